"""What the points of a tube have in common: errors of the poses from which they were seen.

A surface is fitted with each point's own errors. What neighbours share through the poses does not average out over
them, and makes ovals, steps and bends that are none. It is found as the sectionsigma's diameter is: a figure of the
surface is a linear function of the points around it (the row of a least-squares fit over as many as the surface itself
leans on there), and its variance with the whole covariance, less that with the points' own, is what they share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

MOST = 60  # stations of a tube that are computed; between them it is interpolated
LEAST = 30  # points of a window
TUKEY_VARIANCE = 1.0526  # of the surface's weights: 95 % efficient


@dataclass(frozen=True)
class Shared:
    """own (N,3,3): covariances of the points by themselves; whole(places (n,), jacobian (m,n,3)) -> (m,m): covariance
    of linear functions of some of them with all that they share; camera: likewise, what the camera's own uncertainty
    adds, None where it is not known; ellipse: as much of the variance of what they share counts in ovality."""

    own: np.ndarray
    whole: Callable[[np.ndarray, np.ndarray], np.ndarray]
    camera: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    ellipse: float = 1.0


def _positive(found: np.ndarray) -> np.ndarray:
    """The nearest covariance: differences of two may be a little less than nothing."""
    values, vectors = np.linalg.eigh(0.5 * (found + found.T))
    return (vectors * np.maximum(values, 0)) @ vectors.T


class Common:
    """Covariances of a surface's figures by what its points share; zero where that is not known or too few are there.

    used: places among all points of those that the surface knows."""

    def __init__(self, surface: Any, shared: Shared | None, used: np.ndarray, diameter: float) -> None:
        self.surface, self.shared, self.used, self.diameter = surface, shared, used, diameter
        self.placed = surface.placed() if shared else np.zeros((0, 7))

    def _between(self, piece: int, low: float, high: float) -> np.ndarray:
        p = self.placed
        return np.flatnonzero((p[:, 6] == piece) & (p[:, 5] > 0) & (p[:, 0] >= low) & (p[:, 0] <= high))

    def _rows(self, on: np.ndarray, at: float | None = None) -> np.ndarray:
        """(k,n,3) derivatives by the points of the fit of radius, centre, ellipse and, with `at`, of the centre's
        change along the pipe; all at `at`."""
        s, angle, sigma, weight = (self.placed[on, k] for k in (0, 1, 4, 5))
        c, d = np.cos(angle), np.sin(angle)
        columns = [np.ones(len(on)), c, d, np.cos(2 * angle), np.sin(2 * angle)]
        if at is not None:
            columns += [(s - at) * c, (s - at) * d]
        rows = np.column_stack(columns)
        weighed = rows * (weight / sigma**2)[:, None]
        solved = np.linalg.lstsq(rows.T @ weighed, weighed.T, rcond=1e-9)[0]
        frame = self.surface.stations(s.tolist(), self.placed[on, 6].astype(int).tolist())
        return solved[:, :, None] * (c[:, None] * frame["first"] + d[:, None] * frame["second"])

    def _covariance(self, on: np.ndarray, rows: np.ndarray) -> np.ndarray:
        assert self.shared is not None
        places = self.used[on]
        found = self.shared.whole(places, rows) - np.einsum("anj,njk,bnk->ab", rows, self.shared.own[places], rows)
        return _positive(found)

    def ellipses(self, s: np.ndarray, piece: np.ndarray, variance: np.ndarray, known: np.ndarray) -> np.ndarray:
        """(2,n,2,2) of the ellipse's two parameters at stations s (n,): what the points share, what the camera adds;
        variance (n,): of one of them, as the surface has it; known (n,) bool: where there is an ellipse."""
        out = np.zeros((2, len(s), 2, 2))
        if self.shared is None:
            return out
        for k in np.unique(piece[known]):
            here = np.flatnonzero(known & (piece == k))
            chosen = here[np.unique(np.linspace(0, len(here) - 1, min(len(here), MOST)).round().astype(int))]
            all_of = self._between(int(k), -np.inf, np.inf)
            information = self.placed[all_of, 5] / self.placed[all_of, 4] ** 2
            information /= TUKEY_VARIANCE * self.surface.correlation
            places, values = [], []
            for i in chosen:
                away = np.abs(self.placed[all_of, 0] - s[i])
                order = np.argsort(away, kind="stable")
                enough = int(np.searchsorted(np.cumsum(information[order]), 2 / variance[i])) + 1
                enough = max(enough, int((away < 0.375 * self.diameter).sum()))
                if enough >= LEAST:
                    on = all_of[order[:enough]]
                    places.append(s[i])
                    near, rows = self._ellipse_rows(on)
                    camera = self.shared.camera(self.used[near], rows) if self.shared.camera else np.zeros((2, 2))
                    values.append((self.shared.ellipse * self._covariance(near, rows), _positive(camera)))
            if places:
                table = np.array(values)
                for part, a, b in np.ndindex(2, 2, 2):
                    out[part, here, a, b] = np.interp(s[here], places, table[:, part, a, b])
        return out

    def _ellipse_rows(self, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and derivatives (2,n,3) of their common ellipse, each section with a centre and a size of its own: the
        surface's axis follows where the poses wander."""
        s = self.placed[on, 0]
        count = max(1, round((s.max() - s.min()) / (0.75 * self.diameter)))
        number = np.minimum(count - 1, ((s - s.min()) / (np.ptp(s) / count + 1e-12)).astype(int))
        parts = [on[number == k] for k in range(count)]
        parts = [p for p in parts if len(p) >= LEAST] or [on]
        rows = [self._rows(p, float(self.placed[p, 0].mean()))[3:5] * (len(p) / sum(map(len, parts))) for p in parts]
        return np.concatenate(parts), np.concatenate(rows, axis=1)

    def joint(self, k: int) -> np.ndarray:
        """(5,5) at the end of piece k: step across (2), growth of the radius, kink (2), a diameter each way."""
        s = float(self.surface.pieces[k][1])
        before, after = self._between(k, s - self.diameter, s), self._between(k + 1, s, s + self.diameter)
        if self.shared is None or min(len(before), len(after)) < LEAST:
            return np.zeros((5, 5))
        order = [1, 2, 0, 5, 6]
        rows = np.concatenate([-self._rows(before, s)[order], self._rows(after, s)[order]], axis=1)
        return self._covariance(np.concatenate([before, after]), rows)

    def turn(self, piece: int, ends: tuple[float, float], density: float) -> float:
        """Variance of the angle between the axis at two places of a piece, radians^2; density: variance of the tangent
        there, as the surface has it, which says over how long a stretch it leans on points."""
        if self.shared is None:
            return 0.0
        frame = self.surface.stations(list(ends), [piece, piece])
        t = frame["tangent"]
        across = np.cross(t[0], t[1])
        size = np.linalg.norm(across)
        if size < 1e-9:
            return 0.0
        parts, rows = [], []
        for k, sign in ((0, -1.0), (1, 1.0)):
            on = self._between(piece, ends[k] - self.diameter, ends[k] + self.diameter)
            if len(on) < LEAST:
                return 0.0
            on = self._as_long(on, ends[k], density)
            towards = np.cross(across / size, t[k])
            slope = self._rows(on, ends[k])[5:7]
            weights = np.array([towards @ frame["first"][k], towards @ frame["second"][k]])
            parts.append(on)
            rows.append(sign * np.tensordot(weights, slope, 1)[None])
        on = np.concatenate(parts)
        places, back = np.unique(on, return_inverse=True)
        row = np.zeros((1, len(places), 3))
        np.add.at(row[0], back, np.concatenate(rows, axis=1)[0])
        return float(self._covariance(places, row)[0, 0])

    def _as_long(self, on: np.ndarray, at: float, variance: float) -> np.ndarray:
        """Those nearest to `at` over a stretch that tells the axis' direction with that variance, half a diameter at
        least: slopes of n points of sigma over a length l have 24 sigma^2 / (n l^2)."""
        s = self.placed[on, 0]
        low, high = float(s.min()), float(s.max())
        information = float((self.placed[on, 5] / self.placed[on, 4] ** 2).sum()) / (high - low)
        information /= TUKEY_VARIANCE * self.surface.correlation
        length = np.clip((24 / (information * variance)) ** (1 / 3), 0.5 * self.diameter, 2 * self.diameter)
        start = np.clip(at - length / 2, low, max(low, high - length))
        inside = on[(s >= start) & (s <= start + length)]
        return inside if len(inside) >= LEAST else on


def alike(surface: Any) -> int:
    """So many neighbouring points of a surface tell the same."""
    return max(1, round(surface.correlation * surface.thinning))
