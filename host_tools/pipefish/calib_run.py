"""A whole calibration from pictures: find the target, calibrate, look again with the model for what was missed."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .calib_circle import ImageEllipse, find_image_ellipse
from .calib_data import CalibrationError, View
from .calib_input import Given, Picture, Target3D
from .calib_settle import missed_share, settle
from .calib_size import refuse_other_size
from .calibration import Calibration, calibrate
from .detect import Detection, detect_target

Tell = Callable[[str, float], None]

_FOLDS = 5
_ROUNDS = 3  # of looking again; each starts from the model that the one before made better
_RIM = 1.1  # of what is lit: a point beyond is a wrong one, or the rim is
_LOOK = 10  # pictures, taken evenly from all: enough to see a target of another size
_GIVE_UP = 40  # pictures, likewise, without the target
_GOLDEN = 0.6180339887498949  # its multiples modulo 1 are spread evenly at any moment
_ENOUGH = 0.01  # of the points: fewer new ones are not worth another round
_BESIDE_PX = 2.0  # a point of the model-guided search that stands so far from one seen before is not the same one


@dataclasses.dataclass(eq=False)
class Sighting:
    """One target looked for in one picture. added: how many of the points only the model-guided search found."""

    picture: Picture
    board: int
    ids: npt.NDArray[np.int64]
    pixels: npt.NDArray[np.float64]
    status: str
    reason: str
    seen: tuple[int, int] = (0, 0)  # Detection.seen
    added: int = 0

    @property
    def usable(self) -> bool:
        """Whether a calibration can take it: which points they are is known, and they are enough."""
        return self.status in ("ok", "partial") and len(self.ids) >= 4


@dataclasses.dataclass(eq=False)
class Session:
    """A calibration with all that it came from. views: as calibrated; sightings: of pictures, [] for corner files.

    held_out: (pixels rms, views) of views that the camera was not calibrated from, None where there are too few."""

    given: Given
    sightings: list[Sighting]
    views: list[View]
    result: Calibration
    held_out: tuple[float, int] | None

    @property
    def unseen(self) -> list[Sighting]:
        """Pictures in which no target could be used, with the reason."""
        seen = {s.picture for s in self.sightings if s.usable}
        first: dict[Picture, Sighting] = {}
        for s in self.sightings:
            if s.picture not in seen:
                first.setdefault(s.picture, s)
        return list(first.values())

    def picture_of(self, view: int) -> Picture | None:
        """The picture of a view, where there is one."""
        v = self.views[view]
        return next((p for p in self.given.pictures if p.name == v.name and p.camera == v.camera), None)


def run(given: Given, *, model: str, board: str, noise: str = "", robust: bool = True, tell: Tell) -> Session:
    """Calibrates what is given. model, board, noise, robust: of `calibrate`. tell: what is being done, its share.

    Raises CalibrationError, FormatError, OSError."""
    sightings: list[Sighting] = []
    options: dict[str, Any] = {
        "image_size": given.sizes,
        "board": board,
        "circle_radius": one_radius(given.targets),
        "noise": noise,
        "robust": robust,
    }
    views = given.views
    if not views:
        brightest: dict[int, npt.NDArray[np.uint8]] = {}
        sightings = search(given, brightest, lambda share: tell("finding the target", 0.5 * share))
        views = views_of(given, sightings)
        _refuse_other_size(given, sightings)
        refuse_too_few(given, sightings)
        refuse_wrong_size(given, sightings)
        options["image_circle"] = {
            c: lit for c, image in brightest.items() if (lit := lit_around(image, [v for v in views if v.camera == c]))
        }
        for turn in range(_ROUNDS):
            tell("first model", 0.5 + 0.1 * turn)
            first = calibrate(views, model="p9", **options)
            added = look_again(given, sightings, views, first, lambda s, t=turn: tell("missed points", 0.52 + 0.1 * t))
            added += settle_all(given, sightings, first, lambda s, t=turn: tell("places", 0.58 + 0.1 * t))
            views = views_of(given, sightings)
            if added < _ENOUGH * sum(len(v.pixels) for v in views):
                break
    result = calibrate(views, model=model, progress=lambda what, share: tell(what, 0.8 + 0.15 * share), **options)
    tell("held-out views", 0.96)
    return Session(given, sightings, views, result, _held_out(views, result, model, options))


def one_radius(targets: Sequence[Target3D]) -> float:
    """The radius of the targets' discs, metres; 0 for corners. Raises CalibrationError where they differ."""
    radii = sorted({t.radius for t in targets}) or [0.0]
    if len(radii) > 1:
        raise CalibrationError("targets of one run must be alike: all of corners, or all of discs of one radius")
    return radii[0]


