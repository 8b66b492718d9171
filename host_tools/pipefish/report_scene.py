"""The report's 3-D scene: the wall coloured by how far it is off, points, path of the camera, findings."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.cloudfile import read_columns
from pipefish.colours import DIVERGING
from pipefish.errors import FormatError
from pipefish.files import rounded
from pipefish.intervals import Z95
from pipefish.measured_files import COLOUR_SPAN, RING
from pipefish.measured_limits import LIMITS, whole_sigma
from pipefish.measured_texts import column, event_text
from pipefish.page import Chart
from pipefish.report_charts import Charts

MOST_RINGS, AROUND, MOST_POINTS = 360, 36, 6000  # a phone turns that
SCENE_LENGTH = 2.5  # of the scene's longest side, in Plotly's units
FULL_COLOUR = 3.0  # half widths of the interval that full colour is off, at least: noise is not shown as a finding
LABELLED = 0.2  # of the longest side: a shorter one has no numbers, there is no room
NAMED_APART = 0.07  # of the pipe's length: nearer findings are marked, but not both named


def read_rings(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of tube.ply, thinned: (N,AROUND,3) places, (N,AROUND) deviations, (N,) piece. Raises FormatError."""
    wall = read_columns(folder / "tube.ply")
    missing = {"x", "y", "z", "deviation", "piece"} - set(wall)
    if missing or len(wall["x"]) % RING:
        raise FormatError(folder / "tube.ply", "vertex", "not a wall that `pipefish reconstruct` wrote")
    shape, thin = (-1, RING), RING // AROUND
    xyz = np.stack([wall[k].astype(float).reshape(shape) for k in "xyz"], -1)[:, ::thin]
    deviation = wall["deviation"].astype(float).reshape(shape)[:, ::thin]
    piece = wall["piece"].reshape(shape)[:, 0]
    keep = np.arange(len(xyz)) % max(1, math.ceil(len(xyz) / MOST_RINGS)) == 0
    keep |= np.diff(piece, prepend=-1) != 0
    keep |= np.diff(piece, append=-1) != 0
    return xyz[keep], deviation[keep], piece[keep]


def faces_of(piece: np.ndarray) -> np.ndarray:
    """(M,3): triangles between neighbouring rings of one piece."""
    same = np.flatnonzero(piece[1:] == piece[:-1])
    j = np.arange(AROUND)
    a = (same[:, None] * AROUND + j).ravel()
    b = (same[:, None] * AROUND + (j + 1) % AROUND).ravel()
    return np.concatenate([np.c_[a, a + AROUND, b], np.c_[b, a + AROUND, b + AROUND]])


def colour_scale(grey: float) -> list[list[Any]]:
    """Plotly's colour scale from -1 to 1 as shares: grey within +-grey, and from there the colours."""
    half = (len(DIVERGING) - 1) // 2
    outwards = grey + (1 - grey) * np.arange(half + 1) / half
    places = np.concatenate([-outwards[::-1], outwards])
    colours = np.concatenate([DIVERGING[: half + 1], DIVERGING[half:]])
    return [
        [round((1 + p) / 2, 5), "rgb({:.0f},{:.0f},{:.0f})".format(*c)] for p, c in zip(places, colours, strict=True)
    ]


