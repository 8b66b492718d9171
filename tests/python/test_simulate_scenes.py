"""Simulated targets, pairs of views and objects: what their truth says is in their pictures, found there by other
means."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipefish.cli import main
from pipefish.errors import ArgumentError, FormatError, PipefishError
from pipefish.simulate import read_scene, simulate, studio_scenarios
from pipefish.simulate_pictures import picture
from pipefish.studio import Picture, Studio, Texture, facing, listed, pattern, pose, raster, rotation
from pipefish.studio_files import SCENARIOS, checked
from pipefish.studio_objects import simulate_objects
from pipefish.studio_pairs import simulate_two_views
from pipefish.studio_targets import simulate_target_views, target_poses, warp
from pipefish.target import Target, marker_bits

PRESETS = ["fisheye-185", "fisheye-220", "wide-120", "narrow-60", "hyperbolic", "equiangular"]
CLEAN = {"read_noise": 0, "shot_noise": 0, "bits": 10}  # 4 levels a grey level
EVEN = {"vignetting": 0, "rim_blur_px": 0}
VGA = {"width": 640, "height": 480}
BENT = {
    "relief": {
        "powers": [{"i": 2, "j": 0, "metres": 0.06}, {"i": 1, "j": 2, "metres": 0.02}],
        "waves": [{"u_rate": 4.0, "v_rate": 2.5, "phase": 0.4, "metres": 0.03}],
    },
    "stretch_a": {"waves": [{"u_rate": 2.0, "v_rate": 1.0, "phase": 0.1, "metres": 0.02}]},
    "stretch_b": {"powers": [{"i": 1, "j": 0, "metres": 0.03}]},
}


def plain(albedo: float = 0.85) -> Texture:
    """A sheet of one albedo."""
    return Texture.print(np.zeros((0, 6)), albedo)


def area_of(outline: np.ndarray) -> float:
    """Of a closed polygon (N, 2)."""
    x, y = outline.T
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2


@pytest.mark.parametrize(
    "shape", [{}, BENT, {"curvature": 2.5}, {"curvature": -2.5}], ids=["flat", "bent", "out", "in"]
)
@pytest.mark.parametrize("preset", PRESETS)
def test_rays_meet_sheets_where_the_sheets_are(preset: str, shape: dict) -> None:
    studio = Studio({"preset": preset, **VGA})
    lens = studio.spec["lens"]
    theta = 0.5 * (lens["theta_min"] + min(lens["theta_max"], 0.9 if preset in ("narrow-60", "wide-120") else 3))
    ray = np.array([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)])
    at = pose(facing(ray, 0.3) @ rotation((0.5, -0.3, 0)), 0.9 * ray)
    seen_by = Picture({"sheets": [{"width": 0.8, "height": 0.6, "pose": listed(at), **shape}]}, [plain()])
    pixels = np.random.default_rng(1).uniform([0, 0], [639, 479], (20000, 2))
    seen = studio.look(seen_by, pixels)
    hit = seen.sheet == 0
    assert hit.sum() > 200
    placed = seen_by.place(0, seen.at[hit])
    assert np.abs(placed - seen.points[hit]).max() < 1e-10
    back, ok = studio.project(placed)
    assert ok.all()
    assert np.abs(back - pixels[hit]).max() < 1e-8


def test_the_first_hit_of_a_folded_relief_is_the_first() -> None:
    # Against a march in small steps along each ray, which knows nothing of bounds or slopes.
    waves = [
        {"u_rate": 9.0, "v_rate": 3.0, "phase": 0.4, "metres": 0.12},
        {"u_rate": -3.0, "v_rate": 8.0, "metres": 0.07},
    ]
    turn = rotation((1.0, 0.3, 0.2))
    sheet = {"width": 1.0, "height": 1.0, "relief": {"waves": waves}, "pose": listed(pose(turn, (0, 0, 1.2)))}
    shown = Picture({"sheets": [sheet]}, [plain()])
    studio = Studio({"preset": "narrow-60", **VGA, "pupil_scale": 0})
    pixels = np.random.default_rng(2).uniform([150, 130], [490, 350], (400, 2))
    seen = studio.look(shown, pixels)
    far = Picture({"sheets": [{"width": 9, "height": 9, "pose": listed(pose(np.eye(3), (0, 0, 5)))}]}, [plain()])
    ray = studio.look(far, pixels).points
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    t = np.arange(0.3, 2.4, 2e-4)
    checked_rays = 0
    for d, point, hit in zip(ray, seen.points, seen.sheet == 0, strict=True):
        local = (t[:, None] * d - [0, 0, 1.2]) @ turn
        u, v = 2 * local[:, 0], 2 * local[:, 1]
        gap = local[:, 2] - sum(
            w["metres"] * np.sin(w["u_rate"] * u + w["v_rate"] * v + w.get("phase", 0)) for w in waves
        )
        inside = (np.abs(u) <= 1) & (np.abs(v) <= 1)
        crossing = np.nonzero((gap[:-1] * gap[1:] < 0) & inside[:-1] & inside[1:])[0]
        if len(crossing) == 0 or not hit:
            continue  # past the edge, or a graze shorter than a step
        assert abs(np.linalg.norm(point) - t[crossing[0]]) < 4e-4
        checked_rays += 1
    assert checked_rays > 200


def test_light_follows_its_law() -> None:
    # Ambient plus a lamp's cosine over squared distance, times albedo, gain and vignetting; then bias and gamma.
    studio = Studio({"preset": "narrow-60", **VGA, **EVEN, "vignetting": 0.2}, {**CLEAN, "blur_px": 0})
    turn = rotation((0.4, 0, 0))
    sheet = {"width": 1, "height": 1, "pose": listed(pose(turn, (0, 0, 1.0))), "gain": 0.9}
    shadow = {"angle": 0.0, "offset": 0.1, "soft": 0.01, "share": 0.5}
    spec = {"sheets": [{**sheet, "shadows": [shadow]}], "ambient": 60.0, "gain": 1.2, "bias": 10.0, "gamma": 0.8}
    shown = Picture({**spec, "lamps": [{"x": 0.2, "y": -0.1, "z": 0.1, "power": 90.0}]}, [plain(0.6)])
    image = studio.render(shown)
    u, v = np.random.default_rng(3).integers([230, 180], [410, 300], (200, 2)).T
    seen = studio.look(shown, np.column_stack([u, v]))
    away = np.array([0.2, -0.1, 0.1]) - seen.points
    distance = np.linalg.norm(away, axis=1)
    light = 60 + 90 * (away @ -turn[:, 2]) / distance**3
    direction = seen.points / np.linalg.norm(seen.points, axis=1, keepdims=True)
    vignetting = 1 - 0.2 * (np.arccos(direction[:, 2]) / studio.theta_max) ** 4
    light *= 1.2 * 0.9 * vignetting * np.where(seen.at[:, 0] * 2 > 0.1, 0.5, 1)
    grey = 255 * ((0.6 * light + 10) / 255) ** 0.8
    clear = np.abs(seen.at[:, 0] * 2 - 0.1) > 0.03
    assert np.abs(image[v, u] / 4 - grey)[clear].max() < 0.3
    assert np.ptp(grey) > 30


@pytest.mark.parametrize("preset", PRESETS)
def test_discs_have_the_centroids_that_the_truth_says(preset: str) -> None:
    target = Target("circles", 5, 6, 0.03)
    lens = {"preset": preset, **EVEN, **VGA}
    # On 8 bits' levels of one value a white sheet is white everywhere: what is darker is disc.
    views, _ = simulate_target_views(
        target, lens, 1, seed=6, sensor=CLEAN, light={"lamps": []}, level=200, clutter=False, samples=233,
        board=warp(target, 2, 0.002),
    )  # fmt: skip
    studio = Studio(lens, CLEAN)
    errors, bias = [], []
    for view in views:
        seen = studio.look(view.picture, studio.pixels())
        on = seen.sheet == 0
        weight = (200 * target.white * 4 - view.image.ravel().astype(float))[on]
        at, pixels = seen.at[on], studio.pixels()[on]
        assert view.centroids is not None
        for flat, projected, centroid, ok in zip(
            target.flat_points(), view.pixels, view.centroids, view.visible, strict=True
        ):
            own = np.abs(at - flat).max(1) < 0.48 * target.spacing_m
            if not ok or own.sum() == 0:
                continue
            box = np.concatenate([pixels[own] - [0, 0], [640, 480] - pixels[own]]).min()
            lens_spec = studio.spec["lens"]
            r = np.linalg.norm(pixels[own] - [lens_spec["c_u"], lens_spec["c_v"]], axis=1)
            blind = lens_spec["theta_min"] and np.interp(
                lens_spec["theta_min"], *list(studio.lens_table().values())[:2]
            )
            if box < 4 or r.max() > lens_spec["circle_radius"] - 4 or r.min() < blind + 4:
                continue  # cut by an edge
            errors.append((weight[own, None] * pixels[own]).sum(0) / weight[own].sum() - centroid)
            bias.append(np.linalg.norm(centroid - projected))
    assert len(errors) > 15
    assert np.sqrt(np.mean(np.square(errors))) < 0.004
    assert np.abs(errors).max() < 0.012
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.003
    assert max(bias) > 0.03  # the projected centre is something else


def test_edges_are_where_they_are_even_along_pixel_columns() -> None:
    # The dark share of a square whose sides run along columns and rows: an edge that is off by 0.005 px shows as that
    # much of a side's length.
    studio = Studio({"preset": "narrow-60", **VGA, **EVEN, "asymmetry": []}, CLEAN)
    for shift in (0.0, 0.0007, 0.0013):
        square = np.array([[0, shift, shift, 0.1, 0.1, 0.05]])
        sheet = {"width": 0.5, "height": 0.4, "pose": listed(pose(np.eye(3), (0, 0, 0.5)))}
        shown = Picture({"sheets": [sheet]}, [Texture.print(square, 0.85)])
        image = studio.render(shown).astype(float)[90:390, 170:470]
        share = (200 * 0.85 * 4 - image) / (200 * 0.8 * 4)
        side = np.linspace(-0.1, 0.1, 500)[:-1]
        corner = np.full_like(side, 0.1)
        rim = np.concatenate([np.c_[side, -corner], np.c_[corner, side], np.c_[-side, corner], np.c_[-corner, -side]])
        outline, _ = studio.project(shown.place(0, rim + shift))
        perimeter = np.linalg.norm(np.diff(outline, axis=0), axis=1).sum()
        assert abs(share.sum() - area_of(outline)) < 0.002 * perimeter
        v, u = np.mgrid[90:390, 170:470]
        x, y = outline.T
        cross = x * np.roll(y, -1) - y * np.roll(x, -1)
        centre = [((a + np.roll(a, -1)) * cross).sum() / (3 * cross.sum()) for a in (x, y)]
        assert abs((share * u).sum() / share.sum() - centre[0]) < 0.003
        assert abs((share * v).sum() / share.sum() - centre[1]) < 0.003


def corner(image: np.ndarray, start: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """The point where two blurred edges cross, fitted to the grey levels around `start`; their directions are near
    `along` and `across`. Gauss-Newton on point, directions, blur, two grey levels."""
    middle = np.round(start).astype(int)
    v, u = np.mgrid[middle[1] - 5 : middle[1] + 6, middle[0] - 5 : middle[0] + 6].reshape(2, -1)
    grey = image[v, u].astype(float)
    erf = np.vectorize(math.erf)

    def edge(p: np.ndarray, angle: float) -> np.ndarray:
        return erf(((v - p[1]) * np.cos(angle) - (u - p[0]) * np.sin(angle)) / p[4])

    def model(p: np.ndarray) -> np.ndarray:
        return p[5] + p[6] * edge(p, p[2]) * edge(p, p[3])

    p = np.array([*start, np.arctan2(*along[::-1]), np.arctan2(*across[::-1]), 1.7, 0, 1])
    shape = model(p)
    p[6] = ((grey - grey.mean()) @ shape) / (shape @ shape)
    p[5] = grey.mean() - p[6] * shape.mean()
    for _ in range(6):
        base = model(p)
        slopes = np.stack([(model(p + step) - base) / 1e-6 for step in 1e-6 * np.eye(7)], 1)
        p = p + np.linalg.lstsq(slopes, grey - base, rcond=None)[0]
    return p[:2]


@pytest.mark.parametrize(("samples", "rms"), [(89, 0.007), (610, 0.004)])
def test_corners_are_where_edges_cross(samples: int, rms: float) -> None:
    target = Target("checkerboard", 6, 8, 0.03)
    theta = np.linspace(0, 0.7, 71)  # a lens that keeps lines straight
    table = [{"theta": float(t), "radius_px": float(900 * np.tan(t)), "pupil_m": 0.0} for t in theta]
    lens = {**EVEN, "width": 800, "height": 600, "table": table}
    studio = Studio(lens, CLEAN)
    poses = target_poses(target, studio, 3, seed=4, span=(0.6, 0.9), tilt=0.4, reach=0.3)
    soft = {**CLEAN, "blur_px": 1.2}
    views, truth = simulate_target_views(
        target, lens, poses, sensor=soft, light={"lamps": []}, clutter=False, samples=samples
    )
    errors = []
    for view, entry in zip(views, truth["views"], strict=True):
        grid = view.pixels.reshape(5, 7, 2)
        assert np.allclose(view.pixels, np.array(entry["points_px"], dtype=float), atol=1e-8)
        for (row, col), ok in np.ndenumerate(view.visible.reshape(5, 7)):
            px = grid[row, col]
            if ok and (px > 10).all() and px[0] < 790 and px[1] < 590:
                along = grid[row, col] - grid[row, col - 1] if col else grid[row, 1] - grid[row, 0]
                across = grid[row, col] - grid[row - 1, col] if row else grid[1, col] - grid[0, col]
                errors.append(corner(view.image, px, along, across) - px)
    assert len(errors) > 60
    assert np.sqrt(np.mean(np.square(errors))) < rms
    assert np.percentile(np.abs(errors), 95) < 2 * rms
    assert np.abs(errors).max() < 4 * rms  # where edges cross at a sharp angle
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.3 * rms  # unbiased


@pytest.mark.parametrize("preset", ["fisheye-185", "fisheye-220"])
def test_corners_are_where_edges_cross_through_lenses_that_bend_lines(preset: str) -> None:
    # As above, with the edges fitted in the board's plane, where they are straight: a pixel's place there is where its
    # ray meets it, from the lens's inverse; the truth comes from projection. The blur is round in pixels.
    target = Target("checkerboard", 6, 8, 0.03)
    lens = {**EVEN, **VGA, "preset": preset}
    studio = Studio(lens, CLEAN)
    poses = target_poses(target, studio, 3, seed=5, tilt=0.3)
    views, _ = simulate_target_views(
        target, lens, poses, sensor={**CLEAN, "blur_px": 0.8}, light={"lamps": []}, clutter=False, samples=610
    )
    erf = np.vectorize(math.erf)
    errors = []
    for view in views:

        def look(pixels: np.ndarray, shown: Picture = view.picture) -> tuple[np.ndarray, np.ndarray]:
            """Where pixels (N, 2) meet the board, (N, 2) metres; the derivatives by the pixel, (N, 2, 2)."""
            at, *beside = (studio.look(shown, pixels + step).at
                           for step in ((0, 0), (0.01, 0), (-0.01, 0), (0, 0.01), (0, -0.01)))  # fmt: skip
            return at, np.stack([beside[0] - beside[1], beside[2] - beside[3]], -1) / 0.02

        grid = view.pixels.reshape(5, 7, 2)
        for (row, col), ok in np.ndenumerate(view.visible.reshape(5, 7)):
            px = grid[row, col]
            near = [grid[r, c] for r, c in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1))
                    if 0 <= r < 5 and 0 <= c < 7]  # fmt: skip
            if not ok or not ((px > 8) & (px < [631, 471])).all() or min(np.linalg.norm(near - px, axis=1)) < 14:
                continue
            middle = np.round(px).astype(int)
            v, u = np.mgrid[middle[1] - 4 : middle[1] + 5, middle[0] - 4 : middle[0] + 5].reshape(2, -1)
            pixels = np.column_stack([u, v]).astype(float)
            at, by = look(pixels)
            if not np.isfinite(by).all():
                continue
            away, grey = at - target.flat_points().reshape(5, 7, 2)[row, col], view.image[v, u].astype(float)
            # Pixels from either edge: over the mean of the gradients there and here, which leaves a third order.
            wide = np.linalg.norm(by, axis=2)
            for k in (0, 1):
                foot = pixels - (away[:, k] / wide[:, k] ** 2)[:, None] * by[:, k]
                wide[:, k] = (wide[:, k] + np.linalg.norm(look(foot)[1][:, k], axis=1)) / 2

            def model(p: np.ndarray, away: np.ndarray = away, wide: np.ndarray = wide) -> np.ndarray:
                across = (away - p[:2]) / wide / p[2]
                return p[3] + p[4] * erf(across[:, 0]) * erf(across[:, 1])

            p = np.array([0, 0, 1.2, 0, 1])
            shape = model(p)
            p[4] = ((grey - grey.mean()) @ shape) / (shape @ shape)
            p[3] = grey.mean() - p[4] * shape.mean()
            steps = np.diag([1e-8, 1e-8, 1e-6, 1e-6, 1e-6])
            for _ in range(6):
                base = model(p)
                slopes = np.stack([(model(p + s) - base) / s.max() for s in steps], 1)
                p = p + np.linalg.lstsq(slopes, grey - base, rcond=None)[0]
            errors.append(np.linalg.solve(look(px[None])[1][0], p[:2]))
    assert len(errors) > 20, len(errors)
    # What is left is the fit's: where both edges are curved, blur moves their crossing by about its variance over their
    # radius: 0.8^2 / 150 px near the rim, and more where they meet at a sharp angle.
    assert np.sqrt(np.mean(np.square(errors))) < 0.007
    assert np.abs(errors).max() < 0.03  # where edges cross at a sharp angle
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.002  # unbiased


def test_a_warped_board_moves_its_corners_as_it_says() -> None:
    target = Target("checkerboard", 6, 8, 0.03)
    stretch = {"powers": [{"i": 1, "j": 0, "metres": 1e-4}]}
    board = {"relief": {"powers": [{"i": 2, "j": 0, "metres": 0.004}]}, "stretch_a": stretch}
    at = pose(np.eye(3), (0, 0, 0.4))
    bent, _ = simulate_target_views(
        target, {"preset": "narrow-60", **VGA}, [at], board=board, clutter=False, samples=34
    )
    half = target.size_m[0] / 2
    flat = target.points()
    x = flat[:, 0] + 1e-4 * flat[:, 0] / half
    expected = np.column_stack([x, flat[:, 1], 0.4 + 0.004 * (x / half) ** 2])
    assert np.abs(bent[0].points - expected).max() < 1e-12


def test_a_sleeve_lies_in_the_pipe() -> None:
    target = Target("sleeve", 6, 16, 0.04, diameter_m=0.3)
    at = pose(rotation((0.1, -0.05, 0.3)), (0.02, -0.01, 0.05))
    views, _ = simulate_target_views(target, VGA, [at], sensor=CLEAN, samples=34)
    points = target.points()
    assert np.abs(np.hypot(points[:, 0], points[:, 1]) - 0.15).max() < 1e-12
    assert np.abs(views[0].points - (points @ at[:, :3].T + at[:, 3])).max() < 1e-9
    assert views[0].visible.sum() > 50
    # Clock angle 0 is up (-Y); the marks go clockwise: to the right (+X) first.
    order = np.argsort(np.abs(np.arctan2(points[:16, 0], -points[:16, 1])))[:2]
    assert set(points[order, 0] > 0) == {True, False}
    image, bits = views[0].image, target.sleeve_bits().ravel()
    dark = [image[round(v), round(u)] < 300 for (u, v), ok in zip(views[0].pixels, views[0].visible, strict=True) if ok]
    assert np.mean(np.array(dark) == (bits[views[0].visible] == 0)) > 0.95  # a far ring's hole is smaller than a pixel


def test_codes_are_what_they_promise() -> None:
    for rows, cols in ((6, 16), (10, 36)):
        bits = Target("sleeve", rows, cols, 0.03, diameter_m=0.5).sleeve_bits()
        around = np.hstack([bits, bits[:, :3]])
        windows = [tuple(around[r : r + 4, c : c + 4].ravel()) for r in range(rows - 3) for c in range(cols)]
        assert len(set(windows)) == len(windows)
    for side, distance in ((4, 3), (5, 6), (6, 10)):
        markers = [marker_bits(k, side) for k in range(30)]
        for i, a in enumerate(markers):
            assert min((np.rot90(a, k) != a).sum() for k in (1, 2, 3)) >= distance
            assert all((np.rot90(a, k) != b).sum() >= distance for b in markers[:i] for k in range(4))
    # Pinned: printed boards must stay readable.
    assert "".join(map(str, marker_bits(0, 5).ravel())) == MARKER_0


MARKER_0 = "1111010110110011101110001"


@pytest.mark.parametrize("kind", ["checkerboard", "circles", "asymmetric-circles", "charuco", "sleeve"])
def test_a_target_is_within_its_sheet_and_survives_as_a_dict(kind: str) -> None:
    target = Target(kind, 6, 8, 0.04, diameter_m=0.3 if kind == "sleeve" else 0.0)
    assert Target.from_dict(json.loads(json.dumps(target.to_dict()))) == target
    width, height = target.size_m
    figures = target.figures()
    side = target.margin_m if kind != "sleeve" else 0.0
    assert np.abs(figures[:, 1] + figures[:, 3] * np.sign(figures[:, 1])).max() <= width / 2 - side + 1e-12
    assert np.abs(figures[:, 2] + figures[:, 4] * np.sign(figures[:, 2])).max() <= height / 2 - target.margin_m + 1e-12
    assert len(target.points()) == (35 if kind in ("checkerboard", "charuco") else 48)
    assert np.abs(target.flat_points().mean(0)).max() < 1e-12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "hexagons"}, "kind: must be one of checkerboard"),
        ({"rows": 1}, "rows: must be a whole number"),
        ({"cols": 3.5}, "cols: must be a whole number"),
        ({"spacing_m": 0}, "spacing_m: must be a number"),
        ({"kind": "circles", "radius_m": 0.02}, "radius_m: circles of 0.02 m touch"),
        ({"kind": "sleeve"}, "diameter_m: a sleeve needs it"),
        ({"marker_bits": 7}, "marker_bits: must be 4, 5 or 6"),
        ({"rings": 2}, "rings: unknown; known are kind"),
    ],
)
def test_a_wrong_target_is_refused_by_its_field(change: dict, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        Target.from_dict({"kind": "checkerboard", "rows": 5, "cols": 6, "spacing_m": 0.03} | change)


def sampled(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Bicubic (Keys, a = -1/2) values at pixels (N, 2)."""
    base = np.floor(at).astype(int)
    share = at - base

    def kernel(x: np.ndarray) -> np.ndarray:
        x = np.abs(x)
        return np.where(x < 1, 1.5 * x**3 - 2.5 * x**2 + 1, np.where(x < 2, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2, 0))

    out = np.zeros(len(at))
    for j in range(-1, 3):
        for i in range(-1, 3):
            weight = kernel(share[:, 0] - i) * kernel(share[:, 1] - j)
            out += weight * image[base[:, 1] + j, base[:, 0] + i]
    return out


