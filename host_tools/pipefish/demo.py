"""`pipefish demo`: a whole survey on this machine: simulated pipe, daemon, emulated serial cable, reception, the pipe
measured, pages."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipefish import __version__
from pipefish.errors import PipefishError
from pipefish.intervals import SAID, Z95
from pipefish.terminal import say

PRESET = "demo"
BAUD = 3_000_000
BENCH_TIMEOUT_S = 120
PATIENCE_S = 60  # for a program that starts or ends, however busy the machine is
DRAIN_S = 900  # tracking is faster than the cable: 10 m are tracked in 20 s and sent in two minutes
CALIBRATION_VIEWS = 40
LOG_LINES = 12  # of a program that failed, shown with the error


@dataclass
class Programs:
    """The executables of one build."""

    daemon: Path
    line: Path
    bench_link: Path | None


def find_programs(build_dir: str | None) -> Programs:
    """The executables in `build_dir`, $PIPEFISH_BUILD or build/release. Raises PipefishError if one is not there."""
    folder = Path(build_dir or os.environ.get("PIPEFISH_BUILD") or "build/release")
    daemon, line = folder / "firmware" / "pipefishd", folder / "drivers" / "pipefish-line"
    for program in (daemon, line):
        if not os.access(program, os.X_OK):
            raise PipefishError(f"{program} is not there; run `make build`, or name the build with --build-dir")
    bench = folder / "tests" / "bench" / "bench_link"
    return Programs(daemon.resolve(), line.resolve(), bench.resolve() if os.access(bench, os.X_OK) else None)


@dataclass
class Recording:
    """Files of one simulated recording."""

    video: Path
    csv: Path
    truth: Path
    profile: Path

    @staticmethod
    def at(stem: Path) -> Recording:
        """The files that `pipefish simulate -o stem` writes."""
        return Recording(*(stem.with_name(stem.name + end) for end in (".y4m", ".csv", ".truth.json", ".profile.json")))

    def key(self) -> list[list[Any]]:
        """What tells whether the files are still those that were written."""
        return [[p.name, p.stat().st_size, p.stat().st_mtime_ns] for p in vars(self).values()]


def simulated(folder: Path, frames: int | None, fresh: bool, quiet: bool) -> Recording:
    """The demo's recording, simulated unless the same one is there already."""
    from pipefish.simcamera import calibrated
    from pipefish.simulate import Scene, scene_key, simulate

    recording = Recording.at(folder / PRESET)
    stamp = folder / "stamp.json"
    wanted = {"scene": scene_key(PRESET), "frames": frames, "software": __version__, "profile": CALIBRATION_VIEWS}
    if not fresh:
        with contextlib.suppress(OSError, ValueError):
            if json.loads(stamp.read_text()) == {**wanted, "files": recording.key()}:
                say("simulation: the recording is there already", quiet)
                return recording
    folder.mkdir(parents=True, exist_ok=True)
    stamp.unlink(missing_ok=True)
    say("simulation: a 6 m DN300 concrete pipe with a bend and an oval stretch", quiet)
    simulate(PRESET, folder / PRESET, frames=frames, quiet=quiet)
    say(f"calibration: the simulated camera, from {CALIBRATION_VIEWS} views of a board", quiet)
    calibrated(Scene.load(PRESET), CALIBRATION_VIEWS).save(recording.profile)
    stamp.write_text(json.dumps({**wanted, "files": recording.key()}))
    return recording


@contextlib.contextmanager
def program(command: list[str | Path], log: Path) -> Iterator[subprocess.Popen[str]]:
    """Runs a program beside us, its messages in `log`, its output in the pipe; ends it with the block."""
    with open(log, "w") as messages:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=messages, text=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def last_lines(log: Path) -> str:
    """The end of a log, for an error."""
    lines = log.read_text(errors="replace").splitlines()[-LOG_LINES:]
    return "\n".join(f"  {line}" for line in lines) or "  (it said nothing)"


