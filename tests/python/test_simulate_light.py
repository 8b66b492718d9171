"""Surfaces and light of the simulator: photometry against closed forms, and what each option does to the picture."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from pipefish.errors import FormatError
from pipefish.simulate import Scene

RADIUS, EVEN = 0.1, 0.45
F0 = 0.04
# A roughness that the surface's bytes hold exactly: they step by 1.8 / 255.
ALPHA = 14 * 1.8 / 255


def straight(**changes: dict) -> dict:
    """An even, matt wall, a central lens without vignetting, no noise, no blur, light from the lamps alone, clipped."""
    scene = {
        "diameter": 2 * RADIUS,
        "pieces": [{"length": 5.0}],
        "texture": {"contrast": 0, "joint_spacing": 0},
        "lens": {"width": 320, "height": 240, "circle_radius": 118, "c_u": 160, "c_v": 120}
        | {"pupil_scale": 0, "zonal_px": 0, "vignetting": 0, "rim_blur_px": 0},
        "lamp": {"bounce": 0, "exposure": 350, "size": 0},
        "sensor": {"blur_px": 0, "read_noise": 0, "shot_noise": 0},
        "tone": {"knee": 1},
        "motion": {"frames": 40, "start": 1.0, "below_axis": 0, "wobble_m": 0, "wobble_rad": 0},
    }
    for key, value in changes.items():
        scene[key] = scene.get(key, {}) | value if isinstance(value, dict) else value
    return scene


def wall(scene: Scene, frame: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whole pixels (N, 2), their wall points (N, 3) in the camera's frame, and inward normals (N, 3)."""
    lens = scene.spec["lens"]
    rows, columns = np.mgrid[0 : lens["height"] : 3, 0 : lens["width"] : 3]
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    away = np.hypot(pixels[:, 0] - lens["c_u"], pixels[:, 1] - lens["c_v"])
    pixels = pixels[(away > 8) & (away < 0.99 * scene.circle_radius)]
    points, ok = scene.cast(frame, pixels)
    assert ok.all()
    pose = scene.pose(frame)
    inward = -points * [1, 1, 0] / np.linalg.norm(points[:, :2], axis=1)[:, None]
    return pixels.astype(int), points @ pose[:, :3].T + pose[:, 3], inward @ pose[:, :3].T


def lambert(points: np.ndarray, normals: np.ndarray, lamps: list, law: tuple[float, float, int]) -> np.ndarray:
    """Mean over lamps (place, axis, factor) of intensity x cosine / distance^2."""
    side, forward, exponent = law
    total = np.zeros(len(points))
    for place, axis, factor in lamps:
        to = np.array(place) - points
        distance = np.linalg.norm(to, axis=1)
        ahead = np.maximum(-(to @ np.array(axis)) / distance, 0)
        shine = side + forward * np.where(ahead > 0, ahead**exponent, 0)
        total += factor * shine * np.maximum(np.sum(to * normals, axis=1) / distance, 0) / distance**2
    return total / len(lamps)


def ring(count: int, radius: float, start: float = 0.0) -> list:
    turns = start + 2 * np.pi * np.arange(count) / count
    return [((radius * math.sin(a), -radius * math.cos(a), 0), (0, 0, 1), 1) for a in turns]


LAMPS = {
    "ring": ({"lamps": 5, "ring_radius": 0.04, "side": 0.3, "forward": 0.8}, ring(5, 0.04), (0.3, 0.8, 2)),
    "sides": ({"layout": "sides", "ring_radius": 0.045}, ring(2, 0.045, math.pi / 2), (0.12, 1.0, 2)),
    "list": (
        {
            "layout": "list",
            "exponent": 5,
            "side": 0.1,
            "forward": 1.2,
            "list": [
                {"x": 0.03, "y": -0.02, "z": -0.05, "yaw": 0.6, "pitch": 0.3, "intensity": 1.5},
                {"x": -0.02, "z": 0.03, "yaw": -0.2, "intensity": 0.7},
            ],
        },
        [
            ((0.03, -0.02, -0.05), (math.sin(0.6) * math.cos(0.3), -math.sin(0.3), math.cos(0.6) * math.cos(0.3)), 1.5),
            ((-0.02, 0, 0.03), (-math.sin(0.2), 0, math.cos(0.2)), 0.7),
        ],
        (0.1, 1.2, 5),
    ),
}


