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


def dictionary(text: str) -> str:
    """A name of target.DICTIONARIES, with or without DICT_."""
    from pipefish.target import DICTIONARIES, OWN

    known = {name.lower(): name for name in (OWN, *DICTIONARIES)}
    name = known.get(text.lower().removeprefix("dict_"))
    if name is None:
        raise argparse.ArgumentTypeError(f"'{text}' is none of {', '.join((OWN, *DICTIONARIES))}")
    return name


def made_target(args: argparse.Namespace) -> Any:
    """The Target of the arguments; what is not given is chosen to fill the paper. Raises ArgumentError."""
    from pipefish.target import Target
    from pipefish.targetprint import fitting

    cols, rows = _grid_of(args)
    more = {name: value for name in ("radius_m", "margin_m") if (value := getattr(args, name)) is not None}
    markers = {"dictionary": args.dictionary, "legacy": args.legacy or None, "first_marker": args.first_marker}
    given = {name: value for name, value in markers.items() if value is not None}
    if args.kind != "charuco" and (given or args.marker is not None):
        raise ArgumentError(f"--dictionary, --marker, --legacy, --first-marker: are for charuco, not for {args.kind}")
    if (args.diameter is None) == (args.kind == "sleeve"):
        if args.diameter is None:
            raise ArgumentError("--diameter: a sleeve needs the pipe's inside diameter in mm")
        raise ArgumentError(f"--diameter: is for a sleeve, not for {args.kind}")
    if args.diameter is not None:
        # About 48 mm between discs around, at least 16 of them, and rings as far apart.
        cols, rows = (cols, rows) if cols else (max(16, 2 * round(args.diameter * 3.1416 / 0.096)), 4)
        spacing = args.spacing or round(args.diameter * 3.1416 / cols, 3)
        return Target(args.kind, rows, cols, spacing, diameter_m=args.diameter, **more)
    cols, rows = (cols, rows) if cols else GRIDS[args.kind]
    spacing = args.spacing or fitting(args.kind, cols, rows, args.paper)
    if args.marker is not None:
        given["marker_share"] = args.marker / spacing
    return Target(args.kind, rows, cols, spacing, **{"margin_m": spacing / 2} | more | given)


def _grid_of(args: argparse.Namespace) -> tuple[int, int]:
    """(0, 0): not given."""
    if args.corners is None:
        return args.grid or (0, 0)
    if args.kind not in ("checkerboard", "charuco"):
        raise ArgumentError(f"--corners: is for checkerboard and charuco; a {args.kind} has --grid")
    if args.grid is not None:
        raise ArgumentError("--corners, --grid: give one: squares are one more each way than inner corners")
    return args.corners[0] + 1, args.corners[1] + 1


def run_target(args: argparse.Namespace) -> Result:
    """Writes the PDF and beside it the JSON, or of a target that is there already the JSON alone."""
    from pipefish.files import write_atomically
    from pipefish.targetprint import describe, pages, print_target, what_to_measure

    out = Path(args.output)
    described = out.suffix.lower() == ".json"
    if not described and out.suffix.lower() != ".pdf":
        raise ArgumentError(f"--output: {out}: the name must end in .pdf, or in .json to describe a target you have")
    if described and (args.spacing is None or (args.grid is None and args.corners is None)):
        raise ArgumentError(
            f"--output: {out}: to describe a target you have give its --grid (or --corners) and its --spacing, measured"
        )
    target = made_target(args)
    beside = out.with_suffix(".json")
    document: dict[str, Any] = {"pdf": None, "json": str(beside), "pages": 0, "paper": None}
    rows = [("target", describe(target))]
    if not described:
        data, count = print_target(target, args.paper), len(pages(target, args.paper))
        write_atomically(out, data)
        document |= {"pdf": str(out), "pages": count, "paper": args.paper}
        rows += [
            ("paper", f"{args.paper}, {count} page{'s' if count > 1 else ''}"),
            ("print", f"{out}, at 100 %; its ruler must then be 100 mm"),
        ]
    target.save(beside)
    document["target"] = target.to_dict()
    rows += [
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
        "calibration what it is. Or describe one that you have: -o FILE.json writes that file alone.",
        "pipefish target checkerboard --grid 11x8 --spacing 30 --paper A3 -o board.pdf\n"
        "  pipefish target sleeve --diameter 297.5 --paper A3 -o sleeve.pdf\n"
        "  pipefish target checkerboard --corners 9x6 --spacing 25.1 -o mine.json\n"
        "  pipefish target charuco --grid 7x5 --spacing 40 --marker 30 --dictionary DICT_4X4_50 -o mine.json",
    )
    p.add_argument("kind", metavar="KIND", choices=KINDS, help=", ".join(KINDS))
    p.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="FILE.pdf, and FILE.json beside it; or only FILE.json"
    )
    p.add_argument(
        "--grid",
        type=grid,
        metavar="COLSxROWS",
        help="squares (a checkerboard's corners are one fewer each way) or circles [11x8, circles 9x7, asymmetric "
        "circles 4x11, charuco 9x7, a sleeve as fits]",
    )
    p.add_argument(
        "--corners",
        type=grid,
        metavar="COLSxROWS",
        help="instead of --grid: inner corners of a checkerboard or charuco, as other programs count",
    )
    p.add_argument(
        "--spacing",
        type=millimetres,
        metavar="MM",
        help="a square's side, or from centre to centre; of asymmetric circles within a row, twice the step from row "
        "to row; of a sleeve from ring to ring [as large as fits the paper]",
    )
    p.add_argument("--radius", type=millimetres, metavar="MM", dest="radius_m", help="of circles [0.2 to 0.3 spacings]")
    p.add_argument("--margin", type=millimetres, metavar="MM", dest="margin_m", help="white around it [half a spacing]")
    p.add_argument("--diameter", type=millimetres, metavar="MM", help="inside diameter of the pipe, for a sleeve")
    group = p.add_argument_group("markers of a charuco")
    group.add_argument(
        "--dictionary",
        type=dictionary,
        metavar="NAME",
        help="OpenCV's name of them: DICT_4X4_50, DICT_6X6_250, DICT_APRILTAG_36h11, ... [pipefish: our own]",
    )
    group.add_argument("--marker", type=millimetres, metavar="MM", help="side of a marker [0.7 of a square's]")
    group.add_argument("--first-marker", type=int, metavar="N", help="number of the first one [0]")
    group.add_argument(
        "--legacy",
        action="store_true",
        help="an even number of rows that begins with a marker, not with a dark square: as OpenCV before 4.6 made them",
    )
    p.add_argument("--paper", default="A4", metavar="SIZE", help="A0 to A4, letter, or WIDTHxHEIGHT in mm [A4]")