@pytest.mark.parametrize("preset", ["narrow-60", "fisheye-220"])
def test_flow_and_gain_turn_one_view_into_the_other(preset: str) -> None:
    lens = {"preset": preset, **VGA, "rim_blur_px": 0}
    pair = simulate_two_views(3, lens, seed=11, sensor={**CLEAN, "blur_px": 1.0}, shadows=False)
    moved, visible, gain = pair.flow(0)
    labels = pair.labels(0)
    half_x, half_y = np.array([[0.5, 0.0], [0.0, 0.5]])
    first, second = (image.astype(float) for image in pair.images)
    inner = np.zeros_like(visible)
    inner[8:-8, 8:-8] = True
    for layer in range(4):
        good = visible & inner & (labels == layer)
        good &= (moved > 8).all(-1) & (moved[..., 0] < 631) & (moved[..., 1] < 471)
        for d in (-4, 4):  # well within the layer, in both views
            good &= np.roll(labels == layer, d, 0) & np.roll(labels == layer, d, 1)
            good &= np.roll(visible, d, 0) & np.roll(visible, d, 1)
        assert good.sum() > 1500
        at = moved[good]
        share = gain[good]
        back = sampled(second, at) / share
        dx = (sampled(second, at + half_x) - sampled(second, at - half_x)) / share
        dy = (sampled(second, at + half_y) - sampled(second, at - half_y)) / share
        bright = (first[good] < 1000) & (back < 1000)
        basis = np.column_stack([dx, dy, back, np.ones_like(dx)])[bright]
        residual = (first[good] - back)[bright]
        shift_x, shift_y, slope, _ = np.linalg.lstsq(basis, residual, rcond=None)[0]
        assert abs(shift_x) < 0.02, (layer, shift_x)
        assert abs(shift_y) < 0.02, (layer, shift_y)
        assert abs(slope) < 0.02, (layer, slope)
        assert np.median(np.abs(residual)) < 0.05 * np.std(first[good])


