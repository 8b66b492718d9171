"""Pictures and files of quasi-dense matches: what `pipefish match` reads and writes."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import FormatError
from .files import opened_picture, write_atomically
from .matching import Matches, Seeds, grey

COLUMNS = ("x1", "y1", "x2", "y2", "a11", "a12", "a21", "a22", "zncc")


def read_pixels(path: str | os.PathLike[str]) -> NDArray[np.generic]:
    """A picture as (H,W,3) uint8; (H,W) uint16 or float32 where it is that. Raises FormatError, OSError."""
    with opened_picture(path) as opened:
        if opened.mode.startswith("I;16") or opened.mode == "F":
            return np.asarray(opened)
        if opened.mode == "I":  # what some files of 16 bits are read as
            return _of_16_bits(np.asarray(opened), path)
        return np.asarray(opened.convert("RGB"))


def _of_16_bits(pixels: NDArray[np.int32], path: str | os.PathLike[str]) -> NDArray[np.uint16]:
    if pixels.min() < 0 or pixels.max() > 65535:
        raise FormatError(path, None, f"values of {pixels.min()} to {pixels.max()}: more than 16 bits are not read")
    return pixels.astype(np.uint16)


def read_grey(path: str | os.PathLike[str]) -> NDArray[np.float32]:
    """A picture as (H,W) float32 of 0..1. Raises FormatError, OSError."""
    pixels = read_pixels(path)
    try:
        return grey(pixels, "picture")
    except ValueError as error:
        raise FormatError(path, None, str(error)) from None


def numbers(path: str | os.PathLike[str]) -> list[tuple[int, list[float]]]:
    """Rows of numbers, separated by commas or blanks, with their line. A first line of words is a heading.

    Raises FormatError with the line, OSError."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise FormatError(path, None, "not text") from None
    rows: list[tuple[int, list[float]]] = []
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        try:
            values = [float(word) for word in words]
        except ValueError:
            if rows or number > 1:
                raise FormatError(path, f"line {number}", "not numbers") from None
            continue
        if values:
            rows.append((number, values))
    return rows


def read_seeds(path: str | os.PathLike[str]) -> Seeds:
    """Seeds, a row each: x1 y1 x2 y2, or with the map a11 a12 a21 a22 behind. Raises FormatError, OSError."""
    rows = numbers(path)
    for number, row in rows:
        if len(row) not in (4, 8) or len(row) != len(rows[0][1]):
            raise FormatError(path, f"line {number}", f"{len(row)} numbers; each row needs 4, or each 8")
    if not rows:
        raise FormatError(path, None, "no seeds")
    values = np.array([row for _, row in rows])
    return Seeds(values[:, :2], values[:, 2:4], values[:, 4:].reshape(-1, 2, 2) if values.shape[1] == 8 else None)


