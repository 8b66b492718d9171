"""Pictures of calibration targets by the simulator's camera, with the truth about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipefish.errors import ArgumentError
from pipefish.progress import track
from pipefish.studio import (
    Picture,
    Studio,
    Texture,
    chain,
    facing,
    inverse,
    listed,
    pattern,
    pose,
    random,
    raster,
    room,
    room_textures,
    rotation,
)
from pipefish.target import Target

# From a sleeve's sheet (its middle at clock angle 0, its face inwards) to the pipe's frame.
_TURN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass
class TargetView:
    """One picture of a target and the truth about it."""

    image: np.ndarray  # (H, W) uint8, or uint16 of 10 bits
    pose: np.ndarray  # cam_from_target (3, 4)
    points: np.ndarray  # (N, 3) corners or centres in the camera's frame, on the target as it is bent
    pixels: np.ndarray  # (N, 2) their images; NaN outside the lens's field
    visible: np.ndarray  # (N,) on the sensor, in the field, and nothing in front of it
    centroids: np.ndarray | None  # (N, 2) area-weighted centroids of the imaged discs; None for corners
    picture: Picture


def warp(target: Target, seed: int, metres: float, degree: int = 4) -> dict[str, Any]:
    """How a board is bent: keys for `board`. A polynomial height up to that degree, the quadratic terms largest, of
    about `metres` at the edges; the print 3e-4 too wide and sheared by as much, give or take."""
    rng = random(seed, 1)
    powers = []
    for total in range(2, degree + 1):
        for i in range(total + 1):
            size = metres * 0.5 * 0.4 ** (total - 2)
            powers.append({"i": i, "j": total - i, "metres": float(size * rng.uniform(-1, 1))})
    aspect, shear = 3e-4 * target.size_m[0] / 2 * rng.normal(size=2)
    return {
        "relief": {"powers": powers},
        "stretch_a": {"powers": [{"i": 1, "j": 0, "metres": float(aspect)}]},
        "stretch_b": {"powers": [{"i": 1, "j": 0, "metres": float(shear)}]},
    }


def target_poses(
    target: Target,
    studio: Studio,
    count: int,
    seed: int = 1,
    span: tuple[float, float] = (0.3, 0.9),
    tilt: float = 0.6,
    reach: float = 0.75,
) -> list[np.ndarray]:
    """Poses cam_from_target (3, 4) that cover the lens's field: the target's middle anywhere up to `reach` times the
    field's edge, so far away that the target's longer side would span that share of the picture's shorter one on the
    axis, turned towards the camera but for up to `tilt` radians, rolled anyhow. A sleeve: the camera somewhere near its
    axis, looking along it."""
    rng = random(seed, 2)
    poses = []
    lens, table = studio.spec["lens"], studio.lens_table()
    for _ in range(count):
        share, azimuth = np.sqrt(rng.uniform(0, 1)), rng.uniform(0, 2 * np.pi)
        turn = tilt * np.sqrt(rng.uniform(0, 1)) * np.array([np.cos(a := rng.uniform(0, 2 * np.pi)), np.sin(a), 0])
        focal = table["radius_px"][1] / table["theta"][1]
        side = rng.uniform(*span) * min(studio.width, studio.height)
        distance, roll = focal * max(target.size_m) / side, rng.uniform(-np.pi, np.pi)
        if target.kind == "sleeve":
            radius = target.diameter_m / 2
            back = rng.uniform(-0.4, 0.9) * radius + (target.size_m[1] / 2 if studio.theta_max < 1.3 else 0)
            off = 0.35 * radius * share * np.array([np.cos(azimuth), np.sin(azimuth)])
            poses.append(
                chain(pose(rotation(0.4 * turn) @ rotation((0, 0, roll)), (0, 0, 0)), pose(np.eye(3), (*off, back)))
            )
            continue
        edge = min(lens["theta_max"], _corner_angle(studio))
        theta = max(reach * share * edge, lens["theta_min"] + 0.15 if lens["theta_min"] > 0 else 0)
        ray = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
        poses.append(pose(facing(ray, roll) @ rotation(turn), distance * ray))
    return poses


def _corner_angle(studio: Studio) -> float:
    """Field angle at the middle of the sensor's shorter side, or at the lens's edge if that comes first."""
    table = studio.lens_table()
    return float(np.interp(min(studio.width, studio.height) / 2, table["radius_px"], table["theta"]))


def target_sheet(target: Target, cam_from_target: np.ndarray, board: dict[str, Any] | None = None) -> dict[str, Any]:
    """The sheet of a picture with the target's print as texture 0. board: more keys of it, such as warp() gives."""
    width, height = target.size_m
    sheet = {"width": width, "height": height, "pose": listed(cam_from_target), **(board or {})}
    if target.kind == "sleeve":
        radius = target.diameter_m / 2
        sheet["curvature"] = -1 / radius
        sheet["width"] = width * (1 - 1e-13)  # not wider than the circumference, whatever rounding does
        sheet["pose"] = listed(chain(cam_from_target, pose(_TURN, (0, -radius, 0))))
    return sheet


