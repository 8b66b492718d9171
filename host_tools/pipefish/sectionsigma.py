"""How well a diameter is known: the adjustment's covariance through the fit of a section, all correlation kept.

Points share the errors of the poses and of the camera, so what a section's points have in common does not average away,
and what a pose shares with the next (a drift) hardly changes a diameter. Both come out right where the diameter is a
linear function of the points, 2 sum a_j n_j . X_j, a the row of the least-squares fit of a circle that may be oval, and
its variance is taken from the whole covariance (RECONSTRUCTION section 12)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipefish.structure import Reconstruction
from pipefish.tube import SECTION, Tube
from pipefish.tube_shared import Shared

MOST = 60  # stations of a stretch that are computed; between them it is interpolated
LEAST = 30  # points


@dataclass
class DiameterSigma:
    """Of the mean diameter along a stretch, in the structure's own unit.

    s (K,); random (K,) standard deviations, the encoder's scale included; camera
    (K,) what the camera's covariance adds, None where it is not known; mean_random, mean_camera: of the mean over all,
    where errors that change their sign on the way cancel; wander, wander_camera (K,) of the difference to the mean over
    all in proportion: what is left where that mean is the scale"""

    s: np.ndarray
    random: np.ndarray
    camera: np.ndarray | None
    mean_random: float
    mean_camera: float | None
    wander: np.ndarray
    wander_camera: np.ndarray | None


def shared_of(structure: Reconstruction, segment: int, factor: float = 1.0, ellipse: float = 1.0) -> Shared:
    """What the points of a segment share through the poses. factor: by which the structure was scaled since; ellipse:
    share of this variance that counts in ovality, unless residuals show more."""
    first = int(np.searchsorted(structure.point_segment, segment))
    shown = structure.variance_factor[segment]

    def whole(places: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return structure.functions_covariance(first + places, rows) * factor**2

    def camera(places: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return factor**2 * structure.functions_covariance(first + places, rows, systematic=True) - whole(places, rows)

    # The points' own part of `whole`: with the noise that the adjustment had, which is more than the residuals' where
    # tracks err in common.
    own = structure.own_covariance[structure.point_segment == segment] * (structure.noise[segment] ** 2 / shown)
    known = structure.parts[segment][1] is not None
    return Shared(own, whole, camera if known else None, max(ellipse, min(1.0, shown)))


def diameter_function(tube: Tube, s: float, diameter: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n,), places among the tube's, and derivatives (n,3) of the mean diameter at s by them."""
    p = tube.points
    on = np.flatnonzero((np.abs(p["s"] - s) < 0.5 * SECTION * diameter) & (p["weight"] > 0) & (p["piece"] >= 0))
    if len(on) < LEAST:
        return on[:0], np.zeros((0, 3))
    clock, frame = p["clock"][on], tube.frames(p["s"][on])
    c, d = np.cos(clock), np.sin(clock)
    normal = c[:, None] * frame["up"] + d[:, None] * frame["right"]
    rows = np.column_stack([np.ones(len(on)), c, d, np.cos(2 * clock), np.sin(2 * clock)])
    weighed = rows * (p["weight"][on] / p["sigma"][on] ** 2)[:, None]
    radius = np.linalg.lstsq(rows.T @ weighed, weighed.T, rcond=None)[0][0]
    return on, 2 * radius[:, None] * normal


def diameter_sigma(structure: Reconstruction, segment: int, tube: Tube) -> DiameterSigma | None:
    """None where no station has enough points. The tube's points are those of the segment, in their order."""
    first = int(np.searchsorted(structure.point_segment, segment))
    known_camera = structure.parts[segment][1] is not None

    def variances(on: np.ndarray, by: np.ndarray) -> tuple[float, float]:
        """Of a function of points: random, and what the camera adds."""
        random = float(structure.functions_covariance(first + on, by[None])[0, 0])
        if not known_camera:
            return random, 0.0
        return random, float(structure.functions_covariance(first + on, by[None], systematic=True)[0, 0]) - random

    table = tube.stations
    known = np.flatnonzero(np.isfinite(table["d_mean"]))
    chosen = known[np.unique(np.linspace(0, len(known) - 1, min(len(known), MOST)).round().astype(int))]
    total = np.zeros((len(tube.points["s"]), 3))
    places, own, functions, weights = [], [], [], []
    for k in chosen:
        on, by = diameter_function(tube, float(table["s"][k]), float(table["d_mean"][k]))
        if not len(on):
            continue
        weights.append(float(table["d_mean_sigma"][k]) ** -2)  # in the mean, as the tube's summary has it
        total[on] += weights[-1] * by
        functions.append((on, by, float(table["d_mean"][k])))
        places.append(float(table["s"][k]))
        own.append(variances(on, by))
    if not places:
        return None
    on = np.flatnonzero(total.any(axis=1))
    by = total[on] / sum(weights)
    across = np.average([d for _, _, d in functions], weights=weights)
    wander = []
    for there, slope, d in functions:
        rest = by * (-d / across)
        rest[np.searchsorted(on, there)] += slope
        wander.append(variances(on, rest))
    (random, camera), (mean_random, mean_camera), (apart, apart_camera) = (
        np.sqrt(np.maximum(0, np.transpose(v))) for v in (own, variances(on, by), wander)
    )
    if not known_camera:
        return DiameterSigma(np.array(places), random, None, float(mean_random), None, apart, None)
    return DiameterSigma(np.array(places), random, camera, float(mean_random), float(mean_camera), apart, apart_camera)
