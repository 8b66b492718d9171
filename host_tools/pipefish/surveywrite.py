"""Writing surveys durably: each object of the device becomes one MCAP chunk, on disk before it is acknowledged.

docs/survey.md has the layout. One chunk an object means that an object is in the file as a whole or not at all,
whatever the moment of a power cut: a chunk carries its length and checksum.
"""

from __future__ import annotations

import hashlib
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
from pipefish.errors import FormatError, PipefishError
from pipefish.mcapscan import McapScan
from pipefish.survey import UNKNOWN_ERROR_NS, Observations, lost_indices

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
        if self.start is None or self.end is None:
            return False
        return set(range(self.end.keyframes)) <= self.indices | lost_indices(self.end)

    @property
    def lost(self) -> int:
        """Number of keyframes that the device lost."""
        return len(lost_indices(self.end) - self.indices) if self.end else 0

    def note(self, topic: str, data: bytes) -> None:
        """Takes in one message of the file. Raises DecodeError."""
        match topic:
            case "/survey/start":
                start = pb.SurveyStart.FromString(data)
                self.start = self.start or start
                self.survey_id = start.survey_id
            case "/survey/end":
                self.end = pb.SurveyEnd.FromString(data)
                self.survey_id = self.end.survey_id
            case "/keyframe":
                keyframe = pb.Keyframe.FromString(data)
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
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.partial = path.with_name(path.name + ".partial")
        self.content = Content()
        self.recovered = 0
        self.damaged: Path | None = None
        if self.partial.exists():
            self._recover()
        else:
            self._create(self.partial)
            self._sync()
            fsync_folder(self.partial)

    def _create(self, path: Path) -> None:
        self._file: IO[bytes] = open(path, "wb")  # noqa: SIM115 - lives as long as the writer
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
        """Copies the whole chunks of the old partial file into a new one that takes its place."""
        fresh = self.partial.with_name(self.partial.name + ".recover")
        self._create(fresh)
        try:
            scan = self._copy_whole_objects()
        except BaseException:
            self._file.close()
            fresh.unlink()
            raise
        if any(not damage.tail for damage in scan.damage):
            self.damaged = self.partial.with_name(self.partial.name + ".damaged")
            self.damaged.unlink(missing_ok=True)
            os.link(self.partial, self.damaged)
        os.replace(fresh, self.partial)
        fsync_folder(self.partial)
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
                    except DecodeError as error:
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
        self._sync()
        self.content.note(topic, data)
        self.content.note("/receipt", receipt_data)

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
        self._add("/status", max(0, log_time), now_unix_ns, 0, status.SerializeToString())

    def finish(self, notes: dict[str, str]) -> None:
        """Closes the file and gives it its final name. `notes` join the metadata record "pipefish"."""
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
        if start is not None and start.profile:
            now = time.time_ns()
            self._writer.add_attachment(now, now, "profile.bin", "application/octet-stream", start.profile)
            text = profile_json(start.profile)
            if text is not None:
                self._writer.add_attachment(now, now, "profile.json", "application/json", text.encode())
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self.partial, self.path)
        fsync_folder(self.path)

    def close(self) -> None:
        """Leaves the file partial, to be resumed."""
        self._sync()
        self._file.close()


def profile_json(binary: bytes) -> str | None:
    """The JSON form of a binary profile, or None if this version cannot read it."""
    from pipefish.camera import Camera

    try:
        return Camera.from_binary(binary).to_json()
    except PipefishError:
        return None