def config_text(recording: Recording, profile: Path, run: Path) -> str:
    """pipefishd's configuration for the demo: frames as fast as they are tracked, not in real time; none is dropped."""
    truth = json.loads(recording.truth.read_text())
    sections: dict[str, dict[str, Any]] = {
        "survey": {"name": "demo pipe", "nominal_diameter_mm": round(truth["scene"]["diameter"] * 1000)},
        "camera": {
            "driver": "replay",
            "path": recording.video.resolve(),
            "csv": recording.csv.resolve(),
            "speed": "fast",
            "profile": profile.resolve(),
        },
        "encoder": {"metres_per_count": repr(truth["scene"]["telemetry"]["metres_per_count"])},
        "link": {"transport": "serial", "device": (run / "crawler").absolute(), "baud": BAUD},
        "spool": {"path": (run / "spool.db").absolute()},
        "daemon": {"drain_s": DRAIN_S},
    }
    return "\n".join(
        f"[{section}]\n" + "".join(f"{key} = {value}\n" for key, value in keys.items())
        for section, keys in sections.items()
    )


def survey_over_the_line(programs: Programs, recording: Recording, run: Path, quiet: bool) -> dict[str, Any]:
    """Plays the recording through pipefishd and receives it over an emulated serial cable. Returns what `receive` says
    and what the cable says ("cable")."""
    from pipefish.camera import Camera
    from pipefish.receive import Interrupted, receive
    from pipefish.transport import open_transport

    shutil.rmtree(run, ignore_errors=True)
    run.mkdir(parents=True)
    profile = run / "camera.profile"
    profile.write_bytes(Camera.load(recording.profile).to_binary())
    config = run / "pipefishd.ini"
    config.write_text(config_text(recording, profile, run))
    line_log, daemon_log = run / "line.log", run / "pipefishd.log"
    ends = [run / "crawler", run / "host"]
    with program([programs.line, "--baud", str(BAUD), *ends], line_log) as line:
        deadline = time.monotonic() + PATIENCE_S
        while not all(end.exists() for end in ends):
            if line.poll() is not None or time.monotonic() > deadline:
                raise PipefishError(f"the emulated cable did not start:\n{last_lines(line_log)}")
            time.sleep(0.01)
        with program([programs.daemon, "--config", config], daemon_log) as daemon:
            say(f"survey: pipefishd over a serial line of {BAUD / 1e6:g} Mbaud", quiet)
            try:
                summary = receive(
                    open_transport(str(ends[1]), BAUD),
                    run.parent / "survey.mcap",
                    overwrite=True,
                    stop=lambda: daemon.poll() is not None,
                    quiet=quiet,
                )
            except Interrupted as error:
                code = daemon.poll()
                why = str(error) if code is None else f"pipefishd ended with code {code} before the survey was complete"
                raise PipefishError(f"{why}; its log, {daemon_log}:\n{last_lines(daemon_log)}") from error
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(PATIENCE_S)  # its spool is empty: it ends by itself
        if daemon.returncode != 0:
            raise PipefishError(f"pipefishd failed with code {daemon.returncode}:\n{last_lines(daemon_log)}")
        line.send_signal(signal.SIGTERM)
        summary["cable"] = json.loads(line.communicate(timeout=PATIENCE_S)[0])
    return summary


def link_goodput(bench: Path | None, quiet: bool) -> dict[str, float]:
    """Payload delivered against what the emulated line could carry, in virtual time: link_goodput_clean, _1pct."""
    if bench is None:
        return {}
    say("link: goodput in virtual time", quiet)
    done = subprocess.run([bench], capture_output=True, text=True, timeout=BENCH_TIMEOUT_S, check=False)
    if done.returncode != 0:
        raise PipefishError(f"{bench.name} failed with code {done.returncode}: {done.stderr.strip()}")
    figures = [json.loads(text) for text in done.stdout.splitlines() if text.strip()]
    names = {"link.goodput_clean": "link_goodput_clean", "link.goodput_1pct": "link_goodput_1pct"}
    return {names[f["name"]]: f["value"] for f in figures if f["name"] in names}


