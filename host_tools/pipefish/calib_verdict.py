"""Whether a calibration is good enough to measure pipes with, for which, and why: in plain words."""

from __future__ import annotations

import math
from typing import Any

from .intervals import Z95

SHARE = 0.005  # of the diameter: what profiler requirements of road agencies allow (MoDOT TM-84)
_STUDENT = 2.776  # the same of a standard deviation from the five parts of a jackknife
_UNSEEN = 0.001  # of the diameter: what all views share, as a pupil that moves otherwise than the model's (docs)
_NARROW = math.radians(60)  # below, the wall is seen only far ahead
_SEEN = 0.6  # of the cells of the picture
_OVERFIT = 1.15  # held out against fitted
_NO_FIT_PX = 2.0  # rms that no lens in focus leaves: the views do not belong together
_BENT = 0.01  # of the target's longer side: paper that nobody glued onto anything


def verdict(
    report: dict[str, Any], held_out: float | None, covered: float, index: int = 0, bend: float = 0.0
) -> dict[str, Any]:
    """Of camera `index` of a Calibration.report. held_out: pixels rms, where known; covered: radians, how far off the
    axis the target was seen; bend: of the target, as a share of its size.

    usable: for any pipe; dn_from, dn_to: millimetres, of the nominal diameters of `pipes` that hold; systematic_mm:
    largest of these (95 %); chosen: the model was, by held-out views; pipes: one entry a diameter;
    reasons, cautions: sentences."""
    camera = report["cameras"][index]
    halves = camera.get("halves", {}).get("ratio")
    pipes = []
    for pipe in camera["pipes"]:
        bound = Z95 * pipe["sigma_mm"]
        if math.isfinite(pipe.get("spread_mm", math.nan)):
            bound = max(bound, _STUDENT * pipe["spread_mm"])
        else:  # too few views for parts, or parts that saw too little: what the halves tell
            bound *= max(1.0, halves or 1.0)
        bound = math.hypot(bound, _UNSEEN * pipe["dn_mm"])
        known = math.isfinite(bound)
        pipes.append(
            {
                "dn_mm": pipe["dn_mm"],
                "systematic_mm": bound if known else None,
                "share": bound / pipe["dn_mm"] if known else None,
                "usable": known and bound <= SHARE * pipe["dn_mm"],
            }
        )
    fits = report["rms_px"] <= _NO_FIT_PX
    good = [p for p in pipes if p["usable"] and fits]
    out: dict[str, Any] = {
        "usable": bool(good),
        "fits": fits,
        "dn_from": good[0]["dn_mm"] if good else None,
        "dn_to": good[-1]["dn_mm"] if good else None,
        "systematic_mm": max(p["systematic_mm"] for p in good) if good else None,
        "allowed_share": SHARE,
        "pipes": pipes,
    }
    out["chosen"] = bool(report["models"])
    out["text"] = _text(out)
    out["reasons"], out["cautions"] = (
        _reasons(report, camera, held_out, halves),
        _cautions(report, camera, held_out, halves, covered, out, bend),
    )
    return out


def _text(out: dict[str, Any]) -> str:
    if not out["fits"]:
        return (
            "Not usable: the best lens leaves more than two pixels. Are all pictures of one camera, with one "
            "focus, and "
            "is the target the one that --target describes?"
        )
    if not out["usable"]:
        known = [p for p in out["pipes"] if p["systematic_mm"] is not None]
        if not known:
            return "Not usable: the wall of no pipe falls where this camera was calibrated."
        best = min(known, key=lambda p: p["share"])
        return (
            f"Not usable to measure diameters: off by up to {best['systematic_mm']:.2g} mm at DN {best['dn_mm']}, and "
            f"{100 * SHARE:g} % ({SHARE * best['dn_mm']:.2g} mm) are allowed."
        )
    pipes = f"DN {out['dn_from']}" + (f" to {out['dn_to']}" if out["dn_to"] != out["dn_from"] else "")
    low = min(p["systematic_mm"] for p in out["pipes"] if p["usable"])
    high = out["systematic_mm"]
    range_ = f"{low:.2g} to {high:.2g}" if f"{low:.2g}" != f"{high:.2g}" else f"{high:.2g}"
    what = "calibration puts" if out["chosen"] else "pictures' noise alone puts"
    return f"Usable for {pipes}: the {what} the mean diameter off by at most {range_} mm (95 %)."


def _reasons(report: dict[str, Any], camera: dict[str, Any], held_out: float | None, halves: float | None) -> list[str]:
    """What speaks for it."""
    used = [v for v in report["views"] if v["used"] and v["camera"] == camera["camera"]]
    points = sum(v["points"] for v in used)
    out = [f"{points} points of {len(used)} views fit within {report['rms_px']:.3f} px rms"]
    if held_out is not None and held_out <= _OVERFIT * report["rms_px"]:
        out.append(f"views that it was not made from fit as well: {held_out:.3f} px rms")
    if halves is not None and halves <= 1.5:
        out.append("two halves of the views give the same camera, within what the noise explains")
    return out


def _cautions(
    report: dict[str, Any],
    camera: dict[str, Any],
    held_out: float | None,
    halves: float | None,
    covered: float,
    out: dict[str, Any],
    bend: float,
) -> list[str]:
    """What one should know before using it, and what to do about it."""
    said = []
    if not out["chosen"]:
        said.append(
            f"the model {report['model']} was given, not chosen by views held out: what it cannot fit of this "
            "lens is in no bound; --model auto compares"
        )
    coverage = camera["coverage"]
    if held_out is None:
        said.append("no views could be held out to check it: take at least 6 views, better 20")
    elif held_out > _OVERFIT * report["rms_px"]:
        said.append(f"views that it was not made from fit worse, {held_out:.3f} px rms: take more views")
    if halves is not None and halves > 1.5:
        two = camera["halves"]
        spreads = [pipe.get("spread_mm", math.nan) for pipe in camera["pipes"]]
        bounded = ", and is in the bounds above" if all(map(math.isfinite, spreads)) else ""
        said.append(
            f"calibrated from either half of the views the camera differs by {two['rms_px']:.2g} px, of which noise "
            f"explains {two['expected_px']:.2g} px; the rest is in lens, target or focus{bounded}"
        )
    if covered < _NARROW:
        said.append(
            f"the target was seen up to {math.degrees(covered):.0f} degrees off the axis only: walls are measured far "
            "ahead, with a long lever; show the target at the rim too"
        )
    if coverage["share_covered"] < _SEEN:
        said.append(
            f"only {100 * coverage['share_covered']:.0f} % of the picture ever saw the target; {coverage['advice']}"
        )
    distance = camera["uncertainty"]["distance_m"]
    if out["usable"] and distance > 4 * out["dn_from"] / 2000:
        said.append(
            f"the target stood {distance:.2g} m away, walls of DN {out['dn_from']} are at "
            f"{out['dn_from'] / 2000:.2g} m: "
            "take some views as near as the walls will be"
        )
    if bend > _BENT:
        said.append(
            f"the target bends by {100 * bend:.1f} % of its size: glue it onto something flat; if it is flat, it is "
            f"not "
            "the one that --target describes, or the pictures are of two cameras"
        )
    lost = [v for v in report["views"] if not v["used"]]
    if lost:
        said.append(f"{len(lost)} of {len(report['views'])} views were rejected; see below")
    return said
