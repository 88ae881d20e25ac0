"""Flags of the pixels of a calibrated sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.defects import response_outliers
from equipix.flags import set_bits

if TYPE_CHECKING:
    from equipix._types import Array
    from equipix.calibration.weights import Weighted
    from equipix.exposures.options import FitOptions


def pixel_flags(weighted: Weighted, options: FitOptions) -> Array:
    """Bits of `equipix.Flag` of each pixel, shape (rows, cols), uint32.

    Flagged are pixels that the solver left undetermined, those found before the fit, outliers of
    the response, and pixels whose measurements contradict each other.
    """
    exposures, fit, rejected = weighted
    flags: Array = fit.flags.copy()
    sensitivity = fit.sensitivity.astype(exposures.values.dtype, copy=False)
    dead, hot = response_outliers(sensitivity, lambda: _std(weighted, options.workers))
    set_bits(flags, "dead", dead | (sensitivity <= options.tolerance))
    set_bits(flags, "hot", hot)
    for finding, pixels in vars(exposures.findings).items():
        set_bits(flags, finding, pixels)
    if rejected is not None:
        kept = exposures.usable().sum(axis=0)
        set_bits(flags, "contradictory", rejected.sum(axis=0) > kept)
    return flags


def _std(weighted: Weighted, workers: int | None) -> Array:
    """Standard deviation of M, that of the beam left out: 1/√D."""
    information = weighted.fit.information(workers=workers)
    with np.errstate(divide="ignore"):
        return np.asarray(1 / np.sqrt(information / weighted.noise_variance))
