"""Shifts that a smooth beam does not refine: findings count their stated errors."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.errors import EquipixWarning
from equipix.fitting.residuals import sampled
from equipix.fitting.stated_errors import flux_variance, unrefined

SENSOR, CROSS = (64, 96), equipix.cross_pattern(11, 19).astype(float)
NOISE = 1e-3
BEAMS = {
    "off centre": (simulate.gaussian_beam(SENSOR, width=150, centre=(62, 48)), 0.02),
    "gradient": (simulate.tilted_beam(SENSOR, slope=(0.2, 0.0)), 0.05),
}
"""A beam, and the standard deviation of the shifts in it."""


def calibrated(name, seed, *, times=1.0, drift=0.0, **options):
    """A calibration whose shifts are wrong by so many of the standard deviations given."""
    rng = np.random.default_rng([1, seed])
    beam, std = BEAMS[name]
    true = CROSS + times * std * rng.standard_normal(CROSS.shape)
    flux = np.exp(drift * rng.standard_normal(5))
    truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
    frames = simulate.exposures(truth, beam, true, flux=flux)
    frames += NOISE * rng.standard_normal(frames.shape)
    options = {"variance": np.full(5, NOISE**2), "shift_std": std, "tolerance": 1e-5} | options
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        return equipix.calibrate(frames, CROSS, **options)


def kinds(cal):
    return [finding.kind for finding in cal.findings]


@pytest.mark.parametrize("name", BEAMS)
def test_a_steady_lamp_with_honest_shifts_has_no_drift(name):
    """Without the variance of the shifts 8 of 10 and 5 of 6 were findings on the lamp."""
    for seed in range(6):
        cal = calibrated(name, seed)
        assert cal.metadata["options"]["shifts"] == "undetermined"
        assert kinds(cal) == []


@pytest.mark.parametrize("name", BEAMS)
def test_a_drift_beyond_the_shifts_is_found(name):
    for seed in range(6):
        assert "drift" in kinds(calibrated(name, seed, drift=3e-3))


def test_shifts_ten_times_as_wrong_as_stated_are_noticed():
    for seed in range(4):
        assert kinds(calibrated("off centre", seed, times=10))


@pytest.mark.long
@pytest.mark.parametrize("name", BEAMS)
def test_a_prior_on_fluxes_is_not_contradicted_by_shifts(name):
    for seed in range(6):
        assert kinds(calibrated(name, seed, flux=np.ones(5), flux_std=1e-5)) == []


def test_the_variance_of_a_flux_is_that_of_the_slope():
    """In exp(s·u) the mean slope of ln L is s, whatever the weights."""
    slope = np.array([2e-3, -1e-3])
    frames = simulate.exposures(
        np.ones(SENSOR), lambda rows, cols: np.exp(slope[0] * rows + slope[1] * cols), CROSS
    )
    frames += NOISE * np.random.default_rng(1).standard_normal(frames.shape)
    std = np.array([(0, 0), (0.02, 0.01), (0.01, 0.03), (0.02, 0.0), (0.05, 0.05)])
    for turn in (0, 90):
        shown = np.ascontiguousarray(np.rot90(frames, turn // 90, axes=(1, 2)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EquipixWarning)
            cal = equipix.calibrate(shown, CROSS, shift_std=std, rotation=np.full(5, turn))
        residuals = sampled(cal.weighted)
        # Slopes are differences of light over two pixels, but at the edge, to (s²/6 + s/2·edge).
        np.testing.assert_allclose(
            flux_variance(cal.weighted, residuals), (std**2) @ slope**2, rtol=1e-2
        )
        assert unrefined(cal.weighted, residuals).std.shape == (2, 5)


@pytest.mark.long
def test_shifts_that_were_refined_or_exact_add_nothing():
    rng = np.random.default_rng(2)
    beam = simulate.wavy_beam(SENSOR, rng=3)
    frames = simulate.exposures(np.ones(SENSOR), beam, CROSS)
    frames += NOISE * rng.standard_normal(frames.shape)
    for options in ({}, {"shift_std": 0.02}):
        cal = equipix.calibrate(frames, CROSS, **options)
        assert unrefined(cal.weighted, sampled(cal.weighted)) is None


@pytest.mark.long
def test_along_fringes_only_the_other_direction_is_left():
    def fringes(rows, cols):
        return np.exp(1e-3 * rows) * (1 + 0.1 * np.cos(2 * np.pi * cols / 30)) + 0 * rows

    rng = np.random.default_rng(4)
    given = CROSS + 0.02 * rng.standard_normal(CROSS.shape)
    frames = simulate.exposures(np.ones(SENSOR), fringes, CROSS)
    frames += NOISE * rng.standard_normal(frames.shape)
    cal = equipix.calibrate(frames, given, shift_std=0.02)
    residuals = sampled(cal.weighted)
    assert unrefined(cal.weighted, residuals).std == pytest.approx(np.full((1, 5), 0.02), rel=1e-2)
    # What is left of the columns is turned by less than 1e-2 of the fringes' slope of 0.02.
    found = flux_variance(cal.weighted, residuals)
    np.testing.assert_allclose(np.sqrt(found), 0.02 * 1e-3, rtol=0.1)
