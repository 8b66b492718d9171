"""Random set-ups for self-calibration, general and degenerate. The lenses are formulas of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

KINDS = ("perspective", "wide", "fisheye", "mirror")
DEGENERATE = ("no_rotation", "axial", "planar", "low_coverage")


@dataclass
class Lens:
    """r = f radius(theta) about a centre; rays up to theta_max. Pixels are square."""

    width: int
    height: int
    f: float
    centre: np.ndarray
    theta_max: float
    radius: Callable[[np.ndarray], np.ndarray]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,3) -> pixels (n,2), inside the picture and the field (n,)."""
        theta = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
        phi = np.arctan2(points[:, 1], points[:, 0])
        r = self.f * self.radius(np.minimum(theta, self.theta_max))
        uv = self.centre + r[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
        inside = (uv > -0.5).all(axis=1) & (uv < np.array([self.width, self.height]) - 0.5).all(axis=1)
        return uv, inside & (theta < self.theta_max)

    def rays(self, uv: np.ndarray) -> np.ndarray:
        """(n,2) -> unit rays (n,3); NaN beyond theta_max."""
        out = uv - self.centre
        r, phi = np.linalg.norm(out, axis=1) / self.f, np.arctan2(out[:, 1], out[:, 0])
        theta = np.linspace(0, self.theta_max, 40001)
        angle = np.interp(r, self.radius(theta), theta, right=np.nan)
        return np.column_stack([np.sin(angle) * np.cos(phi), np.sin(angle) * np.sin(phi), np.cos(angle)])


def random_lens(kind: str, random: np.random.Generator) -> Lens:
    """A lens of the kind, its centre off the picture's by half a per cent of the width (one sigma)."""
    width, height = 1280, 960
    centre = np.array([width - 1, height - 1]) / 2 + random.normal(0, 0.005 * width, 2)
    if kind == "perspective":  # 50 to 80 degrees across, with a little of Brown's k1
        f = width / 2 / np.tan(np.radians(random.uniform(25, 40)))
        bend = random.uniform(-0.03, 0.01)
        return Lens(width, height, f, centre, np.radians(52), lambda t: np.tan(t) * (1 + bend * np.tan(t) ** 2))
    if kind == "wide":  # 100 to 130 degrees across: between stereographic and equidistant
        half, s = np.radians(random.uniform(50, 65)), random.uniform(0.2, 0.5)
        f = width / 2 * s / np.tan(s * half)
        return Lens(width, height, f, centre, np.radians(92), lambda t: np.tan(s * t) / s)
    if kind == "fisheye":  # 185 degrees as a circle in the picture, equidistant to equisolid, and bent
        end, s = np.radians(92.5), random.uniform(0.1, 0.5)
        bend = random.uniform(-0.01, 0.01)

        def radius(t: np.ndarray) -> np.ndarray:
            x = (t / end) ** 2
            return np.sin(s * t) / s * (1 + bend * x * (1 - x))

        return Lens(width, height, random.uniform(0.42, 0.48) * height / float(radius(end)), centre, end, radius)
    mirror, end = random.uniform(0.7, 1.0), np.radians(random.uniform(98, 108))

    def unified(t: np.ndarray) -> np.ndarray:
        return (mirror + 1) * np.sin(t) / (mirror + np.cos(t))

    return Lens(width, height, random.uniform(0.44, 0.49) * height / float(unified(end)), centre, end, unified)


@dataclass
class Setup:
    """Pairs of a lens: (n,2) and (n,2) pixels each, which are right (n,), cam2_from_cam1 (3,4)."""

    kind: str
    lens: Lens
    noise: float
    outliers: float
    pairs: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    right: list[np.ndarray] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)


