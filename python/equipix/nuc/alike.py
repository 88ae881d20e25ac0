"""Pixels whose residuals deviate from those of the array."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.defects import SIGMAS
from equipix.noise import MEDIAN_SQUARE

if TYPE_CHECKING:
    from equipix._types import Bools, Floats

_FEW = 0.05
"""Largest share of pixels that are left out because they deviate from the others."""


def alike_pixels(squares: Floats) -> Bools:
    """Find pixels that do not deviate from the others.

    Parameters
    ----------
    squares : ndarray, shape (orders, pixels)
        Mean square residual of each pixel at each order.

    Returns
    -------
    ndarray of bool, shape (pixels,)
        False where at some order it is above 36 times the variance of the normal variable whose
        square has the median of the array; of more than one pixel in twenty, for those that deviate
        most.
    """
    limits = SIGMAS**2 / MEDIAN_SQUARE * np.median(squares, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):  # the median of exact levels may be 0
        excess = np.nan_to_num(squares / limits[:, None], posinf=0).max(axis=0)
    most = int(_FEW * excess.size)
    if not most:
        return np.ones(excess.size, bool)
    # Of more than `most`, those that deviate most are left out.
    return np.asarray(excess <= max(1.0, float(np.partition(excess, -most - 1)[-most - 1])))
