"""Textured objects, each alone in its model pictures and among others in scenes, with the truth: labels, boxes,
poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipefish.errors import ArgumentError
from pipefish.progress import track
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

KINDS = ("card", "bent", "box", "cylinder")


@dataclass
class ObjectPicture:
    """A model's picture or a scene, and the truth about it. Label 0 is no object, k the k-th."""

    image: np.ndarray  # (H, W) uint8, or uint16 of 10 bits
    labels: np.ndarray  # (H, W) uint8, of objects; distractors and background are 0
    boxes: dict[int, tuple[int, int, int, int]]  # of the visible pixels: first column, row, last column, row
    shown: dict[int, float]  # share of the object's pixels in the picture that nothing hides
    poses: dict[int, np.ndarray]  # cam_from_object (3, 4)
    picture: Picture


@dataclass
class Objects:
    """Models and scenes; models[k] are the pictures of object k + 1."""

    studio: Studio
    kinds: list[str]
    models: list[list[ObjectPicture]]
    scenes: list[ObjectPicture]


@dataclass(frozen=True)
class _Solid:
    """An object: sheets with poses object_from_sheet; about as large as a ball of radius 1."""

    kind: str
    sheets: list[dict[str, Any]]
    poses: list[np.ndarray]


def simulate_objects(
    objects: int = 9,
    scenes: int = 23,
    lens: dict[str, Any] | None = None,
    *,
    sensor: dict[str, Any] | None = None,
    kinds: tuple[str, ...] = KINDS,
    model_views: int = 1,
    per_scene: tuple[int, int] = (1, 3),
    distractors: int = 4,
    scale: tuple[float, float] = (0.5, 2.0),
    tilt: float = 0.87,
    bend: float = 0.25,
    relight: float = 0.3,
    textures: list[np.ndarray] | None = None,
    seed: int = 1,
    threads: int | None = None,
    samples: int = 34,
    quiet: bool = True,
    source: str | None = None,
) -> Objects:
    """`objects` model objects, and `scenes` with some of them among distractors.

    lens [narrow-60, 640 x 480]. kinds: taken in turn: a flat card, a bent sheet, a box, half a cylinder. model_views:
    pictures of each object alone, from directions around the front. per_scene: fewest and most objects in a scene.
    scale: of an object in a scene to its model's picture. tilt: radians, at most, from the model's viewpoint. bend: how
    much cards and sheets are bent between model and scene, as a share of their half width. relight: share by which the
    light changes. distractors: sheets with textures of their own, before and behind. textures: images for the objects.
    Raises ArgumentError, FormatError.
    """
    if not 1 <= objects <= 250 or scenes < 0:
        raise ArgumentError("objects: must be within 1 and 250; scenes: not negative")
    if not kinds or any(kind not in KINDS for kind in kinds):
        raise ArgumentError(f"kinds: must be of {', '.join(KINDS)}")
    if not 0 <= per_scene[0] <= per_scene[1] <= 12 or not 0 < scale[0] <= scale[1]:
        raise ArgumentError("per_scene, scale: must be (least, most)")
    lens = lens or {"preset": "narrow-60", "width": 640, "height": 480}
    studio = Studio(lens, {"seed": seed, **(sensor or {})}, source)
    given = list(textures or [])
    made: list[Texture] = []
    solids = []
    for k in range(objects):
        solid = _solid(random(seed, 100 + k), kinds[k % len(kinds)], len(made))
        for face in range(len(solid.sheets)):
            own = given[k] if k < len(given) else pattern(seed * 5000 + 8 * k + face, 384, 384, contrast=0.2)
            made.append(raster(own))
        solids.append(solid)
    ground = len(made)
    made += [*room_textures(seed), *(raster(pattern(seed * 9000 + k, 384, 384)) for k in range(12))]
    made.append(Texture.print(np.zeros((0, 6)), 0.35))
    world = _Stage(studio, solids, made, ground, threads, samples, source)
    models = []
    for k in range(objects):
        views = []
        for view in range(model_views):
            rng = random(seed, 1000 + 50 * k + view)
            turn = rotation((*(0.5 * rng.uniform(-1, 1, 2)), 0)) if view else np.eye(3)
            views.append(world.model(k, turn, view))
        models.append(views)
    shown = []
    for n in track(range(scenes), "drawing", scenes, quiet):
        rng = random(seed, 10_000 + n)
        shown.append(world.scene(rng, n, per_scene, distractors, scale, tilt, bend, relight))
    return Objects(studio, [s.kind for s in solids], models, shown)


