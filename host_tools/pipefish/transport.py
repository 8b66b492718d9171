"""Byte streams to a device: serial line, TCP or TLS, non-blocking, with a file descriptor to wait on."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import socket
import ssl
import struct
import termios
import time
from abc import ABC, abstractmethod

from pipefish.errors import PipefishError

DEFAULT_BAUD = 921600
DEFAULT_PORT = 7447
CONNECT_TIMEOUT_S = 5.0
LEAST_WAIT_S = 0.01  # for what is here already, though the time is up
RTSCTS = ",rtscts"  # behind the speed in a serial line's address


class TransportClosed(PipefishError):
    """The line is gone: cable out, adapter removed, peer closed the connection. Reopening may help.

    reason    without the name of the line
    is_final  waiting does not help: we may not open it, or it is no line"""

    def __init__(self, text: str, cause: Exception | None = None, reason: str = "") -> None:
        super().__init__(text)
        self.reason = reason or (text if cause is None else _reason(cause))
        self.is_final = _number(cause) in (errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOTTY)


def _reason(error: Exception) -> str:
    """The system's text for an error number, without what libraries put around it."""
    if isinstance(error, socket.gaierror):
        return error.strerror
    if isinstance(error, ssl.SSLError):  # its numbers are OpenSSL's, not the system's
        ended = isinstance(error, ssl.SSLZeroReturnError | ssl.SSLEOFError)
        return "the device closed the connection" if ended else error.reason or str(error)
    number = _number(error)
    if number == errno.ENOTTY:
        return "not a serial line"
    return os.strerror(number) if number else str(error)


def _number(error: BaseException | None) -> int:
    """The system's error number, also where a library has wrapped the error; 0 if there is none."""
    while error is not None and not isinstance(error, ssl.SSLError):  # whose numbers are OpenSSL's own
        number = error.args[0] if isinstance(error, termios.error) else getattr(error, "errno", None)
        if isinstance(number, int) and number > 0:
            return number
        error = error.__context__
    return 0


class Refused(PipefishError):
    """The other end does not let us in, or is not whom we know: opening it again does not help."""


class Transport(ABC):
    """One byte stream. `open` may be called again after TransportClosed."""

    name: str  # as the user wrote it

    @abstractmethod
    def open(self) -> None:
        """Opens the stream. Raises TransportClosed with the reason if it cannot be opened now."""

    @abstractmethod
    def fileno(self) -> int:
        """File descriptor for select."""

    @abstractmethod
    def read(self) -> bytes:
        """What has arrived, at most 64 KiB; b"" if nothing. Raises TransportClosed."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Takes as many bytes as fit now; returns how many. Raises TransportClosed."""

    @abstractmethod
    def waiting(self) -> int:
        """Bytes written that the line has not taken yet."""

    @abstractmethod
    def close(self) -> None:
        """Closes the stream; again is harmless."""


# What errors of opening a serial line mean.
SERIAL_REASONS = {
    errno.EACCES: "Permission denied (is this user in the device's group, dialout?)",
    errno.EAGAIN: "another program has it open (a pipefish receive?)",
    errno.EBUSY: "another program has it open (a pipefish receive?)",
}


class SerialTransport(Transport):
    """A serial device, 8N1, with hardware flow control if asked for; locked against other programs."""

    def __init__(self, path: str, baud: int, rtscts: bool = False) -> None:
        self.name = f"serial:{path}@{baud}" + (RTSCTS if rtscts else "")
        self.path = path
        self.baud = baud
        self.rtscts = rtscts
        self._port = None

    def open(self) -> None:
        import serial

        self.close()
        try:
            self._port = serial.Serial(
                self.path, self.baud, timeout=0, write_timeout=0, exclusive=True, rtscts=self.rtscts
            )
            self._port.reset_input_buffer()
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
            reason = SERIAL_REASONS.get(_number(error), _reason(error))
            raise TransportClosed(f"{self.path}: {reason}", error, reason) from error

    def fileno(self) -> int:
        return self._port.fileno() if self._port is not None else -1

    def read(self) -> bytes:
        try:
            return self._port.read(65536)
        except (OSError, TypeError, AttributeError, termios.error) as error:
            raise TransportClosed(f"{self.path}: {_reason(error)}") from error

    def write(self, data: bytes) -> int:
        import serial

        try:
            return self._port.write(data) or 0
        except serial.SerialTimeoutException:
            return 0
        except (OSError, TypeError, AttributeError, termios.error) as error:
            raise TransportClosed(f"{self.path}: {_reason(error)}") from error

    def waiting(self) -> int:
        try:
            return self._port.out_waiting
        except (OSError, AttributeError, termios.error) as error:
            raise TransportClosed(f"{self.path}: {_reason(error)}") from error

    def close(self) -> None:
        if self._port is not None:
            port, self._port = self._port, None
            port.close()


