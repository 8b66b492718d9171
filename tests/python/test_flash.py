"""Profiles on a device: pipefishd's own store, `pipefish flash`, and what power cuts and bad profiles do to it."""

import dataclasses
import hashlib
import json
import os
import random
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import pipefish as pf
from crawler import (
    HEIGHT,
    PATIENCE_S,
    SEED,
    WIDTH,
    Crawler,
    Store,
    mounted,
    run,
    serve,
    wait_for_log,
    wait_for_status,
    write_recording,
)
from pipefish import cli
from pipefish import pipefish_pb2 as pb
from pipefish.errors import PipefishError
from pipefish.flash import Flasher
from pipefish.transport import TcpTransport
from spec_reader import crc32c


def camera(name: str, **changes: object) -> pf.Camera:
    cam = pf.Camera(width=WIDTH, height=HEIGHT, f_u=60, f_v=60, c_u=96, c_v=80, theta_max=1.5, name=name, serial="S1")
    return dataclasses.replace(cam, **changes)


PATIENT = ("--timeout", str(PATIENCE_S))
OLD, NEW = camera("old"), camera("new", f_u=61)


@pytest.fixture
def crawler(tmp_path: Path) -> Iterator[Crawler]:
    """A daemon with a profile store that does not exist yet, and a short survey behind it."""
    write_recording(tmp_path / "survey.y4m", 4)
    crawler = Crawler(
        tmp_path, camera__profile_store=tmp_path / "profiles.store", daemon__exit_when_done="false", daemon__drain_s=0
    )
    crawler.store = tmp_path / "profiles.store"
    yield crawler
    if crawler.process is not None:
        crawler.kill()


def device(crawler: Crawler) -> Flasher:
    wait_for_log(crawler, "; survey ")
    return Flasher(TcpTransport("127.0.0.1", crawler.port), PATIENCE_S)


def restart(crawler: Crawler) -> pb.ProfileState:
    """kill -9 and a new start; what the device then uses and has stored."""
    if crawler.process is not None:
        crawler.kill()
    crawler.log.unlink(missing_ok=True)
    crawler.status_file.unlink(missing_ok=True)
    crawler.start()
    with device(crawler) as flasher:
        return flasher.state()


def flash(crawler: Crawler, capsys, *arguments: object) -> dict:
    """`pipefish flash ... --json`."""
    code = cli.main(["flash", f"tcp://127.0.0.1:{crawler.port}", *map(str, arguments), *PATIENT, "--json"])
    out, err = capsys.readouterr()
    assert code == 0, err
    return json.loads(out)


def install(crawler: Crawler, cam: pf.Camera) -> pb.ProfileState:
    """Sends a profile, restarts the device with it and confirms it; what the device then says."""
    with device(crawler) as flasher:
        flasher.send(cam.to_binary())
    sha256 = restart(crawler).stored.sha256
    with device(crawler) as flasher:
        return flasher.confirm(sha256)


def name_of(profile: pb.Profile | dict | None) -> str | None:
    name = profile.get("name") if isinstance(profile, dict) else profile and profile.name
    return name or None


def test_a_flashed_profile_is_used_from_the_next_start_on(tmp_path: Path, crawler: Crawler, capsys):
    assert name_of(restart(crawler).in_use) is None
    OLD.save(tmp_path / "old.json")
    document = flash(crawler, capsys, tmp_path / "old.json")
    assert document["in_use"] is None and document["stored"]["name"] == "old" and document["stored"]["trial"]
    assert document["stored"]["sha256"] == hashlib.sha256(OLD.to_binary()).hexdigest()
    assert sum(document["slot_erases"]) == 1
    state = restart(crawler)
    assert (state.in_use.name, state.in_use.serial, state.in_use.trial) == ("old", "S1", True)
    flash(crawler, capsys, "--confirm")
    with device(crawler) as flasher:
        state = flasher.state()
    assert not state.in_use.trial and not state.stored.trial
    assert state.in_use.crc32c == int.from_bytes(OLD.to_binary()[-4:], "little")
    store = Store(crawler.port)
    with store.client(crawler) as client:
        serve(crawler, client, lambda: any(s.profile for s in store.starts) and store.statuses)
        status = client.answer_to(PATIENCE_S, get_status=pb.Nothing()).status
    assert OLD.to_binary() in [s.profile for s in store.starts]
    assert status.profile == state.in_use == store.statuses[-1].profile
    assert wait_for_status(crawler, lambda s: s["profile"])["profile"]["sha256"] == status.profile.sha256.hex()
    assert cli.main(["status", f"tcp://127.0.0.1:{crawler.port}", *PATIENT]) == 0
    assert "old, serial S1" in capsys.readouterr().out


