"""Self-calibration from views of an unknown scene: right where it answers, and refused where nothing can be known.

The long statistics are tests/accept_selfcal.py; here a few set-ups of each kind. Does not prove: real lenses that are
not radially symmetric.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish import _engine, health, lens_ripple, measured_remarks, selfcal_input
from pipefish.cli import main
from pipefish.health import _chi2_tail
from pipefish.measure import measure
from pipefish.selfcal import _reason, _status, self_calibrate, stored_alpha_sigma
from pipefish.structure import reconstruct
from pipefish.survey import Survey
from selfcal_drives import ENCODER, health_of, survey
from selfcal_scenes import DEGENERATE, KINDS, bearing_error, make_setup, random_lens
from test_reconstruct_cli import survey_of
from tube_tracks import fisheye, rotation, tube_drive

SIZE = (1280, 960)


@pytest.mark.parametrize("kind", KINDS)
def test_two_pairs_find_the_lens(kind):
    """Within three of its own sigmas and half a degree, at 0.5 px and with wrong matches, for every kind of lens."""
    setup = make_setup(2, kind, pairs=2, noise=0.5, outliers=0.3)
    found = self_calibrate(setup.pairs, SIZE, views=[(0, 1), (1, 2)])
    assert found.status == "ok", found.reason
    error = bearing_error(found.camera, setup.lens, found.radius)
    assert error < 3 * found.bearing_sigma
    assert math.degrees(error) < 0.5
    assert found.sigma == pytest.approx(0.5, rel=0.15)
    assert found.camera.provenance.views == 3
    assert stored_alpha_sigma(found.camera) == pytest.approx(found.alpha_sigma, rel=0.05)  # of two digits
    assert found.camera.rms_px == found.rms == pytest.approx(0.5, rel=0.2)
    for pair, right in zip(found.pairs, setup.right, strict=True):
        assert (pair.inlier & right).sum() > 0.95 * right.sum()
        assert (pair.inlier & ~right).sum() < 0.05 * right.sum()


def test_poses_are_those_of_the_pairs():
    setup = make_setup(2, "fisheye", pairs=1, noise=0.2, outliers=0.2, points=200)
    found = self_calibrate(setup.pairs, SIZE)
    true = setup.poses[0]
    turn = found.pairs[0].pose[:, :3] @ true[:, :3].T
    assert math.degrees(math.acos(min(1, (np.trace(turn) - 1) / 2))) < 0.5
    assert found.pairs[0].pose[:, 3] @ true[:, 3] / np.linalg.norm(true[:, 3]) > 0.999


@pytest.mark.parametrize(("seed", "kind"), [(10_174, "fisheye"), (10_191, "mirror")])
def test_a_patch_too_small_for_any_motion_to_be_found_is_told_as_such(seed: int, kind: str):
    """Wrong matches lie all over the second picture: the first one's span is what the right ones can have at most."""
    setup = make_setup(seed, kind, "low_coverage")
    found = self_calibrate(setup.pairs, (setup.lens.width, setup.lens.height))
    assert found.status == "low_coverage" and "10 % are needed" in found.reason


@pytest.mark.parametrize("case", DEGENERATE)
def test_what_cannot_be_seen_is_refused_with_its_reason(case):
    for seed, kind in enumerate(("perspective", "fisheye")):
        setup = make_setup(10_100 + seed, kind, case, points=200)
        found = self_calibrate(setup.pairs, SIZE)
        assert found.status == case
        assert found.camera is None
        if case in ("no_rotation", "axial"):
            assert "Pan or tilt by at least" in found.reason


