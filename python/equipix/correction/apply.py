"""Corrections applied to frames."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from equipix import _native
from equipix._check import Array, Flagged, as_array, check_word, naming_memory
from equipix.correction.protocol import UNKNOWN, Depth
from equipix.errors import InputError
from equipix.findings import usable
from equipix.measured.colour import Colours
from equipix.measured.statistics import FrameStatistics, refuse_subtracted

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


_ONE = Colours((("",),))
"""The pattern of a sensor without filters."""


def apply(
    frames: ArrayLike,
    formula: Callable[[NDArray[Any], NDArray[Any]], object],
    *,
    flags: NDArray[Any],
    flagged: Flagged,
    out: NDArray[Any] | None,
    depth: Depth = UNKNOWN,
    cfa: Colours | None = None,
) -> NDArray[Any]:
    """Correct frames by a formula, and treat flagged pixels as `flagged` requires.

    Parameters
    ----------
    frames : array_like, shape (rows, cols) or (n, rows, cols)
        Raw frames, in DN.
    formula : callable
        ``formula(frame, corrected)`` writes a corrected frame of shape (rows, cols) to its second
        argument, a float32 or float64 array.
    flags : ndarray, shape (rows, cols)
        Bits of `Flag` per pixel.
    flagged : {"nan", "keep", "replace"}
        What becomes of pixels flagged ``DO_NOT_USE``.
    out : ndarray or None
        Array for the result, of the frames' shape, float32 or float64.
    depth : Depth
        Bits of the sensor.
    cfa : Colours or None
        Colour filters of the pixels: a pixel is replaced by those of its colour.

    Returns
    -------
    ndarray, of the frames' shape
        Of dtype float64 for float64 frames, else float32; or `out`.

    Raises
    ------
    InputError
        If a shape does not fit, `flagged` is unknown, or frames are of another bit depth.
    """
    with naming_memory("correcting"):
        raw = _checked(frames, flags, flagged)
        depth.refuse_type(raw.dtype)
        dtype = np.dtype(np.float64 if raw.dtype == np.float64 else np.float32)
        result = np.empty(raw.shape, dtype) if out is None else _checked_out(out, raw.shape)
        bad = ~usable(flags)
        for source, target in zip(_each(raw), _each(result), strict=True):
            depth.refuse_highest(float(np.fmax.reduce(source, axis=None)), raw.dtype)
            formula(source, target)
            if flagged == "nan":
                target[bad] = np.nan
            elif flagged == "replace":
                replace_bad(target, bad, cfa)
        return result


def apply_polynomial(
    frames: ArrayLike,
    coefficients: Callable[[], NDArray[Any]],
    *,
    sources: tuple[NDArray[Any], ...] | None,
    flags: NDArray[Any],
    flagged: Flagged,
    out: NDArray[Any] | None,
    depth: Depth,
    cfa: Colours | None = None,
) -> NDArray[Any]:
    """Σ c_j y^j of each value y by Horner's scheme, and the values of flagged pixels.

    Frames of 8 or 16 bits and float32 are corrected in float32 by the compiled part; `out` may
    then be of whole numbers, which are rounded half to even and limited to the range of the type.
    Others are corrected in float64. `coefficients` makes the coefficients, once for the arrays
    `sources` of a result, the flags last. The other parameters are those of `apply`.
    """
    # A copy is no array of the result.
    known = (flags.copy(),) if sources is None else sources
    fast = _fast(frames, known, coefficients, flagged=flagged, out=out, depth=depth, cfa=cfa)
    if fast is not None:
        return fast
    planes = coefficients()

    def formula(frame: NDArray[Any], corrected: NDArray[Any]) -> None:
        total = np.zeros(frame.shape)
        with np.errstate(invalid="ignore"):  # a dead pixel has infinite coefficients
            for coefficient in planes[::-1]:
                total *= frame
                total += coefficient
        corrected[...] = total

    return apply(frames, formula, flags=flags, flagged=flagged, out=out, depth=depth, cfa=cfa)


def apply_gain(
    frames: ArrayLike,
    *,
    gain: NDArray[Any],
    dark: FrameStatistics | ArrayLike | None,
    stored: NDArray[Any] | None,
    flags: NDArray[Any],
    flagged: Flagged,
    out: NDArray[Any] | None,
    depth: Depth,
    cfa: Colours | None = None,
) -> NDArray[Any]:
    """(frame − dark) / gain of each value, and the values of flagged pixels.

    The parameters are those of `equipix.Calibration.correct`; frames and results of some types go
    to the compiled part, as in `apply_polynomial`. Coefficients are prepared once for no dark and
    for the `stored` one of the result; another may change between two calls.
    """
    offset = None if dark is None else dark_frame(dark, gain.shape)
    sources: tuple[NDArray[Any], ...] = (gain, flags)
    if dark is stored and stored is not None:
        sources = (gain, stored, flags)
    elif offset is not None:
        sources = (gain, offset.copy(), flags)  # a copy is no array of the result

    def coefficients() -> NDArray[Any]:
        return gain_coefficients(gain, offset)

    fast = _fast(frames, sources, coefficients, flagged=flagged, out=out, depth=depth, cfa=cfa)
    if fast is not None:
        return fast
    dark_level = np.zeros((), np.float32) if offset is None else offset

    def formula(frame: NDArray[Any], corrected: NDArray[Any]) -> None:
        np.subtract(frame, dark_level, out=corrected, dtype=corrected.dtype, casting="same_kind")
        with np.errstate(divide="ignore", invalid="ignore"):
            np.divide(corrected, gain, out=corrected, casting="same_kind")

    return apply(frames, formula, flags=flags, flagged=flagged, out=out, depth=depth, cfa=cfa)


def gain_coefficients(gain: NDArray[Any], dark: NDArray[Any] | None) -> NDArray[Any]:
    """Coefficients c_0 = −dark/gain, 0 without a dark, and c_1 = 1/gain; NaN where gain is."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a dead pixel may have gain 0
        inverse = 1 / gain.astype(np.float64)
        offset = np.zeros_like(inverse) if dark is None else -dark * inverse
    offset[np.isnan(inverse)] = np.nan
    return np.stack([offset, inverse])


