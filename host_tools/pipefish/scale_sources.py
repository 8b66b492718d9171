"""What tells a survey's scale: the encoder in its adjustment, joints, a target, a known diameter; and the structure
brought into metres by them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipefish.errors import ArgumentError
from pipefish.scale import ORDER, SPACING_SIGMA, Estimate, Known, Scale, combine, joints_estimate, rescaled
from pipefish.scale_target import look, target_estimate
from pipefish.sectionsigma import diameter_sigma
from pipefish.target import Target
from pipefish.tube import Tube, fit_tube

if TYPE_CHECKING:
    from pipefish.measure import Tell
    from pipefish.measurement import Measurement


@dataclass(frozen=True)
class Beforehand:
    """What is known of lengths before anything is measured, but for the encoder: see `measure`."""

    diameter: Known | None = None
    spacing: Known | None = None
    target: Target | None = None


def beforehand(diameter: float | Known | None, spacing: float | Known | None, target: Target | None) -> Beforehand:
    """Raises ArgumentError."""
    lengths = {}
    for name, given, sigma in (("diameter", diameter, 0.0), ("joint_spacing", spacing, SPACING_SIGMA)):
        known = Known(given, sigma * given) if isinstance(given, int | float) else given
        if known and not (math.isfinite(known.value) and known.value > 0 and 0 <= known.sigma < 0.5 * known.value):
            raise ArgumentError(f"{name}: {known.value} with a sigma of {known.sigma} is not a length above zero")
        lengths[name] = known
    if target is not None and target.kind == "sleeve":
        raise ArgumentError(
            "target: a sleeve around the wall is as large as the pipe's diameter makes it, which would then not be "
            "measured: give the diameter, or a flat target"
        )
    return Beforehand(lengths["diameter"], lengths["joint_spacing"], target)


def _segment_tube(m: Measurement, segment: int, threads: int | None) -> Tube:
    inside = m.structure.point_segment == segment
    points, own = m.structure.points[inside], m.structure.own_covariance[inside]
    return fit_tube(points, own, m.path(segment), up=m.up, threads=threads or 2)


def find_scale(m: Measurement, known: Beforehand, threads: int | None, tell: Tell) -> None:
    """Brings the structure into metres, or into diameters of each stretch."""
    structure, segments = m.structure, range(len(m.structure.sigma))
    metric = structure.unit == "metre"
    estimates: list[Estimate] = []
    if metric:
        sigma = float(structure.scale_sigma or 0.0)
        estimates.append(Estimate("encoder", 0.0, 0.0, sigma, "its wheel's scale"))
    else:
        m.encoder = None  # of no use: too few of its steps could be used
    tubes: dict[int, Tube] = {}
    if not metric or known.spacing or known.target:
        for segment in segments:
            tubes[segment] = _segment_tube(m, segment, threads)
            tell(0.5, "scale")
    estimates += _joints(m, known, tubes) + _target(m, known, tubes, tell)
    if metric:
        found = combine(estimates)
        m.factors = [math.exp(found.log)] * len(segments)
        wheel = (1 + structure.wheel) * m.factors[0] - 1
        m.scale = Scale(found.used[0], "metre", found.sigma, wheel, found.sigma, found.rows, found.chi2, found.freedom)
    else:
        m.factors, m.scale = _free_scale(known, estimates, tubes)
    if any(factor != 1.0 for factor in m.factors):
        m.structure = rescaled(structure, m.factors)


def _free_scale(known: Beforehand, estimates: list[Estimate], tubes: dict[int, Tube]) -> tuple[list[float], Scale]:
    """Factors of stretches that no encoder joins: each has its own unit. 0 for those that nothing tells the scale of
    where it is told for others."""
    if not estimates:
        sizes = [t.summary["d_mean"] if t.status == "ok" else None for t in tubes.values()]
        given = known.diameter
        factors = [(given.value if given else 1.0) / size if size else 1.0 for size in sizes]
        if given is None:
            return factors, Scale("none", "diameter", 0.0)
        return factors, Scale("diameter", "metre", given.sigma / given.value)
    factors, rows, chi2, freedom, sigmas, used = [], [], 0.0, 0, [], set()
    for segment in tubes:
        own = [e for e in estimates if e.segment == segment]
        if not own:
            factors.append(0.0)
            continue
        found = combine(own)
        factors.append(math.exp(found.log))
        rows += found.rows
        chi2, freedom = chi2 + found.chi2, freedom + found.freedom
        sigmas.append(found.sigma)
        used |= set(found.used)
    source = next(name for name in ORDER if name in used)
    return factors, Scale(source, "metre", max(sigmas), None, None, rows, chi2, freedom)


def _joints(m: Measurement, known: Beforehand, tubes: dict[int, Tube]) -> list[Estimate]:
    """What the spacing of joints says of each stretch."""
    if known.spacing is None:
        return []
    out, metric = [], m.structure.unit == "metre"
    size = known.diameter.value if known.diameter else m.nominal
    for segment, tube in tubes.items():
        if tube.status != "ok":
            continue
        unit = known.spacing.value if metric else None
        if not metric and size:
            unit = known.spacing.value * tube.summary["d_mean"] / size
        found = joints_estimate(m.structure, segment, tube, known.spacing, unit)
        if found is not None:
            out.append(found)
    if not out:
        count = sum(e["kind"] == "joint" for t in tubes.values() for e in t.events)
        m.remarks.append(f"The joint spacing tells no scale: {count} joints were found, and they make no row.")
    return out


def _target(m: Measurement, known: Beforehand, tubes: dict[int, Tube], tell: Tell) -> list[Estimate]:
    """What a target of known size says of each stretch."""
    if known.target is None:
        return []
    seen = look(m.survey, m.index[m.structure.frames], known.target, lambda done: tell(0.5, "looking for the target"))
    out, why = [], ""
    for segment, tube in tubes.items():

        def local(centre: np.ndarray, segment: int = segment, tube: Tube = tube) -> float:
            exact = diameter_sigma(m.structure, segment, tube) if tube.status == "ok" else None
            if exact is None:
                return 0.0
            s = float(np.nan_to_num(tube.project(centre[None])["s"][0]))
            wheel = float(m.structure.scale_sigma or 0.0) if m.structure.unit == "metre" else 0.0
            relative = float(np.interp(s, exact.s, exact.random)) / tube.summary["d_mean"]
            return math.sqrt(max(0.0, relative**2 - wheel**2))

        found = target_estimate(m.structure, segment, seen, m.camera, known.target, local)
        if isinstance(found, str):
            why = why or found
        else:
            out.append(found)
    if not out:
        m.remarks.append(f"The target tells no scale: {why}.")
    return out
