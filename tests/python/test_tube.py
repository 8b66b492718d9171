"""The tube as a whole: simulated pipes of all sizes within their intervals, real clouds, files, command."""

from __future__ import annotations

import json
import math
import re
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import pipefish as pf
from pipe_cloud import Pipe
from pipefish import cli_tube
from pipefish.cli import main
from pipefish.cloudfile import ply_bytes, read_points
from pipefish.measured_texts import event_text
from pipefish.tube_section import calipers


def turned(seed: int) -> np.ndarray:
    """Any rotation."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.diag(r)) * np.linalg.det(q)


@pytest.mark.parametrize(
    "pipe",
    [
        Pipe(diameter=0.1, length=1.5, noise=0.0005, ovality=0.02, seed=1),
        Pipe(outliers=0.3, ovality=0.03, seed=2),
        Pipe(diameter=0.4, length=5, noise=0.002, bend=(2, math.radians(30), 1.2), seed=3, tilt=turned(3)),
        Pipe(diameter=1.0, length=8, noise=0.005, outliers=0.1, ovality=0.01, seed=4),
        Pipe(diameter=0.6, noise=0.003, cover=math.radians(250), seed=5),
    ],
    ids=["DN100", "DN300 30 % gross", "DN400 bend", "DN1000", "DN600 one-sided"],
)
@pytest.mark.parametrize("with_path", [False, True], ids=["bare", "path"])
def test_sizes_shapes_and_gross_points_are_within_their_intervals(pipe: Pipe, with_path: bool) -> None:
    tube = pf.fit_tube(pipe.points(2000), pipe.noise, pipe.cameras() if with_path else None, nominal=pipe.diameter)
    t = tube.stations
    assert tube.status == "ok" and (t["status"] == "ok").mean() > 0.9
    s = np.linspace(0, pipe.length, 5)
    clock = np.linspace(0, 2 * np.pi, 720)
    r = pipe.radius(s[:1], clock)
    mean = 2 * r.mean()
    assert np.abs(t["d_mean"] / mean - 1).max() < 0.005
    # Smoothing makes one pipe's stations nearly one figure, which is beyond 2.58 sigma in one of a hundred.
    z = (t["d_mean"] - mean) / t["d_mean_sigma"]
    assert np.sqrt(np.mean(z**2)) < 2.58 and np.abs(z).max() < 4.5
    assert abs(tube.summary["d_mean"] - mean) < 2.58 * tube.summary["d_mean_sigma"]
    known = t["status"] == "ok"
    z = (np.sqrt(np.maximum(t["ovality_squared"], 0)) - pipe.ovality)[known] / t["ovality_sigma"][known]
    assert np.sqrt(np.mean(z**2)) < (2.58 if pipe.ovality else 3.03)  # of two normals where it is round: 99 %
    assert abs(tube.length - pipe.length) < 0.02 * pipe.diameter + 0.01 * pipe.length
    assert not [e for e in tube.events if e["kind"] != "bend"]


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    inside, oval, z = [], [], []
    for seed in range(18):
        pipe = Pipe(ovality=0.01 * (seed % 3), outliers=0.1, seed=seed)
        t = pf.fit_tube(pipe.points(900), pipe.noise, pipe.cameras()).stations
        some = np.arange(2, len(t["s"]) - 2, 6)  # at 1.5 diameters
        z += ((t["d_mean"] - 0.3) / t["d_mean_sigma"])[some].tolist()
        inside += (np.abs(t["d_mean"] - 0.3) < 1.96 * t["d_mean_sigma"])[some].tolist()
        oval += ((t["ovality_lo"] <= pipe.ovality) & (pipe.ovality <= t["ovality_hi"]))[some].tolist()
    assert 0.90 <= np.mean(inside) <= 0.985
    assert 0.90 <= np.mean(oval) <= 0.995  # of circles the lower end is zero more often than not
    assert 0.85 <= np.std(z) <= 1.15


def test_the_mean_diameter_is_as_uncertain_as_it_scatters() -> None:
    """A straight pipe's stations are nearly one figure: they do not average out. No estimate is better than that of
    one who knows axis and shape, 2 sigma / sqrt(n)."""
    z, known = [], 2 * 0.0015 / math.sqrt(1600)
    for seed in range(16):
        pipe = Pipe(length=4, seed=200 + seed)
        summary = pf.fit_tube(pipe.points(1600), None, pipe.cameras()).summary
        assert 0.9 * known < summary["d_mean_sigma"] < 1.4 * known
        z.append((summary["d_mean"] - 0.3) / summary["d_mean_sigma"])
    assert 3.9 < np.sum(np.square(z)) < 39.3  # 99.8 % of chi-squared of 16


def test_the_mean_diameter_s_sigma_is_that_of_its_own_change_with_the_points() -> None:
    """Where the diameter changes along the pipe the stations are not one figure: moving points by their noise tells."""
    pipe = Pipe(length=3, ovality=0.0, seed=5, noise=0.0)
    exact, found = pipe.points(1200), []
    exact[:, :2] *= (1 + 0.02 * np.sin(4 * exact[:, 2]))[:, None]
    for seed in range(16):
        noisy = exact + np.random.default_rng(seed).normal(0, 0.001, exact.shape)
        summary = pf.fit_tube(noisy, 0.001, pipe.cameras()).summary
        found.append((summary["d_mean"], summary["d_mean_sigma"]))
    mean, sigma = np.array(found).T
    assert 4.1 < 15 * np.var(mean, ddof=1) / np.mean(sigma**2) < 37.7  # 99.6 % of chi-squared of 15


def test_the_ovality_of_the_pipe_is_that_of_all_of_it() -> None:
    """Where it is oval the square of the ovality is the less certain: that must not weigh it out."""
    random = np.random.default_rng(1)
    angle, z = random.uniform(0, 2 * np.pi, 3000), random.uniform(0, 3, 3000)
    oval = np.clip((z - 1.2) / 0.6, 0, 1) * 0.05
    points = np.column_stack([0.15 * (1 + oval / 2) * np.cos(angle), 0.15 * (1 - oval / 2) * np.sin(angle), z])
    tube = pf.fit_tube(points + random.normal(0, 0.001, points.shape))
    truth = math.sqrt(np.mean((np.clip((np.linspace(0, 3, 400) - 1.2) / 0.6, 0, 1) * 0.05) ** 2))
    assert tube.summary["ovality_rms"] == pytest.approx(truth, abs=0.001)


def test_noise_makes_no_ovality_on_average() -> None:
    squares = []
    for seed in range(8):
        pipe = Pipe(seed=60 + seed)
        t = pf.fit_tube(pipe.points(1500), None, pipe.cameras()).stations
        assert (t["ovality_squared"] < 0).any() or t["oval"].any()
        squares.append(np.mean(t["ovality_squared"]))
    assert abs(np.mean(squares)) < 3 * np.std(squares, ddof=1) / math.sqrt(len(squares))


def test_an_ovality_that_grows_is_followed() -> None:
    pipe = Pipe(ovality=0.0, ovality_end=0.05, length=4, noise=0.001, seed=6)
    t = pf.fit_tube(pipe.points(3000), pipe.noise, pipe.cameras(), nominal=0.3).stations
    truth = 0.05 * t["s"] / pipe.length
    some = t["s"] > 0.8
    assert np.abs(t["ovality"] - truth)[some].max() < 0.003
    assert (np.abs(t["ovality"] - truth) < 3 * t["ovality_sigma"])[some].mean() > 0.9
    assert np.abs((t["clock_max"] - pipe.clock_max + np.pi / 2) % np.pi - np.pi / 2)[some].max() < 0.1
    assert t["ovality_astm"][some] == pytest.approx(truth[some] / 2, abs=0.002)
    assert t["reduction_nominal"][some] == pytest.approx(truth[some] / 2, abs=0.003)


def test_eggs_get_the_harmonics_they_need_and_ellipses_none() -> None:
    egg = Pipe(diameter=0.6, egg=0.05, ovality=0.2, noise=0.003, seed=7)
    tube = pf.fit_tube(egg.points(4000), egg.noise, egg.cameras())
    assert tube.surface.order >= 3
    clock = np.linspace(0, 2 * np.pi, 73)
    got, want = tube.radius([1.5], clock)[0], egg.radius(np.full(73, 1.5), clock)
    assert np.abs(got - want).max() < 0.004  # 1.3 % of the radius, whose third harmonic is 15 mm
    plain = Pipe(ovality=0.03, seed=7)
    assert pf.fit_tube(plain.points(2000), plain.noise).surface.order == 2


def test_full_covariances_count_along_the_wall_s_normal() -> None:
    pipe = Pipe(noise=0.0, roughness=0.001, seed=8)
    points = pipe.points(1500)
    rng = np.random.default_rng(8)
    points[:, 2] += rng.normal(0, 0.01, len(points))  # along the axis: tells nothing of the wall
    sigma = np.tile(np.diag([0.0, 0.0, 1e-4]), (len(points), 1, 1))
    tube = pf.fit_tube(points, sigma, pipe.cameras())
    assert tube.summary["roughness"] == pytest.approx(0.001, rel=0.15)


def test_projecting_and_evaluating_are_inverse() -> None:
    pipe = Pipe(length=4, bend=(1.5, 0.5, 0.9), ovality=0.03, seed=9)
    tube = pf.fit_tube(pipe.points(2500), pipe.noise, pipe.cameras())
    s, clock = np.array([0.5, 1.7, 3.2]), np.array([0.2, 2.0, 4.4])
    back = tube.project(tube.evaluate(s, clock).reshape(-1, 3))
    assert np.abs(back["distance"]).max() < 1e-4
    assert np.abs(back["s"].reshape(3, 3) - s[:, None]).max() < 1e-4
    assert np.abs(back["clock"].reshape(3, 3) - clock).max() < 1e-4


def test_up_turns_the_clock() -> None:
    pipe = Pipe(ovality=0.05, seed=10)
    t = pf.fit_tube(
        pipe.points(1500), pipe.noise, pipe.cameras(), up=(1, 0, 0)
    ).stations  # three o'clock becomes twelve
    off = (t["clock_max"] - (pipe.clock_max - np.pi / 2) + np.pi / 2) % np.pi - np.pi / 2
    assert np.abs(off).max() < 0.1


def test_gravity_along_a_shaft_is_no_twelve_o_clock() -> None:
    pipe = Pipe(ovality=0.05, seed=10)
    points, path = pipe.points(1500), pipe.cameras()
    shaft, frame = (pf.fit_tube(points, pipe.noise, path, up=up) for up in ((0.05, 0, 1), None))
    assert shaft.clock_zero.startswith(frame.clock_zero) and "gravity tells no clock" in shaft.clock_zero
    assert np.array_equal(shaft.stations["clock_max"], frame.stations["clock_max"], equal_nan=True)
    assert pf.fit_tube(points, pipe.noise, path, up=(0.2, 0, 1)).clock_zero == "against gravity"


def test_the_same_bits_for_any_number_of_threads() -> None:
    points = Pipe(outliers=0.2, seed=11).points(1500)
    one, four = (pf.fit_tube(points, 0.0015, threads=n).stations for n in (1, 4))
    for name, values in one.items():
        assert np.array_equal(values, four[name], equal_nan=values.dtype.kind == "f"), name


def test_scale_goes_into_the_systematic_sigma() -> None:
    t = pf.fit_tube(Pipe(seed=12).points(1200), 0.0015, scale_sigma=0.002).stations
    assert t["d_mean_systematic"] == pytest.approx(0.002 * t["d_mean"])


def test_half_a_pipe_gives_diameters_but_no_ovality() -> None:
    tube = pf.fit_tube(Pipe(cover=math.pi, seed=13).points(1200), 0.0015)
    t = tube.stations
    assert (t["status"] == "circle_only").all() and np.isnan(t["ovality"]).all() and np.isnan(t["d_max"]).all()
    assert (np.abs(t["d_mean"] - 0.3) < 4 * t["d_mean_sigma"]).all()


def test_what_half_a_pipe_hides_is_in_its_interval() -> None:
    """Pipes as oval as is assumed, in any direction: a circle through the half that is seen is off by per cents."""
    random, z, sigmas = np.random.default_rng(3), [], []
    for seed in range(12):
        oval, direction = 0.03 / math.sqrt(2) * np.hypot(*random.normal(size=2)), random.uniform(0, math.pi)
        pipe = Pipe(cover=0.96 * math.pi, ovality=oval, clock_max=direction, length=2, noise=0.001, seed=seed)
        t = pf.fit_tube(pipe.points(1000), None, pipe.cameras()).stations
        assert (t["status"] == "circle_only").all()
        middle = len(t["s"]) // 2
        z.append((t["d_mean"][middle] - 0.3) / t["d_mean_sigma"][middle])
        sigmas.append(t["d_mean_sigma"][middle])
    assert 2.2 < np.sum(np.square(z)) < 32.9  # 99.8 % of chi-squared of 12
    assert np.median(sigmas) < 0.3 * 0.01  # and tells something


@pytest.mark.parametrize(
    ("points", "status"),
    [
        (np.zeros((0, 3)), "too_few_points"),
        (np.full((500, 3), np.nan), "too_few_points"),
        (Pipe().points(500) * 1e300, "too_few_points"),
        (np.zeros((500, 3)), "no_cylinder"),
        (np.random.default_rng(0).normal(size=(1500, 3)), "no_cylinder"),
        (Pipe(cover=1.9).points(1200), "one_sided"),
    ],
    ids=["none", "not finite", "beyond all bounds", "one place", "a cloud", "a strip"],
)
def test_what_is_no_pipe_is_an_answer(points: np.ndarray, status: str) -> None:
    tube = pf.fit_tube(points)
    assert tube.status == status and tube.reason and len(tube.stations["s"]) == 0 and not tube.events


def test_a_stretch_without_points_is_a_gap_not_a_guess() -> None:
    pipe = Pipe(length=4, seed=14)
    points = pipe.points(2000)
    points = points[(points[:, 2] < 1.5) | (points[:, 2] > 2.3)]
    t = pf.fit_tube(points, pipe.noise, pipe.cameras()).stations
    hole = (t["s"] > 1.7) & (t["s"] < 2.1)
    assert (t["status"][hole] == "too_few_points").all() and np.isnan(t["d_mean"][hole]).all()
    assert np.isfinite(t["d_mean"][(t["s"] < 1.3) | (t["s"] > 2.5)]).all()


@pytest.mark.parametrize("driven", [0.075, 0.16, 0.32])
def test_a_drive_shorter_than_the_pipe_is_wide_is_measured_where_it_saw_the_wall(driven: float) -> None:
    """What is left of a survey between two interruptions: most of the wall that it saw lies beyond the path's end."""
    pipe = Pipe(length=4, seed=15)
    points, path = pipe.points(2400), pipe.cameras()
    points = points[(points[:, 2] > 1.09) & (points[:, 2] < 1.25 + driven)]
    path = np.column_stack([path[0, :2] * np.ones((5, 2)), np.linspace(1.0, 1.0 + driven, 5)])
    for centres in (path, path[::-1]):  # forwards, and backwards out of it
        tube = pf.fit_tube(points, pipe.noise, centres)
        assert tube.status == "ok" and tube.length > 0.12 + driven
        t = tube.stations
        assert (np.abs(t["d_mean"] - 0.3) < 4.5 * t["d_mean_sigma"]).all()


