"""Constant against adaptive maps over growing changes of view, as the thesis's Fig. 8: wall and boat 1-2 to 1-6.

match_views.py [DOCS]: prints the table of docs/matching.md and draws match_views.png there [the project's docs].
Coverage is matches over the cells of the coarser picture in the common area; errors are distances from the homography,
which for these pictures is itself good to a pixel or two."""

import itertools
import os
import sys
from pathlib import Path

import numpy as np
from peers import ROOT

BOUNDS = (0.5, 1, 2, 5)
COLOURS = {"constant": (200, 100, 27), "adaptive": (31, 138, 148)}


def load(folder: Path, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pictures 1 and `view`, and the homography between them."""
    from PIL import Image

    one, two = (np.asarray(Image.open(folder / f"img{k}.png").convert("L")) for k in (1, view))
    text = (folder / f"H1to{view}p.xml").read_text()
    h = np.array(text[text.index("<data>") + 6 : text.index("</data>")].split(), float).reshape(3, 3)
    return one, two, h


def mapped(h: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Places (N,2) through a homography."""
    p = np.c_[xy, np.ones(len(xy))] @ h.T
    return p[:, :2] / p[:, 2:]


def common(one: np.ndarray, two: np.ndarray, h: np.ndarray) -> float:
    """Cells of the coarser picture that both show."""
    y, x = np.mgrid[: one.shape[0], : one.shape[1]]
    xy = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    to = mapped(h, xy)
    inside = (to >= 0).all(axis=1) & (to < np.array(two.shape[::-1])).all(axis=1)
    step = 1e-3
    across, down = (mapped(h, xy[inside] + d) - to[inside] for d in ((step, 0), (0, step)))
    area = np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]) / step**2
    return float(np.minimum(1, area).sum())


def measure(folder: Path, view: int) -> dict[str, dict[str, float]]:
    """Of each mode: matches, coverage, share within each bound."""
    from pipefish.matching import find_seeds, match_quasi_dense

    one, two, h = load(folder, view)
    area, seeds, out = common(one, two, h), find_seeds(one, two), {}
    for mode in COLOURS:
        m = match_quasi_dense(one, two, seeds, mode=mode)
        error = np.linalg.norm(mapped(h, m.xy1) - m.xy2, axis=1)
        out[mode] = {"matches": len(m), "coverage": len(m) / area}
        out[mode] |= {str(b): float(np.mean(error < b)) if len(m) else 0.0 for b in BOUNDS}
    return out


def draw(figures: dict[str, list[dict[str, dict[str, float]]]], path: Path) -> None:
    """Coverage (full lines) and share within 5 pixels (dashes) over the views, a chart a sequence."""
    from PIL import Image, ImageDraw, ImageFont

    width, height, left, top = 420, 240, 50, 34
    sheet = Image.new("RGB", (2 * (width + left + 20), height + top + 60), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for n, (name, rows) in enumerate(figures.items()):
        x0, y0 = n * (width + left + 20) + left, top + height
        for k in range(6):
            y = y0 - height * k / 5
            pen.line([(x0, y), (x0 + width, y)], (225, 225, 228))
            pen.text((x0 - 6, y), f"{20 * k} %", "black", font, anchor="rm")
        places = [x0 + width * (k + 0.5) / len(rows) for k in range(len(rows))]
        for k, x in enumerate(places):
            pen.text((x, y0 + 6), f"{name} 1-{k + 2}", "black", font, anchor="ma")
        for mode, colour in COLOURS.items():
            for key, dashed in (("coverage", False), ("5", True)):
                line = [(x, y0 - height * min(1, r[mode][key])) for x, r in zip(places, rows, strict=True)]
                for (xa, ya), (xb, yb) in itertools.pairwise(line):
                    parts = 12 if dashed else 1
                    for p in range(parts):
                        s, e = p / parts, (p + (0.55 if dashed else 1)) / parts
                        ends = [(xa + t * (xb - xa), ya + t * (yb - ya)) for t in (s, e)]
                        pen.line(ends, colour, 3)
                for x, y in line:
                    pen.ellipse([(x - 4, y - 4), (x + 4, y + 4)], colour)
    x = left
    for text, colour in (
        ("adaptive", COLOURS["adaptive"]),
        ("constant", COLOURS["constant"]),
        ("full lines: coverage of the common area; dashes: within 5 pixels", (0, 0, 0)),
    ):
        pen.text((x, 8), text, colour, font)
        x += 20 + int(pen.textlength(text, font))
    sheet.save(path)


def main() -> int:
    """Measures, prints and draws; 1 without the pictures."""
    folder = Path(os.environ.get("PIPEFISH_DATA") or ROOT.parent / "shared" / "data") / "homography"
    if not folder.exists():
        print(f"the pictures are not in {folder}: set PIPEFISH_DATA", file=sys.stderr)
        return 1
    docs = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs"
    figures: dict[str, list[dict[str, dict[str, float]]]] = {}
    print("| pair | matches | coverage % | " + " | ".join(f"within {b:g} px %" for b in BOUNDS) + " |")
    print("|---" * (3 + len(BOUNDS)) + "|")
    for name in ("wall", "boat"):
        for view in range(2, 7):
            got = measure(folder / name, view)
            figures.setdefault(name, []).append(got)
            cells = [" / ".join(f"{got[mode]['matches'] / 1000:.0f}k" for mode in COLOURS)]
            cells += [
                " / ".join(f"{100 * got[mode][k]:.0f}" for mode in COLOURS) for k in ("coverage", *map(str, BOUNDS))
            ]
            print(f"| {name} 1-{view} | " + " | ".join(cells) + " |", flush=True)
    draw(figures, docs / "match_views.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
