"""What may be taken away from quasi-dense matches afterwards: matches that contradict their neighbours, small islands,
those that the reverse direction does not confirm, those off one plane or one rigid motion, and those that could as well
be elsewhere on their epipolar line.

The plane and the motion are found from the matches themselves: cells of 8 x 8 pixels, each with an affine map fitted
robustly, count once each (after Lhuillier and Quan 2005), so that dense clutter does not outvote the rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipefish import _engine
from pipefish.camera import Camera
from pipefish.errors import ArgumentError
from pipefish.matching import RADIUS, Matches, Seeds, epipolar_geometry, grey, match_quasi_dense, whole

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELL, CELL_LEAST, CELL_PX, CELL_SHARE = 8, 10, 0.7, 0.6
NEIGHBOURS = ((0, 1), (1, 0), (0, 2), (2, 0), (1, 1), (1, -1))  # rows, columns; half of them, the others follow
TRIALS, JUDGED, ROUGHLY, REFITTED = 1000, 800, 100, 8  # samples at a time, cells that judge them
TRIALS_MOST, MISSED = 30_000, 0.01
ISLAND = 1000  # of the smaller picture: between ten pairs of unrelated ones the largest island was a 1150th
PX = {"plane": 2.0, "motion": 1.0}
# Of the cells, for a scene to count as rigid: of graf's pairs 82 to 90 % agree, of a book that is bent 73 %, of two
# toys that each move half.
RIGID = 0.78
RIVAL = 0.98  # of a match's correlation


@dataclass(frozen=True, eq=False)
class Geometry:
    """A dominant geometry: `matrix` (3,3), a homography x' ~ H x or a fundamental matrix x'^T F x = 0; `error` (K,)
    pixels of each match from it; how many cells found it, and the share of them that agree."""

    kind: str
    matrix: Floats
    error: Floats
    cells: int
    share: float


def select(m: Matches, keep: Mask) -> Matches:
    """The matches of a mask (K,); where a parent is not among them, its nearest kept ancestor is, -1 without."""
    keep = np.asarray(keep, bool)
    if keep.shape != (len(m),):
        raise ArgumentError(f"keep: shape {keep.shape} is not ({len(m)},)")
    parent = m.parent.copy()
    while True:
        lost = (parent >= 0) & ~keep[np.maximum(parent, 0)]
        if not lost.any():
            break
        parent[lost] = m.parent[parent[lost]]
    number = np.cumsum(keep) - 1
    parent = np.where(parent >= 0, number[np.maximum(parent, 0)], -1)
    arrays = {name: getattr(m, name)[keep] for name in ("xy1", "xy2", "affine", "zncc", "seed")}
    return replace(m, **arrays, parent=parent[keep])


def _check(m: Matches) -> None:
    """Raises ArgumentError for matches that are not within their images, or that no growth leaves so."""
    if not ((m.parent >= -1) & (m.parent < np.arange(len(m)))).all():
        raise ArgumentError("m: parent: not all -1 or a match found before")
    for name, shape in (("xy1", m.shape1), ("xy2", m.shape2)):
        xy = getattr(m, name)
        if not ((xy >= -0.5) & (xy < np.array(shape[::-1]) - 0.5)).all():
            raise ArgumentError(f"m: {name}: not all within its image")
    if not np.isfinite(m.affine).all():
        raise ArgumentError("m: affine: not finite")


def swapped(seeds: Seeds) -> Seeds:
    """The seeds of the same images the other way round."""
    affine = np.tile(np.eye(2), (len(seeds), 1, 1)) if seeds.affine is None else seeds.affine
    turned = np.abs(np.linalg.det(affine)) > 1e-9
    return Seeds(seeds.xy2[turned], seeds.xy1[turned], np.linalg.inv(affine[turned]))


def consistent(m: Matches, least: int = 30) -> Mask:
    """(K,): of the neighbours up to two pixels away, at least half are where the match's affine map has them, to a
    pixel of the coarser image; and such neighbours join it to `least` matches or more."""
    scale = np.sqrt(np.abs(np.linalg.det(m.affine)))
    # Neighbours are those in the coarser image: in the finer one matches lie further apart.
    if len(m) and np.median(scale) < 1:
        shape, here, there, maps = m.shape2, m.xy2, m.xy1, np.linalg.inv(m.affine)
    else:
        shape, here, there, maps = m.shape1, m.xy1, m.xy2, m.affine
    index = np.full(shape, -1, np.int64)
    x, y = np.floor(here + 0.5).astype(int).T
    index[y, x] = np.arange(len(m))
    reach = np.maximum(1, np.maximum(scale, 1 / scale))
    rows, columns = index.shape
    table = np.column_stack([here, there, maps.reshape(-1, 4)])  # a match's row at one look
    agree, around = np.zeros(len(m)), np.zeros(len(m))
    joined = []
    for dy, dx in NEIGHBOURS:
        a = index[: rows - dy, max(0, -dx) : columns - max(0, dx)]
        b = index[dy:, max(0, dx) : columns + min(0, dx)]
        both = (a >= 0) & (b >= 0)
        one, two = a[both], b[both]
        first, second = table[one], table[two]
        (step_x, step_y, x, y), (a11, a12, a21, a22) = (second - first)[:, :4].T, 0.5 * (first + second)[:, 4:].T
        off = np.maximum(np.abs(x - (a11 * step_x + a12 * step_y)), np.abs(y - (a21 * step_x + a22 * step_y)))
        near = off <= np.maximum(reach[one], reach[two])
        for side in (one, two):
            around += np.bincount(side, minlength=len(m))
            agree += np.bincount(side[near], minlength=len(m))
        joined.append((one[near], two[near]))
    good = (around > 0) & (2 * agree >= around)
    one, two = (np.concatenate(ends) for ends in zip(*joined, strict=True))
    held = good[one] & good[two]
    edges = np.column_stack([one[held], two[held]])
    part = _components(len(m), edges)
    return good & (np.bincount(part, minlength=len(m))[part] >= least)


def _components(count: int, edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """(count,): the least number of each one's connected component."""
    label = np.arange(count)
    while True:
        low = np.minimum(label[edges[:, 0]], label[edges[:, 1]])
        new = label.copy()
        np.minimum.at(new, label[edges[:, 0]], low)
        np.minimum.at(new, label[edges[:, 1]], low)
        while not np.array_equal(new, new[new]):
            new = new[new]
        if np.array_equal(new, label):
            return label
        label = new


