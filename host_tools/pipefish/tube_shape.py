"""Sections that are no ellipse: an egg's crown is a circle, and a fit that begins with the best circle ends there.

So where much of the wall lies off it all along the pipe, the surface is fitted a second time from the circle that all
points ask for together, however badly it suits them, and the likelier of the two counts. Where such a section is not
seen all around, its curve over the gap is a guess: the invert of an egg is not where its crown's circle has it. Where
that guess is worth too little, stations are open. Of a crown alone nothing tells that it is an egg's."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pipefish.tube_section import AROUND, MEASURED

if TYPE_CHECKING:
    from pipefish.tube import Tube

OFF = 0.03  # of the points of half of all windows: more off the wall, and another one is tried
FAR = 2.5  # radii: what is further away is not this wall
WIDE = 0.15  # radii: how far a section may be from a circle and still be led by it
ROUNDS = 20
LEAST = 20  # points of a window
SURE = 10.0  # of the likelihood's logarithm
OUTLYING = 2.5  # sigmas: points further off the wall do not count, in the fit
NO_ELLIPSE = 0.0025  # of the diameter, of a departure: it makes diameters 0.5 % larger or smaller
# Of the departure: what the egg of 2 to 3 has beyond the sixth harmonic is up to 8 % of what it has up to it.
BEYOND = 0.1
# Of the diameter, one sigma, of the wall over a gap: off by so much in the middle of a third of the turn, by half of it
# on the average, it makes diameters 0.5 % larger or smaller.
KNOWN = 0.015
HALF_WAVE = math.radians(90)  # of an ellipse: a gap that has room for another one
BORDER = math.radians(30)  # of a gap, from either side
STRAY = 4.0  # sigmas of Poisson, by which points off the wall are no gross ones
EVEN = 1.1  # nine of ten circles over one of ten: wider than joints, eggs and wear make it


def much_off(tube: Tube) -> bool:
    """Whether more than a few points are off the wall all along the pipe, not only at a heap or a branch."""
    p, d = tube.points, tube.summary["d_mean"]
    near = (p["piece"] >= 0) & (p["r"] < 0.5 * FAR * d)
    window = (p["s"][near] / d).astype(int)
    count = np.bincount(window)
    off = np.bincount(window, p["weight"][near] <= 0)
    return bool((off > OFF * count)[count > 0].mean() > 0.5)


def wide_circles(
    cloud: np.ndarray, tube: Tube, count: int, among: np.ndarray | None = None
) -> tuple[np.ndarray, list[float]]:
    """Centres (count,3) and radii along the tube of circles through all points around it, of those `among` (n,) bool:
    Cauchy weights."""
    p, d = tube.points, tube.summary["d_mean"]
    near = (p["piece"] >= 0) & (p["r"] < 0.5 * FAR * d)
    known = np.flatnonzero(near if among is None else near & among)
    known = known[np.argsort(p["s"][known], kind="stable")]
    s = np.linspace(0, tube.length, count)
    first, last = (np.searchsorted(p["s"][known], s + away) for away in (-d, d))
    frame = tube.frames(s)
    nodes, radii = frame["centre"].copy(), np.full(count, 0.5 * d)
    for k in range(count):
        rows = known[first[k] : last[k]]
        if len(rows) < LEAST:
            continue
        away = cloud[rows] - nodes[k]
        x, y = away @ frame["right"][k], away @ frame["up"][k]
        weight = np.ones(len(x))
        for _ in range(ROUNDS):  # algebraic: begins anywhere
            left = np.column_stack([2 * x, 2 * y, np.ones_like(x)])
            right = x * x + y * y
            a, b, c = np.linalg.lstsq(left * weight[:, None], right * weight, rcond=None)[0]
            radius = math.sqrt(max(c + a * a + b * b, 0.0))
            weight = 1 / np.sqrt(1 + ((np.hypot(x - a, y - b) - radius) / (WIDE * 0.5 * d)) ** 2)
        if 0.25 * d < radius < 2 * d:
            nodes[k] += a * frame["right"][k] + b * frame["up"][k]
            radii[k] = radius
    return np.ascontiguousarray(nodes), radii.tolist()


def leads_elsewhere(cloud: np.ndarray, tube: Tube, nodes: np.ndarray, radii: list[float]) -> bool:
    """Whether wide circles are another beginning than the tube's wall: not where circles through that wall's own points
    are, to within the distance at which points no longer count."""
    on = tube.points["weight"] > 0
    own, own_radii = wide_circles(cloud, tube, len(nodes), on)
    apart = np.linalg.norm(nodes - own, axis=1) + np.abs(np.subtract(radii, own_radii))
    return bool(np.median(apart) > OUTLYING * np.median(tube.points["sigma"][on]))


def is_even(radii: list[float]) -> bool:
    """Whether circles along the pipe are of one size, as a pipe's are: others are of what stands around it."""
    least, most = np.percentile(radii, (10, 90))
    return bool(most < EVEN * least)


