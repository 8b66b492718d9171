"""Dark lines that lie on the wall, cell by cell: what several keyframes, unrolled onto the measured wall, show as thin,
dark and in the same place. What stands off the wall (roots), glints and shadows move from one keyframe to the next, and
the median over keyframes does not hold them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipefish.dense_unroll import Unroller, box_sum
from pipefish.wallmodel import Floats

Grey = NDArray[np.float32]
Mask = NDArray[np.bool_]

STRIP, MARGIN = 512, 24  # rows at a time, and beside them
EVEN = 15  # cells: what is lighter or darker over this radius is the light's, or a stain
GLOOM = 0.02  # of full scale, about 5 grey levels: what is darker is not judged
SIGMA, TURNS, HALF = (
    1.5,
    12,
    6,
)  # of the line filter: cells across, directions in half a turn, cells to either side along
REACH = 5  # cells across that a keyframe's own profile is taken over
WIDTH_LEAST = 0.25  # cells of missing light, for a cell to be looked at
OVER = 2.5  # and times what the filter tells of most cells around


@dataclass(frozen=True, eq=False)
class Dark:
    """Cells on dark lines, each (n,): x, y columns and rows of the unrolled grid, fractions; turn of the line, radians
    from the columns' direction (around the pipe) towards the rows' (along it), 0 to pi; width, cells of black that
    would take as much light (median of the keyframes); spread of it; views, how many show the place, and of them dark,
    how many show the line there; place, sigma of where it is, across it, cells; usual, what the line filter tells of
    three quarters of the cells around at most: the wall's own texture."""

    x: Floats
    y: Floats
    turn: Floats
    width: Floats
    spread: Floats
    views: Floats
    dark: Floats
    place: Floats
    usual: Floats

    def __len__(self) -> int:
        return len(self.x)

    def where(self, keep: Any) -> Dark:
        """Those of a mask or index."""
        return Dark(*(getattr(self, f.name)[keep] for f in fields(self)))


def dark_lines(
    unroller: Unroller,
    images: Callable[[int], Grey],
    poses: Floats,
    views: Iterable[int],
    tell: Callable[[float], None],
) -> Dark:
    """The dark cells of all the wall that the keyframes `views` see, strip by strip; images gives their pictures (H,W),
    0..1; poses (n,3,4). tell is called with the fraction done."""
    seen = {k: unroller.rows(poses[k]) for k in views}
    low = min((a for a, b in seen.values() if b > a), default=0)
    high = max((b for a, b in seen.values() if b > a), default=0)
    pictures: dict[int, Grey] = {}
    found = []
    for first in range(low, high, STRIP):
        tell((first - low) / max(high - low, 1))
        a, b = max(first - MARGIN, 0), min(first + STRIP, high) + MARGIN
        near = [k for k, (c, d) in seen.items() if min(b, d) - max(a, c) > 2 * HALF]
        pictures = {k: pictures.get(k) if k in pictures else images(k) for k in near}
        if len(near) < 2:
            continue
        stack = np.full((len(near), b - a, unroller.columns + 2 * unroller.pad), np.nan, np.float32)
        for one, k in zip(stack, near, strict=True):
            c, d = max(a, seen[k][0]), min(b, seen[k][1])
            one[c - a : d - a] = relative(*unroller.part(pictures[k], poses[k], c, d))
        dark = _dark_of(stack)
        x, y = dark.x - unroller.pad, dark.y + a
        inside = (x >= 0) & (x < unroller.columns) & (y >= first) & (y < min(first + STRIP, high))
        found.append(Dark(x, y, *(getattr(dark, f.name) for f in fields(Dark)[2:])).where(inside))
    return Dark(*(np.concatenate([getattr(d, f.name) for d in found] or [np.empty(0)]) for f in fields(Dark)))


def relative(picture: Grey, sound: Mask) -> Grey:
    """By how much a cell is lighter than what is around it, over that: -1 black. NaN where not seen."""
    mean = box_sum(picture, EVEN) / np.maximum(box_sum(sound.astype(np.float32), EVEN), 1)
    return np.where(sound & (mean > GLOOM), picture / np.maximum(mean, GLOOM) - 1, np.nan).astype(np.float32)


