"""`pipefish calibrate`: from corner files and pictures to a profile, what it says, its report, and its refusals."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import re
import shutil

import numpy as np
import pytest
from PIL import Image

import calib_scenes as scenes
import pipefish as pf
from browser import ask_page
from device import Device
from pipefish import cli
from pipefish import pipefish_pb2 as pb
from pipefish.calib_data import CalibrationError
from pipefish.calib_input import Given, Picture, Target3D, load_target, load_views, natural
from pipefish.calib_live import Guide
from pipefish.calib_run import lit_around
from pipefish.calib_run import run as run_pictures
from pipefish.calib_settle import missed_share, places, settle, turns_of
from pipefish.calib_size import refuse_other_size
from pipefish.calib_verdict import verdict
from synthetic import BOOT, SURVEY, keyframe, start
from test_page import Outline, data_of

TARGET = pf.Target("checkerboard", 9, 12, 0.03)
LENS = scenes.Lens("equidistant", 1280, 960, 380.0, (640.0, 470.0), 1.0, (0.005, -0.001), math.radians(95))


def simulated(count: int = 14, noise: float = 0.1, seed: int = 4, lens: scenes.Lens = LENS, points=None):
    random = np.random.default_rng(seed)
    return scenes.views_of(random, lens, count, noise, points=TARGET.points() if points is None else points)[0]


def write_csv(path, views, prefix="v"):
    """view,x,y,z,u,v of numerical views."""
    lines = ["view,x,y,z,u,v"]
    for i, view in enumerate(views):
        for (x, y, z), (u, v) in zip(view.board_xyz, view.pixels, strict=True):
            lines.append(f"{prefix}{i},{x!r},{y!r},{z!r},{u!r},{v!r}".replace("np.float64(", "").replace(")", ""))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def target(tmp_path):
    TARGET.save(tmp_path / "board.json")
    return tmp_path / "board.json"


@pytest.fixture
def corners(tmp_path):
    return write_csv(tmp_path / "corners.csv", simulated())


def run(*arguments) -> int:
    return cli.main(["calibrate", *map(str, arguments)])


def test_corner_files_give_a_profile_with_all_that_is_known_about_it(tmp_path, target, corners, capsys):
    out = tmp_path / "camera.json"
    assert run(corners, "--target", target, "--size", "1280x960", "-o", out, "--model", "p9", "--serial", "A7") == 0
    text = capsys.readouterr().out
    assert "Usable for DN" in text and f"pipefish flash DEVICE {out}" in text and "held-out" in text
    camera = pf.Camera.load(out)
    assert camera.serial == "A7" and camera.source == "target" and camera.covariance is not None
    assert camera.provenance.views == 14 and camera.provenance.held_out_views == 14
    assert camera.rms_px == pytest.approx(0.1 * math.sqrt(2), rel=0.08)
    assert camera.rms_px < camera.held_out_rms_px < 1.1 * camera.rms_px
    assert abs(camera.f_u - 380) < 0.5 and abs(camera.c_v - 470) < 0.5


def test_json_tells_everything_and_nothing_else(tmp_path, target, corners, capsys):
    assert run(corners, "--size", "1280x960", "-o", tmp_path / "c.json", "--model", "p6", "--json") == 0
    document = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert document["files"] == {"camera": str(tmp_path / "c.json")}
    assert len(document["camera_from_board"]) == 14 and document["verdicts"]["camera"]["pipes"][0]["dn_mm"] == 100
    assert document["report"]["points"] == len(document["report"]["residuals"]["pixel"])


def test_point_numbers_mean_rows_of_the_target(tmp_path, target):
    path = tmp_path / "a.csv"
    path.write_text("# by hand\nview,point,u,v\nfirst, 0 ,10,20\nfirst,87,30,40\nfirst,5,1,2\nfirst,6,1,3\n")
    (view,) = load_views({"c": [path]}, [load_target(target)], (100, 100)).views
    np.testing.assert_array_equal(view.board_xyz, TARGET.points()[[0, 87, 5, 6]])
    np.testing.assert_array_equal(view.pixels, [[10, 20], [30, 40], [1, 2], [1, 3]])


def test_mrcal_corners_leave_out_what_was_not_found(tmp_path, target):
    rows = [f"x/img1.png {i} {2 * i} {'-' if i == 3 else -1 if i == 4 else 0}" for i in range(88)]
    path = tmp_path / "corners.vnl"
    path.write_text("## generated\n# filename x y level\n" + "\n".join([*rows, "x/img2.png - - -"]) + "\n")
    (view,) = load_views({"c": [path]}, [load_target(target)], (100, 200)).views
    assert view.name == "img1.png" and len(view.pixels) == 86
    np.testing.assert_array_equal(view.board_xyz[3], TARGET.points()[5])
    path.write_text("\n".join(rows[:80]))
    with pytest.raises(pf.FormatError, match=r"img1.png: 80 corners, the target has 88"):
        load_views({"c": [path]}, [load_target(target)], (100, 200))


def test_lists_of_babelcalib_are_in_centimetres(tmp_path):
    (tmp_path / "b.dsc").write_text("0,2,2,7.5\nt25h7,2.0\n-1,0,0,0.75,16.5,0\n-1,0,1,1.5,16.5,0\n")
    (tmp_path / "p.orpc").write_text("filename: p.png\nwidth: 64\nheight: 48\nnum_corners: 4\n" + "0,1,1,7.5,8\n" * 4)
    given = load_views({"c": [tmp_path / "p.orpc"]}, [load_target(tmp_path / "b.dsc")])
    assert given.sizes == [(64, 48)]
    np.testing.assert_allclose(given.views[0].board_xyz[0], [0.015, 0.165, 0])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("view,point,u\na,1,2\n", "line 1: columns view, point, u: must be"),
        ("view,point,u,v\na,88,2,3\n", "line 2: point: '88' is not a whole number below 88"),
        ("view,x,y,z,u,v\na,0,0,nan,2,3\n", "line 2: z: 'nan' is no number"),
        ("view,point,u,v\na,1,2\n", "line 2: 3 cells, the header has 4"),
    ],
)
def test_a_bad_corner_file_names_line_and_column(tmp_path, target, capsys, text, reason):
    (tmp_path / "bad.csv").write_text(text)
    assert run(tmp_path / "bad.csv", "--target", target, "--size", "100x100", "-o", tmp_path / "c.json") == 1
    error = capsys.readouterr().err
    assert reason in error and "bad.csv" in error and error.count("\n") == 1
    assert not (tmp_path / "c.json").exists()


def test_refusals_say_what_is_wrong_with_the_views(tmp_path, target, capsys):
    def refused(views, *more):
        path = write_csv(tmp_path / "x.csv", views)
        assert run(path, "--size", "1280x960", "-o", tmp_path / "c.json", "--model", "p9", *more) == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    views = simulated(8)
    assert "2 views are too few" in refused(views[:2])
    one = [pf.View(views[0].board_xyz, views[0].pixels + 0.01 * i) for i in range(5)]
    assert "pose" in refused(one)
    assert "lie outside the image" in refused([pf.View(v.board_xyz, v.pixels + np.array([900, 0])) for v in views])
    narrow = scenes.Lens("perspective", 1280, 960, 900.0, (640.0, 480.0), 1.0, (0.0, 0.0), math.radians(35))
    assert "two cameras" in refused([*simulated(12), *simulated(12, lens=narrow, seed=2)])
    assert "two cameras" in refused([*simulated(8), *simulated(8, lens=narrow, seed=9)])  # the common lens fits neither
    assert not (tmp_path / "c.json").exists()


def test_wrong_usage_is_told_before_anything_is_read(tmp_path, target, capsys):
    for arguments, reason in (
        ([], "give either VIEWS"),
        (["a/", "--device", "tcp://x:1"], "give either VIEWS"),
        (["a/"], "--target FILE is needed"),
        (["--camera", "one=a/", "--target", target], "at least two cameras"),
        (["a/", "--target", target, "--report", "r.pdf"], "must end in .html"),
        (["a/", "--target", target, "--recording", "r.mcap"], "--recording is for --device"),
    ):
        assert run(*arguments, "-o", tmp_path / "c.json") == 2
        assert reason in capsys.readouterr().err
    assert run("a.csv", "--target", target) == 2


def test_two_cameras_of_a_rig_get_a_profile_each_and_their_place(tmp_path, target, capsys):
    """The right camera is 20 cm to the right, turned 5 degrees: both see the same boards."""
    random = np.random.default_rng(3)
    right = np.column_stack([scenes.turn(np.array([0, math.radians(5), 0])), [-0.2, 0.01, 0.03]])
    left, other = [], []
    while len(left) < 12:
        pose = scenes.random_pose(random, TARGET.points(), LENS)
        x = TARGET.points() @ pose[:, :3].T + pose[:, 3]
        a, seen_a = LENS.project(x)
        b, seen_b = LENS.project(x @ right[:, :3].T + right[:, 3])
        if min(seen_a.sum(), seen_b.sum()) < 40:
            continue
        for into, pixels, seen in ((left, a, seen_a), (other, b, seen_b)):
            into.append(pf.View(TARGET.points()[seen], pixels[seen] + random.normal(0, 0.1, (seen.sum(), 2))))
    for name, views in (("left", left), ("right", other)):
        (tmp_path / name).mkdir()
        write_csv(tmp_path / name / "corners.csv", views)
    folders = [f"--camera={n}={tmp_path / n}" for n in ("left", "right")]
    out = tmp_path / "rig"
    assert run(*folders, "--target", target, "--size", "1280x960", "-o", out, "--model", "p9") == 0
    rig = json.loads((out / "rig.json").read_text())
    assert [c["name"] for c in rig["cameras"]] == ["left", "right"] and pf.Camera.load(out / "right.json").rms_px < 0.2
    np.testing.assert_allclose(rig["cameras"][1]["translation_m"], right[:, 3], atol=1e-3)
    half = math.radians(2.5)
    np.testing.assert_allclose(rig["cameras"][1]["quaternion_wxyz"], [math.cos(half), 0, math.sin(half), 0], atol=1e-3)


def test_another_size_is_told_only_where_most_pictures_show_it():
    board = pf.Target("checkerboard", 7, 10, 0.03)  # 9 x 6 inner corners
    refuse_other_size(board, [(13, 8), (9, 6), (9, 6), (9, 6)], "b")  # one picture of another board
    refuse_other_size(board, [(6, 5)] * 5 + [(9, 5), (8, 6), (7, 6), (7, 5)], "b")  # a board that is never whole
    refuse_other_size(board, [(13, 8)] * 3 + [(0, 0)] * 7, "b", least=5)  # ten looked at: the others may show the board
    with pytest.raises(CalibrationError, match="larger than described: 3 of 4"):
        refuse_other_size(board, [(13, 8)] * 3 + [(9, 6)], "b")
    with pytest.raises(CalibrationError, match="smaller than described: 4 of 4"):
        refuse_other_size(board, [(8, 5)] * 4, "b")


def test_the_verdict_follows_the_bounds_and_says_why():
    pipes = [
        {"dn_mm": 100, "sigma_mm": 0.5},
        {"dn_mm": 300, "sigma_mm": 0.1, "spread_mm": 0.4},
        {"dn_mm": 500, "sigma_mm": math.nan},
    ]
    camera = {
        "camera": 0,
        "pipes": pipes,
        "coverage": {"share_covered": 0.4, "advice": "next view: there"},
        "uncertainty": {"distance_m": 1.0},
        "halves": {"ratio": 2.0, "rms_px": 0.04, "expected_px": 0.02},
    }
    views = [{"used": True, "camera": 0, "points": 100}, {"used": False, "camera": 0, "points": 0}]
    report = {"cameras": [camera], "views": views, "rms_px": 0.2, "model": "p9", "models": [{"model": "p9"}]}
    found = verdict(report, 0.3, math.radians(50))
    given = verdict(report | {"models": []}, 0.3, math.radians(50))
    assert "noise alone" in given["text"] and "p9 was given" in given["cautions"][0] and "alone" not in found["text"]
    assert found["usable"] and (found["dn_from"], found["dn_to"]) == (300, 300)
    assert found["systematic_mm"] == pytest.approx(
        math.hypot(2.776 * 0.4, 0.3)
    )  # the jackknife's, Student's t of four degrees
    said = " ".join(found["cautions"])
    for words in (
        "fit worse",
        "50 degrees off the axis only",
        "only 40 % of the picture",
        "stood 1 m away",
        "1 of 2",
        "0.04 px",
    ):
        assert words in said
    assert "is in the bounds above" not in said  # without a spread they hold no such thing
    for pipe in pipes:
        pipe["spread_mm"] = 0.4
    assert "is in the bounds above" in " ".join(verdict(report, 0.3, math.radians(50))["cautions"])
    camera["pipes"] = [{"dn_mm": 300, "sigma_mm": 2.0}]
    worse = verdict(report, 0.2, math.radians(90))
    assert not worse["usable"] and "Not usable" in worse["text"] and "DN 300" in worse["text"]
    camera["pipes"] = pipes
    mixed = verdict(report | {"rms_px": 4.6}, 4.7, math.radians(90), bend=0.03)
    assert not mixed["usable"] and "of one camera" in mixed["text"] and "bends by 3.0 %" in " ".join(mixed["cautions"])


def test_files_are_taken_in_natural_order():
    assert sorted(["img10.png", "img2.png", "img1.png", "a.png"], key=natural) == [
        "a.png",
        "img1.png",
        "img2.png",
        "img10.png",
    ]


# ---------------------------------------------------------------------- pictures and the report


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A folder of simulated pictures of a board, one of them without it; the target; the simulator's focal length."""
    folder = tmp_path_factory.mktemp("shots")
    board = pf.Target("checkerboard", 6, 9, 0.03)
    views, truth = pf.simulate_target_views(
        board, {"preset": "fisheye-185", "width": 480, "height": 360}, 9, samples=34, seed=6, clutter=False
    )
    for i, view in enumerate(views):
        Image.fromarray(view.image).save(folder / f"shot{i}.png")
    Image.fromarray(np.full((360, 480), 90, dtype=np.uint8)).save(folder / "shot20.png")
    board.save(folder.parent / "small.json")
    return folder, folder.parent / "small.json", truth


