"""The scale by a target of known size that the camera drove past: `pipefish target` prints and describes it.

Its points are found in the pictures of keyframes whose poses are known; a similarity that takes the target to where it
was (seven parameters) is fitted to all of them at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipefish.camera import Camera
from pipefish.detect import detect_target
from pipefish.scale import Estimate
from pipefish.structure import Reconstruction
from pipefish.survey import Survey
from pipefish.target import Target

EVERY = 3  # keyframes: where it is looked for at first
LEAST_POINTS = 6  # of a target, in a picture
LEAST_BASELINE = 0.05  # of the distance to the target: cameras nearer together tell no depth
PIXEL_FLOOR = 0.1  # px: of a point's place, beside what its picture shows; the profile's own error
PRINT_SIGMA = 0.001  # relative: paper and printers, where nobody measured the sheet
WORST_PX = 3.0  # rms of the fit: more is no target, or another one


@dataclass
class Seen:
    """A target's points in one frame of the structure: frame, ids (M,), pixels (M,2), variance (M,) px^2."""

    frame: int
    ids: np.ndarray
    pixels: np.ndarray
    variance: np.ndarray


def look(survey: Survey, index: np.ndarray, target: Target, tell: Callable[[float], None]) -> list[Seen]:
    """Where the target is seen; index: number in the survey of each of the structure's frames."""
    by_index = {k.index: k for k in survey.keyframes}
    found: dict[int, Seen | None] = {}

    def see(frame: int) -> Seen | None:
        if frame not in found:
            seen, kept = detect_target(np.asarray(by_index[int(index[frame])].image), target), None
            if seen and not seen.mirrored and len(seen.ids) >= LEAST_POINTS:
                kept = Seen(frame, seen.ids, seen.pixels, np.trace(seen.covariance, axis1=1, axis2=2) / 2)
            found[frame] = kept
            tell(len(found) / len(index))
        return found[frame]

    # Whoever drives past sees it in many pictures, one after the other: the others are looked at around a find only.
    for frame in range(0, len(index), EVERY):
        for step in (-1, 1) if see(frame) else ():
            beside = frame + step
            while 0 <= beside < len(index) and see(beside):
                beside += step
    return [seen for _, seen in sorted(found.items()) if seen]


def _start(seen: list[Seen], structure: Reconstruction, camera: Camera, points: np.ndarray) -> np.ndarray | None:
    """(3,4) that takes the target's points into the structure, scale included, from their triangulation."""
    normal = np.zeros((len(points), 3, 3))
    right = np.zeros((len(points), 3))
    views = np.zeros(len(points), int)
    for s in seen:
        pose = structure.poses[s.frame]
        rays, ok = camera.unproject(s.pixels)
        rays = rays @ pose[:, :3]
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        centre = -pose[:, :3].T @ pose[:, 3]
        ids = s.ids[ok]
        normal[ids] += across[ok]
        right[ids] += across[ok] @ centre
        views[ids] += 1
    good = np.flatnonzero(views >= 2)
    good = good[np.linalg.eigvalsh(normal[good])[:, 0] > 1e-6]
    if len(good) < LEAST_POINTS:
        return None
    found = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    a, b = points[good] - points[good].mean(0), found - found.mean(0)
    u, d, v = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    scale = float((d * sign).sum() / (a**2).sum())
    turn = scale * (u * sign) @ v
    return np.column_stack([turn, found.mean(0) - turn @ points[good].mean(0)])