@pytest.mark.parametrize("centres", [2, 3])
def test_a_straight_pipe_s_two_ends_are_a_path(centres: int) -> None:
    pipe = Pipe(seed=16)
    path = np.column_stack([np.zeros((centres, 2)), np.linspace(0, pipe.length, centres)])
    tube = pf.fit_tube(pipe.points(1500), pipe.noise, path)
    assert tube.status == "ok" and tube.length == pytest.approx(pipe.length, abs=0.02)


def test_wrong_arguments_are_named() -> None:
    points = Pipe().points(200)
    for wrong, name in (
        (dict(points=points[:, :2]), "points"),
        (dict(points=points, sigma=np.ones(3)), "sigma"),
        (dict(points=points, sigma=-1.0), "sigma"),
        (dict(points=points, path=np.zeros((5, 3))), "path"),
        (dict(points=points, path=np.zeros((0, 3))), "path"),
        (dict(points=points, path=np.full((5, 3), 1e300)), "path"),
        (dict(points=points, nominal=-1.0), "nominal"),
        (dict(points=points, order=5), "order"),
        (dict(points=points, up=(0, 0, 0)), "up"),
        (dict(points=points, sigma=math.nan), "sigma"),
        (dict(points=points, sigma=np.tile(-1e-6 * np.eye(3), (200, 1, 1))), "sigma"),
        (dict(points=points, sigma=np.tile(1e-6 * np.triu(np.ones((3, 3))), (200, 1, 1))), "sigma"),
        (dict(points=points, spacing=-0.1), "spacing"),
        (dict(points=points, spacing=0.0), "spacing"),
        (dict(points=points, spacing=math.nan), "spacing"),
        (dict(points=points, scale_sigma=-1.0), "scale_sigma"),
        (dict(points=points, scale_sigma=math.nan), "scale_sigma"),
    ):
        with pytest.raises(pf.ArgumentError, match=name):
            pf.fit_tube(**wrong)


