"""One self-contained HTML page about a survey: pictures, tracks, link, device. No network, no other file."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pipefish import __version__
from pipefish.colours import AGE_MAX, scale_colours
from pipefish.errors import PipefishError
from pipefish.files import rounded, write_atomically
from pipefish.show import Painter, Style, animation, spread
from pipefish.survey import Survey
from pipefish.trackstats import charts as statistics_charts

GALLERY = 16  # keyframes
GALLERY_WIDTH = 900  # pixels
HERO_WIDTH = 560
HERO_LIMIT = 4 << 20  # bytes of the animation
ASSETS = Path(__file__).with_name("page_assets")

# The device's stages of StageTimes, as people call them.
STAGES = [
    ("capture", "capture"),
    ("pyramid", "pyramid"),
    ("track", "tracking"),
    ("detect", "corner detection"),
    ("keyframe", "JPEG and message, a keyframe"),
    ("store", "spool, a keyframe"),
]

Chart = dict[str, Any]


def data_uri(data: bytes, kind: str) -> str:
    """Bytes as a data: address."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _axis(title: str, **more: Any) -> dict[str, Any]:
    return {"title": {"text": title}, **more}


def along_of(survey: Survey) -> tuple[bool, np.ndarray, str]:
    """(whether it is chainage, (N,) where each keyframe lies along the survey, title of that axis)."""
    chainage = survey.chainage()
    if len(chainage) and np.isfinite(chainage).all():
        return True, chainage, "chainage by the encoder, m"
    return False, np.array([k.index for k in survey.keyframes], dtype=float), "keyframe"


