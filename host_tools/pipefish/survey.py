"""Reading surveys: MCAP files of `pipefish receive`, finished or still `.partial`. docs/survey.md has the layout."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Channel, Message, Metadata

from pipefish import pipefish_pb2 as pb
from pipefish.errors import ArgumentError, FormatError
from pipefish.mcapscan import Damage, McapScan, read_chunk
from pipefish.scene import STATES, frames_in, losses_of

if TYPE_CHECKING:
    from PIL.Image import Image

CAUSES = {1: "first", 2: "encoder", 3: "parallax", 4: "few common tracks"}
UNKNOWN_ERROR_NS = 2**64 - 1  # ClockSync.error_ns: the offset is a guess from the time of reception
KEYFRAMES_MAX = 1_000_000  # of a survey: 25 km at one each 25 mm. A number that is made up must not cost its memory
UPTIME_MAX_NS = 2**63  # 292 years; with a wall time added it still fits the 64 bits of MCAP's times

TOPICS: dict[str, type] = {
    "/keyframe": pb.Keyframe,
    "/survey/start": pb.SurveyStart,
    "/survey/end": pb.SurveyEnd,
    "/status": pb.Status,
    "/receipt": pb.Receipt,
}


def check_numbers(message: pb.Keyframe | pb.SurveyStart | pb.SurveyEnd | pb.Status) -> None:
    """Raises ValueError for a message of a survey with numbers that no device can have meant."""
    if isinstance(message, pb.Keyframe) and message.index >= KEYFRAMES_MAX:
        raise ValueError(f"keyframe {message.index}: a survey has at most {KEYFRAMES_MAX}")
    if isinstance(message, pb.SurveyEnd) and message.keyframes > KEYFRAMES_MAX:
        raise ValueError(f"{message.keyframes} keyframes: a survey has at most {KEYFRAMES_MAX}")
    if message.time.monotonic_ns >= UPTIME_MAX_NS:
        raise ValueError(f"a time of {message.time.monotonic_ns} ns since the device's start")


@dataclass
class Observations:
    """What one frame saw of the tracks; item i of every array belongs to track id[i].

    id          (N,) int64, ascending, unique in one boot
    xy          (N,2) float64 pixels
    covariance  (N,2,2) float64 px^2
    age         (N,) int64 frames since detection
    quality     (N,) float64, ZNCC with the previous patch, 0..1
    status      (N,) int64, pipefish.v1.TrackStatus
    settled     (N,2) float64 pixels by which xy was moved towards where the wall's other tracks say; 0 where not told
    """

    id: np.ndarray
    xy: np.ndarray
    covariance: np.ndarray
    age: np.ndarray
    quality: np.ndarray
    status: np.ndarray
    settled: np.ndarray

    @staticmethod
    def from_message(message: pb.Observations) -> Observations:
        """From the parallel arrays on the wire. Raises ValueError if their lengths differ."""
        fields = ("x_q16", "y_q16", "cov_xx_q20", "cov_xy_q20", "cov_yy_q20", "age", "quality", "status")
        n = len(message.id_delta)
        for name in fields:
            if len(getattr(message, name)) != n:
                raise ValueError(f"observations: {n} ids but {len(getattr(message, name))} values of {name}")
        settled = [np.array(column, dtype=np.int64) for column in (message.settled_x_q8, message.settled_y_q8)]
        if any(len(column) not in (0, n) for column in settled):
            raise ValueError(f"observations: {n} ids but {[len(column) for column in settled]} values of settled")
        x, y, xx, xy, yy, age, quality, status = (np.array(getattr(message, name), dtype=np.int64) for name in fields)
        ids = np.cumsum(np.array(message.id_delta, dtype=np.uint64), dtype=np.uint64).astype(np.int64)
        if n > 1 and not np.all(np.diff(ids) > 0):
            raise ValueError("observations: ids do not ascend")
        return Observations(
            id=ids,
            xy=np.stack([x, y], axis=1) / 65536.0,
            covariance=np.stack([xx, xy, xy, yy], axis=1).reshape(n, 2, 2) / 1048576.0,
            age=age,
            quality=quality / 32768.0,
            status=status,
            settled=np.stack([c if len(c) else np.zeros(n) for c in settled], axis=1) / 256.0,
        )


@dataclass
class Keyframe:
    """One keyframe of a survey.

    index           in the survey, over all boots
    boot            boot id of the device; monotonic_ns counts from its start
    time_ns         middle of the exposure, wall time (unix, ns) as far as the host knew the device's clock
    message         the whole pipefish.v1.Keyframe without its JPEG
    observations    Observations
    """

    index: int
    boot: int
    monotonic_ns: int
    time_ns: int
    message: pb.Keyframe
    observations: Observations
    _path: Path = field(repr=False)
    _chunk: int = field(repr=False)  # offset of the chunk with the picture
    _camera_channel: int = field(default=0, repr=False)

    @property
    def width(self) -> int:
        """Pixels."""
        return self.message.width

    @property
    def height(self) -> int:
        """Pixels."""
        return self.message.height

    @property
    def cause(self) -> str:
        """Why it was taken: first, encoder, parallax, few common tracks, unknown."""
        return CAUSES.get(self.message.cause, "unknown")

    @property
    def after_break(self) -> bool:
        """Whether tracks do not go on from the keyframe before."""
        return self.message.after_break

    @property
    def telemetry(self) -> dict[str, Any]:
        """The values that were measured, by the names of pipefish.v1.Telemetry."""
        return {d.name: v for d, v in self.message.telemetry.ListFields() if d.name != "time"}

    @property
    def encoder_count(self) -> int | None:
        """Encoder counts, None if there is no encoder."""
        telemetry = self.message.telemetry
        return telemetry.encoder_count if telemetry.HasField("encoder_count") else None

    @property
    def jpeg(self) -> bytes:
        """The picture as the device coded it, read from the file on each call."""
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        for record in read_chunk(self._path, self._chunk):
            if (
                isinstance(record, Message)
                and record.channel_id == self._camera_channel
                and record.sequence == self.index & 0xFFFFFFFF
            ):
                return CompressedImage.FromString(record.data).data
        raise FormatError(self._path, f"offset {self._chunk}", f"no picture of keyframe {self.index}")

    @property
    def image(self) -> Image:
        """The picture, decoded (mode L). Raises FormatError if it is no JPEG of the keyframe's size, or damaged."""
        from PIL import Image as PilImage

        try:
            # No other format: Pillow runs another program for some of them. The size is known before memory is taken.
            picture = PilImage.open(io.BytesIO(self.jpeg), formats=["JPEG"])
            if picture.size != (self.width, self.height):
                raise ValueError(f"{picture.width} x {picture.height} pixels, not {self.width} x {self.height}")
            return picture.convert("L")
        except (OSError, SyntaxError, ValueError, PilImage.DecompressionBombError) as error:
            raise FormatError(
                self._path, f"offset {self._chunk}", f"picture of keyframe {self.index}: {error}"
            ) from error


