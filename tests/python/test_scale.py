"""Where lengths come from: that sources which agree are combined with the right sigma, that those which do not are
named and not averaged, that a known diameter is never measured from itself.

Simulated drives, no rendered pipe; the target's pictures are drawn by this file."""

from __future__ import annotations

import dataclasses
import io
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.errors import ArgumentError
from pipefish.measure import measure
from pipefish.measurement import Measurement
from pipefish.scale import Z95, Estimate, Known, _pattern, combine, joints_estimate
from pipefish.survey import Survey
from pipefish.surveywrite import OBJECT_KEYFRAME
from pipefish.target import Target
from synthetic import as_object, write_survey
from test_reconstruct_cli import document_of, objects_of, survey_of
from tube_tracks import Drive, rotation, tube_drive

SPACING = 0.5
TRUE = 0.3 * (1 + 0.015**2 / 4)  # perimeter / pi of the drives' ellipse


@pytest.fixture(scope="module")
def drive() -> Drive:
    """3 m of DN300 with a joint each half metre."""
    return tube_drive(31, 3.0, joints=SPACING, density=400.0)


def measured(drive: Drive, folder: Path, known: dict, **options: object) -> Measurement:
    survey = survey_of(drive, folder / "a.mcap", **options)
    return measure(Survey.open(survey), threads=2, **known)


@pytest.fixture(scope="module")
def both(drive, tmp_path_factory) -> Measurement:
    """With an encoder known to 0.1 % and the spacing to 0.1 %."""
    return measured(drive, tmp_path_factory.mktemp("both"), {"joint_spacing": Known(SPACING, 0.001 * SPACING)})


def source(m: Measurement, name: str) -> dict:
    return next(r for r in m.scale.sources if r["name"] == name)


def test_estimates_that_agree_average_with_their_weights_and_hold_the_truth():
    random, z, chi2, refused = np.random.default_rng(1), [], [], 0
    sigmas = (0.003, 0.002, 0.004)
    for _ in range(2000):
        found = combine(
            [
                Estimate(n, random.normal(0, s), s, 0.0, "")
                for n, s in zip(("encoder", "joints", "target"), sigmas, strict=True)
            ]
        )
        refused += len(found.used) < 3
        if len(found.used) == 3:
            assert found.sigma == pytest.approx(1 / math.sqrt(sum(s**-2 for s in sigmas)))
            z.append(found.log / found.sigma)
        chi2.append(found.chi2)
    assert np.std(z) == pytest.approx(1.0, abs=0.05)
    assert np.mean(chi2) == pytest.approx(2.0, abs=0.15), "of two degrees of freedom"
    assert refused < 0.01 * 2000, "three sigma: 0.27 %"


def test_what_all_estimates_of_a_source_share_does_not_average_away():
    """Joints of four stretches, the spacing known to 0.2 %: four times as many joints do not make it better."""
    own = [Estimate("joints", 0.0, 0.002, 0.002, "", k) for k in range(4)]
    assert combine(own).sigma == pytest.approx(math.hypot(0.001, 0.002))


def test_the_one_source_that_all_others_contradict_is_left_out():
    others = [Estimate("joints", 0.0, 0.002, 0.0, ""), Estimate("target", 0.001, 0.002, 0.0, "")]
    found = combine([Estimate("encoder", 0.02, 0.002, 0.0, ""), *others])
    assert found.used == ("target", "joints") and abs(found.log) < 0.002 and found.sigma < 0.002
    assert not next(r for r in found.rows if r["name"] == "encoder")["consistent"]
    alone = combine([Estimate("encoder", 0.02, 0.002, 0.0, ""), others[0]])
    assert alone.used == ("encoder",) and alone.log == 0.02
    assert Z95 * alone.sigma >= 0.02, "an interval that leaves the contrary word out would claim what is not known"


def test_encoder_and_joints_that_agree_are_combined(both):
    m = both
    assert m.scale.consistent and source(m, "encoder")["used"] and source(m, "joints")["used"]
    joints = source(m, "joints")
    assert abs(joints["relative"]) < 3 * joints["sigma"] and joints["sigma"] < 0.005
    wheel = m.structure.scale_sigma
    assert m.scale.sigma == pytest.approx(1 / math.hypot(1 / wheel, 1 / joints["sigma"]), rel=1e-6)
    assert m.scale.sigma < 0.98 * wheel
    assert not [r for r in m.remarks if "disagree" in r]
    value = m.measured[0].tube.summary["d_mean"]
    assert abs(value / TRUE - 1) < 2.5 * math.hypot(m.scale.sigma, m.measured[0].d_mean_sigma / value)


