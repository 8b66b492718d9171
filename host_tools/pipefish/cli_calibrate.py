"""The command `pipefish calibrate`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
from pathlib import Path
from typing import Any

from pipefish.cli import DEFAULT_BAUD, DEVICE_HELP, Result, UsageError, add_command, not_negative, positive, table
from pipefish.cli_profile import size_of

RIG_FORMAT = "pipefish-rig"


def named_folder(text: str) -> tuple[str, Path]:
    """An argument like left=shots/left."""
    name, equals, path = text.partition("=")
    if not equals or not path or not name or "/" in name or name.startswith("."):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=FOLDER")
    return name, Path(path)


def run_calibrate(args: argparse.Namespace) -> Result:
    from pipefish.calib_input import load_target, load_views
    from pipefish.calib_run import run
    from pipefish.progress import Progress

    _may_write(args)
    targets = [load_target(Path(path)) for path in args.target]
    live: dict[str, Any] | None = None
    if args.device:
        from pipefish.calib_live import collect
        from pipefish.transport import open_transport

        folder = _recording(args)
        try:
            live = collect(
                open_transport(args.device, args.baud),
                targets,
                folder,
                most=args.most,
                timeout_s=args.timeout,
                quiet=args.json,
            )
        finally:
            with contextlib.suppress(OSError):  # the folder goes where nothing came into it
                folder.rmdir()
        sources = {"camera": [Path(live["folder"])]}
    elif args.camera:
        sources = {}
        for name, path in args.camera:
            sources.setdefault(name, []).append(path)
    else:
        sources = {"camera": [Path(path) for path in args.views]}
    with Progress("calibrating", 100, quiet=args.json) as bar:

        def tell(what: str, share: float) -> None:
            bar.update(round(100 * share), what)

        tell("reading", 0.0)
        given = load_views(sources, targets, args.size)
        session = run(given, model=args.model, board=args.board, tell=tell)
        tell("report", 0.98)
        return _written(args, session, live)


def _may_write(args: argparse.Namespace) -> None:
    """Raises UsageError where a result could not be written after minutes of work, or over what it is made from."""
    out = Path(args.output)
    for option, path in (("-o", out), ("--report", Path(args.report) if args.report else None)):
        if path is None:
            continue
        if any(path.exists() and Path(one).exists() and path.samefile(one) for one in (*args.target, *args.views)):
            raise UsageError(f"calibrate: {option} {path}: is what it calibrates from; name another file")
        is_rig = args.camera and path is out
        folder = path if is_rig else path.parent
        while is_rig and not folder.exists():
            folder = folder.parent
        if not folder.is_dir():
            raise UsageError(f"calibrate: {option} {path}: there is no folder {folder}")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise UsageError(f"calibrate: {option} {path}: the folder {folder} may not be written to")


def _recording(args: argparse.Namespace) -> Path:
    """Where the pictures of a device go. Raises UsageError if that is there already."""
    output = Path(args.output)
    path = Path(args.recording) if args.recording else output.with_name(f"{output.stem}-shots")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UsageError(
            f"calibrate: {path} exists already: name another with --recording, or calibrate from it: "
            f"pipefish calibrate {path} ..."
        )
    return path


def _written(args: argparse.Namespace, session: Any, live: dict[str, Any] | None) -> Result:
    from pipefish.calib_page import write_report
    from pipefish.calib_verdict import verdict

    result, report, held_out = session.result, session.result.report, session.held_out
    rms = held_out[0] if held_out else None
    many = len(result.cameras) > 1
    files, verdicts, cameras = {}, {}, {}
    out = Path(args.output)
    bend = max(b.warp_mm / 2000 / b.frame.half for b in result.boards.values())
    for index, (number, camera) in enumerate(result.cameras.items()):
        label = session.given.cameras[number]
        name = " ".join(filter(None, (args.name, label if many else "")))
        camera = dataclasses.replace(
            camera,
            name=name or camera.name,
            serial=args.serial or "",
            lens=args.lens or "",
            held_out_rms_px=rms,
            provenance=dataclasses.replace(camera.provenance, held_out_views=held_out[1] if held_out else 0),
        )
        cameras[number] = camera
        files[number] = out / f"{label}.json" if many else out
        covered = camera.theta_covered or camera.theta_max
        verdicts[number] = verdict(report, rms, covered, index, bend)
    session.result = result = dataclasses.replace(result, cameras=cameras, camera=cameras[min(cameras)])
    if many:
        out.mkdir(parents=True, exist_ok=True)
    for number, camera in cameras.items():
        camera.save(files[number])
    rig = _save_rig(out, session, files) if many else None
    title = args.name or (f"Camera {args.serial}" if args.serial else "Calibration")
    size = write_report(session, verdicts, Path(args.report), title) if args.report else None
    document = _document(session, files, verdicts, rig, args.report, live)
    if size is not None:
        document["report_bytes"] = size
    return document, _text(args, session, files, verdicts, rig)


def _save_rig(folder: Path, session: Any, files: dict[int, Path]) -> Path:
    """Where the cameras of a rig are: rig.json."""
    from pipefish.files import write_atomically

    cameras = []
    for number, pose in session.result.camera_poses.items():
        cameras.append(
            {
                "name": session.given.cameras[number],
                "profile": files[number].name,
                "quaternion_wxyz": _quaternion(pose[:, :3]),
                "translation_m": pose[:, 3].tolist(),
            }
        )
    data = {"format": RIG_FORMAT, "version": 1, "pose": "camera from rig, X_cam = R X_rig + t", "cameras": cameras}
    path = folder / "rig.json"
    write_atomically(path, (json.dumps(data, indent=2) + "\n").encode())
    return path


def _quaternion(r: Any) -> list[float]:
    """Of a rotation matrix, (w, x, y, z), w >= 0."""
    import numpy as np

    # The eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix: no case distinctions.
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r.trace()],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    q = q * (1 if q[3] >= 0 else -1)
    return [float(q[3]), float(q[0]), float(q[1]), float(q[2])]


def _document(
    session: Any,
    files: dict[int, Path],
    verdicts: dict[int, Any],
    rig: Path | None,
    report_file: str | None,
    live: dict[str, Any] | None,
) -> dict[str, Any]:
    """Everything for --json."""
    from pipefish.calib_size import scale_text

    result, report = session.result, session.result.report
    names = session.given.cameras
    return {
        "files": {names[n]: str(path) for n, path in files.items()},
        "rig": str(rig) if rig else None,
        "report_file": report_file,
        "recording": live,
        "scale": scale_text(session.given.targets),
        "model": result.model,
        "rms_px": result.rms,
        "held_out_rms_px": session.held_out[0] if session.held_out else None,
        "held_out_views": session.held_out[1] if session.held_out else 0,
        "verdicts": {names[n]: v for n, v in verdicts.items()},
        "cameras": {names[n]: json.loads(camera.to_json()) for n, camera in result.cameras.items()},
        "camera_from_rig": {names[n]: pose.tolist() for n, pose in result.camera_poses.items()},
        "camera_from_board": [pose.tolist() if math.isfinite(pose[0, 0]) else None for pose in result.poses],
        "boards": [
            {"target": n, "shape": b.shape, "warp_mm": b.warp_mm, "aspect": b.aspect, "shear": b.shear}
            for n, b in result.boards.items()
        ],
        "pictures": [
            {
                "picture": s.picture.place,
                "target": s.board,
                "points": len(s.ids),
                "by_model": s.added,
                "status": s.status,
                "reason": "" if s.status == "ok" else s.reason,
            }
            for s in session.sightings
        ],
        "copies": [
            {"camera": names[camera], "picture": name, "same_as": first} for camera, name, first in session.given.copies
        ],
        "report": finite(report),
    }


def finite(value: Any) -> Any:
    """Plain values for JSON: what is not finite becomes None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return value


