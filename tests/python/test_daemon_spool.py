"""pipefishd: a full spool, and being killed: nothing acknowledged is lost, nothing comes twice."""

import contextlib
import os
import random
import sqlite3
import subprocess
import time
from pathlib import Path

import pytest

from crawler import (
    END,
    EVERY_FRAME,
    RESET_GAP,
    SEED,
    Crawler,
    Store,
    mounted,
    receive_all,
    run,
    serve,
    spooled,
    stopped,
    wait_for_log,
    wait_for_status,
    write_recording,
)
from pipefish import pipefish_pb2 as pb
from pipefish.survey import lost_indices


def test_a_full_spool_makes_a_fast_replay_wait_and_loses_nothing(crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "spool.quota_mb=0.3", *EVERY_FRAME)
    wait_for_log(crawler, "until there is room")
    assert receive_all(crawler, store) == 0
    [end_message] = store.ends
    assert [k.index for k in store.keyframes] == list(range(end_message.keyframes))
    assert list(end_message.lost_first) == []


def test_a_spool_with_a_bad_page_is_replaced_and_what_is_whole_is_delivered(crawler: Crawler):
    crawler.start("--set", "daemon.drain_s=0", *EVERY_FRAME)
    assert crawler.wait() == 0
    spool = crawler.config.parent / "spool.db"
    whole = sum(spooled(crawler).values())
    data = bytearray(spool.read_bytes())
    data[100:400] = bytes(300)  # the schema
    spool.write_bytes(data)
    data[: 5 * 4096] = os.urandom(5 * 4096)
    (spool.parent / "other.db").write_bytes(data)
    refused = run("--config", crawler.config, "--set", f"spool.path={spool.parent}/other.db")
    assert refused.returncode == 1, "of whose first pages nothing is left is not known to be a spool"
    store = Store(crawler.port)
    crawler.start(*EVERY_FRAME)
    assert receive_all(crawler, store) == 0
    assert "was damaged" in crawler.text() and (spool.parent / "spool.db.damaged-1").exists()
    assert len(store.ends) == 2 and len(store.objects) == 2 * whole and whole > 20, "the first survey is there too"
    # The head of the file says only what lies where; a page in its midst costs what lies there.
    crawler.start("--set", "daemon.drain_s=0", "--set", "survey.name=again", *EVERY_FRAME)
    assert crawler.wait() == 0
    before = sum(spooled(crawler).values())
    data = bytearray(spool.read_bytes())
    middle = len(data) // 8192 * 4096
    data[middle : middle + 4096] = os.urandom(4096)
    spool.write_bytes(data)
    store = Store(crawler.port)
    crawler.start("--set", "survey.name=third", *EVERY_FRAME)
    assert receive_all(crawler, store) == 0
    assert len(store.objects) >= before - 3 and len(store.ends) == 2


def test_a_read_only_medium_is_sent_and_written_to_once_it_can_be(tmp_path: Path, crawler: Crawler):
    with mounted(tmp_path / "medium", "size=64m") as medium:
        on_medium = ("--set", f"spool.path={medium}/spool.db", *EVERY_FRAME)
        crawler.start("--set", "daemon.drain_s=0", *on_medium)
        assert crawler.wait() == 0
        subprocess.run(["mount", "-o", "remount,ro", medium], check=True)
        store = Store(crawler.port)
        crawler.start("--set", "survey.name=next", *on_medium)
        with store.client(crawler) as client:
            serve(crawler, client, lambda: store.ends and crawler.status().get("spool_trouble"))
            status = crawler.status()
            assert "Read-only file system" in status["spool_trouble"]
            before = dict(store.objects)
            assert status["spool"]["objects"] == len(before), "what cannot be removed stays"
            subprocess.run(["mount", "-o", "remount,rw", medium], check=True)
            serve(crawler, client, lambda: False)
        assert crawler.wait() == 0
    assert {*before} < {*store.objects} and set(store.arrivals.values()) == {1}
    first, second = store.ends
    for end in (first, second):
        got = {k.index for k in store.keyframes if k.survey_id == end.survey_id}
        assert got | lost_indices(end) == set(range(end.keyframes))
    assert lost_indices(second) == set(), "a fast replay waits until it can be stored"


