"""Pipefish: measure pipes with one fisheye camera.

Names are loaded when first used, so that `import pipefish` and `pipefish --help` are quick.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_LAZY = {
    "Camera": "pipefish.camera",
    "Scene": "pipefish.simulate",
    "Studio": "pipefish.studio",
    "Target": "pipefish.target",
    "Detection": "pipefish.detect",
    "detect_target": "pipefish.detect",
    "homography_from_conics": "pipefish.conics",
    "pose_from_discs": "pipefish.conics",
    "simulate_target_views": "pipefish.studio_targets",
    "simulate_two_views": "pipefish.studio_pairs",
    "simulate_objects": "pipefish.studio_objects",
    "reconstruct": "pipefish.structure",
    "Reconstruction": "pipefish.structure",
    "Encoder": "pipefish.structure",
    "RollingShutter": "pipefish.structure",
    "two_view": "pipefish.twoview",
    "TwoView": "pipefish.twoview",
    "Survey": "pipefish.survey",
    "Tube": "pipefish.tube",
    "fit_tube": "pipefish.tube",
    "Calibration": "pipefish.calibration",
    "CalibrationError": "pipefish.calibration",
    "View": "pipefish.calibration",
    "Matches": "pipefish.matching",
    "Seeds": "pipefish.matching",
    "find_seeds": "pipefish.matching",
    "match_quasi_dense": "pipefish.matching",
    "Groups": "pipefish.grouping",
    "group_matches": "pipefish.grouping",
    "ObjectModel": "pipefish.recognition",
    "Recognition": "pipefish.recognition",
    "recognise": "pipefish.recognition",
    "Layer": "pipefish.segmentation",
    "Motion": "pipefish.segmentation",
    "Segmentation": "pipefish.segmentation",
    "segment_motion": "pipefish.segmentation",
    "Roc": "pipefish.roc_curve",
    "roc": "pipefish.roc_curve",
    "filter_matches": "pipefish.matching_filters",
    "match_back": "pipefish.matching_filters",
    "match_rivals": "pipefish.matching_filters",
    "DenseWall": "pipefish.dense",
    "WallModel": "pipefish.wallmodel",
    "dense_wall": "pipefish.dense",
    "find_cracks": "pipefish.dense_cracks",
    "predicted_seeds": "pipefish.wallmodel",
    "calibrate": "pipefish.calibration",
    "self_calibrate": "pipefish.selfcal",
    "SelfCalibration": "pipefish.selfcal",
    "check_profile": "pipefish.health",
    "ProfileCheck": "pipefish.health",
    "find_image_circle": "pipefish.calib_circle",
    "Keyframe": "pipefish.survey",
    "Tracks": "pipefish.survey",
    "PARAMETERS": "pipefish.camera",
    "Provenance": "pipefish.camera",
    "ArgumentError": "pipefish.errors",
    "PipefishError": "pipefish.errors",
    "FormatError": "pipefish.errors",
    "ProfileError": "pipefish.errors",
}

__all__ = ["__version__", *sorted(_LAZY)]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'pipefish' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
