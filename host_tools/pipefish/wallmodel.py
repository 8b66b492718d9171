"""A fitted tube as rings of wall points: fast both ways between places (s, clock) and points. Lengths as given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipefish.camera import Camera
from pipefish.errors import ArgumentError
from pipefish.matching import Seeds

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WallModel:
    """One piece of a tube between two joints, or a tube without joints.

    rings   (n,m,3): ring by ring, wall points at m equal steps of the clock from twelve o'clock on, clockwise looking
            along increasing s, as Tube.mesh() gives them

    The axis is the line through the rings' means. Places between rings: cubic along the axis, linear in the radius."""

    rings: Floats

    def __post_init__(self) -> None:
        rings = np.asarray(self.rings, float)
        if rings.ndim != 3 or rings.shape[0] < 2 or rings.shape[1] < 8 or rings.shape[2] != 3:
            raise ArgumentError(f"rings: shape {rings.shape} is not (2 or more, 8 or more, 3)")
        if not np.isfinite(rings).all():
            raise ArgumentError("rings: not finite")
        centre = rings.mean(axis=1)
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centre, axis=0), axis=1))])
        if not (np.diff(s) > 0).all():
            raise ArgumentError("rings: two at one place")
        slope = np.gradient(centre, s, axis=0)
        tangent = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        up = rings[:, 0] - centre
        up -= np.einsum("ni,ni->n", up, tangent)[:, None] * tangent
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        right = np.cross(tangent, up)
        off = rings - centre[:, None]
        a, b = np.einsum("nmi,ni->nm", off, up), np.einsum("nmi,ni->nm", off, right)
        angles = np.arange(rings.shape[1] + 1) * 2 * np.pi / rings.shape[1]
        radius = np.empty((len(rings), len(angles)))
        for k, (angle, r) in enumerate(zip(np.arctan2(b, a), np.hypot(a, b), strict=True)):
            radius[k] = np.interp(angles, angle, r, period=2 * np.pi)
        for name, value in {"s": s, "centre": centre, "slope": slope, "up": up, "radii": radius}.items():
            object.__setattr__(self, "_" + name, value)

    @property
    def length(self) -> float:
        """Along the axis."""
        return float(self._s[-1])

    @property
    def mean_radius(self) -> float:
        """Of all the wall."""
        return float(self._radii[:, :-1].mean())

    def frames(self, s: Any) -> tuple[Floats, Floats, Floats, Floats]:
        """Of each s (n,): the axis's point, its tangent, twelve and three o'clock, all (n,3). Straight on beyond the
        ends."""
        s = np.asarray(s, float)
        k = np.clip(np.searchsorted(self._s, s, side="right") - 1, 0, len(self._s) - 2)
        h = (self._s[k + 1] - self._s[k])[:, None]
        t = (np.clip(s, 0, self.length) - self._s[k])[:, None] / h
        c0, c1, d0, d1 = self._centre[k], self._centre[k + 1], h * self._slope[k], h * self._slope[k + 1]
        centre = c0 + t * (d0 + t * (3 * (c1 - c0) - 2 * d0 - d1 + t * (2 * (c0 - c1) + d0 + d1)))
        tangent = d0 + t * (6 * (c1 - c0) - 4 * d0 - 2 * d1 + t * 3 * (2 * (c0 - c1) + d0 + d1))
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        centre += (s - np.clip(s, 0, self.length))[:, None] * tangent
        up = (1 - t) * self._up[k] + t * self._up[k + 1]
        up -= np.einsum("ni,ni->n", up, tangent)[:, None] * tangent
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        return centre, tangent, up, np.cross(tangent, up)

    def radius(self, s: Any, clock: Any) -> Floats:
        """Of the wall at places s (n,), clock (n,)."""
        s, columns = np.clip(np.asarray(s, float), 0, self.length), self._radii.shape[1] - 1
        k = np.clip(np.searchsorted(self._s, s, side="right") - 1, 0, len(self._s) - 2)
        t = (s - self._s[k]) / (self._s[k + 1] - self._s[k])
        angle = np.asarray(clock, float) / (2 * np.pi) % 1 * columns
        j = np.minimum(angle.astype(int), columns - 1)
        u = angle - j
        near = (1 - u) * self._radii[k, j] + u * self._radii[k, j + 1]
        return (1 - t) * near + t * ((1 - u) * self._radii[k + 1, j] + u * self._radii[k + 1, j + 1])

    def points(self, s: Any, clock: Any, deviation: Any = 0.0) -> Floats:
        """Wall points (n,3) at places s (n,), clock (n,), so much outside the wall."""
        centre, _, up, right = self.frames(s)
        clock = np.asarray(clock, float)
        out = np.cos(clock)[:, None] * up + np.sin(clock)[:, None] * right
        return centre + (self.radius(s, clock) + deviation)[:, None] * out

    def locate(self, points: Any, start: Any = None) -> tuple[Floats, Floats, Floats]:
        """s, clock and distance outside the wall (radially), each (n,), of points (n,3) near it. start (n,): s to
        begin with [the nearest ring's]."""
        points = np.asarray(points, float)
        if start is None:
            start = np.empty(len(points))
            for k in range(0, len(points), 4096):
                far = np.linalg.norm(points[k : k + 4096, None] - self._centre[None], axis=2)
                start[k : k + 4096] = self._s[far.argmin(axis=1)]
        s = np.asarray(start, float).copy()
        for _ in range(20):  # each step leaves what the axis bends over it
            centre, tangent, up, right = self.frames(s)
            off = points - centre
            step = np.einsum("ni,ni->n", off, tangent)
            s += step
            if not np.abs(step).max(initial=0) > 1e-6 * self.mean_radius:
                break
        a, b = np.einsum("ni,ni->n", off, up), np.einsum("ni,ni->n", off, right)
        clock = np.arctan2(b, a) % (2 * np.pi)
        return s, clock, np.hypot(a, b) - self.radius(s, clock)


