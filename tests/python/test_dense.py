"""The dense wall: pictures of a pipe whose truth is exact, drawn by intersecting each pixel's ray with it.

Bounds on the error are those asked of a DN400: median 0.8 mm, 95 % within 3 mm."""

from __future__ import annotations

import io
import itertools
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import pipefish as pf
from pipefish import pipefish_pb2 as pb
from pipefish.cli import main
from pipefish.cloudfile import ply_bytes, read_columns
from pipefish.dense import CALIBRATION_PX, DenseWall, _tube_sigma
from pipefish.dense_cracks import chains, without_masonry, without_rings
from pipefish.dense_files import Strip, document_of, strips_of
from pipefish.dense_lines import Dark
from pipefish.dense_regions import find_regions
from pipefish.dense_steps import find_steps
from pipefish.measured_files import RING
from pipefish.surveywrite import OBJECT_END, OBJECT_KEYFRAME, OBJECT_START
from pipefish.wall import pieces_of
from pipefish.wallmodel import predicted_seeds
from synthetic import BOOT, SURVEY, as_object, write_survey

Floats = NDArray[np.float64]
R = 0.2
SIZE = 512
CAMERA = pf.Camera(width=SIZE, height=SIZE, f_u=165.0, f_v=165.0, c_u=255.0, c_v=256.5, theta_max=1.75)
WIDE = pf.Camera(width=SIZE, height=SIZE, f_u=139.0, f_v=139.0, c_u=255.0, c_v=256.5, theta_max=1.83)  # 104.9 degrees
START, FRAMES, STEP = 0.2, 7, 0.055
DEPOSIT = {"s": 0.42, "clock": 2.0, "height": 0.006, "length": 0.08, "extent": 0.5}


def radius(s: Floats, clock: Floats) -> Floats:
    """The wall: round, with one deposit."""
    x = 2 * (s - DEPOSIT["s"]) / DEPOSIT["length"]
    y = 2 * ((clock - DEPOSIT["clock"] + np.pi) % (2 * np.pi) - np.pi) / DEPOSIT["extent"]
    return R - DEPOSIT["height"] * np.clip(1 - x**2, 0, 1) ** 2 * np.clip(1 - y**2, 0, 1) ** 2


def paint(s: Floats, clock: Floats) -> Floats:
    """Waves along and around the pipe, 5 to 40 mm long; around, a whole number of them."""
    rng = np.random.default_rng(4)
    out = np.zeros_like(s, np.float32)
    for _ in range(60):
        length, turn, phase = 0.005 * 8 ** rng.random(), 2 * np.pi * rng.random(), 2 * np.pi * rng.random()
        around = round(2 * np.pi * R / length * np.sin(turn))
        out += np.cos((2 * np.pi / length * np.cos(turn) * s + around * clock + phase).astype(np.float32))
    return 0.5 + 0.14 * out / np.sqrt(30)


CRACK = np.array([[0.30, 4.0], [0.33, 4.07], [0.35, 4.03], [0.38, 4.10], [0.41, 4.08], [0.45, 4.17], [0.49, 4.15]])
CRACK_WIDTH = 0.0015  # of black
ROD = (0.46, 0.15)  # s and radius of a thin dark rod around the axis, off the wall


def cracked(s: Floats, clock: Floats) -> Floats:
    """How dark the crack is: a soft line along CRACK (s, clock), 0 to 0.75."""
    near = (s > 0.29) & (s < 0.5) & (np.abs((clock - 4.1 + np.pi) % (2 * np.pi) - np.pi) < 0.2)
    p = np.column_stack([s[near], R * (clock[near] % (2 * np.pi))])
    ends = CRACK * [1, R]
    off = np.full(len(p), np.inf)
    for a, b in itertools.pairwise(ends):
        t = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        off = np.minimum(off, np.linalg.norm(p - a - t[:, None] * (b - a), axis=1))
    out = np.zeros(len(s))
    sigma = CRACK_WIDTH / 0.75 / np.sqrt(2 * np.pi)
    out[near] = 0.75 * np.exp(-0.5 * (off / sigma) ** 2)
    return out


def pose(k: int) -> Floats:
    """cam_from_world: along z, beside the axis, turned a little; x right, y down."""
    yaw, pitch, roll = 0.03 * np.sin(k), 0.02 * np.cos(2 * k), 0.04 * np.sin(0.7 * k)
    c, s = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    turn = np.array([[c[0], 0, s[0]], [0, 1, 0], [-s[0], 0, c[0]]])
    turn = turn @ np.array([[1, 0, 0], [0, c[1], -s[1]], [0, s[1], c[1]]])
    turn = turn @ np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
    centre = np.array([0.006 * np.sin(1.3 * k), 0.012, START + STEP * k])
    return np.column_stack([turn, -turn @ centre])