class TcpTransport(Transport):
    """A TCP connection."""

    _heard = False  # the device has said something since it was opened

    scheme = "tcp"
    at_once = "other hosts are connected to the device, as many as it takes, or it speaks TLS (tls:// instead?)"

    def __init__(self, host: str, port: int) -> None:
        self.name = f"{self.scheme}://{f'[{host}]' if ':' in host else host}:{port}"
        self.address = (host, port)
        self._socket: socket.socket | None = None

    def open(self) -> None:
        self.close()
        try:
            self._socket = socket.create_connection(self.address, timeout=CONNECT_TIMEOUT_S)
            self._heard = False
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.setblocking(False)
        except OSError as error:
            raise TransportClosed(f"{self.name}: {_reason(error)}", error) from error

    def fileno(self) -> int:
        return self._socket.fileno() if self._socket is not None else -1

    def read(self) -> bytes:
        data = self._receive()
        self._heard = self._heard or bool(data)
        return data

    def _receive(self) -> bytes:
        """What the socket has, at most 64 KiB."""
        if self._socket is None:
            raise TransportClosed(f"{self.name}: not connected")
        try:
            data = self._socket.recv(65536)
        except (BlockingIOError, InterruptedError):
            return b""
        except ConnectionResetError as error:
            raise self._ended() from error
        except OSError as error:
            raise TransportClosed(f"{self.name}: {_reason(error)}") from error
        if not data:
            raise self._ended()
        return data

    def _ended(self) -> TransportClosed:
        why = "the device closed the connection"
        if not self._heard:
            why = self.at_once
        return TransportClosed(f"{self.name}: {why}", reason=why)

    def write(self, data: bytes) -> int:
        if self._socket is None:
            raise TransportClosed(f"{self.name}: not connected")
        try:
            return self._socket.send(data)
        except (BlockingIOError, InterruptedError):
            return 0
        except (ConnectionResetError, BrokenPipeError) as error:
            raise self._ended() from error
        except OSError as error:
            raise TransportClosed(f"{self.name}: {_reason(error)}") from error

    def waiting(self) -> int:
        if self._socket is None:
            raise TransportClosed(f"{self.name}: not connected")
        try:
            raw = fcntl.ioctl(self._socket.fileno(), termios.TIOCOUTQ, b"\0\0\0\0")
        except OSError as error:
            raise TransportClosed(f"{self.name}: {_reason(error)}") from error
        return struct.unpack("i", raw)[0]

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


# What OpenSSL reports of a device that sent us away, and what it means.
REFUSALS = {
    "BAD_CERTIFICATE": "the device does not know this host's key: pair first (pipefish pair)",
    "CERTIFICATE_REVOKED": "the device has revoked this host's key",
    "CERTIFICATE_REQUIRED": "the device wants a certificate",
    "PROTOCOL_VERSION": "the other end has no TLS 1.3",
    "WRONG_VERSION_NUMBER": "the other end speaks no TLS (tcp:// instead?)",
}


