"""Kuhn, Lin and Loranz: a fixed point of ln M over pairs of exposures.

J. R. Kuhn, H. Lin, D. Loranz, "Gain calibrating nonuniform image-array data using only the image
data", PASP 103, 1097 (1991), as SolarSoft's mk_kuhn_flat has it. Pixel p in exposure i and pixel
q = p + d_i − d_j in exposure j see the same light, so ln M(p) = ln y_i(p) − ln y_j(q) + ln M(q).
With g = ln M, and means over the ordered pairs (i, j) whose q lies on the sensor,

    g(p) ← K(p) + mean g(q),   K(p) = mean [ln y_i(p) − ln y_j(q)],   starting from g = K
"""

from __future__ import annotations

from itertools import permutations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit, prange

from peers.race import Outcome, race

if TYPE_CHECKING:
    from collections.abc import Iterator

    from peers.race import ErrorOf


class Pairs(NamedTuple):
    """Pairs of exposures: their moves q − p, how many there are at each pixel, and K."""

    moves: np.ndarray
    number: np.ndarray
    constant: np.ndarray

    @property
    def margin(self) -> tuple[int, int]:
        """Rows and columns that the longest moves lead off the sensor."""
        rows, cols = np.abs(self.moves).max(axis=0).tolist()
        return rows, cols


def solve(
    frames: np.ndarray, shifts: np.ndarray, error_of: ErrorOf, tolerance: float, seconds: float
) -> Outcome:
    """Iterate until the true error is within the tolerance or the time is over."""
    passes = _passes(frames, shifts)
    return race(passes, lambda g: error_of(np.exp(g)), tolerance, seconds)


def _passes(frames: np.ndarray, shifts: np.ndarray) -> Iterator[np.ndarray]:
    pairs = pairs_of(frames, shifts)
    g, new = framed(pairs), framed(pairs)
    while True:
        _update(g, *pairs, new)
        g, new = new, g
        yield inner(g, pairs)


def pairs_of(frames: np.ndarray, shifts: np.ndarray) -> Pairs:
    """All ordered pairs of two exposures."""
    pairs = np.array(list(permutations(range(len(shifts)), 2)))
    moves = shifts[pairs[:, 0]] - shifts[pairs[:, 1]]
    return Pairs(moves, *_means(frames, pairs, moves))


def framed(pairs: Pairs) -> np.ndarray:
    """K in a frame of zeros: pixels off the sensor then add nothing, and need no question."""
    return np.pad(pairs.constant, [(margin, margin) for margin in pairs.margin])


def inner(g: np.ndarray, pairs: Pairs) -> np.ndarray:
    """The sensor without the frame."""
    (rows, cols), (top, left) = pairs.constant.shape, pairs.margin
    return g[top : top + rows, left : left + cols]


@njit("(f8[:,:,::1], i8[:,::1], i8[:,::1])", parallel=True, fastmath=True, cache=True)
def _means(frames, pairs, moves):
    logs = np.log(frames)
    _, rows, cols = frames.shape
    count, total = np.zeros((rows, cols)), np.zeros((rows, cols))
    for row in prange(rows):
        for pair in range(len(pairs)):
            there, move = row + moves[pair, 0], moves[pair, 1]
            if 0 <= there < rows:
                first, width = max(0, -move), cols - abs(move)
                ours = logs[pairs[pair, 0], row, first:]
                theirs = logs[pairs[pair, 1], there, first + move :]
                here, seen = total[row, first:], count[row, first:]
                for col in range(width):
                    here[col] += ours[col] - theirs[col]
                    seen[col] += 1
    return count, total / count


@njit(
    "(f8[:,::1], i8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1])",
    parallel=True,
    fastmath=True,
    cache=True,
)
def _update(g, moves, count, constant, new):
    rows, cols = constant.shape
    top, left = (g.shape[0] - rows) // 2, (g.shape[1] - cols) // 2
    for row in prange(rows):
        total = np.zeros(cols)
        for pair in range(len(moves)):
            there = g[top + row + moves[pair, 0], left + moves[pair, 1] :]
            for col in range(cols):
                total[col] += there[col]
        here, number, mean = new[top + row, left:], count[row], constant[row]
        for col in range(cols):
            here[col] = mean[col] + total[col] / number[col]
