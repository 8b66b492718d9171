"""The simulated pipe's geometry: what a ray meets is the stated surface, first hit and normal; truth is consistent."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from pipefish.errors import FormatError
from pipefish.simulate import MATERIALS, Scene, simulate

# Round, so that a pixel's distance from the centre says its angle.
LENS = {"width": 320, "height": 240, "circle_radius": 118, "c_u": 158.3, "c_v": 121.1, "asymmetry": []}
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
        "deposit": pipe(d, deposits=[{"s": 1.1, "length": d, "height": d / 5, "roughness": d / 99, "grain": d / 25}]),
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


def origins(scene: Scene, frame: int, pixels: np.ndarray) -> np.ndarray:
    """Where on the optical axis each pixel's ray begins, (N, 3): interpolated in the lens's table, to 1e-7 m."""
    theta = np.linspace(0, scene.spec["lens"]["theta_max"], 2001)
    radius, pupil = np.array([scene._scene.lens(t) for t in theta]).T
    off = np.linalg.norm(pixels - [LENS["c_u"], LENS["c_v"]], axis=1)
    return scene.centre(frame) + np.interp(off, radius, pupil)[:, None] * scene.pose(frame)[2, :3]


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
    for joint in [
        j for j in spec["joints"][:1] if j["gap"] > 0
    ]:  # a turned pipe's face is tilted: the groove before it reaches beyond s + gap
        angle = math.hypot(joint["yaw"], joint["pitch"])
        across = np.array([joint["yaw"], joint["pitch"]]) * (math.sin(angle) / angle if angle else 0)
        face = points - [joint["step_right"], joint["step_down"], joint["s"] + joint["gap"]]
        groove = (points[:, 2] > joint["s"]) & (face @ [*across, math.cos(angle)] < 0)
        inside |= groove & (np.hypot(points[:, 0], points[:, 1]) < spec["diameter"] / 2 + joint["depth"])
    for kind in ("laterals", "holes"):
        for item in spec[kind]:
            s, clock = item["s"], item["clock"]
            origin = (scene.wall(s, 0.7) * scene.wall_radius(s, 0.7 + math.pi)
                      + scene.wall(s, 0.7 + math.pi) * scene.wall_radius(s, 0.7))  # fmt: skip
            origin /= scene.wall_radius(s, 0.7) + scene.wall_radius(s, 0.7 + math.pi)
            out = scene.wall(s, clock) - origin
            length = np.linalg.norm(out) + item["depth"] if kind == "holes" else item["length"]
            out /= np.linalg.norm(out)
            ahead = np.array([0, 0, 1])  # laterals stand in straight pipes here; holes need none
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
        many = pixels_in_circle(6000, frame)  # more of them where there is something to miss
        special = many[scene.sights(frame, many).material > 0]
        pixels = np.vstack([pixels_in_circle(60, 100 + frame), special[:60]])
        seen = scene.sights(frame, pixels)
        start = origins(scene, frame, pixels)
        way = seen.point - start
        length = np.linalg.norm(way, axis=1)
        near = length < 1.5
        share = np.concatenate([np.linspace(0, 1, 1200)[:-1], 1 - np.geomspace(1e-6, 1e-3, 20)])
        for i in np.flatnonzero(near):
            free = free_space(scene, start[i] + share[:, None] * way[i])
            before = share * length[i] < length[i] - 1e-5
            assert free[before].all(), (frame, pixels[i], MATERIALS[seen.material[i]])
        beyond = seen.point[near] - 1e-6 * seen.normal[near]
        assert free_space(scene, beyond).mean() < 0.01, feature


@pytest.mark.parametrize("feature", FEATURES)
def test_project_returns_to_the_pixel_and_what_it_sees_is_visible(feature: str) -> None:
    scene = Scene(scenes(0.3)[feature])
    pixels = pixels_in_circle(2000, 5)
    points, ok = scene.cast(3, pixels)
    back, seen = scene.visible(3, points)
    assert ok.all()
    assert seen.all()
    assert np.abs(back - pixels).max() < 1e-9


def test_a_point_behind_a_mound_or_in_a_branch_is_hidden() -> None:
    scene = Scene(pipe(deposits=[{"s": 1.1, "length": 0.3, "height": 0.1}], laterals=[{"s": 1.0, "diameter": 0.1}]))
    behind = scene.wall(1.3, math.pi)[None]
    corner = np.array([[0.25, 0.045, 1.045]])  # of the branch to the right, from a camera that stands before it
    for points in (behind, corner):
        assert scene.project(0, points)[1].all()
        assert not scene.visible(0, points)[1].any()
    assert scene.visible(0, scene.wall(1.3, 0)[None])[1].all()


def test_flow_is_cast_then_project_where_nothing_hides_it() -> None:
    scene = Scene(scenes(0.3)["deposit"])
    pixels = pixels_in_circle(1500, 6)
    there, ok = scene.flow(2, 6, pixels)
    points, _ = scene.cast(2, pixels)
    direct, inside = scene.project(6, points)
    assert 0.7 < ok.mean() < 1
    assert (inside | ~ok).all()
    assert np.array_equal(there[ok], direct[ok])
    again, _ = scene.cast(6, there[ok])
    assert np.linalg.norm(again - points[ok], axis=1).max() < 1e-9
    hidden = inside & ~ok  # something is in front there
    first, _ = scene.cast(6, direct[hidden])
    eye = scene.centre(6)
    assert (np.linalg.norm(first - eye, axis=1) < np.linalg.norm(points[hidden] - eye, axis=1)).all()


def cubic(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The image at (x, y), by cubic convolution."""
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    value = np.zeros_like(x)

    def weight(f: np.ndarray) -> np.ndarray:
        near, far = 1.5 * f**3 - 2.5 * f**2 + 1, -0.5 * f**3 + 2.5 * f**2 - 4 * f + 2
        return np.where(f < 1, near, np.where(f < 2, far, 0))

    for b in range(-1, 3):
        for a in range(-1, 3):
            value += weight(np.abs(x - i - a)) * weight(np.abs(y - j - b)) * image[j + b, i + a]
    return value


