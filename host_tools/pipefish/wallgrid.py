"""A simulated pipe's wall from a file: a table of radii over arc length and clock angle."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.errors import FormatError


def with_wall_grid(scene: dict[str, Any], source: str | os.PathLike[str] | None) -> dict[str, Any]:
    """The scene with the table in `grid.file` (relative to `source`) read. Raises FormatError, OSError."""
    grid = scene.get("grid")
    if not isinstance(grid, dict) or "file" not in grid:
        return scene
    if not isinstance(grid["file"], str) or len(grid) > 1:
        raise FormatError(source, "grid.file", "must be a path, and nothing stands beside it")
    base = Path(source).parent if source is not None else Path()
    return scene | {"grid": read_wall_grid(base / grid["file"])}


def read_wall_grid(path: Path) -> dict[str, Any]:
    """A CSV file or a two-dimensional .npy array: radii in metres; see docs/simulator.md. Raises FormatError, OSError.

    The first column holds the rows' arc lengths, evenly spaced, the first row the columns' clock angles, evenly from 0
    over the whole turn; their corner is not read.
    """
    try:
        table = np.load(path) if path.suffix == ".npy" else np.genfromtxt(path, delimiter=",", comments="#")
        table = np.asarray(table, dtype=float)
    except ValueError as error:
        raise FormatError(path, None, str(error).strip().splitlines()[0]) from None
    if table.ndim != 2 or table.shape[0] < 3 or table.shape[1] < 5:
        raise FormatError(path, None, "needs a row of clock angles, two rows or more, and four angles or more")
    s, phi, radius = table[1:, 0], table[0, 1:], table[1:, 1:]
    step = (s[-1] - s[0]) / (len(s) - 1)
    if not (step > 0 and np.allclose(np.diff(s), step, rtol=1e-6)):
        raise FormatError(path, "column 1", "arc lengths must rise in even steps")
    if not np.allclose(phi, np.arange(len(phi)) * 2 * np.pi / len(phi), atol=1e-4):
        raise FormatError(path, "row 1", "clock angles must go evenly from 0 over the whole turn, radians")
    if not np.isfinite(radius).all():
        row, column = np.argwhere(~np.isfinite(radius))[0]
        raise FormatError(path, f"row {row + 2}, column {column + 2}", "must be a number")
    return {"start": float(s[0]), "step": float(step), "around": len(phi), "radius": radius.ravel().tolist()}
