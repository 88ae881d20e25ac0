"""Words of a correction: coarse offset, fine offset and gain of every pixel."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix._native import __version__
from equipix.errors import InputError
from equipix.flags import set_bits, usable
from equipix.hardware.words import WIDEST, Format, Words

if TYPE_CHECKING:
    from equipix._types import Array, Bools, Floats
    from equipix.correction.protocol import Correction

_FINEST_GAIN = -40
"""Exponent of the finest step of a gain."""

_NAMED = 3
"""Most pixels that a message names."""

_STEPS = 65
"""Raw values at which a straight line is compared with the curve that it replaces."""


class Steps(NamedTuple):
    """Exponents of the steps; None is the finest step that holds all usable pixels."""

    adc: int
    coarse: int | None
    offset: int | None
    gain: int | None
    out: int


class Encoded(NamedTuple):
    """Words of all pixels, 0 where a pixel must not be used, and what they stand for."""

    format: Format
    coarse: Array
    offset: Array
    gain: Array
    flags: Array
    largest_error: float
    """Largest difference to the line of a usable pixel over the range of the ADC, in DN, before
    the output is rounded."""


def line_of(
    correction: Correction, linearise: tuple[float, float] | None
) -> tuple[Floats, Floats, float]:
    """Offset and gain of each pixel; the largest deviation of the line from the curve, in DN.

    Raises
    ------
    InputError
        If the correction is curved and `linearise` is not given, or names no range.
    """
    planes = np.asarray(correction.coefficients, np.float64)
    if len(planes) < 2:
        raise InputError("'correction' has no gain, expected coefficients of order 1 or more")
    if linearise is None:
        if len(planes) > 2 and np.nan_to_num(planes[2:]).any():
            raise InputError(
                f"'correction' is of order {len(planes) - 1}, but a table of gain and offset holds "
                "order 1: fit a response of order 1, or give 'linearise' (--linearise), two raw "
                "values in DN between which a straight line takes the place of the curve"
            )
        return planes[0], planes[1], 0.0
    low, high = (float(each) for each in linearise)
    if not (np.isfinite([low, high]).all() and low < high):
        raise InputError(f"'linearise' is {linearise!r}, expected two rising raw values in DN")
    ends = [_curve(planes, value) for value in (low, high)]
    gain = (ends[1] - ends[0]) / (high - low)
    offset = ends[0] - gain * low
    away = [
        np.abs(_curve(planes, value) - offset - gain * value)[usable(correction.flags)]
        for value in np.linspace(low, high, _STEPS)
    ]
    largest = float(np.nanmax(away)) if np.isfinite(away).any() else 0.0
    # Half of the largest deviation of a parabola is left on either side.
    middle = _curve(planes, (low + high) / 2) - offset - gain * (low + high) / 2
    return offset + middle / 2, gain, largest


def _curve(planes: Floats, raw: float) -> Floats:
    total = np.zeros(planes.shape[1:])
    for plane in planes[::-1]:
        total = total * raw + plane
    return total


def encode(
    line: tuple[Floats, Floats], flags: Array, widths: dict[str, int], steps: Steps, lowest: float
) -> Encoded:
    """Make the words of the line of each pixel.

    Parameters
    ----------
    line : tuple of ndarray
        Offset and gain of each pixel: corrected = offset + gain · raw, in DN.
    flags : ndarray
        Bits of `Flag` per pixel.
    widths : dict
        Widths of the words, by the names of `Format`.
    steps : Steps
        Exponents of the steps.
    lowest : float
        Corrected value in DN that the ADC must still see: pixels have a word of 0 or more there,
        and the output is 0.

    Returns
    -------
    Encoded
        The words.

    Raises
    ------
    InputError
        If no pixel is usable, a usable one has no gain above 0, or words do not fit.
    """
    offset, gain = line
    flags = np.array(flags, np.uint32)
    set_bits(flags, "undetermined", ~np.isfinite(offset + gain) & usable(flags))
    used = usable(flags)
    o, g = offset[used], gain[used]
    _refuse_unresponsive(g)
    coarse_words, coarse = _coarse((lowest - o) / g, widths["dac_bits"], steps)
    zero = int(np.floor(np.ldexp(lowest, -steps.out)))
    o -= np.ldexp(float(zero), steps.out)
    pedestal = np.ldexp(coarse_words, coarse)
    gains = Words("gain", widths["gain_bits"], lowest=1)
    if steps.gain is None:
        _refuse_extreme(gains, g, used)
    gain_words, gain_exponent = _chosen(gains, g, steps.gain, _FINEST_GAIN)
    # The offset takes up the rounding of the gain in the middle of the range of the ADC.
    rounded = np.ldexp(gain_words, gain_exponent)
    middle = np.ldexp(float(2 ** (widths["adc_bits"] - 1)), steps.adc)
    fine = o + g * pedestal + (g - rounded) * middle
    words = Words("offset", widths["offset_bits"], signed=True)
    offset_words, exponent, base = _offsets(fine, words, steps, gain_exponent + steps.adc)
    left = fine - np.ldexp(float(base), steps.out) - np.ldexp(offset_words, exponent)
    exponents = {"adc": steps.adc, "coarse": coarse, "offset": exponent, "out": steps.out}
    return Encoded(
        Format(**widths, **exponents, gain=gain_exponent, base=base, zero=zero),
        _spread(coarse_words, used, np.uint16),
        _spread(offset_words, used, np.int16),
        _spread(gain_words, used, np.uint16),
        flags,
        float((np.abs(left) + np.abs(g - rounded) * middle).max()),
    )


def _offsets(values: Floats, words: Words, steps: Steps, product: int) -> tuple[Floats, int, int]:
    """Words of the fine offset, their exponent, and the base in the middle of their values."""
    base = int(np.rint(np.ldexp((values.min() + values.max()) / 2, -steps.out)))
    values = values - np.ldexp(float(base), steps.out)
    return *_chosen(words, values, steps.offset, min(product, steps.out)), base


def _refuse_unresponsive(gain: Floats) -> None:
    if not gain.size:
        raise InputError("'correction' has no usable pixel: all are flagged DO_NOT_USE or NaN")
    wrong = int(np.count_nonzero(gain <= 0))
    if wrong:
        raise InputError(
            f"'correction' has a gain of 0 or below in {wrong} usable pixels, such as "
            f"{gain.min():.4g}, expected more than 0: flag them DO_NOT_USE"
        )


def _refuse_extreme(words: Words, gain: Floats, used: Bools) -> None:
    """Refuse gains that no step holds together, and name the fewer ones that are far from most."""
    step = words.finest(gain, _FINEST_GAIN)
    small = words.rounded(gain, step) < words.lowest
    if not small.any():
        return
    far = small
    if 2 * np.count_nonzero(small) > gain.size:
        far = gain >= min(words.limits[1] * float(np.median(gain)), gain.max())
    places = [tuple(each) for each in np.argwhere(used)[far].tolist()]
    more = f" and {len(places) - _NAMED} more" if len(places) > _NAMED else ""
    raise InputError(
        f"'gain_bits' is {words.bits}: no gain_step holds gains from {gain.min():.6g} to "
        f"{gain.max():.6g}, of which {float(np.median(gain)):.6g} is the median. Flag DO_NOT_USE "
        f"the pixels far from it: {', '.join(map(str, places[:_NAMED]))}{more}{_wider(words, gain)}"
    )


def _wider(words: Words, gain: Floats) -> str:
    """Say how many bits would hold all gains."""
    for bits in range(words.bits + 1, WIDEST + 1):
        wider = Words(words.name, bits, lowest=words.lowest)
        if not wider.outside(gain, wider.finest(gain, _FINEST_GAIN)):
            return f"; or take {bits} gain_bits"
    return ""


def _coarse(pedestal: Floats, bits: int, steps: Steps) -> tuple[Floats, int]:
    """Words of the DAC: at most what the pixel gives at the lowest corrected value."""
    words = Words("dac", bits, floor=True)
    return _chosen(words, np.maximum(pedestal, 0), steps.coarse, steps.adc)


def _chosen(words: Words, values: Floats, exponent: int | None, finest: int) -> tuple[Floats, int]:
    """Words with the given step, or with the finest that holds all values."""
    chosen = words.finest(values, finest) if exponent is None else exponent
    return words.encoded(values, chosen), chosen


def _spread(words: Floats, used: Bools, dtype: type[np.generic]) -> Array:
    """Words of usable pixels in their places, 0 elsewhere."""
    out = np.zeros(used.shape, dtype)
    out[used] = words
    return out


def origin(correction: Correction) -> dict[str, Any]:
    """Return what a table keeps of its correction: the hash of its numbers, kind, sensor."""
    digest = hashlib.sha256()
    for array in (np.asarray(correction.coefficients, "<f8"), np.asarray(correction.flags, "<u4")):
        digest.update(f"{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    sensor = correction.metadata.get("sensor")
    return {
        "equipix": __version__,
        "correction": type(correction).__name__,
        "sha256": digest.hexdigest(),
        **({"sensor": sensor} if isinstance(sensor, dict) else {}),
    }
