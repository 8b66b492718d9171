"""Calibration files of other programs: read, recognised by what they hold, converted with the error told.

docs/formats.md is the list: models, pixel origins, axis orders, sources.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..camera import Camera
from ..errors import ArgumentError, PipefishError, ProfileError
from ..files import write_atomically
from ..fit import MODELS, Fit
from ..lenses import KannalaBrandt, Lens, Unified
from . import readers, texts
from .convert import MAX_ERROR, camera_of, lens_field
from .parse import BYTES_MAX, Found, decode, parse_json, parse_xml, parse_yaml
from .writers import WRITERS, Wanted, Written

__all__ = ["MAX_ERROR", "READERS", "WRITERS", "Conversion", "Wanted", "Written", "from_lens", "load", "write"]

_MAPPINGS: dict[str, Callable[[Any, Any], list[Found]]] = {
    "opencv-fisheye": readers.read_opencv_fisheye,
    "opencv": readers.read_opencv,
    "opencv-omnidir": readers.read_opencv_omnidir,
    "opencv-any": readers.read_opencv_any,
    "ros": readers.read_ros,
    "kalibr": readers.read_kalibr,
    "basalt": readers.read_basalt,
    "orbslam3": readers.read_orbslam3,
    "stella": readers.read_stella,
    "svo": readers.read_svo,
    "adapter": readers.read_adapter,
    "boofcv": readers.read_boofcv,
    "woodscape": readers.read_woodscape,
    "pyocamcalib": readers.read_pyocamcalib,
}
_TEXTS: dict[str, Callable[[str, Any], list[Found]]] = {
    "colmap": texts.read_colmap,
    "ocam": texts.read_ocam,
    "toolbox": texts.read_toolbox,
    "mrcal": texts.read_mrcal,
}
#: Names for load(form=...) and `--from`.
READERS = ("json", "binary", *(name for name in _MAPPINGS if name != "opencv-any"), *_TEXTS)


@dataclasses.dataclass(frozen=True)
class Conversion:
    """A camera out of a file. form: what the file is; cameras: the names of all cameras in it; camera_name: the one
    taken; fit: how well the Camera stands for the file's model (None for Pipefish's own profiles); notes."""

    camera: Camera
    form: str
    cameras: tuple[str, ...]
    camera_name: str
    fit: Fit | None
    notes: tuple[str, ...]


def _guess_mapping(document: Any) -> str | None:
    """The form of a YAML or JSON document."""
    if not isinstance(document, dict):
        return None
    keys = {str(key) for key in document}
    value0 = document.get("value0")
    tests = (
        ("json", document.get("format") == "pipefish-profile"),
        ("basalt", isinstance(value0, dict) and "intrinsics" in value0),
        ("kalibr", any(re.fullmatch(r"cam\d+", key) for key in keys)),
        ("boofcv", {"pinhole", "model"} <= keys),
        ("svo", isinstance(document.get("cameras"), list)),
        ("adapter", {"image", "parameter"} <= keys),
        ("orbslam3", bool({"Camera.fx", "Camera1.fx"} & keys)),
        ("stella", isinstance(document.get("Camera"), dict)),
        ("woodscape", isinstance(document.get("intrinsic"), dict)),
        ("pyocamcalib", "taylor_coefficient" in keys),
        ("ros", str(document.get("distortion_model")) in readers.ROS_MODELS),
        ("opencv-any", bool({"camera_matrix", "K", "cameraMatrix", "intrinsic_matrix"} & keys)),
    )
    return next((form for form, fits in tests if fits), None)


def _guess_text(text: str) -> str | None:
    head = text[:4096].lstrip()
    if re.search(r"['\"]lens_?model['\"][ \t]*:[ \t]*['\"]LENSMODEL_", text):
        return "mrcal"
    if head.startswith("#polynomial coefficients"):
        return "ocam"
    if re.search(r"^[ \t]*para1[ \t]*=", text, re.MULTILINE):
        return "toolbox"
    if re.search(r"^[ \t]*\d+ [A-Z][A-Z_]+ \d+ \d+ [-+.\d]", text, re.MULTILINE):
        return "colmap"
    return None


def _read(data: bytes, form: str | None, size: tuple[int, int] | None) -> tuple[str, list[Found]]:
    text = decode(data)
    form = form or _guess_text(text)
    if form in _TEXTS:
        return form, _TEXTS[form](text, size)
    parse = parse_json if _like_json(data) else parse_xml if text.lstrip().startswith("<") else parse_yaml
    document = parse(text)
    form = form or _guess_mapping(document)
    if form is None or form == "json":
        raise ProfileError(None, None, "not a camera calibration in a format that is known (docs/formats.md)")
    found = _MAPPINGS[form](document, size)
    if form == "opencv-any":
        kinds = {KannalaBrandt: "opencv-fisheye", Unified: "opencv-omnidir"}
        form = kinds.get(type(found[0].lens), "opencv")
    return form, found


def _choose(names: list[str], camera: int | str) -> int:
    """The place of a camera that is given by its name or its place."""
    numbers = [str(i) for i in range(len(names))]
    for known in (names if isinstance(camera, str) else [], numbers):
        if str(camera) in known:
            return known.index(str(camera))
    raise ProfileError(None, None, f"no camera {camera!r:.40}; there are {', '.join(names)} (or 0 to {len(names) - 1})")


def load(
    path: str | os.PathLike[str],
    *,
    camera: int | str | None = None,
    size: tuple[int, int] | None = None,
    form: str | None = None,
    max_error: float = MAX_ERROR,
    max_theta: float | None = None,
    model: str = "auto",
) -> Conversion:
    """Reads a profile or another program's calibration file.

    camera: name or number of the camera in a file of several [the first, with a note]; size: width and height, for
    formats that do not hold it, and refused where the file says another one; form: one of READERS [told by the
    content]; max_error: largest allowed difference of a fit, pixels; max_theta: take no more of the field than this,
    radians, above zero; model: of the fit, see convert.camera_of: also a profile is fitted where it is not "auto".
    Raises ProfileError with file, place and reason, ArgumentError for an option that is wrong in itself.
    """
    if model != "auto" and model not in MODELS:
        raise ArgumentError(f"model {model!r:.40} is none of auto, {', '.join(MODELS)}")
    if max_theta is not None and not max_theta > 0:
        raise ArgumentError(f"max_theta must be above zero, not {max_theta:g}")
    try:
        with open(path, "rb") as stream:
            data = stream.read(BYTES_MAX + 1)
    except OSError as error:
        raise ProfileError(path, None, error.strerror or str(error)) from None
    if not data.strip():
        raise ProfileError(path, None, "the file is empty")
    try:
        if form in (None, "binary") and (data[:4] == b"PFPR" or form == "binary"):
            return _own("binary", Camera.from_binary(data), camera, size, model, max_error, max_theta)
        if form == "json" or (form is None and _own_json(data)):
            return _own("json", Camera.load_json(path), camera, size, model, max_error, max_theta)
        form, found = _read(data, form, size)
        chosen = found[_choose([f.name for f in found], 0 if camera is None else camera)]
        _check_size(size, chosen.lens.width, chosen.lens.height)
        made, fit = _within(form, chosen.lens, model, max_error, max_theta)
        notes = list(chosen.notes)
        if camera is None and len(found) > 1:
            notes.append(f"{len(found)} cameras in the file: {chosen.name} taken")
        made = dataclasses.replace(made, name=_name(chosen.name, Path(path)))
    except ProfileError as error:
        raise ProfileError(path, error.position, error.reason) from None
    return Conversion(made, form, tuple(f.name for f in found), chosen.name, fit, tuple(notes))


def _own(
    form: str,
    own: Camera,
    camera: int | str | None,
    size: tuple[int, int] | None,
    model: str,
    max_error: float,
    max_theta: float | None,
) -> Conversion:
    """A profile with the options of load: they mean the same as for other programs' files."""
    _choose([own.name], 0 if camera is None else camera)
    _check_size(size, own.width, own.height)
    fit = None
    if model != "auto":
        own, fit = own.to_generic(model, max_theta=max_theta)
        if not fit.max_px <= max_error:
            raise ProfileError(None, None, f"{model} does not fit: {fit}; see --max-error, --max-theta")
    elif max_theta is not None and max_theta < own.theta_max:
        own = dataclasses.replace(own, theta_max=max_theta)
    return Conversion(own, form, (own.name,), own.name, fit, ())