@pytest.mark.parametrize("feature", ["joint", "egg", "deposit", "grid", "bends", "wet"])
def test_flow_is_that_of_the_drawn_pictures(feature: str) -> None:
    # Patches of the later picture, fetched along the flow, against the earlier: what shift is left? Per patch least
    # squares with gain and offset free; over all patches the median along and across the radius from the centre.
    lens = {"width": 640, "height": 480, "circle_radius": 236, "c_u": 318.3, "c_v": 241.1}
    quiet = {"sensor": {"read_noise": 0, "shot_noise": 0, "blur_px": 0.7}, "lens": lens}
    if feature == "wet":  # light that moves with the camera alone, and a wall that shines
        wet = {"material": "brick", "wetness": 0.6, "joint_spacing": 0}
        scene = Scene(pipe(texture=wet, lamp={"bounce": 0, "layout": "sides", "exposure": 2000}) | quiet)
    else:
        scene = Scene(scenes(0.3)[feature] | quiet)
    a, b = 4, 5
    first, second = (scene.render(f).astype(float) for f in (a, b))
    rng, half = np.random.default_rng(11), 7
    grid = np.mgrid[-half : half + 1, -half : half + 1][::-1].reshape(2, -1).T
    left = []
    for _ in range(400):
        radius, angle = 215 * math.sqrt(rng.uniform(0.15, 1)), rng.uniform(0, TURN)
        outward = np.array([math.cos(angle), math.sin(angle)])
        pixels = np.round([318.3, 241.1] + radius * outward) + grid
        there, ok = scene.flow(a, b, pixels)
        inside = ((there > 2) & (there < [637, 477])).all()
        seen = scene.sights(a, pixels[::20])
        if not ok.all() or not inside or len(set(zip(seen.material, seen.part, strict=True))) > 1:
            continue
        u, v = pixels.astype(int).T
        values = first[v, u]
        if values.mean() < 40 or values.max() > 250:
            continue
        gradient = np.column_stack([first[v, u + 1] - first[v, u - 1], first[v + 1, u] - first[v - 1, u]]) / 2
        fit = np.column_stack([gradient, values, np.ones_like(values)])
        shift = np.linalg.lstsq(fit, cubic(second, *there.T), rcond=None)[0][:2]
        left.append([shift @ outward, shift @ [-outward[1], outward[0]]])
    left = np.array(left)
    assert len(left) > 60
    assert np.abs(np.median(left, axis=0)).max() < 0.01, np.median(left, axis=0)
    assert np.median(np.abs(left)) < 0.1


