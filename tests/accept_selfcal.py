"""Self-calibration and the profile's health check over random set-ups, and on real data where they are; resumable.

    python tests/accept_selfcal.py [--only general,half,degenerate,real,health,rendered] [--setups 500]

prints a table, then one JSON list of {name, value, bound, holds}. Results of set-ups are kept in build/accept_selfcal/,
one line each, and taken from there while product and script are the same. Real data: in PIPEFISH_DATA or
../shared/data. `rendered` draws a video (340 MB, kept in build/accept/recon/knee) and plays it through pipefishd.
"""

import argparse
import itertools
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "python"))

from accept_recon_video import recorded  # noqa: E402
from accept_rows import Row, at_least, at_most, exactly, figure, kept_series, print_rows  # noqa: E402

from calib_data_sets import jy_stereo, ov_plane  # noqa: E402
from pipefish.camera import Camera  # noqa: E402
from pipefish.demo import find_programs, survey_over_the_line  # noqa: E402
from pipefish.health import BUDGET, FALSE_ALARM, WORDS  # noqa: E402
from pipefish.matching_files import read_grey  # noqa: E402
from pipefish.measure import measure  # noqa: E402
from pipefish.selfcal import self_calibrate  # noqa: E402
from pipefish.selfcal_input import COMMON_SIGMA, match_pictures  # noqa: E402
from pipefish.simcamera import calibrated  # noqa: E402
from pipefish.simulate import Scene  # noqa: E402
from pipefish.survey import Survey  # noqa: E402
from selfcal_drives import drifted, health_of  # noqa: E402
from selfcal_scenes import DEGENERATE, KINDS, bearing_error, make_setup  # noqa: E402
from test_reconstruct_cli import survey_of  # noqa: E402
from tube_tracks import tube_drive  # noqa: E402

KEEP = ROOT / "build" / "accept_selfcal"
DATA = Path(os.environ.get("PIPEFISH_DATA", ROOT.parent / "shared" / "data"))


