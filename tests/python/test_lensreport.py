"""`pipefish profile show|check|convert`, and the stored profiles."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish import cli, lensreport
from pipefish.cli_profile import READ, WRITTEN
from pipefish.formats import READERS, WRITERS

ROOT = Path(__file__).resolve().parents[2]
FORMATS = Path(__file__).with_name("data") / "formats"
STORED = sorted((ROOT / "calib_profiles").glob("*.json"))


@pytest.fixture
def camera():
    return pf.Camera(
        width=800, height=600, f_u=250, f_v=250, c_u=399.5, c_v=299.5, theta_max=math.radians(100), name="Lens 7"
    )


def run(*arguments):
    return cli.main(["profile", *map(str, arguments)])


def test_curve_and_table_are_those_of_the_equidistant_lens(camera):
    c = lensreport.curve(camera)
    np.testing.assert_allclose(c.radius, 250 * c.theta, atol=1e-9)
    np.testing.assert_allclose(c.radial, 250 * math.pi / 180, rtol=1e-9)
    np.testing.assert_allclose(c.tangential[1:], 250 * c.theta[1:] / np.sin(c.theta[1:]) * math.pi / 180, rtol=1e-9)
    rows = lensreport.table(camera)
    assert [r["theta_deg"] for r in rows[:3]] == [0, 15, 30] and rows[-1]["theta_deg"] == pytest.approx(100)
    assert rows[6]["radius_px"] == pytest.approx(250 * math.pi / 2, abs=1e-3)


def test_show_tells_and_draws(camera, tmp_path, capsys):
    camera.save(tmp_path / "c.json")
    for name in ("c.png", "c.html"):
        assert run("show", tmp_path / "c.json", "--out", tmp_path / name) == 0
    text = capsys.readouterr().out
    assert "Lens 7" in text and "theta, deg" in text and "392.7" in text  # 250 pi / 2
    picture = np.asarray(Image.open(tmp_path / "c.png").convert("L"))
    assert picture.shape[0] > 500 and (picture < 200).sum() > 2000
    page = (tmp_path / "c.html").read_text()
    assert page.count("Plotly.newPlot('c") == 2 and "Lens 7" in page and "http://" not in page.split("<script>")[0]
    assert run("show", tmp_path / "c.json", "--out", tmp_path / "c.bmp") == 1 and not (tmp_path / "c.bmp").exists()
    assert run("show", tmp_path / "c.json", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["f_u"] == 250 and document["curve"][0]["radial_px_per_deg"] == pytest.approx(4.3633, abs=1e-4)


def test_show_tells_how_well_alpha_is_known_of_a_self_calibrated_camera(camera, tmp_path, capsys):
    """As the diameter and the angles feel it; of a camera calibrated otherwise nothing."""
    chosen = pf.Provenance(model_choice="5 pairs, sigma(alpha) 0.31 %")
    dataclasses.replace(camera, source="selfcal", provenance=chosen).save(tmp_path / "c.json")
    assert run("show", tmp_path / "c.json") == 0
    assert "± 0.61 % of a diameter" in (text := capsys.readouterr().out)
    assert "± 0.39 % of the angle at 45 deg (95 %)" in text  # sin 45 cos 45 / (pi / 4) x 1.96 x 0.31 = 0.387
    assert run("show", tmp_path / "c.json", "--json") == 0
    assert json.loads(capsys.readouterr().out)["alpha_sigma"] == pytest.approx(0.0031)
    dataclasses.replace(camera, provenance=chosen).save(tmp_path / "c.json")
    assert run("show", tmp_path / "c.json") == 0 and "of a diameter" not in capsys.readouterr().out


def test_check_passes_a_good_camera_and_tells_its_limits(tmp_path, capsys):
    assert run("check", FORMATS / "stella.yaml", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["valid"] and document["round_trip_px"] < 1e-9 and document["covered"] > 0.999
    k = [-3.0e-02, -3.3e-03, -2.8e-03, -5.9e-04]  # r' = 0 is where the proof must end
    slope = np.poly1d([9 * k[3], 0, 7 * k[2], 0, 5 * k[1], 0, 3 * k[0], 0, 1])
    zero = math.degrees(min(r.real for r in slope.roots if abs(r.imag) < 1e-9 and r.real > 0))
    assert zero - 0.3 < document["one_to_one_up_to_deg"] <= zero


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"c_u": 4000.0}, "is not in the picture"),
        ({"f_v": 40.0}, "far from square"),
        ({"f_u": 9e4, "f_v": 9e4, "theta_max": 0.0005}, "pixels per radian"),
        ({"pupil_e1": 0.6}, "millimetres"),
    ],
)
def test_check_refuses_what_can_be_no_camera_with_the_reason(camera, changes, reason, tmp_path, capsys):
    dataclasses.replace(camera, **changes).save(tmp_path / "c.json")
    assert run("check", tmp_path / "c.json") == 1
    told = capsys.readouterr()
    assert reason in told.err and "c.json" in told.err and told.out == ""


def test_convert_reads_and_writes_every_form_it_lists(camera, tmp_path, capsys):
    assert set(WRITTEN) == {"json", "binary", *WRITERS} and set(WRITERS) <= set(READERS)
    camera.save(tmp_path / "c.json")
    for form in WRITTEN:
        assert run("convert", tmp_path / "c.json", tmp_path / "out", "--to", form, "--max-theta", 80, "--json") == 0, (
            form
        )
        document = json.loads(capsys.readouterr().out)
        assert document["form"] == form and document["bytes"] == (tmp_path / "out").stat().st_size
        if form != "toolbox":
            assert run("check", tmp_path / "out", "--camera-size", "800x600") == 0, form
            capsys.readouterr()


@pytest.mark.parametrize(("form", "degrees"), [("opencv-fisheye", 89), ("json", 70), ("binary", 70), ("mrcal", 60)])
def test_convert_tells_the_field_of_view_that_it_wrote(form, degrees, tmp_path, capsys):
    for name in ("stella.yaml", "own.json"):
        source = FORMATS / name
        if name == "own.json":
            source = tmp_path / name
            pf.Camera.load(FORMATS / "kalibr.yaml").save(source)
        options = ["--to", form, "--max-theta", degrees]
        assert run("convert", source, tmp_path / "out", *options, "--json") == 0
        document = json.loads(capsys.readouterr().out)
        told = document["field_of_view_deg"]
        if name == "own.json" and form == "opencv-fisheye":
            assert document["notes"] == ["holds up to 89.0 degrees only"]
        reach = min(degrees, math.degrees(pf.Camera.load(source).theta_max))  # stella's picture ends at 80 degrees
        assert 2 * reach * 0.997 < told <= 2 * degrees
        assert run("convert", source, tmp_path / "out", *options) == 0
        assert f"field of view  {told:.1f} deg" in capsys.readouterr().out


def test_convert_makes_a_polynomial_of_another_family_with_the_error_told(tmp_path, capsys):
    source = ROOT / "calib_profiles" / "ideal-equisolid-180.json"
    assert run("convert", source, tmp_path / "p9.json", "--model", "p9", "--json") == 0
    fit = json.loads(capsys.readouterr().out)["read_fit"]
    made = pf.Camera.load(tmp_path / "p9.json")
    assert made.radial == "generic" and not fit["exact"] and 0 < fit["max_px"] < 0.01
    assert run("convert", source, tmp_path / "p6.json", "--model", "p6", "--max-error", 0.001) == 1
    assert "does not fit" in capsys.readouterr().err and not (tmp_path / "p6.json").exists()


def test_refusals_leave_no_file_and_say_why(tmp_path, capsys):
    out = tmp_path / "x.yaml"
    assert run("convert", FORMATS / "kalibr.yaml", out, "--to", "opencv-fisheye") == 1
    told = capsys.readouterr().err
    assert "ends at 90 degrees" in told and "7 cameras in the file: cam0 taken" in told and not out.exists()
    assert run("convert", FORMATS / "kalibr.yaml", out, "--to", "json", "--camera", "cam9") == 1
    assert "there are cam0, cam1" in capsys.readouterr().err
    assert run("check", FORMATS / "pyocamcalib.json") == 1
    assert "--camera-size" in capsys.readouterr().err


# ---- calib_profiles/


@pytest.mark.parametrize("path", STORED, ids=lambda p: p.stem)
def test_stored_profiles_are_sound_and_listed(path):
    cam = pf.Camera.load(path)
    found = lensreport.check(cam)
    assert found["valid"], found["problems"]
    assert cam.name and found["round_trip_px"] < 1e-9
    assert json.loads(path.read_text())["version"] == 2 and cam.provenance.model_choice
    assert f"| {path.name} |" in (ROOT / "calib_profiles" / "README.md").read_text()


def test_stored_profiles_span_the_family():
    cameras = [pf.Camera.load(p) for p in STORED]
    assert len(cameras) >= 12
    assert {c.radial for c in cameras} >= {
        "generic", "perspective", "stereographic", "equisolid", "equidistant", "orthographic", "unified",
    }  # fmt: skip
    fields = [2 * math.degrees(c.theta_max) for c in cameras]
    assert min(fields) < 80 and max(fields) > 200 and any(185 <= f <= 191 for f in fields)


def test_published_numbers_are_those_of_their_papers():
    """Facts typed a second time, from the publications."""
    load = lambda name: pf.Camera.load(ROOT / "calib_profiles" / name)  # noqa: E731
    tum = load("tum-vi-cam0-512.json")
    assert (tum.f_u, tum.c_v, tum.k2) == (190.97847715128717, 256.8974428996504, 0.0034823894022493434)
    xtion = load("tum-rgbd-freiburg3.json")
    assert (xtion.f_u, xtion.f_v, xtion.c_u, xtion.c_v) == (535.4, 539.2, 320.1, 247.6)
    pixels, _ = load("euroc-mav-cam0.json").project([[0.3, -0.4, 1.0]])
    r2 = 0.25
    radial = 1 - 0.28340811 * r2 + 0.07395907 * r2**2
    p1, p2 = 0.00019359, 1.76187114e-05
    x = 0.3 * radial + 2 * p1 * 0.3 * -0.4 + p2 * (r2 + 2 * 0.09)
    y = -0.4 * radial + p1 * (r2 + 2 * 0.16) + 2 * p2 * 0.3 * -0.4
    np.testing.assert_allclose(pixels[0], [458.654 * x + 367.215, 457.296 * y + 248.375], atol=0.02)


def test_a_converted_profile_goes_into_a_pipe_through_a_link_and_never_over_its_source(tmp_path):
    """Outputs that are no plain files stay what they are."""
    source = tmp_path / "a.json"
    source.write_bytes((Path(__file__).resolve().parents[2] / "calib_profiles/tum-vi-cam0-512.json").read_bytes())
    command = [sys.executable, "-m", "pipefish", "profile", "convert", str(source)]
    link, target, fifo = tmp_path / "link.json", tmp_path / "target.json", tmp_path / "fifo"
    target.write_text("old")
    link.symlink_to(target)
    assert subprocess.run([*command, str(link)], check=False).returncode == 0
    assert link.is_symlink() and json.loads(target.read_text())["format"] == "pipefish-profile"
    os.mkfifo(fifo)
    with subprocess.Popen(["cat", str(fifo)], stdout=subprocess.PIPE) as reader:
        assert subprocess.run([*command, str(fifo), "--to", "json"], check=False).returncode == 0
        assert json.loads(reader.communicate(timeout=60)[0])["format"] == "pipefish-profile"
    assert fifo.is_fifo()
    before = source.read_bytes()
    assert subprocess.run([*command, str(source)], check=False).returncode == 2
    assert source.read_bytes() == before


def test_readers_of_the_command_are_those_of_the_package():
    assert READ == READERS
