"""The report of a pipe with pictures: the unrolled wall and its keyframes, and the page in a browser."""

from __future__ import annotations

import base64
import html
import io
import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from browser import ask_page
from pipefish.cli import main
from pipefish.dense import DenseWall
from pipefish.dense_files import strips_of, write_dense
from pipefish.dense_findings import fingerprint
from pipefish.intervals import Z95
from pipefish.measured_limits import whole_sigma
from pipefish.measured_texts import OVALITIES, column, interval_text, length_text
from pipefish.report import Report
from pipefish.report_charts import Charts
from pipefish.report_dense import DensePart
from pipefish.report_scene import Scene, colour_scale, named
from pipefish.report_wall import WallPicture, _marks
from pipefish.wall import read_wall
from rendered_survey import MARKS
from test_page import Outline, data_of


@pytest.fixture(scope="module")
def page(measured, tmp_path_factory) -> Path:
    """The report, with a dense map beside the measured wall."""
    folder = shutil.copytree(measured / "out", tmp_path_factory.mktemp("report") / "out")
    with_map(folder)
    out = folder.parent / "report.html"
    assert main(["report", str(folder), "-o", str(out), "--limit", "ovality=9", "--json"]) == 0
    return out


CRACK = {
    **{"s": 0.3, "clock": 6.2, "sigma": 0.0002, "length": 0.2, "length_sigma": 0.003, "width": 0.001},
    **{"width_sigma": 0.0001, "extent_s": 0.2, "extent_clock": 0.3, "direction": "along", "views": 3.0},
    **{"offset": 0.002, "offset_sigma": 0.0003, "path": [[0.2, 6.05], [0.3, 6.2], [0.4, 6.35]]},
}
DEPOSIT = {"s": 0.5, "clock": 3.1, "length": 0.04, "extent": 0.3, "height": -0.004, "sigma": 0.0005}
STEP = {"s": 0.6, "step": 0.003, "clock": 1.57, "widening": -0.001, "sigma": 0.0002}


def with_map(folder: Path) -> None:
    """Writes folder/dense: a flat map of the first piece on which a crack, a deposit and a step were found."""
    wall = read_wall(folder)
    strip = strips_of(wall.pieces)[0]
    flat = np.zeros((150, 200))
    found = DenseWall(
        wall=strip.wall,
        s=(np.arange(150) + 0.5) * strip.wall.length / 150,
        clock=(np.arange(200) + 0.5) * np.pi / 100,
        deviation=flat,
        sigma=flat + 0.0003,
        pairs=np.full(flat.shape, 2),
        looks=np.full(flat.shape, 2),
        brightness=flat + 0.5,
        scatter=1.0,
        pairs_used=9,
        regions=[DEPOSIT | {"area": 0.001, "volume": -2e-6}],
        steps=[STEP],
        cracks=[CRACK],
    )
    write_dense(folder / "dense", [found], [strip], wall.unit, wall.document["summary"], fingerprint(folder))


def test_a_report_without_a_name_is_called_by_its_file_and_date(measured, tmp_path):
    folder = shutil.copytree(measured / "out", tmp_path / "out")
    document = json.loads((folder / "reconstruction.json").read_text())
    document["survey"] |= {"name": "", "file": "/away/street 7.mcap", "first_time_unix_ns": 1_700_000_000 * 10**9}
    (folder / "reconstruction.json").write_text(json.dumps(document))
    report = Report(folder, [], WallPicture("", None), DensePart())
    assert report.name() == "street 7, 2023-11-14 22:13 UTC"
    report.document["survey"]["name"] = "Mill Lane"
    assert report.name() == "Mill Lane"


def test_a_pupils_shift_that_the_survey_tells_is_not_said_to_be_left_out(measured):
    report = Report(measured / "out", [], WallPicture("", None), DensePart())
    report.document["structure"]["pupil_e1"] = [0.001]
    report.summary["systematic"]["pupil"] = 0.0
    assert "in the repeatability" in dict(report.accuracy_rows())["  of which pupil shift"]