def test_the_egg_has_the_proportions_two_to_three() -> None:
    scene = Scene(pipe(eggs=[{}]))
    outline = scene.outline(1.0, 3600)
    width, height = np.ptp(outline, axis=0)
    assert width == pytest.approx(0.3, abs=1e-6)
    assert height == pytest.approx(0.45, abs=1e-9)
    x, y = outline.T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert area == pytest.approx(1.14859 * 0.3**2, rel=1e-4)  # of the 2 : 3 egg, times the width squared


def test_a_drop_goes_down_and_back() -> None:
    scene = Scene(scenes(0.3)["bends"])
    start, end = (0.5 * (scene.wall(s, 0) + scene.wall(s, math.pi)) for s in (0.2, scene.length - 0.2))
    drop = 2 * 0.6 * (1 - math.cos(1.5))
    assert end[1] - start[1] == pytest.approx(drop, abs=1e-9)
    assert scene.wall(scene.length, 0)[1] - scene.wall(scene.length - 1, 0)[1] == pytest.approx(0, abs=1e-12)


def test_a_joint_displaces_and_turns_what_follows() -> None:
    joint = {"s": 1.0, "gap": 0.02, "depth": 0.03, "step_right": 0.004, "step_down": -0.003, "yaw": 0.03}
    scene = Scene(pipe(joints=[joint]))
    axis = [0.5 * (scene.wall(s, 0.4) + scene.wall(s, 0.4 + math.pi)) for s in (0.99, 1.02, 2.02)]
    assert np.abs(axis[0] - [0, 0, 0.99]).max() < 1e-12
    assert np.abs(axis[1] - [0.004, -0.003, 1.02]).max() < 1e-12
    assert np.abs(axis[2] - axis[1] - [math.sin(0.03), 0, math.cos(0.03)]).max() < 1e-12
    assert scene.wall_radius(1.01, 2.0) == pytest.approx(0.18, abs=1e-12)
    assert scene.wall_radius(1.03, 2.0) == pytest.approx(0.15, abs=1e-12)


def test_the_camera_rolls_smoothly_over_a_joint() -> None:
    joint = {"s": 1.0, "gap": 0, "step_right": 0.01, "step_down": 0.01, "yaw": 0.02}
    motion = pipe()["motion"] | {"frames": 200, "speed": 0.05, "wobble_m": 0, "wobble_rad": 0, "ramp": 0}
    scene = Scene(pipe(joints=[joint]) | {"motion": motion})
    path = np.array([scene.centre(f) for f in range(200)])
    # A quintic of 0.3 m that climbs 0.014 m: second derivative up to 0.9 a metre, times (0.0025 m)^2 a frame.
    assert np.abs(np.diff(path, 2, axis=0)).max() < 1e-5
    straight = np.linalg.norm(path[-1] - path[0])
    assert scene.driven(199) == pytest.approx(straight, rel=2e-3)


def test_wheels_dip_into_a_gap_as_deep_as_they_are_round() -> None:
    # Half a gap of 10 mm under a wheel of 30 mm radius: 0.03 - sqrt(0.03^2 - 0.01^2). The camera sits in front of the
    # axles, so it tips further down by 0.08 / 0.2 of that.
    motion = pipe()["motion"] | {"frames": 1, "start": 1.01 + 0.08, "wobble_m": 0, "wobble_rad": 0}
    gap, even = (Scene(pipe(joints=[{"s": 1.0, "gap": g, "depth": 0.01}]) | {"motion": motion}) for g in (0.02, 0))
    assert (gap.centre(0) - even.centre(0))[1] == pytest.approx((0.03 - math.sqrt(8e-4)) * 1.4, abs=1e-9)
    assert gap.attitude(0)[1] < even.attitude(0)[1]
    assert gap.spec["motion"]["bumps"] == []  # truth reads it back: it must not dip twice


def test_a_deposit_has_the_stated_height_and_extent() -> None:
    scene = Scene(pipe(deposits=[{"s": 1.1, "clock": 3.0, "length": 0.4, "extent": 1.2, "height": 0.05}]))
    assert scene.wall_radius(1.1, 3.0) == pytest.approx(0.1, abs=1e-12)
    for s, phi in [(0.9, 3.0), (1.3, 3.0), (1.1, 2.4), (1.1, 3.6)]:
        assert scene.wall_radius(s, phi) == pytest.approx(0.15, abs=1e-9)
    assert 0.149 < scene.wall_radius(1.1, 2.46) < 0.15


