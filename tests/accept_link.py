"""Link and daemon for long, in pieces that are kept: 12 minutes of CPU time for the sessions, 6 for the soak.

sessions    10,000 seeded sessions of two links over lines with faults of every kind at once (test_link_channel.c says
            which): every object once, whole and identical, or the session has failed
soak        1,000,000 frames replayed as fast as they go through pipefishd to a host that takes everything, 250,000 a
            process: memory flat, nothing lost or twice. Frames of 96 x 80 pixels: it is the housekeeping that is tried,
            and none can be dropped
live        three minutes, 5,400 frames of 1280 x 800, as a camera of 30 a second that waits for nobody: none dropped
control     pipefishd on an emulated cable of 921600 baud that is full of keyframes: how long a request takes, really

A session's or a soak piece's figures are kept in build/accept/link/ and taken from there while the program is the same:
what was interrupted goes on where it stopped. Pieces that would begin after --minutes are left out: the row then tells
the count so far, and does not hold.

    python tests/accept_link.py                   prints one JSON list of {name, value, bound, holds}
    python tests/accept_link.py sessions --minutes 10
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from accept_rows import Row, at_least, at_most, exactly, figure, print_rows

from pipefish import pipefish_pb2 as pb
from pipefish.client import ACCEPT, STORED, Client, ObjectHandlers
from pipefish.files import write_atomically
from pipefish.survey import Survey
from pipefish.transport import SerialTransport

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build/accept/link"
CHANNEL = ROOT / "build/debug/tests/unit/test_link_channel"
DAEMON = ROOT / "build/release/firmware/pipefishd"
LINE = ROOT / "build/release/drivers/pipefish-line"
SESSIONS, BATCH = 10_000, 100
CONTROL_BAUD, REQUESTS = 921_600, 300
SOAK, PIECE = 1_000_000, 250_000
LIVE, RATE = 5400, 30
# A survey of a month at 30 frames a second may take 64 MB more at its end than at its start: an eighth of a board that
# has 512, beside the 16 that the daemon takes anyway.
MONTH = 30 * 86_400 * RATE
GROWTH_BYTES = 64 * 2**20 / MONTH
SETTINGS = {"camera.driver": "replay", "status.interval_ms": "200", "link.transport": "tcp"}
SMALL = {
    "camera.speed": "fast",
    "tracker.max_tracks": "40",
    "keyframe.step_mm": "1000",
    "keyframe.min_common": "1",
    "keyframe.min_interval": "100",
}


@dataclasses.dataclass(frozen=True)
class Loop:
    """A recording that begins anew without a seam: a texture as wide as it moves, `step` pixels a frame."""

    width: int
    height: int
    frames: int
    step: int

    def write(self, path: Path) -> None:
        """As a Y4M file: the tracker always has work."""
        rng = np.random.default_rng(1)
        blocks = rng.integers(40, 216, (self.height // 4, self.frames * self.step // 4))
        pattern = np.kron(blocks, np.ones((4, 4))).astype(np.uint8)
        with path.open("wb") as out:
            out.write(f"YUV4MPEG2 W{self.width} H{self.height} F{RATE}:1 Ip A1:1 Cmono\n".encode())
            for i in range(self.frames):
                frame = np.ascontiguousarray(np.roll(pattern, -i * self.step, axis=1)[:, : self.width])
                out.write(b"FRAME\n" + frame.tobytes())


SMALL_LOOP, LIVE_LOOP = Loop(96, 80, 500, 1), Loop(1280, 800, 180, 8)


def pieces(name: str, program: Path, count: int, minutes: float, measure) -> Iterator[dict]:
    """The figures of pieces 0..count-1, kept ones first asked; ends early when time is over."""
    digest = hashlib.sha256(program.read_bytes()).hexdigest()[:16]
    folder = FOLDER / f"{name}-{digest}"
    folder.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + 60 * minutes
    for i in range(count):
        kept = folder / f"{i}.json"
        if not kept.exists():
            if time.monotonic() > end:
                continue
            write_atomically(kept, json.dumps(measure(i)).encode())
        yield json.loads(kept.read_text())


# ---- sessions


def run_sessions(batch: int) -> dict:
    """One batch of seeds: how many ran, and whether all of them delivered."""
    done = subprocess.run(
        [CHANNEL],
        env={"PIPEFISH_TEST_SESSIONS": f"{100_000 + batch * BATCH} {BATCH}"},
        capture_output=True,
        text=True,
        check=False,
    )
    good = done.returncode == 0 and f"sessions: {BATCH}" in done.stdout
    return {"sessions": BATCH, "failed": 0 if good else 1, "said": "" if good else done.stdout[-500:]}


def check_sessions(minutes: float) -> list[Row]:
    done = list(pieces("sessions", CHANNEL, SESSIONS // BATCH, minutes, run_sessions))
    for piece in done:
        if piece["failed"]:
            print(piece["said"], file=sys.stderr)
    ran, failed = sum(p["sessions"] for p in done), sum(p["failed"] for p in done)
    return [
        exactly("link.sessions", ran, SESSIONS),
        exactly("link.sessions_batches_failed", failed, 0),
    ]


# ---- soak


def own_kb(process: int) -> int:
    """Resident memory of its own, without the pages of files that it has mapped, such as the recording."""
    words = Path(f"/proc/{process}/statm").read_text().split()
    return (int(words[1]) - int(words[2])) * 4


def watch(daemon: subprocess.Popen, status_file: Path) -> list[tuple[float, int, int]]:
    """Seconds, frames so far and kB of its own, until the daemon ends."""
    seen: list[tuple[float, int, int]] = []
    while daemon.poll() is None:
        time.sleep(0.2)
        try:
            frames = json.loads(status_file.read_text())["frames"]
            now = time.monotonic(), frames, own_kb(daemon.pid)
        except (OSError, ValueError, IndexError):
            continue
        if now[2] > 0 and (not seen or frames > seen[-1][1]):  # 0: it is just going
            seen.append(now)
    return seen


def replay(name: str, port: int, loop: Loop, frames: int, settings: dict) -> dict:
    """One daemon, one receiver, `frames` frames: their rate, what the memory grew by, and what was lost."""
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(1) as pool:
        folder = Path(scratch)
        loop.write(folder / "loop.y4m")
        (folder / "empty.ini").touch()
        settings = {
            **SETTINGS,
            **settings,
            "camera.path": folder / "loop.y4m",
            "camera.loops": frames // loop.frames,
            "spool.path": folder / "spool.db",
            "daemon.status_file": folder / "status.json",
            "survey.name": name,
            "link.port": port,
        }
        flags = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        with (folder / "log").open("wb") as log:
            daemon = subprocess.Popen([DAEMON, "--config", folder / "empty.ini", *flags], stderr=log)
        survey = folder / "survey.mcap"
        receive = [sys.executable, "-m", "pipefish", "receive", f"tcp://127.0.0.1:{port}", "-o", survey]
        receiver = pool.submit(subprocess.run, receive, capture_output=True, text=True, check=False)
        seen = watch(daemon, folder / "status.json")
        if receiver.result().returncode != 0:
            raise SystemExit(f"{name}: {receiver.result().stderr}{(folder / 'log').read_text()[-1000:]}")
        status = json.loads((folder / "status.json").read_text())
        got = Survey.open(survey)
        indices = [k.index for k in got.keyframes]
        late = [s for s in seen if s[1] > 0.4 * frames]  # by then everything has been used once
        first, last = seen[0], seen[-1]
        return {
            "frames": status["frames"],
            "fps": (last[1] - first[1]) / (last[0] - first[0]),
            "growth_kb": late[-1][2] - late[0][2],
            "growth_bytes_per_frame": 1024 * (late[-1][2] - late[0][2]) / (late[-1][1] - late[0][1]),
            # between two rounds six numbers are left out
            "dropped": status["frames_dropped"] - (frames // loop.frames - 1) * 6,
            "keyframes": len(indices),
            "wrong": int(indices != list(range(got.end.keyframes)) or status["keyframes_dropped"] > 0),
        }


def run_soak(piece: int) -> dict:
    return replay(f"soak {piece}", 20000 + piece, SMALL_LOOP, PIECE, SMALL)


def check_soak(minutes: float) -> list[Row]:
    done = list(pieces("soak", DAEMON, SOAK // PIECE, minutes, run_soak))
    rows = [exactly("soak.frames", sum(p["frames"] for p in done), SOAK)]
    if done:
        # The spool's page cache (2 MB at most) grows once when the host lags, in some pieces: what leaks grows in all.
        # The second least, for one lucky piece would hide a leak.
        growth = sorted(p["growth_bytes_per_frame"] for p in done)[:2][-1]
        rows += [
            at_most("soak.growth_bytes_per_frame", growth, GROWTH_BYTES),
            at_most("soak.growth_kb_most", max(p["growth_kb"] for p in done), 2560),
            at_least("soak.fps", min(p["fps"] for p in done), RATE),
            exactly("soak.surveys_wrong", sum(p["wrong"] for p in done), 0),
        ]
    return rows


def run_live(_piece: int) -> dict:
    return replay("live", 20100, LIVE_LOOP, LIVE, {})


def check_live(minutes: float) -> list[Row]:
    return [
        row
        for p in pieces("live", DAEMON, 1, minutes, run_live)
        for row in (
            exactly("live.frames", p["frames"], LIVE),
            exactly("live.frames_dropped", p["dropped"], 0),
            at_least("live.fps", p["fps"], 0.99 * RATE),
            exactly("live.surveys_wrong", p["wrong"], 0),
        )
    ]


# ---- control


class Taker(ObjectHandlers):
    """A host that takes everything and keeps nothing."""

    def __init__(self) -> None:
        self.bytes = 0

    def on_offer(self, name: bytes, kind: int, size: int) -> int:
        return ACCEPT

    def on_object(self, name: bytes, kind: int, data: bytes) -> int:
        self.bytes += len(data)
        return STORED


def _wait_while(is_waiting: Callable[[], bool], what: str, processes: list[subprocess.Popen]) -> None:
    """At most a minute, and only while all the processes live."""
    end = time.monotonic() + 60
    while is_waiting():
        if time.monotonic() > end or any(p.poll() is not None for p in processes):
            raise RuntimeError(f"not seen: {what}")
        time.sleep(0.05)


def run_control(_piece: int) -> dict:
    """REQUESTS requests to a daemon whose line has more to carry than it can; ms each, and the share of the line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        SMALL_LOOP.write(folder / "loop.y4m")
        rows = [f"{i},{i * 10**9 // 30},{i}" for i in range(SMALL_LOOP.frames)]  # a millimetre each: a keyframe each
        (folder / "loop.csv").write_text("\n".join(["sequence,time_ns,encoder_count", *rows]) + "\n")
        (folder / "empty.ini").touch()
        ends = folder / "crawler", folder / "host"
        settings = {
            **SETTINGS,
            **SMALL,
            "camera.path": folder / "loop.y4m",
            "encoder.metres_per_count": "0.001",
            "keyframe.step_mm": "1",
            "keyframe.min_interval": "1",
            "keyframe.jpeg_quality": "100",
            "spool.path": folder / "spool.db",
            "daemon.exit_when_done": "false",
            "link.transport": "serial",
            "link.device": ends[0],
            "link.baud": CONTROL_BAUD,
        }
        flags = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        said, taker, took = folder / "log", Taker(), []
        running = [subprocess.Popen([LINE, "--baud", str(CONTROL_BAUD), *ends], stdout=subprocess.DEVNULL)]
        try:
            _wait_while(lambda: not ends[1].exists(), "the line", running)
            with said.open("wb") as log:
                running.append(subprocess.Popen([DAEMON, "--config", folder / "empty.ini", *flags], stderr=log))
            # Nobody tracks any more: what is timed is the link.
            _wait_while(lambda: "survey ends" not in said.read_text(), "the survey's end", running)
            client = Client(SerialTransport(str(ends[1]), CONTROL_BAUD), taker)
            client.open()
            client.run(lambda: taker.bytes > 200_000, 60)
            start, before = time.monotonic(), taker.bytes
            for _ in range(REQUESTS):
                asked = time.monotonic()
                client.answer_to(5, get_status=pb.Nothing())
                took.append(1e3 * (time.monotonic() - asked))
                pause = time.monotonic() + 0.02
                client.run(lambda pause=pause: time.monotonic() > pause, 5)
            share = (taker.bytes - before) / ((time.monotonic() - start) * CONTROL_BAUD / 10)
            client.close()
        finally:
            for process in running:
                process.kill()
                process.wait()
    took.sort()
    return {
        "median_ms": took[len(took) // 2],
        "p95_ms": took[len(took) * 95 // 100],
        "most_ms": took[-1],
        "share": share,
    }


def check_control(minutes: float) -> list[Row]:
    return [
        row
        for p in pieces("control", DAEMON, 1, minutes, run_control)
        for row in (
            at_most("link.daemon_control_ms_median", p["median_ms"], 40),
            # What other programs of this machine delay is in these; the bound in virtual time is link.control_rtt_ms.
            figure("link.daemon_control_ms_p95", p["p95_ms"], "told only", True),
            at_least("link.daemon_line_share", p["share"], 0.8),  # the line was indeed full
        )
    ]


CHECKS = {"sessions": check_sessions, "soak": check_soak, "live": check_live, "control": check_control}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("only", nargs="?", default="")
    parser.add_argument("--minutes", type=float, default=600)
    args = parser.parse_args()
    rows = [r for name, check in CHECKS.items() if args.only in name for r in check(args.minutes)]
    print_rows(rows)


if __name__ == "__main__":
    main()
