"""Quasi-dense matching of two images: from a few seeds, matches grow over everything the images have in common.

docs/matching.md explains modes and limits; the growth itself is C++ (engine/match).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import index
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _engine
from .camera import Camera
from .errors import ArgumentError

MODES = ("adaptive", "constant", "translation")
ADAPTATIONS = ("fit", "gradient", "intensity")
TURNS = ("correlation", "peak", "epipolar")
RADIUS = {"adaptive": 5, "constant": 3, "translation": 2}  # of the correlation window
SMALLEST = 32  # pixels a side
SEED_PIXELS = 800_000

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Seeds:
    """Where growth starts. xy1, xy2: (S,2) pixels in image 1 and 2. affine: (S,2,2), maps offsets from xy1 to offsets
    from xy2; None for no turn and no change of scale."""

    xy1: Floats
    xy2: Floats
    affine: Floats | None = None

    def __len__(self) -> int:
        return len(self.xy1)


@dataclass(frozen=True, eq=False)
class Matches:
    """What match_quasi_dense returns: K matches, one-to-one, in the order in which they were found.

    xy1      (K,2) pixels of image 1, whole numbers
    xy2      (K,2) where they are in image 2, to a fraction of a pixel
    affine   (K,2,2) the map between the surroundings: xy1 + v corresponds to xy2 + affine @ v
    zncc     (K,) zero-mean normalised cross-correlation of the surroundings, at most 1: of a window one pixel wider on
             each side than `radius` says where map or place was fitted, of that of `radius` in mode "translation", of
             15 x 15 pixels for a seed
    parent   (K,) the match each grew from, -1 for a seed
    seed     (K,) the seed each comes from, an index into `seeds`
    status   "ok", "no seeds" (none found, or none that fits its surroundings), "no growth" (no seed came to 200
             matches: the images probably have nothing in common) or "nothing left" (by filter_matches)
    counts   of the growth, which filters leave as they are: grown (matches), seeds_used, at_border (matches found at
             the rim of the search: more than a fifth of the grown means that maps are wrong); and what became of
             candidates: tried, low_zncc (before or after the fit), taken (its place was), off_line (the epipolar line)
    """

    xy1: Floats
    xy2: Floats
    affine: Floats
    zncc: Floats
    parent: NDArray[np.int64]
    seed: NDArray[np.int64]
    seeds: Seeds
    status: str
    shape1: tuple[int, int]
    shape2: tuple[int, int]
    counts: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.xy1)

    def map1(self) -> NDArray[np.int64]:
        """(H,W) of image 1: the index of each pixel's match, -1 without."""
        out = np.full(self.shape1, -1, np.int64)
        x, y = self.xy1.astype(int).T
        out[y, x] = np.arange(len(self))
        return out


def grey(image: ArrayLike, name: str) -> NDArray[np.float32]:
    """An image as (H,W) float32 of 0..1: uint8 or uint16 of their range, or floats of 0..1; (H,W,3) is RGB.

    Raises ArgumentError that names `name`."""
    given = np.asarray(image)
    if given.ndim not in (2, 3) or (given.ndim == 3 and given.shape[2] not in (1, 3, 4)):
        raise ArgumentError(f"{name}: shape {given.shape} is not (H,W) or (H,W,3)")
    if min(given.shape[:2]) < SMALLEST or max(given.shape[:2]) > 16384:
        raise ArgumentError(f"{name}: {given.shape[1]}x{given.shape[0]} is not between {SMALLEST} and 16384 a side")
    if given.dtype == np.uint8 or given.dtype == np.uint16:
        value = given.astype(np.float32) / np.iinfo(given.dtype).max
    elif given.dtype.kind == "f":
        value = given.astype(np.float32)
        if not np.isfinite(value).all() or value.min() < -1e-6 or value.max() > 1 + 1e-6:
            raise ArgumentError(f"{name}: floating-point values must be finite and within 0..1")
    else:
        raise ArgumentError(f"{name}: {given.dtype} is not uint8, uint16 or a floating-point type")
    if value.ndim == 3:
        weights = np.array([0.299, 0.587, 0.114], np.float32)
        value = value[..., 0] if value.shape[2] == 1 else value[..., :3] @ weights
    return np.ascontiguousarray(value)


