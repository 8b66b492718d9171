"""The pipe's wall, densely: keyframes are unrolled onto the fitted tube, matched pair by pair, triangulated on the rays
of the fisheye camera and fused into a map of how far the wall is from the tube, with a sigma for each cell.

docs/matching.md tells method and accuracy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipefish import _engine
from pipefish.camera import Camera
from pipefish.errors import ArgumentError
from pipefish.matching import Seeds, grey, match_quasi_dense
from pipefish.wallmodel import Floats, WallModel

THETA_LEAST = math.radians(30)  # nearer to the axis a pixel covers four times as much of the wall as beside the camera
RIM_PX = 6.0  # inside the image circle's rim
CELLS = 100  # of the map, to a diameter
BASE = (0.2, 0.7)  # travel between the two keyframes of a pair, diameters
STRIDE = 0.12  # between keyframes that begin pairs, diameters
PAIRS = 2  # of each of them, with later ones
SEARCH_S, SEARCH_CLOCK = 10, 3  # cells of the unrolled picture around the model's prediction
SEED_STEP, SEED_RADIUS = 36, 7
ANGLE_LEAST = math.radians(1.5)  # between two rays
MATCH_PX = 0.25  # sigma of a match as growth leaves it, before the map's own scatter corrects it
CALIBRATION_PX = 0.1
ACROSS = 3  # matches in a map's cell, along and around, where the pictures have more: near ones share their error
SKEW_PX = 1.5  # two rays may miss each other by so much
WINDOW = 7  # side of the correlation window: matches nearer to each other than that share their error
BATCH = 8  # pairs at a time, whatever the number of threads: sums have one order
SPREAD_LEAST = 3  # pairs, for a cell to say something about the scatter
REGION_SIGMA, REGION_CELLS = 3.0, 12


@dataclass(frozen=True, eq=False)
class DenseWall:
    """A map of the wall. Cells (rows, columns): s[i] along the tube, clock[j]; metres (the unit of the poses).

    deviation, sigma   of the wall from the fitted tube, radially, positive outside; NaN where not measured
    pairs              how many pairs of keyframes agree in a cell, at least two where there is a deviation
    looks              how many pairs have a cell in view, measured there or not
    brightness         0..1, of the unrolled pictures; NaN where none sees the cell
    points             (rows, columns, 3) of the cells' middles, moved by their deviation; NaN where not measured
    scatter            what the pairs' own scatter multiplied the sigmas of theory by
    regions            connected cells that are off the tube by over 3 sigma: see `find_regions`
    """

    wall: WallModel
    s: Floats
    clock: Floats
    deviation: Floats
    sigma: Floats
    pairs: NDArray[np.int64]
    looks: NDArray[np.int64]
    brightness: Floats
    scatter: float
    pairs_used: int
    regions: list[dict[str, float]] = field(default_factory=list)

    @property
    def points(self) -> Floats:
        s, clock = np.meshgrid(self.s, self.clock, indexing="ij")
        return self.wall.points(s.ravel(), clock.ravel(), self.deviation.ravel()).reshape(*s.shape, 3)

    @property
    def coverage(self) -> float:
        """Share of the cells that are measured, of those that two pairs or more have in view."""
        seen = self.looks >= 2
        return float(np.isfinite(self.deviation)[seen].mean()) if seen.any() else 0.0


@dataclass(frozen=True, eq=False)
class _View:
    """A keyframe unrolled: picture rows are cells along s from `row` on; `pad` columns are repeated at either end."""

    row: int
    picture: NDArray[np.float32]
    even: NDArray[np.float32]  # the picture without the lamp's falloff
    sound: NDArray[np.bool_]
    centre: Floats
    pose: Floats


class _Unroller:
    """Unrolls keyframes onto one grid of square cells, a pixel beside the camera each."""

    pad = 24

    def __init__(self, camera: Camera, wall: WallModel, scale: float) -> None:
        self.camera, self.wall = camera, wall
        self.columns = max(64, round(2 * math.pi * camera.f_u / scale))
        self.cell = 2 * math.pi * wall.mean_radius / self.columns
        self.theta_most = min(camera.theta_max, math.radians(110))

    def clock(self, column: Any) -> Floats:
        return (np.asarray(column, float) - self.pad + 0.5) * 2 * np.pi / self.columns

    def s(self, row: Any) -> Floats:
        return (np.asarray(row, float) + 0.5) * self.cell

    def rows(self, pose: Floats) -> tuple[int, int]:
        """The rows of cells that a keyframe sees, from and to; few or none beside the wall."""
        centre = -pose[:, :3].T @ pose[:, 3]
        s = float(self.wall.locate(centre[None])[0][0])
        rho, last = self.wall.mean_radius, int(self.wall.length / self.cell)
        ahead = float(self.wall.frames([s])[1][0] @ pose[2, :3])  # below 0: the camera looks back
        ends = sorted(s + math.copysign(rho, ahead) / math.tan(t) for t in (self.theta_most, THETA_LEAST))
        first, end = (min(max(round(e / self.cell), 0), last) for e in ends)
        return first, end

    def view(self, image: NDArray[np.float32], pose: Floats) -> _View:
        """A keyframe that sees some of the wall, unrolled."""
        first, end = self.rows(pose)
        rows, columns = np.arange(first, end), np.arange(self.columns + 2 * self.pad)
        pixels, sound = self._pixels(rows, columns, pose)
        values = _engine.sample_image(image, pixels.reshape(-1, 2)).reshape(sound.shape)
        sound &= np.isfinite(values)
        picture = np.where(sound, values, 0).astype(np.float32)
        return _View(first, picture, _even(picture, sound), sound, -pose[:, :3].T @ pose[:, 3], pose)

    def _pixels(self, rows: Any, columns: Any, pose: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Where cells are in the picture: every 4th is projected, the others lie between (0.003 px off at most)."""
        step = 4
        r = np.arange(rows[0], rows[-1] + step, step)
        c = np.arange(0, columns[-1] + step, step)
        s, clock = np.meshgrid(self.s(r), self.clock(c), indexing="ij")
        points = self.wall.points(s.ravel(), clock.ravel())
        seen = points @ pose[:, :3].T + pose[:, 3]
        pixels, ok = self.camera.project(seen)
        theta = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
        ok &= (theta >= THETA_LEAST) & (theta <= self.theta_most)
        ok &= self.camera.in_image(pixels)
        fine = _between(np.where(ok[:, None], pixels, np.nan).reshape(*s.shape, 2), len(rows), len(columns), step)
        return np.nan_to_num(fine, nan=-1.0), np.isfinite(fine[..., 0])


