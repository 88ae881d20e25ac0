"""What tables of words refuse names its cause."""

from __future__ import annotations

import numpy as np
import pytest

from equipix import Flag, Polynomial, errors, hardware
from equipix.simulate import BolometerArray

SHAPE = (4, 5)


def correction(gain, flags=None):
    planes = np.stack([np.zeros(SHAPE), gain])
    return Polynomial(planes, np.zeros(SHAPE, np.uint32) if flags is None else flags)


def gains(value, places):
    gain = 1 + 0.01 * np.arange(20.0).reshape(SHAPE)
    flags = np.zeros(SHAPE, np.uint32)
    for place in places:
        gain[place] = value
        flags[place] = Flag.DEAD | Flag.DO_NOT_USE
    return gain, flags


@pytest.mark.parametrize(
    ("value", "places", "words"),
    [
        (1e6, [(2, 3)], r"\(2, 3\)$"),
        (1e-7, [(1, 4)], r"\(1, 4\)$"),
        (1e6, [(0, k) for k in range(5)], r"\(0, 0\), \(0, 1\), \(0, 2\) and 2 more$"),
    ],
)
def test_the_pixels_whose_gain_is_far_from_others_are_named(value, places, words):
    gain, flags = gains(value, places)
    message = rf"'gain_bits' is 16: no gain_step holds .* Flag DO_NOT_USE the pixels .*: {words}"
    with pytest.raises(errors.InputError, match=message):
        hardware.Table.of(correction(gain))
    hardware.Table.of(correction(gain, flags))


def test_more_bits_are_named_where_they_hold_all_gains():
    gain, flags = gains(700.0, [(2, 3)])
    # With a step of 2 the gain of 1 would be the word 0, and with a step of 1 700 takes 10 bits.
    with pytest.raises(errors.InputError, match=r"\(2, 3\); or take 10 gain_bits"):
        hardware.Table.of(correction(gain), gain_bits=8)
    hardware.Table.of(correction(gain), gain_bits=10)
    hardware.Table.of(correction(gain, flags), gain_bits=8)


@pytest.mark.parametrize("low", [5000, -20])
def test_frames_beyond_the_adc_are_named(low):
    frames = np.random.default_rng(1).integers(low, low + 9, (8, *SHAPE)).astype(float)
    with pytest.raises(errors.InputError, match="beyond an ADC of 'adc_bits' 12 and 'adc_step' 1"):
        hardware.quality(correction(np.ones(SHAPE)), frames, adc_bits=12)
    inside = np.random.default_rng(1).integers(2000, 2009, (8, *SHAPE)).astype(float)
    assert hardware.quality(correction(np.ones(SHAPE)), inside, adc_bits=12).at_ends == 0


def test_an_attribute_that_no_array_has_is_named():
    array = BolometerArray.of((8, 8), rng=1)
    with pytest.raises(errors.InputError, match="'nosuch' is no attribute of a BolometerArray: "):
        array.with_properties(nosuch=-1)
