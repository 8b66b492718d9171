"""The pipe's wall, densely: keyframes are unrolled onto the fitted tube, matched pair by pair, triangulated on the rays
of the fisheye camera and fused into a map of how far the wall is from the tube, with a sigma for each cell.

docs/matching.md tells method and accuracy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipefish.camera import Camera
from pipefish.dense_regions import ellipses, find_regions
from pipefish.dense_steps import find_steps
from pipefish.dense_unroll import THETA_LEAST, Unroller, View, box_sum, keyframe_picture
from pipefish.errors import ArgumentError
from pipefish.matching import Seeds, match_quasi_dense, whole
from pipefish.wallmodel import Floats, WallModel, predicted_seeds, seen_on_wall

Rays = tuple[Floats, Floats]  # origins and directions of unit length, (K,3) each

CELLS = 100  # of the map, to a diameter
BASE = (0.2, 0.7)  # travel between the two keyframes of a pair, diameters
STRIDE = 0.12  # between keyframes that begin pairs, diameters
PAIRS = 2  # of each of them, with later ones
SEARCH_S, SEARCH_CLOCK = 10, 3  # cells of the unrolled picture around the model's prediction, and along s
WRONG_RADIUS = (
    0.12  # besides, of the way between the keyframes: a tube wrong by that share of its radius shifts all by it
)
SEED_STEP, SEED_RADIUS = 36, 7
RAW_STEP, RAW_RADIUS = 24, 5  # pixels between the seeds of raw pictures; radius of the window there
RAW_BEND_STEP = 16  # pixels between the places where the map's bend is looked at
_OFF = np.arange(-RAW_RADIUS, RAW_RADIUS + 1)
_WEIGHT = np.exp(-0.5 * (_OFF / (0.6 * RAW_RADIUS)) ** 2)  # the growth's window
WINDOW_VARIANCE = float((_WEIGHT * _OFF**2).sum() / _WEIGHT.sum())  # pixels squared
ANGLE_LEAST = math.radians(1.5)  # between two rays
MATCH_PX = 0.25  # sigma of a match as growth leaves it, before the map's own scatter corrects it
CALIBRATION_PX = 0.1
ACROSS = 3  # matches in a map's cell, along and around, where the pictures have more: near ones share their error
SKEW_PX = 1.5  # two rays may miss each other by so much
WINDOW = 7  # side of the correlation window: matches nearer to each other than that share their error
BATCH = 8  # pairs at a time, whatever the number of threads: sums have one order
SPREAD_LEAST = 3  # pairs, for a cell to say something about the scatter


@dataclass(frozen=True, eq=False)
class DenseWall:
    """A map of the wall. Cells (rows, columns): s[i] along the tube, clock[j]; metres (the unit of the poses).

    deviation, sigma   of the wall from the fitted tube, radially, positive outside; NaN where not measured
    pairs              how many pairs of keyframes agree in a cell, at least two where there is a deviation
    looks              how many pairs have a cell in view, measured there or not
    brightness         0..1, of the unrolled pictures; NaN where none sees the cell
    points             (rows, columns, 3) of the cells' middles, moved by their deviation; NaN where not measured
    scatter            what the pairs' own scatter multiplied the sigmas of theory by
    tube_sigma         in every sigma: how far the tube and the poses are off that no scatter tells, see `_tube_sigma`
    regions            connected cells that are off the tube by over 3 sigma: see `find_regions`
    steps              where the pipe steps aside or changes its width at once: see `find_steps`
    cracks             lines that wander over the wall: see `find_cracks`, which looks for them
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
    tube_sigma: float = 0.0
    regions: list[dict[str, float]] = field(default_factory=list)
    steps: list[dict[str, float]] = field(default_factory=list)
    cracks: list[dict[str, Any]] = field(default_factory=list)

    @property
    def points(self) -> Floats:
        s, clock = np.meshgrid(self.s, self.clock, indexing="ij")
        return self.wall.points(s.ravel(), clock.ravel(), self.deviation.ravel()).reshape(*s.shape, 3)

    @property
    def coverage(self) -> float:
        """Share of the cells that are measured, of those that two pairs or more have in view."""
        seen = self.looks >= 2
        return float(np.isfinite(self.deviation)[seen].mean()) if seen.any() else 0.0


