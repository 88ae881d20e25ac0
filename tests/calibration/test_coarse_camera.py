"""Calibrations of cameras that round coarsely, with few dark frames, or that saturate."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import equipix
from equipix import Flag, simulate
from equipix.errors import EquipixWarning

SHAPE = (96, 120)


def calibrated(*, binning=1, **camera):
    """Calibrate simulated frames; give what was found, and z of the pixels that are usable."""
    truth = simulate.paper_sensitivity(SHAPE, rng=1)
    cross = equipix.cross_pattern(11, 19)
    virtual = simulate.experiment(truth, simulate.gaussian_beam(SHAPE), cross, rng=101, **camera)
    dark = equipix.average(virtual.dark())
    frames = [equipix.average(virtual.frames(k), dark=dark) for k in range(len(cross))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        cal = equipix.calibrate(frames, binning * virtual.positions, uncertainty=True)
    good = (cal.flags & Flag.DO_NOT_USE == 0) & np.isfinite(cal.sensitivity)
    error = cal.sensitivity / cal.sensitivity[good].mean() - truth / truth[good].mean()
    return cal, error[good] / cal.sensitivity_std[good]


@pytest.mark.long
@pytest.mark.parametrize(("gain", "frames", "bits"), [(0.0025, 100, 12), (0.0025, 20, 8)])
def test_rounding_that_all_exposures_share_is_no_misfit(gain, frames, bits):
    """M follows it: reduced chi-square is 0.53 and 0.84, and error bars are right or too large."""
    cal, z = calibrated(gain_dn_per_e=gain, frames=frames, bit_depth=bits)
    assert cal.findings == ()
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.03


@pytest.mark.long
@pytest.mark.parametrize("frames", [20, 300])
def test_one_dark_frame_makes_error_bars_too_large_and_not_too_small(frames):
    """Its noise was that of a line through bright light, up to five times too large, or none."""
    cal, z = calibrated(frames=frames, dark_frames=1)
    assert cal.findings == ()
    # The dark's own pattern, of 2 to 3 DN beside a read noise of 2 DN, counts as noise.
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1


@pytest.mark.parametrize("dark_frames", [1, 4])
def test_single_frames_have_the_noise_of_their_dark(dark_frames):
    """Without it they deviated by 1.42 and 1.12 standard deviations."""
    z = _single_frames(dark_frames, pattern=0.0)
    assert abs(z.std() - 1) < 5 / np.sqrt(2 * z.size)


@pytest.mark.parametrize("pattern", [60.0, 1000.0])
def test_the_pattern_of_one_dark_frame_counts_as_noise_of_a_frame_at_most(pattern):
    """Of 1000 DN it was more noise than residuals have."""
    # Photon and read noise of a light frame are 4 times the read noise, which the dark has.
    assert np.sqrt((1 / 5 + 1 / 4) / (1 / 5 + 1)) < _single_frames(1, pattern).std() < 1


def test_a_variance_that_is_given_for_the_dark_of_arrays_stays():
    """They may be means of many frames less a dark of one."""
    rng = np.random.default_rng(1)
    cross = equipix.cross_pattern(5, 7)
    frames = simulate.exposures(np.ones(SHAPE), simulate.gaussian_beam(SHAPE), cross)
    frames += 1e-3 * rng.standard_normal(frames.shape)
    cal = equipix.calibrate(frames, cross, dark_variance=1e-5)
    assert cal.reduced_chi2 < 1e-5
    assert np.all(cal.weighted.exposures.dark_variance == 1e-5)


def _single_frames(dark_frames, pattern):
    """Errors of M over their standard deviations, of one frame at each position."""
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    cross = equipix.cross_pattern(5, 7)
    light = 8000 * simulate.exposures(truth, simulate.gaussian_beam(SHAPE), cross)
    offset = 5000 + pattern * rng.standard_normal(SHAPE)

    def taken(light, count):
        noise = rng.poisson(light, (count, *SHAPE)) + 60 * rng.standard_normal((count, *SHAPE))
        return np.rint(offset + noise).astype(np.uint16)

    dark = equipix.average(taken(np.zeros(SHAPE), dark_frames))
    frames = [equipix.average(taken(each, 1), dark=dark) for each in light]
    cal = equipix.calibrate(frames, cross, uncertainty=True)
    return (cal.sensitivity - truth / truth.mean()) / cal.sensitivity_std


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_dark_that_is_finer_than_its_rounding_shows_no_pattern(seed):
    """Read noise of 0.02 DN in a dark of 10 DN with a pattern of 0.3 DN: it is 9, 10 or 11 DN."""
    rng = np.random.default_rng(seed)
    truth = simulate.cosine_sensitivity(SHAPE, rng=seed)
    cross = equipix.cross_pattern(5, 7)
    electrons = 20_000 * simulate.exposures(
        truth, simulate.wavy_beam(SHAPE, contrast=0.2, rng=seed), cross
    )
    offset = 10 + 0.3 * rng.standard_normal(SHAPE)
    offset[50, 60] += 60

    def stack(light):
        shot = rng.poisson(light, (50, *SHAPE)) + 10 * rng.standard_normal((50, *SHAPE))
        return np.rint(offset + 0.002 * shot).astype(np.uint8)

    dark = equipix.average(stack(np.zeros(SHAPE)))
    frames = [equipix.average(stack(light), dark=dark) for light in electrons]
    assert equipix.calibrate(frames, cross).findings == ()


@pytest.mark.long
def test_clipped_values_do_not_say_that_variances_are_too_large():
    cal, _ = calibrated(exposure_e=19500)
    assert "saturation" in {finding.kind for finding in cal.findings}
    assert not any("variances are too large" in finding.message for finding in cal.findings)


@pytest.mark.long
def test_shifts_of_binned_pixels_are_no_matter_of_noise():
    cal, _ = calibrated(binning=2, frames=4)
    assert not any("variances are too small" in finding.message for finding in cal.findings)


def test_an_estimate_below_the_tolerance_is_not_said_to_be_above_it():
    """Ten iterations make an estimate; three sweeps leave the error at a twentieth."""
    shifts = equipix.cross_pattern(5, 7)
    truth = simulate.paper_sensitivity(SHAPE, rng=1)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE), shifts)
    with pytest.warns(equipix.errors.ConvergenceWarning, match="too few to estimate .*: allow mor"):
        cal = equipix.calibrate(frames, shifts, tolerance=0.3, max_sweeps=3)
    assert cal.error_estimate < 0.3
    assert not cal.converged


def test_light_below_zero_is_refused():
    beam = simulate.wavy_beam(SHAPE, contrast=0.5, rng=5)
    virtual = simulate.experiment(np.ones(SHAPE), beam, [(0, 0)] * 3, rng=1, frames=2)
    with pytest.raises(equipix.errors.InputError, match="expected 0 or more"):
        next(virtual.frames(0))
