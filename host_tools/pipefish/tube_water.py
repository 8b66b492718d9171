"""Still water mirrors the wall as rigidly as the wall stands: points that lie under the invert, and are none of it.

What makes them water and no hole: mirrored once more at one level they lie on the wall above it, and below that level
no wall is seen."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pipefish.tube import Tube

LEAST = 6  # mirrored points of a window
SHARE = 0.5  # of the points under the surface that one level must explain
TOLERANCE = 0.02  # of the diameter, of a level
BARE = 0.1  # of the wall's points that would be below the level if it were dry: more, and it is


def mirrored(tube: Tube, gravity: bool) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """(N,) bool: points of the tube seen in water or through it; and the stretches of water: s from `start` to `end`,
    `depth` over the invert (its median), how many points. gravity: twelve o'clock is up; else water lies where the wall
    is bare. Windows of a diameter."""
    p, d = tube.points, tube.summary["d_mean"]
    mask, stretches = np.zeros(len(p["s"]), bool), []
    wall = np.flatnonzero((p["piece"] >= 0) & (p["weight"] > 0))
    off = np.flatnonzero(
        (p["piece"] >= 0) & (p["weight"] <= 0) & (p["distance"] > np.maximum(4 * p["sigma"], 0.01 * d))
    )
    if not len(off):
        return mask, []
    down = math.pi if gravity else _bare(p["clock"][wall])
    for middle in np.arange(0.25 * d, tube.length, 0.5 * d):
        on, out = (rows[np.abs(p["s"][rows] - middle) < 0.5 * d] for rows in (wall, off))
        if len(out) < LEAST or len(on) < 5 * LEAST:
            continue
        level, below = _level(p, on, out, down, d)
        if level is None:
            continue
        mask[out[below]] = True
        piece = {"start": middle - 0.5 * d, "end": middle + 0.5 * d, "level": [level]}
        if stretches and piece["start"] <= stretches[-1]["end"] + 0.5 * d:
            stretches[-1]["end"] = piece["end"]
            stretches[-1]["level"] += piece["level"]
        else:
            stretches.append(piece)
    for piece in stretches:
        piece["start"], piece["end"] = max(0.0, float(piece["start"])), min(tube.length, float(piece["end"]))
        piece["depth"] = 0.5 * d - float(np.median(piece.pop("level")))
        piece["points"] = int((mask & (p["s"] >= piece["start"]) & (p["s"] <= piece["end"])).sum())
    return mask, stretches


def _bare(clock: np.ndarray) -> float:
    """The middle of the widest sector without points."""
    ordered = np.sort(clock)
    width = np.diff(np.append(ordered, ordered[0] + 2 * math.pi))
    k = int(width.argmax())
    return float(ordered[k] + width[k] / 2)


def _level(
    p: dict[str, np.ndarray], on: np.ndarray, out: np.ndarray, down: float, d: float
) -> tuple[float | None, np.ndarray]:
    """How far below the axis the surface is, None without one, and which of `out` are under it."""
    radius, tolerance = 0.5 * d, TOLERANCE * d
    turn = p["clock"][out] - down
    away = radius + p["distance"][out]
    x, y = away * np.sin(turn), away * np.cos(turn)
    half = np.sqrt(np.maximum(0.0, radius**2 - x**2))
    # Of each point the two levels at which its mirror image lies on the wall.
    votes = np.stack([0.5 * (y + half), 0.5 * (y - half)])
    votes[:, np.abs(x) >= radius] = np.nan
    votes[(votes > y - tolerance) | (np.abs(votes) > 0.97 * radius)] = np.nan
    ordered = np.sort(votes[np.isfinite(votes)])
    none = np.zeros(len(out), bool)
    if len(ordered) < LEAST:
        return None, none
    reach = np.searchsorted(ordered, ordered + 2 * tolerance, side="right") - np.arange(len(ordered))
    k = int(reach.argmax())
    level = float(np.median(ordered[k : k + reach[k]]))
    agree = (np.abs(votes - level) < tolerance).any(0)
    below = y > level + tolerance
    angle = math.acos(min(1.0, max(-1.0, (level + tolerance) / radius)))
    dry = len(on) * angle / (math.pi - angle)
    seen = (radius * np.cos(p["clock"][on] - down) > level + tolerance).sum()
    if agree.sum() < max(LEAST, SHARE * below.sum()) or dry < LEAST or seen > BARE * dry:
        return None, none
    return level, below
