"""Calibration from views of boards: no guess, robust, with its uncertainty.

    result = pf.calibrate([pf.View(board_xyz, pixels), ...], image_size=(w, h))
    result.camera.save("profile.json")

The steps are Paper II's (initial internals, homographies on rays, poses, bundle adjustment) without its need of a data
sheet; then come the board's own shape, the pupil shift and smooth asymmetry, as far as held-out views accept them.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from . import __version__, _engine
from .calib_choice import choose
from .calib_circle import ImageEllipse, ellipses_of, lit_corners
from .calib_data import (
    Array,
    BoardFrame,
    CalibrationError,
    Data,
    View,
    check_views,
    compose,
    homogeneous,
    image_sizes,
)
from .calib_fit import Fit, Single, assemble, diagnose, smooth_error, view_pose
from .calib_mixed import refuse_two_cameras
from .calib_model import Model, named
from .calib_order import by_shape, consistent, same_side
from .calib_report import Uncertainty, covariance_of, describe
from .camera import PARAMETERS, Camera, Provenance
from .errors import ArgumentError, ProfileError

__all__ = ["Board", "Calibration", "CalibrationError", "View", "calibrate"]

_MOST_LOST = 0.3  # of the views; with more rejected, nobody knows which ones are right
_BEYOND = 1.15  # of the largest angle observed: farther out a polynomial is off by pixels (docs/calibration.md)
_BENDS = 2.0  # of the radius' slope where observation ends: a polynomial that bends more is no lens


@dataclasses.dataclass(frozen=True, eq=False)
class Board:
    """A board as it turned out. shape: its level ("flat", "z2", ...); warp_mm: largest height of a point over the
    best plane through them; aspect: how much longer X is than drawn against Y, shear: radians."""

    shape: str
    warp_mm: float
    aspect: float
    shear: float
    coefficients: tuple[float, ...]
    frame: BoardFrame = dataclasses.field(repr=False)
    pose: Array = dataclasses.field(repr=False)  #: rig of boards from this one (3, 4)

    def points(self, drawn: Array) -> Array:
        """Where drawn points (N, 3) of the user's frame really are, in the same frame, metres."""
        plane = self.frame.plane
        given = np.ascontiguousarray(np.asarray(drawn, dtype=np.float64) @ plane[:, :3].T + plane[:, 3])
        bundle = _engine.Bundle([0], [0], [0], [0, 1], given[:1], np.zeros((1, 2)))
        bundle.set_shape(0, list(self.coefficients), *self.frame.centre, self.frame.half)
        return (bundle.shape_at(0, given) - plane[:, 3]) @ plane[:, :3]


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """What `calibrate` found.

    camera: of camera 0 of the rig (cameras: all, by index). poses: camera from board for each view (V, 3, 4), NaN for
    rejected ones. camera_poses: camera from rig (3, 4) by index, the first one is the rig. boards: by index; board: the
    first one. rms: root mean square distance of the used points, pixels. covariance: (n, n) over
    camera.covariance_parameters. uncertainty: of projections, by camera. report: all of it, as plain values.
    """

    camera: Camera
    cameras: dict[int, Camera]
    camera_poses: dict[int, Array]
    poses: Array
    board: Board
    boards: dict[int, Board]
    rms: float
    covariance: Array
    covariances: dict[int, Array]
    uncertainty: dict[int, Uncertainty]
    model: str
    circle_radius: float
    corner_shifts: dict[int, tuple[float, float]]  #: of checkerboard corners by their detector, by camera (docs)
    _describe: Callable[[], dict[str, Any]] = dataclasses.field(repr=False)

    @functools.cached_property
    def report(self) -> dict[str, Any]:
        """Everything that a report shows (docs/calibration.md); made when first asked for."""
        return self._describe()

    def test(self, views: Sequence[View]) -> float:
        """Root mean square distance, pixels, over all points of other views: cameras and boards as they are, poses
        refitted. Raises CalibrationError for a view that no pose fits."""
        error, _ = self.residuals(views)
        return float(np.sqrt(np.mean((error**2).sum(axis=1))))

    def residuals(self, views: Sequence[View]) -> tuple[Array, Array]:
        """Of other views, as `test` does: measured minus projected pixels (N, 2) of all points, poses (V, 3, 4)."""
        for view in views:
            if view.camera not in self.cameras or view.board not in self.boards:
                raise ArgumentError(f"{view.label}: camera {view.camera} or board {view.board} was not calibrated")
        size = max(self.cameras) + 1
        sizes = [(self.camera.width, self.camera.height)] * size
        data = Data(views, sizes, self.circle_radius)
        data.boards = [self.boards[b].frame for b in data.board_ids]
        data.xyz = np.ascontiguousarray(
            np.concatenate([data.place(int(data.board_of[i]), v.board_xyz) for i, v in enumerate(views)])
        )
        fit = Fit(data)
        for i, c in enumerate(data.cameras):
            fit.bundle.set_camera(i, self.cameras[c]._profile)
            fit.bundle.set_corner(i, list(self.corner_shifts[c]), False)
        for i, b in enumerate(data.board_ids):
            board = self.boards[b]
            fit.bundle.set_shape(i, list(board.coefficients), *board.frame.centre, board.frame.half)
        poses: dict[int, Array] = {}
        for v in range(len(views)):
            pose = fit.bundle.view_pose(v)
            if pose is None:
                raise CalibrationError(f"{data.label(v)}: no pose of the board explains it")
            poses[v] = pose
        placed: set[int] = set()
        for v, pose in poses.items():
            camera = self.camera_poses[data.cameras[data.camera_of[v]]]
            board = self.boards[data.board_ids[data.board_of[v]]].pose
            fit.bundle.set_camera_pose(int(data.camera_of[v]), np.ascontiguousarray(camera))
            fit.bundle.set_board_pose(int(data.board_of[v]), np.ascontiguousarray(board))
            if int(data.frame_of[v]) not in placed:
                placed.add(int(data.frame_of[v]))
                start = np.linalg.inv(homogeneous(camera)) @ homogeneous(pose) @ np.linalg.inv(homogeneous(board))
                fit.bundle.set_frame(int(data.frame_of[v]), np.ascontiguousarray(start[:3]))
        for i, c in enumerate(data.cameras):  # the edge of the model must not stop a step
            profile = self.cameras[c]._profile
            end, profile.theta_max = profile.theta_max, 3.1415926535897927
            fit.bundle.set_camera(i, profile)
            profile.theta_max = end
        fit.bundle.huber = 3.0
        scale = np.median(fit.errors()) + 1e-6
        fit.bundle.set_sigma(np.full(len(data.pixels), scale))
        fit.bundle.adjust(30, 1e-8)
        fit.bundle.huber = 0.0
        fit.bundle.adjust(60, 1e-12)
        predicted, _ = fit.bundle.predict()
        return data.pixels - predicted, _view_poses(fit)


