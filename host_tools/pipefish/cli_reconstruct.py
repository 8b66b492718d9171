"""`pipefish reconstruct` and `pipefish report`: from a survey to a measured pipe and what a surveyor hands over."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from pipefish.cli import Result, UsageError, add_command, table


def _millimetres(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} is not a length above zero")
    return value / 1000


def _limit(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    try:
        number = float(value)
    except ValueError:
        equals = ""
    if not equals or not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"'{text}' is not NAME=NUMBER")
    return name, number


def add_reconstruct(commands: Any) -> None:
    """Adds the commands."""
    from pipefish.cli_profile import add_profile_input

    p = add_command(
        commands,
        "reconstruct",
        run_reconstruct,
        "Measure the pipe of a survey: poses, points, diameters and ovality with intervals, bends, joints, deposits.",
        "pipefish reconstruct survey.mcap -o out/ && pipefish report out/ -o report.html",
    )
    p.add_argument("survey", metavar="SURVEY", help="survey file, complete or .partial")
    p.add_argument("-o", "--output", required=True, metavar="DIR", help="folder for the files")
    p.add_argument("--profile", metavar="PROFILE", help="camera profile, or another program's [the survey's]")
    p.add_argument(
        "--diameter",
        type=_millimetres,
        metavar="MM",
        help="known true inner diameter: the scale where there is no encoder, a check where there is one",
    )
    p.add_argument("--nominal", type=_millimetres, metavar="MM", help="nominal diameter [the survey's]")
    p.add_argument(
        "--method",
        choices=("hierarchical", "incremental"),
        default="hierarchical",
        help="how poses are found [hierarchical]",
    )
    add_profile_input(p)

    p = add_command(
        commands,
        "report",
        run_report,
        "Write one HTML page about a measured pipe: figures and limits, profile, findings, 3-D, quality. No network.",
        "pipefish report out/ -o report.html --limit ovality=5 --limit d_min=285",
    )
    p.add_argument("folder", metavar="DIR", help="of pipefish reconstruct")
    p.add_argument("-o", "--output", required=True, metavar="FILE", help="page to write")
    p.add_argument(
        "--limit",
        type=_limit,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a limit that must hold all along the pipe; may be repeated: ovality, ovality_nominal, ovality_astm, "
        "reduction_nominal (at most, %%), d_max (at most, mm), d_min (at least, mm)",
    )
    p.add_argument("--title", help="of the page [the survey's name]")


def run_reconstruct(args: argparse.Namespace) -> Result:
    """Runs the command."""
    from pipefish.measure import measure
    from pipefish.measured_files import write_measurement
    from pipefish.progress import Progress
    from pipefish.survey import Survey

    camera = None
    if args.profile:
        from pipefish.cli_profile import load_profile

        camera = load_profile(args).camera
    with Progress("reconstruct", 100, args.json) as bar:
        measured = measure(
            Survey.open(args.survey),
            camera,
            diameter=args.diameter,
            nominal=args.nominal,
            method=args.method,
            tell=lambda done, word: bar.update(round(100 * done), word),
        )
        bar.update(97, "writing files")
        document, files = write_measurement(measured, Path(args.output))
    return document, reconstruct_text(document, files)


def reconstruct_text(document: dict[str, Any], files: list[str]) -> str:
    """The result for people."""
    from pipefish.measured_texts import events_text, length_text, percent_text

    s = document["summary"]
    unit = s["unit"]
    shared = length_text(1.96 * s["d_mean_systematic"], unit)
    rows: list[tuple[str, object]] = [
        ("status", document["status"]),
        (
            "keyframes",
            f"{s['keyframes_with_pose']} of {s['keyframes']} with a pose"
            + (f", in {s['stretches']} stretches" if s["stretches"] > 1 else ""),
        ),
        ("points", s["points"]),
        ("path", length_text(s["path_length"], unit, metres=True)),
    ]
    if s["diameter_from_prior"]:
        rows.append(
            (
                "mean diameter",
                "given, not measured" if unit == "metre" else "not measured: no scale (lengths in diameters)",
            )
        )
    else:
        rows.append(
            (
                "mean diameter",
                f"{length_text(s['d_mean'], unit)} +- {length_text(1.96 * s['d_mean_sigma'], unit)} (95 %, "
                "repeatability) "
                f"+- {shared} (95 %, systematic)",
            )
        )
    rows.append(
        (
            "along the pipe",
            f"{length_text(s['d_mean_least'], unit)} to {length_text(s['d_mean_most'], unit)}, "
            f"{s['stations_measured']} of {s['stations']} stations",
        )
    )
    if "ovality_mean" in s:
        rows.append(
            (
                "ovality",
                f"mean {percent_text(s['ovality_mean'])}, most {percent_text(s['ovality_most'])} at "
                f"{length_text(s['ovality_most_at'], unit, metres=True)} ((max - min) / mean)",
            )
        )
    rows += [(e["kind"].replace("_", " "), events_text(e, unit)) for e in document["events"]]
    if document["quality"]["profile"]:
        rows.append(("profile", document["quality"]["profile"]["text"]))
    rows += [("note", remark) for remark in document["remarks"]]
    rows += [("written", file) for file in files]
    return table(rows)


def run_report(args: argparse.Namespace) -> Result:
    """Runs the command."""
    from pipefish.measured_texts import LIMITS
    from pipefish.report import write_report

    unknown = [name for name, _ in args.limit if name not in LIMITS]
    if unknown:
        raise UsageError(f"--limit {unknown[0]}: not one of {', '.join(LIMITS)}")
    out = Path(args.output)
    verdicts = write_report(Path(args.folder), out, limits=args.limit, title=args.title)
    document = {"file": str(out), "bytes": out.stat().st_size, "limits": verdicts}
    rows = [(f"limit {v['name']}", v["text"]) for v in verdicts]
    return document, table([*rows, ("written", str(out))])
