"""What the findings of a survey can hold at all, and what they cannot: a list of what was found looks complete, and
tracks see little of a wall. docs/reconstruction.md, "What the findings can show"."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pipefish.intervals import Z95
from pipefish.measured_texts import length_text
from pipefish.measurement import Measurement, mean_diameter
from pipefish.tube_patches import LEAST_HEIGHT, SURELY, TENTH

FEWEST = 9  # points whose median makes a patch, at the least: more than half of them have to stand out
JOINT_SIGMAS = 4.0  # by which the walls before and after a joint must differ: chi-squared of 16, at the least
UNSEEN = "cracks, open joints without a step, laterals and holes without tracked points in them, roots, infiltration, "
UNSEEN += "damage of the surface"


def reach(m: Measurement) -> dict[str, Any]:
    """The smallest that tracks of this survey could have told, in the unit of its scale: spacing of the points on the
    wall, patch_size (across) and patch_height of a deposit or recess, joint_step (None where no joint with a step was
    found, whose sigma it is of). Bounds: a patch that is little larger may still be missed."""
    d = mean_diameter(m)[0]
    tubes = [s.tube for s in m.measured]
    on = [t.points["piece"] >= 0 for t in tubes]
    # Neighbours that tell the same count once.
    each = [k.sum() / max(1.0, t.surface.correlation * t.surface.thinning) for t, k in zip(tubes, on, strict=True)]
    area = math.pi * d * sum(t.length for t in tubes) / max(1.0, sum(each))
    sigma = float(np.median(np.concatenate([t.points["sigma"][k] for t, k in zip(tubes, on, strict=True)])))
    own = TENTH + SURELY / math.sqrt(0.2 * FEWEST)
    steps = [e["step_sigma"] for t in tubes for e in t.events if e["kind"] == "joint" and e.get("step_sigma")]
    return {
        "spacing": math.sqrt(area),
        "patch_size": 2 * math.sqrt(area * (FEWEST + 1) / 2 / math.pi),
        "patch_height": LEAST_HEIGHT * d + own * sigma,
        "joint_step": JOINT_SIGMAS * float(np.median(steps)) if steps else None,
    }


def reach_text(found: dict[str, Any], unit: str) -> str:
    """The same in words, as `reach` made it, for the terminal and the report."""
    size, height, spacing = (length_text(found[k], unit) for k in ("patch_size", "patch_height", "spacing"))
    step = f" by some {length_text(found['joint_step'], unit)}" if found["joint_step"] else ""
    return (
        f"By tracked points, one every {spacing} of the wall: deposits and recesses over {size} across that stand out "
        f"by more than {height}, joints displaced{step} or kinked by 2°, bends from 2°. They do not show {UNSEEN}."
    )


def map_text(dense: dict[str, Any]) -> str:
    """What a dense map (a document of dense.json) adds, in words."""
    unit, cell = dense["unit"], dense["cell"]
    sigma = dense["sigma_median"]
    known = f", each to ± {length_text(Z95 * sigma, unit)} (median)" if sigma else ""
    return (
        f"By the dense map, a cell every {length_text(cell, unit)}{known}, on {100 * dense['coverage']:.0f} % of what "
        "two pairs of keyframes saw: smaller deposits and recesses, joint steps, cracks. Elsewhere only what tracks "
        "tell. Neither finds open joints without a step, roots, infiltration or what merely looks different."
    )
