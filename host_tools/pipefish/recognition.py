"""Recognition of specific objects: pictures of models against scenes, by grouped quasi-dense matches.

docs/recognition.md explains score and limits; the work on a pair is C++ (engine/group).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _engine
from .errors import ArgumentError
from .grouping import group_options
from .matching import grey
from .segmentation import planes

THRESHOLD = 0.05
MAX_PIXELS = 400_000
REGIONS = 3000  # of a picture, before orientations
LEAST = 6  # vertices of a group; whether it counts is a matter of how well they agree

Floats = NDArray[np.float64]


class ObjectModel:
    """An object to look for: its name and one or more pictures of it.

    views     (image, mask) pairs, or images: (H,W) or (H,W,3), uint8, uint16 or floats of 0..1; mask (H,W), not zero
              where the object is, or None for the whole picture
    labels    names of the views [view 1, ...]
    Pictures of more than `max_pixels`, of their mask's surroundings, are made smaller. Raises ArgumentError.
    """

    def __init__(
        self, name: str, views: Sequence[Any], labels: Sequence[str] | None = None, max_pixels: int = MAX_PIXELS
    ) -> None:
        self.name = name
        self.labels = [f"view {k + 1}" for k in range(len(views))] if labels is None else list(labels)
        if not views:
            raise ArgumentError(f"{name}: no views")
        if len(self.labels) != len(views):
            raise ArgumentError(f"{name}: {len(self.labels)} labels of {len(views)} views")
        self._views = [
            _prepare(*(view if isinstance(view, tuple) else (view, None)), f"{name}, {label}", max_pixels)
            for view, label in zip(views, self.labels, strict=True)
        ]

    def __len__(self) -> int:
        return len(self._views)


def _prepare(image: ArrayLike, mask: ArrayLike | None, name: str, max_pixels: int) -> _engine.Prepared:
    if not 10_000 <= max_pixels <= 16_000_000:
        raise ArgumentError(f"max_pixels: {max_pixels} is not within 10,000 to 16,000,000")
    picture = grey(image, name)
    marked = None
    if mask is not None:
        given = np.asarray(mask)
        if given.shape != picture.shape:
            raise ArgumentError(f"{name}: the mask's shape {given.shape} is not that of the picture {picture.shape}")
        marked = np.where(given != 0, 255, 0).astype(np.uint8)
    try:
        return _engine.Prepared(picture, marked, max_pixels, REGIONS)
    except ValueError as error:
        raise ArgumentError(f"{name}: {error}") from None


@dataclass(frozen=True, eq=False)
class Segment:
    """A surface of the model found in the scene.

    score           area * coverage * correlation, at most 1
    area            of the segment in the model's picture, as a share of the model
    coverage        share of its textured pixels that are matched, counted in the coarser picture
    correlation     mean of (zncc - 0.5) / 0.5
    evidence        that its neighbours agree by more than chance: calibrated, from 6 on it counts in full
    matches         pixels
    centre          x, y of its middle in the scene
    view            label of the model's picture
    model_contours, scene_contours  outer boundaries, (N,2) each, in pixels of the pictures given
    """

    score: float
    area: float
    coverage: float
    correlation: float
    evidence: float
    matches: int
    centre: tuple[float, float]
    view: str
    model_contours: list[Floats]
    scene_contours: list[Floats]


@dataclass(frozen=True, eq=False)
class Recognition:
    """One object in one scene.

    object, scene  name and index
    score          0 to 1: share of the model that is found, weighted by coverage, correlation and, where that is
                   below 6, evidence, by its best view; without segments at most 0.002
    sum_score      the sum over the views
    present        whether there are segments and score is at least the threshold
    view           label of the best view: of those with segments, if there are any
    segments       of the best view, and of others whose segments' scores together are at least the threshold, as far as
                   they are where the best view's best segment has the object; best first
    extent         outline of the whole model, (N,2) each, carried into the scene by the affine map that fits the
                   matches of the view that has most of them: where all of the object would be, hidden parts too
    outline        (N,2) each: what is seen of a present object, its bare parts too: the extent, settled by the
                   scene's colours and edges. Empty where the object is not present
    seeds, matches of the best view by each: what a decision without growth or without groups would go by
    """

    object: str
    scene: int
    score: float
    sum_score: float
    present: bool
    view: str
    segments: list[Segment]
    extent: list[Floats]
    outline: list[Floats]
    seeds: int
    matches: int

    def mask(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """(H,W) of the scene: where the object is, by its outline; without one, where it was matched."""
        return _filled(self.outline, shape) if self.outline else self.matched(shape)

    def matched(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """(H,W) of the scene: where the object's surface was matched."""
        return _filled([line for segment in self.segments for line in segment.scene_contours], shape)

    def contours(self, shape: tuple[int, int]) -> list[Floats]:
        """Outer boundaries of mask(shape), (N,2) each, largest first."""
        return _engine.mask_outlines(self.mask(shape).astype(np.uint8))

    def box(self) -> tuple[float, float, float, float] | None:
        """Around the outline, or what was matched: least x and y, largest x and y. None where nothing was found."""
        points = self.outline or [line for segment in self.segments for line in segment.scene_contours]
        if not points:
            return None
        xy = np.concatenate(points)
        return (*map(float, xy.min(axis=0)), *map(float, xy.max(axis=0)))  # type: ignore[return-value]


