"""Single frames off a device that runs, as its camera gave them: for calibration.

The device's survey goes on and stays on the device: `pipefish receive` gets it later.
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError
from PIL import Image

from . import pipefish_pb2 as pb
from .calib_input import TELEMETRY
from .client import ACCEPT, AGAIN, REFUSE, STORED, Client, NoDevice, ObjectHandlers
from .errors import PipefishError, file_error
from .files import write_atomically
from .terminal import in_line
from .transport import Transport, TransportClosed

OBJECT_RAW_FRAME = 5  # pf_object_kind
_ASK_AGAIN_S = 0.05  # after "try again": the device has not heard yet that the last still is here
_INPUT_ENDED = "end of input"
_OVER_S = 2.0  # of a survey that is over, for a still that was made before
_COLUMNS = (
    *("sequence", "time_ns", "encoder_count", "roll_rad", "pitch_rad", "attitude_sigma_rad"),
    *("exposure_us", "gain", "lamp", "sha256"),
)


class SurveyOver(PipefishError):
    """The device's camera gives no more frames."""


@dataclass(frozen=True, eq=False)
class Still:
    """One frame. image: (H, W) uint8; time_ns: of the exposure, the device's monotonic clock since boot `boot_id`."""

    image: npt.NDArray[np.uint8]
    sequence: int
    boot_id: int
    time_ns: int
    telemetry: pb.Telemetry

    def png(self) -> bytes:
        """As a file."""
        out = io.BytesIO()
        Image.fromarray(self.image).save(out, "PNG")
        return out.getvalue()


def still_of(data: bytes) -> Still:
    """From a RawFrame message. Raises PipefishError: not one that this version reads."""
    try:
        frame = pb.RawFrame.FromString(data)
    except DecodeError as error:
        raise PipefishError(f"the device's still is damaged: {error}") from None
    if frame.encoding != "mono8":
        raise PipefishError(f"the device's still is in {frame.encoding!r}, this version of pipefish reads 'mono8'")
    if len(frame.pixels) != frame.width * frame.height or not frame.pixels:
        raise PipefishError(f"the device's still of {frame.width} x {frame.height} has {len(frame.pixels)} bytes")
    image = np.frombuffer(frame.pixels, dtype=np.uint8).reshape(frame.height, frame.width)
    return Still(image, frame.frame_sequence, frame.time.boot_id, frame.time.monotonic_ns, frame.telemetry)


class Stills(ObjectHandlers):
    """Asks a device for frames, one after the other. A context: opens the line, closes it."""

    receive_slots = 16  # the link's most: what the device has to send of its survey is left there and keeps its slots
    max_object = 32 << 20  # the memory is only touched where frames come to lie

    def __init__(self, transport: Transport, timeout_s: float = 30.0) -> None:
        """`timeout_s`: how long a silent device is waited for; 0 = for ever."""
        self.client = Client(transport, self)
        self._timeout_s = timeout_s
        self._still: Still | None = None
        self._asked: int | None = None  # the request under way
        self._accepted = False  # the device said that a still comes
        self._offered = False
        self._state = ""
        self._over_since = 0.0

    def __enter__(self) -> Stills:
        with contextlib.suppress(TransportClosed):  # it may be about to start
            self.client.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()

    # ---- handlers

    def on_up(self, event: Any) -> None:
        # What was asked may be lost with the session; a still that was under way goes on.
        self._offered = self._offered and not event.peer_restarted
        self._asked, self._accepted = None, self._offered
        self._state = ""

    def on_offer(self, name: bytes, kind: int, size: int) -> int | None:
        if kind != OBJECT_RAW_FRAME:
            return None  # of the survey: a refusal would make the device delete it
        self._offered = True
        return ACCEPT

    def on_object(self, name: bytes, kind: int, data: bytes) -> int:
        if kind != OBJECT_RAW_FRAME:
            return REFUSE
        if hashlib.sha256(data).digest() != name:
            return AGAIN
        self._still = still_of(data)
        return STORED

    def on_status(self, status: pb.Status) -> None:
        if status.state != "surveying" and self._state in ("", "surveying"):
            self._over_since = time.monotonic()
        self._state = status.state

    # ---- asking

    def take(self) -> Still:
        """The camera's next frame. Raises SurveyOver, NoDevice, PipefishError with the device's words."""
        self._still, self._asked, self._accepted, self._offered = None, None, False, False
        ask_at = accepted_at = 0.0
        silence = self._timeout_s
        while self._still is None:
            self.client.run(lambda: self.client.up, silence)
            now = time.monotonic()
            if not self._accepted and self._asked is None and now >= ask_at:
                with contextlib.suppress(NoDevice):  # gone this moment: asked again when it is back
                    self._asked = self.client.ask(get_still=pb.Nothing())
            answer = self._is_accepted()
            if answer is False:
                self._asked, ask_at = None, now + _ASK_AGAIN_S
            elif answer is True:
                accepted_at = now
            waits = self._accepted and not self._offered and self.client.up
            if waits and self._timeout_s and now - accepted_at > self._timeout_s:
                raise NoDevice(
                    f"the device said that a still comes, and none came for {self._timeout_s:g} s: no camera, or "
                    "frames too large to be sent; its log says"
                )
            over = self._state not in ("", "surveying") and now - self._over_since > _OVER_S
            if over and not self._offered:
                raise SurveyOver("the device's survey is over: its camera gives no more frames")
            self.client.step(0.05)
        return self._still

    def _is_accepted(self) -> bool | None:
        """The device's answer; None: not yet."""
        reply = self.client.replies.pop(self._asked, None) if self._asked is not None else None
        if reply is None:
            return None
        if not reply.error:
            self._accepted = True
            return True
        if reply.error.endswith("try again"):
            return False
        if reply.error == "unknown request":
            raise PipefishError("the device sends no stills: its pipefishd is too old")
        if "survey is over" in reply.error:
            raise SurveyOver(f"the device says: {in_line(reply.error)}")
        raise PipefishError(f"the device says: {in_line(reply.error)}")


