"""The command `pipefish dense`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, positive, table
from pipefish.errors import ArgumentError, PipefishError
from pipefish.intervals import SAID, Z95


def run_dense(args: argparse.Namespace) -> Result:
    """Measures the wall of a reconstructed survey densely."""
    from pipefish.dense import DenseWall, dense_wall
    from pipefish.dense_cracks import find_cracks
    from pipefish.dense_files import Strip, strips_of, write_dense
    from pipefish.dense_findings import fingerprint
    from pipefish.progress import Progress
    from pipefish.wall import read_wall

    measured = read_wall(Path(args.measured), Path(args.survey) if args.survey else None)
    strips = strips_of(measured.pieces)
    maps: list[DenseWall] = []
    mapped: list[Strip] = []
    problem: ArgumentError | None = None
    with Progress("dense", 100 * len(strips), args.json) as bar:
        for n, strip in enumerate(strips):
            try:
                found = dense_wall(
                    measured.picture,
                    measured.camera,
                    measured.poses,
                    strip.wall,
                    cell=args.cell / 1000 if args.cell else None,
                    scale=args.scale,
                    raw=args.raw,
                    threads=args.threads,
                    tell=lambda done, n=n: bar.update(round(100 * (n + 0.8 * done))),
                )
                found.cracks.extend(
                    find_cracks(
                        found,
                        measured.picture,
                        measured.camera,
                        measured.poses,
                        tell=lambda done, n=n: bar.update(round(100 * (n + 0.8 + 0.2 * done)), "cracks"),
                    )
                )
            except ArgumentError as error:
                problem = error
                continue
            maps.append(found)
            mapped.append(strip)
        if not maps:
            raise PipefishError(f"{args.measured}: nothing was measured densely: {problem or 'no wall'}")
        summary, made = measured.document["summary"], fingerprint(Path(args.measured))
        document, files = write_dense(Path(args.output), maps, mapped, measured.unit, summary, made)
    return document, _text(document, files)


def _text(document: dict[str, Any], files: list[str]) -> str:
    """The result for people."""
    from pipefish.dense_findings import finding_parts, findings_of
    from pipefish.measured_texts import event_text, length_text

    unit = document["unit"]
    low, middle, high = document["deviation_p05_p50_p95"] or (0.0, 0.0, 0.0)
    sigma = document["sigma_median"]  # None: nothing was measured
    rows: list[tuple[str, object]] = [
        ("pairs", f"{document['pairs']} of keyframes"),
        (
            "cells",
            f"{document['measured']} of {length_text(document['cell'], unit)}, {100 * document['coverage']:.0f} % of "
            "those in view of two pairs",
        ),
        ("a cell is known", "-" if sigma is None else f"to ± {length_text(Z95 * sigma, unit)} (median)"),
        (
            "off the tube",
            f"median {length_text(middle, unit)}, 90 % within {length_text(low, unit)} to {length_text(high, unit)}",
        ),
    ]
    if document["scale_sigma"]:
        rows.append(("scale", f"± {100 * Z95 * document['scale_sigma']:.2g} % of every radius, in common"))
    found_there = findings_of(document)
    for e in found_there[:40]:
        rows.append((e["kind"], event_text(e, unit, finding_parts(e, unit))))
    if len(found_there) > 40:
        rows.append(("and", f"{len(found_there) - 40} more findings"))
    rows.append(("intervals", SAID))
    return table([*rows, *(("written", f) for f in files)])


def add_dense(commands: Any) -> None:
    """Adds `dense` to the command line."""
    p = add_command(
        commands,
        "dense",
        run_dense,
        "Measure the wall of a reconstructed survey densely: keyframes are unrolled onto the fitted tube and matched; "
        "writes a map of how far the wall is from the tube and how well each cell is known, as tables, arrays, a "
        "picture and a point cloud, and what stands in or out of it, steps of joints and cracks.",
        "pipefish reconstruct survey.mcap -o out/ && pipefish dense out/ -o out/dense/",
    )
    p.add_argument("measured", metavar="DIR", help="of pipefish reconstruct")
    p.add_argument("-o", "--output", required=True, metavar="FOLDER", help="for what is written")
    p.add_argument("--survey", metavar="SURVEY", help="the survey file [where it was when DIR was made]")
    p.add_argument("--cell", type=float, metavar="MM", help="side of the map's cells [a hundredth of the diameter]")
    p.add_argument(
        "--scale",
        type=float,
        default=1.0,
        metavar="N",
        help="pixels of the pictures to a cell of the unrolled ones; 2 takes a quarter of the time [1]",
    )
    p.add_argument("--raw", action="store_true", help="match the pictures as they are: to check the unrolled way by")
    p.add_argument("--threads", type=positive, default=1, metavar="N", help="do not change the result [1]")
