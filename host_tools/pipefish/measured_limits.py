"""What `pipefish reconstruct` measured, against limits that must hold all along the pipe."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from pipefish.errors import ArgumentError
from pipefish.intervals import Z95
from pipefish.measured_texts import OVALITIES, column, length_text

#: A bound further off the pipe's diameter than by this factor was meant in another unit: metres, centimetres, inches.
DIAMETER_OFF = 5.0


class LimitError(ArgumentError):
    """A limit that nobody can have meant."""


class Limit(NamedTuple):
    """What can be limited: column of the stations, what it is in words, whether it must stay at most or at least there,
    factor to people's unit, unit."""

    column: str
    words: str
    side: str
    factor: float
    unit: str


LIMITS = {
    **{
        name: Limit(name, f"{name.split('_', 1)[0]}, {words}", "at most", 100.0, "%")
        for name, words in OVALITIES.items()
    },
    "d_max": Limit("d_max", "widest caliper width", "at most", 1000.0, "mm"),
    "d_min": Limit("d_min", "narrowest caliper width", "at least", 1000.0, "mm"),
}


def check_limits(limits: Iterable[tuple[str, float]], diameter: float | None = None) -> None:
    """Raises LimitError for a name that is none and for a bound that cannot be meant. diameter: the pipe's, metres."""
    for name, bound in limits:
        if name not in LIMITS:
            raise LimitError(f"{name}: not one of {', '.join(LIMITS)}")
        shown, unit = f"{name}={bound:g}", LIMITS[name].unit
        if unit == "%" and not 0 <= bound < 100:
            raise LimitError(f"{shown}: is in per cent, from 0 to below 100")
        if unit == "mm" and not (math.isfinite(bound) and bound > 0):
            raise LimitError(f"{shown}: is a width in millimetres, above 0")
        if unit == "mm" and diameter and not 1 / DIAMETER_OFF < bound / (1000 * diameter) < DIAMETER_OFF:
            raise LimitError(f"{shown}: is in millimetres, and the pipe is {1000 * diameter:.0f} mm wide")


def all_hold(verdicts: Iterable[dict[str, Any]]) -> bool:
    """Whether each limit was shown to hold all along the pipe: what an exit code of 0 says."""
    return all(v["state"] == "passed" for v in verdicts)


def whole_sigma(document: dict[str, Any], quantity: str) -> np.ndarray:
    """Of a column of the stations: repeatability and systematic error together."""
    scale = document["summary"]
    sigma = column(document, f"{quantity}_sigma")
    camera = column(document, "ovality_systematic")  # of (max - min) / mean
    if quantity.startswith("ovality"):
        over_nominal = column(document, "d_mean") / (scale["nominal"] or math.nan)
        share = {"ovality": 1.0, "ovality_nominal": over_nominal}.get(quantity, 0.5)
        return np.hypot(sigma, share * camera)
    if quantity in ("d_max", "d_min"):
        return np.hypot(sigma, column(document, f"{quantity}_systematic"))
    if quantity == "reduction_nominal":
        return np.hypot(sigma, column(document, "d_min_systematic") / (scale["nominal"] or math.nan))
    return sigma


def most_oval(document: dict[str, Any]) -> float:
    """Half width of the 95 % interval of the largest ovality."""
    return Z95 * float(whole_sigma(document, "ovality")[int(np.nanargmax(column(document, "ovality")))])


def verdict(document: dict[str, Any], name: str, bound: float) -> dict[str, Any]:
    """Whether a limit holds at every station with ovality, with 95 % intervals of repeatability and systematic error
    together: "passed", "passed where measured", "failed", "undecided" (the interval holds it), "not measured"."""
    limit = LIMITS[name]
    quantity, factor, unit = limit.column, limit.factor, limit.unit
    scale = document["summary"]
    if unit == "mm" and scale["unit"] != "metre":
        return _verdict(name, bound, unit, "not measured", "there is no scale")
    value = factor * column(document, quantity)
    sigma = factor * whole_sigma(document, quantity)
    if not np.isfinite(value).any():
        wanting = limit.column.endswith("nominal") and not scale["nominal"]
        why = "no nominal diameter was given (--nominal of reconstruct)" if wanting else "no station has it"
        return _verdict(name, bound, unit, "not measured", why)
    excess = (value - bound) * (1 if limit.side == "at most" else -1)
    outside, inside = excess - Z95 * sigma > 0, excess + Z95 * sigma <= 0
    known = np.isfinite(value)
    reach = np.where(
        np.isfinite(sigma), Z95 * sigma, 0.0
    )  # the station that decides, surely outside or not surely inside
    worst = int(np.nanargmax(excess - reach if outside[known].any() else excess + reach))
    at = length_text(column(document, "chainage")[worst], scale["unit"], metres=True)
    shown = f"{value[worst]:.2f} ± {Z95 * sigma[worst]:.2f} {unit} at {at}"
    missing = len(value) - int(known.sum())
    state = "failed" if outside[known].any() else "passed" if inside[known].all() else "undecided"
    left_out = sum(_has_length(stretch) for stretch in document.get("not_measured", []))
    if state == "passed" and (missing or left_out):
        state = "passed where measured"
    more = f"; {missing} of {len(value)} stations have no value" if missing else ""
    if left_out:
        more += f"; {left_out} {'stretch' if left_out == 1 else 'stretches'} not measured"
    return _verdict(name, bound, unit, state, shown + more)


def _has_length(stretch: dict[str, Any]) -> bool:
    """Of what was not measured: whether there is wall that was not seen."""
    start, end = stretch["start"], stretch["end"]
    return start is None or end is None or end > start


def _verdict(name: str, bound: float, unit: str, state: str, shown: str) -> dict[str, Any]:
    what = f"{LIMITS[name].side} {bound:g} {unit}"
    text = f"{state}: {what}; worst {shown}" if state != "not measured" else f"not measured: {shown}"
    return {"name": name, "bound": bound, "unit": unit, "state": state, "worst": shown, "text": text}
