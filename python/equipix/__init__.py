"""Pixel sensitivity of image sensors, measured without a uniform light source."""

from equipix import errors, plan, simulate
from equipix._native import __version__
from equipix.calibration import Calibration, History, calibrate
from equipix.comparison import Comparison, compare
from equipix.experiment import Experiment
from equipix.frames import average
from equipix.load import load
from equipix.noise import NoiseModel
from equipix.results import Correction, Flag, FrameStatistics
from equipix.shifts import ShiftMeasurement, Spot, cross_pattern, measure_shift

__all__ = [
    "Calibration",
    "Comparison",
    "Correction",
    "Experiment",
    "Flag",
    "FrameStatistics",
    "History",
    "NoiseModel",
    "ShiftMeasurement",
    "Spot",
    "__version__",
    "average",
    "calibrate",
    "compare",
    "cross_pattern",
    "errors",
    "load",
    "measure_shift",
    "plan",
    "simulate",
]