def test_what_is_hidden_is_behind_something_else() -> None:
    pair = simulate_two_views(4, {"preset": "narrow-60", "width": 320, "height": 240}, seed=5, samples=34)
    moved, visible, gain = pair.flow(0)
    first, second = pair.labels(0), pair.labels(1)
    on = (np.nan_to_num(moved, nan=-9) > 0).all(-1) & (moved[..., 0] < 319) & (moved[..., 1] < 239)
    u, v = np.round(moved[on]).astype(int).T
    same = second[v, u] == first[on]
    assert same[visible[on]].mean() > 0.98  # but for pixels on outlines
    assert (~visible & on).sum() > 150
    assert same[~visible[on]].mean() < 0.1
    assert np.isnan(gain[~visible]).all()
    again, ok, other = pair.flow_at(moved[visible], 1)
    v, u = np.nonzero(visible)
    assert ok.all()
    assert np.abs(again - np.column_stack([u, v])).max() < 1e-6
    assert np.abs(other * gain[visible] - 1).max() < 1e-9


def test_labels_cover_the_area_of_the_outline() -> None:
    studio = Studio({"preset": "fisheye-185", **VGA})
    wave = {"k": 3, "share": 0.2, "phase": 0.5}
    sheet = {"width": 0.6, "height": 0.5, "outline": "round", "outline_waves": [wave], **BENT}
    shown = Picture({"sheets": [{**sheet, "pose": listed(pose(rotation((0.3, 0.2, 0)), (0.2, 0.1, 0.45)))}]}, [plain()])
    angle = np.linspace(0, 2 * np.pi, 2000)[:-1]
    radius = 1 + 0.2 * np.cos(3 * angle - 0.5)
    outline, ok = studio.project(
        shown.place(0, np.column_stack([0.3 * radius * np.cos(angle), 0.25 * radius * np.sin(angle)]))
    )
    assert ok.all()
    count = (studio.look(shown, studio.pixels()).sheet == 0).sum()
    perimeter = np.linalg.norm(np.diff(outline, axis=0), axis=1).sum()
    assert abs(count - area_of(outline)) < 2 * np.sqrt(perimeter)  # 6 sigma of counting pixel centres
    assert count > 5000


