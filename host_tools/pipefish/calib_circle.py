"""The part of the sensor that a lens lights: its image circle, or the ellipse of unequal pixels or of a mask."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import ArgumentError

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_AZIMUTHS = 240
_DARK = 0.12  # of the way from black to the bright part: what counts as lit
_NEAR = 0.02  # of the radius: so near, a rim point lies on the curve
_ON = 0.7  # of the rim points that must
_DARK_SHARE = 0.85  # of the pixels outside the curve; the rest are flares, and rims that fade slowly
# (share of the azimuths with a rim, widest gap between them): three numbers need less than five. A rim on one side only
# is a wall.
_CIRCLE, _ELLIPSE = (0.15, math.radians(170)), (0.5, math.radians(120))


@dataclasses.dataclass(frozen=True)
class ImageEllipse:
    """What is lit: within `a` and `b` pixels of (u, v), `a` along `angle` (radians from u to v). a = b: a circle."""

    u: float
    v: float
    a: float
    b: float
    angle: float = 0.0

    def radii(self, pixels: Array) -> Array:
        """Of pixels (N, 2): 1 on the rim, less inside (N,)."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        x, y = (pixels - [self.u, self.v]).T
        return np.hypot((c * x + s * y) / self.a, (c * y - s * x) / self.b)

    def inside(self, pixels: Array) -> Mask:
        """Whether pixels (N, 2) are lit (N,)."""
        return self.radii(pixels) <= 1

    def rim(self, count: int = 720) -> Array:
        """Pixels on it (count, 2); some may lie off the sensor."""
        t = 2 * np.pi * np.arange(count) / count
        x, y = self.a * np.cos(t), self.b * np.sin(t)
        c, s = math.cos(self.angle), math.sin(self.angle)
        return np.stack([self.u + c * x - s * y, self.v + s * x + c * y], axis=1)

    @property
    def circle(self) -> tuple[float, float, float]:
        """The smallest circle around it (u, v, radius), pixels: what a profile can say."""
        return self.u, self.v, max(self.a, self.b)


def ellipses_of(image_circle: object, cameras: Sequence[int]) -> dict[int, ImageEllipse]:
    """What `calibrate` was given as image_circle, by camera. Raises ArgumentError."""
    if image_circle is None:
        return {}
    given: Mapping[int, Any] = (
        image_circle if isinstance(image_circle, Mapping) else dict.fromkeys(cameras, image_circle)
    )
    out = {}
    for camera, one in given.items():
        if not isinstance(one, ImageEllipse):
            try:
                u, v, radius = (float(x) for x in one)
            except (TypeError, ValueError):
                raise ArgumentError(f"image_circle: must be (u, v, radius), not {one!r:.60}") from None
            one = ImageEllipse(u, v, radius, radius)
        if not all(map(math.isfinite, dataclasses.astuple(one))) or min(one.a, one.b) <= 0:
            raise ArgumentError(f"image_circle: must be finite, its radius above 0, not {one!r:.60}")
        out[camera] = one
    return out


def lit_corners(ellipse: ImageEllipse | None, width: int, height: int) -> Array:
    """Pixels (N, 2) on the edge of what is lit of a sensor: its own edge, and the ellipse where that is on it."""
    u, v = np.linspace(-0.5, width - 0.5, 121), np.linspace(-0.5, height - 0.5, 121)
    edge = np.concatenate(
        [
            *(np.stack([u, np.full(len(u), w)], axis=1) for w in (-0.5, height - 0.5)),
            *(np.stack([np.full(len(v), w), v], axis=1) for w in (-0.5, width - 0.5)),
        ]
    )
    if ellipse is None:
        return edge
    rim = ellipse.rim()
    on = (rim >= -0.5).all(axis=1) & (rim <= [width - 0.5, height - 0.5]).all(axis=1)
    return np.concatenate([edge[ellipse.inside(edge)], rim[on]])


def find_image_circle(images: Sequence[npt.NDArray[np.generic]]) -> tuple[float, float, float] | None:
    """Centre and radius (u, v, radius), pixels, of the circle that a lens lights in images (H, W) or (H, W, 3) of one
    size; None where the whole sensor is lit. The brightest of the images at each pixel counts, so one dark scene does
    not matter. An ellipse gives the circle around it. Raises ArgumentError for images of different sizes."""
    found = find_image_ellipse(images)
    return found.circle if found else None


