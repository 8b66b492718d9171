"""The commands `pipefish demo` and `pipefish simulate`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, positive, table


def run_demo(args: argparse.Namespace) -> Result:
    from pipefish.demo import demo, figures

    summary, page = demo(
        Path(args.out), frames=args.frames, build_dir=args.build_dir, quiet=args.json, fresh=args.fresh
    )
    return summary, f"{figures(summary)}\n{page}"


def add_demo(commands: Any) -> None:
    """Adds `demo` to the command line."""
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


def add_simulate(commands: Any) -> None:
    """Adds `simulate` to the command line."""
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
