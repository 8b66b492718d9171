"""What `pipefish reconstruct` measured, in words and against limits: for the report, the terminal and scripts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.errors import FormatError

FORMAT, VERSION = "pipefish-reconstruction", 1
Z95 = 1.96

# Limits that can be asked for: column, whether the value must stay at most or at least, factor to people's unit, unit.
LIMITS = {
    "ovality": ("ovality", "most", 100.0, "%"),
    "ovality_nominal": ("ovality_nominal", "most", 100.0, "%"),
    "ovality_astm": ("ovality_astm", "most", 100.0, "%"),
    "reduction_nominal": ("reduction_nominal", "most", 100.0, "%"),
    "d_max": ("d_max", "most", 1000.0, "mm"),
    "d_min": ("d_min", "least", 1000.0, "mm"),
}


# ---- texts


def length_text(value: float, unit: str, metres: bool = False) -> str:
    """A length for people."""
    if unit != "metre":
        return f"{value:.3f} diameters"
    return f"{value:.2f} m" if metres else f"{1000 * value:.1f} mm"


def percent_text(value: float) -> str:
    """A share for people."""
    return f"{100 * value:.2f} %"


def clock_text(angle: float) -> str:
    """A clock position, hours and minutes."""
    minutes = round(angle * 360 / math.pi) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}"


def size_parts(e: dict[str, Any], unit: str) -> Iterable[str]:
    if e["kind"] == "not_measured":
        if e["start"] is not None and e["end"] is not None:
            yield f"to {length_text(e['end'], unit, metres=True)}"
        yield e["detail"]
        return
    if e["kind"] == "bend":
        yield f"{math.degrees(e['angle']):.1f} ± {math.degrees(Z95 * e['angle_sigma']):.2f}°"
        if e.get("radius"):
            number, word = length_text(e["radius"], unit, metres=True).split()
            yield f"radius {number} ± {length_text(Z95 * e['radius_sigma'], unit, metres=True).split()[0]} {word}"
        yield f"from {length_text(e['start'], unit, metres=True)} to {length_text(e['end'], unit, metres=True)}"
        return
    for name in ("gap", "step", "height", "length", "width"):
        if e.get(name) is not None:
            sigma = e.get("size_sigma" if name in ("length", "width") else f"{name}_sigma")
            text = length_text(e[name], unit)
            if sigma is not None:
                text = text.replace(" ", f" ± {length_text(Z95 * sigma, unit).split()[0]} ", 1)
            yield f"{name} {text}"
    if e["kind"] == "joint" and e.get("angle") is not None:
        yield f"angle {math.degrees(e['angle']):.2f} ± {math.degrees(Z95 * e['angle_sigma']):.2f}°"


def events_text(e: dict[str, Any], unit: str) -> str:
    """One line about an event, without its kind."""
    at = f"at {length_text(e['chainage'], unit, metres=True)}" if e["chainage"] is not None else "place unknown"
    clock = f"{clock_text(e['clock'])} o'clock" if e.get("clock") is not None else ""
    return ", ".join(p for p in (at, clock, *size_parts(e, unit)) if p)


def scale_texts(scale: dict[str, Any]) -> list[str]:
    """A line for each source that tells the scale, where there are several."""
    if len(scale["sources"]) < 2:
        return []
    out = []
    for row in scale["sources"]:
        word = "agrees" if row["consistent"] else f"DISAGREES by {abs(row['deviation']):.1f} sigma"
        role = "used" if row["used"] else "a check"
        size = f"{100 * row['relative']:+.2f} ± {100 * Z95 * row['sigma']:.2f} %"
        out.append(f"{row['name']}: {size}, {role}, {word} ({row['detail']})")
    return out


# ---- reading


def read_measured(folder: Path) -> dict[str, Any]:
    """reconstruction.json of a folder. Raises FormatError, OSError."""
    path = folder / "reconstruction.json"
    try:
        document = json.loads(path.read_bytes())
    except (ValueError, UnicodeDecodeError) as error:
        raise FormatError(path, None, f"not JSON: {error}") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise FormatError(path, "format", f"not '{FORMAT}': is this a folder of `pipefish reconstruct`?")
    if document.get("version") != VERSION:
        raise FormatError(path, "version", f"{document.get('version')}; this program reads {VERSION}")
    return document


def column(document: dict[str, Any], name: str) -> np.ndarray:
    """A column of the stations, (N,) with NaN where not measured."""
    return np.array([np.nan if v is None else v for v in document["stations"][name]], float)


# ---- limits


def verdict(document: dict[str, Any], name: str, bound: float) -> dict[str, Any]:
    """Whether a limit holds at every station with ovality, with 95 % intervals of repeatability and systematic error
    together: "passed", "passed where measured", "failed", "undecided" (the interval holds it), "not measured"."""
    quantity, side, factor, unit = LIMITS[name]
    scale = document["summary"]
    if unit == "mm" and scale["unit"] != "metre":
        return _verdict(name, bound, unit, "not measured", "there is no scale")
    value = factor * column(document, quantity)
    sigma = factor * column(document, f"{quantity}_sigma")
    camera = column(document, "ovality_systematic")  # of (max - min) / mean
    if quantity.startswith("ovality"):
        over_nominal = column(document, "d_mean") / (scale["nominal"] or math.nan)
        share = {"ovality": 1.0, "ovality_nominal": over_nominal, "ovality_astm": 0.5}[quantity]
        sigma = np.hypot(sigma, factor * share * camera)
    elif quantity in ("d_max", "d_min"):
        sigma = np.hypot(sigma, factor * column(document, f"{quantity}_systematic"))
    elif quantity == "reduction_nominal":
        sigma = np.sqrt(sigma**2 + (factor * scale["systematic"]["relative"]) ** 2 + (0.5 * factor * camera) ** 2)
    if not np.isfinite(value).any():
        return _verdict(name, bound, unit, "not measured", "no station has it")
    excess = (value - bound) * (1 if side == "most" else -1)
    worst = int(np.nanargmax(excess))
    at = length_text(column(document, "chainage")[worst], scale["unit"], metres=True)
    shown = f"{value[worst]:.2f} ± {Z95 * sigma[worst]:.2f} {unit} at {at}"
    outside, inside = excess - Z95 * sigma > 0, excess + Z95 * sigma <= 0
    known = np.isfinite(value)
    missing = len(value) - int(known.sum())
    state = "failed" if outside[known].any() else "passed" if inside[known].all() else "undecided"
    if state == "passed" and missing:
        state = "passed where measured"
    more = f"; {missing} of {len(value)} stations have no value" if missing else ""
    return _verdict(name, bound, unit, state, shown + more)


def _verdict(name: str, bound: float, unit: str, state: str, shown: str) -> dict[str, Any]:
    word = "at most" if LIMITS[name][1] == "most" else "at least"
    text = f"{state}: {word} {bound:g} {unit}; worst {shown}" if state != "not measured" else f"not measured: {shown}"
    return {"name": name, "bound": bound, "unit": unit, "state": state, "worst": shown, "text": text}
