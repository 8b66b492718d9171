"""The command `pipefish match`."""

from __future__ import annotations

import argparse
from typing import Any

from pipefish.cli import Result, add_command, positive, table
from pipefish.errors import ArgumentError

FILTERS = ("consistent", "rigid", "both-ways", "plane", "motion", "unique", "none")
MODES = ("adaptive", "constant", "translation")  # matching.MODES, whose import costs time here


def run_match(args: argparse.Namespace) -> Result:
    """Matches two pictures and writes what was found."""
    from pipefish.camera import Camera
    from pipefish.matching import match_quasi_dense
    from pipefish.matching_files import read_grey, read_pose, read_seeds, statistics, write_matches
    from pipefish.matching_filters import filter_matches, match_back, match_rivals

    if bool(args.profile) != bool(args.pose):
        raise ArgumentError("--profile and --pose: the epipolar geometry needs both")
    one, two = read_grey(args.first), read_grey(args.second)
    cameras = tuple(Camera.load(path) for path in args.profile) if args.profile else None
    if cameras and len(cameras) > 2:
        raise ArgumentError(f"--profile: {len(cameras)} profiles for two pictures")
    pinhole = all(camera.radial == "perspective" for camera in cameras or ())
    filters = set(args.filter or (["consistent", "rigid"] if pinhole else ["consistent"]))
    geometries = [name for name in ("plane", "motion", "rigid") if name in filters]
    if len(geometries) > 1:
        raise ArgumentError(f"--filter: {' or '.join(geometries)}, not both")
    if geometries and not pinhole:
        raise ArgumentError("--filter: plane, motion and rigid are of pinhole pictures, the --profile is of none")
    if "none" in filters and len(filters) > 1:
        raise ArgumentError("--filter: none, or others, not both")
    options = {"mode": args.mode, "zncc_min": args.zncc, "threads": args.threads}
    pair = cameras[0] if cameras and len(cameras) == 1 else cameras
    geometry = pair, read_pose(args.pose) if args.pose else None
    m = match_quasi_dense(one, two, read_seeds(args.seeds) if args.seeds else None, *geometry, **options)
    grown = len(m)
    if filters != {"none"}:
        m = filter_matches(
            m,
            least=None if "consistent" in filters else 0,
            back=match_back(one, two, m, *geometry, **options) if "both-ways" in filters else None,
            rivals=match_rivals(one, two, m, *geometry, threads=args.threads) if "unique" in filters else None,
        )
    consistent = len(m)
    if geometries:
        m = filter_matches(m, least=0, geometry=geometries[0])
    files = write_matches(args.output, one, two, m)
    document = statistics(m) | {"files": files}
    doubts = {
        "no seeds": "no region of one picture is found in the other: they may have nothing in common",
        "no growth": "no seed grew to 200 matches: the pictures may have nothing in common, these may all be wrong",
    }
    rows: list[tuple[str, object]] = [
        ("matches", f"{len(m)}, {100 * document['share_of_image1']:.1f} % of {args.first}"),
        *([("filtered", f"{grown - len(m)} of {grown} taken away")] if len(m) < grown else []),
        *(
            [("motion", f"one fits most: of these {consistent - len(m)} are off it (--filter consistent keeps them)")]
            if geometries == ["rigid"] and len(m) < consistent
            else []
        ),
        ("status", m.status),
        *([("doubt", doubts[m.status])] if m.status in doubts else []),
        ("seeds", f"{len(m.seeds)}, {document['seeds_that_grew']} of them grew"),
    ]
    if len(m):
        zncc, scale = document["zncc"], document["scale"]
        rows += [
            ("correlation", f"median {zncc['median']:.3f}, 5 % below {zncc['p05']:.3f}"),
            ("scale", f"median {scale['median']:.2f}, 90 % within {scale['p05']:.2f} to {scale['p95']:.2f}"),
        ]
        if document["at_border_share"] > 0.2:
            rows.append(("doubt", f"{100 * document['at_border_share']:.0f} % found at the rim of their search"))
    return document, table([*rows, *(("written", f) for f in files)])


def add_match(commands: Any) -> None:
    """Adds `match` to the command line."""
    p = add_command(
        commands,
        "match",
        run_match,
        "Match two pictures quasi-densely: from seeds that are found (or given), matches grow over what the pictures "
        "have in common. Writes matches.npz and .csv, a picture of both with the matches coloured, the second warped "
        "onto the first, and statistics.",
        "pipefish match left.png right.png -o out/\n"
        "  pipefish match k17.png k18.png --profile camera.json --pose pose.txt -o out/",
    )
    p.add_argument("first", metavar="A", help="a picture")
    p.add_argument("second", metavar="B", help="another of the same scene")
    p.add_argument("-o", "--output", required=True, metavar="FOLDER", help="for what is written")
    p.add_argument(
        "--mode",
        choices=MODES,
        default="adaptive",
        help="the affine map between surroundings is estimated at each match, is that of the seed, or none at all "
        "(narrow baselines, fastest) [adaptive]",
    )
    p.add_argument("--zncc", type=float, default=0.8, metavar="Z", help="least correlation of a match [0.8]")
    p.add_argument("--seeds", metavar="FILE", help="rows x1,y1,x2,y2 or x1,y1,x2,y2,a11,a12,a21,a22 [found]")
    p.add_argument(
        "--profile", action="append", metavar="PROFILE", help="of the camera; twice for two cameras. Needs --pose"
    )
    p.add_argument("--pose", metavar="FILE", help="cam2_from_cam1: the 12 numbers of [R | t], row by row")
    p.add_argument(
        "--filter",
        action="append",
        choices=FILTERS,
        help="keep only matches that fit their neighbours and are no small islands (consistent), that the reverse "
        "direction confirms (both-ways), that fit the one plane or rigid motion that most agree with (pinhole "
        "pictures; rigid: the motion, if 78 %% of the picture agree), or that are the only place on their epipolar "
        "line which looks like it (unique: by --pose, else by the rigid motion that most agree with); may be repeated; "
        "none: all that grew [consistent and rigid; with a fisheye's --profile consistent]",
    )
    p.add_argument("--threads", type=positive, default=1, metavar="N", help="do not change the result [1]")
