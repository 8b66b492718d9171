"""The device on a network: who gets in, and that who does not get in harms nobody; TLS, keys, and the file of hosts."""

import contextlib
import datetime
import os
import select
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

from crawler import PATIENCE_S, Crawler, find_daemon, wait_for_log, write_recording
from network_device import let_in, network, open_client, raw_tls, serving
from pipefish import keys
from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.client import Client, Handlers, NoDevice
from pipefish.errors import PipefishError
from pipefish.transport import Refused, TlsTransport, TransportClosed, open_transport

pytestmark = pytest.mark.usefixtures("own_keys")
HANDSHAKE_S = 5.0  # that the device gives a handshake


def own_certificate(path: Path, since: str, until: str) -> str:
    """A P-256 key with a certificate of those years, as one PEM; returns its key."""
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


def test_an_unknown_host_is_sent_away_with_the_remedy_and_counted(device: Crawler):
    keys.remember_device(let_in(device, "operator", "ab" * 32, "somebody"), "crawler")
    client = open_client(device)  # the handshake of TLS 1.3 ends for the host before the device has looked at its key
    with pytest.raises(Refused, match="pair first"):
        client.run(lambda: client.up, PATIENCE_S)
    client.close()
    assert network(device, refused_unknown=1)["sessions"] == 0


def test_a_host_that_speaks_no_tls_to_a_device_that_does_is_told_so(device: Crawler):
    client = Client(open_transport(f"tcp://127.0.0.1:{device.port}"), Handlers())
    client.open()
    with serving(client):
        network(device, refused_handshake=1)  # it has closed the connection: why is heard, however late
    with pytest.raises(NoDevice, match="tls:// instead"):
        client.run(lambda: client.up, 0.1)
    client.close()


@pytest.mark.parametrize("abrupt", [True, False])
def test_a_handshake_that_the_device_breaks_off_is_told_as_that_and_may_be_tried_again(abrupt: bool):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hang_up() -> None:
            s, _ = server.accept()
            if not abrupt:
                s.recv(65536)
                s.sendall(bytes.fromhex("15030300020100"))  # close_notify
            s.close()

        thread = threading.Thread(target=hang_up)
        thread.start()
        with pytest.raises(TransportClosed, match="broke the handshake off") as told:
            TlsTransport("127.0.0.1", server.getsockname()[1]).open()
        thread.join()
    assert not told.value.is_final


