"""The report's unrolled wall, linked to the keyframes that show it."""

from __future__ import annotations

import html
import io
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipefish.errors import PipefishError
from pipefish.measured_texts import clock_text, length_text
from pipefish.page import data_uri
from pipefish.unroll import Tell, Unroller, nice_length
from pipefish.unroll_files import picture
from pipefish.wall import Wall, read_wall

ROWS = 470  # of the wall's picture, about: a DN300 pipe at 2 mm
MOST_COLUMNS = 40_000  # of it: 10 MB; longer pipes are drawn coarser
PART = 4096  # columns of one picture
MOST_KEYFRAMES, KEYFRAME_WIDTH = 200, 420  # in the page: 3 MB
QUALITY = 78
NAME_PIXELS, LETTER_PIXELS, ROW_PIXELS = 22, 8, 18  # of the name beside a mark: its margins, a letter, its height


@dataclass
class WallPicture:
    """The section of the page, and what its script needs; without data: why there is no picture."""

    html: str
    data: dict[str, Any] | None


def wall_picture(
    folder: Path, survey: Path | None, tell: Tell | None, findings: Sequence[dict[str, Any]] = ()
) -> WallPicture:
    """The wall of a folder of `pipefish reconstruct`, with `findings` (as dense_findings tells them) marked besides the
    tube's own. Raises FormatError for one that is broken, and PipefishError for
    a `survey` that is named but not there; a survey that is merely not where it was, the section tells."""
    try:
        wall = read_wall(folder, survey)
    except PipefishError as error:
        if survey is not None or "--survey" not in str(error):
            raise
        return WallPicture(f"<p class='muted'>No picture of the wall: {html.escape(str(error))}.</p>", None)
    length = wall.end - wall.start
    cell = nice_length(math.pi * wall.diameter / ROWS)
    cell = max(cell, nice_length(length / MOST_COLUMNS, up=True))
    try:
        unroller = Unroller(wall, cell=cell, tell=tell)
    except PipefishError as error:
        return WallPicture(f"<p class='muted'>No picture of the wall: {html.escape(str(error))}.</p>", None)
    images, views = [], []
    for first in range(0, unroller.columns, PART):
        drawn = unroller.draw(first, min(PART, unroller.columns - first))
        stream = io.BytesIO()
        picture(drawn).convert("RGBA").save(stream, "WEBP", quality=QUALITY, method=4)
        share = drawn.grey.shape[1] / min(PART, unroller.columns)  # on paper a part that is whole is as wide as that
        size = f"width='{drawn.grey.shape[1]}' height='{drawn.grey.shape[0]}' style='--share: {share:.4f}'"
        images.append(f"<img src='{data_uri(stream.getvalue(), 'image/webp')}' {size} alt=''>")
        views.append(drawn.view)
    view = np.concatenate(views)
    numbers, frames = _keyframes(wall, np.unique(view[view >= 0]))
    runs = [[next(run), int(numbers[v]) if v >= 0 else -1] for v, run in _runs(view)]
    runs = [r for i, r in enumerate(runs) if i == 0 or r[1] != runs[i - 1][1]]
    data = {"start": unroller.start, "cell": unroller.cell, "columns": unroller.columns, "rows": unroller.rows}
    data |= {"cut": unroller.cut, "signs": unroller.signs, "unit": "m" if wall.unit == "metre" else "diameters"}
    data |= {"runs": runs, "frames": frames}
    return WallPicture(_section(unroller, images, findings), data)


def _runs(view: np.ndarray) -> Iterable[tuple[int, Any]]:
    for value, run in itertools.groupby(range(len(view)), key=lambda i: view[i]):
        yield int(value), run


def _keyframes(wall: Wall, views: np.ndarray) -> tuple[dict[int, int], list[dict[str, str]]]:
    """For each view the place of its picture in the list, or of the nearest that is there; pictures and captions."""
    shown = views[np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_KEYFRAMES)).round().astype(int))]
    frames = []
    for v in shown.tolist():
        small = Image.fromarray(wall.picture(v))
        small.thumbnail((KEYFRAME_WIDTH, KEYFRAME_WIDTH), Image.Resampling.LANCZOS)
        stream = io.BytesIO()
        small.save(stream, "JPEG", quality=QUALITY, optimize=True)
        at = length_text(float(wall.chainage[v]), wall.unit, metres=True)
        text = f"keyframe {wall.keyframe[v]}, taken at {at}"
        frames.append({"src": data_uri(stream.getvalue(), "image/jpeg"), "text": text})
    nearest = np.abs(wall.chainage[views][:, None] - wall.chainage[shown][None]).argmin(axis=1)
    return dict(zip(views.tolist(), nearest.tolist(), strict=True)), frames


