"""Other programs' calibration files: what they say must come out as the same rays, or be refused with the reason.

The oracle is lens_formulas.py: each model's definition, written a second time. The fits' stated errors are compared
with the errors that the oracle sees.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

import lens_formulas as lf
import pipefish as pf
from pipefish import formats
from pipefish.errors import ArgumentError, PipefishError, ProfileError
from pipefish.lenses import SplinedStereographic

DATA = Path(__file__).with_name("data") / "formats"
OCAM = (-260.0, 0.0, 1.1e-03, -9.0e-07, 2.0e-09)
KB_K = (-0.012, 0.0045, -0.002, 0.0003)

# file, camera in it, options, oracle, exact?
CASES = {
    "opencv-fisheye": (
        "opencv_fisheye.yaml", 0, {}, lf.fisheye((301.5, 299.75), (410.25, 290.5), KB_K, 1.25), True
    ),
    "opencv": (
        "opencv_pinhole.yaml", 0, {},
        lf.pinhole((610, 611), (322.5, 238.25), (-0.11, 0.02, 1e-3), (3e-4, -2e-4)), False,
    ),
    "opencv-omnidir": (
        "opencv_omnidir.yaml", 0, {}, lf.mei(0.95, (560, 561), (402, 297), (-0.02, 0.005), (2e-4, -1e-4), 0.8), False
    ),
    "ros": (
        "ros_equidistant.yaml", 0, {}, lf.fisheye((240.5, 241.5), (361, 268.5), (0.011, -0.004, 0.0012, -1e-5)), True
    ),
    "ros-rational": (
        "ros_rational.yaml", 0, {},
        lf.pinhole((600, 602), (318, 244), (0.3, 0.05, 0.001, 0.35, 0.07, 0.002), (1e-4, -2e-4)), False,
    ),
    "kalibr-equi": (
        "kalibr.yaml", "cam0", {}, lf.fisheye((190.9, 190.8), (254.9, 256.8), (0.0034, 0.0007, -0.002, 0.0002)), True
    ),
    "kalibr-omni": (
        "kalibr.yaml", "cam1", {},
        lf.mei(1.2, (700, 702), (320.5, 241.5), (-0.05, 0.01), (2e-4, -3e-4)), False,
    ),
    "kalibr-ds": ("kalibr.yaml", "cam2", {}, lf.double_sphere(-0.17, 0.59, (158.3, 158.2), (254.9, 256.9)), False),
    "kalibr-eucm": ("kalibr.yaml", "cam3", {}, lf.eucm(0.63, 1.04, (191.1, 191.2), (255.1, 256.7)), False),
    "kalibr-fov": ("kalibr.yaml", 4, {}, lf.fov(0.93, (400, 401), (321, 239)), False),
    "kalibr-pinhole": ("kalibr.yaml", "cam5", {}, lf.pinhole((700, 701), (321, 239)), True),
    "kalibr-omni-plain": ("kalibr.yaml", "cam6", {}, lf.mei(0.96, (410, 411), (402.5, 301.5)), True),
    "colmap-fisheye": ("cameras.txt", "1", {}, lf.fisheye((301.5, 299.75), (409.75, 290), KB_K), True),
    "colmap-radial-fisheye": ("cameras.txt", "2", {}, lf.fisheye((300.5, 300.5), (400, 300), (0.01, -0.002)), True),
    "colmap-pinhole": ("cameras.txt", "3", {}, lf.pinhole((600.25, 600.25), (320, 240)), True),
    "colmap-thin-prism": (
        "cameras.txt", "4", {},
        lf.colmap_thin_prism(
            (310, 311), (319.5, 239.5), (-0.01, 0.002, 0.0001, 0.00005), (0.0003, -0.0002), (0.0004, -0.0003)
        ), False,
    ),
    "colmap-opencv": (
        "cameras.txt", "5", {}, lf.pinhole((610, 611), (322.5, 238.25), (-0.05, 0.01), (3e-4, -2e-4)), False
    ),
    "basalt-kb4": (
        "basalt.json", "cam0", {}, lf.fisheye((190.9, 190.8), (254.9, 256.8), (0.0034, 0.0007, -0.002, 0.0002)), True
    ),
    "basalt-ds": ("basalt.json", "cam1", {}, lf.double_sphere(-0.17, 0.59, (158.3, 158.2), (254.9, 256.9)), False),
    "basalt-eucm": ("basalt.json", "cam2", {}, lf.eucm(0.63, 1.04, (191.1, 191.2), (255.1, 256.7)), False),
    "basalt-ucm": ("basalt.json", "cam3", {}, lf.eucm(0.63, 1.0, (191.1, 191.2), (255.1, 256.7)), True),
    "orbslam3": (
        "orbslam3.yaml", 0, {}, lf.fisheye((190.9, 190.8), (254.9, 256.8), (0.0034, 0.0007, -0.002, 0.0002)), True
    ),
    "stella": (
        "stella.yaml", 0, {}, lf.fisheye((441.5, 442.5), (480.25, 275.5), (-3e-2, -3.3e-3, -2.8e-3, -5.9e-4)), True
    ),
    "svo": ("svo.yaml", 0, {}, lf.ocam_toolbox(OCAM, (238.5, 330.5), 1.002, 0.0004, -0.0003), False),
    "ocam": ("calib_results.txt", 0, {}, lf.ocam_toolbox(OCAM, (238.5, 330.5), 1.002, 0.0004, -0.0003), False),
    "pyocamcalib": (
        "pyocamcalib.json", 0, {"size": (640, 480)},
        lf.py_ocam([-v for v in OCAM], (330.5, 238.5), ((1.002, 0.0004), (-0.0003, 1.0))), False,
    ),
    "boofcv-omni": (
        "boofcv_omni.yaml", 0, {}, lf.mei(1.1, (610, 611), (399.5, 300.5), (-0.03, 0.01), (2e-4, -1e-4), 0.5), False
    ),
    "boofcv-kannala-brandt": (
        "boofcv_kb.yaml", 0, {},
        lf.kannala_brandt(
            (1.5, -0.02, 0.003, -0.001, 0.00005), (210, 211), (399.5, 300.5),
            ((0.001, -0.0005, 0.0002), (1.0, -0.5, 0.25, 0.75)),
            ((-0.0008, 0.0004, 0.0001), (0.5, 1.5, -0.3, 0.2)),
        ), True,
    ),
    "woodscape": (
        "woodscape.json", 0, {}, lf.woodscape((340, -3, 6, -1), 1.01, (640 - 0.5 + 3.5, 483 - 0.5 - 2.25)), False
    ),
    "mrcal-opencv8": (
        "pinhole.cameramodel", 0, {},
        lf.pinhole((610, 611), (322.5, 238.25), (0.3, 0.05, 0.001, 0.35, 0.07, 0.002), (1e-4, -2e-4)), False,
    ),
    "mrcal-stereographic": ("stereographic.cameramodel", 0, {}, lf.stereographic((300, 301), (401.5, 299)), True),
    "toolbox-p9": (
        "toolbox_p9.txt", 0, {},
        lf.kannala_brandt((4.0, -0.4, 0.1, -0.02, 0.001), (75.5, 75.0), (323.5, 229.5)), True,
    ),
    "toolbox-p23": (
        "toolbox_p23.txt", 0, {"size": (800, 600)},
        lf.kannala_brandt(
            (2.0, -0.05, 0.004, -0.001, 0.0001), (150.5, 151), (400, 298.5),
            ((-0.0015, 0.0008, 0.0002), (1.0, -0.5, 0.25, 0.75)),
            ((0.002, -0.001, 0.0003), (0.5, 1.5, -0.3, 0.2)),
        ), True,
    ),
    "adapter": ("adapter_ds.yml", 0, {}, lf.double_sphere(-0.17, 0.59, (158.3, 158.2), (254.9, 256.9)), False),
}  # fmt: skip


def pixel_grid(width, height, n=17):
    """Pixels of the whole picture, its corners included."""
    sides = np.meshgrid(np.linspace(-0.49, width - 0.51, n), np.linspace(-0.49, height - 0.51, n))
    return np.stack(sides, axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("name", CASES)
def test_rays_of_a_file_are_those_of_its_models_definition(name):
    file, which, options, oracle, exact = CASES[name]
    form = "toolbox" if file == "toolbox_p23.txt" else None
    loaded = formats.load(DATA / file, camera=which, max_error=0.5, form=form, **options)
    assert loaded.fit.exact is exact, loaded.fit
    cam = loaded.camera
    pixels = pixel_grid(cam.width, cam.height)
    rays, ok = cam.unproject(pixels)
    assert ok.mean() > 0.97  # p9's sensor corner may lie beyond theta_max by a hair
    error = np.array([np.subtract(oracle(*ray), pixel) for ray, pixel in zip(rays[ok], pixels[ok], strict=True)])
    largest = np.hypot(*error.T).max()
    assert largest <= (1e-9 if exact else 1.05 * loaded.fit.max_px + 1e-9), (largest, loaded.fit)
    assert cam.source == "imported" and not loaded.fit.max_px > 0.5


def test_formats_are_told_by_content_whatever_the_name(tmp_path):
    seen = set()
    for file, _, options, _, _ in CASES.values():
        if file == "toolbox_p23.txt":  # bare numbers could be anything
            continue
        renamed = tmp_path / "calibration"
        renamed.write_bytes((DATA / file).read_bytes())
        seen.add(formats._read(renamed.read_bytes(), None, options.get("size"))[0])
    assert seen == {
        "opencv-fisheye", "opencv", "opencv-omnidir", "ros", "kalibr", "colmap", "basalt", "orbslam3", "stella", "svo",
        "ocam", "pyocamcalib", "boofcv", "woodscape", "mrcal", "toolbox", "adapter",
    }  # fmt: skip


def test_the_same_camera_in_three_scaramuzza_dialects_is_one_camera():
    svo, toolbox = (pf.Camera.load(DATA / f, max_error=1) for f in ("svo.yaml", "calib_results.txt"))
    pixels = pixel_grid(640, 480)
    np.testing.assert_array_equal(svo.unproject(pixels)[0], toolbox.unproject(pixels)[0])


def test_opencv_xml_and_yaml_are_one_camera(tmp_path):
    """FileStorage as OpenCV 4 and 5 write it, and as OpenCV 3 wrote matrices."""
    text = (DATA / "opencv_fisheye.yaml").read_text()
    from_yaml = formats.load(DATA / "opencv_fisheye.yaml")
    (tmp_path / "nd.yml").write_text(text.replace("!!opencv-matrix", "!!opencv-nd-matrix"))
    k = " ".join(map(str, (301.5, 1.25, 410.25, 0.0, 299.75, 290.5, 0.0, 0.0, 1.0)))
    matrix = '<{0} type_id="opencv-{1}matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>\n  {2}</data></{0}>'
    (tmp_path / "cal.xml").write_text(
        '<?xml version="1.0"?>\n<opencv_storage>\n<calibration_time>"Sun 22"</calibration_time>\n'
        "<!-- a remark --><image_width>800</image_width>\n<image_height>600</image_height>\n"
        + matrix.format("camera_matrix", "", k)
        + matrix.format("distortion_coefficients", "nd-", " ".join(map(str, KB_K)))
        + "<files><_>a.png</_><_>b.png</_></files><fisheye_model>1</fisheye_model></opencv_storage>\n"
    )
    for name in ("nd.yml", "cal.xml"):
        loaded = formats.load(tmp_path / name)
        assert loaded.form == "opencv-fisheye" and loaded.fit.exact
        assert dataclasses.replace(loaded.camera, name="") == dataclasses.replace(from_yaml.camera, name="")


def test_ros_messages_as_printed_are_read_like_ros_files(tmp_path):
    text = (
        "width: 640\nheight: 480\ndistortion_model: plumb_bob\nd: [-0.11, 0.02, 0.0003, -0.0002]\n"
        "k: [610.0, 0.0, 322.5, 0.0, 611.0, 238.25, 0.0, 0.0, 1.0]\nr: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nbinning_x: 0\n"
    )
    (tmp_path / "info").write_text(text + "---\n")  # rostopic echo ends each message so
    loaded = formats.load(tmp_path / "info")
    oracle = lf.pinhole((610, 611), (322.5, 238.25), (-0.11, 0.02), (3e-4, -2e-4))
    pixel, _ = loaded.camera.project([[0.3, -0.2, 1.0]])
    assert loaded.form == "ros" and np.abs(pixel[0] - oracle(0.3, -0.2, 1.0)).max() < 1.1 * loaded.fit.max_px


# ---- writers


@pytest.mark.parametrize("form", ["opencv-fisheye", "ros", "kalibr", "colmap", "basalt", "orbslam3"])
def test_a_polynomial_goes_out_and_comes_back_to_the_bit(front, form, tmp_path):
    written = formats.write(front, tmp_path / "out", form)
    assert written.fit.exact and written.fit.max_px == 0
    back = formats.load(tmp_path / "out", form=form)
    fields = ("f_u", "f_v", "k2", "k3", "k4", "k5", "width", "height")
    assert [getattr(back.camera, f) for f in fields] == [getattr(front, f) for f in fields]
    assert back.fit.exact and back.camera.c_u == pytest.approx(front.c_u, abs=1e-12)
    assert formats.load(tmp_path / "out").form == form


def test_colmap_pixels_begin_half_a_pixel_earlier(front, tmp_path):
    formats.write(front, tmp_path / "cameras.txt", "colmap")
    values = (tmp_path / "cameras.txt").read_text().splitlines()[-1].split()
    assert values[1] == "OPENCV_FISHEYE" and [float(v) for v in values[6:8]] == [402.75, 297.0]


def test_toolbox_vector_goes_out_and_comes_back_with_its_asymmetry(tmp_path):
    cam = pf.Camera.from_kannala_toolbox(DATA / "toolbox_p23.txt", size=(800, 600))
    formats.write(cam, tmp_path / "p.txt", "toolbox")
    back = pf.Camera.load(tmp_path / "p.txt", size=(800, 600))
    rays, ok = cam.unproject(pixel_grid(800, 600))
    np.testing.assert_allclose(back.project(rays[ok])[0], cam.project(rays[ok])[0], atol=1e-9)


def test_mrcal_gets_a_spline_within_the_stated_error(front, tmp_path):
    written = formats.write(front, tmp_path / "a.cameramodel", "mrcal")
    assert not written.fit.exact and written.fit.max_px < 0.05
    text = (tmp_path / "a.cameramodel").read_text()
    assert "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3" in text
    back = formats.load(tmp_path / "a.cameramodel")
    rays, ok = front.unproject(pixel_grid(800, 600))
    assert ok.mean() < 1 and "valid_intrinsics_region" in text  # the corners lie beyond theta_max
    error = np.linalg.norm(back.camera.project(rays[ok])[0] - front.project(rays[ok])[0], axis=1)
    assert np.nanmax(error) < written.fit.max_px + back.fit.max_px + 1e-6


@pytest.mark.parametrize("order", [2, 3])
def test_mrcal_splines_reproduce_what_splines_reproduce(order):
    """Control points that are a linear function of their place make exactly that function, wherever the knots lie."""
    nx, ny, fov = 11, 9, math.radians(140)
    per_unit = (nx - 1 - (order - 1)) / (2 * 2 * math.tan(fov / 4))
    u = (np.arange(nx) - (nx - 1) / 2) / per_unit
    v = (np.arange(ny) - (ny - 1) / 2) / per_unit
    control = np.stack(np.meshgrid(0.01 * u, 0.02 * v), axis=-1) + np.array([0.003, -0.004])
    lens = SplinedStereographic(
        width=800, height=600, fx=200, fy=210, cx=400, cy=300, order=order, fov_x=fov, control=control
    )
    rng = np.random.default_rng(3)
    points = np.hstack([rng.uniform(-0.8, 0.8, (200, 2)), np.ones((200, 1))])
    pixels, ok = lens.project(points)
    assert ok.all()
    s = 2 * points[:, :2] / (np.linalg.norm(points, axis=1) + points[:, 2])[:, None]
    expected = (s * [1.01, 1.02] + [0.003, -0.004]) * [200, 210] + [400, 300]
    np.testing.assert_allclose(pixels, expected, atol=1e-10)


def test_unified_cameras_stay_unified_in_kalibr(tmp_path):
    cam = pf.Camera.from_unified(width=800, height=600, fx=410, fy=411, cx=402.5, cy=301.5, xi=0.96)
    written = formats.write(cam, tmp_path / "chain.yaml", "kalibr")
    back = formats.load(tmp_path / "chain.yaml")
    assert written.fit.exact and back.fit.exact and back.camera.mirror == 0.96
    assert back.camera.f_u == pytest.approx(cam.f_u, abs=1e-12)


# ---- refusals


def test_formats_that_end_at_90_degrees_say_so_and_what_to_do(tmp_path):
    wide = pf.Camera.load(DATA / "kalibr.yaml")
    for form in ("opencv-fisheye", "ros", "kalibr", "colmap", "orbslam3"):
        with pytest.raises(ProfileError, match=r"90 degrees.*--max-theta") as caught:
            formats.write(wide, tmp_path / "x", form)
        assert ("divides by z" in caught.value.reason) is (form != "orbslam3")  # which projects with atan2
        assert not (tmp_path / "x").exists()
    written = formats.write(wide, tmp_path / "x", "colmap", max_theta=math.radians(89))
    assert any("89.0 degrees only" in note for note in written.notes)
    assert formats.write(wide, tmp_path / "y", "basalt").fit.exact


def test_what_a_format_lacks_is_named_and_bounded(front, tmp_path):
    bent = dataclasses.replace(front, asym_radial_theta=(0.004, 0, 0), asym_radial_phi=(0, 0, 1, 0))
    with pytest.raises(ProfileError, match=r"no asym_radial.*--max-error 0.1"):
        formats.write(bent, tmp_path / "x", "basalt")
    slight = dataclasses.replace(front, asym_radial_theta=(1e-4, 0, 0), asym_radial_phi=(0, 0, 1, 0))
    written = formats.write(slight, tmp_path / "x", "basalt")
    assert not written.fit.exact and 0.001 < written.fit.max_px < 0.1 and "asym_radial" in written.notes[0]


def test_a_lost_pupil_shift_is_told_in_pixels_at_a_distance(front, tmp_path):
    shifted = dataclasses.replace(front, pupil_e1=-0.0006)
    notes = formats.write(shifted, tmp_path / "x", "basalt").notes
    near = 0.1 * np.array([[math.sin(1.4), 0, math.cos(1.4)]])
    really = np.linalg.norm(shifted.project(near)[0] - front.project(near)[0])
    told = float(next(n for n in notes if "0.1 m" in n).split("up to ")[1].split(" px")[0])
    assert 0.7 * really < told < 1.5 * really


def test_what_does_not_fit_is_refused_with_the_angle_that_does():
    pixels = {"width": 1280, "height": 966, "fx": 1.0, "fy": 1.0, "cx": 640.0, "cy": 480.0}
    from pipefish.lenses import RadialPolynomial

    lens = RadialPolynomial(coefficients=(340.0, -32.0, 48.0, -7.0), **pixels)
    with pytest.raises(ProfileError, match=r"does not fit.*--max-theta \d+ keeps within") as caught:
        formats.from_lens(lens)
    degrees = int(caught.value.reason.split("--max-theta ")[1].split()[0])
    assert formats.from_lens(lens, max_theta=math.radians(degrees)).fit.max_px <= 0.1


CHAIN = "cam0: {{camera_model: {}, intrinsics: [{}, 300, 300, 320, 240], resolution: [640, 480]}}"
WOODSCAPE = (
    '{{"intrinsic": {{"model": "radial_poly", "width": 640, "height": 480, "cx_offset": 0, "cy_offset": 0, '
    '"poly_order": {}, "k1": -3}}}}'
)
ROS = (
    "width: 640\nheight: 480\ndistortion_model: equidistant\nd: [0, 0, 0, 0]\n"
    "k: [300.0, 0.0, 322.5, 0.0, 300.0, 238.25, 0.0, 0.0, 1.0]\n"
)
BAD = [
    ("a: [1, 2", "line"),
    ("", "the file is empty"),
    ("nothing: here", "not a camera calibration"),
    ("when: 2026-02-31\nwhat: !!timestamp never", "not a camera calibration"),
    ("1 OPENCV_FISHEYE 800 600 1 2 3", "8 belong"),
    ("1 DIVISION 800 600 1 2 3 4", "not read"),
    ("cam0: {camera_model: pinhole, intrinsics: [1, 2, 3], resolution: [10, 10]}", "cam0.intrinsics: 3 numbers"),
    ("cam0: {camera_model: pinhole, intrinsics: [1, 2, 3, x], resolution: [10, 10]}", "cam0.intrinsics[3]"),
    ("cam0: {camera_model: fish, intrinsics: [1, 2, 3, 4], resolution: [10, 10]}", "cam0.camera_model"),
    ("cam0: 3", "cam0: not a mapping"),
    ("Camera.type: KannalaBrandt8\nCamera.fx: 3\nCamera.fx: 4", "twice"),
    ("camera_matrix: {data: [1,0,0,0,1,0,0,0,1]}\nD: [0,0,0,0]\nimage_width: 9\nimage_height: 9", "--from opencv"),
    ("K: {data: [1,0,0,0,1,0,0,0,1]}\nD: [0,0,0,0,0]", "image size: not in the file"),
    ("{'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': [1,2,3,4], 'imagersize': [5,5]}", "CAHVOR"),
    ("{'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [1,2,3,4], 'imagersize': [5,5]}", "8 belong"),
    ("{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [__import__('os')], 'imagersize': [5,5]}", "not the literal"),
    ("#polynomial coefficients\n2 1 2 3\n1 1\n1 2\n1 2 3\n5 5", "count"),
    ("para1=1#\npara3=1#", "1, 2, 3"),
    ("para1=1#", "1 parameters"),
    ('{"value0": {"intrinsics": [{}], "resolution": []}}', "not as many"),
    ('{"intrinsic": {"model": "cylindrical"}}', "radial_poly"),
    ("Camera: {model: equirectangular, cols: 9, rows: 9}", "no lens"),
    ("a: &a [1, 2]\nb: [*a, *a]", "line 2: the alias *a"),
    ("camera_matrix: &m {data: [1,0,0,0,1,0,0,0,1]}\nK: *m", "line 2: the alias *m"),
    ("a: [" + "1," * 300_000 + "1]", "YAML longer than"),
    ("distortion_model: [1, 2]", "not a camera calibration"),
    (CHAIN.format("ds", "-1, 0.5"), "cam0.xi: -1 is outside"),
    (CHAIN.format("ds", "0.1, 1.2"), "cam0.alpha: 1.2 is outside"),
    (CHAIN.format("ds", "0.1, -0.2"), "cam0.alpha: -0.2 is outside"),
    (CHAIN.format("eucm", "1.5, 1"), "cam0.alpha: 1.5 is outside"),
    (CHAIN.format("eucm", "0.5, 0"), "cam0.beta: 0 is outside"),
    (CHAIN.replace("300, 300", "-300, 300").format("ds", "0.1, 0.5"), "cam0.fx: -300 is outside"),
    (CHAIN.format("omni", "-1"), "cam0.xi: -1 is outside"),
    ("7 FOV 640 480 300 300 320 240 0", "7.omega: 0 is outside"),
    ("7 FOV 640 480 300 300 320 240 3.2", "7.omega: 3.2 is outside"),
    (WOODSCAPE.format("0"), "intrinsic.poly_order: 0 is not"),
    (WOODSCAPE.format("1.5"), "intrinsic.poly_order: 1.5 is not"),
    (WOODSCAPE.format("1"), "camera.k1: -3 is outside"),
    (ROS + "---\n" + ROS, "2 documents, divided by ---"),
    ("<opencv_storage><K>1 2</opencv_storage>", "line 1 column 25: not XML: mismatched tag"),
    ("<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage>&b;</opencv_storage>", "DOCTYPE"),
    ("<opencv_storage>&b;</opencv_storage>", "not XML: undefined entity"),
    ("<opencv_storage><a>1</a><a>2</a></opencv_storage>", "twice"),
    ("<opencv_storage>" + "<a>" * 5000 + "</a>" * 5000 + "</opencv_storage>", "too deep"),
    ("<html><body/></html>", "XML of <html>, not OpenCV's"),
    (
        "<opencv_storage><K type_id='opencv-matrix'><data>1 0 0 0 1 0 0 0 x</data></K><D>1 2 3 4</D>"
        "<fisheye_model>1</fisheye_model></opencv_storage>",
        "K[8]: not a number",
    ),
    ("K: {data: [1,0,0,0,1,0,0,1,1]}\nD: [0,0,0,0,0]", "its last row is not 0 0 1"),
    (ROS + "binning_x: 2", "binning_x: binned pictures"),
    (ROS + "roi: {x_offset: 8, y_offset: 0, width: 100, height: 90}", "roi: cropped pictures"),
]


@pytest.mark.parametrize(("text", "expected"), BAD)
def test_bad_files_are_refused_with_place_and_reason(text, expected, tmp_path):
    file = tmp_path / "bad"
    file.write_text(text)
    with pytest.raises(ProfileError) as caught:
        formats.load(file)
    assert expected in str(caught.value) and str(file) in str(caught.value)


def test_a_bomb_of_aliases_is_refused_at_its_first_alias(tmp_path):
    """Nine levels of nine: its repr alone would be gigabytes."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    (tmp_path / "bomb").write_text("\n".join([*lines, "camera_matrix: *a8", "D: [1]"]))
    with pytest.raises(ProfileError, match=r"line 2: the alias \*a0 is not read"):
        formats.load(tmp_path / "bomb")