def test_an_alert_of_the_device_s_own_trouble_is_waited_out():
    """OpenSSL's number of it is that of "not permitted" in the system."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def complain() -> None:
            with server.accept()[0] as line:
                line.recv(65536)
                line.sendall(bytes.fromhex("15030300020250"))  # internal_error

        threading.Thread(target=complain, daemon=True).start()
        with pytest.raises(TransportClosed, match="INTERNAL_ERROR") as told:
            TlsTransport("127.0.0.1", server.getsockname()[1]).open()
    assert not told.value.is_final


def test_a_device_with_another_key_gets_not_a_byte(device: Crawler):
    let_in(device, "operator")
    keys.forget_device("crawler")
    keys.remember_device("cd" * 32, "crawler")
    with pytest.raises(Refused, match=f"does not know .*; known: crawler {'cd' * 32}"):
        open_client(device)


@pytest.mark.usefixtures("own_keys")
def test_a_key_with_a_slip_of_the_pen_is_seen_when_it_is_said_again_and_can_be_taken_back(capsys):
    wrong, right = "ab" * 31 + "ac", "ab" * 32
    know = ["pair", "--device-name", "crawler", "--device-key"]
    assert main([*know, wrong]) == 0 and main([*know, wrong]) == 0
    assert "another" not in capsys.readouterr().out
    assert main([*know, right]) == 0
    assert f"pipefish pair --forget {wrong}" in capsys.readouterr().out
    assert main(["pair", "--forget", "crawler"]) == 1
    assert wrong in capsys.readouterr().err
    assert main(["pair", "--forget", wrong]) == 0
    assert keys.known_devices() == {right: "crawler"}
    assert main(["pair", "--forget", wrong]) == 1 and main(["pair", "--forget", right, "--revoke", wrong]) == 2


def test_a_revoked_key_ends_its_session_at_once_and_never_comes_back(device: Crawler, tmp_path: Path):
    let_in(device, "operator")
    client = open_client(device)
    client.run(lambda: client.up, PATIENCE_S)
    let_in(device, "revoked")
    client.run(lambda: not client.up, PATIENCE_S)
    with pytest.raises(Refused, match="revoked"):
        client.run(lambda: client.up, PATIENCE_S)
    client.close()
    assert network(device, refused_revoked=1)
    again = subprocess.run(
        [find_daemon(), "--config", device.config, "--pair", f"operator {keys.host_key()} me"], capture_output=True
    )
    assert again.returncode == 1 and b"revoked" in again.stderr


@pytest.mark.parametrize("device", [60000], indirect=True, ids=["seldom"])
def test_a_revoked_key_ends_a_session_in_which_nothing_happens(device: Crawler):
    """The host has come up and says nothing more, for which the device would wait longer than the test."""
    device.kill()
    device.start("--set", "status.interval_ms=3600000", "--set", "status.preview_interval_ms=0")
    let_in(device, "operator")
    client = open_client_late(device)
    end = time.monotonic() + 2
    client.run(lambda: time.monotonic() > end, PATIENCE_S)  # the survey is over, the link has said what it had to
    let_in(device, "revoked")
    begin = time.monotonic()
    with pytest.raises(TransportClosed, match="closed the connection"):
        while time.monotonic() < begin + PATIENCE_S / 2:
            select.select([client.transport], [], [], 1)
            client.transport.read()
    client.close()
    wait_for_log(device, "host has gone")


def test_no_certificate_an_old_tls_and_no_tls_at_all_are_refused(device: Crawler, tmp_path: Path):
    let_in(device, "operator")
    with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"), raw_tls(device.port) as s:
        s.recv(1)
    with pytest.raises(ssl.SSLError, match="PROTOCOL_VERSION"):
        raw_tls(device.port, keys.host_key_file(), ssl.TLSVersion.TLSv1_2)
    with socket.create_connection(("127.0.0.1", device.port), PATIENCE_S) as s:
        s.sendall(b"GET / HTTP/1.1\r\n\r\n")
        s.settimeout(PATIENCE_S)
        with contextlib.suppress(ConnectionError):
            while s.recv(4096):
                pass
    assert network(device, refused_handshake=3)["sessions"] == 0
    client = open_client(device)
    client.run(lambda: client.up, PATIENCE_S)
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
        client.run(lambda: client.up, PATIENCE_S)
        client.close()
        thread.join(PATIENCE_S)
    before = network(device, sessions=1)["sessions"]
    with socket.create_connection(("127.0.0.1", device.port), PATIENCE_S) as s:
        s.sendall(bytes(sent))
        s.settimeout(PATIENCE_S)
        with contextlib.suppress(OSError):
            while s.recv(65536):
                pass
    counters = network(device, refused_handshake=1)
    assert counters["sessions"] == before


def connect_from(address: str, port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), PATIENCE_S, (address, 0))


def test_slow_and_too_many_handshakes_do_not_keep_a_host_out(device: Crawler):
    let_in(device, "operator")
    begin = time.monotonic()
    loris = [connect_from("127.0.0.2", device.port) for _ in range(6)]
    try:
        for s in loris:
            with contextlib.suppress(OSError):
                s.sendall(b"\x16")
        client = open_client(device)
        late = client.answer_to(PATIENCE_S, get_status=pb.Nothing()).status.network.refused_late
        assert not late or time.monotonic() - begin > HANDSHAKE_S, "it came in when the slow ones had been given up"
        client.close()
        counters = network(device, refused_often=4, refused_late=2)
        assert counters["sessions"] == 1
    finally:
        for s in loris:
            s.close()


def test_a_handshake_that_lasts_gives_way_to_one_that_begins(device: Crawler):
    let_in(device, "operator")
    begin = time.monotonic()
    slow = [connect_from(f"127.0.0.{2 + i // 2}", device.port) for i in range(4)]
    try:
        client = open_client_late(device)
        late = client.answer_to(PATIENCE_S, get_status=pb.Nothing()).status.network.refused_late
        assert 1 <= late < 4 or time.monotonic() - begin > HANDSHAKE_S, "all four have been given up anyway"
        client.close()
    finally:
        for s in slow:
            s.close()


def open_client_late(crawler: Crawler) -> Client:
    """A client that comes again and again until it is let in."""
    client = Client(TlsTransport("127.0.0.1", crawler.port), Handlers())
    with contextlib.suppress(TransportClosed):
        client.open()
    client.run(lambda: client.up, PATIENCE_S)
    return client


def test_an_address_that_failed_five_times_waits_while_others_come_in(device: Crawler):
    let_in(device, "operator")
    for _ in range(8):
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", device.port), PATIENCE_S, ("127.0.0.3", 0)) as s,
        ):
            s.sendall(b"garbage\r\n\r\n")
            s.settimeout(PATIENCE_S)
            while s.recv(100):
                pass
    counters = network(device, refused_often=3, refused_handshake=5)
    assert counters["refused_handshake"] == 5
    client = open_client(device)
    client.run(lambda: client.up, PATIENCE_S)
    client.close()


def test_strangers_with_ever_new_keys_do_not_fill_the_log(device: Crawler, tmp_path: Path):
    let_in(device, "operator")
    begin = time.monotonic()
    for i in range(20):
        own_certificate(tmp_path / "new", "2000-01-01", "2100-01-01")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        context.load_cert_chain(tmp_path / "new")
        with contextlib.suppress(OSError), context.wrap_socket(connect_from(f"127.0.1.{i + 1}", device.port)) as s:
            s.settimeout(PATIENCE_S)
            s.recv(1)
    network(device, refused_unknown=20)
    assert device.text().count("a host that is not known") <= time.monotonic() - begin + 1


def test_a_device_that_hangs_up_on_a_handshake_is_told_in_words_of_its_own():
    """The numbers of OpenSSL's errors are not the system's."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hang_up() -> None:
            with server.accept()[0] as line:
                line.recv(65536)

        threading.Thread(target=hang_up, daemon=True).start()
        with pytest.raises(TransportClosed, match="the device broke the handshake off"):
            TlsTransport("127.0.0.1", server.getsockname()[1]).open()


