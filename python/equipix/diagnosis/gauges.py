"""Colours of a calibrated sensor: the gauge of each, and whether one beam is that of all."""

from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from equipix._check import Array, Bools, Floats
from equipix.exposures.exposures import Exposures
from equipix.findings import mean_of_usable, usable
from equipix.fitting.residuals import EXACT, FEWEST, Residuals
from equipix.fitting.weighted import Weighted
from equipix.measured.colour import Colours
from equipix.measured.noise import chi2_tail

_CHANCE = 1e-6
"""Probability below which noise is no explanation."""

_LEAST = 1e-4
"""Difference between the colours' fluxes that does no harm."""

_PARTS = 4
"""Parts of the sensor along each axis."""

_ROUNDS = 20
"""Rounds in which means of exposures and of colours are taken out in turn."""


class Gauge(NamedTuple):
    """What leads from a fit to the result: M → M · of_sensitivity, L → L · of_beam.

    `response` is that of each colour, of mean 1 over the pixels in use; None without a `cfa`.
    """

    of_sensitivity: Floats | float
    of_beam: float
    response: dict[str, float] | None = None


def gauge_of(weighted: Weighted, flags: Array) -> Gauge:
    """Find the gauge of mean 1 within each colour, over the pixels in use.

    Values over the response r of their colour were fitted. So c L M r is a frame, M r has the mean
    μ, and M the mean m in a colour: the result has M/m, r m/μ and L μ. Of a pattern that nobody
    named it has M r/μ.
    """
    filters = weighted.exposures.filters
    if filters is None:
        mean = mean_of_usable(weighted.fit.sensitivity, flags)
        return Gauge(1 / mean, mean)
    sensitivity, shape = weighted.fit.sensitivity, weighted.exposures.shape
    known = np.isfinite(sensitivity)
    counted = known & usable(flags)
    counted = counted if counted.any() else known
    response = filters.map_of(shape)
    mean = float(np.mean((sensitivity * response)[counted]))
    if not filters.given:
        return Gauge(response / mean, mean)
    means = filters.colours.means(sensitivity, counted)
    found = {label: filters.response[label] * m / mean for label, m in means.items()}
    return Gauge(1 / filters.colours.map_of(means, shape), mean, found)


def scaled(values: Array, factor: Floats | float, dtype: DTypeLike = np.float64) -> Array:
    """Values times a factor in a dtype; the array itself where nothing changes."""
    same = isinstance(factor, float) and factor == 1
    return (values if same else values * factor).astype(dtype, copy=False)


def contradiction(weighted: Weighted, residuals: Residuals, flags: Array) -> str | None:
    """Say where the fluxes of the colours differ, which those of one beam do not; else None.

    Notes
    -----
    For each exposure k, colour j and part of the sensor the flux that residuals r ask for is
    f = Σ w s r / Σ w s² of the signals s. What is common to the colours of an exposure is a flux,
    what is common to the exposures of a colour its response. The rest has (n − 1)(C − 1) degrees of
    freedom in each part; fits absorb some of it, which makes its χ² smaller.
    """
    filters = weighted.exposures.filters
    if filters is None or not filters.given or len(filters.colours.labels) < 2:
        return None
    if weighted.fit.degrees_of_freedom < FEWEST or not residuals.inexactness < EXACT:
        return None
    parts = _sums(weighted, filters.colours, usable(flags))
    scale = weighted.noise_variance
    if weighted.exposures.knows_noise:
        scale *= max(1.0, weighted.reduced_chi2)
    # Of the whole sensor first, then of its parts: a smooth change cancels out over the whole.
    for weights, sums in ([each.sum(axis=2, keepdims=True) for each in parts], parts):
        rest = _rest(weights, sums)
        square = float(np.sum(weights * rest**2))
        size = (square / float(weights.sum())) ** 0.5
        if size > _LEAST and chi2_tail(square / scale, _freedom(weights)) < _CHANCE:
            return _words(weighted.exposures, filters.colours, rest, size)
    return None


def _words(exposures: Exposures, colours: Colours, rest: Floats, size: float) -> str:
    """What is wrong, the value, the limit and the remedy."""
    exposure, colour, _ = np.unravel_index(int(np.argmax(np.abs(rest))), rest.shape)
    largest = float(rest.flat[int(np.argmax(np.abs(rest)))])
    return (
        f"the colours contradict one beam for all: fluxes fitted for each colour differ by "
        f"{size:.2%} rms, most in {exposures.name_of(int(exposure))}, by {largest:+.2%} for "
        f"{colours.labels[colour]!r} (limit {_LEAST:.2%}). The colour of the lamp varies over the "
        "beam, or from exposure to exposure: use a lamp of one colour over the beam, or calibrate "
        "each colour by itself, with 'mask' True for the others and shifts of "
        "equipix.plan.suggest(..., cfa=...)"
    )


def _freedom(weights: Floats) -> int:
    """Fluxes measured less those that exposures and colours have in common, over all parts."""
    measured = weights > 0
    alone = [measured.any(axis=axis).sum() for axis in (0, 1)]
    return int(measured.sum() - sum(alone) + measured.any(axis=(0, 1)).sum())


def _sums(weighted: Weighted, colours: Colours, good: Bools) -> tuple[Floats, Floats]:
    """Σ w s² and Σ w s r of each exposure, colour and part of the sensor."""
    exposures, fit = weighted.exposures, weighted.fit
    rows, cols = (np.arange(size) * _PARTS // size for size in exposures.shape)
    part = rows[:, None] * _PARTS + cols
    group = colours.numbers(exposures.shape).astype(np.int64) * _PARTS**2 + part
    shape = (len(exposures), len(colours.labels), _PARTS**2)
    weights, sums = np.zeros(shape), np.zeros(shape)
    for k in range(len(exposures)):
        signal = exposures.light(fit, k, None) * fit.sensitivity
        residual = exposures.residual(fit, k, None)
        used = exposures.usable(k) & good & np.isfinite(residual)
        deviation = np.broadcast_to(exposures.deviation(k), signal.shape)[used]
        scaled = signal[used] / deviation**2
        for target, factor in ((weights, signal), (sums, residual)):
            count = np.bincount(group[used], scaled * factor[used], minlength=target[k].size)
            target[k] = count.reshape(target[k].shape)
    return weights, sums


def _rest(weights: Floats, sums: Floats) -> Floats:
    """Fluxes of colours less what exposures, and colours, have in common in each part."""
    rest = np.divide(sums, weights, where=weights > 0, out=np.zeros(weights.shape))
    for _ in range(_ROUNDS):
        for axis in (0, 1):
            total = weights.sum(axis=axis, keepdims=True)
            mean = np.sum(weights * rest, axis=axis, keepdims=True)
            rest = rest - np.divide(mean, total, where=total > 0, out=np.zeros(total.shape))
    return np.where(weights > 0, rest, 0)
