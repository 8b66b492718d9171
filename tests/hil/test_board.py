"""pipefishd as it runs on a crawler: arm64, Debian's kernel, V4L2, USB serial, network, and everything that may break.

Each scenario ends with a whole survey at the host that equals, bit for bit in tracks and pictures, the host's replay of
the frames that the daemon says it took. Not proved: anything about a real sensor's timing, or about speed."""

from __future__ import annotations

from crawl import Result

LOOPBACK = "modprobe v4l2loopback devices=1 exclusive_caps=0 max_buffers=8"
RATE = 8
SERIAL = {"link__transport": "serial", "link__device": "/dev/ttyUSB0", "link__baud": "3000000"}
SIZE = {"camera__device": "/dev/video0", "camera__width": "320", "camera__height": "240"}


def usb(survey) -> str:
    return f"serial:{survey.board.usb.device}@3000000"


def test_a_survey_from_v4l2_over_usb_serial_equals_its_replay(crawl, note):
    survey = crawl(**SERIAL, **SIZE)
    survey.board.run(LOOPBACK)
    survey.start_receiver(usb(survey))
    survey.start_daemon()
    survey.wait_for("begins")
    world = survey.show(0, 60, RATE, "/dev/video0")
    survey.board.wait(world)
    survey.stop_daemon()
    received = survey.finish()
    result = survey.check(received, Result("survey over USB serial", boot_s=survey.board.boot_s))
    note(result)
    assert result.frames_in >= 55 and result.keyframes_out >= 20
