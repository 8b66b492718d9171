"""Every fuzz target for ten million inputs, in pieces that are kept: what was interrupted goes on where it stopped.

Each piece begins from the corpus that the pieces before left in build/accept/corpus, and keeps what it finds there. A
piece's figures hold for one build of its target. Pieces that would begin after --minutes are left out: the row then
tells the count so far, and does not hold. What the corpora reach is told as lines of the rooms that the target is there
for, by the same targets built to count them (build/coverage).

    python tests/accept_fuzz.py                   prints one JSON list of {name, value, bound, holds}
    python tests/accept_fuzz.py spool --minutes 10
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from accept_link import ROOT, pieces
from accept_rows import Row, exactly, figure, print_rows

TARGETS = ROOT / "build/clang/tests/fuzz"
COUNTING = ROOT / "build/coverage/tests/fuzz"
RUNS, PIECE = 10_000_000, 500_000


@dataclasses.dataclass(frozen=True)
class Reach:
    """What a target is there for, and how many of its lines no input reaches.

    The inputs in tests/fuzz/corpus alone reach all but `missed`, the same ones every time: no tolerance. The number is
    of those not reached, so that code may go; code that comes has to be reached, or the number raised with a reason.
    """

    rooms: str
    missed: int


REACH = {
    "csv": Reach(r"drivers/camera_replay/csv\.c", 36),
    "ini": Reach(r"firmware/(config|ini|utf8)\.c", 59),
    "link": Reach(r"lib/link/(?!messages)\w+\.c", 51),
    "messages": Reach(r"lib/link/messages\.c", 222),
    "peers": Reach(r"drivers/trust/peers\.c", 6),
    "picture": Reach(r"drivers/camera_replay/picture\.c", 11),
    "profile": Reach(r"lib/(profile/(profile|vectors|integers)|camera/(real|fixed)/\w+)\.c", 164),
    "profile_store": Reach(r"lib/profile/store\.c", 14),
    # 44 of them: how full the disk is and what is done then; files in memory have none (test_daemon_spool.py fills one)
    "spool": Reach(r"drivers/spool/\w+\.c", 126),
    "y4m": Reach(r"drivers/camera_replay/y4m\.c", 18),
}


def corpora(name: str) -> list[Path]:
    """Of a target: where what is found is kept, and what the project has."""
    kept, given = ROOT / "build/accept/corpus" / name, ROOT / "tests/fuzz/corpus" / name
    kept.mkdir(parents=True, exist_ok=True)
    return [kept, *([given] if given.is_dir() else [])]


def run_piece(target: Path, piece: int) -> dict:
    """PIECE inputs: whether something was found, and how many were run."""
    name = target.name.removeprefix("fuzz_")
    flags = [f"-runs={PIECE}", "-max_len=4096", f"-seed={piece + 1}", "-timeout=60", "-print_final_stats=1"]
    found = ROOT / "build/accept/found"
    found.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        [target, *flags, f"-artifact_prefix={found}/{name}-", *corpora(name)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        print(done.stderr[-3000:], file=sys.stderr)
    ran = re.search(r"stat::number_of_executed_units:\s+(\d+)", done.stderr)
    return {
        "runs": min(PIECE, int(ran.group(1))) if ran else 0,
        "findings": int(done.returncode != 0),
    }


def count_lines(name: str) -> tuple[int, int]:
    """Lines of the target's rooms that its corpora reach, and all of them."""
    target = COUNTING / f"fuzz_{name}"
    if not target.exists():
        raise SystemExit(f"no {target}: `make fuzz-coverage` builds it")
    with tempfile.TemporaryDirectory() as folder:
        raw, merged = Path(folder) / "raw", Path(folder) / "merged"
        run = [target, "-runs=0", "-max_len=4096", *corpora(name)]
        subprocess.run(run, env={**os.environ, "LLVM_PROFILE_FILE": str(raw)}, capture_output=True, check=True)
        subprocess.run(["llvm-profdata", "merge", raw, "-o", merged], check=True)
        export = ["llvm-cov", "export", target, f"-instr-profile={merged}", "-summary-only"]
        told = json.loads(subprocess.run(export, capture_output=True, check=True).stdout)
    files = {os.path.relpath(f["filename"], ROOT): f["summary"]["lines"] for f in told["data"][0]["files"]}
    lines = [count for path, count in files.items() if re.fullmatch(REACH[name].rooms, path)]
    return sum(line["covered"] for line in lines), sum(line["count"] for line in lines)


def check(target: Path, minutes: float) -> list[Row]:
    name = target.name.removeprefix("fuzz_")
    done = list(pieces(f"fuzz-{name}", target, RUNS // PIECE, minutes, lambda piece: run_piece(target, piece)))
    reached, lines = count_lines(name)
    bound = lines - REACH[name].missed
    return [
        exactly(f"fuzz.{name}_runs", sum(p["runs"] for p in done), RUNS),
        exactly(f"fuzz.{name}_findings", sum(p["findings"] for p in done), 0),
        figure(f"fuzz.{name}_lines", reached, f">= {bound} of {lines}", reached >= bound),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("only", nargs="*", help="names of targets; none: all of them")
    parser.add_argument("--minutes", type=float, default=150, help="for each target")
    args = parser.parse_args()
    built = {path.name.removeprefix("fuzz_") for path in TARGETS.glob("fuzz_*") if os.access(path, os.X_OK)}
    names = args.only or sorted(built | set(REACH))
    if wrong := sorted({*names} - (built & set(REACH))):
        raise SystemExit(f"no fuzz target, or none with its lines told here: {', '.join(wrong)} (make fuzz-build)")
    print_rows([row for name in names for row in check(TARGETS / f"fuzz_{name}", args.minutes)])


if __name__ == "__main__":
    main()
