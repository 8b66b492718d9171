"""Images of two cameras, or of two boards of other sizes, among the views of one: found by splitting the views."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ._engine import rising_end
from .calib_data import Array, CalibrationError
from .calib_fit import THETA_END, Fit, Single, angles, errors_of, smooth_error, view_pose
from .calib_model import Model

_SUSPECT = 1.3  # times what a smooth map leaves: below, one lens explains the views
# Of the error: two lenses leave less of a mixture (measured .45 to .77), .88 to 1 of one camera's views once the board
# has its shape, .82 to .96 on a flat one. Fewer than 12 views are adapted to more easily.
_APART, _APART_FEW = 0.8, 0.75
_FLOOR = 2.7  # times what a smooth map leaves: two lenses must come down to it; one strange lens stays at 4
_ROUNDS = 6
_TRIPLES = 12  # views of one camera drawn three at a time: of an even mixture one draw in four is pure, 97 % find one

Split = tuple[Array, npt.NDArray[np.bool_]]  # error of each view by its lens, which views belong to the first


def refuse_two_cameras(fit: Fit) -> None:
    """Raises CalibrationError where two lenses explain the views much better than one. Costs nothing where the lens
    explains them about as well as any smooth map could."""
    for c in range(len(fit.data.cameras)):
        views = [int(v) for v in fit.used_views() if fit.data.camera_of[v] == c]
        smooth = [smooth_error(fit.data, v) for v in views]
        if len(views) < 6 or None in smooth:
            continue
        floor = np.maximum(np.array(smooth, dtype=float), 1e-9)
        if np.median(fit.view_medians()[views] / floor) < _SUSPECT:
            continue
        # A bent board looks like two lenses to a flat one: its shape first. That of a mixture is no shape, so two
        # lenses may need a flat board to come down.
        shaped = fit.copy()
        shaped.fit(Model(shape="z4", pupil="e1"), iterations=15, tolerance=1e-5)
        if np.median(shaped.view_medians()[views] / floor) < _SUSPECT:
            continue
        lenses = [_Lenses(state, c, views) for state in (shaped, fit)]
        one = [float(of.one().mean()) for of in lenses]
        limit = _APART if len(views) >= 12 else _APART_FEW
        _refuse_split(fit, views, floor, _from_triples(fit, c, views, floor), min(one), _APART_FEW)
        for of, error in zip(lenses, one, strict=True):
            splits = [split for seed in range(3) if (split := of.split(seed)) is not None]
            if not _refuse_split(fit, views, floor, splits, error, limit):
                break


def _refuse_split(fit: Fit, views: list[int], floor: Array, splits: list[Split], one: float, limit: float) -> bool:
    """Raises CalibrationError where the best split leaves less than limit of what one lens leaves and comes down to
    what a smooth map does; -> whether it left that little."""
    if not splits:
        return False
    two, parts = min(splits, key=lambda split: split[0].mean())
    gain = float(two.mean()) / one
    few = min((np.array(views)[parts], np.array(views)[~parts]), key=len)
    if gain <= limit and len(few) >= 2 and np.median(two / floor) <= _FLOOR:
        listed = ", ".join(fit.data.label(int(v)) for v in few[:6]) + (", ..." if len(few) > 6 else "")
        raise CalibrationError(
            f"two lenses explain the views {1 / gain:.1f} times better than one: images of two cameras, or of boards "
            f"of two sizes, are mixed: {listed} against the others"
        )
    return gain <= limit


def _from_triples(fit: Fit, camera: int, views: list[int], floor: Array) -> list[Split]:
    """Splits from nothing, where the common lens is too far from either: a lens from three views, the views that it
    explains, and a lens from the others."""
    splits = []
    random = np.random.default_rng(0)
    for _ in range(_TRIPLES):
        three = np.sort(random.choice(len(views), 3, replace=False))
        try:
            seed = Single(fit.data, camera, views=[views[i] for i in three])
            if seed.median > _FLOOR * float(np.median(floor[three])):
                continue
            inside = _explained(fit, camera, views, seed.bundle.camera(camera)) < _FLOOR * floor
            if min(inside.sum(), (~inside).sum()) < 2:
                continue
            two = np.empty(len(views))
            for side in (inside, ~inside):
                single = Single(fit.data, camera, views=[v for v, of in zip(views, side, strict=True) if of])
                two[side] = single.view_errors(single.bundle)
        except CalibrationError:  # no lens for these: not a split
            continue
        splits.append((two, inside))
    return splits


def _explained(fit: Fit, camera: int, views: list[int], profile: Any) -> Array:
    """Median distance of each view by a given lens, its pose fitted; infinite where it has none."""
    data = fit.data
    bundle = data.bundle(views, own_frames=True)
    profile.theta_max = rising_end(profile, THETA_END)
    bundle.set_camera(camera, profile)
    placed = np.zeros(len(views), dtype=bool)
    for i in range(len(views)):
        pose = bundle.view_pose(i)
        placed[i] = pose is not None
        if pose is not None:
            bundle.set_frame(i, pose)
    profile.theta_max = THETA_END  # the edge of the model must not stop a step
    bundle.set_camera(camera, profile)
    bundle.free_camera(camera, [], False)
    bundle.huber = 2.0
    points = np.concatenate([np.arange(data.first[v], data.first[v + 1]) for v in views])
    part = np.repeat(np.arange(len(views)), [int(data.first[v + 1] - data.first[v]) for v in views])
    bundle.set_used(placed[part])
    bundle.adjust(8, 1e-3)
    error = errors_of(bundle, data.pixels[points])
    return np.array([np.median(error[part == i]) if placed[i] else np.inf for i in range(len(views))])


class _Lenses:
    """Lenses for parts of the views, each view with a pose of its own on the boards of a fit."""

    def __init__(self, fit: Fit, camera: int, views: list[int]) -> None:
        data = fit.data
        self.camera = camera
        self.points = np.concatenate([np.arange(data.first[v], data.first[v + 1]) for v in views])
        self.pixels, self.used = data.pixels[self.points], fit.used[self.points]
        self.part = np.repeat(np.arange(len(views)), [int(data.first[v + 1] - data.first[v]) for v in views])
        self.count = len(views)
        self.start = data.bundle(views, own_frames=True)
        self.start.set_camera(camera, fit.bundle.camera(camera))
        for b in sorted({int(data.board_of[v]) for v in views}):
            self.start.set_shape(b, fit.bundle.shape(b), *data.boards[b].centre, data.boards[b].half)
        self.start.set_sigma(np.ascontiguousarray(fit.sigma[self.points]))
        self.start.set_theta_end(camera, float(angles(fit.bundle.predict()[1])[fit.used].max()))
        self.start.huber = 2.0
        for i, v in enumerate(views):
            self.start.set_frame(i, view_pose(fit, v))

    def fit(self, bundle: Any, inside: npt.NDArray[np.bool_]) -> Array:
        """Fits a lens to the views `inside`; -> error of every view by it."""
        bundle.free_camera(self.camera, Model(2).parameters, False)
        bundle.set_used(self.used & inside[self.part])
        bundle.adjust(10, 1e-4)
        bundle.free_camera(self.camera, [], False)
        bundle.set_used(self.used)
        bundle.adjust(8, 1e-3)
        error = errors_of(bundle, self.pixels)
        return np.array([np.median(error[(self.part == v) & self.used]) for v in range(self.count)])

    def one(self) -> Array:
        """Error of each view by one lens for all."""
        return self.fit(self.start.copy(), np.ones(self.count, dtype=bool))

    def split(self, seed: int) -> Split | None:
        """Two lenses, each view to the one that fits it: -> error of each view, which belong to the first."""
        bundles = [self.start.copy() for _ in range(2)]
        first = np.random.default_rng(seed).permutation(self.count) < self.count // 2
        errors = np.zeros((2, self.count))
        for _ in range(_ROUNDS):
            if min(first.sum(), (~first).sum()) < 2:
                return None
            errors = np.array([self.fit(b, side) for b, side in zip(bundles, (first, ~first), strict=True)])
            closer = errors[0] <= errors[1]
            if (closer == first).all():
                break
            first = closer
        return errors.min(axis=0), first