def _dark_of(stack: Grey) -> Dark:
    """Of what keyframes show of one part (views, rows, columns)."""
    count = np.isfinite(stack).sum(axis=0)
    # The lighter one of two, the middle one of three: dark is what most keyframes show so.
    order = np.sort(stack, axis=0)  # NaN last
    middle = np.take_along_axis(order, np.minimum(count // 2, len(stack) - 1)[None], axis=0)[0]
    plain = np.where(count >= 2, np.nan_to_num(middle), 0)
    strength, turn = line_strength(plain)
    normal = (np.round(-np.sin(turn)).astype(int), np.round(np.cos(turn)).astype(int))
    y, x = np.mgrid[: plain.shape[0], : plain.shape[1]]
    usual = _usual(strength)
    crest = (strength > WIDTH_LEAST) & (strength > OVER * usual) & (count >= 2)
    crest[[*range(HALF), *range(-HALF, 0)]] = False
    crest[:, [*range(HALF), *range(-HALF, 0)]] = False
    at = np.nonzero(crest)
    sides = [strength[at[0] + k * normal[1][at], at[1] + k * normal[0][at]] for k in (-1, 1)]
    top = (strength[at] >= sides[0]) & (strength[at] > sides[1])
    y, x = (v[top] for v in at)
    return _judged(stack, x, y, turn[y, x], usual[y, x])


def _judged(stack: Grey, x: NDArray[np.int64], y: NDArray[np.int64], turn: Floats, usual: Floats) -> Dark:
    """Those places (n,) that most of the keyframes which see them show as a dark line, with what each of them tells."""
    t = np.arange(-REACH, REACH + 1)
    across = np.stack([-np.sin(turn), np.cos(turn)])
    along = np.stack([np.cos(turn), np.sin(turn)])
    profile = np.zeros((len(stack), len(x), len(t)), np.float32)
    for step in (-1, 0, 1):
        column = np.rint(x[:, None] + t * across[0][:, None] + step * along[0][:, None]).astype(int)
        row = np.rint(y[:, None] + t * across[1][:, None] + step * along[1][:, None]).astype(int)
        column, row = column.clip(0, stack.shape[2] - 1), row.clip(0, stack.shape[1] - 1)
        profile += stack[:, row, column] / 3
    # Dark beside what is on either side: the edge of something dark is no line.
    side = np.minimum(profile[..., :2].mean(axis=-1), profile[..., -2:].mean(axis=-1))
    missing = side[..., None] - profile[..., 2:-2]
    seen = np.isfinite(missing).all(axis=-1)
    width = np.where(seen, missing.sum(axis=-1), np.nan)
    weight = np.where(seen[..., None], np.maximum(missing, 0), 0)
    shift = (weight * t[2:-2]).sum(axis=-1) / np.maximum(weight.sum(axis=-1), 1e-6)
    views, dark = seen.sum(axis=0), (seen & (np.nan_to_num(width) > WIDTH_LEAST)).sum(axis=0)
    keep = (dark >= 2) & (2 * dark > views)
    width, shift, seen, views, dark = width[:, keep], shift[:, keep], seen[:, keep], views[keep], dark[keep]
    lines = seen & (np.nan_to_num(width) > WIDTH_LEAST)
    weight = lines / np.maximum(lines.sum(axis=0), 1)
    mean = (weight * shift).sum(axis=0)
    scatter = np.sqrt((weight * (shift - mean) ** 2).sum(axis=0) / np.maximum(dark - 1, 1))
    order = np.sort(np.where(seen, width, np.inf), axis=0)
    pick = np.arange(order.shape[1])
    middle = 0.5 * (order[(views - 1) // 2, pick] + order[views // 2, pick])
    spread = np.sqrt(np.nansum(np.where(seen, (width - middle) ** 2, 0), axis=0) / np.maximum(views - 1, 1) / views)
    return Dark(
        x[keep] + mean * across[0][keep],
        y[keep] + mean * across[1][keep],
        turn[keep],
        *(np.asarray(v, float) for v in (middle, spread, views, dark)),
        np.hypot(scatter, 0.29),  # a cell's own
        usual[keep],
    )


def line_strength(picture: Grey) -> tuple[Grey, Grey]:
    """How much light a dark line through a cell takes, in cells of black (for lines of up to about 4 cells), and its
    turn: the most over TURNS directions of the second derivative across, averaged over 13 cells along."""
    reach = math.ceil(3.5 * SIGMA)
    t = np.arange(-reach, reach + 1)
    g = np.exp(-(t**2) / (2 * SIGMA**2))
    g /= g.sum()
    g1, g2 = -t / SIGMA**2 * g, (t**2 / SIGMA**4 - 1 / SIGMA**2) * g
    g2 -= g2.mean()
    xx = _convolved(_convolved(picture, g, 0), g2, 1)
    yy = _convolved(_convolved(picture, g2, 0), g, 1)
    xy = _convolved(_convolved(picture, g1, 0), g1, 1)
    rows, columns = picture.shape
    best, turn = np.full(picture.shape, -np.inf, np.float32), np.zeros(picture.shape, np.float32)
    for k in range(TURNS):
        angle = math.pi * k / TURNS
        c, s = math.cos(angle), math.sin(angle)
        bend = np.pad(s * s * xx - 2 * s * c * xy + c * c * yy, HALF, mode="edge")
        total = np.zeros_like(best)
        for j in range(-HALF, HALF + 1):
            y, x = HALF + round(j * s), HALF + round(j * c)
            total += bend[y : y + rows, x : x + columns]
        better = total > best
        best[better], turn[better] = total[better], angle
    return best * np.float32(math.sqrt(2 * math.pi) * SIGMA**3 / (2 * HALF + 1)), turn


def _convolved(picture: Grey, kernel: Floats, axis: int) -> Grey:
    reach = len(kernel) // 2
    padded = np.pad(picture, [(reach, reach) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
    out = np.zeros_like(picture)
    for k, weight in enumerate(kernel[::-1].astype(np.float32)):
        part = slice(k, k + picture.shape[axis])
        out += weight * (padded[part] if axis == 0 else padded[:, part])
    return out


def _usual(strength: Grey, block: int = 64) -> Grey:
    """The filter's third quartile in blocks: lines take too few cells to matter."""
    rows, columns = (-(-n // block) for n in strength.shape)
    padded = np.pad(strength, [(0, rows * block - strength.shape[0]), (0, columns * block - strength.shape[1])], "edge")
    blocks = padded.reshape(rows, block, columns, block)[:, ::4, :, ::4].transpose(0, 2, 1, 3)
    level = np.percentile(np.abs(blocks).reshape(rows, columns, -1), 75, axis=2).astype(np.float32)
    return np.repeat(np.repeat(level, block, axis=0), block, axis=1)[: strength.shape[0], : strength.shape[1]]
