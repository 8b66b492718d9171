"""The simulated drive and its sensors: trajectories against closed forms, encoder, inclinometer and clock against
their stated statistics, and the scenarios that are shipped."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipefish.cli import main
from pipefish.errors import FormatError
from pipefish.simulate import Scene, scenarios, simulate, studio_scenarios
from pipefish.simulate_pictures import contact_sheet, picture

STEADY = {"wobble_m": 0, "wobble_rad": 0}


def small(**changes: object) -> dict:
    """A quick scene: 10 m of straight DN200, 100 frames at 20 a second, no wobble."""
    scene = {
        "diameter": 0.2,
        "pieces": [{"length": 10.0}],
        "lens": {"width": 320, "height": 240},
        "motion": {"frames": 100} | STEADY,
        "telemetry": {},
    }
    return scene | {k: scene.get(k, {}) | v if isinstance(v, dict) else v for k, v in changes.items()}


def poses(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Rotations world_from_cam (N, 3, 3) and centres (N, 3) of all frames."""
    pose = np.array([scene.pose(k) for k in range(scene.frames)])
    rotation = pose[:, :, :3].transpose(0, 2, 1)
    return rotation, -np.einsum("nij,nj->ni", rotation, pose[:, :, 3])


def readings(scene: Scene) -> np.ndarray:
    """time_ns, encoder_count, roll, pitch of all frames, (N, 4)."""
    return np.array([scene.telemetry(k) for k in range(scene.frames)])


def test_a_schedule_is_its_integral_with_stops_and_reversing() -> None:
    schedule = [{"time": t, "speed": v} for t, v in ((0, 0), (1, 0.4), (2, 0.4), (2.5, 0), (3, 0), (4, -0.2))]
    scene = Scene(small(motion={"schedule": schedule}, telemetry={"encoder_slip": 0, "encoder_bias": 0}))
    # Trapezoids: 0.2 to 1 s, 0.6 to 2 s, 0.7 from 2.5 to 3 s, then backwards.
    expected = {20: 0.2, 40: 0.6, 50: 0.7, 60: 0.7, 80: 0.6, 99: 0.6 - 0.2 * 0.95}
    for frame, distance in expected.items():
        assert scene.arc_length(frame) - 0.3 == pytest.approx(distance, abs=1e-12)
        assert scene.driven(frame) == pytest.approx(distance, abs=1e-12)
        assert abs(scene.telemetry(frame)[1] * 0.0005 - distance) <= 0.0005
    assert np.array_equal(scene.pose(50), scene.pose(60))


def test_wheels_on_a_bump_pitch_and_lift_the_camera() -> None:
    bump = {"s": 0.5, "length": 0.06, "height": 0.004}
    step = {"s": 0.9, "length": 0.01, "step": 0.002}
    body = {"wheelbase": 0.25, "camera_ahead": 0.1}
    motion = {"speed": 0.2, "ramp": 0, "start": 0.2, "frame_rate": 100, "frames": 800, "bumps": [bump, step]} | body
    scene = Scene(small(motion=motion))
    for frame in range(0, 800, 7):
        s = 0.2 + 0.2 * frame / 100

        def floor(at: float) -> float:
            u = (at - 0.5) / 0.06
            height = 0.002 * (1 + math.cos(2 * math.pi * u)) if abs(u) < 0.5 else 0.0
            v = min(max((at - 0.9) / 0.01 + 0.5, 0), 1)
            return height + 0.002 * v**3 * (10 - 15 * v + 6 * v * v)

        front, rear = floor(s - 0.1), floor(s - 0.35)
        assert scene.attitude(frame)[1] == pytest.approx(math.atan((front - rear) / 0.25), abs=1e-12)
        up = front + (front - rear) * 0.1 / 0.25
        assert scene.centre(frame) == pytest.approx([0, 0.012 - up, s], abs=1e-12)
    pitches = np.array([scene.attitude(k)[1] for k in range(800)])
    assert pitches.max() == pytest.approx(math.atan(0.004 / 0.25), rel=0.01)  # front wheels on top
    assert pitches.min() == pytest.approx(-math.atan(0.004 / 0.25), rel=0.01)  # rear wheels on top


