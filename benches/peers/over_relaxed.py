"""Kuhn-Lin-Loranz by successive over-relaxation.

R. M. Toussaint, J. W. Harvey, D. Toussaint, "Improved convergence for CCD gain calibration using
simultaneous-overrelaxation techniques", AJ 126, 1112 (2003); the HMI flat-field code has it too,
with factor 1.2 and ten passes. The fixed point is that of `kuhn_lin_loranz`, but each pixel takes
its step at once, so that those after it see the new value, and the step is stretched:

    g(p) ← g(p) + factor · [K(p) + mean g(q) − g(p)]

Strips of rows as high as the longest move take turns, even ones and odd ones: pixels of two even
strips never meet, so threads share them out and the result is still the same for any number.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from peers.kuhn_lin_loranz import framed, inner, pairs_of
from peers.race import Outcome, race

if TYPE_CHECKING:
    from collections.abc import Iterator

    from peers.race import ErrorOf


def solve(
    frames: np.ndarray,
    shifts: np.ndarray,
    error_of: ErrorOf,
    tolerance: float,
    seconds: float,
    *,
    factor: float,
) -> Outcome:
    """Iterate until the true error is within the tolerance or the time is over."""
    passes = _passes(frames, shifts, factor)
    return race(passes, lambda g: error_of(np.exp(g)), tolerance, seconds)


def _passes(frames: np.ndarray, shifts: np.ndarray, factor: float) -> Iterator[np.ndarray]:
    pairs = pairs_of(frames, shifts)
    g = framed(pairs)
    level = pairs.moves[:, 0] == 0
    beside, apart = pairs.moves[level, 1], pairs.moves[~level]
    while True:
        _update(g, beside, apart, pairs.number, pairs.constant, factor)
        yield inner(g, pairs)


@njit(
    "(f8[:,::1], i8[::1], i8[:,::1], f8[:,::1], f8[:,::1], f8)",
    parallel=True,
    fastmath=True,
    cache=True,
)
def _update(g, beside, apart, count, constant, factor):
    rows, cols = constant.shape
    top, left = (g.shape[0] - rows) // 2, (g.shape[1] - cols) // 2
    height = max(top, 1)
    strips = (rows + height - 1) // height
    for parity in range(2):
        for index in prange((strips + 1 - parity) // 2):
            first = (2 * index + parity) * height
            for row in range(first, min(rows, first + height)):
                # The other rows stand still meanwhile, so their sums need no order.
                total = np.zeros(cols)
                for pair in range(len(apart)):
                    there = g[top + row + apart[pair, 0], left + apart[pair, 1] :]
                    for col in range(cols):
                        total[col] += there[col]
                here, number, mean = g[top + row], count[row], constant[row]
                for col in range(cols):
                    value = total[col]
                    for move in beside:
                        # Unsigned: numba then need not ask whether it counts from the end.
                        value += here[np.uint64(left + col + move)]
                    step = mean[col] + value / number[col] - here[left + col]
                    here[left + col] += factor * step
