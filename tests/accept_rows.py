"""Rows of the long tests' tables, and measurements that are kept: what was interrupted goes on where it stopped.

Kept results hold for one state of the product and of the scripts: after any change they are measured again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipefish import _engine
from pipefish.demo import find_programs
from pipefish.errors import PipefishError

Row = dict[str, Any]

ROOT = Path(__file__).resolve().parents[1]


def figure(name: str, value: float, bound: str, holds: bool) -> Row:
    """A row of the table."""
    return {"name": name, "value": value, "bound": bound, "holds": bool(holds)}


def at_least(name: str, value: float, bound: float) -> Row:
    """A row that holds from `bound` upwards."""
    return figure(name, value, f">= {bound}", value >= bound)


def at_most(name: str, value: float, bound: float) -> Row:
    """A row that holds up to `bound`."""
    return figure(name, value, f"<= {bound}", value <= bound)


def exactly(name: str, value: float, bound: float) -> Row:
    """A row that holds at `bound` only."""
    return figure(name, value, f"= {bound}", value == bound)


def print_rows(rows: list[Row]) -> None:
    """The table for people on stderr, the rows as one line of JSON on stdout."""
    for row in rows:
        holds = "holds" if row["holds"] else "FAILS"
        print(f"  {holds}  {row['name']:45} {row['value']:12.6g}  {row['bound']}", file=sys.stderr)
    print(json.dumps(rows))


@functools.cache
def product() -> bytes:
    """Digest of what is measured: the engine, the package with all below it and its scenarios, and the programs of the
    build, through which surveys go."""
    package = (ROOT / "host_tools/pipefish").rglob("*")
    files = [Path(_engine.__file__), *sorted(p for p in package if p.suffix in (".py", ".toml"))]
    with contextlib.suppress(PipefishError):  # not built: then nothing can be measured through them
        programs = find_programs(None)
        files += [programs.daemon, programs.line]
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.read_bytes())
    return digest.digest()


def state() -> str:
    """What the figures depend on: the product, the script that runs and its scenes, those imported later too."""
    loaded = {Path(m.__file__) for m in list(sys.modules.values()) if getattr(m, "__file__", None)}
    digest = hashlib.sha256(product())
    for path in sorted(p for p in loaded if p.is_relative_to(ROOT / "tests")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def kept(folder: Path, name: str, work: Callable[[], Any]) -> Any:
    """What `work` returns, from the folder's file where an earlier run left it."""
    return kept_series(folder, name, 1, lambda _: {"result": work()})[0]["result"]


def kept_series(folder: Path, name: str, count: int, measure: Callable[[int], Row]) -> list[Row]:
    """measure(0..count-1), each from the folder's file where an earlier run left it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.jsonl"
    lines = map(json.loads, path.read_text().splitlines()) if path.exists() else ()
    rows = {r["seed"]: r for r in lines if r.get("state") == state()}
    with path.open("a") as out:
        for seed in range(count):
            if seed in rows:
                continue
            began = time.monotonic()
            rows[seed] = {"state": state(), "seed": seed, **measure(seed)}
            out.write(json.dumps(rows[seed]) + "\n")
            out.flush()
            if sys.stderr.isatty() or count == 1:
                print(f"  {name} {seed + 1}/{count}: {time.monotonic() - began:.0f} s", file=sys.stderr)
    return [rows[s] for s in range(count)]
