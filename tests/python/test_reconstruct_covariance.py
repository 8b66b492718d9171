"""What a reconstruction says of itself: covariances against the dense normal matrix, wrong observations told from right
ones, the variance of what is left."""

from __future__ import annotations

import numpy as np
import pytest

import pipefish as pf
from tube_tracks import Drive, fisheye, similarity, tube_drive, tube_pair


def residuals(drive: Drive, rec: pf.Reconstruction) -> np.ndarray:
    """Of each observation, in units of 0.3 px, (N,); NaN where its point or its frame is not there."""
    t = drive.tracks
    point = np.full(int(t.track.max()) + 1, -1)
    point[rec.track] = np.arange(len(rec.track))
    frame = np.full(int(t.frame.max()) + 1, -1)
    frame[rec.frames] = np.arange(len(rec.frames))
    j, k = point[t.track], frame[t.frame]
    seen = np.einsum("nij,nj->ni", rec.poses[k, :, :3], rec.points[j]) + rec.poses[k, :, 3]
    pixels, ok = drive.camera.project(seen)
    out = np.linalg.norm(t.pixels - pixels, axis=1) / 0.3
    return np.where(ok & (j >= 0) & (k >= 0), out, np.nan)


def test_covariances_are_the_inverse_of_the_whole_normal_matrix() -> None:
    """Eight views, all parameters in one dense matrix, written here once more; gauge: first pose, distance to the last.
    Points to a millionth, poses likewise."""
    drive = tube_drive(41, 0.35)
    rec = pf.reconstruct(drive.tracks, drive.camera)
    assert rec.status == "ok" and len(rec.frames) == 8
    t, views, count = drive.tracks, len(rec.frames), len(rec.points)
    kept = np.flatnonzero(residuals(drive, rec) < 3.5)
    point = np.full(int(t.track.max()) + 1, -1)
    point[rec.track] = np.arange(count)
    j, k = point[t.track[kept]], t.frame[kept]
    assert rec.observations == len(kept), "the test must use what the engine used"
    turn = rec.poses[k, :, :3]
    seen = np.einsum("nij,nj->ni", turn, rec.points[j]) + rec.poses[k, :, 3]
    slope = drive.camera.project_jacobian(seen)[2] / 0.3
    by_point = slope @ turn
    by_turn = slope @ -np.cross(seen[:, None, :], np.eye(3)).transpose(0, 2, 1)  # d(w x y)/dw
    size = 6 * views + 3 * count
    normal = np.zeros((size, size))
    for i in range(len(kept)):
        columns = np.r_[6 * k[i] : 6 * k[i] + 6, 6 * views + 3 * j[i] : 6 * views + 3 * j[i] + 3]
        row = np.hstack([by_turn[i], -by_point[i], by_point[i]])
        normal[np.ix_(columns, columns)] += row.T @ row
    baseline = rec.centres[-1] - rec.centres[0]
    held = np.zeros(size)
    held[6 * views - 3 : 6 * views] = baseline / np.linalg.norm(baseline) ** 2 / 1e-7
    normal += np.outer(held, held)
    inverse = np.linalg.inv(normal[6:, 6:]) * rec.noise[0] ** 2
    poses = np.array([inverse[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(views - 1)])
    start = 6 * (views - 1)
    points = np.array(
        [inverse[start + 3 * i : start + 3 * i + 3, start + 3 * i : start + 3 * i + 3] for i in range(count)]
    )
    for found, true in ((rec.pose_covariance[1:], poses), (rec.covariance, points)):
        scale = np.sqrt(np.einsum("nii->ni", true))
        scale = np.maximum(scale, 1e-9)  # the last centre does not move along the baseline
        assert np.abs((found - true) / (scale[:, :, None] * scale[:, None, :])).max() < 1e-4
    # What they are used for: a sum over points, with all correlation.
    weights = np.random.default_rng(1).normal(size=(2, count, 3))
    flat = weights.reshape(2, -1)
    expected = flat @ inverse[start:, start:] @ flat.T
    assert rec.functions_covariance(np.arange(count), weights) == pytest.approx(expected, rel=1e-4)


def inner(points: np.ndarray) -> np.ndarray:
    """(3n,3n) projection of errors of points (n,3) onto those that no motion and no scale makes."""
    turns = -np.cross(points[:, None, :], np.eye(3)).transpose(0, 2, 1)
    free = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), turns, points[:, :, None]], axis=2).reshape(-1, 7)
    return np.eye(len(free)) - free @ np.linalg.solve(free.T @ free, free.T)


def test_two_gauges_say_the_same_of_what_no_gauge_changes() -> None:
    """The drive from its other end: another pose is held, and every point's covariance is another. Without motion and
    scale of the points they agree to 1e-6. Exact tracks: both are linear at the same place."""
    drive = tube_drive(43, 0.7, sigma=0.0)
    t, last = drive.tracks, len(drive.poses) - 1
    there = pf.reconstruct(t, drive.camera)
    back = pf.reconstruct(pf.Tracks(last - t.frame, t.track, t.pixels), drive.camera)
    assert there.status == back.status == "ok"
    common, a, b = np.intersect1d(there.track, back.track, return_indices=True)
    assert len(common) > 0.99 * len(there.track)
    some = np.linspace(0, len(common) - 1, 16).round().astype(int)
    scale, turn, _ = similarity(back.points[b], there.points[a])
    rows = np.eye(48).reshape(48, 16, 3)
    free = inner(there.points[a[some]])
    found = []
    for rec, places, by in ((there, a[some], np.eye(3)), (back, b[some], scale * turn)):
        covariance = rec.functions_covariance(places, rows @ by) / rec.noise[0] ** 2
        found.append(free @ covariance @ free.T)
        raw = np.trace(covariance)
    assert raw > 2 * np.trace(found[0]), "the gauges must matter"
    assert np.abs(found[0] - found[1]).max() < 1e-6 * np.abs(found[0]).max()


def test_wrong_observations_are_told_from_right_ones() -> None:
    """A twentieth of the observations lies 15 px off: those are beyond 3.5 sigma of the result, and only those."""
    drive = tube_drive(42, 3.0, wrong=0.05)
    rec = pf.reconstruct(drive.tracks, drive.camera)
    size = residuals(drive, rec)
    judged = np.isfinite(size)
    wrong = ~drive.right & judged
    # 15 px a coordinate: few lie within 1 px of the truth.
    assert np.mean(size[wrong] > 3.5) > 0.95
    flagged = judged & (size > 3.5)
    assert np.mean(~drive.right[flagged]) > 0.95, "3.5 sigma of two coordinates: 0.2 % of the right ones lie beyond"
    assert rec.variance_factor[0] == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("limits", [(15, 88), (15, 100)], ids=["180 degrees", "200 degrees"])
def test_two_views_with_two_fifths_wrong_are_solved(limits: tuple[float, float]) -> None:
    for seed in range(100):
        pair = tube_pair(seed, (0.004, 0.002, 0.06), 300, 0.4, limits=limits, camera=fisheye(105))
        found = pf.two_view(pair.camera, *pair.pixels, seed=seed)
        assert found.status == "ok"
        t = -pair.rotation @ pair.centre / np.linalg.norm(pair.centre)
        assert np.degrees(np.arccos(min(1.0, float(found.direction @ t)))) < 2.0
