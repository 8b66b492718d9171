"""What is told of a tube at its stations: diameters, ovalities and their sigmas, and the figures of the whole."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from pipefish import tube_shape
from pipefish.intervals import Z95
from pipefish.tube_section import MEASURED, calipers, gradients, size

if TYPE_CHECKING:
    from pipefish.tube import Tube
    from pipefish.tube_shared import Common

MIN_INLIERS = 20  # in a section, for its values to be given
GAP_CIRCLE, GAP_NONE = math.radians(150), math.radians(220)  # azimuth without points: no ovality, nothing
OF_ELLIPSE = ("d_max", "d_min", "ovality", "clock_max", "reduction")
OF_SIZE = ("d_mean", "d_area", "circumference")


def _rice_table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Central 95 % interval of |e| / sigma from its estimate, in two dimensions: both are lengths of a vector. Its
    upper end is at least that of a circle's median: estimates nearer to zero than noise brings would give no width."""
    seen = np.linspace(0, 8, 161)
    true = np.linspace(0, 12, 481)
    y, half = seen[:, None] ** 2 / 2, true[None, :] ** 2 / 2
    below = np.zeros((len(seen), len(true)))  # P(estimate < seen | true)
    poisson, tail, term = np.exp(-half), 1 - np.exp(-y), np.exp(-y)
    for j in range(220):
        below += poisson * tail
        poisson = poisson * half / (j + 1)
        term = term * y / (j + 1)
        tail = tail - term
    low = np.array([true[np.searchsorted(-row, -0.975)] if row[0] > 0.975 else 0.0 for row in below])
    high = np.array([true[min(len(true) - 1, np.searchsorted(-row, -0.025))] for row in below])
    high = np.maximum(high, np.interp(math.sqrt(2 * math.log(2)), seen, high))
    return seen, low, high


