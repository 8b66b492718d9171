"""Whether a survey still agrees with its camera profile. docs/selfcal.md.

The survey's last adjustment is made once more with the profile free to drift, and what it says of the drift is
compared with what noise, the profile's own covariance and what no profile knows of its lens allow. A drift that it
cannot see is never called none.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .assumed import PUPIL_MOST, PUPIL_REST
from .camera import PARAMETERS, Camera
from .errors import ArgumentError
from .intervals import Z95
from .lens_ripple import RADIAL, into_radial, radial_fit, ripple_covariance
from .structure import Encoder, Reconstruction, RollingShutter, changed_camera, reconstruct
from .survey import Tracks
from .tube import fit_tube

Floats = npt.NDArray[np.float64]

BUDGET = 0.005  # of the diameter: what profilers are required to hold, and calibration's verdict allows
FALSE_ALARM = 0.01  # probability: half of what is allowed, as the noise is never quite the one stated
CPOLY_POWERS = (1,) * 2 + (2,) * 6 + (3,) * 6  # of theta, by coefficient
FREE = ("f_u", "f_v", "c_u", "c_v", "k2", "k3", "k4", "k5", "pupil_e1", *(f"cpoly[{n}]" for n in range(14)))
RADIAL_FREE = [FREE.index(name) for name in RADIAL]
# What a good profile does not know of its lens beside ripples, pixels: terms that are not round, each at the rim.
LENS_ASYMMETRIC_PX = 0.2
#: How a profile may drift: directions, and their sigmas. A knock or another temperature moves these, no others.
DRIFT = {
    "angle scale": 0.03,  # all angles by a factor
    "alpha": 0.05,  # cot theta -> alpha cot theta, which a straight drive cannot see
    "bend": 0.01,  # k2
    "centre u": 15.0,  # pixels
    "centre v": 15.0,
}
#: The same for people.
WORDS = {
    "angle scale": "focal length",
    "alpha": "stretch along the axis",
    "bend": "distortion (k2)",
    "centre u": "picture centre (across)",
    "centre v": "picture centre (down)",
}
UNITS = {"angle scale": "%", "alpha": "%", "bend": "", "centre u": "px", "centre v": "px"}
CAUSES = (("angle scale",), ("alpha",), ("bend",), ("centre u", "centre v"))  # that move alone
# A drive that never turns its axis by this much within TURN_KEYFRAMES, about as far as a point is seen, is taken for
# straight: what the adjustment would read from smaller turns is mostly its own noise, which adds up with the length.
TURN_LEAST = math.radians(2.0)
TURN_KEYFRAMES = 10
SEEN = 4.0  # information over that of the drift's prior, from which on a combination counts as observed
# A straight drive leaves so much open that an adjustment without the known diameter ends where it is 8 % wrong, and
# what curves are there is nothing like what they are at the truth: a centre that had moved by 3 px seemed to have moved
# by 0.7. So it is made again with the diameter, until that changes by less than NEAR; CLEAR sigmas are not missed.
NEAR, ROUNDS = 0.001, 6
CLEAR = 4.0
ALIKE = 4.0  # of chi-square: causes that leave so little more than the likeliest are named beside it

VERDICTS = {
    "valid": "profile still valid",
    "drifted": "drifted, recalibrate",
    "unknown": "cannot tell",
}


@dataclass(frozen=True)
class ProfileCheck:
    """What a survey says of its profile.

    verdict          "profile still valid", "drifted, recalibrate" or "cannot tell"; text: with its figures
    alpha_sigma      sigma that a drift leaves in the diameter, relative; budget: what it may be
    changes          of each way to drift if nothing else changed: value, sigma (units of UNITS; wider by what of the
                     drift it leaves unexplained)
    probability      that noise and what the profile does not know of its lens give as much drift as was seen
    observed         combinations of DRIFT that the survey sees, of their number
    evidence         what the diameter rests on, in words
    """

    verdict: str
    text: str
    alpha_sigma: float
    budget: float
    changes: dict[str, tuple[float, float]]
    probability: float
    observed: int
    evidence: str

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        out = dataclasses.asdict(self)
        out["changes"] = {name: {"value": v, "sigma": s, "unit": UNITS[name]} for name, (v, s) in self.changes.items()}
        return out


def _directions(camera: Camera, theta_end: float) -> Floats:
    """(23,5): what each way to drift, by its unit, does to FREE."""
    theta = np.linspace(0.02, 1.0, 60) * theta_end
    k = np.array([camera.k2, camera.k3, camera.k4, camera.k5])
    rise = 1 + (theta[:, None] ** np.array([2, 4, 6, 8]) * np.array([3, 5, 7, 9])) @ k
    out = np.zeros((len(FREE), len(DRIFT)))
    out[0, 0], out[1, 0] = camera.f_u, camera.f_v
    along = rise * np.sin(theta) * np.cos(theta)
    out[RADIAL_FREE, 1] = into_radial(camera) @ radial_fit(camera, theta) @ along
    out[4, 2] = out[2, 3] = out[3, 4] = 1.0
    return out


def _own_covariance(camera: Camera, theta_end: float) -> Floats:
    """The covariance of FREE without a drift, (23,23): the profile's, and what it does not know of its lens."""
    # A bound, taken for a sigma: twice as wide as the diameter's budget has it, for what is blamed here is the lens.
    # A wall 75 mm away looks through a shift that the profile does not know as if the angles had drifted.
    pupil = 2 * PUPIL_REST if "pupil_e1" in camera.covariance_parameters else PUPIL_MOST
    out = np.zeros((len(FREE), len(FREE)))
    out[np.ix_(RADIAL_FREE, RADIAL_FREE)] = ripple_covariance(camera, theta_end)
    own = np.zeros(len(FREE))
    own[:2] = 2e-4 * np.array([camera.f_u, camera.f_v])
    own[2:4] = LENS_ASYMMETRIC_PX
    own[4:8] = [1e-4, 3e-5, 1e-5, 3e-6]  # little, so that there is an inverse
    own[8] = pupil
    own[9:] = LENS_ASYMMETRIC_PX / camera.f_u / theta_end ** np.array(CPOLY_POWERS)
    out += np.diag(own**2)
    if camera.covariance is not None:
        places = [(i, FREE.index(n)) for i, n in enumerate(camera.covariance_parameters) if n in FREE]
        for i, a in places:
            for j, b in places:
                out[a, b] += camera.covariance[i, j]
    return out