def test_a_value_in_an_error_is_short_however_deep_it_is(tmp_path):
    deep = "[" * 400 + "]" * 400
    (tmp_path / "deep").write_text(
        f'{{"distortion_model": "fisheye", "K": [{deep},0,0,0,1,0,0,0,1], "width": 9, "d": [0]}}'
    )
    with pytest.raises(ProfileError) as caught:
        formats.load(tmp_path / "deep")
    assert len(caught.value.reason) < 120


def test_whole_pictures_of_ros_are_read(tmp_path):
    for more in ("binning_x: 1\n", "roi: {x_offset: 0, y_offset: 0, width: 640, height: 480, do_rectify: false}\n"):
        (tmp_path / "info").write_text(ROS + more)
        assert formats.load(tmp_path / "info").fit.exact


def test_models_by_their_parameters_are_refused_outside_their_definition():
    size = {"width": 512, "height": 512, "fx": 158, "fy": 158, "cx": 255, "cy": 257}
    with pytest.raises(ProfileError, match=r"alpha: 1\.7 is outside"):
        pf.Camera.from_double_sphere(**size, xi=0.1, alpha=1.7)
    with pytest.raises(ProfileError, match="beta: -1 is outside"):
        pf.Camera.from_eucm(**size, alpha=0.5, beta=-1)
    with pytest.raises(ProfileError, match="xi: -1 is outside"):
        pf.Camera.from_mei(**size, xi=-1)


