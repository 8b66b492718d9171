"""`pipefish undistort`: pictures, folders of them and Y4M recordings as views (pipefish.views)."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from PIL import Image

from .camera import Camera
from .errors import ArgumentError, FormatError, PipefishError, file_error
from .files import PICTURES, opened_picture, write_atomically
from .progress import Progress, track
from .views import FAR, Remap, remap, rotation, vertical_fov, view_rays

Picture = npt.NDArray[np.uint8]
_PLANES = {"mono": 0, "420": 1, "420jpeg": 1, "420mpeg2": 1, "420paldv": 1}  # and whether colour follows


def undistort(
    source: Path,
    out: Path,
    camera: Camera,
    *,
    view: str = "perspective",
    fov: float | None = None,
    size: tuple[int, int] | None = None,
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    distance: float = FAR,
    mask: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Writes the view of a picture, of each picture of a folder, or of each frame of a Y4M file; each output is there
    as a whole or not at all.

    fov: across the view's width, degrees [90; cylinder and equirect: 180]; size: width, height [that of the picture;
    cube: the edge of a face, half the picture's smaller side]; turn: yaw, pitch, roll of the view, degrees; mask: a
    picture to write, white where the camera sees.
    Returns what was written. Raises ArgumentError, before all work, for a view that cannot be and for a name to write
    that is no picture's; FormatError for input that is no picture or not of the camera's size, OSError.
    """
    if view == "cube" and size is not None and size[0] != size[1]:
        raise ArgumentError(f"the faces of a cube are square, not {size[0]} x {size[1]}")
    if fov is None:
        fov = 90.0 if view in ("perspective", "cube") else 180.0
    one = not source.is_dir() and source.suffix.lower() != ".y4m"
    for path in ([out] if one else []) + ([mask] if mask is not None else []):
        if path.suffix.lower() not in PICTURES:
            raise ArgumentError(f"{path}: a picture's name ends in {', '.join(PICTURES)}")
    width, height = size or (camera.width, camera.height)
    if view == "cube" and size is None:
        width = height = min(camera.width, camera.height) // 2
    table = remap(camera, view_rays(view, width, height, fov), rotation(*turn), distance)
    if not table.valid.any():
        raise PipefishError("the camera sees nothing of this view: turn it or widen it")
    rows, columns = table.valid.shape
    if source.is_dir():
        count = _folder(source, out, camera, table, quiet)
    elif source.suffix.lower() == ".y4m":
        count = _recording(source, out, camera, table, quiet)
    else:
        write_atomically(out, _encode(table.apply(_open(source, camera)), out))
        count = 1
    if mask is not None:
        write_atomically(mask, _encode((table.valid * np.uint8(255)).astype(np.uint8), mask))
    return {
        "file": str(out),
        "mask": None if mask is None else str(mask),
        "pictures": count,
        "view": view,
        "fov_deg": fov if view != "cube" else 90.0,
        "vertical_fov_deg": vertical_fov(view, width, height, fov),
        "width": columns,
        "height": rows,
        "valid": float(table.valid.mean()),
        "most_samples_per_pixel": int(table.count[table.valid].max()) ** 2,
        "exact_at_m": distance if camera.pupil_e1 and distance < FAR else None,
        "pupil_shift_m": camera.pupil_e1,
    }


def _encode(picture: Picture, path: Path) -> bytes:
    out = io.BytesIO()
    options = {"quality": 95} if path.suffix.lower() in (".jpg", ".jpeg", ".webp") else {}
    Image.fromarray(picture).save(out, Image.registered_extensions()[path.suffix.lower()], **options)
    return out.getvalue()


def _open(path: Path, camera: Camera) -> Picture:
    with opened_picture(path) as opened:
        picture = np.asarray(opened if opened.mode in ("L", "RGB") else opened.convert("RGB"))
    _check_size(path, picture.shape[1], picture.shape[0], camera)
    return picture


def _check_size(path: Path, width: int, height: int, camera: Camera) -> None:
    if (width, height) != (camera.width, camera.height):
        reason = f"{width} x {height} pixels, but the profile is for {camera.width} x {camera.height}"
        raise FormatError(path, None, reason)


