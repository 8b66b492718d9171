"""Pictures of a survey: right size, tracks where they belong, readable formats, nothing half-written."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from PIL import Image

from pipefish import pipefish_pb2 as pb
from pipefish.colours import age_colours
from pipefish.errors import PipefishError
from pipefish.page import write_statistics
from pipefish.scene import REASONS
from pipefish.show import Painter, Style, animation, show, spread
from pipefish.survey import Survey
from pipefish.trackstats import charts, statistics
from synthetic import as_object, survey_objects, write_survey


@pytest.fixture
def survey(tmp_path):
    write_survey(tmp_path / "a.mcap", 12)
    return Survey.open(tmp_path / "a.mcap")


def test_the_dot_of_a_track_is_where_the_track_is(survey):
    scale = 4
    picture = np.asarray(Painter(survey).draw(9, Style(160 * scale, legend=False, line=0.5)).convert("RGB")).astype(int)
    seen = survey.keyframes[9].observations
    centres = np.round((seen.xy + 0.5) * scale - 0.5).astype(int)
    distance = np.abs(picture[centres[:, 1], centres[:, 0]] - age_colours(seen.age).astype(int)).max(axis=1)
    assert np.mean(distance <= 40) > 0.85  # the others lie under a neighbour


def test_an_overlay_has_the_picture_and_a_legend(survey, tmp_path):
    written = show(survey, tmp_path / "o.png", keyframe=3)
    picture = Image.open(tmp_path / "o.png")
    assert written["kind"] == "overlay" and picture.width == 160 * 7
    assert picture.height > 120 * 7 and picture.mode == "RGB"


@pytest.mark.parametrize("name", ["a.webp", "a.gif"])
def test_an_animation_has_all_keyframes_and_stays_small(survey, tmp_path, name):
    written = show(survey, tmp_path / name)
    picture = Image.open(tmp_path / name)
    assert written["kind"] == "animation" and picture.n_frames == 12
    assert (tmp_path / name).stat().st_size < 10 << 20


def test_an_animation_is_spread_over_the_whole_survey():
    class Many:
        survey = SimpleNamespace(keyframes=[None] * 150)
        drawn: ClassVar[list[int]] = []

        def draw(self, position, style):
            self.drawn.append(position)
            return Image.new("RGB", (8, 8), (position, 0, 0))

    animation(Many())
    assert len(Many.drawn) == 80 and Many.drawn[0] == 0 and Many.drawn[-1] == 149
    assert set(np.diff(Many.drawn)) <= {1, 2}


def test_an_animation_is_thinned_until_it_fits(survey):
    data = animation(Painter(survey), ".webp", limit=60_000)
    assert len(data) <= 60_000 and Image.open(io.BytesIO(data)).n_frames >= 1


def test_what_cannot_be_drawn_is_said(survey, tmp_path):
    with pytest.raises(PipefishError, match=r"no keyframe 99 \(0 to 11\)"):
        show(survey, tmp_path / "o.png", keyframe=99)
    with pytest.raises(PipefishError, match=r"\.png"):
        show(survey, tmp_path / "o.mov")
    assert not list(tmp_path.glob("o.*"))


def test_spread_keeps_both_ends():
    assert spread(100, 5) == [0, 25, 50, 74, 99] or spread(100, 5)[::4] == [0, 99]
    assert spread(3, 10) == [0, 1, 2] and spread(1, 5) == [0]


def tracking_survey(tmp_path) -> Survey:
    """A survey whose device counted: in keyframe k it found 30 tracks in each of 5 frames and lost k by drift."""
    objects = []
    for k, (name, kind, data) in enumerate(survey_objects(6)):
        if kind == 2:
            message = pb.Keyframe.FromString(data)
            counts = message.tracking
            counts.frames, counts.tracked, counts.lost_drift, counts.age_median = 5, 150, k, 7
            counts.quality_median, counts.reversing = 31130, message.index == 3
            counts.state_frames.extend([2 if message.index == 4 else 0, 5 if message.index == 3 else 0])
            name, kind, data = as_object(kind, message)
        objects.append((name, kind, data))
    write_survey(tmp_path / "t.mcap", objects=objects)
    return Survey.open(tmp_path / "t.mcap")


def test_statistics_are_means_a_frame_and_states_are_drawn(tmp_path):
    survey = tracking_survey(tmp_path)
    stats = statistics(survey)
    np.testing.assert_allclose(stats["tracked"], 30)
    np.testing.assert_allclose(stats["lost_drift"], np.arange(1, 7) / 5)
    np.testing.assert_allclose(stats["quality_median"], 0.95, atol=1e-4)
    assert stats["reversing"].tolist() == [0, 0, 0, 5, 0, 0]
    assert stats["standing"].tolist() == [0, 0, 0, 0, 2, 0]  # over by the keyframe, and still told
    assert survey.info["states"] == {"standing still": 1, "reversing": 1}
    plain, stated = (np.asarray(Painter(survey).draw(i, Style(640, legend=False)))[:30, :120] for i in (2, 3))
    assert (stated == (255, 190, 90)).all(axis=-1).any() and not (plain == (255, 190, 90)).all(axis=-1).any()


def test_the_statistics_page_has_its_charts_and_needs_counters(tmp_path, survey):
    write_statistics(tracking_survey(tmp_path), tmp_path / "s.html")
    text = (tmp_path / "s.html").read_text(encoding="utf-8")
    assert [f"plot-{name}" in text for name in ("stats-live", "stats-lost", "stats-age", "stats-states")] == [True] * 4
    assert "drifted from its template" in text and "saturated" not in text.split("application/json")[1][:20000]
    with pytest.raises(PipefishError, match="no track statistics"):
        write_statistics(survey, tmp_path / "none.html")


def test_reasons_that_have_no_colour_of_their_own_are_one_layer_and_none_is_lost(tmp_path):
    survey = tracking_survey(tmp_path)
    for number, (name, _) in enumerate(REASONS):
        for frame in survey.keyframes:
            setattr(frame.message.tracking, name, 10 * (number + 1))
    chart = next(c for c in charts(survey, np.arange(6.0), "m") if c["id"] == "stats-lost")
    names = [layer["name"] for layer in chart["data"]]
    assert names == ["saturated", "stands still in the picture", "masked", "drifted from its template", "other"]
    assert all(words in chart["text"] for _, words in REASONS if words not in names)
    total = np.sum([layer["y"] for layer in chart["data"]], axis=0)
    np.testing.assert_allclose(total, sum(range(10, 110, 10)) / 5)


def test_the_statistics_page_of_a_survey_without_a_name_is_called_as_its_file(tmp_path):
    survey = tracking_survey(tmp_path)
    survey.start.name = ""
    write_statistics(survey, tmp_path / "s.html")
    assert f"<h1>{survey.path.name}" in (tmp_path / "s.html").read_text(encoding="utf-8")


def test_colour_by_quality_differs_from_colour_by_age(survey):
    by_age, by_quality = (
        np.asarray(Painter(survey).draw(9, Style(640, legend=True, colour=c))) for c in ("age", "quality")
    )
    assert by_age.shape == by_quality.shape and (by_age != by_quality).any(axis=-1).mean() > 0.001
