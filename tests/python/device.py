"""A device for tests: the real link in the device's role over TCP on loopback, with a spool in memory."""

from __future__ import annotations

import contextlib
import hashlib
import select
import socket
import sys
import threading
import time
from collections.abc import Sequence

from pipefish._engine import Link

from pipefish import pipefish_pb2 as pb
from pipefish.client import CONTROL, REFUSED, SENT, UP
from synthetic import BOOT, Object

ROLE_DEVICE = 1


class Device(threading.Thread):
    """Serves `objects` until stopped. `spool` is what has not been acknowledged; `acknowledged` counts the rest.

    cut_after      bytes sent after which the connection is closed, again and again
    corrupt_every  one byte in so many is flipped on its way to the host
    survey_id      what Info and Status tell; b"" tells nothing
    state          what Status tells
    stills         RawFrame messages, one for each get_still (b"": promised, never sent); then the survey is over
    ahead_ns       of our clock, that its own is
    most           so many objects are given to the link, over all connections; may be raised at any time
    """

    def __init__(
        self,
        objects: list[Object],
        survey_id: bytes,
        *,
        boot: int = BOOT,
        cut_after: int = 0,
        corrupt_every: int = 0,
        nonce: int = 7,
        state: str = "draining",
        stills: Sequence[bytes] = (),
        ahead_ns: int = 0,
    ) -> None:
        super().__init__(daemon=True)
        self.spool = {name: (kind, data) for name, kind, data in objects}
        self.acknowledged: list[bytes] = []
        self.refused: list[bytes] = []
        self.survey_id, self.boot = survey_id, boot
        self.cut_after, self.corrupt_every = cut_after, corrupt_every
        self.state = state
        self.stills = list(stills)
        self.ahead_ns = ahead_ns
        self.most = sys.maxsize
        self.clock: pb.ClockSync | None = None
        self.connections = 0
        self._sent = 0
        self.cannot = "this device cannot do that"
        self._under_way: set[bytes] = set()
        self._done = threading.Event()
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(0.05)
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self.link = Link(role=ROLE_DEVICE, nonce=nonce, boot_id=boot, schema=1, max_control=1000)

    def _now(self) -> int:
        return time.monotonic_ns() + self.ahead_ns

    def stop(self) -> None:
        self._done.set()
        self.join(60)
        self._server.close()

    def __enter__(self) -> Device:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def run(self) -> None:
        while not self._done.is_set():
            try:
                line, _ = self._server.accept()
            except TimeoutError:
                continue
            self.connections += 1
            with line, contextlib.suppress(OSError):
                self._serve(line)
            self.link.reset(self._now())

    def _serve(self, line: socket.socket) -> None:
        sent_here = 0
        while not self._done.is_set():
            now = self._now()
            wait = min(0.02, max(0, self.link.deadline(now) - now) / 1e9)
            readable, _, _ = select.select([line], [], [], wait)
            data = line.recv(65536) if readable else b""
            if readable and not data:
                return
            for event in self.link.input(data, self._now()):
                self._event(event)
            for name, (kind, data) in list(self.spool.items()):
                is_held = len(self._under_way) >= self.most
                if name not in self._under_way and not is_held and self.link.free_send_slots():
                    self._under_way.add(name)
                    self.link.send_object(name, kind, data)
            now = self._now()
            while out := self.link.output(4096, now):
                line.sendall(self._spoil(out))
                sent_here += len(out)
            if self.cut_after and sent_here > self.cut_after:
                return

    def _spoil(self, data: bytes) -> bytes:
        if not self.corrupt_every:
            return data
        out = bytearray(data)
        for i in range(len(out)):
            self._sent += 1
            if self._sent % self.corrupt_every == 0:
                out[i] ^= 0x15
        return bytes(out)

    def _event(self, event) -> None:
        if event.type == CONTROL:
            self._control(pb.Request.FromString(event.data))
        elif event.type == SENT:
            self.acknowledged.append(event.name)
            del self.spool[event.name]
        elif event.type == REFUSED:
            self.refused.append(event.name)
            del self.spool[event.name]
        elif event.type == UP:
            self.link.send_latest(0, self.status().SerializeToString())

    def status(self) -> pb.Status:
        status = pb.Status(survey_id=self.survey_id, state=self.state, frames=60, keyframes=12, fps=30.0)
        status.time.boot_id, status.time.monotonic_ns = self.boot, self._now()
        status.spool.objects = len(self.spool)
        return status

    def _control(self, request: pb.Request) -> None:
        reply = pb.Reply(id=request.id)
        match request.WhichOneof("what"):
            case "get_info":
                reply.info.survey_id, reply.info.software, reply.info.boot_id = self.survey_id, "test device", self.boot
            case "get_status":
                reply.status.CopyFrom(self.status())
            case "clock_sync":
                self.clock = request.clock_sync
            case "get_still" if any(kind == 5 for kind, _ in self.spool.values()):
                reply.error = "still: one is under way: try again"
            case "get_still" if self.stills:
                data = self.stills.pop(0)
                if data:  # else it comes to nothing
                    self.spool[hashlib.sha256(data).digest()] = (5, data)
            case "get_still":
                reply.error = "still: the survey is over, the camera gives no frames"
            case _:
                reply.error = self.cannot
        self.link.send_control(reply.SerializeToString())