def _solid(rng: np.random.Generator, kind: str, texture: int) -> _Solid:
    wide, high = rng.uniform(1.3, 1.7), rng.uniform(1.1, 1.5)
    sheet: dict[str, Any] = {"width": wide, "height": high, "texture": texture}
    middle = [pose(np.eye(3), (0, 0, 0))]
    if kind == "card":
        return _Solid(kind, [sheet], middle)
    if kind == "bent":
        wave = {"u_rate": 2.0, "v_rate": float(rng.uniform(-1, 1)), "phase": float(rng.uniform(-3, 3)), "metres": 0.12}
        return _Solid(kind, [{**sheet, "relief": {"waves": [wave]}}], middle)
    if kind == "cylinder":
        radius = wide / np.pi
        return _Solid(kind, [{**sheet, "curvature": 1 / radius}], [pose(np.eye(3), (0, 0, -radius / 2))])
    deep = rng.uniform(0.6, 1.0)
    sizes = [(wide, high), (deep, high), (wide, high), (deep, high), (wide, deep), (wide, deep)]
    away = [deep / 2, wide / 2, deep / 2, wide / 2, high / 2, high / 2]
    turns = [(0, 0, 0), (0, np.pi / 2, 0), (0, np.pi, 0), (0, -np.pi / 2, 0), (np.pi / 2, 0, 0), (-np.pi / 2, 0, 0)]
    sheets, poses = [], []
    for k, (size, turn) in enumerate(zip(sizes, turns, strict=True)):
        r = rotation(turn)
        sheets.append({"width": size[0], "height": size[1], "texture": texture + k})
        poses.append(pose(r, -away[k] * r[:, 2]))  # the face looks outwards
    return _Solid(kind, sheets, poses)