def _between(coarse: Floats, rows: int, columns: int, step: int) -> Floats:
    """Bilinear between the places of a grid `step` apart: (rows, columns, k)."""
    i, j = np.arange(rows), np.arange(columns)
    t, u = (i % step / step)[:, None, None], (j % step / step)[None, :, None]
    across = lambda g: (1 - u) * g[:, j // step] + u * g[:, np.minimum(j // step + 1, g.shape[1] - 1)]  # noqa: E731
    top, bottom = coarse[i // step], coarse[np.minimum(i // step + 1, len(coarse) - 1)]
    return (1 - t) * across(top) + t * across(bottom)


def _box(values: Floats, radius: int) -> Floats:
    """Sums over (2 radius + 1)^2 cells, less of them at the rim."""
    for axis in (0, 1):
        n = values.shape[axis]
        sums = np.concatenate([np.zeros_like(np.take(values, [0], axis)), np.cumsum(values, axis, dtype=float)], axis)
        k = np.arange(n)
        values = np.take(sums, np.minimum(k + radius + 1, n), axis) - np.take(sums, np.maximum(k - radius, 0), axis)
    return values


def _even(picture: NDArray[np.float32], sound: NDArray[np.bool_], radius: int = 15) -> NDArray[np.float32]:
    """The picture with the lamp's falloff taken out: less its local mean, over its local deviation, 0..1."""
    count = np.maximum(_box(sound.astype(float), radius), 1)
    mean = _box(picture.astype(float), radius) / count  # 0 where not sound
    square = _box(picture.astype(float) ** 2, radius) / count
    deviation = np.sqrt(np.maximum(square - mean**2, 0)) + 0.01  # 2.5 grey levels: noise is not made texture
    value = np.where(sound, 0.5 + 0.15 * (picture - mean) / deviation, 0.5)
    return np.clip(value, 0, 1).astype(np.float32)


def _seeds(one: NDArray[np.float32], two: NDArray[np.float32], sound: NDArray[np.bool_]) -> Seeds:
    """Places of a coarse grid in `one` with the best of the shifts in `two` around none at all. Growth judges them."""
    r, margin = SEED_RADIUS, SEED_RADIUS + max(SEARCH_S, SEARCH_CLOCK) + 1
    y, x = (
        a.ravel()
        for a in np.meshgrid(
            np.arange(margin, one.shape[0] - margin, SEED_STEP),
            np.arange(margin, one.shape[1] - margin, SEED_STEP),
            indexing="ij",
        )
    )
    keep = sound[y, x]
    y, x = y[keep], x[keep]
    if not len(x):
        return Seeds(np.empty((0, 2)), np.empty((0, 2)))
    off = np.arange(-r, r + 1)
    patch = one[y[:, None, None] + off[:, None], x[:, None, None] + off]
    patch = patch - patch.mean(axis=(1, 2), keepdims=True)
    wide_s, wide_c = np.arange(-r - SEARCH_S, r + SEARCH_S + 1), np.arange(-r - SEARCH_CLOCK, r + SEARCH_CLOCK + 1)
    block = two[y[:, None, None] + wide_s[:, None], x[:, None, None] + wide_c]
    best = np.full(len(x), -1.0)
    shift = np.zeros((len(x), 2))
    for i, j in itertools.product(range(2 * SEARCH_S + 1), range(2 * SEARCH_CLOCK + 1)):
        other = block[:, i : i + 2 * r + 1, j : j + 2 * r + 1]
        other = other - other.mean(axis=(1, 2), keepdims=True)
        norm = np.sqrt((patch**2).sum(axis=(1, 2)) * (other**2).sum(axis=(1, 2)))
        score = (patch * other).sum(axis=(1, 2)) / np.maximum(norm, 1e-9)
        better = score > best
        best[better], shift[better] = score[better], (j - SEARCH_CLOCK, i - SEARCH_S)
    good = best > 0.7
    at = np.column_stack([x, y])[good].astype(float)
    return Seeds(at, at + shift[good])


def _match(one: _View, two: _View, every: int) -> tuple[Floats, Floats] | None:
    """Cells (K,2) column, row of the grid in either view, where both show the wall; of the matches, every n-th along
    and around."""
    first, end = max(one.row, two.row), min(one.row + len(one.picture), two.row + len(two.picture))
    if end - first < 64:
        return None
    part = [slice(first - v.row, end - v.row) for v in (one, two)]
    sound = one.sound[part[0]] & two.sound[part[1]]
    whole = _box(sound.astype(float), 6) >= 13 * 13 - 0.5
    pictures = [v.even[p] for v, p in zip((one, two), part, strict=True)]
    seeds = _seeds(pictures[0], pictures[1], whole)
    if not len(seeds):
        return None
    m = match_quasi_dense(*pictures, seeds, mode="translation", radius=WINDOW // 2, zncc_min=0.75)
    x, y = m.xy1.astype(int).T
    x2, y2 = np.rint(m.xy2).astype(int).T
    inside = (x >= _Unroller.pad) & (x < one.picture.shape[1] - _Unroller.pad)
    near = (np.abs(m.xy2 - m.xy1) <= [2 * SEARCH_CLOCK, 2 * SEARCH_S]).all(axis=1)
    keep = inside & near & whole[y, x] & whole[y2, x2] & (x % every == 0) & (y % every == 0)
    return m.xy1[keep] + [0, first], m.xy2[keep] + [0, first]


def _rays(unroller: _Unroller, view: _View, cells: Floats) -> tuple[Floats, Floats]:
    """Origins and directions (K,3), of unit length, of what is at cells: rays through the tube's own points."""
    target = unroller.wall.points(unroller.s(cells[:, 1]), unroller.clock(cells[:, 0]))
    origin = np.broadcast_to(view.centre, target.shape)
    if unroller.camera.pupil_e1:
        pixels, _ = unroller.camera.project(target @ view.pose[:, :3].T + view.pose[:, 3])
        origin = origin + unroller.camera.origins(pixels) @ view.pose[:, :3]
    ray = target - origin
    return origin, ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _triangulated(unroller: _Unroller, one: _View, two: _View, cells: tuple[Floats, Floats]) -> tuple[Floats, ...]:
    """s, clock, deviation, its sigma, each (K,), of matches whose rays meet."""
    wall, pixel = unroller.wall, 1 / unroller.camera.f_u
    (o1, d1), (o2, d2) = (_rays(unroller, v, c) for v, c in zip((one, two), cells, strict=True))
    cosine = np.einsum("ki,ki->k", d1, d2)
    base = o2 - o1
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    a, b = np.einsum("ki,ki->k", base, d1), np.einsum("ki,ki->k", base, d2)
    r1, r2 = (a - cosine * b) / sine2, (cosine * a - b) / sine2
    p1, p2 = o1 + r1[:, None] * d1, o2 + r2[:, None] * d2
    weight = r2**2 / np.maximum(r1**2 + r2**2, 1e-12)  # both rays are as good as an angle
    point = weight[:, None] * p1 + (1 - weight)[:, None] * p2
    skew = np.linalg.norm(p1 - p2, axis=1) / np.maximum(pixel * np.hypot(r1, r2), 1e-12)
    keep = (r1 > 0) & (r2 > 0) & (sine2 > math.sin(ANGLE_LEAST) ** 2) & (skew < SKEW_PX)
    s, clock, deviation = wall.locate(point[keep], unroller.s(cells[0][keep, 1]))
    _, tangent, up, right = wall.frames(s)
    out = np.cos(clock)[:, None] * up + np.sin(clock)[:, None] * right
    # A shift of one ray's foot along s moves the crossing outwards by 1 / (difference of the rays' slopes).
    slopes = [np.einsum("ki,ki->k", d[keep], tangent) / np.einsum("ki,ki->k", d[keep], out) for d in (d1, d2)]
    gain = 1 / np.maximum(np.abs(slopes[0] - slopes[1]), 1e-6)
    footprint = pixel * np.hypot(r1, r2)[keep] * np.sqrt(1 + np.maximum(*(np.abs(v) for v in slopes)) ** 2)
    return s, clock, deviation, MATCH_PX * footprint * gain


def _per_cell(
    key: NDArray[np.int64], value: Floats, sigma: Floats, every: int
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Median and sigma of it of each key that has 3 values or more; sigma as if a window's matches were one."""
    order = np.lexsort((value, key))
    key, value, sigma = key[order], value[order], sigma[order]
    start = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    count = np.diff(np.r_[start, len(key)])
    middle = 0.5 * (value[start + (count - 1) // 2] + value[start + count // 2])
    mean_sigma = np.add.reduceat(sigma, start) / count
    keep = count >= 3
    effective = np.maximum(count * every**2 / WINDOW**2, 1)
    return key[start][keep], middle[keep], (mean_sigma / np.sqrt(effective))[keep]


def _fused(
    key: NDArray[np.int64], value: Floats, sigma: Floats, cells: int, shared: float
) -> tuple[Floats, Floats, Any, float]:
    """Of each cell: the mean of the pairs that agree with their median within 3 sigma, its sigma, how many pairs; and
    the scatter, by which sigmas are multiplied. shared: part of sigma that all pairs share."""
    order = np.lexsort((value, key))
    key, value, sigma = key[order], value[order], sigma[order]
    if not len(key):
        return np.full(cells, np.nan), np.full(cells, np.nan), np.zeros(cells, int), 1.0
    start = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    count = np.diff(np.r_[start, len(key)])
    group = np.repeat(np.arange(len(start)), count)
    median = 0.5 * (value[start + (count - 1) // 2] + value[start + count // 2])
    telling = count >= SPREAD_LEAST
    normal = np.abs(value - median[group]) / (sigma * np.sqrt(1 - 1 / count[group]).clip(0.5))
    scatter = float(np.median(normal[telling[group]]) / 0.6745) if telling.any() else 1.0
    scatter = max(scatter, 0.1)
    keep = np.abs(value - median[group]) <= 3 * math.hypot(scatter, shared) * sigma
    weight = np.where(keep, sigma**-2.0, 0)
    total = np.add.reduceat(weight, start)
    agree = np.add.reduceat(keep.astype(int), start)
    mean = np.add.reduceat(weight * value, start) / np.maximum(total, 1e-30)
    square = np.add.reduceat(weight * (value - mean[group]) ** 2, start) / np.maximum(agree - 1, 1)
    # Pairs share keyframes, so n of them tell half as much as n would; and a cell whose pairs scatter more than most is
    # believed.
    variance = 2 * np.maximum(square, scatter**2) + shared**2 * agree
    good = (agree >= 2) & (2 * agree > count)
    out, error, pairs = np.full(cells, np.nan), np.full(cells, np.nan), np.zeros(cells, int)
    out[key[start][good]] = mean[good]
    error[key[start][good]] = np.sqrt(variance[good] / total[good])
    pairs[key[start]] = agree
    return out, error, pairs, scatter


def _pairs(unroller: _Unroller, poses: Floats) -> list[tuple[int, int]]:
    """Keyframes 0.12 diameters apart, each with later ones that are 0.2 to 0.7 diameters further on."""
    seen = [k for k, pose in enumerate(poses) if np.diff(unroller.rows(pose))[0] >= 64]
    centres = np.array([-poses[k, :, :3].T @ poses[k, :, 3] for k in seen]).reshape(-1, 3)
    s = unroller.wall.locate(centres)[0] / (2 * unroller.wall.mean_radius)
    order = np.argsort(s, kind="stable")
    out, last = [], -np.inf
    for n in order:
        if s[n] - last < STRIDE:
            continue
        last = s[n]
        able = [m for m in order if BASE[0] <= s[m] - s[n] <= BASE[1]]
        wanted = np.linspace(*BASE, PAIRS + 2)[1:-1]
        chosen = {min(able, key=lambda m: abs(s[m] - s[n] - w)) for w in wanted} if able else set()
        out += [(seen[n], seen[m]) for m in sorted(chosen)]
    return out


def dense_wall(
    images: Callable[[int], Any],
    camera: Camera,
    poses: Any,
    wall: WallModel,
    *,
    cell: float | None = None,
    scale: float = 1.0,
    calibration_px: float = CALIBRATION_PX,
    threads: int = 1,
    tell: Callable[[float], None] | None = None,
) -> DenseWall:
    """Measures the wall around a fitted tube densely.

    images   gives the picture of keyframe k: (H,W) or (H,W,3), uint8, uint16 or floats of 0..1
    camera   of all keyframes
    poses    (n,3,4) cam_from_world, in the tube's frame and unit
    wall     the fitted tube, or a piece of it between joints
    cell     side of the map's cells [a hundredth of the diameter, or three pixels]
    scale    pixels of the pictures to a cell of the unrolled ones: 2 takes a quarter of the time
    calibration_px   what all pairs share and no scatter tells: errors that the calibration leaves (zones of 0.1 px are
             ordinary) and shading that moves with the lamp. In a simulated concrete pipe errors stay as they are from 2
             pairs to 7, and 0.1 px makes sigmas true
    threads  pairs at a time: do not change the result
    tell     is called with a fraction done

    Raises ArgumentError for what cannot be: shapes, sizes, nothing seen."""
    pose_list = np.asarray(poses, float)
    if pose_list.ndim != 3 or pose_list.shape[1:] != (3, 4) or not np.isfinite(pose_list).all():
        raise ArgumentError(f"poses: shape {pose_list.shape} is not (n,3,4), or not finite")
    if not (math.isfinite(scale) and 0.5 <= scale <= 8):
        raise ArgumentError(f"scale: {scale} is not within 0.5 to 8")
    diameter = 2 * wall.mean_radius
    unroller = _Unroller(camera, wall, scale)
    if not 0 <= calibration_px <= 10:
        raise ArgumentError(f"calibration_px: {calibration_px} is not within 0 to 10")
    size = max(diameter / CELLS, ACROSS * unroller.cell) if cell is None else cell
    if not (math.isfinite(size) and diameter / 1000 <= size <= diameter / 10):
        raise ArgumentError(f"cell: {size} is not within a thousandth to a tenth of the diameter")
    every = max(1, int(size / unroller.cell / ACROSS))
    rows, columns = max(1, round(wall.length / size)), max(8, round(math.pi * diameter / size))

    def seen(k: int) -> _View:
        picture = grey(images(k), f"keyframe {k}")
        if picture.shape != (camera.height, camera.width):
            size = f"{picture.shape[1]}x{picture.shape[0]}"
            raise ArgumentError(f"keyframe {k}: {size} is not the camera's {camera.width}x{camera.height}")
        return unroller.view(picture, pose_list[k])

    pairs = _pairs(unroller, pose_list)
    if not pairs:
        raise ArgumentError("poses: no two keyframes see the same wall from 0.2 to 0.7 diameters apart")
    light, lit = np.zeros(rows * columns), np.zeros(rows * columns)
    views: dict[int, _View] = {}
    looks = np.zeros(rows * columns, int)
    parts = []

    def measured(pair: tuple[int, int]) -> tuple[NDArray[np.int64], Floats, Floats] | None:
        one, two = (views[k] for k in pair)
        cells = _match(one, two, every)
        if cells is None:
            return None
        s, clock, deviation, sigma = _triangulated(unroller, one, two, cells)
        row, column = np.floor(s / wall.length * rows).astype(int), (clock / (2 * np.pi) * columns).astype(int)
        keep = (row >= 0) & (row < rows) & (np.abs(deviation) < 0.25 * diameter)
        return _per_cell((row * columns + column % columns)[keep], deviation[keep], sigma[keep], every)

    with ThreadPoolExecutor(threads) as pool:
        for n in range(0, len(pairs), BATCH):
            if tell:
                tell(n / len(pairs))
            batch, rest = pairs[n : n + BATCH], {k for pair in pairs[n:] for k in pair}
            views = {k: v for k, v in views.items() if k in rest}
            wanted = sorted({k for pair in batch for k in pair} - set(views))
            for k, view in zip(wanted, pool.map(seen, wanted), strict=True):
                views[k] = view
                _add_light(unroller, view, light, lit, rows, columns)
            for i, j in batch:
                looks += _in_view(unroller, views[i], views[j], rows, columns)
            parts += [part for part in pool.map(measured, batch) if part is not None]
    joined = [np.concatenate(p) for p in zip(*parts, strict=True)] if parts else [np.empty(0, int), *[np.empty(0)] * 2]
    value, error, agree, scatter = _fused(*joined, rows * columns, calibration_px / MATCH_PX)
    shape = (rows, columns)
    found = DenseWall(
        wall=wall,
        s=(np.arange(rows) + 0.5) * wall.length / rows,
        clock=(np.arange(columns) + 0.5) * 2 * np.pi / columns,
        deviation=value.reshape(shape),
        sigma=error.reshape(shape),
        pairs=agree.reshape(shape),
        looks=looks.reshape(shape),
        brightness=np.where(lit > 1, light / np.maximum(lit, 1e-9), np.nan).reshape(shape),
        scatter=scatter,
        pairs_used=len(parts),
    )
    found.regions.extend(find_regions(found))
    return found


def _cells_of(unroller: _Unroller, first: int, sound: NDArray[np.bool_], rows: int, columns: int) -> tuple[Any, Any]:
    """Places (n,2) of what is sound in unrolled rows from `first` on, and the map's cell of each."""
    inner = slice(unroller.pad, unroller.pad + unroller.columns)
    y, x = np.nonzero(sound[:, inner])
    row = np.minimum((unroller.s(y + first) / unroller.wall.length * rows).astype(int), rows - 1)
    return (y, x + unroller.pad), row * columns + ((x + 0.5) / unroller.columns * columns).astype(int)


def _add_light(unroller: _Unroller, view: _View, light: Floats, lit: Floats, rows: int, columns: int) -> None:
    """Adds a view's brightness, and one for each cell that it sees, to the map's sums."""
    place, key = _cells_of(unroller, view.row, view.sound, rows, columns)
    count = np.bincount(key, minlength=rows * columns)
    total = np.bincount(key, view.picture[place], minlength=rows * columns)
    seen = count > 0
    light[seen] += total[seen] / count[seen]
    lit[seen] += 1


def _in_view(unroller: _Unroller, one: _View, two: _View, rows: int, columns: int) -> NDArray[np.int64]:
    """One for each cell of the map that both keyframes see."""
    first, end = max(one.row, two.row), min(one.row + len(one.picture), two.row + len(two.picture))
    if end <= first:
        return np.zeros(rows * columns, int)
    sound = one.sound[first - one.row : end - one.row] & two.sound[first - two.row : end - two.row]
    _, key = _cells_of(unroller, first, sound, rows, columns)
    return (np.bincount(key, minlength=rows * columns) > 0).astype(int)


def find_regions(found: DenseWall) -> list[dict[str, float]]:
    """Connected cells (12 or more) whose 3 x 3 neighbourhood stands over 3 sigma and a 500th of the diameter in or out
    of the ellipse through the wall half a diameter around, which leaves out what a tube's smoothness makes of ovality
    and bends. Largest volume first: s, clock (radians) of the middle; length (along), extent (around, radians); height
    (the 90th percentile, negative: it stands into the pipe); sigma of it; area; volume."""
    measured = np.isfinite(found.deviation)
    weight = np.where(measured, np.nan_to_num(found.sigma, nan=1.0) ** -2.0, 0)
    total = _wrapped_box(weight)
    local = np.where(measured, found.deviation, 0) - _ellipses(found)
    mean = _wrapped_box(weight * local) / np.maximum(total, 1e-30)
    sigma = np.nan_to_num(found.sigma, nan=np.inf)  # neighbours share keyframes: their mean is hardly better than one
    off = measured & (np.abs(mean) > REGION_SIGMA * sigma) & (np.abs(mean) > found.wall.mean_radius / 250)
    out = []
    step = (found.s[1] - found.s[0] if len(found.s) > 1 else 1.0, found.clock[1] - found.clock[0])
    area = step[0] * step[1] * found.wall.mean_radius
    for sign in (-1, 1):
        for cells in _connected(off & (sign * mean > 0)):
            if len(cells) < REGION_CELLS:
                continue
            i, j = cells.T
            value = local[i, j]
            angle = found.clock[j]
            middle = np.arctan2(np.sin(angle).sum(), np.cos(angle).sum()) % (2 * np.pi)
            spread = (angle - middle + np.pi) % (2 * np.pi) - np.pi
            height = sign * float(np.percentile(sign * value, 90))
            out.append(
                {
                    "s": float(found.s[i].mean()),
                    "clock": float(middle),
                    "length": float(np.ptp(found.s[i]) + step[0]),
                    "extent": float(np.ptp(spread) + step[1]),
                    "height": height,
                    "sigma": float(np.median(found.sigma[i, j])),
                    "area": float(len(cells) * area),
                    "volume": float(value.sum() * area),
                }
            )
    return sorted(out, key=lambda r: -abs(r["volume"]))


def _ellipses(found: DenseWall) -> Floats:
    """(rows, columns): mean, shift and ellipse through the cells a quarter diameter to either side, robustly."""
    angle = np.outer([1, 1, 2, 2], found.clock) - np.array([[0], [np.pi / 2], [0], [np.pi / 2]])
    terms = np.vstack([np.ones(len(found.clock)), np.cos(angle)])  # (5, columns)
    value = np.nan_to_num(found.deviation)
    weight = np.isfinite(found.deviation).astype(float)
    spacing = found.s[1] - found.s[0] if len(found.s) > 1 else 1.0
    half = max(1, round(0.5 * found.wall.mean_radius / spacing))
    fitted = np.zeros_like(value)
    bound = 3 * max(float(np.median(found.sigma[weight > 0])), 1e-9) if weight.any() else 1.0
    for _ in range(4):
        h = np.einsum("ac,rc,bc->rab", terms, weight, terms)
        g = np.einsum("ac,rc->ra", terms, weight * value)
        h, g = (np.array([a[max(k - half, 0) : k + half + 1].sum(axis=0) for k in range(len(a))]) for a in (h, g))
        h += 1e-3 * np.eye(5)
        fitted = np.linalg.solve(h, g[..., None])[..., 0] @ terms
        off = (value - fitted) / bound
        weight = np.isfinite(found.deviation) / (1 + off**2) ** 2  # a deposit does not bend the ellipse
    return fitted


def _wrapped_box(values: Floats) -> Floats:
    """Sums over 3 x 3 cells; columns go around."""
    around = values + np.roll(values, 1, axis=1) + np.roll(values, -1, axis=1)
    padded = np.pad(around, ((1, 1), (0, 0)))
    return padded[:-2] + padded[1:-1] + padded[2:]


def _connected(cells: NDArray[np.bool_]) -> Iterable[NDArray[np.int64]]:
    """Groups of neighbouring cells, (n,2) each; columns go around."""
    columns = cells.shape[1]
    left = set(zip(*(a.tolist() for a in np.nonzero(cells)), strict=True))
    while left:
        stack = [left.pop()]
        group = []
        while stack:
            i, j = stack.pop()
            group.append((i, j))
            for a, b in itertools.product((i - 1, i, i + 1), (j - 1, j, j + 1)):
                near = (a, b % columns)
                if near in left:
                    left.remove(near)
                    stack.append(near)
        yield np.array(group)
