"""Quasi-dense matching on images whose truth is exact: a sum of waves, warped by evaluating it elsewhere.

Accuracies are those that a prototype of the same method reached on such images, with a margin for the texture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

import pipefish as pf
from pipefish import _engine
from pipefish.matching_filters import select

Floats = NDArray[np.float64]
Map = Callable[[Floats], Floats]
W, H = 200, 160
CENTRE = np.array([(W - 1) / 2, (H - 1) / 2])


def waves(xy: Floats, seed: int = 1, waves_: int = 90) -> Floats:
    """A texture, band-limited: wavelengths 4.5 to 40 pixels, (..., 2) -> (...) of 0..1."""
    rng = np.random.default_rng(seed)
    length = 4.5 * (40 / 4.5) ** rng.random(waves_)
    turn, phase = rng.random((2, waves_)) * 2 * np.pi
    k = 2 * np.pi / length[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    flat = xy.reshape(-1, 2).astype(np.float32)
    value = np.cos(flat @ k.T.astype(np.float32) + phase.astype(np.float32)).sum(axis=1) / np.sqrt(waves_ / 2)
    return (0.5 + 0.14 * value).reshape(xy.shape[:-1]).clip(0, 1)


def grid(width: int = W, height: int = H) -> Floats:
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)


def noisy(image: Floats, seed: int) -> NDArray[np.float32]:
    return (image + np.random.default_rng(seed).normal(0, 0.01, image.shape)).clip(0, 1).astype(np.float32)


def pair(back: Map, noise: bool = True) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Image 1 and what it becomes; back: pixels of image 2 -> pixels of image 1."""
    one, two = waves(grid()), waves(back(grid()))
    return (noisy(one, 5), noisy(two, 6)) if noise else (one.astype(np.float32), two.astype(np.float32))


def errors(m: pf.Matches, there: Map) -> Floats:
    return np.linalg.norm(m.xy2 - there(m.xy1), axis=1)


MARGIN = 7  # pixels of the coarser image that growth keeps from a rim: window 5, the fit's and the search's one each


def slopes(there: Map, xy: Floats) -> Floats:
    """(K,2,2): what maps offsets from xy to offsets from there(xy)."""
    h = 0.25
    return np.stack([(there(xy + h * d) - there(xy - h * d)) / (2 * h) for d in np.eye(2)], axis=2)


def common(there: Map, margin: int = MARGIN, size: tuple[int, int] = (W, H)) -> int:
    """Cells of image 2 for pixels of image 1 whose windows of that half side, in the coarser image, are in both."""
    xy = grid(*size).reshape(-1, 2)
    to, slope, end = there(xy), slopes(there, xy), np.array(size) - 1
    half = margin * np.maximum(1, np.abs(np.linalg.det(slope)) ** -0.5)
    keep = np.minimum(xy, end - xy).min(axis=1) >= half
    keep &= (np.minimum(to, end - to) >= half[:, None] * np.abs(slope).sum(axis=2)).all(axis=1)
    return len(np.unique(np.rint(to[keep]), axis=0))


def affine(a: Floats, shift: tuple[float, float] = (0, 0)) -> tuple[Map, Map]:
    """there and back of x -> a (x - centre) + centre + shift."""
    t = np.asarray(shift)
    return (lambda x: (x - CENTRE) @ a.T + CENTRE + t), (lambda y: (y - CENTRE - t) @ np.linalg.inv(a).T + CENTRE)


def one_seed(there: Map, a: Floats, off: float = 0.0) -> pf.Seeds:
    """At the centre; its map wrong by `off` in each entry."""
    at = np.rint(CENTRE)[None]
    return pf.Seeds(at, there(at), (a + off * np.array([[1, -1], [1, 1]]))[None])


