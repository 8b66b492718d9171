"""Pictures that show some of a target, and which points those are is open: settled by a first model.

Where a grid lies on its lattice says nothing: on a flat board each place has a pose that explains it as well. What
tells is where the picture ought to show more points. Each place is scored by the logarithm of how much likelier it
makes what the model-guided search finds and misses than no target at all does."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .calib_data import Array, CalibrationError, View, compose
from .calib_fit import angles
from .calib_input import Target3D
from .calibration import Calibration
from .camera import Camera
from .detect import Detection, detect_target
from .target import Target

Ids = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

_FEWEST = 6  # points of a picture whose place is looked for
_MOST_PLACES = 60  # each costs a search of the picture; a part that fits in more places is too small to be told
_FIELD = 0.97  # of the angle up to which points have been found: beyond, the lens may cut them
_MARGIN = 0.5  # steps of the grid from the picture's edge: nearer, a point need not be found
_MISSED = (0.02, 0.3)  # of the points that ought to be seen: what a first model's pictures may say of their share
_STRAY = 0.2  # of the searches where nothing is that find something
_SURE = math.log(10)  # likelier than the next place, and than no target
_COVERED = 0.1  # of the points that ought to be seen: where more are missing, something is before the target
_MISFIT = 3.0  # times the root mean square error of the views: the first model does not explain it
_BESIDE_PX = 2.0  # a point of the guided search that stands so far from the picture's own is another one


def turns_of(target: Target) -> list[int]:
    """Quarter turns of the lattice that keep its distances: all four where it is square, else none and half."""
    a, b = target.lattice()[1]
    square = abs(a @ b) < 1e-9 * (a @ a) and abs(a @ a - b @ b) < 1e-6 * (a @ a)
    return [0, 1, 2, 3] if square else [0, 2]


def _turned(sites: Ids, quarters: int) -> Ids:
    for _ in range(quarters):
        sites = np.stack([-sites[:, 1], sites[:, 0]], axis=1)
    return sites


def places(target: Target, ids: Ids) -> list[Ids]:
    """All rows of a target that a part of it, seen as rows `ids`, may be: turned and shifted on the lattice, of the
    same colours (a quarter turn exchanges those of a checkerboard's corners), never mirrored. Of those that a turn of
    the whole target carries into each other, one."""
    sites = target.lattice()[0]
    row = {tuple(s): i for i, s in enumerate(sites.tolist())}
    coloured = not target.has_circles

    def laid(some: Ids, quarters: int, shift: Ids, count: int) -> Ids | None:
        moved = _turned(some, quarters) + shift
        if coloured and (int((moved - some)[0].sum()) + quarters) % 2:
            return None
        found = np.array([row.get(tuple(s), -1) for s in moved.tolist()])
        return found if len(found) == count and found.min() >= 0 else None

    same = []  # turns of the whole target that carry it into itself
    for quarters in turns_of(target):
        shift = sites.min(axis=0) - _turned(sites, quarters).min(axis=0)
        whole = laid(sites, quarters, shift, len(sites))
        if whole is not None:
            same.append(whole)
    out: dict[tuple[int, ...], Ids] = {}
    for quarters in turns_of(target):
        turned = _turned(sites[ids], quarters)
        low, high = sites.min(axis=0) - turned.min(axis=0), sites.max(axis=0) - turned.max(axis=0)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                found = laid(sites[ids], quarters, np.array([i, j]), len(ids))
                if found is not None:
                    out.setdefault(min(tuple(turn[found].tolist()) for turn in same), found)
    return list(out.values())


def visible(camera: Camera, pose: Array, points: Array, step_px: float) -> Mask:
    """Which points (N, 3) of a target a picture ought to show: inside the field, not at the picture's edge (N,)."""
    there = points @ pose[:, :3].T + pose[:, 3]
    at, seen = camera.project(there)
    seen &= angles(there) < _FIELD * (camera.theta_covered or camera.theta_max)
    at, edge = np.nan_to_num(at, nan=-1e9), _MARGIN * step_px
    seen &= (at > edge).all(axis=1) & (at < np.array([camera.width, camera.height]) - edge).all(axis=1)
    around = edge * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    return seen & np.all([camera.in_image(at + step) for step in around], axis=0)


def step_of(pixels: Array) -> float:
    """About how far neighbours of a grid lie apart, pixels."""
    return float(np.linalg.norm(np.ptp(pixels, axis=0)) / math.sqrt(2 * len(pixels)))


def missed_share(first: Calibration, views: Sequence[View], targets: Sequence[Target3D]) -> tuple[float, float]:
    """Of the points that pictures of known place ought to show, the share that was not found; and how likely a picture
    is to have something before its target, by how many of these have (and one in ten beforehand): misses come together
    then."""
    ought = lacking = known_views = covered = 0
    for view, pose in zip(views, first.poses, strict=True):
        if np.isfinite(pose).all():
            points = targets[view.board].points
            seen = visible(first.cameras[view.camera], pose, points, step_of(view.pixels))
            known = {p.tobytes() for p in view.board_xyz}
            missing = sum(p.tobytes() not in known for p in points[seen])
            known_views += 1
            covered += missing > _COVERED * seen.sum()
            if missing <= _COVERED * seen.sum():
                ought += int(seen.sum())
                lacking += missing
    return float(np.clip(lacking / max(ought, 1), *_MISSED)), (covered + 0.5) / (known_views + 5)


def settle(
    image: npt.NDArray[np.uint8],
    target: Target,
    ids: Ids,
    pixels: Array,
    first: Calibration,
    missed: float,
    covered: float,
) -> tuple[Detection | None, str]:
    """The points that an ambiguous picture of a one-camera, one-target run shows: (found, ""), or (None, why not).

    missed, covered: of missed_share."""
    if target.kind == "sleeve" or len(ids) < _FEWEST:
        return None, f"{len(ids)} points, and which ones cannot be told"
    choices = places(target, ids)
    if not 0 < len(choices) <= _MOST_PLACES:
        return None, f"{len(ids)} points fit on the target in {len(choices)} places: too small a part of it"
    points, (camera,) = target.points(), first.cameras.values()
    (number,) = first.cameras
    try:
        _, (pose,) = first.residuals([View(points[choices[0]], pixels, 0, number)])
    except CalibrationError:
        return None, "no pose of the target explains it"
    scores: list[tuple[float, Detection]] = []
    for place in choices:
        there = np.ascontiguousarray(compose(pose, _motion(points[place], points[choices[0]])))
        ought = visible(camera, there, points, step_of(pixels))
        found = detect_target(image, target, camera, there)
        where = np.full((len(points), 2), np.inf)
        where[found.ids] = found.pixels
        seen = np.isfinite(where[:, 0])
        stands = np.linalg.norm(where[place] - pixels, axis=1)
        seen[place[~(stands < _BESIDE_PX)]] = False
        hits, lacks = int(seen[ought].sum()), int((~seen & ought).sum())
        lost = max(lacks * math.log(missed / (1 - _STRAY)), math.log(covered))
        score = hits * math.log((1 - missed) / _STRAY) + lost
        scores.append((score, found))
    scores.sort(key=lambda s: -s[0])
    best, found = scores[0]
    if best < _SURE or (len(scores) > 1 and best - scores[1][0] < _SURE):
        return None, f"{len(ids)} points that fit on the target in {len(choices)} places, none clearly better"
    try:
        error, _ = first.residuals([View(points[found.ids], found.pixels, 0, number)])
    except CalibrationError:
        return None, "no pose of the target explains it"
    if np.median(np.hypot(*error.T)) > _MISFIT * first.rms + 0.1:
        return None, "its points do not fit the lens of the other pictures"
    return found, ""


def _motion(source: Array, to: Array) -> Array:
    """The rigid motion (3, 4) of the sheet that carries points (N, 3) in its plane onto others."""
    a, b = source[:, :2] - source[:, :2].mean(axis=0), to[:, :2] - to[:, :2].mean(axis=0)
    angle = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.column_stack([turn, to.mean(axis=0) - turn @ source.mean(axis=0)])
