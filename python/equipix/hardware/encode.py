"""The line of each pixel as offset and gain words."""

import hashlib
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import DTypeLike

from equipix._check import Array, Bools, Floats
from equipix._native import __version__
from equipix.correction.protocol import Correction, sensor_table
from equipix.errors import InputError
from equipix.findings import set_bits, usable
from equipix.hardware.table_files import DTYPES, Content
from equipix.hardware.words import Format, Words
from equipix.measured.part import blocks, chosen, median

_FINEST_GAIN = -40
"""Exponent of the finest step of a gain."""

_NAMED = 3
"""Most pixels that a message names."""

_FAR = 15.0
"""Distance from the median above which an offset is far, over the median distance: of a normal
distribution ten standard deviations."""

_FEW = 0.01
"""Largest share of offsets that are far from most: more are a part of the array."""

_COSTLY = 2.0
"""Largest error over that without far offsets, above which these are refused."""

_ZERO_LIMIT = 2**31
"""The output 0 stands for fewer steps than this."""


class Steps(NamedTuple):
    """Exponents of the steps; None is the finest step that holds all usable pixels."""

    adc: int
    coarse: int | None
    offset: int | None
    gain: int | None
    out: int


def encode(
    line: tuple[Floats, Floats], flags: Array, widths: dict[str, int], steps: Steps, lowest: float
) -> Content:
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
    Content
        The words, 0 where a pixel must not be used. Its metadata are `lowest` and the largest
        difference to the line of a usable pixel over the range of the ADC, in DN, before the output
        is rounded.

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
    zero = _zero(lowest, steps)
    coarse_words, coarse = _coarse((lowest - o) / g, widths["dac_bits"], steps, lowest)
    gains = Words("gain", widths["gain_bits"], lowest=1)
    if steps.gain is None:
        _refuse_extreme(gains, g, used)
    gain_words, gain_exponent = _chosen(gains, g, steps.gain, _FINEST_GAIN)
    # The offset takes up the rounding of the gain in the middle of the range of the ADC.
    middle = np.ldexp(float(2 ** (widths["adc_bits"] - 1)), steps.adc)
    rounding = (g - np.ldexp(gain_words, gain_exponent)) * middle
    fine = o - np.ldexp(float(zero), steps.out) + g * np.ldexp(coarse_words, coarse) + rounding
    words = Words("offset", widths["offset_bits"], signed=True)
    offset_words, exponent, base = _offsets(fine, words, steps, gain_exponent + steps.adc)
    lost = fine - np.ldexp(float(base), steps.out) - np.ldexp(offset_words, exponent)
    exponents = {"adc": steps.adc, "coarse": coarse, "offset": exponent, "out": steps.out}
    found = Format(**widths, **exponents, gain=gain_exponent, base=base, zero=zero)
    largest = float((np.abs(lost) + np.abs(rounding)).max())
    stored = {"coarse": coarse_words, "offset": offset_words, "gain": gain_words}
    arrays = {name: _spread(each, used, DTYPES[name]) for name, each in stored.items()}
    metadata = {"lowest": lowest, "largest_error_dn": largest}
    return Content(found, **arrays, flags=flags, metadata=metadata)


def _zero(lowest: float, steps: Steps) -> int:
    """Value of the output 0 in its steps.

    Raises
    ------
    InputError
        If it does not fit 32 bits.
    """
    zero = float(np.floor(np.ldexp(lowest, -steps.out)))
    if abs(zero) >= _ZERO_LIMIT:
        step = 2.0**steps.out
        raise InputError(
            f"'lowest' is {lowest:g} DN, expected less than {_ZERO_LIMIT * step:g} on either side "
            f"of 0: the output counts from it in steps of {step:g} DN, with 32 bits"
        )
    return int(zero)


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


