"""Pixels that contradict or are faint, and flags of all pixels."""

import numpy as np

from equipix._check import Array, Bools, Floats, union
from equipix.exposures.exposures import FitOptions
from equipix.findings import set_bits
from equipix.fitting.outliers import weights_of
from equipix.fitting.residuals import FEWEST, in_search
from equipix.fitting.weighted import Options, Weighted
from equipix.measured.defects import response_outliers
from equipix.measured.part import blocks, known_part

_CONTRADICTORY = 9.0
"""Mean squared residual of a pixel over the usual one from which its values contradict the fit. Of
five values noise has it in less than one of a million pixels."""

_WITHOUT_NOISE = 1e-3
"""The same below which they show no noise: of three values noise has it in two of a thousand
pixels, of five in three of a million."""

_DEFECTS = 0.2
"""Share of the pixels up to which contradictions are those of pixels: else the model is wrong."""

_SEVERAL = 3
"""Fewest values that show whether they have noise: M fits one, and nearly two."""


def without_false_pixels(weighted: Weighted, options: Options) -> Weighted:
    """Mask dead and hot pixels that contradict the fit, and fit once more.

    A constant value, taken for a product of light and sensitivity, displaces the beam, and so the
    pixels that see the same cells: if it is a large one, theirs are the larger residuals. So those
    in the cells of hot pixels count too, and all hot ones are left out to find what is usual. A
    pixel of unusual but proportional response stays; values without noise, such as 0 always, are
    no measurements.
    """
    dead, hot = odd_pixels(weighted, options.fit)
    suspect = dead | hot
    if not suspect.any():
        return weighted
    squares = _squares(weighted, options.fit.workers)
    own, (noise, error) = _of_pixels(squares), _usual(weighted, squares, options)
    with np.errstate(invalid="ignore"):
        false = own > _CONTRADICTORY * max(noise, error)
        several = np.isfinite(squares).sum(axis=0) >= _SEVERAL
        false |= several & (own < _WITHOUT_NOISE * noise) & (noise > error)
    most = _DEFECTS * np.count_nonzero(np.isfinite(own))
    if hot.any() and weighted.fit.degrees_of_freedom >= FEWEST:
        others = _without(weighted, dead & false, hot, options)
        usual = max(_usual(others, _squares(others, options.fit.workers), options))
        false |= hot & (_of_cells(weighted, squares) > _CONTRADICTORY * usual)
        if false[hot].all() and np.count_nonzero((dead & false) | hot) <= most:
            return others
    false &= suspect
    if np.count_nonzero(false) > most:
        return weighted
    return _without(weighted, dead & false, hot & false, options) if false.any() else weighted


def _without(weighted: Weighted, dead: Bools, hot: Bools, options: Options) -> Weighted:
    """Fit again without dead and hot pixels, which are marked so then."""
    before = weighted.exposures.bad_pixels
    exposures = weighted.exposures.without(dead | hot)
    exposures = exposures.marked(dead=union(before.dead, dead), hot=union(before.hot, hot))
    return weighted.again(exposures, options.fit)


def _of_cells(weighted: Weighted, squares: Floats) -> Floats:
    """Mean of squares (n, rows, cols) over the cells of the beam that each pixel sees."""
    exposures, fit = weighted.exposures, weighted.fit
    total, count = np.zeros((2, *fit.beam.values.shape))
    for k, each in enumerate(squares):
        known = np.isfinite(each)
        exposures.cells(total, fit, k)[:] += np.where(known, each, 0)
        exposures.cells(count, fit, k)[:] += known
    mean = np.divide(total, count, where=count > 0, out=np.zeros(total.shape))
    seen = sum(exposures.cells(mean, fit, k) for k in range(len(squares)))
    return np.asarray(seen / len(squares))


