"""Homographies from conics: closed forms, all candidates, degenerate cases, noise; pose of discs from outlines."""

from __future__ import annotations

import json
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish import _engine, cli
from pipefish.conics import ellipse, ellipse_centre, ellipses_in, load_conics, map_conics, match_conics

H = np.array([[1.1, 0.2, 30.0], [-0.1, 0.9, -20.0], [3e-4, -2e-4, 1.0]])
ELLIPSES = np.array(
    [
        ellipse((100, 80), (30, 20), 0.3),
        ellipse((300, 120), (25, 25)),
        ellipse((180, 260), (40, 15), 1.2),
        ellipse((350, 300), (20, 30), -0.5),
    ]
)


def same(a: np.ndarray, b: np.ndarray) -> float:
    """The largest difference of two matrices whose scale means nothing."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return float(min(np.abs(a - b).max(), np.abs(a + b).max()))


@pytest.mark.parametrize("count", [3, 4])
def test_three_and_four_conics_give_back_their_homography(count: int) -> None:
    c = ELLIPSES[:count]
    scales = np.array([1.0, -7.0, 1e-3, 50.0])[:count, None, None]  # a conic's scale and sign mean nothing
    found = pf.homography_from_conics(c, scales * map_conics(H, c))
    assert found.shape == (1, 3, 3)
    assert same(found[0], H) < 1e-10
    assert np.linalg.det(found[0]) == pytest.approx(1)


@pytest.mark.parametrize(
    ("pair", "count"),
    [
        ((0, 1), 4),  # apart
        ((4, 5), 4),  # one within the other
        ((6, 7), 2),  # meeting in two points
    ],
)
def test_two_conics_give_every_real_candidate_the_truth_among_them(pair: tuple[int, int], count: int) -> None:
    more = [
        ellipse((0, 0), (50, 40)),
        ellipse((5, 3), (20, 10), 0.2),
        ellipse((0, 0), (30, 20)),
        ellipse((30, 5), (25, 20)),
    ]
    c = np.concatenate([ELLIPSES, more])[list(pair)]
    image = map_conics(H, c)
    found = pf.homography_from_conics(c, image)
    assert len(found) == count
    for h in found:  # all of them map both conics
        for got, want in zip(map_conics(h, c), image, strict=True):
            assert same(got, want) < 1e-8
    assert min(same(h, H) for h in found) < 1e-8
    for a in range(count):
        for b in range(a):
            assert same(found[a], found[b]) > 1e-4
    kept = [np.linalg.norm(ellipse_centre(map_conics(h, c)) - ellipse_centre(image)) for h in found[:1]]
    assert kept[0] < 1e-4  # centres inside and orientation kept comes first


def test_unit_circle_and_its_shift_have_the_identity_among_their_candidates() -> None:
    c = np.array([ellipse((0, 0), (1, 1)), ellipse((3, 0), (1, 1))])
    found = pf.homography_from_conics(c, c)
    assert any(same(h, np.eye(3)) < 1e-9 for h in found)
    assert any(same(h, np.diag([1.0, -1, 1])) < 1e-9 for h in found)  # and the reflection about their axis


def test_families_and_degenerate_conics_are_refused() -> None:
    rings = np.array([ellipse((5, 5), (1, 1)), ellipse((5, 5), (2, 2))])
    with pytest.raises(pf.ArgumentError, match="leave a family"):
        pf.homography_from_conics(rings, map_conics(H, rings))
    three = np.array([ellipse((5, 5), (r, r)) for r in (1, 2, 3)])
    with pytest.raises(pf.ArgumentError, match="leave a family"):
        pf.homography_from_conics(three, map_conics(H, three))
    lines = np.array([np.diag([1.0, -1, 0]), ELLIPSES[0]])
    with pytest.raises(pf.ArgumentError, match="C: conic 0 is degenerate"):
        pf.homography_from_conics(lines, lines)
    with pytest.raises(pf.ArgumentError, match="projective invariants differ"):
        pf.homography_from_conics(ELLIPSES[:2], map_conics(H, ELLIPSES[1:3]))


def test_wrong_arguments_are_refused_by_name() -> None:
    with pytest.raises(pf.ArgumentError, match=r"C: expected shape .*\(1, 3, 3\)"):
        pf.homography_from_conics(ELLIPSES[:1], ELLIPSES[:1])
    with pytest.raises(pf.ArgumentError, match="2 and 3 conics"):
        pf.homography_from_conics(ELLIPSES[:2], ELLIPSES[:3])
    with pytest.raises(pf.ArgumentError, match=r"C_prime\[1\]: not a finite symmetric"):
        pf.homography_from_conics(ELLIPSES[:2], [ELLIPSES[0], np.arange(9).reshape(3, 3)])


def noisy(rng: np.random.Generator, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Ellipses fitted to 60 noisy points on each image ellipse; their homography, and the mapped centres' rms error."""
    image = []
    for c in ELLIPSES:
        t = np.linspace(0, 2 * np.pi, 61)[:-1]
        middle = ellipse_centre(c[None])[0]
        shape = -(c[:2, :2]) / (c[2, 2] + c[:2, 2] @ middle)
        values, vectors = np.linalg.eigh(shape)
        points = middle + (np.column_stack([np.cos(t), np.sin(t)]) / np.sqrt(values)) @ vectors.T
        mapped = np.column_stack([points, np.ones(60)]) @ H.T
        image.append(_engine.fit_ellipse(mapped[:, :2] / mapped[:, 2:] + sigma * rng.normal(size=(60, 2))))
    h = pf.homography_from_conics(ELLIPSES, image)[0]
    corners = np.array([[50, 50, 1], [400, 50, 1], [400, 350, 1], [50, 350, 1.0]])
    got, want = corners @ h.T, corners @ H.T
    return h, got[:, :2] / got[:, 2:] - want[:, :2] / want[:, 2:]


