"""Correction of non-uniformity from the scene, frame by frame, without a source."""

from equipix.scene.adaptive import SceneCorrection
from equipix.scene.descent import Gated, LocalMean
from equipix.scene.loading import METHODS, load
from equipix.scene.registered import Registered
from equipix.scene.statistics import ConstantStatistics, Kalman

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
