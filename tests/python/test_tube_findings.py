"""Findings of the tube: bends, joints, deposits with size; and none in clean rough pipes."""

from __future__ import annotations

import math

import numpy as np
import pytest

import pipefish as pf
from pipe_cloud import Pipe
from pipefish import tube_findings, tube_patches
from pipefish.tube_shared import Common


def of_kind(tube: pf.Tube, kind: str) -> dict:
    found = [e for e in tube.events if e["kind"] == kind]
    assert len(found) == 1, tube.events
    return found[0]


def test_clean_rough_pipes_raise_no_alarms() -> None:
    alarms = []
    for seed in range(8):
        pipe = Pipe(length=4, roughness=0.002, noise=0.001, outliers=0.2 * (seed % 2), ovality=0.01, seed=100 + seed)
        tube = pf.fit_tube(pipe.points(1600), pipe.noise, pipe.cameras())
        assert tube.status == "ok"
        alarms += tube.events
    assert not alarms  # one in a hundred fits is allowed: 8 % of such batches would show one


def test_a_wall_in_waves_raises_no_alarms() -> None:
    """Relief that neighbours share, as the white roughness of the pipes above is not."""
    pipe = Pipe(length=4, waves=(0.2, 0.002), noise=0.0005, seed=1)
    tube = pf.fit_tube(pipe.points(2500), 0.001, pipe.cameras())
    assert tube.status == "ok" and tube.surface.correlation > 2 and not tube.events


def test_rough_walls_with_relief_have_no_kinks() -> None:
    """Waves of two thirds of a diameter, which do not make the axis wind; a kink without a step is a joint, too."""
    alarms = []
    for seed in range(20):
        pipe = Pipe(length=3, waves=(0.2, 0.002), roughness=0.001, noise=0.0005, seed=300 + seed)
        found = pf.fit_tube(pipe.points(1200), 0.001, pipe.cameras()).events
        alarms += [e for e in found if e["kind"] in ("joint", "bend")]
    assert not alarms


def test_a_turn_that_may_be_more_than_a_joints_is_a_bend(monkeypatch: pytest.MonkeyPatch) -> None:
    """10.4 degrees, short: to 0.1 degrees they are surely less than a bend's 11.25, to 1 degree they are not."""
    pipe = Pipe(joint=(1.5, 0.0, math.radians(10.4)), seed=1)
    points = pipe.points(2000)
    assert of_kind(pf.fit_tube(points, pipe.noise, pipe.cameras()), "joint")["step"] is None
    monkeypatch.setattr(Common, "turn", lambda *_: math.radians(1.0) ** 2)
    bend = of_kind(pf.fit_tube(points, pipe.noise, pipe.cameras()), "bend")
    assert bend["angle_sigma"] > math.radians(0.9) and bend["radius"] is None


@pytest.mark.parametrize("degrees", [15.0, 45.0])
def test_bends_have_their_angle_radius_and_side(degrees: float) -> None:
    pipe = Pipe(length=4, bend=(1.5, math.radians(degrees), 0.9), seed=3)
    tube = pf.fit_tube(pipe.points(2400), pipe.noise, pipe.cameras())
    bend = of_kind(tube, "bend")
    assert abs(math.degrees(bend["angle"]) - degrees) < max(0.5, 2.5 * math.degrees(bend["angle_sigma"]))
    assert abs(bend["start"] - 1.5) < 0.15 and abs(bend["end"] - 1.5 - 0.9 * math.radians(degrees)) < 0.15
    assert bend["clock"] == pytest.approx(math.pi / 2, abs=0.1)  # to the right: three o'clock
    # Between the first and the last kink of the smooth axis the arc was 10 to 27 % too short.
    assert abs(bend["radius"] - 0.9) < min(3 * bend["radius_sigma"], 0.9 * 1.35 / degrees)
    truth, _ = pipe.axis(np.linspace(0.3, 3.7, 60))
    assert np.abs(tube.project(truth)["r"]).max() < 0.005 * pipe.diameter


