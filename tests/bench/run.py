"""Runs the benchmarks and writes build/bench.json: a list of {name, value, unit, peer, peer_value, ratio}.

Each program bench_ROOM of build/release/tests/bench prints one JSON object a line, {"name", "value", "unit"} and, where
a peer was measured in the same run, {"peer", "peer_value"}, with "peer_version" and "peer_isa" of the tracker's peers;
ratio = value / peer_value. Rooms of the Python package are
measured here. `--only link.goodput` keeps the figures whose names start so.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import room_calib
import room_match
import room_track
from peers import PEERS

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ROOT / "build" / "release" / "tests" / "bench"


def run_program(*command: Path) -> list[dict]:
    """Runs one benchmark program and returns its figures."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{command[0]} {command[-1]} failed with exit code {done.returncode}: {done.stderr.strip()}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.strip()]


def bench_sim() -> list[dict]:
    """sim.fps: frames of the demo scene drawn per second on one thread, lens, light and noise included."""
    from pipefish.simulate import Scene

    scene = Scene.load("demo")
    scene.render(100, threads=1)
    count, start = 0, time.perf_counter()
    while time.perf_counter() - start < 5.0:
        scene.render(100 + count % 400, threads=1)
        count += 1
    return [{"name": "sim.fps", "value": count / (time.perf_counter() - start), "unit": "frames/s"}]


def bench_camera() -> list[dict]:
    """camera.project, camera.unproject, camera.lut against every peer that is installed."""
    library = PROGRAMS / "libbench_camera_core.so"
    script = ROOT / "tests" / "bench" / "camera_peers.py"
    return [figure for python in PEERS.values() if python.exists() for figure in run_program(python, script, library)]


def bench_recon() -> list[dict]:
    """recon.two_view beside PoseLib and recon.total_30m beside COLMAP, each in one process; recon.ba beside Ceres."""
    peers = PEERS["pip"].parents[1] / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    ceres = ROOT / "build" / "peers" / "tests" / "bench" / "bench_recon"
    figures = run_program(sys.executable, ROOT / "tests" / "bench" / "recon_peers.py", peers) if peers.exists() else []
    return figures + (run_program(ceres) if ceres.exists() else [])


def bench_segment() -> list[dict]:
    """segment.cut_wrong, segment.cut_s: the least cut beside OpenCV's."""
    program = ROOT / "build" / "peers" / "tests" / "bench" / "bench_cut"
    return run_program(program) if program.exists() else []


PYTHON_ROOMS = {
    "calib": room_calib.measure,
    "camera": bench_camera,
    "match": room_match.measure,
    "recon": bench_recon,
    "segment": bench_segment,
    "sim": bench_sim,
    "track": room_track.measure,
}


def cpu_name() -> str:
    """The processor's name as Linux tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("model name", "Model")):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.machine()


def main() -> int:
    """Measures, prints a table, writes the file; 1 when a benchmark fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench.json")
    parser.add_argument("--only", default="", help="a room (track) or the start of a name (link.goodput)")
    args = parser.parse_args()
    room = args.only.split(".")[0]

    figures: list[dict] = []
    for program in sorted(PROGRAMS.glob("bench_*")):
        if os.access(program, os.X_OK) and program.is_file() and (not room or program.name == f"bench_{room}"):
            figures += run_program(program)
    for name, measure in PYTHON_ROOMS.items():
        if not room or room == name:
            figures += measure()
    figures = [f for f in figures if f["name"].startswith(args.only)]
    if not figures:
        print(f"no benchmark is called '{args.only}'", file=sys.stderr)
        return 1

    print(f"{cpu_name()}, {os.cpu_count()} cores, one thread unless the figure says otherwise")
    for figure in figures:
        peer_value = figure.setdefault("peer_value", None)
        figure.setdefault("peer", None)
        figure["ratio"] = figure["value"] / peer_value if peer_value else None
        against = f"  {figure['ratio']:.2f} x {figure['peer']}" if peer_value else ""
        print(f"  {figure['name']:28} {figure['value']:12.4g} {figure['unit']}{against}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    partial = args.out.with_suffix(".partial")
    partial.write_text(json.dumps(figures, indent=1) + "\n")
    partial.replace(args.out)
    print(args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
