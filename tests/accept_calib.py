"""Calibration against theory, over random set-ups and on real data; long, resumable.

    python tests/accept_calib.py [--setups 1000] [--runs 300]

prints a table, then one JSON list of {name, value, bound, holds}. Results of set-ups and runs are kept in
build/accept_calib/, one line each, and taken from there while product and script are the same. Real data: in
PIPEFISH_DATA or ../shared/data.
"""

import argparse
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "python"))

from accept_rows import Row, at_most, figure, kept_series, print_rows  # noqa: E402

from calib_data_sets import PICTURES, jy_stereo, ov_plane, pictures  # noqa: E402
from calib_scenes import Lens, bearing_error, random_lens, views_of  # noqa: E402
from pipefish.calibration import CalibrationError, calibrate  # noqa: E402

Array = np.ndarray
KEEP = ROOT / "build" / "accept_calib"


# ---------------------------------------------------------------------- random set-ups


def setup(seed: int) -> Row:
    """One random lens, views, noise, outliers. Right: bearings over the field within five of their own standard
    deviations (root mean square) of the truth, or within a tenth of a pixel."""
    random = np.random.default_rng(seed)
    while True:
        lens, count, noise = random_lens(random), int(random.integers(5, 31)), float(random.uniform(0.0, 0.5))
        try:
            views, poses = views_of(random, lens, count, noise, 0.02)
            break
        except RuntimeError:
            continue  # a lens whose field no board fits
    row = {"kind": lens.kind, "fov": math.degrees(2 * lens.end), "views": count, "noise": noise}
    try:
        result = calibrate(views, (lens.width, lens.height), "p9", "flat")
    except CalibrationError as error:
        return row | {"outcome": "refused", "why": str(error)}
    error = bearing_error(result.camera, lens, views, poses) * lens.f
    expected = bearing_sigma(result, np.concatenate([v.pixels for v in views])) * lens.f
    used = sum(v["used"] for v in result.report["views"])
    right = error < max(5 * expected, 0.1) and used >= 0.8 * count
    return row | {"outcome": "right" if right else "wrong", "error_px": error, "expected_px": expected, "used": used}


def setups(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "setups", count, setup)
    outcome = {o: sum(r["outcome"] == o for r in rows) for o in ("right", "refused", "wrong")}
    yield figure("calib.setups_right_share", outcome["right"] / count, ">= 0.995", outcome["right"] >= 0.995 * count)
    yield figure("calib.setups_silently_wrong", outcome["wrong"], "= 0", outcome["wrong"] == 0)


