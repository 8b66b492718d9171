"""Still water mirrors the wall as rigidly as the wall stands: points that are none of it.

Two signs. Little water: the images lie outside the wall, mirrored once more at one level they come onto it, and below
that level no wall is seen. Much water: the images of the upper half lie where the lower half would be, or inside. Then
points have twins: pairs at one chainage, one straight under the other, whose middles lie at one level. By chance a
round wall has such pairs too, but as many about any other direction as about gravity's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pipefish.tube import Tube

LEAST = 6  # mirrored points of a window
SHARE = 0.5  # of the points under the surface that one level must explain
TOLERANCE = 0.02  # of the diameter, of a level
BARE = 0.1  # of the wall's points that would be below the level if it were dry: more, and it is
TWIN = 0.01  # of the diameter: how far from each other's images twins may be
TWIN_REACH = 1.5  # diameters each way in which they are counted: a fifth of the wall's points in pictures is enough
TWIN_MOST = 6000  # points of a window among which they are looked for: a dense cloud has 10^8 pairs
TWIN_SHARE = 0.1  # of the points under the surface that must have a twin
TURN = math.radians(2)  # from one direction that is tried to the next
# How far down may be from six o'clock: an inclinometer's error and a pipe that falls; a crawler's roll at its start
LEVEL_TURN, ROLL_TURN = math.radians(4), math.radians(30)
BESIDE = math.radians(8)  # directions nearer than this to down's still see its twins
FILL = 2  # windows beside one under water that may show too little to tell
SURE, BESIDE_SURE = (2.0, 4.0), (1.2, 1.5)  # twins over those by chance, times and sigmas; beside a window under water


def mirrored(tube: Tube, gravity: bool) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """(N,) bool: points of the tube seen in water or through it; and the stretches of water: s from `start` to `end`,
    how many `points`, and `at`: (k,2,3) points of the surface, under the axis, and which way is down, for depth().
    gravity: twelve o'clock is up; else up in the first keyframe. Windows of a diameter."""
    p, d = tube.points, tube.summary["d_mean"]
    mask = np.zeros(len(p["s"]), bool)
    known = np.flatnonzero((p["piece"] >= 0) & (np.abs(p["distance"]) < 0.35 * d))
    wall = known[p["weight"][known] > 0]
    off = np.flatnonzero(
        (p["piece"] >= 0) & (p["weight"] <= 0) & (p["distance"] > np.maximum(4 * p["sigma"], 0.01 * d))
    )
    if not len(wall):
        return mask, []
    bare = math.pi if gravity else _bare(p["clock"][wall])
    middles = np.arange(0.25 * d, tube.length, 0.5 * d)
    turn = LEVEL_TURN if gravity else ROLL_TURN
    found: dict[int, tuple[float, float]] = {}  # of a window, how far below the axis the surface is, and where down is
    unsure: dict[int, tuple[float, float]] = {}
    by_twins: set[int] = set()

    def take(k: int, level: float, down: float) -> None:
        by_twins.add(k)
        near = known[np.abs(p["s"][known] - middles[k]) < 0.5 * d]
        mask[near[p["r"][near] * np.cos(p["clock"][near] - down) > level]] = True
        found[k] = level, down

    for k, middle in enumerate(middles):
        on, out = (rows[np.abs(p["s"][rows] - middle) < 0.5 * d] for rows in (wall, off))
        if len(on) < 5 * LEAST:
            continue
        level, below = _level(p, on, out, bare, d)
        if level is not None:
            found[k] = level, bare
            mask[out[below]] = True
            continue
        twins, sure = _twins(p, known[np.abs(p["s"][known] - middle) < TWIN_REACH * d], turn, d)
        if twins is not None and sure:
            take(k, *twins)
        elif twins is not None:
            unsure[k] = twins
    for k in [*sorted(unsure), *sorted(unsure, reverse=True)]:
        if k not in found and ({k - 1, k + 1} & by_twins):
            take(k, *unsure[k])
    points = [int((np.abs(p["s"][known] - at) < 0.5 * d).sum()) for at in middles]
    for k, of in _too_little(by_twins, points):
        if k not in found:
            take(k, *found[of])
    stretches: list[dict[str, Any]] = []
    for k in sorted(found):
        middle, (level, down) = middles[k], found[k]
        if stretches and middle - 0.5 * d <= stretches[-1]["end"] + 0.5 * d:
            stretches[-1]["end"] = middle + 0.5 * d
        else:
            stretches.append({"start": middle - 0.5 * d, "end": middle + 0.5 * d, "at": []})
        frame = tube.frames([middle])
        towards = math.cos(down) * frame["up"][0] + math.sin(down) * frame["right"][0]
        stretches[-1]["at"].append((frame["centre"][0] + level * towards, towards))
    for piece in stretches:
        piece["start"], piece["end"] = max(0.0, float(piece["start"])), min(tube.length, float(piece["end"]))
        piece["at"] = np.array(piece["at"])
        piece["points"] = int((mask & (p["s"] >= piece["start"]) & (p["s"] <= piece["end"])).sum())
    return mask, stretches


