"""The minimiser of F by dense linear algebra, for tiny sensors: a truth of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from reference.connectivity import components
from reference.descent import Solution, best_beam, best_sensitivity, gauged
from reference.model import Problem, exposures, objective, problem

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_HALVINGS = 40
"""Times that a step is halved at most."""


def solve_dense(
    frames: ArrayLike,
    shifts: ArrayLike,
    *,
    variance: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    flux: ArrayLike | None = None,
    rotation: ArrayLike | None = None,
    prior: ArrayLike | None = None,
    steps: int = 200,
) -> Solution:
    """Minimise F by Gauss-Newton steps, each a dense least-squares problem of least norm.

    Parameters
    ----------
    frames, shifts, variance, mask, flux, rotation : array_like
        As for `reference.model.problem`.
    prior : array_like, shape (rows, cols), optional
        Weights λ of the prior R = Σ λ (M/μ − 1)², μ being the mean of M over the component, which
        is added to F; none unless given.
    steps : int
        Largest number of steps.

    Returns
    -------
    Solution
        Sensitivity, beam and the objective after each step.

    Notes
    -----
    The steps are linear, M + δM and L + δL, and the free scales of M and L in each component
    are what least norm settles. A step that raises F + R is halved. Cost:
    (measurements)·(unknowns)² per step.
    """
    data = problem(frames, shifts, variance=variance, mask=mask, flux=flux, rotation=rotation)
    shape = data.values.shape[1:]
    weights = np.zeros(shape) if prior is None else np.asarray(prior, np.float64)
    pieces, _ = components(data.cells, data.weights > 0, data.grid_shape)
    beam = best_beam(data, np.ones(shape))
    # In weak light M at its closed form is noise.
    sensitivity = np.ones(shape) if weights.any() else best_sensitivity(data, beam)

    def whole(sensitivity: NDArray[Any], beam: NDArray[Any]) -> float:
        _, pull = prior_rows(weights, pieces, np.nan_to_num(sensitivity))
        return objective(data, sensitivity, beam) + float(pull @ pull)

    history = [whole(sensitivity, beam)]
    for _ in range(steps):
        change = _step(data, np.nan_to_num(sensitivity), np.nan_to_num(beam), weights, pieces)
        for _ in range(_HALVINGS):
            changed = (
                sensitivity + change[: sensitivity.size].reshape(shape),
                beam + change[sensitivity.size :].reshape(beam.shape),
            )
            found = whole(*changed)
            if found <= history[-1] * (1 + 1e-12) + 1e-28 * float(np.sum(data.values**2)):
                break
            change = change / 2
        sensitivity, beam = changed
        history.append(found)
        if np.abs(change).max() < 1e-13 * np.nanmax(beam):
            break
    return gauged(data, sensitivity, beam, history)


def prior_rows(
    weights: NDArray[Any], pieces: NDArray[Any], sensitivity: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Derivatives of √λ·M/μ with respect to all M, and √λ·(1 − M/μ), of pixels with a prior.

    Parameters
    ----------
    weights : ndarray, shape (rows, cols)
        Weights λ of the prior.
    pieces : ndarray of int, shape (rows, cols)
        Component of each pixel, over which μ is the mean of M.
    sensitivity : ndarray, shape (rows, cols)
        Sensitivity M.

    Returns
    -------
    rows : ndarray, shape (pixels with a prior, pixels)
        The derivatives.
    pull : ndarray, shape (pixels with a prior,)
        What is missing.
    """
    held = np.flatnonzero((weights > 0) & (pieces >= 0))
    rows, pull = np.zeros((held.size, weights.size)), np.zeros(held.size)
    for index, pixel in enumerate(held):
        piece = np.flatnonzero(pieces.ravel() == pieces.flat[pixel])
        root, m = weights.flat[pixel] ** 0.5, sensitivity.flat[pixel]
        mean = sensitivity.flat[piece].mean()
        rows[index, pixel] = root / mean
        rows[index, piece] -= root * m / mean**2 / piece.size
        pull[index] = root * (1 - m / mean)
    return rows, pull


def _step(
    data: Problem,
    sensitivity: NDArray[Any],
    beam: NDArray[Any],
    weights: NDArray[Any],
    pieces: NDArray[Any],
) -> NDArray[Any]:
    """Solve √w·(c·L·δM + c·M·δL) = √w·(y − c·L·M) for (δM, δL), of least norm."""
    rows, exposure, pixel = gradient(data, sensitivity, beam)
    root = np.sqrt(data.weights.reshape(len(data.weights), -1)[exposure, pixel])
    residual = data.values - exposures(sensitivity, beam, data.flux, data.cells)
    wanted = root * residual.reshape(len(residual), -1)[exposure, pixel]
    of_prior, pull = prior_rows(weights, pieces, sensitivity)
    rows = np.vstack([rows, np.pad(of_prior, ((0, 0), (0, beam.size)))])
    return np.asarray(np.linalg.lstsq(rows, np.append(wanted, pull), rcond=1e-12)[0])


def gradient(
    data: Problem, sensitivity: NDArray[Any], beam: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Derivatives of √w·c·L·M with respect to all M, then all L, of each used measurement.

    Parameters
    ----------
    data : Problem
        The measurements.
    sensitivity : ndarray, shape (rows, cols)
        Sensitivity M.
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
