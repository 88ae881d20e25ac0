"""Corrections in fixed point: every sum below 2^53 steps is exact in double precision."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def apply_words(
    words: ArrayLike,
    gain: ArrayLike,
    offset: ArrayLike,
    *,
    out_bits: int,
    exponents: tuple[int, int, int, int],
    base: int,
) -> NDArray[Any]:
    """Round gain times word plus offset to words of the output.

    Parameters
    ----------
    words : array, shape (n, rows, cols)
        Words of the ADC.
    gain, offset : array, shape (rows, cols)
        Words of the memories; a gain of 0 marks a pixel that must not be used.
    out_bits : int
        Bits of the output.
    exponents : tuple of int
        Powers of two that one step of the ADC, the offset, the gain and the output stands for.
    base : int
        Output of the sum 0.

    Returns
    -------
    ndarray, shape (n, rows, cols), int64
        Words of the output.
    """
    adc, offset_step, gain_step, out = (2.0**exponent for exponent in exponents)
    gain = np.asarray(gain, np.float64)
    value = gain * gain_step * np.asarray(words, np.float64) * adc
    value += np.asarray(offset, np.float64) * offset_step
    limited = np.clip(base + np.rint(value / out), 0, 2**out_bits - 1)
    return np.where(gain == 0, 0, limited).astype(np.int64)


def adapt_words(
    word: ArrayLike,
    gain: ArrayLike,
    offset: ArrayLike,
    *,
    widths: tuple[int, int, int],
    step: float,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Correct one frame by the adaptive loop, and change its memories.

    Parameters
    ----------
    word : array, shape (rows, cols)
        Words of the ADC.
    gain, offset : array, shape (rows, cols)
        Words of the memories.
    widths : tuple of int
        Bits of the ADC, the gain and the offset.
    step : float
        Step of the loop.

    Returns
    -------
    corrected, gain, offset : ndarray, shape (rows, cols), int64
        Words of the output, and the memories after the frame.
    """
    adc_bits, gain_bits, offset_bits = widths
    one, largest = 2 ** (gain_bits - 1), 2 ** (offset_bits - 1)
    y = np.asarray(word, np.float64) / 2**adc_bits
    g = np.asarray(gain, np.float64)
    o = np.asarray(offset, np.float64)
    x = g / one * y + o / 2**offset_bits
    around = np.pad(x, 1, mode="reflect")
    target = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]
    error = target / 4 - x
    g = np.clip(g + np.rint(step * error * y * one), 0, 2 * one - 1)
    o = np.clip(o + np.rint(step * error * 2**offset_bits), -largest, largest - 1)
    g = np.clip(g - np.rint(np.mean(g - one)), 0, 2 * one - 1)
    o = np.clip(o - np.rint(np.mean(o)), -largest, largest - 1)
    corrected = np.clip(np.rint(x * 2**adc_bits), 0, 2**adc_bits - 1)
    return corrected.astype(np.int64), g.astype(np.int64), o.astype(np.int64)
