"""Order of response curves: what the levels allow, and which order predicts a held-out level."""

from typing import get_args

import numpy as np

from equipix._check import Array, By, Floats, Order, check_word, described, is_whole
from equipix.errors import InputError
from equipix.nuc.curves import response_at
from equipix.nuc.levels import Levels, alike_pixels
from equipix.nuc.response import typical

HELD = 4
"""Most levels that are held out to choose an order."""

_BETTER = 1e-3
"""Relative fall of the prediction error that a higher order must bring."""

_ROUNDING = 1e-9
"""Prediction error of exact data, relative to the largest level."""

_MEDIAN_ERROR = 2.33
"""Standard error of the median of N squares of a normal variable, over it, times √N."""


def check_order(order: object, by: object) -> None:
    """Refuse an unknown order, an unknown `by`, and a `by` that an order does not have."""
    if not (is_whole(order) or isinstance(order, str)) or order not in get_args(Order):
        raise InputError(f"'order' is {described(order)}, expected one of {get_args(Order)}")
    check_word("by", by, get_args(By))
    if by == "gain" and order != 0:
        raise InputError(
            f"'by' is 'gain', but order {order!r} corrects offset and gain: expected order=0"
        )


def check_count(levels: Levels, order: int) -> None:
    """Refuse fewer levels that differ than an order has coefficients."""
    distinct = levels.distinct()
    if distinct > order:
        return
    means = ", ".join(f"{reference:.6g}" for reference in levels.references)
    sigma = f", {np.sqrt(np.median(levels.variances)):.2g} DN" if levels.level_noise else ""
    raise InputError(
        f"'levels': {distinct} of {len(levels)} differ by more than the noise of a pixel's mean"
        f"{sigma}, but order {order} needs {order + 1}; their means are {means} DN: take more "
        "levels further apart, or a lower order"
    )


def check_gain(levels: Levels) -> None:
    """Refuse levels with a dark level, or without signal, for a correction by gain: a ratio."""
    if levels.raw:
        raise InputError(
            "'levels' are averages of raw frames, whose dark level would enter the ratio of "
            "by='gain': average them with dark=, or take order=1, which finds the offsets"
        )
    sigma = np.sqrt(levels.variances) if levels.level_noise else np.zeros(len(levels))
    if not np.any(levels.references > 6 * sigma):
        raise InputError(
            f"'levels': the largest mean is {levels.references.max():.6g} DN, which is no signal "
            "for by='gain': give levels with light"
        )


def chosen_order(levels: Levels, by: By, *, workers: int | None) -> tuple[int, list[float]]:
    """Find the order that best predicts levels held out, and the mean square error of each order.

    Notes
    -----
    Up to four levels between the lowest and the highest are left out, one at a time. Where only
    three differ, all levels are: at the mean of two others orders 0 and 1 predict the same. The
    error is the difference of the left-out level to the fit of the others at its reference, in
    standard deviations of the level where noise is known, mean square over usable pixels and
    levels. The lowest order within 0.1 % of the smallest error is taken.

    A pixel that deviates from the others at some order counts at none, nor in V̄: its mean square is
    above 36 times the variance of the normal variable whose square has the median of the array.
    These are the same pixels for all orders, and one in twenty at most: more are a part of the
    array, which the order must fit.

    Of more than 2¹⁹ good pixels so many, evenly over the sensor, are asked: they are an array of
    their own, with its V̄. A mean square error of theirs errs by 0.2 %, and the ratio of two orders
    by less, since both are of the same noise.
    """
    levels = levels.part()
    highest = min(3, levels.distinct() - 2)
    if highest < 1:
        raise InputError(
            f"'order' is 'auto', which leaves out one of the levels between the lowest and the "
            f"highest, but {levels.distinct()} of {len(levels)} differ: give three, or an order"
        )
    between = np.argsort(levels.references)
    if highest > 1:
        between = between[1:-1]
    places = np.unique(np.linspace(0, len(between) - 1, HELD).round().astype(int))
    held, orders = between[places], range(highest + 1)
    squares = np.stack([_squares(levels, held, order, by, workers) for order in orders])
    alike = alike_pixels(squares)
    if not alike.all():
        levels = levels.counting(alike)
        squares = np.stack([_squares(levels, held, order, by, workers) for order in orders])
        alike = alike_pixels(squares)
    errors = squares[:, alike].mean(axis=1).tolist()
    enough = min(errors) * (1 + _BETTER) + (_ROUNDING * np.abs(levels.references).max()) ** 2
    return next(order for order, error in enumerate(errors) if error <= enough), errors


def next_power(levels: Levels, order: int, *, workers: int | None) -> dict[str, float]:
    """Variance over pixels of the coefficient above an order, over that by noise; standard error.

    Notes
    -----
    With a coefficient more the error of a pixel falls, summed over the levels in variances of a
    value, by its square over its variance, and noise adds 1. So the next order is better where this
    ratio is above 2. Pixels whose curves have this order give 1. The residuals of the next order
    give the scale of the noise, so that noise that was understated has no part in it. What all
    pixels have in common is of V̄, not of theirs. Of many pixels a part is asked, as by
    `chosen_order`.

    Both are medians over N pixels, independent of each other. With c = 2.33 the first has the
    relative standard error c/√N, that of residuals of one degree of freedom the same, of more less:
    √(c²/N + c²/N) of their ratio at most. Without residuals it is c/√N.
    """
    levels = levels.part()
    deviation, variances, misfit, _ = levels.fit(order + 1, "offset", workers=workers)
    coefficient, freedom = deviation[-1][levels.good], len(levels) - (order + 2)
    squares = (coefficient - np.median(coefficient)) ** 2 / variances[-1][levels.good]
    ratio, medians = typical(squares, np.array(1)), 1
    if freedom > 0:
        ratio /= typical(misfit[levels.good] / freedom, np.array(freedom))
        medians = 2
    error = _MEDIAN_ERROR * float(np.sqrt(medians / squares.size))
    return {"ratio": ratio, "standard_error": error}


def _squares(levels: Levels, held: Array, order: int, by: By, workers: int | None) -> Floats:
    """Mean square error of each usable pixel, over predictions of each held level by the others."""
    total = np.zeros(int(levels.good.sum()))
    for each in held:
        others = levels.chosen(np.delete(np.arange(len(levels)), each))
        deviation, *_ = others.fit(order, by, workers=workers)
        error = levels.values[each] - response_at(deviation, levels.references[each])
        total += error[levels.good] ** 2 / levels.variances[each]
    return total / len(held)
