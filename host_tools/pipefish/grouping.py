"""Groups of quasi-dense matches that move as one surface, and where they are in both images.

docs/recognition.md explains the method; the grouping itself is C++ (engine/group).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import _engine
from .errors import ArgumentError
from .matching import Matches

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Groups:
    """What group_matches returns: `count` groups, largest first.

    matches         that were grouped, K of them
    label           (K,) the group of each match, -1 for none
    triangles       (T,3) indices of matches: the triangles in which neighbours agree
    triangle_group  (T,) the group of each triangle
    """

    matches: Matches
    count: int
    label: NDArray[np.int64]
    triangles: NDArray[np.int64]
    triangle_group: NDArray[np.int64]

    def mask1(self, group: int, reach: float = 0) -> NDArray[np.bool_]:
        """(H,W) of image 1: where the group is, `reach` pixels beyond its outermost matches."""
        return self._support(group, 1, reach)[0]

    def mask2(self, group: int, reach: float = 0) -> NDArray[np.bool_]:
        """The same in image 2."""
        return self._support(group, 2, reach)[0]

    def contours1(self, group: int, reach: float = 0) -> list[Floats]:
        """(N,2) each: the outer boundaries of mask1, in pixels, largest first."""
        return self._support(group, 1, reach)[1]

    def contours2(self, group: int, reach: float = 0) -> list[Floats]:
        """The same in image 2."""
        return self._support(group, 2, reach)[1]

    def _support(self, group: int, image: int, reach: float) -> tuple[NDArray[np.bool_], list[Floats]]:
        if not 0 <= group < self.count:
            raise ArgumentError(f"group: {group} is not within 0 to {self.count - 1}")
        if not 0 <= reach <= 50:
            raise ArgumentError(f"reach: {reach} is not within 0 to 50")
        xy, shape = (self.matches.xy1, self.matches.shape1) if image == 1 else (self.matches.xy2, self.matches.shape2)
        mask, lines = _engine.group_support(xy, self.triangles, self.triangle_group, group, *shape, reach)
        return mask > 0, lines


def group_options(
    cell: int = 5, agree_px: float = 1.0, agree_share: float = 0.2, least: int = 60
) -> _engine.GroupOptions:
    """The engine's options, checked; group_matches says what they mean."""
    if not 1 <= cell <= 50:
        raise ArgumentError(f"cell: {cell} is not within 1 to 50")
    if not 0 < agree_px <= 50:
        raise ArgumentError(f"agree_px: {agree_px} is not within 0 to 50")
    if not 0 <= agree_share <= 1:
        raise ArgumentError(f"agree_share: {agree_share} is not within 0 to 1")
    if least < 3:
        raise ArgumentError(f"least: {least} is not at least 3")
    options = _engine.GroupOptions()
    options.cell, options.absolute, options.relative, options.least = cell, agree_px, agree_share, least
    return options


def group_matches(
    m: Matches, *, cell: int = 5, agree_px: float = 1.0, agree_share: float = 0.2, least: int = 60
) -> Groups:
    """Groups matches: the best of each cell is a vertex of a Delaunay triangulation of image 1; triangles whose corners
    lie, in both images, where each other's affine maps have them are joined over common edges. Wrong matches among
    right ones are taken out first. Surfaces that move differently come apart; a bent one stays whole.

    m            of match_quasi_dense, adaptive for anything but planes
    cell         pixels a side, of image 1
    agree_px     how far from its place by the map a neighbour may lie: pixels of the coarser image ...
    agree_share  ... and a share of its distance
    least        vertices of a group: 60 are about 1500 pixels

    Raises ArgumentError."""
    if not all(np.isfinite(a).all() for a in (m.xy1, m.xy2, m.affine, m.zncc)):
        raise ArgumentError("m: places, affine maps or correlations that are no finite numbers")
    options = group_options(cell, agree_px, agree_share, least)
    label, triangles, of = _engine.group_matches(m.xy1, m.xy2, m.affine, m.zncc, options)
    return Groups(m, int(of.max(initial=-1)) + 1, label, triangles, of)
