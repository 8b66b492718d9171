"""Where the pipe steps aside or changes its width at once, in a dense map of its wall: joints whose pipes are offset by
too little for the fitted tube to be cut there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipefish.dense_harmonics import fitted_harmonics
from pipefish.wallmodel import Floats

if TYPE_CHECKING:
    from pipefish.dense import DenseWall

STEP_SIGMA, STEP_SHARE = 5.0, 1 / 200  # of the noise of such jumps, and of the mean radius, at least
REACH, GAP = 0.3, 2  # radii that a line is fitted to on either side; rows beside the joint that are left out
LEAST_ROWS = 6
LEAST_SIGMA = 2e-4  # of the mean radius: what no map's own noise tells


def find_steps(found: DenseWall) -> list[dict[str, float]]:
    """Jumps of the wall's middle or width between rows: s; step and clock (radians), how far and where to what follows
    lies aside; widening of its radius; sigma of each of these three lengths. Along s.

    Of each row the mean, the first and the second harmonic around are fitted robustly; a line through those of REACH
    radii before a place, and one through those after it, tell the jump there. What a map has of such jumps elsewhere
    (the lower quartile of their size) is their noise: neighbours share keyframes, and a smooth tube rings beside a
    step."""
    spacing = float(found.s[1] - found.s[0]) if len(found.s) > 1 else 1.0
    reach = max(LEAST_ROWS, round(REACH * found.wall.mean_radius / spacing))
    row = np.arange(len(found.s))
    rows, good = fitted_harmonics(found, row, row + 1)[:, :3], np.isfinite(found.deviation).mean(axis=1) >= 0.5
    places = np.arange(reach + GAP, len(rows) - reach - GAP + 1)
    jump = np.full((len(places), 3), np.nan)
    for k, place in enumerate(places):
        sides = [slice(place - GAP - reach, place - GAP), slice(place + GAP, place + GAP + reach)]
        ends = [_end(rows[side], good[side], np.arange(side.start, side.stop) - place + 0.5) for side in sides]
        if ends[0] is not None and ends[1] is not None:
            jump[k] = ends[1] - ends[0]
    known = np.isfinite(jump[:, 0])
    if known.sum() < 2 * reach:
        return []
    sigma = max(float(np.percentile(np.abs(jump[known]), 25)) / 0.319, LEAST_SIGMA * found.wall.mean_radius)
    size = np.where(known, np.hypot(np.hypot(*jump[:, 1:].T), jump[:, 0]), 0)
    out = []
    for k in np.argsort(-size, kind="stable"):
        if size[k] < max(STEP_SIGMA * sigma, STEP_SHARE * found.wall.mean_radius):
            break
        s = float(found.s[_place(rows, jump[k], int(places[k]))] - 0.5 * spacing)
        if all(abs(s - other["s"]) > 2 * reach * spacing for other in out):
            widening, up, right = map(float, jump[k])
            clock = float(np.arctan2(right, up) % (2 * np.pi))
            out.append(
                {"s": s, "step": float(np.hypot(up, right)), "clock": clock, "widening": widening, "sigma": sigma}
            )
    return sorted(out, key=lambda r: r["s"])


def _place(rows: Floats, jump: Floats, place: int) -> int:
    """The first row after the jump: of the places whose fits leave it out, that between whose rows most of it lies."""
    near = np.arange(place - 2 * GAP, place + 2 * GAP + 1)
    return int(near[np.argmax((rows[near] - rows[near - 1]) @ jump)])


def _end(rows: Floats, good: NDArray[np.bool_], at: Floats) -> Floats | None:
    """(3,): what a line through the rows comes to at 0; None where fewer than two thirds of them are known."""
    if good.sum() < max(LEAST_ROWS - 2, 2 * len(rows) / 3):
        return None
    line = np.column_stack([np.ones(good.sum()), at[good]])
    return np.linalg.lstsq(line, rows[good], rcond=None)[0][0]
