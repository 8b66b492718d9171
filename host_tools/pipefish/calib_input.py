"""What a calibration starts from: pictures, surveys, and files of points that another program found."""

from __future__ import annotations

import csv
import dataclasses
import functools
import hashlib
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .calib_data import CalibrationError, View
from .errors import FormatError, PipefishError
from .files import PICTURES, opened_picture
from .target import Target

Array = npt.NDArray[np.float64]

CORNERS = (".csv", ".vnl", ".orpc")
SURVEYS = (".mcap", ".partial")
TELEMETRY = "telemetry.csv"  # of a recording: no corners


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """One picture of one camera. name: the moment, by which pictures of a rig belong together; place: for messages."""

    name: str
    camera: int
    place: str
    _load: Callable[[], npt.NDArray[Any]] = dataclasses.field(repr=False)

    def image(self) -> npt.NDArray[np.uint8]:
        """(H, W), read anew each time. Raises FormatError, OSError."""
        from .detect import grey

        return grey(self._load())


@dataclasses.dataclass(frozen=True, eq=False)
class Target3D:
    """What points are on: a target, or only its points. points: (N, 3) metres; radius: of discs, 0 for corners."""

    name: str
    points: Array
    radius: float
    target: Target | None


@dataclasses.dataclass(eq=False)
class Given:
    """What there is to calibrate from. views: points that came as such; empty where `pictures` are to be searched.

    copies: pictures that are left out, (camera, name, name of the one that is the same)."""

    cameras: list[str]
    targets: list[Target3D]
    pictures: list[Picture]
    views: list[View]
    sizes: list[tuple[int, int]]
    copies: list[tuple[int, str, str]] = dataclasses.field(default_factory=list)

    def label(self, camera: int, name: str) -> str:
        """A view for messages."""
        return f"{self.cameras[camera]}/{name}" if len(self.cameras) > 1 else name


def load_target(path: Path) -> Target3D:
    """A target's JSON, or the .dsc of BabelCalib's corner lists (its points in centimetres)."""
    if path.suffix.lower() == ".dsc":
        rows = [line.split(",") for line in _text(path).splitlines()]
        try:
            points = np.array([[float(x) / 100 for x in row[3:6]] for row in rows if len(row) == 6])
        except ValueError as error:
            raise FormatError(path, None, f"not a .dsc: {error}") from None
        if not len(points):
            raise FormatError(path, None, "no points: lines of six values")
        return Target3D(path.stem, points, 0.0, None)
    if path.suffix.lower() == ".pdf":
        raise FormatError(path, None, "is the sheet to print; the target is the .json that lies beside it")
    target = Target.load(path)
    return Target3D(path.stem, target.points(), target.radius_m if target.has_circles else 0.0, target)


def load_views(
    sources: dict[str, list[Path]], targets: Sequence[Target3D], size: tuple[int, int] | None = None
) -> Given:
    """Everything in files and folders, by the camera's name. size: (width, height), for points whose files do not say.

    Raises FormatError with file and place, CalibrationError where pictures do not go together."""
    given = Given(list(sources), list(targets), [], [], [])
    sizes: dict[int, tuple[int, int]] = {}
    kinds: set[str] = set()
    known: dict[tuple[int, bytes], str] = {}  # names of pictures by camera and content
    for camera, paths in enumerate(sources.values()):
        files = [file for path in paths for file in _files(path)]
        kinds |= {"corners" if f.suffix.lower() in CORNERS else "pictures" for f in files}
        if len(kinds) > 1:
            raise PipefishError("corner files and pictures are both given: give one or the other")
        for file in files:
            if file.suffix.lower() in CORNERS:
                views, found = _read_corners(file, camera, targets)
                given.views += views
                sizes[camera] = _same_size(sizes.get(camera), found, file)
            elif file.name.lower().endswith((".mcap", ".mcap.partial")):
                given.pictures += _keyframes(file, camera)
            else:
                name = file.stem if len(sources) > 1 else file.name
                content = (camera, hashlib.sha256(file.read_bytes()).digest())
                if content in known:
                    given.copies.append((camera, str(file) if name == known[content] else name, known[content]))
                    continue
                if any(p.name == name and p.camera == camera for p in given.pictures):
                    name = str(file)  # the same name in two folders
                known[content] = name
                given.pictures.append(Picture(name, camera, str(file), functools.partial(_open, file)))
        _refuse_sizes([f for f in files if f.suffix.lower() in PICTURES])
        if "corners" in kinds:
            beside = {p.parent for p in files} | set(filter(Path.is_dir, paths))
            given.pictures += _beside(beside, [v for v in given.views if v.camera == camera], camera)
        sizes[camera] = sizes.get(camera) or size or _picture_size(given, camera, bool(given.views))
    given.sizes = [sizes[c] for c in range(len(sources))]
    for camera in {camera for camera, _, _ in given.copies}:
        _refuse_copies(given, camera)
    return given


