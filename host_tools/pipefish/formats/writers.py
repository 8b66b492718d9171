"""Writers of other programs' files. Each takes the Camera and what may be lost, and returns the text, the fit, and
notes for people; or refuses with the reason.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable

import numpy as np

from ..camera import Camera
from ..errors import ProfileError
from ..fit import Fit, compare
from ..lenses import SplinedStereographic, rays
from .convert import CHECK, camera_field, lost_terms, plain_polynomial


@dataclasses.dataclass(frozen=True)
class Written:
    """A file's text, how well it holds the camera, and notes."""

    text: str
    fit: Fit
    notes: list[str]


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What the user allows: the largest error in pixels, and the angle up to which it counts (radians or None)."""

    max_error: float
    max_theta: float | None = None


def _accept(form: str, camera: Camera, fit: Fit, wanted: Wanted, lost: list[str]) -> list[str]:
    """The notes of a fit within the bounds; ProfileError otherwise."""
    what = f" ({form} has no {', '.join(lost)})" if lost else ""
    if not fit.max_px <= wanted.max_error:
        raise ProfileError(
            None,
            None,
            f"{form} cannot express this camera: {fit}{what}; --max-error {wanted.max_error:g} px allows no more, "
            f"--max-theta less of the field",
        )
    notes = [f"fitted, since {form} has no {', '.join(lost)}"] if lost else []
    if camera.pupil_e1:
        near = abs(camera.pupil_e1) * fit.theta_max**2 * math.sin(fit.theta_max) * camera.f_u
        notes.append(f"the pupil shift is lost: right for far points, up to {near / 0.1:.2g} px off at 0.1 m")
    if wanted.max_theta is not None and fit.theta_max > wanted.max_theta - 1e-3:
        notes.append(f"holds up to {math.degrees(fit.theta_max):.1f} degrees only")
    return notes


_DIVIDES = "it divides by z"


def _front(form: str, camera: Camera, wanted: Wanted, why: str) -> None:
    """Refuses a camera that sees beyond what the program's functions reach."""
    edge = float(camera_field(camera, wanted.max_theta).theta_edge.max())
    if edge >= math.radians(90):
        raise ProfileError(
            None,
            None,
            f"{form} ends at 90 degrees ({why}) and this camera sees {math.degrees(edge):.1f}: "
            f"--max-theta 89 writes a file that is right up to 89 degrees only",
        )


def _kb4(form: str, camera: Camera, wanted: Wanted, front: str | None) -> tuple[Camera, Fit, list[str]]:
    """front: why the program ends at 90 degrees; None: it does not."""
    if front:
        _front(form, camera, wanted, front)
    made, fit, lost = plain_polynomial(camera, wanted.max_theta)
    return made, fit, _accept(form, camera, fit, wanted, lost)


def _k(camera: Camera) -> tuple[float, float, float, float]:
    return camera.k2, camera.k3, camera.k4, camera.k5


def _list(values: object) -> str:
    return "[" + ", ".join(repr(float(v)) for v in values) + "]"  # type: ignore[attr-defined]


def _matrix(camera: Camera) -> list[float]:
    return [camera.f_u, 0.0, camera.c_u, 0.0, camera.f_v, camera.c_v, 0.0, 0.0, 1.0]


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)


def opencv_fisheye(camera: Camera, wanted: Wanted) -> Written:
    """cv::FileStorage YAML for cv::fisheye."""
    made, fit, notes = _kb4("opencv-fisheye", camera, wanted, _DIVIDES)

    def matrix(name: str, rows: int, columns: int, data: object) -> str:
        return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {_list(data)}\n"

    text = (
        f"%YAML:1.0\n---\nname: {_text(camera.name)}\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        f"fisheye_model: 1\n{matrix('camera_matrix', 3, 3, _matrix(made))}"
        f"{matrix('distortion_coefficients', 4, 1, _k(made))}"
    )
    return Written(text, fit, notes)


def ros(camera: Camera, wanted: Wanted) -> Written:
    """sensor_msgs/CameraInfo as camera_info_manager reads it; R is the identity and P has K's numbers."""
    made, fit, notes = _kb4("ros", camera, wanted, _DIVIDES)

    def matrix(name: str, rows: int, columns: int, data: object) -> str:
        return f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {_list(data)}\n"

    k = _matrix(made)
    text = (
        f"image_width: {camera.width}\nimage_height: {camera.height}\ncamera_name: {_text(camera.name or 'camera')}\n"
        f"{matrix('camera_matrix', 3, 3, k)}distortion_model: equidistant\n"
        f"{matrix('distortion_coefficients', 1, 4, _k(made))}"
        f"{matrix('rectification_matrix', 3, 3, np.eye(3).ravel())}"
        f"{matrix('projection_matrix', 3, 4, [*k[:3], 0, *k[3:6], 0, *k[6:], 0])}"
    )
    return Written(text, fit, notes)


