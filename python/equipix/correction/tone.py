"""Corrected frames as whole numbers: rounded and limited, or as a picture by a tone law."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.correction.corrector import largest_value, output_dtype
from equipix.errors import InputError

if TYPE_CHECKING:
    from equipix._types import Array, Display

PERCENTILES = (0.5, 99.5)
"""Percentiles of a frame that a linear picture shows as black and white."""

_BINS = 4096
"""Bins of the histogram between the smallest and the largest value."""

_PLATEAU = 4.0
"""Most pixels that count of a bin, over the mean of the bins that are not empty."""


class Conversion:
    """How corrected frames are written, and the number of values that had to be limited.

    Parameters
    ----------
    dtype : {"float32", "uint16", "uint8"}
        Type of the output.
    bit_depth : int, optional
        Significant bits of whole numbers, 8 to 16; by default all of the type.
    display : {"linear", "histogram"}, optional
        Make pictures of 8 bits by a tone law, see `picture`.

    Attributes
    ----------
    dtype : dtype
        Type of the output.
    clipped : int
        Values so far that had to be limited, or were not a number; always 0 for pictures.
    """

    def __init__(
        self, dtype: str = "float32", *, bit_depth: int | None = None, display: Display | None
    ) -> None:
        if display is not None and (dtype != "uint8" or bit_depth is not None):
            raise InputError(
                f"'display' makes pictures of 8 bits, but 'dtype' is '{dtype}' and 'bit_depth' is "
                f"{bit_depth}: leave both out"
            )
        self.dtype = output_dtype(dtype)
        self._largest = largest_value(self.dtype, bit_depth)
        self._display = display
        self.clipped = 0

    def of(self, frame: Array) -> Array:
        """Convert one corrected frame of shape (rows, cols)."""
        if self._display is not None:
            return picture(frame, self._display)
        if self.dtype.kind != "u":
            return frame.astype(self.dtype, copy=False)
        rounded = np.rint(frame)
        inside = (rounded >= 0) & (rounded <= self._largest)
        self.clipped += int(rounded.size - np.count_nonzero(inside))
        limited = np.clip(np.nan_to_num(rounded, nan=0.0), 0, self._largest)
        return np.asarray(limited, dtype=self.dtype)


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
