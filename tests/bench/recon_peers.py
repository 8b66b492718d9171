"""Times two views against PoseLib, in turns in one process, one thread.

usage: recon_peers.py PEERS   (with pipefish's own interpreter; PEERS: folder of packages that has poselib)

300 points of a tube, 30 % wrong, 0.3 px, forward and sideways. PoseLib works on image planes: points beyond 88 degrees
are clipped for both, and it gets a camera of its own fisheye model. Prints one JSON object a line.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path += [str(ROOT / "tests" / "python"), *sys.argv[1:]]  # numpy stays pipefish's
RUNS = 30


def fastest(calls: list, rounds: int) -> list[float]:
    """The shortest time of each call, ms, measured in turns."""
    best = [float("inf")] * len(calls)
    for _ in range(rounds):
        for i, call in enumerate(calls):
            start = time.perf_counter_ns()
            call()
            best[i] = min(best[i], (time.perf_counter_ns() - start) * 1e-6)
    return best


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Between two vectors, degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def turn(a: np.ndarray, b: np.ndarray) -> float:
    """Between two rotations, degrees."""
    w = a @ b.T
    sine = np.array([w[2, 1] - w[1, 2], w[0, 2] - w[2, 0], w[1, 0] - w[0, 1]])
    return float(np.degrees(np.arctan2(np.linalg.norm(sine) / 2, (np.trace(w) - 1) / 2)))


def two_view() -> list[dict]:
    """recon.two_view: milliseconds a pair, and errors as shares of PoseLib's."""
    import poselib

    import pipefish as pf
    from tube_tracks import fisheye, tube_pair

    camera = fisheye(105)
    model = {
        "model": "OPENCV_FISHEYE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.f_u, camera.f_v, camera.c_u, camera.c_v, camera.k2, camera.k3, camera.k4, camera.k5],
    }
    figures = []
    for name, motion in (("forward", (0.003, 0.002, 0.05)), ("sideways", (0.03, 0.0, 0.002))):
        times, errors = [], []
        for seed in range(RUNS):
            pair = tube_pair(seed, motion, camera=camera)
            ransac = {"max_epipolar_error": 0.3 * np.sqrt(6.63), "seed": seed}
            theirs = [lambda p=pair, r=ransac: poselib.estimate_relative_pose(*p.pixels, model, model, r, {})]
            ours = [lambda p=pair, s=seed: pf.two_view(camera, *p.pixels, seed=s)]
            times.append(fastest(ours + theirs, 5))
            result, (pose, _) = ours[0](), theirs[0]()
            t = -pair.rotation @ pair.centre
            errors.append(
                [
                    turn(result.rotation, pair.rotation),
                    angle(result.direction, t),
                    turn(pose.R, pair.rotation),
                    angle(pose.t, t),
                ]
            )
        milliseconds, rms = np.median(times, axis=0), np.sqrt(np.mean(np.square(errors), axis=0))
        peer = f"poselib {poselib.__version__}"
        for key, unit, ours_value, theirs_value in (
            ("", "ms", milliseconds[0], milliseconds[1]),
            (".rotation", "deg", rms[0], rms[2]),
            (".direction", "deg", rms[1], rms[3]),
        ):
            figure = {"name": f"recon.two_view{key}.{name}" if key else "recon.two_view", "value": float(ours_value)}
            figures.append(figure | {"unit": unit, "peer": f"{peer}, {name}", "peer_value": float(theirs_value)})
    return figures


def main() -> None:
    """Prints the figures of what this interpreter has."""
    for figure in two_view():
        print(json.dumps(figure), flush=True)


if __name__ == "__main__":
    main()
