"""The simulated camera: its lens inverts itself and is what it is said to be; shutter, noise, bits and blur follow
their stated laws."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipefish.camera import Camera
from pipefish.errors import FormatError
from pipefish.simulate import Scene, simulate, with_profile

PRESETS = ["fisheye-185", "fisheye-220", "wide-120", "narrow-60", "hyperbolic", "equiangular"]
QUIET = {"read_noise": 0, "shot_noise": 0}
PLAIN = {"contrast": 0, "joint_spacing": 0}


def merged(scene: dict, changes: dict) -> dict:
    """A scene with some keys of its parts changed."""
    return scene | {k: scene.get(k, {}) | v if isinstance(v, dict) else v for k, v in changes.items()}


def small(**changes: object) -> dict:
    """A quick scene: 320 x 240, 2 m of straight DN200."""
    scene = {
        "diameter": 0.2,
        "pieces": [{"length": 2.0}],
        "lens": {"width": 320, "height": 240, "circle_radius": 118, "c_u": 158.3, "c_v": 121.1},
        "motion": {"frames": 61},
    }
    return merged(scene, changes)


def clear(**changes: object) -> dict:
    """A scene for measuring on pictures: an even wall, no noise, 10 bits, wide light, no vignetting."""
    scene = small(
        texture=PLAIN,
        sensor=QUIET | {"bits": 10},
        lamp={"side": 1, "forward": 2, "exposure": 170, "bounce": 0},
        lens={"width": 640, "height": 480, "circle_radius": 236, "c_u": 319.3, "c_v": 240.1, "vignetting": 0},
    )
    return merged(scene, changes)


def pixels_in_circle(scene: Scene, count: int) -> np.ndarray:
    """Random pixels inside the image circle, up to its rim."""
    rng = np.random.default_rng(2)
    radius = scene.circle_radius * np.sqrt(rng.uniform(0.001, 0.995, count))
    angle = rng.uniform(0, 2 * np.pi, count)
    spec = scene.spec["lens"]
    return np.column_stack([spec["c_u"] + radius * np.cos(angle), spec["c_v"] + radius * np.sin(angle)])


def in_camera(scene: Scene, frame: int, points: np.ndarray, row: float | None = None) -> np.ndarray:
    """World points from points in the camera's frame."""
    pose = scene.pose(frame, row)
    return (points - pose[:, 3]) @ pose[:, :3]


def on_cone(theta: np.ndarray, phi: np.ndarray, pupil: np.ndarray, distance: float = 0.1) -> np.ndarray:
    """Points in the camera's frame on rays of these angles."""
    ray = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    return distance * ray + np.column_stack([np.zeros_like(theta), np.zeros_like(theta), pupil])


