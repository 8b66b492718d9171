"""From a survey file to a measured pipe, its files and its report; no pictures are rendered.

Proves that what is written is what was measured, that scale is what it says it is, that bad input gets a clear answer.
How exact the structure and the tube are is the subject of test_reconstruct.py and test_tube.py."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pipefish as pf
from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.cli_reconstruct import reconstruct_text
from pipefish.cloudfile import read_columns, read_points
from pipefish.measure import measure
from pipefish.measured_files import write_measurement
from pipefish.readings import DEFAULT_ATTITUDE_SIGMA, attitude_of
from pipefish.survey import Survey
from pipefish.surveywrite import OBJECT_END, OBJECT_KEYFRAME, OBJECT_START
from synthetic import BOOT, SURVEY, Object, as_object, picture, write_survey
from test_page import Outline, data_of
from tube_tracks import Drive, tube_drive

COUNT = 0.0005  # metres of the encoder
LENGTH = 2.0


def objects_of(
    drive: Drive,
    *,
    keep: np.ndarray | None = None,
    encoder: bool = True,
    attitude: bool = False,
    profile: pf.Camera | None = None,
    gain: float = 1.0,
    frames: np.ndarray | None = None,
    nominal: float = 0.3,
    seed: int = 3,
    settled: float = 0.0,
    jitter: float = 0.0005,
) -> list[Object]:
    """The objects of a drive as a device sends them. keep: (observations,) bool; gain: of the encoder; frames: which,
    in the order given; seed: of the encoder's noise, jitter: its sigma a step, metres; settled: pixels by which places
    were moved, and told to be."""
    order = np.arange(len(drive.poses)) if frames is None else frames
    camera, jpeg = drive.camera, picture(16, 16, 0)
    begin = pb.SurveyStart(survey_id=SURVEY, name="made-up pipe", software="test", width=camera.width)
    begin.height, begin.nominal_diameter_m = camera.height, nominal
    begin.time.boot_id, begin.profile = BOOT, (profile or camera).to_binary()
    if encoder:
        begin.encoder.metres_per_count, begin.encoder.metres_per_count_sigma = COUNT, 0.001 * COUNT
    objects = [as_object(OBJECT_START, begin)]
    tracks, random = drive.tracks, np.random.default_rng(seed)
    keep = np.ones(len(tracks.frame), bool) if keep is None else keep
    steps = np.abs(np.diff(drive.driven[order], prepend=drive.driven[order[0]]))
    driven = np.cumsum(steps + random.normal(0, jitter, len(order)) * (np.arange(len(order)) > 0))
    for index, frame in enumerate(order):
        message = pb.Keyframe(survey_id=SURVEY, index=index, frame_sequence=5 * index, cause=2, after_break=index == 0)
        message.width, message.height, message.jpeg = camera.width, camera.height, jpeg
        message.time.boot_id, message.time.monotonic_ns = BOOT, 10**9 + index * 2 * 10**8
        if encoder:
            message.telemetry.encoder_count = round(gain * driven[index] / COUNT)
        if attitude:
            down = drive.poses[frame, :, :3] @ np.array([0.0, 1.0, 0.0])
            message.telemetry.roll_rad, message.telemetry.pitch_rad = np.arctan2(down[0], down[1]), -np.arcsin(down[2])
            message.telemetry.attitude_sigma_rad = 0.003
        here = np.flatnonzero((tracks.frame == frame) & keep)
        here = here[np.argsort(tracks.track[here])]
        ids, obs = tracks.track[here] + 1, message.observations
        obs.id_delta.extend(np.diff(ids, prepend=0).tolist())
        shift = np.round(settled * 256 * random.normal(0, 1, (len(here), 2))).astype(int) if settled else None
        xy = np.round(tracks.pixels[here] * 65536).astype(int) + (256 * shift if settled else 0)
        if settled:
            obs.settled_x_q8.extend(shift[:, 0].tolist())
            obs.settled_y_q8.extend(shift[:, 1].tolist())
        obs.x_q16.extend(xy[:, 0].tolist())
        obs.y_q16.extend(xy[:, 1].tolist())
        for name, value in (("cov_xx_q20", 94372), ("cov_xy_q20", 0), ("cov_yy_q20", 94372)):  # 0.3 px
            getattr(obs, name).extend([value] * len(ids))
        obs.age.extend([5] * len(ids))
        obs.quality.extend([32000] * len(ids))
        obs.status.extend([2] * len(ids))
        objects.append(as_object(OBJECT_KEYFRAME, message))
    finish = pb.SurveyEnd(survey_id=SURVEY, keyframes=len(order), frames=5 * len(order), boots=1, reason="done")
    return [*objects, as_object(OBJECT_END, finish)]


def survey_of(drive: Drive, path: Path, **options: Any) -> Path:
    """A survey file of a drive; options of objects_of."""
    write_survey(path, objects=objects_of(drive, **options))
    return path


@pytest.fixture(scope="module")
def drive() -> Drive:
    """2 m of DN300, 3 % oval, the long axis upright."""
    return tube_drive(21, LENGTH)


@pytest.fixture(scope="module")
def out(drive: Drive, tmp_path_factory) -> Path:
    """The files of a survey with encoder and inclinometer."""
    folder = tmp_path_factory.mktemp("measured")
    survey = survey_of(drive, folder / "survey.mcap", attitude=True)
    assert main(["reconstruct", str(survey), "-o", str(folder / "out"), "--json"]) == 0
    return folder / "out"


def document_of(out: Path) -> dict:
    return json.loads((out / "reconstruction.json").read_text())


def test_places_are_taken_where_they_were_found(drive: Drive, tmp_path: Path) -> None:
    """And not where the device moved them to, here 0.5 px in all directions: it knows the wall less well than the tube
    that is fitted to all of it."""
    path = survey_of(drive, tmp_path / "survey.mcap", settled=0.5)
    tracks = measure(Survey.open(path)).tracks
    np.testing.assert_allclose(tracks.pixels, drive.tracks.pixels, atol=1e-5)
    assert np.median(tracks.covariance[:, 0, 0]) > 0.09 + 0.05  # 0.3 px, and half of those 0.5 px at the median


def test_an_inclinometer_that_does_not_know_its_sigma_has_the_usual_one(drive: Drive, tmp_path: Path) -> None:
    objects = []
    for item in objects_of(drive, attitude=True, frames=np.arange(4)):
        if item[1] == OBJECT_KEYFRAME:
            message = pb.Keyframe.FromString(item[2])
            message.telemetry.attitude_sigma_rad = np.nan
            item = as_object(OBJECT_KEYFRAME, message)
        objects.append(item)
    write_survey(tmp_path / "survey.mcap", objects=objects)
    values, sigma = attitude_of(Survey.open(tmp_path / "survey.mcap"))
    assert np.isfinite(values).all() and sigma == DEFAULT_ATTITUDE_SIGMA


def test_files_are_the_same_for_any_number_of_threads(drive: Drive, tmp_path: Path) -> None:
    path = survey_of(drive, tmp_path / "survey.mcap", attitude=True, frames=np.arange(20))
    for threads in (1, 8):
        write_measurement(measure(Survey.open(path), threads=threads), tmp_path / str(threads))
    names = sorted(p.relative_to(tmp_path / "1") for p in (tmp_path / "1").rglob("*") if p.is_file())
    assert len(names) > 8 and names == sorted(
        p.relative_to(tmp_path / "8") for p in (tmp_path / "8").rglob("*") if p.is_file()
    )
    assert [n for n in names if (tmp_path / "1" / n).read_bytes() != (tmp_path / "8" / n).read_bytes()] == []


def failure(capsys, *arguments: object) -> str:
    """The line of a command that must fail with exit code 1."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_diameter_is_the_truth_within_what_is_stated(out):
    s = document_of(out)["summary"]
    # Of its pupil, which does not shift, the profile says nothing: what is assumed for that is no part of this.
    sigma = np.hypot(s["d_mean_sigma"], s["systematic"]["scale"] * s["d_mean"])
    # Perimeter / pi of an ellipse of 0.3 (1 +- 0.015): above 0.3 by a quarter of 0.015^2.
    assert s["d_mean"] == pytest.approx(0.3 * (1 + 0.015**2 / 4), abs=3 * sigma) and sigma < 0.0012
    assert s["unit"] == "metre" and not s["diameter_from_prior"]
    assert s["ovality_rms"] == pytest.approx(0.03, abs=0.0015)


