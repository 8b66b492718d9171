"""Reception over the real link: complete, resumed after any interruption, nothing twice, nothing acknowledged and lost.

Does not prove: behaviour of a real serial adapter that is pulled out.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from device import Device
from pipefish.errors import PipefishError
from pipefish.receive import Interrupted, receive
from pipefish.survey import Survey
from pipefish.transport import SerialTransport, TcpTransport, open_transport
from synthetic import BOOT, SURVEY, end, keyframe, name_of, start, survey_objects


def receive_from(device: Device, path: Path, **options):
    return receive(open_transport(device.address), path, timeout_s=10, quiet=True, **options)


def test_a_survey_arrives_whole_and_the_device_is_empty(tmp_path):
    objects = survey_objects(12)
    with Device(objects, SURVEY) as device:
        summary = receive_from(device, tmp_path / "a.mcap")
        assert not device.spool, "the last acknowledgement has arrived before receive ends"
    survey = Survey.open(tmp_path / "a.mcap")
    assert survey.complete and len(survey.keyframes) == 12
    assert sorted(r.sha256 for r in survey.receipts) == sorted(n for n, _, _ in objects)
    assert summary["keyframes"] == 12 and summary["link"]["bytes"] == sum(len(d) for _, _, d in objects)
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap"}


def test_wall_time_comes_from_the_clock_measured_on_the_link(tmp_path):
    with Device(survey_objects(3), SURVEY) as device:
        receive_from(device, tmp_path / "a.mcap")
        assert device.clock is not None and device.clock.boot_id == BOOT
    survey = Survey.open(tmp_path / "a.mcap")
    offset = survey.keyframes[0].time_ns - survey.keyframes[0].monotonic_ns
    ours = time.time_ns() - time.monotonic_ns()
    assert abs(offset - ours) < 50_000_000
    assert survey.receipts[0].clock.error_ns < 50_000_000


def test_broken_connections_and_damaged_bytes_lose_and_double_nothing(tmp_path):
    objects = survey_objects(12)
    with Device(objects, SURVEY, cut_after=9000, corrupt_every=4001) as device:
        summary = receive_from(device, tmp_path / "a.mcap")
        assert device.connections > 3
    survey = Survey.open(tmp_path / "a.mcap")
    names = [r.sha256 for r in survey.receipts]
    assert survey.complete and len(names) == len(set(names)) == len(objects)
    assert summary["link"]["reconnections"] == device.connections - 1
    assert summary["link"]["crc_errors_host"] > 0


def test_an_interrupted_reception_goes_on_where_it_stopped(tmp_path):
    path = tmp_path / "a.mcap"
    objects = survey_objects(12)
    with Device(objects, SURVEY, cut_after=9000) as device:
        with pytest.raises(Interrupted, match=r"safe in .*a\.mcap\.partial; the same command goes on"):
            receive_from(device, path, stop=lambda: len(device.acknowledged) >= 4)
        acknowledged = set(device.acknowledged)
        stored = {r.sha256 for r in Survey.open(tmp_path / "a.mcap.partial").receipts}
        assert acknowledged and acknowledged <= stored
        summary = receive_from(device, path)
        assert summary["recovered_objects"] == len(stored)
    assert Survey.open(path).complete


def test_what_is_stored_already_is_not_sent_again(tmp_path):
    """The device has forgotten that everything but the end was acknowledged, as after a power cut of its own."""
    path = tmp_path / "a.mcap"
    objects = survey_objects(12)
    with Device(objects[:-1], SURVEY) as device, pytest.raises(Interrupted):
        receive_from(device, path, stop=lambda: not device.spool)
    with Device(objects, SURVEY, nonce=8) as device:
        summary = receive_from(device, path)
    assert summary["link"]["objects"] == 1
    assert len(Survey.open(path).receipts) == len(objects)


def test_killed_at_any_moment_nothing_acknowledged_is_lost(tmp_path):
    """kill -9 of the receiving process, several times, with the device going on."""
    path = tmp_path / "a.mcap"
    objects = survey_objects(60)
    with Device(objects, SURVEY, cut_after=60_000) as device:
        code = "import sys; from pipefish.cli import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", code, "receive", device.address, "-o", str(path), "--json"]
        for pause in (0.35, 0.45, 0.4, 0.5):
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            time.sleep(pause)
            process.send_signal(signal.SIGKILL)
            process.wait()
            gone = set(device.acknowledged)
            if path.exists():
                break
            partial = tmp_path / "a.mcap.partial"
            stored = {r.sha256 for r in Survey.open(partial).receipts} if partial.exists() else set()
            assert gone <= stored
        if not path.exists():
            receive_from(device, path)
    names = [r.sha256 for r in Survey.open(path).receipts]
    assert sorted(names) == sorted(n for n, _, _ in objects)


def test_ctrl_c_leaves_a_file_to_resume_and_says_so(tmp_path):
    path = tmp_path / "a.mcap"
    with Device(survey_objects(5)[:-1], SURVEY) as device:  # the survey has not ended: receive would wait
        command = [sys.executable, "-m", "pipefish", "receive", device.address, "-o", str(path)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while device.spool:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=10)
    assert process.returncode == 1 and out == ""
    assert (
        err == f"pipefish: interrupted: 5 keyframes are safe in {path}.partial; the same command goes on from there\n"
    )
    assert len(Survey.open(tmp_path / "a.mcap.partial").keyframes) == 5


def test_a_restart_of_the_device_stays_in_one_survey(tmp_path):
    second = dict(boot=BOOT + 1, first=3)
    objects = [
        start(),
        *(keyframe(i) for i in range(3)),
        start(boot=BOOT + 1),
        *(keyframe(i, **second) for i in range(3, 6)),
        end(6, boot=BOOT + 1),
    ]
    with Device(objects, SURVEY, boot=BOOT + 1) as device:
        receive_from(device, tmp_path / "a.mcap")
    survey = Survey.open(tmp_path / "a.mcap")
    assert survey.complete and len(survey.starts) == 2 and len(survey.breaks) == 1


def test_leftovers_of_an_earlier_survey_do_not_take_the_name(tmp_path):
    old = bytes(15) + b"\x09"
    with Device([*survey_objects(4, survey=old), *survey_objects(5)], SURVEY) as device:
        summary = receive_from(device, tmp_path / "a.mcap")
    assert Survey.open(tmp_path / "a.mcap").survey_id == SURVEY.hex()
    assert Survey.open(tmp_path / "a-2.mcap").survey_id == old.hex()
    assert summary["other_surveys"] == [{"file": str(tmp_path / "a-2.mcap"), "keyframes": 4}]


def test_an_object_whose_bytes_do_not_match_is_asked_for_again(tmp_path, monkeypatch):
    """The device's memory flips once; the second transfer is right."""
    import hashlib

    import pipefish.surveywrite as surveywrite

    failed = []

    class Once:
        def __init__(self, data: bytes) -> None:
            self._real = hashlib.sha256(data)

        def digest(self) -> bytes:
            if not failed:
                failed.append(1)
                return bytes(32)
            return self._real.digest()

    class Hashes:
        sha256 = Once

    monkeypatch.setattr(surveywrite, "hashlib", Hashes)
    with Device(survey_objects(3), SURVEY) as device:
        summary = receive_from(device, tmp_path / "a.mcap")
    assert summary["link"]["damaged_objects"] == 1
    assert Survey.open(tmp_path / "a.mcap").complete


