"""The forward model and the objective, for whole-pixel shifts.

y_k(p) = c_k·L(u_k(p))·M(p) + noise: `grid_cells` gives u as flat indices into the padded beam
grid, so L(u) is ``beam.flat[cells]`` and a sum over the grid is a ``bincount``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def grid_cells(
    shape: tuple[int, int], shifts: ArrayLike, rotation: ArrayLike | None = None
) -> tuple[NDArray[Any], tuple[int, int], tuple[int, int]]:
    """Find the cell of the padded beam grid that each pixel sees in each exposure.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    shifts : array_like of int, shape (n, 2)
        Shifts (row, col) in whole pixels.
    rotation : array_like, shape (n,), optional
        Rotations of the sensor in degrees, multiples of 90; 0 unless given.

    Returns
    -------
    cells : ndarray of int64, shape (n, rows, cols)
        Flat indices u_k(p) into the grid.
    grid_shape : tuple of int
        Rows and columns of the grid: it covers every window and that of shift 0.
    beam_origin : tuple of int
        Cell that pixel (0, 0) of the unrotated sensor sees at shift 0.
    """
    corners = np.asarray(shifts, np.int64)
    turns = np.zeros(len(corners), int) if rotation is None else np.asarray(rotation, int) // 90
    windows = [shape if turn % 2 == 0 else shape[::-1] for turn in turns]
    low = np.minimum(corners.min(axis=0), 0)
    high = np.maximum((corners + windows).max(axis=0), shape)
    rows, cols = high - low
    grid = np.arange(rows * cols).reshape(rows, cols)
    cells = np.empty((len(corners), *shape), np.int64)
    for k, (row, col) in enumerate(corners - low):
        height, width = windows[k]
        cells[k] = np.rot90(grid[row : row + height, col : col + width], turns[k])
    return cells, (int(rows), int(cols)), (int(-low[0]), int(-low[1]))


@dataclass(frozen=True)
class Problem:
    """Measurements as the solvers take them: what is not used has weight 0 and value 0."""

    values: NDArray[Any]
    weights: NDArray[Any]
    flux: NDArray[Any]
    cells: NDArray[Any]
    grid_shape: tuple[int, int]
    beam_origin: tuple[int, int]


def problem(
    frames: ArrayLike,
    shifts: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
) -> Problem:
    """Turn the arguments of a calibration into values, weights w = 1/σ², fluxes and cells.

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols)
        Exposures, dark subtracted; NaN counts as masked.
    shifts : array_like of int, shape (n, 2)
        Shifts (row, col) in whole pixels.
    variance : array_like, optional
        Variance of the values, like `frames` or (n,); 1 unless given.
    mask : array_like of bool, optional
        True = do not use; (rows, cols) or (n, rows, cols).
    flux : array_like, shape (n,), optional
        Relative power of the lamp in each exposure; 1 unless given.
    rotation : array_like, shape (n,), optional
        Rotations of the sensor in degrees, multiples of 90; 0 unless given.

    Returns
    -------
    Problem
        The measurements as the solvers take them.
    """
    values = np.array(frames, np.float64)
    n, rows, cols = values.shape
    sigma2 = np.ones(1) if variance is None else np.asarray(variance, np.float64)
    if sigma2.ndim == 1:
        sigma2 = sigma2[:, None, None]
    used = np.isfinite(values) & ~np.broadcast_to(False if mask is None else mask, values.shape)
    cells, grid_shape, beam_origin = grid_cells((rows, cols), shifts, rotation)
    return Problem(
        values=np.where(used, values, 0),
        weights=np.where(used, 1 / sigma2, 0),
        flux=np.ones(n) if flux is None else np.asarray(flux, np.float64),
        cells=cells,
        grid_shape=grid_shape,
        beam_origin=beam_origin,
    )


def exposures(
    sensitivity: NDArray[Any], beam: NDArray[Any], flux: NDArray[Any], cells: NDArray[Any]
) -> NDArray[Any]:
    """Evaluate the model c_k·L(u_k(p))·M(p), shape (n, rows, cols)."""
    return np.asarray(flux[:, None, None] * beam.flat[cells] * sensitivity)


def objective(data: Problem, sensitivity: NDArray[Any], beam: NDArray[Any]) -> float:
    """Sum the weighted squares of the residuals, F = Σ w·(y − c·L·M)²."""
    model = exposures(sensitivity, beam, data.flux, data.cells)
    return float(np.sum(data.weights * (data.values - model) ** 2, where=data.weights > 0))
