"""The charts of the report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.files import rounded
from pipefish.intervals import Z95
from pipefish.measured_limits import whole_sigma
from pipefish.measured_remarks import TREND_PX
from pipefish.measured_texts import OVALITIES, column, read_measured
from pipefish.page import Chart

LEAST_SPAN = 0.1  # diameters that the axis of heights spans
NARROW_GAP = 1.5  # stations further apart than so many spacings are not joined by a line

DIAMETERS = (
    ("d_mean", "mean (perimeter / pi)"),
    ("d_max", "widest"),
    ("d_min", "narrowest"),
    ("d_area", "of equal area"),
)
COLOURS = ("#1f8a94", "#c8641b", "#6d4bc4", "#4d8a22", "#b83a63")


def _axis(title: str, **more: Any) -> dict[str, Any]:
    return {"title": {"text": title}, **more}


def _runs(x: np.ndarray, y: np.ndarray, stretch: np.ndarray) -> list[np.ndarray]:
    """Indices of what may be joined: neighbours of one stretch that have values."""
    runs: list[list[int]] = []
    for i in np.flatnonzero(np.isfinite(y)):
        if runs and runs[-1][-1] == i - 1 and stretch[i] == stretch[i - 1]:
            runs[-1].append(int(i))
        else:
            runs.append([int(i)])
    return [np.array(r) for r in runs]


def _band(
    x: np.ndarray,
    y: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    stretch: np.ndarray,
    name: str,
    colour: str,
    **more: Any,
) -> list[dict[str, Any]]:
    """A line with its band, broken where nothing was measured."""
    line_x, line_y, area_x, area_y = ([] for _ in range(4))
    for run in _runs(x, y, stretch):
        line_x += [*rounded(x[run], 3), None]
        line_y += [*rounded(y[run], 3), None]
        area_x += [*rounded(x[run], 3), *rounded(x[run][::-1], 3), None]
        area_y += [*rounded(high[run], 3), *rounded(low[run][::-1], 3), None]
    area = {"type": "scatter", "mode": "none", "x": area_x, "y": area_y, "fill": "toself", "fillcolor": colour + "38"}
    line = {
        "type": "scatter",
        "mode": "lines",
        "x": line_x,
        "y": line_y,
        "name": name,
        "line": {"color": colour, "width": 2},
    }
    return [
        {**area, "legendgroup": name, "showlegend": False, "hoverinfo": "skip", **more},
        {**line, "legendgroup": name, **more},
    ]


class Charts:
    """Charts of a folder of `pipefish reconstruct`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.document = read_measured(folder)
        self.summary = self.document["summary"]
        self.unit = self.summary["unit"]
        self.factor, self.short = (1000.0, "mm") if self.unit == "metre" else (1.0, "diameters")
        self.along_unit = "m" if self.unit == "metre" else "diameters"
        self.x = column(self.document, "chainage")
        self.stretch = column(self.document, "stretch")

    def along(self, **more: Any) -> dict[str, Any]:
        """The axis along the pipe, the same range in all charts: what was not measured is on it too."""
        gaps = [at for gap in self.document["not_measured"] for at in (gap["start"], gap["end"]) if at is not None]
        reach = np.append(self.x, gaps)
        low, high = float(np.nanmin(reach)), float(np.nanmax(reach))
        margin = 0.02 * max(high - low, 1e-3)
        return _axis(f"chainage, {self.along_unit}", range=[round(low - margin, 3), round(high + margin, 3)], **more)

    def shapes(self) -> list[dict[str, Any]]:
        """Grey where nothing was measured."""
        shapes: list[dict[str, Any]] = []
        for gap in self.document["not_measured"]:
            if gap["start"] is not None and gap["end"] is not None:
                shapes.append(
                    {
                        "type": "rect",
                        "xref": "x",
                        "yref": "paper",
                        "x0": gap["start"],
                        "x1": gap["end"],
                        "y0": 0,
                        "y1": 1,
                        "fillcolor": "rgba(128,128,128,0.18)",
                        "line": {"width": 0},
                        "layer": "below",
                    }
                )
        return shapes

    def chart_diameter(self) -> Chart:
        """All named diameters with their bands, one at a time and together with nominal."""
        data: list[dict[str, Any]] = []
        # The mean last and dashed: where a pipe is round it lies on the others.
        for (name, words), colour in [*zip(DIAMETERS, COLOURS, strict=False)][::-1]:
            value, sigma = (self.factor * column(self.document, n) for n in (name, name + "_sigma"))
            shown: dict[str, Any] = {} if name != "d_area" else {"visible": "legendonly"}
            reach = Z95 * sigma
            data += _band(self.x, value, value - reach, value + reach, self.stretch, words, colour, **shown)
        data[-1]["line"]["dash"] = "dash"
        for trace in data[1::2]:
            trace["hovertemplate"] = f"%{{x:.2f}} {self.along_unit}: %{{y:.2f}} {self.short}"
        shapes, dotted = self.shapes(), ""
        if self.summary["nominal"] and self.unit == "metre":
            dotted = " Dotted: nominal."
            line = {
                "type": "line",
                "xref": "paper",
                "x0": 0,
                "x1": 1,
                "line": {"dash": "dot", "width": 1.5, "color": "#888"},
            }
            shapes.append({**line, "y0": 1000 * self.summary["nominal"], "y1": 1000 * self.summary["nominal"]})
        shared = Z95 * self.factor * column(self.document, "d_mean_systematic")
        digits = 1 if self.unit == "metre" else 4
        ends = dict.fromkeys(f"{value:.{digits}f}" for value in (np.nanmin(shared), np.nanmax(shared)))
        wrong = f"the scale or the camera is not in them: ± {' to '.join(ends)} {self.short}"
        if not np.nanmax(shared) > 0:  # no scale, and a profile without covariance
            wrong = "the camera is not in them, and not known"
        return {
            "id": "diameter",
            "title": "Diameter along the pipe",
            "text": f"Bands: repeatability. What is wrong with {wrong}.{dotted} Grey from bottom to top: not measured. "
            "Names in the "
            "legend switch on and off.",
            "data": data,
            "layout": {
                "xaxis": self.along(),
                "yaxis": _axis(self.short),
                "shapes": shapes,
                "hovermode": "x unified",
                "legend": {"traceorder": "reversed"},
            },
        }

    def chart_ovality(self) -> Chart:
        """The definitions of ovality, to choose from."""
        data: list[dict[str, Any]] = []
        names = []
        for name, words in OVALITIES.items():
            value = 100 * column(self.document, name)
            if not np.isfinite(value).any():
                continue
            if name == "ovality":
                low, high = (100 * column(self.document, n) for n in ("ovality_lo", "ovality_hi"))
            else:
                reach = Z95 * 100 * whole_sigma(self.document, name)
                low, high = value - reach, value + reach
            colour = COLOURS[0]
            data += _band(self.x, value, low, high, self.stretch, words, colour, visible=not names)
            data[-1]["hovertemplate"] = f"%{{x:.2f}} {self.along_unit}: %{{y:.2f}} %<extra></extra>"
            names.append(words)
        shapes = self.shapes()
        return {
            "id": "ovality",
            "title": "Ovality along the pipe",
            "text": "Choose the definition. Bands: repeatability and systematic error together, as "
            "for the limits. Noise makes any circle look oval: its share is taken off, and the lower end of an "
            "interval may be zero.",
            "data": data,
            "layout": {
                "xaxis": self.along(),
                "yaxis": _axis("%", rangemode="tozero"),
                "shapes": shapes,
                "showlegend": False,
            },
            "choice": {"label": "Definition", "names": names, "traces": 2},
        }

    def charts_line(self) -> list[Chart]:
        """Where the axis goes: plan, and height where gravity is known."""
        axis = np.stack([column(self.document, k) for k in "xyz"], -1)
        start = axis[0]
        down = self.document["structure"]["down"]
        up = -np.array(down if down else [0.0, 1.0, 0.0])
        heading = np.array([column(self.document, k)[0] for k in ("tx", "ty", "tz")])
        ahead = heading - (heading @ up) * up
        if np.linalg.norm(ahead) < 0.2:  # a shaft: any two directions across
            ahead = np.cross(up, [1.0, 0.0, 0.0])
        ahead /= np.linalg.norm(ahead)
        side = np.cross(ahead, up)
        flat = (axis - start) @ np.stack([ahead, side], -1)
        height = (axis - start) @ up
        breaks = np.diff(self.stretch, prepend=self.stretch[0]) != 0
        line = {"type": "scatter", "mode": "lines", "line": {"width": 2, "color": COLOURS[0]}}

        def cut(values: np.ndarray) -> list[float | None]:
            return rounded(np.insert(values, np.flatnonzero(breaks), np.nan), 4)

        unit = self.along_unit
        known = "by the inclinometer" if down else "up in the first keyframe's picture"
        return [
            {
                "id": "plan",
                "title": "Centreline from above",
                "text": "Ahead as the pipe starts, and to the right of it.",
                "data": [{**line, "x": cut(flat[:, 0]), "y": cut(flat[:, 1])}],
                "layout": {
                    "xaxis": _axis(f"ahead, {unit}"),
                    "yaxis": _axis(f"right, {unit}", scaleanchor="x", autorange="reversed"),
                },
            },
            {
                "id": "height",
                "title": "Height of the centreline",
                "text": f"Above where the pipe starts; up is {known}.",
                "data": [{**line, "x": cut(self.x), "y": cut(self.factor * height)}],
                "layout": {"xaxis": self.along(), "yaxis": _axis(self.short, range=self._heights(height))},
            },
        ]

    def _heights(self, height: np.ndarray) -> list[float]:
        """The range of the axis: not less than LEAST_SPAN, so that what adds up to a millimetre looks like one."""
        low, high = float(np.nanmin(height)), float(np.nanmax(height))
        half = max(0.55 * (high - low), LEAST_SPAN * self.summary["d_mean"] / 2)
        return [round(self.factor * ((low + high) / 2 + end), 4) for end in (-half, half)]

    def charts_quality(self) -> list[Chart]:
        """Residuals by angle, points on the wall, encoder against vision."""
        return [self._chart_residuals(), self._chart_points(), *self._chart_encoder()]

    def _chart_residuals(self) -> Chart:
        quality = self.document["quality"]
        bins = quality["residuals_by_angle"]
        names = [f"{b['low_deg']:.0f}-{b['high_deg']:.0f}°" for b in bins]
        rms = {
            "type": "bar",
            "name": "rms",
            "x": names,
            "y": rounded((b["rms_px"] for b in bins), 3),
            "customdata": [b["count"] for b in bins],
            "hovertemplate": "%{y:.3f} px rms of %{customdata}<extra></extra>",
        }
        outwards = {
            "type": "scatter",
            "mode": "lines+markers",
            "name": "mean outwards",
            "x": names,
            "y": rounded((b["mean_radial_px"] for b in bins), 3),
            "hovertemplate": "%{y:+.3f} px outwards<extra></extra>",
        }
        return {
            "id": "angle",
            "title": "How well the camera profile fits",
            "text": "How far points are in the pictures from where the measurement has them (residuals), by their "
            f"angle from the camera's axis; {quality['observations']} observations, {quality['outliers']} of them "
            "outliers and left out here. A mean outward residual away from zero says that the profile does not fit "
            f"the camera; judged at {TREND_PX:g} px.",
            "data": [rms, outwards],
            "layout": {"xaxis": _axis("", type="category"), "yaxis": _axis("px")},
        }

    def _chart_points(self) -> Chart:
        line = {"type": "scatter", "mode": "lines", "line": {"color": COLOURS[0]}}
        return {
            "id": "points",
            "title": "Points behind each section",
            "text": "Points within 0.375 diameters of each station. Under 20 nothing is given.",
            "data": [{**line, "x": rounded(self.x, 3), "y": rounded(column(self.document, "inliers"), 0)}],
            "layout": {
                "xaxis": self.along(),
                "yaxis": _axis("points", rangemode="tozero"),
                "shapes": self.shapes(),
            },
        }

    def _chart_encoder(self) -> list[Chart]:
        """None without an encoder."""
        encoder = self.document["quality"]["encoder"]
        if not encoder or self.unit != "metre":
            return []
        excess, along = (
            np.array([np.nan if v is None else v for v in encoder[name]], float)
            for name in ("vision_minus_encoder", "chainage")
        )
        last = excess[np.isfinite(excess)]
        total = float(np.nanmax(along) - np.nanmin(along)) or math.nan
        share = f" {100 * last[-1] / total:+.2f} % at the end." if len(last) else ""
        line = {"type": "scatter", "mode": "lines", "line": {"color": COLOURS[1]}}
        chart: Chart = {
            "id": "encoder",
            "title": "Camera's path against the encoder",
            "text": f"How much further the camera's path is than the encoder says.{share} Steps are slips of the wheel "
            "or of the tracking.",
            "data": [{**line, "x": rounded(along, 3), "y": rounded(1000 * excess, 2)}],
            "layout": {"xaxis": _axis("chainage by the encoder, m"), "yaxis": _axis("mm")},
        }
        return [chart]
