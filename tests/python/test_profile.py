"""The forms of a profile: JSON of every version, its schema, and the binary as lib/profile/SPEC.md describes it."""

import dataclasses
import json
import math
from pathlib import Path

import fastjsonschema
import numpy as np
import pytest

import pipefish as pf
import spec_reader
from pipefish import cli, profile_json
from pipefish.errors import ProfileError
from test_camera import make

ROOT = Path(__file__).resolve().parents[2]

VERSION_1 = """{
  "format": "pipefish-profile", "version": 1, "name": "old", "serial": "7", "source": "target",
  "created": "2026-01-31T12:00:05Z", "rms_px": 0.25, "theta_covered": null, "width": 640, "height": 480,
  "f_u": 200.5, "f_v": 200.25, "c_u": 320.5, "c_v": 240.5, "k2": -0.03125, "k3": 0, "k4": 0, "k5": 0,
  "theta_max": 1.5, "covariance": {"parameters": ["f_u", "k2"], "lower": [[0.25], [0.0, 1e-6]]}
}"""


@pytest.fixture(scope="module")
def schema():
    return fastjsonschema.compile(json.loads((ROOT / "docs/profile.schema.json").read_text()))


def test_json_of_version_1_loads_for_good(tmp_path, schema):
    path = tmp_path / "old.json"
    path.write_text(VERSION_1)
    schema(json.loads(VERSION_1))
    cam = pf.Camera.load(path)
    assert (cam.name, cam.serial, cam.f_u, cam.rms_px) == ("old", "7", 200.5, 0.25)
    assert cam.lens == "" and cam.held_out_rms_px is None and cam.provenance == pf.Provenance()
    assert cam.covariance.tolist() == [[0.25, 0], [0, 1e-6]]
    cam.save(path)
    assert json.loads(path.read_text())["version"] == 2 and pf.Camera.load(path) == cam


@pytest.mark.parametrize("key", ["lens", "held_out_rms_px", "provenance", "units"])
def test_version_1_has_no_later_keys(tmp_path, schema, key):
    path = tmp_path / "mixed.json"
    document = json.loads(VERSION_1) | {key: json.loads(make().to_json())[key]}
    path.write_text(json.dumps(document))
    with pytest.raises(ProfileError, match=f"{key}: no such key in a profile of version 1"):
        pf.Camera.load(path)
    with pytest.raises(fastjsonschema.JsonSchemaValueException):
        schema(document)


def test_what_we_ship_and_write_follows_the_schema(schema):
    for file in sorted((ROOT / "calib_profiles").glob("*.json")):
        schema(json.loads(file.read_text(encoding="utf-8")))
    schema(json.loads(make().to_json()))
    schema(json.loads(make(covariance=None, covariance_parameters=(), rms_px=None, created=None).to_json()))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("f_w", 1),
        ("version", 3),
        ("f_u", 0),
        ("f_u", None),
        ("radial", "fisheye"),
        ("units", {"angle": "degree"}),
        ("provenance", {"author": "me"}),
        ("tilt", [0]),
        ("created", "yesterday"),
        ("held_out_rms_px", -1),
        ("covariance", {"parameters": ["focal"], "lower": [[1]]}),
    ],
)
def test_the_schema_refuses_what_load_refuses(tmp_path, schema, key, value):
    document = json.loads(make().to_json()) | {key: value}
    with pytest.raises(fastjsonschema.JsonSchemaValueException):
        schema(document)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ProfileError):
        pf.Camera.load(path)