def _check_size(size: tuple[int, int] | None, width: int, height: int) -> None:
    if size is not None and tuple(size) != (width, height):
        raise ProfileError(None, "image size", f"{width} x {height} in the file, {size[0]} x {size[1]} given")


def from_lens(
    lens: Lens, *, model: str = "auto", max_error: float = MAX_ERROR, max_theta: float | None = None
) -> Conversion:
    """The Camera for a model of pipefish.lenses; options and errors as of load."""
    made, fit = _within(type(lens).__name__, lens, model, max_error, max_theta)
    return Conversion(made, type(lens).__name__, ("camera",), "camera", fit, ())


def _within(form: str, lens: Lens, model: str, max_error: float, max_theta: float | None) -> tuple[Camera, Fit]:
    try:
        made, fit = camera_of(lens, model, max_theta)
    except ArgumentError as error:  # of the fit: a lens that is none
        raise ProfileError(None, None, f"{form}: {error}") from None
    if not fit.max_px <= max_error:
        raise ProfileError(None, None, _does_not_fit(form, lens, model, fit, max_error))
    return made, fit


def _does_not_fit(form: str, lens: Lens, model: str, fit: Fit, max_error: float) -> str:
    """The reason, with the angle up to which the lens can be had within max_error."""
    field, low, high = lens_field(lens), 0.0, fit.theta_max
    for _ in range(5):
        middle = (low + high) / 2
        try:
            fits = camera_of(lens, model, middle, field)[1].max_px <= max_error
        except PipefishError:
            fits = False
        low, high = (middle, high) if fits else (low, middle)
    way = f"--max-theta {math.floor(math.degrees(low))} keeps within that, " if low > math.radians(10) else ""
    return f"{form}: the generic model does not fit: {fit}; {max_error:g} px are allowed: {way}--max-error allows more"


