"""`pipefish unroll`: the wall as one picture at true scale, chainage by clock, as somebody inside sees it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pipefish import _engine
from pipefish.errors import ArgumentError, PipefishError
from pipefish.wall import Piece, Wall

REACH = 1.1  # diameters from the eye up to which a keyframe shows the wall: one along the pipe
NODE = 1 / 50  # diameters from node to node: between them pixels are interpolated, f / 8000 px off at most
MOST_STEP = 16  # cells from node to node
STRIP = 512  # cells of the pipe's length that are drawn at a time, and LONGEST_STRIP diameters at the most: each cell
LONGEST_STRIP = 8  # of a strip is held against each of its keyframes
SAMPLE_EVERY, SAMPLES_AROUND, SAMPLE_SIDE = 0.1, 12, 0.02  # of balancing: diameters, places, diameters
SEAM = 0.02  # diameters over which a keyframe goes over into the next
NICE = (1.0, 2.0, 5.0, 10.0)
Tell = Callable[[float, str], None]


@dataclass
class Drawn:
    """Some columns of the unrolled picture.

    grey, seen   (rows, columns) uint8; seen: 255 where a keyframe saw the wall, else 0
    view         (columns,) the keyframe (place in the wall's list) that shows most of the column, -1: none
    fine         (columns,) pixels of that keyframe per unit of length, median along the column; 0: not seen
    """

    grey: np.ndarray
    seen: np.ndarray
    view: np.ndarray
    fine: np.ndarray


class Unroller:
    """Draws a wall. Column i shows the chainage start + (i + 0.5) cell; row r the clock angle that `clock` gives.

    cell      length of the pipe a column, in the wall's unit
    rows      around the pipe: a row is as high as a column is wide, at the mean diameter, to half a per mille
    start, columns   of the whole picture
    """

    def __init__(
        self,
        wall: Wall,
        *,
        cell: float | None = None,
        cut: float = 0.0,
        span: tuple[float, float] | None = None,
        threads: int | None = None,
        tell: Tell | None = None,
    ) -> None:
        """cell: None: as fine as the keyframes show most of the wall, rounded to 1, 2 or 5; cut: clock angle of the
        picture's upper edge, radians; span: chainages from and to.

        Reads the keyframes once, to find the light. Raises ArgumentError, PipefishError where nothing is seen."""
        self.wall, self.cut, self._tell = wall, cut, tell or (lambda fraction, word: None)
        self._threads = threads or len(os.sched_getaffinity(0))
        self._pictures: dict[int, np.ndarray] = {}
        low, high = span or (wall.start, wall.end)
        low, high = max(low, wall.start), min(high, wall.end)
        if not high > low:
            unit = "m" if wall.unit == "metre" else "mean diameters"
            raise ArgumentError(f"span: the wall was measured from {wall.start:.2f} to {wall.end:.2f} {unit}")
        if cell is not None and not (math.isfinite(cell) and cell > 0):
            raise ArgumentError(f"cell: {cell} is not a positive length")
        balance, fine = _engine.UnrollBalance(), []
        count = max(1, math.ceil((high - low) / wall.diameter))
        for i in range(count):
            self._tell(i / count, "light")
            a, b = low + i * (high - low) / count, low + (i + 1) * (high - low) / count
            fine += [self._glance(balance, piece, a, b) for piece in wall.pieces if piece.end > a and piece.start < b]
        self._pictures.clear()
        found = np.concatenate([np.zeros(0), *fine])
        if not (found > 0).any():
            raise PipefishError(f"{wall.survey.path}: no keyframe shows the measured wall")
        self.light = balance.solve(wall.camera._profile, np.nan_to_num(wall.chainage))
        self._finest = float(np.percentile(found[found > 0], 95))
        self.resolution = 1 / float(np.median(found[found > 0]))
        self.cell = cell or nice_length(self.resolution)
        self.rows = max(8, round(math.pi * wall.diameter / self.cell))
        self.step = min(MOST_STEP, max(1, round(NODE * wall.diameter / self.cell)))
        first = math.ceil(low / self.cell - 0.5 - 1e-9)  # columns whose middle is on the wall
        self.start = first * self.cell
        self.columns = max(1, math.floor(high / self.cell + 0.5 - 1e-9) - first)

    def clock(self, row: Any, sign: int = 1) -> Any:
        """Clock angle of the middle of a row, radians, 0 to 2 pi; sign: of the stretch's chainage along its s."""
        return (self.cut - sign * 2 * np.pi * (np.asarray(row, float) + 0.5) / self.rows) % (2 * np.pi)

    def chainage(self, column: Any) -> Any:
        """Of the middle of a column."""
        return self.start + (np.asarray(column, float) + 0.5) * self.cell

    def _views(self, piece: Piece, low: float, high: float) -> np.ndarray:
        """Keyframes that may show a piece of wall between two chainages; their pictures are at hand afterwards."""
        wall, reach = self.wall, REACH * self.wall.diameter
        near = (wall.stretch == piece.stretch) & (wall.chainage > low - reach) & (wall.chainage < high + reach)
        views = np.flatnonzero(near)
        for view in views.tolist():
            if view not in self._pictures:
                self._pictures[view] = wall.picture(view)
        return views

    def _forget(self, low: float) -> None:
        """Drops the pictures of keyframes that show nothing beyond a chainage."""
        past = self.wall.chainage < low - REACH * self.wall.diameter
        self._pictures = {view: grey for view, grey in self._pictures.items() if not past[view]}

    def _glance(self, balance: Any, piece: Piece, low: float, high: float) -> np.ndarray:
        """Adds places of a piece between two chainages to the balance. Returns how finely each is seen."""
        low, high = max(low, piece.start), min(high, piece.end)
        every = SAMPLE_EVERY * self.wall.diameter
        rings = np.arange(math.ceil(low / every), math.ceil(high / every)) * every
        views = self._views(piece, low, high)
        if not len(rings) or not len(views):
            return np.zeros(0)
        spots = []
        for k, s in enumerate(rings):  # each ring a little further around than the one before
            clock = (np.arange(SAMPLES_AROUND) + 0.618 * k) * 2 * np.pi / SAMPLES_AROUND
            spots.append(_spots(piece, np.array([s]), clock, 0.01 * self.wall.diameter, 0.01)[0])
        self._forget(low)
        return balance.add(
            *self._sources(views), np.concatenate(spots), SAMPLE_SIDE * self.wall.diameter, REACH * self.wall.diameter
        )

    def _sources(self, views: np.ndarray) -> tuple[Any, list[np.ndarray], np.ndarray, list[int]]:
        poses = np.ascontiguousarray(self.wall.poses[views])
        return self.wall.camera._profile, [self._pictures[v] for v in views.tolist()], poses, views.tolist()

    def draw(self, first: int = 0, columns: int | None = None) -> Drawn:
        """Columns first .. first + columns - 1, drawn in strips: memory grows with these columns only."""
        columns = self.columns - first if columns is None else columns
        grey, seen = (np.zeros((self.rows, columns), np.uint8) for _ in range(2))
        out = Drawn(grey, seen, np.full(columns, -1), np.zeros(columns))
        longest = int(LONGEST_STRIP * self.wall.diameter / self.cell) // MOST_STEP * MOST_STEP
        strip = min(STRIP, max(MOST_STEP, longest))
        for at in range(0, columns, strip):
            self._tell((first + at) / max(1, self.columns), "drawing")
            count = min(strip, columns - at)
            middle = self.chainage(first + at + np.arange(count))
            for piece in self.wall.pieces:
                inside = np.flatnonzero((middle >= piece.start) & (middle < piece.end))
                if len(inside):
                    self._strip(out, piece, first, at + int(inside[0]), len(inside))
            self._forget(float(middle[0]))
        return out

    def _strip(self, out: Drawn, piece: Piece, first: int, at: int, count: int) -> None:
        """Draws `count` columns from `at` on of `out`, all on one piece."""
        left = self.start + (first + at) * self.cell
        views = self._views(piece, left, left + count * self.cell)
        if not len(views):
            return
        step = self.step
        wide, high = (step * math.ceil(n / step) for n in (count, self.rows))
        chainage = left + np.arange(0, wide + 1, step) * self.cell
        clock = self.cut - piece.sign * 2 * np.pi * np.arange(0, high + 1, step) / self.rows
        spots = _spots(piece, chainage, clock, step * self.cell, 2 * np.pi * step / self.rows)
        wall = self.wall
        grey, seen, best, fine = _engine.unroll_draw(
            *self._sources(views),
            np.ascontiguousarray(spots.reshape(-1, 3, 3)),
            wide,
            high,
            step,
            self.cell,
            self.light,
            self._finest,
            wall.diameter / 2,
            REACH * wall.diameter,
            SEAM * wall.diameter,
            self._threads,
        )
        here = slice(at, at + count)
        new = (seen[: self.rows, :count] > 0) & (out.seen[:, here] == 0)  # stretches may reach over one another
        out.grey[:, here][new] = grey[: self.rows, :count][new]
        out.seen[:, here][new] = 255
        node = np.minimum((np.arange(count) + step // 2) // step, best.shape[1] - 1)
        view = np.array([_most(column) for column in best.T])
        middle = np.array([np.median(f[f > 0]) if (f > 0).any() else 0.0 for f in fine.T])
        free = out.view[here] < 0
        out.view[here] = np.where(free, view[node], out.view[here])
        out.fine[here] = np.where(free, middle[node], out.fine[here])

    @cached_property
    def signs(self) -> list[dict[str, Any]]:
        """Per stretch: chainages from and to, and whether chainage rises (1) along the way the camera looks."""
        out = []
        for number in sorted({p.stretch for p in self.wall.pieces}):
            of = [p for p in self.wall.pieces if p.stretch == number]
            ends = min(p.start for p in of), max(p.end for p in of)
            out.append({"stretch": number, "start": ends[0], "end": ends[1], "clock_sign": of[0].sign})
        return out


def _most(values: np.ndarray) -> int:
    """The commonest of the values that are not negative; -1 without any."""
    values = values[values >= 0]
    return int(np.bincount(values).argmax()) if len(values) else -1


def nice_length(length: float, up: bool = False) -> float:
    """1, 2 or 5 times a power of ten: the nearest in proportion, or the next above."""
    power = 10.0 ** math.floor(math.log10(length))
    if up:
        return power * next(n for n in (*NICE, 20.0) if n * power >= length * (1 - 1e-9))
    return power * min(NICE, key=lambda n: abs(math.log(n * power / length)))


def _spots(piece: Piece, chainage: np.ndarray, clock: np.ndarray, ds: float, dc: float) -> np.ndarray:
    """Places (n,m,3,3) of the wall: the place, and unit vectors to the right (rising chainage) and down (as the rows
    go) in the picture; slopes from places ds and dc away."""
    at = piece.at(chainage, clock)
    along = piece.at(chainage + ds, clock) - piece.at(chainage - ds, clock)
    down = piece.at(chainage, clock - piece.sign * dc) - piece.at(chainage, clock + piece.sign * dc)
    units = [v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (along, down)]
    return np.stack([at, *units], axis=2)