def find_seeds(
    image1: ArrayLike,
    image2: ArrayLike,
    most: int = 1000,
    affine: bool = True,
    threads: int = 1,
    *,
    hessian: bool = False,
) -> Seeds:
    """Seeds from affine-covariant regions of both images, matched by descriptors: SIFT's points with and without
    adapted shapes, and maximally stable extremal regions. Many may be wrong.

    most      of SIFT's points an image, and half as many extremal regions
    affine    False: circles only, faster
    hessian   the maxima of the Hessian's determinant too, as many as SIFT's: half as many seeds again or more, in twice
              the time, for pairs in which few are found

    Large images are halved first, until they are of 800,000 pixels: the growth fits seeds anew. Raises ArgumentError.
    """
    most, threads = whole("most", most, 1, 10**6), whole("threads", threads, 1)
    one, two = grey(image1, "image1"), grey(image2, "image2")
    times = 0
    while one.size > SEED_PIXELS or two.size > SEED_PIXELS:
        one, two, times = halved(one), halved(two), times + 1
    rows = _engine.find_seeds(one, two, most, affine, bool(hessian), affine, threads)
    xy = rows[:, :4] * 2**times + (2**times - 1) / 2
    return Seeds(xy[:, :2].copy(), xy[:, 2:].copy(), rows[:, 4:].reshape(-1, 2, 2).copy())