class SurveyStore:
    """The survey files of one `pipefish receive`.

    A device may first deliver what is left of earlier surveys. The survey that the device is working on (`primary`)
    gets the name that the user gave; every other one gets a name beside it: survey-2.mcap, survey-3.mcap, ...
    """

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        """Raises PipefishError if `path` exists already and must not be overwritten."""
        self.path = path
        self.writers: dict[bytes, SurveyWriter] = {}
        self.finished: dict[bytes, Path] = {}
        self.primary: bytes | None = None
        self._names: set[bytes] = set()
        if overwrite:
            for old in (path, path.with_name(path.name + ".partial")):
                old.unlink(missing_ok=True)
        elif path.exists():
            raise PipefishError(f"{path} exists already; choose another name or pass --overwrite")
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in range(1, 1000):
            candidate = self._numbered(number)
            partial = candidate.with_name(candidate.name + ".partial")
            if partial.exists():
                writer = SurveyWriter(candidate)
                self._names |= writer.content.names
                self.writers[writer.content.survey_id] = writer
                if number == 1:
                    self.primary = writer.content.survey_id or None
            elif number > 1 and not candidate.exists():
                break

    def _numbered(self, number: int) -> Path:
        return self.path if number == 1 else self.path.with_name(f"{self.path.stem}-{number}{self.path.suffix}")

    def choose_primary(self, survey_id: bytes) -> None:
        """Tells which survey the given name is for; the first call that is not empty holds."""
        if survey_id and self.primary is None:
            self.primary = survey_id

    def has(self, name: bytes) -> bool:
        """Whether the object is stored durably."""
        return name in self._names

    @property
    def recovered(self) -> int:
        """Objects found in files of an earlier, interrupted run."""
        return sum(w.recovered for w in self.writers.values())

    def writer(self, survey_id: bytes) -> SurveyWriter:
        """The file of a survey; created at its first object."""
        if survey_id in self.writers:
            return self.writers[survey_id]
        self.choose_primary(survey_id)
        if b"" in self.writers and survey_id == self.primary:  # an empty partial file of this name
            self.writers[survey_id] = self.writers.pop(b"")
            return self.writers[survey_id]
        number = 1
        if survey_id != self.primary:
            number = 2
            while self._numbered(number).exists() or any(
                w.path == self._numbered(number) for w in self.writers.values()
            ):
                number += 1
        self.writers[survey_id] = SurveyWriter(self._numbered(number))
        return self.writers[survey_id]

    def store(
        self, name: bytes, kind: int, data: bytes, measured: dict[int, BootClock], now_unix_ns: int
    ) -> tuple[SurveyWriter, Any] | None:
        """Stores one object durably. Returns its file and message, or None if the bytes do not match the name.

        measured  clocks that the link has measured, by boot id
        Raises PipefishError for an object that this version does not understand: it stays on the device.
        """
        if hashlib.sha256(data).digest() != name:
            return None
        kinds = {OBJECT_START: pb.SurveyStart, OBJECT_KEYFRAME: pb.Keyframe, OBJECT_END: pb.SurveyEnd}
        try:
            message = kinds[kind].FromString(data)
            if kind == OBJECT_KEYFRAME:
                Observations.from_message(message.observations)
            if not message.survey_id:
                raise ValueError("no survey id")
        except (KeyError, DecodeError, ValueError) as error:
            raise PipefishError(
                f"the device sent an object (kind {kind}, {name.hex()[:16]}...) that this version of pipefish cannot "
                f"read: {error}; it stays on the device, update pipefish on both ends"
            ) from error
        writer = self.writer(message.survey_id)
        writer.store(name, kind, message, len(data), measured.get(message.time.boot_id), now_unix_ns)
        self._names.add(name)
        return writer, message

    def finish_complete(self, notes: dict[str, str]) -> list[Path]:
        """Gives every complete file its final name. Returns the new names."""
        done = []
        for survey_id, writer in list(self.writers.items()):
            if writer.content.complete:
                writer.finish(notes)
                self.finished[survey_id] = writer.path
                del self.writers[survey_id]
                done.append(writer.path)
        return done

    def close(self) -> list[Path]:
        """Leaves what is not complete as partial files. Returns their names."""
        for writer in self.writers.values():
            writer.close()
        return [writer.partial for writer in self.writers.values()]
