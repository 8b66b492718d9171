"""Relative pose of two views from matched pixels, on rays: any field of view, pixel noise as the model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from . import _engine
from .camera import Camera, _rows
from .errors import ArgumentError

#: What `TwoView.status` says.
STATUSES = {
    "ok": "found",
    "plane": "found, but a plane explains the points: another motion may do as well",
    "no_baseline": "a rotation alone explains the points: no direction of motion",
    "too_few": "fewer than 8 pairs, or none that agree",
    "behind": "the points do not lie in front of the rays: not a camera that moves in a rigid scene",
}


@dataclass(frozen=True)
class TwoView:
    """How the second view lies to the first.

    status           a key of STATUSES; the pose means something for "ok", "plane" and (rotation) "no_baseline"
    rotation         (3,3), direction (3,) unit: cam2_from_cam1 = [rotation | s direction], s unknown
    inlier           (N,) bool, by 99 % of chi^2 of the Sampson distance, and in front of both rays
    covariance       (6,6): rotation by a small turn on the left (rad), then direction (rank 2)
    sigma            robust spread of the inliers' distances: 1 = noise as stated
    median_parallax  of the inliers after rotation, radians
    iterations       samples drawn
    """

    status: str
    rotation: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]
    inlier: npt.NDArray[np.bool_]
    covariance: npt.NDArray[np.float64]
    sigma: float
    median_parallax: float
    iterations: int

    @property
    def cam2_from_cam1(self) -> npt.NDArray[np.float64]:
        """(3,4), the translation of length 1 (0 where there is no baseline)."""
        return np.column_stack([self.rotation, self.direction])


def covariances(what: str, given: npt.ArrayLike | None, count: int) -> npt.NDArray[np.float64] | None:
    """(count, 2, 2) numbers as float64, or ArgumentError; None stays None."""
    if given is None:
        return None
    array = np.ascontiguousarray(given, dtype=np.float64)
    if array.shape != (count, 2, 2):
        raise ArgumentError(f"{what}: expected shape ({count}, 2, 2), got {array.shape}")
    return array


def two_view(
    camera: Camera,
    pixels1: npt.ArrayLike,
    pixels2: npt.ArrayLike,
    *,
    camera2: Camera | None = None,
    covariance1: npt.ArrayLike | None = None,
    covariance2: npt.ArrayLike | None = None,
    sigma: float = 0.3,
    seed: int = 0,
) -> TwoView:
    """The relative pose that most of the pairs pixels1[i], pixels2[i] (N, 2) agree with.

    camera2: of the second view, where it is another. covariance1, covariance2: (N,2,2) px^2 of the pixels; without them
    the noise is `sigma` px. The result depends on nothing but the arguments. Pairs outside the camera's model are no
    inliers. A pupil shift is not taken into account here: rays are taken to start at the centre.
    Raises ArgumentError for arrays of wrong shapes.
    """
    uv1, uv2 = _rows("pixels1", pixels1, 2), _rows("pixels2", pixels2, 2)
    if len(uv1) != len(uv2):
        raise ArgumentError(f"pixels1, pixels2: {len(uv1)} and {len(uv2)} rows; they must be pairs")
    if not sigma > 0.0:
        raise ArgumentError(f"sigma: {sigma} is not above 0")
    second = camera if camera2 is None else camera2
    first_covariance = covariances("covariance1", covariance1, len(uv1))
    second_covariance = covariances("covariance2", covariance2, len(uv1))
    return TwoView(
        **_engine.two_view(
            camera._profile, second._profile, uv1, uv2, first_covariance, second_covariance, float(sigma), seed
        )
    )
