"""What `pipefish dense` writes: the map of the wall as tables, arrays, a picture and a point cloud."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipefish.cloudfile import ply_bytes
from pipefish.colours import diverging
from pipefish.dense import DenseWall
from pipefish.dense_findings import FORMAT, VERSION, findings_of, findings_table
from pipefish.files import plain, write_atomically
from pipefish.measured_texts import clock_text
from pipefish.wall import Piece
from pipefish.wallmodel import Floats, WallModel

MAP_WIDTH = 3000  # pixels at most; cells are drawn up to 3 x 3


@dataclass(frozen=True, eq=False)
class Strip:
    """A piece of a measured wall: its chainage where s begins, and the way it grows along s."""

    wall: WallModel
    origin: float
    sign: int


def strips_of(pieces: list[Piece]) -> list[Strip]:
    """The pieces with s as WallModel counts it: along the tube, whichever way the chainage goes."""
    return [Strip(WallModel(p.rings[:: p.sign]), p.start if p.sign > 0 else p.end, p.sign) for p in pieces]


def _table(first: str, along: Floats, clock: Floats, values: Floats) -> bytes:
    """A grid as CSV: chainage in the first column, clock hours in the first row."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([first, *(f"{c * 6 / math.pi:.3f}" for c in clock)])
    for s, row in zip(along, values, strict=True):
        writer.writerow([f"{s:.4f}", *("" if math.isnan(v) else f"{v:.3f}" for v in row)])
    return stream.getvalue().encode()


