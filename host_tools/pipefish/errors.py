"""The exceptions that Pipefish raises. Catch PipefishError for all of them; str() is one line for people."""

from __future__ import annotations

import os


class PipefishError(Exception):
    """Base of every exception that Pipefish raises on purpose."""


class ArgumentError(PipefishError, ValueError):
    """A call that is wrong in itself: an array of the wrong shape or type, a value out of range."""


class FormatError(PipefishError):
    """A file, or data without a file, that is not what it must be.

    path: the file, or None for data from memory. position: where in it (line, byte, key), or None for the whole.
    """

    def __init__(self, path: str | os.PathLike[str] | None, position: str | int | None, reason: str) -> None:
        self.path = None if path is None else os.fspath(path)
        self.position = position
        self.reason = reason
        parts = [self.path, None if position is None else str(position), reason]
        super().__init__(": ".join(part for part in parts if part is not None))

    def __reduce__(self) -> tuple[type, tuple[str | None, str | int | None, str]]:
        return type(self), (self.path, self.position, self.reason)


class ProfileError(FormatError):
    """A camera profile that cannot be used. key: the entry at fault, or None for the whole."""

    @property
    def key(self) -> str | int | None:
        """The entry at fault; the same as position."""
        return self.position


def file_error(error: Exception, path: str | os.PathLike[str]) -> Exception:
    """An OSError as one about the file that the user knows; any other exception as it is."""
    if isinstance(error, OSError) and error.errno is not None:
        return OSError(error.errno, error.strerror, os.fspath(path))
    return error
