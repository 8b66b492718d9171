"""The charts of a calibration's report: residuals, radial curve, coverage, uncertainty, board. See pipefish.page."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from .calibration import Board
from .camera import Camera
from .files import rounded
from .lensreport import curve
from .page import Chart

Array = npt.NDArray[np.float64]

_SHOWN = 2500  # points of a scatter chart; more hide each other and weigh
_CELLS = 20  # of the residual field across the picture


@dataclasses.dataclass(frozen=True, eq=False)
class Residuals:
    """Of one camera's used points: pixel (N, 2), residual (N, 2) measured minus model, theta (N,) radians."""

    pixel: Array
    residual: Array
    theta: Array

    @staticmethod
    def of(report: dict[str, Any], camera: int) -> Residuals:
        """From Calibration.report, of the camera of that number."""
        r = report["residuals"]
        mine = np.array([v["camera"] == camera for v in report["views"]])[np.array(r["view"], dtype=int)]
        keep = mine & np.array(r["used"], dtype=bool)
        return Residuals(
            np.array(r["pixel"]).reshape(-1, 2)[keep],
            np.array(r["residual"]).reshape(-1, 2)[keep],
            np.array(r["theta"])[keep],
        )


def _picture_axes(width: int, height: int) -> dict[str, Any]:
    return {
        "xaxis": {"range": [-0.5, width - 0.5], "constrain": "domain", "title": {"text": "u, px"}, "zeroline": False},
        "yaxis": {
            "range": [height - 0.5, -0.5],
            "constrain": "domain",
            "scaleanchor": "x",
            "title": {"text": "v, px"},
            "zeroline": False,
        },
    }


def residual_field(r: Residuals, camera: Camera, key: str) -> Chart:
    """Mean residual of each cell of the picture as an arrow."""
    step = camera.width / _CELLS
    cell = np.floor(r.pixel / step).astype(int)
    keys, which, counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    mean = np.stack([np.bincount(which, weights=r.residual[:, k]) / counts for k in range(2)], axis=1)
    many = counts >= 5
    middle, mean = (keys[many] + 0.5) * step, mean[many]
    longest = float(np.percentile(np.linalg.norm(mean, axis=1), 95)) if len(mean) else 1.0
    scale = 1.2 * step / max(longest, 1e-9)
    scale = float(f"{scale:.1g}")
    x: list[float | None] = []
    y: list[float | None] = []
    for (u, v), (du, dv) in zip(middle, mean * scale, strict=True):
        a, b = u - 0.28 * du - 0.14 * dv, v - 0.28 * dv + 0.14 * du
        c, d = u - 0.28 * du + 0.14 * dv, v - 0.28 * dv - 0.14 * du
        end = (u + du, v + dv)
        x += [*rounded([u, end[0], a + du, end[0], c + du], 1), None]
        y += [*rounded([v, end[1], b + dv, end[1], d + dv], 1), None]
    typical = float(np.sqrt((mean**2).sum(axis=1).mean())) if len(mean) else 0.0
    return {
        "id": f"field{key}",
        "title": "Residuals over the picture",
        "text": f"Mean of measured minus model in each cell, {scale:g} times as long: {typical:.3f} px rms. A good "
        "calibration leaves no pattern; arrows that flow together are model error, or a target that is not what it "
        "seems.",
        "data": [{"type": "scatter", "mode": "lines", "x": x, "y": y, "hoverinfo": "skip", "line": {"width": 1.6}}],
        "layout": {**_picture_axes(camera.width, camera.height), "showlegend": False},
    }


def residual_theta(r: Residuals, noise: dict[str, Any], key: str) -> Chart:
    """Residuals against the angle off the axis, with their size and the noise that was assumed."""
    pick = np.random.default_rng(1).permutation(len(r.theta))[:_SHOWN]
    degrees = np.degrees(r.theta)
    length = np.linalg.norm(r.residual, axis=1)
    edges = np.linspace(0, degrees.max() * 1.0001, 13)
    at, size = [], []
    for low, high in itertools.pairwise(edges):
        inside = (degrees >= low) & (degrees < high)
        if inside.sum() >= 8:
            at.append((low + high) / 2)
            size.append(float(np.sqrt((length[inside] ** 2).mean())))
    return {
        "id": f"theta{key}",
        "title": "Residuals against the angle off the axis",
        "text": "Each dot is a point of the target; the line is their root mean square. It rises towards the rim, "
        "where "
        "pictures are softest; the fit weights points by it.",
        "data": [
            {
                "type": "scatter",
                "mode": "markers",
                "name": "points",
                "x": rounded(degrees[pick], 2),
                "y": rounded(length[pick], 3),
                "marker": {"size": 3, "opacity": 0.45},
                "hovertemplate": "%{x:.1f} deg: %{y:.2f} px<extra></extra>",
            },
            {
                "type": "scatter",
                "mode": "lines",
                "name": "rms",
                "x": rounded(at, 2),
                "y": rounded(size, 4),
                "line": {"width": 3},
                "hovertemplate": "rms %{y:.3f} px<extra></extra>",
            },
        ],
        "layout": {
            "xaxis": {"title": {"text": "degrees off the axis"}, "rangemode": "tozero"},
            "yaxis": {
                "title": {"text": "px"},
                "range": [0, round(1.1 * float(np.percentile(length, 99.5)), 3)],
            },
        },
    }