def test_a_fourier_vector_of_any_norm_is_read_as_one_of_unit_norm(tmp_path):
    """The product a b stays; and the covariance of the product stays, which the unit form must also describe."""
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=3), 2.5 * rng.normal(size=4)
    names = [f"asym_radial_theta[{i}]" for i in range(3)] + [f"asym_radial_phi[{i}]" for i in range(4)]
    half = rng.normal(size=(7, 7))
    covariance = half @ half.T * 1e-6
    lower = [covariance[i, : i + 1].tolist() for i in range(7)]
    document = json.loads(make().to_json()) | {
        "asym_radial_theta": a.tolist(),
        "asym_radial_phi": b.tolist(),
        "covariance": {"parameters": names, "lower": lower},
    }
    path = tmp_path / "gauge.json"
    path.write_text(json.dumps(document))
    values = profile_json.read(path)
    unit_a, unit_b = np.array(values["asym_radial_theta"]), np.array(values["asym_radial_phi"])
    assert np.linalg.norm(unit_b) == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(np.outer(unit_a, unit_b), np.outer(a, b), rtol=1e-14)

    def product_covariance(a, b, covariance):  # of the 12 numbers a_i b_j
        jacobian = np.hstack([np.kron(np.eye(3), b[:, None]), np.kron(a[:, None], np.eye(4))])
        return jacobian @ covariance @ jacobian.T

    expected = product_covariance(a, b, covariance)
    np.testing.assert_allclose(
        product_covariance(unit_a, unit_b, values["covariance"]), expected, atol=1e-12 * expected.max()
    )
    scale = unit_b @ values["covariance"][3:, 3:] @ unit_b
    assert abs(scale) < 1e-14 * values["covariance"][3:, 3:].max()  # the unit norm has no uncertainty

    document["covariance"] = {"parameters": names[3:], "lower": [lower[i][: i + 1] for i in range(4)]}
    path.write_text(json.dumps(document))
    with pytest.raises(ProfileError, match="asym_radial_phi, whose norm is not 1"):
        profile_json.read(path)


def test_a_unit_fourier_vector_stays_bit_for_bit(tmp_path):
    b = (np.array([3.0, -1.0, 2.0, 0.5]) / np.linalg.norm([3.0, -1.0, 2.0, 0.5])).tolist()
    document = json.loads(make().to_json()) | {"asym_radial_theta": [0.1, 0.2, 0.3], "asym_radial_phi": b}
    path = tmp_path / "unit.json"
    path.write_text(json.dumps(document))
    values = profile_json.read(path)
    assert values["asym_radial_phi"] == b and values["asym_radial_theta"] == [0.1, 0.2, 0.3]


def test_a_reader_made_from_the_specification_reads_the_binary_form():
    cam = make()
    data = cam.to_binary()
    read = spec_reader.read(data)
    assert read["version"] == 2 and len(data) == 812 + 4 * 3 * 4 + 64 * 8 + 28 * 8
    for key in ("width", "height", "f_u", "f_v", "skew", "c_u", "c_v", "k2", "k3", "k4", "k5", "mirror", "pupil_e1"):
        assert read[key] == getattr(cam, key), key
    for key in ("theta_max", "circle_u", "circle_v", "circle_radius", "tilt", "cpoly", *spec_reader.ARRAYS):
        assert read[key] == getattr(cam, key), key
    for key in ("name", "serial", "lens", "rms_px", "held_out_rms_px", "theta_covered"):
        assert read[key] == getattr(cam, key), key
    assert (read["source"], read["radial"], read["created"]) == (1, 0, int(cam.created.timestamp()))
    origin = cam.provenance
    assert (read["tool"], read["tool_version"], read["model_choice"]) == ("pipefish", "0.1.0", "p9")
    assert (read["views"], read["points"], read["held_out_views"]) == (origin.views, origin.points, 5)
    assert read["free"] == [pf.PARAMETERS.index(name) for name in cam.covariance_parameters]
    assert read["covariance"] == tuple(cam.covariance[np.tril_indices(3)])
    unknown = make(rms_px=None, held_out_rms_px=None, covariance=None, covariance_parameters=(), theta_covered=None)
    read = spec_reader.read(unknown.to_binary())
    assert read["rms_px"] is None and read["held_out_rms_px"] is None and read["free"] == []


