"""pipefishd as a program: its settings, one survey from end to end, and what survives kill -9."""

import contextlib
import hashlib
import itertools
import os
import select
import signal
import socket
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from crawler import (
    COUNTS_PER_FRAME,
    END,
    EVERY_FRAME,
    HEIGHT,
    KEYFRAME,
    PATIENCE_S,
    ROOT,
    START,
    WIDTH,
    Crawler,
    Store,
    receive_all,
    reserve_port,
    run,
    serve,
    spooled,
    wait_for_log,
    wait_for_status,
    write_recording,
)
from pipefish import pipefish_pb2 as pb
from pipefish.client import Client, Handlers
from pipefish.rolling import KEY as LINE_TIME
from pipefish.transport import TcpTransport


def test_help_config_is_the_committed_example_and_a_valid_file(tmp_path: Path):
    text = run("--help-config").stdout
    assert text == (ROOT / "firmware" / "pipefishd.ini.example").read_text()
    config = tmp_path / "c.ini"
    config.write_text(text)
    assert run("--config", config, "--check-config", "--set", "camera.driver=v4l2").returncode == 0


def test_check_config_accepts_a_good_file(crawler: Crawler):
    done = run("--config", crawler.config, "--check-config")
    assert (done.returncode, done.stdout) == (0, f"{crawler.config}: ok\n")


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("max_tracks = 4", "tracker.max_tracks = 4: must be 8..2048"),
        ("max_tracks = 1e3x", "not a number"),
        ("max_tracks = 10.5", "not a whole number"),
        ("max_track = 400", "unknown key max_track in [tracker]; it has: max_tracks levels"),
        ("[trackers]\nlevels = 4", "unknown section [trackers]; there are: survey camera tracker"),
        ("levels = 4\nlevels = 4", "tracker.levels is set a second time; the first is in line 2"),
        ("levels", "neither [section] nor key = value"),
        ("[camera]\ndriver = v4l3", "camera.driver = v4l3: this build has: replay|v4l2"),
        ("[link]\nrtscts = yes", "must be true or false"),
    ],
)
def test_a_bad_setting_is_named_with_file_and_line(tmp_path: Path, line: str, what: str):
    config = tmp_path / "c.ini"
    config.write_text(f"[tracker]\n{line}\n")
    done = run("--config", config, "--check-config")
    where = 2 + line.count("\n")
    assert done.returncode == 1
    assert f"{config}:{where}: " in done.stderr
    assert what in done.stderr
    assert done.stderr.count("\n") == 1


def test_wrong_usage_exits_2_and_other_failures_1(tmp_path: Path, crawler: Crawler):
    assert run("--nonsense").returncode == 2
    assert run("survey.ini").returncode == 2
    assert run("--config", tmp_path / "absent.ini").returncode == 1
    for override, what in [("tracker.window=20", "must be odd"), ("nonsense", "section.key=value"), ("a.b=1", "[a]")]:
        done = run("--config", crawler.config, "--check-config", "--set", override)
        assert done.returncode == 1
        assert what in done.stderr


def test_a_wheel_that_nothing_counts_is_refused_with_a_camera_and_told_with_a_recording(crawler: Crawler):
    camera = ("--set", "camera.driver=v4l2", "--set", "camera.width=0", "--set", "camera.height=0")
    done = run("--config", crawler.config, "--check-config", *camera)
    assert done.returncode == 1 and "gpio.encoder: must be set for encoder.metres_per_count" in done.stderr
    assert run("--config", crawler.config, "--check-config", *camera, "--set", "gpio.encoder=auto").returncode == 0
    crawler.start()  # with counts beside the pictures
    assert receive_all(crawler, Store(crawler.port)) == 0
    assert "without an encoder count" not in crawler.text()
    crawler.config.with_name("survey.csv").unlink()
    crawler.start()
    assert receive_all(crawler, Store(crawler.port)) == 0
    assert crawler.text().count("frames came without an encoder count") == 1


@pytest.mark.parametrize(
    ("setting", "what"),
    [
        ("camera.path=absent.y4m", "absent.y4m: No such file"),
        ("link.address=0.0.0.0", "what others can reach must be encrypted (link.transport = tls)"),
        ("link.address=crawler.local", "no numeric address"),
    ],
)
def test_check_config_finds_what_would_keep_it_from_starting(crawler: Crawler, setting: str, what: str):
    done = run("--config", crawler.config, "--check-config", "--set", setting)
    assert done.returncode == 1 and what in done.stderr and done.stderr.count("\n") == 1