def _wall_radius(part: dict[str, Any]) -> float:
    """How far the points of a segment are off the way of the camera (median)."""
    centres = -np.einsum("nij,ni->nj", part["poses"][:, :, :3], part["poses"][:, :, 3])
    ahead = np.gradient(centres, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
    points = part["points"][:: len(part["points"]) // 1000 + 1]
    nearest = np.linalg.norm(points[:, None] - centres, axis=2).argmin(axis=1)
    return float(np.median(np.linalg.norm(np.cross(points - centres[nearest], ahead[nearest]), axis=1)))


def _diameter_slope(camera: Camera, tracks: Tracks, radius: float) -> Floats:
    """(23,): how ln of the diameter answers to FREE, for the angles at which the wall was seen, `radius` off the axis:
    the nearer it is, the more the pupil's shift does. A wall point seen at two angles a and b, a distance s apart, is
    s / (cot a - cot b) off the axis."""
    first = np.flatnonzero(np.diff(tracks.track, prepend=-1))
    last = np.append(first[1:], len(tracks.track)) - 1
    rays, ok = camera.unproject(tracks.pixels[np.concatenate([first, last])])
    across = np.hypot(rays[:, 0], rays[:, 1])
    theta = np.arctan2(across, rays[:, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (radius / across)[:, None]
        _, _, by_point, by_free = camera.project_jacobian(np.where(np.isfinite(away), away, 1.0) * rays)
        outward = away * np.column_stack([rays[:, :2] / across[:, None] * np.cos(theta)[:, None], -np.sin(theta)])
        rise = np.einsum("nij,nj->ni", by_point, outward)
        by_free = by_free[:, :, [PARAMETERS.index(name) for name in FREE]]
        slope = -np.einsum("ni,nip->np", rise, by_free) / (rise**2).sum(axis=1)[:, None]
        near, far = np.split(theta, 2)
        slope_near, slope_far = np.split(slope, 2)
        base = 1 / np.tan(near) - 1 / np.tan(far)
        weight = base**2 / (1 / np.sin(near) ** 4 + 1 / np.sin(far) ** 4)
        each = slope_near / np.sin(near)[:, None] ** 2 - slope_far / np.sin(far)[:, None] ** 2
        each /= base[:, None]
    known = (
        np.logical_and(*np.split(ok, 2)) & np.isfinite(each).all(axis=1) & np.isfinite(weight) & (np.abs(base) > 0.2)
    )
    return np.average(each[known], axis=0, weights=weight[known]) if known.any() else np.zeros(len(FREE))


def _chi2_tail(value: float, degrees: int) -> float:
    """Probability that chi-square with so many degrees of freedom exceeds the value (series and recurrence)."""
    if degrees == 0:
        return 1.0
    half = value / 2
    tail, k = (math.erfc(math.sqrt(half)), 1) if degrees % 2 else (math.exp(-half), 2)
    term = math.exp(-half) * (2 * math.sqrt(half / math.pi) if degrees % 2 else half)
    while k < degrees:
        tail += term
        k += 2
        term *= half / (k / 2)
    return min(1.0, tail)


def _theta_end(camera: Camera, tracks: Tracks) -> float:
    """Largest angle from the axis that tracks were seen at but for a fiftieth, radians; 0 where there are none."""
    rays, ok = camera.unproject(tracks.pixels)
    theta = np.arctan2(np.hypot(rays[ok, 0], rays[ok, 1]), rays[ok, 2])
    return float(np.quantile(theta, 0.98)) if len(theta) else 0.0


def _prior(camera: Camera, theta_end: float) -> Floats:
    scaled = _directions(camera, theta_end) * np.array(list(DRIFT.values()))
    return _own_covariance(camera, theta_end) + scaled @ scaled.T


def drift_prior(tracks: Tracks, camera: Camera, noise: float = 1.0) -> tuple[tuple[str, ...], Floats, float] | None:
    """What reconstruct(drift=...) takes for a check of the profile; `noise`: factor on the tracks' sigmas. None for a
    camera that is not generic, or not a track inside its field."""
    end = _theta_end(camera, tracks) if camera.radial == "generic" else 0.0
    return (FREE, _prior(camera, end), noise) if end > 0 else None


def check_profile(
    tracks: Tracks,
    camera: Camera,
    chainage: npt.ArrayLike | None = None,
    *,
    structure: Reconstruction | None = None,
    encoder: Encoder | None = None,
    attitude: npt.ArrayLike | None = None,
    attitude_sigma: float = 0.01,
    sigma: float = 0.3,
    diameter: float | None = None,
    diameter_sigma: float = 0.001,
    budget: float = BUDGET,
    noise: float = 1.0,
    threads: int | None = None,
    shutter: RollingShutter | None = None,
    sag_sigma: float = 0.0,
    common_errors: bool = False,
    pupil_sigma: float = 0.0,
    about: float | None = None,
    common_scale: float = 0.0,
) -> ProfileCheck:
    """Tests a survey against its profile.

    tracks .. sigma, shutter .. pupil_sigma  as of reconstruct(), about as its diameter
    structure        reconstruct() of the same with drift=drift_prior(tracks, camera, noise); None: it is made here
    diameter         known true inner diameter, metres, with diameter_sigma (relative): beside an encoder it shows what
                     a straight drive cannot
    budget           sigma of the diameter, relative, above which the answer is "cannot tell"
    noise            factor on the sigmas of the tracks, where they are wider than noise to keep something else at bay
    common_scale     what errors that tracks have in common look like in a straight drive beside a known diameter: a
                     factor on all angles, one sigma, that is no drift

    Raises ArgumentError.
    """
    _refuse_wrong(noise, common_scale, budget, diameter, diameter_sigma)
    if camera.radial != "generic":
        camera = camera.to_generic()[0]
    end = _theta_end(camera, tracks)
    if not end > 0:
        return _nothing(budget, "no track inside the profile's field")
    prior = _prior(camera, end)
    known = {"encoder": encoder, "attitude": attitude, "attitude_sigma": attitude_sigma, "sigma": sigma}
    known |= {"threads": threads, "shutter": shutter, "sag_sigma": sag_sigma, "common_errors": common_errors}
    known |= {"pupil_sigma": pupil_sigma, "diameter": about}

    def adjusted(about: Floats, spread: Floats) -> Reconstruction:
        """With the profile free to drift about a change, by this covariance."""
        return reconstruct(tracks, changed_camera(camera, FREE, about), chainage, drift=(FREE, spread, noise), **known)

    found = structure or adjusted(np.zeros(len(FREE)), prior)
    if not found.drift:
        return _nothing(budget, f"nothing was measured: {found.reason}")
    slope = _diameter_slope(camera, tracks, _wall_radius(found.drift[0]))
    straight = _largest_turn(found) < TURN_LEAST
    given = (diameter, diameter_sigma) if diameter is not None and found.unit == "metre" else None
    seen = _evidence(found, adjusted, prior, slope, given, straight)
    if isinstance(seen, str):
        return _nothing(budget, seen, math.sqrt(slope @ prior @ slope))
    return _judge(seen[0], camera, end, slope, budget, seen[1], common_scale if straight else 0.0)


def _refuse_wrong(
    noise: float, common_scale: float, budget: float, diameter: float | None, diameter_sigma: float
) -> None:
    """Raises ArgumentError for numbers that check_profile does not take."""
    if not noise > 0:
        raise ArgumentError(f"noise: {noise} is not above 0")
    if not common_scale >= 0:
        raise ArgumentError(f"common_scale: {common_scale} is below 0")
    if not budget > 0 or not diameter_sigma > 0 or (diameter is not None and not diameter > 0):
        raise ArgumentError("budget, diameter, diameter_sigma: not above 0")


@dataclass(frozen=True)
class _Seen:
    """What the survey alone says of FREE: information (23,23), and information times value (23,)."""

    information: Floats
    weighed: Floats


def _evidence(
    found: Reconstruction,
    adjusted: Callable[[Floats, Floats], Reconstruction],
    prior: Floats,
    slope: Floats,
    given: tuple[float, float] | None,
    straight: bool,
) -> tuple[_Seen, str] | str:
    """What the survey says of FREE, with the diameter that is given (and its sigma), and what that rests on; or why
    nothing can be told."""
    seen, evidence, known = _together(found, np.zeros(len(FREE)), prior), "bends and turns of the drive", False
    if given:
        with_it = _with_diameter(found, adjusted, prior, slope, given)
        if isinstance(with_it, str):
            return with_it
        seen, evidence, known = with_it
    if not known and straight:
        return (
            "the camera never panned, tilted or went round a bend; a known diameter beside the encoder would show a "
            "drift"
        )
    return seen, evidence


def _inverse(matrix: Floats) -> Floats:
    """Of a covariance or an information whose parameters differ by many orders of magnitude."""
    scale = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    out = np.linalg.inv(matrix / np.outer(scale, scale)) / np.outer(scale, scale)
    return (out + out.T) / 2


def _together(found: Reconstruction, about: Floats, spread: Floats) -> _Seen:
    """From all segments, that were adjusted about a change with this covariance. Noise above the one stated counts."""
    before = _inverse(spread)
    information, weighed = np.zeros_like(spread), np.zeros(len(spread))
    for part, factor in zip(found.drift, found.variance_factor, strict=True):
        posterior = _inverse(part["covariance"])
        noise = max(1.0, factor / part["noise"] ** 2)
        information += (posterior - before) / noise
        weighed += (posterior @ (about + part["camera"]) - before @ about) / noise
    return _Seen(information, weighed)


def _largest_turn(found: Reconstruction) -> float:
    """Largest angle of the optical axis between keyframes of a stretch up to TURN_KEYFRAMES apart, radians."""
    most = 0.0
    for number in np.unique(found.segment):
        axes = found.poses[found.segment == number, 2, :3]
        for apart in range(1, min(TURN_KEYFRAMES, len(axes) - 1) + 1):
            cosines = np.einsum("ni,ni->n", axes[apart:], axes[:-apart])
            most = max(most, float(np.arccos(np.clip(cosines, -1, 1)).max()))
    return most


def _nothing(budget: float, why: str, alpha_sigma: float = math.inf) -> ProfileCheck:
    """alpha_sigma: what a lens may drift at all leaves in the diameter."""
    changes = {name: (0.0, math.inf) for name in DRIFT}
    text = f"Cannot tell: {why}."
    if math.isfinite(alpha_sigma):
        text = (
            f"Cannot tell: all that a lens may drift leaves the diameter open by ± {100 * Z95 * alpha_sigma:.2g} %; "
            f"{why}."
        )
    return ProfileCheck(VERDICTS["unknown"], text, alpha_sigma, budget, changes, 1.0, 0, why)


def _diameter_off(found: Reconstruction, diameter: float, diameter_sigma: float) -> tuple[float, float] | str:
    """ln of the known diameter over the one with the profile as it was adjusted, and its variance; or why there is
    none."""
    part = found.drift[0]
    inside = np.flatnonzero(found.point_segment == 0)
    inside = inside[np.isin(found.track[inside], part["tracks"])]
    kept = np.isin(part["tracks"], found.track[inside])
    centres = -np.einsum("nij,ni->nj", part["poses"][:, :, :3], part["poses"][:, :, 3])
    tube = fit_tube(part["points"][kept], found.covariance[inside], centres)
    if tube.status != "ok":
        return tube.reason
    measured = float(tube.summary["d_mean"])
    random = float(tube.summary["d_mean_sigma"]) / measured
    return math.log(diameter / measured), random**2 + found.scale_sigma**2 + diameter_sigma**2


def _with_diameter(
    found: Reconstruction,
    adjusted: Callable[[Floats, Floats], Reconstruction],
    prior: Floats,
    slope: Floats,
    known: tuple[float, float],
) -> tuple[_Seen, str, bool] | str:
    """The known diameter and its sigma as one more measurement of the profile; whether one was measured beside it.
    Why nothing can be told where the adjustments with it do not end."""
    about, spread = np.zeros(len(prior)), prior
    for turn in range(ROUNDS):
        seen, end = _together(found, about, spread), about + found.drift[0]["camera"]
        off = _diameter_off(found, *known)
        if isinstance(off, str):
            return seen, f"bends and turns of the drive; no diameter ({off})", False
        value, variance = off[0] + slope @ end, off[1]
        seen = _Seen(seen.information + np.outer(slope, slope) / variance, seen.weighed + slope * value / variance)
        step = _inverse(seen.information + _inverse(prior)) @ seen.weighed - end
        if abs(slope @ step) < NEAR:
            return seen, "the encoder and the known diameter, bends and turns of the drive", True
        if turn == ROUNDS - 1:
            break
        gain = prior @ slope / (slope @ prior @ slope + variance)
        again = adjusted(gain * value, prior - np.outer(gain, prior @ slope))
        if not again.drift or again.unit != "metre":
            why = again.reason or "the encoder no longer tells the scale"
            return f"with the known diameter there is no adjustment: {why}"
        found, about, spread = again, gain * value, prior - np.outer(gain, prior @ slope)
    return (
        f"the adjustment with the known diameter did not settle: after {ROUNDS} it still changed the diameter by "
        f"{100 * abs(slope @ step):.2g} %"
    )


@dataclass(frozen=True)
class _Cause:
    """One of CAUSES, if nothing else changed: its changes, the probability that none of it shows so clearly, the
    chi-square of what it leaves of the drift, and the probability that this is none."""

    changes: dict[str, tuple[float, float]]
    probability: float
    left: float
    rest: float

    def text(self) -> str:
        """In words, by the change that is most of its sigmas."""
        name = max(self.changes, key=lambda n: abs(self.changes[n][0]) / self.changes[n][1])
        value, sigma = self.changes[name]
        return f"{WORDS[name]} changed by {value:+.2g} ± {Z95 * sigma:.2g} {UNITS[name]}".rstrip()


def _of_cause(names: tuple[str, ...], known: Floats, weighed: Floats, total: float, degrees: int) -> _Cause:
    """By information (5,5) on DRIFT, in its sigmas, information times value (5,), and the chi-square of all."""
    at = [list(DRIFT).index(name) for name in names]
    spread = np.linalg.inv(known[np.ix_(at, at)] + 1e-6 * np.eye(len(at)))
    value = spread @ weighed[at]
    explained = float(value @ weighed[at])
    left, others = max(0.0, total - explained), degrees - len(at)
    # What a single cause leaves is another cause's or the tracker's: it counts as noise.
    wider = math.sqrt(max(1.0, left / others)) if others > 0 else 1.0
    sigma = wider * np.sqrt(spread.diagonal())
    scale = [DRIFT[name] * (100 if UNITS[name] == "%" else 1) for name in names]
    changes = {n: (float(v * u), float(s * u)) for n, v, s, u in zip(names, value, sigma, scale, strict=True)}
    return _Cause(changes, _chi2_tail(explained, len(at)), left, _chi2_tail(left, max(0, others)))


def doubted(check: ProfileCheck, why: str) -> ProfileCheck:
    """A check that found no drift of a survey in which something else says that the profile does not fit."""
    if check.verdict != VERDICTS["valid"]:
        return check
    text = f"Cannot tell whether the profile still holds: {why}, though none of the drifts looked for was found."
    return dataclasses.replace(check, verdict=VERDICTS["unknown"], text=text)


def _limits(known: Floats) -> str:
    """From which change on each way to drift would have shown, if nothing else changed, by information (5,5)."""
    shown, hidden = [], []
    for name, size, information in zip(DRIFT, DRIFT.values(), known.diagonal(), strict=True):
        if information > SEEN:
            least = CLEAR * size / math.sqrt(information) * (100 if UNITS[name] == "%" else 1)
            shown.append(f"{WORDS[name]} by {least:.2g} {UNITS[name]}".rstrip())
        else:
            hidden.append(WORDS[name])
    text = f"Changes that would have shown: {', '.join(shown) or 'none'}."
    return text + (f" Of {' and '.join(hidden)} no change could be seen." if hidden else "")


def _judge(
    seen: _Seen,
    camera: Camera,
    theta_end: float,
    slope: Floats,
    budget: float,
    evidence: str,
    common_scale: float = 0.0,
) -> ProfileCheck:
    ways = _directions(camera, theta_end)
    scaled = ways * np.array(list(DRIFT.values()))  # in units of the drift's sigmas
    feigned = common_scale**2 * np.outer(ways[:, 0], ways[:, 0])
    own = _inverse(_own_covariance(camera, theta_end) + feigned)
    left = _inverse(seen.information + _inverse(_prior(camera, theta_end)))
    open_sigma = math.sqrt(max(0.0, slope @ left @ slope))
    # Of the drift, with the profile's own uncertainty as noise.
    apart = seen.information @ _inverse(seen.information + own)
    known = scaled.T @ (seen.information - apart @ seen.information) @ scaled
    known = (known + known.T) / 2
    weighed = scaled.T @ (seen.weighed - apart @ seen.weighed)
    size, axes = np.linalg.eigh(known)
    clear = size > SEEN
    total = float(np.sum((axes[:, clear].T @ weighed) ** 2 / size[clear]))
    causes = [_of_cause(names, known, weighed, total, int(clear.sum())) for names in CAUSES]
    likeliest = min(causes, key=lambda c: (c.probability, -c.rest))
    # One cause shows more clearly by itself than among all; so many tests are made.
    least = min(likeliest.probability, _chi2_tail(total, int(clear.sum())))
    probability = min(1.0, (1 + len(causes)) * least)
    moved = probability < FALSE_ALARM
    alike = [c.text() for c in causes if c is not likeliest and c.left < likeliest.left + ALIKE]
    what = " or ".join([likeliest.text(), *alike]) + (
        ", if nothing else changed" if likeliest.rest >= FALSE_ALARM else ", which does not explain all of it"
    )
    open_text = f"a drift that the survey cannot see leaves the diameter open by ± {100 * Z95 * open_sigma:.2g} %"
    if open_sigma > budget:
        verdict = VERDICTS["unknown"]
        text = (
            f"Cannot tell whether the profile still holds: {open_text}, more than the "
            f"± {100 * Z95 * budget:.2g} % allowed. A bend, panning and tilting, or a "
            "known diameter beside the encoder would show it."
        )
        if moved:
            text += f" What can be seen does not fit the profile, though: {what}. Recalibrate where limits are tight."
    elif moved:
        verdict = VERDICTS["drifted"]
        text = f"The profile has drifted: {what}; {open_text}. Recalibrate the camera."
    else:
        verdict, text = VERDICTS["valid"], f"The profile is still valid: {open_text}, by {evidence}. {_limits(known)}"
    if common_scale:
        text += (
            f" Errors that tracks have in common look like a focal length off by ± {100 * Z95 * common_scale:.2g} % "
            "in a straight drive, and count as noise."
        )
    if camera.source == "selfcal":
        text += " It is self-calibrated: if from this survey, its agreeing proves nothing."
    changes = {name: change for cause in causes for name, change in cause.changes.items()}
    return ProfileCheck(verdict, text, open_sigma, budget, changes, probability, int(clear.sum()), evidence)