def test_backgrounds_and_relighting_are_as_asked() -> None:
    lens = {"preset": "narrow-60", "width": 160, "height": 120}
    still = simulate_two_views(1, lens, seed=2, background="still", relight=0, motion="none", sensor=CLEAN)
    assert np.array_equal(*still.images)
    assert np.nanmax(np.abs(still.flow(0)[2] - 1)) < 1e-12
    other = simulate_two_views(1, lens, seed=2, background="unrelated", sensor=CLEAN)
    moved, visible, _ = other.flow(0)
    assert not visible[other.labels(0) == 0].any()
    assert np.isnan(moved[other.labels(0) == 0]).all()
    given = simulate_two_views(1, lens, seed=2, textures=[np.full((8, 8, 3), 200, np.uint8)], sensor=CLEAN, relight=0)
    inside = given.labels(0) == 1
    assert np.std(given.images[0][inside]) < 0.3 * np.std(other.images[0][other.labels(0) == 1])
    near = simulate_two_views(1, lens, seed=2, scale=1.5, motion="none", relight=0)
    grown = (near.labels(1) == 1).sum() / (near.labels(0) == 1).sum()
    assert 1.5 < grown < 2.3  # 2.25, but for what the picture's edge cuts


def test_same_seed_same_bits_for_any_threads() -> None:
    lens = {"width": 320, "height": 240}
    target = Target("charuco", 5, 6, 0.04)
    one, three, other = (
        simulate_target_views(target, lens, 2, seed=s, threads=t, samples=34)[0] for s, t in ((7, 1), (7, 3), (8, 1))
    )
    assert all(np.array_equal(a.image, b.image) for a, b in zip(one, three, strict=True))
    assert not np.array_equal(one[0].image, other[0].image)
    a, b = (simulate_two_views(2, lens, seed=7, threads=t, samples=34) for t in (1, 3))
    assert np.array_equal(a.images[1], b.images[1])


