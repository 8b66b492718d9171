"""Two views of textured surfaces that move and bend each in its own way and are lit anew, with the truth: labels, flow,
visibility and gain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipefish.errors import ArgumentError
from pipefish.studio import (
    Picture,
    Studio,
    Texture,
    chain,
    facing,
    listed,
    pattern,
    pose,
    random,
    raster,
    room,
    room_textures,
    rotation,
)

MOTIONS = ("rigid", "affine", "bend", "mixed", "none")
BACKGROUNDS = ("moves", "still", "unrelated")


@dataclass
class TwoViews:
    """Two pictures of the same sheets and the truth about them. Label 0 is the background, k the k-th layer."""

    studio: Studio
    pictures: tuple[Picture, Picture]
    images: tuple[np.ndarray, np.ndarray]  # (H, W) uint8, or uint16 of 10 bits
    layer_of: np.ndarray  # (sheets,) label of each sheet of the pictures
    common: bool  # whether the background of both is the same

    def labels(self, view: int) -> np.ndarray:
        """(H, W) uint8 of picture 0 or 1, at the pixels' centres."""
        sheet = self.studio.look(self.pictures[view], self.studio.pixels()).sheet
        return self._label(sheet).reshape(self.studio.height, self.studio.width)

    def flow(self, view: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """From picture `view` to the other, for every pixel: where it is there (H, W, 2), NaN where nothing or not in
        the lens's field; visible (H, W); gain (H, W) of its light, NaN where not visible. A background that is not the
        same in both has no flow."""
        moved, visible, gain = self.flow_at(self.studio.pixels(), view)
        shape = (self.studio.height, self.studio.width)
        return moved.reshape(*shape, 2), visible.reshape(shape), gain.reshape(shape)

    def flow_at(self, pixels: np.ndarray, view: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for any pixels (N, 2)."""
        first, second = self.pictures[view], self.pictures[1 - view]
        moved, visible, gain = self.studio.flow(first, second, pixels)
        if not self.common:
            unknown = self._label(self.studio.look(first, pixels).sheet) == 0
            moved[unknown], visible[unknown], gain[unknown] = np.nan, False, np.nan
        return moved, visible, gain

    def _label(self, sheet: np.ndarray) -> np.ndarray:
        return np.where(sheet >= 0, self.layer_of[sheet], 0).astype(np.uint8)


def simulate_two_views(
    layers: int = 3,
    lens: dict[str, Any] | None = None,
    *,
    sensor: dict[str, Any] | None = None,
    motion: str = "mixed",
    strength: float = 1.0,
    scale: float = 1.0,
    relight: float = 1.0,
    shadows: bool = True,
    tone: dict[str, float] | None = None,
    background: str = "moves",
    textures: list[np.ndarray] | None = None,
    seed: int = 1,
    threads: int | None = None,
    samples: int = 89,
    source: str | None = None,
) -> TwoViews:
    """Two views of `layers` textured surfaces before a background.

    motion: of each layer between the views: "rigid" turns and shifts it, "affine" stretches it in its own plane too,
    "bend" bends and stretches it smoothly too, "mixed" takes the three in turn, "none". strength: how much of it.
    scale: size of the layers in the second view to the first, by distance. relight: how much the light changes: at 1 by
    a factor of 0.6 to 1.4 in a smooth field on each layer; 0: not. shadows: an edge of shadow over every second layer
    in the second view, if relit. tone: `gain`, `bias`, `gamma` of the second picture. background: "moves" with the
    camera, stands "still", or is "unrelated": other textures in the second view. textures: images (H, W) or (H, W, 3)
    for the layers; the rest is procedural. Raises ArgumentError, FormatError.
    """
    for name, value, known in (("motion", motion, MOTIONS), ("background", background, BACKGROUNDS)):
        if value not in known:
            raise ArgumentError(f"{name}: must be one of {', '.join(known)}, not {value!r}")
    if not 0 <= layers <= 12:
        raise ArgumentError(f"layers: must be within 0 and 12, not {layers}")
    studio = Studio(lens, {"seed": seed, **(sensor or {})}, source)
    given = list(textures or [])
    made: list[Texture] = [raster(given[k]) if k < len(given) else _procedural(seed, k) for k in range(layers)]
    first, second = [], []
    for k in range(layers):
        kind = ("bend", "rigid", "affine")[k % 3] if motion == "mixed" else motion
        a, b = _layer(studio, seed, k, layers, kind, strength, scale)
        if relight > 0:
            b.update(_relit(random(seed, 40 + k), relight, shadows and k % 2 == 1))
        first.append({**a, "texture": k})
        second.append({**b, "texture": k})
    made += room_textures(seed)
    if background == "unrelated":
        made += room_textures(seed + 7777)
    rng = random(seed, 30)
    here = pose(rotation(rng.uniform(-0.5, 0.5, 3)), (0, 0, 0))
    moved = pose(rotation(0.06 * rng.normal(size=3)), 0.1 * rng.normal(size=3)) if background == "moves" else None
    other = layers + (6 if background == "unrelated" else 0)
    first += room(3.0, layers, here)
    walls = room(3.0, other, chain(moved, here) if moved is not None else here)
    second += [
        {**w, **(_relit(random(seed, 60 + k), 0.5 * relight, False) if relight > 0 else {})}
        for k, w in enumerate(walls)
    ]
    light = {"ambient": 130.0, "lamps": [{"x": 0.05, "y": -0.15, "z": 0, "power": 70.0}]}
    changed = {"ambient": 120.0, "lamps": [{"x": -0.2, "y": 0.05, "z": 0, "power": 80.0}]} if relight > 0 else light
    pictures = (
        Picture({"frame": 0, "sheets": first, **light}, made, source),
        Picture({"frame": 1, "sheets": second, **changed, **(tone or {})}, made, source),
    )
    images = tuple(studio.render(p, samples, threads) for p in pictures)
    layer_of = np.array([*range(1, layers + 1), *[0] * 6])
    return TwoViews(studio, pictures, images, layer_of, background != "unrelated")  # type: ignore[arg-type]


def _procedural(seed: int, k: int) -> Texture:
    return raster(pattern(seed * 1000 + 17 * k + 5, 512, 512, contrast=0.2))


def _layer(
    studio: Studio, seed: int, k: int, layers: int, kind: str, strength: float, scale: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    """A layer's sheet in both views: shape and pose."""
    rng = random(seed, 10 + k)
    lens, table = studio.spec["lens"], studio.lens_table()
    # Spread over the picture: the first in the middle, the others around it, within the field.
    short, wide = min(studio.width, studio.height) / 2, studio.width / 2
    angle = rng.uniform(0, 0.8) + 2 * np.pi * k / max(layers - 1, 1)
    off = np.array([0.62 * min(wide, lens["circle_radius"]) * np.cos(angle), 0.55 * short * np.sin(angle)])
    off = off * (0.15 if k == 0 and layers != 2 else 1.0)
    size = rng.uniform(0.5, 0.68) * short  # pixels, half the sheet
    theta = float(np.interp(max(np.hypot(*off), lens["theta_min"] and size), table["radius_px"], table["theta"]))
    focal = table["radius_px"][1] / table["theta"][1]
    azimuth = np.arctan2(off[1], off[0])
    ray = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
    distance = rng.uniform(0.8, 1.2) * (1 + 0.1 * k)
    half = size / focal * distance
    tilt = 0.35 * rng.normal(size=2)
    turn = facing(ray, rng.uniform(-0.3, 0.3)) @ rotation((*tilt, 0))
    shape: dict[str, Any] = {
        "width": 2 * half * rng.uniform(0.9, 1.25),
        "height": 2 * half * rng.uniform(0.8, 1.1),
        "outline": "round",
        "outline_waves": [
            {"k": n, "share": float(0.3 / n * rng.uniform(0.3, 1)), "phase": float(rng.uniform(-3, 3))}
            for n in (2, 3, 5)
        ],
    }
    before, after = dict(shape), dict(shape)
    before["pose"] = listed(pose(turn, distance * ray))
    twist, shift = rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3)
    if kind == "none":
        twist, shift = 0 * twist, 0 * shift
    moved = pose(
        turn @ rotation(strength * 0.3 * twist),
        (distance * ray + strength * half * np.array([0.35, 0.35, 0.2]) * shift) / scale,
    )
    after["pose"] = listed(moved)
    if kind == "affine":
        sizes = strength * half * 0.15 * rng.uniform(-1, 1, (2, 2))
        for n, key in enumerate(("stretch_a", "stretch_b")):
            after[key] = {"powers": [_power(1, 0, sizes[n, 0]), _power(0, 1, sizes[n, 1])]}
    if kind == "bend":
        before["relief"] = {"waves": [_wave(rng, 0.05 * half)]}
        after["relief"] = {
            "waves": [*before["relief"]["waves"], _wave(rng, 0.1 * half * strength)],
            "powers": [_power(2, 0, 0.12 * half * strength * rng.uniform(-1, 1))],
        }
        for key in ("stretch_a", "stretch_b"):
            after[key] = {"waves": [_wave(rng, 0.04 * half * strength)]}
    return before, after


def _power(i: int, j: int, metres: float) -> dict[str, Any]:
    return {"i": i, "j": j, "metres": float(metres)}


def _wave(rng: np.random.Generator, metres: float) -> dict[str, float]:
    rate, angle = rng.uniform(1.5, 3.5), rng.uniform(0, 2 * np.pi)
    made = {"u_rate": rate * np.cos(angle), "v_rate": rate * np.sin(angle), "phase": rng.uniform(-3, 3)}
    return {**{key: float(value) for key, value in made.items()}, "metres": float(metres * rng.uniform(0.6, 1))}


def _relit(rng: np.random.Generator, size: float, shadow: bool) -> dict[str, Any]:
    """Keys of a sheet: a gain field of exp(+-0.35 size) or so, and an edge of shadow."""
    made: dict[str, Any] = {
        "gain": float(np.exp(0.12 * size * rng.uniform(-1, 1))),
        "light": {
            "powers": [_power(1, 0, 0.12 * size * rng.uniform(-1, 1)), _power(0, 1, 0.12 * size * rng.uniform(-1, 1))],
            "waves": [_wave(rng, 0.12 * size)],
        },
    }
    if shadow:
        angle, offset = rng.uniform(-3, 3), rng.uniform(-0.2, 0.3)
        made["shadows"] = [{"angle": float(angle), "offset": float(offset), "soft": 0.08, "share": 0.65}]
    return made