def kalibr(camera: Camera, wanted: Wanted) -> Written:
    """A camchain with one camera: pinhole-equi, or omni-none for the unified model."""
    core = f"  resolution: [{camera.width}, {camera.height}]\n  rostopic: /cam0/image_raw\n"
    if camera.radial == "unified" and lost_terms(camera) == ["the unified radial function"]:
        points = camera_field(camera, wanted.max_theta).sample(*CHECK)
        pixels, _ = camera.project(points)
        scale = 1 + camera.mirror
        intrinsics = (camera.mirror, camera.f_u * scale, camera.f_v * scale, camera.c_u, camera.c_v)
        text = (
            f"cam0:\n  camera_model: omni\n  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  distortion_model: radtan\n"
            f"  intrinsics: {_list(intrinsics)}\n{core}"
        )
        return Written(text, compare(points, pixels, pixels, exact=True), [])
    made, fit, notes = _kb4("kalibr", camera, wanted, _DIVIDES)
    text = (
        f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: {_list(_k(made))}\n  distortion_model: equidistant\n"
        f"  intrinsics: {_list((made.f_u, made.f_v, made.c_u, made.c_v))}\n{core}"
    )
    return Written(text, fit, notes)


def colmap(camera: Camera, wanted: Wanted) -> Written:
    """cameras.txt with one OPENCV_FISHEYE; its pixel centres are at half integers."""
    made, fit, notes = _kb4("colmap", camera, wanted, _DIVIDES)
    values = (made.f_u, made.f_v, made.c_u + 0.5, made.c_v + 0.5, *_k(made))
    text = (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: 1\n1 OPENCV_FISHEYE {camera.width} {camera.height} {' '.join(map(repr, values))}\n"
    )
    return Written(text, fit, notes)