def map_picture(found: DenseWall, chainage: Floats, unit: str) -> NDArray[np.uint8]:
    """(H,W,3): the deviation in colours above, the unrolled pipe below, chainage to the right, clock downwards from
    twelve o'clock; regions framed, steps marked, cracks drawn over."""
    from PIL import Image, ImageDraw, ImageFont

    rows, columns = found.deviation.shape
    zoom = max(1, min(3, MAP_WIDTH // rows))
    factor, name = (1000.0, "mm") if unit == "metre" else (100.0, "% of the diameter")
    known = np.abs(found.deviation[np.isfinite(found.deviation)])
    span = max(float(np.percentile(known, 99.5)) if len(known) else 0.0, found.wall.mean_radius / 100)
    value = found.deviation / span
    colour = diverging(np.nan_to_num(value).ravel()).reshape(rows, columns, 3)
    colour[np.isnan(found.deviation)] = (40, 40, 44)
    most = np.nanpercentile(found.brightness, 99.5) if np.isfinite(found.brightness).any() else 1.0
    level = (255 * np.clip(np.nan_to_num(found.brightness) / max(most, 1e-6), 0, 1)).astype(np.uint8)
    maps = [colour.transpose(1, 0, 2), np.repeat(level.T[..., None], 3, axis=2)]
    left, top, gap = 48, 40, 34
    height = zoom * columns
    sheet = Image.new("RGB", (left + max(zoom * rows, 420) + 20, top + 2 * height + 2 * gap), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(13)
    for n, picture in enumerate(maps):
        y0 = top + n * (height + gap)
        sheet.paste(Image.fromarray(picture).resize((zoom * rows, height), Image.Resampling.NEAREST), (left, y0))
        for hour in (12, 3, 6, 9, 12):
            y = y0 + height * (0 if hour == 12 else hour / 12)
            draw.text((left - 8, y), str(hour), "black", font, anchor="rm")
        draw.text((left - 8, y0 + height), "12", "black", font, anchor="rm")
        for s in _ticks(chainage):
            x = left + zoom * float(np.interp(s, *_ascending(chainage, np.arange(rows))))
            draw.line([(x, y0 + height), (x, y0 + height + 4)], "black")
            draw.text((x, y0 + height + 6), f"{s:g}", "black", font, anchor="ma")
        for r in found.regions:
            _frame(draw, found, r, zoom, left, y0)
        for r in found.cracks:
            _trace(draw, found, r, zoom, left, y0)
        for r in found.steps:
            x = left + zoom * rows * r["s"] / found.wall.length
            for y in (y0 - 4, y0 + height - 8):
                draw.line([(x, y), (x, y + 12)], fill=(220, 30, 140), width=2)
    draw.text((left, 8), "off the fitted tube (blue: inside)", "black", font)
    for k in range(160):
        value = np.array([2 * k / 159 - 1])
        draw.line([(left + 290 + k, 8), (left + 290 + k, 22)], tuple(int(v) for v in diverging(value)[0]))
    draw.text((left + 284, 8), f"-{factor * span:.1f}", "black", font, anchor="ra")
    draw.text((left + 456, 8), f"+{factor * span:.1f} {name}", "black", font)
    return np.asarray(sheet)


def _ascending(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    return (x, y) if x[-1] >= x[0] else (x[::-1], y[::-1])


def _ticks(chainage: Floats) -> Floats:
    """Round chainages, four to ten of them."""
    low, high = min(chainage), max(chainage)
    step = 10 ** math.floor(math.log10(max(high - low, 1e-3)))
    step = next(step * f for f in (0.1, 0.2, 0.5, 1, 2) if (high - low) / (step * f) <= 10)
    return np.round(np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step, 6)


def _frame(draw: Any, found: DenseWall, region: dict[str, float], zoom: int, left: int, top: int) -> None:
    rows, columns = found.deviation.shape
    x = [left + zoom * rows * (region["s"] + k * region["length"] / 2) / found.wall.length for k in (-1, 1)]
    height = zoom * columns
    y = [top + height * (region["clock"] + k * region["extent"] / 2) / (2 * math.pi) for k in (-1, 1)]
    draw.rectangle([(x[0] - 3, max(y[0], top) - 3), (x[1] + 3, min(y[1], top + height) + 3)], outline=(220, 30, 140))


def _trace(draw: Any, found: DenseWall, crack: dict[str, Any], zoom: int, left: int, top: int) -> None:
    """A crack's path, once on either side of where the picture is cut."""
    rows, columns = found.deviation.shape
    path = np.array(crack["path"])
    x = left + zoom * rows * path[:, 0] / found.wall.length
    turns = path[:, 1] / (2 * math.pi)
    for k in range(math.floor(turns.min()), math.floor(turns.max()) + 1):
        inside = (turns >= k) & (turns <= k + 1)
        points = list(zip(x[inside], top + zoom * columns * (turns[inside] - k), strict=True))
        if len(points) > 1:
            draw.line(points, fill=(220, 30, 140), width=1)


def cloud(found: DenseWall, unit: str, sigma_radius: Floats) -> bytes:
    """The measured cells as a PLY file: place, deviation and sigma, that of the radius, grey level, colour by
    deviation."""
    good = np.isfinite(found.deviation)
    span = found.wall.mean_radius / 50
    columns = dict(zip("xyz", found.points[good].T, strict=True))
    columns |= {"deviation": found.deviation[good], "sigma": found.sigma[good], "sigma_radius": sigma_radius[good]}
    columns = {name: v.astype(np.float32) for name, v in columns.items()}
    columns["pairs"] = found.pairs[good].astype(np.uint8)
    columns["brightness"] = (255 * np.nan_to_num(found.brightness[good])).astype(np.uint8)
    columns |= dict(zip(("red", "green", "blue"), diverging(found.deviation[good] / span).T, strict=True))
    return ply_bytes(columns, None, (f"unit: {unit}", f"full colour at {span:.6g} off the fitted tube"))


def radius_sigmas(summary: dict[str, Any]) -> dict[str, Any]:
    """What the radii of all cells have in common and the sigmas of deviations do not hold, from the summary of
    reconstruction.json:
    radius_sigma    repeatability of the fitted tube, of one place
    scale_sigma     relative: the scale and the camera, median of the stations; None where neither is known
    """
    station, shared = summary.get("station_sigma"), summary.get("station_systematic")
    prior = summary.get("diameter_from_prior")
    return {
        "radius_sigma": 0.5 * station if station is not None else None,
        "scale_sigma": shared / summary["d_mean"] if shared and not prior else None,
    }


def radius_sigma_of(found: DenseWall, summary: dict[str, Any]) -> Floats:
    """(rows, columns): sigma of a cell's distance from the axis: its own, and what radius_sigmas tells of all; NaN
    where that tells nothing."""
    shared = radius_sigmas(summary)
    if shared["radius_sigma"] is None and shared["scale_sigma"] is None:
        return np.full_like(found.sigma, np.nan)
    of_scale = (shared["scale_sigma"] or 0.0) * found.wall.mean_radius
    return np.sqrt(found.sigma**2 + (shared["radius_sigma"] or 0.0) ** 2 + of_scale**2)


def document_of(
    maps: list[DenseWall], strips: list[Strip], unit: str, summary: dict[str, Any], reconstruction: str = ""
) -> dict[str, Any]:
    """The document of dense.json; summary: that of reconstruction.json; reconstruction: its fingerprint."""
    regions = []
    for n, (found, strip) in enumerate(zip(maps, strips, strict=True)):
        for r in found.regions:
            place = {
                "piece": n,
                "chainage": strip.origin + strip.sign * r["s"],
                "kind": "inwards" if r["height"] < 0 else "outwards",
            }
            regions.append(place | r | {"clock_text": clock_text(r["clock"])})
    steps = []
    for n, (found, strip) in enumerate(zip(maps, strips, strict=True)):
        for r in found.steps[:: strip.sign]:
            way = 0.0 if strip.sign > 0 else math.pi  # what follows by chainage is what comes before by s
            clock = (r["clock"] + way) % (2 * math.pi)
            place = {"piece": n, "chainage": strip.origin + strip.sign * r["s"]}
            found_there = {"clock": clock, "widening": strip.sign * r["widening"], "clock_text": clock_text(clock)}
            steps.append(place | r | found_there)
    cracks = []
    for n, (found, strip) in enumerate(zip(maps, strips, strict=True)):
        for r in found.cracks:
            path = [[strip.origin + strip.sign * s, clock] for s, clock in r["path"]]
            place = {"piece": n, "chainage": strip.origin + strip.sign * r["s"]}
            cracks.append(place | r | {"path": path, "clock_text": clock_text(r["clock"])})
    values = np.concatenate([f.deviation[np.isfinite(f.deviation)] for f in maps])
    sigmas = np.concatenate([f.sigma[np.isfinite(f.deviation)] for f in maps])
    return plain(
        {
            "format": FORMAT,
            "version": VERSION,
            "reconstruction": reconstruction,
            "unit": unit,
            "cells": sum(f.deviation.size for f in maps),
            "measured": len(values),
            "coverage": float(np.mean([f.coverage for f in maps])) if maps else 0.0,
            "cell": maps[0].wall.length / len(maps[0].s) if maps else None,
            "pairs": sum(f.pairs_used for f in maps),
            "deviation_p05_p50_p95": np.percentile(values, [5, 50, 95]) if len(values) else None,
            "sigma_median": float(np.median(sigmas)) if len(sigmas) else None,
            **radius_sigmas(summary),
            "regions": regions,
            "steps": steps,
            "cracks": sorted(cracks, key=lambda c: -c["length"]),
        }
    )


def write_dense(
    folder: Path,
    maps: list[DenseWall],
    strips: list[Strip],
    unit: str,
    summary: dict[str, Any],
    reconstruction: str = "",
) -> tuple[dict[str, Any], list[str]]:
    """Writes dense.json, findings.csv, and of each piece dense.npz, deviation.csv, sigma.csv, dense.png, dense.ply
    (from the second piece on with its number). Returns the document and the paths. Raises OSError."""
    from PIL import Image

    factor, length = (1000.0, "mm") if unit == "metre" else (1.0, "diameters")
    contents: dict[str, bytes] = {}
    for n, (found, strip) in enumerate(zip(maps, strips, strict=True)):
        end = "" if n == 0 else f"-{n + 1}"
        chainage = strip.origin + strip.sign * found.s
        packed, picture = io.BytesIO(), io.BytesIO()
        arrays = {"deviation": found.deviation, "sigma": found.sigma, "pairs": found.pairs}
        arrays["sigma_radius"] = radius_sigma_of(found, summary)
        np.savez_compressed(
            packed,
            chainage=chainage,
            s=found.s,
            clock=found.clock,
            brightness=found.brightness,
            points=found.points,
            **arrays,
        )
        Image.fromarray(map_picture(found, chainage, unit)).save(picture, "PNG")
        contents[f"dense{end}.npz"] = packed.getvalue()
        corner = f"chainage / clock ({length})"
        contents[f"deviation{end}.csv"] = _table(corner, chainage, found.clock, factor * found.deviation)
        contents[f"sigma{end}.csv"] = _table(corner, chainage, found.clock, factor * found.sigma)
        contents[f"dense{end}.png"] = picture.getvalue()
        contents[f"dense{end}.ply"] = cloud(found, unit, arrays["sigma_radius"])
    document = document_of(maps, strips, unit, summary, reconstruction)
    contents["findings.csv"] = findings_table(findings_of(document))
    document["files"] = [*contents, "dense.json"]
    contents["dense.json"] = json.dumps(document).encode()  # last: what is there is whole
    folder.mkdir(parents=True, exist_ok=True)
    for file, data in contents.items():
        write_atomically(folder / file, data)
    return document, [str(folder / file) for file in contents]
