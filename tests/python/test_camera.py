"""pipefish.Camera: conventions, round trips, files, and errors that name file and key."""

import copy
import dataclasses
import datetime
import json
import math
import os
import pickle
from pathlib import Path

import numpy as np
import pytest

import pipefish as pf
from pipefish.camera import PARAMETERS
from pipefish.errors import ArgumentError, FormatError, PipefishError, ProfileError

ROOT = Path(__file__).resolve().parents[2]


def make(**changes):
    values = {
        "width": 1280,
        "height": 800,
        "f_u": 356.2,
        "f_v": 355.9,
        "c_u": 647.3,
        "c_v": 404.8,
        "skew": 0.3,
        "k2": -0.031,
        "k3": 0.0042,
        "k4": -0.0011,
        "k5": 0.00006,
        "theta_max": math.radians(110),
        "circle_u": 640.0,
        "circle_v": 400.0,
        "circle_radius": 560.0,
        "name": "Öl-Kanal 7",
        "serial": "SN 42",
        "source": "target",
        "created": datetime.datetime(2026, 1, 31, 12, 0, 5, tzinfo=datetime.UTC),
        "lens": "f/2 1.6 mm, Schärfe 0,3 m",
        "rms_px": 0.1 + 0.2,
        "held_out_rms_px": 1 / 3,
        "provenance": pf.Provenance(
            tool="pipefish", version="0.1.0", model_choice="p9", views=20, points=1760, held_out_views=5
        ),
        "theta_covered": 1.5,
        "covariance_parameters": ("f_u", "k5", "cpoly[13]"),
        "covariance": [[1e-2, 1e-7, 0], [1e-7, 3e-9, -1e-10], [0, -1e-10, 1 / 3]],
    }
    return pf.Camera(**values | changes)


def test_conventions_of_axes_pixels_and_angles():
    cam = pf.Camera(width=640, height=480, f_u=100, f_v=200, c_u=320, c_v=240, theta_max=3)
    points = np.array([[0, 0, 2], [1, 0, 1], [0, 1, 1], [-5, 0, 0], [0, 1, -1]])
    pixels, ok = cam.project(points)
    quarter = math.pi / 4
    expected = [
        [320, 240],
        [320 + 100 * quarter, 240],
        [320, 240 + 200 * quarter],
        [320 - 200 * quarter, 240],
        [320, 240 + 600 * quarter],
    ]
    assert pixels.dtype == np.float64 and ok.dtype == np.bool_ and ok.shape == (5,) and ok.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-12)


def test_project_equals_the_formula_in_numpy():
    cam = make()
    rng = np.random.default_rng(1)
    points = rng.normal(size=(5000, 3))
    theta = np.arccos(points[:, 2] / np.linalg.norm(points, axis=1))
    phi = np.arctan2(points[:, 1], points[:, 0])
    r = theta + cam.k2 * theta**3 + cam.k3 * theta**5 + cam.k4 * theta**7 + cam.k5 * theta**9
    expected = np.stack(
        [cam.f_u * r * np.cos(phi) + cam.skew * r * np.sin(phi) + cam.c_u, cam.f_v * r * np.sin(phi) + cam.c_v], axis=1
    )
    pixels, ok = cam.project(points)
    np.testing.assert_array_equal(ok, theta <= cam.theta_max)
    assert 0.4 < ok.mean() < 0.95
    np.testing.assert_allclose(pixels[ok], expected[ok], atol=1e-9)
    assert np.isnan(pixels[~ok]).all()


def test_round_trip_over_the_image_and_origins():
    cam = make()
    u, v = np.meshgrid(np.arange(0, 1280, 9.7), np.arange(0, 800, 9.7))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, ok = cam.unproject(pixels)
    assert 0.8 < ok.mean() < 1  # the corners lie beyond 110 degrees
    np.testing.assert_allclose(np.linalg.norm(rays[ok], axis=1), 1, atol=1e-15)
    back, again = cam.project(3.7 * rays[ok])
    assert again.all() and np.abs(back - pixels[ok]).max() <= 1e-9
    np.testing.assert_array_equal(cam.origins(pixels), np.zeros_like(rays))


