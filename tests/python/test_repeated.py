"""A wall that looks the same again and again: told from pictures, and tracks that jumped to the next repeat are cut."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish import pipefish_pb2 as pb
from pipefish.measure import measure
from pipefish.measured_remarks import _repeated_remark, not_measured
from pipefish.measurement import Measurement
from pipefish.repeated import renamed
from pipefish.structure import Gap
from pipefish.survey import Survey
from pipefish.surveywrite import OBJECT_KEYFRAME
from synthetic import as_object, write_survey
from test_reconstruct_cli import objects_of
from test_water import seen_from
from tube_tracks import Drive, fisheye, tube_drive

PERIOD, GRAIN, RADIUS = 0.06, 0.006, 0.15
JUMP = 10  # the frame from which on
COUNT = 32  # corners to a period


def texture(seed: int, period: float) -> np.ndarray:
    """Grey of the wall at multiples of GRAIN along (so many to a period) and around."""
    return np.random.default_rng(seed).uniform(40, 220, (round(period / GRAIN), round(2 * np.pi * RADIUS / GRAIN)))


def photograph(camera: pf.Camera, rays: np.ndarray, pose: np.ndarray, grain: np.ndarray) -> bytes:
    """The wall of a round pipe along z as the camera sees it along the rays of all its pixels (n,3), NaN where there
    are none, between the grains' centres, as JPEG."""
    centre, d = -pose[:, :3].T @ pose[:, 3], rays @ pose[:, :3]
    a, b = (d[:, :2] ** 2).sum(1), d[:, :2] @ centre[:2]
    reach = (-b + np.sqrt(b**2 + a * (RADIUS**2 - centre[:2] @ centre[:2]))) / np.maximum(a, 1e-12)
    x = centre + reach[:, None] * d
    place = np.column_stack([x[:, 2] / GRAIN, (np.arctan2(x[:, 1], x[:, 0]) % (2 * np.pi)) * RADIUS / GRAIN])
    ok = np.isfinite(place).all(1) & (reach < 1.0)
    place[~ok] = 0.0
    low, part = np.floor(place).astype(int), place - np.floor(place)
    grey = np.zeros(len(x))
    for i, j in np.ndindex(2, 2):
        weight = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1])
        grey += weight * grain[(low[:, 0] + i) % grain.shape[0], (low[:, 1] + j) % grain.shape[1]]
    grey = np.where(ok, grey, 0).reshape(camera.height, camera.width)
    out = io.BytesIO()
    Image.fromarray(grey.astype(np.uint8), "L").save(out, "JPEG", quality=92)
    return out.getvalue()


def repeating() -> Drive:
    """A drive through a round pipe whose corners repeat along it, a camera of 320 pixels."""
    camera = fisheye(95, size=320, f_u=94.0, f_v=94.0)
    drive = tube_drive(31, 1.0, camera=camera, ovality=0.0)
    random, repeats = np.random.default_rng(9), np.arange(-2, 32)
    z, phi = random.uniform(0, PERIOD, COUNT), random.uniform(0, 2 * np.pi, COUNT)
    z, phi = (z + PERIOD * repeats[:, None]).ravel(), np.tile(phi, len(repeats))
    points = np.column_stack([RADIUS * np.cos(phi), RADIUS * np.sin(phi), z])
    return seen_from(drive, points, drive.poses, 9)


def jumped(drive: Drive) -> Drive:
    """From a frame on the tracks that were there before are of the next repeat: COUNT points further."""
    t = drive.tracks
    old = np.isin(t.track, np.unique(t.track[t.frame < JUMP])) & (t.frame >= JUMP)
    after = drive.points[np.minimum(t.track + COUNT, len(drive.points) - 1)]
    poses = drive.poses[t.frame]
    uv, ok = drive.camera.project(np.einsum("nij,nj->ni", poses[:, :, :3], after) + poses[:, :, 3])
    pixels = np.where(old[:, None], uv, t.pixels)
    keep = ~old | ok
    return Drive(
        drive.camera, drive.poses, drive.points, pf.Tracks(t.frame[keep], t.track[keep], pixels[keep]), drive.driven, ok
    )


def measured(drive: Drive, grain: np.ndarray, path: Path, silent: int | None = None) -> Measurement:
    """silent: a keyframe without an encoder's reading."""
    objects, camera = [], drive.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    rays, ok = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    rays[~ok] = np.nan
    for name, kind, data in objects_of(drive):
        if kind == OBJECT_KEYFRAME:
            message = pb.Keyframe.FromString(data)
            message.jpeg = photograph(camera, rays, drive.poses[message.index], grain)
            if message.index == silent:
                message.telemetry.ClearField("encoder_count")
            name, kind, data = as_object(kind, message)
        objects.append((name, kind, data))
    write_survey(path, objects=objects)
    return measure(Survey.open(path))


def test_tracks_that_went_on_to_the_next_repeat_are_cut_and_told(tmp_path) -> None:
    """All of them at one keyframe: a rigid scene, small residuals, and 60 mm that the camera did not drive back. That
    another one's encoder said nothing is no matter."""
    drive = repeating()
    m = measured(jumped(drive), texture(1, PERIOD), tmp_path / "a.mcap", silent=3)
    assert np.isnan(m.encoder[3])
    assert m.repeats.alarm and m.repeats.share > 0.6 and m.repeats.period == pytest.approx(PERIOD, abs=0.004)
    assert m.jumped == [JUMP]
    at = [np.linalg.norm(m.structure.centres[i] - m.structure.centres[0]) for i in range(len(m.structure.frames))]
    assert at == pytest.approx(drive.driven[m.structure.frames], abs=0.02)
    (told,) = [r for r in m.remarks if "next repeat" in r]
    assert "mm further along the pipe" in told and f"keyframe {JUMP}" in told
    gap = next(g for g in not_measured(m) if g["reason"] == "repeated_pattern")
    assert gap["start"] == pytest.approx(0.05 * JUMP, abs=0.2) and m.measured
    # Without a jump: agreement is said of the steps alone that were compared.
    m.jumped, steps = [], int((np.diff(m.structure.segment) == 0).sum())
    (told,) = _repeated_remark(m)
    assert f"agree about the {steps - 2} of {steps} steps" in told
    m.encoder = np.full(len(m.encoder), np.nan)
    (told,) = _repeated_remark(m)
    assert "agree" not in told and "nobody knows" in told


def test_a_wall_that_does_not_repeat_is_believed(tmp_path) -> None:
    drive = repeating()
    m = measured(drive, texture(2, 2.4), tmp_path / "a.mcap")
    assert m.repeats.places > 60 and m.repeats.share < 0.1 and not m.repeats.alarm and not m.jumped
    assert not any("same again" in r for r in m.remarks)


def test_a_gap_that_holds_the_cut_is_told_as_one_and_no_other() -> None:
    gaps = [Gap(first, last, "weak_texture", 0) for first, last in ((2, 9), (9, 10), (9, 11), (10, 12))]
    reasons = [g.reason for g in renamed(gaps, [JUMP])]
    assert reasons == ["weak_texture", "repeated_pattern", "repeated_pattern", "weak_texture"]
