"""Pairs of pictures made up for motion segmentation: textured patches, bent by thin-plate splines and lit anew, before
unrelated backgrounds; labels, flow and gain are known. And the figures by which a segmentation of them is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipefish.segmentation import Segmentation
from pipefish.studio import pattern

SAMPLES = 3  # a side of a pixel


class Patch:
    """A texture with a wavy outline: where it is in a picture, by the map from pixels to its own plane, -1..1."""

    def __init__(self, rng: np.random.Generator, centre: np.ndarray, radius: float, bend: float) -> None:
        angle = rng.uniform(-0.4, 0.4)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        self.centre, self.radius = centre, radius
        self.map = turn @ np.diag(rng.uniform(0.9, 1.1, 2)) / radius
        grid = np.linspace(-1.2, 1.2, 4)
        self.knots = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        away = bend * rng.uniform(-1, 1, self.knots.shape)
        n = len(self.knots)
        system = np.zeros((n + 3, n + 3))
        system[:n, :n] = self._kernel(self.knots)
        system[:n, n], system[:n, n + 1 :] = 1, self.knots
        system[n:, :n] = system[:n, n:].T
        self.weights = np.linalg.solve(system, np.vstack([away, np.zeros((3, 2))]))

    def _kernel(self, p: np.ndarray) -> np.ndarray:
        square = ((p[:, None] - self.knots[None]) ** 2).sum(axis=2)
        return 0.5 * square * np.log(np.maximum(square, 1e-12))

    def plane(self, xy: np.ndarray) -> np.ndarray:
        """(N,2) pixels -> places in the patch's plane; unbent far from it, where nobody looks."""
        p = (xy - self.centre) @ self.map.T
        near = p[np.abs(p).max(axis=1) < 1.5]
        rows = np.hstack([self._kernel(near), np.ones((len(near), 1)), near])
        p[np.abs(p).max(axis=1) < 1.5] += rows @ self.weights
        return p

    def pixels(self, uv: np.ndarray) -> np.ndarray:
        """The inverse, by iteration."""
        back = np.linalg.inv(self.map)
        xy = self.centre + uv @ back.T
        for _ in range(12):
            xy = xy + (uv - self.plane(xy)) @ back.T
        return xy


@dataclass
class Pair:
    """images: (H,W,3) floats. labels: (H,W), what both pictures show. flow: (H,W,2) from picture 1 to 2, NaN where
    nothing. gain: (H,W) of picture 2's light to picture 1's, NaN likewise."""

    images: tuple[np.ndarray, np.ndarray]
    labels: tuple[np.ndarray, np.ndarray]
    flow: np.ndarray
    gain: np.ndarray


def _colour(seed: int, size: int) -> np.ndarray:
    """(size,size,3) of 0..1."""
    tone = np.random.default_rng(seed).uniform(0.35, 0.65, 3)
    own = np.stack([pattern(10 * seed + c, size, size, contrast=0.1) for c in range(3)], axis=-1)
    return np.clip(pattern(10 * seed + 5, size, size, contrast=0.18)[..., None] + 0.6 * (own - 0.5) + tone - 0.5, 0, 1)