def test_invalid_items_are_nan_with_ok_false():
    cam = make()
    pixels, ok = cam.project([[0, 0, 0], [0, 0, -1], [np.nan, 0, 1], [np.inf, 0, 1], [0, 0, 1]])
    assert ok.tolist() == [False] * 4 + [True] and np.isnan(pixels[:4]).all()
    rays, ok = cam.unproject([[1e5, 0], [np.nan, 0], [600, 400]])
    assert ok.tolist() == [False, False, True] and np.isnan(rays[:2]).all()


def test_arrays_of_any_layout_and_empty_ones_are_taken():
    cam = make()
    points = np.random.default_rng(2).normal(size=(3, 40)) + np.array([[0], [0], [5]])
    reference, _ = cam.project(np.ascontiguousarray(points.T))
    np.testing.assert_array_equal(cam.project(points.T)[0], reference)
    np.testing.assert_array_equal(cam.project(points.T[::-2])[0], reference[::-2])
    np.testing.assert_allclose(cam.project(points.T.astype(np.float32))[0], reference, atol=1e-3)
    np.testing.assert_array_equal(cam.project([[0, 0, 1]])[0], [[cam.c_u, cam.c_v]])
    pixels, ok = cam.project(np.zeros((0, 3)))
    assert pixels.shape == (0, 2) and ok.shape == (0,)
    assert cam.unproject(np.zeros((0, 2)))[0].shape == (0, 3)


@pytest.mark.parametrize("bad", [np.zeros(3), np.zeros((4, 2)), np.zeros((2, 2, 3)), 5.0, [], [[1, 2, 3], [4]]])
def test_wrong_shapes_say_what_was_expected(bad):
    with pytest.raises(ArgumentError, match=r"points: .*expected shape \(N, 3\)"):
        make().project(bad)


def test_wrong_types_and_columns_say_what_was_expected():
    for bad in (np.zeros((2, 3), complex), [["a", "b", "c"]], np.zeros((2, 3), bool), [[None] * 3]):
        with pytest.raises(ArgumentError, match="points: expected real numbers"):
            make().project(bad)
    for method in (make().unproject, make().origins):
        with pytest.raises(ArgumentError, match=r"pixels: expected shape \(N, 2\), got \(1, 3\)"):
            method(np.zeros((1, 3)))


def test_json_round_trip_keeps_every_bit(tmp_path):
    for cam in (make(), make(covariance=None, covariance_parameters=(), rms_px=None, theta_covered=None, created=None)):
        cam.save(tmp_path / "a.json")
        back = pf.Camera.load(tmp_path / "a.json")
        assert back == cam and back.to_binary() == cam.to_binary() and hash(back) == hash(cam)
        for field in dataclasses.fields(pf.Camera):
            np.testing.assert_array_equal(getattr(back, field.name), getattr(cam, field.name), err_msg=field.name)
        back.save(tmp_path / "b.json")
        assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["a.json", "b.json"]


def test_binary_round_trip_copies_and_pickles():
    cam = make()
    assert pf.Camera.from_binary(cam.to_binary()) == cam
    assert copy.deepcopy(cam) == cam and pickle.loads(pickle.dumps(cam)) == cam
    assert dataclasses.replace(cam, k2=-0.03) != cam
    assert make(name="other") != cam and cam != 5
    with pytest.raises(dataclasses.FrozenInstanceError):
        cam.f_u = 1.0


def test_binary_damage_is_refused_with_the_field():
    data = make().to_binary()
    for bad, field in ((data[:-1], "length"), (data + b"\0", "length"), (b"", "length"), (b"JSON" + data, "magic")):
        with pytest.raises(ProfileError) as caught:
            pf.Camera.from_binary(bad)
        assert caught.value.key == field and caught.value.path is None
    with pytest.raises(ProfileError, match="checksum: the profile is damaged"):
        pf.Camera.from_binary(data[:200] + bytes([data[200] ^ 4]) + data[201:])


def test_repr_shows_what_identifies_a_camera():
    text = repr(make())
    assert text.startswith("Camera('Öl-Kanal 7', 1280x800, f=(356.20, 355.90)") and "110.00 deg" in text


