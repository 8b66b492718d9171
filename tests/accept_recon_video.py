"""Rendered pipes through pipefishd, the emulated cable and `measure`: what comes out, beside the truth.

The camera is calibrated first, from a board's corners as the scene's own lens images them: what the simulator writes
as its profile is a central fit at one distance. The pictures stay in build/accept/recon/ (1 GB for 10 m) and are drawn
again only if the scene or what the simulator draws has changed: first and last frame are compared.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from accept_recon import FOLDER

from pipefish.camera import Camera
from pipefish.demo import Recording, find_programs, survey_over_the_line
from pipefish.errors import PipefishError
from pipefish.measure import measure
from pipefish.measured_files import write_measurement
from pipefish.measured_remarks import not_measured
from pipefish.measurement import Measurement
from pipefish.measuretruth import against_truth, bare, true_place
from pipefish.simcamera import calibrated
from pipefish.simulate import Scene, simulate
from pipefish.survey import Survey
from pipefish.tube_patches import LEAST_HEIGHT
from selfcal_drives import drifted

LEFT, UP_RIGHT = -math.pi / 2, 0.6
SCENES: dict[str, dict[str, Any]] = {
    "concrete": {
        "diameter": 0.3,
        "pieces": [{"length": 11.2}],
        "ovals": [{"start": 4.0, "end": 8.0, "ramp": 0.6, "ovality": 0.03, "clock": UP_RIGHT}],
        "texture": {"seed": 43},
        "sensor": {"seed": 43, "exposure_s": 0.0015},
        "motion": {"seed": 43, "frames": 1000},
        "telemetry": {"seed": 43},
    },
    "brick": {
        "diameter": 0.4,
        "pieces": [{"length": 2.4}, {"angle": math.radians(25), "radius": 1.2, "clock": LEFT}, {"length": 3.6}],
        "joints": [{"s": 1.6, "gap": 0.012, "step_down": 0.010, "step_right": 0.006}],
        "deposits": [{"s": 4.6, "length": 0.5, "extent": 1.4, "height": 0.025, "roughness": 0.001}],
        "texture": {"seed": 41, "material": "brick", "joint_spacing": 0},
        "sensor": {"seed": 41, "exposure_s": 0.002},
        "motion": {"seed": 41, "frames": 560},
        "telemetry": {"seed": 41},
    },
    "pvc": {
        "diameter": 0.3,
        "pieces": [{"length": 4.2}],
        "texture": {"seed": 47, "material": "pvc"},
        "sensor": {"seed": 47, "exposure_s": 0.002},
        "motion": {"seed": 47, "frames": 300},
        "telemetry": {"seed": 47},
    },
    # R13 of the specification: 250 frames of 1024 x 1024 at 20 mm a frame are 5 m, not 4; the wheel's scale is true,
    # each of its readings is off by 5 mm (one sigma).
    "tube": {
        "diameter": 0.4,
        "pieces": [{"length": 6.6}],
        "deposits": [{"s": 3.0, "length": 0.4, "extent": 1.2, "height": 0.012, "roughness": 0.001}],
        "texture": {"seed": 53},
        "lens": {"width": 1024, "height": 1024, "c_u": 513.2, "c_v": 509.6, "circle_radius": 505},
        "sensor": {"seed": 53, "exposure_s": 0.0015},
        "motion": {"seed": 53, "frames": 250, "speed": 0.4, "ramp": 0.0},
        "telemetry": {"seed": 53, "encoder_bias": 0.0, "encoder_noise": 10.0},
    },
}

Limits = tuple[str, float, float, float]  # name, value, low, high


def recorded(name: str, spec: dict[str, Any]) -> Recording:
    """The recording of the scene of that name, drawn if need be."""
    scene = Scene(spec)
    ends = [hashlib.sha256(scene.render(frame).tobytes()).hexdigest() for frame in (0, scene.frames - 1)]
    stem, stamp = FOLDER / name / "drive", FOLDER / name / "stamp.json"
    wanted = {"scene": scene.spec, "ends": ends}
    if not stamp.exists() or json.loads(stamp.read_text()) != json.loads(json.dumps(wanted)):
        stem.parent.mkdir(parents=True, exist_ok=True)
        stamp.unlink(missing_ok=True)
        simulate(spec, stem, quiet=True)
        stamp.write_text(json.dumps(wanted))
    return Recording.at(stem)


def size_error(found: float, true: float) -> float:
    """Of a size that may be off by 20 % or 2 mm, whichever is more: 1 at that limit."""
    return abs(found - true) / max(0.2 * true, 0.002)


def visible_size(scene: Scene, deposit: dict[str, Any]) -> tuple[float, float]:
    """Length and width of a heap that falls off to nothing: as far as it is as high as what counts as one."""
    pipe, share, size = bare(scene), np.linspace(-0.5, 0.5, 201), []
    for along, around in ((deposit["length"], 0.0), (0.0, deposit["extent"])):
        at = [(deposit["s"] + x * along, deposit["clock"] + x * around) for x in share]
        height = np.array([np.linalg.norm(scene.wall(*place) - pipe.wall(*place)) for place in at])
        high = share[height > LEAST_HEIGHT * scene.spec["diameter"]]
        size.append(float(high[-1] - high[0]) * (along or around * scene.spec["diameter"] / 2))
    return size[0], size[1]


def true_bends(scene: Scene) -> list[float]:
    """Where their middles are, along the axis."""
    pieces = scene.spec["pieces"]
    ends = np.cumsum([p["angle"] * p["radius"] if p["angle"] else p["length"] for p in pieces])
    return [float(e - p["angle"] * p["radius"] / 2) for e, p in zip(ends, pieces, strict=True) if p["angle"]]


def places(measured: Measurement, scene: Scene) -> list[Limits]:
    """Metres by which what was found lies beside the truth, along the pipe and around it; bends, which have no edge, in
    what their sigma allows them."""
    found: dict[str, list[tuple[float, dict[str, Any]]]] = {"bend": [], "joint": [], "deposit": []}
    for stretch in measured.measured:
        for event in stretch.tube.events:
            if event["kind"] in found:
                found[event["kind"]].append((true_place(measured, scene, stretch, event["s"]), event))
    rows: list[Limits] = []
    bends, joints, deposits = true_bends(scene), scene.spec["joints"], scene.spec["deposits"]
    if bends and len(found["bend"]) == len(bends):
        pairs = zip(found["bend"], bends, strict=True)
        worst = max(abs(s - true) / max(0.02, 2.5 * event["s_sigma"]) for (s, event), true in pairs)
        rows.append(("bend_place_off", worst, -math.inf, 1.0))
    if joints and len(found["joint"]) == len(joints):
        worst = max(abs(s - true["s"]) for (s, _), true in zip(found["joint"], joints, strict=True))
        rows.append(("joint_place_m", worst, -math.inf, 0.02))
    if len(deposits) == len(found["deposit"]) == 1:
        (s, event), true = found["deposit"][0], deposits[0]
        turn = (event["clock"] - true["clock"] + math.pi) % (2 * math.pi) - math.pi
        around = abs(turn) * scene.spec["diameter"] / 2
        rows.append(("deposit_place_m", math.hypot(s - true["s"], around), -math.inf, 0.02))
        rows.append(("deposit_clock_m", around, -math.inf, 0.02))
    return rows


def findings(measured: Measurement, scene: Scene) -> list[Limits]:
    """What was found where the scene has a bend, a joint, a deposit; what was found beside them."""
    events = [e for stretch in measured.measured for e in stretch.tube.events]
    rows: list[Limits] = []
    wanted = {"bend": 0, "joint": len(scene.spec["joints"]), "deposit": len(scene.spec["deposits"])}
    wanted["bend"] = sum(bool(p["angle"]) for p in scene.spec["pieces"])
    for kind, count in wanted.items():
        rows.append((f"{kind}s_found", sum(e["kind"] == kind for e in events), count, count))
    rows.append(("other_findings", sum(e["kind"] not in wanted for e in events), -math.inf, 0))
    for kind, sizes, truth in (
        ("joint", "step", [math.hypot(j["step_down"], j["step_right"]) for j in scene.spec["joints"]]),
        ("joint", "gap", [j["gap"] for j in scene.spec["joints"]]),
        ("deposit", "height", [d["height"] for d in scene.spec["deposits"]]),
        ("deposit", "length", [visible_size(scene, d)[0] for d in scene.spec["deposits"]]),
        ("deposit", "width", [visible_size(scene, d)[1] for d in scene.spec["deposits"]]),
    ):
        found = [e[sizes] or math.inf for e in events if e["kind"] == kind]
        if truth and len(found) == len(truth):
            worst = max(size_error(f, t) for f, t in zip(found, truth, strict=True))
            rows.append((f"{kind}_{sizes}_off", worst, -math.inf, 1.0))
    return rows + places(measured, scene)


def of_tube(truth: dict[str, Any]) -> list[Limits]:
    """R13: what the specification asks of diameter, length and coverage; a station and its interval beside it."""
    return [
        ("diameter_mean_pct", truth["diameter_mean_pct"], -0.5, 0.5),
        ("diameter_rms_pct", truth["diameter_rms_pct"], -math.inf, 0.5),
        ("diameter_held", truth["diameter_covered"], 0.9, math.inf),
        ("ovality_rms_points", truth["ovality_rms_points"], -math.inf, 0.3),
        ("length_pct", truth["length_pct"], -0.3, 0.3),
        ("share_measured", truth["stations_measured"] / truth["stations"], 0.9, math.inf),
    ]


def by_diameter(name: str, survey: Path, camera: Camera) -> list[Limits]:
    """What the check of the profile says beside the true diameter: of the right profile, and of one changed since. 1 %
    of the angle scale has to show where the pipe bends; in a straight one tracks' common errors hide it."""
    spec, found_by_bend = SCENES[name], (1, 1)
    if not any(p.get("angle") for p in spec["pieces"]):
        found_by_bend = (-math.inf, math.inf)
    rows: list[Limits] = []
    for change, limits in {"": (-math.inf, 0), "scale": found_by_bend, "centre": (1, 1)}.items():
        changed = drifted(camera, change)
        found = measure(Survey.open(survey), changed, diameter=spec["diameter"], pictures=False, threads=2).health
        assert found is not None
        word = f"by_diameter_{change or 'right'}"
        print(f"  {name}, {word}: {found.text}", file=sys.stderr)
        rows.append((f"{word}_drifted", float(found.verdict.startswith("drifted")), *limits))
        if change != "centre":
            value, sigma = found.changes["angle scale"]
            rows.append((f"{word}_scale_pct", value, -math.inf, math.inf))
            off = abs(value + (1.0 if change else 0.0)) / sigma
            rows.append((f"{word}_off_sigmas", off, -math.inf, 3.0))
    return rows


