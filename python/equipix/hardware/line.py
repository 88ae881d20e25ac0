"""The straight line of each pixel that a table holds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InputError
from equipix.flags import usable

if TYPE_CHECKING:
    from equipix._types import Bools, Floats
    from equipix.correction.protocol import Correction

_STEPS = 65
"""Raw values at which a straight line is compared with the curve that it replaces."""


def line_of(
    correction: Correction, linearise: tuple[float, float] | None
) -> tuple[Floats, Floats, float]:
    """Offset and gain of each pixel, and the largest sag of a curve that a line replaces, in DN.

    The sag is the range of the difference between the curve and the line through its ends.

    Raises
    ------
    InputError
        If the correction is curved and `linearise` is not given, or has no two rising values.
    """
    planes = np.asarray(correction.coefficients, np.float64)
    if len(planes) < 2:
        raise InputError("'correction' has no gain, expected coefficients of order 1 or more")
    if linearise is None:
        if len(planes) > 2 and np.nan_to_num(planes[2:]).any():
            raise InputError(
                f"'correction' is of order {len(planes) - 1}, but a table of gain and offset holds "
                "order 1: fit a response of order 1, or give 'linearise' (--linearise), two raw "
                "values in DN between which a straight line takes the place of the curve"
            )
        return planes[0], planes[1], 0.0
    return _chord(planes, usable(correction.flags), *check_range(linearise))


def check_range(linearise: object) -> tuple[float, float]:
    """Two rising raw values.

    Raises
    ------
    InputError
        If there are not two, or they do not rise.
    """
    problem = f"'linearise' is {linearise!r}, expected two rising raw values in DN"
    try:
        low, high = (float(each) for each in linearise)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise InputError(problem) from error
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(problem)
    return low, high


def _chord(planes: Floats, used: Bools, low: float, high: float) -> tuple[Floats, Floats, float]:
    """Line parallel to the chord with the smallest largest deviation, and the largest sag."""
    ends = [_curve(planes, value) for value in (low, high)]
    gain = (ends[1] - ends[0]) / (high - low)
    offset = ends[0] - gain * low
    lowest, highest = np.zeros(gain.shape), np.zeros(gain.shape)
    for value in np.linspace(low, high, _STEPS):
        away = _curve(planes, value) - offset - gain * value
        lowest, highest = np.minimum(lowest, away), np.maximum(highest, away)
    sag = (highest - lowest)[used & np.isfinite(gain)]
    # Half of the sag is left on either side.
    return offset + (lowest + highest) / 2, gain, float(sag.max(initial=0))


def _curve(planes: Floats, raw: float) -> Floats:
    total = np.zeros(planes.shape[1:])
    for plane in planes[::-1]:
        total = total * raw + plane
    return total
