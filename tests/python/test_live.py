"""`pipefish receive --live`: measured while it arrives, told in plain lines, and the file is as without it.

How exact a measurement is, is the subject of test_reconstruct.py; here its newest stretch only has to be right."""

from __future__ import annotations

import dataclasses
import json
import queue
import re
from pathlib import Path

import numpy as np
import pytest

import pipefish as pf
from device import Device
from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.live import Course, Live, progress_text, summary_rows
from pipefish.measure import measure
from pipefish.measured_files import summary as summary_of
from pipefish.receive import Interrupted, receive
from pipefish.survey import Survey
from pipefish.surveywrite import OBJECT_KEYFRAME
from pipefish.transport import open_transport
from synthetic import SURVEY, Object, as_object, write_survey
from test_reconstruct_cli import objects_of
from tube_tracks import Drive, tube_drive


@pytest.fixture(scope="module")
def drive() -> Drive:
    """2.5 m of DN300, 3 % oval, 51 keyframes."""
    return tube_drive(4, 2.5, density=500.0)


@pytest.fixture(scope="module")
def objects(drive) -> list[Object]:
    return objects_of(drive)


def changed(objects: list[Object], index: int, change) -> list[Object]:
    """The objects with one keyframe changed."""
    out = list(objects)
    at = next(i for i, (_, k, d) in enumerate(out) if k == OBJECT_KEYFRAME and pb.Keyframe.FromString(d).index == index)
    message = pb.Keyframe.FromString(out[at][2])
    change(message)
    out[at] = as_object(OBJECT_KEYFRAME, message)
    return out


def fed(objects: list[Object], path: Path) -> tuple[Course, list[str]]:
    """All objects through the measuring part, without processes; and its warnings."""
    course, told = Course(path), []
    for _, kind, data in objects:
        told += course.take(kind, data)
        if course.due():
            told += course.measure()
    while course.due(over=True):
        told += course.measure()
    return course, told


def test_the_newest_stretch_is_measured_as_it_arrives(objects, tmp_path):
    course, told = fed(objects, tmp_path / "a.mcap")
    assert not told
    summary = course.summary()
    assert summary["d_mean"] == pytest.approx(0.3, rel=0.005)
    assert 0.0 < summary["from"] < 0.3 and summary["to"] > 2.3 and summary["stations"] > 25
    assert summary["ovality_most"] == pytest.approx(0.03, abs=0.006)
    text, newest = progress_text(course.progress()), course.progress()["newest"]
    half = 1960 * np.hypot(newest["d_mean_sigma"], newest["systematic"])
    assert text.startswith("2.50 m: diameter ") and f" ± {half:.1f} mm at" in text and "oval " in text
    rows = dict(summary_rows(summary))
    own, shared = 1960 * summary["d_mean_sigma_most"], 1960 * summary["systematic"]
    told = f" ± {own:.1f} (repeatability, at most) ± {shared:.1f} (systematic: scale and camera)"
    assert rows["warnings"] == "none" and told in rows["mean diameter"] and "along the pipe" in rows
    assert rows["intervals"] == "every ± is a 95 % interval"


def test_what_is_said_of_the_mean_holds_for_what_is_measured_of_the_whole(drive, objects, tmp_path):
    """Other windows and another mean: the bound of its repeatability is one for the whole survey's, too."""
    course, _ = fed(objects, tmp_path / "a.mcap")
    write_survey(tmp_path / "a.mcap", objects=objects)
    live, whole = course.summary(), summary_of(measure(Survey.open(tmp_path / "a.mcap")))
    assert live["d_mean_sigma_most"] >= whole["d_mean_sigma"]
    apart = np.hypot(live["d_mean_sigma_most"], whole["d_mean_sigma"])
    assert abs(live["d_mean"] - whole["d_mean"]) < 2 * apart