@cache
def drawn(k: int, camera: pf.Camera = CAMERA) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Of each pixel: paint, light (0 outside the circle), s, clock, metres from the rod."""
    v, u = np.mgrid[:SIZE, :SIZE]
    rays, ok = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    p = pose(k)
    centre, d = -p[:, :3].T @ p[:, 3], rays @ p[:, :3]
    ok &= np.hypot(d[:, 0], d[:, 1]) > 0.2
    d = np.where(ok[:, None], d, [1.0, 0, 0])
    a, b = (d[:, :2] ** 2).sum(axis=1), d[:, :2] @ centre[:2]

    def meets(wall: Any) -> tuple[Floats, Floats, Floats]:
        far = (-b + np.sqrt(b**2 - a * (centre[:2] @ centre[:2] - wall**2))) / a
        hit = centre + far[:, None] * d
        return far, hit, np.arctan2(hit[:, 0], -hit[:, 1])

    wall = np.full(len(d), R)
    for _ in range(6):  # the wall's slope is gentle: the radius where the ray meets settles at once
        far, hit, clock = meets(wall)
        wall = radius(hit[:, 2], clock)
    light = 1.2 / (1 + (far / R) ** 1.5)  # the lamp is at the camera
    _, there, around = meets(ROD[1])
    rod = np.where(np.abs(around) < 1.0, np.abs(there[:, 2] - ROD[0]) * np.hypot(d[:, 0], d[:, 1]), 1.0)
    return paint(hit[:, 2], clock), np.where(ok, 255 * light, 0), hit[:, 2], clock, rod


def with_noise(k: int, value: Floats) -> NDArray[np.uint8]:
    noise = np.random.default_rng(k).normal(0, 2, len(value))
    return np.rint(value + noise).clip(0, 255).astype(np.uint8).reshape(SIZE, SIZE)


def render(k: int, camera: pf.Camera = CAMERA) -> NDArray[np.uint8]:
    value, light, *_ = drawn(k, camera)
    return with_noise(k, value * light)


@cache
def damaged(k: int) -> NDArray[np.uint8]:
    """With the crack and the rod, on a calmer wall: waves all over are no wall that cracks could be told on."""
    value, light, s, clock, rod = drawn(k)
    return with_noise(
        k, (0.5 + 0.25 * (value - 0.5)) * light * (1 - cracked(s, clock)) * np.where(rod < 0.0012, 0.3, 1)
    )


def rings(r: float = R, start: float = 0.1, end: float = 0.85) -> Floats:
    c = np.arange(RING) * 2 * np.pi / RING
    around = np.column_stack([r * np.sin(c), -r * np.cos(c), np.zeros(RING)])
    return np.stack([around + np.array([0, 0, z]) for z in np.arange(start, end, 0.04)])


@pytest.fixture(scope="module")
def pictures() -> list[NDArray[np.uint8]]:
    return [render(k) for k in range(FRAMES)]


POSES = np.stack([pose(k) for k in range(FRAMES)])


@pytest.fixture(scope="module")
def found(pictures: list[NDArray[np.uint8]]) -> DenseWall:
    """The camera is exact, so nothing is added to sigma for its calibration."""
    return pf.dense_wall(pictures.__getitem__, CAMERA, POSES, pf.WallModel(rings()), calibration_px=0.0)


def errors(f: DenseWall) -> Floats:
    """Radial error of the measured cells, metres; NaN elsewhere."""
    p = f.points
    return np.hypot(p[..., 0], p[..., 1]) - radius(p[..., 2], np.arctan2(p[..., 0], -p[..., 1]))


def test_the_wall_is_covered_and_measured_to_a_millimetre(found: DenseWall) -> None:
    e = np.abs(errors(found)[np.isfinite(found.deviation)])
    assert found.coverage >= 0.85 and len(e) > 8000
    assert np.median(e) <= 0.0008 and np.percentile(e, 95) <= 0.003
    assert abs(np.nanmedian(errors(found))) <= 0.0002


def test_sigmas_are_those_of_the_errors(found: DenseWall) -> None:
    """95 % of the errors within 1 to 2.4 sigma. Exact sigmas give 1.96; pairs that share a keyframe are taken to tell
    half as much, which here is less than they do."""
    ratio = np.abs(errors(found) / found.sigma)
    assert 1.0 <= np.nanpercentile(ratio, 95) <= 2.4


def test_sigmas_hold_what_a_calibration_leaves(pictures: list[NDArray[np.uint8]]) -> None:
    """The map by a camera whose radius waves by 0.12 px about the true one (0.064 px rms: two rays of a match at
    different angles are 0.09 px apart). No scatter of the pairs tells that; without the term for it, 95 % are within
    3.3 sigma."""
    theta = np.linspace(0, CAMERA.theta_max, 500)[1:]
    powers = theta[:, None] ** np.array([1, 3, 5, 7, 9])
    wave = 0.1 * np.sin(2 * np.pi * theta)
    f, *k = np.linalg.lstsq(powers, CAMERA.f_u * theta + wave, rcond=None)[0]
    values = {name: value / f for name, value in zip(("k2", "k3", "k4", "k5"), k, strict=True)}
    size = {name: getattr(CAMERA, name) for name in ("width", "height", "c_u", "c_v", "theta_max")}
    waved = pf.Camera(f_u=f, f_v=f, **size, **values)
    short = pf.WallModel(rings(start=0.3, end=0.6))
    ratio = {px: waved_ratio(pictures, waved, short, px) for px in (0.0, CALIBRATION_PX)}
    assert ratio[0.0] > 2.5 and 0.8 <= ratio[CALIBRATION_PX] <= 1.96


def test_sigmas_hold_a_tube_that_is_off(found: DenseWall) -> None:
    """A tube 0.8 mm beside the wall's axis and 0.6 mm too narrow: deviations are off by 0.8 mm rms, alike for
    neighbours and for all pairs, so that no scatter tells it."""
    off = 0.0006 + 0.0008 * np.cos(found.clock)
    own = np.sqrt(found.sigma**2 - found.tube_sigma**2)
    term = _tube_sigma(replace(found, deviation=found.deviation + off))
    assert found.tube_sigma < 0.0001 and 0.0007 < term < 0.0012
    measured = np.isfinite(found.deviation)
    error = np.abs(errors(found) + off)[measured]
    assert np.mean(error <= 1.96 * own[measured]) < 0.6
    assert np.mean(error <= 1.96 * np.hypot(own, term)[measured]) >= 0.95


def waved_ratio(pictures: list[NDArray[np.uint8]], camera: pf.Camera, wall: pf.WallModel, px: float) -> float:
    """95th percentile of error over sigma without what the map's own mean and shift add to it, which tell it too."""
    f = pf.dense_wall(pictures.__getitem__, camera, POSES, wall, calibration_px=px)
    return float(np.nanpercentile(np.abs(errors(f)) / np.sqrt(f.sigma**2 - f.tube_sigma**2), 95))


