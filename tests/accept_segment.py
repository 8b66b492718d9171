"""Motion segmentation over random scenes with known truth, the simulator's and real pairs; resumable.

    python tests/accept_segment.py [--only patches,none,covered,sizes,simulator,real] [--setups 10] [--pictures FOLDER]

prints what was measured, then one JSON list of {name, value, bound, holds}. Results of scenes are kept in
build/accept_segment/, one line each, and taken from there while product and script are the same. FOLDER gets the
pictures of the real pairs and the simulator's. Real data: in PIPEFISH_DATA or ../shared/data.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "python"))

from accept_rows import Row, at_least, at_most, kept_series, print_rows  # noqa: E402

import pipefish as pf  # noqa: E402
from pipefish.segmentation import planes  # noqa: E402
from pipefish.segmentation_files import draw_overview  # noqa: E402
from segment_scenes import (  # noqa: E402
    boundary_score,
    flow_errors,
    gain_rms,
    label_agreement,
    make_pair,
    overlap,
    paired,
    points_in_layers,
    round_trips,
)

KEEP = ROOT / "build" / "accept_segment"
DATA = Path(os.environ.get("PIPEFISH_DATA") or ROOT.parent / "shared" / "data") / "motion"
REAL = ("book", "breadcube", "cubetoy")
# What moved, drawn by hand in picture 1 of the real pairs to about 2 pixels, in the order of the labels of the points.
# Breadcube's also in picture 2: 17 of its 77 wrong pairs have both points within one outline, so by labels alone a
# faultless cut-out has 0.22.
OUTLINES = {
    "book": ("151,153 381,157 377,233 414,260 411,305 364,325 162,422 96,302 63,300 58,287 50,254 52,247",),
    "breadcube": (
        "242,217 262,219 290,232 315,250 330,272 339,305 328,320 302,348 275,370 247,393 217,412 197,414 "
        "169,406 144,393 126,368 118,348 116,325 123,297 141,282 161,267 181,252 204,233 222,221",
        "467,161 593,223 573,350 475,423 360,351 360,223",
    ),
    "cubetoy": (
        "266,110 371,166 370,276 272,353 175,283 157,175",
        "391,265 392,249 401,229 418,209 438,196 464,186 491,183 519,186 542,199 554,219 557,237 544,249 "
        "542,276 543,297 537,312 554,339 572,339 576,378 567,381 562,396 426,419 421,407 398,408 396,398 "
        "406,368 403,343 380,343 375,337 386,302 396,287 428,282 411,267 398,270",
    ),
}
SCALES = (0.4, 0.63, 1.6, 2.5)
SIZE = {"width": 480, "height": 360}


def rises(s: pf.Segmentation) -> float:
    """The largest rise of the energy from a step to the next, as a share of it."""
    energy = np.array([step[1] for step in s.trace])
    return float(max(0, (np.diff(energy) / np.maximum(1, np.abs(energy[1:]))).max(initial=0)))


def judged(s: pf.Segmentation, labels: tuple[np.ndarray, np.ndarray]) -> tuple[Row, dict[int, int]]:
    """What can be told by labels alone."""
    names = paired(s.labels1, labels[0])
    return {
        "layers": len(s.layers),
        "overlap1": overlap(s.labels1, labels[0], names),
        "overlap2": overlap(s.labels2, labels[1], names),
        "boundary": min(boundary_score(s.labels1, labels[0]), boundary_score(s.labels2, labels[1])),
        "rise": rises(s),
    }, names


def over_scenes(
    name: str, values: list[float], judge: Callable[[str, float, float], Row], bound: float
) -> Iterator[Row]:
    """A figure's median, and the share of scenes that hold by themselves: nine of ten have to. The worst is told."""
    holding = [judge(name, v, bound)["holds"] for v in values]
    worst = min(values) if judge is at_least else max(values)
    print(f"  {name}: worst {worst:.4g}, mean {np.mean(values):.4g}", file=sys.stderr)
    yield judge(f"{name}_median", np.median(values), bound)
    yield at_least(f"{name}_share_that_holds", np.mean(holding), 0.9)


def patches(seed: int) -> Row:
    """Two patches, bent and relit: also pictures exchanged, and light held fast over each layer."""
    pair = make_pair(1000 + seed, **SIZE)
    m = pf.match_quasi_dense(*pair.images)
    s = pf.segment_motion(*pair.images, m)
    row, names = judged(s, pair.labels)
    if all(names.values()):
        errors = flow_errors(s, pair, names)
        row |= {"epe": float(np.median(errors)), "epe95": float(np.quantile(errors, 0.95))}
        row |= {"gain": gain_rms(s, pair, names), "back": float((round_trips(s) <= 1).mean())}
    back = pf.segment_motion(*pair.images[::-1])
    held = pf.segment_motion(*pair.images, m, light=1e6)
    row["exchanged"] = min(label_agreement(s.labels1, back.labels2), label_agreement(s.labels2, back.labels1))
    row["held"] = overlap(held.labels1, pair.labels[0], paired(held.labels1, pair.labels[0]))
    return row