def test_noise_moves_the_homography_about_as_little_as_it_must() -> None:
    """0.2 px on 240 points. A homography from as many point pairs would have corner errors near 0.2 sqrt(2 * 8 / 480)
    = 0.04 px; conics tell only where the outline is, not along it, and the corners lie outside: below 0.4 px rms."""
    rng = np.random.Generator(np.random.Philox(3))
    errors = np.array([noisy(rng, 0.2)[1] for _ in range(20)])
    assert np.sqrt((errors**2).sum(2).mean()) < 0.4


def test_an_ellipse_fitted_to_its_points_is_that_ellipse_far_from_the_origin() -> None:
    t = np.linspace(0, 2 * np.pi, 20)[:-1]
    c, s = math.cos(0.4), math.sin(0.4)
    points = np.column_stack([5 * np.cos(t), 2 * np.sin(t)]) @ np.array([[c, s], [-s, c]]) + [4000, 3000]
    assert same(_engine.fit_ellipse(points), ellipse((4000, 3000), (5, 2), 0.4)) < 1e-9
    with pytest.raises(ValueError, match="at least 5"):
        _engine.fit_ellipse(points[:4])


# ---- cones


def rim(middle: np.ndarray, normal: np.ndarray, radius: float, count: int = 24) -> np.ndarray:
    u = np.cross(normal, [0.3, 0.8, 0.5])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    t = np.linspace(0, 2 * np.pi, count + 1)[:-1, None]
    x = middle + radius * (np.cos(t) * u + np.sin(t) * v)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@pytest.mark.parametrize("theta", [0.2, 1.4, 1.8])
def test_a_disc_of_known_radius_has_two_poses_the_true_one_among_them(theta: float) -> None:
    middle = 0.5 * np.array([math.sin(theta), 0.1, math.cos(theta)])
    normal = np.array([-0.5, 0.4, -0.6]) if theta < 1 else np.array([-0.9, 0.3, 0.1])
    normal /= np.linalg.norm(normal)
    rays = rim(middle, normal, 0.05)
    poses = _engine.disc_poses(_engine.fit_cone(rays), rays.mean(0), 0.05)
    assert len(poses) == 2
    off = [np.linalg.norm(m - middle) + min(np.linalg.norm(n - normal), np.linalg.norm(n + normal)) for m, n in poses]
    assert min(off) < 1e-9 < max(off)
    for m, n in poses:  # both have this outline, and show their face
        assert n @ m < 0
        again = rim(m, n, 0.05)
        cone = _engine.fit_cone(rays)
        assert np.abs(np.einsum("ni,ij,nj->n", again, cone, again)).max() < 1e-9


