"""match.narrow and match.graf13: seconds of quasi-dense matching, matches and their accuracy, beside OpenCV's.

The rival is cv2.stereo.QuasiDenseStereo of opencv-contrib, which Debian's Python has. Processor time of the whole
process, one thread on either side, seeds included, least of two runs in turns. graf 1-3's truth is a homography, that
of the wall: only matches on the wall are judged (above the kerb, for both sides alike); all are counted in
match.graf13_matches. In match.graf13_filtered*, the filters that `pipefish match` runs unless told otherwise have been
applied, their time included, and all that are left are judged.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from peers import PEERS, ROOT

Truth = Callable[[np.ndarray, np.ndarray], np.ndarray]
ROUNDS = 2


def texture(height: int, width: int) -> np.ndarray:
    """Twice oversampled noise of all sizes from two pixels up, (2 height, 2 width) of 0..255."""
    from PIL import Image

    rng = np.random.default_rng(7)
    out = np.zeros((2 * height, 2 * width), np.float32)
    for size in (2, 4, 8, 16, 32, 64):
        noise = rng.normal(0, 1, (2 * height // (2 * size) + 2, 2 * width // (2 * size) + 2)).astype(np.float32)
        out += size**0.3 * np.asarray(Image.fromarray(noise).resize(out.shape[::-1], Image.Resampling.BICUBIC))
    return 127 + 40 * out / out.std()


def narrow() -> tuple[np.ndarray, np.ndarray, Truth]:
    """1280 x 960, disparities of 10 to 60 pixels that vary smoothly, noise of 2 grey levels."""
    width, height = 1280, 960
    t = texture(height, width + 100)
    y, x = np.mgrid[:height, :width].astype(np.float32)

    def disparity(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 35 + 15 * np.sin(x / 170) + 10 * np.cos(y / 120 + x / 400)

    def sampled(u: np.ndarray) -> np.ndarray:
        i = (2 * u).astype(int)
        f = 2 * u - i
        rows = (2 * y).astype(int)
        return t[rows, i] * (1 - f) + t[rows, i + 1] * f

    rng = np.random.default_rng(8)
    pictures = [np.rint(sampled(u) + rng.normal(0, 2, x.shape)).clip(0, 255) for u in (x, x + disparity(x, y))]

    def error(xy1: np.ndarray, xy2: np.ndarray) -> np.ndarray:
        return np.hypot(xy1[:, 0] - xy2[:, 0] - disparity(xy2[:, 0], xy2[:, 1]), xy1[:, 1] - xy2[:, 1])

    return pictures[0].astype(np.uint8), pictures[1].astype(np.uint8), error


def graf13() -> tuple[np.ndarray, np.ndarray, Truth] | None:
    """The Oxford pair where it is; errors are NaN off the wall."""
    from PIL import Image

    folder = Path(os.environ.get("PIPEFISH_DATA") or ROOT.parent / "shared" / "data") / "homography" / "graf"
    if not folder.exists():
        print("graf is not here: match.graf13 is not measured; set PIPEFISH_DATA", file=sys.stderr)
        return None
    one, two = (np.asarray(Image.open(folder / f"img{k}.png").convert("L")) for k in (1, 3))
    text = (folder / "H1to3p.xml").read_text()
    h = np.array(text[text.index("<data>") + 6 : text.index("</data>")].split(), float).reshape(3, 3)

    def error(xy1: np.ndarray, xy2: np.ndarray, everywhere: bool = False) -> np.ndarray:
        p = np.c_[xy1, np.ones(len(xy1))] @ h.T
        off = np.linalg.norm(p[:, :2] / p[:, 2:] - xy2, axis=1)
        return np.where(everywhere | (xy1[:, 1] < 530 - 30 * xy1[:, 0] / 800), off, np.nan)

    return one, two, error


def ours(one: np.ndarray, two: np.ndarray, mode: str, filtered: bool = False) -> tuple[float, np.ndarray, np.ndarray]:
    """Seconds and matches; filtered: as `pipefish match` does unless told otherwise."""
    from pipefish.matching import match_quasi_dense
    from pipefish.matching_filters import filter_matches

    start = time.process_time()
    m = match_quasi_dense(one, two, mode=mode)
    if filtered:
        m = filter_matches(m, geometry="rigid")
    return time.process_time() - start, m.xy1, m.xy2


def figures(name: str, got: tuple, peer: tuple | None, error: Truth, bound: float) -> list[dict]:
    """Seconds, matches and the share of those judged that are within `bound` pixels."""
    out = []
    values = []
    for side in (got, peer):
        if side is not None:
            e = error(side[1], side[2])
            e = e[np.isfinite(e)]
            values.append((side[0], len(side[1]), float(np.mean(e < bound)) if len(e) else 0.0))
    for k, (suffix, unit) in enumerate((("", "s"), ("_matches", "matches"), (f"_within_{bound:g}px", "share"))):
        figure = {"name": f"match.{name}{suffix}", "value": values[0][k], "unit": unit}
        if peer is not None:
            figure |= {"peer": "cv2.stereo.QuasiDenseStereo", "peer_value": values[1][k]}
        out.append(figure)
    return out


def measure() -> list[dict]:
    """All of it; a line on stderr for a rival that is not here."""
    pairs = {"narrow": (*narrow(), "translation", 1.0)}
    wide = graf13()
    if wide is not None:
        pairs["graf13"] = (*wide, "adaptive", 3.0)
    python = PEERS["debian"]
    has_rival = [python, "-c", "import cv2; cv2.stereo.QuasiDenseStereo_create"]
    rival = python.exists() and subprocess.run(has_rival, capture_output=True, check=False).returncode == 0
    if not rival:
        print(f"{python} has no cv2.stereo: not compared", file=sys.stderr)
    mine: dict[str, tuple] = {}
    theirs: dict[str, tuple] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (one, two, *_) in pairs.items():
            np.savez(Path(folder) / f"{name}.npz", one=one, two=two)
        for _ in range(ROUNDS):  # in turns
            for name, (one, two, _, mode, _) in pairs.items():
                mine[name] = min(mine.get(name, (np.inf,)), ours(one, two, mode), key=lambda side: side[0])
            if not rival:
                continue
            for old in Path(folder).glob("*.peer.npz"):
                old.unlink()
            subprocess.run([python, Path(__file__).with_name("match_peers.py"), folder], check=True)
            for name in pairs:
                with np.load(Path(folder) / f"{name}.peer.npz") as p:
                    side = (float(p["seconds"]), p["xy1"], p["xy2"])
                theirs[name] = min(theirs.get(name, (np.inf,)), side, key=lambda side: side[0])
    filtered = []
    if wide is not None:
        one, two, error = wide
        got = min((ours(one, two, "adaptive", filtered=True) for _ in range(ROUNDS)), key=lambda side: side[0])
        filtered = figures("graf13_filtered", got, None, lambda a, b: error(a, b, everywhere=True), 3.0)
    return filtered + [
        figure
        for name, (_, _, error, _, bound) in pairs.items()
        for figure in figures(name, mine[name], theirs.get(name), error, bound)
    ]
