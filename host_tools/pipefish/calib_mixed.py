"""Images of two cameras, or of two boards of other sizes, among the views of one: found by splitting the views."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .calib_data import Array, CalibrationError
from .calib_fit import Fit, angles, errors_of, smooth_error
from .calib_model import Model

_SUSPECT = 1.6  # times what a smooth map leaves: below, one lens explains the views
_APART = 0.76  # of the error: two lenses leave less of a mixture. Of one camera's views two lenses leave .84 to .94,
_APART_FEW = 0.7  # of fewer than 12 views less, for two lenses adapt to few
_FLOOR = 2.7  # times what a smooth map leaves: two lenses must come down to it; one strange lens stays at 4
_ROUNDS = 6


def refuse_two_cameras(fit: Fit) -> None:
    """Raises CalibrationError where two lenses explain the views much better than one. Costs nothing where the lens
    explains them about as well as any smooth map could."""
    for c in range(len(fit.data.cameras)):
        views = [int(v) for v in fit.used_views() if fit.data.camera_of[v] == c]
        smooth = {v: smooth_error(fit.data, v) for v in views}
        if len(views) < 6 or any(s is None for s in smooth.values()):
            continue
        one = fit.view_medians()
        if np.median([one[v] / (smooth[v] or 1e-9) for v in views]) < _SUSPECT:
            continue
        floor = np.array([smooth[v] for v in views])
        splits = [split for seed in range(3) if (split := _split(fit, c, views, seed)) is not None]
        if not splits:
            continue
        two, parts = min(splits, key=lambda split: split[0].mean())
        gain = float(two.mean() / one[views].mean())
        if gain > (_APART if len(views) >= 12 else _APART_FEW) or np.median(two / floor) > _FLOOR:
            continue
        groups = [[v for v, part in zip(views, parts, strict=True) if part == side] for side in (True, False)]
        few = [fit.data.label(v) for v in min(groups, key=len)]
        if len(few) >= 2:
            raise CalibrationError(
                f"two lenses explain the views {1 / gain:.1f} times better than one: images of two cameras, or of "
                f"boards of two sizes, are mixed: {', '.join(few[:6])}{', ...' if len(few) > 6 else ''} "
                "against the others"
            )


def _split(fit: Fit, camera: int, views: list[int], seed: int) -> tuple[Array, npt.NDArray[np.bool_]] | None:
    """Two lenses for two parts of the views, each view to the one that fits it: -> error of each view, parts."""
    data = fit.data
    bundles = [data.bundle(views, own_frames=True) for _ in range(2)]
    points = np.concatenate([np.arange(data.first[v], data.first[v + 1]) for v in views])
    pixels, used = data.pixels[points], fit.used[points]
    part = np.repeat(np.arange(len(views)), [int(data.first[v + 1] - data.first[v]) for v in views])
    for bundle in bundles:
        bundle.set_camera(camera, fit.bundle.camera(camera))
        bundle.set_sigma(np.ascontiguousarray(fit.sigma[points]))
        bundle.huber = 2.0
        bundle.set_theta_end(camera, float(angles(fit.bundle.predict()[1])[fit.used].max()))
        for i, v in enumerate(views):
            bundle.set_frame(i, fit.bundle.frame(int(data.frame_of[v])))
    mine = np.random.default_rng(seed).permutation(len(views)) < len(views) // 2
    errors = np.zeros((2, len(views)))
    for _ in range(_ROUNDS):
        for side, bundle in enumerate(bundles):
            inside = mine if side == 0 else ~mine
            if inside.sum() < 2:
                return None
            bundle.free_camera(camera, Model(2).parameters, False)
            bundle.set_used(used & inside[part])
            bundle.adjust(10, 1e-4)
            bundle.free_camera(camera, [], False)
            bundle.set_used(used)
            bundle.adjust(8, 1e-3)
            error = errors_of(bundle, pixels)
            errors[side] = [np.median(error[(part == v) & used]) for v in range(len(views))]
        closer = errors[0] <= errors[1]
        if (closer == mine).all():
            break
        mine = closer
    return errors.min(axis=0), mine