def test_a_pan_tilt_head_turns_about_its_pivot() -> None:
    head = [{"time": 1, "pan": 0, "tilt": 0}, {"time": 2, "pan": 1.2, "tilt": 0}, {"time": 3, "pan": 1.2, "tilt": -0.5}]
    scene = Scene(small(motion={"speed": 0, "head": head, "head_arm": 0.05}))
    rotation, centre = poses(scene)
    assert np.abs(rotation[:21] - np.eye(3)).max() < 1e-12
    assert rotation[40][:, 2] == pytest.approx([math.sin(1.2), 0, math.cos(1.2)], abs=1e-12)  # right
    look = [math.cos(0.5) * math.sin(1.2), math.sin(0.5), math.cos(0.5) * math.cos(1.2)]  # and down
    assert rotation[60][:, 2] == pytest.approx(look, abs=1e-12)
    assert np.abs(rotation[60:] - rotation[60]).max() < 1e-12
    pivot = centre - 0.05 * rotation[:, :, 2]
    assert np.abs(pivot - [0, 0.012, 0.25]).max() < 1e-12
    middle = rotation[30][:, 2]
    assert math.atan2(middle[0], middle[2]) == pytest.approx(0.6, abs=1e-12)  # half way, half turned


def test_a_pushed_camera_sticks_and_catches_up() -> None:
    motion = {"speed": 0.1, "ramp": 0, "frames": 4000, "frame_rate": 100, "stick_slip_m": 0.05, "stick_share": 0.7}
    scene = Scene(small(motion=motion, telemetry={"cable": True, "encoder_slip": 0, "encoder_bias": 0}))
    s = np.array([scene.arc_length(k) for k in range(4000)])
    pushed = np.array([scene.pushed(k) for k in range(4000)])
    assert pushed == pytest.approx(0.1 * np.arange(4000) / 100, abs=1e-12)
    assert (np.diff(s) >= 0).all()
    assert np.abs(s - 0.3 - pushed).max() < 0.08
    assert abs(s[-1] - 0.3 - pushed[-1]) < 0.08
    # Stuck for 0.7 of the time, and standing still at both ends of a jump a little longer.
    assert 0.68 < np.mean(np.diff(s) < 1e-12) < 0.72
    counted = readings(scene)[:, 1] * 0.0005
    assert np.abs(counted - pushed).max() <= 0.0005  # the reel knows nothing of the camera's jerks


def test_roll_walks_at_random() -> None:
    ends = []
    for seed in range(80):
        scene = Scene(small(motion={"seed": seed, "ramp": 0, "speed": 0.4, "roll_walk": 0.2}))
        assert scene.attitude(0)[0] == pytest.approx(0, abs=1e-9)
        ends.append(scene.attitude(99)[0])
    expected = 0.2 * math.sqrt(0.4 * 99 / 20)
    assert np.mean(ends) == pytest.approx(0, abs=4 * expected / math.sqrt(80))
    assert np.std(ends) == pytest.approx(expected, rel=4 / math.sqrt(160))


def test_a_sliding_camera_climbs_the_sides_and_rolls_with_it() -> None:
    scene = Scene(small(motion={"below_axis": 0.06, "climb_rad": 0.8, "frames": 400, "speed": 0.4}))
    rotation, centre = poses(scene)
    assert np.hypot(centre[:, 0], centre[:, 1]) == pytest.approx(0.06, abs=1e-12)
    climb = np.arctan2(-centre[:, 0], centre[:, 1])
    assert climb.max() - climb.min() > 0.6
    # Its own down is the way out to the wall.
    assert rotation[:, :2, 1] == pytest.approx(np.column_stack([-np.sin(climb), np.cos(climb)]), abs=1e-12)


def test_a_drop_is_driven_straight_down() -> None:
    down = [{"length": 1.0}, {"angle": math.pi / 2, "radius": 0.4, "clock": math.pi}, {"length": 2.0}]
    scene = Scene(small(pieces=down, motion={"speed": 0.5, "frames": 130}))
    rotation, centre = poses(scene)
    assert rotation[-1][:, 2] == pytest.approx([0, 1, 0], abs=1e-9)
    assert np.diff(centre[-5:, 1]) == pytest.approx(0.5 / 20, abs=1e-9)
    assert scene.attitude(129)[1] == pytest.approx(-math.pi / 2, abs=1e-6)


