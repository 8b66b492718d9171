"""What a calibration is worth: covariance, uncertainty of projections and of pipe diameters, coverage, residuals."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from . import _engine
from .calib_circle import ImageEllipse
from .calib_data import Array, CalibrationError
from .calib_fit import Fit, angles, handedness, poses_apart
from .camera import PARAMETERS, Camera
from .errors import ProfileError
from .intervals import Z95

DN = (100, 150, 200, 250, 300, 400, 500, 600, 800, 1000)  # millimetres: pipes that reports speak of
JACKKNIFE = 5  # parts
_AZIMUTHS = 24
_NEAR, _FAR = math.radians(30), math.radians(80)  # a wall point is seen at both: the spec's pair


@dataclasses.dataclass(eq=False)
class Uncertainty:
    """Covariance of one camera, and how the scene moves with it, for the uncertainty of projections.

    parameters (41, 41): covariance of the camera's, scaled by the residuals. motion (6, 41): the turn and shift of the
    scene, in the camera's frame, that takes most of a change of the parameters back over all the points of the targets:
    what a change of pose can do is no uncertainty of the camera.
    """

    covariance: Array
    motion: Array
    distance: float  #: metres: of the boards, median
    scale: float  #: of the residuals to what their noise says
    camera: Camera | None = None

    def _slopes(self, pixels: Array, distance: Array | float | None) -> Array:
        """Of where the points of pixels (N, 2) are seen, by the camera's parameters (N, 2, 41)."""
        assert self.camera is not None
        rays, _ = self.camera.unproject(pixels)
        given = np.broadcast_to(np.asarray(self.distance if distance is None else distance, dtype=float), len(pixels))
        near = np.isfinite(given)
        points = rays * np.where(near, given, 1.0)[:, None] + self.camera.origins(pixels)
        _, _, by_point, by_parameter = self.camera.project_jacobian(np.nan_to_num(points, nan=1.0))
        by_point = np.where(np.isfinite(rays).all(axis=1)[:, None, None], by_point, np.nan)
        return by_parameter + by_point @ _moved(points, near) @ self.motion

    def joint(self, pixels: Array, distance: Array | float | None = None) -> Array:
        """Covariance (2N, 2N) of where the points of `pixels` (N, 2) at `distance` metres (boards' median, inf: at
        infinity) are seen, after the motion of the scene that fits best: mrcal's cross-reprojection. NaN outside the
        model."""
        m = self._slopes(np.atleast_2d(np.asarray(pixels, dtype=float)), distance)
        m = m.reshape(2 * len(m), -1)
        return m @ self.covariance @ m.T

    def covariances(self, pixels: Array, distance: Array | float | None = None) -> Array:
        """The blocks of `joint` of each pixel, (N, 2, 2)."""
        m = self._slopes(np.atleast_2d(np.asarray(pixels, dtype=float)), distance)
        return m @ self.covariance @ m.swapaxes(1, 2)

    def sigma(self, pixels: Array, distance: float | None = None) -> Array:
        """Standard deviation (N,) in the worst direction, pixels, of where points are seen; see `joint`."""
        c = self.covariances(pixels, distance)
        half, difference = (c[:, 0, 0] + c[:, 1, 1]) / 2, (c[:, 0, 0] - c[:, 1, 1]) / 2
        return np.sqrt(np.maximum(half + np.hypot(difference, c[:, 0, 1]), 0.0))

    def diameter(self, dn_mm: float) -> dict[str, float]:
        """What the calibration alone leaves open of the mean diameter of a pipe, millimetres, one standard deviation:
        wall points seen at 30 and at 80 degrees (or as far as the camera was observed) along each azimuth."""
        assert self.camera is not None
        camera = self.camera
        near, far = _angles_of_wall(camera)
        phi = 2 * math.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
        radius = dn_mm / 2000
        pixels, by_theta, reach = [], [], []
        for theta in (near, far):
            points = np.stack([np.cos(phi), np.sin(phi), np.full(len(phi), 1 / math.tan(theta))], axis=1) * radius
            nudged = points * [1, 1, 0] + [0, 0, 1] * (radius / np.tan(theta + 1e-6 * np.ones(len(phi))))[:, None]
            at, seen = camera.project(points)
            beside, _ = camera.project(nudged)
            seen &= camera.in_image(np.nan_to_num(at, nan=-1e9))
            pixels.append(np.where(seen[:, None], at, np.nan))
            by_theta.append((beside - at) / 1e-6)
            reach.append(np.full(len(phi), radius / math.sin(theta)))
        both = np.isfinite(pixels[0]).all(axis=1) & np.isfinite(pixels[1]).all(axis=1)
        if both.sum() < 3:
            return {"dn_mm": dn_mm, "sigma_mm": math.nan}
        joint = self.joint(
            np.concatenate([pixels[0][both], pixels[1][both]]), np.concatenate([reach[0][both], reach[1][both]])
        )
        base = 1 / math.tan(near) - 1 / math.tan(far)
        row = []
        for sign, theta, slope in ((1, near, by_theta[0][both]), (-1, far, by_theta[1][both])):
            to_theta = -slope / (slope**2).sum(axis=1)[:, None]  # a pixel off is a bearing off, the other way round
            row.append(sign / math.sin(theta) ** 2 / base * to_theta.reshape(-1) / both.sum())
        weights = np.concatenate(row)
        return {"dn_mm": dn_mm, "sigma_mm": float(dn_mm * math.sqrt(max(weights @ joint @ weights, 0.0)))}


