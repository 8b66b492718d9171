"""The JSON form of a camera profile, as docs/profile.md describes it: text to the values of a Camera and back.

Every error is a ProfileError that names the key.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import math
import numbers
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import ProfileError

if TYPE_CHECKING:
    from .camera import Camera

_FORMAT = "pipefish-profile"
_VERSION = 2  # of the files that are written; version 1 is read too
_BYTES_MAX = 1 << 20  # a full profile is about 25 kB of JSON

INTEGERS = ("width", "height")
SCALARS = ("f_u", "f_v", "skew", "c_u", "c_v", "k2", "k3", "k4", "k5", "mirror", "pupil_e1", "theta_max")
CIRCLE = ("circle_u", "circle_v", "circle_radius")
ARRAYS = {
    "tilt": 2,
    "asym_radial_theta": 3,
    "asym_radial_phi": 4,
    "asym_tangential_theta": 3,
    "asym_tangential_phi": 4,
    "cpoly": 14,
}
TEXTS = ("name", "serial", "lens")
RESIDUALS = ("rms_px", "held_out_rms_px")
#: Keys of `provenance`, and what the binary form calls them.
PROVENANCE = {
    "tool": "tool",
    "version": "tool_version",
    "model_choice": "model_choice",
    "views": "views",
    "points": "points",
    "held_out_views": "held_out_views",
}
#: Every file says what its numbers are in; there are no other units.
UNITS = {
    "image": "pixel",
    "pixel_origin": "centre of the top-left pixel",
    "angle": "radian",
    "length": "metre",
}
_REQUIRED = ("width", "height", "f_u", "f_v", "c_u", "c_v", "k2", "k3", "k4", "k5", "theta_max")
_KNOWN_1 = {"source", "created", "rms_px", "theta_covered", "radial", "covariance", "name", "serial"}.union(
    INTEGERS, SCALARS, CIRCLE, ARRAYS
)
_KNOWN = {1: _KNOWN_1, 2: _KNOWN_1 | {"lens", "held_out_rms_px", "provenance", "units"}}


def number(key: str, value: object) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise ProfileError(None, key, f"not a number: {value!r:.60}")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise ProfileError(None, key, "not finite")
    return result


def integer(key: str, value: object) -> int:
    """A whole number that fits 32 bits."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise ProfileError(None, key, f"not a whole number: {value!r:.60}")
    if not 0 <= value < 1 << 32:
        raise ProfileError(None, key, "out of range")
    return int(value)


def number_list(key: str, value: object, count: int) -> tuple[float, ...]:
    """A list of `count` finite numbers."""
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str | bytes) or len(value) != count:
        raise ProfileError(None, key, f"not a list of {count} numbers")
    return tuple(number(f"{key}[{i}]", item) for i, item in enumerate(value))


