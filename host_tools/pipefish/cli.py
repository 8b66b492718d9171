"""The command `pipefish`. Heavy imports happen in the commands, so that --help is quick."""

from __future__ import annotations

import argparse
import json
import sys
import unicodedata
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NoReturn

from pipefish import __version__
from pipefish.errors import PipefishError

DONE, FAILED, USAGE = 0, 1, 2
DEFAULT_BAUD = 921600  # the same as transport.DEFAULT_BAUD, whose import costs time here


class UsageError(PipefishError):
    """Arguments that do not go together."""


DEVICE_HELP = (
    "serial:/dev/ttyUSB0@3000000 (hardware flow control: @3000000,rtscts), /dev/ttyUSB0 (speed from --baud), "
    "tls://host:port or tcp://host:port"
)


def printable(text: str) -> str:
    """As a terminal may have it: a survey's or a device's texts could hold codes that clear it or fake other lines."""
    return "".join(c if c in "\n\t" or unicodedata.category(c)[0] != "C" else f"\\u{ord(c):04x}" for c in text)


def table(rows: Iterable[tuple[str, object]]) -> str:
    """Two aligned columns, a line a row; rows whose value is None or "" are left out."""
    shown = [(name, str(value).replace("\n", "\\n")) for name, value in rows if value is not None and value != ""]
    width = max((len(name) for name, _ in shown), default=0)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in shown)


def size_text(count: float) -> str:
    """Bytes for people."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def seconds_text(seconds: float) -> str:
    """A duration for people."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min {rest:02d} s"


# ---- commands: each returns (document for --json, text for people), and an exit code where that is not DONE

Result = tuple[dict[str, Any], str] | tuple[dict[str, Any], str, int]


def run_demo(args: argparse.Namespace) -> Result:
    from pipefish.demo import demo, figures

    summary, page = demo(
        Path(args.out), frames=args.frames, build_dir=args.build_dir, quiet=args.json, fresh=args.fresh
    )
    return summary, f"{figures(summary)}\n{page}"


def run_receive(args: argparse.Namespace) -> Result:
    from pipefish.receive import receive
    from pipefish.transport import open_transport

    summary = receive(
        open_transport(args.device, args.baud),
        Path(args.output),
        overwrite=args.overwrite,
        timeout_s=args.timeout,
        quiet=args.json,
        live=args.live,
    )
    from pipefish.live import summary_rows

    link = summary["link"]
    goodput = link["goodput_bytes_per_s"]
    recovered = summary["recovered_objects"]
    rows = [
        ("file", summary["file"]),
        (
            "keyframes",
            f"{summary['keyframes']}" + (f", {summary['lost']} lost on the device" if summary["lost"] else ""),
        ),
        ("received", f"{size_text(link['bytes'])} in {seconds_text(link['duration_s'])}"),
        ("goodput", f"{goodput / 1000:.1f} kB/s" if goodput else None),
        ("from before", f"{recovered} objects of an interrupted run" if recovered else None),
        ("damaged frames", f"{link['crc_errors_host']} here, {link['crc_errors_device']} on the device"),
        ("sent again", f"{link['fragments_resent']} fragments"),
        ("reconnections", link["reconnections"] or None),
        *(("other survey", f"{o['file']}: {o['keyframes']} keyframes") for o in summary["other_surveys"]),
        *(("incomplete", f) for f in summary["incomplete_surveys"]),
        *(("damaged copy", f) for f in summary["damaged_copies"]),
        *(summary_rows(summary["live"]) if "live" in summary else []),
    ]
    return summary, table(rows)


def run_info(args: argparse.Namespace) -> Result:
    from pipefish.survey import Survey

    survey = Survey.open(args.survey)
    return survey.info, info_text(survey.info)