def test_wobble_stays_within_its_stated_size() -> None:
    scene = Scene(small(motion={"wobble_m": 0.01, "wobble_rad": 0.05, "frames": 2000, "speed": 0.09}))
    rotation, centre = poses(scene)
    assert 0.006 < np.abs(centre[:, 0]).max() <= 0.01
    assert np.abs(centre[:, 1] - 0.012).max() <= 0.01 / 3
    assert 0.03 < np.abs(np.arcsin(rotation[:, 0, 2])).max() <= 0.05
    assert np.abs(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])).max() <= 0.11


def test_encoder_readings_have_quantisation_and_the_stated_noise() -> None:
    motion = {"frames": 3000, "frame_rate": 100, "ramp": 0}
    telemetry = {"encoder_slip": 0, "encoder_bias": 0.01, "encoder_noise": 2.0, "metres_per_count": 0.000137}
    scene = Scene(small(motion=motion, telemetry=telemetry))
    driven = np.array([scene.driven(k) for k in range(3000)])
    error = readings(scene)[:, 1] - driven * 1.01 / 0.000137
    assert error.mean() == pytest.approx(-0.5, abs=4 * math.sqrt(4 + 1 / 12) / math.sqrt(3000))
    assert error.var() == pytest.approx(4 + 1 / 12, rel=4 * math.sqrt(2 / 3000))
    exact = Scene(small(motion=motion, telemetry=telemetry | {"encoder_noise": 0}))
    error = readings(exact)[:, 1] - driven * 1.01 / 0.000137
    assert error.min() >= -1 and error.max() <= 0
    assert error.var() == pytest.approx(1 / 12, rel=0.1)


def test_sudden_slips_come_where_stated_and_as_often_as_stated() -> None:
    exact = {"encoder_slip": 0, "encoder_bias": 0}
    stated = [{"at": 0.5, "metres": 0.02}, {"at": 0.8, "metres": -0.005}]
    scene = Scene(small(motion={"ramp": 0, "speed": 0.2, "frames": 100}, telemetry=exact | {"slips": stated}))
    driven = np.array([scene.driven(k) for k in range(100)])
    extra = readings(scene)[:, 1] * 0.0005 - driven
    expected = 0.02 * (driven >= 0.5) - 0.005 * (driven >= 0.8)
    assert np.abs(extra - expected).max() <= 0.0005 + 1e-12
    ends = []
    for seed in range(100):
        random = exact | {"slip_rate": 3, "slip_m": 0.01, "seed": seed}
        fast = Scene(small(motion={"speed": 2, "ramp": 0, "frames": 80}, telemetry=random))
        ends.append(fast.telemetry(79)[1] * 0.0005 - fast.driven(79))
    # Compound Poisson: rate L mean, rate L (mean^2 + width^2 / 12).
    length = 2 * 79 / 20
    sigma = math.sqrt(3 * length * (0.01**2 + 0.01**2 / 12))
    assert np.mean(ends) == pytest.approx(3 * length * 0.01, abs=4 * sigma / 10)
    assert np.std(ends) == pytest.approx(sigma, rel=4 / math.sqrt(200))


def test_inclinometer_has_the_stated_bias_and_noise() -> None:
    telemetry = {"attitude_sigma": 0.01, "roll_bias": 0.02, "pitch_bias": -0.03}
    scene = Scene(small(motion={"frames": 3000, "frame_rate": 100, "wobble_rad": 0.02}, telemetry=telemetry))
    true = np.array([scene.attitude(k) for k in range(3000)])
    error = readings(scene)[:, 2:] - true
    assert error.mean(axis=0) == pytest.approx([0.02, -0.03], abs=4 * 0.01 / math.sqrt(3000))
    assert error.std(axis=0) == pytest.approx([0.01, 0.01], rel=4 / math.sqrt(6000))
    assert abs(np.corrcoef(error.T)[0, 1]) < 4 / math.sqrt(3000)
    assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 4 / math.sqrt(3000)


def test_time_stamps_jitter_as_stated_and_increase() -> None:
    scene = Scene(small(motion={"frames": 3000, "frame_rate": 100}, telemetry={"time_jitter_s": 0.001}))
    time = readings(scene)[:, 0]
    assert (np.diff(time) > 0).all()
    assert time[0] >= 0
    error = time[1:] * 1e-9 - np.arange(1, 3000) / 100
    assert error.std() == pytest.approx(0.001, rel=4 / math.sqrt(6000))
    wild = Scene(small(motion={"frames": 300, "frame_rate": 100}, telemetry={"time_jitter_s": 0.1}))
    assert (np.diff(readings(wild)[:, 0]) > 0).all()


