"""Opening pictures, writing files, and what is written as JSON and CSV."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import FormatError, file_error

if TYPE_CHECKING:
    from PIL.Image import Image

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")  # how their names end


@contextlib.contextmanager
def opened_picture(path: str | os.PathLike[str]) -> Iterator[Image]:
    """A picture that Pillow has opened; its errors, also those of what is read of it meanwhile, are ours, with the
    file. Raises FormatError, OSError."""
    from PIL import Image, UnidentifiedImageError  # takes time, which --help has not

    try:
        with Image.open(path) as opened:
            yield opened
    except (UnidentifiedImageError, Image.DecompressionBombError, SyntaxError, ValueError, EOFError) as error:
        raise FormatError(path, None, f"not a picture: {error}") from None
    except OSError as error:
        if error.errno is None:  # Pillow's own, for a damaged file
            raise FormatError(path, None, f"not a whole picture: {error}") from None
        raise


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file that is there, on the disk, as a whole or not at all. A link stays a link, to a new file; what is
    no file (a device, a pipe) is written into, not replaced. Raises OSError that names `path`."""
    if path.exists() and not path.is_file() and not path.is_dir():
        try:
            path.write_bytes(data)
        except OSError as error:
            raise file_error(error, path) from error
        return
    path = path.resolve() if path.is_symlink() else path
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise file_error(error, path) from error
    finally:
        with contextlib.suppress(OSError):  # the folder may be no folder
            temporary.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """For JSON: lists and Python's numbers; what is not finite is null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if hasattr(value, "tolist"):  # arrays and numbers of NumPy, whose import would slow down --help
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def rounded(values: Iterable[float], digits: int = 4) -> list[float | None]:
    """Numbers for JSON, short; what is not finite is null: a gap in a chart."""
    return [round(float(v), digits) if math.isfinite(v) else None for v in values]


def csv_bytes(columns: dict[str, Any]) -> bytes:
    """A CSV table from columns of one length; what is not finite or None is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*(plain(c) for c in columns.values()), strict=True):
        writer.writerow(["" if v is None else f"{v:.9g}" if isinstance(v, float) else v for v in row])
    return stream.getvalue().encode()
