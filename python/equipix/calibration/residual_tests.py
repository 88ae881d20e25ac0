"""Tests of residuals: those of a right model are white.

Pure functions of residuals (..., rows, cols), NaN where there are none: images of neighbouring
pixels in their last two axes. None needs a variance.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from equipix._types import Array, Floats

_CLIPPED = 4.0
"""Standard deviations at which residuals are cut off, so that a few false values do not decide."""

ROBUST = 1.4826
"""Standard deviation over median absolute deviation, for normal noise."""


class Correlation(NamedTuple):
    """Correlation of the residuals of neighbouring pixels, along one axis.

    `size` is the mean product over the mean square, `z` the same in standard errors, `product` the
    mean product in the units of the squared residuals.
    """

    size: float
    z: float
    product: float


def lag_one(residuals: NDArray[np.floating], share: float) -> tuple[Correlation, Correlation]:
    """Correlation of residuals one row and one column apart.

    Parameters
    ----------
    residuals : ndarray, shape (..., rows, cols)
        Residuals of a fit; NaN where there are none.
    share : float
        Degrees of freedom over measurements: the fit makes residuals dependent on each other.

    Returns
    -------
    rows, cols : Correlation
        Of neighbours in one column, and of neighbours in one row.

    Notes
    -----
    With r = Q e, e white of variance σ² and Q a projection of rank f that is nearly invariant to
    translations, the sum of all products r r' has the variance σ⁴f. The sum of their squares
    expects σ⁴f²/N: products of pairs that share a pixel or a cell of the beam are dependent.
    """
    cut = clipped(residuals)
    pairs = ((cut[..., 1:, :], cut[..., :-1, :]), (cut[..., 1:], cut[..., :-1]))
    square = float(np.nanmean(np.square(cut))) if np.isfinite(cut).any() else math.nan
    rows, cols = (_correlation(a * b, square, share) for a, b in pairs)
    return rows, cols


def _correlation(products: Floats, square: float, share: float) -> Correlation:
    known = products[np.isfinite(products)]
    spread = math.sqrt(float(known @ known) / share) if share > 0 else 0.0
    if not (known.size and spread > 0):
        return Correlation(0.0, 0.0, 0.0)
    mean = float(known.mean())
    return Correlation(mean / square, float(known.sum()) / spread, mean)


def clipped(residuals: NDArray[np.floating]) -> Floats:
    """Residuals cut off at four standard deviations of their exposure, the first axis."""
    axes = tuple(range(1, residuals.ndim))
    scale = ROBUST * nanmedian_abs(residuals)
    limits = _CLIPPED * scale.reshape((-1, *(1 for _ in axes)))
    return np.asarray(np.clip(residuals, -limits, limits), np.float64)


def nanmedian_abs(residuals: NDArray[np.floating]) -> Floats:
    """Median absolute residual of each exposure, the first axis; 0 without any."""
    found = []
    for each in residuals:
        known = each[np.isfinite(each)]
        found.append(float(np.median(np.abs(known))) if known.size else 0.0)
    return np.array(found)


def in_blocks(image: Array, side: int) -> Array:
    """Sums over blocks of `side` pixels square in the last two axes, smaller ones at the end."""
    for axis, size in ((-2, image.shape[-2]), (-1, image.shape[-1])):
        image = np.add.reduceat(image, np.arange(0, size, side), axis=axis)
    return image
