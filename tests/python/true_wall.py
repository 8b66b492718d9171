"""A simulated pipe as if it had been measured without any error: true wall, true poses, rendered keyframes."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipefish.simulate import Scene, fitted_camera
from pipefish.wall import Piece, Wall


class TrueWall(Wall):
    """A Wall whose pictures are rendered when they are asked for."""

    scene: Scene
    rendered: dict[int, np.ndarray]

    def picture(self, view: int) -> np.ndarray:
        frame = int(self.keyframe[view])
        if frame not in self.rendered:
            self.rendered[frame] = np.ascontiguousarray(self.scene.render(frame))
        return self.rendered[frame]


class NoSurvey:
    path = "simulated"


def true_wall(scene: Scene, frames: np.ndarray, start: float, end: float, ring: float = 0.03) -> TrueWall:
    """The wall from `start` to `end` (arc length), without reliefs, seen by some of the scene's frames."""
    along = np.linspace(start, end, round((end - start) / ring) + 1)
    clock = np.arange(72) * 2 * np.pi / 72
    rings = np.array([[scene.wall(s, phi) for phi in clock] for s in along])
    piece = Piece(along, rings, np.zeros(rings.shape[:2]), 1, 0)
    document: dict[str, Any] = {"summary": {"unit": "metre", "d_mean": scene.spec["diameter"]}, "clock_zero": "truth"}
    wall = TrueWall(
        document=document,
        pieces=[piece],
        camera=fitted_camera(scene),
        survey=NoSurvey(),
        poses=np.array([scene.pose(int(f)) for f in frames]),
        keyframe=np.asarray(frames),
        stretch=np.zeros(len(frames), int),
        chainage=np.array([scene.arc_length(int(f)) for f in frames]),
        diameter=scene.spec["diameter"],
    )
    wall.scene, wall.rendered = scene, {}
    return wall
