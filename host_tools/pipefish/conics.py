"""Conics: homographies from two or more of them, ellipses in pictures, a target's pose from its discs' outlines.

A conic is a symmetric (3, 3) matrix C with x^T C x = 0 for its points x = (x, y, 1); its scale means nothing.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipefish import _engine
from pipefish.detect import Detection, detect_target, grey
from pipefish.errors import ArgumentError, FormatError
from pipefish.files import PICTURES, opened_picture
from pipefish.target import Target

if TYPE_CHECKING:
    from pipefish.camera import Camera

Array = npt.NDArray[np.float64]


def _conics(name: str, given: npt.ArrayLike) -> Array:
    try:
        c = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ArgumentError(f"{name}: expected numbers of shape (n, 3, 3)") from None
    if c.ndim != 3 or c.shape[1:] != (3, 3) or len(c) < 2:
        raise ArgumentError(f"{name}: expected shape (n, 3, 3), n at least 2, got {c.shape}")
    for k, conic in enumerate(c):
        if not np.isfinite(conic).all() or np.abs(conic - conic.T).max() > 1e-9 * np.abs(conic).max():
            raise ArgumentError(f"{name}[{k}]: not a finite symmetric matrix")
    return (c + c.transpose(0, 2, 1)) / 2


def homography_from_conics(C: npt.ArrayLike, C_prime: npt.ArrayLike) -> Array:
    """Homographies H that map conics to conics: C'_i ~ H^-T C_i H^-1, det H = 1.

    C, C_prime: (n, 3, 3), in the same order. Returns (k, 3, 3): for n >= 3 one, linear and then refined so that the
    mapped ellipses lie nearest to C_prime's; for n = 2 every real candidate (up to four), those that keep centres
    inside and orientation first. Raises ArgumentError for degenerate conics, for conics that leave a family of
    homographies (concentric circles), and for two pairs that no homography maps.
    """
    first, second = _conics("C", C), _conics("C_prime", C_prime)
    if len(first) != len(second):
        raise ArgumentError(f"C, C_prime: {len(first)} and {len(second)} conics; as many are needed on both sides")
    try:
        return np.array(_engine.homography_from_conics(list(first), list(second)))
    except ValueError as error:
        raise ArgumentError(str(error)) from None


def map_conics(H: npt.ArrayLike, C: npt.ArrayLike) -> Array:
    """Conics (n, 3, 3) as a homography (3, 3) maps them, of unit norm."""
    back = np.linalg.inv(np.asarray(H, dtype=float))
    out = np.einsum("ji,njk,kl->nil", back, np.asarray(C, dtype=float), back)
    return out / np.linalg.norm(out, axis=(1, 2), keepdims=True)


def ellipse(centre: tuple[float, float], half_axes: tuple[float, float], angle: float = 0.0) -> Array:
    """The conic (3, 3) of an ellipse; angle: of the first half axis, radians from x to y."""
    c, s = math.cos(angle), math.sin(angle)
    to_unit = np.diag([1 / half_axes[0], 1 / half_axes[1]]) @ np.array([[c, s], [-s, c]])
    t = np.vstack([np.column_stack([to_unit, -to_unit @ np.asarray(centre, dtype=float)]), [0, 0, 1]])
    return t.T @ np.diag([1.0, 1.0, -1.0]) @ t


def ellipse_centre(C: npt.ArrayLike) -> Array:
    """Centres (n, 2) of ellipses (n, 3, 3)."""
    c = np.asarray(C, dtype=float)
    return -np.linalg.solve(c[:, :2, :2], c[:, :2, 2:])[..., 0]


def ellipses_in(image: npt.ArrayLike) -> Array:
    """Conics (n, 3, 3) of the dark discs in a picture (H, W): ellipses fitted to their outlines, the largest first."""
    outlines = _engine.find_outlines(grey(image))
    outlines.sort(key=lambda points: -float(np.prod(np.ptp(points, axis=0))))
    return np.array([_engine.fit_ellipse(points) for points in outlines]).reshape(-1, 3, 3)


def circles_of(target: Target) -> Array:
    """Conics (n, 3, 3) of a flat target's discs, in metres on the sheet. Raises ArgumentError."""
    if not target.has_circles or target.kind == "sleeve":
        raise ArgumentError(f"target: homographies need a plane with circles, not a {target.kind}")
    return np.array([ellipse((x, y), (target.radius_m,) * 2) for x, y in target.flat_points()])


def pose_from_discs(detection: Detection, target: Target, camera: Camera) -> tuple[Array, float]:
    """cam_from_target (3, 4), metres, of a flat target with circles, from the outlines that were detected, and the rms
    of the outlines' rays, radians.

    The outlines are cones of rays, and cones of discs have no centroid bias; it works at 90 degrees and beyond. Raises
    ArgumentError where fewer than three outlines are seen, or the target is no plane with circles.
    """
    circles_of(target)
    if detection.outlines is None or len(detection.ids) < 3:
        raise ArgumentError("detection: the outlines of at least three discs are needed")
    rays, kept = [], []
    for number, outline in zip(detection.ids, detection.outlines, strict=True):
        seen = outline[np.isfinite(outline).all(1)]
        r, ok = camera.unproject(seen)
        if ok.sum() >= 8:
            rays.append(np.ascontiguousarray(r[ok]))
            kept.append(number)
    middles = np.ascontiguousarray(target.flat_points()[kept])
    try:
        return _engine.pose_of_discs(middles, target.radius_m, rays)
    except ValueError as error:
        raise ArgumentError(f"detection: {error}") from None