def without_pupil(camera: Camera) -> Camera:
    """The profile as a calibration without near views leaves it."""
    assert camera.covariance is not None
    kept = [i for i, parameter in enumerate(camera.covariance_parameters) if parameter != "pupil_e1"]
    names = tuple(camera.covariance_parameters[i] for i in kept)
    own = camera.covariance[np.ix_(kept, kept)]
    return dataclasses.replace(camera, pupil_e1=0.0, covariance=own, covariance_parameters=names)


def without_encoder(path: Path, scene: Scene, camera: Camera) -> list[Limits]:
    """The same survey with its encoder not read, the mean diameter given: by the profile, and by one that says nothing
    of its pupil."""
    rows: list[Limits] = []
    for word, profile in (("free", camera), ("free_pupil_unknown", without_pupil(camera))):
        survey = Survey.open(path)
        unread = np.full(len(survey.keyframes), np.nan)
        survey.chainage = lambda unread=unread: unread  # type: ignore[method-assign]
        measured = measure(survey, profile, diameter=scene.spec["diameter"], pictures=False, threads=2)
        truth = against_truth(measured, scene)
        assert truth is not None and measured.scale.diameter_from_prior
        share = truth["stations_measured"] / truth["stations"]
        rows += [
            (f"{word}_diameter_scatter_pct", truth["diameter_scatter_pct"], -math.inf, math.inf),
            (f"{word}_diameter_held", truth["diameter_covered"], 0.9, math.inf),
            (f"{word}_share_measured", share, 0.9, math.inf),
        ]
    return rows


