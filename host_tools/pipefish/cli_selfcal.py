"""The command `pipefish selfcal`."""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, positive, table
from pipefish.errors import ArgumentError, PipefishError
from pipefish.intervals import SAID, Z95

STATES = {
    "ok": "",
    "few": "too few matches that agree",
    "standing": "nothing moved",
    "turning": "the camera only turned",
    "plane": "a plane",
}


def _with_file_name(message: str, names: list[str]) -> str:
    """pairs[k] is what Python calls the k-th file."""
    place = re.match(r"pairs\[(\d+)\](: view \d)?", message)
    if place is None:
        return message
    column = {": view 1": ", x1 y1", ": view 2": ", x2 y2", None: ""}[place[2]]
    return names[int(place[1])] + column + message[place.end() :]


def run_selfcal(args: argparse.Namespace) -> Result:
    """Calibrates from views of an unknown scene and writes the profile."""
    from pipefish.progress import Progress
    from pipefish.selfcal import PARAMETERS, self_calibrate
    from pipefish.selfcal_input import read

    if not Path(args.output).absolute().parent.is_dir():
        raise ArgumentError(f"--output: {Path(args.output).parent} is no folder")
    with Progress("selfcal", 100, args.json) as bar:
        given = read(args.inputs, args.threads, lambda done, of: bar.update(80 * done // of, "matching"), args.size)
        if args.size and given.size and tuple(args.size) != given.size:
            raise ArgumentError(f"--size: the pictures are {given.size[0]}x{given.size[1]}")
        size = given.size or args.size
        if size is None:
            raise ArgumentError("--size: files of matches do not say how large the pictures are")
        if not given.pairs:
            raise PipefishError(f"{args.inputs[0]}: no two keyframes have enough tracks in common")
        bar.update(80, "calibrating")
        try:
            found = self_calibrate(
                given.pairs, size, sigma_least=given.sigma_least, views=given.views, threads=args.threads
            )
        except ArgumentError as error:
            raise ArgumentError(_with_file_name(str(error), given.names)) from None
    pairs = [
        {
            "name": name,
            "status": p.status,
            "matches": len(p.inlier),
            "inliers": int(p.inlier.sum()),
            "shift_px": p.shift,
            "rms_px": p.rms,
            "cam2_from_cam1": p.pose.tolist(),
        }
        for name, p in zip(given.names, found.pairs, strict=True)
    ]
    if found.camera is None:
        hint = ". Or is --size not that of the pictures?" if given.size is None and found.status != "no_matches" else ""
        of = args.inputs[0] + (f" and {len(args.inputs) - 1} more" if len(args.inputs) > 1 else "")
        raise PipefishError(f"{of}: {found.reason}{hint}")
    texts = {key: getattr(args, key) for key in ("name", "serial", "lens") if getattr(args, key)}
    camera = dataclasses.replace(found.camera, **texts)
    camera.save(args.output)
    keys = ("status", "sigma", "rms", "usable", "ambiguous", "alpha_sigma", "bearing_sigma", "theta", "area", "tilt")
    document: dict[str, Any] = {key: getattr(found, key) for key in keys}
    document |= {"starts": {key: getattr(found, key) for key in ("starts", "refined", "agreeing", "runner_up")}}
    sigma = math.sqrt(camera.covariance[0, 0])
    document |= {"camera": {key: getattr(camera, key) for key in PARAMETERS} | {"f_u_sigma": sigma}}
    document |= {"pairs": pairs, "files": [args.output]}
    return document, _text(found, pairs, args.output)


def _text(found: Any, pairs: list[dict[str, Any]], output: str) -> str:
    """The result for people."""
    camera = found.camera
    sigma = math.sqrt(camera.covariance[0, 0])
    rows: list[tuple[str, object]] = [
        ("focal length", f"{camera.f_u:.1f} ± {Z95 * sigma:.1f} px a radian"),
        ("centre", f"{camera.c_u:.1f}, {camera.c_v:.1f}"),
        (
            "covered",
            f"to {math.degrees(found.theta):.1f} degrees off the axis; to {math.degrees(camera.theta_max):.1f} it is "
            "extrapolated",
        ),
        ("bearings", f"± {math.degrees(Z95 * found.bearing_sigma):.2f} degrees there"),
        ("along the axis", f"± {100 * Z95 * found.alpha_sigma:.2f} % (stretch of what lies ahead)"),
        ("residuals", f"{found.rms:.2f} px rms; a match counts with {found.sigma:.2f} px"),
        ("starts", f"{found.agreeing} of {found.refined} end at this camera"),
    ]
    if found.runner_up > 0:
        rows.append(("next best", f"another lens, at {found.runner_up:.4g} times the cost of this one"))
    if found.ambiguous:
        rows.append(
            ("CAUTION", "that lens explains the matches as well: this one may be wrong. Take a third view or more")
        )
    elif not found.usable:
        rows.append(
            ("CAUTION", "rough: the focal length to ± 6 % or bearings to ± 1 degree are not certain. Take more views")
        )
    used = [p for p in pairs if p["status"] == "ok"]
    rows.append(("pairs", f"{len(used)} of {len(pairs)}, {sum(p['inliers'] for p in used)} matches"))
    rows += [("left out", f"{p['name']}: {STATES[p['status']]}") for p in pairs if p["status"] != "ok"]
    rows.append(("intervals", SAID))
    rows.append(("written", output))
    return table(rows)


def add_selfcal(commands: Any) -> None:
    """Adds `selfcal` to the command line."""
    from pipefish.cli_profile import size_of

    p = add_command(
        commands,
        "selfcal",
        run_selfcal,
        "Calibrate a camera from two or more views of an unknown scene: no target, nothing known of the lens. The "
        "scene must have depth and the camera must have moved and panned or tilted; what the views cannot tell is "
        "refused, with what is missing. The profile is marked as self-calibrated and carries its uncertainty.",
        "pipefish selfcal a.jpg b.jpg c.jpg -o camera.json\n"
        "  pipefish selfcal matches.npz --size 1280x960 -o camera.json",
    )
    p.add_argument(
        "inputs",
        nargs="+",
        metavar="INPUT",
        help="pictures of one camera; or files of matches (.npz of `pipefish match`, .csv of x1,y1,x2,y2), a pair of "
        "views each; or a survey",
    )
    p.add_argument("-o", "--output", required=True, metavar="FILE", help="the profile")
    p.add_argument("--size", type=size_of, metavar="WxH", help="of the pictures, for files of matches")
    p.add_argument("--name", help="of the camera, for the profile")
    p.add_argument("--serial", help="of the camera, for the profile")
    p.add_argument("--lens", help="for the profile")
    p.add_argument("--threads", type=positive, default=2, metavar="N", help="do not change the result [2]")