def _view_poses(fit: Fit) -> Array:
    """Camera from board, in the user's frames of boards, for each view (V, 3, 4)."""
    data = fit.data
    return np.array(
        [
            compose(
                view_pose(fit, v),
                data.renumbered.get(v, np.eye(3, 4)),
                data.boards[data.board_of[v]].plane,
            )
            for v in range(len(data.views))
        ]
    )


def calibrate(
    views: Sequence[View],
    image_size: Any,
    model: str = "auto",
    board: str = "shape",
    circle_radius: float = 0.0,
    *,
    noise: str = "",
    robust: bool = True,
    image_circle: Any = None,
    name: str = "",
    progress: Callable[[str, float], None] | None = None,
) -> Calibration:
    """Calibrates cameras from views of boards.

    image_size: (width, height), or one for each camera. model: "p6", "p9", "p23" (Paper II), or "auto": chosen by
    held-out views. board: "flat", or "shape": estimated too. circle_radius: metres, of circle targets, whose pixels are
    then centres of gravity of their images; 0 for corners. noise: "field" weights by the noise at each angle off the
    axis, "uniform" does not; by default the paper's models are fitted as in the paper, uniform, "auto" is not. robust:
    mild Huber loss, gross outliers left out; False: least squares of everything.
    image_circle: (u, v, radius) or ImageEllipse of a lens that does not fill the image, or a dictionary of them by
    camera. progress: called with what is done and its share. Raises CalibrationError with
    what is wrong with the views, ArgumentError for a wrong call.
    """
    views = list(views)
    if not all(isinstance(v, View) for v in views):
        raise ArgumentError("views: must be pipefish.View objects")
    asked = named(model, board)
    if noise not in ("", "field", "uniform"):
        raise ArgumentError(f"noise: must be 'field' or 'uniform', not {noise!r:.40}")
    noise = noise or ("field" if asked is None else "uniform")
    if not isinstance(circle_radius, int | float) or not 0 <= circle_radius < 10:
        raise ArgumentError(f"circle_radius: must be metres, at least 0, not {circle_radius!r:.40}")
    sizes = image_sizes(image_size, max((v.camera for v in views), default=0) + 1)
    check_views(views, sizes)
    lit = ellipses_of(image_circle, sorted({v.camera for v in views}))
    tell = progress or (lambda what, share: None)
    data = Data(views, [sizes[c] for c in sorted({v.camera for v in views})], float(circle_radius))
    tell("start values", 0.0)
    fit = _start(data, lit)
    tell("p9 on a flat board", 0.1)
    _settle(fit, Model(), noise, robust)
    notes = fit.notes
    _refuse_one_pose(fit)
    refuse_two_cameras(fit)
    flat = fit.copy()
    table: list[dict[str, Any]] = []
    shape = board == "shape" and any(b.planar for b in data.boards)
    if shape and robust:
        _by_shape(fit, noise)
    if asked is None:
        chosen, table = choose(fit, shape, lambda share: tell("choice of the model", 0.15 + 0.75 * share))
    else:
        chosen = asked if shape else dataclasses.replace(asked, shape="flat")
    if chosen != Model():
        fit.descend(chosen)
        _settle(fit, chosen, noise, robust)
    tell("uncertainty", 0.92)
    return _result(fit, flat, table, notes, noise, robust, lit, name)


