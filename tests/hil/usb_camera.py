"""A USB camera made of recorded frames: a video class device behind the kernel's USB/IP, so that the board's own
uvcvideo sees it plugged in, streams from it, and loses it again.

Protocols: USB/IP as in the kernel's Documentation/usb/usbip_protocol.rst, without its import handshake (the board hands
the connected socket to vhci_hcd itself); USB Video Class 1.1, one grey format over a bulk endpoint."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections import deque

SUBMIT, UNLINK, RET_SUBMIT, RET_UNLINK = 1, 2, 3, 4
STALL, CONNRESET = -32, -104
PAYLOAD = 16384  # most bytes of one transfer, its header of two included
Y800 = b"Y800" + bytes.fromhex("00001000800000aa00389b71")
GET_CUR, GET_LEN, GET_INFO = 0x81, 0x85, 0x86
ADDRESS = "65537 3"  # vhci's device id, and USB_SPEED_HIGH
TEXTS = {1: "Pipefish", 2: "recorded frames", 3: "0001"}


def descriptor(kind: int, *fields: bytes) -> bytes:
    body = bytes([kind]) + b"".join(fields)
    return bytes([len(body) + 1]) + body


class UsbCamera:
    """Serves one board at a time on a port of this machine; its frames are seen while it plays."""

    def __init__(self, frames: list[bytes], width: int, height: int, rate: int) -> None:
        self.frames, self.width, self.height = frames, width, height
        self.interval = 10_000_000 // rate  # of 100 ns
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._changed = threading.Condition()
        self._period: float | None = None  # seconds from one frame to the next, None: no more
        self._next = 0  # frame
        self._transfers: deque[tuple[int, int]] = deque()  # that wait for pixels: sequence number, length
        self._stream = 0  # of which start of the stream a frame is part
        self._line: socket.socket | None = None
        self._sending = threading.Lock()
        self._over = False
        for work in (self._serve, self._feed):
            threading.Thread(target=work, daemon=True).start()

    def play(self, rate: float) -> None:
        """Shows the frames from now on, one after the other and over and over, `rate` a second, to whoever streams."""
        with self._changed:
            self._period = 1 / rate
            self._changed.notify_all()

    def hush(self) -> None:
        """Plugged in, but shows nothing more."""
        with self._changed:
            self._period = None

    def close(self) -> None:
        with self._changed:
            self._over = True
            self._changed.notify_all()
        for line in (self._line, self._server):
            with contextlib.suppress(OSError, AttributeError):
                line.shutdown(socket.SHUT_RDWR)
                line.close()

    # ---- descriptors

    def _device(self) -> bytes:
        return descriptor(1, struct.pack("<HBBBBHHHBBBB", 0x200, 0xEF, 2, 1, 64, 0x1209, 1, 0x100, 1, 2, 3, 1))

    def _configuration(self) -> bytes:
        size = self.width * self.height
        bits = size * 8 * 10_000_000 // self.interval
        camera = descriptor(0x24, struct.pack("<BBHBBHHHB", 2, 1, 0x201, 0, 0, 0, 0, 0, 3), bytes(3))
        output = descriptor(0x24, struct.pack("<BBHBBB", 3, 2, 0x101, 0, 1, 0))
        length = 13 + len(camera) + len(output)
        control = descriptor(0x24, struct.pack("<BHHIBB", 1, 0x110, length, 48_000_000, 1, 1)) + camera + output
        pixels = descriptor(0x24, struct.pack("<BBB", 4, 1, 1), Y800, struct.pack("<BBBBBB", 8, 1, 0, 0, 0, 0))
        frame = descriptor(
            0x24,
            struct.pack("<BBBHHII", 5, 1, 0, self.width, self.height, bits, bits),
            struct.pack("<IIBI", size, self.interval, 1, self.interval),
        )
        matching = descriptor(0x24, bytes([13, 1, 1, 4]))
        formats = pixels + frame + matching
        header = struct.pack("<BBHBBBBBBBB", 1, 1, 14 + len(formats), 0x81, 0, 2, 0, 0, 0, 1, 0)
        streaming = descriptor(0x24, header) + formats
        body = (
            descriptor(11, bytes([0, 2, 14, 3, 0, 2]))  # both interfaces are one function
            + descriptor(4, bytes([0, 0, 0, 14, 1, 0, 2]))
            + control
            + descriptor(4, bytes([1, 0, 1, 14, 2, 0, 0]))
            + streaming
            + descriptor(5, struct.pack("<BBHB", 0x81, 2, 512, 0))
        )
        return descriptor(2, struct.pack("<HBBBBB", 9 + len(body), 2, 1, 0, 0x80, 50)) + body

    def _text(self, index: int) -> bytes:
        return descriptor(3, b"\x09\x04" if index == 0 else TEXTS.get(index, "").encode("utf-16le"))

    def _probe(self) -> bytes:
        size = self.width * self.height
        head = struct.pack("<HBBIHHHHH", 1, 1, 1, self.interval, 0, 0, 0, 0, 0)
        return head + struct.pack("<IIIBBBB", size, PAYLOAD, 48_000_000, 0, 0, 0, 0)

    # ---- requests

    def _reply(self, number: int, status: int, data: bytes = b"", length: int | None = None) -> None:
        head = struct.pack(
            ">5I5i8x", RET_SUBMIT, number, 0, 0, 0, status, len(data) if length is None else length, 0, -1, 0
        )
        with self._sending:
            self._line.sendall(head + data)

    def _restart(self) -> None:
        with self._changed:
            self._stream += 1
            self._changed.notify_all()

    def _control(self, number: int, setup: bytes, written: int) -> None:
        kind, request, value, _, most = struct.unpack("<BBHHH", setup)
        answer: bytes | None = None
        if kind & 0x60 == 0 and request == 6:  # standard: a descriptor
            index = value & 0xFF
            answer = {1: self._device, 2: self._configuration, 3: lambda: self._text(index)}.get(
                value >> 8, lambda: None
            )()
        elif kind & 0x60 == 0:  # standard: status, addresses, settings; clearing a halt ends a stream
            if request == 1:
                self._restart()
            answer = bytes(2) if request == 0 else b""
        elif kind & 0x80 == 0:  # of the class: probe, or commit, which begins a stream
            if value >> 8 == 2:
                self._restart()
            answer = b""
        elif request == GET_LEN:
            answer = struct.pack("<H", len(self._probe()))
        elif request == GET_INFO:
            answer = b"\x03"
        elif request >= GET_CUR:
            answer = self._probe()
        if answer is None:
            self._reply(number, STALL)
        elif kind & 0x80:
            self._reply(number, 0, answer[:most])
        else:
            self._reply(number, 0, b"", written)

    def _unlink(self, number: int, victim: int) -> None:
        with self._changed:
            before = len(self._transfers)
            self._transfers = deque(t for t in self._transfers if t[0] != victim)
            status = CONNRESET if len(self._transfers) < before else 0
        with self._sending:
            self._line.sendall(struct.pack(">5Ii24x", RET_UNLINK, number, 0, 0, 0, status))

    def _requests(self, line: socket.socket) -> None:
        stream = line.makefile("rb")
        while len(head := stream.read(48)) == 48:
            command, number, _, direction, endpoint = struct.unpack(">5I", head[:20])
            if command == UNLINK:
                self._unlink(number, struct.unpack(">I", head[20:24])[0])
                continue
            length = struct.unpack(">i", head[24:28])[0]
            written = stream.read(length) if direction == 0 and length > 0 else b""
            if endpoint == 0:
                self._control(number, head[40:48], len(written))
                continue
            with self._changed:
                self._transfers.append((number, length))
                self._changed.notify_all()

    def _serve(self) -> None:
        while not self._over:
            try:
                line, _ = self._server.accept()
            except OSError:
                return
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._line = line
            with contextlib.suppress(OSError), line:
                self._requests(line)
            with self._changed:  # unplugged
                self._transfers.clear()
                self._stream += 1
                self._changed.notify_all()

    # ---- pixels

    def _transfer(self, stream: int) -> tuple[int, int] | None:
        """The next one that waits for pixels; None when the stream of this frame is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._over or self._stream != stream or self._transfers)
            return None if self._over or self._stream != stream else self._transfers.popleft()

    def _feed(self) -> None:
        toggle, due = 0, 0.0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._over or (self._period is not None and self._transfers))
                if self._over:
                    return
                period, stream = self._period, self._stream
            now = time.monotonic()
            due = max(due + period, now)
            time.sleep(due - now)
            pixels, at = self.frames[self._next % len(self.frames)], 0
            while at < len(pixels) and (transfer := self._transfer(stream)):
                number, length = transfer
                part = pixels[at : at + min(length, PAYLOAD) - 2]
                at += len(part)
                flags = 0x80 | toggle | (2 if at == len(pixels) else 0)
                with contextlib.suppress(OSError):
                    self._reply(number, 0, bytes([2, flags]) + part)
            toggle ^= 1
            if at > 0:  # else it is for the next stream
                self._next += 1
