"""Intervals of the measured diameter: as wide as values scatter, with the camera's own part as large as it is.

Simulated drives, no pictures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import pipefish as pf
import pipefish.measure as measure_module
from pipefish import lens_ripple
from pipefish.assumed import PUPIL_MOST
from pipefish.measure import measure
from pipefish.measurement import Measurement, mean_diameter
from pipefish.sectionsigma import diameter_function, shared_of
from pipefish.survey import Survey
from pipefish.tube import fit_tube
from pipefish.tube_shared import Common
from synthetic import write_survey
from test_reconstruct_cli import objects_of
from tube_tracks import Drive, fisheye, tube_drive

TRUE = 0.3 * (1 + 0.015**2 / 4)  # perimeter / pi of the drives' ellipse


def measured(
    folder: Path, seed: int, profile=None, camera=None, length: float = 2.0, encoder: bool = True, **given: float
) -> Measurement:
    drive = tube_drive(seed, length, density=500.0, camera=camera)
    path = folder / f"{seed}-{len(list(folder.iterdir()))}.mcap"
    write_survey(path, objects=objects_of(drive, profile=profile, seed=seed, encoder=encoder))
    return measure(Survey.open(path), threads=2, **given)


def test_station_intervals_hold_the_truth_and_are_no_wider_than_the_scatter_asks(tmp_path):
    """Six drives, each with its own noise of tracks and encoder. The vision's floor for drifting tracks, which these do
    not have, makes the diameter's intervals up to twice as wide as these values scatter; an encoder's noise over one
    diameter, as a bound, would make them 1.4 times as wide again. An ellipse has neither encoder nor the whole floor in
    it: with that its errors would be 0.63 of their sigma."""
    z, means, ovals = [], [], []
    for seed in range(40, 46):
        m = measured(tmp_path, seed)
        table = m.measured[0].tube.stations
        z.append((table["d_mean"] - TRUE) / table["d_mean_sigma"])
        ovals.append((table["ovality"] - 0.03) / table["ovality_sigma"])
        value, sigma = mean_diameter(m)
        means.append((value - TRUE) / sigma)
        assert sigma < np.median(table["d_mean_sigma"])
        assert 0.0005 < np.median(table["d_mean_sigma"]) < 0.0013
    z = np.concatenate(z)
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.3 and (np.abs(z) < 1.96).mean() > 0.9
    assert 0.7 < np.sqrt(np.mean(np.square(ovals))) < 1.3
    assert np.sqrt(np.mean(np.square(means))) < 1.8  # chi-squared of 6 over 6: 1.7 at 99.5 %


def test_where_the_diameter_is_the_scale_stations_know_how_far_it_wanders(tmp_path):
    """Without an encoder the structure's own scale drifts along the pipe: stations at its ends are known less well than
    those in its middle, by far less than the tube's own points say, and their intervals hold the truth."""
    z, ends, middles = [], [], []
    for seed in range(60, 64):
        drive = tube_drive(seed, 3.0, density=500.0)
        write_survey(tmp_path / f"{seed}.mcap", objects=objects_of(drive, seed=seed, encoder=False))
        m = measure(Survey.open(tmp_path / f"{seed}.mcap"), diameter=TRUE, threads=2)
        table = m.measured[0].tube.stations
        assert m.scale.diameter_from_prior
        z.append((table["d_mean"] - TRUE) / table["d_mean_sigma"])
        ends.append(np.mean(table["d_mean_sigma"][[0, -1]]))
        middles.append(np.median(table["d_mean_sigma"]))
    assert np.mean(ends) > 1.5 * np.mean(middles)
    # The floor for errors that tracks have in common, which these do not have, makes intervals up to twice as wide.
    assert 0.3 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.3


def test_a_diameter_is_a_linear_function_of_its_points(tmp_path):
    """All points twice as far: twice the diameter; all points shifted: none of it."""
    m = measured(tmp_path, 50)
    tube, points = m.measured[0].tube, m.structure.points
    on, by = diameter_function(tube, 0.5 * tube.length, 0.3)
    assert len(on) > 100 and np.abs(by.sum(axis=0)).max() < 0.02
    axis = tube.frames(tube.points["s"][on])["centre"]
    here = np.interp(0.5 * tube.length, tube.stations["s"], tube.stations["d_mean"])
    assert (by * (points[on] - axis)).sum() == pytest.approx(here, rel=0.002)


def test_the_cameras_part_is_what_another_camera_would_measure(tmp_path, monkeypatch):
    """A focal length that is one sigma too long moves the diameter by about the stated sigma. A small sigma: of a large
    one the adjustment, which estimates the camera too, takes a part away by itself, and states what is left."""
    monkeypatch.setattr(lens_ripple, "LENS_RADIAL_PX", 1e-6)  # what a lens may do beside its profile has its own test
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
    others = m.scale.sigma**2 + m.pupil_sigma**2
    camera = np.sqrt(np.maximum(0, (table["d_mean_systematic"] / table["d_mean"]) ** 2 - others))
    stated = np.interp(s, table["s"], camera)
    assert np.median(stated) == pytest.approx(np.median(moved), rel=0.4)
    assert (np.abs(stated - moved) < 0.5 * moved + 1e-4).all(), "station by station: it changes its sign on the way"