@pytest.mark.parametrize("layout", LAMPS)
def test_matt_wall_is_lit_by_the_closed_form_of_every_lamp(layout: str) -> None:
    spec, lamps, law = LAMPS[layout]
    scene = Scene(straight(lamp=spec))
    pixels, points, normals = wall(scene)
    expected = np.minimum(350 * RADIUS**2 * EVEN * lambert(points, normals, lamps, law), 255)
    seen = scene.render(5)[pixels[:, 1], pixels[:, 0]]
    # Rounding of the picture, and of the albedo to 1 / 255.
    assert np.abs(seen - expected).max() < 0.51 + 0.5 / 255 / EVEN * expected.max()
    assert expected.max() > 60


def test_exposure_is_the_level_of_a_white_wall_square_to_a_lamp_at_the_radius() -> None:
    scene = straight(lamp={"lamps": 1, "ring_radius": 0, "side": 1, "forward": 0, "exposure": 200})
    at = Scene(scene).arc_length(5)
    scene["markers"] = [{"s": at, "phi": math.pi / 2, "radius": 0.03}]
    made = Scene(scene)
    pixel, _ = made.project(5, made.wall(at, math.pi / 2)[None])
    u, v = np.round(pixel[0]).astype(int)
    assert abs(int(made.render(5)[v, u]) - 200) <= 1


def brdf_times_pi(nl: np.ndarray, nv: np.ndarray, lv: np.ndarray, albedo: float, alpha: float) -> np.ndarray:
    """docs/simulator.md's law, written out once more."""

    def schlick(cosine: np.ndarray, most: float) -> np.ndarray:
        return F0 + (most - F0) * (1 - cosine) ** 5

    half = np.sqrt(2 + 2 * lv)
    distribution = alpha**2 / (np.pi * (((nl + nv) / half) ** 2 * (alpha**2 - 1) + 1) ** 2)
    visible = 0.5 / (2 * nl * nv * (1 - alpha) + (nl + nv) * alpha)
    taken = [schlick(c, max(1 - alpha, F0)) for c in (nl, nv)]
    return albedo * (1 - taken[0]) * (1 - taken[1]) + np.pi * distribution * visible * schlick(half / 2, 1)


def test_glossy_wall_is_the_law_that_the_docs_state() -> None:
    lamp = {"lamps": 3, "ring_radius": 0.04, "side": 1, "forward": 0, "exposure": 90}
    scene = Scene(straight(lamp=lamp, texture={"roughness": ALPHA}))
    pixels, points, normals = wall(scene)
    distance = np.linalg.norm(points, axis=1)
    nv = -np.sum(points * normals, axis=1) / distance
    expected = np.zeros(len(points))
    for place, axis, _ in ring(3, 0.04):
        to = np.array(place) - points
        away = np.linalg.norm(to, axis=1)
        lv = -np.sum(to * points, axis=1) / away / distance
        nl = np.sum(to * normals, axis=1) / away
        light = lambert(points, normals, [(place, axis, 1)], (1, 0, 2)) / 3
        expected += 90 * RADIUS**2 * light * brdf_times_pi(nl, nv, lv, EVEN, ALPHA)
    keep = nv > 0.03  # the shading's floor of n.v
    seen = scene.render(5)[pixels[:, 1], pixels[:, 0]]
    assert np.abs(seen - np.minimum(expected, 255))[keep].max() < 0.51 + 0.005 * expected.max()
    matt = Scene(straight(lamp=lamp)).render(5)[pixels[:, 1], pixels[:, 0]]
    assert (expected - matt).max() > 30  # there is a highlight


