"""How a measured pipe compares with the truth of a simulated one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pipefish.intervals import Z95
from pipefish.measured_files import stations
from pipefish.measurement import Measurement, Stretch
from pipefish.simulate import Scene

DIRECTIONS = np.arange(180) * math.pi / 180
FINDINGS = ("deposits", "holes", "cracks", "laterals", "roots", "water")  # lie on the pipe's wall, or lead out of it


def bare(scene: Scene) -> Scene:
    """The scene's pipe without what is found in it, joints' grooves filled: what its diameters are."""
    spec = {**scene.spec, **{name: [] for name in FINDINGS}}
    spec["joints"] = [{**joint, "depth": 0.0} for joint in spec["joints"]]
    spec["joint_series"] = {**spec["joint_series"], "depth": 0.0}
    return Scene(spec)


def true_section(scene: Scene, s: float) -> tuple[float, float, float]:
    """Perimeter / pi, widest and narrowest caliper width of the pipe at arc length s, metres, with all its reliefs."""
    y = scene.outline(s, 720)
    chords = np.linalg.norm(np.roll(y, -1, axis=0) - y, axis=1).sum()
    reach = y @ np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)])
    width = reach.max(axis=0) - reach.min(axis=0)
    return float(chords / math.pi), float(width.max()), float(width.min())


def against_truth(m: Measurement, scene: Scene) -> dict[str, Any] | None:
    """Figures of a survey of a simulated pipe, None where nothing has both a value and a truth.

    diameter_rms_pct, diameter_mean_pct, diameter_max_pct   d_mean of the stations against the truth, per cent
    diameter_scatter_pct     the same without the mean error
    ovality_rms_points       (max - min) / nominal, percentage points
    diameter_covered, ovality_covered   share of stations whose 95 % interval (systematic included) holds the truth
    length_pct               the camera's path between the first and the last keyframe of each stretch
    encoder_pct              the encoder over the same stretch: what the scale inherits
    bend_degrees             worst error of a bend's angle, None without a true or found bend

    Each station is put into the true world from the keyframe nearest to it, by that one's true pose: heading and scale
    drift along the path (a wheel of 0.5 % by 25 mm in 5 m), which is an error of the chainage and not of the section
    that was measured."""
    table = stations(m)
    frame_of = {k.index: k.message.frame_sequence for k in m.survey.keyframes}
    place = np.full(len(table["s"]), np.nan)
    length = driven = reading = 0.0
    for stretch in m.measured:
        here = np.flatnonzero(m.structure.segment == stretch.segment)
        frames = [frame_of[int(i)] for i in m.index[stretch.frames]]
        rows = np.flatnonzero(table["stretch"] == stretch.segment)
        axis = np.stack([table[k][rows] for k in "xyz"], -1)
        centres = m.structure.centres[here]
        place[rows] = _places(scene, axis, m.structure.poses[here], centres, frames)
        length += np.linalg.norm(np.diff(centres, axis=0), axis=1).sum()
        driven += np.linalg.norm(np.diff([scene.centre(f) for f in frames], axis=0), axis=1).sum()
        if m.encoder is not None:
            reading += np.abs(np.diff(m.encoder[stretch.frames])).sum()
    known = np.flatnonzero(np.isfinite(table["d_mean"]) & np.isfinite(place))
    if not len(known) or m.scale.unit != "metre":
        return None
    pipe = bare(scene)
    truth = np.array([true_section(pipe, float(s)) for s in place[known]])
    error = table["d_mean"][known] / truth[:, 0] - 1
    sigma = np.hypot(table["d_mean_sigma"], table["d_mean_systematic"])[known] / truth[:, 0]
    nominal = scene.spec["diameter"]
    true_oval = (truth[:, 1] - truth[:, 2]) / nominal
    oval = (table["d_max"] - table["d_min"])[known] / nominal
    with_oval = np.isfinite(oval)
    low, high = (table[k][known] * table["d_mean"][known] / nominal for k in ("ovality_lo", "ovality_hi"))
    inside = (low <= true_oval + 1e-9) & (true_oval <= high)
    out: dict[str, Any] = {
        "diameter_rms_pct": 100 * float(np.sqrt(np.mean(error**2))),
        "diameter_mean_pct": 100 * float(error.mean()),
        "diameter_scatter_pct": 100 * float(error.std()),
        "diameter_max_pct": 100 * float(np.abs(error).max()),
        "diameter_covered": float(np.mean(np.abs(error) <= Z95 * sigma)),
        "ovality_rms_points": None,
        "ovality_covered": None,
        "length_pct": 100 * (length / driven - 1),
        "encoder_pct": 100 * (reading / driven - 1) if reading else None,
        "bend_degrees": _bends(m, scene),
        "stations_measured": len(known),
        "stations": len(place),
    }
    if with_oval.any():
        out["ovality_rms_points"] = 100 * float(np.sqrt(np.mean((oval - true_oval)[with_oval] ** 2)))
        out["ovality_covered"] = float(np.mean(inside[with_oval]))
    return out


def true_place(m: Measurement, scene: Scene, stretch: Stretch, s: float) -> float:
    """True arc length of the place at s along a stretch's tube."""
    here = np.flatnonzero(m.structure.segment == stretch.segment)
    frame_of = {k.index: k.message.frame_sequence for k in m.survey.keyframes}
    frames = [frame_of[int(i)] for i in m.index[stretch.frames]]
    axis = stretch.tube.frames([s])["centre"]
    return float(_places(scene, axis, m.structure.poses[here], m.structure.centres[here], frames)[0])


def _places(scene: Scene, axis: np.ndarray, poses: np.ndarray, centres: np.ndarray, frames: list[int]) -> np.ndarray:
    """(n,) true arc lengths of points (n,3), each as the keyframe nearest to it has it before itself."""
    nearest = np.linalg.norm(axis[:, None] - centres, axis=2).argmin(axis=1)
    seen = np.einsum("nij,nj->ni", poses[nearest, :, :3], axis) + poses[nearest, :, 3]
    true = np.array([scene.pose(frame) for frame in frames])[nearest]
    return scene.locate(np.einsum("nji,nj->ni", true[:, :, :3], seen - true[:, :, 3]))[:, 0]


def _bends(m: Measurement, scene: Scene) -> float | None:
    """Degrees by which bends that were found, in their order, differ from the true ones."""
    true = [p["angle"] for p in scene.spec["pieces"] if p["angle"]]
    found = [e["angle"] for s in m.measured for e in s.tube.events if e["kind"] == "bend"]
    if not true or len(true) != len(found):
        return None
    return math.degrees(max(abs(a - b) for a, b in zip(true, found, strict=True)))
