"""`pipefish simulate` and the simulated scene: a camera driving through a pipe, with exact truth (docs/simulator.md).

The simulator shares no code with the camera model that everything else uses: its lens is its own.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import math
import os
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipefish import __version__, _engine
from pipefish.errors import ArgumentError, FormatError, PipefishError
from pipefish.progress import track
from pipefish.wallgrid import with_wall_grid

TRUTH_FORMAT = "pipefish-truth"
TRUTH_VERSION = 2
POSE_COLUMNS = ["s", "qw", "qx", "qy", "qz", "cx", "cy", "cz", "driven", "pushed", "time_s", "roll", "pitch"]

SCENARIOS = Path(__file__).with_name("scenarios")
SEEDED = ("texture", "sensor", "motion", "telemetry", "window")  # the parts that have a seed
MATERIALS = ("wall", "joint", "deposit", "hole", "crack", "lateral", "root", "water")
_KINDS = ("egg", "corrugation", "deposit", "hole", "crack", "lateral", "root")


@dataclass(frozen=True)
class Sights:
    """What N pixels see; rows with ok false hold NaN and -1. World frame, metres, radians."""

    ok: np.ndarray
    point: np.ndarray  # (N, 3)
    normal: np.ndarray  # (N, 3), unit, towards the camera's side
    s: np.ndarray  # along the centreline; in a lateral or hole along its own axis; of a root its base
    clock: np.ndarray  # in a lateral or hole around its own axis
    material: np.ndarray  # index in MATERIALS
    part: np.ndarray  # index in the scene's list of that kind; of the wall: how many joints lie before it
    mirrored_point: np.ndarray  # (N, 3): what water shows there, else NaN
    mirrored: np.ndarray  # share of the light that the water mirrors


def scenarios() -> dict[str, str]:
    """The built-in pipes: name -> what it is, in one line. docs/scenarios.md shows them."""
    return {path.stem: read_scene(path)[1] for path in sorted(SCENARIOS.glob("*.toml"))}


def studio_scenarios() -> dict[str, str]:
    """The built-in scenes that are no pipes (targets, pairs, objects), likewise."""
    from pipefish.studio_files import scenarios as known

    return {name: read_scene(path)[1] for name, path in known().items()}


def studio_scene(
    scene: str | os.PathLike[str] | dict[str, Any], changes: dict[str, Any] | None = None
) -> tuple[dict[str, Any], Path | None] | None:
    """A scene that is no pipe (it has a `kind`), with other values as described() takes them, and its file, by name,
    file or description; None if it is a pipe or not there. Raises FormatError, OSError."""
    from pipefish.studio_files import scenarios as known

    if isinstance(scene, dict):
        return (_changed(copy.deepcopy(scene), None, changes), None) if "kind" in scene else None
    path = known().get(str(scene), Path(scene))
    if (SCENARIOS / f"{scene}.toml").exists() or not path.is_file():
        return None
    made = read_scene(path)[0]
    return (_changed(made, path, changes), path) if "kind" in made else None


def read_json(path: Path) -> Any:
    """A JSON file. Raises FormatError with line and column, OSError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise FormatError(path, f"{error.lineno}:{error.colno}", error.msg) from None
    except UnicodeDecodeError as error:
        raise FormatError(path, f"byte {error.start}", "not UTF-8 text") from None


def read_toml(path: Path) -> Any:
    """A TOML file. Raises FormatError with line and column, OSError."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        place = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|(end of document))\)", str(error))
        if place is None:
            raise FormatError(path, None, str(error)) from None
        raise FormatError(path, place[4] or f"{place[2]}:{place[3]}", place[1]) from None
    except UnicodeDecodeError as error:
        raise FormatError(path, f"byte {error.start}", "not UTF-8 text") from None


def read_scene(path: Path) -> tuple[dict[str, Any], str]:
    """A scene's description and its line "about" from a TOML or JSON file. Raises FormatError, OSError."""
    scene = read_toml(path) if path.suffix.lower() == ".toml" else read_json(path)
    if not isinstance(scene, dict):
        raise FormatError(path, None, "a scene must be an object")
    about = scene.pop("about", "")
    if not isinstance(about, str):
        raise FormatError(path, "about", "must be text")
    lens = scene.get("lens")
    if isinstance(lens, dict) and isinstance(lens.get("profile"), str):
        scene["lens"] = with_profile(lens, path.parent / lens["profile"], path)
    return scene, about