def _refuse_sizes(files: Sequence[Path]) -> None:
    """Raises CalibrationError where pictures have several sizes, FormatError where one cannot be read: at once."""
    by_size: dict[tuple[int, int], list[Path]] = {}
    damaged: list[FormatError] = []
    for file in files:
        try:
            with opened_picture(file) as opened:
                opened.load()
                by_size.setdefault(opened.size, []).append(file)
        except FormatError as error:
            damaged.append(error)
    if damaged:
        names = ", ".join(Path(e.path or "").name for e in damaged[1:6]) + (", ..." if len(damaged) > 6 else "")
        more = f" (and {len(damaged) - 1} more that cannot be read: {names})" if len(damaged) > 1 else ""
        raise FormatError(damaged[0].path, None, f"{damaged[0].reason}{more}")
    if len(by_size) < 2:
        return
    (usual, most), *odd = sorted(by_size.items(), key=lambda item: -len(item[1]))
    size, few = odd[0]
    more = f" and {len(few) - 1} more" if len(few) > 1 else ""
    raise CalibrationError(
        f"{few[0]}{more}: {size[0]} x {size[1]} pixels, {len(most)} of {len(files)} pictures have "
        f"{usual[0]} x {usual[1]}: images of two cameras, or of two settings of one, are mixed"
    )


def _refuse_copies(given: Given, camera: int) -> None:
    """Raises CalibrationError where hardly anything but copies was given."""
    different = sum(p.camera == camera for p in given.pictures)
    if different < 3:
        texts = [f"{given.label(c, name)} is the same picture as {first}" for c, name, first in given.copies]
        raise CalibrationError(
            f"only {different} different picture{'s' if different > 1 else ''}: {'; '.join(texts[:3])}"
            f"{'; ...' if len(texts) > 3 else ''}. At least 3 are needed, better 15, and the target moved in between"
        )


def _files(path: Path) -> list[Path]:
    """A file, or what is of use in a folder, in natural order."""
    if not path.is_dir():
        if not path.exists():
            raise FormatError(path, None, "no such file or folder")
        known = (*PICTURES, *CORNERS, *SURVEYS)
        if path.suffix.lower() not in known:
            raise FormatError(path, None, f"not a picture, survey or corner file: none of {', '.join(known)}")
        return [path]
    inside = [p for p in path.iterdir() if p.is_file() and not p.name.startswith(".") and p.name != TELEMETRY]
    for suffixes in (CORNERS, PICTURES, SURVEYS):  # corner lists often lie among their pictures
        found = [p for p in inside if p.suffix.lower() in suffixes]
        if found:
            return sorted(found, key=lambda p: natural(p.name))
    raise FormatError(path, None, f"no pictures ({', '.join(PICTURES)}) and no corner files ({', '.join(CORNERS)})")


def natural(name: str) -> list[tuple[int, str]]:
    """A key that puts img2 before img10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(path, None, "not text in UTF-8") from None


def _open(file: Path) -> npt.NDArray[Any]:
    with opened_picture(file) as opened:
        plain = opened.mode in ("L", "RGB", "I;16")
        return np.asarray(opened if plain else opened.convert("I;16" if opened.mode == "I" else "RGB"))


def _keyframes(path: Path, camera: int) -> list[Picture]:
    from .survey import Survey

    survey = Survey.open(path)
    return [
        Picture(f"keyframe {k.index}", camera, f"{path}: keyframe {k.index}", lambda k=k: np.asarray(k.image))
        for k in survey.keyframes
    ]


def _picture_size(given: Given, camera: int, corners: bool) -> tuple[int, int]:
    """Of the camera's first picture."""
    mine = [p for p in given.pictures if p.camera == camera]
    if not mine:
        if corners:
            raise PipefishError("the corner files do not say how large the pictures are: give --size WIDTHxHEIGHT")
        raise CalibrationError(f"camera {given.cameras[camera]}: no pictures")
    height, width = mine[0].image().shape
    return width, height


def _same_size(known: tuple[int, int] | None, new: tuple[int, int] | None, file: Path) -> Any:
    if known and new and known != new:
        raise CalibrationError(
            f"{file.name}: of a picture of {new[0]} x {new[1]}, the others have {known[0]} x {known[1]}: images of two "
            "cameras are mixed"
        )
    return known or new


def _beside(folders: Iterable[Path], views: Iterable[View], camera: int) -> list[Picture]:
    """Pictures that corner files were made from, where they lie beside them: only the report shows them."""
    found = []
    for view in views:
        for folder in folders:
            names = [folder / view.name, *(folder / f"{view.name}{s}" for s in PICTURES)]
            file = next((p for p in names if p.suffix.lower() in PICTURES and p.is_file()), None)
            if file is not None:
                found.append(Picture(view.name, camera, str(file), functools.partial(_open, file)))
                break
    return found


# ---------------------------------------------------------------------- points found by other programs


def _read_corners(path: Path, camera: int, targets: Sequence[Target3D]) -> tuple[list[View], tuple[int, int] | None]:
    match path.suffix.lower():
        case ".csv":
            return _csv(path, camera, targets), None
        case ".vnl":
            return _vnl(path, camera, targets), None
    return _orpc(path, camera, targets)