def test_a_deposit_is_found_where_it_is(found: DenseWall) -> None:
    assert len(found.regions) == 1
    r = found.regions[0]
    assert abs(r["s"] + 0.1 - DEPOSIT["s"]) < 0.012 and abs(r["clock"] - DEPOSIT["clock"]) < 0.06
    assert -1.1 * DEPOSIT["height"] < r["height"] < -0.6 * DEPOSIT["height"]
    assert abs(r["height"]) > 3 * r["sigma"] and r["volume"] < 0


@pytest.fixture(scope="module")
def cracks(found: DenseWall) -> list[dict[str, Any]]:
    return pf.find_cracks(found, damaged, CAMERA, POSES)


def test_a_crack_is_found_where_it_is_and_a_rod_off_the_wall_is_none(cracks: list[dict[str, Any]]) -> None:
    """A cell of the pictures is 1.2 mm. The rod shows as dark a line in each keyframe, in another place each time."""
    (c,) = cracks
    ends = CRACK * [1, R]
    true = float(np.linalg.norm(np.diff(ends, axis=0), axis=1).sum())
    assert abs(c["length"] - true) < 3 * c["length_sigma"] and c["direction"] == "along"
    assert abs(c["s"] + 0.1 - 0.395) < 0.01 and abs(c["clock"] - 4.09) < 0.04
    path = np.array(c["path"])
    path[:, 0] += 0.1
    inner = path[(path[:, 0] > 0.31) & (path[:, 0] < 0.48)]
    off = np.abs(inner[:, 1] - np.interp(inner[:, 0], *CRACK.T)) * R
    assert np.median(off) < 0.0008 and off.max() < 0.005
    assert 0.6 * CRACK_WIDTH < c["width"] < 1.3 * CRACK_WIDTH and c["width_sigma"] < 0.0005
    assert 0 < c["sigma"] < 0.001 and c["views"] >= 2
    assert abs(c["offset"]) < 4 * c["offset_sigma"]


