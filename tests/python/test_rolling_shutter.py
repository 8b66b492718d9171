"""A rolling shutter inside the adjustment, on pixels of the simulator, whose rows are seen one after the other."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import pipefish as pf
from pipefish import _engine
from pipefish.rolling import shutter_of
from pipefish.simulate import Scene, with_profile
from tube_tracks import fisheye, rotation, similarity

LINE_TIME, RADIUS, EVERY = 3e-5, 0.15, 4


def poses(random: np.random.Generator, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Two poses (1,3,4) whose rotations differ by `turn` radians."""
    first, axis = rotation(random.normal(0, 1, 3)), random.normal(0, 1, 3)
    second = rotation(turn * axis / np.linalg.norm(axis)) @ first
    return tuple(np.column_stack([r, random.normal(0, 1, 3)])[None] for r in (first, second))


def between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """(3,4) at that share of the way: 1 s apart, seen `share` seconds after the first."""
    both, place = np.ascontiguousarray(np.concatenate([first, second])), np.zeros(1, np.int32)
    return _engine.row_poses(both, np.zeros(2, np.int32), np.arange(2.0), place, np.array([share]))[0]


def test_pose_between_two_moves_and_turns_evenly() -> None:
    random = np.random.default_rng(1)
    first, second = poses(random, 0.8)
    assert np.allclose(between(first, second, 0.0), first[0]) and np.allclose(between(first, second, 1.0), second[0])
    half, quarter = between(first, second, 0.5), between(first, second, 0.25)
    step = quarter[:, :3] @ first[0, :, :3].T
    assert np.allclose(step @ step @ first[0, :, :3], half[:, :3])
    centre = lambda p: -p[:, :3].T @ p[:, 3]  # noqa: E731
    assert np.allclose(centre(half), (centre(first[0]) + centre(second[0])) / 2)
    assert np.allclose(centre(between(first, second, -0.5)), 1.5 * centre(first[0]) - 0.5 * centre(second[0]))


@pytest.mark.parametrize("turn", [1e-9, 1e-3, 0.05, 2.0])
@pytest.mark.parametrize("share", [-0.3, 0.02, 0.7])
def test_derivatives_of_the_turn_between_are_those_of_differences(turn: float, share: float) -> None:
    random = np.random.default_rng(2)
    pair, h = poses(random, turn), 1e-6
    middle, *found = _engine.turn_between(*pair, share)
    for side in range(2):
        for axis in range(3):
            moved = []
            for sign in (h, -h):
                changed = [p.copy() for p in pair]
                changed[side][0, :, :3] = rotation(sign * np.eye(3)[axis]) @ changed[side][0, :, :3]
                w = _engine.turn_between(*changed, share)[0] @ middle.T
                moved.append(np.array([w[2, 1] - w[1, 2], w[0, 2] - w[2, 0], w[1, 0] - w[0, 1]]) / 2)
            assert np.allclose((moved[0] - moved[1]) / (2 * h), found[side][:, axis], atol=1e-8)


def drive(
    folder: Path, seed: int, noise: float, motion: dict[str, float]
) -> tuple[pf.Tracks, pf.Camera, Scene, np.ndarray, np.ndarray]:
    """Tracks of a straight DN300 by the simulator's own lens and shutter; wall points, frames of the scene."""
    random, camera = np.random.default_rng(seed), fisheye(95)
    camera.save(folder / "camera.json")
    scene = Scene(
        {
            "diameter": 2 * RADIUS,
            "pieces": [{"length": 4.0}],
            "lens": with_profile({}, folder / "camera.json"),
            "sensor": {"line_time_s": LINE_TIME},
            "motion": {"seed": seed, "frames": 221, "speed": 0.3, "frame_rate": 24.0, "start": 0.3} | motion,
        }
    )
    count = 2800
    phi, z = random.uniform(0, 2 * np.pi, count), random.uniform(0.2, 3.9, count)
    wall = np.column_stack([RADIUS * np.cos(phi), RADIUS * np.sin(phi), z])
    frames = np.arange(12, scene.frames, EVERY)
    rows = []
    for number, frame in enumerate(frames):
        pixels, ok = scene.project(int(frame), wall)
        seen = wall @ scene.pose(int(frame))[:, :3].T + scene.pose(int(frame))[:, 3]
        theta = np.degrees(np.arctan2(np.hypot(*seen[:, :2].T), seen[:, 2]))
        keep = np.flatnonzero(ok & (theta > 35) & (theta < 89))
        rows.append((np.full(len(keep), number), keep, pixels[keep] + random.normal(0, noise, (len(keep), 2))))
    frame, track, pixels = (np.concatenate(part) for part in zip(*rows, strict=True))
    return pf.Tracks(frame, track, pixels), camera, scene, wall, frames


