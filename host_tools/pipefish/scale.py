"""How long a metre is: estimates of the scale from what is known beforehand, their combination, and whether they agree.

An estimate is the logarithm of (true length / length in the structure's unit), with its sigma. Estimates that agree are
averaged with their weights; those that do not are reported and not averaged. A known diameter takes no part in the
average: what it had a say in would not be a measured diameter (docs/reconstruction.md)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Any

import numpy as np

from pipefish.intervals import Z95
from pipefish.structure import Reconstruction
from pipefish.tube import Tube
from pipefish.tube_findings import chi2_limit

DISAGREE_SIGMA = 3.0
DISAGREE = 2 * NormalDist().cdf(-DISAGREE_SIGMA)  # the same for the chi-squared of any number of estimates
ORDER = ("encoder", "target", "joints", "diameter")  # whose word counts where two contradict each other
SPACING_SIGMA = 0.005  # of a joint spacing that is given without a tolerance, relative
PATTERN = 0.05  # of the spacing: joints that are further off are none of the row
SLICE_POINTS = 40


@dataclass(frozen=True)
class Known:
    """A length known beforehand, metres, and its standard deviation, 0 if it is exact."""

    value: float
    sigma: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """One source's word. log as above; random: sigma of its own; shared: the sigma that all its estimates have in
    common (a wheel's scale, how well the spacing is known); segment: which it holds for, None for all."""

    name: str
    log: float
    random: float
    shared: float
    detail: str
    segment: int | None = None

    @property
    def sigma(self) -> float:
        """Whole, relative."""
        return math.hypot(self.random, self.shared)


@dataclass(frozen=True)
class Scale:
    """Where lengths come from.

    source      the first of ORDER that has a say, or "none"; with "diameter" no diameter has been measured
    unit        "metre", or "diameter": lengths are in mean diameters of their stretch
    sigma       relative, shared by all; 0 for an exact given diameter and without scale: it is part of the definition.
                Where sources contradict each other so wide that its 95 % interval reaches the contrary word
    wheel, wheel_sigma   (true distance over the encoder's) - 1 as estimated; None without an encoder
    sources     each source's word, one dictionary a source and stretch: name, segment, used, relative (its lengths over
                those that are given, less 1), sigma, deviation (in sigmas, from the others; None alone), consistent,
                detail
    chi2, freedom   of all words that there are
    """

    source: str
    unit: str
    sigma: float
    wheel: float | None = None
    wheel_sigma: float | None = None
    sources: list[dict[str, Any]] = field(default_factory=list)
    chi2: float = 0.0
    freedom: int = 0

    @property
    def consistent(self) -> bool:
        """Whether all sources agree."""
        return self.freedom == 0 or self.chi2 <= chi2_limit(DISAGREE, self.freedom)

    @property
    def diameter_from_prior(self) -> bool:
        """Whether the mean diameter is what was given, or without unit."""
        return self.source in ("diameter", "none")


@dataclass(frozen=True)
class Combined:
    """The scale of one unknown: log, sigma, the names that were used, a row for each estimate, chi2, freedom."""

    log: float
    sigma: float
    used: tuple[str, ...]
    rows: list[dict[str, Any]]
    chi2: float
    freedom: int


def _mean(estimates: Sequence[Estimate]) -> tuple[float, float, float]:
    """Weighted mean, its sigma, chi-squared of the estimates around it."""
    weight = np.array([1 / max(e.sigma, 1e-9) ** 2 for e in estimates])
    values = np.array([e.log for e in estimates])
    mean = float(weight @ values / weight.sum())
    return mean, float(1 / math.sqrt(weight.sum())), float(weight @ (values - mean) ** 2)


def _agree(estimates: Sequence[Estimate]) -> bool:
    return len(estimates) < 2 or _mean(estimates)[2] <= chi2_limit(DISAGREE, len(estimates) - 1)


def _of_each_source(estimates: Sequence[Estimate]) -> list[Estimate]:
    """One estimate a source, in ORDER: those of several stretches averaged, what they share counted once."""
    out = []
    for name in ORDER:
        own = [e for e in estimates if e.name == name]
        if own:
            mean, random, _ = _mean([dataclasses.replace(e, shared=0.0) for e in own])
            shared, detail = max(e.shared for e in own), "; ".join(dict.fromkeys(e.detail for e in own))
            segment = own[0].segment if len({e.segment for e in own}) == 1 else None
            out.append(Estimate(name, mean, random, shared, detail, segment))
    return out


def combine(estimates: Sequence[Estimate]) -> Combined:
    """Of at least one estimate, all of one unknown.

    All are averaged if they agree. Else, if leaving out one, and only that one, makes three or more agree, the rest is;
    else the first of ORDER stands alone, and its sigma grows until its 95 % interval reaches each contrary word."""
    given = _of_each_source(estimates)
    used, widest = given, 0.0
    if not _agree(given):
        rests = [[e for e in given if e is not odd] for odd in given]
        sound = [rest for rest in rests if len(rest) > 1 and _agree(rest)]
        used = sound[0] if len(sound) == 1 else given[:1]
        if len(sound) != 1:
            widest = max(abs(e.log - given[0].log) for e in given) / Z95
    log, sigma, _ = _mean(used)
    rows = [_row(e, e in used, log, [o for o in given if o is not e]) for e in given]
    chi2 = _mean(given)[2]
    return Combined(log, max(sigma, widest), tuple(e.name for e in used), rows, chi2, len(given) - 1)


def _row(e: Estimate, used: bool, log: float, others: Sequence[Estimate]) -> dict[str, Any]:
    deviation = None
    if others:
        mean, sigma, _ = _mean(others)
        deviation = (e.log - mean) / max(math.hypot(e.sigma, sigma), 1e-12)
    return {
        "name": e.name,
        "segment": e.segment,
        "used": used,
        "relative": math.expm1(e.log - log),
        "sigma": e.sigma,
        "deviation": deviation,
        "consistent": deviation is None or abs(deviation) <= DISAGREE_SIGMA,
        "detail": e.detail,
    }


def with_diameter(scale: Scale, known: Known, measured: float, sigma: float) -> Scale:
    """The scale with a known diameter beside it, held against the measured one, metres; sigma relative, without
    the scale's."""
    log = math.log(known.value / measured)
    own = math.hypot(sigma, known.sigma / known.value)
    deviation = log / max(math.hypot(own, scale.sigma), 1e-12)
    row = {
        "name": "diameter",
        "segment": None,
        "used": False,
        "relative": math.expm1(log),
        "sigma": own,
        "deviation": deviation,
        "consistent": abs(deviation) <= DISAGREE_SIGMA,
        "detail": f"{1000 * known.value:.1f} mm given, {1000 * measured:.1f} mm measured",
    }
    used = sum(r["used"] for r in scale.sources)
    alone = used == 1 and not row["consistent"]
    return dataclasses.replace(
        scale,
        sigma=max(scale.sigma, abs(log) / Z95) if alone else scale.sigma,
        sources=[*scale.sources, row],
        chi2=scale.chi2 + deviation**2,
        freedom=scale.freedom + 1,
    )


def disagreement(scale: Scale) -> str | None:
    """One sentence for people where sources contradict each other: names them, and whose word the values are."""
    if scale.consistent or scale.unit != "metre":
        return None
    words = {"encoder": "the encoder", "target": "the target", "joints": "the joints", "diameter": "the given diameter"}

    def told(row: dict[str, Any]) -> str:
        return f"{words[row['name']]} {100 * row['relative']:+.2f} ± {100 * Z95 * row['sigma']:.2f} % ({row['detail']})"

    used = dict.fromkeys(words[r["name"]] for r in scale.sources if r["used"])
    worst = max((abs(r["deviation"]) for r in scale.sources if r["deviation"] is not None), default=0.0)
    return (
        f"What tells the scale disagrees, by up to {worst / Z95:.1f} times the 95 % interval of the difference: "
        f"lengths are, against the given ones, by {'; by '.join(told(r) for r in scale.sources)}. "
        f"The values are those of {' and '.join(used)}: nothing was "
        "averaged with what contradicts it."
    )


# ---- joints


def _pattern(s: np.ndarray, sigma: np.ndarray, unit: float | None) -> tuple[float, np.ndarray] | None:
    """Spacing of a row of joints and each one's number in it, -1000 for those outside: the largest spacing that most
    joints fit and in whose row not more than half are missing. unit: the spacing as it should be, or None; with it two
    joints are a row."""
    best: tuple[int, float, np.ndarray] | None = None
    for i in range(len(s)):
        for j in range(i + 1, len(s)):
            for k in range(1, 7):
                step = (s[j] - s[i]) / k
                if step < 8 * max(sigma[i], sigma[j]) or (unit and not 0.3 < step / unit < 8):
                    continue
                number = np.round((s - s[i]) / step)
                off = np.abs(s - s[i] - number * step)
                fits = off < np.minimum(PATTERN * step, 3 * np.hypot(sigma, sigma[i]) + 0.01 * step)
                found = (int(fits.sum()), float(step), np.where(fits, number, -1000))
                if found[0] < 0.5 * (np.ptp(number[fits]) + 1):
                    continue  # a fine enough row fits any joints
                if best is None or found[:2] > (best[0], best[1] * (1 + 1e-6)):
                    best = found
    if best is None or best[0] < (2 if unit else 3) or best[0] <= len(s) / 2:
        return None
    return best[1], best[2]


def joints_estimate(
    structure: Reconstruction, segment: int, tube: Tube, spacing: Known, unit: float | None
) -> Estimate | None:
    """The scale by the joints that were found in one stretch, the tube in the structure's unit; None where they make no
    row. unit: the spacing in the structure's unit as far as it is known, None: neighbours in the row are one pipe
    apart."""
    # A kink alone, without step or gap, is a turn of the axis as others: it makes no row of pipes.
    joints = [e for e in tube.events if e["kind"] == "joint" and (e["gap"] is not None or e["step"] is not None)]
    s, sigma = np.array([e["s"] for e in joints]), np.array([e["s_sigma"] for e in joints])
    found = _pattern(s, sigma, unit) if len(s) > 1 else None
    if found is None:
        return None
    number = found[1][found[1] > -1000]
    s, sigma = s[found[1] > -1000], sigma[found[1] > -1000]
    covariance = np.diag(sigma**2) + _arc_covariance(structure, segment, tube, s)
    rows = np.column_stack([np.ones(len(s)), number])
    weight = np.linalg.inv(covariance)
    known = np.linalg.inv(rows.T @ weight @ rows)
    start, step = known @ rows.T @ weight @ s
    off = s - start - step * number
    excess = float(off @ weight @ off) / max(1, len(s) - 2)  # the pipes' own lengths differ too
    random = math.sqrt(known[1, 1] * max(1.0, excess)) / step
    pipes = max(1, round(step / unit)) if unit else 1
    detail = f"{len(s)} joints {1000 * spacing.value * pipes:.0f} mm apart"
    return Estimate(
        "joints", math.log(spacing.value * pipes / step), random, spacing.sigma / spacing.value, detail, segment
    )


def _arc_covariance(structure: Reconstruction, segment: int, tube: Tube, s: np.ndarray) -> np.ndarray:
    """(m,m) of the arc lengths from the first of the places s (m,), ascending, to each, as the structure's errors make
    them, the wheel's scale taken out."""
    d, p = tube.summary["d_mean"], tube.points
    node = np.linspace(s[0], s[-1], max(2, round((s[-1] - s[0]) / d) + 1))
    middle = tube.frames(0.5 * (node[1:] + node[:-1]))["tangent"]
    # How much of each interval between nodes lies before each place.
    part = np.clip((s[:, None] - node[None, :-1]) / np.diff(node), 0, 1)
    by_node = np.zeros((len(s), len(node), 3))
    by_node[:, 1:] += part[:, :, None] * middle
    by_node[:, :-1] -= part[:, :, None] * middle
    places, rows = [], []
    for k, at in enumerate(node):
        on = np.flatnonzero((np.abs(p["s"] - at) < 0.5 * d) & (p["weight"] > 0.5) & (p["piece"] >= 0))
        if not len(on):
            return np.zeros((len(s), len(s)))
        on = on[np.unique(np.linspace(0, len(on) - 1, min(len(on), SLICE_POINTS)).round().astype(int))]
        places.append(on)
        rows.append(np.repeat(by_node[:, k, None] / len(on), len(on), axis=1))
    first = int(np.searchsorted(structure.point_segment, segment))
    on, back = np.unique(np.concatenate(places), return_inverse=True)
    jacobian = np.zeros((len(s), len(on), 3))
    for row, total in zip(np.concatenate(rows, axis=1), jacobian, strict=True):
        np.add.at(total, back, row)
    found = structure.functions_covariance(first + on, jacobian)
    if structure.unit == "metre":
        away = s - s[0]
        found = found - float(structure.scale_sigma or 0.0) ** 2 * np.outer(away, away)
    values, vectors = np.linalg.eigh(found)
    return (vectors * np.maximum(values, 0)) @ vectors.T


# ---- the structure in its new unit


def rescaled(structure: Reconstruction, factors: Sequence[float]) -> Reconstruction:
    """The structure with each segment scaled about its first centre and put where the one before ended."""
    poses, points = structure.poses.copy(), structure.points.copy()
    covariance, pose_covariance = structure.covariance.copy(), structure.pose_covariance.copy()
    own = structure.own_covariance.copy()
    systematic = None if structure.systematic is None else structure.systematic.copy()
    pose_systematic = None if structure.pose_systematic is None else structure.pose_systematic.copy()
    centres, end, last = structure.centres, None, None
    for segment, factor in enumerate(factors):
        of_frame, of_point = structure.segment == segment, structure.point_segment == segment
        start = centres[of_frame][0]
        place = start if end is None else end + factor * (start - last)
        moved = place + factor * (centres[of_frame] - start)
        poses[of_frame, :, 3] = -np.einsum("nij,nj->ni", poses[of_frame, :, :3], moved)
        points[of_point] = place + factor * (points[of_point] - start)
        covariance[of_point] *= factor**2
        own[of_point] *= factor**2
        stretch = np.diag([1.0] * 3 + [factor] * 3)
        pose_covariance[of_frame] = stretch @ pose_covariance[of_frame] @ stretch
        if systematic is not None and pose_systematic is not None:
            systematic[of_point] *= factor**2
            pose_systematic[of_frame] = stretch @ pose_systematic[of_frame] @ stretch
        end, last = moved[-1], centres[of_frame][-1]
    return dataclasses.replace(
        structure,
        poses=poses,
        points=points,
        covariance=covariance,
        own_covariance=own,
        pose_covariance=pose_covariance,
        systematic=systematic,
        pose_systematic=pose_systematic,
        pupil=[shift * factor for shift, factor in zip(structure.pupil, factors, strict=False)],
    )
