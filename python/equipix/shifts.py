"""Measured moves of the sensor between exposures, and patterns of positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix import _native
from equipix._check import as_array, as_level, as_shifts
from equipix.errors import InputError
from equipix.mending import hot_places, mended

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Floats

ROUNDING = 1e-6
"""Largest fraction of a pixel that counts as rounding, as in the core."""

_UNNOTICED = 0.02
"""Fraction of a pixel that a shift may be rounded by without a warning."""

_BEYOND = 2**31
"""More pixels than any sensor has along a side."""


@dataclass(frozen=True, eq=False)
class Spot:
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
class ShiftMeasurement:
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
    background. Its centroid is the first moment of the background-subtracted signal in a window
    that holds it and its blurred outline; the background is a cubic surface fitted around the
    window; single or paired hot and dead pixels are replaced by what their neighbours predict (but
    not a dead pixel right on a sharp outline, which moves the centroid of a disc of radius r by up
    to 1/(2πr) pixel). An isolated pixel that saturates is hot if `hot` says so, or if it saturates
    in every frame while the light around it is below 0.9 of the level: it takes the value that its
    neighbours show, and does not count as a saturated spot.

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
    known = None if hot is None else _hot(hot, frames["before"].shape[1:])
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
        if isinstance(length, bool) or not isinstance(length, int | np.integer) or length == 0:
            raise InputError(f"'{name}' is {length!r}, expected a whole number of pixels, not 0")
        if abs(length) > _BEYOND:
            raise InputError(f"'{name}' is {length!r}, more pixels than any sensor has")
    if first == second:
        raise InputError(f"'second' is {second!r}, the same as 'first': the positions coincide")
    return np.array([(0, 0), (0, first), (0, second), (first, 0), (second, 0)], dtype=np.int64)


class Rounding(NamedTuple):
    """The shift (row, col) of an exposure, in pixels, before it was rounded to whole ones."""

    exposure: int
    shift: list[float]

    @property
    def words(self) -> str:
        """What was rounded, and the limit."""
        return (
            f"shifts are rounded to whole pixels: that of exposure {self.exposure} (from 0) is "
            f"{np.round(self.shift, 3).tolist()} (limit {_UNNOTICED:g} from whole)"
        )


def nearest_whole(distance: Floats) -> Floats:
    """Nearest whole numbers; of two that are equally near, but for rounding, the lower one.

    As in the compiled part: a move of half a pixel is then the same from wherever it starts, and a
    fraction that all shifts have in common is one half, not minus one half.
    """
    # What rounds to 0 from below is no −0.
    return np.asarray(np.ceil(distance - (0.5 + ROUNDING)) + 0.0)


def round_shifts(
    shifts: Floats, std: ArrayLike | None = None
) -> tuple[NDArray[np.int64], Rounding | None]:
    """Shifts from the first one in whole pixels, and the largest rounding that is noticeable.

    Parameters
    ----------
    shifts : ndarray, shape (n, 2)
        Shifts (row, col) in pixels.
    std : array_like, shape (n, 2), optional
        Their standard errors, in pixels; 0 unless given.

    Returns
    -------
    whole : ndarray, shape (n, 2), int64
        The nearest whole moves from the first exposure; a tie goes to the lower one.
    rounding : Rounding or None
        Where a shift is more than 0.02 pixel and more than three standard errors from whole: it is
        named as given.

    Raises
    ------
    InputError
        If a shift is not a finite number.
    """
    # A shift beyond any sensor, which the solver refuses, must still fit an integer.
    exact = np.clip(as_shifts(shifts - shifts[0]), -_BEYOND, _BEYOND)
    whole = nearest_whole(exact)
    known = np.zeros_like(exact) if std is None else as_array("std", std, ndim=2)
    change = np.abs(exact - whole)
    change[~(change > np.maximum(_UNNOTICED, 3 * known))] = 0
    worst = int(change.max(axis=1).argmax())
    rounding = Rounding(worst, shifts[worst].tolist()) if change[worst].any() else None
    return whole.astype(np.int64), rounding


def whole_moves(shifts: Floats) -> NDArray[np.int64]:
    """Whole shifts that differ from the first one by the nearest whole numbers of pixels.

    A part of a pixel that all shifts have in common moves the grid of the beam along.
    """
    return round_shifts(shifts)[0] + nearest_whole(shifts[0]).astype(np.int64)


def _frames(name: str, values: ArrayLike) -> NDArray[Any]:
    """Images as a stack of one of the dtypes that the compiled part takes."""
    array = as_array(name, values, ndim=(2, 3))
    if array.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        array = array.astype(np.float64)
    return array if array.ndim == 3 else array[np.newaxis]


def _hot(hot: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    array = as_array("hot", hot, ndim=2)
    if array.dtype != np.bool_ or array.shape != shape:
        raise InputError(
            f"'hot' is {array.dtype} of shape {array.shape}, expected bool of shape {shape}"
        )
    return array


def saturation_level(values: ArrayLike, saturation: float | None) -> float | None:
    """Level given, or the largest value of the caller's integer dtype."""
    if saturation is None:
        dtype = np.asarray(values).dtype
        return float(np.iinfo(dtype).max) if dtype.kind in "iu" else None
    return as_level(saturation)
