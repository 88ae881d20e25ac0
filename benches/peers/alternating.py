"""Alternating least squares in numba: the paper's coordinate descent as loops.

S. E. Stukachev, I. E. Kozhevatov, "Calibration method for spatial distribution of light sensitivity
of matrix photo receivers", Radiophysics and Quantum Electronics (2011). With M fixed each cell of
the beam has a closed form, and with L fixed each pixel has; weights are 1:

    L(u) = Σ_k y_k(p) M(p) / Σ_k M(p)²,   over the exposures whose p = u − d_k is on the sensor
    M(p) = Σ_k y_k(p) L(u) / Σ_k L(u)²,   u = p + d_k,   starting from M = 1
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from peers.race import Outcome, race

if TYPE_CHECKING:
    from collections.abc import Iterator

    from peers.race import ErrorOf


def solve(
    frames: np.ndarray, shifts: np.ndarray, error_of: ErrorOf, tolerance: float, seconds: float
) -> Outcome:
    """Iterate until the true error is within the tolerance or the time is over."""
    return race(_passes(frames, shifts), error_of, tolerance, seconds)


def _passes(frames: np.ndarray, shifts: np.ndarray) -> Iterator[np.ndarray]:
    corners = shifts - shifts.min(axis=0)
    sensitivity = np.ones(frames.shape[1:])
    beam = np.zeros(sensitivity.shape + corners.max(axis=0))
    while True:
        _update_beam(frames, corners, sensitivity, beam)
        _update_sensitivity(frames, corners, beam, sensitivity)
        yield sensitivity


@njit("(f8[:,:,::1], i8[:,::1], f8[:,::1], f8[:,::1])", parallel=True, fastmath=True, cache=True)
def _update_beam(frames, corners, sensitivity, beam):
    rows, cols = sensitivity.shape
    for cell in prange(len(beam)):
        above, below = np.zeros(beam.shape[1]), np.zeros(beam.shape[1])
        for k in range(len(frames)):
            row, corner = cell - corners[k, 0], corners[k, 1]
            if 0 <= row < rows:
                y, m = frames[k, row], sensitivity[row]
                products, squares = above[corner:], below[corner:]
                for col in range(cols):
                    products[col] += y[col] * m[col]
                    squares[col] += m[col] * m[col]
        for col in range(beam.shape[1]):
            if below[col] > 0:
                beam[cell, col] = above[col] / below[col]


@njit("(f8[:,:,::1], i8[:,::1], f8[:,::1], f8[:,::1])", parallel=True, fastmath=True, cache=True)
def _update_sensitivity(frames, corners, beam, sensitivity):
    rows, cols = sensitivity.shape
    for row in prange(rows):
        products, squares = np.zeros(cols), np.zeros(cols)
        for k in range(len(frames)):
            y, light = frames[k, row], beam[row + corners[k, 0], corners[k, 1] :]
            for col in range(cols):
                products[col] += y[col] * light[col]
                squares[col] += light[col] * light[col]
        for col in range(cols):
            sensitivity[row, col] = products[col] / squares[col]
