"""Parts of the search for cracks, and what the report does with a map that it cannot use."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipefish.dense_cracks import NEAR, _beside
from pipefish.dense_findings import FORMAT, VERSION
from pipefish.dense_lines import Dark
from pipefish.errors import FormatError, PipefishError
from pipefish.report_dense import dense_part


@pytest.mark.parametrize("columns", [5, 97, 400])
def test_cells_beside_a_line_are_those_of_all_pairs_over_the_cut_too(columns: int) -> None:
    random = np.random.default_rng(columns)
    x, y = random.uniform(0, columns, 900), random.uniform(0, 120, 900)
    dark = Dark(x, y, *(np.ones(900) for _ in range(7)))
    chain, cells = np.arange(60), np.arange(40, 900)
    dx = (x[cells][:, None] - x[chain] + columns / 2) % columns - columns / 2
    every = np.hypot(dx, y[cells][:, None] - y[chain]).min(axis=1) < NEAR
    assert every.sum() > 50 and (columns == 5 or every.sum() < 800)
    assert (_beside(dark, cells, chain, columns) == every).all()


def test_a_map_of_an_older_version_is_no_reason_to_go_without_a_report(tmp_path: Path) -> None:
    (tmp_path / "reconstruction.json").write_text("{}")
    folder = tmp_path / "dense"
    folder.mkdir()
    (folder / "dense.json").write_text(json.dumps({"format": FORMAT, "version": VERSION - 1}))
    part = dense_part(tmp_path, None)
    assert "No dense map" in part.html and "run `pipefish dense` again" in part.html and not part.findings
    with pytest.raises(PipefishError, match="version"):  # where it is asked for
        dense_part(tmp_path, folder)
    (folder / "dense.json").write_text(json.dumps({"format": FORMAT, "version": VERSION}))
    with pytest.raises(FormatError, match="cell"):
        dense_part(tmp_path, None)
