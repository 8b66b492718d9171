"""From a survey to a measured pipe: poses and points, scale, a tube for each stretch. docs/reconstruction.md."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from pipefish import _engine
from pipefish.assumed import assumed
from pipefish.camera import Camera
from pipefish.errors import ArgumentError, PipefishError
from pipefish.health import ProfileCheck, check_profile, doubted, drift_prior
from pipefish.intervals import Z95
from pipefish.jitter import smoothed
from pipefish.measurement import Measurement, Residuals, Stretch, mean_diameter
from pipefish.pupil import pupil_sigma, shift_sigma
from pipefish.readings import TRACK_FLOOR_PX, Readings, angles, readings_of
from pipefish.repeated import jumps, renamed, repetition
from pipefish.scale import Known, Scale, with_diameter
from pipefish.scale_sources import Beforehand, beforehand, find_scale
from pipefish.sectionsigma import diameter_sigma, shared_of
from pipefish.structure import Reconstruction, reconstruct
from pipefish.survey import Survey, Tracks
from pipefish.target import Target
from pipefish.tube import AGAINST_GRAVITY, Tube, fit_tube
from pipefish.tube_water import depth, mirrored

T = TypeVar("T")
Tell = Callable[[float, str], None]  # fraction done, what is going on

# Of what all tracks have in common (see readings.TRACK_FLOOR_PX) the largest part has a known form and is estimated:
# px^2, the second moment of a window of 21 px is 37; 70 to 90 were found, of a tracker that corrects for it 25.
TRACK_SAG_PX2 = 100.0
# An ellipse has no encoder in it, and the floor is more than what tracks have in common: ellipses of rendered brick,
# concrete and PVC were off (both parameters, along the whole pipe) as by 0.5, 0.4 and 0.3 px.
TRACK_COMMON_PX = 0.4
# A check of the profile asks for drifts beside the lens's own ripples, not for a scale that holds along the pipe: of
# these sigmas it takes so much, 0.3 px and 0.18 px a radian. By their errors alone tracks of drawn brick and concrete
# then show a drift with a chi-square of 2 and 3 for 5 degrees of freedom.
TRACK_SHARPER = 0.6
# What errors that tracks have in common look like beside a known diameter: of drawn concrete, brick, PVC and the demo
# the right profiles show +0.7, +0.2, +0.35 and +0.5 % of the angle scale to +- 0.2 % (0.3 % PVC), 0.47 % rms with
# that noise. Drives that turn tell the scale by that as well, and were not called drifted.
TRACK_COMMON_SCALE = 0.0045
STOOD = 10  # frames in which less than a centimetre was driven


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
    from pipefish.measured_remarks import bent, bent_text, remark

    tell = tell or (lambda fraction, word: None)
    known = beforehand(diameter, joint_spacing, target)
    if nominal is not None and not (math.isfinite(nominal) and nominal > 0):
        raise ArgumentError(f"nominal: {nominal} is not a positive length")
    if len(survey.keyframes) < 3:
        raise PipefishError(f"{survey.path}: {_too_short(survey)}; three are the least that can be measured")
    readings = readings_of(survey, camera, line_time, known.diameter.value if known.diameter else nominal)

    def fitted(given: Readings, cuts: list[int]) -> tuple[Measurement, Readings, Reconstruction]:
        """Poses and points, scale, tubes; what was adjusted, and the structure in the adjustment's unit."""
        used, structure = _adjusted(given, method, threads, tell)
        structure.gaps = renamed(structure.gaps, cuts)
        m = _measurement(survey, used, structure)
        m.nominal = nominal or m.nominal
        find_scale(m, known, threads, tell)
        _fit_stretches(m, threads, tell)
        _check_measured(m, given.diameter)
        return m, used, structure

    m, used, structure = fitted(readings, [])
    if pictures:
        m.repeats = repetition(m)
        jumped = jumps(m, m.repeats)
        if jumped:
            m, used, structure = fitted(readings.cut_at(jumped), jumped)
            m.repeats, m.jumped = repetition(m), jumped
    _sigmas(m)
    _check_diameter(m, known.diameter)
    m.health = _health(m, used, structure, known, threads, tell)
    row = bent(m)
    if row:
        m.health = doubted(m.health, bent_text(row))
    if pictures:
        tell_gaps(m)
    remark(m)
    return m


