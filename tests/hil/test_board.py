"""pipefishd as it runs on a crawler: arm64, Debian's kernel, V4L2, USB serial, network, and everything that may break.

Each scenario ends with a whole survey at the host that equals, bit for bit in tracks and pictures, the host's replay of
the frames that the daemon says it took. Not proved: anything about a real sensor's timing, or about speed."""

from __future__ import annotations

import itertools
import time

import pytest
from crawl import Result
from usb_camera import ADDRESS, UsbCamera

LOOPBACK = "modprobe v4l2loopback devices=1 exclusive_caps=0 max_buffers=32"
RATE = 5
SERIAL = {"link__transport": "serial", "link__device": "/dev/ttyUSB0", "link__baud": "3000000"}
# v4l2loopback writes into buffers that are still in use, sooner the fewer there are.
SIZE = {"camera__device": "/dev/video0", "camera__width": "320", "camera__height": "240", "camera__buffers": "32"}


# The board's only port that the host reaches, TLS on it: the network of a real crawler.
TLS = {"link__transport": "tls", "link__address": "0.0.0.0", "link__port": "7448", "link__trust": "/data/trust"}


def usb(survey) -> str:
    return f"serial:{survey.board.usb.device}@3000000"


def frames(n: int):
    return lambda status: status.get("frames", 0) >= n


def begin(crawl, **settings: str):
    """A survey over USB serial that is waiting for its camera."""
    survey = crawl(**{**SERIAL, **SIZE, **settings})
    survey.board.run(LOOPBACK)
    survey.start_receiver(usb(survey))
    survey.start_daemon()
    survey.wait_for("begins")
    return survey


def end(survey, note, name: str, recovery_s: float | None = None, with_noise: bool = False) -> Result:
    row = Result(name, recovery_s=recovery_s)
    survey.measure(row, survey.daemon)
    survey.stop_daemon()
    result = survey.check(survey.finish(), row, with_noise)
    note(result)
    return result


def test_a_survey_from_v4l2_over_usb_serial_equals_its_replay(crawl, note):
    survey = begin(crawl)
    survey.board.wait(survey.show(0, 45, RATE, "/dev/video0"))
    result = end(survey, note, "survey over USB serial")
    assert result.frames_in >= 30 and result.keyframes_out >= 15


@pytest.mark.parametrize("pixels", ["YUYV", "NV12"])
def test_a_camera_of_another_pixel_format_gives_the_tracks_of_its_grey(crawl, note, pixels):
    survey = begin(crawl, camera__format=pixels)
    board = survey.board
    world = survey.show(0, 20, RATE, "/dev/video0", pixels)
    survey.wait_until(frames(3), "3 frames")
    assert f"'{pixels:4}'" in board.run("v4l2-ctl -d0 --get-fmt-video"), "another format than was asked for"
    board.wait(world)
    result = end(survey, note, f"camera that gives {pixels}")
    assert result.frames_in >= 12 and result.keyframes_out >= 6


def test_the_serial_adapter_unplugged_loses_nothing(crawl, note):
    survey = begin(crawl)
    world = survey.show(0, 45, RATE, "/dev/video0", on=True)
    survey.wait_until(frames(12), "12 frames")
    survey.board.usb.unplug()
    survey.wait_until(lambda s: not s["link"]["up"], "the link down")
    survey.wait_until(lambda s: s["spool"]["objects"] > 20, "20 keyframes for later")
    survey.hide(world)
    survey.board.usb.plug()
    recovery = survey.wait_until(lambda s: s["link"]["up"], "the link up again")
    end(survey, note, "serial adapter unplugged", recovery)


