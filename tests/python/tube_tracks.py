"""Tracks of points on the wall of a tube, in numbers: no pictures, exact truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import pipefish as pf


def fisheye(theta_max: float = 100.0, size: int = 1024, **more: float) -> pf.Camera:
    """A lens of 300 px/rad, its image circle in a square image."""
    half = (size - 1) / 2
    values = {"f_u": 300.0, "f_v": 300.0, "k2": -0.02, "k3": 0.002} | more
    return pf.Camera(width=size, height=size, c_u=half, c_v=half, theta_max=np.radians(theta_max), **values)


def rotation(vector: np.ndarray) -> np.ndarray:
    """The rotation by |vector| about it, (3,3)."""
    angle = np.linalg.norm(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


@dataclass
class Pair:
    """Two views of wall points: rotation and centre of the second view, true pixels, noisy pixels, which are right."""

    camera: pf.Camera
    rotation: np.ndarray
    centre: np.ndarray
    points: np.ndarray
    exact: tuple[np.ndarray, np.ndarray]
    pixels: tuple[np.ndarray, np.ndarray]
    right: np.ndarray


def tube_pair(
    seed: int,
    motion: tuple[float, float, float],
    count: int = 300,
    outliers: float = 0.3,
    sigma: float = 0.3,
    radius: float = 0.15,
    limits: tuple[float, float] = (15.0, 88.0),
    camera: pf.Camera | None = None,
) -> Pair:
    """`count` points of a tube along z, seen in both views between the two angles from the axis (degrees)."""
    random = np.random.default_rng(seed)
    camera = camera or fisheye()
    turn = rotation(random.normal(0, 0.03, 3))
    centre = np.array(motion)
    low, high = np.radians(limits)
    phi, z = random.uniform(0, 2 * np.pi, 50 * count), random.uniform(-0.05, 0.7, 50 * count)
    points = np.column_stack([radius * np.cos(phi), radius * np.sin(phi), z])
    seen = np.ones(len(points), bool)
    for x in (points, (points - centre) @ turn.T):
        theta = np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
        seen &= (low < theta) & (theta < high)
    points = points[seen][:count]
    exact = (camera.project(points)[0], camera.project((points - centre) @ turn.T)[0])
    pixels = tuple(uv + random.normal(0, sigma, uv.shape) for uv in exact)
    right = np.ones(count, bool)
    wrong = random.choice(count, round(outliers * count), replace=False)
    right[wrong] = False
    angle, distance = random.uniform(0, 2 * np.pi, len(wrong)), 300 * np.sqrt(random.uniform(0.02, 1, len(wrong)))
    distance = distance * min(high, np.pi / 2) * 0.95
    pixels[1][wrong] = np.column_stack([np.cos(angle), np.sin(angle)]) * distance[:, None] + [camera.c_u, camera.c_v]
    return Pair(camera, turn, centre, points, exact, pixels, right)


def pair_bound(pair: Pair, sigma: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Cramer-Rao bound of the inliers: covariances of rotation (3,3) and of the unit direction t (3,3), |t| = 1.

    Written here once more, from the projection's derivatives: not the engine's code."""
    length = np.linalg.norm(pair.centre)
    turn, points, centre = pair.rotation, pair.points[pair.right] / length, pair.centre / length
    t = -turn @ centre
    basis = np.linalg.svd(t[None])[2][1:].T
    turned = points @ turn.T
    d1 = pair.camera.project_jacobian(points)[2] / sigma
    d2 = pair.camera.project_jacobian(turned + t)[2] / sigma
    by_rotation = -np.cross(turned[:, None, :], np.eye(3)).transpose(0, 2, 1)
    by_pose = np.zeros((len(points), 4, 5))
    by_pose[:, 2:] = np.concatenate([d2 @ by_rotation, d2 @ basis], axis=2)
    by_point = np.concatenate([d1, d2 @ turn], axis=1)
    across = np.eye(4) - by_point @ np.linalg.pinv(by_point)
    normal = np.einsum("nij,nik,nkl->jl", by_pose, across, by_pose)
    covariance = np.linalg.inv(normal)
    return covariance[:3, :3], basis @ covariance[3:, 3:] @ basis.T


@dataclass
class Drive:
    """A drive through a tube: true poses (K,3,4), points (N,3), tracks with noise, true path length at each frame."""

    camera: pf.Camera
    poses: np.ndarray
    points: np.ndarray
    tracks: pf.Tracks
    driven: np.ndarray
    right: np.ndarray  #: (observations,) in the order of the tracks: not a wrong match

    @property
    def centres(self) -> np.ndarray:
        return -np.einsum("nij,ni->nj", self.poses[:, :, :3], self.poses[:, :, 3])


