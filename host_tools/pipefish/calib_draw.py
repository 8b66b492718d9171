"""Pictures for the report of a calibration: views with their points, close-ups, cube faces. All are PIL images."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from .camera import Camera
from .views import cube_faces, cube_rays, remap

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

GOOD, BAD, MODEL = (76, 195, 205), (240, 90, 70), (250, 210, 60)


def with_points(
    image: Grey | None, size: tuple[int, int], points: Sequence[tuple[Array, Any]], width: int
) -> Image.Image:
    """A view, `width` pixels wide, with points (N, 2) in colours on it; size: of the picture, (w, h), where it is not
    there: then the points are on grey."""
    scale = width / size[0]
    shape = (width, max(1, round(size[1] * scale)))
    if image is None:
        picture = Image.new("RGB", shape, (58, 64, 72))
    else:
        picture = Image.fromarray(image).convert("RGB").resize(shape, Image.Resampling.LANCZOS)
    pen = ImageDraw.Draw(picture)
    for pixels, colour in points:
        for u, v in (np.asarray(pixels) + 0.5) * scale - 0.5:
            pen.ellipse([u - 2.5, v - 2.5, u + 2.5, v + 2.5], outline=colour, width=1)
    return picture


def close_up(image: Grey, measured: Array, model: Array, side: int = 25, zoom: int = 8) -> Image.Image:
    """`side` pixels around a point, enlarged: a cross where it was measured, a circle where the model has it."""
    reach = float(np.abs(model - measured).max()) if np.isfinite(model).all() else 0.0
    side = int(min(max(side, 2 * math.ceil(reach) + 9), 120))
    zoom = max(1, zoom * 25 // side)
    u, v = (int(x) - side // 2 for x in np.rint(measured))
    part = Image.fromarray(image).crop((u, v, u + side, v + side)).convert("RGB")
    picture = part.resize((200, 200), Image.Resampling.NEAREST)
    pen, scale = ImageDraw.Draw(picture), 200 / side

    def place(point: Array) -> tuple[float, float]:
        return (float(point[0]) - u + 0.5) * scale, (float(point[1]) - v + 0.5) * scale

    x, y = place(measured)
    pen.line([x - 8, y, x + 8, y], fill=BAD, width=2)
    pen.line([x, y - 8, x, y + 8], fill=BAD, width=2)
    if np.isfinite(model).all() and reach < 100:
        x, y = place(model)
        pen.ellipse([x - 7, y - 7, x + 7, y + 7], outline=MODEL, width=2)
    return picture


def rows_and_columns(xyz: Array) -> list[list[int]]:
    """Rows and columns of a flat target: numbers of points with one y, or one x."""
    if np.ptp(xyz[:, 2]) > 1e-9:
        return []
    found = []
    for axis in (0, 1):
        values = np.round(xyz[:, axis], 7)
        found += [list(np.flatnonzero(values == value)) for value in np.unique(values)]
    return [line for line in found if len(line) >= 3]


@dataclasses.dataclass(frozen=True)
class Cube:
    """A view on the faces of a cube. off_px: root mean square distance of the target's points from the chords of their
    rows and columns on a face, in pixels of it; None without any; lines: how many chords."""

    picture: Image.Image
    off_px: float | None
    lines: int


def cube(
    camera: Camera, image: Grey, pixels: Array, lines: Sequence[Sequence[int]], edge: int, distance: float
) -> Cube:
    """A view on the faces of a cube, with the chords of `lines` (rows and columns of the target: numbers of `pixels`)
    drawn. distance: metres, of the target: where it is exact for a camera with a pupil shift."""
    rays, corners = cube_rays(edge)
    flat = remap(camera, rays, None, distance).apply(image)
    picture = Image.fromarray(flat).convert("RGB")
    pen = ImageDraw.Draw(picture)
    seen, ok = camera.unproject(pixels)
    seen = seen + (camera.origins(pixels) / distance if camera.pupil_e1 else 0.0)
    off: list[float] = []
    count = 0
    for name, turn in cube_faces().items():
        local = np.where(ok[:, None], seen, np.nan) @ turn
        with np.errstate(invalid="ignore", divide="ignore"):
            place = local[:, :2] / local[:, 2:] * edge / 2
            inside = (local[:, 2] > 0) & (np.abs(place) < edge / 2).all(axis=1)
        place = place + (edge - 1) / 2 + np.array(corners[name])
        for line in lines:
            on = [i for i in line if inside[i]]
            if len(on) < 3:
                continue
            middle = place[on].mean(axis=0)
            along = np.linalg.svd(place[on] - middle)[2][0]
            across = (place[on] - middle) @ np.array([-along[1], along[0]])
            ends = (place[on] - middle) @ along
            pen.line([*(middle + along * ends.min()), *(middle + along * ends.max())], fill=GOOD, width=1)
            off += list(across**2)
            count += 1
    return Cube(picture, math.sqrt(sum(off) / len(off)) if off else None, count)
