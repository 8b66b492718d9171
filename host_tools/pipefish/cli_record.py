"""The command `pipefish record`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, add_device, not_negative, positive, table
from pipefish.terminal import say


def run_record(args: argparse.Namespace) -> Result:
    from pipefish.stills import record
    from pipefish.transport import open_transport

    if args.every is None:
        say("Enter: a still. Ctrl-D: done.", args.json)
    document = record(
        open_transport(args.device, args.baud),
        Path(args.output),
        every_s=args.every,
        count=args.count,
        timeout_s=args.timeout,
        tell=lambda line: say(line, args.json),
    )
    rows = [("stills", document["stills"]), ("ended", document["ended"]), ("written", document["folder"])]
    return document, table(rows)


def add_record(commands: Any) -> None:
    """Adds `record` to the command line."""
    p = add_command(
        commands,
        "record",
        run_record,
        "Single frames off a device that runs, whole and as its camera gave them: for calibration.",
        "pipefish record tcp://127.0.0.1:7447 -o shots\n"
        "  pipefish record serial:/dev/ttyUSB0@3000000 -o shots --every 5",
    )
    add_device(p)
    p.add_argument("-o", "--output", required=True, metavar="FOLDER", help="new folder: shot1.png, ..., telemetry.csv")
    p.add_argument("--every", type=not_negative, metavar="S", help="a still every S seconds [at each Enter]")
    p.add_argument("--count", type=positive, metavar="N", help="stop after N stills")
    p.add_argument(
        "--timeout", type=not_negative, default=30.0, metavar="S", help="give up after S silent seconds [30]; 0: never"
    )
