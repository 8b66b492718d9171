"""Sections that are no ellipse: an egg of which more than the crown is seen is told as one, or not at all; no water."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from pipe_cloud import Pipe
from pipefish import tube_shape
from pipefish.tube import Tube, _Fit, fit_tube
from pipefish.tube_water import mirrored

CROWN = 0.3  # radius; the egg of 2 to 3 is 0.6 wide and 0.9 high


def egg_outline() -> np.ndarray:
    """(n,2) points of the egg, x to the right and y down from the crown's centre: arcs of R, 3 R and R / 2."""
    r, corner = CROWN, np.arctan2(1.5, 2.0)  # where side and invert meet, seen from the side's centre
    crown = np.linspace(-np.pi, 0, 400)
    side, invert = np.linspace(0, corner, 300), np.linspace(corner, np.pi - corner, 200)
    arcs = [
        np.column_stack([r * np.cos(crown), r * np.sin(crown)]),
        np.column_stack([3 * r * np.cos(side) - 2 * r, 3 * r * np.sin(side)]),
        np.column_stack([0.5 * r * np.cos(invert), 1.5 * r + 0.5 * r * np.sin(invert)]),
        np.column_stack([2 * r - 3 * r * np.cos(side[::-1]), 3 * r * np.sin(side[::-1])]),
    ]
    return np.concatenate(arcs)


def along(outline: np.ndarray) -> np.ndarray:
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1)))


def fitted(down_to: float, seed: int = 1, sigma: float = 0.0015, gross: float = 0.0, order: int = 0) -> Tube:
    """3 m of it by 1800 points, those above y = `down_to`; some anywhere near it."""
    random, outline = np.random.default_rng(seed), egg_outline()
    place = random.uniform(0, along(outline)[-1], 20000)
    wall = np.column_stack([np.interp(place, along(outline), outline[:, k]) for k in (0, 1)])
    wall = wall[wall[:, 1] < down_to][:1800]
    points = np.column_stack([wall, random.uniform(0, 3, len(wall))])
    points += random.normal(0, sigma, points.shape)
    off = random.uniform(size=len(points)) < gross
    points[off, :2] = random.uniform((-0.4, -0.4), (0.4, 0.7), (off.sum(), 2))
    path = np.column_stack([np.zeros(40), np.full(40, 0.05), np.linspace(0.1, 2.5, 40)])
    return fit_tube(points, sigma, path, nominal=2 * CROWN, up=[0, -1, 0], order=order)


@pytest.mark.parametrize(("seed", "gross"), [(1, 0.0), (2, 0.0), (3, 0.15)])
def test_an_egg_that_is_seen_all_around_has_its_own_height_width_and_girth(seed: int, gross: float) -> None:
    tube = fitted(1.0, seed, gross=gross)
    girth = along(egg_outline())[-1] / np.pi
    assert tube.status == "ok" and (tube.stations["status"] == "ok").mean() > 0.8
    middle = np.flatnonzero(tube.stations["status"] == "ok")
    for name, true in (("d_mean", girth), ("d_max", 0.9), ("d_min", 0.6)):
        value, one = tube.stations[name][middle], tube.stations[name + "_sigma"][middle]
        assert np.median(value) == pytest.approx(true, rel=0.01)
        assert (np.abs(value - true) < 2.5 * one).mean() > 0.9, name
    assert np.median(tube.stations["departure"]) > 0.02
    assert not [e for e in tube.events if e["kind"] in ("lateral", "hole")]
    assert not mirrored(tube, True)[1] and not mirrored(tube, False)[1]


@pytest.mark.parametrize(
    ("down_to", "seed", "gross"),
    [(0.55, 2, 0.1), (0.45, 1, 0.0), (0.35, 1, 0.0), (0.35, 3, 0.08), (0.2, 1, 0.0), (0.15, 2, 0.0), (0.1, 1, 0.0)],
)
def test_an_egg_whose_invert_is_not_seen_but_whose_sides_are_is_open(down_to: float, seed: int, gross: float) -> None:
    tube = fitted(down_to, seed, gross=gross)
    assert tube.status == "open" and "no ellipse" in tube.reason


