"""Readers of the formats that are neither YAML nor JSON. docs/formats.md says what each number means."""

from __future__ import annotations

import ast
import math
import re
from typing import Any

import numpy as np

from ..errors import ProfileError
from ..lenses import (
    FieldOfView,
    KannalaBrandt,
    Perspective,
    SplinedStereographic,
    Stereographic,
    ThinPrismFisheye,
)
from .parse import Found, Node, finite, whole
from .readers import Size, generic_lens, image, need_size, opencv_distortion, scaramuzza

# ---- COLMAP: pixel centres at half integers

_COLMAP_COUNTS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "OPENCV_FISHEYE": 8,
    "THIN_PRISM_FISHEYE": 12,
}


def _colmap_lens(model: str, v: tuple[float, ...], size: Size) -> Any:
    one_focal = model.startswith(("SIMPLE_", "RADIAL"))
    (fx, *v) = v  # type: ignore[assignment]
    fy, cx, cy, *k = (fx, *v) if one_focal else v
    core: dict[str, Any] = {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5, **image(size)}
    if model == "FOV":
        return FieldOfView(omega=k[0], **core)
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, s1, s2 = k
        return ThinPrismFisheye(k=(k1, k2, k3, k4), tangential=(p1, p2), prism=(s1, s2), **core)
    if model.endswith("_FISHEYE"):
        return KannalaBrandt(k=(*k, *(0.0,) * (4 - len(k))), **core)
    if model in ("OPENCV", "FULL_OPENCV"):
        return Perspective(**core, **opencv_distortion(tuple(k), "parameters"))
    return Perspective(radial=tuple(k), **core)


