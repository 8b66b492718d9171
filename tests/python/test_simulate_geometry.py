"""The simulated pipe's geometry: what a ray meets is the stated surface, first hit and normal; truth is consistent."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from pipefish.errors import FormatError
from pipefish.simulate import MATERIALS, Scene, Sights, simulate

LENS = {"width": 320, "height": 240, "circle_radius": 118, "c_u": 158.3, "c_v": 121.1}
WALL, JOINT, DEPOSIT, HOLE, CRACK, LATERAL, ROOT, WATER = range(8)
TURN = 2 * math.pi


def pipe(diameter: float = 0.3, **features: object) -> dict:
    """A straight pipe with features; the camera creeps along from 0.4 diameters before s = 1."""
    motion = {"frames": 12, "start": 1 - 0.8 * diameter, "speed": 0.2, "below_axis": 0.04 * diameter}
    motion |= {"wobble_m": 0.01 * diameter}
    base = {"diameter": diameter, "pieces": [{"length": 4.0}], "lens": LENS, "motion": motion}
    return base | {"texture": {"joint_spacing": 0}, "lamp": {"ring_radius": 0.1 * diameter}} | features


def grid_wall(diameter: float) -> dict:
    s, phi = np.linspace(0.5, 2.0, 61)[:, None], np.arange(48) * TURN / 48
    radius = diameter / 2 * (1 + 0.05 * np.cos(3 * phi) * np.sin(9 * s) + 0.03 * np.sin(phi + 5 * s))
    return {"start": 0.5, "step": 0.025, "around": 48, "radius": radius.ravel().tolist()}


def scenes(d: float) -> dict[str, dict]:
    """One scene a feature, in a pipe of diameter d."""
    path = [{"s": 0.8, "phi": 0.9}, {"s": 1.3, "phi": 2.0}]
    ring = [{"s": 1.05, "phi": 0.3}, {"s": 1.05, "phi": 0.3 + TURN}]
    bends = [{"length": 0.9}, {"angle": 1.5, "radius": 2 * d, "clock": math.pi}]
    bends += [{"angle": 1.5, "radius": 2 * d, "clock": 0}, {"length": 2.0}]
    joint = {"s": 1.0, "gap": 0.06 * d, "depth": 0.08 * d, "step_right": 0.02 * d, "step_down": -0.03 * d}
    return {
        "joint": pipe(d, joints=[joint | {"yaw": 0.04, "pitch": -0.03}, {"s": 1.5, "gap": 0.01 * d, "depth": 0.1 * d}]),
        "mitre": pipe(d, joints=[{"s": 1.0, "gap": 0, "yaw": 0.1, "step_down": 0.05 * d}]),
        "egg": pipe(d, eggs=[{"start": 0.7, "end": 1.9, "ramp": 0.3}], ovals=[{"start": 1, "end": 2, "ovality": 0.1}]),
        "corrugation": pipe(d, corrugations=[{"start": 0.8, "end": 1.6, "amplitude": 0.02 * d, "wavelength": 0.1 * d}]),
        "deposit": pipe(d, deposits=[{"s": 1.1, "length": d, "height": 0.2 * d, "roughness": 0.01 * d, "grain": 0.04 * d}]),
        "grid": pipe(d, grid=grid_wall(d)),
        "hole": pipe(d, holes=[{"s": 1.0, "clock": 2.0, "diameter": 0.2 * d, "depth": 0.3 * d}]),
        "crack": pipe(
            d,
            cracks=[
                {"path": path, "width": 0.02 * d, "depth": 0.06 * d, "meander": 0.02 * d, "grain": 0.1 * d},
                {"path": ring, "width": 0.01 * d, "depth": 0.03 * d},
            ],
            joints=[{"s": 1.1, "gap": 0.02 * d, "depth": 0.03 * d, "step_down": 0.01 * d}],
        ),
        "lateral": pipe(
            d,
            laterals=[
                {"s": 0.9, "clock": 1.3, "diameter": 0.5 * d, "angle": 1.0, "length": 2 * d},
                {"s": 1.2, "clock": 4.6, "diameter": 0.8 * d, "angle": 2.0, "length": 2 * d},
            ],
        ),
        "bends": pipe(d, pieces=bends, deposits=[{"s": 1.1, "length": d, "height": 0.1 * d}])
        | {"holes": [{"s": 1.1, "clock": 1.0, "diameter": 0.2 * d}], "motion": pipe(d)["motion"] | {"speed": 0.8}},
    }  # fmt: skip


def pixels_in_circle(count: int, seed: int) -> np.ndarray:
    """Random pixels inside the image circle."""
    rng = np.random.default_rng(seed)
    radius, angle = 117.5 * np.sqrt(rng.uniform(0.001, 1, count)), rng.uniform(0, TURN, count)
    return np.column_stack([LENS["c_u"] + radius * np.cos(angle), LENS["c_v"] + radius * np.sin(angle)])


def wall_radius(scene: Scene, places: np.ndarray) -> np.ndarray:
    return np.array([scene.wall_radius(s, phi) for s, _, phi in places])


def origins(scene: Scene, frame: int, seen: Sights, pixels: np.ndarray) -> np.ndarray:
    """Where on the optical axis each pixel's ray begins: from the lens table, by the angle of the pixel."""
    pose, lens = scene.pose(frame), scene.lens()
    r = np.linalg.norm(pixels - [LENS["c_u"], LENS["c_v"]], axis=1)
    fine = np.linspace(0, scene.spec["lens"]["theta_max"], 200001)
    table = np.array([scene._scene.lens(t) for t in fine[::100]])
    del lens
    theta = np.interp(r, table[:, 0], fine[::100])
    pupil = np.interp(theta, fine[::100], table[:, 1])
    return scene.centre(frame) + pupil[:, None] * pose[2, :3]