def _filled(lines: Sequence[Floats], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(H,W): inside one of the lines."""
    from PIL import Image, ImageDraw

    picture = Image.new("1", (shape[1], shape[0]))
    draw = ImageDraw.Draw(picture)
    for line in lines:
        draw.polygon([tuple(p) for p in line], fill=1)
    return np.asarray(picture)


def _outlined(found: list[Recognition], scene: ArrayLike, pool: ThreadPoolExecutor) -> list[Recognition]:
    """The recognitions of one scene, those that are present with their outlines."""
    here = [k for k, r in enumerate(found) if r.present]
    if not here:
        return found
    colours = planes(scene, "scene")
    if all(np.array_equal(colours[0], plane) for plane in colours[1:]):
        colours = colours[:1]
    shape = colours.shape[1:]
    matched = {k: found[k].matched(shape) for k in here}

    def outline(k: int) -> list[Floats]:
        others = np.zeros(shape, bool)
        for j in here:
            if j != k:
                others |= matched[j]
        expected = _filled(found[k].extent, shape)
        marks = (255 * m.astype(np.uint8) for m in (expected, matched[k], others))
        return _engine.mask_outlines(_engine.silhouette(colours, *marks))

    out = list(found)
    for k, lines in zip(here, pool.map(outline, here), strict=True):
        out[k] = replace(found[k], outline=lines)
    return out


def recognise(
    models: Sequence[ObjectModel],
    scenes: Sequence[ArrayLike],
    *,
    threshold: float = THRESHOLD,
    zncc_min: float = 0.8,
    max_pixels: int = MAX_PIXELS,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[Recognition]:
    """Looks for each object in each scene; scene by scene, the objects in their order.

    threshold   score from which an object counts as present
    zncc_min    least correlation of a match, 0.3 to 0.99
    max_pixels  of a scene; larger ones are made smaller, contours are in the scene's own pixels
    threads     pairs at a time; they do not change the result
    progress    called with the number of pairs done and that of all
    Raises ArgumentError.
    """
    if not 0 <= threshold <= 1:
        raise ArgumentError(f"threshold: {threshold} is not within 0 to 1")
    if not 0.3 <= zncc_min <= 0.99:
        raise ArgumentError(f"zncc_min: {zncc_min} is not within 0.3 to 0.99")
    if threads < 1:
        raise ArgumentError(f"threads: {threads} is not at least 1")
    options = _engine.RecogniseOptions()
    options.zncc_min, options.grouping = zncc_min, group_options(least=LEAST)
    total = len(scenes) * sum(len(model) for model in models)
    done = 0
    out = []
    with ThreadPoolExecutor(threads) as pool:
        for index, scene in enumerate(_ahead(pool, scenes, max_pixels)):
            pairs = [view for model in models for view in model._views]
            found: list[dict[str, Any]] = []
            for result in pool.map(lambda view, at=scene: _engine.recognise(view, at, options), pairs):
                found.append(result)
                done += 1
                if progress is not None:
                    progress(done, total)
            start, combined = 0, []
            for model in models:
                combined.append(_combine(model, index, found[start : start + len(model)], threshold))
                start += len(model)
            out += _outlined(combined, scenes[index], pool)
    return out


def _ahead(pool: ThreadPoolExecutor, scenes: Sequence[ArrayLike], max_pixels: int) -> Iterator[_engine.Prepared]:
    """Scenes made ready, the next one while this one is looked at: all at once would take 20 MB each."""

    def ready(k: int) -> _engine.Prepared:
        return _prepare(scenes[k], None, f"scene {k + 1}", max_pixels)

    coming = pool.submit(ready, 0) if len(scenes) else None
    for k in range(len(scenes)):
        scene = coming.result()
        coming = pool.submit(ready, k + 1) if k + 1 < len(scenes) else None
        yield scene


def _combine(model: ObjectModel, scene: int, found: list[dict[str, Any]], threshold: float) -> Recognition:
    scores = np.array([f["score"] for f in found])
    best = max(range(len(found)), key=lambda k: (bool(found[k]["segments"]), scores[k]))
    x, y, radius = found[best]["place"]
    parts = [
        [s for s in f["segments"] if math.hypot(s["centre"][0] - x, s["centre"][1] - y) <= radius]
        if k == best or sum(s["score"] for s in f["segments"]) >= threshold
        else []
        for k, f in enumerate(found)
    ]
    segments = [Segment(**s, view=model.labels[k]) for k, own in enumerate(parts) for s in own]
    segments.sort(key=lambda s: (s.view != model.labels[best], -s.score))
    most = max(range(len(found)), key=lambda k: sum(s["matches"] for s in parts[k]))
    return Recognition(
        object=model.name,
        scene=scene,
        score=float(scores[best]),
        sum_score=float(scores.sum()),
        present=bool(found[best]["segments"] and scores[best] >= threshold),
        view=model.labels[best],
        segments=segments,
        extent=found[most]["extent"],
        outline=[],
        seeds=max(f["seeds"] for f in found),
        matches=max(f["matches"] for f in found),
    )
