"""The tube: from points on a pipe's wall to its axis, diameters, ovality, bends, joints and what stands in it or out.

Frames: chainage s runs along the axis. `clock` angles are radians clockwise looking along increasing s, zero at twelve
o'clock; hours = clock * 6 / pi. Lengths are metres."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipefish import _engine, tube_findings, tube_shape
from pipefish.errors import ArgumentError
from pipefish.tube_section import MEASURED, section_points
from pipefish.tube_shared import Common, Shared
from pipefish.tube_stations import blank, stations_of, summary_of

SECTION = 0.75  # length of the stretch that counts as one section, diameters
# Spacing of the spline's knots, diameters. An ellipse that grows to 4 % over 0.4 m of a DN300 is off by 0.1 points
# between knots half a diameter apart, which no sigma knows; the smoothness decides how many of them a pipe uses.
KNOT = 0.25
STATION = 0.25  # spacing of the stations, diameters
AGAINST_GRAVITY, FROM_FRAME = "against gravity", "-y of the points' frame at the start"  # twelve o'clock
UPRIGHT = 0.1  # sine of the angle between a pipe and gravity that gives no clock
ENOUGH = 8  # centres of a path, to be as many nodes: more between them would be corners, where a bend has none
NODES = 64  # of one with fewer, which is taken for straight: how far its wall is away is measured from the nearest
# Root mean square of pipes' ovality, its direction anywhere: 95 % are below 5.2 %, about what is allowed of a laid
# flexible pipe. What an ellipse through half a wall leans on.
ASSUMED_OVALITY = 0.03
REASONS = {
    "ok": "",
    "too_few_points": "too few points for a tube",
    "no_cylinder": "no stretch of the cloud looks like the wall of a pipe",
    "one_sided": "points on one side only: neither centre nor diameter is determined",
    "open": "the section is no ellipse (an egg?), and too little of it is seen to tell what it is",
    "not_determined": "the points are too uncertain for a tube: their errors leave no diameter determined",
    "too_short": "the wall is shorter than half a radius",
}


@dataclass
class Tube:
    """A fitted tube. `status` "ok", or why there is none: then `stations` has no rows and `events` is empty.

    stations: arrays with one row a station, by name:
      s, x, y, z, tx, ty, tz   chainage, point of the axis, unit tangent
      status                   "ok", "circle_only", "open", "one_sided", "too_few_points"; what was not measured is NaN.
                               "circle_only": sizes hold if the unseen wall goes on as an ellipse does
      d_mean, d_area, circumference, d_max, d_min   perimeter / pi; diameter of the circle of equal area; widest and
                               narrowest caliper width. The ellipse's part is without the noise's bias
      clock_max                clock angle of d_max, radians, 0 to pi
      ovality                  (d_max - d_min) / d_mean;  ovality_nominal: the same over the nominal diameter
      ovality_astm             (d_mean - d_min) / d_mean (ASTM F1216);  ovality_astm_max: (d_max - d_mean) / d_mean
      reduction_nominal        (d_nominal - d_min) / d_nominal (EN 13508-2 BAA, relative to nominal)
      ovality_lo, ovality_hi   95 % interval of `ovality`, with ovality_systematic: what the camera leaves open
      ovality_squared          square of the ovality less the noise's share, below zero as often as above where the
                               pipe is round: what averages are made of (`tube_stations.rms_ovality`)
      <name>_sigma             random standard deviation;  <name>_systematic: of what all stations share (scale)
      departure                of the section from its ellipse, at most (harmonics 3 and up): an egg's, a dent's
      curvature, curvature_sigma, inliers, gap, rms, roughness
    events: one dictionary a finding; see `pipefish.tube_findings`."""

    status: str
    reason: str
    stations: dict[str, np.ndarray]
    events: list[dict[str, Any]] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    nominal: float | None = None
    clock_zero: str = ""
    points: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # of each point: s, clock, r, distance, sigma, weight, ..
    surface: Any = None
    _up: np.ndarray | None = None

    @property
    def length(self) -> float:
        """Metres along the axis; 0 without a tube."""
        return float(self.surface.pieces[-1][1]) if self.surface is not None else 0.0

    def frames(self, s: Any, piece: Any = None) -> dict[str, np.ndarray]:
        """Of each chainage: centre, tangent, up (twelve o'clock), right (three o'clock), all (n,3); shape (n,k);
        `zero`, the section's own angle at twelve o'clock. piece (n,): on which piece's axis, where two meet; -1, or
        None: on the one that holds the chainage."""
        self._need()
        s = np.atleast_1d(np.asarray(s, float))
        on = np.full(s.shape, -1) if piece is None else np.asarray(piece, int)
        if s.ndim != 1 or on.shape != s.shape or not ((on >= -1) & (on < len(self.surface.pieces))).all():
            raise ArgumentError(f"piece: not one of the tube's {len(self.surface.pieces)} for each of s {s.shape}")
        found = self.surface.stations(s.tolist(), on.tolist())
        zero = _zero_angle(found, self._up, self.surface)
        c, n = np.cos(zero)[:, None], np.sin(zero)[:, None]
        found["up"] = c * found["first"] + n * found["second"]
        found["right"] = -n * found["first"] + c * found["second"]
        found["zero"] = zero
        return found

    def radius(self, s: Any, clock: Any) -> np.ndarray:
        """Distance of the wall from the axis at chainages s (n,) and clock angles (m,): (n,m), metres."""
        frame = self.frames(s)
        clock = np.atleast_1d(np.asarray(clock, float))
        t = np.linspace(0, 2 * np.pi, 361)
        curve = section_points(frame["shape"], t)
        out = np.empty((len(curve), len(clock)))
        for i, y in enumerate(curve):
            angle = np.unwrap(np.arctan2(y[:, 1], y[:, 0]))
            wanted = angle[0] + (clock + frame["zero"][i] - angle[0]) % (2 * np.pi)
            out[i] = np.interp(wanted, angle, np.hypot(y[:, 0], y[:, 1]))
        return out

    def evaluate(self, s: Any, clock: Any) -> np.ndarray:
        """Points of the wall at chainages s (n,) and clock angles (m,): (n,m,3)."""
        frame, r = self.frames(s), self.radius(s, clock)
        clock = np.atleast_1d(np.asarray(clock, float))
        around = np.cos(clock)[:, None] * frame["up"][:, None] + np.sin(clock)[:, None] * frame["right"][:, None]
        return frame["centre"][:, None] + r[..., None] * around

    def project(self, points: Any) -> dict[str, np.ndarray]:
        """Place of points (N,3): s, clock, r (from the axis), distance (from the wall, positive outside), piece
        (-1 beyond the ends)."""
        self._need()
        rows = self.surface.project(np.ascontiguousarray(np.asarray(points, float).reshape(-1, 3)))
        return self._places(rows)

    def ring_places(self, along: float | None = None) -> list[np.ndarray]:
        """Chainages of the rings of `mesh`, an array a piece."""
        self._need()
        along = along or 0.1 * self.summary["d_mean"]
        return [np.linspace(a, b, max(2, math.ceil((b - a) / along) + 1)) for a, b in self.surface.pieces]

    def mesh(self, along: float | None = None, around: int = 72) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n*around,3) and triangles (m,3) of the wall, a ring each `along` metres [0.1 d_mean]; pieces are
        not joined, so that joints stay visible. Triangles face inwards."""
        clock = np.arange(around) * 2 * np.pi / around
        vertices, faces, base = [], [], 0
        for k, s in enumerate(self.ring_places(along)):
            rings = len(s)
            vertices.append(self._rings(s, clock, k).reshape(-1, 3))
            i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
            a = base + (i * around + j).ravel()
            b = base + (i * around + (j + 1) % around).ravel()
            faces += [np.c_[a, a + around, b], np.c_[b, a + around, b + around]]
            base += rings * around
        return np.vstack(vertices), np.vstack(faces)

    def _rings(self, s: np.ndarray, clock: np.ndarray, piece: int) -> np.ndarray:
        frame = self.frames(s, [piece] * len(s))
        t = np.linspace(0, 2 * np.pi, 361)
        curve = section_points(frame["shape"], t)
        out = np.empty((len(s), len(clock), 3))
        for i, y in enumerate(curve):
            angle = np.unwrap(np.arctan2(y[:, 1], y[:, 0]))
            wanted = angle[0] + (clock + frame["zero"][i] - angle[0]) % (2 * np.pi)
            r = np.interp(wanted, angle, np.hypot(y[:, 0], y[:, 1]))[:, None]
            out[i] = frame["centre"][i] + r * (
                np.cos(clock)[:, None] * frame["up"][i] + np.sin(clock)[:, None] * frame["right"][i]
            )
        return out

    def _places(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        out = dict(zip(("s", "clock", "r", "distance", "sigma", "weight", "piece"), rows.T.copy(), strict=True))
        on = out["piece"] >= 0
        if on.any():
            grid = np.linspace(0, self.length, max(2, int(self.length / (0.1 * self.summary["d_mean"])) + 1))
            zero = np.unwrap(self.frames(grid)["zero"])
            out["clock"][on] = (out["clock"][on] - np.interp(out["s"][on], grid, zero)) % (2 * np.pi)
        out["piece"] = out["piece"].astype(int)
        for name in ("s", "clock", "r", "distance", "sigma"):
            out[name][~on] = np.nan
        return out

    def _need(self) -> None:
        if self.surface is None:
            raise ArgumentError(f"there is no tube: {self.reason}")


def fit_tube(
    points: Any,
    sigma: Any = None,
    path: Any = None,
    *,
    nominal: float | None = None,
    up: Any = None,
    scale_sigma: float = 0.0,
    order: int = 0,
    spacing: float | None = None,
    shared: Shared | None = None,
    threads: int = 2,
    progress: Callable[[float, str], None] | None = None,
) -> Tube:
    """Fits a tube to points (N,3), metres, among which there may be gross ones.

    sigma     their measurement noise: one number, (N,) standard deviations or (N,3,3) covariances; None: not known (the
              roughness that is reported then holds both)
    path      (K,3) camera centres in the order of travel; None: the pipe is looked for in the bare cloud
    nominal   nominal diameter, for what is defined against it
    up        (3,) direction against gravity, for twelve o'clock; None: -y of the points' frame at the start, carried
              along without twist
    scale_sigma   relative standard deviation of the scale of the whole cloud: the systematic part of each sigma
    order     of the section's harmonics: 2 an ellipse, up to 6; 0: by BIC
    spacing   of the stations, metres [a quarter of the diameter]
    shared    what the points have in common beyond `sigma`, as a reconstruction's do: in the sigmas of ovality, steps
              and bends and in what counts as a joint
    progress  is called with a fraction done and a word

    Same bits for any number of threads. Raises ArgumentError for wrong shapes; a cloud that holds no tube gives a Tube
    whose status says why."""
    cloud, noise, centres, up_vector, used = _checked(points, sigma, path, up)
    if nominal is not None and not (math.isfinite(nominal) and nominal > 0):
        raise ArgumentError(f"nominal: {nominal} is not a positive length")
    if not (math.isfinite(scale_sigma) and scale_sigma >= 0):
        raise ArgumentError(f"scale_sigma: {scale_sigma} is not a relative standard deviation")
    if spacing is not None and not (math.isfinite(spacing) and spacing > 0):
        raise ArgumentError(f"spacing: {spacing} is not a positive length")
    if order not in (0, 2, 3, 4, 6):
        raise ArgumentError(f"order: {order} is not 0, 2, 3, 4 or 6")
    tell = progress or (lambda fraction, word: None)
    if len(cloud) < 60:
        return _none("too_few_points", f"{len(cloud)} finite points", nominal)
    tell(0.0, "looking for the pipe")
    sections = _engine.tube_trace(cloud, noise, centres if centres is not None else np.empty((0, 3)), threads)
    sections = [c for c in sections if c["status"] in MEASURED]
    if not sections:
        return _none(*_why_none(cloud, noise, centres, threads), nominal)
    nodes, rho = _reference(cloud, sections, centres)
    if len(nodes) < 2:
        return _none("too_short", "", nominal)
    tell(0.4, "fitting the surface")
    fit = _Fit(cloud, noise, used, up_vector, nominal, order, spacing, scale_sigma, shared)
    try:
        tube, common = fit.on(nodes, rho)
    except ValueError:  # the normal matrix is singular
        return _none("not_determined", "", nominal)
    if tube_shape.much_off(tube):
        tell(0.7, "trying another shape")
        tube, common = _of_another_shape(fit, np.asarray(points, float), tube, len(nodes)) or (tube, common)
    if not np.isin(tube.stations["status"], MEASURED).any():
        statuses, count = np.unique(tube.stations["status"], return_counts=True)
        return _none(str(statuses[count.argmax()]), "", nominal)  # of most of it
    tell(0.9, "looking for what departs from it")
    tube.events = tube_findings.events(tube, common)
    tube.summary["events"] = len(tube.events)
    tell(1.0, "done")
    return tube


@dataclass
class _Fit:
    """A surface through the cloud, and what a tube has of it."""

    cloud: np.ndarray
    noise: Any
    used: np.ndarray
    up: Any
    nominal: float | None
    order: int
    spacing: float | None
    scale_sigma: float
    shared: Shared | None

    def _surface(self, nodes: np.ndarray, rho: list[float], breaks: list[float]) -> Any:
        return _engine.tube_surface(
            self.cloud, self.noise, nodes, rho, breaks, KNOT, self.order, 12, False, ASSUMED_OVALITY
        )

    def on(self, nodes: np.ndarray, rho: list[float]) -> tuple[Tube, Common]:
        """From circles along the pipe; the tube is without findings. ValueError: nothing is determined."""
        diameter, known = 2 * float(np.median(rho)), np.flatnonzero(self.used)
        coarse = _engine.tube_surface(self.cloud, self.noise, nodes, rho, [], 2.0, 2, 8, True, ASSUMED_OVALITY)
        breaks = tube_findings.break_candidates(coarse, nodes, diameter)
        surface = self._surface(nodes, rho, breaks)
        common = Common(surface, self.shared, known, diameter)
        kept = tube_findings.confirmed(surface, diameter, breaks, common)
        if len(kept) < len(breaks):
            surface = self._surface(nodes, rho, kept)
            common = Common(surface, self.shared, known, diameter)
        tube = Tube("ok", "", {}, nominal=self.nominal, surface=surface)
        tube._up, tube.clock_zero = _clock_of(surface, self.up)
        tube.stations, by_shape = stations_of(tube, self.spacing or STATION * diameter, self.scale_sigma, common)
        tube.summary = summary_of(tube, by_shape, self.used)
        tube.points = _all_points(tube._places(surface.placed()), self.used)
        unknown = tube_shape.is_open(tube)
        if unknown.any():
            tube.stations["status"][unknown] = "open"
            blank(tube.stations)
            tube.summary = summary_of(tube, by_shape, self.used)
        tube.summary["points_apart"] = float(np.mean(tube.points["piece"][self.used] < 0))
        return tube, common


def _of_another_shape(fit: _Fit, points: np.ndarray, tube: Tube, count: int) -> tuple[Tube, Common] | None:
    """The surface from circles through all points around a tube that leaves many of them off its wall (an egg's crown
    is exactly round), where that is likelier."""
    nodes, rho = tube_shape.wide_circles(points, tube, count)
    if not (tube_shape.is_even(rho) and tube_shape.leads_elsewhere(points, tube, nodes, rho)):
        return None
    try:
        other, common = fit.on(nodes, rho)
    except ValueError:  # the normal matrix is singular
        return None
    return (other, common) if tube_shape.likelier(other, tube) else None


def _checked(points: Any, sigma: Any, path: Any, up: Any) -> tuple[Any, Any, Any, Any, np.ndarray]:
    """Arrays as the engine wants them, without points that are not finite; `used`: which points are."""
    cloud = _array(points, "points", (None, 3))
    used = _bounded(cloud).all(1)
    noise = None
    if sigma is not None:
        noise = np.asarray(sigma, float)
        if noise.ndim == 0:
            if not _bounded(noise):
                raise ArgumentError(f"sigma: {noise} is not a standard deviation")
            noise = np.full(len(cloud), float(noise))
        if noise.shape not in ((len(cloud),), (len(cloud), 3, 3)):
            raise ArgumentError(f"sigma: shape {noise.shape} is neither ({len(cloud)},) nor ({len(cloud)}, 3, 3)")
        sound = _bounded(noise) if noise.ndim == 1 else _bounded(noise).all((1, 2))
        if noise.ndim == 1 and (noise[sound] < 0).any():
            raise ArgumentError("sigma: negative standard deviations")
        if noise.ndim == 3 and not _are_covariances(noise[sound]):
            raise ArgumentError("sigma: what is given as covariances is not symmetric or has negative variances")
        used &= sound
        noise = np.ascontiguousarray(noise[used])
    centres = None
    if path is not None:
        centres = _array(path, "path", (None, 3))
        if not _bounded(centres).all():
            raise ArgumentError("path: not finite")
        centres = _forward(centres) if len(centres) else centres
        if len(centres) < 2:
            raise ArgumentError("path: the camera stands still; leave it out")
    vector = None
    if up is not None:
        vector = _array(np.asarray(up, float).reshape(1, -1), "up", (1, 3))[0]
        if not np.linalg.norm(vector) > 0:
            raise ArgumentError("up: not a direction")
        vector = vector / np.linalg.norm(vector)
    return np.ascontiguousarray(cloud[used]), noise, centres, vector, used


def _bounded(values: np.ndarray) -> np.ndarray:
    """Finite, and so are products of a few of them."""
    return np.abs(values) <= 1e50


def _are_covariances(noise: np.ndarray) -> bool:
    """Symmetric and nowhere negative, but for the rounding of whoever computed them."""
    blur = 1e-6 * np.abs(noise).max(axis=(1, 2), initial=0.0)
    even = (np.abs(noise - noise.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0) <= blur).all()
    return bool(even and (np.linalg.eigvalsh(noise)[:, 0] >= -blur).all())


def _array(values: Any, name: str, shape: tuple[int | None, int]) -> np.ndarray:
    try:
        array = np.ascontiguousarray(np.asarray(values, float))
    except (TypeError, ValueError):
        raise ArgumentError(f"{name}: not numbers") from None
    if array.ndim != 2 or array.shape[1] != shape[1] or (shape[0] is not None and array.shape[0] != shape[0]):
        raise ArgumentError(f"{name}: shape {array.shape} is not ({shape[0] or 'N'}, {shape[1]})")
    return array


def _forward(centres: np.ndarray) -> np.ndarray:
    """The path without standstill and driving back, smoothed and evenly spaced, so that its tangent is the pipe's."""
    total = np.linalg.norm(np.ptp(centres, axis=0))
    step = total / 400 if total > 0 else 0.0
    kept = [centres[0]]
    heading = None
    for c in centres[1:]:
        move = c - kept[-1]
        length = np.linalg.norm(move)
        if length <= max(step, 1e-9):
            continue
        if heading is not None and move @ heading < 0:  # backwards: wait until it passes again
            continue
        heading = move / length if heading is None else heading + 0.3 * (move / length - heading)
        kept.append(c)
    line = np.array(kept)
    if len(line) < 2:
        return line
    for _ in range(3):
        line[1:-1] = 0.25 * line[:-2] + 0.5 * line[1:-1] + 0.25 * line[2:]
    s = np.r_[0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    even = np.linspace(0, s[-1], len(line) if len(line) >= ENOUGH else NODES)
    return np.ascontiguousarray(np.column_stack([np.interp(even, s, line[:, k]) for k in range(3)]))


def _why_none(cloud: np.ndarray, noise: Any, centres: Any, threads: int) -> tuple[str, str]:
    if centres is None:
        return str(_engine.tube_find_cylinder(cloud, noise, threads)["status"]), ""
    middle = centres[len(centres) // 2]
    axis = centres[-1] - centres[0]
    away = float(np.median(np.linalg.norm(cloud - middle, axis=1)))
    near = cloud[np.abs((cloud - middle) @ (axis / np.linalg.norm(axis))) < away]
    found = _engine.tube_fit_cylinder(np.ascontiguousarray(near), None, middle, axis, 0.0, False, 0.35, 24)
    status = str(found["status"])
    return (status if status in REASONS and status not in MEASURED else "no_cylinder"), ""


def _reference(cloud: np.ndarray, sections: list[dict[str, Any]], path: Any) -> tuple[np.ndarray, list[float]]:
    """Nodes of the sections, from where the wall begins to where it ends."""
    if path is None and np.linalg.norm(sections[0]["centre"]) > np.linalg.norm(sections[-1]["centre"]):
        sections = [{**c, "axis": -c["axis"]} for c in reversed(sections)]
    nodes = [c["centre"] for c in sections]
    rho = [float(c["rho"]) for c in sections]
    typical = float(np.median(rho))
    ends = []
    for c, sign in ((sections[0], -1.0), (sections[-1], 1.0)):
        x = cloud - c["centre"]
        z = x @ c["axis"]
        r = np.linalg.norm(x - z[:, None] * c["axis"], axis=1)
        z = sign * z[(np.abs(r - c["rho"]) < 4 * c["roughness"] + 0.02 * c["rho"]) & (np.abs(z) < 1.0 * typical)]
        ends.append(sign * max(0.0, float(np.quantile(z, 0.995))) if len(z) else 0.0)
    first = nodes[0] + ends[0] * sections[0]["axis"]
    last = nodes[-1] + ends[1] * sections[-1]["axis"]
    nodes, rho = [first, *nodes, last], [rho[0], *rho, rho[-1]]
    keep = [0]
    for i in range(1, len(nodes)):
        if np.linalg.norm(nodes[i] - nodes[keep[-1]]) > 0.1 * typical:
            keep.append(i)
    if sum(np.linalg.norm(nodes[b] - nodes[a]) for a, b in itertools.pairwise(keep)) < 0.5 * typical:
        return np.empty((0, 3)), []
    return np.ascontiguousarray(np.array([nodes[i] for i in keep])), [rho[i] for i in keep]


def _clock_of(surface: Any, up: np.ndarray | None) -> tuple[np.ndarray | None, str]:
    """The direction of twelve o'clock, None where the points' frame tells it, and what it is."""
    if up is None:
        return None, FROM_FRAME
    s = np.concatenate([np.linspace(a, b, 20) for a, b in surface.pieces])
    piece = np.repeat(np.arange(len(surface.pieces)), 20)
    tangent = surface.stations(s.tolist(), piece.tolist())["tangent"]
    if (np.linalg.norm(up - (tangent @ up)[:, None] * tangent, axis=1) > UPRIGHT).any():
        return up, AGAINST_GRAVITY
    return None, f"{FROM_FRAME}: the pipe stands upright, gravity tells no clock"


def _zero_angle(found: dict[str, np.ndarray], up: np.ndarray | None, surface: Any) -> np.ndarray:
    """The section's own angle at twelve o'clock, at each station."""
    start = surface.stations([0.0], [0])
    down = np.array([0.0, 1.0, 0.0])
    if up is None:
        reference = -down if abs(start["tangent"][0] @ down) < 0.9 else np.array([0.0, 0.0, -1.0])
        angle = math.atan2(float(reference @ start["second"][0]), float(reference @ start["first"][0]))
        return np.full(len(found["first"]), angle)
    a, b = found["first"] @ up, found["second"] @ up
    zero = np.arctan2(b, a)
    upright = np.hypot(a, b) > UPRIGHT  # steeper shafts keep the last clock
    if not upright.all():
        index = np.arange(len(zero))
        zero = np.interp(index, index[upright], np.unwrap(zero[upright])) if upright.any() else np.zeros(len(zero))
    return zero


def _all_points(places: dict[str, np.ndarray], used: np.ndarray) -> dict[str, np.ndarray]:
    """Rows for the points that were not finite too."""
    out = {}
    for name, values in places.items():
        full = np.full(len(used), -1 if name == "piece" else 0.0 if name == "weight" else np.nan, dtype=values.dtype)
        full[used] = values
        out[name] = full
    out["known"] = used
    return out


def _none(status: str, detail: str, nominal: float | None) -> Tube:
    reason = REASONS.get(status, status) + (f": {detail}" if detail else "")
    return Tube(status, reason, {"s": np.empty(0)}, nominal=nominal)
