"""The states of the scene and the fates of tracks that a device reports (pipefish.v1.Tracking), in words."""

from __future__ import annotations

from pipefish import pipefish_pb2 as pb

# Fields of pipefish.v1.Tracking and how people call them.
STATES = [
    ("standing", "standing still"),
    ("reversing", "reversing"),
    ("dark", "dark"),
    ("covered", "lens covered"),
    ("over_exposed", "over-exposed"),
    ("weak_texture", "weak texture"),
    ("encoder_contrary", "encoder contradicts the picture"),
]
REASONS = [
    ("lost_left", "left the picture"),
    ("lost_flat", "no texture"),
    ("lost_diverged", "did not settle"),
    ("lost_residual", "looks different"),
    ("lost_backward", "not found backwards"),
    ("lost_crowded", "ran into another"),
    ("lost_drift", "drifted from its template"),
    ("lost_masked", "masked"),
    ("lost_static", "stands still in the picture"),
    ("lost_saturated", "saturated"),
]


def states_of(tracking: pb.Tracking) -> list[str]:
    """The states in force, in words."""
    return [words for name, words in STATES if getattr(tracking, name)]


def frames_in(tracking: pb.Tracking) -> dict[str, int]:
    """Frames since the keyframe before (of a status: since the start) in each state, by its field's name; of a device
    that does not count them, `frames` for those in force in the last frame, at least 1."""
    if tracking.state_frames:
        counts = list(tracking.state_frames) + [0] * len(STATES)
        return {name: counts[i] for i, (name, _) in enumerate(STATES)}
    return {name: max(tracking.frames, 1) if getattr(tracking, name) else 0 for name, _ in STATES}


def losses_of(tracking: pb.Tracking) -> dict[str, int]:
    """Lost tracks by reason in words; reasons that did not occur are left out."""
    return {words: getattr(tracking, name) for name, words in REASONS if getattr(tracking, name)}