def _like_json(data: bytes) -> bool:
    return data[:4096].lstrip()[:1] in (b"{", b"[", b"")


def _own_json(data: bytes) -> bool:
    """Whether this is a profile in JSON or could be meant as one: JSON that is nobody else's."""
    if not _like_json(data) or len(data) > BYTES_MAX:
        return _like_json(data)
    try:
        text = decode(data)
        return _guess_text(text) is None and _guess_mapping(parse_json(text)) in ("json", None)
    except ProfileError:
        return True


def _name(camera: str, path: Path) -> str:
    """At most 63 bytes for the profile's name: the file, and the camera in it."""
    text = "".join(c for c in f"{path.stem} {camera}" if c.isprintable())
    return text.encode()[:63].decode(errors="ignore")


def write(
    camera: Camera,
    path: str | os.PathLike[str],
    to: str,
    *,
    max_error: float = MAX_ERROR,
    max_theta: float | None = None,
) -> Written:
    """Writes the camera in another program's format, one of WRITERS; the file appears whole or not at all.

    max_error: largest allowed difference, pixels; max_theta: the angle up to which it must hold, radians.
    Raises ProfileError where the format cannot express the camera; OSError.
    """
    try:
        written = WRITERS[to](camera, Wanted(max_error, max_theta))
    except ProfileError as error:
        raise ProfileError(path, error.position, error.reason) from None
    write_atomically(Path(path), written.text.encode())
    return written