def search(given: Given, brightest: dict[int, npt.NDArray[np.uint8]], share: Callable[[float], None]) -> list[Sighting]:
    """Every target in every picture; `brightest` gets the largest value of each pixel, by camera.

    Raises CalibrationError where pictures of two cameras are mixed, and where many show no target."""
    if not all(t.target for t in given.targets) or not given.targets:
        raise CalibrationError("pictures need a --target that can be found in them: a JSON file of `pipefish target`")
    sightings: list[Sighting] = []
    count = len(given.pictures)
    # In an order that is spread over all at any moment: a target that is not the one described costs the most time a
    # picture, and is known after a few.
    for done, i in enumerate(sorted(range(count), key=lambda i: i * _GOLDEN % 1.0)):
        picture = given.pictures[i]
        share(done / count)
        if done in (_LOOK, _GIVE_UP):
            _refuse_other_size(given, sightings, least=done // 2)
        if done == _GIVE_UP and all(s.status == "none" for s in sightings):
            raise CalibrationError(
                f"the target was found in none of {done} pictures, taken evenly from all {count} "
                f"({sightings[0].picture.name}: {sightings[0].reason}). Is it the one that --target describes? If "
                "few pictures show it, give only those"
            )
        image = picture.image()
        size, first = (image.shape[1], image.shape[0]), given.sizes[picture.camera]
        if size != first:
            raise CalibrationError(
                f"{picture.place}: {size[0]} x {size[1]} pixels, the first picture has {first[0]} x {first[1]}: "
                "images of two cameras, or of two settings of one, are mixed"
            )
        brightest[picture.camera] = np.maximum(brightest.get(picture.camera, image), image)
        for board, target in enumerate(given.targets):
            assert target.target is not None
            sightings.append(_sighting(picture, board, detect_target(image, target.target)))
    place = {picture: i for i, picture in enumerate(given.pictures)}
    return sorted(sightings, key=lambda s: (place[s.picture], s.board))


def _refuse_other_size(given: Given, sightings: Sequence[Sighting], least: int = 3) -> None:
    if len(given.targets) == 1:
        refuse_other_size(given.targets[0].target, [s.seen for s in sightings], given.targets[0].name, least)


def lit_around(brightest: npt.NDArray[np.uint8], views: Sequence[View]) -> ImageEllipse | None:
    """What the lens lights, with the points of the views inside; None where it is the whole sensor, or where one point
    of a hundred lies so far out that it cannot be."""
    lit = find_image_ellipse([brightest])
    if lit is None:
        return None
    radii = np.concatenate([lit.radii(view.pixels) for view in views])
    if (radii > _RIM).mean() > 0.01:
        return None
    farthest = float(radii[radii <= _RIM].max())
    grown = max(1.0, farthest + 2.0 / min(lit.a, lit.b)) if farthest > 1 else 1.0
    return dataclasses.replace(lit, a=lit.a * grown, b=lit.b * grown)


def _sighting(picture: Picture, board: int, found: Detection) -> Sighting:
    return Sighting(picture, board, found.ids, found.pixels, found.status, found.reason, found.seen)


def views_of(given: Given, sightings: Sequence[Sighting]) -> list[View]:
    """The views that sightings make."""
    return [
        View(given.targets[s.board].points[s.ids], s.pixels, s.board, s.picture.camera, s.picture.name)
        for s in sightings
        if s.usable
    ]


def refuse_too_few(given: Given, sightings: Sequence[Sighting]) -> None:
    """Raises CalibrationError with what the pictures lack."""
    for camera, name in enumerate(given.cameras):
        mine = [s for s in sightings if s.picture.camera == camera]
        seen = {s.picture for s in mine if s.usable}
        if len(seen) >= 3:
            continue
        pictures = len({s.picture for s in mine})
        who = f"camera {name}: " if len(given.cameras) > 1 else ""
        failed = [s for s in mine if not s.usable]
        reasons = Counter(s.reason or "not found" for s in failed)
        why = f" ({failed[0].picture.name}: {failed[0].reason})" if failed else ""
        most = f"; most often: {reasons.most_common(1)[0][0]}" if len(reasons) > 1 else ""
        ask = (
            ". Is it the target that --target describes? Sharp, evenly lit, with its white margin in view?"
            if not seen
            else ""
        )
        raise CalibrationError(
            f"{who}the target was found in {len(seen)} of {pictures} pictures; at least 3 are needed, better "
            f"15{why}{most}"
            f"{ask}"
        )


def refuse_wrong_size(given: Given, sightings: Sequence[Sighting]) -> None:
    """Raises CalibrationError where most pictures show all of a target but one outer row, and none shows half of that:
    the target has a row less than was said, and what was found of it is no target. It would look calibrated."""
    for board, target in enumerate(given.targets):
        if target.target is not None and target.target.kind in ("charuco", "sleeve"):
            continue  # marks tell which points are seen: a row may be covered
        xy = np.round(target.points[:, :2], 9)
        mine = [set(s.ids.tolist()) for s in sightings if s.board == board and s.usable]
        for axis, what in ((1, "row"), (0, "column")):
            for end in (xy[:, axis].min(), xy[:, axis].max()):
                line = set(np.flatnonzero(xy[:, axis] == end).tolist())
                rest = set(range(len(xy))) - line
                whole = sum(rest <= seen for seen in mine)
                if len(mine) >= 3 and 2 * whole >= len(mine) and all(2 * len(seen & line) < len(line) for seen in mine):
                    raise CalibrationError(
                        f"the target has a {what} of points less than --target says: {whole} of {len(mine)} pictures "
                        f"show all of it but an outer {what}, and none shows half of that"
                    )


def look_again(
    given: Given, sightings: list[Sighting], views: list[View], first: Calibration, share: Callable[[float], None]
) -> int:
    """Looks with a first model for the points that a picture alone did not show; -> how many were added."""
    used = [s for s in sightings if s.usable]
    added = 0
    for done, (sighting, pose) in enumerate(zip(used, first.poses, strict=True)):
        share(done / len(used))
        target = given.targets[sighting.board]
        missed = len(target.points) - len(sighting.ids)
        if not missed or not np.isfinite(pose).all():
            continue
        camera = first.cameras[sighting.picture.camera]
        found = detect_target(sighting.picture.image(), target.target, camera, np.ascontiguousarray(pose))
        new = ~np.isin(found.ids, sighting.ids)
        both, ours, theirs = np.intersect1d(sighting.ids, found.ids, return_indices=True)
        apart = np.linalg.norm(sighting.pixels[ours] - found.pixels[theirs], axis=1)
        if not new.any() or (len(both) and np.median(apart) > _BESIDE_PX):
            continue  # the model is not there yet: it finds other points
        order = np.argsort(np.concatenate([sighting.ids, found.ids[new]]))
        sighting.ids = np.concatenate([sighting.ids, found.ids[new]])[order]
        sighting.pixels = np.concatenate([sighting.pixels, found.pixels[new]])[order]
        sighting.added += int(new.sum())
        added += int(new.sum())
    return added


def settle_all(given: Given, sightings: list[Sighting], first: Calibration, share: Callable[[float], None]) -> int:
    """Settles ambiguous pictures by a first model; -> how many points that gave. Pictures of a rig or of several
    targets are left: their places must go together."""
    open_ = [s for s in sightings if s.status == "ambiguous"]
    target = given.targets[0].target
    if not open_ or target is None or len(given.cameras) > 1 or len(given.targets) > 1:
        return 0
    odds = missed_share(first, views_of(given, sightings), given.targets)
    added = 0
    for done, s in enumerate(open_):
        share(done / len(open_))
        found, why = settle(s.picture.image(), target, s.ids, s.pixels, first, *odds)
        if found is None:
            s.reason = why
            continue
        s.ids, s.pixels, s.status, s.reason = found.ids, found.pixels, "partial", ""
        s.added = len(found.ids)
        added += len(found.ids)
    return added


def _held_out(views: list[View], result: Calibration, model: str, options: dict[str, Any]) -> tuple[float, int] | None:
    """RMS over views that the camera was not calibrated from. The choice of a model has measured it already."""
    report = result.report
    used = [v["view"] for v in report["views"] if v["used"]]
    row = next((r for r in reversed(report["models"]) if r["accepted"]), None)
    if row is not None and row["model"] == report["model"]:
        return float(row["held_out_rms_px"]), len(used)
    moments = sorted({views[v].name or str(v) for v in used})
    if len(moments) < 6 or model == "auto":
        return None
    fine = np.array(report["residuals"]["used"])
    first = np.concatenate([[0], np.cumsum([len(v.pixels) for v in views])])
    squares: list[npt.NDArray[np.float64]] = []
    for fold in range(_FOLDS):
        out = [v for v in used if moments.index(views[v].name or str(v)) % _FOLDS == fold]
        try:
            part = calibrate([views[v] for v in used if v not in out], model=model, **options)
            error, _ = part.residuals([views[v] for v in out])
        except CalibrationError:  # the rest says too little
            return None
        keep = np.concatenate([fine[first[v] : first[v + 1]] for v in out])
        squares.append((error[keep] ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean())), len(used)
