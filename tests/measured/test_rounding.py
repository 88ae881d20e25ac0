"""Noise of rounded values: its formulas, the noise model of rounded frames, no false flags."""

from math import erf

import numpy as np
import pytest

import equipix
from equipix import nuc
from equipix.measured.defects import hot_pixels
from equipix.measured.means import Averaged, variance_of_dark_alone
from equipix.measured.noise import (
    largest_scatter,
    photon_transfer,
    scatter,
    scatter_slope,
    step_of,
    unaveraged,
    unaveraged_apart,
    unaveraged_at,
)
from equipix.measured.saturation import clipping_of

SIGMAS = (0.01, 0.05, 0.1, 0.141, 0.142, 0.2, 0.3, 0.5, 1.0, 3.0)
PHASES = (np.arange(1000) + 0.5) / 1000


def of_phase(sigma, phase):
    """Bias and variance of a rounded normal value by the probabilities of whole numbers."""
    whole = np.arange(-40, 41)
    below = np.array([erf(x) for x in (whole - 0.5 - phase) / (sigma * np.sqrt(2))]) / 2
    above = np.array([erf(x) for x in (whole + 0.5 - phase) / (sigma * np.sqrt(2))]) / 2
    share = above - below
    mean = share @ whole
    return mean - phase, share @ (whole - mean) ** 2


@pytest.mark.parametrize("sigma", SIGMAS)
def test_formulas_are_those_of_probabilities(sigma):
    bias, variance = np.transpose([of_phase(sigma, phase) for phase in PHASES])
    v = sigma**2
    # What Poisson's formula leaves out below v = 0.02 is 2e-8, and the largest series term 1e-11.
    assert unaveraged(v) == pytest.approx(np.mean(bias**2), abs=3e-8)
    assert scatter(v) == pytest.approx(variance.mean(), abs=3e-8)
    assert largest_scatter(v) == pytest.approx(of_phase(sigma, 0.5)[1], abs=1e-9)
    assert largest_scatter(v) > variance.max() - 1e-12
    h = 1e-4 * v
    slope = (scatter(v + h) - scatter(v - h)) / (2 * h)
    assert scatter_slope(v) == pytest.approx(slope, rel=1e-4)


def test_without_noise_all_of_the_rounding_stays():
    assert unaveraged(0.0) == 1 / 12
    assert scatter(0.0) == 0
    assert largest_scatter(0.0) == 0.25
    np.testing.assert_array_equal(unaveraged(np.array([2.0, 1e9])), 0)


@pytest.mark.parametrize(
    ("values", "step"),
    [
        (np.arange(100), 1),
        (16 * np.arange(100), 16),
        (np.arange(100) + 0.5, 0),
        (np.array([5.0, 7.0]), 1),
        (np.full(50, 96.0), 1),
        (np.full(3, np.nan), 0),
        (np.append(64.0 * np.arange(20), np.nan), 64),
        (1e30 * np.arange(1, 10), 0),
    ],
)
def test_the_step_is_found(values, step):
    assert step_of(np.asarray(values, np.float64)) == step


@pytest.mark.parametrize("suffix", ["npz", "tif"])
def test_averages_keep_the_step(tmp_path, suffix):
    rng = np.random.default_rng(1)
    frames = (16 * rng.integers(0, 255, (4, 20, 30))).astype(np.uint16)
    average = equipix.average(frames, dark=equipix.average(frames[:2]))
    assert (average.step, average.dark.step) == (16, 16)
    average.save(tmp_path / f"a.{suffix}")
    loaded = equipix.load(tmp_path / f"a.{suffix}")
    assert (loaded.step, loaded.dark.step) == (16, 16)
    assert equipix.average(0.3 * frames).step == 0


def rounded(rng, signal, sigma, frames, step=1):
    values = signal + sigma * rng.standard_normal((frames, *signal.shape))
    return (step * np.rint(values / step)).astype(np.uint16)


def even(rng, shape=(96, 96)):
    """Light of one level on pixels whose offsets spread over many steps."""
    return rng.normal(1000, 30, shape)


@pytest.mark.parametrize("step", [1, 16])
@pytest.mark.parametrize("frames", [2, 8, 64])
@pytest.mark.parametrize("sigma", [0.05, 0.2])
def test_a_good_array_has_no_noisy_pixel(sigma, frames, step):
    rng = np.random.default_rng(frames)
    signal = even(rng)
    levels = [
        equipix.average(rounded(rng, step * f * signal, step * sigma, frames, step))
        for f in (1, 1.618, 2.236, 2.8)
    ]
    response = nuc.fit(levels, order=1)
    found = nuc.find_defects(response, rounded(rng, step * signal, step * sigma, frames, step))
    assert found.counts["noisy"] == found.counts.get("flickering", 0) == 0
    assert nuc.find_defects(response, levels[0]).counts["noisy"] == 0
    averaged = Averaged.of(levels)
    assert not averaged.bad_pixels(averaged.noise).noisy.any()


@pytest.mark.parametrize("sigma", [0.0, 0.05, 0.15])
@pytest.mark.parametrize("frames", [2, 32])
def test_darks_with_less_noise_than_a_step_have_no_hot_pixel(sigma, frames):
    rng = np.random.default_rng(7)
    dark = equipix.average(rounded(rng, rng.normal(5, 0.7, (96, 96)), sigma, frames))
    light = rounded(rng, even(rng), max(sigma, 0.05), frames)
    averaged = Averaged.of([equipix.average(light, dark=dark)])
    assert not hot_pixels(dark, averaged.noise).any()


