"""Whether a survey still agrees with its camera profile. docs/selfcal.md.

The survey's last adjustment is made once more with the profile free to drift, and what it says of the drift is
compared with what noise and the profile's own covariance allow. A drift that it cannot see is never called none.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .camera import Camera
from .errors import ArgumentError
from .structure import Encoder, Reconstruction, RollingShutter, reconstruct
from .survey import Tracks
from .tube import fit_tube

Floats = npt.NDArray[np.float64]

BUDGET = 0.005  # of the diameter: what profilers are required to hold, and calibration's verdict allows
FALSE_ALARM = 0.005  # of the test: the noise is never quite the one stated, and the bar is 2 %
FREE = ("f_u", "f_v", "c_u", "c_v", "k2", "k3", "k4", "k5", "pupil_e1")
#: Metres, of a profile that says nothing of the pupil's shift: two millimetres at 57 degrees, five at 90. A wall 75 mm
#: away looks through it as if the angles had drifted.
PUPIL_SIGMA = 0.002
#: How a profile may drift: directions, and their sigmas. A knock or another temperature moves these, no others.
DRIFT = {
    "angle scale": 0.03,  # all angles by a factor
    "alpha": 0.05,  # cot theta -> alpha cot theta, which a straight drive cannot see
    "bend": 0.01,  # k2
    "centre u": 15.0,  # pixels
    "centre v": 15.0,
}
UNITS = {"angle scale": "%", "alpha": "%", "bend": "", "centre u": "px", "centre v": "px"}
# A drive that never turns its axis by this much within TURN_KEYFRAMES, about as far as a point is seen, is taken for
# straight: what the adjustment would read from smaller turns is mostly its own noise, which adds up with the length.
TURN_LEAST = math.radians(2.0)
TURN_KEYFRAMES = 10
SEEN = 4.0  # information over that of the drift's prior, from which on a combination counts as observed

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
    changes          of each way to drift: value, sigma (units of UNITS)
    probability      that noise and the profile's covariance alone give as much drift as was seen
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
    """(9,5): what each way to drift, by its unit, does to FREE."""
    theta = np.linspace(0.02, 1.0, 60) * theta_end
    k = np.array([camera.k2, camera.k3, camera.k4, camera.k5])
    powers = theta[:, None] ** np.array([3, 5, 7, 9])
    rise = 1 + (theta[:, None] ** np.array([2, 4, 6, 8]) * np.array([3, 5, 7, 9])) @ k
    design = np.column_stack([theta + powers @ k, powers])
    scale = np.abs(design).max(axis=0)
    along = np.linalg.lstsq(design / scale, rise * np.sin(theta) * np.cos(theta), rcond=None)[0] / scale
    out = np.zeros((len(FREE), len(DRIFT)))
    out[0, 0], out[1, 0] = camera.f_u, camera.f_v
    out[0, 1], out[1, 1], out[4:8, 1] = along[0] * camera.f_u, along[0] * camera.f_v, along[1:]
    out[4, 2] = out[2, 3] = out[3, 4] = 1.0
    return out


def _own_covariance(camera: Camera) -> Floats:
    """The profile's covariance of FREE, (9,9); with a little of each so that it has an inverse."""
    pupil = 1e-4 if "pupil_e1" in camera.covariance_parameters else PUPIL_SIGMA
    bends = [1e-8, 1e-9, 1e-10, 1e-11]
    out = np.diag([(2e-4 * camera.f_u) ** 2, (2e-4 * camera.f_v) ** 2, 0.01, 0.01, *bends, pupil**2])
    if camera.covariance is not None:
        places = [(i, FREE.index(n)) for i, n in enumerate(camera.covariance_parameters) if n in FREE]
        for i, a in places:
            for j, b in places:
                out[a, b] += camera.covariance[i, j]
    return out


