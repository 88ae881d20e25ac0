"""The minimiser of F by dense linear algebra, for tiny sensors: a truth of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.reference.descent import Solution, best_beam, best_sensitivity, gauged
from equipix.reference.model import Problem, exposures, objective, problem

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def solve_dense(
    frames: ArrayLike,
    shifts: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    steps: int = 20,
) -> Solution:
    """Minimise F by Gauss-Newton steps, each a dense least-squares problem of least norm.

    Parameters
    ----------
    frames, shifts, variance, mask, flux, rotation : array_like
        As for `equipix.reference.model.problem`.
    steps : int
        Largest number of steps.

    Returns
    -------
    Solution
        Sensitivity, beam and the objective after each step.

    Notes
    -----
    The steps are linear, M + δM and L + δL, and the free scales of M and L in each component
    are what least norm settles. Cost: (measurements)·(unknowns)² per step.
    """
    data = problem(frames, shifts, variance=variance, mask=mask, flux=flux, rotation=rotation)
    beam = best_beam(data, np.ones(data.values.shape[1:]))
    sensitivity = best_sensitivity(data, beam)
    history = [objective(data, sensitivity, beam)]
    for _ in range(steps):
        change = _step(data, np.nan_to_num(sensitivity), np.nan_to_num(beam))
        sensitivity = sensitivity + change[: sensitivity.size].reshape(sensitivity.shape)
        beam = beam + change[sensitivity.size :].reshape(beam.shape)
        history.append(objective(data, sensitivity, beam))
        if np.abs(change).max() < 1e-13 * np.nanmax(beam):
            break
    return gauged(data, sensitivity, beam, history)


def _step(data: Problem, sensitivity: NDArray[Any], beam: NDArray[Any]) -> NDArray[Any]:
    """Solve √w·(c·L·δM + c·M·δL) = √w·(y − c·L·M) for (δM, δL), of least norm."""
    rows, exposure, pixel = gradient(data, sensitivity, beam)
    root = np.sqrt(data.weights.reshape(len(data.weights), -1)[exposure, pixel])
    residual = data.values - exposures(sensitivity, beam, data.flux, data.cells)
    wanted = root * residual.reshape(len(residual), -1)[exposure, pixel]
    return np.asarray(np.linalg.lstsq(rows, wanted, rcond=1e-12)[0])


def gradient(
    data: Problem, sensitivity: NDArray[Any], beam: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Derivatives of √w·c·L·M with respect to all M, then all L, of each used measurement.

    Parameters
    ----------
    data : Problem
        The measurements.
    sensitivity : ndarray, shape (rows, cols)
        M.
    beam : ndarray, shape of the padded grid
        L.

    Returns
    -------
    rows : ndarray, shape (measurements, pixels + cells)
        The derivatives.
    exposure, pixel : ndarray of int, shape (measurements,)
        Which measurement a row belongs to.
    """
    exposure, pixel = np.nonzero((data.weights > 0).reshape(len(data.weights), -1))
    root = np.sqrt(data.weights.reshape(len(data.weights), -1)[exposure, pixel])
    cell = data.cells.reshape(len(data.cells), -1)[exposure, pixel]
    result = np.zeros((len(root), sensitivity.size + beam.size))
    rows = np.arange(len(root))
    result[rows, pixel] = root * data.flux[exposure] * beam.flat[cell]
    result[rows, sensitivity.size + cell] = root * data.flux[exposure] * sensitivity.flat[pixel]
    return result, exposure, pixel
