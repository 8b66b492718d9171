"""Structure from motion: camera poses and wall points from tracks, with their covariances.

Works on rays, so views of 180 degrees and beyond are ordinary. docs/reconstruction.md describes the method.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _engine
from .camera import PARAMETERS, Camera
from .errors import ArgumentError
from .structure_gaps import Zooms
from .structure_links import linked
from .survey import Tracks

Floats = npt.NDArray[np.float64]

#: Of a held camera's covariance this share goes into the adjustment: so little that the camera neither moves nor is
#: sharpened, and enough for what it adds to be told from rounding. What it adds is divided by it.
HELD = 1e-4

#: Observations of which derivatives are there at a time: by all of a camera's parameters they take as much as the rest.
AT_ONCE = 20_000

#: Why a stretch was not measured, in words.
REASONS = {
    "weak_texture": "too few tracks in common",
    "no_baseline": "the camera stood still or only turned",
    "no_rigid_scene": "the tracks agree with no motion of this camera (wrong profile, or a scene that moves)",
    "low_parallax": "the points' depths are not determined",
    "merge_failed": "two stretches do not fit together",
    "repeated_pattern": "the wall looks the same again and again, and the tracks went on to the next repeat",
    "zoom": "the lens zoomed, and from there on its profile does not hold",
}


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """How good the distances are.

    noise_m_per_sqrt_m  random part: sigma of the distance over one metre; 0.5 mm in 5 cm are 0.00224
    scale_sigma         relative sigma of the wheel's scale, the same over the whole survey
    quantum             metres a count: readings are multiples of it
    """

    noise_m_per_sqrt_m: float = 0.00224
    scale_sigma: float = 0.003
    quantum: float = 0.0


@dataclass(frozen=True)
class RollingShutter:
    """Rows that are exposed one after the other: row v is, line_time (v - middle_row) after its frame's time.

    time        (F,) seconds of each frame, NaN where unknown: there the frame counts as seen at once
    line_time   seconds from a row's exposure to the next one's, below 0 for a camera that reads upwards
    middle_row  that is exposed at the frame's time, None: the picture's middle
    """

    time: npt.ArrayLike
    line_time: float
    middle_row: float | None = None


@dataclass(frozen=True)
class Gap:
    """A stretch between two frames that was not measured."""

    first: int
    last: int
    reason: str  #: a key of REASONS
    common: int  #: tracks in common

    def __str__(self) -> str:
        return f"frames {self.first} to {self.last}: {REASONS[self.reason]}"


def changed_camera(camera: Camera, names: Sequence[str], change: Floats) -> Camera:
    """The camera with a change (n,) of those of PARAMETERS, without a covariance."""
    values: dict[str, Any] = {}
    for name, by in zip(names, change, strict=True):
        key, _, index = name.partition("[")
        if index:
            values.setdefault(key, list(getattr(camera, key)))[int(index[:-1])] += float(by)
        else:
            values[key] = getattr(camera, key) + float(by)
    for kind in ("asym_radial_phi", "asym_tangential_phi"):  # of unit norm: a factor belongs to the part in theta
        norm = float(np.linalg.norm(values.get(kind, ())))
        if norm > 0:
            along = kind.replace("phi", "theta")
            values[kind] = [v / norm for v in values[kind]]
            values[along] = [v * norm for v in values.get(along, getattr(camera, along))]
    return dataclasses.replace(camera, covariance=None, covariance_parameters=(), **values)


@dataclass
class Reconstruction:
    """Poses and points.

    status           "ok"; "partial": some stretches are missing (gaps); "failed": nothing was measured (reason)
    reason           one line, empty for "ok"
    frames           (K,) int64, frames with a pose, ascending
    poses            (K,3,4) cam_from_world; the world is the camera of the first frame
    segment          (K,) int64: frames of one segment were measured against each other; between segments there is
                     odometry at best
    points           (N,3), track (N,) int64 the track of each, point_segment (N,)
    covariance       (N,3,3) of the points and pose_covariance (K,6,6) of the poses (rotation on the left, then centre),
                     random part, in the gauge of `gauge`; first frame of each segment: 0
    own_covariance   (N,3,3) random part of the points, the poses held, by the residuals: what neighbours do not have in
                     common. What fits a shape to the points wants this one: the other grows with the distance from the
                     first frame
    systematic       (N,3,3), pose_systematic (K,6,6): what the camera's own uncertainty adds; None where the profile
                     has no covariance
    unit             "metre", or "arbitrary" where there is no source of scale
    gauge            what the covariances are relative to
    scale_sigma      relative sigma of the scale, wheel included; None without a source
    wheel            (true distance over reading) - 1 as estimated, and wheel_sigma
    sigma            robust spread of the residuals, in units of the stated noise; variance_factor likewise, after
                     outliers were removed, of each segment's pixels
    noise            of each segment: of the pixels over the stated one, as the estimate and its covariances have it:
                     what the variance factor says (not less than 1 with common_errors). The encoder's, the
                     inclinometer's and the camera's uncertainty stay as stated
    observations     used; outside: beyond the camera's model; repeated: the same track twice in a frame
    standing         frames not used: nothing had moved since the one before
    gaps             list of Gap
    down             (3,) direction of gravity in the world, None where the first segment has no reading of an
                     inclinometer
    sag              (3,) px^2, of each segment: the tracks' common sag all around alike, and what along a radius at
                     phi its cosine and sine of 2 phi add
    line_time        seconds, and its sigma, as the survey's own rows tell it; None without a rolling shutter
    shutter          what was said of a rolling shutter; poses are those of its middle row: see poses_at()
    camera_change    (segments, n) change of the camera's parameters as estimated with their prior, names in
                     camera_parameters; None where the profile has no covariance. See camera_of()
    cost             sum of half the squared residuals
    pupil            of each segment, the shift of the camera's pupil as estimated, in its unit; empty where a wheel's
                     metres tell that all along
    pupil_free       whether it was estimated in all of them, and not in some held at the camera's
    joined           (n,2) int64 tracks that are another's continuation under a name of their own, and that one
    drift            of each segment, with reconstruct(drift=...): camera (m,) changes of the parameters and their
                     covariance (m,m); poses, points and tracks as they are then; noise, the factor
    """

    status: str
    reason: str
    frames: npt.NDArray[np.int64]
    poses: Floats
    segment: npt.NDArray[np.int64]
    points: Floats
    track: npt.NDArray[np.int64]
    point_segment: npt.NDArray[np.int64]
    covariance: Floats
    pose_covariance: Floats
    systematic: Floats | None
    pose_systematic: Floats | None
    unit: str
    gauge: str
    scale_sigma: float | None
    wheel: float
    wheel_sigma: float
    sigma: list[float]
    variance_factor: list[float]
    noise: list[float]
    observations: int
    outside: int
    repeated: int
    standing: list[int]
    gaps: list[Gap]
    down: Floats | None
    camera_change: Floats | None
    camera_parameters: tuple[str, ...]
    cost: float
    sag: list[Floats] = field(default_factory=list)
    pupil: list[float] = field(default_factory=list)
    pupil_free: bool = False
    own_covariance: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)), repr=False)
    iterations: list[int] = field(default_factory=list)
    joined: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64), repr=False)
    drift: list[dict[str, Any]] = field(default_factory=list, repr=False)
    shutter: RollingShutter | None = field(default=None, repr=False)
    line_time: tuple[float, float] | None = None
    camera_share: float = 1.0  # of its covariance that went into the adjustment: HELD of a held camera
    parts: list[tuple[Any, Any]] = field(default_factory=list, repr=False)  # the engine's covariances of each segment
    turns: list[Floats] = field(default_factory=list, repr=False)  # world from segment, rotations

    @property
    def centres(self) -> Floats:
        """(K,3) where the camera was."""
        return -np.einsum("nij,ni->nj", self.poses[:, :, :3], self.poses[:, :, 3])

    def poses_at(self, place: npt.NDArray[np.int64], pixels: Floats) -> Floats:
        """(n,3,4) where the camera was when it saw pixels (n,2) of the frames in `place` (n,), positions in `frames`:
        the frames' poses or, with a rolling shutter, on the way to a neighbour."""
        if self.shutter is None:
            return self.poses[place]
        return _engine.row_poses(
            np.ascontiguousarray(self.poses),
            self.segment.astype(np.int32),
            np.asarray(self.shutter.time, dtype=np.float64)[self.frames],
            place.astype(np.int32),
            np.ascontiguousarray(self.shutter.line_time * (pixels[:, 1] - self.shutter.middle_row)),
        )

    def names(self, track: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Under what name each of these tracks (n,) may have a point in `track`."""
        if not len(self.joined):
            return track.copy()
        # In the order of `joined`, which is np.unique's: by the first name, of which each has one row.
        place = np.minimum(np.searchsorted(self.joined[:, 0], track), len(self.joined) - 1)
        return np.where(self.joined[place, 0] == track, self.joined[place, 1], track)

    def functions_covariance(
        self, points: npt.ArrayLike, jacobian: npt.ArrayLike, *, systematic: bool = False
    ) -> Floats:
        """(m,m) covariance of m linear functions of points, with all that they share through the poses.

        points (n,) places in `points`, all of one segment; jacobian (m,n,3). systematic: with the camera's uncertainty.
        Variances of the points alone, added up, are several times too small for what is averaged over many points.
        Raises ArgumentError for points of several segments, or where the camera's uncertainty is not known."""
        places, rows = np.asarray(points, dtype=np.int64), np.asarray(jacobian, dtype=np.float64)
        if places.ndim != 1 or rows.ndim != 3 or rows.shape[1:] != (len(places), 3):
            raise ArgumentError(f"jacobian: expected shape (m, {len(places)}, 3), got {rows.shape}")
        if not len(places):
            return np.zeros((len(rows), len(rows)))
        segments = np.unique(self.point_segment[places])
        if len(segments) > 1:
            raise ArgumentError("points: of several segments, which have nothing in common")
        number = int(segments[0])
        random, total = self.parts[number]
        if systematic and total is None:
            raise ArgumentError("systematic: the camera's profile has no covariance")
        first = int(np.searchsorted(self.point_segment, number))
        rows = np.ascontiguousarray(rows @ self.turns[number])
        inside = (places - first).astype(np.int32)
        found = random.functions(inside, rows)
        if systematic:
            return found + (total.functions(inside, rows) - found) / self.camera_share
        return found

    def in_its_unit(self, camera: Camera, segment: int) -> Camera:
        """The camera with its pupil's shift in the segment's unit, where no encoder's metres are that."""
        return dataclasses.replace(camera, pupil_e1=self.pupil[segment]) if self.pupil else camera

    def camera_of(self, camera: Camera, segment: int) -> Camera:
        """The camera with which a segment's poses and points agree: as estimated with its prior, its pupil's shift in
        their unit."""
        camera = self.in_its_unit(camera, segment)
        if self.camera_change is None:
            return camera
        return changed_camera(camera, self.camera_parameters, self.camera_change[segment])

    @property
    def length(self) -> float:
        """Of the camera's path, within segments."""
        steps = np.linalg.norm(np.diff(self.centres, axis=0), axis=1)
        return float(steps[np.diff(self.segment) == 0].sum())


def _steps(chainage: npt.ArrayLike, frames: int, encoder: Encoder) -> tuple[Floats, Floats]:
    """Distance from each frame to the next (frames,), and its sigma."""
    given = np.asarray(chainage, dtype=np.float64)
    if given.ndim != 1 or len(given) < frames:
        raise ArgumentError(f"chainage: expected one number for each of {frames} frames, got shape {given.shape}")
    sigmas = (encoder.noise_m_per_sqrt_m, encoder.scale_sigma, encoder.quantum)
    if not (np.isfinite(sigmas).all() and min(sigmas) >= 0.0 and encoder.scale_sigma > 0.0):
        raise ArgumentError(f"encoder: scale_sigma is not above 0, or another value of {encoder} is below")
    step = np.append(np.diff(given[:frames]), np.nan)
    noise = encoder.noise_m_per_sqrt_m**2 * np.abs(np.nan_to_num(step)) + encoder.quantum**2 / 6.0
    if not (noise[np.isfinite(step) & (step != 0.0)] > 0.0).all():
        raise ArgumentError("encoder: neither noise_m_per_sqrt_m nor quantum is above 0")
    return step, np.sqrt(np.maximum(noise, 1e-12))


def _down(attitude: npt.ArrayLike, frames: int) -> Floats:
    """Gravity in the camera's frame (frames,3) from roll and pitch; zero where they are not known."""
    given = np.asarray(attitude, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] != 2 or len(given) < frames:
        raise ArgumentError(f"attitude: expected roll and pitch for each of {frames} frames, got shape {given.shape}")
    known = np.isfinite(given[:frames]).all(axis=1)
    roll, pitch = np.where(known[:, None], given[:frames], 0.0).T
    down = np.column_stack([np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch), -np.sin(pitch)])
    return np.ascontiguousarray(np.where(known[:, None], down, 0.0))


