"""The views of a calibration, checked, and as the engine's bundle wants them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from . import _engine
from .errors import ArgumentError, PipefishError

Array = npt.NDArray[np.float64]

_SMALLEST_M, _LARGEST_M = 1e-3, 50.0  # of what is seen of a board: beyond, the unit is not the metre


class CalibrationError(PipefishError):
    """Views that no calibration can come from; the message says which and why."""


@dataclasses.dataclass(frozen=True, eq=False)
class View:
    """Points of one board in one image.

    board_xyz: (M, 3) metres in the board's frame, any part of the board; (M, 2) is a flat one. pixels: (M, 2), the
    centre of the top-left pixel is (0, 0). board, camera: which one of a rig. name: views of one name show the same
    moment: they share the pose of the rig; "" shares with none. Raises ArgumentError.
    """

    board_xyz: Array
    pixels: Array
    board: int = 0
    camera: int = 0
    name: str = ""

    def __post_init__(self) -> None:
        try:
            xyz = np.array(self.board_xyz, dtype=np.float64)
            pixels = np.array(self.pixels, dtype=np.float64)
        except (TypeError, ValueError):
            raise ArgumentError(f"{self.label}: board_xyz and pixels must be arrays of numbers") from None
        if xyz.ndim == 2 and xyz.shape[1] == 2:
            xyz = np.column_stack([xyz, np.zeros(len(xyz))])
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise ArgumentError(f"{self.label}: board_xyz must be (M, 3), not {xyz.shape}")
        if pixels.shape != (len(xyz), 2):
            raise ArgumentError(f"{self.label}: pixels must be ({len(xyz)}, 2) as board_xyz says, not {pixels.shape}")
        if not np.isfinite(xyz).all() or not np.isfinite(pixels).all():
            raise ArgumentError(f"{self.label}: board_xyz and pixels must be finite")
        for key in ("board", "camera"):
            value = getattr(self, key)
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or not 0 <= value < 1000:
                raise ArgumentError(f"{self.label}: {key} must be a whole number from 0 to 999, not {value!r:.40}")
            object.__setattr__(self, key, int(value))
        if not isinstance(self.name, str):
            raise ArgumentError(f"view: name must be text, not {self.name!r:.40}")
        for key, value in (("board_xyz", xyz), ("pixels", pixels)):
            value.setflags(write=False)
            object.__setattr__(self, key, value)

    @property
    def label(self) -> str:
        """For messages."""
        return f"view {self.name!r}" if self.name else "view"


def homogeneous(pose: Array) -> Array:
    """(3, 4) -> (4, 4)."""
    return np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])


def inverse(pose: Array) -> Array:
    """Of a rigid motion (3, 4)."""
    return np.column_stack([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]])


def compose(*poses: Array) -> Array:
    """Product of rigid motions (3, 4), the last one first."""
    out = poses[0]
    for pose in poses[1:]:
        out = np.column_stack([out[:, :3] @ pose[:, :3], out[:, :3] @ pose[:, 3] + out[:, 3]])
    return out


@dataclasses.dataclass(eq=False)
class BoardFrame:
    """A board's drawn points: in a plane Z = 0 of their own where they are flat.

    plane: from the user's frame to ours (3, 4). centre, half: of the box of the points in ours, metres."""

    points: Array
    plane: Array
    planar: bool
    centre: tuple[float, float]
    half: float

    @classmethod
    def of(cls, points: Array) -> BoardFrame:
        """From all the points (N, 3) that were seen of it."""
        points = np.unique(points, axis=0)
        middle = points.mean(axis=0)
        extent = max(float(np.ptp(points, axis=0).max()), 1e-12)
        plane = np.eye(3, 4)
        planar = bool(np.abs(points[:, 2]).max() <= 1e-9 * extent)
        if not planar and len(points) > 3:
            _, sizes, axes = np.linalg.svd(points - middle, full_matrices=False)
            if sizes[2] <= 1e-6 * sizes[0]:
                planar = True
                axes[2] *= np.sign(np.linalg.det(axes))
                plane = np.column_stack([axes, -axes @ middle])
        ours = points @ plane[:, :3].T + plane[:, 3]
        low, high = ours.min(axis=0), ours.max(axis=0)
        centre = (low + high) / 2
        return cls(ours, plane, planar, (float(centre[0]), float(centre[1])), float((high - low)[:2].max() / 2) or 1.0)