def target_texture(target: Target) -> Texture:
    """The target's print."""
    return Texture.print(np.ascontiguousarray(target.figures(), dtype=float), target.white)


def disc_centroids(studio: Studio, picture: Picture, sheet: int, centres: np.ndarray, radius: float) -> np.ndarray:
    """Area-weighted centroids (N, 2) of the images of discs on a sheet, centres (N, 2) in texture coordinates; NaN
    where a disc is not wholly in the lens's field.

    Green's theorem on the image of the rim: 128 points and their derivatives by Fourier series, exact to rounding."""
    count = 128
    angle = 2 * np.pi * np.arange(count) / count
    rim = centres[:, None] + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    px, _ = studio.project(picture.place(sheet, rim.reshape(-1, 2)))
    px = px.reshape(len(centres), count, 2)
    middle = px.mean(1, keepdims=True)
    q = px - middle
    spectrum = np.fft.fft(q, axis=1) * (1j * np.fft.fftfreq(count, 1 / count))[:, None]
    d = np.fft.ifft(spectrum, axis=1).real
    u, v, du, dv = q[..., 0], q[..., 1], d[..., 0], d[..., 1]
    area = (u * dv - v * du).sum(1) / 2
    return middle[:, 0] + np.stack([(u * u * dv).sum(1), -(v * v * du).sum(1)], -1) / (2 * area[:, None])


def simulate_target_views(
    target: Target,
    lens: dict[str, Any] | None = None,
    poses: list[np.ndarray] | int = 12,
    *,
    sensor: dict[str, Any] | None = None,
    board: dict[str, Any] | None = None,
    light: dict[str, Any] | None = None,
    level: float | None = 190.0,
    clutter: bool = True,
    seed: int = 1,
    threads: int | None = None,
    samples: int = 89,
    quiet: bool = True,
    source: str | None = None,
) -> tuple[list[TargetView], dict[str, Any]]:
    """Pictures of a target, and the truth as a dict that JSON can hold (docs/simulator.md).

    lens, sensor: keys as in docs/simulator.md. poses: cam_from_target (3, 4) each, or how many target_poses() to take.
    board: how it is bent and lit: keys of a sheet, as warp() gives. light: keys of a picture (`ambient`, `lamps` in the
    camera's frame, `gamma`, ...) [ambient 100 and a lamp above the camera]. level: grey level of a white sheet at the
    target's middle, by exposure; None: as the light is. clutter: a room around it, for a sleeve a pipe. seed: of poses,
    clutter and noise. Raises FormatError, ArgumentError.
    """
    studio = Studio(lens, {"seed": seed, **(sensor or {})}, source)
    if isinstance(poses, int):
        poses = target_poses(target, studio, poses, seed)
    for p in poses:
        if np.shape(p) != (3, 4):
            raise ArgumentError(f"poses: must be (3, 4) each, not {np.shape(p)}")
    textures = [target_texture(target)]
    if clutter:
        textures += [raster(pattern(seed, 2048, 2048))] if target.kind == "sleeve" else room_textures(seed)
    views = []
    for k, p in enumerate(track(poses, "drawing", len(poses), quiet)):
        sheets = [target_sheet(target, p, board)]
        if clutter:
            sheets += _surroundings(target, p, poses[0], seed)
        spec: dict[str, Any] = {"frame": k, "sheets": sheets, "ambient": 100.0}
        distance = float(np.linalg.norm(p[:, 3]))
        spec["lamps"] = [{"x": 0.05, "y": -0.1, "z": -0.02, "power": 100.0 * max(distance, 0.1) ** 2}]
        spec.update(light or {})
        if level is not None:
            spec["gain"] = _exposure(Picture(spec, textures, source), studio, target, level)
        views.append(_view(studio, target, Picture(spec, textures, source), p, samples, threads))
    return views, _truth(studio, target, board, views)