def described(
    scene: str | os.PathLike[str] | dict[str, Any], changes: dict[str, Any] | None = None
) -> tuple[dict[str, Any], Path | None]:
    """A scene's description (by a built-in name, of a TOML or JSON file, or itself) and the file it is from.

    changes: values to put in, {"motion.speed": 0.2, "texture.material": "pvc"}. Raises FormatError, OSError,
    PipefishError.
    """
    if isinstance(scene, dict):
        source, made = None, copy.deepcopy(scene)
    else:
        source = SCENARIOS / f"{scene}.toml"
        if Path(scene).name != str(scene) or not source.exists():
            source = Path(scene)
        if not source.exists():
            raise PipefishError(
                f"there is no scene '{scene}': a file, or one of {', '.join([*scenarios(), *studio_scenarios()])}"
            )
        made = read_scene(source)[0]
    return _changed(made, source, changes), source


def _changed(made: dict[str, Any], source: Path | None, changes: dict[str, Any] | None) -> dict[str, Any]:
    for key, value in (changes or {}).items():
        *parts, last = key.split(".")
        place = made
        for depth, part in enumerate(parts):
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise FormatError(source, ".".join(parts[: depth + 1]), f"has no key '{last}' of its own")
        place[last] = value
    if isinstance(profile := (changes or {}).get("lens.profile"), str):
        made["lens"] = with_profile(made["lens"], Path(profile), source)
    return made


def with_profile(lens: dict[str, Any], profile: Path, source: Path | None = None) -> dict[str, Any]:
    """The key `lens` of a scene whose lens is exactly that profile (docs/profile.md), evaluated by the simulator.

    The profile sets width, height, principal point and field; `lens` may hold the rest. `source`: the scene's file, for
    errors. Raises FormatError, OSError.
    """
    data = read_json(profile)
    if not isinstance(data, dict) or data.get("format") != "pipefish-profile":
        raise FormatError(profile, "format", "not 'pipefish-profile'")
    if data.get("radial") != "generic":
        raise FormatError(profile, "radial", f"the simulator evaluates 'generic' only, not '{data.get('radial')}'")
    for key in ("tilt", "mirror"):
        if np.any(np.asarray(data.get(key, 0), dtype=float)):
            raise FormatError(profile, key, "the simulator does not evaluate it: must be 0")
    decided = ("width", "height", "c_u", "c_v", "theta_max")
    known = ("f_u", "f_v", "skew", "k2", "k3", "k4", "k5", "pupil_e1", "cpoly")
    asymmetry = [f"asym_{kind}_{of}" for kind in ("radial", "tangential") for of in ("theta", "phi")]
    missing = [key for key in (*decided, *known, *asymmetry) if key not in data]
    if missing:
        raise FormatError(profile, missing[0], "missing")
    for key in decided:
        if key in lens:
            raise FormatError(source, f"lens.{key}", "the profile decides it")
    made = {key: data[key] for key in decided}
    return {**lens, **made, "profile": {key: data[key] for key in (*known, *asymmetry)}}


