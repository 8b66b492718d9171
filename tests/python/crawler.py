"""pipefishd as a child process, its recordings, and a host that keeps what it gets: for the tests of the daemon."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
import os
import signal
import socket
import sqlite3
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
import pytest

from pipefish import pipefish_pb2 as pb
from pipefish.client import ACCEPT, STORED, Client, ObjectHandlers
from pipefish.transport import TcpTransport, TransportClosed

ROOT = Path(__file__).resolve().parents[2]
T = TypeVar("T")
START, KEYFRAME, END = 1, 2, 3
SEED = int(os.environ.get("PIPEFISH_TEST_SEED", "0"))  # of the moments of killing; the long tests try others
PATIENCE_S = 60  # for what a busy machine may delay at will: only what will never come is waited for so long
WIDTH, HEIGHT = 192, 160
COUNTS_PER_FRAME = 10
RESET_GAP = 5  # tracker.reset_gap's default
EVERY_FRAME = (
    *("--set", "keyframe.step_mm=1", "--set", "keyframe.min_interval=1"),
    *("--set", "keyframe.jpeg_quality=100"),
)


def find_daemon() -> Path:
    """PIPEFISH_BUILD (a build folder) or the first of build/release and build/debug that has it."""
    folders = [os.environ["PIPEFISH_BUILD"]] if "PIPEFISH_BUILD" in os.environ else ["build/release", "build/debug"]
    for folder in folders:
        program = ROOT / folder / "firmware" / "pipefishd"
        if program.exists():
            return program
    pytest.fail("pipefishd is not built: run `make build`")


def texture(seed: int) -> np.ndarray:
    """A (HEIGHT, 4 WIDTH) uint8 pattern with corners at several scales, periodic to the right."""
    rng = np.random.default_rng(seed)
    image = np.zeros((HEIGHT, 4 * WIDTH))
    for cell in (4, 8, 16):
        image += np.kron(rng.normal(size=(HEIGHT // cell, 4 * WIDTH // cell)), np.ones((cell, cell))) * 25
    image = sum(np.roll(image, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)) / 9
    return np.clip(image + 128, 0, 255).astype(np.uint8)


def write_recording(path: Path, frames: int, rate: int = 25, skip: tuple[int, ...] = (), seed: int = 1) -> list[str]:
    """A Y4M of a pattern that moves 2 px a frame, with encoder; `skip`: sequence numbers that were dropped.

    Returns the SHA-256 of each frame."""
    pattern = texture(seed)
    rows, hashes = ["sequence,time_ns,encoder_count,roll_rad,pitch_rad,attitude_sigma_rad"], []
    with path.open("wb") as out:
        out.write(f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F{rate}:1 Ip A1:1 Cmono\n".encode())
        sequence = 0
        for i in range(frames):
            while sequence in skip:
                sequence += 1
            pixels = np.ascontiguousarray(np.roll(pattern, -2 * i, axis=1)[:, :WIDTH]).tobytes()
            out.write(b"FRAME\n" + pixels)
            hashes.append(hashlib.sha256(pixels).hexdigest())
            rows.append(f"{sequence},{10**9 + sequence * 10**9 // rate},{i * COUNTS_PER_FRAME},0.01,-0.02,0.005")
            sequence += 1
    path.with_suffix(".csv").write_text("\n".join(rows) + "\n")
    return hashes


def reserve_port() -> socket.socket:
    """A port of the loopback that the system gives to nobody else while the socket is open: it is bound and does not
    listen, and so keeps none out who binds this very port with SO_REUSEADDR, as the daemon does, again and again."""
    holder = socket.socket()
    holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    holder.bind(("127.0.0.1", 0))
    return holder


@contextlib.contextmanager
def mounted(folder: Path, options: str) -> Iterator[Path]:
    """A file system of its own, in memory; skips the test where nothing may be mounted."""
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"a daemon on a file system that is READ-ONLY or FULL is NOT tested: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


class Crawler:
    """A daemon's settings and its process, which may be started again and again on the same spool.

    made   all of the test in progress: a fixture kills what is left of them
    """

    made: ClassVar[list[Crawler]] = []

    def __init__(self, folder: Path, **settings: object) -> None:
        self._reserved = reserve_port()
        self.port = self._reserved.getsockname()[1]
        self.status_file = folder / "status.json"
        self.config = folder / "pipefishd.ini"
        self.log = folder / "log"
        values = {
            "camera.path": folder / "survey.y4m",
            "camera.speed": "fast",
            "encoder.metres_per_count": 0.0001,
            "keyframe.step_mm": 2,  # of 1 mm a frame: every second one
            "link.port": self.port,
            "spool.path": folder / "spool.db",
            "status.interval_ms": 100,
            "status.preview_interval_ms": 100,
            "daemon.drain_s": 600,
            "daemon.status_file": self.status_file,
        } | {key.replace("__", "."): value for key, value in settings.items()}
        sections: dict[str, list[str]] = {}
        for key, value in values.items():
            section, name = key.split(".")
            sections.setdefault(section, []).append(f"{name} = {value}")
        self.config.write_text("".join(f"[{s}]\n" + "\n".join(lines) + "\n" for s, lines in sections.items()))
        self.program = find_daemon()
        self.process: subprocess.Popen[bytes] | None = None
        self.made.append(self)

    def start(self, *arguments: str) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen([self.program, "--config", self.config, *arguments], stderr=log)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def terminate(self) -> None:
        self.process.send_signal(signal.SIGTERM)

    def wait(self) -> int:
        return self.process.wait(2 * PATIENCE_S)

    def status(self) -> dict:
        return json.loads(self.status_file.read_text()) if self.status_file.exists() else {}

    def text(self) -> str:
        return self.log.read_text()


class Store(ObjectHandlers):
    """A host's durable store: what it holds outlives its clients."""

    def __init__(self, port: int, transport: type[TcpTransport] = TcpTransport) -> None:
        self.port = port
        self.transport = transport
        self.objects: dict[bytes, tuple[int, bytes]] = {}
        self.arrivals: Counter[bytes] = Counter()
        self.statuses: list[pb.Status] = []
        self.previews: list[pb.Preview] = []

    def on_offer(self, name: bytes, kind: int, size: int) -> int:
        return STORED if name in self.objects else ACCEPT

    def on_object(self, name: bytes, kind: int, data: bytes) -> int:
        assert hashlib.sha256(data).digest() == name
        self.arrivals[name] += 1
        self.objects[name] = (kind, data)
        return STORED

    def on_status(self, status: pb.Status) -> None:
        self.statuses.append(status)

    def on_preview(self, preview: pb.Preview) -> None:
        self.previews.append(preview)

    @contextlib.contextmanager
    def client(self, crawler: Crawler) -> Iterator[Client]:
        """A fresh client, as after the host's own restart; waits for the daemon's port."""
        client = Client(self.transport("127.0.0.1", self.port), self)

        def is_open() -> bool:
            with contextlib.suppress(TransportClosed):
                client.open()
                return True
            return False

        wait_until(crawler, is_open)
        try:
            yield client
        finally:
            client.close()

    def of_kind(self, kind: int) -> list[bytes]:
        return [data for k, data in self.objects.values() if k == kind]

    @property
    def starts(self) -> list[pb.SurveyStart]:
        return [pb.SurveyStart.FromString(data) for data in self.of_kind(START)]

    @property
    def keyframes(self) -> list[pb.Keyframe]:
        return sorted((pb.Keyframe.FromString(data) for data in self.of_kind(KEYFRAME)), key=lambda k: k.index)

    @property
    def ends(self) -> list[pb.SurveyEnd]:
        return [pb.SurveyEnd.FromString(data) for data in self.of_kind(END)]


