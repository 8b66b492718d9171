"""ROC curves: against values worked out by hand, and the interval against what it promises."""

from __future__ import annotations

import numpy as np
import pytest

import pipefish as pf


def test_a_curve_worked_out_by_hand() -> None:
    r = pf.roc([0.9, 0.8, 0.7, 0.6, 0.5], [True, True, False, True, False])
    assert r.tpr.tolist() == pytest.approx([0, 1 / 3, 2 / 3, 2 / 3, 1, 1])
    assert r.fpr.tolist() == pytest.approx([0, 0, 0, 0.5, 0.5, 1])
    assert r.threshold.tolist() == [np.inf, 0.9, 0.8, 0.7, 0.6, 0.5]
    assert r.auc == pytest.approx(5 / 6)  # of 6 pairs one is the wrong way round
    assert r.tpr_at(0.0) == pytest.approx(2 / 3) and r.tpr_at(0.5) == 1
    assert r.equal_error() == pytest.approx(1 / 3)
    assert (r.positives, r.negatives) == (3, 2)


def test_equal_scores_count_half() -> None:
    assert pf.roc([1, 1, 1, 1], [True, False, True, False]).auc == pytest.approx(0.5)
    assert pf.roc([0, 0, 2], [True, False, True]).auc == pytest.approx(0.75)


def test_the_interval_holds_the_truth_95_times_of_100() -> None:
    """Scores of two normal distributions 1.8 apart: the area is Phi(1.8 / sqrt 2) = 0.8985."""
    rng = np.random.default_rng(1)
    truth = np.r_[np.ones(40, bool), np.zeros(160, bool)]
    inside = 0
    for _ in range(1000):
        low, high = pf.roc(rng.normal(1.8 * truth, 1), truth).interval
        inside += low <= 0.89845 <= high
    assert 0.93 <= inside / 1000 <= 0.98


def test_nothing_confused_is_no_certainty() -> None:
    low, high = pf.roc([2, 2, 2, 1, 1, 1, 1], [True] * 3 + [False] * 4).interval
    assert high == 1 and 0.4 < low < 0.9


@pytest.mark.parametrize(
    ("score", "truth", "what"),
    [
        ([1, 2], [True, True], "2 present and 0 absent"),
        ([1, 2], [True], "shapes"),
        ([np.nan, 1], [True, False], "score"),
    ],
)
def test_wrong_arguments_are_named(score: list, truth: list, what: str) -> None:
    with pytest.raises(pf.ArgumentError, match=what):
        pf.roc(score, truth)
