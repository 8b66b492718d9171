"""How well tracks hold on to the wall, where a simulator knows the truth.

Each track is anchored at the keyframe that saw it first: that observation is cast onto the true wall with the true lens
and pose. The wall point is then projected into every later keyframe that saw the track; the error is the distance
between that projection and the observation. So an error is what the tracker drifted since the anchor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pipefish.errors import PipefishError
from pipefish.survey import Survey, Tracks

WINDOW = 21  # pixels, the tracker's default and OpenCV's
WINDOW_REACH = 16  # pixels: a point nearer to the rim than this cannot be tracked by the default window
CLIPPED = 4  # a window of which more than this part is clipped (2 and below, 250 and above) is in the dark or the glare
AGE_EDGES = [1, 6, 11, 21, 41, 81, 161, 1 << 40]  # camera frames since the anchor


class Truth(Protocol):
    """What evaluation wants of a simulated scene (pipefish.simulate.Scene)."""

    def cast(self, frame: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,2) pixels of camera frame `frame` -> (N,3) metres in the world on the wall, (N,) ok."""

    def project(self, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,3) metres in the world -> (N,2) pixels in camera frame `frame`, (N,) ok."""


@dataclass
class Observed:
    """Tracks as some tracker saw them at some camera frames.

    sequence    camera frame of each index in tracks.frame
    pairs       indices that follow one another without a break between
    """

    tracks: Tracks
    sequence: dict[int, int]
    pairs: list[tuple[int, int]]


def observed(survey: Survey) -> Observed:
    """What the device saw at its keyframes."""
    keys = survey.keyframes
    pairs = [(a.index, b.index) for a, b in pairwise(keys) if a.boot == b.boot and not b.after_break]
    return Observed(survey.tracks(), {k.index: k.message.frame_sequence for k in keys}, pairs)


def anchor_points(seen: Observed, truth: Truth) -> np.ndarray:
    """The true wall point of each track, from its first observation: (K, 3) metres, NaN where the truth has none."""
    tracks = seen.tracks
    anchor = tracks.bounds[:-1]
    points = np.full((len(anchor), 3), np.nan)
    anchor_frame = tracks.frame[anchor]
    for index in np.unique(anchor_frame):
        here = np.flatnonzero(anchor_frame == index)
        xyz, ok = truth.cast(seen.sequence[int(index)], tracks.pixels[anchor[here]])
        points[here[ok]] = xyz[ok]
    return points


def lit(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N,) whether at most one in CLIPPED pixels of the window around each of (N,2) is clipped in image (H,W) uint8.
    Behind the glare a point is as invisible as behind a wall. Pixels outside the image are left out; NaN is not lit."""
    half = WINDOW // 2
    ok = np.isfinite(pixels).all(axis=1)
    for n in np.flatnonzero(ok):
        x, y = np.round(pixels[n]).astype(int)
        window = image[max(y - half, 0) : max(y + half + 1, 0), max(x - half, 0) : max(x + half + 1, 0)]
        ok[n] = CLIPPED * np.count_nonzero((window <= 2) | (window >= 250)) <= window.size > 0
    return ok


