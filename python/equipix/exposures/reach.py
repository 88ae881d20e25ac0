"""Shifts as large as the sensor, and shifts that look like micrometres."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix._check import as_shifts
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from equipix._types import Floats
    from equipix.exposures.positions import Positions

_DECIMALS = 1000
"""Steps per pixel of shifts as people write them."""

_LARGE, _LARGE_WHOLE = 0.1, 0.25
"""Least share of the sensor's side of the largest shift, where steps are a fraction or whole."""

_LEAST_STEP, _LEAST_WHOLE_STEP = 1.0, 3.0
"""Least step, in pixels, of which all shifts are multiples; pixels are 1 to 25 micrometres wide."""


def check_reach(shifts: ArrayLike, positions: Positions, shape: tuple[int, int]) -> None:
    """Refuse a shift as large as the sensor, with its value as it was given.

    Raises
    ------
    InputError
        With the exposure and the remedy.
    """
    for k, (shift, turn) in enumerate(zip(as_shifts(shifts), positions.rotation, strict=True)):
        window = shape if turn % 180 == 0 else shape[::-1]
        for name, part, side in zip(("row", "column"), shift, window, strict=True):
            if abs(part) >= side:
                raise InputError(
                    f"'shifts' of exposure {k} is ({shift[0]:.10g}, {shift[1]:.10g}): its {name} "
                    f"part must be smaller than the sensor, which has {side} there; micrometres "
                    "become pixels when divided by the pixel pitch"
                )


def micrometre_step(shifts: Floats, shape: tuple[int, int]) -> float | None:
    """Return the step that large shifts are multiples of, as shifts in micrometres are; else None.

    Shifts in pixels that are multiples of a step above 1 would leave the sensor in unconnected
    parts, and measured shifts are multiples of no step.
    """
    moves = np.abs(shifts - shifts[0])
    scaled = moves * _DECIMALS
    whole = np.rint(scaled).astype(np.int64)
    different = np.unique(whole[whole > 0])
    if len(different) < 2 or np.abs(scaled - whole).max() > 1e-3:
        return None
    step = int(np.gcd.reduce(different)) / _DECIMALS
    large = float((moves.max(axis=0) / shape).max())
    least = (_LEAST_WHOLE_STEP, _LARGE_WHOLE) if step.is_integer() else (_LEAST_STEP, _LARGE)
    return step if step >= least[0] and large > least[1] else None
