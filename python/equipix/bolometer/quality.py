"""Non-uniformity of corrected frames over the states of operation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix._check import as_array, number
from equipix.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def non_uniformity(frames: ArrayLike, span: float) -> float:
    """Average non-uniformity of corrected frames of even scenes, relative to the range.

    Parameters
    ----------
    frames : array_like, shape (n, rows, cols)
        Corrected frames at n states of operation, in DN; NaN in pixels that do not count.
    span : float
        Range of the output in DN: what holds all pixels in all states and scenes of interest.

    Returns
    -------
    float
        The rms over valid pixels of the difference to the frame's mean, averaged over the frames
        and divided by `span`.

    Raises
    ------
    InputError
        If `span` is not above 0, or a frame has no valid pixel.

    References
    ----------
    .. [1] "Correction of the non-uniformity of parameters of focal plane arrays", in a course on
       staring infrared systems (in Russian), which states below 1/250 000 for bolometers.

    Examples
    --------
    >>> from equipix import bolometer
    >>> bolometer.non_uniformity([[[1.0, 3.0]], [[4.0, 8.0]]], 100.0)
    0.015
    """
    values = as_array("frames", frames, ndim=3).astype(np.float64)
    if not 0 < number("span", span) < np.inf:
        raise InputError(f"'span' is {span!r}, expected a finite number of DN above 0")
    if np.isinf(values).any():
        raise InputError("'frames' holds infinite values, expected finite ones, or NaN where bad")
    empty = np.flatnonzero(~np.isfinite(values).any(axis=(1, 2)))
    if empty.size or not len(values):
        which = f"'frames' has no finite value in frame {empty[0]}" if empty.size else "no 'frames'"
        raise InputError(f"{which}, expected those of the valid pixels")
    return float(np.nanstd(values, axis=(1, 2)).mean() / span)