@pytest.mark.parametrize("kind", ["perspective", "wide"])
def test_a_turning_and_a_standing_camera_are_named(kind):
    """A rotation is a homography of rays as a plane's is, but what helps is another thing."""
    setup = make_setup(3, kind, noise=0.3, outliers=0.0)
    rays = setup.lens.rays(setup.pairs[0][0])
    rays = rays[np.isfinite(rays).all(axis=1)]
    turn = np.array([[0.940, 0, 0.342], [0, 1, 0], [-0.342, 0, 0.940]])
    one, in_one = setup.lens.project(rays)
    two, in_two = setup.lens.project(rays @ turn.T)
    keep = in_one & in_two
    noise = np.random.default_rng(1).normal(0, 0.3, (2, keep.sum(), 2))
    found = self_calibrate([(one[keep] + noise[0], two[keep] + noise[1])], SIZE)
    assert found.status == "turning"
    assert found.camera is None
    assert "Move it as well" in found.reason
    still = self_calibrate([(one[keep], one[keep] + 0.5 * noise[0])], SIZE)
    assert still.status == "standing"


LENS = np.array([math.log(320.0), 0.1, 0.4, 0.3, -0.5, 0.2, 634.0, 486.0])  # of engine/selfcal/lens.hpp


def pair_errors(random: np.random.Generator, noise: float, lens=LENS, theta_end=1.5, limit=1.3, step=None):
    """The engine's errors and derivatives of 40 matches of random motion, the camera, the pose and the matches."""
    still = np.zeros(13)
    nothing = np.zeros((1, 2)) + lens[6:]
    pose = np.column_stack([rotation(random.normal(0, 0.3, 3)), random.normal(size=3)])
    pose[:, 3] /= np.linalg.norm(pose[:, 3])
    found = _engine.selfcal_errors(lens, theta_end, *SIZE, pose.ravel(), nothing, nothing, still)[2]
    f, end = found.pop("f"), found.pop("theta_max")
    camera = pf.Camera(width=SIZE[0], height=SIZE[1], f_u=f, f_v=f, theta_max=end, **found)
    ray = random.normal(size=(4000, 3)) * [1, 1, 1 / math.tan(limit) if limit < 0.3 else 1]
    first = ray * random.uniform(2, 8, (len(ray), 1)) / np.linalg.norm(ray, axis=1)[:, None]
    second = first @ pose[:, :3].T + pose[:, 3]
    inside = [np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2]) < limit for x in (first, second)]
    uv = [camera.project(x[inside[0] & inside[1]][:40])[0] for x in (first, second)]
    uv = [p + random.normal(0, noise, p.shape) for p in uv]
    assert len(uv[0]) == 40
    value, slope, _ = _engine.selfcal_errors(lens, theta_end, *SIZE, pose.ravel(), *uv, still if step is None else step)
    return value.ravel(), slope, camera, pose, uv


def test_the_error_is_the_least_move_of_both_pixels_onto_their_epipolar_curves():
    """First order (Sampson's), by differences of the camera's own rays: the sign too."""
    value, _, camera, pose, uv = pair_errors(np.random.default_rng(8), 0.3)

    def apart(one, two):
        f, g = camera.unproject(one)[0] @ pose[:, :3].T, camera.unproject(two)[0]
        return np.cross(f, g) @ pose[:, 3]

    h = 1e-4 * np.eye(2)
    slopes = [apart(uv[0] + d, uv[1]) - apart(uv[0] - d, uv[1]) for d in h]
    slopes += [apart(uv[0], uv[1] + d) - apart(uv[0], uv[1] - d) for d in h]
    expected = apart(*uv) / np.linalg.norm(np.array(slopes) / 2e-4, axis=0)
    assert np.abs(expected).max() > 0.5
    assert value == pytest.approx(expected, rel=0.01, abs=1e-4)