def _text(
    args: argparse.Namespace, session: Any, files: dict[int, Path], verdicts: dict[int, Any], rig: Path | None
) -> str:
    from pipefish.calib_size import scale_text

    result, report = session.result, session.result.report
    many = len(files) > 1
    rows: list[tuple[str, object]] = []

    def who_of(number: int) -> str:
        return f"{session.given.cameras[number]}: " if many else ""

    for number, v in verdicts.items():
        who = who_of(number)
        rows.append(("verdict" if number == min(verdicts) else "", who + v["text"]))
        rows += [("", f"{who}{text}") for text in v["cautions"]]
    used = sum(v["used"] for v in report["views"])
    added = sum(s.added for s in session.sightings)
    held_out = f"; {session.held_out[0]:.4f} px on held-out views" if session.held_out else ""
    rows += [
        ("model", result.model),
        ("residual", f"{result.rms:.4f} px rms{held_out}"),
        ("views", f"{used} used" + (f" of {max(len(report['views']), len(session.given.pictures))}")),
        (
            "points",
            f"{report['points_used']} of {report['points']}"
            + (f", {added} found with the model's help" if added else ""),
        ),
    ]
    for r in report["rejected_views"]:
        view = session.views[r["view"]]
        rows.append(("left out", f"{session.given.label(view.camera, view.name)}: {r['reason']}"))
    for s in session.unseen:
        rows.append(
            ("left out", f"{session.given.label(s.picture.camera, s.picture.name)}: {s.reason or 'no target found'}")
        )
    for camera, name, first in session.given.copies:
        rows.append(("left out", f"{session.given.label(camera, name)}: is the same picture as {first}"))
    shapes = [b for b in result.boards.values() if b.shape != "flat"]
    rows += [
        ("target", f"bends by {max(b.warp_mm for b in shapes):.2f} mm; taken out" if shapes else "taken as flat"),
        ("scale", scale_text(session.given.targets)),
        *(("note", note) for note in report["notes"]),
        *(("then", who_of(entry["camera"]) + entry["coverage"]["advice"]) for entry in report["cameras"]),
        *(("written", path) for path in files.values()),
        ("written", rig),
        ("report", args.report),
    ]
    if any(v["usable"] for v in verdicts.values()):
        device = args.device or "DEVICE"
        rows += [("flash it", f"pipefish flash {device} {path}") for path in files.values()]
    # A name that repeats is written once; table() would drop rows without a value.
    shown, last = [], None
    for name, value in rows:
        if value is not None and value != "":
            shown.append(("" if name == last else name, value))
            last = name or last
    return table(shown)