def _seeds(one: NDArray[np.float32], two: NDArray[np.float32], sound: NDArray[np.bool_], reach: int) -> Seeds:
    """Places of a coarse grid in `one` with the best of the shifts in `two`, up to `reach` rows. Growth judges them."""
    r = SEED_RADIUS
    # Shifts beyond the picture are not looked at near its ends, where the wall is seen by a tube that is right.
    rows = np.arange(r + SEARCH_S + 1, one.shape[0] - r - SEARCH_S - 1, SEED_STEP)
    across = r + SEARCH_CLOCK + 1
    y, x = (a.ravel() for a in np.meshgrid(rows, np.arange(across, one.shape[1] - across, SEED_STEP), indexing="ij"))
    two = np.pad(two, ((reach - SEARCH_S, reach - SEARCH_S), (0, 0)))
    below = reach - SEARCH_S
    keep = sound[y, x]
    y, x = y[keep], x[keep]
    if not len(x):
        return Seeds(np.empty((0, 2)), np.empty((0, 2)))
    off = np.arange(-r, r + 1)
    patch = one[y[:, None, None] + off[:, None], x[:, None, None] + off]
    patch = patch - patch.mean(axis=(1, 2), keepdims=True)
    wide_s, wide_c = np.arange(-r - reach, r + reach + 1), np.arange(-r - SEARCH_CLOCK, r + SEARCH_CLOCK + 1)
    block = two[y[:, None, None] + below + wide_s[:, None], x[:, None, None] + wide_c]
    best = np.full(len(x), -1.0)
    shift = np.zeros((len(x), 2))
    for i, j in itertools.product(range(2 * reach + 1), range(2 * SEARCH_CLOCK + 1)):
        other = block[:, i : i + 2 * r + 1, j : j + 2 * r + 1]
        other = other - other.mean(axis=(1, 2), keepdims=True)
        norm = np.sqrt((patch**2).sum(axis=(1, 2)) * (other**2).sum(axis=(1, 2)))
        score = (patch * other).sum(axis=(1, 2)) / np.maximum(norm, 1e-9)
        better = score > best
        best[better], shift[better] = score[better], (j - SEARCH_CLOCK, i - reach)
    good = best > 0.7
    at = np.column_stack([x, y])[good].astype(float)
    return Seeds(at, at + shift[good])


