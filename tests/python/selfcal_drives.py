"""Simulated 5 m surveys with a profile that may have drifted, for the health check."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from pipefish.camera import Camera
from pipefish.health import check_profile
from pipefish.structure import Encoder
from tube_tracks import fisheye, tube_drive

CASES = ("straight", "bend", "radius", "axial")  # the last two with a known diameter, "radius" sways
ENCODER = Encoder(noise_m_per_sqrt_m=0.001, scale_sigma=0.001)
DIAMETER = 0.3


def drifted(camera: Camera, change: str) -> Camera:
    """The profile of a camera that has changed: "scale" 1 % of all angles, "centre" 3 px, "alpha" 1 %, "" not."""
    if change == "scale":
        return dataclasses.replace(camera, f_u=1.01 * camera.f_u, f_v=1.01 * camera.f_v)
    if change == "centre":
        return dataclasses.replace(camera, c_u=camera.c_u + 3.0)
    if change == "alpha":  # cot theta' = 1.01 cot theta at the same pixel
        theta = np.linspace(0.02, 1.6, 200)
        # Nearest to theta where the tangent changes its sign, so that the angle goes through 90 degrees.
        moved = theta + np.arctan(0.01 * np.tan(theta) / (1 + 1.01 * np.tan(theta) ** 2))
        r = theta + camera.k2 * theta**3 + camera.k3 * theta**5
        powers = moved[:, None] ** np.array([1, 3, 5, 7, 9])
        c = np.linalg.lstsq(powers, r, rcond=None)[0]
        k2, k3, k4, k5 = c[1:] / c[0]
        f = camera.f_u * c[0]
        return dataclasses.replace(camera, f_u=f, f_v=f, k2=k2, k3=k3, k4=k4, k5=k5)
    return camera


def survey(
    seed: int,
    case: str,
    length: float = 5.0,
    sigma: float = 0.2,
    density: float = 600.0,
    step: float = 0.05,
    camera: Camera | None = None,
) -> tuple[Any, np.ndarray]:
    """Tracks and the encoder's readings. Straight and axial drives have no wobble: a crawler's own panning tells."""
    drive = tube_drive(
        seed,
        length=length,
        step=step,
        diameter=DIAMETER,
        ovality=0.0,
        density=density,
        sigma=sigma,
        limits=(20.0, 89.0),
        camera=camera or fisheye(100),
        wobble=0.0 if case in ("straight", "axial") else 1.0,
        bend=0.4 if case == "bend" else 0.0,
    )
    random = np.random.default_rng([seed, 5])
    noise = random.normal(0, ENCODER.noise_m_per_sqrt_m * np.sqrt(np.diff(drive.driven)))
    readings = drive.driven * (1 + random.normal(0, ENCODER.scale_sigma)) + np.append(0.0, np.cumsum(noise))
    return drive, readings


def health_of(seed: int, case: str, change: str, **more: float) -> dict[str, Any]:
    """Verdict and figures of one survey."""
    drive, readings = survey(seed, case, **more)
    found = check_profile(
        drive.tracks,
        drifted(drive.camera, change),
        readings,
        encoder=ENCODER,
        diameter=DIAMETER if case in ("radius", "axial") else None,
        sigma=more.get("sigma", 0.2),
        threads=1,
    )
    return {
        "verdict": found.verdict,
        "text": found.text,
        "alpha_sigma": found.alpha_sigma,
        "probability": found.probability,
        "observed": found.observed,
        "changes": {k: list(v) for k, v in found.changes.items()},
    }
