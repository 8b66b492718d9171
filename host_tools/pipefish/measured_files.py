"""What `pipefish reconstruct` writes: tables, point clouds, a COLMAP text model, and one JSON document with everything.
docs/reconstruction.md tells each file and column."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from pipefish import __version__
from pipefish.assumed import assumed_px
from pipefish.camera import Camera
from pipefish.cloudfile import ply_bytes
from pipefish.colours import diverging
from pipefish.errors import ProfileError
from pipefish.files import csv_bytes, plain, write_atomically
from pipefish.measure import Tell
from pipefish.measured_reach import reach
from pipefish.measured_remarks import not_measured, trend
from pipefish.measured_texts import FORMAT, VERSION
from pipefish.measurement import Measurement, Stretch, mean_diameter
from pipefish.pupil import pupil_is_known
from pipefish.simulate import quaternion
from pipefish.tube_findings import COLUMNS
from pipefish.tube_stations import rms_ovality

RING = 72  # vertices of tube.ply around the pipe
COLMAP_THETA = math.radians(89)  # its functions divide by z
COLMAP_ERROR_PX = 0.1
COLOUR_SPAN = 0.03  # of the diameter: full colour of a deviation in the point clouds
CENTRELINE = ("s", "x", "y", "z", "tx", "ty", "tz", "centre_sigma", "curvature", "curvature_sigma")


def stations(m: Measurement) -> dict[str, np.ndarray]:
    """The stations of all stretches by column, `stretch` and `chainage` first."""
    tables = []
    for stretch in m.measured:
        table = stretch.tube.stations
        count = len(table["s"])
        head = {"stretch": np.full(count, stretch.segment), "chainage": stretch.chainage(table["s"])}
        tables.append(head | table)
    return {name: np.concatenate([t[name] for t in tables]) for name in tables[0]}


def events(m: Measurement) -> list[dict[str, Any]]:
    """Findings of all stretches and what was not measured (kind "not_measured"), by chainage."""
    found: list[dict[str, Any]] = []
    for stretch in m.measured:
        for event in stretch.tube.events:
            row = {"kind": event["kind"], "stretch": stretch.segment, "chainage": float(stretch.chainage(event["s"]))}
            row |= {k: v for k, v in event.items() if k != "kind"}
            if "start" in event:
                ends = sorted(float(stretch.chainage(event[name])) for name in ("start", "end"))
                row |= {"start": ends[0], "end": ends[1]}
            found.append(row)
    for gap in not_measured(m):
        found.append({"kind": "not_measured", "chainage": gap["start"], **gap})
    return sorted(found, key=lambda e: (e["chainage"] is None, e["chainage"] or 0.0))


def _events_csv(rows: list[dict[str, Any]]) -> bytes:
    names = ["kind", "chainage", "stretch", *COLUMNS[1:], "reason", "detail"]
    return csv_bytes({name: [row.get(name) for row in rows] for name in names})


def summary(m: Measurement) -> dict[str, Any]:
    """The figures that come first: diameter, ovality, lengths. Lengths in the unit of the scale."""
    table = stations(m)
    d, oval = table["d_mean"], table["ovality"]
    value, sigma = mean_diameter(m)
    out: dict[str, Any] = {
        "unit": m.scale.unit,
        "diameter_from_prior": m.scale.diameter_from_prior,
        "d_mean": value,
        "d_mean_sigma": sigma,
        "d_mean_systematic": m.systematic * value,
        "d_mean_least": float(np.nanmin(d)),
        "d_mean_most": float(np.nanmax(d)),
        "station_sigma": float(np.nanmedian(table["d_mean_sigma"])),
        "station_systematic": float(np.nanmedian(table["d_mean_systematic"])),
        "station_systematic_most": float(np.nanmax(table["d_mean_systematic"])),
        "systematic": {
            "relative": m.systematic,
            "scale": m.scale.sigma,
            "camera": m.camera_sigma,
            "pupil": m.pupil_sigma,
        },
        "nominal": m.nominal,
        "path_length": m.structure.length,
        "tube_length": float(sum(s.tube.length for s in m.measured)),
        "stations": len(d),
        "stations_measured": int(np.isfinite(d).sum()),
        "stations_with_ovality": int(np.isfinite(oval).sum()),
        "keyframes": len(m.index),
        "keyframes_with_pose": len(m.structure.frames),
        "points": len(m.structure.points),
        "stretches": len(m.measured),
        "events": sum(len(s.tube.events) for s in m.measured),
        "not_measured": len(not_measured(m)),
    }
    if np.isfinite(oval).any():
        worst = int(np.nanargmax(oval))
        out |= {
            "d_max": float(np.nanmax(table["d_max"])),
            "d_min": float(np.nanmin(table["d_min"])),
            "ovality_rms": rms_ovality(table),
            "ovality_most": float(oval[worst]),
            "ovality_most_at": float(table["chainage"][worst]),
            "ovality_sigma": float(np.nanmedian(table["ovality_sigma"])),
            "ovality_systematic": float(np.nanmedian(table["ovality_systematic"])),
        }
    return out


def encoder_against_vision(m: Measurement) -> dict[str, Any] | None:
    """Per keyframe: chainage by the encoder; how much further the camera's path is, from the stretch's start on."""
    if m.encoder is None:
        return None
    chainage, excess, stretch_of = [], [], []
    for segment in range(len(m.structure.sigma)):
        here = m.structure.segment == segment
        along = m.encoder[m.structure.frames[here]]
        steps = np.linalg.norm(np.diff(m.structure.centres[here], axis=0), axis=1)
        driven = np.append(0.0, np.cumsum(np.abs(np.diff(along))))
        chainage += along.tolist()
        excess += (np.append(0.0, np.cumsum(steps)) - driven).tolist()
        stretch_of += [segment] * int(here.sum())
    return {"chainage": chainage, "vision_minus_encoder": excess, "stretch": stretch_of}


def document_of(m: Measurement) -> dict[str, Any]:
    """The document of reconstruction.json, but for its files."""
    s = m.survey
    return plain(
        {
            "format": FORMAT,
            "version": VERSION,
            "software": f"pipefish {__version__}",
            "status": "ok" if m.structure.status == "ok" and not not_measured(m) else "partial",
            "survey": {k: s.info[k] for k in ("file", "name", "survey_id", "first_time_unix_ns", "source", "software")},
            "summary": summary(m),
            "remarks": m.remarks,
            "scale": _scale_part(m),
            "clock_zero": m.measured[0].tube.clock_zero,
            "camera": _camera_part(m.camera),
            "structure": _structure_part(m),
            "poses": _poses_part(m),
            "tubes": [_tube_part(stretch) for stretch in m.stretches],
            "stations": stations(m),
            "events": events(m),
            "not_measured": not_measured(m),
            "findings_reach": reach(m),
            "quality": _quality_part(m),
        }
    )


def _scale_part(m: Measurement) -> dict[str, Any]:
    names = ("source", "unit", "sigma", "wheel", "wheel_sigma", "sources", "consistent", "chi2", "freedom")
    return {name: getattr(m.scale, name) for name in names}


def _camera_part(camera: Camera) -> dict[str, Any]:
    """What one asks of a camera first, and its whole profile."""
    return {
        "name": camera.name,
        "serial": camera.serial,
        "model": camera.radial,
        "width": camera.width,
        "height": camera.height,
        "theta_max_deg": math.degrees(camera.theta_max),
        "rms_px": camera.rms_px,
        "pupil_e1": camera.pupil_e1,
        "pupil_known": pupil_is_known(camera),
        "covariance": camera.covariance is not None,
        "assumed_px": None if camera.covariance is not None else assumed_px(camera),
        "source": camera.source,
        "created": camera.created.isoformat() if camera.created else None,
        "profile": json.loads(camera.to_json()),
    }


def _structure_part(m: Measurement) -> dict[str, Any]:
    """How the adjustment went."""
    names = ("status", "reason", "gauge", "sigma", "variance_factor", "observations", "outside", "repeated", "down")
    gaps = [
        {"first": int(m.index[g.first]), "last": int(m.index[g.last]), "reason": g.reason, "common": g.common}
        for g in m.structure.gaps
    ]
    part = {name: getattr(m.structure, name) for name in names}
    return part | {
        "standing": m.index[m.structure.standing],
        "gaps": gaps,
        "backwards": m.backwards,
        "pupil_e1": m.structure.pupil,
    }


def _poses_part(m: Measurement) -> dict[str, Any]:
    """Of each keyframe that has one: x_camera = R x + t, by quaternion w x y z; where the camera was."""
    s = m.structure
    variance = np.trace(s.pose_covariance[:, 3:, 3:], axis1=1, axis2=2)
    return {
        "keyframe": m.index[s.frames],
        "stretch": s.segment,
        "chainage": m.frame_chainage(),
        "quaternion": [quaternion(p[:, :3]) for p in s.poses],
        "translation": s.poses[:, :, 3],
        "centre": s.centres,
        "centre_sigma": np.sqrt(np.maximum(0, variance)),
    }


def _tube_part(x: Stretch) -> dict[str, Any]:
    return {
        "stretch": x.segment,
        "status": x.tube.status,
        "reason": x.tube.reason,
        "chainage_at_start": x.origin,
        "chainage_sign": x.sign,
        "summary": x.tube.summary,
        "water": x.water,
    }


def _quality_part(m: Measurement) -> dict[str, Any]:
    """Residuals, the encoder against the pictures, and whether the profile still holds."""
    residuals = m.residuals
    return {
        "residuals_by_angle": trend(residuals, m.camera, m.tracks),
        "residual_rms_px": float(np.sqrt(np.mean(residuals.pixels[residuals.inlier] ** 2))),
        "residuals_over_noise": residuals.spread,
        "observations": len(residuals.item),
        "outliers": int((~residuals.inlier).sum()),
        "encoder": encoder_against_vision(m),
        "profile": m.health.as_dict() if m.health else None,
    }


def _colours(deviation: np.ndarray, diameter: float) -> dict[str, np.ndarray]:
    rgb = diverging(np.clip(deviation / (COLOUR_SPAN * diameter), -1, 1))
    return dict(zip(("red", "green", "blue"), rgb.T, strict=True))


def points_ply(m: Measurement) -> bytes:
    """All points with sigma (that of the longest axis of its covariance), track, place on the tube and distance from it
    (NaN for those of no tube, and for what water mirrors)."""
    structure, size = m.structure, mean_diameter(m)[0]
    values = {name: np.full(len(structure.points), np.nan) for name in ("chainage", "clock", "distance")}
    for stretch in m.measured:
        inside = structure.point_segment == stretch.segment
        place = stretch.tube.project(structure.points[inside])
        values["chainage"][inside] = stretch.chainage(place["s"])
        values["clock"][inside], values["distance"][inside] = place["clock"], place["distance"]
        for column in values.values():
            column[np.flatnonzero(inside)[~stretch.tube.points["known"]]] = np.nan
    sigma = np.sqrt(np.maximum(0, np.linalg.eigvalsh(structure.covariance)[:, -1]))
    columns = dict(zip("xyz", structure.points.T, strict=True))
    columns |= {"sigma": sigma, **values}
    columns = {name: v.astype(np.float32) for name, v in columns.items()}
    columns |= _colours(np.nan_to_num(values["distance"]), size)
    columns["track"] = structure.track.astype(np.int32)
    return ply_bytes(columns, None, (f"unit: {m.scale.unit}",))


def tube_ply(m: Measurement) -> bytes:
    """The wall: rings of RING vertices; deviation: radius less half of the nominal (or mean) diameter."""
    columns, faces = wall_columns(m)
    size = reference_diameter(m)
    comments = (f"unit: {m.scale.unit}", f"rings of {RING} vertices", f"deviation from a radius of {size / 2:.6g}")
    return ply_bytes(columns, faces, comments)


def reference_diameter(m: Measurement) -> float:
    """What deviations are against: the nominal diameter, or the mean where there is none or no scale."""
    return m.nominal if m.nominal and m.scale.unit == "metre" else mean_diameter(m)[0]


def wall_columns(m: Measurement) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Vertices of the wall by column, and triangles (M,3)."""
    vertices, faces, pieces, rows = [], [], [], 0
    along, stretches = [], []
    size = reference_diameter(m)
    for stretch in m.measured:
        points, triangles = stretch.tube.mesh(around=RING)
        rings = points.reshape(-1, RING, 3)
        deviation = np.linalg.norm(rings - rings.mean(axis=1, keepdims=True), axis=2) - size / 2
        vertices.append(np.column_stack([points, deviation.ravel()]))
        faces.append(triangles + rows)
        along.append(np.repeat(stretch.chainage(np.concatenate(stretch.tube.ring_places())), RING))
        stretches.append(np.full(len(points), stretch.segment))
        pieces.append(_piece_of(len(points), triangles) + sum(p.max() + 1 for p in pieces))
        rows += len(points)
    table = np.vstack(vertices)
    columns = dict(zip(("x", "y", "z", "deviation"), table.T.astype(np.float32), strict=True))
    columns |= _colours(table[:, 3], size)
    columns["chainage"] = np.concatenate(along).astype(np.float32)
    columns["stretch"] = np.concatenate(stretches).astype(np.int32)
    columns["piece"] = np.concatenate(pieces).astype(np.int32)
    return columns, np.vstack(faces)