def radial(camera: Camera, covered: float, key: str) -> Chart:
    """Where an angle off the axis falls, and the resolution there."""
    c = curve(camera, 120)
    x = rounded(np.degrees(c.theta), 2)
    return {
        "id": f"radial{key}",
        "title": "The lens: radius and resolution",
        "text": f"Where an angle off the axis falls in the picture. The target was seen up to "
        f"{math.degrees(covered):.0f} "
        f"degrees; beyond, up to {math.degrees(camera.theta_max):.0f}, the curve is extrapolated.",
        "data": [
            {"type": "scatter", "mode": "lines", "name": "radius, px", "x": x, "y": rounded(c.radius, 2)},
            {
                "type": "scatter",
                "mode": "lines",
                "name": "px per degree outward",
                "x": x,
                "y": rounded(c.radial, 3),
                "yaxis": "y2",
            },
            {
                "type": "scatter",
                "mode": "lines",
                "name": "px per degree around",
                "x": x,
                "y": rounded(c.tangential, 3),
                "yaxis": "y2",
                "line": {"dash": "dot"},
            },
        ],
        "layout": {
            "xaxis": {"title": {"text": "degrees off the axis"}, "rangemode": "tozero"},
            "yaxis": {"title": {"text": "radius, px"}, "rangemode": "tozero"},
            "yaxis2": {
                "title": {"text": "px per degree"},
                "overlaying": "y",
                "side": "right",
                "rangemode": "tozero",
                "showgrid": False,
                "tickmode": "auto",
                "nticks": 5,
            },
            "shapes": [
                {
                    "type": "line",
                    "x0": math.degrees(covered),
                    "x1": math.degrees(covered),
                    "yref": "paper",
                    "y0": 0,
                    "y1": 1,
                    "line": {"dash": "dash", "width": 1, "color": "#888"},
                }
            ],
        },
    }


def coverage(cells: dict[str, Any], key: str) -> Chart:
    """Points in cells of angle off the axis by direction, empty ones marked, and where the next view should be."""
    counts, inside = np.array(cells["counts"]), np.array(cells["in_image"], dtype=bool)
    step, width = math.degrees(cells["theta_step"]), 360 / cells["phi_bins"]
    base, length, angle, colour, text = [], [], [], [], []
    for ring, sector in np.argwhere(inside):
        base.append(float(ring * step))
        length.append(float(step))
        angle.append((sector + 0.5) * width)
        colour.append(float(math.log10(1 + counts[ring, sector])))
        text.append(f"{ring * step:.0f} to {(ring + 1) * step:.0f} deg off the axis: {counts[ring, sector]} points")
    top = max(1.0, max(colour, default=1.0))
    ticks = [n for n in (0, 10, 100, 1000, 10000) if math.log10(1 + n) <= top * 1.02]
    data: list[dict[str, Any]] = [
        {
            "type": "barpolar",
            "base": base,
            "r": length,
            "theta": angle,
            "width": [width] * len(angle),
            "text": text,
            "hovertemplate": "%{text}<extra></extra>",
            "marker": {
                "color": colour,
                "cmin": 0,
                "cmax": top,
                "colorscale": [[0, "#d9534a"], [0.02, "#d8e8ea"], [1, "#0f6f78"]],
                "colorbar": {
                    "title": {"text": "points"},
                    "tickvals": [math.log10(1 + n) for n in ticks],
                    "ticktext": [str(n) for n in ticks],
                    "thickness": 12,
                },
                "line": {"width": 1, "color": "rgba(128,128,128,0.35)"},
            },
        }
    ]
    place = cells["next_view"]
    if place is not None:
        data.append(
            {
                "type": "scatterpolar",
                "mode": "markers",
                "r": [math.degrees(place["theta"])],
                "theta": [math.degrees(place["phi"])],
                "marker": {"symbol": "star", "size": 15, "color": "#f5a623", "line": {"width": 1, "color": "#333"}},
                "hovertemplate": "next view here<extra></extra>",
            }
        )
    return {
        "id": f"coverage{key}",
        "title": "Where the target has been seen",
        "text": f"The picture as the lens sees it: the axis in the middle, rings of {step:.0f} degrees. Red has "
        f"never seen "
        f"the target. {cells['advice'][:1].upper() + cells['advice'][1:]} (the star).",
        "data": data,
        "layout": {
            "polar": {
                "angularaxis": {"direction": "clockwise", "rotation": 0, "showticklabels": False, "ticks": ""},
                "radialaxis": {"ticksuffix": "°", "angle": 90, "tickangle": 90, "nticks": 6},
                "bgcolor": "rgba(0,0,0,0)",
            },
            "showlegend": False,
            "margin": {"l": 24, "r": 24, "t": 20, "b": 20},
        },
    }


