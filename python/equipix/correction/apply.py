"""The one way to apply a correction to frames: coefficients prepared once."""

import math
import threading
from collections.abc import Callable
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from equipix import _native
from equipix._check import (
    Array,
    Flagged,
    ReadOnly,
    as_array,
    check_word,
    is_whole,
    naming_memory,
    positive_workers,
)
from equipix.correction.protocol import (
    Correction,
    Dark,
    check_correction,
    check_sensor,
    depth_of,
    is_stored,
    sensor_table,
    with_dark,
)
from equipix.errors import InputError
from equipix.findings import usable
from equipix.io.viewed import Viewed
from equipix.measured.colour import Colours
from equipix.shown import Shown

FAST = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
"""Types of frames, and of corrected frames, that are corrected in single precision."""

_DOUBLE = np.dtype(np.float64)

Formula = Callable[[Array], Array]


class Prepared:
    """Coefficients of a correction for the compiled part, of one treatment of bad pixels.

    They are of single precision, which takes and gives the types of `FAST`, or of double precision
    for float64. Where `levels` of shape (2, rows, cols) are given, values corrected to outside of
    them are counted.
    """

    def __init__(
        self,
        correction: Correction,
        coefficients: Array,
        flagged: Flagged,
        *,
        levels: Array | None = None,
        double: bool = False,
    ) -> None:
        self.depth, colours = depth_of(correction), correction.colours
        planes = np.ascontiguousarray(coefficients, np.float64 if double else np.float32)
        ends = None if levels is None else np.ascontiguousarray(levels, np.float32)
        bad = np.ascontiguousarray(~usable(correction.flags))
        numbers = None if colours is None else colours.numbers(bad.shape)
        # Most rows and columns from a pixel to the next one of its colour.
        reach = 1 if colours is None else max(colours.period)
        self._types = (_DOUBLE,) if double else FAST
        self._native = _native.Corrector(planes, bad, flagged, ends, numbers, reach)

    def run(
        self, raw: Array, result: Array, largest: float, workers: int | None = None
    ) -> tuple[int, int, float]:
        """Correct frames into an array of the types that these coefficients take and give.

        It can be written to, and is not part of `raw`. Returned are the numbers of values limited
        to whole numbers and of those outside of the levels, and the largest raw value, or 0.
        """
        shape = (-1, *raw.shape[-2:])
        aligned = np.require(raw, requirements=("C", "A")).reshape(shape)
        return self._native.apply(aligned, result.reshape(shape), largest, workers=workers)

    def write(self, raw: Array, result: Array, formula: Formula | None) -> None:
        """Correct frames into any array, frame by frame where types must be converted."""
        self.depth.refuse_type(raw.dtype)
        plain = result.flags.carray and not np.may_share_memory(result, raw)
        if formula is None and plain and {raw.dtype, result.dtype} <= {*self._types}:
            highest = self.run(raw, result, largest_value(result.dtype))[-1]
            self.depth.refuse_highest(highest, raw.dtype)
            return
        kind = result.dtype if result.dtype in self._types else _DOUBLE
        for source, target in zip(each_frame(raw), each_frame(result), strict=True):
            self.depth.refuse_highest(float(np.fmax.reduce(source, axis=None)), raw.dtype)
            taken = source if formula is None else formula(source)
            if taken.dtype not in self._types:
                taken = taken.astype(_DOUBLE)
            made = np.empty(source.shape, kind)
            self.run(taken, made, largest_value(kind))
            target[...] = made


