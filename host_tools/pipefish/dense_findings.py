"""What a dense map found, as findings beside those of the fitted tube: for the table, the report and scripts."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from pathlib import Path
from typing import Any

from pipefish.errors import FormatError, PipefishError
from pipefish.intervals import Z95
from pipefish.measured_texts import interval_text, length_text, read_document

FORMAT, VERSION = "pipefish-dense", 2
COLUMNS = (
    *("kind", "piece", "chainage", "clock", "clock_text", "sigma", "length", "length_sigma", "width", "width_sigma"),
    *("height", "height_sigma", "step", "step_sigma", "widening", "widening_sigma", "area", "volume"),
    *("direction", "extent_s", "extent_clock", "offset", "offset_sigma", "views"),
)


def fingerprint(folder: Path) -> str:
    """Of the reconstruction that a folder holds: a map of another one does not lie on its tube. Raises OSError."""
    return hashlib.sha256((folder / "reconstruction.json").read_bytes()).hexdigest()[:16]


def findings_of(document: dict[str, Any]) -> list[dict[str, Any]]:
    """Regions, steps and cracks of a document of dense.json by chainage: kind "deposit" (stands in), "recess" (out),
    "step" or "crack"; the keys of COLUMNS that it has, and a crack's path of (chainage, clock)."""
    out = []
    for r in document["regions"]:
        kind = "deposit" if r["kind"] == "inwards" else "recess"
        out.append(r | {"kind": kind, "height": abs(r["height"]), "height_sigma": r["sigma"], "sigma": None})
        out[-1]["extent_clock"] = r["extent"]
    for r in document["steps"]:
        out.append(r | {"kind": "step", "step_sigma": r["sigma"], "widening_sigma": r["sigma"], "sigma": None})
    out += [c | {"kind": "crack"} for c in document["cracks"]]
    return sorted(out, key=lambda e: (e["chainage"], e["clock"]))


def findings_table(findings: list[dict[str, Any]]) -> bytes:
    """As CSV."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for e in findings:
        values = (e.get(name) for name in COLUMNS)
        writer.writerow(["" if v is None else f"{v:.6g}" if isinstance(v, float) else v for v in values])
    return stream.getvalue().encode()


def _sized(name: str, value: float, sigma: float | None, unit: str) -> str:
    return f"{name} {interval_text(value, sigma, unit)}"


def finding_parts(e: dict[str, Any], unit: str) -> list[str]:
    """How large a finding is, in words, with 95 % intervals."""
    if e["kind"] == "crack":
        parts = [_sized("length", e["length"], e["length_sigma"], unit), e["direction"]]
        parts.append(_sized("width at least", e["width"], e["width_sigma"], unit))
        parts.append(f"place ± {length_text(Z95 * e['sigma'], unit)} across it")
        if e["offset"] is not None and abs(e["offset"]) > 3 * e["offset_sigma"]:
            parts.append(_sized("edges offset by", abs(e["offset"]), e["offset_sigma"], unit))
        return parts
    if e["kind"] == "step":
        return [
            _sized("step", e["step"], e["step_sigma"], unit),
            _sized("radius wider by" if e["widening"] >= 0 else "radius narrower by", abs(e["widening"]), None, unit),
        ]
    width = length_text(e["area"] / e["length"], unit) if e["length"] else ""
    return [
        _sized("height", e["height"], e["height_sigma"], unit),
        _sized("length", e["length"], None, unit),
        f"mean width {width}",
    ]


def read_dense(folder: Path, measured: Path) -> dict[str, Any]:
    """dense.json of a folder, of a map of the reconstruction in the folder `measured`. Raises PipefishError (another
    reconstruction's, another version's), FormatError, OSError."""
    path = folder / "dense.json"
    document = read_document(path, FORMAT, "pipefish dense")
    if document.get("version") != VERSION:
        raise PipefishError(f"{path}: version {document.get('version')}, not {VERSION}; run `pipefish dense` again")
    wanted = {"reconstruction", "files", "unit", "cell", "measured", "coverage", "sigma_median", "cracks"}
    if missing := sorted(wanted - set(document)):
        raise FormatError(path, missing[0], "missing")
    if document["reconstruction"] != fingerprint(measured):
        raise PipefishError(f"{path}: is a map of another reconstruction than {measured}; run `pipefish dense` again")
    try:
        for e in findings_of(document):
            if not math.isfinite(float(e["chainage"]) + float(e["clock"])):
                raise ValueError("chainage or clock")
            finding_parts(e, document["unit"])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(path, None, f"not whole: {error!r:.80}") from None
    return document