@pytest.mark.parametrize("options", ["size=16m", "size=16m,nr_inodes=5"], ids=["bytes", "files"])
def test_a_disk_that_is_full_at_the_first_start_lets_the_survey_begin_once_there_is_room(
    tmp_path: Path, crawler: Crawler, options: str
):
    """Neither the spool nor the store of profiles can be made: the host is served, and told why nothing is stored."""
    with mounted(tmp_path / "medium", options) as medium:
        with contextlib.suppress(OSError):
            for name in range(100):
                (medium / f"other{name}").write_bytes(bytes(0 if "nr_inodes" in options else 1 << 20))
        on_medium = ("--set", f"spool.path={medium}/spool.db", "--set", f"camera.profile_store={medium}/profiles")
        crawler.start(*on_medium, *EVERY_FRAME)
        why = "cannot be written: No space left on device" + " for one more file" * ("nr_inodes" in options)
        wait_for_status(crawler, lambda s: s["spool_trouble"].endswith(why))
        store = Store(crawler.port)
        with store.client(crawler) as client:
            serve(crawler, client, lambda: store.statuses)
            assert not store.objects
            for other in medium.glob("other*"):
                other.unlink()
            serve(crawler, client, lambda: store.ends)
            crawler.terminate()
            serve(crawler, client, lambda: False)
        assert crawler.wait() == 0
    [end] = store.ends
    assert lost_indices(end) == set() and {k.index for k in store.keyframes} == set(range(end.keyframes))
    assert "profiles: No space left on device" in crawler.text()


@pytest.mark.parametrize("speed", ["fast", "recorded"])
def test_a_spool_that_has_filled_the_disk_makes_room_and_goes_on_once_a_host_comes(
    tmp_path: Path, crawler: Crawler, speed: str
):
    """Removing takes room too, in SQLite's log: without some that is left nothing could be removed for ever after. A
    camera's keyframes make room for each other; a replay waits."""
    with mounted(tmp_path / "medium", "size=13m") as medium:
        arguments = ("--set", f"spool.path={medium}/spool.db", "--set", "camera.loops=0", *EVERY_FRAME)
        crawler.start("--set", f"camera.speed={speed}", *arguments)
        wait_for_status(crawler, lambda s: "full" in s["spool_trouble"] or s["spool"]["evicted"] > 10)
        if speed == "recorded":
            wait_for_status(crawler, lambda s: s["spool"]["evicted"] > 10)
        crawler.kill()  # its log stays as it is
        crawler.start("--set", f"camera.speed={speed}", *arguments)
        store = Store(crawler.port)
        with store.client(crawler) as client:
            serve(crawler, client, lambda: len(store.objects) > 200 and crawler.status()["spool"]["stored"] > 100)
            crawler.terminate()
            serve(crawler, client, lambda: False)
        assert crawler.wait() == 0
    [end] = store.ends
    got = {k.index for k in store.keyframes}
    assert got | lost_indices(end) == set(range(end.keyframes)) and set(store.arrivals.values()) == {1}
    assert (lost_indices(end) == set()) == (speed == "fast")


def test_a_disk_that_others_fill_makes_less_important_keyframes_go(tmp_path: Path, crawler: Crawler):
    """Down to less than is left for the log: what comes then takes the place, in the file, of what goes for it."""
    with mounted(tmp_path / "medium", "size=32m") as medium:
        live = ("--set", f"spool.path={medium}/spool.db", "--set", "camera.speed=recorded", "--set", "camera.loops=0")
        crawler.start(*live, *EVERY_FRAME)
        wait_for_status(crawler, lambda s: s["spool"]["stored"] > 100)
        room = os.statvfs(medium)
        (medium / "other").write_bytes(bytes(room.f_bavail * room.f_frsize - (1 << 20)))
        full = wait_for_status(crawler, lambda s: s["spool"]["evicted"] + s["keyframes_dropped"] > 5)
        later = wait_for_status(crawler, lambda s: s["keyframes"] > full["keyframes"] + 100)
        store = Store(crawler.port)
        with store.client(crawler) as client:
            serve(crawler, client, lambda: len(store.objects) > 100)
            crawler.terminate()
            serve(crawler, client, lambda: False)
        assert crawler.wait() == 0
    [end] = store.ends
    lost, got = lost_indices(end), {k.index for k in store.keyframes}
    assert got | lost == set(range(end.keyframes)) and not got & lost
    assert later["spool"]["evicted"] - full["spool"]["evicted"] > 40


