"""What departs from the smooth tube: joints, bends, deposits, holes, laterals.

An event is a dictionary: kind ("joint", "bend", "deposit", "hole", "lateral", "recess"), s (chainage, m), s_sigma, and
  joint    step (m, across), step_sigma, clock (of the step; of a kink without one, towards which it turns),
           diameter_step, angle (rad), gap (m or None), gap_sigma
  bend     start, end, angle (rad; over pi where it turns back), angle_sigma, radius (m) of its axis, radius_sigma (both
           None where it is shorter than can be told from a kink, or turns unevenly), clock (towards which it turns)
  others   clock, length (along), width (around, m), height (m; how far in or out), height_sigma, points, area (m^2)

False alarms: each test is set so that a clean pipe, rough or with scattered gross points, gives less than one event in
a hundred fits (FALSE_ALARMS), whatever its length; tests/python/test_tube_findings.py counts them."""

from __future__ import annotations

import math
from itertools import pairwise
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipefish.tube_heap import fit_heap

if TYPE_CHECKING:
    from pipefish.tube import Tube
    from pipefish.tube_shared import Common

# Of a table of events, whatever was found.
PLACE = ["kind", "s", "s_sigma", "start", "end", "clock", "clock_sigma"]
SIZE = ["length", "width", "size_sigma", "height", "height_sigma", "area", "points"]
JOINT = ["step", "step_sigma", "diameter_step", "diameter_step_sigma", "gap", "gap_sigma", "chi2"]
COLUMNS = [*PLACE, *SIZE, *JOINT, "angle", "angle_sigma", "radius", "radius_sigma"]
FALSE_ALARMS = 0.01  # of one fit
BESIDE = 0.3  # diameters: a gap or a kink nearer than this to a joint is that joint's
CHI2_7_MEDIAN = 6.346
# Of a joint, by the two ends of the surface that meet there.
TESTED = ("chi2", "step", "step_sigma", "diameter_step", "diameter_step_sigma", "angle", "angle_sigma")
GROSS = 4.0  # standard deviations
# Of the diameter. Neighbouring tracks see the same relief in the same changing light and go astray together, which no
# point's own sigma knows: heaps of 0.7 to 1.2 mm were found in a smooth DN300.
LEAST_HEIGHT = 0.005
LEAST_BEND = math.radians(2)
# Each half of an S: waves a diameter long, of 1 % of it (rms), swing the axis to and fro by 3 to 5 degrees.
LEAST_S = math.radians(5)
# Of the diameter, for a bend as long: the smooth axis goes round a bend in kinks a knot or two apart. What that does to
# an arc's length beside its fit's own scatter falls as the bend grows: 60 fits, 15 to 90 degrees, noise 0.5 to 3 mm.
BEND_ENDS = 0.05
BEND_SHORTEST = 0.6  # shorter ones are kinks for all that can be told
# A turn that short is two pipes at an angle in their joint, as far as joints go: of the bends that are made the least
# turns by 11.25 degrees, and spigots leave their sockets before that.
KINK_MOST = math.radians(11)
SURE_KINK = 2.0  # of its own sigmas by which a turn has to be less than that
# Of the whole turn, rms: one arc between straights is left by the tangent by 0.004 to 0.06 of it, an S that is
# taken for one by 0.2 and more.
BEND_UNEVEN = 0.1
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


def chi2_limit(p: float, freedom: int) -> float:
    """Where a chi-squared of so many degrees is exceeded with probability p (Wilson and Hilferty)."""
    z = NormalDist().inv_cdf(1 - p)
    return freedom * (1 - 2 / (9 * freedom) + z * math.sqrt(2 / (9 * freedom))) ** 3


