"""From a survey to a measured pipe: poses and points, scale, a tube for each stretch. docs/reconstruction.md."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from pipefish import _engine
from pipefish.assumed import assumed
from pipefish.camera import Camera
from pipefish.errors import ArgumentError, PipefishError
from pipefish.health import ProfileCheck, check_profile, drift_prior
from pipefish.pupil import pupil_sigma
from pipefish.readings import smoothed
from pipefish.repeated import Repetition, cut, jumps, renamed, repetition
from pipefish.rolling import shutter_of
from pipefish.scale import Known, Scale, with_diameter
from pipefish.scale_sources import beforehand, find_scale
from pipefish.sectionsigma import diameter_sigma, shared_of
from pipefish.structure import Encoder, Reconstruction, reconstruct
from pipefish.survey import Survey, Tracks
from pipefish.target import Target
from pipefish.tube import AGAINST_GRAVITY, Tube, fit_tube
from pipefish.tube_water import depth, mirrored

T = TypeVar("T")
Tell = Callable[[float, str], None]  # fraction done, what is going on

OUTLIER_SIGMA = 3.5  # residuals beyond do not count in the quality page and are not in the COLMAP model
ENCODER_LEAST_M = 0.02  # an encoder that moved less tells no scale
# A tracker's stated covariance is that of one frame's noise. Along a track errors add up, each track its own: in
# simulated pipes (concrete, brick) 0.3 to 0.5 px for each radian by which the point has moved away from the axis.
TRACK_WALK_PX = 0.3
# What all tracks have in common does not average out: 0.01 px a keyframe bends the scale by per cents in 6 m where
# vision outvotes the encoder. The largest part of it has a known form and is estimated: px^2, the second moment
# of a window of 21 px is 37; 70 to 90 were found, of a tracker that corrects for it 25. For the rest vision's word
# counts less: scatter of the diameter in concrete and brick with 0.3 px 0.10 and 0.88 %, with 0.5 px 0.07 and
# 0.09 %, with 0.8 px 0.06 and 0.10 %.
TRACK_SAG_PX2 = 100.0
TRACK_FLOOR_PX = 0.5
# An ellipse has no encoder in it, and the floor is more than what tracks have in common: ellipses of rendered brick,
# concrete and PVC were off (both parameters, along the whole pipe) as by 0.5, 0.4 and 0.3 px.
TRACK_COMMON_PX = 0.4
# A check of the profile asks for drifts beside the lens's own ripples, not for a scale that holds along the pipe: of
# these sigmas it takes so much, 0.3 px and 0.18 px a radian. By their errors alone tracks of drawn brick and concrete
# then show a drift with a chi-square of 2 and 3 for 5 degrees of freedom.
TRACK_SHARPER = 0.6
STOOD = 10  # frames in which less than a centimetre was driven
DEFAULT_ATTITUDE_SIGMA = 0.01


@dataclass
class Stretch:
    """One segment of the structure, its frames and its tube. chainage = origin + sign * s. d_mean_sigma: random, of the
    mean diameter over all of it. camera: relative sigma by the camera's covariance, at the stations (0: not known).
    water: see `tube_water.mirrored`, whose points are not in the tube."""

    segment: int
    tube: Tube
    frames: np.ndarray
    origin: float
    sign: int
    d_mean_sigma: float = math.nan
    camera: Any = 0.0
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
    camera_sigma   relative systematic sigma of a diameter by the camera's covariance (median of the stations); None:
                not known
    pupil_sigma    the same by a pupil shift that the profile does not know, and so assumed
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
    camera_sigma: float | None
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
    def systematic(self) -> float:
        """Relative sigma that all diameters share."""
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


def camera_of(survey: Survey, given: Camera | None) -> Camera:
    """The given camera, or that of the survey's profile. Raises PipefishError where there is none that fits."""
    camera = given
    if camera is None:
        if survey.start is None or not survey.start.profile:
            raise PipefishError(f"{survey.path}: holds no camera profile: give one with --profile")
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
            f"The device does not say how good its encoder's scale is: {100 * quality.scale_sigma:.1f} % (one "
            "sigma) is "
            "assumed."
        )
    return chainage, quality


