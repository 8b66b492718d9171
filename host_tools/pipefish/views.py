"""Views of a camera's picture: perspective, the faces of a cube, cylinder, equirectangular; and the resampling to them.

A view is a bundle of rays in its own frame (x right, y down, z forward), turned against the camera. The camera model
tells where each ray falls in the picture, so every view goes beyond 90 degrees where the camera does.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from .camera import Camera
from .errors import ArgumentError

Array = npt.NDArray[np.float64]

KINDS = ("perspective", "cube", "cylinder", "equirect")
FAR = 1e6  # metres; where the rays of a camera with a pupil shift are followed to when no distance is given
_SUPERSAMPLES = 16  # along each side of a pixel at most; beyond, the picture is halved first

# Places of a cube's faces in the cross (column, row) and their turns (yaw, pitch) in degrees.
_FACES = {
    "up": (1, 0, 0, 90),
    "left": (0, 1, -90, 0),
    "front": (1, 1, 0, 0),
    "right": (2, 1, 90, 0),
    "down": (1, 2, 0, -90),
}


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """(3, 3) from the view's frame to the camera's. Degrees: yaw turns the view right, pitch up, roll clockwise."""
    y, p, r = (math.radians(a) for a in (yaw, pitch, roll))
    turn_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    turn_x = np.array([[1, 0, 0], [0, math.cos(p), -math.sin(p)], [0, math.sin(p), math.cos(p)]])
    turn_z = np.array([[math.cos(r), -math.sin(r), 0], [math.sin(r), math.cos(r), 0], [0, 0, 1]])
    return turn_y @ turn_x @ turn_z


def _grid(width: int, height: int) -> tuple[Array, Array]:
    """Offsets of the pixels from the middle, right and down."""
    x, y = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    return np.meshgrid(x, y)


def perspective_rays(width: int, height: int, fov: float) -> Array:
    """(height, width, 3) rays of a pinhole; fov: across the width, degrees, below 180."""
    if not 0 < fov < 180:
        raise ArgumentError(f"a perspective view covers more than 0 and less than 180 degrees, not {fov:g}")
    x, y = _grid(width, height)
    return np.stack([x, y, np.full_like(x, width / 2 / math.tan(math.radians(fov) / 2))], axis=-1)


def cylinder_rays(width: int, height: int, fov: float) -> Array:
    """Rays to a cylinder about the view's y axis: columns are equal angles, rows equal heights, square pixels. So the
    height says how far it reaches up and down (vertical_fov); along the axis itself no row ever looks."""
    if not 0 < fov <= 360:
        raise ArgumentError(f"a cylinder covers up to 360 degrees, not {fov:g}")
    x, y = _grid(width, height)
    scale = math.radians(fov) / width
    return np.stack([np.sin(x * scale), y * scale, np.cos(x * scale)], axis=-1)


def equirect_rays(width: int, height: int, fov: float) -> Array:
    """Rays of longitude (columns) and latitude (rows), the same angle per pixel in both."""
    scale = math.radians(fov) / width
    if not 0 < fov <= 360 or scale * height > math.pi * (1 + 1e-9):
        asked = f"{fov:g} x {fov * height / width:g}"
        raise ArgumentError(f"an equirectangular view covers up to 360 x 180 degrees, not {asked}")
    x, y = _grid(width, height)
    longitude, latitude = x * scale, y * scale
    cosine = np.cos(latitude)
    return np.stack([np.sin(longitude) * cosine, np.sin(latitude), np.cos(longitude) * cosine], axis=-1)


def cube_rays(edge: int) -> tuple[Array, dict[str, tuple[int, int]]]:
    """The cube's faces unfolded into a cross of 3 x 3 faces with the front in the middle (Fig. 6 of Kannala's thesis);
    (3 edge, 3 edge, 3) rays, NaN in the corners, and the first column and row of each face. The back, which
    begins 125 degrees off the axis at its corners, is left out."""
    rays = np.full((3 * edge, 3 * edge, 3), np.nan)
    front = perspective_rays(edge, edge, 90)
    corners = {}
    for name, (column, row, yaw, pitch) in _FACES.items():
        corners[name] = (column * edge, row * edge)
        part = rays[row * edge : (row + 1) * edge, column * edge : (column + 1) * edge]
        part[:] = front @ rotation(yaw, pitch, 0).T
    return rays, corners


def cube_faces() -> dict[str, Array]:
    """Turns (3, 3) from each face's frame, z through its middle, to the camera's."""
    return {name: rotation(yaw, pitch, 0) for name, (_, _, yaw, pitch) in _FACES.items()}


def vertical_fov(kind: str, width: int, height: int, fov: float) -> float | None:
    """Degrees from the top to the bottom edge of a view, in its middle column; None for the cube's cross."""
    half = math.radians(fov) / 2
    match kind:
        case "perspective":
            return math.degrees(2 * math.atan(math.tan(half) * height / width))
        case "cylinder":
            return math.degrees(2 * math.atan(half * height / width))
        case "equirect":
            return fov * height / width
    return None


def view_rays(kind: str, width: int, height: int, fov: float) -> Array:
    """(rows, columns, 3) rays of one of KINDS; a cube has faces of `width` pixels and takes no field of view."""
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise ArgumentError(f"a view of {width} x {height} pixels: sides of 1 to 16384 are possible")
    match kind:
        case "perspective":
            return perspective_rays(width, height, fov)
        case "cylinder":
            return cylinder_rays(width, height, fov)
        case "equirect":
            return equirect_rays(width, height, fov)
        case "cube":
            return cube_rays(width)[0]
    raise ArgumentError(f"view {kind!r} is none of {', '.join(KINDS)}")