def trackable(truth: Truth, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,3) metres on the wall -> (N,2) pixels in camera frame `frame`, (N,) whether they lie WINDOW_REACH inside the
    field."""
    pixels, ok = truth.project(frame, points)
    for offset in ((WINDOW_REACH, 0), (-WINDOW_REACH, 0), (0, WINDOW_REACH), (0, -WINDOW_REACH)):
        ok = ok & truth.cast(frame, np.nan_to_num(pixels, nan=-1e9) + offset)[1]
    return pixels, ok


def survival(seen: Observed, truth: Truth, frames: Callable[[int], np.ndarray] | None = None) -> float | None:
    """Of the tracks seen in a keyframe whose wall point can still be tracked in the next one, the share seen there.

    It can be tracked if it lies WINDOW_REACH pixels inside the field and, where `frames` (camera frame -> (H,W) uint8)
    are known, is lit. A tracker that drops whatever is hard has few errors, and a low share here. None if there is no
    such track."""
    tracks = seen.tracks
    points = anchor_points(seen, truth)
    kept = possible = 0
    for first, second in seen.pairs:
        here = tracks.track[tracks.frame == first]
        here = here[np.isfinite(points[here, 0])]
        frame = seen.sequence[second]
        pixels, visible = trackable(truth, frame, points[here])
        if frames is not None:
            visible &= lit(frames(frame), pixels)
        possible += int(visible.sum())
        kept += int(np.isin(here[visible], tracks.track[tracks.frame == second]).sum())
    return kept / possible if possible else None


def lives(seen: Observed, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """How long tracks as they were born could be: (K,) camera frames from a track's beginning to the last keyframe in
    which its wall point can be tracked, (K,) whether that is its whole life: it begins after the first keyframe, and
    the point leaves before the last. Where the truth has no wall at the anchor: the track's own length."""
    tracks = seen.tracks
    anchor = tracks.bounds[:-1]
    points = anchor_points(seen, truth)
    known = np.isfinite(points[:, 0])
    in_sight = known.copy()
    born = np.array([seen.sequence[int(i)] for i in tracks.frame[anchor]]) - tracks.age[anchor]
    frames = np.where(known, tracks.age[anchor], tracks.length_frames)
    keys = sorted(seen.sequence)
    for index in keys[1:]:
        here = np.flatnonzero(in_sight & (tracks.frame[anchor] < index))
        visible = trackable(truth, seen.sequence[index], points[here])[1]
        frames[here[visible]] = seen.sequence[index] - born[here[visible]]
        in_sight[here[~visible]] = False
    return frames, known & ~in_sight & (born > seen.sequence[keys[0]])


def track_errors(seen: Observed, truth: Truth) -> dict[str, np.ndarray]:
    """Errors of all observations after each track's anchor.

    Returns error (M,) pixels, age (M,) camera frames since the anchor, frame (M,) keyframe index, track (M,).
    Observations that the truth cannot judge (anchor misses the wall) are left out.
    """
    tracks = seen.tracks
    anchor = tracks.bounds[:-1]
    points = anchor_points(seen, truth)
    later = np.ones(len(tracks.track), dtype=bool)
    later[anchor] = False
    error = np.full(len(tracks.track), np.nan)
    for index in np.unique(tracks.frame[later]):
        here = np.flatnonzero(later & (tracks.frame == index) & np.isfinite(points[tracks.track, 0]))
        if len(here):
            pixels, ok = truth.project(seen.sequence[int(index)], points[tracks.track[here]])
            distance = np.linalg.norm(pixels - tracks.pixels[here], axis=1)
            error[here] = np.where(ok, distance, np.inf)  # the truth says it cannot be seen: as wrong as can be
    judged = ~np.isnan(error)
    since = tracks.age - tracks.age[anchor][tracks.track]
    return {
        "error": error[judged],
        "age": since[judged],
        "frame": tracks.frame[judged],
        "track": tracks.track[judged],
    }


def percentile(error: np.ndarray, share: float) -> float | None:
    """A percentile of errors in pixels; None if it falls on one that the truth says cannot be seen."""
    value = float(np.percentile(error, share, method="lower"))
    return value if np.isfinite(value) else None