def confirmed(m: Matches, back: Matches, px: float = 1.0) -> Mask:
    """(K,): `back`, of the same images the other way round, has a match within a pixel of xy2 that leads back to within
    `px` pixels of xy1 (of the coarser image)."""
    if (m.shape1, m.shape2) != (back.shape2, back.shape1):
        raise ArgumentError("back: not of the same images the other way round")
    index = back.map1()
    out = np.zeros(len(m), bool)
    reach = px * np.maximum(1, 1 / np.sqrt(np.maximum(np.abs(np.linalg.det(m.affine)), 1e-9)))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            cell = np.rint(m.xy2).astype(int) + np.array([dx, dy])
            held = np.clip(cell, 0, np.array(m.shape2[::-1]) - 1)
            there = np.where((held == cell).all(axis=1), index[held[:, 1], held[:, 0]], -1)
            k = np.flatnonzero(there >= 0)
            j = there[k]
            home = back.xy2[j] + np.einsum("kij,kj->ki", back.affine[j], m.xy2[k] - back.xy1[j])
            out[k] |= np.abs(home - m.xy1[k]).max(axis=1) <= reach[k]
    return out


def cells_of(m: Matches) -> tuple[Floats, Floats]:
    """(C,2), (C,2): places of 8 x 8 cells of image 1 with ten matches or more, and where a robust affine map of their
    matches has them in image 2; cells of which fewer than 60 % agree to 0.7 pixels are left out."""
    wide = m.shape1[1] // CELL + 1
    cell = (m.xy1[:, 1] // CELL).astype(int) * wide + (m.xy1[:, 0] // CELL).astype(int)
    total = wide * (m.shape1[0] // CELL + 1)
    count = np.bincount(cell, minlength=total)

    def sums(values: Floats) -> Floats:
        return np.bincount(cell, values, minlength=total)

    middle = np.column_stack([sums(m.xy1[:, k]) for k in (0, 1)]) / np.maximum(count, 1)[:, None]
    v = [np.ones(len(m)), *(m.xy1 - middle[cell]).T]
    weight, fitted = np.ones(len(m)), np.zeros((total, 3, 2))
    inverse = 1 / (CELL_PX * np.maximum(1, np.sqrt(np.abs(np.linalg.det(m.affine)))))
    for _ in range(4):
        h, g = np.zeros((total, 3, 3)), np.zeros((total, 3, 2))
        for a in range(3):
            weighted = weight * v[a]
            for b in range(a, 3):
                h[:, a, b] = h[:, b, a] = sums(weighted * v[b])
            for b in range(2):
                g[:, a, b] = sums(weighted * m.xy2[:, b])
        fitted = np.linalg.solve(h + 1e-9 * np.eye(3), g)
        row = fitted.reshape(total, 6)[cell].T
        x, y = (row[b] + v[1] * row[2 + b] + v[2] * row[4 + b] - m.xy2[:, b] for b in (0, 1))
        off = np.hypot(x, y) * inverse
        weight = 1 / (1 + off**2) ** 2
    good = (count >= CELL_LEAST) & (sums((off <= 1).astype(float)) >= CELL_SHARE * count)
    return middle[good], fitted[good, 0]


def _plane_rows(p: Floats, q: Floats) -> Floats:
    """(..., 2 n, 9): what a homography's entries times these give is zero."""
    one, zero = np.ones(p.shape[:-1]), np.zeros(p.shape[:-1])
    x, y, u, v = p[..., 0], p[..., 1], q[..., 0], q[..., 1]
    rows = [
        np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=-1),
        np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=-1),
    ]
    return np.concatenate(rows, axis=-2)


