"""What happened between two stretches: a lens that zoomed, or tracks that got other names while the wall stayed.

Both are told from the points before the gap and the first frame behind it, whose pose (and zoom) is fitted to them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .camera import Camera

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

LEAST = 12  # points of the stretch before that a frame must show
ZOOMS = 1.03 ** np.arange(-24, 25)  # that are tried: half to twice
ZOOM_LEAST, ZOOM_SIGMAS = 0.01, 6.0  # both must be exceeded
AGREED_SIGMAS = 3.0  # enough where frames' own zooms say the same
ZOOM_SHARE = 0.6  # of the points that must agree with a zoom
ONE, ONE_SIGMAS = 0.015, 5.0  # of one frame against the median of those before it, to be doubted
END, END_SIGMAS = 3, 2.5  # of the last frames before a gap
CHUNK, LEAD = 200, 30  # frames that are looked at together, and before them for their tracks' earlier views
RUN, RUN_LEAST, RUN_SIGMAS = 5, 0.01, 6.0  # of the mean of so many
TRIES = 24  # whole reconstructions that doubts may cost: stretches that break off everywhere have other reasons


def in_unit_of(camera: Camera, segment: dict[str, Any]) -> Camera:
    """The camera with its pupil's shift in the unit of one of the engine's stretches."""
    return dataclasses.replace(camera, pupil_e1=segment["pupil"])


@dataclass
class Fitted:
    """Pose (3,4) and zoom of a frame, its sigma, and the residuals (n,) in pixels, infinite behind the camera."""

    pose: Floats
    zoom: float
    zoom_sigma: float
    off: Floats


def _cross(x: Floats) -> Floats:
    """(n,3,3) with _cross(x) y = x cross y."""
    out = np.zeros((len(x), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -x[:, 2], x[:, 1], -x[:, 0]
    return out - out.transpose(0, 2, 1)


def _seen(camera: Camera, points: Floats, pose: Floats, zoom: float) -> tuple[Floats, npt.NDArray[np.bool_], Floats]:
    """Pixels (n,2) of points, which can be seen, and their derivatives (n,2,3) by the points in the camera's frame."""
    uv, ok, slope = camera.project_jacobian(points @ pose[:, :3].T + pose[:, 3])[:3]
    middle = np.array([camera.c_u, camera.c_v])
    return middle + zoom * (uv - middle), ok, zoom * slope


def fit_frame(
    camera: Camera, points: Floats, pixels: Floats, pose: Floats, zoom: float | None, scales: tuple[float, ...]
) -> Fitted:
    """The pose of a frame that shows points (n,3) at pixels (n,2), from a start; zoom None: held at 1. Least squares
    with Cauchy's weights of these scales, px, one after the other."""
    free, z, sigma = zoom is not None, zoom or 1.0, np.inf
    pose = pose.copy()
    for scale in np.repeat(scales, 6):
        uv, ok, slope = _seen(camera, points, pose, z)
        off = pixels - uv
        weight = np.where(ok, 1.0 / (1.0 + (off**2).sum(1) / scale**2), 0.0)
        turned = points @ pose[:, :3].T
        by = np.concatenate([-slope @ _cross(turned), slope], axis=2)
        if free:
            by = np.concatenate([by, (uv - [camera.c_u, camera.c_v])[:, :, None]], axis=2)
        by, off = np.where(ok[:, None, None], by, 0.0), np.where(ok[:, None], off, 0.0)
        normal = np.einsum("nik,n,nil->kl", by, weight, by)
        scaling = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(scaling[:, None] * normal * scaling, hermitian=True)
        step = scaling * (inverse @ (scaling * np.einsum("nik,n,ni->k", by, weight, off)))
        angle = np.linalg.norm(step[:3])
        if angle > 0.3:
            step *= 0.3 / angle
        k = _cross(step[None, :3])[0]
        angle = max(float(np.linalg.norm(step[:3])), 1e-12)
        turn = np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * k @ k
        pose = np.column_stack([turn @ pose[:, :3], pose[:, 3] + step[3:6]])
        if free:
            z = float(z * np.exp(np.clip(step[6], -0.1, 0.1)))
            squares = float((weight * (off**2).sum(1)).sum()) / max(1.0, 2 * weight.sum() - 7)
            sigma = float(np.sqrt(inverse[6, 6] * squares)) * scaling[6]
    uv, ok, _ = _seen(camera, points, pose, z)
    return Fitted(pose, z, sigma, np.where(ok, np.linalg.norm(pixels - uv, axis=1), np.inf))


def ahead_of(segment: dict[str, Any], steps: float) -> Floats:
    """Pose (3,4) so many steps after a stretch's last, each as the last one was."""
    before, last = segment["poses"][-2], segment["poses"][-1]
    turn = last[:, :3] @ before[:, :3].T
    # Rotation vector of a small turn, and centres: both go on evenly.
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    u, _, v = np.linalg.svd(np.eye(3) + steps * _cross(axis[None])[0])
    centre = [-pose[:, :3].T @ pose[:, 3] for pose in (before, last)]
    place, r = centre[1] + steps * (centre[1] - centre[0]), u @ v @ last[:, :3]
    return np.column_stack([r, -r @ place])