def test_every_figure_of_the_head_has_its_interval_and_what_it_is_stands_once(measured, page):
    text = page.read_text()
    report = Report(measured / "out", [], WallPicture("", None), DensePart())
    tiles = {words.split(",")[0]: words for _, _, words in report.tiles()}
    k = int(np.nanargmax(column(report.document, "ovality")))
    half = 100 * Z95 * whole_sigma(report.document, "ovality")[k]
    assert f"± {half:.2f}, at" in tiles["most oval"]
    assert all("±" in tiles[name] for name in ("mean diameter", "narrowest", "widest"))
    seen = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert seen.count("very ± is a 95 % interval") == 1 and "+-" not in seen and "sigma" not in seen


def test_what_is_to_know_about_files_stands_with_the_files(measured, tmp_path):
    """And not where a surveyor is told of the pipe."""
    folder = shutil.copytree(measured / "out", tmp_path / "out")
    document = json.loads((folder / "reconstruction.json").read_text())
    assert not any("COLMAP" in remark for remark in document["remarks"])
    document["file_remarks"] = ["No COLMAP model: it is Tuesday."]
    (folder / "reconstruction.json").write_text(json.dumps(document))
    out = tmp_path / "r.html"
    assert main(["report", str(folder), "-o", str(out)]) == 0
    files = re.search(r"<h3>Files of the measurement</h3>.*?</table>", out.read_text(), re.S)[0]
    assert "No COLMAP model: it is Tuesday." in files and out.read_text().count("it is Tuesday") == 1
    assert all(name.split("/")[0] in files for name in document["files"])
    assert not re.search(r"<td></td>", files), "each file is told of"


def test_noise_is_grey_and_a_limit_has_full_colour(measured):
    """The colours went over all that the fit had left: a round pipe looked like a finding."""
    charts = Charts(measured / "out")
    scene = Scene(charts, [])
    half, reach = scene.colour_range()
    assert reach >= 3 * half > 0
    colours = {round(at, 4): colour for at, colour in colour_scale(half / reach)}
    inside = [colour for at, colour in colours.items() if abs(2 * at - 1) <= half / reach + 1e-4]
    assert len(inside) == 2 and len(set(inside)) == 1 and len(set(colours.values())) == 5
    size = 1000 * scene.size
    assert Scene(charts, [("d_min", size - 12)]).colour_range()[1] == pytest.approx(max(6, reach))
    assert Scene(charts, [("ovality", 9), ("d_min", size - 60)]).colour_range()[1] == pytest.approx(
        max(0.09 * size / 4, reach)
    )


def test_grey_against_the_mean_is_without_what_all_radii_share(measured):
    """A scale that is off makes the mean as much off: what a pipe differs by along it was grey by the scale's share."""
    charts = Charts(measured / "out")
    by_nominal = Scene(charts, []).colour_range()[0]
    charts.summary["nominal"] = None
    scene = Scene(charts, [])
    own = np.array([v for v in charts.document["stations"]["d_max_sigma"] if v is not None])
    assert scene.against == "the mean" and scene.colour_range()[0] == pytest.approx(980 * np.median(own))
    assert scene.colour_range()[0] < by_nominal


def test_names_of_near_findings_do_not_lie_over_each_other():
    assert named([1.0, 1.02, 1.5, 1.55, 1.61], ["a", "b", "c", "d", "e"], 0.1) == ["a", "", "c", "", "e"]
    joints = ["joint", "deposit", "joint", "joint"]
    assert named([1.0, 1.05, 1.1, 1.2], joints, 0.1) == ["", "deposit", "", "joint"], "the rarer kind's name is kept"


def test_names_of_near_rings_on_the_wall_stand_below_each_other():
    """A metre is 500 columns: joints at 1 m, 1.05 m and 1.1 m, and one at 2 m."""
    joints = [{"kind": "joint", "chainage": at, "clock": None} for at in (2.0, 1.1, 1.0, 1.05)]
    document = {"events": joints}
    unroller = SimpleNamespace(wall=SimpleNamespace(document=document), start=0.0, cell=0.002, columns=1500)
    found = [
        re.search(r"left:([\d.]+)%'><b(?: style='top:(\d+)px')?>joint", mark).groups() for mark in _marks(unroller, [])
    ]
    tops = {round(float(x) / 100 * 3, 2): int(top or 0) for x, top in found}
    assert tops[1.0] == tops[2.0] == 0 < tops[1.05] < tops[1.1]


