"""Response curves: polynomials of the array's mean, one for each pixel."""

from __future__ import annotations

from math import comb
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from equipix._types import Array, Floats


def response_at(deviation: Array, mean: Array | float) -> Floats:
    """Raw value V = V̄ + a + K V̄ + c V̄² + e V̄³ of each pixel at the array's mean V̄.

    Parameters
    ----------
    deviation : ndarray, shape (order + 1, rows, cols)
        Coefficients a, K, c, e.
    mean : ndarray, broadcast against (rows, cols)
        The array's mean V̄, in DN.

    Returns
    -------
    ndarray, shape (rows, cols)
        In DN.
    """
    return np.asarray(mean + polynomial(deviation, mean))


def slope_at(deviation: Array, mean: Array | float) -> Floats:
    """Slope dV/dV̄ of each pixel at the array's mean V̄; the arguments are those of `response_at`."""
    return np.asarray(1 + polynomial(_derived(deviation), mean))


def least_slope(deviation: Array, limits: Array) -> Floats:
    """Smallest slope dV/dV̄ of each pixel between its limits.

    Parameters
    ----------
    deviation : ndarray, shape (order + 1, rows, cols)
        Coefficients a, K, c, e.
    limits : ndarray, shape (2, rows, cols)
        Range of the array's mean V̄, in DN.

    Returns
    -------
    ndarray, shape (rows, cols)
        NaN where the coefficients are.

    Notes
    -----
    The slope is a parabola at most: it is smallest at an end or at its vertex −c/(3e).
    """
    least = np.minimum(slope_at(deviation, limits[0]), slope_at(deviation, limits[1]))
    if len(deviation) < 4:
        return least
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = np.clip(-deviation[2] / (3 * deviation[3]), limits[0], limits[1])
    vertex = np.where(np.isfinite(vertex), vertex, limits[0])
    return np.minimum(least, slope_at(deviation, vertex))


def polynomial(coefficients: Array, x: Array | float) -> Floats:
    """Σ coefficients_j x^j by Horner's scheme; 0 without coefficients."""
    total: Floats = np.zeros(np.broadcast_shapes(coefficients.shape[1:], np.shape(x)))
    for coefficient in coefficients[::-1]:
        total *= x
        total += coefficient
    return total


def counted_from(coefficients: Array, dark: Array) -> Floats:
    """Coefficients d of Σ d_j y^j = Σ c_j (y − dark)^j."""
    moved: Floats = np.zeros(coefficients.shape)
    for power, coefficient in enumerate(coefficients):
        for lower in range(power + 1):
            moved[lower] += comb(power, lower) * coefficient * (-dark) ** (power - lower)
    return moved


def _derived(coefficients: Array) -> Array:
    """Coefficients of the derivative."""
    powers = np.arange(1, len(coefficients))
    return np.asarray(coefficients[1:] * powers[:, None, None])