def zoom_between(
    camera: Camera, segment: dict[str, Any], place: int, track: Ints, pixels: Floats, sigma: float
) -> tuple[float, float] | None:
    """log of how much larger a picture is than the stretch before it says it should be, and its sigma; None where
    nobody knows.

    place: the picture's number among the frames used; track (n,), pixels (n,2): what it shows; sigma: of pixels."""
    camera = in_unit_of(camera, segment)
    _, here, there = np.intersect1d(track, segment["tracks"], return_indices=True)  # a track may be there twice
    if len(here) < LEAST:
        return None
    points, pixels = segment["points"][there], pixels[here]
    start = ahead_of(segment, place - segment["first"] - len(segment["poses"]) + 1)
    middle = np.array([camera.c_u, camera.c_v])
    flat, ok, _ = _seen(camera, points, start, 1.0)
    off = np.linalg.norm(middle + ZOOMS[:, None, None] * (flat - middle) - pixels, axis=2)
    near = np.argsort(np.median(np.where(ok, off, np.inf), axis=1))[0]
    found = fit_frame(camera, points, pixels, start, float(ZOOMS[near]), (12.0, 4.0, 4 * sigma, 4 * sigma))
    gate = 5.0 * max(sigma, 0.2)  # the points have errors of their own
    if (found.off < gate).mean() < ZOOM_SHARE:
        return None
    return float(np.log(found.zoom)), found.zoom_sigma


def frame_zooms(
    camera: Camera, segment: dict[str, Any], place: Ints, track: Ints, pixels: Floats, sigma: float
) -> tuple[Floats, Floats]:
    """log of the zoom of each frame of a stretch against those before it, and its sigma, (frames,); infinite sigma
    where too little is seen. Of each observation: where its track's point is by the views before it alone, and how well
    that is known; of each frame: pose and zoom that fit those best, to first order.

    place (n,) of each observation's frame in the stretch, track (n,), pixels (n,2), sorted by track and frame."""
    camera, count = in_unit_of(camera, segment), len(segment["poses"])
    rows = np.minimum(np.searchsorted(segment["tracks"], track), len(segment["tracks"]) - 1)
    on = np.flatnonzero((segment["tracks"][rows] == track) & (place >= 0) & (place < count))
    place, track, pixels, points = place[on], track[on], pixels[on], segment["points"][rows[on]]
    out = [np.zeros(0), np.zeros(0)]
    for low in range(0, count, CHUNK):  # so much at a time that it stays near the processor
        here = np.flatnonzero((place >= low - LEAD) & (place < low + CHUNK))
        found = _zooms(camera, segment["poses"], place[here], track[here], pixels[here], points[here], sigma)
        out = [np.append(known, new[low : low + CHUNK]) for known, new in zip(out, found, strict=True)]
    return out[0], out[1]


def _zooms(
    camera: Camera, poses: Floats, place: Ints, track: Ints, pixels: Floats, points: Floats, sigma: float
) -> tuple[Floats, Floats]:
    """As frame_zooms(), of some observations, whose points (n,3) are about there."""
    count = len(poses)
    if not len(track):
        return np.zeros(count), np.full(count, np.inf)
    rays, ok = camera.unproject(pixels)
    turn = poses[place, :, :3]
    start = np.where(ok[:, None], camera.origins(pixels), 0.0)
    centre = np.einsum("nji,nj->ni", turn, start - poses[place, :, 3])
    ray = np.einsum("nji,nj->ni", turn, rays)
    depth = np.maximum(np.linalg.norm(points - centre, axis=1), 1e-9)
    across = (np.eye(3) - ray[:, :, None] * ray[:, None]) * (camera.f_u / (sigma * depth))[:, None, None] ** 2
    across[~ok] = 0.0
    push = np.einsum("nij,nj->ni", across, centre)
    # Sums over the views before, within each track.
    begin = np.append(True, track[1:] != track[:-1])
    first = np.maximum.accumulate(np.where(begin, np.arange(len(track)), 0))

    def before(values: Floats) -> Floats:
        total = np.cumsum(values, axis=0) - values
        return total - total[first]

    information, push = before(across), before(push)
    often = (before(ok.astype(float)) >= 2) & ok
    information[~often] = np.eye(3)
    # Views from one place leave the depth open, which the gate below tells; here the matrix must have an inverse.
    information += 1e-12 * np.einsum("nii->n", information)[:, None, None] * np.eye(3)
    spread = np.linalg.inv(information)
    predicted = np.einsum("nij,nj->ni", spread, push)
    seen = np.einsum("nij,nj->ni", turn, predicted) + poses[place, :, 3]
    uv, valid, slope = camera.project_jacobian(seen)[:3]
    by_point = slope @ turn
    noise = sigma**2 * np.eye(2) + by_point @ spread @ by_point.transpose(0, 2, 1)
    off = pixels - uv
    weight = np.linalg.inv(noise)
    far = np.einsum("ni,nij,nj->n", off, weight, off)
    weight /= (1.0 + np.where(np.isfinite(far), far, 1e12) / 9.0)[:, None, None]
    good = often & valid & np.isfinite(far) & (np.einsum("nii->n", noise) < (3.0 * 10.0) ** 2)
    by = np.concatenate(
        [-slope @ _cross(seen - poses[place, :, 3]), slope, (uv - [camera.c_u, camera.c_v])[:, :, None]], axis=2
    )
    normal, gradient = np.zeros((count, 7, 7)), np.zeros((count, 7))
    weighed = by[good].transpose(0, 2, 1) @ weight[good]
    np.add.at(normal, place[good], weighed @ by[good])
    np.add.at(gradient, place[good], np.einsum("nki,ni->nk", weighed, off[good]))
    zoom, spread_of = np.zeros(count), np.full(count, np.inf)
    for k in np.flatnonzero(np.bincount(place[good], minlength=count) >= LEAST):
        scaling = 1.0 / np.sqrt(np.diag(normal[k]))
        inverse = np.linalg.pinv(scaling[:, None] * normal[k] * scaling, hermitian=True, rcond=1e-12)
        zoom[k] = scaling[6] * (inverse[6] @ (scaling * gradient[k]))
        spread_of[k] = scaling[6] * np.sqrt(inverse[6, 6])
    return zoom, spread_of


