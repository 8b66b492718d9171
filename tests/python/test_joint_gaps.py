"""An open joint's width from the unrolled picture: a dark ring all around, and nothing else dark."""

from __future__ import annotations

import numpy as np
import pytest

from pipefish.joint_gaps import find_ring

CELL, PIXEL, ROWS = 0.0005, 0.0009, 1080
X = (np.arange(240) - 119.5) * CELL


def unrolled(
    seed: int, gap: float = 0.0, at: float = 0.004, around: float = 1.0, dark: float = 40.0, wander: float = 0.0
) -> np.ndarray:
    """(ROWS, 240) uint8: a blotchy wall, a ring of that width at `at` over so much of the turn, as a picture of PIXEL
    shows it; wander: how far it goes to and fro."""
    rng = np.random.default_rng(seed)
    blotches = np.kron(rng.normal(115, 15, (ROWS // 60, 6)), np.ones((60, 40)))
    turn = np.arange(ROWS) / ROWS
    away = np.abs(X - at - wander * np.sin(6 * np.pi * turn)[:, None])
    share = np.clip((gap / 2 - away) / PIXEL + 0.5, 0, 1) * (turn < around)[:, None]
    return np.clip(blotches * (1 - share) + dark * share + rng.normal(0, 3, share.shape), 0, 255).astype(np.uint8)


def ring(grey: np.ndarray, seen: np.ndarray | None = None):
    return find_ring(grey, np.full_like(grey, 255) if seen is None else seen, X, 0.0, 0.02, PIXEL)


@pytest.mark.parametrize("gap", [0.003, 0.008, 0.02])
def test_a_gap_has_its_width_and_place(gap: float) -> None:
    errors = []
    for seed in range(5):
        found = ring(unrolled(seed, gap))
        assert found is not None and abs(found.middle - 0.004) < 0.0003
        errors.append((found.width - gap) / found.sigma)
        assert found.sigma < 0.001
    assert max(np.abs(errors)) < 2


def test_what_is_seen_of_two_thirds_of_the_turn_is_told_and_less_is_not() -> None:
    for share, is_told in ((0.8, True), (0.5, False)):
        seen = np.full((ROWS, 240), 255, np.uint8)
        seen[int(share * ROWS) :] = 0
        assert (ring(unrolled(1, 0.008), seen) is not None) is is_told


@pytest.mark.parametrize(
    "grey",
    [unrolled(1), unrolled(2, 0.008, around=0.5), unrolled(3, 0.008, dark=100.0), unrolled(4, 0.005, wander=0.012)],
    ids=["no joint", "half a ring", "a stain", "a crack that wanders"],
)
def test_what_is_no_dark_ring_is_no_gap(grey: np.ndarray) -> None:
    assert ring(grey) is None
