"""`pipefish target`: what is printed has the size that the target says, and the JSON beside it says the same."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pypdfium2
import pytest

import pipefish as pf
from pipefish import cli, cli_target, targetprint
from pipefish.target import KINDS
from pipefish.targetprint import PAPERS, pages, print_target

DPI = 254.0  # ten pixels a millimetre


def raster(data: bytes, page: int = 0) -> np.ndarray:
    """A page as grey levels, ten pixels a millimetre, rows from the top."""
    # A touch below, or rounding makes the raster a row higher.
    drawn = pypdfium2.PdfDocument(data)[page].render(scale=(DPI - 1e-4) / 72, grayscale=True)
    return np.asarray(drawn.to_numpy()).squeeze()


def dark_middles(image: np.ndarray, where: np.ndarray, half: int) -> np.ndarray:
    """Centroids of darkness, mm, in windows of `half` pixels around places `where` in mm."""
    found = []
    for x, y in where * 10:
        x0, y0 = round(x) - half, round(y) - half
        dark = 255.0 - image[y0 : y0 + 2 * half, x0 : x0 + 2 * half]
        v, u = np.mgrid[: 2 * half, : 2 * half] + 0.5
        found.append([(dark * u).sum() / dark.sum() + x0, (dark * v).sum() / dark.sum() + y0])
    return np.array(found) / 10


def test_circles_lie_on_paper_to_a_hundredth_of_a_millimetre() -> None:
    target = pf.Target("asymmetric-circles", 11, 4, 0.03, margin_m=0.01)
    image = raster(print_target(target))
    page = pages(target, "A4")[0]
    assert image.shape == (10 * page.height, 10 * page.width)
    # The sheet's middle is where the mean of all discs is, the foot of the page left out.
    middle = np.array([page.width / 2, (page.height - targetprint.FOOT_MM) / 2])
    places = middle + 1000 * target.flat_points()
    np.testing.assert_allclose(dark_middles(image, places, 85), places, atol=0.01)
    radius = math.sqrt((255.0 - image[: round(10 * (page.height - 25))]).sum() / 255 / 100 / 44 / math.pi)
    assert radius == pytest.approx(1000 * target.radius_m, rel=2e-3)


def test_the_check_ruler_is_100_mm() -> None:
    image = raster(print_target(pf.Target("checkerboard", 8, 11, 0.02, margin_m=0.01)))
    foot = image[-100:]  # ten millimetres
    row = int(np.argmax((foot < 128).sum(1)))
    dark = np.flatnonzero(foot[row, :1080] < 200)  # the text stands behind
    assert abs(dark.max() - dark.min() + 1 - 1000) <= 4  # its line's ends are half a line wide


@pytest.mark.parametrize(
    "target",
    [pf.Target("charuco", 5, 7, 0.03, margin_m=0.01), pf.Target("sleeve", 4, 12, 0.018, diameter_m=0.065)],
    ids=lambda target: target.kind,
)
def test_what_is_black_on_paper_is_what_the_simulator_has_black(target: pf.Target) -> None:
    image = raster(print_target(target))
    page = pages(target, "A4")[0]
    tab = targetprint.TAB_MM if target.kind == "sleeve" else 0
    middle = np.array([(page.width - tab) / 2, (page.height - targetprint.FOOT_MM) / 2])
    albedo = np.full(image.shape, target.white)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    x, y = (u + 0.5) / 10 - middle[0], (v + 0.5) / 10 - middle[1]
    for round_, fx, fy, a, b, value in target.figures():
        row, col = (slice(*(round(10 * (1000 * f + m + s * 1000 * h)) + s for s in (-1, 1)))
                    for f, m, h in ((fy, middle[1], b), (fx, middle[0], a)))  # fmt: skip
        off_x, off_y = np.abs(x[row, col] / 1000 - fx) / a, np.abs(y[row, col] / 1000 - fy) / b
        albedo[row, col][np.hypot(off_x, off_y) < 1 if round_ else np.maximum(off_x, off_y) < 1] = value
    width, height = target.size_m
    on = (np.abs(x) < 500 * width - 1) & (np.abs(y) < 500 * height - 4)  # not the cut lines and their letters
    black = albedo < 0.5
    near_edge = np.zeros_like(black)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            near_edge |= np.roll(black, (down, right), (0, 1)) != black
    assert black[on].mean() > 0.1
    assert ((image < 128) == black)[on & ~near_edge].all()


def test_the_print_is_found_by_the_detector_with_its_own_description(tmp_path: Path) -> None:
    for kind in cli_target.GRIDS:
        out = tmp_path / f"{kind}.pdf"
        assert cli.main(["target", kind, "-o", str(out)]) == 0
        target = pf.Target.load(out.with_suffix(".json"))
        image = raster(out.read_bytes())
        rows, cols = (side // 5 for side in image.shape)
        image = image[: 5 * rows, : 5 * cols].reshape(rows, 5, cols, 5).mean((1, 3))
        found = pf.detect_target(image.round().astype(np.uint8), target)
        assert found.status == "ok" and len(found.ids) == len(target.points()), (kind, found.reason)
        steps = np.linalg.norm(np.diff(found.pixels, axis=0), axis=1) / 2
        expected = 1000 * np.linalg.norm(np.diff(target.flat_points(), axis=0), axis=1)
        np.testing.assert_allclose(steps, expected, atol=0.15)


def test_a_sleeve_goes_onto_several_sheets_that_meet_at_seams_between_columns() -> None:
    target = pf.Target("sleeve", 4, 20, 0.047, diameter_m=0.3)
    made = pages(target, "A4")
    assert len(made) > 2
    around = 1000 * math.pi * 0.3
    assert made[0].start == pytest.approx(-around / 2) and made[-1].end == pytest.approx(around / 2)
    for before, after in itertools.pairwise(made):
        assert before.end == after.start
    columns = 1000 * target.flat_points()[:20, 0]
    for page in made:
        assert np.abs(columns - page.end).min() > 1000 * target.radius_m
        assert page.end - page.start + targetprint.TAB_MM + 2 * targetprint.EDGE_MM <= page.width
    whole = pages(target, "1000x300")
    assert len(whole) == 1 and len(pypdfium2.PdfDocument(print_target(target, "1000x300"))) == 1


def test_the_default_fills_the_paper_and_fits_it() -> None:
    for kind in ("checkerboard", "circles", "asymmetric-circles", "charuco"):
        cols, rows = cli_target.GRIDS[kind]
        for paper in PAPERS:
            spacing = targetprint.fitting(kind, cols, rows, paper)
            pages(pf.Target(kind, rows, cols, spacing, margin_m=spacing / 2), paper)
            with pytest.raises(pf.ArgumentError, match="do not fit"):
                more = spacing + 0.001
                pages(pf.Target(kind, rows, cols, more, margin_m=more / 2), paper)


def test_the_default_checkerboard_and_asymmetric_circles_cannot_be_mistaken_when_turned() -> None:
    for kind in ("checkerboard", "asymmetric-circles"):
        assert sum(cli_target.GRIDS[kind]) % 2 == 1


def test_the_kinds_on_the_command_line_are_those_of_targets() -> None:
    assert cli_target.KINDS == KINDS


def test_the_same_target_gives_the_same_bytes() -> None:
    target = pf.Target("circles", 5, 6, 0.02)
    assert print_target(target) == print_target(target)


def test_the_document_tells_what_was_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "board.pdf"
    arguments = ["target", "checkerboard", "--grid", "11x8", "--spacing", "30mm", "--paper", "A3", "-o", str(out)]
    assert cli.main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["pages"] == 1 and document["target"]["cols"] == 11
    assert json.loads((tmp_path / "board.json").read_text())["format"] == "pipefish-target"
    assert pf.Target.load(document["json"]) == pf.Target.from_dict(document["target"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["checkerboard", "--spacing", "30"], "paper: 360 x 270 mm do not fit A4: --paper A3 or 370x295"),
        (["checkerboard", "--paper", "B5"], "paper: 'B5' is none of A0, A1"),
        (["checkerboard", "--paper", "10x900"], "sides must be 50 to 5000 mm"),
        (["circles", "--radius", "60", "--spacing", "20"], "radius_m: circles of 0.06 m touch"),
        (["sleeve"], "--diameter: a sleeve needs"),
        (["circles", "--diameter", "300"], "--diameter: is for a sleeve"),
        (["sleeve", "--diameter", "300", "--grid", "20x9"], "do not fit A4"),
    ],
)
def test_what_cannot_be_printed_is_refused_in_one_line(tmp_path, capsys, arguments, message) -> None:
    assert cli.main(["target", *arguments, "-o", str(tmp_path / "t.pdf")]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_wrong_name_or_form_of_argument_is_wrong_usage(tmp_path, capsys) -> None:
    assert cli.main(["target", "hexagons", "-o", str(tmp_path / "t.pdf")]) == 2
    assert cli.main(["target", "circles", "--grid", "nine", "-o", str(tmp_path / "t.pdf")]) == 2
    assert cli.main(["target", "circles", "-o", str(tmp_path / "t.png")]) == 1
    assert "must end in .pdf" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[]", "format: not a target"),
        ('{"format": "pipefish-target"}', "version: must be 1"),
        ('{"format": "pipefish-target", "version": 1, "kind": "circles", "rows": 3}', "cols: missing"),
        (
            '{"format": "pipefish-target", "version": 1, "kind": "circles", "rows": 3, "cols": 1, "spacing_m": 1}',
            "cols: must be a whole number from 2",
        ),
    ],
)
def test_a_damaged_description_is_refused_with_file_and_field(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "target.json"
    path.write_text(text)
    with pytest.raises(pf.FormatError, match=message) as error:
        pf.Target.load(path)
    assert str(path) in str(error.value)