def test_bins_do_not_follow_the_scatter_of_a_pixel():
    """Two frames with a whole mean are equal: by their own means bins would scatter by 0 or 1/2."""
    rng = np.random.default_rng(2)
    frames = equipix.average(rounded(rng, even(rng, (128, 128)), 0.2, 2))
    points = photon_transfer(frames.mean, frames.variance, np.ones((128, 128), bool), 2, 1.0)
    # 256 pixels a bin, of which 0.226 differ by 1 and have the variance 1/2.
    error = np.sqrt(0.226 * 0.774 / 256) / 2
    assert abs(points[:, 1] - scatter(0.04)).max() < 5 * error


@pytest.mark.parametrize("sigma", [0.05, 0.2, 1.0, 10.0])
@pytest.mark.parametrize("frames", [2, 16])
def test_the_mean_of_frames_is_off_by_the_variance_of_the_model(sigma, frames):
    rng = np.random.default_rng(3)
    signal = even(rng, (128, 128))
    average = equipix.average(rounded(rng, signal, sigma, frames))
    noise = Averaged.of([average]).noise.of_mean(frames)
    error = float(np.mean((average.mean - signal) ** 2))
    # The square of an error scatters by at most √2 of its mean, over 16 384 pixels; so does s².
    assert float(noise.variance(1000.0)) == pytest.approx(error, rel=5 * 2 * np.sqrt(1 / 2**13))


@pytest.mark.parametrize("sigma", [0.0, 0.05, 0.2, 0.5, 1.5, 10.0])
@pytest.mark.parametrize("frames", [2, 3, 64])
def test_the_mean_of_dark_frames_is_off_by_what_they_show_alone(sigma, frames):
    rng = np.random.default_rng(4)
    signal = even(rng, (128, 128))
    dark = equipix.average(rounded(rng, signal, sigma, frames))
    error = float(np.mean((dark.mean - signal) ** 2))
    assert variance_of_dark_alone(dark) == pytest.approx(error, rel=5 * 2 * np.sqrt(1 / 2**13))


@pytest.mark.parametrize("frames", [1, 2, 16])
def test_equal_dark_frames_that_are_not_rounded_show_no_noise(frames):
    dark = np.full((frames, 20, 30), 100.25)
    assert variance_of_dark_alone(equipix.average(dark)) == 0
    dark[0, 3, 4] = 101.7  # most are 0 apart, one is not
    assert variance_of_dark_alone(equipix.average(dark)) < 1e-3


@pytest.mark.parametrize("frames", [3, 4, 8])
def test_an_offset_that_dark_frames_have_in_common_is_no_noise(frames):
    rng = np.random.default_rng(frames)
    offset = 5 * rng.standard_normal((frames, 1, 1))
    pattern = rng.normal(200, 30, (128, 128))
    dark = equipix.average(np.rint(pattern + offset + 2 * rng.standard_normal((frames, 128, 128))))
    # s² over 16 384 pixels with two degrees of freedom or more, and 1/12 of rounding.
    wanted = (4 + 1 / 12) / frames
    assert variance_of_dark_alone(dark) == pytest.approx(wanted, rel=5 * np.sqrt(1 / 2**14))
    alone = equipix.average(100.25 + offset + np.zeros((1, 20, 30)))
    assert variance_of_dark_alone(alone) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("sigma", [0.05, 0.2])
@pytest.mark.parametrize("spread", [0.05, 0.2, 0.6])
def test_what_pixels_less_than_a_step_apart_have_in_common(sigma, spread):
    phase = np.linspace(-4, 4, 4001)
    bias = np.array([of_phase(sigma, each)[0] for each in phase % 1])
    rng = np.random.default_rng(4)
    own = []
    for _ in range(400):
        light = (rng.random() + spread * rng.standard_normal(400)) % 1
        own.append(np.interp(light, phase, bias).var())
    apart = float(unaveraged(sigma**2) - unaveraged(sigma**2 + spread**2))
    assert np.mean(own) == pytest.approx(apart, abs=5 * np.std(own) / np.sqrt(400))
    # The grid of spreads is a thousandth of a step wide.
    found = unaveraged_apart(sigma**2, spread**2 + apart + 0.01, 0.01)
    assert found == pytest.approx(max(apart, 0.1 * unaveraged(sigma**2)), rel=1e-3)


@pytest.mark.parametrize("place", [3.5, 3.736, 3.2])
@pytest.mark.parametrize("sigma", [0.05, 0.13, 0.3])
def test_the_part_that_pixels_have_apart_follows_their_place_in_a_step(sigma, place):
    """Light spread by 0.2 steps about one place: at 3.736 the mean over places is too large."""
    light = place + 0.2 * np.random.default_rng(3).standard_normal(2000)
    bias = np.array([of_phase(sigma, each % 1)[0] for each in light])
    found = unaveraged_at(sigma**2, float(np.mean(light + bias)), float(np.var(light + bias)))
    # Four standard errors of the variance of 2000 pixels, by its fourth moment.
    error = np.std((bias - bias.mean()) ** 2) / np.sqrt(len(bias))
    assert found == pytest.approx(np.var(bias), abs=4 * error)


def test_means_at_whole_numbers_are_no_saturation():
    """Without noise many pixels share the highest whole number, as they do each other one."""
    rng = np.random.default_rng(5)
    frames = equipix.average(rounded(rng, rng.normal(27, 1, (64, 80)), 0.05, 100), saturation=255)
    assert clipping_of(frames) is None
