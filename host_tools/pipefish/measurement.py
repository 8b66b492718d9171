"""A measured survey: structure, scale, a tube for each stretch, and what one should know of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipefish.camera import Camera
from pipefish.health import ProfileCheck
from pipefish.repeated import Repetition
from pipefish.scale import Scale
from pipefish.structure import Reconstruction
from pipefish.survey import Survey, Tracks
from pipefish.tube import Tube

OUTLIER_SIGMA = 3.5  # residuals beyond do not count in the quality page and are not in the COLMAP model


@dataclass
class Stretch:
    """One segment of the structure, its frames and its tube. chainage = origin + sign * s. d_mean_sigma: random, of the
    mean diameter over all of it. camera: relative sigma by the camera's covariance, at the stations (0: not known);
    mean_camera: of their mean, in which errors that change their sign along the pipe cancel; None: not known.
    water: see `tube_water.mirrored`, whose points are not in the tube."""

    segment: int
    tube: Tube
    frames: np.ndarray
    origin: float
    sign: int
    d_mean_sigma: float = math.nan
    camera: Any = 0.0
    mean_camera: float | None = None
    water: list[dict[str, Any]] = field(default_factory=list)

    def chainage(self, s: Any) -> Any:
        """Along the survey, from s along the tube."""
        return self.origin + self.sign * np.asarray(s, float)


@dataclass
class Residuals:
    """Of every observation of a point: position of its frame and of its point in the structure, item of the tracks,
    (N,2) px, angle from the axis, and size over OUTLIER_SIGMA's unit: the tracker's stated noise times `spread`, the
    robust spread of the residuals over it."""

    frame: np.ndarray
    point: np.ndarray
    item: np.ndarray
    pixels: np.ndarray
    theta: np.ndarray
    whitened: np.ndarray
    spread: float

    @property
    def inlier(self) -> np.ndarray:
        return self.whitened <= OUTLIER_SIGMA


@dataclass
class Measurement:
    """A measured survey.

    index       (K,) index of each keyframe that is here; frames below and in `structure` count these
    encoder     (K,) metres by the encoder, NaN where unknown; None without a usable one. Without the jitter of its
                readings where they have one
    structure   in the unit of `scale`
    pupil_sigma    relative systematic sigma of a diameter by a pupil shift that the profile does not know, and so
                assumed
    health      what the survey says of its profile
    repeats     how often the wall looks the same elsewhere; None: its pictures were not looked at
    jumped      frames at which tracks had gone on to the next repeat, and were cut
    remarks     what one should know, in words, most serious first
    factors     of each segment: by what the adjustment's unit was multiplied
    """

    survey: Survey
    camera: Camera
    tracks: Tracks
    index: np.ndarray
    encoder: np.ndarray | None
    structure: Reconstruction
    scale: Scale
    nominal: float | None
    stretches: list[Stretch]
    residuals: Residuals
    backwards: bool
    pupil_sigma: float = 0.0
    health: ProfileCheck | None = None
    repeats: Repetition | None = None
    jumped: list[int] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    factors: list[float] = field(default_factory=list)

    @property
    def measured(self) -> list[Stretch]:
        """Stretches with a tube."""
        return [s for s in self.stretches if s.tube.status == "ok"]

    @property
    def camera_sigma(self) -> float | None:
        """Relative systematic sigma of mean_diameter() by the camera's covariance, 0 where that is given; None: not
        known. What is wrong with a camera is wrong in all stretches: their sigmas add up as they are."""
        known = [(s.tube.summary["measured"], s.mean_camera) for s in self.measured if s.mean_camera is not None]
        return float(np.average([c for _, c in known], weights=[w for w, _ in known])) if known else None

    @property
    def systematic(self) -> float:
        """Relative sigma of mean_diameter(), beside its random one. That of a station is in its own columns."""
        return math.hypot(self.scale.sigma, self.camera_sigma or 0.0, self.pupil_sigma)

    @property
    def up(self) -> np.ndarray:
        """Against gravity, or up in the first keyframe."""
        down = self.structure.down
        return -down if down is not None else np.array([0.0, -1.0, 0.0])

    def path(self, segment: int) -> np.ndarray:
        """Camera centres in the order in which the tube's s grows: the way the camera looks."""
        centres = self.structure.centres[self.structure.segment == segment]
        return centres[::-1] if self.backwards else centres

    def frame_chainage(self) -> np.ndarray:
        """(F,) chainage of the structure's frames, by the encoder or along the path."""
        if self.encoder is not None:
            return self.encoder[self.structure.frames]
        steps = np.linalg.norm(np.diff(self.structure.centres, axis=0), axis=1)
        return np.append(0.0, np.cumsum(steps))


def mean_diameter(m: Measurement) -> tuple[float, float]:
    """Mean over all that was measured, and its random sigma."""
    weight = np.array([s.tube.summary["measured"] for s in m.measured], float)
    weight /= weight.sum()
    value = float(sum(w * s.tube.summary["d_mean"] for w, s in zip(weight, m.measured, strict=True)))
    return value, math.sqrt(sum((w * s.d_mean_sigma) ** 2 for w, s in zip(weight, m.measured, strict=True)))
