"""pipefishd as a program: its settings, one survey from end to end, and what survives kill -9."""

import contextlib
import hashlib
import io
import json
import os
import random
import select
import signal
import socket
import sqlite3
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish import pipefish_pb2 as pb
from pipefish.client import ACCEPT, STORED, Client, Handlers
from pipefish.survey import lost_indices
from pipefish.transport import TcpTransport, TransportClosed

ROOT = Path(__file__).resolve().parents[2]
START, KEYFRAME, END = 1, 2, 3
SEED = int(os.environ.get("PIPEFISH_TEST_SEED", "0"))  # of the moments of killing; the long tests try others
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


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


class Crawler:
    """A daemon's settings and its process, which may be started again and again on the same spool."""

    def __init__(self, folder: Path, **settings: object) -> None:
        self.port = free_port()
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
            "daemon.drain_s": 20,
            "daemon.status_file": self.status_file,
        } | {key.replace("__", "."): value for key, value in settings.items()}
        sections: dict[str, list[str]] = {}
        for key, value in values.items():
            section, name = key.split(".")
            sections.setdefault(section, []).append(f"{name} = {value}")
        self.config.write_text("".join(f"[{s}]\n" + "\n".join(lines) + "\n" for s, lines in sections.items()))
        self.process: subprocess.Popen[bytes] | None = None

    def start(self, *arguments: str) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen([find_daemon(), "--config", self.config, *arguments], stderr=log)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def terminate(self) -> None:
        self.process.send_signal(signal.SIGTERM)

    def wait(self, timeout: float = 30) -> int:
        return self.process.wait(timeout)

    def status(self) -> dict:
        return json.loads(self.status_file.read_text()) if self.status_file.exists() else {}

    def text(self) -> str:
        return self.log.read_text()


class Store(Handlers):
    """A host's durable store: what it holds outlives its clients."""

    def __init__(self, port: int) -> None:
        self.port = port
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
    def client(self) -> Iterator[Client]:
        """A fresh client, as after the host's own restart; waits for the daemon's port."""
        client = Client(TcpTransport("127.0.0.1", self.port), self, wants_objects=True)
        end = time.monotonic() + 10
        while True:
            try:
                client.open()
                break
            except TransportClosed:
                assert time.monotonic() < end, "the daemon does not listen"
                time.sleep(0.01)
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


def serve(crawler: Crawler, client: Client, until, timeout: float = 30) -> None:
    """Runs the client until `until()` or the daemon's end."""
    end = time.monotonic() + timeout
    while not until() and crawler.process.poll() is None:
        assert time.monotonic() < end, crawler.text()
        client.step(0.02)


def wait_for_log(crawler: Crawler, text: str) -> None:
    """Until the daemon has logged `text`."""
    end = time.monotonic() + 20
    while text not in crawler.text():
        assert time.monotonic() < end, crawler.text()
        time.sleep(0.02)


def spooled(crawler: Crawler) -> Counter[int]:
    """How many objects of each kind the spool of a daemon that has ended holds."""
    with contextlib.closing(sqlite3.connect(crawler.config.parent / "spool.db")) as database:
        return Counter(kind for (kind,) in database.execute("SELECT kind FROM object"))


def receive_all(crawler: Crawler, store: Store) -> int:
    """Serves the daemon until it exits; returns its exit code."""
    with store.client() as client:
        serve(crawler, client, lambda: False)
    return crawler.wait()


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([find_daemon(), *map(str, arguments)], capture_output=True, text=True, timeout=20)


@pytest.fixture
def crawler(tmp_path: Path) -> Iterator[Crawler]:
    """A daemon with a recording of 40 frames."""
    write_recording(tmp_path / "survey.y4m", 40)
    crawler = Crawler(tmp_path)
    yield crawler
    if crawler.process is not None:
        crawler.kill()


# ---- settings


def test_help_config_is_the_committed_example_and_a_valid_file(tmp_path: Path):
    text = run("--help-config").stdout
    assert text == (ROOT / "firmware" / "pipefishd.ini.example").read_text()
    config = tmp_path / "c.ini"
    config.write_text(text)
    assert run("--config", config, "--check-config", "--set", "camera.path=x").returncode == 0


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
        ("[camera]\ndriver = v4l3", "camera.driver = v4l3: this build has: replay"),
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