def test_a_store_that_cannot_be_written_gives_the_profile_that_is_confirmed(tmp_path: Path, crawler: Crawler):
    """Its medium is mounted read-only, as after an error: the survey goes on. What is on trial could not be counted."""
    with mounted(tmp_path / "medium", "size=1m") as medium:
        crawler.config.write_text(crawler.config.read_text().replace(str(crawler.store), str(medium / "store")))
        restart(crawler)
        install(crawler, OLD)
        with device(crawler) as flasher:
            flasher.send(NEW.to_binary())
        crawler.kill()
        subprocess.run(["mount", "-o", "remount,ro", medium], check=True)
        assert run("--config", crawler.config, "--check-config").returncode == 0
        state = restart(crawler)
        assert (name_of(state.in_use), state.in_use.trial, name_of(state.stored)) == ("old", False, "old")
        assert state.problem == "the store cannot be written"
        with device(crawler) as flasher, pytest.raises(PipefishError, match="cannot be written"):
            flasher.send(NEW.to_binary())
        crawler.kill()
        subprocess.run(["mount", "-o", "remount,rw", medium], check=True)
        assert name_of(restart(crawler).in_use) == "new", "it was not tried meanwhile"
        crawler.kill()


def test_the_log_names_a_profile_with_and_without_a_serial_number(crawler: Crawler):
    restart(crawler)
    install(crawler, OLD)
    with device(crawler) as flasher:
        flasher.send(camera("nameplate lost", serial="").to_binary())
    wait_for_log(crawler, "profile nameplate lost: stored, on trial")
    assert "profile old, serial S1" in crawler.text()


def test_a_profile_on_trial_reverts_unless_it_is_confirmed(tmp_path: Path, crawler: Crawler, capsys):
    restart(crawler)
    install(crawler, OLD)
    NEW.save(tmp_path / "new.json")
    document = flash(crawler, capsys, tmp_path / "new.json")
    assert document["stored"]["trial"] and document["stored"]["starts_left"] == 1
    state = restart(crawler)  # one start on trial: camera.trial_starts
    assert state.in_use.name == "new" and state.in_use.trial and state.in_use.starts_left == 0
    address = f"tcp://127.0.0.1:{crawler.port}"
    assert cli.main(["flash", address, *PATIENT]) == 0  # tells, changes nothing
    text = capsys.readouterr().out
    assert text.count("on trial, 0 more starts") == 2 and f"if it is good: pipefish flash {address} --confirm" in text
    assert restart(crawler).in_use.name == "old"

    flash(crawler, capsys, tmp_path / "new.json")
    assert cli.main(["flash", f"tcp://127.0.0.1:{crawler.port}", "--confirm", *PATIENT]) == 1
    assert "not in use yet: restart the device" in capsys.readouterr().err
    restart(crawler)
    document = flash(crawler, capsys, "--confirm")
    assert document["stored"]["name"] == document["in_use"]["name"] == "new" and not document["in_use"]["trial"]
    for _ in range(2):
        assert restart(crawler).in_use.name == "new"
    assert flash(crawler, capsys, "--revert")["stored"]["name"] == "old"
    assert restart(crawler).in_use.name == "old"


