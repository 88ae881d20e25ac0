"""Where the sensor stood: shifts, rotations, orientations, whole pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from equipix import _native
from equipix._check import Array, Floats, ReadOnly, as_array, as_shifts, check_count, per_exposure
from equipix.errors import InputError

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
        shape: tuple[int, ...] | None = None,
    ) -> Self:
        """Check what the caller gave, for frames of a shape (n, rows, cols) if that is known."""
        # A shift beyond any sensor, which the solver refuses, must still fit an integer.
        exact = np.clip(as_shifts(shifts), -_BEYOND, _BEYOND)
        whole = nearest_whole(exact)
        places = np.where(np.abs(exact - whole) < ROUNDING, whole, exact)
        if shape is not None:
            check_count("shifts", len(places), shape[0])
        turns = as_rotation(rotation, len(places))
        errors = None if std is None else as_shift_std(std, len(places))
        if shape is not None:
            for k, (shift, turn) in enumerate(zip(as_shifts(shifts), turns, strict=True)):
                window = shape[1:] if turn % 180 == 0 else shape[:0:-1]
                check_reach(f"'shifts' of exposure {k} (from 0)", shift, window)
        return cls(places, turns, errors)

    def __len__(self) -> int:
        """Return the number of exposures."""
        return len(self.shifts)

    @property
    def are_turned(self) -> bool:
        """Whether exposures are turned against each other."""
        return len(set(self.rotation.tolist())) > 1

    def oriented(self, orientation: Orientation) -> Self:
        """Return the positions with shifts and rotations in another orientation."""
        std = self.std
        return dataclasses.replace(
            self,
            shifts=orientation.shifts(self.shifts),
            rotation=orientation.rotation(self.rotation),
            std=std if std is None or not orientation.exchanged else std[:, ::-1],
        )

    def whole(self, std: Floats | float = 0.0) -> Self:
        """Return the positions whole pixels from the first one that are nearest to these.

        `std` are errors of the shifts. A part of a pixel that all have in common is kept.
        """
        if _native.common_fraction(self.shifts) is not None:
            return self
        moves, rounding = round_shifts(self.shifts, std)
        return dataclasses.replace(self, shifts=self.shifts[0] + moves, rounding=rounding)

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
    return np.asarray(np.array(_TURNS[rotation]) @ np.asarray(pixel) + _offset(rotation, shape))


def variance_in_beam(variance: Array, rotation: int) -> Array:
    """Return the variances along the axes of the beam of those along the sensor's."""
    return np.asarray(np.abs(_TURNS[rotation]) @ variance)


def _offset(rotation: int, shape: ArrayLike) -> Array:
    """Return t, which makes the smallest corner of the turned window 0."""
    return np.asarray(-np.minimum(_TURNS[rotation], 0) @ (np.asarray(shape) - 1))


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


