"""Rules on levels and on the curves fitted to them: saturation, inverse, misfit."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from equipix._check import Array, Bools
from equipix.errors import InputError
from equipix.findings import Rule, usable
from equipix.measured.defects import SIGMAS
from equipix.measured.means import Averaged
from equipix.measured.measured import Measured
from equipix.measured.noise import inliers, scatter_limit
from equipix.measured.part import blocks, chosen
from equipix.measured.saturation import ROUNDING, Clipping, clipping_advice, is_of_bits, whole
from equipix.nuc.response import Response

_MOST_AT_HIGHEST = 0.5
"""Share of its pixels at the highest value of all levels above which a level saturates."""

_WHOLE = 0.99
"""The same, above which only pixels that do not respond are below: nothing is left to fit."""

_FEWEST_JUDGED = 16
"""Fewest pixels of an array whose spread is judged."""


class Given(NamedTuple):
    """Levels as they were given: averages have noise, and the caller a mask."""

    measured: Measured
    averaged: Averaged | None
    mask: Bools | None


def _on_saturation(given: Given) -> str | None:
    """Say that levels probably saturate.

    Raises
    ------
    InputError
        If a level is at the highest value of all levels in nearly all pixels.

    Notes
    -----
    A level with most of its pixels at exactly the highest value saturates, if the pixels of another
    level differ, or the value is the largest number of some bits. If all levels are even without
    it, they are no frames of a camera.
    """
    measured = given.measured
    top, shares = _at_highest(measured)
    crowded = [level for level, share in enumerate(shares) if share > _MOST_AT_HIGHEST]
    found = measured.clipped
    if crowded and (is_of_bits(top) or _others_differ(measured, crowded)):
        full = [level for level in crowded if shares[level] >= _WHOLE]
        if full:
            raise InputError(
                f"'levels': {_named(shares, full)} are exactly {top:.10g}, the highest value, so "
                "they saturate: leave such levels out, or expose less"
            )
        values = round(sum(shares) * measured.values[0].size)
        found = found or Clipping(top, values)
    if found is None:
        return None
    where = [level for level, share in enumerate(shares) if share > 0] if found.level == top else []
    named = f"{_named(shares, where)} of 'levels': " if where else ""
    return named + clipping_advice(found, "levels.toml", "nuc.fit")


def _at_highest(measured: Measured) -> tuple[float, list[float]]:
    """Highest finite raw value of all levels, and the share of each level's pixels there."""
    tops = [_highest(measured, level) for level in range(len(measured))]
    top = max(tops)
    if not np.isfinite(top) or top <= 0 or measured.values[0].size < _FEWEST_JUDGED:
        return top, [0.0] * len(tops)
    least = top * (1 - ROUNDING)
    return whole(top), [
        _share(measured, level, least) if each >= least else 0.0 for level, each in enumerate(tops)
    ]


def _highest(measured: Measured, level: int) -> float:
    """Largest finite value of a level, or minus infinity."""
    every = (measured.raw_values(level, rows) for rows in blocks(measured.shape))
    return float(max(np.max(raw, initial=-np.inf, where=np.isfinite(raw)) for raw in every))


def _share(measured: Measured, level: int, least: float) -> float:
    """Share of the finite values of a level that are `least` or more."""
    count = above = 0
    for rows in blocks(measured.shape):
        raw = measured.raw_values(level, rows)
        known = np.isfinite(raw)
        count += int(np.count_nonzero(known))
        above += int(np.count_nonzero(known & (raw >= least)))
    return above / max(1, count)


def _others_differ(measured: Measured, crowded: Sequence[int]) -> bool:
    """Whether another level has most of its pixels below its highest value."""
    for level in set(range(len(measured))) - set(crowded):
        top = _highest(measured, level)
        least = top - ROUNDING * abs(top)
        if np.isfinite(top) and _share(measured, level, least) <= _MOST_AT_HIGHEST:
            return True
    return False


def _named(shares: Sequence[float], levels: Sequence[int]) -> str:
    """Name levels with their shares."""
    return " and ".join(f"{shares[each]:.1%} of the values of level {each}" for each in levels)


_SHARE = 0.5
"""Variance of a level that saturates over that of a darker one."""

_ROUNDED_VARIANCE = 0.25
"""Most by which rounding to whole DN changes a variance, in DN²."""

_TAIL = 0.01
"""Share of the pixels beyond the ends of a level's values."""


_Pixels = tuple[Array, ...]
"""Rows and columns of pixels."""


class _Scatter(NamedTuple):
    """Mean value of a level, and the temporal variance of one frame."""

    level: int
    mean: float
    variance: float
    least: float
    """Lower bound of that of the pixels' own noise: a drift of the light is no part of it."""