def test_flash_says_what_to_do_next_and_a_trial_can_be_dropped(tmp_path: Path, crawler: Crawler, capsys):
    restart(crawler)
    install(crawler, OLD)
    NEW.save(tmp_path / "new.json")
    address = f"tcp://127.0.0.1:{crawler.port}"
    assert cli.main(["flash", address, str(tmp_path / "new.json"), *PATIENT]) == 0
    assert f"restart the device, then: pipefish flash {address} --confirm" in capsys.readouterr().out
    assert name_of(flash(crawler, capsys, "--revert")["stored"]) == "old"
    flash(crawler, capsys, tmp_path / "new.json")
    done = run("--config", crawler.config, "--check-config", "--set", "camera.trial_starts=5")
    assert done.returncode == 1 and "camera.trial_starts" in done.stderr  # the service gives up after five


def test_a_lens_beyond_fixed_point_is_refused_when_it_is_flashed(crawler: Crawler):
    restart(crawler)
    install(crawler, OLD)
    steep = camera("steep", theta_max=1.57, radial="perspective")
    with device(crawler) as flasher, pytest.raises(PipefishError, match="cannot build it in fixed point"):
        flasher.send(steep.to_binary())
    assert restart(crawler).in_use.name == "old"


def test_a_stored_profile_that_the_pipeline_cannot_use_does_not_end_the_daemon(crawler: Crawler):
    """An image circle that no tracker can work with passes every check of the profile by itself."""
    far = camera("far", circle_u=20000.0, circle_v=0.0, circle_radius=10.0)
    restart(crawler)
    with device(crawler) as flasher:
        flasher.send(far.to_binary())
    state = restart(crawler)  # without one before: it runs on with none
    assert not state.HasField("in_use") and "image circle" in state.problem
    install(crawler, OLD)
    with device(crawler) as flasher:
        flasher.send(far.to_binary())
    for _ in range(2):
        state = restart(crawler)
        assert state.in_use.name == "old" and not state.in_use.trial
    with device(crawler) as flasher:  # confirmed with a circle of its own settings, then used without
        flasher.send(far.to_binary())
    circle = ("--set", "tracker.circle_radius=70", "--set", "tracker.circle_u=96", "--set", "tracker.circle_v=80")
    crawler.kill()
    crawler.log.unlink()
    crawler.start(*circle)
    with device(crawler) as flasher:
        assert not flasher.confirm(flasher.state().in_use.sha256).in_use.trial
    state = restart(crawler)
    assert not state.HasField("in_use") and "image circle" in state.problem
    assert "image circle" in wait_for_status(crawler, lambda s: s["profile_problem"])["profile_problem"]
    assert install(crawler, NEW).in_use.name == "new"


def test_the_device_refuses_what_is_no_profile_for_it_and_says_why(crawler: Crawler):
    restart(crawler)
    changed = bytearray(NEW.to_binary())
    pixel = len(changed) - 4 - 28 * 8 - 64 + 24  # of the last vector; then an intact checksum
    changed[pixel] ^= 0xFF
    changed[pixel + 2] ^= 0xFF
    changed[pixel + 5] ^= 0x01
    changed[-4:] = crc32c(bytes(changed[:-4])).to_bytes(4, "little")
    integers = bytearray(NEW.to_binary())
    integers[-4 - 28 + 8] ^= 1  # one bit of the last ray
    integers[-4:] = crc32c(bytes(integers[:-4])).to_bytes(4, "little")
    damaged = bytearray(NEW.to_binary())
    damaged[300] ^= 1
    install(crawler, OLD)
    with device(crawler) as flasher:
        for data, why in (
            (bytes(changed), "self_test: this device does not"),
            (bytes(integers), "self_test: the fixed-point camera of this device"),
            (bytes(damaged), "checksum: the profile is damaged"),
            (camera("big", width=640).to_binary(), f"is for 640 x {HEIGHT}, the camera gives {WIDTH} x {HEIGHT}"),
            (b"JSON", "magic: this is not a profile"),
        ):
            with pytest.raises(PipefishError, match="the device refuses the profile: .*" + why):
                flasher.send(data)
        with pytest.raises(PipefishError, match="another profile is stored"):
            flasher.confirm(hashlib.sha256(NEW.to_binary()).digest())
        with pytest.raises(PipefishError, match="no profile to go back to"):
            flasher.revert()
        assert flasher.state().stored.name == "old"
    assert restart(crawler).in_use.name == "old"