def _start(data: Data, lit: dict[int, ImageEllipse]) -> Fit:
    """Every camera alone, then the rig."""
    refused = same_side(data)
    fit = Fit(data)
    fit.notes += [f"{data.label(v)}: its points were numbered mirrored; put right" for v in sorted(data.renumbered)]
    poses: dict[int, Array] = {}
    cameras = {}
    for c in range(len(data.cameras)):
        if (data.camera_of == c).sum() < 3:
            raise CalibrationError(f"camera {data.cameras[c]}: fewer than 3 views")
        of = lit.get(data.cameras[c])
        single = Single(data, c, of.circle if of else None)
        _refuse_nonsense(data, single)
        cameras[c] = single.bundle.camera(c)
        medians = single.view_errors(single.bundle)
        for i, v in enumerate(single.views):
            if v in refused:
                fit.reject_view(v, refused[v])
            elif single.lost[i] or medians[i] > max(8 * single.median, 0.5):
                fit.reject_view(v, diagnose(data, v))
            else:
                poses[v] = single.bundle.frame(i)
    _refuse_too_many(fit)
    assemble(fit, poses)
    if len(poses) > len({int(data.frame_of[v]) for v in poses}):  # a rig
        before = dict(data.renumbered)
        poses = consistent(fit, poses)
        turned = sorted(v for v in data.renumbered if before.get(v) is not data.renumbered[v])
        fit.notes += [f"{data.label(v)}: its points were numbered the other way round; put right" for v in turned]
        if turned:
            fit.reload()
            assemble(fit, poses)
    for c, profile in cameras.items():
        fit.bundle.set_camera(c, profile)
    return fit


def _refuse_nonsense(data: Data, single: Single) -> None:
    """Where the best lens leaves many pixels, points and board do not go together at all."""
    if single.median > 0.004 * max(data.size[single.index]):
        reasons = [diagnose(data, v) for v in single.views]
        raise CalibrationError(
            f"camera {data.cameras[single.index]}: no lens explains the views (the best leaves {single.median:.1f} "
            "px). "
            f"{data.label(single.views[0])}: {max(set(reasons), key=reasons.count)}"
        )


def _refuse_too_many(fit: Fit) -> None:
    """More rejected views than a few: which ones are right is not ours to say."""
    for c, camera in enumerate(fit.data.cameras):
        mine = [v for v in range(len(fit.data.views)) if fit.data.camera_of[v] == c]
        lost = [v for v in mine if v in fit.view_reason]
        if len(lost) > max(1, _MOST_LOST * len(mine)) or len(mine) - len(lost) < 3:
            who = f"camera {camera}: " if len(fit.data.cameras) > 1 else ""
            listed = "; ".join(f"{fit.data.label(v)}: {fit.view_reason[v]}" for v in lost[:4])
            raise CalibrationError(
                f"{who}{len(lost)} of {len(mine)} views do not fit the others ({listed}"
                f"{'; ...' if len(lost) > 4 else ''}): views of two cameras or two boards may be mixed"
            )


def _by_shape(fit: Fit, noise: str) -> None:
    """Numbers the views as the board's shape says, in as many turns as change something."""
    shaped = fit.copy()
    for _ in range(4):
        shaped.fit(Model(shape="z4"), iterations=15, tolerance=1e-5)  # z2 looks the same from both ends
        changed = by_shape(shaped)
        fit.notes += changed
        if not changed:
            break
    if fit.data.renumbered:
        fit.bundle = shaped.bundle
        fit.fit(Model(), iterations=30, tolerance=1e-8)
        fit.measure_noise(noise)


