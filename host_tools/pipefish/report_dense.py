"""The report's part about the dense map of the wall, where `pipefish dense` made one."""

from __future__ import annotations

import html
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipefish.dense_findings import findings_of, read_dense
from pipefish.errors import FormatError, PipefishError
from pipefish.intervals import Z95
from pipefish.measured_reach import map_text
from pipefish.measured_texts import length_text
from pipefish.page import data_uri


@dataclass
class DensePart:
    """The section of the page ("" without a map), what the map found (dense_findings.findings_of), and what it could
    find, in words."""

    html: str = ""
    reach: str = ""
    findings: list[dict[str, Any]] = field(default_factory=list)


def dense_part(folder: Path, dense: Path | None) -> DensePart:
    """Of the reconstruction in `folder`, by the map in `dense` [folder/dense, if there]. Raises PipefishError for a
    `dense` that is named and not this reconstruction's, FormatError for one that is broken, OSError."""
    where = dense or folder / "dense"
    if dense is None and not (where / "dense.json").exists():
        return DensePart()
    try:
        document = read_dense(where, folder)
    except FormatError:
        raise
    except PipefishError as error:
        if dense is not None:
            raise
        return DensePart(
            f"<section class='card'><p class='muted'>No dense map: {html.escape(str(error))}.</p></section>"
        )
    return DensePart(_section(where, document), map_text(document), findings_of(document))


def _section(where: Path, document: dict[str, Any]) -> str:
    unit = document["unit"]
    counts = [f"{len(document[key])} {key}" for key in ("regions", "steps", "cracks")]
    text = (
        f"Every {length_text(document['cell'], unit)} of the wall by matching keyframes with each other: "
        f"{document['measured']} places, {100 * document['coverage']:.0f} % of those in view of two pairs, each to "
        f"± {length_text(Z95 * (document['sigma_median'] or 0.0), unit)} (median) from the fitted tube. Found: "
        f"{counts[0]} that stand in or out, {counts[1]} of joints, {counts[2]}; they are among the findings. Above "
        "the deviation, below the wall, chainage to the right; found is what is framed, marked or traced."
    )
    parts = []
    for name in (n for n in document["files"] if n.endswith(".png")):
        try:
            with Image.open(where / name) as opened:
                picture = np.asarray(opened.convert("RGB"))
        except OSError as error:
            raise FormatError(where / name, None, f"no picture: {error}") from error
        stream = io.BytesIO()
        Image.fromarray(picture).save(stream, "WEBP", quality=85, method=4)
        size = f"width='{picture.shape[1]}' height='{picture.shape[0]}'"
        uri = data_uri(stream.getvalue(), "image/webp")
        parts.append(
            f"<div class='wide'><img src='{uri}' {size} alt='Deviation from the tube and unrolled wall'></div>"
        )
    note = f"<p class='note'>{html.escape(text)}</p>"
    return f"<section class='card below'><h3>Dense map</h3>{note}{''.join(parts)}</section>"
