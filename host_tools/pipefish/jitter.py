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


class Smooth(NamedTuple):
    """What the filter gives: readings without their jitter, (n,); logarithm of the likelihood; median variance of the
    scale's logarithm."""

    place: np.ndarray
    likelihood: float
    scale_variance: float


def jitter(step: np.ndarray, length: np.ndarray) -> float:
    """Standard deviation of what each reading is off by itself, from steps (n,) that were read and as the pictures have
    them; 0 where that is not seen. A jitter is in two steps, with opposite signs."""
    if len(step) < LEAST:
        return 0.0
    s = np.cumsum(length)
    slow = length[:, None] * (s / s[-1])[:, None] ** np.arange(3)
    rest = step - slow @ np.linalg.lstsq(slow, step, rcond=None)[0]
    spread = 1.4826 * float(np.median(np.abs(rest)))
    rest = np.clip(rest, -3 * spread, 3 * spread)
    power = float(rest @ rest)
    if power == 0.0 or rest[1:] @ rest[:-1] > -SIGMAS / math.sqrt(len(rest)) * power:
        return 0.0
    return math.sqrt(-float(rest[1:] @ rest[:-1]) / (len(rest) - 1))


def _smooth(reading: np.ndarray, step: np.ndarray, white: float, walk: float, drift: float) -> Smooth:
    """Kalman's filter and Rauch's smoother of place and scale: readings (n,) and the n - 1 steps between them."""
    n = len(reading)
    state = np.array([reading[0], 0.0])
    cov = np.diag([white**2, START**2])
    states, covs = np.empty((n, 2)), np.empty((n, 2, 2))
    ahead, ahead_cov = np.empty((n, 2)), np.empty((n, 2, 2))
    states[0], covs[0], likelihood = state, cov, 0.0
    for k in range(1, n):
        v = step[k - 1]
        a, b, c = cov[0, 0], cov[0, 1], cov[1, 1]
        state = np.array([state[0] + v * (1 + state[1]), state[1]])
        noise = abs(v)
        cov = np.array([[a + v * (2 * b + v * c) + walk**2 * noise, b + v * c], [b + v * c, c + drift**2 * noise]])
        ahead[k], ahead_cov[k] = state, cov
        if math.isfinite(reading[k]):
            total, off = cov[0, 0] + white**2, reading[k] - state[0]
            likelihood -= 0.5 * (off**2 / total + math.log(total))
            gain = cov[:, 0] / total
            state = state + gain * off
            cov = cov - np.outer(gain, cov[0])
        states[k], covs[k] = state, cov
    for k in range(n - 2, -1, -1):
        f = np.array([[1.0, step[k]], [0.0, 1.0]])
        back = np.linalg.solve(ahead_cov[k + 1], f @ covs[k]).T
        states[k] = states[k] + back @ (states[k + 1] - ahead[k + 1])
        covs[k] = covs[k] + back @ (covs[k + 1] - ahead_cov[k + 1]) @ back.T
    return Smooth(states[:, 0], likelihood, float(np.median(covs[:, 1, 1])))


def _driven(structure: Reconstruction, here: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Steps between frames of one segment, below 0 where the wheel turned back, in the encoder's metres."""
    steps = np.diff(structure.centres[here], axis=0)
    length = np.linalg.norm(steps, axis=1)
    turns = np.einsum("ni,ni->n", steps[1:], steps[:-1]) < 0
    way = np.cumprod(np.append(1.0, np.where(turns, -1.0, 1.0)))
    known = np.isfinite(reading)
    if known.sum() < 2:
        return length
    place = np.append(0.0, np.cumsum(way * length))[known]
    ratio = float((place - place.mean()) @ (reading[known] - reading[known].mean()) / np.var(place) / known.sum())
    return ratio * way * length


def smoothed(
    structure: Reconstruction, chainage: np.ndarray, encoder: Encoder
) -> tuple[np.ndarray, Encoder, float] | None:
    """The readings (n,) without their jitter, how good they are then, and the jitter's standard deviation; None where
    they have none beyond what the encoder says of a step."""
    runs = []
    for segment in range(len(structure.sigma)):
        here = np.flatnonzero(structure.segment == segment)
        reading = chainage[structure.frames[here]]
        first = int(np.isfinite(reading).argmax())
        here, reading = here[first:], reading[first:]
        if np.isfinite(reading).sum() > LEAST:
            runs.append((here, reading, _driven(structure, here, reading)))
    if not runs:
        return None
    read, seen = (np.concatenate(x) for x in zip(*((np.diff(r), v) for _, r, v in runs), strict=True))
    both = np.isfinite(read)
    found = jitter(read[both], seen[both])
    stated = math.hypot(
        encoder.noise_m_per_sqrt_m * math.sqrt(float(np.median(np.abs(seen)))), encoder.quantum / math.sqrt(6)
    )
    if math.sqrt(2) * found <= stated:
        return None
    # The likeliest jitter and drift of the pictures' scale, both over all stretches.
    tried = itertools.product(found * 2.0 ** np.arange(-1, 1.01, 0.25), WIDEST * 0.5 ** np.arange(8))
    walk = encoder.noise_m_per_sqrt_m
    _, white, drift = max((sum(_smooth(r, v, w, walk, d).likelihood for _, r, v in runs), w, d) for w, d in tried)
    out, left = chainage.copy(), 0.0
    for here, reading, length in runs:
        smooth = _smooth(reading, length, white, walk, drift)
        out[structure.frames[here]] = smooth.place
        left = max(left, smooth.scale_variance)
    # The adjustment knows errors of steps only: those that would leave the scale as uncertain.
    noise = walk
    while min(_smooth(r, v, encoder.quantum, noise, drift).scale_variance for _, r, v in runs) < left:
        noise = 1.1 * noise + 1e-5
    return out, dataclasses.replace(encoder, noise_m_per_sqrt_m=noise), white