def test_a_16550_that_overruns_and_a_line_that_loses_bytes_lose_nothing(crawl, note):
    """The 16550 hears itself beside the host's noise until its FIFO has overflown and the kernel counted that: the
    daemon tells. All the time every 5,000th byte to the host is lost."""
    survey = crawl(**{**SERIAL, **SIZE, "link__device": "/dev/ttyS0", "link__baud": "115200"})
    board = survey.board
    board.uart.lose_every = 5000
    board.run(LOOPBACK)
    survey.start_receiver(f"serial:{board.uart.device}@115200")
    survey.start_daemon()
    survey.wait_for("begins")
    world = survey.show(0, 45, RATE, "/dev/video0", on=True)
    survey.wait_until(frames(12), "12 frames")
    overrun = board.spawn("exec /mnt/pipefish-world --overrun /dev/ttyS0", "overrun.log")
    while board.is_running(overrun):
        board.uart.flood(bytes(range(256)) * 64)
    survey.wait_for("bytes dropped so far before they could be read")
    survey.wait_until(frames(45), "45 frames")
    survey.hide(world)
    survey.wait_until(lambda s: s["link"]["overruns"] > 0, "overruns in the status")
    survey.wait_until(lambda s: s["link"]["crc_errors"] + s["link"]["malformed"] > 0, "damage in the status")
    survey.wait_until(lambda s: s["link"]["fragments_resent"] > 0, "fragments sent again")
    end(survey, note, "16550 overrun, bytes lost")
    assert int(survey.received.metadata["crc_errors_host"]) > 0


def begin_tls(crawl):
    """A survey over the network that is waiting for its camera, with a host that was let in."""
    survey = crawl(**{**TLS, **SIZE})
    survey.board.run(LOOPBACK)
    device = survey.pair()
    survey.start_daemon()
    survey.wait_for("begins")
    survey.start_receiver(device)
    survey.wait_until(lambda s: s.get("link", {}).get("up"), "the host let in")
    return survey


def test_a_killed_daemon_goes_on_with_its_survey_over_tls(crawl, note):
    survey = begin_tls(crawl)
    world = survey.show(0, 45, RATE, "/dev/video0", on=True)
    survey.wait_until(frames(20), "20 frames")
    survey.board.run(f"kill -9 {survey.daemon}")
    killed = time.monotonic()
    survey.start_daemon()
    survey.wait_for("goes on")
    survey.wait_until(frames(3), "frames again")
    recovery = time.monotonic() - killed
    survey.wait_until(lambda s: s["network"]["sessions"] >= 1, "the host let in again")
    survey.wait_until(frames(20), "20 frames again")
    survey.hide(world)
    network = survey.board.status()["network"]
    assert network["role"] == "operator" and network["refused_handshake"] == 0, network
    end(survey, note, "daemon killed, over TLS", recovery)
    assert len(survey.indices()) == 2


def test_a_power_cut_loses_nothing_that_was_acknowledged_over_tls(crawl, note):
    survey = begin_tls(crawl)
    survey.show(0, 25, RATE, "/dev/video0", on=True)
    survey.wait_until(lambda s: s.get("spool", {}).get("acknowledged", 0) >= 4, "acknowledged keyframes")
    survey.board.power_cut()
    start = time.monotonic()
    survey.board.power_on()
    survey.board.run(LOOPBACK)
    survey.start_daemon()
    survey.wait_for("goes on")
    world = survey.show(25, 20, RATE, "/dev/video0")
    survey.wait_until(frames(1), "frames again")
    recovery = time.monotonic() - start
    survey.board.wait(world)
    end(survey, note, "power cut, over TLS", recovery)
    assert len(survey.indices()) == 2


def show_beside_a_wheel(survey) -> int:
    """A world whose wheel is an input device, as the kernel's driver rotary-encoder makes: it is there when this
    returns, and all stands still until SIGUSR1."""
    world = survey.show(0, 45, RATE, "/dev/video0", encoder="--rotary /mnt/counts.txt", on=True)
    survey.board.run("until [ -e /dev/input/event0 ]; do sleep 0.1; done")
    return world