def _cell(value: float) -> str:
    """As telemetry.csv has it: whole numbers exactly, the others to what 32 bits hold."""
    return str(value) if isinstance(value, int) else f"{value:.9g}"


class StillFolder:
    """A folder of stills that is a recording too (docs/recording.md): shot1.png, ... and telemetry.csv."""

    def __init__(self, path: Path) -> None:
        """Raises PipefishError where the folder has something in it."""
        self.path, self.count, self._boot = path, 0, 0
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise PipefishError(f"{path}: exists and is not an empty folder; name another")
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise file_error(error, path) from error
        self._rows: list[list[object]] = []

    def remove(self) -> None:
        """Takes the folder away where nothing came into it, so that the next try may have its name."""
        with contextlib.suppress(OSError):
            self.path.rmdir()

    def add(self, still: Still) -> Path:
        """Writes a still. Raises PipefishError if the device has restarted since the first: its clock began anew."""
        self._boot = self._boot or still.boot_id
        if still.boot_id != self._boot:
            raise PipefishError(f"the device has restarted; {self.count} stills are in {self.path}")
        path = self.path / f"shot{self.count + 1}.png"
        t = still.telemetry
        row = [
            *(still.sequence, still.time_ns),
            *(_cell(getattr(t, name)) if t.HasField(name) else "" for name in _COLUMNS[2:9]),
            hashlib.sha256(still.image.tobytes()).hexdigest(),
        ]
        try:
            write_atomically(path, still.png())
            self._write([*self._rows, row])
        except BaseException:  # Ctrl-C too: a picture without its row would make the folder no recording
            path.unlink(missing_ok=True)
            if self._rows:
                self._write(self._rows)
            raise
        self._rows.append(row)
        self.count += 1
        return path

    def _write(self, rows: list[list[object]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([_COLUMNS, *rows])
        write_atomically(self.path / TELEMETRY, text.getvalue().encode())


def _on_enter(stills: Stills) -> Iterator[None]:
    """Yields at each line of standard input, until it ends; the link is served meanwhile. Read past Python's buffer:
    lines that lie in it would be seen by no select. What comes while a still is taken waits its turn."""
    if sys.stdin is None:
        return
    keys, waiting = sys.stdin.fileno(), 0
    while True:
        stills.client.step(0.0)
        if waiting:
            waiting -= 1
            yield
        elif select.select([keys], [], [], 0.05)[0]:
            typed = os.read(keys, 4096)
            if not typed:
                return
            waiting = typed.count(b"\n")


def _every(stills: Stills, seconds: float) -> Iterator[None]:
    """Yields at intervals; the link is served meanwhile."""
    due = time.monotonic()
    while True:
        while time.monotonic() < due:
            stills.client.step(min(0.05, max(0.0, due - time.monotonic())))
        due = max(due + seconds, time.monotonic())
        yield


def record(
    transport: Transport,
    folder: Path,
    *,
    every_s: float | None = None,
    count: int | None = None,
    timeout_s: float = 30.0,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Stills into a folder, at each line of standard input (every_s None) or at intervals; until there are `count`,
    the input or the survey ends, or Ctrl-C. -> folder, stills, ended. Raises PipefishError where none came, and the
    folder goes again."""
    kept = StillFolder(folder)
    ended = f"{count} stills"
    try:
        with Stills(transport, timeout_s) as stills:
            for _ in _on_enter(stills) if every_s is None else _every(stills, every_s):
                still = stills.take()
                tell(f"{kept.add(still)}: frame {still.sequence}, {still.image.shape[1]} x {still.image.shape[0]}")
                if count is not None and kept.count >= count:
                    break
            else:
                ended = _INPUT_ENDED
    except KeyboardInterrupt:
        ended = "stopped by Ctrl-C"
    except (NoDevice, SurveyOver) as error:
        if not kept.count:
            kept.remove()
            raise
        ended = str(error)
    if not kept.count:
        kept.remove()
        ask = "; without a keyboard give --every SECONDS" if ended == _INPUT_ENDED else ""
        raise PipefishError(f"no still was taken: {ended}{ask}")
    return {"folder": str(folder), "stills": kept.count, "ended": ended}
