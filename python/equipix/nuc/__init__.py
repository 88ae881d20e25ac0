"""Correction of non-uniformity by a uniform source: response curves and their inverses."""

from equipix.measured.defects import DefectLimits
from equipix.nuc.curve_fit import fit
from equipix.nuc.defect_search import find_defects
from equipix.nuc.response import Response

__all__ = ["DefectLimits", "Response", "find_defects", "fit"]
__dir__ = __all__.copy
