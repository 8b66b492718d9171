"""Tracks that all broke off at once while the wall stayed in sight: the same corners under other names."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import pipefish as pf
from pipefish.measure import measure
from pipefish.survey import Survey
from test_reconstruct_cli import survey_of
from tube_tracks import Drive, similarity, tube_drive


def broken(drive: Drive, frame: int, again: float, seed: int) -> pf.Tracks:
    """From that frame on every track has another name. Of the corners in sight then this share is found again; in place
    of the rest there are those of another wall."""
    t, random = drive.tracks, np.random.default_rng(seed)
    behind = t.frame >= frame
    lasting = np.isin(t.track, np.intersect1d(t.track[behind], t.track[~behind]))
    found = (random.uniform(size=len(drive.points)) < again)[t.track]
    keep = ~behind | ~lasting | found
    wall = tube_drive(seed + 500, (len(drive.poses) - 1) * 0.05)
    o, swap = wall.tracks, np.isin(wall.tracks.track, np.unique(wall.tracks.track[wall.tracks.frame == frame]))
    swap &= (o.frame >= frame) & (random.uniform(size=len(wall.points)) >= again)[o.track]
    frames, tracks = o.frame[swap], o.track[swap]
    seen = np.einsum("nij,nj->ni", drive.poses[frames, :, :3], wall.points[tracks]) + drive.poses[frames, :, 3]
    pixels = drive.camera.project(seen)[0] + random.normal(0, 0.3, (len(frames), 2))
    count = len(drive.points)
    return pf.Tracks(
        np.concatenate([t.frame[keep], frames]),
        np.concatenate([np.where(behind, t.track + count, t.track)[keep], 2 * count + tracks]),
        np.concatenate([t.pixels[keep], pixels]),
    )


@pytest.mark.parametrize(("seed", "encoder"), [(81, True), (82, False)])
def test_a_drive_whose_tracks_all_broke_off_is_one_stretch_again(seed: int, encoder: bool) -> None:
    """Six of ten corners are found again, four are others."""
    drive = tube_drive(seed, 2.0)
    tracks = broken(drive, 20, 0.6, seed)
    rec = pf.reconstruct(tracks, drive.camera, drive.driven if encoder else None)
    assert rec.status == "ok" and not rec.gaps and len(rec.frames) == 41
    scale, turn, move = similarity(rec.centres, drive.centres)
    off = np.linalg.norm(scale * rec.centres @ turn.T + move - drive.centres, axis=1)
    assert off.max() < (0.005 if encoder else 0.02)
    # A corner's point is there once, under its first name.
    count = len(drive.points)
    lasting = np.intersect1d(tracks.track[tracks.frame == 19], tracks.track[tracks.frame == 20] - count)
    once = np.isin(lasting, rec.track) & ~np.isin(lasting + count, rec.track)
    assert len(lasting) > 20 and once.mean() > 0.6


def renamed_at(drive: Drive, *frames: int) -> Drive:
    """The drive with other names for all tracks from each of these frames on; all corners are found again."""
    t, points = drive.tracks, np.tile(drive.points, (len(frames) + 1, 1))
    number = np.searchsorted(frames, t.frame, side="right")
    tracks = pf.Tracks(t.frame, t.track + number * len(drive.points), t.pixels)
    return dataclasses.replace(drive, tracks=tracks, points=points)


def test_a_corner_that_is_in_sight_over_two_breaks_is_one() -> None:
    drive = tube_drive(82, 2.0, limits=(12.0, 89.0))
    count, seen = len(drive.points), drive.tracks
    rec = pf.reconstruct(renamed_at(drive, 18, 22).tracks, drive.camera, drive.driven)
    assert rec.status == "ok" and len(rec.frames) == 41
    over = np.intersect1d(seen.track[seen.frame == 17], seen.track[seen.frame == 22])
    once = np.isin(over, rec.track) & ~np.isin(over + count, rec.track) & ~np.isin(over + 2 * count, rec.track)
    assert len(over) > 200 and once.mean() > 0.6


def test_what_joined_tracks_saw_is_in_the_residuals(tmp_path: Path) -> None:
    """And with them in the report's charts and the COLMAP model."""
    drive = renamed_at(tube_drive(82, 2.0), 20)
    m = measure(Survey.open(survey_of(drive, tmp_path / "a.mcap")), pictures=False)
    assert m.structure.status == "ok" and len(m.structure.joined) > 50
    of_joined = np.isin(m.tracks.track, m.structure.joined[:, 0])
    there = np.isin(np.flatnonzero(of_joined), m.residuals.item)
    assert of_joined.sum() > 200 and there.mean() > 0.95
    joined = np.isin(m.residuals.item, np.flatnonzero(of_joined))
    assert m.residuals.inlier[joined].mean() > 0.98


@pytest.mark.parametrize("seed", [83, 84])
def test_what_is_behind_a_break_is_not_joined_to_a_wall_that_is_not_there(seed: int) -> None:
    """As many corners, none of them the same: chance finds some near each place."""
    drive = tube_drive(seed, 2.0)
    tracks = broken(drive, 20, 0.0, seed)
    rec = pf.reconstruct(tracks, drive.camera, drive.driven)
    assert rec.status == "partial" and [(g.first, g.last, g.reason) for g in rec.gaps] == [(19, 20, "weak_texture")]
