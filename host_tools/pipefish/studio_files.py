"""`pipefish simulate` of scenes that are no pipes: a TOML file with the key `kind` becomes a folder of pictures and
truth (docs/simulator.md)."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipefish import __version__
from pipefish.errors import ArgumentError, FormatError, PipefishError
from pipefish.files import opened_picture
from pipefish.studio_objects import ObjectPicture, simulate_objects
from pipefish.studio_pairs import simulate_two_views
from pipefish.studio_targets import simulate_target_views, warp
from pipefish.target import Target

SCENARIOS = Path(__file__).with_name("scenarios") / "studio"
TRUTH_FORMAT, TRUTH_VERSION = "pipefish-studio-truth", 1

# Keys of each kind beside `kind`, `lens` and `sensor`: what they must be.
_NUMBER, _WHOLE, _TEXT, _FLAG, _TABLE, _RANGE, _FILES = (
    "number",
    "whole number",
    "text",
    "true or false",
    "table",
    "",
    "l",
)
KEYS: dict[str, dict[str, str]] = {
    "target": {
        "target": _TABLE, "board": _TABLE, "warp_m": _NUMBER, "light": _TABLE, "level": _NUMBER, "clutter": _FLAG,
        "views": _WHOLE, "seed": _WHOLE, "samples": _WHOLE,
    },
    "two-views": {
        "layers": _WHOLE, "motion": _TEXT, "strength": _NUMBER, "scale": _NUMBER, "relight": _NUMBER, "shadows": _FLAG,
        "tone": _TABLE, "background": _TEXT, "textures": _FILES, "seed": _WHOLE, "samples": _WHOLE,
    },
    "objects": {
        "objects": _WHOLE, "scenes": _WHOLE, "kinds": _FILES, "model_views": _WHOLE, "per_scene": _RANGE,
        "distractors": _WHOLE, "scale": _RANGE, "tilt": _NUMBER, "bend": _NUMBER, "relight": _NUMBER,
        "textures": _FILES, "seed": _WHOLE, "samples": _WHOLE,
    },
}  # fmt: skip


def scenarios() -> dict[str, Path]:
    """The built-in scenes that are no pipes: name -> file."""
    return {path.stem: path for path in sorted(SCENARIOS.glob("*.toml"))}


def checked(scene: dict[str, Any], path: Path | None) -> dict[str, Any]:
    """The scene, its keys known and of their kinds, images of `textures` read. Raises FormatError."""
    kind = scene.get("kind")
    if kind not in KEYS:
        raise FormatError(path, "kind", f"must be one of {', '.join(KEYS)}, not {kind!r}")
    known = {"kind": _TEXT, "lens": _TABLE, "sensor": _TABLE, **KEYS[kind]}
    made = dict(scene)
    for key, value in scene.items():
        if key not in known:
            raise FormatError(path, key, f"unknown; known are {', '.join(known)}")
        want = known[key]
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if want == _RANGE:
            good = isinstance(value, list) and len(value) == 2 and all(isinstance(x, int | float) for x in value)
            want = "[least, most]"
            made[key] = tuple(value) if good else value
        elif want == _FILES:
            good = isinstance(value, list) and all(isinstance(x, str) for x in value)
            want = "a list of texts"
            made[key] = tuple(value) if good else value
        else:
            types = {_TEXT: str, _FLAG: bool, _TABLE: dict}
            good = number if want == _NUMBER else isinstance(value, types.get(want, int))
            good = good and (want != _WHOLE or (number and value >= 0))
        if not good:
            raise FormatError(path, key, f"must be {want}, not {value!r}")
    if "textures" in made:
        made["textures"] = [_read_image(path, name) for name in made["textures"]]
    return made


def _read_image(path: Path | None, name: str) -> np.ndarray:
    with opened_picture((path.parent if path else Path()) / name) as image:
        return np.asarray(image.convert("L"))


def simulate_studio(
    scene: dict[str, Any],
    folder: Path,
    *,
    path: Path | None = None,
    count: int | None = None,
    seed: int | None = None,
    threads: int | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Draws a scene with a `kind` into a folder, which is complete or not there; one that was made so before is
    replaced.

    path: the scene's file, for errors and textures. count: of a target's views or of scenes, instead of the scene's
    own. seed: likewise. Returns what was written. Raises FormatError, PipefishError, OSError."""
    keys = checked(scene, path)
    kind = keys.pop("kind")
    if seed is not None:
        keys["seed"] = seed
    if count is not None:
        if kind == "two-views":
            raise PipefishError("two views are two: --frames is for targets and objects")
        keys["views" if kind == "target" else "scenes"] = count
    if folder.exists() and not (folder / "truth.json").is_file():
        raise PipefishError(f"{folder}: is there and is no folder of simulated pictures")
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    draw: dict[str, Callable[..., tuple[dict[str, Any], int]]] = {
        "target": _target,
        "two-views": _two_views,
        "objects": _objects,
    }
    try:
        truth, pictures = draw[kind](keys, partial, path, threads=threads, quiet=quiet)
        truth = {
            "format": TRUTH_FORMAT,
            "version": TRUTH_VERSION,
            "software": f"pipefish {__version__}",
            "kind": kind,
        } | truth
        (partial / "truth.json").write_text(json.dumps(truth) + "\n", encoding="utf-8")
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(partial, folder)
    except ArgumentError as error:
        where, _, what = str(error).partition(": ")
        raise FormatError(path, where, what) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    lens = truth["camera"]["lens"]
    return {"pictures": pictures, "width": lens["width"], "height": lens["height"], "files": [str(folder)]}


