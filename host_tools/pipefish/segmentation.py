"""Dense segmentation of two pictures into layers that move, bend and are lit each in its own way.

docs/segmentation.md explains method and limits; the work is C++ (engine/segment).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _engine
from .errors import ArgumentError
from .grouping import group_matches
from .matching import Matches, grey, match_quasi_dense

Floats32 = NDArray[np.float32]
LEAST = 30  # vertices of a group that a layer may start from


@dataclass(frozen=True, eq=False)
class Layer:
    """A surface that both pictures show. Attributes that end in 1 are of picture 1, H x W, those in 2 of picture 2.

    flow1          (H,W,2) where the layer has each pixel in picture 2; NaN where it cannot be: outside picture 2, where
                   the field folds, and far from all matches
    gain1, offset1 (H,W,C) colour in picture 1 = gain * colour in picture 2 + offset, of 0..1; C is 3, or 1 for grey
    warped1        (H,W,C) picture 2 brought here, relit
    area1          pixels with the layer's label
    sigma1         deviation of picture 1 from warped1 within the layer, of 1
    zncc1          mean correlation of the two within the layer
    folds1         pixels within reach of the layer where its field folds
    low_evidence1  share of its pixels that are the layer's for their neighbours' sake: less than a nat speaks for or
                   against it, as where there is no texture
    ambiguous1     share of its pixels whose place in picture 2 is another layer's
    groups         of group_matches it was made from
    claimed        how many matches of no group it took; each fourth was asked
    """

    flow1: Floats32
    flow2: Floats32
    gain1: Floats32
    gain2: Floats32
    offset1: Floats32
    offset2: Floats32
    warped1: Floats32
    warped2: Floats32
    area1: int
    area2: int
    sigma1: float
    sigma2: float
    zncc1: float
    zncc2: float
    folds1: int
    folds2: int
    low_evidence1: float
    low_evidence2: float
    ambiguous1: float
    ambiguous2: float
    groups: list[int]
    claimed: int


@dataclass(frozen=True)
class Motion:
    """How a layer as a whole moves from picture 1 to picture 2: its pixels' median displacement (pixels, to the right
    and down) and how far that is; and of the similarity that is nearest to its field the rotation (radians, clockwise)
    and the scale, about its middle. None of it tells how it bends: flow1 does."""

    right: float
    down: float
    distance: float
    rotation: float
    scale: float


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What segment_motion returns.

    labels1, labels2  (H,W) uint8: 0 is the background, what only one picture shows; k is layers[k - 1]
    layers            largest first
    status            "ok", or "no common motion": nothing that both pictures show was found
    trace             (step, energy in nats, layers) after each step; the energy never rises. At the steps "grid
                      halved" and "matches count less" it is defined anew, lower, and nothing else changes
    """

    labels1: NDArray[np.uint8]
    labels2: NDArray[np.uint8]
    layers: list[Layer]
    status: str
    trace: list[tuple[str, float, int]]

    def motion(self, label: int) -> Motion | None:
        """Of a layer by its label, from 1 on; None where no pixel of picture 1 has it."""
        flow = self.layers[label - 1].flow1
        y, x = np.nonzero((self.labels1 == label) & np.isfinite(flow).all(axis=2))
        if not len(x):
            return None
        shift = flow[y, x].astype(float) - np.stack([x, y], axis=1)
        right, down = np.median(shift, axis=0)
        here = x - x.mean() + 1j * (y - y.mean())
        there = here + shift @ [1, 1j]
        spread = np.vdot(here, here).real
        turn = np.vdot(here, there - there.mean()) / spread if spread > 0 else 1.0
        return Motion(float(right), float(down), float(np.hypot(right, down)), float(np.angle(turn)), float(abs(turn)))


def planes(image: ArrayLike, name: str) -> Floats32:
    """An image as (3,H,W), or (1,H,W) where it is grey, float32 of 0..1. Raises ArgumentError."""
    given = np.asarray(image)
    if given.ndim == 3 and given.shape[2] >= 3:
        return np.stack([grey(given[..., c], name) for c in range(3)])
    return grey(given, name)[None]


def segment_motion(
    image1: ArrayLike,
    image2: ArrayLike,
    m: Matches | None = None,
    *,
    layers: int = 12,
    rounds: int = 6,
    light: float = 200.0,
    threads: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Segmentation:
    """Finds what two pictures have in common, as layers: surfaces that move smoothly, deforming or not, each lit anew.
    Both pictures are segmented; neither needs a mask.

    image1, image2  (H,W) or (H,W,3), uint8, uint16 or floats of 0..1; colour helps
    m               of match_quasi_dense on these pictures; None: matched here
    layers          the most groups of matches to start from, 1 to 40
    rounds          of refinement at most, 1 to 20
    light           stiffness of the change of light over a layer: 200 lets shadows in; 1e6 makes it one gain and offset
    threads         do not change the result
    progress        called with the share that is done, 0 to 1

    Pictures with nothing in common are no error: see Segmentation.status. Raises ArgumentError.
    """
    one, two = planes(image1, "image1"), planes(image2, "image2")
    if len(one) != len(two):
        raise ArgumentError("image1 and image2: one is grey, the other has colour")
    for name, value, kind, low, high in (
        ("layers", layers, Integral, 1, 40),
        ("rounds", rounds, Integral, 1, 20),
        ("light", light, Real, 1e-3, 1e9),
        ("threads", threads, Integral, 1, 1024),
    ):
        if not isinstance(value, kind) or not low <= value <= high:
            number = "a whole number" if kind is Integral else "a number"
            raise ArgumentError(f"{name}: {value!r} is not {number} within {low:g} to {high:g}")
    if m is None:
        m = match_quasi_dense(image1, image2, threads=threads)
    if (m.shape1, m.shape2) != (one.shape[1:], two.shape[1:]):
        raise ArgumentError(f"m: of pictures {m.shape1} and {m.shape2}, not {one.shape[1:]} and {two.shape[1:]}")
    for xy, (height, width) in ((m.xy1, m.shape1), (m.xy2, m.shape2)):
        if ((xy < -0.5) | (xy > np.array([width - 0.5, height - 0.5]))).any():
            raise ArgumentError(f"m: matches that are not within {width}x{height} pixels")
    groups = group_matches(m, least=LEAST)
    options = _engine.SegmentOptions()
    options.layers, options.rounds, options.light, options.threads = layers, rounds, light, threads
    found: dict[str, Any] = _engine.segment(
        one,
        two,
        m.xy1,
        m.xy2,
        m.affine,
        m.zncc,
        groups.label,
        groups.triangles,
        groups.triangle_group,
        options,
        progress or (lambda share: None),
    )
    return Segmentation(
        labels1=found["labels1"],
        labels2=found["labels2"],
        layers=[Layer(**layer) for layer in found["layers"]],
        status="ok" if found["layers"] else "no common motion",
        trace=found["trace"],
    )
