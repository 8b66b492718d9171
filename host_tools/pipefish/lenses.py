"""Camera models of other programs, for converting their files. Each is its published definition (docs/formats.md);
nothing in Pipefish measures with them: they become a pipefish.Camera, exactly where the family allows, else by a fit.

All in the frame of DESIGN: x right, y down, z forward; pixel centres at integers.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _engine

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

THETA_END = 3.1  # radians; no file describes a camera that sees behind itself, and phi means nothing there
_STEPS = 310
_PHIS = 360


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lens(abc.ABC):
    """A model with its image size. Subclasses say how points become pixels."""

    width: int
    height: int

    def ranges(self) -> dict[str, tuple[float, bool]]:
        """What the model's definition wants of its parameters: name -> (value, whether it is in range)."""
        return {}

    def wrong(self) -> tuple[str, str] | None:
        """The first parameter outside the model's definition, and the reason; None if all are within."""
        for name, (value, fine) in self.ranges().items():
            if not fine:
                return name, f"{value:g} is outside the definition of the model {type(self).__name__}"
        return None

    @abc.abstractmethod
    def project(self, points: Array) -> tuple[Array, Mask]:
        """(N, 3) -> (N, 2) pixels, (N,) whether the model holds there."""

    def exact(self) -> dict[str, Any] | None:
        """Arguments of the pipefish.Camera that is this lens to the last digit, or None where there is none."""
        return None


@dataclasses.dataclass(frozen=True, kw_only=True)
class CentredLens(Lens):
    """A lens whose pixel is an affine function of a normalised image point."""

    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0

    def ranges(self) -> dict[str, tuple[float, bool]]:
        return {"fx": (self.fx, self.fx > 0), "fy": (self.fy, self.fy > 0)}

    @abc.abstractmethod
    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        """The image point before focal length and principal point, and where it is valid."""

    def project(self, points: Array) -> tuple[Array, Mask]:
        with np.errstate(all="ignore"):
            a, b, ok = self.normalised(points[:, 0], points[:, 1], points[:, 2])
        pixels = np.stack([self.fx * a + self.skew * b + self.cx, self.fy * b + self.cy], axis=1)
        return pixels, ok & np.isfinite(pixels).all(axis=1)

    def _affine(self, scale: float = 1.0) -> dict[str, Any]:
        return {
            "f_u": self.fx * scale,
            "f_v": self.fy * scale,
            "skew": self.skew * scale,
            "c_u": self.cx,
            "c_v": self.cy,
        }


def _tangential(a: Array, b: Array, p1: float, p2: float) -> tuple[Array, Array]:
    square = a * a + b * b
    return 2 * p1 * a * b + p2 * (square + 2 * a * a), p1 * (square + 2 * b * b) + 2 * p2 * a * b


def _powers(square: Array, coefficients: tuple[float, ...]) -> Array:
    """1 + c0 s + c1 s^2 + ..."""
    total = np.zeros_like(square)
    for c in reversed(coefficients):
        total = (total + c) * square
    return 1 + total


