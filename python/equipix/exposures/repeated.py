"""Exposures that are equal, value for value: no noise repeats itself."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from equipix._types import Array
    from equipix.exposures.positions import Positions

_SAMPLED = 4096
"""Values of an exposure that are compared before all are."""


def repeated(values: Array, positions: Positions) -> tuple[int, int] | None:
    """Indices of the first two exposures that are equal though the sensor moved, or None.

    Equal exposures of a constant value are possible in a simulation without noise.
    """
    step = max(1, values[0].size // _SAMPLED)
    samples = [each.ravel()[::step] for each in values]
    for first, second in combinations(range(len(values)), 2):
        has_moved = np.any(positions.shifts[first] != positions.shifts[second])
        if not has_moved or not np.array_equal(samples[first], samples[second], equal_nan=True):
            continue
        known = samples[first][np.isfinite(samples[first])]
        is_constant = known.size == 0 or np.ptp(known) == 0
        if not is_constant and np.array_equal(values[first], values[second], equal_nan=True):
            return first, second
    return None