def test_objects_of_unknown_kind_are_refused_and_counted(tmp_path):
    strange = (name_of(b"raw frame"), 5, b"raw frame")
    with Device([strange, *survey_objects(2)], SURVEY) as device:
        summary = receive_from(device, tmp_path / "a.mcap")
        assert device.refused == [strange[0]]
    assert summary["link"]["refused_objects"] == 1


def test_nobody_there_is_said_at_once_and_waited_for(tmp_path, capsys):
    for device, why in (("tcp://127.0.0.1:1", "Connection refused"), (str(tmp_path / "ttyUSB9"), "No such file")):
        with pytest.raises(Interrupted, match=r"no device answers .*nothing has arrived"):
            receive(open_transport(device), tmp_path / "a.mcap", timeout_s=0.3)
        assert re.search(f"{why}.*waiting for it", capsys.readouterr().err)


def test_a_silent_line_ends_with_the_timeout(tmp_path):
    import socket

    with socket.create_server(("127.0.0.1", 0)) as server:
        transport = open_transport(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        with pytest.raises(Interrupted, match=r"no device answers .*nothing has arrived"):
            receive(transport, tmp_path / "a.mcap", timeout_s=0.7, quiet=True)


@pytest.mark.parametrize(
    ("address", "baud", "name"),
    [
        ("serial:/dev/ttyUSB0@3000000", None, "serial:/dev/ttyUSB0@3000000"),
        ("/dev/ttyAMA0", 115200, "serial:/dev/ttyAMA0@115200"),
        ("/dev/serial/by-id/usb@1-port0", None, "serial:/dev/serial/by-id/usb@1-port0@921600"),
    ],
)
def test_serial_addresses(address, baud, name):
    transport = open_transport(address, baud)
    assert isinstance(transport, SerialTransport) and transport.name == name


def test_tcp_addresses():
    assert open_transport("tcp://pi.local").address == ("pi.local", 7447)
    transport = open_transport("tcp://[::1]:99")
    assert isinstance(transport, TcpTransport) and transport.address == ("::1", 99)


@pytest.mark.parametrize("address", ["", "tcp://", "tcp://a:0", "tcp://a:b", "http://a", "/dev/x@", "/dev/x@5"])
def test_addresses_that_make_no_sense(address):
    with pytest.raises(PipefishError):
        open_transport(address)