@pytest.mark.parametrize("down_to", [0.25, 0.2])
def test_an_egg_that_may_only_be_an_ellipse_is_open_for_the_sides_that_lie_off_it(down_to: float) -> None:
    assert fitted(down_to, order=2).status == "open"


@pytest.mark.parametrize("down_to", [0.05, 0.0])
def test_an_egg_of_which_the_crown_alone_is_seen_is_its_crowns_circle_and_no_more(down_to: float) -> None:
    """Half a circle tells no egg: with 2.8 mm between its sides and the circle, or nothing, and 1.5 mm of noise."""
    tube = fitted(down_to)
    assert tube.status == "ok" and (tube.stations["status"] == "circle_only").all()
    assert np.abs(tube.stations["d_mean"] - 2 * CROWN).max() < 0.02 * CROWN
    for name in ("d_max", "d_min", "ovality", "ovality_nominal", "reduction_nominal"):
        assert np.isnan(tube.stations[name]).all(), name


ORDINARY = [
    Pipe(seed=1, egg=0.008, cover=math.radians(290), noise=0.001, outliers=0.06),  # 1.2 mm of a third harmonic
    Pipe(seed=2, waves=(0.3, 0.0015), cover=math.radians(260), noise=0.001, outliers=0.08),
]


@pytest.mark.parametrize("pipe", ORDINARY)
def test_a_pipe_with_a_gap_relief_and_gross_points_together_stays_measured(pipe: Pipe) -> None:
    tube = fit_tube(pipe.points(4000), pipe.noise, pipe.cameras())
    assert tube.status == "ok" and (tube.stations["status"] == "ok").all()
    assert tube.summary["d_mean"] == pytest.approx(pipe.diameter, rel=tube_shape.NO_ELLIPSE)


def test_gross_points_alone_are_no_reason_for_another_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    taken, likelier = [], tube_shape.likelier
    monkeypatch.setattr(tube_shape, "likelier", lambda *tubes: taken.append(likelier(*tubes)) or taken[-1])
    pipe = Pipe(seed=1, waves=(0.3, 0.0015), cover=math.radians(260), noise=0.001, outliers=0.25)
    fit_tube(pipe.points(2500), pipe.noise, pipe.cameras())
    assert taken == [False]  # it is tried: the points lean to one side


@pytest.mark.parametrize("pipe", [Pipe(seed=1, noise=0.001, outliers=0.08), *ORDINARY])
def test_a_pipe_is_not_fitted_twice_for_a_few_gross_points(pipe: Pipe, monkeypatch: pytest.MonkeyPatch) -> None:
    fits, on = [], _Fit.on

    def counted(self: _Fit, *reference: Any) -> Any:
        fits.append(1)
        return on(self, *reference)

    monkeypatch.setattr(_Fit, "on", counted)
    tube = fit_tube(pipe.points(2500), pipe.noise, pipe.cameras())
    assert len(fits) == 1 and tube_shape.much_off(tube)


def test_a_round_pipe_with_gross_points_all_along_stays_round() -> None:
    random = np.random.default_rng(5)
    clock = random.uniform(0, 2 * np.pi, 2500)
    points = np.column_stack([0.15 * np.sin(clock), -0.15 * np.cos(clock), random.uniform(0, 3, 2500)])
    points += random.normal(0, 0.001, points.shape)
    off = random.uniform(size=2500) < 0.25
    points[off, :2] = random.uniform(-0.25, 0.25, (off.sum(), 2))
    path = np.column_stack([np.zeros((40, 2)), np.linspace(0, 2.6, 40)])
    tube = fit_tube(points, 0.001, path)
    assert tube.status == "ok" and (tube.stations["status"] == "ok").all()
    assert np.abs(tube.stations["d_mean"] - 0.3).max() < 0.001
    assert tube.stations["departure"].max() < 0.001