def _piece_of(count: int, triangles: np.ndarray) -> np.ndarray:
    """Number of the piece of each vertex: rings that triangles join are of one piece."""
    rings = count // RING
    joined = np.zeros(rings, bool)
    joined[triangles.max(axis=1) // RING] = True  # a ring's triangles reach to the one before it
    return np.repeat(np.cumsum(~joined) - 1, RING)


def colmap_model(m: Measurement) -> tuple[dict[str, bytes], str]:
    """The files of a COLMAP text model, and a note for people: {} and the reason where its OPENCV_FISHEYE cannot hold
    the camera. Pixel (0, 0) is the corner there, not the centre."""
    from pipefish.formats.writers import Wanted, colmap

    limit = min(COLMAP_THETA, m.camera.theta_max)
    try:
        written = colmap(m.camera, Wanted(COLMAP_ERROR_PX, limit if m.camera.theta_max > COLMAP_THETA else None))
    except ProfileError as error:
        why = str(error.reason).partition("; --")[0]  # what else it says are options of another command
        return {}, f"No COLMAP model: {why}."
    keep = m.residuals.inlier & (m.residuals.theta < limit)
    frame, point, item = (v[keep] for v in (m.residuals.frame, m.residuals.point, m.residuals.item))
    error = np.linalg.norm(m.residuals.pixels[keep], axis=1)
    order = np.lexsort((point, frame))
    frame, point, item, error = frame[order], point[order], item[order], error[order]
    pixels = m.tracks.pixels[item] + 0.5
    bounds = np.searchsorted(frame, np.arange(len(m.structure.frames) + 1))
    within = np.arange(len(frame)) - bounds[frame]
    images = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
    ]
    images.append("#   POINTS2D[] as (X, Y, POINT3D_ID)")
    for k, pose in enumerate(m.structure.poses):
        number = int(m.index[m.structure.frames[k]])
        numbers = (*quaternion(pose[:, :3]), *pose[:, 3])
        images.append(f"{number + 1} {' '.join(f'{v:.12g}' for v in numbers)} 1 keyframe_{number:06d}.jpg")
        here = slice(bounds[k], bounds[k + 1])
        rows = zip(pixels[here].tolist(), point[here].tolist(), strict=True)
        images.append(" ".join(f"{x:.4f} {y:.4f} {p + 1}" for (x, y), p in rows))
    points = ["# 3D point list with one line of data per point:"]
    points.append("#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)")
    order = np.argsort(point, kind="stable")
    ends = np.searchsorted(point[order], np.arange(len(m.structure.points) + 1))
    image_id = m.index[m.structure.frames] + 1
    for p, xyz in enumerate(m.structure.points):
        here = order[ends[p] : ends[p + 1]]
        if len(here) < 2:
            continue
        track = " ".join(f"{i} {w}" for i, w in zip(image_id[frame[here]].tolist(), within[here].tolist(), strict=True))
        points.append(f"{p + 1} {' '.join(f'{v:.9g}' for v in xyz)} 128 128 128 {error[here].mean():.4f} {track}")
    held = {int(line.split(" ", 1)[0]) for line in points[2:]}
    images = [_only(line, held) if i > 2 and i % 2 == 0 else line for i, line in enumerate(images)]
    note = (
        ""
        if m.camera.theta_max <= COLMAP_THETA
        else (
            f"The COLMAP model is without observations beyond {math.degrees(limit):.0f} degrees from the axis, "
            "which COLMAP cannot "
            "hold."
        )
    )
    files = {
        "cameras.txt": written.text,
        "images.txt": "\n".join([*images, ""]),
        "points3D.txt": "\n".join([*points, ""]),
    }
    return {name: text.encode() for name, text in files.items()}, note


