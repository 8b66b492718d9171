"""The command `pipefish segment`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, positive, table

MAX_PIXELS = 2_000_000  # of a picture: memory is a kilobyte a pixel and more
REASONS = {
    "no seeds": "no region of one picture looks like one of the other: too little texture, or nothing in common",
    "no growth": "the surroundings of the few regions that look alike differ",
    "ok": "no matches that are neighbours move as one surface",
}


def run_segment(args: argparse.Namespace) -> Result:
    """Segments two pictures into layers and writes them."""
    from pipefish.errors import ArgumentError, FormatError
    from pipefish.matching import grey, match_quasi_dense
    from pipefish.matching_files import read_pixels
    from pipefish.progress import Progress
    from pipefish.segmentation import planes, segment_motion
    from pipefish.segmentation_files import document, motion_text, write_segmentation

    one, two = read_pixels(args.first), read_pixels(args.second)
    for picture, name in ((one, args.first), (two, args.second)):
        if picture.shape[0] * picture.shape[1] > MAX_PIXELS:
            size = f"{picture.shape[1]}x{picture.shape[0]}"
            raise FormatError(name, None, f"{size} is more than {MAX_PIXELS} pixels: make both pictures smaller first")
        grey(picture, name)
    try:
        Path(args.output).mkdir(parents=True, exist_ok=True)
    except OSError as failed:
        raise ArgumentError(f"--output: {args.output} cannot be a folder: {failed.strerror}") from failed
    if any(p.ndim == 2 or (p == p[..., :1]).all() for p in (one, two)):  # three times the same says no more than once
        one, two = grey(one, args.first), grey(two, args.second)
    with Progress("matching and segmenting", total=1.0, quiet=args.json) as bar:
        bar.update(0, "matching")
        m = match_quasi_dense(one, two, threads=args.threads)
        s = segment_motion(
            one,
            two,
            m,
            layers=args.layers,
            threads=args.threads,
            progress=lambda share: bar.update(0.3 + 0.7 * share, "refining"),
        )
    files = write_segmentation(args.output, planes(one, args.first), planes(two, args.second), s)
    rows: list[tuple[str, object]] = [("status", s.status), ("matches", len(m))]
    if not s.layers:
        rows.append(("reason", REASONS[m.status]))
    for k, layer in enumerate(s.layers, 1):
        share = 100 * layer.area1 / s.labels1.size, 100 * layer.area2 / s.labels2.size
        text = f"{motion_text(s.motion(k))}; {share[0]:.1f} and {share[1]:.1f} % of the pictures, "
        text += f"correlation {layer.zncc1:.2f}"
        if (unsure := max(layer.low_evidence1, layer.low_evidence2)) > 0.3:
            text += f"; {100 * unsure:.0f} % of it has little texture and follows its surroundings"
        if max(layer.ambiguous1, layer.ambiguous2) > 0.1:
            text += ", ambiguous: another layer claims the same"
        rows.append((f"layer {k}", text))
    rows.append(("written", f"{args.output}: segmentation.png shows all of it, README.txt tells what each file is"))
    return document(s) | {"matches": len(m), "files": files}, table(rows)


def add_segment(commands: Any) -> None:
    """Adds `segment` to the command line."""
    p = add_command(
        commands,
        "segment",
        run_segment,
        "Find what two pictures have in common, as layers that move, bend and are lit each in its own way. Tells how "
        "each moved, and writes the labels of both pictures' pixels, each layer's fields of motion and of light, and a "
        "picture of it all.",
        "pipefish segment first.png second.png -o out/\n  pipefish segment first.png second.png --threads 2 -o out/",
    )
    p.add_argument("first", metavar="A", help="picture")
    p.add_argument("second", metavar="B", help="picture of the same things, moved")
    p.add_argument("-o", "--output", required=True, metavar="FOLDER", help="for what is written")
    p.add_argument(
        "--layers", type=positive, default=12, metavar="N", help="the most groups of matches to start from [12]"
    )
    p.add_argument("--threads", type=positive, default=1, metavar="N", help="do not change the result [1]")