def _turn(vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def _motion(case: str, lens: Lens, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of the second view; the scene begins at a distance of 2."""
    tilt = random.uniform(15, 40) if lens.theta_max < 1 else random.uniform(20, 60)
    about = random.uniform(0, 2 * np.pi)
    across = np.radians(tilt) * np.array([np.cos(about), np.sin(about), 0])
    roll = np.array([0, 0, np.radians(random.uniform(-20, 20))])
    where = random.normal(size=3) * [1, 1, 0.5 if lens.theta_max < 1 else 1]
    where *= random.uniform(0.6, 1.4) / np.linalg.norm(where)
    if case == "no_rotation":
        sideways = random.uniform(0, 2 * np.pi)
        return _turn(roll * random.integers(0, 2)), np.array(
            [np.cos(sideways), np.sin(sideways), random.uniform(-1, 1)]
        )
    if case == "axial":
        return _turn(roll * random.integers(0, 2)), np.array([0, 0, -random.uniform(0.8, 1.5)])
    if lens.theta_max < 1:  # look at the same scene from elsewhere
        r = _turn(across) @ _turn(roll)
        target = np.array([0, 0, 4.0])
        return r, target - r @ target + 0.7 * where
    r = _turn(across) @ _turn(roll)
    return r, -r @ where


def _points(case: str, lens: Lens, random: np.random.Generator, count: int) -> np.ndarray:
    """Points of the scene before the first camera, all around for a wide field."""
    if case == "planar":
        normal = _turn(np.append(random.normal(0, 0.35, 2), 0)) @ np.array([0, 0, 1.0])
        e1 = np.cross(normal, [0, 1.0, 0])
        e1 /= np.linalg.norm(e1)
        across = random.uniform(-1, 1, (count, 2)) * (3.0 if lens.theta_max < 1 else 8.0)
        return 3.0 * np.array([0, 0, 1.0]) + across[:, :1] * e1 + across[:, 1:] * np.cross(normal, e1)
    if case == "low_coverage":
        angle, about = random.uniform(0, 0.5 * min(lens.theta_max, 1.2)), random.uniform(0, 2 * np.pi)
        size = 0.06 * min(lens.theta_max, 1.6)
        theta_phi = random.uniform(-size, size, (count, 2))
        ray = np.column_stack([theta_phi, np.ones(count)])
        ray = ray @ (_turn(angle * np.array([np.cos(about), np.sin(about), 0]))).T
        return ray / np.linalg.norm(ray, axis=1)[:, None] * random.uniform(2.0, 8.0, (count, 1))
    cosine = random.uniform(np.cos(lens.theta_max), 1, count)
    phi, sine = random.uniform(0, 2 * np.pi, count), np.sqrt(1 - cosine**2)
    ray = np.column_stack([sine * np.cos(phi), sine * np.sin(phi), cosine])
    return ray * random.uniform(2.0, 8.0, (count, 1))


def make_setup(
    seed: int,
    kind: str,
    case: str = "general",
    pairs: int = 1,
    noise: float | None = None,
    outliers: float | None = None,
    points: int | None = None,
) -> Setup:
    """Noise .2 to 1 px, 0 to 40 % outliers (uniform over the picture) and 100 to 500 matches a pair unless given."""
    random = np.random.default_rng([seed, KINDS.index(kind)])
    lens = random_lens(kind, random)
    noise = random.uniform(0.2, 1.0) if noise is None else noise
    outliers = random.uniform(0, 0.4) if outliers is None else outliers
    out = Setup(kind, lens, noise, outliers)
    while len(out.pairs) < pairs:
        count = random.integers(100, 501) if points is None else points
        r, t = _motion(case, lens, random)
        if case == "low_coverage":  # the second camera still sees the patch
            x = _points(case, lens, random, count)
            middle = x.mean(axis=0)
            r = _turn(random.normal(0, np.radians(4), 3))
            t = middle - r @ middle + 0.5 * random.normal(size=3)
        else:
            x = _points(case, lens, random, 60 * count)
        one, see1 = lens.project(x)
        two, see2 = lens.project(x @ r.T + t)
        both = np.flatnonzero(see1 & see2)[:count]
        if len(both) < min(count, 80 if case == "low_coverage" else count):
            continue
        a = one[both] + random.normal(0, noise, (len(both), 2))
        b = two[both] + random.normal(0, noise, (len(both), 2))
        wrong = random.uniform(size=len(both)) < outliers
        b[wrong] = random.uniform(0, [lens.width, lens.height], (int(wrong.sum()), 2))
        out.pairs.append((a, b))
        out.right.append(~wrong)
        out.poses.append(np.column_stack([r, t]))
    return out


def bearing_error(camera: object, lens: Lens, radius: float) -> float:
    """Largest angle, radians, between the rays of a camera and the true ones within `radius` px of the camera's
    centre (and the picture), after the best common rotation."""
    u, v = np.meshgrid(np.arange(0, lens.width, 20.0), np.arange(0, lens.height, 20.0))
    uv = np.column_stack([u.ravel(), v.ravel()])
    uv = uv[np.hypot(*(uv - [camera.c_u, camera.c_v]).T) < radius]
    true = lens.rays(uv)
    known = np.isfinite(true).all(axis=1)
    found, ok = camera.unproject(uv[known])
    if not ok.all():
        return float("inf")
    true = true[known]
    u_, _, vt = np.linalg.svd(found.T @ true)
    r = u_ @ np.diag([1, 1, np.linalg.det(u_ @ vt)]) @ vt
    return float(np.arcsin(np.minimum(1, np.linalg.norm(np.cross(found, true @ r.T), axis=1).max())))
