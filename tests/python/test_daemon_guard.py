"""Watchdogs that must bark, and settings that come back after a crash loop."""

import contextlib
import os
import signal
import socket
import ssl
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from crawler import PATIENCE_S, WIDTH, Crawler, stopped, task_of, texture, wait_until, write_recording
from pipefish import keys

PERIOD_S = 0.3  # of the feeding: a third of WATCHDOG_USEC


class Manager:
    """A service manager's end of the notification socket."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.settimeout(0.05)

    def listen(self, seconds: float, until: str = "") -> list[str]:
        """What has been said, and is in that time; or until `until` is."""
        said, end = [], time.monotonic() + seconds
        while not said or said[-1] != until:
            try:
                said.append(self.socket.recv(4096).decode())
            except TimeoutError:
                if time.monotonic() > end:
                    break
        return said

    def wait_for(self, crawler: Crawler, text: str) -> list[str]:
        """What the daemon says until `text`, which must come."""
        said: list[str] = []

        def has_come() -> bool:
            said.extend(self.listen(0, text))
            return said[-1:] == [text]

        wait_until(crawler, has_come)
        return said

    def wait_for_hang(self, crawler: Crawler, thread: str) -> None:
        """Until the last that was said of the threads is that this one hangs, and nothing is fed for four periods: both
        must come. A stall of a busy machine looks like a hang too, but one that passes."""
        said: list[str] = []

        def is_starved() -> bool:
            now = self.listen(4 * PERIOD_S)
            said.extend(text for text in now if text.startswith("STATUS="))
            return said[-1:] == [f"STATUS=hangs: {thread}"] and "WATCHDOG=1" not in now

        wait_until(crawler, is_starved)


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    manager = Manager(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", str(int(3e6 * PERIOD_S)))
    yield manager
    manager.socket.close()


def slow_folder(path: Path, frames: int) -> None:
    path.mkdir()
    for i in range(frames):
        Image.fromarray(np.roll(texture(1), -2 * i, axis=1)[:, :WIDTH]).save(path / f"{i:03d}.png")


def rounds(crawler: Crawler) -> int:
    """How often the thread of the watchdogs has gone to sleep: it looks around every 50 ms of its own time, however
    seldom a busy machine lets it run."""
    status = (task_of(crawler, "watchdogs") / "status").read_text()
    return int(status.split("voluntary_ctxt_switches:")[1].split()[0])


def test_the_service_manager_hears_that_the_daemon_is_up_well_and_going(tmp_path: Path, manager: Manager):
    write_recording(tmp_path / "survey.y4m", 5)
    crawler = Crawler(tmp_path, daemon__exit_when_done="false", daemon__drain_s=0)
    begin = time.monotonic()
    crawler.start("--state", str(tmp_path / "state"))
    manager.wait_for(crawler, "READY=1")
    first, gone, said = rounds(crawler), 0, []
    while gone < 60 and time.monotonic() < begin + PATIENCE_S:
        said += manager.listen(PERIOD_S)
        gone = rounds(crawler) - first
    said += manager.listen(0)
    fed = said.count("WATCHDOG=1")
    # A period is six rounds of 50 ms, seven at most: no more pass between two feeds, and no feed comes early.
    assert gone / 7 - 1 <= fed <= (time.monotonic() - begin) / PERIOD_S + 1 and gone >= 60
    assert set(said) == {"WATCHDOG=1"}
    wait_for_start(crawler, tmp_path / "state", True)  # up and well for five seconds: a power cut is no failed start
    disk = task_of(crawler, "watchdogs") / "io"
    if disk.exists() and "hangs" not in crawler.text():
        assert "syscw: 0\n" in disk.read_text(), "while all is well the thread that feeds waits for no disk"
    crawler.terminate()
    manager.wait_for(crawler, "STOPPING=1")
    assert crawler.wait() == 0


def test_a_camera_that_hangs_starves_the_watchdog_until_it_goes_on(tmp_path: Path, manager: Manager):
    frames = 40  # 20 s: some of them are still to come when the files are replaced
    slow_folder(tmp_path / "frames", frames)
    crawler = Crawler(
        tmp_path,
        camera__path=tmp_path / "frames",
        camera__speed="recorded",
        camera__frame_rate=2,
        daemon__watchdog_s=2,
        daemon__drain_s=0,
    )
    crawler.start()
    manager.wait_for(crawler, "WATCHDOG=1")
    later = [tmp_path / "frames" / f"{i:03d}.png" for i in range(6, frames)]
    image = later[-1].read_bytes()
    for path in later:  # whichever comes next blocks the thread that opens it
        os.mkfifo(tmp_path / "fifo")
        (tmp_path / "fifo").rename(path)
    manager.wait_for_hang(crawler, "capture")
    assert "the capture thread hangs" in crawler.text()

    def goes_on() -> bool:
        for path in later:
            with contextlib.suppress(OSError):  # nobody reads this one
                fd = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
                os.set_blocking(fd, True)
                os.write(fd, image)
                os.close(fd)
        return "the capture thread goes on" in crawler.text()

    wait_until(crawler, goes_on)
    manager.wait_for(crawler, "STATUS=well")
    crawler.kill()


def test_a_start_that_hangs_starves_the_watchdog(tmp_path: Path, manager: Manager):
    write_recording(tmp_path / "survey.y4m", 5)
    (tmp_path / "trust").mkdir(0o700)
    os.mkfifo(tmp_path / "trust" / "peers")  # nobody writes: who reads it waits for ever
    crawler = Crawler(tmp_path, link__transport="tls", link__trust=tmp_path / "trust", daemon__watchdog_s=2)
    crawler.start()
    said = manager.wait_for(crawler, "STATUS=hangs: main")
    assert set(said[:-1]) == {"EXTEND_TIMEOUT_USEC=30000000"}, "before that it asks for time to start"
    assert manager.listen(2) == []
    assert "the main thread hangs" in crawler.text()
    crawler.kill()


def test_a_link_that_hangs_starves_the_watchdog(tmp_path: Path, manager: Manager, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "host"))
    keys.host_key()
    write_recording(tmp_path / "survey.y4m", 5)
    crawler = Crawler(
        tmp_path,
        link__transport="tls",
        link__trust=tmp_path / "trust",
        daemon__watchdog_s=2,
        daemon__exit_when_done="false",
    )
    crawler.start()
    manager.wait_for(crawler, "WATCHDOG=1")
    os.mkfifo(tmp_path / "trust" / "peers")  # nobody writes: who looks up a key waits for ever
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.load_cert_chain(keys.host_key_file())
    with context.wrap_socket(socket.create_connection(("127.0.0.1", crawler.port), PATIENCE_S)):
        manager.wait_for_hang(crawler, "link")
    crawler.kill()


@pytest.mark.parametrize("thread", ["GPIO", "capture"])
def test_a_thread_that_is_stopped_starves_the_watchdog(tmp_path: Path, manager: Manager, thread: str):
    (tmp_path / "led").mkdir()
    (tmp_path / "led" / "max_brightness").write_text("255\n")
    (tmp_path / "led" / "brightness").write_text("0\n")
    write_recording(tmp_path / "survey.y4m", 5, rate=5)
    crawler = Crawler(
        tmp_path,
        gpio__led=tmp_path / "led",
        camera__speed="recorded",
        camera__loops=0,
        daemon__watchdog_s=2,
        daemon__exit_when_done="false",
    )
    crawler.start()
    manager.wait_for(crawler, "WATCHDOG=1")
    with stopped(crawler, thread):
        manager.wait_for_hang(crawler, thread)
    manager.wait_for(crawler, "WATCHDOG=1")
    crawler.kill()


def test_a_process_that_stands_still_starves_the_watchdog(tmp_path: Path, manager: Manager):
    write_recording(tmp_path / "survey.y4m", 5)
    crawler = Crawler(tmp_path, daemon__exit_when_done="false", daemon__drain_s=0)
    crawler.start()
    manager.wait_for(crawler, "WATCHDOG=1")
    crawler.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, crawler.process.pid, os.WSTOPPED)
    manager.listen(0)
    assert manager.listen(4 * PERIOD_S) == []
    crawler.process.send_signal(signal.SIGCONT)
    manager.wait_for(crawler, "WATCHDOG=1")
    crawler.kill()


def wait_for_start(crawler: Crawler, folder: Path, is_up: bool) -> str:
    """The file that `--state` keeps of the start in progress, once it says so."""

    def look() -> str:
        text = (folder / "starts").read_text()
        return text if text.endswith(" up\n") == is_up else ""

    return wait_until(crawler, look)


def test_a_main_thread_that_hangs_is_a_failed_start_and_a_power_cut_of_a_daemon_that_is_well_is_none(
    tmp_path: Path, manager: Manager
):
    """The board's own watchdog ends such a hang as a power cut ends all: without another word from the daemon."""
    write_recording(tmp_path / "survey.y4m", 5)
    state = tmp_path / "state"
    crawler = Crawler(tmp_path, daemon__exit_when_done="false", daemon__drain_s=0, daemon__watchdog_s=4)
    crawler.start("--state", str(state))
    manager.wait_for(crawler, "READY=1")
    well = wait_for_start(crawler, state, True)
    draft = tmp_path / "status.json.new"  # nobody reads: who writes the status waits for ever
    while not draft.is_fifo():
        with contextlib.suppress(FileExistsError):  # it is just being written
            os.mkfifo(draft)
    manager.wait_for_hang(crawler, "main")
    hung = wait_for_start(crawler, state, False)
    assert "the main thread hangs" in crawler.text()
    crawler.kill()
    draft.unlink()
    counts = []
    for text in (well, hung):
        count, settings, boot, *_ = text.split()
        other = text.replace(boot, "0" * 8 + boot[8:])
        assert count == "1" and settings != boot and other != text
        (state / "starts").write_text(other)  # as found after the board has booted again
        crawler.start("--state", str(state))
        manager.wait_for(crawler, "READY=1")
        counts.append((state / "starts").read_text().split()[0])
        crawler.kill()
    assert counts == ["1", "2"]