def basalt(camera: Camera, wanted: Wanted) -> Written:
    """basalt's calibration.json, the camera part: kb4."""
    made, fit, notes = _kb4("basalt", camera, wanted, None)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    values = (made.f_u, made.f_v, made.c_u, made.c_v, *_k(made))
    document = {
        "value0": {
            "T_imu_cam": [{"px": 0.0, "py": 0.0, "pz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}],
            "intrinsics": [{"camera_type": "kb4", "intrinsics": dict(zip(names, values, strict=True))}],
            "resolution": [[camera.width, camera.height]],
        }
    }
    return Written(json.dumps(document, indent=4) + "\n", fit, notes)


def orbslam3(camera: Camera, wanted: Wanted) -> Written:
    """The camera part of ORB-SLAM3's settings."""
    made, fit, notes = _kb4("orbslam3", camera, wanted, "its back-projection gives rays with z = 1")
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    values = (made.f_u, made.f_v, made.c_u, made.c_v, *_k(made))
    lines = [f"Camera1.{name}: {value!r}" for name, value in zip(names, values, strict=True)]
    text = "\n".join(
        [
            "%YAML:1.0",
            'File.version: "1.0"',
            'Camera.type: "KannalaBrandt8"',
            *lines,
            f"Camera.width: {camera.width}",
            f"Camera.height: {camera.height}",
            "",
        ]
    )
    return Written(text, fit, notes)


def toolbox(camera: Camera, wanted: Wanted) -> Written:
    """The parameter vector p of the toolbox: 23 numbers where the camera is asymmetric, else 9. One-based pixels."""
    lost = [term for term in lost_terms(camera) if not term.startswith("asym_")]
    if lost:
        made, fit, lost = plain_polynomial(camera, wanted.max_theta)
    else:
        made = camera
        points = camera_field(camera, wanted.max_theta).sample(*CHECK)
        pixels, _ = camera.project(points)
        fit = compare(points, pixels, pixels, exact=True)
    notes = _accept("toolbox", camera, fit, wanted, lost)
    p = [1.0, made.k2, made.f_u, made.f_v, made.c_u + 1, made.c_v + 1, made.k3, made.k4, made.k5]
    if any(made.asym_radial_theta) or any(made.asym_tangential_theta):
        p += [*made.asym_tangential_theta, *made.asym_radial_theta]
        p += [*made.asym_tangential_phi, *made.asym_radial_phi]
    text = "".join(f"para{i}={v!r}#\n" for i, v in enumerate(p, 1))
    return Written(text, fit, [*notes, "the vector does not hold the image size"])


def mrcal(camera: Camera, wanted: Wanted) -> Written:
    """A .cameramodel: PINHOLE or STEREOGRAPHIC where the camera is that, else mrcal's own fisheye model, the splined
    stereographic one, whose control points come from linear least squares."""
    simple = {"perspective": "LENSMODEL_PINHOLE", "stereographic": "LENSMODEL_STEREOGRAPHIC"}
    field = camera_field(camera, wanted.max_theta)
    points = field.sample(*CHECK)
    pixels, _ = camera.project(points)
    notes: list[str] = []
    region = ""
    if field.model_ends.any():
        contour, _ = camera.project(rays(field.theta_edge, field.phi)[::4])
        contour = np.vstack([contour, contour[:1]])  # mrcal drops a region that is not closed
        region = f"    'valid_intrinsics_region': {np.round(contour, 3).tolist()},\n\n"
    if lost_terms(camera) == [f"the {camera.radial} radial function"] and camera.radial in simple:
        model, extra = simple[camera.radial], np.zeros(0)
        fit = compare(points, pixels, pixels, exact=True)
    else:
        lens = _spline(dataclasses.replace(camera, pupil_e1=0.0) if camera.pupil_e1 else camera, wanted)
        ny, nx = lens.control.shape[:2]
        fov = round(math.degrees(lens.fov_x))
        model = f"LENSMODEL_SPLINED_STEREOGRAPHIC_order={lens.order}_Nx={nx}_Ny={ny}_fov_x_deg={fov}"
        extra = lens.control.ravel()
        got, ok = lens.project(points)
        got[~ok] = np.nan
        fit = compare(points, pixels, got)
        notes = [f"as a spline of {nx} x {ny} control points, mrcal's model for fisheyes"]
    notes += _accept("mrcal", camera, fit, wanted, [])
    numbers = ", ".join(repr(float(v)) for v in (camera.f_u, camera.f_v, camera.c_u, camera.c_v, *extra))
    text = (
        f"{{\n    'lensmodel': '{model}',\n\n    'intrinsics': [ {numbers} ],\n\n"
        f"    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n\n{region}"
        f"    'imagersize': [ {camera.width}, {camera.height} ]\n}}\n"
    )
    return Written(text, fit, notes)


def _spline(camera: Camera, wanted: Wanted) -> SplinedStereographic:
    """As many control points as mrcal's own calibrations have; fitted to all that the model holds, beyond the edge of
    the picture too, or the spline would be loose there."""
    field = camera_field(camera, wanted.max_theta)
    seen = field.sample(180, 30)
    reach = np.abs(2 * seen[:, :2] / (1 + seen[:, 2:])).max(axis=0) * 1.02
    fov = min(2 * math.ceil(math.degrees(2 * math.atan(reach[0] / 2))), 358)
    nx = 30
    per_unit = (nx - 3) / (4 * math.tan(math.radians(fov) / 4))
    ny = max(math.ceil(2 * reach[1] * per_unit) + 3, 5)
    size = {"width": camera.width, "height": camera.height}
    core = {"fx": camera.f_u, "fy": camera.f_v, "cx": camera.c_u, "cy": camera.c_v}
    lens = SplinedStereographic(order=3, fov_x=math.radians(fov), control=np.zeros((ny, nx, 2)), **core, **size)
    u = np.stack(
        np.meshgrid(*(np.linspace(-r, r, 2 * n) for r, n in zip(reach, (2 * nx, 2 * ny), strict=True))), axis=-1
    )
    u = u.reshape(-1, 2)
    square = (u**2).sum(axis=1, keepdims=True)
    points = np.hstack([4 * u, 4 - square]) / (4 + square)
    pixels, ok = camera.project(points)
    u, points, pixels = u[ok], points[ok], pixels[ok]
    edge = field.sample(360, 4)
    u = np.vstack([u, 2 * edge[:, :2] / (1 + edge[:, 2:])])
    points, pixels = np.vstack([points, edge]), np.vstack([pixels, camera.project(edge)[0]])
    _, _, (ix, iy, wx, wy), _ = lens.basis(*points.T)
    design = np.zeros((len(points), ny * nx))
    for j in range(4):
        for i in range(4):
            np.add.at(design, (np.arange(len(points)), (iy + j) * nx + ix + i), wy[:, j] * wx[:, i])
    target = (pixels - [camera.c_u, camera.c_v]) / [camera.f_u, camera.f_v] - u
    ridge = 1e-6 * np.eye(ny * nx)  # control points that no ray reaches stay near zero
    solved = np.linalg.solve(design.T @ design + ridge, design.T @ target)
    return dataclasses.replace(lens, control=solved.reshape(ny, nx, 2))


#: form -> (writer, what it is)
WRITERS: dict[str, Callable[[Camera, Wanted], Written]] = {
    "opencv-fisheye": opencv_fisheye,
    "ros": ros,
    "kalibr": kalibr,
    "colmap": colmap,
    "basalt": basalt,
    "orbslam3": orbslam3,
    "mrcal": mrcal,
    "toolbox": toolbox,
}