def test_check_config_looks_at_address_and_keys_of_an_encrypted_line_and_makes_nothing(
    tmp_path: Path, crawler: Crawler
):
    trust = tmp_path / "trust"

    def check(**settings: object) -> str:
        """What is wrong; "" = nothing."""
        settings = {"transport": "tls", "address": "0.0.0.0", "trust": trust} | settings
        pairs = (pair for key, value in settings.items() for pair in ("--set", f"link.{key}={value}"))
        done = run("--config", crawler.config, "--check-config", *pairs)
        assert (done.returncode == 0) == (done.stderr == "")
        return done.stderr

    assert check() == "" and not trust.exists()  # the first start makes it
    assert 'tls: "crawler.local" is no numeric address' in check(address="crawler.local")
    assert "absent/trust: making the folder: No such file" in check(trust=tmp_path / "absent" / "trust")
    trust.mkdir(0o700)
    assert check() == "" and not list(trust.iterdir())
    (trust / "peers").write_text("nonsense\n")
    assert "peers: line 1" in check(transport="tcp", address="127.0.0.1")
    (trust / "peers").unlink()
    (trust / "device.pem").touch(0o600)
    assert "device.pem: no private key with its certificate" in check()
    trust.chmod(0o777)
    assert "anybody may write in this folder of keys" in check()


def test_a_pipe_as_recording_is_refused_and_not_waited_for(tmp_path: Path, crawler: Crawler):
    os.mkfifo(tmp_path / "pipe.y4m")
    done = run("--config", crawler.config, "--check-config", "--set", f"camera.path={tmp_path}/pipe.y4m")
    assert done.returncode == 1 and "pipe.y4m: not a regular file" in done.stderr


def test_a_profile_that_is_none_is_refused_before_anything_starts(tmp_path: Path, crawler: Crawler):
    profile = tmp_path / "p.bin"
    profile.write_bytes(b"nonsense")
    done = run("--config", crawler.config, "--check-config", "--set", f"camera.profile={profile}")
    assert done.returncode == 1
    assert str(profile) in done.stderr


@pytest.mark.parametrize("name", ["camera.json", "long.json"])
def test_a_profile_in_json_is_refused_with_the_command_that_converts_it(tmp_path: Path, crawler: Crawler, name: str):
    (tmp_path / name).write_text('{"format": "pipefish-profile"}' + (" " * 100_000 if name == "long.json" else ""))
    done = run("--config", crawler.config, "--check-config", "--set", f"camera.profile={tmp_path / name}")
    assert done.returncode == 1 and f"{name}: JSON; `pipefish profile convert`" in done.stderr


def test_a_busy_port_a_used_spool_and_a_missing_recording_are_clear_errors(tmp_path: Path, crawler: Crawler):
    with socket.create_server(("127.0.0.1", crawler.port)):
        done = run("--config", crawler.config)
    assert done.returncode == 1
    assert str(crawler.port) in done.stderr
    crawler.start("--set", "camera.loops=0")
    with Store(crawler.port).client(crawler), reserve_port() as other:
        wait_for_log(crawler, "begins")
        done = run("--config", crawler.config, "--set", f"link.port={other.getsockname()[1]}")
    assert done.returncode == 1
    assert "spool.db" in done.stderr
    done = run("--config", crawler.config, "--set", f"camera.path={tmp_path}/absent.y4m")
    assert done.returncode == 1
    assert "absent.y4m" in done.stderr


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        (
            ["camera.driver=v4l2", "camera.device=/dev/null", "camera.width=320", "camera.height=240"],
            "/dev/null: not a v",
        ),
        (["camera.driver=v4l2", "camera.device=/dev/absent"], "/dev/absent: No such file"),
        (["camera.driver=v4l2", "camera.format=RGB4"], "format RGB4 is not read"),
        (["camera.width=320"], "camera.width and camera.height: both or neither"),
        (["gpio.encoder_a=A"], "gpio.encoder_a and gpio.encoder_b: both or neither"),
        (["gpio.encoder_a=A", "gpio.encoder_b=B"], "gpio.encoder: must be set (auto or lines)"),
        (["gpio.lamp=NO_SUCH_LINE"], "no line is named NO_SUCH_LINE"),
        (["gpio.stop=gpiochip7:x"], "gpiochip7:x: must be a line's name, or chip:number"),
        (["gpio.lamp=/sys/class/leds/absent"], "/sys/class/leds/absent/"),
        (["gpio.encoder=lines"], "gpio.encoder: its lines are not named"),
        (["gpio.encoder=/etc/hostname"], "/etc/hostname: not a counter's value"),
        (["camera.index=/absent/folder"], "camera.index: /absent/folder/"),
    ],
)
def test_a_device_that_is_not_there_is_named(crawler: Crawler, settings: list[str], what: str):
    settings = [*settings, "encoder.metres_per_count=0"]
    done = run("--config", crawler.config, *(word for s in settings for word in ("--set", s)))
    assert done.returncode == 1
    assert what in done.stderr, done.stderr


