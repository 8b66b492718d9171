"""`pipefish reconstruct`, `unroll` and `report`: from a survey to a measured pipe and what a surveyor hands over."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path
from typing import Any

from pipefish.cli import DONE, FAILED, Result, UsageError, add_command, table
from pipefish.intervals import SAID, Z95

LEAST_MM = 10  # no pipe is as narrow, none as short: who says less means metres or inches


def _millimetres(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} is not a length above zero")
    return value / 1000


def _check_pipe(text: str, value: float) -> None:
    """value: metres."""
    if value < LEAST_MM / 1000:
        raise argparse.ArgumentTypeError(f"'{text}' is in millimetres: no pipe has less than {LEAST_MM}")


def _nominal(text: str) -> float:
    value = _millimetres(text)
    _check_pipe(text, value)
    return value


def _known(text: str) -> Any:
    """A length in millimetres with its tolerance, which is taken for 95 %: 1000, 1000+-2, 1000mm±2. On a
    keyboard +- is easier."""
    from pipefish.scale import Known

    number = r"([0-9]+(?:\.[0-9]*)?)\s*(?:mm)?"
    found = re.fullmatch(rf"\s*{number}\s*(?:(?:\+-|\+/-|±)\s*{number})?\s*", text)
    if not found or float(found[1]) <= 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a length in mm such as 1000 or 1000+-2")
    value = float(found[1]) / 1000
    _check_pipe(text, value)
    return value if found[2] is None else Known(value, float(found[2]) / 1000 / Z95)


def _hour(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 12:
        raise argparse.ArgumentTypeError(f"{text} is not on a clock, 0 to 12")
    return value * math.pi / 6


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
    """Adds `reconstruct` to the command line."""
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
        type=_known,
        metavar="MM[+-MM]",
        help="known true inner diameter (95 %%) [exact]: the scale where nothing else tells it, a check elsewhere",
    )
    p.add_argument(
        "--joint-spacing",
        type=_known,
        metavar="MM[+-MM]",
        help="from one joint to the next (95 %%) [± 1 %%]: with the joints that are found it tells the scale",
    )
    p.add_argument(
        "--target",
        metavar="FILE",
        help="a flat target in the pipe, as `pipefish target` describes it: where it is seen it tells the scale",
    )
    p.add_argument("--nominal", type=_nominal, metavar="MM", help="nominal diameter [the survey's]")
    p.add_argument(
        "--method",
        choices=("hierarchical", "incremental"),
        default="hierarchical",
        help="how poses are found [hierarchical]",
    )
    p.add_argument(
        "--line-time",
        type=float,
        metavar="US",
        help="of a rolling shutter: microseconds from a row's exposure to the next one's [as the survey says]; 0: none",
    )
    add_profile_input(p)


def run_reconstruct(args: argparse.Namespace) -> Result:
    """Measures a survey and writes the files."""
    from pipefish.measure import measure
    from pipefish.measured_files import write_measurement
    from pipefish.progress import Progress
    from pipefish.survey import Survey
    from pipefish.target import Target

    camera = None
    if args.line_time is not None and not abs(args.line_time) <= 1000.0:
        raise UsageError(f"reconstruct: --line-time: {args.line_time:g} is not within 1000 microseconds")
    if args.profile:
        from pipefish.cli_profile import load_profile

        camera = load_profile(args).camera
    with Progress("reconstruct", 100, args.json) as bar:
        measured = measure(
            Survey.open(args.survey),
            camera,
            diameter=args.diameter,
            joint_spacing=args.joint_spacing,
            target=Target.load(args.target) if args.target else None,
            nominal=args.nominal,
            method=args.method,
            line_time=None if args.line_time is None else 1e-6 * args.line_time,
            tell=lambda done, word: bar.update(round(100 * done), word),
        )
        bar.update(97, "writing files")
        document, files = write_measurement(
            measured, Path(args.output), lambda done, word: bar.update(round(97 + 3 * done), "writing files")
        )
    return document, reconstruct_text(document, files)


def reconstruct_text(document: dict[str, Any], files: list[str]) -> str:
    """The result for people."""
    from pipefish.measured_reach import reach_text
    from pipefish.measured_texts import event_text

    unit = document["summary"]["unit"]
    rows = _figures(document)
    rows += [(e["kind"].replace("_", " "), event_text(e, unit)) for e in document["events"]]
    rows.append(
        ("findings", reach_text(document["findings_reach"], unit) + " `pipefish dense` finds smaller ones, and cracks.")
    )
    verdict = document["quality"]["profile"]
    if verdict and not any(remark.startswith(verdict["text"].rstrip(".")) for remark in document["remarks"]):
        rows.append(("profile", verdict["text"]))
    rows += [("note", remark) for remark in document["remarks"]]
    rows.append(("intervals", SAID))
    rows += [("written", file) for file in files]
    rows += [("about files", told) for told in document["file_remarks"]]
    return table(rows)


def _figures(document: dict[str, Any]) -> list[tuple[str, object]]:
    """What was measured, and how much of the pipe."""
    from pipefish.measured_texts import length_text, scale_texts

    s = document["summary"]
    unit = s["unit"]
    stretches = f", in {s['stretches']} stretches" if s["stretches"] > 1 else ""
    if s["diameter_from_prior"]:
        mean = "given, not measured" if unit == "metre" else "not measured: no scale (lengths in diameters)"
    else:
        of_all, most = Z95 * s["d_mean_systematic"], Z95 * s["station_systematic_most"]
        value, own, shared, there = (length_text(v, unit) for v in (s["d_mean"], Z95 * s["d_mean_sigma"], of_all, most))
        mean = f"{value} ± {own} (repeatability) ± {shared} (systematic: scale and camera; at stations up to ± {there})"
    span = f"{length_text(s['d_mean_least'], unit)} to {length_text(s['d_mean_most'], unit)}"
    rows: list[tuple[str, object]] = [
        ("status", document["status"]),
        ("keyframes", f"{s['keyframes_with_pose']} of {s['keyframes']} with a pose{stretches}"),
        ("points", s["points"]),
        ("path", length_text(s["path_length"], unit, metres=True)),
        ("mean diameter", mean),
        *(("scale", told) for told in scale_texts(document["scale"])),
        ("along the pipe", f"{span}, {s['stations_measured']} of {s['stations']} stations"),
    ]
    if "ovality_rms" in s:
        rows.append(("ovality", _ovality(document)))
    return rows


def _ovality(document: dict[str, Any]) -> str:
    """Along the pipe, and where it is most, with its interval."""
    from pipefish.measured_limits import most_oval
    from pipefish.measured_texts import length_text, percent_text

    s = document["summary"]
    at = length_text(s["ovality_most_at"], s["unit"], metres=True)
    most = f"{100 * s['ovality_most']:.2f} ± {100 * most_oval(document):.2f} %"
    return f"{percent_text(s['ovality_rms'])} (rms along the pipe), most {most} at {at} ((max - min) / mean)"


def add_unroll(commands: Any) -> None:
    """Adds `unroll` to the command line."""
    p = add_command(
        commands,
        "unroll",
        run_unroll,
        "Draw the wall as one picture at true scale: chainage by clock, best view of each place, in one light.",
        "pipefish unroll out/ -o unrolled.png --labels",
    )
    p.add_argument("source", metavar="DIR|SURVEY", help="of pipefish reconstruct; or a survey file, measured first")
    p.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="PNG to write; a .json beside it says where each pixel is"
    )
    p.add_argument("--survey", metavar="FILE", help="survey with the pictures [where it was when it was measured]")
    p.add_argument("--mm", type=_millimetres, metavar="MM", help="of wall a pixel [as fine as the pictures show it]")
    p.add_argument("--cut", type=_hour, default=0.0, metavar="HOUR", help="clock of the upper edge, 0 to 12 [12]")
    p.add_argument("--from", dest="start", type=float, metavar="M", help="chainage to begin with, metres")
    p.add_argument("--to", dest="end", type=float, metavar="M", help="chainage to end with, metres")
    p.add_argument("--labels", action="store_true", help="clock, chainage and a scale bar around the picture")


def run_unroll(args: argparse.Namespace) -> Result:
    """Runs the command."""
    from pipefish.progress import Progress
    from pipefish.unroll import Unroller
    from pipefish.unroll_files import check_name, from_source, write_unrolled

    check_name(Path(args.output))
    span = None
    if args.start is not None or args.end is not None:
        span = (-math.inf if args.start is None else args.start, math.inf if args.end is None else args.end)
        if not span[0] < span[1]:
            raise UsageError(f"unroll: --from {span[0]:g} --to {span[1]:g}: ends before it begins")
    with Progress("unroll", 100, args.json) as bar:

        def tell(done: float, word: str) -> None:
            bar.update(round(100 * done), word)

        wall = from_source(Path(args.source), Path(args.survey) if args.survey else None, tell)
        if args.mm is not None and wall.unit != "metre":
            raise UsageError("--mm: there is no scale, lengths are in mean diameters")
        unroller = Unroller(wall, cell=args.mm, cut=args.cut, span=span, tell=tell)
        document, files = write_unrolled(unroller, Path(args.output), labels=args.labels, tell=tell)
    scale = document["scale"]
    resolved = f", the pictures resolve {scale['resolved']:.2g}" if scale["resolved"] else ""
    rows: list[tuple[str, object]] = [
        ("picture", f"{document['columns']} x {document['rows']} pixels"),
        ("scale", f"{scale['along']:.4g} {scale['unit']} along, {scale['around']:.4g} around{resolved}"),
        ("seen", f"{100 * document['seen']:.2f} % of the wall"),
        ("keyframes", len({k["keyframe"] for k in document["keyframes"]})),
        *(("not seen", f"{n['start']:.2f} to {n['end']:.2f}") for n in document["not_seen"]),
        *(("written", file) for file in files),
    ]
    return document, table(rows)


def add_report(commands: Any) -> None:
    """Adds `report` to the command line."""
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
        "ovality_astm_max, reduction_nominal (at most, %%), d_max (at most, mm), d_min (at least, mm). Unless all "
        "passed the exit code is 1",
    )
    p.add_argument("--survey", metavar="FILE", help="survey with the pictures [where it was when it was measured]")
    p.add_argument("--dense", metavar="FOLDER", help="of pipefish dense: its findings and map [DIR/dense, if there]")
    p.add_argument("--title", help="of the page [the survey's name]")


def run_report(args: argparse.Namespace) -> Result:
    """Runs the command."""
    from pipefish.measured_limits import LimitError, all_hold, check_limits
    from pipefish.progress import Progress
    from pipefish.report import write_report

    out = Path(args.output)
    try:
        check_limits(args.limit)
        with Progress("report", 100, args.json) as bar:
            verdicts = write_report(
                Path(args.folder),
                out,
                limits=args.limit,
                title=args.title,
                survey=Path(args.survey) if args.survey else None,
                dense=Path(args.dense) if args.dense else None,
                tell=lambda done, word: bar.update(round(100 * done), word),
            )
    except LimitError as error:
        raise UsageError(f"report: --limit {error}") from error
    document = {"file": str(out), "bytes": out.stat().st_size, "limits": verdicts}
    rows = [(f"limit {v['name']}", v["text"]) for v in verdicts]
    rows += [("intervals", SAID)] if verdicts else []
    return document, table([*rows, ("written", str(out))]), DONE if all_hold(verdicts) else FAILED
