"""Quasi-dense matching: the way back and what it confirms, geometry, seeds of either contrast, odd arguments."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import pipefish as pf
from pipefish.cli import main
from pipefish.matching_files import read_grey, statistics
from pipefish.matching_filters import confirmed, dominant_geometry, select
from test_match import (
    FISHEYE,
    POSE,
    H,
    W,
    affine,
    errors,
    fisheye_seed,
    fisheye_truth,
    grid,
    noisy,
    one_seed,
    pair,
    rendered,
    spoiled,
)

A = np.array([[0.9, -0.2], [0.25, 1.0]])


@pytest.fixture(scope="module")
def turned() -> tuple:
    """An affine pair of pictures, its map, and its matches."""
    there, back = affine(A)
    one, two = pair(back)
    return one, two, there, pf.match_quasi_dense(one, two, one_seed(there, A))


# ---- the way back


def test_the_way_back_confirms_what_is_right_and_nothing_else(turned: tuple) -> None:
    one, two, there, m = turned
    m, wrong = spoiled(m, 0.2)
    held = confirmed(m, pf.match_back(one, two, m))
    assert wrong.sum() > 1000
    assert held[~wrong].mean() >= 0.95 and held[wrong].mean() <= 0.005
    kept = pf.filter_matches(m, least=0, back=pf.match_back(one, two, m))
    assert len(kept) == held.sum() and np.mean(errors(kept, there) < 1) >= 0.995


def test_the_way_back_has_the_cameras_and_the_motion_the_other_way_round() -> None:
    """The second picture by another camera: half the size of the first one's."""
    one, large = rendered(np.eye(3, 4)), rendered(POSE)
    two = large.reshape(H // 2, 2, W // 2, 2).mean(axis=(1, 3))  # its pixel x is at 2 x + 0.5 of the large one
    small = pf.Camera(width=W // 2, height=H // 2, f_u=35.0, f_v=35.0, c_u=49.5, c_v=39.5, theta_max=2.0)
    seed = fisheye_seed()
    seeds = pf.Seeds(seed.xy1, (seed.xy2 - 0.5) / 2, seed.affine / 2)
    geometry = (FISHEYE, small), POSE
    m = pf.match_quasi_dense(one, two, seeds, *geometry)
    assert len(m) > 2000
    assert np.mean(np.linalg.norm(2 * m.xy2 + 0.5 - fisheye_truth(m.xy1), axis=1) < 1) >= 0.99
    back = pf.match_back(one, two, m, *geometry)
    assert len(back) >= 0.9 * len(m)
    assert len(pf.filter_matches(m, least=0, back=back)) >= 0.9 * len(m)
    with pytest.raises(pf.ArgumentError, match="needs both"):
        pf.match_back(one, two, m, FISHEYE)


def test_the_command_confirms_both_ways_with_the_motion(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for name, pose in (("a.png", np.eye(3, 4)), ("b.png", POSE)):
        Image.fromarray((255 * rendered(pose)).astype(np.uint8)).save(tmp_path / name)
    FISHEYE.save(tmp_path / "camera.json")
    np.savetxt(tmp_path / "pose.txt", POSE)
    seed = fisheye_seed()
    row = np.concatenate([seed.xy1[0], seed.xy2[0], seed.affine[0].ravel()])
    np.savetxt(tmp_path / "seeds.txt", row[None])
    arguments = ["match", *(str(tmp_path / n) for n in ("a.png", "b.png")), "-o", str(tmp_path / "out"), "--json"]
    arguments += ["--profile", str(tmp_path / "camera.json"), "--pose", str(tmp_path / "pose.txt")]
    arguments += ["--seeds", str(tmp_path / "seeds.txt")]
    found = {}
    for name in ("none", "both-ways"):
        assert main([*arguments, "--filter", name]) == 0
        found[name] = json.loads(capsys.readouterr().out)["matches"]
    xy = np.load(tmp_path / "out/matches.npz")
    one, two = (read_grey(tmp_path / name) for name in ("a.png", "b.png"))
    m = pf.match_quasi_dense(one, two, seed, FISHEYE, POSE)
    ways = [confirmed(m, pf.match_back(one, two, m, *g)).sum() for g in ((FISHEYE, POSE), ())]
    assert found["both-ways"] == ways[0] != ways[1]  # the way back is held to the motion too
    assert 0.9 * found["none"] <= found["both-ways"] < found["none"]
    assert np.mean(np.linalg.norm(xy["xy2"] - fisheye_truth(xy["xy1"]), axis=1) < 1) >= 0.995


# ---- seeds


def test_seeds_do_not_depend_on_the_sign_of_contrast() -> None:
    """Bright spots on a dark wall, among them few that are dark: a picture and its negative."""
    rng = np.random.default_rng(4)
    at, xy = rng.uniform(15, [305, 225], (160, 2)), grid(320, 240)
    spot = [[2 + 3 * rng.random(), t] for t in np.where(np.arange(160) < 120, 1.0, -1.0)]
    value = 0.45 + 0.02 * np.sin(xy[..., 0] / 7) * np.sin(xy[..., 1] / 9)
    for (x, y), (size, sign) in zip(at, spot, strict=True):
        u, v = (xy[..., 0] - x) / size, (xy[..., 1] - y) / size / rng.uniform(0.5, 1)
        value += sign * rng.uniform(0.2, 0.45) / (1 + np.exp(np.minimum(8 * (np.hypot(u, v) - 1), 50)))
    one = np.rint(255 * value.clip(0, 1)).astype(np.uint8)
    two = np.ascontiguousarray(one[5:, 3:])
    right = []
    for first, second in ((one, two), (255 - one, 255 - two)):
        seeds = pf.find_seeds(first, second, most=40)
        right.append(int((np.abs(seeds.xy1 - seeds.xy2 - [3, 5]).max(axis=1) < 1.5).sum()))
    assert min(right) >= 0.9 * max(right) and min(right) >= 30, right


def test_the_hessians_blobs_add_right_seeds_with_their_maps() -> None:
    a = 0.7 * np.array([[0.8, -0.5], [0.6, 0.9]])
    there, back = affine(a)
    one, two = pair(back)
    counts = []
    for hessian in (False, True):
        seeds = pf.find_seeds(one, two, hessian=hessian)
        good = np.linalg.norm(seeds.xy2 - there(seeds.xy1), axis=1) < 2
        assert np.median(np.linalg.norm(seeds.affine[good] - a, axis=(1, 2))) <= 0.25
        counts.append(good.sum())
    assert counts[1] >= 1.3 * counts[0] > 20


# ---- the epipolar line


@pytest.mark.parametrize("px", [1.0, 0.25])
def test_no_match_is_farther_from_its_line_than_asked(px: float) -> None:
    """With noise, so that fits wander."""
    one, two = noisy(rendered(np.eye(3, 4)), 1), noisy(rendered(POSE), 2)
    m = pf.match_quasi_dense(one, two, fisheye_seed(), FISHEYE, POSE, epipolar_px=px)
    t = POSE[:, 3]
    e = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ POSE[:, :3]

    def value(xy1: NDArray[np.float64], xy2: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.einsum("ki,ij,kj->k", FISHEYE.unproject(xy2)[0], e, FISHEYE.unproject(xy1)[0])

    steps = 1e-3 * np.eye(2)
    slopes = [value(m.xy1 + d, m.xy2) - value(m.xy1 - d, m.xy2) for d in steps]
    slopes += [value(m.xy1, m.xy2 + d) - value(m.xy1, m.xy2 - d) for d in steps]
    distance = np.abs(value(m.xy1, m.xy2)) / np.linalg.norm(slopes, axis=0) * 2e-3
    assert len(m) > 8000 and distance.max() <= px * 1.001


# ---- the motion that most agree with


def cells_of_a_motion(share: float, seed: int) -> tuple[pf.Matches, NDArray[np.bool_]]:
    """Matches of some 600 cells of points at random depths, seen by two pinhole cameras to 0.2 px; all but `share` of
    the cells are elsewhere. And which are right."""
    rng = np.random.default_rng(seed)
    corner = 8.0 * np.stack(np.meshgrid(np.arange(32), np.arange(24)), axis=-1).reshape(-1, 2)
    ray = np.column_stack([(corner + 3.5 - [128, 96]) / 256, np.ones(len(corner))])
    c, s = np.cos(0.1), np.sin(0.1)
    seen = ray * rng.uniform(3, 8, (len(ray), 1)) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + [0.3, 0.05, 0.1]
    shift = 256 * seen[:, :2] / seen[:, 2:] + [128, 96] - (corner + 3.5) + rng.normal(0, 0.2, (len(ray), 2))
    inside = (np.abs(corner + shift - [124, 92]) < [120, 88]).all(axis=1)
    corner, shift = corner[inside], shift[inside]
    right = rng.random(len(corner)) < share
    shift = np.where(right[:, None], shift, rng.uniform(0, [248, 184], corner.shape) - corner)
    inner = np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2)
    xy1 = (corner[:, None] + inner).reshape(-1, 2)
    xy2 = np.clip(xy1 + np.repeat(shift, 64, axis=0), 0, [255, 191])
    n, none = len(xy1), np.empty((0, 2))
    number = np.arange(n)
    maps, good = np.tile(np.eye(2), (n, 1, 1)), np.ones(n)
    m = pf.Matches(xy1, xy2, maps, good, np.full(n, -1), number, pf.Seeds(none, none), "ok", (192, 256), (192, 256))
    return m, np.repeat(right, 64)


@pytest.mark.parametrize("seed", range(3))
def test_a_motion_is_found_that_two_of_five_agree_with(seed: int) -> None:
    m, right = cells_of_a_motion(0.4, seed)
    found = dominant_geometry(m, "motion", 1.0)
    assert found is not None and np.mean(found.error[right] < 1) > 0.9


def test_no_motion_is_made_up_where_one_of_five_agrees() -> None:
    assert dominant_geometry(cells_of_a_motion(0.2, 0)[0], "motion", 1.0) is None


def test_what_is_off_the_motion_goes_by_itself_only_where_a_scene_is_likely_rigid() -> None:
    """Where nine of ten cells agree; where six do, the rest may be right and move otherwise."""
    rigid, moving = (cells_of_a_motion(share, 0)[0] for share in (0.9, 0.6))
    by_itself, asked = (pf.filter_matches(rigid, least=0, geometry=name) for name in ("rigid", "motion"))
    assert np.array_equal(by_itself.xy1, asked.xy1) and len(asked) < 0.92 * len(rigid)
    assert len(pf.filter_matches(moving, least=0, geometry="rigid")) == len(moving)


# ---- what is said of matches


def test_a_filter_does_not_change_the_share_found_at_the_rim(turned: tuple) -> None:
    m = turned[3]
    assert m.counts["grown"] == len(m)
    m = replace(m, counts=m.counts | {"at_border": len(m) // 4})
    few = select(m, np.arange(len(m)) % 10 == 0)
    assert statistics(few)["at_border_share"] == statistics(m)["at_border_share"] == pytest.approx(0.25, abs=0.01)


# ---- arguments that are wrong are named

PLAIN = np.zeros((64, 64), np.uint8)


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"radius": 2.5}, "radius: 2.5 is not a whole number"),
        ({"radius": 1}, "radius: 1 is not at least 2"),
        ({"threads": 1.5}, "threads: 1.5"),
        ({"threads": 0}, "threads: 0"),
        ({"zncc_min": "high"}, "zncc_min: 'high' is not"),
        ({"epipolar_px": [1, 2]}, "epipolar_px: .* is not a number"),
        ({"cameras": 3, "relative_pose": POSE}, "cameras: a Camera, or two"),
    ],
)
def test_matching_names_the_argument(options: dict, what: str) -> None:
    with pytest.raises(pf.ArgumentError, match=what):
        pf.match_quasi_dense(PLAIN, PLAIN, **options)


@pytest.mark.parametrize(("options", "what"), [({"most": 0}, "most: 0"), ({"most": -1}, "most"), ({"threads": 0}, "t")])
def test_finding_seeds_names_the_argument(options: dict, what: str) -> None:
    with pytest.raises(pf.ArgumentError, match=what):
        pf.find_seeds(PLAIN, PLAIN, **options)


@pytest.mark.parametrize(
    ("name", "value"),
    [("xy1", np.nan), ("xy1", -50.0), ("xy2", 1e30), ("xy2", np.nan), ("affine", np.nan), ("parent", 3)],
)
def test_filters_name_what_is_wrong_with_matches(turned: tuple, name: str, value: float) -> None:
    one, two, _, m = turned
    changed = getattr(m, name).copy()
    changed[::3] = value
    broken = replace(m, **{name: changed})
    for call in (lambda: pf.filter_matches(broken), lambda: pf.match_rivals(one, two, broken)):
        with pytest.raises(pf.ArgumentError, match=name):
            call()


def test_a_seed_far_outside_is_no_seed(turned: tuple) -> None:
    """Not the pixel that is left of it in 32 bits."""
    one, two, there, _ = turned
    at = np.array([[100.0 + 2.0**32, 80.0]])
    m = pf.match_quasi_dense(one, two, pf.Seeds(at, there(at), A[None]))
    assert m.status == "no seeds"


def test_filters_take_whole_numbers_only(turned: tuple) -> None:
    for least in (30.5, -1):
        with pytest.raises(pf.ArgumentError, match="least: "):
            pf.filter_matches(turned[3], least=least)


def test_the_command_refuses_a_plane_or_motion_of_a_fisheye(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    Image.fromarray(PLAIN).save(tmp_path / "a.png")
    FISHEYE.save(tmp_path / "camera.json")
    np.savetxt(tmp_path / "pose.txt", POSE)
    arguments = ["match", str(tmp_path / "a.png"), str(tmp_path / "a.png"), "-o", str(tmp_path / "out")]
    arguments += ["--profile", str(tmp_path / "camera.json"), "--pose", str(tmp_path / "pose.txt")]
    for name in ("plane", "motion", "rigid"):
        assert main([*arguments, "--filter", name]) == 1
        assert "--filter: plane, motion and rigid are of pinhole pictures" in capsys.readouterr().err
