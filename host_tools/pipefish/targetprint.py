"""Calibration targets on paper: vector PDF at true scale, with a ruler to check the printer by.

reportlab draws the page: rectangles and circles stay exact at any resolution of the printer.
"""

from __future__ import annotations

import io
import itertools
import math
from dataclasses import dataclass
from typing import Any

from pipefish.errors import ArgumentError
from pipefish.target import OWN, Target

PAPERS = {
    "A0": (841.0, 1189.0),
    "A1": (594.0, 841.0),
    "A2": (420.0, 594.0),
    "A3": (297.0, 420.0),
    "A4": (210.0, 297.0),
    "letter": (215.9, 279.4),
}
EDGE_MM = 5.0  # what printers leave white
FOOT_MM = 15.0  # ruler and text
TAB_MM = 12.0  # on a sleeve's piece, for glue
RULER_MM = 100.0
_POINTS = 72 / 25.4  # a PDF's unit is 1/72 inch


@dataclass(frozen=True)
class Page:
    """A sheet of paper: its size and the stretch of the target's width that is on it, millimetres."""

    width: float
    height: float
    start: float
    end: float
    tab: bool = False


def paper_size(name: str) -> tuple[float, float]:
    """Millimetres of a paper by name, or of "WIDTHxHEIGHT". Raises ArgumentError."""
    for known, size in PAPERS.items():
        if name.lower() == known.lower():
            return size
    try:
        width, height = (float(part) for part in name.lower().split("x"))
    except ValueError:
        raise ArgumentError(f"paper: {name!r} is none of {', '.join(PAPERS)}, nor WIDTHxHEIGHT in mm") from None
    if not (50 <= width <= 5000 and 50 <= height <= 5000):
        raise ArgumentError(f"paper: {name}: sides must be 50 to 5000 mm")
    return width, height


def fitting(kind: str, cols: int, rows: int, paper: str) -> float:
    """The largest spacing, in whole millimetres, with which such a flat target fits a paper with margins of half a
    spacing; metres. Raises ArgumentError where not even 1 mm does."""
    best = 0
    for width, height in _both_ways(paper):
        for mm in range(1, 1000):
            target = Target(kind, rows, cols, mm / 1000, margin_m=mm / 2000)
            w, h = (1000 * side for side in target.size_m)
            if w > width - 2 * EDGE_MM or h > height - 2 * EDGE_MM - FOOT_MM:
                break
            best = max(best, mm)
    if not best:
        raise ArgumentError(f"paper: {cols} x {rows} do not fit {paper}")
    return best / 1000


def _both_ways(paper: str) -> list[tuple[float, float]]:
    width, height = paper_size(paper)
    return [(width, height), (height, width)] if width != height else [(width, height)]


def pages(target: Target, paper: str) -> list[Page]:
    """How a target goes on paper: upright or across, a sleeve in pieces if it is longer. Raises ArgumentError that
    tells the size that is needed."""
    w, h = (1000 * side for side in target.size_m)
    sleeve = target.kind == "sleeve"
    tab = TAB_MM if sleeve else 0.0
    best: list[Page] = []
    for width, height in _both_ways(paper):
        room = width - 2 * EDGE_MM
        if h > height - 2 * EDGE_MM - FOOT_MM:
            continue
        if w + tab <= room:
            return [Page(width, height, -w / 2, w / 2, sleeve)]
        # Seams run midway between columns.
        step = 1000 * target.spacing_x
        columns = int((room - tab) / step + 1e-9)
        if not sleeve or columns < 1:
            continue
        count = math.ceil(target.cols / columns)
        cuts = [round(k * target.cols / count) for k in range(count + 1)]
        made = [Page(width, height, a * step - w / 2, b * step - w / 2, True) for a, b in itertools.pairwise(cuts)]
        if not best or len(made) < len(best):
            best = made
    if best:
        return best
    need = f"{math.ceil(w + tab + 2 * EDGE_MM)}x{math.ceil(h + 2 * EDGE_MM + FOOT_MM)}"
    fits = [(a * b, name) for name, (a, b) in PAPERS.items() if _fits(a, b, w + tab, h) or _fits(b, a, w + tab, h)]
    advice = f"--paper {min(fits)[1]} or {need}" if fits else f"--paper {need}"
    raise ArgumentError(f"paper: {w:.0f} x {h:.0f} mm do not fit {paper}: {advice}")


def _fits(width: float, height: float, w: float, h: float) -> bool:
    return w <= width - 2 * EDGE_MM and h <= height - 2 * EDGE_MM - FOOT_MM


def describe(target: Target) -> str:
    """What it is, in a few words."""
    step = f"{1000 * target.spacing_m:g} mm"
    if target.kind == "checkerboard":
        return (
            f"checkerboard, {target.cols} x {target.rows} squares of {step} ({target.cols - 1} x {target.rows - 1} "
            "inner corners)"
        )
    if target.kind == "charuco":
        last = target.first_marker + len(target.marker_middles()) - 1
        kind = "" if target.dictionary == OWN else f" of {target.dictionary}"
        legacy = ", legacy" if target.legacy else ""
        return (
            f"ChArUco, {target.cols} x {target.rows} squares of {step}, markers {target.first_marker} to {last}{kind}"
            f"{legacy}"
        )
    radius = f"radius {1000 * target.radius_m:g} mm"
    if target.kind == "sleeve":
        return (
            f"sleeve for an inside diameter of {1000 * target.diameter_m:g} mm, {target.rows} rings of {target.cols} "
            f"discs, {radius}, rings {step} apart"
        )
    name = "asymmetric circles" if target.kind == "asymmetric-circles" else "circles"
    if target.kind == "asymmetric-circles":
        step = f"{step} within a row ({500 * target.spacing_m:g} mm from row to row)"
    return f"{name}, {target.cols} x {target.rows}, spacing {step}, {radius}"


