"""Calibration targets: one description for what is printed, simulated, detected and calibrated with.

Target coordinates: metres, X to the right and Y down on the face, Z away from a viewer in front of it, the origin in
the middle of the target. On a sleeve, which goes around the inside of a pipe, X is the arc length from clock angle 0
and Y the place along the pipe.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.errors import ArgumentError, FormatError
from pipefish.files import write_atomically

FORMAT = "pipefish-target"

KINDS = ("checkerboard", "circles", "asymmetric-circles", "charuco", "sleeve")
WHITE, BLACK = 0.85, 0.05  # albedo of paper and of toner

OWN = "pipefish"  # the dictionary of marker_bits
# OpenCV's, in the order of its numbers: bits of a marker's side, markers.
DICTIONARIES = {
    **{f"{n}X{n}_{count}": (n, count) for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "ARUCO_ORIGINAL": (5, 1024),
    "APRILTAG_16h5": (4, 30),
    "APRILTAG_25h9": (5, 35),
    "APRILTAG_36h10": (6, 2320),
    "APRILTAG_36h11": (6, 587),
}


@dataclass(frozen=True)
class Target:
    """A calibration target.

    kind: one of KINDS. rows, cols: of squares (checkerboard, charuco), else of circles; asymmetric circles have `cols`
    in each row, every other row half a step to the right. spacing_m: of a square's side, else of neighbouring centres
    in a row and between rows; asymmetric circles: of a column, rows are half of it apart. radius_m: of circles and of a
    sleeve's discs [0.3 spacing; asymmetric 0.2; sleeve 0.25]. margin_m: white around it all [one spacing; sleeve half].
    marker_share: a charuco marker's side to a square's. dictionary: its markers, OWN or one of DICTIONARIES;
    marker_bits: of a marker's side without its black border, of OWN (the others have their own). first_marker: number
    of the first one. legacy: laid out as OpenCV before 4.6 did, where an even number of rows begins with a marker.
    diameter_m: of the pipe that a sleeve goes around the inside of; it decides the spacing around it. Raises
    ArgumentError that names the field.
    """

    kind: str
    rows: int
    cols: int
    spacing_m: float
    radius_m: float = 0.0
    margin_m: float = -1.0
    marker_share: float = 0.7
    marker_bits: int = 5
    first_marker: int = 0
    dictionary: str = OWN
    legacy: bool = False
    diameter_m: float = 0.0
    white: float = field(default=WHITE)
    black: float = field(default=BLACK)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ArgumentError(f"kind: must be one of {', '.join(KINDS)}, not {self.kind!r}")
        sleeve = self.kind == "sleeve"
        for name, low, high in (("rows", 4 if sleeve else 2, 200), ("cols", 6 if sleeve else 2, 200)):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
                raise ArgumentError(f"{name}: must be a whole number from {low} to {high}, not {value!r}")
        for name, low, high in (
            ("spacing_m", 1e-4, 10),
            ("marker_share", 0.3, 0.95),
            ("white", 0, 1),
            ("black", 0, 1),
            ("radius_m", 0, 10),
            ("margin_m", -1, 10),
            ("diameter_m", 0, 10),
        ):
            value = getattr(self, name)
            if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
                raise ArgumentError(f"{name}: must be a number from {low:g} to {high:g}, not {value!r}")
        if self.white <= self.black:
            raise ArgumentError("white: must be above black")
        if not isinstance(self.first_marker, int) or not 0 <= self.first_marker <= 1000:
            raise ArgumentError("first_marker: must be within 0 and 1000")
        self._check_markers()
        if sleeve != (self.diameter_m > 0):
            raise ArgumentError("diameter_m: a sleeve needs it, nothing else has it")
        share = {"asymmetric-circles": 0.2, "sleeve": 0.25}.get(self.kind, 0.3)
        if self.radius_m == 0:
            object.__setattr__(self, "radius_m", share * min(self.spacing_m, self.spacing_x))
        if self.margin_m < 0:
            object.__setattr__(self, "margin_m", self.spacing_m * (0.5 if sleeve else 1.0))
        gap = 0.5 * min(self.spacing_m, self.spacing_x) * (math.sqrt(0.5) if self.kind == "asymmetric-circles" else 1)
        if self.has_circles and not self.radius_m < 0.95 * gap:
            raise ArgumentError(f"radius_m: circles of {self.radius_m:g} m touch: must be below {0.95 * gap:g}")

    def _check_markers(self) -> None:
        charuco = self.kind == "charuco"
        if not isinstance(self.legacy, bool) or (self.legacy and not charuco):
            raise ArgumentError("legacy: must be true or false, and is for charuco")
        if self.dictionary == OWN:
            if self.marker_bits not in (4, 5, 6):
                raise ArgumentError(f"marker_bits: must be 4, 5 or 6, not {self.marker_bits!r}")
            return
        if not charuco or self.dictionary not in DICTIONARIES:
            raise ArgumentError(
                f"dictionary: must be {OWN} or, of a charuco, one of {', '.join(DICTIONARIES)}, not {self.dictionary!r}"
            )
        bits, count = DICTIONARIES[self.dictionary]
        last = self.first_marker + len(self.marker_middles())
        if last > count:
            raise ArgumentError(f"dictionary: {self.dictionary} has {count} markers, the board needs {last}")
        object.__setattr__(self, "marker_bits", bits)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> Target:
        """From the fields by name. Raises ArgumentError for an unknown or missing one."""
        known = [f.name for f in fields(Target)]
        for key in data:
            if key not in known:
                raise ArgumentError(f"{key}: unknown; known are {', '.join(known)}")
        for key in ("kind", "rows", "cols", "spacing_m"):
            if key not in data:
                raise ArgumentError(f"{key}: missing")
        return Target(**data)

    def to_dict(self) -> dict[str, Any]:
        """All fields by name."""
        return asdict(self)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Target:
        """Reads what save() wrote. Raises FormatError with the file and the field."""
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise FormatError(path, None, f"not JSON: {error}") from None
        if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
            raise FormatError(path, "format", f"not a target: must be {FORMAT!r}")
        if data.pop("version", None) != 1:
            raise FormatError(path, "version", "must be 1")
        try:
            return Target.from_dict(data)
        except ArgumentError as error:
            key, _, reason = str(error).partition(": ")
            raise FormatError(path, key, reason) from None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the target as JSON, whole or not at all. Raises OSError."""
        data = {"format": FORMAT, "version": 1, **self.to_dict()}
        write_atomically(Path(path), (json.dumps(data, indent=2) + "\n").encode())

    @property
    def has_circles(self) -> bool:
        """Whether its points are centres of discs; else they are corners."""
        return self.kind in ("circles", "asymmetric-circles", "sleeve")

    @property
    def spacing_x(self) -> float:
        """Between neighbours in a row, metres."""
        return math.pi * self.diameter_m / self.cols if self.kind == "sleeve" else self.spacing_m

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the sheet with its margin; a sleeve's width is the pipe's circumference."""
        step, edge = self.spacing_m, 2 * self.margin_m
        if self.kind == "sleeve":
            return math.pi * self.diameter_m, (self.rows - 1) * step + 2 * self.radius_m + edge
        if self.kind == "circles":
            discs = 2 * self.radius_m + edge
            return (self.cols - 1) * step + discs, (self.rows - 1) * step + discs
        if self.kind == "asymmetric-circles":
            wide = (self.cols - 0.5) * step + 2 * self.radius_m + edge
            return wide, (self.rows - 1) * step / 2 + 2 * self.radius_m + edge
        return self.cols * step + edge, self.rows * step + edge

    def flat_points(self) -> np.ndarray:
        """Corners or centres (N, 2), row by row: where they are on the sheet laid flat."""
        step = self.spacing_m
        if self.has_circles:
            row, col = np.mgrid[: self.rows, : self.cols].reshape(2, -1).astype(float)
            if self.kind == "sleeve":
                return np.column_stack(
                    [(col - self.cols / 2 + 0.5) * self.spacing_x, (row - (self.rows - 1) / 2) * step]
                )
            if self.kind == "asymmetric-circles":
                x = (col + 0.5 * (row % 2) - (self.cols - 0.5) / 2) * step
                return np.column_stack([x, (row - (self.rows - 1) / 2) * step / 2])
            return np.column_stack([(col - (self.cols - 1) / 2) * step, (row - (self.rows - 1) / 2) * step])
        row, col = np.mgrid[1 : self.rows, 1 : self.cols].reshape(2, -1).astype(float)
        return np.column_stack([(col - self.cols / 2) * step, (row - self.rows / 2) * step])

    @property
    def points_shape(self) -> tuple[int, int]:
        """How many points a row has, and how many rows there are."""
        return (self.cols, self.rows) if self.has_circles else (self.cols - 1, self.rows - 1)

    def lattice(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (N, 2) of the points, in their order, on the lattice that nearest neighbours span, whole numbers; and
        the lattice's steps (2, 2), metres on the sheet: row 0 by one along the first number, row 1 along the second. On
        asymmetric circles the steps go to the lower right and to the lower left."""
        cols, rows = self.points_shape
        row, col = np.mgrid[:rows, :cols].reshape(2, -1)
        if self.kind == "asymmetric-circles":
            half, twice = self.spacing_m / 2, 2 * col + row % 2
            return np.column_stack([(row + twice) // 2, (row - twice) // 2]), np.array([[half, half], [-half, half]])
        return np.column_stack([col, row]), np.diag([self.spacing_x, self.spacing_m])

    def marker_middles(self) -> np.ndarray:
        """(K, 2) middles of a ChArUco board's markers on the sheet, in the order of their numbers."""
        row, col = np.mgrid[: self.rows, : self.cols].reshape(2, -1)
        at = np.column_stack([col - (self.cols - 1) / 2, row - (self.rows - 1) / 2]) * self.spacing_m
        return at[(row + col) % 2 != self.dark_parity]

    @property
    def dark_parity(self) -> int:
        """Row plus column, modulo 2, of the dark squares."""
        return int(self.legacy and self.rows % 2 == 0)

    def marker(self, number: int) -> np.ndarray:
        """The inner bits of one of its dictionary's markers, (side, side), 1 = white."""
        if self.dictionary == OWN:
            return marker_bits(number, self.marker_bits)
        from pipefish import _engine

        return _engine.opencv_marker(list(DICTIONARIES).index(self.dictionary), number)

    def points(self) -> np.ndarray:
        """Corners or centres (N, 3), row by row. A sleeve's in the pipe's frame: Z along it, X to the right, Y down,
        the axis through the origin; clock angle 0 is up, positive clockwise seen along Z."""
        flat = self.flat_points()
        if self.kind != "sleeve":
            return np.column_stack([flat, np.zeros(len(flat))])
        radius = self.diameter_m / 2
        clock = flat[:, 0] / radius
        return np.column_stack([radius * np.sin(clock), -radius * np.cos(clock), flat[:, 1]])

    def figures(self) -> np.ndarray:
        """All that is black or white on the white sheet, to be laid on in this order: (N, 6) rows round (1: an ellipse,
        0: a rectangle), x, y of the middle, half sizes along x and y, albedo."""
        made: list[tuple[float, ...]] = []
        if self.has_circles:
            bits = self.sleeve_bits().ravel() if self.kind == "sleeve" else np.zeros(self.rows * self.cols, dtype=int)
            for (x, y), bit in zip(self.flat_points(), bits, strict=True):
                made.append((1, x, y, self.radius_m, self.radius_m, self.black))
                if bit:
                    made.append((1, x, y, self.radius_m / 2, self.radius_m / 2, self.white))
            return np.array(made)
        half, marker = self.spacing_m / 2, self.first_marker
        for row in range(self.rows):
            for col in range(self.cols):
                x = (col - (self.cols - 1) / 2) * self.spacing_m
                y = (row - (self.rows - 1) / 2) * self.spacing_m
                if (row + col) % 2 == self.dark_parity:
                    made.append((0, x, y, half, half, self.black))
                elif self.kind == "charuco":
                    made += self._marker(marker, x, y)
                    marker += 1
        return np.array(made)

    def _marker(self, number: int, x: float, y: float) -> list[tuple[float, ...]]:
        bits = self.marker(number)
        side = self.marker_share * self.spacing_m
        cell = side / (self.marker_bits + 2)
        made: list[tuple[float, ...]] = [(0, x, y, side / 2, side / 2, self.black)]
        for (row, col), bit in np.ndenumerate(bits):
            if bit:
                middle = (self.marker_bits - 1) / 2
                made.append((0, x + (col - middle) * cell, y + (row - middle) * cell, cell / 2, cell / 2, self.white))
        return made

    def sleeve_bits(self) -> np.ndarray:
        """(rows, cols) of a sleeve: 1 where the disc has a white hole of half its radius. Any 4 x 4 marks, around the
        seam too, occur once: they tell where on the sleeve they are."""
        return _sleeve_bits(self.rows, self.cols)


def _mix(x: np.ndarray) -> np.ndarray:
    """SplitMix64's output function of uint64 numbers."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@cache
def _sleeve_bits(rows: int, cols: int) -> np.ndarray:
    # The first number whose hashed bits have no window twice: about exp(windows^2 / 131072) tries, so up to some 800.
    place = np.arange(rows * cols, dtype=np.uint64)
    weights = 1 << np.arange(16).reshape(4, 4)
    for number in range(100_000):
        bits = (_mix(place + np.uint64(number << 20)) & np.uint64(1)).astype(int).reshape(rows, cols)
        wrapped = np.hstack([bits, bits[:, :3]])
        windows = np.lib.stride_tricks.sliding_window_view(wrapped, (4, 4)).reshape(-1, 16) @ weights.ravel()
        if len(np.unique(windows)) == len(windows):
            bits.flags.writeable = False
            return bits
    raise ArgumentError(f"rows, cols: no code for {rows} x {cols} marks; take fewer")


_DISTANCE = {4: 3, 5: 6, 6: 10}


@cache
def _dictionary(side: int) -> list[np.ndarray]:
    return []


@cache
def _search(side: int) -> list[int]:
    return [0]


def marker_bits(number: int, side: int) -> np.ndarray:
    """The inner bits of a marker, (side, side), 1 = white.

    The rule: the words SplitMix64(0), SplitMix64(1), ... give side^2 bits each, row by row from the lowest; a word is
    taken if it differs from each one taken before, in all four rotations, and from its own rotations, in at least 3 (4
    x 4 bits), 6 (5 x 5) or 10 (6 x 6) bits. Markers are numbered in the order they are taken. Raises ArgumentError when
    there are no more.
    """
    made, at = _dictionary(side), _search(side)
    while len(made) <= number:
        if at[0] > 400_000:
            raise ArgumentError(f"first_marker: there are only {len(made)} markers of {side} x {side} bits")
        words = _mix(np.arange(at[0], at[0] + 1000, dtype=np.uint64))
        at[0] += 1000
        shifts = np.arange(side * side, dtype=np.uint64)
        for bits in ((words[:, None] >> shifts) & np.uint64(1)).astype(np.uint8).reshape(-1, side, side):
            turned = np.array([np.rot90(bits, k) for k in range(4)])
            if (turned[1:] != bits).sum((1, 2)).min() < _DISTANCE[side]:
                continue
            if made and (turned[:, None] != np.array(made)).sum((2, 3)).min() < _DISTANCE[side]:
                continue
            made.append(bits)
    return made[number]