def _attitude(survey: Survey) -> tuple[np.ndarray | None, float]:
    values = np.full((len(survey.keyframes), 2), np.nan)
    sigmas = []
    for row, frame in zip(values, survey.keyframes, strict=True):
        told = frame.telemetry
        if "roll_rad" in told and "pitch_rad" in told:
            row[:] = told["roll_rad"], told["pitch_rad"]
            sigma = told.get("attitude_sigma_rad", 0.0)
            sigmas.append(sigma if sigma > 0.0 and math.isfinite(sigma) else DEFAULT_ATTITUDE_SIGMA)
    return (values, float(np.median(sigmas))) if sigmas else (None, DEFAULT_ATTITUDE_SIGMA)


def _while_telling(work: Callable[[], T], tell: Callable[[], None]) -> T:
    """The work's result; `tell` is called now and then meanwhile."""
    out: list[T] = []
    problem: list[BaseException] = []

    def run() -> None:
        try:
            out.append(work())
        except BaseException as error:
            problem.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        tell()
        thread.join(0.25)
    if problem:
        raise problem[0]
    return out[0]


def measure(
    survey: Survey,
    camera: Camera | None = None,
    *,
    diameter: float | Known | None = None,
    joint_spacing: float | Known | None = None,
    target: Target | None = None,
    nominal: float | None = None,
    method: str = "hierarchical",
    threads: int | None = None,
    line_time: float | None = None,
    pictures: bool = True,
    tell: Tell | None = None,
    _jumped: list[int] | None = None,
) -> Measurement:
    """Measures a survey.

    camera     None: the survey's profile
    diameter   known true inner diameter, metres: the scale where nothing else tells it, a check where something does
    joint_spacing   from one joint to the next, metres; a plain number: to SPACING_SIGMA, shared by all pipes
    target     of known size, somewhere in the pipe; not a sleeve
    nominal    nominal diameter, metres [the survey's], for what is defined against it
    line_time  of a rolling shutter, seconds from a row's exposure to the next one's [as the survey says]
    pictures   whether to look at them: for a wall that looks the same again and again
    tell       is called with a fraction done and a word

    Raises PipefishError where nothing can be measured, with the reason; ArgumentError."""
    from pipefish.joint_gaps import tell_gaps
    from pipefish.measured_remarks import remark

    tell = tell or (lambda fraction, word: None)
    known = beforehand(diameter, joint_spacing, target)
    if nominal is not None and not (math.isfinite(nominal) and nominal > 0):
        raise ArgumentError(f"nominal: {nominal} is not a positive length")
    if len(survey.keyframes) < 3:
        raise PipefishError(f"{survey.path}: {_too_short(survey)}; three are the least that can be measured")
    camera = camera_of(survey, camera)
    remarks: list[str] = []
    chainage, quality = _encoder(survey, remarks)
    attitude, attitude_sigma = _attitude(survey)
    tracks = survey.tracks(as_found=True)
    index = np.array([k.index for k in survey.keyframes], dtype=np.int64)
    tracks = dataclasses.replace(
        tracks,
        frame=np.searchsorted(index, tracks.frame),  # missing keyframes take no number
    )
    if _jumped:
        tracks = cut(tracks, _jumped)
    walk = np.hypot(TRACK_FLOOR_PX, TRACK_WALK_PX * _travel(tracks, camera))
    weighed = dataclasses.replace(tracks, covariance=tracks.covariance + (walk**2)[:, None, None] * np.eye(2))
    shutter = shutter_of(survey, line_time)

    def adjusted() -> Reconstruction:
        return reconstruct(
            weighed,
            assumed(camera),
            chainage,
            encoder=quality,
            attitude=attitude,
            attitude_sigma=attitude_sigma,
            method=method,
            threads=threads,
            sag_sigma=TRACK_SAG_PX2,
            hold_camera=camera.covariance is None,  # tracks are no better than what is assumed
            drift=drift_prior(weighed, camera, TRACK_SHARPER),
            common_errors=True,  # the floor
            shutter=shutter,
        )

    structure = _while_telling(adjusted, lambda: tell(0.05, "poses and points"))
    told = chainage is not None and structure.status != "failed"
    smooth = smoothed(structure, chainage, quality) if told else None
    if smooth:
        chainage, quality, white = smooth
        remarks.append(
            f"The encoder's readings jitter by {1000 * white:.1f} mm each (one sigma), which it does not say: they "
            "were smoothed along what the pictures say was driven from one to the next."
        )
        structure = _while_telling(adjusted, lambda: tell(0.3, "poses and points, the encoder smoothed"))
    structure.gaps = renamed(structure.gaps, _jumped or [])
    if structure.status == "failed":
        raise PipefishError(
            f"{survey.path}: nothing could be measured: {_why(survey, structure)}{_pupil_doubt(camera, chainage)}"
        )
    ahead = np.einsum("ni,ni->n", np.diff(structure.centres, axis=0), structure.poses[:-1, 2, :3])
    m = Measurement(
        survey=survey,
        camera=camera,
        tracks=tracks,
        index=index,
        encoder=chainage,
        structure=structure,
        scale=Scale("none", "diameter", 0.0),
        nominal=nominal or (survey.start.nominal_diameter_m if survey.start else 0.0) or None,
        stretches=[],
        camera_sigma=None,
        residuals=_residuals(tracks, structure, camera),
        backwards=bool(ahead.sum() < 0),
        remarks=remarks,
    )
    find_scale(m, known, threads, tell)
    _fit_stretches(m, threads, tell)
    if not m.measured:
        reasons, shaped = (
            sorted({s.tube.reason for s in m.stretches}),
            any(s.tube.status == "open" for s in m.stretches),
        )
        doubt = "" if shaped else _pupil_doubt(camera, chainage) or " (a wrong camera profile?)"
        raise PipefishError(
            f"{survey.path}: poses of {len(structure.frames)} keyframes and {len(structure.points)} points were "
            f"found, but no pipe {'of any size' if shaped else 'around them'}: {'; '.join(reasons)}{doubt}"
        )
    if pictures:
        m.repeats, m.jumped = repetition(m), _jumped or []
        jumped = jumps(m, m.repeats) if _jumped is None else []
        if jumped:
            return measure(
                survey,
                camera,
                diameter=known.diameter,
                joint_spacing=known.spacing,
                target=target,
                nominal=nominal,
                method=method,
                threads=threads,
                line_time=line_time,
                tell=tell,
                _jumped=jumped,
            )
    _sigmas(m)
    _check_diameter(m, known.diameter)
    m.health = _while_telling(
        lambda: check_profile(
            weighed,
            camera,
            chainage,
            structure=structure if structure.drift else None,
            noise=TRACK_SHARPER,
            encoder=quality,
            attitude=attitude,
            attitude_sigma=attitude_sigma,
            diameter=known.diameter.value if known.diameter and m.scale.source == "encoder" else None,
            threads=threads,
            shutter=shutter,
        ),
        lambda: tell(0.9, "profile"),
    )
    if pictures:
        tell_gaps(m)
    remark(m)
    return m


