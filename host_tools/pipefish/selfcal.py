"""Self-calibration: a camera from matches of one or many pairs of views of an unknown scene. docs/selfcal.md.

The search and the adjustment are C++ (engine/selfcal); here arguments are checked and the result is judged.
"""

from __future__ import annotations

import datetime
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _engine
from .camera import Camera, Provenance
from .errors import ArgumentError
from .intervals import Z95

Floats = npt.NDArray[np.float64]

#: Sigma of ln alpha that is still a calibration: 8 % are 2.3 degrees at 45 degrees off the axis.
ALPHA_LIMIT = 0.08
#: The same by the matches alone. 500 set-ups of general motion: at most 0.008; 100 without rotation or along the axis:
#: at least 0.1.
ALONE_LIMIT = 0.02
USABLE_FOCAL, USABLE_BEARING = 0.03, math.radians(0.5)  # largest sigmas of what one may measure with
AS_GOOD = 1.01  # times the cost of the one found
AREA_LEAST = 0.10  # of the picture, that the matches must span
AXIAL = math.radians(12.0)
TILT_USUAL = math.radians(20.0)  # as docs/selfcal.md asks for, where no angle is enough for these matches alone
TILT_LITTLE = math.radians(4.0)
MATCHES_MOST = 20_000  # a pair: 17 s; two thousand say as much
#: Of a pair's matches that must agree. A lens and a motion that are free find 15 of 500 random ones.
AGREE_LEAST = 0.25
CENTRE_SIGMA = 0.01  # of the picture's width
BEND = 0.01  # of the radius at the rim: how far a lens differs from its nearest nominal projection
ASPECT_SIGMA = 1e-3  # pixels are taken to be square; the covariance says how sure that is
# Pixels. No lens is rounder, no pixel squarer: corners of a bent board have residuals of 0.03 px, and say of alpha
# what is not so.
SIGMA_LEAST = 0.2
ALPHA_TEXT = "sigma(alpha)"  # in a profile's provenance, before the number in per cent
PARAMETERS = ("f_u", "f_v", "c_u", "c_v", "k2", "k3", "k4", "k5")

#: Why there is no camera.
REASONS = {
    "no_matches": "too few matches agree with one motion of a camera. Take sharp pictures of a scene that stands still "
    "and has texture, which overlap by more than half",
    "standing": "hardly anything moved between the views: a camera that stands, or one picture twice. Move it, and pan "
    "or tilt it, between views (where a target was moved before it: pipefish calibrate)",
    "turning": "the camera only turned: without a change of place nothing is seen in depth. Move it as well, by a "
    "tenth of the distance to the scene or more",
    "low_coverage": "the matches span too little of the picture",
    "planar": "the matches are of a plane, which two views of say nothing about the angles of the lens",
    "no_rotation": "the camera moved without panning or tilting: bearings may all be stretched along its axis (alpha)",
    "axial": "the camera moved along its optical axis without panning or tilting: any lens explains that",
    "weak": "the matches leave the lens too uncertain: few, noisy, of a camera that hardly turned, or of a scene that "
    "is nearly flat",
}


@dataclass(frozen=True, eq=False)
class PairReport:
    """One pair of views.

    status   "ok"; or "few", "standing", "turning", "plane": then it says nothing of the lens
    pose     (3,4) cam2_from_cam1, translation of length 1
    inlier   (n,) bool
    shift    median displacement, pixels; rms: of the inliers' errors, pixels
    """

    status: str
    pose: Floats
    inlier: npt.NDArray[np.bool_]
    shift: float
    rms: float