def refuse_far_offsets(
    found: Content, line: tuple[Floats, Floats], widths: dict[str, int], steps: Steps, lowest: float
) -> None:
    """Refuse few offsets far from most that make the words of all the others coarse.

    The first parameter is what `encode` made of the others. What is usual is asked of 2¹⁹ pixels,
    evenly over the sensor, where there are more.

    Raises
    ------
    InputError
        With their places, and what the largest error is without them.
    """
    used, step, error = usable(found.flags), 2.0**steps.out, found.metadata["largest_error_dn"]
    part = line[0].flat[chosen(used)]
    usual = median(part)
    limit = _FAR * max(step, median(np.abs(part - usual)))
    far = used.copy()
    for rows in blocks(far.shape):
        far[rows] &= np.abs(line[0][rows] - usual) > limit
    few = 0 < np.count_nonzero(far) <= _FEW * np.count_nonzero(used)
    if steps.offset is not None or error <= step or not few:
        return
    flags = np.array(found.flags)
    set_bits(flags, "undetermined", far)
    without = encode(line, flags, widths, steps, lowest).metadata["largest_error_dn"]
    if error > _COSTLY * without:
        raise InputError(
            f"'offset_bits' is {widths['offset_bits']}: the step that holds all offsets makes the "
            f"largest error {error:.3g} DN, without the {np.count_nonzero(far)} "
            f"offsets far from most {without:.3g} DN. Flag DO_NOT_USE their pixels: "
            f"{_places(far)}; or give an offset_step"
        )


def refuse_far_lowest(found: Content, line: tuple[Floats, Floats], largest: float) -> None:
    """Refuse a lowest value that no usable pixel gives for raw values up to the largest.

    Raises
    ------
    InputError
        With the range.
    """
    # Where the correction adds to all pixels, the output may begin at 0.
    low, high = 0.0, -np.inf
    for rows in blocks(found.flags.shape):
        offset, gain = (each[rows][usable(found.flags[rows])] for each in line)
        low = float(np.min(offset, initial=low))
        high = float(np.max(offset + gain * largest, initial=high))
    lowest = found.metadata["lowest"]
    if not low <= lowest <= high:
        raise InputError(
            f"'lowest' is {lowest:g} DN, expected a corrected value from {low:g} to {high:g} DN, "
            f"as raw values of the sensor, up to {largest:g} DN, have: choose some noise below the "
            "darkest scene"
        )


def _places(pixels: Bools) -> str:
    """Name the first of some pixels."""
    places = [tuple(each) for each in np.argwhere(pixels).tolist()]
    more = f" and {len(places) - _NAMED} more" if len(places) > _NAMED else ""
    return ", ".join(map(str, places[:_NAMED])) + more


def _refuse_extreme(words: Words, gain: Floats, used: Bools) -> None:
    """Refuse gains that no step holds together, and name the fewer ones that are far from most."""
    step = words.finest(gain, _FINEST_GAIN)
    small = words.rounded(gain, step) < words.lowest
    if not small.any():
        return
    far = small
    if 2 * np.count_nonzero(small) > gain.size:
        far = gain >= min(words.limits[1] * float(np.median(gain)), gain.max())
    pixels = used.copy()
    pixels[used] = far
    bits = words.wide_enough(gain, lambda wider: wider.finest(gain, _FINEST_GAIN))
    raise InputError(
        f"'gain_bits' is {words.bits}: no gain_step holds gains from {gain.min():.6g} to "
        f"{gain.max():.6g}, of which {float(np.median(gain)):.6g} is the median. Flag DO_NOT_USE "
        f"the pixels far from it: {_places(pixels)}{f'; or take {bits} gain_bits' if bits else ''}"
    )


def _coarse(pedestal: Floats, bits: int, steps: Steps, lowest: float) -> tuple[Floats, int]:
    """Words of the DAC: at most what the pixel gives at the lowest corrected value."""
    if bits == 0:
        return np.zeros(pedestal.shape), steps.adc
    words = Words("dac", bits, floor=True)
    values = np.maximum(pedestal, 0)
    if steps.coarse is not None and words.outside(values, steps.coarse) == values.size:
        most = np.ldexp(float(2**bits - 1), steps.coarse)
        raise InputError(
            f"'lowest' is {lowest:g} DN, where all usable pixels give {values.min():.6g} DN or "
            f"more, but the DAC subtracts at most {most:g} DN: take a smaller 'lowest', or a "
            "larger 'dac_step'"
        )
    return _chosen(words, values, steps.coarse, steps.adc)