def test_highlight_stands_in_the_mirror_direction_with_the_closed_form_s_height() -> None:
    # A lamp at the camera: the wall beside it, head-on, throws D V F pi = F0 / (4 alpha^2) on top of the matt part.
    lamp = {"lamps": 1, "ring_radius": 0, "side": 1, "forward": 0, "exposure": 150}
    scene = Scene(straight(lamp=lamp, texture={"roughness": ALPHA}))
    pixel, _ = scene.project(5, scene.wall(scene.arc_length(5), math.pi / 2)[None])
    line = scene.render(5)[round(pixel[0, 1])].astype(int)
    peak = 150 * (EVEN * (1 - F0) ** 2 + F0 / (4 * ALPHA**2))
    assert line[round(pixel[0, 0])] == pytest.approx(peak, abs=1.5)
    assert line[161:].max() == pytest.approx(peak, abs=1.5)


@pytest.mark.parametrize("alpha", [0.05, 0.15, 0.3, 0.5, 0.8, 1.0])
def test_no_wall_throws_back_more_light_than_it_gets(alpha: float) -> None:
    # Over the hemisphere, for a white wall; the law is the one that the picture was held against above. Where light
    # grazes (n.v below 0.1) the masking's approximation is not asked.
    for nv in (0.1, 0.2, 0.4, 0.7, 1.0):
        # Substituting the half vector's slope would be finer; 1500 x 400 cells hold alpha = 0.05 to 0.2 %.
        mu = (np.arange(1500) + 0.5) / 1500
        phi = (np.arange(400) + 0.5) / 400 * np.pi
        nl, turn = np.meshgrid(mu, phi, indexing="ij")
        lv = nl * nv - np.sqrt(1 - nl**2) * math.sqrt(1 - nv**2) * np.cos(turn)
        total = np.mean(brdf_times_pi(nl, np.full_like(nl, nv), lv, 1.0, alpha) * nl) * 2
        assert 0.5 < total < 1.01, nv


def test_fog_dims_by_beer_and_lambert() -> None:
    lamp = {"lamps": 4, "ring_radius": 0.03, "side": 0.5, "forward": 0.5, "exposure": 400}
    scene = Scene(straight(lamp=lamp, fog={"density": 2.5, "albedo": 0}))
    pixels, points, normals = wall(scene)
    expected = np.zeros(len(points))
    for place, axis, _ in ring(4, 0.03):
        path = np.linalg.norm(np.array(place) - points, axis=1) + np.linalg.norm(points, axis=1)
        expected += lambert(points, normals, [(place, axis, 1)], (0.5, 0.5, 2)) / 4 * np.exp(-2.5 * path)
    expected *= 400 * RADIUS**2 * EVEN
    seen = scene.render(5)[pixels[:, 1], pixels[:, 0]]
    assert np.abs(seen - expected).max() < 0.51 + 0.5 / 255 / EVEN * expected.max()


def test_fog_veils_by_the_integral_of_single_scattering() -> None:
    fog = {"density": 4.0, "albedo": 1.0, "anisotropy": 0.5}
    lamp = {"layout": "sides", "ring_radius": 0.04, "side": 0.4, "forward": 0.6, "exposure": 600}
    lens = {"width": 640, "height": 480, "c_u": 320, "c_v": 240, "circle_radius": 235}
    scene = Scene(straight(lamp=lamp, lens=lens, fog=fog))
    clear = Scene(straight(lamp=lamp, lens=lens, fog=fog | {"albedo": 0}))
    pixels, points, _ = wall(scene)
    some = np.linspace(0, len(pixels) - 1, 60).astype(int)
    pixels, points = pixels[some], points[some]
    # Rays that nearly meet a lamp see it through the table's 32 pixels.
    outward = points / np.linalg.norm(points, axis=1)[:, None]
    passes = [np.linalg.norm(np.cross(outward, place), axis=1) for place, _, _ in ring(2, 0.04, math.pi / 2)]
    pixels, points = (v[np.min(passes, axis=0) > 0.02] for v in (pixels, points))
    veil = scene.render(5)[pixels[:, 1], pixels[:, 0]].astype(float) - clear.render(5)[pixels[:, 1], pixels[:, 0]]
    steps = (np.arange(4000) + 0.5) / 4000
    expected = np.zeros(len(points))
    for place, _, _ in ring(2, 0.04, math.pi / 2):
        for i, point in enumerate(points):
            depth = np.linalg.norm(point)
            out = steps[:, None] * point - np.array(place)
            away = np.linalg.norm(out, axis=1)
            shine = 0.4 + 0.6 * np.maximum(out[:, 2] / away, 0) ** 2
            turn = -(out @ point) / away / depth
            phase = (1 - 0.25) / (4 * np.pi * (1.25 - turn) ** 1.5)
            light = shine / 2 / away**2 * phase * np.exp(-4.0 * (away + steps * depth))
            expected[i] += np.pi * 4.0 * depth * light.mean() * 600 * RADIUS**2
    assert expected.max() > 15
    # Two roundings; the table's linear interpolation over 32 pixels.
    assert np.abs(veil - expected).max() < 1.0 + 0.03 * expected.max()


