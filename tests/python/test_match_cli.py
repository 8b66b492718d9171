"""`pipefish match` from files to files, and photographs whose truth is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pipefish as pf
from fountain import figures
from pipefish.cli import main
from pipefish.matching_files import read_grey
from test_match import Floats, H, W, affine, grown_from_anything, pair


def saved(tmp_path: Path) -> tuple[Path, Path]:
    paths = tmp_path / "a.png", tmp_path / "b.png"
    for path, image in zip(paths, pair(affine(np.array([[0.9, -0.2], [0.25, 1.0]]))[1]), strict=True):
        Image.fromarray((255 * image).astype(np.uint8)).save(path)
    return paths


def test_the_command_writes_matches_pictures_and_statistics(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    one, two = saved(tmp_path)
    out = tmp_path / "out"
    assert main(["match", str(one), str(two), "-o", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    packed = np.load(out / "matches.npz")
    rows = np.loadtxt(out / "matches.csv", delimiter=",", skiprows=1)
    assert document["matches"] == len(rows) == len(packed["xy1"]) > 5000
    assert np.abs(rows[:, 2:4] - packed["xy2"]).max() < 1e-3
    assert Image.open(out / "matches.png").size == (2 * W + 4, H)
    warped = np.asarray(Image.open(out / "warped.png")).astype(int)
    x, y = packed["xy1"].astype(int).T
    assert np.abs(warped[y, x, 0] - warped[y, x, 1]).mean() < 6  # noise of both, and the interpolation
    assert json.loads((out / "statistics.json").read_text())["status"] == "ok"


def test_the_command_leaves_out_islands_unless_told_not_to(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The second picture shows the first with a patch of 14 x 14 pixels moved elsewhere."""
    one, _ = pair(affine(np.eye(2))[1])
    two = one.copy()
    two[63:77, 123:137] = one[23:37, 33:47]
    seeds = tmp_path / "seeds.csv"
    seeds.write_text("x1,y1,x2,y2\n40,30,130,70\n100,100,100,100\n")
    for name, image in (("a.png", one), ("b.png", two)):
        Image.fromarray((255 * image).astype(np.uint8)).save(tmp_path / name)
    counts = {}
    for more in ((), ("--filter", "none")):
        arguments = ["match", str(tmp_path / "a.png"), str(tmp_path / "b.png"), "-o", str(tmp_path / "out")]
        assert main([*arguments, "--seeds", str(seeds), "--json", *more]) == 0
        capsys.readouterr()
        found = np.load(tmp_path / "out/matches.npz")
        moved = np.abs(found["xy1"] - found["xy2"]).max(axis=1) > 5
        counts[more] = moved.sum(), (~moved).sum()
    (island, kept), (with_island, all_of_it) = counts.values()
    assert island == 0 and with_island > 0
    assert kept >= 0.95 * all_of_it
    assert main([*arguments, "--filter", "none", "--filter", "plane"]) == 1
    assert "--filter: none" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "content", "option", "what"),
    [
        ("b.png", b"not a picture", None, "b.png: not a picture"),
        ("seeds.csv", b"x1,y1,x2,y2\n1,2,3\n", "--seeds", "seeds.csv: line 2: 3 numbers"),
        ("seeds.csv", b"x1,y1,x2,y2\n", "--seeds", "seeds.csv: no seeds"),
        ("pose.txt", b"1 2 3", "--pose", "--profile and --pose"),
    ],
)
def test_the_command_names_a_bad_file(
    name: str, content: bytes, option: str | None, what: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    one, two = saved(tmp_path)
    (tmp_path / name).write_bytes(content)
    extra = [option, str(tmp_path / name)] if option else []
    assert main(["match", str(one), str(two), "-o", str(tmp_path / "out"), *extra]) == 1
    assert what in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_deep_pictures_keep_their_values(tmp_path: Path) -> None:
    """Pillow alone would clip values of 16 bits, and those of floats, to eight."""
    value = np.linspace(0.1, 0.9, 64 * 64).reshape(64, 64)
    for kind, given in (("i", np.rint(65535 * value).astype(np.int32)), ("f", value.astype(np.float32))):
        Image.fromarray(given).save(tmp_path / f"{kind}.tif")
        assert np.abs(read_grey(tmp_path / f"{kind}.tif") - value).max() < 1e-4
    for given in (np.full((64, 64), 70_000, np.int32), np.full((64, 64), 255, np.float32)):
        Image.fromarray(given).save(tmp_path / "wrong.tif")
        with pytest.raises(pf.FormatError, match=r"wrong.tif: (values of 70000|picture: floating-point)"):
            read_grey(tmp_path / "wrong.tif")


# ---- real pictures


def homography(path: Path) -> Floats:
    text = path.read_text()
    return np.array(text[text.index("<data>") + 6 : text.index("</data>")].split(), float).reshape(3, 3)


def test_a_wall_seen_from_40_degrees_aside(real_data: Callable[[str], Path]) -> None:
    """graf 1-3. Its homography is that of the wall; what lies below the kerb is another plane."""
    folder = real_data("homography/graf")
    one, two = (np.asarray(Image.open(folder / f"img{k}.png").convert("L")) for k in (1, 3))
    h = homography(folder / "H1to3p.xml")
    m = pf.match_quasi_dense(one, two)
    wall = m.xy1[:, 1] < 530 - 30 * m.xy1[:, 0] / 800
    p = np.c_[m.xy1, np.ones(len(m))] @ h.T
    e = np.linalg.norm(p[:, :2] / p[:, 2:] - m.xy2, axis=1)
    assert wall.sum() >= 150_000
    assert np.mean(e[wall] < 3) >= 0.93
    kept = pf.filter_matches(m, geometry="rigid")  # what the command does unless told otherwise
    p = np.c_[kept.xy1, np.ones(len(kept))] @ h.T
    assert len(kept) >= 150_000
    assert np.mean(np.linalg.norm(p[:, :2] / p[:, 2:] - kept.xy2, axis=1) < 3) >= 0.9  # of all of them


@pytest.mark.parametrize(("radius", "most"), [(5, 0.001), (3, 0.01)])
def test_wrong_seeds_do_not_grow_over_unrelated_photographs(
    radius: int, most: float, real_data: Callable[[str], Path]
) -> None:
    """A painted wall and one of bricks; seeds are fitted to each other first, which makes wrong ones look right."""
    one, two = (read_grey(real_data(f"homography/{name}/img1.png")) for name in ("graf", "wall"))
    tried, grown = grown_from_anything(one, two, radius, fitted=True)
    assert tried > 1000 and grown <= most * one.size


def test_photographs_with_known_motion_match_on_their_epipolar_lines(real_data: Callable[[str], Path]) -> None:
    """fountain-P11, pictures 5 and 6: 95 % within 2 pixels of the true line, and 70 % of the textured pixels that both
    photographs show; fountain.py says which those are."""
    (pair_,) = figures(real_data("multiview/fountain-P11"), (768, 512), (5, 6))
    assert pair_["shared"] > 0.5
    assert pair_["within_2px"] >= 0.95 and pair_["coverage"] >= 0.7