def _usual(weighted: Weighted, squares: Floats, options: Options) -> tuple[float, float]:
    """Mean squared residual of a pixel without influence on the beam: of noise, and of the solver.

    Other pixels have less, since the beam follows them: their mean is the share of the degrees of
    freedom among the measurements.
    """
    exposures, fit = weighted.exposures, weighted.fit
    if fit.degrees_of_freedom < 1:
        return 0.0, np.inf
    searched = in_search(fit)
    used = (exposures.used(fit, k) & searched for k in range(len(exposures)))
    measured = sum(np.count_nonzero(each) for each in used)
    noise = np.nanmedian(_of_pixels(squares)) * measured / fit.degrees_of_freedom
    # Without noise, only what the solver leaves would be compared.
    error = max(options.fit.tolerance, float(fit.error_estimate[-1]))
    power = np.square(exposures.values, dtype=np.float64)
    return float(noise), float(error**2 * np.nanmean(exposures.weighted_squares(power)))


def _squares(weighted: Weighted, workers: int | None) -> Floats:
    """Squared residuals times weights (n, rows, cols); NaN where there are none."""
    exposures = weighted.exposures
    return exposures.weighted_squares(np.square(exposures.residuals(weighted.fit, workers)))


def _of_pixels(squares: Floats) -> Floats:
    """Mean of squares (n, rows, cols) over the exposures of each pixel; NaN without any."""
    count = np.isfinite(squares).sum(axis=0)
    total = np.nansum(squares, axis=0)
    return np.asarray(np.divide(total, count, where=count > 0, out=np.full(total.shape, np.nan)))


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


def without_faint_pixels(weighted: Weighted, options: Options) -> Weighted:
    """Find pixels that the noise of the dark makes unreliable, and leave them out of mean(M).

    The solver knows the noise of exposures alone. The noise of their common dark adds to it where
    the light is weak, so that its limit of 4 % is reached in brighter pixels.
    """
    exposures = weighted.exposures
    if exposures.dark_variance is None:
        return weighted
    without, with_dark = std_of_pixels(weighted, options.fit.workers)
    faint = _faint(with_dark) & ~_faint(without) & (weighted.fit.flags == 0)
    if not faint.any():
        return weighted
    exposures = exposures.marked(faint=faint)
    return weighted.again(exposures, options.fit)


def _faint(std: Array) -> Bools:
    """Pixels known to worse than 4 %, and four times worse than a bright one, as in `prior.rs`.

    The bright one is found among 2¹⁹ pixels, evenly over the sensor, where there are more.
    """
    known = known_part(std)
    known = known[np.isfinite(known)]
    lit = known[known <= _LIT]
    lit = lit if lit.size >= _FEWEST else known
    if not lit.size:
        return np.zeros(std.shape, bool)
    bright = np.quantile(lit, _BRIGHT)
    return np.asarray(np.isfinite(std) & (std > max(_RELIABLE, _WEAK * bright)))


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
    for finding, pixels in vars(exposures.bad_pixels).items():
        set_bits(flags, finding, pixels)
    return flags


def odd_pixels(weighted: Weighted, options: FitOptions) -> tuple[Bools, Bools]:
    """Pixels of a much smaller and of a much larger response than their neighbours: dead, hot."""
    sensitivity = weighted.fit.sensitivity.astype(weighted.exposures.values.dtype, copy=False)
    dead, hot = response_outliers(sensitivity, lambda: std_of_pixels(weighted, options.workers)[1])
    return dead | (sensitivity <= options.tolerance), hot


def std_of_pixels(weighted: Weighted, workers: int | None) -> tuple[Array, Array]:
    """Standard deviation of M without and with the noise of the dark, the beam's error left out.

    It is 1/√D. The noise of a dark adds at most v Σw/D, which it adds where all exposures show the
    same light.
    """
    exposures, noise = weighted.exposures, weighted.noise_variance
    information = weighted.fit.information(workers=workers)
    without = np.empty(exposures.shape)
    with np.errstate(divide="ignore"):
        for rows in blocks(exposures.shape):
            without[rows] = 1 / np.sqrt(information[rows] / noise)
        if exposures.dark_variance is None:
            return without, without
        found = np.zeros(exposures.shape)  # Σw, then the deviation
        for k in range(len(exposures)):
            used = exposures.used(weighted.fit, k)
            for rows in blocks(exposures.shape):
                found[rows] += weights_of(exposures.variance, k, used, rows)
        for rows in blocks(exposures.shape):
            total = noise + exposures.dark_variance[rows] * found[rows]
            found[rows] = 1 / np.sqrt(information[rows] / total)
    return without, found