@pytest.mark.parametrize(
    ("name", "diameter", "within"),
    [
        ("200mm_pvc/cloud13", 0.1896, 0.002),
        ("200mm_pvc/cloud15", 0.1896, 0.002),
        ("340mm/light", 0.354, 0.004),
        ("340mm/nolight", 0.354, 0.004),
    ],
)
def test_real_pipes_have_the_diameter_that_a_careful_fit_finds(
    real_data: Callable[[str], Path], name: str, diameter: float, within: float
) -> None:
    points, _ = read_points(real_data(f"pipes/{name}.ply"))
    tube = pf.fit_tube(points)
    assert tube.status == "ok"
    assert abs(tube.summary["d_mean"] - diameter) < within


def test_points_that_say_nothing_are_an_answer() -> None:
    pipe = Pipe(seed=17)
    tube = pf.fit_tube(pipe.points(1500), 1e3, pipe.cameras())
    assert tube.status == "not_determined" and "uncertain" in tube.reason


@pytest.mark.filterwarnings("error")
def test_exact_points_are_no_division_by_zero() -> None:
    pipe = Pipe(noise=0.0, seed=18)
    tube = pf.fit_tube(pipe.points(1500), None, pipe.cameras())
    assert tube.summary["d_mean"] == pytest.approx(0.3, abs=1e-6) and not tube.events


