"""The measured wall again, from the files of `pipefish reconstruct`: any place of it by chainage and clock, and the
keyframes that see it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.camera import Camera
from pipefish.cloudfile import read_columns
from pipefish.errors import FormatError, PipefishError
from pipefish.measured_files import RING, wall_columns
from pipefish.measured_texts import read_measured
from pipefish.measurement import Measurement
from pipefish.survey import Survey


@dataclass(frozen=True)
class Piece:
    """A piece of wall between joints: rings of RING vertices, clockwise from twelve o'clock looking along the tube's s.

    chainage (n,) ascending; rings (n,RING,3); deviation (n,RING); sign: of chainage along s; stretch: its number
    """

    chainage: np.ndarray
    rings: np.ndarray
    deviation: np.ndarray
    sign: int
    stretch: int

    @property
    def start(self) -> float:
        return float(self.chainage[0])

    @property
    def end(self) -> float:
        return float(self.chainage[-1])

    @cached_property
    def _slopes(self) -> np.ndarray:
        return np.gradient(self.rings, self.chainage, axis=0)

    def at(self, chainage: np.ndarray, clock: np.ndarray) -> np.ndarray:
        """Places (n,m,3) at chainages (n,) and clock angles (m,), cubic between the vertices; a little beyond the ends
        too."""
        i = np.clip(np.searchsorted(self.chainage, chainage, "right") - 1, 0, len(self.chainage) - 2)
        step = (self.chainage[i + 1] - self.chainage[i])[:, None, None]
        t = (chainage - self.chainage[i])[:, None, None] / step
        a, b = self.rings[i], self.rings[i + 1]
        rings = (2 * t**3 - 3 * t**2 + 1) * a + (3 * t**2 - 2 * t**3) * b
        rings += step * ((t**3 - 2 * t**2 + t) * self._slopes[i] + (t**3 - t**2) * self._slopes[i + 1])
        turn = (clock / (2 * np.pi) * RING) % RING
        k = turn.astype(int)
        t = (turn - k)[:, None]
        p, q, r, s = (rings[:, (k + n) % RING] for n in (-1, 0, 1, 2))
        return q + 0.5 * t * (r - p + t * (2 * p - 5 * q + 4 * r - s + t * (3 * (q - r) + s - p)))


@dataclass
class Wall:
    """A measured pipe with its keyframes.

    pieces     by chainage
    camera, survey   of the measurement, the camera's pupil shift as estimated where no encoder tells lengths
    poses      (K,3,4) cam_from_world, keyframe (K,) index of each in the survey, stretch (K,)
    chainage   (K,) of the place of the axis beside each camera
    diameter   mean, metres (or 1: `unit` "diameter"); length of the wall's unit
    """

    document: dict[str, Any]
    pieces: list[Piece]
    camera: Camera
    survey: Survey
    poses: np.ndarray
    keyframe: np.ndarray
    stretch: np.ndarray
    chainage: np.ndarray
    diameter: float

    @property
    def start(self) -> float:
        return min(p.start for p in self.pieces)

    @property
    def end(self) -> float:
        return max(p.end for p in self.pieces)

    @property
    def unit(self) -> str:
        return str(self.document["summary"]["unit"])

    def picture(self, view: int) -> np.ndarray:
        """(H,W) uint8 picture of the view, a place in `keyframe`. Raises FormatError."""
        frame = self._frames.get(int(self.keyframe[view]))
        if frame is None:
            raise FormatError(self.survey.path, None, f"has no keyframe {self.keyframe[view]}: another survey?")
        grey = np.asarray(frame.image)
        if grey.shape != (self.camera.height, self.camera.width):
            size = f"{grey.shape[1]} x {grey.shape[0]}, the camera's are {self.camera.width} x {self.camera.height}"
            raise FormatError(self.survey.path, f"keyframe {frame.index}", f"its picture is {size}")
        return np.ascontiguousarray(grey)

    @cached_property
    def _frames(self) -> dict[int, Any]:
        return {k.index: k for k in self.survey.keyframes}


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """(N,4) unit quaternions w, x, y, z -> (N,3,3)."""
    w, x, y, z = np.asarray(quaternion, float).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def pieces_of(wall: dict[str, np.ndarray], document: dict[str, Any], path: Path) -> list[Piece]:
    """The pieces of a wall, by chainage, from the columns of tube.ply (path: for errors). Raises FormatError."""
    if {"deviation", "piece", "chainage", "stretch"} - set(wall) or len(wall["x"]) % RING or not len(wall["x"]):
        raise FormatError(path, "vertex", "not a wall that this version of `pipefish reconstruct` wrote")
    signs = {t["stretch"]: t["chainage_sign"] for t in document["tubes"]}
    xyz = np.stack([wall[k].astype(float) for k in "xyz"], -1).reshape(-1, RING, 3)
    deviation = wall["deviation"].astype(float).reshape(-1, RING)
    chainage, piece, stretch = (wall[k].reshape(-1, RING)[:, 0] for k in ("chainage", "piece", "stretch"))
    out = []
    for number in np.unique(piece):
        rows = np.flatnonzero(piece == number)
        rows = rows[np.argsort(chainage[rows], kind="stable")]
        sign = signs.get(int(stretch[rows[0]]))
        if sign is None or len(rows) < 2 or not (np.diff(chainage[rows]) > 0).all():
            raise FormatError(path, f"piece {number}", "its rings do not fit reconstruction.json")
        along = chainage[rows].astype(float)
        out.append(Piece(along, xyz[rows], deviation[rows], int(sign), int(stretch[rows[0]])))
    return sorted(out, key=lambda p: p.start)


def read_wall(folder: Path, survey: Path | None = None) -> Wall:
    """The wall of a folder of `pipefish reconstruct`; survey: its file [where it was].

    Raises PipefishError, OSError."""
    document = read_measured(folder)
    try:
        pieces = pieces_of(read_columns(folder / "tube.ply"), document, folder / "tube.ply")
        return wall_of(document, pieces, _survey_of(folder, document, survey))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, PipefishError):
            raise
        raise FormatError(folder / "reconstruction.json", None, f"not whole: {error!r:.80}") from None


def _survey_of(folder: Path, document: dict[str, Any], survey: Path | None) -> Survey:
    path = survey or Path(document["survey"]["file"])
    if not path.exists() and survey is None and (folder.parent / path.name).exists():
        path = folder.parent / path.name  # the two were moved together
    if not path.exists():
        raise PipefishError(f"{path}: the survey with the pictures is not there; name it with --survey")
    opened = Survey.open(path)
    if opened.survey_id != document["survey"]["survey_id"]:
        raise PipefishError(f"{path}: is not the survey that was measured ({document['survey']['survey_id']})")
    return opened


def measured_wall(m: Measurement, document: dict[str, Any]) -> Wall:
    """The wall of a measurement and its document (measured_files.document_of)."""
    return wall_of(document, pieces_of(wall_columns(m)[0], document, m.survey.path), m.survey)


def wall_of(document: dict[str, Any], pieces: list[Piece], survey: Survey) -> Wall:
    """The wall of a document of reconstruction.json, its pieces and its survey."""
    poses = document["poses"]
    turn = rotation_of(np.array(poses["quaternion"], float))
    shift = np.array(poses["translation"], float)
    centres, stretch = -np.einsum("nij,ni->nj", turn, shift), np.array(poses["stretch"], int)
    along = np.full(len(centres), np.nan)
    for number in np.unique(stretch):
        here, of = stretch == number, [p for p in pieces if p.stretch == number]
        if of:
            along[here] = _beside(of, centres[here])
    camera = Camera.from_document(document["camera"]["profile"], "reconstruction.json")
    told = document.get("structure", {}).get("pupil_e1", [])  # older ones do not say
    pupil = [told[k] for k in sorted({p.stretch for p in pieces}) if k < len(told)]
    if pupil:  # as the structure has it, in its unit
        camera = dataclasses.replace(camera, pupil_e1=float(np.median(pupil)))
    return Wall(
        document=document,
        pieces=pieces,
        camera=camera,
        survey=survey,
        poses=np.concatenate([turn, shift[:, :, None]], axis=2),
        keyframe=np.array(poses["keyframe"], int),
        stretch=stretch,
        chainage=along,
        diameter=float(document["summary"]["d_mean"]),
    )


def _beside(pieces: list[Piece], centres: np.ndarray) -> np.ndarray:
    """Chainage of the place of the axis nearest to each of (n,3), beyond the ends along their tangents."""
    axis = np.concatenate([p.rings.mean(axis=1) for p in pieces])
    chainage = np.concatenate([p.chainage for p in pieces])
    tangent = np.concatenate([np.gradient(p.rings.mean(axis=1), p.chainage, axis=0) for p in pieces])
    out = np.empty(len(centres))
    for i, centre in enumerate(centres):
        k = int(np.argmin(((axis - centre) ** 2).sum(axis=1)))
        out[i] = chainage[k] + (centre - axis[k]) @ tangent[k] / (tangent[k] @ tangent[k])
    return out
