"""Whether the target in the pictures has the size that was described, and what to describe instead."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from .calib_data import CalibrationError
from .calib_input import Target3D
from .target import Target

_SURE = 3  # pictures at least that show the same other size


def refuse_other_size(target: Target | None, seen: Sequence[tuple[int, int]], name: str, least: int = _SURE) -> None:
    """Raises CalibrationError where most pictures that show a grid, and at least `least`, show one of another size.
    seen: Detection.seen of each picture.

    Parts of a target are seen in another size each time; the same size in half of the pictures is the whole, unless
    others show more of it."""
    if target is None or target.kind not in ("checkerboard", "circles", "asymmetric-circles"):
        return  # marks tell which points these are
    sizes = Counter(_like(size, target) for size in seen if min(size) >= 2)
    if not sizes:
        return
    size, count = sizes.most_common(1)[0]
    want = target.points_shape
    smaller = size[0] <= want[0] and size[1] <= want[1]
    part = smaller and any(more[0] > size[0] or more[1] > size[1] for more in sizes)
    if size == want or 2 * count < sizes.total() or count < least or part:
        return
    raise CalibrationError(_text(target, size, count, len(seen), name))


def _like(size: tuple[int, int], target: Target) -> tuple[int, int]:
    """A size counted along the target's own rows, as far as the picture leaves that open: it may be turned."""
    cols, rows = size
    want = target.points_shape
    if target.kind != "asymmetric-circles":
        return size if (cols >= rows) == (want[0] >= want[1]) else (rows, cols)
    # Their lattice looks the same turned by 90 degrees.
    return want if abs(rows / 2 - want[0]) <= 0.5 and abs(2 * cols - want[1]) <= 1 else size


def _text(target: Target, size: tuple[int, int], count: int, pictures: int, name: str) -> str:
    want = target.points_shape
    more = 0 if target.has_circles else 1
    grid = f"{size[0] + more}x{size[1] + more}"

    def of(points: tuple[int, int]) -> str:
        if target.has_circles:
            return f"{points[0]} x {points[1]} circles"
        return f"{points[0]} x {points[1]} inner corners ({points[0] + 1} x {points[1] + 1} squares)"

    if size[0] >= want[0] and size[1] >= want[1]:
        word = "larger than described"
    elif size[0] <= want[0] and size[1] <= want[1]:
        word = "smaller than described"
    else:
        word = "not the one described"
    why = ""
    if more and size == (want[0] + 1, want[1] + 1):
        why = " It looks as if inner corners were given as --grid, which counts squares."
    elif (size[1], size[0]) == want:
        why = " Columns and rows are exchanged."
    return (
        f"the board in the pictures is {word}: {count} of {pictures} pictures show {of(size)}, described are "
        f"{of(want)}.{why} If that is so: pipefish target {target.kind} --grid {grid} "
        f"--spacing {1000 * target.spacing_m:g} -o {name}.json"
    )


def scale_text(targets: Sequence[Target3D]) -> str:
    """Where the lengths of a calibration come from, and what an error of 1 % there does: a target and its views may be
    scaled together without a change of any angle."""
    sources = []
    for one in targets:
        if one.target is None:
            sources.append(f"the points of {one.name}")
        elif one.target.kind == "sleeve":
            sources.append(f"{one.name}'s diameter of {1000 * one.target.diameter_m:g} mm")
        else:
            sources.append(f"{one.name}'s spacing of {1000 * one.target.spacing_m:g} mm")
    return (
        f"from {' and '.join(sources) or 'the points as given'}, as described: measure it. If all of it is 1 % off, "
        "the lens's angles stay right, and lengths (bend, distance between cameras, pupil shift) are 1 % off"
    )