def break_candidates(coarse: Any, nodes: np.ndarray, diameter: float) -> list[float]:
    """Abscissae along the nodes' polyline where the wall before and after do not meet."""
    length = coarse.pieces[-1][1]
    if length < 2 * diameter:
        return []
    rows = coarse.steps(diameter, 0.05 * diameter, 0.5 * diameter)
    if not len(rows):
        return []
    # A window is one diameter each way; places a quarter of it apart are almost independent.
    # How much more than chance they scatter everywhere, as the wall's relief makes them; what joints and bends
    # leave of the stiff surface is none of it.
    s, chi2 = rows[:, 0], rows[:, 1].copy()
    relief = min(coarse.correlation, max(1.0, float(np.median(chi2)) / CHI2_7_MEDIAN))
    limit = max(16.0, chi2_limit(FALSE_ALARMS * 0.25 * diameter / length, 7) * relief)
    found = []
    while chi2.max() > limit:
        k = int(chi2.argmax())
        found.append(float(s[k]))
        chi2[np.abs(s - s[k]) < 0.8 * diameter] = 0
    placed = coarse.placed()
    found = [_localised(placed, at, diameter) for at in found]
    total = np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum()
    scale = total / length  # the smooth axis is a little shorter than the polyline of its nodes
    return sorted(f * scale for f in found if 0.5 * diameter < f < length - 0.5 * diameter)


def _localised(placed: np.ndarray, at: float, diameter: float) -> float:
    """Where near `at` two smooth walls, one before and one after, leave the least residual."""
    s, angle, distance, sigma, weight = placed[:, 0], placed[:, 1], placed[:, 3], placed[:, 4], placed[:, 5]
    near = (placed[:, 6] >= 0) & (weight > 0) & (np.abs(s - at) < 1.2 * diameter)
    t = (s[near] - at) / diameter
    c, n, c2, n2 = (f(k * angle[near]) for k in (1, 2) for f in (np.cos, np.sin))
    one = np.ones_like(t)
    rows = np.stack([c, n, one, c2, n2, t * c, t * n, t * t * c, t * t * n, t, t * c2, t * n2], 1)
    root = np.sqrt(weight[near]) / sigma[near]
    rows, values = rows * root[:, None], distance[near] * root
    # Normal equations, summed from one try to the next; a hair of ridge for stretches that do not fix all terms.
    tries = np.arange(-0.6, 0.601, 0.02)
    bins = np.searchsorted(tries, t, side="right")
    parts = [bins == i for i in range(len(tries) + 1)]
    normal = np.cumsum([rows[k].T @ rows[k] for k in parts], axis=0)
    right = np.cumsum([rows[k].T @ values[k] for k in parts], axis=0)
    count = np.cumsum([k.sum() for k in parts])
    ridge = 1e-9 * np.trace(normal[-1]) * np.eye(rows.shape[1])
    cost = np.full(len(tries), np.inf)
    for i in range(len(tries)):
        if min(count[i], count[-1] - count[i]) >= 2 * rows.shape[1]:
            sides = ((normal[i], right[i]), (normal[-1] - normal[i], right[-1] - right[i]))
            cost[i] = -sum(float(r @ np.linalg.solve(n + ridge, r)) for n, r in sides)
    return at + float(tries[int(cost.argmin())]) * diameter if np.isfinite(cost).any() else at


def _ends(surface: Any, k: int) -> tuple[dict[str, np.ndarray], float]:
    """The two sides of the joint after piece k: stations (2 rows) and its chainage."""
    s = surface.pieces[k][1]
    return surface.stations([s, s], [k, k + 1]), s


def _joint_test(surface: Any, k: int, common: Common) -> dict[str, Any]:
    f, s = _ends(surface, k)
    size = f["shape"].shape[1] + 2
    cov = f["covariance"].reshape(2, size, size).sum(0)
    turn = f["tangent_covariance"].reshape(2, 2, 2).sum(0)
    shared = common.joint(k)
    cov[:3, :3] += shared[:3, :3]
    turn += shared[3:, 3:]
    axes = np.stack([f["first"][0], f["second"][0]])
    across = axes @ (f["centre"][1] - f["centre"][0])
    bend = axes @ (f["tangent"][1] - f["tangent"][0])
    grow = f["shape"][1, 0] - f["shape"][0, 0]
    chi2 = float(
        across @ np.linalg.solve(cov[:2, :2], across) + grow**2 / cov[2, 2] + bend @ np.linalg.solve(turn, bend)
    )
    step, angle = float(np.hypot(*across)), float(np.hypot(*bend))
    return {
        "s": float(s),
        "chi2": chi2,
        "across": across,
        "step": step,
        "step_sigma": float(np.sqrt(max(0.0, np.trace(cov[:2, :2]) / 2))),
        "diameter_step": 2 * float(grow),
        "diameter_step_sigma": 2 * float(np.sqrt(cov[2, 2])),
        "angle": angle,
        "angle_sigma": float(np.sqrt(max(0.0, np.trace(turn) / 2))),
    }