def seen_on_wall(wall: WallModel, camera: Camera, pose: Floats, pixels: Any) -> Floats:
    """(n,3) places of the wall that pixels (n,2) of a keyframe show; NaN where their rays do not meet it within its
    length. pose: (3,4) cam_from_world."""
    rays, ok = camera.unproject(pixels)
    rotation = pose[:, :3]
    start = (camera.origins(pixels) - pose[:, 3]) @ rotation
    rays = np.where(ok[:, None], rays, [0.0, 0, 1]) @ rotation
    far = np.full(len(rays), wall.mean_radius)
    s = off = None
    for _ in range(25):  # a ray meets the wall once from inside: Newton's steps, from within
        point = start + far[:, None] * rays
        s, clock, off = wall.locate(point, s)
        _, _, up, right = wall.frames(s)
        slope = np.einsum("ni,ni->n", rays, np.cos(clock)[:, None] * up + np.sin(clock)[:, None] * right)
        far = np.clip(far - off / np.where(slope > 0.05, slope, 0.05), 0, 20 * wall.mean_radius)
    good = ok & (np.abs(off) < 1e-4 * wall.mean_radius) & (s >= 0) & (s <= wall.length) & (far > 0)
    return np.where(good[:, None], start + far[:, None] * rays, np.nan)


def predicted_seeds(wall: WallModel, camera: Camera, pose1: Floats, pose2: Floats, pixels: Any) -> Seeds:
    """Seeds for match_quasi_dense between two raw keyframes: pixels (n,2) of the first, where the wall takes them in
    the second, and the affine map between the surroundings, by differences over a pixel; those that both see."""
    pixels = np.ascontiguousarray(pixels, float).reshape(-1, 2)
    offsets = ([0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5])
    points = seen_on_wall(wall, camera, pose1, np.concatenate([pixels + np.array(d) for d in offsets]))
    there, ok = camera.project(np.nan_to_num(points) @ pose2[:, :3].T + pose2[:, 3])
    ok &= np.isfinite(points[:, 0]) & camera.in_image(there)
    there, ok = there.reshape(5, -1, 2), ok.reshape(5, -1).all(axis=0)
    affine = np.stack([there[1] - there[2], there[3] - there[4]], axis=2)
    return Seeds(pixels[ok], there[0][ok], affine[ok])