def test_a_second_pipe_is_not_passed_over_in_silence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = Pipe(seed=19).points(1500)
    for cloud, told in ((points, False), (np.vstack([points, points + np.array([0.0, 0.0, 8.0])]), True)):
        np.save(tmp_path / "cloud.npy", cloud)
        assert main(["tube", str(tmp_path / "cloud.npy")]) == 0
        text = capsys.readouterr().out
        assert ("left out" in text) == told and ("50 % of the points" in text) == told


def test_files_hold_the_same_points(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    sigma = np.linspace(0.1, 0.2, 50)
    columns = dict(zip(("x", "y", "z", "sigma"), np.column_stack([points, sigma]).T, strict=True))
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns))
    rows = "".join(
        f"{x!r} {y!r} {z!r} {v!r}\n" for x, y, z, v in zip(*(c.tolist() for c in columns.values()), strict=True)
    )
    head = "ply\nformat ascii 1.0\nelement vertex 50\n" + "".join(f"property double {n}\n" for n in columns)
    (tmp_path / "b.ply").write_text(head + "end_header\n" + rows)
    (tmp_path / "c.xyz").write_text("# x y z sigma\nx y z sigma\n" + rows)
    (tmp_path / "d.csv").write_text("x,y,z,sigma\n" + rows.replace(" ", ","))
    np.save(tmp_path / "e.npy", np.column_stack([points, sigma]))
    big = b"".join(struct.pack(">ffffB", *p, s, 7) for p, s in zip(points, sigma, strict=True))
    head = "ply\nformat binary_big_endian 1.0\ncomment hello\nelement vertex 50\n"
    head += "".join(f"property float {n}\n" for n in columns) + "property uchar red\nelement face 0\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    (tmp_path / "f.ply").write_bytes(head.encode() + big)
    for file in sorted(tmp_path.iterdir()):
        got, noise = read_points(file)
        assert got == pytest.approx(points, abs=1e-6 if file.name == "f.ply" else 1e-15), file.name
        assert noise == pytest.approx(sigma, abs=1e-6), file.name


