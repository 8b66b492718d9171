"""Patches of a tube's wall that stand in or out: deposits, recesses, holes, laterals. As events, see tube_findings."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from pipefish.tube_heap import fit_heap
from pipefish.tube_shared import alike

if TYPE_CHECKING:
    from pipefish.tube import Tube

FALSE_ALARMS = 0.01  # of one fit
# Of the diameter. Neighbouring tracks see the same relief in the same changing light and go astray together, which no
# point's own sigma knows: heaps of 0.7 to 1.2 mm were found in a smooth DN300.
LEAST_HEIGHT = 0.005
# The flank of a heap that looks away from the camera shows few points: where most of a point's nearest FEW stand out, a
# patch goes on over REACH times what the nearest k of its median take.
FEW, REACH = 7, 1.5
# Kinds that rise and fall off smoothly; the others' walls are steep. Of their length and width, to both sides: what is
# looked at for it.
SHAPED = ("deposit", "recess")
AROUND = 0.75
ENOUGH = 1000  # points, for a shape
TENTH = 1.28  # sigmas that a tenth of what is normally distributed exceeds
SURELY = 1.645  # of its own sigmas by which a patch has to stand out further than that: 95 %, one-sided


def _majority(share: float, k: int) -> float:
    """Chance that more than half of k points stand out, each with probability `share`."""
    need = (k + 1) // 2
    return sum(math.comb(k, j) * share**j * (1 - share) ** (k - j) for j in range(need, k + 1))


def _limit(z: np.ndarray, k: int, tests: int) -> float:
    """Standard deviations that a median of k reaches by chance in less than FALSE_ALARMS of fits, on this side: the
    points' own distribution says how often one of them does."""
    ordered = np.sort(z)
    for limit in np.arange(0.5, 8.0, 0.1):
        share = 1 - np.searchsorted(ordered, limit) / len(z)
        if tests * _majority(share, k) < FALSE_ALARMS / 4:
            return float(limit)
    return 8.0


