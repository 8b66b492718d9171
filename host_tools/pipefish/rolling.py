"""What a survey says of a rolling shutter: the daemon's setting camera.line_time_us and the keyframes' times."""

from __future__ import annotations

import math

import numpy as np

from pipefish.errors import FormatError
from pipefish.structure import RollingShutter
from pipefish.survey import Survey

KEY = "camera.line_time_us"


def shutter_of(survey: Survey, line_time: float | None = None) -> RollingShutter | None:
    """The shutter, by keyframe; None for one that exposes all rows at once, or of which nothing is said.

    line_time  seconds from a row's exposure to the next one's [as the survey says]; 0: all at once

    Raises FormatError for a setting that is no number."""
    if line_time is None:
        line_time = 1e-6 * _stated(survey)
    if line_time == 0.0:
        return None
    # A device's clock is even, the host's idea of the time need not be; between starts there is only that.
    first: dict[object, int] = {}
    time = []
    for frame in survey.keyframes:
        offset = first.setdefault(frame.boot, frame.time_ns - frame.monotonic_ns)
        time.append(frame.monotonic_ns + offset)
    since = np.array(time, dtype=np.int64)
    return RollingShutter((since - since[:1]) * 1e-9, line_time)


def _stated(survey: Survey) -> float:
    """Microseconds, 0 where nothing is said."""
    for line in survey.start.config if survey.start else ():
        key, _, value = (part.strip() for part in line.partition("="))
        if key == KEY:
            try:
                stated = float(value)
            except ValueError:
                stated = math.nan
            if not math.isfinite(stated):
                raise FormatError(survey.path, KEY, f"not a number: {value!r}")
            return stated
    return 0.0