@dataclasses.dataclass(frozen=True)
class Remap:
    """Where each pixel of a view comes from. uv (rows, columns, 2); valid (rows, columns): the camera sees it;
    footprint (rows, columns, 2, 2): pixels of the picture per pixel of the view, to first order; count: how many
    samples a side the pixel takes; level: from the picture halved so many times."""

    uv: Array
    valid: npt.NDArray[np.bool_]
    footprint: Array
    count: npt.NDArray[np.int64]
    level: npt.NDArray[np.int64]

    def apply(self, picture: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """(H, W) or (H, W, C) uint8 -> the view, 0 where it is not valid.

        Each pixel is the mean of n x n bilinear samples over its own footprint in the picture, n = the footprint's
        longest side in pixels, rounded up: plain bilinear where the view magnifies, no aliasing where it shrinks.
        Footprints of more than 16 pixels are sampled from the picture halved, by means of 2 x 2, until they have 16.
        """
        picture = np.asarray(picture)
        if picture.dtype != np.uint8 or picture.ndim not in (2, 3):
            raise ArgumentError(f"expected uint8 of shape (H, W) or (H, W, C), got {picture.dtype} {picture.shape}")
        channels = 1 if picture.ndim == 2 else picture.shape[2]
        source = picture.reshape(picture.shape[0], picture.shape[1], channels)
        out = np.zeros((self.valid.size, channels), dtype=np.uint8)
        uv, footprint = self.uv.reshape(-1, 2), self.footprint.reshape(-1, 2, 2)
        count, level = self.count.ravel(), self.level.ravel()
        for halved in range(int(self.level.max()) + 1):
            if halved:
                source = _halve(source)
            here = np.flatnonzero(self.valid.ravel() & (level == halved))
            for n in np.unique(count[here]):
                chosen = here[count[here] == n]
                for part in np.array_split(chosen, max(1, len(chosen) // 200_000)):
                    total = np.zeros((len(part), channels), dtype=np.float32)
                    steps = (np.arange(n) + 0.5) / n - 0.5
                    for dy in steps:
                        for dx in steps:
                            place = uv[part] + footprint[part] @ np.array([dx, dy])
                            total += _bilinear(source, (place + 0.5) / 2**halved - 0.5)
                    out[part] = np.clip(np.rint(total / n**2), 0, 255).astype(np.uint8)
        return out.reshape(*self.valid.shape, *picture.shape[2:])


def _halve(source: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Means of 2 x 2 pixels; an odd last row or column counts twice."""
    height, width = source.shape[:2]
    padded = np.pad(source, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge").astype(np.float32)
    return (padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]) / 4


def _bilinear(source: npt.NDArray[Any], uv: Array) -> npt.NDArray[np.float32]:
    height, width = source.shape[:2]
    u, v = np.clip(uv[:, 0], 0, width - 1), np.clip(uv[:, 1], 0, height - 1)
    left, top = np.minimum(u.astype(np.int64), max(width - 2, 0)), np.minimum(v.astype(np.int64), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    a, b = (u - left).astype(np.float32)[:, None], (v - top).astype(np.float32)[:, None]
    upper = source[top, left] * (1 - a) + source[top, right] * a
    lower = source[bottom, left] * (1 - a) + source[bottom, right] * a
    return upper * (1 - b) + lower * b


def remap(camera: Camera, rays: Array, turn: Array | None = None, distance: float = FAR) -> Remap:
    """The table that makes the view with `rays` (rows, columns, 3) out of the camera's picture.

    turn: (3, 3) from the view's frame to the camera's. distance: metres, of the sphere around the camera on which the
    view is exact; it matters only for a camera with a pupil shift, whose rays do not meet in one point.
    """
    if not distance > 0:
        raise ArgumentError(f"the distance must be above zero, not {distance:g}")
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    if turn is not None:
        unit = unit @ np.asarray(turn).T
    shape = rays.shape[:2]
    points = (unit * distance if camera.pupil_e1 else unit).reshape(-1, 3)
    uv, ok = camera.project(points)
    with np.errstate(invalid="ignore"):
        ok &= camera.in_image(uv)
    uv = uv.reshape(*shape, 2)
    footprint = np.stack([_difference(uv, 1), _difference(uv, 0)], axis=-1)
    with np.errstate(invalid="ignore"):
        longest = np.sqrt((footprint**2).sum(axis=-2)).max(axis=-1)
    longest = np.where(np.isfinite(longest), longest, 1.0)
    footprint = np.where(np.isfinite(footprint).all(axis=(-1, -2))[..., None, None], footprint, 0.0)
    valid = ok.reshape(shape)
    longest = np.where(valid, longest, 1.0)
    level = np.ceil(np.log2(np.maximum(longest / _SUPERSAMPLES, 1.0)) - 1e-9).astype(np.int64)
    count = np.clip(np.ceil(longest / 2.0**level - 1e-6), 1, _SUPERSAMPLES).astype(np.int64)
    return Remap(uv, valid, footprint, count, level)


def _difference(uv: Array, axis: int) -> Array:
    """Pixels of the picture per pixel of the view along an axis: the smaller of both one-sided differences, which a
    seam between two faces of the cube does not spoil; a pixel at a rim has one."""
    if uv.shape[axis] == 1:
        return np.zeros_like(uv)
    step = np.diff(uv, axis=axis)
    nothing = np.full_like(np.take(step, [0], axis=axis), np.nan)
    before, after = np.concatenate([nothing, step], axis=axis), np.concatenate([step, nothing], axis=axis)
    with np.errstate(invalid="ignore"):
        size_before, size_after = (np.nan_to_num((d**2).sum(axis=-1), nan=np.inf) for d in (before, after))
    return np.where((size_before < size_after)[..., None], before, after)