def _states(survey: Survey) -> str:
    """What the device said about the scene."""
    states = survey.info["states"]
    seen = ", ".join(f"{state} at {count} of {len(survey.keyframes)} keyframes" for state, count in states.items())
    return f"; the device said: {seen}" if seen else ""


def _too_short(survey: Survey) -> str:
    """What a survey of too few keyframes has."""
    info, count = survey.info, len(survey.keyframes)
    words = f"{count} keyframe{'' if count == 1 else 's'}"
    if info["frames"]:
        words += f" of {info['frames']} frames"
    if info["length_m"] is not None:
        stood = " (the camera stood still?)" if (info["frames"] or 0) >= STOOD and info["length_m"] < 0.01 else ""
        words += f", {info['length_m']:.2f} m driven{stood}"
    return words + _states(survey)


def _why(survey: Survey, structure: Reconstruction) -> str:
    """Why there is no structure, with what the device said about the scene."""
    seen = _states(survey)
    if not survey.info["tracks"]["observations"]:
        return f"no keyframe has tracks: a black or covered picture?{seen}"
    return structure.reason + seen


def _pupil_doubt(camera: Camera, chainage: np.ndarray | None) -> str:
    """What may be in the way without an encoder: to a structure that has no unit lenses are central."""
    if not camera.pupil_e1 or chainage is not None:
        return ""
    return (
        f" (the profile's pupil shifts by {1000 * camera.pupil_e1:.2g} mm a squared radian, which is left out where "
        "no encoder tells lengths: close to a narrow pipe's wall that alone may be too much)"
    )


