"""Pairs of views for self-calibration: from pictures, files of matches, or a survey."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .errors import ArgumentError, FormatError
from .matching import find_seeds, grey, halved, match_quasi_dense
from .matching_files import numbers, read_grey
from .selfcal import SIGMA_LEAST, Floats
from .survey import Survey

SURVEYS = (".mcap", ".mcap.partial")
MATCHES = (".npz", ".csv", ".txt")
MOST_MATCHES = 2000  # a pair: more say little more and take longer
DENSE_PIXELS = 2_000_000  # larger pictures are halved before they are matched: four times as fast, a tenth less sharp
SURVEY_PAIRS = 24
# Pixels: a tracker's errors are common to neighbours (readings.TRACK_FLOOR_PX), and a dense matcher's may be; residuals
# show 0.06 and 0.2. By 0.06 bearings from a survey were wrong by a degree. For pictures it is caution: fountain-P11's
# triples are then right to 0.9 of their sigmas, and to 1.2 with 0.2.
COMMON_SIGMA = 0.5
SURVEY_COMMON = 50  # tracks that two keyframes must have in common
ALL_PAIRS = 4  # pictures up to which every two of them are matched

Pair = tuple[Floats, Floats]


@dataclass(frozen=True)
class Input:
    """Pairs of views of one camera, picture size or None, a name for each pair, the least sigma of a match."""

    pairs: list[Pair]
    size: tuple[int, int] | None
    names: list[str]
    sigma_least: float = SIGMA_LEAST
    views: list[tuple[int, int]] | None = None  #: which two each pair is of, where that is known


def _thinned(one: Floats, two: Floats) -> Pair:
    step = -(-len(one) // MOST_MATCHES)
    return one[::step], two[::step]


def match_pictures(one: Any, two: Any, threads: int = 1) -> Pair:
    """Matches of two pictures of one size for self-calibration: quasi-dense ones, the best correlated of each of about
    MOST_MATCHES squares, which spreads them evenly and keeps their errors apart; the seeds where nothing grows.

    Seeds alone are a half as many and three quarters less sharp: they come of pictures a quarter as large (0.44 px
    against 0.25 px in fountain-P11's 3072 x 2048)."""
    pictures = [grey(one, "picture"), grey(two, "picture")]
    seeds = find_seeds(*pictures, threads=threads)
    area, times = pictures[0].size, 0
    while pictures[0].size > DENSE_PIXELS:
        pictures, times = [halved(p) for p in pictures], times + 1
    scale, shift = 2**times, (2**times - 1) / 2
    start = ((seeds.xy1 - shift) / scale, (seeds.xy2 - shift) / scale, seeds.affine)
    found = match_quasi_dense(*pictures, start, threads=threads)
    if found.status != "ok":
        return seeds.xy1, seeds.xy2
    first, second = (xy * scale + shift for xy in (found.xy1, found.xy2))
    cell = math.sqrt(area / MOST_MATCHES)
    square = np.floor(first / cell).astype(np.int64) @ [1 << 20, 1]
    order = np.lexsort((-found.zncc, square))
    best = order[np.diff(square[order], prepend=-1) != 0]
    return first[best], second[best]


def from_pictures(
    paths: Sequence[str], threads: int, tell: Callable[[int, int], None], size: tuple[int, int] | None = None
) -> Input:
    """Every two of up to four pictures, of more each with the next two. Raises ArgumentError where they are not of the
    size given, FormatError, OSError."""
    pictures = [read_grey(path) for path in paths]
    for path, picture in zip(paths, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise FormatError(
                path,
                None,
                f"{picture.shape[1]}x{picture.shape[0]}, the first is {pictures[0].shape[1]}x{pictures[0].shape[0]}: "
                "not of one camera",
            )
    found = (pictures[0].shape[1], pictures[0].shape[0])
    if size and tuple(size) != found:
        raise ArgumentError(f"--size: the pictures are {found[0]}x{found[1]}")
    every = itertools.combinations(range(len(paths)), 2)
    chosen = [(a, b) for a, b in every if len(paths) <= ALL_PAIRS or b - a <= 2]
    pairs = []
    for done, (a, b) in enumerate(chosen):
        tell(done, len(chosen))
        pairs.append(match_pictures(pictures[a], pictures[b], threads))
    names = [f"{Path(paths[a]).name}, {Path(paths[b]).name}" for a, b in chosen]
    return Input(pairs, found, names, COMMON_SIGMA, chosen)


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
            raise FormatError(path, None, "not an .npz file of arrays") from None
        if one.ndim != 2 or one.shape[1:] != (2,) or one.shape != two.shape:
            raise FormatError(path, "xy1, xy2", f"shapes {one.shape} and {two.shape} are not both (n,2)")
    else:
        rows = numbers(path)
        for number, row in rows:
            if len(row) < 4:
                raise FormatError(path, f"line {number}", f"{len(row)} numbers; each row needs x1 y1 x2 y2")
        if not rows:
            raise FormatError(path, None, "no matches: not a row of numbers x1 y1 x2 y2")
        values = np.array([row[:4] for _, row in rows])
        one, two = values[:, :2], values[:, 2:]
    return Input([_thinned(one, two)], None, [Path(path).name])


def from_survey(path: str | os.PathLike[str]) -> Input:
    """The pairs of keyframes, as far apart as they have tracks in common, between which the camera panned or tilted
    most, seen by the shift that their tracks share. Raises FormatError, OSError."""
    survey = Survey.open(Path(path))
    if not survey.keyframes:
        raise FormatError(path, None, "no keyframes")
    tracks = survey.tracks()
    frames = np.unique(tracks.frame)
    rows = [np.flatnonzero(tracks.frame == frame) for frame in frames]
    found: list[tuple[float, int, int, Pair]] = []
    for a in range(len(frames)):
        for b in range(min(len(frames) - 1, a + 40), a, -1):
            _, one, two = np.intersect1d(tracks.track[rows[a]], tracks.track[rows[b]], return_indices=True)
            if len(one) >= SURVEY_COMMON:
                pair = tracks.pixels[rows[a][one]], tracks.pixels[rows[b][two]]
                found.append((float(np.linalg.norm(np.median(pair[1] - pair[0], axis=0))), a, b, pair))
                break
    found.sort(key=lambda f: -f[0])
    frame = survey.keyframes[0]
    pairs = [pair for *_, pair in found[:SURVEY_PAIRS]]
    names = [f"keyframes {frames[a]}, {frames[b]}" for _, a, b, _ in found[:SURVEY_PAIRS]]
    return Input(
        pairs, (frame.width, frame.height), names, COMMON_SIGMA, [(a, b) for _, a, b, _ in found[:SURVEY_PAIRS]]
    )


def read(
    paths: Sequence[str], threads: int, tell: Callable[[int, int], None], size: tuple[int, int] | None = None
) -> Input:
    """What the files hold: pictures, of `size` if that is given; or files of matches, a pair each; or one survey.

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
        raise ArgumentError(
            f"{paths[0]}: alone; give two pictures or more, or a file of matches (.npz, .csv, .txt), or a survey "
            "(.mcap)"
        )
    return from_pictures(paths, threads, tell, size)
