"""A wall that looks the same again and again (bricks, corrugation): its tracks may have gone on to the next repeat.

Told from pictures: a patch of the wall, cut out of one keyframe, is looked for in the next one up and down the pipe.
Where the second best place is nearly as good as the best one, the picture cannot say which is right; where many places
are like that, encoder and pictures that disagree by whole repeats mean tracks that jumped."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pipefish.errors import FormatError
from pipefish.structure import Gap
from pipefish.survey import Tracks

if TYPE_CHECKING:
    from pipefish.measurement import Measurement, Stretch

Floats = npt.NDArray[np.float64]

PAIRS = 6  # of keyframes that are looked at
CELL = 1 / 120  # diameters: side of a cell of the wall
PATCH, PATCHES = 12, 20  # cells each way of a patch; around the pipe
NEAR, FAR = 0.15, 0.55  # diameters ahead of the eye where patches are: 73 to 42 degrees from the axis
REACH = 0.35  # diameters up and down in which they are looked for
PLAIN = 4.0  # grey levels: patches that vary less tell nothing
ALIKE, SHARE = 0.9, 0.3  # second best over best, in this share of the places: the alarm
FOUND = 0.6  # correlation that the best place must have
AROUND = 4  # steps each way that tell the direction of one
OFF, OFF_SIGMAS = 0.2, 4.0  # share of a repeat, and sigmas of a step, by which a jump may be no whole repeat


@dataclass
class Repetition:
    """share: of the places that look the same elsewhere; places: that were looked at; period: from one repeat to the
    next along the pipe, in the structure's unit, NaN where they do not agree about it."""

    share: float
    places: int
    period: float

    @property
    def alarm(self) -> bool:
        return self.places >= 2 * PATCHES and self.share > SHARE


