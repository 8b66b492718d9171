"""The simulated camera as a calibration finds it: from a board's corners, with a covariance, as a real profile has."""

from __future__ import annotations

import math

import numpy as np

from .calib_data import View
from .calibration import calibrate
from .camera import Camera
from .simulate import Scene
from .studio import rotation


def calibrated(scene: Scene, views: int = 80, noise: float = 0.05) -> Camera:
    """The scene's camera from a board of 70 corners, 25 mm apart, at 0.1 to 0.7 m all over the field, imaged by the
    scene's own lens; corners with `noise` px. What `simulate` writes as a profile knows no asymmetry and is central."""
    spec, pose, random = scene.spec["lens"], scene.pose(0), np.random.default_rng(5)
    size = (spec["width"], spec["height"])
    x, y = np.meshgrid(np.arange(10) - 4.5, np.arange(7) - 3.0)
    board = 0.025 * np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    seen = []
    for number in range(views):
        distance = random.choice([0.12, 0.2, 0.35, 0.6]) * random.uniform(0.8, 1.2)
        theta, phi = 1.5 * math.sqrt(random.uniform(0, 1)), random.uniform(0, 2 * math.pi)
        ahead = np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])
        across = np.cross([0.0, 1.0, 0.1], ahead)
        across /= np.linalg.norm(across)
        turn = np.stack([across, np.cross(ahead, across), ahead], 1) @ rotation(random.normal(0, 0.35, 3))
        placed = board @ turn.T + distance * ahead
        pixels, ok = scene.project(0, (placed - pose[:, 3]) @ pose[:, :3])
        ok &= (pixels >= 0).all(1) & (pixels <= np.array(size) - 1).all(1)
        if ok.sum() >= 20:
            noisy = pixels[ok] + random.normal(0, noise, (int(ok.sum()), 2))
            seen.append(View(board[ok], noisy, board=0, camera=0, name=str(number)))
    circle = (spec["c_u"], spec["c_v"], scene.circle_radius)
    return calibrate(seen, image_size=size, model="auto", board="flat", image_circle=circle).camera