def measured(rec: pf.Reconstruction, wall: np.ndarray) -> tuple[float, float]:
    """Mean radius over the true one less 1, and by how many degrees a straight metre seems to bend."""
    scale, turn, move = similarity(rec.points, wall[rec.track])
    points = rec.points @ turn.T + move / scale
    true = wall[rec.track]
    inside = (true[:, 2] > 0.6) & (true[:, 2] < 3.0)
    points, true = points[inside], true[inside]
    out = points - true
    # Sideways displacement of each section as a quadratic of z: its second derivative is the bend.
    z, phi = true[:, 2] - 1.8, np.arctan2(true[:, 1], true[:, 0])
    basis = np.column_stack([np.ones(len(z)), z, z * z])
    bend = [2 * np.linalg.lstsq(basis, out[:, axis], rcond=None)[0][2] for axis in (0, 1)]
    radial = out[:, 0] * np.cos(phi) + out[:, 1] * np.sin(phi)
    return float(radial.mean() / RADIUS), float(np.degrees(np.hypot(*bend)))


def told_of(scene: Scene, frames: np.ndarray) -> pf.RollingShutter:
    return pf.RollingShutter([scene.time(int(f)) for f in frames], LINE_TIME)


def test_even_motion_without_noise_gives_the_exact_structure(tmp_path: Path) -> None:
    """The first and the last frame, too, of which half the rows lie beyond the drive."""
    tracks, camera, scene, wall, frames = drive(
        tmp_path, 4, 0.0, {"wobble_m": 0.0, "wobble_rad": 0.0, "ramp": 0.0, "frames": 101}
    )
    driven = np.array([scene.driven(int(f)) for f in frames])
    rec = pf.reconstruct(tracks, camera, driven, shutter=told_of(scene, frames))
    assert rec.status == "ok" and rec.variance_factor[0] < 1e-6
    turn, move = (part := scene.pose(int(frames[0])))[:, :3], part[:, 3]
    assert np.abs(rec.points - (wall[rec.track] @ turn.T + move)).max() < 1e-5
    seen = rec.poses_at(np.array([0, len(frames) - 1]), np.array([[500.0, 0.0], [500.0, 1023.0]]))
    true = [scene.pose(int(f), row) for f, row in ((frames[0], 0.0), (frames[-1], 1023.0))]
    world = np.eye(4)
    world[:3] = part
    for found, expected in zip(seen, true, strict=True):
        assert np.abs(found - expected @ np.linalg.inv(world)).max() < 1e-6