def _folder(source: Path, out: Path, camera: Camera, table: Remap, quiet: bool) -> int:
    pictures = sorted(p for p in source.iterdir() if p.suffix.lower() in PICTURES and p.is_file())
    if not pictures:
        raise FormatError(source, None, f"no pictures ({', '.join(PICTURES)})")
    if out.exists():
        raise PipefishError(f"{out}: is there already; a folder is not overwritten")
    partial = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        partial.mkdir(parents=True)
        for picture in track(pictures, "undistorting", len(pictures), quiet):
            target = partial / picture.name
            target.write_bytes(_encode(table.apply(_open(picture, camera)), target))
        os.replace(partial, out)
    except OSError as error:
        raise file_error(error, out) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(pictures)


def _recording(source: Path, out: Path, camera: Camera, table: Remap, quiet: bool) -> int:
    if out.suffix.lower() != ".y4m":
        raise PipefishError(f"{out}: the view of a recording is a recording: a name that ends in .y4m")
    partial = out.with_name(f".{out.name}.{os.getpid()}")
    try:
        with open(source, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            fields, colour = _header(stream, source, camera)
            rows, columns = table.valid.shape
            if colour and (rows % 2 or columns % 2 or camera.width % 2 or camera.height % 2):
                raise FormatError(source, "header", "colour at half the size wants even widths and heights")
            count = 0
            with open(partial, "wb") as target, Progress("undistorting", size, quiet) as bar:
                rest = [f for f in fields if f[:1] not in ("W", "H")]
                target.write(f"YUV4MPEG2 W{columns} H{rows} {' '.join(rest)}".rstrip().encode() + b"\n")
                for luma, chroma in _frames(stream, source, camera, colour):
                    target.write(b"FRAME\n" + table.apply(luma).tobytes())
                    for plane in chroma:
                        target.write(_half(table, plane).tobytes())
                    count += 1
                    bar.update(stream.tell(), f"{count} frames")
        if not count:
            raise FormatError(source, None, "no frames")
        os.replace(partial, out)
    except OSError as error:
        raise file_error(error, source if error.filename == os.fspath(source) else out) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
    return count


def _header(stream: BinaryIO, path: Path, camera: Camera) -> tuple[list[str], int]:
    """The header's fields, and whether planes of colour follow the grey one."""
    line = stream.readline(512)
    magic, *fields = line.decode("ascii", "replace").split()
    if magic != "YUV4MPEG2" or not line.endswith(b"\n"):
        raise FormatError(path, "header", "not a Y4M file")
    values = {f[0]: f[1:] for f in fields}
    try:
        width, height = int(values["W"]), int(values["H"])
    except (KeyError, ValueError):
        raise FormatError(path, "header", "no width and height") from None
    space = values.get("C", "420")
    if space not in _PLANES:
        raise FormatError(path, "header", f"the colour space {space:.20} is not read: {', '.join(_PLANES)}")
    _check_size(path, width, height, camera)
    return fields, _PLANES[space]


def _frames(stream: BinaryIO, path: Path, camera: Camera, colour: int) -> Iterator[tuple[Picture, list[Picture]]]:
    width, height = camera.width, camera.height
    shapes = [(height, width)] + [(height // 2, width // 2)] * (2 * colour)
    number = 0
    while line := stream.readline(256):
        if not line.startswith(b"FRAME") or not line.endswith(b"\n"):
            raise FormatError(path, f"frame {number}", "does not begin with FRAME")
        planes = []
        for shape in shapes:
            data = stream.read(shape[0] * shape[1])
            if len(data) != shape[0] * shape[1]:
                raise FormatError(path, f"frame {number}", "cut off")
            planes.append(np.frombuffer(data, dtype=np.uint8).reshape(shape))
        yield planes[0], planes[1:]
        number += 1


def _half(table: Remap, plane: Picture) -> Picture:
    """A colour plane of half the size, through the view at full size; grey (128) where nothing is seen."""
    full = table.apply(plane.repeat(2, axis=0).repeat(2, axis=1)).astype(np.uint16)
    full[~table.valid] = 128
    return ((full[::2, ::2] + full[1::2, ::2] + full[::2, 1::2] + full[1::2, 1::2] + 2) // 4).astype(np.uint8)