def test_without_an_encoder_places_are_where_the_pictures_say(drive, tmp_path):
    """Each window's own path begins at 0: what windows have in common carries it on. In mean diameters."""
    course, _ = fed(objects_of(drive, encoder=False), tmp_path / "a.mcap")
    summary = course.summary()
    assert summary["unit"] == "diameter"
    assert course.driven[50] - course.driven[0] == pytest.approx(drive.driven[50] / 0.3, rel=0.02)
    assert summary["from"] < 1 and 7.7 < summary["to"] < 9 and 30 < summary["stations"] < 36
    assert np.diff([course.places[k]["at"] for k in sorted(course.places)]).min() > 0
    newest = course.progress()["newest"]["at"]
    assert newest == pytest.approx(summary["to"])


def test_a_place_has_one_number_however_far_it_is():
    """Two windows at 100 m whose mean diameters differ by 0.3 %, a whole place there."""
    course, at = Course(Path("a.mcap")), 100 + 0.075 * np.arange(20)
    for diameter, middle in ((0.3, 100.0), (0.301, 101.425)):
        values = np.full(len(at), diameter)
        names = ("d_mean", "d_mean_sigma", "d_max", "d_min", "ovality", "d_mean_systematic")
        course._keep({"chainage": at} | dict.fromkeys(names, values), middle)
    places = [course.places[k] for k in sorted(course.places)]
    assert [p["at"] for p in places] == at.tolist()
    assert [p["d_mean"] for p in places] == [0.3] * 10 + [0.301] * 10, "of the window nearer to its middle"


def test_a_window_that_fails_does_not_end_the_measurement(objects, tmp_path, monkeypatch):
    """Whatever goes wrong in one: it is told, and the rest is measured."""
    measured, calls = Course._measure, []

    def fails_once(self: Course, indices: list[int]) -> list[str]:
        calls.append(indices)
        if len(calls) == 2:
            raise ValueError("a number")
        return measured(self, indices)

    monkeypatch.setattr(Course, "_measure", fails_once)
    course, told = fed(objects, tmp_path / "a.mcap")
    assert [t for t in told if "not measured" in t] == ["1.00 m: not measured: internal error (ValueError: a number)"]
    assert len(calls) > 3 and course.summary()["to"] > 2.3 and not course.progress()["why"]


def test_slip_darkness_and_a_break_are_told_once_and_where(objects, tmp_path):
    def slip(m: pb.Keyframe) -> None:
        m.telemetry.encoder_count += 60  # 30 mm that the camera did not go

    def dark(m: pb.Keyframe) -> None:
        m.tracking.dark = True

    slipped = objects
    for index in range(30, 51):
        slipped = changed(slipped, index, slip)
    for index in (10, 11, 12):
        slipped = changed(slipped, index, dark)
    _, told = fed(slipped, tmp_path / "a.mcap")
    assert [t for t in told if "dark (lamp out?)" in t] == ["0.50 m: dark (lamp out?)"]
    (at,) = [float(t.split(" m:")[0]) for t in told if "slip" in t]
    assert at == pytest.approx(1.53, abs=0.06)


def test_after_the_lens_zoomed_nothing_is_measured(drive, tmp_path):
    """A window that begins behind the zoom does not know of it: its numbers would be wrong in silence."""
    t, middle = drive.tracks, np.array([drive.camera.c_u, drive.camera.c_v])
    pixels = np.where((t.frame > 24)[:, None], middle + 1.2 * (t.pixels - middle), t.pixels)
    zoomed = dataclasses.replace(drive, tracks=pf.Tracks(t.frame, t.track, pixels))
    course, told = fed(objects_of(zoomed), tmp_path / "a.mcap")
    (at,) = [float(line.split(" m:")[0]) for line in told if "the lens zoomed" in line]
    assert at == pytest.approx(1.2, abs=0.11)  # keyframe 24
    assert course.summary()["to"] < 1.6 and course.summary()["d_mean"] == pytest.approx(0.3, rel=0.005)
    assert "the lens zoomed" in course.progress()["why"]


