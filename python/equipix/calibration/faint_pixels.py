"""Pixels that the noise of the dark leaves less known than bright ones."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.pixel_flags import std_of_pixels

if TYPE_CHECKING:
    from equipix._types import Array, Bools
    from equipix.calibration.weights import Weighted
    from equipix.exposures.options import FitOptions

_RELIABLE = 0.04
"""Standard deviation of M up to which a pixel is reliable in any light, as the solver has it."""

_WEAK = 4.0
"""Standard deviation of M over that of a bright pixel from which light is weak, likewise."""

_LIT = 0.1
"""Standard deviation of M of a lit pixel: a bright one is among these."""

_BRIGHT = 0.1
"""Share of lit pixels that are better known than a bright one."""

_FEWEST = 16
"""Fewer lit pixels are chance."""


def without_faint_pixels(weighted: Weighted, options: FitOptions) -> Weighted:
    """Find pixels that the noise of the dark makes unreliable, and leave them out of mean(M).

    The solver knows the noise of exposures alone. The noise of their common dark adds to it where
    the light is weak, so that its limit of 4 % is reached in brighter pixels.
    """
    exposures = weighted.exposures
    if exposures.dark_variance is None:
        return weighted
    without, with_dark = std_of_pixels(weighted, options.workers)
    faint = _faint(with_dark) & ~_faint(without) & (weighted.fit.flags == 0)
    if not faint.any():
        return weighted
    findings = dataclasses.replace(exposures.findings, faint=faint)
    exposures = dataclasses.replace(exposures, findings=findings)
    return weighted._replace(exposures=exposures, fit=exposures.fit(options, weighted.fit))


def _faint(std: Array) -> Bools:
    """Pixels known to worse than 4 %, and four times worse than a bright one, as in `prior.rs`."""
    known = std[np.isfinite(std)]
    lit = known[known <= _LIT]
    lit = lit if lit.size >= _FEWEST else known
    if not lit.size:
        return np.zeros(std.shape, bool)
    bright = np.quantile(lit, _BRIGHT)
    return np.asarray(np.isfinite(std) & (std > max(_RELIABLE, _WEAK * bright)))
