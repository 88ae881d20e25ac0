"""Response curves pixel by pixel, in the powers of the array's mean as they stand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray


def response(
    means: ArrayLike,
    references: ArrayLike,
    powers: tuple[int, ...],
    variance: Callable[[int, Any], Any] | None = None,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Weighted least squares of V − V̄ = Σ q_i V̄^i for each pixel.

    Parameters
    ----------
    means : array, shape (n, rows, cols)
        Levels of a uniform source, in DN.
    references : array, shape (n,)
        Mean V̄ of each level.
    powers : tuple of int
        The powers i.
    variance : callable, optional
        ``variance(level, signal)`` of a value in DN²; 1 unless given. It is evaluated at V̄, then at
        the curve that results.

    Returns
    -------
    coefficients, variances : ndarray, shape (len(powers), rows, cols)
        The coefficients q and their variances.
    misfit : ndarray, shape (rows, cols)
        Σ r²/σ².
    """
    means, references = np.asarray(means, np.float64), np.asarray(references, np.float64)
    n, rows, cols = means.shape
    basis = np.stack([references**power for power in powers], axis=1)
    # Columns of unit length: powers of DN differ by many orders of magnitude.
    scale = np.linalg.norm(basis, axis=0)
    coefficients = np.zeros((len(powers), rows, cols))
    variances, misfit = np.zeros(coefficients.shape), np.zeros((rows, cols))
    for pixel in np.ndindex(rows, cols):
        deviation = means[(slice(None), *pixel)] - references
        expected = references
        for _ in range(2):
            sigma = np.ones(n)
            if variance is not None:
                sigma = np.sqrt([variance(k, expected[k]) for k in range(n)])
            design = basis / scale / sigma[:, None]
            found = np.linalg.lstsq(design, deviation / sigma, rcond=None)[0]
            expected = references + basis @ (found / scale)
        place = (slice(None), *pixel)
        coefficients[place] = found / scale
        variances[place] = np.diag(np.linalg.inv(design.T @ design)) / scale**2
        misfit[pixel] = np.sum((deviation / sigma - design @ found) ** 2)
    return coefficients, variances, misfit


def inverse(coefficients: ArrayLike, raw: float, limits: tuple[float, float]) -> float:
    """Mean V̄ of the array at a raw value of one pixel, by halving the range 200 times.

    Parameters
    ----------
    coefficients : array, shape (order + 1,)
        Those of V − V̄, lowest power first.
    raw : float
        The value, between those at the limits.
    limits : tuple of float
        Range of V̄ in which the curve rises.

    Returns
    -------
    float
        V̄ in DN.
    """
    low, high = limits
    for _ in range(200):
        middle = (low + high) / 2
        value = middle + np.polyval(np.asarray(coefficients)[::-1], middle)
        low, high = (middle, high) if value < raw else (low, middle)
    return (low + high) / 2