def test_a_crack_has_the_stated_width_and_depth() -> None:
    path = [{"s": 0.8, "phi": 1.0}, {"s": 1.2, "phi": 1.0}]
    scene = Scene(pipe(cracks=[{"path": path, "width": 0.003, "depth": 0.02}]))
    arc = np.arange(-0.004, 0.004, 1e-5)
    depth = np.array([scene.wall_radius(1.0, 1.0 + a / 0.15) for a in arc]) - 0.15
    assert (depth > 0.01).sum() * 1e-5 == pytest.approx(0.003, abs=2e-5)
    assert depth.max() == pytest.approx(0.02, abs=1e-12)


def test_a_hole_is_a_cylinder_with_a_floor() -> None:
    motion = pipe()["motion"] | {"start": 0.95}
    scene = Scene(pipe(holes=[{"s": 1.0, "clock": 2.0, "diameter": 0.06, "depth": 0.04}]) | {"motion": motion})
    seen = scene.sights(0, pixels_in_circle(30000, 7))
    points = seen.point[seen.material == HOLE] - [0, 0, 1.0]
    out = np.array([math.sin(2.0), -math.cos(2.0), 0])
    along = points @ out
    across = np.linalg.norm(points - along[:, None] * out, axis=1)
    floor = np.abs(along - 0.19) < 1e-9
    assert len(points) > 50
    assert (floor | (np.abs(across - 0.03) < 1e-9)).all()
    assert floor.any()
    assert not floor.all()


def test_roots_are_rounded_cones_that_hang_from_their_place() -> None:
    roots = [{"s": 1.0, "clock": 0.2, "length": 0.12, "diameter": 0.008, "strands": 6}]
    scene, without = Scene(pipe(roots=roots)), Scene(pipe())
    pixels = pixels_in_circle(20000, 8)
    seen, wall = scene.sights(0, pixels), without.sights(0, pixels)
    root = seen.material == ROOT
    assert root.sum() > 50
    eye = scene.centre(0)
    assert (np.linalg.norm(seen.point - eye, axis=1)[root] < np.linalg.norm(wall.point - eye, axis=1)[root]).all()
    assert np.array_equal(seen.point[~root], wall.point[~root])
    base = scene.wall(1.0, 0.2)
    assert np.linalg.norm(seen.point[root] - base, axis=1).max() < 0.14
    # Against the light: normals look at the camera.
    assert (np.sum(seen.normal[root] * (eye - seen.point[root]), axis=1) > 0).mean() > 0.99


def test_water_lies_flat_hides_the_invert_and_mirrors_by_fresnel() -> None:
    water = {"depth": 0.04, "refraction": 1.333}
    scene, dry = Scene(pipe(water=[water])), Scene(pipe())
    pixels = pixels_in_circle(4000, 9)
    seen, bare = scene.sights(0, pixels), dry.sights(0, pixels)
    wet = seen.material == WATER
    assert 0.1 < wet.mean() < 0.5
    assert np.abs(seen.point[wet, 1] - 0.11).max() < 1e-12
    assert (bare.point[wet, 1] > 0.11 - 1e-12).all()
    assert np.array_equal(seen.point[~wet], bare.point[~wet])
    assert (bare.point[~wet, 1] < 0.11).all()
    # The image of the mirrored point lies as deep under the water, on the ray's own line.
    origin = origins(scene, 0, pixels)[wet]
    image = seen.mirrored_point[wet] * [1, -1, 1] + [0, 0.22, 0]
    ray, to_image = seen.point[wet] - origin, image - origin
    off = np.linalg.norm(np.cross(ray, to_image), axis=1) / np.linalg.norm(ray, axis=1)
    assert off.max() < 1e-5  # as far as the interpolated origins
    cos = np.abs(ray[:, 1]) / np.linalg.norm(ray, axis=1)
    inside = np.sqrt(1 - (1 - cos**2) / 1.333**2)
    share = (
        ((cos - 1.333 * inside) / (cos + 1.333 * inside)) ** 2 + ((1.333 * cos - inside) / (1.333 * cos + inside)) ** 2
    ) / 2
    assert np.abs(seen.mirrored[wet] - share).max() < 1e-5
    assert not scene.flow(0, 1, pixels[wet])[1].any()


