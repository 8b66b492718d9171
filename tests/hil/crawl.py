"""A crawler on the emulated board: what its camera sees, its daemon, the host that receives, and the replay that must
give the same."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from board import ROOT, Board

from pipefish.survey import Survey

PIPEFISH = Path(sys.executable).with_name("pipefish")
HOST_DAEMON = ROOT / "build" / "release" / "firmware" / "pipefishd"
FRAME = b"FRAME\n"
# Settings that a replay on the host has no use for.
BOARD_ONLY = (
    *("gpio.", "camera.device", "camera.format", "camera.buffers"),
    *("link.device", "link.baud", "link.trust", "link.address"),
)
SETTINGS = {
    "camera.driver": "v4l2",
    "camera.profile": "{folder}/crawl.profile",
    "tracker.max_tracks": "80",
    "keyframe.parallax_deg": "3",
    "keyframe.min_interval": "1",
    "survey.nominal_diameter_mm": "200",
    "status.preview_interval_ms": "0",
    "link.keepalive_ms": "300",
}


RESERVED: list[socket.socket] = []


def free_port() -> int:
    """A port of the loopback that the system gives to nobody else until the tests end: a socket that is bound and does
    not listen keeps it, and keeps none out who binds it with SO_REUSEADDR, as the daemon and QEMU do."""
    holder = socket.socket()
    holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    holder.bind(("127.0.0.1", 0))
    RESERVED.append(holder)
    return holder.getsockname()[1]


@dataclass
class Recording:
    """The simulated frames: `frames` bytes by SHA-256, and in order."""

    path: Path
    header: bytes
    order: list[str]
    frames: dict[str, bytes]
    counts: list[int]

    @staticmethod
    def load(path: Path) -> Recording:
        data = path.read_bytes()
        header, _, rest = data.partition(b"\n")
        words = dict((w[:1], w[1:]) for w in header.decode().split()[1:])
        size = int(words["W"]) * int(words["H"])
        order, frames = [], {}
        for at in range(0, len(rest), size + len(FRAME)):
            pixels = rest[at + len(FRAME) : at + len(FRAME) + size]
            name = hashlib.sha256(pixels).hexdigest()
            order.append(name)
            frames[name] = pixels
        with path.with_suffix(".csv").open() as rows:
            counts = [int(row["encoder_count"]) for row in csv.DictReader(rows)]
        return Recording(path, header, order, frames, counts)


@dataclass
class Result:
    """One scenario's row in the table."""

    name: str
    frames_in: int = 0
    keyframes_out: int = 0
    lost: int = 0
    duplicated: int = 0
    recovery_s: float | None = None
    # Of the last boot, in the board's time from its kernel's start on: it takes commands, the daemon is started, the
    # daemon's first frame. What the test does in between is in it.
    up_s: float | None = None
    daemon_s: float | None = None
    frame_s: float | None = None
    cpu_ms: float | None = None  # of the daemon's last start, a frame, in the board's time
    cpu_share: dict[str, float] = field(default_factory=dict)  # of that, by stage


