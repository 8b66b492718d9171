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

from pipefish.tube_patches import FALSE_ALARMS, patches
from pipefish.tube_shared import alike

if TYPE_CHECKING:
    from pipefish.tube import Tube
    from pipefish.tube_shared import Common

# Of a table of events, whatever was found.
PLACE = ["kind", "s", "s_sigma", "start", "end", "clock", "clock_sigma"]
SIZE = ["length", "width", "size_sigma", "height", "height_sigma", "area", "points"]
JOINT = ["step", "step_sigma", "diameter_step", "diameter_step_sigma", "gap", "gap_sigma", "chi2"]
COLUMNS = [*PLACE, *SIZE, *JOINT, "angle", "angle_sigma", "radius", "radius_sigma"]
BESIDE = 0.3  # diameters: a gap or a kink nearer than this to a joint is that joint's
CHI2_7_MEDIAN = 6.346
# Of a joint, by the two ends of the surface that meet there.
TESTED = ("chi2", "step", "step_sigma", "diameter_step", "diameter_step_sigma", "angle", "angle_sigma")
GROSS = 4.0  # standard deviations
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
    found = _joints(tube, rings, kinks, common) + bends + patches(tube, rings)
    return sorted(found, key=lambda e: e["s"])


def _rings(tube: Tube) -> list[dict[str, Any]]:
    """Narrow rings of points outside the wall, all around: the gap of a joint, seen from inside."""
    p, d = tube.points, tube.summary["d_mean"]
    out = (p["piece"] >= 0) & (p["distance"] > np.maximum(GROSS * p["sigma"], 0.005 * d)) & (p["distance"] < 0.25 * d)
    s, sextant = p["s"][out], (p["clock"][out] / (np.pi / 3)).astype(int) % 6
    # Where neighbours tell the same, only one of so many counts.
    order = np.argsort(s)[:: alike(tube.surface)]
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