def _likelihood(tube: Tube, among: np.ndarray, mirrored: np.ndarray, width: float) -> float:
    """Its logarithm: points on the wall are normal, others anywhere within `width`; mirrored (n,) bool: what water
    explains counts as any on the wall."""
    p = tube.points
    off = p["weight"] <= 0
    share = float(np.clip(np.mean(off[among] & ~mirrored[among]), 0.001, 0.999))
    sigma = np.maximum(p["sigma"][among], 1e-6 * width)
    square = np.where(mirrored[among], 1.0, (p["distance"][among] / sigma) ** 2)
    normal = (1 - share) * np.exp(-0.5 * square) / (math.sqrt(2 * math.pi) * sigma)
    return float(np.log(normal + share / width).sum())


def _explained(other: Tube, first: Tube, among: np.ndarray, wet: np.ndarray) -> float:
    """Share of points that are on the other one's wall, off the first one's and not its wall in water, less those the
    other way round. Where both walls are within a sigma, both explain the same."""
    p, q = first.points, other.points
    on, also = (p["weight"][among] > 0) | wet, q["weight"][among] > 0
    apart = np.abs(q["distance"][among] - p["distance"][among]) > p["sigma"][among]
    return float(np.mean(apart & also & ~on) - np.mean(apart & on & ~also))


def likelier(other: Tube, first: Tube) -> bool:
    """Whether the other tube explains the points better than the first one, water that mirrors its wall included: half
    of what made one look for it at least is on its wall, and the likelihood gains by more than what its section's
    parameters cost (BIC)."""
    from pipefish.tube_water import mirrored

    width = FAR * first.summary["d_mean"]
    both = (first.points["piece"] >= 0) & (other.points["piece"] >= 0)
    among = np.flatnonzero(both & (first.points["r"] < 0.5 * width))
    if len(among) < LEAST:
        return False
    wet = mirrored(first, False)[0]
    if _explained(other, first, among, wet[among]) < 0.5 * OFF:
        return False
    gain = _likelihood(other, among, np.zeros(len(wet), bool), width) - _likelihood(first, among, wet, width)
    alike = max(first.surface.correlation, other.surface.correlation)  # so many neighbours tell the same
    stretches = max(1.0, first.length / first.summary["d_mean"])
    price = stretches * math.log(max(2.0, len(among) / stretches / alike))
    return gain / alike > (other.surface.order - first.surface.order) * price + SURE


def departure(shape: np.ndarray) -> np.ndarray:
    """(n,) metres by which sections (n,k) depart from their ellipses, at most."""
    t = np.arange(360) * np.pi / 180
    out = np.zeros((len(shape), len(t)))
    for h, k in enumerate(range(3, shape.shape[1], 2), start=3):
        out += shape[:, k, None] * np.cos(h * t) + shape[:, k + 1, None] * np.sin(h * t)
    return np.abs(out).max(axis=1)


def left_out(departs: np.ndarray, diameter: np.ndarray) -> np.ndarray:
    """(n,) metres, one sigma, by which a diameter may be off for harmonics that are not in the section."""
    return np.where(departs > NO_ELLIPSE * diameter, BEYOND * departs, 0.0)


def _waves(order: int, t: np.ndarray) -> np.ndarray:
    """(m,2 order+1) how the wall moves outwards at angles t (m,) with the centre, the radius and each harmonic."""
    h = np.arange(2, order + 1)[:, None] * t
    pairs = np.stack([np.cos(h), np.sin(h)], 1).reshape(-1, len(t))
    return np.vstack([np.cos(t), np.sin(t), np.ones_like(t), pairs]).T


