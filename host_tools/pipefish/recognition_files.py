"""Files and pictures of recognition: what `pipefish recognise` reads and writes."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import FormatError
from .files import PICTURES, opened_picture, write_atomically
from .matching import grey
from .matching_files import png, read_grey, read_pixels
from .recognition import ObjectModel, Recognition
from .roc_curve import Roc

MASKS = ("_mask", "_labels")  # what a mask's name ends with; labels are those of simulated objects
COLUMNS = (
    "scene",
    "object",
    "score",
    "sum_score",
    "present",
    "view",
    "segments",
    "matches",
    "seeds",
    "x0",
    "y0",
    "x1",
    "y1",
)
COLOURS = (
    (230, 60, 50),
    (60, 170, 255),
    (70, 210, 80),
    (255, 190, 30),
    (200, 100, 255),
    (40, 220, 210),
    (255, 120, 180),
)


def _listed(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)


def pictures_in(path: Path) -> list[Path]:
    """The pictures of a folder but for masks, by name, or the picture itself. Raises FormatError for none, OSError."""
    if path.is_file():
        return [path]
    found = [p for p in _listed(path) if not p.stem.endswith(MASKS)]
    if not found:
        raise FormatError(path, None, "no pictures (" + ", ".join(PICTURES) + ")")
    return found


def _mask_of(picture: Path) -> Path | None:
    """X_mask.png for X.png, X_color.png or X-color.png, beside it."""
    stems = {picture.stem, picture.stem.removesuffix("_color").removesuffix("-color")}
    names = {stem + ending for stem in stems for ending in MASKS}
    return next((p for p in _listed(picture.parent) if p.stem in names), None)


def _read_view(picture: Path, mask: Path | None) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """A picture and its mask: a file, or else what the picture's own alpha covers."""
    image = read_grey(picture)
    if mask is not None:
        values = read_grey(mask)
        return image, values > 0.5 * values.max()
    with opened_picture(picture) as opened:
        if "A" in opened.getbands():
            return image, np.asarray(opened.getchannel("A")) > 127
    return image, None


def read_models(path: str | os.PathLike[str], max_pixels: int) -> list[ObjectModel]:
    """Objects from a folder: each folder in it is an object with a picture a view (also in its folder `models`), each
    picture in it an object of one view. Raises FormatError, OSError."""
    top = Path(path)
    sets: list[tuple[str, list[Path]]] = []
    for folder in top.iterdir():
        if folder.is_dir():
            inner = folder / "models"
            sets.append((folder.name, pictures_in(inner if inner.is_dir() else folder)))
    sets += [(p.stem, [p]) for p in _listed(top) if not p.stem.endswith(MASKS)]
    if not sets:
        raise FormatError(top, None, "neither pictures nor folders of pictures of objects")
    out = []
    for name, views in sorted(sets):
        given = [_read_view(p, _mask_of(p)) for p in views]
        for picture, (image, mask) in zip(views, given, strict=True):
            if mask is not None and mask.shape != image.shape:
                raise FormatError(picture, None, f"is {image.shape[1]}x{image.shape[0]}, its mask is not")
        try:
            out.append(ObjectModel(name, given, [p.stem for p in views], max_pixels))
        except ValueError as error:
            raise FormatError(top, None, str(error)) from None
    return out


def read_scene(path: str | os.PathLike[str]) -> NDArray[np.generic]:
    """A scene's picture, with its colours, as recognise() takes it. Raises FormatError, OSError."""
    pixels = read_pixels(path)
    try:
        grey(pixels, "picture")
    except ValueError as error:
        raise FormatError(path, None, str(error)) from None
    return pixels


