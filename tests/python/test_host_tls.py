"""The host's end of TLS against a device that it knows and that has fallen into wrong hands."""

from __future__ import annotations

import _ssl
import ctypes
import select
import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from crawler import PATIENCE_S
from pipefish import keys
from pipefish.transport import TlsTransport

pytestmark = pytest.mark.usefixtures("own_keys")
POINTER = ctypes.c_void_p
ANSWER = 1  # SSL_KEY_UPDATE_REQUESTED
PEM = 1  # SSL_FILETYPE_PEM
TAKEN = 65536  # bytes of the socket that one read takes
NEW_KEY = 27  # bytes of a record with a new key


class Device:
    """A device's end, in OpenSSL's own functions: Python's module sends no new keys."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self.ssl = ctypes.CDLL(_ssl.__file__)  # finds them in the library that Python itself uses
        for make in (self.ssl.TLS_server_method, self.ssl.SSL_CTX_new, self.ssl.SSL_new):
            make.restype = POINTER
        self.context = POINTER(self.ssl.SSL_CTX_new(POINTER(self.ssl.TLS_server_method())))
        pem = str(keys.host_key_file()).encode()
        assert self.ssl.SSL_CTX_use_certificate_file(self.context, pem, PEM) == 1
        assert self.ssl.SSL_CTX_use_PrivateKey_file(self.context, pem, PEM) == 1
        self.line = POINTER()

    def serve(self, talk: Callable[[], None]) -> None:
        """Lets one host in, and talks until it has gone."""
        connection, _ = self.server.accept()
        with connection:
            self.line = POINTER(self.ssl.SSL_new(self.context))
            self.ssl.SSL_set_fd(self.line, connection.fileno())
            assert self.ssl.SSL_accept(self.line) == 1
            talk()
            self.ssl.SSL_free(self.line)

    def send_key(self, kind: int = 0) -> bool:
        return self.ssl.SSL_key_update(self.line, kind) == 1 and self.ssl.SSL_do_handshake(self.line) == 1

    def say(self, word: bytes) -> None:
        assert self.ssl.SSL_write(self.line, word, len(word)) == len(word)


@pytest.fixture
def device() -> Iterator[Device]:
    keys.remember_device(keys.host_key(), "crawler")
    it = Device()
    with it.server:
        yield it


def test_new_keys_without_end_hold_the_host_up_no_longer_than_one_read_of_the_socket(device: Device):
    """Else OpenSSL is deaf to Ctrl-C and the time that it was given, for as long as the device likes."""
    count = 5 * TAKEN // NEW_KEY
    is_said = threading.Event()

    def talk() -> None:
        for _ in range(count):
            assert device.send_key()
        device.say(b"x")
        is_said.set()
        host_has_gone.wait(PATIENCE_S)

    host_has_gone = threading.Event()
    thread = threading.Thread(target=device.serve, args=(talk,))
    thread.start()
    host = TlsTransport("127.0.0.1", device.port)
    host.open()
    host._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    is_said.wait(PATIENCE_S)  # nearly all of it waits in the host's socket
    heard, reads = b"", 0
    while not heard:
        assert select.select([host], [], [], PATIENCE_S)[0]
        heard = host.read()
        reads += 1
    assert heard == b"x" and reads >= 5
    host_has_gone.set()
    thread.join()
    host.close()


def test_a_device_that_asks_for_answers_and_takes_none_does_not_fill_the_host_s_memory(device: Device):
    def talk() -> None:
        while device.send_key(ANSWER):
            pass

    device.server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # it fills up at once
    thread = threading.Thread(target=device.serve, args=(talk,))
    thread.start()
    host = TlsTransport("127.0.0.1", device.port)
    host.open()
    host._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    for _ in range(100):
        assert select.select([host], [], [], PATIENCE_S)[0]
        assert host.read() == b""
    assert len(host._unsent) + host._outgoing.pending < 2 * TAKEN
    assert host.write(b"y") == 0 and host.waiting() > 4096
    host.close()
    thread.join()