class Scene:
    """The scene of a folder of `pipefish reconstruct`; limits: (name of LIMITS, bound)."""

    def __init__(self, charts: Charts, limits: list[tuple[str, float]]) -> None:
        self.charts, self.limits = charts, limits
        self.document, self.summary = charts.document, charts.summary
        self.metric = charts.unit == "metre"
        nominal = self.summary["nominal"] if self.metric else None
        self.against = "nominal" if nominal else "the mean"
        self.size = nominal or self.summary["d_mean"]
        xyz, self.deviation, piece = read_rings(charts.folder)
        self.faces = faces_of(piece)
        path = np.array(self.document["poses"]["centre"], float)
        self.start = path[0]
        self.wall, self.path = self.upright(xyz), self.upright(path)

    def upright(self, points: np.ndarray) -> np.ndarray:
        """(N,3): right, ahead and up of where the camera set out: Plotly's third axis points upwards."""
        return (points.reshape(-1, 3) - self.start)[:, [0, 2, 1]] * [1, 1, -1]

    def along(self) -> np.ndarray:
        """(3,): from the first ring's middle to the last one's, of length 1."""
        way = self.wall[-AROUND:].mean(axis=0) - self.wall[:AROUND].mean(axis=0)
        return way / max(float(np.linalg.norm(way)), 1e-9)

    def colour_range(self) -> tuple[float, float]:
        """Half width of the 95 % interval of a radius, and the deviation from which on the colour is full."""
        name = "d_max" if np.isfinite(column(self.document, "d_max_sigma")).any() else "d_mean"
        # Against the mean only what differs along and around the pipe counts, and that the scale does not change.
        by_nominal = self.against == "nominal"
        sigma = whole_sigma(self.document, name) if by_nominal else column(self.document, f"{name}_sigma")
        half = self.charts.factor * Z95 * float(np.nanmedian(sigma)) / 2
        most = self.charts.factor * min(float(np.nanpercentile(np.abs(self.deviation), 99)), COLOUR_SPAN * self.size)
        limits = [off for limit in self.limits if (off := self._off(*limit)) > 0]
        strictest = min(*limits, self.charts.factor * COLOUR_SPAN * self.size) if limits else 0.0
        return half, max(1e-6, most, FULL_COLOUR * half, strictest)

    def _off(self, name: str, bound: float) -> float:
        """How far a radius is off where the section is at the limit."""
        if LIMITS[name].unit == "mm":
            return abs(bound - 1000 * self.size) / 2 if self.metric else 0.0
        both = name in ("ovality", "ovality_nominal")  # the widest and the narrowest diameter share it
        return (0.25 if both else 0.5) * bound / 100 * self.charts.factor * self.size

    def chart(self) -> Chart:
        """The wall, the points (hidden: they cover the wall's colour), the path, the findings."""
        half, reach = self.colour_range()
        short = self.charts.short
        digits = 1 if self.metric else 4
        marks, highest = self._marks()
        data = [self._mesh(half, reach), self._points(), self._path(), *marks]
        places = np.vstack([self.wall, self.path, highest])
        low, high = places.min(axis=0), places.max(axis=0)
        extent = np.maximum(high - low, 1e-9)
        ratio = (SCENE_LENGTH * extent / extent.max()).round(4).tolist()  # true proportions
        unit = self.charts.along_unit
        long = extent >= LABELLED * extent.max()
        titles = [
            title if shown else "" for title, shown in zip((f"right, {unit}", f"ahead, {unit}", ""), long, strict=True)
        ]
        axes = {
            f"{name}axis": {
                "title": {"text": title},
                "range": [round(a, 4), round(b, 4)],
                "showticklabels": bool(title),
            }
            for name, title, a, b in zip("xyz", titles, low.tolist(), high.tolist(), strict=True)
        }
        return {
            "id": "tube",
            "title": "The pipe in 3-D",
            "text": "Drag to turn, wheel or two fingers to come nearer; the points are switched on in the legend. "
            f"Colour: the wall's radius against {self.against}; grey within ± {half:.{digits}f} {short}, which is its "
            f"interval, full from {reach:.{digits}f} {short} on. Point at a mark for the finding.",
            "data": data,
            "along": self.along().round(4).tolist(),  # by which the page's script places its camera
            "layout": {
                "scene": {
                    "domain": {"y": [0.13, 1]},  # above the colours' bar
                    "aspectmode": "manual",
                    "aspectratio": dict(zip("xyz", ratio, strict=True)),
                    **axes,
                },
                "margin": {"l": 0, "r": 0, "t": 28, "b": 0},
                "dragmode": "orbit",
            },
        }

    def _mesh(self, half: float, reach: float) -> dict[str, Any]:
        factor, short = self.charts.factor, self.charts.short
        return {
            "type": "mesh3d",
            "name": "wall",
            **_columns(self.wall),
            **{n: self.faces[:, k].tolist() for k, n in enumerate("ijk")},
            "intensity": rounded(factor * self.deviation.ravel(), 3),
            "colorscale": colour_scale(min(half / reach, 1 / FULL_COLOUR)),
            "cmin": -reach,
            "cmax": reach,
            "opacity": 0.55,
            "flatshading": False,
            "lighting": {"ambient": 0.7, "diffuse": 0.5, "specular": 0.1},
            "colorbar": {
                "title": {"text": f"radius - {factor * self.size / 2:.4g}, {short}", "side": "top"},
                "orientation": "h",
                "thickness": 10,
                "len": 0.8,
                "y": 0,
                "yanchor": "bottom",
            },
            "hovertemplate": f"%{{intensity:.2f}} {short}<extra>wall</extra>",
        }

    def _points(self) -> dict[str, Any]:
        cloud = read_columns(self.charts.folder / "points.ply")
        points = np.stack([cloud[k].astype(float) for k in "xyz"], -1)
        near = np.abs(cloud["distance"]) < 0.25 * self.size
        points = points[near][:: max(1, math.ceil(near.sum() / MOST_POINTS))]
        dots = {"type": "scatter3d", "mode": "markers", "marker": {"size": 1.2, "color": "#7d8a97"}}
        return {
            **dots,
            "hoverinfo": "skip",
            "name": "points",
            "visible": "legendonly",
            **_columns(self.upright(points)),
        }

    def _path(self) -> dict[str, Any]:
        of_stretch = self.document["poses"]["stretch"]
        rows: list[np.ndarray] = []
        for _, run in itertools.groupby(range(len(self.path)), key=lambda k: of_stretch[k]):
            rows += [self.path[list(run)], np.full((1, 3), np.nan)]
        line = {"type": "scatter3d", "mode": "lines", "line": {"width": 4, "color": "#d8a012"}, "hoverinfo": "skip"}
        return {**line, "name": "camera", **_columns(np.vstack(rows))}

    def _marks(self) -> tuple[list[dict[str, Any]], np.ndarray]:
        """Findings, above the pipe, where its wall does not hide their names; and their places (N,3)."""
        found = sorted(
            (e for e in self.document["events"] if e["kind"] != "not_measured"), key=lambda e: float(e["chainage"])
        )
        if not found:
            return [], np.zeros((0, 3))
        axis, x = np.stack([column(self.document, k) for k in "xyz"], -1), self.charts.x
        order, at = np.argsort(x), [e["chainage"] for e in found]
        place = self.upright(np.stack([np.interp(at, x[order], axis[order, k]) for k in range(3)], -1))
        place[:, 2] += 0.75 * self.size
        mark = {
            "type": "scatter3d",
            "mode": "markers+text",
            "name": "findings",
            **_columns(place),
            "marker": {"size": 5, "symbol": "diamond", "color": "#b83a63"},
            "text": named(at, [e["kind"] for e in found], NAMED_APART * float(np.ptp(x))),
            "textposition": "top center",
            "hovertext": [f"{e['kind']} {event_text(e, self.charts.unit)}" for e in found],
            "hoverinfo": "text",
        }
        return [mark], place


def named(at: list[float], names: list[str], apart: float) -> list[str]:
    """The names of marks at places along the pipe, without those that would lie over another one: the rarer kind's is
    kept, so that a deposit is not lost among joints."""
    shown: list[int] = []
    for k in sorted(range(len(at)), key=lambda k: (names.count(names[k]), at[k])):
        if all(abs(at[k] - at[other]) >= apart for other in shown):
            shown.append(k)
    return [name if k in shown else "" for k, name in enumerate(names)]


def _columns(points: np.ndarray) -> dict[str, list[float | None]]:
    return {name: rounded(points[:, k], 4) for k, name in enumerate("xyz")}