def test_a_survey_that_shows_nothing_says_why(drive, tmp_path):
    random = np.random.default_rng(0)
    sparse = objects_of(drive, keep=random.uniform(size=len(drive.tracks.frame)) < 0.03)
    course, told = fed(sparse, tmp_path / "a.mcap")
    assert any("not measured: nothing could be measured" in t for t in told) and len(told) < 4
    assert "nothing" in dict(summary_rows(course.summary()))["measured live"]


def test_a_survey_without_a_profile_is_told_which_command_takes_one(objects, tmp_path):
    """`receive` has no --profile: whoever reads this must not look for it there."""
    start = pb.SurveyStart.FromString(objects[0][2])
    start.ClearField("profile")
    course, _ = fed([as_object(objects[0][1], start), *objects[1:]], tmp_path / "a.mcap")
    assert "no camera profile: pipefish reconstruct --profile takes one" in progress_text(course.progress())


def test_the_file_is_the_one_that_arrives_without(objects, tmp_path, capfd):
    """The same objects, which may overtake each other; plain lines where there is no terminal; a summary."""
    with Device(objects, SURVEY) as device:
        summary = receive(open_transport(device.address), tmp_path / "a.mcap", timeout_s=60, live=True)
    lines = capfd.readouterr().err.splitlines()
    assert summary["live"]["d_mean"] == pytest.approx(0.3, rel=0.005)
    assert lines and all(re.search(": diameter |not(hing to)? measured? yet", line) for line in lines)
    with Device(objects, SURVEY) as device:
        receive(open_transport(device.address), tmp_path / "b.mcap", timeout_s=60, quiet=True)
    a, b = (Survey.open(tmp_path / name) for name in ("a.mcap", "b.mcap"))
    assert sorted(r.sha256 for r in a.receipts) == sorted(r.sha256 for r in b.receipts)
    assert [k.message.SerializeToString() for k in a.keyframes] == [k.message.SerializeToString() for k in b.keyframes]
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap", "b.mcap"}


@pytest.mark.parametrize("options", [(), ("--overwrite",)], ids=["again", "overwrite"])
def test_an_interrupted_reception_is_measured_from_its_beginning(objects, tmp_path, capsys, options):
    path = tmp_path / "a.mcap"
    with Device(objects, SURVEY) as device:
        with pytest.raises(Interrupted):
            receive(
                open_transport(device.address),
                path,
                timeout_s=60,
                quiet=True,
                live=True,
                stop=lambda: len(device.acknowledged) >= 20,
            )
        capsys.readouterr()
        assert main(["receive", device.address, "-o", str(path), "--live", "--json", *options]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["recovered_objects"] >= 20
    live = document["live"]
    assert live["keyframes"] == 51 and live["from"] < 0.3 and live["d_mean"] == pytest.approx(0.3, rel=0.005)


def test_what_the_measuring_process_said_before_it_ended_is_heard():
    """It may end at any moment while it is listened to."""

    class EndsNow:
        def is_alive(self) -> bool:
            live._outbox.put({"summary": {"keyframes": 3}})
            return False

    live = Live.__new__(Live)
    live._process, live._outbox = EndsNow(), queue.Queue()
    live._told_end, live.progress, live.summary = False, {}, None
    assert live.poll() == [] and live.summary == {"keyframes": 3}


def test_a_measurement_that_dies_does_not_end_the_reception(objects, tmp_path, monkeypatch):
    taken = Live.take

    def killed(self: Live, kind: int, data: bytes) -> None:
        taken(self, kind, data)
        self._process.kill()

    monkeypatch.setattr(Live, "take", killed)
    with Device(objects, SURVEY) as device:
        summary = receive(open_transport(device.address), tmp_path / "a.mcap", timeout_s=60, quiet=True, live=True)
    assert summary["keyframes"] == 51 and summary["live"] is None
    assert dict(summary_rows(None))["measured live"].startswith("no")