def _marks(unroller: Unroller, findings: Sequence[dict[str, Any]]) -> Iterable[str]:
    """Findings, where they are on the picture: a circle, a line for what goes around the pipe, a crack's path."""
    ends: list[float] = []  # of the names of rings in each row, pixels: near ones stand one below the other
    found = [e for e in (*unroller.wall.document["events"], *findings) if e["kind"] not in ("not_measured", "bend")]
    for event in sorted((e for e in found if e["chainage"] is not None), key=lambda e: float(e["chainage"])):
        x = 100 * (event["chainage"] - unroller.start) / (unroller.columns * unroller.cell)
        if not 0 <= x <= 100:
            continue
        word = html.escape(event["kind"])
        if event["kind"] in ("joint", "step") or event.get("clock") is None:
            left = x / 100 * unroller.columns
            row = next((k for k, end in enumerate(ends) if end <= left), len(ends))
            ends[row : row + 1] = [left + NAME_PIXELS + LETTER_PIXELS * len(event["kind"])]
            top = f" style='top:{2 + ROW_PIXELS * row}px'" if row else ""
            yield f"<span class='wall-mark ring' style='left:{x:.3f}%'><b{top}>{word}</b></span>"
            continue
        signs = [s["clock_sign"] for s in unroller.signs if s["stretch"] == event.get("stretch")]
        sign = (signs or [unroller.signs[0]["clock_sign"]])[0]
        y = 100 * ((unroller.cut - event["clock"]) * sign / (2 * math.pi) % 1)
        place = f"left:{x:.3f}%;top:{y:.2f}%"
        bare = " bare" if event["kind"] == "crack" else ""
        yield f"<span class='wall-mark{bare}' style='{place}'><b>{word} {clock_text(event['clock'])}</b></span>"
    paths = "".join(_path(unroller, e) for e in findings if e["kind"] == "crack")
    if paths:
        box = "viewBox='0 0 100 100' preserveAspectRatio='none' aria-hidden='true'"
        yield f"<svg class='wall-paths' {box}>{paths}</svg>"


def _path(unroller: Unroller, crack: dict[str, Any]) -> str:
    """A crack's path in hundredths of the picture, begun anew where it crosses the cut."""
    chainage, clock = np.array(crack["path"], float).T
    x = 100 * (chainage - unroller.start) / (unroller.columns * unroller.cell)
    y = (unroller.cut - clock) * unroller.signs[0]["clock_sign"] / (2 * math.pi) % 1
    way = "".join(
        f"{'M' if k == 0 or abs(y[k] - y[k - 1]) > 0.5 else 'L'}{x[k]:.3f} {100 * y[k]:.2f}" for k in range(len(x))
    )
    return f"<path d='{way}'/>"


def _section(unroller: Unroller, images: list[str], findings: Sequence[dict[str, Any]]) -> str:
    wall = unroller.wall
    scale = f"{1000 * unroller.cell:g} mm" if wall.unit == "metre" else f"{unroller.cell:g} diameters"
    sign = unroller.signs[0]["clock_sign"]
    text = (
        f"Unrolled as seen from inside: {scale} a pixel, chainage to the right, 12 o'clock at the upper and lower "
        f"edge, 6 in the middle, {'9' if sign > 0 else '3'} above and {'3' if sign > 0 else '9'} below it. Each place "
        "is from the keyframe that sees it best, in one light. Chequered: not seen. Point at a place, or tap it, for "
        "its keyframe."
    )
    shape = f"--shape: {wall.camera.width} / {wall.camera.height}"
    return (
        f"<p class='note'>{html.escape(text)}</p>"
        "<div class='wall-scroll'><div class='wall-strip' id='wall-strip' tabindex='0' role='img' "
        f"aria-label='Unrolled wall; arrow keys move along the pipe'>{''.join(images)}"
        f"{''.join(_marks(unroller, findings))}"
        "<span id='wall-cursor'></span></div></div>"
        f"<div class='wall-under' style='{shape}'><img id='wall-view' src='data:,' alt='Keyframe beside this place'>"
        "<output id='wall-text'></output></div>"
    )
