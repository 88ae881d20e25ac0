"""The check of a fit: predictions, residuals, reduced χ², weights by a noise model, saturation."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import Flag, NoiseModel, errors, metrics, simulate

CROSS = equipix.cross_pattern(5, 7)
WIDE = equipix.cross_pattern(11, 19)
EPS = np.finfo(np.float64).eps


def sensor(shape, seed, *, width=None):
    """A generator, a true sensitivity of mean 1, and a beam."""
    rng = np.random.default_rng(seed)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    return rng, truth / truth.mean(), simulate.gaussian_beam(shape, width=width or 3 * max(shape))


def chi2_scatter(cal, runs=1):
    """Standard deviation of the mean reduced χ² of so many runs: √(2/f) of each."""
    return np.sqrt(2 / (cal.objective / cal.reduced_chi2) / runs)


@pytest.fixture(scope="module")
def noise_free():
    _, truth, beam = sensor(TestPredict.SHAPE, 1)
    options = {"rotation": TestPredict.ROTATION, "flux": TestPredict.FLUX}
    frames = simulate.exposures(truth, beam, TestPredict.SHIFTS, **options)
    return (
        truth,
        beam,
        frames,
        equipix.calibrate(frames, TestPredict.SHIFTS, tolerance=1e-9, **options),
    )


class TestPredict:
    SHAPE = (30, 44)
    SHIFTS = np.vstack([CROSS, [(2, -3), (-1, 4), (3, 1)]])
    ROTATION = (0, 0, 0, 0, 0, 90, 180, 270)
    FLUX = (1, 1.1, 0.9, 1.2, 1, 0.8, 1, 1.3)

    @pytest.mark.parametrize("rotation", [0, 90, 180, 270])
    @pytest.mark.parametrize("shift", [(2, 3), (0, 6), (-1, 1)])
    def test_it_is_the_exposure_at_another_position(self, noise_free, shift, rotation):
        truth, beam, _, cal = noise_free
        wanted = simulate.exposures(truth, beam, [shift], rotation=[rotation], flux=[1.7])[0]
        got = cal.predict(shift, rotation=rotation, flux=1.7)
        seen = np.isfinite(got)
        assert seen.mean() > 0.8
        # M and L are each off by what the estimate, right within a factor 10, leaves.
        np.testing.assert_allclose(got[seen], wanted[seen], rtol=2 * 10 * 1e-9)

    def test_what_no_exposure_observed_is_nan(self, noise_free):
        cal = noise_free[3]
        for shift, rotation in (((500, -500), 0), ((-(10**6), 0), 90)):
            with pytest.raises(
                errors.InputError, match="no exposure has observed the beam where a pixel"
            ):
                cal.predict(shift, rotation=rotation)
        rows = np.isnan(cal.predict((-3, 0))).all(axis=1)
        assert rows.tolist() == [True] * 2 + [False] * 28  # the grid begins at row −1

    def test_a_masked_pixel_is_nan(self):
        _, truth, beam = sensor((30, 40), 1)
        mask = np.zeros(truth.shape, bool)
        mask[4, 5] = True
        cal = equipix.calibrate(simulate.exposures(truth, beam, CROSS), CROSS, mask=mask)
        assert np.argwhere(np.isnan(cal.predict((0, 0)))).tolist() == [[4, 5]]

    def test_it_keeps_the_precision_of_the_frames(self, noise_free):
        _, _, frames, _ = noise_free
        cal = equipix.calibrate(frames[:5].astype(np.float32), CROSS, flux=self.FLUX[:5])
        assert cal.predict((0, 0)).dtype == np.float32

    @pytest.mark.parametrize(
        ("arguments", "options", "words"),
        [
            ((3,), {}, "'shift' is 3"),
            (([[0, 0]],), {}, "'shift'"),
            (((0, 0),), {"rotation": 45}, "'rotation'"),
            (((0, np.nan),), {}, "'shift"),
        ],
    )
    def test_bad_arguments_are_named(self, noise_free, arguments, options, words):
        with pytest.raises(errors.InputError, match=words):
            noise_free[3].predict(*arguments, **options)

    def test_between_pixels_it_follows_the_beam(self):
        truth, beam = np.ones((48, 64)), simulate.gaussian_beam((48, 64), width=50)
        cal = equipix.calibrate(simulate.exposures(truth, beam, CROSS), CROSS)
        held_out = simulate.exposures(truth, beam, [(0.4, 2.3)])[0]
        error = np.abs(cal.predict((0.4, 2.3)) / held_out - 1)
        # Polynomials through six cells: 1e-8 for such a width; straight lines at the edge 1/8 of
        # the second difference, 2/50², and the calibration itself to 1e-6.
        assert np.nanmax(error[3:-3, 3:-3]) < 2e-6
        assert np.nanmax(error) < 0.25 / 50**2 * 1.5


class TestResiduals:
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    @pytest.mark.parametrize("seed", range(3))
    def test_their_squares_add_up_to_the_objective(self, seed, tmp_path):
        rng, truth, beam = sensor((30, 44), seed)
        rotation, flux = [0, 0, 0, 0, 90], [1, 1.1, 0.9, 1, 1.2]
        frames = simulate.exposures(truth, beam, CROSS, rotation=rotation, flux=flux)
        variance = rng.uniform(1, 3, 5) * 1e-6
        frames += np.sqrt(variance)[:, None, None] * rng.standard_normal(frames.shape)
        frames[2, 5, 6] = np.nan
        plain = equipix.calibrate(frames, CROSS, rotation=rotation, flux=flux)
        weighted = equipix.calibrate(
            frames, CROSS, rotation=rotation, flux=flux, variance=variance, tolerance=1e-9
        )
        weighted.save(tmp_path / "cal.tif")
        read = equipix.load(tmp_path / "cal.tif")
        # F is stationary: an error of M and L enters by its square. Sums of N squares.
        rounding = 1e-10 + frames.size * EPS
        maps = plain.residuals(frames)
        assert np.argwhere(np.isnan(maps)).tolist() == [[2, 5, 6]]
        assert np.nansum(maps**2) == pytest.approx(plain.objective, rel=rounding)
        for cal in (weighted, read):
            maps = cal.residuals(frames, variance=variance)
            assert np.nansum(maps**2) == pytest.approx(cal.objective, rel=rounding)

    @pytest.mark.parametrize("seed", range(3))
    def test_an_exposure_held_out_is_predicted_within_its_noise(self, seed):
        noise = 1e-3
        rng, truth, beam = sensor((120, 160), seed)
        frames = simulate.exposures(truth, beam, [*CROSS.tolist(), (3, 4)])
        signal = frames[5].copy()
        frames += noise * rng.standard_normal(frames.shape)
        cal = equipix.calibrate(frames[:5], CROSS, variance=np.full(5, noise**2))
        maps = cal.residuals(frames[5:], variance=[noise**2], shifts=[(3, 4)])[0]
        wrong = (cal.predict((3, 4)) - signal) / noise
        seen = np.isfinite(maps)
        share = np.mean(wrong[seen] ** 2)
        # Its own noise and the prediction's are independent: the squares have a mean of 1 + share
        # and scatter by √(2 + 4·share) at given predictions.
        scatter = np.sqrt((2 + 4 * share) / seen.sum())
        assert np.mean(maps[seen] ** 2) == pytest.approx(1 + share, abs=4 * scatter)
        # M and L each take 1/5 of the noise of five exposures, and more where fewer look.
        assert 2 / 5 - 1 / 25 < share < 1

    def test_an_exposure_at_another_place_stands_out(self):
        _, truth, beam = sensor((60, 80), 1, width=60)
        frames = simulate.exposures(truth, beam, CROSS)
        cal = equipix.calibrate(frames, CROSS)
        assert np.nanmax(np.abs(cal.residuals(frames[1:2], shifts=[(0, 5)]))) < 1e-5
        assert np.nanmax(np.abs(cal.residuals(frames[1:2], shifts=[(0, 6)]))) > 1e-3

    def test_noise_models_and_averages_give_the_scale(self):
        rng, truth, beam = sensor((60, 80), 2)
        clean = 2000 * simulate.exposures(truth, beam, CROSS)
        averages = [equipix.average(rng.normal(x, np.sqrt(0.5 * x), (10, *x.shape))) for x in clean]
        cal = equipix.calibrate(averages, CROSS)
        model = NoiseModel(0.0, 0.5).of_mean(10)
        means = np.stack([each.mean for each in averages])
        known = cal.residuals(means, variance=model)
        measured = cal.residuals(averages)
        # The fitted model stands on 9 degrees of freedom in each of 24 000 measurements.
        np.testing.assert_allclose(measured, known, rtol=5 * np.sqrt(2 / (9 * 24_000)) * 2)

    def test_bad_arguments_are_named(self):
        _, truth, beam = sensor((30, 40), 1)
        frames = simulate.exposures(truth, beam, CROSS)
        cal = equipix.calibrate(frames, CROSS)
        for arguments, options, words in (
            (frames[:, 1:], {}, "the sensor"),
            (frames[:2], {}, "'frames' has 2 entries"),
            (frames[:2], {"shifts": CROSS}, "'shifts' has 5 entries"),
            (frames, {"variance": np.ones(3)}, "'variance' has 3"),
        ):
            with pytest.raises(errors.InputError, match=words):
                cal.residuals(arguments, **options)


class TestReducedChi2:
    """Pooled over five runs it scatters by 0.0014 at 320×240: four of these are within 0.01."""

    SHAPE = (240, 320)

    def chi2(self, calibrate):
        cals = [calibrate(*sensor(self.SHAPE, seed, width=1000)) for seed in range(5)]
        chi2 = [cal.reduced_chi2 for cal in cals]
        assert chi2 == pytest.approx([1] * 5, abs=0.01)  # 3.3 standard deviations
        mean = np.mean(chi2)
        assert mean == pytest.approx(1, abs=4 * chi2_scatter(cals[0], 5))
        return cals

    @pytest.mark.study
    @pytest.mark.parametrize("shifts", [WIDE, equipix.cross_pattern(4, 6)], ids=["1 part", "4"])
    @pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
    def test_known_variances(self, shifts):
        def run(rng, truth, beam):
            clean = simulate.exposures(truth, beam, shifts)
            sigma = rng.uniform(1e-3, 3e-3, clean.shape)
            mask = rng.random(clean.shape) < 0.02
            frames = clean + sigma * rng.standard_normal(clean.shape)
            return equipix.calibrate(frames, shifts, variance=sigma**2, mask=mask)

        self.chi2(run)

    @pytest.mark.long
    def test_averaged_frames(self):
        def run(rng, truth, beam):
            clean = 3000 * simulate.exposures(truth, beam, WIDE)
            sigma = np.sqrt(0.3 * clean + 4)
            stacks = (rng.normal(x, s, (8, *x.shape)) for x, s in zip(clean, sigma, strict=True))
            return equipix.calibrate([equipix.average(each) for each in stacks], WIDE)

        # The signals span so little that half of the fits would have the variance without light
        # below 0. The variance stands on 7 degrees of freedom in each of 384 000 measurements:
        # that adds 0.0009/√5 in quadrature to four standard deviations of 0.0014 and is left out.
        self.chi2(run)

    @pytest.mark.long
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_noise_models_on_plain_arrays(self):
        """Variances at the noisy values bias the signals, which looks like a drift of the lamp."""
        model = NoiseModel(read_noise=5.0, gain=1.0)
        naive = []

        def run(rng, truth, beam):
            clean = 100 * simulate.exposures(truth, beam, WIDE)
            frames = rng.poisson(clean) + 5 * rng.standard_normal(clean.shape)
            naive.append(equipix.calibrate(frames, WIDE, variance=model.variance(frames)))
            return equipix.calibrate(frames, WIDE, variance=model)

        cals = self.chi2(run)
        # What the detour is for: with variances at the noisy values χ² is further off.
        off = [abs(np.mean([cal.reduced_chi2 for cal in each]) - 1) for each in (cals, naive)]
        assert off[0] < off[1]

    def test_a_large_sensor(self):
        rng, truth, beam = sensor((582, 782), 3, width=1000)
        clean = simulate.exposures(truth, beam, WIDE)
        frames = clean + 1e-3 * rng.standard_normal(clean.shape)
        cal = equipix.calibrate(frames, WIDE, variance=np.full(5, 1e-6))
        assert cal.reduced_chi2 == pytest.approx(1, abs=4 * chi2_scatter(cal))


class TestNoiseModel:
    @pytest.mark.long
    @pytest.mark.parametrize("electrons", [30, 100])
    def test_weights_at_expectations_make_m_better(self, electrons):
        """At few electrons a weight taken at the value itself goes with that value's noise."""
        squares = np.zeros(2)
        model = NoiseModel(read_noise=3.0, gain=1.0)
        for seed in range(3):
            rng, truth, beam = sensor((120, 160), seed, width=1000)
            frames = rng.poisson(electrons * simulate.exposures(truth, beam, WIDE)) * 1.0
            frames += 3 * rng.standard_normal(frames.shape)
            for index, variance in enumerate((model, model.variance(frames))):
                cal = equipix.calibrate(frames, WIDE, variance=variance)
                squares[index] += np.mean(metrics.relative_error(cal.sensitivity, truth) ** 2)
        assert squares[0] < squares[1]

    def test_one_for_each_exposure(self):
        rng, truth, beam = sensor((60, 80), 1)
        clean = simulate.exposures(truth, beam, CROSS)
        sigma = [1e-3, 2e-3, 1e-3, 4e-3, 1e-3]
        frames = clean + np.array(sigma)[:, None, None] * rng.standard_normal(clean.shape)
        models = [NoiseModel(each, 0.0) for each in sigma]
        by_model = equipix.calibrate(frames, CROSS, variance=models, tolerance=1e-9)
        by_number = equipix.calibrate(frames, CROSS, variance=np.square(sigma), tolerance=1e-9)
        # The estimate of each is right within a factor 10.
        np.testing.assert_allclose(by_model.sensitivity, by_number.sensitivity, rtol=2e-8)

    def test_without_read_noise_dark_pixels_have_a_variance(self):
        _, truth, beam = sensor((30, 40), 1)
        truth[4, 5] = 0
        frames = 1e4 * simulate.exposures(truth, beam, CROSS)
        cal = equipix.calibrate(frames, CROSS, variance=NoiseModel(0.0, 1.0))
        assert cal.flags[4, 5] & Flag.DEAD

    @pytest.mark.parametrize("values", [(-1, 0), (0, 0), (np.nan, 1), (1, np.inf), ("1", 1)])
    def test_what_is_no_noise_is_refused(self, values):
        with pytest.raises(errors.InputError, match="'read_noise'|'gain'"):
            NoiseModel(*values)

    def test_mixtures_are_refused(self):
        frames = np.ones((3, 8, 9))
        model = NoiseModel(1.0, 0.0)
        with pytest.raises(errors.InputError, match="mixes"):
            equipix.calibrate(frames, CROSS[:3], variance=[model, 1.0, 1.0])
        with pytest.raises(errors.InputError, match="'variance' has 2 entries"):
            equipix.calibrate(frames, CROSS[:3], variance=[model, model])


