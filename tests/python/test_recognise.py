"""Recognition of objects: two small models, turned and placed among other textures, with exact masks."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import pipefish as pf
from pipefish.cli import main
from pipefish.recognition import _combine
from test_match import grid, noisy, waves

Floats = NDArray[np.float64]
W, H = 220, 170
OBJECT = (100, 84)  # width, height of a model
PLACES = {"rose": (80, 70), "thorn": (135, 90)}
SEEDS = {"rose": 31, "thorn": 32}
TURN = np.array([[0.94, -0.3], [0.28, 0.9]])


def model_picture(name: str, behind: int = 40) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The object on some background, and its mask."""
    xy = grid(OBJECT[0] + 40, OBJECT[1] + 40)
    inside = ((xy >= 20) & (xy < np.array(OBJECT) + 20)).all(axis=-1)
    return noisy(np.where(inside, waves(xy, SEEDS[name]), waves(xy, behind)), 3), inside


@cache
def scene(name: str | None, behind: int = 50, size: int = 1) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The object turned (or none) before a background, its upper left corner hidden; where it is seen.

    size: times as many pixels."""
    xy = (grid(W * size, H * size) + 0.5) / size - 0.5
    picture, seen = waves(xy, behind), np.zeros((H * size, W * size), bool)
    if name is not None:
        own = (xy - PLACES[name]) @ np.linalg.inv(TURN).T + np.array(OBJECT) / 2 + 20
        seen = ((own >= 20) & (own < np.array(OBJECT) + 20)).all(axis=-1)
        seen &= xy[..., 0] + xy[..., 1] > sum(PLACES[name]) - 50
        picture = np.where(seen, 0.8 * waves(own, SEEDS[name]) + 0.05, picture)
    return noisy(picture, 4), seen


def models() -> list[pf.ObjectModel]:
    return [pf.ObjectModel(name, [model_picture(name)]) for name in PLACES]


def iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_objects_are_found_where_they_are_and_nowhere_else() -> None:
    wanted = ["rose", "thorn", None]
    found = pf.recognise(models(), [scene(name)[0] for name in wanted])
    assert [(r.object, r.scene) for r in found] == [(n, s) for s in range(3) for n in PLACES]
    for r in found:
        here = wanted[r.scene] == r.object
        assert r.present == here
        if here:
            assert r.score > 0.4 and iou(r.mask((H, W)), scene(r.object)[1]) >= 0.8
            x0, y0, x1, y1 = r.box()
            y, x = np.nonzero(scene(r.object)[1])
            assert np.abs(np.array([x0, y0, x1, y1]) - [x.min(), y.min(), x.max(), y.max()]).max() < 10
        else:
            assert r.score < 0.02


def test_the_extent_is_the_whole_object_hidden_parts_too() -> None:
    (r,) = pf.recognise(models()[:1], [scene("rose")[0]])
    corners = np.array([[20, 20], [119, 20], [119, 103], [20, 103]], float)
    there = (corners - np.array(OBJECT) / 2 - 20) @ TURN.T + PLACES["rose"]
    (line,) = r.extent
    assert np.linalg.norm(line[:, None] - there[None], axis=2).min(axis=0).max() < 2.5


def with_bare_rim() -> tuple[pf.Recognition, NDArray[np.bool_], NDArray[np.bool_]]:
    """A model whose middle is textured and whose broad rim is bare; a scene, in colours, where it stands before another
    colour, its place known by the middle only, its lower left corner hidden.

    Returns what is found, where it is seen, where it is hidden."""
    image, inside = model_picture("rose")
    middle = np.zeros_like(inside)
    middle[45:-45, 50:-50] = True
    model = np.where(inside & ~middle, 0.6, image).astype(np.float32)
    xy = grid(W, H)
    own = (xy - PLACES["rose"]) @ np.linalg.inv(TURN).T + np.array(OBJECT) / 2 + 20
    at = np.rint(own).astype(int)
    held = np.clip(at, 0, np.array(inside.shape[::-1]) - 1)
    whole = inside[held[..., 1], held[..., 0]] & (held == at).all(axis=-1)
    seen = whole & (xy[..., 1] - xy[..., 0] < 30)
    textured = seen & ((own >= [50, 45]) & (own < [90, 79])).all(axis=-1)
    values = np.where(textured, waves(own, SEEDS["rose"]), 0.6)
    behind = waves(xy, 50)
    yellow = np.stack([values, 0.9 * values, np.full_like(values, 0.2)], axis=-1)
    blue = np.stack([0.4 * behind, 0.4 * behind, np.full_like(behind, 0.6)], axis=-1)
    picture = np.where(seen[..., None], yellow, blue)
    return pf.recognise([pf.ObjectModel("rose", [(model, inside)])], [picture])[0], seen, whole & ~seen


def test_the_outline_is_that_of_what_is_seen_bare_parts_too() -> None:
    r, seen, hidden = with_bare_rim()
    assert r.present and iou(r.matched((H, W)), seen) < 0.5
    assert iou(r.mask((H, W)), seen) >= 0.9
    assert hidden.sum() > 400 and (r.mask((H, W)) & hidden).sum() < 0.5 * hidden.sum()
    y, x = np.nonzero(seen)
    assert np.abs(np.array(r.box()) - [x.min(), y.min(), x.max(), y.max()]).max() < 5


def test_what_another_object_covers_is_not_the_ones() -> None:
    """Both objects present, the thorn's corner over the rose: what was matched of one is in no other's outline."""
    both, _ = scene("rose")
    thorn, covers = scene("thorn")
    rose, over = pf.recognise(models(), [np.where(covers, thorn, both)])
    assert rose.present and over.present
    shared = _whole(rose) & over.matched((H, W))
    assert shared.sum() > 300 and (rose.mask((H, W)) & shared).sum() < 0.1 * shared.sum()


def test_what_is_farther_away_than_the_object_is_large_is_no_part_of_it() -> None:
    """Its halves, 250 pixels apart: one counts, whether both are in one view or each in its own."""
    picture, mask = model_picture("rose")
    halves = (
        np.where(np.arange(picture.shape[1]) < 70, mask, False),
        np.where(np.arange(picture.shape[1]) > 69, mask, 0),
    )
    apart = waves(grid(2 * W, H), 50)
    for half, x in zip(halves, (10, 260), strict=True):
        place = apart[10 : 10 + mask.shape[0], x : x + mask.shape[1]]
        place[half != 0] = picture[half != 0]
    views = [(picture, half) for half in halves]
    for model in (pf.ObjectModel("whole", [(picture, mask)]), pf.ObjectModel("halves", views)):
        (r,) = pf.recognise([model], [apart])
        seen = r.matched(apart.shape)
        assert r.present and min(seen[:, :W].sum(), seen[:, W:].sum()) == 0
        assert r.view != "view 1" or len(r.segments) == 1


def test_a_small_piece_counts_where_it_fits_and_not_where_chance_matches_as_many() -> None:
    """18 x 18 pixels of the rose show. Elsewhere larger groups match by chance: their neighbours agree less."""
    picture, _ = model_picture("rose")
    shown = scene(None)[0].copy()
    shown[60:78, 100:118] = picture[60:78, 60:78]
    rose, thorn = pf.recognise(models(), [shown])
    (piece,) = rose.segments
    assert np.hypot(piece.centre[0] - 108.5, piece.centre[1] - 68.5) < 5 and piece.evidence >= 6
    assert rose.score > 0.02
    assert thorn.matches > 50 and thorn.segments == []
    assert 0 < thorn.score < 0.001  # ranked all the same: what is absent does not tie with what is hardly seen


@pytest.mark.parametrize("seed", [0, 12, 15])
def test_nothing_is_present_that_was_not_matched_anywhere(seed: int) -> None:
    """16 x 16 pixels, all of an object, matched by a group too small to be evident: its share alone would do."""
    rng = np.random.default_rng(seed)
    picture = noisy(waves(grid(160, 140), 60 + seed), 3)
    x, y = rng.integers(40, 80, 2)[::-1]
    own, there = (slice(y, y + 16), slice(x, x + 16)), (slice(60, 76), slice(100, 116))
    mask, shown = np.zeros(picture.shape, bool), scene(None)[0].copy()
    mask[own] = True
    shown[there] = np.clip(picture[own] + rng.normal(0, 0.03, (16, 16)), 0, 1)
    model = pf.ObjectModel("it", [(picture, mask)])
    (r,) = pf.recognise([model], [shown])
    assert r.matches > 0 and r.segments == [] and not r.present
    assert 0 < r.score <= 0.002  # what a segment has to have
    (r,) = pf.recognise([model], [shown], threshold=0)
    assert not r.present


def test_a_view_without_segments_does_not_hide_those_of_others() -> None:
    """It has no place: everything else would lie outside of it."""
    segment = {"score": 0.055, "area": 0.1, "coverage": 0.8, "correlation": 0.7, "evidence": 20.0, "matches": 500}
    segment |= {"centre": (50.0, 60.0), "model_contours": [], "scene_contours": [np.zeros((3, 2))]}
    nowhere = {"score": 0.06, "place": (0, 0, 0), "segments": [], "extent": [], "seeds": 1, "matches": 100}
    seen = {"score": 0.055, "place": (50, 60, 40), "segments": [segment], "extent": [np.zeros((4, 2))]}
    seen |= {"seeds": 5, "matches": 900}
    model = pf.ObjectModel("it", [model_picture("rose")] * 2, ["a", "b"])
    r = _combine(model, 0, [nowhere, seen], 0.05)
    assert r.present and r.view == "b" and [s.view for s in r.segments] == ["b"]
    assert len(r.extent) == 1 and r.box() is not None


def test_evidence_is_that_of_the_smaller_picture() -> None:
    """45 x 45 pixels are 80 cells of a model at any size, which crowd at half the size: a quarter of the pixels."""
    picture, mask = model_picture("rose")
    mask = np.pad(mask[30:75, 40:85], ((30, mask.shape[0] - 75), (40, mask.shape[1] - 85)))
    piece, large = pf.ObjectModel("piece", [(picture, mask)]), scene("rose")[0]
    same, half = pf.recognise([piece], [large, large.reshape(H // 2, 2, W // 2, 2).mean(axis=(1, 3))])
    assert same.present and half.present
    assert 6 <= half.segments[0].evidence < 0.35 * same.segments[0].evidence


def _whole(r: pf.Recognition) -> NDArray[np.bool_]:
    return replace(r, outline=r.extent).mask((H, W))


def test_what_is_outside_the_mask_is_not_learned() -> None:
    """The model's background and the scene's are the same: only the mask keeps it from being found."""
    image, mask = model_picture("rose", behind=50)
    masked, whole = pf.ObjectModel("masked", [(image, mask)]), pf.ObjectModel("whole", [image])
    a, b = pf.recognise([masked, whole], [scene(None)[0]])
    assert not a.present and a.score < 0.01
    assert b.present


def test_the_score_hardly_changes_when_model_and_scene_change_places() -> None:
    """Both cluttered, neither masked. A score is a share of the model's picture: put to pixels of one of them."""
    one, two = noisy(scene("rose")[0], 7), np.ascontiguousarray(np.pad(model_picture("rose")[0], ((20, 26), (40, 40))))
    there, back = (
        pf.recognise([pf.ObjectModel("it", [a])], [b])[0].score * a.size for a, b in ((one, two), (two, one))
    )
    there *= 1 / np.linalg.det(TURN)
    assert there > 1000
    assert abs(there - back) <= 0.15 * max(there, back)


