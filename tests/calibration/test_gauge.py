"""The gauge of a result: usable pixels have mean 1, and what is predicted stays as it is."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import simulate

SHAPE = (48, 64)
CROSS = equipix.cross_pattern(5, 7).astype(float)
NOISE = 1e-3


def calibrated(response, shifts, share=0.05):
    """Exposures of a sensor of which a share of the pixels has another response."""
    rng = np.random.default_rng(5)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    truth.flat[rng.choice(truth.size, int(share * truth.size), replace=False)] = response
    frames = simulate.exposures(truth, simulate.wavy_beam(SHAPE, rng=rng), shifts)
    frames += NOISE * rng.standard_normal(frames.shape)
    variance = np.full(len(shifts), NOISE**2)
    return frames, equipix.calibrate(frames, shifts, variance=variance, uncertainty=True)


@pytest.mark.long
@pytest.mark.parametrize("response", [0.0, 0.01, 3.0])
@pytest.mark.parametrize("fraction", [0.0, 0.3])
def test_the_mean_over_usable_pixels_is_1(response, fraction):
    shifts = CROSS + fraction * np.arange(5)[:, None]
    frames, cal = calibrated(response, shifts)
    usable = (cal.flags & equipix.Flag.DO_NOT_USE) == 0
    assert 0.9 * usable.size < usable.sum() < 0.96 * usable.size
    # A mean of float64 values.
    assert cal.sensitivity[usable].mean() == pytest.approx(1, abs=1e-12)
    # M and L change together: what they predict is what was measured.
    for frame, shift in zip(frames, cal.shifts, strict=True):
        left = (frame - cal.predict(shift))[usable]
        assert np.sqrt(np.mean(left**2)) < 1.1 * NOISE
    # Of 5 measurements of light near 1.
    assert np.nanmedian(cal.sensitivity_std[usable]) == pytest.approx(NOISE * 1.2 / 5**0.5, rel=0.2)


def test_without_flags_the_gauge_is_that_of_the_fit():
    _, cal = calibrated(1.0, CROSS)
    assert not cal.flags.any()
    # The arrays of the fit, which are not copied.
    assert np.shares_memory(cal.sensitivity, cal.weighted.fit.sensitivity)
