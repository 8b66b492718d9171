"""Point clouds of pipes with exact truth, made without the fitter: the wall is walked along straights and arcs and its
sections are drawn in polar coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Pipe:
    """A pipe that starts at the origin along z, up is -y. Clock angles: radians clockwise, twelve o'clock up."""

    diameter: float = 0.3
    length: float = 3.0
    ovality: float = 0.0  # (d_max - d_min) / (their mean), at the start; `ovality_end` at the end
    ovality_end: float | None = None
    clock_max: float = 0.6
    egg: float = 0.0  # third harmonic of the radius, relative
    bend: tuple[float, float, float] | None = None  # start (m), angle (rad), radius (m); turns to the right (+x)
    joint: tuple[float, float, float] | None = None  # chainage, step up (m), kink to the right (rad)
    ring: tuple[float, float] | None = None  # chainage, width of a gap: points there lie 20 mm outside
    deposit: tuple[float, float, float, float] | None = None  # chainage, clock, diameter, height
    noise: float = 0.0015
    roughness: float = 0.0
    waves: tuple[float, float] = (1.0, 0.0)  # relief: about so long (m), rms height (m), in all directions
    outliers: float = 0.0
    cover: float = 2 * math.pi  # azimuth seen, centred at twelve o'clock
    seed: int = 0
    tilt: np.ndarray = field(default_factory=lambda: np.eye(3))

    def axis(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (n,3) of the axis, and the heading angle (n,) towards +x."""
        start, angle, radius = self.bend or (math.inf, 0.0, 1.0)
        turned = np.clip((s - start) / radius, 0, angle) if self.bend else np.zeros_like(s)
        inside = np.minimum(s, start) if self.bend else s
        after = np.maximum(0, s - start - angle * radius) if self.bend else np.zeros_like(s)
        x = radius * (1 - np.cos(turned)) + after * math.sin(angle)
        z = inside + radius * np.sin(turned) + after * math.cos(angle)
        points = np.column_stack([x, np.zeros_like(s), z])
        heading = turned.copy()
        if self.joint:
            at, step, kink = self.joint
            past = s > at
            points[past] += np.column_stack(
                [np.sin(kink) * (s - at), np.full(len(s), -step), (np.cos(kink) - 1) * (s - at)]
            )[past]
            heading[past] += kink
        return points, heading

    def radius(self, s: np.ndarray, clock: np.ndarray) -> np.ndarray:
        """Distance of the clean wall from the axis."""
        end = self.ovality if self.ovality_end is None else self.ovality_end
        oval = self.ovality + (end - self.ovality) * s / self.length
        a, b = self.diameter / 2 * (1 + oval / 2), self.diameter / 2 * (1 - oval / 2)
        t = clock - self.clock_max
        r = a * b / np.sqrt((b * np.cos(t)) ** 2 + (a * np.sin(t)) ** 2)
        r = r + self.egg * self.diameter / 2 * np.cos(3 * clock)
        if self.waves[1]:
            rng = np.random.default_rng(self.seed + 999)
            for _ in range(60):
                # A whole number of waves around, the rest of the wave number along.
                wave = 2 * np.pi / (self.waves[0] * math.exp(rng.normal(0, 0.3)))
                turns = rng.integers(0, int(wave * self.diameter / 2) + 1)
                along = math.sqrt(max(0.0, wave**2 - (2 * turns / self.diameter) ** 2))
                r = r + self.waves[1] * math.sqrt(2 / 60) * np.cos(
                    along * s + turns * clock + rng.uniform(0, 2 * np.pi)
                )
        if self.deposit:
            at, where, size, height = self.deposit
            away = np.hypot(s - at, ((clock - where + np.pi) % (2 * np.pi) - np.pi) * self.diameter / 2) / (size / 2)
            r = r - height * np.sqrt(np.maximum(0, 1 - away**2))
        if self.ring:
            r = r + np.where(np.abs(s - self.ring[0]) < self.ring[1] / 2, 0.02, 0.0)
        return r

    def points(self, count: int) -> np.ndarray:
        """(count,3): even over s and clock, with noise, roughness and gross points."""
        rng = np.random.default_rng(self.seed)
        s = rng.uniform(0, self.length, count)
        clock = rng.uniform(-self.cover / 2, self.cover / 2, count)
        r = self.radius(s, clock) + rng.normal(0, self.roughness, count) * (self.roughness > 0)
        axis, heading = self.axis(s)
        right = np.column_stack([np.cos(heading), np.zeros(count), -np.sin(heading)])
        up = np.array([0.0, -1.0, 0.0])
        wall = axis + r[:, None] * (np.cos(clock)[:, None] * up + np.sin(clock)[:, None] * right)
        wall += rng.normal(0, self.noise, (count, 3))
        gross = rng.random(count) < self.outliers
        n = int(gross.sum())
        wall[gross] = axis[gross] + rng.uniform(-1.2, 1.2, (n, 3)) * self.diameter
        far = rng.random(n) < 0.1
        wall[np.flatnonzero(gross)[far]] += rng.normal(0, 20, (int(far.sum()), 3))
        return np.ascontiguousarray(wall @ self.tilt.T)

    def cameras(self, step: float = 0.05) -> np.ndarray:
        """A path off the axis."""
        s = np.arange(0, self.length, step)
        return (self.axis(s)[0] + self.diameter * np.array([0.05, 0.1, 0.0])) @ self.tilt.T
