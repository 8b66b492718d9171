"""`pipefish target -o FILE.json`: a target that is there already, described; `pipefish profile convert` without OUT."""

from __future__ import annotations

import json

import numpy as np
import pytest

import pipefish as pf
from pipefish import cli
from pipefish.detect import _correctable
from pipefish.target import DICTIONARIES

# Bits of marker 0 of some of OpenCV's dictionaries, row by row, from its own drawings.
MARKER_0 = {
    "4X4_50": "1011010100110010",
    "7X7_50": "1101110101011100011011001010010111001010000010101",
    "ARUCO_ORIGINAL": "1000010000100001000010000",
    "APRILTAG_36h11": "001000011010000101000110101110101011",
}


def described(tmp_path, *arguments):
    out = tmp_path / "mine.json"
    assert cli.main(["target", *map(str, arguments), "-o", str(out)]) == 0
    assert not out.with_suffix(".pdf").exists()
    return pf.Target.load(out)


def test_every_kind_of_target_can_be_described_without_printing_it(tmp_path, capsys):
    board = described(tmp_path, "checkerboard", "--corners", "9x6", "--spacing", "25.1")
    assert (board.cols, board.rows, board.spacing_m) == (10, 7, pytest.approx(0.0251))
    said = capsys.readouterr().out
    assert "9 x 6 inner corners" in said and "200.80 mm across" in said and "calibrate --target" in said
    assert described(tmp_path, "checkerboard", "--grid", "10x7", "--spacing", "25.1") == board
    circles = described(tmp_path, "circles", "--grid", "7x6", "--spacing", "20mm", "--radius", "5")
    assert (circles.points_shape, circles.radius_m) == ((7, 6), 0.005)
    dots = described(tmp_path, "asymmetric-circles", "--grid", "4x11", "--spacing", "40")
    assert np.ptp(dots.points()[:, :2], axis=0) == pytest.approx([0.14, 0.2])  # 3.5 columns, 10 half rows
    sleeve = described(tmp_path, "sleeve", "--diameter", "297.5", "--grid", "20x4", "--spacing", "46")
    assert (sleeve.cols, sleeve.rows, sleeve.diameter_m) == (20, 4, 0.2975)
    marks = described(
        *(tmp_path, "charuco", "--grid", "7x6", "--spacing", "40", "--marker", "30"),
        *("--dictionary", "DICT_4x4_50", "--first-marker", "3", "--legacy"),
    )
    assert (marks.dictionary, marks.legacy, marks.first_marker, marks.marker_bits) == ("4X4_50", True, 3, 4)
    assert marks.marker_share == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["checkerboard", "--spacing", "25"], "give its --grid (or --corners) and its --spacing"),
        (["checkerboard", "--corners", "9x6"], "give its --grid (or --corners) and its --spacing"),
        (["checkerboard", "--corners", "9x6", "--grid", "9x6", "--spacing", "9"], "squares are one more each way"),
        (["circles", "--corners", "9x6", "--spacing", "9"], "--corners: is for checkerboard and charuco"),
        (["circles", "--grid", "9x6", "--spacing", "9", "--legacy"], "are for charuco, not for circles"),
        (["charuco", "--grid", "9x6", "--spacing", "9", "--dictionary", "9X9"], "'9X9' is none of pipefish, 4X4_50"),
        (
            ["charuco", "--grid", "30x9", "--spacing", "9", "--dictionary", "4X4_50"],
            "has 50 markers, the board needs 135",
        ),
    ],
)
def test_a_description_that_says_too_little_or_nonsense_is_refused(tmp_path, capsys, arguments, words):
    assert cli.main(["target", *arguments, "-o", str(tmp_path / "a.json")]) != 0
    assert words in capsys.readouterr().err and not (tmp_path / "a.json").exists()


def drawn(target: pf.Target, scale: float = 3000.0) -> np.ndarray:
    """The sheet as a picture, soft at its edges, `scale` pixels a metre."""
    width, height = (int(scale * side) + 40 for side in target.size_m)
    image = np.full((height, width), target.white)
    for _, u, v, a, b, albedo in target.figures():
        left, right = (round(width / 2 + scale * x) for x in (u - a, u + a))
        top, bottom = (round(height / 2 + scale * y) for y in (v - b, v + b))
        image[top:bottom, left:right] = albedo
    image = sum(np.roll(image, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
    return (255 * image).astype(np.uint8)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("dictionary", ["4X4_50", "7X7_1000"])
def test_charuco_boards_of_opencv_are_found_in_either_layout(dictionary, legacy):
    target = pf.Target("charuco", 6, 4, 0.03, marker_share=0.75, dictionary=dictionary, legacy=legacy)
    image = drawn(target)
    found = pf.detect_target(image, target)
    assert found.status == "ok"
    middle = (np.array(image.shape[::-1]) - 1) / 2
    np.testing.assert_allclose(found.pixels, middle + 3000 * target.flat_points(), atol=0.3)
    other = pf.Target("charuco", 6, 4, 0.03, marker_share=0.75, dictionary=dictionary, legacy=not legacy)
    assert "legacy" in pf.detect_target(image, other).reason


def test_legacy_boards_begin_with_a_marker_where_the_rows_are_even():
    """OpenCV's rule, compared with drawings of OpenCV 5.0 once."""
    for rows, legacy, first in ((6, False, (1, 0)), (6, True, (0, 0)), (5, True, (1, 0)), (5, False, (1, 0))):
        target = pf.Target("charuco", rows, 7, 0.01, dictionary="6X6_250", legacy=legacy)
        x, y = target.marker_middles()[0] / 0.01 + [3, (rows - 1) / 2]
        assert (round(x), round(y)) == first


@pytest.mark.parametrize("name", MARKER_0)
def test_markers_of_opencv_are_its_own(name):
    target = pf.Target("charuco", 3, 3, 0.01, dictionary=name)
    assert "".join(map(str, target.marker(0).ravel())) == MARKER_0[name]


def test_dictionaries_are_in_opencvs_order_and_no_more_bits_are_corrected_than_tell_markers_apart():
    for name, (side, count) in DICTIONARIES.items():
        target = pf.Target("charuco", 3, 3, 0.01, dictionary=name)
        assert target.marker(count - 1).shape == (side, side)
        with pytest.raises(ValueError, match="no such marker"):
            target.marker(count)
    one = np.zeros((2, 4, 4), dtype=np.uint8)
    one[0, 0, :2] = 1
    one[1, 0, :3] = 1
    assert _correctable(one) == 0  # a bit apart


def test_convert_without_an_output_tells_what_a_profile_can_become(tmp_path, capsys):
    camera = pf.Camera(width=640, height=480, f_u=200.0, f_v=200.0, c_u=320.0, c_v=240.0, theta_max=1.7)
    camera.save(tmp_path / "c.json")
    assert cli.main(["profile", "convert", str(tmp_path / "c.json")]) == 0
    said = capsys.readouterr().out
    assert "nothing has been written" in said and "OUT --to basalt" in said and "--max-theta 89" in said
    assert cli.main(["profile", "convert", str(tmp_path / "c.json"), "--json"]) == 0
    forms = json.loads(capsys.readouterr().out)["forms"]
    assert forms["binary"]["fits"] and forms["basalt"]["fit"]["exact"] and not forms["ros"]["fits"]
    assert cli.main(["profile", "convert", str(tmp_path / "c.json"), "--to", "ros"]) == 2
    assert "name the file to write" in capsys.readouterr().err
    assert cli.main(["convert", str(tmp_path / "c.json")]) == 2
    assert "did you mean: pipefish profile convert" in capsys.readouterr().err
