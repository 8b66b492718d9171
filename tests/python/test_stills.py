"""Stills: frames off a running pipefishd, whole, over TCP; `pipefish record`; what happens to the survey meanwhile."""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json

import numpy as np
import pytest
from PIL import Image

from crawler import COUNTS_PER_FRAME, HEIGHT, WIDTH, Crawler, Store, receive_all, serve, write_recording
from device import Device
from pipefish import cli
from pipefish import pipefish_pb2 as pb
from pipefish.calib_input import load_views
from pipefish.client import NoDevice
from pipefish.errors import PipefishError
from pipefish.stills import StillFolder, Stills, SurveyOver, still_of
from pipefish.transport import TcpTransport, open_transport
from synthetic import SURVEY, keyframe, start


@pytest.fixture
def crawler(tmp_path):
    """A daemon that plays a recording at its speed, for eight seconds; frames' hashes by sequence."""
    hashes = write_recording(tmp_path / "survey.y4m", 200)
    daemon = Crawler(tmp_path, camera__speed="recorded", daemon__exit_when_done="false")
    daemon.start()
    yield daemon, hashes
    daemon.process.kill()
    daemon.process.wait()


def stills_of(crawler: Crawler) -> Stills:
    return Stills(TcpTransport("127.0.0.1", crawler.port), 10.0)


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
    with store.client() as client:
        serve(daemon, client, lambda: len(store.keyframes) > 3)
    assert all(kind != 5 for kind, _ in store.objects.values())
    with stills_of(daemon) as stills:
        still = stills.take()
    assert hashlib.sha256(still.image.tobytes()).hexdigest() == hashes[still.sequence]


def test_after_the_survey_there_are_no_stills_and_the_device_says_so(crawler):
    daemon, _ = crawler
    with stills_of(daemon) as stills:
        stills.take()
        stills.client.answer_to(5.0, stop_survey=pb.Nothing())
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
    with store.client() as client:
        serve(player, client, lambda: len(store.ends) > 0)
    player.kill()
    assert store.ends[0].frames == 3 and store.ends[0].reason == "end of recording"


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
        with Stills(TcpTransport("127.0.0.1", int(device.address.rsplit(":", 1)[1])), 10.0) as stills:
            still = stills.take()
        assert device.connections > 1
    np.testing.assert_array_equal(still.image, image)
    assert len([kind for kind, _ in device.spool.values() if kind != 5]) == len(objects) and not device.refused


def test_a_still_that_was_promised_and_never_comes_is_not_waited_for_for_ever():
    with (
        Device([], SURVEY, state="surveying", stills=[b""]) as device,
        Stills(open_transport(device.address), timeout_s=1.0) as stills,
        pytest.raises(NoDevice, match="none came"),
    ):
        stills.take()