@pytest.mark.parametrize("encoder", [True, False])
def test_the_cameras_part_of_the_mean_is_what_other_cameras_move_the_mean_by(tmp_path, monkeypatch, encoder):
    """Two coefficients of the radius off by one sigma each, one after the other: diameters move by as much as is
    stated, station by station. Their mean moves by less, since errors cancel along the pipe, and not at all where it is
    given: there a station's part is that of its difference to it. Small sigmas: of large ones the survey tells a part.
    """
    monkeypatch.setattr(lens_ripple, "LENS_RADIAL_PX", 1e-6)
    names, sigma = ("k2", "k3"), 3e-5
    # Without an encoder the pupil is known, too: one that is free takes up what the radius does.
    own, told = ([sigma**2] * 2, names) if encoder else ([sigma**2, sigma**2, 1e-12], (*names, "pupil_e1"))
    known = dataclasses.replace(fisheye(95), covariance=np.diag(own), covariance_parameters=told)
    m = measured(tmp_path, 61, profile=known, encoder=encoder, diameter=TRUE)
    table = m.measured[0].tube.stations
    value, random = mean_diameter(m)
    moved, mean_moved = np.zeros(len(table["s"])), 0.0
    for name in names:
        profile = dataclasses.replace(known, **{name: getattr(known, name) + sigma})
        other = measured(tmp_path, 61, profile=profile, encoder=encoder, diameter=TRUE)
        there = other.measured[0].tube.stations
        moved += (np.interp(table["s"], there["s"], there["d_mean"]) / table["d_mean"] - 1) ** 2
        mean_moved += (mean_diameter(other)[0] / value - 1) ** 2
    stated, moved, mean_moved = m.measured[0].camera, np.sqrt(moved), np.sqrt(mean_moved)
    assert (np.abs(stated - moved) < 0.2 * moved + 3e-5).all()
    if not encoder:
        assert m.scale.diameter_from_prior and m.camera_sigma == m.systematic == 0.0
        assert mean_moved < 1e-6 and stated.max() > 0.003 and stated.min() < 0.0005
        return
    assert m.camera_sigma == pytest.approx(mean_moved, rel=0.3) and m.camera_sigma < 0.7 * np.median(stated)
    check = next(row for row in m.scale.sources if row["name"] == "diameter")
    assert check["sigma"] == pytest.approx(np.sqrt((random / value) ** 2 + m.camera_sigma**2 + m.pupil_sigma**2))


def test_a_pupil_that_the_profile_does_not_know_is_in_the_systematic_part(tmp_path):
    """A lens whose pupil shifts by 2 mm at 90 degrees, measured as a central one: the diameter is off by a share that
    the budget names, by about what a shift of that size was said to make, and by less where the profile knows it."""
    e1 = 0.002 / (np.pi / 2) ** 2
    central = tube_drive(60, 2.0, density=500.0).camera
    shifted = dataclasses.replace(central, pupil_e1=e1)
    m = measured(tmp_path, 60, profile=central, camera=shifted)
    knows = dataclasses.replace(shifted, covariance=np.array([[1e-12]]), covariance_parameters=("pupil_e1",))
    right = measured(tmp_path, 60, profile=knows, camera=shifted)
    off = mean_diameter(m)[0] / mean_diameter(right)[0] - 1
    told = m.pupil_sigma * 1.96 * e1 / PUPIL_MOST
    assert right.pupil_sigma == 0 and -off == pytest.approx(told, rel=0.5)
    assert m.systematic == pytest.approx(np.hypot(m.scale.sigma, m.pupil_sigma))
    table = m.measured[0].tube.stations
    assert (np.abs(table["d_mean"] / TRUE - 1) < 1.96 * table["d_mean_systematic"] / table["d_mean"]).all()


def seen_by_another_pupil(drive: Drive) -> Drive:
    """The drive, its rays starting where Gennery's law has them, 2.5 mm ahead at 90 degrees, and not at e1 theta^2."""
    tracks = drive.tracks
    pose = drive.poses[tracks.frame]
    seen = np.einsum("nij,nj->ni", pose[:, :, :3], drive.points[tracks.track]) + pose[:, :, 3]
    theta = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
    ahead = 0.00445 * (theta / np.sin(theta) - 1) - drive.camera.pupil_e1 * theta**2
    other = seen - ahead[:, None] * [0.0, 0.0, 1.0]
    pixels = tracks.pixels + drive.camera.project(other)[0] - drive.camera.project(seen)[0]
    return dataclasses.replace(drive, tracks=dataclasses.replace(tracks, pixels=pixels))


