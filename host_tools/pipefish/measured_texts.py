"""What `pipefish reconstruct` measured, in words: for the report, the terminal and scripts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.errors import FormatError
from pipefish.intervals import Z95

FORMAT, VERSION = "pipefish-reconstruction", 1
MOST_DIGITS = 5  # of a length

#: What an ovality of the tables is of, in words.
OVALITIES = {
    "ovality": "(max - min) / mean",
    "ovality_nominal": "(max - min) / nominal",
    "ovality_astm": "ASTM F1216: (mean - min) / mean",
    "ovality_astm_max": "ASTM F1216: (max - mean) / mean",
    "reduction_nominal": "EN 13508-2 BAA: (nominal - min) / nominal",
}


# ---- texts


def _form(unit: str, metres: bool) -> tuple[float, int, str]:
    """How a length is shown: by which factor, digits, unit."""
    if unit != "metre":
        return 1.0, 3, "diameters"
    return (1.0, 2, "m") if metres else (1000.0, 1, "mm")


def length_text(value: float, unit: str, metres: bool = False) -> str:
    """A length for people."""
    factor, digits, word = _form(unit, metres)
    return f"{factor * value:.{digits}f} {word}"


def interval_text(value: float, sigma: float | None, unit: str, metres: bool = False) -> str:
    """A length with its 95 % interval, if that is known, and with more digits where else it would be told as 0."""
    if sigma is None:
        return length_text(value, unit, metres)
    factor, digits, word = _form(unit, metres)
    half = factor * Z95 * sigma
    while 0 < half < 0.5 * 10**-digits and digits < MOST_DIGITS:
        digits += 1
    return f"{factor * value:.{digits}f} ± {half:.{digits}f} {word}"


def percent_text(value: float) -> str:
    """A share for people."""
    return f"{100 * value:.2f} %"


def clock_text(angle: float) -> str:
    """A clock position, hours and minutes."""
    minutes = round(angle * 360 / math.pi) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}"


def size_parts(e: dict[str, Any], unit: str) -> Iterable[str]:
    """How large an event of a tube is, in words, with 95 % intervals."""
    if e["kind"] == "not_measured":
        if e["start"] is not None and e["end"] is not None:
            yield f"to {length_text(e['end'], unit, metres=True)}"
        yield e["detail"]
        return
    if e["kind"] == "bend":
        yield f"{math.degrees(e['angle']):.1f} ± {math.degrees(Z95 * e['angle_sigma']):.2f}°"
        if e.get("radius"):
            yield f"radius {interval_text(e['radius'], e['radius_sigma'], unit, metres=True)}"
        yield f"from {length_text(e['start'], unit, metres=True)} to {length_text(e['end'], unit, metres=True)}"
        return
    for name in ("gap", "step", "height", "length", "width"):
        if e.get(name) is not None:
            sigma = e.get("size_sigma" if name in ("length", "width") else f"{name}_sigma")
            yield f"{name} {interval_text(e[name], sigma, unit)}"
    if e["kind"] == "joint" and e.get("angle") is not None:
        yield f"angle {math.degrees(e['angle']):.2f} ± {math.degrees(Z95 * e['angle_sigma']):.2f}°"


def place_text(e: dict[str, Any], unit: str) -> str:
    """Where along the pipe an event is, with its 95 % interval."""
    if e["chainage"] is None:
        return "unknown"
    return interval_text(e["chainage"], e.get("s_sigma"), unit, metres=True)


def event_text(e: dict[str, Any], unit: str, sizes: Iterable[str] | None = None) -> str:
    """One line about an event, without its kind. sizes: how large it is [as an event of a tube]."""
    at = f"at {place_text(e, unit)}" if e["chainage"] is not None else "place unknown"
    clock = f"{clock_text(e['clock'])} o'clock" if e.get("clock") is not None else ""
    return ", ".join(p for p in (at, clock, *(size_parts(e, unit) if sizes is None else sizes)) if p)


def scale_texts(scale: dict[str, Any]) -> list[str]:
    """A line for each source that tells the scale, where there are several."""
    if len(scale["sources"]) < 2:
        return []
    out = []
    for row in scale["sources"]:
        word = "agrees"
        if not row["consistent"]:
            word = f"DISAGREES by {abs(row['deviation']) / Z95:.1f} times the 95 % interval"
        role = "used" if row["used"] else "a check"
        size = f"{100 * row['relative']:+.2f} ± {100 * Z95 * row['sigma']:.2f} %"
        out.append(f"{row['name']}: {size}, {role}, {word} ({row['detail']})")
    return out


# ---- reading


def read_document(path: Path, form: str, command: str) -> dict[str, Any]:
    """A JSON document of this format, as this command writes it. Raises FormatError, OSError."""
    try:
        document = json.loads(path.read_bytes())
    except (ValueError, UnicodeDecodeError) as error:
        raise FormatError(path, None, f"not JSON: {error}") from error
    if not isinstance(document, dict) or document.get("format") != form:
        raise FormatError(path, "format", f"not '{form}': is this a folder of `{command}`?")
    return document


def read_measured(folder: Path) -> dict[str, Any]:
    """reconstruction.json of a folder. Raises FormatError, OSError."""
    path = folder / "reconstruction.json"
    if folder.is_file():
        raise FormatError(folder, None, "a file; `pipefish reconstruct SURVEY -o DIR` makes the folder that is wanted")
    if folder.is_dir() and not path.exists():
        raise FormatError(folder, None, "no reconstruction.json here: `pipefish reconstruct SURVEY -o DIR` writes it")
    document = read_document(path, FORMAT, "pipefish reconstruct")
    if document.get("version") != VERSION:
        raise FormatError(path, "version", f"{document.get('version')}; this program reads {VERSION}")
    return document


def column(document: dict[str, Any], name: str) -> np.ndarray:
    """A column of the stations, (N,) with NaN where not measured."""
    return np.array([np.nan if v is None else v for v in document["stations"][name]], float)
