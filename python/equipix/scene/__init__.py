"""Correction of non-uniformity from the scene, frame by frame, without a source."""

from equipix.scene.methods import ConstantStatistics, Gated, Kalman, LocalMean, Registered

__all__ = ["ConstantStatistics", "Gated", "Kalman", "LocalMean", "Registered"]
__dir__ = __all__.copy
