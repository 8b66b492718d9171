"""What `pipefish profile show` and `check` tell about a camera: its radial curve, its resolution, and what is wrong."""

from __future__ import annotations

import dataclasses
import html
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from .camera import Camera
from .errors import PipefishError, ProfileError
from .files import write_atomically
from .lenses import rays

Array = npt.NDArray[np.float64]

_PHIS = 36
_ROUND_TRIP_PX = 1e-8  # a tenth of a millionth of what a corner detector resolves


@dataclasses.dataclass(frozen=True)
class Curve:
    """Over theta (n,) radians, means over all azimuths: radius in pixels, its smallest and largest, and the pixels per
    degree away from the axis (radial) and around it (tangential)."""

    theta: Array
    radius: Array
    least: Array
    most: Array
    radial: Array
    tangential: Array


def curve(camera: Camera, count: int = 200) -> Curve:
    """The camera's radial curve from the axis to theta_max, for far points."""
    far = dataclasses.replace(camera, pupil_e1=0.0)
    theta = np.linspace(0, camera.theta_max, count)
    phi = 2 * math.pi * np.arange(_PHIS) / _PHIS
    grid_theta, grid_phi = np.meshgrid(theta, phi, indexing="ij")
    uv, _ = far.project(rays(grid_theta, grid_phi).reshape(-1, 3))
    centre, _ = far.project(np.array([[0.0, 0.0, 1.0]]))
    radius = np.hypot(*(uv - centre).T).reshape(count, _PHIS)
    mean = radius.mean(axis=1)
    degree = math.pi / 180
    with np.errstate(invalid="ignore", divide="ignore"):
        tangential = mean / np.sin(theta) * degree
    radial = np.gradient(mean, theta, edge_order=2) * degree
    tangential[0] = radial[0]
    return Curve(theta, mean, radius.min(axis=1), radius.max(axis=1), radial, tangential)


def table(camera: Camera, rows: int = 8) -> list[dict[str, float]]:
    """Angles in round steps up to theta_max, with radius and resolution there."""
    end = math.degrees(camera.theta_max)
    step = next(s for s in (1, 2, 5, 10, 15, 20, 30) if end / s <= rows or s == 30)
    angles = [*np.arange(0, end - 0.2 * step, step), end]
    c = curve(camera, 400)
    degrees = np.degrees(c.theta)
    names = {"radius_px": c.radius, "radial_px_per_deg": c.radial, "tangential_px_per_deg": c.tangential}
    return [{"theta_deg": float(a), **{n: float(np.interp(a, degrees, v)) for n, v in names.items()}} for a in angles]


def table_text(camera: Camera) -> str:
    """The table for a terminal."""
    lines = ["theta, deg  radius, px  px/deg outward  px/deg around"]
    for row in table(camera):
        lines.append(
            f"{row['theta_deg']:10.1f}  {row['radius_px']:10.2f}  {row['radial_px_per_deg']:14.3f}  "
            f"{row['tangential_px_per_deg']:13.3f}"
        )
    return "\n".join(lines)


# ---- pictures


def draw(camera: Camera, out: Path) -> None:
    """Writes the radial curve and the angular resolution as .png or .html (one file, no network).

    Raises PipefishError for another suffix; OSError.
    """
    match out.suffix.lower():
        case ".png":
            data = _png(camera)
        case ".html":
            data = _page(camera).encode()
        case _:
            raise PipefishError(f"{out}: a name that ends in .png or .html")
    write_atomically(out, data)


def _charts(camera: Camera) -> list[tuple[str, str, list[tuple[str, Array, Array]]]]:
    """(title, name of the y axis, [(name, x in degrees, y)])."""
    c = curve(camera)
    x = np.degrees(c.theta)
    ideal = math.sqrt(camera.f_u * camera.f_v) * c.theta
    lines = [("this camera", x, c.radius), ("equidistant, for comparison", x, ideal)]
    if (c.most - c.least).max() > 0.01 * c.most.max():  # else it hides the camera's own line
        lines += [("nearest azimuth", x, c.least), ("farthest azimuth", x, c.most)]
    both = [("outward", x, c.radial), ("around the axis", x, c.tangential)]
    return [
        ("Where an angle off the axis falls in the picture", "radius, px", lines),
        ("Angular resolution", "px per degree", both),
    ]


