"""Standard deviations of what a fit found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from equipix._check import as_array, naming_memory, positive_workers
from equipix.errors import InputError
from equipix.flags import determined, usable
from equipix.maps import tilt_weights

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._native import Fit
    from equipix._types import Array, Bools, Floats, Progress
    from equipix.calibration.lamp_drift import Drift
    from equipix.calibration.weights import Weighted
    from equipix.exposures.options import FitOptions


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
    along_sensitivity : float or None
        Standard deviation of b, the least-squares part b·M of all errors, in the units of the
        frames; None where the fit did not converge or no noise is known. With fitted ratios of the
        levels no measurement changes when O → O + b·M, L → L − b and the ratios are adapted,
        if L is the same at all positions of a pixel.
    of_a_pixel : float or None
        Root mean square of the error of the dark by the noise of the same pixel.
    """

    along_sensitivity: float | None
    of_a_pixel: float | None


def error_bars(
    weighted: Weighted, flags: Array, drift: Drift | None, options: FitOptions
) -> ErrorBars:
    """Standard deviations of sensitivity, tilt and shifts, in one set-up of the linear problem.

    The tilt that a drift of the lamp hides is part of them.
    """
    exposures, fit, _ = weighted
    scale = noise_scale(weighted)
    weights = tilt_weights(usable(flags) & determined(fit.sensitivity, flags))
    asks_tilt = not fit.leaves_tilt and bool(np.isfinite(weights).all())
    refined = fit.refinement == "refined"
    with naming_memory("the error map"):
        answer = fit.uncertainty(
            error_map=True,
            functionals=of_logarithm(weights, fit) if asks_tilt else None,
            shifts=refined,
            offset=False,
            workers=options.workers,
            progress=options.progress,
        )
    std = scale * cast("Floats", answer.std)
    tilt = _std(scale, answer.variances) if asks_tilt else None
    if drift is not None and drift.is_added:
        std = np.hypot(std, fit.sensitivity * np.sqrt(drift.variance_map(fit.sensitivity)))
        tilt = None if tilt is None else np.hypot(tilt, drift.tilt_std)
    shifts = _std(scale, answer.shift_variances) if refined else exposures.positions.std
    return ErrorBars(
        sensitivity=np.asarray(std, exposures.values.dtype),
        tilt=np.full(2, np.inf if fit.leaves_tilt else np.nan) if tilt is None else tilt,
        shifts=shifts,
        exactness={"draws": answer.draws, "relative_standard_error": answer.exactness},
    )


def dark_std(weighted: Weighted, options: FitOptions) -> DarkStd | None:
    """Uncertainty of a dark that was fitted together with fluxes; None for any other."""
    exposures, fit, _ = weighted
    if not exposures.offset or exposures.flux.kind == "known":
        return None
    if not np.isfinite(weighted.noise_variance):
        return DarkStd(None, None)
    with naming_memory("the standard deviation of the dark"):
        answer = fit.uncertainty(
            error_map=False,
            functionals=None,
            shifts=False,
            offset=True,
            workers=options.workers,
            progress=None,
        )
    along, alone = _std(noise_scale(weighted), answer.offset_variances).tolist()
    return DarkStd(along if fit.ended == "converged" else None, alone)


def noise_scale(weighted: Weighted) -> float:
    """Factor of standard deviations that were found for unit weights.

    Raises
    ------
    InputError
        If no variance was given and the residuals cannot determine it.
    """
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


def _std(scale: float, variances: ArrayLike | None) -> Floats:
    """Standard deviations from variances, scaled."""
    return np.asarray(scale * np.sqrt(np.asarray(cast("ArrayLike", variances))))


def functional_std(
    weighted: Weighted,
    weights: Floats,
    drift: Drift | None,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Floats:
    """Standard deviation of the sum of weights · ln M, for each of a stack (m, rows, cols).

    With g = weights/M the variance is gᵀ S⁻¹ g, in the gauge mean(M) = 1: the solution of one
    linear problem, to 1e-4 of the variance.
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
        )
    std = _std(scale, answer.variances)
    if drift is not None and drift.is_added:
        std = np.hypot(std, np.sqrt(drift.variance_of(weights, weighted.fit.sensitivity)))
    return std


def checked_weights(weights: ArrayLike, determined: Bools) -> Floats:
    """Weights of a functional as (m, rows, cols), 0 wherever ln M is undetermined.

    Parameters
    ----------
    weights : array_like, shape (rows, cols) or (m, rows, cols)
        Weights of the pixels.
    determined : ndarray of bool, shape (rows, cols)
        Where ln M is known.

    Returns
    -------
    ndarray, shape (m, rows, cols), float64
        The weights.

    Raises
    ------
    InputError
        If they do not fit the sensor, or are not finite, or not 0 in such a pixel.
    """
    array = as_array("weights", weights, ndim=(2, 3)).astype(np.float64, copy=False)
    if array.shape[-2:] != determined.shape:
        raise InputError(f"'weights' has shape {array.shape}, the sensor {determined.shape}")
    if not np.isfinite(array).all():
        raise InputError("'weights' holds values that are not finite")
    stack = array.reshape(-1, *determined.shape)
    wrong = (stack != 0).any(axis=0) & ~determined
    if wrong.any():
        row, col = np.argwhere(wrong)[0].tolist()
        raise InputError(
            f"'weights' is not 0 in {np.count_nonzero(wrong)} pixels whose ln M is undetermined, "
            f"the first at ({row}, {col}): set it to 0 there"
        )
    return stack