def _only(line: str, held: set[int]) -> str:
    """A line of POINTS2D in which points that are not in the model have the number -1."""
    words = line.split()
    words[2::3] = [w if int(w) in held else "-1" for w in words[2::3]]
    return " ".join(words)


def write_measurement(m: Measurement, folder: Path, tell: Tell | None = None) -> tuple[dict[str, Any], list[str]]:
    """Writes all files; returns the document of reconstruction.json and the files' paths. Raises OSError."""
    from pipefish.gltf import gltf_files

    model, of_model = colmap_model(m)
    document = document_of(m)
    scenes, of_scenes = gltf_files(m, document, tell)
    document["file_remarks"] = [note for note in (of_model, of_scenes) if note]  # of the files, not of the pipe
    table = stations(m)
    contents = {
        "profile.csv": csv_bytes(table),
        "centreline.csv": csv_bytes({name: table[name] for name in ("stretch", "chainage", *CENTRELINE)}),
        "events.csv": _events_csv(document["events"]),
        "points.ply": points_ply(m),
        "tube.ply": tube_ply(m),
        **scenes,
        **{f"colmap/{name}": data for name, data in model.items()},
    }
    files = [str(folder / name) for name in (*contents, "reconstruction.json")]
    document["files"] = [*contents, "reconstruction.json"]
    contents["reconstruction.json"] = json.dumps(document).encode()  # last: what is there is whole
    for name, data in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / name, data)
    return document, files