class TlsTransport(TcpTransport):
    """Mutual TLS 1.3 (docs/network.md): this host's key, and only devices that it knows.

    OpenSSL gets the bytes from here, not from the socket: given that, one call goes on, deaf to Ctrl-C, for as long as
    a device sends new keys instead of data.

    device    name of the device at the other end, once opened"""

    scheme = "tls"
    at_once = "other hosts are connected to the device, as many as it takes"

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port)
        self.device = ""
        self._tls: ssl.SSLObject | None = None
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._unsent = b""  # of what OpenSSL wants to send

    def _context(self) -> ssl.SSLContext:
        from pipefish.keys import host_key_file

        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        # Neither a name nor an issuer counts, only the key, which is looked at before a byte is sent.
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        path = host_key_file()
        try:
            context.load_cert_chain(path)
        except (ssl.SSLError, OSError) as error:
            raise PipefishError(f"{path}: no private key with its certificate: remove it and pair again") from error
        return context

    def _failed(self, error: OSError) -> PipefishError:
        said = getattr(error, "reason", None) or ""
        for word, reason in REFUSALS.items():
            if word in said:
                return Refused(f"{self.name}: {reason}")
        return TransportClosed(f"{self.name}: {_reason(error)}", error)

    def open(self) -> None:
        from pipefish.keys import certificate_key, known_devices

        context = self._context()
        devices = known_devices()
        super().open()
        self._incoming, self._outgoing, self._unsent = ssl.MemoryBIO(), ssl.MemoryBIO(), b""
        self._tls = context.wrap_bio(self._incoming, self._outgoing)
        try:
            self._handshake(self._tls, self._socket)
            key = certificate_key(self._tls.getpeercert(binary_form=True) or b"")
            self._socket.setblocking(False)
        except ValueError as error:
            self.close()
            raise TransportClosed(f"{self.name}: the device shows no key") from error
        except (ssl.SSLZeroReturnError, ssl.SSLEOFError, ConnectionError) as error:
            self.close()
            why = "the device broke the handshake off: too many at once, or five of this address failed within a minute"
            raise TransportClosed(f"{self.name}: {why}", reason=why) from error
        except TimeoutError as error:
            self.close()
            raise TransportClosed(f"{self.name}: the device does not answer the handshake", error) from error
        except OSError as error:
            self.close()
            raise self._failed(error) from error
        if key not in devices:
            self.close()
            known = ", ".join(f"{name} {k}" for k, name in devices.items())
            raise Refused(
                f"{self.name}: a device that this host does not know (key {key}"
                + (f"; known: {known}" if known else "")
                + "). If it is yours, pair with it: pipefish pair"
            )
        self.device = devices[key]

    def _handshake(self, tls: ssl.SSLObject, line: socket.socket) -> None:
        end = time.monotonic() + CONNECT_TIMEOUT_S
        is_done = False
        while not is_done:
            try:
                tls.do_handshake()
                is_done = True
            except ssl.SSLWantReadError:
                pass
            line.settimeout(max(end - time.monotonic(), LEAST_WAIT_S))
            line.sendall(self._outgoing.read())
            if not is_done and not self._incoming.write(line.recv(65536)):
                self._incoming.write_eof()

    def _send(self) -> bool:
        """Gives the socket what OpenSSL wants to send. True: the socket has taken all of it."""
        self._unsent += self._outgoing.read()
        while self._unsent:
            taken = super().write(self._unsent)
            if taken == 0:
                return False
            self._unsent = self._unsent[taken:]
        return True

    def read(self) -> bytes:
        if self._tls is None:
            raise TransportClosed(f"{self.name}: not connected")
        # A device that asks for answers and takes none is not listened to: they would fill our memory.
        received = self._receive() if self._send() else b""
        if not received:
            return b""
        self._incoming.write(received)
        data, is_over = bytearray(), False
        try:
            while not is_over:  # all of it: for what is decrypted already no descriptor becomes readable
                part = self._tls.read(65536)
                is_over = not part
                data += part
        except ssl.SSLWantReadError:
            pass
        except OSError as error:
            raise self._failed(error) from error
        if is_over and not data:
            raise self._ended()
        self._heard = self._heard or bool(data)
        return bytes(data)

    def write(self, data: bytes) -> int:
        if self._tls is None:
            raise TransportClosed(f"{self.name}: not connected")
        if not self._send():
            return 0
        try:
            taken = self._tls.write(data)
        except OSError as error:
            raise self._failed(error) from error
        self._send()
        return taken

    def waiting(self) -> int:
        return super().waiting() + len(self._unsent)

    def close(self) -> None:
        super().close()
        self._tls = None


def open_transport(address: str, baud: int | None = None) -> Transport:
    """A transport, not yet opened, for `serial:/dev/ttyUSB0@3000000`, `/dev/ttyUSB0` (speed from `baud`), the same with
    `@3000000,rtscts` for hardware flow control, `tls://host:port` or `tcp://host:port`.

    Raises PipefishError if the address makes no sense.
    """
    if address.startswith(("tcp://", "tls://")):
        match = re.fullmatch(r"t(?:cp|ls)://(\[[0-9a-fA-F:.]+(?:%[\w.-]+)?\]|[^\[\]/:]+)(?::(\d+))?/?", address)
        port = int(match[2] or DEFAULT_PORT) if match else 0
        if not match or not 0 < port < 65536:
            raise PipefishError(
                f"'{address}' is no address; write tls://host:port, for example tls://10.0.0.7:{DEFAULT_PORT}"
            )
        return (TlsTransport if address[1] == "l" else TcpTransport)(match[1].strip("[]"), port)
    path = address.removeprefix("serial:")
    is_host = address == path and re.fullmatch(r"[\w.-]+:\d+|(\d+\.){3}\d+", path) is not None  # its tcp:// forgotten
    if "://" in path or not path or is_host:
        raise PipefishError(
            f"'{address}' is no device; write /dev/ttyUSB0, serial:/dev/ttyUSB0@3000000, tls://host:port or tcp://host:port"
        )
    path, at, speed = path.rpartition("@") if re.search(rf"@\d*({RTSCTS})?$", path) else (path, "", "")
    rtscts = speed.endswith(RTSCTS)
    speed = speed.removesuffix(RTSCTS)
    if at:
        if not speed:
            raise PipefishError(f"'{address}' has no speed after the @; write for example serial:{path}@{DEFAULT_BAUD}")
        baud = int(speed)
    baud = DEFAULT_BAUD if baud is None else baud
    if not 1200 <= baud <= 12_000_000:
        raise PipefishError(f"{baud} baud is out of range (1200 to 12000000)")
    return SerialTransport(path, baud, rtscts)
