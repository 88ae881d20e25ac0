"""Types of arguments, and their checks: arrays, masks, counts, shapes, words for messages."""

import functools
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from types import EllipsisType
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from equipix.errors import InputError, InsufficientMemoryError
from equipix.shown import Brief

LOG = logging.getLogger("equipix")
"""Tells the steps of the work: at INFO what a user may want to see, at DEBUG more."""

LOG.addHandler(logging.NullHandler())

ArrayLike: TypeAlias = npt.ArrayLike

Array: TypeAlias = NDArray[Any]

Floats: TypeAlias = NDArray[np.float64]

Ints: TypeAlias = NDArray[np.int64]

Bools: TypeAlias = NDArray[np.bool_]

Pixels: TypeAlias = EllipsisType | slice | tuple[Array, ...]
"""All pixels of a map, blocks of rows, or rows and columns of some."""

Progress: TypeAlias = Callable[[int, int, str], object]
"""Called as ``progress(done, total, stage)``; an exception in it stops the work."""

Rng: TypeAlias = np.random.Generator | int
"""A generator of random numbers, or its seed."""

Method = Literal["multiscale", "coordinate-descent"]

FluxModel = Literal["fit", "linear"]

ShiftSign = Literal["confirmed", "contradicted", "undetermined"]

Flagged = Literal["nan", "keep", "replace"]
"""The values of pixels flagged ``DO_NOT_USE`` in corrected frames."""

Display = Literal["linear", "histogram"]
"""Tone laws of pictures."""

OutputType = Literal["float32", "uint16", "uint8"]
"""Types of corrected frames."""

By = Literal["offset", "gain"]
"""What a one-point correction changes."""

Order = Literal[0, 1, 2, 3, "auto"]
"""Order of response curves, or that which predicts a held-out level best."""


class ReadOnly(Brief):
    """Base of frozen dataclasses whose arrays are read-only.

    They are views: nothing is copied, and an array that the caller made stays writeable.
    """

    def __post_init__(self) -> None:
        """Replace each array by a read-only view of it."""
        fields = vars(self)
        fields |= {name: _guarded(value) for name, value in fields.items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Unpickle: NumPy makes arrays writeable again."""
        vars(self).update(state)
        ReadOnly.__post_init__(self)


def _guarded(value: Any) -> Any:
    """Return a value with its arrays read-only, those in a mapping too."""
    if isinstance(value, dict):
        return {key: _guarded(each) for key, each in value.items()}
    return read_only(value) if isinstance(value, np.ndarray) else value


def read_only(array: Array) -> Array:
    """Return the array itself if it is read-only, else a read-only view of it."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


_MOST_WORKERS = 1024

_PIXELS = ("", "pix", "pixel", "dimensionless")
"""Units of a number of pixels, as packages for quantities name them."""


@contextmanager
def naming_memory(what: str) -> Iterator[None]:
    """Convert NumPy's MemoryError to an InsufficientMemoryError that names the work."""
    try:
        yield
    except InsufficientMemoryError:
        raise
    except MemoryError as error:
        reason = str(error) or "no more memory is available"
        raise InsufficientMemoryError(f"{what}: {reason}") from error


def check_type(name: str, given: object, kind: type | tuple[type, ...], wanted: str) -> None:
    """Refuse what is of another type, such as the name of a file in place of its content."""
    if not isinstance(given, kind):
        raise InputError(f"'{name}' is {described(given)}, expected {wanted}")


def check_word(name: str, given: object, words: tuple[str, ...]) -> None:
    """Refuse what is none of some words."""
    if not (isinstance(given, str) and given in words):
        raise InputError(f"'{name}' is {described(given)}, expected one of {', '.join(words)}")


def described(given: object) -> str:
    """Describe what was given: None, a text, a number or a path by itself, else by its type."""
    plain = given is None or isinstance(given, str | bytes | int | float | PathLike)
    return repr(given) if plain else f"of type {type(given).__name__}"


def as_array(name: str, values: ArrayLike, *, ndim: int | tuple[int, ...]) -> NDArray[Any]:
    """Real numeric array of one of the ranks `ndim`, in native byte order and C order.

    A copy is made only where the caller's array is not already so.
    """
    arrays = values if isinstance(values, list | tuple) else (values,)
    if any(np.ma.is_masked(array) for array in arrays):
        raise InputError(
            f"'{name}' is a masked array, whose mask would be ignored: give it as 'mask', or set "
            "the masked values to NaN"
        )
    try:
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"'{name}' is not an array of numbers: {error}") from error
    if array.dtype.kind not in "buif":
        raise InputError(f"'{name}' {_in_place_of_numbers(array)}")
    ranks = (ndim,) if isinstance(ndim, int) else ndim
    if array.ndim not in ranks:
        wanted = " or ".join(str(rank) for rank in ranks)
        raise InputError(
            f"'{name}' has shape {array.shape}, expected {wanted} dimensions, not {array.ndim}"
        )
    return np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("="))


