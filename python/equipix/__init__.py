"""Pixel sensitivity of image sensors, measured without a uniform light source or with one.

Importing the package loads nothing else; every public name is loaded on first use.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False
"""As `typing.TYPE_CHECKING`, whose import would take longer than all else here."""

if TYPE_CHECKING:
    from typing import Any

    from equipix import (
        bolometer,
        detector,
        errors,
        hardware,
        lens,
        metrics,
        nuc,
        plan,
        scene,
        simulate,
    )
    from equipix._native import __version__
    from equipix.calibration.calibrate import calibrate
    from equipix.calibration.result import Calibration, History
    from equipix.comparison import Comparison, compare
    from equipix.correction.corrector import Corrector
    from equipix.correction.polynomial import Polynomial, combine
    from equipix.correction.protocol import Correction
    from equipix.experiment.experiment import Experiment
    from equipix.experiment.level_experiment import LevelExperiment
    from equipix.exposures.spots import ShiftMeasurement, Spot, cross_pattern, measure_shift
    from equipix.findings import Flag
    from equipix.loading import load
    from equipix.measured.average import average
    from equipix.measured.noise import NoiseModel
    from equipix.measured.statistics import FrameStatistics

_HOMES = {
    "Calibration": "calibration.result",
    "Comparison": "comparison",
    "Correction": "correction.protocol",
    "Corrector": "correction.corrector",
    "Experiment": "experiment.experiment",
    "Flag": "findings",
    "FrameStatistics": "measured.statistics",
    "History": "calibration.result",
    "LevelExperiment": "experiment.level_experiment",
    "NoiseModel": "measured.noise",
    "Polynomial": "correction.polynomial",
    "ShiftMeasurement": "exposures.spots",
    "Spot": "exposures.spots",
    "__version__": "_native",
    "average": "measured.average",
    "calibrate": "calibration.calibrate",
    "combine": "correction.polynomial",
    "compare": "comparison",
    "cross_pattern": "exposures.spots",
    "load": "loading",
    "measure_shift": "exposures.spots",
}
"""The module of each public name."""

_MODULES = (
    "bolometer",
    "detector",
    "errors",
    "hardware",
    "lens",
    "metrics",
    "nuc",
    "plan",
    "scene",
    "simulate",
)
"""Public modules."""

__all__ = [
    "Calibration",
    "Comparison",
    "Correction",
    "Corrector",
    "Experiment",
    "Flag",
    "FrameStatistics",
    "History",
    "LevelExperiment",
    "NoiseModel",
    "Polynomial",
    "ShiftMeasurement",
    "Spot",
    "__version__",
    "average",
    "bolometer",
    "calibrate",
    "combine",
    "compare",
    "cross_pattern",
    "detector",
    "errors",
    "hardware",
    "lens",
    "load",
    "measure_shift",
    "metrics",
    "nuc",
    "plan",
    "scene",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"equipix.{name}")
    if name in _HOMES:
        value = getattr(import_module(f"equipix.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'equipix' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