def textured(image: NDArray[np.float32], xy: Floats) -> NDArray[np.bool_]:
    """(K,): some of the four neighbours differs by a hundredth."""
    x, y = xy.astype(int).T
    near = [image[y + dy, x + dx] for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    return np.abs(np.array(near) - image[y, x]).max(axis=0) >= 0.01


def check_invariants(m: pf.Matches, *images: NDArray[np.float32]) -> None:
    """One-to-one in both images, chains of parents that end in seeds, correlation above the bound; in the images, where
    given, matches are where there is texture."""
    for image, xy in zip(images, (m.xy1, np.floor(m.xy2 + 0.5)), strict=False):
        assert textured(image, xy).all()
    for xy in (m.xy1, np.floor(m.xy2 + 0.5)):
        assert len(np.unique(xy, axis=0)) == len(m)
    k = np.arange(len(m))
    assert (m.parent < k).all() and (m.parent >= -1).all()
    grown = m.parent >= 0
    assert np.array_equal(m.seed[grown], m.seed[m.parent[grown]])
    assert np.abs(m.xy1[grown] - m.xy1[m.parent[grown]]).max() <= 2
    assert m.zncc.min() >= 0.8 and m.zncc.max() <= 1 + 1e-5
    assert (np.linalg.det(m.affine) > 0).all()


@pytest.mark.parametrize(("mode", "median"), [("adaptive", 0.05), ("constant", 0.05), ("translation", 0.12)])
def test_the_same_image_twice_matches_everywhere(mode: str, median: float) -> None:
    there, back = affine(np.eye(2))
    one, two = pair(back, noise=False)
    m = pf.match_quasi_dense(one, two, one_seed(there, np.eye(2)), mode=mode)
    check_invariants(m)
    assert m.status == "ok"
    assert len(m) >= 0.98 * common(there, 12)
    e = errors(m, there)
    assert np.abs(m.xy2 - m.xy1).max() <= 0.5 and np.median(e) <= median


def test_a_shift_by_part_of_a_pixel_is_measured_without_bias() -> None:
    there, back = affine(np.eye(2), (20.3, 10.45))
    m = pf.match_quasi_dense(*pair(back), one_seed(there, np.eye(2)))
    assert len(m) >= 0.85 * common(there, 8)
    assert np.median(errors(m, there)) <= 0.06
    assert np.abs((m.xy2 - there(m.xy1)).mean(axis=0)).max() <= 0.01


@pytest.mark.parametrize("scale", [0.5, 0.7, 1.0, 1.5])
def test_an_affine_map_is_covered_and_recovered(scale: float) -> None:
    a = scale * np.array([[0.95, -0.25], [0.3, 1.05]])
    there, back = affine(a)
    one, two = pair(back)
    m = pf.match_quasi_dense(one, two, one_seed(there, a, 0.05))
    check_invariants(m, one, two)
    e = errors(m, there)
    assert len(m) >= 0.95 * common(there)
    assert np.median(e) <= 0.06 and np.mean(e < 1) >= 0.99
    assert np.median(np.linalg.norm(m.affine - a, axis=(1, 2))) <= 0.03


def bend(x: Floats) -> Floats:
    """A smooth map that no affine one is like: areas grow by 0.6 to 1.3 across the image."""
    u = (x - CENTRE) / 40
    return x + 6 * np.stack([np.sin(u[..., 1]) + 0.5 * u[..., 0] ** 2, np.sin(1.3 * u[..., 0])], axis=-1)


def unbend(y: Floats) -> Floats:
    x = y.copy()
    for _ in range(60):
        x += y - bend(x)
    return x


@cache
def bent() -> tuple[NDArray[np.float32], NDArray[np.float32], pf.Seeds]:
    """The bend's pair, and a seed in its middle."""
    return (*pair(unbend), one_seed(bend, slopes(bend, np.rint(CENTRE)[None])[0]))


@cache
def grown_constant() -> pf.Matches:
    return pf.match_quasi_dense(*bent(), mode="constant", radius=5)


def map_error(m: pf.Matches, there: Map) -> float:
    """Median Frobenius error of the affine maps."""
    return float(np.median(np.linalg.norm(m.affine - slopes(there, m.xy1), axis=(1, 2))))


def test_an_adaptive_map_follows_a_bend_that_a_constant_one_leaves() -> None:
    adaptive, constant = pf.match_quasi_dense(*bent()), grown_constant()
    check_invariants(adaptive, *bent()[:2])
    area = common(bend)
    assert len(adaptive) >= 0.95 * area and len(constant) <= 0.87 * area
    e = errors(adaptive, bend)
    assert np.median(e) <= 0.087 and np.mean(e < 0.5) >= 0.99
    assert np.median(e) < 0.5 * np.median(errors(constant, bend))


def test_a_strong_homography_is_covered_from_one_seed() -> None:
    """Areas change from 0.3 to 1.9 times over the image; noise of 0.02; the seed's map is off by 0.05."""
    width, height = 300, 240
    h = np.array([[1.15, 0.15, -18], [0.05, 1.0, -6], [0.0013 / 0.6, 0.0002 / 0.6, 0.72]])

    def through(m: Floats) -> Map:
        def there(p: Floats) -> Floats:
            q = np.concatenate([p, np.ones((*p.shape[:-1], 1))], axis=-1) @ m.T
            return q[..., :2] / q[..., 2:]

        return there

    there, rng, xy = through(h), np.random.default_rng(0), grid(width, height)
    pictures = (waves(xy), waves(through(np.linalg.inv(h))(xy)))
    one, two = ((p + rng.normal(0, 0.02, p.shape)).clip(0, 1).astype(np.float32) for p in pictures)
    at = np.array([[150.0, 120.0]])
    seed = pf.Seeds(at, there(at), slopes(there, at) + 0.05 * np.array([[1, -1], [1, 1]]))
    area = common(there, MARGIN, (width, height))
    adaptive, constant = (pf.match_quasi_dense(one, two, seed, mode=k, radius=5) for k in ("adaptive", "constant"))
    e = errors(adaptive, there)
    assert len(adaptive) >= 0.94 * area and len(constant) <= 0.75 * area
    assert np.median(e) <= 0.093 and np.mean(e < 0.5) >= 0.968
    assert np.median(e) < 0.5 * np.median(errors(constant, there))


@pytest.mark.parametrize("adaptation", ["gradient", "intensity"])
@pytest.mark.parametrize("turn", ["correlation", "peak"])
def test_the_moments_of_the_papers_grow_too(adaptation: str, turn: str) -> None:
    """Their maps are at least twice as near to the truth as the seed's map; ten times with gradients, where a fit
    follows."""
    m = pf.match_quasi_dense(*bent(), adaptation=adaptation, turn=turn)
    check_invariants(m)
    assert len(m) >= 0.95 * common(bend)
    assert np.mean(errors(m, bend) < 1) >= 0.97
    assert map_error(m, bend) <= (0.5 if adaptation == "intensity" else 0.1) * map_error(grown_constant(), bend)


def test_brightness_does_not_count() -> None:
    a = np.array([[1.1, 0.1], [-0.1, 0.95]])
    there, back = affine(a)
    one, two = pair(back)
    plain, changed = (pf.match_quasi_dense(one, b, one_seed(there, a)) for b in (two, 0.5 * two + 0.2))
    both = (plain.map1() >= 0) & (changed.map1() >= 0)
    assert both.sum() >= 0.97 * max(len(plain), len(changed))
    k, j = plain.map1()[both], changed.map1()[both]
    assert np.mean(np.linalg.norm(plain.xy2[k] - changed.xy2[j], axis=1) < 0.1) >= 0.99


def grown_from_anything(
    one: NDArray[np.float32], two: NDArray[np.float32], radius: int, fitted: bool
) -> tuple[int, int]:
    """200 random seeds, whatever they correlate at: candidates tried, matches grown."""
    rng = np.random.default_rng(3)
    ends = [np.array(p.shape[::-1]) - 20 for p in (one, two)]
    xy1, xy2 = (rng.uniform(20, end, (200, 2)) for end in ends)
    options = _engine.MatchOptions()
    options.mode, options.radius = _engine.MatchMode.adaptive, radius
    options.seed_zncc_min, options.refine_seeds = -1.0, fitted
    got = _engine.grow_matches(one, two, xy1, xy2, np.tile(np.eye(2), (200, 1, 1)), options, None, None, None)
    assert got["seeds_used"] > 150
    return got["tried"], int((got["parent"] >= 0).sum())


@pytest.mark.parametrize(("radius", "most"), [(5, 0.001), (3, 0.01)])
def test_wrong_seeds_do_not_grow_over_images_with_nothing_in_common(radius: int, most: float) -> None:
    one, two = (noisy(waves(grid(500, 400), seed=k), k) for k in (1, 2))
    tried, grown = grown_from_anything(one, two, radius, fitted=False)
    assert tried > 1000 and grown <= most * one.size


def test_images_with_nothing_in_common_do_not_match() -> None:
    """Random seeds are refused as seeds; those that are found grow to islands."""
    one, two = (noisy(waves(grid(), seed=k), k) for k in (1, 2))
    m = pf.match_quasi_dense(one, two, np.random.default_rng(3).uniform(20, 140, (200, 4)))
    assert m.status == "no seeds" and len(m) == 0
    assert pf.match_quasi_dense(one, two).status in ("no seeds", "no growth")


def test_a_flat_image_has_no_seeds() -> None:
    flat = np.full((H, W), 128, np.uint8)
    m = pf.match_quasi_dense(flat, flat)
    assert m.status == "no seeds" and len(m) == 0 and m.xy1.shape == (0, 2) and m.affine.shape == (0, 2, 2)


def test_threads_do_not_change_the_result() -> None:
    a = np.array([[0.9, -0.2], [0.25, 1.0]])
    one, two = pair(affine(a)[1])
    first, second = (pf.match_quasi_dense(one, two, threads=n) for n in (1, 8))
    assert len(first) > 1000
    for name in ("xy1", "xy2", "affine", "zncc", "parent", "seed"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


def test_work_is_linear_in_the_matches() -> None:
    """Candidates tried for each match do not grow with the images."""
    tried = []
    for k in (1, 2):
        at, x, shift = np.array([[60.0 * k, 50.0 * k]]), grid(k * W, k * H), np.array([3.3, 2.4])
        one, two = noisy(waves(x), 5), noisy(waves(x - shift), 6)
        m = pf.match_quasi_dense(one, two, (at, at + shift), mode="constant")
        assert len(m) > 0.7 * k**2 * W * H
        tried.append(m.counts["tried"] / len(m))
    assert abs(tried[1] / tried[0] - 1) < 0.1


@pytest.mark.parametrize("degrees", [0, 60])
def test_seeds_are_found_with_their_maps(degrees: float) -> None:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    a = np.array([[c, -s], [s, c]]) @ np.diag([1.0, 0.6])
    there, back = affine(a)
    one, two = pair(back)
    seeds = pf.find_seeds(one, two)
    good = np.linalg.norm(seeds.xy2 - there(seeds.xy1), axis=1) < 2
    assert good.sum() >= 20 and good.mean() >= 0.7
    off = np.linalg.norm(seeds.affine[good] - a, axis=(1, 2))
    assert np.median(off) <= 0.25
    m = pf.match_quasi_dense(one, two)
    assert m.status == "ok" and np.mean(errors(m, there) < 1) >= 0.99


# ---- two views of a plane by a fisheye camera


FISHEYE = pf.Camera(width=W, height=H, f_u=70.0, f_v=70.0, c_u=99.5, c_v=79.5, theta_max=2.0)
POSE = np.hstack([np.array([[0.98, 0, 0.199], [0, 1, 0], [-0.199, 0, 0.98]]), [[0.25], [0.05], [0.1]]])
POSE[:, :3] = np.linalg.svd(POSE[:, :3])[0] @ np.linalg.svd(POSE[:, :3])[2]


def seen(pixels: Floats, pose: Floats) -> Floats:
    """Where pixels' rays meet the plane z = 1 of the first camera's frame; pose is cam_from_first."""
    rays, ok = FISHEYE.unproject(pixels.reshape(-1, 2))
    centre = -pose[:, :3].T @ pose[:, 3]
    d = rays @ pose[:, :3]
    far = np.where(d[:, 2] > 0.2, (1 - centre[2]) / np.maximum(d[:, 2], 0.2), np.nan)
    xyz = centre + far[:, None] * d
    xyz[~ok] = np.nan
    return xyz.reshape(*pixels.shape[:-1], 3)


def rendered(pose: Floats) -> NDArray[np.float32]:
    xyz = seen(grid(), pose)
    value = waves(np.nan_to_num(xyz[..., :2]) * 110)
    return np.where(np.isfinite(xyz[..., 0]), value, 0.5).astype(np.float32)


def fisheye_truth(pixels: Floats) -> Floats:
    xyz = seen(pixels, np.eye(3, 4))
    return FISHEYE.project(xyz @ POSE[:, :3].T + POSE[:, 3])[0]


def fisheye_seed() -> pf.Seeds:
    at, h = np.rint(CENTRE), 0.01
    slope = np.stack([fisheye_truth((at + h * d)[None])[0] - fisheye_truth((at - h * d)[None])[0] for d in np.eye(2)])
    return pf.Seeds(at[None], fisheye_truth(at[None]), slope.T[None] / (2 * h))


def test_fisheye_images_match_as_they_are_and_geometry_holds_the_maps() -> None:
    one, two = rendered(np.eye(3, 4)), rendered(POSE)
    plain = pf.match_quasi_dense(one, two, fisheye_seed())
    held = pf.match_quasi_dense(one, two, fisheye_seed(), FISHEYE, POSE)
    wrong = pf.match_quasi_dense(one, two, fisheye_seed(), FISHEYE, np.hstack([POSE[:, :3], -POSE[[1, 2, 0], 3:]]))
    for m in (plain, held):
        check_invariants(m)
        e = errors(m, fisheye_truth)
        assert len(m) > 8000 and np.median(e) <= 0.06 and np.mean(e < 1) >= 0.99
    assert len(wrong) < 0.5 * len(held)

    def residual(m: pf.Matches) -> float:
        """Median of |A^T n' + n| / |n|, the epipolar constraint on the map; n and n' by differences."""
        t = POSE[:, 3]
        e = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ POSE[:, :3]
        off = [np.zeros(2), np.array([1e-4, 0]), np.array([0, 1e-4])]
        f = [FISHEYE.unproject(m.xy1 + d)[0] for d in off]
        g = [FISHEYE.unproject(m.xy2 + d)[0] for d in off]
        base = np.einsum("ki,ij,kj->k", g[0], e, f[0])
        n = np.stack([np.einsum("ki,ij,kj->k", g[0], e, f[d]) - base for d in (1, 2)], axis=1)
        n2 = np.stack([np.einsum("ki,ij,kj->k", g[d], e, f[0]) - base for d in (1, 2)], axis=1)
        r = np.einsum("kji,kj->ki", m.affine, n2) + n
        return float(np.median(np.linalg.norm(r, axis=1) / np.linalg.norm(n, axis=1)))

    assert residual(held) < 0.5 * residual(plain)


def test_turns_by_epipolar_lines() -> None:
    one, two = rendered(np.eye(3, 4)), rendered(POSE)
    m = pf.match_quasi_dense(one, two, fisheye_seed(), FISHEYE, POSE, adaptation="gradient", turn="epipolar")
    assert len(m) > 8000 and np.mean(errors(m, fisheye_truth) < 1) >= 0.98


def test_intensity_moments_turned_by_epipolar_lines_follow_a_fisheyes_maps() -> None:
    """The papers' way. The seed's map alone covers less than half as much."""
    one, two = rendered(np.eye(3, 4)), rendered(POSE)
    m = pf.match_quasi_dense(one, two, fisheye_seed(), FISHEYE, POSE, adaptation="intensity", turn="epipolar")
    constant = pf.match_quasi_dense(one, two, fisheye_seed(), FISHEYE, POSE, mode="constant", radius=5)
    e = errors(m, fisheye_truth)
    assert len(m) >= 13_000 and len(m) > 2 * len(constant)
    assert np.median(e) <= 0.08 and np.mean(e < 1) >= 0.98
    assert map_error(m, fisheye_truth) < map_error(constant, fisheye_truth)


# ---- invariants, and what filters take away


def test_swapped_images_give_the_inverse_map() -> None:
    a = np.array([[0.9, -0.2], [0.25, 1.0]])
    there, back = affine(a)
    one, two = pair(back)
    m = pf.match_quasi_dense(one, two, one_seed(there, a))
    reverse = pf.match_back(one, two, m)
    check_invariants(reverse)
    index = reverse.map1()
    x, y = np.rint(m.xy2).astype(int).T
    k = np.flatnonzero(index[y, x] >= 0)
    j = index[y, x][k]
    home = reverse.xy2[j] + np.einsum("kij,kj->ki", reverse.affine[j], m.xy2[k] - reverse.xy1[j])
    assert len(k) >= 0.9 * len(m)
    assert np.mean(np.linalg.norm(home - m.xy1[k], axis=1) < 1) >= 0.95


def test_children_are_where_their_parents_map_has_them() -> None:
    """To the search's one pixel, half of one for the fraction and one for the fit, in units of the map."""
    for m in (pf.match_quasi_dense(*bent(), mode=k) for k in ("constant", "adaptive")):
        check_invariants(m)
        child = np.flatnonzero(m.parent >= 0)
        up = m.parent[child]
        off = m.xy2[child] - m.xy2[up] - np.einsum("kij,kj->ki", m.affine[up], m.xy1[child] - m.xy1[up])
        bound = 1.5 * np.maximum(1, np.linalg.norm(m.affine[up], 2, axis=(1, 2))) + 1
        assert (np.abs(off).max(axis=1) <= bound).all()


def spoiled(m: pf.Matches, share: float) -> tuple[pf.Matches, NDArray[np.bool_]]:
    """Some matches moved by 5 to 30 pixels, islands of 4 x 4 among them; and which."""
    rng = np.random.default_rng(8)
    corner = (m.xy1 // 4).astype(int)
    wrong = rng.random((H // 4 + 1, W // 4 + 1))[corner[:, 1], corner[:, 0]] < share
    shift = rng.uniform(5, 30, (H // 4 + 1, W // 4 + 1, 2))[corner[:, 1], corner[:, 0]]
    to = np.clip(m.xy2 + wrong[:, None] * shift, 0, [W - 1, H - 1])
    _, first = np.unique(np.rint(to), axis=0, return_index=True)
    keep = np.zeros(len(m), bool)
    keep[first] = True
    return select(replace(m, xy2=to), keep), wrong[keep]


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_what_contradicts_its_neighbours_goes(scale: float) -> None:
    a = scale * np.array([[0.95, -0.2], [0.25, 1.0]])
    there, back = affine(a)
    m, wrong = spoiled(pf.match_quasi_dense(*pair(back), one_seed(there, a)), 0.1)
    kept = pf.filter_matches(m)
    off = errors(kept, there) > 3
    assert wrong.sum() > 200 and off.sum() <= 0.02 * wrong.sum()
    assert len(kept) >= 0.9 * (~wrong).sum()
    grown = kept.parent >= 0  # whose parents went have grandparents now
    assert (kept.parent < np.arange(len(kept))).all()
    assert np.array_equal(kept.seed[grown], kept.seed[kept.parent[grown]])


@pytest.mark.parametrize("geometry", ["plane", "motion"])
def test_what_is_off_the_plane_or_the_motion_goes(geometry: str) -> None:
    """Of two planes 6 pixels apart under one motion along x, `plane` keeps the larger one, `motion` both; neither keeps
    what is wrong."""

    def there(x: Floats) -> Floats:
        step = 8 + 0.02 * x[..., :1] + np.where(x[..., 1:] > 0.7 * H, 6.0, 0.0)
        return x + np.concatenate([step, 0 * step], axis=-1)

    one = waves(grid())
    x2 = grid()
    source = x2[..., 0] - 8 - np.where(x2[..., 1] > 0.7 * H, 6.0, 0.0)
    two = waves(np.stack([source / 1.02, x2[..., 1]], axis=-1))
    at = np.array([[60.0, 40.0], [60.0, 140.0]])
    m = pf.match_quasi_dense(noisy(one, 1), noisy(two, 2), pf.Seeds(at, there(at)))
    m, wrong = spoiled(m, 0.15)
    kept = pf.filter_matches(m, least=0, geometry=geometry)
    lower = kept.xy1[:, 1] > 0.7 * H + 6
    right = ~wrong & (m.xy1[:, 1] < 0.7 * H - 6)
    if geometry == "plane":
        assert np.mean(errors(kept, there) > 3) <= 0.01
        assert lower.sum() <= 0.02 * len(kept)
    else:
        assert np.abs(kept.xy2[:, 1] - kept.xy1[:, 1]).max() <= 2.5  # lines of this motion are rows
        assert lower.sum() >= 0.8 * (~wrong & (m.xy1[:, 1] > 0.7 * H + 6)).sum()
    assert (~lower).sum() >= 0.9 * right.sum()


def fence(xy: Floats) -> Floats:
    """Left of the middle like nothing else, right of it bars 9 pixels apart, alike along x."""
    bars = waves(np.stack([2 * np.cos(2 * np.pi * xy[..., 0] / 9), xy[..., 1] + 500], axis=-1), 3)
    return np.where(xy[..., 0] < W / 2, waves(xy), bars)


def test_what_could_as_well_be_elsewhere_on_its_epipolar_line_goes() -> None:
    """Two planes under a motion along x; the right one repeats itself along x, all of it right but none of it sure."""
    one, two = fence(grid()), np.where(grid()[..., 0] < W / 2, fence(grid() - [0.3, 0]), fence(grid() - [6.3, 0]))
    one, two = one.astype(np.float32), two.astype(np.float32)
    seeds = pf.Seeds(np.array([[50.0, 80.0], [150.0, 80.0]]), np.array([[50.3, 80.0], [156.3, 80.0]]))
    m = pf.match_quasi_dense(one, two, seeds)
    m = select(m, np.arange(len(m)) % 3 == 0)
    sideways = np.array([[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]])
    pinhole = pf.Camera(
        width=W, height=H, f_u=200.0, f_v=200.0, c_u=99.5, c_v=79.5, theta_max=0.6, radial="perspective"
    )
    left, right = m.xy1[:, 0] < W / 2 - 30, m.xy1[:, 0] > W / 2 + 30
    assert min(left.sum(), right.sum()) > 1300
    for geometry in ((pinhole, sideways), ()):
        ratio = pf.match_rivals(one, two, m, *geometry)
        assert np.mean(ratio[left] < 0.9) > 0.97 and np.mean(ratio[right] >= 0.98) > 0.95
    kept = pf.filter_matches(m, least=0, rivals=ratio)
    assert np.mean(kept.xy1[:, 0] > W / 2 + 30) < 0.05 and (kept.xy1[:, 0] < W / 2 - 30).sum() > 0.97 * left.sum()
    with pytest.raises(pf.ArgumentError, match="rivals: shape"):
        pf.filter_matches(m, rivals=ratio[1:])


def test_rivals_are_looked_for_along_the_curve_of_a_fisheye() -> None:
    """The plane's texture is like itself nowhere: few have a rival, on 1 thread or 3."""
    one, two = rendered(np.eye(3, 4)), rendered(POSE)
    m = pf.match_quasi_dense(one, two, fisheye_seed(), FISHEYE, POSE)
    m = select(m, np.arange(len(m)) % 4 == 0)
    ratio = pf.match_rivals(one, two, m, FISHEYE, POSE)
    assert len(m) > 2000 and np.mean(ratio < 0.98) > 0.99 and np.median(ratio) > 0.1
    assert np.array_equal(ratio, pf.match_rivals(one, two, m, FISHEYE, POSE, threads=3))


def test_matches_that_nothing_holds_together_come_to_nothing() -> None:
    rng = np.random.default_rng(2)
    one, two = pair(affine(np.eye(2))[1])
    m = pf.match_quasi_dense(one, two, one_seed(affine(np.eye(2))[0], np.eye(2)))
    from dataclasses import replace

    mixed = replace(m, xy2=m.xy2[rng.permutation(len(m))])
    for geometry in ("plane", "motion"):
        left = pf.filter_matches(mixed, least=0, geometry=geometry)
        assert len(left) == 0 and left.status == "nothing left"


def test_filters_refuse_what_cannot_be() -> None:
    m = pf.match_quasi_dense(PLAIN, PLAIN)
    with pytest.raises(pf.ArgumentError, match="least: -1"):
        pf.filter_matches(m, least=-1)
    with pytest.raises(pf.ArgumentError, match="kind: 'sphere'"):
        pf.filter_matches(m, geometry="sphere")
    with pytest.raises(pf.ArgumentError, match="back: not of the same"):
        pf.filter_matches(m, back=pf.match_quasi_dense(np.zeros((64, 80), np.uint8), PLAIN))
    assert len(pf.filter_matches(m)) == 0


# ---- what is wrong is refused

PLAIN = np.zeros((64, 64), np.uint8)


@pytest.mark.parametrize(
    ("arguments", "options", "what"),
    [
        ((PLAIN[0], PLAIN), {}, "image1: shape"),
        ((PLAIN, PLAIN[:8]), {}, "image2: 64x8"),
        ((PLAIN, PLAIN.astype(int)), {}, "image2: int64"),
        ((PLAIN, np.full((64, 64), np.nan)), {}, "image2: floating-point"),
        ((PLAIN, PLAIN, np.zeros((3, 5))), {}, "seeds: shape"),
        ((PLAIN, PLAIN, (np.zeros((3, 2)), np.zeros((2, 2)))), {}, "seeds: 3 xy1, 2 xy2"),
        ((PLAIN, PLAIN), {"mode": "fast"}, "mode: 'fast'"),
        ((PLAIN, PLAIN), {"radius": 9}, "radius: 9"),
        ((PLAIN, PLAIN), {"zncc_min": float("nan")}, "zncc_min: nan"),
        ((PLAIN, PLAIN), {"turn": "epipolar"}, "turn: 'epipolar' needs"),
        ((PLAIN, PLAIN), {"cameras": FISHEYE}, "needs both"),
        ((PLAIN, PLAIN), {"cameras": FISHEYE, "relative_pose": POSE}, "cameras: 200x160 is not the size of image1"),
        ((PLAIN, PLAIN), {"cameras": FISHEYE, "relative_pose": 2 * POSE}, "relative_pose: its first three"),
    ],
)
def test_wrong_arguments_are_named(arguments: tuple, options: dict, what: str) -> None:
    with pytest.raises(pf.ArgumentError, match=what.replace("(", r"\(")):
        pf.match_quasi_dense(*arguments, **options)
