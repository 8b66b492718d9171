"""Matching over wide baselines: graf 1-3 to 1-6 against the homography of the wall, by the command's default filters
and by `--filter motion`, one rule for all four; unrelated pictures; the narrow baseline and graf 1-3's time beside
OpenCV's (bench/room_match.py); and fountain-P11's neighbours (python/fountain.py).

That homography is the wall's alone: matches on the strip below the kerb, another plane, count as wrong.

    python tests/accept_match.py

prints a table, then one JSON list of {name, value, bound, holds}. Needs $PIPEFISH_DATA or ../shared/data.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is loaded: times are those of one thread

import numpy as np
from accept_rows import Row, at_least, at_most, print_rows
from PIL import Image

import pipefish as pf

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests/bench"), str(ROOT / "tests/python")]
DATA = Path(os.environ.get("PIPEFISH_DATA") or ROOT.parent / "shared" / "data")
BOUNDS = {3: 0.9, 4: 0.8, 5: 0.7, 6: 0.7}  # of the matches within 3 pixels
LEAST = 150_000  # matches of 1-3
SECONDS = 4.0  # of 1-3, seeds and filter included
UNRELATED = (("graf", 1, "wall", 1), ("graf", 1, "boat", 1), ("boat", 2, "graf", 4), ("wall", 3, "boat", 4))


def graf_rows(view: int) -> list[Row]:
    """One pair: share within 3 pixels, by either filter, and how many there are."""
    from match_views import load, mapped

    one, two, h = load(DATA / "homography/graf", view)
    grown = pf.match_quasi_dense(one, two)

    def right(m: pf.Matches) -> float:
        return float(np.mean(np.linalg.norm(mapped(h, m.xy1) - m.xy2, axis=1) < 3)) if len(m) else 0.0

    default, motion = pf.filter_matches(grown, geometry="rigid"), pf.filter_matches(grown, least=0, geometry="motion")
    rows = [at_least(f"match.graf_1_{view}_within_3px", right(default), BOUNDS[view])]
    if view == 3:
        rows.append(at_least("match.graf_1_3_matches", len(default), LEAST))
    rows.append(at_least(f"match.graf_1_{view}_motion_within_3px", right(motion), BOUNDS[view]))
    return rows


def unrelated_row() -> Row:
    """What the default filters leave between pictures of different things; islands grow there from wrong seeds."""
    left = 0
    for first, j, second, k in UNRELATED:
        one, two = (
            np.asarray(Image.open(DATA / f"homography/{name}/img{number}.png").convert("L"))
            for name, number in ((first, j), (second, k))
        )
        left += len(pf.filter_matches(pf.match_quasi_dense(one, two), geometry="rigid"))
    return at_most("match.unrelated_left", left, 0)


def timed_rows() -> list[Row]:
    """The narrow baseline against OpenCV's matcher, where it is; graf 1-3's time."""
    from room_match import measure

    figures = {f["name"]: f for f in measure()}
    rows = [at_most("match.graf_1_3_seconds", figures["match.graf13_filtered"]["value"], SECONDS)]
    if "peer_value" in figures["match.narrow"]:
        ratio = {name: f["value"] / f["peer_value"] for name, f in figures.items() if "peer_value" in f}
        rows.append(at_least("match.narrow_matches_of_opencv", ratio["match.narrow_matches"], 0.8))
        rows.append(at_least("match.narrow_within_1px_of_opencv", ratio["match.narrow_within_1px"], 1.0))
        rows.append(at_most("match.narrow_time_of_opencv", ratio["match.narrow"], 0.5))
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
        rows = [row for view in BOUNDS for row in graf_rows(view)]
        print_rows([*rows, unrelated_row(), *timed_rows(), *fountain_rows()])
    else:
        print(f"no {DATA}: nothing is measured", file=sys.stderr)
        print_rows([])


if __name__ == "__main__":
    main()
