"""pipefishd: what its tracking is told and what it tells: profiles, masks, cells, threads, states, gaps."""

import io
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from crawler import HEIGHT, WIDTH, Crawler, Store, receive_all, run, texture, write_recording
from pipefish import pipefish_pb2 as pb


def other(folder: Path) -> Path:
    """A recording of another size."""
    path = folder / "other.y4m"
    path.write_bytes(b"YUV4MPEG2 W64 H64 F25:1 Ip A1:1 Cmono\nFRAME\n" + bytes(4096))
    return path


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


def drive_through_a_tube(path: Path, frames: int, per_frame: float) -> pf.Camera:
    """A recording of the inside of a round tube, drawn ray by ray: `per_frame` radii and 45 encoder counts a frame."""
    side, focal, circle = 320, 100.0, 150.0
    y, x = np.mgrid[:side, :side] - side / 2 + 1e-6
    r, azimuth = np.hypot(x, y), np.arctan2(y, x)
    ahead = 1 / np.tan(np.minimum(r / focal, 3.0))
    contrast = 22 * np.clip(3.5 - ahead, 0, 1)  # farther away the waves are finer than pixels
    rows = ["sequence,time_ns,encoder_count"]
    with path.open("wb") as out:
        out.write(f"YUV4MPEG2 W{side} H{side} F30:1 Ip A1:1 Cmono\n".encode())
        for i in range(frames):
            waves = (
                np.sin((3 + 5 * k % 17) * azimuth + (-1) ** k * (6 + 7 * k % 13) * (ahead + per_frame * i) + 1.7 * k)
                for k in range(12)
            )
            pixels = np.where(r < circle, np.clip(120 + contrast * sum(waves), 3, 245), 0).astype(np.uint8)
            out.write(b"FRAME\n" + pixels.tobytes())
            rows.append(f"{i},{10**9 + i * 10**9 // 30},{45 * i}")
    path.with_suffix(".csv").write_text("\n".join(rows) + "\n")
    return pf.Camera(
        **{"width": side, "height": side, "f_u": focal, "f_v": focal, "c_u": side / 2, "c_v": side / 2},
        **{"theta_max": 1.55, "circle_u": side / 2, "circle_v": side / 2, "circle_radius": circle},
    )


def test_what_begins_on_the_way_is_seen_in_three_keyframes(tmp_path: Path):
    camera = drive_through_a_tube(tmp_path / "survey.y4m", 110, 0.03)
    (tmp_path / "camera.bin").write_bytes(camera.to_binary())
    crawler = Crawler(tmp_path, keyframe__step_mm=0, survey__nominal_diameter_mm=300)
    store = Store(crawler.port)
    crawler.start("--set", f"camera.profile={tmp_path / 'camera.bin'}")
    assert receive_all(crawler, store) == 0
    seen = [set(np.cumsum(k.observations.id_delta).tolist()) for k in store.keyframes]
    assert len(seen) >= 12
    times = Counter(track for ids in seen for track in ids)
    on_the_way = set.union(*seen[2:-3]) - set.union(*seen[:2]) - set.union(*seen[-3:])
    assert len(on_the_way) > 100
    assert sum(times[track] < 3 for track in on_the_way) < 0.1 * len(on_the_way)  # a third, if a fixed way is left
