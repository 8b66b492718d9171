"""tube.glb and deviation.glb against the glTF 2.0 specification, read here from its text, and against the wall."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipefish.simulate import Scene
from rendered_survey import MARKS, SCENE

SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
TYPES = {5121: "u1", 5123: "u2", 5125: "u4", 5126: "f4"}
PARTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Gltf:
    """A .glb file, every rule checked that its parts must keep."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.document = d = json.loads(data[20 : 20 + size])
        binary, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert kind == b"BIN\0" and binary % 4 == 0 and 28 + size + binary == len(data)
        self.binary = data[28 + size :]
        assert d["asset"]["version"] == "2.0" and d["buffers"][0]["byteLength"] <= binary
        for view in d["bufferViews"]:
            assert view["byteOffset"] + view["byteLength"] <= d["buffers"][0]["byteLength"]
        nodes = [n for scene in d["scenes"] for n in scene["nodes"]]
        assert d["scene"] < len(d["scenes"]) and nodes == [0]
        assert sorted(d["nodes"][0]["children"]) == list(range(1, len(d["nodes"])))
        turn = np.array(d["nodes"][0]["matrix"]).reshape(4, 4).T
        self.turn = turn[:3, :3]
        assert np.allclose(self.turn @ self.turn.T, np.eye(3)) and np.linalg.det(self.turn) == pytest.approx(1)
        assert turn[3].tolist() == [0, 0, 0, 1]
        self.primitives = [self._primitive(p) for n in d["nodes"][1:] for p in d["meshes"][n["mesh"]]["primitives"]]

    def values(self, number: int) -> np.ndarray:
        a = self.document["accessors"][number]
        view, parts = self.document["bufferViews"][a["bufferView"]], PARTS[a["type"]]
        assert view["byteOffset"] % SIZES[a["componentType"]] == 0
        assert a["count"] * parts * SIZES[a["componentType"]] == view["byteLength"]
        raw = np.frombuffer(self.binary, "<" + TYPES[a["componentType"]], a["count"] * parts, view["byteOffset"])
        return raw.reshape(a["count"], parts)

    def _primitive(self, p: dict) -> dict[str, np.ndarray]:
        out = {name: self.values(number) for name, number in p["attributes"].items()}
        assert len({len(v) for v in out.values()}) == 1, "as many of each attribute"
        position = self.document["accessors"][p["attributes"]["POSITION"]]
        assert np.array_equal(position["min"], out["POSITION"].min(0))
        assert np.array_equal(position["max"], out["POSITION"].max(0))
        assert np.allclose(np.linalg.norm(out["NORMAL"], axis=1), 1, atol=1e-5)
        indices = self.values(p["indices"])[:, 0]
        assert len(indices) % 3 == 0 and indices.max() < len(out["POSITION"])
        target = self.document["bufferViews"][self.document["accessors"][p["indices"]]["bufferView"]]["target"]
        assert target == 34963
        corners = out["POSITION"].astype(float)[indices.reshape(-1, 3)]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        facing = np.einsum("ni,ni->n", across, out["NORMAL"][indices.reshape(-1, 3)[:, 0]])
        assert (facing > 0).all(), "anticlockwise from where the normals point"
        material = self.document["materials"][p["material"]]
        texture = material["pbrMetallicRoughness"].get("baseColorTexture")
        if texture is not None:
            source = self.document["textures"][texture["index"]]["source"]
            image = self.document["images"][source]
            view = self.document["bufferViews"][image["bufferView"]]
            data = self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
            picture = Image.open(io.BytesIO(data))
            assert Image.MIME[picture.format] == image["mimeType"] and max(picture.size) <= 4096
            out["picture"] = np.asarray(picture.convert("L"))
        return out


def test_the_textured_wall_is_whole_and_its_picture_lies_where_the_discs_are(measured):
    """Every disc's place in space, by the simulator's truth, takes a bright pixel out of the texture; the places beside
    it dark ones. So texture, vertices and chainage belong together and nothing is mirrored."""
    glb = Gltf(measured / "out" / "tube.glb")
    (wall,) = glb.primitives
    assert (wall["TEXCOORD_0"] >= -1e-6).all() and (wall["TEXCOORD_0"] <= 1 + 1e-6).all()
    scene, picture = Scene(SCENE), wall["picture"].astype(float)
    first = scene.pose(0)
    at = wall["POSITION"].astype(float)
    for s, phi in MARKS[2:-1]:
        place = first[:, :3] @ scene.wall(s, phi) + first[:, 3]  # the pipe's frame is the first keyframe's
        near = np.argsort(np.linalg.norm(at - place, axis=1))[:9]
        assert np.linalg.norm(at[near[0]] - place) < 0.02
        middle, texture = at[near].mean(axis=0), wall["TEXCOORD_0"][near].astype(float)
        slope = np.linalg.lstsq(at[near] - middle, texture - texture.mean(axis=0), rcond=0.05)[0]  # in the wall only
        u, v = texture.mean(axis=0) + (place - middle) @ slope
        row, column = int(v * picture.shape[0]) % picture.shape[0], int(u * picture.shape[1])
        patch = picture[np.ix_(np.arange(row - 1, row + 2) % len(picture), range(column - 1, column + 2))]
        assert patch.max() > 1.4 * np.median(picture), f"the disc at {s}"


def test_gravity_points_down(measured):
    """In glTF y is up: the wall's frame is turned by the inclinometer's vertical."""
    document = json.loads((measured / "out" / "reconstruction.json").read_text())
    for name in ("tube.glb", "deviation.glb"):
        turn = Gltf(measured / "out" / name).turn
        assert np.allclose(turn @ document["structure"]["down"], [0, -1, 0], atol=1e-6)


def test_vertices_are_coloured_by_deviation(measured):
    """Orange where the wall is outside, blue where it is inside; the values stand beside the colours."""
    glb = Gltf(measured / "out" / "deviation.glb")
    colour = np.concatenate([p["COLOR_0"] for p in glb.primitives])
    deviation = np.concatenate([p["_DEVIATION"] for p in glb.primitives])[:, 0]
    assert (colour >= 0).all() and (colour <= 1).all()
    assert deviation.max() > 0.002 and deviation.min() < -0.002, "the oval stretch: 6 % of 200 mm"
    out, inside = deviation > 0.002, deviation < -0.002
    assert (colour[out, 0] > colour[out, 2]).all() and (colour[inside, 2] > colour[inside, 0]).all()
    assert set(json.loads((measured / "out" / "reconstruction.json").read_text())["files"]) >= {
        "tube.glb",
        "deviation.glb",
    }