# ---- options


@pytest.mark.parametrize("suffix", ["json", "profile"])
def test_options_count_for_profiles_as_for_other_files(front, suffix, tmp_path):
    file = tmp_path / f"own.{suffix}"
    file.write_bytes(front.to_binary() if suffix == "profile" else front.to_json().encode())
    assert formats.load(file, max_theta=math.radians(60)).camera.theta_max == math.radians(60)
    assert formats.load(file, max_theta=math.radians(120)).camera.theta_max == front.theta_max
    assert formats.load(file, camera=0).camera_name == formats.load(file, camera="front").camera_name == "front"
    with pytest.raises(ProfileError, match="no camera 'cam1'; there are front"):
        formats.load(file, camera="cam1")
    with pytest.raises(ProfileError, match="image size: 800 x 600 in the file, 640 x 480 given"):
        formats.load(file, size=(640, 480))
    assert formats.load(file, size=(800, 600)).fit is None
    assert formats.load(file, model="p6", max_error=9, max_theta=1.0).fit.max_px > 0.01
    with pytest.raises(ProfileError, match="p6 does not fit"):
        formats.load(file, model="p6", max_error=1e-9)


def test_a_size_that_is_not_the_files_is_refused():
    with pytest.raises(ProfileError, match="512 x 512 in the file"):
        formats.load(DATA / "kalibr.yaml", size=(640, 480))