def _adjusted(readings: Readings, method: str, threads: int | None, tell: Tell) -> tuple[Readings, Reconstruction]:
    """Poses and points; and the readings, of which the encoder's are smoothed where they jitter."""
    structure = _adjusted_once(readings, method, threads, lambda: tell(0.05, "poses and points"))
    if readings.chainage is None or structure.status == "failed":
        return readings, structure
    smooth = smoothed(structure, readings.chainage, readings.encoder)
    if smooth is None:
        return readings, structure
    chainage, encoder, white = smooth
    remark = (
        f"The encoder's readings jitter by ± {1000 * Z95 * white:.1f} mm each, which the device does not state: "
        "they were smoothed along what the pictures say was driven from one to the next."
    )
    better = dataclasses.replace(readings, chainage=chainage, encoder=encoder, remarks=[*readings.remarks, remark])
    again = _adjusted_once(better, method, threads, lambda: tell(0.3, "poses and points, the encoder smoothed"))
    return (readings, structure) if again.status == "failed" else (better, again)


def _adjusted_once(readings: Readings, method: str, threads: int | None, tell: Callable[[], None]) -> Reconstruction:
    return _while_telling(
        lambda: reconstruct(
            readings.weighed,
            assumed(readings.camera, metric=readings.chainage is not None),
            readings.chainage,
            encoder=readings.encoder,
            attitude=readings.attitude,
            attitude_sigma=readings.attitude_sigma,
            method=method,
            threads=threads,
            sag_sigma=TRACK_SAG_PX2,
            # Beside an encoder tracks are no better than what is assumed; without one nothing else holds the scale.
            hold_camera=readings.camera.covariance is None and readings.chainage is not None,
            drift=drift_prior(readings.weighed, readings.camera, TRACK_SHARPER),
            common_errors=True,  # the floor
            shutter=readings.shutter,
            pupil_sigma=shift_sigma(readings.camera),
            diameter=readings.diameter,
        ),
        tell,
    )


def _measurement(survey: Survey, readings: Readings, structure: Reconstruction) -> Measurement:
    """Of a structure whose scale is not looked for yet. Raises PipefishError where there is none."""
    camera, chainage = readings.camera, readings.chainage
    if structure.status == "failed":
        raise PipefishError(f"{survey.path}: nothing could be measured: {_why(survey, structure)}")
    ahead = np.einsum("ni,ni->n", np.diff(structure.centres, axis=0), structure.poses[:-1, 2, :3])
    return Measurement(
        survey=survey,
        camera=camera,
        tracks=readings.tracks,
        index=readings.index,
        encoder=chainage,
        structure=structure,
        scale=Scale("none", "diameter", 0.0),
        nominal=(survey.start.nominal_diameter_m if survey.start else 0.0) or None,
        stretches=[],
        residuals=_residuals(readings.tracks, structure, camera),
        backwards=bool(ahead.sum() < 0),
        remarks=list(readings.remarks),
    )


def _check_measured(m: Measurement, given: float | None) -> None:
    """Raises PipefishError where no stretch has a tube."""
    if m.measured:
        return
    reasons = sorted({s.tube.reason for s in m.stretches})
    shaped = any(s.tube.status == "open" for s in m.stretches)
    doubt = "" if shaped else _doubt(m, given)
    raise PipefishError(
        f"{m.survey.path}: poses of {len(m.structure.frames)} keyframes and {len(m.structure.points)} points were "
        f"found, but no pipe {'of any size' if shaped else 'around them'}: {'; '.join(reasons)}{doubt}"
    )


def _health(
    m: Measurement, readings: Readings, structure: Reconstruction, known: Beforehand, threads: int | None, tell: Tell
) -> ProfileCheck:
    """structure: in the adjustment's unit."""
    return _while_telling(
        lambda: check_profile(
            readings.weighed,
            readings.camera,
            readings.chainage,
            structure=structure if structure.drift else None,
            noise=TRACK_SHARPER,
            encoder=readings.encoder,
            attitude=readings.attitude,
            attitude_sigma=readings.attitude_sigma,
            diameter=known.diameter.value if known.diameter and m.scale.source == "encoder" else None,
            threads=threads,
            shutter=readings.shutter,
            sag_sigma=TRACK_SAG_PX2,
            common_errors=True,
            pupil_sigma=shift_sigma(readings.camera),
            about=readings.diameter,
            common_scale=TRACK_COMMON_SCALE,
        ),
        lambda: tell(0.9, "profile"),
    )


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