def test_dropped_frames_are_gaps_of_the_recording(tmp_path: Path) -> None:
    scene = small(motion={"frames": 60}, telemetry={"drop_rate": 0.05, "drop_longest": 3, "seed": 4})
    scene["lens"] = {"width": 64, "height": 64}
    done = simulate(scene, tmp_path / "a", quiet=True)
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    rows = (tmp_path / "a.csv").read_text().splitlines()[1:]
    arrived = [int(row.split(",")[0]) for row in rows]
    assert truth["dropped"]
    assert sorted(arrived + truth["dropped"]) == list(range(60))
    assert done["frames"] == len(arrived)
    assert len(truth["poses"]) == 60
    assert (tmp_path / "a.y4m").stat().st_size == len(b"YUV4MPEG2 W64 H64 F20:1 Ip A1:1 Cmono\n") + len(rows) * (
        6 + 64 * 64
    )
    frame = (tmp_path / "a.y4m").read_bytes()[-64 * 64 :]
    assert np.array_equal(np.frombuffer(frame, np.uint8).reshape(64, 64), Scene(scene).render(arrived[-1]))
    long = Scene(small(motion={"frames": 6000, "frame_rate": 100, "speed": 0.1}, telemetry={"drop_rate": 0.02}))
    lost = sum(long.dropped(k) for k in range(6000))
    assert not long.dropped(0)
    assert lost == pytest.approx(120, abs=4 * math.sqrt(120))


def test_flow_is_that_of_the_wall_and_knows_what_is_hidden() -> None:
    scene = Scene(small(pieces=[{"length": 1.0}, {"angle": 1.5, "radius": 0.3}, {"length": 3}], motion={"start": 0.6}))
    pixels = np.array([[150.0, 60.0], [100, 120], [200, 150]])
    moved, ok = scene.flow(10, 14, pixels)
    assert ok.all()
    assert 0.5 < np.linalg.norm(moved - pixels, axis=1).max() < 30
    back, _ = scene.flow(14, 10, moved)
    assert np.abs(back - pixels).max() < 1e-7
    # From the bend's end, what its beginning cannot see although it is in its field: the straight way to it runs
    # through the wall.
    rows, columns = np.mgrid[10:230:8, 10:310:8].reshape(2, -1)
    pixels = np.column_stack([columns, rows]).astype(float)
    there, lit = scene.cast(60, pixels)
    _, seen = scene.project(0, there)
    hidden = lit & seen & ~scene.flow(60, 0, pixels)[1]
    assert hidden.sum() > 50
    for point in there[hidden][::10]:
        way = scene.centre(0) + np.linspace(0, 1, 200)[:, None] * (point - scene.centre(0))
        assert not np.nanmax(np.nan_to_num(scene.locate(way)[:, 1], nan=1)) < 0.1


def test_truth_says_what_the_sensors_should_have_said(tmp_path: Path) -> None:
    scene = small(motion={"frames": 30, "wobble_rad": 0.05, "stick_slip_m": 0.03})
    scene["lens"] = {"width": 64, "height": 64}
    simulate(scene, tmp_path / "a", quiet=True)
    truth, made = json.loads((tmp_path / "a.truth.json").read_text()), Scene(scene)
    table = dict(zip(truth["pose_columns"], np.array(truth["poses"]).T, strict=True))
    assert table["time_s"] == pytest.approx(np.arange(30) / 20, abs=1e-12)
    for name, value in (("driven", made.driven), ("pushed", made.pushed), ("s", made.arc_length)):
        assert table[name] == pytest.approx([value(k) for k in range(30)], abs=1e-11)
    assert np.column_stack([table["roll"], table["pitch"]]) == pytest.approx(
        np.array([made.attitude(k) for k in range(30)]), abs=1e-11
    )
    assert truth["rows"]["line_time_s"] == 0
    again = Scene.from_truth(tmp_path / "a.truth.json")
    assert np.array_equal(again.pose(17), made.pose(17))