def test_a_profile_that_is_none_is_refused_before_anything_starts(tmp_path: Path, crawler: Crawler):
    profile = tmp_path / "p.bin"
    profile.write_bytes(b"nonsense")
    done = run("--config", crawler.config, "--check-config", "--set", f"camera.profile={profile}")
    assert done.returncode == 1
    assert str(profile) in done.stderr


def test_a_busy_port_a_used_spool_and_a_missing_recording_are_clear_errors(tmp_path: Path, crawler: Crawler):
    with socket.create_server(("127.0.0.1", crawler.port)):
        done = run("--config", crawler.config)
    assert done.returncode == 1
    assert str(crawler.port) in done.stderr
    crawler.start("--set", "camera.loops=0")
    with Store(crawler.port).client():
        wait_for_log(crawler, "begins")
        done = run("--config", crawler.config, "--set", f"link.port={free_port()}")
    assert done.returncode == 1
    assert "spool.db" in done.stderr
    done = run("--config", crawler.config, "--set", f"camera.path={tmp_path}/absent.y4m")
    assert done.returncode == 1
    assert "absent.y4m" in done.stderr


# ---- one survey


def test_a_whole_survey_arrives_and_its_counters_agree(tmp_path: Path, crawler: Crawler):
    hashes = write_recording(tmp_path / "survey.y4m", 40)
    store = Store(crawler.port)
    crawler.start("--set", "survey.name=Ölstraße 7")
    assert receive_all(crawler, store) == 0

    [start], keyframes, [end] = store.starts, store.keyframes, store.ends
    assert start.name == "Ölstraße 7"
    assert start.source.startswith("replay")
    assert (start.width, start.height, start.profile) == (WIDTH, HEIGHT, b"")
    assert start.encoder.metres_per_count == 0.0001
    assert "keyframe.step_mm = 2" in start.config
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
        for column in (o.x_q16, o.y_q16, o.cov_xx_q20, o.cov_xy_q20, o.cov_yy_q20, o.age, o.quality, o.status):
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


def test_a_profile_goes_with_the_survey_and_gives_parallax_keyframes_and_the_image_circle(
    tmp_path: Path, crawler: Crawler
):
    camera = pf.Camera(
        **{"width": WIDTH, "height": HEIGHT, "f_u": 60.0, "f_v": 60.0, "c_u": 95.5, "c_v": 79.5, "theta_max": 1.5},
        **{"circle_u": 95.5, "circle_v": 79.5, "circle_radius": 75.0},
    )
    profile = tmp_path / "camera.bin"
    profile.write_bytes(camera.to_binary())
    store = Store(crawler.port)
    crawler.start(
        *("--set", f"camera.profile={profile}", "--set", "keyframe.min_common=1"),
        *("--set", "encoder.metres_per_count=0", "--set", "keyframe.parallax_deg=1"),
    )
    assert receive_all(crawler, store) == 0
    assert store.starts[0].profile == camera.to_binary()
    causes = Counter(k.cause for k in store.keyframes)
    assert causes[pb.KEYFRAME_CAUSE_FIRST] == 1
    assert causes[pb.KEYFRAME_CAUSE_PARALLAX] >= 2
    assert len(store.keyframes) < 20
    for k in store.keyframes:
        pixels = np.asarray(Image.open(io.BytesIO(k.jpeg)))
        assert pixels[:8, :8].max() == 0  # outside of the circle
        assert pixels[60:100, 60:130].min() > 0
        x, y = np.array(k.observations.x_q16) / 65536, np.array(k.observations.y_q16) / 65536
        assert np.hypot(x - 95.5, y - 79.5).max() <= 75
    done = run(
        "--config", crawler.config, "--set", f"camera.profile={profile}", "--set", f"camera.path={other(tmp_path)}"
    )
    assert done.returncode == 1
    assert "the profile is for 192 x 160, the camera gives 64 x 64" in done.stderr


def other(folder: Path) -> Path:
    """A recording of another size."""
    path = folder / "other.y4m"
    path.write_bytes(b"YUV4MPEG2 W64 H64 F25:1 Ip A1:1 Cmono\nFRAME\n" + bytes(4096))
    return path