def test_a_network_that_goes_away_and_a_host_that_is_killed_lose_nothing(crawl, note):
    wheel = {"gpio__encoder": "auto", "encoder__metres_per_count": "0.0005", "keyframe__step_mm": "5"}
    survey = crawl(**SIZE, **wheel, link__transport="tcp")
    survey.board.run(f"{LOOPBACK}; modprobe uinput; modprobe evdev")
    world = show_beside_a_wheel(survey)
    survey.start_daemon()
    survey.wait_for("begins")
    survey.board.run(f"kill -USR1 {world}")
    # The daemon listens on loopback only: what an SSH tunnel is on a real crawler.
    forward = "exec nc -ll -p 7448 -e nc 127.0.0.1 7447"
    tunnel = survey.board.spawn(forward, "tunnel0.log")
    survey.start_receiver(f"tcp://127.0.0.1:{survey.board.port}")
    survey.wait_until(frames(12), "12 frames")
    survey.board.run(f"kill {tunnel}; killall nc", check=False)
    survey.wait_until(lambda s: not s["link"]["up"], "the link down")
    survey.board.spawn(forward, "tunnel1.log")
    recovery = survey.wait_until(lambda s: s["link"]["up"], "the link up again")
    survey.kill_receiver()
    survey.wait_until(frames(45), "45 frames")
    survey.hide(world)
    survey.start_receiver(f"tcp://127.0.0.1:{survey.board.port}")
    assert survey.board.status()["gpio"]["encoder"].startswith("/dev/input/")
    end(survey, note, "network lost, host killed", recovery)
    turned = dict(zip(survey.recording.order, survey.recording.counts, strict=True))
    read = [(k.encoder_count, turned[k.message.frame_sha256.hex()]) for k in survey.received.keyframes]
    # v4l2loopback may hand the first frame over late, stamped with that moment.
    assert all(got == made for got, made in read[1:]) and max(read)[0] > 300, read


def test_the_watchdog_resets_a_board_whose_daemon_hangs_and_no_other(crawl):
    watchdog = {"daemon__watchdog": "/dev/watchdog", "daemon__watchdog_s": "3", "daemon__drain_s": "0"}
    survey = crawl(**{**SERIAL, **SIZE, **watchdog})
    board = survey.board
    board.run(f"{LOOPBACK}; modprobe i6300esb")
    survey.start_daemon()
    survey.wait_for("begins")
    board.run("sleep 4")  # one that is well is let be
    survey.stop_daemon()
    board.wait(survey.daemon)
    board.run("sleep 4")  # so is a board whose daemon ended of itself
    survey.start_daemon()
    survey.wait_for("begins")
    board.run(f"kill -STOP {survey.daemon}")
    board.wait_for_reset(300)


GPIO = {
    "gpio__lamp": "LAMP",
    "gpio__led": "LED",
    "gpio__stop": "ESTOP",
    "gpio__limit_front": "!FRONT",
    "gpio__limit_rear": "!REAR",
    "gpio__encoder": "auto",
    "gpio__encoder_a": "ENC_A",
    "gpio__encoder_b": "ENC_B",
    "encoder__metres_per_count": "0.002",
    "keyframe__step_mm": "5",
}
LINES = ("ENC_A", "ENC_B", "LAMP", "ESTOP", "FRONT", "REAR", "LED")
CHIP = "/sys/kernel/config/gpio-sim/crawler"


def make_lines(board) -> str:
    """A chip of gpio-sim with the crawler's lines; the folder of their world side. The stop is a normally closed switch
    to ground: open, or its wire broken, it is high and means stop. The limit switch closes to ground."""
    chip = CHIP
    board.run("modprobe gpio-sim")
    names = "; ".join(f"mkdir {chip}/b/line{i}; echo {name} > {chip}/b/line{i}/name" for i, name in enumerate(LINES))
    board.run(f"mkdir {chip}; mkdir {chip}/b; echo {len(LINES)} > {chip}/b/num_lines; {names}; echo 1 > {chip}/live")
    name = board.run(f"echo $(cat {chip}/dev_name)/$(cat {chip}/b/chip_name)").strip()
    world = f"/sys/devices/platform/{name}"
    for name in ("FRONT", "REAR"):
        pull(board, world, name, "up")
    return world


