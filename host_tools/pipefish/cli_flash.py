"""The command `pipefish flash`."""

from __future__ import annotations

import argparse
from typing import Any

from pipefish.cli import Result, UsageError, add_command, add_device, not_negative, table
from pipefish.cli_profile import add_profile_input, load_profile
from pipefish.errors import PipefishError


def stored_text(profile: Any) -> str:
    """A pb.Profile for people."""
    starts = f"{profile.starts_left} more start{'s' if profile.starts_left != 1 else ''}"
    trial = f", on trial, {starts}" if profile.trial else ""
    serial = f", serial {profile.serial}" if profile.serial else ""
    return f"{profile.name or 'unnamed'}{serial} ({profile.crc32c:08x}){trial}"


def run_flash(args: argparse.Namespace) -> Result:
    from pipefish.flash import Flasher
    from pipefish.message_documents import document_of
    from pipefish.transport import open_transport

    if sum(map(bool, (args.profile, args.confirm, args.revert))) > 1:
        raise UsageError("flash: a profile, --confirm and --revert exclude each other")
    data = load_profile(args).camera.to_binary() if args.profile else None
    with Flasher(open_transport(args.device, args.baud), args.timeout) as device:
        if args.revert:
            state = device.revert()
        elif data:
            state = device.send(data)
        elif not args.confirm:
            state = device.state()
        else:
            state = device.state()
            if not state.HasField("stored"):
                raise PipefishError("the device has no profile that could be confirmed")
            state = device.confirm(state.stored.sha256)
    document = {
        name: document_of(profile) | {"crc32c": f"{profile.crc32c:08x}"} if state.HasField(name) else None
        for name, profile in (("in_use", state.in_use), ("stored", state.stored))
    }
    document["problem"] = state.problem or None
    document["slot_erases"] = [state.slot_erases_a, state.slot_erases_b]
    stored = stored_text(state.stored) if state.HasField("stored") else "none"
    in_use = stored_text(state.in_use) if state.HasField("in_use") else "none"
    rows = [
        ("in use", in_use),
        ("stored", stored + ("" if in_use == stored else "; the next start of the device takes it")),
        ("problem", state.problem),
        ("written", f"{state.slot_erases_a + state.slot_erases_b} times"),
    ]
    if state.stored.trial and state.in_use.sha256 == state.stored.sha256:
        rows.append(("then", f"if it is good: pipefish flash {args.device} --confirm"))
    elif state.stored.trial:
        rows.append(("then", f"restart the device, then: pipefish flash {args.device} --confirm"))
    return document, table(rows)


def add_flash(commands: Any) -> None:
    """`pipefish flash`."""
    p = add_command(
        commands,
        "flash",
        run_flash,
        "Put a camera profile on a device. It is tested, stored on trial and read back; the device's next start takes "
        "it. Then --confirm it, or the device goes back to the one before. Without a profile: tell what is in use, "
        "stored and on trial.",
        "pipefish flash tcp://127.0.0.1:7447 camera.json",
    )
    add_device(p)
    p.add_argument("profile", metavar="PROFILE", nargs="?", help="a profile, or another program's calibration")
    p.add_argument("--confirm", action="store_true", help="keep the profile on trial, with which the device runs now")
    p.add_argument("--revert", action="store_true", help="drop the profile on trial, or go back to the one before")
    add_profile_input(p)
    p.add_argument(
        "--timeout", type=not_negative, default=10.0, metavar="S", help="give up after S silent seconds [10]; 0: never"
    )
