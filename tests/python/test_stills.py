"""Stills: frames off a running pipefishd, whole, over TCP; `pipefish record`; what happens to the survey meanwhile."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import os
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from crawler import COUNTS_PER_FRAME, HEIGHT, PATIENCE_S, WIDTH, Crawler, Store, receive_all, serve, write_recording
from device import Device
from pipefish import cli
from pipefish import pipefish_pb2 as pb
from pipefish.calib_input import load_views
from pipefish.client import NoDevice
from pipefish.errors import PipefishError
from pipefish.stills import StillFolder, Stills, SurveyOver, _on_enter, still_of
from pipefish.transport import TcpTransport, open_transport
from synthetic import SURVEY, keyframe, start


@pytest.fixture
def crawler(tmp_path):
    """A daemon that plays a recording at its speed, for longer than any test takes; frames' hashes by sequence."""
    hashes = write_recording(tmp_path / "survey.y4m", 1000, rate=10)
    daemon = Crawler(tmp_path, camera__speed="recorded", daemon__exit_when_done="false")
    daemon.start()
    yield daemon, hashes
    daemon.process.kill()
    daemon.process.wait()


def stills_of(crawler: Crawler) -> Stills:
    return Stills(TcpTransport("127.0.0.1", crawler.port), PATIENCE_S)


def test_stills_are_the_frames_of_the_camera_and_the_survey_stays_on_the_device(crawler):
    daemon, hashes = crawler
    with stills_of(daemon) as stills:
        taken = [stills.take() for _ in range(4)]
    for still in taken:
        assert still.image.shape == (HEIGHT, WIDTH)
        assert hashlib.sha256(still.image.tobytes()).hexdigest() == hashes[still.sequence]
        assert still.telemetry.encoder_count == still.sequence * COUNTS_PER_FRAME
    assert all(a.sequence < b.sequence for a, b in itertools.pairwise(taken))
    daemon.terminate()
    store = Store(daemon.port)
    receive_all(daemon, store)
    kinds = {kind for kind, _ in store.objects.values()}
    assert kinds == {1, 2, 3} and store.starts[0].width == WIDTH  # no still among them
    assert [k.index for k in store.keyframes] == list(range(store.ends[0].keyframes))


def test_a_still_that_nobody_waits_for_is_dropped_and_the_next_host_gets_its_own(crawler):
    daemon, hashes = crawler
    for _ in range(3):
        with stills_of(daemon) as stills:  # asks and goes away
            serve(daemon, stills.client, lambda stills=stills: stills.client.up)
            stills.client.ask(get_still=pb.Nothing())
            stills.client.step(0.0)
    store = Store(daemon.port)
    with store.client(daemon) as client:
        serve(daemon, client, lambda: len(store.keyframes) > 3)
    assert all(kind != 5 for kind, _ in store.objects.values())
    with stills_of(daemon) as stills:
        still = stills.take()
    assert hashlib.sha256(still.image.tobytes()).hexdigest() == hashes[still.sequence]


def test_after_the_survey_there_are_no_stills_and_the_device_says_so(crawler):
    daemon, _ = crawler
    with stills_of(daemon) as stills:
        stills.take()
        stills.client.answer_to(PATIENCE_S, stop_survey=pb.Nothing())
        with pytest.raises(SurveyOver, match="survey is over"):
            for _ in range(9):
                stills.take()


def test_record_writes_a_folder_that_plays_and_calibrates(crawler, tmp_path, capsys):
    daemon, hashes = crawler
    folder = tmp_path / "shots"
    arguments = ["record", f"tcp://127.0.0.1:{daemon.port}", "-o", str(folder), "--every", "0", "--count", "3"]
    assert cli.main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"folder": str(folder), "stills": 3, "ended": "3 stills"}
    rows = list(csv.DictReader(io.StringIO((folder / "telemetry.csv").read_text())))
    for i, row in enumerate(rows):
        pixels = np.array(Image.open(folder / f"shot{i + 1}.png"))
        assert row["sha256"] == hashes[int(row["sequence"])] == hashlib.sha256(pixels.tobytes()).hexdigest()
        assert int(row["encoder_count"]) == int(row["sequence"]) * COUNTS_PER_FRAME
        assert float(row["roll_rad"]) == pytest.approx(0.01) and row["gain"] == ""
    assert [p.name for p in load_views({"camera": [folder]}, [], None).pictures] == [f"shot{i}.png" for i in (1, 2, 3)]
    assert cli.main(arguments) == 1 and "is not an empty folder" in capsys.readouterr().err
    daemon.kill()
    second = tmp_path / "second"
    second.mkdir()
    player = Crawler(second, camera__path=folder)  # the device plays what it gave, hashes checked
    player.start()
    store = Store(player.port)
    with store.client(player) as client:
        serve(player, client, lambda: len(store.ends) > 0)
    player.kill()
    assert store.ends[0].frames == 3 and store.ends[0].reason == "end of recording"


def small_still(sequence: int) -> bytes:
    frame = pb.RawFrame(frame_sequence=sequence, width=4, height=3, encoding="mono8", pixels=bytes(12))
    frame.time.boot_id = 7
    return frame.SerializeToString()


@pytest.fixture
def keyboard(monkeypatch):
    """Standard input as a pipe; -> its writing end."""
    read, write = os.pipe()
    with open(read) as stdin, open(write, "wb", buffering=0) as keys:
        monkeypatch.setattr("sys.stdin", stdin)
        yield keys