class TestOddPixels:
    @pytest.mark.parametrize("seed", range(3))
    def test_saturated_values_are_left_out_and_flagged(self, seed):
        rng, truth, beam = sensor((60, 80), seed)
        clean = 1000 * simulate.exposures(truth, beam, CROSS)
        frames = clean + rng.standard_normal(clean.shape)
        level = float(np.quantile(frames, 0.99))
        clipped = np.minimum(frames, level)
        mask = np.zeros(frames.shape, bool)
        mask[1, 20, 20] = True
        cal = equipix.calibrate(clipped, CROSS, mask=mask, saturation=level)
        wanted = equipix.calibrate(frames, CROSS, mask=mask | (frames >= level))
        np.testing.assert_array_equal(cal.sensitivity, wanted.sensitivity)
        saturated = (frames >= level).any(axis=0)
        np.testing.assert_array_equal((cal.flags & Flag.SATURATED) > 0, saturated)

    def test_a_saturation_that_leaves_nothing_is_named(self):
        frames = np.ones((5, 20, 30))
        with pytest.raises(errors.InputError, match=r"exposure 0: 100\.0% of the pixels"):
            equipix.calibrate(frames, CROSS, saturation=0.5)
        with pytest.raises(errors.InputError, match="'saturation' is -1"):
            equipix.calibrate(frames, CROSS, saturation=-1)
        averages = [equipix.average(np.stack([each, each + 1])) for each in frames]
        with pytest.raises(errors.InputError, match="equipix.average"):
            equipix.calibrate(averages, CROSS, saturation=3)

    @pytest.mark.parametrize("variance", [None, np.full(5, 1e-6)], ids=["unit", "known"])
    def test_dead_and_hot_pixels_are_flagged(self, variance):
        """Whatever the beam does: M knows of none, where a frame has a spot or an edge."""
        rng, truth, beam = sensor((60, 80), 4, width=35)
        truth[10, 12], truth[30, 40], truth[50, 7], truth[20, 60] = 0.1, 0.4, 2.5, 1.5
        frames = simulate.exposures(truth, beam, CROSS)
        frames += 1e-3 * rng.standard_normal(frames.shape)
        cal = equipix.calibrate(frames, CROSS, variance=variance)
        dead, hot = ((cal.flags & flag) > 0 for flag in (Flag.DEAD, Flag.HOT))
        assert np.argwhere(dead).tolist() == [[10, 12], [30, 40]]
        assert np.argwhere(hot).tolist() == [[50, 7]]
        np.testing.assert_array_equal(cal.flags & Flag.DO_NOT_USE > 0, dead | hot)

    @pytest.mark.parametrize("seed", range(3))
    def test_noise_alone_makes_none(self, seed):
        rng, truth, beam = sensor((60, 80), seed)
        frames = 20 * simulate.exposures(truth, beam, CROSS)
        frames += 5 * rng.standard_normal(frames.shape)
        for variance in (None, np.full(5, 25.0)):
            assert not equipix.calibrate(frames, CROSS, variance=variance).flags.any()

    @pytest.mark.parametrize("seed", range(3))
    def test_a_pixel_that_flickers_is_hot(self, seed):
        rng, truth, beam = sensor((60, 80), seed)
        clean = 2000 * simulate.exposures(truth, beam, CROSS)
        sigma = np.sqrt(0.5 * clean)
        sigma[:, 7, 8] *= 10
        stacks = (rng.normal(x, s, (16, *x.shape)) for x, s in zip(clean, sigma, strict=True))
        cal = equipix.calibrate([equipix.average(each) for each in stacks], CROSS)
        assert np.argwhere((cal.flags & Flag.HOT) > 0).tolist() == [[7, 8]]
        assert np.isnan(cal.sensitivity[7, 8])