def test_tables_say_the_same_as_the_document(out):
    document, profile = document_of(out), rows_of(out / "profile.csv")
    for name in ("chainage", "d_mean", "ovality", "d_mean_sigma"):
        written = [float(r[name]) if r[name] else None for r in profile]
        assert written == pytest.approx(document["stations"][name], rel=1e-6, nan_ok=True)
    line = rows_of(out / "centreline.csv")
    assert [r["x"] for r in line] == [r["x"] for r in profile] and "curvature" in line[0]
    assert len(rows_of(out / "events.csv")) == len(document["events"])
    header = (out / "events.csv").read_text().splitlines()[0].split(",")
    assert header[:2] == ["kind", "chainage"] and {"clock", "height", "gap", "angle", "detail"} <= set(header)
    assert set(document["files"]) == {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}


def test_chainage_is_the_encoders(drive, out):
    """Where the axis passes a camera, its chainage is that camera's reading."""
    document = document_of(out)
    centres, along = np.array(document["poses"]["centre"]), np.array(document["poses"]["chainage"])
    stations = document["stations"]
    axis = np.stack([stations[k] for k in "xyz"], -1)
    inner = along[(along > 0.3) & (along < LENGTH - 0.3)]
    nearest = [np.argmin(np.linalg.norm(axis - centres[along == a], axis=1)) for a in inner]
    assert np.array(stations["chainage"])[nearest] == pytest.approx(inner, abs=0.08)  # stations are 75 mm apart


