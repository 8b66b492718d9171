"""The device on a network: what each role may do, who has the line, who looks on, and who takes it over."""

import contextlib
import hashlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from pipefish._engine import Link

from crawler import PATIENCE_S, Crawler, Store, wait_for_log, wait_for_status, write_recording
from network_device import (
    IMPATIENT,
    Watcher,
    another_user,
    let_in,
    network,
    open_client,
    raw_tls,
    receiving,
    serving,
)
from pipefish import keys
from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.client import BUSY, ROLE_HOST, VIEWER, Client, Handlers, NoDevice
from pipefish.errors import PipefishError
from pipefish.flash import Flasher
from pipefish.transport import TcpTransport, TlsTransport, TransportClosed

pytestmark = pytest.mark.usefixtures("own_keys")


def test_an_operator_takes_the_whole_survey_and_the_device_says_who_he_is(device: Crawler):
    let_in(device, "operator")
    store = Store(device.port, TlsTransport)
    with store.client(device) as client:
        client.run(lambda: store.ends, PATIENCE_S)
        reply = client.answer_to(PATIENCE_S, get_status=pb.Nothing())
    assert [k.index for k in store.keyframes] == list(range(store.ends[0].keyframes)) and len(store.keyframes) > 5
    assert reply.status.network.peer == "tester" and reply.status.network.role == "operator"
    assert network(device, sessions=1)["refused_unknown"] == 0


def test_a_viewer_sees_the_status_and_can_make_the_device_forget_nothing(device: Crawler):
    let_in(device, "viewer")
    store = Watcher(device.port, TlsTransport)
    with store.client(device) as client:
        client.answer_to(PATIENCE_S, get_status=pb.Nothing())
        with pytest.raises(PipefishError, match="role operator"):
            client.answer_to(PATIENCE_S, stop_survey=pb.Nothing())
        with pytest.raises(PipefishError, match="role operator"):
            client.answer_to(PATIENCE_S, set_lamp=0.5)
        with pytest.raises(PipefishError, match="role calibrator"):
            client.answer_to(PATIENCE_S, pair=pb.Pair(key=b"\1" * 32, role="calibrator", name="friend"))
        end = time.monotonic() + 1
        client.run(lambda: time.monotonic() > end, PATIENCE_S)
    assert not store.objects
    assert wait_for_status(device, lambda s: s["network"]["sessions"] > 0)["spool"]["acknowledged"] == 0