def figures(seen: Observed, truth: Truth, frames: Callable[[int], np.ndarray] | None = None) -> dict[str, Any] | None:
    """Figures of `track_errors` as plain values; None if no track was seen twice. `frames`: of `survival`.

    within_1px: share of observations; median_px, p95_px, p99_px, max_px; survival: see there; length_median: camera
    frames that half of the tracks live; length_mean: that they live on average; length_possible: the median if none
    were lost, and whole: share of whole lives (`lives`);
    by_age: list of age_low, age_high, count, within_1px and median_px.
    """
    result = track_errors(seen, truth)
    error, age = result["error"], result["age"]
    if not len(error):
        return None
    possible, whole = lives(seen, truth)
    by_age = []
    for low, high in pairwise(AGE_EDGES):
        here = error[(age >= low) & (age < high)]
        if len(here):
            by_age.append(
                {
                    "age_low": low,
                    "age_high": int(min(high - 1, age.max())),
                    "count": len(here),
                    "within_1px": float(np.mean(here <= 1.0)),
                    "median_px": percentile(here, 50),
                }
            )
    return {
        "observations": len(error),
        "within_1px": float(np.mean(error <= 1.0)),
        "median_px": percentile(error, 50),
        "p95_px": percentile(error, 95),
        "p99_px": percentile(error, 99),
        "max_px": percentile(error, 100),
        "survival": survival(seen, truth, frames),
        "length_median": float(np.median(seen.tracks.length_frames)),
        "length_mean": float(np.mean(seen.tracks.length_frames)),
        "length_possible": float(np.median(possible)),
        "whole": float(np.mean(whole)),
        "by_age": by_age,
    }


def evaluate(survey: Survey, truth: Truth, frames: Callable[[int], np.ndarray] | None = None) -> dict[str, Any] | None:
    """`figures` of what the device saw; None if no track was seen twice."""
    return figures(observed(survey), truth, frames)


def frames_of(survey: Survey, recording: Path) -> Callable[[int], np.ndarray]:
    """Camera frame -> (H,W) uint8 of the simulated recording (STEM.y4m, grey) of a survey.

    Raises PipefishError (it has fewer frames than the survey, or of another size), OSError."""
    width, height = survey.keyframes[0].width, survey.keyframes[0].height
    with recording.open("rb") as file:
        head = len(file.readline(4096))
    stored = np.memmap(recording, dtype=np.uint8, mode="r")
    size = width * height + len(b"FRAME\n")
    if (len(stored) - head) // size <= max(k.message.frame_sequence for k in survey.keyframes):
        raise PipefishError(f"{recording}: has fewer frames than the survey, or of another size")

    def frame(k: int) -> np.ndarray:
        return np.array(stored[head + k * size : head + (k + 1) * size][-width * height :]).reshape(height, width)

    return frame


# ---- the peer: what one gets from OpenCV with its usual recipe

PEER_LEVELS = 3
PEER_BACK_PX = 0.5  # forward-backward limit


