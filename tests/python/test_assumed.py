"""What stands for the covariance of a profile that has none; what all tracks share around the picture; where the truth
of a measured station is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import pipefish as pf
from pipefish import _engine
from pipefish.assumed import ASYMMETRY, PUPIL_REST, RESIDUAL_PX, assumed
from pipefish.camera import PARAMETERS
from pipefish.measure import _residuals
from pipefish.measuretruth import _places
from pipefish.simulate import Scene
from tube_tracks import fisheye, tube_drive

SAG = np.array([30.0, 20.0, -12.0])  # px^2: all around, more to the sides than up and down, more along one diagonal


def test_the_assumed_asymmetry_moves_the_picture_by_what_the_calibration_left() -> None:
    """Over the picture, whatever the profile: and it is stated where the profile does not say."""
    for residual, stated in ((0.07, 0.07), (None, RESIDUAL_PX)):
        camera = assumed(dataclasses.replace(fisheye(95), rms_px=residual))
        assert camera.covariance_parameters == ASYMMETRY
        random = np.random.default_rng(3)
        radius, phi = camera.theta_max * np.sqrt(random.uniform(0, 1, 2000)), random.uniform(0, 2 * np.pi, 2000)
        rays = np.column_stack([np.sin(radius) * np.cos(phi), np.sin(radius) * np.sin(phi), np.cos(radius)])
        slope = camera.project_jacobian(rays)[3][:, :, [PARAMETERS.index(name) for name in ASYMMETRY]]
        variance = np.einsum("nia,ab,nib->ni", slope, camera.covariance, slope)
        assert np.sqrt(np.nanmean(variance.sum(axis=1))) == pytest.approx(stated, rel=0.1)  # a distance, as rms_px is


def test_a_profile_with_a_covariance_still_does_not_know_its_lenss_ripples_nor_all_of_its_pupil() -> None:
    """0.1 px rms of the radius all over the field, beside what is stated; where nothing tells lengths, no pupil."""
    told = dataclasses.replace(
        fisheye(95), pupil_e1=0.001, covariance=np.diag([0.01, 1e-12]), covariance_parameters=("c_u", "pupil_e1")
    )
    camera = assumed(told)
    index = [PARAMETERS.index(name) for name in camera.covariance_parameters]
    theta = np.linspace(0.3, 0.95 * told.theta_max, 100)
    rays = np.column_stack([0 * theta, np.sin(theta), np.cos(theta)])  # upwards, where c_u does nothing
    slope = told.project_jacobian(rays)[3][:, 1, index]
    moved = np.sqrt(np.einsum("na,ab,nb->n", slope, camera.covariance, slope))
    assert np.sqrt(np.mean(moved**2)) == pytest.approx(0.1, rel=0.1)
    at = camera.covariance_parameters.index
    assert camera.covariance[at("c_u"), at("c_u")] == pytest.approx(0.01)
    assert camera.covariance[at("pupil_e1"), at("pupil_e1")] == pytest.approx(1e-12 + PUPIL_REST**2)
    blind = assumed(told, metric=False)
    assert "pupil_e1" not in blind.covariance_parameters and blind.covariance[0].any()


def test_a_held_camera_stays_and_no_survey_sharpens_it() -> None:
    """Its systematic part is what lenses of one sigma each would make of the same tracks."""
    drive = tube_drive(10, 1.0)
    camera = dataclasses.replace(
        drive.camera, covariance_parameters=("f_u", "f_v"), covariance=np.diag([0.3**2, 0.3**2])
    )
    free, held = (pf.reconstruct(drive.tracks, camera, drive.driven, hold_camera=hold) for hold in (False, True))
    plain = pf.reconstruct(drive.tracks, drive.camera, drive.driven)
    assert np.abs(held.points - plain.points).max() < 1e-5 and np.abs(held.camera_change).max() < 1e-3 * 0.3
    square = np.zeros(len(plain.points))
    for name in ("f_u", "f_v"):
        other = dataclasses.replace(drive.camera, **{name: getattr(drive.camera, name) + 0.3})
        moved = pf.reconstruct(drive.tracks, other, drive.driven)
        assert (moved.track == plain.track).all()
        square += ((moved.points - plain.points) ** 2).sum(axis=1)
    stated = np.einsum("nii->n", held.systematic)
    assert 0.8 < np.median(np.sqrt(stated / square)) < 1.25
    assert np.median(stated) > np.median(np.einsum("nii->n", free.systematic))


def test_a_calibration_that_fixes_a_norm_has_a_covariance_like_any_other() -> None:
    """Of a harmonic only the product of its amplitude in theta and its direction in phi is known: the direction has
    unit norm, and no variance along itself. The drive is measured, its camera is a camera, and the systematic part is
    that of the other parameters."""
    drive = tube_drive(10, 1.0)
    phi = (0.6, 0.8, 0.0, 0.0)
    camera = dataclasses.replace(drive.camera, asym_radial_theta=(2e-4, 0.0, 0.0), asym_radial_phi=phi)
    names = ("f_u", "f_v", *(f"asym_radial_phi[{i}]" for i in range(4)))
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = 0.3**2  # the two are one: singular too
    covariance[2:, 2:] = 0.1**2 * (np.eye(4) - np.outer(phi, phi))
    camera = dataclasses.replace(camera, covariance_parameters=names, covariance=covariance)
    rec = pf.reconstruct(drive.tracks, camera, drive.driven)
    assert rec.status == "ok" and rec.systematic is not None and np.isfinite(rec.systematic).all()
    changed = rec.camera_of(camera, 0)
    assert np.linalg.norm(changed.asym_radial_phi) == pytest.approx(1.0)
    assert changed.f_u - camera.f_u == pytest.approx(changed.f_v - camera.f_v, abs=1e-9)
    held = pf.reconstruct(drive.tracks, camera, drive.driven, hold_camera=True)
    plain = dataclasses.replace(camera, covariance=None, covariance_parameters=())
    moved = pf.reconstruct(
        drive.tracks, dataclasses.replace(plain, f_u=plain.f_u + 0.3, f_v=plain.f_v + 0.3), drive.driven
    )
    there = pf.reconstruct(drive.tracks, plain, drive.driven)
    ratio = np.einsum("nii->n", held.systematic) / ((moved.points - there.points) ** 2).sum(axis=1)
    assert 0.8 < np.sqrt(np.median(ratio)) < 1.25


def test_a_sag_that_differs_around_the_picture_makes_no_oval() -> None:
    """Tracks sag more to the sides than up and down: what a window's second moment as a tensor does."""
    drive = tube_drive(11, 1.5, sigma=0.03, ovality=0.0, limits=(25, 94))
    tracks, camera = drive.tracks, drive.camera
    rays, _ = camera.unproject(tracks.pixels)
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    first = np.searchsorted(tracks.track, tracks.track)
    out = tracks.pixels - [camera.c_u, camera.c_v]
    out /= np.linalg.norm(out, axis=1)[:, None]
    phi = np.arctan2(out[:, 1], out[:, 0])
    size = SAG[0] + SAG[1] * np.cos(2 * phi) + SAG[2] * np.sin(2 * phi)
    off = (size * _engine.sag(np.ascontiguousarray(theta[first]), theta, camera.f_u))[:, None] * out
    sagging = pf.Tracks(tracks.frame, tracks.track, tracks.pixels + off)
    encoder = pf.Encoder(noise_m_per_sqrt_m=0.0003, scale_sigma=1e-4)
    rec = pf.reconstruct(sagging, camera, drive.driven, encoder=encoder, sigma=0.03, sag_sigma=50.0)
    sigma = np.sqrt(np.diag(rec.parts[0][0].border))[1:4]
    assert (np.abs(rec.sag[0] - SAG) < 3 * sigma).all() and (sigma < 3.0).all()
    blind = pf.reconstruct(sagging, camera, drive.driven, encoder=encoder, sigma=0.03)
    oval = []
    for found in (rec, blind):
        world = (found.points - drive.poses[0, :, 3]) @ drive.poses[0, :, :3]
        angle = np.arctan2(world[:, 1], world[:, 0])
        rows = np.column_stack(
            [np.ones(len(angle)), np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]
        )
        radius = np.linalg.norm(world[:, :2], axis=1)
        near = np.abs(radius - 0.15) < 0.002
        fit = np.linalg.lstsq(rows[near], radius[near], rcond=None)[0]
        oval.append(100 * 4 * np.hypot(fit[3], fit[4]) / 0.3)
    assert oval[0] < 0.006 and oval[1] > 0.012  # points of the diameter