class Scene:
    """A simulated pipe with a camera driving through it.

    World frame: the pipe begins at the origin along +z, x right, y down (gravity), metres. Clock angles: 0 is up,
    positive clockwise seen along the drive. Frames are counted from 0.
    """

    def __init__(self, scene: dict[str, Any], source: str | os.PathLike[str] | None = None) -> None:
        """From a description as docs/simulator.md lists it; what is not said takes its default.

        Raises FormatError that names the key (and the file `source`) for one unknown or out of range.
        """
        if not isinstance(scene, dict):
            raise FormatError(source, None, "a scene must be an object")
        scene = with_wall_grid(scene, source)
        try:
            self._scene = _engine.Scene(scene)
        except ValueError as error:
            where, _, what = str(error).partition(": ")
            raise FormatError(source, where, what) from None
        self._middle_row = (self.spec["lens"]["height"] - 1) / 2

    @staticmethod
    def load(name_or_path: str | os.PathLike[str] | dict[str, Any], changes: dict[str, Any] | None = None) -> Scene:
        """A built-in scene by name, a TOML or JSON file, or a description, with other values: changes =
        {"motion.speed": 0.2}. Raises FormatError, OSError, PipefishError."""
        made, source = described(name_or_path, changes)
        try:
            return Scene(made, source)
        except FormatError as error:
            if error.position in (changes or {}):  # not the file's fault
                raise FormatError(None, error.position, error.reason) from None
            raise

    @staticmethod
    def from_truth(path: str | os.PathLike[str]) -> Scene:
        """The scene behind a truth file. Raises FormatError (also if this version's simulator drives otherwise)."""
        truth = read_json(Path(path))
        if not isinstance(truth, dict) or truth.get("format") != TRUTH_FORMAT:
            raise FormatError(path, "format", f"not '{TRUTH_FORMAT}'")
        if truth.get("version") != TRUTH_VERSION:
            raise FormatError(path, "version", f"{truth.get('version')}: this is version {TRUTH_VERSION}")
        scene = Scene(truth.get("scene"), path)
        last = scene.frames - 1
        try:
            centre = np.array(truth["poses"][last][5:8], dtype=float)
        except (KeyError, IndexError, TypeError, ValueError):
            raise FormatError(path, "poses", "must hold pose_columns of every frame") from None
        if not np.allclose(centre, scene.centre(last), atol=1e-9):
            raise FormatError(path, f"poses[{last}]", "this version's simulator drives otherwise: simulate anew")
        return scene

    @property
    def spec(self) -> dict[str, Any]:
        """The whole description, defaults filled in."""
        return self._scene.spec

    @property
    def frames(self) -> int:
        """How many frames the drive has."""
        return self.spec["motion"]["frames"]

    @property
    def length(self) -> float:
        """Of the pipe, metres of arc length."""
        return self._scene.length

    @property
    def circle_radius(self) -> float:
        """Of the image circle, pixels."""
        return self._scene.circle_radius

    def render(self, frame: int, threads: int | None = None) -> np.ndarray:
        """What the camera sees: (H, W) uint8, or uint16 (0..1023) of 10 bits. The same bits for any number of threads
        [all cores]."""
        return self._scene.render(frame, threads or os.cpu_count() or 1)

    def pose(self, frame: int, row: float | None = None) -> np.ndarray:
        """cam_from_world [R | t] in the middle of the exposure of `row` [the middle one], (3, 4)."""
        return self._scene.pose(frame, self._middle_row if row is None else row)

    def time(self, frame: int, row: float | None = None) -> float:
        """When the middle of the exposure of `row` [the middle one] is, seconds since that of frame 0."""
        return self._scene.row_time(frame, self._middle_row if row is None else row)

    def centre(self, frame: int) -> np.ndarray:
        """The camera's centre in the world, (3,) metres."""
        pose = self.pose(frame)
        return -pose[:, :3].T @ pose[:, 3]

    def arc_length(self, frame: int) -> float:
        """How far along the pipe the camera is, metres."""
        return self._scene.arc_length(frame)

    def driven(self, frame: int) -> float:
        """How far the camera has driven since frame 0, metres, less for backwards: what a wheel counts."""
        return self._scene.driven(frame)

    def pushed(self, frame: int) -> float:
        """How much cable has been pushed since frame 0, metres: what a counter at the reel counts."""
        return self._scene.pushed(frame)

    def attitude(self, frame: int) -> tuple[float, float]:
        """True roll and pitch in radians."""
        return self._scene.attitude(frame)

    def dropped(self, frame: int) -> bool:
        """Whether the frame is lost before it is recorded: a gap in the sequence."""
        return self._scene.dropped(frame)

    def telemetry(self, frame: int) -> tuple[int, int, float, float]:
        """What the sensors say: time in ns, encoder counts, roll and pitch in radians."""
        return self._scene.telemetry(frame)

    def light_level(self, frame: int) -> float:
        """Factor of a frame's light: the lamps' flicker times the exposure's gain."""
        return self._scene.light_level(frame)

    def cast(self, frame: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) pixels -> (N, 3) wall points in the world, (N,) ok (false outside the image circle)."""
        return self._scene.cast(frame, _points(pixels, 2))

    def project(self, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) world points -> (N, 2) pixels, (N,) ok (false beyond the field; what is in between is not asked)."""
        return self._scene.project(frame, _points(points, 3))

    def visible(self, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As project(), but ok is false also where something stands between camera and point."""
        return self._scene.visible(frame, _points(points, 3))

    def flow(self, frame_a: int, frame_b: int, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where what `pixels` (N, 2) of frame a show is in frame b: (N, 2), (N,) ok.

        ok is false where it is hidden or outside the picture in b, and on water.
        """
        return self._scene.flow(frame_a, frame_b, _points(pixels, 2))

    def sights(self, frame: int, pixels: np.ndarray) -> Sights:
        """Everything about what `pixels` (N, 2) see."""
        rows, ok = self._scene.sights(frame, _points(pixels, 2))
        material, part = (np.where(ok, rows[:, k], -1).astype(int) for k in (8, 9))
        return Sights(
            ok, rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7], material, part, rows[:, 10:13], rows[:, 13]
        )

    def locate(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world points -> (N, 3): arc length, distance from the axis, clock angle; NaN far outside the pipe."""
        return self._scene.locate(_points(points, 3))[0]

    def wall(self, s: float, phi: float) -> np.ndarray:
        """The wall point at arc length s and clock angle phi, (3,)."""
        return self._scene.wall(s, phi)

    def wall_radius(self, s: float, phi: float) -> float:
        """From the axis to the wall at arc length s and clock angle phi, metres: section, reliefs, grooves, cracks."""
        return self._scene.wall_radius(s, phi)

    def outline(self, s: float, points: int = 360) -> np.ndarray:
        """The section's wall at arc length s as a polygon (points, 2): right and down of the axis, metres."""
        phi = np.arange(points) * (2 * np.pi / points)
        radius = np.array([self.wall_radius(s, p) for p in phi])
        return np.column_stack([radius * np.sin(phi), -radius * np.cos(phi)])

    def events(self) -> list[dict[str, Any]]:
        """What is in the pipe, in order of arc length: kind, index in its list, s, clock (if it has one), its sizes."""
        spec = self.spec
        lists = {"joint": self._scene.joints} | {kind: spec[kind + "s"] for kind in _KINDS} | {"water": spec["water"]}
        events = []
        for kind, items in lists.items():
            for index, item in enumerate(items):
                event = {"kind": kind, "index": index} | {k: v for k, v in item.items() if k not in ("seed", "path")}
                if kind == "crack":
                    path = [list(p) for p in self._scene.crack_path(index)]
                    event |= {"s": path[0][0], "clock": path[0][1] % (2 * math.pi), "path": path}
                elif kind in ("egg", "corrugation", "water"):
                    event["s"] = max(0.0, item["start"])
                events.append(event)
        return sorted(events, key=lambda event: event["s"])

    def section(self, s: float) -> tuple[float, float, float]:
        """D_max and D_min in metres, clock angle of D_max, of the ellipse at arc length s (outline() has the rest)."""
        return self._scene.section(s)

    def lens(self) -> dict[str, list[float]]:
        """The lens as its table: theta (radians), radius (pixels), pupil shift (metres)."""
        theta = self._scene.lens_nodes
        radius, pupil = zip(*(self._scene.lens(t) for t in theta), strict=True)
        return {
            "theta": [round(t, 12) for t in theta],
            "radius_px": [round(r, 9) for r in radius],
            "pupil_m": [round(e, 12) for e in pupil],
        }


def _points(values: np.ndarray, columns: int) -> np.ndarray:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns:
        raise ArgumentError(f"must have the shape (N, {columns}), not {array.shape}")
    return array


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """A rotation matrix (3, 3) as a unit quaternion (w, x, y, z), w >= 0."""
    # The eigenvector of the largest eigenvalue (Bar-Itzhack 2000): no case needs a branch.
    r = rotation
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    q = np.linalg.eigh(k, UPLO="U")[1][:, -1]
    return q if q[0] >= 0 else -q


def truth_of(scene: Scene) -> dict[str, Any]:
    """What the truth file says."""
    poses = []
    for frame in range(scene.frames):
        q = quaternion(scene.pose(frame)[:, :3])
        told = [scene.driven(frame), scene.pushed(frame), scene.time(frame), *scene.attitude(frame)]
        poses.append([round(float(v), 12) for v in (scene.arc_length(frame), *q, *scene.centre(frame), *told)])
    return {
        "format": TRUTH_FORMAT,
        "version": TRUTH_VERSION,
        "software": f"pipefish {__version__}",
        "scene": scene.spec,
        "pipe_length_m": scene.length,
        "events": scene.events(),
        "lens": scene.lens(),
        "rows": {
            "line_time_s": scene.spec["sensor"]["line_time_s"],
            "rule": "row v is exposed line_time_s (v - (height - 1) / 2) after the frame's time, which is the middle "
            "of its middle row's exposure; Scene.pose(frame, v) is the camera then",
        },
        "pose_columns": POSE_COLUMNS,
        "light": [round(scene.light_level(frame), 9) for frame in range(scene.frames)],
        "poses": poses,
        "dropped": [frame for frame in range(scene.frames) if scene.dropped(frame)],
    }


def fitted_camera(scene: Scene) -> Any:
    """The p9 camera closest to the scene's lens at the wall of its pipe: least squares of image radius over angle.

    The fit is central and the lens is not, so it holds at one distance: wall points at the pipe's radius, seen from the
    camera centre. `rms_px` is the residual there, over the picture: mostly the asymmetry, which it has none of. For a
    lens that is a profile: that profile. A pipefish.Camera.
    """
    from pipefish.camera import Camera

    spec = scene.spec["lens"]
    if spec["profile"]["f_u"] > 0:
        size = {key: spec[key] for key in ("width", "height", "c_u", "c_v", "theta_max")}
        return Camera(**size, **spec["profile"], name="simulated, exactly this profile", source="simulated", rms_px=0.0)
    ray = np.linspace(0, spec["theta_max"], 1001)[1:]
    radius, pupil = np.array([scene._scene.lens(t) for t in ray]).T
    wall = scene.spec["diameter"] / 2
    theta = np.arctan2(wall, pupil + wall / np.tan(ray))  # of the wall point on that ray, from the camera centre
    powers = theta[:, None] ** np.array([1, 3, 5, 7, 9])
    coefficients = np.linalg.lstsq(powers, radius, rcond=None)[0]
    focal = float(coefficients[0])
    k2, k3, k4, k5 = (coefficients[1:] / focal).tolist()
    camera = Camera(
        width=spec["width"],
        height=spec["height"],
        f_u=focal,
        f_v=focal,
        c_u=spec["c_u"],
        c_v=spec["c_v"],
        k2=k2,
        k3=k3,
        k4=k4,
        k5=k5,
        theta_max=float(theta[-1]),
        circle_u=spec["c_u"],
        circle_v=spec["c_v"],
        circle_radius=scene.circle_radius,
        name="simulated fisheye",
        source="simulated",
        theta_covered=float(theta[-1]),
    )
    phi = np.arange(36) * (2 * np.pi / 36)
    place = np.searchsorted(radius, radius[-1] * np.sqrt((np.arange(40) + 0.5) / 40))  # rings of equal area
    around = np.stack([np.cos(phi), np.sin(phi)], axis=-1) * wall
    ahead = wall / np.tan(theta[place])
    points = np.array([[x, y, z] for z in ahead for x, y in around])
    pose = scene.pose(0)
    seen, ok = scene.project(0, (points - pose[:, 3]) @ pose[:, :3])
    found, within = camera.project(points)
    off = (seen - found)[ok & within]
    return dataclasses.replace(camera, rms_px=float(np.sqrt(np.mean((off**2).sum(axis=1)))))


def scene_key(name: str) -> dict[str, Any]:
    """What a recording of this preset depends on: the scene, and the very engine that draws it."""
    engine = hashlib.sha256(Path(_engine.__file__).read_bytes()).hexdigest()
    return {"scene": Scene.load(name).spec, "engine": engine}


def simulate(
    scene: str | os.PathLike[str] | dict[str, Any],
    stem: Path,
    *,
    changes: dict[str, Any] | None = None,
    frames: int | None = None,
    seed: int | None = None,
    threads: int | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Writes STEM.y4m, STEM.csv, STEM.truth.json and STEM.profile.json, each complete or not at all; of a scene that is
    no pipe the folder STEM.

    scene: a scenario's name, a TOML or JSON file, or the description itself. changes: other values, as described()
    takes them. frames: stop after so many. seed: of all that is random but the shapes of what is in the pipe. Returns
    what was written. Raises FormatError, PipefishError, OSError.
    """
    if (studio := studio_scene(scene, changes)) is not None:
        from pipefish.studio_files import simulate_studio

        more = {"count": frames, "seed": seed, "threads": threads, "quiet": quiet}
        return simulate_studio(studio[0], Path(stem), path=studio[1], **more)
    changes = dict(changes or {})
    if frames is not None:
        changes["motion.frames"] = frames
    if seed is not None:
        changes |= {f"{part}.seed": seed for part in SEEDED}
    made = Scene.load(scene, changes)
    stem = Path(stem)
    stem.parent.mkdir(parents=True, exist_ok=True)
    files = {kind: stem.with_name(stem.name + kind) for kind in (".y4m", ".csv", ".truth.json", ".profile.json")}
    partial = {kind: file.with_name(file.name + ".partial") for kind, file in files.items()}
    try:
        _write_video(made, partial[".y4m"], threads, quiet)
        _write_csv(made, partial[".csv"])
        partial[".truth.json"].write_text(json.dumps(truth_of(made)) + "\n", encoding="utf-8")
        fitted_camera(made).save(partial[".profile.json"])
        for kind, file in files.items():
            os.replace(partial[kind], file)
    finally:
        for file in partial.values():
            file.unlink(missing_ok=True)
    last = made.frames - 1
    return {
        "frames": sum(not made.dropped(frame) for frame in range(made.frames)),
        "width": made.spec["lens"]["width"],
        "height": made.spec["lens"]["height"],
        "driven_m": made.arc_length(last) - made.arc_length(0),
        "files": [str(f) for f in files.values()],
    }


def _recorded(scene: Scene) -> list[int]:
    return [frame for frame in range(scene.frames) if not scene.dropped(frame)]


def _write_video(scene: Scene, path: Path, threads: int | None, quiet: bool) -> None:
    lens, rate = scene.spec["lens"], scene.spec["motion"]["frame_rate"]
    numerator, denominator = (int(rate), 1) if rate == int(rate) else (round(rate * 1000), 1000)
    colour = "mono10" if scene.spec["sensor"]["bits"] == 10 else "mono"
    frames = _recorded(scene)
    with open(path, "wb") as out:
        header = f"YUV4MPEG2 W{lens['width']} H{lens['height']} F{numerator}:{denominator} Ip A1:1 C{colour}\n"
        out.write(header.encode())
        for frame in track(frames, "simulating", len(frames), quiet):
            out.write(b"FRAME\n")
            image = scene.render(frame, threads)
            out.write(image.astype(image.dtype.newbyteorder("<"), copy=False).tobytes())


def _write_csv(scene: Scene, path: Path) -> None:
    sigma = scene.spec["telemetry"]["attitude_sigma"]
    with open(path, "w", encoding="utf-8", newline="\n") as out:
        out.write("sequence,time_ns,encoder_count,roll_rad,pitch_rad,attitude_sigma_rad\n")
        for frame in _recorded(scene):
            time_ns, count, roll, pitch = scene.telemetry(frame)
            attitude = f"{roll:.6f},{pitch:.6f},{sigma:g}" if sigma > 0 else f"{roll:.6f},{pitch:.6f},"
            out.write(f"{frame},{time_ns},{count},{attitude}\n")
