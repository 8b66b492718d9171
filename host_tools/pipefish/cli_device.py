"""The commands `pipefish receive` and `pipefish status`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, add_device, not_negative, seconds_text, size_text, table
from pipefish.cli_survey import losses_text


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


def add_receive(commands: Any) -> None:
    """Adds `receive` to the command line."""
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
    p.add_argument("--overwrite", action="store_true", help="replace FILE, once the new survey is complete")
    p.add_argument(
        "--timeout",
        type=not_negative,
        default=30.0,
        metavar="S",
        help="give up after S seconds without a device [30]; 0: wait for ever",
    )


def hosts_text(status: Any) -> str:
    """Who is connected, as the one who asks sees it."""
    others = status.visitors - bool(status.looking_on)
    name = f" ({status.network.peer}, {status.network.role})" if status.network.peer else ""
    has = f"another host has the device{name}; this one looks on" if status.looking_on else "this one has the device"
    if status.looking_on and not status.link.up:
        has = "nobody has the device; this one looks on"
    return has + (f", {others} more look on" if others else "")


def run_status(args: argparse.Namespace) -> Result:
    from pipefish import pipefish_pb2 as pb
    from pipefish.cli_flash import stored_text
    from pipefish.client import Client, Handlers
    from pipefish.message_documents import document_of
    from pipefish.scene import losses_of, states_of
    from pipefish.transport import open_transport

    client = Client(open_transport(args.device, args.baud), Handlers())
    try:
        client.open()
        info = client.answer_to(args.timeout, get_info=pb.Nothing()).info
        status = client.answer_to(args.timeout, get_status=pb.Nothing()).status
    finally:
        client.close()
    document = {"info": document_of(info), "status": document_of(status)}
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


def add_status(commands: Any) -> None:
    """Adds `status` to the command line."""
    p = add_command(
        commands, "status", run_status, "Ask a device how it is.", "pipefish status tcp://127.0.0.1:7447 --json"
    )
    add_device(p)
    p.add_argument(
        "--timeout", type=not_negative, default=5.0, metavar="S", help="give up after S seconds [5]; 0: wait for ever"
    )
