"""Files and pictures of motion segmentation: what `pipefish segment` writes."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .files import write_atomically
from .matching_files import png
from .segmentation import Floats32, Layer, Motion, Segmentation

COLOURS = np.array(
    [(0, 0, 0), (230, 60, 50), (60, 170, 255), (70, 210, 80), (255, 190, 30), (200, 100, 255), (40, 220, 210)],
    np.uint8,
)
MESH = 16  # pixels between the lines of a mesh
HEADING = 16  # pixels
LINE = (20, 20, 20)
README = """\
What `pipefish segment` wrote about two pictures, A and B (1 and 2 in the names). Look at segmentation.png first.

segmentation.png          all at a glance: a row for each picture: itself, its layers with their numbers, their fields
labels1.png, labels2.png  the layer of each pixel of A and of B; 0 is the background: what only one picture shows
layers.json               of each layer: how it moved, how large it is, how sure; and how the search went

A folder for each layer, layer_1 being the largest:
flow.npz                  flow1: where B has each pixel of A (x, y; NaN where it cannot be); flow2: the other way
light.npz                 colour in A = gain1 * colour in B + offset1, pixel by pixel; gain2, offset2: the other way
warped1.png               B brought into A, in A's light, cut out; warped2.png: A brought into B
residual1.png             A less warped1.png, four times, around grey; residual2.png: the same of B
"""
#: What lies in the folder of a layer.
LAYER_FILES = ("flow.npz", "light.npz", "warped1.png", "residual1.png", "warped2.png", "residual2.png")
Bytes = NDArray[np.uint8]


def colour_of(label: NDArray[np.integer]) -> Bytes:
    """(...,3) of labels; 0 is black, colours come again from the seventh layer on."""
    last = len(COLOURS) - 1
    return COLOURS[np.where(label > 0, (label.astype(int) - 1) % last + 1, 0)]


def _bytes(image: Floats32) -> Bytes:
    """(H,W,3) uint8 of (H,W,C) floats; what is not a number is black."""
    wide = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image
    return (255 * np.clip(np.nan_to_num(wide), 0, 1) + 0.5).astype(np.uint8)


def _rows(planes: Floats32) -> Floats32:
    return np.moveaxis(planes, 0, -1)


def _side(layer: Layer, name: str, picture: int) -> Any:
    return getattr(layer, f"{name}{picture}")


def draw_labels(labels: Bytes) -> bytes:
    """PNG whose values are the labels, with a palette of their colours."""
    from PIL import Image

    picture = Image.fromarray(labels)
    picture.putpalette(colour_of(np.arange(256)).ravel().tolist())
    out = io.BytesIO()
    picture.save(out, "PNG")
    return out.getvalue()


def draw_cut(image: Floats32, labels: Bytes) -> Bytes:
    """(H,W,3): the layers of a picture cut out, on white, each with an outline in its colour."""
    out = _bytes(image)
    out[labels == 0] = 255
    edge = np.zeros(labels.shape, bool)
    for step in (1, 2):  # two pixels, inside the layer
        for axis, way in ((0, step), (0, -step), (1, step), (1, -step)):
            edge |= np.roll(labels, way, axis) != labels
    edge &= labels > 0
    out[edge] = colour_of(labels)[edge]
    return out


def _number(picture: Bytes, labels: Bytes) -> Bytes:
    """The picture with the number of each layer on it, in its colour: on its pixel nearest to the middle of them."""
    from PIL import Image, ImageDraw

    drawn = Image.fromarray(picture)
    draw = ImageDraw.Draw(drawn)
    for k in range(1, int(labels.max(initial=0)) + 1):
        at = np.argwhere(labels == k)
        if len(at):
            y, x = map(int, at[np.abs(at - np.median(at, axis=0)).sum(axis=1).argmin()])
            ink = tuple(map(int, colour_of(np.array(k))))
            box = draw.textbbox((x, y), str(k), anchor="mm")
            draw.rectangle((box[0] - 3, box[1] - 3, box[2] + 3, box[3] + 3), fill=(255, 255, 255), outline=ink)
            draw.text((x, y), str(k), fill=(0, 0, 0), anchor="mm")
    return np.asarray(drawn)


def _heading(widths: list[int]) -> Bytes:
    """(HEADING, sum of widths, 3): what the columns show."""
    from PIL import Image, ImageDraw

    drawn = Image.new("RGB", (sum(widths), HEADING), (255, 255, 255))
    texts = ("picture", "layers, with their numbers", "the other picture's mesh, and its light: grey as it looks here")
    for k, text in enumerate(texts):
        ImageDraw.Draw(drawn).text((sum(widths[:k]) + 3, 2), text, fill=(0, 0, 0))
    return np.asarray(drawn)


def draw_fields(s: Segmentation, picture: int) -> Bytes:
    """(H,W,3) of picture 1 or 2: how each layer's light makes grey of the other picture look here, over the grey of the
    background, and the regular mesh of the other picture as the layer's geometry has it here."""
    from PIL import Image, ImageDraw

    labels = s.labels1 if picture == 1 else s.labels2
    canvas = np.full((*labels.shape, 3), 128, np.uint8)
    for k, layer in enumerate(s.layers, 1):
        on = labels == k
        canvas[on] = _bytes(0.5 * _side(layer, "gain", picture) + _side(layer, "offset", picture))[on]
    drawn = Image.fromarray(canvas)
    draw = ImageDraw.Draw(drawn)
    for k, layer in enumerate(s.layers, 1):
        _draw_mesh(
            draw, _side(layer, "flow", 3 - picture), (s.labels2 if picture == 1 else s.labels1) == k, labels == k
        )
    return np.asarray(drawn)


