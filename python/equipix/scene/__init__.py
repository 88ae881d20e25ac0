"""Correction of non-uniformity from the scene, frame by frame, without a source."""

from equipix.scene.methods import (
    METHODS,
    ConstantStatistics,
    Gated,
    Kalman,
    LocalMean,
    Registered,
    load,
)
from equipix.scene.scene_correction import SceneCorrection

__all__ = [
    "METHODS",
    "ConstantStatistics",
    "Gated",
    "Kalman",
    "LocalMean",
    "Registered",
    "SceneCorrection",
    "load",
]
