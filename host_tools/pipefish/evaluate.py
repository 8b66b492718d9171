"""How well tracks hold on to the wall, where a simulator knows the truth.

Each track is anchored at the keyframe that saw it first: that observation is cast onto the true wall with the true lens
and pose. The wall point is then projected into every later keyframe that saw the track; the error is the distance
between that projection and the observation. So an error is what the tracker drifted since the anchor.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from pipefish.survey import Survey

WINDOW_REACH = 16  # pixels: a point nearer to the rim than this cannot be tracked by the default window
AGE_EDGES = [1, 6, 11, 21, 41, 81, 161, 1 << 40]  # camera frames since the anchor


class Truth(Protocol):
    """What evaluation wants of a simulated scene (pipefish.simulate.Scene)."""

    def cast(self, frame: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,2) pixels of camera frame `frame` -> (N,3) metres in the world on the wall, (N,) ok."""

    def project(self, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,3) metres in the world -> (N,2) pixels in camera frame `frame`, (N,) ok."""


def anchor_points(survey: Survey, truth: Truth) -> np.ndarray:
    """The true wall point of each track, from its first observation: (K, 3) metres, NaN where the truth has none."""
    tracks = survey.tracks()
    sequence = {k.index: k.message.frame_sequence for k in survey.keyframes}
    anchor = tracks.bounds[:-1]
    points = np.full((len(anchor), 3), np.nan)
    anchor_frame = tracks.frame[anchor]
    for index in np.unique(anchor_frame):
        here = np.flatnonzero(anchor_frame == index)
        xyz, ok = truth.cast(sequence[int(index)], tracks.pixels[anchor[here]])
        points[here[ok]] = xyz[ok]
    return points


def survival(survey: Survey, truth: Truth) -> float | None:
    """Of the tracks seen in a keyframe whose wall point can still be tracked in the next one, the share seen there.

    It can be tracked if it lies WINDOW_REACH pixels inside the field. A tracker that drops whatever is hard has few
    errors, and a low share here. None if there is no such track."""
    tracks = survey.tracks()
    points = anchor_points(survey, truth)
    kept = possible = 0
    for first, second in pairwise(survey.keyframes):
        if first.boot != second.boot:
            continue
        here = tracks.track[tracks.frame == first.index]
        here = here[np.isfinite(points[here, 0])]
        frame = second.message.frame_sequence
        pixels, visible = truth.project(frame, points[here])
        for offset in ((WINDOW_REACH, 0), (-WINDOW_REACH, 0), (0, WINDOW_REACH), (0, -WINDOW_REACH)):
            visible &= truth.cast(frame, np.nan_to_num(pixels, nan=-1e9) + offset)[1]
        possible += int(visible.sum())
        kept += int(np.isin(here[visible], tracks.track[tracks.frame == second.index]).sum())
    return kept / possible if possible else None


def track_errors(survey: Survey, truth: Truth) -> dict[str, np.ndarray]:
    """Errors of all observations after each track's anchor.

    Returns error (M,) pixels, age (M,) camera frames since the anchor, frame (M,) keyframe index, track (M,).
    Observations that the truth cannot judge (anchor misses the wall) are left out.
    """
    tracks = survey.tracks()
    sequence = {k.index: k.message.frame_sequence for k in survey.keyframes}
    anchor = tracks.bounds[:-1]
    points = anchor_points(survey, truth)
    later = np.ones(len(tracks.track), dtype=bool)
    later[anchor] = False
    error = np.full(len(tracks.track), np.nan)
    for index in np.unique(tracks.frame[later]):
        here = np.flatnonzero(later & (tracks.frame == index) & np.isfinite(points[tracks.track, 0]))
        if len(here):
            pixels, ok = truth.project(sequence[int(index)], points[tracks.track[here]])
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


def evaluate(survey: Survey, truth: Truth) -> dict[str, Any] | None:
    """Figures of `track_errors` as plain values; None if no track was seen twice.

    within_1px: share of observations; median_px, p95_px, p99_px, max_px; survival: see there; by_age: list of age_low,
    age_high, count, within_1px and median_px.
    """
    result = track_errors(survey, truth)
    error, age = result["error"], result["age"]
    if not len(error):
        return None
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
        "survival": survival(survey, truth),
        "by_age": by_age,
    }
