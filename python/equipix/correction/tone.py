"""Corrected frames as pictures of 8 bits, by a tone law."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from equipix._types import Array, Display

PERCENTILES = (0.5, 99.5)
"""Percentiles of a frame that a linear picture shows as black and white."""

_BINS = 4096
"""Bins of the histogram between the smallest and the largest value."""

_PLATEAU = 4.0
"""Most pixels that count of a bin, over the mean of the bins that are not empty."""


def picture(frame: Array, display: Display) -> Array:
    """Make a picture of 8 bits of a frame.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
        Corrected values; what is not finite becomes black.
    display : {"linear", "histogram"}
        The tone law.

    Returns
    -------
    ndarray, shape (rows, cols), uint8
        The picture, scaled for each frame by itself.

    Notes
    -----
    *linear*: black and white are the percentiles 0.5 and 99.5. *histogram*: equalisation of a
    histogram of 4096 bins between the smallest and the largest value, in which a bin counts at most
    4 times the mean of the bins that are not empty. That plateau keeps large even areas from taking
    all grey levels [1]_. An even frame becomes grey.

    References
    ----------
    .. [1] V. E. Vickers, "Plateau equalization algorithm for real-time display of high-quality
       infrared imagery", Optical Engineering 35 (1996) 1921-1926.
    """
    known = np.isfinite(frame)
    values = frame[known].astype(np.float64)
    grey = np.zeros(frame.shape, np.uint8)
    if values.size:
        tones = (_linear if display == "linear" else _equalised)(values)
        grey[known] = np.rint(255 * tones).astype(np.uint8)
    return grey


def _linear(values: Array) -> Array:
    """Tones from 0 to 1 between two percentiles."""
    low, high = np.percentile(values, PERCENTILES)
    if high <= low:
        return np.full(values.shape, 0.5)
    return np.asarray(np.clip((values - low) / (high - low), 0, 1))


def _equalised(values: Array) -> Array:
    """Tones from 0 to 1 by a histogram with a plateau."""
    low, high = values.min(), values.max()
    if high <= low:
        return np.full(values.shape, 0.5)
    bins = np.minimum(((values - low) / (high - low) * _BINS).astype(np.int64), _BINS - 1)
    counts: Any = np.bincount(bins, minlength=_BINS).astype(np.float64)
    counts = np.minimum(counts, _PLATEAU * counts[counts > 0].mean())
    below = np.cumsum(counts) - counts[0]
    return np.asarray((below / below[-1])[bins])