def _fast(
    frames: ArrayLike,
    sources: tuple[NDArray[Any], ...],
    coefficients: Callable[[], NDArray[Any]],
    *,
    flagged: Flagged,
    out: NDArray[Any] | None,
    depth: Depth,
    cfa: Colours | None,
) -> NDArray[Any] | None:
    """Correct frames by the compiled part; None where it does not take their types.

    `sources` are the arrays that `coefficients` makes coefficients of, the flags last.
    """
    with naming_memory("correcting"):
        raw = _checked(frames, sources[-1], flagged)
        if raw.dtype not in FAST or not (out is None or _is_plain(out, raw)):
            return None
        depth.refuse_type(raw.dtype)
        result = np.empty(raw.shape, np.float32) if out is None else out
        check_flagged(flagged, result.dtype)
        if raw.size:
            prepared = kept(sources, flagged, coefficients, cfa)
            counts = run(prepared, raw, result, largest_of(result.dtype), None)
            depth.refuse_highest(counts.highest, raw.dtype)
        return result


def _is_plain(out: NDArray[Any], raw: NDArray[Any]) -> bool:
    """Whether the compiled part can write to an array."""
    fits = isinstance(out, np.ndarray) and out.dtype in FAST and out.shape == raw.shape
    return bool(fits and out.flags.carray and not np.may_share_memory(out, raw))