def _motion_rows(p: Floats, q: Floats) -> Floats:
    """(..., n, 9) for a fundamental matrix."""
    one = np.ones((*p.shape[:-1], 1))
    a, b = np.concatenate([p, one], axis=-1), np.concatenate([q, one], axis=-1)
    return (b[..., :, None] * a[..., None, :]).reshape(*p.shape[:-1], 9)


def _plane_error(h: Floats, p: Floats, q: Floats) -> Floats:
    """(..., n) pixels in image 2 of homographies (...,3,3)."""
    there = np.concatenate([p, np.ones((len(p), 1))], axis=1) @ np.swapaxes(h, -1, -2)
    z = np.where(np.abs(there[..., 2:]) > 1e-12, there[..., 2:], 1e-12)
    return np.linalg.norm(there[..., :2] / z - q, axis=-1)


def _motion_error(f: Floats, p: Floats, q: Floats) -> Floats:
    """(..., n) Sampson distances, pixels."""
    a, b = np.concatenate([p, np.ones((len(p), 1))], axis=1), np.concatenate([q, np.ones((len(q), 1))], axis=1)
    line_2, line_1 = a @ np.swapaxes(f, -1, -2), b @ f
    size = np.sqrt((line_1[..., :2] ** 2).sum(axis=-1) + (line_2[..., :2] ** 2).sum(axis=-1))
    return np.abs((line_2 * b).sum(axis=-1)) / np.maximum(size, 1e-12)


def _solved(rows: Callable[[Floats, Floats], Floats], p: Floats, q: Floats, rank_2: bool) -> Floats:
    """(...,3,3) from places (...,n,2); coordinates are of size one."""
    a = rows(p, q)
    matrix = np.linalg.eigh(np.swapaxes(a, -1, -2) @ a)[1][..., 0].reshape(*p.shape[:-2], 3, 3)
    if rank_2:
        u, s, vt = np.linalg.svd(matrix)
        s[..., 2] = 0
        matrix = u @ (s[..., None] * vt)
    return matrix


