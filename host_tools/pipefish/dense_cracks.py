"""Cracks in the wall: long thin dark lines on it that wander, with place, length, width and what the map of deviations
tells of their edges. docs/matching.md tells method and accuracy."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipefish.camera import Camera
from pipefish.dense_lines import HALF, Dark, dark_lines
from pipefish.dense_regions import wrapped_box
from pipefish.dense_unroll import Unroller, keyframe_picture
from pipefish.errors import ArgumentError
from pipefish.wallmodel import Floats

if TYPE_CHECKING:
    from pipefish.dense import DenseWall

THETA_LEAST = math.radians(50)  # off the axis: nearer to it a pixel covers 1.7 times as much along the wall
STRIDE = 0.06  # diameters between the keyframes that are looked at
STRONG, UNUSUAL = (
    0.35,
    4.0,
)  # cells of missing light, and times what is usual around: a crack has both on most of its way
LEAST = 0.2  # diameters: shorter ones are not told
NEAR, BRIDGED, BEND = 4.0, 14.0, math.radians(30)  # cells between neighbours, cells of gap, turn of a line over it
ROUND, SECTORS = 2.5, 72  # cells off a plane; parts of the turn, half of which a joint shows in
ALIGNED, ALIGNED_OVER, ALIGNED_SHARE = math.radians(8), 12, 0.62  # of the pipe's own directions; cells; of a line


def find_cracks(
    found: DenseWall,
    images: Callable[[int], Any],
    camera: Camera,
    poses: Any,
    *,
    tell: Callable[[float], None] | None = None,
) -> list[dict[str, Any]]:
    """Cracks in a wall that was measured by dense_wall from the same images, camera and poses. Longest first:

    s, clock         of its middle; path (n,2): s and clock along it, clock going on beyond a turn
    sigma            of its place, across it
    length, length_sigma   along it
    width, width_sigma     of black that would take as much light, mean along it: cracks are not quite black, so they
                     are as wide or wider
    extent_s, extent_clock   what it spans, length and radians
    direction        "along" the pipe, "around" it or "oblique", by which of the two is over twice the other
    views            keyframes that show a place of it, median
    offset, offset_sigma   by how much more the wall stands out on the side of greater clock (of greater s, for one
                     around the pipe); None where the map has too little beside it

    A line counts that most of the keyframes which see it show in the same place, a fifth of the diameter long or more,
    dark as a third of a cell of black or more and as four times what the wall's texture has of such around. Joints
    (planes around half of the pipe or more) are left out, and in masonry (four lines or more that keep to the pipe's
    own directions) whatever keeps to them, and lines under 0.4 diameters. Raises ArgumentError."""
    pose_list = np.asarray(poses, float)
    if pose_list.ndim != 3 or pose_list.shape[1:] != (3, 4) or not np.isfinite(pose_list).all():
        raise ArgumentError(f"poses: shape {pose_list.shape} is not (n,3,4), or not finite")
    unroller = Unroller(camera, found.wall, 1.0, theta_least=THETA_LEAST, relief=_relief(found))
    views = _spread(unroller, pose_list)
    pictures = partial(keyframe_picture, images, camera)
    dark = dark_lines(unroller, pictures, pose_list, views, tell or (lambda done: None))
    dark = without_rings(dark, unroller.columns)
    lines = [line for line in chains(dark, unroller) if len(line) > 2]
    lines = without_masonry(lines, dark, unroller)
    cracks = [_record(found, unroller, dark, line) for line in lines]
    return sorted(cracks, key=lambda c: -c["length"])


def _relief(found: DenseWall) -> Callable[[Floats, Floats], Floats]:
    """How far outside the tube the measured wall is at places: the map, smoothed over 3 x 3 cells, bilinear; 0 where
    nothing is known near."""
    known = np.isfinite(found.deviation)
    total, weight = (wrapped_box(np.where(known, v, 0.0)) for v in (found.deviation, 1.0))
    value = total / np.maximum(weight, 1)
    rows, columns = value.shape

    def at(s: Floats, clock: Floats) -> Floats:
        y = np.clip(s / found.wall.length * rows - 0.5, 0, rows - 1)
        x = np.asarray(clock) / (2 * np.pi) * columns - 0.5
        i, j = np.minimum(y.astype(int), max(rows - 2, 0)), np.floor(x).astype(int)
        t, u, k = y - i, x - j, np.minimum(i + 1, rows - 1)
        j, right = j % columns, (j + 1) % columns
        return (1 - t) * ((1 - u) * value[i, j] + u * value[i, right]) + t * (
            (1 - u) * value[k, j] + u * value[k, right]
        )

    return at


def _spread(unroller: Unroller, poses: Floats) -> list[int]:
    """Keyframes that see the wall, STRIDE or more apart."""
    seen = [k for k, pose in enumerate(poses) if np.diff(unroller.rows(pose))[0] >= 4 * HALF]
    centres = np.array([-poses[k, :, :3].T @ poses[k, :, 3] for k in seen]).reshape(-1, 3)
    s = unroller.wall.locate(centres)[0] / (2 * unroller.wall.mean_radius)
    out, last = [], -np.inf
    for n in np.argsort(s, kind="stable"):
        if s[n] - last >= STRIDE:
            out.append(seen[n])
            last = s[n]
    return out


# ---- from cells to lines


def _turned(a: Any, b: Any) -> Floats:
    """Between directions of lines, 0 to a quarter turn."""
    d = np.abs(np.asarray(a) - b) % np.pi
    return np.minimum(d, np.pi - d)


def without_rings(dark: Dark, columns: int) -> Dark:
    """Without the joints: planes through the pipe that show on half of the turn or more."""
    around = np.flatnonzero(_turned(dark.turn, 0.0) < math.radians(20))
    keep = np.ones(len(dark), bool)
    while len(around):
        rows = np.bincount(dark.y[around].astype(int) // 8)
        total = rows + np.append(rows[1:], 0)
        k = int(total.argmax())
        near = around[np.abs(dark.y[around] - 8 * (k + 1)) < 24]
        off = np.full(len(near), np.inf)
        if len(near) >= SECTORS // 2:
            angle = dark.x[near] * 2 * np.pi / columns
            plane = np.column_stack([np.ones(len(near)), np.cos(angle), np.sin(angle)])
            centre = np.array([np.median(dark.y[near]), 0.0, 0.0])
            for _ in range(10):
                weight = 1 / (1 + ((dark.y[near] - plane @ centre) / ROUND) ** 2)
                h = (plane * weight[:, None]).T @ plane + 1e-6 * np.eye(3)
                centre = np.linalg.solve(h, plane.T @ (weight * dark.y[near]))
            off = np.abs(dark.y[near] - plane @ centre)
        on = near[off < ROUND]
        sectors = np.unique((dark.x[on] / columns * SECTORS).astype(int))
        if 2 * len(sectors) < SECTORS:
            # No other band of rows can hold a ring if the fullest of what is left does not.
            if len(near) < SECTORS // 2:
                break
            around = around[np.abs(dark.y[around] - 8 * (k + 1)) >= 8]
            continue
        angle = dark.x * 2 * np.pi / columns
        ring = np.abs(dark.y - np.column_stack([np.ones(len(dark)), np.cos(angle), np.sin(angle)]) @ centre)
        keep &= ring >= 2 * ROUND
        around = around[ring[around] >= 2 * ROUND]
    return dark.where(keep)


def _edges(dark: Dark, columns: int) -> tuple[NDArray[np.int64], Floats]:
    """Pairs (k,2) of cells that follow each other on a line, and their distances: neighbours, and over gaps what lies
    ahead of both."""
    wide = columns / max(1, int(columns / BRIDGED))
    across, rows = round(columns / wide), int(dark.y.max() / BRIDGED) + 1
    bin_x, bin_y = np.minimum((dark.x / wide).astype(int), across - 1), (dark.y / BRIDGED).astype(int)
    order = np.argsort(bin_y * across + bin_x, kind="stable")
    start = np.searchsorted((bin_y * across + bin_x)[order], np.arange(rows * across + 1))
    members = [order[a:b] for a, b in itertools.pairwise(start)]
    pairs, sizes = [], []
    for n in np.unique(bin_y * across + bin_x).tolist():
        i, j = divmod(n, across)
        for di, dj in ((0, 0), (0, 1), (1, -1), (1, 0), (1, 1)):
            if i + di >= rows:
                continue
            there = members[(i + di) * across + (j + dj) % across]
            one, two = (v.ravel() for v in np.meshgrid(members[n], there, indexing="ij"))
            if (di, dj) == (0, 0):
                one, two = one[one < two], two[one < two]
            dx = (dark.x[two] - dark.x[one] + columns / 2) % columns - columns / 2
            dy = dark.y[two] - dark.y[one]
            far, heading = np.hypot(dx, dy), np.arctan2(dy, dx)
            ahead = np.maximum(_turned(heading, dark.turn[one]), _turned(heading, dark.turn[two])) < BEND
            good = (far < NEAR) | ((far < BRIDGED) & ahead)
            pairs.append(np.column_stack([one, two])[good])
            sizes.append(far[good])
    return np.concatenate(pairs), np.concatenate(sizes)


def chains(dark: Dark, unroller: Unroller) -> list[NDArray[np.int64]]:
    """Each a chain of cells, from one end to the other: the longest way through what hangs together, then the longest
    of what branches off."""
    if not len(dark):
        return []
    pairs, sizes = _edges(dark, unroller.columns)
    # A way over a gap is longer than one through the cells of the line, so that none is left out.
    sizes = np.where(sizes < NEAR, sizes, 1.5 * sizes)
    neighbours: list[list[tuple[int, float]]] = [[] for _ in range(len(dark))]
    for (a, b), far in zip(pairs.tolist(), sizes.tolist(), strict=True):
        neighbours[a].append((b, far))
        neighbours[b].append((a, far))
    least = LEAST * 2 * unroller.wall.mean_radius / unroller.cell
    left, strong = np.ones(len(dark), bool), _strong(dark)
    out = []
    for seed in np.argsort(-dark.width, kind="stable").tolist():
        if not left[seed] or not strong[seed]:
            continue
        while left[seed]:
            far, _ = _ways(seed, neighbours, left)
            end = max(far, key=lambda n: (far[n], n))
            far, before = _ways(end, neighbours, left)
            other = max(far, key=lambda n: (far[n], n))
            line = [other]
            while line[-1] != end:
                line.append(before[line[-1]])
            chain = np.array(line)
            whole = np.fromiter(far, int)
            if far[other] < least:
                left[whole] = False
                break
            if _convinces(dark, chain, unroller.columns):
                out.append(chain)
            # Beside the line lie cells of the same.
            left[whole[_beside(dark, whole, chain, unroller.columns)]] = False
    return out


def _beside(dark: Dark, cells: NDArray[np.int64], chain: NDArray[np.int64], columns: int) -> NDArray[np.bool_]:
    """Which cells are less than NEAR from one of the chain's (itself included); by bins, in time linear in both."""
    across = max(1, int(columns / NEAR))

    def bins(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return np.minimum((dark.x[rows] / columns * across).astype(int), across - 1), (dark.y[rows] // NEAR).astype(int)

    x, y = bins(chain)
    order = np.argsort(y * across + x, kind="stable")
    keys, chain = (y * across + x)[order], chain[order]
    x, y = bins(cells)
    near = np.zeros(len(cells), bool)
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        there = (y + i) * across + (x + j) % across
        first, last = np.searchsorted(keys, there), np.searchsorted(keys, there, "right")
        for k in range(int((last - first).max(initial=0))):
            asked = np.flatnonzero(first + k < last)
            other = chain[first[asked] + k]
            dx = (dark.x[cells[asked]] - dark.x[other] + columns / 2) % columns - columns / 2
            near[asked] |= np.hypot(dx, dark.y[cells[asked]] - dark.y[other]) < NEAR
    return near


def _ways(
    start: int, neighbours: list[list[tuple[int, float]]], left: NDArray[np.bool_]
) -> tuple[dict[int, float], dict[int, int]]:
    """The shortest ways to all that hang together with `start`: lengths, and the cell before each."""
    far, before, done = {start: 0.0}, {start: start}, set()
    heap = [(0.0, start)]
    while heap:
        d, n = heapq.heappop(heap)
        if n in done:
            continue
        done.add(n)
        for m, step in neighbours[n]:
            if left[m] and d + step < far.get(m, math.inf):
                far[m], before[m] = d + step, n
                heapq.heappush(heap, (d + step, m))
    return far, before


def _steps(dark: Dark, chain: NDArray[np.int64], columns: int) -> tuple[Floats, Floats]:
    """x, going on beyond the turn, and y of a chain, smoothed over 5 of its cells."""
    dx = (np.diff(dark.x[chain]) + columns / 2) % columns - columns / 2
    x, y = dark.x[chain[0]] + np.r_[0, np.cumsum(dx)], dark.y[chain]
    reach = np.minimum(2, np.minimum(np.arange(len(x)), np.arange(len(x))[::-1]))
    low, high = np.arange(len(x)) - reach, np.arange(len(x)) + reach + 1
    sums = [np.r_[0, np.cumsum(v)] for v in (x, y)]
    return tuple((s[high] - s[low]) / (high - low) for s in sums)  # type: ignore[return-value]


def _strong(dark: Dark) -> NDArray[np.bool_]:
    return dark.width >= np.maximum(STRONG, UNUSUAL * dark.usual)


def _convinces(dark: Dark, chain: NDArray[np.int64], columns: int) -> bool:
    """Dark enough on most of its way, most of which is seen."""
    x, y = _steps(dark, chain, columns)
    step = np.hypot(np.diff(x), np.diff(y))
    dark_enough = _strong(dark)[chain]
    strong = dark_enough[1:] & dark_enough[:-1]
    gap = step > NEAR
    return bool(step[strong & ~gap].sum() >= 0.5 * step.sum() and step[gap].sum() <= 0.3 * step.sum())


def without_masonry(lines: list[NDArray[np.int64]], dark: Dark, unroller: Unroller) -> list[NDArray[np.int64]]:
    """The lines; where four or more of them keep to the pipe's own directions, as between bricks, none of those, and
    of the others those that are twice as long as else asked: stairs of joints with a worn brick or two are shorter."""
    columns = unroller.columns
    aligned = [aligned_share(dark, line, columns) > ALIGNED_SHARE for line in lines]
    if sum(aligned) < 4:
        return lines
    least = 2 * LEAST * 2 * unroller.wall.mean_radius / unroller.cell
    return [
        line
        for line, is_aligned in zip(lines, aligned, strict=True)
        if not is_aligned and _long(dark, line, columns) > least
    ]


def _long(dark: Dark, line: NDArray[np.int64], columns: int) -> float:
    x, y = _steps(dark, line, columns)
    return float(np.hypot(np.diff(x), np.diff(y)).sum())


def aligned_share(dark: Dark, line: NDArray[np.int64], columns: int) -> float:
    """Of the chords of 12 cells along a line, the share that runs along or around the pipe to 8 degrees: 0.7 and more
    of what mortar shows, stairs over bricks included, 0.5 of cracks along the pipe, which wander."""
    x, y = _steps(dark, line, columns)
    way = np.r_[0, np.cumsum(np.hypot(np.diff(x), np.diff(y)))]
    at = np.arange(0, max(way[-1] - ALIGNED_OVER, 1), 1.0)
    chord = [np.interp(at + ALIGNED_OVER, way, v) - np.interp(at, way, v) for v in (x, y)]
    angle = np.arctan2(*chord) % (np.pi / 2)
    return float(np.mean(np.minimum(angle, np.pi / 2 - angle) < ALIGNED))


# ---- what is told of them


def _record(found: DenseWall, unroller: Unroller, dark: Dark, line: NDArray[np.int64]) -> dict[str, Any]:
    x, y = _steps(dark, line, unroller.columns)
    s, clock = unroller.s(y), (x + 0.5) * 2 * np.pi / unroller.columns
    radius = found.wall.radius(s, clock)
    step = np.hypot(np.diff(s), 0.5 * (radius[1:] + radius[:-1]) * np.diff(clock))
    way = np.r_[0, np.cumsum(step)]
    if clock[-1] < clock[0]:
        s, clock, way = s[::-1], clock[::-1], way[-1] - way[::-1]
    around = float(np.ptp(clock))
    extents = float(np.ptp(s)), around * float(radius.mean())
    places = np.linspace(0, way[-1], max(2, min(60, round(way[-1] / (8 * unroller.cell)))))
    cell = unroller.cell
    offset, offset_sigma = _offset(found, s, clock, way, extents)
    return {
        "s": float(np.interp(way[-1] / 2, way, s)),
        "clock": float(np.interp(way[-1] / 2, way, clock)) % (2 * math.pi),
        "sigma": cell * float(np.median(dark.place[line])),
        "length": float(way[-1]),
        "length_sigma": cell * HALF * math.sqrt(2 / 3),  # either end may be off by the filter's reach
        "width": cell * float(np.median(dark.width[line])),
        "width_sigma": cell * float(np.median(dark.spread[line])),
        "extent_s": extents[0],
        "extent_clock": around,
        "direction": "along" if extents[0] > 2 * extents[1] else "around" if extents[1] > 2 * extents[0] else "oblique",
        "views": float(np.median(dark.views[line])),
        "offset": offset,
        "offset_sigma": offset_sigma,
        "path": np.column_stack([np.interp(places, way, s), np.interp(places, way, clock)]).tolist(),
    }


def _offset(
    found: DenseWall, s: Floats, clock: Floats, way: Floats, extents: tuple[float, float]
) -> tuple[float | None, float | None]:
    """The median of how much further out the map's wall is beyond the line than before it, by clock (by s, for one that
    goes around), 1.5 to 4 of the map's cells off; its sigma, every fourth cell of the map counted as one place."""
    rows, columns = found.deviation.shape
    cell = (found.wall.length / rows, 2 * np.pi / columns)
    places = np.arange(0, way[-1], cell[0])
    y = np.interp(places, way, s) / cell[0]
    x = np.interp(places, way, clock) / cell[1]
    by_s = extents[1] > extents[0]
    sides = []
    for sign in (-1, 1):
        at = []
        for k in np.arange(2, 5):
            i = np.floor(y + sign * k * by_s).astype(int)
            j = np.floor(x + sign * k * (not by_s)).astype(int) % columns
            inside = (i >= 0) & (i < rows)
            at.append(np.where(inside, found.deviation[i.clip(0, rows - 1), j], np.nan))
        known = np.isfinite(at)
        sides.append(np.where(known.any(axis=0), np.nansum(at, axis=0) / np.maximum(known.sum(axis=0), 1), np.nan))
    step = sides[1] - sides[0]
    step = step[np.isfinite(step)]
    if len(step) < 8:
        return None, None
    spread = 1.4826 * float(np.median(np.abs(step - np.median(step))))
    sigma = 1.25 * max(spread, float(np.nanmedian(found.sigma))) / math.sqrt(len(step) / 4)
    return float(np.median(step)), sigma
