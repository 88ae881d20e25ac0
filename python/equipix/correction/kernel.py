"""The compiled part that corrects frames: what it takes, and coefficients prepared for it."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import numpy as np

from equipix import _native
from equipix._check import check_word
from equipix._types import Flagged
from equipix.errors import InputError
from equipix.flags import usable

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import DTypeLike

    from equipix._types import Array
    from equipix.colour import Colours

FAST = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
"""Types of frames, and of corrected frames, that the compiled part takes."""


class _Kept(NamedTuple):
    """Prepared coefficients, and the arrays and the treatment that they were prepared for."""

    references: tuple[weakref.ref[Array], ...]
    flagged: str
    cfa: Colours | None
    prepared: _native.Corrector

    def fits(self, sources: tuple[Array, ...], flagged: str, cfa: Colours | None) -> bool:
        """Whether they are for these; another array may have the identity of one that is gone."""
        pairs = zip(self.references, sources, strict=True)
        same = (self.flagged, self.cfa) == (flagged, cfa)
        return same and all(own() is other for own, other in pairs)


_KEPT: dict[tuple[int, ...], _Kept] = {}
"""Prepared coefficients of results, by the identities of their arrays: of each the last ones."""


def reach_of(cfa: Colours | None) -> int:
    """Most rows and columns from a pixel to the next one of its colour."""
    return 1 if cfa is None else max(cfa.period)


def native(
    coefficients: Array,
    flags: Array,
    flagged: Flagged,
    levels: Array | None = None,
    cfa: Colours | None = None,
) -> _native.Corrector:
    """Prepare coefficients of shape (n, rows, cols) for the compiled part.

    It counts values corrected to outside of `levels`, of shape (2, rows, cols), where they are
    given, and replaces pixels by those of their colour where there is a `cfa`.
    """
    planes = np.ascontiguousarray(coefficients, dtype=np.float32)
    ends = None if levels is None else np.ascontiguousarray(levels, dtype=np.float32)
    bad = np.ascontiguousarray(~usable(flags))
    colours = None if cfa is None else cfa.numbers(bad.shape)
    return _native.Corrector(planes, bad, flagged, ends, colours, reach_of(cfa))


def kept(
    sources: tuple[Array, ...],
    flagged: Flagged,
    coefficients: Callable[[], Array],
    cfa: Colours | None,
) -> _native.Corrector:
    """Prepare coefficients once for a result, as long as its arrays live and `flagged` is the same.

    Parameters
    ----------
    sources : tuple of ndarray
        Arrays that the coefficients are made of, the flags last. Only read-only ones, which belong
        to an immutable result, are recognised at the next call.
    flagged : {"nan", "keep", "replace"}
        What becomes of flagged pixels.
    coefficients : callable
        Makes the coefficients.
    cfa : Colours or None
        Colour filters of the pixels.

    Returns
    -------
    _native.Corrector
        As `native` gives it.
    """
    flags = sources[-1]
    if any(array.flags.writeable for array in sources):
        return native(coefficients(), flags, flagged, None, cfa)
    key = tuple(map(id, sources))
    found = _KEPT.get(key)
    if found is not None and found.fits(sources, flagged, cfa):
        return found.prepared

    def forget(_: object) -> None:
        _KEPT.pop(key, None)

    references = tuple(weakref.ref(array, forget) for array in sources)
    prepared = native(coefficients(), flags, flagged, None, cfa)
    found = _KEPT[key] = _Kept(references, flagged, cfa, prepared)
    return found.prepared


class Counts(NamedTuple):
    """What `run` found: values limited to whole numbers, those outside of the levels, the largest.

    The largest raw value is 0 where none is above 0.
    """

    limited: int
    extrapolated: int
    highest: float


def run(
    corrector: _native.Corrector, raw: Array, result: Array, largest: float, workers: int | None
) -> Counts:
    """Correct frames into an array."""
    shape = (-1, *raw.shape[-2:])
    aligned = np.require(raw, requirements=("C", "A"))
    done = corrector.apply(aligned.reshape(shape), result.reshape(shape), largest, workers=workers)
    return Counts(*done)


def check_flagged(flagged: object, dtype: np.dtype[Any] | None = None) -> None:
    """Refuse an unknown treatment of flagged pixels, and NaN in whole numbers of a dtype."""
    check_word("flagged", flagged, get_args(Flagged))
    if flagged == "nan" and dtype is not None and dtype.kind == "u":
        raise InputError(
            f"'flagged' (--flagged) is 'nan', which {dtype} does not hold: take 'replace' or "
            "'keep', or float32"
        )


def usual_treatment(dtype: np.dtype[Any]) -> Flagged:
    """Return the treatment of flagged pixels where none is named: NaN, if a dtype holds it."""
    return "replace" if dtype.kind == "u" else "nan"


def largest_of(dtype: np.dtype[Any]) -> float:
    """Return the largest value of a dtype of whole numbers; 0, which is not used, of others."""
    return float(np.iinfo(dtype).max) if dtype.kind == "u" else 0.0


def output_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    """Return a type that corrected frames may have, and refuse others."""
    try:
        found = np.dtype(dtype)
    except TypeError as error:
        raise InputError(f"'dtype' is {dtype!r}, expected uint8, uint16 or float32") from error
    if found not in FAST:
        raise InputError(f"'dtype' is {found}, expected uint8, uint16 or float32")
    return found


def largest_value(dtype: np.dtype[Any], bit_depth: int | None) -> float:
    """Return the largest value of whole numbers of so many bits."""
    if bit_depth is None:
        return largest_of(dtype)
    bits = 8 * dtype.itemsize
    number = isinstance(bit_depth, int | np.integer) and not isinstance(bit_depth, bool)
    if dtype.kind != "u" or not number or bit_depth not in range(8, bits + 1):
        wanted = f"8 to {bits}"
        if dtype.kind != "u":
            wanted = "None for float32: whole numbers need 'dtype' (--dtype) uint16 or uint8"
        raise InputError(f"'bit_depth' is {bit_depth!r}, expected {wanted}")
    return float(2**bit_depth - 1)
