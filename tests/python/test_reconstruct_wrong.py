"""Wrong observations at their full share, perturbed starts and exact maps: what each stage must stand by itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import pipefish as pf
from pipefish import _engine
from pipefish.structure_gaps import zoom_between
from test_reconstruct_covariance import residuals
from tube_tracks import Drive, fisheye, rotation, similarity, tube_drive


def slid(drive: Drive, random: np.random.Generator, share: float, frame: int) -> tuple[pf.Tracks, np.ndarray]:
    """That share of a frame's observations moved by 5 to 25 px along the curve on which the frame before allows them:
    their points are elsewhere on the ray from there. (N,) which are."""
    t, pixels = drive.tracks, drive.tracks.pixels.copy()
    wrong = np.zeros(len(t.frame), bool)
    pose, eye = drive.poses[frame], drive.centres[frame - 1]
    for i in np.flatnonzero((t.frame == frame) & (random.uniform(size=len(t.frame)) < share)):
        stretch = np.concatenate([[1.0], np.linspace(0.4, 4.0, 800)])
        points = eye + (drive.points[t.track[i]] - eye) * stretch[:, None]
        uv, ok = drive.camera.project(points @ pose[:, :3].T + pose[:, 3])
        moved = np.linalg.norm(uv - uv[0], axis=1)
        fits = np.flatnonzero(ok & (moved > 5) & (moved < 25))
        if len(fits):
            pixels[i] += uv[random.choice(fits)] - uv[0]
            wrong[i] = True
    return pf.Tracks(t.frame, t.track, pixels), wrong


def test_three_views_tell_what_slid_along_the_epipolar_curve() -> None:
    """Two views cannot: the curve is where the second one allows a match. A fifth of the third view's is wrong."""
    bad, told, good, kept = 0, 0, 0, 0
    for seed in range(12):
        drive = tube_drive(seed, 0.1, density=1500.0, limits=(30.0, 89.0))
        tracks, wrong = slid(drive, np.random.default_rng(seed), 0.2, 2)
        rec = pf.reconstruct(tracks, drive.camera)
        assert rec.status == "ok" and len(rec.frames) == 3
        in_all = np.flatnonzero(np.bincount(tracks.track) == 3)
        off = np.intersect1d(tracks.track[wrong], in_all)
        right = np.setdiff1d(in_all, off)
        bad, told = bad + len(off), told + len(np.setdiff1d(off, rec.track))
        good, kept = good + len(right), kept + len(np.intersect1d(right, rec.track))
    assert bad > 400 and told > 0.95 * bad and kept > 0.99 * good


def test_sixty_four_exact_views_merge_to_the_truth() -> None:
    """Five levels of merging; what is left is rounding: 1e-8 of the length."""
    drive = tube_drive(51, 63 * 0.05, sigma=0.0)
    rec = pf.reconstruct(drive.tracks, drive.camera)
    assert rec.status == "ok" and len(rec.frames) == 64
    scale, turn, move = similarity(rec.centres, drive.centres)
    length = np.linalg.norm(drive.centres[-1] - drive.centres[0])
    assert np.abs(scale * rec.centres @ turn.T + move - drive.centres).max() < 1e-8 * length


def test_a_start_two_per_cent_off_comes_to_the_cost_of_the_true_one_in_twenty_steps() -> None:
    drive, random = tube_drive(52, 2.0), np.random.default_rng(6)
    t = drive.tracks
    often = np.bincount(t.track, minlength=len(drive.points)) >= 3
    number = np.cumsum(often) - 1
    kept = often[t.track]
    seen = (t.frame[kept].astype(np.int32), number[t.track[kept]].astype(np.int32), t.pixels[kept], 0.3)
    points = drive.points[often]
    # Of the radius, and of a radian.
    moved = points + random.normal(0, 0.02 * 0.15, points.shape)
    poses = drive.poses.copy()
    for pose, centre in zip(poses[1:], drive.centres[1:], strict=True):
        turn = rotation(random.normal(0, 0.02, 3)) @ pose[:, :3]
        pose[:] = np.column_stack([turn, -turn @ (centre + random.normal(0, 0.02 * 0.15, 3))])
    camera = drive.camera._profile
    true = _engine.adjust(camera, drive.poses, points, *seen, 50)
    off = _engine.adjust(camera, poses, moved, *seen, 20)
    assert true["converged"] and off["converged"] and off["observations"] == true["observations"]
    assert off["cost"] == pytest.approx(true["cost"], rel=1e-6)
    assert off["variance_factor"] == pytest.approx(1, abs=0.03)


