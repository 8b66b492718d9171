"""The commands `pipefish profile show|check|convert` and `pipefish undistort`."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pipefish.cli import Result, UsageError, add_command, not_negative, positive, table
from pipefish.errors import ArgumentError, ProfileError
from pipefish.intervals import Z95
from pipefish.terminal import say

# The forms of --from and --to: formats.READERS and WRITERS, whose import costs time here.
READ = (
    *("json", "binary", "opencv-fisheye", "opencv", "opencv-omnidir", "ros", "kalibr", "basalt", "orbslam3", "stella"),
    *("svo", "adapter", "boofcv", "woodscape", "pyocamcalib", "colmap", "ocam", "toolbox", "mrcal"),
)
WRITTEN = ("json", "binary", "opencv-fisheye", "ros", "kalibr", "colmap", "basalt", "orbslam3", "mrcal", "toolbox")

OWN_SUFFIXES = {".json": "json", ".profile": "binary", ".bin": "binary"}  # names that need no --to


def load_profile(args: argparse.Namespace) -> Any:
    """A formats.Conversion of args.profile: a profile or another program's calibration, with the options that
    add_profile_input gave. Its notes go to stderr. Raises ProfileError."""
    from pipefish.formats import load

    loaded = load(
        args.profile,
        camera=args.camera,
        size=args.camera_size,
        form=getattr(args, "from"),
        max_error=args.max_error,
        max_theta=_radians(args.max_theta),
        model=args.model,
    )
    for note in loaded.notes:
        say(f"pipefish: {args.profile}: {note}", args.json)
    return loaded


def fit_document(fit: Any) -> dict[str, Any] | None:
    """A fit for --json."""
    if fit is None:
        return None
    return {
        "exact": fit.exact,
        "rms_px": fit.rms_px,
        "max_px": fit.max_px,
        "compared_to_deg": math.degrees(fit.theta_max),
        "worst_at_deg": math.degrees(fit.worst_theta),
    }


def run_profile_show(args: argparse.Namespace) -> Result:
    from pipefish.lensreport import draw, table_text
    from pipefish.lensreport import table as lens_table
    from pipefish.selfcal import stored_alpha_sigma

    loaded = load_profile(args)
    camera = loaded.camera
    alpha = stored_alpha_sigma(camera)
    if args.out:
        draw(camera, Path(args.out))
    covered = f"{math.degrees(camera.theta_covered):.1f} deg" if camera.theta_covered else "unknown"
    circle = f"({camera.circle_u:.1f}, {camera.circle_v:.1f}) radius {camera.circle_radius:.1f} px"

    def numbers(values: Iterable[float]) -> str | None:
        shown = list(values)
        return ", ".join(f"{v:.6g}" for v in shown) if any(shown) else None

    rows = [
        ("name", camera.name or "unnamed"),
        ("serial", camera.serial),
        ("source", camera.source),
        ("read from", f"{loaded.form}, {loaded.fit}" if loaded.fit else None),
        ("created", camera.created.isoformat() if camera.created else None),
        ("picture", f"{camera.width} x {camera.height}"),
        ("model", camera.radial),
        ("f_u, f_v", f"{camera.f_u:.4f}, {camera.f_v:.4f} px/rad"),
        ("c_u, c_v", f"{camera.c_u:.4f}, {camera.c_v:.4f} px"),
        ("skew", f"{camera.skew:.6g}" if camera.skew else None),
        ("tilt", numbers(map(math.degrees, camera.tilt))),
        ("k2 .. k5", numbers((camera.k2, camera.k3, camera.k4, camera.k5))),
        ("asym_radial", numbers(camera.asym_radial_theta + camera.asym_radial_phi)),
        ("asym_tangential", numbers(camera.asym_tangential_theta + camera.asym_tangential_phi)),
        ("cpoly", numbers(camera.cpoly)),
        ("mirror", f"{camera.mirror:.6g}" if camera.mirror else None),
        ("pupil shift", f"{camera.pupil_e1 * 1000:.4g} mm per rad^2" if camera.pupil_e1 else None),
        ("field of view", f"{2 * math.degrees(camera.theta_max):.1f} deg (data covered half of it up to {covered})"),
        ("image circle", circle if camera.circle_radius else "the whole picture"),
        ("residual", f"{camera.rms_px:.4f} px rms" if camera.rms_px is not None else "unknown"),
        (
            "covariance",
            f"of {len(camera.covariance_parameters)} parameters" if camera.covariance_parameters else "none",
        ),
        ("model chosen", camera.provenance.model_choice or None),
        ("stretch along the axis", _alpha_text(alpha)),
        ("drawn in", args.out),
    ]
    document = json.loads(camera.to_json())
    document["curve"] = lens_table(camera)
    document["alpha_sigma"] = alpha
    document["conversion"] = {"form": loaded.form, "fit": fit_document(loaded.fit), "notes": loaded.notes}
    return document, f"{table(rows)}\n\n{table_text(camera)}"


def _alpha_text(sigma: float | None) -> str | None:
    """What sigma(alpha) means for who measures: cot theta -> alpha cot theta stretches the pipe along its axis by
    alpha, against an encoder its diameter by 1 / alpha, and turns a ray by sin theta cos theta of ln alpha."""
    if sigma is None:
        return None
    angle = 0.5 / math.radians(45) * sigma  # sin cos of 45 degrees, of the angle itself
    of_diameter, of_angle = (100 * Z95 * value for value in (sigma, angle))
    return f"± {of_diameter:.2g} % of a diameter beside an encoder, ± {of_angle:.2g} % of the angle at 45 deg (95 %)"


def run_profile_check(args: argparse.Namespace) -> Result:
    from pipefish.lensreport import check

    loaded = load_profile(args)
    camera, found = loaded.camera, check(loaded.camera)
    if found["problems"]:
        raise ProfileError(args.profile, None, "; ".join(found["problems"]))
    document = {"file": args.profile, "form": loaded.form, "name": camera.name, **found}
    document["fit"] = fit_document(loaded.fit)
    rows = [
        ("valid", f"{camera.name or 'unnamed'}, {camera.width} x {camera.height}"),
        ("read from", f"{loaded.form}, {loaded.fit}" if loaded.fit else loaded.form),
        (
            "one-to-one",
            f"proved up to {found['one_to_one_up_to_deg']:.1f} deg (in use up to {found['theta_max_deg']:.1f})",
        ),
        ("self-test", f"pixel to ray to pixel within {found['round_trip_px']:.2g} px"),
        ("coverage", f"{100 * found['covered']:.1f} % of the lit picture has rays"),
        *(("note", remark) for remark in found["remarks"]),
    ]
    return document, table(rows)


def run_profile_convert(args: argparse.Namespace) -> Result:
    from pipefish.files import write_atomically
    from pipefish.formats import write

    if args.out is None:
        if args.to:
            raise UsageError(f"profile convert: --to {args.to}: name the file to write as well: OUT")
        return _convertible(args)
    out = Path(args.out)
    if out.exists() and Path(args.profile).exists() and out.samefile(args.profile):
        raise UsageError(f"profile convert: {out} would be written over what it is made from")
    form = args.to or OWN_SUFFIXES.get(out.suffix.lower())
    if form is None:
        raise UsageError(
            f"profile convert: {out}: the name does not say what to write (only {', '.join(OWN_SUFFIXES)} do): "
            f"give --to {', '.join(WRITTEN)}"
        )
    loaded = load_profile(args)
    camera, fit, notes = loaded.camera, loaded.fit, list(loaded.notes)
    if form in ("json", "binary"):
        write_atomically(out, camera.to_json().encode() if form == "json" else camera.to_binary())
        written_fit, reach = None, camera.theta_max
    else:
        written = write(camera, out, form, max_error=args.max_error, max_theta=_radians(args.max_theta))
        written_fit, reach = written.fit, written.fit.theta_max  # other formats do not say where they end
        notes += written.notes
    document = {
        "file": str(out),
        "form": form,
        "bytes": out.stat().st_size if out.is_file() else None,
        "read_as": loaded.form,
        "read_fit": fit_document(fit),
        "written_fit": fit_document(written_fit),
        "field_of_view_deg": 2 * math.degrees(reach),
        "notes": notes,
    }
    rows = [
        ("written", f"{out}: {form}, {document['bytes']} bytes"),
        ("read as", f"{loaded.form}, {fit}" if fit else loaded.form),
        ("written as", f"{form}, {written_fit}" if written_fit else None),
        ("field of view", f"{2 * math.degrees(reach):.1f} deg"),
        *(("note", note) for note in notes if note not in loaded.notes),
    ]
    return document, table(rows)


def _convertible(args: argparse.Namespace) -> Result:
    """What a profile can be converted to, with the error of each; nothing is written."""
    from pipefish.formats import WRITERS
    from pipefish.formats.writers import Wanted

    loaded = load_profile(args)
    camera, wanted = loaded.camera, Wanted(args.max_error, _radians(args.max_theta))
    exact = {"json": "exact; OUT.json", "binary": "exact, for devices; OUT.profile or OUT.bin"}
    forms: dict[str, dict[str, Any]] = {form: {"fits": True, "fit": None, "reason": ""} for form in exact}
    rows: list[tuple[str, object]] = [
        ("name", camera.name or "unnamed"),
        ("read as", f"{loaded.form}, {loaded.fit}" if loaded.fit else loaded.form),
        ("picture", f"{camera.width} x {camera.height}"),
        ("field of view", f"{2 * math.degrees(camera.theta_max):.1f} deg"),
        ("can become", "(nothing has been written)"),
        *((f"  {form}", text) for form, text in exact.items()),
    ]
    for form in WRITTEN:
        if form in exact:
            continue
        try:
            fit = WRITERS[form](camera, wanted).fit
            forms[form] = {"fits": True, "fit": fit_document(fit), "reason": ""}
            rows.append((f"  {form}", f"{fit}; OUT --to {form}"))
        except ProfileError as error:
            forms[form] = {"fits": False, "fit": None, "reason": error.reason}
            rows.append((f"  {form}", f"no: {error.reason.removeprefix(form).strip(' :')}"))
    rows.append(("next", f"pipefish profile convert {args.profile} OUT [--to FORMAT]"))
    return {"file": args.profile, "read_as": loaded.form, "forms": forms, "notes": list(loaded.notes)}, table(rows)


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)


def run_undistort(args: argparse.Namespace) -> Result:
    from pipefish.undistort import undistort
    from pipefish.views import FAR

    if args.view == "cube" and args.fov is not None:
        raise UsageError("undistort: --fov does not go with --view cube, whose faces cover 90 degrees each")
    camera = load_profile(args).camera
    try:
        document = undistort(
            Path(args.input),
            Path(args.output),
            camera,
            view=args.view,
            fov=args.fov,
            size=args.size,
            turn=args.rotate,
            distance=FAR if args.distance is None else args.distance,
            mask=None if args.mask is None else Path(args.mask),
            quiet=args.json,
        )
    except ArgumentError as error:  # a field of view, size or file name that no view can have
        raise UsageError(f"undistort: {error}") from None
    at = document["exact_at_m"]
    exact = f"at {at:g} m from the camera" if at else "for far points; --distance for near ones"
    rows = [
        ("written", f"{document['file']}" + (f", {document['pictures']} pictures" if document["pictures"] > 1 else "")),
        ("mask", document["mask"]),
        ("view", f"{document['view']}, {fov_text(document)}, {document['width']} x {document['height']} pixels"),
        ("seen", f"{100 * document['valid']:.1f} % of it"),
        ("exact", exact if camera.pupil_e1 else None),
    ]
    return document, table(rows)


def fov_text(document: dict[str, Any]) -> str:
    """The angles that a view covers."""
    down = document["vertical_fov_deg"]
    return f"{document['fov_deg']:g} x {down:.4g} deg" if down is not None else "faces of 90 deg"


def size_of(text: str) -> tuple[int, int]:
    """An argument like 1280x960; 640 alone is 640x640."""
    width, _, height = text.lower().partition("x")
    return positive(width), positive(height or width)


def above_zero(text: str) -> float:
    """An argument that is a finite number above zero."""
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{value:g} is not a number above zero")
    return value


def angles(text: str) -> tuple[float, float, float]:
    """An argument like 30,0,-5: yaw, pitch and roll in degrees; what is left out is zero."""
    parts = [float(part) for part in text.split(",")]
    if len(parts) > 3 or not all(abs(part) <= 360 for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is not YAW,PITCH,ROLL in degrees")
    return (*parts, *(0.0,) * (3 - len(parts)))  # type: ignore[return-value]


def add_profile_input(parser: argparse.ArgumentParser) -> None:
    """Options of everything that reads a profile: how to take another program's file."""
    group = parser.add_argument_group("how to take the profile, or another program's calibration")
    group.add_argument(
        "--from", choices=READ, metavar="FORMAT", help=f"what the file is [told by its content]: {', '.join(READ)}"
    )
    group.add_argument("--camera", metavar="NAME", help="which camera, by name or number, of a file of several [first]")
    group.add_argument("--camera-size", type=size_of, metavar="WxH", help="picture size, where the file does not say")
    group.add_argument("--model", choices=("auto", "p6", "p9", "p23", "cpoly"), default="auto", help="to fit [auto]")
    group.add_argument(
        "--max-error", type=not_negative, default=0.1, metavar="PX", help="largest error allowed of a fit [0.1]"
    )
    group.add_argument("--max-theta", type=above_zero, metavar="DEG", help="take no more than DEG off the axis")