def uncertainty(grid: dict[str, Any], camera: Camera, key: str) -> Chart:
    """How well a point's place in the picture is known, pixels."""
    values = np.array([[np.nan if s is None else s for s in row] for row in grid["sigma_px"]], dtype=float)
    finite = values[np.isfinite(values)]
    top = float(np.percentile(finite, 97)) if len(finite) else 1.0
    middle = float(np.median(finite)) if len(finite) else math.nan
    return {
        "id": f"uncertainty{key}",
        "title": "Uncertainty of the calibration",
        "text": f"Standard deviation, in the worst direction, of where a point {grid['distance_m']:.2g} m away is "
        f"seen: "
        f"median {middle:.3f} px. It comes from the noise and the views; it does not know of what the model leaves "
        f"out.",
        "data": [
            {
                "type": "heatmap",
                "x": rounded(grid["u"], 1),
                "y": rounded(grid["v"], 1),
                "z": [rounded(row) for row in values],
                "zmin": 0,
                "zmax": top,
                "zsmooth": "best",
                "colorscale": "Viridis",
                "colorbar": {"title": {"text": "px"}, "thickness": 12},
                "hovertemplate": "(%{x:.0f}, %{y:.0f}): %{z:.3f} px<extra></extra>",
            }
        ],
        "layout": _picture_axes(camera.width, camera.height),
    }


def board_shape(board: Board, name: str, key: str) -> Chart | None:
    """Heights of a flat target over the best plane, millimetres; None where none was estimated."""
    if board.shape == "flat" or not board.frame.planar:
        return None
    points = board.frame.points
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = np.linspace(low[0], high[0], 33), np.linspace(low[1], high[1], 33)
    drawn = np.stack([*np.meshgrid(x, y), np.zeros((33, 33))], axis=-1).reshape(-1, 3)
    plane = board.frame.plane
    back = (drawn - plane[:, 3]) @ plane[:, :3]
    real = board.points(back)
    plane_through = np.linalg.lstsq(
        np.column_stack([drawn[:, :2], np.ones(len(drawn))]), _height(real, plane), rcond=None
    )
    flat = np.column_stack([drawn[:, :2], np.ones(len(drawn))]) @ plane_through[0]
    height = (_height(real, plane) - flat).reshape(33, 33) * 1e3
    limit = float(np.abs(height).max()) or 1e-3
    wider = "wider" if board.aspect > 0 else "narrower"
    stretch = f"; it is {100 * abs(board.aspect):.3f} % {wider} against its height than drawn" if board.aspect else ""
    return {
        "id": f"board{key}",
        "title": f"Shape of the target {name}".strip(),
        "text": f"How far it bends out of its plane: up to {board.warp_mm:.2f} mm{stretch}. The calibration knows "
        f"of this "
        "and takes it out; a stiffer board is better still.",
        "data": [
            {
                "type": "contour",
                "x": rounded(x * 1e3, 2),
                "y": rounded(y * 1e3, 2),
                "z": [rounded(row, 5) for row in height],
                "zmin": -limit,
                "zmax": limit,
                "colorscale": "RdBu",
                "contours": {"coloring": "heatmap"},
                "line": {"width": 0.6},
                "colorbar": {"title": {"text": "mm"}, "thickness": 12},
                "hovertemplate": "(%{x:.0f}, %{y:.0f}) mm: %{z:.3f} mm<extra></extra>",
            }
        ],
        "layout": {
            "xaxis": {"title": {"text": "mm"}, "constrain": "domain", "zeroline": False},
            "yaxis": {
                "title": {"text": "mm"},
                "autorange": "reversed",
                "scaleanchor": "x",
                "constrain": "domain",
                "zeroline": False,
            },
        },
    }


def _height(points: Array, plane: Array) -> Array:
    return points @ plane[2, :3] + plane[2, 3]