def test_far_from_zero_the_error_is_oliensis_square():
    """A lens so long that a pixel is the same angle everywhere; the two rays a tenth of the field apart: the least sum
    of squared sines over all planes through the baseline, by brute force."""
    lens = np.array([math.log(8000.0), 0.0, 0.0, 0, 0, 0, 640.0, 480.0])
    random = np.random.default_rng(4)
    value, _, camera, pose, uv = pair_errors(random, 30.0, lens, theta_end=0.1, limit=0.07)
    angle = np.linspace(0, np.pi, 20001)
    basis = np.linalg.svd(pose[None, :, 3])[2][1:]
    planes = np.cos(angle)[:, None] * basis[0] + np.sin(angle)[:, None] * basis[1]
    f, g = camera.unproject(uv[0])[0] @ pose[:, :3].T, camera.unproject(uv[1])[0]
    brute = ((f @ planes.T) ** 2 + (g @ planes.T) ** 2).min(axis=1)
    assert np.sqrt(brute).max() > 20 / 8000
    # Rays 0.07 from the axis: a pixel around it is a sixth of 0.07^2 less than one away from it, and 1 ray in 20 lies
    # so near the baseline that this counts tenfold.
    assert value**2 / 8000**2 == pytest.approx(brute, rel=0.02, abs=1e-12)


def test_the_errors_derivatives_by_lens_and_pose_are_those_of_differences():
    slope = pair_errors(np.random.default_rng(9), 0.5)[1]
    for unknown, size in enumerate([1e-5] * 6 + [1e-3] * 2 + [1e-6] * 5):
        step = np.zeros(13)
        step[unknown] = size
        ahead, back = (pair_errors(np.random.default_rng(9), 0.5, step=s)[0] for s in (step, -step))
        scale = np.abs(slope[:, unknown]).max()
        assert scale > 0
        assert slope[:, unknown] == pytest.approx((ahead - back) / (2 * size), abs=1e-4 * scale)


def found_with(states: tuple[str, ...], **more: float) -> dict:
    """What the engine says of pairs of these states."""
    pairs = [{"status": s, "inliers": 90, "inlier": np.ones(100, bool)} for s in states]
    said = {"area": 0.5, "axial": 1.0, "tilt": 0.3, "alpha_sigma": 0.01, "alpha_alone": 0.001, "needed": 0.2}
    return {"found": True, "pairs": pairs, **said, **more}


@pytest.mark.parametrize("states", [("plane", "turning"), ("turning", "plane")])
def test_pairs_that_are_refused_for_two_reasons_give_the_same_one_in_every_run(states):
    """A set's order changes from process to process."""
    assert _status(found_with(states)) == "planar"


def test_a_camera_that_tilted_is_not_told_that_it_did_not():
    """Of a scene that is nearly flat the matches leave alpha open whatever the tilt: the reason is the scene."""
    found = found_with(("ok",), alpha_alone=0.3, tilt=math.radians(15))
    assert _status(found) == "weak"
    assert "nearly flat" in _reason("weak", found) and "± 59 % (95 %, by themselves; ± 4 %" in _reason("weak", found)
    assert _status(found_with(("ok",), alpha_alone=0.3, tilt=math.radians(1))) == "no_rotation"
    assert "± 2 % (95 %)" in _reason("low_coverage", found_with(("ok",)))  # of alpha_sigma 0.01


def test_chance_is_no_camera():
    """A free lens and motion agree with 15 of 500 random matches."""
    random = np.random.default_rng(0).uniform(0, 640, (500, 4))
    assert self_calibrate([(random[:, :2], random[:, 2:])], (640, 640)).status == "no_matches"


def test_of_a_plane_no_sigma_along_alpha_is_claimed():
    found = self_calibrate(make_setup(10_104, "mirror", "planar", points=200).pairs, SIZE)
    assert found.status == "planar" and found.alpha_sigma == math.inf


def test_what_the_refusal_advises_is_enough():
    """Taken again with the tilt that was asked for, and nothing else changed."""
    random = np.random.default_rng(502)
    lens = random_lens("fisheye", random)

    def shot(tilt: float) -> tuple[np.ndarray, np.ndarray]:
        points = random.normal(size=(3000, 3))
        points *= random.uniform(2, 8, (3000, 1)) / np.linalg.norm(points, axis=1)[:, None]
        views = [points, points @ rotation(np.array([tilt, 0.0, 0.0])).T + [1.0, 0.0, 0.3]]
        (one, in_one), (two, in_two) = (lens.project(view) for view in views)
        keep = np.flatnonzero(in_one & in_two)[:250]
        return tuple(uv[keep] + random.normal(0, 0.5, (len(keep), 2)) for uv in (one, two))

    refused = self_calibrate([shot(0.0)], SIZE)
    assert refused.status == "no_rotation" and refused.needed > 0
    assert self_calibrate([shot(refused.needed)], SIZE).status == "ok"


