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
        uncertainty,
    )
    from equipix._native import __version__
    from equipix.calibration.calibrate import calibrate
    from equipix.calibration.history import History
    from equipix.calibration.result import Calibration
    from equipix.comparison import Comparison, compare
    from equipix.correction.corrector import Corrector
    from equipix.correction.polynomial import Polynomial, combine
    from equipix.correction.protocol import Correction
    from equipix.experiment.levels import LevelExperiment
    from equipix.experiment.run import Experiment
    from equipix.flags import Flag
    from equipix.frames import FrameStatistics, average
    from equipix.loading import load
    from equipix.noise import NoiseModel
    from equipix.shifts import ShiftMeasurement, Spot, cross_pattern, measure_shift

_HOMES = {
    "Calibration": "calibration.result",
    "Comparison": "comparison",
    "Correction": "correction.protocol",
    "Corrector": "correction.corrector",
    "Experiment": "experiment.run",
    "Flag": "flags",
    "FrameStatistics": "frames",
    "History": "calibration.history",
    "LevelExperiment": "experiment.levels",
    "NoiseModel": "noise",
    "Polynomial": "correction.polynomial",
    "ShiftMeasurement": "shifts",
    "Spot": "shifts",
    "__version__": "_native",
    "average": "frames",
    "calibrate": "calibration.calibrate",
    "combine": "correction.polynomial",
    "compare": "comparison",
    "cross_pattern": "shifts",
    "load": "loading",
    "measure_shift": "shifts",
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
    "uncertainty",
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
    "uncertainty",
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
