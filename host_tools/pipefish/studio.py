"""Sheets before the simulator's camera: what calibration targets, two-view scenes and objects in clutter are made of.

A picture is a dict of sheets, lamps and light (docs/simulator.md lists the keys); its sheets' poses are cam_from_sheet.
Random numbers come from numpy's Philox, a counter-based generator, and from the engine's own.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from pipefish import _engine
from pipefish.errors import ArgumentError, FormatError

Texture = _engine.Texture


@dataclass(frozen=True)
class Seen:
    """What pixels see, in their order."""

    sheet: np.ndarray  # (N,) int32, number in the picture's list; -1: no sheet, or outside the lens's field
    back: np.ndarray  # (N,) bool, the sheet's other face
    at: np.ndarray  # (N, 2) texture coordinates, metres from the sheet's middle; NaN without a sheet
    points: np.ndarray  # (N, 3) in the camera's frame, metres
    white: np.ndarray  # (N,) linear grey level of a white sheet there, vignetting and gain included


class Picture:
    """Sheets where they are for one picture, their light and their textures."""

    def __init__(self, spec: dict[str, Any], textures: list[Texture], source: str | None = None) -> None:
        """Raises FormatError that names the key."""
        self._picture = _made(_engine.Picture, source, spec, textures)
        self.textures = textures

    @property
    def spec(self) -> dict[str, Any]:
        """The whole description, defaults filled in."""
        return self._picture.spec

    def place(self, sheet: np.ndarray | int, at: np.ndarray) -> np.ndarray:
        """Points of sheets at texture coordinates (N, 2): (N, 3) in the camera's frame, NaN for sheet -1."""
        at = np.ascontiguousarray(at, dtype=float)
        return self._picture.place(np.ascontiguousarray(np.broadcast_to(sheet, len(at)), dtype=np.int32), at)


class Studio:
    """The simulator's lens and sensor, at the origin of the camera's frame."""

    def __init__(
        self, lens: dict[str, Any] | None = None, sensor: dict[str, Any] | None = None, source: str | None = None
    ) -> None:
        """lens, sensor: keys as in docs/simulator.md. Raises FormatError that names the key."""
        self._studio = _made(_engine.Studio, source, {"lens": lens or {}, "sensor": sensor or {}})
        self.spec = self._studio.spec
        self.width: int = self.spec["lens"]["width"]
        self.height: int = self.spec["lens"]["height"]
        self.theta_max: float = self.spec["lens"]["theta_max"]

    def render(self, picture: Picture, samples: int = 89, threads: int | None = None) -> np.ndarray:
        """(H, W) uint8, or uint16 of 10 bits; the same bits for any number of threads [all cores]. samples: rays in a
        pixel that an edge runs through: a Fibonacci number from 34 to 987."""
        try:
            return self._studio.render(picture._picture, samples, threads or os.cpu_count() or 1)
        except ValueError as error:
            raise ArgumentError(str(error)) from None

    def look(self, picture: Picture, pixels: np.ndarray, threads: int | None = None) -> Seen:
        """What the rays of pixels (N, 2) meet."""
        px = np.ascontiguousarray(pixels, dtype=float)
        sheet, back, at, points, white = self._studio.look(picture._picture, px, threads or os.cpu_count() or 1)
        return Seen(sheet, back.astype(bool), at, points, white)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) in the camera's frame -> (N, 2) pixels, (N,) ok: in the lens's field and on the sensor."""
        px, ok = self._studio.project(np.ascontiguousarray(points, dtype=float))
        on = (px >= -0.5).all(1) & (px[:, 0] <= self.width - 0.5) & (px[:, 1] <= self.height - 0.5)
        return px, ok.astype(bool) & on

    def pixels(self) -> np.ndarray:
        """All pixel centres (H W, 2), row by row."""
        v, u = np.mgrid[: self.height, : self.width]
        return np.column_stack([u.ravel(), v.ravel()]).astype(float)

    def lens_table(self) -> dict[str, list[float]]:
        """The lens as its table: theta (radians), radius (pixels), pupil shift (metres)."""
        theta = self._studio.lens_nodes
        radius, pupil = zip(*(self._studio.lens(t) for t in theta), strict=True)
        return {"theta": list(theta), "radius_px": list(radius), "pupil_m": list(pupil)}

    def flow(
        self, first: Picture, second: Picture, pixels: np.ndarray, other: Studio | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where `second` (seen by `other` [the same camera]) has what `first` has at the pixels. The pictures have the
        same sheets, somewhere else, otherwise bent.

        (N, 2) -> pixels (N, 2), NaN where nothing or nothing of the field; visible (N,): on the sensor, the same face,
        and nothing in front; gain (N,): of the light on it from the first to the second, NaN where it is not
        visible."""
        other = other or self
        seen = self.look(first, pixels)
        moved, ok = other.project(second.place(seen.sheet, seen.at))
        again = other.look(second, np.where(ok[:, None], moved, -1e6))
        gap = np.abs(again.at - seen.at).max(1)
        visible = ok & (again.sheet == seen.sheet) & (again.back == seen.back) & (gap < 1e-6)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where(visible, again.white / seen.white, np.nan)
        return moved, visible, gain


