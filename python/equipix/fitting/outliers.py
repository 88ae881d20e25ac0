"""Measurements that disagree, and dust that falls and stays."""

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix._check import Array, Bools, Floats
from equipix._native import Fit
from equipix.exposures.exposures import Exposures, FitOptions
from equipix.measured.noise import ROBUST, nanmedian_abs

_BEYOND = 5.0
"""Standard deviations that normal noise exceeds in one of two million measurements."""

_NEAR = 3.0
"""The same beside a measurement that is rejected: grains have soft edges."""

_LEADING = 0.7
"""Share of the largest deviation in the same pixel and cell that is suspect. One false value among
m spreads 1/(m − 1) of its own deviation over each of the others: at most a half from m = 3."""

_TESTABLE = 1e-6
"""Least share of its variance that a residual must keep: less is rounding."""


def rejected(exposures: Exposures, fit: Fit, before: Bools, options: FitOptions) -> Bools:
    """Find the measurements to leave out next.

    Parameters
    ----------
    exposures : Exposures
        All measurements that may be used, and their variances, of which only the ratios count.
    fit : Fit
        The fit without those that were left out.
    before : ndarray of bool, shape (n, rows, cols)
        Which were left out.
    options : FitOptions
        Its tolerance is the relative deviation that the solver leaves: a smaller one is none.

    Returns
    -------
    ndarray of bool, shape (n, rows, cols)
        Which to leave out: when it is `before`, the search has ended.

    Notes
    -----
    A hard redescending weight, 1 or 0, in rounds. A false value changes M and L, and so makes its
    own residual smaller and those that share its pixel or its cell larger. So each round leaves out
    only what deviates most in its pixel and in its cell; the next fit shows what remains. A value
    that no longer deviates is used again, and so are those of a pixel that would have no M.
    """
    new, old = deviations(exposures, fit, before, options)
    result = before & ~(old <= _NEAR)
    del old
    leading = np.nan_to_num(new, copy=False)
    leading[before] = 0
    by_pixel = leading.max(axis=0)
    by_cell = np.zeros(fit.beam.values.shape, leading.dtype)
    for k, each in enumerate(leading):
        seen = exposures.cells(by_cell, fit, k)
        np.maximum(seen, each, out=seen)
    # A pixel may lose its connections by mistake while larger deviations mask the false values:
    # then all its measurements are used again.
    result[:, np.isnan(fit.sensitivity)] = False
    for k in range(len(exposures)):
        rival = _LEADING * np.maximum(by_pixel, exposures.cells(by_cell, fit, k))
        suspect = (leading[k] > _NEAR) & (leading[k] >= rival)
        result[k] |= suspect & (leading[k] > _BEYOND)
        result[k] |= suspect & (box_sums(result[k]) > 0)
    return result


