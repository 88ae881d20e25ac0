"""Pixel sensitivity of image sensors, measured without a uniform light source."""

from equipix._native import __version__
from equipix.frames import average
from equipix.results import FrameStatistics

__all__ = ["FrameStatistics", "__version__", "average"]
