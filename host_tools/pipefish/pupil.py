"""What a pupil shift that a profile does not know leaves open in the diameter.

A fisheye's entrance pupil moves along the axis with the angle, by millimetres: rays start at (0, 0, e1 theta^2)
(docs/profile.md). A profile that says nothing of it takes them as from one point. Between two
sights of a place, the encoder's way between them known, its distance R from the axis follows from
R (cot theta_1 - cot theta_2) = way - e1 (theta_1^2 - theta_2^2), so R is off by a share that no residual shows."""

from __future__ import annotations

import math

import numpy as np

from .assumed import PUPIL_MOST, PUPIL_REST
from .camera import Camera
from .intervals import Z95


def pupil_is_known(camera: Camera) -> bool:
    """Whether the profile says how well it knows its pupil's shift: then that is in the camera's covariance."""
    return camera.covariance is not None and "pupil_e1" in camera.covariance_parameters


def shift_sigma(camera: Camera) -> float:
    """Metres of e1 that the profile leaves open."""
    if not pupil_is_known(camera):
        return PUPIL_MOST / Z95
    assert camera.covariance is not None
    place = camera.covariance_parameters.index("pupil_e1")
    return math.hypot(PUPIL_REST, math.sqrt(max(0.0, float(camera.covariance[place, place]))))


def diameter_slope(theta: np.ndarray, point: np.ndarray, radius: float) -> float:
    """Share by which a diameter changes for each metre of e1 that is left out. theta (N,): angles from the axis under
    which the points (N,) were seen, radius: of the pipe, metres. Least squares over each point's sights with even noise
    of the angles, as pixels of a fisheye have it."""
    weight = np.sin(theta) ** 4
    values = np.stack([1 / np.tan(theta), theta**2])
    total = np.maximum(np.bincount(point, weight), 1e-300)
    ahead, shift = (v - (np.bincount(point, weight * v) / total)[point] for v in values)
    return float((weight * ahead * shift).sum() / (weight * ahead**2).sum() / radius)


def pupil_sigma(camera: Camera, theta: np.ndarray, point: np.ndarray, radius: float) -> float:
    """Relative sigma of a diameter by a shift within PUPIL_MOST (95 %); 0 where the profile tells its own."""
    return 0.0 if pupil_is_known(camera) else PUPIL_MOST / Z95 * abs(diameter_slope(theta, point, radius))
