"""Grouping of matches: on made-up matches whose motion is known, and on what growth gives.

The shares that must be kept and removed are those that a prototype of the same rule reached.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

import pipefish as pf
from test_match import bent

Floats = NDArray[np.float64]
W, H = 240, 180


def made(
    motion: Callable[[Floats], Floats],
    places: Floats | None = None,
    noise: float = 0.1,
    wrong: float = 0.0,
    seed: int = 1,
) -> tuple[pf.Matches, NDArray[np.bool_]]:
    """Matches of every pixel (or of `places`) under `motion` with noise, a share of them wrong; which ones are."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(10, W - 10), np.arange(10, H - 10)), axis=-1).reshape(-1, 2).astype(float)
    xy1 = grid if places is None else places
    n, h = len(xy1), 0.5
    xy2 = motion(xy1) + rng.normal(0, noise, (n, 2))
    slope = [(motion(xy1 + h * d) - motion(xy1 - h * d)) / (2 * h) for d in np.eye(2)]
    affine = np.stack(slope, axis=2) + rng.normal(0, 0.02, (n, 2, 2))
    is_wrong = rng.random(n) < wrong
    xy2[is_wrong] = rng.uniform(0, (W, H), (is_wrong.sum(), 2))
    zncc = rng.uniform(0.8, 1, n)
    none = np.full(n, -1)
    m = pf.Matches(xy1, xy2, affine, zncc, none, none, pf.Seeds(xy1[:0], xy2[:0]), "ok", (H, W), (H, W))
    return m, is_wrong


def two_motions(x: Floats) -> Floats:
    """Left of a slanted line one motion, right of it another: they part by 12 px and 20 degrees."""
    left = (x[:, 0] - W / 2) + 0.4 * (x[:, 1] - H / 2) < 0
    a, b = np.array([[1.05, 0.1], [-0.08, 0.95]]), np.array([[0.9, -0.25], [0.3, 1.0]])
    c = np.array([W / 2, H / 2])
    return np.where(left[:, None], (x - c) @ a.T + c, (x - c) @ b.T + c + [12, 5])


def test_two_motions_become_two_groups_that_do_not_mix() -> None:
    m, _ = made(two_motions)
    g = pf.group_matches(m)
    left = (m.xy1[:, 0] - W / 2) + 0.4 * (m.xy1[:, 1] - H / 2) < 0
    large = [k for k in range(g.count) if (g.label == k).mean() > 0.05]
    assert len(large) == 2
    for k in large:
        share = left[g.label == k].mean()
        assert max(share, 1 - share) >= 0.99
    assert (g.label >= 0).mean() >= 0.93  # the rest is along the line


@pytest.mark.parametrize(("wrong", "kept"), [(0.1, 0.99), (0.3, 0.97), (0.5, 0.85)])
def test_random_wrong_matches_are_taken_out_and_right_ones_stay(wrong: float, kept: float) -> None:
    m, is_wrong = made(lambda x: x @ np.array([[0.9, 0.2], [-0.25, 1.1]]) + [20, 4], wrong=wrong)
    g = pf.group_matches(m)
    assert g.count >= 1
    assert (g.label[is_wrong] < 0).mean() >= 0.995
    assert (g.label[~is_wrong] >= 0).mean() >= kept


def test_a_bent_surface_stays_one_group() -> None:
    m, _ = made(lambda x: x + 12 * np.sin(2 * np.pi * x[:, ::-1] / 350))
    g = pf.group_matches(m)
    assert g.count == 1 and (g.label == 0).mean() >= 0.99


def test_a_bent_surface_stays_one_group_after_growth_too() -> None:
    m = pf.match_quasi_dense(*bent())
    g = pf.group_matches(m)
    assert g.count == 1 and (g.label == 0).mean() >= 0.97


def test_matches_without_a_common_motion_form_no_group() -> None:
    m, _ = made(lambda x: x, wrong=1.0)
    g = pf.group_matches(m)
    assert g.count == 0 and (g.label == -1).all() and g.triangles.shape == (0, 3)