def test_the_frame_index_replays_to_the_same_keyframes(tmp_path: Path, crawler: Crawler):
    write_recording(tmp_path / "survey.y4m", 40, skip=(7, 8, 30))
    (tmp_path / "index").mkdir()
    store = Store(crawler.port)
    crawler.start("--set", f"camera.index={tmp_path}/index")
    assert receive_all(crawler, store) == 0
    [index] = (tmp_path / "index").iterdir()
    assert index.name == f"{store.starts[0].survey_id.hex()[:8]}-001.csv"
    (tmp_path / "survey.csv").write_text(index.read_text())
    again = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, again) == 0
    assert [k.observations for k in again.keyframes] == [k.observations for k in store.keyframes]
    assert [k.frame_sequence for k in again.keyframes] == [k.frame_sequence for k in store.keyframes]
    assert [k.telemetry.roll_rad for k in again.keyframes] == [k.telemetry.roll_rad for k in store.keyframes]


# ---- one survey


def test_a_whole_survey_arrives_and_its_counters_agree(tmp_path: Path, crawler: Crawler):
    hashes = write_recording(tmp_path / "survey.y4m", 40)
    store = Store(crawler.port)
    crawler.start("--set", "survey.name=Ölstraße 7", "--set", "camera.line_time_us=-12.5")
    assert receive_all(crawler, store) == 0

    [start], keyframes, [end] = store.starts, store.keyframes, store.ends
    assert start.name == "Ölstraße 7"
    assert start.source.startswith("replay")
    assert (start.width, start.height, start.profile) == (WIDTH, HEIGHT, b"")
    assert start.encoder.metres_per_count == 0.0001
    assert "keyframe.step_mm = 2" in start.config
    assert f"{LINE_TIME} = -12.5" in start.config, "what `reconstruct` takes the rows' time from"
    tracker = "".join(f"{line}\n" for line in start.config if line.startswith("tracker."))
    assert start.tracker_config_sha256 == hashlib.sha256(tracker.encode()).digest()
    assert {start.survey_id} == {k.survey_id for k in keyframes} | {end.survey_id}
    assert [k.index for k in keyframes] == list(range(20))
    assert end.reason == "end of recording"
    assert (end.keyframes, end.frames, end.boots, list(end.lost_first)) == (20, 40, 1, [])
    assert set(store.arrivals.values()) == {1}

    boot = start.time.boot_id
    ages: dict[int, int] = {}
    for k in keyframes:
        assert k.frame_sequence == 2 * k.index
        assert (k.time.boot_id, k.recorded_ns) == (boot, 10**9 + k.frame_sequence * 40_000_000)
        # On the clock of the start and the end, at the recorded distances.
        assert k.time.monotonic_ns - keyframes[0].time.monotonic_ns == k.recorded_ns - keyframes[0].recorded_ns
        assert start.time.monotonic_ns < keyframes[0].time.monotonic_ns < end.time.monotonic_ns
        assert k.frame_sha256.hex() == hashes[k.frame_sequence]
        assert k.telemetry.encoder_count == k.frame_sequence * COUNTS_PER_FRAME
        assert k.telemetry.roll_rad == pytest.approx(0.01)
        assert k.cause == (pb.KEYFRAME_CAUSE_ENCODER if k.index else pb.KEYFRAME_CAUSE_FIRST)
        assert not k.after_break
        assert k.jpeg.startswith(b"\xff\xd8")
        o = k.observations
        n = len(o.id_delta)
        assert n > 20
        columns = (o.x_q16, o.y_q16, o.cov_xx_q20, o.cov_xy_q20, o.cov_yy_q20, o.age, o.quality, o.status)
        for column in (*columns, o.settled_x_q8, o.settled_y_q8):
            assert len(column) == n
        assert all(delta > 0 for delta in o.id_delta)
        assert max(o.x_q16) < WIDTH << 16
        assert set(o.status) <= {pb.TRACK_STATUS_NEW, pb.TRACK_STATUS_TRACKED}
        for track, age in zip(np.cumsum(o.id_delta), o.age, strict=True):
            if int(track) in ages:
                assert age == ages[int(track)] + 2  # frames between keyframes
            ages[int(track)] = age
        ages = {int(t): int(a) for t, a in zip(np.cumsum(o.id_delta), o.age, strict=True)}

    last = store.statuses[-1]
    assert (last.state, last.frames, last.keyframes, last.frames_dropped) == ("idle", 40, 20, 0)
    assert (last.spool.objects, last.spool.acknowledged, last.spool.stored) == (0, 22, 22)
    assert last.link.objects_sent == 22
    assert last.link.crc_errors == 0
    assert last.fps > 0
    assert min(last.stage.pyramid, last.stage.track, last.stage.detect, last.stage.keyframe, last.stage.store) > 0
    status = crawler.status()
    assert (status["frames"], status["keyframes"], status["keyframes_dropped"]) == (40, 20, 0)
    assert status["survey_id"] == start.survey_id.hex()
    assert status["spool"]["objects"] == 0
    assert store.previews == [] or store.previews[-1].width == WIDTH // 4


