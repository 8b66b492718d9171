"""Times the camera model against other libraries, in turns in one process, one thread, a million points.

usage: camera_peers.py LIBRARY   (LIBRARY: the shared library bench_camera_core)

Run by run.py with each interpreter that has peers: the benchmark's own virtual environment (opencv-python-headless,
pycolmap) and Debian's Python (python3-opencv, python3-mrcal). Prints one JSON object a line. What was not equal: cv2
projects only in front (theta < 90 degrees, here 5 to 85) and its undistortPoints returns plane points, ours unit rays;
mrcal's OPENCV4 is a pinhole with four distortion terms, no fisheye; all get the same directions, in double.
"""

import ctypes
import json
import sys
import time
from collections.abc import Callable

import numpy as np

N = 1_000_000
ROUNDS = 15


class Core:
    """Our side, through ctypes: no copy, no Python per point."""

    def __init__(self, path: str) -> None:
        self.library = ctypes.CDLL(path)
        self.library.bench_camera.restype = self.library.bench_rays.restype = ctypes.c_void_p
        self.ok = np.empty(N, np.uint8)

    def project(self, asymmetric: int, xyz: np.ndarray, uv: np.ndarray) -> Callable[[], None]:
        """A call that projects xyz (N,3) into uv (N,2); the arrays must live on."""
        camera = ctypes.c_void_p(self.library.bench_camera(asymmetric))
        arguments = [camera, ctypes.c_size_t(N)] + [ctypes.c_void_p(a.ctypes.data) for a in (xyz, uv, self.ok)]
        return lambda: self.library.pf_camera_project_n(*arguments)

    def unproject(self, uv: np.ndarray, ray: np.ndarray) -> Callable[[], None]:
        """A call that back-projects uv (N,2) into ray (N,3); the arrays must live on."""
        camera = ctypes.c_void_p(self.library.bench_camera(0))
        origin = ctypes.c_void_p(None)
        arguments = [camera, ctypes.c_size_t(N)] + [ctypes.c_void_p(a.ctypes.data) for a in (uv, ray)]
        return lambda: self.library.pf_camera_unproject_n(*arguments, origin, ctypes.c_void_p(self.ok.ctypes.data))

    def lookup(self, pixels: np.ndarray, rays: np.ndarray) -> Callable[[], None]:
        """A call that looks up the rays (N,3) int32 Q1.30 of pixels (N,2) int32 Q16.16; the arrays must live on."""
        table = ctypes.c_void_p(self.library.bench_rays())
        arguments = [table, ctypes.c_size_t(N)] + [ctypes.c_void_p(a.ctypes.data) for a in (pixels, rays)]
        return lambda: self.library.pf_camera_rays_lookup(*arguments)


def fastest(*calls: Callable[[], object]) -> list[float]:
    """The shortest time of each call in ns a point, measured in turns."""
    best = [float("inf")] * len(calls)
    for _ in range(ROUNDS):
        for i, call in enumerate(calls):
            start = time.perf_counter_ns()
            call()
            best[i] = min(best[i], (time.perf_counter_ns() - start) / N)
    return best


def report(name: str, ours: float, peer: str, theirs: float) -> None:
    """One figure on stdout."""
    figure = {"name": name, "value": ours, "unit": "ns/point", "peer": peer, "peer_value": theirs}
    print(json.dumps(figure), flush=True)


def main() -> None:
    """Measures against every peer that this interpreter has."""
    core = Core(sys.argv[1])
    random = np.random.default_rng(1)
    theta, phi = np.radians(random.uniform(5, 85, N)), random.uniform(0, 2 * np.pi, N)
    length = random.uniform(0.5, 2, N)[:, None]
    xyz = length * np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    uv, uv23, ray = np.empty((N, 2)), np.empty((N, 2)), np.empty((N, 3))
    ours, ours_p23, back = core.project(0, xyz, uv), core.project(1, xyz, uv23), core.unproject(uv, ray)
    ours()
    back()
    assert np.abs(ray - xyz / length).max() < 1e-12, "the core does not come back to its rays"
    # The table: those of the pixels that lie on the sensor, in random order.
    chosen = np.resize(np.flatnonzero((np.abs(uv - [639.5, 399.5]) < [640, 400]).all(axis=1)), N)
    pixels_q16, rays_q30 = np.rint(uv[chosen] * 65536).astype(np.int32), np.empty((N, 3), np.int32)
    table = core.lookup(pixels_q16, rays_q30)
    table()
    error = np.abs(rays_q30 / 2**30 - xyz[chosen] / length[chosen]).max()
    assert error < 1e-5, f"the table of rays is off by {error}"
    intrinsics = [356.2, 355.9, 647.3, 404.8]
    radial = [-0.031, 0.0042, -0.0011, 0.00006]

    try:
        import cv2
    except ImportError:
        cv2 = None
    if cv2 is not None:
        cv2.setNumThreads(1)
        matrix = np.array([[intrinsics[0], 0, intrinsics[2]], [0, intrinsics[1], intrinsics[3]], [0, 0, 1]])
        points, pixels, zero = xyz[:, None, :].copy(), uv[:, None, :].copy(), np.zeros(3)
        projected = cv2.fisheye.projectPoints(points, zero, zero, matrix, np.array(radial))[0][:, 0]
        assert np.abs(projected - uv).max() < 1e-8, "cv2.fisheye and the core disagree"
        peer = f"cv2.fisheye {cv2.__version__}"
        t = fastest(ours, ours_p23, lambda: cv2.fisheye.projectPoints(points, zero, zero, matrix, np.array(radial)))
        report("camera.project.p9", t[0], peer, t[2])
        report("camera.project.p23", t[1], peer, t[2])
        t = fastest(back, table, lambda: cv2.fisheye.undistortPoints(pixels, matrix, np.array(radial)))
        report("camera.unproject.p9", t[0], peer, t[2])
        report("camera.lut", t[1], peer, t[2])

    try:
        import mrcal
    except ImportError:
        mrcal = None
    if mrcal is not None:
        model, values = "LENSMODEL_OPENCV4", np.array([*intrinsics, -0.01, 0.002, 0, 0])
        t = fastest(ours, lambda: mrcal.project(xyz, model, values))
        report("camera.project.p9", t[0], "mrcal OPENCV4", t[1])
        t = fastest(ours, lambda: mrcal.project(xyz, "LENSMODEL_OPENCV8", np.r_[values, 0, 0, 0, 0]))
        report("camera.project.p9", t[0], "mrcal OPENCV8", t[1])
        few = uv[: N // 20].copy()
        best = min(_timed(lambda: mrcal.unproject(few, model, values)) for _ in range(3))
        t = fastest(back, table)
        report("camera.unproject.p9", t[0], "mrcal OPENCV4", best / len(few))
        report("camera.lut", t[1], "mrcal OPENCV4", best / len(few))

    try:
        import pycolmap
    except ImportError:
        pycolmap = None
    if pycolmap is not None:
        camera = pycolmap.Camera(model="OPENCV_FISHEYE", width=1280, height=800, params=[*intrinsics, *radial])
        t = fastest(ours, lambda: camera.img_from_cam(xyz))
        report("camera.project.p9", t[0], "pycolmap", t[1])
        t = fastest(back, table, lambda: camera.cam_from_img(uv))
        report("camera.unproject.p9", t[0], "pycolmap", t[2])
        report("camera.lut", t[1], "pycolmap", t[2])


def _timed(call: Callable[[], object]) -> float:
    start = time.perf_counter_ns()
    call()
    return time.perf_counter_ns() - start


if __name__ == "__main__":
    main()
