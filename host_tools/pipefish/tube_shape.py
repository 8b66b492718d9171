"""Sections that are no ellipse: an egg's crown is a circle, and a fit that begins with the best circle ends there.

So where much of the wall lies off it all along the pipe, the surface is fitted a second time from the circle that all
points ask for together, however badly it suits them, and the likelier of the two counts. Where such a section is not
seen all around, nothing tells what it is: the invert of an egg is not where its crown's circle has it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pipefish.tube import Tube

OFF = 0.03  # of the points of half of all windows: more off the wall, and another one is tried
FAR = 2.5  # radii: what is further away is not this wall
WIDE = 0.15  # radii: how far a section may be from a circle and still be led by it
ROUNDS = 20
LEAST = 20  # points of a window
SURE = 10.0  # of the likelihood's logarithm
NO_ELLIPSE = 0.0025  # of the diameter, of a departure: it makes diameters 0.5 % larger or smaller
# Of the departure: what the egg of 2 to 3 has beyond the sixth harmonic is up to 8 % of what it has up to it.
BEYOND = 0.1
EVEN = 1.1  # nine of ten circles over one of ten: wider than joints, eggs and wear make it


def much_off(tube: Tube) -> bool:
    """Whether more than a few points are off the wall all along the pipe, not only at a heap or a branch."""
    p, d = tube.points, tube.summary["d_mean"]
    near = (p["piece"] >= 0) & (p["r"] < 0.5 * FAR * d)
    window = (p["s"][near] / d).astype(int)
    count = np.bincount(window)
    off = np.bincount(window, p["weight"][near] <= 0)
    return bool((off > OFF * count)[count > 0].mean() > 0.5)


def wide_circles(cloud: np.ndarray, tube: Tube, count: int) -> tuple[np.ndarray, list[float]]:
    """Centres (count,3) and radii along the tube of circles through all points around it: Cauchy weights."""
    p, d = tube.points, tube.summary["d_mean"]
    known = np.flatnonzero((p["piece"] >= 0) & (p["r"] < 0.5 * FAR * d))
    s = np.linspace(0, tube.length, count)
    frame = tube.frames(s)
    nodes, radii = frame["centre"].copy(), np.full(count, 0.5 * d)
    for k in range(count):
        rows = known[np.abs(p["s"][known] - s[k]) < d]
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


def likelier(other: Tube, first: Tube) -> bool:
    """Whether the other tube explains the points better than the first one, water that mirrors its wall included, and
    by more than its section's parameters cost (BIC)."""
    from pipefish.tube_water import mirrored

    width = FAR * first.summary["d_mean"]
    both = (first.points["piece"] >= 0) & (other.points["piece"] >= 0)
    among = np.flatnonzero(both & (first.points["r"] < 0.5 * width))
    if len(among) < LEAST:
        return False
    wet = mirrored(first, False)[0]
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


def is_open(tube: Tube) -> np.ndarray:
    """(n,) bool: stations whose section is no ellipse and shows less than would tell what it is: a whole wave of the
    highest harmonic has room where there are no points, or half of one where points lie off it all along."""
    table, order = tube.stations, tube.surface.order
    room = 2 * math.pi / order / (2 if much_off(tube) else 1)
    open_ = (order > 2) & (table["departure"] > NO_ELLIPSE * tube.summary["d_mean"]) & (table["gap"] > room)
    return np.asarray(open_ & (table["status"] == "ok"))
