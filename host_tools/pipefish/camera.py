"""The camera: Kannala and Brandt's generic model, evaluated by the C core, and its profile as JSON and as binary.

docs/profile.md describes the parameters and the JSON form, lib/profile/SPEC.md the binary form.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _engine, profile_json
from .camera_sources import Sources
from .errors import ArgumentError, ProfileError
from .files import write_atomically
from .profile_json import (
    ARRAYS,
    CIRCLE,
    INTEGERS,
    PROVENANCE,
    RESIDUALS,
    SCALARS,
    TEXTS,
    integer,
    number,
    number_list,
    text,
)

# In the order of pf_radial and pf_profile_source.
_RADIAL = ("generic", "perspective", "stereographic", "equidistant", "equisolid", "orthographic", "unified")
_SOURCE = ("unknown", "target", "selfcal", "imported", "simulated")


#: What the core calls the keys of `provenance`.
_PLACES = {place: f"provenance.{key}" for key, place in PROVENANCE.items()}


def _indexed(name: str) -> list[str]:
    return [f"{name}[{i}]" for i in range(ARRAYS[name])]


#: Names of the parameters that may be free, at their number in the binary form.
PARAMETERS: tuple[str, ...] = (
    *("f_u", "f_v", "skew", "c_u", "c_v", "k2", "k3", "k4", "k5"),
    *_indexed("asym_radial_theta"),
    *_indexed("asym_radial_phi"),
    *_indexed("asym_tangential_theta"),
    *_indexed("asym_tangential_phi"),
    *_indexed("tilt"),
    *("mirror", "pupil_e1"),
    *_indexed("cpoly"),
)


def _choice(key: str, value: object, choices: Sequence[str]) -> int:
    if not isinstance(value, str) or value not in choices:
        raise ProfileError(None, key, f"{value!r:.60} is none of {', '.join(choices)}")
    return choices.index(value)


def _rows(what: str, array: npt.ArrayLike, columns: int) -> npt.NDArray[np.float64]:
    """(N, columns) numbers as a contiguous float64 array, or ArgumentError."""
    try:
        given = np.asarray(array)
    except ValueError:
        raise ArgumentError(f"{what}: rows of different lengths; expected shape (N, {columns})") from None
    if given.dtype.kind not in "fiu":
        raise ArgumentError(f"{what}: expected real numbers, got dtype {given.dtype}")
    if given.ndim != 2 or given.shape[1] != columns:
        raise ArgumentError(f"{what}: expected shape (N, {columns}), got {given.shape}")
    return np.ascontiguousarray(given, dtype=np.float64)


def _split(error: ValueError) -> ProfileError:
    """The core says 'field: reason'."""
    key, _, reason = str(error).partition(": ")
    return ProfileError(None, _PLACES.get(key, key), reason)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a calibration comes from. Texts "" and counts 0: unknown."""

    tool: str = ""  #: program that made it, at most 31 bytes
    version: str = ""  #: of the tool, at most 31 bytes
    model_choice: str = ""  #: how the model was chosen, at most 63 bytes
    views: int = 0  #: images that were used
    points: int = 0  #: measured points in them
    held_out_views: int = 0  #: images that held_out_rms_px is of


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Camera(Sources):
    """One calibrated camera. Immutable; use dataclasses.replace() for a changed copy.

    Pixels: the centre of the top-left pixel is (0, 0), u right, v down. Camera frame: x right, y down, z along the
    optical axis. Angles in radians, lengths in metres. f_u and f_v are in pixels per radian on the axis.
    covariance is (n, n) over covariance_parameters, names out of PARAMETERS in their order; None = unknown.

    Raises ProfileError, with the name of the argument, for a camera that is not valid or not supported.
    """

    width: int
    height: int
    f_u: float
    f_v: float
    c_u: float
    c_v: float
    theta_max: float
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    skew: float = 0.0
    radial: str = "generic"
    tilt: tuple[float, ...] = (0.0,) * 2
    asym_radial_theta: tuple[float, ...] = (0.0,) * 3
    asym_radial_phi: tuple[float, ...] = (0.0,) * 4
    asym_tangential_theta: tuple[float, ...] = (0.0,) * 3
    asym_tangential_phi: tuple[float, ...] = (0.0,) * 4
    cpoly: tuple[float, ...] = (0.0,) * 14
    mirror: float = 0.0
    pupil_e1: float = 0.0
    circle_u: float = 0.0
    circle_v: float = 0.0
    circle_radius: float = 0.0
    name: str = ""
    serial: str = ""
    lens: str = ""
    source: str = "unknown"
    created: datetime.datetime | None = None
    rms_px: float | None = None
    held_out_rms_px: float | None = None
    theta_covered: float | None = None
    provenance: Provenance = Provenance()
    covariance_parameters: tuple[str, ...] = ()
    covariance: npt.NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        profile = _engine.Profile()

        def put(key: str, value: Any) -> None:
            object.__setattr__(self, key, value)
            setattr(profile, key, value)

        try:
            for key in INTEGERS:
                put(key, integer(key, getattr(self, key)))
            for key in SCALARS + CIRCLE:
                put(key, number(key, getattr(self, key)))
            for key, count in ARRAYS.items():
                put(key, number_list(key, getattr(self, key), count))
            for key in TEXTS:
                put(key, text(key, getattr(self, key)))
            profile.radial = _choice("radial", self.radial, _RADIAL)
            profile.source = _choice("source", self.source, _SOURCE)
            profile.created_unix_s = self._created_unix_s()
            for key in RESIDUALS:
                setattr(profile, key, math.nan)
                if getattr(self, key) is not None:
                    put(key, number(key, getattr(self, key)))
            if self.theta_covered is not None:
                put("theta_covered", number("theta_covered", self.theta_covered))
                object.__setattr__(self, "theta_covered", self.theta_covered or None)
            self._set_provenance(profile)
            self._set_covariance(profile)
            profile.encode()
        except ValueError as error:
            raise _split(error) from None
        object.__setattr__(self, "_profile", profile)

    def _created_unix_s(self) -> int:
        if self.created is None:
            return 0
        if not isinstance(self.created, datetime.datetime) or self.created.tzinfo is None:
            raise ProfileError(None, "created", "not a time with its time zone")
        object.__setattr__(self, "created", self.created.astimezone(datetime.UTC).replace(microsecond=0))
        seconds = int(self.created.timestamp())
        if seconds <= 0:
            raise ProfileError(None, "created", "not after 1970")
        return seconds

    def _set_provenance(self, profile: Any) -> None:
        if not isinstance(self.provenance, Provenance):
            raise ProfileError(None, "provenance", "not a Provenance")
        for key, place in PROVENANCE.items():
            check = integer if place in ("views", "points", "held_out_views") else text
            setattr(profile, place, check(f"provenance.{key}", getattr(self.provenance, key)))

    def _set_covariance(self, profile: Any) -> None:
        names = self.covariance_parameters
        if not isinstance(names, Sequence) or isinstance(names, str):
            raise ProfileError(None, "covariance_parameters", "not a list of names")
        for name in names:
            if name not in PARAMETERS:
                raise ProfileError(None, "covariance_parameters", f"{name!r:.60} is no parameter")
        names = tuple(names)
        places = [PARAMETERS.index(name) for name in names]
        if places != sorted(set(places)):
            raise ProfileError(None, "covariance_parameters", "a name twice, or not in the order of the parameters")
        object.__setattr__(self, "covariance_parameters", names)
        if self.covariance is None:
            if names:
                raise ProfileError(None, "covariance", "missing for its parameters")
            return
        try:
            matrix = np.array(self.covariance, dtype=np.float64)
        except (TypeError, ValueError):
            raise ProfileError(None, "covariance", "not a matrix of numbers") from None
        if not names or matrix.shape != (len(names), len(names)):
            raise ProfileError(None, "covariance", f"not {len(names)} x {len(names)} as its parameters say")
        if not np.isfinite(matrix).all():
            raise ProfileError(None, "covariance", "not finite")
        sigma = np.sqrt(np.abs(matrix.diagonal()))
        if (np.abs(matrix - matrix.T) > 1e-9 * np.outer(sigma, sigma)).any():
            raise ProfileError(None, "covariance", "not symmetric")
        lower = np.tril_indices(len(names))
        matrix.T[lower] = matrix[lower]
        matrix.setflags(write=False)
        object.__setattr__(self, "covariance", matrix)
        profile.set_covariance(places, matrix[lower].tolist())

    # ------------------------------------------------------------------ model

    def project(self, points: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Points in the camera frame, (N, 3) metres -> pixels (N, 2), ok (N,).

        A pixel is NaN where ok is False: beyond theta_max, the origin, or not finite. A pixel may lie off the image.
        """
        return self._profile.project(_rows("points", points, 3))

    def unproject(self, pixels: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Pixels (N, 2) -> unit rays in the camera frame (N, 3), ok (N,).

        A ray is NaN where ok is False: beyond theta_max, or not finite.
        """
        return self._profile.unproject(_rows("pixels", pixels, 2))

    def origins(self, pixels: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Where the rays of pixels (N, 2) start, (N, 3) metres in the camera frame: zero for a central camera, else NaN
        where there is no ray."""
        given = _rows("pixels", pixels, 2)
        return self._profile.origins(given) if self.pupil_e1 else np.zeros((len(given), 3))

    def in_image(self, pixels: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether pixels (N, 2) lie on the sensor and inside the image circle, (N,)."""
        return self._profile.in_image(_rows("pixels", pixels, 2))

    def project_jacobian(
        self, points: npt.ArrayLike
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """As project, with derivatives: pixels (N, 2), ok (N,), by the point (N, 2, 3), by PARAMETERS (N, 2, 41).

        Everything is NaN where ok is False. Derivatives by a parameter are there also where it is zero now.
        """
        return self._profile.project_jacobian(_rows("points", points, 3))

    @classmethod
    def fit(
        cls, rays: npt.ArrayLike, pixels: npt.ArrayLike, size: tuple[int, int], model: str = "p9", **more: Any
    ) -> tuple[Camera, Any]:
        """The generic camera that sees `rays` (N, 3) at `pixels` (N, 2), and how well; see pipefish.fit.fit_camera."""
        from .fit import fit_camera

        return fit_camera(rays, pixels, size, model, **more)

    def to_generic(self, model: str = "p9", *, max_theta: float | None = None) -> tuple[Camera, Any]:
        """This camera with the radial polynomial (and with model "p23" or "cpoly" its asymmetric terms) fitted over the
        image, and how well it fits: pipefish.fit.Fit."""
        from .formats.convert import generic

        return generic(self, model, max_theta)

    # ------------------------------------------------------------------ files

    def to_binary(self) -> bytes:
        """The binary form that devices store."""
        return self._profile.encode()

    @classmethod
    def from_binary(cls, data: bytes) -> Camera:
        """Reads the binary form. Raises ProfileError, with the field, for anything but one intact profile."""
        try:
            profile = _engine.Profile.decode(bytes(data))
        except ValueError as error:
            raise _split(error) from None
        values = {key: getattr(profile, key) for key in (*INTEGERS, *SCALARS, *CIRCLE, *ARRAYS, *TEXTS)}
        values |= {key: getattr(profile, key) for key in RESIDUALS if not math.isnan(getattr(profile, key))}
        names = tuple(PARAMETERS[i] for i in profile.free_param)
        if names:
            covariance = np.zeros((len(names), len(names)))
            rows, columns = np.tril_indices(len(names))
            covariance[rows, columns] = covariance[columns, rows] = profile.covariance
            values |= {"covariance_parameters": names, "covariance": covariance}
        if profile.created_unix_s:
            values["created"] = datetime.datetime.fromtimestamp(profile.created_unix_s, datetime.UTC)
        return cls(
            radial=_RADIAL[profile.radial],
            source=_SOURCE[profile.source],
            provenance=Provenance(**{key: getattr(profile, place) for key, place in PROVENANCE.items()}),
            theta_covered=profile.theta_covered or None,
            **values,
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """Reads a profile, JSON or binary, or the calibration file of another program, whatever its name.

        Other programs' models become ours exactly or by a fit; docs/formats.md lists them, pipefish.formats.load also
        tells how well it fits and takes the same options: camera, size, max_error, max_theta, form.
        Raises ProfileError with the file, the key and the reason.
        """
        from .formats import load

        return load(path, **options).camera

    @classmethod
    def load_json(cls, path: str | os.PathLike[str]) -> Camera:
        """Reads a profile in JSON. Raises ProfileError with the file, the key and the reason."""
        return cls._made(path, lambda: profile_json.read(path))

    @classmethod
    def from_document(cls, document: Mapping[str, Any], source: str | os.PathLike[str]) -> Camera:
        """From what `to_json` writes, parsed; source: the file, for errors. Raises ProfileError."""
        return cls._made(source, lambda: profile_json.values_of(document))

    @classmethod
    def _made(cls, source: str | os.PathLike[str], values_of: Callable[[], dict[str, Any]]) -> Camera:
        try:
            values = values_of()
            return cls(**values | {"provenance": Provenance(**values.get("provenance", {}))})
        except ProfileError as error:
            key = "covariance.parameters" if error.key == "covariance_parameters" else error.key
            raise ProfileError(source, key, error.reason) from None

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the profile as JSON; the file appears whole or not at all. Raises OSError where it cannot."""
        write_atomically(Path(path), self.to_json().encode())

    def to_json(self) -> str:
        """The JSON form that people read, as `save` writes it."""
        return profile_json.write(self)

    # ------------------------------------------------------------------ object

    def __repr__(self) -> str:
        parts = [
            *([repr(self.name)] if self.name else []),
            f"{self.width}x{self.height}",
            f"f=({self.f_u:.2f}, {self.f_v:.2f})",
            f"c=({self.c_u:.2f}, {self.c_v:.2f})",
            f"k=({self.k2:.4g}, {self.k3:.4g}, {self.k4:.4g}, {self.k5:.4g})",
            f"theta_max={math.degrees(self.theta_max):.2f} deg",
            *([] if self.rms_px is None else [f"rms={self.rms_px:.3f} px"]),
        ]
        return f"Camera({', '.join(parts)})"

    def __eq__(self, other: object) -> bool:
        return self.to_binary() == other.to_binary() if isinstance(other, Camera) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.to_binary())

    def __reduce__(self) -> tuple[Any, tuple[bytes]]:
        return Camera.from_binary, (self.to_binary(),)