def test_a_certificate_of_a_version_that_is_none_carries_no_key(tmp_path: Path):
    own_certificate(tmp_path / "pem", "2000-01-01", "2100-01-01")
    der = x509.load_pem_x509_certificate((tmp_path / "pem").read_bytes()).public_bytes(Encoding.DER)
    with pytest.raises(ValueError, match="5 is not a valid"):
        keys.certificate_key(der.replace(b"\xa0\x03\x02\x01\x02", b"\xa0\x03\x02\x01\x05", 1))


def test_a_stranger_cannot_choose_a_slow_key_exchange(device: Crawler):
    key = let_in(device, "operator")
    assert key
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    context.set_ecdh_curve("secp521r1")  # the one thing that Python can offer instead; finite fields are shut with it
    with pytest.raises(ssl.SSLError), socket.create_connection(("127.0.0.1", device.port), PATIENCE_S) as s:
        context.wrap_socket(s)
    network(device, refused_handshake=1)


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
        pair = ["pair", cable, "--timeout", str(PATIENCE_S)]
        assert main([*pair, "--role", "viewer", "--device-name", "probe", "--name", "me and you"]) == 0
        line = (tmp_path / "trust" / "peers").read_text()
        assert line == f"viewer {keys.host_key()} me and you\n"
        assert list(keys.known_devices().values()) == ["probe"]
        assert main([*pair, "--revoke", keys.host_key()]) == 0
        assert (tmp_path / "trust" / "peers").read_text().startswith("revoked ")
        assert main([*pair, "--name", "again"]) == 1
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
        client.run(lambda: client.up, PATIENCE_S)
    client.close()


def test_tcp_is_for_loopback_only_and_tls_needs_its_folder(tmp_path: Path):
    write_recording(tmp_path / "survey.y4m", 2)
    crawler = Crawler(tmp_path, link__address="0.0.0.0")
    crawler.start()
    assert crawler.wait() == 1 and "must be encrypted" in crawler.log.read_text()
    crawler = Crawler(tmp_path, link__transport="tls")
    crawler.start()
    assert crawler.wait() == 1 and "link.trust" in crawler.log.read_text()