@dataclass
class Tracks:
    """Observations of tracks in frames. Arrays are copied, and sorted by track, then frame.

    frame       (N,) int64 index of the frame (of a survey: of the keyframe), from 0
    track       (N,) int64, of a survey 0..K-1, unique over all its boots; otherwise any numbers
    pixels      (N,2) float64
    covariance  (N,2,2) float64 px^2, or None where it is not known
    age         (N,) int64 frames since detection, at this observation
    quality     (N,) float64 similarity with the frame before, 0..1; 0 when new
    boot, id    (K,) uint64 boot id and (K,) int64 id on the device, of each track

    The last four are there for the tracks of a survey. Raises ArgumentError for arrays of wrong shapes.
    """

    frame: np.ndarray
    track: np.ndarray
    pixels: np.ndarray
    covariance: np.ndarray | None = None
    age: np.ndarray | None = None
    quality: np.ndarray | None = None
    boot: np.ndarray | None = None
    id: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("frame", "track"):
            given = np.asarray(getattr(self, name))
            if given.ndim != 1 or (given.dtype.kind not in "iu" and given.size):
                raise ArgumentError(f"{name}: expected (N,) integers, got {given.dtype} of shape {given.shape}")
            setattr(self, name, given.astype(np.int64))
        count = len(self.frame)
        self.pixels = np.array(self.pixels, dtype=np.float64)
        shapes = {"track": (count,), "pixels": (count, 2)}
        if self.covariance is not None:
            self.covariance = np.array(self.covariance, dtype=np.float64)
            shapes["covariance"] = (count, 2, 2)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ArgumentError(f"{name}: expected shape {shape}, got {getattr(self, name).shape}")
        if count and self.frame.min() < 0:
            raise ArgumentError(f"frame: {self.frame.min()} is negative")
        order = np.lexsort((self.frame, self.track))
        if (np.diff(order) < 0).any():
            for name in ("frame", "track", "pixels", "covariance", "age", "quality"):
                if getattr(self, name) is not None:
                    setattr(self, name, getattr(self, name)[order])

    @cached_property
    def bounds(self) -> np.ndarray:
        """(K+1,) int64: track k of a survey owns the items bounds[k]..bounds[k+1]-1."""
        count = int(self.track[-1]) + 1 if len(self.track) else 0
        return np.searchsorted(self.track, np.arange(count + 1))

    @property
    def length_frames(self) -> np.ndarray:
        """(K,) int64: age at the last sighting among the keyframes, in camera frames (0 = seen only when new)."""
        return self.age[self.bounds[1:] - 1]

    @property
    def length_keyframes(self) -> np.ndarray:
        """(K,) int64: in how many keyframes the track was seen."""
        return np.diff(self.bounds)