def test_a_device_without_a_store_says_so(tmp_path: Path, crawler: Crawler, capsys):
    crawler.start("--set", "camera.profile_store=")
    wait_for_log(crawler, "; survey ")
    NEW.save(tmp_path / "new.json")
    assert cli.main(["flash", f"tcp://127.0.0.1:{crawler.port}", str(tmp_path / "new.json"), *PATIENT]) == 1
    assert "camera.profile_store is not set" in capsys.readouterr().err
    done = run("--config", crawler.config, "--check-config", "--set", "camera.profile=x")
    assert done.returncode == 1 and "camera.profile_store: not together with camera.profile" in done.stderr


def test_flash_arguments_that_do_not_go_together_are_wrong_usage(capsys):
    for arguments in (["a.json", "--confirm"], ["a.json", "--revert"], ["--confirm", "--revert"]):
        assert cli.main(["flash", "tcp://127.0.0.1:1", *arguments]) == 2
        assert "flash: " in capsys.readouterr().err


def flip(path: Path, at: int) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        byte = file.read(1)[0]
        file.seek(at)
        file.write(bytes([byte ^ 1]))


def test_check_config_finds_a_stored_profile_of_another_size(tmp_path: Path, crawler: Crawler):
    restart(crawler)
    install(crawler, OLD)
    crawler.kill()
    (tmp_path / "other.y4m").write_bytes(b"YUV4MPEG2 W64 H32 F25:1 Ip A1:1 Cmono\nFRAME\n" + bytes(64 * 32))
    size = f"{OLD.width} x {OLD.height}"
    for settings, given in [
        ((f"camera.path={tmp_path}/other.y4m",), "64 x 32"),
        (("camera.driver=v4l2", "gpio.encoder=auto", "camera.width=1280", "camera.height=800"), "1280 x 800"),
    ]:
        pairs = (pair for setting in settings for pair in ("--set", setting))
        done = run("--config", crawler.config, "--check-config", *pairs)
        assert done.returncode == 1
        assert f"camera.profile_store: the stored profile is for {size}, the camera gives {given}" in done.stderr
    live = ("--set", "camera.driver=v4l2", "--set", "gpio.encoder=auto")  # whose size nobody knows before it is there
    assert run("--config", crawler.config, "--check-config", *live).returncode == 0


def test_a_damaged_store_is_told_and_can_be_written_again(tmp_path: Path, crawler: Crawler):
    assert run("--config", crawler.config, "--check-config").returncode == 0 and not crawler.store.exists()
    restart(crawler)
    install(crawler, OLD)
    assert run("--config", crawler.config, "--check-config").returncode == 0
    crawler.kill()
    flip(crawler.store, 2 * 16384 + 200)  # in slot A
    done = run("--config", crawler.config, "--check-config")
    assert done.returncode == 1 and "the stored profile is damaged" in done.stderr
    state = restart(crawler)  # it runs, for the host must be able to send another one
    assert not state.HasField("in_use") and "damaged" in state.problem
    install(crawler, NEW)
    crawler.kill()
    for log in (0, 16384):
        flip(crawler.store, log + 100)  # behind the record: does no harm
    assert restart(crawler).in_use.name == "new"

    done = run("--config", crawler.config, "--set", "spool.path=" + str(tmp_path / "other.db"))
    assert done.returncode == 1 and "another process has it open" in done.stderr
    crawler.kill()
    crawler.process = None
    crawler.store.write_bytes(b"nonsense")
    done = run("--config", crawler.config)
    assert done.returncode == 1 and "not a profile store" in done.stderr