def test_large_pictures_are_made_smaller_and_contours_are_in_their_pixels() -> None:
    large, seen = scene("thorn", size=3)
    (r,) = pf.recognise(models()[1:], [large], max_pixels=W * H)
    assert r.present and iou(r.mask(seen.shape), seen) >= 0.8


def test_several_views_count_by_the_best_and_share_a_contour() -> None:
    (rose, mask), (thorn, mask2) = model_picture("rose"), model_picture("thorn")
    left, right = mask.copy(), mask.copy()
    left[:, 75:], right[:, :65] = False, False
    model = pf.ObjectModel("both", [(rose, left), (thorn, mask2), (rose, right)], ["left", "other", "right"])
    (r,) = pf.recognise([model], [scene("rose")[0]])
    assert r.view in ("left", "right") and {s.view for s in r.segments} == {"left", "right"}
    assert r.sum_score > 1.5 * r.score and iou(r.mask((H, W)), scene("rose")[1]) >= 0.8


def test_threads_do_not_change_the_result_and_progress_is_told() -> None:
    told: list[tuple[int, int]] = []
    scenes = [scene("rose")[0], scene("thorn")[0]]
    one = pf.recognise(models(), scenes, progress=lambda *d: told.append(d))
    four = pf.recognise(models(), scenes, threads=4)
    assert told == [(k, 4) for k in range(1, 5)]
    for a, b in zip(one, four, strict=True):
        assert (a.score, a.seeds, a.matches, a.view) == (b.score, b.seeds, b.matches, b.view)
        for s, t in zip(a.segments, b.segments, strict=True):
            assert all(np.array_equal(p, q) for p, q in zip(s.scene_contours, t.scene_contours, strict=True))


