"""What `pipefish unroll` writes: the unrolled picture, in parts where it is long, and a JSON document that says where
each pixel is. docs/unroll.md tells each key."""

from __future__ import annotations

import io
import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pipefish import __version__
from pipefish.errors import ArgumentError, PipefishError
from pipefish.files import write_atomically
from pipefish.unroll import Drawn, Tell, Unroller, nice_length

FORMAT, VERSION = "pipefish-unrolled", 1
LONGEST = 16384  # columns of one file: what browsers and graphics cards show
PNG_LEVEL = 3  # of compression: 9 takes four times as long for 2 % less
PAPER, INK = (255, 255), (30, 255)  # grey, opacity


def picture(drawn: Drawn) -> Image.Image:
    """Grey with opacity: what no keyframe saw is transparent."""
    return Image.merge("LA", (Image.fromarray(drawn.grey), Image.fromarray(drawn.seen)))


def check_name(out: Path) -> None:
    """Of the picture, before anything is measured for it. Raises ArgumentError."""
    if out.suffix.lower() != ".png":
        raise ArgumentError(f"{out}: the unrolled picture is a PNG file: a name that ends in .png")


def write_unrolled(
    unroller: Unroller, out: Path, *, labels: bool = False, tell: Tell | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Writes `out` (a .png; OUT-1.png, OUT-2.png, ... where one file would be too wide) and OUT.json. labels: with
    clock, chainage and a scale bar around it. Returns the document and the files' names. Raises ArgumentError, OSError.

    At most one part is in memory."""
    check_name(out)
    tell = tell or (lambda fraction, word: None)
    count = math.ceil(unroller.columns / LONGEST)
    edges = np.linspace(0, unroller.columns, count + 1).round().astype(int)
    parts: list[dict[str, Any]] = []
    view, fine, shares, blank = [], [], [], []
    margin = Margin(unroller) if labels else None
    for number, (a, b) in enumerate(itertools.pairwise(edges.tolist()), 1):
        drawn = unroller.draw(a, b - a)
        tell(b / unroller.columns, "writing")
        image = picture(drawn)
        if margin is not None:
            image = margin.around(image, a)
        path = out if count == 1 else out.with_name(f"{out.stem}-{number}{out.suffix}")
        stream = io.BytesIO()
        image.save(stream, "PNG", compress_level=PNG_LEVEL)
        write_atomically(path, stream.getvalue())
        ends = unroller.start + unroller.cell * np.array([a, b])
        parts.append({"file": path.name, "first_column": a, "columns": b - a})
        parts[-1] |= {"start": float(ends[0]), "end": float(ends[1])}
        view.append(drawn.view)
        fine.append(drawn.fine)
        shares.append((drawn.seen > 0).mean() * (b - a))
        blank.append(~(drawn.seen > 0).any(axis=0))
    document = document_of(unroller, np.concatenate(view), np.concatenate(fine))
    document["seen"] = float(sum(shares) / unroller.columns)
    document["not_seen"] = _spans(unroller, np.concatenate(blank))
    document["parts"] = parts
    document["margin"] = {"left": margin.left, "top": margin.top} if margin is not None else {"left": 0, "top": 0}
    write_atomically(out.with_suffix(".json"), (json.dumps(document, indent=1) + "\n").encode())
    return document, [*(str(out.with_name(p["file"])) for p in parts), str(out.with_suffix(".json"))]


def document_of(unroller: Unroller, view: np.ndarray, fine: np.ndarray) -> dict[str, Any]:
    """Where each pixel of the picture is, and from which keyframe each column. view, fine: (columns,) of Drawn."""
    wall, u = unroller.wall, unroller
    keyframes = []
    for number, run in itertools.groupby(range(len(view)), key=lambda i: view[i]):
        if number >= 0:
            inside = list(run)
            row = {"keyframe": int(wall.keyframe[number]), "chainage": round(float(wall.chainage[number]), 5)}
            keyframes.append(row | {"first_column": inside[0], "columns": len(inside)})
    factor = 1000.0 if wall.unit == "metre" else 1.0
    known = fine[fine > 0]
    return {
        "format": FORMAT,
        "version": VERSION,
        "software": f"pipefish {__version__}",
        "survey_id": wall.document.get("survey", {}).get("survey_id", ""),
        "unit": wall.unit,
        "cell": u.cell,
        "scale": {
            "along": factor * u.cell,
            "around": factor * math.pi * wall.diameter / u.rows,
            "unit": "mm per pixel" if wall.unit == "metre" else "mean diameters per pixel",
            "resolved": factor / float(np.median(known)) if len(known) else None,
        },
        "diameter": wall.diameter,
        "rows": u.rows,
        "columns": u.columns,
        "start": u.start,
        "end": u.start + u.columns * u.cell,
        "clock": {"zero": wall.document["clock_zero"], "cut": u.cut, "stretches": u.signs},
        "light": {
            "scatter": u.light.scatter,
            "gain_least": float(u.light.gain.min()),
            "gain_most": float(u.light.gain.max()),
        },
        "keyframes": keyframes,
    }


def _spans(unroller: Unroller, blank: np.ndarray) -> list[dict[str, float]]:
    """Chainages from and to of runs of columns in which nothing was seen."""
    spans = []
    for empty, run in itertools.groupby(range(len(blank)), key=lambda i: blank[i]):
        inside = list(run)
        if empty:
            ends = unroller.start + unroller.cell * np.array([inside[0], inside[-1] + 1])
            spans.append({"start": round(float(ends[0]), 5), "end": round(float(ends[1]), 5)})
    return spans


class Margin:
    """Clock at the left, chainage below, a scale bar: around the picture, which stays as it is."""

    def __init__(self, unroller: Unroller) -> None:
        self._u = unroller
        self._size = max(11, unroller.rows // 55)
        self._font = ImageFont.load_default(self._size)
        self.left, self.top = 5 * self._size, self._size
        self._below = 5 * self._size

    def around(self, image: Image.Image, first: int) -> Image.Image:
        """The picture of the columns from `first` on with its margins."""
        u, size = self._u, self._size
        right = image.width + self.left
        page = Image.new("LA", (right + self.left, image.height + self.top + self._below), PAPER)
        page.paste(image, (self.left, self.top))
        draw = ImageDraw.Draw(page)
        foot = self.top + image.height
        sign = u.signs[0]["clock_sign"]
        for hour in range(13):
            row = (u.cut - hour * math.pi / 6) * sign / (2 * math.pi) % 1.0 * u.rows
            rows = [row, u.rows] if row < 1e-6 * u.rows else [row]
            for y in (self.top + min(r, u.rows - 1) for r in (rows if hour else [])):
                for x, anchor, tick in ((self.left - 1, "rm", -1), (right, "lm", 1)):
                    draw.line((x, y, x + tick * size // 2, y), INK)
                    draw.text((x + tick * 0.8 * size, y), str(hour), INK, self._font, anchor)
        unit = "m" if u.wall.unit == "metre" else "D"
        every = nice_length(10 * size * u.cell, up=True)
        low, high = u.start + first * u.cell, u.start + (first + image.width) * u.cell
        for k in range(math.ceil(low / every - 1e-9), math.floor(high / every + 1e-9) + 1):
            x = self.left + (k * every - low) / u.cell
            draw.line((x, foot, x, foot + size // 2), INK)
            text = f"{k * every:.{max(0, -math.floor(math.log10(every) + 1e-9))}f} {unit}"
            draw.text((x, foot + size * 0.7), text, INK, self._font, "ma")
        bar = nice_length(12 * size * u.cell)
        x, y = self.left, foot + 3.4 * size
        draw.rectangle((x, y, x + bar / u.cell, y + size // 3), INK)
        shown, per = (f"{1000 * bar:g} mm", f"{1000 * u.cell:g} mm") if unit == "m" else (f"{bar:g} D", f"{u.cell:g} D")
        draw.text((x + bar / u.cell + size, y + size // 6), f"{shown}; {per} a pixel", INK, self._font, "lm")
        return page


def from_source(source: Path, survey: Path | None, tell: Tell) -> Any:
    """The wall of a folder of `pipefish reconstruct`, or of a survey file, which is measured first. Raises
    PipefishError, OSError."""
    from pipefish.measure import measure
    from pipefish.measured_files import document_of as measured_document
    from pipefish.survey import Survey
    from pipefish.wall import measured_wall, read_wall

    if source.is_dir():
        return read_wall(source, survey)
    if survey is not None:
        raise PipefishError(f"{source}: is no folder of `pipefish reconstruct`, so --survey has no use")
    m = measure(Survey.open(source), tell=lambda done, word: tell(0.4 * done, word))
    return measured_wall(m, measured_document(m))