def _refuse_one_pose(fit: Fit) -> None:
    """Fewer than three poses of the board that differ say too little, however many views there are."""
    poses = _view_poses(fit)[fit.used_views()]
    distinct: list[Array] = []
    for pose in poses:
        near = False
        for other in distinct:
            turn = float(np.arccos(np.clip((np.trace(pose[:, :3] @ other[:, :3].T) - 1) / 2, -1, 1)))
            near |= turn < 0.02 and bool(np.linalg.norm(pose[:, 3] - other[:, 3]) < 0.03 * np.linalg.norm(pose[:, 3]))
        if not near:
            distinct.append(pose)
        if len(distinct) >= 3:
            return
    raise CalibrationError(
        f"the views show the board in {len(distinct)} pose{'s' if len(distinct) > 1 else ''} only: move and tilt it "
        "between views, at least 3 poses are needed, better 15"
    )


def _settle(fit: Fit, model: Model, noise: str, robust: bool) -> None:
    """Fits a model with noise and rejections that go with it."""
    if not robust:
        fit.sigma[:] = max(float(np.median(fit.errors()[fit.used])), 1e-6)
        fit.fit(model, huber=0.0, iterations=200, tolerance=1e-14)
        fit.measure_noise("uniform")
        return
    fit.measure_noise(noise)
    fit.fit(model, iterations=40, tolerance=1e-6)
    for _ in range(6):
        fit.measure_noise(noise)
        for v in fit.misfits():
            fit.reject_view(v, diagnose(fit.data, v))
        changed = fit.reject_points()
        data, error = fit.data, fit.errors()
        for v in range(len(fit.data.views)):
            part = data.of_view(v)
            kept = int(fit.used[part].sum())
            if v in fit.view_reason or kept >= 0.7 * len(fit.used[part]):
                continue
            smooth = smooth_error(data, v)  # corners found badly, or another lens?
            if kept < max(4, 0.4 * len(fit.used[part])) or not smooth or np.median(error[part]) > 2 * smooth:
                fit.reject_view(v, f"only {kept} of its {len(fit.used[part])} points fit")
        _refuse_too_many(fit)
        fit.fit(model, iterations=40, tolerance=1e-6)
        if changed <= 0.0005 * len(fit.used):
            break
    # In the valley of two products of small numbers that p23 is, a lens without asymmetry creeps for ever: a relative
    # gain of 1e-6 is a hundredth of one unit of chi square.
    fit.fit(model, tolerance=1e-6 if model.asymmetry == "p23" else 1e-10)


def _result(
    fit: Fit,
    flat: Fit,
    table: list[dict[str, Any]],
    notes: list[str],
    noise: str,
    robust: bool,
    lit: dict[int, ImageEllipse],
    name: str,
) -> Calibration:
    data = fit.data
    uncertainty = covariance_of(fit)
    poses = _view_poses(fit)
    for v in fit.view_reason:
        poses[v] = math.nan
    cameras = {
        number: _camera(fit, c, uncertainty[c], table, lit.get(number), name) for c, number in enumerate(data.cameras)
    }
    for c, number in enumerate(data.cameras):
        uncertainty[c].camera = cameras[number]
    boards = {number: _board(fit, b) for b, number in enumerate(data.board_ids)}

    def report() -> dict[str, Any]:
        return describe(fit, flat, table, notes, cameras, uncertainty, lit) | {"noise": noise, "robust": robust}

    first = data.cameras[0]
    return Calibration(
        camera=cameras[first],
        cameras=cameras,
        camera_poses={n: fit.bundle.camera_pose(c) for c, n in enumerate(data.cameras)},
        poses=poses,
        board=boards[data.board_ids[0]],
        boards=boards,
        rms=fit.rms(),
        covariance=cameras[first].covariance,
        covariances={n: cameras[n].covariance for n in data.cameras},
        uncertainty={n: uncertainty[c] for c, n in enumerate(data.cameras)},
        model=fit.model.name,
        circle_radius=data.circle_radius,
        corner_shifts={n: tuple(fit.bundle.corner(c)) for c, n in enumerate(data.cameras)},
        _describe=report,
    )


