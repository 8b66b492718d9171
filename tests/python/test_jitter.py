"""An encoder whose readings jitter: smoothed along what the pictures say; one that slips, drifts or counts is left."""

from __future__ import annotations

import numpy as np
import pytest

import pipefish as pf
from pipefish.jitter import jitter, smoothed
from pipefish.structure import Encoder
from tube_tracks import Drive, tube_drive

STATED = Encoder(noise_m_per_sqrt_m=0.005, quantum=0.0005)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return tube_drive(3, 4.0)


def structure_of(drive: Drive, reading: np.ndarray) -> pf.Reconstruction:
    return pf.reconstruct(drive.tracks, drive.camera, reading, encoder=STATED)


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
    assert jitter(length + white, length) == pytest.approx(0.003, rel=0.2)
    assert jitter(length + random.normal(0, 0.003, 400), length) == 0.0
    assert jitter(length, length) == 0.0
    assert jitter(length[:10] + white[:10], length[:10]) == 0.0  # too few to tell


def test_missing_readings_and_driving_back_are_smoothed_too(drive: Drive) -> None:
    reading = drive.driven[-1] - drive.driven + np.random.default_rng(4).normal(0, 0.005, len(drive.driven))
    reading[[0, 20, 21, 50]] = np.nan  # a wheel that counts downwards
    found = smoothed(structure_of(drive, reading), reading, STATED)
    assert found is not None
    off = found[0] - (drive.driven[-1] - drive.driven)
    assert np.isnan(found[0][0]) and np.std(off[1:]) < 0.003
