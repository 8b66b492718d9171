"""`pipefish report`: one self-contained HTML page about a measured pipe, from the folder of `pipefish reconstruct`."""

from __future__ import annotations

import datetime
import html
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.dense_findings import finding_parts
from pipefish.files import write_atomically
from pipefish.intervals import SAID, Z95
from pipefish.measured_limits import LIMITS, check_limits, most_oval, verdict, whole_sigma
from pipefish.measured_reach import UNSEEN, reach_text
from pipefish.measured_texts import clock_text, column, length_text, place_text, scale_texts, size_parts
from pipefish.page import chart_html, fill, table_html, whole_page
from pipefish.report_charts import Charts
from pipefish.report_dense import DensePart, dense_part
from pipefish.report_scene import Scene
from pipefish.report_wall import WallPicture, wall_picture
from pipefish.unroll import Tell

INTERVALS = (
    "Repeatability: by how much another drive through the pipe would differ. Systematic: what it "
    "would repeat, as scale and camera stay the same."
)
FILES = {
    "profile.csv": "diameters and ovality along the pipe",
    "centreline.csv": "where the pipe goes",
    "events.csv": "the findings",
    "points.ply": "the points that were measured, as a cloud",
    "tube.ply": "the fitted wall, as a surface",
    "tube.glb": "the wall with its picture, in 3-D",
    "deviation.glb": "the wall coloured by deviation, in 3-D",
    "colmap": "poses and points for COLMAP and what reads it",
    "reconstruction.json": "all of it, for programs",
}
FINDING_COLUMNS = ("what", "chainage", "clock", "size", "found by")


def _finding_cell(of: str, text: str) -> str:
    """A cell of the findings; where they stand below each other, as on a phone, it says what it is of."""
    named = f" data-of='{of}'" if of not in ("what", "size") else ""
    return f"<td{named}>{html.escape(text)}</td>"


def _with_code(text: str) -> str:
    """HTML of a text with its commands, between back-ticks, as code."""
    parts = html.escape(text).split("`")
    return "".join(f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts))