def test_clock_of_the_long_axis_is_upright_by_gravity(out):
    document = document_of(out)
    assert document["clock_zero"] == "against gravity"
    clock = np.array([c for c in document["stations"]["clock_max"] if c is not None])
    assert np.abs((clock + np.pi / 2) % np.pi - np.pi / 2).max() < 0.2


def test_clouds_have_points_on_the_wall_and_a_closed_skin(out):
    points, sigma = read_points(out / "points.ply")
    columns = read_columns(out / "points.ply")
    assert len(points) == document_of(out)["summary"]["points"] and (sigma > 0).all()
    on = np.isfinite(columns["distance"])
    assert on.mean() > 0.9 and np.median(np.abs(columns["distance"][on])) < 0.002
    wall = read_columns(out / "tube.ply")
    assert len(wall["x"]) % 72 == 0 and set(wall["piece"]) == {0}
    assert np.abs(wall["deviation"]).max() == pytest.approx(0.3 * 0.015, rel=0.5)


def test_the_colmap_model_reprojects_with_its_own_pixel_origin(drive, out):
    """Its fisheye model, written out here from COLMAP's documentation, puts every point where it was observed."""
    head = (out / "colmap" / "cameras.txt").read_text().splitlines()[-1].split()
    assert head[1] == "OPENCV_FISHEYE"
    fx, fy, cx, cy, *k = map(float, head[4:])
    assert (cx, cy) == (drive.camera.c_u + 0.5, drive.camera.c_v + 0.5)
    world = {}
    for line in (out / "colmap" / "points3D.txt").read_text().splitlines():
        if not line.startswith("#"):
            words = line.split()
            world[int(words[0])] = (np.array(words[1:4], float), np.array(words[8:], int).reshape(-1, 2))
    images = [t for t in (out / "colmap" / "images.txt").read_text().splitlines() if not t.startswith("#")]
    errors, seen = [], {}
    for pose, row in zip(images[::2], images[1::2], strict=True):
        number, qw, qx, qy, qz, *t = (float(v) for v in pose.split()[:8])
        v, w = np.array([qx, qy, qz]), qw
        observed = np.array(row.split(), float).reshape(-1, 3)
        seen[int(number)] = observed
        observed = observed[observed[:, 2] >= 0]
        x = np.array([world[int(p)][0] for p in observed[:, 2]])
        x = x + 2 * np.cross(v, np.cross(v, x) + w * x) + t
        theta = np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
        r = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
        phi = np.arctan2(x[:, 1], x[:, 0])
        errors.append(observed[:, :2] - np.stack([fx * r * np.cos(phi) + cx, fy * r * np.sin(phi) + cy], -1))
    errors = np.vstack(errors)
    assert np.sqrt((errors**2).mean()) < 0.4 and np.abs(errors.mean(axis=0)).max() < 0.02
    for number, (_, track) in world.items():
        assert all(seen[i][j, 2] == number for i, j in track)