def info_text(info: dict[str, Any]) -> str:
    """Survey.info for people."""
    import datetime

    tracks, link, profile = info["tracks"], info["link"], info["profile"]
    when = info["first_time_unix_ns"]
    started = datetime.datetime.fromtimestamp(when / 1e9).astimezone().isoformat(" ", "seconds") if when else None
    missing = (
        f"{len(info['missing'])} missing, {len(info['lost'])} of them lost on the device" if info["missing"] else ""
    )
    length = f"{info['length_m']:.2f} m" if info["length_m"] is not None else "unknown (no encoder)"
    breaks = ", ".join(f"at keyframe {b['index']} ({b['reason']})" for b in info["breaks"])
    diameter = info["nominal_diameter_m"]
    lens = ""
    if profile:
        lens = profile.get("error") or f"{profile['name'] or 'unnamed'} {profile['serial']}".strip()
    rows: list[tuple[str, object]] = [
        ("survey", info["name"] or info["survey_id"]),
        ("state", "complete" if info["complete"] else "incomplete"),
        ("started", started),
        ("device", info["software"]),
        ("source", info["source"]),
        ("profile", lens or "none"),
        (
            "picture",
            f"{info['width']} x {info['height']}" + (f" at {info['frame_rate']:g}/s" if info["frame_rate"] else ""),
        ),
        ("pipe", f"DN{diameter * 1000:.0f}" if diameter else None),
        ("length", length),
        ("duration", seconds_text(info["duration_s"]) + (f" in {info['boots']} runs" if info["boots"] > 1 else "")),
        ("frames", info["frames"]),
        ("keyframes", f"{info['keyframes']}" + (f", {missing}" if missing else "")),
        ("breaks", breaks or "none"),
    ]
    if tracks["tracks"]:
        rows += [
            ("tracks", f"{tracks['tracks']}, {tracks['per_keyframe_median']:.0f} on a typical keyframe"),
            (
                "track length",
                f"median {tracks['length_frames_median']:.0f}, 90 % up to {tracks['length_frames_p90']:.0f} camera "
                f"frames; median {tracks['length_keyframes_median']:.0f} keyframes",
            ),
        ]
    if info["states"]:
        rows.append(("states", ", ".join(f"{state} at {count} keyframes" for state, count in info["states"].items())))
    if info["lost_tracks"]:
        rows.append(("tracks lost", losses_text(info["lost_tracks"])))
    rows.append(("ended", info["end_reason"]))
    if info["object_bytes"]:
        rows.append(("received", size_text(info["object_bytes"])))
    if link.get("line"):
        goodput = link.get("goodput_bytes_per_s", "None")
        speed = f", {float(goodput) / 1000:.1f} kB/s" if goodput not in ("None", "") else ""
        rows.append(("link", f"{link['line']}{speed}, {link.get('crc_errors_host', '?')} damaged frames"))
    return table(rows)


def losses_text(losses: dict[str, int]) -> str:
    """Lost tracks by reason, most first."""
    return ", ".join(f"{count} {reason}" for reason, count in sorted(losses.items(), key=lambda item: -item[1]))


def run_show(args: argparse.Namespace) -> Result:
    from pipefish.page import write_statistics
    from pipefish.show import show
    from pipefish.survey import Survey

    survey, out = Survey.open(args.survey), Path(args.output)
    if args.stats:
        if out.suffix.lower() not in (".html", ".htm"):
            raise PipefishError(f"{out}: --stats writes a .html page")
        size = write_statistics(survey, out)
        return {"file": str(out), "kind": "statistics", "bytes": size}, f"{out} (statistics, {size_text(size)})"
    written = show(survey, out, args.keyframe, quiet=args.json, colour=args.colour)
    return written, f"{written['file']} ({written['kind']}, {size_text(float(str(written['bytes'])))})"


def hosts_text(status: Any) -> str:
    """Who is connected, as the one who asks sees it."""
    others = status.visitors - bool(status.looking_on)
    name = f" ({status.network.peer}, {status.network.role})" if status.network.peer else ""
    has = f"another host has the device{name}; this one looks on" if status.looking_on else "this one has the device"
    if status.looking_on and not status.link.up:
        has = "nobody has the device; this one looks on"
    return has + (f", {others} more look on" if others else "")