def test_noise_is_not_read_as_a_sag() -> None:
    """Of noise and the same with the other sign the mean is what it is read as in truth: it was -30 px^2."""
    drive, sag = tube_drive(5, 5.0, sigma=0.0), []
    for sigma in (0.6, -0.6):
        noise = sigma * np.random.default_rng(2).normal(size=drive.tracks.pixels.shape)
        tracks = dataclasses.replace(drive.tracks, pixels=drive.tracks.pixels + noise)
        sag.append(pf.reconstruct(tracks, drive.camera, drive.driven, sigma=0.6, sag_sigma=100.0).sag[0])
    assert (np.abs(np.mean(sag, axis=0)) < 3).all() and np.abs(sag).max() > 5


def test_a_sag_that_nothing_tells_is_as_open_as_was_said() -> None:
    """All around alike up to 90 px^2 were found, what differs around the picture is less."""
    drive = tube_drive(11, 1.0)
    rec = pf.reconstruct(drive.tracks, drive.camera, drive.driven, sigma=60.0, sag_sigma=100.0, common_errors=True)
    sigma = np.sqrt(np.diag(rec.parts[0][0].border))[1:4]
    assert sigma == pytest.approx([100, 50, 50], rel=0.02)


def test_a_station_is_compared_with_the_section_before_its_keyframe() -> None:
    """A wheel of 0.6 % puts the far end of 2 m by 12 mm beyond: that is no error of the section there."""
    scene = Scene.load("straight", {"motion.frames": 60})
    frames = list(range(0, scene.frames, 4))
    s = np.array([scene.arc_length(f) for f in frames]) + 0.02
    axis = np.array([(scene.wall(a, 0.0) + scene.wall(a, np.pi)) / 2 for a in s])
    first = scene.pose(frames[0])
    poses = np.array([scene.pose(f) for f in frames])
    centres = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
    origin = -first[:, :3].T @ first[:, 3]
    grown = poses.copy()
    stretched = origin + 1.006 * (centres - origin)
    grown[:, :, 3] = -np.einsum("nij,nj->ni", poses[:, :, :3], stretched)
    places = _places(scene, origin + 1.006 * (axis - origin), grown, stretched, frames)
    assert np.abs(places - s).max() < 0.002


def test_a_pixels_noise_is_all_in_its_residual_whatever_the_sag() -> None:
    """The sag is taken at the angles of adjusted points: by the pixel's own a part of its noise went into it."""
    drive = tube_drive(11, 1.0, sigma=0.1)
    rec = pf.reconstruct(drive.tracks, drive.camera, drive.driven, sigma=0.1, sag_sigma=100.0)
    rec.sag[0] = np.array([80.0, 0.0, 0.0])
    covariance = np.broadcast_to(0.01 * np.eye(2), (len(drive.tracks.pixels), 2, 2)).copy()
    residual = []
    for along in (0.0, 0.5):
        pixels = drive.tracks.pixels.copy()
        outwards = pixels - [drive.camera.c_u, drive.camera.c_v]
        pixels += along * outwards / np.linalg.norm(outwards, axis=1)[:, None]
        tracks = dataclasses.replace(drive.tracks, pixels=pixels, covariance=covariance)
        residual.append(_residuals(tracks, rec, drive.camera).pixels)
    assert np.linalg.norm(residual[1] - residual[0], axis=1) == pytest.approx(0.5, abs=1e-9)
