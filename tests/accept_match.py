"""Matching over wide baselines: graf 1-3 to 1-6 against the homography of the wall, as `pipefish match` filters; and
fountain-P11's neighbours (python/fountain.py).

That homography is the wall's alone: matches on the strip below the kerb, another plane, count as wrong.

    python tests/accept_match.py

prints a table, then one JSON list of {name, value, bound, holds}. Needs $PIPEFISH_DATA or ../shared/data.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from accept_rows import Row, at_least, print_rows

import pipefish as pf

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests/bench"), str(ROOT / "tests/python")]
DATA = Path(os.environ.get("PIPEFISH_DATA") or ROOT.parent / "shared" / "data")
BOUNDS = {3: 0.9, 4: 0.8, 5: 0.7, 6: 0.7}  # of the matches within 3 pixels
LEAST = 150_000  # matches of 1-3


def rows_of(view: int) -> list[Row]:
    """One pair: share within 3 pixels, and how many there are."""
    from match_views import load, mapped

    one, two, h = load(DATA / "homography/graf", view)
    grown = pf.match_quasi_dense(one, two)
    m = pf.filter_matches(grown, least=0, geometry="motion") if view == 3 else pf.filter_matches(grown)
    right = float(np.mean(np.linalg.norm(mapped(h, m.xy1) - m.xy2, axis=1) < 3)) if len(m) else 0.0
    rows = [at_least(f"match.graf_1_{view}_within_3px", right, BOUNDS[view])]
    if view == 3:
        rows.append(at_least("match.graf_1_3_matches", len(m), LEAST))
    return rows


def fountain_rows() -> list[Row]:
    """The worst of the five pairs, the photographs made a third as large."""
    from fountain import figures

    found = figures(DATA / "multiview/fountain-P11", (1024, 682))
    return [
        at_least("match.fountain_within_2px", min(f["within_2px"] for f in found), 0.95),
        at_least("match.fountain_coverage", min(f["coverage"] for f in found), 0.7),
    ]


def main() -> None:
    """All pairs."""
    if DATA.is_dir():
        print_rows([*(row for view in BOUNDS for row in rows_of(view)), *fountain_rows()])
    else:
        print(f"no {DATA}: nothing is measured", file=sys.stderr)
        print_rows([])


if __name__ == "__main__":
    main()