def _checked(shutter: RollingShutter, frames: int, camera: Camera) -> RollingShutter | None:
    """As the engine wants it; None where all rows are exposed at once."""
    time = np.ascontiguousarray(shutter.time, dtype=np.float64)
    if time.ndim != 1 or len(time) < frames:
        raise ArgumentError(f"shutter: expected one time for each of {frames} frames, got shape {time.shape}")
    middle = (camera.height - 1) / 2 if shutter.middle_row is None else shutter.middle_row
    if not np.isfinite([shutter.line_time, middle]).all():
        raise ArgumentError(f"shutter: line_time {shutter.line_time} or middle_row {middle} is not finite")
    return RollingShutter(time[:frames], float(shutter.line_time), float(middle)) if shutter.line_time else None


def _merged(segments: Sequence[dict[str, Any]], steps: Floats | None, frames: npt.NDArray[np.int64]) -> list[Floats]:
    """For each segment the (3,4) that takes it into the world of the first: along the path by odometry, where there is
    any."""
    moves = [np.eye(3, 4)]
    for before, after in itertools.pairwise(segments):
        r, t = moves[-1][:, :3], moves[-1][:, 3]
        centres = [-np.einsum("nij,ni->nj", s["poses"][:, :, :3], s["poses"][:, :, 3]) for s in (before, after)]
        ahead = r @ (centres[0][-1] - centres[0][-2])
        first = centres[1][1] - centres[1][0]
        ahead, first = ahead / np.linalg.norm(ahead), first / np.linalg.norm(first)
        distance = 0.0
        if steps is not None:
            start, end = frames[before["first"] + len(before["poses"]) - 1], frames[after["first"]]
            distance = float(np.nan_to_num(np.abs(steps[start:end])).sum())
        axis, cosine = np.cross(first, ahead), float(first @ ahead)
        k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        turn = np.eye(3) + k + k @ k / (1 + cosine) if cosine > -0.999 else r
        place = r @ centres[0][-1] + t + distance * ahead
        moves.append(np.column_stack([turn, place - turn @ centres[1][0]]))
    return moves