def check_patches(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "patches", count, patches)
    yield at_least("segment.layers_right", np.mean([r["layers"] == 2 for r in rows]), 0.9)
    overlaps = [min(r["overlap1"], r["overlap2"]) for r in rows]
    lost = [r["overlap1"] - r["held"] for r in rows]
    yield from over_scenes("segment.overlap", overlaps, at_least, 0.92)
    yield from over_scenes("segment.flow_px", [r.get("epe", 99) for r in rows], at_most, 0.5)
    yield from over_scenes("segment.flow_p95_px", [r.get("epe95", 99) for r in rows], at_most, 2)
    yield from over_scenes("segment.gain_rms", [r.get("gain", 9) for r in rows], at_most, 0.05)
    yield from over_scenes("segment.round_trip_1px", [r.get("back", 0) for r in rows], at_least, 0.95)
    yield from over_scenes("segment.exchanged", [r["exchanged"] for r in rows], at_least, 0.97)
    yield from over_scenes("segment.overlap_lost_without_light", lost, at_least, 0.05)
    yield at_most("segment.energy_rise", max(r["rise"] for r in rows), 1e-6)


def nothing(seed: int) -> Row:
    """Pictures with nothing in common."""
    s = pf.segment_motion(*make_pair(2000 + seed, **SIZE, patches=0).images)
    return {"layers": len(s.layers), "share": float(max((s.labels1 > 0).mean(), (s.labels2 > 0).mean()))}


def check_none(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "none", count, nothing)
    yield at_most("segment.nothing_in_common_share", max(r["share"] for r in rows), 0.01)
    yield at_most("segment.nothing_in_common_layers", max(r["layers"] for r in rows), 0)


def covered(seed: int) -> Row:
    """One patch before the other in picture 2."""
    pair = make_pair(3000 + seed, **SIZE, covered=True)
    return judged(pf.segment_motion(*pair.images), pair.labels)[0]


def check_covered(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "covered", count, covered)
    yield from over_scenes("segment.covered_boundary", [r["boundary"] for r in rows], at_least, 0.8)


def sized(seed: int) -> Row:
    """Patches of another size in picture 2."""
    pair = make_pair(4000 + seed, **SIZE, scale=SCALES[seed % len(SCALES)])
    s = pf.segment_motion(*pair.images)
    row, names = judged(s, pair.labels)
    if all(names.values()):
        row["epe"] = float(np.median(flow_errors(s, pair, names)))
    return row


def check_sizes(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "sizes", max(count, len(SCALES)), sized)
    for k, scale in enumerate(SCALES):
        own = [min(r["overlap1"], r["overlap2"]) for r in rows if r["seed"] % len(SCALES) == k]
        yield at_least(f"segment.size_{scale}_overlap_least", min(own), 0.85)


def simulated(seed: int) -> Row:
    """The simulator's sheets: two or three, rigid, stretched and bent, relit, before an unrelated room."""
    made = pf.simulate_two_views(2 + seed % 2, background="unrelated", seed=seed + 1)
    start = time.process_time()
    s = pf.segment_motion(*made.images, threads=2)
    seconds = time.process_time() - start
    moved, visible, _ = made.flow(0)
    _, seen, _ = made.flow(1)
    labels = (np.where(visible, made.labels(0), 0), np.where(seen, made.labels(1), 0))
    row, names = judged(s, labels)
    errors = [
        np.hypot(*(s.layers[f - 1].flow1 - moved)[(labels[0] == k) & (s.labels1 == f)].T) for k, f in names.items() if f
    ]
    row |= {"sheets": 2 + seed % 2, "seconds": seconds, "found": sum(f > 0 for f in names.values())}
    row["epe"] = float(np.median(np.concatenate(errors))) if errors else 99.0
    shares = [
        ((s.labels1 == f) & (labels[0] == k)).sum() / ((s.labels1 == f) | (labels[0] == k)).sum()
        for k, f in names.items()
        if f
    ]
    row["overlap_mean"] = float(np.sum(shares) / len(names))
    picture(f"simulated_{seed}", made.images, s)
    return row