# ---- which conic is which


def match_conics(C: npt.ArrayLike, C_prime: npt.ArrayLike) -> list[tuple[int, int]]:
    """Which ellipses (n, 3, 3) of one set are which of another, under some homography that keeps orientation: pairs of
    their numbers, at least four. Of both sets the first twelve are looked at. Raises ArgumentError where no homography
    maps four or more, each to within a fifth of its size."""
    first, second = _conics("C", C)[:12], _conics("C_prime", C_prime)[:12]
    sizes = np.array([np.sqrt(abs(np.linalg.det(c) / np.linalg.det(c[:2, :2]) ** 1.5)) for c in second])
    centres = ellipse_centre(second)
    best: list[tuple[int, int]] = []
    least = np.inf
    for start in itertools.islice(itertools.combinations(range(len(first)), 3), 4):
        for order in itertools.permutations(range(len(second)), 3):
            try:
                h = homography_from_conics(first[list(start)], second[list(order)])[0]
            except ArgumentError:
                continue
            mapped = map_conics(h, first)
            with np.errstate(all="ignore"):
                off = np.linalg.norm(ellipse_centre(mapped)[:, None] - centres[None], axis=2) / sizes
            nearest = np.argmin(np.nan_to_num(off, nan=np.inf), axis=1)
            pairs = [(k, int(m)) for k, m in enumerate(nearest) if off[k, m] < 0.2]
            cost = float(sum(off[k, m] for k, m in pairs)) / max(len(pairs), 1)
            if len({m for _, m in pairs}) == len(pairs) and (len(pairs), -cost) > (len(best), -least):
                best, least = pairs, cost
        if len(best) >= min(len(first), len(second)):
            break
    if len(best) < 4:
        raise ArgumentError(
            f"conics: of {len(first)} and {len(second)} ellipses, the largest, fewer than four correspond; give conics "
            "in the same order in files, or a target's description"
        )
    return best


def discs_of_target(target: Target, image: npt.ArrayLike) -> tuple[Array, npt.NDArray[np.int64]]:
    """Conics (n, 3, 3) of a target's discs that a picture (H, W) shows, and which they are (n,): rows of circles_of().

    Raises ArgumentError with the detector's reason where it does not find the target."""
    circles_of(target)
    found = detect_target(grey(image), target)
    if found.outlines is None or not len(found.ids):
        raise ArgumentError(f"the target is not found in the picture: {found.reason}")
    outlines = [line[np.isfinite(line).all(axis=1)] for line in found.outlines]
    whole = [k for k, line in enumerate(outlines) if len(line) >= 6]
    return np.array([_engine.fit_ellipse(outlines[k]) for k in whole]).reshape(-1, 3, 3), found.ids[whole]


# ---- files


def is_target(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a target's description."""
    path = Path(path)
    return path.suffix.lower() == ".json" and '"pipefish-target"' in path.read_text(encoding="utf-8", errors="replace")


def load_picture(path: str | os.PathLike[str]) -> npt.NDArray[np.uint8]:
    """A picture (H, W) in grey. Raises FormatError, OSError."""
    with opened_picture(path) as picture:
        return np.asarray(picture.convert("L"))


def load_conics(path: str | os.PathLike[str]) -> tuple[Array, bool]:
    """Conics (n, 3, 3) of a file, and whether their order means anything.

    A picture: its dark discs, in no order. A target's description: its circles. Else JSON, a list or {"conics": [...]},
    or CSV, of conics as 9 numbers (or 3 x 3) or as 6 numbers a, b, c, d, e, f of a x^2 + b x y + c y^2 + d x + e y + f.
    Raises FormatError with the file and the place, OSError.
    """
    path = Path(path)
    if path.suffix.lower() in PICTURES:
        found = ellipses_in(load_picture(path))
        if len(found) < 3:
            raise FormatError(path, None, f"{len(found)} dark discs found, at least 3 are needed")
        return found, False
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise FormatError(path, None, "neither a picture nor text") from None
    rows: list[tuple[str, Any]] = []
    if path.suffix.lower() == ".csv":
        for number, line in enumerate(text.splitlines(), 1):
            line = line.split("#")[0].strip()
            if line and not (number == 1 and line[0].isalpha()):
                rows.append((f"line {number}", line.replace(";", ",").split(",")))
    else:
        try:
            data = json.loads(text)
        except json.JSONDecodeError as error:
            raise FormatError(path, f"line {error.lineno}", f"not JSON: {error.msg}") from None
        if isinstance(data, dict) and data.get("format") == "pipefish-target":
            return circles_of(Target.load(path)), True
        listed = data.get("conics") if isinstance(data, dict) else data
        if not isinstance(listed, list):
            raise FormatError(path, "conics", "must be a list of conics")
        rows = [(f"conics[{k}]", item) for k, item in enumerate(listed)]
    return np.array([_one_conic(path, where, item) for where, item in rows]).reshape(-1, 3, 3), True


def _one_conic(path: Path, where: str, item: Any) -> Array:
    try:
        numbers = np.array(item, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise FormatError(path, where, "not numbers") from None
    if len(numbers) == 6:
        a, b, c, d, e, f = numbers
        return np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]])
    if len(numbers) != 9:
        raise FormatError(path, where, f"{len(numbers)} numbers, a conic has 6 or 9")
    return numbers.reshape(3, 3)
