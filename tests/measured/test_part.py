"""A part of the pixels stands for all, within its standard errors; blocks of rows change no bit."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix.measured import defects, noise, part
from equipix.measured.noise import NoiseModel, block_medians, photon_transfer, unaveraged
from equipix.measured.part import blocks, chosen, known_part, median, spread

SHAPE = (700, 900)
"""More pixels than `ENOUGH`."""


@pytest.mark.parametrize(("count", "most"), [(0, 5), (5, 5), (6, 5), (1000, 7), (12_000_000, 1000)])
def test_one_place_lies_in_each_of_as_many_equal_stretches(count, most):
    places = spread(count, most)
    assert len(places) == min(count, most)
    starts = np.arange(len(places) + 1) * count // max(1, len(places))
    assert (places >= starts[:-1]).all()
    assert (places < starts[1:]).all()


def test_all_rows_and_columns_have_their_share():
    """Steps of whole rows or columns would leave some out: 4000 columns are a multiple of 20."""
    rows, cols = np.divmod(spread(3000 * 4000, 3000 * 4000 // 20), 4000)
    for lines, count in ((rows, 3000), (cols, 4000)):
        shares = np.bincount(lines, minlength=count)
        # Places in a stretch are no worse spread than by chance: six standard deviations.
        assert abs(shares - shares.mean()).max() < 6 * np.sqrt(shares.mean())


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
def test_pixels_are_chosen_of_those_that_are_true(share):
    pixels = np.random.default_rng(1).random((40, 60)) < share
    every = np.flatnonzero(pixels)
    assert chosen(pixels).tolist() == every.tolist()
    found = chosen(pixels, 100)
    assert found.tolist() == every[spread(len(every), 100)].tolist()


def test_few_known_values_are_found_among_many_missing():
    values = np.full(SHAPE, np.nan)
    values[17, 30:40] = np.arange(10)
    assert sorted(known_part(values)) == [*range(10)]
    assert median(values) == 4.5
    assert np.isnan(median(values[:10]))


@pytest.mark.parametrize("shape", [(1, 1), (1, 300_000), (3000, 4000), (7, 3)])
def test_blocks_are_all_rows_in_order(shape):
    rows = [row for block in blocks(shape) for row in range(block.start, block.stop)]
    assert rows == [*range(shape[0])]


@pytest.mark.parametrize("shape", [(1, 1), (16, 16), (17, 40), (33, 15), (70, 90)])
@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
def test_medians_of_blocks_are_those_of_numpy(shape, dtype):
    rng = np.random.default_rng(1)
    image = rng.integers(0, 1000, shape).astype(dtype)
    if np.dtype(dtype).kind == "f":
        image[rng.random(shape) < 0.3] = np.nan
        image[:16, :16] = np.nan
    padded = np.pad(image, [(0, -size % 16) for size in shape], mode="symmetric")
    cut = padded.reshape(padded.shape[0] // 16, 16, -1, 16)
    wanted = noise.nanmedian(cut, axis=(1, 3))
    np.testing.assert_array_equal(block_medians(image), wanted)
    assert block_medians(image).dtype == wanted.dtype


def test_a_missing_value_changes_no_other_of_a_map():
    v = np.array([1e-3, 0.5, 2.0, 400.0])
    with_missing = unaveraged(np.append(v, np.nan))
    np.testing.assert_array_equal(with_missing[:-1], unaveraged(v))
    assert with_missing[2:4].tolist() == [0, 0]
    assert np.isnan(with_missing[-1])


def averages(shape, levels=(500.0, 3000.0), frames=4):
    """Averages of frames of photon noise, with a dark."""
    camera = equipix.simulate.Camera(
        sensitivity=np.full(shape, 1.0), gain_dn_per_e=0.2, read_noise_e=10
    )
    dark = equipix.average(camera.frames(np.zeros(shape), frames, rng=1))
    return [
        equipix.average(camera.frames(np.full(shape, level), frames, rng=k), dark=dark)
        for k, level in enumerate(levels, start=2)
    ]


def test_a_part_gives_the_noise_within_its_standard_error():
    """A variance of N values of f degrees of freedom errs by √(2/(N f)); six of that."""
    (bright,) = averages(SHAPE, (3000.0,))
    usable = np.ones(SHAPE, bool)

    def mean(points):
        return np.average(points[:, 1], weights=points[:, 2])

    few = mean(photon_transfer(bright.mean, bright.variance, usable, 4))
    every = bright.variance.mean()
    assert few != every
    assert abs(few / every - 1) < 6 * np.sqrt(2 / (part.ENOUGH * 3))


def test_a_part_gives_the_noise_model_and_no_other_bad_pixel(monkeypatch):
    """Against all pixels: the same flags, and coefficients within their standard errors."""
    shape = (96, 128)
    levels = averages(shape)
    whole = equipix.nuc.fit(levels)
    monkeypatch.setattr(spread, "__defaults__", (2000,))
    monkeypatch.setattr(chosen, "__defaults__", (2000,))
    monkeypatch.setattr(known_part, "__defaults__", (2000,))
    sampled = equipix.nuc.fit(levels)
    np.testing.assert_array_equal(sampled.flags, whole.flags)
    np.testing.assert_array_equal(sampled.levels, whole.levels)
    # The variances of both err by √(2/(N f)) of N pixels; of a line through two levels they are all
    # that weights change.
    ratio = sampled.variances / whole.variances
    assert abs(ratio - 1).max() < 6 * np.sqrt(2 / (2000 * 3))
    np.testing.assert_allclose(sampled.deviation, whole.deviation, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("pixels", [1, 50, 2**17])
def test_blocks_of_any_size_find_the_same_pixels(monkeypatch, pixels):
    rng = np.random.default_rng(1)
    shape, model = (40, 50), NoiseModel(2.0, 0.2)
    means = 500 + rng.standard_normal((2, *shape))
    variances = model.variance(means) * rng.chisquare(3, means.shape) / 3
    variances[:, 3, 4] = 100 * model.variance(500.0)
    means[0, 7, 8] = np.nan
    light = [defects.Light(), defects.Light(relative=1e-6)]
    monkeypatch.setattr(part, "_BLOCK", pixels)
    found = defects.noisy_pixels(means, variances, [4, 4], model, light)
    assert np.argwhere(found).tolist() == [[3, 4]]