def marker_moments(scene: dict, marker: dict, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Centroid (2,) and covariance (2, 2) of the share of the pixels that a marker covers, whatever the light does."""
    bare = Scene(scene).render(frame).astype(float)
    change = Scene(scene | {"markers": [marker]}).render(frame) - bare
    rows, columns = np.nonzero(change > 2)  # rounding differs by less than 2
    rows, columns = np.mgrid[rows.min() - 5 : rows.max() + 6, columns.min() - 5 : columns.max() + 6].reshape(2, -1)
    change /= np.maximum(bare, 1)
    weight, at = change[rows, columns], np.column_stack([columns, rows])
    centre = weight @ at / weight.sum()
    return centre, ((at - centre).T * weight) @ (at - centre) / weight.sum()


@pytest.mark.parametrize("preset", PRESETS)
def test_cast_and_project_are_inverse_for_every_preset(preset: str) -> None:
    lens = {"preset": preset, "asymmetry": [{"harmonic": k, "radial_px": 3, "tangential_px": -2} for k in (1, 2, 3)]}
    scene = Scene({"diameter": 0.3, "pieces": [{"length": 2.0}], "lens": lens, "motion": {"frames": 1}})
    pixels = np.random.default_rng(4).uniform(0, [1279, 799], (4000, 2))
    points, ok = scene.cast(0, pixels)
    assert 0.2 < ok.mean() <= 1
    back, seen = scene.project(0, points[ok])
    assert seen.all()
    assert np.abs(back - pixels[ok]).max() < 1e-9
    lens = scene.spec["lens"]
    theta = np.arctan2(
        np.hypot(*(local := points[ok] @ scene.pose(0)[:, :3].T + scene.pose(0)[:, 3]).T[:2]), local[:, 2]
    )
    assert theta.max() <= lens["theta_max"] + 0.05  # seen from the centre, not from the pupil
    assert (~ok).any() or preset in ("wide-120", "narrow-60")


def test_asymmetry_has_the_stated_harmonics() -> None:
    asymmetry = [
        {"harmonic": 1, "radial_px": 0.3, "tangential_px": 0.1, "phase": 0.7},
        {"harmonic": 2, "radial_px": 0.12, "tangential_px": 0.2, "phase": 1.9},
        {"harmonic": 3, "radial_px": 0.08, "tangential_px": 0.05, "phase": 4.1},
    ]
    scene = Scene(small(lens={"asymmetry": asymmetry}))
    spec, nodes = scene.spec["lens"], scene.lens()
    for share in (0.5, 0.98):
        theta = np.full(64, share * spec["theta_max"])
        phi = np.arange(64) * 2 * np.pi / 64
        radius, pupil = np.array([scene._scene.lens(t) for t in theta]).T
        pixels, ok = scene.project(3, in_camera(scene, 3, on_cone(theta, phi, pupil)))
        assert ok.all()
        offset = (pixels - [spec["c_u"], spec["c_v"]]) @ [1, 1j] * np.exp(-1j * phi) - radius
        for h in asymmetry:
            size = share ** (h["harmonic"] + 1)
            for part, wave, name in ((offset.real, np.cos, "radial_px"), (offset.imag, np.sin, "tangential_px")):
                basis = wave(h["harmonic"] * phi - h["phase"])
                assert 2 * np.mean(part * basis) == pytest.approx(size * h[name], abs=1e-9)
        assert np.abs(offset).max() > 0.02
    assert len(nodes["theta"]) > 100


def test_default_lens_has_a_third_harmonic() -> None:
    # p23 has two harmonics, cpoly stops at the third power: a third harmonic that grows with the fourth is in neither.
    assert any(h["harmonic"] == 3 and h["radial_px"] > 0.02 for h in Scene(small()).spec["lens"]["asymmetry"])


def test_a_profile_as_lens_is_that_profile_to_another_implementation(tmp_path: Path) -> None:
    camera = Camera(
        width=320, height=240, f_u=71.3, f_v=70.9, skew=0.02, c_u=158.9, c_v=121.4, k2=0.013, k3=-0.006, k4=0.0011,
        k5=-0.0001, theta_max=1.6, circle_u=158.9, circle_v=121.4, circle_radius=112,
    )  # fmt: skip
    camera.save(tmp_path / "camera.json")
    (tmp_path / "scene.toml").write_text(
        'diameter = 0.2\npieces = [{ length = 1 }]\nmotion = { frames = 5 }\nlens = { profile = "camera.json" }\n'
    )
    scene = Scene.load(tmp_path / "scene.toml")
    simulate(tmp_path / "scene.toml", tmp_path / "a", frames=1, quiet=True)
    again = Camera.load(tmp_path / "a.profile.json")
    assert [getattr(again, k) for k in ("f_u", "skew", "c_v", "k5")] == [71.3, 0.02, 121.4, -0.0001]
    rng = np.random.default_rng(1)
    theta, phi = rng.uniform(0.001, 1.59, 3000), rng.uniform(0, 2 * np.pi, 3000)
    local = on_cone(theta, phi, 0 * theta)
    pixels, ok = scene.project(2, in_camera(scene, 2, local))
    expected, valid = camera.project(local)
    assert valid.all()
    assert ok.mean() > 0.95
    assert np.abs(pixels - expected)[ok].max() < 1e-9
    points, hit = scene.cast(2, pixels[ok])
    back, _ = scene.project(2, points)
    assert hit.all()
    assert np.abs(back - pixels[ok]).max() < 1e-9


def test_a_profile_with_every_term_is_the_formula_of_the_documents() -> None:
    rng = np.random.default_rng(7)
    k, e1 = [0.02, -0.008, 0.001, -0.0001], 0.0012
    a_r, a_t, cpoly = rng.normal(0, 2e-3, 3), rng.normal(0, 2e-3, 3), rng.normal(0, 1e-3, 14)
    b_r, b_t = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 4)))
    profile = {
        **{"f_u": 240.0, "f_v": 238.0, "skew": 0.3, "pupil_e1": e1, "cpoly": cpoly.tolist()},
        **dict(zip(("k2", "k3", "k4", "k5"), k, strict=True)),
        **{"asym_radial_theta": a_r.tolist(), "asym_radial_phi": b_r.tolist()},
        **{"asym_tangential_theta": a_t.tolist(), "asym_tangential_phi": b_t.tolist()},
    }
    lens = {"width": 1280, "height": 800, "c_u": 640.0, "c_v": 400.0, "theta_max": 1.6, "profile": profile}
    scene = Scene({"diameter": 0.2, "pieces": [{"length": 1.0}], "motion": {"frames": 1}, "lens": lens})
    theta, phi = rng.uniform(1e-4, 1.59, 2000), rng.uniform(0, 2 * np.pi, 2000)
    odd = np.stack([theta, theta**3, theta**5])
    waves = np.stack([np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)])
    radius = theta + k @ np.stack([theta**3, theta**5, theta**7, theta**9])
    x = (radius + (a_r @ odd) * (b_r @ waves) + 1j * (a_t @ odd) * (b_t @ waves)) * np.exp(1j * phi)
    z = theta * np.exp(1j * phi)
    terms = [z.conj(), z**2, z * z.conj(), z.conj() ** 2, z**3, z * z.conj() ** 2, z.conj() ** 3]
    x = x + (cpoly[::2] + 1j * cpoly[1::2]) @ np.stack(terms)
    expected = np.column_stack([240 * x.real + 0.3 * x.imag + 640, 238 * x.imag + 400])
    inside = (expected > 0).all(axis=1) & (expected < [1279, 799]).all(axis=1)
    pixels, ok = scene.project(0, in_camera(scene, 0, on_cone(theta, phi, e1 * theta**2)))
    assert ok[inside].all()
    assert np.abs(pixels - expected)[inside].max() < 1e-9
    points, hit = scene.cast(0, expected[inside])
    back, _ = scene.project(0, points)
    assert hit.all()
    assert np.abs(back - expected[inside]).max() < 1e-9


@pytest.mark.parametrize(
    ("change", "lens", "where"),
    [
        ({"format": "other"}, {}, r"camera\.json: format: "),
        ({"radial": "unified"}, {}, r"camera\.json: radial: "),
        ({"tilt": [0.1, 0]}, {}, r"camera\.json: tilt: "),
        ({"k5": None}, {}, r"camera\.json: k5: missing"),
        ({}, {"c_u": 5}, r"lens\.c_u: the profile decides it"),
    ],
)
def test_a_profile_that_cannot_be_the_lens_is_refused(tmp_path: Path, change: dict, lens: dict, where: str) -> None:
    file = tmp_path / "camera.json"
    Camera(width=320, height=240, f_u=70, f_v=70, c_u=160, c_v=120, theta_max=1.5).save(file)
    data = {k: v for k, v in (json.loads(file.read_text()) | change).items() if v is not None or k not in change}
    file.write_text(json.dumps(data))
    with pytest.raises(FormatError, match=where):
        with_profile(lens, file)


def test_a_mirror_is_blind_in_its_centre() -> None:
    lens = {"preset": "hyperbolic", "width": 320, "height": 240}
    scene = Scene(
        {"diameter": 0.2, "pieces": [{"length": 2.0}], "lens": lens, "sensor": QUIET, "motion": {"frames": 1}}
    )
    spec = scene.spec["lens"]
    blind = scene._scene.lens(spec["theta_min"])[0]
    angle = np.linspace(0, 2 * np.pi, 50)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    assert not scene.cast(0, [spec["c_u"], spec["c_v"]] + (blind - 1) * ring)[1].any()
    assert scene.cast(0, [spec["c_u"], spec["c_v"]] + (blind + 1) * ring)[1].all()
    rows, columns = np.mgrid[0:240, 0:320]
    inside = np.hypot(columns - spec["c_u"], rows - spec["c_v"]) < blind - 4
    assert inside.sum() > 100
    assert scene.render(0)[inside].max() == 0


def test_blur_grows_to_the_rim_as_stated() -> None:
    # The covariance of a small disc's image with the rim's blur, less that without: share^4 rim^2 on both axes.
    for s, phi in ((0.37, 1.2), (0.345, 4.0)):
        marker = {"s": s, "phi": phi, "radius": 0.006}
        _, sharp = marker_moments(clear(lens={"rim_blur_px": 0}), marker, 10)
        centre, soft = marker_moments(clear(lens={"rim_blur_px": 1.5}), marker, 10)
        share = np.linalg.norm(centre - [319.3, 240.1]) / 236
        expected = 1.5**2 * share**4
        assert expected > 0.5
        # share changes across the disc by 3 %, its fourth power by 12 %, and what is cut off at 2 levels is 1 % more.
        assert np.diag(soft - sharp) == pytest.approx([expected, expected], rel=0.06)


def test_blur_of_the_whole_image_is_as_stated() -> None:
    marker = {"s": 0.42, "phi": 1.2, "radius": 0.006}
    _, sharp = marker_moments(clear(lens={"rim_blur_px": 0}, sensor={"blur_px": 0}), marker, 10)
    _, soft = marker_moments(clear(lens={"rim_blur_px": 0}, sensor={"blur_px": 1.2}), marker, 10)
    assert np.diag(soft - sharp) == pytest.approx([1.44, 1.44], rel=0.03)


def test_rows_of_a_rolling_shutter_see_the_camera_at_their_time() -> None:
    # Exposures one after the other without a pause: the last row of a frame comes with the next one's first, and both
    # with the frame between them of a camera twice as fast.
    motion = {"wobble_m": 0.01, "wobble_rad": 0.1, "frames": 41}
    rolling = Scene(small(motion=motion, sensor={"line_time_s": 1 / 20 / 239}))
    fast = Scene(small(motion=motion | {"frames": 81, "frame_rate": 40}))
    for frame in (1, 20, 39):
        assert rolling.time(frame, 239) == pytest.approx((frame + 0.5) / 20, abs=1e-12)
        assert np.abs(rolling.pose(frame, 239) - rolling.pose(frame + 1, 0)).max() < 1e-12
        assert np.abs(rolling.pose(frame, 239) - fast.pose(2 * frame + 1)).max() < 1e-12
        assert np.abs(rolling.pose(frame) - fast.pose(2 * frame)).max() < 1e-12
    pixels = pixels_in_circle(rolling, 1000)
    points, _ = rolling.cast(20, pixels)
    back, ok = rolling.project(20, points)
    assert ok.all()
    assert np.abs(back - pixels).max() < 1e-9
    still, _ = Scene(small(motion=motion)).cast(20, pixels)
    assert np.linalg.norm(still - points, axis=1).max() > 1e-3


def outline(scene: Scene, marker: dict, frame: int) -> np.ndarray:
    """The marker's edge in the picture, (N, 2) pixels."""
    turn, size = np.linspace(0, 2 * np.pi, 200, endpoint=False), marker["radius"]
    around = size / (scene.spec["diameter"] / 2)
    ring = [scene.wall(marker["s"] + size * math.cos(a), marker["phi"] + around * math.sin(a)) for a in turn]
    return scene.project(frame, np.array(ring))[0]


def area_and_centroid(polygon: np.ndarray) -> tuple[float, np.ndarray]:
    """Of the inside of the polygon (N, 2)."""
    (x, y), (x2, y2) = polygon.T, np.roll(polygon, -1, axis=0).T
    cross = x * y2 - x2 * y
    return cross.sum() / 2, np.array([((x + x2) * cross).sum(), ((y + y2) * cross).sum()]) / (3 * cross.sum())


def test_a_marker_is_drawn_where_its_rows_saw_it() -> None:
    rolling = clear(motion={"speed": 1.0, "ramp": 0, "frames": 20}, sensor={"line_time_s": 5e-5})
    still = merged(rolling, {"sensor": {"line_time_s": 0}})
    for s, phi in ((0.72, 0.2), (0.7, 3.4)):
        marker = {"s": s, "phi": phi, "radius": 0.006}
        seen, _ = marker_moments(rolling, marker, 6)
        truth = area_and_centroid(outline(Scene(rolling), marker, 6))[1]
        assert np.abs(seen - truth).max() < 0.02
        assert np.linalg.norm(truth - area_and_centroid(outline(Scene(still), marker, 6))[1]) > 0.3


def test_motion_blur_is_the_mean_over_the_exposure() -> None:
    # From 10 frames before to 10 after: the mean of the disc's centroids, each counting with the area it covers.
    moving = clear(motion={"speed": 0.1, "ramp": 0, "frame_rate": 600, "frames": 200}, lens={"rim_blur_px": 0})
    marker = {"s": 0.365, "phi": 3.3, "radius": 0.005}
    _, sharp = marker_moments(moving, marker, 150)
    seen, blurred = marker_moments(merged(moving, {"sensor": {"exposure_s": 20 / 600}}), marker, 150)
    scene = Scene(moving)
    areas, places = zip(*(area_and_centroid(outline(scene, marker, k)) for k in range(140, 161)), strict=True)
    weights = np.array(areas) * ([0.5] + 19 * [1] + [0.5])
    way = np.array(places)
    mean = weights @ way / weights.sum()
    length = np.linalg.norm(way[-1] - way[0])
    assert length > 2.5
    assert np.abs(seen - mean).max() < 0.01
    assert np.abs(seen - way[10]).max() < 0.03  # the middle of the exposure, but for the disc's growth
    # Steps of at most half a pixel lack their own variance, up to 0.5^2 / 12.
    spread = (way - mean).T * weights @ (way - mean) / weights.sum()
    along = (way[-1] - way[0]) / length
    assert along @ (blurred - sharp - spread) @ along == pytest.approx(-0.01, abs=0.03)
    across = np.array([-along[1], along[0]])
    assert across @ (blurred - sharp - spread) @ across == pytest.approx(0, abs=0.03)
    assert along @ spread @ along > 0.5


def test_a_blurred_picture_is_the_mean_of_sharp_ones() -> None:
    # 40 sharp pictures within an exposure in which the rim moves by 15 pixels, rolling shutter and all.
    motion = {"speed": 0.3, "ramp": 0, "frame_rate": 1000, "frames": 61, "wobble_rad": 0.1}
    scene = small(sensor=QUIET | {"bits": 10, "line_time_s": 1e-4}, motion=motion)
    blurred = Scene(merged(scene, {"sensor": {"exposure_s": 40 / 1000}})).render(30).astype(float)
    sharp = Scene(scene)
    weights = np.ones(41)
    weights[[0, -1]] = 0.5
    mean = np.average([sharp.render(10 + k) for k in range(41)], axis=0, weights=weights)
    single = np.abs(sharp.render(30) - mean)[mean > 40].mean()
    assert np.abs(blurred - mean)[mean > 40].mean() < 0.05 * single


def test_a_standing_camera_has_no_motion_blur() -> None:
    still = small(motion={"speed": 0}, sensor=QUIET)
    assert np.array_equal(Scene(still).render(3), Scene(merged(still, {"sensor": {"exposure_s": 0.02}})).render(3))


def test_fixed_pattern_stays_and_has_the_stated_size() -> None:
    scene = small(motion={"speed": 0}, sensor={"offset_pattern": 2.0, "gain_pattern": 0.03, "read_noise": 3.0})
    bare = Scene(merged(scene, {"sensor": QUIET | {"offset_pattern": 0, "gain_pattern": 0}})).render(0).astype(float)
    made = Scene(scene)
    frames = np.array([made.render(k) for k in range(40)], dtype=float)
    for low, high in ((25, 50), (60, 100), (100, 150)):
        where = (bare > low) & (bare < high)
        level = bare[where].mean()
        pattern = (frames.mean(axis=0) - bare)[where].var()
        noise = 9 + 0.025 * level + 1 / 12
        expected = 4 + 0.03**2 * np.mean(bare[where] ** 2) + noise / 40 + 1 / 12
        assert pattern == pytest.approx(expected, rel=4 * math.sqrt(2 / where.sum()) + 0.02)
        assert frames[:, where].var(axis=0, ddof=1).mean() == pytest.approx(noise, rel=0.03)


def test_hot_pixels_are_as_many_as_stated_and_stay() -> None:
    scene = Scene(small(sensor=QUIET | {"hot_pixels": 0.002}, motion={"speed": 0}))
    bare = Scene(small(sensor=QUIET, motion={"speed": 0})).render(0).astype(int)
    hot = scene.render(0).astype(int) - bare >= 19
    expected = 0.002 * 320 * 240
    assert abs(hot.sum() - expected) < 4 * math.sqrt(expected)
    assert np.array_equal(hot, scene.render(7).astype(int) - bare >= 19)


def test_ten_bits_are_four_times_as_fine() -> None:
    eight, ten = (Scene(small(sensor=QUIET | {"bits": bits})).render(3).astype(float) for bits in (8, 10))
    assert ten.max() > 400
    assert np.abs(ten / 4 - eight).max() <= 0.5 + 0.125
    assert (ten / 4 - eight)[eight > 20].std() == pytest.approx(math.sqrt((1 + 1 / 16) / 12 - 2 / 4 / 12 / 4), rel=0.1)


def test_compression_is_that_of_a_jpeg() -> None:
    clean, squeezed = (Scene(small(sensor={"jpeg_quality": q})).render(3) for q in (0, 40))
    file = io.BytesIO()
    Image.fromarray(clean).save(file, "JPEG", quality=40)
    peer = np.asarray(Image.open(file)).astype(int)
    assert np.abs(squeezed.astype(int) - clean).mean() > 1
    assert np.abs(squeezed.astype(int) - peer).max() <= 1  # decoders may round otherwise


def test_a_picture_does_not_depend_on_the_number_of_threads() -> None:
    scene = small(
        sensor={"exposure_s": 0.01, "line_time_s": 1e-4, "offset_pattern": 1, "jpeg_quality": 80, "hot_pixels": 1e-3},
        motion={"wobble_rad": 0.05, "stick_slip_m": 0.02, "roll_walk": 0.3},
    )
    one, three = Scene(scene), Scene(scene)
    for frame in (5, 31):
        assert np.array_equal(one.render(frame, 1), three.render(frame, 3))


def test_ten_bit_recording_is_mono10_and_little_endian(tmp_path: Path) -> None:
    scene = small(sensor={"bits": 10}, motion={"frames": 2})
    simulate(scene, tmp_path / "a", quiet=True)
    data = (tmp_path / "a.y4m").read_bytes()
    header = b"YUV4MPEG2 W320 H240 F20:1 Ip A1:1 Cmono10\n"
    assert data.startswith(header)
    assert len(data) == len(header) + 2 * (6 + 2 * 320 * 240)
    second = data[len(header) + 6 + 2 * 320 * 240 :][6:]
    assert np.array_equal(np.frombuffer(second, "<u2").reshape(240, 320), Scene(scene).render(1))


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"lens": {"preset": "wide"}}, "lens.preset: must be one of fisheye-185, fisheye-220"),
        ({"lens": {"asymmetry": [{"harmonic": 4}]}}, r"lens.asymmetry\[0\].harmonic: must be within"),
        ({"lens": {"asymmetry": [{"radial_px": 20, "harmonic": 3}] * 9}}, "lens: the lens's asymmetry folds"),
        ({"lens": {"theta_min": 1.2, "theta_max": 1.1}}, "lens.theta_min: must be below theta_max"),
        ({"lens": {"profile": {"f_u": 100}}}, "lens.profile: needs both"),
        ({"lens": {"profile": {"f_u": 100, "f_v": 100, "cpoly": [1]}}}, "lens.profile.cpoly: must be a list of 14"),
        ({"lens": {"profile": {"f_u": 100, "f_v": 100, "k2": -2}}}, "lens: a lens table's angles and radii must"),
        ({"lens": {"preset": "narrow-60", "theta_max": 1.2}}, "lens: theta_max must be below 60"),
        ({"sensor": {"bits": 9}}, "sensor.bits: must be 8 or 10"),
        ({"sensor": {"bits": 10, "jpeg_quality": 50}}, "sensor.jpeg_quality: JPEG has 8 bits"),
        ({"sensor": {"line_time_s": -1}}, "sensor.line_time_s: must be within"),
    ],
)
def test_a_bad_camera_is_refused_with_the_key(change: dict, where: str) -> None:
    with pytest.raises(FormatError, match=where):
        Scene(small(**change))
