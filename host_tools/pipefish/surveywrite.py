"""Writing surveys durably: each object of the device becomes one MCAP chunk, on disk before it is acknowledged.

docs/survey.md has the layout. One chunk an object means that an object is in the file as a whole or not at all,
whatever the moment of a power cut: a chunk carries its length and checksum.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from mcap.records import Channel, Message
from mcap.writer import CompressionType, Writer

from pipefish import __version__
from pipefish import pipefish_pb2 as pb
from pipefish.colours import age_colours
from pipefish.errors import FormatError, PipefishError, file_error
from pipefish.mcapscan import McapScan
from pipefish.survey import UNKNOWN_ERROR_NS, UPTIME_MAX_NS, Observations, check_numbers, lost_indices

FORMAT_VERSION = 1  # of the layout in docs/survey.md
OBJECT_START, OBJECT_KEYFRAME, OBJECT_END = 1, 2, 3  # pf_object_kind

# Topic, message: registered in this order in every file.
CHANNELS: list[tuple[str, Descriptor]] = [
    ("/survey/start", pb.SurveyStart.DESCRIPTOR),
    ("/survey/end", pb.SurveyEnd.DESCRIPTOR),
    ("/camera", CompressedImage.DESCRIPTOR),
    ("/camera/tracks", ImageAnnotations.DESCRIPTOR),
    ("/keyframe", pb.Keyframe.DESCRIPTOR),
    ("/status", pb.Status.DESCRIPTOR),
    ("/receipt", pb.Receipt.DESCRIPTOR),
]


def descriptor_set(descriptor: Descriptor) -> bytes:
    """The schema of a message with all it imports, as MCAP wants it."""
    files = FileDescriptorSet()
    done: set[str] = set()

    def add(file: FileDescriptor) -> None:
        if file.name not in done:
            done.add(file.name)
            for dependency in file.dependencies:
                add(dependency)
            file.CopyToProto(files.file.add())

    add(descriptor.file)
    return files.SerializeToString(deterministic=True)


def fsync_folder(path: Path) -> None:
    """Makes a new or renamed entry of `path`'s folder durable."""
    handle = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class BusyError(PipefishError):
    """Another process is writing the file."""


def locked(path: Path, create: bool = False) -> IO[bytes]:
    """Opens a file that is being received, locked against another `pipefish receive`; closing it unlocks.

    create  the file must not exist yet
    Raises BusyError when another process writes it; OSError.
    """
    while True:
        try:
            file: IO[bytes] = open(path, "xb" if create else "r+b")  # noqa: SIM115 - lives as long as its writer
        except FileExistsError:
            raise BusyError(f"another pipefish receive is writing {path}") from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            if isinstance(error, BlockingIOError):
                raise BusyError(f"another pipefish receive is writing {path}") from None
            raise OSError(error.errno, f"cannot be locked: {error.strerror}", str(path)) from error
        if create or is_at(file, path):
            return file
        file.close()  # recovered by another process between our open and our lock: take what is there now


def is_at(file: IO[bytes], path: Path) -> bool:
    """Whether `path` still names this open file."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def annotations(observations: Observations, timestamp_ns: int) -> ImageAnnotations:
    """The tracks of one keyframe as points coloured by age, for Foxglove's image panel."""
    message = ImageAnnotations()
    message.timestamp.FromNanoseconds(timestamp_ns)
    points = PointsAnnotation(type=PointsAnnotation.POINTS, thickness=3.0)
    points.timestamp.FromNanoseconds(timestamp_ns)
    for (x, y), colour in zip(observations.xy, age_colours(observations.age), strict=True):
        points.points.add(x=x + 0.5, y=y + 0.5)  # Foxglove's origin is the corner of the first pixel, ours its centre
        points.outline_colors.add(r=colour[0] / 255, g=colour[1] / 255, b=colour[2] / 255, a=1.0)
    message.points.append(points)
    return message


@dataclass
class BootClock:
    """Maps the monotonic clock of one boot to wall time: unix = monotonic + offset_ns, within error_ns."""

    offset_ns: int
    error_ns: int


