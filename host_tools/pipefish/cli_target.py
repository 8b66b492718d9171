"""The command `pipefish target`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, table
from pipefish.errors import ArgumentError

KINDS = ("checkerboard", "circles", "asymmetric-circles", "charuco", "sleeve")  # target.KINDS, whose import costs time
GRIDS = {"checkerboard": (11, 8), "circles": (9, 7), "asymmetric-circles": (4, 11), "charuco": (9, 7)}


def grid(text: str) -> tuple[int, int]:
    """COLUMNSxROWS."""
    cols, _, rows = text.lower().partition("x")
    if not cols.isdecimal() or not rows.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not COLUMNSxROWS, such as 11x8")
    return int(cols), int(rows)


def millimetres(text: str) -> float:
    """A length above zero."""
    value = float(text.lower().removesuffix("mm"))
    if not 0 < value < 1e5:
        raise argparse.ArgumentTypeError(f"{text} is not a length in mm above zero")
    return value / 1000


def made_target(args: argparse.Namespace) -> Any:
    """The Target of the arguments; what is not given is chosen to fill the paper. Raises ArgumentError."""
    from pipefish.target import Target
    from pipefish.targetprint import fitting

    more = {name: value for name in ("radius_m", "margin_m") if (value := getattr(args, name)) is not None}
    if args.kind == "charuco":
        more["first_marker"] = args.first_marker
    if args.kind != "sleeve":
        if args.diameter is not None:
            raise ArgumentError(f"--diameter: is for a sleeve, not for {args.kind}")
        cols, rows = args.grid or GRIDS[args.kind]
        spacing = args.spacing or fitting(args.kind, cols, rows, args.paper)
        return Target(args.kind, rows, cols, spacing, **{"margin_m": spacing / 2} | more)
    if args.diameter is None:
        raise ArgumentError("--diameter: a sleeve needs the pipe's inside diameter in mm")
    # About 48 mm between discs around, at least 16 of them, and rings as far apart.
    cols, rows = args.grid or (max(16, 2 * round(args.diameter * 3.1416 / 0.096)), 4)
    spacing = args.spacing or round(args.diameter * 3.1416 / cols, 3)
    return Target(args.kind, rows, cols, spacing, diameter_m=args.diameter, **more)


def run_target(args: argparse.Namespace) -> Result:
    """Writes the PDF and beside it the JSON."""
    from pipefish.files import write_atomically
    from pipefish.targetprint import describe, pages, print_target, what_to_measure

    target = made_target(args)
    out = Path(args.output)
    if out.suffix.lower() != ".pdf":
        raise ArgumentError(f"--output: {out}: the name must end in .pdf")
    data, count = print_target(target, args.paper), len(pages(target, args.paper))
    beside = out.with_suffix(".json")
    write_atomically(out, data)
    target.save(beside)
    document = {"pdf": str(out), "json": str(beside), "pages": count, "paper": args.paper, "target": target.to_dict()}
    rows = [
        ("target", describe(target)),
        ("paper", f"{args.paper}, {count} page{'s' if count > 1 else ''}"),
        ("print", f"{out}, at 100 %; its ruler must then be 100 mm"),
        ("measure", what_to_measure(target)),
        ("description", f"{beside}, for pipefish calibrate --target"),
    ]
    return document, table(rows)


def add_target(commands: Any) -> None:
    """Adds `target` to the command line."""
    p = add_command(
        commands,
        "target",
        run_target,
        "Make a calibration target to print: a PDF at true scale, and beside it a JSON file that tells detection and "
        "calibration what it is.",
        "pipefish target checkerboard --grid 11x8 --spacing 30 --paper A3 -o board.pdf\n"
        "  pipefish target sleeve --diameter 297.5 --paper A3 -o sleeve.pdf",
    )
    p.add_argument("kind", metavar="KIND", choices=KINDS, help=", ".join(KINDS))
    p.add_argument("-o", "--output", required=True, metavar="FILE.pdf", help="the PDF; FILE.json is written beside it")
    p.add_argument(
        "--grid",
        type=grid,
        metavar="COLSxROWS",
        help="squares (a checkerboard's corners are one fewer each way) or circles [11x8, circles 9x7, asymmetric "
        "circles 4x11, charuco 9x7, a sleeve as fits]",
    )
    p.add_argument(
        "--spacing",
        type=millimetres,
        metavar="MM",
        help="a square's side, or from centre to centre [as large as fits the paper]",
    )
    p.add_argument("--radius", type=millimetres, metavar="MM", dest="radius_m", help="of circles [0.2 to 0.3 spacings]")
    p.add_argument("--margin", type=millimetres, metavar="MM", dest="margin_m", help="white around it [half a spacing]")
    p.add_argument("--diameter", type=millimetres, metavar="MM", help="inside diameter of the pipe, for a sleeve")
    p.add_argument("--first-marker", type=int, default=0, metavar="N", help="number of a charuco's first marker [0]")
    p.add_argument("--paper", default="A4", metavar="SIZE", help="A0 to A4, letter, or WIDTHxHEIGHT in mm [A4]")
