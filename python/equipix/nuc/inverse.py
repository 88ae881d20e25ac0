"""Inverse of a response curve: from the raw value of a pixel to the array's mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from equipix._types import Array, Floats

_NODES = 4
"""Places at which the cubic agrees with the exact inverse."""

_CHECKED = 33
"""Places at which they are compared."""

_NEWTON = 60
"""Most steps of the exact inverse: bisection alone halves the range so often."""


def response_of(deviation: Array, mean: Array) -> Floats:
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
    return np.asarray(mean + _polynomial(deviation, mean))


def slope_of(deviation: Array, mean: Array) -> Floats:
    """Slope dV/dV̄ of each pixel at the array's mean V̄; the arguments are those of `response_of`."""
    powers = np.arange(1, len(deviation))
    derived = deviation[1:] * powers[:, None, None]
    return np.asarray(1 + _polynomial(derived, mean))


def exact_inverse(deviation: Array, raw: Array, limits: tuple[float, float]) -> Floats:
    """Array's mean V̄ at which a pixel has the raw value `raw`.

    Parameters
    ----------
    deviation : ndarray, shape (order + 1, rows, cols)
        Coefficients a, K, c, e.
    raw : ndarray, shape (rows, cols)
        Raw values V, in DN.
    limits : tuple of float
        Range of V̄ in which the curve rises; a raw value beyond its ends is extrapolated with the
        slope at the end.

    Returns
    -------
    ndarray, shape (rows, cols)
        V̄ in DN; NaN where the coefficients or the value are.

    Notes
    -----
    Up to the first order (V − a)/(1 + K); above it Newton steps that are kept inside a bracket,
    which bisection halves where a step would leave it.
    """
    if len(deviation) < 3:
        slope = 1 if len(deviation) == 1 else 1 + deviation[1]
        return np.asarray((raw - deviation[0]) / slope)
    ends = [np.asarray(response_of(deviation, np.float64(end))) for end in limits]
    low, high = (np.full(raw.shape, end) for end in limits)
    inside = np.clip(raw, *ends)
    mean = np.clip(raw, low, high)
    for _ in range(_NEWTON):
        excess = response_of(deviation, mean) - inside
        low, high = np.where(excess < 0, mean, low), np.where(excess > 0, mean, high)
        step = mean - excess / slope_of(deviation, mean)
        following = np.where((step >= low) & (step <= high), step, (low + high) / 2)
        settled = np.abs(following - mean) <= 4 * np.spacing(np.abs(mean))
        mean = following
        if np.all(settled | ~np.isfinite(inside)):
            break
    slope = np.where(raw < ends[0], slope_of(deviation, np.float64(limits[0])), 1.0)
    slope = np.where(raw > ends[1], slope_of(deviation, np.float64(limits[1])), slope)
    found: Floats = np.where(np.isfinite(inside), mean + (raw - inside) / slope, np.nan)
    return found


def horner_inverse(deviation: Array, limits: tuple[float, float]) -> tuple[Floats, Floats]:
    """Coefficients of the inverse as a polynomial of the raw value, and how exact it is.

    Parameters
    ----------
    deviation : ndarray, shape (order + 1, rows, cols)
        Coefficients a, K, c, e.
    limits : tuple of float
        Range of the array's mean V̄ that the levels cover, in DN.

    Returns
    -------
    coefficients : ndarray, shape (2 or 4, rows, cols)
        c of V̄ = Σ c_j V^j, for V in DN.
    difference : ndarray, shape (rows, cols)
        Largest difference to the exact inverse over the range, in DN; 0 up to the first order,
        whose inverse is a line.

    Notes
    -----
    Above the first order the cubic through the exact inverse at four Chebyshev nodes of V̄, which
    is within a small factor of the best cubic.
    """
    if len(deviation) < 3:
        slope = np.ones_like(deviation[0]) if len(deviation) == 1 else 1 + deviation[1]
        return np.stack([-deviation[0] / slope, 1 / slope]), np.zeros_like(deviation[0])
    low, high = limits
    angles = np.pi * (np.arange(_NODES) + 0.5) / _NODES
    nodes = (low + high) / 2 - (high - low) / 2 * np.cos(angles)
    coefficients = _through(np.stack([response_of(deviation, node) for node in nodes]), nodes)
    difference = np.zeros_like(deviation[0])
    for mean in np.linspace(low, high, _CHECKED):
        inverted = _polynomial(coefficients, response_of(deviation, mean))
        difference = np.maximum(difference, np.abs(inverted - mean))
    return coefficients, difference


def _through(raw: Floats, means: Floats) -> Floats:
    """Coefficients of the cubic through four points of each pixel, by divided differences."""
    divided = np.broadcast_to(means[:, None, None], raw.shape).copy()
    for order in range(1, _NODES):
        rise = divided[order:] - divided[order - 1 : -1]
        divided[order:] = rise / (raw[order:] - raw[:-order])
    coefficients = np.zeros_like(raw)
    for node in range(_NODES - 1, -1, -1):
        shifted = -raw[node] * coefficients
        shifted[1:] += coefficients[:-1]
        shifted[0] += divided[node]
        coefficients = shifted
    return coefficients


def _polynomial(coefficients: Array, x: Array) -> Floats:
    """Σ coefficients_j x^j by Horner's scheme; 0 without coefficients."""
    total: Floats = np.zeros(np.broadcast_shapes(coefficients.shape[1:], np.shape(x)))
    for coefficient in coefficients[::-1]:
        total = total * x + coefficient
    return total
