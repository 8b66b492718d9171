"""A daemon on a network, its owner at its console, and hosts that come to it: for the tests of TLS, trust and lines."""

import contextlib
import socket
import ssl
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from crawler import PATIENCE_S, Crawler, Store, find_daemon, wait_for_status
from pipefish import keys
from pipefish.client import Client, Handlers
from pipefish.transport import TlsTransport

# Hosts count as gone after 0.8 s of silence, not 20 s: where that is the subject, for a busy machine is silent so long.
IMPATIENT = pytest.mark.parametrize("device", [200], indirect=True, ids=["impatient"])


def let_in(crawler: Crawler, role: str, key: str | None = None, name: str = "tester") -> str:
    """What the device's owner does on its console; returns the device's key, which this host then knows."""
    out = subprocess.run(
        [find_daemon(), "--config", crawler.config, "--pair", f"{role} {key or keys.host_key()} {name}"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    device = out.split("this device's key: ")[1].strip()
    keys.remember_device(device, "crawler")
    return device


def another_user(folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """From now on we are somebody else; returns his key."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(folder))
    return keys.host_key()


def open_client(crawler: Crawler) -> Client:
    client = Client(TlsTransport("127.0.0.1", crawler.port), Handlers())
    client.open()
    return client


def network(crawler: Crawler, **wanted: int) -> dict:
    """The counters of the status file, once those `wanted` are reached."""
    status = wait_for_status(crawler, lambda s: all(s["network"][key] >= value for key, value in wanted.items()))
    return status["network"]


def raw_tls(port: int, pem: Path | None = None, newest: ssl.TLSVersion = ssl.TLSVersion.TLSv1_3) -> ssl.SSLSocket:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.maximum_version = newest
    if pem is not None:
        context.load_cert_chain(pem)
    wrapped = context.wrap_socket(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
    wrapped.settimeout(PATIENCE_S)
    return wrapped


class Watcher(Store):
    """A host that would take objects, and is content with looking on."""

    may_look_on = True


@contextlib.contextmanager
def serving(*clients: Client) -> Iterator[None]:
    """Serves what the clients hear, in a thread."""
    running = True

    def serve() -> None:
        while running:
            for client in clients:
                client.step(0.05 / len(clients))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        running = False
        thread.join()


@contextlib.contextmanager
def receiving(device: Crawler) -> Iterator[Store]:
    """An operator who keeps the line; what he has received."""
    store = Store(device.port, TlsTransport)
    with store.client(device) as client:
        client.run(lambda: client.up, PATIENCE_S)
        with serving(client):
            yield store
        client.run(lambda: client.up, PATIENCE_S)  # of a busy machine's device nothing may be heard for a while
        assert client.reconnections == 0, "who looks on has disturbed him"
