"""Where a heap or a hollow on a tube's wall lies and how large it is, by shapes fitted to its points.

Points on a heap are few: 30 to 50 of a drive's tracks, hardly any on some flanks, none just where it ends. Its
outermost points are no ends, its middlemost no middle. A shape has both, as all points together say."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

# (1 - u^bluntness)^power from the top to the foot: tables and cones, domes, parabolas and what falls off to nothing;
# along and around by themselves or by the distance from the top. None is held for true: each counts as its cost says.
SHAPES = ((1.0, 1.0), (2.0, 0.5), (2.0, 1.0), (2.0, 2.0), (2.0, 3.0), (2.0, 5.0), (4.0, 0.5), (4.0, 1.0))
LEAST_POINTS = 12
# A heap is no formula: of the height there, half as much of length and width, half of that of their middles. Of 36
# heaps of seven forms, four of which are none of these, ends and tops were off by about so much.
UNLIKE = 0.05
CAUCHY = 2.4  # standard deviations
# What is believed beforehand, as sigmas of logarithms: how much longer one side is than the other, how much higher the
# top than the highest points, how much larger the foot than what stands out.
SIDES, TOP, FOOT = 0.5, 0.3, 0.7
STEPS = 30


class Heap(NamedTuple):
    """s, x: the middle between the ends; length along, width around, m, as far as it is `least` high. Sigmas."""

    s: float
    x: float
    length: float
    width: float
    height: float
    s_sigma: float
    x_sigma: float
    length_sigma: float
    width_sigma: float
    height_sigma: float


class Kind(NamedTuple):
    """One of the shapes."""

    bluntness: float
    power: float
    is_round: bool

    def half(self, share: float) -> float:
        """Where along an axis, of 1, it is as high as that share of its top; of a share over 0.9 as of that."""
        return float((1 - min(0.9, share) ** (1 / self.power)) ** (1 / self.bluntness))


def _shape(q: np.ndarray, along: np.ndarray, across: np.ndarray, kind: Kind) -> np.ndarray:
    """Height. q: log height; top along and across; logs of the four half axes, before and behind along, across."""
    h, s, x = math.exp(q[0]), along - q[1], across - q[2]
    a, b, c, d = np.exp(q[3:])
    u, v = np.abs(s / np.where(s < 0, a, b)), np.abs(x / np.where(x < 0, c, d))
    if kind.is_round:
        left = 1 - np.hypot(u, v) ** kind.bluntness
    else:
        left = np.maximum(0, 1 - u**kind.bluntness) * (1 - v**kind.bluntness)
    return np.asarray(h * np.maximum(0, left) ** kind.power)


def _figures(q: np.ndarray, kind: Kind, least: float) -> np.ndarray:
    """Middle along and across, length, width, height."""
    h = math.exp(q[0])
    a, b, c, d = np.exp(q[3:])
    x = kind.half(least / h)
    return np.array([q[1] + 0.5 * (b - a) * x, q[2] + 0.5 * (d - c) * x, (a + b) * x, (c + d) * x, h])


class _Fit(NamedTuple):
    q: np.ndarray
    cost: float
    covariance: np.ndarray
    scatter: float  # of the residuals, over their sigmas squared


def _fitted(
    start: np.ndarray, along: np.ndarray, across: np.ndarray, value: np.ndarray, sigma: np.ndarray, kind: Kind
) -> _Fit:
    """Levenberg and Marquardt with Cauchy weights."""
    beliefs = np.zeros((7, 7))  # rows: top; two pairs of sides; four half axes
    beliefs[0, 0] = 1 / TOP
    beliefs[1, [3, 4]] = beliefs[2, [5, 6]] = 1 / SIDES, -1 / SIDES
    beliefs[[3, 4, 5, 6], [3, 4, 5, 6]] = 1 / FOOT

    def residuals(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        model = _shape(q, along, across, kind)
        r = (value - model) / np.hypot(sigma, UNLIKE * np.maximum(model, np.clip(value, 0, math.exp(start[0]))))
        off = beliefs @ (q - start)
        return r, off, float(CAUCHY**2 * np.log1p((r / CAUCHY) ** 2).sum() + off @ off)

    q, damping = start.copy(), 1e-2
    r, off, cost = residuals(q)
    for _ in range(STEPS):
        root = 1 / np.sqrt(1 + (r / CAUCHY) ** 2)
        hair = 1e-4 * np.array([1, math.exp(start[3]), math.exp(start[5]), 1, 1, 1, 1])
        j = np.column_stack([(residuals(q + e)[0] - residuals(q - e)[0]) / (2 * e.sum()) for e in np.diag(hair)])
        j *= root[:, None]
        normal = j.T @ j + beliefs.T @ beliefs
        gradient = j.T @ (r * root) + beliefs.T @ off
        move = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        tried = residuals(q + move)
        if tried[2] < cost:
            done = cost - tried[2] < 1e-4
            q, (r, off, cost), damping = q + move, tried, max(1e-6, damping / 5)
            if done:
                break
        else:
            damping *= 5
            if damping > 1e6:
                break
    weight = 1 / (1 + (r / CAUCHY) ** 2)
    scatter = max(1.0, float((weight * r**2).sum() / max(1.0, weight.sum() - len(q))))
    return _Fit(q, cost, np.linalg.inv(normal) * scatter, scatter)


def fit_heap(
    along: np.ndarray,
    across: np.ndarray,
    value: np.ndarray,
    sigma: np.ndarray,
    box: tuple[float, float, float, float],
    height: float,
    least: float,
) -> Heap | None:
    """along, across: metres; value: how far points stand out; box: where it is about (middle along and across, length,
    width); height: about. All points around it belong in, the wall's too. None where they are too few."""
    middle, aside, length, width = box
    if (value > max(least, 3 * float(np.median(sigma)))).sum() < LEAST_POINTS:
        return None
    fits = []
    for kind in (Kind(*shape, is_round) for shape in SHAPES for is_round in (False, True)):
        half = 0.5 / kind.half(least / height)
        start = np.array([math.log(height), middle, aside, *np.log(half * np.array([length, length, width, width]))])
        fits.append((kind, _fitted(start, along, across, value, sigma, kind)))
    best = min((f for _, f in fits), key=lambda f: f.cost)
    share = np.array([math.exp(-0.5 * (f.cost - best.cost) / best.scatter) for _, f in fits])
    share /= share.sum()
    found, variance = np.zeros((len(fits), 5)), np.zeros((len(fits), 5))
    for k, (kind, f) in enumerate(fits):
        found[k] = _figures(f.q, kind, least)
        by = [(_figures(f.q + e, kind, least) - _figures(f.q - e, kind, least)) / 2e-4 for e in 1e-4 * np.eye(7)]
        variance[k] = np.einsum("in,ij,jn->n", by, f.covariance, by)
    mean = share @ found
    variance = share @ (variance + (found - mean) ** 2)
    unlike = np.array([0.25 * mean[2], 0.25 * mean[3], 0.5 * mean[2], 0.5 * mean[3], mean[4]])
    variance += (UNLIKE * unlike) ** 2
    return Heap(*mean.tolist(), *np.sqrt(variance).tolist())