def _in_place_of_numbers(array: Array) -> str:
    """Say what an array holds in place of real numbers, and what to give of it."""
    objects = array.flat if array.dtype == object else ()
    for each in objects:
        if not isinstance(each, int | float | np.number):
            verb = "holds a value" if array.ndim else "is"
            remedy = ": make a list of it" if hasattr(each, "__next__") else ""
            remedy = ": give its 'mean'" if hasattr(each, "mean") else remedy
            return f"{verb} of type {type(each).__name__}, expected an array of numbers{remedy}"
    return f"has dtype {array.dtype}, expected real numbers"


def as_floats(name: str, values: ArrayLike, *, ndim: int | tuple[int, ...]) -> NDArray[Any]:
    """Like `as_array`, with float32 kept and every other dtype made float64."""
    array = as_array(name, values, ndim=ndim)
    if array.dtype == np.bool_:
        raise InputError(f"'{name}' has dtype bool, expected numbers")
    return array if array.dtype == np.float32 else array.astype(np.float64, copy=False)


def as_shifts(shifts: ArrayLike) -> NDArray[np.float64]:
    """Shifts as float64 of shape (n, 2), all finite."""
    _refuse_units(shifts)
    array = as_array("shifts", shifts, ndim=2).astype(np.float64)
    if array.shape[1] != 2:
        raise InputError(f"'shifts' has shape {array.shape}, expected (n, 2): row and column")
    if not np.isfinite(array).all():
        k = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise InputError(
            f"'shifts' of exposure {k} (from 0) is {array[k].tolist()}, expected finite numbers"
        )
    return array


def _refuse_units(shifts: object) -> None:
    """Refuse lengths with a unit, which NumPy drops, and texts."""
    first = shifts
    while isinstance(first, list | tuple) and first:
        first = first[0]
    for each in (shifts, first):
        unit = getattr(each, "unit", getattr(each, "units", None))
        if unit is not None and str(unit) not in _PIXELS:
            raise InputError(
                f"'shifts' has the unit {unit}, expected plain numbers of pixels: divide by the "
                "pixel pitch, see 'From micrometres to pixels' in docs/shifts.md"
            )
    if isinstance(first, str):
        raise InputError(
            f"'shifts' holds {first!r}, expected numbers of pixels without a unit: divide "
            "micrometres by the pixel pitch"
        )


def check_maps(owner: str, maps: Mapping[str, ArrayLike]) -> None:
    """Refuse maps of one sensor that are not of one shape (rows, cols), that of the first."""
    shapes = {name: np.shape(values) for name, values in maps.items()}
    first = next(iter(shapes))
    for name, shape in shapes.items():
        if len(shape) != 2:
            raise InputError(f"'{name}' of {owner} has shape {shape}, expected (rows, cols)")
        if shape != shapes[first]:
            raise InputError(
                f"'{name}' of {owner} has shape {shape}, expected {shapes[first]} like '{first}'"
            )


def check_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of a sensor, checked."""
    sizes = np.asarray(shape)
    if sizes.shape != (2,) or sizes.dtype.kind not in "iu" or not np.all(sizes > 0):
        raise InputError(f"'shape' is {shape!r}, expected (rows, cols), each 1 or more")
    return int(sizes[0]), int(sizes[1])


def check_bit_depth(bits: int) -> None:
    """Refuse bits of a simulated ADC that no camera has."""
    if bits not in range(8, 17):
        raise InputError(f"'bit_depth' is {bits!r}, expected 8 to 16")


def is_whole(value: Any, least: float = -np.inf, most: float = np.inf) -> bool:
    """Whether a value is a whole number, and no truth value, from `least` to `most`."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and bool(least <= value <= most)


def positive_workers(workers: int | None) -> int | None:
    """The number of worker threads, checked."""
    if workers is None:
        return None
    if not is_whole(workers, 1, _MOST_WORKERS):
        raise InputError(
            f"'workers' is {workers!r}, expected a whole number from 1 to {_MOST_WORKERS} or None"
        )
    return int(workers)


def positive_count(name: str, value: int) -> int:
    """A whole number above 0, checked; above 64 bits it becomes the largest of 64 bits."""
    if not is_whole(value, 1):
        raise InputError(f"'{name}' is {value!r}, expected a positive whole number or None")
    return min(int(value), 2**63 - 1)