def _doubt(m: Measurement, given: float | None) -> str:
    """What to look at where there are points and no pipe; given: what the pipe's diameter was said to be."""
    if m.encoder is not None:
        return " (a wrong camera profile?)"
    size = "" if given else ", say what the pipe's nominal diameter is (--nominal)"
    return (
        " (a wrong camera profile? No encoder tells how far the camera went, and pictures alone lose a pipe's size on "
        f"the way where they show little of its wall: connect an encoder, light the wall better{size})"
    )


def _in_camera(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n,3) in the coordinates of cameras (n,3,4)."""
    return np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]


def _from_axis(seen: np.ndarray) -> np.ndarray:
    """Angles (n,) of points (n,3) in the camera's coordinates from its optical axis."""
    return np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])


def _sag(pixels: np.ndarray, camera: Camera, sag: np.ndarray, first: np.ndarray, now: np.ndarray) -> np.ndarray:
    """(n,2) pixels by which observations (n,2) are off for that sag (n,3), px^2, at angles `now` (n,) from the axis of
    tracks that began at `first` (n,): of adjusted points, for pixels' noise would be read as a sag."""
    size = _engine.sag(np.ascontiguousarray(first), np.ascontiguousarray(now), camera.f_u)
    out = pixels - np.array([camera.c_u, camera.c_v])
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
    seen = _in_camera(structure.poses_at(k, tracks.pixels[item]), structure.points[j])
    pixels, ok = np.empty((len(item), 2)), np.zeros(len(item), bool)
    for segment in range(len(structure.sigma)):
        inside = np.flatnonzero(structure.segment[k] == segment)
        pixels[inside], ok[inside] = structure.camera_of(camera, segment).project(seen[inside])
    item, j, k, seen, pixels = item[ok], j[ok], k[ok], seen[ok], pixels[ok]
    start = tracks.bounds[:-1][names[item]]
    begun, theta = place[tracks.frame[start]], _from_axis(seen)
    here = (begun >= 0) & (structure.segment[begun] == structure.segment[k])  # else only the pixel is known
    first = _from_axis(_in_camera(structure.poses[begun], structure.points[j]))
    first = np.where(here, first, np.nan_to_num(angles(tracks, camera)[start]))
    sag = _sag(tracks.pixels[item], camera, np.array(structure.sag)[structure.segment[k]], first, theta)
    residual = tracks.pixels[item] - pixels - sag
    covariance = tracks.covariance[item]  # a survey's tracks have them
    determinant = np.maximum(np.linalg.det(covariance), 1e-12)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    square = yy * residual[:, 0] ** 2 - 2 * xy * residual[:, 0] * residual[:, 1] + xx * residual[:, 1] ** 2
    whitened = np.sqrt(np.maximum(0, square / determinant / 2))
    spread = float(np.median(whitened)) / math.sqrt(math.log(2))  # the median of a Rayleigh distribution
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
    for stretch in m.measured:
        exact, factor, stations = found[stretch.segment], m.factors[stretch.segment], stretch.tube.stations
        stretch.d_mean_sigma = stretch.tube.summary["d_mean_sigma"]
        if exact is None:
            continue
        d = stations["d_mean"]
        # Where the mean diameter is the scale, a station's is known as far as the structure's own scale holds along it.
        by_prior, mean = m.scale.diameter_from_prior, stretch.tube.summary["d_mean"]
        # Of other profiles a radial part is assumed only where no encoder holds the scale.
        if exact.mean_camera is not None and (m.camera.covariance is not None or m.structure.unit != "metre"):
            camera = exact.wander_camera if by_prior else exact.camera
            stretch.camera = factor * np.interp(stations["s"], exact.s, camera) / d
            stretch.mean_camera = 0.0 if by_prior else factor * exact.mean_camera / mean
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
        rest = math.sqrt(max(0.0, (factor * exact.mean_random) ** 2 - (wheel * mean) ** 2))
        stretch.d_mean_sigma = math.hypot(stretch.d_mean_sigma, rest)
    # Else it is in what the diameter was set to, or was estimated. One number stands for all stretches.
    if m.scale.unit == "metre" and not m.scale.diameter_from_prior and not m.structure.pupil_free:
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


def _check_diameter(m: Measurement, known: Known | None) -> None:
    """A known diameter beside what else tells the scale: held against what was measured."""
    if known is None or m.scale.diameter_from_prior:
        return
    measured, random = mean_diameter(m)
    m.scale = with_diameter(
        m.scale, known, measured, math.hypot(random / measured, m.camera_sigma or 0.0, m.pupil_sigma)
    )
    _systematic_columns(m)