def test_objects_that_an_operator_left_halfway_are_not_offered_to_a_viewer(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")

    class Slow(Store):
        def on_object(self, name: bytes, kind: int, data: bytes) -> None:
            self.arrivals[name] += 1  # and it never says that it has it

    slow = Slow(device.port, TlsTransport)
    with slow.client(device) as client:
        client.run(lambda: slow.arrivals, PATIENCE_S)
    viewer = another_user(tmp_path / "viewer", monkeypatch)
    let_in(device, "viewer", viewer, "visitor")
    store = Watcher(device.port, TlsTransport)
    with store.client(device) as client:
        client.answer_to(PATIENCE_S, get_status=pb.Nothing())
        end = time.monotonic() + 1
        client.run(lambda: time.monotonic() > end, PATIENCE_S)
    assert not store.objects
    assert wait_for_status(device, lambda s: s["network"]["sessions"] > 1)["spool"]["acknowledged"] == 0


def test_only_a_calibrator_may_flash(device: Crawler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    profile = b"no profile, but it must not even be looked at"
    let_in(device, "operator")
    with Flasher(TlsTransport("127.0.0.1", device.port), PATIENCE_S) as flasher:
        with pytest.raises(PipefishError, match="refuses"):
            flasher.send(profile)
        with pytest.raises(PipefishError, match="role calibrator"):
            flasher.revert()
    let_in(device, "calibrator")
    refused = pytest.raises(PipefishError, match="refuses the profile: the profile")
    with Flasher(TlsTransport("127.0.0.1", device.port), PATIENCE_S) as flasher, refused:
        flasher.send(profile)


class Taker(Store):
    """A host that wants the objects, and leaves where it may only look on."""

    losses = 0

    def on_down(self) -> None:
        self.losses += 1


def test_others_look_on_while_a_host_receives_and_can_change_nothing(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")
    with receiving(device) as store:
        other = another_user(tmp_path / "other", monkeypatch)
        let_in(device, "calibrator", other, "second")
        second = open_client(device)
        reply = second.answer_to(PATIENCE_S, get_status=pb.Nothing())
        assert reply.status.looking_on == BUSY and reply.status.network.peer == "tester"
        for what in ({"set_lamp": 0.5}, {"stop_survey": pb.Nothing()}, {"revert_profile": pb.Nothing()}):
            with pytest.raises(PipefishError, match="another host is connected to the device: until it has gone"):
                second.answer_to(PATIENCE_S, **what)
        second.close()
        with Flasher(TlsTransport("127.0.0.1", device.port), PATIENCE_S) as flasher:
            assert not flasher.state().problem
            with pytest.raises(PipefishError, match="refuses the profile: another host is connected"):
                flasher.send(b"whatever it is")
        watcher = Watcher(device.port, TlsTransport)
        with watcher.client(device) as client:
            client.run(lambda: len(watcher.statuses) > 1, PATIENCE_S)
        assert not watcher.objects
        taker = Taker(device.port, TlsTransport)
        with taker.client(device) as client:
            client.run(lambda: taker.losses, PATIENCE_S)
            with pytest.raises(NoDevice, match="another host is connected"):
                client.run(lambda: taker.objects, 0.1)
        wait_for_status(device, lambda s: s["spool"]["acknowledged"] > 5)
    # He has gone: the same host that was told so is served now.
    with taker.client(device) as client:
        client.run(lambda: client.up and taker.statuses, PATIENCE_S)
    assert len(store.objects) > 5 and network(device)["refused_busy"] == 0
    assert "host is there: tester, operator" in device.text() and "looks on: second, calibrator" in device.text()


def test_the_same_host_looks_on_while_it_receives(device: Crawler, capsys):
    let_in(device, "operator")
    with receiving(device):
        assert main(["status", f"tls://127.0.0.1:{device.port}", "--timeout", str(PATIENCE_S)]) == 0
        assert "looks on" in capsys.readouterr().out


def test_a_host_that_looked_on_or_left_gets_its_answers_when_it_has_the_device(device: Crawler, tmp_path, monkeypatch):
    """Whoever was there in between: both ends count their messages alike."""
    let_in(device, "operator")
    with receiving(device):
        other = another_user(tmp_path / "other", monkeypatch)
        let_in(device, "calibrator", other, "second")
        client = open_client(device)
        for _ in range(4):
            assert client.answer_to(PATIENCE_S, get_status=pb.Nothing()).status.looking_on == BUSY
        client.handlers.may_look_on = False
        client.run(lambda: not client.up, PATIENCE_S)
    client.run(lambda: client.up, PATIENCE_S)
    assert not client.answer_to(PATIENCE_S, get_status=pb.Nothing()).status.looking_on
    client.close()


def test_a_viewer_looks_on_and_an_operator_takes_the_line(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "viewer")
    viewer = open_client(device)
    viewer.run(lambda: viewer.up, PATIENCE_S)
    operator = another_user(tmp_path / "operator", monkeypatch)
    let_in(device, "operator", operator, "boss")
    with receiving(device):
        status = viewer.answer_to(PATIENCE_S, get_status=pb.Nothing()).status
    assert status.network.role == "operator" and status.looking_on == VIEWER
    viewer.close()


def test_more_than_three_who_look_on_are_sent_away_and_harm_nobody(device: Crawler):
    let_in(device, "operator")
    with receiving(device):
        lookers = [open_client(device) for _ in range(3)]
        for client in lookers:
            client.run(lambda client=client: client.up, PATIENCE_S)
        with serving(*lookers):
            more = open_client(device)
            assert network(device, refused_busy=1)["sessions"] == 4
            with pytest.raises(NoDevice, match="as many as it takes"):
                more.run(lambda: more.up, 0.1)
            more.close()
            wait_for_status(device, lambda s: s["link"]["visitors"] == 3)
            assert all(client.up for client in lookers)
        for client in lookers:
            client.close()
    wait_for_status(device, lambda s: s["link"]["visitors"] == 0)
    wait_for_log(device, "turned away: tester wanted to look on")


def test_a_revoked_key_ends_looking_on_too(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")
    with receiving(device):
        other = another_user(tmp_path / "other", monkeypatch)
        let_in(device, "viewer", other, "second")
        second = open_client(device)
        second.run(lambda: second.up, PATIENCE_S)
        let_in(device, "revoked", other, "second")
        second.run(lambda: not second.up, PATIENCE_S)
        second.close()


def test_an_upload_that_a_calibrator_began_is_not_finished_by_who_may_not(device: Crawler):
    """The link keeps the parts of an object over sessions, whoever was allowed to begin it."""
    let_in(device, "calibrator")
    profile = hashlib.shake_256(b"no profile").digest(8000)

    class Upload(Handlers):
        refused = False

        def on_refused(self, name: bytes) -> None:
            self.refused = True

    def begin(most: int) -> tuple[Client, Upload]:
        upload = Upload()
        client = Client(TlsTransport("127.0.0.1", device.port), upload)
        client.open()
        write, sent = client.transport.write, 0

        def write_some(data: bytes) -> int:
            nonlocal sent
            if sent >= most:
                raise TransportClosed("cut")
            taken = write(data[: most - sent])
            sent += taken
            return taken

        client.transport.write = write_some
        client.link.send_object(hashlib.sha256(profile).digest(), 4, profile)
        return client, upload

    client, _ = begin(6000)
    client.run(lambda: client.up, PATIENCE_S)
    client.run(lambda: not client.up, PATIENCE_S)
    assert client.link.stats["fragments_sent"] > 3
    client.close()
    let_in(device, "operator")
    client, upload = begin(1 << 20)
    client.run(lambda: upload.refused, PATIENCE_S)
    sent = client.link.stats["fragments_sent"] - client.link.stats["fragments_resent"]
    assert sent < 8, "the device had kept the first parts: this test proves something"
    assert "profile_store" not in device.text()
    client.close()


@IMPATIENT
def test_a_host_that_lost_its_way_takes_its_own_place_over(device: Crawler):
    let_in(device, "operator")
    lost = open_client(device)
    lost.run(lambda: lost.up, PATIENCE_S)
    again = Store(device.port, TlsTransport)  # the device has not noticed yet that the first has gone
    with again.client(device) as client:
        client.run(lambda: again.objects, PATIENCE_S)
    lost.close()


@IMPATIENT
def test_a_host_that_falls_silent_makes_room_for_another(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")
    silent = open_client(device)
    silent.run(lambda: silent.up, PATIENCE_S)
    other = another_user(tmp_path / "other", monkeypatch)
    let_in(device, "operator", other, "second")
    taker = Taker(device.port, TlsTransport)
    with taker.client(device) as client:
        client.run(lambda: taker.objects, PATIENCE_S)
    silent.close()


def test_a_device_that_stood_still_hears_its_host_before_another_gets_the_line(tmp_path: Path):
    """Suspended, or on a machine that is too busy: what a host has said meanwhile waits to be read."""
    write_recording(tmp_path / "survey.y4m", 30)
    keepalive_ms = 1000  # four of them are the time that this host may be held up for itself
    crawler = Crawler(tmp_path, link__keepalive_ms=keepalive_ms, daemon__exit_when_done="false", daemon__drain_s=0)
    crawler.start()
    store = Store(crawler.port)
    with store.client(crawler) as host:
        host.link = Link(role=ROLE_HOST, nonce=9, schema=1, max_object=1 << 20, max_control=1000, keepalive_ms=60000)
        host.run(lambda: len(store.statuses) > 1, PATIENCE_S)
        os.kill(crawler.process.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, crawler.process.pid, os.WSTOPPED | os.WNOWAIT)
        other = Client(TcpTransport("127.0.0.1", crawler.port), Handlers())
        other.open()
        end = time.monotonic() + 5 * keepalive_ms / 1000
        host.run(lambda: time.monotonic() > end, PATIENCE_S)
        host.ask(get_status=pb.Nothing())
        host.step(0)
        os.kill(crawler.process.pid, signal.SIGCONT)
        with serving(host):
            assert other.answer_to(PATIENCE_S, get_status=pb.Nothing()).status.looking_on == BUSY
        assert host.up and host.reconnections == 0
        other.close()


def test_what_is_no_host_is_not_told_as_one_that_looks_on(tmp_path: Path):
    """A page in a browser tries as often as it likes; the log has a line for each host."""
    write_recording(tmp_path / "survey.y4m", 30)
    crawler = Crawler(tmp_path, daemon__exit_when_done="false", daemon__drain_s=0)
    crawler.start()
    store = Store(crawler.port)
    with store.client(crawler) as host:
        host.run(lambda: store.statuses, PATIENCE_S)
        with serving(host):
            for _ in range(10):
                page = socket.create_connection(("127.0.0.1", crawler.port), PATIENCE_S)
                with page, contextlib.suppress(ConnectionError):
                    page.sendall(b"POST / HTTP/1.1\r\n\r\n")
                    while page.recv(4096):
                        pass
            other = Client(TcpTransport("127.0.0.1", crawler.port), Handlers())
            other.open()
            assert other.answer_to(PATIENCE_S, get_status=pb.Nothing()).status.looking_on == BUSY
        other.close()
    assert crawler.text().count("a host looks on") == 1


def test_a_peer_that_sends_garbage_inside_the_tunnel_harms_nobody(device: Crawler):
    let_in(device, "operator")
    with raw_tls(device.port, keys.host_key_file()) as s:
        block = hashlib.shake_256(b"garbage").digest(1 << 20)
        with contextlib.suppress(OSError):
            s.sendall(block)
            s.sendall(b"x" * (1 << 20) + b"\0")  # one frame of a megabyte
            s.shutdown(socket.SHUT_WR)
            while s.recv(1 << 16):  # closing with words unread would reset the line: what is under way would be lost
                pass
    client = open_client(device)
    client.run(lambda: client.up, PATIENCE_S)
    client.answer_to(PATIENCE_S, get_status=pb.Nothing())
    client.close()
    assert device.process.poll() is None
    wait_for_status(device, lambda s: s["link"]["crc_errors"] >= 1000)  # a zero in 256 bytes ends a frame


@contextlib.contextmanager
def address_of_nobody() -> Iterator[str]:
    """An address of those that documents may use, which nobody has: other runs of this test in this network see the
    name of a socket that holds it for us, and one that a killed run has left can be bound to."""
    for number in range(1, 255):
        address = f"192.0.2.{number}"
        with socket.socket(socket.AF_UNIX) as holder:
            if can_bind(holder, f"\0pipefish test {address}"):
                with socket.socket() as probe:
                    is_there = can_bind(probe, (address, 0))
                if not is_there:
                    yield address
                    return
    pytest.fail("all addresses of 192.0.2.0/24 are taken")


def can_bind(own: socket.socket, name: str | tuple[str, int]) -> bool:
    with contextlib.suppress(OSError):
        own.bind(name)
        return True
    return False


def test_an_address_of_nobody_is_another_for_each_of_those_that_run_at_the_same_time():
    with address_of_nobody() as one, address_of_nobody() as other:
        assert one != other


def test_an_address_that_comes_later_is_waited_for(tmp_path: Path, device: Crawler):
    let_in(device, "operator")
    device.kill()
    with address_of_nobody() as address:
        device.start("--set", f"link.address={address}")
        wait_for_log(device, f"does not have the address {address} yet")
        assert device.process.poll() is None
        alias = [f"{address}/32", "dev", "lo"]
        added = subprocess.run(["ip", "address", "add", *alias], capture_output=True, text=True)
        if added.returncode != 0:
            pytest.skip(f"that the device serves an address that came later is NOT tested: {added.stderr.strip()}")
        try:
            client = Client(TlsTransport(address, device.port), Handlers())
            client.open()
            client.run(lambda: client.up, PATIENCE_S)
            assert client.up
            client.close()
        finally:
            subprocess.run(["ip", "address", "del", *alias], capture_output=True)
