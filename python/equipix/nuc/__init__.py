"""Correction of pixels by a uniform source: response curves and their inverses."""

from __future__ import annotations

from equipix.nuc.fit import fit
from equipix.nuc.response import Response

__all__ = ["Response", "fit"]
