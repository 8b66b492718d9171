"""Files in other programs' formats, against these programs themselves: what we read is what they project, and what we
write is what they read. They run in the system's Python, where they are installed; the tests are skipped, with a
warning, where they are not.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest

from pipefish import formats

DATA = Path(__file__).with_name("data") / "formats"
PYTHON = "/usr/bin/python3"

READ_CV = """
storage = cv2.FileStorage(file, cv2.FILE_STORAGE_READ)
def matrix(*names):
    return next(m for m in (storage.getNode(n).mat() for n in names) if m is not None)
K, D = matrix("camera_matrix", "K"), matrix("distortion_coefficients", "D")
points, zero = points.reshape(-1, 1, 3), np.zeros((3, 1))
"""
CENTRAL = "points, zero, zero, K"
PROGRAMS = {  # name: (function that must be there, how `points` are projected by `file`)
    "fisheye": (
        "cv2.fisheye.projectPoints",
        READ_CV + f"uv, _ = cv2.fisheye.projectPoints({CENTRAL}, D, alpha=K[0, 1] / K[0, 0])",
    ),
    "omnidir": (
        "cv2.omnidir.projectPoints",
        READ_CV + f"uv, _ = cv2.omnidir.projectPoints({CENTRAL}, float(matrix('xi')[0, 0]), D.reshape(1, 4))",
    ),
    "pinhole": ("cv2.projectPoints", READ_CV + f"uv, _ = cv2.projectPoints({CENTRAL}, D)"),
    "mrcal": ("mrcal.project", "uv = mrcal.project(points, *mrcal.cameramodel(file).intrinsics())"),
    "mrcal region": (
        "mrcal.cameramodel",
        "region = mrcal.cameramodel(file).valid_intrinsics_region()\nuv = [] if region is None else region",
    ),
}


def ask(program, file, points=()):
    """What the program answers, (N, 2)."""
    function, code = PROGRAMS[program]
    module = function.partition(".")[0]
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}

    def run(source, given):
        return subprocess.run([PYTHON, "-c", source], input=given, text=True, capture_output=True, env=clean)

    if not Path(PYTHON).exists() or run(f"import {module}; {function}", "").returncode:
        warnings.warn(f"no {function} in {PYTHON}: not compared with it", stacklevel=2)
        pytest.skip(f"no {function} in {PYTHON}")
    script = (
        f"import json, sys\nimport numpy as np\nimport {module}\nfile, points = json.load(sys.stdin)\n"
        f"points = np.array(points, dtype=float)\n{code}\nprint(json.dumps(np.asarray(uv).reshape(-1, 2).tolist()))\n"
    )
    done = run(script, json.dumps([str(file), np.asarray(points).tolist()]))
    assert done.returncode == 0, done.stderr
    return np.array(json.loads(done.stdout)).reshape(-1, 2)


def rays_of(camera):
    """Rays over the camera's picture, at most 89 degrees off the axis."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 23), np.linspace(0, camera.height - 1, 23))
    rays, ok = camera.unproject(np.stack([x, y], axis=-1).reshape(-1, 2))
    return rays[ok & (rays[:, 2] > math.cos(math.radians(89)))]


@pytest.mark.parametrize(
    ("program", "file"),
    [
        ("fisheye", "opencv_fisheye.yaml"),
        ("omnidir", "opencv_omnidir.yaml"),
        ("pinhole", "opencv_pinhole.yaml"),
        ("mrcal", "pinhole.cameramodel"),
        ("mrcal", "stereographic.cameramodel"),
    ],
)
def test_a_file_means_the_pixels_that_its_own_program_makes_of_it(program, file):
    loaded = formats.load(DATA / file, max_error=0.5)
    rays = rays_of(loaded.camera)
    error = np.linalg.norm(loaded.camera.project(rays)[0] - ask(program, DATA / file, rays), axis=1)
    assert len(rays) > 300 and error.max() <= 1.05 * loaded.fit.max_px + 1e-9


def test_a_written_fisheye_file_is_read_by_opencv(front, tmp_path):
    formats.write(front, tmp_path / "out.yaml", "opencv-fisheye")
    rays = rays_of(front)
    np.testing.assert_allclose(ask("fisheye", tmp_path / "out.yaml", rays), front.project(rays)[0], atol=1e-9)


def test_a_written_spline_is_projected_by_mrcal_within_the_stated_error(front, tmp_path):
    file = tmp_path / "out.cameramodel"
    written = formats.write(front, file, "mrcal")
    rays = rays_of(front)
    error = np.linalg.norm(ask("mrcal", file, rays) - front.project(rays)[0], axis=1)
    assert error.max() <= 1.05 * written.fit.max_px


def test_mrcal_keeps_the_region_that_is_written(front, tmp_path):
    """It drops, with no more than a warning, a region that is not closed."""
    file = tmp_path / "out.cameramodel"
    formats.write(front, file, "mrcal")
    region = ask("mrcal region", file)
    assert len(region) > 80 and (region[0] == region[-1]).all()
    theta = np.arccos(front.unproject(np.clip(region, 0, [799, 599]))[0][:, 2])
    assert 1.5 < np.nanmax(theta) <= 1.5201  # the profile ends inside the picture's corners