def check_simulator(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "simulator", count, simulated)
    yield at_least("segment.sim_sheets_found", sum(r["found"] for r in rows) / sum(r["sheets"] for r in rows), 0.9)
    # A mean: a scene may be burnt out to white, or show a sheet as a crescent too small for a group.
    overlaps = [r["overlap_mean"] for r in rows]
    held = sum(o >= 0.85 for o in overlaps)
    print(f"  simulator: overlap {held} of {len(rows)} at 0.85, worst {min(overlaps):.3f}", file=sys.stderr)
    yield at_least("segment.sim_overlap_mean", np.mean(overlaps), 0.85)
    yield from over_scenes("segment.sim_flow_px", [r["epe"] for r in rows], at_most, 0.5)


def within(outline: str) -> np.ndarray:
    """(480,640): the inside of an outline."""
    picture = Image.new("1", (640, 480))
    ImageDraw.Draw(picture).polygon([tuple(map(int, p.split(","))) for p in outline.split()], fill=1)
    return np.asarray(picture)


def real(seed: int) -> Row:
    """A pair of photographs with labelled points."""
    name = REAL[seed]
    images = [np.asarray(Image.open(DATA / name / f"{name}{k}.png").convert("RGB")) for k in (1, 2)]
    start, cpu, main = time.perf_counter(), time.process_time(), time.thread_time()
    s = pf.segment_motion(*images, threads=2)
    row = {"pair": name, "wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
    row["load"] = os.getloadavg()[0]
    row["main_s"] = time.thread_time() - main  # of the thread that also does what only one can
    found = points_in_layers(s, np.loadtxt(DATA / name / f"{name}.txt"))
    picture(name, images, s)
    row |= {"layers": len(s.layers), "back": float((round_trips(s) <= 1).mean()), "rise": rises(s)}
    row |= {key: float(found[key]) for key in ("outliers", "same_layer")}
    pairs = [(s.labels1 == m["layer"], within(o)) for m, o in zip(found["motions"], OUTLINES[name], strict=True)]
    row["overlap"] = [float((cut & drawn).sum() / (cut | drawn).sum()) for cut, drawn in pairs]
    return row | {key: [float(m[key]) for m in found["motions"]] for key in ("recall", "purity")}


def check_real(_: int) -> Iterator[Row]:
    if not DATA.is_dir():
        print(f"no {DATA}: the real pairs are left out", file=sys.stderr)
        return
    for r in kept_series(KEEP, "real", len(REAL), real):
        yield at_least(f"segment.{r['pair']}_purity", min(r["purity"]), 0.9)
        yield at_least(f"segment.{r['pair']}_recall", min(r["recall"]), 0.8)
        yield at_most(f"segment.{r['pair']}_outliers", r["outliers"], 0.15)
        least = 17 / 77 if r["pair"] == "breadcube" else 0.15  # of a faultless cut-out
        yield at_most(f"segment.{r['pair']}_outliers_by_labels_alone", r["same_layer"], least)
        yield at_least(f"segment.{r['pair']}_overlap_with_outline", min(r["overlap"]), 0.7)
        yield at_least(f"segment.{r['pair']}_round_trip_1px", r["back"], 0.95)
        yield at_most(f"segment.{r['pair']}_energy_rise", r["rise"], 1e-6)
        # Of all threads: on two idle cores the clock's time is no longer, since a thread works all the while.
        yield at_most(f"segment.{r['pair']}_processor_s", r["cpu_s"], 30)
        told = f"main thread {r['main_s']:.1f} s, by the clock {r['wall_s']:.1f} s beside what else ran"
        print(f"  {r['pair']}: {told} (load {r['load']:.1f})", file=sys.stderr)


PICTURES: list[Path] = []


def picture(name: str, images: list[np.ndarray] | tuple[np.ndarray, ...], s: pf.Segmentation) -> None:
    """Its picture, where pictures are wanted."""
    for folder in PICTURES:
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(draw_overview(*(planes(i, name) for i in images), s)).save(folder / f"{name}.png")


CHECKS: dict[str, Callable[[int], Iterator[Row]]] = {
    "patches": check_patches,
    "none": check_none,
    "covered": check_covered,
    "sizes": check_sizes,
    "simulator": check_simulator,
    "real": check_real,
}


def main() -> None:
    """What is asked for, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default=",".join(CHECKS), help="parts, separated by commas")
    parser.add_argument("--setups", type=int, default=10, help="scenes of each kind [10]")
    parser.add_argument("--pictures", type=Path, help="folder for pictures")
    args = parser.parse_args()
    PICTURES.extend([args.pictures] if args.pictures else [])
    rows = [row for name in args.only.split(",") for row in CHECKS[name](args.setups)]
    print_rows(rows)


if __name__ == "__main__":
    main()
