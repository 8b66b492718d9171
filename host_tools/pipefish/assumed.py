"""What is taken for the asymmetry of a camera whose profile has no covariance: stated, not hidden.

A lens whose elements are tilted or decentred by hundredths of a millimetre makes any pipe oval by some
hundredths of a point, everywhere alike, and no straight drive shows it."""

from __future__ import annotations

import dataclasses

import numpy as np

from .camera import PARAMETERS, Camera

#: Pixels, of a profile that does not say what its calibration left: between the 0.1 and 0.5 that calibrations of wide
#: lenses leave.
RESIDUAL_PX = 0.3
RESIDUAL_LEAST_PX = 0.02
#: All that is not the radial function. Along that a survey's scale bends, and what a profile is off there cannot be
#: said from a residual: a wrong one leaves as little.
ASYMMETRY = ("c_u", "c_v", *(f"cpoly[{i}]" for i in range(14)))
#: Metres of e1, of a profile that does not say how well it knows its pupil's shift: 95 % of lenses shift less. Two
#: millimetres at 57 degrees, five at 90; traced and calibrated fisheyes have one to three at 90.
PUPIL_MOST = 0.002
RINGS, AROUND = 16, 36


def assumed_px(camera: Camera) -> float:
    """Pixels by which such a profile counts as off, rms over the field: as much as its calibration left."""
    return RESIDUAL_PX if camera.rms_px is None else max(camera.rms_px, RESIDUAL_LEAST_PX)


def assumed(camera: Camera) -> Camera:
    """The camera with a covariance of its ASYMMETRY; that of a camera which has a covariance is its own.

    The profile's error is taken for a field of that family whose rms over the picture is assumed_px() and whose
    directions move the picture by as much each."""
    if camera.covariance is not None:
        return camera
    chosen = [PARAMETERS.index(name) for name in ASYMMETRY]
    end = camera.theta_covered or camera.theta_max
    # Rings of equal area in the picture, about.
    theta = end * np.sqrt((np.arange(RINGS) + 0.5) / RINGS)[:, None]
    phi = np.arange(AROUND) * (2 * np.pi / AROUND)
    rays = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi]
    pixels, ok, _, by_parameter = camera.project_jacobian(np.stack(rays, axis=-1).reshape(-1, 3))
    inside = ok & (pixels >= 0).all(axis=1) & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=1)
    rows = by_parameter[inside][:, :, chosen].reshape(-1, len(chosen))
    scale = np.linalg.norm(rows, axis=0)
    _, size, directions = np.linalg.svd(rows / scale, full_matrices=False)
    # A residual is a distance: along either axis it is less by the root of two.
    spread = (directions.T / size) * (assumed_px(camera) * np.sqrt(0.5 * len(rows) / len(chosen))) / scale[:, None]
    return dataclasses.replace(camera, covariance=spread @ spread.T, covariance_parameters=ASYMMETRY)
