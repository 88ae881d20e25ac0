"""Correction of non-uniformity by a uniform source: response curves and their inverses."""

from equipix.nuc.fit import fit
from equipix.nuc.response import Response

__all__ = ["Response", "fit"]
