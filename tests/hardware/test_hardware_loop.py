"""The adaptive loop with memories of whole numbers."""

from __future__ import annotations

import numpy as np
import pytest

import hardware as docs
import reference
from equipix import errors, hardware

SHAPE = (17, 23)


def scene(count, bits, rng=1):
    rng = np.random.default_rng(rng)
    light = rng.uniform(0.2, 0.8, (count, 1, 1)) + 0.1 * rng.standard_normal((count, *SHAPE))
    y = (1 + 0.1 * rng.standard_normal(SHAPE)) * light + 0.1 * rng.standard_normal(SHAPE)
    return np.clip(np.rint(y * 2**bits), 0, 2**bits - 1).astype(np.uint16)


@pytest.mark.parametrize(
    ("widths", "step"),
    [((14, 16, 16), 2**-6), ((12, 10, 9), 2**-2), ((16, 8, 16), 0.5), ((8, 16, 8), 2**-4)],
)
def test_words_and_memories_are_those_of_the_reference(widths, step):
    adc, gain, offset = widths
    loop = hardware.AdaptiveLoop(SHAPE, adc_bits=adc, gain_bits=gain, offset_bits=offset, step=step)
    g, o = np.full(SHAPE, 2 ** (gain - 1)), np.zeros(SHAPE, int)
    for frame in scene(12, adc):
        words, g, o = reference.adapt_words(frame, g, o, widths=widths, step=step)
        assert np.array_equal(loop.update(frame, workers=2), words)
        assert np.array_equal(loop.gain, g)
        assert np.array_equal(loop.offset, o)
    assert np.any(g != 2 ** (gain - 1))
    assert np.any(o != 0)


def test_a_stack_is_its_frames_for_any_number_of_workers():
    frames = scene(10, 14)
    one, other = (hardware.AdaptiveLoop(SHAPE, step=2**-4) for _ in range(2))
    stack = one.update(frames, workers=1)
    each = [other.update(frame, workers=3) for frame in frames]
    assert np.array_equal(stack, each)
    assert np.array_equal(one.gain, other.gain)
    assert np.array_equal(one.offset, other.offset)


def test_the_memories_are_a_table():
    loop = hardware.AdaptiveLoop(SHAPE, adc_bits=12, gain_bits=14, offset_bits=11, step=2**-4)
    frames = scene(20, 12)
    loop.update(frames[:-1])
    table = loop.correction()
    assert np.array_equal(table.apply(frames[-1]), loop.update(frames[-1]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"step": 1.0}, "'step' is 1.0, .* above 1/2 the loop diverges"),
        ({"step": 0.3}, "'step' is 0.3, expected a power of two"),
        ({"step": 2**-13}, "expected 2\\^-12"),
        ({"gain_bits": 17}, "'gain_bits' is 17"),
        ({"offset_bits": 7}, "'offset_bits' is 7"),
    ],
)
def test_arguments_out_of_range_are_refused(options, words):
    with pytest.raises(errors.InputError, match=words):
        hardware.AdaptiveLoop(SHAPE, **options)
    with pytest.raises(errors.InputError, match="neighbours"):
        hardware.AdaptiveLoop((1, 9))


def test_frames_that_do_not_fit_change_nothing():
    loop = hardware.AdaptiveLoop(SHAPE, adc_bits=12)
    with pytest.raises(errors.InputError, match="holds 4096, above 4095"):
        loop.update(np.array([scene(1, 12)[0], np.full(SHAPE, 4096)], np.uint16))
    for wrong in (np.zeros(SHAPE), np.zeros((3, 3), np.uint16)):
        with pytest.raises(errors.InputError, match="expected uint8 or uint16 words|the sensor"):
            loop.update(wrong)
    assert np.all(loop.gain == 2**15)
    assert not loop.offset.any()


def test_at_the_bound_of_the_step_a_chequered_pattern_does_not_grow():
    rows, cols = np.indices((16, 16))
    sign = 1 - 2 * ((rows + cols) % 2)
    frames = np.repeat((60_000 + 3000 * sign).astype(np.uint16)[None], 200, axis=0)
    loop = hardware.AdaptiveLoop((16, 16), adc_bits=16, step=0.5)
    spread = loop.update(frames).astype(float).std(axis=(1, 2))
    assert spread[-1] < 0.1 * spread[0]
    # The law behind the bound: twice the step makes it grow, in double precision.
    floats = docs.Loop((16, 16), 1.0)
    for frame in frames[:20]:
        floats.update(frame / 2**16)
    assert (floats.gain * frames[0] / 2**16 + floats.offset).std() > 10 * spread[0] / 2**16


def test_narrow_memories_stop_converging():
    found = docs.falls([16, 14, 8], exponent=6, seed=1, moving=800)
    assert found.words[16] == pytest.approx(found.floats, rel=0.02)
    assert found.words[14] == pytest.approx(found.words[16], rel=0.02)
    assert found.words[8] < found.floats / 2
    assert found.stops_at == 8


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("exponent", [4, 6])
def test_memories_are_frozen_where_half_a_step_is_the_largest_change(exponent, seed):
    largest = docs.falls([], exponent=exponent, seed=seed, moving=200).largest
    bits = docs.lost_at(largest, exponent)
    found = docs.falls([bits, bits + 1, bits + 2], exponent=exponent, seed=seed, moving=200)
    assert found.words[bits] == 1
    # Twice the largest change of a narrower step: some offsets change.
    assert found.words[bits + 1] != 1
    assert found.words[bits + 2] > 1


def test_the_loop_of_the_study_is_the_same_below_and_above_8_bits(monkeypatch):
    words = [
        docs.digitised(frame.values)
        for frame in docs.MovingScene(seed=1, shape=docs.SCENE).frames(20)
    ]
    compiled = docs.in_words(words, 9, 2**-4)
    monkeypatch.setattr(docs, "WIDTHS", range(16, 9, -1))
    assert np.array_equal(docs.in_words(words, 9, 2**-4), compiled)
    assert np.any(compiled[1] != 0)
