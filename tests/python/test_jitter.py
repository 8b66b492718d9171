"""An encoder whose readings jitter: smoothed along what the pictures say; one that slips, drifts or counts is left."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import pipefish as pf
from pipefish import measure as measuring
from pipefish.jitter import jitter, smoothed
from pipefish.structure import Encoder
from tube_tracks import Drive, tube_drive

STATED = Encoder(noise_m_per_sqrt_m=0.005, quantum=0.0005)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return tube_drive(3, 4.0)


def structure_of(drive: Drive, reading: np.ndarray) -> pf.Reconstruction:
    return pf.reconstruct(drive.tracks, drive.camera, reading, encoder=STATED)


def pictures(z: np.ndarray, noise: float = 0.0003, segment: np.ndarray | None = None) -> SimpleNamespace:
    """What smoothed() looks at, of a camera that looks along z from (n,) and sways: places are off by `noise`."""
    sway = np.column_stack([0.012 * np.sin(6 * z), 0.008 * np.cos(5 * z), z])
    segment = np.zeros(len(z), int) if segment is None else segment
    return SimpleNamespace(
        centres=sway + np.random.default_rng(7).normal(0, noise, sway.shape),
        poses=np.tile(np.eye(3, 4), (len(z), 1, 1)),
        segment=segment,
        sigma=[1.0] * (segment.max() + 1),
        frames=np.arange(len(z)),
    )


def jittering(z: np.ndarray, seed: int) -> np.ndarray:
    return z + np.random.default_rng(seed).normal(0, 0.005, len(z))


@pytest.mark.parametrize("seed", range(3))
def test_readings_that_jitter_by_5_mm_come_out_right_to_2_mm(drive: Drive, seed: int) -> None:
    random = np.random.default_rng(seed)
    reading = drive.driven + random.normal(0, 0.005, len(drive.driven))
    found = smoothed(structure_of(drive, reading), reading, STATED)
    assert found is not None
    place, quality, white = found
    assert white == pytest.approx(0.005, rel=0.35)  # of 81 readings
    off = place - drive.driven
    assert np.std(off) < 0.4 * np.std(reading - drive.driven)
    assert quality.noise_m_per_sqrt_m >= STATED.noise_m_per_sqrt_m
    # A diameter's length of it, which scales a section: within what is said of it then.
    steps = off[6:] - off[:-6]
    assert np.std(steps) < 1.2 * quality.noise_m_per_sqrt_m * np.sqrt(6 * 0.05)


def test_the_scale_holds_along_the_pipe_though_each_step_is_worth_nothing(drive: Drive) -> None:
    reading = drive.driven + np.random.default_rng(9).normal(0, 0.005, len(drive.driven))
    found = smoothed(structure_of(drive, reading), reading, STATED)
    assert found is not None
    rec = pf.reconstruct(drive.tracks, drive.camera, found[0], encoder=found[1])
    for part in (slice(0, 27), slice(27, 54), slice(54, 81)):
        true, seen = (np.linalg.norm(np.diff(c[part], axis=0), axis=1).sum() for c in (drive.centres, rec.centres))
        assert seen == pytest.approx(true, rel=0.006)


def test_a_wheel_whose_errors_stay_is_left_as_it_is(drive: Drive) -> None:
    for seed in range(4):
        random = np.random.default_rng(seed)
        steps = np.diff(drive.driven)
        walk = steps + random.normal(0, 0.005, len(steps)) * np.sqrt(steps)
        slips = walk * np.where(random.uniform(size=len(steps)) < 0.1, 1.3, 1.0)
        for wrong in (walk, slips):
            reading = np.append(0.0, np.cumsum(wrong))
            assert smoothed(structure_of(drive, reading), reading, STATED) is None
        counts = np.floor(drive.driven / STATED.quantum) * STATED.quantum
        assert smoothed(structure_of(drive, counts), counts, STATED) is None


def test_jitter_is_what_neighbouring_steps_contradict_each_other_by() -> None:
    random, length = np.random.default_rng(1), np.full(400, 0.05)
    white = np.diff(random.normal(0, 0.003, 401))
    variance, sigma = jitter(length + white, length)
    assert np.sqrt(variance) == pytest.approx(0.003, rel=0.2)
    assert 0 < sigma < variance / 5
    assert jitter(length + random.normal(0, 0.003, 400), length)[0] == 0.0
    assert jitter(length, length)[0] == 0.0
    assert jitter(length[:10] + white[:10], length[:10])[0] == 0.0  # too few to tell


def test_a_slip_hides_no_jitter() -> None:
    length, slip, found = np.full(60, 0.05), 0.15 * (np.arange(60) == 30), []
    for seed in range(60):
        white = np.diff(np.random.default_rng(seed).normal(0, 0.005, 61))
        found.append([jitter(length + white, length)[0] > 0, jitter(length + white + slip, length)[0] > 0])
    without, beside = np.mean(found, axis=0)
    assert beside > without - 0.1


def test_missing_readings_stay_missing_and_a_wheel_may_count_downwards(drive: Drive) -> None:
    true = drive.driven[-1] - drive.driven
    reading = true + np.random.default_rng(4).normal(0, 0.005, len(true))
    reading[[0, 20, 21, 50, 78, 79, 80]] = np.nan
    found = smoothed(structure_of(drive, reading), reading, STATED)
    assert found is not None
    assert np.array_equal(np.isnan(found[0]), np.isnan(reading))  # the pictures' own steps are no odometry
    assert np.nanstd(found[0] - true) < 0.003


def test_a_slip_among_jitter_stays_one_step_and_bends_no_scale(drive: Drive) -> None:
    true = drive.driven + np.where(np.arange(len(drive.driven)) < 40, 0.0, 0.15)
    reading = true + np.random.default_rng(5).normal(0, 0.005, len(true))
    found = smoothed(structure_of(drive, reading), reading, STATED)
    assert found is not None
    off = np.diff(found[0] - true)
    assert abs(off[39]) < 4 * found[2]
    assert abs(np.delete(off, 39)).max() < 0.002
    rec = pf.reconstruct(drive.tracks, drive.camera, found[0], encoder=found[1])
    for part in (slice(0, 27), slice(27, 54), slice(54, 81)):
        was, seen = (np.linalg.norm(np.diff(c[part], axis=0), axis=1).sum() for c in (drive.centres, rec.centres))
        assert seen == pytest.approx(was, rel=0.006)


@pytest.mark.parametrize("at", [12, 60, 110])
def test_a_slip_bends_the_scale_before_and_after_it_by_no_more_than_jitter_does(at: int) -> None:
    z = np.arange(0, 6, 0.05)
    for slip in (0.03, 0.15, -0.15):
        true = z + np.where(np.arange(len(z)) < at, 0.0, slip)
        found = smoothed(pictures(z), jittering(true, at), STATED)
        assert found is not None
        for part in (slice(0, at), slice(at, None)):
            slope = np.polyfit(z[part], found[0][part] - true[part], 1)[0]
            length = np.ptp(z[part])
            assert abs(slope) < 3 * found[1].noise_m_per_sqrt_m / np.sqrt(length)


def test_a_slip_of_four_sigmas_of_jitter_is_found_by_what_lies_before_and_after() -> None:
    z, slopes = np.arange(0, 6, 0.05), []
    true = z + np.where(np.arange(len(z)) < 60, 0.0, 0.02)
    for seed in range(100, 112):
        found = smoothed(pictures(z), jittering(true, seed), STATED)
        assert found is not None
        slopes += [np.polyfit(z[p], found[0][p] - true[p], 1)[0] for p in (slice(40, 60), slice(60, 80))]
    assert np.sqrt(np.mean(np.square(slopes))) < 0.003  # 0.002 without a slip


def test_what_is_not_jitter_alone_is_left_as_it_is() -> None:
    z = np.arange(0, 6, 0.05)
    reading = jittering(z, 6)
    for seed in range(4):  # slips, ten in 120 steps
        jump = np.zeros(len(z))
        jump[8:115:11] = 0.02 * (-1.0) ** np.arange(10)
        assert smoothed(pictures(z), jittering(z + np.cumsum(jump), seed), STATED) is None
    aside = pictures(z)  # looked at the wall while it drove on: nothing ahead is seen of those steps
    aside.poses[40:60, 2, :3] = [1.0, 0.0, 0.0]
    assert smoothed(aside, reading, STATED) is None


def test_driving_back_is_told_from_the_way_the_camera_looks() -> None:
    z = np.append(np.arange(0, 3, 0.05), np.arange(3, -0.001, -0.05))
    found = smoothed(pictures(z), jittering(z, 1), STATED)
    assert found is not None
    assert np.std(found[0] - z) < 0.002
    backwards = pictures(z)
    backwards.poses[:, 2, :3] *= -1.0  # looks back: the same drive
    assert np.allclose(smoothed(backwards, jittering(z, 1), STATED)[0], found[0])


@pytest.mark.parametrize(("step", "noise"), [(0.004, 0.001), (0.002, 0.001)])
def test_a_creep_whose_steps_drown_in_the_poses_noise_turns_nothing_round(step: float, noise: float) -> None:
    z = np.cumsum(np.concatenate([np.full(60, 0.05), np.full(40, step), np.full(60, 0.05)]))
    found = smoothed(pictures(z, noise), jittering(z, 2), STATED)
    assert found is not None
    assert np.std(found[0] - z) < 0.0025 and abs(found[0] - z).max() < 0.007


def test_a_nod_turns_nothing_round() -> None:
    z = np.arange(0, 5, 0.05)
    nodding = pictures(z)
    nodding.centres[50, 2] = nodding.centres[49, 2] - 0.01
    found = smoothed(nodding, jittering(z, 3), STATED)
    assert found is None or np.std(found[0] - z) < 0.0025


def test_counts_as_coarse_as_stated_are_no_jitter() -> None:
    z = np.arange(0, 6, 0.05)
    for quantum in (0.005, 0.01, 0.02):
        stated = Encoder(noise_m_per_sqrt_m=0.00224, quantum=quantum)
        for scale in (1.0, 1.003, 1.02):  # 2.5 counts a step, again and again: the worst of them
            reading = np.floor(z * scale / quantum + 0.37) * quantum
            assert smoothed(pictures(z), reading, stated) is None
    # Beyond them it is, and the counts' own share of what a reading is off by is not taken for the steps'.
    reading = np.floor(jittering(z, 8) / 0.005) * 0.005
    found = smoothed(pictures(z), reading, Encoder(noise_m_per_sqrt_m=0.0005, quantum=0.005))
    assert found is not None
    assert found[2] == pytest.approx(np.hypot(0.005, 0.005 / np.sqrt(12)), rel=0.35)
    off = found[0] - z
    assert np.std(off[6:] - off[:-6]) < 1.2 * found[1].noise_m_per_sqrt_m * np.sqrt(6 * 0.05)


def test_the_steps_noise_is_widened_to_what_smoothing_leaves_open() -> None:
    z, fine = np.arange(0, 6, 0.05), Encoder(noise_m_per_sqrt_m=0.0005, quantum=0.0)
    for seed in range(5):
        found = smoothed(pictures(z), jittering(z, seed), fine)
        assert found is not None
        off = found[0] - z
        assert np.std(off[6:] - off[:-6]) < 1.2 * found[1].noise_m_per_sqrt_m * np.sqrt(6 * 0.05)
        assert found[1].noise_m_per_sqrt_m < 0.01  # a thousandth of 5 m, not a slip a step


def test_a_short_stretch_beside_a_long_one_is_smoothed_and_its_scale_covered() -> None:
    z = np.arange(0, 6, 0.05)
    segment = (np.arange(len(z)) >= len(z) - 12).astype(int)
    error = []
    for seed in range(12):
        reading = jittering(z, 20 + seed)
        found = smoothed(pictures(z, segment=segment), reading, STATED)
        assert found is not None
        off = (found[0] - z)[-12:]
        noise = found[1].noise_m_per_sqrt_m
        assert np.std(np.diff(off)) < noise * np.sqrt(0.05)  # raw readings would be off by 7 mm a step
        error.append(np.polyfit(z[-12:], off, 1)[0] / (noise / np.sqrt(11 * 0.05)))
    assert np.sqrt(np.mean(np.square(error))) < 1.5


def test_a_second_adjustment_that_fails_leaves_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = SimpleNamespace(status="ok"), SimpleNamespace(status="failed")
    nothing = dict.fromkeys(measuring.Readings.__dataclass_fields__)
    given = measuring.Readings(**nothing | {"chainage": np.arange(3.0), "encoder": STATED, "remarks": []})
    made = iter((first, second))
    monkeypatch.setattr(measuring, "_adjusted_once", lambda *_: next(made))
    monkeypatch.setattr(measuring, "smoothed", lambda *_: (np.zeros(3), STATED, 0.005))
    used, structure = measuring._adjusted(given, "", None, lambda *_: None)
    assert structure is first and used is given and next(made, None) is None


def test_the_remark_on_jitter_tells_an_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one sigma of 5 mm, as every other ±."""
    nothing = dict.fromkeys(measuring.Readings.__dataclass_fields__)
    given = measuring.Readings(**nothing | {"chainage": np.arange(3.0), "encoder": STATED, "remarks": []})
    monkeypatch.setattr(measuring, "_adjusted_once", lambda *_: SimpleNamespace(status="ok"))
    monkeypatch.setattr(measuring, "smoothed", lambda *_: (np.zeros(3), STATED, 0.005))
    used, _ = measuring._adjusted(given, "", None, lambda *_: None)
    assert len(used.remarks) == 1 and "jitter by ± 9.8 mm each" in used.remarks[0] and "sigma" not in used.remarks[0]