def _angles_of_wall(camera: Camera) -> tuple[float, float]:
    """Off the axis: where two points of the wall on one line along the pipe are seen."""
    far = min(_FAR, (camera.theta_covered or camera.theta_max) * 0.98)
    return min(_NEAR, far * 0.4), far


def _diameter_by(other: Camera, camera: Camera, dn_mm: float) -> float:
    """The mean diameter, millimetres, that `other` measures where `camera` sees a pipe of dn_mm; NaN out of sight. The
    one is turned to the other first: where the axis points is in the poses, and asymmetry can turn it by a degree."""
    phi = 2 * math.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    slope = 1 / np.tan(_angles_of_wall(camera))
    wall = np.stack([np.stack([np.cos(phi), np.sin(phi), np.full(len(phi), s)], axis=1) for s in slope]) * dn_mm / 2000
    pixels, seen = camera.project(wall.reshape(-1, 3))
    seen &= camera.in_image(np.nan_to_num(pixels, nan=-1e9))
    pixels = np.where(seen[:, None], pixels, 0.0)
    ours, _ = camera.unproject(pixels)
    theirs, fine = other.unproject(pixels)
    use = (seen & fine).reshape(2, -1).all(axis=0)
    if use.sum() < 3:
        return math.nan
    both = np.tile(use, 2)
    u, _, vt = np.linalg.svd(ours[both].T @ theirs[both])
    rays = (theirs @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T).reshape(2, -1, 3)[:, use]
    near, far = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    start = other.origins(pixels)[:, 2].reshape(2, -1)[:, use]
    return 2000 * float(np.mean(((wall[0, use, 2] - wall[1, use, 2]) - (start[0] - start[1])) / (near - far)))


def _cross(v: Array) -> Array:
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - out.swapaxes(-1, -2)


def _moved(points: Array, near: Array | bool = True) -> Array:
    """How points (N, 3) answer to a small turn and shift, (N, 3, 6); those at infinity (near False) do not shift."""
    return np.concatenate([-_cross(points), np.eye(3) * np.broadcast_to(near, len(points))[:, None, None]], axis=2)