@pytest.mark.parametrize("camera", ["²", "٣", "-1", "9" * 5000, 7])
def test_cameras_that_are_not_there_are_refused_by_name(camera):
    with pytest.raises(ProfileError, match="there are cam0, cam1"):
        formats.load(DATA / "kalibr.yaml", camera=camera)


@pytest.mark.parametrize("which", ["cam0", "cam2", "cam6"])  # exact, fitted, exact in another family
def test_no_camera_goes_beyond_max_theta(which):
    for degrees in (40.0, 61.0):
        camera = formats.load(DATA / "kalibr.yaml", camera=which, max_theta=math.radians(degrees)).camera
        assert 0.99 * math.radians(degrees) < camera.theta_max <= math.radians(degrees)


@pytest.mark.parametrize("file", sorted(p.name for p in DATA.iterdir()))
def test_damaged_files_raise_nothing_but_our_own_errors(file, tmp_path):
    data = (DATA / file).read_bytes()
    rng = np.random.default_rng(len(data))
    for _ in range(25):
        broken = bytearray(data)
        for place in rng.integers(0, len(data), 3):
            broken[place] = int(rng.integers(0, 256))
        target = tmp_path / "broken"
        target.write_bytes(bytes(broken[: int(rng.integers(1, len(data) + 1))]))
        try:
            text = formats.decode(target.read_bytes())
            form = formats._guess_text(text)
            formats._read(target.read_bytes(), form, (640, 480))
        except PipefishError:
            pass