def _angles(tracks: Tracks, camera: Camera) -> np.ndarray:
    """From the axis, (N,); NaN beyond the camera's model."""
    rays, ok = camera.unproject(tracks.pixels)
    return np.where(ok, np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), np.nan)


def _travel(tracks: Tracks, camera: Camera) -> np.ndarray:
    """(N,) radians that each point has moved away from or to the axis since it was first seen."""
    theta = _angles(tracks, camera)
    return np.nan_to_num(np.abs(theta - theta[tracks.bounds[:-1][tracks.track]]))


def _sag(tracks: Tracks, camera: Camera, sag: np.ndarray, item: np.ndarray, first: np.ndarray) -> np.ndarray:
    """(n,2) pixels by which observations `item` (n,) are off for that sag (n,3), px^2; first (n,): of their tracks."""
    theta = np.nan_to_num(_angles(tracks, camera))
    size = _engine.sag(np.ascontiguousarray(theta[first]), np.ascontiguousarray(theta[item]), camera.f_u)
    out = tracks.pixels[item] - np.array([camera.c_u, camera.c_v])
    out /= np.maximum(np.linalg.norm(out, axis=1), 1e-9)[:, None]
    along = sag[:, 0] + sag[:, 1] * (out[:, 0] ** 2 - out[:, 1] ** 2) + sag[:, 2] * 2 * out[:, 0] * out[:, 1]
    return (along * size)[:, None] * out


def _residuals(tracks: Tracks, structure: Reconstruction, camera: Camera) -> Residuals:
    point = np.full(int(tracks.track.max()) + 1, -1)
    point[structure.track] = np.arange(len(structure.track))
    place = np.full(int(tracks.frame.max()) + 1, -1)
    place[structure.frames] = np.arange(len(structure.frames))
    names = structure.names(tracks.track)
    j, k = point[names], place[tracks.frame]
    item = np.flatnonzero((j >= 0) & (k >= 0))
    item = item[structure.point_segment[j[item]] == structure.segment[k[item]]]
    j, k = j[item], k[item]
    poses = structure.poses_at(k, tracks.pixels[item])
    seen = np.einsum("nij,nj->ni", poses[:, :, :3], structure.points[j]) + poses[:, :, 3]
    pixels, ok = np.empty((len(item), 2)), np.zeros(len(item), bool)
    for segment in range(len(structure.sigma)):
        inside = np.flatnonzero(structure.segment[k] == segment)
        pixels[inside], ok[inside] = structure.camera_of(camera, segment).project(seen[inside])
    item, j, k, seen, pixels = item[ok], j[ok], k[ok], seen[ok], pixels[ok]
    first = tracks.bounds[:-1][names[item]]
    sag = _sag(tracks, camera, np.array(structure.sag)[structure.segment[k]], item, first)
    residual = tracks.pixels[item] - pixels - sag
    covariance = tracks.covariance[item]  # a survey's tracks have them
    determinant = np.maximum(np.linalg.det(covariance), 1e-12)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    square = yy * residual[:, 0] ** 2 - 2 * xy * residual[:, 0] * residual[:, 1] + xx * residual[:, 1] ** 2
    whitened = np.sqrt(np.maximum(0, square / determinant / 2))
    spread = float(np.median(whitened)) / math.sqrt(math.log(2))  # the median of a Rayleigh distribution
    theta = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
    return Residuals(k, j, item, residual, theta, whitened / max(spread, 0.5), spread)


