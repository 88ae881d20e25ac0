"""Pixels that see no light in any exposure, beside pixels that see light in all: dead regions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.defects import SIGMAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equipix._types import Array, Bools
    from equipix.noise import NoiseModel

_WELL_ABOVE = 10.0
"""Signal of the pixels around, over the limit of noise, from which they see light beyond doubt:
light that fades passes the limit of noise slowly, a dead region ends within a pixel."""


def blind_pixels(signals: Array, models: Sequence[NoiseModel], usual: Array | float = 1.0) -> Bools:
    """Find pixels that are at the dark in every exposure, however many lie side by side.

    Parameters
    ----------
    signals : ndarray, shape (n, rows, cols)
        Dark-subtracted means of the exposures, in DN.
    models : sequence of NoiseModel, one an exposure
        Those of `signals`.
    usual : ndarray of shape (rows, cols), optional
        Response of good pixels, such as those of the colours of their filters.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True where no exposure has a signal above six standard deviations of the dark, and where
        along rows or columns the nearest other pixels on both sides see so much light in every
        exposure that a good pixel here would be ten times above that; and where along rows and
        columns these are such pixels themselves. One side may be the edge of the sensor.

    Notes
    -----
    A region without light in the beam lies elsewhere in each exposure, so that the pixels beside
    what is dark in all of them are dark in some. That does not hold where all shifts run along the
    region, as along the shadow of a wire: its pixels are found as well, though they may be good.
    They have no light in any exposure, so nothing determines their sensitivity either way.
    """
    limits = [SIGMAS * float(np.sqrt(model.variance(np.zeros(())))) for model in models]
    dark = np.ones(signals.shape[1:], dtype=bool)
    light = np.full(signals.shape[1:], np.inf)
    for signal, limit in zip(signals, limits, strict=True):
        # A comparison with NaN is false: a missing measurement neither is light nor excludes it.
        dark &= ~(signal > limit)
        light = np.minimum(light, signal / limit)
    if not dark.any():
        return dark
    light /= usual
    wanted = np.broadcast_to(_WELL_ABOVE / usual, dark.shape)
    found = dark & (_between_lit(dark, light, wanted) | _between_lit(dark.T, light.T, wanted.T).T)
    # What such pixels enclose along rows and columns is where dead rows cross dead columns, as in
    # the corners of a frame of them.
    dark &= ~found
    edges, half = found.astype(np.float64), np.full(dark.shape, 0.5)
    enclosed = _between_lit(dark, edges, half) & _between_lit(dark.T, edges.T, half.T).T
    return found | (dark & enclosed)


def _between_lit(dark: Bools, light: Array, wanted: Array) -> Bools:
    """Which dark pixels have lit ones as the nearest others of their column, on both sides."""
    before, after = _nearest(dark, light), _nearest(dark[::-1], light[::-1])[::-1]
    lit = (before > wanted) & (after > wanted)
    return np.asarray(lit & (np.minimum(before, after) < np.inf))


def _nearest(dark: Bools, light: Array) -> Array:
    """Light of the last pixel of the column that is not dark; infinite at the sensor's edge."""
    rows = np.arange(len(dark))[:, None]
    last = np.maximum.accumulate(np.where(dark, -1, rows), axis=0)
    return np.where(last < 0, np.inf, np.take_along_axis(light, np.maximum(last, 0), axis=0))
