"""The image circle of a lens that does not fill its sensor, from the images themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .errors import ArgumentError

Array = npt.NDArray[np.float64]

_AZIMUTHS = 240
_DARK = 0.12  # of the way from black to the bright part: what counts as lit


def find_image_circle(images: Sequence[npt.NDArray[np.generic]]) -> tuple[float, float, float] | None:
    """Centre and radius (u, v, radius), pixels, of the circle that a lens lights in images (H, W) or (H, W, 3) of one
    size; None where the whole sensor is lit. The brightest of the images at each pixel counts, so one dark scene does
    not matter. Raises ArgumentError for images of different sizes."""
    grey = [np.asarray(i, dtype=np.float64) for i in images]
    grey = [i.mean(axis=2) if i.ndim == 3 else i for i in grey]
    if not grey or grey[0].ndim != 2 or any(i.shape != grey[0].shape for i in grey):
        raise ArgumentError("images: must be (H, W) or (H, W, 3), all of one size")
    lit = np.max(grey, axis=0)
    height, width = lit.shape
    black, bright = np.quantile(lit, 0.005), np.quantile(lit, 0.7)
    mask = lit > black + _DARK * (bright - black)
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    rim = np.empty((0, 2))
    for _ in range(3):  # from the middle of the image, then from the circle's own
        rim = _rim(mask, centre)
        if len(rim) < 0.25 * _AZIMUTHS:
            return None
        fitted = _circle(rim)
        if fitted is None:
            return None
        centre = fitted[:2]
    off = np.abs(np.hypot(*(rim - fitted[:2]).T) - fitted[2])
    inside = (off < 0.02 * fitted[2]).sum()
    # A dark wall has no circular edge, a dark corner none about the image's middle.
    apart = np.abs(fitted[:2] - [(width - 1) / 2, (height - 1) / 2]).max() > 0.25 * min(width, height)
    if inside < 0.7 * len(rim) or apart or fitted[2] > 0.7 * np.hypot(width, height):
        return None
    return float(fitted[0]), float(fitted[1]), float(fitted[2])


def _rim(mask: npt.NDArray[np.bool_], centre: Array) -> Array:
    """The outermost lit pixel along each azimuth (n, 2), where it is not at the sensor's edge."""
    height, width = mask.shape
    radius = np.arange(0.0, np.hypot(width, height), 0.5)
    found = []
    for phi in 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS:
        u, v = centre[0] + radius * np.cos(phi), centre[1] + radius * np.sin(phi)
        on = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        row = mask[np.round(v[on]).astype(int), np.round(u[on]).astype(int)]
        if row.any():
            last = len(row) - 1 - int(np.argmax(row[::-1]))
            if last < len(row) - 7:  # at least three dark pixels beyond
                found.append((u[last], v[last]))
    return np.array(found).reshape(-1, 2)


def _circle(points: Array) -> Array | None:
    """(u, v, radius) by least squares, points far from it weighted down; None for points on a line."""
    weight = np.ones(len(points))
    middle, scale = points.mean(axis=0), float(np.ptp(points, axis=0).max()) or 1.0
    x, y = ((points - middle) / scale).T
    out = None
    for _ in range(12):
        design = np.stack([x, y, np.ones_like(x)], axis=1)
        solved, _, rank, _ = np.linalg.lstsq(design * weight[:, None], (x * x + y * y) * weight, rcond=1e-6)
        square = solved[2] + (solved[0] ** 2 + solved[1] ** 2) / 4
        if rank < 3 or square <= 0:
            return None
        radius = np.sqrt(square)
        off = np.abs(np.hypot(x - solved[0] / 2, y - solved[1] / 2) - radius)
        weight = 1 / (1 + (off / (2 * np.median(off) + 1e-4)) ** 2)
        out = np.array([*(solved[:2] / 2 * scale + middle), radius * scale])
    return out
