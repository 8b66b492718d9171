"""Readings of an encoder that are each off by something of their own: smoothed along what the pictures say was driven.

The adjustment takes a reading's error as one of the step (a wheel's: it stays). Readings that jitter (a loose cable, a
clock of its own) have errors that are gone at the next one: of 5 mm each, a step of 50 mm is worth nothing, but 5 m
are known to a thousandth. How much they jitter is seen beside the pictures' own steps, whose scale only drifts."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import NamedTuple

import numpy as np

from pipefish.structure import Encoder, Reconstruction

LEAST = 20  # steps, to judge by
SIGMAS = 3.0  # by which neighbouring steps must contradict each other
START = 0.1  # relative sigma of the pictures' scale where a stretch begins
WIDEST = 0.02  # of the pictures' scale in a metre: more is a wheel that slips
SLIP = 4.0  # sigmas by which readings from a step on must be off, for a slip in it
SLIPS = 0.05  # of the steps: with more of them it is not jitter that is seen
SLIPPED = 1.0  # sigma of such a step, metres
OFF = 5.0  # sigmas of jitter that no reading may be away from what it is smoothed to
WIDER = 1.05  # the step's noise grows by, looked for


class Run(NamedTuple):
    """Readings of one stretch, from its first one on."""

    here: np.ndarray  #: (n,) where among the structure's frames
    reading: np.ndarray  #: (n,) NaN where there is none
    step: np.ndarray  #: (n - 1,) as the pictures have it, in the encoder's metres


class Model(NamedTuple):
    """What readings and steps are off by."""

    white: float  #: sigma of a reading
    walk: float  #: of a step, in a metre
    drift: float  #: of the pictures' scale, in a metre


class Ahead(NamedTuple):
    """Kalman's filter: at each reading what those before it say of place and scale (n,2), its covariance (n,3) as
    [place, both, scale]; what the reading is off that by, and the variance of it, 0 where there is no reading."""

    state: np.ndarray
    cov: np.ndarray
    off: np.ndarray
    total: np.ndarray
    likelihood: float  #: logarithm


class Smooth(NamedTuple):
    """Readings without their jitter (n,); median variance of the scale's logarithm where there are readings; sigmas
    (n - 1,) by which a jump in a step would better agree with them."""

    place: np.ndarray
    scale_variance: float
    slip: np.ndarray


def jitter(step: np.ndarray, length: np.ndarray) -> tuple[float, float]:
    """Variance of what each reading is off by itself, and its sigma, from steps (n,) that were read and as the pictures
    have them; 0 where that is not seen. A jitter is in two steps, with opposite signs."""
    if len(step) < LEAST:
        return 0.0, 0.0
    s = np.cumsum(np.abs(length))
    slow = length[:, None] * (s / s[-1])[:, None] ** np.arange(3)
    held = step
    for _ in range(4):  # without the steps that slipped
        fit = slow @ np.linalg.lstsq(slow, held, rcond=None)[0]
        spread = 1.4826 * float(np.median(np.abs(step - fit)))
        rest = np.where(np.abs(step - fit) <= 3 * spread, step - fit, 0.0)
        held = fit + rest
    power, both = float(rest @ rest), -float(rest[1:] @ rest[:-1])
    sigma = power / math.sqrt(len(rest))
    if power == 0.0 or both < SIGMAS * sigma:
        return 0.0, 0.0
    return both / (len(rest) - 1), sigma / (len(rest) - 1)


def _filtered(run: Run, slipped: np.ndarray, model: Model) -> Ahead:
    reading, step = run.reading.tolist(), run.step.tolist()
    jump = (SLIPPED**2 * slipped).tolist()
    place, scale, a, b, c = reading[0], 0.0, model.white**2, 0.0, START**2
    states, covs, offs, totals, likelihood = [(place, scale)], [(a, b, c)], [0.0], [0.0], 0.0
    for k in range(1, len(reading)):
        v = step[k - 1]
        place += v * (1.0 + scale)
        a += v * (2.0 * b + v * c) + model.walk**2 * abs(v) + jump[k - 1]
        b += v * c
        c += model.drift**2 * abs(v)
        states.append((place, scale))
        covs.append((a, b, c))
        off, total = 0.0, 0.0
        if math.isfinite(reading[k]):
            off, total = reading[k] - place, a + model.white**2
            likelihood -= 0.5 * (off**2 / total + math.log(total))
            to_place, to_scale = a / total, b / total
            place, scale = place + to_place * off, scale + to_scale * off
            a, b, c = a - to_place * a, b - to_place * b, c - to_scale * b
        offs.append(off)
        totals.append(total)
    return Ahead(np.array(states), np.array(covs), np.array(offs), np.array(totals), likelihood)


def _smooth(run: Run, slipped: np.ndarray, model: Model) -> Smooth:
    """The filter, and de Jong's smoother backwards, whose sum says of each step too what a jump in it would explain."""
    ahead = _filtered(run, slipped, model)
    n = len(run.reading)
    place, scale_variance, slip = np.empty(n), np.empty(n), np.empty(n)
    r, big = np.zeros(2), np.zeros((2, 2))  # what the readings from k on say of the state before them, and how surely
    for k in range(n - 1, -1, -1):
        a, b, c = ahead.cov[k]
        if ahead.total[k] > 0.0:
            gain = np.array([a, b]) / ahead.total[k]
            left = np.array([[1.0 - gain[0], 0.0], [-gain[1], 1.0]])
            r, big = left.T @ r, left.T @ big @ left
            r[0] += ahead.off[k] / ahead.total[k]
            big[0, 0] += 1.0 / ahead.total[k]
        cov = np.array([[a, b], [b, c]])
        place[k] = ahead.state[k, 0] + cov[0] @ r
        scale_variance[k] = c - cov[1] @ big @ cov[1]
        slip[k] = abs(r[0]) / math.sqrt(big[0, 0]) if big[0, 0] > 0.0 else 0.0
        if k:
            on = np.array([[1.0, run.step[k - 1]], [0.0, 1.0]])
            r, big = on.T @ r, on.T @ big @ on
    return Smooth(place, float(np.median(scale_variance[np.isfinite(run.reading)])), slip[1:])