class Turns(Pipe):
    """A pipe with several bends, to both sides: `turns` as `bend`, to the left where the angle is below 0."""

    turns: tuple[tuple[float, float, float], ...] = ()

    def axis(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = np.arange(0, self.length + 0.002, 0.001)
        heading = sum(
            math.copysign(1, angle) * np.clip((at - start) / radius, 0, abs(angle))
            for start, angle, radius in self.turns
        )
        middle = 0.5 * (heading[1:] + heading[:-1])
        x, z = (np.interp(s, at, np.r_[0, np.cumsum(f(middle))] * 0.001) for f in (np.sin, np.cos))
        return np.column_stack([x, np.zeros_like(s), z]), np.interp(s, at, heading)


def test_a_bend_over_half_a_turn_has_all_of_its_angle() -> None:
    """From tangent to tangent it would be 160 degrees, to the other side."""
    pipe = Pipe(length=4.2, bend=(0.8, math.radians(200), 0.7), seed=1)
    bend = of_kind(pf.fit_tube(pipe.points(2500), pipe.noise, pipe.cameras()), "bend")
    assert abs(math.degrees(bend["angle"]) - 200) < 2.5 * math.degrees(bend["angle_sigma"])
    assert abs(bend["radius"] - 0.7) < min(3 * bend["radius_sigma"], 0.02 * 0.7)
    assert bend["clock"] == pytest.approx(math.pi / 2, abs=0.1)


def test_an_s_is_two_bends() -> None:
    """As one its turns would take each other away: of 45 degrees to and fro nothing was told."""
    pipe = Turns(length=4, seed=1)
    pipe.turns = ((1.3, math.radians(45), 0.9), (1.3 + 0.9 * math.radians(45), -math.radians(45), 0.9))
    events = pf.fit_tube(pipe.points(2400), pipe.noise, pipe.cameras()).events
    assert [e["kind"] for e in events] == ["bend", "bend"]
    for bend, clock in zip(events, (0.5, 1.5), strict=True):
        assert abs(math.degrees(bend["angle"]) - 45) < 3  # each ends where the other begins: there the axis is smoothed
        assert abs(bend["radius"] - 0.9) < 3 * bend["radius_sigma"] < 0.1
        assert bend["clock"] == pytest.approx(clock * math.pi, abs=0.1)


def test_what_turns_unevenly_has_no_radius() -> None:
    s = np.arange(0, 1.5, 0.015)
    for right, up, even in ((0.6, 0.0, True), (0.5, -0.4, False), (0.5, 0.5, False)):
        first, then = np.clip(s - 0.3, 0, 0.5) / 0.5, np.clip(s - 0.8, 0, 0.4) / 0.4
        twist = right != up
        yaw = right * first + (up * then if twist else 0)
        pitch = np.zeros(len(s)) if twist else up * then
        tangent = np.column_stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        assert (tube_findings._arc(s, tangent, 0.3, 1.2).uneven < tube_findings.BEND_UNEVEN) is even


def test_a_bend_too_short_to_be_told_from_a_kink_has_no_radius() -> None:
    pipe = Pipe(length=4, bend=(1.5, math.radians(15), 0.3), seed=3)
    bend = of_kind(pf.fit_tube(pipe.points(2400), pipe.noise, pipe.cameras()), "bend")
    assert abs(math.degrees(bend["angle"]) - 15) < max(0.5, 2.5 * math.degrees(bend["angle_sigma"]))
    assert abs(bend["s"] - 1.54) < 0.03 and bend["radius"] is None and bend["radius_sigma"] is None


def test_a_long_bend_that_turns_no_more_than_a_joint_is_a_bend() -> None:
    pipe = Pipe(length=4, bend=(1.5, math.radians(9), 3.0), seed=3)
    tube = pf.fit_tube(pipe.points(2400), pipe.noise, pipe.cameras())
    bend = of_kind(tube, "bend")
    assert len(tube.events) == 1
    assert abs(math.degrees(bend["angle"]) - 9) < max(0.5, 2.5 * math.degrees(bend["angle_sigma"]))


@pytest.mark.parametrize(("degrees", "step"), [(3.0, 0.0), (5.0, 0.0), (3.0, 0.012), (5.0, 0.012)])
def test_a_kink_is_a_joint_with_its_angle(degrees: float, step: float) -> None:
    """Not a bend of a third of a diameter."""
    pipe = Pipe(joint=(1.5, step, math.radians(degrees)), seed=1)
    tube = pf.fit_tube(pipe.points(2000), pipe.noise, pipe.cameras())
    joint = of_kind(tube, "joint")
    assert len(tube.events) == 1 and abs(joint["s"] - 1.5) < max(0.03, 2 * joint["s_sigma"])
    assert abs(math.degrees(joint["angle"]) - degrees) < max(0.1, 2.5 * math.degrees(joint["angle_sigma"]))
    if step:
        assert abs(joint["step"] - step) < max(0.002, 2.5 * joint["step_sigma"])
    else:
        assert joint["step"] is None
        assert joint["clock"] == pytest.approx(math.pi / 2, abs=0.1)  # to the right


@pytest.mark.parametrize("off", [-0.05, 0.05])
def test_a_break_beside_a_kink_is_one_joint_with_the_angle_of_both(monkeypatch, off: float) -> None:
    """Where the surface was broken a sixth of a diameter off the joint it kinks there and turns back at its end."""
    pipe = Pipe(joint=(1.5, 0.004, math.radians(6)), seed=1)
    monkeypatch.setattr(tube_findings, "break_candidates", lambda *_: [1.5 + off])
    tube = pf.fit_tube(pipe.points(4000), pipe.noise, pipe.cameras())
    joint = of_kind(tube, "joint")
    assert abs(joint["s"] - 1.5) < 2 * joint["s_sigma"] and not any(e["kind"] == "bend" for e in tube.events)
    assert abs(math.degrees(joint["angle"]) - 6) < max(0.1, 2.5 * math.degrees(joint["angle_sigma"]))


def test_an_open_joint_that_kinks_is_one_joint() -> None:
    pipe = Pipe(joint=(1.5, 0.0, math.radians(5)), ring=(1.5, 0.03), seed=4)
    tube = pf.fit_tube(pipe.points(4000), pipe.noise, pipe.cameras())
    joint = of_kind(tube, "joint")
    assert abs(math.degrees(joint["angle"]) - 5) < 0.3
    assert abs(joint["s"] - 1.5) < 0.015 and joint["gap"] is not None


def test_beside_a_joint_nothing_swings() -> None:
    """The smooth surface ends there: neither diameter nor axis nor ovality overshoots."""
    pipe = Pipe(joint=(1.5, 0.012, 0.0), ovality=0.02, seed=1)
    tube = pf.fit_tube(pipe.points(2000), pipe.noise, pipe.cameras())
    of_kind(tube, "joint")
    table = tube.stations
    beside = np.abs(table["s"] - 1.5) < pipe.diameter
    off = np.hypot(table["x"], table["y"] + 0.012 * table["piece"])
    for error, sigma in (
        (table["d_mean"] - pipe.diameter, table["d_mean_sigma"]),
        (table["ovality"] - 0.02, table["ovality_sigma"]),
        (off, table["centre_sigma"]),
    ):
        assert beside.sum() >= 6 and (np.abs(error[beside]) < 3.5 * sigma[beside]).all()
        assert np.sqrt(np.mean(error[beside] ** 2)) < 2 * np.sqrt(np.mean(error[~beside] ** 2)) + sigma.mean()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_displaced_joint_is_found_with_its_step(seed: int) -> None:
    pipe = Pipe(joint=(1.5, 0.012, 0.0), seed=seed)
    joint = of_kind(pf.fit_tube(pipe.points(2000), pipe.noise, pipe.cameras()), "joint")
    assert abs(joint["s"] - 1.5) < 0.03
    assert abs(joint["step"] - 0.012) < max(0.002, 2.5 * joint["step_sigma"])
    assert min(joint["clock"], 2 * math.pi - joint["clock"]) < 0.3  # upwards: twelve o'clock


def test_a_small_step_is_found_in_a_pipe_that_also_bends() -> None:
    """What the bend leaves of the stiff surface is no relief that hides the joint."""
    pipe = Pipe(
        diameter=0.4, length=5.5, bend=(2.4, math.radians(25), 1.2), joint=(1.6, 0.0045, 0.0), noise=0.001, seed=1
    )
    tube = pf.fit_tube(pipe.points(4000), pipe.noise, pipe.cameras())
    joint = of_kind(tube, "joint")
    assert abs(joint["s"] - 1.6) < 0.03 and abs(joint["step"] - 0.0045) < 0.0009
    assert [e["kind"] for e in tube.events] == ["joint", "bend"]


def test_an_open_joint_is_found_with_its_gap() -> None:
    pipe = Pipe(ring=(1.2, 0.03), seed=4)
    joint = of_kind(pf.fit_tube(pipe.points(4000), pipe.noise, pipe.cameras()), "joint")
    assert abs(joint["s"] - 1.2) < 0.005
    assert abs(joint["gap"] - 0.03) < max(0.2 * 0.03, 3 * joint["gap_sigma"])
    assert joint["step"] is None


@pytest.mark.parametrize(("height", "is_told"), [(0.0016, False), (0.0025, True)])
def test_a_heap_is_told_where_it_is_surely_more_than_tracks_have_in_common(height: float, is_told: bool) -> None:
    pipe = Pipe(deposit=(1.4, 3.0, 0.12, height), noise=0.0003, seed=5)
    tube = pf.fit_tube(pipe.points(2500), pipe.noise, pipe.cameras())
    assert [e["kind"] for e in tube.events] == ["deposit"] * is_told


@pytest.mark.parametrize(("sigma_of_the_highest", "is_sure"), [(0.0005, False), (0.0001, True)])
def test_points_that_are_the_highest_for_their_errors_make_no_height(
    sigma_of_the_highest: float, is_sure: bool
) -> None:
    """Seven points, 2.4 mm by the two that are known least: as tracks in a bend had them where nothing is."""
    points = {
        "distance": np.array([2.6, 2.2, 1.7, 1.3, 1.3, 0.9, 0.8]) / 1000,
        "sigma": np.array([sigma_of_the_highest] * 2 + [0.0002] * 5),
    }
    surely = tube_patches._surely(points, np.arange(7), 0.0024, 0.0002)
    assert (surely > tube_patches.LEAST_HEIGHT * 0.3) is is_sure


@pytest.mark.parametrize(("clock", "height"), [(3.0, 0.015), (0.05, 0.009), (4.5, -0.012)])
def test_deposits_and_holes_have_place_height_and_kind(clock: float, height: float) -> None:
    pipe = Pipe(deposit=(1.4, clock, 0.15, height), outliers=0.1, seed=5)
    tube = pf.fit_tube(pipe.points(5000), pipe.noise, pipe.cameras())
    found = of_kind(tube, "deposit" if height > 0 else "hole")
    assert abs(found["s"] - 1.4) < 0.02
    assert abs((found["clock"] - clock + math.pi) % (2 * math.pi) - math.pi) * 0.15 < 0.02
    assert abs(found["height"] - abs(height)) < max(0.2 * abs(height), 0.002)
    assert abs(found["length"] - 0.15) < 0.05 and abs(found["width"] - 0.15) < 0.05


@pytest.mark.parametrize(("size", "clock"), [(0.15, 1.5), (0.1, 4.5)])
def test_laterals_have_place_size_and_depth(size: float, clock: float) -> None:
    """Half a ball that is hollow, 50 and 60 mm deep: as much of a pipe's mouth as is seen."""
    depth = 0.05 if size > 0.12 else 0.06
    pipe = Pipe(deposit=(1.4, clock, size, -depth), seed=5)
    tube = pf.fit_tube(pipe.points(5000), pipe.noise, pipe.cameras())
    found = of_kind(tube, "lateral")
    turn = (found["clock"] - clock + math.pi) % (2 * math.pi) - math.pi
    for error, sigma in (
        (found["s"] - 1.4, found["s_sigma"]),
        (turn, found["clock_sigma"]),
        (found["length"] - size, found["size_sigma"]),
        (found["width"] - size, found["size_sigma"]),
        (found["height"] - depth, found["height_sigma"]),
    ):
        assert abs(error) < 2.5 * sigma
    assert found["s_sigma"] < 0.02 and found["size_sigma"] < 0.03 and found["height_sigma"] < 0.3 * depth


def test_a_heap_whose_far_flank_shows_few_points_is_told_at_its_middle() -> None:
    """As a camera sees it that looks over it: one in five of the points behind the top."""
    pipe = Pipe(deposit=(1.4, 3.0, 0.3, 0.012), noise=0.0005, seed=5)
    points = pipe.points(3000)
    behind = (points[:, 2] > 1.4) & (points[:, 2] < 1.57) & (points[:, 1] > 0)
    points = points[~behind | (np.arange(len(points)) % 5 == 0)]
    found = of_kind(pf.fit_tube(points, pipe.noise, pipe.cameras()), "deposit")
    assert abs(found["s"] - 1.4) < 0.015 and abs(found["length"] - 0.3) < 0.04
    assert abs(found["height"] - 0.012) < 0.002


class Heap(Pipe):
    """A pipe with a heap of any form: height by (x, y) from -1 to 1 along and around, lumpy by 4 % of it."""

    heap: tuple[float, float, float, float, float] = (0.0, 0.0, 1.0, 1.0, 0.0)  # chainage, clock, length, angle, height

    @staticmethod
    def form(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def radius(self, s: np.ndarray, clock: np.ndarray) -> np.ndarray:
        at, where, length, angle, height = self.heap
        x, y = (s - at) * 2 / length, ((clock - where + np.pi) % (2 * np.pi) - np.pi) * 2 / angle
        lumps = 1 + 0.04 * np.random.default_rng(self.seed + 5).normal(0, 1, len(s))
        return super().radius(s, clock) - height * self.form(x, y) * lumps


def cone(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.clip(1 - np.hypot(x, y), 0, 1)


def swept(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Steep before, drawn out behind its top at x = -0.4."""
    along = np.where(x < -0.4, (x + 0.4) / 0.6, (x + 0.4) / 1.4)
    return (np.clip(1 - along**2, 0, 1) * np.clip(1 - y**2, 0, 1)) ** 1.5


def bank(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """With a flat top."""
    return np.clip(1 - x**6, 0, 1) * np.clip(1 - y**4, 0, 1)


def fades(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (np.clip(1 - x**2, 0, 1) * np.clip(1 - y**2, 0, 1)) ** 3


@pytest.mark.parametrize(
    ("form", "diameter", "length", "angle", "height", "clock"),
    [
        (fades, 0.4, 1.3, 1.4, 0.06, 3.1),
        (cone, 0.3, 1.2, 1.0, 0.07, 4.4),
        (swept, 0.15, 1.8, 1.2, 0.08, 0.02),
        (bank, 0.6, 1.9, 1.0, 0.03, 3.1),
    ],
)
def test_few_points_tell_where_a_heap_of_any_form_lies_and_how_large_it_is(
    form, diameter: float, length: float, angle: float, height: float, clock: float
) -> None:
    """As many points as tracks leave of a drive, a third of them on the far side. Lengths and heights in diameters. By
    its outermost points the first of these was told 40 mm off."""
    pipe = Heap(diameter=diameter, length=8 * diameter, noise=0.0009 * diameter, outliers=0.03, seed=11)
    pipe.form, pipe.heap = form, (4.3 * diameter, clock, length * diameter, angle, height * diameter)
    points = pipe.points(3500)
    rng, s = np.random.default_rng(7), points[:, 2]
    away = (np.arctan2(points[:, 0], -points[:, 1]) - clock + np.pi) % (2 * np.pi) - np.pi
    behind = (s > pipe.heap[0]) & (s < pipe.heap[0] + 0.5 * pipe.heap[2]) & (np.abs(away) < angle / 2)
    tube = pf.fit_tube(points[~behind | (rng.random(len(s)) < 0.33)], pipe.noise, pipe.cameras(diameter / 8))
    found = of_kind(tube, "deposit")
    x = np.linspace(-1, 1, 2001)
    high = x[height * form(x[:, None], np.linspace(-1, 1, 101)).max(axis=1) > tube_patches.LEAST_HEIGHT]
    middle = pipe.heap[0] + 0.25 * (high[0] + high[-1]) * pipe.heap[2]
    place = float(tube.project(np.array([[0, 0, middle]]))["s"][0])  # the wall begins where its first points lie
    turn = (found["clock"] - clock + math.pi) % (2 * math.pi) - math.pi
    assert math.hypot(found["s"] - place, turn * diameter / 2) < 0.02
    visible = 0.5 * (high[-1] - high[0]) * pipe.heap[2]
    for value, true in ((found["length"], visible), (found["height"], pipe.heap[4])):
        assert abs(value - true) < max(0.2 * true, 0.002)


@pytest.mark.parametrize("link", [0.01, 0.08, 0.5, 3.0])
def test_points_beside_a_rim_are_those_of_all_pairs(link: float) -> None:
    """Over the seam at twelve o'clock, and where few or one of the cells go round the pipe."""
    rng = np.random.default_rng(7)
    p = {"s": rng.uniform(-1, 1, 900), "clock": rng.uniform(0, 2 * np.pi, 900)}
    p["clock"][:3] = 0.0, 2 * np.pi, np.nextafter(2 * np.pi, 0)
    rim, rows = np.arange(0, 900, 5), np.arange(1, 900, 2)
    reach = np.where(rng.random(len(rows)) < 0.5, 1.5, 1.0) * link
    away = (p["clock"][rows][:, None] - p["clock"][rim] + np.pi) % (2 * np.pi) - np.pi
    near = np.hypot(p["s"][rows][:, None] - p["s"][rim], away * 0.15) < reach[:, None]
    assert (tube_patches._beside(p, rows, rim, reach, 0.15) == near.any(axis=1)).all()
