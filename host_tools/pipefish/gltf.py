"""The wall as glTF 2.0 (.glb): one file with the keyframes' picture on it, one coloured by deviation.

The glTF specification 2.0 (Khronos): right-handed, y up, metres, textures with (0, 0) at the upper left corner."""

from __future__ import annotations

import io
import json
import math
import struct
from typing import Any

import numpy as np
from PIL import Image

from pipefish import __version__
from pipefish.colours import diverging
from pipefish.errors import PipefishError
from pipefish.measured_files import COLOUR_SPAN, RING
from pipefish.measurement import Measurement
from pipefish.unroll import Tell, Unroller
from pipefish.wall import Piece, Wall, measured_wall

TEXTURE = 4096  # columns of one picture: what every graphics card takes
AROUND = 500  # pixels of the texture around the pipe, about
MOST_COLUMNS = 60_000  # of all textures: 15 MB; longer pipes get coarser ones
QUALITY = 82
NOT_SEEN = 60  # grey
FLOAT, UNSIGNED_INT, UNSIGNED_BYTE = 5126, 5125, 5121
ARRAY, ELEMENTS = 34962, 34963  # targets of buffer views
REPEAT, CLAMP, LINEAR, MIPMAPS = 10497, 33071, 9729, 9987


class Glb:
    """Collects what goes into a binary glTF file."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"pipefish {__version__}"},
            "scene": 0,
            "bufferViews": [],
            "accessors": [],
            "meshes": [],
            "materials": [],
        }

    def view(self, data: bytes, target: int | None = None) -> int:
        """Adds bytes; their number as a buffer view."""
        self._bytes += b"\0" * (-len(self._bytes) % 4)
        view = {"buffer": 0, "byteOffset": len(self._bytes), "byteLength": len(data)}
        self._bytes += data
        self.document["bufferViews"].append(view | ({"target": target} if target else {}))
        return len(self.document["bufferViews"]) - 1

    def array(self, values: np.ndarray, kind: str, target: int = ARRAY, **more: Any) -> int:
        """Adds an array of float32, uint32 or uint8; its number as an accessor of a kind ("VEC3", ...)."""
        types = {"f4": FLOAT, "u4": UNSIGNED_INT, "u1": UNSIGNED_BYTE}
        accessor = {"bufferView": self.view(values.tobytes(), target), "count": len(values), "type": kind}
        accessor |= {"componentType": types[values.dtype.str[1:]]}
        self.document["accessors"].append(accessor | more)
        return len(self.document["accessors"]) - 1

    def finish(self, up: np.ndarray, extras: dict[str, Any]) -> bytes:
        """The file. up: the direction in the pipe's frame that becomes y."""
        d = self.document
        meshes = range(len(d["meshes"]))
        root = {"name": "pipe", "matrix": _upright(up), "children": [k + 1 for k in meshes], "extras": extras}
        d["nodes"] = [root, *({"mesh": k, "name": d["meshes"][k]["name"]} for k in meshes)]
        d["scenes"] = [{"nodes": [0]}]
        self._bytes += b"\0" * (-len(self._bytes) % 4)
        d["buffers"] = [{"byteLength": len(self._bytes)}]
        text = json.dumps(d, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self._bytes)
        head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
        return head + struct.pack("<I4s", len(self._bytes), b"BIN\0") + bytes(self._bytes)


def _upright(up: np.ndarray) -> list[float]:
    """A rotation, column by column, that takes `up` to y and the pipe's beginning, z, as far as it can to -z."""
    y = up / np.linalg.norm(up)
    ahead = np.array([0.0, 0.0, 1.0]) if abs(y[2]) < 0.9 else np.array([0.0, -1.0, 0.0])
    z = -(ahead - (ahead @ y) * y)
    z /= np.linalg.norm(z)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.cross(y, z), y, z])
    return turn.T.ravel().tolist()


def _grid(rings: int, around: int) -> np.ndarray:
    """(m,3) triangles of rings of `around` vertices, anticlockwise as seen from inside; a ring's last and first vertex
    are not joined."""
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around - 1), indexing="ij")
    a = (i * around + j).ravel()
    return np.concatenate([np.c_[a, a + 1, a + around], np.c_[a + 1, a + around + 1, a + around]])