def test_each_line_of_input_is_a_still_also_those_that_come_at_once(tmp_path, keyboard, capsys):
    keyboard.write(b"\n\nand one more\n")
    keyboard.close()
    with Device([], SURVEY, state="surveying", stills=[small_still(i) for i in range(5)]) as device:
        assert cli.main(["record", device.address, "-o", str(tmp_path / "a"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"folder": str(tmp_path / "a"), "stills": 3, "ended": "end of input"}


def test_lines_that_came_together_do_not_wait_for_the_next_key(keyboard):
    """They were left in Python's buffer until the pipe or the keyboard gave more."""

    class Served:
        turns = 0

        def step(self, most_s: float) -> None:
            self.turns += 1
            assert self.turns < 20, "a line that is there is not seen"

    keyboard.write(b"\n\n\n")
    presses = _on_enter(SimpleNamespace(client=Served()))
    assert [next(presses) for _ in range(3)] == [None] * 3


def test_input_that_ends_at_once_leaves_no_folder_and_says_what_to_give(tmp_path, keyboard, capsys):
    keyboard.close()
    with Device([], SURVEY, state="surveying", stills=[small_still(0)]) as device:
        assert cli.main(["record", device.address, "-o", str(tmp_path / "a")]) == 1
    assert "no still was taken: end of input; without a keyboard give --every" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_ctrl_c_keeps_what_was_taken_and_a_half_written_still_leaves_nothing(tmp_path, monkeypatch):
    folder = StillFolder(tmp_path / "a")
    folder.add(still_of(small_still(1)))
    before = {p.name: p.read_bytes() for p in folder.path.iterdir()}

    def interrupted(self, rows):
        if len(rows) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(StillFolder, "_write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            folder.add(still_of(small_still(2)))
    assert {p.name: p.read_bytes() for p in folder.path.iterdir()} == before
    assert folder.add(still_of(small_still(3))).name == "shot2.png"
    assert len((folder.path / "telemetry.csv").read_text().splitlines()) == 3


def test_ctrl_c_at_the_keyboard_ends_with_what_there_is(tmp_path, monkeypatch, capsys):
    def presses(stills):
        yield
        raise KeyboardInterrupt

    monkeypatch.setattr("pipefish.stills._on_enter", presses)
    with Device([], SURVEY, state="surveying", stills=[small_still(0)]) as device:
        assert cli.main(["record", device.address, "-o", str(tmp_path / "a")]) == 0
    assert "stopped by Ctrl-C" in capsys.readouterr().out and (tmp_path / "a" / "shot1.png").exists()


def test_a_daemon_says_at_once_that_its_frames_are_too_large_to_be_sent(tmp_path, capsys):
    width, height = 8192, 4097  # just above 32 MiB
    with (tmp_path / "survey.y4m").open("wb") as out:
        out.write(f"YUV4MPEG2 W{width} H{height} F1:1 Ip A1:1 Cmono\n".encode())
        for _ in range(2):
            out.write(b"FRAME\n" + bytes(width * height))
    an_hour = 3_600_000_000_000  # so that the survey is not over when it is asked
    (tmp_path / "survey.csv").write_text(f"sequence,time_ns\n0,1\n1,{an_hour}\n")
    daemon = Crawler(tmp_path, camera__speed="recorded", daemon__exit_when_done="false")
    daemon.start()
    try:
        address = f"tcp://127.0.0.1:{daemon.port}"
        assert cli.main(["record", address, "-o", str(tmp_path / "a"), "--every", "0", "--timeout", "60"]) == 1
    finally:
        daemon.kill()
    assert "a frame of 8192 x 4097 is larger than the 32 MiB" in capsys.readouterr().err


def test_a_damaged_or_unknown_still_is_told(tmp_path):
    good = pb.RawFrame(width=2, height=1, encoding="mono8", pixels=b"ab")
    assert still_of(good.SerializeToString()).image.tolist() == [[97, 98]]
    for change, words in (
        ({"width": 3}, "3 x 1 has 2 bytes"),
        ({"pixels": b""}, "has 0 bytes"),
        ({"encoding": "bayer"}, "'bayer'"),
    ):
        bad = pb.RawFrame.FromString(good.SerializeToString())
        for name, value in change.items():
            setattr(bad, name, value)
        with pytest.raises(PipefishError, match=words):
            still_of(bad.SerializeToString())
    with pytest.raises(PipefishError, match="damaged"):
        still_of(b"\xff\xff")
    folder = StillFolder(tmp_path / "a")
    for boot in (1, 2):
        good.time.boot_id = boot
        still = still_of(good.SerializeToString())
        if boot == 1:
            folder.add(still)
    with pytest.raises(PipefishError, match="restarted; 1 stills are in"):
        folder.add(still)


def test_a_still_survives_a_line_that_breaks_and_what_the_device_has_spooled_stays_there():
    image = np.random.default_rng(3).integers(0, 256, (480, 640), dtype=np.uint8)
    frame = pb.RawFrame(width=640, height=480, encoding="mono8", pixels=image.tobytes())
    objects = [start(), *(keyframe(i) for i in range(2))]
    with Device(objects, SURVEY, cut_after=100_000, state="surveying", stills=[frame.SerializeToString()]) as device:
        with Stills(TcpTransport("127.0.0.1", int(device.address.rsplit(":", 1)[1])), PATIENCE_S) as stills:
            still = stills.take()
        assert device.connections > 1
    np.testing.assert_array_equal(still.image, image)
    assert len([kind for kind, _ in device.spool.values() if kind != 5]) == len(objects) and not device.refused


def test_a_still_that_was_promised_and_never_comes_is_not_waited_for_for_ever():
    with (
        Device([], SURVEY, state="surveying", stills=[b""]) as device,
        Stills(open_transport(device.address), timeout_s=1.0) as stills,
    ):
        stills.client.run(lambda: stills.client.up, PATIENCE_S)
        with pytest.raises(NoDevice, match="none came"):
            stills.take()