def _leverage(order: int, gap: float) -> float:
    """How far the wall over a gap is off for each metre of the first harmonic that is not in the section: by what the
    others take for it where there are points, and it itself."""
    seen = np.abs(AROUND - math.pi) > 0.5 * gap  # the gap is in the middle
    missing = np.column_stack([np.cos((order + 1) * AROUND), np.sin((order + 1) * AROUND)])
    if seen.all():
        return 1.0
    waves = _waves(order, AROUND)
    off = waves @ np.linalg.lstsq(waves[seen], missing[seen], rcond=None)[0] - missing
    return float(np.sqrt((off[~seen] ** 2).sum(1).max()))


def guessed(tube: Tube) -> np.ndarray:
    """(n,) metres, one sigma, of the wall where it is known least: over the gap. From the covariance of centre and
    section, and from the harmonics that are not in the section."""
    table, order = tube.stations, tube.surface.order
    size = 2 * order + 1
    covariance = tube.frames(table["s"], table["piece"])["covariance"].reshape(-1, size, size)
    waves = _waves(order, AROUND)
    variance = np.einsum("tp,npq,tq->nt", waves, covariance, waves, optimize=True).max(1)
    gaps, of = np.unique(np.round(np.degrees(table["gap"])), return_inverse=True)
    leverage = np.array([_leverage(order, math.radians(gap)) for gap in gaps])[of]
    return np.asarray(np.sqrt(np.maximum(0, variance) + (leverage * BEYOND * table["departure"]) ** 2))


def bordered(tube: Tube, among: np.ndarray, without: np.ndarray) -> np.ndarray:
    """(n,) bool: those of stations `among` (n,) where points, but `without` (N,), lie outside the wall on either side
    of the gap, more than gross points elsewhere make likely: the wall goes on there, but not as the section does."""
    p, d = tube.points, tube.summary["d_mean"]
    near = np.flatnonzero((p["piece"] >= 0) & (p["r"] < 0.5 * FAR * d) & ~without)
    near = near[np.argsort(p["s"][near], kind="stable")]
    off, wall = (p["weight"][near] <= 0) & (p["distance"][near] > 0), p["weight"][near] > 0
    out = np.zeros(len(tube.stations["s"]), bool)
    ends = [np.searchsorted(p["s"][near], tube.stations["s"] + away) for away in (-d, d)]
    for k in np.flatnonzero(among):
        first, last = ends[0][k], ends[1][k]
        clock = p["clock"][near[first:last]]
        seen = np.sort(clock[wall[first:last]])
        if len(seen) < LEAST:
            continue
        width = np.diff(np.append(seen, seen[0] + 2 * math.pi))
        gap, start = width.max(), seen[width.argmax()]
        into = (clock[off[first:last]] - start) % (2 * math.pi)
        inside = into < gap
        beside = inside & (np.minimum(into, gap - into) < BORDER)
        chance = (~inside).sum() * min(gap, 2 * BORDER) / (2 * math.pi - gap)
        out[k] = beside.sum() > chance + STRAY * math.sqrt(max(1.0, chance))
    return out


def is_open(tube: Tube) -> np.ndarray:
    """(n,) bool: stations that were measured but for this: the section is no ellipse, and how it goes on where no wall
    is seen is hardly known; half as well is not enough where points beside the gap lie off it."""
    from pipefish.tube_water import mirrored

    table, d = tube.stations, tube.summary["d_mean"]
    measured = np.isin(table["status"], MEASURED)
    beside = measured & (table["gap"] > (HALF_WAVE if tube.surface.order == 2 else 0.0))
    if beside.any():
        beside = bordered(tube, beside, np.zeros(len(tube.points["s"]), bool))
    if beside.any():
        beside = bordered(tube, beside, mirrored(tube, False)[0])
    if tube.surface.order == 2:
        doubt = np.where(beside, 2.0, 0.0)
    else:
        doubt = guessed(tube) / (np.where(beside, 0.5, 1.0) * KNOWN * d)
    # A section is not another one from one station to the next.
    s, doubt = table["s"][measured], doubt[measured]
    ends = zip(np.searchsorted(s, s - d), np.searchsorted(s, s + d, side="right"), strict=True)
    measured[measured] = [np.median(doubt[first:last]) > 1 for first, last in ends]
    return np.asarray(measured, bool)