def _on_full_wells(given: Given) -> str | None:
    """Say that levels scatter less than a darker one, and what to do.

    Notes
    -----
    Saturation is where the temporal variance has its maximum [1]_: a full well loses what exceeds
    it. A drift of the light in the frames of the darker level would look the same, so what all of
    its pixels may have in common does not count. 2¹⁹ pixels, evenly over the sensor, are asked.

    References
    ----------
    .. [1] European Machine Vision Association, "EMVA Standard 1288", release 4.0 linear, 2021.
    """
    averaged = given.averaged
    if averaged is None:
        return None
    used = np.unravel_index(chosen(_used(averaged, given.mask)), averaged.saturated.shape)
    if used[0].size < _FEWEST_JUDGED:
        return None
    lowest = averaged.values[int(np.argmin([each[used].mean() for each in averaged.values]))][used]
    scatters = [
        _scatter(averaged, level, used, lowest)
        for level, frames in enumerate(averaged.frames)
        if frames > 1
    ]
    full = [each for each in scatters if _noisier(each, scatters)]
    if not full:
        return None
    first = min(full, key=lambda each: each.mean)
    darker = max(_noisier(first, scatters), key=lambda each: each.variance)
    return _words(full, first, darker) + _advice(averaged, used, full)


def _noisier(bright: _Scatter, scatters: list[_Scatter]) -> list[_Scatter]:
    """Darker levels with a noise that saturation alone explains."""
    return [
        each
        for each in scatters
        if each.mean < bright.mean
        and bright.variance < min(each.least, _SHARE * each.variance) - _ROUNDED_VARIANCE
    ]


def _used(averaged: Averaged, mask: Bools | None) -> Bools:
    """Pixels with a value and a variance at every level, so that gains are the same at all."""
    used = np.ones(averaged.saturated.shape, bool)
    for value, variance in zip(averaged.values, averaged.variances, strict=True):
        used &= np.isfinite(value)
        used &= np.isfinite(variance)
    return used if mask is None else used & ~mask.reshape(-1, *used.shape).any(axis=0)


def _scatter(averaged: Averaged, level: int, used: _Pixels, lowest: Array) -> _Scatter:
    """Noise of a level, with its bound."""
    frames = averaged.frames[level]
    variances = averaged.variances[level][used].astype(np.float64)
    rise = averaged.values[level][used].astype(np.float64) - lowest
    kept = inliers(variances, scatter_limit(frames))
    common = _common(variances[kept], rise[kept], frames - 1)
    mean, variance = averaged.raw_values(level, used).mean(), float(variances[kept].mean())
    return _Scatter(level, float(mean), variance, variance - common)


def _common(variances: Array, rise: Array, freedom: int) -> float:
    """Largest variance that pixels may have in common, as a drift of the light gives it.

    Notes
    -----
    Sample variances of a variance σ² of their own and C in common have the mean σ² + C, and scatter
    by σ⁴ + 2σ²C, times 2 over the degrees of freedom f: C² is the square of the mean less that.
    Both parts rise with the gain of a pixel, so the scatter is that about their line over the
    `rise` from the lowest level. The scatter of N variances has a relative standard error of
    √((2 + 12/f)/N), with the kurtosis of χ².
    """
    square = float(variances.mean()) ** 2
    error = SIGMAS * float(np.sqrt((2 + 12 / freedom) / variances.size))
    scatter, steepness = float(variances.var()), float(rise.var())
    if steepness > 0:  # not the lowest level itself
        # The line of the variances over the rise explains a part of it.
        covariance = float(np.mean((rise - rise.mean()) * (variances - variances.mean())))
        scatter -= covariance**2 / steepness
    return float(np.sqrt(max(0.0, square * (1 + error) - freedom / 2 * scatter)))


def _words(full: list[_Scatter], first: _Scatter, darker: _Scatter) -> str:
    """Say which levels saturate, with the numbers of the darkest of them."""
    named = " and ".join(f"level {each.level}" for each in full)
    verbs = ("saturates", "counts") if len(full) == 1 else ("saturate", "count")
    least, most = (
        f"{each.variance:.3g} DN² at {each.mean:.6g} DN (level {each.level})"
        for each in (first, darker)
    )
    return (
        f"{named} of 'levels' probably {verbs[0]} below the top of the ADC, by a full well, and "
        f"{verbs[1]} as valid: the variance of a frame is {least}, but {most}. Leave out what "
        "saturates"
    )


def _advice(averaged: Averaged, used: _Pixels, full: list[_Scatter]) -> str:
    """Name the saturation level, where it is above the values of all other levels."""
    if averaged.dark is None and not averaged.raw:
        return ""  # less a dark that was not kept
    saturate = [each.level for each in full]
    free = [level for level in range(averaged.count) if level not in saturate]
    low = min(float(np.quantile(averaged.raw_values(level, used), _TAIL)) for level in saturate)
    highest = max(float(np.quantile(averaged.raw_values(level, used), 1 - _TAIL)) for level in free)
    if np.floor(low) <= highest:
        return ""
    level = f"{np.floor(low):.10g}"
    return (
        f", and write saturation = {level} in [sensor] of levels.toml, or give it as 'saturation' "
        "to equipix.average"
    )


