"""Pictures of simulated scenes to look at: `pipefish simulate --picture` and `--contact-sheet`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.errors import PipefishError
from pipefish.progress import track
from pipefish.simulate import Scene, scenarios, studio_scene


def picture(
    scene: str | os.PathLike[str],
    path: Path,
    frame: int | None = None,
    width: int = 480,
    changes: dict[str, Any] | None = None,
) -> None:
    """Writes one frame of a scene [at three quarters of the drive], shrunk to `width` pixels if it is wider; what kind
    of picture, the name's end says. Raises FormatError, PipefishError, OSError."""
    if (studio := studio_scene(scene, changes)) is not None:
        from pipefish.studio_files import thumbnail

        _save(_shrunk(thumbnail(*studio, frame or 0), width), Path(path))
        return
    made = Scene.load(scene, changes)
    frame = made.frames * 3 // 4 if frame is None else frame
    if not 0 <= frame < made.frames:
        raise PipefishError(f"there is no frame {frame}: the scene has {made.frames}")
    _save(_thumbnail(made, frame, width), Path(path))


def contact_sheet(path: Path, names: list[str] | None = None, width: int = 400, quiet: bool = False) -> None:
    """Writes one picture with a frame of each of the scenarios [all]. Raises PipefishError, OSError."""
    from PIL import Image, ImageDraw, ImageFont

    names = names or list(scenarios())
    columns, line = 4, 22
    made = []
    for name in track(names, "drawing", len(names), quiet):
        scene = Scene.load(name)
        made.append(_thumbnail(scene, scene.frames * 3 // 4, width))
    height = max(image.height for image in made) + line
    sheet = Image.new("L", (columns * width, -(-len(made) // columns) * height))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for i, (name, image) in enumerate(zip(names, made, strict=True)):
        x, y = i % columns * width, i // columns * height
        sheet.paste(image, (x + (width - image.width) // 2, y + line))
        draw.text((x + 6, y + 2), name, fill=255, font=font)
    _save(sheet, Path(path))


def _thumbnail(scene: Scene, frame: int, width: int) -> Any:
    grey = scene.render(frame)
    return _shrunk(grey if grey.dtype == np.uint8 else (grey >> 2).astype(np.uint8), width)


def _shrunk(grey: np.ndarray, width: int) -> Any:
    from PIL import Image

    image = Image.fromarray(grey)
    width = min(width, image.width)
    return image.resize((width, round(image.height * width / image.width)), Image.Resampling.BOX)


def _save(image: Any, path: Path) -> None:
    partial = path.with_name(f"{path.stem}.partial{path.suffix}")
    try:
        image.save(partial, quality=75)
        os.replace(partial, path)
    except (ValueError, KeyError):
        raise PipefishError(f"{path}: pictures end in .png, .jpg or .webp") from None
    finally:
        partial.unlink(missing_ok=True)