# ---- fits


def test_a_fit_finds_the_camera_that_made_the_data():
    rng = np.random.default_rng(5)
    truth = pf.Camera.from_kannala_toolbox(DATA / "toolbox_p23.txt", size=(800, 600))
    rays, ok = truth.unproject(rng.uniform([0, 0], [799, 599], (600, 2)))
    pixels = truth.project(rays[ok])[0]
    cam, fit = pf.Camera.fit(rays[ok], pixels, (800, 600), model="p23")
    assert fit.max_px < 1e-6
    np.testing.assert_allclose(cam.project(rays[ok])[0], pixels, atol=1e-6)
    symmetric, worse = pf.Camera.fit(rays[ok], pixels, (800, 600), model="p9")
    assert worse.rms_px > 0.05 and not any(symmetric.asym_radial_theta)


@pytest.mark.parametrize("model", ["p9", "cpoly"])
def test_least_squares_averages_noise_as_theory_says(model):
    """The residual of a fit with n free parameters is sigma sqrt(1 - n / (2 N))."""
    rng = np.random.default_rng(6)
    truth = pf.Camera.load(DATA / "kalibr.yaml")
    rays, ok = truth.unproject(rng.uniform([0, 0], [511, 511], (4000, 2)))
    noisy = truth.project(rays[ok])[0] + rng.normal(0, 0.2, (ok.sum(), 2))
    cam, fit = pf.Camera.fit(rays[ok], noisy, (512, 512), model=model)
    assert fit.rms_px == pytest.approx(0.2 * math.sqrt(2), rel=0.03)
    assert abs(cam.c_u - truth.c_u) < 0.05 and abs(cam.f_u - truth.f_u) < 0.3