def test_a_frame_index_on_a_full_medium_ends_with_a_whole_row_and_keeps_no_survey_from_starting(
    tmp_path: Path, crawler: Crawler
):
    frames = write_recording(tmp_path / "survey.y4m", 150)
    with mounted(tmp_path / "medium", "size=16k") as medium:
        index = ("--set", f"camera.index={medium}", "--set", "daemon.drain_s=0")
        crawler.start(*index)
        assert crawler.wait() == 0
        [file] = medium.iterdir()
        text = file.read_text()
        rows = text.splitlines()[1:]
        assert text.endswith("\n") and {row.count(",") for row in rows} == {9}
        assert [row.rpartition(",")[2] for row in rows] == frames[: len(rows)] and 50 < len(rows) < 150
        assert crawler.text().count(f"rows are missing from frame {len(rows)} on") == 1
        crawler.start(*index, "--set", "survey.name=next")
        assert crawler.wait() == 0
        assert "No space left on device; the frames of this start are not listed" in crawler.text()
    assert spooled(crawler)[END] == 2


@pytest.mark.parametrize(
    "place",
    ["of a survey that has ended", "of the survey that goes on", "of an interrupted survey", "in its first bytes"],
)
def test_a_keyframe_that_the_medium_damages_is_named_as_lost(crawler: Crawler, place: str):
    is_interrupted = place in ("of the survey that goes on", "of an interrupted survey")
    if is_interrupted:
        crawler.start("--set", "camera.loops=0")
        wait_for_status(crawler, lambda s: s["spool"]["stored"] > 5)
        crawler.kill()
    else:
        crawler.start("--set", "daemon.drain_s=0", *EVERY_FRAME)
        assert crawler.wait() == 0
    with contextlib.closing(sqlite3.connect(crawler.config.parent / "spool.db")) as database:
        rows = database.execute("SELECT row, bytes FROM object WHERE kind = 2 ORDER BY row").fetchall()
        damaged = (rows[0], rows[-2])
        for row, data in damaged:
            flipped = bytearray(data)
            flipped[3 if place == "in its first bytes" else len(data) // 2] ^= 1
            database.execute("UPDATE object SET bytes = ? WHERE row = ?", (bytes(flipped), row))
        database.commit()
    lost = {pb.Keyframe.FromString(data).index for _, data in damaged}
    store = Store(crawler.port)
    crawler.start(
        *(() if is_interrupted else EVERY_FRAME),
        *(("--set", "survey.name=other") if place == "of an interrupted survey" else ()),
    )
    assert receive_all(crawler, store) == 0
    survey_id = pb.Keyframe.FromString(damaged[0][1]).survey_id
    [end] = [e for e in store.ends if e.survey_id == survey_id]
    got = {k.index for k in store.keyframes if k.survey_id == survey_id}
    assert 0 in lost and not got & lost and got | lost == set(range(end.keyframes))
    assert lost_indices(end) == (set() if place == "in its first bytes" else lost)
    status = crawler.status()
    assert (status["keyframes_dropped"], status["spool"]["evicted"]) == (2, 0)
    assert status["spool"]["objects"] == 0


def test_a_quota_below_one_object_is_refused_at_the_start(crawler: Crawler):
    done = run("--config", crawler.config, "--set", "spool.quota_mb=0.05")
    assert done.returncode == 1
    assert "spool.quota_mb = 0.05: an object of this camera may have" in done.stderr


def test_a_full_spool_makes_a_live_survey_give_up_the_least_important_and_name_them(tmp_path: Path, crawler: Crawler):
    write_recording(tmp_path / "survey.y4m", 1000, rate=25)
    store = Store(crawler.port)
    live = ("--set", "camera.speed=recorded", "--set", "camera.loops=0")
    crawler.start("--set", "spool.quota_mb=0.3", *live, *EVERY_FRAME)
    wait_for_status(crawler, lambda s: s["spool"]["evicted"] >= 3 and s["keyframes"] >= 120)
    with store.client(crawler) as client:
        serve(crawler, client, lambda: client.up)
        client.ask(stop_survey=pb.Nothing())
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    [end_message] = store.ends
    lost, got = lost_indices(end_message), {k.index for k in store.keyframes}
    assert lost
    assert lost & got == set()
    assert lost | got == set(range(end_message.keyframes))
    status = crawler.status()
    assert status["keyframes_dropped"] + status["spool"]["evicted"] == len(lost)
    assert status["spool"]["evicted"] >= 3
    # What is left is spread over the survey: the even ones are kept longest, and the first one always.
    assert 0 in got and max(got) - min(got) > len(got) * 2
    assert len([i for i in lost if i % 2]) + status["keyframes_dropped"] > len(lost) / 2  # those by a slow disk, any


def test_a_disk_that_pauses_costs_no_keyframe(tmp_path: Path, crawler: Crawler):
    """As memory cards do while they tidy up: 25 keyframes are two seconds of what a drive gives at the most."""
    write_recording(tmp_path / "survey.y4m", 25, rate=25)
    store = Store(crawler.port)
    crawler.start("--set", "camera.speed=recorded", *EVERY_FRAME)
    with stopped(crawler, "store"):
        wait_for_status(crawler, lambda status: status.get("frames", 0) == 25)
    assert receive_all(crawler, store) == 0
    [end_message] = store.ends
    assert [k.index for k in store.keyframes] == list(range(end_message.keyframes)) and end_message.keyframes == 25


# ---- kill -9


def check_everything_arrived_once(store: Store, kills: int, frames: int = 120) -> None:
    """`frames`: of one loop of the recording.

    Nothing acknowledged is lost, nothing arrives twice: the keyframes are 0..n-1, each once, in one survey."""
    [end] = store.ends
    assert {k.survey_id for k in store.keyframes} == {end.survey_id}
    assert [k.index for k in store.keyframes] == list(range(end.keyframes))
    assert list(end.lost_first) == []
    assert 1 < end.boots <= kills + 1
    # One start for each boot that came to store it; each boot's first keyframe is marked.
    boots = [s.time.boot_id for s in store.starts]
    assert len(set(boots)) == len(boots) <= end.boots
    before, loop = None, 0
    for k in store.keyframes:
        assert k.time.boot_id in boots
        is_first = k.time.boot_id != before
        is_wrap = not is_first and k.frame_sequence // (frames + RESET_GAP + 1) != loop
        assert k.after_break == ((is_first and k.index > 0) or is_wrap), k.index
        if k.after_break:
            assert k.break_reason == ("restart" if is_first else f"gap of {RESET_GAP + 1} frames")
        before, loop = k.time.boot_id, k.frame_sequence // (frames + RESET_GAP + 1)


def test_kill_9_while_spooling_loses_nothing_and_doubles_nothing(tmp_path: Path, crawler: Crawler):
    # No host at all while it is being killed; then one that takes what the boots have left.
    write_recording(tmp_path / "survey.y4m", 120)
    rng = random.Random(SEED + 3)
    kills = 15
    for i in range(kills):
        crawler.status_file.unlink(missing_ok=True)
        crawler.start("--set", "camera.loops=0")
        if i % 2:  # else it is killed while it starts
            wait_for_status(crawler, lambda s: s["spool"]["stored"] > 0)
        time.sleep(rng.uniform(0.02, 0.25))
        crawler.kill()
    store = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, store) == 0
    check_everything_arrived_once(store, kills)


