"""The tracker against OpenCV, one thread, in this process and in alternation; run by run.py with each OpenCV there is.

Prints one JSON object a figure. 1280x800 pictures of the benchmark's texture, noise of 2 grey levels; processor time of
the thread, least of many alternating repetitions. Window 21, 4 levels, on both sides. What is not equal is said at each
figure. OpenCV's Python door to the KLT takes pictures, not pyramids; it builds two pyramids a call, derivatives of
the first: the time of a call with one point is taken off, so that its figure is that of one who keeps his pyramids.
(buildOpticalFlowPyramid with derivatives takes longer than that whole call: it hands them to Python.)
Not equal: OpenCV makes up to 30 steps a level and stops at 0.01 px (its defaults), ours up to 10 and stops at 0.02 px
(0.04 px for the template); the mask of OpenCV's refill is drawn outside the time measured.
"""

import json
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from track_library import TRACKED, Entry

WIDTH, HEIGHT, TRACKS, DISTANCE = 1280, 800, 300, 10
SIDE = 21
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)  # OpenCV's own default


def least(repeat: int, **calls: Callable[[], Any]) -> dict[str, float]:
    """Milliseconds of each call, the least of `repeat` rounds in which all take turns."""
    best = dict.fromkeys(calls, float("inf"))
    for _ in range(repeat):
        for name, call in calls.items():
            start = time.thread_time_ns()
            call()
            best[name] = min(best[name], (time.thread_time_ns() - start) * 1e-6)
    return best


def corners(image: np.ndarray, count: int, mask: np.ndarray | None = None) -> np.ndarray:
    """OpenCV's corners: (N, 1, 2)."""
    return cv2.goodFeaturesToTrack(image, count, 0.01, DISTANCE, mask=mask, blockSize=3)


def flow(one: np.ndarray, two: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's KLT."""
    to, ok, _ = cv2.calcOpticalFlowPyrLK(one, two, points, None, winSize=(SIDE, SIDE), maxLevel=3, criteria=CRITERIA)
    return to, ok.ravel().astype(bool)


def chain_frame(one: np.ndarray, two: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, int]:
    """OpenCV's usual tracker: there, back, keep what returns within half a pixel, refill away from what is kept.

    With the nanoseconds that drawing the mask took, in Python's loop: not OpenCV's."""
    to, ok = flow(one, two, points)
    back, returned = flow(two, one, to)
    keep = ok & returned & (np.linalg.norm((back - points)[:, 0], axis=1) < 0.5)
    start = time.thread_time_ns()
    mask = np.full(one.shape, 255, np.uint8)
    for x, y in to[keep, 0]:
        cv2.circle(mask, (round(float(x)), round(float(y))), DISTANCE, 0, -1)
    drawing = time.thread_time_ns() - start
    fresh = corners(two, max(1, TRACKS - int(keep.sum())), mask)
    return (to[keep] if fresh is None else np.concatenate([to[keep], fresh])), drawing


def test_textures() -> dict[str, np.ndarray]:
    """Pictures that a detector finds easy and hard: nothing, a corner everywhere, edges only, corners alike."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    pictures = {
        "flat": np.full((HEIGHT, WIDTH), 128),
        "noise": np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH)),
        "stripes": np.where(x // 8 % 2, 200, 60),
        "checker": np.where((x // 16 + y // 16) % 2, 200, 60),
    }
    return {name: np.ascontiguousarray(picture, np.uint8) for name, picture in pictures.items()}


def detection(ours: Entry, picture: np.ndarray) -> tuple[float, float]:
    """Milliseconds of ours, without the pyramid, and of OpenCV's."""

    def detect() -> int:
        ours.reset()
        return ours.frame(picture)

    t = least(
        10,
        pyramid=lambda: ours.pyramid(1, picture),
        detect=detect,
        detect_cv=lambda: corners(picture, TRACKS),
    )
    return t["detect"] - t["pyramid"], t["detect_cv"]


def main() -> None:
    """Measures and prints."""
    peer = sys.argv[1]
    cv2.setNumThreads(1)
    zoom = 1.015
    ours = Entry(WIDTH, HEIGHT, TRACKS, 2 * DISTANCE)
    frames = [ours.scene(zoom**k, k) for k in range(6)]
    one, two = frames[0], frames[1]
    points = corners(one, TRACKS)
    inside = np.all((points[:, 0] > 40) & (points[:, 0] < [WIDTH - 40, HEIGHT - 40]), axis=1)
    points = points[inside]

    def pyramid() -> Any:
        return cv2.buildOpticalFlowPyramid(two, (SIDE, SIDE), 3, withDerivatives=False)

    def detect() -> int:
        ours.reset()
        return ours.frame(one)

    ours.pyramid(0, one)
    ours.pyramid(1, two)
    t = least(
        40,
        pyramid=lambda: ours.pyramid(1, two),
        pyramid_cv=pyramid,
        klt_cv_pyramids=lambda: flow(one, two, points[:1]),
        plain=lambda: ours.klt(points[:, 0], False),
        light=lambda: ours.klt(points[:, 0], True),
        klt_cv=lambda: flow(one, two, points),
    )
    t |= least(15, detect=detect, detect_cv=lambda: corners(one, TRACKS))
    textures = {name: detection(ours, picture) for name, picture in test_textures().items()}
    klt_cv = t["klt_cv"] - t["klt_cv_pyramids"]

    # whole frames: both sides along the same drive, frame by frame in turns; the least time of each frame, their mean
    rounds, own, chain, tracked = 8, [], [], 0
    for _ in range(rounds):
        ours.reset()
        ours.frame(one)
        there = corners(one, TRACKS)
        times: list[tuple[float, float]] = []
        for before, now in pairwise(frames):
            a = time.thread_time_ns()
            ours.frame(now)
            b = time.thread_time_ns()
            there, drawing = chain_frame(before, now, there)
            times.append(((b - a) * 1e-6, (time.thread_time_ns() - b - drawing) * 1e-6))
            tracked = int((ours.tracks()[3] == TRACKED).sum())
        own.append([x for x, _ in times])
        chain.append([y for _, y in times])
    frame = float(np.min(own, axis=0).mean())
    # built twice: two pyramids and derivatives of one; needed once: a pyramid and its derivatives
    frame_cv = float(np.min(chain, axis=0).mean()) - t["klt_cv_pyramids"] - t["pyramid_cv"]

    features = [f for f in ("AVX512_SKX", "AVX2", "SSE4_2") if f in cv2.getBuildInformation()]
    built = {"peer_version": f"OpenCV {cv2.__version__}", "peer_isa": features[0] if features else "baseline"}

    def say(name: str, value: float, peer_value: float) -> None:
        figure = {"name": name, "value": value, "unit": "ms", "peer": peer, "peer_value": peer_value, **built}
        print(json.dumps(figure))

    say("track.pyramid", t["pyramid"], t["pyramid_cv"])
    say("track.detect", t["detect"] - t["pyramid"], t["detect_cv"])  # ours with the templates of its corners taken
    for name, (value, peer_value) in textures.items():
        say(f"track.detect_{name}", value, peer_value)
    say("track.klt_plain", t["plain"], klt_cv)  # ours estimates gain and bias even so
    say("track.klt_light", t["light"], klt_cv)  # ours takes each template and fits gain, bias, slopes and affine
    say("track.frame", frame, frame_cv)
    print(
        f"{peer}: OpenCV {cv2.__version__}, dispatches up to {built['peer_isa']}; "
        f"{len(points)} points, {tracked} tracked by ours in the last frame",
        file=sys.stderr,
    )


if __name__ == "__main__":
    main()
