"""The commands `pipefish info`, `show` and `evaluate`: what is in a survey file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pipefish.cli import Result, add_command, seconds_text, size_text, table
from pipefish.errors import PipefishError


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


def add_info(commands: Any) -> None:
    """Adds `info` to the command line."""
    p = add_command(commands, "info", run_info, "Tell what is in a survey file.", "pipefish info survey.mcap")
    p.add_argument("survey", metavar="FILE", help="survey file, complete or .partial")


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


def add_show(commands: Any) -> None:
    """Adds `show` to the command line."""
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


def add_evaluate(commands: Any) -> None:
    """Adds `evaluate` to the command line."""
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