def test_with_the_lens_open_another_pupil_tapers_narrow_pipes_by_less_and_within_their_intervals(tmp_path, monkeypatch):
    """A wall 75 mm away, a profile as a calibration has it: right at the rim, up to 0.2 mm of pupil wrong within, and
    sure of itself. Five drives together, since they differ (0.09 to 0.75 % of scatter): stations of one drive are one
    smooth curve, mostly a taper, and so count as one in the binomial error of the share that is held. Of 21 drives the
    rms scatter is 0.31 of the closed lens's; of five by chance up to 0.31 (1 + 2 / sqrt(2 5)) = 0.5 of it."""
    camera = fisheye(95, pupil_e1=0.00103)
    known = dataclasses.replace(camera, covariance=np.array([[1e-11]]), covariance_parameters=("pupil_e1",))
    known_for_all, drives, held, variance = measure_module.assumed, range(61, 66), [], []
    for seed in drives:
        drive = tube_drive(seed, 0.96, step=0.02, diameter=0.15, ovality=0.0, density=1500.0, sigma=0.1, camera=camera)
        path = tmp_path / f"{seed}.mcap"
        write_survey(path, objects=objects_of(seen_by_another_pupil(drive), profile=known, seed=seed, jitter=0.0003))
        for about in (known_for_all, lambda camera, metric: camera):
            monkeypatch.setattr(measure_module, "assumed", about)
            table = measure(Survey.open(path), pictures=False, threads=2).measured[0].tube.stations
            error = table["d_mean"] / 0.15 - 1
            sigma = np.hypot(table["d_mean_sigma"], table["d_mean_systematic"]) / 0.15
            held.append((np.abs(error) < 1.96 * sigma).mean())
            variance.append(error.var())
    (held_open, held_closed), (scatter_open, scatter_closed) = (
        np.reshape(held, (-1, 2)).mean(axis=0),
        np.sqrt(np.reshape(variance, (-1, 2)).mean(axis=0)),
    )
    least = 0.95 - np.sqrt(0.95 * 0.05 / len(drives))
    assert held_open >= least and held_closed < least
    assert scatter_open < 0.5 * scatter_closed and scatter_closed > 0.008


def test_the_cameras_part_of_ovality_is_what_another_camera_would_measure(tmp_path):
    """A lens that is one sigma longer across than upright makes a pipe oval by about the stated systematic sigma, and
    the interval knows it."""
    sigma = 0.001
    drive = tube_drive(60, 2.0, density=500.0)
    f = drive.camera.f_u
    known = dataclasses.replace(
        drive.camera, covariance=(sigma * f) ** 2 * np.eye(2), covariance_parameters=("f_u", "f_v")
    )
    stretched = dataclasses.replace(drive.camera, f_u=f * (1 + sigma), f_v=f * (1 - sigma))
    m = measured(tmp_path, 60, profile=known)
    plain, other = (measured(tmp_path, 60, profile=p).measured[0].tube.stations for p in (None, stretched))
    table = m.measured[0].tube.stations
    moved = np.median(np.abs(np.interp(plain["s"], other["s"], other["ovality"]) - plain["ovality"]))
    stated = np.median(table["ovality_systematic"])
    assert 0.4 < stated / (moved / np.sqrt(2)) < 2.5, "two parameters of one sigma each"
    wide = np.median(table["ovality_hi"] - table["ovality_lo"])
    own = np.median(table["ovality_sigma"])
    assert wide == pytest.approx(2 * 1.96 * np.hypot(own, stated), rel=0.1)
    assert (plain["ovality_systematic"] > 0).all(), "a profile without covariance counts as off, too"


def test_a_bends_angle_knows_how_the_heading_wanders():
    """Three drives through a bend of 17 degrees, each with noise of its own. What the poses share is most of the sigma:
    by their own errors alone the two ends are known five times as well as the angle is."""
    curvature, z, own = 0.1, [], []
    for seed in range(71, 74):
        drive = tube_drive(seed, 3.0, bend=curvature)
        rec = pf.reconstruct(drive.tracks, drive.camera, drive.driven, encoder=pf.Encoder(scale_sigma=1e-5))
        tube = fit_tube(rec.points, rec.own_covariance, rec.centres)
        ends = (0.4, tube.length - 0.4)
        frame, p = tube.frames(list(ends)), tube.points
        by_ends = np.trace(frame["tangent_covariance"].reshape(-1, 2, 2), axis1=1, axis2=2).sum() / 2
        common = Common(tube.surface, shared_of(rec, 0), np.arange(len(rec.points)), tube.summary["d_mean"])
        sigma = np.sqrt(by_ends + common.turn(0, ends, by_ends / 2))
        wall = drive.points[rec.track]
        along, on = np.arctan2(wall[:, 2], 1 / curvature - wall[:, 0]), p["weight"] > 0
        near = [on & (np.abs(p["s"] - s) < 0.2) for s in ends]
        true = np.diff([np.polyfit(p["s"][k] - s, along[k], 1)[1] for s, k in zip(ends, near, strict=True)])[0]
        z.append((np.arccos(frame["tangent"][0] @ frame["tangent"][1]) - true) / sigma)
        own.append(np.sqrt(by_ends) / sigma)
    assert 0.1 < np.sqrt(np.mean(np.square(z))) < 2.07, "chi-squared of 3, 99.5 %"
    assert np.median(own) < 0.4
