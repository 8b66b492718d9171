"""Covariances along a drive of many short tracks, where a recursion from the far end would lose all its digits."""

from __future__ import annotations

import numpy as np

import pipefish as pf
from tube_tracks import tube_drive


def test_covariances_of_a_long_chain_are_positive_and_grow_from_the_held_end() -> None:
    """Takahashi's recursion gave variances of square metres, half of them negative, after 150 keyframes."""
    drive = tube_drive(31, 7.0, step=0.04, limits=(42.0, 88.0), density=1100.0)
    rec = pf.reconstruct(drive.tracks, drive.camera, drive.driven)
    assert rec.status == "ok" and len(rec.frames) > 150
    assert np.linalg.eigvalsh(rec.covariance)[:, 0].min() > 0
    assert np.linalg.eigvalsh(rec.pose_covariance[1:])[:, 0].min() > 0
    sigma = np.sqrt(rec.pose_covariance[:, 3:, 3:].trace(axis1=1, axis2=2))
    assert sigma[0] == 0 and sigma[1] < sigma[40] < sigma[80] < sigma[-1] < 0.2


def test_a_long_chain_needs_no_more_steps_than_a_short_one() -> None:
    """Its softest bends hardly change the cost: damped as the stiff ones are, 100 m took 11 steps, 300 m 26."""
    drive = tube_drive(31, 100.0, density=450.0, limits=(30.0, 89.0))
    rec = pf.reconstruct(drive.tracks, drive.camera, drive.driven)
    assert rec.status == "ok" and len(rec.frames) == 2001
    assert rec.iterations[0] <= 4
