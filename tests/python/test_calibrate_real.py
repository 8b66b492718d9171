"""Calibration on real corner sets, with figures that others measured on them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calib_data_sets import jy_stereo, ov_plane, pictures
from pipefish.calibration import calibrate
from pipefish.cli import main


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


def test_pictures_of_two_fisheyes_become_lenses(real_data: Callable[[str], Path]) -> None:
    """From pictures, by the project's detector and default options. Others' corners of Fisheye1 leave p9 .880 px and
    Fisheye2's .324 (.895 and .330 on views left out): ours are found better."""
    data = real_data("calibration")
    for name, count, train, held_out in (("Fisheye1", 15, 0.880, 0.895), ("Fisheye2", 16, 0.324, 0.330)):
        views, size, _ = pictures(data, name)
        assert len(views) == count
        flat = calibrate(views, size, "p9", "flat")
        assert flat.rms <= train
        assert not flat.report["rejected_views"] and not flat.report["rejected_points"]
        best = calibrate(views, size)
        p9, *_, chosen = [row["held_out_rms_px"] for row in best.report["models"] if row["accepted"]]
        assert p9 <= held_out
        assert chosen < 0.6 * p9
        assert best.camera.held_out_rms_px == chosen and best.camera.provenance.held_out_views == count


def test_pictures_through_a_mirror_need_the_asymmetric_terms(real_data: Callable[[str], Path]) -> None:
    views, size, count = pictures(real_data("calibration"), "catadioptric", 2)
    assert len(views) == count == 9
    symmetric, best = calibrate(views, size, "p9", "flat"), calibrate(views, size)
    assert best.rms <= 0.7 * symmetric.rms
    assert all(v["used"] for v in best.report["views"])


def test_pictures_of_a_stereo_pair(real_data: Callable[[str], Path]) -> None:
    """Every fourth pair; the board looks the same when turned, so the detector's numbering may differ between the
    cameras. The baseline is that of the data's own corners (above)."""
    data = real_data("calibration")
    (left, size, count), (right, _, _) = (pictures(data, f"jy_stereo {side}", 4) for side in ("left", "right"))
    assert len(left) == len(right) == count == 9
    result = calibrate(left + right, size, "p9", "shape")
    assert result.rms < 0.29384  # what is left of the data's own corners, one camera alone
    assert 0.095 < np.linalg.norm(result.camera_poses[1][:, 3]) < 0.105


def test_a_board_with_a_row_less_than_was_said_is_refused(
    real_data: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Stray corners beyond its edge were once taken for that row in half of the pictures, and the lens was "usable"."""
    target, out = tmp_path / "board.pdf", tmp_path / "camera.json"
    pictures = [str(p) for p in sorted(real_data("calibration/camodocal").glob("*.png"))[::4]]
    grid = ["--grid", "10x8", "--spacing", "60", "--paper", "700x600"]
    assert main(["target", "checkerboard", *grid, "-o", str(target)]) == 0
    assert main(["calibrate", *pictures, "--target", str(target.with_suffix(".json")), "-o", str(out)]) == 1
    error = capsys.readouterr().err
    assert "smaller than described" in error and "show 9 x 6 inner corners" in error and not out.exists()