def test_threads_and_runs_give_the_same_bits():
    setup = make_setup(5, "wide", points=120)
    a, b = (self_calibrate(setup.pairs, SIZE, threads=n).camera for n in (1, 2))
    assert (a.f_u, a.c_u, a.k2, a.k5) == (b.f_u, b.c_u, b.k2, b.k5)


def test_profile_says_how_it_came_about_and_loads(tmp_path):
    setup = make_setup(6, "fisheye", noise=0.3, points=200)
    found = self_calibrate(setup.pairs, SIZE)
    found.camera.save(tmp_path / "camera.json")
    back = pf.Camera.load(tmp_path / "camera.json")
    assert back.source == "selfcal"
    assert back.provenance.tool == "pipefish selfcal"
    assert back.covariance_parameters[:3] == ("f_u", "f_v", "c_u")
    assert np.linalg.eigvalsh(back.covariance).min() > 0


@pytest.mark.parametrize(
    ("pairs", "size", "message"),
    [
        ([], SIZE, "pairs: none"),
        ([(np.zeros((3, 2)), np.zeros((4, 2)))], SIZE, "3 pixels in one view, 4 in the other"),
        ([(np.full((3, 2), np.nan), np.zeros((3, 2)))], SIZE, "not finite"),
        ([(np.full((3, 2), 5000.0), np.zeros((3, 2)))], SIZE, "outside the picture"),
        ([(np.zeros((3, 2)), np.zeros((3, 2)))], (2, 2), "image_size"),
        ([(np.zeros((3, 2)), np.zeros((3, 2)))], (math.nan, 960), "image_size"),
        (None, SIZE, "pairs"),
        ([5], SIZE, "not two arrays"),
        ([(np.ones((30000, 2)), np.ones((30000, 2)))], SIZE, "take every n-th"),
    ],
)
def test_wrong_arguments_are_named(pairs, size, message):
    with pytest.raises(pf.ArgumentError, match=message):
        self_calibrate(pairs, size)


def test_few_matches_are_no_error():
    assert self_calibrate([(np.ones((5, 2)), np.ones((5, 2)))], SIZE).status == "no_matches"


def test_command_reads_matches_and_refuses_in_one_line(tmp_path, capsys):
    good, bad = make_setup(7, "wide", noise=0.3, points=200), make_setup(10_100, "fisheye", "axial", points=200)
    np.savez(tmp_path / "good.npz", xy1=good.pairs[0][0], xy2=good.pairs[0][1])
    np.savetxt(tmp_path / "bad.csv", np.hstack(bad.pairs[0]), delimiter=",", header="x1,y1,x2,y2", comments="")
    out = tmp_path / "camera.json"
    assert main(["selfcal", str(tmp_path / "good.npz"), "--size", "1280x960", "-o", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["status"] == "ok"
    assert document["starts"]["agreeing"] >= 1
    assert document["usable"] is True and document["ambiguous"] is False
    assert document["camera"]["f_u"] == pf.Camera.load(out).f_u and document["camera"]["f_u_sigma"] > 0
    assert pf.Camera.load(out).f_u == pytest.approx(good.lens.f, rel=0.03)
    assert main(["selfcal", str(tmp_path / "bad.csv"), "--size", "1280x960", "-o", str(tmp_path / "no.json")]) == 1
    assert "along its optical axis" in capsys.readouterr().err
    assert not (tmp_path / "no.json").exists()
    assert main(["selfcal", str(tmp_path / "good.npz"), "-o", str(out)]) == 1
    assert "--size" in capsys.readouterr().err
    assert main(["selfcal", str(tmp_path / "good.npz"), "--size", "640x480", "-o", str(out)]) == 1
    assert "good.npz, x1 y1: a pixel outside the picture" in capsys.readouterr().err


def test_what_cannot_be_done_is_said_before_the_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(selfcal_input, "match_pictures", None)
    for name in ("a.json", "a.jpg"):
        assert main(["selfcal", name, "-o", str(tmp_path / "o.json")]) == 1
        assert f"{name}: alone; give two pictures" in capsys.readouterr().err
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / name)
    pictures = [str(tmp_path / name) for name in ("a.jpg", "b.jpg")]
    assert main(["selfcal", *pictures, "-o", str(tmp_path / "nowhere" / "o.json")]) == 1
    assert "nowhere is no folder" in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"x1,y1\n1,2\n", b"1,2,3\n", b"\xff\xfe"])