def serve(crawler: Crawler, client: Client, until: Callable[[], object]) -> None:
    """Runs the client until `until()`, or until the daemon has ended and all it said has been heard."""
    end = time.monotonic() + 2 * PATIENCE_S
    while not until():
        assert time.monotonic() < end, crawler.text()
        has_ended = crawler.process.poll() is not None
        client.step(0.02)
        if has_ended and not client.up:
            return


def wait_until(crawler: Crawler, look: Callable[[], T]) -> T:
    """What `look()` gives, once that is true. What is not so when the daemon has ended is never going to be: it fails
    then, after one last look."""
    end = time.monotonic() + PATIENCE_S
    while True:
        has_ended = crawler.process.poll() is not None
        if seen := look():
            return seen
        assert not has_ended, f"the daemon has ended with {crawler.process.returncode}:\n{crawler.text()}"
        assert time.monotonic() < end, f"{crawler.status()}\n{crawler.text()}"
        time.sleep(0.01)


def task_of(crawler: Crawler, thread: str) -> Path:
    """The folder in /proc of the daemon's thread of that name, once it has come to run and named itself."""

    def look() -> Path | None:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that ends
            for task in Path(f"/proc/{crawler.process.pid}/task").iterdir():
                if (task / "comm").read_text() == f"{thread}\n":
                    return task
        return None

    return wait_until(crawler, look)


@contextlib.contextmanager
def stopped(crawler: Crawler, thread: str) -> Iterator[None]:
    """That thread stands still, the others go on; skips the test where nothing may be traced."""
    task = int(task_of(crawler, thread).name)
    libc = ctypes.CDLL(None, use_errno=True)
    seize, interrupt, detach, any_thread = 0x4206, 0x4207, 17, 0x40000000
    if libc.ptrace(seize, task, None, None) != 0:
        pytest.skip(f"a stopped thread is NOT tested: no ptrace here: {os.strerror(ctypes.get_errno())}")
    assert libc.ptrace(interrupt, task, None, None) == 0
    os.waitpid(task, any_thread)
    try:
        yield
    finally:
        libc.ptrace(detach, task, None, None)


def wait_for_log(crawler: Crawler, text: str, times: int = 1) -> None:
    """Until the daemon has logged `text` so often."""
    wait_until(crawler, lambda: crawler.text().count(text) >= times)


def wait_for_status(crawler: Crawler, is_so: Callable[[dict], object]) -> dict:
    """The status file, once it is there and `is_so`; a key that it does not have means that it is not."""

    def look() -> dict:
        status = crawler.status()
        with contextlib.suppress(KeyError):
            if status and is_so(status):
                return status
        return {}

    return wait_until(crawler, look)


def spooled(crawler: Crawler) -> Counter[int]:
    """How many objects of each kind the spool of a daemon that has ended holds."""
    with contextlib.closing(sqlite3.connect(crawler.config.parent / "spool.db")) as database:
        return Counter(kind for (kind,) in database.execute("SELECT kind FROM object"))


def receive_all(crawler: Crawler, store: Store) -> int:
    """Serves the daemon until it exits; returns its exit code."""
    with store.client(crawler) as client:
        serve(crawler, client, lambda: False)
    return crawler.wait()


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([find_daemon(), *map(str, arguments)], capture_output=True, text=True, timeout=2 * PATIENCE_S)
