"""Real corner sets for the tests of calibration; they are not part of the project."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from PIL import Image

import pipefish as pf
from pipefish.calibration import View

#: Pictures: folder, pattern, squares of the checkerboard (rows, cols), metres (where unknown: any).
PICTURES = {
    "Fisheye1": ("ocam", "Fisheye1_*.jpg", 9, 7, 0.03),
    "Fisheye2": ("ocam", "Fisheye2_*.jpg", 9, 7, 0.03),
    "catadioptric": ("catadioptric", "*.jpg", 7, 10, 0.03),
    "camodocal": ("camodocal", "*.png", 7, 10, 0.03),
    "jy_stereo left": ("jy_stereo/left", "*.jpg", 7, 9, 0.0244),
    "jy_stereo right": ("jy_stereo/right", "*.jpg", 7, 9, 0.0244),
}


def ov_plane(data: Path, part: str) -> tuple[list[View], tuple[int, int]]:
    """BabelCalib's ov_plane, "train" or "test": .orpc rows are board, point, 1, x, y; .dsc has the points in
    centimetres."""
    rows = [line.strip().split(",") for line in (data / "ov_plane/ov_plane.dsc").read_text().splitlines()]
    points = np.array([[float(x) / 100 for x in row[3:6]] for row in rows if len(row) == 6])
    views = []
    for path in sorted((data / "ov_plane/corners" / part).glob("*.orpc")):
        lines = [line.split(",") for line in path.read_text().splitlines() if line[:1].isdigit()]
        found = np.array([[float(x) for x in line] for line in lines if len(line) == 5])
        views.append(View(points[found[:, 1].astype(int)], found[:, 3:5], name=path.stem))
    return views, (1280, 800)


def jy_stereo(data: Path, camera: int) -> tuple[list[View], tuple[int, int]]:
    """The first 20 pairs of jy_stereo; camera 1 is the left one, 2 the right one."""
    root = ElementTree.parse(data / "jy_stereo/omni_stereocalib_data_fisheye.xml").getroot()
    y, x = np.mgrid[:6, :8].reshape(2, -1)
    board = np.stack([x * 0.0244, y * 0.0244, 0 * x], axis=1)
    views = []
    for i, node in enumerate(root.find(f"imagePoints{camera}")):
        pixels = np.array(node.find("data").text.split(), dtype=float).reshape(-1, 2)
        views.append(View(board, pixels, camera=camera - 1, name=f"{i}"))
    return views, (1280, 800)


def pictures(data: Path, name: str, every: int = 1) -> tuple[list[View], tuple[int, int], int]:
    """Views of one of PICTURES with the project's own detector and its default options, each `every`-th picture, and
    how many pictures that were; jy_stereo's right camera is camera 1, pairs share a name."""
    folder, pattern, rows, cols, spacing = PICTURES[name]
    target = pf.Target("checkerboard", rows, cols, spacing)
    files = sorted((data / folder).glob(pattern))[::every]
    views, size = [], (0, 0)
    for file in files:
        picture = Image.open(file).convert("L")
        found = pf.detect_target(np.array(picture), target)
        if found:
            number = "".join(c for c in file.stem if c.isdigit())
            views.append(
                View(target.points()[found.ids], found.pixels, camera=int(name.endswith("right")), name=number)
            )
        size = picture.size
    return views, size, len(files)
