"""The long tests: `make accept` writes build/accept.json ({name, value, bound, holds} each) and prints a table.

Resumable: each check's result is kept in build/accept/ under the commit it was measured at; a second run at the same
commit measures only what is missing. --fresh forgets them.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from accept_rows import Row, at_least, at_most, exactly

from pipefish.health import VERDICTS

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build"


def run(*command: str | Path, **env: str) -> subprocess.CompletedProcess:
    """Runs a command at the project's top; its output is returned, not shown."""
    return subprocess.run(
        [str(c) for c in command], cwd=ROOT, env={**os.environ, **env}, capture_output=True, text=True, check=False
    )


def check_link_goodput() -> list[Row]:
    """Payload delivered against what the emulated 3 Mbaud line carries, and how long a request takes at 921600
    baud; virtual time."""
    done = run(BUILD / "release/tests/bench/bench_link")
    values = {f["name"]: f["value"] for f in map(json.loads, done.stdout.splitlines())}
    return [
        at_least("link.goodput_clean", values["link.goodput_clean"], 0.97),
        at_least("link.goodput_1pct", values["link.goodput_1pct"], 0.90),
        at_most("link.control_rtt_ms", values["link.control_rtt_most"], 40),
    ]


def rows_of(script: str, *arguments: object, python: object = sys.executable, **environment: str) -> list[Row]:
    """The rows that a script of long tests prints; it resumes by itself."""
    done = run(python, f"tests/{script}", *arguments, **environment)
    print(done.stderr, file=sys.stderr)
    if done.returncode != 0:
        raise SystemExit(f"{script} failed: {done.stderr.strip()}")
    return json.loads(done.stdout.splitlines()[-1])


def peers_path() -> str:
    """OpenCV for this environment's Python."""
    peers = next((BUILD / "venv-peers/lib").glob("python3*/site-packages"), None)
    if peers is None:
        raise SystemExit("build/venv-peers is missing: `make accept` installs it")
    return str(peers)


def check_track() -> list[Row]:
    """The tracker's accuracy on closed-form images; the benchmark's OpenCV beside it if `make bench` got one."""
    peers = BUILD / "venv-peers/bin/python"
    return rows_of("accept_track.py", python=peers if peers.exists() else sys.executable)


def check_pipes() -> list[Row]:
    """The whole chain in 24 simulated pipes: material, diameter, speed; the truth and OpenCV beside it."""
    return rows_of("accept_pipes.py", PYTHONPATH=peers_path())


def check_match() -> list[Row]:
    """Matches of views that lie far apart, against their homographies."""
    return rows_of("accept_match.py")


def check_recognise() -> list[Row]:
    """Objects in simulated and in real scenes, beside OpenCV's SIFT."""
    return rows_of("accept_recognise.py", "--pictures", BUILD / "accept/recognise", PYTHONPATH=peers_path())


def check_calib() -> list[Row]:
    """Calibration over random set-ups, against theory, and on real data where they are."""
    return rows_of("accept_calib.py")


def check_selfcal() -> list[Row]:
    """Self-calibration and the profile's health check over random set-ups and on real data."""
    return rows_of("accept_selfcal.py")


def check_segment() -> list[Row]:
    """Motion segmentation over made-up, simulated and real pairs."""
    return rows_of("accept_segment.py", "--pictures", BUILD / "accept/segment")


def check_recon() -> list[Row]:
    """Reconstruction and tube against theory, and in rendered pipes."""
    return rows_of("accept_recon.py")


def check_recon_peers() -> list[Row]:
    """Reconstruction's times beside its peers' in the same run, as `make bench ONLY=recon` measures them; and the cost
    of an adjustment beside what Ceres finds."""
    if not (BUILD / "peers/tests/bench/bench_recon").exists():
        raise SystemExit("build/peers is missing: `make bench` builds it")
    peers_path()
    out = BUILD / "accept/bench-recon.json"
    done = run(sys.executable, "tests/bench/run.py", "--only", "recon", "--out", out)
    if done.returncode != 0:
        raise SystemExit(f"bench failed: {done.stderr.strip()}")
    figures = json.loads(out.read_text())

    def worst(name: str, key: str) -> float:
        return max(f[key] for f in figures if f["name"] == name)

    return [
        at_most("recon.two_view_ms", worst("recon.two_view", "value"), 5.0),
        at_most("recon.total_over_colmap", worst("recon.total_30m", "ratio"), 0.1),
        at_most("recon.ba_over_ceres", worst("recon.ba", "ratio"), 0.15),
        at_most("recon.ba_cost_off", worst("recon.ba_cost_off", "value"), 1e-5),
    ]


def check_dense() -> list[Row]:
    """The wall of a DN400, densely, after the device's program and the reconstruction."""
    return rows_of("accept_dense.py")


def check_link() -> list[Row]:
    """10,000 sessions over bad lines, and a million frames through the daemon."""
    return rows_of("accept_link.py")


def check_link_seeds() -> list[Row]:
    """The link's fault scenarios on 20 times as many lines as `make test` takes."""
    program = BUILD / "debug/tests/unit/test_link_channel"
    failures = sum(run(program, PIPEFISH_TEST_SEED=str(1000 * (i + 1))).returncode != 0 for i in range(20))
    return [exactly("link.seeds_failed_of_20", failures, 0)]