def covariance_of(fit: Fit) -> list[Uncertainty]:
    """Of every camera, from the state of a fit. Raises CalibrationError where the views leave something open."""
    data, bundle = fit.data, fit.bundle
    fit.free(fit.model)
    bundle.set_used(fit.used)
    bundle.set_sigma(fit.sigma)
    bundle.huber = 0.0
    frames = np.unique(data.frame_of[fit.used_views()])
    camera_at, _, _, _, _, size = bundle.layout()
    whitened = fit.errors()[fit.used] / fit.sigma[fit.used]
    freedom = 2 * int(fit.used.sum()) - size - 6 * len(frames)
    if freedom <= 0:
        raise CalibrationError("fewer measurements than unknowns: give more views")
    square = float((whitened**2).sum()) / freedom
    try:
        border = bundle.uncertainty() * square
    except ValueError:
        raise CalibrationError(
            "the views do not determine the camera: show the board from different sides, tilted, and near the rim too"
        ) from None
    _, points = bundle.predict()
    out = []
    for c in range(len(data.cameras)):
        slope = np.zeros((len(PARAMETERS), size))
        own = bundle.parameter_slope(c)
        if camera_at[c] >= 0:
            slope[:, camera_at[c] : camera_at[c] + own.shape[1]] = own
        covariance = slope @ border @ slope.T
        mine = fit.used & (data.camera_of[data.view_of] == c)
        seen = np.ascontiguousarray(points[mine])
        _, fine, by_point, by_parameter = bundle.camera(c).project_jacobian(seen)
        weight = np.where(fine, 1 / fit.sigma[mine], 0.0)[:, None, None]
        by_point, by_parameter = np.nan_to_num(by_point), np.nan_to_num(by_parameter)
        by_motion = (by_point @ _moved(seen) * weight).reshape(-1, 6)
        motion = -np.linalg.lstsq(by_motion, (by_parameter * weight).reshape(len(by_motion), -1), rcond=None)[0]
        out.append(
            Uncertainty(
                covariance=(covariance + covariance.T) / 2,
                motion=motion,
                distance=float(np.median(np.linalg.norm(points[mine], axis=1))),
                scale=math.sqrt(square),
            )
        )
        sigma_f = math.sqrt(max(out[-1].covariance[0, 0], 0.0)) / abs(bundle.camera(c).f_u)
        if not sigma_f < 0.05:
            raise CalibrationError(
                f"the views leave the focal length open by {100 * sigma_f:.0f} %: they show the board in one pose, or "
                "parallel to the image; tilt it, and show it near the rim too"
            )
    return out


# ---------------------------------------------------------------------- coverage

_THETA_STEP, _PHI_BINS = math.radians(10), 12


def coverage(
    fit: Fit, index: int, camera: Camera, uncertainty: Uncertainty, lit: ImageEllipse | None = None
) -> dict[str, Any]:
    """Points seen in cells of 10 degrees off the axis by 30 degrees around it, what of the image is empty, and where
    the next view should put the board: where a view tells most about projections that are uncertain."""
    data = fit.data
    mine = fit.used & (data.camera_of[data.view_of] == index)
    points = fit.bundle.predict()[1][mine]
    theta, phi = angles(points), np.arctan2(points[:, 1], points[:, 0]) % (2 * math.pi)
    rings = max(1, math.ceil(camera.theta_max / _THETA_STEP))
    counts = np.zeros((rings, _PHI_BINS), dtype=int)
    np.add.at(
        counts,
        (
            np.minimum((theta / _THETA_STEP).astype(int), rings - 1),
            (phi / (2 * math.pi) * _PHI_BINS).astype(int) % _PHI_BINS,
        ),
        1,
    )
    middle_theta = np.minimum((np.arange(rings) + 0.5) * _THETA_STEP, camera.theta_max * (1 - 1e-9))
    middle_phi = (np.arange(_PHI_BINS) + 0.5) * 2 * math.pi / _PHI_BINS
    t, p = np.meshgrid(middle_theta, middle_phi, indexing="ij")
    pixels, seen = camera.project(
        np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1).reshape(-1, 3)
    )
    pixels = np.nan_to_num(pixels, nan=-1e9)
    seen &= camera.in_image(pixels)
    inside = (seen & lit.inside(pixels) if lit else seen).reshape(counts.shape)
    sigma = np.full(counts.size, np.nan)
    where = inside.reshape(-1)
    sigma[where] = uncertainty.sigma(pixels[where])
    sigma = sigma.reshape(counts.shape)
    advice = "the whole image was seen"
    place = None
    if inside.any() and np.isfinite(sigma).any():
        worst = np.unravel_index(int(np.nanargmax(np.where(inside, sigma / np.sqrt(1 + counts), np.nan))), counts.shape)
        u, v = pixels.reshape(*counts.shape, 2)[worst]
        place = {
            "theta": float(middle_theta[worst[0]]),
            "phi": float(middle_phi[worst[1]]),
            "pixel": [float(u), float(v)],
            "sigma_px": float(sigma[worst]),
        }
        advice = (
            f"next view: the board near pixel ({u:.0f}, {v:.0f}), {math.degrees(place['theta']):.0f} degrees off the "
            f"axis, tilted; the calibration is known to ± {Z95 * sigma[worst]:.2g} px (95 %) there"
        )
        if lit is None and camera.theta_covered and place["theta"] > camera.theta_covered:
            advice += (
                " (farther out than the target was ever seen: skip it if the lens shows nothing of the room there)"
            )
    return {
        "theta_step": _THETA_STEP,
        "phi_bins": _PHI_BINS,
        "counts": counts.tolist(),
        "in_image": inside.tolist(),
        "sigma_px": [[None if math.isnan(s) else float(s) for s in row] for row in sigma],
        "share_covered": float((counts[inside] > 0).mean()) if inside.any() else 0.0,
        "next_view": place,
        "advice": advice,
    }