def test_the_vectors_are_what_the_model_says_and_cover_the_domain_up_to_the_rim():
    """Recomputed from the formulas of docs/profile.md, in numpy."""
    cam = make()
    vectors = np.array(spec_reader.read(cam.to_binary())["vectors"])
    xyz, uv, ray = vectors[:, :3], vectors[:, 3:5], vectors[:, 5:]
    theta, phi = np.arctan2(np.hypot(xyz[:, 0], xyz[:, 1]), xyz[:, 2]), np.arctan2(xyz[:, 1], xyz[:, 0])
    r = theta + cam.k2 * theta**3 + cam.k3 * theta**5 + cam.k4 * theta**7 + cam.k5 * theta**9
    x, y = r * np.cos(phi), r * np.sin(phi)
    np.testing.assert_allclose(uv[:, 0], cam.f_u * x + cam.skew * y + cam.c_u, rtol=0, atol=1e-9)
    np.testing.assert_allclose(uv[:, 1], cam.f_v * y + cam.c_v, rtol=0, atol=1e-9)
    np.testing.assert_allclose(ray, xyz / np.linalg.norm(xyz, axis=1)[:, None], rtol=0, atol=1e-12)
    assert theta[0] == 0 and (theta > 0.99999 * cam.theta_max).sum() == 4 and (theta <= cam.theta_max).all()
    ends = np.sort(phi[theta > 0.99 * cam.theta_max])
    assert np.diff(np.append(ends, ends[0] + 2 * math.pi)).max() < math.radians(140)


def test_a_profile_whose_vectors_disagree_is_refused():
    data = bytearray(make().to_binary())
    at = len(data) - 4 - 28 * 8 - 64 + 24  # u of the last vector
    data[at : at + 8] = np.float64(np.frombuffer(data[at : at + 8])[0] + 1e-6).tobytes()
    data[-4:] = spec_reader.crc32c(bytes(data[:-4])).to_bytes(4, "little")
    with pytest.raises(ProfileError, match="self_test: this device does not project"):
        pf.Camera.from_binary(bytes(data))


def test_the_integer_vectors_are_the_same_in_q16_and_q30():
    read = spec_reader.read(make().to_binary())
    vectors, integers = np.array(read["vectors"]), np.array(read["integer_vectors"])
    assert len(integers) == 8
    np.testing.assert_array_equal(integers[:, :2], np.floor(vectors[:, 3:5] * 2**16 + 0.5))
    np.testing.assert_allclose(integers[:, 2:5] / 2**30, vectors[:, 5:], rtol=0, atol=1e-6)
    np.testing.assert_allclose(integers[:, 5:], integers[:, :2], rtol=0, atol=8)


def test_a_profile_with_one_wrong_bit_in_an_integer_vector_is_refused(tmp_path, capsys):
    data = bytearray(make().to_binary())
    data[-4 - 28 + 8] ^= 1  # x of the last ray
    data[-4:] = spec_reader.crc32c(bytes(data[:-4])).to_bytes(4, "little")
    with pytest.raises(ProfileError, match="self_test: the fixed-point camera of this device"):
        pf.Camera.from_binary(bytes(data))
    path = tmp_path / "camera.profile"
    path.write_bytes(data)
    assert cli.main(["profile", "check", str(path)]) == 1
    assert "self_test: the fixed-point camera of this device" in capsys.readouterr().err


def test_a_lens_beyond_fixed_point_has_no_integer_vectors():
    lens = make(radial="perspective", k2=0.0, k3=0.0, k4=0.0, k5=0.0, mirror=0.0, theta_max=1.5707, theta_covered=1.0)
    lens = dataclasses.replace(lens, covariance=None, covariance_parameters=())
    assert spec_reader.read(lens.to_binary())["integer_vectors"] == []
    assert pf.Camera.from_binary(lens.to_binary()).theta_max == 1.5707


def test_the_binary_of_version_1_loads(tmp_path):
    """The bytes that a released program wrote (the same as in tests/unit/test_profile.c)."""
    source = (ROOT / "tests/unit/test_profile.c").read_text()
    text = source[source.index("GOLDEN_1[] =") :]
    data = bytes.fromhex("".join(text[: text.index(";")].split('"')[1::2]))
    read, cam = spec_reader.read(data), pf.Camera.from_binary(data)
    assert read["version"] == 1 and read["vectors"] == [] and "lens" not in read
    for key in ("name", "serial", "f_u", "k5", "rms_px", "theta_covered", "width", "theta_max"):
        assert read[key] == getattr(cam, key), key
    assert cam.lens == "" and cam.held_out_rms_px is None