class _Stage:
    def __init__(
        self,
        studio: Studio,
        solids: list[_Solid],
        textures: list[Texture],
        ground: int,
        threads: int | None,
        samples: int,
        source: str | None,
    ) -> None:
        self.studio, self.solids, self.textures, self.ground = studio, solids, textures, ground
        self.threads, self.samples, self.source = threads, samples, source
        table = studio.lens_table()
        self.table = table
        focal = table["radius_px"][1] / table["theta"][1]
        self.distance = focal * 2.0 / (0.62 * min(studio.width, studio.height))  # a model fills 0.62 of the picture

    def model(self, k: int, turn: np.ndarray, frame: int) -> ObjectPicture:
        """Object k alone on an even ground."""
        at = pose(turn, (0, 0, self.distance))
        sheets = self._sheets(self.solids[k], at, {})
        far = {"width": 60.0, "height": 60.0, "texture": len(self.textures) - 1}
        sheets.append({**far, "pose": listed(pose(np.eye(3), (0, 0, self.distance + 3)))})
        spec = {"frame": 1000 * (k + 1) + frame, "sheets": sheets, "ambient": 210.0}
        return self._taken(spec, [(k + 1, len(self.solids[k].sheets))], {k + 1: at})

    def scene(
        self,
        rng: np.random.Generator,
        number: int,
        per_scene: tuple[int, int],
        distractors: int,
        scale: tuple[float, float],
        tilt: float,
        bend: float,
        relight: float,
    ) -> ObjectPicture:
        """Some objects among distractors."""
        count = int(rng.integers(per_scene[0], per_scene[1] + 1))
        chosen = rng.permutation(len(self.solids))[:count]
        sheets: list[dict[str, Any]] = []
        taken: list[tuple[np.ndarray, float]] = []  # balls around what is there
        parts, poses = [], {}
        for k in chosen:
            size = float(np.exp(rng.uniform(*np.log(scale))))
            at = self._anywhere(rng, self.distance / size, tilt, 0.6, taken, 1.0)
            changes: dict[str, Any] = {"gain": float(1 + relight * rng.uniform(-1, 1))}
            if self.solids[k].kind in ("card", "bent") and bend > 0:
                changes["powers"] = [
                    {"i": 2, "j": 0, "metres": float(bend * 0.7 * rng.uniform(-1, 1))},
                    {"i": 1, "j": 1, "metres": float(bend * 0.2 * rng.uniform(-1, 1))},
                ]
            slope = 0.3 * relight * rng.uniform(-1, 1, 2)
            changes["light"] = {"powers": [{"i": 1, "j": 0, "metres": slope[0]}, {"i": 0, "j": 1, "metres": slope[1]}]}
            made = self._sheets(self.solids[k], at, changes)
            parts.append((int(k) + 1, len(made)))
            poses[int(k) + 1] = at
            sheets += made
        for _ in range(distractors):
            size = rng.uniform(0.4, 1.1)
            at = self._anywhere(rng, self.distance * rng.uniform(0.6, 2.0), 0.6, 0.95, taken, 0.9 * size)
            one = {
                "width": size,
                "height": size * rng.uniform(0.5, 1.5),
                "texture": self.ground + 6 + int(rng.integers(12)),
            }
            sheets.append({**one, "outline": ("rectangle", "round")[int(rng.integers(2))], "pose": listed(at)})
        walls = pose(rotation(rng.uniform(-0.5, 0.5, 3)), (0, 0, 0))
        sheets += room(4 * self.distance / scale[0], self.ground, walls)
        lamp = {"x": rng.uniform(-2, 2), "y": rng.uniform(-3, 0), "z": 0.0, "power": 60.0 * self.distance**2}
        spec = {"frame": number, "sheets": sheets, "ambient": 150.0, "lamps": [lamp]}
        return self._taken(spec, parts, poses)

    def _anywhere(
        self,
        rng: np.random.Generator,
        distance: float,
        tilt: float,
        reach: float,
        taken: list[tuple[np.ndarray, float]],
        radius: float,
    ) -> np.ndarray:
        """A pose towards the camera but for `tilt`, its middle within that share of the picture; of 50 places the first
        where a ball of that radius meets none that is there, else the last."""
        for _ in range(50):
            off = reach * 0.5 * rng.uniform(-1, 1, 2) * [self.studio.width, self.studio.height]
            theta = float(np.interp(np.hypot(*off), self.table["radius_px"], self.table["theta"]))
            theta = max(theta, self.studio.spec["lens"]["theta_min"] * 1.3)
            azimuth = np.arctan2(off[1], off[0])
            ray = np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
            if all(np.linalg.norm(distance * ray - centre) > radius + other for centre, other in taken):
                break
        taken.append((distance * ray, radius))
        a, size = rng.uniform(0, 2 * np.pi), tilt * np.sqrt(rng.uniform(0, 1))
        turn = rotation((size * np.cos(a), size * np.sin(a), 0))
        return pose(facing(ray, rng.uniform(-0.6, 0.6)) @ turn, distance * ray)

    @staticmethod
    def _sheets(solid: _Solid, at: np.ndarray, changes: dict[str, Any]) -> list[dict[str, Any]]:
        made = []
        for sheet, own in zip(solid.sheets, solid.poses, strict=True):
            one = {**sheet, **{key: changes[key] for key in ("gain", "light") if key in changes}}
            if "powers" in changes:
                one["relief"] = {**sheet.get("relief", {}), "powers": changes["powers"]}
            made.append({**one, "pose": listed(chain(at, own))})
        return made

    def _taken(self, spec: dict[str, Any], parts: list[tuple[int, int]], poses: dict[int, np.ndarray]) -> ObjectPicture:
        """The picture, and what shows of the objects, whose sheets come first: (label, how many sheets) each."""
        picture = Picture(spec, self.textures, self.source)
        shape = (self.studio.height, self.studio.width)
        owner = np.zeros(len(spec["sheets"]) + 1, dtype=np.uint8)  # the last: no sheet
        pixels, boxes, shown, at = self.studio.pixels(), {}, {}, 0
        for label, count in parts:
            owner[at : at + count] = label
            at += count
        labels = owner[self.studio.look(picture, pixels).sheet].reshape(shape)
        at = 0
        for label, count in parts:
            alone = Picture({**spec, "sheets": spec["sheets"][at : at + count]}, self.textures, self.source)
            all_of_it = int((self.studio.look(alone, pixels).sheet >= 0).sum())
            at += count
            rows, columns = np.nonzero(labels == label)
            shown[label] = len(rows) / all_of_it if all_of_it else 0.0
            if len(rows):
                boxes[label] = (int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max()))
        image = self.studio.render(picture, self.samples, self.threads)
        return ObjectPicture(image, labels, boxes, shown, poses, picture)