@dataclass(frozen=True)
class Orientation:
    """How given shifts and rotations are changed: signs first, then the order of the axes.

    Attributes
    ----------
    rows, cols : bool
        Whether the given values along rows, and along columns, change their sign.
    exchanged : bool
        Whether both values of each shift are exchanged, as for shifts given as (x, y).
    turned : bool
        Whether quarter turns go the other way, 90° for 270°.
    """

    rows: bool = False
    cols: bool = False
    exchanged: bool = False
    turned: bool = False

    @classmethod
    def every(cls, *, quarter_turns: bool) -> list[Self]:
        """Return all orientations, the one as given first."""
        ways = (False, True) if quarter_turns else (False,)
        found = [cls(*each) for each in product((False, True), (False, True), (False, True), ways)]
        return sorted(found, key=lambda each: sum(vars(each).values()))

    def shifts(self, given: Floats) -> Floats:
        """Return shifts (n, 2) so changed."""
        signs = np.where([self.rows, self.cols], -1.0, 1.0)
        changed = given * signs + 0.0  # no negative zeros
        return np.ascontiguousarray(changed[:, ::-1]) if self.exchanged else changed

    def rotation(self, given: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return rotations (n,), in degrees, so changed."""
        return -given % 360 if self.turned else given

    @property
    def words(self) -> str:
        """What is to be changed, as a request."""
        return "; then ".join(request for request, _ in self._changes()) or "change nothing"

    @property
    def changes(self) -> str:
        """The same, as what has been changed."""
        return " and ".join(change for _, change in self._changes()) or "nothing changed"

    def _changes(self) -> list[tuple[str, str]]:
        """Each change, as a request and as done."""
        signs = {
            (True, True): "of all shifts",
            (True, False): "of the shifts along rows",
            (False, True): "of the shifts along columns",
        }
        found = []
        if which := signs.get((self.rows, self.cols)):
            found.append((f"reverse the sign {which}", f"the sign {which} reversed"))
        if self.exchanged:
            request = "exchange the two values of each shift: (row, col), not (x, y)"
            found.append((request, "the two values of each shift exchanged"))
        if self.turned:
            request = "give 270 for 90 degrees of rotation, and 90 for 270"
            found.append((request, "rotations of 90 and 270 degrees exchanged"))
        return found


_DECIMALS = 1000
"""Steps per pixel of shifts as people write them."""

_LARGE, _LARGE_WHOLE = 0.1, 0.25
"""Least share of the sensor's side of the largest shift, where steps are a fraction or whole."""

_LEAST_STEP, _LEAST_WHOLE_STEP = 1.0, 3.0
"""Least step, in pixels, of which all shifts are multiples; pixels are 1 to 25 micrometres wide."""


def check_reach(name: str, shift: Floats, shape: tuple[int, ...]) -> None:
    """Refuse a shift as large as the sensor, with its value as it was given."""
    for axis, part, side in zip(("row", "column"), shift, shape, strict=True):
        if abs(part) >= side:
            raise InputError(
                f"{name} is ({shift[0]:.10g}, {shift[1]:.10g}): its {axis} part must be smaller "
                f"than the sensor, which has {side} there; micrometres become pixels when divided "
                "by the pixel pitch"
            )


def micrometre_step(shifts: Floats, shape: tuple[int, int]) -> float | None:
    """Return the step that large shifts are multiples of, as shifts in micrometres are; else None.

    Shifts in pixels that are multiples of a step above 1 would leave the sensor in unconnected
    parts, and measured shifts are multiples of no step.
    """
    moves = np.abs(shifts - shifts[0])
    scaled = moves * _DECIMALS
    whole = np.rint(scaled).astype(np.int64)
    different = np.unique(whole[whole > 0])
    if len(different) < 2 or np.abs(scaled - whole).max() > 1e-3:
        return None
    step = int(np.gcd.reduce(different)) / _DECIMALS
    large = float((moves.max(axis=0) / shape).max())
    least = (_LEAST_WHOLE_STEP, _LARGE_WHOLE) if step.is_integer() else (_LEAST_STEP, _LARGE)
    return step if step >= least[0] and large > least[1] else None


def name_of(names: Sequence[str], exposure: int) -> str:
    """Return how messages name an exposure."""
    own = names[exposure] if names else ""
    return f"exposure {own!r}" if own else f"exposure {exposure} (from 0)"


ROUNDING = 1e-6
"""Largest fraction of a pixel that counts as rounding, as in the core."""

_UNNOTICED = 0.02
"""Fraction of a pixel that a shift may be rounded by without a warning."""


class Rounding(NamedTuple):
    """The shift (row, col) of an exposure, in pixels, before it was rounded to whole ones."""

    exposure: int
    shift: list[float]

    def words(self, names: Sequence[str] = ()) -> str:
        """Say what was rounded, and the limit; exposures may have names."""
        return (
            f"shifts are rounded to whole pixels: that of {name_of(names, self.exposure)} is "
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
    shifts: Floats, std: Floats | float = 0.0
) -> tuple[NDArray[np.int64], Rounding | None]:
    """Shifts from the first one in whole pixels, and the largest rounding that is noticeable.

    Parameters
    ----------
    shifts : ndarray, shape (n, 2)
        Shifts (row, col) in pixels.
    std : ndarray, shape (n, 2), or float
        Their standard errors, in pixels.

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
    change = np.abs(exact - whole)
    change[~(change > np.maximum(_UNNOTICED, 3 * std))] = 0
    worst = int(change.max(axis=1).argmax())
    rounding = Rounding(worst, shifts[worst].tolist()) if change[worst].any() else None
    return whole.astype(np.int64), rounding


def whole_moves(shifts: Floats) -> NDArray[np.int64]:
    """Whole shifts that differ from the first one by the nearest whole numbers of pixels.

    A part of a pixel that all shifts have in common moves the grid of the beam along.
    """
    return round_shifts(shifts)[0] + nearest_whole(shifts[0]).astype(np.int64)
