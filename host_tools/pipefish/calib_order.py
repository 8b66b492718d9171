"""Views whose points are numbered another way round: a board that looks the same after a turn has several numberings,
and a detector may take any. A lens alone does not mind; the board's shape and the rig do."""

from __future__ import annotations

import numpy as np

from .calib_data import Array, BoardFrame, CalibrationError, Data, compose, inverse
from .calib_fit import Fit, handedness, view_pose

_BETTER, _SURER = (
    0.6,
    25.0,
)  # of chi square: what another numbering must come down to, by five sigma more than noise can

_MOST_MIRRORED = 0.3  # of the views; with more, which side is the right one is not ours to say


def symmetries(board: BoardFrame) -> list[Array]:
    """Rigid motions (3, 4), the identity first, that carry the points of a plane board onto themselves."""
    found = [np.eye(3, 4)]
    if not board.planar or len(board.points) < 4:
        return found
    middle = np.array([*board.centre, 0.0])
    key = {tuple(k) for k in _grid(board.points, board.half)}
    for flip in (False, True):
        for quarter in range(4):
            c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
            rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            if flip:
                rotation = rotation @ np.diag([1.0, -1.0, -1.0])
            motion = np.column_stack([rotation, middle - rotation @ middle])
            moved = board.points @ rotation.T + motion[:, 3]
            if (flip or quarter) and {tuple(k) for k in _grid(moved, board.half)} == key:
                found.append(motion)
    return found


def _grid(points: Array, half: float) -> Array:
    return np.round(points[:, :2] / half * 1e6).astype(int)


def renumber(data: Data, view: int, motion: Array) -> None:
    """Gives the points of a view the numbers that they have after a motion of the board."""
    part = data.of_view(view)
    data.xyz[part] = data.xyz[part] @ motion[:, :3].T + motion[:, 3]
    data.renumbered[view] = compose(motion, data.renumbered.get(view, np.eye(3, 4)))


def same_side(data: Data) -> dict[int, str]:
    """Turns views around that are numbered mirrored against most others of their board and camera; -> those that
    cannot be, with the reason. Raises CalibrationError where too many are for one to know which are right."""
    refused: dict[int, str] = {}
    hands = np.array([handedness(data, v) for v in range(len(data.views))])
    for b in range(len(data.boards)):
        for c in range(len(data.cameras)):
            mine = np.flatnonzero((data.board_of == b) & (data.camera_of == c))
            usual = np.sign(hands[mine].sum())
            turned = min(int((hands[mine] > 0).sum()), int((hands[mine] < 0).sum()))
            if len(data.boards) == 1 and turned > max(1, _MOST_MIRRORED * len(mine)):  # of several, the rig tells
                raise CalibrationError(
                    f"{turned} of {len(mine)} views are numbered mirrored against the others: some pictures are "
                    "mirrored copies, were taken through a mirror, or show the target's back; take those of one kind"
                )
            for v in mine:
                if usual == 0 or hands[v] != -usual:
                    continue
                mirror = next((m for m in symmetries(data.boards[b]) if m[2, 2] < 0), None)
                if mirror is None:
                    refused[int(v)] = "its points are numbered mirrored against the other views"
                else:
                    renumber(data, int(v), mirror)
    return refused


def consistent(fit: Fit, poses: dict[int, Array]) -> dict[int, Array]:
    """Numbers the views of one rig alike, by the poses (board to camera) that the rig expects: -> poses for the views
    as they are numbered now."""
    data = fit.data
    out = dict(poses)
    for v, pose in poses.items():
        expected = view_pose(fit, v)
        board = data.boards[data.board_of[v]]
        choices = [m for m in symmetries(board) if m[2, 2] > 0]
        middle = np.array([*board.centre, 0.0])

        def off(motion: Array, pose: Array = pose, expected: Array = expected, middle: Array = middle) -> float:
            turned = compose(pose, inverse(motion))
            turn = np.trace(turned[:, :3] @ expected[:, :3].T)
            return float(np.arccos(np.clip((turn - 1) / 2, -1, 1)))

        best = min(choices, key=off)
        if best is not choices[0] and off(best) < 0.3 * off(choices[0]):
            renumber(data, v, best)
            out[v] = compose(pose, inverse(best))
    return out


def by_shape(fit: Fit) -> list[str]:
    """Turns views around whose points fit the board's shape clearly better in another numbering; -> what was done."""
    data = fit.data
    notes: list[str] = []
    alone = {v for v in fit.used_views() if (data.frame_of == data.frame_of[v]).sum() == 1}
    options = {b: [m for m in symmetries(board)[1:] if m[2, 2] > 0] for b, board in enumerate(data.boards)}
    frozen = fit.copy()
    frozen.freeze()
    base = _chi_square(frozen)
    best = {v: (base[v], np.eye(3, 4)) for v in alone}
    for number in range(max((len(o) for o in options.values()), default=0)):
        turned = data.copy()
        motions: dict[int, Array] = {}
        for v in alone:
            choices = options[int(data.board_of[v])]
            if number < len(choices):
                motions[v] = choices[number]
                renumber(turned, v, choices[number])
        trial = fit.with_data(turned)
        for v, motion in motions.items():
            f, b = int(data.frame_of[v]), fit.bundle.board_pose(int(data.board_of[v]))
            moved = compose(fit.bundle.frame(f), b, inverse(motion), inverse(b))
            trial.bundle.set_frame(f, np.ascontiguousarray(moved))
        trial.freeze()
        trial.bundle.adjust(10, 1e-6)
        score = _chi_square(trial)
        for v, motion in motions.items():
            if score[v] < best[v][0]:
                best[v] = (score[v], motion)
    changed = [v for v in sorted(best) if best[v][0] < _BETTER * base[v] - _SURER]
    for v in changed:
        renumber(data, v, best[v][1])
        f, b = int(data.frame_of[v]), fit.bundle.board_pose(int(data.board_of[v]))
        moved = compose(fit.bundle.frame(f), b, inverse(best[v][1]), inverse(b))
        notes.append(f"{data.label(v)}: its points were numbered the other way round; put right")
        fit.bundle.set_frame(f, np.ascontiguousarray(moved))
    if changed:
        fit.reload()
    return notes


def _chi_square(fit: Fit) -> Array:
    data = fit.data
    square = np.where(fit.used, np.minimum(fit.errors() / fit.sigma, 10.0) ** 2, 0.0)
    return np.bincount(data.view_of, weights=square, minlength=len(data.views))
