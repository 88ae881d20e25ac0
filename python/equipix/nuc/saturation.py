"""Levels that saturate although no one has named the level of saturation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InputError, SaturationWarning, warn
from equipix.exposures.clipping import Clipping, clipping_advice, is_of_bits
from equipix.nuc.full_well import warn_of_full_wells

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equipix._types import Array, Bools
    from equipix.exposures.averaged import Averaged
    from equipix.exposures.front import Measured

_MOST = 0.5
"""Share of its pixels at the highest value of all levels above which a level saturates."""

_WHOLE = 0.99
"""The same, above which only pixels that do not respond are below: nothing is left to fit."""

_FEWEST = 16
"""Fewest pixels of an array whose spread is judged."""

_ROUNDING = 1e-9
"""Relative rounding of means from which a dark was subtracted, and added again."""


def check_saturation(
    measured: Measured, averaged: Averaged | None = None, mask: Bools | None = None
) -> None:
    """Warn of levels that probably saturate, and refuse those that do so as a whole.

    Raises
    ------
    InputError
        If a level is at the highest value of all levels in nearly all pixels.

    Notes
    -----
    A level with most of its pixels at exactly the highest value saturates, if the pixels of another
    level differ, or the value is the largest number of some bits. If all levels are even without
    it, they are no frames of a camera. Where no such value is found, the noise of averages shows
    levels that a full well limits.
    """
    top, shares = _at_highest(measured)
    crowded = [level for level, share in enumerate(shares) if share > _MOST]
    found = measured.clipped
    if crowded and (is_of_bits(top) or _others_differ(measured, crowded)):
        _refuse_whole(top, shares, crowded)
        values = round(sum(shares) * measured.values[0].size)
        found = found or Clipping(top, values)
    if found is None:
        if averaged is not None:
            warn_of_full_wells(averaged, mask)
        return
    where = [level for level, share in enumerate(shares) if share > 0] if found.level == top else []
    named = f"{_named(shares, where)} of 'levels': " if where else ""
    warn(named + clipping_advice(found, "levels.toml", "nuc.fit"), SaturationWarning)


def _at_highest(measured: Measured) -> tuple[float, list[float]]:
    """Highest finite raw value of all levels, and the share of each level's pixels there."""
    tops = [_highest(_raw(measured, level)) for level in range(len(measured.values))]
    top = max(tops)
    if not np.isfinite(top) or top <= 0 or measured.values[0].size < _FEWEST:
        return top, [0.0] * len(tops)
    least = top * (1 - _ROUNDING)
    return _whole(top), [
        _share(_raw(measured, level), least) if each >= least else 0.0
        for level, each in enumerate(tops)
    ]


def _highest(raw: Array) -> float:
    """Largest finite value, or minus infinity."""
    return float(np.max(raw, initial=-np.inf, where=np.isfinite(raw)))


def _share(raw: Array, least: float) -> float:
    """Share of the finite values that are `least` or more."""
    known = np.isfinite(raw)
    count = int(np.count_nonzero(known))
    return int(np.count_nonzero(known & (raw >= least))) / max(1, count)


def _whole(top: float) -> float:
    """The whole number that a mean is but for rounding, or the mean."""
    return float(np.rint(top)) if abs(top - np.rint(top)) <= _ROUNDING * top else top


def _others_differ(measured: Measured, crowded: Sequence[int]) -> bool:
    """Whether another level has most of its pixels below its highest value."""
    for level in set(range(len(measured.values))) - set(crowded):
        raw = _raw(measured, level)
        top = _highest(raw)
        if np.isfinite(top) and _share(raw, top - _ROUNDING * abs(top)) <= _MOST:
            return True
    return False


def _refuse_whole(top: float, shares: Sequence[float], crowded: Sequence[int]) -> None:
    """Refuse levels that saturate in nearly all pixels."""
    whole = [level for level in crowded if shares[level] >= _WHOLE]
    if whole:
        raise InputError(
            f"'levels': {_named(shares, whole)} are exactly {top:.10g}, the highest value, so they "
            "saturate: leave such levels out, or expose less"
        )


def _named(shares: Sequence[float], levels: Sequence[int]) -> str:
    """Name levels with their shares."""
    return " and ".join(f"{shares[each]:.1%} of the values of level {each}" for each in levels)


def _raw(measured: Measured, level: int) -> Array:
    """Values of a level before the dark was subtracted; NaN where they are known to saturate."""
    values: Array = measured.values[level]
    if measured.mask is not None and measured.mask.ndim == 3:
        values = np.where(measured.mask[level], np.nan, values)
    return values if measured.dark is None else values + measured.dark
