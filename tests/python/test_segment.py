"""Motion segmentation: the labels' minimisation, layers and fields on pictures whose truth is known, files."""

from __future__ import annotations

import numpy as np

from pipefish import _engine


def labelling(rng: np.random.Generator) -> tuple:
    """A random problem as those of segmentation, small: two images of 2 x 4 pixels, three labels."""
    n = 16
    cost = rng.integers(0, 60, (3, n)).astype(np.int32)
    cost[1:][rng.random((2, n)) < 0.15] = 1_000_000
    edges = []
    for image in (0, 8):
        for y in range(2):
            for x in range(4):
                p = image + 4 * y + x
                edges += [(p, p + 1)] if x < 3 else []
                edges += [(p, p + 4)] if y < 1 else []
                edges += [(p, p + 5)] if x < 3 and y < 1 else []
    ends = np.array(edges, np.int32)
    weight = rng.integers(0, 40, len(ends)).astype(np.int32)
    partner = np.full((3, n), -1, np.int32)
    partner[1:, :8], partner[1:, 8:] = rng.integers(8, 16, (2, 8)), rng.integers(0, 8, (2, 8))
    partner[1:][rng.random((2, n)) < 0.2] = -1
    labels = rng.integers(0, 3, n)
    labels[cost[labels, np.arange(n)] >= 1_000_000] = 0
    return cost, ends, weight, partner, int(rng.integers(0, 30)), labels.astype(np.uint8)


def energies(cost, ends, weight, partner, lonely, labels) -> np.ndarray:
    """(M,) of labels (M,N), by the definition."""
    n = np.arange(labels.shape[1])
    out = cost[labels, n].sum(axis=1, dtype=np.int64)
    out += ((labels[:, ends[:, 0]] != labels[:, ends[:, 1]]) * weight).sum(axis=1)
    to = partner[labels, n]
    alone = (labels > 0) & (to >= 0) & (np.take_along_axis(labels, np.maximum(to, 0), axis=1) != labels)
    return out + lonely * alone.sum(axis=1)


def expansion_errors(problems: int, seed: int) -> int:
    """How many single expansions of random problems end above the least energy of all 2^16 choices."""
    rng = np.random.default_rng(seed)
    choice = (np.arange(1 << 16)[:, None] >> np.arange(16)) & 1
    wrong = 0
    for _ in range(problems):
        *problem, labels = labelling(rng)
        alpha = int(rng.integers(0, 3))
        free = np.flatnonzero((labels != alpha) & (problem[0][alpha] < 1_000_000))
        every = np.repeat(labels[None], 1 << len(free), axis=0)
        every[:, free] = np.where(choice[: 1 << len(free), : len(free)] > 0, alpha, every[:, free])
        best = energies(*problem, every).min()
        got, energy = _engine.segment_expand(*problem, alpha, labels)
        wrong += energy != best or energies(*problem, got[None])[0] != best
    return wrong


def test_an_expansion_finds_the_best_of_all_choices():
    """The cut against brute force, couplings between the images and forbidden labels among the costs."""
    assert expansion_errors(100, seed=1) == 0


def test_expanding_all_labels_never_raises_the_energy():
    rng = np.random.default_rng(2)
    for _ in range(200):
        *problem, labels = labelling(rng)
        before = energies(*problem, labels[None])[0]
        got, energy = _engine.segment_expand(*problem, -1, labels)
        assert energy == energies(*problem, got[None])[0] <= before
        assert all(_engine.segment_expand(*problem, alpha, got)[1] == energy for alpha in range(3))