def test_no_interval_is_told_as_nothing():
    """A joint stood at 1.31 ± 0.00 m."""
    assert interval_text(1.30722, 0.000713, "metre", metres=True) == "1.307 ± 0.001 m"
    assert interval_text(1.30722, 0.00713, "metre", metres=True) == "1.31 ± 0.01 m"
    assert interval_text(0.0117, 0.00071, "metre") == "11.7 ± 1.4 mm"
    assert interval_text(4.2, 1e-5, "diameter") == "4.20000 ± 0.00002 diameters"
    assert interval_text(4.2, None, "diameter") == length_text(4.2, "diameter") == "4.200 diameters"
    assert interval_text(4.2, 0.0, "metre", metres=True) == "4.20 ± 0.00 m"


def test_undecided_is_explained_only_where_a_limit_is(measured, page, tmp_path, capsys):
    assert "passed" in page.read_text() and "Undecided" not in page.read_text()
    summary = read_wall(measured / "out").document["summary"]
    out, close = tmp_path / "report.html", f"ovality={100 * summary['ovality_most']:.3f}"
    assert main(["report", str(measured / "out"), "-o", str(out), "--limit", close]) == 1
    told = capsys.readouterr().out
    assert "±" in told and told.count("95 %") == 1, "what the ± of a limit is"
    assert "Undecided: the interval at the worst station" in out.read_text()


