"""Photon detectors: the spread of composition of HgCdTe that a correction tolerates."""

from equipix.detector.material import HgCdTe, ShortPass
from equipix.detector.tolerance import Tolerance, composition_tolerance

__all__ = ["HgCdTe", "ShortPass", "Tolerance", "composition_tolerance"]