def uncertainty_map(
    camera: Camera, uncertainty: Uncertainty, lit: ImageEllipse | None = None, columns: int = 16
) -> dict[str, Any]:
    """Standard deviation of projections in the worst direction over a grid of pixels, at the boards' distance and at
    infinity; None outside the model and where nothing is lit."""
    rows = max(2, round(columns * camera.height / camera.width))
    u, v = np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    out: dict[str, Any] = {"u": u.tolist(), "v": v.tolist(), "distance_m": uncertainty.distance}
    for key, distance in (("sigma_px", None), ("sigma_infinity_px", math.inf)):
        sigma = uncertainty.sigma(grid, distance)
        sigma = np.where(lit.inside(grid), sigma, np.nan) if lit else sigma
        sigma = sigma.reshape(rows, columns)
        out[key] = [[None if math.isnan(s) else float(s) for s in row] for row in sigma]
    return out


# ---------------------------------------------------------------------- two halves


def halves_difference(fit: Fit) -> list[dict[str, float]]:
    """Calibrations from every other pose, compared where the targets' points are: their difference after the motion of
    the scene that fits each best, and what their own uncertainties expect of it; a ratio much above 1 is model error.
    One entry a camera."""
    data = fit.data
    pose_of_point = poses_apart(fit)[data.frame_of[data.view_of]]
    cameras, uncertainties = [], []
    for half in range(2):
        part = fit.copy()
        part.used = fit.used & (pose_of_point % 2 == half)
        part.fit(fit.model, iterations=40, tolerance=1e-8)
        try:
            uncertainties.append(covariance_of(part))
        except CalibrationError:  # half of the views may leave something open
            return []
        cameras.append([_bounded(part, c) for c in range(len(data.cameras))])
    predicted, points = fit.bundle.predict()
    out = []
    for c in range(len(data.cameras)):
        mine = np.flatnonzero(fit.used & (data.camera_of[data.view_of] == c))
        mine = mine[:: max(1, len(mine) // 1000)]
        seen, weight = points[mine], 1 / fit.sigma[mine]
        first, second = (_aligned(cameras[h][c], seen, predicted[mine], weight) for h in range(2))
        use = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
        distance = np.linalg.norm(seen[use], axis=1)
        expected = [
            _variance(uncertainties[h][c], cameras[h][c], predicted[mine][use], distance, fit, c) for h in (0, 1)
        ]
        difference = float(np.sqrt(np.mean((first - second)[use] ** 2)))
        predicted_difference = float(np.sqrt(expected[0] + expected[1]))
        out.append(
            {"rms_px": difference, "expected_px": predicted_difference, "ratio": difference / predicted_difference}
        )
    return out


def _aligned(profile: Any, points: Array, pixels: Array, weight: Array) -> Array:
    """Where a camera sees points (N, 3) after the motion that brings them nearest to `pixels`; NaN outside."""
    points = np.ascontiguousarray(points)
    for _ in range(5):
        seen, fine, by_point, _ = profile.project_jacobian(points)
        slope = (by_point @ _moved(points) * weight[:, None, None])[fine].reshape(-1, 6)
        step = np.linalg.lstsq(slope, ((pixels - seen) * weight[:, None])[fine].reshape(-1), rcond=None)[0]
        angle = float(np.linalg.norm(step[:3])) or 1e-300
        k = _cross(step[:3] / angle)
        rotation = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
        points = np.ascontiguousarray(points @ rotation.T + step[3:])
    seen, fine, _, _ = profile.project_jacobian(points)
    return np.where(fine[:, None], seen, np.nan)


def _bounded(fit: Fit, index: int) -> Any:
    """The camera of a fit, up to where it was observed."""
    profile = fit.bundle.camera(index)
    mine = fit.used & (fit.data.camera_of[fit.data.view_of] == index)
    profile.theta_max = _engine.rising_end(profile, float(fit.theta()[mine].max()))
    return profile


def _variance(uncertainty: Uncertainty, profile: Any, pixels: Array, distance: Array, fit: Fit, index: int) -> float:
    """Variance of projections along an axis: the mean over both and over the pixels (N, 2), points at (N,) metres."""
    uncertainty.camera = _camera_of(profile, fit, index)
    if uncertainty.camera is None:
        return math.nan
    return float(np.nanmean(np.trace(uncertainty.covariances(pixels, distance), axis1=1, axis2=2) / 2))


def _camera_of(profile: Any, fit: Fit, index: int) -> Camera | None:
    """A fitted camera, as far out as it is proved one-to-one."""
    width, height = fit.data.size[index]
    keys = ("f_u", "f_v", "c_u", "c_v", "k2", "k3", "k4", "k5", "pupil_e1")
    arrays = ("asym_radial_theta", "asym_radial_phi", "asym_tangential_theta", "asym_tangential_phi", "cpoly")
    values = {k: getattr(profile, k) for k in keys} | {k: tuple(getattr(profile, k)) for k in arrays}
    end = profile.theta_max
    for share in (1.0, 0.97, 0.94, 0.9, 0.8, 0.6):
        try:
            return Camera(width=width, height=height, theta_max=end * share, **values)
        except ProfileError:  # not proved one-to-one
            continue
    return None


def diameter_spread(fit: Fit, cameras: list[Camera]) -> list[list[float]]:
    """Standard deviations of pipes' mean diameters, millimetres, of each camera and each of DN, by how much they depend
    on which views there are: the jackknife over five parts of the poses. It sees what the noise does not tell: a lens
    or a target that is not what the model can be. [] for fewer than ten poses."""
    pose = poses_apart(fit)
    if pose.max() + 1 < 2 * JACKKNIFE:
        return []
    pose_of_point = pose[fit.data.frame_of[fit.data.view_of]]
    found = np.full((len(cameras), len(DN), JACKKNIFE), np.nan)
    for k in range(JACKKNIFE):
        part = fit.copy()
        part.used = fit.used & (pose_of_point % JACKKNIFE != k)
        part.fit(fit.model, iterations=40, tolerance=1e-8)
        for c, camera in enumerate(cameras):
            if not (part.used & (fit.data.camera_of[fit.data.view_of] == c)).any():
                continue  # all its views are in this part: what it depends on is not known
            other = _camera_of(_bounded(part, c), part, c)
            if other is not None:
                found[c, :, k] = [_diameter_by(other, camera, dn) for dn in DN]
    return (math.sqrt(JACKKNIFE - 1) * found.std(axis=2)).tolist()


# ---------------------------------------------------------------------- the report


def describe(
    fit: Fit,
    flat: Fit,
    table: list[dict[str, Any]],
    notes: list[str],
    cameras: dict[int, Camera],
    uncertainty: list[Uncertainty],
    lit: dict[int, ImageEllipse],
) -> dict[str, Any]:
    """Everything that a report of the calibration shows, as plain values."""
    data, error, theta = fit.data, fit.errors(), fit.theta()
    in_views = ~np.isin(data.view_of, list(fit.view_reason))
    residual = data.pixels - fit.bundle.predict()[0]
    hands = [handedness(data, v) for v in range(len(data.views))]
    mirrored = "every view shows the board mirrored: seen through a mirror, or its X and Y are not right and down"
    all_mirrored = hands and all(h <= 0 for h in hands) and any(h < 0 for h in hands)
    return {
        "model": fit.model.name,
        "rms_px": fit.rms(),
        "rms_all_px": fit.rms(in_views),
        "median_px": float(np.median(error[fit.used])),
        "flat_board": {
            "model": flat.model.name,
            "rms_px": flat.rms(),
            "median_px": float(np.median(flat.errors()[flat.used])),
        },
        "circle_radius_m": data.circle_radius,
        "points_used": int(fit.used.sum()),
        "points": len(fit.used),
        "freedom": {"camera": fit.model.freedom[0], "board": fit.model.freedom[1]},
        "models": table,
        "notes": [*notes, mirrored] if all_mirrored else list(notes),
        "views": [_view_row(fit, v, error, theta, hands[v]) for v in range(len(data.views))],
        "rejected_views": [
            {"view": v, "name": data.views[v].name, "reason": r} for v, r in sorted(fit.view_reason.items())
        ],
        "rejected_points": [
            {
                "view": int(data.view_of[i]),
                "point": int(i - data.first[data.view_of[i]]),
                "pixel": data.pixels[i].tolist(),
                "error_px": float(error[i]),
                "reason": f"{error[i]:.1f} px off where {fit.sigma[i]:.2f} px is the noise",
            }
            for i in np.flatnonzero(~fit.used & in_views)
        ],
        "residuals": {
            "view": data.view_of.tolist(),
            "pixel": data.pixels.tolist(),
            "residual": np.round(np.nan_to_num(residual, nan=1e9), 5).tolist(),
            "theta": np.round(theta, 6).tolist(),
            "used": fit.used.tolist(),
        },
        "boards": [
            {"board": n, "coefficients": list(fit.bundle.shape(b)), "flat": fit.model.shape == "flat"}
            for b, n in enumerate(data.board_ids)
        ],
        "cameras": _camera_rows(fit, cameras, uncertainty, lit, compared=bool(table)),
    }


def _view_row(fit: Fit, v: int, error: Array, theta: Array, hand: float) -> dict[str, Any]:
    """One view of the report."""
    points = fit.data.of_view(v)
    used = fit.used[points]
    return {
        "view": v,
        "name": fit.data.views[v].name,
        "camera": fit.data.views[v].camera,
        "board": fit.data.views[v].board,
        "used": v not in fit.view_reason,
        "reason": fit.view_reason.get(v, ""),
        "points": int(used.sum()),
        "rms_px": float(np.sqrt(np.mean(error[points][used] ** 2))) if used.any() else None,
        "theta_max": float(theta[points].max()),
        "mirrored": hand < 0,
    }


def _camera_rows(
    fit: Fit,
    cameras: dict[int, Camera],
    uncertainty: list[Uncertainty],
    lit: dict[int, ImageEllipse],
    compared: bool,
) -> list[dict[str, Any]]:
    """The cameras of the report; with what the halves of the views differ by where models were compared."""
    rows: list[dict[str, Any]] = []
    for c, number in enumerate(fit.data.cameras):
        camera = cameras[number]
        knots, sigma = fit.noise[c]
        rows.append(
            {
                "camera": number,
                "noise": {"theta": knots.tolist(), "sigma_px": sigma.tolist()},
                "residual_scale": uncertainty[c].scale,
                "corner_shift_px": list(fit.bundle.corner(c)),
                "coverage": coverage(fit, c, camera, uncertainty[c], lit.get(number)),
                "uncertainty": uncertainty_map(camera, uncertainty[c], lit.get(number)),
                "pipes": [uncertainty[c].diameter(dn) for dn in DN],
            }
        )
    if compared:
        for row, halves in zip(rows, halves_difference(fit), strict=False):
            row["halves"] = halves
        for row, spread in zip(rows, diameter_spread(fit, list(cameras.values())), strict=False):
            for pipe, spread_mm in zip(row["pipes"], spread, strict=True):
                pipe["spread_mm"] = spread_mm
    return rows