class CorrectionBase(Shown, ReadOnly):
    """Base of corrections that are frozen dataclasses: what follows from flags and metadata.

    Coefficients are prepared once, for the dark and the treatment of bad pixels of the last call.
    """

    __slots__ = ("_last",)

    @property
    def shape(self: Correction) -> tuple[int, int]:
        """Sizes of the sensor (rows, cols)."""
        rows, cols = self.flags.shape
        return rows, cols

    @property
    def bits(self: Correction) -> int:
        """Bits of the raw values, by the saturation level unless named; 0 where both are unknown.

        Pixels may give more than that level, which may be set below the largest value.
        """
        bits = sensor_table(self.metadata).get("bit_depth")
        if isinstance(bits, int):
            return bits
        level = self.saturation
        return 0 if level in (None, math.inf) else math.ceil(level).bit_length()

    @property
    def colours(self: Correction) -> Colours | None:
        """Colour filters of the pixels, where they are known."""
        return Colours.of(sensor_table(self.metadata).get("cfa"))

    def viewed(self: Correction) -> Viewed:
        """Return the gain, as other programs show it of a file."""
        return Viewed.of("gain", self.coefficients[1], self.flags)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the prepared coefficients, which cannot be pickled."""
        return dict(vars(self))

    def correct(
        self: Any,
        frames: ArrayLike,
        *,
        dark: Dark = "stored",
        flagged: Flagged = "nan",
        exact: bool = False,
        out: Array | None = None,
    ) -> Array:
        """Frames as a sensor of equal pixels would have given them, Σ c_j y^j of raw values y.

        Parameters
        ----------
        frames : array_like, shape (rows, cols) or (n, rows, cols)
            Raw frames, in DN.
        dark : "stored", FrameStatistics, array_like of shape (rows, cols), or None
            The dark frame to subtract, in DN: the one that is part of the correction, another (of
            averaged frames the mean), or none where it is already subtracted. Only what
            `takes_dark` takes another than "stored".
        flagged : {"nan", "keep", "replace"}
            The value of pixels flagged ``DO_NOT_USE``: NaN, the value that the formula gives
            (NaN still in an undetermined pixel, and the code 0 of a table of words), or the mean of
            the nearest good pixels around.
        exact : bool
            Whether to invert the curves of a response to levels, of orders 2 and 3, exactly, some
            20 times slower, with the slope at the end of the valid range beyond it. The cubic
            differs by at most `inverse_error`. Other corrections have no curves to invert.
        out : ndarray, optional
            Array for the result, of the frames' shape, float32 or float64; for frames of 8 or 16
            bits and float32, unless `exact` or of a table of words, also uint8 or uint16, which
            hold no NaN, so they need another `flagged`: values are rounded half to even, and
            limited to the range of the type (`equipix.Corrector` counts such values).

        Returns
        -------
        ndarray, of the frames' shape
            Of dtype float64 for float64 frames, else float32; or `out`. Values outside of the valid
            range of a response are extrapolated: see its `extrapolated`.

        Raises
        ------
        InputError
            If a shape does not fit, `dark` is "stored" and one is needed or another than "stored"
            and none can be taken, `flagged` is unknown, `exact` is set without curves, or frames
            are of another bit depth than the sensor: `out` is then of no use.
        """
        with naming_memory("correcting"):
            raw = checked_frames(frames, self.shape)
            formula = self._formula(dark, exact)
            result = _result(raw, out, flagged, whole=formula is None and raw.dtype in FAST)
            if formula is None:
                double = not {raw.dtype, result.dtype} <= {*FAST}
                prepared = _prepared(self, dark, flagged, double=double)
            else:
                same = np.broadcast_to(np.array([0.0, 1.0])[:, None, None], (2, *self.shape))
                prepared = Prepared(self, same, flagged, double=True)
            prepared.write(raw, result, formula)
        return result

    def _formula(self, _dark: Dark, exact: bool, /) -> Formula | None:
        """What gives a corrected frame, float64, of one of shape (rows, cols) by no coefficients.

        A result of another dtype than float32 or float64 is then refused.
        """
        if exact:
            raise InputError("'exact' is True, but only a Response has curves: leave it out")
        return None

    def _planes(self: Correction, dtype: DTypeLike) -> Array:
        """The coefficients, rounded to a dtype from double precision."""
        return np.asarray(self.coefficients, dtype)


class RawCorrection(CorrectionBase):
    """Base of corrections of raw frames: no dark frame is subtracted, and no levels limit them."""

    dark: ClassVar[None] = None
    takes_dark: ClassVar[bool] = False
    needs_dark: ClassVar[bool] = False
    limits: ClassVar[None] = None


def _prepared(correction: Any, dark: Dark, flagged: Flagged, *, double: bool) -> Prepared:
    """Prepare coefficients, or take those of the last call: a dark of the caller may change."""
    key, stays = (flagged, double, dark is None), dark is None or is_stored(dark)
    last: tuple[Any, Prepared] | None = getattr(correction, "_last", None)
    if stays and last is not None and last[0] == key:
        return last[1]
    if stays:
        object.__setattr__(correction, "_last", None)  # its memory, before more is taken
        del last
    planes = with_dark(correction, dark)._planes(_DOUBLE if double else FAST[-1])
    made = Prepared(correction, planes, flagged, double=double)
    if stays:
        object.__setattr__(correction, "_last", (key, made))
    return made


def each_frame(stack: Array) -> Array:
    """One frame, or the frames of a stack, as a stack."""
    return stack[None] if stack.ndim == 2 else stack


def checked_frames(frames: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Refuse frames of another shape than the sensor."""
    raw = as_array("frames", frames, ndim=(2, 3))
    if raw.shape[-2:] != shape:
        raise InputError(f"'frames' has shape {raw.shape}, the sensor {shape}")
    return raw