class Survey:
    """One survey file.

    keyframes   list of Keyframe, by index
    start       pipefish.v1.SurveyStart of the first boot, or None if it has not arrived; starts: of all boots
    end         pipefish.v1.SurveyEnd or None
    statuses    list of (time_ns, pipefish.v1.Status)
    receipts    list of pipefish.v1.Receipt, in order of reception
    complete    whether everything is there that the device did not lose
    damage      list of pipefish.mcapscan.Damage; empty for a finished file
    metadata    what the receiver noted ("pipefish" metadata record)
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.keyframes: list[Keyframe] = []
        self.starts: list[pb.SurveyStart] = []
        self.end: pb.SurveyEnd | None = None
        self.statuses: list[tuple[int, pb.Status]] = []
        self.receipts: list[pb.Receipt] = []
        self.damage: list[Damage] = []
        self.metadata: dict[str, str] = {}

    @staticmethod
    def open(path: str | Path) -> Survey:
        """Reads a survey; pictures stay on disk until asked for. A `.partial` file gives what arrived so far.

        Raises FormatError, with the offset, if the file is not a survey or a finished file is damaged; OSError.
        """
        survey = Survey(Path(path))
        survey._load()
        return survey

    def _load(self) -> None:
        scan = McapScan(self.path)
        channels: dict[int, Channel] = {}
        seen: dict[int, Keyframe] = {}
        pictures: dict[int, tuple[int, int]] = {}
        for item in scan:
            if isinstance(item.record, Metadata) and item.record.name == "pipefish":
                self.metadata = dict(item.record.metadata)
            records = item.chunk if item.chunk is not None else [item.record]
            for record in records:
                if isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    if record.channel_id not in channels:
                        raise FormatError(self.path, f"offset {item.offset}", f"no channel {record.channel_id}")
                    topic = channels[record.channel_id].topic
                    if topic == "/camera":
                        pictures[record.sequence] = (item.offset, record.channel_id)
                    elif topic in TOPICS:
                        self._take(topic, record, item.offset, seen)
        self.damage = scan.damage
        partial = self.path.name.endswith(".partial")
        for damage in scan.damage:
            if not (partial and damage.tail):
                cut = f" (a copy that was cut? Named {self.path.name}.partial, what is whole of it is read)"
                raise FormatError(self.path, f"offset {damage.offset}", damage.reason + (cut if damage.tail else ""))
        if not partial and not (self.starts or self.end or seen):
            raise FormatError(self.path, f"offset {scan.end}", "an MCAP file, but not a pipefish survey")
        for index in sorted(seen):
            if index not in pictures:
                raise FormatError(self.path, f"offset {seen[index]._chunk}", f"keyframe {index} has no picture")
            seen[index]._chunk, seen[index]._camera_channel = pictures[index]
            self.keyframes.append(seen[index])

    def _take(self, topic: str, record: Message, offset: int, seen: dict[int, Keyframe]) -> None:
        try:
            message = TOPICS[topic].FromString(record.data)
            if topic != "/receipt":
                check_numbers(message)
            match topic:
                case "/keyframe":
                    seen[message.index] = Keyframe(
                        message.index,
                        message.time.boot_id,
                        message.time.monotonic_ns,
                        record.log_time,
                        message,
                        Observations.from_message(message.observations),
                        self.path,
                        offset,
                    )
                case "/survey/start":
                    self.starts.append(message)
                case "/survey/end":
                    self.end = message
                case "/status":
                    self.statuses.append((record.log_time, message))
                case "/receipt":
                    self.receipts.append(message)
        except (DecodeError, ValueError) as error:
            raise FormatError(self.path, f"offset {offset}", f"{topic}: {error}") from error

    @property
    def start(self) -> pb.SurveyStart | None:
        """The first SurveyStart, or None."""
        return self.starts[0] if self.starts else None

    @property
    def survey_id(self) -> str:
        """Hexadecimal; "" if nothing arrived."""
        for message in (*self.starts, self.end, *(k.message for k in self.keyframes[:1])):
            if message is not None:
                return message.survey_id.hex()
        return ""

    @property
    def missing(self) -> list[int]:
        """Indices of keyframes that are not here: lost on the device, or not delivered yet. Ascending."""
        have = {k.index for k in self.keyframes}
        made = self.end.keyframes if self.end else max(have, default=-1) + 1
        return sorted(set(range(made)) - have)

    @property
    def lost(self) -> list[int]:
        """Indices of keyframes that the device says were made but can never be delivered. Ascending."""
        return sorted(lost_indices(self.end) - {k.index for k in self.keyframes}) if self.end else []

    @property
    def complete(self) -> bool:
        """Whether the survey has ended and all its keyframes are here that the device still had."""
        return self.end is not None and bool(self.starts) and set(self.missing) <= set(self.lost)

    @property
    def breaks(self) -> list[dict[str, Any]]:
        """Where tracks do not go on: {index, reason, restart} for each marked keyframe after the first."""
        result = []
        previous: Keyframe | None = None
        for frame in self.keyframes:
            restart = previous is not None and previous.boot != frame.boot
            if previous is not None and (frame.after_break or restart):
                reason = frame.message.break_reason or ("restart" if restart else "break")
                result.append({"index": frame.index, "reason": reason, "restart": restart})
            previous = frame
        return result

    def chainage(self) -> np.ndarray:
        """(K,) metres travelled at each keyframe by the encoder, from the first; NaN where there is no count.

        Counts start anew with each boot of the device, and each boot has its own scale. The first counted keyframe of a
        later boot stands where the last one before it stood: what was driven in between nobody counted. Those places
        are the `breaks` with restart = True."""
        scales = {s.time.boot_id: s.encoder.metres_per_count for s in self.starts}
        scale = self.start.encoder.metres_per_count if self.start else 0.0
        chainage = np.full(len(self.keyframes), np.nan)
        boot, zero, base, reached = None, None, 0.0, 0.0
        for i, frame in enumerate(self.keyframes):
            if frame.boot != boot:
                boot, zero = frame.boot, None
                scale = scales.get(boot, scale)  # not received yet: most likely that of the boot before
            if frame.encoder_count is None or not scale:
                continue
            if zero is None:
                zero, base = frame.encoder_count, reached
            reached = chainage[i] = base + (frame.encoder_count - zero) * scale
        return chainage

    def tracks(self, as_found: bool = False) -> Tracks:
        """All observations of all keyframes.

        as_found: where patches were found, not moved towards where the wall's other tracks say. What a place was moved
        by is then its uncertainty, along that way: places that were moved know their neighbours, and what the wall
        really does there is half taken back."""
        observations = [k.observations for k in self.keyframes]
        count = [len(o.id) for o in observations]
        boots = np.repeat(np.array([k.boot for k in self.keyframes], dtype=np.uint64), count)
        frame = np.repeat(np.array([k.index for k in self.keyframes], dtype=np.int64), count)

        def joined(name: str, shape: tuple[int, ...], dtype: type) -> np.ndarray:
            return np.concatenate([np.zeros((0, *shape), dtype), *(getattr(o, name) for o in observations)])

        ids = joined("id", (), np.int64)
        # Boots are numbered by first appearance, so that track numbers follow the survey.
        order_of_boot: dict[int, int] = {}
        for keyframe in self.keyframes:
            order_of_boot.setdefault(keyframe.boot, len(order_of_boot))
        boot_number = np.repeat(np.array([order_of_boot[k.boot] for k in self.keyframes], dtype=np.int64), count)
        order = np.lexsort((frame, ids, boot_number))
        ids, boots, boot_number = ids[order], boots[order], boot_number[order]
        first = np.ones(len(ids), dtype=bool)
        first[1:] = (ids[1:] != ids[:-1]) | (boot_number[1:] != boot_number[:-1])
        pixels, covariance = joined("xy", (2,), np.float64), joined("covariance", (2, 2), np.float64)
        if as_found:
            settled = joined("settled", (2,), np.float64)
            pixels, covariance = pixels - settled, covariance + settled[:, :, None] * settled[:, None, :]
        return Tracks(
            frame=frame[order],
            track=np.cumsum(first, dtype=np.int64) - 1,
            pixels=pixels[order],
            covariance=covariance[order],
            age=joined("age", (), np.int64)[order],
            quality=joined("quality", (), np.float64)[order],
            boot=boots[first],
            id=ids[first],
        )

    def time_spans(self) -> Iterator[tuple[int, float]]:
        """(boot id, seconds from its first to its last keyframe), in order."""
        spans: dict[int, list[int]] = {}
        for frame in self.keyframes:
            spans.setdefault(frame.boot, []).append(frame.monotonic_ns)
        for boot, times in spans.items():
            yield boot, (max(times) - min(times)) / 1e9

    @property
    def last_status(self) -> pb.Status | None:
        """The newest counters of the device, from the end of the survey or the last status message."""
        if self.end is not None and self.end.HasField("last_status"):
            return self.end.last_status
        return self.statuses[-1][1] if self.statuses else None

    def _count_state(self, name: str) -> int:
        """Keyframes at which, or since the one before which, the device was in a state."""
        return sum(frames_in(k.message.tracking)[name] > 0 for k in self.keyframes)

    @cached_property
    def info(self) -> dict[str, Any]:
        """What there is to say about the survey, as plain values, ready for JSON. docs/survey.md lists the keys."""
        start, status, tracks = self.start, self.last_status, self.tracks()
        chainage = self.chainage()
        length = float(np.nanmax(chainage) - np.nanmin(chainage)) if np.isfinite(chainage).any() else None
        frames = tracks.length_frames
        live = [len(k.observations.id) for k in self.keyframes]
        spans = list(self.time_spans())
        lengths = {
            "tracks": len(tracks.id),
            "observations": len(tracks.track),
            "per_keyframe_median": float(np.median(live)) if live else None,
            "length_frames_median": float(np.median(frames)) if len(frames) else None,
            "length_frames_p90": float(np.percentile(frames, 90)) if len(frames) else None,
            "length_keyframes_median": float(np.median(tracks.length_keyframes)) if len(frames) else None,
        }
        received = [r.received_unix_ns for r in self.receipts]
        return {
            "file": str(self.path),
            "survey_id": self.survey_id,
            "name": start.name if start else "",
            "complete": self.complete,
            "software": start.software if start else "",
            "source": start.source if start else "",
            "width": start.width if start else (self.keyframes[0].width if self.keyframes else 0),
            "height": start.height if start else (self.keyframes[0].height if self.keyframes else 0),
            "frame_rate": start.frame_rate if start else 0.0,
            "nominal_diameter_m": start.nominal_diameter_m if start else 0.0,
            "profile": profile_summary(start.profile) if start else None,
            "keyframes": len(self.keyframes),
            "missing": self.missing,
            "lost": self.lost,
            "frames": status.frames if status else None,
            "boots": len(spans),
            "breaks": self.breaks,
            "duration_s": sum(seconds for _, seconds in spans),
            "length_m": length,
            "first_time_unix_ns": self.keyframes[0].time_ns if self.keyframes else None,
            "tracks": lengths,
            "states": {words: n for name, words in STATES if (n := self._count_state(name))},
            "lost_tracks": losses_of(status.tracking) if status else {},
            "object_bytes": sum(r.size for r in self.receipts),
            "receive_s": (max(received) - min(received)) / 1e9 if received else None,
            "end_reason": self.end.reason if self.end else None,
            "link": self.metadata,
        }


def lost_indices(end: pb.SurveyEnd) -> set[int]:
    """The keyframes of a survey that its end lists as lost; some may have arrived (pipefish.proto)."""
    lost: set[int] = set()
    past = 0  # ranges that overlap are not gone through twice, however many there are
    for first, count in sorted(zip(end.lost_first, end.lost_count, strict=False)):
        lost.update(range(max(first, past), min(first + count, end.keyframes)))
        past = max(past, min(first + count, end.keyframes))
    return lost


def profile_summary(binary: bytes) -> dict[str, Any] | None:
    """Name and model of a binary profile as plain values; None when empty; {"error"} when it cannot be read."""
    if not binary:
        return None
    from pipefish.camera import Camera
    from pipefish.errors import PipefishError

    try:
        camera = Camera.from_binary(binary)
    except PipefishError as error:
        return {"error": str(error)}
    return {
        "name": camera.name,
        "serial": camera.serial,
        "model": camera.radial,
        "source": camera.source,
        "theta_max_deg": math.degrees(camera.theta_max),
        "rms_px": camera.rms_px,
    }