def test_objects_are_where_boxes_and_labels_say() -> None:
    made = simulate_objects(4, 3, {"preset": "narrow-60", "width": 320, "height": 240}, seed=3, samples=34)
    assert made.kinds == ["card", "bent", "box", "cylinder"]
    for k, views in enumerate(made.models):
        mask = views[0].labels == k + 1
        assert 0.08 < mask.mean() < 0.5
        assert set(np.unique(views[0].labels)) == {0, k + 1}
        assert np.std(views[0].image[mask]) > 4 * np.std(views[0].image[~mask])
        assert views[0].shown == {k + 1: 1.0}
    assert any(0 < share < 1 for scene in made.scenes for share in scene.shown.values())
    for scene in made.scenes:
        seen = made.studio.look(scene.picture, made.studio.pixels())
        for k, share in scene.shown.items():
            rows, columns = np.nonzero(scene.labels == k)
            assert (share > 0) == (len(rows) > 0)
            if len(rows):
                assert scene.boxes[k] == (columns.min(), rows.min(), columns.max(), rows.max())
            if made.kinds[k - 1] == "box":  # closed: nobody sees it from within
                assert not seen.back[scene.labels.ravel() == k].any()
    poses = [p for scene in made.scenes for p in scene.poses.values()]
    distance = made.models[0][0].poses[1][2, 3]
    scales = [distance / np.linalg.norm(p[:, 3]) for p in poses]
    assert min(scales) > 0.49
    assert max(scales) < 2.01


