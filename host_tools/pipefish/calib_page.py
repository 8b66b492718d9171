"""The report of a calibration: one self-contained HTML page, verdict first."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from . import calib_charts, calib_draw
from .calib_run import Session
from .calib_size import scale_text
from .files import write_atomically
from .page import Chart, chart_html, data_uri, fill, whole_page

Array = npt.NDArray[np.float64]

_THUMB = 420  # pixels wide
_MOST_LOST = 12  # rejected views shown
_MOST_POINTS = 8  # rejected points shown enlarged
_CUBE_EDGE = 300
_DARK = 8  # grey value: no darker edge is shown
_CUBES = 2  # views shown on cube faces, a camera

_LEVELS = {
    "bend": "bend",
    "z2": "quadratic height, stretch",
    "z4": "height to degree 4, stretch",
    "z6": "height to degree 6, stretch",
    "z6xy": "height to degree 6, stretch and in-plane to degree 3",
}


def write_report(session: Session, verdicts: dict[int, dict[str, Any]], out: Path, title: str) -> int:
    """Writes the page; returns its size in bytes. verdicts: calib_verdict.verdict by camera number. Raises OSError."""
    data = render(session, verdicts, title).encode()
    write_atomically(out, data)
    return len(data)


def render(session: Session, verdicts: dict[int, dict[str, Any]], title: str) -> str:
    """The page as text."""
    result, report = session.result, session.result.report
    many = len(result.cameras) > 1
    charts: list[Chart] = []
    cameras = []
    for entry in report["cameras"]:
        number = entry["camera"]
        made = _camera_charts(session, entry, str(number) if many else "")
        charts += made
        name = f"Camera {session.given.cameras[number]}" if many else "How well it fits, and where"
        cameras.append(
            _section(f"camera{number}", name, "<div class='grid'>" + "".join(map(chart_html, made)) + "</div>")
        )
    boards = [
        chart
        for n, board in result.boards.items()
        if (
            chart := calib_charts.board_shape(
                board, session.given.targets[n].name if session.given.targets else "", str(n)
            )
        )
    ]
    charts += boards
    choice = _choice(report["models"])
    if boards or choice:
        inner = "<div class='grid tables'>" + "".join(map(chart_html, boards)) + choice + "</div>"
        cameras.append(_section("model", "Model and target", inner))
    main = fill(
        "calibration.html",
        {
            "verdict": "".join(
                _verdict(v, f"Camera {session.given.cameras[n]}" if many else "", _next(session, n, v))
                for n, v in verdicts.items()
            ),
            "cameras": "".join(cameras),
            "straight": _straight(session),
            "lost": _lost(session),
            "records": _views(session) + _facts(session),
        },
    )
    first = verdicts[next(iter(verdicts))]
    return whole_page("Pipefish calibration", title, first["text"], main, charts, _tiles(session, first))


def _section(key: str, title: str, inner: str) -> str:
    return f"<section aria-labelledby='{key}'><h2 id='{key}'>{html.escape(title)}</h2>{inner}</section>"


def _tiles(session: Session, first: dict[str, Any]) -> list[tuple[str, str, str]]:
    result, report = session.result, session.result.report
    tiles = []
    pipe = next((p for p in first["pipes"] if p["dn_mm"] == 300), None)
    if pipe and pipe["systematic_mm"] is not None:
        tiles.append((f"± {pipe['systematic_mm']:.2g}", "mm", "on the mean diameter of a DN 300 (95 %)"))
    tiles.append((f"{result.rms:.3f}", "px", f"rms of {report['points_used']} points"))
    if session.held_out:
        tiles.append((f"{session.held_out[0]:.3f}", "px", "rms of views held out"))
    used = sum(v["used"] for v in report["views"])
    of = max(len(report["views"]), len(session.given.pictures))
    tiles.append((str(used), f"of {of}", "views used"))
    tiles.append(
        (f"{2 * math.degrees(result.camera.theta_covered or 0):.0f}", "deg", "field that the target was seen in")
    )
    if result.board.shape != "flat":
        tiles.append((f"{result.board.warp_mm:.2f}", "mm", "bend of the target, taken out"))
    return tiles


def _next(session: Session, number: int, v: dict[str, Any]) -> str:
    """What to do with it, and what it stands on."""
    entry = next(e for e in session.result.report["cameras"] if e["camera"] == number)
    advice = entry["coverage"]["advice"]
    steps = [f"To make it better: {advice}"] if advice else []
    if v["usable"]:
        steps.insert(0, "Put it on the crawler: pipefish flash DEVICE PROFILE. Freeze focus and zoom as they are now")
    steps.append(f"Scale: {scale_text(session.given.targets)}")
    return "".join(f"<li class='step'>{html.escape(text)}.</li>" for text in steps)


def _verdict(v: dict[str, Any], name: str, steps: str) -> str:
    def points(items: Iterable[str], kind: str) -> str:
        return "".join(f"<li class='{kind}'>{html.escape(t[:1].upper() + t[1:])}.</li>" for t in items)

    rows = [
        (
            "",
            (
                f"DN {p['dn_mm']}",
                "-" if p["systematic_mm"] is None else f"± {p['systematic_mm']:.2f} mm",
                "-" if p["share"] is None else f"{100 * p['share']:.2f} %",
                "yes" if p["usable"] else "no",
            ),
        )
        for p in v["pipes"]
    ]
    table = _table(("pipe", "off by (95 %)", "share", "usable"), rows)
    badge = "good" if v["usable"] and not v["cautions"] else "fair" if v["usable"] else "bad"
    word = {"good": "usable", "fair": "usable, with care", "bad": "not usable"}[badge]
    return (
        "<div class='grid tables below'>"
        f"<section class='card'><h3><span class='badge {badge}'>{word}</span> {html.escape(name)}</h3>"
        f"<p>{html.escape(v['text'])}</p>"
        f"<ul class='why'>{points(v['cautions'], 'caution')}{points(v['reasons'], 'plus')}</ul>"
        f"<h3 class='below'>What to do now</h3><ul class='why'>{steps}</ul></section>"
        f"<section class='card'><h3>What the calibration alone puts a diameter off by</h3>{table}"
        "<p class='note'>Mean diameter from wall points seen near 30 and near 80 degrees off the axis, or as far as "
        f"the target was seen; {100 * v['allowed_share']:g} % is allowed. 0.1 % is in it for what no set of views "
        "tells. Tracking and the crawler's motion come on top.</p></section></div>"
    )


def _camera_charts(session: Session, entry: dict[str, Any], key: str) -> list[Chart]:
    camera = session.result.cameras[entry["camera"]]
    covered = camera.theta_covered or camera.theta_max
    residuals = calib_charts.Residuals.of(session.result.report, entry["camera"])
    return [
        calib_charts.residual_field(residuals, camera, key),
        calib_charts.residual_theta(residuals, entry["noise"], key),
        calib_charts.coverage(entry["coverage"], key),
        calib_charts.uncertainty(entry["uncertainty"], camera, key),
        calib_charts.radial(camera, covered, key),
    ]


def _table(head: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """rows: (class, cells)."""
    top = "".join(f"<th scope='col'>{html.escape(h)}</th>" for h in head)
    body = "".join(
        f"<tr class='{kind}'>" + "".join(f"<td>{html.escape(c)}</td>" for c in cells) + "</tr>" for kind, cells in rows
    )
    return (
        f"<div class='scroll'><table class='columns'><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _choice(models: list[dict[str, Any]]) -> str:
    """The table of the models that were tried; "" where the user asked for one."""
    if len(models) < 2:
        return ""
    head = ("lens + shape of the target", "result", "parameters", "fitted, px", "held out, px", "gain", "against")
    last = max(i for i, m in enumerate(models) if m["accepted"])
    rows = []
    for i, m in enumerate(models):
        held_out = f"{m['held_out_rms_px']:.4f}" if math.isfinite(m["held_out_rms_px"]) else "failed"
        cells = (
            m["model"],
            "chosen" if i == last else "step" if m["accepted"] else "",
            f"{m['camera_parameters']} + {m['board_parameters']}",
            f"{m['train_rms_px']:.4f}",
            held_out,
            f"{100 * m['gain']:+.1f} %" if m.get("against") else "",
            m.get("against", ""),
        )
        rows.append(("taken" if m["accepted"] else "", cells))
    text = (
        "A fifth of the views at a time was held out: camera and target frozen, their poses refitted. A model is "
        "accepted where nine of ten resamplings of the views gain by it; fewer parameters win a draw. p9 is a lens "
        "that is the same all around, p23, cpoly2 and cpoly3 are not; e1: its pupil moves with the angle; bend and "
        "z..: the target's own shape, by degree; saddle: corners that the pictures' light shifts."
    )
    note = f"<p class='note'>{text}</p>"
    return (
        f"<details class='card full'><summary><h3>Choice of the model: {html.escape(models[last]['model'])} of "
        f"{len(models)} tried</h3></summary>{note}{_table(head, rows)}</details>"
    )


def _figure(picture: Image.Image, alt: str, caption: str, quality: int = 82) -> str:
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=quality, optimize=True)
    return (
        f"<figure class='card picture'><img src='{data_uri(out.getvalue(), 'image/jpeg')}' "
        f"alt='{html.escape(alt, quote=True)}'><figcaption>{html.escape(caption)}</figcaption></figure>"
    )


# ---------------------------------------------------------------------- what was left out


def _lost(session: Session) -> str:
    """Rejected views and points, with reasons and pictures."""
    report, views = session.result.report, session.views
    figures = []
    for r in report["rejected_views"][:_MOST_LOST]:
        view = views[r["view"]]
        figures.append(
            _view_figure(session, r["view"], f"{session.given.label(view.camera, view.name)}: {r['reason']}.")
        )
    for s in session.unseen[: max(0, _MOST_LOST - len(figures))]:
        image = s.picture.image()
        size = (image.shape[1], image.shape[0])
        picture = calib_draw.with_points(image, size, [(s.pixels, calib_draw.BAD)], _THUMB)
        label = session.given.label(s.picture.camera, s.picture.name)
        figures.append(_figure(picture, f"Picture {label}, left out", f"{label}: {s.reason or 'no target found'}."))
    more = len(report["rejected_views"]) + len(session.unseen) - len(figures)
    points = _lost_points(session)
    if not figures and not points:
        return ""
    text = f"<p class='note'>and {more} more; the table below has them all.</p>" if more > 0 else ""
    inner = f"<div class='grid thumbs'>{''.join(figures)}</div>{text}" if figures else ""
    return _section("lost", "What was left out, and why", inner + points)


def _view_figure(session: Session, view: int, caption: str) -> str:
    v = session.views[view]
    source = session.picture_of(view)
    picture = calib_draw.with_points(
        source.image() if source else None, session.given.sizes[v.camera], [(v.pixels, calib_draw.BAD)], _THUMB
    )
    return _figure(picture, f"View {v.name} with the points found", caption)


def _lost_points(session: Session) -> str:
    """Single points that do not fit: how many in which view, the worst ones enlarged."""
    report = session.result.report
    lost = report["rejected_points"]
    if not lost:
        return ""
    r = report["residuals"]
    first = np.concatenate([[0], np.cumsum([len(v.pixels) for v in session.views])])
    figures = []
    for p in sorted(lost, key=lambda p: -p["error_px"]):
        source = session.picture_of(p["view"])
        if source is None or len(figures) == _MOST_POINTS:
            break
        measured = np.array(p["pixel"])
        model = measured - np.array(r["residual"][first[p["view"]] + p["point"]])
        figures.append(
            _figure(
                calib_draw.close_up(source.image(), measured, model),
                f"Close-up of a point left out of {source.name}",
                f"{session.given.label(source.camera, source.name)}, point {p['point']}: {p['reason']}.",
                90,
            )
        )
    share = 100 * len(lost) / max(1, report["points"])
    pictures = (
        "<p class='note'>The worst: the cross is where it was measured, the circle where the model has it.</p>"
        f"<div class='grid small'>{''.join(figures)}</div>"
        if figures
        else ""
    )
    which = f"{len(lost)} single points lie" if len(lost) > 1 else "One single point lies"
    return (
        f"<p>{which} ({share:.1f} % of {report['points']}) so far off that noise does not explain it: blur, glare, or "
        f"something in front of the target.</p>{pictures}"
    )


# ---------------------------------------------------------------------- straight lines


def _straight(session: Session) -> str:
    """Views on the faces of a cube, where straight lines are straight."""
    figures = []
    report = session.result.report
    for number in session.result.cameras:
        mine = [v for v in report["views"] if v["used"] and v["camera"] == number and session.picture_of(v["view"])]
        if not mine:
            continue
        widest = sorted(mine, key=lambda v: -v["theta_max"] * v["points"] ** 0.5)[:_CUBES]
        figures += [_cube(session, v["view"], number) for v in widest]
    if not figures:
        return ""
    inner = (
        "<p>A view on the faces of a cube around the camera: front in the middle, up, down, left and right beside "
        "it. On "
        "each face straight lines of the world must be straight; the thin lines are drawn from end to end of the "
        f"target's rows and columns.</p><div class='grid wide'>{''.join(figures)}</div>"
    )
    return _section("straight", "Straight lines are straight", inner)


def _cube(session: Session, view: int, number: int) -> str:
    v, camera = session.views[view], session.result.cameras[number]
    source = session.picture_of(view)
    assert source is not None
    distance = float(
        session.result.report["cameras"][list(session.result.cameras).index(number)]["uncertainty"]["distance_m"]
    )
    made = calib_draw.cube(
        camera, source.image(), v.pixels, calib_draw.rows_and_columns(v.board_xyz), _CUBE_EDGE, distance
    )
    off = (
        f" {made.lines} rows and columns of the target are straight within {made.off_px:.2f} px rms."
        if made.off_px
        else ""
    )
    name = session.given.label(v.camera, v.name)
    box = made.picture.convert("L").point(lambda grey: 255 * (grey > _DARK)).getbbox()
    return _figure(made.picture.crop(box), f"View {name} on the faces of a cube", f"{name}.{off}")


# ---------------------------------------------------------------------- on record


def _views(session: Session) -> str:
    rows: list[tuple[str, Sequence[str]]] = []
    report = session.result.report
    added = {(s.picture.name, s.picture.camera, s.board): s.added for s in session.sightings}
    many = len(session.given.targets) > 1
    for v in report["views"]:
        more = added.get((v["name"], v["camera"], v["board"]), 0)
        rows.append(
            (
                "",
                (
                    session.given.label(v["camera"], v["name"] or str(v["view"]))
                    + (f", {session.given.targets[v['board']].name}" if many else ""),
                    f"{v['points']}" + (f" ({more} by the model)" if more else ""),
                    "-" if v["rms_px"] is None else f"{v['rms_px']:.3f}",
                    f"{math.degrees(v['theta_max']):.0f}",
                    v["reason"] or ("mirrored" if v["mirrored"] else ""),
                ),
            )
        )
    for s in session.unseen:
        label = session.given.label(s.picture.camera, s.picture.name)
        rows.append(("", (label, "0", "-", "-", s.reason or "no target found")))
    for camera, name, first in session.given.copies:
        rows.append(("", (session.given.label(camera, name), "-", "-", "-", f"is the same picture as {first}")))
    table = _table(("view", "points", "rms, px", "farthest, deg", "left out because"), rows)
    return f"<details class='card'><summary><h3>All {len(rows)} views</h3></summary>{table}</details>"


def _facts(session: Session) -> str:
    result, report = session.result, session.result.report
    cards = []
    for n, camera in result.cameras.items():
        rows: list[tuple[str, str]] = [
            ("picture", f"{camera.width} x {camera.height}"),
            ("model", result.model),
            ("focal length", f"{camera.f_u:.3f}, {camera.f_v:.3f} px/rad"),
            ("principal point", f"{camera.c_u:.3f}, {camera.c_v:.3f} px"),
            ("k2 .. k5", ", ".join(f"{k:.6g}" for k in (camera.k2, camera.k3, camera.k4, camera.k5))),
            ("field", f"{math.degrees(camera.theta_max):.1f} deg off the axis"),
            ("pupil shift", f"{camera.pupil_e1 * 1e3:.3f} mm per rad²" if camera.pupil_e1 else "none"),
            ("serial", camera.serial or "-"),
            ("rms", f"{camera.rms_px:.4f} px; {report['flat_board']['rms_px']:.4f} px with p9 and a flat target"),
        ]
        board = _LEVELS.get(result.board.shape)
        if board:
            rows.append(("shape of the target", f"{board}; {result.board.warp_mm:.2f} mm"))
        halves = report["cameras"][list(result.cameras).index(n)].get("halves")
        if halves:
            text = f"differ by {halves['rms_px']:.3f} px, {halves['expected_px']:.3f} px expected of noise"
            rows.append(("two halves of the views", text))
        if n in result.camera_poses and len(result.cameras) > 1:
            place = result.camera_poses[n]
            rows.append(("place in the rig", ", ".join(f"{x * 1e3:.2f}" for x in place[:, 3]) + " mm"))
        body = "".join(f"<tr><th scope='row'>{html.escape(a)}</th><td>{html.escape(b)}</td></tr>" for a, b in rows)
        name = session.given.cameras[n] if len(result.cameras) > 1 else "The camera"
        cards.append(f"<section class='card'><h3>{html.escape(name)}</h3><table>{body}</table></section>")
    if report["notes"]:
        notes = "".join(f"<li>{html.escape(t)}</li>" for t in report["notes"])
        cards.append(f"<section class='card'><h3>Notes</h3><ul class='why'>{notes}</ul></section>")
    return f"<div class='grid tables below'>{''.join(cards)}</div>"
