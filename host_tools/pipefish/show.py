"""Pictures of a survey: a keyframe with its tracks drawn, and a short animation."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pipefish.colours import AGE_MAX, QUALITY_LOW, age_position, quality_position, scale_colours
from pipefish.errors import PipefishError
from pipefish.files import write_atomically
from pipefish.progress import track as progress_over
from pipefish.scene import states_of
from pipefish.survey import Keyframe, Survey, Tracks

SUPERSAMPLE = 2  # lines are drawn so much larger and then reduced: smooth edges
TRAIL = 8  # keyframes that a trail reaches back
ANIMATION_LIMIT = 10 << 20  # bytes
ANIMATION_FRAMES = 80
ANIMATION_WIDTH = 560  # pixels
FRAME_MS = 120

BACKGROUND, TEXT, MUTED = (17, 19, 24), (236, 238, 242), (150, 156, 168)
ALERT = (255, 190, 90)


@dataclass
class Style:
    """Sizes in pixels of the finished picture."""

    width: int
    legend: bool = True
    line: float = 1.8
    dot: float = 2.6
    colour: str = "age"  # or "quality"


class Painter:
    """Draws the keyframes of one survey."""

    def __init__(self, survey: Survey) -> None:
        """Raises PipefishError if there is nothing to draw."""
        if not survey.keyframes:
            raise PipefishError(f"{survey.path}: no keyframes to show")
        self.survey = survey
        self.tracks: Tracks = survey.tracks()
        self.chainage = survey.chainage()
        order = np.lexsort((self.tracks.track, self.tracks.frame))
        self._order = order
        self._frames = self.tracks.frame[order]

    def _trails(self, frame: Keyframe, colour: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(pixels (M,2), colours (M,3)) of each track seen in `frame`, oldest first, as far back as a trail reaches."""
        low, high = np.searchsorted(self._frames, [frame.index - TRAIL, frame.index + 1])
        items = np.sort(self._order[low:high])
        track = self.tracks.track[items]
        for part in np.split(items, np.flatnonzero(np.diff(track)) + 1):
            if len(part) and self.tracks.frame[part[-1]] == frame.index:
                position = age_position(self.tracks.age[part])
                if colour == "quality":  # a new track has none yet
                    position = np.where(
                        self.tracks.age[part] > 0, quality_position(self.tracks.quality[part]), position
                    )
                yield self.tracks.pixels[part], scale_colours(position)

    def draw(self, position: int, style: Style) -> Image.Image:
        """The keyframe at `position` of survey.keyframes with its tracks: trails of the last few, coloured by age."""
        frame = self.survey.keyframes[position]
        picture = frame.image
        scale = style.width / picture.width
        size = (style.width, round(picture.height * scale))
        grey = picture.resize(size, Image.Resampling.LANCZOS).point([int(v * 0.82) for v in range(256)])
        base = Image.merge("RGB", (grey, grey, grey))
        factor = scale * SUPERSAMPLE
        layer = Image.new("RGBA", (size[0] * SUPERSAMPLE, size[1] * SUPERSAMPLE), (0, 0, 0, 0))
        pen = ImageDraw.Draw(layer)
        dots = []
        for pixels, colours in self._trails(frame, style.colour):
            points = (pixels + 0.5) * factor
            for i in range(1, len(points)):
                alpha = int(255 * (0.25 + 0.65 * i / (len(points) - 1)))
                line = [tuple(points[i - 1]), tuple(points[i])]
                pen.line(line, fill=(*map(int, colours[i]), alpha), width=max(1, round(style.line * SUPERSAMPLE)))
            dots.append((points[-1], tuple(map(int, colours[-1]))))
        radius = style.dot * SUPERSAMPLE
        for (x, y), colour in dots:
            for r, fill in ((radius + SUPERSAMPLE * 0.8, (0, 0, 0, 190)), (radius, (*colour, 255))):
                pen.ellipse((x - r, y - r, x + r, y + r), fill=fill)
        layer = layer.reduce(SUPERSAMPLE)
        base.paste(layer, (0, 0), layer)
        self._write_states(base, states_of(frame.message.tracking))
        return self._with_legend(base, position, style.colour) if style.legend else base

    def _write_states(self, picture: Image.Image, states: list[str]) -> None:
        """The states of the scene in the upper left corner, on a dark ground."""
        if not states:
            return
        unit = max(10, picture.width // 48)
        font = ImageFont.load_default(unit)
        pen = ImageDraw.Draw(picture, "RGBA")
        text = ", ".join(states)
        left, top, right, bottom = pen.textbbox((unit, unit), text, font=font)
        pad = unit // 3
        pen.rectangle((left - pad, top - pad, right + pad, bottom + pad), fill=(*BACKGROUND, 200))
        pen.text((unit, unit), text, font=font, fill=ALERT)

    def caption(self, position: int) -> str:
        """One line about a keyframe."""
        frame = self.survey.keyframes[position]
        parts = [f"keyframe {frame.index}"]
        if np.isfinite(self.chainage[position]):
            parts.append(f"{self.chainage[position]:.2f} m")
        parts.append(f"{len(frame.observations.id)} tracks")
        return "   ".join(parts)

    def _with_legend(self, picture: Image.Image, position: int, colour: str) -> Image.Image:
        """Adds a strip below: what it is, and the scale of ages or qualities."""
        unit = max(10, picture.width // 56)  # text height
        strip = Image.new("RGB", (picture.width, unit * 4), BACKGROUND)
        pen = ImageDraw.Draw(strip)
        font, small = ImageFont.load_default(unit * 1.15), ImageFont.load_default(unit * 0.85)
        pen.text((unit, unit * 2), self.caption(position), font=font, fill=TEXT, anchor="lm")
        length, left = picture.width * 36 // 100, picture.width * 62 // 100
        ramp = scale_colours(np.linspace(0, 1, length))
        bar = Image.fromarray(np.broadcast_to(ramp, (unit * 6 // 10, length, 3)).copy(), "RGB")
        strip.paste(bar, (left, unit * 15 // 10))
        if colour == "quality":
            marks = [(v, f"{v:g}") for v in (QUALITY_LOW, 0.85, 0.9, 0.95, 1.0)]
            places, what = quality_position(np.array([v for v, _ in marks])), "similarity with the frame before"
        else:
            marks = [(v, f"{v}+" if v == AGE_MAX else str(v)) for v in (0, 1, 3, 10, 30, AGE_MAX)]
            places, what = age_position(np.array([v for v, _ in marks])), "age of a track in camera frames"
        for (_, label), place in zip(marks, places, strict=True):
            pen.text((left + float(place) * (length - 1), unit * 2.4), label, font=small, fill=MUTED, anchor="mt")
        pen.text((left, unit * 1.25), what, font=small, fill=MUTED, anchor="ls")
        whole = Image.new("RGB", (picture.width, picture.height + strip.height))
        whole.paste(picture, (0, 0))
        whole.paste(strip, (0, picture.height))
        return whole


def spread(count: int, wanted: int) -> list[int]:
    """`wanted` positions (or all) spread evenly over 0..count-1, with both ends."""
    return sorted({round(float(i)) for i in np.linspace(0, count - 1, min(wanted, count))})


def position_of(survey: Survey, index: int | None) -> int:
    """Position in survey.keyframes of the keyframe `index`; the middle one for None. Raises PipefishError."""
    if index is None:
        return len(survey.keyframes) // 2
    for position, frame in enumerate(survey.keyframes):
        if frame.index == index:
            return position
    last = survey.keyframes[-1].index if survey.keyframes else 0
    raise PipefishError(f"{survey.path}: there is no keyframe {index} (0 to {last})")


def natural_width(survey: Survey) -> int:
    """Width of an overlay: the picture's own or a multiple of it, so that tracks are legible on small ones."""
    width = survey.keyframes[0].image.width if survey.keyframes else 640
    return width * max(1, round(1100 / width))


def encode_animation(frames: list[Image.Image], suffix: str, quality: int) -> bytes:
    """An animated WebP or GIF that repeats."""
    out = io.BytesIO()
    first, rest = frames[0], frames[1:]
    if suffix == ".gif":
        palette = [f.quantize(128, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE) for f in frames]
        palette[0].save(out, "GIF", save_all=True, append_images=palette[1:], duration=FRAME_MS, loop=0)
    else:
        first.save(out, "WEBP", save_all=True, append_images=rest, duration=FRAME_MS, loop=0, quality=quality, method=4)
    return out.getvalue()


def animation(
    painter: Painter,
    suffix: str = ".webp",
    limit: int = ANIMATION_LIMIT,
    width: int = ANIMATION_WIDTH,
    frames: int = ANIMATION_FRAMES,
    legend: bool = True,
    quiet: bool = True,
    colour: str = "age",
) -> bytes:
    """The keyframes one after the other, tracks drawn: at most `frames`, spread evenly over all, and `limit` bytes."""
    count = len(painter.survey.keyframes)
    style = Style(width, legend, line=1.1, dot=1.6, colour=colour)
    positions = spread(count, frames)
    pictures = [painter.draw(p, style) for p in progress_over(positions, "drawing", len(positions), quiet)]
    quality = 60
    while True:
        data = encode_animation(pictures, suffix, quality)
        if len(data) <= limit or len(pictures) == 1:
            return data
        # Too large: first coarser, then fewer and smaller.
        if quality > 30 and suffix != ".gif":
            quality -= 15
        else:
            pictures = [
                p.resize((p.width * 4 // 5, p.height * 4 // 5), Image.Resampling.LANCZOS) for p in pictures[::2]
            ]


def show(
    survey: Survey, out: Path, keyframe: int | None = None, quiet: bool = False, colour: str = "age"
) -> dict[str, object]:
    """Writes an overlay (.png, .jpg, .webp with a keyframe named) or an animation (.gif, .webp). Returns what it wrote.

    colour: "age" or "quality" (similarity with the frame before), of the tracks.

    Raises PipefishError for another suffix or a keyframe that is not there; OSError.
    """
    suffix = out.suffix.lower()
    painter = Painter(survey)
    if suffix == ".gif" or (suffix == ".webp" and keyframe is None):
        data = animation(painter, suffix, quiet=quiet, colour=colour)
        kind = "animation"
    elif suffix in (".png", ".jpg", ".jpeg", ".webp"):
        picture = painter.draw(position_of(survey, keyframe), Style(natural_width(survey), colour=colour))
        buffer = io.BytesIO()
        picture.save(buffer, {".png": "PNG", ".webp": "WEBP"}.get(suffix, "JPEG"), quality=88)
        data, kind = buffer.getvalue(), "overlay"
    else:
        raise PipefishError(f"{out}: write a .png or .jpg (one keyframe), or a .webp or .gif (animation)")
    write_atomically(out, data)
    return {"file": str(out), "kind": kind, "bytes": len(data)}