class Data:
    """Views as arrays. Points of all views one after the other: xyz, pixels; view_of[i] is the view of point i."""

    def __init__(
        self, views: Sequence[View], image_size: Sequence[tuple[int, int]], circle_radius: float = 0.0
    ) -> None:
        self.views = list(views)
        self.size = list(image_size)
        self.circle_radius = circle_radius
        self.cameras = sorted({v.camera for v in self.views})
        self.board_ids = sorted({v.board for v in self.views})
        names: dict[str, int] = {}
        self.frame_of = np.array([names.setdefault(v.name or f"\0{i}", len(names)) for i, v in enumerate(self.views)])
        self.frames = len(names)
        self.renumbered: dict[int, Array] = {}  # motions of the board that gave a view's points other numbers
        self.camera_of = np.array([self.cameras.index(v.camera) for v in self.views])
        self.board_of = np.array([self.board_ids.index(v.board) for v in self.views])
        counts = [len(v.pixels) for v in self.views]
        self.first = np.concatenate([[0], np.cumsum(counts)]).astype(int)
        self.view_of = np.repeat(np.arange(len(self.views)), counts)
        self.pixels = np.ascontiguousarray(np.concatenate([v.pixels for v in self.views]))
        self.boards = [
            BoardFrame.of(np.concatenate([v.board_xyz for v in self.views if v.board == b])) for b in self.board_ids
        ]
        self.xyz = np.ascontiguousarray(
            np.concatenate([self.place(self.board_of[i], v.board_xyz) for i, v in enumerate(self.views)])
        )

    def copy(self) -> Data:
        """With points of its own; the views are shared."""
        other = object.__new__(Data)
        other.__dict__.update(self.__dict__)
        other.xyz, other.renumbered = self.xyz.copy(), dict(self.renumbered)
        return other

    def place(self, board: int, xyz: Array) -> Array:
        """The user's points of a board (index) in our frame of it."""
        plane = self.boards[board].plane
        return xyz @ plane[:, :3].T + plane[:, 3]

    def of_view(self, view: int) -> slice:
        """Its points."""
        return slice(int(self.first[view]), int(self.first[view + 1]))

    def label(self, view: int) -> str:
        """For messages: its number and, where it has one, its name."""
        name = self.views[view].name
        return f"view {view}" + (f" ({name})" if name else "")

    def bundle(self, views: Sequence[int] | None = None, *, own_frames: bool = False) -> _engine.Bundle:
        """The engine's bundle of all or some views; own_frames: no two views share a frame."""
        chosen = list(range(len(self.views))) if views is None else list(views)
        points = np.concatenate([np.arange(self.first[v], self.first[v + 1]) for v in chosen])
        counts = [int(self.first[v + 1] - self.first[v]) for v in chosen]
        bundle = _engine.Bundle(
            [int(self.camera_of[v]) for v in chosen],
            [int(self.board_of[v]) for v in chosen],
            list(range(len(chosen))) if own_frames else [int(self.frame_of[v]) for v in chosen],
            [0, *np.cumsum(counts).tolist()],
            np.ascontiguousarray(self.xyz[points]),
            np.ascontiguousarray(self.pixels[points]),
            self.circle_radius,
        )
        for i in sorted({int(self.board_of[v]) for v in chosen}):
            board = self.boards[i]
            bundle.set_shape(i, [0.0] * 41, *board.centre, board.half)
        bundle.set_parity(self.parity()[points])
        if self.circle_radius > 0:
            bundle.set_sheets(*(np.ascontiguousarray(vectors[points]) for vectors in self.disc_sheets()))
        return bundle

    def parity(self) -> Array:
        """Of each point (N,), +1 and -1 like the squares of a checkerboard; 0 where the points are no square grid of
        corners."""
        out = np.zeros(len(self.xyz))
        if self.circle_radius > 0:
            return out
        for i, board in enumerate(self.boards):
            mine = self.board_of[self.view_of] == i
            if not board.planar or len(board.points) < 4 or not mine.any():
                continue
            gaps = np.hypot(*(board.points[1:, :2] - board.points[0, :2]).T)
            step = gaps[gaps > 1e-6 * board.half].min()
            cell = (self.xyz[mine][:, :2] - board.points[0, :2]) / step
            if np.abs(cell - np.round(cell)).max() < 1e-3:
                out[mine] = 1.0 - 2.0 * (np.round(cell).astype(int).sum(axis=1) % 2)
        return out

    def disc_sheets(self) -> tuple[Array, Array, Array]:
        """Two unit vectors (N, 3) in the plane that touches each disc, and how the sheet bends along the first (to the
        bend's centre, 1/metres): of the board, of the wall that a sleeve around its Z axis lies on, or of the nearest
        discs."""
        across, down, bend = np.zeros_like(self.xyz), np.zeros_like(self.xyz), np.zeros_like(self.xyz)
        across[:, 0], down[:, 1] = 1.0, 1.0
        for i, board in enumerate(self.boards):
            if board.planar:
                continue
            mine = np.flatnonzero(self.board_of[self.view_of] == i)
            radius = np.hypot(board.points[:, 0], board.points[:, 1])
            if np.ptp(radius) < 1e-6 * radius.max():
                wall = np.hypot(*self.xyz[mine, :2].T)
                x, y = (self.xyz[mine, :2] / wall[:, None]).T
                bend[mine] = np.stack([-x / wall, -y / wall, 0 * x], axis=1)
                across[mine] = np.stack([-y, x, 0 * x], axis=1)
                down[mine] = [0.0, 0.0, 1.0]
                continue
            for k in mine:
                near = np.argsort(((board.points - self.xyz[k]) ** 2).sum(axis=1))[:9]
                _, _, axes = np.linalg.svd(board.points[near] - board.points[near].mean(axis=0))
                across[k], down[k] = axes[0], axes[1]
        return across, down, bend


