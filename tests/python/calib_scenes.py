"""Simulated views of boards for the tests of calibration: a lens, poses around it, noise, outliers, and the truth."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

import pipefish as pf
from pipefish.calibration import View

Array = np.ndarray

RADII = {
    "perspective": np.tan,
    "stereographic": lambda t: 2 * np.tan(t / 2),
    "equidistant": lambda t: t,
    "equisolid": lambda t: 2 * np.sin(t / 2),
    "orthographic": np.sin,
}


@dataclasses.dataclass
class Lens:
    """r(theta) of a classical projection with a little of its own; independent of the library's camera."""

    kind: str
    width: int
    height: int
    f: float
    c: tuple[float, float]
    aspect: float
    k: tuple[float, float]
    end: float  # half the field of view, radians

    def project(self, x: Array) -> tuple[Array, Array]:
        rho = np.hypot(x[:, 0], x[:, 1])
        theta = np.arctan2(rho, x[:, 2])
        safe = np.minimum(theta, self.end)
        r = self.f * (RADII[self.kind](safe) + self.k[0] * safe**3 + self.k[1] * safe**5)
        scale = r / np.maximum(rho, 1e-300)
        pixels = np.stack([self.c[0] + scale * x[:, 0], self.c[1] + self.aspect * scale * x[:, 1]], axis=1)
        inside = ((pixels > 0) & (pixels < [self.width - 1, self.height - 1])).all(axis=1)
        return pixels, (theta <= self.end) & inside


def random_lens(random: np.random.Generator, fov: float | None = None) -> Lens:
    """fov: full angle across the image's width, radians."""
    fov = fov if fov is not None else math.radians(random.uniform(60, 220))
    end = fov / 2
    kinds = ["equidistant", "equisolid", "stereographic"]
    if end < math.radians(55):
        kinds.append("perspective")
    if end < math.radians(75):
        kinds.append("orthographic")
    kind = str(random.choice(kinds))
    width, height = [(1280, 800), (1280, 960), (752, 480), (1920, 1080), (1024, 1024)][random.integers(5)]
    k = (float(random.uniform(-0.015, 0.015)), float(random.uniform(-0.002, 0.002)))
    grid = np.linspace(0.01, end, 200)
    if (np.diff(RADII[kind](grid) + k[0] * grid**3 + k[1] * grid**5) <= 0.002 * (grid[1] - grid[0])).any():
        k = (0.0, 0.0)
    f = width / 2 / float(RADII[kind](np.array(end)) + k[0] * end**3 + k[1] * end**5)
    c = ((width - 1) / 2 + random.normal(0, 0.01 * width), (height - 1) / 2 + random.normal(0, 0.01 * width))
    return Lens(kind, width, height, f, c, 1 + random.normal(0, 0.003), k, end)


def board(cols: int = 11, rows: int = 8, step: float = 0.03) -> Array:
    y, x = np.mgrid[:rows, :cols].reshape(2, -1)
    return np.stack([x * step, y * step, 0 * x], axis=1)


def turn(w: Array) -> Array:
    """Rotation by a vector."""
    angle = float(np.linalg.norm(w))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = w / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k


def random_pose(random: np.random.Generator, points: Array, lens: Lens) -> Array:
    """Board in front of a random place in the field, filling 0.3 to 0.9 of its width, tilted up to 50 degrees."""
    theta = lens.end * math.sqrt(random.uniform(0, 0.85))
    phi = random.uniform(0, 2 * math.pi)
    sight = np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])
    axis = np.cross([0, 0, 1], sight)
    face = turn(axis / max(np.linalg.norm(axis), 1e-12) * theta)
    tilt = random.uniform(0.1, 0.85)
    about = random.uniform(0, 2 * math.pi)
    rotation = (
        face
        @ turn(np.array([math.cos(about), math.sin(about), 0]) * tilt)
        @ turn(np.array([0, 0, random.uniform(0, 2 * math.pi)]))
    )
    size = np.ptp(points, axis=0).max()
    spread = min(lens.end * 1.2, 1.1) * random.uniform(0.35, 0.9)
    distance = size / 2 / math.tan(spread / 2)
    return np.column_stack([rotation, sight * distance - rotation @ points.mean(axis=0)])


def views_of(
    random: np.random.Generator,
    lens: Lens,
    count: int,
    noise: float,
    outliers: float = 0.0,
    points: Array | None = None,
    truth: Array | None = None,
) -> tuple[list[View], list[Array]]:
    """`count` views and their poses; points: as drawn, truth: as they are. Outliers go anywhere within 40 px."""
    points = board() if points is None else points
    real = points if truth is None else truth
    views: list[View] = []
    poses: list[Array] = []
    for _ in range(50 * count):
        pose = random_pose(random, points, lens)
        pixels, seen = lens.project(real @ pose[:, :3].T + pose[:, 3])
        if seen.sum() < max(20, 0.4 * len(points)):
            continue
        noisy = pixels + random.normal(0, noise, pixels.shape)
        wrong = random.uniform(size=len(points)) < outliers
        noisy[wrong] += random.uniform(-40, 40, (int(wrong.sum()), 2))
        seen &= ((noisy >= 0) & (noisy <= [lens.width - 1, lens.height - 1])).all(axis=1)
        views.append(View(points[seen], noisy[seen], name=f"{len(views)}"))
        poses.append(pose)
        if len(views) == count:
            return views, poses
    raise RuntimeError("no poses for this lens")


def bearing_error(camera: pf.Camera, lens: Lens, views: list[View], poses: list[Array]) -> float:
    """RMS angle, radians, between true directions of the points seen and where the camera says that their true pixels
    look, after the best common rotation (which a calibration cannot tell from the poses)."""
    directions, seen = [], []
    for view, pose in zip(views, poses, strict=True):
        x = view.board_xyz @ pose[:, :3].T + pose[:, 3]
        pixels, _ = lens.project(x)
        rays, ok = camera.unproject(pixels)
        directions.append((x / np.linalg.norm(x, axis=1)[:, None])[ok])
        seen.append(rays[ok])
        if ok.mean() < 0.95:
            return math.inf
    a, b = np.concatenate(directions), np.concatenate(seen)
    u, _, vt = np.linalg.svd(a.T @ b)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return float(np.sqrt(np.mean(np.linalg.norm(a - b @ rotation.T, axis=1) ** 2)))
