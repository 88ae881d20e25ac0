"""Pixel sensitivity of image sensors, measured without a uniform light source or with one.

Importing the package loads nothing else; every public name is loaded on first use. Their
types stand in the stub beside this file.
"""

from importlib import import_module

_HOMES = {
    "Calibration": "calibration.result",
    "CameraExperiment": "experiment.camera",
    "Correction": "correction.protocol",
    "Corrector": "correction.apply",
    "Experiment": "experiment.experiment",
    "Finding": "findings",
    "Flag": "findings",
    "FrameStatistics": "measured.statistics",
    "LevelExperiment": "experiment.level_experiment",
    "NoiseModel": "measured.noise",
    "Polynomial": "correction.polynomial",
    "Running": "live.running",
    "__version__": "_native",
    "average": "measured.average",
    "batch": "",
    "bolometer": "",
    "calibrate": "calibration.calibrate",
    "combine": "correction.polynomial",
    "compare": "comparison",
    "cross_pattern": "exposures.spots",
    "detector": "",
    "errors": "",
    "hardware": "",
    "lens": "",
    "load": "saved_results",
    "measure_shift": "exposures.spots",
    "metrics": "",
    "nuc": "",
    "plan": "",
    "scene": "",
    "simulate": "",
}
"""The module of each public name; "" is a module by itself."""

__all__ = [*_HOMES]
__dir__ = __all__.copy


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'equipix' has no attribute '{name}'")
    home = _HOMES[name]
    module = import_module(f"equipix.{home or name}")
    value = getattr(module, name) if home else module
    globals()[name] = value
    return value
