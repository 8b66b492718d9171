"""Views: straight lines are straight, faces meet, nothing is aliased or shifted, the unseen is black and masked."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish import cli, views
from pipefish.errors import PipefishError
from pipefish.undistort import undistort


@pytest.fixture(scope="module")
def camera():
    return pf.Camera(
        width=640, height=480, f_u=178.0, f_v=177.0, c_u=322.0, c_v=237.0, theta_max=math.radians(105),
        k2=-0.02, k3=0.004, k4=-0.001, asym_radial_theta=(0.004, 0, 0), asym_radial_phi=(0.6, 0.8, 0, 0),
        circle_u=322.0, circle_v=237.0, circle_radius=300.0, name="bent",
    )  # fmt: skip


def see(camera, shade):
    """The picture that the camera takes of a smooth world whose brightness in direction (N, 3) is shade."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays, ok = camera.unproject(np.stack([x, y], axis=-1).reshape(-1, 2))
    value = np.where(ok, shade(np.nan_to_num(rays)), 0).reshape(camera.height, camera.width)
    return np.rint(np.clip(value, 0, 255)).astype(np.uint8)


def on_plane(rays, edge):
    """A board 1 m in front: dark left of the line, bright right of it, a ramp of 0.1 m between."""
    with np.errstate(all="ignore"):
        x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    return np.where(rays[:, 2] > 0.05, np.clip(125 + 2000 * edge(x, y), 25, 225), 25.0)


def shade(r):
    """A smooth world all around."""
    return 128 + 60 * np.sin(5 * r[:, 0] + 1) * np.cos(4 * r[:, 1]) + 40 * r[:, 2]


@pytest.fixture(scope="module")
def world(camera):
    return see(camera, shade)


def test_lines_of_a_board_are_straight_in_a_perspective_view(camera):
    """A slanted edge, found in each row to a fraction of a pixel, lies on one line; in the fisheye picture it bends."""
    slope, offset = 0.21, 0.83  # the line bulges by tens of pixels here
    picture = see(camera, lambda r: on_plane(r, lambda x, y: x - slope * y - offset))
    table = views.remap(camera, views.perspective_rays(500, 400, 110))
    flat = table.apply(picture).astype(float)
    assert table.valid.all()

    def edge_columns(image, rows):
        found = []
        for row in rows:
            up = np.flatnonzero((image[row, :-1] < 125) & (image[row, 1:] >= 125))
            assert len(up) == 1
            a, b = image[row, up[0]], image[row, up[0] + 1]
            found.append(up[0] + (125 - a) / (b - a))
        return np.array(found)

    rows = np.arange(10, 390)
    columns = edge_columns(flat, rows)
    line = np.polyfit(rows, columns, 1)
    assert np.abs(columns - np.polyval(line, rows)).max() < 0.1
    f = 250 / math.tan(math.radians(55))
    assert line[0] == pytest.approx(slope, abs=1e-4)
    middle = np.polyval(line, 199.5)
    assert middle == pytest.approx(249.5 + f * offset, abs=0.03)  # and it is where the board's line is
    bent_rows = np.arange(120, 360)
    bent = edge_columns(picture.astype(float), bent_rows)
    assert np.abs(bent - np.polyval(np.polyfit(bent_rows, bent, 1), bent_rows)).max() > 3


