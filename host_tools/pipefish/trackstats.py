"""What became of the tracks along a survey: the device's own counters and states, keyframe by keyframe, as charts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pipefish.files import rounded
from pipefish.scene import REASONS, STATES, frames_in
from pipefish.survey import Survey

MOST_REASONS = 5  # layers of a chart of reasons
Line = Callable[..., dict[str, Any]]  # a name, values and more: a line of a chart


def statistics(survey: Survey) -> dict[str, np.ndarray]:
    """Per keyframe (N,): live tracks; mean a frame since the keyframe before of tracked, detected and each lost_*
    (NaN where the device counts nothing); age_median in camera frames, quality_median 0..1 (NaN without tracks); each
    state as frames in it since the keyframe before."""
    parts = [k.message.tracking for k in survey.keyframes]
    frames = np.array([p.frames or np.nan for p in parts], dtype=float)
    found = np.array([p.tracked > 0 for p in parts], dtype=bool)
    result: dict[str, np.ndarray] = {"live": np.array([len(k.observations.id) for k in survey.keyframes])}
    for name in ("tracked", "detected", *(name for name, _ in REASONS)):
        result[name] = np.array([getattr(p, name) for p in parts], dtype=float) / frames
    result["age_median"] = np.where(found, np.array([p.age_median for p in parts], dtype=float), np.nan)
    result["quality_median"] = np.where(found, np.array([p.quality_median for p in parts]) / 32768.0, np.nan)
    counted = [frames_in(p) for p in parts]
    for name, _ in STATES:
        result[name] = np.array([c[name] for c in counted], dtype=np.uint64)
    return result


def charts(survey: Survey, along: np.ndarray, title: str) -> list[dict[str, Any]]:
    """Charts over `along` (N,), whose axis is called `title`; [] if the device counted nothing. See pipefish.page."""
    stats = statistics(survey)
    if not np.isfinite(stats["tracked"]).any():
        return []
    x, xaxis = rounded(along), {"title": {"text": title}}

    def line(name: str, y: np.ndarray, **more: Any) -> dict[str, Any]:
        return {"type": "scatter", "mode": "lines", "name": name, "x": x, "y": rounded(y, 3), **more}

    return [_live(stats, line, xaxis), _lost(stats, line, xaxis), _age(stats, line, xaxis), *_states(stats, x, xaxis)]


def _live(stats: dict[str, np.ndarray], line: Line, xaxis: dict[str, Any]) -> dict[str, Any]:
    return {
        "id": "stats-live",
        "title": "Tracks held and taken up",
        "text": "Tracks in each keyframe; found again and newly detected in a camera frame, in the mean since the "
        "keyframe before.",
        "data": [
            line("in the keyframe", stats["live"]),
            line("found again a frame", stats["tracked"]),
            line("new a frame", stats["detected"]),
        ],
        "layout": {"xaxis": xaxis, "yaxis": {"title": {"text": "tracks"}, "rangemode": "tozero"}},
    }


def _lost(stats: dict[str, np.ndarray], line: Line, xaxis: dict[str, Any]) -> dict[str, Any]:
    """The most frequent reasons each, the rest in one layer: a page has so many colours, and a legend so much room."""
    seen = [(name, words) for name, words in REASONS if np.nansum(stats[name]) > 0]
    seen.sort(key=lambda reason: -np.nansum(stats[reason[0]]))
    own, rest = (seen, []) if len(seen) <= MOST_REASONS else (seen[: MOST_REASONS - 1], seen[MOST_REASONS - 1 :])
    layers = [(words, stats[name]) for name, words in own]
    if rest:
        layers.append(("other", np.sum([stats[name] for name, _ in rest], axis=0)))
    other = f" Other: {', '.join(words for _, words in rest)}." if rest else ""
    return {
        "id": "stats-lost",
        "title": "Why tracks end",
        "text": "Tracks lost in a camera frame, by reason, in the mean since the keyframe before." + other,
        "data": [
            line(words, values, stackgroup="lost", hovertemplate="%{y:.2f}", line={"width": 0.5})
            for words, values in layers
        ],
        "layout": {
            "xaxis": xaxis,
            "yaxis": {"title": {"text": "lost a frame"}, "rangemode": "tozero"},
            "hovermode": "x unified",
            "legend": {"font": {"size": 11}},
        },
    }


def _age(stats: dict[str, np.ndarray], line: Line, xaxis: dict[str, Any]) -> dict[str, Any]:
    return {
        "id": "stats-age",
        "title": "Age and quality",
        "text": "Medians over the tracks found again in the keyframe's own frame; quality is the similarity with "
        "the frame before.",
        "data": [
            line("age, camera frames", stats["age_median"]),
            line("quality", stats["quality_median"], yaxis="y2"),
        ],
        "layout": {
            "xaxis": xaxis,
            "yaxis": {"title": {"text": "camera frames"}, "rangemode": "tozero"},
            "yaxis2": {
                "title": {"text": "quality"},
                "overlaying": "y",
                "side": "right",
                "showgrid": False,
                "tickformat": ".3f",
                "tickmode": "auto",  # else its ticks are where the other axis has its own
            },
        },
    }


def _states(stats: dict[str, np.ndarray], x: list[float | None], xaxis: dict[str, Any]) -> list[dict[str, Any]]:
    """None where the device reported no state."""
    seen = [(name, words) for name, words in STATES if stats[name].any()]
    if not seen:
        return []
    marks = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": words,
            "x": [v for v, on in zip(x, stats[name], strict=True) if on],
            "y": [words] * int((stats[name] > 0).sum()),
            "text": [f"{on} frames" for on in stats[name] if on],
            "marker": {"symbol": "square", "size": 9},
        }
        for name, words in seen
    ]
    chart = {
        "id": "stats-states",
        "title": "States of the scene",
        "text": "States that the device reported since the keyframe before, and in how many frames.",
        "data": marks,
        "layout": {"xaxis": xaxis, "yaxis": {"automargin": True}, "showlegend": False},
    }
    return [chart]