@pytest.mark.parametrize("radial", ["stereographic", "equisolid", "orthographic", "perspective"])
def test_classical_lenses_become_the_polynomial_within_the_told_error(radial):
    cam = pf.Camera(width=640, height=480, f_u=420, f_v=420, c_u=319.5, c_v=239.5, theta_max=0.75, radial=radial)
    made, fit = cam.to_generic("p9")
    rays, ok = cam.unproject(pixel_grid(640, 480))
    error = np.linalg.norm(made.project(rays[ok])[0] - cam.project(rays[ok])[0], axis=1)
    assert made.radial == "generic" and np.nanmax(error) <= fit.max_px * 1.05 < 0.02


def test_fit_refuses_what_it_cannot_use():
    with pytest.raises(PipefishError, match="points but"):
        pf.Camera.fit(np.ones((3, 3)), np.ones((4, 2)), (10, 10))
    with pytest.raises(PipefishError, match="none of"):
        pf.Camera.fit(np.ones((30, 3)), np.ones((30, 2)), (10, 10), model="p99")
    with pytest.raises(PipefishError, match="cannot tell"):
        pf.Camera.fit(np.eye(3), np.ones((3, 2)), (10, 10))


def test_parameter_constructors_say_what_is_missing():
    with pytest.raises(PipefishError, match="alpha"):
        pf.Camera.from_double_sphere(width=512, height=512, fx=1, fy=1, cx=2, cy=3, xi=0.1)
    k = np.array([[301.5, 1.25, 410.25], [0, 299.75, 290.5], [0, 0, 1]])
    for row, column, value in ((2, 2, 2.0), (2, 0, 0.1), (1, 0, 0.1)):
        wrong = k.copy()
        wrong[row, column] = value
        with pytest.raises(ArgumentError, match=r"\[0, 0, 1\]"):
            pf.Camera.from_opencv_fisheye(wrong, KB_K, size=(800, 600))
    with pytest.raises(ProfileError, match="fx: -300 is outside"):
        pf.Camera.from_opencv_fisheye(np.diag([-300.0, 300, 1]), KB_K, size=(800, 600))
    a = pf.Camera.from_opencv_fisheye(k, KB_K, size=(800, 600))
    b = pf.Camera.from_opencv_fisheye(DATA / "opencv_fisheye.yaml")
    assert [a.f_u, a.skew, a.k2, a.theta_max] == [b.f_u, b.skew, b.k2, b.theta_max]


