"""What a good profile does not know of its lens's radius: ripples about the polynomial.

A calibration's covariance holds its noise. What the model's family cannot follow is not in it: zones of the glass,
and a pupil that moves otherwise than e1 theta^2, which from the axis of a pipe is one more curve over the angle."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .camera import Camera

Floats = npt.NDArray[np.float64]

#: Pixels, and the angle over which they change. Three directions of drift are radial curves that are nearly alike, so
#: that 0.07 px of ripple look like 1.7 % of the angle scale with 1 % along alpha and a bend, to a sigma of 0.4 %; and a
#: tenth of a pixel that all tracks share tapers a DN150 by per cents where vision outvotes the encoder.
LENS_RADIAL_PX, LENS_LENGTH = 0.1, 0.4
RADIAL = ("f_u", "f_v", "k2", "k3", "k4", "k5")


def radial_slope(camera: Camera, theta: Floats) -> Floats:
    """(N,5): how the radius at angles (N,) from the axis, in units of f, answers to ln f and k2 to k5."""
    powers = theta[:, None] ** np.array([3, 5, 7, 9])
    return np.column_stack([theta + powers @ [camera.k2, camera.k3, camera.k4, camera.k5], powers])


def radial_fit(camera: Camera, theta: Floats) -> Floats:
    """(5,N): change of ln f and k2 to k5 by a change of the radius, in units of f, at angles (N,)."""
    design = radial_slope(camera, theta)
    scale = np.abs(design).max(axis=0)
    return np.linalg.pinv(design / scale) / scale[:, None]


def into_radial(camera: Camera) -> Floats:
    """(6,5): what ln f and k2 to k5 do to RADIAL."""
    out = np.zeros((6, 5))
    out[0, 0], out[1, 0] = camera.f_u, camera.f_v
    out[2:, 1:] = np.eye(4)
    return out


def ripple_covariance(camera: Camera, theta_end: float, least_px: float = 0.0) -> Floats:
    """(6,6) of RADIAL: the ripples up to an angle from the axis, as far as the polynomial follows them; of `least_px`
    where those are less."""
    theta = np.linspace(0.2, 1.0, 60) * theta_end
    ripple = (max(LENS_RADIAL_PX, least_px) / camera.f_u) ** 2 * np.exp(
        -0.5 * ((theta[:, None] - theta) / LENS_LENGTH) ** 2
    )
    fit = into_radial(camera) @ radial_fit(camera, theta)
    return fit @ ripple @ fit.T