def _fit_stretches(m: Measurement, threads: int | None, tell: Tell) -> None:
    """A tube for each segment: across a gap nothing joins two of them but odometry, so no surface does."""
    structure, count = m.structure, len(m.structure.sigma)
    along = m.frame_chainage()
    for segment in range(count):
        inside, here = structure.point_segment == segment, np.flatnonzero(structure.segment == segment)
        if m.factors[segment] == 0.0:
            why = "nothing tells the scale of this stretch, as of others"
            m.stretches.append(Stretch(segment, Tube("no_scale", why, {}), structure.frames[here], 0.0, 1))
            continue
        points, water = structure.points[inside], []

        def fit(points: np.ndarray, k: int = segment, inside: np.ndarray = inside) -> Tube:
            return fit_tube(
                points,
                structure.own_covariance[inside],
                m.path(k),
                nominal=m.nominal if m.scale.unit == "metre" else None,
                up=m.up,
                shared=shared_of(structure, k, m.factors[k], (TRACK_COMMON_PX / TRACK_FLOOR_PX) ** 2),
                threads=threads or 2,
                progress=lambda f, word: tell(0.5 + 0.45 * (k + f) / count, word),
            )

        tube = fit(points)
        if tube.status == "ok":
            wet, water = mirrored(tube, structure.down is not None)
            if water:
                tube = fit(np.where(wet[:, None], np.nan, points))
            for w in water:
                at = w.pop("at")
                w["depth"] = depth(tube, at) if tube.status == "ok" else None
        if structure.down is None and tube.clock_zero == AGAINST_GRAVITY:
            tube.clock_zero = "up in the first keyframe"
        origin, sign = _origin(tube, structure.centres[here], along[here], m.backwards)
        m.stretches.append(Stretch(segment, tube, structure.frames[here], origin, sign, water=water))


def _origin(tube: Tube, centres: np.ndarray, along: np.ndarray, backwards: bool) -> tuple[float, int]:
    """chainage = origin + sign s, exact at the first camera that is beside the tube."""
    if tube.status != "ok":
        return 0.0, 1
    start = tube.frames([0.0])
    place = tube.project(centres)
    s = np.where(place["piece"] >= 0, place["s"], (centres - start["centre"][0]) @ start["tangent"][0])
    known = np.flatnonzero(np.isfinite(along))
    if not len(known):
        return float(-s[0]), -1 if backwards else 1
    beside = known[place["piece"][known] >= 0]
    first = int(beside[0]) if len(beside) else int(known[0])
    growing = (along[known[-1]] - along[known[0]]) * (s[known[-1]] - s[known[0]])
    sign = -1 if growing < 0 else 1
    return float(along[first] - sign * s[first]), sign