@dataclass(frozen=True)
class _Asked:
    """What the engine is asked, in its terms."""

    tracks: Tracks
    names: npt.NDArray[Any]  # of the tracks; the engine has numbers
    camera: Camera
    sigma: float
    method: str
    seed: int
    threads: int
    still: float
    step: Floats | None
    step_sigma: Floats | None
    scale_sigma: float
    down: Floats | None
    down_sigma: float
    covariance: Floats | None
    drift: tuple[Sequence[str], Floats, float] | None
    common_errors: bool
    sag_sigma: float
    shutter: RollingShutter | None
    pupil_sigma: float
    diameter: float | None

    def run(self, numbers: npt.NDArray[Any], end: int) -> dict[str, Any]:
        """What the engine finds of the frames before one, with these numbers of the observations' tracks."""
        tracks, drift, shutter = self.tracks, self.drift, self.shutter
        kept = slice(None) if not len(tracks.frame) or tracks.frame.max() < end else tracks.frame < end
        return _engine_run(
            self.camera._profile,
            end,
            len(self.names),
            tracks.frame[kept].astype(np.int32),
            numbers[kept].astype(np.int32),
            np.ascontiguousarray(tracks.pixels[kept]),
            None if tracks.covariance is None else np.ascontiguousarray(tracks.covariance[kept]),
            self.sigma,
            self.method,
            self.seed,
            self.threads,
            self.still,
            None if self.step is None else self.step[:end],
            None if self.step_sigma is None else self.step_sigma[:end],
            self.scale_sigma,
            None if self.down is None else self.down[:end],
            self.down_sigma,
            [PARAMETERS.index(name) for name in self.camera.covariance_parameters],
            self.covariance,
            [PARAMETERS.index(name) for name in drift[0]] if drift else [],
            np.ascontiguousarray(drift[1]) if drift else None,
            float(drift[2]) if drift else 1.0,
            self.common_errors,
            self.sag_sigma,
            None if shutter is None else np.asarray(shutter.time)[:end],
            0.0 if shutter is None else shutter.line_time,
            0.0 if shutter is None else shutter.middle_row,
            self.pupil_sigma,
            0.5 * (self.diameter or 0.0),
        )

    def typical_noise(self) -> float:
        """Of an observation, pixels."""
        covariance = self.tracks.covariance
        if covariance is None or not len(self.tracks.frame):
            return self.sigma
        return float(np.sqrt(np.median(np.einsum("nii->n", covariance)) / 2))


