"""Intervals of the measured diameter: as wide as values scatter, with the camera's own part as large as it is.

Simulated drives, no pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipefish.measure import Measurement, mean_diameter, measure
from pipefish.sectionsigma import diameter_function
from pipefish.survey import Survey
from synthetic import write_survey
from test_reconstruct_cli import objects_of
from tube_tracks import tube_drive

TRUE = 0.3 * (1 + 0.015**2 / 4)  # perimeter / pi of the drives' ellipse


def measured(folder: Path, seed: int, profile=None, camera=None, length: float = 2.0) -> Measurement:
    drive = tube_drive(seed, length, density=500.0, camera=camera)
    path = folder / f"{seed}-{len(list(folder.iterdir()))}.mcap"
    write_survey(path, objects=objects_of(drive, profile=profile, seed=seed))
    return measure(Survey.open(path), threads=2)


def test_station_intervals_hold_the_truth_and_are_no_wider_than_the_scatter_asks(tmp_path):
    """Six drives, each with its own noise of tracks and encoder. The vision's floor for drifting tracks, which these do
    not have, makes the intervals up to twice as wide as these values scatter; an encoder's noise over one diameter,
    as a bound, would make them 1.4 times as wide again."""
    z, means = [], []
    for seed in range(40, 46):
        m = measured(tmp_path, seed)
        table = m.measured[0].tube.stations
        z.append((table["d_mean"] - TRUE) / table["d_mean_sigma"])
        value, sigma = mean_diameter(m)
        means.append((value - TRUE) / sigma)
        assert sigma < np.median(table["d_mean_sigma"])
        assert 0.0005 < np.median(table["d_mean_sigma"]) < 0.0013
    z = np.concatenate(z)
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.3 and (np.abs(z) < 1.96).mean() > 0.9
    assert np.sqrt(np.mean(np.square(means))) < 1.8  # chi-squared of 6 over 6: 1.7 at 99.5 %


def test_a_diameter_is_a_linear_function_of_its_points(tmp_path):
    """All points twice as far: twice the diameter; all points shifted: none of it."""
    m = measured(tmp_path, 50)
    tube, points = m.measured[0].tube, m.structure.points
    on, by = diameter_function(tube, 0.5 * tube.length, 0.3)
    assert len(on) > 100 and np.abs(by.sum(axis=0)).max() < 0.02
    axis = tube.frames(tube.points["s"][on])["centre"]
    here = np.interp(0.5 * tube.length, tube.stations["s"], tube.stations["d_mean"])
    assert (by * (points[on] - axis)).sum() == pytest.approx(here, rel=0.002)


def test_the_cameras_part_is_what_another_camera_would_measure(tmp_path):
    """A focal length that is one sigma too long moves the diameter by about the stated sigma. A small sigma: of a large
    one the adjustment, which estimates the camera too, takes a part away by itself, and states what is left."""
    sigma = 0.0005
    drive = tube_drive(60, 2.0, density=500.0)
    f = drive.camera.f_u
    known = dataclasses.replace(
        drive.camera,
        covariance=(sigma * f) ** 2 * np.array([[1.0, 0.999999], [0.999999, 1.0]]),
        covariance_parameters=("f_u", "f_v"),
    )
    m = measured(tmp_path, 60, profile=known)
    longer = measured(tmp_path, 60, profile=dataclasses.replace(drive.camera, f_u=f * (1 + sigma), f_v=f * (1 + sigma)))
    plain = measured(tmp_path, 60)
    s, d = (plain.measured[0].tube.stations[k] for k in ("s", "d_mean"))
    table = longer.measured[0].tube.stations
    moved = np.abs(np.interp(s, table["s"], table["d_mean"]) / d - 1)
    table = m.measured[0].tube.stations
    camera = np.sqrt(np.maximum(0, (table["d_mean_systematic"] / table["d_mean"]) ** 2 - m.scale.sigma**2))
    stated = np.interp(s, table["s"], camera)
    assert np.median(stated) == pytest.approx(np.median(moved), rel=0.4)
    assert (np.abs(stated - moved) < 0.5 * moved + 1e-4).all(), "station by station: it changes its sign on the way"
    assert m.camera_sigma == pytest.approx(np.median(camera)) and 0.05 * sigma < m.camera_sigma < 2 * sigma
