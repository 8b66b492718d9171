"""Watchdogs that must bark, and settings that come back after a crash loop."""

import contextlib
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from crawler import WIDTH, Crawler, texture, write_recording

PERIOD_S = 0.3  # of the feeding: a third of WATCHDOG_USEC


class Manager:
    """A service manager's end of the notification socket."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.settimeout(0.05)

    def listen(self, seconds: float, until: str = "") -> list[str]:
        """What is said in that time, or until `until` is."""
        said, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(TimeoutError):
                said.append(self.socket.recv(4096).decode())
                if said[-1] == until:
                    break
        return said


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


def test_the_service_manager_hears_that_the_daemon_is_up_well_and_going(tmp_path: Path, manager: Manager):
    write_recording(tmp_path / "survey.y4m", 5)
    crawler = Crawler(tmp_path, daemon__exit_when_done="false", daemon__drain_s=0)
    crawler.start()
    assert "READY=1" in manager.listen(10, "READY=1")
    said = manager.listen(10 * PERIOD_S)
    assert 7 <= said.count("WATCHDOG=1") <= 11 and set(said) == {"WATCHDOG=1"}
    crawler.terminate()
    assert "STOPPING=1" in manager.listen(10, "STOPPING=1")
    assert crawler.wait() == 0


def test_a_camera_that_hangs_starves_the_watchdog_until_it_goes_on(tmp_path: Path, manager: Manager):
    slow_folder(tmp_path / "frames", 12)
    crawler = Crawler(
        tmp_path,
        camera__path=tmp_path / "frames",
        camera__speed="recorded",
        camera__frame_rate=2,
        daemon__watchdog_s=2,
        daemon__drain_s=0,
    )
    crawler.start()
    manager.listen(10, "WATCHDOG=1")
    image = (tmp_path / "frames" / "011.png").read_bytes()
    for i in range(6, 12):  # whichever comes next blocks the thread that opens it
        (tmp_path / "frames" / f"{i:03d}.png").unlink()
        os.mkfifo(tmp_path / "frames" / f"{i:03d}.png")
    assert "STATUS=hangs: capture" in manager.listen(15, "STATUS=hangs: capture")
    assert "WATCHDOG=1" not in manager.listen(4 * PERIOD_S)
    assert "the capture thread hangs" in crawler.text()
    for i in range(6, 12):
        path = tmp_path / "frames" / f"{i:03d}.png"
        end = time.monotonic() + 10
        while time.monotonic() < end:
            with contextlib.suppress(OSError):  # no reader yet, or it was skipped for being late
                fd = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
                os.set_blocking(fd, True)
                os.write(fd, image)
                os.close(fd)
                break
            if crawler.process.poll() is not None:
                break
            time.sleep(0.02)
    assert "STATUS=well" in manager.listen(10, "STATUS=well") or "goes on" in crawler.text()
    crawler.kill()


def test_a_process_that_stands_still_starves_the_watchdog(tmp_path: Path, manager: Manager):
    write_recording(tmp_path / "survey.y4m", 5)
    crawler = Crawler(tmp_path, daemon__exit_when_done="false", daemon__drain_s=0)
    crawler.start()
    manager.listen(10, "WATCHDOG=1")
    crawler.process.send_signal(signal.SIGSTOP)
    manager.listen(0.2)
    assert manager.listen(4 * PERIOD_S) == []
    crawler.process.send_signal(signal.SIGCONT)
    assert "WATCHDOG=1" in manager.listen(5, "WATCHDOG=1")
    crawler.kill()


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