def measured_extra(summary: dict[str, Any]) -> dict[str, Any]:
    """What the demo's page says about the measured pipe, with the link to the report."""
    if summary["report"] is None:
        return {"measured_rows": [("measured", f"not: {summary['measured_why']}")]}
    m = summary["measured"]
    rows = [
        ("mean diameter", f"{1000 * m['d_mean']:.1f} mm"),
        ("  repeatability", f"± {1000 * Z95 * m['d_mean_sigma']:.2f} mm"),
        ("  systematic", f"± {1000 * Z95 * m['d_mean_systematic']:.2f} mm"),
        ("  intervals", SAID),
        ("stations measured", f"{m['stations_measured']} of {m['stations']}"),
    ]
    texts = (
        ("diameter_rms_pct", "diameter against the truth, rms", "{:.2f} %"),
        ("diameter_scatter_pct", "  without the mean error", "{:.2f} %"),
        ("ovality_rms_points", "ovality against the truth, rms", "{:.2f} points"),
        ("encoder_pct", "error of the simulated encoder's scale", "{:+.2f} %"),
        ("bend_degrees", "angle of the bend, error", "{:.2f} degrees"),
    )
    rows += [(words, form.format(summary[key])) for key, words, form in texts if summary.get(key) is not None]
    return {"measured_rows": rows, "report": Path(summary["report"]).name}


def link_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """The page's table about the link."""
    link, cable = summary["received"]["link"], summary["received"]["cable"]
    goodput, fps = link["goodput_bytes_per_s"] or 0, summary["fps"]
    share = f" ({100 * goodput / (BAUD / 10):.0f} % of the line)" if goodput else ""
    rows = [
        ("line", f"emulated serial cable, {BAUD / 1e6:g} Mbaud"),
        ("objects delivered", f"{link['objects']}, {link['bytes'] / 1e6:.2f} MB"),
        *([("tracking time", f"{summary['frames'] / fps:.1f} s, {fps:.1f} frames per second")] if fps else []),
        (
            "transfer time",
            f"{link['duration_s']:.1f} s from the first object to the last",
        ),
        ("goodput of the line over the transfer", f"{goodput / 1000:.1f} kB/s{share}"),
        ("fragments sent again", f"{link['fragments_resent']} of {link['fragments_received']}"),
        ("damaged frames", f"{link['crc_errors_host']} at the host, {link['crc_errors_device']} at the device"),
        ("round trip", f"{link['rtt_ms']:.1f} ms"),
        ("bytes on the wire", f"{cable['a_to_b'] / 1e6:.2f} MB to the host, {cable['b_to_a'] / 1e3:.1f} kB back"),
    ]
    for key, what in (("link_goodput_clean", "clean line"), ("link_goodput_1pct", "1 % of frames lost")):
        if key in summary:
            rows.append((f"goodput in virtual time, {what}", f"{100 * summary[key]:.1f} % of the line"))
    return rows


LIMITS = [("ovality", 5.0), ("d_min", 285.0)]  # of the demo's report; the pipe is 4 % oval, DN300


def measured(survey: Any, truth: Any, out: Path, quiet: bool) -> dict[str, Any]:
    """Measures the survey, writes its files and the report, and compares with the truth. The summary's part of it:
    "report" is None, with "measured_why", where nothing could be measured."""
    from pipefish.measure import measure
    from pipefish.measured_files import write_measurement
    from pipefish.measuretruth import against_truth
    from pipefish.progress import Progress
    from pipefish.report import write_report

    say("measuring the pipe", quiet)
    started = time.monotonic()
    try:
        with Progress("reconstruct", 100, quiet) as bar:
            result = measure(survey, tell=lambda done, word: bar.update(round(100 * done), word))
            document, _ = write_measurement(result, out / "pipe")
    except PipefishError as error:
        return {"report": None, "measured_why": str(error)}
    report = out / "report.html"
    verdicts = write_report(out / "pipe", report, limits=LIMITS, title="Demo pipe, measured")
    figures_of = document["summary"]
    names = ("d_mean", "d_mean_sigma", "d_mean_systematic", "ovality_rms", "ovality_most", "path_length", "points")
    return {
        **{key: value for key, value in (against_truth(result, truth) or {}).items() if not key.startswith("stations")},
        "measured": {name: figures_of.get(name) for name in (*names, "stations", "stations_measured", "events")},
        "limits": {v["name"]: v["state"] for v in verdicts},
        "report": str(report),
        "measure_seconds": round(time.monotonic() - started, 1),
    }


