"""`pipefish calibrate --device`: views from a device that runs, with guidance where to hold the target next.

The views are stills: frames as the camera gave them, one after the other as fast as they can be searched. The device's
survey stays on the device.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .calib_data import CalibrationError, View
from .calib_input import Target3D
from .calib_run import lit_around, one_radius
from .calib_verdict import verdict
from .calibration import calibrate
from .detect import detect_target
from .errors import PipefishError
from .stills import StillFolder, Stills, SurveyOver
from .terminal import printable, say
from .transport import Transport

Array = npt.NDArray[np.float64]

_COLUMNS, _ROWS = 8, 5  # cells of the picture on the terminal
_FIRST_MODEL = 6  # views before a camera is tried
_EVERY = 3  # views between trials; each takes about a second
_ENOUGH_VIEWS, _ENOUGH_SEEN = 15, 0.85  # views, share of the cells: then more tell little
_SAME = 0.02  # of the picture's width: a target that moved less says nothing new
_STILL = 0.003  # of the width, between two stills: 4 px of 1280 in half a second blur an exposure of 20 ms by 0.16 px
_UNSTEADY = "exposure or gain changes between the views: set camera.exposure to hold or fixed"
_PLACES = (("top", "middle", "bottom"), ("left", "middle", "right"))


@dataclasses.dataclass
class Guide:
    """What has been seen so far, and what is missing."""

    targets: list[Target3D]
    size: tuple[int, int] = (0, 0)
    views: list[View] = dataclasses.field(default_factory=list)
    names: list[str] = dataclasses.field(default_factory=list)
    advice: str = ""
    enough: bool = False
    seen: float = 0.0
    _last: list[View] = dataclasses.field(default_factory=list)  # of the picture before
    _brightest: npt.NDArray[np.uint8] | None = None  # of all pictures, by pixel

    def add(self, name: str, image: npt.NDArray[np.uint8]) -> str:
        """Takes a picture; -> one line about it."""
        self.size = self.size if self.views else (image.shape[1], image.shape[0])
        if self._brightest is None or self._brightest.shape != image.shape:
            self._brightest = image
        self._brightest = np.maximum(self._brightest, image)
        found = []
        reason = ""
        for board, target in enumerate(self.targets):
            assert target.target is not None
            sighting = detect_target(image, target.target)
            if sighting and len(sighting.ids) >= 4:
                found.append(View(target.points[sighting.ids], sighting.pixels, board, 0, name))
            else:
                reason = reason or sighting.reason
        before, self._last = self._last, found
        if not found:
            return f"{name}: {reason or 'no target'}"
        moved = [m for view in found for other in before if (m := self._moved(view, other)) is not None]
        if not moved or max(moved) > _STILL * self.size[0]:
            return f"{name}: hold the target still"
        if all(
            any((m := self._moved(v, o)) is not None and m < _SAME * self.size[0] for o in self.views) for v in found
        ):
            return f"{name}: seen; move the target to another place"
        self.views += found
        self.names.append(name)
        self._think()
        points = sum(len(v.pixels) for v in found)
        of = sum(len(t.points) for t in self.targets)
        return f"{name}: view {len(self.names)}, {points} of {of} points; {100 * self.seen:.0f} % seen; {self.advice}"

    @staticmethod
    def _moved(view: View, other: View) -> float | None:
        """By how many pixels the points that both show have moved, the median; None: fewer than four in common."""
        if view.board != other.board:
            return None
        key = {tuple(p): i for i, p in enumerate(np.round(view.board_xyz, 9))}
        pairs = [(key[t], j) for j, p in enumerate(np.round(other.board_xyz, 9)) if (t := tuple(p)) in key]
        if len(pairs) < 4:
            return None
        mine, theirs = (list(x) for x in zip(*pairs, strict=True))
        return float(np.median(np.linalg.norm(view.pixels[mine] - other.pixels[theirs], axis=1)))

    def cells(self) -> npt.NDArray[np.int64]:
        """Points seen in each cell of the picture, (rows, columns)."""
        pixels = np.concatenate([v.pixels for v in self.views]) if self.views else np.zeros((0, 2))
        place = (
            np.floor((pixels + 0.5) / self.size * [_COLUMNS, _ROWS]).astype(int) if len(pixels) else pixels.astype(int)
        )
        counts = np.zeros((_ROWS, _COLUMNS), dtype=np.int64)
        np.add.at(counts, (np.clip(place[:, 1], 0, _ROWS - 1), np.clip(place[:, 0], 0, _COLUMNS - 1)), 1)
        return counts

    def _think(self) -> None:
        """Where the next view should be, from a first camera where there is one, and whether it is enough."""
        cells = self.cells()
        count = len(self.names)
        if count < _FIRST_MODEL or (count - _FIRST_MODEL) % _EVERY:
            if count < _FIRST_MODEL or not self.advice:
                self.seen = float((cells > 0).mean())
                row, column = np.unravel_index(int(np.argmin(cells)), cells.shape)
                self.advice = f"next: {self._place((column + 0.5) / _COLUMNS, (row + 0.5) / _ROWS)}, tilted"
            return
        try:
            lit = None if self._brightest is None else lit_around(self._brightest, self.views)
            radius = one_radius(self.targets)
            result = calibrate(self.views, self.size, "p9", circle_radius=radius, image_circle=lit)
            report = result.report
        except CalibrationError as error:
            self.advice = f"next: another place, tilted another way ({error})"
            return
        coverage = report["cameras"][0]["coverage"]
        place = coverage["next_view"]
        self.seen = float(coverage["share_covered"])
        if place is not None:
            u, v = np.array(place["pixel"]) / self.size
            off = math.degrees(place["theta"])
            self.advice = f"next: {self._place(u, v)}, {off:.0f} degrees off the axis, tilted"
        covered = result.camera.theta_covered or 0.0
        self.enough = count >= _ENOUGH_VIEWS and self.seen >= _ENOUGH_SEEN and verdict(report, None, covered)["usable"]

    @staticmethod
    def _place(u: float, v: float) -> str:
        down, across = (names[min(2, max(0, int(3 * x)))] for names, x in zip(_PLACES, (v, u), strict=True))
        return "the middle of the picture" if down == across == "middle" else f"{down} {across} of the picture"

    def map_text(self) -> str:
        """The picture's cells as text: empty, few, some, many points."""
        return "\n".join("".join(" .:#"[min(3, int(math.log(1 + n, 4)))] * 2 for n in row) for row in self.cells())


