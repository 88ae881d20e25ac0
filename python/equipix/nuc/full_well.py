"""Levels above a full well: brighter than another level, and with less noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix.defects import SIGMAS
from equipix.errors import SaturationWarning, warn
from equipix.noise import inliers, scatter_limit

if TYPE_CHECKING:
    from equipix._types import Array, Bools
    from equipix.exposures.averaged import Averaged

_SHARE = 0.5
"""Variance of a level that saturates over that of a darker one."""

_ROUNDING = 0.25
"""Most by which rounding to whole DN changes a variance, in DN²."""

_FEWEST = 16
"""Fewest pixels whose noise is judged."""

_TAIL = 0.01
"""Share of the pixels beyond the ends of a level's values."""


class _Scatter(NamedTuple):
    """Mean value of a level, and the temporal variance of one frame."""

    level: int
    mean: float
    variance: float
    least: float
    """Lower bound of that of the pixels' own noise: a drift of the light is no part of it."""


def warn_of_full_wells(averaged: Averaged, mask: Bools | None) -> None:
    """Warn of levels that scatter less than a darker one, and say what to do.

    Notes
    -----
    Saturation is where the temporal variance has its maximum [1]_: a full well loses what exceeds
    it. A drift of the light in the frames of the darker level would look the same, so what all of
    its pixels may have in common does not count.

    References
    ----------
    .. [1] European Machine Vision Association, "EMVA Standard 1288", release 4.0 linear, 2021.
    """
    used = _used(averaged, mask)
    if np.count_nonzero(used) < _FEWEST:
        return
    lowest = averaged.values[int(np.argmin([each[used].mean() for each in averaged.values]))][used]
    scatters = [
        _scatter(averaged, level, used, lowest)
        for level, frames in enumerate(averaged.frames)
        if frames > 1
    ]
    full = [each for each in scatters if _noisier(each, scatters)]
    if full:
        first = min(full, key=lambda each: each.mean)
        darker = max(_noisier(first, scatters), key=lambda each: each.variance)
        warn(_words(full, first, darker) + _advice(averaged, used, full), SaturationWarning)


def _noisier(bright: _Scatter, scatters: list[_Scatter]) -> list[_Scatter]:
    """Darker levels with a noise that saturation alone explains."""
    return [
        each
        for each in scatters
        if each.mean < bright.mean
        and bright.variance < min(each.least, _SHARE * each.variance) - _ROUNDING
    ]


def _used(averaged: Averaged, mask: Bools | None) -> Bools:
    """Pixels with a value and a variance at every level, so that gains are the same at all."""
    known = np.isfinite(averaged.values) & np.isfinite(averaged.variances)
    used = np.asarray(known.all(axis=0))
    return used if mask is None else used & ~mask.reshape(-1, *used.shape).any(axis=0)


def _scatter(averaged: Averaged, level: int, used: Bools, lowest: Array) -> _Scatter:
    """Noise of a level, with its bound."""
    frames = averaged.frames[level]
    variances = averaged.variances[level][used].astype(np.float64)
    rise = averaged.values[level][used].astype(np.float64) - lowest
    kept = inliers(variances, scatter_limit(frames))
    common = _common(variances[kept], rise[kept], frames - 1)
    mean, variance = float(_raw(averaged, level)[used].mean()), float(variances[kept].mean())
    return _Scatter(level, mean, variance, variance - common)


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
    scatter = float(variances.var()) - _by_rise(variances, rise)
    return float(np.sqrt(max(0.0, square * (1 + error) - freedom / 2 * scatter)))


def _by_rise(variances: Array, rise: Array) -> float:
    """Part of the scatter of variances that their line over the rise explains."""
    steepness = float(rise.var())
    if steepness == 0:  # the lowest level itself
        return 0.0
    covariance = float(np.mean((rise - rise.mean()) * (variances - variances.mean())))
    return covariance**2 / steepness


def _raw(averaged: Averaged, level: int) -> Array:
    """Mean values of a level before the dark was subtracted."""
    values: Array = averaged.values[level]
    return values if averaged.dark is None else values + averaged.dark.mean


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


def _advice(averaged: Averaged, used: Bools, full: list[_Scatter]) -> str:
    """Name the saturation level, where it is above the values of all other levels."""
    if averaged.dark is None and not averaged.raw:
        return ""  # less a dark that was not kept
    saturate = [each.level for each in full]
    free = [level for level in range(averaged.count) if level not in saturate]
    low = min(float(np.quantile(_raw(averaged, level)[used], _TAIL)) for level in saturate)
    highest = max(float(np.quantile(_raw(averaged, level)[used], 1 - _TAIL)) for level in free)
    if np.floor(low) <= highest:
        return ""
    level = f"{np.floor(low):.10g}"
    return (
        f", and write saturation = {level} in [sensor] of levels.toml, or give it as 'saturation' "
        "to equipix.average"
    )