def test_a_serial_device_that_is_not_there_is_waited_for_and_its_loss_is_logged_once(tmp_path: Path, crawler: Crawler):
    device = tmp_path / "ttyPipe"
    crawler.start("--set", "link.transport=serial", "--set", f"link.device={device}")
    wait_for_log(crawler, "survey ends")  # it goes on into the spool meanwhile
    missing = f"{device}: No such file or directory"
    wait_for_log(crawler, missing)
    master, slave = os.openpty()
    device.symlink_to(os.ttyname(slave))
    end = time.monotonic() + 20
    while not select.select([master], [], [], 0.1)[0]:  # its hello
        assert time.monotonic() < end, crawler.text()
    device.unlink()
    os.close(master)
    os.close(slave)
    wait_for_log(crawler, f"{device}: hung up")
    time.sleep(1)  # four tries
    assert crawler.text().count(missing) == 2  # before it came, and after it went
    assert crawler.text().count("hung up") == 1


@pytest.mark.parametrize("threads", [(1, 1), (1, 2), (2, 2)])
def test_runs_of_one_recording_are_the_same_with_one_thread_and_with_two(tmp_path: Path, threads: tuple[int, int]):
    write_recording(tmp_path / "survey.y4m", 60, skip=(20, *range(31, 39)))  # a dropped frame, and a break
    runs = []
    for name, count in zip("ab", threads, strict=True):
        folder = tmp_path / name
        folder.mkdir()
        crawler = Crawler(folder, camera__path=tmp_path / "survey.y4m", daemon__threads=count)
        store = Store(crawler.port)
        crawler.start()
        assert receive_all(crawler, store) == 0
        runs.append(store.keyframes)
        for keyframe in runs[-1]:  # all but what belongs to the run
            keyframe.ClearField("survey_id")
            keyframe.ClearField("time")
            keyframe.telemetry.ClearField("time")
    assert len(runs[0]) > 20
    assert [k.break_reason for k in runs[0] if k.after_break] == ["gap of 8 frames"]
    assert [k.SerializeToString(deterministic=True) for k in runs[0]] == [
        k.SerializeToString(deterministic=True) for k in runs[1]
    ]


def write_pgm(path: Path, pixels: np.ndarray) -> None:
    path.write_bytes(b"P5\n%d %d\n255\n" % pixels.shape[::-1] + pixels.astype(np.uint8).tobytes())


def test_nothing_is_tracked_under_the_mask_of_the_configuration(tmp_path: Path):
    mask = np.full((HEIGHT, WIDTH), 255)
    mask[:, 96:160] = 0
    write_pgm(tmp_path / "mask.pgm", mask)
    write_recording(tmp_path / "survey.y4m", 20)
    crawler = Crawler(tmp_path, tracker__mask=tmp_path / "mask.pgm")
    store = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, store) == 0
    x = np.concatenate([np.array(k.observations.x_q16) / 65536 for k in store.keyframes])
    assert len(x) > 50 and not np.any((x >= 96) & (x < 160))
    assert store.ends[0].last_status.tracking.lost_masked > 0  # the pattern moves to the left, into the mask


@pytest.mark.parametrize(
    ("mask", "what"),
    [
        (np.zeros((5, 7)), "tracker.mask: {path}: 7 x 5 pixels, but the camera gives 192 x 160"),
        (None, "tracker.mask: {path}: No such file or directory"),
        (b"GIF89a", "tracker.mask: {path}: byte 0: neither PNG, JPEG nor binary PGM"),
    ],
)
def test_a_mask_that_does_not_fit_is_a_clear_error(tmp_path: Path, crawler: Crawler, mask, what: str):
    path = tmp_path / "mask.pgm"
    if isinstance(mask, bytes):
        path.write_bytes(mask)
    elif mask is not None:
        write_pgm(path, mask)
    crawler.start("--set", f"tracker.mask={path}")
    assert crawler.wait() == 1
    assert what.format(path=path) in crawler.text()


def test_polar_cells_without_a_circle_are_a_clear_error(crawler: Crawler):
    crawler.start("--set", "tracker.cells=polar")
    assert crawler.wait() == 1
    assert "tracker.cells = polar: needs an image circle" in crawler.text()