def _angles(x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
    """theta and the unit vector of the azimuth (0, 0 on the axis)."""
    rho = np.hypot(x, y)
    safe = np.where(rho > 0, rho, 1)
    return np.arctan2(rho, z), x / safe, y / safe


@dataclasses.dataclass(frozen=True, kw_only=True)
class KannalaBrandt(CentredLens):
    """r = theta + k1 theta^3 + ... + k4 theta^9: OpenCV's fisheye, "equidistant", "equi", KB4, KB8."""

    k: tuple[float, ...] = (0.0,) * 4

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        theta, a, b = _angles(x, y, z)
        r = theta * _powers(theta**2, self.k)
        return r * a, r * b, np.ones(len(x), dtype=bool)

    def exact(self) -> dict[str, Any]:
        return {**self._affine(), **dict(zip(("k2", "k3", "k4", "k5"), self.k, strict=False))}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Perspective(CentredLens):
    """x / z with OpenCV's distortion: rational radial, tangential, thin prism (plumb_bob, radtan, Brown are parts)."""

    radial: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0,) * 4

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        a, b = x / z, y / z
        square = a * a + b * b
        factor = _powers(square, self.radial) / _powers(square, self.denominator)
        du, dv = _tangential(a, b, *self.tangential)
        s1, s2, s3, s4 = self.prism
        return a * factor + du + square * (s1 + s2 * square), b * factor + dv + square * (s3 + s4 * square), z > 0

    def exact(self) -> dict[str, Any] | None:
        distorted = any(self.radial + self.denominator + self.tangential + self.prism)
        return None if distorted else {**self._affine(), "radial": "perspective"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stereographic(CentredLens):
    """2 tan(theta / 2)."""

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        denominator = np.sqrt(x * x + y * y + z * z) + z
        return 2 * x / denominator, 2 * y / denominator, denominator > 0

    def exact(self) -> dict[str, Any]:
        return {**self._affine(), "radial": "stereographic"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldOfView(CentredLens):
    """Devernay and Faugeras: r = atan(2 tan(omega / 2) tan theta) / omega."""

    omega: float

    def ranges(self) -> dict[str, tuple[float, bool]]:
        return {**super().ranges(), "omega": (self.omega, 0 < self.omega < math.pi)}

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        theta, a, b = _angles(x, y, z)
        r = np.arctan(2 * math.tan(self.omega / 2) * np.tan(theta)) / self.omega
        return r * a, r * b, z > 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Unified(CentredLens):
    """Mei and Rives: unit sphere, then a pinhole xi behind its centre, then OpenCV's first distortion terms."""

    xi: float
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)

    def ranges(self) -> dict[str, tuple[float, bool]]:
        return {**super().ranges(), "xi": (self.xi, self.xi > -1)}

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        length = np.sqrt(x * x + y * y + z * z)
        denominator = z + self.xi * length
        a, b = x / denominator, y / denominator
        factor = _powers(a * a + b * b, self.radial)
        du, dv = _tangential(a, b, *self.tangential)
        return a * factor + du, b * factor + dv, (denominator > 0) & (length + self.xi * z > 0)

    def exact(self) -> dict[str, Any] | None:
        if any(self.radial + self.tangential) or self.xi < 0:
            return None
        return {**self._affine(1 / (1 + self.xi)), "radial": "unified", "mirror": self.xi}


@dataclasses.dataclass(frozen=True, kw_only=True)
class DoubleSphere(CentredLens):
    """Usenko, Demmel and Cremers 2018."""

    xi: float
    alpha: float

    def ranges(self) -> dict[str, tuple[float, bool]]:
        return {**super().ranges(), "xi": (self.xi, self.xi > -1), "alpha": (self.alpha, 0 <= self.alpha <= 1)}

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        d1 = np.sqrt(x * x + y * y + z * z)
        shifted = self.xi * d1 + z
        denominator = self.alpha * np.sqrt(x * x + y * y + shifted**2) + (1 - self.alpha) * shifted
        w1 = self.alpha / (1 - self.alpha) if self.alpha <= 0.5 else (1 - self.alpha) / self.alpha
        w2 = (w1 + self.xi) / math.sqrt(2 * w1 * self.xi + self.xi**2 + 1)
        return x / denominator, y / denominator, (z > -w2 * d1) & (denominator > 0)

    def exact(self) -> dict[str, Any] | None:
        if self.xi != 0 or self.alpha >= 1:
            return None
        return {**self._affine(), "radial": "unified", "mirror": self.alpha / (1 - self.alpha)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExtendedUnified(CentredLens):
    """Khomutenko, Garcia and Martinet 2016."""

    alpha: float
    beta: float

    def ranges(self) -> dict[str, tuple[float, bool]]:
        return {**super().ranges(), "alpha": (self.alpha, 0 <= self.alpha <= 1), "beta": (self.beta, self.beta > 0)}

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        denominator = self.alpha * np.sqrt(self.beta * (x * x + y * y) + z * z) + (1 - self.alpha) * z
        ok = denominator > 0
        if self.alpha > 0.5:
            ok &= z > denominator * (self.alpha - 1) / (2 * self.alpha - 1)
        return x / denominator, y / denominator, ok

    def exact(self) -> dict[str, Any] | None:
        if self.beta != 1 or self.alpha >= 1:
            return None
        return {**self._affine(), "radial": "unified", "mirror": self.alpha / (1 - self.alpha)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThinPrismFisheye(CentredLens):
    """COLMAP's THIN_PRISM_FISHEYE: an equidistant image point with radial, tangential and thin-prism distortion."""

    k: tuple[float, ...]
    tangential: tuple[float, float]
    prism: tuple[float, float]

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        theta, a, b = _angles(x, y, z)
        a, b = theta * a, theta * b
        square = a * a + b * b
        factor = _powers(square, self.k)
        du, dv = _tangential(a, b, *self.tangential)
        return a * factor + du + self.prism[0] * square, b * factor + dv + self.prism[1] * square, z > 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class RadialPolynomial(CentredLens):
    """r = c1 theta + c2 theta^2 + c3 theta^3 ..., even powers too (WoodScape)."""

    coefficients: tuple[float, ...]

    def ranges(self) -> dict[str, tuple[float, bool]]:
        return {**super().ranges(), "k1": (self.coefficients[0], self.coefficients[0] > 0)}

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        theta, a, b = _angles(x, y, z)
        r = theta * np.polyval(self.coefficients[::-1], theta)
        return r * a, r * b, np.ones(len(x), dtype=bool)

    def exact(self) -> dict[str, Any] | None:
        c1, odd = self.coefficients[0], self.coefficients[2::2]
        if any(self.coefficients[1::2]) or c1 <= 0 or len(odd) > 4:
            return None
        names = ("k2", "k3", "k4", "k5")
        return {**self._affine(c1), **{n: c / c1 for n, c in zip(names, odd, strict=False)}}


@dataclasses.dataclass(frozen=True, kw_only=True)
class OCam(Lens):
    """Scaramuzza: the image point (a, b) has the ray (a, b, f(rho)), rho = hypot(a, b), f = p0 + p1 rho + p2 rho^2 ..;
    (u, v) = stretch (a, b) + centre. p0 > 0: the axis looks into the scene."""

    polynomial: tuple[float, ...]
    cx: float
    cy: float
    stretch: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 0.0), (0.0, 1.0))

    def ranges(self) -> dict[str, tuple[float, bool]]:
        (a, b), (c, d) = self.stretch
        return {"stretch": (a * d - b * c, a * d - b * c > 0)}

    def _rho(self, theta: Array) -> tuple[Array, Mask]:
        """The smallest rho > 0 whose ray makes the angle theta with the axis, and whether there is one."""
        reach = 1.5 * math.hypot(max(self.cx, self.width - self.cx), max(self.cy, self.height - self.cy))
        grid = np.linspace(0, reach, 4096)
        angle = np.arctan2(grid, np.polyval(self.polynomial[::-1], grid))
        rising = np.append(np.diff(angle) > 0, False)
        end = int(np.argmin(rising)) + 1
        rho = np.interp(theta, angle[:end], grid[:end])
        slope = np.polyder(np.poly1d(self.polynomial[::-1]))
        for _ in range(6):
            f = np.polyval(self.polynomial[::-1], rho)
            step = (rho * np.cos(theta) - f * np.sin(theta)) / (np.cos(theta) - slope(rho) * np.sin(theta))
            rho = np.clip(rho - step, 0, grid[end - 1])
        return rho, theta <= angle[end - 1]

    def project(self, points: Array) -> tuple[Array, Mask]:
        theta, a, b = _angles(*points.T)
        rho, ok = self._rho(theta)
        pixels = np.stack([rho * a, rho * b], axis=1) @ np.array(self.stretch).T + np.array([self.cx, self.cy])
        return pixels, ok & np.isfinite(pixels).all(axis=1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplinedStereographic(CentredLens):
    """mrcal's splined model: u = stereographic(p), q = (u + spline(u)) f + c with B-splines of order 2 or 3 over a grid
    of control points (ny, nx, 2). region: polygon (n, 2) of pixels outside which the spline means nothing."""

    order: int
    fov_x: float  # radians
    control: Array
    region: Array | None = None

    def project(self, points: Array) -> tuple[Array, Mask]:
        pixels, ok = super().project(points)
        return pixels, ok if self.region is None else ok & _inside(self.region, pixels)

    def basis(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, tuple[Array, Array, Array, Array], Mask]:
        """u (N,), v (N,); first column and row of the control points in use, their weights (N, order + 1) each; ok."""
        ny, nx = self.control.shape[:2]
        denominator = np.sqrt(x * x + y * y + z * z) + z
        u, v = 2 * x / denominator, 2 * y / denominator
        per_unit = (nx - self.order) / (4 * math.tan(self.fov_x / 4))
        parts = []
        ok = denominator > 0
        for value, count in ((u, nx), (v, ny)):
            place = value * per_unit + (count - 1) / 2
            first = np.nan_to_num(np.floor(place) if self.order == 3 else np.floor(place + 0.5), nan=1.0)
            last = count - 3 if self.order == 3 else count - 2
            ok = ok & (first >= 1) & (first <= last)
            first = np.clip(first, 1, last)
            parts.append((first.astype(int) - 1, _bspline(place - first, self.order)))
        (ix, wx), (iy, wy) = parts
        return u, v, (ix, iy, wx, wy), ok

    def normalised(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Mask]:
        u, v, (ix, iy, wx, wy), ok = self.basis(x, y, z)
        span = np.arange(self.order + 1)
        patch = self.control[(iy[:, None] + span)[:, :, None], (ix[:, None] + span)[:, None, :]]
        delta = np.einsum("nj,ni,njik->nk", wy, wx, patch)
        return u + delta[:, 0], v + delta[:, 1], ok


@dataclasses.dataclass(frozen=True, kw_only=True)
class Generic(Lens):
    """The full generic model, of programs that have it: arguments of pipefish.Camera."""

    fields: dict[str, Any]

    def project(self, points: Array) -> tuple[Array, Mask]:
        profile = _engine.Profile()
        for key, value in {"width": self.width, "height": self.height, "theta_max": THETA_END, **self.fields}.items():
            setattr(profile, key, value)
        return profile.project(np.ascontiguousarray(points, dtype=np.float64))

    def exact(self) -> dict[str, Any]:
        return self.fields


def _inside(polygon: Array, pixels: Array) -> Mask:
    """Whether pixels (N, 2) lie in the polygon (n, 2): a line to the right crosses its sides an odd number of times."""
    inside = np.zeros(len(pixels), dtype=bool)
    x, y = pixels.T
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        with np.errstate(all="ignore"):
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def _bspline(t: Array, order: int) -> Array:
    """Weights (N, order + 1) of the uniform B-spline: t in 0..1 (cubic) or -1/2..1/2 (quadratic)."""
    if order == 2:
        return np.stack([(1 - 2 * t) ** 2 / 8, (3 - 4 * t * t) / 4, (1 + 2 * t) ** 2 / 8], axis=1)
    s = 1 - t
    return np.stack([s**3, 4 - 6 * t * t + 3 * t**3, 4 - 6 * s * s + 3 * s**3, t**3], axis=1) / 6


# ---- what an image sees of a lens


def rays(theta: Array, phi: Array) -> Array:
    """Unit rays (N, 3)."""
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1)


@dataclasses.dataclass(frozen=True)
class Field:
    """How far an image sees: theta_edge[i] along phi[i], radians, and whether it is the model that ends there. corners:
    the azimuths of the image's corners, which are among phi."""

    phi: Array
    theta_edge: Array
    model_ends: Mask
    corners: Array

    def edge(self, phi: Array) -> Array:
        """theta_edge between the samples."""
        return np.interp(phi % (2 * math.pi), self.phi, self.theta_edge, period=2 * math.pi)

    def within(self, theta: float) -> Field:
        """The part of the field at most theta off the axis."""
        ends = self.model_ends & (self.theta_edge <= theta)
        return Field(self.phi, np.minimum(self.theta_edge, theta), ends, self.corners)

    def sample(self, phis: int, thetas: int, start: float = 0.0) -> Array:
        """Rays ((phis + 4) * thetas, 3) over the field: azimuths from `start` and those of the corners, angles to the
        edge, which is included."""
        phi = np.append(start + 2 * math.pi * np.arange(phis) / phis, self.corners)
        theta = np.linspace(1 / thetas, 1, thetas)[None, :] * self.edge(phi)[:, None] * (1 - 1e-9)
        return rays(theta, np.broadcast_to(phi[:, None], theta.shape)).reshape(-1, 3)


def field_of(project: Any, width: int, height: int, end: float = THETA_END, in_image: Any = None) -> Field | None:
    """The field of `project` ((N,3) -> pixels, ok) in an image: along each azimuth up to where the pixel leaves the
    image, the model ends, or the pixel no longer moves outward. None if the axis is not in the image."""
    if in_image is None:

        def in_image(pixels: Array) -> Mask:
            return ((pixels > -0.5) & (pixels < [width - 0.5, height - 0.5])).all(axis=1)

    centre, ok = project(np.array([[0.0, 0.0, 1.0]]))
    if not ok[0] or not in_image(centre)[0]:
        return None

    def radius(theta: Array, azimuth: Array) -> tuple[Array, Mask, Mask]:
        pixels, valid = project(rays(theta.ravel(), azimuth.ravel()))
        with np.errstate(invalid="ignore"):
            lit = in_image(pixels)
        return np.hypot(*(pixels - centre).T).reshape(theta.shape), valid.reshape(theta.shape), lit.reshape(theta.shape)

    phi = 2 * math.pi * np.arange(_PHIS) / _PHIS
    edge, ends = _edge(radius, phi, end)
    pixels, _ = project(rays(edge, phi))
    place = np.unwrap(np.arctan2(*(pixels - centre).T[::-1]))  # of the pixel; not phi where the lens is asymmetric
    corner = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]]) - centre
    turns = (np.arctan2(corner[:, 1], corner[:, 0]) - place[0]) % (2 * math.pi)
    corners = np.interp(turns, np.append(place - place[0], 2 * math.pi), np.append(phi, 2 * math.pi)) % (2 * math.pi)
    more = _edge(radius, corners, end)
    order = np.argsort(np.append(phi, corners), kind="stable")
    return Field(
        np.append(phi, corners)[order], np.append(edge, more[0])[order], np.append(ends, more[1])[order], corners
    )