def read_pose(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """cam2_from_cam1 (3,4): twelve numbers, row by row. Raises FormatError, OSError."""
    values = [v for _, row in numbers(path) for v in row]
    if len(values) != 12:
        raise FormatError(path, None, f"{len(values)} numbers; a pose [R | t] has 12")
    return np.array(values).reshape(3, 4)


def colours(xy: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float32]:
    """(K,3) of 0..1: a colour for each place, so that the same colour in two pictures is the same thing."""
    u, v = xy[:, 0] / shape[1], xy[:, 1] / shape[0]
    stripes = 0.75 + 0.25 * np.sign(np.sin(u * 60) * np.sin(v * 60 * shape[0] / shape[1]))
    rgb = np.stack([u, v, 1 - 0.5 * (u + v)], axis=1) * stripes[:, None]
    return rgb.astype(np.float32)


def draw_matches(image1: NDArray[np.float32], image2: NDArray[np.float32], m: Matches) -> NDArray[np.uint8]:
    """(H,W,3): both images side by side, each match in one colour in both; what has no match stays grey and dark."""
    paint = colours(m.xy1, m.shape1)
    sides = []
    for image, xy in ((image1, m.xy1), (image2, m.xy2)):
        out = np.repeat(0.45 * image[..., None], 3, axis=2)
        x, y = np.clip(np.rint(xy).astype(int), 0, np.array(image.shape[::-1]) - 1).T
        out[y, x] = 0.5 * image[y, x, None] + 0.6 * paint
        sides.append(out)
    height = max(s.shape[0] for s in sides)
    padded = [np.pad(s, ((0, height - s.shape[0]), (0, 0), (0, 0))) for s in sides]
    gap = np.ones((height, 4, 3), np.float32)
    return (255 * np.clip(np.concatenate([padded[0], gap, padded[1]], axis=1), 0, 1)).astype(np.uint8)


def warp(image1: NDArray[np.float32], image2: NDArray[np.float32], m: Matches) -> NDArray[np.uint8]:
    """(H,W,3) in the frame of image 1: image 1 in red, image 2 brought there by the matches in green and blue, so that
    what fits is grey. Without a match: image 1, dark."""
    out = np.repeat(0.3 * image1[..., None], 3, axis=2)
    xy = np.clip(m.xy2, 0, np.array(m.shape2[::-1]) - 1.001)
    i, f = xy.astype(int), xy - xy.astype(int)
    top = image2[i[:, 1], i[:, 0]] * (1 - f[:, 0]) + image2[i[:, 1], i[:, 0] + 1] * f[:, 0]
    bottom = image2[i[:, 1] + 1, i[:, 0]] * (1 - f[:, 0]) + image2[i[:, 1] + 1, i[:, 0] + 1] * f[:, 0]
    x, y = m.xy1.astype(int).T
    other = top * (1 - f[:, 1]) + bottom * f[:, 1]
    out[y, x] = np.stack([image1[y, x], other, other], axis=1)
    return (255 * np.clip(out, 0, 1)).astype(np.uint8)


def statistics(m: Matches) -> dict[str, Any]:
    """What can be said of matches without the truth."""
    n = len(m)
    scale = np.sqrt(np.abs(np.linalg.det(m.affine)))
    share = n / (m.shape1[0] * m.shape1[1])
    spread = {"p05": 5, "median": 50, "p95": 95}
    return {
        "status": m.status,
        "matches": n,
        "share_of_image1": share,
        "seeds": len(m.seeds),
        "seeds_that_grew": int((np.bincount(m.seed) > 1).sum()) if n else 0,
        "zncc": {k: float(np.percentile(m.zncc, q)) for k, q in spread.items()} if n else None,
        "scale": {k: float(np.percentile(scale, q)) for k, q in spread.items()} if n else None,
        "at_border_share": m.counts["at_border"] / max(m.counts["grown"], 1),  # filters leave both as they are
        "counts": {k: int(v) for k, v in m.counts.items()},
    }


def png(picture: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG", compress_level=3)
    return stream.getvalue()


def write_matches(
    folder: str | os.PathLike[str], image1: NDArray[np.float32], image2: NDArray[np.float32], m: Matches
) -> list[str]:
    """Writes matches.npz, matches.csv, matches.png, warped.png and statistics.json. Returns the names.

    Raises OSError."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    packed, text = io.BytesIO(), io.StringIO()
    np.savez_compressed(
        packed,
        xy1=m.xy1,
        xy2=m.xy2,
        affine=m.affine,
        zncc=m.zncc,
        parent=m.parent,
        seed=m.seed,
        seeds_xy1=m.seeds.xy1,
        seeds_xy2=m.seeds.xy2,
    )
    rows = np.concatenate([m.xy1, m.xy2, m.affine.reshape(-1, 4), m.zncc[:, None]], axis=1)
    np.savetxt(text, rows, "%d,%d,%.3f,%.3f,%.5f,%.5f,%.5f,%.5f,%.4f", header=",".join(COLUMNS), comments="")
    contents = {
        "matches.npz": packed.getvalue(),
        "matches.csv": text.getvalue().encode(),
        "matches.png": png(draw_matches(image1, image2, m)),
        "warped.png": png(warp(image1, image2, m)),
        "statistics.json": json.dumps(statistics(m), indent=1).encode(),
    }
    for name, data in contents.items():
        write_atomically(folder / name, data)
    return [str(folder / name) for name in contents]