def _title(camera: Camera) -> str:
    return camera.name or "unnamed camera"


def _page(camera: Camera) -> str:
    from plotly.offline import get_plotlyjs

    parts = []
    for i, (title, y_name, lines) in enumerate(_charts(camera)):
        data = [
            {"type": "scatter", "mode": "lines", "name": n, "x": np.round(x, 4).tolist(), "y": np.round(y, 5).tolist()}
            for n, x, y in lines
        ]
        axis = {"rangemode": "tozero", "zeroline": True}
        layout = {
            "title": {"text": title},
            "xaxis": {"title": {"text": "angle off the axis, degrees"}, **axis},
            "yaxis": {"title": {"text": y_name}, **axis},
            "height": 420,
            "legend": {"orientation": "h", "y": 1.08},
            "margin": {"t": 80, "b": 60, "l": 70, "r": 20},
        }
        call = json.dumps([data, layout]).replace("<", "\\u003c")
        parts.append(f"<div id='c{i}'></div><script>Plotly.newPlot('c{i}', ...{call}, {{responsive: true}})</script>")
    name = html.escape(_title(camera))
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{name}</title>"
        "<style>body{font-family:system-ui,sans-serif;max-width:900px;margin:2em auto;padding:0 1em}</style>"
        f"<h1>{name}</h1><pre>{html.escape(table_text(camera))}</pre>"
        f"<script>{get_plotlyjs()}</script>{''.join(parts)}</html>\n"
    )


_COLOURS = ((31, 98, 190), (150, 150, 150), (214, 120, 30), (60, 150, 80))
_WIDTH, _PANEL, _SCALE = 820, 380, 2  # drawn at twice the size: smooth lines


def _ticks(end: float, count: int) -> list[float]:
    raw = end / count
    base = 10 ** math.floor(math.log10(raw))
    step = next(s * base for s in (1, 2, 2.5, 5, 10) if s * base >= raw)
    return [i * step for i in range(int(end / step + 1e-9) + 1)]


