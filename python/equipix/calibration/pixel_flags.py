"""Flags of the pixels of a calibrated sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.defects import response_outliers
from equipix.flags import set_bits

if TYPE_CHECKING:
    from equipix._types import Array, Bools
    from equipix.calibration.weights import Weighted
    from equipix.exposures.options import FitOptions


def pixel_flags(weighted: Weighted, options: FitOptions) -> Array:
    """Bits of `equipix.Flag` of each pixel, shape (rows, cols), uint32.

    Flagged are pixels that the solver left undetermined, those found before the fit, outliers of
    the response, and pixels whose measurements contradict each other.
    """
    exposures, fit = weighted.exposures, weighted.fit
    flags: Array = fit.flags.copy()
    dead, hot = odd_pixels(weighted, options)
    set_bits(flags, "dead", dead)
    set_bits(flags, "hot", hot)
    for finding, pixels in vars(exposures.findings).items():
        set_bits(flags, finding, pixels)
    return flags


def odd_pixels(weighted: Weighted, options: FitOptions) -> tuple[Bools, Bools]:
    """Pixels of a much smaller and of a much larger response than their neighbours: dead, hot."""
    sensitivity = weighted.fit.sensitivity.astype(weighted.exposures.values.dtype, copy=False)
    dead, hot = response_outliers(sensitivity, lambda: std_of_pixels(weighted, options.workers))
    return dead | (sensitivity <= options.tolerance), hot


def std_of_pixels(weighted: Weighted, workers: int | None) -> Array:
    """Standard deviation of M, that of the beam left out: 1/√D.

    The noise of a dark adds at most v Σw/D, which it adds where all exposures show the same light.
    """
    exposures = weighted.exposures
    information = weighted.fit.information(workers=workers)
    variance: float | Array = weighted.noise_variance
    if exposures.dark_variance is not None:
        ones = np.where(np.isfinite(exposures.values), 1.0, np.nan)
        weights = np.nansum(exposures.weighted_squares(ones), axis=0)
        variance = variance + exposures.dark_variance * weights
    with np.errstate(divide="ignore"):
        return np.asarray(1 / np.sqrt(information / variance))