def halved(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of 2 x 2 pixels."""
    even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    return np.ascontiguousarray((even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / 4)


def _numbers(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    try:
        out = np.ascontiguousarray(value, np.float64)
    except (TypeError, ValueError):
        raise ArgumentError(f"{name}: not numbers") from None
    if out.ndim != len(shape) or any(want not in (-1, got) for want, got in zip(shape, out.shape, strict=True)):
        wanted = ",".join("S" if n < 0 else str(n) for n in shape)
        raise ArgumentError(f"{name}: shape {out.shape} is not ({wanted})")
    if not np.isfinite(out).all():
        raise ArgumentError(f"{name}: not finite")
    return out


def whole(name: str, value: Any, least: int, most: int | None = None) -> int:
    """A whole number from `least` to `most`. Raises ArgumentError that names `name`."""
    try:
        number = index(value)
    except TypeError:
        raise ArgumentError(f"{name}: {value!r} is not a whole number") from None
    if number < least:
        raise ArgumentError(f"{name}: {number} is not at least {least}")
    if most is not None and number > most:
        raise ArgumentError(f"{name}: {number} is more than {most}")
    return number


def _given_seeds(seeds: Any) -> Seeds:
    """Seeds from Seeds, (xy1, xy2), (xy1, xy2, affine), or (S,4) rows x1 y1 x2 y2."""
    if isinstance(seeds, Seeds):
        parts: Sequence[Any] = (seeds.xy1, seeds.xy2, seeds.affine)
    elif isinstance(seeds, tuple) and len(seeds) in (2, 3):
        parts = seeds
    else:
        rows = _numbers("seeds", seeds, (-1, 4))
        parts = (rows[:, :2], rows[:, 2:])
    xy1, xy2 = _numbers("seeds: xy1", parts[0], (-1, 2)), _numbers("seeds: xy2", parts[1], (-1, 2))
    n = len(xy1)
    if len(parts) < 3 or parts[2] is None:
        affine = np.tile(np.eye(2), (n, 1, 1))
    else:
        affine = _numbers("seeds: affine", parts[2], (-1, 2, 2))
    if not n == len(xy2) == len(affine):
        raise ArgumentError(f"seeds: {n} xy1, {len(xy2)} xy2 and {len(affine)} affine")
    return Seeds(xy1, xy2, affine)


def epipolar_geometry(cameras: Any, relative_pose: Any) -> tuple[Any, Any, Floats | None]:
    """The two profiles of the C core and cam2_from_cam1, or three None."""
    if cameras is None and relative_pose is None:
        return None, None, None
    if cameras is None or relative_pose is None:
        raise ArgumentError("cameras and relative_pose: the epipolar geometry needs both")
    pair = (cameras, cameras) if isinstance(cameras, Camera) else cameras
    if not isinstance(pair, Sequence) or len(pair) != 2 or not all(isinstance(c, Camera) for c in pair):
        raise ArgumentError("cameras: a Camera, or two of them")
    if any(c.pupil_e1 for c in pair):
        raise ArgumentError("cameras: pupil_e1: the epipolar geometry is that of central cameras")
    pose = _numbers("relative_pose", relative_pose, (3, 4))
    if np.abs(pose[:, :3] @ pose[:, :3].T - np.eye(3)).max() > 1e-6 or np.linalg.det(pose[:, :3]) < 0:
        raise ArgumentError("relative_pose: its first three columns are not a rotation")
    if not np.linalg.norm(pose[:, 3]) > 0:
        raise ArgumentError("relative_pose: no translation, so no epipolar geometry")
    return pair[0]._profile, pair[1]._profile, pose


def _choice(name: str, value: str, among: tuple[str, ...], kind: Any) -> Any:
    if value not in among:
        raise ArgumentError(f"{name}: {value!r} is none of {', '.join(among)}")
    return getattr(kind, value)


def match_quasi_dense(
    image1: ArrayLike,
    image2: ArrayLike,
    seeds: Any = None,
    cameras: Any = None,
    relative_pose: ArrayLike | None = None,
    *,
    mode: str = "adaptive",
    adaptation: str = "fit",
    turn: str = "correlation",
    radius: int | None = None,
    zncc_min: float = 0.8,
    texture: float = 0.01,
    epipolar_px: float = 1.0,
    threads: int = 1,
) -> Matches:
    """Matches two images quasi-densely.

    image1, image2  (H,W) or (H,W,3), uint8, uint16 or floats of 0..1
    seeds           Seeds, (xy1, xy2), (xy1, xy2, affine) or (S,4) rows x1 y1 x2 y2 in pixels; None: found by itself
    cameras         a Camera, or one for each image; with relative_pose: only matches on their epipolar lines (on a
                    fisheye: curves), and maps held to them
    relative_pose   (3,4) cam2_from_cam1; the length of the translation does not count
    mode            "adaptive": the map is estimated at each match. "constant": it stays the seed's. "translation": no
                    map, for a narrow baseline, fastest
    adaptation      "fit" (least squares), "gradient" (second moments of the gradient, then the fit) or "intensity"
                    (second moments of the intensity, as Kannala and Brandt)
    turn            what settles the rotation that moments leave open: "correlation" or "peak" of the histograms of
                    gradient directions, or "epipolar"
    radius          of the correlation window in pixels, 2 to 7 [adaptive 5, constant 3, translation 2]
    zncc_min        least correlation of a match, 0.3 to 0.99; below 0.8 matches keep their parent's map
    texture         least difference to a neighbouring pixel (of 1) where a match may be
    epipolar_px     largest distance from the epipolar line, pixels
    threads         do not change the result

    Images with nothing in common are no error: see Matches.status. Raises ArgumentError for arguments that are wrong.
    """
    one, two = grey(image1, "image1"), grey(image2, "image2")
    options = _engine.MatchOptions()
    options.mode = _choice("mode", mode, MODES, _engine.MatchMode)
    options.adaptation = _choice("adaptation", adaptation, ADAPTATIONS, _engine.MatchAdaptation)
    options.turn = _choice("turn", turn, TURNS, _engine.MatchTurn)
    options.radius = RADIUS[mode] if radius is None else whole("radius", radius, 2, 7)
    limits = {"zncc_min": (zncc_min, 0.3, 0.99), "texture": (texture, 0, 1), "epipolar_px": (epipolar_px, 1e-3, 1e3)}
    for name, (value, low, high) in limits.items():
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise ArgumentError(f"{name}: {value!r} is not a number") from None
        if not low <= number <= high:
            raise ArgumentError(f"{name}: {number} is not within {low} to {high}")
        setattr(options, name, number)
    options.threads = whole("threads", threads, 1)
    profiles = epipolar_geometry(cameras, relative_pose)
    if turn == "epipolar" and profiles[2] is None:
        raise ArgumentError("turn: 'epipolar' needs cameras and relative_pose")
    for k, camera in enumerate(profiles[:2]):
        if camera is not None and (camera.height, camera.width) != (one, two)[k].shape:
            raise ArgumentError(f"cameras: {camera.width}x{camera.height} is not the size of image{k + 1}")
    start = (
        find_seeds(one, two, affine=mode != "translation", threads=threads) if seeds is None else _given_seeds(seeds)
    )
    grown = _engine.grow_matches(one, two, start.xy1, start.xy2, start.affine, options, *profiles)
    arrays = {name: grown.pop(name) for name in ("xy1", "xy2", "affine", "zncc", "parent", "seed")}
    grown["grown"] = len(arrays["xy1"])
    status = "ok"
    if not grown["seeds_used"]:
        status = "no seeds"
    elif np.bincount(arrays["seed"]).max() < 200:
        status = "no growth"
    return Matches(**arrays, seeds=start, status=status, shape1=one.shape, shape2=two.shape, counts=grown)