# ---- real files

REAL = {  # file: (max_error it needs, reason otherwise)
    "adapter_euroc_DS.yml": 0.1,
    "adapter_euroc_EUCM.yml": 0.1,
    "adapter_euroc_KB.yml": 0.1,
    "basalt_tumvi_512_ds_calib.json": 0.1,
    "basalt_tumvi_512_eucm_calib.json": 0.1,
    "endomapper_endoscope03_orbslam3_kb.yaml": 0.1,
    "kannala_toolbox_p.txt": 0.1,
    "openvins_tum_vi_kalibr_imucam_chain.yaml": 0.1,
    "openvins_uzhfpv_indoor_kalibr_imucam_chain.yaml": 0.1,
    "orbslam3_tumvi_stereo_KannalaBrandt8.yaml": 0.1,
    "stella_aist_fisheye.yaml": 0.1,
    "tumvi_512_kalibr_camchain.yaml": 0.1,
    # to the corners of the picture, far outside what their calibrations covered:
    "adapter_euroc_RadTan.yml": 0.5,
    "adapter_ocam.yml": 1.2,
    "boofcv_theta_front_universalomni.yaml": 0.5,
    "pyocamcalib_fisheye1_scaramuzza.json": 0.3,
    "svo_bluefox_25000826_ocam.yaml": 0.7,
    "woodscape_front_radialpoly.json": 0.5,
}