def test_parameters_are_numbered_as_the_binary_form_says():
    expected = {"f_u": 0, "k5": 8, "asym_radial_theta[0]": 9, "asym_radial_phi[0]": 12, "asym_tangential_theta[0]": 16}
    expected |= {"asym_tangential_phi[0]": 19, "tilt[0]": 23, "mirror": 25, "pupil_e1": 26, "cpoly[0]": 27}
    assert {name: PARAMETERS.index(name) for name in expected} == expected and len(PARAMETERS) == 41


BAD_VALUES = [
    ("width", 0),
    ("width", 1.5),
    ("width", True),
    ("width", 1 << 40),
    ("height", -1),
    ("f_u", 0),
    ("f_u", "300"),
    ("f_u", None),
    ("f_v", float("nan")),
    ("c_u", float("inf")),
    ("c_v", 10**400),
    ("skew", 400),
    ("k2", [1]),
    ("k3", False),
    ("k4", 1e9),
    ("k5", {}),
    ("theta_max", math.pi),
    ("theta_max", -1),
    ("tilt[0]", [0.8, 0]),
    ("tilt", [0]),
    ("tilt", "00"),
    ("asym_radial_theta", [2e6, 0, 0]),
    ("asym_radial_phi[0]", ["1", 0, 0, 0]),
    ("asym_tangential_theta", [0, 0, 2e6]),
    ("asym_tangential_phi", 0),
    ("cpoly", [0] * 13),
    ("cpoly[1]", [0, "x"] + [0] * 12),
    ("mirror", 0.9),
    ("pupil_e1", 2),
    ("circle_u", 1e9),
    ("circle_v", "x"),
    ("circle_radius", -1),
    ("radial", "fisheye"),
    ("source", 1),
    ("name", "x" * 64),
    ("name", "a\nb"),
    ("name", "a\0b"),
    ("name", "\ud800"),
    ("serial", None),
    ("rms_px", -1),
    ("held_out_rms_px", -1),
    ("held_out_rms_px", "x"),
    ("lens", "x" * 64),
    ("lens", 1),
    ("rms_px", float("nan")),
    ("theta_covered", 4),
    ("created", 5),
]


@pytest.mark.parametrize(("key", "value"), BAD_VALUES)
def test_constructor_names_the_argument(key, value):
    with pytest.raises(ProfileError) as caught:
        make(**{key.split("[")[0]: value})
    assert caught.value.key == key and caught.value.path is None and caught.value.reason


BAD_JSON = [
    *BAD_VALUES,
    ("theta_max", 3.1),
    ("created", "yesterday"),
    ("created", "1969-12-31T23:59:59Z"),
    ("format", "other"),
    ("version", 3),
    ("version", True),
    ("f_w", 1),
    ("units", {"image": "pixel", "angle": "degree", "length": "metre"}),
    ("provenance", []),
    ("provenance.author", {"author": "me"}),
    ("provenance.tool", {"tool": "x" * 32}),
    ("provenance.version", {"version": 1}),
    ("provenance.model_choice", {"model_choice": "a\nb"}),
    ("provenance.views", {"views": -1}),
    ("provenance.points", {"points": 1.5}),
    ("provenance.held_out_views", {"held_out_views": 1 << 32}),
    ("covariance", []),
    ("covariance", {"parameters": ["f_u"]}),
    ("covariance", {"parameters": ["f_u"], "lower": []}),
    ("covariance", {"parameters": ["f_u"], "lower": [[-1]]}),
    ("covariance", {"parameters": ["f_u", "f_v"], "lower": [[1], [2, 1]]}),
    ("covariance.lower[1]", {"parameters": ["f_u", "f_v"], "lower": [[1], [1]]}),
    ("covariance.lower[1][0]", {"parameters": ["f_u", "f_v"], "lower": [[1], ["x", 1]]}),
    ("covariance.parameters", {"parameters": ["focal"], "lower": [[1]]}),
    ("covariance.parameters", {"parameters": ["f_v", "f_u"], "lower": [[1], [0, 1]]}),
    ("covariance.parameters", {"parameters": ["f_u", "f_u"], "lower": [[1], [0, 1]]}),
]