def test_a_serial_device_that_is_not_there_is_waited_for_and_its_loss_is_logged_once(tmp_path: Path, crawler: Crawler):
    device = tmp_path / "ttyPipe"
    crawler.start("--set", "link.transport=serial", "--set", f"link.device={device}")
    wait_for_log(crawler, "survey ends")  # it goes on into the spool meanwhile
    missing = f"{device}: No such file or directory"
    wait_for_log(crawler, missing)
    master, slave = os.openpty()
    device.symlink_to(os.ttyname(slave))
    assert select.select([master], [], [], PATIENCE_S)[0], crawler.text()  # its hello
    device.unlink()
    os.close(master)
    os.close(slave)
    wait_for_log(crawler, f"{device}: hung up")
    wait_for_log(crawler, missing, 2)  # before it came, and after it went
    time.sleep(1)  # four tries
    assert crawler.text().count(missing) == 2
    assert crawler.text().count("hung up") == 1


def test_sigterm_ends_the_survey_and_drains(tmp_path: Path, crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "camera.loops=0", "--set", "camera.speed=recorded")
    with store.client(crawler) as client:
        serve(crawler, client, lambda: len(store.keyframes) >= 3)
        crawler.terminate()
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    [end] = store.ends
    assert end.reason == "terminated"
    # At a recording's own speed a slow disk costs keyframes, which the end names (a busy machine's disk is slow).
    lost = [i for first, n in zip(end.lost_first, end.lost_count, strict=True) for i in range(first, first + n)]
    assert sorted([k.index for k in store.keyframes] + lost) == list(range(end.keyframes))


def test_what_could_not_be_sent_is_delivered_by_the_next_start_before_its_new_survey(crawler: Crawler):
    crawler.start("--set", "daemon.drain_s=0")
    assert crawler.wait() == 0
    assert "22 objects stay in the spool" in crawler.text()
    store = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, store) == 0
    assert len({s.survey_id for s in store.starts}) == 2
    assert [e.boots for e in store.ends] == [1, 1]
    assert Counter(k.survey_id for k in store.keyframes) == {s.survey_id: 20 for s in store.starts}
    # Up to four objects are under way at once, so the order is that of starting, give or take four.
    order = list(store.objects.values())
    old_end = next(i for i, (kind, _) in enumerate(order) if kind == END)
    assert old_end <= 21 + 3


def test_without_time_to_drain_every_keyframe_made_and_the_end_are_still_stored(crawler: Crawler):
    crawler.start("--set", "daemon.drain_s=0", "--set", "camera.loops=0", *EVERY_FRAME)
    wait_for_status(crawler, lambda s: s["keyframes"] > 3)
    crawler.terminate()
    assert crawler.wait() == 0
    made = int(crawler.text().split("survey ends: terminated; ")[1].split()[0])
    assert spooled(crawler) == {START: 1, KEYFRAME: made, END: 1}


def test_a_signal_without_a_host_does_not_wait_for_all_the_time_to_drain(crawler: Crawler):
    crawler.start("--set", "daemon.drain_s=3600")
    wait_for_log(crawler, "survey ends")
    crawler.terminate()
    assert crawler.wait() == 0
    assert spooled(crawler) == {START: 1, KEYFRAME: 20, END: 1}