def pull(board, world: str, name: str, way: str) -> None:
    board.run(f"echo pull-{way} > {world}/sim_gpio{LINES.index(name)}/pull")


def value_file(world: str, name: str) -> str:
    return f"{world}/sim_gpio{LINES.index(name)}/value"


def level(board, world: str, name: str) -> str:
    return board.run(f"cat {value_file(world, name)}").strip()


def levels(board, world: str, name: str) -> set[str]:
    """Those that a line has within some seconds, looked at after ever longer pauses: whatever a look takes, of one that
    blinks at five a second 5 of the 20 looks at least show either."""
    pauses = " ".join(f"0.{k:02}" for k in range(1, 21))
    return set(board.run(f"for i in {pauses}; do cat {value_file(world, name)}; sleep $i; done").split())


def test_encoder_lamp_and_stop_of_gpio_lines(crawl, note):
    survey = crawl(**{**SERIAL, **SIZE, **GPIO})
    board = survey.board
    board.run(LOOPBACK)
    world = make_lines(board)

    # A quarter of the wheel's edges: gpio-sim under emulation merges edges that are less than some milliseconds apart.
    counts = [count // 4 for count in survey.recording.counts]
    (board.share / "quarter.txt").write_text("".join(f"{count}\n" for count in counts))
    survey.start_receiver(usb(survey))
    survey.start_daemon()
    survey.wait_for("begins")
    assert level(board, world, "LAMP") == "1"
    encoder = f"--encoder {world}/sim_gpio0/pull {world}/sim_gpio1/pull /mnt/quarter.txt"
    process = survey.show(0, 45, RATE, "/dev/video0", encoder=encoder, on=True)
    survey.wait_until(frames(25), "25 frames")
    assert levels(board, world, "LED") == {"1"}, "on: a survey"
    pull(board, world, "FRONT", "down")
    survey.wait_for("front limit switch pressed")
    pull(board, world, "ESTOP", "up")
    start = time.monotonic()
    board.run(f"until [ $(cat {value_file(world, 'LAMP')}) = 0 ]; do sleep 0.01; done")
    recovery = time.monotonic() - start
    pull(board, world, "ESTOP", "down")
    survey.wait_until(lambda s: s["gpio"]["stop"], "the stop in the status")
    most = board.status()["frames"]
    survey.wait_until(frames(max(45, most + 15)), "a keyframe after the stop")
    survey.hide(process)
    status = survey.board.status()
    assert status["gpio"]["stop"] and status["gpio"]["limit_front"], "latched, though the button is released"
    assert level(board, world, "LAMP") == "0"
    assert status["gpio"]["encoder"] == "lines"
    assert (status["gpio"]["missed"], status["gpio"]["illegal"]) == (0, 0)
    # The lines are let go when the daemon has ended; its count is what the wheel was turned by.
    result = end(survey, note, "encoder, lamp, stop by GPIO", recovery)
    received = survey.received
    turned = dict(zip(survey.recording.order, counts, strict=True))
    read = [(k.encoder_count, turned[k.message.frame_sha256.hex()]) for k in received.keyframes]
    assert all(got == made for got, made in read), read
    assert max(read)[0] > 100
    assert received.keyframes[-1].telemetry["emergency_stop"]
    assert "emergency_stop" not in received.keyframes[0].telemetry
    assert received.keyframes[-1].telemetry["limit_front"] and "limit_front" not in received.keyframes[0].telemetry
    assert received.keyframes[0].telemetry["lamp"] == 1 and received.keyframes[-1].telemetry["lamp"] == 0
    assert result.keyframes_out > 10


def test_lost_edges_are_told_and_a_chip_that_vanishes_is_a_pressed_stop(crawl):
    """The wheel turns while the daemon stands still: the kernel keeps 1,024 edges and drops the older ones. Then the
    rear limit switch, and the chip with all lines goes, as that of an expander whose plug comes off."""
    lamp = {"gpio__lamp": "/mnt/lamp", "gpio__lamp_level": "0.5", "daemon__drain_s": "0"}
    survey = crawl(**{**SERIAL, **SIZE, **GPIO, **lamp})
    board = survey.board
    board.run(f"{LOOPBACK}; mkdir /mnt/lamp; echo 255 > /mnt/lamp/max_brightness; : > /mnt/lamp/brightness")
    world = make_lines(board)
    survey.start_daemon()
    survey.wait_for("begins")
    assert (board.share / "lamp/brightness").read_text() == "128"
    assert levels(board, world, "LED") == {"0", "1"}, "blinks: no camera"
    (board.share / "far.txt").write_text("0\n8\n1308\n")
    encoder = f"--encoder {world}/sim_gpio0/pull {world}/sim_gpio1/pull /mnt/far.txt"
    board.wait(survey.show(0, 2, 1, "/dev/video0", encoder=encoder))
    assert board.status()["gpio"]["missed"] == 0
    board.run(f"kill -STOP {survey.daemon}")
    board.wait(survey.show(2, 1, 1, "/dev/video0", encoder=encoder))
    board.run(f"kill -CONT {survey.daemon}")
    survey.wait_for("wheel encoder: ")
    survey.wait_until(lambda s: s["gpio"]["missed"] > 0, "lost edges in the status")
    gpio = survey.board.status()["gpio"]
    assert gpio["missed"] <= 1300 - 1024 and not gpio["stop"] and not gpio["broken"], gpio
    pull(board, world, "REAR", "down")
    survey.wait_for("rear limit switch pressed")
    assert not board.status()["gpio"]["limit_front"]
    board.run(f"echo 0 > {CHIP}/live")
    survey.wait_for("emergency stop: the lamp is off")
    survey.wait_for("a chip or device of [gpio] has gone")
    survey.wait_until(lambda s: s["gpio"]["stop"] and s["gpio"]["broken"], "stop and a broken chip in the status")
    assert (board.share / "lamp/brightness").read_text()[:1] == "0"
    assert board.is_running(survey.daemon)
    survey.stop_daemon()
    board.wait(survey.daemon)


VIVID = "modprobe vivid n_devs=1 node_types=0x101 num_inputs=1 input_types=0x3 num_outputs=1 output_types=0x1"
# A fatal error ends the output too, so that the camera sees noise from then on.
FAULTS = (
    "inject_v4l2_buf_flag_error",
    "inject_vidioc_qbuf_error",
    "percentage_of_dropped_buffers",
    "dv_timings_signal_mode",  # 1: no signal, and noise as long as that lasts
    "inject_fatal_streaming_error",
    "inject_vidioc_streamon_error inject_fatal_streaming_error",
    "inject_vidioc_reqbufs_error inject_vidioc_streamon_error inject_fatal_streaming_error",
    "wrap_sequence_number inject_fatal_streaming_error",  # the stream begins anew 128 frames before its number wraps
)


def plug_vivid(survey, first: int, count: int, rate: float, pixels: str = "GREY") -> int:
    """Plugs in a camera whose HDMI cable leads to what the world shows; the world's process.

    Its frames are 640 x 480; it shrinks them for us. It shows on and on, for after its output vivid shows noise. Its
    link appears when all is set, as udev's does."""
    timings = "; ".join(f"v4l2-ctl -d{d} --set-dv-bt-timings=cvt,width=640,height=480,fps=60" for d in (0, 1))
    survey.board.run(f"{VIVID}; v4l2-ctl -d0 -c osd_text_mode=2; {timings}")
    world = survey.show(first, count, rate, "/dev/video1", pixels, on=True)
    survey.board.run(f"until grep -q shows /mnt/world{first}.log; do sleep 0.1; done")
    survey.board.run("v4l2-ctl -d0 -c loop_video=1; sleep 0.5; ln -s /dev/video0 /run/camera")
    return world


def test_a_camera_with_faults_that_is_unplugged_goes_on(crawl, note):
    camera = {"camera__device": "/run/camera", "camera__buffers": "6", "camera__exposure": "device"}
    survey = crawl(**{**SERIAL, **SIZE, **camera}, tracker__reset_gap="100000", status__interval_ms="100")
    board = survey.board
    world = plug_vivid(survey, 0, 35, 1)
    survey.start_receiver(usb(survey))
    survey.start_daemon()
    survey.wait_for("begins")
    # What is shown before the faults that end in noise is what can be compared with a replay.
    survey.wait_until(lambda s: s.get("frames", 0) >= 10 and s["keyframes"] >= 6, "10 frames, 6 keyframes")
    for fault in FAULTS:
        before = board.status()["frames"]
        board.run("; ".join(f"v4l2-ctl -d0 -c {name}=1" for name in fault.split()))
        survey.wait_until(frames(before + (150 if "wrap" in fault else 5)), f"frames after {fault}")
        if "signal" in fault:
            board.run(f"v4l2-ctl -d0 -c {fault}=0")
    board.run("rm /run/camera; v4l2-ctl -d0 -c disconnect=1")
    survey.wait_for("no camera")
    board.run(f"kill -9 {world}", check=False)
    # The module can go only if nothing of the daemon's keeps the old camera open, held frames neither.
    board.run("until rmmod vivid; do sleep 0.1; done")
    before = board.status()["frames"]
    world = plug_vivid(survey, 35, 6, 1)
    recovery = survey.wait_until(frames(before + 1), "frames again")
    survey.hide(world)
    status = board.status()
    assert status["camera"]["damaged"] >= 1 and status["camera"]["restarts"] >= 1 and status["camera"]["reopens"] >= 1
    end(survey, note, "camera faults, unplugged", recovery, with_noise=True)
    numbers = [int(row["sequence"]) for _, rows in survey.indices() for row in rows]
    steps = [after - before for before, after in itertools.pairwise(numbers)]
    assert min(steps) > 0 and max(steps) < 10_000, "numbers that go on over the wrap, with gaps as long as the pauses"


@pytest.mark.parametrize("pixels", ["Y10", "Y12"])
def test_a_camera_of_more_than_eight_bits_gives_the_tracks_of_its_high_eight(crawl, note, pixels):
    """Through vivid: v4l2loopback 0.12 makes room for ten bits a pixel of Y10, where V4L2 has sixteen."""
    camera = {"camera__device": "/run/camera", "camera__buffers": "6", "camera__exposure": "device"}
    survey = crawl(**{**SERIAL, **SIZE, **camera}, camera__format=pixels)
    plug_vivid(survey, 0, 45, 3, pixels)
    survey.start_receiver(usb(survey))
    survey.start_daemon()
    survey.wait_for("begins")
    survey.wait_until(lambda s: s.get("frames", 0) >= 10 and s["keyframes"] >= 6, "10 frames, 6 keyframes")
    assert f"'{pixels:4}'" in survey.board.run("v4l2-ctl -d0 --get-fmt-video"), "another format than was asked for"
    result = end(survey, note, f"camera that gives {pixels}")
    assert result.keyframes_out >= 6
    pictures = {row["sha256"] for _, rows in survey.indices() for row in rows}
    assert len(pictures) >= 4, "one picture again and again"


VHCI = "/sys/devices/platform/vhci_hcd.0"


def plug_usb_camera(board, port: int) -> None:
    """Hands the camera's socket to the kernel, as usbip does: the shell that writes has it as its standard input."""
    script = f"#!/bin/sh\\necho 0 0 {ADDRESS} > {VHCI}/attach\\n"
    board.run(f"printf '{script}' > /run/attach; chmod +x /run/attach; nc 10.0.2.2 {port} -e /run/attach")


def announce_late(board, subsystem: str) -> None:
    """udev holds back what it announces of new devices of a subsystem: `media` or `video4linux`."""
    rule = f'ACTION=="add", SUBSYSTEM=="{subsystem}", PROGRAM="/bin/sleep 0.5"'
    board.run(f"mkdir -p /run/udev/rules.d; echo '{rule}' > /run/udev/rules.d/99-late.rules; udevadm control --reload")


def see_vimc(survey, daemon: str, name: str, least: int, tracks: int) -> None:
    """The kernel's virtual camera, whose pipeline libcamera puts together: a test pattern in colours. `least` frames
    come, and more than `tracks` tracks."""
    board = survey.board
    vimc = "camera.driver=libcamera camera.device=vimc camera.width=318 camera.height=240"
    extra = f"spool.path=/run/{name}.db daemon.status_file=/run/status.json status.interval_ms=100 daemon.drain_s=0"
    flags = " ".join(f"--set {setting}" for setting in f"{vimc} {extra}".split())
    process = board.spawn(f": > /run/vimc.ini; exec {daemon} --config /run/vimc.ini {flags}", f"{name}.log")
    has_come = frames(least)
    survey.wait_until(lambda s: has_come(s) and s["tracks_live"] > tracks, f"tracks of vimc through {name}")
    assert board.status()["camera"]["bad_stamps"] == 0
    assert name.replace("-", " v") in (board.share / f"{name}.log").read_text(), "another libcamera than it should be"
    board.run(f"kill {process}")
    board.wait(process)
    board.run("rm /run/status.json")  # now: at its end a daemon writes it once more


def test_cameras_of_libcamera_are_unplugged_and_stall(crawl, note):
    camera = {"camera__driver": "libcamera", "camera__exposure": "device", "tracker__reset_gap": "100000"}
    size = {"camera__width": "320", "camera__height": "240", "camera__device": "1209:0001"}
    survey = crawl(**{**SERIAL, **size, **camera}, status__interval_ms="100")
    board = survey.board
    board.run("/lib/systemd/systemd-udevd --daemon 2>/dev/null; modprobe vimc; modprobe vhci-hcd; modprobe uvcvideo")
    board.run("modprobe vhci-node; udevadm trigger -s media -s video4linux; udevadm settle")
    see_vimc(survey, "/mnt/pipefishd", "libcamera-0.0.3", 10, 20)
    if board.bring_newer_libcamera():
        # It has the kernel draw 1920 x 1080 and scale that: seconds a frame here, so that the stream counts as stalled
        # and is started anew after each.
        see_vimc(survey, "sh /mnt/newer/run", "libcamera-0.3", 1, 0)
    # A USB camera, plugged in after the daemon has started, unplugged, and silent for longer than a stream may be.
    pixels = [survey.recording.frames[name] for name in survey.recording.order]
    usb_camera = UsbCamera(pixels, 320, 240, 30)
    try:
        survey.start_receiver(usb(survey))
        survey.start_daemon()
        survey.wait_for("begins")
        usb_camera.play(RATE)
        # Its two nodes are announced in this order and then in the other: that is the case libcamera itself falls over.
        announce_late(board, "video4linux")
        plug_usb_camera(board, usb_camera.port)
        survey.wait_until(frames(8), "8 frames")
        board.run(f"echo 0 > {VHCI}/detach")
        survey.wait_for("has gone")  # not the one that was not there yet
        before = board.status()["frames"]
        announce_late(board, "media")
        plug_usb_camera(board, usb_camera.port)
        survey.wait_until(frames(before + 4), "frames after it was plugged in again")
        usb_camera.hush()
        before = board.status()["camera"]["restarts"]
        survey.wait_until(lambda s: s["camera"]["restarts"] > before, "a restart of the silent stream")
        before = board.status()["frames"]
        start = time.monotonic()
        usb_camera.play(RATE)
        survey.wait_until(frames(before + 4), "frames again")
        recovery = time.monotonic() - start
        usb_camera.hush()
        result = end(survey, note, "libcamera: unplugged, stalled", recovery)
    finally:
        usb_camera.close()
    # The camera's clock is the host's: a board that is emulated slowly drops frames, and counts them.
    assert result.frames_in > 8 and result.keyframes_out > 4
