"""The device on a network: who gets in, what each role may do, and that who does not get in harms nobody."""

import contextlib
import hashlib
import os
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from crawler import Crawler, Store, find_daemon, wait_for_log, write_recording
from pipefish import keys
from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.client import BUSY, VIEWER, Client, Handlers, NoDevice
from pipefish.errors import PipefishError
from pipefish.flash import Flasher
from pipefish.transport import Refused, TlsTransport, TransportClosed


@pytest.fixture(autouse=True)
def own_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "host"))


@pytest.fixture
def device(tmp_path: Path):
    """A daemon that serves until it is told to stop, with a small survey in its spool."""
    write_recording(tmp_path / "survey.y4m", 30)
    crawler = Crawler(
        tmp_path,
        link__transport="tls",
        link__trust=tmp_path / "trust",
        link__keepalive_ms=200,
        camera__profile_store=tmp_path / "profiles",
        daemon__exit_when_done="false",
        daemon__drain_s=0,
    )
    crawler.start()
    wait_for_log(crawler, "127.0.0.1:")
    yield crawler
    if crawler.process.poll() is None:
        crawler.kill()


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
    end = time.monotonic() + 15
    counters: dict = {}
    while time.monotonic() < end:
        with contextlib.suppress(OSError, ValueError, KeyError):
            counters = crawler.status()["network"]
            if all(counters[key] >= value for key, value in wanted.items()):
                return counters
        time.sleep(0.05)
    pytest.fail(f"wanted {wanted}, the device counts {counters}")


def raw_tls(port: int, pem: Path | None = None, newest: ssl.TLSVersion = ssl.TLSVersion.TLSv1_3) -> ssl.SSLSocket:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.maximum_version = newest
    if pem is not None:
        context.load_cert_chain(pem)
    wrapped = context.wrap_socket(socket.create_connection(("127.0.0.1", port), 5))
    wrapped.settimeout(5)
    return wrapped


def connect_from(address: str, port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), 5, (address, 0))


def own_certificate(path: Path, since: str, until: str) -> str:
    """A P-256 key with a certificate of those years, as one PEM; returns its key."""
    import datetime

    key = generate_private_key(SECP256R1())
    name = x509.Name([])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.datetime.fromisoformat(since))
        .not_valid_after(datetime.datetime.fromisoformat(until))
        .sign(key, SHA256())
    )
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    path.write_bytes(private + certificate.public_bytes(Encoding.PEM))
    return keys.certificate_key(certificate.public_bytes(Encoding.DER))


class Watcher(Store):
    """A host that would take objects, and is content with looking on."""

    may_look_on = True


def test_an_operator_takes_the_whole_survey_and_the_device_says_who_he_is(device: Crawler):
    let_in(device, "operator")
    store = Store(device.port, TlsTransport)
    with store.client() as client:
        client.run(lambda: store.ends, 20)
        reply = client.answer_to(5, get_status=pb.Nothing())
    assert [k.index for k in store.keyframes] == list(range(store.ends[0].keyframes)) and len(store.keyframes) > 5
    assert reply.status.network.peer == "tester" and reply.status.network.role == "operator"
    assert network(device, sessions=1)["refused_unknown"] == 0


def test_a_viewer_sees_the_status_and_can_make_the_device_forget_nothing(device: Crawler):
    let_in(device, "viewer")
    store = Watcher(device.port, TlsTransport)
    with store.client() as client:
        client.answer_to(5, get_status=pb.Nothing())
        with pytest.raises(PipefishError, match="role operator"):
            client.answer_to(5, stop_survey=pb.Nothing())
        with pytest.raises(PipefishError, match="role operator"):
            client.answer_to(5, set_lamp=0.5)
        with pytest.raises(PipefishError, match="role calibrator"):
            client.answer_to(5, pair=pb.Pair(key=b"\1" * 32, role="calibrator", name="friend"))
        end = time.monotonic() + 1
        client.run(lambda: time.monotonic() > end, 5)
    assert not store.objects
    assert device.status()["spool"]["acknowledged"] == 0