def thumbnail(scene: dict[str, Any], path: Path | None, number: int) -> np.ndarray:
    """One picture of a scene (H, W) uint8: that view of a target [of 3], both views side by side, that scene."""
    keys = checked(scene, path)
    kind = keys.pop("kind")
    try:
        if kind == "target":
            image = _views(keys, path, number + 1)[0][number].image
        elif kind == "two-views":
            image = np.hstack(simulate_two_views(**keys, source=path).images)
        else:
            image = simulate_objects(**{**keys, "scenes": number + 1}, source=path).scenes[number].image
    except ArgumentError as error:
        where, _, what = str(error).partition(": ")
        raise FormatError(path, where, what) from None
    return image if image.dtype == np.uint8 else (image >> 2).astype(np.uint8)


def _save(image: np.ndarray, file: Path) -> None:
    from PIL import Image

    Image.fromarray(image).save(file)


def _views(keys: dict[str, Any], path: Path | None, count: int | None, **more: Any) -> tuple[list[Any], dict[str, Any]]:
    keys = dict(keys)
    if "target" not in keys:
        raise FormatError(path, "target", "missing")
    try:
        target = Target.from_dict(keys.pop("target"))
    except ArgumentError as error:
        where, _, what = str(error).partition(": ")
        raise FormatError(path, f"target.{where}", what) from None
    bent, views = keys.pop("warp_m", 0.0), keys.pop("views", 12)
    if bent:
        keys["board"] = warp(target, keys.get("seed", 1), bent) | keys.get("board", {})
    return simulate_target_views(target, poses=count or views, source=path, **keys, **more)


def _target(keys: dict[str, Any], folder: Path, path: Path | None, **more: Any) -> tuple[dict[str, Any], int]:
    views, truth = _views(keys, path, None, **more)
    for k, (view, entry) in enumerate(zip(views, truth["views"], strict=True)):
        entry["file"] = f"{k:03d}.png"
        _save(view.image, folder / entry["file"])
    return truth, len(views)


def _two_views(
    keys: dict[str, Any], folder: Path, path: Path | None, threads: int | None, quiet: bool
) -> tuple[dict[str, Any], int]:
    pair = simulate_two_views(**keys, source=path, threads=threads)
    for k, name in enumerate(("a", "b")):
        _save(pair.images[k], folder / f"{name}.png")
        _save(pair.labels(k), folder / f"labels_{name}.png")
        moved, visible, gain = pair.flow(k)
        at = np.stack(np.meshgrid(np.arange(pair.studio.width), np.arange(pair.studio.height)), -1)
        file = folder / f"flow_{name}.npz"
        np.savez_compressed(file, flow=(moved - at).astype(np.float32), visible=visible, gain=gain.astype(np.float32))
    return {
        "images": ["a.png", "b.png"],
        "labels": ["labels_a.png", "labels_b.png"],
        "flow": ["flow_a.npz", "flow_b.npz"],
        "layer_of_sheet": pair.layer_of.tolist(),
        "pictures": [p.spec for p in pair.pictures],
        "camera": pair.studio.spec,
        "lens": pair.studio.lens_table(),
    }, 2


def _objects(
    keys: dict[str, Any], folder: Path, path: Path | None, threads: int | None, quiet: bool
) -> tuple[dict[str, Any], int]:
    made = simulate_objects(**keys, source=path, threads=threads, quiet=quiet)

    def write(picture: ObjectPicture, name: str) -> dict[str, Any]:
        _save(picture.image, folder / f"{name}.png")
        _save(picture.labels, folder / f"{name}_labels.png")
        found = [
            {"object": k, "box": picture.boxes.get(k), "shown": picture.shown[k], "cam_from_object": p[:3].tolist()}
            for k, p in sorted(picture.poses.items())
        ]
        return {"file": f"{name}.png", "labels": f"{name}_labels.png", "objects": found}

    models = [[write(p, f"model_{k + 1:02d}_{v}") for v, p in enumerate(views)] for k, views in enumerate(made.models)]
    scenes = [write(p, f"scene_{n:03d}") for n, p in enumerate(made.scenes)]
    camera = {"camera": made.studio.spec, "lens": made.studio.lens_table()}
    return {"kinds": made.kinds, "models": models, "scenes": scenes, **camera}, sum(map(len, models)) + len(scenes)