def test_a_mirrored_neighbourhood_does_not_pass() -> None:
    """Positions are mirrored, maps are not: short edges alone would agree within their slack."""
    m, _ = made(lambda x: x * [-1, 1] + [W, 0])
    m.affine[...] = np.eye(2)
    assert pf.group_matches(m, agree_px=3).count == 0


def circumscribed(p: Floats) -> tuple[Floats, float]:
    a, b, c = p
    centre = np.linalg.solve(2 * np.array([b - a, c - a]), [b @ b - a @ a, c @ c - a @ a])
    return centre, float(np.linalg.norm(centre - a))


def test_triangles_are_delaunays() -> None:
    """No vertex within the circle of any triangle; none of the short and fat ones is missing."""
    rng = np.random.default_rng(2)
    places = np.unique(rng.integers(0, 60, (150, 2)), axis=0).astype(float)
    m, _ = made(lambda x: x, places, noise=0)
    m.affine[...] = np.eye(2)
    g = pf.group_matches(m, cell=1, least=3, agree_px=50)
    g2 = pf.group_matches(m, cell=1, least=3, agree_px=50)
    assert np.array_equal(g.triangles, g2.triangles) and len(g.triangles)
    for t in g.triangles:
        centre, radius = circumscribed(places[t])
        assert np.linalg.norm(places - centre, axis=1).min() >= radius - 1e-6


def test_points_of_a_lattice_which_lie_on_common_circles_are_triangulated_once() -> None:
    places = np.stack(np.meshgrid(np.arange(0, 60, 3), np.arange(0, 45, 3)), axis=-1).reshape(-1, 2).astype(float)
    m, _ = made(lambda x: x, places, noise=0)
    g = pf.group_matches(m, cell=3)
    assert len(g.triangles) == 2 * 19 * 14
    corners = places[g.triangles]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    assert np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2 == 57 * 42


def test_masks_and_contours_lie_where_the_group_is() -> None:
    """A disc of matches, made larger by 1.4 and moved: its area in both images, and the contour around it."""
    grid = np.stack(np.meshgrid(np.arange(W), np.arange(H)), axis=-1).reshape(-1, 2).astype(float)
    disc = grid[np.linalg.norm(grid - [90, 80], axis=1) <= 40]
    m, _ = made(lambda x: 1.4 * (x - [90, 80]) + [120, 90], disc, noise=0.05)
    g = pf.group_matches(m)
    assert g.count == 1
    r = 40 - 1.5  # the best match of a cell is up to 5 px from the rim
    for mask, lines, centre, radius in (
        (g.mask1(0), g.contours1(0), (90, 80), r),
        (g.mask2(0), g.contours2(0), (120, 90), 1.4 * r),
    ):
        assert mask.shape == (H, W)
        assert mask.sum() == pytest.approx(np.pi * radius**2, rel=0.08)
        assert len(lines) == 1
        far = np.linalg.norm(lines[0] - centre, axis=1)
        assert np.abs(far - radius).max() < 7
    grown = g.mask1(0, reach=4)
    assert grown.sum() == pytest.approx(np.pi * (r + 4) ** 2, rel=0.08) and (grown | ~g.mask1(0)).all()


@pytest.mark.parametrize(
    ("options", "what"),
    [({"cell": 0}, "cell: 0"), ({"agree_px": -1}, "agree_px: -1"), ({"least": 2}, "least: 2"),
     ({"agree_share": float("nan")}, "agree_share: nan")],
)  # fmt: skip
def test_wrong_options_are_named(options: dict, what: str) -> None:
    m, _ = made(lambda x: x, np.array([[1.0, 1.0]]))
    with pytest.raises(pf.ArgumentError, match=what):
        pf.group_matches(m, **options)
    with pytest.raises(pf.ArgumentError, match="group: 0"):
        pf.group_matches(m).mask1(0)
