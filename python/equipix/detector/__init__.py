"""Photon detectors: the spread of composition of HgCdTe that a correction tolerates."""

from equipix.detector.material import HgCdTe, ShortPass
from equipix.detector.tolerance import composition_tolerance

__all__ = ["HgCdTe", "ShortPass", "composition_tolerance"]
__dir__ = __all__.copy