def test_a_watchdog_device_that_is_none_is_a_clear_error(tmp_path: Path):
    write_recording(tmp_path / "survey.y4m", 5)
    for path in ("/dev/null", tmp_path / "none"):
        crawler = Crawler(tmp_path, daemon__watchdog=path)
        crawler.start()
        assert crawler.wait() == 1 and f"daemon.watchdog: {path}" in crawler.text()


def test_after_three_failed_starts_the_settings_of_the_last_good_run_come_back(tmp_path: Path):
    write_recording(tmp_path / "survey.y4m", 5)
    state = ("--state", str(tmp_path / "state"))
    crawler = Crawler(tmp_path, daemon__drain_s=0, survey__name='the "good" one')
    crawler.start(*state)
    assert crawler.wait() == 0
    good = (tmp_path / "state" / "good.ini").read_text()
    assert 'name = the "good" one\n' in good and f'path = "{tmp_path / "survey.y4m"}"\n' in good

    Crawler(tmp_path, daemon__drain_s=0, survey__name="bad", camera__path=tmp_path / "moved.y4m")
    for _ in range(3):
        crawler.start(*state)
        assert crawler.wait() == 1
    for _ in range(2):  # it stays so while the file is the same
        crawler.start(*state)
        assert crawler.wait() == 0
    assert crawler.text().count("the settings of the last good run are used") == 2
    assert (tmp_path / "state" / "good.ini").read_text() == good

    Crawler(tmp_path, daemon__drain_s=0, survey__name="mended")
    crawler.start(*state)
    assert crawler.wait() == 0
    assert 'name = "mended"\n' in (tmp_path / "state" / "good.ini").read_text()


def test_a_file_of_settings_that_does_not_parse_and_a_lost_state_do_not_keep_the_daemon_down(tmp_path: Path):
    write_recording(tmp_path / "survey.y4m", 5)
    state = ("--state", str(tmp_path / "state"))
    crawler = Crawler(tmp_path, daemon__drain_s=0)
    crawler.start(*state)
    assert crawler.wait() == 0
    text = crawler.config.read_text()
    crawler.config.write_text("[camera\nnonsense")
    codes = []
    for _ in range(4):
        crawler.start(*state)
        codes.append(crawler.wait())
    assert codes == [1, 1, 1, 0]
    crawler.config.write_text(text)
    for damage in ("", "x", "99999999999999999999 zz\n", "\0" * 100):
        (tmp_path / "state" / "starts").write_text(damage)
        crawler.start(*state)
        assert crawler.wait() == 0
    (tmp_path / "state" / "good.ini").write_text("garbage")
    crawler.config.write_text("[camera\nnonsense")
    for _ in range(5):
        crawler.start(*state)
        assert crawler.wait() == 1
