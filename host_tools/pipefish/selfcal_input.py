"""Pairs of views for self-calibration: from pictures, files of matches, or a survey."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import ArgumentError, FormatError
from .matching import find_seeds
from .matching_files import numbers, read_grey
from .selfcal import Floats
from .survey import Survey

SURVEYS = (".mcap", ".mcap.partial")
MATCHES = (".npz", ".csv", ".txt")
MOST_MATCHES = 1500  # a pair: more say little more and take longer
SURVEY_PAIRS = 12
SURVEY_COMMON = 50  # tracks that two keyframes must have in common
ALL_PAIRS = 4  # pictures up to which every two of them are matched

Pair = tuple[Floats, Floats]


@dataclass(frozen=True)
class Input:
    """Pairs of views of one camera, picture size or None, and a name for each pair."""

    pairs: list[Pair]
    size: tuple[int, int] | None
    names: list[str]


def _thinned(one: Floats, two: Floats) -> Pair:
    step = -(-len(one) // MOST_MATCHES)
    return one[::step], two[::step]


def from_pictures(paths: Sequence[str], threads: int, tell: Callable[[int, int], None]) -> Input:
    """Every two of up to four pictures, of more each with the next two. Raises FormatError, OSError."""
    pictures = [read_grey(path) for path in paths]
    for path, picture in zip(paths, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise FormatError(
                path,
                None,
                f"{picture.shape[1]}x{picture.shape[0]}, the first is {pictures[0].shape[1]}x{pictures[0].shape[0]}: "
                "not of one camera",
            )
    every = itertools.combinations(range(len(paths)), 2)
    chosen = [(a, b) for a, b in every if len(paths) <= ALL_PAIRS or b - a <= 2]
    pairs = []
    for done, (a, b) in enumerate(chosen):
        tell(done, len(chosen))
        seeds = find_seeds(pictures[a], pictures[b], threads=threads)
        pairs.append((seeds.xy1, seeds.xy2))
    names = [f"{Path(paths[a]).name}, {Path(paths[b]).name}" for a, b in chosen]
    return Input(pairs, (pictures[0].shape[1], pictures[0].shape[0]), names)


def from_matches(path: str | os.PathLike[str]) -> Input:
    """matches.npz of `pipefish match`, or rows x1 y1 x2 y2 with perhaps more behind. One pair. Raises FormatError,
    OSError."""
    if str(path).lower().endswith(".npz"):
        try:
            with np.load(path, allow_pickle=False) as data:
                missing = {"xy1", "xy2"} - set(data.files)
                if missing:
                    raise FormatError(path, sorted(missing)[0], "missing")
                one, two = (np.asarray(data[key], dtype=np.float64) for key in ("xy1", "xy2"))
        except (ValueError, EOFError, OSError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise
            raise FormatError(path, None, f"not an .npz file of arrays: {error}") from None
        if one.ndim != 2 or one.shape[1:] != (2,) or one.shape != two.shape:
            raise FormatError(path, "xy1, xy2", f"shapes {one.shape} and {two.shape} are not both (n,2)")
    else:
        rows = numbers(path)
        for number, row in rows:
            if len(row) < 4:
                raise FormatError(path, f"line {number}", f"{len(row)} numbers; each row needs x1 y1 x2 y2")
        if not rows:
            raise FormatError(path, None, "no matches")
        values = np.array([row[:4] for _, row in rows])
        one, two = values[:, :2], values[:, 2:]
    return Input([_thinned(one, two)], None, [Path(path).name])


def from_survey(path: str | os.PathLike[str]) -> Input:
    """Keyframes far apart that have tracks in common, spread over the survey. Raises FormatError, OSError."""
    survey = Survey.open(Path(path))
    if not survey.keyframes:
        raise FormatError(path, None, "no keyframes")
    tracks = survey.tracks()
    frames = np.unique(tracks.frame)
    rows = [np.flatnonzero(tracks.frame == frame) for frame in frames]
    pairs: list[Pair] = []
    names: list[str] = []
    for a in range(len(frames)):
        for b in range(min(len(frames) - 1, a + 40), a, -1):
            _, one, two = np.intersect1d(
                tracks.track[rows[a]], tracks.track[rows[b]], assume_unique=True, return_indices=True
            )
            if len(one) >= SURVEY_COMMON:
                pairs.append((tracks.pixels[rows[a][one]], tracks.pixels[rows[b][two]]))
                names.append(f"keyframes {frames[a]}, {frames[b]}")
                break
    step = -(-len(pairs) // SURVEY_PAIRS) or 1
    frame = survey.keyframes[0]
    return Input(pairs[::step], (frame.width, frame.height), names[::step])


def read(paths: Sequence[str], threads: int, tell: Callable[[int, int], None]) -> Input:
    """What the files hold: pictures; or files of matches, a pair each; or one survey.

    Raises ArgumentError, FormatError, OSError."""
    lower = [path.lower() for path in paths]
    if any(name.endswith(SURVEYS) for name in lower):
        if len(paths) > 1:
            raise ArgumentError(f"{paths[1]}: a survey is given alone")
        return from_survey(paths[0])
    files = [name.endswith(MATCHES) for name in lower]
    if all(files):
        parts = [from_matches(path) for path in paths]
        return Input([p.pairs[0] for p in parts], None, [p.names[0] for p in parts])
    if any(files):
        raise ArgumentError(f"{paths[files.index(True)]}: pictures or files of matches, not both")
    if len(paths) < 2:
        raise ArgumentError(f"{paths[0]}: one picture; two views are the least")
    return from_pictures(paths, threads, tell)