def _too_little(found: set[int], points: list[int]) -> list[tuple[int, int]]:
    """Windows that are as the one of the second number: between two under water, or before the first or behind the last
    and with less than half of their points."""
    usual = float(np.median([points[k] for k in found])) if found else 0.0
    out = []
    for k in sorted(set(range(len(points))) - set(found)):
        before = max((j for j in found if j < k), default=None)
        after = min((j for j in found if j > k), default=None)
        if before is not None and after is not None:
            if after - before <= FILL + 1:
                out.append((k, before))
            continue
        nearest = before if before is not None else after
        if nearest is not None and abs(k - nearest) <= FILL and points[k] < 0.5 * usual:
            out.append((k, nearest))
    return out


def depth(tube: Tube, at: np.ndarray) -> float:
    """Of the water over the invert of the tube, the median of points `at` as mirrored() gives them."""
    places, downs = at[:, 0], at[:, 1]
    place = tube.project(places)
    s = np.where(place["piece"] >= 0, place["s"], 0.0)
    level = np.einsum("ni,ni->n", places - tube.frames(s)["centre"], downs)[place["piece"] >= 0]
    return 0.5 * tube.summary["d_mean"] - float(np.median(level)) if len(level) else math.nan


def _twins(
    p: dict[str, np.ndarray], rows: np.ndarray, turn: float, d: float
) -> tuple[tuple[float, float] | None, bool]:
    """How far below the axis the level is about which points have twins, and the clock of down; None without one; and
    whether that is sure by itself. Down is within `turn` of six o'clock."""
    rows = rows[:: -(-len(rows) // TWIN_MOST) or 1]
    rows = rows[np.argsort(p["s"][rows], kind="stable")]
    s, r, clock = p["s"][rows], p["r"][rows], p["clock"][rows]
    last = np.searchsorted(s, s + TWIN * d, side="right")
    i = np.repeat(np.arange(len(s)), last - np.arange(len(s)) - 1)
    if not len(i):
        return None, False
    j = i + 1 + np.arange(len(i)) - np.searchsorted(i, i)  # each with those that follow within reach
    best, chance = (0, 0.0, 0.0), 0
    for down in math.pi + np.arange(-math.pi / 2, math.pi / 2, TURN):
        under, beside = r * np.cos(clock - down), r * np.sin(clock - down)
        pair = (np.abs(beside[i] - beside[j]) < TWIN * d) & (np.abs(under[i] - under[j]) > 6 * TWIN * d)
        level = np.sort(0.5 * (under[i] + under[j])[pair])
        if not len(level):
            continue
        reach = np.searchsorted(level, level + 2 * TWIN * d, side="right") - np.arange(len(level))
        k = int(reach.argmax())
        count = int(reach[k])
        if abs(down - math.pi) <= turn:
            if count > best[0]:
                best = count, float(np.median(level[k : k + count])), float(down)
        elif abs(down - math.pi) > turn + BESIDE:
            chance = max(chance, count)
    count, level, down = best
    below = (r * np.cos(clock - down) > level).sum()
    least = [max(LEAST, f * chance, chance + g * math.sqrt(chance), TWIN_SHARE * below) for f, g in (SURE, BESIDE_SURE)]
    return ((level, down) if count >= least[1] else None), count >= least[0]


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
