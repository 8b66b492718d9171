"""The command `pipefish homography`."""

from __future__ import annotations

import argparse
from typing import Any

from pipefish.cli import Result, add_command, table
from pipefish.errors import ArgumentError, FormatError


def run_homography(args: argparse.Namespace) -> Result:
    """Homographies between the conics of two files."""
    import numpy as np

    from pipefish.conics import ellipse_centre, homography_from_conics, load_conics, map_conics, match_conics

    if (paired := _target_and_picture(args.first, args.second)) is not None:
        (first, second), one, two = paired, True, True
    else:
        (first, one), (second, two) = load_conics(args.first), load_conics(args.second)
    for path, conics in ((args.first, first), (args.second, second)):
        if len(conics) < 2:
            raise FormatError(path, None, f"{len(conics)} conics, at least 2 are needed")
    if one and two:
        if len(first) != len(second):
            raise ArgumentError(f"{args.first} has {len(first)} conics, {args.second} {len(second)}")
        pairs = [(k, k) for k in range(len(first))]
    else:
        pairs = match_conics(first, second)
    a, b = first[[i for i, _ in pairs]], second[[j for _, j in pairs]]
    found = homography_from_conics(a, b)
    rows: list[tuple[str, object]] = [("conics", f"{len(pairs)} pairs")]
    candidates = []
    for k, h in enumerate(found):
        with np.errstate(all="ignore"):
            off = np.linalg.norm(ellipse_centre(map_conics(h, a)) - ellipse_centre(b), axis=1)
        candidates.append({"homography": h.tolist(), "centre_rms": float(np.sqrt((off**2).mean()))})
        name = "homography" if len(found) == 1 else f"candidate {k + 1}"
        rows += [(name if r == 0 else " ", "  ".join(f"{x:14.8g}" for x in row)) for r, row in enumerate(h)]
    if len(found) == 1:
        rows.append(
            ("centres", f"{candidates[0]['centre_rms']:.4g} rms from where they are, in units of {args.second}")
        )
    return {"pairs": pairs, "candidates": candidates}, table(rows)


def _target_and_picture(first: str, second: str) -> tuple[Any, Any] | None:
    """Conics of a target and of a picture of it, each beside its own, where the two files are these."""
    from pathlib import Path

    from pipefish.conics import circles_of, discs_of_target, is_target, load_picture
    from pipefish.files import PICTURES
    from pipefish.target import Target

    for target, picture in ((first, second), (second, first)):
        if Path(picture).suffix.lower() in PICTURES and is_target(target):
            described = Target.load(target)
            seen, ids = discs_of_target(described, load_picture(picture))
            sheet = circles_of(described)[ids]
            return (sheet, seen) if target == first else (seen, sheet)
    return None


def add_homography(commands: Any) -> None:
    """Adds `homography` to the command line."""
    p = add_command(
        commands,
        "homography",
        run_homography,
        "Compute the homography that maps the conics of one file to those of another: from three or more one, from two "
        "all candidates.",
        "pipefish homography plan.json picture.png\n  pipefish homography conics1.csv conics2.csv --json",
    )
    p.add_argument(
        "first",
        metavar="FROM",
        help="conics as .json or .csv (6 coefficients or 9 entries each), a target's .json, or a picture of dark discs",
    )
    p.add_argument("second", metavar="TO", help="the same; in files the order counts, discs in pictures are matched")