def read_truth(path: str | os.PathLike[str], scenes: Sequence[str], objects: Sequence[str]) -> set[tuple[str, str]]:
    """What is present: rows scene,object with that heading. A scene is named as its file, with or without the ending.

    Raises FormatError with the line, OSError."""
    try:
        rows = list(csv.reader(Path(path).read_text(encoding="utf-8").splitlines()))
    except UnicodeDecodeError:
        raise FormatError(path, None, "not text") from None
    if not rows or [word.strip() for word in rows[0][:2]] != ["scene", "object"]:
        raise FormatError(path, "line 1", "the heading is not scene,object")
    stems = {Path(name).stem: name for name in scenes}
    present = set()
    for number, row in enumerate(rows[1:], 2):
        if not row:
            continue
        scene, name = (word.strip() for word in (*row, "")[:2])
        known = scene if scene in scenes else stems.get(Path(scene).stem)
        if known is None:
            raise FormatError(path, f"line {number}", f"no scene is named {scene!r}")
        if name not in objects:
            raise FormatError(path, f"line {number}", f"no object is named {name!r}")
        present.add((known, name))
    return present


def as_table(found: Sequence[Recognition], scenes: Sequence[str]) -> str:
    """CSV, a row for each object in each scene; the box is that of the contours."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(COLUMNS)
    for r in found:
        box = r.box()
        corners = ["" if box is None else f"{v:.1f}" for v in box or (0, 0, 0, 0)]
        numbers = (f"{r.score:.4g}", f"{r.sum_score:.4g}", int(r.present), r.view, len(r.segments), r.matches, r.seeds)
        out.writerow((scenes[r.scene], r.object, *numbers, *corners))
    return text.getvalue()


def as_document(found: Sequence[Recognition], scenes: Sequence[str]) -> list[dict[str, Any]]:
    """The same with segments and contours, for JSON."""

    def lines(contours: Sequence[NDArray[np.float64]]) -> list[list[list[float]]]:
        return [np.round(line, 1).tolist() for line in contours]

    out = []
    for r in found:
        row: dict[str, Any] = {
            name: getattr(r, name) for name in ("object", "score", "sum_score", "present", "view", "matches", "seeds")
        }
        row["scene"], row["box"], row["extent"] = scenes[r.scene], r.box(), lines(r.extent)
        row["outline"] = lines(r.outline)
        row["segments"] = [
            {
                name: getattr(s, name)
                for name in ("score", "area", "coverage", "correlation", "evidence", "matches", "view")
            }
            | {"model_contours": lines(s.model_contours), "scene_contours": lines(s.scene_contours)}
            for s in r.segments
        ]
        out.append(row)
    return out


def draw_scene(image: NDArray[np.float32], found: Sequence[Recognition], objects: Sequence[str]) -> NDArray[np.uint8]:
    """(H,W,3): the scene, darker, with the contours of the objects that are present, each in its colour and named;
    thin: where all of the object would be."""
    from PIL import Image, ImageDraw, ImageFont

    grey = (255 * image).astype(np.uint8)
    picture = Image.fromarray(np.repeat((0.7 * grey).astype(np.uint8)[..., None], 3, axis=2))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(max(12, image.shape[1] // 45))
    here = [r for r in found if r.present]
    lit = np.asarray(picture).copy()
    for r in here:
        inside = r.mask(image.shape)
        lit[inside] = grey[inside, None]
    picture.paste(Image.fromarray(lit))
    width = max(2, image.shape[1] // 300)
    for r in here:
        colour = COLOURS[objects.index(r.object) % len(COLOURS)]
        for lines, thick in ((r.extent, 1), (r.contours(image.shape), width)):
            for line in lines:
                points = [tuple(p) for p in line]
                draw.line([*points, points[0]], fill=colour, width=thick, joint="curve")
    for r in here:
        colour = COLOURS[objects.index(r.object) % len(COLOURS)]
        x, y, right, _ = r.box() or (0, 0, 0, 0)
        text = f"{r.object} {r.score:.2f}"
        left, top, end, bottom = draw.textbbox((0, 0), text, font=font)
        at = (min(max(0, (x + right - end) / 2), image.shape[1] - end - 4), max(0, y - bottom - 6))
        draw.rectangle((at[0] - 3, at[1] + top - 2, at[0] + end + 3, at[1] + bottom + 2), fill=(0, 0, 0))
        draw.text((at[0] - left, at[1]), text, fill=colour, font=font)
    return np.asarray(picture)


def draw_roc(curves: Mapping[str, Roc], size: int = 640) -> NDArray[np.uint8]:
    """(H,W,3): ROC curves, the names with their areas beneath. The vertical axis starts where the curves do."""
    from PIL import Image, ImageDraw, ImageFont

    inset, right, legend = 76, 20, 26 * len(curves) + 16
    low = min(0.9, np.floor(10 * min(curve.tpr_at(0) for curve in curves.values())) / 10)
    picture = Image.new("RGB", (size + inset + right, size + inset + right + legend), "white")
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(16)

    def at(x: float, y: float) -> tuple[float, float]:
        return inset + x * size, right + (1 - y) / (1 - low) * size

    for k in range(11):
        grid, y = (225, 225, 225) if k % 10 else (120, 120, 120), low + (1 - low) * k / 10
        draw.line([at(k / 10, low), at(k / 10, 1)], fill=grid)
        draw.line([at(0, y), at(1, y)], fill=grid)
        if k % 2 == 0:
            draw.text((at(k / 10, 0)[0], right + size + 6), f"{k / 10:.1f}", fill="black", font=font, anchor="ma")
            draw.text((inset - 8, at(0, y)[1]), f"{y:.2f}", fill="black", font=font, anchor="rm")
    draw.text((inset + size / 2, right + size + 28), "false positive rate", fill="black", font=font, anchor="ma")
    words = Image.new("RGB", (160, 22), "white")
    ImageDraw.Draw(words).text((80, 0), "true positive rate", fill="black", font=font, anchor="ma")
    picture.paste(words.rotate(90, expand=True), (4, right + size // 2 - 80))
    for k, (name, curve) in reversed(list(enumerate(curves.items()))):  # the first on top
        colour = COLOURS[k % len(COLOURS)]
        corners = [at(float(x), max(low, float(y))) for x, y in zip(curve.fpr, curve.tpr, strict=True)]
        draw.line(corners, fill=colour, width=4 if k == 0 else 3, joint="curve")
        y = right + size + inset + 4 + 26 * k
        draw.line([(inset, y + 9), (inset + 36, y + 9)], fill=colour, width=4)
        least, most = curve.interval
        draw.text((inset + 46, y), f"{name}: area {curve.auc:.4f} ({least:.3f} to {most:.3f})", fill="black", font=font)
    return np.asarray(picture)


def roc_document(curve: Roc) -> dict[str, Any]:
    """A ROC for JSON."""
    return {
        "auc": curve.auc,
        "interval": list(curve.interval),
        "positives": curve.positives,
        "negatives": curve.negatives,
        "tpr_at_fpr": {f"{x:g}": curve.tpr_at(x) for x in (0.01, 0.05, 0.1)},
        "equal_error": curve.equal_error(),
        "points": [
            {"threshold": None if np.isinf(t) else float(t), "tpr": float(y), "fpr": float(x)}
            for t, y, x in zip(curve.threshold, curve.tpr, curve.fpr, strict=True)
        ],
    }


def write_recognitions(
    folder: str | os.PathLike[str],
    found: Sequence[Recognition],
    objects: Sequence[str],
    scenes: Sequence[Path],
    curves: Mapping[str, Roc] | None = None,
) -> list[str]:
    """Writes recognitions.csv, recognitions.json and a picture of each scene; with curves roc.json and roc.png.

    Returns the names. Raises OSError."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = [p.name for p in scenes]
    contents = {
        "recognitions.csv": as_table(found, names).encode(),
        "recognitions.json": json.dumps(as_document(found, names)).encode(),
    }
    if curves:
        contents["roc.json"] = json.dumps({k: roc_document(c) for k, c in curves.items()}, indent=1).encode()
        contents["roc.png"] = png(draw_roc(curves))
    for index, path in enumerate(scenes):
        own = [r for r in found if r.scene == index]
        contents[f"{path.stem}.found.png"] = png(draw_scene(read_grey(path), own, objects))
    for name, data in contents.items():
        write_atomically(folder / name, data)
    return [str(folder / name) for name in contents]
