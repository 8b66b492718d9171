"""Times rivals' calibration of the benchmark's views: seconds, shortest of ten. Prints one JSON object a rival.

What is not equal: cv2.fisheye and mrcal get a guess (the true focal length, rounded), ours gets none; mrcal fits
OPENCV8, a pinhole with eight terms, for it has no parametric fisheye, on the points less than 60 degrees off the axis.
"""

import json
import sys

import numpy as np
from calib_scene import SIZE, K, board, fastest, views

PIXELS = views()


def opencv() -> dict | None:
    """cv2.fisheye.calibrate with a guess, one thread."""
    try:
        import cv2
    except ImportError:
        return None
    cv2.setNumThreads(1)
    flags = cv2 if hasattr(cv2, "CALIB_RECOMPUTE_EXTRINSIC") else cv2.fisheye
    wanted = flags.CALIB_USE_INTRINSIC_GUESS if flags is cv2 else cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
    wanted |= flags.CALIB_RECOMPUTE_EXTRINSIC | flags.CALIB_FIX_SKEW
    drawn = [board().reshape(1, -1, 3)] * len(PIXELS)
    seen = [p.reshape(1, -1, 2) for p in PIXELS]
    rms = 0.0

    def run() -> None:
        nonlocal rms
        guess = np.array([[round(K[0], -1), 0, SIZE[0] / 2], [0, round(K[1], -1), SIZE[1] / 2], [0, 0, 1.0]])
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-9)
        rms = cv2.fisheye.calibrate(drawn, seen, SIZE, guess, np.zeros((4, 1)), None, None, wanted, criteria)[0]

    return {"peer": f"cv2.fisheye {cv2.__version__} with a guess", "seconds": fastest(run, 10), "rms": rms}


def mrcal() -> dict | None:
    """mrcal.optimize from the true poses' neighbourhood: the solver alone, as it has no start of its own here."""
    try:
        import mrcal as library
    except ImportError:
        return None
    observed = []
    for pixels in PIXELS:
        r = np.hypot(*((pixels - K[2:]) / K[:2]).T)
        weight = np.where(r < np.radians(60), 1.0, -1.0)
        observed.append(np.column_stack([pixels, weight]).reshape(8, 11, 3))
    indices = np.array([[i, 0, -1] for i in range(len(PIXELS))], dtype=np.int32)
    observations = np.array(observed)
    rms = 0.0

    def run() -> None:
        nonlocal rms
        intrinsics = np.array([[320.0, 320.0, *(np.array(SIZE) / 2), *[1e-3] * 8]])
        frames = np.array([_start(o) for o in observed])
        stats = library.optimize(
            intrinsics=intrinsics,
            extrinsics_rt_fromref=np.zeros((0, 6)),
            frames_rt_toref=frames,
            points=None,
            observations_point=None,
            indices_point_camintrinsics_camextrinsics=None,
            observations_board=observations.copy(),
            indices_frame_camintrinsics_camextrinsics=indices,
            lensmodel="LENSMODEL_OPENCV8",
            imagersizes=np.array([SIZE], dtype=np.int32),
            calibration_object_spacing=0.03,
            do_optimize_calobject_warp=False,
            do_apply_outlier_rejection=False,
            do_apply_regularization=True,
            verbose=False,
        )
        rms = stats["rms_reproj_error__pixels"]

    try:
        return {"peer": "mrcal OPENCV8", "seconds": fastest(run, 5), "rms": rms}
    except (RuntimeError, TypeError, AttributeError) as error:
        print(f"mrcal: {error}", file=sys.stderr)
        return None


def _start(observed: np.ndarray) -> np.ndarray:
    """A board's pose (rt) by a homography to rays of the true lens; good enough for a solver."""
    pixels, drawn = observed[..., :2].reshape(-1, 2), board()
    x = (pixels - K[2:]) / K[:2]
    theta = np.hypot(*x.T)
    rays = np.column_stack([x * (np.sin(theta) / theta)[:, None], np.cos(theta)])
    plane = np.column_stack([drawn[:, :2] / 0.1, np.ones(len(drawn))])
    rows = []
    for ray, p in zip(rays, plane, strict=True):
        a = np.array([[0, -ray[2], ray[1]], [ray[2], 0, -ray[0]], [-ray[1], ray[0], 0]])
        rows.append(np.kron(a, p))
    h = np.linalg.svd(np.concatenate(rows))[2][-1].reshape(3, 3)
    h *= np.sign((rays * (plane @ h.T)).sum())
    h /= (np.linalg.norm(h[:, 0]) + np.linalg.norm(h[:, 1])) / 2
    u, _, vt = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    r = u @ vt
    angle = np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1))
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (2 * np.sin(angle))
    return np.concatenate([axis * angle, h[:, 2] * 0.1])


def main() -> int:
    """Prints what is installed."""
    for rival in (opencv, mrcal):
        done = rival()
        if done:
            print(json.dumps(done))
    return 0


if __name__ == "__main__":
    sys.exit(main())