def test_joints_and_mortar_are_no_cracks() -> None:
    """Of dark cells: a tilted ring goes, what crosses it stays; between bricks lines along the courses and stairs go,
    while a line that wanders stays."""
    columns, cell = 1000, 0.001
    unroller = SimpleNamespace(columns=columns, cell=cell, wall=SimpleNamespace(mean_radius=columns * cell / 2 / np.pi))

    def dark(x: Floats, y: Floats, turn: Floats) -> Dark:
        one = np.ones(len(x))
        return Dark(x, y, turn, one, 0.1 * one, 3 * one, 3 * one, 0.3 * one, 0.05 * one)

    x = np.arange(0, 1000.0)
    tilted = 400 + 12 * np.cos(2 * np.pi * x / columns)
    y = np.arange(250.0, 550)
    wander = 500 + 0.3 * (y - 250) + 6 * (np.abs((y / 10) % 2 - 1) - 0.5)
    turn = np.full(len(y), np.pi / 2 - 0.3)
    both = dark(np.r_[x, wander], np.r_[tilted, y], np.r_[0 * x, turn])
    kept = without_rings(both, columns)
    assert len(kept) < 310 and (np.abs(kept.x - 500) < 120).all() and len(kept) > 280
    courses = [(np.full(300, 40.0 + 60 * k), y, np.full(300, np.pi / 2)) for k in range(5)]
    stair = (np.r_[np.full(80, 700.0), np.arange(700.0, 760), np.full(90, 760.0)],
             np.r_[y[:80], np.full(60, 330.0), y[80:170]],
             np.r_[np.full(80, np.pi / 2), np.zeros(60), np.full(90, np.pi / 2)])  # fmt: skip
    wall = dark(*(np.concatenate(v) for v in zip(*courses, stair, (wander, y, turn), strict=True)))
    lines = chains(wall, unroller)
    left = without_masonry(lines, wall, unroller)
    assert len(lines) == 7 and len(left) == 1 and np.abs(wall.x[left[0]] - 545).max() < 60
    only = dark(*courses[0])
    assert len(without_masonry(chains(only, unroller), only, unroller)) == 1, "one straight line is no masonry"


def test_a_cracks_edges_that_are_offset_are_told(found: DenseWall, cracks: list[dict[str, Any]]) -> None:
    """The map where the wall beyond the crack, by clock, stands 1 mm further out."""
    s, clock = np.meshgrid(found.s + 0.1, found.clock, indexing="ij")
    beyond = clock > np.interp(s, *CRACK.T)
    moved = replace(found, deviation=found.deviation + 0.001 * (beyond & (clock < 5.0)))
    (c,) = pf.find_cracks(moved, damaged, CAMERA, POSES)
    assert abs(c["offset"] - cracks[0]["offset"] - 0.001) < 0.0002 and c["offset"] > 3 * c["offset_sigma"]


def test_a_bare_pipe_has_no_regions(found: DenseWall) -> None:
    """The same map with the deposit's cells replaced by their errors."""
    plain = replace(found, deviation=np.where(np.isfinite(found.deviation), errors(found), np.nan), regions=[])
    assert find_regions(plain) == []


def stepped(found: DenseWall, at: float, aside: float, clock: float, wider: float) -> DenseWall:
    """The map where from `at` on the pipe lies aside and is wider, less what a smooth tube takes up of it: a slope over
    0.16 m."""
    after = np.clip((found.s - at) / 0.16 + 0.5, 0, 1)
    left = (found.s >= at) - after
    moved = left[:, None] * (aside * np.cos(found.clock - clock) + wider)[None]
    return replace(found, deviation=found.deviation + moved, regions=[], steps=[])


@pytest.mark.parametrize(("aside", "wider"), [(0.003, 0.0), (0.0, -0.002), (0.002, 0.0015)])
def test_a_joint_that_steps_aside_or_in_width_is_found(found: DenseWall, aside: float, wider: float) -> None:
    (r,) = find_steps(stepped(found, 0.45, aside, 2.5, wider))
    assert abs(r["s"] - 0.45) < 0.006
    assert abs(r["step"] - aside) < 0.2 * max(aside, 0.002) and abs(r["widening"] - wider) < 0.2 * max(aside, 0.002)
    if aside:
        assert abs(r["clock"] - 2.5) < 0.15


