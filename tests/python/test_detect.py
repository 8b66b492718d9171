"""Targets found in pictures, against the simulator's truth and against other people's detections of real pictures."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish.detect import grey
from pipefish.studio import Studio
from pipefish.studio_targets import TargetView, simulate_target_views

SIZE = {"width": 480, "height": 360}
FISHEYE = {"preset": "fisheye-185", **SIZE}
BOARD = pf.Target("checkerboard", 6, 9, 0.03)


@lru_cache
def camera(preset: str) -> pf.Camera:
    """The simulator's lens as a profile, fitted to rays it traces."""
    studio = Studio({"preset": preset, **SIZE})
    theta, phi = np.meshgrid(np.linspace(0.01, 0.995 * studio.theta_max, 60), np.linspace(0, 2 * np.pi, 30)[:-1])
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    px, ok = studio.project(rays)
    return pf.Camera.fit(rays[ok], px[ok], (studio.width, studio.height))[0]


def at(x: float, y: float, z: float, yaw: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """cam_from_target: turned about the camera's y axis, after a roll about its own normal."""
    c, s, cr, sr = math.cos(yaw), math.sin(yaw), math.cos(roll), math.sin(roll)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return np.column_stack([turn, [x, y, z]])


@lru_cache
def view(target: pf.Target, preset: str, place: tuple[float, ...], light: float = 0.0) -> TargetView:
    more = {"light": {"powers": [{"i": 1, "j": 0, "metres": light}]}} if light else None
    views, _ = simulate_target_views(
        target, {"preset": preset, **SIZE}, [at(*place)], seed=4, samples=34, level=150, board=more
    )
    return views[0]


def errors(found: pf.Detection, seen: TargetView, turned: bool = False) -> np.ndarray:
    truth = seen.pixels if seen.centroids is None else seen.centroids
    return found.pixels - truth[len(truth) - 1 - found.ids if turned else found.ids]


def rms(e: np.ndarray) -> float:
    return float(np.sqrt((e**2).sum(1).mean()))


FACING = (0.0, 0.0, 0.2, 0.1, 0.2)

# Found bounds: rms in these pictures 0.02 to 0.05 px; a whole pixel off, or a neighbour, would be 30 px and more.
TARGETS = {
    "checkerboard": (BOARD, FACING),
    "circles": (pf.Target("circles", 6, 8, 0.03), FACING),
    "asymmetric-circles": (pf.Target("asymmetric-circles", 9, 4, 0.05), FACING),
    "charuco": (pf.Target("charuco", 5, 7, 0.04), (0.0, 0.0, 0.14, 0.1, 0.2)),
    "sleeve": (pf.Target("sleeve", 5, 16, 0.05, diameter_m=0.3), (0.02, 0.01, 0.04, 0.1, 0.3)),
}


@pytest.mark.parametrize("kind", TARGETS)
def test_every_kind_of_target_is_found_where_it_is(kind: str) -> None:
    target, place = TARGETS[kind]
    seen = view(target, "fisheye-185", place)
    found = pf.detect_target(seen.image, target)
    assert found.status in ("ok", "partial"), found.reason
    # Of the sleeve's discs the lens's field cuts one in eight.
    assert len(found.ids) >= (0.8 if kind == "sleeve" else 0.9) * seen.visible.sum()
    assert rms(errors(found, seen)) < 0.08
    assert found.turns == (2 if kind == "circles" else 1)
    if target.has_circles:
        assert found.outlines is not None and found.outlines.shape == (len(found.ids), 32, 2)


def test_a_model_brings_back_what_the_picture_alone_does_not_show_beyond_90_degrees() -> None:
    place = (0.12, 0.03, 0.02, 1.25, 0.3)
    seen = view(BOARD, "fisheye-220", place)
    theta = np.degrees(np.arctan2(np.hypot(*seen.points[:, :2].T), seen.points[:, 2]))
    guided = pf.detect_target(seen.image, BOARD, camera("fisheye-220"), seen.pose)
    assert theta[guided.ids].max() > 100
    assert len(guided.ids) >= 0.9 * seen.visible.sum()
    assert rms(errors(guided, seen)) < 0.15


def test_a_model_that_is_five_pixels_off_leads_to_the_same_points() -> None:
    seen = view(BOARD, "fisheye-185", FACING)
    right = pf.detect_target(seen.image, BOARD, camera("fisheye-185"), seen.pose)
    pose = seen.pose.copy()
    pose[0, 3] += 5 / camera("fisheye-185").f_u * pose[2, 3]
    wrong = pf.detect_target(seen.image, BOARD, camera("fisheye-185"), pose)
    np.testing.assert_array_equal(wrong.ids, right.ids)
    np.testing.assert_allclose(wrong.pixels, right.pixels, atol=0.02)


def test_a_model_does_not_find_a_board_that_is_not_there() -> None:
    seen = view(BOARD, "fisheye-185", FACING)
    pose = at(0.0, 0.0, 0.5, 0.1, 1.2)
    found = pf.detect_target(seen.image, BOARD, camera("fisheye-185"), pose)
    assert found.status == "none" and "not where the model says" in found.reason


def test_a_gradient_of_light_moves_no_corner_by_the_colour_of_its_saddle() -> None:
    """exp(1.5 u) over the board: a factor of 20 across it. A fit without a light term shifts corners of one parity
    against those of the other by about 0.05 px here; the difference of the two means has a sigma of 0.006."""
    seen = view(BOARD, "wide-120", (0.0, 0.0, 0.3, 0.0, 0.0), 1.5)
    found = pf.detect_target(seen.image, BOARD)
    e = errors(found, seen)
    parity = (found.ids % 8 + found.ids // 8) % 2 == 0
    assert len(found.ids) == 40
    assert np.abs(e[parity].mean(0) - e[~parity].mean(0)).max() < 0.02


def test_covariances_are_those_of_the_errors() -> None:
    """chi-square per degree of freedom over 40 corners and 48 discs: 1 within a factor of 2.5; the fits' weak beliefs
    and the renderer's own sampling leave it near 1.4."""
    for kind in ("checkerboard", "circles"):
        target, place = TARGETS[kind]
        seen = view(target, "fisheye-185", place)
        found = pf.detect_target(seen.image, target)
        e = errors(found, seen)
        chi2 = np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.covariance), e).mean() / 2
        assert 0.4 < chi2 < 2.5