def _linked(
    asked: _Asked, found: dict[str, Any], numbers: npt.NDArray[Any], end: int, noise: float
) -> tuple[dict[str, Any], Tracks, npt.NDArray[np.int64]]:
    """Once more with tracks joined across breaks, where that leaves fewer segments: what is found then, the tracks so
    joined, and which names became which."""
    tracks, names = asked.tracks, asked.names
    none = np.zeros((0, 2), np.int64)
    joined = linked(asked.camera, found, tracks.frame, numbers, tracks.pixels, noise, asked.step)
    if joined is None:
        return found, tracks, none
    again = asked.run(joined, end)
    if len(again["segments"]) >= len(found["segments"]):
        return found, tracks, none
    moved = joined != np.searchsorted(names, tracks.track)
    pairs = np.unique(np.column_stack([tracks.track, names[joined]])[moved], axis=0)
    return again, dataclasses.replace(tracks, track=names[joined]), pairs


def reconstruct(
    tracks: Tracks,
    camera: Camera,
    chainage: npt.ArrayLike | None = None,
    *,
    encoder: Encoder | None = None,
    attitude: npt.ArrayLike | None = None,
    attitude_sigma: float = 0.01,
    sigma: float = 0.3,
    method: str = "hierarchical",
    threads: int | None = None,
    seed: int = 0,
    still: float = 0.5,
    sag_sigma: float = 0.0,
    hold_camera: bool = False,
    drift: tuple[Sequence[str], Floats, float] | None = None,
    common_errors: bool = False,
    shutter: RollingShutter | None = None,
    pupil_sigma: float = 0.0,
    diameter: float | None = None,
) -> Reconstruction:
    """Poses of the frames and points of the tracks.

    chainage   (F,) metres driven at each frame 0..F-1, NaN where unknown; encoder: how good it is. Without it the
               result has no unit: the distance from the first to the last frame of each segment is 1.
    attitude   (F,2) roll and pitch of each frame, radians (Telemetry's), NaN where unknown, with attitude_sigma
    sigma      px, of pixels without a covariance
    method     "hierarchical" (leaves of three and more frames, merged) or "incremental" (frame after frame): equal
               results but for rounding
    threads    None: all cores; the result is the same for any number
    still      px: frames in which tracks moved less (median) are not used
    sag_sigma  px^2, above 0: tracks have a common sag that is not known, as those of a tracker with a window have in a
               tube: it follows the mean motion over the window, not its middle's (docs/reconstruction.md). Half of it
               for what differs around the picture
    hold_camera   the camera stays as it is, and its covariance is propagated as it is: no tracks sharpen it
    drift      names of the camera's parameters, their covariance, as wide as they may have changed since it was
               calibrated, and a factor on the noise of the tracks: the adjustment is then made once more with them
               free, for Reconstruction.drift alone
    common_errors   the stated noise holds errors that tracks have in common, too, which leave no residual: it counts
               as stated even where residuals are smaller, against the encoder and in the covariances
    shutter    of a camera whose rows are exposed one after the other; None: all at once
    pupil_sigma   metres, above 0: where no chainage tells lengths the pupil's shift is estimated in the structure's
               unit, about the camera's, which is known to this sigma, and where the chainage is not known all along, in
               metres, unless the camera's covariance holds it. 0: without chainage lenses count as central
    diameter   of the pipe, metres, to a few per cent: what that unit is, for the pupil's shift alone; None: not known

    What cannot be measured is a status with a reason; what was measured is kept. Raises ArgumentError for arguments
    that are wrong in themselves.
    """
    if method not in ("hierarchical", "incremental"):
        raise ArgumentError(f"method: {method!r} is neither 'hierarchical' nor 'incremental'")
    if not sigma > 0.0:
        raise ArgumentError(f"sigma: {sigma} is not above 0")
    frames = int(tracks.frame.max()) + 1 if len(tracks.frame) else 0
    names, numbers = np.unique(tracks.track, return_inverse=True)
    step = step_sigma = down = None
    encoder = encoder or Encoder()
    if chainage is not None:
        step, step_sigma = _steps(chainage, frames, encoder)
    if attitude is not None:
        if not (np.isfinite(attitude_sigma) and attitude_sigma > 0.0):
            raise ArgumentError(f"attitude_sigma: {attitude_sigma} is not above 0")
        down = _down(attitude, frames)
    if shutter is not None:
        shutter = _checked(shutter, frames, camera)
    share = HELD if hold_camera else 1.0
    asked = _Asked(
        tracks=tracks,
        names=names,
        camera=camera,
        sigma=float(sigma),
        method=method,
        seed=seed,
        threads=threads or len(os.sched_getaffinity(0)),
        still=float(still),
        step=step,
        step_sigma=step_sigma,
        scale_sigma=float(encoder.scale_sigma),
        down=down,
        down_sigma=float(attitude_sigma),
        covariance=None if camera.covariance is None else np.ascontiguousarray(camera.covariance * share),
        drift=drift,
        common_errors=common_errors,
        sag_sigma=float(sag_sigma),
        shutter=shutter,
        pupil_sigma=float(pupil_sigma),
        diameter=diameter,
    )
    noise = asked.typical_noise()
    found, end = asked.run(numbers, frames), frames
    zoomed = Zooms(camera, tracks.frame, numbers, tracks.pixels, noise).first(found, lambda e: asked.run(numbers, e))
    if zoomed:
        end, found = zoomed
    found, tracks, linked_tracks = _linked(asked, found, numbers, end, noise)
    out = _result(found, names, end, step, encoder, camera, share)
    if zoomed:
        out.gaps.append(Gap(int(out.frames[-1]) if len(out.frames) else 0, frames - 1, "zoom", 0))
        out.status = "partial" if len(out.frames) else "failed"
        out.reason = "; ".join(str(gap) for gap in out.gaps[-3:])
    out.shutter, out.joined = shutter, linked_tracks
    if shutter is not None:
        out.line_time = _line_time(found["segments"], shutter.line_time)
    for part in out.drift:
        part["noise"] = drift[2]
    out.own_covariance = _own_covariance(out, tracks, camera, sigma)
    return out