@dataclass(frozen=True, eq=False)
class SelfCalibration:
    """What self_calibrate returns.

    status         "ok", or a key of REASONS: then camera is None and `reason` says why and what is missing
    camera         source "selfcal", with covariance; None where refused
    pairs          list of PairReport
    sigma          that a match counts with, pixels: at least sigma_least
    rms            of the right matches' errors, pixels
    alpha_sigma    sigma along the direction that matches show least, cot theta -> alpha cot theta, relative; infinite
                   where every pair is of a plane, a rotation or a camera that stands
    bearing_sigma  largest sigma of a ray inside the covered field, radians, after the best common rotation
    radius, theta  of the covered field: pixels from the principal point, and radians
    area           share of the picture that the matches span
    tilt           largest angle between optical axes of a pair, radians
    needed         radians by which the camera should have been panned or tilted; 0: no such angle would do, or needed
    starts, refined, agreeing   how many starts were tried, refined, and end at this camera
    runner_up      cost of the next best minimum, of this one's; 0: none was found
    """

    status: str
    reason: str
    camera: Camera | None
    pairs: list[PairReport]
    sigma: float = math.nan
    rms: float = math.nan
    alpha_sigma: float = math.nan
    bearing_sigma: float = math.nan
    radius: float = math.nan
    theta: float = math.nan
    area: float = math.nan
    tilt: float = math.nan
    needed: float = 0.0
    starts: int = 0
    refined: int = 0
    agreeing: int = 0
    runner_up: float = 0.0

    @property
    def usable(self) -> bool:
        """Whether its own sigmas are below 3 % of the focal length and 0.5 degrees of bearings, without a rival."""
        if self.camera is None or self.ambiguous:
            return False
        focal = math.sqrt(self.camera.covariance[0, 0]) / self.camera.f_u
        return focal < USABLE_FOCAL and self.bearing_sigma < USABLE_BEARING

    @property
    def ambiguous(self) -> bool:
        """Whether another lens, found by other starts, explains the matches as well."""
        return 0 < self.runner_up < AS_GOOD


def _version() -> str:
    from . import __version__

    return __version__


def _pixels(name: str, value: Any, size: tuple[int, int]) -> Floats:
    try:
        out = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ArgumentError(f"{name}: not numbers") from None
    if out.ndim != 2 or out.shape[1] != 2:
        raise ArgumentError(f"{name}: shape {out.shape} is not (n,2)")
    if not np.isfinite(out).all():
        raise ArgumentError(f"{name}: not finite")
    # Half a feature's size beyond the rim is a measurement; more is another picture's pixel.
    if len(out) and ((out < -10.0).any() or (out > np.array(size) + 10.0).any()):
        raise ArgumentError(f"{name}: a pixel outside the picture of {size[0]}x{size[1]}")
    return out


def _pair(number: int, pair: Any, size: tuple[int, int]) -> tuple[Floats, Floats]:
    try:
        given = (pair.xy1, pair.xy2) if hasattr(pair, "xy1") else tuple(pair)
    except TypeError:
        given = ()
    if len(given) != 2:
        raise ArgumentError(f"pairs[{number}]: not two arrays of pixels")
    one, two = (_pixels(f"pairs[{number}]: view {k + 1}", xy, size) for k, xy in enumerate(given))
    if len(one) != len(two):
        raise ArgumentError(f"pairs[{number}]: {len(one)} pixels in one view, {len(two)} in the other")
    if len(one) > MATCHES_MOST:
        raise ArgumentError(f"pairs[{number}]: {len(one)} matches are more than {MATCHES_MOST}; take every n-th")
    return one, two