def test_rows_bend_a_straight_pipe_and_their_time_takes_it_back(tmp_path: Path) -> None:
    """Rows above see the wall earlier than rows below: 0.65 degrees a metre at 0.3 m/s and 31 ms."""
    tracks, camera, scene, wall, frames = drive(tmp_path, 3, 0.3, {"wobble_m": 0.003, "wobble_rad": 0.012})
    driven = np.array([scene.driven(int(f)) for f in frames])
    encoder = pf.Encoder(noise_m_per_sqrt_m=0.0005, scale_sigma=1e-5)
    blind = pf.reconstruct(tracks, camera, driven, encoder=encoder)
    told = pf.reconstruct(tracks, camera, driven, encoder=encoder, shutter=told_of(scene, frames))
    assert blind.status == told.status == "ok"
    assert blind.variance_factor[0] - told.variance_factor[0] > 0.02
    assert blind.line_time is None and abs(told.line_time[0] - LINE_TIME) < 4 * told.line_time[1] + 0.03 * LINE_TIME
    (blind_radius, blind_bend), (radius, bend) = measured(blind, wall), measured(told, wall)
    assert blind_bend > 0.5 and bend < 0.2
    assert blind_radius > 2e-4 and abs(radius) < 2e-4
    # Judged at the frames' poses most observations would lie beyond 3.5 sigma and not count.
    assert np.median(np.einsum("nii->n", told.own_covariance)) < np.median(np.einsum("nii->n", blind.own_covariance))


@pytest.mark.parametrize("factor", [-1.0, 3.0])
def test_rows_tell_a_line_time_of_the_wrong_sign_or_unit(tmp_path: Path, factor: float) -> None:
    tracks, camera, scene, _, frames = drive(tmp_path, 3, 0.3, {"wobble_m": 0.003, "wobble_rad": 0.012, "frames": 101})
    shutter = pf.RollingShutter([scene.time(int(f)) for f in frames], factor * LINE_TIME)
    rec = pf.reconstruct(tracks, camera, np.array([scene.driven(int(f)) for f in frames]), shutter=shutter)
    value, sigma = rec.line_time
    assert rec.status == "ok" and sigma < 0.2 * LINE_TIME
    assert abs(value - LINE_TIME) < 4 * sigma + 0.1 * LINE_TIME


def test_a_time_that_is_not_known_leaves_a_frame_as_it_is(tmp_path: Path) -> None:
    tracks, camera, scene, _, frames = drive(tmp_path, 5, 0.3, {"frames": 61})
    plain = pf.reconstruct(tracks, camera)
    for shutter in (
        pf.RollingShutter(np.full(len(frames), np.nan), LINE_TIME),
        pf.RollingShutter(told_of(scene, frames).time, 0.0),
    ):
        rec = pf.reconstruct(tracks, camera, shutter=shutter)
        assert rec.centres == pytest.approx(plain.centres, abs=1e-6)
    with pytest.raises(pf.ArgumentError, match="shutter: expected one time"):
        pf.reconstruct(tracks, camera, shutter=pf.RollingShutter([0.0, 1.0], LINE_TIME))
    with pytest.raises(pf.ArgumentError, match="line_time"):
        pf.reconstruct(tracks, camera, shutter=pf.RollingShutter(np.arange(len(frames)), np.inf))


def survey(config: list[str], boots: list[int]) -> SimpleNamespace:
    """What a survey says, of keyframes half a second apart and 100 s from start to start."""
    frames = [
        SimpleNamespace(boot=b, monotonic_ns=10**12 * b + 5 * 10**8 * i, time_ns=10**18 + 10**11 * b + 5 * 10**8 * i)
        for i, b in enumerate(boots)
    ]
    return SimpleNamespace(path="pipe.mcap", start=SimpleNamespace(config=config), keyframes=frames)


def test_a_survey_states_its_shutter_and_the_command_line_overrules_it() -> None:
    stated = survey(["camera.gain = 0", "camera.line_time_us = 30"], [1, 1, 2, 2])
    shutter = shutter_of(stated)
    assert shutter is not None and shutter.line_time == pytest.approx(3e-5)
    assert shutter.time == pytest.approx([0.0, 0.5, 101.0, 101.5])
    assert shutter_of(stated, 1e-5).line_time == 1e-5 and shutter_of(stated, 0.0) is None
    assert shutter_of(survey(["camera.line_time_us = 0"], [1, 1])) is None and shutter_of(survey([], [1])) is None
    with pytest.raises(pf.FormatError, match=r"camera\.line_time_us"):
        shutter_of(survey(["camera.line_time_us = fast"], [1]))
