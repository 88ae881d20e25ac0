"""What was given and the data contradict: priors, variances; false pixels, and dust that stays."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import equipix
from equipix import Flag, metrics, simulate
from equipix.errors import EquipixWarning, MisfitWarning
from equipix.fitting.stated_errors import sampled_frames

SENSOR, CROSS = (64, 96), equipix.cross_pattern(11, 19)
NOISE = 1e-3
TEN = np.array(
    [(0, 0), (3, 9), (11, 2), (-7, 8), (5, -9), (-3, -8), (9, 11), (-10, 1), (1, 5), (7, -4)]
)


def calibrated(frames, shifts, **options):
    """Calibration and the kinds of its findings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        cal = equipix.calibrate(frames, shifts, **{"tolerance": 1e-4} | options)
    return cal, [finding.kind for finding in cal.findings]


def noisy(frames, rng, noise=NOISE):
    return frames + noise * rng.standard_normal(frames.shape)


class TestFluxPriors:
    @staticmethod
    def experiment(seed, true):
        rng = np.random.default_rng([1, seed])
        flux = np.exp(true * rng.standard_normal(len(TEN)))
        truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
        beam = simulate.gaussian_beam(SENSOR, width=150)
        frames = noisy(simulate.exposures(truth, beam, TEN, flux=flux), rng)
        cal, kinds = calibrated(
            frames, TEN, flux=np.ones(10), flux_std=1e-3, variance=np.full(10, 1e-6)
        )
        return cal, kinds, truth

    def test_ten_times_too_small_is_noticed_and_widened(self):
        z = []
        for seed in range(6):
            cal, kinds, truth = self.experiment(seed, 1e-2)
            assert "prior" in kinds
            valid = np.ones(SENSOR, bool)
            std = cal.std_of(equipix.metrics.maps.tilt_weights(valid))
            z.append((cal.tilt - equipix.metrics.maps.tilt(truth, valid)) / std)
        # 12 values of Student's t with 7 degrees of freedom: 4.8 in one of 1000 such sets.
        assert np.abs(z).max() < 4.8

    @pytest.mark.long
    def test_right_ones_are_left(self):
        for seed in range(6):
            assert self.experiment(seed, 1e-3)[1] == []


class TestShiftPriors:
    @pytest.mark.parametrize(("true", "said"), [(0.1, ["prior"]), (0.01, [])])
    def test_ten_times_too_small_is_noticed(self, true, said):
        for seed in range(2):
            rng = np.random.default_rng([2, seed])
            truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
            moved = CROSS + true * rng.standard_normal(CROSS.shape)
            frames = simulate.exposures(truth, simulate.wavy_beam(SENSOR, rng=seed), moved)
            _, kinds = calibrated(
                noisy(frames, rng), CROSS, shift_std=0.01, variance=np.full(5, 1e-6)
            )
            assert kinds == said


class TestSampleVariances:
    @staticmethod
    def experiment(seed, count):
        rng = np.random.default_rng([3, seed])
        truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
        means = 1e4 * simulate.exposures(truth, simulate.gaussian_beam(SENSOR, width=60), CROSS)
        raw = means + np.sqrt(means) * rng.standard_normal((count, *means.shape))
        return raw.mean(axis=0), raw.var(axis=0, ddof=1) / count, means / count, truth

    @pytest.mark.parametrize("count", [3, 4, 8])
    def test_are_recognised_and_smoothed(self, count):
        frames, variance, expected, truth = self.experiment(count, count)
        # The mean of x² over 30 000 pairs scatters by 0.9 % of itself.
        assert sampled_frames(variance) == pytest.approx(count, rel=0.05)
        with pytest.warns(MisfitWarning, match=f"like sample variances of {count}"):
            cal = equipix.calibrate(frames, CROSS, variance=variance, uncertainty=True)
        known = equipix.calibrate(frames, CROSS, variance=expected)
        error, best = (
            metrics.relative_error(each.sensitivity, truth).std() for each in (cal, known)
        )
        # Weights off by 1 % or so lose less than 1e-3 of the exactness.
        assert error < 1.01 * best
        assert cal.reduced_chi2 == pytest.approx(1, abs=0.05)

    def test_smooth_variances_and_those_of_the_pixels_are_kept(self):
        _, _, expected, _ = self.experiment(1, 4)
        assert sampled_frames(expected) is None
        own = np.random.default_rng(4).chisquare(4, SENSOR) * np.ones((5, 1, 1))
        assert sampled_frames(own) is None
        assert sampled_frames(np.ones(5)) is sampled_frames(None) is None