def test_sloped_water_follows_the_pipe_and_ends_where_it_is_said() -> None:
    bend = [{"length": 0.3}, {"angle": 0.1, "radius": 1.0, "clock": math.pi}, {"length": 3.0}]
    water = [{"s": 1.0, "start": 0.5, "end": 1.2, "depth": 0.03, "sloped": 1}]
    scene = Scene(pipe(pieces=bend, water=water))
    seen = scene.sights(0, pixels_in_circle(4000, 10))
    wet = seen.material == WATER
    places = scene.locate(seen.point[wet])
    down = -places[:, 1] * np.cos(places[:, 2])
    assert wet.sum() > 300
    assert np.abs(down - 0.12).max() < 1e-9
    assert places[:, 0].max() < 1.2
    assert places[:, 0].max() > 1.1


def test_a_thin_crack_darkens_by_its_area() -> None:
    # A longitudinal crack a sixth of a pixel wide and too deep to see light in: over a strip across it, the sum of
    # what is missing, in wall per pixel, is its projected width.
    lens = {"lens": LENS | {"vignetting": 0, "pupil_scale": 0}}
    quiet = {"sensor": {"read_noise": 0, "shot_noise": 0, "blur_px": 0}, "texture": {"contrast": 0, "joint_spacing": 0}}
    quiet["lamp"] = {"ring_radius": 0.03, "exposure": 1500}
    path = [{"s": 0.5, "phi": 1.6}, {"s": 2.0, "phi": 1.6}]
    crack = {"cracks": [{"path": path, "width": 0.0004, "depth": 0.03}]}
    still = {"motion": {"frames": 1, "start": 0.76, "wobble_m": 0, "wobble_rad": 0, "below_axis": 0}}
    with_crack = Scene(pipe(**lens, **quiet, **crack) | still).render(0).astype(float)
    plain = Scene(pipe(**lens, **quiet) | still)
    without = plain.render(0).astype(float)
    edges = np.array(
        [plain.wall(s, 1.6 + side * 0.0002 / 0.15) for s in np.arange(0.78, 0.9, 0.002) for side in (-1, 1)]
    )
    pixels, ok = plain.project(0, edges)
    assert ok.all()
    column = np.round(pixels[::2, 0]).astype(int)
    width = np.abs(pixels[1::2, 1] - pixels[::2, 1])
    lost = []
    for c, row in zip(column, np.round(pixels[::2, 1]).astype(int), strict=True):
        strip = slice(row - 3, row + 4)
        lost.append((1 - with_crack[strip, c] / without[strip, c]).sum())
    assert 0.1 < width.mean() < 0.4
    assert np.mean(lost) == pytest.approx(width.mean(), rel=0.15)


def test_a_wall_from_a_file_passes_through_its_values(tmp_path: Path) -> None:
    grid = grid_wall(0.3)
    radius = np.array(grid["radius"]).reshape(61, 48)
    table = np.zeros((62, 49))
    table[1:, 0], table[0, 1:], table[1:, 1:] = 0.5 + 0.025 * np.arange(61), np.arange(48) * TURN / 48, radius
    np.save(tmp_path / "wall.npy", table)
    np.savetxt(tmp_path / "wall.csv", table, delimiter=",", fmt="%.17g")
    for name in ("wall.npy", "wall.csv"):
        (tmp_path / "scene.json").write_text(json.dumps(pipe(grid={"file": name})))
        scene = Scene.load(tmp_path / "scene.json")
        for row, column in [(0, 0), (7, 13), (30, 47), (60, 20)]:
            there = scene.wall_radius(0.5 + 0.025 * row, column * TURN / 48)
            assert there == pytest.approx(radius[row, column], abs=1e-12)
        # Between the rows: cubic convolution is exact to the third order; the waves' error is below 2e-5 m.
        s, phi = 1.2345, 2.1
        truth = 0.15 * (1 + 0.05 * math.cos(3 * phi) * math.sin(9 * s) + 0.03 * math.sin(phi + 5 * s))
        assert scene.wall_radius(s, phi) == pytest.approx(truth, abs=2e-5)
        assert scene.wall_radius(5.0, 1.0) == scene.wall_radius(2.0, 1.0)


