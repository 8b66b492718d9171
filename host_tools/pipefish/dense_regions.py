"""What stands in or out of the wall, in a dense map of it."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipefish.dense_harmonics import fitted_harmonics, harmonics
from pipefish.wallmodel import Floats

if TYPE_CHECKING:
    from pipefish.dense import DenseWall

REGION_SIGMA, REGION_CELLS = 3.0, 12


def find_regions(found: DenseWall) -> list[dict[str, float]]:
    """Connected cells (12 or more) whose 3 x 3 neighbourhood stands over 3 sigma and a 500th of the diameter in or out
    of the ellipse through the wall half a diameter around, on its own side of found.steps: that leaves out what a
    tube's smoothness makes of ovality and bends. Largest volume first: s, clock (radians) of the middle; length
    (along), extent (around, radians); height (the 90th percentile, negative: it stands into the pipe); sigma of it;
    area; volume."""
    measured = np.isfinite(found.deviation)
    weight = np.where(measured, np.nan_to_num(found.sigma, nan=1.0) ** -2.0, 0)
    total = wrapped_box(weight)
    local = np.where(measured, found.deviation, 0) - ellipses(found)
    mean = wrapped_box(weight * local) / np.maximum(total, 1e-30)
    sigma = np.nan_to_num(found.sigma, nan=np.inf)  # neighbours share keyframes: their mean is hardly better than one
    off = measured & (np.abs(mean) > REGION_SIGMA * sigma) & (np.abs(mean) > found.wall.mean_radius / 250)
    out = []
    step = (found.s[1] - found.s[0] if len(found.s) > 1 else 1.0, found.clock[1] - found.clock[0])
    area = step[0] * step[1] * found.wall.mean_radius
    for sign in (-1, 1):
        for cells in _connected(off & (sign * mean > 0)):
            if len(cells) < REGION_CELLS:
                continue
            i, j = cells.T
            value = local[i, j]
            angle = found.clock[j]
            middle = np.arctan2(np.sin(angle).sum(), np.cos(angle).sum()) % (2 * np.pi)
            spread = (angle - middle + np.pi) % (2 * np.pi) - np.pi
            height = sign * float(np.percentile(sign * value, 90))
            out.append(
                {
                    "s": float(found.s[i].mean()),
                    "clock": float(middle),
                    "length": float(np.ptp(found.s[i]) + step[0]),
                    "extent": float(np.ptp(spread) + step[1]),
                    "height": height,
                    "sigma": float(np.median(found.sigma[i, j])),
                    "area": float(len(cells) * area),
                    "volume": float(value.sum() * area),
                }
            )
    return sorted(out, key=lambda r: -abs(r["volume"]))


def ellipses(found: DenseWall) -> Floats:
    """(rows, columns): mean, shift and ellipse through the cells a quarter diameter to either side, robustly, but not
    beyond a step of the pipe."""
    spacing = found.s[1] - found.s[0] if len(found.s) > 1 else 1.0
    half = max(1, round(0.5 * found.wall.mean_radius / spacing))
    row = np.arange(len(found.s))
    cuts = np.concatenate([[0], np.searchsorted(found.s, sorted(r["s"] for r in found.steps)), [len(row)]])
    section = np.searchsorted(cuts, row, "right")
    low, high = np.maximum(row - half, cuts[section - 1]), np.minimum(row + half + 1, cuts[section])
    return fitted_harmonics(found, low, high) @ harmonics(found.clock)


def wrapped_box(values: Floats) -> Floats:
    """Sums over 3 x 3 cells; columns go around."""
    around = values + np.roll(values, 1, axis=1) + np.roll(values, -1, axis=1)
    padded = np.pad(around, ((1, 1), (0, 0)))
    return padded[:-2] + padded[1:-1] + padded[2:]


def _connected(cells: NDArray[np.bool_]) -> Iterable[NDArray[np.int64]]:
    """Groups of neighbouring cells, (n,2) each; columns go around."""
    columns = cells.shape[1]
    left = set(zip(*(a.tolist() for a in np.nonzero(cells)), strict=True))
    while left:
        stack = [left.pop()]
        group = []
        while stack:
            i, j = stack.pop()
            group.append((i, j))
            for a, b in itertools.product((i - 1, i, i + 1), (j - 1, j, j + 1)):
                near = (a, b % columns)
                if near in left:
                    left.remove(near)
                    stack.append(near)
        yield np.array(group)
