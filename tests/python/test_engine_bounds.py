"""What gets past Python's own checks and does not fit together is refused by the engine, before it touches memory."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pipefish as pf
from pipe_cloud import Pipe
from pipefish import _engine
from tube_tracks import fisheye

CAMERA = fisheye()._profile
INT, LONG = np.int32, np.int64


def pixels(count: int) -> np.ndarray:
    return np.random.default_rng(count).uniform(300, 700, (count, 2))


def reconstruct(frames: int = 3, tracks: int = 4, **changed: Any) -> Any:
    """Four tracks through three frames."""
    frame, track = np.repeat(np.arange(3, dtype=INT), 4), np.tile(np.arange(4, dtype=INT), 3)
    arguments = dict(
        camera=CAMERA, frames=frames, tracks=tracks, frame=frame, track=track, uv=pixels(12), covariance=None,
        sigma=0.3, method="hierarchical", seed=0, threads=1, still=0.5, step=None, step_sigma=None, scale_sigma=0.003,
        down=None, down_sigma=0.01, uncertain=[], uncertainty=None, drifting=[], drift=None, drift_noise=1.0,
        common_errors=False, sag_sigma=0.0, frame_time=None, line_time=0.0, middle_row=0.0,
        pupil_sigma=0.0, radius=0.0,
    )  # fmt: skip
    return _engine.reconstruct(**(arguments | changed))


def adjust(poses: int, frame: int) -> Any:
    pose = np.tile(np.eye(3, 4), (poses, 1, 1))
    at = np.array([0, frame], INT), np.zeros(2, INT)
    return _engine.adjust(CAMERA, pose, np.ones((1, 3)), *at, pixels(2), 0.3, 5)


def row_poses(segment: list[int], place: int) -> Any:
    poses = np.tile(np.eye(3, 4), (3, 1, 1))
    return _engine.row_poses(poses, np.array(segment, INT), np.arange(3.0), np.array([place], INT), np.array([0.1]))


def two_view(second: int, covariances: int) -> Any:
    covariance = np.tile(np.eye(2), (covariances, 1, 1))
    return _engine.two_view(CAMERA, CAMERA, pixels(20), pixels(second), covariance, None, 0.3, 0)


PICTURE = np.random.default_rng(0).random((40, 50), np.float32)
MATCHES = (pixels(5), pixels(5), np.tile(np.eye(2), (5, 1, 1)), np.full(5, 0.9))


def grow(radius: int = 5, classes: int = 1024, maps: int = 5, picture: np.ndarray = PICTURE) -> Any:
    options = _engine.MatchOptions()
    options.radius, options.classes = radius, classes
    affine = np.tile(np.eye(2), (maps, 1, 1))
    return _engine.grow_matches(picture, picture, MATCHES[0], MATCHES[1], affine, options, None, None, None)


def group(cell: int = 5, at: float = 10.0) -> Any:
    options = _engine.GroupOptions()
    options.cell = cell
    return _engine.group_matches(np.full((5, 2), at), *MATCHES[1:], options)


def support(triangles: list[list[int]], groups: int = 1, height: int = 40) -> Any:
    return _engine.group_support(pixels(5), np.array(triangles, LONG), np.zeros(groups, LONG), 0, height, 50, 1.0)


def segment(label: list[int], triangles: list[list[int]], of: list[int]) -> Any:
    planes = PICTURE[None].copy()
    groups = np.array(label, LONG), np.array(triangles, LONG).reshape(-1, 3), np.array(of, LONG)
    return _engine.segment(planes, planes, *MATCHES, *groups, _engine.SegmentOptions(), lambda share: None)


def expand(label: int = 0, partner: int = -1, pixels: int = 16, width: int = 4, alpha: int = 1) -> Any:
    cost, weight = np.zeros((3, 16), INT), np.zeros((2, 8, 4), INT)
    labels = np.full(pixels, label, np.uint8)
    return _engine.segment_expand(cost, width, weight, np.full((3, 16), partner, INT), 1, alpha, labels)


@cache
def tube() -> Any:
    return pf.fit_tube(Pipe().points(1500))


def surface(centres: int = 5, radii: int = 5, **changed: Any) -> Any:
    arguments = dict(
        points=Pipe().points(300), noise=None, centres=np.column_stack([np.zeros((centres, 2)), np.arange(centres)]),
        rho=[0.15] * radii, breaks=[], knot=0.25, order=2, rounds=2, smooth_only=False, ovality=0.03,
    )  # fmt: skip
    return _engine.tube_surface(**(arguments | changed))


def board(points: int = 4, codes: int = 0, kind: str = "circles", markers: int = 0) -> Any:
    none = np.zeros(0, np.uint8)
    return _engine.Board(
        kind, pixels(points), np.zeros((4, 2), INT), np.zeros(codes, np.uint8), np.eye(2), [2, 2], 0.01, 0.0, 5, 1,
        0.02, np.zeros((markers, 2)), none,
    )  # fmt: skip


def bundle(first: list[int], camera: int = 0) -> Any:
    return _engine.Bundle([camera, 0], [0, 0], [0, 1], first, np.zeros((8, 3)), pixels(8))


def sheet(columns: int = 4, nodes: int = 9) -> Any:
    balance = _engine.UnrollBalance()
    light = balance.solve(CAMERA, np.zeros(1))
    spots = np.zeros((nodes, 3, 3))
    none = [], np.zeros((0, 3, 4)), []
    return _engine.unroll_draw(CAMERA, *none, spots, columns, 4, 2, 0.01, light, 1.0, 0.1, 1.0, 0.1, 1)


@pytest.mark.parametrize(
    ("call", "what"),
    [
        (lambda: reconstruct(frames=2), "frame"),
        (lambda: reconstruct(frames=-1), "frames"),
        (lambda: reconstruct(tracks=3), "track"),
        (lambda: reconstruct(track=np.full(12, -1, INT)), "track"),
        (lambda: reconstruct(uv=pixels(11)), "uv"),
        (lambda: reconstruct(covariance=np.tile(np.eye(2), (11, 1, 1))), "covariance"),
        (lambda: reconstruct(step=np.zeros(2), step_sigma=np.ones(3)), "step"),
        (lambda: reconstruct(step=np.zeros(3), step_sigma=np.ones(2)), "step_sigma"),
        (lambda: reconstruct(down=np.zeros((2, 3))), "down"),
        (lambda: reconstruct(frame_time=np.zeros(2)), "frame_time"),
        (lambda: reconstruct(uncertain=[0, 1], uncertainty=np.eye(1)), "covariance"),
        (lambda: reconstruct(drifting=[41], drift=np.eye(1)), "parameter"),
        (lambda: adjust(poses=1, frame=0), "poses"),
        (lambda: adjust(poses=3, frame=3), "frame"),
        (lambda: row_poses([0, 1, 0], 1), "segment"),
        (lambda: row_poses([0, 0, 0], 3), "place"),
        (lambda: two_view(19, 20), "uv2"),
        (lambda: two_view(20, 19), "covariance1"),
        (lambda: _engine.turn_between(np.zeros((0, 3, 4)), np.zeros((1, 3, 4)), 0.5), "pose"),
        (lambda: _engine.sag(np.ones(2), np.ones(3), 300.0), "first"),
        (lambda: grow(radius=8), "radius"),
        (lambda: grow(classes=0), "classes"),
        (lambda: grow(maps=4), "affine"),
        (lambda: grow(picture=PICTURE[:0]), "picture"),
        (lambda: _engine.match_rivals(PICTURE, PICTURE, *MATCHES, 99, 1, None, None, None, np.eye(3)), "radius"),
        (lambda: group(cell=0), "cell"),
        (lambda: group(at=np.nan), "pixels"),
        (lambda: group(at=1e12), "pixels"),
        (lambda: support([[0, 1, 5]]), "position"),
        (lambda: support([[0, 1, -1]]), "position"),
        (lambda: support([[0, 1, 2]], groups=0), "triangle"),
        (lambda: support([[0, 1, 2]], height=-40), "height"),
        (lambda: segment([0] * 5, [[0, 1, 5]], [0]), "match"),
        (lambda: segment([0] * 4, [[0, 1, 2]], [0]), "label"),
        (lambda: segment([0] * 5, [[0, 1, 2]], []), "label"),
        (lambda: segment([0] * 5, [[0, 1, 2]], [-1]), "group"),
        (lambda: expand(label=3), "label"),
        (lambda: expand(alpha=3), "label"),
        (lambda: expand(partner=16), "partner"),
        (lambda: expand(pixels=15), "labels"),
        (lambda: expand(width=3), "width"),
        (lambda: _engine.mask_outlines(np.zeros((0, 5), np.uint8)), "mask"),
        (lambda: _engine.silhouette(np.zeros((1, 0, 5), np.float32), *[np.zeros((0, 5), np.uint8)] * 3), "picture"),
        (lambda: _engine.silhouette(np.zeros((6, 9, 9), np.float32), *[np.zeros((9, 9), np.uint8)] * 3), "picture"),
        (lambda: _engine.Prepared(PICTURE[:0], None, 100_000, 500), "picture"),
        (lambda: _engine.Prepared(PICTURE, None, 0, 500), "max_pixels"),
        (lambda: surface(radii=4), "rho"),
        (lambda: surface(breaks=[3.0, 1.0]), "breaks"),
        (lambda: surface(knot=0.0), "knot"),
        (lambda: surface(order=1), "order"),
        (lambda: surface(points=np.full((300, 3), np.inf)), "points"),
        (lambda: surface(noise=np.full(300, np.nan)), "noise"),
        (lambda: _engine.tube_find_cylinder(np.zeros((0, 3)), None, 1), "points"),
        (lambda: _engine.tube_trace(np.full((300, 3), 1e300), None, np.zeros((2, 3)), 1), "points"),
        (lambda: _engine.tube_trace(Pipe().points(300), None, np.full((2, 3), np.nan), 1), "path"),
        (lambda: tube().surface.stations([0.0], [9]), "piece"),
        (lambda: tube().surface.stations([0.0, 0.1], [0]), "piece"),
        (lambda: tube().surface.variance([0.0], [-1], np.zeros((1, 3))), "piece"),
        (lambda: tube().surface.steps(0.3, 0.0, 0.15), "every"),
        (lambda: tube().surface.medians(0.15, 0, 1, 0.1, 0.1), "k, every"),
        (lambda: tube().surface.medians(0.15, 5, 0, 0.1, 0.1), "k, every"),
        (lambda: board(points=5), "sites"),
        (lambda: board(kind="sleeve"), "code"),
        (lambda: board(markers=1), "marker_codes"),
        (lambda: _engine.find_outlines(np.zeros((0, 9), np.uint8)), "picture"),
        (lambda: bundle([0, 9, 8]), "bundle"),
        (lambda: bundle([0, 4, 8], camera=-1), "bundle"),
        (lambda: bundle([0, 4, 8]).set_sheets(np.zeros((8, 3)), np.zeros((7, 3)), np.zeros((8, 3))), "bundle"),
        (lambda: bundle([0, 4, 8]).parameter_slope(1), "camera"),
        (lambda: sheet(columns=-4), "spots"),
        (lambda: sheet(nodes=8), "spots"),
        (lambda: _engine.self_calibrate([pixels(9)], [pixels(8)], 9, 9, 4, 4, 1, 1, 1, 1, 1, 0, 1), "matches"),
    ],
)  # fmt: skip
def test_the_engine_refuses_what_does_not_fit_together(call: Callable[[], Any], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        call()


def test_a_picture_of_one_row_has_no_place_to_sample() -> None:
    """Nor has one of one column: its spline is a constant, and reads nothing beside it."""
    for shape in ((1, 9), (9, 1), (1, 1)):
        assert np.isnan(_engine.sample_image(np.ones(shape, np.float32), np.zeros((3, 2)))).all()


@pytest.mark.parametrize("side", [6, 7, 16])
def test_a_small_picture_of_one_grey_is_that_grey_between_its_pixels(side: int) -> None:
    """The spline's first coefficients are sums over 16 samples, mirrored at the other end where there are fewer."""
    values = _engine.sample_image(np.full((side, side), 0.5, np.float32), np.array([[2.5, 2.5]]))
    assert np.abs(values - 0.5).max() < 1e-6


def test_where_the_system_gives_no_more_threads_the_work_is_done_by_fewer() -> None:
    """Nine threads have stacks of 8 MB each; with the memory there is, three begin."""
    code = """
import resource, sys
from pipe_cloud import Pipe
from pipefish import _engine
points = Pipe().points(1500)
alone = _engine.tube_find_cylinder(points, None, 1)
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (30 << 20),) * 2)
among = _engine.tube_find_cylinder(points, None, 10)
assert all(repr(alone[key]) == repr(among[key]) for key in alone)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_tube_has_no_other_pieces_than_its_own() -> None:
    assert np.isfinite(tube().frames([0.1], [0])["centre"]).all()
    for s, piece in (([0.1], [9]), ([0.1], [-2]), ([0.1, 0.2], [0])):
        with pytest.raises(pf.ArgumentError, match="piece"):
            tube().frames(s, piece)
