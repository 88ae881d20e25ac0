"""What tables of words refuse names its cause."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import equipix
from equipix import Flag, Polynomial, errors, hardware
from equipix.io.tiff import write_frames
from equipix.simulate import BolometerArray

SHAPE = (4, 5)

FRAMES = np.random.default_rng(1).integers(2000, 2009, (8, *SHAPE)).astype(float)


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
    with pytest.warns(errors.InputWarning, match="the words differ from the correction"):
        hardware.Table.of(correction(gain), gain_bits=10)
    hardware.Table.of(correction(gain, flags), gain_bits=8)


def test_words_that_cost_more_than_half_a_percent_of_the_range_are_a_finding():
    spread = correction(gains(1.0, [])[0])
    with pytest.warns(errors.InputWarning, match=r"up to 1\.56e\+03 DN, 9\.5% .*'gain_step'"):
        coarse = hardware.Table.of(spread, gain_step=1.0)
    assert [each.kind for each in coarse.findings] == ["words"]
    assert hardware.Table.of(spread).findings == ()  # warnings are errors here
    hardware.smallest_widths(spread, [FRAMES])


def test_an_adc_of_too_few_bits_for_the_sensor_is_a_finding():
    sensor = {"sensor": {"name": "a", "bit_depth": 12}}
    of_12_bits = replace(correction(np.ones(SHAPE)), metadata=sensor)
    with pytest.warns(errors.InputWarning, match=r"94% of the raw values of 12 bits .* word 255"):
        narrow = hardware.Table.of(of_12_bits, adc_bits=8)
    assert narrow.findings[0].message.endswith("take 'adc_bits' 12, or 'adc_step' 16")
    for enough in ({"adc_bits": 12}, {"adc_bits": 8, "adc_step": 16.0}, {}):
        assert hardware.Table.of(of_12_bits, **enough).findings == ()
    hardware.quality(of_12_bits, FRAMES - 1900, adc_bits=8)  # it measures the cost


def test_the_command_says_once_what_words_cost(run, tmp_path):
    correction(gains(1.0, [])[0]).save(tmp_path / "gain.npz")
    write_frames(tmp_path / "raw.tif", FRAMES.astype(np.uint16), nbytes=FRAMES.size * 2)
    command = ("hardware", tmp_path / "gain.npz", "-o", tmp_path / "t.bin", "--gain-step", 1)
    status, out, err = run(*command, "--frames", tmp_path / "raw.tif", "--json")
    assert status == 0
    assert err.count("\n") == 1
    assert err.startswith("equipix: warning: the words differ")
    assert "--gain-step" in err
    assert [each["kind"] for each in json.loads(out)["findings"]] == ["words"]
    assert equipix.load(tmp_path / "t.bin").findings[0].kind == "words"


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
