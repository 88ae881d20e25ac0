"""Pixels whose values are not proportional to light: found by the fit, they spoil neighbours."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from equipix.calibration.pixel_flags import odd_pixels
from equipix.exposures.front import union

if TYPE_CHECKING:
    from equipix._types import Array, Floats
    from equipix.calibration.options import Options
    from equipix.calibration.weights import Weighted

_CONTRADICTORY = 9.0
"""Mean squared residual of a pixel over the usual one from which its values contradict the fit. Of
five values noise has it in less than one of a million pixels."""


def without_false_pixels(weighted: Weighted, options: Options) -> Weighted:
    """Mask dead and hot pixels that contradict the fit, and fit once more.

    A constant value, taken for a product of light and sensitivity, displaces the beam, and so the
    pixels that see the same cells. A pixel of unusual but proportional response stays.
    """
    dead, hot = odd_pixels(weighted, options.fit)
    if not (dead | hot).any():
        return weighted
    squares = _mean_squares(weighted, options.fit.workers)
    false = (dead | hot) & (squares > _CONTRADICTORY * _usual(weighted, options, squares))
    if not false.any():
        return weighted
    exposures = weighted.exposures
    findings = dataclasses.replace(
        exposures.findings,
        dead=union(exposures.findings.dead, dead & false),
        hot=union(exposures.findings.hot, hot & false),
    )
    exposures = dataclasses.replace(exposures.without(false), findings=findings)
    return weighted._replace(exposures=exposures, fit=exposures.fit(options.fit, weighted.fit))


def _usual(weighted: Weighted, options: Options, squares: Floats) -> float:
    """Mean squared residual of a pixel without influence on the beam: of noise, or of the solver.

    Other pixels have less, since the beam follows them: their mean is the share of the degrees of
    freedom among the measurements.
    """
    exposures, fit = weighted.exposures, weighted.fit
    if fit.degrees_of_freedom < 1:
        return np.inf
    noise = np.nanmedian(squares) * exposures.usable().sum() / fit.degrees_of_freedom
    # Without noise, only what the solver leaves would be compared.
    error = max(options.fit.tolerance, float(fit.error_estimate[-1]))
    power = np.square(exposures.values, dtype=np.float64)
    return float(max(noise, error**2 * np.nanmean(exposures.weighted_squares(power))))


def _mean_squares(weighted: Weighted, workers: int | None) -> Floats:
    """Mean squared residual of each pixel times weights; NaN without any."""
    exposures, fit = weighted.exposures, weighted.fit
    usable = exposures.usable()
    total, count = np.zeros(exposures.shape), np.zeros(exposures.shape)
    for k in range(len(exposures)):
        residual = exposures.residual(fit, k, workers)
        known = usable[k] & np.isfinite(residual)
        variance: Array | float = 1.0 if exposures.variance is None else exposures.variance[k]
        total += np.divide(residual**2, variance, where=known, out=np.zeros(exposures.shape))
        count += known
    return np.asarray(
        np.divide(total, count, where=count > 0, out=np.full(exposures.shape, np.nan))
    )
