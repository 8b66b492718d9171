"""The command `pipefish`. Heavy imports happen in the commands, so that --help is quick."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable
from typing import Any, NoReturn

from pipefish import __version__
from pipefish.errors import PipefishError
from pipefish.files import plain
from pipefish.terminal import in_line, printable, say

DONE, FAILED, USAGE = 0, 1, 2
DEFAULT_BAUD = 921600  # the same as transport.DEFAULT_BAUD, whose import costs time here


class UsageError(PipefishError):
    """Arguments that do not go together."""


DEVICE_HELP = (
    "serial:/dev/ttyUSB0@3000000 (hardware flow control: @3000000,rtscts), /dev/ttyUSB0 (speed from --baud), "
    "tls://host:port or tcp://host:port"
)


def table(rows: Iterable[tuple[str, object]]) -> str:
    """Two aligned columns, a line a row; rows whose value is None or "" are left out."""
    shown = [(name, in_line(str(value))) for name, value in rows if value is not None and value != ""]
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


# A command returns (document for --json, text for people), and an exit code where that is not DONE.
Result = tuple[dict[str, Any], str] | tuple[dict[str, Any], str, int]


# ---- the parser


class Parser(argparse.ArgumentParser):
    """argparse's, with wrong usage as an exception: main tells it in the form that was asked for."""

    def format_help(self) -> str:
        """As the terminal may have it."""
        return printable(super().format_help(), sys.stdout.encoding)

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        if message.startswith("argument COMMAND: invalid choice"):
            for action in ("convert", "check"):
                if f"choice: '{action}'" in message:
                    message = f"there is no command {action}; did you mean: pipefish profile {action}"
        raise UsageError(f"{self.prog.removeprefix('pipefish').strip()}: {message}".removeprefix(": "))


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


def add_commands(commands: Any) -> None:
    """Each command adds itself, beside what runs it. The order is that of --help: a survey's way first."""
    from pipefish.cli_calibrate import add_calibrate  # they need what stands above
    from pipefish.cli_dense import add_dense
    from pipefish.cli_device import add_receive, add_status
    from pipefish.cli_flash import add_flash
    from pipefish.cli_homography import add_homography
    from pipefish.cli_match import add_match
    from pipefish.cli_pair import add_pair
    from pipefish.cli_profile import add_profile, add_undistort
    from pipefish.cli_recognise import add_recognise
    from pipefish.cli_reconstruct import add_reconstruct, add_report, add_unroll
    from pipefish.cli_record import add_record
    from pipefish.cli_segment import add_segment
    from pipefish.cli_selfcal import add_selfcal
    from pipefish.cli_simulate import add_demo, add_simulate
    from pipefish.cli_survey import add_evaluate, add_info, add_show
    from pipefish.cli_target import add_target
    from pipefish.cli_tube import add_tube

    survey = (add_demo, add_simulate, add_receive, add_status, add_info, add_show)
    pipe = (add_reconstruct, add_dense, add_unroll, add_report, add_tube, add_evaluate)
    camera = (add_target, add_record, add_calibrate, add_selfcal, add_profile, add_flash, add_pair)
    pictures = (add_undistort, add_match, add_recognise, add_segment, add_homography)
    for add in (*survey, *pipe, *camera, *pictures):
        add(commands)


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
    add_commands(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Runs one command. Returns the exit code: 0 done, 1 failed, 2 wrong usage. A failure is one line on stderr, and
    with --json also the document {"error": {...}} on stdout (error_document)."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        args = build_parser().parse_args(argv)
        args.check(args)
        document, text, *code = args.run(args)
        print(json.dumps(plain(document), indent=2) if args.json else printable(text, sys.stdout.encoding), flush=True)
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
        say(f"pipefish: {message_of(error)}")
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
        case FileNotFoundError() if error.filename and os.path.exists(f"{error.filename}.partial"):
            return f"{error.filename}: {error.strerror}; {error.filename}.partial is there: not complete yet"
        case OSError():
            return f"{error.filename}: {error.strerror}" if error.filename else str(error)
        case KeyboardInterrupt():
            return "interrupted"
        case _:
            return f"internal error: {type(error).__name__}: {error} (--debug shows where)"


if __name__ == "__main__":
    sys.exit(main())