def confirmed(surface: Any, diameter: float, breaks: list[float], common: Common) -> list[float]:
    """The breaks whose two sides really differ in the final fit."""
    length = surface.pieces[-1][1]
    limit = max(16.0, chi2_limit(FALSE_ALARMS * 0.25 * diameter / length, 5))
    return [b for k, b in enumerate(breaks) if _joint_test(surface, k, common)["chi2"] > limit]


def events(tube: Tube, common: Common) -> list[dict[str, Any]]:
    """All findings, along the pipe; common: what the points share."""
    rings = _rings(tube)
    bends, kinks = _bends(tube, common)
    found = _joints(tube, rings, kinks, common) + bends + _patches(tube, rings)
    return sorted(found, key=lambda e: e["s"])


def _alike(tube: Tube) -> int:
    """So many neighbouring points tell the same."""
    return max(1, round(tube.surface.correlation * tube.surface.thinning))


def _rings(tube: Tube) -> list[dict[str, Any]]:
    """Narrow rings of points outside the wall, all around: the gap of a joint, seen from inside."""
    p, d = tube.points, tube.summary["d_mean"]
    out = (p["piece"] >= 0) & (p["distance"] > np.maximum(GROSS * p["sigma"], 0.005 * d)) & (p["distance"] < 0.25 * d)
    s, sextant = p["s"][out], (p["clock"][out] / (np.pi / 3)).astype(int) % 6
    # Where neighbours tell the same, only one of so many counts.
    order = np.argsort(s)[:: _alike(tube)]
    s, sextant = s[order], sextant[order]
    if len(s) < 4:
        return []
    rate, found = len(s) / tube.length, []
    for width in (0.02 * d, 0.05 * d, 0.1 * d, 0.2 * d):
        last = np.searchsorted(s, s + width, side="right")
        limit = _poisson_limit(rate * width, FALSE_ALARMS * width / tube.length / 4)
        for i in np.flatnonzero(last - np.arange(len(s)) >= limit):
            inside = slice(i, last[i])
            if len(set(sextant[inside])) >= 4:
                found.append((float((last[i] - i) / width), i, int(last[i])))
    found.sort(key=lambda f: -f[0])
    rings: list[dict[str, Any]] = []
    for density, first, after in found:
        # Grown to the last point that follows as closely as the ring's own do.
        reach = min(5 / density, 1 / (3 * rate)) if rate < density / 15 else 3 / density
        while first > 0 and s[first] - s[first - 1] < reach:
            first -= 1
        while after < len(s) and s[after] - s[after - 1] < reach:
            after += 1
        n, a, b = after - first, float(s[first]), float(s[after - 1])
        if all(b < r["from"] - 0.1 * d or a > r["to"] + 0.1 * d for r in rings):
            # Ends of n points spread evenly: each misses the edge by (width / (n + 1)) on average.
            gap = (b - a) * (n + 1) / max(1, n - 1)
            sigma = gap * math.sqrt(2.0) / (n + 1)
            rings.append({"s": (a + b) / 2, "from": a, "to": b, "gap": gap, "gap_sigma": sigma, "points": n})
    return rings


def _poisson_limit(mean: float, p: float) -> int:
    """Fewest events that chance brings with a probability below p, at least 4."""
    n, term, total = 0, math.exp(-min(mean, 700.0)), 0.0
    while n < 100000:
        total += term
        n += 1
        term *= mean / n
        if 1 - total < p:
            break
    return max(4, n)