def check_views(views: Sequence[View], sizes: Sequence[tuple[int, int]]) -> None:
    """Raises what makes a calibration impossible before it starts."""
    if len(views) < 3:
        raise CalibrationError(f"{len(views)} views are too few: give at least 3, better 15, tilted and near the rim")
    seen: dict[tuple[str, int, int], int] = {}
    for i, view in enumerate(views):
        first = seen.setdefault((view.name or f"\0{i}", view.board, view.camera), i)
        if first != i:
            raise CalibrationError(
                f"views {first} and {i} are both of board {view.board} by camera {view.camera} at '{view.name}': views "
                "of one name must differ in board or camera"
            )
        label = f"view {i}" + (f" ({view.name})" if view.name else "")
        if len(view.pixels) < 4:
            raise CalibrationError(f"{label}: {len(view.pixels)} points are too few: at least 4 are needed")
        if view.camera >= len(sizes) and len(sizes) > 1:
            raise ArgumentError(f"{label}: camera {view.camera} has no image_size")
        width, height = sizes[view.camera if len(sizes) > 1 else 0]
        outside = ((view.pixels < -1) | (view.pixels > [width, height])).any(axis=1)
        if outside.any():
            raise CalibrationError(
                f"{label}: {outside.sum()} points lie outside the image of {width} x {height}: another camera's image, "
                "or image_size is wrong"
            )
        extent = float(np.ptp(view.board_xyz, axis=0).max())
        if not _SMALLEST_M <= extent <= _LARGEST_M:
            raise CalibrationError(
                f"{label}: its points of the board lie within {extent:.3g} m: coordinates must be metres"
            )
        if len({p.tobytes() for p in view.board_xyz}) < len(view.board_xyz):
            raise CalibrationError(f"{label}: a point of the board is given twice")


def image_sizes(image_size: object, cameras: int) -> list[tuple[int, int]]:
    """One (width, height) for all cameras, or a list of one each."""
    try:
        given = np.array(image_size)
    except ValueError:
        given = np.array(None)
    if given.shape == (2,):
        given = np.tile(given, (cameras, 1))
    if given.ndim != 2 or given.shape[1:] != (2,) or given.dtype.kind not in "iu" or len(given) < cameras:
        raise ArgumentError(
            f"image_size: must be (width, height) in whole pixels, or one for each camera, not {image_size!r:.60}"
        )
    if (given < 1).any() or (given > 16384).any():
        raise ArgumentError("image_size: must be within 1 and 16384")
    return [(int(w), int(h)) for w, h in given]