def test_what_a_step_makes_of_the_wall_beside_it_is_no_region(found: DenseWall) -> None:
    after = np.where(found.s >= 0.45, 0.003, 0)[:, None] * np.cos(found.clock - 2.5)
    plain = replace(found, deviation=found.deviation + after, steps=[])
    assert len(find_regions(plain)) > 1
    (r,) = find_regions(replace(plain, steps=find_steps(plain)))
    assert abs(r["s"] + 0.1 - DEPOSIT["s"]) < 0.012


def test_neither_a_deposit_nor_a_slope_nor_an_oval_is_a_step(found: DenseWall) -> None:
    assert found.steps == [] and np.isfinite(found.deviation).sum() > 8000
    slope = 0.02 * (found.s - 0.45)[:, None] * np.cos(found.clock - 1.0)
    oval = 0.003 * (found.s >= 0.45)[:, None] * np.cos(2 * found.clock)
    assert find_steps(replace(found, deviation=found.deviation + slope + oval)) == []


def test_a_step_is_told_along_the_chainage_which_may_run_against_s(found: DenseWall) -> None:
    with_step = stepped(found, 0.45, 0.003, 2.5, 0.001)
    with_step.steps.extend(find_steps(with_step))
    for sign in (1, -1):
        (r,) = document_of([with_step], [Strip(found.wall, 5.0, sign)], "metre", {})["steps"]
        assert abs(r["chainage"] - (5.0 + sign * 0.45)) < 0.006
        assert abs(r["widening"] - sign * 0.001) < 0.0004
        assert abs(r["clock"] - (2.5 if sign > 0 else 2.5 + np.pi)) < 0.15


@pytest.mark.parametrize(("share", "beside"), [(1.1, 0.003), (0.9, 0.0)])
def test_the_result_does_not_hang_on_the_fitted_tube(
    share: float, beside: float, pictures: list[NDArray[np.uint8]], found: DenseWall
) -> None:
    """A tube a tenth too wide and beside the true axis, or too narrow: rays are triangulated, so the wall stays within
    0.5 mm. Compared are radii in bins of 10 mm along and 10 mm around, where both maps have three cells or more."""
    wrong = rings(share * R, start=0.25, end=0.65) + np.array([beside, 0, 0])
    other = pf.dense_wall(pictures.__getitem__, CAMERA, POSES, pf.WallModel(wrong), calibration_px=0.0)
    assert other.coverage >= 0.75
    assert abs(np.nanmedian(other.deviation) - (1 - share) * R) < 0.002
    change = binned(other) - binned(found)
    change = change[np.isfinite(change)]
    assert len(change) > 2000
    assert abs(np.median(change)) <= 0.00005 and np.mean(np.abs(change) <= 0.0005) >= 0.95