@pytest.mark.parametrize(
    ("name", "content", "where"),
    [
        ("a.ply", b"plywood", "header"),
        ("b.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1 2 3", "x, y, z"),
        ("c.ply", b"ply\nformat ascii 2\nelement face 3\nend_header\n", "vertex"),
        ("d.ply", b"ply\nformat middle_endian 1.0\nelement vertex 1\nend_header\n", "middle_endian"),
        (
            "e.ply",
            b"ply\nformat ascii 1.0\nelement vertex 3\nproperty char x\nproperty char y\nproperty char z\n"
            b"end_header\n1 2",
            "0 of 3",
        ),
        ("f.xyz", b"1 2 3\n4 five 6\n", "line 2"),
        ("g.csv", b"", "no points"),
        ("h.npy", b"\x93NUMPY garbage", "NumPy"),
        ("i.las", b"", "not a kind"),
    ],
)
def test_broken_files_are_refused_with_the_place(tmp_path: Path, name: str, content: bytes, where: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(pf.FormatError, match=where):
        read_points(tmp_path / name)


def test_the_command_writes_profile_events_mesh_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = Pipe(length=4, bend=(1.5, 0.5, 0.9), ovality=0.02, seed=15)
    np.save(tmp_path / "cloud.npy", 1000 * pipe.points(2000))
    out = tmp_path / "out"
    command = ["tube", str(tmp_path / "cloud.npy"), "-o", str(out), "--unit", "mm", "--sigma", "1.5"]
    assert main([*command, "--nominal", "300", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == {**json.loads((out / "tube.json").read_text()), "files": document["files"]}
    assert document["summary"]["d_mean"] == pytest.approx(0.3, abs=0.001)
    assert [e["kind"] for e in document["events"]] == ["bend"]
    lines = (out / "profile.csv").read_text().splitlines()
    assert len(lines) == 1 + len(document["stations"]["s"]) and "ovality_astm" in lines[0].split(",")
    assert (out / "events.csv").read_text().splitlines()[1].startswith("bend")
    vertices, _ = read_points(out / "tube.ply")
    assert len(vertices) > 1000
    assert main(command) == 0
    text = capsys.readouterr().out
    bend = document["events"][0] | {"chainage": document["events"][0]["s"]}
    assert "mean diameter" in text and f"bend           {event_text(bend, 'metre')}\n" in text
    metres = r"[\d.]+ ± [\d.]+ m"
    assert re.search(rf"^bend +at {metres}, \d+:\d\d o'clock, [\d.]+ ± [\d.]+°, radius {metres}, from ", text, re.M)


def test_a_finding_is_told_with_its_intervals() -> None:
    """As `tube`, `reconstruct` and the report's picture tell it."""
    joint = {"kind": "joint", "chainage": 1.2345, "s_sigma": 0.004, "clock": 1.5 * math.pi}
    joint |= {"step": 0.004, "step_sigma": 0.0005, "gap": 0.02, "gap_sigma": 0.001, "angle": 0.02, "angle_sigma": 0.005}
    told = "at 1.23 ± 0.01 m, 9:00 o'clock, gap 20.0 ± 2.0 mm, step 4.0 ± 1.0 mm, angle 1.15 ± 0.56°"
    assert event_text(joint, "metre") == told
    heap = {
        "kind": "deposit",
        "chainage": None,
        "height": 0.01,
        "height_sigma": 0.001,
        "length": 0.1,
        "size_sigma": 0.01,
    }
    assert event_text(heap, "metre") == "place unknown, height 10.0 ± 2.0 mm, length 100.0 ± 19.6 mm"


def test_the_command_refuses_what_is_no_pipe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).normal(size=(1000, 3)))
    assert main(["tube", str(tmp_path / "cloud.npy")]) == 1
    assert "looks like the wall of a pipe" in capsys.readouterr().err
    assert main(["tube", str(tmp_path / "nothing.ply")]) == 1
    assert "nothing.ply" in capsys.readouterr().err


def test_a_cloud_in_another_unit_is_doubted_in_words():
    assert cli_tube.unit_note(300.2, 0.3).endswith("--unit cm, m, mm") and "1e+03 times" in cli_tube.unit_note(
        300.2, 0.3
    )
    assert cli_tube.unit_note(0.31, 0.3) == "" == cli_tube.unit_note(300.2, None)


@pytest.mark.parametrize("sigma", ["nan", "0", "-1"])
def test_a_sigma_that_is_none_is_named_before_the_cloud(tmp_path, capsys, sigma):
    assert main(["tube", str(tmp_path / "none.ply"), f"--sigma={sigma}"]) == 2
    assert "--sigma" in capsys.readouterr().err


def test_ovality_is_told_with_its_interval():
    station = {"ovality": 0.0402, "ovality_lo": -0.001, "ovality_hi": 0.045}
    assert cli_tube.ovality_text(station) == "4.02 %, 95 % from 0.00 to 4.50 %"


def test_a_long_pipes_diameters_take_no_room_for_all_of_it_at_a_time() -> None:
    """Half a megabyte a section: 2 GB for 300 m."""
    shape = np.tile([0.15, 0.002, 0.001], (1000, 1)) * np.linspace(1, 1.1, 1000)[:, None]
    tracemalloc.start()
    many = calipers(shape)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    one = calipers(shape[777:778])
    assert all((many[name][777] == one[name][0]).all() for name in one)
