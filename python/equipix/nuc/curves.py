"""Response curves and their inverses."""

from math import comb

import numpy as np
from numpy.typing import DTypeLike

from equipix._check import Array, Floats
from equipix.measured.part import blocks


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
    powers = np.arange(1, len(deviation))
    return np.asarray(1 + polynomial(deviation[1:] * powers[:, None, None], mean))


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


def counted_from(coefficients: Array, dark: Array, dtype: DTypeLike = np.float64) -> Array:
    """Coefficients d of Σ d_j y^j = Σ c_j (y − dark)^j, rounded to a dtype at last."""
    moved: Array = np.empty(coefficients.shape, dtype)
    for rows in blocks(dark.shape):
        block: Floats = np.zeros(coefficients[:, rows].shape)
        for power, coefficient in enumerate(coefficients[:, rows]):
            for lower in range(power + 1):
                shift = (-dark[rows]) ** (power - lower)
                block[lower] += comb(power, lower) * coefficient * shift
        moved[:, rows] = block
    return moved


_NODES = 4
"""Places at which the cubic agrees with the exact inverse."""

_CHECKED = 17
"""Places at which they are compared: two between extremes of the difference, which has four."""

_NEWTON = 60
"""Most steps of the exact inverse: bisection alone halves the range so often."""


def exact_inverse(deviation: Array, raw: Array, limits: Array) -> Floats:
    """Array's mean V̄ at which a pixel has the raw value `raw`.

    Parameters
    ----------
    deviation : ndarray, shape (order + 1, rows, cols)
        Coefficients a, K, c, e.
    raw : ndarray, shape (rows, cols)
        Raw values V, in DN.
    limits : ndarray, shape (2, rows, cols)
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
        return np.asarray(polynomial(_line(deviation), raw))
    low, high = limits
    ends = response_at(deviation, low), response_at(deviation, high)
    inside = np.clip(raw, *ends)
    mean = _newton(deviation, inside, low, high)
    slope = np.ones(raw.shape)
    for end, limit, beyond in ((ends[0], low, raw < ends[0]), (ends[1], high, raw > ends[1])):
        slope = np.where(beyond, slope_at(deviation, limit), slope)
        mean = np.where(beyond, limit + (raw - end) / slope, mean)
    return np.where(np.isfinite(inside), mean, np.nan)


def horner_inverse(deviation: Array, limits: Array) -> tuple[Floats, Floats]:
    """Coefficients of the inverse as a polynomial of the raw value, and how exact it is.

    Parameters
    ----------
    deviation : ndarray, shape (order + 1, rows, cols)
        Coefficients a, K, c, e.
    limits : ndarray, shape (2, rows, cols)
        Range of the array's mean V̄ that the levels of a pixel cover, in DN.

    Returns
    -------
    coefficients : ndarray, shape (2 or 4, rows, cols)
        Coefficients c of V̄ = Σ c_j V^j, for V in DN.
    difference : ndarray, shape (rows, cols)
        Largest difference to the exact inverse over the range, in DN; 0 up to the first order,
        whose inverse is a line.

    Notes
    -----
    Above the first order the cubic through the exact inverse at four Chebyshev nodes of V̄, which
    is within a small factor of the best cubic.
    """
    if len(deviation) < 3:
        return _line(deviation), np.where(np.isnan(deviation[0]), np.nan, 0.0)
    low, high = limits
    angles = np.pi * (np.arange(_NODES) + 0.5) / _NODES
    nodes = (low + high) / 2 - (high - low) / 2 * np.cos(angles)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):  # a dead pixel has one value at all levels
        coefficients = _through(np.stack([response_at(deviation, node) for node in nodes]), nodes)
        difference = np.zeros(low.shape)
        for share in np.linspace(0, 1, _CHECKED):
            mean = low + share * (high - low)
            inverted = polynomial(coefficients, response_at(deviation, mean))
            difference = np.maximum(difference, np.abs(inverted - mean))
    return coefficients, difference


def _line(deviation: Array) -> Floats:
    """Coefficients −a/(1 + K) and 1/(1 + K) of the inverse of a line."""
    slope = np.ones_like(deviation[0]) if len(deviation) == 1 else 1 + deviation[1]
    with np.errstate(divide="ignore", invalid="ignore"):  # a dead pixel has K = −1
        line = np.stack([-deviation[0] / slope, 1 / slope])
    line[:, np.isnan(deviation[0])] = np.nan
    return line


def _newton(deviation: Array, raw: Array, low: Array, high: Array) -> Floats:
    """Root of a rising curve between two ends."""
    mean: Floats = np.clip(raw, low, high)
    for _ in range(_NEWTON):
        excess = response_at(deviation, mean) - raw
        low, high = np.where(excess < 0, mean, low), np.where(excess > 0, mean, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = mean - excess / slope_at(deviation, mean)
        following = np.where((step >= low) & (step <= high), step, (low + high) / 2)
        settled = np.abs(following - mean) <= 4 * np.spacing(np.abs(mean))
        mean = following
        if np.all(settled | ~np.isfinite(mean)):
            break
    return mean


def _through(raw: Floats, means: Floats) -> Floats:
    """Coefficients of the cubic through four points of each pixel, by divided differences."""
    divided = means.copy()
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
