"""Corrections prepared for many frames, applied by the compiled part."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from equipix import _native
from equipix._check import as_array, positive_workers
from equipix._types import Flagged
from equipix.errors import InputError
from equipix.flags import usable

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

    from equipix._types import Array
    from equipix.correction.protocol import Correction

FAST = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
"""Types of frames, and of corrected frames, that the compiled part takes."""


class Corrector:
    """A correction prepared for many frames: whole numbers in and out, no allocation per frame.

    Parameters
    ----------
    correction : Correction
        What to apply: a calibration, a response, or any other with ``coefficients`` and ``flags``.
    dtype : {"uint16", "uint8", "float32"}
        Type of the corrected frames.
    bit_depth : int, optional
        Significant bits of whole numbers, 8 to 16: the largest value is 2^bits − 1. By default all
        bits of the type.
    flagged : {"replace", "nan", "keep"}
        The value of pixels flagged ``DO_NOT_USE``: the mean of the nearest good pixels around, in
        the same pass; NaN, which is 0 in whole numbers; or the value that the formula gives.
    workers : int, optional
        Number of threads; by default one for each processor. It changes no bit of the result.

    Attributes
    ----------
    clipped : int
        Values of whole numbers so far that had to be limited to the range from 0 to the largest
        value, or were not a number.
    frames : int
        Frames corrected so far.
    replaced : int
        Pixels that are replaced in each frame.

    Raises
    ------
    InputError
        If an argument has a wrong value, or the correction has more than four coefficients.

    Notes
    -----
    A corrected value is c₀ + y·(c₁ + y·(c₂ + y·c₃)), in float32 by Horner's scheme, each operation
    rounded: the same bytes on every processor. Whole numbers are rounded half to even. A value of
    16 bits with four coefficients is off by less than 0.05 DN through float32.

    A pixel is replaced by the mean of the good ones of its eight neighbours; where there are none,
    by that of neighbours replaced before. NaN counts in no mean, so it does not spread.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> gain = np.array([[0.9, 1.0, 1.1]])
    >>> response = equipix.nuc.fit([100 * gain, 1000 * gain], order=1)
    >>> corrector = equipix.Corrector(response, "uint8")
    >>> corrector.apply(np.array([[90, 100, 110]], np.uint8))
    array([[100, 100, 100]], dtype=uint8)
    >>> corrector.clipped
    0
    """

    def __init__(
        self,
        correction: Correction,
        dtype: DTypeLike = "uint16",
        *,
        bit_depth: int | None = None,
        flagged: Flagged = "replace",
        workers: int | None = None,
    ) -> None:
        self.shape = correction.shape
        self.dtype = output_dtype(dtype)
        self._saturation: float | None = getattr(correction, "saturation", None)
        self._largest = largest_value(self.dtype, bit_depth)
        self._workers = positive_workers(workers)
        check_flagged(flagged)
        self._native = native(correction.coefficients, correction.flags, flagged)
        bad = int(np.count_nonzero(~usable(correction.flags)))
        self.replaced = bad if flagged == "replace" else 0
        self.clipped = self.frames = 0
        self._counting = threading.Lock()

    def __repr__(self) -> str:
        """Short form: sizes and types."""
        return f"<Corrector of {self.shape[0]} x {self.shape[1]} pixels to {self.dtype}>"

    def apply(self, frames: ArrayLike, out: Array | None = None) -> Array:
        """Correct one frame or a stack.

        Parameters
        ----------
        frames : array_like, shape (rows, cols) or (n, rows, cols)
            Raw frames in DN, uint8, uint16 or float32.
        out : ndarray, optional
            Array for the result, of the frames' shape and this corrector's dtype, C-contiguous, not
            the frames themselves.

        Returns
        -------
        ndarray, of the frames' shape
            Of this corrector's dtype; or `out`.

        Raises
        ------
        InputError
            If a shape or dtype does not fit, or whole numbers have fewer bits than the correction.
        """
        raw = as_array("frames", frames, ndim=(2, 3))
        if raw.shape[-2:] != self.shape:
            raise InputError(f"'frames' has shape {raw.shape}, the sensor {self.shape}")
        if raw.dtype not in FAST:
            raise InputError(
                f"'frames' is {raw.dtype}, expected uint8, uint16 or float32: convert them, or use "
                "the correction's own correct()"
            )
        check_depth(raw.dtype, self._saturation)
        result = np.empty(raw.shape, self.dtype) if out is None else self._checked(out, raw)
        clipped = run(self._native, raw, result, self._largest, self._workers)
        with self._counting:
            self.clipped += clipped
            self.frames += 1 if raw.ndim == 2 else len(raw)
        return result

    def _checked(self, out: Array, raw: Array) -> Array:
        """Refuse an array that the result cannot be written to."""
        array = isinstance(out, np.ndarray)
        if not array or out.dtype != self.dtype or out.shape != raw.shape:
            got = f"{getattr(out, 'dtype', type(out).__name__)} of shape {np.shape(out)}"
            raise InputError(f"'out' is {got}, expected {self.dtype} of shape {raw.shape}")
        if not (out.flags.c_contiguous and out.flags.writeable):
            raise InputError("'out' is not contiguous or read-only: give a writeable C-order array")
        if np.may_share_memory(out, raw):
            raise InputError("'out' overlaps 'frames': neighbours of replaced pixels must stay raw")
        return out


def native(coefficients: Array, flags: Array, flagged: Flagged) -> _native.Corrector:
    """Prepare coefficients of shape (n, rows, cols) for the compiled part."""
    planes = np.ascontiguousarray(coefficients, dtype=np.float32)
    return _native.Corrector(planes, np.ascontiguousarray(~usable(flags)), flagged)


def run(
    corrector: _native.Corrector, raw: Array, result: Array, largest: float, workers: int | None
) -> int:
    """Correct frames into an array; gives the number of values that had to be limited."""
    shape = (-1, *raw.shape[-2:])
    return corrector.apply(raw.reshape(shape), result.reshape(shape), largest, workers=workers)


def check_flagged(flagged: str) -> None:
    """Refuse an unknown treatment of flagged pixels."""
    if flagged not in get_args(Flagged):
        raise InputError(f"'flagged' is {flagged!r}, expected one of {get_args(Flagged)}")


def check_depth(dtype: np.dtype[Any], saturation: float | None) -> None:
    """Refuse whole numbers of fewer bits than a sensor that saturates at this level gives."""
    if saturation is None or dtype.kind != "u" or np.iinfo(dtype).max >= saturation / 2:
        return
    raise InputError(
        f"'frames' is {dtype}, but the levels saturate at {saturation:g} DN: frames of another bit "
        "depth"
    )


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
    if dtype.kind != "u" or isinstance(bit_depth, bool) or bit_depth not in range(8, bits + 1):
        wanted = f"8 to {bits}" if dtype.kind == "u" else "None for float32"
        raise InputError(f"'bit_depth' is {bit_depth!r}, expected {wanted}")
    return float(2**bit_depth - 1)