def test_textures_are_rich_and_band_limited() -> None:
    texture = pattern(3, 256, 256)
    assert texture.dtype == np.float32
    assert 0.1 < texture.std() < 0.3
    assert texture.min() >= 0.05
    assert texture.max() <= 0.95
    power = np.abs(np.fft.fft2(texture * np.hanning(256)[:, None] * np.hanning(256))) ** 2
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    assert power[wave > 0.4].sum() < 1e-3 * power[(wave > 0.02) & (wave < 0.2)].sum()
    assert not np.array_equal(texture, pattern(4, 256, 256))
    with pytest.raises(ArgumentError, match="at least 2 x 2"):
        raster(np.zeros((1, 5)))


@pytest.mark.parametrize(
    ("picture_spec", "message"),
    [
        ({"sheets": [{"curvature": 1, "relief": {"powers": [{"i": 2, "metres": 0.1}]}}]}, r"sheets\[0\]\.curvature: "),
        ({"sheets": [{"width": 7, "curvature": 1}]}, "wider than the cylinder"),
        ({"sheets": [{"pose": [2.0] * 12}]}, r"sheets\[0\]\.pose: not a rotation"),
        ({"sheets": [{"texture": 3}]}, r"sheets\[0\]\.texture: there are 1"),
        ({"sheets": [{"stretch_a": {"powers": [{"i": 1, "metres": -1}]}}]}, "the texture folds"),
        ({"lamps": [{"x": 0, "watts": 3}]}, r"lamps\[0\]\.watts: unknown"),
        ({"gamma": 9}, "gamma: must be within"),
    ],
)
def test_a_wrong_picture_is_refused_by_its_key(picture_spec: dict, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        Picture(picture_spec, [plain()])


def test_a_scene_file_becomes_a_folder_with_its_truth(tmp_path: Path) -> None:
    file = tmp_path / "board.toml"
    file.write_text(
        'kind = "target"\ntarget = { kind = "circles", rows = 4, cols = 5, spacing_m = 0.03 }\nviews = 2\n'
        "samples = 34\nlens = { width = 160, height = 120 }\nwarp_m = 0.001\n"
    )
    assert main(["simulate", str(file), "-o", str(tmp_path / "out")]) == 0
    truth = json.loads((tmp_path / "out" / "truth.json").read_text())
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["000.png", "001.png", "truth.json"]
    assert Target.from_dict(truth["target"]).rows == 4
    assert len(truth["views"][1]["points_px"]) == len(truth["views"][1]["centroids_px"]) == 20
    assert truth["board"]["relief"]["powers"]
    assert Image.open(tmp_path / "out" / "000.png").size == (160, 120)
    simulate(file, tmp_path / "out", frames=1, quiet=True)  # replaces
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["000.png", "truth.json"]
    (tmp_path / "mine").mkdir()
    with pytest.raises(PipefishError, match="is no folder of simulated pictures"):
        simulate(file, tmp_path / "mine", quiet=True)
    picture(file, tmp_path / "p.png", 1)
    assert Image.open(tmp_path / "p.png").size == (160, 120)


def test_pairs_and_objects_become_folders(tmp_path: Path) -> None:
    small = {"lens": {"preset": "narrow-60", "width": 160, "height": 120}, "samples": 34, "seed": 3}
    simulate({"kind": "two-views", "layers": 2, **small}, tmp_path / "pair", quiet=True)
    flow = np.load(tmp_path / "pair" / "flow_a.npz")
    assert flow["flow"].shape == (120, 160, 2)
    assert np.nanmedian(np.abs(flow["flow"])) < 60
    assert flow["visible"].mean() > 0.3
    assert np.unique(np.asarray(Image.open(tmp_path / "pair" / "labels_b.png"))).tolist() == [0, 1, 2]
    simulate(
        {"kind": "objects", "objects": 2, "scenes": 1, "kinds": ["card", "box"], **small}, tmp_path / "o", quiet=True
    )
    truth = json.loads((tmp_path / "o" / "truth.json").read_text())
    assert truth["kinds"] == ["card", "box"]
    for entry in [*truth["models"][0], *truth["scenes"]]:
        assert (tmp_path / "o" / entry["file"]).exists()
        assert (tmp_path / "o" / entry["labels"]).exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "movie"', "s.toml: kind: must be one of target"),
        ('kind = "two-views"\nlayer = 2', "s.toml: layer: unknown"),
        ('kind = "two-views"\nlayers = "two"', "s.toml: layers: must be whole number"),
        ('kind = "two-views"\nmotion = "fast"', "s.toml: motion: must be one of"),
        ('kind = "two-views"\nlens = { width = 3 }', "s.toml: lens.width: must be within"),
        ('kind = "two-views"\nsamples = 50', "s.toml: samples: must be 34"),
        ('kind = "target"', "s.toml: target: missing"),
        ('kind = "target"\ntarget = { kind = "circles", rows = 3 }', "s.toml: target.cols: missing"),
        ('kind = "objects"\nscale = [2, 1]', "s.toml: per_scene, scale: must be"),
        ('kind = "objects"\nkinds = ["ball"]', "s.toml: kinds: must be of"),
        ('kind = "objects"\ntextures = ["s.toml"]', "s.toml: not a picture"),
    ],
)
def test_a_wrong_scene_file_is_refused_by_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(FormatError, match=message):
        simulate(tmp_path / "s.toml", tmp_path / "out", quiet=True)
    assert [p.name for p in tmp_path.iterdir()] == ["s.toml"]


def test_every_shipped_scene_is_valid_and_says_what_it_is() -> None:
    known = studio_scenarios()
    assert {"target-checkerboard", "target-sleeve", "two-views", "objects"} <= set(known)
    for name, about in known.items():
        assert 20 < len(about) < 120, name
        scene = checked(read_scene(SCENARIOS / f"{name}.toml")[0], None)
        if scene["kind"] == "target":
            assert len(Target.from_dict(scene["target"]).points()) > 20