def test_half_a_board_is_numbered_by_its_visible_border() -> None:
    seen = view(BOARD, "wide-120", (0.2, 0.0, 0.2, 0.0, 0.0))
    assert 10 < seen.visible.sum() < 35
    found = pf.detect_target(seen.image, BOARD)
    assert found.status == "partial", found.reason
    assert rms(errors(found, seen)) < 0.08


def test_a_board_without_a_visible_border_is_ambiguous_and_says_so() -> None:
    big = pf.Target("checkerboard", 20, 25, 0.03)
    seen = view(big, "wide-120", (0.0, 0.0, 0.1, 0.0, 0.0))
    found = pf.detect_target(seen.image, big)
    assert found.status == "ambiguous" and "ordering ambiguous" in found.reason
    assert not found


def test_a_board_that_looks_the_same_turned_reports_it() -> None:
    for rows, cols, turns in ((7, 9, 2), (7, 7, 4), (6, 9, 1), (6, 6, 2)):
        target = pf.Target("checkerboard", rows, cols, 0.03)
        found = pf.detect_target(view(target, "wide-120", (0, 0, 0.35, 0.1, 0.1)).image, target)
        assert found.status == "ok" and found.turns == turns
        assert ("looks the same when turned" in found.reason) == (turns > 1)


def test_a_board_of_another_size_is_refused_with_both_sizes() -> None:
    seen = view(BOARD, "fisheye-185", FACING)
    found = pf.detect_target(seen.image, pf.Target("checkerboard", 5, 7, 0.03))
    assert found.status == "none" and found.seen == (8, 5)
    assert "8 x 5 inner corners (9 x 6 squares) are seen, described are 6 x 4 inner corners" in found.reason


def test_a_mirrored_picture_of_a_coded_target_is_recognised() -> None:
    target = pf.Target("asymmetric-circles", 10, 4, 0.05)  # an odd number of rows has a mirror image of its own
    seen = view(target, "fisheye-185", FACING)
    found = pf.detect_target(seen.image[:, ::-1], target)
    assert found.mirrored and "mirror" in found.reason
    mirrored = np.array([SIZE["width"] - 1, 0]) + np.array([-1, 1]) * seen.centroids
    assert found.turns == 2
    assert min(rms(found.pixels - mirrored[ids]) for ids in (found.ids, 39 - found.ids)) < 0.08


def test_nothing_is_found_in_noise_or_in_an_empty_picture() -> None:
    rng = np.random.Generator(np.random.Philox(1))
    for image in (np.full((200, 300), 128, np.uint8), rng.integers(0, 256, (200, 300)).astype(np.uint8)):
        for target, _ in TARGETS.values():
            found = pf.detect_target(image, target)
            assert found.status == "none" and found.reason and len(found.ids) == 0
            assert found.pixels.shape == (0, 2) and found.covariance.shape == (0, 2, 2)