def doubted(zoom: Floats, sigma: Floats, gap: bool) -> tuple[int, float] | None:
    """The first frame of a stretch that looks zoomed against those before it, of what frame_zooms() says; and which
    way, above 0 for larger. gap: behind the stretch there is one."""
    known = np.isfinite(sigma)
    for k in range(4, len(zoom)):
        if not known[k] or not known[:k].any():
            continue
        off = zoom[k:] - np.median(zoom[:k][known[:k]])
        sigmas = END_SIGMAS if gap and k >= len(zoom) - END else ONE_SIGMAS
        if abs(off[0]) > max(ONE, sigmas * sigma[k]):
            return k, float(off[0])
        run = np.flatnonzero(known[k : k + RUN])
        mean, of_mean = float(off[run].mean()), float(np.sqrt((sigma[k + run] ** 2).sum())) / len(run)
        if len(run) >= 3 and abs(mean) > max(RUN_LEAST, RUN_SIGMAS * of_mean):
            return k, mean
    return None


class Zooms:
    """Looks for the keyframe at which the lens zoomed. camera, sigma: of pixels; frame, track (n,), pixels (n,2): all
    that was seen."""

    def __init__(self, camera: Camera, frame: Ints, track: Ints, pixels: Floats, sigma: float) -> None:
        self.camera, self.sigma = camera, sigma
        order = np.lexsort((frame, track))
        self.frame, self.track, self.pixels = frame[order], track[order], pixels[order]

    def _confirmed(self, used: Ints, segment: dict[str, Any], at: int, way: float | None) -> bool:
        """Whether one of some frames from number `at` of `used` on shows the stretch before it zoomed; way: which way
        frames' own zooms say."""
        for place in range(at, min(at + RUN, len(used))):
            on = self.frame == used[place]
            found = zoom_between(self.camera, segment, place, self.track[on], self.pixels[on], self.sigma)
            if found is None or abs(found[0]) < ZOOM_LEAST:
                continue
            sigmas = ZOOM_SIGMAS if way is None or way * found[0] < 0 else AGREED_SIGMAS
            if abs(found[0]) > sigmas * found[1]:
                return True
        return False

    def first(self, found: dict[str, Any], again: Callable[[int], dict[str, Any]]) -> tuple[int, dict[str, Any]] | None:
        """The first frame that is zoomed, and what was found before it; None where there is none. found: of the engine;
        again(frame): the same, of what was seen before that frame."""
        used = found["frames"].astype(np.int64)
        if not len(used):
            return None
        place = np.searchsorted(used, self.frame)
        place = np.where(used[np.minimum(place, len(used) - 1)] == self.frame, place, -1)
        left = TRIES
        for segment in found["segments"]:
            begin, end = segment["first"], segment["first"] + len(segment["poses"])
            of_frames = frame_zooms(self.camera, segment, place - begin, self.track, self.pixels, self.sigma)
            doubt = doubted(*of_frames, end < len(used))
            if doubt is None and (end >= len(used) or not self._confirmed(used, segment, end, None)):
                continue
            # A zoomed frame that the stretch took up makes those before it look zoomed, too: the first doubt is early.
            tries = [(begin + k, doubt[1]) for k in range(doubt[0], len(of_frames[0]))[:RUN]] if doubt else []
            if end < len(used) and (doubt is None or self._confirmed(used, segment, end, None)):
                tries.append((end, None))
            for at, way in tries[:left]:
                left -= 1
                before = again(int(used[at]))
                last = before["segments"][-1] if before["segments"] else None
                reached = last is not None and last["first"] + len(last["poses"]) > at - 3
                if last is not None and reached and self._confirmed(used, last, at, way):
                    return int(used[at]), before
        return None
