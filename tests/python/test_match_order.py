"""Growth takes the best first by classes of correlation, the last found first within one. Beside an order that has a
class for each value, which is a heap's, that costs nothing."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipefish import _engine

Floats = NDArray[np.float64]
WIDTH, HEIGHT = 260, 200
STRICT = 1 << 24  # classes: each float from 0.5 to 1 has one to itself


def scene() -> tuple[list[NDArray[np.float32]], Floats]:
    """Two views with noise of 0.02, a third of the picture 14 pixels nearer: the order decides who gets its rim. The
    true place in view 2 of each pixel, NaN where hidden."""
    rng = np.random.default_rng(21)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)

    def waves(u: Floats, v: Floats, seed: int) -> Floats:
        r = np.random.default_rng(seed)
        length, turn, phase = 5 * 6 ** r.random(50), r.uniform(0, 2 * np.pi, 50), r.uniform(0, 2 * np.pi, 50)
        kx, ky = 2 * np.pi / length * np.cos(turn), 2 * np.pi / length * np.sin(turn)
        return 0.5 + 0.03 * sum(np.cos(a * u + b * v + c) for a, b, c in zip(kx, ky, phase, strict=True))

    # View 2 is x' = 1.06 x - 6, 14 further right for what is in front; `inside` is that in view 1.
    def inside(u: Floats, v: Floats) -> NDArray[np.bool_]:
        return (np.abs(u - 130) < 45) & (np.abs(v - 100) < 60)

    one = np.where(inside(x, y), waves(x, y, 2), waves(x, y, 1))
    behind, front = (x + 6) / 1.06, (x - 8) / 1.06
    two = np.where(inside(front, y), waves(front, y, 2), waves(behind, y, 1))
    pictures = [(p + rng.normal(0, 0.02, p.shape)).clip(0, 1).astype(np.float32) for p in (one, two)]
    there = np.where(inside(x, y), 1.06 * x + 8, 1.06 * x - 6)
    hidden = ~inside(x, y) & inside((there - 8) / 1.06, y)
    there[hidden] = np.nan
    return pictures, np.stack([there, y], axis=-1)


@pytest.mark.parametrize("mode", ["adaptive", "translation"])
def test_classes_of_correlation_are_as_good_an_order_as_a_strict_one(mode: str) -> None:
    pictures, truth = scene()
    at = np.array([[40.0, 40.0], [220.0, 160.0], [130.0, 100.0]])
    grown, place, right = [], [], []
    for classes in (1024, STRICT):
        options = _engine.MatchOptions()
        options.mode, options.radius = getattr(_engine.MatchMode, mode), 5 if mode == "adaptive" else 3
        options.classes = classes
        seeds = at, truth[at[:, 1].astype(int), at[:, 0].astype(int)], np.tile(np.diag([1.06, 1.0]), (3, 1, 1))
        got = _engine.grow_matches(*pictures, *seeds, options, None, None, None)
        x, y = got["xy1"].astype(int).T
        to = np.full((HEIGHT, WIDTH, 2), np.nan)
        to[y, x] = got["xy2"]
        off = np.linalg.norm(got["xy2"] - truth[y, x], axis=1)
        place.append(to)
        grown.append(len(x))
        right.append((np.median(off[off < 1]), np.mean(off < 1)))
    both = np.isfinite(place[0][..., 0]) & np.isfinite(place[1][..., 0])
    assert both.sum() >= 0.99 * max(grown)
    assert np.mean(np.linalg.norm(place[0][both] - place[1][both], axis=1) < 0.5) >= 0.98
    (median, share), (strict_median, strict_share) = right
    assert share > 0.9 and share >= strict_share - 0.002 and median <= 1.01 * strict_median
