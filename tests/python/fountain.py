"""fountain-P11: neighbouring photographs with known motion. Of the matches of each pair, the share within 2 pixels of
the true epipolar line; and how much of the textured common area those cover.

The data have no depth here. The common area is therefore taken from all the pairs together: matches that agree with
the true motion to a pixel are triangulated with it, which gives depths in both of a pair's pictures; a picture's
depths, from the pairs with both its neighbours, are continued into holes by means of what is around. A pixel of the
first picture is common where its point lies within the second, 8 pixels from the rim, and behind nothing of the first
picture that lands within a pixel of it and is nearer by 2 %. Textured: a step of 0.01 of full scale to one of the four
neighbours, as the growth asks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import pipefish as pf

Floats = NDArray[np.float64]
PICTURES = range(2, 8)
RIM, NEARER = 8, 0.98


def photograph(folder: Path, number: int, size: tuple[int, int]) -> tuple[NDArray[np.uint8], Floats, Floats]:
    """A picture in that size, K and cam_from_world."""
    rows = [r.split() for r in (folder / "gt_dense_cameras" / f"{number:04d}.jpg.camera").read_text().splitlines()]
    k, r = np.array(rows[:3], float), np.array(rows[4:7], float)
    name = next((folder / "images").glob(f"{number:04d}*"))
    with Image.open(name) as opened:
        shrink = size[0] / opened.size[0]
        grey = np.asarray(opened.convert("L").resize(size, Image.Resampling.BOX))
    k = np.diag([shrink, shrink, 1]) @ k
    k[:2, 2] += (shrink - 1) / 2  # pixel centres are whole numbers
    return grey, k, np.column_stack([r.T, -r.T @ np.array(rows[7], float)])


def line_distance(m: pf.Matches, k1: Floats, p1: Floats, k2: Floats, p2: Floats) -> Floats:
    """(K,) pixels of each match's second place from the true epipolar line of its first."""
    r = p2[:, :3] @ p1[:, :3].T
    t = p2[:, 3] - r @ p1[:, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    f = np.linalg.inv(k2).T @ cross @ r @ np.linalg.inv(k1)
    a, b = np.c_[m.xy1, np.ones(len(m))], np.c_[m.xy2, np.ones(len(m))]
    line = a @ f.T
    return np.abs((line * b).sum(axis=1)) / np.linalg.norm(line[:, :2], axis=1)


def points_of(m: pf.Matches, k1: Floats, p1: Floats, k2: Floats, p2: Floats) -> Floats:
    """(K,3) where the matches' rays come nearest to each other."""
    rays = []
    for xy, k, p in ((m.xy1, k1, p1), (m.xy2, k2, p2)):
        d = np.c_[xy, np.ones(len(m))] @ np.linalg.inv(k).T @ p[:, :3]
        rays.append((-p[:, :3].T @ p[:, 3], d / np.linalg.norm(d, axis=1, keepdims=True)))
    (o1, d1), (o2, d2) = rays
    c, base = (d1 * d2).sum(axis=1), o2 - o1
    far = (d1 @ base - c * (d2 @ base)) / np.maximum(1 - c**2, 1e-9)
    return o1 + far[:, None] * d1


def depths(points: Floats, xy: Floats, p: Floats, shape: tuple[int, int]) -> Floats:
    """(H,W) depth of points (K,3) seen at xy by a camera; NaN where there is none."""
    out = np.full(shape, np.nan)
    x, y = np.rint(xy).astype(int).T
    z = points @ p[2, :3] + p[2, 3]
    ok = z > 0
    out[y[ok], x[ok]] = z[ok]
    return out


def filled(depth: Floats) -> Floats:
    """Holes take the mean of the least square around (2 x 2, 4 x 4, ..) in which something is known."""
    hole = np.isnan(depth)
    if not hole.any():
        return depth
    if hole.all():
        raise ValueError("no depth at all")
    rows, columns = (-(-n // 2) for n in depth.shape)
    known = np.zeros((2, 2 * rows, 2 * columns))
    known[0, : depth.shape[0], : depth.shape[1]] = np.where(hole, 0, depth)
    known[1, : depth.shape[0], : depth.shape[1]] = ~hole
    total, count = known.reshape(2, rows, 2, columns, 2).sum(axis=(2, 4))
    coarse = filled(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    fine = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[: depth.shape[0], : depth.shape[1]]
    return np.where(hole, fine, depth)


def textured(grey: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H,W) what growth takes to be textured."""
    value = grey / 255
    steps = [np.abs(np.diff(value, axis=a, **{e: value.take([0 if e == "prepend" else -1], a)}))
             for a in (0, 1) for e in ("prepend", "append")]  # fmt: skip
    return np.max(steps, axis=0) > 0.01


def common(depth: Floats, k1: Floats, p1: Floats, k2: Floats, p2: Floats) -> NDArray[np.bool_]:
    """(H,W) pixels of picture 1 that picture 2 shows, by depths of all of picture 1."""
    rows, columns = depth.shape
    y, x = np.mgrid[:rows, :columns]
    seen = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(k1).T * depth.reshape(-1, 1)
    there = (seen - p1[:, 3]) @ p1[:, :3] @ p2[:, :3].T + p2[:, 3]
    z = there[:, 2]
    at = there @ k2.T
    at = at[:, :2] / np.maximum(at[:, 2:], 1e-9)
    inside = (z > 0) & (at >= RIM).all(axis=1) & (at < np.array([columns, rows]) - RIM).all(axis=1)
    u, v = np.rint(np.where(inside[:, None], at, 0)).astype(int).T
    nearest = np.full((rows, columns), np.inf)
    np.minimum.at(nearest, (v[inside], u[inside]), z[inside])
    padded = np.pad(nearest, 1, constant_values=np.inf)
    around = [padded[a : a + rows, b : b + columns] for a in range(3) for b in range(3)]
    front = np.min(around, axis=0)
    return (inside & (front[v, u] >= NEARER * z)).reshape(rows, columns)


def figures(folder: Path, size: tuple[int, int], pictures: Sequence[int] = PICTURES) -> list[dict[str, float]]:
    """Of each pair of neighbours, made as large as `size` (width, height): matches, share within 2 pixels of the line,
    coverage of the textured common area by those, and what share of the first picture that area is."""
    views = {n: photograph(folder, n, size) for n in pictures}
    shape = views[pictures[0]][0].shape
    parts: dict[int, list[Floats]] = {n: [] for n in pictures}
    matches, near = {}, {}
    for a, b in pairwise(pictures):
        (one, *geometry1), (two, *geometry2) = views[a], views[b]
        m = matches[a] = pf.match_quasi_dense(one, two)
        near[a] = line_distance(m, *geometry1, *geometry2)
        good = near[a] < 1
        points = points_of(m, *geometry1, *geometry2)[good]
        parts[a].append(depths(points, m.xy1[good], geometry1[1], shape))
        parts[b].append(depths(points, m.xy2[good], geometry2[1], shape))
    out = []
    for a, b in pairwise(pictures):
        (one, *geometry1), (_, *geometry2) = views[a], views[b]
        known = np.isfinite(parts[a])
        depth = np.where(known.any(axis=0), np.nansum(parts[a], axis=0) / np.maximum(known.sum(axis=0), 1), np.nan)
        shared = common(filled(depth), *geometry1, *geometry2) & textured(one)
        shared[: RIM // 2], shared[-RIM // 2 :], shared[:, : RIM // 2], shared[:, -RIM // 2 :] = (False,) * 4
        index = matches[a].map1()
        covered = (index >= 0) & (near[a] < 2)[np.maximum(index, 0)] & shared
        out.append({"pair": a, "matches": len(matches[a]), "within_2px": float(np.mean(near[a] < 2))})
        out[-1] |= {"shared": float(shared.mean()), "coverage": float(covered.sum() / shared.sum())}
    return out
