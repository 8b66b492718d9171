"""Keyframes unrolled onto a tube: one grid of square cells for all, a pixel beside the camera each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipefish import _engine
from pipefish.camera import Camera
from pipefish.errors import ArgumentError
from pipefish.matching import grey
from pipefish.wallmodel import Floats, WallModel

THETA_LEAST = math.radians(30)  # nearer to the axis a pixel covers four times as much of the wall as beside the camera


def keyframe_picture(images: Callable[[int], Any], camera: Camera, k: int) -> NDArray[np.float32]:
    """Keyframe k, (H,W) of 0..1, which must be as large as the camera's. Raises ArgumentError."""
    picture = grey(images(k), f"keyframe {k}")
    if picture.shape != (camera.height, camera.width):
        size = f"{picture.shape[1]}x{picture.shape[0]}"
        raise ArgumentError(f"keyframe {k}: {size} is not the camera's {camera.width}x{camera.height}")
    return picture


@dataclass(frozen=True, eq=False)
class View:
    """A keyframe unrolled: picture rows are cells along s from `row` on; `pad` columns are repeated at either end."""

    row: int
    picture: NDArray[np.float32]
    even: NDArray[np.float32]  # the picture without the lamp's falloff
    sound: NDArray[np.bool_]
    image: NDArray[np.float32]
    centre: Floats
    pose: Floats


class Unroller:
    """Unrolls keyframes onto one grid of square cells, a pixel (times `scale`) beside the camera each; what is seen
    from theta_least off the axis on. relief: gives how far outside the tube the wall is at s (n,), clock (n,)."""

    pad = 24

    def __init__(
        self,
        camera: Camera,
        wall: WallModel,
        scale: float,
        *,
        theta_least: float = THETA_LEAST,
        relief: Callable[[Floats, Floats], Floats] | None = None,
    ) -> None:
        self.camera, self.wall, self.theta_least, self.relief = camera, wall, theta_least, relief
        self.columns = max(64, round(2 * math.pi * camera.f_u / scale))
        self.cell = 2 * math.pi * wall.mean_radius / self.columns
        self.theta_most = min(camera.theta_max, math.radians(110))

    def clock(self, column: Any) -> Floats:
        return (np.asarray(column, float) - self.pad + 0.5) * 2 * np.pi / self.columns

    def s(self, row: Any) -> Floats:
        return (np.asarray(row, float) + 0.5) * self.cell

    def rows(self, pose: Floats) -> tuple[int, int]:
        """The rows of cells that a keyframe sees, from and to; few or none beside the wall."""
        centre = -pose[:, :3].T @ pose[:, 3]
        s = float(self.wall.locate(centre[None])[0][0])
        rho, last = self.wall.mean_radius, int(self.wall.length / self.cell)
        ahead = float(self.wall.frames([s])[1][0] @ pose[2, :3])  # below 0: the camera looks back
        ends = sorted(s + math.copysign(rho, ahead) / math.tan(t) for t in (self.theta_most, self.theta_least))
        first, end = (min(max(round(e / self.cell), 0), last) for e in ends)
        return first, end

    def view(self, image: NDArray[np.float32], pose: Floats) -> View:
        """A keyframe that sees some of the wall, unrolled."""
        first, end = self.rows(pose)
        picture, sound = self.part(image, pose, first, end)
        return View(first, picture, even(picture, sound), sound, image, -pose[:, :3].T @ pose[:, 3], pose)

    def part(
        self, image: NDArray[np.float32], pose: Floats, first: int, end: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """What a keyframe shows of the rows from `first` to before `end`, 0 where nothing; where it shows some."""
        pixels, sound = self._pixels(np.arange(first, end), np.arange(self.columns + 2 * self.pad), pose)
        values = _engine.sample_image(image, pixels.reshape(-1, 2)).reshape(sound.shape)
        sound &= np.isfinite(values)
        return np.where(sound, values, 0).astype(np.float32), sound

    def _pixels(self, rows: Any, columns: Any, pose: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Where cells are in the picture: every 4th is projected, the others lie between (0.003 px off at most)."""
        step = 4
        r = np.arange(rows[0], rows[-1] + step, step)
        c = np.arange(0, columns[-1] + step, step)
        s, clock = np.meshgrid(self.s(r), self.clock(c), indexing="ij")
        off = self.relief(s.ravel(), clock.ravel()) if self.relief else 0.0
        points = self.wall.points(s.ravel(), clock.ravel(), off)
        seen = points @ pose[:, :3].T + pose[:, 3]
        pixels, ok = self.camera.project(seen)
        theta = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
        ok &= (theta >= self.theta_least) & (theta <= self.theta_most)
        ok &= self.camera.in_image(pixels)
        fine = _between(np.where(ok[:, None], pixels, np.nan).reshape(*s.shape, 2), len(rows), len(columns), step)
        return np.nan_to_num(fine, nan=-1.0), np.isfinite(fine[..., 0])


def _between(coarse: Floats, rows: int, columns: int, step: int) -> Floats:
    """Bilinear between the places of a grid `step` apart: (rows, columns, k)."""
    i, j = np.arange(rows), np.arange(columns)
    t, u = (i % step / step)[:, None, None], (j % step / step)[None, :, None]
    across = lambda g: (1 - u) * g[:, j // step] + u * g[:, np.minimum(j // step + 1, g.shape[1] - 1)]  # noqa: E731
    top, bottom = coarse[i // step], coarse[np.minimum(i // step + 1, len(coarse) - 1)]
    return (1 - t) * across(top) + t * across(bottom)


def box_sum(values: Floats, radius: int) -> Floats:
    """Sums over (2 radius + 1)^2 cells, less of them at the rim."""
    for axis in (0, 1):
        n = values.shape[axis]
        sums = np.concatenate([np.zeros_like(np.take(values, [0], axis)), np.cumsum(values, axis, dtype=float)], axis)
        k = np.arange(n)
        values = np.take(sums, np.minimum(k + radius + 1, n), axis) - np.take(sums, np.maximum(k - radius, 0), axis)
    return values


def even(picture: NDArray[np.float32], sound: NDArray[np.bool_], radius: int = 15) -> NDArray[np.float32]:
    """The picture with the lamp's falloff taken out: less its local mean, over its local deviation, 0..1."""
    count = np.maximum(box_sum(sound.astype(float), radius), 1)
    mean = box_sum(picture.astype(float), radius) / count  # 0 where not sound
    square = box_sum(picture.astype(float) ** 2, radius) / count
    deviation = np.sqrt(np.maximum(square - mean**2, 0)) + 0.01  # 2.5 grey levels: noise is not made texture
    value = np.where(sound, 0.5 + 0.15 * (picture - mean) / deviation, 0.5)
    return np.clip(value, 0, 1).astype(np.float32)
