"""Weights that depend on the fit: variances by a noise model, and 0 for outliers."""

from __future__ import annotations

import dataclasses
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.calibration.fallen_dust import without_fallen_dust
from equipix.calibration.robust import rejected
from equipix.exposures.front import union
from equipix.noise import modelled_variances

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from equipix._native import Fit
    from equipix._types import Array, Bools, Floats
    from equipix.calibration.options import Options
    from equipix.exposures.exposures import Exposures
    from equipix.exposures.options import FitOptions

_ROUGH = 1e-3
"""Tolerance of a fit that only predicts how much signal to expect: its noise is larger."""

_MOST_ROUNDS = 20
"""Most rounds of fitting and leaving out; a grain of dust takes three or four, a thirtieth of false
values beside as many masked ones nine."""

_FEWEST = 2
"""Fewest measurements of a pixel that confirm each other."""


class Weighted(NamedTuple):
    """Exposures with their final weights, their fit, and the measurements left out.

    `dark_misfit` is what the noise of the dark adds to F on average, `sampled` what the arrays held
    that later questions read again. `excess` is the factor by which a beam that is finer than its
    spline raises the variance of residuals above that given.
    """

    exposures: Exposures
    fit: Fit
    rejected: Bools | None
    dark_misfit: float = 0.0
    sampled: Mapping[str, Array] = MappingProxyType({})
    excess: float = 1.0

    @property
    def reduced_chi2(self) -> float:
        """F over that expected, or the variance of a value of weight 1; NaN where undetermined."""
        freedom = self.fit.degrees_of_freedom
        if freedom <= 0:
            return float("nan")
        if self.exposures.knows_noise:
            return self.fit.misfit / self.expected_misfit
        left = self.fit.misfit - self.dark_misfit
        return left / freedom if left > 0 or self.dark_misfit == 0 else float("nan")

    @property
    def expected_misfit(self) -> float:
        """F where variances are right: degrees of freedom, and what the noise of the dark adds."""
        return self.fit.degrees_of_freedom + self.dark_misfit

    @property
    def chi2_std(self) -> float:
        """Standard error of reduced χ² where variances are known and right.

        In a pixel with f degrees of freedom, of which one has the variance 1 + m by the noise of
        the dark, F has the variance 2f + 4m + 2m². m counts as alike in all pixels: in a beam that
        falls to its edge the standard error is larger, by a fifth in one of width 30 on 48×64.
        """
        added, pixels = self.dark_misfit, int(np.isfinite(self.fit.sensitivity).sum())
        variance = 2 * self.fit.degrees_of_freedom + 4 * added + 2 * added**2 / max(pixels, 1)
        return float(np.sqrt(variance)) / self.expected_misfit

    @property
    def noise_variance(self) -> float:
        """Variance of a value of weight 1: `excess` where variances are known, else reduced χ²."""
        return self.excess if self.exposures.knows_noise else self.reduced_chi2


def weighted_fit(exposures: Exposures, options: Options, start: Fit | None = None) -> Weighted:
    """Fit exposures whose weights may depend on the fit.

    Variances by a noise model are evaluated at what a first fit expects. That fit has the variances
    at the medians over the exposures, pixel by pixel, which no single false value moves far. Each
    fit begins from the one before, the first from `start`.
    """
    options.check(exposures)
    middle = exposures.medians() if exposures.noise else None
    if middle is not None:
        tolerance = max(options.fit.tolerance, _ROUGH)
        rough = dataclasses.replace(options.fit, tolerance=tolerance)
        at_medians = (c * middle for c in exposures.flux.values)
        start = modelled(exposures, at_medians).fit(rough, start)
        exposures = modelled(exposures, expected(exposures, start, middle, options.fit.workers))
    fit = exposures.fit(options.fit, start)
    # With the rough fit go the variances that it refers to.
    del start
    if options.robust:
        return _robust_fit(exposures, options.fit, fit, middle)
    return Weighted(exposures, fit, None)


def _robust_fit(
    exposures: Exposures, options: FitOptions, fit: Fit, middle: Floats | None
) -> Weighted:
    """Leave out outliers and fit again, until nothing changes.

    A measurement that was used again, and is left out once more, stays so: the search ends.
    """
    given = exposures.usable()
    exposures, fit = without_fallen_dust(exposures, fit, options)
    usable = exposures.usable()
    out, returned = np.zeros_like(usable), np.zeros_like(usable)
    kept = exposures
    for _ in range(_MOST_ROUNDS):
        former, out = out, rejected(exposures, fit, out, options)
        out |= former & returned
        if np.array_equal(former, out):
            break
        returned |= former & ~out
        if middle is not None:
            exposures = modelled(exposures, expected(exposures, fit, middle, options.workers))
        kept = contradictory_found(exposures.without(~usable | out), given)
        fit = kept.fit(options, fit)
    return Weighted(kept, fit, out | (given & ~usable))


def contradictory_found(kept: Exposures, given: Bools) -> Exposures:
    """Exposures with a finding for each pixel whose measurements contradict each other.

    Most of those given are left out, or so many that no two agree.
    """
    before, after = given.sum(axis=0), kept.usable().sum(axis=0)
    contradictory = (before > 2 * after) | ((before > after) & (after < _FEWEST))
    found = union(kept.findings.contradictory, contradictory)
    findings = dataclasses.replace(kept.findings, contradictory=found)
    return dataclasses.replace(kept, findings=findings)


def modelled(exposures: Exposures, signals: Iterator[Array]) -> Exposures:
    """Exposures with the variances that their noise models have at these signals."""
    models, like = exposures.noise, exposures.values
    if exposures.filters is None:
        return exposures.weighted(modelled_variances(models, signals, like))
    response = exposures.response  # the models are of values in DN
    variances = modelled_variances(models, (signal * response for signal in signals), like)
    return exposures.weighted(np.asarray(variances / np.square(response), like.dtype))


def expected(
    exposures: Exposures, fit: Fit, middle: Floats, workers: int | None
) -> Iterator[Array]:
    """Signals c · L · M; c times the medians `middle` where the fit determines none."""
    for k, flux in enumerate(exposures.flux.values):
        signal = exposures.light(fit, k, workers) * fit.sensitivity
        yield np.where(np.isfinite(signal), signal, flux * middle)
