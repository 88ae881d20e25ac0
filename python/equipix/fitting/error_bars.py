"""Standard deviations of what a fit found."""

import dataclasses
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import Array, Floats, Progress, naming_memory, positive_workers
from equipix._native import Fit, Uncertainty
from equipix.errors import InputError
from equipix.findings import Finding, say
from equipix.fitting.weighted import Options, Weighted
from equipix.metrics.maps import slope_pixels, tilt_weights

_FOUND = 0.1
"""Largest estimated error of M for which noise determines the residuals."""

_FINEST = 2.0
"""Excess of variance by a beam finer than its spline up to which error bars are widened: the error
of M was then 0.93 to 1.1 times what is stated, and above it as little as 0.6 times."""


class ErrorBars(NamedTuple):
    """Standard deviations; see the attributes of `equipix.Calibration`."""

    sensitivity: Array
    tilt: Floats
    shifts: Floats | None
    exactness: dict[str, Any]


class DarkStd(NamedTuple):
    """Uncertainty of a fitted dark.

    Attributes
    ----------
    std_along_sensitivity : float or None
        Standard deviation of b, the least-squares part b·M of all errors, in the units of the
        frames; None where the fit did not converge or no noise is known. With fitted ratios of the
        levels no measurement changes when O → O + b·M, L → L − b and the ratios are adapted,
        if L is the same at all positions of a pixel.
    std_of_a_pixel : float or None
        Root mean square of the error of the dark by the noise of the same pixel.
    """

    std_along_sensitivity: float | None
    std_of_a_pixel: float | None


def standard_deviations(
    weighted: Weighted, flags: Array, options: Options
) -> tuple[ErrorBars | None, DarkStd | None]:
    """Standard deviations of sensitivity, tilt and shifts if asked for, and of a fitted dark.

    That of a dark which was fitted together with fluxes is always given: a finding needs it. All
    are questions of one call, which sets up the linear problem once. A fit too far from its minimum
    or from its beam has none.
    """
    exposures, fit = weighted.exposures, weighted.fit
    wanted = options.uncertainty and why_none(weighted) is None
    asks_dark = exposures.offset and exposures.flux.kind != "known"
    unknown = too_fine(weighted) is not None or not np.isfinite(weighted.noise_variance)
    if asks_dark and not wanted and unknown:
        return None, DarkStd(None, None)
    if not (wanted or asks_dark):
        return None, None
    scale = noise_scale(weighted)
    weights = tilt_weights(slope_pixels(fit.sensitivity, flags))
    asks_tilt = wanted and not fit.leaves_tilt and bool(np.isfinite(weights).all())
    refined = fit.refinement == "refined"
    with naming_memory("the error map" if wanted else "the standard deviation of the dark"):
        answer = fit.uncertainty(
            error_map=wanted,
            functionals=of_logarithm(weights, fit) if asks_tilt else None,
            shifts=wanted and refined,
            offset=asks_dark,
            workers=options.fit.workers,
            progress=options.fit.progress if wanted else None,
            dark_variance=_relative(exposures.dark_variance, scale),
        )
    dark = _of_dark(weighted, answer, scale) if asks_dark else None
    return _error_bars(weighted, answer, scale) if wanted else None, dark


def _error_bars(weighted: Weighted, answer: Uncertainty, scale: float) -> ErrorBars:
    """Standard deviations of sensitivity, tilt and shifts from the answers for unit weights."""
    exposures, fit = weighted.exposures, weighted.fit
    std = scale * cast("Floats", answer.std)
    unknown = np.full(2, np.inf if fit.leaves_tilt else np.nan)
    refined = answer.shift_variances is not None
    return ErrorBars(
        sensitivity=np.asarray(std, exposures.values.dtype),
        tilt=unknown if answer.variances is None else _std(scale, answer.variances),
        shifts=_std(scale, answer.shift_variances) if refined else exposures.positions.std,
        exactness={
            "draws": answer.draws,
            "relative_standard_error": answer.exactness,
            "incomplete_searches": answer.incomplete,
        },
    )


def _of_dark(weighted: Weighted, answer: Uncertainty, scale: float) -> DarkStd:
    """Uncertainty of a fitted dark from the answers for unit weights."""
    along, alone = _std(scale, answer.offset_variances).tolist()
    return DarkStd(along if weighted.fit.ended == "converged" else None, alone)


def with_bounded_dark(weighted: Weighted) -> Weighted:
    """Bound the variance of the dark where no exposure shows its noise.

    That of a frame without light is at most that of one with light. The scatter between neighbours
    of one dark frame holds its pattern too. Arrays, of which no dark is kept, may be means of many
    frames: the variance that is given for their dark stays.
    """
    exposures, most = weighted.exposures, weighted.reduced_chi2
    if exposures.dark is None or exposures.dark_variance is None:
        return weighted
    if exposures.knows_noise or not np.isfinite(most):
        return weighted
    bounded = np.minimum(exposures.dark_variance, most)
    return weighted._replace(exposures=dataclasses.replace(exposures, dark_variance=bounded))


