"""From another program's lens to a Camera, and from a Camera to what a format can hold, with the error of it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from ..camera import Camera
from ..errors import ArgumentError, ProfileError
from ..fit import MODELS, Fit, compare, fit_camera
from ..lenses import THETA_END, Field, Lens, field_of

MAX_ERROR = 0.1  # pixels; what a good calibration's own residual is
_FIT = (36, 32)  # azimuths, angles of the fit
CHECK = (77, 91, 0.013)  # and of the check: other rays, among them the edge of the picture
_ASYMMETRIC_BELOW = 0.5  # "cpoly" is taken where it at least halves the error ...
_GOOD_ENOUGH = 0.005  # ... of more than this many pixels


def lens_field(lens: Lens) -> Field:
    """What the lens's image sees. Raises ProfileError where its axis is not in the image."""
    field = field_of(lens.project, lens.width, lens.height)
    if field is None or not field.theta_edge.min() > 1e-3:
        raise ProfileError(None, None, "the optical axis is not in the image, or the model does not begin there")
    return field


def camera_of(
    lens: Lens, model: str = "auto", max_theta: float | None = None, field: Field | None = None
) -> tuple[Camera, Fit]:
    """The Camera for `lens`, over what its image sees (at most max_theta, radians).

    model: "auto": the exact equivalent if there is one, else p9, else cpoly where that is much better; or one of
    MODELS. field: lens_field(lens), where it is there already. Raises ProfileError where the lens has no axis in its
    image or the result is not one-to-one.
    """
    field = field or lens_field(lens)
    if max_theta is not None:
        field = field.within(max_theta)
    end = THETA_END if max_theta is None else min(max_theta, THETA_END)
    fields = lens.exact() if model == "auto" else None
    points = field.sample(*CHECK)
    expected, ok = lens.project(points)
    points, expected = points[ok], expected[ok]
    if fields is not None:
        camera = _widest(field, end, lambda theta: _build(lens, fields, theta))
        got, ok = camera.project(points)
        return camera, compare(points[ok], expected[ok], got[ok], exact=True)
    size = (lens.width, lens.height)
    skew = bool(getattr(lens, "skew", 0.0)) or hasattr(lens, "stretch")
    camera, fit = _fitted(lens.project, size, field, end, "p9" if model == "auto" else model, skew)
    if model == "auto" and fit.max_px > _GOOD_ENOUGH:
        try:
            other = _fitted(lens.project, size, field, end, "cpoly", skew)
        except ProfileError:  # cpoly not one-to-one: p9 stays
            return camera, fit
        if other[1].max_px < _ASYMMETRIC_BELOW * fit.max_px:
            return other
    return camera, fit


def _build(lens: Lens, fields: dict[str, Any], theta_max: float) -> Camera:
    return Camera(width=lens.width, height=lens.height, theta_max=theta_max, source="imported", **fields)


def _widest(field: Field, end: float, build: Any) -> Camera:
    """The camera with the largest theta_max, at most `end`, that is proved one-to-one: a little beyond the picture's
    edge, or a little less where the model itself ends at the edge."""
    edge = float(field.theta_edge.max())
    ends = bool(field.model_ends[np.argmax(field.theta_edge)])
    factors = (0.9999, 0.999, 0.99) if ends else (1.001, 1.0, 0.9999, 0.999, 0.99)
    for factor in factors:
        try:
            return build(min(edge * factor, end))
        except ProfileError as error:
            if error.key != "theta_max" or factor == factors[-1]:
                raise
    raise AssertionError("unreachable")


def _fitted(
    project: Any, size: tuple[int, int], field: Field, end: float, model: str, skew: bool
) -> tuple[Camera, Fit]:
    points = np.vstack([[[0.0, 0.0, 1.0]], field.sample(*_FIT)])
    pixels, ok = project(points)
    points, pixels = points[ok], pixels[ok]
    theta = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])

    def build(theta_max: float) -> Camera:
        use = theta <= theta_max
        return fit_camera(
            points[use], pixels[use], size, model, skew=skew, theta_max=theta_max, even=True, source="imported"
        )[0]

    camera = _widest(field, end, build)
    points = field.sample(*CHECK)
    expected, ok = project(points)
    got, seen = camera.project(points)
    both = ok & seen
    return camera, compare(points[both], expected[both], got[both])


# ---- from a Camera


def camera_field(camera: Camera, max_theta: float | None = None) -> Field:
    """What the camera's image sees."""
    end = min(max_theta or math.pi, camera.theta_max)
    field = field_of(camera.project, camera.width, camera.height, end, camera.in_image)
    if field is None:
        raise ProfileError(None, "c_u, c_v", "the optical axis is not in the image")
    return field


def lost_terms(camera: Camera) -> list[str]:
    """What of this camera a polynomial without asymmetry, skew and pupil shift does not have."""
    lost = [] if camera.radial in ("generic", "equidistant") else [f"the {camera.radial} radial function"]
    for name in ("skew", "tilt", "asym_radial_theta", "asym_tangential_theta", "cpoly", "pupil_e1"):
        if np.any(getattr(camera, name)):
            lost.append(name.removesuffix("_theta"))
    return lost


def generic(
    camera: Camera, model: str = "p9", max_theta: float | None = None, skew: bool | None = None
) -> tuple[Camera, Fit]:
    """The camera with the polynomial (and the asymmetry of `model`) fitted over the image; see Camera.to_generic.

    A pupil shift is left out: then the fit is of far points.
    """
    if model not in MODELS:
        raise ArgumentError(f"model {model!r} is none of {', '.join(MODELS)}")
    far = dataclasses.replace(camera, pupil_e1=0.0) if camera.pupil_e1 else camera
    field = camera_field(far, max_theta)
    skew = bool(camera.skew) if skew is None else skew
    made, fit = _fitted(
        far.project, (camera.width, camera.height), field, min(max_theta or math.pi, THETA_END), model, skew
    )
    keep = {key: getattr(camera, key) for key in ("name", "serial", "created", "circle_u", "circle_v", "circle_radius")}
    return dataclasses.replace(made, source=camera.source, **keep), fit


def plain_polynomial(camera: Camera, max_theta: float | None = None) -> tuple[Camera, Fit, list[str]]:
    """The camera as f_u, f_v, c_u, c_v, k2..k5 alone: exact or fitted; and what was lost."""
    lost = lost_terms(camera)
    if lost:
        made, fit = generic(camera, "p9", max_theta, skew=False)
        return made, fit, lost
    made = camera if camera.radial == "generic" else dataclasses.replace(camera, radial="generic")
    points = camera_field(camera, max_theta).sample(*CHECK)
    pixels, _ = camera.project(points)
    return made, compare(points, pixels, made.project(points)[0], exact=True), []
