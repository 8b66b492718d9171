"""What is measured of the tracker beside its own program: OpenCV in alternation, instructions, code and stack."""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from peers import PEERS

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ROOT / "build/release/tests/bench/bench_track"
FRAMES = 10


def against_opencv() -> list[dict]:
    """The figures against each OpenCV that is installed; a line on stderr for one that is not."""
    figures: list[dict] = []
    for name, python in PEERS.items():
        peer = f"opencv-{name}"
        has_opencv = [python, "-c", "import cv2"]
        if not python.exists() or subprocess.run(has_opencv, capture_output=True, check=False).returncode != 0:
            print(f"{peer}: {python} has no cv2: not compared", file=sys.stderr)
            continue
        command = [str(python), str(Path(__file__).with_name("track_peers.py")), peer]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise SystemExit(f"track_peers.py with {peer} failed: {done.stderr.strip()}")
        print(done.stderr.strip(), file=sys.stderr)
        figures += [json.loads(line) for line in done.stdout.splitlines()]
    return figures


def instructions() -> list[dict]:
    """Instructions of each stage of a frame (callgrind on this machine's code; the clock marks the stages)."""
    if not shutil.which("valgrind"):
        print("valgrind is not here: instructions are not counted", file=sys.stderr)
        return []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "callgrind"
        command = ["valgrind", "--tool=callgrind", "--dump-before=now_ns", f"--callgrind-out-file={out}"]
        subprocess.run([*command, PROGRAM, str(FRAMES)], capture_output=True, check=True)
        parts = sorted((f for f in out.parent.glob("callgrind.*")), key=lambda f: int(f.suffix[1:]))
        counts = [int(re.search(r"^(?:totals|summary): (\d+)", f.read_text(), re.M).group(1)) for f in parts]
    # parts end before the calls of the clock: first before the first frame, then three stages and the way to the next
    whole = counts[1 : 1 + 4 * (FRAMES + 1)]
    stages = {"pyramid": whole[4::4], "track": whole[5::4], "detect": whole[6::4]}
    return [
        {"name": f"track.instructions_{name}", "value": sum(count) / len(count), "unit": "instructions"}
        for name, count in stages.items()
    ]


def deepest(calls: str) -> int:
    """Bytes of stack of the deepest chain of calls in gcc's call graphs (-fcallgraph-info=su) put together.

    A call through a pointer is in no graph: the detector's question whether a corner is allowed, the predictor's
    projection. docs/targets.md has the whole of it, measured."""
    own = {name: int(n) for name, n in re.findall(r'node: { title: "([^"]+)" label: "[^"]*?(\d+) bytes', calls)}
    called: dict[str, set[str]] = {}
    for caller, callee in re.findall(r'edge: { sourcename: "([^"]+)" targetname: "([^"]+)"', calls):
        called.setdefault(caller, set()).add(callee)
    whole: dict[str, int] = {}

    def depth(name: str) -> int:
        if name not in whole:
            whole[name] = 0  # nothing here calls itself
            whole[name] = own.get(name, 0) + max((depth(c) for c in called.get(name, ())), default=0)
        return whole[name]

    return max(depth(name) for name in own)


def sizes() -> list[dict]:
    """Code and the stack of the deepest chain of calls, for Cortex-M7."""
    gcc = "arm-none-eabi-gcc"
    if not shutil.which(gcc):
        print(f"{gcc} is not here: sizes are not measured", file=sys.stderr)
        return []
    flags = ["-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-std=c11", "-O2"]
    sources = [f for room in ("track", "image") for f in (ROOT / "lib" / room).glob("*.c") if f.stem != "bearing"]
    code, calls = 0, ""
    with tempfile.TemporaryDirectory() as folder:
        for source in sources:
            out = Path(folder) / f"{source.stem}.o"
            command = [gcc, *flags, "-fcallgraph-info=su", f"-I{ROOT / 'lib/include'}", "-c", str(source), "-o", out]
            subprocess.run(command, check=True)
            size = subprocess.run(["arm-none-eabi-size", out], capture_output=True, text=True, check=True)
            code += int(size.stdout.splitlines()[1].split()[0])
            calls += out.with_suffix(".ci").read_text()
    return [
        {"name": "track.code_cortex_m7", "value": code, "unit": "bytes"},
        {"name": "track.deepest_stack_cortex_m7", "value": deepest(calls), "unit": "bytes"},
    ]


def measure() -> list[dict]:
    """All of it."""
    return against_opencv() + instructions() + sizes()