WHICH = "a profile, JSON or binary, or another program's calibration"


def add_profile(commands: Any) -> None:
    """Adds `profile` with its actions to the command line."""
    parser = commands.add_parser(
        "profile", help="look at, check and convert camera profiles", description="Camera profiles."
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    p = add_command(
        actions,
        "show",
        run_profile_show,
        "Tell what a profile says, with the radius and the resolution at angles off the axis.",
        "pipefish profile show camera.json --out camera.png",
    )
    p.add_argument("profile", metavar="PROFILE", help=WHICH)
    p.add_argument("--out", metavar="FILE", help="draw the radial curve and the resolution: .png or .html")
    add_profile_input(p)
    p = add_command(
        actions,
        "check",
        run_profile_check,
        "Check a profile: valid, one-to-one, self-test, coverage, units; exit code 1 if it is not to be used.",
        "pipefish profile check camera.json",
    )
    p.add_argument("profile", metavar="PROFILE", help=WHICH)
    add_profile_input(p)
    p = add_command(
        actions,
        "convert",
        run_profile_convert,
        "Convert a profile: JSON for people, binary for devices, or another program's format, with the error of it.",
        "pipefish profile convert camera.json\n"
        "  pipefish profile convert camchain.yaml camera.profile\n"
        "  pipefish profile convert camera.json camera.yaml --to opencv-fisheye",
    )
    p.add_argument("profile", metavar="PROFILE", help=WHICH)
    p.add_argument(
        "out",
        metavar="OUT",
        nargs="?",
        help="file to write; without --to: .json is JSON, .profile and .bin binary. Without OUT: only tell what "
        "it can become",
    )
    p.add_argument(
        "--to", choices=WRITTEN, help="format to write, whatever the name is; needed for all but .json, .profile, .bin"
    )
    add_profile_input(p)


def add_undistort(commands: Any) -> None:
    """Adds `undistort` to the command line."""
    p = add_command(
        commands,
        "undistort",
        run_undistort,
        "Turn fisheye pictures into a perspective, cube, cylinder or equirectangular view.",
        "pipefish undistort frame.png --profile camera.json --view perspective --fov 100 -o flat.png",
    )
    p.add_argument("input", metavar="INPUT", help="a picture, a folder of pictures, or a recording (.y4m)")
    p.add_argument("-o", "--output", required=True, metavar="OUT", help="picture, folder or .y4m to write")
    p.add_argument("--profile", required=True, metavar="PROFILE", help=WHICH)
    p.add_argument(
        "--view", choices=("perspective", "cube", "cylinder", "equirect"), default="perspective", help="[perspective]"
    )
    p.add_argument(
        "--fov",
        type=float,
        metavar="DEG",
        help="across the view's width [90; cylinder, equirect: 180]; up and down follow from --size: pixels are square",
    )
    p.add_argument(
        "--size", type=size_of, metavar="WxH", help="of the view [the picture's]; cube: edge of a face [half of it]"
    )
    p.add_argument(
        "--rotate",
        type=angles,
        default=(0.0, 0.0, 0.0),
        metavar="Y,P,R",
        help="yaw (right), pitch (up), roll (clockwise) of the view in degrees; --rotate=-30,0,0 for a negative yaw",
    )
    p.add_argument(
        "--distance",
        type=above_zero,
        metavar="M",
        help="where the view of a camera with a pupil shift is exact, metres [far]",
    )
    p.add_argument("--mask", metavar="FILE", help="also write a picture that is white where the camera sees")
    add_profile_input(p)