def _engine_run(*arguments: Any) -> dict[str, Any]:
    try:
        return _engine.reconstruct(*arguments)
    except ValueError as error:  # numbers that leave the range of an adjustment
        raise ArgumentError(f"these tracks, chainage and priors cannot be adjusted: {error}") from error


def _own_covariance(rec: Reconstruction, tracks: Tracks, camera: Camera, sigma: float) -> Floats:
    """(N,3,3) of the points with the poses held. Observations beyond 3.5 sigma do not count."""
    if not len(rec.points):
        return np.zeros((0, 3, 3))
    cameras = [rec.camera_of(camera, segment) for segment in range(len(rec.sigma))]
    place = np.minimum(np.searchsorted(rec.frames, tracks.frame), len(rec.frames) - 1)
    here = rec.frames[place] == tracks.frame
    # Points are in the order of segment and track; a track may have one in each of several segments.
    most = int(max(rec.track.max(), tracks.track.max())) + 1
    keys, wanted = rec.point_segment * most + rec.track, rec.segment[place] * most + tracks.track
    number = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    here &= keys[number] == wanted
    item = np.flatnonzero(here)
    information = np.zeros((len(rec.points), 3, 3))
    for start in range(0, len(item), AT_ONCE):
        some = item[start : start + AT_ONCE]
        _add_information(information, rec, tracks, cameras, sigma, some, number[some], place[some])
    # A point that keeps too few observations keeps the whole covariance.
    sound = np.linalg.eigvalsh(information)[:, 0] > 1e-12 * np.einsum("nii->n", information)
    own = rec.covariance.copy()
    own[sound] = np.linalg.inv(information[sound])
    return own