_MOST = 2.0
"""Misfit of the array above which more of it comes from the order than from noise."""

_LEAST = 0.5
"""Mean of reduced χ² below which the noise is less than stated."""


class Curves(NamedTuple):
    """Response curves, and the misfit that they leave half of the pixels."""

    response: Response
    misfit: float


def _on_large_noise(curves: Curves) -> str | None:
    """Say that residuals are smaller than the noise, of which not all pixels have few."""
    response = curves.response
    if not curves.misfit < _LEAST:
        return None
    judged = usable(response.flags) & (response.freedom > 0)
    chi2 = float(response.reduced_chi2[judged].mean())
    if not chi2 < _LEAST:
        return None
    return (
        f"the residuals of the curves are smaller than the noise predicts (reduced "
        f"chi-square {chi2:.3g}, expected 1, limit {_LEAST:g}): standard deviations are too "
        "large, and bad pixels may be missed. Check that the light was steady while the "
        "frames of a level were taken, and that the noise was as stated"
    )


def _on_misfit(curves: Curves) -> str | None:
    """Say that noise does not explain a misfit, and what to do."""
    response, misfit = curves
    power, order = response.metadata.get("next_power"), response.order
    levels = len(response.levels)
    limit = max(_MOST, 1 + SIGMAS * power["standard_error"]) if power else 0.0
    if power and power["ratio"] > limit:
        auto = " or order='auto'" if order < levels - 2 else ""
        return (
            f"curves of order {order} do not follow the levels: their reduced chi-square is "
            f"{misfit:.3g}, and the variance of the next coefficient is {power['ratio']:.3g} times "
            f"that by noise (1 ± {power['standard_error']:.2g} of noise alone, limit {limit:.3g}): "
            f"fit with order={order + 1}{auto}"
        )
    if not misfit > _MOST:
        return None
    higher = ""
    if power:
        higher = f"order {order + 1} explains no more of it than noise, so "
    elif response.metadata["options"]["order"] == "auto":
        higher = "no other order predicts levels that are left out better, so "
    elif order < 3:
        more = "fit with" if order < levels - 2 else "give more levels and fit with"
        higher = f"{more} order={order + 1} or order='auto', "
    return (
        f"curves of order {order} leave half of the pixels a misfit of {misfit:.3g} or more times "
        f"that of noise: {higher}check that the source was steady and that the noise was as "
        "stated. find_defects flags pixels that deviate from the others, not what all have in "
        "common"
    )


_LARGEST_DIFFERENCE = 0.3
"""Largest difference, over the noise of a frame, that passes: it adds 4 % to the noise."""

_MOST_BEYOND = 1e-3
"""Largest share of the usable pixels that may differ by more, without a finding."""


def inverse_error(difference: Array, noise: float | None) -> dict[str, float | int | None]:
    """Compare the error of the cubic with the noise of a frame.

    Parameters
    ----------
    difference : ndarray, shape (pixels,)
        Largest difference to the exact inverse of usable pixels, in DN.
    noise : float, optional
        Noise of a frame, in DN, where it is known.

    Returns
    -------
    dict
        The largest difference, the noise, and the number of pixels beyond the limit, for metadata.
    """
    largest = float(np.max(difference, initial=0.0))
    beyond = 0 if noise is None else int(np.count_nonzero(difference > _LARGEST_DIFFERENCE * noise))
    return {"largest_error_dn": largest, "noise_dn": noise, "pixels_beyond": beyond}


def _on_inverse(response: Response) -> str | None:
    """Say that the cubic misses the inverse of the curves in many pixels."""
    largest, noise, beyond = response.metadata["inverse"].values()
    count = int(np.count_nonzero(usable(response.flags)))
    if not beyond > _MOST_BEYOND * count:
        return None
    return (
        f"the cubic that inverts the curves differs from their inverse by up to {largest:.2g} "
        f"DN, and in {beyond} of {count} pixels by more than {_LARGEST_DIFFERENCE:g} "
        f"of the noise of a frame, {noise:.2g} DN: correct(exact=True), or fit a lower order "
        "or a smaller range of levels"
    )


GIVEN: tuple[Rule[Given], ...] = (
    Rule("saturation", "input", _on_saturation),
    Rule("full_well", "input", _on_full_wells, unless=frozenset({"saturation"})),
    Rule("light", "misfit", lambda given: given.measured.unsteady),
)
"""What is asked of levels as they were given."""

INVERSE: tuple[Rule[Response], ...] = (Rule("inverse", "misfit", _on_inverse),)
"""What is asked of a response."""

CURVES: tuple[Rule[Curves], ...] = (
    Rule("variance", "misfit", _on_large_noise),
    Rule("misfit", "misfit", _on_misfit),
)
"""What is asked of curves that are fitted to more levels than they need."""
