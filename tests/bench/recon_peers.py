"""Times two views against PoseLib and a whole reconstruction against COLMAP, in one process, one thread.

usage: recon_peers.py PEERS   (with pipefish's own interpreter; PEERS: folder of packages with poselib and pycolmap)

300 points of a tube, 30 % wrong, 0.3 px, forward and sideways. PoseLib works on image planes: points beyond 88 degrees
are clipped for both, and it gets a camera of its own fisheye model.

A whole pipe: DN300, 30 m, a frame every 5 cm, 0.3 px, up to 88 degrees; the same tracks. COLMAP gets them as verified
matches of frames up to 11 apart (no time is counted for that), with the camera fixed and forward motion allowed for its
first pair, and maps incrementally. Ours gets no encoder either. Prints one JSON object a line.
"""

import json
import sys
import tempfile
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


def database(folder: Path, drive: object) -> Path:
    """The tracks as COLMAP's database of images, corners and verified matches."""
    import pycolmap

    camera, tracks = drive.camera, drive.tracks
    path = folder / "tracks.db"
    store = pycolmap.Database.open(path)
    # COLMAP's pixels start at the corner of the first pixel, ours at its centre.
    parameters = [
        camera.f_u,
        camera.f_v,
        camera.c_u + 0.5,
        camera.c_v + 0.5,
        camera.k2,
        camera.k3,
        camera.k4,
        camera.k5,
    ]
    theirs = pycolmap.Camera(model="OPENCV_FISHEYE", width=camera.width, height=camera.height, params=parameters)
    theirs.has_prior_focal_length = True
    number = store.write_camera(theirs)
    images, seen = [], []
    for frame in range(len(drive.poses)):
        here = tracks.frame == frame
        images.append(store.write_image(pycolmap.Image(name=f"{frame:05d}.png", camera_id=number)))
        store.write_keypoints(images[-1], (tracks.pixels[here] + 0.5).astype(np.float32))
        seen.append(tracks.track[here])
    for a in range(len(seen)):
        for b in range(a + 1, min(len(seen), a + 12)):
            common, i, j = np.intersect1d(seen[a], seen[b], return_indices=True)
            if len(common) >= 15:
                pairs = np.column_stack([i, j]).astype(np.uint32)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config, geometry.inlier_matches = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, pairs
                store.write_matches(images[a], images[b], pairs)
                store.write_two_view_geometry(images[a], images[b], geometry)
    store.close()
    return path


def total_30m() -> list[dict]:
    """recon.total_30m: seconds from tracks to poses, points and covariance."""
    import pycolmap

    import pipefish as pf
    from tube_tracks import tube_drive

    drive = tube_drive(0, 30.0, limits=(35.0, 88.0))
    pycolmap.logging.minloglevel = 2
    ours = float("inf")
    for _ in range(3):
        start = time.perf_counter()
        mine = pf.reconstruct(drive.tracks, drive.camera, threads=1)
        ours = min(ours, time.perf_counter() - start)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.mapper.init_max_forward_motion = 1.0
    options.extract_colors = options.multiple_models = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = database(folder, drive)
        start = time.perf_counter()
        maps = pycolmap.incremental_mapping(path, folder, folder, options)
        theirs = time.perf_counter() - start
    registered = max((m.num_reg_images() for m in maps.values()), default=0)
    print(f"recon.total_30m: {len(mine.frames)} frames, COLMAP {registered}", file=sys.stderr)
    peer = f"pycolmap {pycolmap.__version__}"
    return [{"name": "recon.total_30m", "value": ours, "unit": "s", "peer": peer, "peer_value": theirs}]


def main() -> None:
    """Prints the figures."""
    for figure in two_view() + total_30m():
        print(json.dumps(figure), flush=True)


if __name__ == "__main__":
    main()
