"""Mean, shift and ellipse of a dense map's rows, fitted so that what stands out does not bend them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pipefish.wallmodel import Floats

if TYPE_CHECKING:
    from pipefish.dense import DenseWall


def harmonics(clock: Floats) -> Floats:
    """(5, columns): one; the first harmonic, towards twelve and three o'clock; the second."""
    angle = np.outer([1, 1, 2, 2], clock) - np.array([[0], [np.pi / 2], [0], [np.pi / 2]])
    return np.vstack([np.ones(len(clock)), np.cos(angle)])


def fitted_harmonics(found: DenseWall, low: Any, high: Any) -> Floats:
    """(rows, 5): of each row what fits rows low to high - 1 (whole numbers, (rows,) each) of the deviation, by weights
    that fall with the residual; zeros where nothing is measured."""
    terms = harmonics(found.clock)
    measured = np.isfinite(found.deviation)
    value, weight = np.where(measured, found.deviation, 0), measured.astype(float)
    bound = 3 * max(float(np.median(found.sigma[measured])), 1e-9) if measured.any() else 1.0
    fitted = np.zeros((len(value), 5))
    for _ in range(4):
        h = np.einsum("ac,rc,bc->rab", terms, weight, terms)
        g = np.einsum("ac,rc->ra", terms, weight * value)
        h, g = (np.array([a[i:j].sum(axis=0) for i, j in zip(low, high, strict=True)]) for a in (h, g))
        fitted = np.linalg.solve(h + 1e-3 * np.eye(5), g[..., None])[..., 0]
        weight = measured / (1 + ((value - fitted @ terms) / bound) ** 2) ** 2
    return fitted
