"""The image circle of a lens that does not light the whole sensor, from the pictures of a calibration."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

_RAYS = 240
_DARK = 0.15  # of the lit middle: what corners may have at most where there is an edge of light before them
_EDGE = 0.3  # of the lit middle: the edge
_ROUND = 0.006  # of the radius: how far the edge may lie from a circle, rms
_SHARE = 0.3  # of the directions in which the edge must be seen
_MARGIN_PX = 2.0


class Brightest:
    """The brightest that each pixel ever was: what stays dark is not lit."""

    def __init__(self) -> None:
        self.picture: Grey | None = None

    def add(self, image: Grey) -> None:
        """Takes a picture; all have one size."""
        self.picture = image.copy() if self.picture is None else np.maximum(self.picture, image)


def image_circle(brightest: Grey, points: Iterable[Array]) -> tuple[float, float, float] | None:
    """(u, v, radius), px; None where the sensor is lit up to its corners, or the edge of the light is no circle.

    points: pixels (N, 2) of targets; they are inside."""
    height, width = brightest.shape
    smooth = _smoothed(brightest)
    patch = max(4, min(width, height) // 20)
    corners = [smooth[y, x] for y in (slice(patch), slice(-patch, None)) for x in (slice(patch), slice(-patch, None))]
    middle = float(np.percentile(smooth, 75))
    if sum(float(np.median(c)) < _DARK * middle for c in corners) < 3:
        return None
    edge = _edge(smooth, _EDGE * middle)
    if len(edge) < _SHARE * _RAYS:
        return None
    fit = _circle(edge)
    keep = np.ones(len(edge), dtype=bool)
    for _ in range(8):  # something dark before the lens, or a reflection beside it, is no edge
        off = np.abs(np.linalg.norm(edge - fit[:2], axis=1) - fit[2])
        keep = off <= max(3 * 1.4826 * float(np.median(off)), 1.0)
        fit = _circle(edge[keep])
    off = np.linalg.norm(edge[keep] - fit[:2], axis=1) - fit[2]
    if keep.mean() < 0.7 or keep.sum() < _SHARE * _RAYS or float(np.sqrt((off**2).mean())) > _ROUND * fit[2]:
        return None
    seen = [np.linalg.norm(p - fit[:2], axis=1).max() for p in points if len(p)]
    radius = max(float(fit[2]), *(float(r) + _MARGIN_PX for r in seen)) if seen else float(fit[2])
    return float(fit[0]), float(fit[1]), radius


def _smoothed(image: Grey) -> Array:
    """Means of 5 x 5 pixels: noise is no light."""
    padded = np.pad(image.astype(np.float64), 3, mode="edge")[:-1, :-1].cumsum(0).cumsum(1)
    return (padded[5:, 5:] - padded[:-5, 5:] - padded[5:, :-5] + padded[:-5, :-5]) / 25


def _edge(smooth: Array, level: float) -> Array:
    """Where light begins along rays from outside (N, 2); rays that are lit at the picture's border are left out."""
    height, width = smooth.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    found = []
    for angle in 2 * np.pi * np.arange(_RAYS) / _RAYS:
        along = np.array([np.cos(angle), np.sin(angle)])
        with np.errstate(divide="ignore"):
            reach = np.min(np.where(np.abs(along) > 1e-9, middle / np.abs(along), np.inf)) - 1
        steps = np.arange(reach, 0.2 * reach, -0.5)
        u, v = np.rint(middle + steps[:, None] * along).astype(int).T
        lit = smooth[v, u] >= level
        first = int(np.argmax(lit))
        if lit[first] and first > 4:
            found.append(middle + steps[first] * along)
    return np.array(found).reshape(-1, 2)


def _circle(points: Array) -> Array:
    """(u, v, radius) by least squares of u^2 + v^2 = 2 a u + 2 b v + c."""
    middle = points.mean(axis=0)
    p = points - middle
    a, b, c = np.linalg.lstsq(np.column_stack([2 * p, np.ones(len(p))]), (p**2).sum(axis=1), rcond=None)[0]
    return np.array([a + middle[0], b + middle[1], np.sqrt(max(c + a * a + b * b, 0.0))])