def bearing_sigma(result: object, pixels: Array) -> float:
    """RMS angle, radians, that the covariance of the parameters leaves open at pixels, after the best rotation."""
    camera = result.camera
    pixels = pixels[:: max(1, len(pixels) // 300)]
    rays, ok = camera.unproject(np.clip(pixels, 0, [camera.width - 1, camera.height - 1]))
    rays = rays[ok]
    _, _, by_point, by_parameter = camera.project_jacobian(rays)
    free = [list(__import__("pipefish").PARAMETERS).index(p) for p in camera.covariance_parameters]
    # A pixel that moves by d is a ray that moves by -pinv(J) d, in the ray's plane.
    to_ray = np.linalg.pinv(by_point)
    slope = -(to_ray @ by_parameter[:, :, free]).reshape(-1, len(free))
    turn = np.zeros((len(rays), 3, 3))
    turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = rays[:, 2], -rays[:, 1], rays[:, 0]
    turn = (turn - turn.swapaxes(1, 2)).reshape(-1, 3)
    slope = slope - turn @ np.linalg.lstsq(turn, slope, rcond=None)[0]
    return float(np.sqrt(np.trace(slope @ result.covariance @ slope.T) / len(rays)))


# ---------------------------------------------------------------------- Monte Carlo

TRUTH = Lens("equidistant", 1280, 800, 330.0, (645.0, 395.0), 1.001, (-0.02, 0.002), math.radians(93))
NOISE = 0.1


def run(seed: int) -> Row:
    """One set of measurements of the same 20 views: intervals, Paper II's sum of squares, bearings."""
    clean, poses = views_of(np.random.default_rng(77), TRUTH, 20, 0.0)
    random = np.random.default_rng(10_000 + seed)
    views = [type(v)(v.board_xyz, v.pixels + random.normal(0, NOISE, v.pixels.shape)) for v in clean]
    result = calibrate(views, (TRUTH.width, TRUTH.height), "p9", "flat")
    camera = result.camera
    truth = {"f_u": 330.0, "f_v": 330.0 * 1.001, "c_u": 645.0, "c_v": 395.0, "k2": -0.02, "k3": 0.002, "k4": 0, "k5": 0}
    sigma = np.sqrt(np.diag(result.covariance))
    inside = [
        abs(getattr(camera, p) - truth[p]) < 1.959964 * s
        for p, s in zip(camera.covariance_parameters, sigma, strict=True)
    ]
    true_pixels = np.concatenate([v.pixels for v in clean])
    pixels = np.concatenate([v.pixels for v in views])
    residual = np.array(result.report["residuals"]["residual"])
    square = {
        "measurement": ((pixels - true_pixels) ** 2).sum(axis=1).mean(),
        "residual": (residual**2).sum(axis=1).mean(),
        "estimation": ((pixels - residual - true_pixels) ** 2).sum(axis=1).mean(),
    }
    bearing = bearing_error(camera, TRUTH, clean, poses)
    plain = calibrate(views, (TRUTH.width, TRUTH.height), "p9", "flat", robust=False)
    return {
        "inside": [bool(i) for i in inside],
        **{k: float(v) for k, v in square.items()},
        "bearing": bearing,
        "bearing_plain": bearing_error(plain.camera, TRUTH, clean, poses),
        "bearing_sigma": bearing_sigma(result, true_pixels),
        "points": len(pixels),
        "pipe_sigma_mm": result.uncertainty[0].diameter(300)["sigma_mm"],
    }


def monte_carlo(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "runs", count, run)
    share = float(np.mean([r["inside"] for r in rows]))
    yield figure("calib.intervals_95", share, "0.93 .. 0.97", 0.93 <= share <= 0.97)
    sums = {k: np.mean([r[k] for r in rows]) for k in ("measurement", "residual", "estimation")}
    off = abs(float(sums["measurement"] / (sums["residual"] + sums["estimation"])) - 1)
    yield at_most("calib.squares_off", off, 0.03)
    bearing = math.sqrt(np.mean([r["bearing"] ** 2 for r in rows]))
    bound = math.sqrt(np.mean([r["bearing_sigma"] ** 2 for r in rows]))
    # Nine tenths of the variance lie in one direction (the scale), so the ratio scatters like chi square of 1.25
    # degrees of freedom a run: by 0.04 at 300 runs, by 0.1 at 40. Efficiency against least squares on the same noise,
    # which attains the bound, does not scatter.
    yield at_most("calib.bearing_to_cramer_rao", bearing / bound, 1.05)
    plain = math.sqrt(np.mean([r["bearing_plain"] ** 2 for r in rows]))
    yield at_most("calib.bearing_to_least_squares", bearing / plain, 1.001)
    freedom = 8 + 6 * 20
    chi = float(np.mean([r["estimation"] for r in rows])) * rows[0]["points"] / NOISE**2 / freedom
    yield figure("calib.estimation_to_theory", chi, "0.97 .. 1.03", 0.97 <= chi <= 1.03)


# ---------------------------------------------------------------------- real data


def real(data: Path) -> Iterator[Row]:
    train, size = ov_plane(data, "train")
    test, _ = ov_plane(data, "test")
    for model, board, bound in (("p9", "flat", 0.476), ("p23", "flat", 0.458), ("auto", "shape", 0.27)):
        result = calibrate(train, size, model, board)
        yield at_most(f"calib.ov_plane.{model}_{board}_test_px", result.test(test), bound)
    left, size = jy_stereo(data, 1)
    yield at_most("calib.jy_left_p9_px", calibrate(left, size, "p9", "flat", robust=False).rms, 0.29385)
    yield from from_pictures(data)


def from_pictures(data: Path) -> Iterator[Row]:
    """Rows that have a bound; the others are told on stderr: they could not fail."""
    for row in figures_of_pictures(data):
        if row["bound"].endswith("inf"):
            print(f"  no bound  {row['name']:44} {row['value']:.6g}", file=sys.stderr)
        else:
            yield row


def figures_of_pictures(data: Path) -> Iterator[Row]:
    """The project's own detector and default options. Bounds of p9: residuals on others' corners of the same pictures;
    held out: folds over views, p9 against the chosen model on the same corners."""
    bounds = {"Fisheye1": (0.88, 0.895), "Fisheye2": (0.324, 0.33), "camodocal": (0.54, math.inf)}
    for name in PICTURES:
        views, size, count = pictures(data, name)
        key = f"calib.{name.replace(' ', '_')}"
        p9, auto = calibrate(views, size, "p9", "flat"), calibrate(views, size)
        used = sum(v["used"] for v in p9.report["views"])
        yield figure(f"{key}.views", used, f">= {15 * count // 16}", used >= 15 * count // 16)
        train, test = bounds.get(name, (math.inf, math.inf))
        yield at_most(f"{key}.p9_flat_px", p9.report["rms_all_px"], train)
        accepted = [row["held_out_rms_px"] for row in auto.report["models"] if row["accepted"]]
        yield at_most(f"{key}.p9_flat_held_out_px", accepted[0], test)
        clearly = {"camodocal": 1.0, "catadioptric": 0.7}.get(name, 0.9)
        print(f"{key}: {auto.model}", file=sys.stderr)
        yield at_most(f"{key}.auto_held_out_px", accepted[-1], clearly * accepted[0])
        yield at_most(f"{key}.auto_px", auto.rms, clearly * p9.rms if name == "catadioptric" else math.inf)
    left, size, _ = pictures(data, "jy_stereo left")
    right, _, _ = pictures(data, "jy_stereo right")
    pair = calibrate(left + right, size)
    yield at_most("calib.jy_stereo_pair.auto_px", pair.rms, 0.29384)
    yield at_most(
        "calib.jy_stereo_pair.baseline_off_mm", abs(np.linalg.norm(pair.camera_poses[1][:, 3]) - 0.1) * 1e3, 5
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setups", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=300)
    args = parser.parse_args()
    rows = [*monte_carlo(args.runs), *setups(args.setups)]
    data = Path(os.environ.get("PIPEFISH_DATA") or ROOT.parent / "shared" / "data") / "calibration"
    if data.exists():
        rows += real(data)
    print_rows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