def test_a_tenth_of_wrong_observations_is_told_and_leaves_no_gap() -> None:
    """What a gate on three tenths leaves: 95 % are told, 98 % of what is told is wrong. Tracks of four to five frames,
    so that neighbouring leaves have few points in common."""
    told = []
    for seed in (42, 43, 44, 45):
        drive = tube_drive(seed, 3.0, wrong=0.1)
        rec = pf.reconstruct(drive.tracks, drive.camera)
        assert rec.status == "ok" and len(rec.frames) == 61
        size = residuals(drive, rec)
        judged, off = np.isfinite(size), ~drive.right
        flagged = judged & (size > 3.5)
        told.append([(flagged & off).sum(), (judged & off).sum(), flagged.sum()])
    right, wrong, flags = np.sum(told, axis=0)
    assert right > 0.95 * wrong and right > 0.98 * flags


def zoomed(drive: Drive, by: float, frames: int, start: int) -> pf.Tracks:
    """Tracks of a drive whose lens zooms over so many frames after one."""
    t, middle = drive.tracks, np.array([drive.camera.c_u, drive.camera.c_v])
    zoom = by ** np.clip((t.frame - start) / frames, 0, 1)
    return pf.Tracks(t.frame, t.track, middle + zoom[:, None] * (t.pixels - middle))


@pytest.mark.parametrize(
    ("by", "frames", "start", "seed"),
    [(1.2, 1, 20, 62), (1.2, 1, 34, 62), (1.2, 1, 12, 64), (1.2, 4, 16, 62), (0.8, 4, 24, 62), (1.5, 4, 30, 63)],
)
def test_what_was_seen_before_the_lens_zoomed_is_measured_and_nothing_behind_it(
    by: float, frames: int, start: int, seed: int
) -> None:
    """From there on the profile does not hold, and diameters would be off by half of it: a step all at once, which no
    pose explains, and a slow one, which poses and points take up with small residuals."""
    drive = tube_drive(seed, 2.0)
    rec = pf.reconstruct(zoomed(drive, by, frames, start), drive.camera, drive.driven)
    assert rec.status == "partial" and start - 1 <= rec.frames[-1] <= start and not rec.standing
    assert (rec.gaps[-1].reason, rec.gaps[-1].first, rec.gaps[-1].last) == ("zoom", rec.frames[-1], 40)
    assert "the lens zoomed" in rec.reason
    r, t = drive.poses[0, :, :3], drive.poses[0, :, 3]
    off = rec.points - (drive.points[rec.track] @ r.T + t)
    assert np.median(np.linalg.norm(off, axis=1)) < 0.004


def test_a_track_that_is_twice_in_a_frame_tells_the_same_zoom() -> None:
    drive, by, frame = tube_drive(62, 1.0), 1.2, 10
    t, middle = drive.tracks, np.array([drive.camera.c_u, drive.camera.c_v])
    known, on = np.unique(t.track[t.frame < frame]), t.frame == frame
    stretch = {"tracks": known, "points": drive.points[known], "first": 0, "poses": drive.poses[:frame]}
    stretch["pupil"] = drive.camera.pupil_e1
    track, pixels = t.track[on], middle + by * (t.pixels[on] - middle)
    once = zoom_between(drive.camera, stretch, frame, track, pixels, 0.3)
    twice = zoom_between(drive.camera, stretch, frame, np.repeat(track, 2), np.repeat(pixels, 2, axis=0), 0.3)
    assert once is not None and twice == once and once[0] == pytest.approx(np.log(by), abs=0.005)


@pytest.mark.parametrize("seed", [71, 72])
def test_a_lens_that_did_not_zoom_is_believed(seed: int) -> None:
    """In a bend, with wrong observations, along tracks that all drift outwards by a tenth of a pixel a frame."""
    drive = tube_drive(seed, 2.0, wrong=0.05, bend=0.3)
    t, middle = drive.tracks, np.array([drive.camera.c_u, drive.camera.c_v])
    out = t.pixels - middle
    since = t.frame - t.frame[np.searchsorted(t.track, t.track)]
    drifted = t.pixels + 0.1 * since[:, None] * out / np.linalg.norm(out, axis=1)[:, None]
    rec = pf.reconstruct(pf.Tracks(t.frame, t.track, drifted), drive.camera, drive.driven)
    assert not [g for g in rec.gaps if g.reason == "zoom"] and rec.frames[-1] == 40


