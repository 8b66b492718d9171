"""The command `pipefish recognise`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, positive, table
from pipefish.errors import FormatError

THRESHOLD, MAX_PIXELS = 0.05, 400_000  # those of pipefish.recognition, whose import costs time here


def run_recognise(args: argparse.Namespace) -> Result:
    """Looks for objects in scenes and writes what was found."""
    from pipefish.progress import Progress
    from pipefish.recognition import recognise
    from pipefish.recognition_files import (
        pictures_in,
        read_models,
        read_scene,
        read_truth,
        roc_document,
        write_recognitions,
    )
    from pipefish.roc_curve import roc

    files = [p for given in args.scenes for p in pictures_in(Path(given))]
    scenes = [p.name for p in files]
    if len({p.stem for p in files}) < len(files):
        raise FormatError(args.scenes[0], None, "two scenes have the same name")
    pictures = [read_scene(p) for p in files]
    models = read_models(args.models, args.max_pixels)
    objects = [model.name for model in models]
    present = read_truth(args.truth, scenes, objects) if args.truth else None
    with Progress("looking", quiet=args.json) as bar:
        found = recognise(
            models,
            pictures,
            threshold=args.threshold,
            max_pixels=args.max_pixels,
            threads=args.threads,
            progress=lambda done, total: bar.update(done, total=total),
        )
    curves = None
    if present is not None:
        truth = [(scenes[r.scene], r.object) in present for r in found]
        curves = {
            "grouped matches": roc([r.score for r in found], truth),
            "matches": roc([r.matches for r in found], truth),
            "seeds": roc([r.seeds for r in found], truth),
        }
    written = write_recognitions(args.output, found, objects, files, curves)
    seen = [r for r in found if r.present]
    document: dict[str, Any] = {
        "objects": objects,
        "scenes": scenes,
        "threshold": args.threshold,
        "found": [{"scene": scenes[r.scene], "object": r.object, "score": r.score, "box": r.box()} for r in seen],
        "files": written,
    }
    rows: list[tuple[str, object]] = [
        ("looked for", f"{len(objects)} objects in {len(scenes)} scenes"),
        *((scenes[r.scene], f"{r.object}, score {r.score:.3f}") for r in seen),
    ]
    if curves:
        document["roc"] = {name: roc_document(curve) for name, curve in curves.items()}
        for name, c in curves.items():
            span = f"{c.auc:.4f} ({c.interval[0]:.3f} to {c.interval[1]:.3f})"
            rows.append((f"area, {name}", f"{span}, {100 * c.tpr_at(0.05):.0f} % found at 5 % false"))
    rows.append(("written", f"{len(written)} files in {args.output}"))
    return document, table(rows)


def _share(text: str) -> float:
    """An argument of 0 to 1."""
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{value:g} is not within 0 to 1")
    return value


def add_recognise(commands: Any) -> None:
    """Adds `recognise` to the command line."""
    p = add_command(
        commands,
        "recognise",
        run_recognise,
        "Look for known objects in scenes: pictures of the objects are matched quasi-densely, and an object is present "
        "where enough of it is matched by groups that move as one surface. Writes a table (CSV, JSON), a picture of "
        "each scene with contours and, when the truth is given, the ROC.",
        "pipefish recognise models/ scenes/ -o out/\n"
        "  pipefish recognise models/ scenes/ --truth truth.csv --threads 4 -o out/",
    )
    p.add_argument(
        "models",
        metavar="MODELS",
        help="folder: a picture or a folder of pictures for each object, X_mask.png or alpha to tell where it is",
    )
    p.add_argument("scenes", metavar="SCENES", nargs="+", help="pictures, or folders of them")
    p.add_argument("-o", "--output", required=True, metavar="FOLDER", help="for what is written")
    p.add_argument("--truth", metavar="FILE", help="CSV scene,object: what is present, for the ROC")
    p.add_argument(
        "--threshold",
        type=_share,
        default=THRESHOLD,
        metavar="S",
        help=f"score of an object that is present [{THRESHOLD}]",
    )
    p.add_argument(
        "--max-pixels",
        type=positive,
        default=MAX_PIXELS,
        metavar="N",
        help=f"larger pictures are made smaller [{MAX_PIXELS}]",
    )
    p.add_argument(
        "--threads", type=positive, default=1, metavar="N", help="pairs at a time; do not change the result [1]"
    )
