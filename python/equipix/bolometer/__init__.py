"""Uncooled bolometers: a simulated array, and corrections that follow temperature and bias."""

from equipix.bolometer.dynamic import DynamicCorrection
from equipix.bolometer.state_fit import fit
from equipix.metrics.maps import non_uniformity
from equipix.simulate.bolometers import BolometerArray

__all__ = ["BolometerArray", "DynamicCorrection", "fit", "non_uniformity"]