def self_calibrate(
    pairs: Sequence[Any],
    image_size: tuple[int, int],
    *,
    centre: tuple[float, float] | None = None,
    centre_sigma: float | None = None,
    sigma_least: float = SIGMA_LEAST,
    views: Sequence[tuple[int, int]] | None = None,
    seed: int = 0,
    threads: int | None = None,
) -> SelfCalibration:
    """The camera that matches of pairs of views were taken with; nothing else need be known of it.

    pairs         of one camera: each two arrays (n,2) of pixels, row by row of one scene point, or Matches. Up to 40 %
                  may be wrong
    image_size    (width, height), pixels
    centre        where the principal point is likely to be, pixels, and its sigma [the picture's, 1 % of the width]
    sigma_least   of a match's error, pixels: above what the residuals show where errors are common to many matches
    views         which two views each pair is of, to count them in the profile [all different]
    threads       do not change the result [all cores]

    The lens: radially symmetric, one viewpoint, square pixels, between perspective and orthographic or a central
    mirror, fields to 240 degrees. What the matches cannot tell is no error: see SelfCalibration.status.

    Raises ArgumentError.
    """
    try:
        width, height = (int(n) for n in image_size)
        middle = None if centre is None else tuple(float(n) for n in centre)
        pairs = list(pairs)
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError("pairs, image_size, centre: not a list of pairs, two whole numbers, two numbers") from None
    if not (16 <= width <= 16384 and 16 <= height <= 16384):
        raise ArgumentError(f"image_size: {width}x{height} is not within 16 to 16384 pixels")
    taken = [_pair(k, pair, (width, height)) for k, pair in enumerate(pairs)]
    if not taken:
        raise ArgumentError("pairs: none")
    middle = middle or ((width - 1) / 2, (height - 1) / 2)
    spread = CENTRE_SIGMA * width if centre_sigma is None else centre_sigma
    if len(middle) != 2 or not (np.isfinite(middle).all() and math.isfinite(spread) and spread > 0):
        raise ArgumentError("centre, centre_sigma: not two numbers, not finite or not above 0")
    if not isinstance(seed, int) or not 0 <= seed < 2**64 or (threads is not None and threads < 1):
        raise ArgumentError("seed, threads: not a whole number from 0, or from 1")
    if views is not None and len(views) != len(taken):
        raise ArgumentError(f"views: {len(views)}, pairs: {len(taken)}")
    if not (math.isfinite(sigma_least) and sigma_least > 0):
        raise ArgumentError("sigma_least: not finite and above 0")
    found = _engine.self_calibrate(
        [one for one, _ in taken],
        [two for _, two in taken],
        width,
        height,
        float(middle[0]),
        float(middle[1]),
        float(spread),
        BEND,
        ALPHA_LIMIT,
        ALONE_LIMIT,
        float(sigma_least),
        seed,
        threads or len(os.sched_getaffinity(0)),
    )
    reports = [
        PairReport(p["status"], p["pose"], p["inlier"], p["median_shift_px"], p["rms_px"]) for p in found["pairs"]
    ]
    used = [k for k, p in enumerate(found["pairs"]) if p["status"] == "ok"]
    if found["found"] and not used:  # at the lens that was found a plane looks as if it told of lenses
        found |= {"alpha_sigma": math.inf, "bearing_sigma": math.inf}
    values = _values(found)
    status = _status(found)
    if status != "ok":
        return SelfCalibration(status, _reason(status, found), None, reports, **values)
    which = [(2 * k, 2 * k + 1) for k in range(len(taken))] if views is None else views
    camera = _camera(found, width, height, len(used), len({v for k in used for v in which[k]}), values["rms"])
    return SelfCalibration("ok", "", camera, reports, **values)


def _values(found: dict[str, Any]) -> dict[str, Any]:
    """Fields of SelfCalibration."""
    values: dict[str, Any] = {key: found[key] for key in ("starts", "refined", "agreeing", "runner_up")}
    if found["found"]:
        values |= {key: found[key] for key in ("alpha_sigma", "bearing_sigma", "theta", "area", "tilt", "needed")}
        values |= {"sigma": found["sigma_px"], "radius": found["radius_px"]}
        good = [p for p in found["pairs"] if p["status"] == "ok"]
        if good:
            squares = sum(p["inliers"] * p["rms_px"] ** 2 for p in good)
            values["rms"] = math.sqrt(squares / sum(p["inliers"] for p in good))
    return values