def with_dark_misfit(weighted: Weighted, options: Options) -> Weighted:
    """Add what the noise of the dark adds to F, unless the fit is too far from its minimum."""
    exposures, fit = weighted.exposures, weighted.fit
    found = fit.ended == "converged" or float(fit.error_estimate[-1]) <= _FOUND
    unit = weighted.noise_variance
    if exposures.dark_variance is None or not (found and unit > 0):
        return weighted
    with naming_memory("the misfit of the dark"):
        # In its unit, in which the core decides what is negligible.
        variance = np.ascontiguousarray(exposures.dark_variance / unit)
        added = unit * fit.dark_misfit(variance, workers=options.fit.workers)
    return weighted._replace(dark_misfit=added)


def fits_noise(fit: Fit) -> bool:
    """Whether a fit went on without bringing M within its own size."""
    return fit.ended == "stalled" and not float(fit.error_estimate[-1]) < 1


def too_fine(weighted: Weighted) -> str | None:
    """Say that the beam is so much finer than its spline that errors of M are unknown."""
    if not weighted.excess > _FINEST:
        return None
    return (
        "no standard deviations: the beam is finer than a spline of one knot a pixel can follow, "
        f"and residuals have {weighted.excess:.3g} times the variance of the noise (limit "
        f"{_FINEST:g}): move by whole pixels, or defocus the beam"
    )


def why_none(weighted: Weighted) -> str | None:
    """Say why a fit has no standard deviations: its beam is too fine, or its minimum too far."""
    fit, error = weighted.fit, float(weighted.fit.error_estimate[-1])
    if words := too_fine(weighted):
        return words
    if not fits_noise(fit) and (error <= _FOUND or not fit.is_joint):
        return None
    return (
        "no standard deviations: the fit is too far from its minimum (estimated error "
        f"{error:.1e}, limit {_FOUND:g})"
    )


def noise_scale(weighted: Weighted) -> float:
    """Factor of standard deviations that were found for unit weights.

    Raises
    ------
    InputError
        If the beam is much finer than its spline, or no variance was given and the residuals cannot
        determine it.
    """
    if words := too_fine(weighted):
        raise InputError(words)
    variance = weighted.noise_variance
    if not np.isfinite(variance):
        raise InputError(
            "'variance' is None and the residuals do not determine the noise, since there are no "
            "more measurements than unknowns: give the variance of the values"
        )
    return float(np.sqrt(variance))


def of_logarithm(weights: Floats, fit: Fit) -> Floats:
    """Weights g of M whose sums vary as those of ln M with `weights`: g = w/M."""
    none = np.zeros(weights.shape)
    return np.asarray(np.divide(weights, fit.sensitivity, where=weights != 0, out=none))


def _relative(dark_variance: Floats | None, scale: float) -> Floats | None:
    """Variance of the dark in units of that of a value of weight 1."""
    return None if dark_variance is None else np.ascontiguousarray(dark_variance / scale**2)


def _std(scale: float, variances: ArrayLike | None) -> Floats:
    """Standard deviations from variances, scaled."""
    return np.asarray(scale * np.sqrt(np.asarray(cast("ArrayLike", variances))))


def functional_std(
    weighted: Weighted,
    weights: Floats,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Floats:
    """Standard deviation of the sum of weights · ln M, for each of a stack (m, rows, cols).

    With g = weights/M the variance is gᵀ S⁻¹ g, in the gauge mean(M) = 1: the solution of one
    linear problem, to 1e-4 of the variance. The noise of a dark adds its own.
    """
    scale = noise_scale(weighted)
    with naming_memory("the standard deviation"):
        answer = weighted.fit.uncertainty(
            error_map=False,
            functionals=of_logarithm(weights, weighted.fit),
            shifts=False,
            offset=False,
            workers=positive_workers(workers),
            progress=progress,
            dark_variance=_relative(weighted.exposures.dark_variance, scale),
        )
    if answer.incomplete:
        say(Finding("uncertainty", incomplete_searches(answer.incomplete), "convergence"))
    return _std(scale, answer.variances)


def incomplete_searches(count: int) -> str:
    """Message on searches that ended before their variance was found."""
    return (
        f"{count} of the searches for standard deviations ended early: the measurements barely "
        "constrain some pattern of the sensitivity, and standard deviations that it is part of are "
        "too small. The pattern may lie in weak light (mask it), or the shifts are too regular or "
        "too uncertain (see equipix.plan.error_budget)"
    )