def tube_drive(
    seed: int,
    length: float = 3.0,
    step: float = 0.05,
    diameter: float = 0.3,
    ovality: float = 0.03,
    density: float = 800.0,
    sigma: float = 0.3,
    limits: tuple[float, float] = (35.0, 89.0),
    wrong: float = 0.0,
    camera: pf.Camera | None = None,
    wobble: float = 1.0,
    bend: float = 0.0,
    pan: float = 0.0,
    joints: float = 0.0,
) -> Drive:
    """Frames every `step` metres; `density` points a metre of wall, seen between two angles from the axis (degrees).

    ovality: (max - min) / diameter, the long axis upright. wrong: share of observations at a random place nearby.
    bend: the tube's curvature, 1/m, to the side. pan: radians that the camera swings to either side, every half metre.
    joints: metres from one open joint, 12 mm wide and 10 mm deep, to the next; the first at 0.3 m.
    """
    random = np.random.default_rng(seed)
    camera = camera or fisheye(95)
    s = np.arange(0.0, length + step / 2, step)
    phase = random.uniform(0, 2 * np.pi, 6)
    sway = wobble * np.column_stack([0.012 * np.sin(6 * s + phase[0]), 0.008 * np.cos(4.6 * s + phase[1]), 0.0 * s])
    angles = wobble * np.column_stack(
        [0.03 * np.sin(5 * s + phase[2]), 0.04 * np.sin(3.1 * s + phase[3]), 0.05 * np.sin(1.3 * s + phase[4])]
    )
    angles[:, 1] += bend * s
    heading = np.cumsum(np.append(0.0, np.full(len(s) - 1, bend * step)))

    def along(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Axis point (n,3) and turn about y (n,) at arc length z of the tube."""
        if bend == 0.0:
            return np.column_stack([0 * z, 0 * z, z]), 0 * z
        return np.column_stack([(1 - np.cos(bend * z)) / bend, 0 * z, np.sin(bend * z) / bend]), bend * z

    def turned(offset: np.ndarray, turn: np.ndarray) -> np.ndarray:
        return np.column_stack([offset[:, 0] * np.cos(turn), offset[:, 1], -offset[:, 0] * np.sin(turn)])

    axis, turn = along(s)
    centres = axis + turned(sway, turn)
    poses = np.zeros((len(s), 3, 4))
    for i in range(len(s)):
        about_y = rotation(np.array([0.0, -heading[i], 0.0]))
        swing = wobble * 0.04 * np.sin(3.1 * s[i] + phase[3]) + pan * np.sin(4 * np.pi * s[i])
        r = rotation(angles[i] * [1, 0, 1] + [0, swing, 0]) @ about_y
        poses[i] = np.column_stack([r, -r @ centres[i]])
    count = int(density * (length + 0.8))
    z, phi = np.sort(random.uniform(-0.1, length + 0.7, count)), random.uniform(0, 2 * np.pi, count)
    a, b = diameter / 2 * (1 - ovality / 2), diameter / 2 * (1 + ovality / 2)
    out = np.zeros(len(z))
    if joints:
        ring = np.arange(0.3, length + 0.6, joints)[:, None] + random.uniform(0, 0.012, (1, 30))
        z, phi = np.append(z, ring.ravel()), np.append(phi, random.uniform(0, 2 * np.pi, ring.size))
        order = np.argsort(z)
        z, phi = z[order], phi[order]
        out = np.where((z > 0.29) & ((z - 0.3) % joints < 0.012), 0.01, 0.0)
    axis, turn = along(z)
    points = axis + turned(np.column_stack([(a + out) * np.cos(phi), (b + out) * np.sin(phi)]), turn)
    low, high = np.radians(limits)
    reach = diameter / 2 / np.tan(low) + 0.1
    frame, track, pixels = [], [], []
    for i in range(len(s)):
        near = np.arange(np.searchsorted(z, s[i] - 0.1), np.searchsorted(z, s[i] + reach))
        seen = points[near] @ poses[i, :, :3].T + poses[i, :, 3]
        theta = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
        uv, ok = camera.project(seen)
        keep = ok & (low < theta) & (theta < high)
        frame.append(np.full(keep.sum(), i))
        track.append(near[keep])
        pixels.append(uv[keep])
    frame, track, pixels = np.concatenate(frame), np.concatenate(track), np.concatenate(pixels)
    pixels = pixels + random.normal(0, sigma, pixels.shape) if sigma else pixels
    order = np.lexsort((frame, track))
    frame, track, pixels = frame[order], track[order], pixels[order]
    right = random.uniform(size=len(frame)) >= wrong
    pixels[~right] += random.normal(0, 15.0, ((~right).sum(), 2))
    driven = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    return Drive(camera, poses, points, pf.Tracks(frame, track, pixels), driven, right)


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation, translation that take `source` (n,3) nearest to `target` (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, d, v = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    turn = u @ sign @ v
    scale = float(np.trace(np.diag(d) @ sign) / (a**2).sum())
    return scale, turn, target.mean(0) - scale * turn @ source.mean(0)