def test_everything_random_follows_the_seed() -> None:
    motion = {"wobble_rad": 0.02, "stick_slip_m": 0.03, "roll_walk": 0.1}
    telemetry = {"drop_rate": 0.1, "slip_rate": 1, "time_jitter_s": 1e-3, "encoder_noise": 1}
    first, again = (Scene(small(motion=motion, telemetry=telemetry)) for _ in range(2))
    other = Scene(small(motion=motion | {"seed": 2}, telemetry=telemetry | {"seed": 2}))
    assert np.array_equal(readings(first), readings(again))
    assert np.array_equal(poses(first)[0], poses(again)[0])
    assert not np.array_equal(readings(first)[:, 0], readings(other)[:, 0])
    assert not np.array_equal(poses(first)[0], poses(other)[0])


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"motion": {"schedule": [{"time": 1}, {"time": 1}]}}, r"motion.schedule\[1\].time: must be later"),
        ({"motion": {"head": [{"time": 1}, {"time": 0}]}}, r"motion.head\[1\].time: must be later"),
        ({"motion": {"head": [{"yaw": 1}]}}, r"motion.head\[0\].yaw: unknown; known are time, pan, tilt"),
        ({"motion": {"bumps": [{"height": 0.09}]}}, "motion.below_axis: the camera would leave"),
        ({"motion": {"schedule": [{"speed": -1}]}}, "motion: the camera would drive out"),
        ({"telemetry": {"cable": 1}}, "telemetry.cable: must be true or false"),
        ({"telemetry": {"drop_longest": 0}}, "telemetry.drop_longest: must be within"),
        ({"telemetry": {"slips": [{"metres": "x"}]}}, r"telemetry.slips\[0\].metres: must be a number"),
        ({"motion": {"encoder_slip": 0}}, "motion.encoder_slip: unknown"),
        ({"water": [{"depth": 0.001}, {"depth": 0.15}]}, r"water\[1\]: at frame 0 the camera would be under it"),
        (
            {"deposits": [{"s": 0.5, "height": 0.07, "extent": 3.0}], "motion": {"below_axis": 0.04}},
            r"(motion|lamp): at frame \d+ .* would be in the wall",
        ),
        (
            {"lamp": {"ring_radius": 0.05}, "motion": {"below_axis": 0.07, "wobble_m": 0, "wobble_rad": 0}},
            r"lamp: at frame 0 lamp \d would be in the wall",
        ),
    ],
)
def test_a_bad_drive_is_refused_with_the_key(change: dict, where: str) -> None:
    with pytest.raises(FormatError, match=where):
        Scene(small(**change))


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("pieces = [", r"scene\.toml: (end of document|1:\d+): "),
        ("a = 1\nb ? 2\n", r"scene\.toml: 2:3: "),
        ("pieces = [{ length = 1 }]\nabout = 3\n", r"scene\.toml: about: must be text"),
        ("pieces = [{ length = 1 }]\n[motion]\nspeed = 'x'\n", r"scene\.toml: motion\.speed: must be a number"),
        ("pieces = [{ length = 1 }]\n[lens]\nprofile = 'none.json'\n", r"none\.json"),
    ],
)
def test_a_bad_scenario_is_refused_with_file_and_place(tmp_path: Path, text: str, where: str) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(text)
    with pytest.raises((FormatError, OSError), match=where):
        simulate(file, tmp_path / "out", quiet=True)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.toml"]


def test_toml_and_json_say_the_same(tmp_path: Path) -> None:
    scene = {"diameter": 0.25, "pieces": [{"length": 2}], "motion": {"frames": 3}}
    (tmp_path / "a.json").write_text(json.dumps(scene))
    (tmp_path / "a.toml").write_text("diameter = 0.25\npieces = [{ length = 2 }]\nmotion.frames = 3\n")
    assert Scene.load(tmp_path / "a.json").spec == Scene.load(tmp_path / "a.toml").spec == Scene(scene).spec


def test_every_scenario_is_valid_and_says_what_it_is() -> None:
    known = scenarios()
    assert {"demo", "straight", "tiny"} < set(known)
    assert len(known) >= 12
    for name, about in known.items():
        assert 20 < len(about) < 120, name
        assert Scene.load(name).frames > 0


def test_every_scenario_is_in_the_documents_with_a_small_picture() -> None:
    docs = Path(__file__).resolve().parents[2] / "docs"
    page = (docs / "scenarios.md").read_text()
    for name, about in {**scenarios(), **studio_scenarios()}.items():
        assert f"## {name}\n" in page, name
        assert about in " ".join(page.split()), name
        assert f"(scenarios/{name}.jpg)" in page, name
        assert 1000 < (docs / "scenarios" / f"{name}.jpg").stat().st_size < 40000, name