def _mesh(piece: Piece, chainage: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n,RING+1,3) at chainages, going around as the rows of the unrolled picture do (the last is the first
    again), unit normals to the inside, deviations (n,RING+1), triangles."""
    clock = -piece.sign * np.arange(RING + 1) * 2 * np.pi / RING
    at = piece.at(chainage, clock)
    step = 1e-3 * float(np.ptp(piece.chainage))
    along = piece.at(chainage + step, clock) - piece.at(chainage - step, clock)
    down = piece.at(chainage, clock - piece.sign * 1e-3) - piece.at(chainage, clock + piece.sign * 1e-3)
    normal = -np.cross(along, down)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    order = (-piece.sign * np.arange(RING + 1)) % RING
    deviation = np.stack([np.interp(chainage, piece.chainage, column) for column in piece.deviation[:, order].T], 1)
    return at, normal, deviation, _grid(len(chainage), RING + 1)


def _primitive(glb: Glb, at: np.ndarray, normal: np.ndarray, triangles: np.ndarray) -> dict[str, Any]:
    points = at.reshape(-1, 3).astype(np.float32)
    ends = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    attributes = {"POSITION": glb.array(points, "VEC3", **ends)}
    attributes["NORMAL"] = glb.array(normal.reshape(-1, 3).astype(np.float32), "VEC3")
    indices = glb.array(triangles.astype(np.uint32).ravel(), "SCALAR", ELEMENTS)
    return {"attributes": attributes, "indices": indices}


def _material(**more: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0, **more}, "doubleSided": True}


def _up(document: dict[str, Any]) -> np.ndarray:
    down = document["structure"]["down"]
    return -np.array(down if down else [0.0, 1.0, 0.0], float)


def _extras(document: dict[str, Any]) -> dict[str, Any]:
    unit = document["summary"]["unit"]
    return {"unit": unit, "survey_id": document["survey"]["survey_id"], "clock_zero": document["clock_zero"]}


def deviation_glb(pieces: list[Piece], document: dict[str, Any]) -> bytes:
    """The wall, its vertices coloured by deviation: grey where it is 0, full colour at COLOUR_SPAN diameters."""
    glb = Glb()
    glb.document["materials"].append(_material() | {"name": "deviation"})
    size = document["summary"]["d_mean"]
    for number, piece in enumerate(pieces):
        at, normal, deviation, triangles = _mesh(piece, piece.chainage)
        primitive = _primitive(glb, at, normal, triangles) | {"material": 0}
        srgb = diverging(np.clip(deviation.ravel() / (COLOUR_SPAN * size), -1, 1)) / 255.0
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)  # vertex colours are linear
        primitive["attributes"]["COLOR_0"] = glb.array(linear.astype(np.float32), "VEC3")
        primitive["attributes"]["_DEVIATION"] = glb.array(deviation.astype(np.float32).ravel(), "SCALAR")
        glb.document["meshes"].append({"name": f"piece {number}", "primitives": [primitive]})
    return glb.finish(_up(document), _extras(document))


def wall_glb(wall: Wall, tell: Tell | None = None) -> bytes:
    """The wall with what the keyframes show of it. Raises PipefishError where they show nothing of it."""
    cell = max(math.pi * wall.diameter / AROUND, (wall.end - wall.start) / MOST_COLUMNS)
    unroller = Unroller(wall, cell=cell, tell=tell)
    glb = Glb()
    d = glb.document
    d |= {"images": [], "textures": [], "samplers": []}
    d["samplers"].append({"magFilter": LINEAR, "minFilter": MIPMAPS, "wrapS": CLAMP, "wrapT": REPEAT})
    for a in range(0, unroller.columns, TEXTURE):
        count = min(TEXTURE, unroller.columns - a)
        start, end = unroller.start + cell * np.array([a, a + count])
        drawn = unroller.draw(a, count)
        stream = io.BytesIO()
        grey = np.where(drawn.seen > 0, drawn.grey, NOT_SEEN).astype(np.uint8)
        Image.fromarray(grey).convert("RGB").save(stream, "JPEG", quality=QUALITY)
        number = len(d["images"])
        d["images"].append({"bufferView": glb.view(stream.getvalue()), "mimeType": "image/jpeg"})
        d["textures"].append({"source": number, "sampler": 0})
        d["materials"].append(_material(baseColorTexture={"index": number}) | {"name": f"wall {start:.2f}"})
        for piece in wall.pieces:
            low, high = max(piece.start, start), min(piece.end, end)
            if high - low < cell:
                continue
            inner = piece.chainage[(piece.chainage > low + 0.5 * cell) & (piece.chainage < high - 0.5 * cell)]
            chainage = np.concatenate([[low], inner, [high]])
            at, normal, _, triangles = _mesh(piece, chainage)
            primitive = _primitive(glb, at, normal, triangles) | {"material": number}
            u = np.repeat((chainage - start) / (end - start), RING + 1)
            v = np.tile(np.arange(RING + 1) / RING, len(chainage))
            primitive["attributes"]["TEXCOORD_0"] = glb.array(np.stack([u, v], 1).astype(np.float32), "VEC2")
            d["meshes"].append({"name": f"{low:.2f} to {high:.2f}", "primitives": [primitive]})
    return glb.finish(_up(wall.document), _extras(wall.document))


def gltf_files(m: Measurement, document: dict[str, Any], tell: Tell | None = None) -> tuple[dict[str, bytes], str]:
    """tube.glb and deviation.glb of a measurement and its document, and a note for people: why there is no tube.glb
    where the pictures cannot be put on the wall."""
    wall = measured_wall(m, document)
    files = {"deviation.glb": deviation_glb(wall.pieces, document)}
    try:
        return {"tube.glb": wall_glb(wall, tell)} | files, ""
    except PipefishError as error:
        return files, f"No tube.glb: {error}."
