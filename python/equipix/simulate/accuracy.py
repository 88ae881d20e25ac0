"""Error of the sensitivity that noise alone leaves at the optimum."""

from collections.abc import Iterable

import numpy as np

from equipix._check import ArrayLike, Floats, Ints, Rng, as_array, as_shifts
from equipix.errors import InputError
from equipix.exposures.positions import whole_moves
from equipix.metrics.maps import rms_at_both_scales
from equipix.simulate.beams import Beam, exposures

_TOLERANCE = 1e-5
"""Norm of the residual at which a solution is taken, relative to that at the start."""


def noise_prediction(
    sensitivity: ArrayLike,
    beam: Beam,
    shifts: ArrayLike,
    variance: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    draws: int = 4,
    rng: Rng,
) -> tuple[float, float]:
    """Error of the sensitivity that noise alone of known variance leaves at the optimum.

    Parameters
    ----------
    sensitivity : array_like, shape (rows, cols)
        True sensitivity M.
    beam : callable
        True beam L, a function of arrays of row and column coordinates.
    shifts : array_like, shape (n, 2)
        Shifts (row, col) in pixels, rounded here so that they differ by whole ones.
    variance : array_like
        Variance of the noise of each value, in the units of the beam squared: one number,
        (rows, cols) or (n, rows, cols). The solution weights each value by its inverse.
    mask : array_like of bool, shape (rows, cols), optional
        True in pixels that are not used.
    draws : int
        Number of random draws that are averaged.
    rng : numpy.random.Generator or int
        Source of the random numbers, or its seed.

    Returns
    -------
    rms : float
        Root mean square of the relative error of M over the pixels, mean over the draws.
    block_rms : float
        The same for means over blocks of 16×16 pixels; NaN for a sensor smaller than a block.

    Raises
    ------
    InputError
        If an argument has the wrong shape, or a variance or a signal is not above 0.

    Notes
    -----
    Around the truth, with relative steps g of M and f of L and ω = (L·M)²/variance, least
    squares is a graph Laplacian problem, S g = b with S = D_M − B·D_L⁻¹·Bᵀ, where D_M and D_L
    sum ω over the exposures on pixels and on beam cells. Noise puts √ω·(white noise of variance
    1) on each measurement, and b sums that as S does. Conjugate gradients, preconditioned by the
    diagonal, solve it; the remaining error is far below the scatter of the draws. A pattern that
    leaves pixels in several connected components has a scale free in each: the prediction then
    leaves those scales out.

    Examples
    --------
    >>> import numpy as np
    >>> from equipix import simulate
    >>> beam = simulate.gaussian_beam((48, 64))
    >>> cross = [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)]
    >>> rms, block_rms = simulate.noise_prediction(np.ones((48, 64)), beam, cross, 1e-6, rng=1)
    >>> print(f"{rms:.1e}")
    5.5e-04
    """
    truth = as_array("sensitivity", sensitivity, ndim=2).astype(np.float64)
    cells = whole_moves(as_shifts(shifts))
    signal = exposures(truth, beam, cells)
    if np.shape(variance) not in ((), truth.shape, signal.shape):
        raise InputError(
            f"'variance' has shape {np.shape(variance)}, expected {signal.shape} or {truth.shape}"
        )
    noise = as_array("variance", variance, ndim=(0, 2, 3)).astype(np.float64)
    if not (np.all(noise > 0) and np.all(signal > 0)):
        raise InputError("'variance' and the signal must be above 0 in every pixel")
    used = ~as_array("mask", np.zeros(truth.shape, bool) if mask is None else mask, ndim=2)
    if used.shape != truth.shape or not used.any():
        raise InputError(f"'mask' of shape {used.shape} leaves no pixel of {truth.shape}")
    system = ReducedSystem(signal**2 / noise * used, cells - cells.min(axis=0))
    rng = np.random.default_rng(rng)
    results = []
    for _ in range(draws):
        steps = system.solve(system.noise(rng))
        error = steps - np.average(steps, weights=truth * used)
        results.append(rms_at_both_scales(np.where(used, error, np.nan)))
    rms, block_rms = np.mean(results, axis=0)
    return float(rms), float(block_rms)


class ReducedSystem:
    """The normal equations of relative steps of M, those of the beam eliminated.

    Parameters
    ----------
    weights : ndarray, shape (n, rows, cols)
        Weight ω of each measurement.
    corners : ndarray of int, shape (n, 2)
        First beam cell (row, col) of each exposure; the smallest is (0, 0).
    """

    def __init__(self, weights: Floats, corners: Ints) -> None:
        rows, cols = weights.shape[1:]
        self._windows = [np.s_[r : r + rows, c : c + cols] for r, c in corners.tolist()]
        self._grid = (rows + int(corners[:, 0].max()), cols + int(corners[:, 1].max()))
        self._root: Floats = np.sqrt(weights)
        self._weights = weights
        self._on_pixels: Floats = weights.sum(axis=0)
        self._on_cells = self._scatter(weights)

    def _scatter(self, values: Iterable[Floats]) -> Floats:
        """Sum values over the exposures on the beam cells."""
        cells = np.zeros(self._grid)
        for seen, value in zip(self._windows, values, strict=True):
            cells[seen] += value
        return cells

    def _eliminated(self, on_cells: Floats) -> Floats:
        """Apply B·D_L⁻¹ to a sum on beam cells."""
        beam = np.divide(on_cells, self._on_cells, where=self._on_cells > 0, out=on_cells)
        result: Floats = np.zeros_like(self._on_pixels)
        for seen, weight in zip(self._windows, self._weights, strict=True):
            result += weight * beam[seen]
        return result

    def product(self, steps: Floats) -> Floats:
        """Multiply S by steps."""
        scattered = self._scatter(weight * steps for weight in self._weights)
        return self._on_pixels * steps - self._eliminated(scattered)

    def noise(self, rng: np.random.Generator) -> Floats:
        """Draw a right-hand side b: white noise of variance 1 per measurement, times √ω."""
        drawn: Floats = self._root * rng.standard_normal(self._root.shape)
        on_pixels: Floats = drawn.sum(axis=0)
        return on_pixels - self._eliminated(self._scatter(drawn))

    def solve(self, rhs: Floats) -> Floats:
        """Solve S·g = rhs by conjugate gradients, preconditioned by D_M."""
        used = self._on_pixels > 0
        solution = np.zeros_like(rhs)
        residual = rhs.copy()
        direction = np.zeros_like(rhs)
        energy, first = 0.0, 0.0
        while True:
            scaled = np.divide(residual, self._on_pixels, where=used, out=np.zeros_like(rhs))
            previous, energy = energy, float(np.sum(residual * scaled))
            first = first or energy
            if energy <= _TOLERANCE**2 * first:
                return solution
            direction = scaled + (energy / previous if previous else 0.0) * direction
            image = self.product(direction)
            length = energy / float(np.sum(direction * image))
            solution += length * direction
            residual -= length * image
