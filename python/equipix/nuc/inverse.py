"""Inverse of a response curve: from the raw value of a pixel to the array's mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import InverseWarning, warn
from equipix.nuc.curve import polynomial, response_at, slope_at

if TYPE_CHECKING:
    from equipix._types import Array, Floats

_NODES = 4
"""Places at which the cubic agrees with the exact inverse."""

_CHECKED = 17
"""Places at which they are compared: two between extremes of the difference, which has four."""

_SHARE = 0.3
"""Largest difference, over the noise of a frame, that passes: it adds 4 % to the noise."""

_MOST_BEYOND = 1e-3
"""Largest share of the usable pixels that may differ by more, without a warning."""

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


def inverse_verdict(difference: Array, noise: float | None) -> dict[str, float | int | None]:
    """Compare the error of the cubic with the noise of a frame, and warn where it is large.

    Parameters
    ----------
    difference : ndarray, shape (pixels,)
        Largest difference to the exact inverse of usable pixels, in DN.
    noise : float, optional
        Noise of a frame, in DN, where it is known.

    Returns
    -------
    dict
        The largest difference, the noise, and the number of pixels beyond the limit, for metadata.
    """
    largest = float(np.max(difference, initial=0.0))
    beyond = 0 if noise is None else int(np.count_nonzero(difference > _SHARE * noise))
    if beyond > _MOST_BEYOND * difference.size:
        warn(
            f"the cubic that inverts the curves differs from their inverse by up to {largest:.2g} "
            f"DN, and in {beyond} of {difference.size} pixels by more than {_SHARE:g} of the noise "
            f"of a frame, {noise:.2g} DN: correct(exact=True), or fit a lower order or a smaller "
            "range of levels",
            InverseWarning,
        )
    return {"largest_error_dn": largest, "noise_dn": noise, "pixels_beyond": beyond}


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