class Report(Charts):
    """Collects the parts of the page. Use `write_report`."""

    def __init__(self, folder: Path, limits: list[tuple[str, float]], picture: WallPicture, dense: DensePart) -> None:
        super().__init__(folder)
        self.picture = picture
        self.dense = dense
        check_limits(limits, self.summary["d_mean"] if self.unit == "metre" else None)
        self.scene = Scene(self, limits)
        self.verdicts = [verdict(self.document, name, bound) for name, bound in limits]

    # ---- texts

    def tiles(self) -> list[tuple[str, str, str]]:
        """(figure, unit, what) of the head."""
        s, tiles = self.summary, []
        if not s["diameter_from_prior"]:
            random, shared = (1000 * Z95 * s[k] for k in ("d_mean_sigma", "d_mean_systematic"))
            tiles.append(
                (
                    f"{1000 * s['d_mean']:.1f}",
                    "mm",
                    f"mean diameter, ± {random:.1f} repeatability, ± {shared:.1f} systematic",
                )
            )
        elif self.unit == "metre":
            tiles.append((f"{1000 * s['d_mean']:.1f}", "mm", "mean diameter, as given: not measured"))
        digits = 1 if self.unit == "metre" else 3
        if "d_max" in s:
            for name, word, worst in (("d_min", "narrowest", np.nanargmin), ("d_max", "widest", np.nanargmax)):
                k = int(worst(column(self.document, name)))
                at = length_text(column(self.document, "chainage")[k], self.unit, metres=True)
                half = self.factor * Z95 * whole_sigma(self.document, name)[k]
                tiles.append(
                    (f"{self.factor * s[name]:.{digits}f}", self.short, f"{word}, ± {half:.{digits}f}, at {at}")
                )
            at = length_text(s["ovality_most_at"], self.unit, metres=True)
            rms = s.get("ovality_rms")  # older documents have none
            along = "" if rms is None else f"; {100 * rms:.2f} % rms along the pipe"
            half = 100 * most_oval(self.document)
            tiles.append((f"{100 * s['ovality_most']:.2f}", "%", f"most oval, ± {half:.2f}, at {at}{along}"))
        figure = f"{s['path_length']:.2f}", self.along_unit, "of camera path"
        tiles.append(figure)
        return tiles

    def limits_html(self) -> str:
        """The limits, passed or failed."""
        if not self.verdicts:
            return "<p class='muted'>No limits were given (<code>--limit ovality=5</code>).</p>"
        shown = [v | {"word": "FAILED" if v["state"] == "failed" else v["state"]} for v in self.verdicts]
        rows = "".join(
            f"<tr><th scope='row'>{html.escape(LIMITS[v['name']].words)}</th>"
            f"<td><span class='state {v['state'].split()[0]}'>{v['word']}</span></td>"
            f"<td>{LIMITS[v['name']].side} {v['bound']:g} {v['unit']}</td>"
            f"<td>worst: {html.escape(v['worst'])}</td></tr>"
            for v in shown
        )
        table = f"<div class='wide'><table class='list'>{rows}</table></div>"
        if all(v["state"] != "undecided" for v in self.verdicts):
            return table
        note = "Undecided: the interval at the worst station, systematic part included, reaches across the limit."
        return f"{table}<p class='muted'>{note}</p>"

    def date(self) -> str:
        """When the first keyframe was taken."""
        stamp = self.document["survey"]["first_time_unix_ns"]
        if not stamp:
            return ""
        return datetime.datetime.fromtimestamp(stamp / 1e9, datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")

    def name(self) -> str:
        """What the survey is called; without a name, its file and date."""
        survey = self.document["survey"]
        return survey["name"] or ", ".join(t for t in (Path(survey["file"]).stem, self.date()) if t) or "Pipe"

    def scale_source(self) -> str:
        """What the scale is from, in words."""
        words = {"diameter": "given diameter", "joints": "joint spacing"}
        scale = self.document["scale"]
        used = dict.fromkeys(r["name"] for r in scale["sources"] if r["used"]) or {scale["source"]: None}
        return " and ".join(words.get(name, name) for name in used)

    def camera_text(self) -> str:
        """What the camera's calibration leaves open in the mean diameter."""
        camera = self.summary["systematic"]["camera"]
        return f"± {Z95 * 100 * camera:.2f} %" if camera is not None else "unknown: the profile has no covariance"

    def pupil_text(self) -> str:
        """What the pupil's shift leaves open in the mean diameter. Documents of older versions have none."""
        if "pupil" not in self.summary["systematic"]:
            return "not counted by the version that measured"
        pupil = self.summary["systematic"]["pupil"]
        if pupil:
            return f"± {Z95 * 100 * pupil:.2f} %, assumed: the profile does not say how well it knows it"
        if self.document["structure"].get("pupil_e1"):
            return "in the repeatability: the survey's own tracks tell the shift"
        known = self.document["camera"].get("pupil_known", False)
        return "in the camera's, as calibrated" if known else "not counted: no diameter was measured"

    def accuracy_rows(self) -> list[tuple[str, str]]:
        """Repeatability and systematic error side by side."""
        s = self.summary
        if s["diameter_from_prior"]:
            why = "the scale is the given diameter" if self.unit == "metre" else "there is no scale"
            rows = [("mean diameter", f"not measured: {why}")]
            if s["systematic"]["camera"] is None:
                rows.append(("camera, by its calibration", self.camera_text()))
        else:
            rows = [
                ("repeatability of the mean diameter", f"± {Z95 * 1000 * s['d_mean_sigma']:.2f} mm"),
                ("repeatability of one station", f"± {Z95 * 1000 * s['station_sigma']:.2f} mm"),
                ("systematic, of the mean diameter", f"± {Z95 * 1000 * s['d_mean_systematic']:.2f} mm"),
                (f"  of which scale ({self.scale_source()})", f"± {Z95 * 100 * s['systematic']['scale']:.2f} %"),
                ("  of which camera, by its calibration", self.camera_text()),
                ("  of which pupil shift", self.pupil_text()),
            ]
        if self.unit == "metre" and "station_systematic_most" in s:  # documents of older versions have none
            median, most = (1000 * Z95 * s[k] for k in ("station_systematic", "station_systematic_most"))
            rows.append(("systematic, of one station", f"± {median:.2f} mm, up to ± {most:.2f}"))
        if "ovality_sigma" in s:
            rows.append(
                ("ovality at one station, repeatability", f"± {Z95 * 100 * s['ovality_sigma']:.2f} percentage points")
            )
            if s["ovality_systematic"] > 0:
                rows.append(("  systematic (camera)", f"± {Z95 * 100 * s['ovality_systematic']:.2f} percentage points"))
        for text in scale_texts(self.document["scale"]):
            name, _, told = text.partition(": ")
            rows.append((f"lengths by the {name}, against the given ones", told))
        return rows

    def events_html(self) -> str:
        """The table of findings, those of the dense map among them."""
        rows = []
        events = [(e, False) for e in self.document["events"]] + [(e, True) for e in self.dense.findings]
        # What has no place stands last.
        events.sort(key=lambda e: (e[0]["chainage"] is None, e[0]["chainage"] or 0.0))
        for e, by_map in events:
            clock = clock_text(e["clock"]) if e.get("clock") is not None else ""
            size = "; ".join(finding_parts(e, self.unit) if by_map else size_parts(e, self.unit))
            found_by = "dense map" if by_map else "tube"
            cells = (e["kind"].replace("_", " "), place_text(e, self.unit), clock, size, found_by)
            rows.append("<tr>" + "".join(map(_finding_cell, FINDING_COLUMNS, cells)) + "</tr>")
        told = f"<p class='note'>{_with_code(self.reach_text())}</p>"
        if not rows:
            return f"<p class='muted'>Nothing was found to depart from a smooth pipe.</p>{told}"
        head = "".join(f"<th scope='col'>{c}</th>" for c in FINDING_COLUMNS)
        table = f"<table class='list findings'><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
        return f"<div class='wide'>{table}</div>{told}"

    def reach_text(self) -> str:
        """What the findings can show at all."""
        found = self.document.get("findings_reach")  # older ones have none
        by_tracks = reach_text(found, self.unit) if found else f"Tracked points do not show {UNSEEN}."
        if self.dense.reach:
            return f"{by_tracks} {self.dense.reach}"
        return by_tracks + " `pipefish dense` maps the wall between the tracks: smaller deposits, joint steps, cracks."

    def tables(self) -> list[tuple[str, list[tuple[str, str]]]]:
        """(heading, rows) of what stands at the end."""
        d = self.document
        gaps = [
            (
                f"{g['start']:.2f} to {g['end']:.2f} {self.along_unit}" if g["start"] is not None else "unknown",
                g["detail"],
            )
            for g in d["not_measured"]
            if g["end"] is not None or g["start"] is None
        ]
        survey = [
            ("survey", d["survey"]["name"] or "-"),
            ("surveyed", self.date() or "unknown"),
            ("survey id", d["survey"]["survey_id"]),
            ("file", Path(d["survey"]["file"]).name),
            ("device", d["survey"]["software"] or "-"),
            ("measured by", d["software"]),
        ]
        return [
            ("Accuracy", self.accuracy_rows()),
            ("Measured", self.measured_rows()),
            ("Stretches not measured", gaps or [("none", "all of the path was measured")]),
            ("Calibration used", self.calibration_rows()),
            ("Survey", survey),
            ("Files of the measurement", self.file_rows()),
        ]

    def measured_rows(self) -> list[tuple[str, str]]:
        """How much there is of everything."""
        d, s = self.document, self.summary
        structure = d["structure"]
        digits = 1 if self.unit == "metre" else 3
        least, most = (f"{self.factor * s[k]:.{digits}f}" for k in ("d_mean_least", "d_mean_most"))
        rows = [
            ("keyframes with a pose", f"{s['keyframes_with_pose']} of {s['keyframes']}"),
            ("left out: nothing had moved", str(len(structure["standing"]))),
            ("stretches", str(s["stretches"])),
            ("points", str(s["points"])),
            ("observations", str(structure["observations"])),
            ("mean diameter of the stations", f"{least} to {most} {self.short}"),
            ("stations with diameter", f"{s['stations_measured']} of {s['stations']}"),
            ("stations with ovality", f"{s['stations_with_ovality']} of {s['stations']}"),
            ("residuals", f"{d['quality']['residual_rms_px']:.3f} px rms per coordinate"),
            ("residuals over the tracker's stated noise", f"{d['quality']['residuals_over_noise']:.2f}"),
            ("scale from", self.scale_source()),
            ("clock zero", d["clock_zero"]),
            ("nominal diameter", f"{1000 * s['nominal']:.0f} mm" if s["nominal"] else "unknown"),
        ]
        if d["scale"]["wheel_sigma"] is not None:
            wheel = f"{100 * d['scale']['wheel']:+.2f} ± {100 * Z95 * d['scale']['wheel_sigma']:.2f} %"
            rows.append(("wheel: true distance against reading", wheel))
        return rows

    def calibration_rows(self) -> list[tuple[str, str]]:
        """The camera that measured."""
        d, camera = self.document, self.document["camera"]
        return [
            ("profile", camera["name"] or "unnamed"),
            ("serial", camera["serial"] or "-"),
            ("model", camera["model"]),
            ("picture", f"{camera['width']} x {camera['height']}"),
            ("field", f"to {camera['theta_max_deg']:.1f}° from the axis"),
            *([("in this survey", profile["text"])] if (profile := d["quality"].get("profile")) else []),
            (
                "residual of the calibration",
                f"{camera['rms_px']:.3f} px" if camera["rms_px"] is not None else "unknown",
            ),
            (
                "pupil shift",
                f"{1000 * camera['pupil_e1']:.3g} mm per rad²" if camera["pupil_e1"] else "none in the profile",
            ),
            (
                "covariance",
                "yes" if camera["covariance"] else f"none: asymmetry of {camera['assumed_px']:.2g} px assumed",
            ),
            ("source", camera["source"] or "-"),
        ]

    def file_rows(self) -> list[tuple[str, str]]:
        """What lies beside reconstruction.json, and what to know about it. Older documents do not say."""
        names = dict.fromkeys(name.split("/")[0] for name in self.document.get("files", []))
        rows = [(name, FILES.get(name, "")) for name in names]
        return rows + [("note", text) for text in self.document.get("file_remarks", [])]

    def render(self, title: str | None) -> str:
        """The whole page."""
        diameter, ovality, tube = self.chart_diameter(), self.chart_ovality(), self.scene.chart()
        line, quality = self.charts_line(), self.charts_quality()
        tables = dict(self.tables())
        remarks = "".join(f"<li>{_with_code(r)}</li>" for r in self.document["remarks"])
        values = {
            "limits": self.limits_html(),
            "accuracy": table_html("Accuracy", tables.pop("Accuracy"), note=INTERVALS),
            "remarks": f"<ul class='remarks'>{remarks}</ul>" if remarks else "<p class='muted'>None.</p>",
            "profile": chart_html(diameter) + chart_html(ovality),
            "events": self.events_html(),
            "wall": self.picture.html,
            "dense": self.dense.html,
            "tube": chart_html(tube),
            "line": "".join(map(chart_html, line)),
            "quality": "".join(map(chart_html, quality)),
            "tables": "".join(table_html(heading, rows) for heading, rows in tables.items()),
        }
        s = self.summary
        lead = f"{length_text(s['path_length'], self.unit, metres=True)} of "
        lead += f"DN{1000 * s['nominal']:.0f} pipe, " if s["nominal"] else "pipe, "
        lead += f"measured from {s['keyframes_with_pose']} keyframes and {s['points']} points of its wall."
        if self.document["status"] != "ok":
            missing = s["stations"] - s["stations_with_ovality"]
            without = f", {missing} of {s['stations']} stations have no ovality" if missing else ""
            lead += f" Parts were not measured{without}: they are left blank and listed."
        if not self.document["scale"]["consistent"]:
            lead += " What tells the scale disagrees: see what to know before a length is used."
        charts = [diameter, ovality, tube, *line, *quality]
        main, more = fill("report.html", values), {"wall": self.picture.data} if self.picture.data else {}
        return whole_page(
            "Pipefish measurement",
            title or self.name(),
            f"{lead} {SAID.capitalize()}.",
            main,
            charts,
            self.tiles(),
            **more,
        )


def write_report(
    folder: Path,
    out: Path,
    *,
    limits: list[tuple[str, float]] | None = None,
    title: str | None = None,
    survey: Path | None = None,
    dense: Path | None = None,
    tell: Tell | None = None,
) -> list[dict[str, Any]]:
    """Writes the page about a folder of `pipefish reconstruct`; returns the verdicts on the limits (name of LIMITS,
    bound in per cent or millimetres). survey: the file with the pictures [where it was when it was measured]; where it
    is not, the page says so. dense: folder of `pipefish dense` [`folder`/dense, where there is one]. Raises
    LimitError, PipefishError, OSError."""
    check_limits(limits or [])
    by_map = dense_part(folder, dense)
    report = Report(folder, limits or [], wall_picture(folder, survey, tell, by_map.findings), by_map)
    write_atomically(out, report.render(title).encode())
    return report.verdicts
