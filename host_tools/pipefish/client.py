"""The host's end of the link: one select loop around the link's state machine (lib/link, through the binding)."""

from __future__ import annotations

import abc
import math
import secrets
import select
import time
from collections.abc import Callable
from typing import Any

from google.protobuf.message import DecodeError

from pipefish import pipefish_pb2 as pb
from pipefish.errors import PipefishError
from pipefish.survey import UPTIME_MAX_NS
from pipefish.surveywrite import BootClock
from pipefish.terminal import one_line
from pipefish.transport import Transport, TransportClosed

SCHEMA_VERSION = 1  # of pipefish.proto
ROLE_HOST = 2

# pf_link_event_type, pf_link_answer and pf_topic
UP, DOWN, INCOMPATIBLE, CONTROL, LATEST, OFFER, OBJECT, SENT, REFUSED = range(1, 10)
ACCEPT, STORED, REFUSE, AGAIN = range(1, 5)
TOPIC_STATUS, TOPIC_PREVIEW = 0, 1

BACKOFF_S = (0.1, 5.0)  # first and longest pause before the line is opened again
OUTPUT_CHUNK = 4096  # bytes given to the line at once: about 14 ms at 3 Mbaud; acknowledgements are small
BUSY_S = 0.5  # pause before a device is asked again that another host has
BUSY, VIEWER = 1, 2  # Status.looking_on
LOOKING = {
    BUSY: "another host is connected to the device",
    VIEWER: "this host may only look on: its role is viewer",
}
IDLE_S = 0.5  # longest sleep: the caller's `until` is looked at this often


class NoDevice(PipefishError):
    """Nothing answered in time."""


class Handlers:
    """What a client that only asks does with what arrives; override what matters. The device keeps its objects.

    may_look_on   it is of use also while another host has the device, which then refuses all that changes anything
    """

    may_look_on = True

    def on_up(self, event: Any) -> None:
        """The device answers; event.peer_boot_id is its boot id."""

    def on_down(self) -> None:
        """The device has gone silent."""

    def on_sent(self, name: bytes) -> None:
        """The device has this object durably."""

    def on_refused(self, name: bytes) -> None:
        """The device will never take this object."""

    def on_status(self, status: pb.Status) -> None:
        """Newest counters of the device."""

    def on_preview(self, preview: pb.Preview) -> None:
        """Newest small picture of the device."""


class ObjectHandlers(Handlers, abc.ABC):
    """What a client does that takes the device's objects too: so many at once, so many bytes at most each."""

    may_look_on = False
    receive_slots = 4
    max_object = 8 << 20  # a keyframe of a 20-megapixel camera stays well below

    @abc.abstractmethod
    def on_offer(self, name: bytes, kind: int, size: int) -> int | None:
        """Answer (ACCEPT, STORED, REFUSE) to an object the device wants to send. The device drops what is refused; None
        leaves it there, and its receive slot taken."""

    @abc.abstractmethod
    def on_object(self, name: bytes, kind: int, data: bytes) -> int | None:
        """Answer (STORED, AGAIN, REFUSE) to an object that is all here; None: not yet, ask again on the next turn."""