PLAIN = np.zeros((64, 64), np.uint8)


@pytest.mark.parametrize(
    ("call", "what"),
    [
        (lambda: pf.ObjectModel("a", []), "a: no views"),
        (lambda: pf.ObjectModel("a", [PLAIN], ["x", "y"]), "a: 2 labels of 1 views"),
        (lambda: pf.ObjectModel("a", [(PLAIN, PLAIN)]), "a, view 1: the mask is empty"),
        (lambda: pf.ObjectModel("a", [(PLAIN, PLAIN[:9])]), "a, view 1: the mask's shape"),
        (lambda: pf.ObjectModel("a", [PLAIN], max_pixels=9), "max_pixels: 9"),
        (lambda: pf.recognise([], [PLAIN], threshold=2), "threshold: 2"),
        (lambda: pf.recognise([], [PLAIN], threads=0), "threads: 0"),
        (lambda: pf.recognise([], [PLAIN[0]]), "scene 1: shape"),
    ],
)
def test_wrong_arguments_are_named(call: Callable[[], object], what: str) -> None:
    with pytest.raises(pf.ArgumentError, match=what):
        call()


def test_flat_pictures_are_no_error() -> None:
    (r,) = pf.recognise([pf.ObjectModel("flat", [PLAIN])], [PLAIN])
    assert r.score == 0 and not r.present and r.box() is None and r.segments == []