def test_an_encoder_of_two_per_cent_too_much_is_reported_with_the_joints(drive, tmp_path, capsys):
    survey = survey_of(drive, tmp_path / "a.mcap", gain=1.02)
    assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--joint-spacing", "500+-1"]) == 0
    text = capsys.readouterr().out
    document = document_of(tmp_path / "out")
    first = document["remarks"][0]
    assert "disagree" in first and "the encoder" in first and "the joints" in first
    assert "DISAGREES" in text
    scale = document["scale"]
    assert not scale["consistent"] and [r["used"] for r in scale["sources"]] == [True, False]
    joints = scale["sources"][1]
    assert joints["relative"] == pytest.approx(-0.0196, abs=3 * joints["sigma"])
    s = document["summary"]
    assert s["d_mean"] == pytest.approx(1.02 * TRUE, rel=0.004), "the encoder's, not a mean of both"
    assert Z95 * s["systematic"]["scale"] > 0.9 * abs(joints["relative"]), "nobody knows which is right"


def test_joints_alone_give_metres_and_a_known_diameter_has_no_say(drive, tmp_path):
    """Without an encoder; the diameter that is given is 10 % wrong."""
    m = measured(drive, tmp_path, {"joint_spacing": Known(SPACING, 0.001), "diameter": 0.33}, encoder=False)
    assert m.scale.source == "joints" and m.scale.unit == "metre" and not m.scale.diameter_from_prior
    joints, given = source(m, "joints"), source(m, "diameter")
    assert 0.002 < joints["sigma"] < 0.01
    value, random = m.measured[0].tube.summary["d_mean"], m.measured[0].d_mean_sigma
    assert abs(value / TRUE - 1) < 2.5 * math.hypot(joints["sigma"], random / value)
    assert m.structure.length == pytest.approx(drive.driven[-1], rel=3 * joints["sigma"])
    assert not given["used"] and not given["consistent"] and "diameter" in m.remarks[0] and "joints" in m.remarks[0]
    assert m.scale.sigma > 0.04, "two words against each other"


def test_a_wrong_spacing_is_another_scale_and_multiples_are_known_by_the_encoder(both):
    """Half the spacing: every second joint was not found, or that is what the encoder says it must be."""
    tube = both.measured[0].tube
    wrong = joints_estimate(both.structure, 0, tube, Known(1.1 * SPACING, 0.001), 1.1 * SPACING)
    assert wrong is not None and math.expm1(wrong.log) == pytest.approx(0.1, abs=0.01)
    found = combine([Estimate("encoder", 0.0, 0.0, 0.003, ""), wrong])
    assert found.used == ("encoder",) and found.chi2 > 100
    half = joints_estimate(both.structure, 0, tube, Known(SPACING / 2, 0.0005), SPACING / 2)
    assert half is not None and abs(half.log) < 0.01


def test_kinks_alone_are_no_joints_of_a_row(both):
    """Turns of the axis that nothing but themselves shows: as joints they outvoted those that are there."""
    tube = both.measured[0].tube
    alone = joints_estimate(both.structure, 0, tube, Known(SPACING, 0.0005), SPACING)
    kink = {"kind": "joint", "s_sigma": 0.01, "angle": 0.05, "step": None, "gap": None}
    places = np.random.default_rng(2).uniform(0.2, 2.8, 2 * len(tube.events))
    events = sorted([*tube.events, *({**kink, "s": s} for s in places)], key=lambda e: e["s"])
    assert (
        joints_estimate(both.structure, 0, dataclasses.replace(tube, events=events), Known(SPACING, 0.0005), SPACING)
        == alone
    )


def test_joints_that_make_no_row_tell_nothing():
    assert _pattern(np.array([0.3, 1.31, 1.75, 2.93]), np.full(4, 0.01), None) is None
    assert _pattern(np.array([0.3, 1.31]), np.full(2, 0.01), None) is None, "of two, any is a row"
    step, number = _pattern(np.array([0.3, 1.31, 1.7, 3.3, 4.29]), np.full(5, 0.01), None)
    assert step == pytest.approx(1.0, abs=0.02) and number.tolist() == [0, 1, -1000, 3, 4]


