"""How wide a joint stands open, in the unrolled picture: no tracks begin beside so dark an edge, and what lies in the
gap moves unlike the wall, but it is a dark ring with two sharp edges all around."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipefish.errors import PipefishError
from pipefish.unroll import Unroller
from pipefish.wall import measured_wall

if TYPE_CHECKING:
    from pipefish.measurement import Measurement

SECTORS = 36
MOST = 2 / 3  # of the sectors that must show it
REACH = 0.15  # diameters to both sides of a joint that are looked at; its place is known to a twentieth
DARK = 0.7  # of the wall's grey beside it, at most
ALIKE = 4  # neighbouring sectors show the same view and the same light
EDGE = 0.5  # pixels of the pictures to which one of its edges is known


class Ring(NamedTuple):
    """A dark ring: middle, width and the width's sigma, metres."""

    middle: float
    width: float
    sigma: float


def _dark_run(profile: np.ndarray, x: np.ndarray, at: float, near: float) -> tuple[float, float] | None:
    """The edges, at half the depth, of the dark stretch of a profile that lies nearest to `at`."""
    wall = float(np.median(profile))
    inside = np.abs(x - at) < near
    dark = float(np.partition(profile[inside], 2)[2])  # one or two columns are noise
    level = 0.5 * (wall + dark)
    if dark > DARK * wall:
        return None
    edges = np.flatnonzero(np.diff(np.r_[0, profile < level, 0]))
    runs = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a > 0 and b < len(x)]
    if not runs:
        return None
    a, b = min(runs, key=lambda r: (max(0.0, x[r[0]] - at, at - x[r[1] - 1]), r[0] - r[1]))
    first, last = (
        float(x[i - 1] + (level - profile[i - 1]) / (profile[i] - profile[i - 1]) * (x[i] - x[i - 1])) for i in (a, b)
    )
    return (first, last) if first < at + near and last > at - near else None


def find_ring(grey: np.ndarray, seen: np.ndarray, x: np.ndarray, at: float, near: float, pixel: float) -> Ring | None:
    """grey, seen: (rows around, columns along) of an unrolled picture; x: of its columns, metres; at, near: where the
    ring must lie; pixel: metres that one of the pictures shows. None where it is not seen most of the way around, or
    its edges are not where they are elsewhere."""
    sector = np.arange(len(grey)) * SECTORS // len(grey)
    found = []
    for k in range(SECTORS):
        rows = (sector == k) & (seen.min(axis=1) > 0)
        if rows.any():
            run = _dark_run(np.median(grey[rows], axis=0), x, at, near)
            found += [run] if run else []
    if len(found) < MOST * SECTORS:
        return None
    ends = np.array(found)
    typical = np.median(ends, axis=0)
    width = float(typical[1] - typical[0])
    sound = (np.abs(ends - typical) < max(0.25 * width, 2 * pixel)).all(axis=1)
    if sound.sum() < MOST * SECTORS or width < 2 * pixel:
        return None
    middle, scatter = float(ends[sound].mean()), float(np.std(ends[sound, 1] - ends[sound, 0]))
    sigma = math.hypot(scatter / math.sqrt(sound.sum() / ALIKE), math.sqrt(2) * EDGE * pixel)
    return Ring(middle, float(np.mean(ends[sound, 1] - ends[sound, 0])), sigma)


def tell_gaps(m: Measurement) -> None:
    """Gives each joint without a gap that of the dark ring beside it, with its place, where there is one."""
    from pipefish.measured_files import document_of

    wall = None
    for stretch in m.measured:
        for event in stretch.tube.events:
            if event["kind"] != "joint" or event.get("gap") is not None:
                continue
            wall = wall or measured_wall(m, document_of(m))
            at, reach = float(stretch.chainage(event["s"])), REACH * wall.diameter
            try:
                unroller = Unroller(wall, span=(at - reach, at + reach))
            except PipefishError:  # no keyframe shows it
                continue
            drawn = unroller.draw()
            x = unroller.chainage(np.arange(unroller.columns))
            ring = find_ring(drawn.grey, drawn.seen, x, at, reach / 3, unroller.resolution)
            if ring is not None:
                event["s"] += stretch.sign * (ring.middle - at)
                event.update(s_sigma=ring.sigma, gap=ring.width, gap_sigma=ring.sigma)