def test_light_between_walls_obeys_the_balance_of_an_endless_pipe() -> None:
    # All light of a point source (4 pi) meets the wall; of what meets it the share `albedo` goes on to other wall, for
    # ever: the bounced light's integral along the pipe is albedo / (1 - albedo) of the direct one's, 1 / radius a side.
    lamp = {"lamps": 1, "ring_radius": 0, "side": 1, "forward": 0, "exposure": 250}
    lens = {"width": 640, "height": 480, "c_u": 320, "c_v": 240, "circle_radius": 235}
    both, direct = Scene(straight(lamp=lamp | {"bounce": 1}, lens=lens)), Scene(straight(lamp=lamp, lens=lens))
    columns = np.arange(323, 550)
    points, ok = both.cast(5, np.column_stack([columns, np.full(len(columns), 240)]).astype(float))
    along = points[:, 2] - both.centre(5)[2]
    bounced = both.render(5)[240, columns].astype(float) - direct.render(5)[240, columns]
    keep = ok & (along > 0) & (along < 12 * RADIUS)
    order = np.argsort(along[keep])
    integral = np.trapezoid(bounced[keep][order], along[keep][order]) / (250 * RADIUS**2 * EVEN)
    assert integral * RADIUS == pytest.approx(EVEN / (1 - EVEN), rel=0.04)


def test_fine_texture_is_averaged_not_skipped() -> None:
    # The same wall through a lens of four times the resolution, 4 x 4 pixels averaged: each pixel must be the mean of
    # what is under it, from the rim to the far end.
    texture = {"contrast": 1, "gloss": 0, "relief": 0, "wetness": 0, "joint_spacing": 0}
    small = {"width": 160, "height": 120, "circle_radius": 59, "c_u": 80, "c_v": 60}
    coarse = Scene(straight(texture=texture, lens=small, lamp={"exposure": 700}))
    lens = {"width": 640, "height": 480, "circle_radius": 236, "c_u": 321.5, "c_v": 241.5}
    fine = Scene(straight(texture=texture, lens=lens, lamp={"exposure": 700}))
    seen = coarse.render(5).astype(float)
    truth = fine.render(5).astype(float).reshape(120, 4, 160, 4).mean((1, 3))
    rows, columns = np.mgrid[:120, :160]
    away = np.hypot(columns - 80, rows - 60)
    for low, high in ((8, 25), (25, 42), (42, 57)):
        where = (away > low) & (away < high)
        assert seen[where].mean() == pytest.approx(truth[where].mean(), rel=0.01)
        texture_left = truth[where].std()
        assert (seen - truth)[where].std() < 0.35 * texture_left, low


@pytest.mark.parametrize("material", ["concrete", "brick", "clay", "pvc", "lined"])
def test_every_material_is_a_function_of_seed_and_place_alone(material: str) -> None:
    spec = straight(texture={"material": material, "contrast": 1}, lamp={"exposure": 500})
    walker, other = Scene(spec), Scene(spec)
    seen = {frame: walker.render(frame, 1) for frame in (0, 30, 1)}
    for frame in (1, 0, 30):
        assert np.array_equal(other.render(frame, 3), seen[frame])
    spec["texture"]["seed"] = 2
    assert not np.array_equal(Scene(spec).render(0), seen[0])