def _add_information(
    information: Floats,
    rec: Reconstruction,
    tracks: Tracks,
    cameras: list[Camera],
    sigma: float,
    item: npt.NDArray[np.int64],
    number: npt.NDArray[np.int64],
    place: npt.NDArray[np.int64],
) -> None:
    """Adds to `information` (N,3,3) what observations `item` (n,) tell of points `number` (n,) from frames in `place`
    (n,)."""
    poses = rec.poses_at(place, tracks.pixels[item])
    turn = poses[:, :, :3]
    seen = np.einsum("nij,nj->ni", turn, rec.points[number]) + poses[:, :, 3]
    pixels, ok, slope = np.empty((len(item), 2)), np.zeros(len(item), bool), np.empty((len(item), 2, 3))
    for segment, own in enumerate(cameras):
        inside = np.flatnonzero(rec.segment[place] == segment)
        pixels[inside], ok[inside], slope[inside] = own.project_jacobian(seen[inside])[:3]
    spread = np.broadcast_to(sigma**2 * np.eye(2), (len(item), 2, 2))
    if tracks.covariance is not None:
        spread = tracks.covariance[item]
    weight = np.linalg.inv(spread)
    off = tracks.pixels[item] - pixels
    factor = np.array(rec.variance_factor)[rec.segment[place]]
    ok = ok & (np.einsum("ni,nij,nj->n", off, weight, off) < 3.5**2 * np.maximum(factor, 0.25))
    by_point = slope[ok] @ turn[ok]
    told = by_point.transpose(0, 2, 1) @ weight[ok] @ by_point / factor[ok, None, None]
    np.add.at(information, number[ok], told)


