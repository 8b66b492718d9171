"""What a survey says, as the adjustment takes it: tracks with what they may be off, wheel, attitude, shutter."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from pipefish.camera import Camera
from pipefish.errors import PipefishError
from pipefish.intervals import Z95
from pipefish.repeated import cut
from pipefish.rolling import shutter_of
from pipefish.structure import Encoder, RollingShutter
from pipefish.survey import Survey, Tracks

ENCODER_LEAST_M = 0.02  # an encoder that moved less tells no scale
# A tracker's stated covariance is that of one frame's noise. Along a track errors add up, each track its own: in
# simulated pipes (concrete, brick) 0.3 to 0.5 px for each radian by which the point has moved away from the axis.
TRACK_WALK_PX = 0.3
# What all tracks have in common does not average out: 0.01 px a keyframe bends the scale by per cents in 6 m where
# vision outvotes the encoder. The largest part of it has a known form and is estimated (measure.TRACK_SAG_PX2). For the
# rest vision's word counts less: scatter of the diameter in concrete and brick with 0.3 px 0.10 and 0.88 %, with 0.5 px
# 0.07 and 0.09 %, with 0.8 px 0.06 and 0.10 %.
TRACK_FLOOR_PX = 0.5
DEFAULT_ATTITUDE_SIGMA = 0.01


@dataclass(frozen=True)
class Readings:
    """Of one survey.

    index     (K,) index of each keyframe that is here; frames of the tracks count these
    tracks    where patches were found, each with the tracker's covariance
    weighed   the same, the covariance with what adds up along a track and what all tracks share
    chainage  (K,) metres by the encoder, NaN where unknown; None without a usable one
    encoder   how good it is
    attitude  (K,2) roll and pitch, radians, NaN where unknown; None without an inclinometer
    shutter   None for one that exposes all rows at once
    diameter  metres, what the pipe is said to be; None: nothing is said
    remarks   what one should know of them, in words
    """

    camera: Camera
    index: np.ndarray
    tracks: Tracks
    weighed: Tracks
    chainage: np.ndarray | None
    encoder: Encoder
    attitude: np.ndarray | None
    attitude_sigma: float
    shutter: RollingShutter | None
    diameter: float | None
    remarks: list[str]

    def cut_at(self, frames: list[int]) -> Readings:
        """The same with tracks that end before each of those frames and go on under other names."""
        tracks = cut(self.tracks, frames)
        return dataclasses.replace(self, tracks=tracks, weighed=_weighed(tracks, self.camera))


def readings_of(
    survey: Survey, camera: Camera | None, line_time: float | None = None, diameter: float | None = None
) -> Readings:
    """Reads a survey that has keyframes.

    camera     None: the survey's profile
    line_time  as of `shutter_of`
    diameter   of the pipe, about, metres [the survey's nominal one]

    Raises PipefishError for a profile that is missing or does not fit, FormatError for a setting that is no number."""
    camera = camera_of(survey, camera)
    remarks: list[str] = []
    chainage, encoder = _encoder(survey, remarks)
    attitude, attitude_sigma = attitude_of(survey)
    index = np.array([k.index for k in survey.keyframes], dtype=np.int64)
    tracks = survey.tracks(as_found=True)
    tracks = dataclasses.replace(tracks, frame=np.searchsorted(index, tracks.frame))  # missing ones take no number
    return Readings(
        camera=camera,
        index=index,
        tracks=tracks,
        weighed=_weighed(tracks, camera),
        chainage=chainage,
        encoder=encoder,
        attitude=attitude,
        attitude_sigma=attitude_sigma,
        shutter=shutter_of(survey, line_time),
        diameter=diameter or (survey.start.nominal_diameter_m if survey.start else 0.0) or None,
        remarks=remarks,
    )


def camera_of(survey: Survey, given: Camera | None) -> Camera:
    """The given camera, or that of the survey's profile. Raises PipefishError where there is none that fits."""
    camera = given
    if camera is None:
        if survey.start is None or not survey.start.profile:
            raise PipefishError(f"{survey.path}: holds no camera profile: pipefish reconstruct --profile takes one")
        camera = Camera.from_binary(survey.start.profile)
    frame = survey.keyframes[0]
    if (camera.width, camera.height) != (frame.width, frame.height):
        raise PipefishError(
            f"{survey.path}: the camera profile is for pictures of {camera.width} x {camera.height}, the survey has "
            f"{frame.width} x {frame.height}: a wrong profile?"
        )
    return camera


def _encoder(survey: Survey, remarks: list[str]) -> tuple[np.ndarray | None, Encoder]:
    """Distance at each keyframe, None if it tells nothing, and how good it is."""
    chainage = survey.chainage()
    told = survey.start.encoder if survey.start else None
    count = told.metres_per_count if told else 0.0
    known = chainage[np.isfinite(chainage)]
    quality = Encoder(quantum=count)
    if told is not None and told.noise_m_per_sqrt_m > 0:
        quality = dataclasses.replace(quality, noise_m_per_sqrt_m=told.noise_m_per_sqrt_m)
    if told is not None and told.metres_per_count_sigma > 0 and count > 0:
        quality = dataclasses.replace(quality, scale_sigma=told.metres_per_count_sigma / count)
    if len(known) < 2:
        return None, quality
    if np.abs(np.diff(known)).sum() < max(ENCODER_LEAST_M, 3 * count):
        remarks.append("The encoder did not move: it tells no scale.")
        return None, quality
    if not told or not told.metres_per_count_sigma:
        remarks.append(
            f"The device does not say how good its encoder's scale is: ± {100 * Z95 * quality.scale_sigma:.1f} % is "
            "assumed."
        )
    return chainage, quality


def attitude_of(survey: Survey) -> tuple[np.ndarray | None, float]:
    """Roll and pitch at each keyframe, None if it tells nothing, and their sigma, radians."""
    values = np.full((len(survey.keyframes), 2), np.nan)
    sigmas = []
    for row, frame in zip(values, survey.keyframes, strict=True):
        told = frame.telemetry
        if "roll_rad" in told and "pitch_rad" in told:
            row[:] = told["roll_rad"], told["pitch_rad"]
            sigma = told.get("attitude_sigma_rad", 0.0)
            sigmas.append(sigma if sigma > 0.0 and math.isfinite(sigma) else DEFAULT_ATTITUDE_SIGMA)
    return (values, float(np.median(sigmas))) if sigmas else (None, DEFAULT_ATTITUDE_SIGMA)


def angles(tracks: Tracks, camera: Camera) -> np.ndarray:
    """From the axis, (N,); NaN beyond the camera's model."""
    rays, ok = camera.unproject(tracks.pixels)
    return np.where(ok, np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), np.nan)


def _travel(tracks: Tracks, camera: Camera) -> np.ndarray:
    """(N,) radians that each point has moved away from or to the axis since it was first seen."""
    theta = angles(tracks, camera)
    return np.nan_to_num(np.abs(theta - theta[tracks.bounds[:-1][tracks.track]]))


def _weighed(tracks: Tracks, camera: Camera) -> Tracks:
    more = np.hypot(TRACK_FLOOR_PX, TRACK_WALK_PX * _travel(tracks, camera))
    return dataclasses.replace(tracks, covariance=tracks.covariance + (more**2)[:, None, None] * np.eye(2))