def write_states(path: Path, black: int = 0, white: int = 255) -> None:
    """Moving, standing, dark, moving: 30 frames each, by a camera with these levels."""
    pattern = texture(3)
    with path.open("wb") as out:
        out.write(f"YUV4MPEG2 W{WIDTH} H{HEIGHT} F25:1 Ip A1:1 Cmono\n".encode())
        shift = 0
        for i in range(120):
            part = i // 30
            shift += 2 if part in (0, 3) else 0
            frame = np.roll(pattern, -shift, axis=1)[:, :WIDTH]
            grey = black + (frame // (60 if part == 2 else 1)).astype(int) * (white - black) // 255
            out.write(b"FRAME\n" + np.ascontiguousarray(grey.astype(np.uint8)).tobytes())
    path.with_suffix(".csv").unlink(missing_ok=True)


@pytest.mark.parametrize(("black", "white"), [(0, 255), (16, 235)])
def test_states_of_the_scene_reach_the_host_and_the_log(tmp_path: Path, black: int, white: int):
    write_states(tmp_path / "survey.y4m", black, white)
    crawler = Crawler(
        tmp_path,
        encoder__metres_per_count=0,
        keyframe__min_common=2000,
        camera__black_level=black,
        camera__white_level=white,
    )
    store = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, store) == 0
    log = crawler.text()
    order = ["standing still", "dark", "no longer dark"]
    at = [log.index(f": {text}\n") for text in order]
    assert at == sorted(at)
    last = store.ends[0].last_status.tracking
    assert last.frames == 120 and not last.dark and not last.standing
    lost = last.lost_residual + last.lost_flat + last.lost_backward + last.lost_diverged + last.lost_drift
    assert lost > 0  # in the dark
    assert crawler.status()["tracking"]["frames"] == 120
    assert sum(k.tracking.frames for k in store.keyframes) <= 120
    assert last.state_frames[0] >= 15 and last.state_frames[2] >= 20  # standing; dark
    assert sum(k.tracking.state_frames[0] for k in store.keyframes if k.tracking.state_frames) >= 15


def test_dropped_frames_are_counted_and_a_long_gap_is_a_marked_break(tmp_path: Path, crawler: Crawler):
    write_recording(tmp_path / "survey.y4m", 30, skip=(5, *range(20, 32)))
    store = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, store) == 0
    assert crawler.status()["frames_dropped"] == 13
    breaks = [k for k in store.keyframes if k.after_break]
    assert [(k.frame_sequence, k.break_reason, k.cause) for k in breaks] == [
        (32, "gap of 12 frames", pb.KEYFRAME_CAUSE_FIRST)
    ]
    assert set(breaks[0].observations.status) == {pb.TRACK_STATUS_NEW}


def test_sigterm_ends_the_survey_and_drains(tmp_path: Path, crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "camera.loops=0", "--set", "camera.speed=recorded")
    with store.client() as client:
        serve(crawler, client, lambda: len(store.keyframes) >= 3)
        crawler.terminate()
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    [end] = store.ends
    assert end.reason == "terminated"
    assert [k.index for k in store.keyframes] == list(range(end.keyframes))


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
    wait_for_log(crawler, "begins")
    time.sleep(0.3)
    crawler.terminate()
    assert crawler.wait() == 0
    made = int(crawler.text().split("survey ends: terminated; ")[1].split()[0])
    assert spooled(crawler) == {START: 1, KEYFRAME: made, END: 1}


class LateStore(Store):
    """A host that takes the survey's end in, but acknowledges it only when `may_acknowledge` says so."""

    may_acknowledge = False

    def on_object(self, name: bytes, kind: int, data: bytes) -> int | None:
        return None if kind == END and not self.may_acknowledge else super().on_object(name, kind, data)


def test_an_acknowledgement_at_the_last_moment_still_empties_the_spool(crawler: Crawler):
    store = LateStore(crawler.port)
    crawler.start("--set", "daemon.drain_s=1", "--set", "daemon.log_level=debug")
    with store.client() as client:
        serve(crawler, client, lambda: "the link closes" in crawler.text())
        store.may_acknowledge = True
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    assert len(store.ends) == 1
    assert spooled(crawler) == {}


def test_a_shutdown_waits_for_a_host_that_takes_nothing_only_as_long_as_a_signal_does(crawler: Crawler):
    crawler.start("--set", "daemon.drain_s=1", "--set", "daemon.exit_when_done=false")
    with contextlib.closing(Client(TcpTransport("127.0.0.1", crawler.port), Handlers(), wants_objects=False)) as client:
        wait_for_log(crawler, "survey ends")
        client.open()
        serve(crawler, client, lambda: client.up)
        client.ask(shutdown=pb.Nothing())
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0
    assert spooled(crawler) == {START: 1, KEYFRAME: 20, END: 1}


def test_a_second_sigterm_exits_at_once(crawler: Crawler):
    crawler.start("--set", "camera.loops=0")
    with Store(crawler.port).client():
        crawler.terminate()
        wait_for_log(crawler, "survey ends")
        assert crawler.process.poll() is None  # nobody takes the objects: it drains
        crawler.terminate()
        assert crawler.wait(5) == 1


