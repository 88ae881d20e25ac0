"""Uncooled bolometers: corrections that follow temperature and bias."""

from equipix.bolometer.dynamic import DynamicCorrection
from equipix.bolometer.state_fit import fit

__all__ = ["DynamicCorrection", "fit"]
__dir__ = __all__.copy