def binned(f: DenseWall) -> Floats:
    """Median radius in bins of 10 mm along z (of 0.8 m) and 10 mm around; NaN with less than three cells."""
    p = f.points[np.isfinite(f.deviation)]
    around = round(2 * np.pi * R / 0.01)
    bins = (p[:, 2] / 0.01).astype(int) * around
    bins += ((np.arctan2(p[:, 0], -p[:, 1]) / (2 * np.pi) % 1) * around).astype(int)
    r = np.hypot(p[:, 0], p[:, 1])
    order = np.lexsort((r, bins))
    key, start, count = np.unique(bins[order], return_index=True, return_counts=True)
    out = np.full(100 * around, np.nan)
    out[key[count >= 3]] = r[order][start + count // 2][count >= 3]
    return out


def test_raw_and_unrolled_keyframes_tell_the_same_wall(pictures: list[NDArray[np.uint8]], found: DenseWall) -> None:
    """Two ways of matching, one with an affine map at each match, agree within 2 of their sigmas; a bend of the map
    within the window that were not taken out would leave 86 %."""
    raw = pf.dense_wall(pictures.__getitem__, CAMERA, POSES, found.wall, raw=True, calibration_px=0.0)
    difference = (raw.deviation - found.deviation) / np.hypot(raw.sigma, found.sigma)
    difference = difference[np.isfinite(difference)]
    assert len(difference) > 10_000
    assert np.mean(np.abs(difference) <= 2) >= 0.95
    assert np.nanpercentile(np.abs(errors(raw)), 95) <= 0.003


def test_threads_do_not_change_the_map(pictures: list[NDArray[np.uint8]]) -> None:
    wall = pf.WallModel(rings(start=0.25, end=0.65))
    maps = [pf.dense_wall(pictures.__getitem__, CAMERA, POSES, wall, scale=1.5, threads=n) for n in (1, 3)]
    assert np.isfinite(maps[0].deviation).sum() > 1000
    for name in ("deviation", "sigma", "pairs", "brightness"):
        assert np.array_equal(getattr(maps[0], name), getattr(maps[1], name), equal_nan=True), name


def test_places_and_points_of_a_bent_oval_wall_are_inverse() -> None:
    c, arc = np.arange(RING) * 2 * np.pi / RING, np.arange(0, 1.2, 0.04)
    bend = 1.5  # metres of radius, to the right
    axis = np.column_stack([bend * (1 - np.cos(arc / bend)), 0 * arc, bend * np.sin(arc / bend)])
    right = np.column_stack([np.cos(arc / bend), 0 * arc, -np.sin(arc / bend)])
    r = 0.2 + 0.004 * np.cos(2 * c)
    wall = pf.WallModel(
        axis[:, None] + (r * np.sin(c))[None, :, None] * right[:, None] - (r * np.cos(c))[None, :, None] * [0, 1, 0]
    )
    rng = np.random.default_rng(1)
    s, clock, off = rng.uniform(0.1, 1.0, 500), rng.uniform(0, 2 * np.pi, 500), rng.uniform(-0.02, 0.02, 500)
    back = wall.locate(wall.points(s, clock, off))
    for got, want, bound in zip(back, (s, clock, off), (1e-6, 1e-6, 1e-6), strict=True):
        assert np.abs(got - want).max() < bound
    assert np.abs(wall.radius(s, clock) - 0.2 - 0.004 * np.cos(2 * clock)).max() < 3e-5
    assert abs(wall.length - arc[-1]) < 1e-3


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"poses": np.zeros((2, 3, 3))}, "poses: shape"),
        ({"poses": POSES[:1]}, "poses: no two keyframes"),
        ({"cell": 1.0}, "cell: 1.0"),
        ({"scale": 99.0}, "scale: 99"),
        ({"threads": 0}, "threads: 0 is not at least 1"),
        ({"images": lambda k: np.zeros((64, 64), np.uint8)}, "keyframe 0: 64x64 is not the camera's 512x512"),
    ],
)
def test_wrong_arguments_are_named(change: dict, what: str, pictures: list[NDArray[np.uint8]]) -> None:
    arguments = {"images": pictures.__getitem__, "camera": CAMERA, "poses": POSES, "wall": pf.WallModel(rings())}
    with pytest.raises(pf.ArgumentError, match=what):
        pf.dense_wall(**arguments | change)


def test_cracks_are_looked_for_in_keyframes_of_the_camera_only(found: DenseWall) -> None:
    with pytest.raises(pf.ArgumentError, match="poses: shape"):
        pf.find_cracks(found, damaged, CAMERA, POSES[0])
    with pytest.raises(pf.ArgumentError, match="keyframe 0: 64x64 is not the camera's 512x512"):
        pf.find_cracks(found, lambda k: np.zeros((64, 64), np.uint8), CAMERA, POSES)


def test_rings_that_are_none_are_refused() -> None:
    with pytest.raises(pf.ArgumentError, match="rings: shape"):
        pf.WallModel(np.zeros((5, 3)))
    with pytest.raises(pf.ArgumentError, match="rings: two at one place"):
        pf.WallModel(np.repeat(rings()[:1], 3, axis=0))


def truth(pixels: Floats, one: Floats, two: Floats, camera: pf.Camera = CAMERA) -> Floats:
    """Where pixels of a keyframe at pose `one` are at pose `two`, by the true wall."""
    rays, _ = camera.unproject(pixels)
    centre, d = -one[:, :3].T @ one[:, 3], rays @ one[:, :3]
    a, b = (d[:, :2] ** 2).sum(axis=1), d[:, :2] @ centre[:2]
    wall = np.full(len(d), R)
    for _ in range(6):
        far = (-b + np.sqrt(b**2 - a * (centre[:2] @ centre[:2] - wall**2))) / a
        hit = centre + far[:, None] * d
        wall = radius(hit[:, 2], np.arctan2(hit[:, 0], -hit[:, 1]))
    return camera.project(hit @ two[:, :3].T + two[:, 3])[0]


