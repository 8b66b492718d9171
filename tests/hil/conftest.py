"""The emulated board's tests: what they need, and the table of what they saw."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from board import CACHE, PROGRAMS, ROOT, Board
from crawl import HOST_DAEMON, PIPEFISH, Crawl, Recording, Result, free_port
from summary import add_rows

RESULTS: list[Result] = []
SUMMARY = ROOT / "build" / "hil" / "summary.json"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--half", type=int, choices=(1, 2), help="every second scenario: `make hil` runs both at once")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    half = config.getoption("half", None)
    if half:
        items[:] = items[half - 1 :: 2]


def pytest_sessionstart() -> None:
    RESULTS.clear()


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The simulated drive through a pipe; skips loudly where the board cannot be emulated."""
    wanted = [CACHE / "vmlinuz", CACHE / "initramfs", PROGRAMS / "firmware" / "pipefishd", HOST_DAEMON]
    missing = [str(path) for path in wanted if not path.exists()]
    if shutil.which("qemu-system-aarch64") is None:
        missing.append("qemu-system-aarch64")
    if missing:
        text = f"NO EMULATED BOARD: {', '.join(missing)} is missing; `make hil` makes what it can"
        warnings.warn(text, stacklevel=1)
        pytest.skip(text)
    folder = tmp_path_factory.mktemp("crawl")
    stem = folder / "crawl"
    subprocess.run([PIPEFISH, "simulate", ROOT / "tests/hil/crawl.toml", "-o", stem], check=True, capture_output=True)
    convert = [PIPEFISH, "profile", "convert", f"{stem}.profile.json", f"{stem}.profile"]
    subprocess.run(convert, check=True, capture_output=True)
    return Recording.load(stem.with_suffix(".y4m"))


@pytest.fixture
def crawl(recording: Recording, tmp_path: Path) -> Iterator[Callable[..., Crawl]]:
    """Boots a board and gives a survey on it: crawl(setting=value, ...), a dot in a name written as two underscores."""
    made: list[Crawl] = []

    def make(has_system: bool = False, **settings: str) -> Crawl:
        board = Board(tmp_path / f"b{len(made)}", free_port(), has_system)
        survey = Crawl(board, recording, tmp_path, {k.replace("__", "."): v for k, v in settings.items()})
        made.append(survey)
        board.power_on()
        return survey

    yield make
    for survey in made:
        survey.close()
        survey.board.close()


@pytest.fixture
def note() -> Callable[[Result], None]:
    return RESULTS.append


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """The table of scenarios, also as build/hil/summary.json: a half adds its own to the other's."""
    if not RESULTS:
        return
    if not config.getoption("half", None):
        SUMMARY.unlink(missing_ok=True)
    add_rows(SUMMARY, [dataclasses.asdict(r) for r in RESULTS])
    terminalreporter.section("emulated board")
    terminalreporter.write_line(
        f"{'scenario':34}{'frames in':>10}{'keyframes':>10}{'lost':>6}{'twice':>6}{'recovery':>10}"
    )
    for r in RESULTS:
        recovery = "-" if r.recovery_s is None else f"{r.recovery_s:.2f} s"
        terminalreporter.write_line(
            f"{r.name:34}{r.frames_in:10}{r.keyframes_out:10}{r.lost:6}{r.duplicated:6}{recovery:>10}"
        )
    stages = list(RESULTS[0].cpu_share)
    terminalreporter.write_line("")
    terminalreporter.write_line("seconds and milliseconds of the board's time, which runs with its instructions")
    terminalreporter.write_line(
        f"{'scenario':34}{'boot':>7}{'daemon':>7}{'frame':>7}{'CPU a frame':>14}"
        + "".join(f"{stage:>9}" for stage in stages)
    )
    for r in RESULTS:
        times = "".join("      -" if s is None else f"{s:7.2f}" for s in (r.up_s, r.daemon_s, r.frame_s))
        shares = "".join(f"{100 * r.cpu_share[stage]:7.1f} %" for stage in stages)
        terminalreporter.write_line(f"{r.name:34}{times}{r.cpu_ms:11.1f} ms{shares}")