def opencv_tracks(
    frames: Callable[[int], np.ndarray],
    sequence: dict[int, int],
    pairs: list[tuple[int, int]],
    most: int,
    circle: tuple[float, float, float] | None = None,
) -> Observed:
    """Tracks by goodFeaturesToTrack, calcOpticalFlowPyrLK and the forward-backward check, refilled at every frame, seen
    at the keyframes of `sequence` (as in Observed; camera frames in between are tracked as well).

    frames  camera frame -> (H,W) uint8
    most    tracks alive at once
    circle  centre and radius of the image circle, pixels; a window's reach from its rim nothing is detected
    Raises PipefishError if OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError:
        raise PipefishError("the comparison needs OpenCV: pip install opencv-python-headless") from None
    cv2.setNumThreads(1)
    index_of = {frame: index for index, frame in sequence.items()}
    first, last = min(index_of), max(index_of)
    points, ident, age = np.zeros((0, 2), np.float32), np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows: list[np.ndarray] = []
    previous, next_id = frames(first), 0
    inside = np.full(previous.shape, 255, np.uint8)
    if circle is not None:
        y, x = np.mgrid[: previous.shape[0], : previous.shape[1]]
        inside = np.where(np.hypot(x - circle[0], y - circle[1]) < circle[2] - WINDOW_REACH, 255, 0).astype(np.uint8)
    spacing = max(8, round(0.75 * np.sqrt(np.count_nonzero(inside) / most)))
    options = {"winSize": (WINDOW, WINDOW), "maxLevel": PEER_LEVELS}
    for frame in range(first, last + 1):
        image = frames(frame)
        if len(points):
            there, found, _ = cv2.calcOpticalFlowPyrLK(previous, image, points, None, **options)
            back, returned, _ = cv2.calcOpticalFlowPyrLK(image, previous, there, None, **options)
            whole = np.clip(np.round(np.nan_to_num(there)).astype(int), 0, np.array(image.shape[::-1]) - 1)
            keep = (found.ravel() == 1) & (returned.ravel() == 1)
            keep &= np.linalg.norm(back - points, axis=1) < PEER_BACK_PX
            keep &= inside[whole[:, 1], whole[:, 0]] > 0
            points, ident, age = there[keep], ident[keep], age[keep] + 1
        if len(points) < most:
            free = inside.copy()
            for x, y in points:
                cv2.circle(free, (round(float(x)), round(float(y))), spacing, 0, -1)
            new = cv2.goodFeaturesToTrack(image, most - len(points), 0.01, spacing, mask=free, blockSize=11)
            new = np.zeros((0, 2), np.float32) if new is None else new.reshape(-1, 2)
            points = np.concatenate([points, new])
            ident = np.concatenate([ident, next_id + np.arange(len(new))])
            age = np.concatenate([age, np.zeros(len(new), np.int64)])
            next_id += len(new)
        if frame in index_of and len(points):
            index = np.full(len(points), index_of[frame])
            rows.append(np.column_stack([ident, index, points.astype(float), age]))
        previous = image
    return Observed(_tracks_of(np.concatenate(rows)), sequence, pairs)


def _tracks_of(rows: np.ndarray) -> Tracks:
    """(N,5) id, keyframe index, u, v, age -> Tracks without covariance and quality."""
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    ids, track = np.unique(rows[:, 0].astype(np.int64), return_inverse=True)
    return Tracks(
        frame=rows[:, 1].astype(np.int64),
        track=track,
        pixels=rows[:, 2:4],
        covariance=np.zeros((len(rows), 2, 2)),
        age=rows[:, 4].astype(np.int64),
        quality=np.zeros(len(rows)),
        boot=np.zeros(len(ids), np.uint64),
        id=ids,
    )


def compare_with_opencv(survey: Survey, truth: Any, frames: Callable[[int], np.ndarray]) -> dict[str, Any] | None:
    """`figures` of OpenCV's recipe on the frames of a simulated recording (`frames_of`) at the survey's keyframes.

    truth: a pipefish.simulate.Scene. Raises PipefishError if OpenCV is missing."""
    seen = observed(survey)
    lens = truth.spec["lens"]
    most = int(np.median([len(k.observations.id) for k in survey.keyframes]))
    circle = (lens["c_u"], lens["c_v"], lens["circle_radius"])
    return figures(opencv_tracks(frames, seen.sequence, seen.pairs, most, circle), truth, frames)


# Bounds of an accepted tracker in a simulated pipe: (figure, least or most, bound). On PVC 0.96 within 1 px.
BARS = [("within_1px", min, 0.97), ("survival", min, 0.90), ("median_px", max, 0.20)]
LENGTH_RATIO = 1.5  # median length against the peer's


def verdict(ours: dict[str, Any], peer: dict[str, Any] | None, smooth: bool = False) -> dict[str, Any]:
    """Whether the bars hold: {figure: {value, bound, holds}}, with length_median if there is a peer."""
    rows: dict[str, Any] = {}
    for name, side, bound in BARS:
        bound = 0.96 if smooth and name == "within_1px" else bound
        value = ours[name]
        holds = value is not None and side(value, bound) == bound
        rows[name] = {"value": value, "bound": bound, "holds": bool(holds)}
    if peer is not None:
        bound = LENGTH_RATIO * peer["length_median"]
        rows["length_median"] = {
            "value": ours["length_median"],
            "bound": bound,
            "holds": ours["length_median"] >= bound,
        }
    return rows