def _best_sample(
    fitted: Callable[[Any], Floats], error: Callable[[Floats, Any], Floats], count: int, sample: int, px: float
) -> Floats:
    """The geometry of the best of random samples of `sample` of `count` cells, refitted to what agrees with it.

    By the cost of errors up to `px`: all samples on 100 cells, of each 1000 the best eight, refitted, on 800.
    Until a sample without a wrong cell has been missed with a probability of 1 % only, by the share that agrees."""
    random = np.random.default_rng(1)
    judged = random.permutation(count)[:JUDGED]
    best, least, limit, tried = np.eye(3), np.inf, float(TRIALS_MOST), 0
    while tried < limit:
        picks = np.sort(random.integers(0, count, (TRIALS, sample)), axis=1)
        found = fitted(picks[(np.diff(picks, axis=1) > 0).all(axis=1)])
        rough = (np.minimum(error(found, judged[:ROUGHLY]), px) ** 2).sum(axis=-1)
        for k in np.argsort(rough, kind="stable")[:REFITTED]:
            inside = judged[error(found[k], judged) < 2 * px]
            for geometry in (found[k], *([fitted(inside)] if len(inside) >= 2 * sample else [])):
                off = error(geometry, judged)
                cost = float((np.minimum(off, px) ** 2).sum())
                if cost < least:
                    best, least = geometry, cost
                    share = float(np.mean(off < px))
                    limit = (
                        min(TRIALS_MOST, np.log(MISSED) / np.log1p(-min(share**sample, 1 - 1e-9))) if share else limit
                    )
        tried += TRIALS
    return best


def dominant_geometry(m: Matches, kind: str, px: float) -> Geometry | None:
    """The plane ("plane": a homography) or the rigid motion ("motion": a fundamental matrix, of pinhole cameras) that
    most cells of the matches agree with to `px` pixels; by random samples (always the same; as many as the share that
    agrees asks for) and refitting. None where there are fewer than 20 cells, or fewer than a third agree."""
    if kind not in PX:
        raise ArgumentError(f"kind: {kind!r} is none of {', '.join(PX)}")
    if not 0 < px <= 100:
        raise ArgumentError(f"px: {px} is not within 0 to 100")
    p, q = cells_of(m)
    if len(p) < 20:
        return None
    plane = kind == "plane"
    rows, error, sample = (_plane_rows, _plane_error, 4) if plane else (_motion_rows, _motion_error, 8)
    size = [max(shape) / 2 for shape in (m.shape1, m.shape2)]
    bring = [np.array([[1 / s, 0, -1], [0, 1 / s, -1], [0, 0, 1]]) for s in size]

    def back(matrix: Floats) -> Floats:
        return np.linalg.inv(bring[1]) @ matrix @ bring[0] if plane else bring[1].T @ matrix @ bring[0]

    small = p / size[0] - 1, q / size[1] - 1

    def fitted(cells: Any) -> Floats:
        return back(_solved(rows, small[0][cells], small[1][cells], not plane))

    best = _best_sample(fitted, lambda t, k: error(t, p[k], q[k]), len(p), sample, px)
    for _ in range(5):
        inside = error(best, p, q) < px
        if inside.sum() < 2 * sample:
            return None
        best = fitted(inside)
    share = float(np.mean(error(best, p, q) < px))
    if share < 1 / 3:
        return None
    return Geometry(kind, best / np.linalg.norm(best), error(best, m.xy1, m.xy2), len(p), share)