def _one_target(path: Path, targets: Sequence[Target3D]) -> Target3D:
    if len(targets) != 1:
        raise PipefishError(f"{path}: names no target: give exactly one --target for it")
    return targets[0]


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise FormatError(path, f"line {line}", f"{column}: {text!r:.40} is no number")
    return value


def _index(path: Path, line: int, column: str, text: str, end: int, what: str) -> int:
    if not text.strip().isdecimal() or int(text) >= end:
        raise FormatError(path, f"line {line}", f"{column}: {text!r:.40} is not a whole number below {end}, {what}")
    return int(text)


def _csv(path: Path, camera: int, targets: Sequence[Target3D]) -> list[View]:
    """Columns view, u, v; point (row of the target's points), or x, y, z in metres; optional board (number of the
    target). Other columns are errors; lines with # are left out."""
    lines = [(n, text) for n, text in enumerate(_text(path).splitlines(), 1) if text.strip() and text[0] != "#"]
    rows = list(csv.reader(text for _, text in lines))
    header = [name.strip() for name in rows[0]] if rows else []
    known = {"view", "point", "x", "y", "z", "u", "v", "board"}
    need = {"view", "u", "v"} | ({"point"} if "point" in header else {"x", "y", "z"})
    if len(set(header)) < len(header) or set(header) - known or need - set(header):
        raise FormatError(
            path,
            "line 1",
            f"columns {', '.join(header) or 'none'}: must be view,point,u,v or view,x,y,z,u,v (and board)",
        )
    found: dict[tuple[str, int], list[tuple[tuple[float, ...], float, float]]] = {}
    for (number, _), cells in zip(lines[1:], rows[1:], strict=True):
        if len(cells) != len(header):
            raise FormatError(path, f"line {number}", f"{len(cells)} cells, the header has {len(header)}")
        row = dict(zip(header, cells, strict=True))
        board = _index(path, number, "board", row.get("board", "0"), max(len(targets), 1), "the targets given")
        if "point" in row:
            if not targets:
                raise PipefishError(f"{path}: its points are numbers: give the --target that they are of")
            points = targets[board].points
            place = tuple(points[_index(path, number, "point", row["point"], len(points), "the target's points")])
        else:
            place = tuple(_number(path, number, key, row[key]) for key in "xyz")
        u, v = (_number(path, number, key, row[key]) for key in "uv")
        found.setdefault((row["view"].strip(), board), []).append((place, u, v))
    return [
        View([p for p, _, _ in points], [(u, v) for _, u, v in points], board, camera, name)
        for (name, board), points in found.items()
    ]


def _vnl(path: Path, camera: int, targets: Sequence[Target3D]) -> list[View]:
    """mrcal's corners: filename x y [level], all corners of a board row by row; a level below 0 or - is none."""
    target = _one_target(path, targets)
    found: dict[str, list[tuple[float, float] | None]] = {}
    for number, text in enumerate(_text(path).splitlines(), 1):
        cells = text.split()
        if not cells or text.startswith("#"):
            continue
        if len(cells) not in (3, 4):
            raise FormatError(path, f"line {number}", f"{len(cells)} cells; must be: filename x y level")
        corners = found.setdefault(cells[0], [])
        if cells[1] == "-":
            continue  # nothing was found in this picture
        pixel = (_number(path, number, "x", cells[1]), _number(path, number, "y", cells[2]))
        lost = len(cells) == 4 and (cells[3] == "-" or _number(path, number, "level", cells[3]) < 0)
        corners.append(None if lost else pixel)
    views = []
    for name, corners in found.items():
        if not corners:
            continue
        if len(corners) != len(target.points):
            raise FormatError(path, None, f"{name}: {len(corners)} corners, the target has {len(target.points)}")
        ids = [i for i, c in enumerate(corners) if c is not None]
        views.append(View(target.points[ids], [corners[i] for i in ids], 0, camera, Path(name).name))
    return views


def _orpc(path: Path, camera: int, targets: Sequence[Target3D]) -> tuple[list[View], tuple[int, int] | None]:
    """One picture's points of BabelCalib: width: and height: in the head, then rows board, point, 1, x, y."""
    head: dict[str, str] = {}
    found: dict[int, list[tuple[int, float, float]]] = {}
    for number, text in enumerate(_text(path).splitlines(), 1):
        if ":" in text and not text[:1].isdigit():
            key, _, value = text.partition(":")
            head[key.strip()] = value.strip()
            continue
        cells = text.split(",")
        if len(cells) != 5 or not text[:1].isdigit():
            continue
        board = _index(path, number, "board", cells[0], len(targets), "the targets given")
        point = _index(path, number, "point", cells[1], len(targets[board].points), "the target's points")
        found.setdefault(board, []).append(
            (point, _number(path, number, "x", cells[3]), _number(path, number, "y", cells[4]))
        )
    size = (int(head["width"]), int(head["height"])) if {"width", "height"} <= head.keys() else None
    views = [
        View(targets[b].points[[p for p, _, _ in rows]], [(x, y) for _, x, y in rows], b, camera, path.stem)
        for b, rows in sorted(found.items())
    ]
    return views, size