def text(key: str, value: object) -> str:
    """A text that UTF-8 can write."""
    if not isinstance(value, str):
        raise ProfileError(None, key, "not a text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise ProfileError(None, key, "not UTF-8 text") from None
    return value


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The arguments of Camera out of a file. What they are worth is for Camera to check."""
    return values_of(_parse(path))


def values_of(document: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of Camera out of a document."""
    if document.get("format") != _FORMAT:
        raise ProfileError(None, "format", f"not {_FORMAT!r}: this is not a profile")
    version = document.get("version")
    if isinstance(version, bool) or version not in (1, _VERSION):
        raise ProfileError(None, "version", f"this version reads 1 and {_VERSION}")
    values = {key: value for key, value in document.items() if key not in ("format", "version")}
    for key in values:
        if key not in _KNOWN[int(version)]:
            raise ProfileError(None, key, f"no such key in a profile of version {int(version)}")
    for key in (*_REQUIRED, *(["units"] if version == _VERSION else [])):
        if key not in values:
            raise ProfileError(None, key, "missing")
    if values.get("created") is not None:
        values["created"] = _parse_time(values["created"])
    if values.pop("units", UNITS) != UNITS:
        raise ProfileError(None, "units", f"not {json.dumps(UNITS)}")
    if "provenance" in values:
        values["provenance"] = _parse_provenance(values["provenance"])
    if values.get("covariance") is not None:
        values |= _parse_covariance(values["covariance"])
    for term in ("asym_radial", "asym_tangential"):
        _fix_gauge(values, f"{term}_theta", f"{term}_phi")
    return values


def write(camera: Camera) -> str:
    """The text that `read` reads."""
    document: dict[str, Any] = {"format": _FORMAT, "version": _VERSION}
    for key in (*TEXTS, "source"):
        document[key] = getattr(camera, key)
    document["created"] = None if camera.created is None else camera.created.strftime("%Y-%m-%dT%H:%M:%SZ")
    document["provenance"] = {key: getattr(camera.provenance, key) for key in PROVENANCE}
    document["units"] = UNITS
    for key in (*RESIDUALS, "theta_covered", *INTEGERS, "radial", *SCALARS, *CIRCLE, *ARRAYS):
        document[key] = getattr(camera, key)
    document["covariance"] = None
    lines = [f"  {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}" for key, value in document.items()]
    if camera.covariance is not None:
        rows = [json.dumps(row[: i + 1]) for i, row in enumerate(camera.covariance.tolist())]
        names = json.dumps(camera.covariance_parameters)
        lower = ",\n      ".join(rows)
        lines[-1] = f'  "covariance": {{\n    "parameters": {names},\n    "lower": [\n      {lower}\n    ]\n  }}'
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _parse(path: str | os.PathLike[str]) -> Mapping[str, Any]:
    def without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key, value in pairs:
            if key in result:
                raise ProfileError(None, key, "appears twice")
            result[key] = value
        return result

    try:
        with open(path, "rb") as file:
            data = file.read(_BYTES_MAX + 1)
    except OSError as error:
        raise ProfileError(None, None, error.strerror or str(error)) from None
    if len(data) > _BYTES_MAX:
        raise ProfileError(None, None, f"longer than {_BYTES_MAX} bytes: this is not a profile")
    try:
        document = json.loads(data.decode("utf-8"), object_pairs_hook=without_twins)
    except UnicodeDecodeError as error:
        raise ProfileError(None, f"byte {error.start}", "not UTF-8 text: this is not a profile in JSON") from None
    except json.JSONDecodeError as error:
        raise ProfileError(None, f"line {error.lineno} column {error.colno}", error.msg) from None
    except (RecursionError, ValueError) as error:
        raise ProfileError(None, None, f"not a profile in JSON: {error}") from None
    if not isinstance(document, dict):
        raise ProfileError(None, None, "not a JSON object: this is not a profile")
    return document


def _parse_time(value: object) -> datetime.datetime:
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            return datetime.datetime.strptime(value, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=datetime.UTC)
    raise ProfileError(None, "created", f"not a time like 2026-01-31T12:00:00Z: {value!r:.60}")


def _parse_covariance(value: object) -> dict[str, Any]:
    if not isinstance(value, dict) or set(value) != {"parameters", "lower"}:
        raise ProfileError(None, "covariance", "not an object of 'parameters' and 'lower'")
    names, lower = value["parameters"], value["lower"]
    if not isinstance(names, list) or not isinstance(lower, list) or not names or len(lower) != len(names):
        raise ProfileError(None, "covariance", "'parameters' and 'lower' are not lists of one length")
    matrix = np.zeros((len(names), len(names)))
    for i, row in enumerate(lower):
        matrix[i, : i + 1] = matrix[: i + 1, i] = number_list(f"covariance.lower[{i}]", row, i + 1)
    return {"covariance_parameters": names, "covariance": matrix}


def _parse_provenance(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ProfileError(None, "provenance", "not an object")
    for key in value:
        if key not in PROVENANCE:
            raise ProfileError(None, f"provenance.{key}", "no such key in a profile")
    return value


def _fix_gauge(values: dict[str, Any], theta: str, phi: str) -> None:
    """Moves the scale of an asymmetric term's Fourier vector into its polynomial: b of unit norm, the same product.

    The covariance goes with it: a' = |b| a, b' = b / |b|."""
    if phi not in values or theta not in values:
        return
    a, b = np.array(number_list(theta, values[theta], 3)), np.array(number_list(phi, values[phi], 4))
    norm = float(np.linalg.norm(b))
    if norm == 0 or abs(norm - 1) <= 1e-15:  # what was made unit stays as it is, bit for bit
        return
    values[theta], values[phi] = (norm * a).tolist(), (b / norm).tolist()
    names = list(values.get("covariance_parameters", ()))
    jacobian = np.eye(len(names))
    a_at = [(names.index(n), i) for i in range(3) if (n := f"{theta}[{i}]") in names]
    b_at = [(names.index(n), i) for i in range(4) if (n := f"{phi}[{i}]") in names]
    if b_at and len(a_at) < 3:
        raise ProfileError(None, "covariance", f"of {phi}, whose norm is not 1, without all of {theta}")
    for row, i in a_at:
        jacobian[row, row] = norm
        for column, j in b_at:
            jacobian[row, column] = a[i] * b[j] / norm
    for row, i in b_at:
        for column, j in b_at:
            jacobian[row, column] = (i == j) / norm - b[i] * b[j] / norm**3
    if names:
        covariance = jacobian @ values["covariance"] @ jacobian.T
        values["covariance"] = (covariance + covariance.T) / 2