def number(name: str, value: float) -> float:
    """A number, checked."""
    if isinstance(value, bool | np.bool_ | str | bytes):
        raise InputError(f"'{name}' is {value!r}, expected a number")
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"'{name}' is {value!r}, expected a number") from error


def positive(name: str, value: float, *, zero: bool = False) -> float:
    """A finite number above 0, or 0 where that is allowed, checked."""
    checked = number(name, value)
    if not (0 < checked < np.inf or (zero and checked == 0)):
        raise InputError(f"'{name}' is {value!r}, expected a finite number above 0{' or 0' * zero}")
    return checked


def as_level(saturation: float | None) -> float | None:
    """The saturation level, checked; None where there is none."""
    if saturation is None:
        return None
    level = number("saturation", saturation)
    if not level > 0:
        raise InputError(f"'saturation' is {saturation!r}, expected a level above 0 in DN, or None")
    return level


def as_tolerance(value: float) -> float:
    """The largest relative error of the sensitivity, checked: it is below 1."""
    checked = number("tolerance", value)
    if not 0 < checked < 1:
        raise InputError(
            f"'tolerance' is {value!r}, expected a relative error between 0 and 1, such as 1e-6"
        )
    return checked


def check_progress(progress: object) -> None:
    """Refuse a progress callback that cannot be called."""
    if progress is not None and not callable(progress):
        raise InputError(
            f"'progress' is {progress!r}, expected a function of (done, total, stage) or None"
        )


def staged(progress: Progress | None, stage: str) -> Progress | None:
    """Progress that names one stage, whatever the work calls its own."""
    return None if progress is None else lambda done, total, _: progress(done, total, stage)


def per_exposure(
    name: str, values: ArrayLike | None, count: int, *, default: float
) -> NDArray[np.float64]:
    """One number for each exposure, `default` unless given."""
    if values is None:
        return np.full(count, float(default))
    array = as_array(name, values, ndim=1).astype(np.float64)
    check_count(name, len(array), count)
    return array


def one_or_each(
    name: str, values: ArrayLike, shape: tuple[int, ...], *, ndim: tuple[int, ...]
) -> NDArray[np.float64]:
    """Finite numbers not below 0, one for all or one for each, as an array of that shape."""
    array = as_array(name, values, ndim=ndim).astype(np.float64)
    if array.shape not in ((1,), shape):  # as_array makes one number an array of one
        raise InputError(f"'{name}' has shape {array.shape}, expected {shape} or one number")
    wrong = array[~(np.isfinite(array) & (array >= 0))]
    if wrong.size:
        raise InputError(f"'{name}' holds {wrong[0]:g}, expected finite numbers not below 0")
    return np.broadcast_to(array, shape)


def check_count(name: str, got: int, count: int, one: str = "exposure") -> None:
    """Refuse an argument that has not one entry for each exposure, or level."""
    if got != count:
        article = "an" if one[0] in "aeiou" else "a"
        raise InputError(f"'{name}' has {got} entries, expected {count}: one {article} {one}")


def union(*masks: Bools | None) -> Bools | None:
    """Union of several masks, of one exposure or of all."""
    given = [mask for mask in masks if mask is not None]
    return functools.reduce(np.logical_or, given) if given else None


def as_mask(
    mask: ArrayLike | None,
    shape: tuple[int, ...],
    *,
    name: str = "mask",
    may_be_whole: bool = False,
) -> Bools | None:
    """Mask of frames of that shape (rows, cols), or (n, rows, cols): of each or of all of them."""
    if mask is None:
        return None
    shapes = list(dict.fromkeys([shape[-2:], shape]))
    array = as_array(name, mask, ndim=tuple(map(len, shapes)))
    if array.dtype != np.bool_:
        raise InputError(
            f"'{name}' has dtype {array.dtype}, expected bool, True = do not use: give {name} != 0"
        )
    if array.shape not in shapes:
        wanted = " or ".join(map(str, shapes))
        raise InputError(f"'{name}' has shape {array.shape}, expected {wanted}")
    if array.all() and not may_be_whole:
        raise InputError(f"'{name}' excludes all pixels: give one with pixels that may be used")
    return array


class Words(NamedTuple):
    """What messages call the argument of the measurements, and one of them.

    `pixel_variances` is whether they take a variance of each pixel.
    """

    argument: str = "'frames'"
    one: str = "exposure"
    pixel_variances: bool = True

    def place(self, number: int, name: str = "") -> str:
        """Name one of the measurements."""
        return f"{self.argument}: {self.one} {repr(name) if name else number}"


EXPOSURES = Words()