FEATURES = list(scenes(1.0))


@pytest.mark.parametrize("feature", FEATURES)
@pytest.mark.parametrize("diameter", [0.1, 0.3, 1.0])
def test_a_hit_lies_on_the_stated_wall_and_its_normal_is_the_gradient(feature: str, diameter: float) -> None:
    scene = Scene(scenes(diameter)[feature])
    checked = 0
    for frame in (0, 8):
        seen = scene.sights(frame, pixels_in_circle(1200, frame))
        assert seen.ok.all()
        wall = np.isin(seen.material, [WALL, DEPOSIT])
        places = scene.locate(seen.point[wall])
        error = np.abs(places[:, 1] - wall_radius(scene, places))
        # Where planes bound the wall (faces of joints), a neighbour's frame may claim the point: not more than a few.
        assert np.mean(error < 1e-9 * diameter / 2) > 0.998
        # The normal: against central differences of distance less wall radius in the world.
        step, where = 1e-6 * diameter, np.flatnonzero(wall)[:: max(1, wall.sum() // 150)]
        gradient = np.zeros((len(where), 3))
        for axis in range(3):
            for sign in (-1, 1):
                shifted = scene.locate(seen.point[where] + sign * step * np.eye(3)[axis])
                gradient[:, axis] += sign * (shifted[:, 1] - wall_radius(scene, shifted))
        gradient /= np.linalg.norm(gradient, axis=1)[:, None]
        angle = np.arccos(np.clip(-np.sum(gradient * seen.normal[where], axis=1), -1, 1))
        assert np.mean(angle < 2e-3) > 0.97
        assert np.median(angle) < 1e-4
        checked += wall.sum()
    assert checked > 500


def free_space(scene: Scene, points: np.ndarray) -> np.ndarray:
    """By the description alone: is each point (N, 3) in the pipe, a branch, a hole or a crack? True, or False."""
    spec = scene.spec
    places = scene.locate(points)
    inside = places[:, 1] < wall_radius(scene, np.nan_to_num(places))
    for kind in ("laterals", "holes"):
        for item in spec[kind]:
            s, clock = item["s"], item["clock"]
            origin = (scene.wall(s, 0.7) * scene.wall_radius(s, 0.7 + math.pi)
                      + scene.wall(s, 0.7 + math.pi) * scene.wall_radius(s, 0.7))  # fmt: skip
            origin /= scene.wall_radius(s, 0.7) + scene.wall_radius(s, 0.7 + math.pi)
            out = scene.wall(s, clock) - origin
            length = np.linalg.norm(out) + item["depth"] if kind == "holes" else item["length"]
            out /= np.linalg.norm(out)
            ahead = np.cross(scene.wall(s, 0) - origin, scene.wall(s, math.pi / 2) - origin)
            ahead /= -np.linalg.norm(ahead) * np.sign(ahead @ (scene.wall(s, 0) - scene.wall(s + 1e-3, 0)))
            angle = item.get("angle", math.pi / 2)
            axis = math.sin(angle) * out + math.cos(angle) * ahead
            along = (points - origin) @ axis
            across = np.linalg.norm(points - origin - along[:, None] * axis, axis=1)
            inside |= (along > 0) & (along < length) & (across < item["diameter"] / 2)
    return inside


@pytest.mark.parametrize("feature", FEATURES)
def test_a_fine_march_finds_nothing_before_the_hit_and_solid_behind_it(feature: str) -> None:
    scene = Scene(scenes(0.3)[feature])
    for frame in (0, 7):
        pixels = pixels_in_circle(60, 100 + frame)
        if feature not in ("bends",):  # more of them where there is something to miss
            many = pixels_in_circle(6000, frame)
            special = scene.sights(frame, many).material
            pixels = np.vstack([pixels, many[special > 0][:60]])
        seen = scene.sights(frame, pixels)
        start = origins(scene, frame, seen, pixels)
        way = seen.point - start
        length = np.linalg.norm(way, axis=1)
        near = length < 1.5
        share = np.concatenate([np.linspace(0, 1, 1200)[:-1], 1 - np.geomspace(1e-6, 1e-3, 20)])
        for i in np.flatnonzero(near):
            # 1e-6 m: the lens table's interpolation above moves the ray by less.
            free = free_space(scene, start[i] + share[:, None] * way[i])
            assert free[share * length[i] < length[i] - 1e-5].all(), (feature, frame, pixels[i], MATERIALS[seen.material[i]])
        beyond = seen.point[near] - 1e-6 * seen.normal[near]
        assert free_space(scene, beyond).mean() < 0.01, feature