def patches(tube: Tube, rings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Patches of wall whose points stand in or out together."""
    p, d = tube.points, tube.summary["d_mean"]
    every = alike(tube.surface)
    rows = np.flatnonzero(p["piece"] >= 0)
    tests = len(rows) // every
    if tests < 60:
        return []
    z = p["distance"][rows] / p["sigma"][rows]
    radius = 0.5 * d
    worst = max((z > 3).mean(), (z < -3).mean())
    k = next((k for k in range(9, 62, 2) if tests * _majority(float(worst), k) < FALSE_ALARMS / 4), 61)
    spacing = math.sqrt(d * tube.length * k / tests)
    # `used` are the points that the surface knows: the finite ones.
    median, near = np.full((2, len(p["s"])), np.nan)
    median[p["known"]] = tube.surface.medians(radius, k, every, 2.5 * spacing, 1.0 * d)
    near[p["known"]] = tube.surface.medians(radius, FEW, every, 2.5 * spacing, 1.0 * d)
    rows = rows[np.isfinite(median[rows])]
    if len(rows) < 60:
        return []
    value = median[rows]
    centre = float(np.median(value))
    scale = float(1.4826 * np.median(np.abs(value - centre)))
    gauss = -NormalDist().inv_cdf(FALSE_ALARMS / 4 / max(1.0, tests / k)) * scale
    out = []
    for sign in (-1, 1):
        limit = np.maximum(gauss, _limit(sign * z, k, tests) * p["sigma"][rows])
        flagged = rows[sign * (value - centre) > limit]
        seeds = _clusters(p, flagged, radius, spacing)
        highest = [float(np.nanmax([*(sign * median[seed]), *(sign * near[seed])])) for seed in seeds]
        grown = [_grown(p, seed, near, sign, radius, spacing, h) for seed, h in zip(seeds, highest, strict=True)]
        told = _told(tube, grown, sign, spacing / math.sqrt(k))
        for event in told:
            ringed = any(r["from"] - 0.1 * d < event["s"] < r["to"] + 0.1 * d for r in rings)
            if not (sign > 0 and ringed and event["length"] < 0.3 * d):
                out.append(event)
    return out


def _told(tube: Tube, clusters: list[np.ndarray], sign: int, spacing: float) -> list[dict[str, Any]]:
    """The events of clusters. Those that have grown into each other, or of which one lies in the middle of another, are
    one: a low heap is seen by patches."""
    out: list[tuple[np.ndarray, dict[str, Any]]] = []
    waiting = [c for c in clusters if len(c) >= 4]
    while waiting:
        cluster = waiting.pop(0)
        event = _patch(tube, cluster, sign, spacing)
        if event is None:
            continue
        met = [k for k, (c, e) in enumerate(out) if np.intersect1d(c, cluster).size or _are_one(e, event, tube)]
        if met:
            waiting.insert(0, np.unique(np.concatenate([cluster, *(out[k][0] for k in met)])))
            out = [o for k, o in enumerate(out) if k not in met]
        else:
            out.append((cluster, event))
    return [event for _, event in out]


def _are_one(a: dict[str, Any], b: dict[str, Any], tube: Tube) -> bool:
    """Whether the middle of one heap or hollow lies within the ends of another."""
    turn = abs((a["clock"] - b["clock"] + math.pi) % (2 * math.pi) - math.pi) * 0.5 * tube.summary["d_mean"]
    within = 2 * abs(a["s"] - b["s"]) < max(a["length"], b["length"]) and 2 * turn < max(a["width"], b["width"])
    return within and a["kind"] == b["kind"] and a["kind"] in SHAPED


def _patch(tube: Tube, cluster: np.ndarray, sign: int, spacing: float) -> dict[str, Any] | None:
    """The event of a cluster; None where it does not surely stand out."""
    event = _describe(tube, cluster, sign, spacing)
    if _surely(tube.points, cluster, event["height"], event["height_sigma"]) < LEAST_HEIGHT * tube.summary["d_mean"]:
        return None
    # The highest of n points of a heap is so much lower than its top.
    event["height_sigma"] = math.hypot(event["height_sigma"], 3 * event["height"] / event["points"])
    return {**event, **_shaped(tube, event, sign)} if event["kind"] in SHAPED else event


def _shaped(tube: Tube, event: dict[str, Any], sign: int) -> dict[str, Any]:
    """Place and size of a patch by a shape that is fitted to its points and those around it, as far as it is as high as
    what counts as one; nothing where its points are too few for one."""
    p, d = tube.points, tube.summary["d_mean"]
    across = ((p["clock"] - event["clock"] + np.pi) % (2 * np.pi) - np.pi) * 0.5 * d
    near = p["piece"] >= 0
    near &= np.abs(p["s"] - event["s"]) < AROUND * event["length"] + 0.1 * d
    near &= np.abs(across) < AROUND * event["width"] + 0.1 * d
    near = np.flatnonzero(near)[:: 1 + int(near.sum()) // ENOUGH]
    box = (event["s"], 0.0, event["length"], event["width"])
    value, sigma = sign * p["distance"][near], p["sigma"][near]
    found = fit_heap(p["s"][near], across[near], value, sigma, box, event["height"], LEAST_HEIGHT * d)
    if found is None:
        return {}
    return {
        "s": found.s,
        "s_sigma": found.s_sigma,
        "clock": float((event["clock"] + found.x / (0.5 * d)) % (2 * math.pi)),
        "clock_sigma": found.x_sigma / (0.5 * d),
        "length": found.length,
        "width": found.width,
        "size_sigma": max(found.length_sigma, found.width_sigma),
        "height": found.height,
        "height_sigma": found.height_sigma,
        "area": found.length * found.width * math.pi / 4,
    }


def _surely(p: dict[str, np.ndarray], cluster: np.ndarray, height: float, sigma: float) -> float:
    """What a patch surely stands out by. The points that make its height are its highest for their errors, too: those
    of the tenth that is, are 1.28 sigmas at least."""
    top = np.abs(p["distance"][cluster]) >= 0.8 * height
    own = math.sqrt(float(np.mean(p["sigma"][cluster][top] ** 2)))
    return height - TENTH * own - SURELY * max(sigma, own / math.sqrt(max(1.0, 0.2 * len(cluster))))


def _clusters(p: dict[str, np.ndarray], rows: np.ndarray, radius: float, link: float) -> list[np.ndarray]:
    """Points that hang together on the unrolled wall, no further apart than `link`."""
    if not len(rows):
        return []
    around = max(1, int(2 * np.pi * radius / link))
    i = np.floor(p["s"][rows] / link).astype(int)
    j = np.minimum(around - 1, (p["clock"][rows] / (2 * np.pi) * around).astype(int))
    cells: dict[tuple[int, int], list[int]] = {}
    for row, a, b in zip(rows.tolist(), i.tolist(), j.tolist(), strict=True):
        cells.setdefault((a, b), []).append(row)
    out, left = [], set(cells)
    while left:
        stack, members = [left.pop()], []
        while stack:
            a, b = stack.pop()
            members += cells[a, b]
            for near in ((a + x, (b + y) % around) for x in (-1, 0, 1) for y in (-1, 0, 1)):
                if near in left:
                    left.remove(near)
                    stack.append(near)
        out.append(np.array(sorted(members)))
    return sorted(out, key=lambda c: int(c[0]))


def _grown(
    p: dict[str, np.ndarray],
    cluster: np.ndarray,
    near: np.ndarray,
    sign: int,
    radius: float,
    link: float,
    height: float,
) -> np.ndarray:
    """The cluster with the points around it that stand out to the same side. near (N,): median of each point's nearest
    few; where they stand out as well, the patch goes on."""
    away = sign * p["distance"]
    left = np.flatnonzero((p["piece"] >= 0) & (away > 2.5 * p["sigma"]) & (away < 1.5 * height + 3 * p["sigma"]))
    inner = sign * near[left] > 2.5 * p["sigma"][left]
    out, rim = [], cluster
    while len(rim):
        reach = np.where(inner, REACH, 1.0) * link
        joins = _beside(p, left, rim, reach, radius)
        out.append(left[joins])
        rim, left, inner = left[joins & inner], left[~joins], inner[~joins]
    return np.sort(np.concatenate(out))


def _beside(
    p: dict[str, np.ndarray], rows: np.ndarray, rim: np.ndarray, reach: np.ndarray, radius: float
) -> np.ndarray:
    """(n,) bool: which points `rows` lie within their `reach` (n,) of one of the points `rim` on the unrolled wall."""
    found = np.zeros(len(rows), bool)
    s, clock = p["s"], p["clock"]
    near = np.flatnonzero((s[rows] > s[rim].min() - reach) & (s[rows] < s[rim].max() + reach))
    if not len(near):
        return found
    # Cells as wide as the farthest reach: only those of the eight around a point's own, and that, can hold what it
    # meets. Pairs all along the pipe, as of a dense cloud with a film on its wall, would be millions.
    cell = float(reach.max())
    around = max(1, int(2 * np.pi * radius / cell))
    (i, j), (k, m) = (
        (np.floor(s[x] / cell).astype(int), (clock[x] / (2 * np.pi) * around).astype(int) % around)
        for x in (rows[near], rim)
    )
    order = np.argsort(k * around + m, kind="stable")
    keys, rim = (k * around + m)[order], rim[order]
    for x, y in ((x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)):
        key = (i + x) * around + (j + y) % around
        first, last = np.searchsorted(keys, key), np.searchsorted(keys, key, side="right")
        one = np.repeat(np.arange(len(near)), last - first)
        other = rim[np.arange(len(one)) - np.repeat(np.cumsum(last - first) - last, last - first)]
        away = (clock[rows[near[one]]] - clock[other] + np.pi) % (2 * np.pi) - np.pi
        close = np.hypot(s[rows[near[one]]] - s[other], away * radius) < reach[near[one]]
        found[near[one[close]]] = True
    return found


def _describe(tube: Tube, cluster: np.ndarray, sign: int, spacing: float) -> dict[str, Any]:
    p, d = tube.points, tube.summary["d_mean"]
    s, value = p["s"][cluster], np.abs(p["distance"][cluster])
    clock = float(np.angle(np.exp(1j * p["clock"][cluster]).mean()) % (2 * np.pi))
    off = (p["clock"][cluster] - clock + np.pi) % (2 * np.pi) - np.pi
    n = len(cluster)
    # The outermost of n points miss the rim of a patch by about its size over n.
    length = float(np.ptp(s)) * (n + 1) / (n - 1)
    width = float(np.ptp(off)) * 0.5 * d * (n + 1) / (n - 1)
    end_sigma = max(length, width) / (n + 1) + spacing / 2
    # Near the top, but not the farthest point, which may be gross: most points of a heap lie on its flanks.
    height = float(np.quantile(value, max(0.9, 1.0 - 1.5 / len(value))))
    kind = "deposit"
    if sign > 0:
        kind = "recess"
        if height > 0.03 * d:
            kind = "lateral" if height > 0.12 * d and min(length, width) > 0.15 * d else "hole"
    return {
        "kind": kind,
        "s": 0.5 * float(s.min() + s.max()),  # the middle of what stands out, not of the points: its sides have more
        "s_sigma": end_sigma / math.sqrt(2),
        "clock": float((clock + 0.5 * (off.min() + off.max())) % (2 * math.pi)),
        "clock_sigma": end_sigma / math.sqrt(2) / (0.5 * d),
        "length": length,
        "width": width,
        "size_sigma": end_sigma * math.sqrt(2),
        "height": height,
        "height_sigma": float(np.median(p["sigma"][cluster]) / math.sqrt(max(1.0, 0.2 * n))),
        "area": length * width * math.pi / 4,
        "points": n,
    }