def test_pictures_are_small_and_whole(tmp_path: Path) -> None:
    picture("tiny", tmp_path / "tiny.jpg", 3)
    assert (tmp_path / "tiny.jpg").read_bytes()[:2] == b"\xff\xd8"
    contact_sheet(tmp_path / "sheet.png", ["tiny", "tiny"], quiet=True)
    assert (tmp_path / "sheet.png").read_bytes()[1:4] == b"PNG"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sheet.png", "tiny.jpg"]


def test_the_command_lists_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {**scenarios(), **studio_scenarios()}
    assert main(["simulate", "tiny", "--picture", str(tmp_path / "a.bmpx")]) == 1
    assert "pictures end in" in capsys.readouterr().err
    assert main(["simulate", "tiny", "--picture", str(tmp_path / "a.png"), "--frame", "99"]) == 1
    assert "there is no frame 99" in capsys.readouterr().err
    assert main(["simulate", "tiny", "--picture", str(tmp_path / "a.png"), "--set", "diameter"]) == 2
    assert main(["simulate", "tiny", "--picture", str(tmp_path / "a.png"), "--set", "diametre=0.1"]) == 1
    assert "diametre" in capsys.readouterr().err
    assert main(["simulate", "tiny", "--picture", str(tmp_path / "a.png"), "--set", "diameter.d=0.1"]) == 1
    assert "diameter" in capsys.readouterr().err
    assert main(["simulate", "tiny", "-o", str(tmp_path / "a"), "--set", "lens.widht=3"]) == 1
    assert capsys.readouterr().err.startswith("pipefish: lens.widht: unknown")  # no file is to blame
    assert main(["simulate", "two-views", "-o", str(tmp_path / "a"), "--set", "layer=3"]) == 1
    assert "layer: unknown" in capsys.readouterr().err
    assert main(["simulate", "-o", str(tmp_path / "a")]) == 2
    assert main(["simulate", "tiny", "-o", str(tmp_path / "a"), "--width", "3"]) == 2
    assert main(["simulate", "tiny"]) == 2
    assert main(["simulate", "tiny", "--picture", str(tmp_path / "a.png"), "--seed", "3"]) == 2
    assert main(["simulate", "tiny", "-o", str(tmp_path / "a"), "--frame", "3"]) == 2
    assert not list(tmp_path.iterdir())


def test_a_picture_is_as_wide_as_asked_and_set_reaches_scenes_that_are_no_pipes(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    small = ["--set", "lens.width=200", "--set", "lens.height=150", "--set", "samples=34"]
    assert main(["simulate", "two-views", "--picture", str(file), *small]) == 0
    assert Image.open(file).size == (400, 150)
    assert main(["simulate", "tiny", "--picture", str(file), "--width", "100"]) == 0
    assert Image.open(file).size == (100, 75)
    assert main(["simulate", "tiny", "--picture", str(file), "--width", "1000"]) == 0
    assert Image.open(file).size == (320, 240)


def test_a_lens_profile_can_be_put_in(tmp_path: Path) -> None:
    simulate("tiny", tmp_path / "a", frames=1, quiet=True)
    profile = tmp_path / "a.profile.json"
    command = ["simulate", "straight", "--picture", str(tmp_path / "b.png"), "--set", f"lens.profile={profile}"]
    assert main(command) == 0
    assert Image.open(tmp_path / "b.png").size == (320, 240)


def test_set_changes_the_scene_before_it_is_checked(tmp_path: Path) -> None:
    # Twice as fast, tiny would drive out of its pipe but for the fewer frames.
    changes = ["diameter=0.15", "motion.speed=2", "texture.material=pvc", "lamp.ring_radius=0.01"]
    command = ["simulate", "tiny", "-o", str(tmp_path / "a"), "--frames", "2", "--seed", "7"]
    for change in changes:
        command += ["--set", change]
    assert main(command) == 0
    spec = Scene.from_truth(tmp_path / "a.truth.json").spec
    assert (spec["diameter"], spec["motion"]["speed"], spec["motion"]["frames"]) == (0.15, 2, 2)
    assert (spec["texture"]["material"], spec["texture"]["seed"], spec["telemetry"]["seed"]) == ("pvc", 7, 7)