def _checked(frames: ArrayLike, flags: NDArray[Any], flagged: Flagged) -> NDArray[Any]:
    """Refuse frames of another shape than the sensor, and unknown treatments."""
    raw = as_array("frames", frames, ndim=(2, 3))
    if raw.shape[-2:] != flags.shape:
        raise InputError(f"'frames' has shape {raw.shape}, the sensor {flags.shape}")
    check_flagged(flagged)
    return raw


def is_stored(dark: str | FrameStatistics | ArrayLike | None) -> bool:
    """Whether a dark is the word "stored"; another word is refused."""
    if isinstance(dark, str) and dark != "stored":
        raise InputError(f"'dark' is {dark!r}, expected 'stored', an array or None")
    return isinstance(dark, str)


def dark_or_stored(
    dark: str | FrameStatistics | ArrayLike | None, stored: NDArray[Any] | None
) -> FrameStatistics | ArrayLike | None:
    """Return the dark given, or the stored one of a calibration where it is "stored"."""
    if not is_stored(dark):
        return dark
    if stored is None:
        raise InputError(
            "'dark' is 'stored' but this calibration holds no dark frame: give one, or None if it "
            "is already subtracted"
        )
    return stored


def dark_frame(dark: FrameStatistics | ArrayLike, shape: tuple[int, ...]) -> NDArray[Any]:
    """Check a dark frame that is to be subtracted; of averages it is the mean."""
    if isinstance(dark, FrameStatistics):
        refuse_subtracted(dark)
        dark = dark.mean
    offset = as_array("dark", dark, ndim=2)
    if offset.shape != shape:
        raise InputError(f"'dark' has shape {offset.shape}, the sensor {shape}")
    return offset


def replace_bad(image: NDArray[Any], bad: NDArray[np.bool_], cfa: Colours | None = None) -> None:
    """Put the mean of the nearest good pixels in place of each bad one.

    The good ones of the eight neighbours count; where there are none, those that were filled in
    the round before. With a `cfa` those of its colour count, on the nearest square around the pixel
    that has any. A value that is NaN counts in no mean. An image without any good pixel becomes
    NaN.
    """
    reach = reach_of(cfa)
    inner = (slice(reach, -reach), slice(reach, -reach))
    good = np.pad(~bad & ~np.isnan(image), reach)
    values = np.pad(np.where(good[inner], image, 0).astype(np.float64), reach)
    colours = np.pad((cfa or _ONE).numbers(image.shape), reach)
    todo = np.argwhere(bad) + reach
    while len(todo):
        count, total = np.zeros(len(todo)), np.zeros(len(todo))
        for steps in map(_square, range(1, reach + 1)):
            # Places (steps, pixels to do) in rows and columns.
            places = tuple((todo + steps[:, None]).transpose(2, 0, 1))
            used = good[places] & (colours[places] == colours[tuple(todo.T)]) & (count == 0)
            count += used.sum(axis=0)
            total += np.where(used, values[places], 0).sum(axis=0)
        ready = count > 0
        if not ready.any():
            image[tuple((todo - reach).T)] = np.nan
            return
        filled = tuple(todo[ready].T)
        values[filled] = total[ready] / count[ready]
        good[filled] = True
        image[tuple((todo[ready] - reach).T)] = values[filled]
        todo = todo[~ready]


def _square(reach: int) -> NDArray[np.int64]:
    """Steps (n, 2) to the pixels on the square around a pixel, so far from it."""
    side = np.arange(-reach, reach + 1)
    steps = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(steps[np.abs(steps).max(axis=1) == reach])


def _each(stack: NDArray[Any]) -> NDArray[Any]:
    return stack[None] if stack.ndim == 2 else stack


def _checked_out(out: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    fits = isinstance(out, np.ndarray) and out.shape == shape and out.flags.writeable
    if not fits or out.dtype not in (np.float32, np.float64):
        got = f"{getattr(out, 'dtype', type(out).__name__)} {np.shape(out)}"
        raise InputError(
            f"'out' is {got}, expected a writeable float32 or float64 array of shape {shape}"
        )
    return out
