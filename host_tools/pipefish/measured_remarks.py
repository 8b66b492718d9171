"""What one should know about a measurement: residuals by angle, remarks, stretches not measured."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from pipefish.assumed import assumed_px
from pipefish.camera import Camera
from pipefish.health import VERDICTS
from pipefish.intervals import Z95
from pipefish.lens_ripple import LENS_RADIAL_PX
from pipefish.measured_texts import clock_text, length_text
from pipefish.measurement import Measurement, Residuals, Stretch, mean_diameter
from pipefish.repeated import against_encoder
from pipefish.scale import disagreement
from pipefish.structure import REASONS
from pipefish.survey import Tracks
from pipefish.tube_shape import NO_ELLIPSE

THETA_BIN = math.radians(10)
TREND_PX = 0.15  # mean radial residual of a bin: more says that the profile or its centre of projection is wrong
BIN_LEAST = 100  # observations, for a bin to be judged
INVERT = math.radians(45)  # from six o'clock
GAP_TOLD = math.radians(60)  # without points, at GAP_SHARE of a stretch's stations: worth a remark
GAP_SHARE = 0.2
LINE_SIGMAS, LINE_OFF = 5.0, 0.25  # beyond both a stated line time is doubted: swaying between keyframes biases it
NOMINAL_OFF = 0.1  # pipes are up to 7 % off the diameter that they are named by
TURNED = 0.25  # diameters that the camera must go back
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


def bent(m: Measurement) -> dict[str, Any] | None:
    """The row of trend() that is furthest off, where that is more than a profile that fits leaves."""
    rows = [b for b in trend(m.residuals, m.camera, m.tracks) if b["count"] >= BIN_LEAST]
    most = max(rows, key=lambda b: abs(b["mean_radial_px"]), default=None)
    return most if most and abs(most["mean_radial_px"]) > TREND_PX else None


def bent_text(row: dict[str, Any]) -> str:
    return (
        f"residuals have a trend: {row['mean_radial_px']:+.2f} px outwards between {row['low_deg']:.0f} and "
        f"{row['high_deg']:.0f} degrees from the axis"
    )


def remark(m: Measurement) -> None:
    """What one should know, most serious first."""
    told = disagreement(m.scale)
    remarks = [told] if told else []
    if m.health is not None and m.health.verdict == VERDICTS["drifted"]:
        # Told by a given diameter beside the encoder, one of three is wrong.
        given = any(row["name"] == "diameter" for row in m.scale.sources)
        remarks.append(
            m.health.text.rstrip(".") + (", unless the encoder or the given diameter is wrong." if given else ".")
        )
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
    remarks += _nominal_remark(m)
    worst = m.residuals.spread
    if worst > SIGMA_MOST:
        remarks.append(
            f"Residuals scatter {worst:.1f} times as far as the tracks' own noise: a wrong profile, a lens that "
            "has moved, or "
            "a wall that does?"
        )
    row = bent(m)
    if row:
        remarks.append(
            f"R{bent_text(row)[1:]}. The profile does not quite fit the camera (or its pupil moves), and diameters may "
            "be off by more than their intervals."
        )
    if m.health is not None and m.health.verdict not in (VERDICTS["drifted"], VERDICTS["valid"]):
        remarks.append(m.health.text)
    remarks += _repeated_remark(m)
    remarks += _shape_remark(m) + _water_remark(m) + _invert_remark(m)
    remarks += _uncovered_remark(m)
    if m.structure.down is None:
        remarks.append("No inclinometer: the clock is relative to the first keyframe.")
    remarks += _shutter_remark(m)
    remarks += _turned_remark(m)
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


def _uncovered_remark(m: Measurement) -> list[str]:
    """Of a profile that does not say how well it is known."""
    if m.camera.covariance is not None:
        return []
    px = assumed_px(m.camera)
    whence = "it does not say what its calibration left" if m.camera.rms_px is None else "as its calibration left"
    radial = "what its radial function is off is not in the intervals of diameters"
    if m.structure.unit != "metre" and m.camera.radial == "generic":
        radial = f"diameters count its radial function as off by {max(px, LENS_RADIAL_PX):.2g} px"
    return [
        f"The camera profile has no covariance: {radial}. Ovality counts it as asymmetric by {px:.2g} px all over the "
        f"picture ({whence})."
    ]


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


def _nominal_remark(m: Measurement) -> list[str]:
    """Of a diameter that no pipe of that name has: not a check of a few per cent, which nominal diameters are off."""
    if not m.nominal or m.scale.unit != "metre" or m.scale.diameter_from_prior:
        return []
    value, off = mean_diameter(m)[0], mean_diameter(m)[0] / m.nominal - 1
    if abs(off) < NOMINAL_OFF:
        return []
    return [
        f"The mean diameter of {1000 * value:.0f} mm is {100 * abs(off):.0f} % {'over' if off > 0 else 'under'} the "
        f"nominal {1000 * m.nominal:.0f} mm: a wrong camera profile, a wrong scale of {m.scale.source}, or another "
        "pipe than was said?"
    ]


def _repeated_remark(m: Measurement) -> list[str]:
    """Of a wall whose tracks may have gone on to the next repeat."""
    found = m.repeats
    if found is None or not (found.alarm or m.jumped):
        return []
    words = f"The wall looks the same again in {100 * found.share:.0f} % of the places looked at"
    if not math.isfinite(found.period):
        return [words + ": tracks may have gone on to another place that looks alike."]
    words += f", {length_text(found.period, m.scale.unit)} further along the pipe"
    if m.jumped:
        gaps = sum(g.reason == "repeated_pattern" for g in m.structure.gaps)
        names = ", ".join(str(m.index[f]) for f in m.jumped)
        words += (
            f". At keyframe{'s' if len(m.jumped) > 1 else ''} {names} all tracks had gone on to the next "
            "repeat, as the encoder says; they were cut there and "
            f"{'joined again' if not gaps else 'joined again but for the gaps told'}."
        )
        return [words]
    steps = np.linalg.norm(np.diff(m.structure.centres, axis=0), axis=1)[np.diff(m.structure.segment) == 0]
    step, value = float(np.median(steps)), mean_diameter(m)[0]
    compared = int(np.isfinite(against_encoder(m)).sum())
    if not compared:
        return [words + ": without an encoder nobody knows whether tracks went on to the next repeat."]
    each = "each step" if compared == len(steps) else f"the {compared} of {len(steps)} steps that it has readings of"
    other = [value * step / (step + k * found.period) for k in (-1, 1) if step + k * found.period > 0.2 * step]
    sizes = " or ".join(length_text(d, m.scale.unit) for d in other)
    return [
        words + f". Encoder and pictures agree about {each}; had tracks gone on by one repeat at every keyframe, they "
        f"would, too, and the diameter would be {sizes}."
    ]


def _shutter_remark(m: Measurement) -> list[str]:
    """Of rows that say another time than was stated."""
    shutter, told = m.structure.shutter, m.structure.line_time
    if shutter is None or told is None:
        return []
    stated, (value, sigma) = 1e6 * shutter.line_time, (1e6 * told[0], 1e6 * told[1])
    if abs(value - stated) < max(LINE_SIGMAS * sigma, LINE_OFF * abs(stated)):
        return []
    why = ": is its sign wrong?" if abs(value + stated) < max(LINE_SIGMAS * sigma, LINE_OFF * abs(stated)) else ""
    return [
        f"The rolling shutter is stated as {stated:.1f} us a row (camera.line_time_us, --line-time), but the survey's "
        f"own rows say {value:.1f} ± {Z95 * sigma:.1f}{why}"
        + ("" if why else ": bends, clocks and ovality may be off.")
    ]


def _turned_remark(m: Measurement) -> list[str]:
    """Of a drive that passes wall a second time. By the path: not all encoders count backwards."""
    back, size = 0.0, mean_diameter(m)[0]
    for segment in range(len(m.structure.sigma)):
        steps = np.diff(m.structure.centres[m.structure.segment == segment], axis=0)
        steps = steps[np.linalg.norm(steps, axis=1) > 1e-3 * size]
        if not len(steps):
            continue
        turns = np.einsum("ni,ni->n", steps[1:], steps[:-1]) < 0
        way = np.cumprod(np.append(1.0, np.where(turns, -1.0, 1.0)))
        driven = np.append(0.0, np.cumsum(way * np.linalg.norm(steps, axis=1)))
        driven *= 1.0 if driven[-1] >= 0 else -1.0
        back = max(back, float((np.maximum.accumulate(driven) - driven).max()))
    if back < TURNED * size:
        return []
    return [
        f"The camera turned round and drove back by up to {length_text(back, m.scale.unit, metres=True)}: what it "
        "passed twice was measured as new wall each time, and both count."
    ]


def _shape_remark(m: Measurement) -> list[str]:
    """Of sections that are no ellipse."""
    out = []
    for stretch in m.measured:
        table = stretch.tube.stations
        odd = (table["status"] == "ok") & (table["departure"] > NO_ELLIPSE * table["d_mean"])
        if odd.mean() < GAP_SHARE:
            continue
        ends = np.sort(stretch.chainage(table["s"][odd][[0, -1]]))
        most = length_text(float(table["departure"][odd].max()), m.scale.unit)
        out.append(
            f"From {ends[0]:.2f} to {ends[1]:.2f} the section is no ellipse (an egg, or bent in?): it departs from the "
            f"nearest one by up to {most}. Diameters and ovality are those of the section as it is."
        )
    return out


def _water_remark(m: Measurement) -> list[str]:
    """Of points that were seen in water or through it."""
    out = []
    for stretch in m.measured:
        for w in stretch.water:
            start, end = np.sort(stretch.chainage([w["start"], w["end"]]))
            out.append(
                f"From {start:.2f} to {end:.2f} water mirrors the wall: {w['points']} points under its surface are no "
                f"wall and were left out. It stands {length_text(w['depth'], m.scale.unit)} over the invert."
            )
    return out


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


def _bare_between(m: Measurement, start: float, end: float) -> tuple[float, float]:
    """The wall that stretches leave between two keyframes: a camera sees it ahead of where it is."""
    low, high = min(start, end), max(start, end)
    before, after, reach = [], [], mean_diameter(m)[0]  # further off lies what other gaps are told of
    for stretch in m.measured:
        table = stretch.tube.stations
        seen = stretch.chainage(table["s"][table["status"] == "ok"])
        if len(seen) and seen.min() <= low < seen.max() + reach:
            before.append(float(seen.max()))
        elif len(seen) and seen.min() - reach < high <= seen.max():
            after.append(float(seen.min()))
    low, high = max(before, default=low), min(after, default=high)
    return min(low, high), high


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
        start, end = _bare_between(m, along[gap.first], along[gap.last])
        detail = f"keyframes {m.index[gap.first]} to {m.index[gap.last]}: {REASONS[gap.reason]}"
        if start == end:
            detail += "; the wall there was seen all the same"
        rows.append({"start": at(start), "end": at(end), "reason": gap.reason, "detail": detail})
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
                "circle_only": "mean diameter only, if the rest goes on round: no wall seen over more than 150 degrees",
                "open": "nothing: the section is no ellipse, and too little of it is seen to tell what it is",
                "one_sided": "nothing: no wall seen over more than 220 degrees",
                "too_few_points": "nothing: too few points on the wall",
            }[str(good)]
            if good != "too_few_points":
                what += unseen_sector(m, stretch, stations["s"][inside[0]], stations["s"][inside[-1]])[0]
            rows.append({"start": float(ends[0]), "end": float(ends[1]), "reason": str(good), "detail": what})
    return sorted(rows, key=lambda r: (r["start"] is None, r["start"] or 0.0))
