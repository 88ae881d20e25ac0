"""Pixels whose values are not proportional to light spoil no others, however many they are."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import Flag, simulate

SHAPE, CROSS = (48, 64), equipix.cross_pattern(5, 7)


def frames_of(rng, bad, values):
    """Exposures of 1000 DN with noise of 1 DN, but for some pixels; and the true sensitivity."""
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    beam = simulate.gaussian_beam(SHAPE, width=60, amplitude=1000)
    frames = simulate.exposures(truth, beam, CROSS)
    frames += rng.standard_normal(frames.shape)
    frames[:, bad] = values(frames[:, bad])
    return frames, truth


def some(rng, count):
    bad = np.zeros(SHAPE, bool)
    bad.flat[rng.choice(bad.size, count, replace=False)] = True
    return bad


def rms(sensitivity, truth, good):
    ratio = sensitivity[good] / truth[good]
    return np.std(ratio / ratio.mean())


@pytest.mark.parametrize("count", [1, 5, 20])
def test_pixels_stuck_far_above_the_signal_are_left_out(count):
    rng = np.random.default_rng(count)
    bad = some(rng, count)
    frames, truth = frames_of(rng, bad, lambda x: 65_000 + rng.standard_normal(x.shape))
    cal = equipix.calibrate(frames, CROSS, variance=np.ones(5))
    wanted = equipix.calibrate(frames, CROSS, variance=np.ones(5), mask=bad)
    np.testing.assert_array_equal((cal.flags & Flag.HOT) > 0, bad)
    assert np.isnan(cal.sensitivity[bad]).all()
    assert rms(cal.sensitivity, truth, ~bad) == pytest.approx(
        rms(wanted.sensitivity, truth, ~bad), rel=1e-3
    )
    assert [each.kind for each in cal.findings] == []


def test_dead_pixels_without_noise_are_no_measurements():
    rng = np.random.default_rng(1)
    bad = some(rng, SHAPE[0] * SHAPE[1] // 20)
    frames, _ = frames_of(rng, bad, np.zeros_like)
    cal = equipix.calibrate(frames, CROSS, variance=np.ones(5))
    wanted = equipix.calibrate(frames, CROSS, variance=np.ones(5), mask=bad)
    np.testing.assert_array_equal((cal.flags & Flag.DEAD) > 0, bad)
    assert cal.reduced_chi2 == pytest.approx(wanted.reduced_chi2, rel=1e-5)
    assert [each.kind for each in cal.findings] == []


def test_pixels_of_unusual_but_proportional_response_stay():
    rng = np.random.default_rng(2)
    bad = some(rng, 20)
    factor = np.resize([0.3, 2.5, 10.0], 20)
    frames, truth = frames_of(rng, bad, lambda x: x * factor)
    cal = equipix.calibrate(frames, CROSS, variance=np.ones(5))
    assert ((cal.flags & Flag.DO_NOT_USE) > 0)[bad].all()
    ratio = cal.sensitivity / np.where(bad, np.nan, truth)
    found = cal.sensitivity[bad] / truth[bad] / np.nanmean(ratio)
    # Noise of 1 DN at 300 to 2500 DN in five exposures, and six standard deviations of it.
    np.testing.assert_allclose(found, factor, rtol=6 * 1 / 150 / 5**0.5)