def _at(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    x, y = np.clip(x, 0, image.shape[1] - 1.001), np.clip(y, 0, image.shape[0] - 1.001)
    i, j = x.astype(int), y.astype(int)
    a, b = (x - i)[:, None], (y - j)[:, None]
    top = image[j, i] * (1 - a) + image[j, i + 1] * a
    return top * (1 - b) + (image[j + 1, i] * (1 - a) + image[j + 1, i + 1] * a) * b


def _wavy(uv: np.ndarray, phase: float) -> np.ndarray:
    angle = np.arctan2(uv[:, 1], uv[:, 0]) + phase
    return np.hypot(*uv.T) < 0.82 + 0.1 * np.sin(3 * angle) + 0.06 * np.sin(5 * angle)


def make_pair(
    seed: int,
    width: int = 320,
    height: int = 240,
    *,
    patches: int = 2,
    scale: float = 1.0,
    covered: bool = False,
    relit: bool = True,
    noise: float = 2 / 255,
) -> Pair:
    """`patches` (0 to 2) beside each other, exchanged and bent in picture 2, where they are `scale` times as large;
    covered: there the second hides a part of the first. relit: gain from 0.6 to 1.4 and an edge of shadow."""
    rng = np.random.default_rng(seed)
    radius = 0.36 * height * np.array([1, scale]) / max(1, scale)
    size = np.array([width, height])
    second = [(0.72, 0.5), (0.27, 0.5)] if not covered else [(0.42, 0.5), (0.7, 0.55)]
    places = [[np.array(c) * size for c in ((0.28, 0.5), (0.73, 0.5))], [np.array(c) * size for c in second]]
    shapes = [[Patch(rng, places[k][p], radius[k], 0.1 * k) for p in range(2)] for k in range(2)]
    textures = [_colour(100 * seed + p, 256) for p in range(2)]
    phases = rng.uniform(0, 6, 2)
    wave, edge = rng.uniform(-1, 1, (2, 2, 2)), rng.uniform(0, 6, 2)

    def gain(p: int, uv: np.ndarray) -> np.ndarray:
        if not relit:
            return np.ones(len(uv))
        smooth = 1 + 0.25 * np.sin(1.5 * uv @ wave[p, 0] + 3 * wave[p, 1, 0])
        side = uv @ np.array([np.cos(edge[p]), np.sin(edge[p])]) - 0.1
        return smooth * (1 - 0.2 * (1 + np.tanh(8 * side)))

    def owner(uv: list[np.ndarray]) -> np.ndarray:
        """(N,) 0 or the patch seen, from where in each."""
        label = np.zeros(len(uv[0]), int)
        for p in range(patches):
            label[_wavy(uv[p], phases[p])] = p + 1
        return label

    images = []
    y, x = (v.ravel() for v in np.mgrid[:height, :width].astype(float))
    xy = np.stack([x, y], axis=1)
    for k in range(2):
        back = _colour(100 * seed + 50 + k, 512)
        whole = [shapes[k][p].plane(xy).reshape(height, width, 2) for p in range(2)]
        slopes = [np.gradient(w, axis=(1, 0)) for w in whole]
        total = np.zeros((height * width, 3))
        for n in range(SAMPLES**2):
            dx, dy = (n % SAMPLES + 0.5) / SAMPLES - 0.5, (n // SAMPLES + 0.5) / SAMPLES - 0.5
            uv = [(w + dx * sx + dy * sy).reshape(-1, 2) for w, (sx, sy) in zip(whole, slopes, strict=True)]
            label = owner(uv)
            sample = _at(back, x + dx, y + dy)
            for p in range(patches):
                on = label == p + 1
                colour = _at(textures[p], *(127.5 * (uv[p][on] + 1)).T)
                sample[on] = colour * gain(p, uv[p][on])[:, None] if k == 1 else colour
            total += sample
        image = total.reshape(height, width, 3) / SAMPLES**2
        images.append(np.clip(image + noise * rng.normal(size=image.shape), 0, 1))
    flow, light = np.full((len(xy), 2), np.nan), np.full(len(xy), np.nan)
    labels = []
    for k in range(2):
        uv = [shapes[k][p].plane(xy) for p in range(2)]
        label = owner(uv)
        for p in range(patches):
            on = np.flatnonzero(label == p + 1)
            to = shapes[1 - k][p].pixels(uv[p][on])
            seen = (owner([shapes[1 - k][q].plane(to) for q in range(2)]) == p + 1) & (
                (to >= 0) & (to <= size - 1)
            ).all(axis=1)
            label[on[~seen]] = 0
            if k == 0:
                flow[on[seen]], light[on[seen]] = to[seen], gain(p, uv[p][on[seen]])
        labels.append(label.reshape(height, width).astype(np.uint8))
    shape = (height, width)
    return Pair((images[0], images[1]), (labels[0], labels[1]), flow.reshape(*shape, 2), light.reshape(shape))


def make_wave(seed: int, period: float, height: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Two pictures (120,160,3) of one surface, rippled in picture 1 by waves of `period` and `height` pixels along both
    axes; and where each of its pixels is in picture 2, (120,160,2)."""
    y, x = (v.ravel() for v in np.mgrid[:120, :160].astype(float))
    to = np.stack([x + height * np.sin(2 * np.pi * y / period), y + height * np.sin(2 * np.pi * x / period)], axis=1)
    texture, noise = _colour(seed, 256), np.random.default_rng(seed)
    pictures = [_at(texture, *(20 + at).T).reshape(120, 160, 3) for at in (to, np.stack([x, y], axis=1))]
    return [np.clip(p + noise.normal(0, 0.005, p.shape), 0, 1) for p in pictures], to.reshape(120, 160, 2)


def paired(found: np.ndarray, truth: np.ndarray) -> dict[int, int]:
    """For each label of the truth the found one that covers most of it; 0 if none."""
    out = {}
    for k in range(1, int(truth.max(initial=0)) + 1):
        counts = np.bincount(found[truth == k], minlength=1)
        counts[0] = 0
        out[k] = int(counts.argmax()) if counts.max() else 0
    return out


def overlap(found: np.ndarray, truth: np.ndarray, names: dict[int, int]) -> float:
    """Least intersection over union of a label of the truth and the found one it is paired with."""
    return min(
        float(((found == f) & (truth == k)).sum() / ((found == f) | (truth == k)).sum()) if f else 0.0
        for k, f in names.items()
    )


def flow_errors(s: Segmentation, pair: Pair, names: dict[int, int]) -> np.ndarray:
    """Pixels, of all pixels of picture 1 that are rightly labelled."""
    errors = [
        np.hypot(*(s.layers[f - 1].flow1 - pair.flow)[(pair.labels[0] == k) & (s.labels1 == f)].T)
        for k, f in names.items()
        if f
    ]
    return np.concatenate(errors)


def gain_rms(s: Segmentation, pair: Pair, names: dict[int, int]) -> float:
    """Of picture 2's light to picture 1's, as the layers have it, in the colours' mean: (layer's colour there) / (here)
    against the truth."""
    errors = []
    for k, f in names.items():
        on = (pair.labels[0] == k) & (s.labels1 == f) if f else np.zeros_like(pair.labels[0], bool)
        if on.any():
            layer = s.layers[f - 1]
            here = layer.warped1[on].mean(axis=1)
            there = ((layer.warped1 - layer.offset1) / layer.gain1)[on].mean(axis=1)
            errors.append(there / np.maximum(here, 0.05) - pair.gain[on])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def boundary_score(found: np.ndarray, truth: np.ndarray, reach: int = 2) -> float:
    """F score of the boundary of the labels, to `reach` pixels."""

    def edges(labels: np.ndarray) -> np.ndarray:
        out = np.zeros(labels.shape, bool)
        out[:, :-1] |= labels[:, :-1] != labels[:, 1:]
        out[:-1] |= labels[:-1] != labels[1:]
        return out

    def near(mask: np.ndarray) -> np.ndarray:
        out = np.zeros_like(mask)
        for y, x in np.argwhere(mask):
            out[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = True
        return out

    a, b = edges(found), edges(truth)
    right, seen = (a & near(b)).sum() / max(a.sum(), 1), (b & near(a)).sum() / max(b.sum(), 1)
    return float(2 * right * seen / max(right + seen, 1e-9))


def label_agreement(a: np.ndarray, b: np.ndarray) -> float:
    """Share of pixels with the same label, the labels of `a` renamed to those of `b` that cover most of them."""
    names = paired(b, a)
    renamed = np.array([0, *(names[k] if names[k] else 255 for k in sorted(names))])[a]
    return float((renamed == b).mean())


def _nearest(xy: np.ndarray, field: np.ndarray) -> np.ndarray:
    x, y = np.clip(np.rint(np.nan_to_num(xy)).astype(int), 0, np.array(field.shape[1::-1]) - 1).T
    return field[y, x]


def round_trips(s: Segmentation) -> np.ndarray:
    """Pixels from where a labelled pixel of picture 1 is to where it comes back from picture 2; infinite if nowhere."""
    out = []
    for k, layer in enumerate(s.layers, 1):
        y, x = np.nonzero(s.labels1 == k)
        there = layer.flow1[y, x].astype(float)
        # flow2 between its pixels: at the nearest one, and on by its slope.
        cell = np.rint(there)
        dy, dx = (np.nan_to_num(g) for g in np.gradient(layer.flow2, axis=(0, 1)))
        back = _nearest(there, layer.flow2).astype(float)
        back += (there - cell)[:, :1] * _nearest(there, dx) + (there - cell)[:, 1:] * _nearest(there, dy)
        distance = np.hypot(*(back - np.stack([x, y], axis=1)).T)
        out.append(np.where(np.isnan(distance), np.inf, distance))
    return np.concatenate(out)


def smallest_piece(labels: np.ndarray) -> int:
    """Pixels of the smallest piece of one label, its corners touching."""
    left = np.pad(labels.astype(int), 1, constant_values=-1)
    least = labels.size
    while (left >= 0).any():
        start = np.unravel_index(int((left >= 0).argmax()), left.shape)
        label, front, size = left[start], [start], 1
        left[start] = -1
        while front:
            y, x = front.pop()
            for q in ((y + dy, x + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)):
                if left[q] == label:
                    left[q], size = -1, size + 1
                    front.append(q)
        least = min(least, size)
    return least


def points_in_layers(s: Segmentation, rows: np.ndarray) -> dict:
    """How labelled pairs of points (x1 y1 1 x2 y2 1 label, 0 is an outlier) lie in layers.

    A pair, right or wrong, is in a layer when both its points have its label and the layer's motion carries the one to
    less than 10 pixels from the other. recall: share of a motion's pairs in its best layer; purity: share of that
    motion among all pairs there, wrong ones too; outliers: share of wrong pairs that are in a layer; same_layer: share
    of wrong pairs both of whose points have a layer's label, whatever its motion."""
    one, two, truth = rows[:, :2], rows[:, 3:5], rows[:, -1].astype(int)
    label = _nearest(one, s.labels1).astype(int)
    label[label != _nearest(two, s.labels2)] = 0
    wrong = truth == 0
    same_layer = (label[wrong] > 0).mean()
    for k, layer in enumerate(s.layers, 1):
        label[(label == k) & ~(np.hypot(*(_nearest(one, layer.flow1) - two).T) < 10)] = 0
    motions = []
    for k in range(1, truth.max() + 1):
        counts = np.bincount(label[truth == k], minlength=len(s.layers) + 1)
        counts[0] = 0
        best = int(counts.argmax())
        own = {"recall": counts[best] / (truth == k).sum(), "purity": counts[best] / max((label == best).sum(), 1)}
        motions.append(own | {"layer": best if counts[best] else 0})
    return {"motions": motions, "outliers": (label[wrong] > 0).mean(), "same_layer": same_layer}