class Client:
    """Keeps the link to one device up: opens the transport again when it breaks, and asks and answers.

    statistics and state: `link.stats` (a dict, see pf_link_stats), `up`, `boot` (id of the device, 0 = unknown)
    """

    def __init__(self, transport: Transport, handlers: Handlers, link: Any = None) -> None:
        """`handlers`: ObjectHandlers to be sent objects. `link`: for tests."""
        self.transport = transport
        self.handlers = handlers
        self._takes_objects = handlers if isinstance(handlers, ObjectHandlers) else None
        if link is None:
            from pipefish._engine import Link

            link = Link(
                role=ROLE_HOST,
                nonce=secrets.randbits(32) | 1,
                schema=SCHEMA_VERSION,
                max_object=self._takes_objects.max_object if self._takes_objects else 0,
                receive_slots=self._takes_objects.receive_slots if self._takes_objects else 0,
                max_latest=65536,
                max_control=1000,
            )
        self.link = link
        self.up = False
        self.boot = 0
        self.reconnections = 0
        self.replies: dict[int, pb.Reply] = {}
        self._open = False
        self._was_open = False
        self._open_error = ""  # why the line could not be opened, "" while it is open
        self._lost_error = ""  # why it was lost before, "" since the device has answered
        self._backlog = b""  # bytes of the link that the line has not taken
        # Objects whose answer is due: slot, name, kind, bytes. The link asks once, whatever happens to the line.
        self._pending: list[tuple[int, bytes, int, bytes]] = []
        self._last_id = 0
        self._asked: set[int] = set()
        self._retry_ns = 0
        self._backoff_s = BACKOFF_S[0]
        self.down_since_ns = time.monotonic_ns()
        self._waited_since_ns = self.down_since_ns  # as it was before the device last came up

    def open(self) -> None:
        """Opens the line. Raises TransportClosed if that fails now; `run` and `step` then try again."""
        try:
            self.transport.open()
        except TransportClosed as error:
            self._open_error = error.reason
            raise
        if self._was_open:
            self.reconnections += 1
        self._open, self._was_open, self._open_error = True, True, ""

    def close(self) -> None:
        """Closes the line."""
        self.transport.close()
        self._open = False

    @property
    def has_clock(self) -> bool:
        """Whether the device's clock has been measured on the link, whatever it says."""
        return self.up and self.link.stats["peer_clock_error_ns"] < 2**63

    @property
    def clock(self) -> BootClock | None:
        """The device's clock as measured on the link: unix time = monotonic + offset; None before the first answer, and
        where it is one that no device can have."""
        stats = self.link.stats
        theirs = time.monotonic_ns() + stats["peer_clock_offset_ns"]
        if not self.has_clock or not 0 <= theirs < UPTIME_MAX_NS:
            return None
        # A busy machine may do something else between two looks at its clocks.
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        offset = wall - (before + after) // 2 - stats["peer_clock_offset_ns"]
        return BootClock(offset, stats["peer_clock_error_ns"] + (after - before + 1) // 2)

    def run(self, until: Callable[[], bool], timeout_s: float = 0.0) -> None:
        """Serves the link until `until()`. Raises NoDevice when nobody answered for `timeout_s` (0 = wait for ever)."""
        while not until():
            self.step(IDLE_S)
            silent_s = (time.monotonic_ns() - self.down_since_ns) / 1e9
            if not self.up and timeout_s and silent_s > timeout_s:
                why = self._open_error or self._lost_error
                waited = f"no device answers on {self.transport.name} (waited {timeout_s:g} s)"
                raise NoDevice(f"{waited}: {why}" if why else waited)

    def step(self, most_s: float) -> None:
        """One turn: waits for bytes or a deadline, at most `most_s` seconds, and serves what happened."""
        if not self._open:
            self._reopen(most_s)
            return
        try:
            self._turn(most_s)
        except TransportClosed as error:
            self._lost_error = error.reason
            self._lost()

    def _turn(self, most_s: float) -> None:
        # What has come while the caller was busy, or stood still, is heard before the link looks at the clock: it is a
        # sign of life. The caller may have waited for just that: it is asked before anything else is waited for.
        heard = self._hear(0.0)
        now = time.monotonic_ns()
        blocked = self._flush(now)
        wait_s = 0.0 if heard else min(most_s, max(0.0, (self.link.deadline(now) - now) / 1e9))
        if self._pending:
            wait_s = min(wait_s, 0.01)
        if blocked:
            wait_s = min(wait_s, 0.005)
        self._hear(wait_s)
        self._answer_pending()
        self._flush(time.monotonic_ns())

    def _hear(self, wait_s: float) -> bool:
        """Serves what the device says within that time; True: it said something."""
        readable, _, _ = select.select([self.transport], [], [], wait_s)
        now = time.monotonic_ns()
        data = self.transport.read() if readable else b""
        for event in self.link.input(data, now):
            self._serve(event)
        return bool(readable)

    def _flush(self, now: int) -> bool:
        """Gives the line what the link wants to send. True while the line takes no more."""
        while True:
            if self._backlog:
                self._backlog = self._backlog[self.transport.write(self._backlog) :]
                if self._backlog:
                    return True
            if self.transport.waiting() > OUTPUT_CHUNK:
                return True  # what waits in the driver cannot be overtaken by something more urgent
            self._backlog = self.link.output(OUTPUT_CHUNK, now)
            if not self._backlog:
                return False

    def _serve(self, event: Any) -> None:
        match event.type:
            case x if x == UP:
                self._waited_since_ns = self.down_since_ns
                self._lost_error = ""
                self.up, self.boot = True, event.peer_boot_id
                self._backoff_s = BACKOFF_S[0]
                self.handlers.on_up(event)
            case x if x == DOWN:
                self._down()
            case x if x == INCOMPATIBLE:
                raise PipefishError(
                    f"the device on {self.transport.name} speaks version {event.peer_version} of the link, which this "
                    "pipefish does not; update the older of the two"
                )
            case x if x == CONTROL:
                self._reply(event.data)
            case x if x == LATEST:
                self._latest(event.topic, event.data)
            case x if x == OFFER and self._takes_objects:
                answer = self._takes_objects.on_offer(event.name, event.kind, event.size)
                if answer is not None:
                    self.link.answer_object(event.slot, answer)
            case x if x == SENT:
                self.handlers.on_sent(event.name)
            case x if x == REFUSED:
                self.handlers.on_refused(event.name)
            case x if x == OBJECT:
                self._pending.append((event.slot, event.name, event.kind, event.data))

    def _answer_pending(self) -> None:
        while self._pending and self._takes_objects:
            slot, name, kind, data = self._pending[0]
            answer = self._takes_objects.on_object(name, kind, data)
            if answer is None:
                return
            self._pending.pop(0)
            self.link.answer_object(slot, answer)

    def _reply(self, data: bytes) -> None:
        try:
            reply = pb.Reply.FromString(data)
        except DecodeError:
            return  # the link's checksum holds, so this is another schema; a request then times out with a message
        if reply.id in self._asked:
            self._asked.discard(reply.id)
            self.replies[reply.id] = reply

    def _latest(self, topic: int, data: bytes) -> None:
        try:
            if topic == TOPIC_STATUS:
                status = pb.Status.FromString(data)
                if status.looking_on and not self.handlers.may_look_on:
                    self._leave(status.looking_on)
                self.handlers.on_status(status)
            elif topic == TOPIC_PREVIEW:
                self.handlers.on_preview(pb.Preview.FromString(data))
        except DecodeError:
            return  # newest wins: the next one may be readable

    def ask(self, **what: Any) -> int:
        """Sends a request, for example ask(get_status=pb.Nothing()). Returns its id; the reply appears in `replies`.

        Raises NoDevice if it is not there."""
        self._last_id += 1
        request = pb.Request(id=self._last_id, **what)
        try:
            self.link.send_control(request.SerializeToString())
        except (ConnectionError, BufferError) as error:
            raise NoDevice(f"the device on {self.transport.name} does not listen: {error}") from error
        self._asked.add(request.id)
        return request.id

    def answer_to(self, timeout_s: float, **what: Any) -> pb.Reply:
        """Sends a request, serves the link until its reply (timeout_s = 0: waits for ever).

        Raises PipefishError: no answer, or the device's text."""
        self.run(lambda: self.up, timeout_s)
        wanted = self.ask(**what)
        self.step(0.0)  # it is on its way before its time begins
        end = time.monotonic() + (timeout_s or math.inf)
        self.run(lambda: wanted in self.replies or time.monotonic() > end, timeout_s)
        if wanted not in self.replies:
            self.step(0.0)  # this host may have stood still until the time was up: what came meanwhile counts
        if wanted not in self.replies:
            raise NoDevice(f"the device on {self.transport.name} did not reply within {timeout_s:g} s")
        reply = self.replies.pop(wanted)
        if reply.error:
            raise PipefishError(f"the device says: {one_line(reply.error)}")
        return reply

    def _leave(self, looking: int) -> None:
        """A device that another host has counts as not there, and is asked again. Raises TransportClosed, or
        PipefishError where waiting does not help."""
        why = LOOKING.get(looking, "this host may only look on")
        if looking != BUSY:
            raise PipefishError(f"the device on {self.transport.name} says: {why}")
        self._backoff_s = BUSY_S
        self._down()
        self.down_since_ns = self._waited_since_ns
        raise TransportClosed(f"{self.transport.name}: {why}", reason=why)

    def _down(self) -> None:
        if self.up:
            self.up = False
            self.down_since_ns = time.monotonic_ns()
            self.handlers.on_down()

    def _lost(self) -> None:
        """The stream broke: the link forgets half a frame, objects stay and resume."""
        now = time.monotonic_ns()
        self.close()
        self._backlog = b""
        self.link.reset(now)
        for event in self.link.input(b"", now):
            self._serve(event)
        self._down()
        self._pause(now)

    def _pause(self, now: int) -> None:
        """Until the line is opened again: longer each time, until the device answers. One that opens and closes at once
        costs the device a handshake each time."""
        self._retry_ns = now + int(self._backoff_s * 1e9)
        self._backoff_s = min(2 * self._backoff_s, BACKOFF_S[1])

    def _reopen(self, most_s: float) -> None:
        pause_s = (self._retry_ns - time.monotonic_ns()) / 1e9
        if pause_s > 0:
            time.sleep(min(pause_s, most_s))
            return
        try:
            self.open()
        except TransportClosed:
            self._pause(time.monotonic_ns())