def test_objects_that_an_operator_left_halfway_are_not_offered_to_a_viewer(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")

    class Slow(Store):
        def on_object(self, name: bytes, kind: int, data: bytes) -> None:
            self.arrivals[name] += 1  # and it never says that it has it

    slow = Slow(device.port, TlsTransport)
    with slow.client() as client:
        client.run(lambda: slow.arrivals, 10)
    viewer = another_user(tmp_path / "viewer", monkeypatch)
    let_in(device, "viewer", viewer, "visitor")
    store = Watcher(device.port, TlsTransport)
    with store.client() as client:
        client.answer_to(5, get_status=pb.Nothing())
        end = time.monotonic() + 1
        client.run(lambda: time.monotonic() > end, 5)
    assert not store.objects and device.status()["spool"]["acknowledged"] == 0


def test_only_a_calibrator_may_flash(device: Crawler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    profile = b"no profile, but it must not even be looked at"
    let_in(device, "operator")
    with Flasher(TlsTransport("127.0.0.1", device.port), 5) as flasher:
        with pytest.raises(PipefishError, match="refuses"):
            flasher.send(profile)
        with pytest.raises(PipefishError, match="role calibrator"):
            flasher.revert()
    let_in(device, "calibrator")
    refused = pytest.raises(PipefishError, match="refuses the profile: the profile")
    with Flasher(TlsTransport("127.0.0.1", device.port), 5) as flasher, refused:
        flasher.send(profile)


def test_an_unknown_host_is_sent_away_with_the_remedy_and_counted(device: Crawler):
    keys.remember_device(let_in(device, "operator", "ab" * 32, "somebody"), "crawler")
    client = open_client(device)  # the handshake of TLS 1.3 ends for the host before the device has looked at its key
    with pytest.raises(Refused, match="pair first"):
        client.run(lambda: client.up, 5)
    client.close()
    assert network(device, refused_unknown=1)["sessions"] == 0


def test_a_device_with_another_key_gets_not_a_byte(device: Crawler):
    let_in(device, "operator")
    keys.forget_device("crawler")
    keys.remember_device("cd" * 32, "crawler")
    with pytest.raises(Refused, match="does not know"):
        open_client(device)


def test_a_revoked_key_ends_its_session_at_once_and_never_comes_back(device: Crawler, tmp_path: Path):
    let_in(device, "operator")
    client = open_client(device)
    client.run(lambda: client.up, 5)
    let_in(device, "revoked")
    client.run(lambda: not client.up, 5)
    with pytest.raises(Refused, match="revoked"):
        client.run(lambda: client.up, 5)
    client.close()
    assert network(device, refused_revoked=1)
    again = subprocess.run(
        [find_daemon(), "--config", device.config, "--pair", f"operator {keys.host_key()} me"], capture_output=True
    )
    assert again.returncode == 1 and b"revoked" in again.stderr


def test_no_certificate_an_old_tls_and_no_tls_at_all_are_refused(device: Crawler, tmp_path: Path):
    let_in(device, "operator")
    with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"), raw_tls(device.port) as s:
        s.recv(1)
    with pytest.raises(ssl.SSLError, match="PROTOCOL_VERSION"):
        raw_tls(device.port, keys.host_key_file(), ssl.TLSVersion.TLSv1_2)
    with socket.create_connection(("127.0.0.1", device.port), 5) as s:
        s.sendall(b"GET / HTTP/1.1\r\n\r\n")
        s.settimeout(5)
        with contextlib.suppress(ConnectionError):
            while s.recv(4096):
                pass
    assert network(device, refused_handshake=3)["sessions"] == 0
    client = open_client(device)
    client.run(lambda: client.up, 5)
    client.close()


def test_dates_of_certificates_mean_nothing(device: Crawler, tmp_path: Path):
    for name, since, until in (("past", "1990-01-01", "1991-01-01"), ("future", "2090-01-01", "2091-01-01")):
        let_in(device, "operator", own_certificate(tmp_path / name, since, until), name)
        with raw_tls(device.port, tmp_path / name) as s:
            assert s.recv(1)  # the device begins to talk


def test_a_recorded_session_cannot_be_played_again(device: Crawler):
    let_in(device, "operator")
    sent = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as proxy:

        def carry() -> None:
            near, _ = proxy.accept()
            with near, socket.create_connection(("127.0.0.1", device.port)) as far:

                def back() -> None:
                    with contextlib.suppress(OSError):
                        while data := far.recv(65536):
                            near.sendall(data)

                threading.Thread(target=back, daemon=True).start()
                with contextlib.suppress(OSError):
                    while data := near.recv(65536):
                        sent.extend(data)
                        far.sendall(data)

        thread = threading.Thread(target=carry, daemon=True)
        thread.start()
        client = Client(TlsTransport("127.0.0.1", proxy.getsockname()[1]), Handlers())
        client.open()
        client.run(lambda: client.up, 5)
        client.close()
        thread.join(5)
    before = network(device, sessions=1)["sessions"]
    with socket.create_connection(("127.0.0.1", device.port), 5) as s:
        s.sendall(bytes(sent))
        s.settimeout(8)
        with contextlib.suppress(OSError):
            while s.recv(65536):
                pass
    counters = network(device, refused_handshake=1)
    assert counters["sessions"] == before


def test_slow_and_too_many_handshakes_do_not_keep_a_host_out(device: Crawler):
    let_in(device, "operator")
    loris = [connect_from("127.0.0.2", device.port) for _ in range(6)]
    try:
        for s in loris:
            with contextlib.suppress(OSError):
                s.sendall(b"\x16")
        client = open_client(device)
        client.run(lambda: client.up, 3)
        client.close()
        counters = network(device, refused_often=4, refused_late=2)
        assert counters["sessions"] == 1
    finally:
        for s in loris:
            s.close()


def test_an_address_that_failed_five_times_waits_while_others_come_in(device: Crawler):
    let_in(device, "operator")
    for _ in range(8):
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", device.port), 5, ("127.0.0.3", 0)) as s,
        ):
            s.sendall(b"garbage\r\n\r\n")
            s.settimeout(5)
            while s.recv(100):
                pass
    counters = network(device, refused_often=3, refused_handshake=5)
    assert counters["refused_handshake"] == 5
    client = open_client(device)
    client.run(lambda: client.up, 5)
    client.close()


@contextlib.contextmanager
def serving(*clients: Client):
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
def receiving(device: Crawler):
    """An operator who keeps the line; what he has received."""
    store = Store(device.port, TlsTransport)
    with store.client() as client:
        client.run(lambda: client.up, 5)
        with serving(client):
            yield store
        assert client.up and client.reconnections == 0, "who looks on has disturbed him"


def test_others_look_on_while_a_host_receives_and_can_change_nothing(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")
    with receiving(device) as store:
        other = another_user(tmp_path / "other", monkeypatch)
        let_in(device, "calibrator", other, "second")
        second = open_client(device)
        reply = second.answer_to(5, get_status=pb.Nothing())
        assert reply.status.looking_on == BUSY and reply.status.network.peer == "tester"
        for what in ({"set_lamp": 0.5}, {"stop_survey": pb.Nothing()}, {"revert_profile": pb.Nothing()}):
            with pytest.raises(PipefishError, match="another host is connected to the device: until it has gone"):
                second.answer_to(5, **what)
        second.close()
        with Flasher(TlsTransport("127.0.0.1", device.port), 5) as flasher:
            assert not flasher.state().problem
            with pytest.raises(PipefishError, match="refuses the profile: another host is connected"):
                flasher.send(b"whatever it is")
        watcher = Watcher(device.port, TlsTransport)
        with watcher.client() as client:
            client.run(lambda: len(watcher.statuses) > 1, 10)
        assert not watcher.objects
        taker = Store(device.port, TlsTransport)
        with pytest.raises(NoDevice, match="another host is connected"), taker.client() as client:
            client.run(lambda: taker.objects, 1.2)
    # He has gone: the same host that was told so is served now.
    with taker.client() as client:
        client.run(lambda: client.up and taker.statuses, 10)
    assert len(store.objects) > 5 and network(device)["refused_busy"] == 0
    assert "host is there: tester, operator" in device.text() and "looks on: second, calibrator" in device.text()


def test_the_same_host_looks_on_while_it_receives(device: Crawler, capsys):
    let_in(device, "operator")
    with receiving(device):
        assert main(["status", f"tls://127.0.0.1:{device.port}"]) == 0
        assert "looks on" in capsys.readouterr().out


def test_a_host_that_looked_on_or_left_gets_its_answers_when_it_has_the_device(device: Crawler, tmp_path, monkeypatch):
    """Whoever was there in between: both ends count their messages alike."""
    let_in(device, "operator")
    with receiving(device):
        other = another_user(tmp_path / "other", monkeypatch)
        let_in(device, "calibrator", other, "second")
        client = open_client(device)
        for _ in range(4):
            assert client.answer_to(5, get_status=pb.Nothing()).status.looking_on == BUSY
        client.handlers.may_look_on = False
        client.run(lambda: not client.up, 5)
    client.run(lambda: client.up, 8)
    assert not client.answer_to(5, get_status=pb.Nothing()).status.looking_on
    client.close()


def test_a_viewer_looks_on_and_an_operator_takes_the_line(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "viewer")
    viewer = open_client(device)
    viewer.run(lambda: viewer.up, 5)
    operator = another_user(tmp_path / "operator", monkeypatch)
    let_in(device, "operator", operator, "boss")
    with receiving(device):
        status = viewer.answer_to(5, get_status=pb.Nothing()).status
    assert status.network.role == "operator" and status.looking_on == VIEWER
    viewer.close()


def test_more_than_three_who_look_on_are_sent_away_and_harm_nobody(device: Crawler):
    let_in(device, "operator")
    with receiving(device):
        lookers = [open_client(device) for _ in range(3)]
        with serving(*lookers):
            network(device, sessions=4)
            more = open_client(device)
            with pytest.raises(NoDevice, match="as many as it takes"):
                more.run(lambda: more.up, 1.2)
            more.close()
            assert network(device, refused_busy=1)["sessions"] == 4
            assert device.status()["link"]["visitors"] == 3 and all(client.up for client in lookers)
        for client in lookers:
            client.close()
    end = time.monotonic() + 5
    while device.status()["link"]["visitors"]:
        assert time.monotonic() < end, "the device does not notice that they have gone"
        time.sleep(0.05)
    wait_for_log(device, "turned away: tester wanted to look on")


def test_a_revoked_key_ends_looking_on_too(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")
    with receiving(device):
        other = another_user(tmp_path / "other", monkeypatch)
        let_in(device, "viewer", other, "second")
        second = open_client(device)
        second.run(lambda: second.up, 5)
        let_in(device, "revoked", other, "second")
        second.run(lambda: not second.up, 5)
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
    client.run(lambda: client.up, 5)
    end = time.monotonic() + 5
    client.run(lambda: not client.up or time.monotonic() > end, 5)
    assert client.link.stats["fragments_sent"] > 3
    client.close()
    let_in(device, "operator")
    client, upload = begin(1 << 20)
    client.run(lambda: upload.refused, 10)
    assert client.link.stats["fragments_sent"] < 8, "the device had kept the first parts: this test proves something"
    assert "profile_store" not in device.text()
    client.close()


def test_a_stranger_cannot_choose_a_slow_key_exchange(device: Crawler):
    key = let_in(device, "operator")
    assert key
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.set_ecdh_curve("secp521r1")  # the one thing that Python can offer instead; finite fields are shut with it
    with pytest.raises(ssl.SSLError), socket.create_connection(("127.0.0.1", device.port), 5) as s:
        context.wrap_socket(s)
    network(device, refused_handshake=1)


def test_a_handshake_that_lasts_gives_way_to_one_that_begins(device: Crawler):
    let_in(device, "operator")
    slow = [connect_from(f"127.0.0.{2 + i // 2}", device.port) for i in range(4)]
    try:
        client = open_client_late(device)
        assert network(device, refused_late=1)["refused_late"] < 4, "all four have been given up anyway"
        client.close()
    finally:
        for s in slow:
            s.close()


def open_client_late(crawler: Crawler) -> Client:
    """A client that comes again and again until it is let in."""
    client = Client(TlsTransport("127.0.0.1", crawler.port), Handlers())
    with contextlib.suppress(TransportClosed):
        client.open()
    client.run(lambda: client.up, 10)
    return client


def test_a_host_that_lost_its_way_takes_its_own_place_over(device: Crawler):
    let_in(device, "operator")
    lost = open_client(device)
    lost.run(lambda: lost.up, 5)
    again = Store(device.port, TlsTransport)  # the device has not noticed yet that the first has gone
    with again.client() as client:
        client.run(lambda: again.objects, 5)
    lost.close()


def test_a_host_that_falls_silent_makes_room_for_another(device: Crawler, tmp_path, monkeypatch):
    let_in(device, "operator")
    silent = open_client(device)
    silent.run(lambda: silent.up, 5)
    other = another_user(tmp_path / "other", monkeypatch)
    let_in(device, "operator", other, "second")
    time.sleep(4 * 0.2 + 0.3)
    second = open_client(device)
    second.run(lambda: second.up, 5)
    second.close()
    silent.close()


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
    client.run(lambda: client.up, 5)
    client.answer_to(5, get_status=pb.Nothing())
    client.close()
    assert device.process.poll() is None
    end = time.monotonic() + 30  # the first status may not be written yet
    while device.status().get("link", {}).get("crc_errors", 0) < 1000:  # a zero in 256 bytes ends a frame
        assert time.monotonic() < end, device.status()
        time.sleep(0.05)


def test_pairings_at_the_same_time_are_all_kept(device: Crawler):
    """A revocation that another pairing writes over would let a lost laptop in."""
    commands = [
        [find_daemon(), "--config", device.config, "--pair", f"operator {i:064x} host{i}"] for i in range(10, 22)
    ]
    processes = [subprocess.Popen(c, stdout=subprocess.PIPE, text=True) for c in commands]
    said = {p.communicate()[0].split("this device's key: ")[1] for p in processes}
    assert len(said) == 1 and not any(p.returncode for p in processes)
    assert len((device.config.parent / "trust" / "peers").read_text().splitlines()) == 12


def test_a_device_that_is_new_makes_one_key_however_many_pair(tmp_path: Path):
    crawler = Crawler(tmp_path, link__transport="tls", link__trust=tmp_path / "trust")
    commands = [
        [find_daemon(), "--config", crawler.config, "--pair", f"operator {i:064x} host{i}"] for i in range(10, 18)
    ]
    processes = [subprocess.Popen(c, stdout=subprocess.PIPE, text=True) for c in commands]
    assert len({p.communicate()[0].split("this device's key: ")[1] for p in processes}) == 1


def test_programs_of_one_host_that_begin_together_have_one_key_and_forget_no_device(tmp_path: Path):
    code = "import sys; from pipefish import keys; print(keys.host_key()); keys.remember_device(sys.argv[1] * 32, 'it')"
    programs = [
        subprocess.Popen([sys.executable, "-c", code, f"{i:02x}"], stdout=subprocess.PIPE, text=True) for i in range(6)
    ]
    assert {p.communicate()[0] for p in programs} == {keys.host_key() + "\n"}
    assert len(keys.known_devices()) == 6


@pytest.mark.parametrize("what", ["", "peers"])
def test_keys_that_anybody_may_write_are_refused(device: Crawler, tmp_path: Path, what: str):
    let_in(device, "operator")
    path = tmp_path / "trust" / what
    path.chmod(path.stat().st_mode | 0o002)
    pair = [find_daemon(), "--config", device.config, "--pair", f"operator {'ab' * 32} somebody"]
    told = subprocess.run(pair, capture_output=True, text=True, check=False)
    assert told.returncode == 1 and "anybody may write" in told.stderr and "chmod o-w" in told.stderr


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
@pytest.mark.parametrize("is_there", [False, True])
def test_who_pairs_as_root_leaves_files_that_the_daemon_can_read(tmp_path: Path, is_there: bool):
    nobody = 65534
    with tempfile.TemporaryDirectory() as home:  # tmp_path lies in folders that are root's alone
        folder = Path(home) / "trust"
        os.chown(home, nobody, nobody)
        if is_there:
            folder.mkdir()
            os.chown(folder, nobody, nobody)
        crawler = Crawler(tmp_path, link__transport="tls", link__trust=folder)
        pair = [find_daemon(), "--config", crawler.config, "--pair", f"operator {'ab' * 32} somebody"]
        subprocess.run(pair, capture_output=True, check=True)
        assert {p.name: p.stat().st_uid for p in folder.iterdir()} == {"device.pem": nobody, "peers": nobody}


def test_pairing_by_the_cable_lets_a_host_in_and_remembers_the_device(tmp_path: Path, capsys):
    write_recording(tmp_path / "survey.y4m", 10)
    crawler = Crawler(tmp_path, link__trust=tmp_path / "trust", daemon__exit_when_done="false", daemon__drain_s=0)
    crawler.start()
    try:
        wait_for_log(crawler, "127.0.0.1:")
        cable = f"tcp://127.0.0.1:{crawler.port}"  # loopback: as trusted as the cable
        assert main(["pair", cable, "--role", "viewer", "--device-name", "probe", "--name", "me and you"]) == 0
        line = (tmp_path / "trust" / "peers").read_text()
        assert line == f"viewer {keys.host_key()} me and you\n"
        assert list(keys.known_devices().values()) == ["probe"]
        assert main(["pair", cable, "--revoke", keys.host_key()]) == 0
        assert (tmp_path / "trust" / "peers").read_text().startswith("revoked ")
        assert main(["pair", cable, "--name", "again"]) == 1
        assert "revoked" in capsys.readouterr().err
    finally:
        crawler.kill()


def test_private_keys_are_for_their_owner_only(tmp_path: Path, device: Crawler):
    let_in(device, "operator")
    for path in (keys.host_key_file(), tmp_path / "trust" / "device.pem", tmp_path / "trust" / "peers"):
        assert path.stat().st_mode & 0o777 == 0o600
    os.chmod(keys.host_key_file(), 0o644)
    with pytest.raises(PipefishError, match="others may read"):
        open_client(device)
    device.kill()
    os.chmod(tmp_path / "trust" / "device.pem", 0o640)
    device.start()
    assert device.wait() == 1 and "others may read" in device.log.read_text()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("operator", 'must be "role key name"'),
        (f"king {'0' * 64} me", "role must be"),
        (f"viewer {'0' * 63} me", "64 hexadecimal"),
        (f"viewer {'0' * 64} ", "name must be"),
        (f"viewer {'0' * 64} a\nviewer {'0' * 64} b", "line 2: this key is there already"),
    ],
)
def test_a_damaged_file_of_hosts_stops_the_start_and_names_the_line(device: Crawler, tmp_path: Path, text, why):
    let_in(device, "operator")
    device.kill()
    (tmp_path / "trust" / "peers").write_text(text + "\n")
    device.start()
    assert device.wait() == 1
    assert "line " in device.log.read_text() and why in device.log.read_text()


def test_a_file_of_hosts_that_is_damaged_while_the_device_runs_lets_nobody_in(device: Crawler, tmp_path: Path):
    let_in(device, "operator")
    (tmp_path / "trust" / "peers").write_text("nonsense\n")
    client = open_client(device)
    with pytest.raises(Refused):
        client.run(lambda: client.up, 5)
    client.close()


def test_tcp_is_for_loopback_only_and_tls_needs_its_folder(tmp_path: Path):
    write_recording(tmp_path / "survey.y4m", 2)
    crawler = Crawler(tmp_path, link__address="0.0.0.0")
    crawler.start()
    assert crawler.wait() == 1 and "must be encrypted" in crawler.log.read_text()
    crawler = Crawler(tmp_path, link__transport="tls")
    crawler.start()
    assert crawler.wait() == 1 and "link.trust" in crawler.log.read_text()


def test_an_address_that_comes_later_is_waited_for(tmp_path: Path, device: Crawler):
    let_in(device, "operator")
    device.kill()
    address = f"192.0.2.{1 + os.getpid() % 254}"  # of those that documents may use: nobody's
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
        client.run(lambda: client.up, 5)
        assert client.up
        client.close()
    finally:
        subprocess.run(["ip", "address", "del", *alias], capture_output=True)
