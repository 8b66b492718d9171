"""Calibration targets in pictures: which of their points are seen, and where, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipefish import _engine
from pipefish.errors import ArgumentError
from pipefish.target import Target

if TYPE_CHECKING:
    from pipefish.camera import Camera


@dataclass(frozen=True, eq=False)
class Detection:
    """A target in a picture.

    status: "ok" (all points), "partial" (some), "ambiguous" (some, and which ones is known only up to a shift along the
    board), "none". reason: in plain words, what is missing or why there is nothing; "" when there is nothing to say.
    turns: in how many ways the target may be turned and look the same; above 1 the order that reads most like text is
    given. mirrored: the target is seen as in a mirror. With a model `seen` is not told.
    """

    ids: npt.NDArray[np.int64]  #: (M,) rows of Target.points(), ascending
    pixels: npt.NDArray[np.float64]  #: (M, 2) corners, or centroids of the discs' areas
    covariance: npt.NDArray[np.float64]  #: (M, 2, 2) pixels^2, of the noise that the picture shows
    status: str
    reason: str
    turns: int = 1
    mirrored: bool = False
    seen: tuple[int, int] = (
        0,
        0,
    )  #: points in a row and rows of the grid seen, whatever the target has; 0: none, markers
    outlines: npt.NDArray[np.float64] | None = None  #: of discs: (M, 32, 2) points on the rims, NaN where there is none

    def __bool__(self) -> bool:
        return self.status in ("ok", "partial")


def grey(image: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """A picture as (H, W) uint8: colours become grey, 10 to 16 bits become 8 by their largest value, numbers from 0 to
    1 are scaled. Raises ArgumentError."""
    given = np.asarray(image)
    if given.ndim == 3 and given.shape[2] in (3, 4):
        given = given[..., :3].astype(np.float64) @ np.array([0.299, 0.587, 0.114])
        given = np.round(given).astype(np.asarray(image).dtype) if np.asarray(image).dtype.kind == "u" else given
    if given.ndim != 2 or min(given.shape) < 16 or max(given.shape) > 16384:
        raise ArgumentError(f"image: expected shape (H, W) or (H, W, 3), 16 to 16384 pixels, got {given.shape}")
    if given.dtype == np.uint8:
        return np.ascontiguousarray(given)
    if given.dtype == np.uint16:
        bits = max(8, int(given.max()).bit_length())
        return (given >> (bits - 8)).astype(np.uint8)
    if given.dtype.kind == "f" and np.isfinite(given).all() and given.min() >= 0 and given.max() <= 255:
        scale = 255.0 if given.max() <= 1 else 1.0
        return np.round(given * scale).astype(np.uint8)
    raise ArgumentError(f"image: expected uint8, uint16, or numbers from 0 to 1 or 255, got {given.dtype}")


@lru_cache(maxsize=32)
def _board(target: Target) -> _engine.Board:
    flat = target.flat_points()
    sites, steps = target.lattice()
    empty = np.zeros(0, dtype=np.uint8)
    code, middles, codes, bits, side = empty, np.zeros((0, 2)), empty, 0, 0.0
    cols, rows = target.points_shape
    if target.kind == "sleeve":
        code = target.sleeve_bits().ravel().astype(np.uint8)
    elif not target.has_circles:
        # The square to the upper left of corner (0, 0) is the square (0, 0).
        code = ((sites.sum(1) + target.dark_parity + 1) % 2).astype(np.uint8)
    if target.kind == "charuco":
        middles = target.marker_middles()
        bits, side = target.marker_bits, target.marker_share * target.spacing_m
        codes = np.array([target.marker(target.first_marker + k) for k in range(len(middles))], dtype=np.uint8)
    return _engine.Board(
        kind=target.kind,
        flat=np.ascontiguousarray(flat),
        sites=np.ascontiguousarray(sites, dtype=np.int32),
        code=code,
        steps=np.ascontiguousarray(steps),
        size=[cols, rows],
        radius=target.radius_m,
        diameter=target.diameter_m,
        marker_bits=bits,
        marker_errors=_correctable(codes) if bits else 0,
        marker_side=side,
        marker_middles=np.ascontiguousarray(middles, dtype=float),
        marker_codes=np.ascontiguousarray(codes),
    )


def _correctable(codes: npt.NDArray[np.uint8]) -> int:
    """In how many bits a marker (of codes (K, side, side)) may be misread and still be told from all others, turned or
    not; no more than a third of a side's."""
    side = codes.shape[1]
    turned = np.stack([np.rot90(codes, k, (1, 2)) for k in range(4)]).reshape(4, len(codes), -1)
    apart = (turned[:, :, None] != turned[0]).sum(-1)
    apart[0][np.diag_indices(len(codes))] = side * side
    return min(int(apart.min() - 1) // 2, (side - 3) // 2 + 1) if len(codes) else 0


def detect_target(
    image: npt.ArrayLike, target: Target, camera: Camera | None = None, pose: npt.ArrayLike | None = None
) -> Detection:
    """Finds a target, or the part of it that is seen.

    image: (H, W) uint8, or what grey() takes. camera, pose: where the target is, cam_from_target (3, 4), metres; then
    each point is looked for within 0.45 spacings of where the model has it, in a window that follows the model's local
    map: this finds what the picture alone does not show as part of a grid. Raises ArgumentError.
    """
    picture = grey(image)
    if (camera is None) != (pose is None):
        raise ArgumentError("camera, pose: give both or neither")
    if camera is None or pose is None:
        return _in_picture(Detection(**_engine.find_target(picture, _board(target))), picture, target)
    given = np.ascontiguousarray(pose, dtype=np.float64)
    if given.shape != (3, 4) or not np.isfinite(given).all():
        raise ArgumentError(f"pose: expected finite numbers of shape (3, 4), got {given.shape}")
    if picture.shape != (camera.height, camera.width):
        raise ArgumentError(
            f"image: {picture.shape[1]} x {picture.shape[0]} pixels, the camera has {camera.width} x {camera.height}"
        )
    found = Detection(**_engine.find_target_guided(picture, _board(target), camera._profile, given))
    return _in_picture(found, picture, target)


def _in_picture(found: Detection, picture: npt.NDArray[np.uint8], target: Target) -> Detection:
    """Without points that a fit at the picture's edge has put beyond it."""
    height, width = picture.shape
    inside = ((found.pixels >= -0.5) & (found.pixels <= [width - 0.5, height - 0.5])).all(axis=1)
    if inside.all():
        return found
    count, whole = int(inside.sum()), len(target.points())
    return replace(
        found,
        ids=found.ids[inside],
        pixels=found.pixels[inside],
        covariance=found.covariance[inside],
        outlines=None if found.outlines is None else found.outlines[inside],
        status="partial" if found.status == "ok" else found.status,
        reason=found.reason or f"{count} of {whole} points",
    )