def run_status(args: argparse.Namespace) -> Result:
    from google.protobuf.json_format import MessageToDict

    from pipefish import pipefish_pb2 as pb
    from pipefish.cli_flash import stored_text
    from pipefish.client import Client, Handlers
    from pipefish.scene import losses_of, states_of
    from pipefish.transport import open_transport

    client = Client(open_transport(args.device, args.baud), Handlers())
    try:
        client.open()
        info = client.answer_to(args.timeout, get_info=pb.Nothing()).info
        status = client.answer_to(args.timeout, get_status=pb.Nothing()).status
    finally:
        client.close()
    document = {
        "info": MessageToDict(info, preserving_proto_field_name=True, always_print_fields_with_no_presence=True),
        "status": MessageToDict(status, preserving_proto_field_name=True, always_print_fields_with_no_presence=True),
    }
    link, stage = status.link, status.stage
    rows = [
        ("device", info.software),
        ("source", info.source),
        ("profile", stored_text(status.profile) if status.HasField("profile") else "none"),
        ("survey", info.survey_id.hex()),
        ("state", status.state),
        ("up for", seconds_text(status.uptime_ns / 1e9)),
        ("hosts", hosts_text(status)),
        (
            "frames",
            f"{status.frames} at {status.fps:.1f}/s, {status.frames_dropped} dropped",
        ),
        ("tracks", f"{status.tracks_live} live, {status.tracks_new} new, {status.tracks_lost} lost in the last frame"),
        ("scene", ", ".join(states_of(status.tracking)) or "nothing special"),
        ("lost so far", losses_text(losses_of(status.tracking)) or "none"),
        ("keyframes", f"{status.keyframes} made, {status.keyframes_dropped} dropped, {status.spool.evicted} given up"),
        (
            "spool",
            f"{status.spool.objects} waiting ({size_text(status.spool.bytes)})"
            + (", in trouble: see the device's log" if status.spool.failing else ""),
        ),
        (
            "link",
            f"round trip {link.rtt_us / 1000:.1f} ms, {link.crc_errors} damaged frames, "
            f"{link.fragments_resent} fragments sent again",
        ),
        ("frame time", f"{stage.pyramid + stage.track + stage.detect:.0f} us, slowest {stage.frame_max:.0f} us"),
    ]
    return document, table(rows)


def run_evaluate(args: argparse.Namespace) -> Result:
    from pipefish.evaluate import compare_with_opencv, evaluate, frames_of, verdict
    from pipefish.simulate import Scene
    from pipefish.survey import Survey

    stem = Path(args.recording)
    truth = Scene.from_truth(stem.with_name(stem.name + ".truth.json"))
    survey = Survey.open(args.survey)
    frames = frames_of(survey, stem.with_name(stem.name + ".y4m"))
    ours = evaluate(survey, truth, frames)
    if ours is None:
        raise PipefishError(f"{survey.path}: no track was seen in two keyframes")
    peer = compare_with_opencv(survey, truth, frames) if args.opencv else None
    bars = verdict(ours, peer, smooth=args.smooth)
    rows: list[tuple[str, object]] = [("", "device" + (", OpenCV's recipe" if peer else ""))]
    for name, what in (
        ("within_1px", "within 1 px"),
        ("survival", "kept of those visible"),
        ("median_px", "median error, px"),
        ("length_median", "median length, frames"),
        ("length_mean", "mean length, frames"),
        ("length_possible", "if none were lost"),
        ("whole", "share of whole lives"),
    ):
        values = [side[name] for side in (ours, peer) if side is not None]
        rows.append((what, ", ".join("-" if v is None else f"{v:.4g}" for v in values)))
    failed = [name for name, row in bars.items() if not row["holds"]]
    rows.append(("bars", "all hold" if not failed else "missed: " + ", ".join(failed)))
    return {"device": ours, "opencv": peer, "bars": bars}, table(rows)


