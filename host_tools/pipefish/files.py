"""Writing files."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from .errors import file_error


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