def _chosen(words: Words, values: Floats, exponent: int | None, finest: int) -> tuple[Floats, int]:
    """Words with the given step, or with the finest that holds all values."""
    chosen = words.finest(values, finest) if exponent is None else exponent
    return words.encoded(values, chosen), chosen


def _spread(words: Floats, used: Bools, dtype: DTypeLike) -> Array:
    """Words of usable pixels in their places, 0 elsewhere."""
    out = np.zeros(used.shape, dtype)
    out[used] = words
    return out


def origin(correction: Correction) -> dict[str, Any]:
    """Return what a table keeps of its correction: the hash of its numbers, kind, sensor."""
    digest = hashlib.sha256()
    for array in (np.asarray(correction.coefficients, "<f8"), np.asarray(correction.flags, "<u4")):
        digest.update(f"{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    sensor = sensor_table(correction.metadata)
    return {
        "equipix": __version__,
        "correction": type(correction).__name__,
        "sha256": digest.hexdigest(),
        **({"sensor": sensor} if sensor else {}),
    }


_STEPS = 65
"""Raw values at which a straight line is compared with the curve that it replaces."""


def line_of(
    correction: Correction, linearise: tuple[float, float] | None, largest: float
) -> tuple[tuple[Floats, Floats], tuple[float, float]]:
    """Offset and gain of each pixel; largest sag of usable curves, and the pattern of lines, in DN.

    The sag is the range of the difference between the curve and the line through its ends. The
    pattern is the largest standard deviation over the pixels of what the lines leave of the curves.

    Raises
    ------
    InputError
        If the correction is curved and `linearise` is not given, or has no two rising raw values
        up to the largest.
    """
    planes = np.asarray(correction.coefficients, np.float64)
    if len(planes) < 2:
        raise InputError("'correction' has no gain, expected a polynomial of degree 1 or more")
    if linearise is None:
        if len(planes) > 2 and np.nan_to_num(planes[2:]).any():
            raise InputError(
                f"'correction' has degree {len(planes) - 1} in raw values, but a table of gain and "
                "offset holds degree 1: fit a response of order 1, or give 'linearise' "
                "(--linearise), two raw values in DN between which a straight line takes the place "
                "of the curve"
            )
        return (planes[0], planes[1]), (0.0, 0.0)
    return _chord(planes, usable(correction.flags), *_checked_range(linearise, largest))


def _checked_range(linearise: object, largest: float) -> tuple[float, float]:
    """Two rising raw values that the sensor has.

    Raises
    ------
    InputError
        If there are not two, they do not rise, or are out of range.
    """
    problem = (
        f"'linearise' is {linearise!r}, expected two rising raw values in DN from 0 to "
        f"{largest:g}, the largest raw value of the sensor"
    )
    try:
        low, high = (float(each) for each in linearise)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise InputError(problem) from error
    if not 0 <= low < high <= largest:
        raise InputError(problem)
    return low, high


def _chord(
    planes: Floats, used: Bools, low: float, high: float
) -> tuple[tuple[Floats, Floats], tuple[float, float]]:
    """Line parallel to the chord with the smallest largest deviation, largest sag, and pattern."""
    ends = [np.asarray(polyval(value, planes)) for value in (low, high)]
    gain = (ends[1] - ends[0]) / (high - low)
    offset = ends[0] - gain * low
    lowest, highest = np.zeros(gain.shape), np.zeros(gain.shape)
    values = np.linspace(low, high, _STEPS)
    for value in values:
        away = polyval(value, planes) - offset - gain * value
        lowest, highest = np.minimum(lowest, away), np.maximum(highest, away)
    # Half of the sag is left on either side.
    offset += (lowest + highest) / 2
    used = used & np.isfinite(gain)
    if not used.any():
        return (offset, gain), (0.0, 0.0)
    # By the values left, which have a sign: curves may be bent either way.
    pattern = max(
        np.std((polyval(value, planes) - offset - gain * value)[used]) for value in values
    )
    return (offset, gain), (float((highest - lowest)[used].max()), float(pattern))
