"""What becomes of a signal: words of the ADC, and the corrected words."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix import _native
from equipix.errors import InputError

if TYPE_CHECKING:
    from equipix._types import Array, Bools
    from equipix.hardware.words import Format


class Applied(NamedTuple):
    """Corrected words, and how many outputs were limited to 0 and to the largest word."""

    words: Array
    below: int
    above: int


def digitised(raw: Array, coarse: Array, used: Bools, f: Format) -> Array:
    """Words of the ADC behind the subtracting amplifier, as `Table.digitise` describes them."""
    pedestal = np.ldexp(coarse.astype(np.float64), f.coarse)
    words = np.empty(raw.shape, np.uint16)
    for source, target in zip(_each(raw), _each(words), strict=True):
        lost = int(np.count_nonzero(~np.isfinite(source) & used))
        if lost:
            raise InputError(f"'frames' holds {lost} usable pixels that are not finite")
        steps = np.rint(np.ldexp(np.where(used, source, 0) - pedestal, -f.adc))
        target[...] = np.clip(steps, 0, f.largest_word)
    return words


def applied(raw: Array, gain: Array, offset: Array, f: Format, workers: int | None) -> Applied:
    """Correct words of the ADC, and count the outputs that were limited."""
    if raw.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"'frames' is {raw.dtype}, expected uint8 or uint16 words of the ADC: "
            "table.digitise(frames) makes them of raw values"
        )
    words = np.ascontiguousarray(raw, np.uint16)
    out = np.empty(words.shape, np.uint16)
    stack = (-1, *gain.shape)
    below, above = _native.apply_words(
        words.reshape(stack),
        np.ascontiguousarray(gain),
        np.ascontiguousarray(offset),
        out.reshape(stack),
        f.arithmetic,
        workers=workers,
    )
    return Applied(out, below, above)


def _each(stack: Array) -> Array:
    return stack[None] if stack.ndim == 2 else stack
