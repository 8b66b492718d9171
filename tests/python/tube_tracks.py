"""Tracks of points on the wall of a tube, in numbers: no pictures, exact truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import pipefish as pf


def fisheye(theta_max: float = 100.0, size: int = 1024, **more: float) -> pf.Camera:
    """A lens of 300 px/rad, its image circle in a square image."""
    half = (size - 1) / 2
    values = {"k2": -0.02, "k3": 0.002} | more
    return pf.Camera(
        width=size, height=size, f_u=300.0, f_v=300.0, c_u=half, c_v=half, theta_max=np.radians(theta_max), **values
    )


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
