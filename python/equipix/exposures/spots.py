"""Moves measured from images of a hole, whose hot pixels are mended."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equipix import _native
from equipix._check import Array, Bools, as_array, as_mask, is_whole
from equipix.errors import InputError
from equipix.exposures.positions import _BEYOND
from equipix.measured.saturation import saturation_level
from equipix.shown import Brief


@dataclass(frozen=True, eq=False)
class Spot(Brief):
    """Where the image of a hole is on the sensor.

    Attributes
    ----------
    position : ndarray, shape (2,), float64
        Centroid as (row, column) in pixels; the centre of the first pixel is (0, 0).
    std : ndarray, shape (2,), float64
        Standard error of `position`, from random noise alone, in pixels.
    """

    position: NDArray[np.float64]
    std: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShiftMeasurement(Brief):
    """A measured move of the sensor.

    Attributes
    ----------
    shift : ndarray, shape (2,), float64
        Shift after the move minus shift before it, as (row, column) in pixels.
    std : ndarray, shape (2,), float64
        Standard error of `shift`, from random noise alone, in pixels.
    before, after : Spot
        The spot before and after the move.
    """

    shift: NDArray[np.float64]
    std: NDArray[np.float64]
    before: Spot
    after: Spot


def measure_shift(
    before: ArrayLike,
    after: ArrayLike,
    *,
    saturation: float | None = None,
    hot: ArrayLike | None = None,
) -> ShiftMeasurement:
    """Measure a move of the sensor, from a spot that is fixed in the beam.

    Parameters
    ----------
    before, after : array_like, shape (rows, cols) or (n, rows, cols)
        Images of a small hole in the beam before and after the move, in DN; several frames each
        give a standard error that includes the camera's noise. The dark need not be subtracted. At
        least 16 rows and columns.
    saturation : float, optional
        Level in DN that saturated samples reach; by default the largest value of an integer
        dtype, and none for floats. Give it for a camera of, say, 12 bits in 16-bit files: 4095.
    hot : array_like of bool, shape (rows, cols), optional
        Pixels that dark frames show to be hot.

    Returns
    -------
    ShiftMeasurement
        The move, its standard error, and the two spots.

    Raises
    ------
    SpotError
        The spot is missing, cut by the edge, doubled or saturated; the message says in which
        argument, where, and by how much.
    InputError
        An argument is not an image or a stack of images, or holds values that are not finite.

    Notes
    -----
    Sign: the spot is fixed in the beam. When the sensor moves towards larger rows, the spot is at a
    smaller row than before. A shift d is the place in the beam of the sensor's first pixel, so ::

        d_new = d_old + centroid(before) - centroid(after)

    and `shift` is ``before.position - after.position``, to be added to the former exposure's
    shift.

    The spot is the largest set of connected pixels above half of the spot's level over a smooth
    background. This search takes background and noise of at most 2²⁰ pixels, evenly spread, which
    leaves errors of 0.4 % and 0.1 % of the noise of a pixel. The centroid is the first moment of
    the background-subtracted signal in a window that holds the spot and its blurred outline; the
    background is a cubic surface fitted around the window; single or paired hot and dead pixels are
    replaced by what their neighbours predict (but not a dead pixel right on a sharp outline, which
    moves the centroid of a disc of radius r by up to 1/(2πr) pixel). An isolated pixel that
    saturates is hot if `hot` says so, or if it saturates in every frame while the light around it
    is below 0.9 of the level: it takes the value that its neighbours show, and does not count as a
    saturated spot.

    The standard error propagates the random noise of every pixel of the window and of the
    background's fit. The noise comes from the scatter of the frames; of a single image it is
    estimated from its roughness, which takes non-uniformity for noise. Not included: vibration,
    and that the two positions fall on different pixels: a non-uniformity of relative rms s, white
    in space, moves the centroid of a disc of any size by s/(2√π) = 0.28 s pixel rms along each
    axis, so a uniform ±5 % moves it by 0.008 pixel and a measured shift by 0.011 pixel. On images
    corrected by a first calibration s is the noise of M: so `Experiment` measures a second time.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> rows, cols = np.indices((96, 128))
    >>> def hole(row, col):
    ...     return 1000 * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / (2 * 3.0**2))
    >>> move = equipix.measure_shift(hole(50, 70), hole(50, 59.25))
    >>> print(move.shift.round(4) + 0.0)
    [ 0.   10.75]
    """
    frames = {"before": _frames("before", before), "after": _frames("after", after)}
    if frames["before"].shape[1:] != frames["after"].shape[1:]:
        raise InputError(
            f"'after' has images of shape {frames['after'].shape[1:]}, expected those of 'before', "
            f"{frames['before'].shape[1:]}"
        )
    levels = (saturation_level(before, saturation), saturation_level(after, saturation))
    known = as_mask(hot, frames["before"].shape[1:], name="hot", may_be_whole=True)
    for (name, images), level in zip(frames.items(), levels, strict=True):
        frames[name] = mended(images, hot_places(images, level, known))
    first, second = (
        Spot(np.array(position), np.array(std))
        for position, std in _native.locate_spots(frames["before"], frames["after"], levels)
    )
    shift = first.position - second.position
    return ShiftMeasurement(shift, np.hypot(first.std, second.std), first, second)


def cross_pattern(first: int, second: int) -> NDArray[np.int64]:
    """Five positions of the sensor in a cross, the pattern of the method's authors.

    Parameters
    ----------
    first, second : int
        Lengths of the two arms along each axis, in pixels: different, neither 0. With coprime
        lengths and a sensor much larger than them, all pixels are connected.

    Returns
    -------
    ndarray, shape (5, 2), int64
        Shifts as (row, column): the origin, two along the columns, two along the rows.

    Raises
    ------
    InputError
        A length is not a whole number or beyond any sensor, or positions coincide.

    Examples
    --------
    >>> import equipix
    >>> equipix.cross_pattern(11, 19).tolist()
    [[0, 0], [0, 11], [0, 19], [11, 0], [19, 0]]
    """
    for name, length in (("first", first), ("second", second)):
        if not is_whole(length) or length == 0:
            raise InputError(f"'{name}' is {length!r}, expected a whole number of pixels, not 0")
        if abs(length) > _BEYOND:
            raise InputError(f"'{name}' is {length!r}, more pixels than any sensor has")
    if first == second:
        raise InputError(f"'second' is {second!r}, the same as 'first': the positions coincide")
    return np.array([(0, 0), (0, first), (0, second), (first, 0), (second, 0)], dtype=np.int64)


def _frames(name: str, values: ArrayLike) -> NDArray[Any]:
    """Images as a stack of one of the dtypes that the compiled part takes."""
    array = as_array(name, values, ndim=(2, 3))
    if array.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        array = array.astype(np.float64)
    return array if array.ndim == 3 else array[np.newaxis]


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
        hot, values[at] = values[at], base
        floor = _FAINT * float(np.ptp(values)) + float(np.finfo(np.float32).tiny)
        values[at] = hot
        light = base + _light(values - base, places, floor)
        image[at] = np.rint(light) if image.dtype.kind in "iu" else light
    return result


def _alone(pixels: Bools) -> Bools:
    """Pixels, away from the border, with no other of these pixels beside them."""
    rows, cols = pixels.shape
    padded = np.pad(pixels, 1).view(np.uint8)
    near = sum(padded[r : r + rows, c : c + cols] for r in range(3) for c in range(3))
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
    return np.asarray(np.array(values)[best, np.arange(len(places))])