def _sampled(picture: Floats, uv: Floats, ok: npt.NDArray[np.bool_]) -> Floats:
    """Grey of a picture at pixels (n,2), between four; NaN where not ok."""
    height, width = picture.shape
    x, y = (np.where(ok, uv[:, k], 0.0) for k in (0, 1))
    inside = ok & (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    i, j = (np.where(inside, v, 0).astype(int) for v in (y, x))
    a, b = np.where(inside, y, 0) - i, np.where(inside, x, 0) - j
    out = (1 - a) * ((1 - b) * picture[i, j] + b * picture[i, j + 1])
    out += a * ((1 - b) * picture[i + 1, j] + b * picture[i + 1, j + 1])
    return np.where(inside, out, np.nan)


def _correlation(patch: Floats, strip: Floats) -> Floats:
    """Of a patch (p,w) with each place of a strip (n,w) along it: (n-p+1,); NaN where the strip is not seen."""
    windows = np.lib.stride_tricks.sliding_window_view(strip, patch.shape)[:, 0]
    centred = windows - windows.mean(axis=(1, 2), keepdims=True)
    own = patch - patch.mean()
    spread = np.sqrt((centred**2).sum(axis=(1, 2)) * (own**2).sum())
    return np.where(spread > 0, (centred * own).sum(axis=(1, 2)) / np.maximum(spread, 1e-9), np.nan)


def second_best(found: Floats, at: int) -> tuple[float, int] | None:
    """How good the best other place is against the one at `at`, and how far away the nearest that is as good; None
    where that one is no good place. Other places are behind a dip of half the way to nothing."""
    around = found[max(0, at - 2) : at + 3]
    if not np.isfinite(around).all() or around.max() < FOUND:
        return None
    at = max(0, at - 2) + int(around.argmax())
    best, others = float(found[at]), []
    for step in (-1, 1):
        dipped, k = False, at + step
        while 0 < k < len(found) - 1 and np.isfinite(found[k]):
            dipped = dipped or found[k] < 0.5 * best
            if dipped and 0 < found[k] >= np.nanmax(found[k - 1 : k + 2]):
                others.append((float(found[k]), abs(k - at)))
            k += step
    if not others:
        return 0.0, 0
    top = max(value for value, _ in others)
    return top / best, min(away for value, away in others if value >= 0.95 * top)


def _pair(m: Measurement, stretch: Stretch, first: int, second: int, s: float) -> list[tuple[float, float]]:
    """Of patches ahead of s, from one keyframe to another: second best over best, and how far apart, metres."""
    d = stretch.tube.summary["d_mean"]
    cell = CELL * d
    along = s + np.arange(NEAR - REACH, FAR + REACH, CELL) * d
    clock = (np.arange(PATCHES)[:, None] * 2 * np.pi / PATCHES + np.arange(PATCH) * 2 * CELL).ravel()
    points = stretch.tube.evaluate(along, clock).reshape(-1, 3)
    strips = []
    for frame in (first, second):
        grey = np.asarray(m.survey.keyframes[int(m.structure.frames[frame])].image, float)
        if grey.shape != (m.camera.height, m.camera.width):
            return []
        pose = m.structure.poses[frame]
        uv, ok = m.structure.in_its_unit(m.camera, stretch.segment).project(points @ pose[:, :3].T + pose[:, 3])
        strips.append(_sampled(grey, uv, ok).reshape(len(along), PATCHES, PATCH))
    out, reach = [], round(REACH / CELL)
    for row in range(reach, len(along) - reach - PATCH, 2 * PATCH):
        for k in range(PATCHES):
            patch = strips[0][row : row + PATCH, k]
            if not np.isfinite(patch).all() or patch.std() < PLAIN:
                continue
            found = _correlation(patch, strips[1][row - reach : row + reach + PATCH, k])
            other = second_best(found, reach)
            if other is not None:
                out.append((other[0], other[1] * cell))
    return out


def repetition(m: Measurement) -> Repetition:
    """How often the wall looks the same elsewhere. Pictures of another size than the camera's, or damaged ones, are not
    looked at."""
    found: list[tuple[float, float]] = []
    for stretch in m.measured:
        place = np.flatnonzero(m.structure.segment == stretch.segment)
        s = stretch.tube.project(m.structure.centres[place])
        known = np.flatnonzero(s["piece"] >= 0)
        known = known[known + 1 < len(place)]
        for k in known[np.unique(np.linspace(0, len(known) - 1, min(PAIRS, len(known))).round().astype(int))]:
            try:
                found += _pair(m, stretch, int(place[k]), int(place[k] + 1), float(s["s"][k]))
            except (FormatError, OSError):
                continue
    if not found:
        return Repetition(0.0, 0, float("nan"))
    ratio, apart = np.array(found).T
    alike = ratio > ALIKE
    period = float(np.median(apart[alike])) if alike.any() else float("nan")
    agree = (np.abs(apart[alike] / period - np.round(apart[alike] / period)) < OFF).mean() if alike.any() else 0.0
    return Repetition(float(alike.mean()), len(found), period if agree > 0.7 else float("nan"))


def against_encoder(m: Measurement) -> Floats:
    """(F-1,) how much further pictures than encoder say each step of the structure's frames was, in its unit; NaN from
    one stretch to the next and where the encoder says nothing."""
    structure = m.structure
    centres, count = structure.centres, len(structure.frames)
    if m.encoder is None or m.scale.unit != "metre" or count < 2:
        return np.full(max(count - 1, 0), np.nan)
    # Along the path around: a jump may be longer than the step, and turn it round.
    low, high = np.maximum(np.arange(count - 1) - AROUND, 0), np.minimum(np.arange(count - 1) + 1 + AROUND, count - 1)
    ahead = centres[high] - centres[low]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1), 1e-12)[:, None]
    driven = np.diff(m.encoder[structure.frames])
    known = np.isfinite(driven) & (np.diff(structure.segment) == 0)
    way = np.sign(np.median(driven[known])) if known.any() else 1.0
    return np.where(known, np.einsum("ni,ni->n", np.diff(centres, axis=0), ahead) - driven * way, np.nan)


def jumps(m: Measurement, found: Repetition) -> list[int]:
    """Frames of the tracks from which on they are of the next repeat: pictures and encoder disagree about the step to
    them by a whole number of repeats, and by more than the encoder's noise."""
    apart, out = against_encoder(m), []
    known = np.flatnonzero(np.isfinite(apart))
    if not found.alarm or not np.isfinite(found.period) or not len(known):
        return []
    usual = 1.4826 * float(np.median(np.abs(apart[known])))
    for k in known:
        number = round(apart[k] / found.period)
        left = abs(apart[k] - number * found.period)
        if number and abs(apart[k]) > 2 * OFF_SIGMAS * usual and left < max(OFF * found.period, OFF_SIGMAS * usual):
            out.append(int(m.structure.frames[k + 1]))
    return out


def cut(tracks: Tracks, frames: list[int]) -> Tracks:
    """Tracks that end before each of those frames and go on under other names."""
    part = np.searchsorted(frames, tracks.frame, side="right")
    _, first, number = np.unique(tracks.track * (len(frames) + 1) + part, return_index=True, return_inverse=True)
    old = tracks.track[first]
    return dataclasses.replace(tracks, track=number, boot=tracks.boot[old], id=tracks.id[old])


def renamed(gaps: list[Gap], frames: list[int]) -> list[Gap]:
    """Gaps in which tracks were cut have that as their reason: the frame behind a cut may itself be lost."""
    return [
        dataclasses.replace(g, reason="repeated_pattern") if any(g.first < f <= g.last for f in frames) else g
        for g in gaps
    ]