def _joints(
    tube: Tube, rings: list[dict[str, Any]], kinks: list[dict[str, Any]], common: Common
) -> list[dict[str, Any]]:
    """Where the surface's pieces end, where it kinks, where a gap shows; a gap beside another one is its own."""
    d, found, free = tube.summary["d_mean"], [], list(rings)
    for k in range(len(tube.surface.pieces) - 1):
        test = _joint_test(tube.surface, k, common)
        f = tube.frames([test["s"]], [k])
        shift = test["across"] @ np.stack([f["first"][0], f["second"][0]])
        clock = float(math.atan2(shift @ f["right"][0], shift @ f["up"][0]) % (2 * math.pi))
        found.append(_joint(test["s"], 0.05 * d, clock=clock, **{n: test[n] for n in TESTED}))
    breaks = len(found)
    for kink in kinks:
        piece = min(range(breaks), key=lambda k: abs(found[k]["s"] - kink["s"]), default=None)
        if piece is not None and abs(found[piece]["s"] - kink["s"]) < BESIDE * d:
            _take_kink(tube, found[piece], piece, kink)
        else:
            found.append(_joint(**{n: kink[n] for n in ("s", "s_sigma", "clock", "angle", "angle_sigma")}))
    for event in found:
        near = [r for r in free if abs(r["s"] - event["s"]) < BESIDE * d]
        if near:
            ring = min(near, key=lambda r: abs(r["s"] - event["s"]))
            free.remove(ring)
            event.update(s=ring["s"], s_sigma=ring["gap"] / math.sqrt(12), gap=ring["gap"], gap_sigma=ring["gap_sigma"])
    for ring in free:
        sigma = max(ring["gap"] / math.sqrt(12), 1e-4)
        found.append(_joint(ring["s"], sigma, **{n: ring[n] for n in ("gap", "gap_sigma", "points")}))
    return found


def _take_kink(tube: Tube, joint: dict[str, Any], piece: int, kink: dict[str, Any]) -> None:
    """A piece that ends a little off the joint kinks where the joint is, and the next one turns back: the joint is at
    the clearer one of both, and its angle is that between the axes half a diameter outside them."""
    reach = 0.5 * tube.summary["d_mean"]
    outside = [min(joint["s"], kink["s"]) - reach, max(joint["s"], kink["s"]) + reach]
    (start, _), (_, end) = tube.surface.pieces[piece : piece + 2]
    before, behind = tube.frames([max(outside[0], start), min(outside[1], end)], [piece, piece + 1])["tangent"]
    if kink["angle"] > joint["angle"]:
        apart = abs(kink["s"] - joint["s"])
        joint.update(s=kink["s"], s_sigma=math.hypot(kink["s_sigma"], apart))
    joint["angle"] = float(math.atan2(np.linalg.norm(np.cross(before, behind)), before @ behind))
    joint["angle_sigma"] = math.hypot(joint["angle_sigma"], kink["angle_sigma"])


def _joint(s: float, s_sigma: float, **known: Any) -> dict[str, Any]:
    """The event; None for what is not known of it."""
    unknown = dict.fromkeys(
        ("step", "step_sigma", "diameter_step", "angle", "angle_sigma", "clock", "gap", "gap_sigma")
    )
    return {"kind": "joint", "s": s, "s_sigma": s_sigma, **unknown, **known}