def what_to_measure(target: Target) -> str:
    """Which length on the print tells its scale, and where the number goes."""
    points = 1000 * target.flat_points()
    wide = float(points[:, 0].max() - points[:, 0].min())
    tall = float(points[:, 1].max() - points[:, 1].min())
    if target.kind == "sleeve":
        around = 1000 * math.pi * target.diameter_m
        return f"Around, from seam to seam: {around:.2f} mm. First to last ring, centres: {tall:.2f} mm."
    ends = "centres" if target.has_circles else "inner corners"
    return f"Outermost {ends} apart: {wide:.2f} mm across, {tall:.2f} mm down; if not, correct spacing_m in the JSON."


def print_target(target: Target, paper: str = "A4") -> bytes:
    """The target as a PDF at true scale, on as many pages as it takes. The same target gives the same bytes. Raises
    ArgumentError."""
    from reportlab.pdfgen.canvas import Canvas

    sheets = pages(target, paper)
    out = io.BytesIO()
    canvas = Canvas(out, invariant=1, pageCompression=1)
    canvas.setTitle(f"Pipefish: {describe(target)}")
    canvas.setCreator("Pipefish")
    for number, page in enumerate(sheets):
        canvas.setPageSize((page.width * _POINTS, page.height * _POINTS))
        canvas.scale(_POINTS, _POINTS)  # from here on millimetres, y upwards
        _draw_page(canvas, target, page, number, len(sheets))
        canvas.showPage()
    canvas.save()
    return out.getvalue()


def _draw_page(canvas: Any, target: Target, page: Page, number: int, count: int) -> None:
    high = 1000 * target.size_m[1]
    length = page.end - page.start
    left = (page.width - length - (TAB_MM if page.tab else 0)) / 2
    bottom = FOOT_MM + EDGE_MM + (page.height - 2 * EDGE_MM - FOOT_MM - high) / 2
    x0, y0 = left - page.start, bottom + high / 2  # the target's middle on the page
    canvas.saveState()
    clip = canvas.beginPath()
    clip.rect(left, bottom, length, high)
    canvas.clipPath(clip, stroke=0, fill=0)
    middle = 0.5 * (target.black + target.white)
    for round_, x, y, a, b, albedo in target.figures():
        x, y, a, b = x0 + 1000 * x, y0 - 1000 * y, 1000 * a, 1000 * b
        if x + a < left or x - a > left + length:
            continue
        canvas.setFillGray(0.0 if albedo < middle else 1.0)
        if round_:
            canvas.ellipse(x - a, y - b, x + a, y + b, stroke=0, fill=1)
        else:
            canvas.rect(x - a, y - b, 2 * a, 2 * b, stroke=0, fill=1)
    canvas.restoreState()
    if page.tab:
        _draw_tab(canvas, left, bottom, length, high, number, count)
    _draw_foot(canvas, target, page, number, count)


def _draw_tab(canvas: Any, left: float, bottom: float, length: float, high: float, number: int, count: int) -> None:
    """Cut lines around a sleeve's piece, and a tab on its right, on which the next piece's left edge is laid."""
    canvas.setLineWidth(0.1)
    canvas.setStrokeGray(0.5)
    canvas.rect(left, bottom, length + TAB_MM, high, stroke=1, fill=0)
    canvas.setLineWidth(0.2)
    canvas.setStrokeGray(0)
    right = left + length
    mark = min(2.5, high / 10)
    for y in (bottom, bottom + high - mark):  # where the edges must meet, outside the discs
        canvas.line(right, y, right, y + mark)
    letter, before = chr(ord("A") + number % 26), chr(ord("A") + (number - 1) % count % 26)
    canvas.setFillGray(0)
    canvas.setFont("Helvetica", 2.6)
    canvas.drawString(left + 0.8, bottom + 0.8, before)
    canvas.drawRightString(right - 0.8, bottom + 0.8, letter)
    canvas.saveState()
    canvas.translate(right + TAB_MM / 2 + 1, bottom + high / 2)
    canvas.rotate(90)
    canvas.drawCentredString(
        0, 0, f"glue: the edge {letter} of " + ("the next piece" if count > 1 else "its own start")
    )
    canvas.restoreState()


def _draw_foot(canvas: Any, target: Target, page: Page, number: int, count: int) -> None:
    canvas.setFillGray(0)
    canvas.setStrokeGray(0)
    left, base = EDGE_MM + 2, EDGE_MM + 1
    ruler = RULER_MM if page.width >= RULER_MM + 2 * EDGE_MM + 4 else 10 * int((page.width - 2 * EDGE_MM - 4) / 10)
    canvas.setLineWidth(0.2)
    canvas.line(left, base, left + ruler, base)
    for mm in range(int(ruler) + 1):
        canvas.line(left + mm, base, left + mm, base + (3.0 if mm % 10 == 0 else 2.0 if mm % 5 == 0 else 1.2))
    canvas.setFont("Helvetica", 2.4)
    canvas.drawString(left + ruler + 2, base, f"{ruler:.0f} mm")
    lines = [
        f"Pipefish {describe(target)}" + (f", piece {number + 1} of {count}" if count > 1 else ""),
        f"Print at 100 %, not fitted to the page. {what_to_measure(target)}",
    ]
    for k, line in enumerate(lines):
        size = 2.8
        while size > 1.2 and canvas.stringWidth(line, "Helvetica", size) > page.width - 2 * left:
            size -= 0.1
        canvas.setFont("Helvetica", size)
        canvas.drawString(left, base + 9.6 - 4.2 * k, line)
