"""The door build/hil/summary.json: both halves of `make hil` are in it, and nothing of a run before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from board import ROOT

SCENARIO = """
def test_{name}(note):
    from crawl import Result
    note(Result("{name}", 3, 2, cpu_ms=1.0, cpu_share={{"main": 1.0}}))
"""


def test_two_halves_at_once_make_one_summary_without_what_was_there(tmp_path: Path):
    """The recipe of `make hil` itself, on scenarios that need no board."""
    scenarios = tmp_path / "tests" / "hil"
    scenarios.mkdir(parents=True)
    for source in (ROOT / "tests/hil").glob("*.py"):
        if not source.name.startswith("test_"):
            (scenarios / source.name).write_bytes(source.read_bytes())
    text = "".join(SCENARIO.format(name=name) for name in "abcde")
    (scenarios / "test_five.py").write_text(text)
    (tmp_path / "pyproject.toml").write_text("")
    (tmp_path / "Makefile").write_bytes((ROOT / "Makefile").read_bytes())
    summary = tmp_path / "build/hil/summary.json"
    summary.parent.mkdir(parents=True)
    summary.write_text('[{"name": "of yesterday"}]')
    make = ["make", "hil-halves", f"PY={sys.executable}"]
    environment = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKELEVEL", "PYTEST_ADDOPTS")}
    done = subprocess.run(make, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads(summary.read_text())
    assert sorted(row["name"] for row in rows) == list("abcde")
    assert {"name", "frames_in", "keyframes_out", "lost", "duplicated", "recovery_s"} <= rows[0].keys()