@dataclass
class Content:
    """What a survey file holds so far."""

    names: set[bytes] = field(default_factory=set)  # SHA-256 of the objects
    indices: set[int] = field(default_factory=set)
    start: pb.SurveyStart | None = None
    end: pb.SurveyEnd | None = None
    survey_id: bytes = b""
    object_bytes: int = 0
    clocks: dict[int, BootClock] = field(default_factory=dict)
    first_received_ns: int = 0

    @property
    def complete(self) -> bool:
        """Whether nothing more is to come: start, end, and every keyframe that the device did not lose."""
        return self.start is not None and self.end is not None and not self.missing

    @property
    def missing(self) -> list[int]:
        """Keyframes that the device made and did not lose, and that are not here; [] before the survey's end."""
        if self.end is None:
            return []
        return sorted(set(range(self.end.keyframes)) - self.indices - lost_indices(self.end))

    @property
    def lost(self) -> int:
        """Number of keyframes that the device lost."""
        return len(lost_indices(self.end) - self.indices) if self.end else 0

    def note(self, topic: str, data: bytes) -> None:
        """Takes in one message of the file. Raises DecodeError, ValueError."""
        match topic:
            case "/survey/start":
                start = pb.SurveyStart.FromString(data)
                check_numbers(start)
                self.start = self.start or start
                self.survey_id = start.survey_id
            case "/survey/end":
                end = pb.SurveyEnd.FromString(data)
                check_numbers(end)
                self.end = end
                self.survey_id = end.survey_id
            case "/keyframe":
                keyframe = pb.Keyframe.FromString(data)
                check_numbers(keyframe)
                self.indices.add(keyframe.index)
                self.survey_id = keyframe.survey_id
            case "/receipt":
                receipt = pb.Receipt.FromString(data)
                self.names.add(receipt.sha256)
                self.object_bytes += receipt.size
                self.first_received_ns = self.first_received_ns or receipt.received_unix_ns
                if receipt.HasField("clock"):
                    self.clocks[receipt.clock.boot_id] = BootClock(receipt.clock.offset_ns, receipt.clock.error_ns)