def video_figures(name: str) -> list[Limits]:
    """Name, value and limits of what came out of one scene."""
    recording = recorded(name, SCENES[name])
    scene = Scene.from_truth(recording.truth)
    profile = recording.profile.with_name("calibrated.json")
    calibrated(scene).save(profile)
    recording.profile = profile
    began = time.monotonic()
    survey = survey_over_the_line(find_programs(None), recording, FOLDER / name / "run", True)
    try:
        measured = measure(Survey.open(Path(survey["file"])), threads=2)
        write_measurement(measured, FOLDER / name / "out")
    except PipefishError as error:
        return [(f"failed: {error}", 1, -math.inf, 0)]
    seconds = time.monotonic() - began
    truth = against_truth(measured, scene)
    if truth is None:
        return [("stations_measured", 0, 1, math.inf)]
    accused = [
        ("profile_called_drifted", float(measured.health.verdict.startswith("drifted")), -math.inf, 0),
        *by_diameter(name, Path(survey["file"]), Camera.load(profile)),
        *without_encoder(Path(survey["file"]), scene, Camera.load(profile)),
    ]
    if name == "tube":
        after = ("seconds_after_rendering", seconds, -math.inf, 180)
        return [*of_tube(truth), after, *accused, *findings(measured, scene)]
    if name == "pvc":  # hardly a corner: what is measured must hold its intervals, what is not must be said
        gaps = not_measured(measured)
        silent = truth["stations"] - truth["stations_measured"] if not gaps else 0
        return [
            ("stations_measured", truth["stations_measured"], 1, math.inf),
            ("diameter_rms_pct", truth["diameter_rms_pct"], -math.inf, math.inf),
            ("diameter_held", truth["diameter_covered"], 0.9, math.inf),
            ("stations_missing_in_silence", silent, -math.inf, 0),
            ("findings", sum(len(s.tube.events) for s in measured.measured), -math.inf, 0),
            *accused,
        ]
    rows: list[Limits] = [
        ("diameter_rms_pct", truth["diameter_rms_pct"], -math.inf, 0.5),
        ("diameter_scatter_pct", truth["diameter_scatter_pct"], -math.inf, math.inf),
        ("encoder_pct", truth["encoder_pct"], -math.inf, math.inf),
        ("diameter_held", truth["diameter_covered"], 0.9, math.inf),
        ("ovality_rms_points", truth["ovality_rms_points"], -math.inf, 0.3),
        ("ovality_held", truth["ovality_covered"], 0.9, math.inf),
        ("share_measured", truth["stations_measured"] / truth["stations"], 0.95, math.inf),
        *accused,
    ]
    if truth["bend_degrees"] is not None:
        rows.append(("bend_degrees", truth["bend_degrees"], -math.inf, 0.5))
        radii = [e["radius"] for s in measured.measured for e in s.tube.events if e["kind"] == "bend"]
        true = [p["radius"] for p in scene.spec["pieces"] if p["angle"]]
        worst = max(abs((f or math.inf) / t - 1) for f, t in zip(radii, true, strict=True))
        rows.append(("bend_radius_off", worst, -math.inf, 0.05))
    return rows + findings(measured, scene)