def _bends(tube: Tube, common: Common) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Stretches whose curvature is more than 3 sigma and that turn by more than 2 degrees: bends, and what is so short
    and turns so little that it is a joint's kink."""
    d, found, kinks = tube.summary["d_mean"], [], []
    for k, (start, end) in enumerate(tube.surface.pieces):
        s = np.linspace(start, end, max(3, int((end - start) / (0.05 * d)) + 1))
        f = tube.frames(s, [k] * len(s))
        curvature = f["curvature"]
        bent = curvature > 3 * f["curvature_sigma"]
        turning = np.cross(f["tangent"], np.gradient(f["tangent"], axis=0))  # rad from station to station
        bent[1:] &= np.einsum("ni,ni->n", turning[1:], turning[:-1]) > 0  # an S is two bends
        edges = np.flatnonzero(np.diff(np.r_[0, bent, 0]))
        runs: list[list[int]] = []
        for a, b in zip(edges[::2], edges[1::2], strict=True):
            if runs and s[a] - s[runs[-1][1] - 1] < 0.5 * d:
                turns = [turning[slice(*run)].sum(axis=0) for run in (runs[-1], (a, b))]
                # Beside a kink the smooth axis swings back a little, and with waves of the wall to and fro.
                if turns[0] @ turns[1] > 0 or min(np.linalg.norm(turns, axis=1)) < LEAST_S:
                    runs[-1][1] = int(b)
                    continue
            runs.append([int(a), int(b)])
        between = [0, *((r[1] - 1 + n[0]) // 2 for r, n in pairwise(runs)), len(s) - 1]
        for (a, b), least, most in zip(runs, between, between[1:], strict=False):
            # The smooth axis enters a bend over about a knot: the angle is taken outside it, short of the next bend.
            out_a = max(least, int(np.searchsorted(s, s[a] - 0.5 * d)))
            out_b = min(most, int(np.searchsorted(s, s[b - 1] + 0.5 * d)))
            arc = _arc(s[out_a : out_b + 1], f["tangent"][out_a : out_b + 1], float(s[a]), float(s[b - 1]))
            if arc.angle < LEAST_BEND:
                continue
            turn = f["tangent_covariance"].reshape(-1, 2, 2)
            own = max(0.0, float(np.trace(turn[out_a]) + np.trace(turn[out_b])) / 2)
            # The heading wanders with the poses from one end to the other: more than both ends by themselves.
            sigma = math.sqrt(own + common.turn(k, (float(s[out_a]), float(s[out_b])), own / 2))
            at = int(np.searchsorted(s, arc.middle))
            toward = np.cross(arc.normal, f["tangent"][at])
            ends = BEND_ENDS * d * d / arc.length
            radius = None
            if arc.length > BEND_SHORTEST * d and arc.uneven < BEND_UNEVEN:
                radius = arc.length / arc.angle
            relative = math.hypot(arc.length_sigma, ends) / arc.length
            kink = arc.length <= BEND_SHORTEST * d and arc.angle + SURE_KINK * sigma < KINK_MOST
            (kinks if kink else found).append(
                {
                    "kind": "bend",
                    "s": arc.middle,
                    "s_sigma": math.hypot(arc.middle_sigma, ends / 2),
                    "start": arc.middle - 0.5 * arc.length,
                    "end": arc.middle + 0.5 * arc.length,
                    "angle": arc.angle,
                    "angle_sigma": sigma,
                    "radius": radius,
                    "radius_sigma": radius and radius * math.hypot(relative, sigma / arc.angle),
                    "clock": float(math.atan2(toward @ f["right"][at], toward @ f["up"][at]) % (2 * math.pi)),
                }
            )
    return found, kinks


class _Arc(NamedTuple):
    """An even turn between two straights. normal (3,): of the bend's plane; uneven: rms residual, in the
    plane and out of it, over the turn."""

    middle: float
    length: float
    angle: float
    normal: np.ndarray
    middle_sigma: float
    length_sigma: float
    uneven: float


def _arc(s: np.ndarray, tangent: np.ndarray, start: float, end: float) -> _Arc:
    """Where a pipe with these tangents (n,3) at s (n,) turns evenly, straight before and behind: least squares of its
    heading in the plane in which it turns on the whole. start, end: about. The angle is from first to last tangent."""
    normal = np.cross(tangent[:-1], tangent[1:]).sum(axis=0)
    normal /= np.linalg.norm(normal)
    across = np.cross(normal, tangent[0])
    heading = np.unwrap(np.arctan2(tangent @ across, tangent @ tangent[0]))
    middle, length, least = 0.5 * (start + end), max(end - start, s[1] - s[0]), s[1] - s[0]
    for _ in range(30):
        along = np.clip((s - middle) / length + 0.5, 0, 1)
        ramp = np.column_stack([np.ones(len(s)), along])
        turn = np.linalg.lstsq(ramp, heading, rcond=None)[0]
        residual = heading - ramp @ turn
        slope = np.where((along > 0) & (along < 1), -turn[1] / length, 0.0)
        columns = np.column_stack([ramp, slope, slope * (s - middle) / length])
        move = np.linalg.lstsq(columns, residual, rcond=None)[0][2:]
        middle = float(np.clip(middle + np.clip(move[0], -length / 4, length / 4), s[0], s[-1]))
        length = float(np.clip(length + move[1], max(0.5 * length, least), min(1.5 * length, s[-1] - s[0])))
        if np.abs(move).max() < 1e-6 * (s[-1] - s[0]):
            break
    scatter = float(residual @ residual) / max(1, len(s) - columns.shape[1])
    variance = scatter * np.diag(np.linalg.pinv(columns.T @ columns))
    left = residual**2 + (tangent @ normal) ** 2
    uneven = math.sqrt(float(np.mean(left))) / max(1e-9, abs(float(turn[1])))
    angle = abs(float(heading[-1] - heading[0]))
    return _Arc(middle, length, angle, normal, math.sqrt(variance[2]), math.sqrt(variance[3]), uneven)


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


def _patches(tube: Tube, rings: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Patches of wall whose points stand in or out together."""
    p, d = tube.points, tube.summary["d_mean"]
    every = _alike(tube)
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