def detection_of(target: pf.Target, camera: pf.Camera, pose: np.ndarray, noise: float = 0.0) -> pf.Detection:
    rng = np.random.Generator(np.random.Philox(5))
    t = np.linspace(0, 2 * np.pi, 33)[:-1]
    rims = target.flat_points()[:, None] + target.radius_m * np.stack([np.cos(t), np.sin(t)], -1)[None]
    flat = np.concatenate([rims.reshape(-1, 2), np.zeros((rims.size // 2, 1))], 1)
    px, ok = camera.project(flat @ pose[:, :3].T + pose[:, 3])
    assert ok.all()
    outlines = px.reshape(len(rims), 32, 2) + noise * rng.normal(size=(len(rims), 32, 2))
    n = len(rims)
    return pf.Detection(np.arange(n), outlines.mean(1), np.tile(np.eye(2), (n, 1, 1)), "ok", "", outlines=outlines)


@pytest.mark.parametrize("theta", [0.0, 1.2, 1.75])
def test_outlines_give_the_pose_of_a_circle_target_without_bias_beyond_90_degrees(theta: float) -> None:
    """Discs as large as a third of the distance: the centres' projections and the centroids differ by up to 3 px."""
    target = pf.Target("circles", 3, 4, 0.06)
    camera = pf.Camera(width=1000, height=1000, f_u=220, f_v=221, c_u=500, c_v=499, theta_max=2.3, k2=-0.01)
    c, s = math.cos(theta), math.sin(theta)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    tilt = np.array([[1, 0, 0], [0, 0.9, -math.sqrt(0.19)], [0, math.sqrt(0.19), 0.9]])
    pose = np.column_stack([turn @ tilt, 0.2 * turn[:, 2]])
    got, rms = pf.pose_from_discs(detection_of(target, camera, pose), target, camera)
    np.testing.assert_allclose(got, pose, atol=1e-8)
    assert rms < 1e-9
    got, rms = pf.pose_from_discs(detection_of(target, camera, pose, 0.1), target, camera)
    # 0.1 px over 384 points: position to some 0.2 m * 0.1 px / 220 px / sqrt(64) = 1e-5 m
    assert np.linalg.norm(got[:, 3] - pose[:, 3]) < 1e-4
    assert rms == pytest.approx(0.1 / 220, rel=0.25)


def test_a_pose_needs_three_outlines_of_a_plane() -> None:
    camera = pf.Camera(width=1000, height=1000, f_u=220, f_v=220, c_u=500, c_v=499, theta_max=2.3)
    none = pf.Detection(np.arange(0), np.zeros((0, 2)), np.zeros((0, 2, 2)), "none", "")
    with pytest.raises(pf.ArgumentError, match="at least three discs"):
        pf.pose_from_discs(none, pf.Target("circles", 3, 4, 0.06), camera)
    with pytest.raises(pf.ArgumentError, match="a plane with circles, not a checkerboard"):
        pf.pose_from_discs(none, pf.Target("checkerboard", 3, 4, 0.06), camera)


# ---- pictures and the command


def draw(conics: np.ndarray, size: tuple[int, int] = (520, 420)) -> Image.Image:
    """Dark ellipses on light ground, 4 x 4 samples a pixel."""
    v, u = (np.mgrid[: size[1] * 4, : size[0] * 4] + 0.5) / 4 - 0.5
    grey = np.full(u.shape, 200.0)
    x = np.stack([u, v, np.ones_like(u)], -1)
    for c in conics:
        c = c * -np.sign(ellipse_centre(c[None])[0] @ c[:2, 2] + c[2, 2])  # negative inside
        grey[np.einsum("hwi,ij,hwj->hw", x, c, x) < 0] = 30
    return Image.fromarray(grey.reshape(size[1], 4, size[0], 4).mean((1, 3)).round().astype(np.uint8))


def test_two_pictures_of_discs_give_their_homography(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    draw(ELLIPSES).save(tmp_path / "one.png")
    draw(map_conics(H, ELLIPSES)).save(tmp_path / "two.png")
    found = ellipses_in(np.asarray(Image.open(tmp_path / "one.png")))
    off = np.linalg.norm(ellipse_centre(found)[:, None] - ellipse_centre(ELLIPSES)[None], axis=2)
    assert len(found) == 4 and off.min(0).max() < 0.02
    assert cli.main(["homography", str(tmp_path / "one.png"), str(tmp_path / "two.png"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    h = np.array(document["candidates"][0]["homography"])
    corners = np.array([[100, 100, 1], [350, 100, 1], [350, 300, 1], [100, 300, 1.0]])
    got, want = corners @ h.T, corners @ H.T
    assert np.abs(got[:, :2] / got[:, 2:] - want[:, :2] / want[:, 2:]).max() < 0.5


def test_matching_finds_the_pairs_whatever_the_order() -> None:
    order = [2, 0, 3, 1]
    pairs = match_conics(ELLIPSES, map_conics(H, ELLIPSES[order]))
    assert sorted(pairs) == [(order[k], k) for k in np.argsort(order)]
    with pytest.raises(pf.ArgumentError, match="fewer than four"):
        match_conics(ELLIPSES[:3], map_conics(H, ELLIPSES[:3]))


def test_files_of_conics_in_each_form_are_read_alike(tmp_path: Path) -> None:
    six = [[c[0, 0], 2 * c[0, 1], c[1, 1], 2 * c[0, 2], 2 * c[1, 2], c[2, 2]] for c in ELLIPSES]
    (tmp_path / "a.json").write_text(json.dumps({"conics": ELLIPSES.tolist()}))
    (tmp_path / "b.json").write_text(json.dumps(six))
    (tmp_path / "c.csv").write_text("a,b,c,d,e,f\n" + "\n".join(",".join(map(repr, map(float, r))) for r in six))
    for name in ("a.json", "b.json", "c.csv"):
        conics, ordered = load_conics(tmp_path / name)
        np.testing.assert_allclose(conics, ELLIPSES, rtol=1e-14)
        assert ordered
    target = pf.Target("circles", 3, 3, 0.02)
    target.save(tmp_path / "t.json")
    np.testing.assert_allclose(ellipse_centre(load_conics(tmp_path / "t.json")[0]), target.flat_points(), atol=1e-12)


def test_the_command_tells_one_homography_or_all_candidates(tmp_path: Path, capsys) -> None:
    (tmp_path / "a.json").write_text(json.dumps(ELLIPSES.tolist()))
    (tmp_path / "b.json").write_text(json.dumps(map_conics(H, ELLIPSES).tolist()))
    assert cli.main(["homography", str(tmp_path / "a.json"), str(tmp_path / "b.json"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["candidates"]) == 1 and len(document["pairs"]) == 4
    assert same(np.array(document["candidates"][0]["homography"]), H) < 1e-9
    (tmp_path / "a.json").write_text(json.dumps(ELLIPSES[:2].tolist()))
    (tmp_path / "b.json").write_text(json.dumps(map_conics(H, ELLIPSES[:2]).tolist()))
    assert cli.main(["homography", str(tmp_path / "a.json"), str(tmp_path / "b.json")]) == 0
    assert "candidate 4" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("x.json", "{", "x.json: line 1: not JSON"),
        ("x.json", "{}", "x.json: conics: must be a list"),
        ("x.json", "[[1, 2, 3]]", "x.json: conics[0]: 3 numbers, a conic has 6 or 9"),
        ("x.json", '[["a", 2, 3, 4, 5, 6]]', "x.json: conics[0]: not numbers"),
        ("x.json", "[[1, 0, 1, 0, 0, -1]]", "x.json: 1 conics, at least 2 are needed"),
        ("x.csv", "1,2,3\n", "x.csv: line 1: 3 numbers"),
        ("x.png", "nothing", "x.png: not a picture"),
    ],
)
def test_bad_files_are_refused_with_file_and_place(tmp_path, capsys, name, text, message) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert cli.main(["homography", str(path), str(path)]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_picture_that_ends_early_is_named(tmp_path, capsys) -> None:
    """The error said what is wrong, but of no file."""
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8)).save(tmp_path / "x.png")
    (tmp_path / "x.png").write_bytes((tmp_path / "x.png").read_bytes()[:1000])
    assert cli.main(["homography", str(tmp_path / "x.png"), str(tmp_path / "x.png")]) == 1
    assert "x.png: not a whole picture" in capsys.readouterr().err


def png(width: int, height: int) -> bytes:
    """A picture of that size, without its pixels."""
    chunks = (b"IHDR" + struct.pack(">II5B", width, height, 8, 0, 0, 0, 0), b"IDAT")
    packed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@pytest.mark.parametrize(
    "name, data",
    [("x.png", png(60000, 60000)), ("x.pgm", b"P5\n" + 100 * b"9" + b" 1\n255\n"), ("x.ppm", b"P6\n-1 1\n255\n")],
)
def test_a_picture_that_claims_what_none_has_is_named(tmp_path, capsys, name: str, data: bytes) -> None:
    (tmp_path / name).write_bytes(data)
    assert cli.main(["homography", str(tmp_path / name), str(tmp_path / name)]) == 1
    error = capsys.readouterr().err
    assert f"{name}: not a picture: " in error and error.count("\n") == 1 and "internal error" not in error


def test_a_target_of_many_discs_and_a_picture_of_it_give_their_homography(tmp_path: Path, capsys) -> None:
    """Matched one by one only the twelve largest would be looked at; the target's own detector orders them all."""
    board = pf.Target("circles", 7, 7, 0.02, radius_m=0.005)
    board.save(tmp_path / "board.json")
    shot = pf.simulate_target_views(board, {"preset": "narrow-60", "width": 640, "height": 480}, 1, samples=34, seed=2)[
        0
    ][0]
    Image.fromarray(shot.image).save(tmp_path / "shot.png")
    assert cli.main(["homography", str(tmp_path / "board.json"), str(tmp_path / "shot.png"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["pairs"]) >= 40 and document["candidates"][0]["centre_rms"] < 5  # the lens bends lines
    Image.new("L", (320, 240), 128).save(tmp_path / "blank.png")
    assert cli.main(["homography", str(tmp_path / "board.json"), str(tmp_path / "blank.png")]) == 1
    assert "the target is not found" in capsys.readouterr().err
