"""`pipefish tube`: from a point cloud to diameters, ovality, bends, joints and what stands in the pipe."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from pipefish.cli import Result, UsageError, add_command, table
from pipefish.intervals import SAID, Z95

APART = 0.1  # share of points that scattered gross ones do not reach
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
UNIT_OFF = 2.0  # measured over nominal diameter, from which on the unit is doubted


def add_tube(commands: Any) -> None:
    """Adds the command."""
    p = add_command(
        commands,
        "tube",
        run_tube,
        "Measure a pipe in a point cloud: diameters and ovality along it with intervals, bends, joints, deposits.",
        "pipefish tube cloud.ply -o out/ --nominal 300",
    )
    p.add_argument("cloud", metavar="CLOUD", help=".ply (ASCII or binary), .xyz, .txt, .csv (x y z [sigma]) or .npy")
    p.add_argument("-o", "--output", metavar="DIR", help="folder for profile.csv, events.csv, tube.ply, tube.json")
    p.add_argument("--unit", choices=sorted(UNITS), default="m", help="of the cloud and of --path, --sigma [m]")
    p.add_argument("--sigma", type=float, help="measurement noise of a point [the cloud's column sigma, or unknown]")
    p.add_argument("--path", metavar="FILE", help="camera centres in order of travel, a file like CLOUD")
    p.add_argument("--nominal", type=float, metavar="MM", help="nominal diameter in mm")
    p.add_argument("--up", metavar="X,Y,Z", help="direction against gravity, for twelve o'clock [-y]")
    p.add_argument(
        "--scale-sigma", type=float, default=0.0, metavar="R", help="relative sigma of the cloud's scale [0]"
    )
    p.add_argument("--spacing", type=float, metavar="MM", help="of the stations along the pipe, mm [d / 4]")


def run_tube(args: argparse.Namespace) -> Result:
    """Runs the command."""
    from pipefish.cloudfile import read_points
    from pipefish.errors import PipefishError
    from pipefish.progress import Progress
    from pipefish.tube import fit_tube

    unit = UNITS[args.unit]
    if args.sigma is not None and not (math.isfinite(args.sigma) and args.sigma > 0):
        raise UsageError(f"tube: --sigma {args.sigma:g}: is not a length above zero")
    points, sigma = read_points(args.cloud)
    path = read_points(args.path)[0] * unit if args.path else None
    sigma = args.sigma if args.sigma is not None else sigma
    with Progress("tube", 100, args.json) as bar:
        tube = fit_tube(
            points * unit,
            None if sigma is None else sigma * unit,
            path,
            nominal=args.nominal / 1000 if args.nominal is not None else None,
            up=_direction(args.up) if args.up else None,
            scale_sigma=args.scale_sigma,
            spacing=args.spacing / 1000 if args.spacing is not None else None,
            progress=lambda done, word: bar.update(round(100 * done), word),
        )
    if tube.status != "ok":
        raise PipefishError(f"{args.cloud}: {tube.reason} ({tube.status})")
    document = document_of(tube)
    files = write_tube(tube, Path(args.output), document) if args.output else []
    return {**document, "files": files}, _text(tube, files)


def _direction(text: str) -> list[float]:
    try:
        values = [float(v) for v in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3:
        raise UsageError(f"--up {text}: not three numbers X,Y,Z")
    return values


def document_of(tube: Any) -> dict[str, Any]:
    """Everything about a tube for JSON; what was not measured is null."""
    from pipefish.files import plain

    return plain(
        {
            "status": tube.status,
            "reason": tube.reason,
            "nominal": tube.nominal,
            "clock_zero": tube.clock_zero,
            "summary": tube.summary,
            "events": tube.events,
            "stations": tube.stations,
        }
    )


def write_tube(tube: Any, folder: Path, document: dict[str, Any]) -> list[str]:
    """Writes profile.csv, events.csv, tube.ply and tube.json; returns their paths."""
    import numpy as np

    from pipefish.cloudfile import ply_bytes
    from pipefish.files import csv_bytes, write_atomically
    from pipefish.tube_findings import COLUMNS

    folder.mkdir(parents=True, exist_ok=True)
    vertices, faces = tube.mesh()
    columns = dict(zip("xyz", vertices.T.astype(np.float32), strict=True))
    contents = {
        "profile.csv": csv_bytes(tube.stations),
        "events.csv": csv_bytes({name: [event.get(name) for event in tube.events] for name in COLUMNS}),
        "tube.ply": ply_bytes(columns, faces, ("units: metres",)),
        "tube.json": json.dumps(document).encode(),
    }
    for name, data in contents.items():
        write_atomically(folder / name, data)
    return [str(folder / name) for name in contents]


def _text(tube: Any, files: list[str]) -> str:
    import numpy as np

    from pipefish.measured_texts import event_text

    s, t = tube.summary, tube.stations
    known = "ovality_rms" in s
    oval = (
        f"{100 * s['ovality_rms']:.2f} % (rms along the pipe, (max - min) / mean)"
        if known
        else "not measured: one side only"
    )
    spread = f", {1000 * np.nanmin(t['d_mean']):.1f} to {1000 * np.nanmax(t['d_mean']):.1f} along the pipe"
    rows: list[tuple[str, object]] = [
        ("length", f"{s['length']:.2f} m, {s['measured']} of {s['stations']} stations measured"),
        ("mean diameter", f"{1000 * s['d_mean']:.2f} ± {1000 * Z95 * s['d_mean_sigma']:.2f} mm{spread}"),
        ("ovality", oval),
        ("  most", _most_oval(t) if known else ""),
        ("roughness", f"{1000 * s['roughness']:.2f} mm"),
        ("clock", f"zero {tube.clock_zero}"),
    ]
    if s["points_apart"] > APART:
        text = f"{100 * s['points_apart']:.0f} % of the points are far from this pipe or beyond its ends: not measured"
        rows.append(("left out", text))
    rows += [(e["kind"], event_text(e | {"chainage": e["s"]}, "metre")) for e in tube.events]
    rows.append(("note", unit_note(s["d_mean"], tube.nominal)))
    rows.append(("intervals", SAID))
    return table([*rows, *(("written", f) for f in files)])


def _most_oval(stations: dict[str, Any]) -> str:
    import numpy as np

    k = int(np.nanargmax(stations["ovality"]))
    return f"{ovality_text({n: v[k] for n, v in stations.items()})}, at {stations['s'][k]:.2f} m"


def unit_note(diameter: float, nominal: float | None) -> str:
    """Of a diameter that is so far off the nominal one that the cloud must be in another unit than was said."""
    if not nominal or 1 / UNIT_OFF < diameter / nominal < UNIT_OFF:
        return ""
    return (
        f"measured is {diameter / nominal:.3g} times the nominal diameter: is the cloud in another unit? "
        f"--unit {', '.join(sorted(UNITS))}"
    )


def ovality_text(station: dict[str, Any]) -> str:
    """The ovality at one station with its 95 % interval."""
    low, high = (100 * max(0.0, float(station[k])) for k in ("ovality_lo", "ovality_hi"))
    return f"{100 * float(station['ovality']):.2f} %, 95 % from {low:.2f} to {high:.2f} %"