def test_tracks_that_come_in_from_beyond_the_cameras_model_are_no_error() -> None:
    """Backwards, corners come in from the rim: a profile up to 69 degrees has no ray for their first views, and two
    such views say nothing of where a corner is."""
    drive = tube_drive(62, 1.0, limits=(20.0, 89.0))
    t = drive.tracks
    backwards = pf.Tracks(t.frame.max() - t.frame, t.track, t.pixels)
    camera = dataclasses.replace(drive.camera, theta_max=1.2)
    rec = pf.reconstruct(backwards, camera, drive.driven[::-1])
    assert rec.status == "ok" and rec.outside > 500 and len(rec.frames) == 21
    scale, turn, move = similarity(rec.centres, drive.centres[::-1])
    assert np.abs(scale * rec.centres @ turn.T + move - drive.centres[::-1]).max() < 0.01


def test_keyframes_that_came_twice_are_standing_and_nothing_else_changes() -> None:
    """Each keyframe sent twice: no motion between the two, which makes neither a gap nor a second camera."""
    drive = tube_drive(63, 1.0)
    t = drive.tracks
    twice = pf.Tracks(
        np.concatenate([2 * t.frame, 2 * t.frame + 1]), np.tile(t.track, 2), np.concatenate([t.pixels, t.pixels])
    )
    once = pf.reconstruct(t, drive.camera, drive.driven)
    rec = pf.reconstruct(twice, drive.camera, np.repeat(drive.driven, 2))
    assert rec.status == "ok" and len(rec.frames) == len(once.frames) == 21 and len(rec.standing) == 21
    assert (rec.frames // 2 == once.frames).all() and (rec.track == once.track).all()
    assert np.abs(rec.centres - once.centres).max() < 1e-3 and np.abs(rec.points - once.points).max() < 0.01


@pytest.mark.parametrize("kind", ["mirrored", "one pixel"])
def test_pictures_that_cannot_be_are_a_status_without_a_wrong_number(kind: str) -> None:
    drive = tube_drive(61, 2.0)
    t, middle = drive.tracks, np.array([drive.camera.c_u, drive.camera.c_v])
    pixels = {
        "mirrored": t.pixels * [-1, 1] + [2 * middle[0], 0],
        "one pixel": np.tile(middle + 80.0, (len(t.frame), 1)),
    }[kind]
    rec = pf.reconstruct(pf.Tracks(t.frame, t.track, pixels), drive.camera, drive.driven)
    for values in (rec.points, rec.poses, rec.covariance, rec.pose_covariance):
        assert np.isfinite(values).all()
    if kind == "mirrored":  # a lens that is round cannot tell: the pipe is mirrored, too
        mirrored = drive.points[rec.track] * [-1, 1, 1]
        scale, turn, move = similarity(rec.points, mirrored)
        assert rec.status == "ok" and np.abs(scale * rec.points @ turn.T + move - mirrored).max() < 0.05
    else:
        assert rec.status == "failed" and rec.reason


@pytest.mark.parametrize(("shift", "seed"), [(0.001, 3), (0.001, 4), (0.002, 4), (0.004, 3)])
def test_a_pupil_that_no_encoder_scales_ends_in_a_status(shift: float, seed: int) -> None:
    """Without an encoder lenses count as central, unless it is said how well the shift is known: of a pupil that moves
    by millimetres beside a wall 60 mm away hardly an observation is left, and what is left determines nothing or
    little. That is a gap, and no internal error."""
    camera = dataclasses.replace(fisheye(95), pupil_e1=shift)
    drive = tube_drive(seed, 1.0, step=0.02, diameter=0.12, camera=camera)
    rec = pf.reconstruct(drive.tracks, camera, None)
    assert rec.status in ("partial", "failed") and rec.gaps and np.isfinite(rec.points).all()
    assert np.isfinite(rec.covariance).all()