def _draw_mesh(draw: Any, flow: Floats32, there: NDArray[np.bool_], here: NDArray[np.bool_]) -> None:
    """Lines of the other picture's rows and columns, carried here by `flow`; where both pictures have the layer."""
    height, width = there.shape
    lines = [(np.full(width, y), np.arange(width)) for y in range(MESH // 2, height, MESH)]
    lines += [(np.arange(height), np.full(height, x)) for x in range(MESH // 2, width, MESH)]
    for y, x in lines:
        at = flow[y, x]
        on = there[y, x] & np.isfinite(at).all(axis=1)
        i, j = np.clip(np.rint(np.nan_to_num(at[:, ::-1])).astype(int), 0, np.array(here.shape) - 1).T
        on &= here[i, j]
        for piece in np.split(np.flatnonzero(on), np.flatnonzero(np.diff(np.flatnonzero(on)) > 1) + 1):
            if len(piece) > 1:
                draw.line([tuple(map(float, p)) for p in at[piece]], fill=LINE)


def draw_overview(one: Floats32, two: Floats32, s: Segmentation) -> Bytes:
    """(H,W,3): a heading, and a row for each picture: the picture, its layers cut out, and their fields."""
    rows = []
    for picture, planes, labels in ((1, one, s.labels1), (2, two, s.labels2)):
        parts = [_bytes(_rows(planes)), _number(draw_cut(_rows(planes), labels), labels), draw_fields(s, picture)]
        gap = np.full((labels.shape[0], 6, 3), 255, np.uint8)
        rows.append(np.concatenate([parts[0], gap, parts[1], gap, parts[2]], axis=1))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(r, ((0, 6), (0, width - r.shape[1]), (0, 0)), constant_values=255) for r in rows]
    column = width // 3
    return np.concatenate([_heading([column, column, width - 2 * column]), *padded])


def motion_text(m: Motion | None) -> str:
    """A layer's motion for people."""
    if m is None:
        return "moved nobody knows how far: no pixel of picture 1 is left"
    ways = [(abs(m.right), "right" if m.right > 0 else "left"), (abs(m.down), "down" if m.down > 0 else "up")]
    parts = " and ".join(f"{size:.1f} px {way}" for size, way in ways)
    turn = math.degrees(m.rotation)
    return (
        f"moved {m.distance:.1f} px ({parts}), turned {abs(turn):.1f}° {'' if turn > 0 else 'counter-'}clockwise, "
        f"{m.scale:.2f} times as large"
    )


def _motion(m: Motion | None) -> dict[str, float] | None:
    if m is None:
        return None
    sizes = {"right_px": m.right, "down_px": m.down, "distance_px": m.distance}
    sizes |= {"rotation_deg": math.degrees(m.rotation), "scale": m.scale}
    return {name: round(value, 4) for name, value in sizes.items()}


def document(s: Segmentation) -> dict[str, Any]:
    """For JSON: status, layers, energies."""
    names = ("area", "sigma", "zncc", "folds", "low_evidence", "ambiguous")
    layers = [
        {"label": k, "motion": _motion(s.motion(k)), "groups": layer.groups, "claimed": layer.claimed}
        | {f"{name}{p}": round(_side(layer, name, p), 5) for name in names for p in (1, 2)}
        for k, layer in enumerate(s.layers, 1)
    ]
    trace = [{"step": step, "energy": round(energy, 3), "layers": layers} for step, energy, layers in s.trace]
    return {"status": s.status, "layers": layers, "trace": trace}


def _arrays(**arrays: NDArray[Any]) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def _forget_layers(folder: Path, kept: int) -> None:
    """Removes the layers beyond so many that an earlier run left: they are not of these pictures. What else lies in
    their folders stays."""
    for old in folder.glob("layer_*"):
        number = old.name.removeprefix("layer_")
        if not (number.isdecimal() and int(number) > kept and old.is_dir()):
            continue
        for name in LAYER_FILES:
            (old / name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # it holds something else
            old.rmdir()


def write_segmentation(folder: str | os.PathLike[str], one: Floats32, two: Floats32, s: Segmentation) -> list[str]:
    """Writes a segmentation of pictures (C,H,W): README.txt, which tells what each file is, labels1.png,
    labels2.png, segmentation.png, layers.json, and for each layer a folder layer_1, layer_2, ... with flow.npz,
    light.npz, and warped and residual pictures; layers of an earlier run are removed. Returns the names. Raises
    OSError."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _forget_layers(folder, len(s.layers))
    contents = {
        "README.txt": README.encode(),
        "labels1.png": draw_labels(s.labels1),
        "labels2.png": draw_labels(s.labels2),
        "segmentation.png": png(draw_overview(one, two, s)),
        "layers.json": json.dumps(document(s), indent=1).encode(),
    }
    for k, layer in enumerate(s.layers, 1):
        contents[f"layer_{k}/flow.npz"] = _arrays(flow1=layer.flow1, flow2=layer.flow2)
        light = {f"{name}{p}": _side(layer, name, p) for name in ("gain", "offset") for p in (1, 2)}
        contents[f"layer_{k}/light.npz"] = _arrays(**light)
        for p, planes, labels in ((1, one, s.labels1), (2, two, s.labels2)):
            warped = np.where((labels == k)[..., None], _side(layer, "warped", p), np.nan)
            residual = np.where(np.isnan(warped), 0.5, 0.5 + 4 * (_rows(planes) - warped)).astype(np.float32)
            alpha = np.where(labels == k, 255, 0).astype(np.uint8)
            contents[f"layer_{k}/warped{p}.png"] = png(np.dstack([_bytes(warped), alpha]))
            contents[f"layer_{k}/residual{p}.png"] = png(_bytes(residual))
    for name, data in contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        write_atomically(folder / name, data)
    return [str(folder / name) for name in contents]
