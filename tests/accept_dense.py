"""A simulated DN400 through pipefishd, the emulated cable, `reconstruct` and `dense`, cell by cell beside the truth.

The drive is 0.9 m past a deposit of 3 mm and three cracks, of 2, 1 and 0.7 mm. Poses are the reconstruction's; the map
is laid onto the truth by one rigid motion, which the camera centres and directions tell, so that the error of scale
stays in.

    python tests/accept_dense.py

prints a table, then one JSON list of {name, value, bound, holds}. Pictures stay in build/accept/recon/dense-dn400.
"""

from __future__ import annotations

import json
import sys
from contextlib import redirect_stdout
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from accept_recon import FOLDER
from accept_recon_video import recorded
from accept_rows import at_least, at_most, exactly, kept, print_rows

from pipefish.cli import main as pipefish
from pipefish.demo import find_programs, survey_over_the_line
from pipefish.dense_files import strips_of
from pipefish.simulate import Scene
from pipefish.wall import Wall, read_wall

NAME = "dense-dn400"
CRACKS = [
    {"path": [{"s": 0.75, "phi": 0.5}, {"s": 1.15, "phi": 0.7}], "width": 0.002, "meander": 0.006, "seed": 51},
    {"path": [{"s": 0.9, "phi": -0.8}, {"s": 0.94, "phi": -2.0}], "width": 0.001, "meander": 0.004, "seed": 52},
    {"path": [{"s": 0.8, "phi": 1.6}, {"s": 1.1, "phi": 2.2}], "width": 0.0007, "meander": 0.004, "seed": 53},
]
DEPOSIT = {"s": 0.95, "clock": 3.14, "length": 0.06, "extent": 0.3, "height": 0.003}
SCENE: dict[str, Any] = {
    "diameter": 0.4,
    "pieces": [{"length": 2.4}],
    "deposits": [DEPOSIT],
    "cracks": CRACKS,
    "texture": {"seed": 45},
    "sensor": {"seed": 45},
    "motion": {"seed": 45, "frames": 80, "speed": 0.25, "ramp": 0.4},
    "telemetry": {"seed": 45},
}


