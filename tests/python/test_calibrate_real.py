"""Calibration on real corner sets, with figures that others measured on them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib_data_sets import jy_stereo, ov_plane
from pipefish.calibration import calibrate


def test_the_same_minimum_as_opencv(real_data: Callable[[str], Path]) -> None:
    """cv2.fisheye.calibrate 4.6 and 5.0 with a guess, the same function, jy_stereo left: RMS 0.29384931767904, K and D
    below. Ours needs no guess."""
    views, size = jy_stereo(real_data("calibration"), 1)
    result = calibrate(views, size, "p9", "flat", robust=False)
    assert result.rms == pytest.approx(0.29384931767904, abs=1e-8)
    c = result.camera
    found = [c.f_u, c.f_v, c.c_u, c.c_v, c.k2, c.k3, c.k4, c.k5]
    theirs = [559.22387918, 561.20488782, 619.7122555, 381.70144576, -6.9118e-4, -6.86552e-3, 0.0104524, -5.4044e-3]
    assert found == pytest.approx(theirs, abs=1e-6)


def test_a_lens_of_more_than_180_degrees(real_data: Callable[[str], Path]) -> None:
    """ov_plane: a plain prototype's p9 leaves .4746 px on test views, p23 .4574; with the board's shape much less."""
    views, size = ov_plane(real_data("calibration"), "train")
    test, _ = ov_plane(real_data("calibration"), "test")
    flat = calibrate(views, size, "p9", "flat")
    assert flat.test(test) < 0.476
    assert np.degrees(flat.camera.theta_covered) > 92
    assert calibrate(views, size, "p23", "flat").test(test) < 0.458
    assert calibrate(views, size, "p9", "shape").test(test) < 0.375


def test_a_stereo_pair(real_data: Callable[[str], Path]) -> None:
    left, size = jy_stereo(real_data("calibration"), 1)
    right, _ = jy_stereo(real_data("calibration"), 2)
    result = calibrate(left + right, size, "p9", "shape")
    assert result.rms < 0.31
    assert 0.095 < np.linalg.norm(result.camera_poses[1][:, 3]) < 0.105  # the baseline, metres
