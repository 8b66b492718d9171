"""Tracks that lost their names: all broke off (the light failed, the device restarted), and the same wall was found
again under others. Where a stretch's points are in the next one's first frame says which belong together."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import numpy.typing as npt

from .camera import Camera
from .structure_gaps import ahead_of, fit_frame, in_unit_of

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

FEW = 15  # tracks in common: with more, their names are not what is missing
FARTHEST = 6  # frames from one stretch to the next: further off the start is too uncertain, and little wall is left
RADII = (30.0, 20.0, 12.0, 7.0, 4.0)  # px, within which points and tracks are taken for the same, from start to end
GATE_SIGMAS, GATE_LEAST = 4.0, 1.5  # of what is linked, px at least
SCALES = 1.015 ** np.arange(-20, 21)  # of a stretch without a unit against the one before, about the ratio of depths
SHARE, LEAST, OVER_CHANCE = 0.3, 15, 5.0  # of the rarer ones that must be found again; how many; times those by chance


def pairs_within(a: Floats, b: Floats, radius: float) -> tuple[Ints, Ints]:
    """Places in a (n,2) and b (m,2) of those that are each other's nearest, within a radius."""
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    nearest = apart.argmin(axis=0)
    there = np.arange(len(b))
    good = (apart.argmin(axis=1)[nearest] == there) & (apart[nearest, there] < radius)
    return nearest[good], there[good]


def in_picture(camera: Camera, points: Floats, pose: Floats) -> tuple[Ints, Floats]:
    """Places of the points (n,3) that a frame shows, and where."""
    uv, ok = camera.project(points @ pose[:, :3].T + pose[:, 3])
    inside = np.flatnonzero(ok & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1))
    return inside, uv[inside]


def enough(count: int, uv: Floats, pixels: Floats, gate: float, share: float = SHARE) -> bool:
    """Whether so many pairs within a gate are no chance: that finds a place in the picture as near to a point as points
    are dense."""
    area = np.pi * max(1.0, float(np.prod(2 * np.std(uv, axis=0))))
    chance = len(pixels) * (1 - np.exp(-len(uv) * np.pi * gate**2 / area))
    return count >= max(LEAST, share * min(len(uv), len(pixels)), OVER_CHANCE * chance)


def found_again(
    camera: Camera, points: Floats, pixels: Floats, pose: Floats, gate: float
) -> tuple[Ints, Ints, Floats] | None:
    """Places of points (n,3) and of what a frame shows (m,2) that belong together, and the frame's pose; None where
    that could be chance. pose: about where it was, (3,4)."""
    for radius in (*RADII, gate):
        inside, uv = in_picture(camera, points, pose)
        if min(len(inside), len(pixels)) < LEAST:
            return None
        a, b = pairs_within(uv, pixels, radius)
        if len(a) < LEAST:
            return None
        if radius > gate:
            pose = fit_frame(camera, points[inside[a]], pixels[b], pose, None, (radius / 3,)).pose
    return (inside[a], b, pose) if enough(len(a), uv, pixels, gate) else None


def _depth(part: dict[str, Any], frame: int, near: Ints) -> float:
    """Median distance of some points of a stretch from the optical axis of one of its frames."""
    pose = part["poses"][frame]
    seen = part["points"][near] @ pose[:, :3].T + pose[:, 3]
    return float(np.median(np.hypot(seen[:, 0], seen[:, 1])))


def seen_before(
    camera: Camera,
    before: dict[str, Any],
    after: dict[str, Any],
    near: Ints,
    pose: Floats,
    pixels: Floats,
    gate: float,
    ratio: float,
) -> tuple[Ints, Ints]:
    """Which of the points `near` of a stretch and of what the last frame before it showed (m,2) belong together: many a
    track of that frame was too young for a point. pose: of the first frame behind, in the world before; ratio: of their
    units, about."""
    own, last = after["poses"][0], before["poses"][-1]
    local = after["points"][near] @ own[:, :3].T + own[:, 3]
    scales = np.ones(1) if after["metric"] else SCALES * ratio
    best: tuple[Ints, Ints] = np.zeros(0, np.int64), np.zeros(0, np.int64)
    for scale in scales:
        inside, uv = in_picture(camera, (scale * local - pose[:, 3]) @ pose[:, :3], last)
        if min(len(inside), len(pixels)) < LEAST:
            continue
        a, b = pairs_within(uv, pixels, 2 * gate)
        # Many of these points come into the picture only now: half the share will do.
        if len(a) > len(best[0]) and enough(len(a), uv, pixels, 2 * gate, SHARE / 2):
            best = near[inside[a]], b
    return best


def linked(
    camera: Camera, found: dict[str, Any], frame: Ints, track: Ints, pixels: Floats, sigma: float, step: Floats | None
) -> Ints | None:
    """The tracks' numbers (n,) with those of a stretch that go on in the next one joined to these; None where none do.

    found: of the engine; frame, track (n,) ascending, pixels (n,2): all that was seen; sigma: of pixels; step: metres
    from each frame to the next, None where nobody counted."""
    used, out, gate = found["frames"].astype(np.int64), track.copy(), max(GATE_SIGMAS * sigma, GATE_LEAST)

    def join(name: int, other: int) -> None:
        # As they are called by now: a track may go on behind several breaks.
        name, other = (int(out[np.searchsorted(track, k)]) for k in (name, other))
        if not np.isin(frame[out == other], frame[out == name]).any():
            out[out == other] = name

    for a, b in itertools.pairwise(found["segments"]):
        last, first = a["first"] + len(a["poses"]) - 1, b["first"]
        at_last, at_first = np.flatnonzero(frame == used[last]), np.flatnonzero(frame == used[first])
        if first - last > FARTHEST or np.isin(track[at_first], track[at_last]).sum() > FEW:
            continue
        steps = float(first - last)
        if step is not None:
            driven, before = step[used[last] : used[first]].sum(), step[used[last - 1] : used[last]].sum()
            steps = float(driven / before) if np.isfinite(driven) and abs(before) > 1e-6 else steps
        near = np.flatnonzero(np.isin(a["tracks"], track[(frame >= used[max(last - 4, 0)]) & (frame <= used[last])]))
        lens = in_unit_of(camera, a)
        again = found_again(lens, a["points"][near], pixels[at_first], ahead_of(a, steps), gate)
        if again is None:
            continue
        old, new = near[again[0]], track[at_first[again[1]]]
        for k, other in zip(old, new, strict=True):
            join(int(a["tracks"][k]), int(other))
        young = at_last[~np.isin(track[at_last], a["tracks"][old])]
        first_seen = np.flatnonzero(np.isin(b["tracks"], track[at_first]))
        ratio = _depth(a, -1, near) / _depth(b, 0, first_seen) if len(first_seen) else 1.0
        ours, theirs = seen_before(lens, a, b, first_seen, again[2], pixels[young], gate, ratio)
        for k, item in zip(ours, young[theirs], strict=True):
            if b["tracks"][k] not in new:
                join(int(track[item]), int(b["tracks"][k]))
    return out if (out != track).any() else None