def together(args: argparse.Namespace) -> None:
    """Raises UsageError for arguments that do not go together."""
    ways = sum(map(bool, (args.views, args.camera, args.device)))
    if ways != 1:
        raise UsageError("calibrate: give either VIEWS, or --camera NAME=FOLDER for each camera of a rig, or --device")
    if not args.target and not (args.views and all(str(v).lower().endswith(".csv") for v in args.views)):
        raise UsageError(
            "calibrate: --target FILE is needed: the JSON that `pipefish target` wrote; to describe a target you "
            "have: pipefish target checkerboard --corners 9x6 --spacing 25 -o board.json"
        )
    if args.report and not args.report.lower().endswith((".html", ".htm")):
        raise UsageError(f"calibrate: --report {args.report}: the name must end in .html")
    if args.recording and not args.device:
        raise UsageError("calibrate: --recording is for --device")
    if len({name for name, _ in args.camera}) == 1:
        raise UsageError("calibrate: a rig has at least two cameras of different names")
    if not args.camera and Path(args.output).is_dir():
        raise UsageError(f"calibrate: -o {args.output}: is a folder; name a file in it")


def add_calibrate(commands: Any) -> None:
    """Adds `calibrate` to the command line."""
    p = add_command(
        commands,
        "calibrate",
        run_calibrate,
        "Calibrate a camera from pictures of a target: a profile, how good it is, and a report. No guess is needed.",
        "pipefish calibrate shots/ --target board.json -o camera.json --report camera.html\n"
        "  pipefish calibrate --camera left=shots/left --camera right=shots/right --target board.json -o rig/\n"
        "  pipefish calibrate --device tcp://127.0.0.1:7447 --target board.json -o camera.json --report camera.html",
    )
    p.add_argument(
        "views",
        metavar="VIEWS",
        nargs="*",
        help="pictures, folders of them, surveys (.mcap), or corner files (.csv, .vnl, .orpc; docs/calibration.md)",
    )
    p.add_argument(
        "--target",
        action="append",
        default=[],
        metavar="FILE",
        help="the JSON that `pipefish target` writes, also of a target that you have (`pipefish target --help`); again "
        "for each target of a run",
    )
    p.add_argument("-o", "--output", required=True, metavar="FILE", help="profile to write; of a rig: a folder of them")
    p.add_argument("--report", metavar="FILE.html", help="a page that tells whether it is good, and why")
    p.add_argument(
        "--model", choices=("auto", "p6", "p9", "p23"), default="auto", help="[auto: what held-out views accept]"
    )
    p.add_argument(
        "--board",
        choices=("shape", "flat"),
        default="shape",
        help="estimate the target's own shape, or trust it [shape]",
    )
    p.add_argument(
        "--camera", action="append", type=named_folder, default=[], metavar="NAME=FOLDER", help="one camera of a rig"
    )
    p.add_argument("--size", type=size_of, metavar="WxH", help="of the pictures, for corner files that do not say")
    p.add_argument("--name", metavar="TEXT", help="of the camera, for the profile")
    p.add_argument("--serial", metavar="NUMBER", help="of the camera, for the profile")
    p.add_argument("--lens", metavar="TEXT", help="its lens, for the profile")
    group = p.add_argument_group("views from a device that runs")
    group.add_argument("--device", metavar="DEVICE", help=DEVICE_HELP)
    group.add_argument("--baud", type=positive, help=f"speed of a serial line [{DEFAULT_BAUD}]")
    group.add_argument(
        "--recording", metavar="FOLDER", help="where its pictures are kept [the profile's name with -shots]"
    )
    group.add_argument("--most", type=positive, default=60, metavar="N", help="stop after N views with a target [60]")
    group.add_argument(
        "--timeout", type=not_negative, default=30.0, metavar="S", help="give up after S silent seconds [30]; 0: never"
    )
    p.set_defaults(check=together)