def _wheel_sigma(segment: dict[str, Any] | None) -> float | None:
    """Of the first parameter that all poses share, the wheel's scale, where there is one."""
    return float(np.sqrt(segment["random"].border[0, 0])) if segment and segment["metric"] else None


def _line_time(segments: list[dict[str, Any]], stated: float) -> tuple[float, float] | None:
    """Of all segments, weighed."""
    told = [(s["late"], s["late_sigma"] ** -2.0) for s in segments if s["late_sigma"] > 0]
    if not told:
        return None
    share, weight = np.array(told).T
    return stated * float(share @ weight / weight.sum()), abs(stated) / float(np.sqrt(weight.sum()))


def _stacked(parts: list[npt.NDArray[Any]], shape: tuple[int, ...], dtype: type = np.float64) -> npt.NDArray[Any]:
    return np.concatenate(parts) if parts else np.zeros((0, *shape), dtype)


def _result(
    found: dict[str, Any],
    names: npt.NDArray[np.int64],
    count: int,
    step: Floats | None,
    encoder: Encoder,
    camera: Camera,
    share: float,
) -> Reconstruction:
    """The engine's answer in terms of the caller's frames and tracks."""
    used = found["frames"].astype(np.int64)
    segments = found["segments"]
    gaps = [Gap(int(used[a]), int(used[b]), reason, common) for a, b, reason, common in found["gaps"]]
    moves = _merged(segments, step, used)
    poses, points, covariances, pose_covariances, systematic, pose_systematic = [], [], [], [], [], []
    for s, move in zip(segments, moves, strict=False):
        r, t = move[:, :3], move[:, 3]
        turned = s["poses"][:, :, :3] @ r.T
        poses.append(np.concatenate([turned, (s["poses"][:, :, 3] - turned @ t)[:, :, None]], axis=2))
        points.append(s["points"] @ r.T + t)
        spin = np.eye(6)
        spin[3:, 3:] = r
        covariances.append(r @ s["random"].point @ r.T)
        pose_covariances.append(spin @ s["random"].pose @ spin.T)
        pose_covariances[-1][0] = 0.0  # held; the engine has the unit matrix there
        if s["total"] is not None:
            systematic.append(r @ (s["total"].point - s["random"].point) @ r.T / share)
            pose_systematic.append(spin @ (s["total"].pose - s["random"].pose) @ spin.T / share)
    metric = bool(segments) and all(s["metric"] for s in segments)
    status = "failed" if not segments else "partial" if gaps or len(segments) > 1 else "ok"
    reason = "" if status == "ok" else "; ".join(str(gap) for gap in gaps[:3])
    if status == "failed" and not reason:
        reason = f"fewer than three frames with something to see that moves ({len(used)} of {count})"
    first = segments[0] if segments else None
    return Reconstruction(
        status=status,
        reason=reason,
        frames=_stacked([used[s["first"] : s["first"] + len(s["poses"])] for s in segments], (), np.int64),
        poses=_stacked(poses, (3, 4)),
        segment=_stacked([np.full(len(s["poses"]), i) for i, s in enumerate(segments)], (), np.int64),
        points=_stacked(points, (3,)),
        track=_stacked([names[s["tracks"]] for s in segments], (), np.int64),
        point_segment=_stacked([np.full(len(s["points"]), i) for i, s in enumerate(segments)], (), np.int64),
        covariance=_stacked(covariances, (3, 3)),
        pose_covariance=_stacked(pose_covariances, (6, 6)),
        systematic=_stacked(systematic, (3, 3)) if systematic else None,
        pose_systematic=_stacked(pose_systematic, (6, 6)) if systematic else None,
        unit="metre" if metric else "arbitrary",
        gauge="first frame" if metric else "first frame and distance to the last",
        scale_sigma=_wheel_sigma(first),
        wheel=float(first["wheel"]) if first else 0.0,
        wheel_sigma=_wheel_sigma(first) or 0.0,
        sigma=[s["sigma"] for s in segments],
        variance_factor=[s["variance_factor"] for s in segments],
        noise=[s["noise"] for s in segments],
        observations=sum(s["observations"] for s in segments),
        outside=found["outside"],
        repeated=found["repeated"],
        standing=sorted(set(range(count)) - set(used.tolist())),
        gaps=gaps,
        down=first["down"] if first and np.any(first["down"]) else None,
        camera_change=np.array([s["camera"] for s in segments]) if first and len(first["camera"]) else None,
        camera_parameters=camera.covariance_parameters,
        camera_share=share,
        cost=sum(s["cost"] for s in segments),
        sag=[s["sag"] for s in segments],
        pupil=[] if metric and not any(s["frees_pupil"] for s in segments) else [s["pupil"] for s in segments],
        pupil_free=all(s["frees_pupil"] for s in segments),
        iterations=[s["iterations"] for s in segments],
        drift=[s["drift"] | {"tracks": names[s["drift"]["tracks"]]} for s in segments if s["drift"]],
        parts=[(s["random"], s["total"]) for s in segments],
        turns=[move[:, :3] for move in moves[: len(segments)]],
    )