def load_real(folder, file, **options):
    size = {"size": (1032, 778)} if file.startswith("pyocam") else {}
    return formats.load(folder / file, **size, **options)


@pytest.mark.parametrize("file", REAL)
def test_published_calibrations_load_or_are_refused_with_the_reason(real_data, file):
    folder = real_data("profiles")
    loaded = load_real(folder, file, max_error=REAL[file])
    pixels = pixel_grid(loaded.camera.width, loaded.camera.height)
    rays, ok = loaded.camera.unproject(pixels)
    again, _ = loaded.camera.project(rays[ok])
    assert np.abs(again - pixels[ok]).max() < 1e-9
    if REAL[file] > 0.1:
        with pytest.raises(ProfileError, match=r"does not fit.*0\.1 px are allowed.*--max-error"):
            load_real(folder, file)


# The same camera, calibrated once per model by its publisher: how far their rays may differ, degrees, within an angle
# of the axis. The figures are of the models (each fits its own data to some tenths of a pixel), not of the conversion.
PAIRS = [
    ("tumvi_512_kalibr_camchain.yaml", "openvins_tum_vi_kalibr_imucam_chain.yaml", 115, 1e-12),
    ("tumvi_512_kalibr_camchain.yaml", "orbslam3_tumvi_stereo_KannalaBrandt8.yaml", 115, 1e-12),
    ("tumvi_512_kalibr_camchain.yaml", "basalt_tumvi_512_ds_calib.json", 60, 0.12),
    ("tumvi_512_kalibr_camchain.yaml", "basalt_tumvi_512_ds_calib.json", 90, 0.27),
    ("basalt_tumvi_512_eucm_calib.json", "basalt_tumvi_512_ds_calib.json", 90, 0.016),
    ("adapter_euroc_KB.yml", "adapter_euroc_DS.yml", 57, 0.16),
    ("adapter_euroc_EUCM.yml", "adapter_euroc_DS.yml", 57, 0.07),
    ("adapter_euroc_KB.yml", "adapter_euroc_RadTan.yml", 35, 0.2),
]


@pytest.mark.parametrize(("one", "other", "within", "bound"), PAIRS)
def test_published_calibrations_of_one_camera_agree(real_data, one, other, within, bound):
    folder = real_data("profiles")
    a, b = (load_real(folder, f, max_error=0.5).camera for f in (one, other))
    pixels = pixel_grid(a.width, a.height, 60)
    (ray_a, ok_a), (ray_b, ok_b) = a.unproject(pixels), b.unproject(pixels)
    use = ok_a & ok_b & (ray_a[:, 2] > math.cos(math.radians(within)))
    angle = np.degrees(np.linalg.norm(np.cross(ray_a[use], ray_b[use]), axis=1)).max()
    assert use.sum() > 500 and angle <= bound


def test_fit_is_reported_in_json(tmp_path, capsys):
    from pipefish import cli

    out = tmp_path / "c.json"
    assert cli.main(["profile", "convert", str(DATA / "kalibr.yaml"), str(out), "--camera", "cam2", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["read_as"] == "kalibr" and 0 < document["read_fit"]["max_px"] < 0.01
    assert document["read_fit"]["exact"] is False and document["read_fit"]["compared_to_deg"] > 100
