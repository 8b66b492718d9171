"""Twenty views of 88 points by a fisheye, noise 0.1 px an axis: what each side of the calibration benchmark gets."""

import time
from collections.abc import Callable

import numpy as np

SIZE = (1280, 800)
K = (330.0, 331.0, 645.0, 395.0)
D = (-0.02, 0.002, 0.0, 0.0)
VIEWS = 20


def board() -> np.ndarray:
    """(88, 3) metres."""
    y, x = np.mgrid[:8, :11].reshape(2, -1) * 0.03
    return np.stack([x, y, 0 * x], axis=1)


def _turn(w: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(w)
    x, y, z = w / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def views() -> list[np.ndarray]:
    """Pixels (88, 2) of each view, all in the image and less than 88 degrees off the axis, so that every rival can."""
    random = np.random.default_rng(20)
    found: list[np.ndarray] = []
    while len(found) < VIEWS:
        rotation = _turn(random.uniform(-0.8, 0.8, 3))
        x = (board() - [0.15, 0.105, 0]) @ rotation.T + [*random.uniform(-0.25, 0.25, 2), random.uniform(0.12, 0.35)]
        theta = np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
        r = theta * (1 + D[0] * theta**2 + D[1] * theta**4)
        scale = r / np.hypot(x[:, 0], x[:, 1])
        pixels = np.stack([K[0] * x[:, 0] * scale + K[2], K[1] * x[:, 1] * scale + K[3]], axis=1)
        pixels += random.normal(0, 0.1, pixels.shape)
        if (theta < np.radians(88)).all() and ((pixels > 0) & (pixels < [SIZE[0] - 1, SIZE[1] - 1])).all():
            found.append(pixels)
    return found


def fastest(call: Callable[[], object], rounds: int) -> float:
    """Shortest time of a call, seconds of the processor's wall clock."""
    best = float("inf")
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return best
