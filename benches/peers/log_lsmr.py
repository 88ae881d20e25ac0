"""SciPy's LSMR on the logarithms: ln y_k(p) = ln L(p + d_k) + ln M(p), one sparse matrix.

D. C.-L. Fong, M. Saunders, "LSMR: An iterative algorithm for sparse least-squares problems", SIAM
J. Sci. Comput. 33, 2950 (2011). Weights 1 of y are weights y² of ln y, since a small step of ln y
is that of y over y: each row of the matrix and its right side are multiplied by y. Columns are
scaled to norm 1, which is LSMR's diagonal preconditioner (782×582 to 1e-4 with some 230 instead of
270 iterations). The gauge is left to LSMR, whose solution is the shortest.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import lsmr

from peers.race import Outcome

if TYPE_CHECKING:
    from peers.race import ErrorOf

FIRST = 16
"""Iterations of the first trial."""

RESOLUTION = 20
"""The count found is too high by at most one in as many."""


def solve(
    frames: np.ndarray, shifts: np.ndarray, error_of: ErrorOf, tolerance: float, seconds: float
) -> Outcome:
    """Find how few iterations bring the true error within the tolerance.

    SciPy shows no estimate on the way, so it starts anew for each number of iterations: twice as
    many each time, then by bisection. The seconds are those of the run that the outcome tells of,
    and no run is planned to take longer than the time given.
    """
    few, enough = 0, FIRST
    best = _run(frames, shifts, error_of, enough)
    while best.error > tolerance:
        most = min(2 * enough, int(enough * seconds / best.seconds))
        if best.passes < enough or most - enough <= enough // RESOLUTION:
            return best
        few, enough = enough, most
        best = _run(frames, shifts, error_of, enough)
    while enough - few > max(1, enough // RESOLUTION):
        middle = (few + enough) // 2
        trial = _run(frames, shifts, error_of, middle)
        if trial.error <= tolerance:
            best, enough = trial, middle
        else:
            few = middle
    return best


def _run(frames: np.ndarray, shifts: np.ndarray, error_of: ErrorOf, iterations: int) -> Outcome:
    shape = frames.shape[1:]
    start = time.perf_counter()
    matrix = _matrix(frames, shifts)
    scale = 1 / np.sqrt(matrix.power(2).sum(axis=0))
    logs = (frames * np.log(frames)).ravel()
    solution, _, passes, *_ = lsmr(
        csr_array(matrix @ diags_array(scale)), logs, atol=0, btol=0, conlim=0, maxiter=iterations
    )
    sensitivity = np.exp((solution * scale)[: shape[0] * shape[1]].reshape(shape))
    seconds = time.perf_counter() - start
    return Outcome(error_of(sensitivity), passes, seconds)


def _matrix(frames: np.ndarray, shifts: np.ndarray) -> csr_array:
    """A row for each value: y at its pixel and y at its cell of the beam, of those seen."""
    _, rows, cols = frames.shape
    corners = shifts - shifts.min(axis=0)
    grid = corners.max(axis=0) + frames.shape[1:]
    places = np.arange(grid.prod()).reshape(grid)
    places = np.stack([places[r : r + rows, c : c + cols] for r, c in corners.tolist()]).ravel()
    seen = np.zeros(grid.prod(), bool)
    seen[places] = True
    cells = rows * cols - 1 + np.cumsum(seen)
    pixels = np.tile(np.arange(rows * cols), len(frames))
    columns = np.stack([pixels, cells[places]], axis=1).astype(np.int32).ravel()
    starts = np.arange(0, columns.size + 1, 2, dtype=np.int32)
    weights = np.repeat(frames.ravel(), 2)
    return csr_array((weights, columns, starts), shape=(frames.size, cells[-1] + 1))