@pytest.fixture(scope="module")
def made(pictures, tmp_path_factory):
    """What --json says of them, the profile and the page."""
    folder, target, _ = pictures
    here = tmp_path_factory.mktemp("made")
    arguments = [folder, "--target", target, "-o", here / "c.json", "--report", here / "r.html", "--model", "p9"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert run(*arguments, "--name", "<Lens & Co>", "--json") == 0
    return json.loads(said.getvalue()), here / "c.json", here / "r.html"


def test_pictures_become_a_profile(pictures, made):
    document, profile, _ = made
    assert [p["status"] for p in document["pictures"]].count("none") == 1 and document["pictures"][-1]["reason"]
    table = pictures[2]["lens"]
    focal = table["radius_px"][1] / table["theta"][1]
    assert pf.Camera.load(profile).f_u == pytest.approx(focal, rel=0.01)
    assert document["rms_px"] < 0.3


def test_the_report_stands_alone_and_shows_what_was_left_out(made):
    text = made[2].read_text(encoding="utf-8")
    outline = Outline(text)
    assert not outline.open and all(a.startswith("data:") for a in outline.addresses)
    assert ["plot-" + c["id"] for c in data_of(text)["charts"]] == outline.charts and len(outline.charts) == 6
    assert "&lt;Lens &amp; Co&gt;" in text and "<Lens" not in text
    assert re.search(r"<img [^>]*left out[^>]*><figcaption>shot20.png: ", text)
    straight = [float(x) for x in re.findall(r"straight within ([0-9.]+) px", text)]
    assert len(straight) == 2 and max(straight) < 0.5


def test_the_report_draws_in_a_browser(made, tmp_path):
    drawn = "p.querySelectorAll('.main-svg path[d^=M], .main-svg image').length"
    script = f"return Object.fromEntries([...document.querySelectorAll('.plot')].map((p) => [p.id, {drawn}]))"
    found = ask_page(made[2], script, 1200, tmp_path)
    assert list(found) == ["plot-" + c["id"] for c in data_of(made[2].read_text(encoding="utf-8"))["charts"]]
    assert all(found.values()), found


def test_pictures_that_do_not_go_together_are_refused(pictures, tmp_path, capsys):
    folder, target, _ = pictures

    def refused(source, description=target):
        assert run(source, "--target", description, "-o", tmp_path / "c.json") == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        return error

    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for i in range(3):
        shutil.copy(folder / f"shot{i}.png", mixed)
    pf.Target("circles", 12, 14, 0.03).save(tmp_path / "other.json")
    error = refused(mixed, tmp_path / "other.json")
    assert "found in 0 of 3 pictures" in error and "Is it the target that --target describes?" in error
    Image.fromarray(np.zeros((300, 400), dtype=np.uint8)).save(mixed / "shot0b.png")
    error = refused(mixed)
    assert "shot0b.png: 400 x 300 pixels, 3 of 4 pictures have 480 x 360" in error and "two cameras" in error
    (mixed / "shot0b.png").write_bytes(b"no picture")
    assert "shot0b.png: not a picture" in refused(mixed)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no pictures" in refused(empty)


@pytest.mark.parametrize(
    ("squares", "words"),
    [
        ((5, 8), ["larger than described", "6 x 9 squares", "inner corners were given as --grid", "--grid 6x9"]),
        ((11, 8), ["smaller than described", "8 x 5 inner corners (9 x 6 squares)", "described are 10 x 7 inner"]),
    ],
)
def test_a_board_of_another_size_is_told_with_what_to_type(pictures, tmp_path, capsys, squares, words):
    """Squares for inner corners, exchanged too; a larger and a smaller board."""
    for i in range(3):
        shutil.copy(pictures[0] / f"shot{i}.png", tmp_path)
    pf.Target("checkerboard", squares[1], squares[0], 0.03).save(tmp_path / "other.json")
    assert run(tmp_path, "--target", tmp_path / "other.json", "-o", tmp_path / "c.json") == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(w in error for w in words), error


def test_which_size_a_target_has_is_told_by_half_of_the_pictures_not_by_parts_of_it():
    def refuse(kind, cols, rows, seen):
        refuse_other_size(pf.Target(kind, rows, cols, 0.04), seen, "mine")

    refuse("circles", 7, 7, [(7, 7), (6, 7), (5, 5), (0, 0)])
    refuse("circles", 9, 8, [(7, 7), (6, 7), (5, 5), (4, 8)])  # parts, each another one
    refuse("circles", 9, 8, [(7, 7), (7, 7), (7, 7), (9, 8)])  # once it was seen whole
    refuse("checkerboard", 9, 6, [(5, 8), (5, 8), (5, 8)])  # turned
    refuse("charuco", 9, 6, [(3, 3)] * 9)
    refuse("asymmetric-circles", 4, 11, [(4, 11), (6, 8), (6, 8)])  # their lattice turned by 90 degrees looks the same
    with pytest.raises(
        CalibrationError, match=r"smaller than described: 3 of 5 pictures show 7 x 7 circles, .* --grid 7x7"
    ):
        refuse("circles", 9, 8, [(7, 7), (7, 7), (7, 7), (5, 5), (0, 0)])
    with pytest.raises(CalibrationError, match=r"not the one described: 3 of 3 .*--grid 9x6"):
        refuse("checkerboard", 12, 5, [(5, 8)] * 3)
    with pytest.raises(
        CalibrationError, match=r"Columns and rows are exchanged.*--grid 4x11 --spacing 40 -o mine.json"
    ):
        refuse("asymmetric-circles", 11, 4, [(4, 11)] * 3)


def test_copies_of_a_picture_are_left_out_and_named(pictures, tmp_path, capsys):
    folder, target, _ = pictures
    names = ("a.png", "b.png", "c.png", "d.png", "e.png")
    for name, shot in zip(names, (0, 1, 2, 0, 0), strict=True):
        shutil.copy(folder / f"shot{shot}.png", tmp_path / name)
    given = load_views({"camera": [tmp_path]}, [load_target(target)])
    assert [p.name for p in given.pictures] == ["a.png", "b.png", "c.png"]
    assert given.copies == [(0, "d.png", "a.png"), (0, "e.png", "a.png")]
    same = [tmp_path / n for n in ("a.png", "d.png", "e.png")]
    assert run(*same, "--target", target, "-o", tmp_path / "c.json") == 1
    error = capsys.readouterr().err
    assert "only 1 different picture: d.png is the same picture as a.png; e.png is the same picture as a.png" in error


def test_one_or_two_pictures_are_told_to_be_too_few(pictures, tmp_path, capsys):
    folder, target, _ = pictures
    assert run(folder / "shot0.png", folder / "shot1.png", "--target", target, "-o", tmp_path / "c.json") == 1
    assert "found in 2 of 2 pictures; at least 3 are needed, better 15" in capsys.readouterr().err


def test_what_cannot_be_written_is_told_before_the_work(pictures, tmp_path, capsys):
    folder, target, _ = pictures
    for more, words in (
        (["-o", tmp_path / "no" / "c.json"], "there is no folder"),
        (["-o", tmp_path / "c.json", "--report", tmp_path / "no" / "r.html"], "there is no folder"),
        (["-o", target], "is what it calibrates from"),
    ):
        assert run(folder, "--target", target, *more) == 2
        assert words in capsys.readouterr().err
    assert load_target(target).target


def test_a_device_that_is_not_there_leaves_no_folder(tmp_path, target, capsys):
    assert run("--device", "tcp://127.0.0.1:1", "--timeout", 0.5, "--target", target, "-o", tmp_path / "c.json") == 1
    assert "no device answers on tcp://127.0.0.1:1" in capsys.readouterr().err
    assert not (tmp_path / "c-shots").exists()


def test_a_wrong_spacing_changes_lengths_and_no_angle_as_is_said(made, pictures):
    """Checked on the calibration itself: a target and its views may be scaled together."""
    views = simulated(8)
    one = pf.calibrate(views, image_size=(1280, 960), model="p9")
    other = pf.calibrate([pf.View(v.board_xyz * 1.01, v.pixels) for v in views], image_size=(1280, 960), model="p9")
    rays = [
        c.unproject(np.array([[100.0, 500.0], [640.0, 400.0], [900.0, 800.0]]))[0] for c in (one.camera, other.camera)
    ]
    np.testing.assert_allclose(rays[0], rays[1], atol=1e-6)
    np.testing.assert_allclose(other.poses[0][:, 3], 1.01 * one.poses[0][:, 3], rtol=1e-4)
    assert "small's spacing of 30 mm" in made[0]["scale"] and "angles stay right" in made[0]["scale"]
    assert "small&#x27;s spacing of 30 mm" in made[2].read_text(encoding="utf-8")


def test_a_target_that_is_not_there_is_known_after_a_few_pictures():
    """Every picture of a folder was searched to the end: minutes, to say that the board is another one."""
    board = pf.Target("checkerboard", 6, 9, 0.03)
    opened = []

    def blank(i):
        opened.append(i)
        return np.full((60, 80), 90, dtype=np.uint8)

    pictures = [Picture(f"p{i}", 0, f"p{i}", lambda i=i: blank(i)) for i in range(60)]
    given = Given(["camera"], [Target3D("b", board.points(), 0.0, board)], pictures, [], [(80, 60)])
    with pytest.raises(CalibrationError, match="none of 40 pictures, taken evenly from all 60"):
        run_pictures(given, model="p9", board="flat", tell=lambda *_: None)
    assert len(opened) == 40 and max(np.diff(sorted(opened))) <= 6


def test_an_ambiguous_picture_is_settled_by_a_first_model():
    """The picture's edge, or the lens's, cuts a grid of discs: a model tells where it would show more of them."""
    board = pf.Target("circles", 6, 8, 0.03)
    seen, _ = pf.simulate_target_views(
        board, {"preset": "fisheye-185", "width": 480, "height": 360}, 8, samples=34, seed=1
    )
    pictures = [Picture(f"p{i}", 0, f"p{i}", lambda v=v: v.image) for i, v in enumerate(seen)]
    assert pf.detect_target(seen[4].image, board).status == "ambiguous"
    target = Target3D("dots", board.points(), board.radius_m, board)
    session = run_pictures(
        Given(["camera"], [target], pictures, [], [(480, 360)]), model="p9", board="flat", tell=lambda *_: None
    )
    found = next(s for s in session.sightings if s.picture.name == "p4")
    assert found.status == "partial" and len(found.ids) > 20 and not session.unseen
    turned = len(board.points()) - 1 - found.ids  # the whole looks the same turned by 180 degrees
    off = [np.linalg.norm(found.pixels - seen[4].centroids[ids], axis=1).max() for ids in (found.ids, turned)]
    assert min(off) < 1.0


def test_a_part_of_a_grid_may_lie_wherever_its_colours_do():
    """A square grid looks the same after quarter turns; a checkerboard's corners exchange their colours then."""
    dots = pf.Target("circles", 5, 5, 0.03)  # 12 places of 3 x 2, turned four ways, and four of all 48 are one
    assert turns_of(dots) == [0, 1, 2, 3] and len(places(dots, np.array([0, 1, 2, 5, 6, 7]))) == 12
    oblong = pf.Target("circles", 5, 7, 0.03)  # 20 places along, 18 across, each turned two ways, which are one
    assert len(places(oblong, np.array([0, 1, 2, 7, 8, 9]))) == 38
    board = pf.Target("checkerboard", 7, 9, 0.03)  # corners 6 x 8
    cols = board.points_shape[0]
    found = places(board, np.array([0, 1, 2, cols, cols + 1, cols + 2]))
    code = board.lattice()[0].sum(axis=1) % 2
    for ids in found:
        xy = board.points()[ids, :2]
        along, down = xy[1] - xy[0], xy[3] - xy[0]
        assert along[0] * down[1] - along[1] * down[0] > 0  # never mirrored
        assert code[ids[0]] == (0 if abs(along[1]) < 1e-9 else 1)  # a quarter turn exchanges the colours
    assert len({tuple(i) for i in map(tuple, found)}) == len(found)


def test_a_place_that_is_no_better_than_another_is_refused():
    """Corners of the middle of a large board, in a picture that ends with them: nothing tells which."""
    board = pf.Target("circles", 9, 9, 0.03)
    views, _ = scenes.views_of(np.random.default_rng(3), LENS, 8, 0.1, points=board.points())
    first = pf.calibrate(views, (1280, 960), "p9", "flat")
    part = np.array([10, 11, 12, 13, 19, 20, 21, 22, 28, 29, 30, 31])
    pixels = np.stack([600 + 20.0 * (part % 9), 400 + 20.0 * (part // 9)], axis=1)
    blank = np.full((960, 1280), 128, dtype=np.uint8)
    found, why = settle(blank, board, part, pixels, first, 0.05, 0.05)
    assert found is None and "places" in why


def test_something_before_the_target_is_known_by_misses_that_come_together():
    """As independent misses half a covered board spoke a thousandfold for a wrong place on which it would be unseen."""
    board = pf.Target("circles", 9, 9, 0.03)
    views, _ = scenes.views_of(np.random.default_rng(3), LENS, 8, 0.1, points=board.points())
    first = pf.calibrate(views, (1280, 960), "p9", "flat")
    target = Target3D("dots", board.points(), board.radius_m, board)
    missed, covered = missed_share(first, views, [target])
    assert missed == pytest.approx(0.02) and covered == pytest.approx(0.5 / 13)
    half = [
        dataclasses.replace(v, board_xyz=v.board_xyz[40:], pixels=v.pixels[40:]) if i % 2 else v
        for i, v in enumerate(views)
    ]
    missed, covered = missed_share(first, half, [target])
    assert missed == pytest.approx(0.02) and covered == pytest.approx(4.5 / 13)  # four of eight


def test_points_of_the_target_lie_inside_the_image_circle():
    v, u = np.mgrid[:480, :640]
    lit = np.where(np.hypot(u - 325.3, v - 236.8) < 225.4, 160, 6).astype(np.uint8)
    views = [pf.View(np.eye(3)[:2], [[325.3, 236.8], [325.3, 30.8]])]
    np.testing.assert_allclose(lit_around(lit, views).circle, [325.3, 236.8, 225.4], atol=1.0)
    views.append(pf.View(np.eye(3)[:2], [[325.3, 236.8], [325.3, 10.8]]))
    assert lit_around(lit, views).a == pytest.approx(228, abs=1)
    assert lit_around(np.full((480, 640), 90, dtype=np.uint8), views) is None


# ---------------------------------------------------------------------- from a device


def stills_of(folder, exposures: int = 1) -> list[bytes]:
    """Each picture of a folder as a still, twice, as of a target held still for a moment; the first thrice. exposures:
    different ones, until the last stays."""
    files = sorted(folder.iterdir(), key=lambda p: natural(p.name))
    messages = []
    for i, path in enumerate([files[0], *(f for f in files for _ in range(2))]):
        pixels = np.array(Image.open(path))
        frame = pb.RawFrame(frame_sequence=i, width=480, height=360, encoding="mono8", pixels=pixels.tobytes())
        frame.time.boot_id = BOOT
        frame.telemetry.exposure_us = 1000 * min(i // 2 + 1, exposures)
        messages.append(frame.SerializeToString())
    return messages


def test_a_device_is_calibrated_from_stills_and_they_are_kept(pictures, tmp_path, capsys):
    folder, target, _ = pictures
    out = tmp_path / "c.json"
    with Device([start(), keyframe(0)], SURVEY, state="surveying", stills=stills_of(folder)) as device:
        arguments = ["--device", device.address, "--target", target, "-o", out, "--model", "p9"]
        assert run(*arguments) == 0
        assert sorted(kind for kind, _ in device.spool.values() if kind != 5) == [1, 2]  # the survey is still there
    text = capsys.readouterr()
    assert f"pipefish flash {device.address} {out}" in text.out
    lines = text.err.splitlines()
    assert lines[0] == "frame 0: hold the target still"
    assert "frame 1: view 1, " in lines[1] and "next: " in lines[1]
    assert lines[2] == "frame 2: seen; move the target to another place"
    assert "exposure or gain" not in text.err
    assert pf.Camera.load(out).provenance.views == 9
    kept = tmp_path / "c-shots"
    assert len(list(kept.glob("shot*.png"))) == 9
    first = np.array(Image.open(folder / "shot0.png"))
    np.testing.assert_array_equal(np.array(Image.open(kept / "shot1.png")), first)
    assert run(*arguments) == 2 and "calibrate from it" in capsys.readouterr().err


def test_views_of_different_exposures_are_warned_of(pictures, tmp_path, capsys):
    folder, target, _ = pictures
    with Device([], SURVEY, state="surveying", stills=stills_of(folder, 2)) as device:
        assert run("--device", device.address, "--target", target, "-o", tmp_path / "c.json", "--model", "p9") == 0
    views = [line for line in capsys.readouterr().err.splitlines() if ": view " in line]
    assert ["exposure or gain changes" in line for line in views] == [False] + [True] * 8


def test_a_device_that_shows_no_target_is_told_so(tmp_path, target, capsys):
    frame = pb.RawFrame(width=64, height=48, encoding="mono8", pixels=bytes(64 * 48)).SerializeToString()
    with Device([], SURVEY, state="surveying", stills=[frame]) as device:
        assert run("--device", device.address, "--target", target, "-o", tmp_path / "c.json") == 1
    assert re.search("0 views with the target came from the device .*the survey is over", capsys.readouterr().err)


def test_guidance_points_where_nothing_was_seen(target):
    guide = Guide([load_target(target)], (800, 500))
    x, y = np.meshgrid(np.linspace(5, 795, 40), np.linspace(5, 495, 40))
    seen = np.stack([x, y], axis=-1).reshape(-1, 2)
    seen = seen[~((seen[:, 0] > 700) & (seen[:, 1] > 400))]
    guide.views = [pf.View(np.random.default_rng(1).normal(size=(len(seen), 3)), seen)]
    guide.names = ["a"]
    guide._think()
    assert guide.advice == "next: bottom right of the picture, tilted" and guide.seen == pytest.approx(39 / 40)
    assert guide.map_text().splitlines()[-1].endswith("  ")