def _edge(radius: Any, phi: Array, end: float) -> tuple[Array, Mask]:
    """theta_edge and model_ends of a Field along phi; radius: (theta, phi) -> pixels off the centre, valid, lit."""
    theta = np.linspace(0, end, _STEPS + 1)
    grid = np.broadcast_to(theta[1:], (len(phi), _STEPS))
    r, valid, lit = radius(grid, np.broadcast_to(phi[:, None], grid.shape))
    with np.errstate(invalid="ignore"):
        valid &= np.diff(r, axis=1, prepend=0.0) > 0
    good = np.logical_and.accumulate(valid & lit, axis=1)
    last = good.sum(axis=1)  # index into theta
    low, high = theta[last], theta[np.minimum(last + 1, _STEPS)]
    for _ in range(40):  # to 1e-14 rad
        middle = (low + high) / 2
        r, valid, lit = radius(middle, phi)
        before, _, _ = radius(np.maximum(middle - 1e-5, 0), phi)
        with np.errstate(invalid="ignore"):
            fine = valid & lit & (r > before)
        low, high = np.where(fine, middle, low), np.where(fine, high, middle)
    r, valid, lit = radius(np.minimum(low + 2e-5, end), phi)
    before, _, _ = radius(low, phi)
    with np.errstate(invalid="ignore"):
        ends = (low >= end - 1e-9) | ~valid | ~(r > before)
    return low, ends