def test_requests_are_answered(crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "camera.loops=0", "--set", "camera.speed=recorded")

    def ask(client: Client, **what: object) -> pb.Reply:
        number = client.ask(**what)
        serve(crawler, client, lambda: number in client.replies)
        return client.replies.pop(number)

    with store.client() as client:
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
    with store.client() as client:
        serve(crawler, client, lambda: bool(store.statuses) and store.statuses[-1].state == "idle")
        assert crawler.process.poll() is None
        assert len(store.keyframes) == 20
        client.ask(shutdown=pb.Nothing())
        serve(crawler, client, lambda: False)
    assert crawler.wait() == 0


def wake_ups_per_second(crawler: Crawler, seconds: float) -> float:
    """How often the daemon's threads have gone to sleep, a second."""

    def count() -> int:
        tasks = Path(f"/proc/{crawler.process.pid}/task").glob("*/status")
        return sum(int(t.read_text().split("voluntary_ctxt_switches:")[1].split()[0]) for t in tasks)

    first, begin = count(), time.monotonic()
    time.sleep(seconds)
    return (count() - first) / (time.monotonic() - begin)


def test_a_daemon_without_a_host_sleeps(crawler: Crawler):
    crawler.start()
    wait_for_log(crawler, "survey ends")
    assert wake_ups_per_second(crawler, 1) < 200  # it looks around 20 times a second, the rest is spare


def test_a_host_that_reads_nothing_counts_as_gone_and_costs_no_wake_ups(tmp_path: Path, crawler: Crawler):
    write_recording(tmp_path / "survey.y4m", 600)
    store = Store(crawler.port)
    full_line = ("--set", "link.window=1048576", "--set", "link.send_slots=16")
    crawler.start("--set", "link.keepalive_ms=200", *full_line, *EVERY_FRAME)
    with store.client() as client:
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


def test_a_full_spool_makes_a_fast_replay_wait_and_loses_nothing(crawler: Crawler):
    store = Store(crawler.port)
    crawler.start("--set", "spool.quota_mb=0.3", *EVERY_FRAME)
    wait_for_log(crawler, "make room")
    assert receive_all(crawler, store) == 0
    [end_message] = store.ends
    assert [k.index for k in store.keyframes] == list(range(end_message.keyframes))
    assert list(end_message.lost_first) == []


def test_a_quota_below_one_object_is_refused_at_the_start(crawler: Crawler):
    done = run("--config", crawler.config, "--set", "spool.quota_mb=0.05")
    assert done.returncode == 1
    assert "spool.quota_mb = 0.05: an object of this camera may have" in done.stderr


def test_a_full_spool_makes_a_live_survey_drop_keyframes_and_name_them(tmp_path: Path, crawler: Crawler):
    write_recording(tmp_path / "survey.y4m", 40, rate=20)
    store = Store(crawler.port)
    crawler.start("--set", "spool.quota_mb=0.3", "--set", "camera.speed=recorded", *EVERY_FRAME)
    wait_for_log(crawler, "survey ends")
    assert receive_all(crawler, store) == 0
    [end_message] = store.ends
    lost, got = lost_indices(end_message), {k.index for k in store.keyframes}
    assert lost
    assert lost & got == set()
    assert lost | got == set(range(end_message.keyframes))
    assert crawler.status()["keyframes_dropped"] == len(lost)


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
    for _ in range(kills):
        crawler.start("--set", "camera.loops=0")
        time.sleep(rng.uniform(0.02, 0.25))
        crawler.kill()
    store = Store(crawler.port)
    crawler.start()
    assert receive_all(crawler, store) == 0
    check_everything_arrived_once(store, kills)


@pytest.mark.parametrize("change", ["survey.name=the next pipe", "encoder.metres_per_count=0.0002"])
def test_after_kill_9_another_setup_begins_another_survey_and_ends_the_old_one(crawler: Crawler, change: str):
    crawler.start("--set", "camera.loops=0")
    wait_for_log(crawler, "begins")
    time.sleep(0.3)
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
            with store.client() as client:
                end = time.monotonic() + rng.uniform(0.02, 0.2)
                serve(crawler, client, lambda end=end: time.monotonic() > end)
        crawler.kill()
    assert len(store.objects) > kills  # it was indeed sending
    crawler.start()
    assert receive_all(crawler, store) == 0
    check_everything_arrived_once(store, kills)
    assert set(store.arrivals.values()) == {1}