def _match(one: View, two: View, cell: float, every: int) -> tuple[Floats, Floats] | None:
    """Cells (K,2) column, row of the grid in either view, where both show the wall; of the matches, every n-th along
    and around. cell: side of one."""
    first, end = max(one.row, two.row), min(one.row + len(one.picture), two.row + len(two.picture))
    if end - first < 64:
        return None
    part = [slice(first - v.row, end - v.row) for v in (one, two)]
    sound = one.sound[part[0]] & two.sound[part[1]]
    whole = box_sum(sound.astype(float), 6) >= 13 * 13 - 0.5
    pictures = [v.even[p] for v, p in zip((one, two), part, strict=True)]
    reach = SEARCH_S + round(WRONG_RADIUS * float(np.linalg.norm(two.centre - one.centre)) / cell)
    seeds = _seeds(pictures[0], pictures[1], whole, reach)
    if not len(seeds):
        return None
    m = match_quasi_dense(*pictures, seeds, mode="translation", radius=WINDOW // 2, zncc_min=0.75)
    x, y = m.xy1.astype(int).T
    x2, y2 = np.rint(m.xy2).astype(int).T
    inside = (x >= Unroller.pad) & (x < one.picture.shape[1] - Unroller.pad)
    near = (np.abs(m.xy2 - m.xy1) <= [2 * SEARCH_CLOCK, SEARCH_S + reach]).all(axis=1)
    keep = inside & near & whole[y, x] & whole[y2, x2] & (x % every == 0) & (y % every == 0)
    return m.xy1[keep] + [0, first], m.xy2[keep] + [0, first]


def _rays(unroller: Unroller, view: View, cells: Floats) -> Rays:
    """Origins and directions (K,3), of unit length, of what is at cells: rays through the tube's own points."""
    target = unroller.wall.points(unroller.s(cells[:, 1]), unroller.clock(cells[:, 0]))
    origin = np.broadcast_to(view.centre, target.shape)
    if unroller.camera.pupil_e1:
        pixels, _ = unroller.camera.project(target @ view.pose[:, :3].T + view.pose[:, 3])
        origin = origin + unroller.camera.origins(pixels) @ view.pose[:, :3]
    ray = target - origin
    return origin, ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _unrolled_rays(unroller: Unroller, one: View, two: View, every: int) -> tuple[Rays, Rays] | None:
    """Rays of what matches in the unrolled pictures, each n-th cell along and around."""
    cells = _match(one, two, unroller.cell, every)
    if cells is None:
        return None
    return _rays(unroller, one, cells[0]), _rays(unroller, two, cells[1])


def _raw_rays(unroller: Unroller, one: View, two: View) -> tuple[Rays, Rays] | None:
    """Rays of what matches in the keyframes as they are, from seeds that the wall predicts."""
    camera = unroller.camera
    seeds = predicted_seeds(unroller.wall, camera, one.pose, two.pose, _pixel_grid(camera, RAW_STEP))
    if not len(seeds):
        return None
    turn = two.pose[:, :3] @ one.pose[:, :3].T
    pose = np.column_stack([turn, two.pose[:, 3] - turn @ one.pose[:, 3]])
    central = {} if camera.pupil_e1 else {"cameras": camera, "relative_pose": pose}
    m = match_quasi_dense(one.image, two.image, seeds, **central, radius=RAW_RADIUS)
    pixels, keep = (m.xy1, m.xy2 - _bulge(unroller, one, two, m.xy1)), np.ones(len(m), bool)
    rays = []
    for view, xy in zip((one, two), pixels, strict=True):
        ray, ok = camera.unproject(xy)
        theta = np.arccos(np.clip(ray[:, 2], -1, 1))
        keep &= ok & camera.in_image(xy) & (theta >= THETA_LEAST) & (theta <= unroller.theta_most)
        rays.append((view.centre + camera.origins(xy) @ view.pose[:, :3], ray @ view.pose[:, :3]))
    (o1, d1), (o2, d2) = ((o[keep], d[keep]) for o, d in rays)
    return (o1, d1), (o2, d2)


def _pixel_grid(camera: Camera, step: int) -> Floats:
    """(n,2) pixels, row by row."""
    grid = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    return np.stack(grid, axis=-1).reshape(-1, 2).astype(float)


def _bulge(unroller: Unroller, one: View, two: View, pixels: Floats) -> Floats:
    """(K,2): how far a match fitted by an affine map lies off in view two, because over its window the true map is
    not affine: half the map's Laplacian times the window's variance. NaN where the wall does not tell."""
    camera, step = unroller.camera, RAW_BEND_STEP
    points = seen_on_wall(unroller.wall, camera, one.pose, _pixel_grid(camera, step))
    there, ok = camera.project(np.nan_to_num(points) @ two.pose[:, :3].T + two.pose[:, 3])
    there[~ok | np.isnan(points[:, 0])] = np.nan
    at = there.reshape(-(-camera.height // step), -(-camera.width // step), 2)
    laplacian = np.full(at.shape, np.nan)
    laplacian[1:-1, 1:-1] = (at[2:, 1:-1] + at[:-2, 1:-1] + at[1:-1, 2:] + at[1:-1, :-2] - 4 * at[1:-1, 1:-1]) / step**2
    column, row = np.rint(pixels / step).astype(int).T.clip(0, [[at.shape[1] - 1], [at.shape[0] - 1]])
    return 0.5 * laplacian[row, column] * WINDOW_VARIANCE


def _triangulated(unroller: Unroller, rays: tuple[Rays, Rays]) -> tuple[Floats, ...]:
    """s, clock, deviation, its sigma, each (K,), of matches whose rays meet."""
    wall, pixel = unroller.wall, 1 / unroller.camera.f_u
    (o1, d1), (o2, d2) = rays
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
    s, clock, deviation = wall.locate(point[keep])
    _, tangent, up, right = wall.frames(s)
    out = np.cos(clock)[:, None] * up + np.sin(clock)[:, None] * right
    # A shift of one ray's foot along s moves the crossing outwards by 1 / (difference of the rays' slopes).
    slopes = [np.einsum("ki,ki->k", d[keep], tangent) / np.einsum("ki,ki->k", d[keep], out) for d in (d1, d2)]
    gain = 1 / np.maximum(np.abs(slopes[0] - slopes[1]), 1e-6)
    footprint = pixel * np.hypot(r1, r2)[keep] * np.sqrt(1 + np.maximum(*(np.abs(v) for v in slopes)) ** 2)
    return s, clock, deviation, MATCH_PX * footprint * gain


def _medians(key: NDArray[np.int64], value: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Of each key, of values in order of key and value: where its values start, how many they are, their median."""
    start = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    count = np.diff(np.r_[start, len(key)])
    return start, count, 0.5 * (value[start + (count - 1) // 2] + value[start + count // 2])


def _per_cell(
    key: NDArray[np.int64], value: Floats, sigma: Floats, share: float
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """Of each key that has 3 values or more the median, its sigma as if a window's matches were one, and the sigma of
    one match, which is that of what they share. share: of a window, a match's own."""
    order = np.lexsort((value, key))
    key, value, sigma = key[order], value[order], sigma[order]
    start, count, middle = _medians(key, value)
    mean_sigma = np.add.reduceat(sigma, start) / count
    keep = count >= 3
    effective = np.maximum(count * share, 1)
    return key[start][keep], middle[keep], (mean_sigma / np.sqrt(effective))[keep], mean_sigma[keep]


def _fused(
    key: NDArray[np.int64], value: Floats, sigma: Floats, one: Floats, cells: int, shared: float
) -> tuple[Floats, Floats, Any, float]:
    """Of each cell: the mean of the pairs that agree with their median within 3 sigma, its sigma, how many pairs; and
    the scatter, by which sigmas are multiplied. one: sigma of one match; that share of it all pairs and matches have in
    common."""
    order = np.lexsort((value, key))
    key, value, sigma, common = key[order], value[order], sigma[order], shared * one[order]
    if not len(key):
        return np.full(cells, np.nan), np.full(cells, np.nan), np.zeros(cells, int), 1.0
    start, count, median = _medians(key, value)
    group = np.repeat(np.arange(len(start)), count)
    telling = count >= SPREAD_LEAST
    normal = np.abs(value - median[group]) / (sigma * np.sqrt(1 - 1 / count[group]).clip(0.5))
    scatter = float(np.median(normal[telling[group]]) / 0.6745) if telling.any() else 1.0
    scatter = max(scatter, 0.1)
    keep = np.abs(value - median[group]) <= 3 * np.hypot(scatter * sigma, common)
    weight = np.where(keep, sigma**-2.0, 0)
    total = np.add.reduceat(weight, start)
    agree = np.add.reduceat(keep.astype(int), start)
    mean = np.add.reduceat(weight * value, start) / np.maximum(total, 1e-30)
    square = np.add.reduceat(weight * (value - mean[group]) ** 2, start) / np.maximum(agree - 1, 1)
    # Pairs share keyframes, so n of them tell half as much as n would; and a cell whose pairs scatter more than most is
    # believed.
    variance = 2 * np.maximum(square, scatter**2) / np.maximum(total, 1e-30)
    variance += (np.add.reduceat(weight * common, start) / np.maximum(total, 1e-30)) ** 2
    good = (agree >= 2) & (2 * agree > count)
    out, error, pairs = np.full(cells, np.nan), np.full(cells, np.nan), np.zeros(cells, int)
    out[key[start][good]] = mean[good]
    error[key[start][good]] = np.sqrt(variance[good])
    pairs[key[start]] = agree
    return out, error, pairs, scatter


def _pairs(unroller: Unroller, poses: Floats) -> list[tuple[int, int]]:
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


def _checked(poses: Any, scale: float, calibration_px: float) -> Floats:
    """The poses. Raises ArgumentError."""
    pose_list = np.asarray(poses, float)
    if pose_list.ndim != 3 or pose_list.shape[1:] != (3, 4) or not np.isfinite(pose_list).all():
        raise ArgumentError(f"poses: shape {pose_list.shape} is not (n,3,4), or not finite")
    if not (math.isfinite(scale) and 0.5 <= scale <= 8):
        raise ArgumentError(f"scale: {scale} is not within 0.5 to 8")
    if not 0 <= calibration_px <= 10:
        raise ArgumentError(f"calibration_px: {calibration_px} is not within 0 to 10")
    return pose_list


def _cell_size(cell: float | None, diameter: float, unroller: Unroller) -> float:
    """The side of the map's cells. Raises ArgumentError."""
    size = max(diameter / CELLS, ACROSS * unroller.cell) if cell is None else cell
    if not (math.isfinite(size) and diameter / 1000 <= size <= diameter / 10):
        raise ArgumentError(f"cell: {size} is not within a thousandth to a tenth of the diameter")
    return size


def dense_wall(
    images: Callable[[int], Any],
    camera: Camera,
    poses: Any,
    wall: WallModel,
    *,
    cell: float | None = None,
    scale: float = 1.0,
    raw: bool = False,
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
    raw      keyframes are matched as they are, with maps fitted at each match, instead of unrolled: to check the one by
             the other. Slower, and the tube must be within a few hundredths of its radius, for seeds come from it
    calibration_px   what all pairs share and no scatter tells: errors that a calibration leaves. Where the image radius
             waves by an amplitude a over the angle, two rays of a match, at unlike angles, differ by a (rms: the square
             root of 2 of a wave's); 0.1 px is what zones of ordinary lenses come to
    threads  pairs at a time: do not change the result
    tell     is called with a fraction done

    Raises ArgumentError for what cannot be: shapes, sizes, nothing seen."""
    pose_list = _checked(poses, scale, calibration_px)
    threads = whole("threads", threads, 1)
    diameter = 2 * wall.mean_radius
    unroller = Unroller(camera, wall, scale)
    size = _cell_size(cell, diameter, unroller)
    every = max(1, int(size / unroller.cell / ACROSS))
    share = 1 / (2 * RAW_RADIUS + 1) ** 2 if raw else every**2 / WINDOW**2
    rows, columns = max(1, round(wall.length / size)), max(8, round(math.pi * diameter / size))

    def seen(k: int) -> View:
        return unroller.view(keyframe_picture(images, camera, k), pose_list[k])

    pairs = _pairs(unroller, pose_list)
    if not pairs:
        raise ArgumentError("poses: no two keyframes see the same wall from 0.2 to 0.7 diameters apart")
    light, lit = np.zeros(rows * columns), np.zeros(rows * columns)
    views: dict[int, View] = {}
    looks = np.zeros(rows * columns, int)
    parts = []

    def measured(pair: tuple[int, int]) -> tuple[NDArray[np.int64], Floats, Floats, Floats] | None:
        one, two = (views[k] for k in pair)
        rays = _raw_rays(unroller, one, two) if raw else _unrolled_rays(unroller, one, two, every)
        if rays is None:
            return None
        s, clock, deviation, sigma = _triangulated(unroller, rays)
        row, column = np.floor(s / wall.length * rows).astype(int), (clock / (2 * np.pi) * columns).astype(int)
        keep = (row >= 0) & (row < rows) & (np.abs(deviation) < 0.25 * diameter)
        if not keep.any():
            return None
        return _per_cell((row * columns + column % columns)[keep], deviation[keep], sigma[keep], share)

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
    joined = [np.concatenate(p) for p in zip(*parts, strict=True)] if parts else [np.empty(0, int), *[np.empty(0)] * 3]
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
    found.steps.extend(find_steps(found))
    found.regions.extend(find_regions(found))  # which are off their own surroundings, not off the tube
    tube_sigma = _tube_sigma(found)
    return replace(found, sigma=np.hypot(found.sigma, tube_sigma), tube_sigma=tube_sigma)


def _tube_sigma(found: DenseWall) -> float:
    """The mean, shift and ellipse that the map shows over half a diameter along, median of the cells as a sigma. A tube
    that is right leaves none: they are what it and the poses are off by, alike for neighbours and for all pairs, so
    that no scatter tells it. By the median, for what is not a smooth tube (steps, a bend's ends) is there to be
    shown."""
    measured = np.isfinite(found.deviation)
    return float(np.median(np.abs(ellipses(found)[measured])) / 0.6745) if measured.any() else 0.0


def _cells_of(unroller: Unroller, first: int, sound: NDArray[np.bool_], rows: int, columns: int) -> tuple[Any, Any]:
    """Places (n,2) of what is sound in unrolled rows from `first` on, and the map's cell of each."""
    inner = slice(unroller.pad, unroller.pad + unroller.columns)
    y, x = np.nonzero(sound[:, inner])
    row = np.minimum((unroller.s(y + first) / unroller.wall.length * rows).astype(int), rows - 1)
    return (y, x + unroller.pad), row * columns + ((x + 0.5) / unroller.columns * columns).astype(int)


def _add_light(unroller: Unroller, view: View, light: Floats, lit: Floats, rows: int, columns: int) -> None:
    """Adds a view's brightness, and one for each cell that it sees, to the map's sums."""
    place, key = _cells_of(unroller, view.row, view.sound, rows, columns)
    count = np.bincount(key, minlength=rows * columns)
    total = np.bincount(key, view.picture[place], minlength=rows * columns)
    seen = count > 0
    light[seen] += total[seen] / count[seen]
    lit[seen] += 1


def _in_view(unroller: Unroller, one: View, two: View, rows: int, columns: int) -> NDArray[np.int64]:
    """One for each cell of the map that both keyframes see."""
    first, end = max(one.row, two.row), min(one.row + len(one.picture), two.row + len(two.picture))
    if end <= first:
        return np.zeros(rows * columns, int)
    sound = one.sound[first - one.row : end - one.row] & two.sound[first - two.row : end - two.row]
    _, key = _cells_of(unroller, first, sound, rows, columns)
    return (np.bincount(key, minlength=rows * columns) > 0).astype(int)
