"""Evaluation against truth: anchored at the first sighting, in pixels; what cannot be seen counts as wrong."""

from __future__ import annotations

import numpy as np
import pytest

from pipefish.evaluate import evaluate, lit, lives, observed, opencv_tracks, survival, track_errors, verdict
from pipefish.survey import Survey
from synthetic import write_survey


class Flat:
    """A world in which the points of the synthetic survey move outwards as it draws them, plus `drift` a frame."""

    def __init__(self, drift: float = 0.0, blind_after: int = 10**9) -> None:
        self.drift, self.blind_after = drift, blind_after

    def cast(self, frame, pixels):
        offset = pixels - [80, 60]
        radius = np.linalg.norm(offset, axis=1) - 0.6 * frame
        angle = np.arctan2(offset[:, 1], offset[:, 0])
        return np.stack([radius, angle, np.full(len(pixels), frame)], axis=1), np.ones(len(pixels), dtype=bool)

    def project(self, frame, points):
        radius = points[:, 0] + 0.6 * frame + self.drift * (frame - points[:, 2])
        pixels = np.stack([80 + radius * np.cos(points[:, 1]), 60 + radius * np.sin(points[:, 1])], axis=1)
        return pixels, np.full(len(points), frame <= self.blind_after)


def opened(tmp_path) -> Survey:
    write_survey(tmp_path / "a.mcap", 12)
    return Survey.open(tmp_path / "a.mcap")


def test_perfect_tracks_have_no_error(tmp_path):
    survey = opened(tmp_path)
    result = evaluate(survey, Flat())
    assert result["length_mean"] == pytest.approx(survey.tracks().length_frames.mean())
    assert result["within_1px"] == 1.0 and result["p95_px"] < 1e-3  # Q16.16 positions
    assert result["observations"] == 12 * 40 - len(survey.tracks().id)


def test_drift_grows_with_the_age_since_the_anchor(tmp_path):
    errors = track_errors(observed(opened(tmp_path)), Flat(drift=0.12))
    np.testing.assert_allclose(errors["error"], 0.12 * errors["age"], atol=1e-3)
    result = evaluate(opened_again(tmp_path), Flat(drift=0.12))
    assert result["by_age"][0]["within_1px"] == 1.0  # 5 frames: 0.6 px
    assert result["by_age"][1]["within_1px"] == 0.0  # 10 frames: 1.2 px


def opened_again(tmp_path) -> Survey:
    return Survey.open(tmp_path / "a.mcap")


def test_a_track_that_cannot_be_there_is_wrong(tmp_path):
    result = evaluate(opened(tmp_path), Flat(blind_after=0))
    assert result["within_1px"] == 0.0


class Rim(Flat):
    """The same world with a rim: the field ends `reach` pixels from (80, 60)."""

    def __init__(self, reach: float) -> None:
        super().__init__()
        self.reach = reach

    def cast(self, frame, pixels):
        points, _ = super().cast(frame, pixels)
        return points, np.linalg.norm(pixels - [80, 60], axis=1) < self.reach


def test_survival_counts_only_tracks_that_could_go_on(tmp_path):
    survey = opened(tmp_path)
    tracks = survey.tracks()
    gone = len(tracks.id) - np.sum(
        tracks.frame == tracks.frame.max()
    )  # a track each that a keyframe has and the next not
    pairs = 11 * 40  # 12 keyframes of 40 tracks
    assert survival(observed(survey), Flat()) == pytest.approx(1 - gone / pairs)
    assert survival(observed(survey), Rim(1)) is None  # everything leaves the field: nobody is to blame


def test_what_goes_behind_the_glare_is_nobodys_fault(tmp_path):
    seen = observed(opened(tmp_path))
    grey = np.full((120, 160), 100, np.uint8)
    assert survival(seen, Flat(), lambda frame: grey) == survival(seen, Flat())
    assert survival(seen, Flat(), lambda frame: np.full_like(grey, 255)) is None


def test_a_window_clipped_by_more_than_a_quarter_is_not_lit():
    image = np.full((60, 60), 100, np.uint8)
    image[:, :25] = 255  # columns 20..24 of 20..40: 5 of 21
    image[:4] = 2
    at = np.array([[30.0, 30.0], [29.0, 30.0], [30.0, 12.0], [np.nan, 0.0]])
    np.testing.assert_array_equal(lit(image, at), [True, False, False, False])


def test_a_life_ends_where_the_point_leaves_or_the_survey_ends(tmp_path):
    seen = observed(opened(tmp_path))
    tracks, last = seen.tracks, max(seen.sequence.values())
    anchor = tracks.bounds[:-1]
    born = np.array([seen.sequence[int(i)] for i in tracks.frame[anchor]]) - tracks.age[anchor]
    frames, whole = lives(seen, Flat())
    assert (frames == last - born).all() and not whole.any()  # nothing ever leaves: only the survey's end does
    frames, whole = lives(seen, Rim(40 + 16))  # the points go on, the field ends
    reached = np.linalg.norm(tracks.pixels - [80, 60], axis=1) > 40
    ends = np.array([reached[a:b].any() for a, b in zip(anchor, tracks.bounds[1:], strict=True)])
    assert ends.any() and (frames[ends] <= tracks.length_frames[ends]).all()
    assert (frames[whole] < last - born[whole]).all() and (born[whole] > min(seen.sequence.values())).all()
    frames, whole = lives(seen, Rim(1))
    assert (frames == tracks.length_frames).all() and not whole.any()  # no wall at the anchors: nothing is known


FIGURES = {"within_1px": 0.98, "survival": 0.95, "median_px": 0.1, "length_median": 30.0}


@pytest.mark.parametrize(
    ("change", "failed"),
    [
        ({}, []),
        ({"within_1px": 0.965}, ["within_1px"]),
        ({"survival": 0.89}, ["survival"]),
        ({"survival": None}, ["survival"]),
        ({"median_px": 0.21}, ["median_px"]),
        ({"length_median": 29.0}, ["length_median"]),
    ],
)
def test_each_bar_is_enforced(change, failed):
    rows = verdict(FIGURES | change, {"length_median": 20.0})
    assert [name for name, row in rows.items() if not row["holds"]] == failed
    assert "length_median" not in verdict(FIGURES, None)
    assert verdict(FIGURES | {"within_1px": 0.965}, None, smooth=True)["within_1px"]["holds"]


def test_the_peer_follows_a_shift_and_is_judged_like_the_device():
    pytest.importorskip("cv2")
    rng = np.random.default_rng(1)
    wall = rng.normal(size=(200, 400))
    for _ in range(4):
        wall = (wall + np.roll(wall, 1, 0) + np.roll(wall, 1, 1) + np.roll(wall, -1, 0) + np.roll(wall, -1, 1)) / 5
    wall = np.clip(128 + wall * 200, 0, 255).astype(np.uint8)
    seen = opencv_tracks(lambda k: wall[20:180, 100 - 2 * k : 340 - 2 * k], {0: 0, 1: 5, 2: 10}, [(0, 1), (1, 2)], 80)

    class Plane:
        def cast(self, frame, pixels):
            points = np.column_stack([pixels - [2 * frame, 0], np.zeros(len(pixels))])
            return points, np.all((pixels > 0) & (pixels < [239, 159]), axis=1)

        def project(self, frame, points):
            return points[:, :2] + [2 * frame, 0], np.ones(len(points), dtype=bool)

    assert np.median(track_errors(seen, Plane())["error"]) < 0.1
    assert survival(seen, Plane()) > 0.9
    assert seen.tracks.age.max() == 10
