"""Isolated hot pixels in images of a spot, replaced by what their neighbours show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from equipix._types import Array, Bools

    Places = NDArray[np.int64]

_LIGHT = 0.9
"""Light at a pixel, by its neighbours, over the saturation level, from which on the light may
saturate it: the estimate scatters by some per cent with the pixels' sensitivities."""

_FAINT = 0.01
"""Least signal that a logarithm is taken of, over the saturation level."""

_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Directions through a pixel."""

_CUBIC = np.array([-1, 4, 4, -1]) / 6
"""Weights of the neighbours at distances −2, −1, 1 and 2."""


def hot_places(frames: Array, level: float | None, known: Bools | None = None) -> Places:
    """Find isolated pixels that reach the saturation level although their neighbours are darker.

    Parameters
    ----------
    frames : ndarray, shape (n, rows, cols)
        Images of a spot.
    level : float or None
        Saturation level; None: nothing saturates.
    known : ndarray of bool, shape (rows, cols), optional
        Pixels that are hot in dark frames: the light around them may be as high as it likes.

    Returns
    -------
    ndarray, shape (m, 2), int64
        Their rows and columns.

    Notes
    -----
    A pixel that is not known to be hot must reach the level in every frame, and the light that its
    neighbours show must be below 0.9 of it. No pixel beside it may reach the level in any frame.
    The two outermost rows and columns are left as they are.
    """
    none: Places = np.empty((0, 2), np.int64)
    if level is None:
        return none
    reached = frames >= level
    ever: Bools = np.asarray(reached.any(axis=0))
    if not ever.any():
        return none
    mean = frames.mean(axis=0, dtype=np.float64)
    base = float(np.median(mean))
    places = np.argwhere(_alone(ever))
    if base >= level or not len(places):
        return none
    at = tuple(places.T)
    dark_around = base + _light(mean - base, places, _FAINT * (level - base)) < _LIGHT * level
    steady = np.asarray(reached.all(axis=0))[at]
    by_dark = False if known is None else known[at]
    return places[(dark_around & steady) | by_dark]


def mended(frames: Array, places: Places) -> Array:
    """Return images whose pixels at `places` have the value that their neighbours show."""
    if not len(places):
        return frames
    result = frames.copy()
    at = tuple(places.T)
    for image in result:
        values = image.astype(np.float64)
        base = float(np.median(values))
        floor = _FAINT * float(np.ptp(_without(values, at))) + float(np.finfo(np.float32).tiny)
        light = base + _light(values - base, places, floor)
        image[at] = np.rint(light) if image.dtype.kind in "iu" else light
    return result


def _without(values: Array, at: tuple[Any, ...]) -> Array:
    """Return the values but those at some places."""
    others = np.ones(values.shape, bool)
    others[at] = False
    return values[others]


def _alone(pixels: Bools) -> Bools:
    """Pixels, away from the border, with no other of these pixels beside them."""
    rows, cols = pixels.shape
    padded = np.pad(pixels, 1).astype(np.uint8)
    near = np.zeros(pixels.shape, np.uint8)
    for i, j in np.ndindex(3, 3):
        near += padded[i : i + rows, j : j + cols]
    alone: Bools = np.logical_and(pixels, near == 1)
    alone[:2] = alone[-2:] = alone[:, :2] = alone[:, -2:] = False
    return alone


def _light(signal: Array, places: Places, floor: float) -> NDArray[np.float64]:
    """Light at some pixels by their neighbours, which follows the outline of a spot.

    Of the four directions through a pixel that is taken along which the light changes least. A
    cubic through the two neighbours on each side interpolates ln of the light, which is exact for a
    Gaussian; where a neighbour is faint, the light itself.
    """
    values, slopes = [], []
    for step in np.array(_STEPS):
        four = np.array([signal[tuple((places + k * step).T)] for k in (-2, -1, 1, 2)])
        logs = np.log(np.maximum(four, floor))
        bright = four.min(axis=0) > 2 * floor
        values.append(np.where(bright, np.exp(_CUBIC @ logs), _CUBIC @ four))
        slopes.append(np.abs(logs[2] - logs[1]) + np.abs(logs[3] - logs[0]))
    best = np.argmin(slopes, axis=0)
    light: NDArray[np.float64] = np.array(values)[best, np.arange(len(places))]
    return light
