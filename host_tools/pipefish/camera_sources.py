"""Camera.from_...: cameras out of other programs' files and out of the parameters of other models."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import lenses
from .errors import ArgumentError, ProfileError

if TYPE_CHECKING:
    from .camera import Camera


class Sources:
    """Class methods of Camera, for the files of docs/formats.md. `Camera.load` tells the formats apart by itself; these
    say which one is meant. All raise ProfileError where the generic model cannot hold the other within max_error."""

    @classmethod
    def from_opencv_fisheye(
        cls, source: str | os.PathLike[str] | npt.ArrayLike, distortion: npt.ArrayLike | None = None, **options: Any
    ) -> Camera:
        """OpenCV's fisheye module: a YAML file, or its K (3, 3) and D (4,) with size=(width, height)."""
        from . import formats

        if distortion is None:
            return cls.load(source, form="opencv-fisheye", **options)  # type: ignore[arg-type]
        k, d = np.asarray(source, dtype=float), np.asarray(distortion, dtype=float).ravel()
        if k.shape != (3, 3) or d.shape != (4,) or "size" not in options:
            raise ArgumentError("from_opencv_fisheye: K must be (3, 3), D have 4 numbers, and size=(w, h) be given")
        if k[1, 0] != 0 or tuple(k[2]) != (0, 0, 1):
            raise ArgumentError(f"from_opencv_fisheye: K is [fx, s, cx], [0, fy, cy], [0, 0, 1], not {k.tolist()}")
        width, height = options.pop("size")
        core = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "skew": k[0, 1]}
        core = {name: float(value) for name, value in core.items()}
        lens = _lens(lenses.KannalaBrandt, {"width": width, "height": height, "k": tuple(d.tolist()), **core})
        return formats.from_lens(lens, **options).camera

    @classmethod
    def from_unified(cls, *, max_error: float = 0.1, max_theta: float | None = None, **parameters: Any) -> Camera:
        """The unified (Mei) model: width, height, fx, fy, cx, cy, xi, and where there is distortion skew, radial (k1,
        k2, ...), tangential (p1, p2); fx is Mei's gamma."""
        from . import formats

        return formats.from_lens(_lens(lenses.Unified, parameters), max_error=max_error, max_theta=max_theta).camera

    from_mei = from_unified

    @classmethod
    def from_double_sphere(cls, *, max_error: float = 0.1, max_theta: float | None = None, **parameters: Any) -> Camera:
        """The double sphere model: width, height, fx, fy, cx, cy, xi, alpha."""
        from . import formats

        lens = _lens(lenses.DoubleSphere, parameters)
        return formats.from_lens(lens, max_error=max_error, max_theta=max_theta).camera

    @classmethod
    def from_eucm(cls, *, max_error: float = 0.1, max_theta: float | None = None, **parameters: Any) -> Camera:
        """The extended unified model: width, height, fx, fy, cx, cy, alpha, beta."""
        from . import formats

        lens = _lens(lenses.ExtendedUnified, parameters)
        return formats.from_lens(lens, max_error=max_error, max_theta=max_theta).camera

    @classmethod
    def from_kannala_toolbox(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """The parameter vector of the toolbox of Kannala and Brandt. Options as of load; size=(width, height)."""
        return cls.load(path, form="toolbox", **options)

    @classmethod
    def from_opencv(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """OpenCV's calib3d, not fisheye: a YAML file. Options as of load."""
        return cls.load(path, form="opencv", **options)

    @classmethod
    def from_opencv_omnidir(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """OpenCV's omnidir: a YAML file. Options as of load."""
        return cls.load(path, form="opencv-omnidir", **options)

    @classmethod
    def from_ros(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """ROS: camera_info as YAML. Options as of load."""
        return cls.load(path, form="ros", **options)

    @classmethod
    def from_kalibr(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """Kalibr: a camchain. Options as of load."""
        return cls.load(path, form="kalibr", **options)

    @classmethod
    def from_colmap(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """COLMAP: cameras.txt. Options as of load."""
        return cls.load(path, form="colmap", **options)

    @classmethod
    def from_basalt(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """basalt: calibration.json. Options as of load."""
        return cls.load(path, form="basalt", **options)

    @classmethod
    def from_orbslam3(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """ORB-SLAM3: settings. Options as of load."""
        return cls.load(path, form="orbslam3", **options)

    @classmethod
    def from_stella(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """stella_vslam: configuration. Options as of load."""
        return cls.load(path, form="stella", **options)

    @classmethod
    def from_svo(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """SVO: a camera rig. Options as of load."""
        return cls.load(path, form="svo", **options)

    @classmethod
    def from_ocam(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """OCamCalib: calib_results.txt. Options as of load."""
        return cls.load(path, form="ocam", **options)

    @classmethod
    def from_pyocamcalib(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """py-OCamCalib: JSON. Options as of load."""
        return cls.load(path, form="pyocamcalib", **options)

    @classmethod
    def from_boofcv(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """BoofCV: YAML. Options as of load."""
        return cls.load(path, form="boofcv", **options)

    @classmethod
    def from_woodscape(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """WoodScape: JSON. Options as of load."""
        return cls.load(path, form="woodscape", **options)

    @classmethod
    def from_mrcal(cls, path: str | os.PathLike[str], **options: Any) -> Camera:
        """mrcal: .cameramodel. Options as of load."""
        return cls.load(path, form="mrcal", **options)


def _lens(kind: Any, parameters: dict[str, Any]) -> Any:
    try:
        lens = kind(**parameters)
    except TypeError as error:
        raise ArgumentError(f"{kind.__name__}: {str(error).partition('() ')[2] or error}") from None
    if wrong := lens.wrong():
        raise ProfileError(None, *wrong)
    return lens