def to_scene(wall: Wall, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motion (3,3), (3,) from the reconstruction's world to the scene's, by the poses of all keyframes."""
    frames = {k.index: k.message.frame_sequence for k in wall.survey.keyframes}
    true = np.array([scene.pose(int(frames[int(k)])) for k in wall.keyframe])
    turns = np.einsum("nji,njk->ik", true[:, :, :3], wall.poses[:, :, :3])
    u, _, vt = np.linalg.svd(turns)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    there, here = (-np.einsum("nji,nj->ni", p[:, :, :3], p[:, :, 3]) for p in (true, wall.poses))
    return turn, there.mean(axis=0) - turn @ here.mean(axis=0)


def true_radii(points: np.ndarray, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """(N,), (N,): distances from the axis of a straight pipe, and those of its wall there."""
    rings = np.array([[scene.wall(s, phi) for phi in (0.0, np.pi)] for s in (0.2, 2.2)]).mean(axis=1)
    along = (rings[1] - rings[0]) / np.linalg.norm(rings[1] - rings[0])
    up = scene.wall(0.2, 0.0) - rings[0]
    up /= np.linalg.norm(up)
    off = points - rings[0]
    s = off @ along
    across = off - s[:, None] * along
    phi = np.arctan2(across @ np.cross(along, up), across @ up)
    side = scene.wall(0.2, np.pi / 2) - rings[0]
    phi *= np.sign(side @ np.cross(along, up))
    wall = [np.linalg.norm(scene.wall(a + 0.2, f) - rings[0] - a * along) for a, f in zip(s, phi, strict=True)]
    return np.linalg.norm(across, axis=1), np.array(wall)


def figures() -> dict[str, float]:
    """What came out, lengths in millimetres."""
    recording = recorded(NAME, SCENE)
    scene = Scene.from_truth(recording.truth)
    folder = FOLDER / NAME
    survey = survey_over_the_line(find_programs(None), recording, folder / "run", True)
    for command in (
        ("reconstruct", survey["file"], "-o", folder / "out"),
        ("dense", folder / "out", "-o", folder / "map", "--scale", "1.5", "--threads", "2"),
    ):
        with redirect_stdout(sys.stderr):
            if pipefish([str(word) for word in command]) != 0:
                raise SystemExit(f"pipefish {command[0]} failed")
    turn, shift = to_scene(read_wall(folder / "out"), scene)
    found = np.load(folder / "map/dense.npz")
    measured = np.isfinite(found["deviation"])
    radius, true = true_radii(found["points"][measured] @ turn.T + shift, scene)
    error = radius - true
    # The fitted tube stands for the bare pipe: what the map tells beside it, the truth tells beside its own cylinder.
    beside = found["deviation"][measured] - (true - scene.spec["diameter"] / 2)
    document = json.loads((folder / "map/dense.json").read_text())
    return {
        "coverage": document["coverage"],
        "median_mm": 1000 * float(np.median(np.abs(error))),
        "p95_mm": 1000 * float(np.percentile(np.abs(error), 95)),
        "radius_p95_sigmas": float(np.percentile(np.abs(error) / found["sigma_radius"][measured], 95)),
        "deviation_p95_sigmas": float(np.percentile(np.abs(beside) / found["sigma"][measured], 95)),
        **deposit(document["regions"], folder, scene, turn, shift),
        **cracks(folder, scene, turn, shift),
    }


def deposit(
    regions: list[dict[str, Any]], folder: Path, scene: Scene, turn: np.ndarray, shift: np.ndarray
) -> dict[str, float]:
    """How many regions there are; of the largest the height in millimetres and in sigmas, and how far its middle is
    from the deposit's (all NaN without one: no bound holds)."""
    if not regions:
        return dict.fromkeys(("deposit_mm", "deposit_sigmas", "deposit_off_mm"), np.nan) | {"regions": 0.0}
    r = regions[0]
    strip = strips_of(read_wall(folder / "out").pieces)[r["piece"]]
    point = strip.wall.points(np.array([r["s"]]), np.array([r["clock"]])) @ turn.T + shift
    s, _, phi = scene.locate(point)[0]
    around = (phi - DEPOSIT["clock"] + np.pi) % (2 * np.pi) - np.pi
    return {
        "regions": float(len(regions)),
        "deposit_mm": -1000 * r["height"],
        "deposit_sigmas": -r["height"] / r["sigma"],
        "deposit_off_mm": 1000 * float(np.hypot(s - DEPOSIT["s"], around * scene.spec["diameter"] / 2)),
    }


def cracks(folder: Path, scene: Scene, turn: np.ndarray, shift: np.ndarray) -> dict[str, float]:
    """How many of the cracks were found (half of their way or more), how far the paths are from the true ones (median
    of the worst, millimetres), the worst error of a length, and how many others were told."""
    strips = strips_of(read_wall(folder / "out").pieces)
    truth = [e["path"] for e in scene.events() if e["kind"] == "crack"]
    true = [np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(np.array(path, float))]) for path in truth]
    radius = scene.spec["diameter"] / 2
    found: dict[int, list[tuple[float, float]]] = {k: [] for k in range(len(true))}
    others = 0
    for c in json.loads((folder / "map/dense.json").read_text())["cracks"]:
        strip = strips[c["piece"]]
        chainage, clock = np.array(c["path"]).T
        points = strip.wall.points(strip.sign * (chainage - strip.origin), clock) @ turn.T + shift
        place = scene.locate(points)
        off = []
        for path in true:
            around = (place[:, 2][:, None] - path[:, 1] + np.pi) % (2 * np.pi) - np.pi
            off.append(np.hypot(place[:, 0][:, None] - path[:, 0], radius * around).min(axis=1))
        nearest = int(np.argmin([np.median(o) for o in off]))
        if np.median(off[nearest]) < 0.005:
            found[nearest].append((c["length"], float(np.median(off[nearest]))))
        else:
            others += 1
    lengths = [np.hypot(*(np.diff(p, axis=0) * [1, radius]).T).sum() for p in true]
    share = [sum(a for a, _ in found[k]) / lengths[k] for k in found]
    return {
        "cracks_found": float(sum(s >= 0.5 for s in share)),
        "cracks_off_mm": 1000 * max((o for of in found.values() for _, o in of), default=0.0),
        "cracks_length_share": float(min(share)),
        "cracks_other": float(others),
    }


def main() -> int:
    """The rows."""
    f = kept(FOLDER, NAME, figures)
    print_rows(
        [
            at_most("dense.dn400_median_mm", f["median_mm"], 0.8),
            at_most("dense.dn400_p95_mm", f["p95_mm"], 3.0),
            at_least("dense.dn400_coverage", f["coverage"], 0.85),
            # What users read as 95 %: 1.96 sigma. Neighbouring cells share errors, so the percentile is itself good to
            # a few hundredths only.
            at_most("dense.dn400_radius_p95_sigmas", f["radius_p95_sigmas"], 1.96),
            at_most("dense.dn400_deviation_p95_sigmas", f["deviation_p95_sigmas"], 1.96),
            exactly("dense.dn400_regions", f["regions"], 1),
            at_most("dense.dn400_deposit_off_mm", f["deposit_off_mm"], 15.0),
            at_least("dense.dn400_deposit_mm", f["deposit_mm"], 2.0),
            at_most("dense.dn400_deposit_mm_most", f["deposit_mm"], 4.0),
            at_least("dense.dn400_deposit_sigmas", f["deposit_sigmas"], 3.0),
            at_least("dense.dn400_cracks_found", f["cracks_found"], 3),
            at_most("dense.dn400_cracks_off_mm", f["cracks_off_mm"], 3.0),
            at_most("dense.dn400_cracks_other", f["cracks_other"], 0),
        ]
    )
    print({k: round(v, 3) for k, v in f.items()}, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