def test_a_bad_wall_file_is_refused_with_file_and_place(tmp_path: Path) -> None:
    file = tmp_path / "wall.csv"
    for text, where in [
        ("0,0,1.5708,3.1416,4.7124\n0,1,1,1,1\n1,1,1,x,1\n", r"wall.csv: row 3, column 4: must be a number"),
        ("0,0,1.5708,3.1416,4.7124\n0,1,1,1,1\n1,1,1,1,1\n3,1,1,1,1\n", "wall.csv: column 1: arc lengths"),
        ("0,0,1,2,3\n0,1,1,1,1\n1,1,1,1,1\n", "wall.csv: row 1: clock angles"),
        ("0,0\n0,1\n", "wall.csv: needs a row"),
    ]:
        file.write_text(text)
        with pytest.raises(FormatError, match=where):
            Scene(pipe(grid={"file": "wall.csv"}), tmp_path / "scene.json")


def test_truth_lists_what_is_in_the_pipe(tmp_path: Path) -> None:
    scene = pipe(
        joints=[{"s": 1.2, "gap": 0.01}],
        joint_series={"start": 0.5, "spacing": 1.0, "step_sigma": 0.003},
        cracks=[{"path": [{"s": 0.9, "phi": 7.0}, {"s": 1.0, "phi": 7.5}], "width": 0.001}],
        laterals=[{"s": 2.0, "clock": 1.0, "diameter": 0.1}],
        deposits=[{"s": 0.7, "height": 0.02}],
    )
    simulate(scene, tmp_path / "t", frames=1, quiet=True)
    events = json.loads((tmp_path / "t.truth.json").read_text())["events"]
    found = [(e["kind"], e["index"], round(e["s"], 9)) for e in events]
    assert found == [
        ("joint", 0, 0.5),
        ("deposit", 0, 0.7),
        ("crack", 0, 0.9),
        ("joint", 1, 1.2),
        ("joint", 2, 1.5),
        ("lateral", 0, 2.0),
        ("joint", 3, 2.5),
        ("joint", 4, 3.5),
    ]
    assert events[2]["clock"] == pytest.approx(7.0 - TURN)
    assert events[3]["gap"] == 0.01
    assert 0 < abs(events[0]["step_right"]) <= 0.006
    again = Scene.from_truth(tmp_path / "t.truth.json")
    assert again.events() == events


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"joints": [{"s": 9.0}]}, "joints at 9.000000 m: must lie within"),
        ({"joints": [{"s": 1.0}, {"s": 1.01}]}, "joints at 1.000000 m: the next joint is too close"),
        ({"joints": [{"s": 1.0, "gap": 0.001, "yaw": 0.1}]}, "joints at 1.000000 m: the gap must be wide enough"),
        ({"joints": [{"s": 1.0, "step_down": 0.1}]}, "joints at 1.000000 m: a step must be"),
        ({"joints": [{"s": 1.0, "gab": 0.1}]}, r"joints\[0\].gab: unknown"),
        ({"joint_series": {"spacing": 0.01}}, "joint_series.spacing: must be"),
        ({"deposits": [{"s": 1.0, "height": 0.13}]}, "wall: deposits"),
        ({"eggs": [{"start": 1.0, "end": 1.1}]}, r"eggs\[0\].end: must be"),
        ({"corrugations": [{"start": 1.0, "end": 1.05}]}, r"corrugations\[0\].end: must be"),
        ({"laterals": [{"s": 1.0, "diameter": 0.3}]}, r"laterals\[0\].diameter: must be"),
        ({"holes": [{"s": 1.0, "diameter": 0.2}]}, r"holes\[0\].diameter: must be"),
        ({"cracks": [{"path": [{"s": 1.0}]}]}, r"cracks\[0\].path: needs at least two"),
        ({"grid": {"around": 4, "radius": [0.1] * 5}}, "grid.radius: needs two rows"),
        ({"grid": {"around": 4, "radius": [0.1, "x"]}}, r"grid.radius\[1\]: must be a number"),
        ({"grid": {"around": 4, "radius": [0.1] * 7 + [-1.0]}}, r"grid.radius\[7\]: must be within"),
        ({"grid": {"file": 3}}, "grid.file: must be a path"),
    ],
)
def test_a_bad_feature_is_refused_with_the_key(change: dict, where: str) -> None:
    with pytest.raises(FormatError, match=where):
        Scene(pipe(**change))