def filter_matches(
    m: Matches,
    *,
    least: int | None = None,
    back: Matches | None = None,
    geometry: str | None = None,
    px: float | None = None,
    rivals: Any = None,
) -> Matches:
    """The matches that stand up to what is asked.

    least      matches that contradict their neighbours, and islands of fewer than so many, are left out; 0: not asked.
               None: as many as a 1000th of the smaller picture's pixels, 30 at least. Wrong seeds grow islands of
               a few hundred where repeated patterns resemble each other from far aside
    back       matches of the same images the other way round: what they do not confirm is left out
    geometry   "plane" or "motion": what is off the dominant one by more than `px` [2, 1] pixels is left out (all of it
               where there is none); parts of the scene that move or lie otherwise are lost too. "rigid": as "motion"
               where 78 % of the cells or more agree with it; where fewer do, the scene bends or moves, or the pictures
               are a fisheye's, and nothing is left out
    rivals     (K,) of match_rivals: matches with 0.98 or more are left out

    Raises ArgumentError."""
    _check(m)
    if rivals is not None:
        found = np.asarray(rivals, float)
        if found.shape != (len(m),):
            raise ArgumentError(f"rivals: shape {found.shape} is not ({len(m)},)")
        m = select(m, ~(found >= RIVAL))
    if least is None:
        least = max(30, min(np.prod(m.shape1), np.prod(m.shape2)) // ISLAND)
    if whole("least", least, 0):
        m = select(m, consistent(m, least))
    if back is not None:
        m = select(m, confirmed(m, back))
    if geometry is not None:
        kind = "motion" if geometry == "rigid" else geometry
        bound = PX.get(kind, 1.0) if px is None else px
        agreed = dominant_geometry(m, kind, bound)
        if geometry != "rigid" or (agreed is not None and agreed.share >= RIGID):
            m = select(m, np.zeros(len(m), bool) if agreed is None else agreed.error < bound)
    status = m.status if len(m) or m.status != "ok" else "nothing left"
    return replace(m, status=status)


def match_back(
    image1: Any, image2: Any, m: Matches, cameras: Any = None, relative_pose: Any = None, **options: Any
) -> Matches:
    """The same images matched the other way round, from the same seeds; cameras, relative_pose (cam2_from_cam1) and
    options as match_quasi_dense takes them for image1 and image2. Raises ArgumentError."""
    pose = epipolar_geometry(cameras, relative_pose)[2]
    if pose is not None:
        pose = np.column_stack([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]])
        cameras = cameras if isinstance(cameras, Camera) else tuple(cameras)[::-1]
    return match_quasi_dense(image2, image1, swapped(m.seeds), cameras, pose, **options)


def match_rivals(
    image1: Any,
    image2: Any,
    m: Matches,
    cameras: Any = None,
    relative_pose: Any = None,
    *,
    radius: int = RADIUS["adaptive"],
    threads: int = 1,
) -> Floats:
    """(K,): the best correlation of each match's surroundings 3 to 20 pixels (of the coarser image) away along its
    epipolar line or, with cameras, curve, over its own; 0 where nothing there can be compared. Near 1 the match could
    as well be there: repeated texture, or texture that runs along the line.

    cameras, relative_pose   as match_quasi_dense takes them; without, the motion that most of the matches agree with
                             (pinhole pictures: dominant_geometry)
    radius                   of the correlation window, 2 to 7

    Raises ArgumentError, also where no motion is given and none is found."""
    one, two = grey(image1, "image1"), grey(image2, "image2")
    if (m.shape1, m.shape2) != (one.shape, two.shape):
        raise ArgumentError("m: not of images of this size")
    radius, threads = whole("radius", radius, 2, 7), whole("threads", threads, 1)
    _check(m)
    profiles = epipolar_geometry(cameras, relative_pose)
    fundamental = None
    if profiles[2] is None:
        agreed = dominant_geometry(m, "motion", PX["motion"])
        if agreed is None:
            raise ArgumentError("relative_pose: none is given, and no one motion fits the matches")
        fundamental = np.ascontiguousarray(agreed.matrix)
    arrays = (np.ascontiguousarray(v, float) for v in (m.xy1, m.xy2, m.affine, m.zncc))
    return _engine.match_rivals(one, two, *arrays, radius, threads, *profiles, fundamental)
