"""The file of what the scenarios saw: build/hil/summary.json, one object a scenario."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path


def add_rows(path: Path, rows: list[dict]) -> None:
    """Adds rows to those that another half of the same run may be writing at this moment."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        rows = json.loads(file.read() or "[]") + rows
        file.truncate(0)
        file.write(json.dumps(rows, indent=1) + "\n")
