"""The survey files of one reception: which object goes into which file (docs/survey.md, "Several surveys")."""

from __future__ import annotations

import contextlib
import hashlib
import re
from itertools import count
from pathlib import Path
from typing import IO

from google.protobuf.message import DecodeError
from mcap.reader import make_reader

from pipefish import pipefish_pb2 as pb
from pipefish.errors import PipefishError, file_error
from pipefish.survey import Observations, check_numbers
from pipefish.surveywrite import (
    OBJECT_END,
    OBJECT_KEYFRAME,
    OBJECT_START,
    BootClock,
    BusyError,
    SurveyWriter,
    is_of,
    locked,
    partial_of,
    read_content,
)


def finished_survey_id(path: Path) -> bytes:
    """The survey in a finished file, from its metadata (the pictures are not read); b"" if it is no survey."""
    try:
        with open(path, "rb") as stream:
            for record in make_reader(stream).iter_metadata():
                if record.name == "pipefish":
                    return bytes.fromhex(record.metadata.get("survey_id", ""))
    except Exception:  # whatever it is, it is no survey that could be offered again
        return b""
    return b""


class SurveyStore:
    """The survey files of one `pipefish receive`.

    A device may first deliver what is left of earlier surveys. The survey that the device is working on (`primary`)
    gets the name that the user gave; every other one gets a name beside it: survey-2.mcap, survey-3.mcap, ...
    """

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        """`overwrite`: `path` and its partial file may be replaced; they are not touched before there is something to
        replace them with. A partial file of the survey that the device goes on to deliver is gone on with all the same:
        what it holds is no longer on the device.

        Raises PipefishError if `path` exists already and must not be overwritten, or another process writes it."""
        self.path = path
        self.writers: dict[bytes, SurveyWriter] = {}
        self.finished: dict[bytes, Path] = {}
        self.primary: bytes | None = None
        self._overwrite = overwrite
        self._names: set[bytes] = set()
        self._empty: dict[Path, SurveyWriter] = {}  # partial files without an object, by final name
        self._finished_before: dict[bytes, Path] = {}  # siblings that are complete
        if path.is_dir():
            raise PipefishError(f"{path} is a folder; name a file in it")
        if path.exists() and not overwrite:
            raise PipefishError(f"{path} exists already; choose another name or pass --overwrite")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise PipefishError(f"{path}: {path.parent} is not a folder") from None
        self._old: IO[bytes] | None = None  # a partial file to be replaced, locked until then
        try:
            if partial_of(path).exists():
                if overwrite:
                    self._old = locked(partial_of(path))
                else:
                    self._resume(SurveyWriter(path))
                    self.primary = next(iter(self.writers), None)
            self._look_at_siblings()
        except BaseException:
            self.close()
            raise

    def _look_at_siblings(self) -> None:
        """survey-2.mcap, survey-3.mcap, ... of earlier runs, whichever of them are still here."""
        pattern = re.compile(rf"{re.escape(self.path.stem)}-(\d+){re.escape(self.path.suffix)}(\.partial)?")
        found = {p: m for p in self.path.parent.iterdir() if (m := pattern.fullmatch(p.name)) and p.is_file()}
        for path in sorted(found, key=lambda p: int(found[p][1])):
            if found[path][2]:
                final = path.with_name(path.name.removesuffix(".partial"))
                with contextlib.suppress(BusyError):  # another reception, into a name of its own
                    if not final.exists():
                        self._resume(SurveyWriter(final))
            elif survey_id := finished_survey_id(path):
                self._finished_before[survey_id] = path

    def _resume(self, writer: SurveyWriter) -> None:
        self._names |= writer.content.names
        survey_id = writer.content.survey_id
        if not survey_id:
            self._empty[writer.path] = writer
        elif survey_id in self.writers:
            writer.close()  # one survey in two files: go on in the first
        else:
            self.writers[survey_id] = writer

    def _numbered(self, number: int) -> Path:
        return self.path if number == 1 else self.path.with_name(f"{self.path.stem}-{number}{self.path.suffix}")

    def choose_primary(self, survey_id: bytes) -> None:
        """Tells which survey the given name is for; the first call that is not empty holds."""
        if survey_id and self.primary is None:
            self.primary = survey_id
            if self._old is not None and is_of(partial_of(self.path), survey_id):
                self._release_old()
                self._resume(SurveyWriter(self.path, self._overwrite))

    def _release_old(self) -> None:
        if self._old is not None:
            self._old.close()
            self._old = None

    def has(self, name: bytes) -> bool:
        """Whether the object is stored durably."""
        return name in self._names

    @property
    def recovered(self) -> int:
        """Objects found in files of an earlier, interrupted run."""
        return sum(w.recovered for w in self.writers.values())

    def writer(self, survey_id: bytes) -> SurveyWriter:
        """The file of a survey; created at its first object."""
        if survey_id not in self.writers:
            self.choose_primary(survey_id)
        if survey_id in self.writers:
            return self.writers[survey_id]
        path, is_primary = self.path, survey_id == self.primary
        if not is_primary:
            path = next(p for p in map(self._numbered, count(2)) if p in self._empty or not self._is_taken(p))
        anew = is_primary and self._old is not None
        if anew:
            self._release_old()
        writer = self._empty.pop(path, None) or SurveyWriter(path, self._overwrite and is_primary, anew)
        if writer.content.survey_id not in (b"", survey_id):  # it was not there when we started
            writer.close()
            raise BusyError(f"{writer.partial} is of another survey, which another pipefish receive has begun")
        self.writers[survey_id] = writer
        self._names |= writer.content.names
        return writer

    def _is_taken(self, path: Path) -> bool:
        return path.exists() or partial_of(path).exists()

    def _in_finished(self, survey_id: bytes, name: bytes) -> bool:
        """Whether an object that is offered again is in a sibling that is complete."""
        path = self._finished_before.get(survey_id)
        if path is None:
            return False
        if survey_id not in self.finished:
            self._names |= read_content(path).names
            self.finished[survey_id] = path
        return name in self._names

    def store(self, name: bytes, kind: int, data: bytes, measured: dict[int, BootClock], now_unix_ns: int) -> bool:
        """Stores one object durably, unless it is stored already. False if the bytes do not match the name.

        measured  clocks that the link has measured, by boot id
        Raises PipefishError for an object that this version does not understand, or when it cannot be written: it stays
        on the device.
        """
        if hashlib.sha256(data).digest() != name:
            return False
        kinds = {OBJECT_START: pb.SurveyStart, OBJECT_KEYFRAME: pb.Keyframe, OBJECT_END: pb.SurveyEnd}
        try:
            message = kinds[kind].FromString(data)
            check_numbers(message)
            if kind == OBJECT_KEYFRAME:
                Observations.from_message(message.observations)
            if not message.survey_id:
                raise ValueError("no survey id")
        except (KeyError, DecodeError, ValueError) as error:
            raise PipefishError(
                f"the device sent an object (kind {kind}, {name.hex()[:16]}...) that this version of pipefish cannot "
                f"read: {error}; it stays on the device, update pipefish on both ends"
            ) from error
        if message.survey_id not in self.writers and self._in_finished(message.survey_id, name):
            return True
        writer = self.writer(message.survey_id)
        if name in self._names:
            return True
        writer.store(name, kind, message, len(data), measured.get(message.time.boot_id), now_unix_ns)
        self._names.add(name)
        return True

    def finish_complete(self, notes: dict[str, str]) -> list[Path]:
        """Gives every complete file its final name. Returns the new names.

        Raises the first PipefishError or OSError, after the other files."""
        done = []
        failure: Exception | None = None
        for survey_id, writer in list(self.writers.items()):
            if not writer.can_finish:
                continue
            try:
                writer.finish(notes)
            except (OSError, PipefishError) as error:
                failure = failure or file_error(error, writer.partial)
                continue
            self.finished[survey_id] = writer.path
            del self.writers[survey_id]
            done.append(writer.path)
        if failure is not None:
            raise failure
        return done

    def close(self) -> list[Path]:
        """Leaves what is not complete as partial files. Returns the names of those that hold something."""
        for writer in (*self.writers.values(), *self._empty.values()):
            writer.close()
        self._release_old()
        return [writer.partial for writer in self.writers.values()]