@pytest.mark.parametrize("change", ["survey.name=the next pipe", "encoder.metres_per_count=0.0002"])
def test_after_kill_9_another_setup_begins_another_survey_and_ends_the_old_one(crawler: Crawler, change: str):
    crawler.start("--set", "camera.loops=0")
    wait_for_status(crawler, lambda s: s["spool"]["stored"] > 5)
    crawler.kill()
    store = Store(crawler.port)
    crawler.start("--set", change)
    assert receive_all(crawler, store) == 0
    ends = {e.reason: e for e in store.ends}
    old, new = ends["interrupted; another survey began"], ends["end of recording"]
    assert [s.survey_id for s in store.starts] == [old.survey_id, new.survey_id]
    for end in (old, new):
        assert [k.index for k in store.keyframes if k.survey_id == end.survey_id] == list(range(end.keyframes))
        assert (end.boots, list(end.lost_first)) == (1, [])
    assert not next(k for k in store.keyframes if k.survey_id == new.survey_id).after_break


def test_kill_9_while_sending_and_a_host_that_dies_too_lose_nothing_and_double_nothing(
    tmp_path: Path, crawler: Crawler
):
    # What the host has stored but the daemon had not yet removed is offered again and answered from the store: it does
    # not arrive twice. Every second time the host dies as well, in the middle of whatever was under way.
    write_recording(tmp_path / "survey.y4m", 120)
    rng = random.Random(SEED + 4)
    kills = 20
    store = Store(crawler.port)
    for i in range(kills):
        crawler.start("--set", "camera.loops=0")
        for _ in range(1 + i % 2):
            with store.client(crawler) as client:
                few = len(store.objects) + 2 * (i % 2)  # it is indeed sending
                serve(crawler, client, lambda few=few: len(store.objects) >= few)
                end = time.monotonic() + rng.uniform(0.02, 0.2)
                serve(crawler, client, lambda end=end: time.monotonic() > end)
        crawler.kill()
    crawler.start()
    assert receive_all(crawler, store) == 0
    check_everything_arrived_once(store, kills)
    assert set(store.arrivals.values()) == {1}
