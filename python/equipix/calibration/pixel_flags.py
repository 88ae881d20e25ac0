"""Flags of the pixels of a calibrated sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.defects import response_outliers
from equipix.flags import set_bits

if TYPE_CHECKING:
    from equipix._types import Array, Bools, Floats
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
    dead, hot = response_outliers(sensitivity, lambda: std_of_pixels(weighted, options.workers)[1])
    return dead | (sensitivity <= options.tolerance), hot


def _weights(weighted: Weighted) -> Floats:
    """Sum of the weights of each pixel, one exposure at a time: large sensors must fit."""
    exposures = weighted.exposures
    total = np.zeros(exposures.shape)
    for k in range(len(exposures)):
        variance = 1.0 if exposures.variance is None else exposures.variance[k]
        used = exposures.used(weighted.fit, k)
        total += np.divide(1.0, variance, where=used, out=np.zeros(exposures.shape))
    return total


def std_of_pixels(weighted: Weighted, workers: int | None) -> tuple[Array, Array]:
    """Standard deviation of M without and with the noise of the dark, the beam's error left out.

    It is 1/√D. The noise of a dark adds at most v Σw/D, which it adds where all exposures show the
    same light.
    """
    exposures = weighted.exposures
    information = weighted.fit.information(workers=workers)
    variance = weighted.noise_variance
    with np.errstate(divide="ignore"):
        without = np.asarray(1 / np.sqrt(information / variance))
        if exposures.dark_variance is None:
            return without, without
        total = variance + exposures.dark_variance * _weights(weighted)
        return without, np.asarray(1 / np.sqrt(information / total))