class Page:
    """Collects the parts of the page. Use `write_page`."""

    def __init__(self, survey: Survey, evaluation: dict[str, Any] | None, extra: dict[str, Any]) -> None:
        self.survey = survey
        self.info = survey.info
        self.painter = Painter(survey)
        self.tracks = self.painter.tracks
        self.evaluation = evaluation
        self.extra = extra
        self.has_chainage, self.along, self.along_title = along_of(survey)

    # ---- charts: (title, what one should see, data, layout)

    def charts_tracks(self) -> list[Chart]:
        """Length of tracks, tracks along the pipe, and accuracy where the truth is known."""
        lengths = self.tracks.length_frames
        if not len(lengths):
            return []
        top = int(min(lengths.max(), max(30, np.percentile(lengths, 99)))) + 1
        counts, edges = np.histogram(np.minimum(lengths, top), bins=min(60, top), range=(0, top))
        charts = [
            {
                "id": "lengths",
                "title": "How long tracks live",
                "text": f"Age of each track when a keyframe last saw it, in camera frames: median "
                f"{np.median(lengths):.0f}, 90th percentile {np.percentile(lengths, 90):.0f}. "
                "The last bar holds all longer ones.",
                "data": [
                    {
                        "type": "bar",
                        "x": rounded((edges[:-1] + edges[1:]) / 2, 2),
                        "y": counts.tolist(),
                        "width": rounded(np.diff(edges) * 0.92, 3),
                        "hovertemplate": "%{x:.0f} frames: %{y} tracks<extra></extra>",
                    }
                ],
                "layout": {"xaxis": _axis("camera frames"), "yaxis": _axis("tracks")},
            }
        ]
        live = [len(k.observations.id) for k in self.survey.keyframes]
        unbroken = [i > 0 and not k.after_break for i, k in enumerate(self.survey.keyframes)]  # else: none before
        common = [
            k.message.common_tracks if u else np.nan for k, u in zip(self.survey.keyframes, unbroken, strict=True)
        ]
        charts.append(
            {
                "id": "live",
                "title": "Tracks along the pipe",
                "text": "Tracks seen in each keyframe, and how many of them the keyframe before saw too.",
                "data": [
                    {"type": "scatter", "mode": "lines", "name": "seen", "x": rounded(self.along), "y": live},
                    {
                        "type": "scatter",
                        "mode": "lines",
                        "name": "in common with the one before",
                        "x": rounded(self.along),
                        "y": rounded(common, 0),
                    },
                ],
                "layout": {"xaxis": _axis(self.along_title), "yaxis": _axis("tracks", rangemode="tozero")},
            }
        )
        charts += statistics_charts(self.survey, self.along, self.along_title)
        if self.evaluation and self.evaluation["by_age"]:
            charts.append(self._chart_accuracy(self.evaluation["by_age"]))
        return charts

    def _chart_accuracy(self, by_age: list[dict[str, Any]]) -> Chart:
        ages = [f"{b['age_low']}-{b['age_high']}" for b in by_age]
        error = self.evaluation["median_px"]
        median = f"; the median error is {error:.3f} px" if error is not None else ""
        share = self.evaluation.get("survival")
        survival = (
            f" {100 * share:.1f} % of the tracks that could be followed to the next keyframe were." if share else ""
        )
        return {
            "id": "accuracy",
            "title": "Accuracy against the simulator's truth",
            "text": f"{100 * self.evaluation['within_1px']:.2f} % of all observations lie within one pixel of where "
            f"the point really is{median}. Each track is anchored at the keyframe that saw it first.{survival}",
            "data": [
                {
                    "type": "bar",
                    "name": "within 1 px",
                    "x": ages,
                    "y": rounded((100 * b["within_1px"] for b in by_age), 2),
                    "customdata": [b["count"] for b in by_age],
                    "hovertemplate": "%{y:.2f} % of %{customdata} observations<extra></extra>",
                },
                {
                    "type": "scatter",
                    "mode": "lines+markers",
                    "name": "median error",
                    "x": ages,
                    "y": rounded((np.nan if b["median_px"] is None else b["median_px"] for b in by_age), 4),
                    "yaxis": "y2",
                    "hovertemplate": "median %{y:.3f} px<extra></extra>",
                },
            ],
            "layout": {
                "xaxis": _axis("camera frames since the anchor", type="category"),
                "yaxis": _axis("within 1 px, %", range=[0, 100]),
                "yaxis2": _axis(
                    "median error, px",
                    overlaying="y",
                    side="right",
                    rangemode="tozero",
                    showgrid=False,
                    tickformat=".2f",
                ),
            },
        }

    def charts_device(self) -> list[Chart]:
        """Time per stage, keyframe sizes, encoder."""
        charts = []
        status = self.survey.last_status
        if status is not None and status.HasField("stage"):
            stage = status.stage
            names = [text for _, text in STAGES]
            charts.append(
                {
                    "id": "stages",
                    "title": "Where the device spends its time",
                    "text": f"Mean of each stage; {status.fps:.1f} frames tracked per second over the run, slowest "
                    f"frame {stage.frame_max / 1000:.1f} ms.",
                    "data": [
                        {
                            "type": "bar",
                            "orientation": "h",
                            "y": names[::-1],
                            "x": rounded((getattr(stage, name) / 1000 for name, _ in reversed(STAGES)), 3),
                            "hovertemplate": "%{y}: %{x:.2f} ms<extra></extra>",
                        }
                    ],
                    "layout": {"xaxis": _axis("milliseconds"), "yaxis": {"automargin": True}},
                }
            )
        sizes = {r.sha256: r.size for r in self.survey.receipts if r.kind == 2}
        if sizes:
            values = np.array(list(sizes.values())) / 1000
            counts, edges = np.histogram(values, bins=min(40, max(5, len(values) // 3)))
            charts.append(
                {
                    "id": "sizes",
                    "title": "Size of a keyframe on the wire",
                    "text": f"Picture and observations together: median {np.median(values):.1f} kB, largest "
                    f"{values.max():.1f} kB.",
                    "data": [
                        {
                            "type": "bar",
                            "x": rounded((edges[:-1] + edges[1:]) / 2, 2),
                            "y": counts.tolist(),
                            "width": rounded(np.diff(edges) * 0.92, 4),
                            "hovertemplate": "%{x:.1f} kB: %{y} keyframes<extra></extra>",
                        }
                    ],
                    "layout": {"xaxis": _axis("kB"), "yaxis": _axis("keyframes")},
                }
            )
        if self.has_chainage and len(self.survey.keyframes) > 1:
            charts.append(self._chart_encoder())
        return charts

    def _chart_encoder(self) -> Chart:
        times: list[float] = []
        elapsed, previous = 0.0, None
        for frame in self.survey.keyframes:  # a restart begins a new clock: go on where the last one stopped
            if previous is not None and previous.boot == frame.boot:
                elapsed += (frame.monotonic_ns - previous.monotonic_ns) / 1e9
            times.append(elapsed)
            previous = frame
        return {
            "id": "encoder",
            "title": "Distance by the encoder",
            "text": f"{self.info['length_m']:.2f} m in {elapsed:.1f} s of the device's time. Each point is a keyframe.",
            "data": [
                {
                    "type": "scatter",
                    "mode": "lines+markers",
                    "x": rounded(times, 3),
                    "y": rounded(self.along),
                    "marker": {"size": 4},
                    "hovertemplate": "%{x:.1f} s: %{y:.3f} m<extra></extra>",
                }
            ],
            "layout": {"xaxis": _axis("seconds"), "yaxis": _axis("metres")},
        }

    # ---- pictures

    def gallery(self) -> list[dict[str, str]]:
        """A spread of keyframes as JPEG data URIs with their captions."""
        result = []
        for position in spread(len(self.survey.keyframes), GALLERY):
            picture = self.painter.draw(position, Style(GALLERY_WIDTH, legend=False, line=1.5, dot=2.2))
            out = io.BytesIO()
            picture.save(out, "JPEG", quality=82, optimize=True)
            result.append({"src": data_uri(out.getvalue(), "image/jpeg"), "text": self.painter.caption(position)})
        return result

    # ---- text

    def tiles(self) -> list[tuple[str, str, str]]:
        """(figure, unit, what) of the head of the page."""
        info, tracks = self.info, self.info["tracks"]
        tiles = [(f"{info['length_m']:.2f}", "m", "of pipe")] if info["length_m"] is not None else []
        made = self.survey.end.keyframes if self.survey.end else None
        tiles.append((str(info["keyframes"]), f"of {made}" if made is not None else "", "keyframes received"))
        if info["frames"]:
            fps = self.survey.last_status.fps if self.survey.last_status else 0.0
            tiles.append((str(info["frames"]), "", f"camera frames, {fps:.0f} tracked per second"))
        if tracks["tracks"]:
            tiles.append((f"{tracks['length_frames_median']:.0f}", "frames", "median length of a track"))
        if self.evaluation:
            tiles.append(
                (f"{100 * self.evaluation['within_1px']:.1f}", "%", "of tracked points within 1 px of the truth")
            )
        goodput = self.extra.get("goodput_bytes_per_s")
        if goodput:
            tiles.append((f"{goodput / 1000:.0f}", "kB/s", "over the line during the transfer"))
        return tiles

    def tables(self) -> list[tuple[str, list[tuple[str, str]]]]:
        """(heading, rows) of the tables."""
        info, start, status = self.info, self.survey.start, self.survey.last_status
        profile = info["profile"] or {}
        survey = [
            ("name", info["name"] or "-"),
            ("survey id", info["survey_id"]),
            ("state", "complete" if info["complete"] else "incomplete"),
            (
                "pipe",
                f"DN{info['nominal_diameter_m'] * 1000:.0f}" if info["nominal_diameter_m"] else "diameter unknown",
            ),
            (
                "camera",
                f"{info['width']} x {info['height']}" + (f" at {info['frame_rate']:g}/s" if info["frame_rate"] else ""),
            ),
            ("profile", profile.get("error") or profile.get("name") or "none"),
            ("source", info["source"] or "-"),
            ("device", info["software"] or "-"),
            ("duration", f"{info['duration_s']:.1f} s of the device's time"),
            ("ended", info["end_reason"] or "not yet"),
        ]
        breaks = [(f"keyframe {b['index']}", b["reason"]) for b in info["breaks"]] or [
            ("breaks", "none: one run, no gaps")
        ]
        if info["missing"]:
            breaks.append(
                ("keyframes missing", f"{len(info['missing'])}, of which {len(info['lost'])} lost on the device")
            )
        link = [(name, str(value)) for name, value in self.extra.get("link_rows", [])]
        if status is not None:
            breaks += [
                ("frames dropped by the camera", str(status.frames_dropped)),
                ("keyframes that could not be stored", str(status.keyframes_dropped)),
            ]
        measured = [(name, str(value)) for name, value in self.extra.get("measured_rows", [])]
        tables = [("The pipe, measured", measured), ("Survey", survey), ("Link", link), ("Gaps and breaks", breaks)]
        if start is not None and start.config:
            settings = [tuple(part.strip() for part in line.partition("=")[::2]) for line in start.config]
            tables.append(("Settings of the device", settings))
        return [(heading, rows) for heading, rows in tables if rows]


def _row_head(name: str) -> str:
    """Names that begin with spaces, as on a terminal, are parts of what stands above."""
    part = " class='part'" if name.startswith(" ") else ""
    return f"<th scope='row'{part}>{html.escape(name.lstrip())}</th>"


def table_html(heading: str, rows: list[tuple[str, str]], folded: bool = False, note: str = "") -> str:
    """A table of two columns under its heading, with a note below; folded: a click opens it."""
    body = "".join(f"<tr>{_row_head(n)}<td>{html.escape(v)}</td></tr>" for n, v in rows)
    table = f"<table>{body}</table>" + (f"<p class='note'>{html.escape(note)}</p>" if note else "")
    if folded:
        return f"<details class='card'><summary><h3>{html.escape(heading)}</h3></summary>{table}</details>"
    return f"<section class='card'><h3>{html.escape(heading)}</h3>{table}</section>"


def chart_html(chart: Chart) -> str:
    """The place of a chart, with its title and text. A chart with a `choice` (label, names; `traces` of each) shows one
    of them at a time."""
    choice, menu = chart.get("choice"), ""
    if choice:
        options = "".join(f"<option>{html.escape(n)}</option>" for n in choice["names"])
        menu = f"<label class='choice'>{html.escape(choice['label'])} <select id='choice-{chart['id']}'>{options}"
        menu += "</select></label>"
    return (
        f"<figure class='card chart'><figcaption><h3>{html.escape(chart['title'])}</h3>"
        f"<p>{html.escape(chart['text'])}</p>{menu}</figcaption>"
        f"<div class='plot' id='plot-{chart['id']}' role='img' "
        f"aria-label='{html.escape(chart['title'], quote=True)}'></div></figure>"
    )


def _for_script(value: Any) -> str:
    """JSON that may stand inside a script element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def render(page: Page, title: str, lead: str, quiet: bool = True) -> str:
    """The whole page as text."""
    gallery = page.gallery()
    moving = animation(page.painter, ".webp", HERO_LIMIT, HERO_WIDTH, legend=False, quiet=quiet)
    tracks, device = page.charts_tracks(), page.charts_device()
    tables = "".join(table_html(heading, rows, len(rows) > 14) for heading, rows in page.tables())
    values = {
        "still": gallery[len(gallery) // 2]["src"],
        "moving": data_uri(moving, "image/webp"),
        "age_max": str(AGE_MAX),
        "first": gallery[len(gallery) // 2]["src"],
        "middle": str(len(gallery) // 2),
        "first_text": html.escape(gallery[len(gallery) // 2]["text"]),
        "last": str(len(gallery) - 1),
        "tracks": "".join(map(chart_html, tracks)),
        "device": "".join(map(chart_html, device)),
        "tables": tables,
    }
    main = fill("page.html", values)
    if page.extra.get("report"):
        main = fill("report_link.html", {"address": html.escape(page.extra["report"], quote=True)}) + main
    return whole_page("Pipefish survey", title, lead, main, [*tracks, *device], page.tiles(), gallery=gallery)


def whole_page(
    brand: str,
    title: str,
    lead: str,
    main: str,
    charts: list[Chart],
    tiles: Iterable[tuple[str, str, str]] = (),
    **data: Any,
) -> str:
    """A page as text: head with `tiles` (figure, unit, what), `main` as HTML, the charts that it has places for. data:
    more for the page's script."""
    from plotly.offline import get_plotlyjs

    tile_row = "".join(
        f"<div class='tile'><span class='figure'>{html.escape(f)}<small>{html.escape(u)}</small></span>"
        f"<span class='what'>{html.escape(w)}</span></div>"
        for f, u, w in tiles
    )
    stops = ", ".join("rgb({}, {}, {})".format(*c) for c in scale_colours(np.linspace(0, 1, 9)))
    values = {
        "brand": html.escape(brand),
        "title": html.escape(title),
        "lead": html.escape(lead),
        "css": (ASSETS / "page.css").read_text(encoding="utf-8").replace("/*ramp*/", stops),
        "tiles": f"<div class='tiles'>{tile_row}</div>" if tile_row else "",
        "main": main,
        "version": __version__,
        "plotly": get_plotlyjs(),
        "data": _for_script({**data, "charts": charts}),
        "script": (ASSETS / "page.js").read_text(encoding="utf-8"),
    }
    return fill("base.html", values)


def fill(template: str, values: dict[str, str]) -> str:
    """A template of page_assets with its {{names}} replaced."""
    parts = (ASSETS / template).read_text(encoding="utf-8").split("{{")
    text = [parts[0]]
    for part in parts[1:]:
        name, _, rest = part.partition("}}")
        text += [values[name.strip()], rest]
    return "".join(text)


def write_statistics(survey: Survey, out: Path) -> int:
    """Writes a page with the track statistics along a survey; returns its size in bytes.

    Raises PipefishError if the device counted nothing; OSError."""
    _, along, title = along_of(survey)
    charts = statistics_charts(survey, along, title)
    if not charts:
        raise PipefishError(f"{survey.path}: no track statistics: recorded by an older device, or no keyframes")
    main = fill("stats.html", {"tracks": "".join(map(chart_html, charts))})
    lead = f"What became of the tracks, over {len(survey.keyframes)} keyframes."
    name = survey.info["name"] or survey.path.name
    data = whole_page("Pipefish tracks", name, lead, main, charts).encode()
    write_atomically(out, data)
    return len(data)


def write_page(
    survey: Survey,
    out: Path,
    *,
    title: str,
    lead: str,
    evaluation: dict[str, Any] | None = None,
    extra: dict[str, Any] | None = None,
    quiet: bool = True,
) -> int:
    """Writes the page atomically; returns its size in bytes.

    evaluation  of pipefish.evaluate, where the truth is known
    extra       goodput_bytes_per_s; link_rows, measured_rows: lists of (name, value); report: address of a report that
                is linked to, relative to this page
    Raises PipefishError if the survey has no keyframes; OSError.
    """
    data = render(Page(survey, evaluation, extra or {}), title, lead, quiet).encode()
    write_atomically(out, data)
    return len(data)
