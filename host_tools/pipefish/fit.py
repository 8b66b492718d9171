"""Least-squares fit of the generic model to rays and their pixels, with the C core's derivatives.

For converting models. Calibration from targets, with poses, is the engine's.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _engine
from .camera import PARAMETERS, Camera, _rows
from .errors import ArgumentError

Array = npt.NDArray[np.float64]

_RADIAL = ("k2", "k3", "k4", "k5")
_CPOLY = tuple(f"cpoly[{i}]" for i in range(14))
_ASYMMETRIC = tuple(name for name in PARAMETERS if name.startswith("asym_"))
_LAWSON_STEPS = 30

_FIELDS = ("width", "height", "theta_max", *dict.fromkeys(name.partition("[")[0] for name in PARAMETERS))

#: Free parameters besides focal lengths, principal point and skew.
MODELS = {"p6": _RADIAL[:1], "p9": _RADIAL, "p23": _RADIAL + _ASYMMETRIC, "cpoly": _RADIAL + _CPOLY}


@dataclasses.dataclass(frozen=True)
class Fit:
    """How well one model stands for another: pixels between their projections of the same rays, over the image.

    exact: the parameters are the same numbers, no fit was needed. theta_max: the largest angle compared, radians;
    worst_theta: where the largest difference is.
    """

    exact: bool
    rms_px: float
    max_px: float
    theta_max: float
    worst_theta: float

    def __str__(self) -> str:
        reach = f"up to {math.degrees(self.theta_max):.1f} deg"
        if self.exact:
            return f"exact {reach}"
        where = f" at {math.degrees(self.worst_theta):.1f} deg"
        return f"fitted: rms {self.rms_px:.2g} px, largest {self.max_px:.2g} px{where}, compared {reach}"


def compare(points: Array, expected: Array, got: Array, exact: bool = False) -> Fit:
    """The Fit of two projections (N, 2) of `points` (N, 3)."""
    error = np.linalg.norm(got - expected, axis=1)
    theta = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    worst = int(np.argmax(np.where(np.isfinite(error), error, np.inf)))
    return Fit(exact, float(np.sqrt(np.mean(error**2))), float(error[worst]), float(theta.max()), float(theta[worst]))


def _index(name: str) -> tuple[str, int | None]:
    key, _, rest = name.partition("[")
    return key, int(rest[:-1]) if rest else None


def _set(profile: Any, names: tuple[str, ...], values: Array) -> None:
    for name, value in zip(names, values, strict=True):
        key, i = _index(name)
        if i is None:
            setattr(profile, key, float(value))
        else:
            array = list(getattr(profile, key))
            array[i] = float(value)
            setattr(profile, key, array)


def _get(profile: Any, names: tuple[str, ...]) -> Array:
    parts = [(getattr(profile, key), i) for key, i in map(_index, names)]
    return np.array([value if i is None else value[i] for value, i in parts])


def _linear_start(points: Array, pixels: Array, radial: int) -> dict[str, float]:
    """u and v are linear in the products of focal length and polynomial: their least squares, one k for both."""
    theta = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    rho = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-300)
    scale = theta.max()
    powers = (theta[:, None] / scale) ** (2 * np.arange(radial + 1) + 1)
    solved = []
    for axis in range(2):
        direction = np.where(theta > 0, points[:, axis] / rho, 0.0)
        design = np.column_stack([powers * direction[:, None], np.ones(len(points))])
        solved.append(np.linalg.lstsq(design, pixels[:, axis], rcond=None)[0])
    (*a, c_u), (*b, c_v) = solved
    total = np.array(a) + np.array(b)
    if not (a[0] > 0 and b[0] > 0):
        raise ArgumentError("fit: the pixels do not go with the rays (a focal length comes out negative)")
    k = {name: total[i + 1] / total[0] / scale ** (2 * i + 2) for i, name in enumerate(_RADIAL[:radial])}
    return {"f_u": a[0] / scale, "f_v": b[0] / scale, "c_u": c_u, "c_v": c_v, **k}


def _asymmetric_start(profile: Any, points: Array, residual: Array) -> None:
    """Start values of the 14 asymmetric terms, whose zero is a saddle: the unfactored 3 x 4 coefficients of
    the radial and the tangential residual are linear; their best rank-one parts are the factors."""
    theta = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    phi = np.arctan2(points[:, 1], points[:, 0])
    y = residual[:, 1] / profile.f_v
    x = (residual[:, 0] - profile.skew * y) / profile.f_u
    scale = theta.max()
    powers = np.stack([(theta / scale) ** n for n in (1, 3, 5)], axis=1)
    waves = np.stack([np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)], axis=1)
    design = (powers[:, :, None] * waves[:, None, :]).reshape(len(theta), 12)
    normal = np.einsum("ni,nj->ij", design, design)  # einsum: see _step
    normal += 1e-12 * np.trace(normal) * np.eye(12)
    for key, part in (
        ("asym_radial", x * np.cos(phi) + y * np.sin(phi)),
        ("asym_tangential", y * np.cos(phi) - x * np.sin(phi)),
    ):
        solved = np.linalg.solve(normal, np.einsum("ni,n->i", design, part)).reshape(3, 4)
        left, sizes, right = np.linalg.svd(solved)
        size = max(sizes[0], 1e-9)  # never the saddle itself
        setattr(profile, f"{key}_theta", (left[:, 0] * size / scale ** np.array([1, 3, 5])).tolist())
        setattr(profile, f"{key}_phi", right[0].tolist())


def _normalise(profile: Any) -> None:
    """Unit norm of the phi vectors: the gauge of the asymmetric terms."""
    for key in ("asym_radial", "asym_tangential"):
        phi, theta = np.array(getattr(profile, f"{key}_phi")), np.array(getattr(profile, f"{key}_theta"))
        norm = np.linalg.norm(phi)
        if theta.any() and norm > 0:
            setattr(profile, f"{key}_phi", (phi / norm).tolist())
            setattr(profile, f"{key}_theta", (theta * norm).tolist())


def _step(jacobian: Array, residual: Array, damping: float) -> Array:
    """-(J'J + damping diag J'J)^-1 J'r. The sums are einsum's: BLAS would share these few numbers among threads and
    wait for them, twenty times longer on a busy machine."""
    norm = np.sqrt(np.einsum("ni,ni->i", jacobian, jacobian))
    norm[norm == 0] = 1.0
    scaled = jacobian / norm
    normal = np.einsum("ni,nj->ij", scaled, scaled) + damping * np.eye(len(norm))
    return -np.linalg.solve(normal, np.einsum("ni,n->i", scaled, residual)) / norm


def _minimise(profile: Any, names: tuple[str, ...], points: Array, pixels: Array) -> None:
    """Levenberg-Marquardt on the named parameters of `profile`, in place."""
    columns = [PARAMETERS.index(name) for name in names]

    def evaluate() -> tuple[float, Array, Array]:
        uv, ok, _, by_parameter = profile.project_jacobian(points)
        if not ok.all():
            return math.inf, uv, by_parameter
        residual = (uv - pixels).ravel()
        return float(residual @ residual), residual, by_parameter.reshape(len(residual), -1)[:, columns]

    damping = 1e-6
    cost, residual, jacobian = evaluate()
    if not math.isfinite(cost):
        raise ArgumentError("fit: a ray lies beyond theta_max")
    for _ in range(60):
        before = _get(profile, names)
        _set(profile, names, before + _step(jacobian, residual, damping))
        _normalise(profile)
        new = evaluate()
        if new[0] <= cost:
            small = cost - new[0] <= 1e-13 * cost + 1e-26 * len(residual)
            cost, residual, jacobian = new
            damping = max(damping / 10, 1e-13)
            if small:
                return
        else:
            _set(profile, names, before)
            damping *= 10
            if damping > 1e6:
                return


def _even_out(profile: Any, names: tuple[str, ...], points: Array, pixels: Array) -> None:
    """From least squares towards the smallest largest error (Lawson's weights, Gauss-Newton steps): a conversion is
    judged by its worst pixel. Keeps the best it meets."""
    columns = [PARAMETERS.index(name) for name in names]
    weight = np.ones(len(points))
    best, kept = math.inf, _get(profile, names)
    for _ in range(_LAWSON_STEPS):
        uv, ok, _, by_parameter = profile.project_jacobian(points)
        residual = uv - pixels
        error = np.linalg.norm(residual, axis=1)
        if not ok.all() or error.max() > 10 * best:
            break
        if error.max() < best:
            best, kept = error.max(), _get(profile, names)
        weight *= error / error.max() + 1e-3
        weight /= weight.max()
        root = np.repeat(np.sqrt(weight), 2)
        jacobian = by_parameter.reshape(len(root), -1)[:, columns] * root[:, None]
        step = _step(jacobian, residual.ravel() * root, 1e-12)
        _set(profile, names, _get(profile, names) + step)
        _normalise(profile)
    _set(profile, names, kept)
    _normalise(profile)


def fit_camera(
    points: npt.ArrayLike,
    pixels: npt.ArrayLike,
    size: tuple[int, int],
    model: str = "p9",
    *,
    skew: bool = False,
    theta_max: float | None = None,
    even: bool = False,
    **about: Any,
) -> tuple[Camera, Fit]:
    """The generic camera that sees `points` (N, 3) at `pixels` (N, 2), in the least-squares sense (even: then towards
    the smallest largest error, for data without noise).

    model: "p6" (k2), "p9" (k2..k5), "p23" (and the asymmetric terms) or "cpoly" (and the smooth asymmetry);
    skew: estimated too; theta_max: of the result, radians [the largest angle among the points]; size: width, height;
    about: name, serial, ... of the Camera. Points for a central camera are rays: any length.
    Raises ArgumentError for bad input, ProfileError if the result is not one-to-one up to theta_max.
    """
    xyz, uv = _rows("points", points, 3), _rows("pixels", pixels, 2)
    if len(xyz) != len(uv):
        raise ArgumentError(f"fit: {len(xyz)} points but {len(uv)} pixels")
    if model not in MODELS:
        raise ArgumentError(f"fit: model {model!r} is none of {', '.join(MODELS)}")
    if not np.isfinite(xyz).all() or not np.isfinite(uv).all():
        raise ArgumentError("fit: points and pixels must be finite")
    names = ("f_u", "f_v", *(("skew",) if skew else ()), "c_u", "c_v", *MODELS[model])
    if 2 * len(xyz) < len(names):
        raise ArgumentError(f"fit: {len(xyz)} points cannot tell {len(names)} parameters")
    theta = np.arctan2(np.hypot(xyz[:, 0], xyz[:, 1]), xyz[:, 2])
    if not theta.max() > 0:
        raise ArgumentError("fit: all points lie on the optical axis")

    profile = _engine.Profile()
    profile.width, profile.height = size
    profile.theta_max = min(float(theta.max()) * (1 + 1e-9), math.pi - 1e-9)
    radial = [name for name in MODELS[model] if name in _RADIAL]
    for key, value in _linear_start(xyz, uv, len(radial)).items():
        setattr(profile, key, float(value))
    plain = tuple(name for name in names if name not in _ASYMMETRIC + _CPOLY)
    _minimise(profile, plain, xyz, uv)
    if plain != names:
        if model == "p23":
            _asymmetric_start(profile, xyz, uv - profile.project(xyz)[0])
        _minimise(profile, names, xyz, uv)
    if even:
        _even_out(profile, names, xyz, uv)
    if theta_max is not None:
        profile.theta_max = max(float(theta.max()), theta_max)
    camera = Camera(**{key: getattr(profile, key) for key in _FIELDS}, **about)
    return camera, compare(xyz, uv, camera.project(xyz)[0])