def _surroundings(target: Target, p: np.ndarray, first: np.ndarray, seed: int) -> list[dict[str, Any]]:
    if target.kind == "sleeve":
        radius = target.diameter_m / 2 + 0.001  # the sleeve is laid into it
        pipe = {
            "width": 2 * np.pi * radius * (1 - 1e-13),
            "height": 20 * radius,
            "curvature": -1 / radius,
            "texture": 1,
        }
        return [{**pipe, "pose": listed(chain(p, pose(_TURN, (0, -radius, 0))))}]
    # The board is carried around in a room that stands still, its walls well behind any board.
    half = 4 * max(*target.size_m) + float(np.linalg.norm(first[:, 3]))
    return room(half, 1, pose(rotation(random(seed, 3).uniform(-0.4, 0.4, 3)), (0, 0, 0)))


def _exposure(picture: Picture, studio: Studio, target: Target, level: float) -> float:
    """The gain that gives a white sheet at the target's middle that grey level, without vignetting."""
    spec = picture.spec
    at = np.array([[0.0, 0.0]])
    if target.kind == "sleeve":  # mean of all around
        half = spec["sheets"][0]["width"] / 2
        at = np.column_stack([np.linspace(-half, half, 9)[:-1], np.zeros(8)])
    points = picture.place(0, at)
    ahead = picture.place(0, at + np.array([0, 1e-5])) - points
    side = picture.place(0, at + np.array([1e-5, 0])) - points
    normal = np.cross(side, ahead)
    normal /= -np.linalg.norm(normal, axis=1, keepdims=True)  # the face looks along -z
    light = np.full(len(at), spec["ambient"])
    for lamp in spec["lamps"]:
        to = np.array([lamp["x"], lamp["y"], lamp["z"]]) - points
        distance = np.linalg.norm(to, axis=1)
        light += lamp["power"] * np.maximum((to * normal).sum(1), 0) / distance**3
    return float(level / max(light.mean(), 1e-6))


def _view(
    studio: Studio, target: Target, picture: Picture, p: np.ndarray, samples: int, threads: int | None
) -> TargetView:
    flat = target.flat_points()
    points = picture.place(0, flat)
    pixels, ok = studio.project(points)
    seen = studio.look(picture, np.where(ok[:, None], pixels, -1e6))
    with np.errstate(invalid="ignore"):
        visible = ok & (seen.sheet == 0) & ~seen.back & (np.abs(seen.at - flat).max(1) < 1e-6)
    centroids = disc_centroids(studio, picture, 0, flat, target.radius_m) if target.has_circles else None
    return TargetView(studio.render(picture, samples, threads), p, points, pixels, visible, centroids, picture)


def _rounded(values: np.ndarray) -> list[Any]:
    """As lists, to 1e-9, None for what is not a number."""
    return [[None if np.isnan(x) else round(float(x), 9) for x in row] for row in values]


def _truth(studio: Studio, target: Target, board: dict[str, Any] | None, views: list[TargetView]) -> dict[str, Any]:
    made = []
    for view in views:
        entry = {
            "cam_from_target": _rounded(view.pose),
            "camera_in_target": [round(float(x), 9) for x in inverse(view.pose)[:, 3]],
            "points_px": _rounded(view.pixels),
            "visible": view.visible.tolist(),
        }
        if view.centroids is not None:
            entry["centroids_px"] = _rounded(view.centroids)
        made.append(entry)
    return {
        "target": target.to_dict(),
        "points_m": _rounded(target.points()),
        "board": board or {},
        "camera": studio.spec,
        "lens": studio.lens_table(),
        "views": made,
    }
