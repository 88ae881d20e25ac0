"""Pixels that do not respond to the scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.nuc.limits import DefectLimits

if TYPE_CHECKING:
    from equipix._types import Array

_WIDTH, _EVERY = 11, 2
"""Rows and columns of the square with whose median a pixel is compared, and every how many of them
count: clusters of 5×5 pixels are less than half of it."""

_LEAST_FRAMES = 51
"""Frames from which deviations are compared: of n frames that do not depend on each other a
deviation errs by 1/√(2(n − 1)), of which the limit 1/2 is then five times."""


def unresponsive(gain: Array, deviation: Array, frames: int) -> Array:
    """Pixels of less than half the response of their neighbours.

    Parameters
    ----------
    gain : ndarray, shape (rows, cols)
        Gain of each pixel, the inverse of its response.
    deviation : ndarray, shape (rows, cols)
        Standard deviation of each pixel over the frames.
    frames : int
        Number of frames.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        Pixels whose gain, or whose deviation from 51 frames on, has that response.
    """
    limit = DefectLimits.response
    weak: Array = ~((gain > 0) & (gain <= 1 / limit))
    if frames >= _LEAST_FRAMES:
        weak |= deviation < limit * _median(deviation)
    return weak


def _median(values: Array) -> Array:
    """Median over the square around each pixel, reflected about the edge pixels."""
    padded = np.pad(values, _WIDTH // 2, mode="reflect")
    squares = np.lib.stride_tricks.sliding_window_view(padded, (_WIDTH, _WIDTH))
    median: Array = np.median(squares[:, :, ::_EVERY, ::_EVERY], axis=(2, 3))
    return median