class TestFalsePixels:
    @staticmethod
    def experiment(seed, share):
        rng = np.random.default_rng([5, seed])
        truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
        frames = noisy(simulate.exposures(truth, simulate.wavy_beam(SENSOR, rng=seed), CROSS), rng)
        stuck = rng.random(SENSOR) < share
        stuck[30, 40] = True
        frames[:, stuck] = rng.choice([0.1, 3.0], stuck.sum())
        return frames, stuck, truth

    @pytest.mark.long
    @pytest.mark.parametrize("share", [0, 1e-3])
    def test_neighbours_of_constant_pixels_are_as_good_as_others(self, share):
        for seed in range(3):
            frames, stuck, truth = self.experiment(seed, share)
            cal, kinds = calibrated(frames, CROSS, variance=np.full(5, NOISE**2), uncertainty=True)
            flags = (cal.flags & (Flag.HOT | Flag.DEAD)) != 0
            np.testing.assert_array_equal(flags, stuck)
            good = np.where(stuck, np.nan, truth)
            z = metrics.relative_error(cal.sensitivity, good) / cal.sensitivity_std
            # The largest of 6144 normal values is above 5.5 in one of 4000 cases.
            assert np.nanmax(np.abs(z * truth)) < 5.5
            assert kinds == []

    def test_a_pixel_of_twice_the_response_keeps_its_sensitivity(self):
        rng = np.random.default_rng(6)
        truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
        truth[20, 30], truth[40, 50] = 2.5, 0.3
        frames = noisy(simulate.exposures(truth, simulate.wavy_beam(SENSOR, rng=6), CROSS), rng)
        cal, _ = calibrated(frames, CROSS, variance=np.full(5, NOISE**2))
        error = metrics.relative_error(cal.sensitivity, truth)
        assert np.abs(error[[20, 40], [30, 50]]).max() < 5e-3


class TestDustThatStays:
    @pytest.mark.parametrize("first", [2, 5, 8])
    def test_is_found_and_flagged(self, first):
        for seed in range(2):
            rng = np.random.default_rng([7, seed])
            truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
            frames = simulate.exposures(truth, simulate.wavy_beam(SENSOR, rng=seed), TEN)
            grain = np.zeros(SENSOR, bool)
            grain[20:25, 41:47] = True
            frames[first:, grain] *= 0.7
            cal, _ = calibrated(
                noisy(frames, rng), TEN, robust=True, variance=np.full(10, 1e-6), uncertainty=True
            )
            flagged = (cal.flags & Flag.UNRELIABLE_FLAT) != 0
            assert flagged[grain].all()
            assert np.count_nonzero(flagged & ~grain) <= 4
            after = np.where(grain, 0.7 * truth, truth)
            good = np.where(flagged, np.nan, truth)
            scale = np.nanmean(cal.sensitivity[~flagged]) / np.nanmean(good)
            z = (cal.sensitivity / scale - after) / cal.sensitivity_std
            # The largest of 6144 normal values is above 5.5 in one of 4000 cases.
            assert np.nanmax(np.abs(z)) < 5.5

    def test_nothing_falls_in_a_right_experiment(self):
        rng = np.random.default_rng(8)
        truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
        frames = noisy(simulate.exposures(truth, simulate.wavy_beam(SENSOR, rng=8), TEN), rng)
        cal, kinds = calibrated(frames, TEN, robust=True)
        assert not cal.flags.any()
        assert kinds == []