# ---- the command


def save(path: Path, image: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * np.asarray(image, float)).astype(np.uint8)).save(path)


def saved(tmp_path: Path) -> tuple[Path, Path]:
    """A model as a picture with its mask beside it, another as a folder with a view that has an alpha channel."""
    top = tmp_path / "models"
    rose, mask = model_picture("rose")
    save(top / "rose.png", rose)
    save(top / "rose_mask.png", mask)
    thorn, mask = model_picture("thorn")
    save(top / "thorn/front.png", np.dstack([thorn, thorn, thorn, mask]))
    save(tmp_path / "scenes/a.png", scene("rose")[0])
    save(tmp_path / "scenes/b.png", scene("thorn")[0])
    return top, tmp_path / "scenes"


def test_the_command_writes_tables_pictures_and_the_roc(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    top, scenes = saved(tmp_path)
    truth = tmp_path / "truth.csv"
    truth.write_text("scene,object\na,rose\nb.png,thorn\n")
    out = tmp_path / "out"
    assert main(["recognise", str(top), str(scenes), "--truth", str(truth), "-o", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [(f["scene"], f["object"]) for f in document["found"]] == [("a.png", "rose"), ("b.png", "thorn")]
    assert document["roc"]["grouped matches"]["auc"] == 1
    with open(out / "recognitions.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(r["scene"], r["object"], r["present"]) for r in rows] == [
        ("a.png", "rose", "1"),
        ("a.png", "thorn", "0"),
        ("b.png", "rose", "0"),
        ("b.png", "thorn", "1"),
    ]
    whole = json.loads((out / "recognitions.json").read_text())
    assert whole[3]["segments"][0]["view"] == "front"
    assert whole[3]["box"] == pytest.approx([float(rows[3][k]) for k in ("x0", "y0", "x1", "y1")], abs=0.06)
    drawn = np.asarray(Image.open(out / "a.found.png")).astype(int)
    assert drawn.shape == (H, W, 3)
    coloured = np.ptp(drawn, axis=2) > 40
    seen = scene("rose")[1]
    y, x = np.nonzero(seen)
    assert coloured[y.min() : y.max(), x.min() : x.max()].sum() > 200
    assert Image.open(out / "roc.png").size[0] > 600
    assert json.loads((out / "roc.json").read_text())["seeds"]["positives"] == 2


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("truth.csv", b"picture,thing\n", "truth.csv: line 1: the heading is not scene,object"),
        ("truth.csv", b"scene,object\na,rose\nc,rose\n", "truth.csv: line 3: no scene is named 'c'"),
        ("truth.csv", b"scene,object\na,lily\n", "truth.csv: line 2: no object is named 'lily'"),
        ("scenes/c.png", b"no picture", "c.png: not a picture"),
        ("models/thorn/front_mask.png", b"", "front_mask.png: not a picture"),
    ],
)
def test_the_command_names_a_bad_file(
    name: str, content: bytes, what: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    top, scenes = saved(tmp_path)
    (tmp_path / "truth.csv").write_text("scene,object\na,rose\n")
    (tmp_path / name).write_bytes(content)
    truth = str(tmp_path / "truth.csv")
    assert main(["recognise", str(top), str(scenes), "--truth", truth, "-o", str(tmp_path / "out")]) == 1
    assert what in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_command_names_a_mask_of_another_size_and_folders_without_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    top, scenes = saved(tmp_path)
    save(top / "rose_mask.png", np.ones((40, 40)))
    assert main(["recognise", str(top), str(scenes), "-o", str(tmp_path / "out")]) == 1
    assert "rose.png: is 140x124, its mask is not" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    for arguments in ((str(tmp_path / "empty"), str(scenes)), (str(top), str(tmp_path / "empty"))):
        assert main(["recognise", *arguments, "-o", str(tmp_path / "out")]) == 1
        assert "pictures" in capsys.readouterr().err


# ---- real pictures


def test_a_sugar_box_is_found_among_other_things(real_data: Callable[[str], Path]) -> None:
    """Two views of the box and of a mustard bottle; a scene with the box only, partly behind others."""
    top = real_data("objects")

    def model(name: str, views: tuple[str, ...]) -> pf.ObjectModel:
        folder = top / name / "models"
        return pf.ObjectModel(
            name,
            [
                tuple(np.asarray(Image.open(folder / f"{v}_{kind}.png").convert("L")) for kind in ("color", "mask"))
                for v in views
            ],
        )

    objects = [
        model("004_sugar_box", ("view_30_005", "view_0_006")),
        model("006_mustard_bottle", ("view_0_006", "view_0_001")),
    ]
    picture = np.asarray(Image.open(top / "004_sugar_box/test_images/4_0058_001715-color.jpg").convert("L"))
    box, bottle = pf.recognise(objects, [picture])
    assert box.present and box.score > 0.2
    assert not bottle.present
    truth = np.zeros((480, 640), bool)
    truth[172:446, 366:504] = True
    x0, y0, x1, y1 = map(int, box.box())
    around = np.zeros_like(truth)
    around[y0 : y1 + 1, x0 : x1 + 1] = True
    assert iou(around, truth) > 0.5