def _board(fit: Fit, index: int) -> Board:
    frame = fit.data.boards[index]
    coefficients = fit.bundle.shape(index)
    shaped = fit.bundle.shape_at(index, np.ascontiguousarray(frame.points))
    heights = shaped - shaped.mean(axis=0)
    warp = 0.0
    if frame.planar and fit.model.shape != "flat":
        normal = np.linalg.svd(heights, full_matrices=False)[2][2]
        warp = float(np.abs(heights @ normal).max() * 1e3)
    pose = fit.bundle.board_pose(index)
    return Board(
        shape=fit.model.shape if frame.planar else "flat",
        warp_mm=warp,
        aspect=coefficients[0],
        shear=coefficients[1],
        coefficients=tuple(coefficients),
        frame=frame,
        pose=pose,
    )


def _camera(
    fit: Fit,
    index: int,
    uncertainty: Uncertainty,
    table: list[dict[str, Any]],
    lit: ImageEllipse | None,
    name: str,
) -> Camera:
    """The camera as a profile: valid up to the farthest lit pixel, as far as data carry the radius (`_field_end`)."""
    profile = fit.bundle.camera(index)
    width, height = fit.data.size[index]
    mine = fit.used & (fit.data.camera_of[fit.data.view_of] == index)
    covered = float(fit.theta()[mine].max())
    values: dict[str, Any] = {
        key: getattr(profile, key) for key in ("f_u", "f_v", "c_u", "c_v", "skew", "k2", "k3", "k4", "k5", "pupil_e1")
    }
    for key in (
        "tilt",
        "asym_radial_theta",
        "asym_radial_phi",
        "asym_tangential_theta",
        "asym_tangential_phi",
        "cpoly",
    ):
        values[key] = tuple(getattr(profile, key))
    if lit:
        values |= dict(zip(("circle_u", "circle_v", "circle_radius"), lit.circle, strict=True))
    views = len(np.unique(fit.data.view_of[mine]))
    free = fit.model.parameters
    common: dict[str, Any] = {
        "width": width,
        "height": height,
        "name": name,
        "source": "target",
        "created": datetime.datetime.now(datetime.UTC).replace(microsecond=0),
        "rms_px": float(np.sqrt(np.mean(fit.errors()[mine] ** 2))),
        "held_out_rms_px": next((r["held_out_rms_px"] for r in reversed(table) if r["accepted"]), None),
        "provenance": Provenance(
            tool="pipefish",
            version=__version__,
            model_choice=f"{fit.model.name} {'by held-out views' if table else 'as asked'}"[:63],
            views=views,
            points=int(mine.sum()),
            held_out_views=views if table else 0,
        ),
        "covariance_parameters": tuple(PARAMETERS[p] for p in free),
        "covariance": uncertainty.covariance[np.ix_(free, free)],
    }
    wanted = _engine.rising_end(profile, _field_end(profile, lit_corners(lit, width, height), covered))
    error: ProfileError | None = None
    # What cannot be proved one-to-one is not promised: the field shrinks towards what was observed.
    for share in (1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.0, -0.02, -0.05):
        end = min(covered * (1 + 1e-9) + share * (wanted - covered), wanted) if share >= 0 else covered * (1 + share)
        try:
            return Camera(**values, **common, theta_max=end, theta_covered=min(covered, end))
        except ProfileError as failure:  # not proved one-to-one
            error = failure
    raise CalibrationError(f"the model that fits the views is no lens: {error}")


def _field_end(profile: Any, corners: Array, covered: float) -> float:
    """Angle up to which a camera is promised: of the farthest of pixels `corners` (N, 2) on the edge of what is lit, at
    most _BEYOND times the largest one observed and as long as the radius rises like there, within a factor of two:
    what bends more is the polynomial, not the lens."""
    far = float(
        np.hypot((corners[:, 0] - profile.c_u) / profile.f_u, (corners[:, 1] - profile.c_v) / profile.f_v).max()
    )
    grid = np.linspace(0, min(_BEYOND * covered, 3.1), 2000)
    coefficients = np.array([1.0, profile.k2, profile.k3, profile.k4, profile.k5])
    radius = grid[:, None] ** np.array([1, 3, 5, 7, 9]) @ coefficients
    slope = grid[:, None] ** np.array([0, 2, 4, 6, 8]) @ (coefficients * [1, 3, 5, 7, 9])
    usual = float(np.interp(covered, grid, slope))
    ends = (np.maximum.accumulate(radius) >= far * 1.005) | (
        (grid > covered) & ((slope < usual / _BENDS) | (slope > usual * _BENDS))
    )
    return max(covered, float(grid[np.argmax(ends)] if ends.any() else grid[-1]))