def _diameter_slope(camera: Camera, tracks: Tracks, directions: Floats) -> Floats:
    """(5,): how ln of the diameter answers to each way to drift, for the angles at which the wall was seen. A wall
    point seen at two angles a and b, a distance s apart, is s / (cot a - cot b) off the axis."""
    first = np.flatnonzero(np.diff(tracks.track, prepend=-1))
    last = np.append(first[1:], len(tracks.track)) - 1
    ends = tracks.pixels[np.concatenate([first, last])]

    def angles(changed: Camera) -> Floats:
        rays, _ = changed.unproject(ends)
        return np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])

    theta = angles(camera)
    near, far = np.split(theta, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        base = 1 / np.tan(near) - 1 / np.tan(far)
        weight = base**2 / (1 / np.sin(near) ** 4 + 1 / np.sin(far) ** 4)
    out = np.zeros(directions.shape[1])
    for column in range(directions.shape[1]):
        h = 1e-4 * (DRIFT[list(DRIFT)[column]] / 0.05)
        changed = dataclasses.replace(
            camera,
            covariance=None,
            covariance_parameters=(),
            **{n: getattr(camera, n) + h * d for n, d in zip(FREE, directions[:, column], strict=True)},
        )
        slope_near, slope_far = np.split((angles(changed) - theta) / h, 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            each = (slope_near / np.sin(near) ** 2 - slope_far / np.sin(far) ** 2) / base
        known = np.isfinite(each) & np.isfinite(weight) & (np.abs(base) > 0.2)
        out[column] = np.average(each[known], weights=weight[known]) if known.any() else 0.0
    return out


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


def _prior(camera: Camera, directions: Floats) -> Floats:
    scaled = directions * np.array(list(DRIFT.values()))
    return _own_covariance(camera) + scaled @ scaled.T


def drift_prior(tracks: Tracks, camera: Camera) -> tuple[tuple[str, ...], Floats] | None:
    """What reconstruct(drift=...) takes for a check of the profile. None for a camera that is not generic, or not a
    track inside its field."""
    end = _theta_end(camera, tracks) if camera.radial == "generic" else 0.0
    return (FREE, _prior(camera, _directions(camera, end))) if end > 0 else None


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
    common: float = 1.0,
    threads: int | None = None,
    shutter: RollingShutter | None = None,
) -> ProfileCheck:
    """Tests a survey against its profile.

    tracks .. sigma, shutter  as of reconstruct()
    structure        reconstruct() of the same with drift=drift_prior(tracks, camera); None: it is made here
    diameter         known true inner diameter, metres, with diameter_sigma (relative): beside an encoder it shows what
                     a straight drive cannot
    budget           sigma of the diameter, relative, above which the answer is "cannot tell"
    common           factor on the noise of the tracks, for errors that many of them have in common

    Raises ArgumentError.
    """
    if not common >= 1:
        raise ArgumentError(f"common: {common} is below 1")
    if not budget > 0 or not diameter_sigma > 0 or (diameter is not None and not diameter > 0):
        raise ArgumentError("budget, diameter, diameter_sigma: not above 0")
    if camera.radial != "generic":
        camera = camera.to_generic()[0]
    end = _theta_end(camera, tracks)
    if not end > 0:
        return _nothing(budget, "no track inside the profile's field")
    directions = _directions(camera, end)
    drift = np.array(list(DRIFT.values()))
    own, prior = _own_covariance(camera), _prior(camera, directions)
    found = structure or reconstruct(
        tracks,
        dataclasses.replace(camera, covariance=None, covariance_parameters=()),
        chainage,
        encoder=encoder,
        attitude=attitude,
        attitude_sigma=attitude_sigma,
        sigma=sigma,
        threads=threads,
        drift=(FREE, prior),
        shutter=shutter,
    )
    if not found.drift:
        return _nothing(budget, f"nothing was measured: {found.reason}")
    if diameter is None and _largest_turn(found) < TURN_LEAST:
        return _nothing(
            budget,
            "the camera never panned, tilted or went round a bend; a known diameter beside the encoder "
            "would show a drift",
        )
    # In units of the drift's sigmas; what of a change is no drift belongs to the profile's own covariance.
    scaled = directions * drift
    weight = np.linalg.inv(own)
    into = np.linalg.solve(scaled.T @ weight @ scaled + np.eye(5), scaled.T @ weight)
    before, own_part = into @ prior @ into.T, into @ own @ into.T
    value, spread = _together(found, into, before, common)
    slope = _diameter_slope(camera, tracks, directions) * drift
    evidence = "bends and turns of the drive"
    if diameter is not None and found.unit == "metre":
        value, spread, evidence = _with_diameter(found, diameter, diameter_sigma, common, value, spread, slope)
    return _judge(value, spread, before, own_part, slope, drift, budget, evidence)


def _together(found: Reconstruction, into: Floats, before: Floats, common: float) -> tuple[Floats, Floats]:
    """Drift (5,) in its prior's sigmas and its covariance, from all segments. Noise above the one stated counts."""
    prior = np.linalg.inv(before)
    known, weighed = prior.copy(), np.zeros(len(before))
    for part, factor in zip(found.drift, found.variance_factor, strict=True):
        posterior = np.linalg.inv(into @ part["covariance"] @ into.T)
        noise = common**2 * max(1.0, factor)
        known += (posterior - prior) / noise
        weighed += posterior @ into @ part["camera"] / noise
    spread = np.linalg.inv((known + known.T) / 2)
    return spread @ weighed, spread


def _largest_turn(found: Reconstruction) -> float:
    """Largest angle of the optical axis between keyframes of a stretch up to TURN_KEYFRAMES apart, radians."""
    most = 0.0
    for number in np.unique(found.segment):
        axes = found.poses[found.segment == number, 2, :3]
        for apart in range(1, min(TURN_KEYFRAMES, len(axes) - 1) + 1):
            cosines = np.einsum("ni,ni->n", axes[apart:], axes[:-apart])
            most = max(most, float(np.arccos(np.clip(cosines, -1, 1)).max()))
    return most


def _nothing(budget: float, why: str) -> ProfileCheck:
    changes = {name: (0.0, math.inf) for name in DRIFT}
    return ProfileCheck(VERDICTS["unknown"], f"Cannot tell: {why}.", math.inf, budget, changes, 1.0, 0, why)


def _with_diameter(
    found: Reconstruction,
    diameter: float,
    diameter_sigma: float,
    common: float,
    value: Floats,
    spread: Floats,
    slope: Floats,
) -> tuple[Floats, Floats, str]:
    """The known diameter beside the measured one, as one more measurement of the drift."""
    part = found.drift[0]
    inside = np.flatnonzero(found.point_segment == 0)
    inside = inside[np.isin(found.track[inside], part["tracks"])]
    kept = np.isin(part["tracks"], found.track[inside])
    centres = -np.einsum("nij,ni->nj", part["poses"][:, :, :3], part["poses"][:, :, 3])
    tube = fit_tube(part["points"][kept], found.covariance[inside], centres)
    if tube.status != "ok":
        return value, spread, f"bends and turns of the drive; no diameter ({tube.reason})"
    measured = float(tube.summary["d_mean"])
    random = common * float(tube.summary["d_mean_sigma"]) / measured
    noise = random**2 + found.scale_sigma**2 + diameter_sigma**2
    gain = spread @ slope / (slope @ spread @ slope + noise)
    value = value + gain * math.log(diameter / measured)
    spread = spread - np.outer(gain, slope @ spread)
    return value, (spread + spread.T) / 2, "the encoder and the known diameter, bends and turns of the drive"


def _judge(
    value: Floats,
    spread: Floats,
    before: Floats,
    own: Floats,
    slope: Floats,
    drift: Floats,
    budget: float,
    evidence: str,
) -> ProfileCheck:
    open_sigma = math.sqrt(max(0.0, slope @ spread @ slope))
    # What the data alone say: information beyond the prior's, along the combinations that have enough of it.
    known = np.linalg.inv(spread) - np.linalg.inv(before)
    size, axes = np.linalg.eigh((known + known.T) / 2)
    seen = size > SEEN
    axes, size = axes[:, seen], size[seen]
    statistic = 0.0
    if seen.any():
        alone = axes.T @ np.linalg.solve(spread, value) / size
        noise = np.diag(1 / size) + axes.T @ own @ axes
        statistic = float(alone @ np.linalg.solve(noise, alone))
    probability = _chi2_tail(statistic, int(seen.sum()))
    sigmas = np.sqrt(np.maximum(0, spread.diagonal()))
    changes = {
        name: (float(v * d * (100 if UNITS[name] == "%" else 1)), float(s * d * (100 if UNITS[name] == "%" else 1)))
        for name, v, s, d in zip(DRIFT, value, sigmas, drift, strict=True)
    }
    moved = probability < FALSE_ALARM
    worst = max(changes, key=lambda name: abs(changes[name][0]) / max(changes[name][1], 1e-12))
    what = f"{worst} changed by {changes[worst][0]:+.2g} +- {changes[worst][1]:.1g} {UNITS[worst]}".rstrip()
    open_text = f"sigma(alpha) is {100 * open_sigma:.2g} % of the diameter"
    if open_sigma > budget:
        verdict = VERDICTS["unknown"]
        text = (
            f"Cannot tell whether the profile still holds: {open_text}, more than the {100 * budget:.2g} % allowed. "
            "A bend, panning and tilting, or a known diameter beside the encoder would show it."
        )
        if moved:
            text += f" What can be seen does not fit the profile, though: {what}. Recalibrate where limits are tight"
            text += "."
    elif moved:
        verdict = VERDICTS["drifted"]
        text = f"The profile has drifted: {what}; {open_text}. Recalibrate the camera."
    else:
        verdict, text = VERDICTS["valid"], f"The profile is still valid: {open_text}, by {evidence}."
    return ProfileCheck(verdict, text, open_sigma, budget, changes, probability, int(seen.sum()), evidence)