def _made(make: Any, source: str | None, *args: Any) -> Any:
    try:
        return make(*args)
    except ValueError as error:
        where, _, what = str(error).partition(": ")
        raise FormatError(source, where, what) from None


def pattern(seed: int, rows: int = 512, columns: int = 512, **more: float) -> np.ndarray:
    """A procedural texture, (rows, columns) float32 albedos of 0.05 to 0.95: smooth noise in octaves from the
    wavelength `coarse` [a quarter of the rows] to `fine` [6] texels, each `fall` [0.85] times as strong as the next
    coarser, standard deviation `contrast` [0.18], and soft-edged blots that cover the share `blots` [0.6]."""
    spec = {"seed": int(seed), "rows": rows, "columns": columns, "coarse": max(rows // 4, 8), **more}
    return _made(_engine.draw_pattern, None, spec)


def raster(albedo: np.ndarray) -> Texture:
    """A texture from albedos (H, W) of 0 to 1, or from an image (H, W) or (H, W, 3) uint8, as it is stretched over a
    sheet. Raises ArgumentError."""
    image = np.asarray(albedo)
    if image.ndim == 3:
        image = image[..., :3] @ np.array([0.299, 0.587, 0.114])
    if image.dtype.kind in "ui" or (image.size and np.nanmax(image) > 1.5):
        image = image / 255.0
    if image.ndim != 2 or min(image.shape) < 2 or not (np.isfinite(image).all() and image.min() >= 0):
        raise ArgumentError(f"a texture must be an image of at least 2 x 2 pixels, not {np.shape(albedo)}")
    return Texture.raster(np.ascontiguousarray(image, dtype=np.float32))


def rotation(vector: np.ndarray | tuple[float, float, float] | list[float]) -> np.ndarray:
    """Rotation matrix (3, 3) of a rotation vector in radians."""
    x, y, z = np.asarray(vector, dtype=float)
    angle = float(np.sqrt(x * x + y * y + z * z))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-12:
        return np.eye(3) + cross
    return np.eye(3) + np.sin(angle) / angle * cross + (1 - np.cos(angle)) / angle**2 * (cross @ cross)


def facing(direction: np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Rotation cam_from_sheet (3, 3) of a sheet in that direction that faces the camera, its right side turned by
    `roll` from the camera's."""
    z = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    # The shortest turn of the optical axis to z; behind, by way of the x axis.
    axis, cosine = np.cross([0.0, 0.0, 1.0], z), z[2]
    sine = np.linalg.norm(axis)
    turn = rotation(axis / sine * np.arctan2(sine, cosine)) if sine > 1e-9 else np.diag([1.0, cosine, cosine])
    return turn @ rotation((0, 0, roll))


def pose(turn: np.ndarray, shift: np.ndarray | tuple[float, float, float]) -> np.ndarray:
    """[R | t] (3, 4)."""
    return np.column_stack([turn, np.asarray(shift, dtype=float)])


def chain(*poses: np.ndarray) -> np.ndarray:
    """The pose that does the last of them first, (3, 4)."""
    made = np.eye(4)
    for p in poses:
        made = made @ np.vstack([p, [0, 0, 0, 1]])
    return made[:3]


def inverse(p: np.ndarray) -> np.ndarray:
    """Of a pose (3, 4)."""
    return pose(p[:, :3].T, -p[:, :3].T @ p[:, 3])


def listed(p: np.ndarray) -> list[float]:
    """A pose as the 12 numbers of a sheet's key."""
    return [float(x) for x in np.asarray(p).ravel()]


def random(seed: int, stream: int) -> np.random.Generator:
    """Numbers that depend on seed and stream alone."""
    return np.random.Generator(np.random.Philox(key=[int(seed), int(stream)]))


def room(half: float, first_texture: int, world: np.ndarray) -> list[dict[str, Any]]:
    """Six walls around the point (0, 0, 0) of a world that the camera sees with the pose cam_from_world, `half` metres
    away, with the textures first_texture .. + 5."""
    turns = [(0, 0, 0), (0, np.pi / 2, 0), (0, np.pi, 0), (0, -np.pi / 2, 0), (np.pi / 2, 0, 0), (-np.pi / 2, 0, 0)]
    made = []
    for k, turn in enumerate(turns):
        r = rotation(turn)
        wall = {"width": 2 * half, "height": 2 * half, "texture": first_texture + k}
        made.append({**wall, "pose": listed(chain(world, pose(r, half * r[:, 2])))})
    return made


@lru_cache(maxsize=12)
def _pattern(seed: int, texels: int) -> Texture:
    return raster(pattern(seed, texels, texels, contrast=0.15))


def room_textures(seed: int) -> list[Texture]:
    """Six textures for room(): of three patterns, opposite walls alike."""
    return [_pattern(seed * 64 + k % 3, 1024) for k in range(6)]
