"""Colours of track ages: one scale for Foxglove, pictures and the page."""

from __future__ import annotations

import numpy as np

# Ages run over several decades, so the scale is logarithmic: new tracks are violet, old ones yellow, lightness rising
# all the way (readable on grey pictures and for colour-blind people).
STOPS = np.array(
    [
        (112, 78, 236),
        (146, 58, 214),
        (182, 50, 180),
        (212, 64, 138),
        (232, 95, 98),
        (246, 138, 62),
        (253, 182, 45),
        (244, 236, 60),
    ],
    dtype=float,
)
AGE_MAX = 60  # frames; older tracks share the last colour. In a narrow pipe a point is in view for about 30.

QUALITY_LOW = 0.8  # the tracker's default limit: nothing less is reported


def age_position(age: np.ndarray) -> np.ndarray:
    """(N,) ages in frames -> (N,) positions on the scale, 0..1."""
    return np.clip(np.log1p(np.asarray(age, dtype=float)) / np.log1p(AGE_MAX), 0.0, 1.0)


def scale_colours(position: np.ndarray) -> np.ndarray:
    """(N,) positions 0..1 -> (N,3) uint8 RGB."""
    x = np.asarray(position, dtype=float) * (len(STOPS) - 1)
    return (
        np.stack([np.interp(x, np.arange(len(STOPS)), STOPS[:, c]) for c in range(3)], axis=-1).round().astype(np.uint8)
    )


def age_colours(age: np.ndarray) -> np.ndarray:
    """(N,) ages in frames -> (N,3) uint8 RGB."""
    return scale_colours(age_position(age))


def quality_position(quality: np.ndarray) -> np.ndarray:
    """(N,) similarities with the frame before -> (N,) positions on the scale: from QUALITY_LOW, least violet, to 1."""
    return np.clip((np.asarray(quality, dtype=float) - QUALITY_LOW) / (1 - QUALITY_LOW), 0.0, 1.0)


# Deviations: blue inside, grey on, orange outside; both ends equally far from grey in lightness.
DIVERGING = np.array([(28, 88, 168), (98, 152, 208), (206, 208, 210), (236, 154, 82), (188, 76, 16)], dtype=float)


def diverging(value: np.ndarray) -> np.ndarray:
    """(N,) values -1..1 -> (N,3) uint8 RGB."""
    x = (np.clip(np.asarray(value, dtype=float), -1, 1) + 1) / 2 * (len(DIVERGING) - 1)
    channels = [np.interp(x, np.arange(len(DIVERGING)), DIVERGING[:, c]) for c in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)