def deviations(
    exposures: Exposures, fit: Fit, left_out: Bools, options: FitOptions
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How far each measurement, or the mean of the 3×3 pixels around it, is from the fit.

    Parameters
    ----------
    exposures : Exposures
        The measurements.
    fit : Fit
        Their fit.
    left_out : ndarray of bool, shape (n, rows, cols)
        Which were left out of the fit.
    options : FitOptions
        Its tolerance is the relative deviation that the solver leaves: a smaller one is none.

    Returns
    -------
    new, old : ndarray, shape (n, rows, cols), float32
        The larger of both absolute deviations, in standard deviations; NaN where the residual
        carries no information. `new` is for what was not left out: the mean is over such only, and
        does not count beside one that is conspicuous by itself, whose effect on others would be in
        it. `old` is for what was left out: the mean is over both, each deviation cut off at five.

    Notes
    -----
    M takes the share h_M = w c²L² / Σ w c²L² (over the exposures of the pixel) of a measurement's
    noise out of its residual, L the share h_L = w c²M² / Σ w c²M² (over those of the cell):
    its variance is near (1 − h_M)(1 − h_L) σ², which is exact where every exposure covers all, as
    in a two-way analysis of variance. That of one that was left out is (1 + h_M)(1 + h_L) σ². The
    scale of these is the residuals' own, in each exposure, from their median absolute value. So a
    common factor of the variances given has little effect.
    """
    shape, flux = exposures.shape, fit.flux
    response = np.nan_to_num(fit.sensitivity).astype(np.float64)
    on_pixels = fit.information(workers=options.workers)
    on_cells = np.zeros(fit.beam.values.shape)
    # Light and weights are computed twice: of all exposures they are four times the data.
    for k in range(len(exposures)):
        light, weight = _seen(exposures, fit, k, response, options.workers)
        weight[left_out[k]] = 0
        exposures.cells(on_cells, fit, k)[:] += weight * (flux[k] * response) ** 2
    new, old = (np.empty(exposures.values.shape, np.float32) for _ in range(2))
    for k in range(len(exposures)):
        light, weight = _seen(exposures, fit, k, response, options.workers)
        spread = _spread(
            _share(weight * light**2, on_pixels),
            _share(weight * (flux[k] * response) ** 2, exposures.cells(on_cells, fit, k)),
            left_out[k],
        )
        known = (weight > 0) & (spread > _TESTABLE)  # NaN is not
        light *= response
        root = np.sqrt(weight, out=weight)
        residual = np.full(shape, np.nan)
        scaled = (root * (exposures.values[k] - light))[known] / np.sqrt(spread[known])
        residual[known] = scaled
        used = known & ~left_out[k]
        least = options.tolerance * _median(root * light, known)
        residual /= max(ROBUST * _median(residual, used), least, np.finfo(float).tiny)
        del light, weight, root, spread, scaled
        new[k], old[k] = _conspicuous(residual, used, known)
    return new, old


def _seen(
    exposures: Exposures, fit: Fit, exposure: int, response: Floats, workers: int | None
) -> tuple[Floats, Floats]:
    """Light on each pixel in an exposure, and the weights of what may be used there."""
    light = np.nan_to_num(exposures.light(fit, exposure, workers), copy=False)
    used = exposures.used(fit, exposure) & (light * response != 0)
    return light, weights_of(exposures.variance, exposure, used)


def _spread(of_pixel: Array, of_cell: Array, left_out: Bools) -> Array:
    """Variances of residuals in σ², from the shares of their noise that M and L take."""
    sign = np.where(left_out, 1, -1)
    return np.asarray((1 + sign * of_pixel) * (1 + sign * of_cell))


def _conspicuous(residual: Array, used: Bools, known: Bools) -> tuple[Array, Array]:
    """Deviations alone or of the 3×3 means around, of what was used and of what was left out."""
    own = np.abs(residual)
    quiet = box_sums(used & (own > _BEYOND)) == 0
    new = np.fmax(own, np.where(known & quiet, np.abs(_around(residual, used)), np.nan))
    old = np.fmax(own, np.abs(_around(np.clip(residual, -_BEYOND, _BEYOND), known)))
    new[~known] = old[~known] = np.nan
    return new, old


def _around(residual: NDArray[Any], where: NDArray[np.bool_]) -> NDArray[Any]:
    """Mean of the 3×3 residuals around each pixel, in standard deviations by their own scale."""
    mean = box_sums(np.where(where, residual, 0)) / np.sqrt(np.maximum(box_sums(where), 1))
    return np.asarray(mean / max(1.0, ROBUST * _median(mean, where)))


def weights_of(
    variance: Array | None, exposure: int, used: Bools, rows: slice = slice(None)
) -> Array:
    """Weights 1/σ² of some rows of an exposure; 0 where nothing is used."""
    scale = np.asarray(1.0 if variance is None else variance[exposure])
    used, scale = used[rows], scale[rows] if scale.ndim else scale
    return np.asarray(np.divide(1.0, scale, where=used, out=np.zeros(used.shape)))


def _share(own: NDArray[Any], total: NDArray[Any]) -> NDArray[Any]:
    """Share that a weight has in a sum; NaN where the sum is 0."""
    return np.asarray(np.divide(own, total, where=total > 0, out=np.full(own.shape, np.nan)))


def _median(values: NDArray[Any], where: NDArray[np.bool_]) -> float:
    chosen = np.abs(values[where])
    return float(np.median(chosen, overwrite_input=True)) if chosen.size else 0.0


def box_sums(image: NDArray[Any]) -> NDArray[Any]:
    """Sum of the 3×3 pixels around each, those beyond the border counting 0."""
    padded = np.pad(image.astype(np.float32), 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:])


_STEP_BEYOND = 6.0
"""Standard deviations that a step of the residuals of one pixel does not reach by noise."""

_STEP_NEAR = 3.0
"""The same where the neighbours have one: grains are larger than a pixel, and have soft edges."""

_LEADING_STEP = 0.4
"""Share of the largest step that others must have in a round: through the beam a grain spreads a
part 1/n of its own over other pixels, more where several of its pixels meet."""

_STEP = 0.85
"""Share of the squared residuals of a pixel that one step in time explains. Of a false value in one
exposure it explains at most 0.38 with five exposures, and less with more."""

_TOGETHER = 4
"""Pixels of 3×3 that have their step at one moment. A large reflection in one exposure meets itself
through the beam, in patterns that single pixels may show as a step."""

_MOST_ROUNDS = 10
"""Most rounds of finding and fitting: a large grain hides smaller ones beside it."""


def without_fallen_dust(
    exposures: Exposures, fit: Fit, options: FitOptions
) -> tuple[Exposures, Fit]:
    """Leave out, where dust fell, the values before it did, and fit again.

    Under the grain the sensitivity is then that of the later exposures. Its pixels are marked as
    contradictory.

    Notes
    -----
    Exposures are in the order of time. For each moment with at least two exposures before and after
    it, the difference of the mean residuals after and before is tested. The
    sensitivity of a pixel takes the mean of both, so that residuals change their sign then.
    """
    moment = np.zeros(exposures.shape, np.int64)
    for _ in range(_MOST_ROUNDS):
        step, first = steps(exposures, fit, options)
        found = _together((step > _STEP_BEYOND) & (step > _LEADING_STEP * step.max()), first)
        edges = not found.any() and moment.any()
        if edges:
            padded, (rows, cols) = np.pad(moment, 1), moment.shape
            around = (padded[r : r + rows, c : c + cols] for r in range(3) for c in range(3))
            first = functools.reduce(np.maximum, around)
            found = (moment == 0) & (step > _STEP_NEAR) & (first > 0)
        if not found.any():
            break
        moment = np.where(found, first, moment)
        before = np.arange(len(exposures))[:, None, None] < moment
        exposures = exposures.without(before).marked(contradictory=moment > 0)
        fit = exposures.fit(options, fit.start())
        if edges:
            break
    return exposures, fit


def steps(exposures: Exposures, fit: Fit, options: FitOptions) -> tuple[Floats, NDArray[np.int64]]:
    """Step of the residuals of each pixel in standard deviations, and the first exposure after it.

    It is the smaller of the pixel's own and of that of the 3×3 pixels around; 0 where something
    other than a step explains most of the residuals.
    """
    residuals = _scaled(exposures, fit, options)
    count, shape = len(residuals), exposures.shape
    largest, moment = np.zeros(shape), np.zeros(shape, np.int64)
    square = np.einsum("krc,krc->rc", residuals, residuals)
    for first in range(2, count - 1):
        contrast = np.where(np.arange(count) < first, -1 / first, 1 / (count - first))
        contrast /= np.linalg.norm(contrast)
        own = np.tensordot(contrast.astype(np.float32), residuals, axes=1)
        # Box sums are linear: those of the step are the step of those of the residuals.
        mean = np.abs(box_sums(own)) / 3
        explains = own**2 > _STEP * square
        step = np.where(explains & (mean > _STEP_NEAR), np.abs(own), 0)
        later = step > largest
        moment[later], largest[later] = first, step[later]
    return largest, moment


def _scaled(exposures: Exposures, fit: Fit, options: FitOptions) -> NDArray[np.float32]:
    """Residuals in standard deviations, by their own scale in each exposure; 0 where unknown.

    One exposure after the other, in single precision: they are as many as the data.
    """
    scaled, scale = np.empty(exposures.values.shape, np.float32), np.empty(len(exposures))
    for k, each in enumerate(scaled):
        residual = exposures.residual(fit, k, options.workers)
        usable = exposures.used(fit, k)
        np.divide(residual, exposures.deviation(k), out=residual, where=usable)
        residual[~usable] = np.nan
        scale[k] = ROBUST * nanmedian_abs(residual[None])[0]
        each[:] = residual
    usual = np.maximum(scale, options.tolerance * np.median(scale) + np.finfo(np.float32).tiny)
    scaled /= usual[:, None, None].astype(np.float32)
    return np.nan_to_num(scaled, copy=False)


def _together(found: Bools, first: NDArray[np.int64]) -> Bools:
    """Those that have others beside them, with the step at the same moment."""
    together = np.zeros_like(found)
    for moment in np.unique(first[found]):
        same = found & (first == moment)
        together |= same & (box_sums(same) >= _TOGETHER)
    return together
