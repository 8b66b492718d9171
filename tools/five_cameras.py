#!/usr/bin/env python3
"""Paper III's experiment: five cameras, one generic model, one method.

A target of discs is drawn before five simulated lenses that lie outside the model's family: narrow, wide, fisheye,
hyperbolic mirror, equiangular mirror. Each is calibrated from its pictures with p6, p9 and p23, without any guess and
told nothing but the target. The table is the RMS residual of the discs' centroids; the pictures show one view of
each on the faces of a cube, where straight lines must be straight.

    build/venv/bin/python tools/five_cameras.py docs/calibration      # about three minutes

J. Kannala, J. Heikkila, S. Brandt: Geometric camera calibration, in: Wiley Encyclopedia of Computer Science and
Engineering, 2008 (Paper III of Kannala's thesis) has it with real cameras.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

import pipefish as pf
from pipefish.calib_draw import cube, rows_and_columns
from pipefish.calib_input import Given, Picture, Target3D
from pipefish.calib_run import Session, run
from pipefish.files import write_atomically
from pipefish.progress import Progress
from pipefish.studio import Studio
from pipefish.studio_targets import target_poses

CAMERAS = {
    "narrow": "narrow-60",
    "wide": "wide-120",
    "fisheye": "fisheye-185",
    "hyperbolic mirror": "hyperbolic",
    "equiangular mirror": "equiangular",
}
MODELS = ("p6", "p9", "p23")
TARGET = pf.Target("asymmetric-circles", 15, 6, 0.04)
SIZE = (960, 720)
WIDTH = 400  # of a picture on the sheet


def pictures(preset: str, views: int, seed: int) -> list[np.ndarray]:
    """Pictures of the target, near and far, over the whole field."""
    lens = {"preset": preset, "width": SIZE[0], "height": SIZE[1]}
    poses = target_poses(TARGET, Studio(lens, {"seed": seed}), views, seed, (0.35, 0.8), 0.5, 0.8)
    made, _ = pf.simulate_target_views(TARGET, lens, poses, seed=seed, samples=55)
    return [view.image for view in made]


def calibrated(images: list[np.ndarray], model: str, tell: Any) -> Session:
    """From nothing but the pictures. The board is flat here, and told to be."""
    shots = [Picture(f"{i}", 0, f"picture {i}", lambda image=image: image) for i, image in enumerate(images)]
    target = Target3D("dots", TARGET.points(), TARGET.radius_m, TARGET)
    return run(Given(["camera"], [target], shots, [], [SIZE]), model=model, board="flat", tell=tell)


def rectified(session: Session) -> tuple[Image.Image, float]:
    """The picture with the most points far out, on the cube's faces; how straight rows are there, px rms."""
    views = [v for v in session.result.report["views"] if v["used"]]
    best = max(views, key=lambda v: v["points"] * v["theta_max"])["view"]
    view, source = session.views[best], session.picture_of(best)
    assert source is not None
    distance = session.result.report["cameras"][0]["uncertainty"]["distance_m"]
    edge = WIDTH // 3
    for _ in range(2):  # what the camera sees of the cube fills the sheet
        lines = rows_and_columns(view.board_xyz)
        made = cube(session.result.camera, source.image(), view.pixels, lines, edge, distance)
        box = made.picture.getbbox()
        assert box is not None
        edge = edge * WIDTH // (box[2] - box[0])
    seen = made.picture.crop(box)
    small = Image.fromarray(source.image()).convert("RGB")
    small.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    sheet = Image.new("RGB", (WIDTH, small.height + 8 + seen.height), (246, 247, 249))
    sheet.paste(small, (0, 0))
    sheet.paste(seen, ((WIDTH - seen.width) // 2, small.height + 8))
    return sheet, made.off_px or float("nan")


def main() -> int:
    """Writes five-cameras.jpg and five-cameras.json into a folder and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="FOLDER")
    parser.add_argument("--views", type=int, default=16, metavar="N", help="of each camera [16]")
    parser.add_argument("--seed", type=int, default=3)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    sheets: list[Image.Image] = []
    with Progress("cameras", len(CAMERAS) * (len(MODELS) + 1)) as bar:
        for name, preset in CAMERAS.items():
            bar.update(len(rows) * (len(MODELS) + 1), name)
            images = pictures(preset, args.views, args.seed)
            row: dict[str, Any] = {"camera": name, "preset": preset}
            for model in MODELS:
                session = calibrated(images, model, lambda *_: None)
                row[model] = session.result.rms
                row[f"{model}_held_out"] = session.held_out[0] if session.held_out else None
                row["views"] = sum(v["used"] for v in session.result.report["views"])
                row["points"] = session.result.report["points_used"]
            sheet, row["straight_px"] = rectified(session)
            sheets.append(sheet)
            rows.append(row)
    height = max(s.height for s in sheets)
    whole = Image.new("RGB", (sum(s.width for s in sheets) + 12 * (len(sheets) - 1), height + 26), (246, 247, 249))
    at = 0
    for row, sheet in zip(rows, sheets, strict=True):
        ImageDraw.Draw(whole).text((at + 2, 4), row["camera"], fill=(40, 46, 56), font_size=17)
        whole.paste(sheet, (at, 26))
        at += sheet.width + 12
    out = io.BytesIO()
    whole.save(out, "JPEG", quality=80, optimize=True)
    write_atomically(args.out / "five-cameras.jpg", out.getvalue())
    write_atomically(args.out / "five-cameras.json", (json.dumps(rows, indent=2) + "\n").encode())
    print("| camera | views | discs | p6 | p9 | p23 | p23, held out |\n|---|--:|--:|--:|--:|--:|--:|")
    for row in rows:
        figures = [row[m] for m in MODELS] + [row["p23_held_out"]]
        cells = " | ".join("-" if f is None else f"{f:.3f}" for f in figures)
        print(f"| {row['camera']} | {row['views']} | {row['points']} | {cells} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