def test_bands_of_ovality_hold_what_the_limits_count(measured):
    """Repeatability and systematic error, of each definition: bands were drawn without what the camera leaves open."""
    charts = Charts(measured / "out")
    stations = charts.document["stations"]
    stations["ovality_systematic"] = [None if v is None else 0.01 for v in stations["ovality_systematic"]]
    chart = charts.chart_ovality()
    bands = [trace["y"] for trace in chart["data"] if trace.get("fill") == "toself"]
    seen = 0
    for band, name in zip(bands, chart["choice"]["names"], strict=True):
        quantity = next(key for key, words in OVALITIES.items() if words == name)
        if quantity == "ovality":
            continue  # has an interval of its own
        first = band[: band.index(None)]
        half = (np.array(first[: len(first) // 2]) - first[: len(first) // 2 - 1 : -1]) / 2
        sigma = whole_sigma(charts.document, quantity)
        start = int(np.flatnonzero(np.isfinite(sigma))[0])
        assert half == pytest.approx(100 * Z95 * sigma[start : start + len(half)], abs=0.002)
        assert half.min() > 100 * Z95 * 0.0049  # half of the camera's part at least
        seen += 1
    assert seen >= 3


def test_the_page_says_what_is_systematic_at_stations_beside_what_is_in_the_mean(measured, tmp_path):
    """A lens that is a little wrong tapers a pipe: the two ends by more than the mean."""
    folder = shutil.copytree(measured / "out", tmp_path / "out")
    document = json.loads((folder / "reconstruction.json").read_text())
    summary, stations = document["summary"], document["stations"]
    stations["d_mean_systematic"] = np.linspace(0.0005, 0.002, len(stations["s"])).tolist()
    summary |= {"d_mean_systematic": 0.0004, "station_systematic": 0.001, "station_systematic_most": 0.002}
    (folder / "reconstruction.json").write_text(json.dumps(document))
    assert main(["report", str(folder), "-o", str(tmp_path / "r.html")]) == 0
    text = html.unescape((tmp_path / "r.html").read_text())
    assert "± 0.78 mm" in text and "± 1.96 mm, up to ± 3.92" in text and "± 1.0 to 3.9 mm. Dotted" in text


def test_what_was_not_measured_at_the_ends_is_on_the_charts(measured, tmp_path):
    folder = shutil.copytree(measured / "out", tmp_path / "out")
    document = json.loads((folder / "reconstruction.json").read_text())
    gap = {"start": -7.0, "end": -2.0, "keyframes": [0, 9], "reason": "tracks", "detail": ""}
    document["not_measured"].append(gap)
    (folder / "reconstruction.json").write_text(json.dumps(document))
    for chart in (Charts(folder).chart_diameter(), Charts(folder).chart_ovality()):
        low, high = chart["layout"]["xaxis"]["range"]
        assert low < -7.0 and high > max(document["stations"]["chainage"])
        assert any((s.get("x0"), s.get("x1")) == (-7.0, -2.0) for s in chart["layout"]["shapes"])


def test_a_survey_in_place_of_a_measured_folder_is_told_what_to_do_first(tmp_path, capsys):
    (tmp_path / "a.mcap").write_bytes(b"")
    assert main(["report", str(tmp_path / "a.mcap"), "-o", str(tmp_path / "r.html")]) == 1
    assert "a.mcap: a file; `pipefish reconstruct SURVEY -o DIR`" in capsys.readouterr().err


def test_a_systematic_part_that_nobody_knows_is_not_told_as_zero(measured, tmp_path):
    """Without a scale, of a profile without covariance: the camera's part is unknown, and there is no nominal line."""
    folder = shutil.copytree(measured / "out", tmp_path / "out")
    document = json.loads((folder / "reconstruction.json").read_text())
    document["stations"]["d_mean_systematic"] = [0.0] * len(document["stations"]["s"])
    document["summary"]["nominal"] = None
    (folder / "reconstruction.json").write_text(json.dumps(document))
    text = Charts(folder).chart_diameter()["text"]
    assert "What is wrong with the camera is not in them, and not known." in text and "Dotted" not in text


def test_commands_in_texts_are_shown_as_code(measured, tmp_path):
    out = tmp_path / "report.html"
    assert main(["report", str(measured / "out"), "-o", str(out)]) == 0
    assert "<code>pipefish dense</code> maps the wall" in out.read_text() and "`pipefish" not in out.read_text()


def test_what_the_dense_map_found_is_told_and_shown(page):
    text = page.read_text()
    cells = re.findall(
        r"<tr><td>(\w+)</td><td[^>]*>([\d.]+) m</td><td[^>]*>(\d+:\d\d)</td><td>([^<]*)</td><td[^>]*>dense", text
    )
    kinds = {kind: (float(at), clock, size) for kind, at, clock, size in cells}
    assert set(kinds) == {"crack", "deposit", "step"}
    assert kinds["deposit"][1] == "5:55" and "height 4.0 ± 1.0 mm" in kinds["deposit"][2]
    assert "step 3.0 ± 0.4 mm" in kinds["step"][2] and "radius narrower by 1.0 mm" in kinds["step"][2]
    assert "length 200.0 ± 5.9 mm" in kinds["crack"][2] and "edges offset by 2.0 ± 0.6 mm" in kinds["crack"][2]
    assert kinds["step"][0] - kinds["crack"][0] == pytest.approx(0.3, abs=0.011)
    assert "By the dense map, a cell every" in text and "smaller deposits and recesses, joint steps, cracks" in text
    (path,) = re.findall(r"<path d='(.*?)'/>", text)
    assert path.count("M") == 2, "it crosses twelve o'clock, where the picture is cut"
    (shown,) = [i for i in Outline(text).images if (i["alt"] or "").startswith("Deviation")]
    assert Image.open(io.BytesIO(base64.b64decode(shown["src"].split(",")[1]))).width == int(shown["width"])


def test_a_map_of_another_reconstruction_is_left_out_or_refused(page, tmp_path, capsys):
    folder = shutil.copytree(page.parent / "out", tmp_path / "out")
    text = (folder / "reconstruction.json").read_text().replace("survey.mcap", "gone.mcap")
    (folder / "reconstruction.json").write_text(text)
    out = tmp_path / "r.html"
    assert main(["report", str(folder), "-o", str(out)]) == 0
    assert "is a map of another reconstruction" in out.read_text() and ">dense map</td>" not in out.read_text()
    capsys.readouterr()
    assert main(["report", str(folder), "-o", str(out), "--dense", str(folder / "dense")]) == 1
    assert "another reconstruction" in capsys.readouterr().err
    (folder / "dense/dense.json").write_text("{}")
    assert main(["report", str(folder), "-o", str(out)]) == 1
    assert "dense.json: format: not 'pipefish-dense'" in capsys.readouterr().err


def test_the_page_holds_the_wall_and_the_keyframes_that_show_it(page):
    text = page.read_text()
    outline, wall = Outline(text), data_of(text)["wall"]
    assert not outline.open and all(a.startswith("data:") for a in outline.addresses)
    parts = [i for i in outline.images if i["src"].startswith("data:image/webp") and not i["alt"]]
    pictures = [Image.open(io.BytesIO(base64.b64decode(p["src"].split(",")[1]))) for p in parts]
    assert [p.size for p in pictures] == [(int(p["width"]), int(p["height"])) for p in parts]
    assert sum(p.width for p in pictures) == wall["columns"] and pictures[0].height == wall["rows"]
    runs = np.array(wall["runs"])
    assert (np.diff(runs[:, 0]) > 0).all() and runs[0, 0] == 0 and runs[:, 1].max() == len(wall["frames"]) - 1
    for s, _ in MARKS[2:6]:
        column = (s - 0.4 - wall["start"]) / wall["cell"]
        frame = wall["frames"][runs[np.searchsorted(runs[:, 0], column, "right") - 1, 1]]
        at = float(re.search(r"taken at ([\d.]+) m", frame["text"])[1])
        assert abs(at - (s - 0.4)) < 0.04 and frame["src"].startswith("data:image/jpeg")


SCRIPT = """
  await new Promise((done) => setTimeout(done, 1500));
  const plots = [...document.querySelectorAll(".plot")];
  const select = document.querySelector(".choice select");
  select.selectedIndex = 2;
  select.dispatchEvent(new Event("change"));
  const strip = document.getElementById("wall-strip"), box = strip.getBoundingClientRect();
  const texts = [0.1, 0.5].map((x) => {
    const at = { clientX: box.left + x * box.width, clientY: box.top + box.height / 2, bubbles: true };
    strip.dispatchEvent(new PointerEvent("pointermove", at));
    return document.getElementById("wall-text").textContent;
  });
  const scene = document.getElementById("plot-tube");
  const drawn = scene._fullLayout.scene._scene, eye = drawn.glplot.cameraParams, wall = scene.data[0];
  const times = (m, v) => [0, 1, 2, 3].map((r) => m[r] * v[0] + m[4 + r] * v[1] + m[8 + r] * v[2] + m[12 + r] * v[3]);
  const ends = [[2, -2], [2, -2]]; // of the wall in the view, by Plotly's own matrices: -1 to 1 is what one sees
  wall.x.forEach((x, n) => {
    const place = [x, wall.y[n], wall.z[n]].map((v, k) => v * drawn.dataScale[k]);
    const [u, v, , w] = times(eye.projection, times(eye.view, times(eye.model, [...place, 1])));
    [u / w, v / w].forEach((at, k) => { ends[k] = [Math.min(ends[k][0], at), Math.max(ends[k][1], at)]; });
  });
  return {
    inner: innerWidth, scroll: document.documentElement.scrollWidth, texts,
    view: document.getElementById("wall-view").naturalWidth,
    plots: plots.map((p) => [p.clientWidth, p.querySelector(".main-svg").clientWidth]),
    select: select.getBoundingClientRect().right,
    shown: document.getElementById("plot-ovality").data.map((t) => t.visible),
    triangles: Math.max(...drawn.glplot.objects.map((o) => o.triangleCount || 0)),
    picture: await Plotly.toImage(scene, { format: "png", width: 400, height: 400 }), ends,
  };
"""


@pytest.mark.parametrize("width", [390, 1280], ids=["phone", "desktop"])
def test_the_page_draws_itself_in_a_browser(page, tmp_path, width):
    """Nothing is wider than the window, charts fill their cards, the 3-D scene shows triangles, the menu chooses, the
    pointer on the wall brings the keyframe beside it."""
    found = ask_page(page, SCRIPT, width, tmp_path)
    assert found["inner"] == width and found["scroll"] <= width and found["select"] < width
    assert len(found["plots"]) == len(data_of(page.read_text())["charts"])
    assert all(inner == outer > 0.5 * min(width, 500) for inner, outer in found["plots"])
    assert [bool(v) for v in found["shown"][:6]] == [False] * 4 + [True] * 2
    assert found["triangles"] > 500
    picture = Image.open(io.BytesIO(base64.b64decode(found["picture"].split(",")[1]))).convert("RGB")
    colours = picture.quantize(64).getcolors()
    assert len(colours) > 20, "the wall is shaded and coloured: an empty scene has a handful of colours"
    (left, right), (low, high) = found["ends"]
    assert -1 < left < right < 1 and -1 < low < high < 1, "all of the pipe is in view"
    assert right - left > 1.4 or high - low > 1.2, "and fills it: it was half as large on a desktop"
    wall = data_of(page.read_text())["wall"]
    for text, share in zip(found["texts"], (0.1, 0.5), strict=True):
        at, taken = (
            float(x) for x in re.search(r"^([\d.]+) m, (?:6:0|5:5)\d o'clock.*taken at ([\d.]+) m", text).groups()
        )
        assert at == pytest.approx(wall["start"] + share * wall["columns"] * wall["cell"], abs=0.01)
        assert abs(at - taken) < 0.04
    assert found["view"] > 100, "the picture of the keyframe is there"


REDRAWS = """
  const rest = () => new Promise((done) => setTimeout(done, 1000));
  const plots = [...document.querySelectorAll(".plot")], main = document.querySelector("main");
  const own = Plotly.react, out = { all: plots.map((p) => p.id) };
  let drawn = [];
  Plotly.react = function (place) { drawn.push(place.id); return own.apply(this, arguments); };
  const after = async (name, event) => {
    event();
    await rest();
    out[name] = drawn;
    out[name + "_widths"] = plots.map((p) => [p.clientWidth, p.querySelector(".main-svg").clientWidth]);
    const flat = plots.filter((p) => p.querySelector(".legend") && p.querySelector(".nsewdrag"));
    const box = (p, part) => p.querySelector(part).getBoundingClientRect();
    out[name + "_over"] = flat.map((p) => box(p, ".legend").bottom - box(p, ".nsewdrag").top);
    drawn = [];
  };
  const tell = (event) => () => window.dispatchEvent(new Event(event));
  await after("loaded", () => {});
  await after("same", tell("resize"));
  await after("chosen", () => document.querySelector(".choice select").dispatchEvent(new Event("change")));
  await after("narrow", () => { main.style.maxWidth = "420px"; tell("resize")(); });
  await after("paper", tell("beforeprint"));
  const flat = document.querySelector("#plot-tube .on-paper");
  const seen = flat.getContext("2d").getImageData(0, 0, flat.width, flat.height).data;
  out.inked = seen.filter((v, i) => i % 4 === 3 && v > 0).length / (seen.length / 4);
  await after("screen", tell("afterprint"));
  out.left = document.querySelectorAll(".on-paper").length;
  return out;
"""


def test_only_what_has_another_size_is_drawn_again_and_paper_has_its_own(page, tmp_path):
    """A phone's bars that come and go change no chart's size; a choice changes one chart; paper is as wide as A4."""
    found = ask_page(page, REDRAWS, 1280, tmp_path)
    assert found["same"] == [] and found["chosen"] == ["plot-ovality"]
    for name in ("narrow", "paper", "screen"):
        assert sorted(found[name]) == sorted(found["all"]), name
        assert all(inner == outer for inner, outer in found[name + "_widths"]), name
        assert found[name + "_over"] and max(found[name + "_over"]) < 3, "a legend lies on no curve"
    assert {inner for inner, _ in found["paper_widths"]} == {655}
    assert found["screen_widths"] == found["narrow_widths"] != found["loaded_widths"]
    assert found["inked"] > 0.05 and found["left"] == 0, "the 3-D scene is on the paper, and only there"


def test_without_the_survey_the_page_says_that_the_pictures_are_missing(measured, tmp_path, capsys):
    moved = shutil.copytree(measured / "out", tmp_path / "deep" / "out")
    document = (moved / "reconstruction.json").read_text()
    (moved / "reconstruction.json").write_text(document.replace("survey.mcap", "gone.mcap"))
    page = tmp_path / "r.html"
    assert main(["report", str(moved), "-o", str(page), "--json"]) == 0
    text = page.read_text()
    assert "gone.mcap: the survey with the pictures is not there" in text and "wall" not in data_of(text)
    survey = str(measured / "survey.mcap")
    assert main(["report", str(moved), "-o", str(page), "--survey", survey, "--json"]) == 0
    assert "wall" in data_of(page.read_text())
    assert main(["report", str(moved), "-o", str(page), "--survey", str(tmp_path / "no.mcap")]) == 1
    assert "no.mcap" in capsys.readouterr().err