def test_relief_answers_to_where_the_lamp_is() -> None:
    # The same wall lit from the left and from the right: without relief only the lamps' smooth light differs.
    def ratio(relief: float) -> np.ndarray:
        pictures = []
        for x in (-0.045, 0.045):
            lamp = {"layout": "list", "list": [{"x": x}], "exposure": 200, "side": 1}
            texture = {"contrast": 1, "gloss": 0, "wetness": 0, "wear": 0, "relief": relief}
            sensor = {"bits": 10, "blur_px": 0, "read_noise": 0, "shot_noise": 0}
            pictures.append(Scene(straight(lamp=lamp, texture=texture, sensor=sensor)).render(5).astype(float))
        left, right = pictures
        share = (left - right) / np.maximum(left + right, 1)
        crown = share[20:50, 130:190]
        return crown[:, 1:-1] - 0.5 * (crown[:, :-2] + crown[:, 2:])

    assert ratio(1).std() > 3 * ratio(0).std()


def test_the_materials_are_as_hard_as_they_should_be() -> None:
    path = Path(__file__).parents[1] / "surfaces.py"
    spec = importlib.util.spec_from_file_location("surfaces", path)
    surfaces = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(surfaces)
    found = {m: surfaces.statistics(*surfaces.draw(m)) for m in ("concrete", "pvc")}
    # Of the stills (smooth grey plastic): 0.3 and 10 usable corners a 10,000 pixels, before and after their own blur.
    assert 0.3 < found["pvc"]["corners_usable"] < 10
    assert found["concrete"]["corners_usable"] > 10 * found["pvc"]["corners_usable"]


def test_flicker_is_the_mean_of_its_wave_over_the_shutter() -> None:
    def levels(shutter: float, **flicker: float) -> np.ndarray:
        sensor = {"blur_px": 0, "read_noise": 0, "shot_noise": 0, "exposure_s": shutter}
        scene = Scene(straight(lamp={"flicker": flicker}, sensor=sensor))
        return np.array([scene.light_level(f) for f in range(40)])

    times = np.arange(40) / 20
    instant = levels(0, amplitude=0.3, frequency=100.7)
    assert np.abs(instant - (1 + 0.3 * np.sin(2 * np.pi * 100.7 * times))).max() < 1e-9
    # Over 4 ms, by 20,000 steps.
    window = times[:, None] + ((np.arange(20000) + 0.5) / 20000 - 0.5) * 0.004
    mean = (1 + 0.3 * np.sin(2 * np.pi * 100.7 * window)).mean(axis=1)
    assert np.abs(levels(0.004, amplitude=0.3, frequency=100.7) - mean).max() < 1e-6
    bright = (window * 130.3) % 1 < 0.4
    expected = (0.5 + 0.5 * bright.mean(axis=1)) / (0.5 + 0.5 * 0.4)
    assert np.abs(levels(0.004, amplitude=0.5, frequency=130.3, duty=0.4) - expected).max() < 1e-3
    assert np.ptp(expected) > 0.05  # it beats
    assert np.array_equal(levels(0), np.ones(40))


def test_a_rolling_shutter_sees_flicker_as_bands() -> None:
    sensor = {"blur_px": 0, "read_noise": 0, "shot_noise": 0, "line_time_s": 1e-4}
    motion = {"speed": 0}
    steady = Scene(straight(lamp={"exposure": 700}, sensor=sensor, motion=motion))
    lamp = {"exposure": 700, "flicker": {"amplitude": 0.3, "frequency": 100}}
    banded = Scene(straight(lamp=lamp, sensor=sensor, motion=motion))
    rows = np.array([30, 60, 90, 150, 180, 210])
    ratio = banded.render(3)[rows, 110:210].sum(axis=1) / steady.render(3)[rows, 110:210].sum(axis=1)
    times = 3 / 20 + (rows - 119.5) * 1e-4
    assert np.abs(ratio - (1 + 0.3 * np.sin(2 * np.pi * 100 * times))).max() < 0.01


def test_scripted_exposure_scales_the_picture_from_its_frame_on() -> None:
    steps = [{"frame": 4, "gain": 0.5}, {"frame": 8, "gain": 2}]
    scene = Scene(straight(exposure={"mode": "script", "steps": steps}, motion={"speed": 0}))
    assert [scene.light_level(f) for f in (3, 4, 7, 8)] == [1, 0.5, 0.5, 2]
    full, half = scene.render(3).astype(float), scene.render(4).astype(float)
    assert np.abs(full / 2 - half).max() <= 0.8