def _png(camera: Camera) -> bytes:
    charts = _charts(camera)
    picture = Image.new("RGB", (_WIDTH * _SCALE, (_PANEL * len(charts) + 40) * _SCALE), "white")
    pen = ImageDraw.Draw(picture)
    font, small = (ImageFont.load_default(size * _SCALE) for size in (16, 13))
    pen.text((70 * _SCALE, 12 * _SCALE), _title(camera), fill="black", font=font)
    for i, (title, y_name, lines) in enumerate(charts):
        _panel(pen, 40 + i * _PANEL, title, y_name, lines, (font, small))
    picture = picture.resize((picture.width // _SCALE, picture.height // _SCALE), Image.Resampling.LANCZOS)
    out = io.BytesIO()
    picture.save(out, "PNG", optimize=True)
    return out.getvalue()


def _panel(pen: Any, top: int, title: str, y_name: str, lines: list[tuple[str, Array, Array]], fonts: Any) -> None:
    font, small = fonts
    left, right, low, high = 70, _WIDTH - 30, top + _PANEL - 60, top + 50
    x_end = max(float(x.max()) for _, x, _ in lines)
    y_end = max(float(y.max()) for _, _, y in lines) * 1.06

    def place(x: float, y: float) -> tuple[float, float]:
        return (
            (left + (right - left) * x / x_end) * _SCALE,
            (low - (low - high) * y / y_end) * _SCALE,
        )

    def text(x: float, y: float, words: str, anchor: str, face: Any = small, colour: Any = (70, 70, 70)) -> None:
        pen.text((x * _SCALE, y * _SCALE), words, fill=colour, font=face, anchor=anchor)

    text(left, top + 6, title, "la", font, "black")
    for value in _ticks(x_end, 9):
        pen.line([place(value, 0), place(value, y_end)], fill=(228, 228, 228), width=_SCALE)
        text(place(value, 0)[0] / _SCALE, low + 6, f"{value:g}", "ma")
    for value in _ticks(y_end, 6):
        pen.line([place(0, value), place(x_end, value)], fill=(228, 228, 228), width=_SCALE)
        text(left - 8, place(0, value)[1] / _SCALE, f"{value:g}", "rm")
    text((left + right) / 2, low + 26, "angle off the axis, degrees", "ma")
    text(left - 60, high - 8, y_name, "lb")
    x_key = left + 110
    for (name, x, y), colour in zip(lines, _COLOURS, strict=False):
        pen.line([place(*p) for p in zip(x, y, strict=True)], fill=colour, width=2 * _SCALE, joint="curve")
        level = (high - 14) * _SCALE
        pen.line([(x_key * _SCALE, level), ((x_key + 22) * _SCALE, level)], fill=colour, width=3 * _SCALE)
        text(x_key + 28, high - 14, name, "lm")
        x_key += 44 + int(small.getlength(name) / _SCALE)
    pen.rectangle([*place(0, y_end), *place(x_end, 0)], outline=(120, 120, 120), width=_SCALE)


# ---- check


def check(camera: Camera) -> dict[str, Any]:
    """Looks a valid camera over. "problems": reasons not to use it; "remarks": what one should know."""
    problems, remarks = [], []
    width, height = camera.width, camera.height
    if not (-0.5 <= camera.c_u <= width - 0.5 and -0.5 <= camera.c_v <= height - 0.5):
        problems.append(f"c_u, c_v: ({camera.c_u:g}, {camera.c_v:g}) is not in the picture: are they in pixels?")
    aspect = camera.f_u / camera.f_v
    if not 0.5 < aspect < 2:
        problems.append(f"f_u, f_v: {aspect:.2g} times each other; no sensor's pixels are so far from square")
    if abs(camera.pupil_e1) > 0.05:
        problems.append(f"pupil_e1: {camera.pupil_e1:g} m; a lens is not that long: is it in millimetres?")
    sides = np.meshgrid(np.linspace(0, width - 1, 161), np.linspace(0, height - 1, 121))
    grid = np.stack(sides, axis=-1).reshape(-1, 2)
    lit = camera.in_image(grid)
    seen, ok = camera.unproject(grid)
    covered = float((ok & lit).sum() / max(1, lit.sum()))
    if covered < 0.05:
        problems.append(f"theta_max, f_u: rays for {100 * covered:.1f} % of the picture: are f in pixels per radian?")
    elif covered < 0.999:
        remarks.append(f"{100 * (1 - covered):.1f} % of the picture lies beyond theta_max and has no rays")
    error = 0.0
    if (ok & lit).any():
        points = seen[ok & lit] + camera.origins(grid[ok & lit])
        again, back = camera.project(points)
        error = float(np.linalg.norm(again - grid[ok & lit], axis=1)[back].max()) if back.any() else math.inf
        if not (back.all() and error <= _ROUND_TRIP_PX):
            problems.append(f"self-test: pixel to ray to pixel is {error:.2g} px off")
    if Camera.from_binary(camera.to_binary()) != camera:
        problems.append("self-test: the binary form does not give the camera back")
    limit = proof_limit(camera)
    if camera.theta_covered is None:
        remarks.append("theta_covered: how far the calibration's data reached is unknown")
    elif camera.theta_covered < camera.theta_max - 0.02:
        covered_deg, max_deg = math.degrees(camera.theta_covered), math.degrees(camera.theta_max)
        remarks.append(f"between {covered_deg:.1f} and {max_deg:.1f} degrees the model is extrapolated: no data there")
    if camera.covariance is None:
        remarks.append("covariance: none; what is measured with this camera carries no interval of it")
    if camera.rms_px is not None and camera.rms_px > 1:
        remarks.append(f"rms_px: {camera.rms_px:.2f} px is much for a calibration")
    return {
        "valid": not problems,
        "problems": problems,
        "remarks": remarks,
        "covered": covered,
        "round_trip_px": error,
        "theta_max_deg": math.degrees(camera.theta_max),
        "one_to_one_up_to_deg": math.degrees(limit),
    }


def proof_limit(camera: Camera) -> float:
    """The largest theta_max, to 0.1 degrees, up to which the core proves this camera one-to-one."""

    def proved(theta: float) -> bool:
        try:
            dataclasses.replace(camera, theta_max=theta)
        except ProfileError:
            return False
        return True

    low, high = camera.theta_max, math.pi - 1e-6
    if proved(high):
        return high
    while high - low > math.radians(0.1):
        middle = (low + high) / 2
        low, high = (middle, high) if proved(middle) else (low, middle)
    return low