def test_the_terminal_says_once_what_plus_minus_is(out):
    """95 % of everything: standard deviations stood among intervals, and the largest ovality alone."""
    document = document_of(out) | {"file_remarks": ["No COLMAP model: it is Tuesday."]}
    lines = dict(line.split("  ", 1) for line in reconstruct_text(document, ["a.csv"]).splitlines())
    text, s = "\n".join(lines.values()), document["summary"]
    assert text.count("95 %") == 1 and "sigma" not in text and "+-" not in text
    assert f"± {1960 * s['d_mean_sigma']:.1f} mm (repeatability) ± {1960 * s['d_mean_systematic']:.1f} mm" in text
    most = max(document["stations"]["d_mean_systematic"])
    assert s["station_systematic_most"] == most and f"at stations up to ± {1960 * most:.1f} mm)" in text
    k = document["stations"]["ovality"].index(s["ovality_most"])
    half = 196 * np.hypot(*(document["stations"][f"ovality_{n}"][k] for n in ("sigma", "systematic")))
    assert f"most {100 * s['ovality_most']:.2f} ± {half:.2f} % at" in text
    assert list(lines)[-1] == "about files" and "Tuesday" not in text.partition("every ±")[0]


def test_without_scale_everything_is_relative_and_says_so(drive, tmp_path, capsys):
    survey = survey_of(drive, tmp_path / "a.mcap", encoder=False)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "no scale" in text and "mm" not in re.sub(r"note.*|written.*", "", text)
    s = document_of(tmp_path / "out")["summary"]
    assert s["unit"] == "diameter" and s["d_mean"] == pytest.approx(1, abs=0.01)
    assert s["ovality_rms"] == pytest.approx(0.03, abs=0.0015)
    assert s["path_length"] == pytest.approx(drive.driven[-1] / 0.3, rel=0.02)


def test_a_known_diameter_is_a_scale_and_then_not_measured(drive, tmp_path):
    survey = survey_of(drive, tmp_path / "a.mcap", encoder=False)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--diameter", "300", "--json"]) == 0
    document = document_of(tmp_path / "out")
    assert document["summary"]["diameter_from_prior"] and document["summary"]["unit"] == "metre"
    assert document["summary"]["path_length"] == pytest.approx(drive.driven[-1], rel=0.02)
    assert any("not measured" in r for r in document["remarks"])


def test_an_encoder_that_contradicts_the_known_diameter_is_told_and_not_averaged(drive, tmp_path):
    survey = survey_of(drive, tmp_path / "a.mcap", gain=1.05)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--diameter", "300", "--json"]) == 0
    document = document_of(tmp_path / "out")
    check = next(r for r in document["scale"]["sources"] if r["name"] == "diameter")
    assert not check["consistent"] and check["deviation"] < -3 and not check["used"]
    assert document["summary"]["d_mean"] == pytest.approx(0.315, rel=0.005)
    assert "times the 95 % interval of the difference" in " ".join(document["remarks"])
    assert "Recalibrate the camera, unless the encoder or the given diameter is wrong." in " ".join(document["remarks"])