def test_a_fit_at_the_edge_puts_no_point_outside_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """One such point and a calibration would refuse all pictures as another camera's."""
    seen = view(BOARD, "fisheye-185", FACING)
    found = pf.detect_target(seen.image, BOARD)
    pixels = found.pixels.copy()
    pixels[3] = [-1.2, 50.0]
    told = {k: getattr(found, k) for k in ("ids", "covariance", "status", "reason", "outlines")} | {"pixels": pixels}
    monkeypatch.setattr("pipefish._engine.find_target", lambda *_: told)
    kept = pf.detect_target(seen.image, BOARD)
    assert len(kept.ids) == len(found.ids) - 1 == len(kept.pixels) == len(kept.covariance)
    assert found.ids[3] not in kept.ids and kept.status == "partial" and kept.reason == "39 of 40 points"


def test_wrong_arguments_are_refused_by_name() -> None:
    image = np.zeros((360, 480), np.uint8)
    with pytest.raises(pf.ArgumentError, match="camera, pose"):
        pf.detect_target(image, BOARD, camera("fisheye-185"))
    with pytest.raises(pf.ArgumentError, match=r"pose: .*\(4, 4\)"):
        pf.detect_target(image, BOARD, camera("fisheye-185"), np.eye(4))
    with pytest.raises(pf.ArgumentError, match="image: 480 x 300"):
        pf.detect_target(image[:300], BOARD, camera("fisheye-185"), np.eye(4)[:3])
    with pytest.raises(pf.ArgumentError, match="image: expected shape"):
        grey(np.zeros((3, 4, 5)))
    with pytest.raises(pf.ArgumentError, match="image: expected uint8"):
        grey(np.full((30, 30), -1.0))


def test_pictures_of_other_kinds_become_grey_bytes() -> None:
    ramp = np.arange(64, dtype=np.uint8).reshape(1, 64).repeat(20, 0)
    np.testing.assert_array_equal(
        grey(ramp.astype(np.uint16) * 4 + 3 + (ramp == 63).astype(np.uint16) * 768)[:, 5], ramp[:, 5]
    )
    np.testing.assert_array_equal(grey(ramp / 255), ramp)
    np.testing.assert_array_equal(grey(np.stack([ramp] * 3, -1)), ramp)


# ---- real pictures


def load(path: Path) -> np.ndarray:
    return np.array(Image.open(path).convert("L"))


@pytest.mark.parametrize(
    ("folder", "pattern", "rows", "cols", "least"),
    [
        ("camodocal", "*.png", 7, 10, 32),
        ("ocam", "Fisheye1_*.jpg", 9, 7, 15),
        ("ocam", "Fisheye2_*.jpg", 9, 7, 16),
        ("catadioptric", "*.jpg", 7, 10, 18),
        ("jy_stereo/left", "*.jpg", 7, 9, 34),
    ],
)
def test_real_boards_are_found_in_every_view(real_data, folder, pattern, rows, cols, least) -> None:
    """Every eighth picture of each set, to be quick."""
    files = sorted(real_data(f"calibration/{folder}").glob(pattern))
    assert len(files) == least
    target = pf.Target("checkerboard", rows, cols, 0.03)
    for file in files[::8]:
        found = pf.detect_target(load(file), target)
        assert found and len(found.ids) >= 0.97 * (rows - 1) * (cols - 1), f"{file}: {found.reason}"


def reference(path: Path) -> tuple[int, int, np.ndarray]:
    text = path.read_text()
    rows, cols = (int(re.search(rf"{name}: (\d+)", text)[1]) for name in ("rows", "cols"))
    numbers = re.search(r"data: \[(.*?)\]", text, re.S)[1].split(",")
    return rows, cols, np.array([float(x) for x in numbers]).reshape(-1, 2)


@pytest.mark.parametrize(
    ("kind", "stem", "count"),
    [("circles", "circles/circles", 14), ("asymmetric-circles", "asymmetric_circles/acircles", 9)],
)
def test_real_circle_grids_agree_with_the_reference_centres(real_data, kind, stem, count) -> None:
    """All of them, in the same order; the references are OpenCV's own blob centres, so 0.3 px is theirs as much."""
    folder = real_data("calibration/circle_grids")
    for k in range(1, count + 1):
        rows, cols, centres = reference(folder / f"{stem}_corners{k}.dat")
        found = pf.detect_target(load(folder / f"{stem}{k}.png"), pf.Target(kind, rows, cols, 0.02))
        assert found.status == "ok", f"{stem}{k}: {found.reason}"
        assert np.linalg.norm(found.pixels - centres, axis=1).max() < 0.4
