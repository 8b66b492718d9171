"""What one should know about a measurement: residuals by angle, remarks, stretches not measured."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from pipefish.assumed import assumed_px
from pipefish.camera import Camera
from pipefish.health import VERDICTS
from pipefish.measure import Measurement, Residuals, Stretch, mean_diameter
from pipefish.measured_texts import clock_text
from pipefish.scale import disagreement
from pipefish.structure import REASONS
from pipefish.survey import Tracks

THETA_BIN = math.radians(10)
TREND_PX = 0.15  # mean radial residual of a bin: more says that the profile or its centre of projection is wrong
BIN_LEAST = 100  # observations, for a bin to be judged
INVERT = math.radians(45)  # from six o'clock
GAP_TOLD = math.radians(60)  # without points, at GAP_SHARE of a stretch's stations: worth a remark
GAP_SHARE = 0.2
SIGMA_MOST = 2.0  # robust spread of the residuals over the tracks' own noise


def trend(residuals: Residuals, camera: Camera, tracks: Tracks) -> list[dict[str, Any]]:
    """Residuals of the inliers by angle from the axis: low, high (degrees), count, mean radial and rms, px."""
    keep = residuals.inlier
    out = tracks.pixels[residuals.item[keep]] - np.array([camera.c_u, camera.c_v])
    radial = np.einsum("ni,ni->n", residuals.pixels[keep], out) / np.maximum(np.linalg.norm(out, axis=1), 1e-9)
    number = (residuals.theta[keep] / THETA_BIN).astype(int)
    rms = np.einsum("ni,ni->n", residuals.pixels[keep], residuals.pixels[keep]) / 2
    rows = []
    for k in np.unique(number):
        inside = number == k
        rows.append(
            {
                "low_deg": 10.0 * int(k),
                "high_deg": 10.0 * int(k) + 10.0,
                "count": int(inside.sum()),
                "mean_radial_px": float(radial[inside].mean()),
                "rms_px": float(np.sqrt(rms[inside].mean())),
            }
        )
    return rows


def remark(m: Measurement) -> None:
    """What one should know, most serious first."""
    told = disagreement(m.scale)
    remarks = [told] if told else []
    if m.health is not None and m.health.verdict == VERDICTS["drifted"]:
        remarks.append(m.health.text)
    if m.scale.source == "none":
        remarks.append(
            "There is no scale: no encoder, no known length. Lengths are in mean diameters; only ratios were "
            "measured. --joint-spacing or --target gives a scale, --diameter one for all but the diameter."
        )
    if m.scale.source == "diameter":
        remarks.append(
            f"The scale is the given diameter of {1000 * mean_diameter(m)[0]:.1f} mm. So the mean diameter was not "
            "measured; its changes along the pipe, ovality and angles were."
        )
    worst = m.residuals.spread
    if worst > SIGMA_MOST:
        remarks.append(
            f"Residuals scatter {worst:.1f} times as far as the tracks' own noise: a wrong profile, a lens that "
            "has moved, or "
            "a wall that does?"
        )
    bins = [b for b in trend(m.residuals, m.camera, m.tracks) if b["count"] >= BIN_LEAST]
    bent = max(bins, key=lambda b: abs(b["mean_radial_px"]), default=None)
    if bent and abs(bent["mean_radial_px"]) > TREND_PX:
        remarks.append(
            f"Residuals have a trend: {bent['mean_radial_px']:+.2f} px outwards between {bent['low_deg']:.0f} and "
            f"{bent['high_deg']:.0f} degrees from the axis. The profile does not quite fit the camera (or its "
            "pupil moves), "
            "and diameters may be off by more than their intervals."
        )
    if m.health is not None and m.health.verdict not in (VERDICTS["drifted"], VERDICTS["valid"]):
        remarks.append(m.health.text)
    remarks += _invert_remark(m)
    if m.camera.covariance is None:
        whence = "it does not say what its calibration left" if m.camera.rms_px is None else "as its calibration left"
        remarks.append(
            "The camera profile has no covariance: what its radial function and its pupil are off is not in the "
            f"intervals of diameters. Ovality counts it as asymmetric by {assumed_px(m.camera):.2g} px all over the "
            f"picture ({whence})."
        )
    if m.structure.down is None:
        remarks.append("No inclinometer: the clock is relative to the first keyframe.")
    if m.backwards:
        remarks.append("The camera drove backwards, against its line of sight; clock as the camera looks.")
    for b in m.survey.breaks:
        if b["restart"]:
            remarks.append(
                f"The device restarted before keyframe {b['index']}: what it drove meanwhile nobody counted, and the "
                "chainage goes on as if it were nothing."
            )
    if m.structure.repeated:
        remarks.append(f"{m.structure.repeated} observations were of one track twice in a frame and were left out.")
    m.remarks = remarks + m.remarks


def unseen_sector(m: Measurement, stretch: Stretch, low: float, high: float) -> tuple[str, float]:
    """Where around the wall there are no points between two s of a stretch, in words, and how wide that is, radians."""
    p, half = stretch.tube.points, 0.375 * stretch.tube.summary["d_mean"]
    on = (p["s"] > low - half) & (p["s"] < high + half) & (p["weight"] > 0)
    clock = np.sort(p["clock"][on])
    if len(clock) < 2:
        return "", 2 * math.pi
    width = np.diff(np.append(clock, clock[0] + 2 * math.pi))
    k = int(width.argmax())
    middle = (clock[k] + width[k] / 2) % (2 * math.pi)
    words = f", around {clock_text(middle)} o'clock"
    if m.structure.down is not None and abs(middle - math.pi) < INVERT:
        words += " (the invert: water or sediment?)"
    return words, float(width[k])


def _invert_remark(m: Measurement) -> list[str]:
    """Of stretches whose ellipse stands on the rest of the wall, because part of it shows no points."""
    out = []
    for stretch in m.measured:
        table = stretch.tube.stations
        bare = (table["status"] == "ok") & (table["gap"] > GAP_TOLD)
        if bare.mean() < GAP_SHARE:
            continue
        s = table["s"][bare]
        words, _ = unseen_sector(m, stretch, float(s[0]), float(s[-1]))
        ends, degrees = np.sort(stretch.chainage(s[[0, -1]])), math.degrees(np.median(table["gap"][bare]))
        out.append(
            f"From {ends[0]:.2f} to {ends[1]:.2f} the wall shows no points over {degrees:.0f} degrees, where it shows "
            f"fewest{words}: diameters and ovality there are those of an ellipse through the rest, and "
            "what lies below was not measured."
        )
    return out


def not_measured(m: Measurement) -> list[dict[str, Any]]:
    """Stretches without values: start, end (chainage, None where it is unknown), reason, detail."""
    rows = []
    along = np.full(len(m.index), np.nan)
    along[m.structure.frames] = m.frame_chainage()
    if m.encoder is not None:
        along = m.encoder

    def at(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    for gap in m.structure.gaps:
        rows.append(
            {
                "start": at(along[gap.first]),
                "end": at(along[gap.last]),
                "reason": gap.reason,
                "detail": f"keyframes {m.index[gap.first]} to {m.index[gap.last]}: {REASONS[gap.reason]}",
            }
        )
    for stretch in m.stretches:
        if stretch.tube.status != "ok":
            ends = along[stretch.frames[[0, -1]]]
            rows.append(
                {"start": at(ends[0]), "end": at(ends[1]), "reason": stretch.tube.status, "detail": stretch.tube.reason}
            )
            continue
        stations = stretch.tube.stations
        for good, run in itertools.groupby(range(len(stations["s"])), key=lambda i: stations["status"][i]):
            if good == "ok":
                continue
            inside = list(run)
            ends = np.sort(stretch.chainage(stations["s"][[inside[0], inside[-1]]]))
            what = {
                "circle_only": "mean diameter only: no wall seen over more than 150 degrees",
                "one_sided": "nothing: no wall seen over more than 220 degrees",
                "too_few_points": "nothing: too few points on the wall",
            }[str(good)]
            if good != "too_few_points":
                what += unseen_sector(m, stretch, stations["s"][inside[0]], stations["s"][inside[-1]])[0]
            rows.append({"start": float(ends[0]), "end": float(ends[1]), "reason": str(good), "detail": what})
    return sorted(rows, key=lambda r: (r["start"] is None, r["start"] or 0.0))