def test_bad_files_are_named(tmp_path: Path, capsys, content):
    file = tmp_path / "matches.csv"
    file.write_bytes(content)
    assert main(["selfcal", str(file), "--size", "640x480", "-o", str(tmp_path / "o.json")]) == 1
    assert "matches.csv" in capsys.readouterr().err


def test_matches_of_pictures_are_dense_even_and_in_pixels_of_the_whole_picture(monkeypatch):
    """Halved pictures, as large ones are: a place that is half a pixel off would show."""
    monkeypatch.setattr(selfcal_input, "DENSE_PIXELS", 320 * 240)
    monkeypatch.setattr(selfcal_input, "MOST_MATCHES", 300)
    random = np.random.default_rng(3)
    base = sum(
        np.kron(random.uniform(0, 1, (600 // n + 1, 760 // n + 1)), np.ones((n, n)))[:600, :760] for n in (4, 8, 16, 32)
    )
    wave = np.exp(-(np.linspace(-2, 2, 9) ** 2))
    for axis in (0, 1):
        base = np.apply_along_axis(np.convolve, axis, base, wave / wave.sum(), "same")
    base = (base - base.min()) / np.ptp(base)
    shift = np.array([17.0, 9.0])
    one, two = selfcal_input.match_pictures(base[40:520, 40:680], base[31:511, 23:663])
    off = np.linalg.norm(two - one - shift, axis=1)
    assert 100 < len(one) <= 320
    assert np.median(off) < 0.1 and (off < 0.5).mean() > 0.9
    assert (one.max(axis=0) > [560, 400]).all() and (one.min(axis=0) < [80, 80]).all()


def test_a_survey_with_panning_calibrates_and_a_straight_one_is_refused(tmp_path, capsys):
    """From the file a device sends: the scale within three sigmas and 2 %, with an uncertainty that a reconstruction
    takes up; straight on, what is missing is named."""
    camera = fisheye(100)
    drive = tube_drive(4, 1.5, limits=(20.0, 89.0), density=300.0, camera=camera, pan=0.6)
    file = survey_of(drive, tmp_path / "pan.mcap")
    assert main(["selfcal", str(file), "-o", str(tmp_path / "camera.json"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    found = pf.Camera.load(tmp_path / "camera.json")
    assert document["sigma"] >= selfcal_input.COMMON_SIGMA
    assert abs(found.f_u - camera.f_u) < min(3 * math.sqrt(found.covariance[0, 0]), 0.02 * camera.f_u)
    measured = reconstruct(drive.tracks, found, drive.driven, encoder=ENCODER, threads=1)
    assert 0 < np.median(np.einsum("nii->n", measured.systematic)) < 0.01**2  # a hundredth of a metre
    straight = tube_drive(4, 1.5, limits=(20.0, 89.0), density=300.0, camera=camera, wobble=0.0)
    file = survey_of(straight, tmp_path / "straight.mcap")
    assert main(["selfcal", str(file), "-o", str(tmp_path / "no.json")]) == 1
    error = capsys.readouterr().err
    assert "along its optical axis" in error and "Pan or tilt by at least" in error


# ---------------------------------------------------------------------- health


@pytest.mark.parametrize("case", ["bend", "radius", "axial"])
def test_health_check_tells_a_drifted_profile_from_one_that_holds(case):
    assert health_of(1, case, "", density=300.0, length=5.0)["verdict"] == "profile still valid"
    for change, name, size in (("scale", "angle scale", -1.0), ("centre", "centre u", -3.0)):
        found = health_of(1, case, change, density=300.0, length=5.0)
        assert found["verdict"] == "drifted, recalibrate"
        assert f"{health.WORDS[name]} changed by" in found["text"] and "if nothing else changed" in found["text"]
        # A straight drive tells the angles' scale and alpha apart by nothing but their curves.
        assert (health.WORDS["alpha"] not in found["text"]) or (case == "axial" and change == "scale")
        value, sigma = found["changes"][name]
        assert abs(value - size) < 3 * sigma < abs(size)


def judged(drift: list[float], noise: float, common_scale: float = 0.0) -> health.ProfileCheck:
    """What is said of a survey that sees `drift` of DRIFT with sigmas of `noise` times DRIFT's, and nothing else."""
    camera, end = fisheye(100), 1.5
    ways = health._directions(camera, end) * np.array(list(health.DRIFT.values()))
    onto = np.linalg.pinv(ways / np.abs(ways).max(axis=1, keepdims=True).clip(1e-12))
    onto /= np.abs(ways).max(axis=1).clip(1e-12)
    information = onto.T @ onto / noise**2
    seen = health._Seen(information, information @ ways @ drift)
    return health._judge(seen, camera, end, np.zeros(23), 1.0, "", common_scale)


def test_a_change_that_is_named_is_that_of_one_cause_and_wider_by_what_it_leaves():
    """Curves of drift are so much alike that with all of them free -1 % was told as -2.6 +- 0.5 %."""
    one, two = judged([-1 / 3, 0, 0, 0, 0], 0.01), judged([-1 / 3, 0, 0, 0.4, 0], 0.01)
    value, sigma = one.changes["angle scale"]
    assert value == pytest.approx(-1.0, abs=0.01) and "if nothing else changed" in one.text
    assert f"focal length changed by {value:+.2g} ± {1.96 * sigma:.2g} %" in one.text, "its 95 % interval"
    assert two.changes["angle scale"][1] > 2 * sigma and "does not explain all of it" in two.text


@pytest.mark.parametrize("change", ["", "alpha"])
def test_health_check_cannot_tell_in_a_straight_pipe_of_unknown_radius(change):
    """Turns that noise feigns would leave sigma(alpha) at a few per cent: they count for nothing."""
    found = health_of(3, "straight", change, density=300.0, length=5.0)
    assert found["verdict"] == "cannot tell"
    assert 0.02 < found["alpha_sigma"] < 0.2  # all that a lens may drift
    assert f"leaves the diameter open by ± {196 * found['alpha_sigma']:.2g} %" in found["text"]


def test_a_valid_profile_is_told_with_what_would_have_shown():
    """ "Valid" is no word on what the survey does not see."""
    found = judged([0, 0, 0, 0, 0], 0.01)
    blind = judged([0, 0, 0, 0, 0], 0.6).text
    least = 4 * found.changes["angle scale"][1]
    assert f"focal length by {least:.2g} %" in found.text and "no change" not in found.text
    assert f"would have shown: none. Of {' and '.join(health.WORDS[name] for name in health.DRIFT)} no change" in blind


def test_what_tracks_have_in_common_is_no_drift_and_hides_as_much():
    """0.7 % of the angle scale to +- 0.17 % was a drift in a straight drive whose profile was right."""
    drift = [0.7 / 3, 0, 0, 0, 0]
    assert judged(drift, 0.04).verdict == health.VERDICTS["drifted"]
    found = judged(drift, 0.04, 0.0045)
    _, sigma = found.changes["angle scale"]
    assert found.verdict == health.VERDICTS["valid"]
    assert sigma == pytest.approx(math.hypot(0.45, judged(drift, 0.04).changes["angle scale"][1]), rel=0.1)
    assert f"focal length by {4 * sigma:.2g} %" in found.text and "± 0.88 % in a straight drive" in found.text
    assert judged([0, 0, 0, 0.3, 0], 0.04, 0.0045).verdict == health.VERDICTS["drifted"], "the centre shows as before"


@pytest.mark.parametrize(("wobble", "said"), [(0.0, True), (1.0, False)])
def test_a_measurement_counts_what_tracks_have_in_common_where_the_drive_is_straight(wobble, said, tmp_path):
    file = survey_of(tube_drive(3, 2.0, density=300.0, wobble=wobble), tmp_path / "survey.mcap")
    health_text = measure(Survey.open(file), diameter=0.3, pictures=False, threads=1).health.text
    assert ("in common look like a focal length off by ± 0.88 %" in health_text) is said


@pytest.mark.parametrize("fails", [False, True])
def test_an_adjustment_with_the_known_diameter_that_does_not_end_tells_nothing(fails, monkeypatch):
    """Its last state was judged as if it had: the diameter by what the adjustment without it had made of the drive."""
    drive, readings = survey(2, "axial", density=300.0, length=2.0)
    known = {"encoder": ENCODER, "diameter": 0.3, "sigma": 0.2, "threads": 1}
    made = []

    def once(*args, **more):
        made.append(reconstruct(*args, **more))
        return dataclasses.replace(made[-1], drift=[], reason="no camera") if fails and len(made) > 1 else made[-1]

    monkeypatch.setattr(health, "reconstruct", once)
    monkeypatch.setattr(health, "NEAR", 1e-9)
    monkeypatch.setattr(health, "ROUNDS", 2)
    found = health.check_profile(drive.tracks, drive.camera, readings, **known)
    assert found.verdict == "cannot tell" and len(made) == 2
    assert ("no camera" if fails else "did not settle: after 2") in found.text


def test_residuals_with_a_trend_take_back_that_a_profile_is_valid(tmp_path, monkeypatch):
    """And nothing else: what has drifted stays so."""
    file = survey_of(tube_drive(3, 2.0, density=300.0), tmp_path / "survey.mcap")
    right = measure(Survey.open(file), diameter=0.3, pictures=False, threads=1)
    assert right.health.verdict == health.VERDICTS["valid"]
    monkeypatch.setattr(measured_remarks, "TREND_PX", 1e-9)
    found = measure(Survey.open(file), diameter=0.3, pictures=False, threads=1)
    assert found.health.verdict == health.VERDICTS["unknown"] and "residuals have a trend" in found.health.text
    drifted = judged([-1 / 3, 0, 0, 0, 0], 0.01)
    assert health.doubted(drifted, "why") is drifted


def test_a_known_diameter_without_an_encoder_tells_nothing_of_a_straight_drive():
    """It is then the scale: nothing is left to compare it with."""
    drive, _ = survey(2, "straight", density=300.0, length=2.0)
    found = health.check_profile(drive.tracks, drive.camera, diameter=0.3, sigma=0.2, threads=1)
    assert found.verdict == "cannot tell" and "never panned" in found.text


def bent_drive(**camera):
    return survey(1, "bend", density=300.0, camera=fisheye(100, **camera))


def test_a_profile_without_the_pupil_shift_is_not_accused(monkeypatch):
    """A shift of 2.5 mm at 90 degrees, 15 cm from the wall: as large as a drift, and another thing."""
    drive, readings = bent_drive(pupil_e1=0.001)
    profile = fisheye(100)
    known = {"encoder": ENCODER, "sigma": 0.2, "threads": 1}
    assert health.check_profile(drive.tracks, profile, readings, **known).verdict != "drifted, recalibrate"
    monkeypatch.setattr(health, "PUPIL_MOST", 1e-6)
    assert health.check_profile(drive.tracks, profile, readings, **known).probability < 1e-6


def test_a_lens_of_ripples_that_is_a_little_oval_is_not_accused(monkeypatch):
    """0.08 px of what no profile has: curves of drift are so much alike that they would show per cents of each."""
    ripple = lens_ripple.radial_fit(fisheye(100), np.linspace(0.2, 1.6, 60)) @ (
        0.08 / 300 * np.cos(5 * np.linspace(0.2, 1.6, 60))
    )
    f, (k2, k3, k4, k5) = 300 * math.exp(ripple[0]), np.array([-0.02, 0.002, 0, 0]) + ripple[1:]
    cpoly = (0.0,) * 2 + (0.08 / 300 / 1.5**2,) * 6 + (0.0,) * 6
    drive, readings = bent_drive(f_u=f, f_v=f, k2=k2, k3=k3, k4=k4, k5=k5, cpoly=cpoly)
    known = {"encoder": ENCODER, "sigma": 0.2, "threads": 1}
    assert health.check_profile(drive.tracks, fisheye(100), readings, **known).verdict == "profile still valid"
    monkeypatch.setattr(lens_ripple, "LENS_RADIAL_PX", 1e-4)
    monkeypatch.setattr(health, "LENS_ASYMMETRIC_PX", 1e-4)
    assert health.check_profile(drive.tracks, fisheye(100), readings, **known).verdict == "drifted, recalibrate"


def test_the_check_asks_for_no_second_reconstruction(monkeypatch):
    """With one that was made for it the answer is the same; with the noise of its tracks taken for more, wider."""
    drive, readings = bent_drive()
    known = {"encoder": ENCODER, "sigma": 0.2, "threads": 1}
    alone = health.check_profile(drive.tracks, drive.camera, readings, **known)

    def again(noise: float) -> health.ProfileCheck:
        prior = health.drift_prior(drive.tracks, drive.camera, noise)
        structure = reconstruct(drive.tracks, drive.camera, readings, drift=prior, **known)
        with monkeypatch.context() as patch:
            patch.setattr(health, "reconstruct", None)
            return health.check_profile(drive.tracks, drive.camera, readings, structure=structure, **known)

    same, wider = again(1.0), again(3.0)
    assert (same.verdict, same.alpha_sigma) == (alone.verdict, pytest.approx(alone.alpha_sigma, rel=1e-6))
    assert wider.alpha_sigma > 2 * alone.alpha_sigma and wider.verdict == "cannot tell"


@pytest.mark.parametrize("radius", [0.075, 0.3])
def test_the_nearer_a_wall_the_more_a_pupil_shift_changes_its_diameter(radius):
    """Against the diameter that a central profile measures through a lens whose pupil moves."""
    shift, angles, phi = 1e-4, np.radians([40, 80]), np.linspace(0, 6, 20)[:, None]
    ahead = radius / np.tan(angles)
    points = np.stack(np.broadcast_arrays(radius * np.cos(phi), radius * np.sin(phi), ahead), -1).reshape(-1, 3)
    pixels = fisheye(100, pupil_e1=shift).project(points)[0]
    rays = fisheye(100).unproject(pixels)[0].reshape(20, 2, 3)
    cot = rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
    measured = (ahead[0] - ahead[1]) / (cot[:, 0] - cot[:, 1])
    tracks = pf.Tracks(np.tile([0, 1], 20), np.repeat(np.arange(20), 2), pixels)
    slope = health._diameter_slope(fisheye(100), tracks, radius)[health.FREE.index("pupil_e1")]
    assert slope == pytest.approx(-np.log(np.mean(measured) / radius) / shift, rel=0.01)


def test_chi2_tail_against_tables():
    for value, degrees, tail in ((3.841, 1, 0.05), (5.991, 2, 0.05), (7.815, 3, 0.05), (13.277, 4, 0.01)):
        assert _chi2_tail(value, degrees) == pytest.approx(tail, rel=2e-3)