def stations_of(
    tube: Tube, spacing: float, scale_sigma: float, common: Common
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The stations' table, and the derivatives (n,k) of their mean diameters by the section's parameters."""
    s, piece = [], []
    for k, (start, end) in enumerate(tube.surface.pieces):
        count = max(2, round((end - start) / spacing) + 1)
        s.append(np.linspace(start, end, count))
        piece.append(np.full(count, k))
    s, piece = np.concatenate(s), np.concatenate(piece)
    f = tube.frames(s, piece)
    shape, k = f["shape"], f["shape"].shape[1]
    full = f["covariance"].reshape(len(s), k + 2, k + 2)
    cov = full[:, 2:, 2:].copy()
    together, camera = common.ellipses(s, piece, 0.5 * (cov[:, 1, 1] + cov[:, 2, 2]), f["ellipse"] > 0)
    cov[:, 1:3, 1:3] += together
    out: dict[str, np.ndarray] = {"s": s, "piece": piece.astype(int)}
    out.update(zip("xyz", f["centre"].T, strict=True))
    out.update(zip(("tx", "ty", "tz"), f["tangent"].T, strict=True))
    out["centre_sigma"] = np.sqrt(np.maximum(0, full[:, 0, 0] + full[:, 1, 1]))
    # The ellipse's amplitude without the noise's share.
    e = np.hypot(shape[:, 1], shape[:, 2])
    trace = cov[:, 1, 1] + cov[:, 2, 2]
    debiased = shape.copy()
    debiased[:, 1:3] *= (np.sqrt(np.maximum(e**2 - trace, 0)) / np.maximum(e, 1e-300))[:, None]
    raw = calipers(shape)
    sound = calipers(debiased)
    gradient = gradients(shape, raw)
    d_mean, d_area = size(debiased)
    values = {"d_mean": d_mean, "d_area": d_area, "d_max": sound["max"], "d_min": sound["min"]}

    out["departure"] = tube_shape.departure(shape)
    beyond = tube_shape.left_out(out["departure"], d_mean)

    def sigma_of(g: np.ndarray, diameters: int = 1) -> np.ndarray:
        return np.sqrt(np.maximum(0, np.einsum("ni,nij,nj->n", g, cov, g)) + diameters * beyond**2)

    for name, value in values.items():
        out[name] = value
        out[name + "_sigma"] = sigma_of(gradient[name])
        out[name + "_systematic"] = scale_sigma * value
    out["circumference"] = np.pi * d_mean
    out["circumference_sigma"] = np.pi * out["d_mean_sigma"]
    out["clock_max"] = (raw["max_direction"] - f["zero"]) % np.pi
    out["clock_max_sigma"] = np.minimum(np.pi / 2, 0.5 * np.sqrt(trace / 2) / np.maximum(e, 1e-300))
    span, span_sigma = values["d_max"] - values["d_min"], sigma_of(gradient["d_max"] - gradient["d_min"], 2)
    out["ovality"], out["ovality_sigma"] = span / d_mean, span_sigma / d_mean
    by_ellipse = (gradient["d_max"] - gradient["d_min"])[:, 1:3]
    out["ovality_systematic"] = np.sqrt(np.einsum("ni,nij,nj->n", by_ellipse, camera, by_ellipse)) / d_mean
    out["ovality_astm"] = (d_mean - values["d_min"]) / d_mean
    out["ovality_astm_sigma"] = sigma_of(gradient["d_mean"] - gradient["d_min"], 2) / d_mean
    out["ovality_astm_max"] = (values["d_max"] - d_mean) / d_mean
    out["ovality_astm_max_sigma"] = sigma_of(gradient["d_max"] - gradient["d_mean"], 2) / d_mean
    nominal = tube.nominal or math.nan
    out["ovality_nominal"], out["ovality_nominal_sigma"] = span / nominal, span_sigma / nominal
    out["reduction_nominal"] = (nominal - values["d_min"]) / nominal
    out["reduction_nominal_sigma"] = out["d_min_sigma"] / nominal
    seen, low, high = _rice_table()
    amplitude = (raw["max"] - raw["min"]) / d_mean
    out["ovality_squared"] = amplitude**2 - 16 * trace / d_mean**2  # the widths differ by 4 |e|
    one = np.maximum(np.hypot(out["ovality_sigma"], out["ovality_systematic"]), 1e-300)
    inside = amplitude / one < seen[-1]
    out["ovality_lo"] = np.where(inside, one * np.interp(amplitude / one, seen, low), amplitude - Z95 * one)
    out["ovality_hi"] = np.where(inside, one * np.interp(amplitude / one, seen, high), amplitude + Z95 * one)
    out["oval"] = e**2 / np.maximum(trace / 2, 1e-300) > 5.99  # chi^2 of two, 95 %
    for name in ("curvature", "curvature_sigma", "gap", "rms", "roughness"):
        out[name] = f[name]
    out["inliers"] = f["inliers"].astype(int)
    out["status"] = _station_status(out, f["ellipse"] > 0)
    blank(out)
    return out, gradient["d_mean"]


def _station_status(out: dict[str, np.ndarray], ellipse: np.ndarray) -> np.ndarray:
    status = np.full(len(out["s"]), "ok", dtype="U16")
    status[(out["gap"] > GAP_CIRCLE) | ~ellipse] = "circle_only"
    status[out["gap"] > GAP_NONE] = "one_sided"
    status[out["inliers"] < MIN_INLIERS] = "too_few_points"
    return status


def blank(out: dict[str, np.ndarray]) -> None:
    """NaN for what was not measured: nothing is invented."""
    for name in out:
        if name.startswith(OF_ELLIPSE):
            out[name] = np.where(out["status"] == "ok", out[name], np.nan)
        elif name.startswith(OF_SIZE):
            out[name] = np.where(np.isin(out["status"], MEASURED), out[name], np.nan)
    out["oval"] = out["oval"] & (out["status"] == "ok")


def rms_ovality(stations: dict[str, np.ndarray]) -> float:
    """Root of the mean square of the ovality along the pipe, each station with the same weight: the one average that
    noise does not raise, as squares may be had without its share. NaN where no station has an ellipse."""
    squares = stations["ovality_squared"]
    known = np.isfinite(squares)
    return math.sqrt(max(0.0, float(np.mean(squares[known])))) if known.any() else math.nan


def summary_of(tube: Tube, by_shape: np.ndarray, used: np.ndarray) -> dict[str, Any]:
    """The figures of a tube with stations. by_shape: what `stations_of` gave besides; used (N,): the finite points."""
    t = tube.stations
    good = np.isfinite(t["d_mean"])
    out: dict[str, Any] = {
        "length": tube.length,
        "points": len(used),
        "points_not_finite": int((~used).sum()),
        "order": tube.surface.order,
        "correlation": tube.surface.correlation,
        "converged": bool(tube.surface.converged),
        "stations": len(t["s"]),
        "measured": int(good.sum()),
        "pieces": len(tube.surface.pieces),
    }
    if not good.any():
        out["d_mean"] = float(2 * np.median(tube.frames(t["s"])["shape"][:, 0]))
        return out
    # A depth camera's far end must not count as its near one. What smoothing makes stations share is in the variance.
    weight = 1 / t["d_mean_sigma"][good] ** 2
    weight /= weight.sum()
    out["d_mean"] = float(weight @ t["d_mean"][good])
    by_mean = weight[:, None] * by_shape[good]
    out["d_mean_sigma"] = math.sqrt(tube.surface.variance(t["s"][good].tolist(), t["piece"][good].tolist(), by_mean))
    out["d_mean_spread"] = float(np.std(t["d_mean"][good]))
    oval = np.isfinite(t["ovality"])
    if oval.any():
        out["ovality_rms"] = rms_ovality(t)
        out["d_max"] = float(np.max(t["d_max"][oval]))
        out["d_min"] = float(np.min(t["d_min"][oval]))
    out["roughness"] = float(np.median(t["roughness"]))
    return out