def _sigmas(m: Measurement) -> None:
    """Sets the stations' sigmas from the adjustment: the tube takes its points' errors as their own, and knows neither
    camera nor wheel. Random: what the encoder's noise, the poses and the points leave open, the wheel's scale taken
    out; systematic: that scale, the camera and what is assumed of its pupil."""
    found = {s.segment: diameter_sigma(m.structure, s.segment, s.tube) for s in m.measured}
    cameras: dict[int, np.ndarray] = {}  # of each stretch, relative, at the stations
    for stretch in m.measured:
        exact, factor, stations = found[stretch.segment], m.factors[stretch.segment], stretch.tube.stations
        stretch.d_mean_sigma = stretch.tube.summary["d_mean_sigma"]
        if exact is None:
            continue
        d = stations["d_mean"]
        if exact.camera is not None and m.camera.covariance is not None:  # what is assumed of others has no radial part
            cameras[stretch.segment] = factor * np.interp(stations["s"], exact.s, exact.camera) / d
            stretch.camera = cameras[stretch.segment]
        # Where the mean diameter is the scale, a station's is known as far as the structure's own scale holds along it.
        by_prior = m.scale.diameter_from_prior
        wheel = 0.0 if by_prior else float(m.structure.scale_sigma or 0.0)  # 0 where there is none in the adjustment
        random = np.interp(stations["s"], exact.s, exact.wander if by_prior else exact.random)
        beyond = np.maximum(0, (factor * random) ** 2 - (wheel * d) ** 2)
        own = np.hypot(stations["d_mean_sigma"], np.sqrt(beyond))
        span = stations["ovality_sigma"] * d  # of widest less narrowest
        stations["d_mean_sigma"], stations["circumference_sigma"] = own, np.pi * own
        stations["d_area_sigma"] = np.hypot(stations["d_area_sigma"], np.sqrt(beyond))
        for name in ("d_max", "d_min"):
            stations[name + "_sigma"] = np.hypot(own, 0.5 * span)
        if stretch.tube.nominal:
            stations["reduction_nominal_sigma"] = stations["d_min_sigma"] / stretch.tube.nominal
        if by_prior:
            continue
        mean = stretch.tube.summary["d_mean"]
        rest = math.sqrt(max(0.0, (factor * exact.mean_random) ** 2 - (wheel * mean) ** 2))
        stretch.d_mean_sigma = math.hypot(stretch.d_mean_sigma, rest)
    m.camera_sigma = float(np.nanmedian(np.concatenate(list(cameras.values())))) if cameras else None
    if m.scale.unit == "metre" and not m.scale.diameter_from_prior:  # else it is in what the diameter was set to
        seen = m.residuals.inlier
        m.pupil_sigma = pupil_sigma(
            m.camera, m.residuals.theta[seen], m.residuals.point[seen], 0.5 * mean_diameter(m)[0]
        )
    _systematic_columns(m)


def _systematic_columns(m: Measurement) -> None:
    for stretch in m.measured:
        stations, shared = stretch.tube.stations, np.hypot(math.hypot(m.scale.sigma, m.pupil_sigma), stretch.camera)
        for name in ("d_mean", "d_area", "d_max", "d_min"):
            stations[name + "_systematic"] = shared * stations[name]
        half = 0.5 * stations["ovality_systematic"] * stations["d_mean"]
        for name in ("d_max", "d_min"):
            stations[name + "_systematic"] = np.hypot(stations[name + "_systematic"], half)


def mean_diameter(m: Measurement) -> tuple[float, float]:
    """Mean over all that was measured, and its random sigma."""
    weight = np.array([s.tube.summary["measured"] for s in m.measured], float)
    weight /= weight.sum()
    value = float(sum(w * s.tube.summary["d_mean"] for w, s in zip(weight, m.measured, strict=True)))
    return value, math.sqrt(sum((w * s.d_mean_sigma) ** 2 for w, s in zip(weight, m.measured, strict=True)))


def _check_diameter(m: Measurement, known: Known | None) -> None:
    """A known diameter beside what else tells the scale: held against what was measured."""
    if known is None or m.scale.diameter_from_prior:
        return
    measured, random = mean_diameter(m)
    m.scale = with_diameter(
        m.scale, known, measured, math.hypot(random / measured, m.camera_sigma or 0.0, m.pupil_sigma)
    )
    _systematic_columns(m)