def test_cube_faces_meet_and_show_their_directions(camera):
    edge = 120
    rays, corners = views.cube_rays(edge)
    assert np.isnan(rays[:edge, :edge]).all() and list(corners) == ["up", "left", "front", "right", "down"]
    middle = {n: rays[r + edge // 2, c + edge // 2] / np.linalg.norm(rays[r + edge // 2, c + edge // 2])
              for n, (c, r) in corners.items()}  # fmt: skip
    for name, direction in {"up": (0, -1, 0), "left": (-1, 0, 0), "front": (0, 0, 1), "right": (1, 0, 0)}.items():
        assert middle[name] @ direction > 0.999, name
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    across = np.linalg.norm(np.diff(unit[edge + 30], axis=0), axis=-1)  # along a row: left, front, right
    assert across.max() < 1.1 * 2 / edge and across.min() > 0  # no gap and no jump at the seams
    table = views.remap(camera, rays)
    assert table.valid[edge : 2 * edge, edge : 2 * edge].all() and not table.valid[:edge, :edge].any()
    assert table.count[table.valid].max() <= 5  # a radian around the axis is 280 px; a seam would look like 16


@pytest.mark.parametrize(("kind", "fov"), [("perspective", 100), ("cylinder", 170), ("equirect", 170), ("cube", 90)])
@pytest.mark.parametrize("turn", [(0, 0, 0), (15, -10, 30)])
def test_every_view_shows_the_world_where_its_rays_point(camera, world, kind, fov, turn):
    """Each valid pixel has the brightness of its own ray."""
    rays, turn = views.view_rays(kind, 200, 150, fov), views.rotation(*turn)
    table = views.remap(camera, rays, turn)
    got = table.apply(world)[table.valid].astype(float)
    unit = rays[table.valid] / np.linalg.norm(rays[table.valid], axis=-1, keepdims=True)
    expected = shade(unit @ turn.T)
    inner = np.abs(got - expected) < 3
    assert table.valid.sum() > 5000 and inner.mean() > 0.97  # the rest touches the black rim


@pytest.mark.parametrize(("kind", "fov"), [("perspective", 100), ("cylinder", 300), ("equirect", 170)])
def test_the_vertical_field_of_view_is_that_of_the_rays(kind, fov):
    """Between the outer edges of the first and the last row: half a row beyond their centres."""
    rays = views.view_rays(kind, 301, 201, fov)[:, 150]
    angle = np.arctan2(rays[:, 1], rays[:, 2])
    if kind == "equirect":
        expected = (angle[-1] - angle[0]) * 201 / 200
    else:
        expected = 2 * np.arctan(np.tan(angle[-1]) * 201 / 200)
    assert views.vertical_fov(kind, 301, 201, fov) == pytest.approx(np.degrees(expected), rel=1e-12)


def test_the_python_page_is_true(tmp_path, monkeypatch):
    """Its examples run, and the names in its tables exist."""
    root = Path(__file__).resolve().parents[2]
    page = (root / "docs" / "python.md").read_text()
    code = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(re.sub(r'"(calib_profiles|tests)/', rf'"{root}/\1/', code), names)
    assert names["ok"].tolist() == [True, True, False] and np.isnan(names["pixels"][2]).all()
    assert names["loaded"].form == "kalibr" and (tmp_path / "cameras.txt").exists()
    assert names["flat"].shape == (480, 640) and names["table"].valid.any()
    fields = {field.name for field in dataclasses.fields(pf.Camera)}
    for name in re.findall(r"(?:amera|, `|`)\.(\w+)", "".join(re.findall(r"^\| `.*$", page, re.MULTILINE))):
        assert hasattr(pf.Camera, name) or name in fields, name


def test_turns_are_right_up_and_clockwise():
    forward = np.array([0, 0, 1.0])
    assert views.rotation(30, 0, 0) @ forward == pytest.approx([0.5, 0, math.cos(math.pi / 6)])
    assert views.rotation(0, 30, 0) @ forward == pytest.approx([0, -0.5, math.cos(math.pi / 6)])
    assert views.rotation(0, 0, 90) @ [1.0, 0, 0] == pytest.approx([0, 1, 0])


def test_shrinking_does_not_alias(camera):
    """Fine stripes become their mean, and do not beat against the view's pixels."""
    v, u = np.mgrid[0:480, 0:640]
    stripes = np.where((u + v) % 4 < 2, 255, 0).astype(np.uint8)
    table = views.remap(camera, views.perspective_rays(48, 36, 110))
    assert table.count.min() >= 5
    small = table.apply(stripes)[table.valid].astype(float)
    assert abs(small.mean() - 127.5) < 2 and small.std() < 8
    single = dataclasses.replace(table, count=np.ones_like(table.count))
    assert single.apply(stripes)[table.valid].std() > 60  # what one sample a pixel would give


@pytest.mark.parametrize("pattern", ["columns", "rows", "checks"])
def test_shrinking_a_large_picture_fifty_times_does_not_alias(pattern):
    """Stripes of one pixel become their mean in a view 80 pixels wide of a picture 4000 wide."""
    camera = pf.Camera(
        width=4000, height=3000, f_u=1400.0, f_v=1400.0, c_u=1999.5, c_v=1499.5, theta_max=1.6, radial="equidistant"
    )
    v, u = np.mgrid[0:3000, 0:4000]
    bright = {"columns": u % 2, "rows": v % 2, "checks": (u + v) % 2}[pattern]
    table = views.remap(camera, views.perspective_rays(80, 60, 100))
    assert table.level.min() >= 1 and table.valid.all()
    small = table.apply((bright * 255).astype(np.uint8)).astype(float)
    assert np.abs(small - 127.5).max() < 1


def test_halved_pictures_are_not_shifted():
    """The middle of a soft blob stays where its ray is, at every level, on sides that do not halve evenly."""
    camera = pf.Camera(
        width=1999, height=1501, f_u=1400.0, f_v=1400.0, c_u=999.0, c_v=750.0, theta_max=1.2, radial="perspective"
    )
    v, u = np.mgrid[0:1501, 0:1999]
    blob = np.rint(255 * np.exp(-((u - 1207.0) ** 2 + (v - 611.0) ** 2) / (2 * 150.0**2))).astype(np.uint8)
    for width, halved in ((99, 1), (60, 2), (30, 3)):
        table = views.remap(camera, views.perspective_rays(width, width * 3 // 4, 70))
        assert table.level.max() == halved
        small = table.apply(blob).astype(float)
        middle = (small[..., None] * table.uv).sum(axis=(0, 1)) / small.sum()
        np.testing.assert_allclose(middle, [1207, 611], atol=1.0)


def test_an_unscaled_view_returns_the_picture():
    """A perspective camera through its own perspective view: the same pixels to the grey level."""
    f = 300.0
    cam = pf.Camera(width=320, height=240, f_u=f, f_v=f, c_u=159.5, c_v=119.5, theta_max=0.6, radial="perspective")
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 256, (240, 320, 3), dtype=np.uint8)
    fov = 2 * math.degrees(math.atan(160 / f))
    table = views.remap(cam, views.perspective_rays(320, 240, fov))
    assert table.valid.all() and (table.count == 1).all()
    np.testing.assert_array_equal(table.apply(picture), picture)


def test_a_shifted_pupil_is_exact_at_the_distance(camera):
    near = dataclasses.replace(camera, pupil_e1=-0.002)
    rays = views.perspective_rays(60, 40, 120)
    unit = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    for distance in (0.15, 2.0):
        table = views.remap(near, rays, distance=distance)
        expected, _ = near.project(distance * unit)
        np.testing.assert_allclose(table.uv.reshape(-1, 2), expected, atol=1e-9)
    gap = np.abs(views.remap(near, rays, distance=0.15).uv - views.remap(near, rays).uv).max()
    assert gap > 0.5  # pixels: why the distance is asked for


def test_views_that_make_no_sense_are_refused(camera):
    for call in (
        lambda: views.perspective_rays(10, 10, 180),
        lambda: views.equirect_rays(10, 10, 200),
        lambda: views.cylinder_rays(10, 10, 0),
        lambda: views.view_rays("fish", 10, 10, 90),
        lambda: views.view_rays("cube", 0, 0, 90),
        lambda: views.remap(camera, views.perspective_rays(4, 4, 90), distance=0.0),
        lambda: views.remap(camera, views.perspective_rays(4, 4, 90)).apply(np.zeros((480, 640))),
    ):
        with pytest.raises(PipefishError):
            call()


# ---- the command


@pytest.fixture
def files(camera, tmp_path):
    camera.save(tmp_path / "camera.json")
    rng = np.random.default_rng(2)
    grey = rng.integers(0, 256, (480, 640), dtype=np.uint8)
    Image.fromarray(grey).save(tmp_path / "grey.png")
    folder = tmp_path / "folder"
    folder.mkdir()
    for name in ("b.png", "a.png"):
        Image.fromarray(np.stack([grey] * 3, axis=-1)).save(folder / name)
    (folder / "notes.txt").write_text("no picture")
    with open(tmp_path / "mono.y4m", "wb") as out:
        out.write(b"YUV4MPEG2 W640 H480 F20:1 Ip A1:1 Cmono\n")
        for i in range(3):
            out.write(b"FRAME\n" + np.roll(grey, i, axis=1).tobytes())
    with open(tmp_path / "colour.y4m", "wb") as out:
        out.write(b"YUV4MPEG2 W640 H480 F20:1 C420jpeg\n")
        for _ in range(2):
            out.write(b"FRAME\n" + grey.tobytes() + bytes([90]) * 76800 + bytes([170]) * 76800)
    return tmp_path


def run(*arguments):
    return cli.main(["undistort", *map(str, arguments)])


def test_command_writes_picture_mask_folder_and_recording(files, camera, capsys):
    table = views.remap(camera, views.perspective_rays(100, 80, 100))
    grey = np.asarray(Image.open(files / "grey.png"))
    common = ["--profile", files / "camera.json", "--fov", 100, "--size", "100x80"]
    assert run(files / "grey.png", "-o", files / "o.png", *common, "--mask", files / "m.png", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["width"], document["height"], document["pictures"]) == (100, 80, 1)
    np.testing.assert_array_equal(np.asarray(Image.open(files / "o.png")), table.apply(grey))
    assert (np.asarray(Image.open(files / "m.png")) == 255 * table.valid).all()

    assert run(files / "folder", "-o", files / "out", *common) == 0
    assert sorted(p.name for p in (files / "out").iterdir()) == ["a.png", "b.png"]
    assert np.asarray(Image.open(files / "out" / "a.png")).shape == (80, 100, 3)

    assert run(files / "mono.y4m", "-o", files / "o.y4m", *common) == 0
    data = (files / "o.y4m").read_bytes()
    header, rest = data.split(b"\n", 1)
    assert header == b"YUV4MPEG2 W100 H80 F20:1 Ip A1:1 Cmono" and len(rest) == 3 * (6 + 8000)
    last = np.frombuffer(rest[-8000:], dtype=np.uint8).reshape(80, 100)
    np.testing.assert_array_equal(last, table.apply(np.roll(grey, 2, axis=1)))

    assert run(files / "colour.y4m", "-o", files / "c.y4m", *common) == 0
    rest = (files / "c.y4m").read_bytes().split(b"\n", 1)[1]
    assert len(rest) == 2 * (6 + 12000)
    assert set(rest[6 + 8000 : 6 + 10000]) == {90} and set(rest[6 + 10000 : 6 + 12000]) == {170}


def test_command_takes_other_programs_calibrations(files, capsys):
    text = (
        "cam0:\n  camera_model: pinhole\n  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  distortion_model: equidistant\n"
        "  intrinsics: [178.0, 177.0, 322.0, 237.0]\n  resolution: [640, 480]\n"
    )
    (files / "chain.yaml").write_text(text)
    assert run(files / "grey.png", "-o", files / "o.png", "--profile", files / "chain.yaml", "--view", "cube") == 0
    assert Image.open(files / "o.png").size == (720, 720)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("small.png", None, "640 x 480"),
        ("junk.png", b"junk", "not a picture"),
        ("cut.y4m", b"YUV4MPEG2 W640 H480 Cmono\nFRAME\n123", "frame 0: cut off"),
        ("depth.y4m", b"YUV4MPEG2 W640 H480 Cmono16\n", "Cmono16"[1:]),
        ("other.y4m", b"RIFF", "not a Y4M file"),
        ("size.y4m", b"YUV4MPEG2 W64 H48 Cmono\n", "64 x 48"),
        ("none.y4m", b"YUV4MPEG2 W640 H480 Cmono\n", "no frames"),
        ("absent.png", "absent", "No such file"),
    ],
)
def test_bad_input_leaves_nothing_behind(files, capsys, name, content, expected):
    source = files / name
    if content is None:
        Image.new("L", (64, 48)).save(source)
    elif content != "absent":
        source.write_bytes(content)
    out = files / ("out" + source.suffix)
    assert run(source, "-o", out, "--profile", files / "camera.json") == 1
    told = capsys.readouterr().err
    assert expected in told and name in told
    assert not [p for p in files.iterdir() if "out" in p.name]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--view", "cube", "--fov", 80], "--fov does not go with --view cube"),
        (["--view", "cube", "--size", "200x100"], "square, not 200 x 100"),
        (["--distance", 0], "0 is not a number above zero"),
        (["--distance", "inf"], "inf is not a number above zero"),
        (["--fov", 180], "less than 180 degrees, not 180"),
        (["--fov", "nan"], "not nan"),
        (["--view", "cylinder", "--fov", 361], "up to 360 degrees, not 361"),
        (["--view", "equirect", "--fov", 360, "--size", "100x80"], "360 x 180 degrees, not 360 x 288"),
        (["--size", "20000x10"], "sides of 1 to 16384"),
        (["--mask", "mask.txt"], "mask.txt: a picture's name ends in"),
        (["--max-theta", 0], "0 is not a number above zero"),
    ],
)
def test_options_that_make_no_view_are_usage_errors_before_any_work(files, capsys, options, reason):
    assert run(files / "grey.png", "-o", files / "o.png", "--profile", files / "camera.json", *options) == 2
    assert reason in capsys.readouterr().err and not (files / "o.png").exists()


def test_max_theta_ends_the_view_of_a_profile(files, capsys):
    common = [files / "grey.png", "-o", files / "o.png", "--profile", files / "camera.json", "--fov", 100, "--json"]
    seen = []
    for more in ([], ["--max-theta", 30]):
        assert run(*common, *more) == 0
        seen.append(json.loads(capsys.readouterr().out)["valid"])
    assert seen[1] < 0.5 < seen[0]


def test_a_view_that_sees_nothing_and_a_folder_that_is_there_are_refused(files, camera, capsys):
    with pytest.raises(PipefishError, match="sees nothing"):
        undistort(files / "grey.png", files / "o.png", camera, fov=40, turn=(180, 0, 0))
    (files / "out").mkdir()
    assert run(files / "folder", "-o", files / "out", "--profile", files / "camera.json") == 1
    assert "is there already" in capsys.readouterr().err