def _result(raw: Array, out: Array | None, flagged: Flagged, *, whole: bool) -> Array:
    """Give the array for corrected frames, of floating-point or also of `whole` numbers."""
    check_flagged(flagged)
    if out is None:
        return np.empty(raw.shape, _DOUBLE if raw.dtype == _DOUBLE else np.float32)
    _refuse_output(out, raw, (*FAST, _DOUBLE) if whole else (FAST[-1], _DOUBLE))
    check_flagged(flagged, out.dtype)
    return out


def _refuse_output(out: Array, raw: Array, dtypes: tuple[np.dtype[Any], ...]) -> None:
    """Refuse an array that frames of no such type, or of another shape, are written to."""
    fits = isinstance(out, np.ndarray) and out.shape == raw.shape and out.flags.writeable
    if not fits or out.dtype not in dtypes:
        got = f"{getattr(out, 'dtype', type(out).__name__)} of shape {np.shape(out)}"
        wanted = " or ".join(map(str, dtypes))
        raise InputError(f"'out' is {got}, expected a writeable {wanted} array of {raw.shape}")


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


def output_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    """Return a type that corrected frames may have, and refuse others."""
    try:
        found = np.dtype(dtype)
    except TypeError as error:
        raise InputError(f"'dtype' is {dtype!r}, expected uint8, uint16 or float32") from error
    if found not in FAST:
        raise InputError(f"'dtype' is {found}, expected uint8, uint16 or float32")
    return found


def largest_value(dtype: np.dtype[Any], bit_depth: int | None = None) -> float:
    """Return the largest value of whole numbers of so many bits; 0, not used, of others."""
    if bit_depth is None:
        return float(np.iinfo(dtype).max) if dtype.kind == "u" else 0.0
    bits = 8 * dtype.itemsize
    if dtype.kind != "u" or not is_whole(bit_depth, 8, bits):
        problem = f"expected 8 to {bits}"
        if dtype.kind != "u":
            problem = (
                "but float32 has none: leave it out, or give 'dtype' (--dtype) uint16 or uint8"
            )
        raise InputError(f"'bit_depth' is {bit_depth!r}, {problem}")
    return float(2**bit_depth - 1)


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
        2²⁰ values are corrected by the calling thread, and by one beside it while less than 0.2 ms
        pass between two calls; for so long that one waits without sleep. Of larger stacks each
        thread takes whole frames, and of frames of more than 2²⁰ pixels parts.

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
        self._largest = largest_value(self.dtype, bit_depth)
        self._workers = positive_workers(workers)
        flagged = usual_treatment(self.dtype) if flagged is None else flagged
        check_flagged(flagged, self.dtype)
        check_sensor(correction, sensor)
        levels = correction.limits
        if levels is not None and not (levels[1] > levels[0]).any():
            levels = None
        with naming_memory("preparing a correction"):
            planes = with_dark(correction, dark).coefficients
            self._prepared = Prepared(correction, planes, flagged, levels=levels)
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
            raw = checked_frames(frames, self.shape)
            if raw.dtype not in FAST:
                raise InputError(
                    f"'frames' is {raw.dtype}, expected uint8, uint16 or float32: convert them, or "
                    "use the correction's own correct()"
                )
            self._prepared.depth.refuse_type(raw.dtype)
            result = np.empty(raw.shape, self.dtype) if out is None else self._checked(out, raw)
            limited, outside, highest = self._prepared.run(
                raw, result, self._largest, self._workers
            )
        self._prepared.depth.refuse_highest(highest, raw.dtype)
        with self._counting:
            self.clipped += limited
            self.frames += 1 if raw.ndim == 2 else len(raw)
            if self.extrapolated is not None:
                self.extrapolated += outside
        return result

    def _checked(self, out: Array, raw: Array) -> Array:
        """Refuse an array that the result cannot be written to."""
        _refuse_output(out, raw, (self.dtype,))
        if not out.flags.carray:
            raise InputError(
                "'out' is not contiguous, not aligned or read-only: give a writeable C-order array"
            )
        if np.may_share_memory(out, raw):
            raise InputError("'out' overlaps 'frames': neighbours of replaced pixels must stay raw")
        return out