def test_a_profile_of_another_frame_size_does_not_keep_the_device_from_starting(tmp_path: Path, crawler: Crawler):
    restart(crawler)
    install(crawler, OLD)
    with device(crawler) as flasher:
        flasher.send(NEW.to_binary())
    crawler.kill()
    narrow = bytearray()  # the camera now gives frames of half the height
    for chunk in (tmp_path / "survey.y4m").read_bytes().split(b"FRAME\n"):
        narrow += (
            chunk.replace(f"H{HEIGHT}".encode(), f"H{HEIGHT // 2}".encode())
            if not narrow
            else (b"FRAME\n" + chunk[: WIDTH * HEIGHT // 2])
        )
    (tmp_path / "survey.y4m").write_bytes(narrow)
    state = restart(crawler)
    assert not state.HasField("in_use") and f"the camera gives {WIDTH} x {HEIGHT // 2}" in state.problem
    install(crawler, camera("fitting", height=HEIGHT // 2))
    assert restart(crawler).in_use.name == "fitting"


def test_sending_goes_on_after_the_device_was_killed(crawler: Crawler):
    """Nothing was stored when power failed; the same send ends well after the device is back."""
    crawler.start("--set", "link.port=" + str(crawler.port))
    with device(crawler) as flasher:
        flasher.state()
        crawler.process.send_signal(signal.SIGSTOP)  # it takes no profile any more
        os.waitid(os.P_PID, crawler.process.pid, os.WSTOPPED)
        result: list[pb.ProfileState | Exception] = []

        def send() -> None:
            try:
                flasher._client.link.send_object(hashlib.sha256(NEW.to_binary()).digest(), 4, NEW.to_binary())
                flasher._client.run(lambda: flasher._delivery.stored is not None, PATIENCE_S)
                result.append(flasher.state())
            except PipefishError as error:
                result.append(error)

        thread = threading.Thread(target=send)
        thread.start()
        time.sleep(0.2)
        crawler.kill()
        crawler.start()
        thread.join(2 * PATIENCE_S)
        assert isinstance(result[0], pb.ProfileState) and result[0].stored.name == "new", result


def test_kill_at_any_moment_of_flashing_leaves_the_old_profile_or_the_new_one(crawler: Crawler):
    """kill -9 while a profile is on its way, being written, or being confirmed; and it can be flashed again."""
    rng = random.Random(SEED)
    restart(crawler)
    install(crawler, OLD)
    stored, seen, rounds = OLD, set(), 8

    def cut(what: str, act) -> pb.ProfileState:
        with device(crawler) as flasher:
            is_last = round_ == rounds - 1
            killer = threading.Timer(rng.uniform(0.0, 0.12), crawler.process.kill)
            if not is_last:  # else it dies when all is done
                flasher._timeout_s = 0.3
                killer.start()
            if round_ == 0:  # before the device hears of it
                killer.join()
            try:
                act(flasher)
                seen.add(what)
            except PipefishError:
                seen.add("cut")
            if is_last:
                crawler.process.kill()
        crawler.process.wait()
        return restart(crawler)

    for round_ in range(rounds):
        wanted = camera(f"round {round_}", f_u=70 + round_)
        allowed = {hashlib.sha256(cam.to_binary()).digest(): cam for cam in (stored, wanted)}
        state = cut("sent", lambda flasher, wanted=wanted: flasher.send(wanted.to_binary()))
        assert state.in_use.sha256 in allowed, (round_, state)
        state = cut("confirmed", lambda flasher, state=state: flasher.confirm(state.in_use.sha256))
        assert state.in_use.sha256 in allowed and not state.in_use.trial, (round_, state)
        stored = camera(f"after {round_}", f_u=90 + round_)
        install(crawler, stored)
    assert seen == {"sent", "confirmed", "cut"}
    assert restart(crawler).in_use.name == stored.name
