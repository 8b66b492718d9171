"""How well a score tells what is there from what is not: ROC curve, area under it with interval, operating points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import ArgumentError
from .intervals import Z95

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Roc:
    """What roc() returns.

    threshold  (N,) falling; "present" is a score of at least that. The first is infinite: nothing is present
    tpr, fpr   (N,) share of what is there that is found, of what is not there that is "found" all the same
    auc        area under the curve: the probability that something present scores more than something absent
    interval   of auc, at 95 %
    positives, negatives  how many there are
    """

    threshold: Floats
    tpr: Floats
    fpr: Floats
    auc: float
    interval: tuple[float, float]
    positives: int
    negatives: int

    def tpr_at(self, fpr: float) -> float:
        """The share found while at most `fpr` of the absent are."""
        return float(self.tpr[self.fpr <= fpr].max())

    def equal_error(self) -> float:
        """The rate at which as many of the present are missed as absent ones found (between points: linear)."""
        gap = self.fpr - (1 - self.tpr)
        k = int(np.argmax(gap >= 0))
        if k == 0:
            return float(self.fpr[0])
        share = -gap[k - 1] / (gap[k] - gap[k - 1])
        return float(self.fpr[k - 1] + share * (self.fpr[k] - self.fpr[k - 1]))


def roc(score: ArrayLike, truth: ArrayLike) -> Roc:
    """The ROC of scores (N,) of decisions whose truth (N,) is known; both present and absent ones are needed.

    The interval of the area is Newcombe's (Statistics in Medicine 25, 2006, method 5), which does not close at 1 when
    nothing was confused, as a bootstrap's does. It takes decisions as independent. Raises ArgumentError."""
    s, t = np.asarray(score, float), np.asarray(truth, bool)
    if s.ndim != 1 or s.shape != t.shape:
        raise ArgumentError(f"score and truth: shapes {s.shape} and {t.shape} are not (N,)")
    if np.isnan(s).any():
        raise ArgumentError("score: not a number")
    m, n = int(t.sum()), int((~t).sum())
    if not m or not n:
        raise ArgumentError(f"truth: {m} present and {n} absent; a ROC needs both")
    levels, place = np.unique(-s, return_inverse=True)
    found = np.cumsum(np.bincount(place[t], minlength=len(levels)))
    false = np.cumsum(np.bincount(place[~t], minlength=len(levels)))
    tpr, fpr = np.r_[0, found / m], np.r_[0, false / n]
    auc = float(np.clip(np.trapezoid(tpr, fpr), 0, 1))
    return Roc(np.r_[np.inf, -levels], tpr, fpr, auc, auc_interval(auc, m, n), m, n)


def auc_interval(auc: float, positives: int, negatives: int) -> tuple[float, float]:
    """The areas from which `auc` is Z95 of their own standard errors away."""

    def deviation(a: float) -> float:
        more = (positives + negatives) / 2 - 1
        return float(np.sqrt(a * (1 - a) * (1 + more * ((1 - a) / (2 - a) + a / (1 + a))) / (positives * negatives)))

    ends = []
    for end in (0.0, 1.0):
        inside, outside = auc, end
        for _ in range(60):  # halving: beyond the resolution of a double
            middle = (inside + outside) / 2
            if abs(middle - auc) > Z95 * deviation(middle):
                outside = middle
            else:
                inside = middle
        ends.append(inside)
    return ends[0], ends[1]
