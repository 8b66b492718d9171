"""The command `pipefish pair`."""

from __future__ import annotations

import argparse

from pipefish.cli import DEFAULT_BAUD, DEVICE_HELP, Result, UsageError, add_command, positive, table
from pipefish.keys import ROLES

DEFAULT_ROLE = "operator"


def check_pair(args: argparse.Namespace) -> None:
    """Raises UsageError."""
    from pipefish.keys import parse_key

    if args.forget is not None and any((args.device, args.revoke, args.device_key)):
        raise UsageError("--forget: stands alone")
    if args.device_key is not None:
        if args.device is not None or args.revoke is not None:
            raise UsageError("--device-key: stands alone, with --device-name")
        parse_key(args.device_key)
    if args.revoke is not None:
        if args.device is None:
            raise UsageError("--revoke: needs the DEVICE that is to forget the key")
        parse_key(args.revoke)


def ask_device(args: argparse.Namespace, key: str, role: str, name: str) -> str:
    """Has the device let a key in, or revoke it; returns the device's own key. Raises PipefishError."""
    from pipefish import pipefish_pb2 as pb
    from pipefish.client import Client, Handlers
    from pipefish.transport import open_transport

    client = Client(open_transport(args.device, args.baud), Handlers())
    client.open()
    try:
        reply = client.answer_to(args.timeout, pair=pb.Pair(key=bytes.fromhex(key), role=role, name=name))
        return reply.paired.key.hex()
    finally:
        client.close()


def namesakes_text(name: str, keys: list[str]) -> str:
    """What to say where other devices are called so: one may be a slip of the pen, or a card that was written anew."""
    return "".join(f"\nso is another one, {k}; if it is none of yours: pipefish pair --forget {k}" for k in keys)


def run_pair(args: argparse.Namespace) -> Result:
    """Pairs, revokes, remembers or forgets a device, or tells how to pair."""
    from pipefish.keys import forget_device, host_key, host_name, known_devices, parse_key, remember_device

    if args.forget is not None:
        name = forget_device(args.forget)
        return {"forgotten": name}, f"{name} is no longer known"
    if args.device_key is not None:
        key = parse_key(args.device_key)
        others = remember_device(key, args.device_name)
        return {"device": {"key": key, "name": args.device_name}}, (
            f"{key} is known as {args.device_name} from now on" + namesakes_text(args.device_name, others)
        )
    if args.revoke is not None:
        key = parse_key(args.revoke)
        ask_device(args, key, "revoked", "revoked")
        return {"revoked": key}, "the device never lets this key in again"
    key, name = host_key(), args.name or host_name()
    if args.device is not None:
        device = ask_device(args, key, args.role, name)
        others = remember_device(device, args.device_name)
        rows = [("this host", f"{name}, {args.role}"), ("its key", key), ("device", args.device_name)]
        result = {"host": {"key": key, "name": name, "role": args.role}}
        text = table([*rows, ("its key", device)]) + namesakes_text(args.device_name, others)
        return result | {"device": {"key": device, "name": args.device_name}}, text
    devices = known_devices()
    text = table([("this host's key", key), *((f"device {n}", k) for k, n in devices.items())])
    text += (
        "\n\nTo pair by the cable:   pipefish pair /dev/ttyUSB0\n"
        "Without it, on the device (ssh, or its console):\n"
        f'  sudo pipefishd --pair "{args.role} {key} {name}"\n'
        "and with the key that this prints, here:\n"
        "  pipefish pair --device-key KEY --device-name crawler"
    )
    if args.role != "calibrator":
        text += "\nTo flash profiles and pair other hosts, too: --role calibrator"
    return {"host": {"key": key, "name": name}, "devices": [{"key": k, "name": n} for k, n in devices.items()]}, text


def add_pair(commands: argparse._SubParsersAction) -> None:
    """The command line."""
    p = add_command(
        commands,
        "pair",
        run_pair,
        "Let this host and a device know each other's key, for the network.",
        "pipefish pair /dev/ttyUSB0 --role calibrator --device-name crawler",
    )
    p.add_argument("device", metavar="DEVICE", nargs="?", help=f"{DEVICE_HELP}; none: shows this host's key")
    p.add_argument("--baud", type=positive, help=f"speed of a serial line [{DEFAULT_BAUD}]")
    p.add_argument(
        "--role",
        choices=ROLES,
        default=DEFAULT_ROLE,
        help="what this host may do: look on; take surveys, lamp, stop; also flash and pair [%(default)s]",
    )
    p.add_argument("--name", help="what the device calls this host [user@host]")
    p.add_argument("--device-name", default="crawler", help="what this host calls the device [%(default)s]")
    p.add_argument("--device-key", metavar="KEY", help="know this device without asking it")
    p.add_argument("--forget", metavar="KEY", help="this host no longer knows the device with this key, or name")
    p.add_argument("--revoke", metavar="KEY", help="the device never lets this host's key in again")
    p.add_argument("--timeout", type=positive, default=10.0, help="seconds to wait for the device [%(default)g]")
    p.set_defaults(check=check_pair)