def find_image_ellipse(images: Sequence[npt.NDArray[np.generic]]) -> ImageEllipse | None:
    """As `find_image_circle`: a circle where one fits, else an ellipse; the sensor may cut either."""
    grey = [np.asarray(i, dtype=np.float64) for i in images]
    grey = [i.mean(axis=2) if i.ndim == 3 else i for i in grey]
    if not grey or grey[0].ndim != 2 or any(i.shape != grey[0].shape for i in grey):
        raise ArgumentError("images: must be (H, W) or (H, W, 3), all of one size")
    lit = np.max(grey, axis=0)
    black, bright = np.quantile(lit, 0.005), np.quantile(lit, 0.7)
    mask = lit > black + _DARK * (bright - black)
    for fit, (share, gap) in ((_circle, _CIRCLE), (_ellipse, _ELLIPSE)):
        found = _fitted(mask, fit, share, gap)
        if found is not None:
            return found
    return None


def _fitted(mask: Mask, fit: Any, share: float, gap: float) -> ImageEllipse | None:
    """The curve through the rim of what is lit, if it is one."""
    height, width = mask.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    centre, rim, found = middle, np.empty((0, 2)), None
    for _ in range(3):  # from the middle of the image, then from the curve's own
        rim = _rim(mask, centre)
        found = fit(rim) if len(rim) >= share * _AZIMUTHS else None
        if found is None:
            return None
        centre = np.array([found.u, found.v])
        # A dark wall has no such edge, a dark corner none about the image's middle.
        if np.abs(centre - middle).max() > 0.25 * min(width, height) or max(found.a, found.b) > 0.7 * math.hypot(
            width, height
        ):
            return None
    on = np.abs(found.radii(rim) - 1) < _NEAR
    if on.mean() < _ON or on.sum() < share * _AZIMUTHS:
        return None
    azimuth = np.sort(np.arctan2(*(rim[on] - centre).T[::-1]))
    if np.diff(azimuth, append=azimuth[0] + 2 * np.pi).max() > gap:
        return None
    v, u = np.mgrid[:height:2, :width:2]
    outside = found.radii(np.stack([u.ravel(), v.ravel()], axis=1)) > 1 + 2 * _NEAR
    return found if not outside.any() or (~mask[::2, ::2].ravel()[outside]).mean() >= _DARK_SHARE else None


def _rim(mask: Mask, centre: Array) -> Array:
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


def _scaled(points: Array) -> tuple[Array, Array, float]:
    """x and y of points about their middle in units of their extent, the middle, the unit."""
    middle, scale = points.mean(axis=0), float(np.ptp(points, axis=0).max()) or 1.0
    return (points - middle).T / scale, middle, scale


def _circle(points: Array) -> ImageEllipse | None:
    """By least squares, points far from it weighted down; None for points on a line."""
    (x, y), middle, scale = _scaled(points)
    weight = np.ones(len(points))
    out = None
    for _ in range(12):
        design = np.stack([x, y, np.ones_like(x)], axis=1)
        solved, _, rank, _ = np.linalg.lstsq(design * weight[:, None], (x * x + y * y) * weight, rcond=1e-6)
        square = solved[2] + (solved[0] ** 2 + solved[1] ** 2) / 4
        if rank < 3 or square <= 0:
            return None
        radius = float(np.sqrt(square))
        off = np.abs(np.hypot(x - solved[0] / 2, y - solved[1] / 2) - radius)
        weight = 1 / (1 + (off / (2 * np.median(off) + 1e-4)) ** 2)
        u, v = solved[:2] / 2 * scale + middle
        out = ImageEllipse(float(u), float(v), radius * scale, radius * scale)
    return out


def _ellipse(points: Array) -> ImageEllipse | None:
    """The same for an ellipse no longer than twice its width: x^2 + y^2 = p (x^2 - y^2) + 2 q x y + r x + s y + t."""
    (x, y), middle, scale = _scaled(points)
    weight = np.ones(len(points))
    out = None
    for _ in range(12):
        design = np.stack([x * x - y * y, 2 * x * y, x, y, np.ones_like(x)], axis=1)
        (p, q, r, s, t), _, rank, _ = np.linalg.lstsq(design * weight[:, None], (x * x + y * y) * weight, rcond=1e-6)
        bend = math.hypot(p, q)  # a^2 : b^2 = 1 + bend : 1 - bend
        if rank < 5 or bend >= 0.6:
            return None
        form = np.array([[1 - p, -q], [-q, 1 + p]])
        at = np.linalg.solve(form, [r / 2, s / 2])
        square = t + at @ form @ at
        if square <= 0:
            return None
        a, b = math.sqrt(square / (1 - bend)), math.sqrt(square / (1 + bend))
        u, v = at * scale + middle
        out = ImageEllipse(float(u), float(v), a * scale, b * scale, math.atan2(q, p) / 2)
        off = np.abs(out.radii(points) - 1)
        weight = 1 / (1 + (off / (2 * np.median(off) + 1e-4)) ** 2)
    return out
