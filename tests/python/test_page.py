"""The page: one file, no network, works with and without truth, survives hostile texts."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import pytest

from pipefish import pipefish_pb2 as pb
from pipefish.page import write_page
from pipefish.survey import Survey
from synthetic import as_object, end, keyframe, start, survey_objects, write_survey

EVALUATION = {
    "observations": 10,
    "within_1px": 0.98,
    "survival": 0.991,
    "median_px": 0.2,
    "p95_px": 0.7,
    "by_age": [{"age_low": 1, "age_high": 5, "count": 10, "within_1px": 0.98, "median_px": None}],
}


class Outline(HTMLParser):
    """Tags, addresses and balance of a page."""

    VOID = ("meta", "link", "img", "input", "source", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.images: list[dict] = []
        self.charts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.addresses += [v for k, v in attributes if k in ("src", "href", "srcset")]
        if tag == "img":
            self.images.append(values)
        if values.get("class") == "plot":
            self.charts.append(values["id"])
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def page_of(path, objects=None, **options) -> str:
    write_survey(path.with_suffix(".mcap"), objects=objects or survey_objects(10))
    survey = Survey.open(path.with_suffix(".mcap"))
    size = write_page(survey, path, title=survey.info["name"], lead="A test.", **options)
    assert path.stat().st_size == size < 15 << 20
    return path.read_text(encoding="utf-8")


def data_of(text: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])


@pytest.mark.parametrize("evaluation", [None, EVALUATION])
def test_the_page_stands_alone(tmp_path, evaluation):
    text = page_of(tmp_path / "p.html", evaluation=evaluation)
    outline = Outline(text)
    assert not outline.open, "every element is closed"
    assert all(a.startswith("data:") for a in outline.addresses)
    assert all(len(i["alt"]) > 10 for i in outline.images) and len(outline.images) == 2
    data = data_of(text)
    assert ["plot-" + c["id"] for c in data["charts"]] == outline.charts
    assert ("plot-accuracy" in outline.charts) == (evaluation is not None)
    assert len(data["gallery"]) == 10 and all(g["src"].startswith("data:image/jpeg") for g in data["gallery"])
    assert text.count("plotly.js v") == 1


def test_texts_of_the_device_cannot_break_the_page(tmp_path):
    nasty = "</script><script>alert(1)</script><b>'\"&"
    objects = [start(name=nasty), *(keyframe(i) for i in range(3)), end(3)]
    text = page_of(tmp_path / "p.html", objects)
    assert "<script>alert" not in text and not Outline(text).open
    assert "&lt;/script&gt;&lt;script&gt;alert(1)" in text


def test_a_survey_without_encoder_or_end_still_has_a_page(tmp_path):
    bare = pb.Keyframe.FromString(keyframe(0)[2])
    bare.ClearField("telemetry")
    bare.ClearField("observations")
    write_survey(tmp_path / "a.mcap", objects=[start(), as_object(2, bare), end(1)])
    write_page(Survey.open(tmp_path / "a.mcap"), tmp_path / "p.html", title="t", lead="l")
    assert not Outline((tmp_path / "p.html").read_text()).open


def test_no_track_in_common_is_a_zero_and_no_keyframe_before_is_a_gap(tmp_path):
    objects = [start()]
    for index, (common, after_break) in enumerate([(0, True), (30, False), (0, False), (0, True)]):
        message = pb.Keyframe.FromString(keyframe(index)[2])
        message.common_tracks, message.after_break = common, after_break
        objects.append(as_object(2, message))
    data = data_of(page_of(tmp_path / "p.html", [*objects, end(4)]))
    live = next(c for c in data["charts"] if c["id"] == "live")
    assert live["data"][1]["y"] == [None, 30, 0, None]


def test_the_head_shows_sent_and_received(tmp_path):
    objects = [start(), keyframe(0), keyframe(1), end(3, lost=(2,))]
    text = page_of(tmp_path / "p.html", objects)
    assert re.search(r"2<small>of 3</small>.*?keyframes received", text)
    assert "1, of which 1 lost on the device" in text