def run_simulate(args: argparse.Namespace) -> Result:
    from pipefish import simulate as room

    if args.list:
        names = {**room.scenarios(), **room.studio_scenarios()}
        return names, table(list(names.items()))
    if args.contact_sheet:
        from pipefish.simulate_pictures import contact_sheet

        contact_sheet(Path(args.contact_sheet), quiet=args.json)
        return {"files": [args.contact_sheet]}, table([("written", args.contact_sheet)])
    if args.picture:
        from pipefish.simulate_pictures import picture

        width = {} if args.width is None else {"width": args.width}
        picture(args.scene, Path(args.picture), args.frame, changes=dict(args.set), **width)
        return {"files": [args.picture]}, table([("written", args.picture)])
    document = room.simulate(
        args.scene,
        Path(args.output),
        changes=dict(args.set),
        frames=args.frames,
        seed=args.seed,
        quiet=args.json,
    )
    what = "frames" if "frames" in document else "pictures"
    rows = [
        (what, f"{document[what]} of {document['width']} x {document['height']} pixels"),
        *([("driven", f"{document['driven_m']:.2f} m")] if what == "frames" else []),
        *(("written", file) for file in document["files"]),
    ]
    return document, table(rows)


# ---- the parser


class Parser(argparse.ArgumentParser):
    """argparse's, with wrong usage as an exception: main tells it in the form that was asked for."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        if message.startswith("argument COMMAND: invalid choice"):
            for action in ("convert", "check"):
                if f"choice: '{action}'" in message:
                    message = f"there is no command {action}; did you mean: pipefish profile {action}"
        raise UsageError(f"{self.prog.removeprefix('pipefish').strip()}: {message}".removeprefix(": "))


def setting(text: str) -> tuple[str, Any]:
    """KEY=VALUE with a value as in TOML, or a bare word."""
    import tomllib

    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"'{text}' is not KEY=VALUE")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value


def positive(text: str) -> int:
    """An argument that is a whole number above zero."""
    value = int(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{value} is not above zero")
    return value


def not_negative(text: str) -> float:
    """An argument that is a number of at least zero."""
    value = float(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{value:g} is not a number of at least zero")
    return value


def add_command(
    commands: Any, name: str, run: Callable[[argparse.Namespace], Result], what: str, example: str
) -> argparse.ArgumentParser:
    """A command with what all of them share."""
    parser = commands.add_parser(
        name,
        help=what[0].lower() + what[1:].rstrip("."),
        description=what,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help='one JSON document on stdout, nothing else there: the result, or {"error": ...}',
    )
    parser.add_argument("--debug", action="store_true", help="show a traceback on errors")
    parser.set_defaults(run=run, check=lambda _: None)
    return parser


def add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("device", metavar="DEVICE", help=DEVICE_HELP)
    parser.add_argument("--baud", type=positive, help=f"speed of a serial line [{DEFAULT_BAUD}]")


def build_parser() -> argparse.ArgumentParser:
    """The command line of `pipefish`."""
    parser = Parser(
        prog="pipefish",
        description="Measure pipes with one fisheye camera.",
        epilog="example:\n  pipefish receive /dev/ttyUSB0 --baud 3000000 -o survey.mcap\n\n"
        "`pipefish COMMAND --help` tells more.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"pipefish {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    p = add_command(
        commands,
        "demo",
        run_demo,
        "Simulate a pipe, survey it through the daemon and the link, and write a page about it.",
        "pipefish demo --out build/demo",
    )
    p.add_argument("--out", default="build/demo", help="folder for the page and all that leads to it [build/demo]")
    p.add_argument("--frames", type=positive, help="stop the simulated camera after so many frames")
    p.add_argument("--build-dir", help="where the executables are [$PIPEFISH_BUILD or build/release]")
    p.add_argument("--fresh", action="store_true", help="simulate anew even if the same recording is there")

    p = add_command(
        commands,
        "simulate",
        run_simulate,
        "Simulate a camera in a pipe: recorded frames, telemetry, and the truth about both.",
        "pipefish simulate demo -o /tmp/pipe",
    )
    p.add_argument("scene", metavar="SCENE", nargs="?", help="a name of --list, or a TOML or JSON file")
    what = p.add_mutually_exclusive_group(required=True)
    what.add_argument("-o", "--output", metavar="STEM", help="start of the names: STEM.y4m, STEM.csv, ...; a folder")
    what.add_argument("--list", action="store_true", help="tell which scenes there are")
    what.add_argument("--picture", metavar="FILE", help="draw one frame into FILE (.png, .jpg, .webp)")
    what.add_argument("--contact-sheet", metavar="FILE", help="draw one frame of each scene of --list into FILE")
    p.add_argument(
        "--set",
        type=setting,
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="another value in the scene, as in its file: diameter=0.15, motion.speed=0.4, texture.material=pvc; "
        "may be repeated",
    )
    p.add_argument("--frames", type=positive, help="stop after so many frames, views or scenes")
    p.add_argument("--seed", type=int, help="of all that is random [the scene's]")
    p.add_argument("--frame", type=int, metavar="N", help="which, for --picture [at three quarters of the drive]")

    p.add_argument("--width", type=positive, metavar="PIXELS", help="--picture is shrunk to [480]")

    def scene_is_named(args: argparse.Namespace, refuse: Callable[[str], None] = p.error) -> None:
        if args.scene is None and not (args.list or args.contact_sheet):
            refuse("which SCENE? `pipefish simulate --list` tells what there is")
        if not args.output and (args.frames or args.seed is not None):
            refuse("--frames and --seed are for a recording: -o STEM")
        if args.set and not (args.output or args.picture):
            refuse("--set is for -o and --picture")
        if not args.picture and (args.frame is not None or args.width is not None):
            refuse("--frame and --width are for --picture")

    p.set_defaults(check=scene_is_named)

    p = add_command(
        commands,
        "receive",
        run_receive,
        "Receive a survey from a device into one MCAP file. An interrupted reception goes on with the same command.",
        "pipefish receive serial:/dev/ttyUSB0@3000000 -o survey.mcap",
    )
    add_device(p)
    p.add_argument(
        "-o", "--output", required=True, metavar="FILE", help="survey file; FILE.partial until it is complete"
    )
    p.add_argument("--live", action="store_true", help="measure the pipe meanwhile: diameter, ovality, warnings")
    p.add_argument("--overwrite", action="store_true", help="start anew; FILE stays until the new survey is complete")
    p.add_argument(
        "--timeout",
        type=not_negative,
        default=30.0,
        metavar="S",
        help="give up after S seconds without a device [30]; 0: wait for ever",
    )

    p = add_command(commands, "info", run_info, "Tell what is in a survey file.", "pipefish info survey.mcap")
    p.add_argument("survey", metavar="FILE", help="survey file, complete or .partial")

    p = add_command(
        commands,
        "show",
        run_show,
        "Draw the tracks on a keyframe (.png, .jpg) or on all of them (.webp, .gif: an animation).",
        "pipefish show survey.mcap -o tracks.png --keyframe 17",
    )
    p.add_argument("survey", metavar="FILE", help="survey file, complete or .partial")
    p.add_argument("-o", "--output", required=True, metavar="OUT", help="picture to write")
    p.add_argument("--keyframe", type=int, metavar="N", help="index of the keyframe [the middle one]")
    p.add_argument("--colour", choices=("age", "quality"), default="age", help="what the tracks' colour tells [age]")
    p.add_argument("--stats", action="store_true", help="a .html page instead: what became of the tracks, and why")

    p = add_command(
        commands,
        "evaluate",
        run_evaluate,
        "Compare the tracks of a survey of a simulated pipe with the truth, and with OpenCV's.",
        "pipefish evaluate survey.mcap --recording /tmp/pipe --opencv",
    )
    p.add_argument("survey", metavar="FILE", help="survey file, complete or .partial")
    p.add_argument("--recording", required=True, metavar="STEM", help="of pipefish simulate: STEM.truth.json, STEM.y4m")
    p.add_argument("--opencv", action="store_true", help="also run OpenCV's usual chain over the recording's frames")
    p.add_argument("--smooth", action="store_true", help="the bars for smooth plastic")

    p = add_command(
        commands, "status", run_status, "Ask a device how it is.", "pipefish status tcp://127.0.0.1:7447 --json"
    )
    add_device(p)
    p.add_argument(
        "--timeout", type=not_negative, default=5.0, metavar="S", help="give up after S seconds [5]; 0: wait for ever"
    )

    from pipefish.cli_calibrate import add_calibrate  # they need what stands above
    from pipefish.cli_homography import add_homography
    from pipefish.cli_pair import add_pair
    from pipefish.cli_profile import add_profile
    from pipefish.cli_record import add_record
    from pipefish.cli_target import add_target

    add_profile(commands)
    add_target(commands)
    add_pair(commands)
    add_calibrate(commands)
    add_record(commands)
    add_homography(commands)

    from pipefish.cli_dense import add_dense
    from pipefish.cli_match import add_match
    from pipefish.cli_recognise import add_recognise
    from pipefish.cli_segment import add_segment
    from pipefish.cli_selfcal import add_selfcal
    from pipefish.cli_tube import add_tube

    add_tube(commands)
    add_match(commands)
    add_recognise(commands)
    add_segment(commands)
    add_dense(commands)
    add_selfcal(commands)

    from pipefish.cli_reconstruct import add_reconstruct

    add_reconstruct(commands)

    from pipefish.cli_flash import add_flash

    add_flash(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Runs one command. Returns the exit code: 0 done, 1 failed, 2 wrong usage. A failure is one line on stderr, and
    with --json also the document {"error": {...}} on stdout (error_document)."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        args = build_parser().parse_args(argv)
        args.check(args)
        document, text, *code = args.run(args)
        print(json.dumps(document, indent=2) if args.json else printable(text), flush=True)
        return code[0] if code else DONE
    except SystemExit as exit_:  # --help and --version
        return int(exit_.code or 0)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone; nothing to say to anybody
        return FAILED
    except (Exception, KeyboardInterrupt) as error:
        code = USAGE if isinstance(error, UsageError) else FAILED
        if "--json" in argv:
            print(json.dumps(error_document(error, code), indent=2), flush=True)
        if "--debug" in argv:
            raise
        print(f"pipefish: {printable(message_of(error))}", file=sys.stderr)
        return code


def error_document(error: BaseException, code: int) -> dict[str, Any]:
    """What --json prints where a command fails: exit_code 1 (failed) or 2 (wrong usage), kind: the exception's name,
    message: the line for people; file and position (line, key, ...; null where there is none) of a bad file."""
    file, position = getattr(error, "path", None), getattr(error, "position", None)
    if isinstance(error, OSError):
        file = error.filename
    return {
        "error": {
            "exit_code": code,
            "kind": type(error).__name__,
            "message": message_of(error),
            "file": None if file is None else str(file),
            "position": position,
        }
    }


def message_of(error: BaseException) -> str:
    """One clear line about what went wrong."""
    match error:
        case PipefishError():
            return str(error)
        case OSError():
            return f"{error.filename}: {error.strerror}" if error.filename else str(error)
        case KeyboardInterrupt():
            return "interrupted"
        case _:
            return f"internal error: {type(error).__name__}: {error} (--debug shows where)"


if __name__ == "__main__":
    sys.exit(main())