def test_a_stretch_without_texture_is_left_blank_and_the_rest_is_measured(tmp_path):
    drive = tube_drive(14, 4.0)
    bare = (drive.tracks.frame >= 35) & (drive.tracks.frame <= 45)
    keep = ~bare | (np.random.default_rng(0).uniform(size=len(bare)) < 0.05)
    survey = survey_of(drive, tmp_path / "a.mcap", keep=keep)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--json"]) == 0
    document = document_of(tmp_path / "out")
    assert document["status"] == "partial" and document["summary"]["stretches"] == 2
    gap = next(g for g in document["not_measured"] if g["reason"] == "weak_texture")
    assert gap["start"] > 1.4 and gap["end"] < 2.6
    assert any(e["kind"] == "not_measured" for e in document["events"])
    assert not [e for e in document["events"] if e["kind"] != "not_measured"], "a gap is no finding"
    first, second = (np.array(document["stations"]["stretch"]) == k for k in (0, 1))
    chainage = np.array(document["stations"]["chainage"])
    assert chainage[second].max() == pytest.approx(4.4, abs=0.3)
    assert chainage[second].min() > chainage[first].max() - 0.6
    # What is said to be missing is what the stations leave, not where the camera had no pose.
    assert gap["start"] == pytest.approx(min(chainage[first].max(), chainage[second].min()), abs=1e-6)
    assert gap["end"] == pytest.approx(chainage[second].min(), abs=1e-6)


def test_an_invert_under_water_is_told_with_its_clock(tmp_path):
    """No tracks over 100 degrees around six: an ellipse through the rest, said to be that. Over 170: no ellipse,
    and the stretch without it names the clock."""
    drive = tube_drive(21, 1.6, density=900.0)
    below = np.arctan2(drive.points[:, 0], drive.points[:, 1])  # from straight down: y is down
    for degrees, word in ((100, "the invert"), (170, "mean diameter only")):
        dry = np.abs(below[drive.tracks.track]) > np.radians(degrees / 2)
        survey = survey_of(drive, tmp_path / f"{degrees}.mcap", keep=dry, attitude=True)
        assert main(["reconstruct", str(survey), "-o", str(tmp_path / str(degrees)), "--json"]) == 0
        document = document_of(tmp_path / str(degrees))
        told = [*document["remarks"], *(g["detail"] for g in document["not_measured"])]
        found = [t for t in told if word in t]
        assert found and any("the invert" in t for t in found), told
        hour = int(re.search(r"around (\d+):", found[0])[1])
        assert hour in (5, 6)


def mirrored(drive: Drive, level: float, every: int) -> Drive:
    """The drive with water so far below the axis, which shows each so-manieth point of the dry wall once more."""
    image = drive.points[::every] * [1, -1, 1] + [0, 2 * level, 0]
    image = image[image[:, 1] > level]
    frame, track, pixels = [drive.tracks.frame], [drive.tracks.track], [drive.tracks.pixels]
    for number, pose in enumerate(drive.poses):
        seen = image @ pose[:, :3].T + pose[:, 3]
        uv, ok = drive.camera.project(seen)
        theta = np.degrees(np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2]))
        here = np.flatnonzero(ok & (theta > 35) & (theta < 89))
        frame.append(np.full(len(here), number))
        track.append(len(drive.points) + here)
        pixels.append(uv[here] + np.random.default_rng(number).normal(0, 0.3, (len(here), 2)))
    tracks = pf.Tracks(*(np.concatenate(part) for part in (frame, track, pixels)))
    return dataclasses.replace(drive, tracks=tracks, points=np.concatenate([drive.points, image]))


def test_what_water_mirrors_is_no_wall_and_no_lateral(tmp_path):
    """The images are as rigid as the wall: without knowing them the invert has a lateral, 0.2 m wide."""
    level = 0.15 * np.cos(np.radians(50))
    drive = mirrored(tube_drive(21, 1.6, density=900.0, ovality=0.01), level, 4)
    dry = (drive.points[:, 1] < level)[drive.tracks.track] | (drive.tracks.track >= 900 * 2.4)
    survey = survey_of(drive, tmp_path / "a.mcap", keep=dry, attitude=True)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--json"]) == 0
    document = document_of(tmp_path / "out")
    assert not document["events"] and document["summary"]["d_mean"] == pytest.approx(0.3, rel=0.01)
    (water,) = document["tubes"][0]["water"]
    assert water["depth"] == pytest.approx(0.15 - level, abs=0.003) and water["points"] > 100
    assert any("water mirrors the wall" in r for r in document["remarks"])
    distance = read_columns(tmp_path / "out" / "points.ply")["distance"]
    assert np.isnan(distance).sum() >= water["points"] and (distance > 0.01).sum() < 0.05 * water["points"]


