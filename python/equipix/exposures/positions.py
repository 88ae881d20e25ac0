"""Positions of the sensor in the beam."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix import _native
from equipix._check import as_array, as_shifts, check_count, per_exposure
from equipix._readonly import ReadOnly
from equipix.errors import InputError
from equipix.shifts import ROUNDING, nearest_whole, round_shifts

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Array, Floats
    from equipix.exposures.orientation import Orientation
    from equipix.shifts import Rounding

_TURNS = {
    0: ((1, 0), (0, 1)),
    90: ((0, 1), (-1, 0)),
    180: ((-1, 0), (0, -1)),
    270: ((0, -1), (1, 0)),
}
"""A of each rotation, in degrees: the exposure is ``numpy.rot90(window, rotation / 90)``."""

WIDEST = 0.3
"""Largest prior standard deviation of a shift, in pixels: a fit moves it by less than a pixel."""

_BEYOND = 2**31
"""More pixels than any sensor has along a side."""


@dataclass(frozen=True, eq=False)
class Positions(ReadOnly):
    """Positions of the sensor in the beam: pixel p is at u = A p + t + d.

    Attributes
    ----------
    shifts : ndarray, shape (n, 2), float64
        Shift d (row, col) of each exposure, in pixels.
    rotation : ndarray, shape (n,), int64
        How far the sensor is turned, in degrees: 0, 90, 180 or 270. It determines A and t.
    std : ndarray, shape (n, 2), float64, or None
        Prior standard deviations of the shifts, in pixels; None: the shifts are exact.
    rounding : Rounding or None
        The largest noticeable rounding, where the shifts were rounded to whole pixels.
    """

    shifts: Floats
    rotation: NDArray[np.int64]
    std: Floats | None = None
    rounding: Rounding | None = None

    @classmethod
    def of(
        cls,
        shifts: ArrayLike,
        *,
        rotation: ArrayLike | None = None,
        std: ArrayLike | None = None,
        count: int | None = None,
    ) -> Self:
        """Check what the caller gave, for `count` exposures if that is known."""
        # A shift beyond any sensor, which the solver refuses, must still fit an integer.
        exact = np.clip(as_shifts(shifts), -_BEYOND, _BEYOND)
        whole = nearest_whole(exact)
        places = np.where(np.abs(exact - whole) < ROUNDING, whole, exact)
        if count is not None:
            check_count("shifts", len(places), count)
        turns = as_rotation(rotation, len(places))
        return cls(places, turns, None if std is None else as_shift_std(std, len(places)))

    def __len__(self) -> int:
        """Return the number of exposures."""
        return len(self.shifts)

    def oriented(self, orientation: Orientation) -> Self:
        """Return the positions with shifts and rotations in another orientation."""
        std = self.std
        return dataclasses.replace(
            self,
            shifts=orientation.shifts(self.shifts),
            rotation=orientation.rotation(self.rotation),
            std=std if std is None or not orientation.exchanged else std[:, ::-1],
        )

    def whole(self, std: ArrayLike | None = None) -> Self:
        """Return the positions whole pixels from the first one that are nearest to these.

        `std` are errors of the shifts. A part of a pixel that all have in common is kept.
        """
        if _native.common_fraction(self.shifts) is not None:
            return self
        moves, rounding = round_shifts(self.shifts, std)
        return dataclasses.replace(self, shifts=self.shifts[0] + moves, rounding=rounding)

    def at(self, shifts: ArrayLike, std: ArrayLike) -> Self:
        """Return the same exposures at other shifts, measured with standard deviations `std`."""
        return type(self).of(shifts, rotation=self.rotation, std=std, count=len(self))

    def chosen(self, exposures: Sequence[int] | NDArray[Any]) -> Self:
        """Return the positions of some exposures."""
        std = None if self.std is None else self.std[exposures]
        return dataclasses.replace(
            self, shifts=self.shifts[exposures], rotation=self.rotation[exposures], std=std
        )

    def of_window(self, first: Array, sizes: Array, shape: tuple[int, int]) -> Self:
        """Return the positions of the part of the sensor from pixel `first` on, of `sizes`.

        The smallest corner is the origin, so that the padded grid of the part is small.
        """
        shifts = self.shifts + self.corners(first, sizes, shape)
        return dataclasses.replace(self, shifts=shifts - np.floor(shifts.min(axis=0)))

    def corners(self, first: ArrayLike, sizes: ArrayLike, shape: tuple[int, int]) -> Floats:
        """Return (n, 2): how far the shift of a part of the sensor is from that of the whole."""
        turns = self.rotation.tolist()
        return np.array([in_beam(first, turn, shape) - _offset(turn, sizes) for turn in turns])


def in_beam(pixel: ArrayLike, rotation: int, shape: tuple[int, int]) -> Array:
    """Return A p + t: the place of a pixel in the beam at shift 0."""
    place: Array = np.array(_TURNS[rotation]) @ np.asarray(pixel) + _offset(rotation, shape)
    return place


def variance_in_beam(variance: Array, rotation: int) -> Array:
    """Return the variances along the axes of the beam of those along the sensor's."""
    return np.asarray(np.abs(_TURNS[rotation]) @ variance)


def _offset(rotation: int, shape: ArrayLike) -> Array:
    """Return t, which makes the smallest corner of the turned window 0."""
    offset: Array = -np.minimum(_TURNS[rotation], 0) @ (np.asarray(shape) - 1)
    return offset


def as_rotation(rotation: ArrayLike | None, count: int) -> NDArray[np.int64]:
    """Rotation of each exposure, in degrees; 0 unless given."""
    turns = per_exposure("rotation", rotation, count, default=0)
    if not np.all(np.isin(turns, tuple(_TURNS))):
        raise InputError(f"'rotation' is {turns.tolist()}, expected 0, 90, 180 or 270 degrees")
    return turns.astype(np.int64)


def as_shift_std(shift_std: ArrayLike, count: int) -> Floats:
    """Standard deviations of the shifts, (n, 2)."""
    array = as_array("shift_std", shift_std, ndim=(0, 1, 2))
    if array.ndim == 1:
        array = array[:, np.newaxis]
    if array.size != 1 and array.shape not in ((count, 1), (count, 2)):
        raise InputError(
            f"'shift_std' has shape {array.shape}, expected ({count},) or ({count}, 2)"
        )
    std = np.array(np.broadcast_to(array, (count, 2)), dtype=np.float64)
    if not (np.isfinite(std).all() and (std >= 0).all() and std.any()):
        raise InputError(f"'shift_std' is {std.tolist()}, expected pixels, not negative, not all 0")
    if std.max() > WIDEST:
        raise InputError(
            f"'shift_std' holds {std.max():g}, expected at most {WIDEST}: shifts are refined "
            "within a pixel of where they were measured: measure them more accurately"
        )
    return std
