"""A fisheye's pictures matched as the faces of a cube: what two faces say about their common rim is the same."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

import pipefish as pf
from pipefish.views import cube_faces, perspective_rays, remap

Floats = NDArray[np.float64]
CAMERA = pf.Camera(width=360, height=300, f_u=110.0, f_v=110.0, c_u=179.5, c_v=149.5, theta_max=1.9)
EDGE, FOV = 240, 110.0  # of a face: ten degrees beyond its neighbour's middle rim on either side
FOCAL = EDGE / 2 / math.tan(math.radians(FOV) / 2)
TURN = math.radians(2.0)  # about the axis, and a drive forwards: what one face sees stays on it
POSE = np.array(
    [
        [math.cos(TURN), -math.sin(TURN), 0, 0.02],
        [math.sin(TURN), math.cos(TURN), 0, 0.01],
        [0, 0, 1, -0.06],
    ]
)


def brightness(points: Floats) -> NDArray[np.uint8]:
    """A texture in space, waves of 5 to 40 pixels where the unit sphere shows it."""
    rng = np.random.default_rng(4)
    length = 5 * 8 ** rng.random(60) / CAMERA.f_u
    k = rng.normal(size=(60, 3))
    k *= (2 * np.pi / length / np.linalg.norm(k, axis=1))[:, None]
    flat = points.reshape(-1, 3).astype(np.float32)
    value = np.cos(flat @ k.T.astype(np.float32) + rng.uniform(0, 6.28, 60).astype(np.float32)).sum(axis=1) / np.sqrt(
        30
    )
    return np.rint(255 * (0.5 + 0.14 * value).clip(0, 1)).astype(np.uint8).reshape(points.shape[:-1])


def picture(pose: Floats) -> NDArray[np.uint8]:
    """What the camera sees inside the unit sphere about the first camera; pose: cam_from_first."""
    pixels = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), axis=-1).astype(float)
    rays, ok = CAMERA.unproject(pixels.reshape(-1, 2))
    centre, d = -pose[:, :3].T @ pose[:, 3], np.where(ok[:, None], rays, [0, 0, 1]) @ pose[:, :3]
    along = d @ centre
    points = centre + (np.sqrt(along**2 + 1 - centre @ centre) - along)[:, None] * d
    return (brightness(points) * ok).astype(np.uint8).reshape(pixels.shape[:2])


def seen_twice(pixels: Floats) -> Floats:
    """(K,2): where the second camera sees what the first sees at pixels."""
    return CAMERA.project(CAMERA.unproject(pixels)[0] @ POSE[:, :3].T + POSE[:, 3])[0]


def to_picture(turn: Floats, xy: Floats) -> Floats:
    """(K,2): a face's pixels in the fisheye's picture."""
    rays = np.column_stack([(xy - (EDGE - 1) / 2) / FOCAL, np.ones(len(xy))])
    return CAMERA.project(rays @ turn.T)[0]


def to_face(turn: Floats, pixels: Floats) -> Floats:
    rays = CAMERA.unproject(pixels)[0] @ turn
    return rays[:, :2] / rays[:, 2:] * FOCAL + (EDGE - 1) / 2


def matched_on(turn: Floats, at: Floats, pictures: list[NDArray[np.uint8]]) -> tuple[Floats, Floats]:
    """Matches grown on one face from a seed at the pixel `at` of the picture, carried back: pixels of both pictures."""
    rays = perspective_rays(EDGE, EDGE, FOV)
    faces = [remap(CAMERA, rays, turn).apply(p) for p in pictures]
    seed = (to_face(turn, at[None]), to_face(turn, seen_twice(at[None])))
    m = pf.match_quasi_dense(*faces, seed)
    return to_picture(turn, m.xy1), to_picture(turn, m.xy2)


def test_matches_on_two_faces_of_a_cube_agree_across_their_seam() -> None:
    """Carried back to the pictures, what the front face says along its rim with the right one and what that says differ
    by less than a twentieth of a pixel in every stretch of 20 pixels along it (a fifth is asked)."""
    pictures, turns = [picture(np.eye(3, 4)), picture(POSE)], cube_faces()
    rim = 110 * math.pi / 4  # pixels from the middle
    sides = []
    for name, off in (("front", -12), ("right", 12)):
        at, to = matched_on(turns[name], np.rint(np.array([179.5 + rim + off, 150.0])), pictures)
        rays = CAMERA.unproject(at)[0]
        beside = np.degrees(np.arctan2(rays[:, 0], rays[:, 2])) - 45
        near = np.abs(beside) < 4
        assert (np.abs(beside) < 1).sum() > 100, name
        sides.append((at[near, 1], (to - seen_twice(at))[near]))
    stretches = 0
    for top in range(60, 240, 20):
        error = [e[(row >= top) & (row < top + 20)] for row, e in sides]
        assert min(map(len, error)) > 50
        means = [e.mean(axis=0) for e in error]
        assert np.linalg.norm(means[0] - means[1]) < 0.05, (top, means)
        stretches += 1
        for e in error:
            assert np.median(np.linalg.norm(e, axis=1)) < 0.05
    assert stretches == 9
