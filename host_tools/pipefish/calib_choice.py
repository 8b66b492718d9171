"""Choice of the model by held-out views: greedy over blocks (radial, board, pupil, asymmetry), two levels ahead."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from .calib_data import Array, CalibrationError
from .calib_fit import Fit, poses_apart
from .calib_model import Model
from .calib_report import covariance_of

_FOLDS = 5
_GAIN = 0.003  # of the held-out RMS: less is not worth its parameters
_BOOTSTRAP = 1000
_ROUNDS = 8
_DRIFT = 0.01  # of the focal length, one sigma: more is a drift with the board's aspect
_FOLD_TOLERANCE = 1e-4  # of the cost: a sixtieth of _GAIN in RMS


def folds(fit: Fit, count: int = _FOLDS) -> Array:
    """Fold of each frame (F,): neighbours in time apart, frames of one pose together; -1 for rejected."""
    number = poses_apart(fit)
    return np.where(number < 0, -1, number % count)


def held_out(fit: Fit, model: Model, number: Array) -> tuple[Array, Array]:
    """Sum of squares and number of points of each frame when it is held out (F,), and by the model that the others
    give: cameras and boards frozen, its pose refitted. inf where that fails."""
    data = fit.data
    squares, points = np.zeros(data.frames), np.zeros(data.frames)
    frame_of_point = data.frame_of[data.view_of]
    for k in range(int(number.max()) + 1):
        out = np.isin(frame_of_point, np.flatnonzero(number == k)) & fit.used
        if not out.any():
            continue
        rest = fit.copy()
        rest.used = fit.used & ~out
        rest.fit(model, iterations=10, tolerance=_FOLD_TOLERANCE)
        rest.used = out
        rest.freeze()
        rest.bundle.adjust(10, 1e-6)
        error = np.minimum(rest.errors()[out], 1e6)
        squares += np.bincount(frame_of_point[out], weights=error**2, minlength=data.frames)
        points += np.bincount(frame_of_point[out], minlength=data.frames)
    return squares, points


def bound_of_gain(old: Array, new: Array, seed: int = 1) -> float:
    """The gain of RMS that nine of ten resamplings of the poses exceed, as a share, from each one's sum of squares."""
    pick = np.random.default_rng(seed).integers(0, len(old), (_BOOTSTRAP, len(old)))
    ratio = np.sqrt(new[pick].sum(axis=1) / np.maximum(old[pick].sum(axis=1), 1e-300))
    return float(1 - np.quantile(ratio, 0.9))


def tries(state: Fit, candidates: list[Model], number: Array) -> Iterator[tuple[Fit, Array]]:
    """Each candidate's fit and its sums of squares of held-out frames, in order; as many at once as there are cores."""

    def one(candidate: Model) -> tuple[Fit, Array]:
        trial = state.copy()
        trial.fit(candidate, iterations=20, tolerance=1e-6)
        return trial, held_out(trial, candidate, number)[0]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(one, candidates)


def choose(fit: Fit, shape: bool, progress: Callable[[float], None]) -> tuple[Model, list[dict[str, Any]]]:
    """The model that held-out views accept, from a settled p9 on a flat board, and the table of all that were tried."""
    pose = poses_apart(fit)
    number = folds(fit)
    alive = number >= 0
    poses = int(pose.max()) + 1

    def by_pose(squares: Array) -> Array:
        return np.bincount(pose[alive], weights=squares[alive], minlength=poses)

    state, model = fit.copy(), Model()
    squares, points = held_out(state, model, number)
    table = [_row(model, state, squares, points, 0.0, 0.0, True)]
    if poses < 6:
        return (Model(shape="z2") if shape else model), table
    tried: set[Model] = {model}
    for turn in range(_ROUNDS):
        best: tuple[float, Model, Fit, Array, dict[str, Any]] | None = None
        candidates = [m for m in model.steps() if (shape or m.shape == "flat") and m not in tried]
        candidates = [m for m in candidates if sum(m.freedom) <= 0.1 * state.used.sum()]
        for i, (candidate, (trial, new)) in enumerate(zip(candidates, tries(state, candidates, number), strict=True)):
            progress((turn + (i + 1) / len(candidates)) / _ROUNDS)
            gain = 1 - math.sqrt(new.sum() / squares.sum())
            bound = bound_of_gain(by_pose(squares), by_pose(new))
            row = _row(candidate, trial, new, points, gain, bound, False)
            row["against"] = model.name
            table.append(row)
            if gain > _GAIN and bound > 0 and (best is None or gain > best[0]) and _determined(trial):
                best = (gain, candidate, trial, new, row)
        if best is None:
            break
        _, model, state, squares, row = best
        row["accepted"] = True
        tried.add(model)
    return model, table


def _determined(fit: Fit) -> bool:
    """Not where camera and board drift along together, as aspect does where no view is rolled: held-out views of the
    same kind cannot tell."""
    try:
        found = covariance_of(fit.copy())
    except CalibrationError:
        return False
    focal = [abs(fit.bundle.camera(c).f_u) for c in range(len(found))]
    return all(math.sqrt(u.covariance[0, 0]) < _DRIFT * f for u, f in zip(found, focal, strict=True))


def _row(
    model: Model, fit: Fit, squares: Array, points: Array, gain: float, bound: float, accepted: bool
) -> dict[str, Any]:
    camera, board = model.freedom
    return {
        "model": model.name,
        "camera_parameters": camera,
        "board_parameters": board,
        "train_rms_px": fit.rms(),
        "held_out_rms_px": float(np.sqrt(squares.sum() / max(points.sum(), 1))),
        "gain": gain,
        "gain_bound": bound,
        "accepted": accepted,
    }