def test_a_survey_driven_backwards_is_measured_and_says_so(drive, tmp_path):
    backwards = np.arange(len(drive.poses))[::-1]
    survey = survey_of(drive, tmp_path / "a.mcap", frames=backwards)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--json"]) == 0
    document = document_of(tmp_path / "out")
    assert document["structure"]["backwards"] and any("backwards" in r for r in document["remarks"])
    assert document["summary"]["d_mean"] == pytest.approx(0.3, rel=0.01)
    assert document["tubes"][0]["chainage_sign"] == -1


def test_a_pipe_of_another_size_than_said_and_a_drive_that_turned_round_are_told(drive, tmp_path):
    """A quarter off no pipe is: a wrong profile makes diameters like that, whose residuals are small."""
    there_and_back = np.r_[0:16, 14:7:-1]
    survey = survey_of(drive, tmp_path / "a.mcap", frames=there_and_back, nominal=0.4)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--json"]) == 0
    remarks = document_of(tmp_path / "out")["remarks"]
    assert any("25 % under the nominal 400 mm: a wrong camera profile" in r for r in remarks)
    assert any("turned round and drove back by up to 0.35 m" in r for r in remarks)


def test_surveys_that_cannot_be_measured_say_why_in_one_line(drive, tmp_path, capsys):
    black = survey_of(drive, tmp_path / "black.mcap", keep=np.zeros(len(drive.tracks.frame), bool))
    assert "no keyframe has tracks: a black or covered picture?" in failure(
        capsys, "reconstruct", black, "-o", tmp_path
    )
    two = survey_of(drive, tmp_path / "two.mcap", frames=np.arange(2))
    assert "2 keyframes, 0.05 m driven; three are the least" in failure(capsys, "reconstruct", two, "-o", tmp_path)
    stood = survey_of(drive, tmp_path / "stood.mcap", frames=np.zeros(1, int))
    assert "1 keyframe, 0.00 m driven" in failure(capsys, "reconstruct", stood, "-o", tmp_path)
    three = survey_of(drive, tmp_path / "three.mcap", frames=np.arange(3))
    assert main(["reconstruct", str(three), "-o", str(tmp_path / "three"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)["summary"]
    assert abs(answer["d_mean"] - 0.3) < 4 * answer["d_mean_sigma"] and answer["stations_measured"] >= 2
    still = survey_of(drive, tmp_path / "still.mcap", frames=np.zeros(8, int))
    assert "moves" in failure(capsys, "reconstruct", still, "-o", tmp_path)
    small = dataclasses.replace(drive.camera, width=640, height=480, c_u=320.0, c_v=240.0)
    wrong = survey_of(drive, tmp_path / "wrong.mcap", profile=small)
    assert "a wrong profile?" in failure(capsys, "reconstruct", wrong, "-o", tmp_path)
    assert not list(tmp_path.glob("*.csv"))


def test_a_profile_that_does_not_fit_is_warned_of(drive, tmp_path, capsys):
    bent = dataclasses.replace(drive.camera, f_u=360.0, f_v=360.0, k2=-0.08, theta_max=1.5)
    survey = survey_of(drive, tmp_path / "a.mcap", profile=bent)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--json"]) == 0
    words = " ".join(json.loads(capsys.readouterr().out)["remarks"])
    assert "under the nominal 300 mm: a wrong camera profile" in words
    assert "px outwards between 80 and 90 degrees from the axis. The profile does not quite fit the camera" in words
    assert "What can be seen does not fit the profile" in words


# ---------------------------------------------------------------- the report


def test_the_report_stands_alone_and_its_scene_has_geometry(out, tmp_path, capsys):
    page = tmp_path / "report.html"
    limits = ("ovality=5", "ovality_astm=0.5", "ovality_astm_max=5", "d_min=295.5")
    arguments = [x for limit in limits for x in ("--limit", limit)]
    assert main(["report", str(out), "-o", str(page), *arguments, "--json"]) == 1
    verdicts = {v["name"]: v["state"] for v in json.loads(capsys.readouterr().out)["limits"]}
    assert verdicts["ovality"] == "passed" and verdicts["ovality_astm"] == "failed"
    text = page.read_text()
    assert verdicts["ovality_astm_max"] == "passed" and "ASTM F1216: (max - mean) / mean</th>" in text
    assert "narrowest caliper width</th>" in text
    outline = Outline(text)
    assert not outline.open and all(a.startswith("data:") for a in outline.addresses)
    charts = {c["id"]: c for c in data_of(text)["charts"]}
    assert {"plot-" + name for name in charts} == set(outline.charts)
    mesh = charts["tube"]["data"][0]
    assert mesh["type"] == "mesh3d" and len(mesh["i"]) > 500 and max(mesh["k"]) < len(mesh["x"])
    z = np.array([mesh["x"], mesh["y"], mesh["z"]])
    assert np.ptp(z, axis=1).max() > LENGTH and len(charts["tube"]["data"][1]["x"]) > 500
    scene, mean = charts["tube"]["layout"]["scene"], charts["diameter"]["data"][-1]
    assert max(scene["aspectratio"].values()) == 2.5 and scene["domain"]["y"][0] > 0.1, (
        "all of it, above the colour bar"
    )
    assert mean["name"].startswith("mean") and mean["line"]["dash"] == "dash", "seen where all diameters are alike"
    assert "sigma(alpha)" not in text, "in a surveyor's words"
    menu = charts["ovality"]["choice"]["names"]
    assert any("F1216" in m for m in menu) and any("13508" in m for m in menu) and len(menu) == 5


@pytest.mark.parametrize(
    ("limit", "code"),
    [
        *(("ovality=5", 0), ("ovality=2", 1), ("ovality=3", 1), ("ovality_nominal=5", 0)),  # it is 3 % oval: undecided
        *(("ovality=-5", 2), ("ovality=100", 2), ("d_min=-3", 2), ("d_min=0.285", 2), ("d_max=30500", 2)),
    ],
)
def test_a_script_learns_from_the_exit_code_whether_all_limits_hold(out, tmp_path, capsys, limit, code):
    """1 for what failed and what was not shown; 2 for a bound that nobody can have meant, with its unit."""
    page = tmp_path / "r.html"
    assert main(["report", str(out), "-o", str(page), "--limit", "d_max=320", "--limit", limit]) == code
    said = capsys.readouterr()
    assert page.exists() == (code != 2)
    if code == 2:
        assert limit.split("=")[0] in said.err and ("per cent" in said.err or "millimetres" in said.err)


def test_stations_without_a_value_are_not_taken_for_passed(out, tmp_path, capsys):
    document = document_of(out)
    document["stations"]["ovality"][3] = None
    (tmp_path / "reconstruction.json").write_text(json.dumps(document))
    shutil.copy(out / "points.ply", tmp_path)
    shutil.copy(out / "tube.ply", tmp_path)
    assert main(["report", str(tmp_path), "-o", str(tmp_path / "r.html"), "--limit", "ovality=5", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["limits"][0]["state"] == "passed where measured"


@pytest.mark.parametrize(("end", "state"), [(1.9, "passed where measured"), (1.2, "passed")])
def test_a_limit_does_not_hold_over_a_stretch_that_nobody_measured(out, end, state):
    """One without a length is a break in the chain of tracks whose wall was seen all the same."""
    from pipefish.measured_limits import all_hold, verdict

    document = document_of(out)
    document["not_measured"] = [{"start": 1.2, "end": end, "reason": "weak_texture"}]
    found = verdict(document, "ovality", 5.0)
    assert found["state"] == state and all_hold([found]) == (state == "passed")


@pytest.mark.parametrize(
    ("value", "sigma", "state", "shown"),
    [([0.060, 0.055], [0.015, 0.001], "failed", "5.50"), ([0.049, 0.045], [0.0002, 0.010], "undecided", "4.50")],
)
def test_the_station_that_decides_is_the_one_that_is_shown(out, value, sigma, state, shown):
    from pipefish.measured_limits import verdict

    document = document_of(out)
    stations = {name: column[:2] for name, column in document["stations"].items()}
    document["stations"] = stations | {"ovality": value, "ovality_sigma": sigma, "ovality_systematic": [0.0, 0.0]}
    found = verdict(document, "ovality", 5.0)
    assert found["state"] == state and found["worst"].startswith(shown)


def test_the_help_names_every_limit(capsys):
    from pipefish.measured_limits import LIMITS

    assert main(["report", "--help"]) == 0
    assert set(LIMITS) <= set(re.findall(r"\w+", capsys.readouterr().out))


def test_findings_say_what_they_cannot_show(out, tmp_path, capsys):
    """How small a thing the survey could have found, from its own points, on the page and in the terminal."""
    from pipefish.cli_reconstruct import reconstruct_text

    document = document_of(out)
    found = document["findings_reach"]
    wall = np.pi * 0.3 * document["summary"]["tube_length"] / document["summary"]["points"]
    assert 0.95 < found["spacing"] / np.sqrt(wall) < 2 and 2 < found["patch_size"] / found["spacing"] < 3
    assert 0.0015 < found["patch_height"] < 0.01 and found["joint_step"] is None
    assert main(["report", str(out), "-o", str(tmp_path / "r.html")]) == 0
    for text in ((tmp_path / "r.html").read_text(), reconstruct_text(document, [])):
        assert "open joints without a step" in text and "pipefish dense" in text
        assert f"over {1000 * found['patch_size']:.1f} mm across" in text


def test_limits_hold_the_interval_against_the_bound(out):
    from pipefish.measured_limits import verdict
    from pipefish.measured_texts import read_measured

    document = read_measured(out)
    worst = max(v for v in document["stations"]["d_max"] if v is not None) * 1000
    assert verdict(document, "d_max", worst + 20)["state"] == "passed"
    assert verdict(document, "d_max", worst - 20)["state"] == "failed"
    assert verdict(document, "d_max", worst)["state"] == "undecided"
    document["summary"]["nominal"] = None
    document["stations"]["reduction_nominal"] = [None] * len(document["stations"]["s"])
    assert "no nominal diameter was given" in verdict(document, "reduction_nominal", 5)["text"]


def test_a_limit_of_the_reduction_counts_what_is_systematic_at_its_own_station(out):
    """What a camera leaves open at the ends of a drive is not in the mean's, and was counted for that."""
    from pipefish.measured_limits import whole_sigma
    from pipefish.measured_texts import read_measured

    document = read_measured(out)
    stations = document["stations"]
    stations["d_min_systematic"] = np.linspace(0.001, 0.004, len(stations["s"])).tolist()
    random, here = (np.array(stations[name], float) for name in ("reduction_nominal_sigma", "d_min_systematic"))
    assert document["summary"]["nominal"] == 0.3
    assert whole_sigma(document, "reduction_nominal") == pytest.approx(np.hypot(random, here / 0.3), nan_ok=True)


def test_texts_of_the_survey_cannot_break_the_report(out, tmp_path):
    nasty = "</script><script>alert(1)</script><b>'\"&"
    copy = shutil.copytree(out, tmp_path / "copy")
    document = document_of(copy)
    document["survey"]["name"] = document["camera"]["name"] = nasty
    document["remarks"].append(nasty)
    (copy / "reconstruction.json").write_text(json.dumps(document))
    assert main(["report", str(copy), "-o", str(tmp_path / "r.html"), "--json"]) == 0
    text = (tmp_path / "r.html").read_text()
    assert "<script>alert" not in text and not Outline(text).open


def test_a_folder_that_is_none_is_named(tmp_path, capsys):
    told = failure(capsys, "report", tmp_path, "-o", tmp_path / "r.html")
    assert "reconstruction.json" in told and "`pipefish reconstruct SURVEY -o DIR` writes it" in told
    (tmp_path / "reconstruction.json").write_text("{}")
    assert "pipefish reconstruct" in failure(capsys, "report", tmp_path, "-o", tmp_path / "r.html")
    assert main(["report", str(tmp_path), "-o", "r.html", "--limit", "beauty=3"]) == 2


@pytest.mark.parametrize("option", ["--diameter", "--joint-spacing", "--nominal"])
def test_metres_where_millimetres_are_wanted_are_wrong_usage(tmp_path, capsys, option):
    assert main(["reconstruct", str(tmp_path / "a.mcap"), "-o", str(tmp_path), option, "0.3"]) == 2
    assert f"{option}: '0.3' is in millimetres" in capsys.readouterr().err
