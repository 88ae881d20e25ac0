"""Corrections prepared for many frames, applied by the compiled part."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from equipix._check import Array, Flagged, as_array, naming_memory, positive_workers
from equipix.correction.apply import (
    FAST,
    check_flagged,
    dark_frame,
    is_stored,
    largest_value,
    native,
    output_dtype,
    run,
    usual_treatment,
)
from equipix.correction.protocol import (
    Correction,
    cfa_of,
    check_correction,
    check_sensor,
    depth_of,
    takes_dark,
)
from equipix.errors import InputError
from equipix.findings import usable
from equipix.measured.statistics import FrameStatistics

Dark = Literal["stored"] | FrameStatistics | ArrayLike | None


class Corrector:
    """A correction prepared for many frames: whole numbers in and out, no array made per frame.

    Parameters
    ----------
    correction : Correction
        What to apply: a calibration, a response, or any other with ``coefficients`` and ``flags``.
    dtype : {"uint16", "uint8", "float32"}
        Type of the corrected frames.
    bit_depth : int, optional
        Significant bits of whole numbers, 8 to 16: the largest value is 2^bits − 1. By default all
        bits of the type.
    flagged : {"nan", "replace", "keep"}, optional
        The value of pixels flagged ``DO_NOT_USE``: NaN; the mean of the nearest good pixels around,
        in the same pass; or the value that the formula gives. Unless given, they become NaN in
        floating-point numbers, and are replaced in whole numbers, which hold no NaN.
    dark : "stored", FrameStatistics, array_like of shape (rows, cols), or None
        The dark frame to subtract, as for the correction's own ``correct``. A calibration that
        holds none needs one, or None for frames whose dark is already subtracted.
    sensor : str, optional
        Name of the sensor that gives the frames, to be compared with that of the correction.
    workers : int, optional
        Number of threads; by default one for each processor. It changes no bit of the result. Up to
        2²⁰ values the calling thread works alone; of larger stacks each thread takes whole frames,
        and of frames of more than 2²⁰ pixels parts.

    Attributes
    ----------
    clipped : int
        Values of whole numbers so far that had to be limited to the range from 0 to the largest
        value, or were not a number.
    extrapolated : int or None
        Values so far that were corrected to below the lowest or above the highest level that the
        response of their pixel was fitted to, to the rounding of float32. None where a correction
        has no range of levels, such as a calibration.
    frames : int
        Frames corrected so far.
    replaced : int
        Pixels that are replaced in each frame; 0 where no pixel is good.

    Raises
    ------
    InputError
        If an argument has a wrong value, the correction has more than four coefficients, or needs
        a dark frame, or is of another sensor.
    InsufficientMemoryError
        If the memory for the coefficients cannot be had.

    Notes
    -----
    A corrected value is c₀ + y·(c₁ + y·(c₂ + y·c₃)), in float32 by Horner's scheme, each operation
    rounded: the same bytes on every processor. Whole numbers are rounded half to even. A value of
    16 bits with four coefficients is off by less than 0.05 DN through float32.

    A pixel is replaced by the mean of the good ones of its eight neighbours; where there are none,
    by that of neighbours replaced before. Behind colour filters those of its colour count, on the
    nearest square around it that has any. NaN counts in no mean, so it does not spread.

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
        flagged: Flagged | None = None,
        dark: Dark = "stored",
        sensor: str | None = None,
        workers: int | None = None,
    ) -> None:
        check_correction("correction", correction)
        self.shape = correction.shape
        self.dtype = output_dtype(dtype)
        self._depth = depth_of(correction)
        self._largest = largest_value(self.dtype, bit_depth)
        self._workers = positive_workers(workers)
        flagged = usual_treatment(self.dtype) if flagged is None else flagged
        check_flagged(flagged, self.dtype)
        check_sensor(correction, sensor)
        levels = levels_of(correction)
        with naming_memory("preparing a correction"):
            coefficients = coefficients_of(correction, dark)
            self._native = native(
                coefficients, correction.flags, flagged, levels, cfa_of(correction)
            )
        good = int(np.count_nonzero(usable(correction.flags)))
        self.replaced = correction.flags.size - good if flagged == "replace" and good else 0
        self.clipped = self.frames = 0
        self.extrapolated = None if levels is None else 0
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
            If a shape or dtype does not fit, whole numbers have fewer bits than those of the
            correction, or a value is above what these hold: `out` is then of no use.
        InsufficientMemoryError
            If the memory for the result cannot be had.
        """
        with naming_memory("correcting"):
            raw = as_array("frames", frames, ndim=(2, 3))
            self._check(raw)
            result = np.empty(raw.shape, self.dtype) if out is None else self._checked(out, raw)
            counts = run(self._native, raw, result, self._largest, self._workers)
        self._depth.refuse_highest(counts.highest, raw.dtype)
        with self._counting:
            self.clipped += counts.limited
            self.frames += 1 if raw.ndim == 2 else len(raw)
            if self.extrapolated is not None:
                self.extrapolated += counts.extrapolated
        return result

    def _check(self, raw: Array) -> None:
        """Refuse frames of another shape, type or bit depth."""
        if raw.shape[-2:] != self.shape:
            raise InputError(f"'frames' has shape {raw.shape}, the sensor {self.shape}")
        if raw.dtype not in FAST:
            raise InputError(
                f"'frames' is {raw.dtype}, expected uint8, uint16 or float32: convert them, or use "
                "the correction's own correct()"
            )
        self._depth.refuse_type(raw.dtype)

    def _checked(self, out: Array, raw: Array) -> Array:
        """Refuse an array that the result cannot be written to."""
        array = isinstance(out, np.ndarray)
        if not array or out.dtype != self.dtype or out.shape != raw.shape:
            got = f"{getattr(out, 'dtype', type(out).__name__)} of shape {np.shape(out)}"
            raise InputError(f"'out' is {got}, expected {self.dtype} of shape {raw.shape}")
        if not (out.flags.carray):
            raise InputError(
                "'out' is not contiguous, not aligned or read-only: give a writeable C-order array"
            )
        if np.may_share_memory(out, raw):
            raise InputError("'out' overlaps 'frames': neighbours of replaced pixels must stay raw")
        return out


def levels_of(correction: Correction) -> Array | None:
    """Lowest and highest level of each pixel, of a correction that was measured at several."""
    limits: Array | None = getattr(correction, "limits", None)
    if limits is None or not (limits[1] > limits[0]).any():
        return None
    return limits


def coefficients_of(correction: Correction, dark: Dark) -> Array:
    """Coefficients with this dark frame in place of that stored, by the rules of ``correct``."""
    stored = is_stored(dark)
    if not takes_dark(correction):
        if stored:
            return correction.coefficients
        raise InputError(
            "'dark' is given, but the offsets of this correction are part of it and no dark frame "
            "can replace them: expected 'stored'"
        )
    # Of no frames it refuses a dark that it would refuse of any.
    correction.correct(np.empty((0, *correction.shape), np.float32), dark=dark)
    if stored:
        return correction.coefficients
    offset = None if dark is None else dark_frame(dark, correction.shape)
    changed: Any = replace(correction, dark=offset)  # type: ignore[type-var]
    return np.asarray(changed.coefficients)
