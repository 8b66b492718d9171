"""Motion segmentation: the labels' minimisation, layers and fields on pictures whose truth is known, files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from pipefish import _engine
from pipefish.cli import main
from pipefish.segmentation import planes
from pipefish.segmentation_files import LAYER_FILES, document, motion_text, write_segmentation
from segment_scenes import (
    Pair,
    boundary_score,
    flow_errors,
    gain_rms,
    label_agreement,
    make_pair,
    make_wave,
    overlap,
    paired,
    points_in_layers,
    round_trips,
    smallest_piece,
)

SIZE = {"width": 240, "height": 180}
STEPS = ((1, 0), (0, 1), (1, 1), (-1, 1))  # to the neighbours that a pixel's weights are of


def labelling(rng: np.random.Generator) -> tuple:
    """A random problem as those of segmentation, small: two images of 2 x 4 pixels, three labels."""
    n = 16
    cost = rng.integers(0, 60, (3, n)).astype(np.int32)
    cost[1:][rng.random((2, n)) < 0.15] = 1_000_000
    weight = rng.integers(0, 40, (2, 2, 4, 4)).astype(np.int32)  # image, y, x, the neighbour
    for k, (dx, dy) in enumerate(STEPS):
        weight[:, :, 3 if dx > 0 else 0, k] *= dx == 0
        weight[:, 1, :, k] *= dy == 0
    partner = np.full((3, n), -1, np.int32)
    partner[1:, :8], partner[1:, 8:] = rng.integers(8, 16, (2, 8)), rng.integers(0, 8, (2, 8))
    partner[1:][rng.random((2, n)) < 0.2] = -1
    labels = rng.integers(0, 3, n)
    labels[cost[labels, np.arange(n)] >= 1_000_000] = 0
    return cost, 4, weight.reshape(2, 8, 4), partner, int(rng.integers(0, 30)), labels.astype(np.uint8)


def energies(cost, width, weight, partner, lonely, labels) -> np.ndarray:
    """(M,) of labels (M,N), by the definition."""
    n = np.arange(labels.shape[1])
    out = cost[labels, n].sum(axis=1, dtype=np.int64)
    pixels = weight.shape[1]
    for image, p, k in np.argwhere(weight > 0):
        one = image * pixels + p
        out += (labels[:, one] != labels[:, one + STEPS[k][0] + width * STEPS[k][1]]) * int(weight[image, p, k])
    to = partner[labels, n]
    alone = (labels > 0) & (to >= 0) & (np.take_along_axis(labels, np.maximum(to, 0), axis=1) != labels)
    return out + lonely * alone.sum(axis=1)


def expansion_errors(problems: int, seed: int) -> int:
    """How many single expansions of random problems end above the least energy of all 2^16 choices."""
    rng = np.random.default_rng(seed)
    choice = (np.arange(1 << 16)[:, None] >> np.arange(16)) & 1
    wrong = 0
    for _ in range(problems):
        *problem, labels = labelling(rng)
        alpha = int(rng.integers(0, 3))
        free = np.flatnonzero((labels != alpha) & (problem[0][alpha] < 1_000_000))
        every = np.repeat(labels[None], 1 << len(free), axis=0)
        every[:, free] = np.where(choice[: 1 << len(free), : len(free)] > 0, alpha, every[:, free])
        best = energies(*problem, every).min()
        got, energy = _engine.segment_expand(*problem, alpha, labels)
        wrong += energy != best or energies(*problem, got[None])[0] != best
    return wrong


def test_an_expansion_finds_the_best_of_all_choices():
    """The cut against brute force, couplings between the images and forbidden labels among the costs."""
    assert expansion_errors(1000, seed=1) == 0


def test_expanding_all_labels_never_raises_the_energy():
    rng = np.random.default_rng(2)
    for _ in range(200):
        *problem, labels = labelling(rng)
        before = energies(*problem, labels[None])[0]
        got, energy = _engine.segment_expand(*problem, -1, labels)
        assert energy == energies(*problem, got[None])[0] <= before
        assert all(_engine.segment_expand(*problem, alpha, got)[1] == energy for alpha in range(3))


@cache
def scene(**kind) -> Pair:
    return make_pair(**SIZE, **kind)


@cache
def segmented(**kind) -> pf.Segmentation:
    return pf.segment_motion(*scene(**kind).images)


def test_bent_and_relit_patches_are_found_in_both_pictures():
    """Outlines, motion and light, before unrelated backgrounds."""
    pair, s = scene(seed=1), segmented(seed=1)
    names = paired(s.labels1, pair.labels[0])
    assert s.status == "ok" and len(s.layers) == 2 and sorted(names.values()) == [1, 2]
    assert overlap(s.labels1, pair.labels[0], names) >= 0.92 and overlap(s.labels2, pair.labels[1], names) >= 0.92
    errors = flow_errors(s, pair, names)
    assert np.median(errors) <= 0.5 and np.quantile(errors, 0.95) <= 2
    assert gain_rms(s, pair, names) <= 0.05


def test_the_energy_never_rises():
    for s in (segmented(seed=1), segmented(seed=3, covered=True)):
        energy = np.array([step[1] for step in s.trace])
        assert len(energy) > 8 and (np.diff(energy) <= 1e-6 * np.abs(energy[1:])).all()
        assert [step for step, *_ in s.trace].count("grid halved") == 1


def test_the_way_there_and_back_ends_where_it_began():
    distances = round_trips(segmented(seed=1))
    assert len(distances) > 5000 and (distances <= 1).mean() >= 0.95


def test_pictures_exchanged_give_the_same_layers():
    s = segmented(seed=1)
    back = pf.segment_motion(*scene(seed=1).images[::-1])
    assert label_agreement(s.labels1, back.labels2) >= 0.97
    assert label_agreement(s.labels2, back.labels1) >= 0.97


def test_threads_do_not_change_the_result():
    pair, s = scene(seed=1), segmented(seed=1)
    other = pf.segment_motion(*pair.images, threads=3)
    assert (other.labels1 == s.labels1).all() and (other.labels2 == s.labels2).all() and other.trace == s.trace
    assert all(np.array_equal(a.flow1, b.flow1, equal_nan=True) for a, b in zip(s.layers, other.layers, strict=True))


def test_light_that_may_not_vary_over_a_layer_loses_much_of_it():
    """So the field of light is needed, and is what makes the first test pass."""
    pair = scene(seed=1)
    s = pf.segment_motion(*pair.images, light=1e6, rounds=2)
    names = paired(s.labels1, pair.labels[0])
    assert overlap(s.labels1, pair.labels[0], names) <= 0.85


def test_halving_the_grid_leaves_the_field_as_it_was():
    """Knots put between a spline's own: exact but for rounding, outside the box's grid points too."""
    rng = np.random.default_rng(4)
    for box, spacing in (((0, 0, 100, 70), 16.0), ((37, 5, 61, 90), 8.0)):
        at = np.array(box[:2]) + rng.random((200, 2)) * (np.array(box[2:]) - 1)
        whole, half = _engine.segment_halved(box, spacing, rng.normal(0, 5, (400, 2)), at)
        assert np.abs(whole - at).max() > 1 and np.abs(half - whole).max() < 1e-12


def test_waves_shorter_than_two_of_the_first_grids_cells_are_followed():
    """28 pixels: a point each 16 cannot follow them (the median error then is 1.1 pixels), one each 8 can."""
    images, to = make_wave(seed=5, period=28, height=1.5)
    s = pf.segment_motion(*images, rounds=2)
    on = np.zeros(s.labels1.shape, bool)
    on[12:-12, 12:-12] = s.labels1[12:-12, 12:-12] == 1
    assert on.mean() > 0.5
    assert np.median(np.hypot(*(s.layers[0].flow1 - to)[on].T)) <= 0.4


def test_matches_of_no_group_go_to_the_layer_whose_motion_they_have_and_wrong_ones_to_none(
    monkeypatch: pytest.MonkeyPatch,
):
    """A strip of a patch is taken out of its group, and half of its matches are put 20 pixels off: the layer takes the
    others (each fourth match is asked)."""
    pair = scene(seed=1)
    m = pf.match_quasi_dense(*pair.images)
    groups = pf.group_matches(m, least=30)
    own = groups.label == 0
    strip = own & (np.abs(m.xy1[:, 0] - np.median(m.xy1[own, 0])) < 15)
    wrong = strip & (np.random.default_rng(1).random(len(m)) < 0.5)
    inwards = np.where(m.xy2[:, 1] < 90, 20, -20)
    xy2 = m.xy2 + (wrong * inwards)[:, None] * np.array([0, 1])
    label = np.where(strip, -1, np.where(groups.label < 0, groups.count, groups.label))  # and no others
    monkeypatch.setattr("pipefish.segmentation.group_matches", lambda m, least: replace(groups, matches=m, label=label))
    s = pf.segment_motion(*pair.images, replace(m, xy2=xy2), rounds=1)
    asked = ~wrong[np.flatnonzero(strip)[::4]]
    assert 250 < asked.sum() < 0.6 * len(asked)
    assert 0.95 * asked.sum() <= sum(layer.claimed for layer in s.layers) <= asked.sum()


def test_labels_have_no_specks():
    for s in (segmented(seed=1), segmented(seed=3, covered=True), segmented(seed=4, scale=0.4)):
        assert smallest_piece(s.labels1) >= 50 and smallest_piece(s.labels2) >= 50


def test_pictures_with_nothing_in_common_have_no_layers():
    s = segmented(seed=2, patches=0)
    assert s.status == "no common motion" and not s.layers
    assert not s.labels1.any() and not s.labels2.any()


def test_a_layer_that_covers_another_ends_at_its_outline():
    pair, s = scene(seed=3, covered=True), segmented(seed=3, covered=True)
    assert boundary_score(s.labels1, pair.labels[0]) >= 0.8 and boundary_score(s.labels2, pair.labels[1]) >= 0.8


def test_layers_may_be_much_smaller_in_one_picture():
    pair, s = scene(seed=4, scale=0.4), segmented(seed=4, scale=0.4)
    names = paired(s.labels1, pair.labels[0])
    assert overlap(s.labels1, pair.labels[0], names) >= 0.9
    assert np.median(flow_errors(s, pair, names)) <= 0.5


def test_a_surface_whose_matches_are_right_is_not_lost_for_its_common_colours():
    """Seen much smaller in picture 2, a sixth of a patch was lost where its colours are common: pixels alone spoke."""
    pair = make_pair(4000, width=480, height=360, scale=0.4)
    s = pf.segment_motion(*pair.images)
    assert overlap(s.labels1, pair.labels[0], paired(s.labels1, pair.labels[0])) >= 0.9


def test_grey_pictures_do_too():
    pair = scene(seed=1)
    s = pf.segment_motion(*(image.mean(axis=2) for image in pair.images), rounds=2)
    names = paired(s.labels1, pair.labels[0])
    assert overlap(s.labels1, pair.labels[0], names) >= 0.85 and s.layers[0].gain1.shape[2] == 1


def test_real_motions_come_apart(real_data: Callable[[str], Path]):
    """A bread and a cube that were moved each by itself, at half the size: the points of each in a layer of its own."""
    folder = real_data("motion") / "breadcube"
    halves = []
    for k in (1, 2):
        whole = np.asarray(Image.open(folder / f"breadcube{k}.png").convert("RGB")).astype(float)
        halves.append(whole.reshape(240, 2, 320, 2, 3).mean(axis=(1, 3)) / 255)
    points = np.loadtxt(folder / "breadcube.txt")
    points[:, [0, 1, 3, 4]] = (points[:, [0, 1, 3, 4]] - 0.5) / 2
    found = points_in_layers(pf.segment_motion(*halves), points)
    assert all(m["recall"] >= 0.8 and m["purity"] >= 0.9 for m in found["motions"])
    assert found["outliers"] <= 0.15
    assert found["same_layer"] <= 0.25  # of a faultless cut-out 0.22: wrong pairs within the cube, or within the bread


def test_the_command_writes_labels_fields_and_pictures(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pair = scene(seed=1)
    for k, image in enumerate(pair.images):
        Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(tmp_path / f"{k}.png")
    out = tmp_path / "out"
    assert main(["segment", str(tmp_path / "0.png"), str(tmp_path / "1.png"), "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["status"] == "ok" and len(told["layers"]) == 2 and all(Path(f).exists() for f in told["files"])
    labels = np.asarray(Image.open(out / "labels1.png"))
    assert [(labels == k).sum() for k in (1, 2)] == [layer["area1"] for layer in told["layers"]]
    assert json.loads((out / "layers.json").read_text())["trace"] == told["trace"]
    with np.load(out / "layer_1/flow.npz") as flow, np.load(out / "layer_1/light.npz") as light:
        assert np.isfinite(flow["flow1"][labels == 1]).mean() > 0.99
        assert flow["flow2"].shape == (180, 240, 2) and light["gain1"].shape == (180, 240, 3)
    legend = (out / "README.txt").read_text()
    assert all(Path(f).name in legend for f in told["files"] if Path(f) != out / "README.txt"), "each file is told of"
    assert (
        sorted(p.name for p in out.iterdir() if p.is_dir()) == ["layer_1", "layer_2"] and len(list(out.iterdir())) == 7
    )
    cut = np.asarray(Image.open(out / "layer_1/warped1.png"))
    assert ((cut[..., 3] > 0) == (labels == 1)).all() and np.ptp(cut[labels == 1]) > 50
    assert Image.open(out / "segmentation.png").size == (3 * 240 + 12, 16 + 2 * 186)


def test_layers_of_an_earlier_run_are_gone_and_what_else_lay_there_stays(tmp_path: Path):
    """They looked like layers of these pictures."""
    pair, s = scene(seed=1), segmented(seed=1)
    one, two = (planes(image, "image") for image in pair.images)
    write_segmentation(tmp_path, one, two, s)
    (tmp_path / "layer_2/notes.txt").write_text("mine")
    (tmp_path / "layer_old").mkdir()
    nothing = replace(s, layers=[], labels1=0 * s.labels1, labels2=0 * s.labels2)
    write_segmentation(tmp_path, one, two, nothing)
    left = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.glob("layer_*/**/*"))
    assert left == ["layer_2/notes.txt"]
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["layer_2", "layer_old"]
    files = write_segmentation(tmp_path, one, two, s)
    assert {Path(f).name for f in files if Path(f).parent.name == "layer_1"} == set(LAYER_FILES)


def test_a_layer_tells_how_far_it_moved_and_turned():
    """Of pixels with its label alone, whatever its field says elsewhere; clockwise as one looks at the picture."""
    s = segmented(seed=1)
    y, x = np.mgrid[:180, :240].astype(float)
    turn, middle = 1.1 * np.exp(1j * np.radians(12)), 90 + 60j
    there = (x + 1j * y - middle) * turn + middle + (30 - 7.5j)
    on = np.hypot(x - 90, y - 60) < 40
    flow = np.stack([there.real, there.imag], axis=2).astype(np.float32)
    flow[~on] = 500
    flow[60, 90] = np.nan
    labels = np.where(on, 1, 0).astype(np.uint8)
    moved = replace(s, labels1=labels, layers=[replace(s.layers[0], flow1=flow)])
    found = moved.motion(1)
    assert (found.right, found.down) == pytest.approx((30, -7.5), abs=0.1)
    assert found.distance == pytest.approx(np.hypot(30, 7.5), abs=0.1)
    assert (np.degrees(found.rotation), found.scale) == pytest.approx((12, 1.1), abs=0.01)
    told = motion_text(found)
    assert "px right and" in told and "px up)" in told and "turned 12.0° clockwise, 1.10 times as large" in told
    assert replace(moved, labels1=0 * labels).motion(1) is None


def test_layers_that_changed_places_moved_apart():
    """By as much as their pixels really did, median of the truth."""
    pair, s = scene(seed=1), segmented(seed=1)
    y, x = np.mgrid[:180, :240]
    for patch, label in paired(s.labels1, pair.labels[0]).items():
        true = np.nanmedian((pair.flow - np.stack([x, y], axis=2))[pair.labels[0] == patch], axis=0)
        found = s.motion(label)
        assert (found.right, found.down) == pytest.approx(true, abs=1.0) and found.distance > 80
        assert document(s)["layers"][label - 1]["motion"]["right_px"] == pytest.approx(found.right, abs=1e-3)


def test_the_command_takes_grey_with_colour_and_names_what_it_cannot_take(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    Image.fromarray(np.zeros((40, 50, 3), np.uint8)).save(tmp_path / "colour.png")
    Image.fromarray(np.full((40, 60), 300, np.uint16)).save(tmp_path / "deep.png")
    Image.fromarray(np.zeros((1001, 2000), np.uint8)).save(tmp_path / "large.png")
    out = ["-o", str(tmp_path / "out"), "--json"]
    assert main(["segment", str(tmp_path / "colour.png"), str(tmp_path / "deep.png"), *out]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "no common motion"
    assert main(["segment", str(tmp_path / "colour.png"), str(tmp_path / "deep.png"), *out[:2]]) == 0
    assert "too little texture" in capsys.readouterr().out
    assert main(["segment", str(tmp_path / "colour.png"), str(tmp_path / "deep.png"), "-o", "/proc/none"]) == 1
    assert "--output: /proc/none" in capsys.readouterr().err
    assert main(["segment", str(tmp_path / "colour.png"), str(tmp_path / "large.png"), *out]) == 1
    assert "large.png: 2000x1001" in capsys.readouterr().err


def test_bad_arguments_are_named():
    image, other = scene(seed=1).images[0].mean(axis=2)[:64, :64], np.zeros((64, 64, 3))
    m = pf.match_quasi_dense(image, image)
    assert len(m) > 0
    for call, name in (
        (lambda: pf.segment_motion(image, other), "colour"),
        (lambda: pf.segment_motion(image, np.zeros((64, 65)), m), "m:"),
        (lambda: pf.segment_motion(image, image, replace(m, xy1=m.xy1 - 1e4)), "m: matches"),
        (lambda: pf.segment_motion(image, image, replace(m, xy2=m.xy2 + 1e4)), "m: matches"),
        (lambda: pf.segment_motion(image, image, replace(m, xy2=m.xy2 * np.nan)), "m: places"),
        (lambda: pf.segment_motion(image, image, layers=0), "layers"),
        (lambda: pf.segment_motion(image, image, layers="a"), "layers"),
        (lambda: pf.segment_motion(image, image, rounds=2.5), "rounds"),
        (lambda: pf.segment_motion(image, image, replace(m, zncc=m.zncc * np.nan)), "m: places, affine maps or correl"),
        (lambda: pf.segment_motion(image, image, threads=0), "threads"),
        (lambda: pf.segment_motion(image, image, light=0), "light"),
        (lambda: pf.segment_motion(image - 1, image), "image1"),
    ):
        with pytest.raises(pf.ArgumentError, match=name):
            call()