def check_profile_store() -> list[Row]:
    """The profile store under every pair of power cuts, and a million times with flipped bits."""
    done = run(BUILD / "debug/tests/unit/test_profile_store", PIPEFISH_TEST_LONG="1")
    cuts, seconds = re.search(r"^power cuts: (\d+) in ([\d.]+) s", done.stdout, re.MULTILINE).groups()
    flips = re.search(r"^flipped bits: (\d+)", done.stdout, re.MULTILINE).group(1)
    return [
        exactly("profile_store.failed", done.returncode, 0),
        at_least("profile_store.cuts", int(cuts), 100000),
        at_most("profile_store.cuts_cpu_s", float(seconds), 60),
        at_least("profile_store.flips", int(flips), 1000000),
    ]


def check_daemon_kills() -> list[Row]:
    """kill -9 at 10 times as many moments: nothing acknowledged is lost, nothing arrives twice."""
    command = (sys.executable, "-m", "pytest", "-q", "tests/python/test_daemon_spool.py", "-k", "kill")
    failures = sum(run(*command, PIPEFISH_TEST_SEED=str(i + 1)).returncode != 0 for i in range(10))
    return [exactly("daemon.kills_failed_of_10", failures, 0)]


GOLDEN_FRAMES, GOLDEN_HASH = 10_000, "bf6e1884"


def check_golden_replay() -> list[Row]:
    """The hash of a long replay through the tracker, on x86 and (emulated) on aarch64."""
    rows = []
    for target, folder, emulator in (
        ("x86", "debug", ()),
        ("aarch64", "aarch64", ("qemu-aarch64-static", "-L", "/usr/aarch64-linux-gnu")),
    ):
        done = run(*emulator, BUILD / folder / "tests/unit/golden_replay", str(GOLDEN_FRAMES))
        differs = done.returncode != 0 or done.stdout.split()[:1] != [GOLDEN_HASH]
        rows.append(exactly(f"track.golden_{GOLDEN_FRAMES}_{target}_differs", int(differs), 0))
    return rows


def check_fuzz() -> list[Row]:
    """Every fuzz target for ten million inputs, as far as an hour each reaches; the next run goes on."""
    return rows_of("accept_fuzz.py")


def check_spool() -> list[Row]:
    """The spool, killed at every write of 1,000 records: what was reported as stored or removed is so."""
    done = run(BUILD / "debug/tests/unit/test_spool_faults", PIPEFISH_TEST_LONG="1")
    killed = re.search(r"^killed at (\d+) writes of (\d+) records, lost (\d+)", done.stdout, re.MULTILINE)
    writes, records, lost = map(int, killed.groups()) if killed else (0, 0, -1)
    return [
        exactly("spool.failed", done.returncode, 0),
        exactly("spool.records", records, 1000),
        at_least("spool.killed_at_writes", writes, records),
        exactly("spool.acknowledged_lost", lost, 0),
    ]


def check_demo() -> list[Row]:
    """The demo survey, whole."""
    done = run(sys.executable, "-m", "pipefish", "demo", "--out", "build/demo")
    if done.returncode != 0:
        return [exactly("demo.exit_code", done.returncode, 0)]
    summary = json.loads((BUILD / "demo/summary.json").read_text())
    if summary["report"] is None:
        return [exactly("demo.not_measured", 1, 0)]
    document = json.loads((BUILD / "demo/pipe/reconstruction.json").read_text())
    return [
        exactly("demo.reports", int((ROOT / summary["report"]).is_file()), 1),
        at_least("demo.diameter_held", summary["diameter_covered"], 0.9),
        at_least("demo.ovality_held", summary["ovality_covered"], 0.9),
        exactly("demo.profile_drifted", int(document["quality"]["profile"]["verdict"] == VERDICTS["drifted"]), 0),
        at_least("demo.within_1px", summary["within_1px"], 0.95),
        at_least("demo.survival", summary["evaluation"]["survival"], 0.7),
        exactly("demo.keyframes_missing", summary["keyframes_sent"] - summary["keyframes_received"], 0),
        exactly("demo.crc_errors", summary["crc_errors"], 0),
    ]


CHECKS: dict[str, Callable[[], list[Row]]] = {
    "link_goodput": check_link_goodput,
    "track": check_track,
    "pipes": check_pipes,
    "calib": check_calib,
    "match": check_match,
    "recognise": check_recognise,
    "selfcal": check_selfcal,
    "segment": check_segment,
    "recon": check_recon,
    "recon_peers": check_recon_peers,
    "dense": check_dense,
    "link_seeds": check_link_seeds,
    "link": check_link,
    "profile_store": check_profile_store,
    "spool": check_spool,
    "daemon_kills": check_daemon_kills,
    "golden_replay": check_golden_replay,
    "fuzz": check_fuzz,
    "demo": check_demo,
}


def main() -> int:
    """Measures what is missing; 1 when a row does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=BUILD / "accept.json")
    parser.add_argument("--fresh", action="store_true", help="measure everything again")
    args = parser.parse_args()
    commit = run("git", "rev-parse", "--short", "HEAD").stdout.strip()
    dirty = bool(run("git", "status", "--porcelain").stdout)
    kept = BUILD / "accept"
    kept.mkdir(parents=True, exist_ok=True)

    rows: list[Row] = []
    for name, check in CHECKS.items():
        file = kept / f"{commit}-{name}.json"
        if file.exists() and not args.fresh and not dirty:
            rows += json.loads(file.read_text())
            continue
        print(f"{name}: {check.__doc__}", file=sys.stderr)
        measured = check()
        if not dirty:  # figures of uncommitted code are not the commit's
            file.write_text(json.dumps(measured))
        rows += measured
    for row in rows:
        print(f"  {'holds' if row['holds'] else 'FAILS'}  {row['name']:32} {row['value']:10.4g}  {row['bound']}")
    partial = args.out.with_suffix(".partial")
    partial.write_text(json.dumps(rows, indent=1) + "\n")
    partial.replace(args.out)
    print(args.out)
    return 0 if all(row["holds"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