def _status(found: dict[str, Any]) -> str:
    states = [p["status"] for p in found["pairs"]]
    most = max(("plane", "turning", "standing", "few"), key=states.count)  # the first of those that are as many
    if not found["found"]:
        if "standing" in states:
            return "standing"
        return "low_coverage" if 0 < found["area"] < AREA_LEAST else "no_matches"
    if found["area"] < AREA_LEAST:
        return "low_coverage"
    agree = [p for p in found["pairs"] if p["status"] != "few"]
    if sum(p["inliers"] for p in agree) < AGREE_LEAST * sum(len(p["inlier"]) for p in agree):
        return "no_matches"
    # Ahead in a straight pipe one radius maps to another, as before a wall: that the camera never tilted comes first.
    straight = "axial" if found["axial"] < AXIAL else "no_rotation"
    if "ok" not in states:
        if most == "plane" and found["tilt"] < TILT_LITTLE:
            return straight
        return {"plane": "planar", "few": "no_matches"}.get(most, most)
    if found["alpha_alone"] > ALONE_LIMIT or found["alpha_sigma"] > ALPHA_LIMIT:
        # Along the axis, where any lens will do, poor pairs feign tilts. Across it set-ups without any show 0.2 deg.
        if found["tilt"] < TILT_LITTLE or (straight == "axial" and found["alpha_alone"] > 5 * ALONE_LIMIT):
            return straight
        return "weak"
    return "ok"


def _reason(status: str, found: dict[str, Any]) -> str:
    text = REASONS[status]
    if status in ("no_rotation", "axial", "weak"):
        alone = found["alpha_alone"] > ALONE_LIMIT
        sigma, limit = (found["alpha_alone"], ALONE_LIMIT) if alone else (found["alpha_sigma"], ALPHA_LIMIT)
        known = f"± {100 * Z95 * sigma:.2g} %" if sigma < 1 else "± 200 % and more"
        text += f"; they leave its stretch along the axis open by {known} (95 %{', by themselves' if alone else ''}; "
        text += f"± {100 * Z95 * limit:.0f} % is the most). "
        degrees = max(1, round(math.degrees(found["needed"] or TILT_USUAL)))
        text += f"Pan or tilt by at least {degrees} degrees{' more' if status == 'weak' else ''} between views"
        text += " of a scene in depth"
        if not found["needed"]:
            text += ", with more or better matches: with such as these no angle would do"
        if any(p["status"] == "plane" for p in found["pairs"]):
            text += ". The matches look like those of a plane, too"
    if status == "low_coverage":
        area = math.floor(1000 * found["area"]) / 10
        text += f" ({area:g} %; {100 * AREA_LEAST:.0f} % are needed"
        if found["found"] and found["alpha_sigma"] < 1:
            text += f"; its stretch along the axis is open by ± {100 * Z95 * found['alpha_sigma']:.2g} % (95 %)"
        text += "). Take a scene that fills it"
    if status == "planar":
        text += ". Take a scene in depth: near and far things, not a wall or a board alone"
    return text


def stored_alpha_sigma(camera: Camera) -> float | None:
    """Sigma of ln alpha that a self-calibrated camera's profile keeps; None of any other."""
    kept = re.search(rf"{re.escape(ALPHA_TEXT)} (\d+(?:\.\d+)?(?:e[+-]?\d+)?) %", camera.provenance.model_choice)
    return float(kept[1]) / 100 if camera.source == "selfcal" and kept else None


def _camera(found: dict[str, Any], width: int, height: int, good: int, views: int, rms: float) -> Camera:
    small = found["covariance"]
    spread = np.zeros((8, 7))
    spread[0, 0] = spread[1, 0] = 1.0
    spread[2:, 1:] = np.eye(6)
    covariance = spread @ small @ spread.T
    covariance[1, 1] += (ASPECT_SIGMA * found["camera"]["f_u"]) ** 2
    covariance = (covariance + covariance.T) / 2
    return Camera(
        width=width,
        height=height,
        **found["camera"],
        source="selfcal",
        created=datetime.datetime.now(datetime.UTC),
        rms_px=rms,
        theta_covered=min(found["theta"], found["camera"]["theta_max"]),
        provenance=Provenance(
            tool="pipefish selfcal",
            version=_version(),
            model_choice=f"{good} pairs, {ALPHA_TEXT} {100 * found['alpha_sigma']:.2g} %",
            views=views,
            points=sum(p["inliers"] for p in found["pairs"] if p["status"] == "ok"),
        ),
        covariance_parameters=PARAMETERS,
        covariance=covariance,
    )
