"""The simulator: its truth agrees with itself and with its pictures; bad scenes are refused by name."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from pipefish.camera import Camera
from pipefish.errors import FormatError, PipefishError
from pipefish.simulate import Scene, fitted_camera, quaternion, scenarios, simulate


def small(**changes: object) -> dict:
    """A quick scene: 320 x 240, a bend and an oval stretch in 2 m of DN200."""
    scene = {
        "diameter": 0.2,
        "pieces": [{"length": 0.9}, {"angle": 0.5, "radius": 0.6, "clock": 2.0}, {"length": 1.0}],
        "ovals": [{"start": 1.2, "end": 1.9, "ramp": 0.2, "ovality": 0.05, "clock": 0.7}],
        "lens": {"width": 320, "height": 240, "circle_radius": 118, "c_u": 158.3, "c_v": 121.1},
        "motion": {"frames": 141},
    }
    return scene | changes


def pixels_in_circle(scene: Scene, count: int, seed: int) -> np.ndarray:
    """Random pixels inside the image circle."""
    rng = np.random.default_rng(seed)
    lens = scene.spec["lens"]
    radius = scene.circle_radius * np.sqrt(rng.uniform(0.001, 0.99, count))
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([lens["c_u"] + radius * np.cos(angle), lens["c_v"] + radius * np.sin(angle)])


@pytest.mark.parametrize("frame", [0, 60, 90, 140])
def test_cast_and_project_are_inverse_in_straight_bend_and_oval(frame: int) -> None:
    scene = Scene(small())
    pixels = pixels_in_circle(scene, 2000, frame)
    points, ok = scene.cast(frame, pixels)
    assert ok.all()
    back, seen = scene.project(frame, points)
    assert seen.all()
    assert np.abs(back - pixels).max() < 1e-6


@pytest.mark.parametrize("frame", [0, 60, 90, 140])
def test_cast_points_lie_on_the_wall_and_nothing_is_in_front(frame: int) -> None:
    scene = Scene(small())
    points, _ = scene.cast(frame, pixels_in_circle(scene, 500, frame))
    for s, rho, phi in scene.locate(points):
        d_max, d_min, clock = scene.section(s)
        ellipse = 1 / math.hypot(2 * math.cos(phi - clock) / d_max, 2 * math.sin(phi - clock) / d_min)
        assert abs(rho - ellipse) < 1e-7
    # Walk each ray from the camera: every place before the hit is inside the pipe. The pupil shift (1.5 mm) makes the
    # straight line from the centre a little different: its last per cent is left out.
    centre = scene.centre(frame)
    for share in np.linspace(0, 0.98, 50):
        s, rho, phi = scene.locate(centre + share * (points - centre)).T
        for a, r, p in zip(s, rho, phi, strict=True):
            d_max, d_min, clock = scene.section(a)
            assert r < 1 / math.hypot(2 * math.cos(p - clock) / d_max, 2 * math.sin(p - clock) / d_min) + 1e-4


def test_centreline_matches_closed_form_of_a_bend() -> None:
    scene = Scene(small())
    # Towards clock 2.0: right is +x, up is -y. After the bend of 0.5 rad with radius 0.6 that begins at z = 0.9.
    inward = np.array([math.sin(2.0), -math.cos(2.0), 0])
    end = np.array([0, 0, 0.9]) + 0.6 * ((1 - math.cos(0.5)) * inward + np.array([0, 0, math.sin(0.5)]))
    middle = (scene.wall(0.9 + 0.3, 0.4) + scene.wall(0.9 + 0.3, 0.4 + math.pi)) / 2
    assert np.abs(middle - end).max() < 1e-12
    assert abs(scene.length - (0.9 + 0.3 + 1.0)) < 1e-12
    beyond = (scene.wall(1.7, 0.4) + scene.wall(1.7, 0.4 + math.pi)) / 2
    tangent = math.sin(0.5) * inward + np.array([0, 0, math.cos(0.5)])
    assert np.abs(beyond - (end + 0.5 * tangent)).max() < 1e-12


def test_section_has_the_stated_ovality_where_it_is_stated() -> None:
    scene = Scene(small())
    assert scene.section(1.0)[:2] == (0.2, 0.2)
    d_max, d_min, clock = scene.section(1.55)
    assert (d_max - d_min) / ((d_max + d_min) / 2) == pytest.approx(0.05, abs=1e-12)
    assert clock == 0.7
    across = np.linalg.norm(scene.wall(1.55, 0.7) - scene.wall(1.55, 0.7 + math.pi))
    assert across == pytest.approx(d_max, abs=1e-12)


def test_pictures_agree_with_project() -> None:
    # White discs on the wall: the centroid of what they change in the picture, against the area centroid of their
    # projected outline. Change / picture without them is the covered share of a pixel, whatever the light does.
    places = [(0.62, 0.3), (0.66, 2.0), (0.7, 3.8), (0.64, 5.2)]
    base = small(
        texture={"contrast": 0, "joint_spacing": 0},
        lens={"width": 960, "height": 720, "circle_radius": 354, "c_u": 478.3, "c_v": 361.1, "vignetting": 0},
        sensor={"read_noise": 0, "shot_noise": 0},
        lamp={"side": 1, "forward": 2, "exposure": 400},
    )
    markers = [{"s": s, "phi": phi, "radius": 0.008} for s, phi in places]
    scene, frame = Scene(base | {"markers": markers}), 20
    without = Scene(base).render(frame).astype(float)
    covered = (scene.render(frame) - without) / np.maximum(without, 1)
    for s, phi in places:
        angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
        ring = [scene.wall(s + 0.008 * math.cos(a), phi + 0.008 * math.sin(a) / 0.1) for a in angle]
        outline, _ = scene.project(frame, np.array(ring))
        (x, y), (x2, y2) = outline.T, np.roll(outline, -1, axis=0).T
        cross = x * y2 - x2 * y
        truth = np.array([((x + x2) * cross).sum(), ((y + y2) * cross).sum()]) / (3 * cross.sum())
        u, v = np.round(truth).astype(int)
        reach = int(np.ceil(np.ptp(outline, axis=0).max() / 2)) + 4
        rows, columns = np.mgrid[v - reach : v + reach + 1, u - reach : u + reach + 1]
        weight = covered[rows, columns]
        seen = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        # Half a pixel of bias anywhere between wall and picture (texel centres, levels, pixels) would show ten times.
        assert np.abs(seen - truth).max() < 0.05, (s, phi)


def test_light_follows_the_closed_form_on_an_even_wall() -> None:
    # One lamp at the camera centre, a central lens, no optics' blur, no noise: exposure x intensity x cosine x albedo x
    # (radius / distance)^2 x vignetting, from the wall point and its normal alone.
    scene = Scene(
        small(
            pieces=[{"length": 3.0}],
            ovals=[],
            texture={"contrast": 0, "joint_spacing": 0},
            sensor={"read_noise": 0, "shot_noise": 0, "blur_px": 0},
            lamp={"lamps": 1, "ring_radius": 0, "side": 0.2, "forward": 0.9, "exposure": 400, "bounce": 0},
            lens=small()["lens"] | {"pupil_scale": 0, "vignetting": 0.3, "rim_blur_px": 0},
        )
    )
    image = scene.render(10)
    pixels = np.round(pixels_in_circle(scene, 500, 3))
    points, ok = scene.cast(10, pixels)
    local = points[ok] @ scene.pose(10)[:, :3].T + scene.pose(10)[:, 3]
    distance = np.linalg.norm(local, axis=1)
    cos_axis = local[:, 2] / distance
    inward = -points[ok] * [1, 1, 0] / 0.1
    cosine = np.sum(inward * (scene.centre(10) - points[ok]), axis=1) / distance
    intensity = 0.2 + 0.9 * np.maximum(cos_axis, 0) ** 2
    theta = np.arccos(cos_axis) / scene.spec["lens"]["theta_max"]
    expected = 400 * intensity * cosine * 0.45 * (0.1 / distance) ** 2 * (1 - 0.3 * theta**4)
    seen = image[pixels[ok, 1].astype(int), pixels[ok, 0].astype(int)]
    assert ok.sum() > 400
    assert np.abs(seen - expected).max() < 0.5 + 400 * 1.1 * 0.002  # rounding; the albedo is held to 1 / 255


def test_a_frame_does_not_depend_on_the_frames_drawn_before_it() -> None:
    # The surface is made around the camera and forgotten behind it: going on, jumping and coming back must not show.
    walker, other = Scene(small()), Scene(small())
    seen = {frame: walker.render(frame) for frame in (0, 60, 140, 61, 1)}
    for frame in (61, 0, 140):
        assert np.array_equal(other.render(frame), seen[frame]), frame


def test_texture_does_not_repeat_along_the_pipe() -> None:
    # The same picture a joint's spacing or any other distance further on would make odometry ambiguous.
    motion = {"frames": 250, "wobble_m": 0, "wobble_rad": 0}
    quiet = {"read_noise": 0, "shot_noise": 0}
    plain = {"joint_spacing": 0}  # joints do come back
    scene = Scene(small(pieces=[{"length": 4.0}], ovals=[], texture=plain, motion=motion, sensor=quiet))
    pictures = np.array([scene.render(frame) for frame in range(30, 250, 20)], dtype=float)  # every 0.2 m of 2 m
    mean = pictures.mean(axis=0)
    textures = np.diff(pictures[:, mean > 25] / mean[mean > 25])  # stains may be alike in neighbours, grains may not
    alike = np.corrcoef(textures) - np.eye(len(textures))
    assert textures.std() > 0.02
    assert np.abs(alike).max() < 0.3


def test_noise_has_the_stated_variance() -> None:
    quiet = Scene(small(sensor={"read_noise": 0, "shot_noise": 0})).render(3).astype(float)
    noisy = Scene(small(sensor={"read_noise": 3, "shot_noise": 0.2})).render(3).astype(float)
    for low, high in [(30, 60), (60, 100), (100, 160)]:
        where = (quiet >= low) & (quiet < high)
        level = quiet[where].mean()
        expected = 9 + 0.2 * level + 2 / 12  # both pictures are rounded
        variance = (noisy - quiet)[where].var()
        # The variance of n normal samples is known to sqrt(2 / n); four of these.
        assert variance == pytest.approx(expected, rel=4 * math.sqrt(2 / where.sum()) + 0.02)


def test_encoder_has_the_stated_bias_and_slip() -> None:
    ends = []
    for seed in range(60):
        scene = Scene(small(pieces=[{"length": 3.0}], ovals=[], motion={"frames": 200}, telemetry={"seed": seed}))
        driven = scene.arc_length(199) - scene.arc_length(0)
        ends.append(scene.telemetry(199)[1] * 0.0005 - driven)
    expected_bias, expected_sigma = 0.004 * driven - 0.00025, 0.00224 * math.sqrt(driven)
    assert np.mean(ends) == pytest.approx(expected_bias, abs=4 * expected_sigma / math.sqrt(60))
    assert np.std(ends) == pytest.approx(expected_sigma, rel=4 / math.sqrt(2 * 60))


def test_roll_and_pitch_are_those_of_the_pose() -> None:
    scene = Scene(small(motion={"frames": 30}, telemetry={"attitude_sigma": 0}))
    for frame in (0, 13, 29):
        down = scene.pose(frame)[:, :3] @ np.array([0, 1, 0])
        _, _, roll, pitch = scene.telemetry(frame)
        assert roll == pytest.approx(math.atan2(down[0], down[1]), abs=1e-12)
        assert pitch == pytest.approx(math.asin(-down[2]), abs=1e-12)


def test_lens_is_outside_the_model_family_but_close_to_it(tmp_path: Path) -> None:
    simulate("tiny", tmp_path / "t", frames=1, quiet=True)
    profile = json.loads((tmp_path / "t.profile.json").read_text())
    assert profile["source"] == "simulated"
    # A wave of 0.1 px that grows to the rim has an rms of 0.1 / sqrt(10) px; a polynomial follows little of it.
    alone = fitted_camera(Scene.load("tiny", {"lens.asymmetry": []})).rms_px
    assert 0.015 < alone < 0.035
    # Of the harmonic h, over the picture: (radial^2 + tangential^2) / 2 / (h + 2).
    lens = Scene.load("tiny").spec["lens"]["asymmetry"]
    waves = [(h["radial_px"] ** 2 + h["tangential_px"] ** 2) / 2 / (h["harmonic"] + 2) for h in lens]
    assert profile["rms_px"] == pytest.approx(math.sqrt(alone**2 + sum(waves)), rel=0.05)
    lens = Scene.load("demo").lens()
    theta, pupil = np.array(lens["theta"]), np.array(lens["pupil_m"])
    assert 0.002 < pupil[-1] < 0.004
    assert (np.diff(pupil) > 0).all()
    best = np.sum(pupil * theta**2) / np.sum(theta**4)  # the family's pupil_e1
    assert np.abs(pupil - best * theta**2).max() > 1e-4


def test_a_lens_from_a_table_is_that_table() -> None:
    table = [
        {"theta": t, "radius_px": 100 * math.sin(t / 2), "pupil_m": 0.002 * t * t} for t in np.linspace(0, 1.5, 31)
    ]
    scene = Scene(small(lens={"width": 320, "height": 240, "c_u": 160, "c_v": 120, "table": table}))
    assert scene.circle_radius == 100 * math.sin(0.75)
    for node in (3, 17, 29):
        theta = table[node]["theta"]
        point = np.array([math.sin(theta), 0, math.cos(theta)]) * 0.05 + [0, 0, table[node]["pupil_m"]]
        pose = scene.pose(5)
        pixel, ok = scene.project(5, (pose[:, :3].T @ (point - pose[:, 3]))[None])
        assert ok[0]
        assert np.abs(pixel[0] - [160 + table[node]["radius_px"], 120]).max() < 1e-6


def test_quaternion_is_the_rotation() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        w, x, y, z = q = (lambda v: v / np.linalg.norm(v))(rng.normal(size=4))
        matrix = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        assert min(np.abs(quaternion(matrix) - q).max(), np.abs(quaternion(matrix) + q).max()) < 1e-12


def test_simulate_writes_a_recording_that_says_what_the_scene_does(tmp_path: Path) -> None:
    done = simulate("tiny", tmp_path / "a", frames=5, quiet=True)
    assert done["frames"] == 5
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "a.profile.json", "a.truth.json", "a.y4m"]
    scene = Scene.from_truth(tmp_path / "a.truth.json")
    data = (tmp_path / "a.y4m").read_bytes()
    header = b"YUV4MPEG2 W320 H240 F20:1 Ip A1:1 Cmono\n"
    assert data.startswith(header)
    frame = data[len(header) :][2 * (6 + 320 * 240) :][6 : 6 + 320 * 240]
    assert np.array_equal(np.frombuffer(frame, np.uint8).reshape(240, 320), scene.render(2))
    rows = (tmp_path / "a.csv").read_text().splitlines()
    assert len(rows) == 6
    assert rows[3].startswith(f"2,{scene.telemetry(2)[0]},{scene.telemetry(2)[1]},")


def test_truth_of_another_simulator_is_refused(tmp_path: Path) -> None:
    simulate("tiny", tmp_path / "a", frames=3, quiet=True)
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    truth["poses"][2][5] += 1e-3
    (tmp_path / "a.truth.json").write_text(json.dumps(truth))
    with pytest.raises(FormatError, match=r"poses\[2\].*simulate anew"):
        Scene.from_truth(tmp_path / "a.truth.json")


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"widht": 3}, "widht: unknown; known are diameter"),
        ({"lens": {"focal": 3}}, "lens.focal: unknown"),
        ({"lens": {"width": 3.5}}, "lens.width: must be a whole number"),
        ({"lens": {"width": "wide"}}, "lens.width: must be a number"),
        ({"lens": 5}, r"lens: must be an object \{\.\.\.\}"),
        ({"joint_series": [{"spacing": 1}]}, r"joint_series: must be an object \{\.\.\.\}"),
        ({"diameter": -1}, "diameter: must be within"),
        ({"diameter": float("nan")}, "diameter: must be within"),
        ({"pieces": []}, "pieces: needs at least one"),
        ({"pieces": {}}, "pieces: must be a list"),
        ({"pieces": [{"length": 1}, {"angle": 1, "radius": 0.1}]}, r"pieces\[1\].radius: must be above"),
        ({"pieces": [{"radius": 1}]}, r"pieces\[0\]: a straight run needs a length"),
        ({"ovals": [{"start": 2, "end": 1}]}, r"ovals\[0\].end: must lie behind start"),
        ({"ovals": [{"start": 1, "end": 2, "ramp": 0.6}]}, r"ovals\[0\].ramp: must be at most half"),
        ({"ovals": [{"start": 0, "end": 1, "ovality": 0.3}] * 2}, r"ovals\[1\].ovality: all stretches"),
        ({"lamp": {"ring_radius": 0.06}}, "lamp.ring_radius: must be at most"),
        ({"lens": {"theta_max": 2.1}}, "lens: theta_max must be"),
        ({"lens": {"table": [{"theta": 0}]}}, "lens: a lens table needs at least 4"),
        ({"lens": {"table": [{"theta": 0.1 * i, "radius_px": 9 * i % 20} for i in range(5)]}}, "lens: .*must increase"),
        ({"motion": {"frames": 5000}}, "motion: the camera would drive out"),
        ({"motion": {"below_axis": 0.3}}, "motion.below_axis: the camera would leave"),
    ],
)
def test_a_bad_scene_is_refused_with_the_key(change: dict, where: str) -> None:
    with pytest.raises(FormatError, match=where):
        Scene(small(**change))


def test_a_bad_scene_file_is_refused_with_file_and_place(tmp_path: Path) -> None:
    file = tmp_path / "scene.json"
    file.write_text('{"pieces": [\n  {"length": }]}')
    with pytest.raises(FormatError, match=r"scene\.json: 2:14: "):
        Scene.load(file)
    file.write_text('{"pieces": [{"length": 2}], "lens": {"width": 1}}')
    with pytest.raises(FormatError, match=r"scene\.json: lens\.width: "):
        simulate(file, tmp_path / "out", quiet=True)
    with pytest.raises(PipefishError, match=r"demo.*straight.*tiny"):
        Scene.load("no-such-scene")
    assert [p.name for p in tmp_path.iterdir()] == ["scene.json"]


def test_a_scene_that_is_no_object_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "scene.json"
    file.write_text("[]")
    with pytest.raises(FormatError, match=r"scene\.json: a scene must be an object"):
        Scene.load(file)


def test_every_preset_is_a_valid_scene() -> None:
    for name in scenarios():
        assert Scene.load(name).frames > 0


def test_the_fitted_profile_sees_the_wall_where_the_lens_does(tmp_path: Path) -> None:
    even = {"diameter": 0.3, "pieces": [{"length": 2.0}], "motion": {"frames": 1}, "lens": {"asymmetry": []}}
    simulate(even, tmp_path / "s", quiet=True)
    scene, camera = Scene.from_truth(tmp_path / "s.truth.json"), Camera.load(tmp_path / "s.profile.json")
    points, ok = scene.cast(0, pixels_in_circle(scene, 2000, 1))
    pose = scene.pose(0)
    pixels, seen = camera.project(points[ok] @ pose[:, :3].T + pose[:, 3])
    truth, _ = scene.project(0, points[ok])
    error = np.linalg.norm(pixels - truth, axis=1)[seen]
    assert seen.mean() > 0.99
    # The camera rides 12 mm under the axis, so walls are 138 to 162 mm away, not 150: a pupil shift of 2.7 mm at the
    # rim is off by 2.7 x 12 / 150 / 150 rad there, 0.34 px at 235 px a radian.
    assert np.median(error) < 0.1
    assert error.max() < 0.6