@pytest.mark.parametrize(("key", "value"), BAD_JSON)
def test_bad_json_names_file_and_key(tmp_path, key, value):
    path = tmp_path / "profile.json"
    make().save(path)
    document = json.loads(path.read_text(encoding="utf-8"))
    if key == "theta_max" and value == 3.1:
        document["k2"] = -0.3
    document[key.split("[")[0].split(".")[0]] = value
    path.write_text(json.dumps(document))
    with pytest.raises(ProfileError) as caught:
        pf.Camera.load(path)
    assert caught.value.key == key and str(caught.value).startswith(f"{path}: {key}: ")


@pytest.mark.parametrize(
    "key", ["format", "version", "units", "width", "height", "f_u", "f_v", "c_u", "c_v", "k2", "k5", "theta_max"]
)
def test_missing_keys_are_named(tmp_path, key):
    path = tmp_path / "profile.json"
    make().save(path)
    document = json.loads(path.read_text(encoding="utf-8"))
    del document[key]
    path.write_text(json.dumps(document))
    with pytest.raises(ProfileError, match=f": {key}: "):
        pf.Camera.load(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b'{"format":\n oops}', "line 2 column 2"),
        (b"[]", "not a JSON object"),
        (b"\xff\xfe", "byte 0: not UTF-8"),
        (b"[" * 200000, "not a profile in JSON"),
        (b'{"f_u": 1, "f_u": 2}', "f_u: appears twice"),
        (b" " * (1 << 20) + b"{}", "longer than"),
    ],
)
def test_files_that_are_no_profile(tmp_path, content, message):
    path = tmp_path / "profile.json"
    path.write_bytes(content)
    with pytest.raises(ProfileError) as caught:
        pf.Camera.load(path)
    assert message in str(caught.value) and str(caught.value).startswith(f"{path}: ")


def test_missing_file_and_folder_raise_our_own_error(tmp_path):
    for path in (tmp_path / "absent.json", tmp_path):
        with pytest.raises(ProfileError) as caught:
            pf.Camera.load(path)
        assert isinstance(caught.value, FormatError) and isinstance(caught.value, PipefishError)
        assert str(caught.value).startswith(f"{path}: ")


def test_a_failed_save_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch):
    path = tmp_path / "profile.json"
    make().save(path)
    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", lambda fd: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        make(name="new").save(path)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["profile.json"]


def test_covariance_in_the_constructor_is_checked():
    for parameters, covariance, key in (
        (("f_u",), None, "covariance"),
        ((), [[1.0]], "covariance"),
        (("f_u",), [[1.0, 0.0]], "covariance"),
        (("f_u",), [["x"]], "covariance"),
        (("f_u",), [[float("nan")]], "covariance"),
        (("f_u", "f_v"), [[1, 0.1], [0.2, 1]], "covariance"),
        ("f_u", [[1.0]], "covariance_parameters"),
        (PARAMETERS, np.eye(41), "covariance"),
    ):
        with pytest.raises(ProfileError) as caught:
            make(covariance_parameters=parameters, covariance=covariance)
        assert caught.value.key == key
    given = np.eye(2)
    cam = make(covariance_parameters=["f_u", "f_v"], covariance=given)
    given[0, 0] = 7
    assert cam.covariance[0, 0] == 1 and not cam.covariance.flags.writeable


def test_stored_profiles_load():
    files = sorted((ROOT / "calib_profiles").glob("*.json"))
    assert files
    for file in files:
        assert pf.Camera.load(file).name


def test_published_equidistant_calibration_round_trips(real_data):
    """EuRoC cam0 as published by others."""
    file = real_data("profiles/adapter_euroc_KB.yml")
    values = dict(line.strip().split(":") for line in file.read_text().splitlines() if line.strip())
    value = {key: float(text) for key, text in values.items() if text.strip()}
    cam = pf.Camera(
        width=int(value["width"]),
        height=int(value["height"]),
        **{ours: value[theirs] for ours, theirs in (("f_u", "fx"), ("f_v", "fy"), ("c_u", "cx"), ("c_v", "cy"))},
        **{f"k{i + 1}": value[f"k{i}"] for i in range(1, 5)},
        theta_max=math.radians(55),
    )
    u, v = np.meshgrid(np.arange(0, cam.width, 5.0), np.arange(0, cam.height, 5.0))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, ok = cam.unproject(pixels)
    assert ok.mean() > 0.95
    assert np.abs(cam.project(rays[ok])[0] - pixels[ok]).max() <= 1e-9