def drawn(target: Target, drive: Drive, frame: int, board: np.ndarray) -> np.ndarray | None:
    """The picture of a checkerboard; board (3,4): world from target. None where it is not seen."""
    camera, pose = drive.camera, drive.poses[frame]
    turn, move = pose[:, :3] @ board[:, :3], pose[:, :3] @ board[:, 3] + pose[:, 3]
    corners = target.points() @ turn.T + move
    uv, ok = camera.project(corners)
    if not ok.all() or (corners[:, 2] < 0.03).any():
        return None
    low = np.maximum(np.floor(uv.min(0)) - 60, 0).astype(int)
    high = np.minimum(np.ceil(uv.max(0)) + 60, [camera.width - 1, camera.height - 1]).astype(int)
    fine = (np.arange(3) - 1) / 3
    x = (np.arange(low[0], high[0] + 1)[:, None] + fine).ravel()
    y = (np.arange(low[1], high[1] + 1)[:, None] + fine).ravel()
    rays = camera.unproject(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))[0] @ turn  # in the target's frame
    start = -turn.T @ move
    at = start + rays * (-start[2] / rays[:, 2])[:, None]
    width, height = target.size_m
    paper = (np.abs(at[:, 0]) < width / 2) & (np.abs(at[:, 1]) < height / 2) & (rays[:, 2] * start[2] < 0)
    col = np.floor(at[:, 0] / target.spacing_m + target.cols / 2)
    row = np.floor(at[:, 1] / target.spacing_m + target.rows / 2)
    inside = (col >= 0) & (col < target.cols) & (row >= 0) & (row < target.rows)
    value = np.where(paper, np.where(inside & ((row + col) % 2 == 0), 20.0, 200.0), 90.0)
    count = (high - low + 1)[::-1]
    out = np.full((camera.height, camera.width), 90.0)
    out[low[1] : high[1] + 1, low[0] : high[0] + 1] = value.reshape(count[0], 3, count[1], 3).mean((1, 3))
    return np.clip(out + np.random.default_rng(frame).normal(0, 2, out.shape), 0, 255).astype(np.uint8)


def test_a_target_seen_in_the_pipe_tells_the_scale(tmp_path):
    """A checkerboard, 12 mm a square, on the wall beside the way; without an encoder."""
    drive, target = tube_drive(21, 2.0, density=400.0), Target("checkerboard", 6, 7, 0.012)
    tilt = rotation(np.array([0.0, math.radians(55), 0.0]))
    board = np.column_stack([tilt, [0.06, 0.0, 1.2]])
    objects, seen = objects_of(drive, encoder=False), 0
    for at, made in enumerate(objects):
        if made[1] != OBJECT_KEYFRAME:
            continue
        message = pb.Keyframe.FromString(made[2])
        picture = drawn(target, drive, message.index, board) if 15 <= message.index <= 19 else None
        seen += picture is not None
        stream = io.BytesIO()
        blank = np.full((message.height, message.width), 90, np.uint8)
        Image.fromarray(blank if picture is None else picture).save(stream, "JPEG", quality=92)
        message.jpeg = stream.getvalue()
        objects[at] = as_object(OBJECT_KEYFRAME, message)
    assert seen == 5
    write_survey(tmp_path / "a.mcap", objects=objects)
    m = measure(Survey.open(tmp_path / "a.mcap"), target=target, threads=2)
    assert m.scale.source == "target" and 0.001 <= m.scale.sigma < 0.02
    value, random = m.measured[0].tube.summary["d_mean"], m.measured[0].d_mean_sigma
    assert abs(value / TRUE - 1) < 2.5 * math.hypot(m.scale.sigma, random / value)


def test_what_is_no_length_is_refused(tmp_path, drive, capsys):
    survey = survey_of(drive, tmp_path / "a.mcap")
    with pytest.raises(ArgumentError, match="joint_spacing"):
        measure(Survey.open(survey), joint_spacing=-1.0)
    with pytest.raises(ArgumentError, match="sleeve"):
        measure(Survey.open(survey), target=Target("sleeve", 8, 24, 0.03, diameter_m=0.3))
    for text in ("1000+-", "0", "one metre"):
        assert main(["reconstruct", str(survey), "-o", str(tmp_path / "out"), "--joint-spacing", text]) == 2
        assert "--joint-spacing" in capsys.readouterr().err
