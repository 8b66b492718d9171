"""Fitting one model to the views of a calibration: starts without a guess, robust steps, rejection with reasons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _engine
from .calib_data import Array, CalibrationError, Data, compose, inverse
from .calib_model import Model
from .fit import _asymmetric_start

Mask = npt.NDArray[np.bool_]

THETA_END = 3.1415926535897927  # PF_CAMERA_THETA_MAX
_RAYLEIGH = math.sqrt(2 * math.log(2))  # median of the distance in units of sigma per axis
_HUBER = 5.0  # sigma: the mild bend; real corners have tails that Gaussian noise has not
_GROSS = 10.0  # sigma: a point beyond is no measurement of this corner
_SAME_POSE = 0.005  # of the picture's diagonal, a hand's tremor: points that moved less between frames show one pose


def errors_of(bundle: _engine.Bundle, data_pixels: Array) -> Array:
    """Distance of each point from where the bundle sees it, pixels; inf outside the model."""
    predicted, _ = bundle.predict()
    error = np.hypot(*(predicted - data_pixels).T)
    return np.where(np.isfinite(error), error, np.inf)


def angles(points: Array) -> Array:
    """Off the axis, radians, of points (N, 3) in the camera's frame."""
    return np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])


def noise_by_angle(error: Array, theta: Array, used: Mask) -> tuple[Array, Array]:
    """Robust standard deviations by the angle off the axis: knots (K,) radians, sigma (K,) pixels an axis."""
    order = np.argsort(theta[used], kind="stable")
    bins = int(np.clip(len(order) // 60, 1, 12))
    parts = np.array_split(order, bins)
    floor = 0.3 * float(np.median(error[used])) / _RAYLEIGH + 1e-9
    knots = np.array([np.median(theta[used][p]) for p in parts])
    sigma = np.array([max(float(np.median(error[used][p])) / _RAYLEIGH, floor) for p in parts])
    return knots, sigma


def flipped(pose: Array, centre: Array) -> Array:
    """The other pose that a plane seen from afar may have: its tilt reversed about the line of sight."""
    middle = pose[:, :3] @ centre + pose[:, 3]
    sight = middle / np.linalg.norm(middle)
    turn = 2 * np.outer(sight, sight) - np.eye(3)
    rotation = turn @ pose[:, :3] @ np.diag([-1.0, -1.0, 1.0])
    return np.column_stack([rotation, middle - rotation @ centre])


class Single:
    """One camera from nothing, of all its views or `views`: a pose for each, p6 and then p9, on flat boards."""

    def __init__(
        self,
        data: Data,
        camera: int,
        circle: tuple[float, float, float] | None = None,
        views: list[int] | None = None,
    ) -> None:
        self.data = data
        self.index = camera
        self.views = views or [v for v in range(len(data.views)) if data.camera_of[v] == camera]
        self.bundle = data.bundle(self.views, own_frames=True)
        points = np.concatenate([np.arange(data.first[v], data.first[v + 1]) for v in self.views])
        self.pixels = data.pixels[points]
        self.counts = [int(data.first[v + 1] - data.first[v]) for v in self.views]
        self.part = np.repeat(np.arange(len(self.views)), self.counts)
        self.lost = np.zeros(len(self.views), dtype=bool)
        self._start(circle)
        self._rescue()

    def _start(self, circle: tuple[float, float, float] | None) -> None:
        width, height = self.data.size[self.index]
        c_u, c_v = circle[:2] if circle else ((width - 1) / 2, (height - 1) / 2)
        best: tuple[float, Any, Mask] | None = None
        for classical in (False, True):  # nearly every lens is found from the equidistant start
            for profile, median, _ in self.bundle.sweep(self.index, width, height, c_u, c_v, classical):
                if best is not None and (best[0] < 0.0004 * max(width, height) or median > 5 * best[0] + 20):
                    break
                tried = self._try(profile)
                if tried is not None and (best is None or tried[0] < best[0]):
                    best = tried
            if best is not None and best[0] < 0.0004 * max(width, height):
                break
        if best is None:
            raise CalibrationError(
                "no lens explains the views: the points do not fit a board of this geometry (rows, columns or order "
                "wrong), or too few of its points are seen"
            )
        self.median, self.bundle, self.lost = best

    def _try(self, profile: Any) -> tuple[float, Any, Mask] | None:
        bundle = self.bundle.copy()
        profile.theta_max = _engine.rising_end(profile, THETA_END)
        bundle.set_camera(self.index, profile)
        lost = np.zeros(len(self.views), dtype=bool)
        for v in range(len(self.views)):
            pose = bundle.view_pose(v)
            lost[v] = pose is None
            if pose is not None:
                bundle.set_frame(v, pose)
        profile.theta_max = THETA_END
        bundle.set_camera(self.index, profile)
        bundle.huber = 1.5
        for radial, rounds in ((1, 12), (1, 12), (4, 25)):
            error = errors_of(bundle, self.pixels)
            usable = np.isfinite(error) & ~lost[self.part]
            if usable.sum() < 12:
                return None
            scale = float(np.median(error[usable]))
            bundle.set_used(usable & (error < 200 * scale + 1))
            bundle.set_sigma(np.full(len(error), scale / _RAYLEIGH + 1e-3))
            bundle.free_camera(self.index, Model(radial).parameters, False)
            _, points = bundle.predict()
            bundle.set_theta_end(self.index, min(1.02 * float(angles(points)[usable].max()), 3.1))
            if bundle.adjust(rounds, 1e-4)[0] == "outside":
                return None
        error = errors_of(bundle, self.pixels)
        return float(np.median(error[~lost[self.part]])), bundle, lost

    def view_errors(self, bundle: Any) -> Array:
        """Median distance of each view, pixels."""
        error = errors_of(bundle, self.pixels)
        return np.array([np.median(error[self.part == v]) for v in range(len(self.views))])

    def _rescue(self) -> None:
        """Poses of views that do not fit, anew by the camera as it is now: from rays, and with the tilt reversed."""
        errors = self.view_errors(self.bundle)
        bad = np.flatnonzero((errors > 4 * self.median + 0.05) | self.lost)
        if len(bad) == 0:
            return
        camera = self.bundle.camera(self.index)
        camera.theta_max = _engine.rising_end(camera, THETA_END)
        self.bundle.set_camera(self.index, camera)
        self.bundle.set_used(np.ones(len(self.pixels), dtype=bool))  # a lost view's points were not
        fresh = {int(v): self.bundle.view_pose(int(v)) for v in bad}
        camera.theta_max = THETA_END
        self.bundle.set_camera(self.index, camera)
        best = {int(v): (errors[v], self.bundle.frame(int(v))) for v in bad}
        for attempt in range(3):
            trial = self.bundle.copy()
            trial.free_camera(self.index, [], False)
            trial.set_used(np.isin(self.part, bad))
            for v, pose in fresh.items():
                board = self.data.boards[self.data.board_of[self.views[v]]]
                centre = np.array([*board.centre, 0.0])
                start = (self.bundle.frame(v) if attempt == 2 else pose) if pose is not None else self.bundle.frame(v)
                trial.set_frame(v, flipped(start, centre) if attempt > 0 and board.planar else start)
            trial.adjust(30, 1e-6)
            for v, error in enumerate(self.view_errors(trial)):
                if v in best and error < best[v][0]:
                    best[v] = (error, trial.frame(v))
        for v, (error, pose) in best.items():
            self.bundle.set_frame(v, pose)
            self.lost[v] = self.lost[v] and error > 4 * self.median + 0.05
        error = errors_of(self.bundle, self.pixels)
        usable = np.isfinite(error) & ~self.lost[self.part]
        if not usable.any():
            return
        self.bundle.set_used(usable)
        self.bundle.adjust(25, 1e-6)
        self.median = float(np.median(errors_of(self.bundle, self.pixels)[usable]))


class Fit:
    """All cameras, boards and frames in one bundle, under a model; what is used of the data and how noisy it is."""

    def __init__(self, data: Data) -> None:
        self.data = data
        self.bundle = data.bundle()
        self.model = Model()
        self.used: Mask = np.ones(len(data.pixels), dtype=bool)
        self.view_reason: dict[int, str] = {}
        self.notes: list[str] = []
        self.sigma = np.ones(len(data.pixels))
        self.noise: list[tuple[Array, Array]] = []
        self.camera_linked = [False] * len(data.cameras)  # by frames to another camera: its pose is an unknown
        self.board_linked = [False] * len(data.boards)

    def copy(self) -> Fit:
        """Of the state; the data are shared."""
        other = object.__new__(Fit)
        other.__dict__.update(self.__dict__)
        other.bundle = self.bundle.copy()
        other.used, other.sigma = self.used.copy(), self.sigma.copy()
        other.view_reason = dict(self.view_reason)
        return other

    def with_data(self, data: Data) -> Fit:
        """The same state with other points of the boards."""
        other = self.copy()
        other.data = data
        other.reload()
        return other

    def reload(self) -> None:
        """A bundle for the points of the boards as they are numbered now, in the state of the old one."""
        old, self.bundle = self.bundle, self.data.bundle()
        for c in range(len(self.data.cameras)):
            self.bundle.set_camera(c, old.camera(c))
            self.bundle.set_camera_pose(c, old.camera_pose(c))
            self.bundle.set_corner(c, old.corner(c), False)
        for b, board in enumerate(self.data.boards):
            self.bundle.set_board_pose(b, old.board_pose(b))
            self.bundle.set_shape(b, old.shape(b), *board.centre, board.half)
        for f in range(self.data.frames):
            self.bundle.set_frame(f, old.frame(f))
        self.bundle.set_used(self.used)
        self.bundle.set_sigma(self.sigma)

    # ------------------------------------------------------------------ state

    def errors(self) -> Array:
        """Distance of every point, pixels; inf outside the model."""
        return errors_of(self.bundle, self.data.pixels)

    def theta(self) -> Array:
        """Angle off the axis of every point, radians."""
        return angles(self.bundle.predict()[1])

    def rms(self, mask: Mask | None = None) -> float:
        """Root mean square distance over the used points, pixels."""
        chosen = self.errors()[self.used if mask is None else mask]
        return float(np.sqrt(np.mean(chosen**2))) if len(chosen) else math.nan

    def reject_view(self, view: int, reason: str) -> None:
        """Leaves a view out, for a reason in plain words."""
        self.view_reason[view] = reason
        self.used[self.data.of_view(view)] = False

    def free(self, model: Model) -> None:
        """Frees what the model says, and the rig; what it lacks becomes zero."""
        self.model = model
        for c in range(len(self.data.cameras)):
            self._clear(c, model)
            self.bundle.set_corner(c, self.bundle.corner(c) if model.corner else [0.0, 0.0], bool(model.corner))
        for b, board in enumerate(self.data.boards):
            kept = set(model.shape_terms)
            shape = [value if i in kept else 0.0 for i, value in enumerate(self.bundle.shape(b))]
            self.bundle.set_shape(b, shape, *board.centre, board.half)
        alive = self.used_views()
        for c in range(len(self.data.cameras)):
            self.bundle.free_camera(
                c, model.parameters if (self.data.camera_of[alive] == c).any() else [], self.camera_linked[c]
            )
        for b, board in enumerate(self.data.boards):
            seen = board.planar and (self.data.board_of[alive] == b).any()
            self.bundle.free_board(b, model.shape_terms if seen else [], self.board_linked[b])

    def _clear(self, index: int, model: Model) -> None:
        camera = self.bundle.camera(index)
        if model.asymmetry != "p23":
            for key in ("asym_radial", "asym_tangential"):
                setattr(camera, f"{key}_theta", [0.0] * 3)
                setattr(camera, f"{key}_phi", [0.0] * 4)
        terms = {"cpoly2": 8, "cpoly3": 14}.get(model.asymmetry, 0)
        camera.cpoly = [value if i < terms else 0.0 for i, value in enumerate(camera.cpoly)]
        if not model.pupil:
            camera.pupil_e1 = 0.0
        self.bundle.set_camera(index, camera)

    def used_views(self) -> npt.NDArray[np.int64]:
        """Views with a used point."""
        return np.unique(self.data.view_of[self.used])

    # ------------------------------------------------------------------ fitting

    def fit(self, model: Model, *, huber: float = _HUBER, iterations: int = 60, tolerance: float = 1e-10) -> str:
        """Adjusts everything under a model from the present state; -> how it ended."""
        if model.asymmetry == "p23" and self.model.asymmetry != "p23":
            self._asymmetric_starts()
        self.free(model)
        self.bundle.huber = huber
        self.bundle.set_used(self.used)
        self.bundle.set_sigma(self.sigma)
        theta = self.theta()
        for c in range(len(self.data.cameras)):
            mine = self.used & (self.data.camera_of[self.data.view_of] == c)
            if mine.any():
                self.bundle.set_theta_end(c, min(1.02 * float(theta[mine].max()), 3.1))
        return self.bundle.adjust(iterations, tolerance)[0]

    def freeze(self) -> None:
        """Leaves only the frames' poses free, with the points that are used now, in least squares."""
        for c in range(len(self.data.cameras)):
            self.bundle.free_camera(c, [], False)
            self.bundle.set_corner(c, self.bundle.corner(c), False)
        for b in range(len(self.data.boards)):
            self.bundle.free_board(b, [], False)
        self.bundle.set_used(self.used)

    def descend(self, model: Model) -> None:
        """Takes a state with more terms to one without: the radius is refitted, the others become zero."""
        for c in range(len(self.data.cameras)):
            camera = self.bundle.camera(c)
            if model.radial < 4:
                mine = self.used & (self.data.camera_of[self.data.view_of] == c)
                theta = np.linspace(0, float(self.theta()[mine].max()), 101)[1:, None]
                powers = theta ** np.array([1, 3, 5, 7, 9])
                radius = powers @ np.array([1.0, camera.k2, camera.k3, camera.k4, camera.k5])
                k = np.linalg.lstsq(powers[:, : model.radial + 1], radius, rcond=None)[0]
                camera.f_u, camera.f_v = camera.f_u * k[0], camera.f_v * k[0]
                camera.k2, camera.k3, camera.k4, camera.k5 = np.append(
                    k[1:] / k[0], np.zeros(4 - model.radial)
                ).tolist()
                self.bundle.set_camera(c, camera)

    def _asymmetric_starts(self) -> None:
        predicted, points = self.bundle.predict()
        for c in range(len(self.data.cameras)):
            mine = self.used & (self.data.camera_of[self.data.view_of] == c)
            if mine.any():
                camera = self.bundle.camera(c)
                _asymmetric_start(camera, points[mine], (self.data.pixels - predicted)[mine])
                self.bundle.set_camera(c, camera)

    def measure_noise(self, noise: str) -> None:
        """Standard deviations of points from the residuals: "field" by the angle off the axis, "uniform" for all."""
        error, theta = self.errors(), self.theta()
        self.noise = []
        for c in range(len(self.data.cameras)):
            mine = self.data.camera_of[self.data.view_of] == c
            if not (mine & self.used).any():
                self.noise.append((np.zeros(1), np.ones(1)))
                continue
            knots, sigma = noise_by_angle(error, theta, self.used & mine)
            self.noise.append((knots, sigma))
            uniform = max(float(np.median(error[self.used & mine])) / _RAYLEIGH, 1e-9)
            self.sigma[mine] = uniform if noise == "uniform" else np.interp(theta[mine], knots, sigma)

    def reject_points(self, limit: float = _GROSS) -> int:
        """Leaves out points that are no measurements, and takes back those that are; -> how many changed."""
        error = self.errors()
        good = error <= limit * self.noise_at() + 0.02
        for view in self.view_reason:
            good[self.data.of_view(view)] = False
        changed = int((good != self.used).sum())
        self.used = good
        return changed

    def noise_at(self) -> Array:
        """Standard deviation of every point by its angle, pixels an axis."""
        theta = self.theta()
        out = np.empty(len(theta))
        for c, (knots, sigma) in enumerate(self.noise):
            mine = self.data.camera_of[self.data.view_of] == c
            out[mine] = np.interp(theta[mine], knots, sigma)
        return out

    def misfits(self) -> list[int]:
        """Used views that the others' camera does not explain: well above what is usual, and above what a smooth map
        leaves of them."""
        medians = self.view_medians()
        overall = float(np.median(self.errors()[self.used]))
        found = []
        for v in np.flatnonzero(medians > max(4 * overall, 0.3)):
            smooth = smooth_error(self.data, int(v))
            above = medians[v] > 3 * smooth if smooth is not None else medians[v] > max(8 * overall, 0.5)
            if int(v) not in self.view_reason and above:
                found.append(int(v))
        return found

    def view_medians(self) -> Array:
        """Median distance of the points of each view, pixels."""
        error = self.errors()
        return np.array([np.median(error[self.data.of_view(v)]) for v in range(len(self.data.views))])


def view_pose(fit: Fit, view: int) -> Array:
    """Camera from our frame of the board (3, 4)."""
    data, bundle = fit.data, fit.bundle
    return np.ascontiguousarray(
        compose(
            bundle.camera_pose(int(data.camera_of[view])),
            bundle.frame(int(data.frame_of[view])),
            bundle.board_pose(int(data.board_of[view])),
        )
    )


# ---------------------------------------------------------------------- rigs


def _central(poses: Sequence[Array]) -> Array:
    """The one of several measurements of a motion that is nearest to the others."""
    if len(poses) < 3:
        return poses[0]

    def apart(a: Array, b: Array) -> float:
        turn = compose(inverse(a), b)
        return float(
            np.arccos(np.clip((np.trace(turn[:, :3]) - 1) / 2, -1, 1))
            + np.linalg.norm(turn[:, 3]) / (1 + np.linalg.norm(a[:, 3]))
        )

    scores = [np.median([apart(a, b) for b in poses]) for a in poses]
    return poses[int(np.argmin(scores))]


def assemble(fit: Fit, view_poses: dict[int, Array]) -> None:
    """Poses of cameras, boards and frames of a rig from the poses of the views (board to camera)."""
    data = fit.data
    cameras: dict[int, Array] = {}
    boards: dict[int, Array] = {}
    frames: dict[int, Array] = {}
    left = set(view_poses)
    while left:
        for unknown, known in (("frame", frames), ("board", boards), ("camera", cameras)):
            found: dict[int, list[Array]] = {}
            for v in sorted(left):
                c, b, f = int(data.camera_of[v]), int(data.board_of[v]), int(data.frame_of[v])
                pose = view_poses[v]
                if unknown == "frame" and f not in frames and c in cameras and b in boards:
                    found.setdefault(f, []).append(compose(inverse(cameras[c]), pose, inverse(boards[b])))
                if unknown == "board" and b not in boards and c in cameras and f in frames:
                    found.setdefault(b, []).append(compose(inverse(frames[f]), inverse(cameras[c]), pose))
                if unknown == "camera" and c not in cameras and b in boards and f in frames:
                    found.setdefault(c, []).append(compose(pose, inverse(compose(frames[f], boards[b]))))
            for key, poses in found.items():
                known[key] = _central(poses)
                if unknown == "board":
                    fit.board_linked[key] = True
                if unknown == "camera":
                    fit.camera_linked[key] = True
            if found:
                break
        else:
            left = {
                v
                for v in left
                if int(data.camera_of[v]) not in cameras
                or int(data.board_of[v]) not in boards
                or int(data.frame_of[v]) not in frames
            }
            if not left:
                break
            v = min(left)  # starts a part of the rig that nothing links to the others
            cameras.setdefault(int(data.camera_of[v]), np.eye(3, 4))
            if int(data.frame_of[v]) not in frames:
                boards.setdefault(int(data.board_of[v]), np.eye(3, 4))
    for c, pose in cameras.items():
        fit.bundle.set_camera_pose(c, np.ascontiguousarray(pose))
    for b, pose in boards.items():
        fit.bundle.set_board_pose(b, np.ascontiguousarray(pose))
    for f, pose in frames.items():
        fit.bundle.set_frame(f, np.ascontiguousarray(pose))


# ---------------------------------------------------------------------- what is wrong with a view


def smooth_error(data: Data, view: int) -> float | None:
    """Median distance, pixels, to the best smooth map from the board to the image, which exists whatever the lens is:
    a polynomial of degree 2 to 4; None for few points or a board that is not plane."""
    part = data.of_view(view)
    board, pixels = data.xyz[part], data.pixels[part]
    if not data.boards[data.board_of[view]].planar or len(board) < 15:
        return None
    x, y = ((board[:, :2] - board[:, :2].mean(axis=0)) / np.ptp(board[:, :2], axis=0).max() * 2).T
    degree = 4 if len(board) >= 45 else 3 if len(board) >= 30 else 2
    basis = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
    weight = np.ones(len(board))
    error = weight
    for _ in range(4):
        weighted = basis * weight[:, None] ** 2
        normal = weighted.T @ basis + 1e-9 * len(board) * np.eye(basis.shape[1])
        error = np.hypot(*(pixels - basis @ np.linalg.solve(normal, weighted.T @ pixels)).T)
        weight = 1 / (1 + (error / (2 * np.median(error) + 1e-9)) ** 2)
    return float(np.median(error))


def diagnose(data: Data, view: int) -> str:
    """Why a view fits no pose: its points' order, or its camera."""
    error = smooth_error(data, view)
    if error is None:
        return "no pose of the board explains it"
    pixels = data.pixels[data.of_view(view)]
    gaps = np.hypot(*(pixels[:, None] - pixels[None]).transpose(2, 0, 1))
    np.fill_diagonal(gaps, np.inf)
    if error > 0.2 * np.median(gaps.min(axis=1)):
        return "its points do not lie on the board as given: wrong board size (rows, columns), or their order is mixed"
    return "it shows the board, but not through this lens: the image of another camera, or another board"


def handedness(data: Data, view: int) -> int:
    """1 where the board's x to y turns as the image's u to v, -1 mirrored, 0 unclear."""
    part = data.of_view(view)
    if not data.boards[data.board_of[view]].planar:
        return 0
    board, pixels = data.xyz[part][:, :2], data.pixels[part]
    design = np.column_stack([board - board.mean(axis=0), np.ones(len(board))])
    solved = np.linalg.lstsq(design, pixels, rcond=None)[0][:2]
    determinant = float(np.linalg.det(solved))
    return int(np.sign(determinant)) if abs(determinant) > 1e-9 * np.abs(solved).max() ** 2 else 0


def poses_apart(fit: Fit) -> Array:
    """Number of the pose that each frame shows (F,), -1 for rejected ones: frames in which the targets' points lie
    nearly where they lie in an earlier one show the same, as in a burst. They are no independent witnesses."""
    data = fit.data
    alive = np.unique(data.frame_of[fit.used_views()])
    number = np.full(data.frames, -1)
    firsts: list[dict[tuple[int, int, bytes], Array]] = []
    for f in alive:
        shown = {
            (int(data.camera_of[v]), int(data.board_of[v]), xyz.tobytes()): pixel
            for v in np.flatnonzero(data.frame_of == f)
            for xyz, pixel in zip(data.views[v].board_xyz, data.views[v].pixels, strict=True)
        }
        near = _SAME_POSE * min(math.hypot(*size) for size in data.size)
        for k, first in enumerate(firsts):
            common = [key for key in shown if key in first]
            apart = [float(np.linalg.norm(shown[key] - first[key])) for key in common]
            if 2 * len(common) >= min(len(shown), len(first)) and np.median(apart) < near:
                number[f] = k
                break
        else:
            number[f] = len(firsts)
            firsts.append(shown)
    return number