def general(seed: int, noise: float | None = None) -> Row:
    """One set-up of general motion: half of them one pair, the others two or three."""
    pairs = (1, 2, 1, 3)[seed // 4 % 4]
    setup = make_setup(seed, KINDS[seed % 4], pairs=pairs, noise=noise)
    start = time.process_time()
    found = self_calibrate(setup.pairs, (setup.lens.width, setup.lens.height), threads=1)
    seconds = time.process_time() - start
    row: Row = {"kind": setup.kind, "pairs": pairs, "seconds": seconds, "status": found.status}
    if found.camera is not None:
        error = bearing_error(found.camera, setup.lens, found.radius)
        row |= {
            "error_deg": math.degrees(error) if math.isfinite(error) else 180.0,
            "sigmas": error / found.bearing_sigma if math.isfinite(error) else 1e3,
            "alpha_sigma": found.alpha_sigma,
            "agreeing": found.agreeing / found.refined,
        }
    return row


def degenerate(seed: int) -> Row:
    """One set-up that must be refused: one pair; in every fourth block of sixteen three, which change nothing (but of
    small patches, as three would cover more)."""
    case = DEGENERATE[seed // 4 % 4]
    pairs = 3 if seed // 16 % 4 == 3 and case != "low_coverage" else 1
    setup = make_setup(10_000 + seed, KINDS[seed % 4], case, pairs=pairs)
    found = self_calibrate(setup.pairs, (setup.lens.width, setup.lens.height), threads=1)
    return {"case": case, "kind": setup.kind, "status": found.status}


def check_general(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "general", count, general)
    good = [r for r in rows if r["status"] == "ok"]
    yield at_least("selfcal.within_3_sigma", sum(r["sigmas"] < 3 for r in good) / len(rows), 0.95)
    yield at_most("selfcal.one_pair_seconds", max(r["seconds"] for r in rows if r["pairs"] == 1), 3.0)


def check_half(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "half", count, lambda seed: general(seed, noise=0.5))
    for kind in KINDS:
        of = [r for r in rows if r["kind"] == kind]
        share = sum(r.get("error_deg", 180.0) < 0.5 for r in of) / len(of)
        print(f"  at 0.5 px, {kind}: {100 * share:.1f} % below 0.5 degrees", file=sys.stderr)
    for number in (1, 2, 3):
        of = [r for r in rows if r["pairs"] == number]
        share = sum(r.get("error_deg", 180.0) < 0.5 for r in of) / max(len(of), 1)
        print(f"  at 0.5 px, {number} pairs: {100 * share:.1f} % below 0.5 degrees", file=sys.stderr)
    yield at_least("selfcal.below_half_degree", sum(r.get("error_deg", 180.0) < 0.5 for r in rows) / len(rows), 0.9)


def check_degenerate(count: int) -> Iterator[Row]:
    rows = kept_series(KEEP, "degenerate", count, degenerate)
    yield figure(
        "selfcal.degenerate_misjudged",
        sum(r["status"] != r["case"] for r in rows),
        "= 0",
        all(r["status"] == r["case"] for r in rows),
    )


# ---------------------------------------------------------------------- real


def fountain() -> list[Row]:
    """All pairs and triples of the six pictures, by their own matches."""
    folder = DATA / "multiview" / "fountain-P11" / "images"
    names = sorted(folder.glob("*.jpg"))
    k = np.loadtxt(folder / "K.txt", usecols=range(3))[:3]
    true = Camera(
        width=3072, height=2048, f_u=k[0, 0], f_v=k[1, 1], c_u=k[0, 2], c_v=k[1, 2], radial="perspective", theta_max=0.9
    )
    file = KEEP / "fountain_matches.npz"
    KEEP.mkdir(parents=True, exist_ok=True)
    pairs = list(itertools.combinations(range(len(names)), 2))
    if not file.exists():
        pictures = [read_grey(name) for name in names]
        found = [np.hstack(match_pictures(pictures[a], pictures[b], threads=2)) for a, b in pairs]
        np.savez(file, **{f"{a}{b}": m for (a, b), m in zip(pairs, found, strict=True)})
    with np.load(file) as data:
        matches = {(a, b): data[f"{a}{b}"] for a, b in pairs}
    groups = [[p] for p in pairs] + [
        [(a, b), (a, c), (b, c)] for a, b, c in itertools.combinations(range(len(names)), 3)
    ]

    class Truth:
        width, height = 3072, 2048

        @staticmethod
        def rays(uv: np.ndarray) -> np.ndarray:
            return true.unproject(uv)[0]

    def one(number: int) -> Row:
        group = groups[number]
        mine = [(matches[p][:, :2], matches[p][:, 2:]) for p in group]
        found = self_calibrate(mine, (3072, 2048), sigma_least=COMMON_SIGMA, threads=1)
        row: Row = {"views": len(group), "status": found.status, "matches": sum(len(matches[p]) for p in group)}
        if found.camera is not None:
            row |= {
                "focal": found.camera.f_u / true.f_u - 1,
                "error_deg": math.degrees(bearing_error(found.camera, Truth, found.radius)),
                "bearing_sigma_deg": math.degrees(found.bearing_sigma),
                "focal_sigma": math.sqrt(found.camera.covariance[0, 0]) / found.camera.f_u,
            }
        return row

    return kept_series(KEEP, "fountain", len(groups), one)


def boards() -> list[Row]:
    """Corners of one plane board in two of its views; and the pictures' own matches, with the room behind the board by
    a camera that stands."""
    board, size = ov_plane(DATA / "calibration", "train")
    stereo, stereo_size = jy_stereo(DATA / "calibration", 1)
    cases = []
    for name, views, of in (("ov_plane", board, size), ("jy_stereo", stereo, stereo_size)):
        for a, b in itertools.pairwise(views):
            first = {tuple(np.round(p, 6)): k for k, p in enumerate(a.board_xyz)}
            common = [(first[key], k) for k, p in enumerate(b.board_xyz) if (key := tuple(np.round(p, 6))) in first]
            one, two = np.array(common, int).reshape(-1, 2).T
            cases.append((name, (a.pixels[one], b.pixels[two]), of))

    def one_case(number: int) -> Row:
        name, pair, of = cases[number]
        found = self_calibrate([pair], of, threads=1)
        return {"name": name, "status": found.status, "pair": found.pairs[0].status, "matches": len(pair[0])}

    rows = kept_series(KEEP, "boards", len(cases), one_case)
    files = sorted((DATA / "calibration/jy_stereo/left").glob("*.jpg"))[:5]
    if len(files) == 5:

        def standing(number: int) -> Row:
            one, two = (read_grey(files[number + k]) for k in (0, 1))
            pair = match_pictures(one, two, threads=1)
            found = self_calibrate([pair], one.shape[::-1], sigma_least=COMMON_SIGMA, threads=1)
            return {"name": "static", "status": found.status, "pair": found.pairs[0].status, "matches": len(pair[0])}

        rows += kept_series(KEEP, "static", 4, standing)
    return rows


#: Pairs of ov_plane between which the camera turned about itself: by its calibration it moved by 0.00 and 0.03 of the
#: distance to the board, by 0.06 to 0.24 in all others.
OV_PLANE_TURNED = (10, 14)


def rightly_refused(row: Row) -> bool:
    """A plane seen without a tilt is told by the tilt that is missing, a small one by what it covers."""
    if row["name"] == "static":
        return row["status"] == "standing"
    if row["status"] == "turning":
        return row["name"] == "ov_plane" and row["seed"] in OV_PLANE_TURNED
    plane = row["status"] in ("planar", "no_rotation", "axial") and row["pair"] == "plane"
    return plane or row["status"] == "low_coverage"


FOCAL, BEARING_DEG = 0.03, 0.5  # largest errors of focal length, relative, and of a bearing


def meets(row: Row) -> bool:
    """The bar of a pair or triple of fountain-P11."""
    return abs(row["focal"]) < FOCAL and row["error_deg"] < BEARING_DEG


def check_real() -> Iterator[Row]:
    if not (DATA / "multiview" / "fountain-P11").is_dir():
        print(f"skipped: {DATA} has no multiview/fountain-P11", file=sys.stderr)
        return
    rows = [r for r in fountain() if r["status"] == "ok"]
    # Usable by what each says of itself: its own sigmas below the bars.
    usable = [r for r in rows if r["focal_sigma"] < FOCAL and r["bearing_sigma_deg"] < BEARING_DEG]
    for name, of in (("usable", usable), ("all", rows)):
        for views in (1, 3):
            mine = [r for r in of if r["views"] == views]
            met = sum(map(meets, mine))
            print(f"  fountain-P11, {name}, {views} pairs: {met} of {len(mine)} meet the bar", file=sys.stderr)
    yield at_least("selfcal.fountain_good", sum(map(meets, usable)) / max(len(usable), 1), 0.8)
    rest = [r for r in rows if not (r in usable and meets(r))]
    honest = sum(r["error_deg"] < 3 * r["bearing_sigma_deg"] for r in rest)
    refused = boards()
    for row in refused:
        print(f"  {row['name']}: {row['matches']} matches, {row['status']}", file=sys.stderr)
    wrong = [r for r in refused if not rightly_refused(r)]
    yield exactly("selfcal.boards_misjudged", float(len(wrong)), 0.0)
    yield figure("selfcal.fountain_rest_dishonest", len(rest) - honest, "= 0", honest == len(rest))


# ---------------------------------------------------------------------- health


# Half of the tracks for changes: they must show all the same. Intact drives have all of them: noise hides a bias.
FEWER = {"density": 300.0}


def most_likely(count: int, of: int) -> float:
    """The largest share of which `count` of `of` or fewer come in a twentieth of all cases (Clopper and Pearson)."""
    low, high = 0.0, 1.0
    for _ in range(50):
        share = (low + high) / 2
        tail = sum(math.comb(of, k) * share**k * (1 - share) ** (of - k) for k in range(count + 1))
        low, high = (share, high) if tail > 0.05 else (low, share)
    return high


def check_changes(case: str, count: int) -> Iterator[Row]:
    """Changed profiles are told, by the right name and size."""
    for change, (name, true) in {"scale": ("angle scale", -1.0), "centre": ("centre u", -3.0)}.items():
        rows = kept_series(KEEP, f"health_{case}_{change}", count, lambda s, x=change: health_of(s, case, x, **FEWER))
        share = sum(r["verdict"].startswith("drifted") for r in rows) / len(rows)
        yield at_least(f"health.{case}_{change}_detected", share, 0.95)
        named = sum(f"{WORDS[name]} changed by" in r["text"] for r in rows) / len(rows)
        yield at_least(f"health.{case}_{change}_named", named, 0.95)
        off = [abs(r["changes"][name][0] - true) / r["changes"][name][1] for r in rows]
        yield at_least(f"health.{case}_{change}_within_3_sigma", sum(o < 3 for o in off) / len(rows), 0.95)


def check_health(count: int, intact: int) -> Iterator[Row]:
    for case in ("bend", "radius", "axial"):
        yield from check_changes(case, count)
        rows = kept_series(KEEP, f"health_{case}_none", intact, lambda s, c=case: health_of(s, c, ""))
        alarms = sum(r["verdict"].startswith("drifted") for r in rows)
        valid = sum(r["verdict"].endswith("valid") for r in rows)
        print(f"  health, {case}: {alarms} alarms, {valid} called valid, of {len(rows)} intact", file=sys.stderr)
        yield at_most(f"health.{case}_false_alarms", alarms / len(rows), 0.02)
        yield at_most(f"health.{case}_false_alarms_at_95_percent", most_likely(alarms, len(rows)), 0.02)
    changes = ("", "scale", "alpha")
    rows = kept_series(KEEP, "health_straight", 100, lambda s: health_of(s, "straight", changes[s % 3], **FEWER))
    certain = sum(r["verdict"] != "cannot tell" for r in rows)
    yield figure("health.straight_not_cannot_tell", certain, "= 0", certain == 0)
    yield from check_long()
    yield from check_alpha()


LONG = ((5, 60.0), (6, 60.0), (7, 60.0), (77, 100.0))  # seeds and metres


def check_long() -> Iterator[Row]:
    """Intact drives so long that a sigma hides no bias, as `measure` judges them: 0.3 px, swaying, diameter unknown."""

    def one(number: int) -> Row:
        seed, length = LONG[number]
        with tempfile.TemporaryDirectory() as folder:
            file = survey_of(tube_drive(seed, length), Path(folder) / "long.mcap")
            health = measure(Survey.open(file), pictures=False, threads=1).health
        assert health is not None
        return health.as_dict()

    rows = kept_series(KEEP, "health_long", len(LONG), one)
    for (seed, length), row in zip(LONG, rows, strict=True):
        yield at_least(f"health.intact_{length:.0f}_m_seed_{seed}_probability", row["probability"], FALSE_ALARM)


ALPHA = (*(("bend", length) for length in (1.0, 2.0, 5.0)), ("radius", 5.0))  # what tells alpha, and for how long


def check_alpha() -> Iterator[Row]:
    """sigma(alpha), per cent of the diameter, by length and noise: less where there is more to see, and where it is
    above the budget the answer is "cannot tell"."""
    noises = (0.1, 0.3, 1.0)
    cases = [(case, length, noise) for case, length in ALPHA for noise in noises]

    def one(number: int) -> Row:
        case, length, noise = cases[number]
        return health_of(1, case, "", length=length, sigma=noise, density=480.0)

    rows = kept_series(KEEP, "health_alpha", len(cases), one)
    found = {case: row["alpha_sigma"] for case, row in zip(cases, rows, strict=True)}
    for (case, length, noise), row in zip(cases, rows, strict=True):
        sigma = row["alpha_sigma"]
        honest = (row["verdict"] == "cannot tell") == (sigma > BUDGET)
        for other in cases:  # more to see
            if other[0] == case and other[1] >= length and other[2] <= noise:
                honest &= found[other] < 1.02 * sigma
        yield figure(
            f"health.alpha_sigma_percent_{case}_{length:.0f}_m_{noise:.1f}_px",
            100 * sigma,
            "cannot tell above 0.5",
            honest,
        )
    yield at_most("health.alpha_sigma_percent_bend_5_m_0.3_px_bound", 100 * found["bend", 5.0, 0.3], 100 * BUDGET)


# A DN300 with a bend of 90 degrees, concrete; 0.3 m/s, 15 mm a frame.
KNEE = {
    "diameter": 0.3,
    "pieces": [{"length": 2.0}, {"angle": math.pi / 2, "radius": 0.9, "clock": 0.6}, {"length": 2.4}],
    "texture": {"seed": 53},
    "sensor": {"seed": 53, "exposure_s": 0.001},
    "motion": {"seed": 53, "frames": 330, "speed": 0.3},
    "telemetry": {"seed": 53},
}
CHANGES = ("", "scale", "centre")


def rendered(number: int) -> Row:
    """A drawn survey through pipefishd, by a profile from a board that is right or changed since; diameter unknown."""
    recording = recorded("knee", KNEE)
    recording.profile = recording.video.with_name("profile.json")
    drifted(calibrated(Scene.from_truth(recording.truth)), CHANGES[number]).save(recording.profile)
    run = recording.video.with_name("run")
    survey = survey_over_the_line(find_programs(None), recording, run, True)
    health = measure(Survey.open(Path(survey["file"]))).health
    assert health is not None
    return {"change": CHANGES[number], **health.as_dict()}


def check_rendered() -> Iterator[Row]:
    right, *changed = kept_series(KEEP, "rendered", len(CHANGES), rendered)
    for row in (right, *changed):
        print(f"  rendered, {row['change'] or 'right'}: {row['text']}", file=sys.stderr)
    yield exactly("health.rendered_right_called_valid", float(right["verdict"].endswith("valid")), 1.0)
    for row, (name, true) in zip(changed, (("angle scale", -1.0), ("centre u", -3.0)), strict=True):
        off = abs(row["changes"][name]["value"] - true) / row["changes"][name]["sigma"]
        yield at_most(f"health.rendered_{row['change']}_off_sigmas", off, 3.0)
    yield exactly("health.rendered_drifts_found", sum(r["verdict"].startswith("drifted") for r in changed), 2)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--setups", type=int, default=500)
    parser.add_argument("--half", type=int, default=200)
    parser.add_argument("--degenerate", type=int, default=200)
    parser.add_argument("--health", type=int, default=60, help="changed profiles of each kind")
    parser.add_argument("--intact", type=int, default=150, help="none of so many called drifted shows 2 %%")
    parser.add_argument("--only", default="general,half,degenerate,real,health,rendered")
    args = parser.parse_args()
    checks: dict[str, Callable[[], Iterator[Row]]] = {
        "general": lambda: check_general(args.setups),
        "half": lambda: check_half(args.half),
        "degenerate": lambda: check_degenerate(args.degenerate),
        "real": check_real,
        "health": lambda: check_health(args.health, args.intact),
        "rendered": check_rendered,
    }
    rows = [row for name in args.only.split(",") for row in checks[name]()]
    print_rows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