def test_a_host_that_comes_soon_after_the_signal_gets_the_rest(crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "camera.loops=0")
    wait_for_status(crawler, lambda s: s["keyframes"] > 3)
    crawler.terminate()
    wait_for_log(crawler, "survey ends")
    time.sleep(0.3)  # in which it must not end
    assert receive_all(crawler, store) == 0
    assert len(store.ends) == 1 and spooled(crawler) == {}


class LateStore(Store):
    """A host that takes the survey's end in, but acknowledges it only when `may_acknowledge` says so."""

    may_acknowledge = False
    has_end = False

    def on_object(self, name: bytes, kind: int, data: bytes) -> int | None:
        self.has_end = self.has_end or kind == END
        return None if kind == END and not self.may_acknowledge else super().on_object(name, kind, data)


def stop_while_it_lingers(crawler: Crawler, client: Client) -> bool:
    """Stops a daemon as soon as it says that the link closes, 0.3 s before it does. False: a busy machine was late."""
    end = time.monotonic() + PATIENCE_S
    has_ended = crawler.process.poll() is not None
    before = time.monotonic()
    while "the link closes" not in crawler.text():
        assert not has_ended and before < end, crawler.text()
        client.step(0.005)
        has_ended = crawler.process.poll() is not None
        before = time.monotonic()
    if crawler.process.poll() is not None:
        return False
    os.kill(crawler.process.pid, signal.SIGSTOP)  # unlike send_signal, does not reap one that has just ended
    how = os.waitid(os.P_PID, crawler.process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
    return how.si_code == os.CLD_STOPPED and time.monotonic() - before < 0.15


def acknowledge_at_the_last_moment(crawler: Crawler) -> bool:
    """False: the daemon was not met in its last moment."""
    store = LateStore(crawler.port)
    crawler.start("--set", "daemon.drain_s=3", "--set", "daemon.log_level=debug")
    with store.client(crawler) as client:
        serve(crawler, client, lambda: store.has_end)
        if not stop_while_it_lingers(crawler, client):
            return False
        store.may_acknowledge = True
        end = time.monotonic() + PATIENCE_S
        while not store.ends or client.link.deadline(time.monotonic_ns()) <= time.monotonic_ns():
            assert time.monotonic() < end, crawler.text()
            client.step(0.02)
        crawler.process.send_signal(signal.SIGCONT)
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    assert len(store.ends) == 1
    assert spooled(crawler) == {}
    return True


def test_an_acknowledgement_at_the_last_moment_still_empties_the_spool(tmp_path: Path):
    """A busy machine may come too late to stop it in time, again and again: it is tried until it does not."""
    write_recording(tmp_path / "survey.y4m", 40)
    for i in itertools.count():
        (tmp_path / str(i)).mkdir()
        if acknowledge_at_the_last_moment(Crawler(tmp_path / str(i), camera__path=tmp_path / "survey.y4m")):
            return


def test_a_shutdown_waits_for_a_host_that_takes_nothing_only_as_long_as_a_signal_does(crawler: Crawler):
    crawler.start("--set", "daemon.drain_s=1", "--set", "daemon.exit_when_done=false")
    with contextlib.closing(Client(TcpTransport("127.0.0.1", crawler.port), Handlers())) as client:
        wait_for_log(crawler, "survey ends")
        client.open()
        serve(crawler, client, lambda: client.up)
        client.ask(shutdown=pb.Nothing())
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    assert spooled(crawler) == {START: 1, KEYFRAME: 20, END: 1}


def test_a_second_signal_ends_at_once_and_leaves_no_lamp_on(tmp_path: Path, crawler: Crawler):
    lamp = tmp_path / "lamp"
    lamp.mkdir()
    (lamp / "max_brightness").write_text("1")
    (lamp / "brightness").write_text("0")
    crawler.start("--set", f"gpio.lamp={lamp}", "--set", "gpio.lamp_level=1", *EVERY_FRAME)
    wait_for_log(crawler, "survey ends")
    assert (lamp / "brightness").read_text() == "1"
    crawler.terminate()
    wait_for_log(crawler, "signal 15")
    assert crawler.process.poll() is None  # nobody takes the objects: it drains
    crawler.terminate()
    assert crawler.wait() == 1
    assert "exit at once" in crawler.text()
    assert (lamp / "brightness").read_text() == "0"


def test_requests_are_answered(crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "camera.loops=0", "--set", "camera.speed=recorded")

    def ask(client: Client, **what: object) -> pb.Reply:
        number = client.ask(**what)
        serve(crawler, client, lambda: number in client.replies)
        return client.replies.pop(number)

    with store.client(crawler) as client:
        serve(crawler, client, lambda: client.up and store.starts)
        info = ask(client, get_info=pb.Nothing()).info
        assert info.software == "pipefishd 0.1.0"
        assert info.survey_id == store.starts[0].survey_id
        status = ask(client, get_status=pb.Nothing()).status
        assert status.state == "surveying"
        assert status.time.boot_id == info.boot_id
        assert "none that can be set" in ask(client, set_lamp=0.5).error
        assert "0..1" in ask(client, set_lamp=float("nan")).error
        sync = pb.ClockSync(boot_id=info.boot_id, offset_ns=-5, error_ns=7)
        assert ask(client, clock_sync=sync).error == ""
        assert "another boot" in ask(client, clock_sync=pb.ClockSync(boot_id=1)).error
        assert "unknown request" in ask(client).error
        serve(crawler, client, lambda: crawler.status().get("clock") == {"offset_ns": -5, "error_ns": 7})
        serve(crawler, client, lambda: store.previews)
        assert store.previews[-1].jpeg.startswith(b"\xff\xd8")
        assert ask(client, stop_survey=pb.Nothing()).error == ""
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    assert store.ends[0].reason == "stopped by the operator"


def test_without_exit_when_done_the_daemon_serves_until_shutdown(crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "daemon.exit_when_done=false")
    with store.client(crawler) as client:
        serve(crawler, client, lambda: bool(store.statuses) and store.statuses[-1].state == "idle")
        assert crawler.process.poll() is None
        assert len(store.keyframes) == 20
        client.ask(shutdown=pb.Nothing())
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0


def wake_ups_per_second(crawler: Crawler, seconds: float) -> float:
    """How often the daemon's threads have gone to sleep, a second."""

    def count() -> dict[Path, int]:
        counts = {}
        for task in Path(f"/proc/{crawler.process.pid}/task").glob("*/status"):
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that ends
                counts[task] = int(task.read_text().split("voluntary_ctxt_switches:")[1].split()[0])
        return counts

    first, begin = count(), time.monotonic()
    time.sleep(seconds)
    last, end = count(), time.monotonic()
    return sum(last[task] - first[task] for task in first.keys() & last.keys()) / (end - begin)


def test_a_daemon_without_a_host_sleeps(crawler: Crawler):
    crawler.start()
    wait_for_log(crawler, "survey ends")
    assert wake_ups_per_second(crawler, 1) < 200  # it looks around 20 times a second, the rest is spare


def test_a_host_that_reads_nothing_counts_as_gone_and_costs_no_wake_ups(tmp_path: Path, crawler: Crawler):
    write_recording(tmp_path / "survey.y4m", 600)
    store = Store(crawler.port)
    full_line = ("--set", "link.window=1048576", "--set", "link.send_slots=16")
    crawler.start("--set", "link.keepalive_ms=200", *full_line, *EVERY_FRAME)
    with store.client(crawler) as client:
        client.transport._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # it fills up at once
        serve(crawler, client, lambda: len(store.objects) > 3)
        wait_for_log(crawler, "host has gone")  # from here on it reads nothing
        wait_for_log(crawler, "survey ends")
        assert wake_ups_per_second(crawler, 1) < 1500


def test_a_damaged_recording_ends_the_survey_and_the_daemon_with_1(tmp_path: Path, crawler: Crawler):
    recording = tmp_path / "survey.y4m"
    csv = recording.with_suffix(".csv")
    hashes = write_recording(recording, 40)
    rows = csv.read_text().splitlines()
    csv.write_text("\n".join([rows[0] + ",sha256"] + [f"{r},{h}" for r, h in zip(rows[1:], hashes, strict=True)]))
    data = bytearray(recording.read_bytes())
    data[-30 * (WIDTH * HEIGHT + 6) + 100] ^= 1  # a pixel of the eleventh frame
    recording.write_bytes(data)
    store = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, store) == 1
    [end] = store.ends
    assert end.reason.startswith("camera failed: ")
    assert "survey.y4m" in end.reason
    assert end.frames == 10
    assert len(store.keyframes) == end.keyframes == 5
    assert "survey.y4m" in crawler.text()