def demo(
    out: Path,
    *,
    frames: int | None = None,
    build_dir: str | None = None,
    fresh: bool = False,
    quiet: bool = False,
) -> tuple[dict[str, Any], Path]:
    """Runs the whole demo into the folder `out`. Returns the summary (that of summary.json) and the page's path.

    Raises PipefishError, with the log of the program that failed; OSError.
    """
    from pipefish.evaluate import evaluate
    from pipefish.files import write_atomically
    from pipefish.page import write_page
    from pipefish.simulate import Scene
    from pipefish.survey import Survey

    programs = find_programs(build_dir)
    out.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    recording = simulated(out / "recording", frames, fresh, quiet)
    received = survey_over_the_line(programs, recording, out / "run", quiet)
    survey = Survey.open(received["file"])
    say("evaluation against the truth", quiet)
    truth = Scene.from_truth(recording.truth)
    evaluation = evaluate(survey, truth)
    info, status, link = survey.info, survey.last_status, received["link"]
    summary: dict[str, Any] = {
        "frames": info["frames"],
        "fps": round(status.fps, 2) if status else None,
        "keyframes_sent": survey.end.keyframes if survey.end else None,
        "keyframes_received": info["keyframes"],
        "bytes": link["bytes"],
        "crc_errors": link["crc_errors_host"] + (link["crc_errors_device"] or 0),
        "track_length_median": info["tracks"]["length_frames_median"],
        "track_length_p90": info["tracks"]["length_frames_p90"],
        "track_length_keyframes_median": info["tracks"]["length_keyframes_median"],
        "within_1px": evaluation["within_1px"] if evaluation else None,
        "survival": evaluation["survival"] if evaluation else None,
        "evaluation": evaluation,
        **link_goodput(programs.bench_link, quiet),
        "length_m": info["length_m"],
        **measured(survey, truth, out, quiet),
        "received": received,
    }
    say("page", quiet)
    page = out / "index.html"
    length = f"{info['length_m']:.1f} m of " if info["length_m"] is not None else ""
    lead = (
        f"{length}simulated DN{info['nominal_diameter_m'] * 1000:.0f} concrete pipe with a bend and an oval stretch, "
        f"driven in {info['duration_s']:.0f} s. The recorded frames went through pipefishd, its keyframes over an "
        f"emulated serial line of {BAUD / 1e6:g} Mbaud into one survey file. The simulator knows the truth, so every "
        "track is checked."
    )
    extra = {
        "goodput_bytes_per_s": link["goodput_bytes_per_s"],
        "link_rows": link_rows(summary),
        **measured_extra(summary),
    }
    write_page(survey, page, title="Demo pipe", lead=lead, evaluation=evaluation, extra=extra, quiet=quiet)
    summary["seconds"] = round(time.monotonic() - start, 1)
    summary["page"] = str(page)
    write_atomically(out / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())
    return summary, page


def figures(summary: dict[str, Any]) -> str:
    """The short table at the end of `pipefish demo`."""
    from pipefish.cli import size_text, table

    def percent(name: str) -> str | None:
        return f"{100 * summary[name]:.2f} %" if summary.get(name) is not None else None

    def camera_frames(name: str) -> str | None:
        return f"{summary[name]:.0f} camera frames" if summary.get(name) is not None else None

    def number(name: str, unit: str) -> str | None:
        return f"{summary[name]:.2f} {unit}" if summary.get(name) is not None else None

    return table(
        [
            ("frames", summary["frames"]),
            ("frames per second of the daemon", summary["fps"]),
            ("keyframes sent", summary["keyframes_sent"]),
            ("keyframes received", summary["keyframes_received"]),
            ("bytes", f"{summary['bytes']} ({size_text(summary['bytes'])})"),
            ("CRC errors", summary["crc_errors"]),
            ("track length, median", camera_frames("track_length_median")),
            ("track length, 90th percentile", camera_frames("track_length_p90")),
            ("tracked points within 1 px of the truth", percent("within_1px")),
            ("followed to the next keyframe, of those possible", percent("survival")),
            ("diameter against the truth, rms", number("diameter_rms_pct", "%")),
            ("ovality against the truth, rms", number("ovality_rms_points", "points")),
            ("the pipe", summary.get("measured_why")),
            ("report", summary["report"]),
            ("link goodput, clean", percent("link_goodput_clean")),
            ("link goodput, 1 % of frames lost", percent("link_goodput_1pct")),
        ]
    )
