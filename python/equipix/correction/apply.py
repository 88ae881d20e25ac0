"""Frames corrected one by one by a formula, and the values of flagged pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._check import as_array, naming_memory
from equipix.colour import Colours
from equipix.correction.depth import UNKNOWN, Depth
from equipix.correction.kernel import FAST, check_flagged, kept, largest_of, reach_of, run
from equipix.errors import InputError
from equipix.flags import usable
from equipix.frames import FrameStatistics, refuse_subtracted

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Flagged

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