class Crawl:
    """One survey on one board."""

    def __init__(self, board: Board, recording: Recording, folder: Path, settings: dict[str, str]) -> None:
        self.board, self.recording, self.folder = board, recording, folder
        self.settings = {**SETTINGS, **settings}
        self.output = folder / "survey.mcap"
        self.patience = 3 if board.has_system else 1  # a whole system has much to do besides
        self.daemon = 0
        self.starts = 0
        self._first_start = (0, 0, 0.0)  # of the last boot that had one: which boot, which start, the board's uptime
        self.environment = {**os.environ, "XDG_CONFIG_HOME": str(folder / "host")}
        self._receiver: subprocess.Popen[bytes] | None = None
        for suffix in ("y4m", "profile"):
            target = board.share / f"crawl.{suffix}"
            target.write_bytes(recording.path.with_suffix(f".{suffix}").read_bytes())
        (board.share / "counts.txt").write_text("".join(f"{count}\n" for count in recording.counts))

    # ---- on the board

    def _arguments(self, settings: dict[str, str], folder: str) -> list[str]:
        lines = {**self.settings, **settings}
        return [f"{key}={value.format(folder=folder)}" for key, value in lines.items()]

    def pair(self) -> str:
        """Lets this host in over the network, as the board's owner does on its console; what to receive from."""
        key = self._pipefish("pair", "--json")["host"]["key"]
        trust = self.settings["link.trust"]
        said = self.board.run(
            ": > /run/empty.ini; /mnt/pipefishd --config /run/empty.ini --set camera.driver=v4l2 "
            f'--set link.trust={trust} --pair "operator {key} hil"'
        )
        self._pipefish("pair", "--json", "--device-key", said.split()[-1], "--device-name", "board")
        return f"tls://127.0.0.1:{self.board.port}"

    def _pipefish(self, *arguments: str) -> dict:
        done = subprocess.run([PIPEFISH, *arguments], env=self.environment, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)

    def start_daemon(self) -> None:
        """The arm64 daemon, its spool on the board's disk and its frame index in the shared folder."""
        self.board.run("mkdir -p /mnt/index; : > /run/empty.ini; rm -f /run/status.json")
        settings = {
            "camera.index": "/mnt/index",
            "spool.path": "/data/spool.db",
            "daemon.status_file": "/run/status.json",
            "status.interval_ms": "200",
        }
        flags = " ".join(f"--set {a}" for a in self._arguments(settings, "/mnt"))
        self._note_start()
        self.daemon = self.board.spawn(
            f"exec /mnt/pipefishd --config /run/empty.ini {flags}", f"daemon{self.starts - 1}.log"
        )

    def _note_start(self) -> None:
        self.starts += 1
        if self._first_start[0] != self.board.boots:
            self._first_start = self.board.boots, self.starts, self.board.uptime()

    def install(self, package: Path) -> None:
        """As its owner does: the package by dpkg, settings in its file, the service enabled and started. The log
        goes to the shared folder as that of start_daemon."""
        board = self.board
        (board.share / package.name).write_bytes(package.read_bytes())
        board.run(f"dpkg -i /mnt/{package.name}")
        settings = {
            "camera.index": "/var/lib/pipefish/index",
            "camera.profile": "/etc/pipefish/crawl.profile",
            "spool.path": "/var/lib/pipefish/spool.db",
            "daemon.status_file": "/run/pipefish/status.json",
            "status.interval_ms": "200",
        }
        sections: dict[str, list[str]] = {}
        for line in self._arguments(settings, "/etc/pipefish"):
            section, _, rest = line.partition(".")
            sections.setdefault(section, []).append(rest.replace("=", " = ", 1))
        text = "".join(f"[{name}]\n" + "\n".join(lines) + "\n" for name, lines in sections.items())
        (board.share / "pipefishd.ini").write_text(text)
        # A watchdog that barks sooner than the unit's 30 s.
        log = "[Service]\nStandardError=append:/mnt/daemon0.log\nWatchdogSec=10\n"
        (board.share / "log.conf").write_text(log)
        folder = "/etc/systemd/system/pipefishd.service.d"
        board.run(f"mkdir -p {folder} && cp /mnt/log.conf {folder} && systemctl daemon-reload")
        board.run("cp /mnt/pipefishd.ini /mnt/crawl.profile /etc/pipefish/ && pipefishd --check-config")
        board.run("install -d -o pipefish -g pipefish -m 750 /var/lib/pipefish /var/lib/pipefish/index")
        board.run("ln -s /run/pipefish/status.json /run/status.json; touch /mnt/daemon0.log")
        self._note_start()
        board.run("systemctl enable pipefishd && systemctl start pipefishd")

    def wait_for(self, text: str, timeout: float = 300) -> float:
        """Until the daemon's log of this start has `text`; the seconds that took. Fails, after one last look, when the
        process of start_daemon() has ended."""
        start, timeout = time.monotonic(), timeout * self.patience
        looked, has_ended = start, False
        log = self.board.share / f"daemon{self.starts - 1}.log"
        while text not in log.read_text(errors="replace"):
            if has_ended or time.monotonic() - start > timeout:
                ended = " (it has ended)" if has_ended else ""
                said = f"{self.board.logs()}\n{self.board.console()}"
                raise AssertionError(f"the daemon did not say '{text}'{ended}:\n{said}")
            if self.daemon and time.monotonic() - looked > 2:  # a command costs the emulated board time
                has_ended, looked = not self.board.is_running(self.daemon), time.monotonic()
            time.sleep(0.05)
        return time.monotonic() - start

    def wait_until(self, condition, what: str, timeout: float = 300) -> float:
        """Until condition(status) of the daemon's status file; the seconds that took."""
        start, timeout = time.monotonic(), timeout * self.patience
        while not condition(self.board.status()):
            if time.monotonic() - start > timeout:
                ended = "" if self.board.is_running(self.daemon) else " (the daemon has ended)"
                raise AssertionError(f"not seen: {what}{ended}: {self.board.status()}\n{self.board.logs()}")
            time.sleep(0.1)
        return time.monotonic() - start

    def show(
        self,
        first: int,
        count: int,
        rate: float,
        device: str,
        pixels: str = "GREY",
        encoder: str = "",
        on: bool = False,
    ) -> int:
        """Begins to show frames to the camera, once, or with `on` to and fro until hide(); the world's process id.

        What is to happen while frames come has all the time it needs only with `on`."""
        world = "/mnt/pipefish-world" + " --to-and-fro" * on
        command = f"exec {world} /mnt/crawl.y4m {device} {pixels} {rate} {first} {count} {encoder}"
        return self.board.spawn(command, f"world{first}.log")

    def hide(self, world: int) -> None:
        """Ends a world that shows on and on; its last frame has a period's time to be taken."""
        self.board.run(f"kill -TERM {world}")
        self.board.wait(world)

    def measure(self, result: Result, process: int) -> None:
        """Adds the daemon's CPU time to the table, while it runs: its threads', the tracking's by the stage timers."""
        status = self.board.status()
        ticks: dict[str, int] = {}
        for line in self.board.run(f"cat /proc/{process}/task/*/stat 2>/dev/null", check=False).splitlines():
            name, numbers = re.fullmatch(r"\d+ \((.*)\) \S (.*)", line).groups()
            user, system = numbers.split()[10:12]
            ticks[name] = ticks.get(name, 0) + int(user) + int(system)
        stages = {stage: status["stage"][stage] for stage in ("pyramid", "track", "detect")}
        tracking = ticks.pop("tracking", 0)
        spent = {stage: tracking * us / max(sum(stages.values()), 1e-9) for stage, us in stages.items()}
        spent |= {name: ticks.pop(name, 0) for name in ("capture", "store", "link")}
        spent["main"] = ticks.pop("pipefishd", 0)  # opens everything, writes the status file
        spent["other"] = sum(ticks.values())
        total = sum(spent.values())
        result.cpu_ms = 10 * total / max(status["frames"], 1)
        result.cpu_share = {stage: part / max(total, 1) for stage, part in spent.items()}

    def stop_daemon(self) -> None:
        """The survey ends; the daemon drains and exits."""
        self.board.run(f"kill -TERM {self.daemon}")

    # ---- on the host

    def start_receiver(self, device: str) -> None:
        with (self.folder / "receive.log").open("ab") as log:
            self._receiver = subprocess.Popen(
                [PIPEFISH, "receive", device, "-o", self.output, "--timeout", str(300 * self.patience)],
                env=self.environment,
                stdout=log,
                stderr=log,
            )

    def kill_receiver(self) -> None:
        self._receiver.send_signal(signal.SIGKILL)
        self._receiver.wait()

    def finish(self, timeout: float = 300) -> Survey:
        """Waits for the receiver; the survey it got."""
        try:
            code = self._receiver.wait(timeout * self.patience)
        except subprocess.TimeoutExpired as error:
            raise AssertionError(f"the survey does not end\n{self._texts()}") from error
        assert code == 0, self._texts()
        self.received = Survey.open(self.output)
        return self.received

    def _texts(self) -> str:
        return f"{(self.folder / 'receive.log').read_text()[-2000:]}\n{self.board.logs()}\n{self.board.console()}"

    def close(self) -> None:
        if self._receiver is not None and self._receiver.poll() is None:
            self._receiver.kill()
            self._receiver.wait()

    # ---- what must be true

    def indices(self) -> list[tuple[Path, list[dict[str, str]]]]:
        """The rows of each start's frame index; a last row that power cut short is left out."""
        out = []
        for path in sorted((self.board.share / "index").glob("*.csv")):
            text = path.read_text()
            whole = text[: text.rfind("\n") + 1]
            out.append((path, list(csv.DictReader(whole.splitlines()))))
        return out

    def replay(self, rows: list[dict[str, str]], name: str) -> Survey:
        """The host's own daemon on the frames of one index, in its order, with its gaps and repeats."""
        folder = self.folder / name
        folder.mkdir()
        with (folder / "replay.y4m").open("wb") as out:
            out.write(self.recording.header + b"\n")
            for row in rows:
                out.write(FRAME + self.recording.frames[row["sha256"]])
        with (folder / "replay.csv").open("w", newline="") as out:
            writer = csv.DictWriter(out, rows[0].keys())
            writer.writeheader()
            writer.writerows(rows)
        port = free_port()
        settings = {
            "camera.driver": "replay",
            "camera.path": f"{folder}/replay.y4m",
            "camera.speed": "fast",
            "spool.path": f"{folder}/spool.db",
            "link.transport": "tcp",
            "link.port": str(port),
        }
        (folder / "empty.ini").touch()
        command = [HOST_DAEMON, "--config", folder / "empty.ini"]
        for argument in self._arguments(settings, str(self.board.share)):
            if not argument.startswith(BOARD_ONLY):
                command += ["--set", argument]
        with (folder / "daemon.log").open("wb") as log:
            daemon = subprocess.Popen(command, stderr=log)
        try:
            receive = [PIPEFISH, "receive", f"tcp://127.0.0.1:{port}", "-o", folder / "replay.mcap"]
            subprocess.run(receive, check=True, capture_output=True, timeout=300)
            daemon.wait(60)
        finally:
            daemon.kill()
        return Survey.open(folder / "replay.mcap")

    def check(self, survey: Survey, result: Result, with_noise: bool = False) -> Result:
        """Nothing lost, nothing twice, every frame whole; tracks and pictures as in the replay, bit for bit.

        With `with_noise` the camera may have shown what nobody gave it; what came before that is compared."""
        assert survey.complete and not survey.lost, (survey.missing, survey.lost)
        assert [k.index for k in survey.keyframes] == list(range(len(survey.keyframes)))
        moments = Counter((k.boot, k.message.frame_sequence) for k in survey.keyframes)
        result.duplicated = sum(n - 1 for n in moments.values())
        result.keyframes_out = len(survey.keyframes)
        boots = list(dict.fromkeys(s.time.boot_id for s in survey.starts))
        _, start, result.daemon_s = self._first_start
        result.up_s = self.board.up_s
        compared = 0
        for number, (path, rows) in enumerate(self.indices()):
            result.frames_in += len(rows)
            strange = [i for i, row in enumerate(rows) if row["sha256"] not in self.recording.frames]
            assert with_noise or not strange, f"{path.name}: frames that nobody showed: {strange[:20]}"
            rows = rows[: strange[0]] if strange else rows
            if not rows:
                continue
            count = int(path.stem.split("-")[1])
            if count == start:
                result.frame_s = int(rows[0]["time_ns"]) / 1e9
            boot = boots[count - 1]
            last = int(rows[-1]["sequence"])
            got = {
                k.message.frame_sequence: k
                for k in survey.keyframes
                if k.boot == boot and k.message.frame_sequence <= last
            }
            expected = {k.message.frame_sequence: k for k in self.replay(rows, f"replay{number}").keyframes}
            # A restart without warning loses what had not reached the spool; what has must be as expected.
            ended = boot == survey.end.time.boot_id
            missing = set(expected) - set(got)
            if ended:
                result.lost += len(missing)
            assert set(got) <= set(expected), (sorted(got), sorted(expected))
            for sequence, keyframe in got.items():
                compare(keyframe, expected[sequence])
                compared += 1
        assert compared == len(survey.keyframes) or (with_noise and compared >= 5), compared
        assert result.duplicated == 0 and result.lost == 0, result
        return result


def compare(a, b) -> None:
    """Two keyframes of one frame: tracks, picture, hash and readings must be the same bits."""
    assert a.message.observations.SerializeToString() == b.message.observations.SerializeToString()
    assert a.message.frame_sha256 == b.message.frame_sha256
    assert a.message.cause == b.message.cause
    assert a.telemetry.get("encoder_count") == b.telemetry.get("encoder_count")
    assert a.jpeg == b.jpeg


def is_alive(process: subprocess.Popen[bytes]) -> bool:
    with contextlib.suppress(ProcessLookupError):
        os.kill(process.pid, 0)
        return process.poll() is None
    return False