def _driven(structure: Reconstruction, here: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Steps between frames of one segment the way the camera looks, below 0 where it went back, in the encoder's
    metres. A step of which nothing is ahead, as where it sways or pans, is none of the wheel's."""
    view = structure.poses[here, 2, :3]
    along = np.einsum("ni,ni->n", np.diff(structure.centres[here], axis=0), (view[1:] + view[:-1]) / 2)
    known = np.isfinite(reading)
    place = np.append(0.0, np.cumsum(along))[known]
    spread = float(np.var(place))
    if spread == 0.0:
        return along
    return along * float((place - place.mean()) @ (reading[known] - reading[known].mean()) / spread / known.sum())


def _runs(structure: Reconstruction, chainage: np.ndarray) -> list[Run]:
    runs = []
    for segment in range(len(structure.sigma)):
        here = np.flatnonzero(structure.segment == segment)
        reading = chainage[structure.frames[here]]
        first = int(np.isfinite(reading).argmax())
        here, reading = here[first:], reading[first:]
        if np.isfinite(reading).sum() > 1:
            runs.append(Run(here, reading, _driven(structure, here, reading)))
    return runs


def _find_slips(run: Run, slipped: np.ndarray, model: Model) -> bool:
    """Marks steps in which the wheel slipped, the plainest first; False where they are too many."""
    for _ in range(int(1 + SLIPS * len(slipped))):
        slip = np.where(slipped, 0.0, _smooth(run, slipped, model).slip)
        if slip.max() < SLIP:
            return True
        slipped[slip.argmax()] = True
    return False


def _fitted(runs: list[Run], found: float, walk: float) -> tuple[Model, list[np.ndarray]] | None:
    """The likeliest jitter and drift of the pictures' scale, both over all stretches, and where the wheel slipped; None
    where it did too often."""
    slips = [np.zeros(len(run.step), bool) for run in runs]
    model = Model(found, walk, WIDEST)
    for _ in range(2):
        if not all(_find_slips(run, slipped, model) for run, slipped in zip(runs, slips, strict=True)):
            return None
        tried = [
            Model(found * 2.0 ** (i / 4), walk, WIDEST * 0.5**k) for i, k in itertools.product(range(-4, 5), range(8))
        ]
        model = max(tried, key=lambda m: sum(_filtered(r, s, m).likelihood for r, s in zip(runs, slips, strict=True)))
    return model, slips


def _noise(run: Run, slipped: np.ndarray, encoder: Encoder, drift: float, left: float) -> float:
    """A step's noise, in a metre, with which readings would leave the scale as uncertain as `left`."""
    noise = max(encoder.noise_m_per_sqrt_m, 1e-5)
    model = Model(encoder.quantum / math.sqrt(12), noise, drift)
    while model.walk < 1.0 and _smooth(run, slipped, model).scale_variance < left:
        model = model._replace(walk=WIDER * model.walk)
    return model.walk


def smoothed(
    structure: Reconstruction, chainage: np.ndarray, encoder: Encoder
) -> tuple[np.ndarray, Encoder, float] | None:
    """The readings (n,) without their jitter, how good they are then, and the jitter's standard deviation; None where
    they have none beyond what the encoder says of a step, or what they are off by is not jitter alone."""
    runs = _runs(structure, chainage)
    if not runs:
        return None
    read, seen = (np.concatenate(x) for x in zip(*((np.diff(r.reading), r.step) for r in runs), strict=True))
    both = np.isfinite(read)
    variance, sigma = jitter(read[both], seen[both])
    # Of a counter a reading's error has a variance of q^2 / 12, but neighbours that differ by half counts have q^2 / 4.
    stated = encoder.noise_m_per_sqrt_m**2 * float(np.median(np.abs(seen))) / 2 + encoder.quantum**2 / 4
    if variance - SIGMAS * sigma <= stated:
        return None
    fitted = _fitted(runs, math.sqrt(variance), encoder.noise_m_per_sqrt_m)
    if fitted is None:
        return None
    model, slips = fitted
    out, noise = chainage.copy(), encoder.noise_m_per_sqrt_m
    for run, slipped in zip(runs, slips, strict=True):
        smooth = _smooth(run, slipped, model)
        if np.nanmax(np.abs(smooth.place - run.reading)) > OFF * model.white:
            return None
        # Where nothing was read the pictures alone say what was driven: not once more as the encoder.
        out[structure.frames[run.here]] = np.where(np.isfinite(run.reading), smooth.place, np.nan)
        # The adjustment knows errors of steps only: those that would leave the scale as uncertain.
        noise = max(noise, _noise(run, slipped, encoder, model.drift, smooth.scale_variance))
    return out, dataclasses.replace(encoder, noise_m_per_sqrt_m=noise), model.white