def test_raw_keyframes_match_to_100_degrees_from_seeds_that_the_tube_predicts() -> None:
    """As they come from a camera that sees to 105 degrees from its axis; the tube is 3 % too wide. Behind the camera,
    where a point has Z < 0, they match as well as beside it, in each degree to 102; then the window meets the rim."""
    one, two = POSES[1], POSES[3]
    grid = np.stack(np.meshgrid(np.arange(40, SIZE, 48), np.arange(40, SIZE, 48)), axis=-1).reshape(-1, 2)
    seeds = predicted_seeds(pf.WallModel(rings(1.03 * R, start=0.0, end=1.5)), WIDE, one, two, grid)
    assert len(seeds) > 30
    relative = two[:, :3] @ one[:, :3].T
    pose = np.column_stack([relative, two[:, 3] - relative @ one[:, 3]])
    m = pf.match_quasi_dense(render(1, WIDE), render(3, WIDE), seeds, WIDE, pose)
    off = np.linalg.norm(m.xy2 - truth(m.xy1, one, two, WIDE), axis=1)
    off = np.nan_to_num(off, nan=np.inf)  # what the rim hides in the second
    theta = np.degrees(np.arccos(WIDE.unproject(m.xy2)[0][:, 2]))
    assert len(m) > 30_000
    assert np.median(off) <= 0.15 and np.mean(off < 1) >= 0.97
    for degree in range(90, 102):
        here = (theta >= degree) & (theta < degree + 1)
        assert here.sum() > 500 and np.mean(off[here] < 1) >= 0.99, degree


def test_predicted_seeds_are_exact_on_the_wall_that_they_assume() -> None:
    one, two = POSES[0], POSES[2]
    pixels = np.array([[255.0, 150.0], [350.0, 300.0], [170.0, 330.0], [150.0, 256.0]])
    seeds = predicted_seeds(pf.WallModel(rings(start=-0.5, end=2.0)), CAMERA, one, two, pixels)
    assert len(seeds) == 4
    assert np.abs(seeds.xy2 - truth(pixels, one, two)).max() < 0.02  # rings are 40 mm and 5 degrees apart
    for d in (np.array([0.5, 0.0]), np.array([0.0, 0.5])):
        slope = truth(pixels + d, one, two) - truth(pixels - d, one, two)
        assert np.abs(seeds.affine @ (2 * d) - slope).max() < 0.01


# ---- the command


def wall_columns(points: NDArray[np.float64], chainage: Any) -> dict[str, NDArray[Any]]:
    """tube.ply of one piece: rings (n RING, 3) at these chainages (n,)."""
    columns = dict(zip("xyz", points.reshape(-1, 3).T.astype(np.float32), strict=True))
    nothing = np.zeros(len(columns["x"]), np.int32)
    columns |= {"deviation": nothing.astype(np.float32), "piece": nothing, "stretch": nothing}
    return columns | {"chainage": np.repeat(np.asarray(chainage, float), RING)}


def measured_folder(folder: Path, pictures: list[NDArray[np.uint8]]) -> Path:
    """What `pipefish reconstruct` leaves, as far as `dense` reads it, and the survey, with every second cell's work."""
    begin = pb.SurveyStart(survey_id=SURVEY, name="made-up", software="test", width=SIZE, height=SIZE)
    begin.time.boot_id, begin.profile = BOOT, CAMERA.to_binary()
    objects = [as_object(OBJECT_START, begin)]
    for index, grey in enumerate(pictures):
        stream = io.BytesIO()
        Image.fromarray(grey).save(stream, "JPEG", quality=92)
        message = pb.Keyframe(survey_id=SURVEY, index=index, frame_sequence=index, cause=2, after_break=index == 0)
        message.width, message.height, message.jpeg = SIZE, SIZE, stream.getvalue()
        message.time.boot_id, message.time.monotonic_ns = BOOT, 10**9 * (index + 1)
        objects.append(as_object(OBJECT_KEYFRAME, message))
    finish = pb.SurveyEnd(survey_id=SURVEY, keyframes=len(pictures), frames=len(pictures), boots=1, reason="done")
    write_survey(folder / "survey.mcap", objects=[*objects, as_object(OBJECT_END, finish)])
    points = rings()
    (folder / "tube.ply").write_bytes(ply_bytes(wall_columns(points, 4.9 + points[:, 0, 2])))
    from pipefish.simulate import quaternion

    z = [0.1, 0.4, 0.7]
    document = {
        "format": "pipefish-reconstruction",
        "version": 1,
        "summary": {"unit": "metre", "d_mean": 2 * R, "station_sigma": 0.001, "station_systematic": 0.006 * R},
        "survey": {"file": str(folder / "survey.mcap"), "survey_id": SURVEY.hex()},
        "camera": {"profile": json.loads(CAMERA.to_json())},
        "poses": {
            "keyframe": list(range(FRAMES)),
            "quaternion": [quaternion(p[:, :3]).tolist() for p in POSES],
            "translation": POSES[:, :, 3].tolist(),
            "stretch": [0] * FRAMES,
        },
        "stations": {
            "stretch": [0, 0, 0],
            "chainage": [5.0, 5.3, 5.6],
            **{"x": [0, 0, 0], "y": [0, 0, 0], "z": z, "tx": [0, 0, 0], "ty": [0, 0, 0], "tz": [1, 1, 1]},
        },
        "tubes": [{"stretch": 0, "chainage_sign": 1}],
    }
    (folder / "reconstruction.json").write_text(json.dumps(document))
    return folder


