"""The unrolled picture: every place where it belongs, in one light, nothing invented.

Proves it on simulated pipes with discs of known place, with the true wall and poses (the drawing alone) and from a
survey file through `reconstruct` and `unroll` (the whole chain)."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from pipefish.cli import main
from pipefish.simulate import Scene
from pipefish.unroll import Unroller, nice_length
from rendered_survey import FRAMES, MARKS, SCENE, rendered_survey
from test_reconstruct_cli import failure
from true_wall import TrueWall, true_wall


def brightest(grey: np.ndarray, row: float, column: float, reach: int) -> tuple[float, float]:
    """Row and column of the middle of the bright disc near a place; rows go around."""
    rows = (int(row) + np.arange(-reach, reach + 1)) % len(grey)
    columns = int(column) + np.arange(-reach, reach + 1)
    patch = grey[np.ix_(rows, columns)].astype(float)
    bright = np.where(patch > 0.6 * patch.max() + 0.4 * np.median(patch), 1.0, 0.0)
    weight = bright.sum()
    return (
        float(int(row) + (bright.sum(1) @ np.arange(-reach, reach + 1)) / weight),
        float(int(column) + (bright.sum(0) @ np.arange(-reach, reach + 1)) / weight),
    )


def detrended(values: np.ndarray) -> np.ndarray:
    """Without a linear trend: along the pipe that is the wall's or the light's, and nobody can tell."""
    x = np.arange(len(values))
    return values - np.polyval(np.polyfit(x, values, 1), x)


def off_by(grey: np.ndarray, unroller: Unroller, shift: float = 0.0) -> np.ndarray:
    """(marks,2) cells by which the discs are off in rows and columns; shift: from arc length to chainage."""
    out = []
    for s, phi in MARKS:
        column = (s + shift - unroller.start) / unroller.cell - 0.5
        row = (unroller.cut - phi) / (2 * np.pi) * unroller.rows % unroller.rows - 0.5
        found = brightest(grey, row, column, 12)
        out.append((found[0] - row, found[1] - column))
    return np.array(out)


@pytest.fixture(scope="module")
def wall() -> TrueWall:
    return true_wall(Scene(SCENE), FRAMES, 0.5, 1.12, ring=0.02)


def test_discs_are_found_where_they_are_along_a_bend_too(wall):
    """A third of a cell in the mean, 1.5 at most: a cell is 1 mm, a pixel of the pictures 0.9 mm where it is finest."""
    unroller = Unroller(wall, cell=0.001)
    off = off_by(unroller.draw().grey, unroller)
    assert np.abs(off).max() < 1.5 and np.abs(off.mean(axis=0)).max() < 0.3
    turned = Unroller(wall, cell=0.001, cut=2.0)
    assert np.abs(off_by(turned.draw().grey, turned)).max() < 1.5, "the cut moves the picture, not the wall"


def test_strips_and_parts_and_threads_give_the_same_picture(wall):
    unroller = Unroller(wall, cell=0.001, threads=1)
    whole = unroller.draw()
    again = Unroller(wall, cell=0.001, threads=3)
    part = again.draw(104, 124)  # a multiple of the nodes' distance, so the same nodes
    assert unroller.step == 4 and again.light.level == unroller.light.level
    assert np.array_equal(part.grey, whole.grey[:, 104:228])
    assert np.array_equal(part.view, whole.view[104:228])


def test_the_scale_is_that_of_the_pictures(wall):
    """Pixels a radian over the radius: beside the camera nothing is seen more finely along the pipe."""
    unroller = Unroller(wall)
    pixels_per_metre = wall.camera.f_u / 0.1
    assert 1 / unroller.resolution == pytest.approx(pixels_per_metre, rel=0.2)
    assert unroller.cell == pytest.approx(0.001)
    assert unroller.rows * unroller.cell == pytest.approx(np.pi * 0.2, rel=0.001)
    assert [nice_length(x) for x in (0.0031, 0.0016, 0.07)] == pytest.approx([0.002, 0.002, 0.05])
    assert nice_length(0.0021, up=True) == pytest.approx(0.005)


def test_exposure_lamp_and_lens_are_balanced_without_seams():
    """An even wall under an exposure that jumps by factors up to 1.6, its lamp's light falling off by ten: even within
    two per cent, and the gains are the jumps."""
    steps = [{"frame": f, "gain": g} for f, g in ((8, 1.6), (13, 0.8), (21, 1.25))]
    even = SCENE | {"markers": [], "texture": {"contrast": 0.0, "relief": 0.0, "wetness": 0.0, "joint_spacing": 0.0}}
    scene = Scene(even | {"exposure": {"mode": "script", "steps": steps}})
    wall = true_wall(scene, FRAMES, 0.5, 1.05, ring=0.02)
    unroller = Unroller(wall, cell=0.002)
    drawn = unroller.draw()
    grey = drawn.grey[:, 10:-10].astype(float)
    along = grey.mean(axis=0)
    assert np.abs(np.diff(along)).max() < 0.012 * grey.mean(), "no seam from one column to the next"
    assert detrended(np.log(along)).std() < 0.01
    seen = np.unique(drawn.view)
    true = np.log([scene.light_level(int(f)) for f in FRAMES])[seen]
    off = unroller.light.gain[seen] - true
    assert detrended(off).std() < 0.01


def test_what_no_keyframe_saw_is_transparent(wall):
    """The last keyframe is at 0.75 m: its picture ends 92.5 degrees from the axis, REACH ahead."""
    short = true_wall(wall.scene, FRAMES[:14], 0.5, 1.12, ring=0.02)
    short.rendered = wall.rendered
    unroller = Unroller(short, cell=0.002)
    drawn = unroller.draw()
    end = float(short.chainage.max()) + 0.2 * np.sqrt(1.1**2 - 0.25)  # from the axis; the camera is below it
    seen = (drawn.seen > 0).mean(axis=0)
    at = unroller.chainage(np.arange(unroller.columns))
    assert seen[at < end - 0.03].min() == 1.0 and seen[at > end + 0.03].max() == 0.0
    assert not drawn.grey[drawn.seen == 0].any() and (drawn.view[at > end + 0.03] == -1).all()


def test_views_beyond_a_right_angle_are_used(wall):
    """A disc 17 mm behind the first camera, 100 degrees from its axis, in a lens of 220 degrees."""
    lens = {"preset": "fisheye-220", "width": 400, "height": 400, "circle_radius": 195, "c_u": 199.5, "c_v": 199.5}
    wide = true_wall(Scene(SCENE | {"lens": lens | {"theta_max": 1.92}}), FRAMES[24:], 0.9, 1.1, ring=0.02)
    s, phi = MARKS[6]
    assert wide.chainage.min() - s > 0.015
    unroller = Unroller(wide, cell=0.001)
    column, row = (s - unroller.start) / unroller.cell - 0.5, -phi / (2 * np.pi) * unroller.rows % unroller.rows - 0.5
    found = brightest(unroller.draw().grey, row, column, 10)
    assert np.hypot(found[0] - row, found[1] - column) < 2


# ---------------------------------------------------------------- from a survey file


def test_a_survey_becomes_a_picture_that_says_where_it_is(measured, tmp_path, capsys):
    """Within two cells along, where the encoder's and the vision's errors add up, and around, where gravity is zero."""
    out = tmp_path / "wall.png"
    capsys.readouterr()
    assert main(["unroll", str(measured / "out"), "-o", str(out), "--mm", "1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == json.loads(out.with_suffix(".json").read_text())
    grey, alpha = (np.asarray(band) for band in Image.open(out).split())
    assert grey.shape == (document["rows"], document["columns"])
    assert (alpha > 0).mean() == pytest.approx(document["seen"]) and document["seen"] > 0.75
    assert document["not_seen"][-1]["end"] == pytest.approx(document["end"]), "ahead of the last keyframe"
    scene = Scene(SCENE)
    off = []
    for s, phi in MARKS[2:-1]:
        column = (s - scene.arc_length(0) - document["start"]) / document["cell"] - 0.5
        row = -phi / (2 * np.pi) * document["rows"] % document["rows"] - 0.5
        found = brightest(grey, row, column, 12)
        off.append((found[0] - row, found[1] - column))
        view = next(k for k in document["keyframes"] if k["first_column"] <= column < k["first_column"] + k["columns"])
        assert abs(view["chainage"] - (s - scene.arc_length(0))) < 0.04, "the keyframe beside it"
    assert np.abs(off).max() < 2.5 and np.sqrt(np.mean(np.square(off))) < 1.5
    assert document["scale"]["along"] == 1.0 and document["scale"]["around"] == pytest.approx(1.0, rel=0.001)


def test_a_survey_file_is_measured_first(measured, tmp_path, capsys):
    """The same wall from both, but for what tables round."""
    documents = []
    for name, source in (("a.png", "survey.mcap"), ("b.png", "out")):
        arguments = ["--mm", "2", "--from", "0.2", "--to", "0.5", "--json"]
        capsys.readouterr()
        assert main(["unroll", str(measured / source), "-o", str(tmp_path / name), *arguments]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    one, two = documents
    assert (one["rows"], one["columns"]) == (two["rows"], two["columns"])
    assert one["diameter"] == pytest.approx(two["diameter"], rel=1e-6)
    first, second = (np.asarray(Image.open(tmp_path / name).convert("L"), float) for name in ("a.png", "b.png"))
    assert np.abs(first - second).mean() < 1


def test_what_cannot_be_drawn_is_told_before_a_survey_is_measured(measured, tmp_path, capsys, monkeypatch):
    from pipefish import measure

    monkeypatch.setattr(measure, "measure", lambda *_, **__: pytest.fail("measured"))
    survey = measured / "survey.mcap"
    assert ".png" in failure(capsys, "unroll", survey, "-o", tmp_path / "a.tif")
    assert main(["unroll", str(survey), "-o", str(tmp_path / "a.png"), "--from", "3", "--to", "1"]) == 2
    assert "--from 3 --to 1: ends before it begins" in capsys.readouterr().err


def test_labels_stand_around_the_picture(measured, tmp_path):
    plain, labelled = tmp_path / "a.png", tmp_path / "b.png"
    for path, more in ((plain, []), (labelled, ["--labels"])):
        arguments = ["--mm", "2", "--from", "0.2", "--to", "0.5", *more, "--json"]
        assert main(["unroll", str(measured / "out"), "-o", str(path), *arguments]) == 0
    margin = json.loads(labelled.with_suffix(".json").read_text())["margin"]
    inner, outer = np.asarray(Image.open(plain)), np.asarray(Image.open(labelled))
    left, top = margin["left"], margin["top"]
    assert np.array_equal(outer[top : top + inner.shape[0], left : left + inner.shape[1]], inner)
    assert (outer[:, :left, 0] < 60).any() and (outer[top + inner.shape[0] :, left:, 0] < 60).any()


def test_a_long_picture_is_written_in_parts(measured, tmp_path, monkeypatch):
    from pipefish import unroll_files

    monkeypatch.setattr(unroll_files, "LONGEST", 128)
    out = tmp_path / "wall.png"
    assert main(["unroll", str(measured / "out"), "-o", str(out), "--mm", "2", "--json"]) == 0
    document = json.loads(out.with_suffix(".json").read_text())
    parts = document["parts"]
    assert len(parts) > 1 and not out.exists() and sum(p["columns"] for p in parts) == document["columns"]
    for p, after in zip(parts, [*parts[1:], None], strict=True):
        assert Image.open(tmp_path / p["file"]).width == p["columns"] <= 128
        assert after is None or (
            after["first_column"] == p["first_column"] + p["columns"] and after["start"] == p["end"]
        )


def test_bad_input_is_named(measured, tmp_path, capsys):
    out = tmp_path / "a.png"
    missing = failure(capsys, "unroll", measured / "out", "-o", out, "--survey", tmp_path / "none.mcap")
    assert "none.mcap" in missing and "--survey" in missing
    assert ".png" in failure(capsys, "unroll", measured / "out", "-o", tmp_path / "a.tif", "--mm", "5")
    assert "was measured from" in failure(capsys, "unroll", measured / "out", "-o", out, "--from", "50")
    other = rendered_survey(Scene(SCENE | {"markers": []}), FRAMES[:3], tmp_path / "b.mcap", points=10)
    assert main(["unroll", str(measured / "out"), "-o", str(out), "--mm", "0"]) == 2
    assert "no keyframe" in failure(capsys, "unroll", measured / "out", "-o", out, "--survey", other)
    assert not list(tmp_path.glob("a*"))
