"""Kept results of the long tests hold for one state of the product: all of what they go through is in it."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

TESTS = Path(__file__).resolve().parents[1]


@pytest.fixture
def rows(tmp_path, monkeypatch):
    """accept_rows over a product of a few files."""
    monkeypatch.syspath_prepend(str(TESTS))
    monkeypatch.delitem(sys.modules, "accept_rows", raising=False)
    import accept_rows

    for name in ("engine.so", "pipefishd", "pipefish-line", "host_tools/pipefish/a.py", "host_tools/pipefish/b/c.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("first")
    monkeypatch.setattr(accept_rows, "ROOT", tmp_path)
    monkeypatch.setattr(accept_rows, "_engine", SimpleNamespace(__file__=str(tmp_path / "engine.so")))
    programs = SimpleNamespace(daemon=tmp_path / "pipefishd", line=tmp_path / "pipefish-line")
    monkeypatch.setattr(accept_rows, "find_programs", lambda _: programs)
    yield accept_rows
    accept_rows.product.cache_clear()
    monkeypatch.delitem(sys.modules, "accept_rows", raising=False)


@pytest.mark.parametrize(
    "name", ["engine.so", "pipefishd", "pipefish-line", "host_tools/pipefish/a.py", "host_tools/pipefish/b/c.py"]
)
def test_kept_results_are_measured_again_after_a_change_of_any_part_of_the_product(rows, tmp_path, name):
    kept = rows.kept(tmp_path / "kept", "x", lambda: 1)
    assert kept == rows.kept(tmp_path / "kept", "x", lambda: 2) == 1
    (tmp_path / name).write_text("second")
    rows.product.cache_clear()
    assert rows.kept(tmp_path / "kept", "x", lambda: 3) == 3