def test_the_command_writes_a_map_a_cloud_and_what_stands_in_the_pipe(
    tmp_path: Path, pictures: list[NDArray[np.uint8]], capsys: pytest.CaptureFixture
) -> None:
    folder, out = measured_folder(tmp_path, pictures), tmp_path / "out"
    assert main(["dense", str(folder), "-o", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["coverage"] > 0.85 and document["format"] == "pipefish-dense"
    assert document["radius_sigma"] == 0.0005 and document["scale_sigma"] == pytest.approx(
        0.003
    )  # what all cells have in common
    packed = np.load(out / "dense.npz")
    cloud = read_columns(out / "dense.ply")
    good = np.isfinite(packed["deviation"])
    shared = 0.0005**2 + (0.003 * R) ** 2
    assert np.allclose(packed["sigma_radius"][good], np.sqrt(packed["sigma"][good] ** 2 + shared), rtol=0.01)
    assert np.allclose(cloud["sigma_radius"], packed["sigma_radius"][good], rtol=1e-5)
    assert len(cloud["x"]) == good.sum() == document["measured"]
    assert np.allclose(cloud["deviation"], packed["deviation"][good], atol=1e-7)
    assert np.abs(np.hypot(cloud["x"], cloud["y"]) - R - cloud["deviation"]).max() < 1e-4
    rows = (out / "deviation.csv").read_text().splitlines()
    assert len(rows) == len(packed["s"]) + 1 and rows[0].startswith("chainage / clock (mm),")
    assert abs(float(rows[1].split(",")[0]) - packed["chainage"][0]) < 1e-4
    r = document["regions"][0]
    assert r["kind"] == "inwards" and abs(r["chainage"] - (5.0 + DEPOSIT["s"] - 0.1)) < 0.012
    assert Image.open(out / "dense.png").size[0] > 400


@pytest.mark.parametrize(
    ("name", "change", "what"),
    [
        ("reconstruction.json", b"{}", "reconstruction.json: format: not 'pipefish-reconstruction'"),
        (
            "reconstruction.json",
            b'{"format": "pipefish-reconstruction", "version": 1}',
            "reconstruction.json: not whole",
        ),
        ("tube.ply", b"nothing", "tube.ply: not a PLY file"),
        ("survey.mcap", b"nothing", "survey.mcap"),
    ],
)
def test_the_command_names_a_bad_file(
    name: str, change: bytes, what: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = measured_folder(tmp_path, [np.zeros((SIZE, SIZE), np.uint8)] * FRAMES)
    (folder / name).write_bytes(change)
    assert main(["dense", str(folder), "-o", str(tmp_path / "out")]) == 1
    assert what in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_another_survey_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = measured_folder(tmp_path, [np.zeros((SIZE, SIZE), np.uint8)] * FRAMES)
    text = (folder / "reconstruction.json").read_text().replace(SURVEY.hex(), "00" * 16)
    (folder / "reconstruction.json").write_text(text)
    assert main(["dense", str(folder), "-o", str(tmp_path / "out")]) == 1
    assert "is not the survey that" in capsys.readouterr().err


def test_pieces_of_a_tube_stay_apart_and_their_chainage_runs_either_way(tmp_path: Path) -> None:
    both = np.concatenate([rings(end=0.4), rings(1.01 * R, start=0.45)])
    first, s = len(rings(end=0.4)), both[:, 0, 2]
    for sign in (1, -1):
        columns = wall_columns(both, 7.0 + sign * s)
        columns["piece"] = np.repeat([0, 1], [first * RING, (len(both) - first) * RING]).astype(np.int32)
        document = {"tubes": [{"stretch": 0, "chainage_sign": sign}]}
        strips = strips_of(pieces_of(columns, document, tmp_path))
        strips.sort(key=lambda strip: strip.sign * strip.origin)
        assert len(strips) == 2 and abs(strips[1].wall.mean_radius / strips[0].wall.mean_radius - 1.01) < 1e-4
        for strip in strips:  # the wall's own s and the chainage tell the same places
            z = strip.wall.points([0.05], [1.0])[0][2]
            assert abs(strip.origin + strip.sign * 0.05 - (7.0 + sign * z)) < 1e-3