def fit_target(
    seen: list[Seen], structure: Reconstruction, camera: Camera, points: np.ndarray
) -> tuple[float, float, float] | str:
    """Metres a unit of the structure (logarithm), its sigma by the pictures' noise with the poses held, and the fit's
    rms in px; or why not. seen: from one segment; points (N,3) of the target, metres."""
    if not seen:
        return "it was found in no keyframe"
    camera = structure.in_its_unit(camera, int(structure.segment[seen[0].frame]))
    centres = structure.centres[[s.frame for s in seen]]
    place = _start(seen, structure, camera, points)
    if place is None:
        return f"it was found in {len(seen)} keyframes, too few to tell how far away it is"
    away = np.linalg.norm(centres - (place[:, :3] @ points.mean(0) + place[:, 3]), axis=1).min()
    if np.ptp(centres, axis=0).max() < LEAST_BASELINE * away:
        return "the camera hardly moved while it saw it"
    frame = np.concatenate([np.full(len(s.ids), s.frame) for s in seen])
    ids, pixels = np.concatenate([s.ids for s in seen]), np.concatenate([s.pixels for s in seen])
    sigma = np.sqrt(np.concatenate([s.variance for s in seen]) + PIXEL_FLOOR**2)
    turn, move = structure.poses[frame, :, :3], structure.poses[frame, :, 3]

    def residuals(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        spun = points[ids] @ p[:, :3].T
        at = np.einsum("nij,nj->ni", turn, spun + p[:, 3]) + move
        image, ok, slope = camera.project_jacobian(at)[:3]
        by_world = slope @ turn
        cross = np.zeros((len(ids), 3, 3))
        cross[:, [2, 0, 1], [1, 2, 0]] = -spun
        cross[:, [1, 2, 0], [2, 0, 1]] = spun
        by = np.concatenate([by_world @ spun[:, :, None], by_world @ cross, by_world], axis=2)
        off = np.where(ok[:, None], pixels - image, 0.0)
        return off, np.where(ok[:, None, None], by, 0.0)

    for _ in range(30):
        off, by = residuals(place)
        size = np.linalg.norm(off, axis=1) / sigma
        weight = 1 / sigma**2 * np.minimum(1, 3 / np.maximum(size, 1e-9))
        normal = np.einsum("nki,n,nkj->ij", by, weight, by)
        step = np.linalg.solve(normal, np.einsum("nki,n,nk->i", by, weight, off))
        move_by, spin = step[4:], step[1:4]
        angle = np.linalg.norm(spin)
        k = np.array([[0, -spin[2], spin[1]], [spin[2], 0, -spin[0]], [-spin[1], spin[0], 0]]) / max(angle, 1e-300)
        rotation = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
        place = np.column_stack([math.exp(step[0]) * rotation @ place[:, :3], place[:, 3] + move_by])
        if np.abs(step[:4]).max() < 1e-10:
            break
    off, by = residuals(place)
    rms = float(np.sqrt(np.mean(off**2)))
    if not math.isfinite(rms) or rms > WORST_PX:
        return f"what was found does not fit it ({rms:.1f} px rms): another target, or another profile?"
    factor = max(1.0, float(np.mean((off / sigma[:, None]) ** 2)))
    known = np.linalg.inv(np.einsum("nki,n,nkj->ij", by, 1 / sigma**2, by))
    units = float(np.cbrt(np.linalg.det(place[:, :3])))  # of the structure, a metre
    return -math.log(units), math.sqrt(factor * known[0, 0]), rms


def target_estimate(
    structure: Reconstruction,
    segment: int,
    seen: list[Seen],
    camera: Camera,
    target: Target,
    local: Callable[[np.ndarray], float],
) -> Estimate | str:
    """The scale by the target where it was seen from one stretch, or why not. local: the relative sigma of lengths
    there against those of the whole stretch, by a camera centre (3,)."""
    here = [s for s in seen if structure.segment[s.frame] == segment]
    found = fit_target(here, structure, camera, target.points())
    if isinstance(found, str):
        return found
    log, sigma, rms = found
    middle = structure.centres[[s.frame for s in here]].mean(axis=0)
    detail = f"a {target.kind} of {1000 * target.spacing_m:g} mm spacing in {len(here)} keyframes, {rms:.2f} px rms"
    return Estimate("target", log, math.hypot(sigma, local(middle)), PRINT_SIGMA, detail, segment)