class SurveyWriter:
    """One survey file in the making.

    `path` is the final name; the file is `<path>.partial` until `finish`. An existing partial file is recovered: every
    whole object is kept, a torn tail dropped. `recovered` then counts the objects found, and `damaged` names the copy
    of the old file that is kept when it was damaged elsewhere than at its end.

    The partial file is locked from here to `finish` or `close`: two receptions cannot write one file.
    """

    def __init__(self, path: Path, overwrite: bool = False, anew: bool = False) -> None:
        """`overwrite`: let `finish` replace an old survey. `anew`: begin anew in place of an old partial file.

        Raises PipefishError when another process writes the file, or `path` is a finished survey; OSError."""
        self.path = path
        self.partial = partial_of(path)
        self.content = Content()
        self.recovered = 0
        self.damaged: Path | None = None
        self._overwrite = overwrite
        self._failed = False
        self._refuse_finished()
        if not self.partial.exists():
            self._create(self.partial)
            self._sync()
            fsync_folder(self.partial)
            return
        with locked(self.partial):
            fresh = self.partial.with_name(self.partial.name + ".recover")
            fresh.unlink(missing_ok=True)  # of a recovery that was interrupted; the lock makes it ours
            self._create(fresh)
            try:
                if anew:
                    self._sync()
                else:
                    self._recover()
                os.replace(fresh, self.partial)
            except BaseException as error:
                self._failed = True
                self.close()
                fresh.unlink(missing_ok=True)
                if isinstance(error, OSError):
                    raise file_error(error, self.partial) from error
                raise
            fsync_folder(self.partial)

    def _refuse_finished(self) -> None:
        if not self._overwrite and self.path.exists():
            raise PipefishError(f"{self.path} exists already; choose another name or pass --overwrite")

    def _create(self, path: Path) -> None:
        self._file = locked(path, create=True)
        # No compression: JPEG does not shrink. The chunk size only bounds what `flush` has not yet closed.
        self._writer = Writer(self._file, chunk_size=1 << 40, compression=CompressionType.NONE)
        self._writer.start(profile="", library=f"pipefish {__version__}")
        self._channel: dict[str, int] = {}
        for topic, descriptor in CHANNELS:
            schema = self._writer.register_schema(descriptor.full_name, "protobuf", descriptor_set(descriptor))
            self._channel[topic] = self._writer.register_channel(topic, "protobuf", schema)

    def _sync(self) -> None:
        self._writer.flush()
        self._file.flush()
        os.fsync(self._file.fileno())

    def _recover(self) -> None:
        """Copies the whole chunks of the old partial file into the new one, which is about to take its place."""
        scan = self._copy_whole_objects()
        if any(not damage.tail for damage in scan.damage):
            self.damaged = self.partial.with_name(self.partial.name + ".damaged")
            self.damaged.unlink(missing_ok=True)
            os.link(self.partial, self.damaged)
        self.recovered = len(self.content.names)

    def _copy_whole_objects(self) -> McapScan:
        scan = McapScan(self.partial)
        topics: dict[int, str] = {}
        for item in scan:
            for record in item.chunk or []:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    topic = topics.get(record.channel_id, "")
                    if topic not in self._channel:
                        raise FormatError(self.partial, f"offset {item.offset}", "not a partial survey of pipefish")
                    try:
                        self.content.note(topic, record.data)
                    except (DecodeError, ValueError) as error:
                        raise FormatError(self.partial, f"offset {item.offset}", f"{topic}: {error}") from error
                    self._add(topic, record.log_time, record.publish_time, record.sequence, record.data)
            self._writer.flush()
        self._sync()
        return scan

    def _add(self, topic: str, log_time: int, publish_time: int, sequence: int, data: bytes) -> None:
        self._writer.add_message(
            channel_id=self._channel[topic],
            log_time=log_time,
            publish_time=publish_time,
            sequence=sequence & 0xFFFFFFFF,
            data=data,
        )

    def clock(self, boot: int, measured: BootClock | None, monotonic_ns: int, now_unix_ns: int) -> BootClock:
        """The clock of a boot: as measured on the link, as noted before, or, unknown, as if sent when it was taken."""
        known = self.content.clocks.get(boot)
        if measured is not None and (known is None or measured.error_ns <= known.error_ns):
            known = measured
        if known is None:
            known = BootClock(now_unix_ns - monotonic_ns, UNKNOWN_ERROR_NS)
        self.content.clocks[boot] = known
        return known

    def store(
        self, name: bytes, kind: int, message: Any, size: int, measured: BootClock | None, now_unix_ns: int
    ) -> None:
        """Writes one object durably; when this returns it may be acknowledged.

        message   the parsed SurveyStart, Keyframe or SurveyEnd; its own survey id has been looked at by the caller
        size      bytes of the object on the wire
        measured  clock of the boot that the message is from, if the link has measured it
        Raises PipefishError, with the file and the reason, if it cannot be written: the object stays on the device.
        """
        time_of = message.time
        clock = self.clock(time_of.boot_id, measured, time_of.monotonic_ns, now_unix_ns)
        log_time = max(0, time_of.monotonic_ns + clock.offset_ns)
        if kind == OBJECT_KEYFRAME:
            topic, sequence, data = "/keyframe", message.index, self._keyframe(message, log_time, now_unix_ns)
        else:
            topic, sequence = ("/survey/start" if kind == OBJECT_START else "/survey/end"), 0
            data = message.SerializeToString()
        self._add(topic, log_time, now_unix_ns, sequence, data)
        receipt = pb.Receipt(sha256=name, kind=kind, size=size, received_unix_ns=now_unix_ns)
        receipt.clock.boot_id = time_of.boot_id
        receipt.clock.offset_ns = clock.offset_ns
        receipt.clock.error_ns = clock.error_ns
        receipt_data = receipt.SerializeToString()
        self._add("/receipt", log_time, now_unix_ns, len(self.content.names), receipt_data)
        try:
            self._sync()
        except OSError as error:
            self._failed = True
            raise PipefishError(
                f"{self.partial}: {error.strerror}; {len(self.content.indices)} keyframes are safe in it, what is not "
                "stays on the device; the same command goes on from there"
            ) from error
        self._check_place()
        self.content.note(topic, data)
        self.content.note("/receipt", receipt_data)

    def _check_place(self) -> None:
        """Raises PipefishError if the file that we write is no longer the one of that name."""
        if not is_at(self._file, self.partial):
            self._failed = True
            raise PipefishError(
                f"{self.partial} was removed or replaced by another program while it was written; what it held is "
                "no longer on the device"
            )

    def _keyframe(self, message: pb.Keyframe, log_time: int, now_unix_ns: int) -> bytes:
        """Adds picture and annotations; returns the message without the picture."""
        image = CompressedImage(frame_id="camera", data=message.jpeg, format="jpeg")
        image.timestamp.FromNanoseconds(log_time)
        self._add("/camera", log_time, now_unix_ns, message.index, image.SerializeToString())
        points = annotations(Observations.from_message(message.observations), log_time)
        self._add("/camera/tracks", log_time, now_unix_ns, message.index, points.SerializeToString())
        bare = pb.Keyframe()
        bare.CopyFrom(message)
        bare.ClearField("jpeg")
        return bare.SerializeToString()

    def note_status(self, status: pb.Status, log_time: int, now_unix_ns: int) -> None:
        """Adds the device's counters; written with the next object, not by itself."""
        if status.time.monotonic_ns < UPTIME_MAX_NS:
            self._add("/status", max(0, log_time), now_unix_ns, 0, status.SerializeToString())

    def finish(self, notes: dict[str, str]) -> None:
        """Closes the file and gives it its final name. `notes` join the metadata record "pipefish".

        Raises PipefishError, OSError; what was stored then stays in the partial file."""
        self._check_place()
        self._refuse_finished()
        self._failed = True  # unless all of the following works, nothing may be added behind it
        start = self.content.start
        self._writer.flush()
        about = {
            "format": str(FORMAT_VERSION),
            "software": f"pipefish {__version__}",
            "survey_id": self.content.survey_id.hex(),
            "name": start.name if start else "",
            "device_software": start.software if start else "",
            "keyframes": str(len(self.content.indices)),
            "keyframes_lost": str(self.content.lost),
        }
        self._writer.add_metadata("pipefish", {**about, **notes})
        self._failed = True  # unless all of the following works, nothing may be added behind it
        if start is not None and start.profile:
            now = time.time_ns()
            self._writer.add_attachment(now, now, "profile.bin", "application/octet-stream", start.profile)
            text = profile_json(start.profile)
            if text is not None:
                self._writer.add_attachment(now, now, "profile.json", "application/json", text.encode())
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        os.replace(self.partial, self.path)
        fsync_folder(self.path)
        self._file.close()  # only now: this unlocks

    @property
    def can_finish(self) -> bool:
        """Whether all of the survey is here, in a file that could be written so far."""
        return self.content.complete and not self._failed

    def close(self) -> None:
        """Leaves the file partial, to be resumed. Objects are on disk already, so that a full disk is no error here."""
        with contextlib.suppress(OSError):
            if not self._failed:
                self._sync()
        with contextlib.suppress(OSError):
            self._file.close()


def profile_json(binary: bytes) -> str | None:
    """The JSON form of a binary profile, or None if this version cannot read it."""
    from pipefish.camera import Camera

    try:
        return Camera.from_binary(binary).to_json()
    except PipefishError:
        return None


def partial_of(path: Path) -> Path:
    """The name of a survey file while it is being received."""
    return path.with_name(path.name + ".partial")


def is_of(path: Path, survey_id: bytes) -> bool:
    """Whether a file, finished or partial, is of this survey."""
    try:
        return read_content(path).survey_id == survey_id
    except (OSError, PipefishError):
        return False


def read_content(path: Path) -> Content:
    """What a survey file holds, finished or partial, as far as it can be read. Raises FormatError, OSError."""
    content = Content()
    topics: dict[int, str] = {}
    for item in McapScan(path):
        for record in item.chunk or []:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                try:
                    content.note(topics.get(record.channel_id, ""), record.data)
                except (DecodeError, ValueError) as error:
                    raise FormatError(path, f"offset {item.offset}", str(error)) from error
    return content