def read_colmap(text: str, size: Size | None) -> list[Found]:
    """cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        fields = line.split("#")[0].split()
        if not fields:
            continue
        where = f"line {number}"
        if len(fields) < 5:
            raise ProfileError(None, where, "not CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        name, model, width, height, *parameters = fields
        if model not in _COLMAP_COUNTS:
            raise ProfileError(None, where, f"the model {model:.40} is not read")
        if len(parameters) != _COLMAP_COUNTS[model]:
            raise ProfileError(None, where, f"{len(parameters)} parameters where {_COLMAP_COUNTS[model]} belong")
        values = tuple(finite(p, where) for p in parameters)
        found.append(Found(name, _colmap_lens(model, values, (whole(width, where), whole(height, where)))))
    if not found:
        raise ProfileError(None, None, "no camera in the file")
    return found


# ---- OCamCalib: x is the row, y the column


def read_ocam(text: str, size: Size | None) -> list[Found]:
    """calib_results.txt as the toolbox exports it (it subtracts MATLAB's one from the centre itself)."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) < 5:
        raise ProfileError(None, None, f"{len(lines)} lines of numbers where 5 belong")
    polynomial, inverse, centre, affine, shape = (
        tuple(finite(v, f"numbers, line {i + 1}") for v in line) for i, line in enumerate(lines[:5])
    )
    for values, name in ((polynomial, "polynomial"), (inverse, "inverse polynomial")):
        if not values or len(values) - 1 != values[0]:
            raise ProfileError(None, name, "its first number does not count the others")
    if (len(centre), len(affine), len(shape)) != (2, 3, 2):
        raise ProfileError(None, "centre, affine, size", "not 2, 3 and 2 numbers")
    c, d, e = affine
    height, width = (whole(v, "size") for v in shape)
    # (row, column) = [c d; e 1] (x, y) + centre; ours are (column, row) = [1 e; d c] (y, x) + centre.
    lens = scaramuzza((width, height), polynomial[1:], (centre[1], centre[0]), ((1.0, e), (d, c)))
    return [Found("camera", lens)]


# ---- the toolbox of the model's authors (MATLAB: the first pixel's centre is 1)


def read_toolbox(text: str, size: Size | None) -> list[Found]:
    """p = [k1 k2 mu mv u0 v0 | k3 k4 k5 | i1..i3 j1..j3 l1..l4 m1..m4]: lines `para1=...#`, or nothing but 6, 9 or 23
    numbers. i and l make the tangential, j and m the radial asymmetry."""
    named = re.findall(r"^[ \t]*para(\d+)[ \t]*=[ \t]*([^#\s]+)", text, re.MULTILINE)
    if named:
        if [int(i) for i, _ in named] != list(range(1, len(named) + 1)):
            raise ProfileError(None, "para", "the numbers of the parameters are not 1, 2, 3, ...")
        p = tuple(finite(v, f"para{i}") for i, v in named)
    else:
        p = tuple(finite(v, f"number {i + 1}") for i, v in enumerate(re.split(r"[\s,;]+", text.strip(" \n\t[];,"))))
    if len(p) not in (6, 9, 23):
        raise ProfileError(None, "p", f"{len(p)} parameters where 6, 9 or 23 belong")
    notes = []
    start = re.search(r"^p0:[ \t]*\n([^\n]*)", text, re.MULTILINE)
    if size is None and start:
        p0 = start[1].replace(",", " ").split()
        if len(p0) != 6:
            raise ProfileError(None, "p0", f"{len(p0)} numbers where 6 belong")
        u0, v0 = (finite(v, "p0") for v in p0[4:])
        size = whole(2 * u0, "p0"), whole(2 * v0, "p0")
        notes.append(f"image size {size[0]} x {size[1]} from the start values p0 (twice its centre)")
    shape = need_size(size)
    k1, k2, mu, mv, u0, v0 = p[:6]
    k = (k1, k2, *(p[6:9] or (0.0,) * 3))
    core = {"fx": mu, "fy": mv, "skew": 0.0, "cx": u0 - 1, "cy": v0 - 1, **image(shape)}
    # asymmetric: radial theta j, phi m; tangential theta i, phi l
    asymmetric = (p[12:15], p[19:23], p[9:12], p[15:19]) if len(p) == 23 else ()
    return [Found("camera", generic_lens(core, k, *asymmetric), *notes)]


# ---- mrcal


def read_mrcal(text: str, size: Size | None) -> list[Found]:
    """A .cameramodel: a Python literal."""
    try:
        document = ast.literal_eval(text.lstrip())
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = getattr(error, "lineno", None)
        raise ProfileError(None, f"line {line}" if line else None, "not the literal of a .cameramodel") from None
    node = Node(document)
    model = node.text("lensmodel" if "lensmodel" in node else "lens_model")
    v = node.numbers("intrinsics")
    width, height = node.numbers("imagersize", 2)
    shape = (whole(width, "imagersize"), whole(height, "imagersize"))
    if len(v) < 4:
        raise ProfileError(None, "intrinsics", "fewer than 4 numbers")
    fx, fy, cx, cy, *k = v
    core: dict[str, Any] = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **image(shape)}
    opencv = re.fullmatch(r"LENSMODEL_OPENCV(4|5|8|12)", model)
    counts = {
        "LENSMODEL_PINHOLE": 0,
        "LENSMODEL_STEREOGRAPHIC": 0,
        model if opencv else "": int(opencv[1]) if opencv else 0,
    }
    splined = re.fullmatch(r"LENSMODEL_SPLINED_STEREOGRAPHIC_order=([23])_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+)", model)
    if splined:
        order, nx, ny, fov = map(int, splined.groups())
        counts[model] = 2 * nx * ny
        if min(nx, ny) <= order or not 0 < fov < 360:
            raise ProfileError(None, "lensmodel", f"{model:.80} is not a grid")
    if model not in counts:
        raise ProfileError(
            None, "lensmodel", f"{model:.60} is not read: OPENCV4 to 12, PINHOLE, STEREOGRAPHIC, SPLINED_STEREOGRAPHIC"
        )
    if len(k) != counts[model]:
        raise ProfileError(None, "intrinsics", f"{len(v)} numbers where {counts[model] + 4} belong")
    if splined:
        control = np.array(k).reshape(ny, nx, 2)
        if node.value.get("valid_intrinsics_region"):
            region = np.array(node.numbers("valid_intrinsics_region"))
            if region.size % 2 or region.size < 6:
                raise ProfileError(None, "valid_intrinsics_region", "not a list of three or more points")
            core["region"] = region.reshape(-1, 2)
        return [Found("camera", SplinedStereographic(order=order, fov_x=math.radians(fov), control=control, **core))]
    if model == "LENSMODEL_STEREOGRAPHIC":
        return [Found("camera", Stereographic(**core))]
    if not opencv:
        return [Found("camera", Perspective(**core))]
    return [Found("camera", Perspective(**core, **opencv_distortion(tuple(k), "intrinsics")))]