def test_auto_exposure_steps_towards_its_target_and_lags() -> None:
    # Lamps that dim and come back every 2 s: the loop follows in steps of half a stop, late.
    flicker = {"amplitude": 0.9, "frequency": 0.5}
    auto = {"mode": "auto", "target": 60, "step": 0.5, "slack": 0.3, "interval": 3, "delay": 2}
    scene = Scene(straight(exposure=auto, lamp={"flicker": flicker}, motion={"speed": 0}))
    light = np.array([scene.light_level(f) for f in range(40)])
    gain = light / (1 + 0.9 * np.sin(np.pi * np.arange(40) / 20))
    stops = np.log2(gain) * 2
    assert np.abs(stops - np.round(stops)).max() < 1e-9
    changes = np.flatnonzero(np.abs(np.diff(stops)) > 0.5) + 1
    assert len(changes) >= 4
    assert (changes % 3 == 0).all()
    steady = Scene(straight(exposure=auto, motion={"speed": 0}))
    lens = steady.spec["lens"]
    rows, columns = np.mgrid[:240, :320]
    inside = np.hypot(columns - lens["c_u"], rows - lens["c_v"]) < 118
    error = math.log2(steady.render(20)[inside].mean() / 60)
    assert abs(error) < 0.35  # slack, and the meter's coarse grid


def test_tone_bends_highlights_and_keeps_the_rest() -> None:
    lamp = {"lamps": 1, "ring_radius": 0, "side": 1, "forward": 0, "exposure": 600}
    linear = Scene(straight(lamp=lamp, sensor={"bits": 10, "blur_px": 0, "read_noise": 0, "shot_noise": 0}))
    grey = linear.render(5).astype(float) / 4
    curve = Scene(straight(lamp=lamp, tone={"knee": 0.5, "gamma": 2.2})).render(5).astype(float)
    x = grey / 255
    expected = 255 * np.where(x > 0.5, 0.5 + 0.5 * (1 - np.exp(-(x - 0.5) / 0.5)), x) ** (1 / 2.2)
    free = (grey < 254) & (grey > 4)
    assert np.abs(curve - expected)[free].max() < 1.5
    assert (grey >= 255).any()
    assert curve.max() < 254


def test_drops_and_dirt_stay_where_they_are_on_the_glass() -> None:
    texture = {"contrast": 1}
    clean = Scene(straight(texture=texture, lamp={"exposure": 700}))
    window = {"drops": 3, "dirt": 5, "drop_radius": 14, "dirt_radius": 12, "dirt_density": 0.9}
    soiled = Scene(straight(texture=texture, lamp={"exposure": 700}, window=window))
    touched = [np.abs(soiled.render(f).astype(int) - clean.render(f)) > 0 for f in (2, 30)]
    share = [t.mean() for t in touched]
    assert 0.005 < share[0] < 0.2
    either, both = touched[0] | touched[1], touched[0] & touched[1]
    assert both.sum() > 0.7 * either.sum()


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"texture": {"material": "wood"}}, "texture.material: must be one of concrete, brick, clay, pvc, lined"),
        ({"texture": {"wear": 2}}, "texture.wear: must be within"),
        ({"lamp": {"layout": "list"}}, "lamp.list: needs at least one lamp"),
        ({"lamp": {"layout": "list", "list": [{"x": 0.06}]}}, r"lamp.list\[0\]: must be within a quarter"),
        ({"lamp": {"flicker": {"duty": 1.5}}}, "lamp.flicker.duty: must be within"),
        ({"fog": {"density": -1}}, "fog.density: must be within"),
        ({"exposure": {"mode": "manual"}}, "exposure.mode: must be one of fixed, script, auto"),
        ({"exposure": {"steps": [{"frames": 1}]}}, r"exposure.steps\[0\].frames: unknown"),
        ({"window": {"drops": 1.5}}, "window.drops: must be a whole number"),
        ({"tone": {"gamma": 0}}, "tone.gamma: must be within"),
    ],
)
def test_bad_light_is_refused_with_the_key(change: dict, where: str) -> None:
    with pytest.raises(FormatError, match=where):
        Scene(straight(**change))
