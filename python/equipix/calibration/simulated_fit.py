"""What a right model leaves in its residuals: a fit of simulated noise."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.calibration.error_bars import with_dark_misfit
from equipix.calibration.residuals import EXACT, FEWEST, sampled, tested
from equipix.calibration.weights import Weighted
from equipix.calibration.window_fit import if_there_is_light, window_of

if TYPE_CHECKING:
    from equipix._native import Fit
    from equipix._types import Bools
    from equipix.exposures.exposures import Exposures
    from equipix.exposures.options import FitOptions


class Chi2(NamedTuple):
    """Reduced χ², and its standard error where model and variances are right."""

    value: float
    std: float


@if_there_is_light
def simulated_chi2(weighted: Weighted, options: FitOptions) -> Chi2 | None:
    """Reduced χ² by the degrees of freedom that simulated measurements have; None without such.

    Notes
    -----
    The measurements are c L M + d + σ e on a central window, with the c, L and M of its fit, the
    given variances σ², normal e, and an error d of the dark that all exposures share. F of their
    fit, over what it is expected to be, is the factor by which degrees of freedom are counted
    wrongly: a spline's penalty determines cells that only noisy pixels see, and a prior on M dim
    pixels. That of the whole sensor is divided by it [1]_. Pixels whose M follows the prior are
    left out of F. None where the window has too few degrees of freedom, or where the fit of the
    simulation is not exact enough.

    References
    ----------
    .. [1] B. Efron, R. J. Tibshirani, "An Introduction to the Bootstrap" (1993), section 6.5: the
       parametric bootstrap.
    """
    # Coordinate descent would take thousands of sweeps for large-scale errors of this fit alone.
    options = dataclasses.replace(options, progress=None, method="multiscale")
    window, fit = window_of(weighted.exposures, weighted.fit)
    part = weighted
    if fit is None:
        part = with_dark_misfit(Weighted(window, window.fit(options), None), options)
    right = simulated(part, options)
    other = Weighted(right, right.fit(options, part.fit), None)
    exact = sampled(other, workers=options.workers).inexactness <= EXACT
    if part.fit.degrees_of_freedom < FEWEST or not exact:
        return None
    free = tested(part.fit)
    factor = squares(right, other.fit, free, options) / part.expected_misfit
    left = squares(weighted.exposures, weighted.fit, tested(weighted.fit), options)
    std = float(np.hypot(weighted.chi2_std, part.chi2_std))
    return Chi2(left / factor / weighted.expected_misfit, std)


def simulated(part: Weighted, options: FitOptions, sign: int = 1) -> Exposures:
    """Exposures of the values that a fit expects, and noise; as they are where it expects none.

    The noise is that of the measurements, and an error of the dark that all exposures share. Both
    are the same numbers in every call, times `sign`.
    """
    window, rng = part.exposures, np.random.default_rng(0)
    values, dark = window.values - window.residuals(part.fit, options.workers), window.dark
    if window.dark_variance is not None:
        error = sign * np.sqrt(window.dark_variance) * rng.standard_normal(window.shape)
        values += error
        dark = None if dark is None else dark - error
    for k, each in enumerate(values):
        scale = sign * part.noise_variance**0.5 * window.deviation(k)
        each += scale * rng.standard_normal(window.shape)
    values = np.where(np.isfinite(values), values, window.values).astype(window.values.dtype)
    return dataclasses.replace(window, values=values, dark=dark)


def squares(exposures: Exposures, fit: Fit, where: Bools, options: FitOptions) -> float:
    """Σ w r² of some pixels, one exposure at a time: large sensors must fit."""
    total = 0.0
    for k in range(len(exposures)):
        scaled = exposures.residual(fit, k, options.workers) / exposures.deviation(k)
        total += float(np.nansum(np.square(scaled[where & exposures.usable(k)])))
    return total