def collect(
    transport: Transport,
    targets: list[Target3D],
    folder: Path,
    *,
    most: int = 60,
    timeout_s: float = 30.0,
    quiet: bool = False,
) -> dict[str, Any]:
    """Takes stills until they suffice, there are `most` views, the survey ends, or Ctrl-C; those with a new view of the
    target are kept in `folder`, which must be new. -> folder, views, ended, seen, exposures: how many settings of
    exposure and gain the views have; more than one is warned of, as the views' blur and noise then differ.

    Raises PipefishError, also where fewer than three views came; the folder stays."""
    if any(t.target is None for t in targets):
        raise PipefishError("--device needs a target that can be found: a JSON file of `pipefish target`")
    kept = StillFolder(folder)
    guide = Guide(targets)
    screen = Screen(quiet)
    exposures: set[tuple[int, float]] = set()
    try:
        with Stills(transport, timeout_s) as stills:
            while not guide.enough and len(guide.names) < most:
                still = stills.take()
                count = len(guide.names)
                line = guide.add(f"frame {still.sequence}", still.image)
                if len(guide.names) > count:
                    kept.add(still)
                    exposures.add((still.telemetry.exposure_us, still.telemetry.gain))
                    if len(exposures) > 1:
                        line += f"; {_UNSTEADY}"
                screen.show(line, guide)
        ended = "enough has been seen" if guide.enough else f"{most} views"
    except KeyboardInterrupt:
        ended = "stopped by Ctrl-C"
    except SurveyOver as error:
        ended = str(error)
    except PipefishError as error:
        if len(guide.names) < 3:
            raise
        ended = str(error)
    finally:
        screen.close()
    if len(guide.names) < 3:
        raise PipefishError(
            f"{len(guide.names)} views with the target came from the device ({ended}); at least 3 are needed"
        )
    return {
        "folder": str(folder),
        "views": len(guide.names),
        "ended": ended,
        "seen": guide.seen,
        "exposures": len(exposures),
    }


class Screen:
    """Guidance on stderr: on a terminal a map of the picture that is drawn anew, else a line a view."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._live: Any = None
        self._said = ""
        if not quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), auto_refresh=False)
            self._live.start()

    def show(self, line: str, guide: Guide) -> None:
        """One picture's line, and the map."""
        if self._live is not None:
            from rich.panel import Panel
            from rich.text import Text

            told = printable(line, sys.stderr.encoding)
            body = Text(guide.map_text() + f"\n\n{told}\nCtrl-C: calibrate with what has been seen")
            self._live.update(Panel.fit(body, title="seen in the picture"), refresh=True)
        elif not self._quiet and line.partition(": ")[2] != self._said:
            self._said = line.partition(": ")[2]
            say(line)

    def close(self) -> None:
        """Leaves the last map standing."""
        if self._live is not None:
            self._live.stop()
