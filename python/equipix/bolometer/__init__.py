"""Uncooled bolometers: a simulated array, and corrections that follow temperature and bias."""

from equipix.bolometer.array import BolometerArray
from equipix.bolometer.dynamic import DynamicCorrection
from equipix.bolometer.fit import fit
from equipix.bolometer.quality import non_uniformity

__all__ = ["BolometerArray", "DynamicCorrection", "fit", "non_uniformity"]
