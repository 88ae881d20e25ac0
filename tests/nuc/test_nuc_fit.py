"""Response curves from levels of a uniform source: the fit, its errors, order and refusals."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import equipix
import reference
from equipix import Flag, NoiseModel, errors, nuc
from equipix.measured.means import Averaged
from equipix.nuc.levels import levels_of
from equipix.nuc.order import next_power
from equipix.simulate import StaringArray

SHAPE = (48, 64)
LEVELS = np.linspace(300.0, 3500.0, 8)
NOISE = NoiseModel(read_noise=2.0, gain=0.25)
EPS = np.finfo(np.float64).eps
SIZES = (30.0, 0.05, 4e-6, 1e-9)
"""Spread of a, K, c and e over the pixels, for signals of thousands of DN."""


STRONG = pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
"""For curves of third order that bend more than a cubic inverse can follow, as they are told."""


def truth(order, rng, shape=SHAPE):
    """Coefficients whose means over the pixels are 0, so that V̄ is the mean of the array."""
    found = np.stack([size * rng.standard_normal(shape) for size in SIZES[: order + 1]])
    return found - found.mean(axis=(1, 2), keepdims=True)


def curves(deviation, levels=LEVELS):
    """Raw means of all levels without noise."""
    return np.stack([v + sum(q * v**i for i, q in enumerate(deviation)) for v in levels])


def noisy(values, rng, model=NOISE):
    return values + np.sqrt(model.variance(values)) * rng.standard_normal(values.shape)


@pytest.fixture(scope="module")
def cubic():
    """Levels of a sensor of third order with noise, its truth, and the fit."""
    rng = np.random.default_rng(1)
    deviation = truth(3, rng, (96, 128))
    levels = noisy(curves(deviation), rng)
    return deviation, levels, nuc.fit(levels, order=3, variance=NOISE)


@STRONG
class TestAgainstTheReference:
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @pytest.mark.parametrize(
        ("order", "by", "powers"),
        [
            (0, "offset", (0,)),
            (0, "gain", (1,)),
            (1, "offset", (0, 1)),
            (2, "offset", (0, 1, 2)),
            (3, "offset", (0, 1, 2, 3)),
        ],
    )
    @pytest.mark.parametrize("variance", [None, NOISE])
    def test_the_fit_is_that_of_plain_least_squares(self, dtype, order, by, powers, variance):
        rng = np.random.default_rng(order)
        levels = noisy(curves(truth(3, rng, (5, 7))), rng).astype(dtype)
        response = nuc.fit(levels, order=order, by=by, variance=variance)
        law = None if variance is None else lambda _, signal: variance.variance(signal)
        found, variances, misfit = reference.response(levels, response.levels, powers, law)
        # Coefficients in DN at the highest level: rounding of sums of 4000 DN, through a condition
        # of powers on [−1, 1] squared (normal equations) and shifted to powers of DN: below 1e5.
        unit = LEVELS[-1] ** np.array(powers)[:, None, None]
        atol = 1e5 * EPS * 4000
        np.testing.assert_allclose(
            response.deviation[list(powers)] * unit, found * unit, rtol=0, atol=atol
        )
        freedom = len(LEVELS) - len(powers)
        np.testing.assert_allclose(response.reduced_chi2, misfit / freedom, rtol=1e5 * EPS)
        if variance is None:
            usable = (response.flags & Flag.DO_NOT_USE) == 0
            variances = variances * misfit[usable].sum() / (freedom * usable.sum())
        np.testing.assert_allclose(response.variances[list(powers)], variances, rtol=1e5 * EPS)

    @pytest.mark.parametrize("order", [2, 3])
    def test_the_exact_inverse_is_that_of_bisection(self, order):
        rng = np.random.default_rng(4)
        response = nuc.fit(curves(truth(order, rng, (4, 5))), order=order)
        low, high = response.valid_range
        raw = low + rng.random(low.shape) * (high - low)
        corrected = response.correct(raw, exact=True, flagged="keep")
        for place in np.ndindex(raw.shape):
            limits = response.limits[(slice(None), *place)]
            wanted = reference.inverse(
                response.deviation[(slice(None), *place)], raw[place], limits
            )
            assert corrected[place] == pytest.approx(wanted, rel=1e3 * EPS)

    def test_the_exact_inverse_of_second_order_is_the_formula(self):
        rng = np.random.default_rng(5)
        response = nuc.fit(curves(truth(2, rng)), order=2)
        a, k, c = response.deviation
        raw = 2000.0 + 100 * rng.standard_normal(SHAPE)
        root = np.sqrt((1 + k) ** 2 + 4 * c * (raw - a))
        wanted = 2 * (raw - a) / (1 + k + root)
        corrected = response.correct(raw, exact=True, flagged="keep")
        np.testing.assert_allclose(corrected, wanted, rtol=100 * EPS)


@STRONG
class TestStatistics:
    def test_coefficients_lie_within_their_standard_errors(self, cubic):
        deviation, _, response = cubic
        z = (response.deviation - deviation) / np.sqrt(response.variances)
        # 12 288 normal values: their rms has a standard error of 0.6 %.
        np.testing.assert_allclose(np.sqrt(np.mean(z**2, axis=(1, 2))), 1, atol=0.03)
        assert np.abs(np.mean(z, axis=(1, 2))).max() < 5 / np.sqrt(z[0].size)

    def test_the_goodness_of_fit_is_one_where_the_noise_is_right(self, cubic):
        _, _, response = cubic
        freedom = (len(LEVELS) - 4) * response.flags.size
        assert response.reduced_chi2.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / freedom))

    def test_without_noise_given_the_residuals_give_the_standard_errors(self):
        rng = np.random.default_rng(2)
        deviation, sigma = truth(1, rng), 3.0
        levels = curves(deviation) + sigma * rng.standard_normal((len(LEVELS), *SHAPE))
        response = nuc.fit(levels, order=1)
        known = nuc.fit(levels, order=1, variance=np.full(len(LEVELS), sigma**2))
        # The pooled variance has (8 − 2) · 3072 degrees of freedom: 0.74 % of it; five of these.
        np.testing.assert_allclose(response.variances / known.variances, 1, atol=0.037)
        assert response.metadata["options"]["weights"] == "equal"

    def test_averages_bring_their_noise(self):
        rng = np.random.default_rng(3)
        deviation = truth(1, rng)
        frames = [noisy(np.repeat(each[None], 8, axis=0), rng) for each in curves(deviation)]
        averages = [equipix.average(each) for each in frames]
        response = nuc.fit(averages, order=1)
        z = (response.deviation - deviation) / np.sqrt(response.variances)
        # 3072 normal values: 1.3 %; the model of the noise adds less than 1 %.
        np.testing.assert_allclose(np.sqrt(np.mean(z**2, axis=(1, 2))), 1, atol=0.06)
        freedom = (len(LEVELS) - 2) * response.flags.size
        assert response.reduced_chi2.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / freedom) + 0.01)

    def test_a_dark_of_few_frames_adds_to_the_variance_of_the_offset(self):
        rng = np.random.default_rng(6)
        deviation = truth(1, rng)
        deviation[0] = 0
        dark = equipix.average(np.rint(60 + 2 * rng.standard_normal((2, *SHAPE))).astype(np.uint16))
        averages = [
            equipix.average(
                np.rint(60 + noisy(np.repeat(each[None], 16, axis=0), rng)).astype(np.uint16),
                dark=dark,
            )
            for each in curves(deviation)
        ]
        response = nuc.fit(averages, order=1)
        z = response.deviation / np.sqrt(response.variances)
        assert np.sqrt(np.mean(z[0] ** 2)) == pytest.approx(1, abs=0.07)
        np.testing.assert_array_equal(response.dark, dark.mean)


@STRONG
class TestLaws:
    def test_the_order_of_the_levels_plays_no_part(self, cubic):
        _, levels, response = cubic
        again = nuc.fit(levels[::-1], order=3, variance=NOISE)
        unit = LEVELS[-1] ** np.arange(4)[:, None, None]
        atol = 1e5 * EPS * 4000
        np.testing.assert_allclose(again.deviation * unit, response.deviation * unit, atol=atol)

    def test_transposed_levels_give_transposed_curves(self, cubic):
        _, levels, response = cubic
        again = nuc.fit(levels.transpose(0, 2, 1), order=3, variance=NOISE)
        # The sum of V̄ runs in another order: some roundings of it.
        unit = LEVELS[-1] ** np.arange(4)[:, None, None]
        turned = response.deviation.transpose(0, 2, 1)
        atol = 1e5 * EPS * 4000
        np.testing.assert_allclose(again.deviation * unit, turned * unit, atol=atol)

    def test_the_unit_of_the_levels_scales_the_curves(self, cubic):
        _, levels, response = cubic
        again = nuc.fit(4 * levels, order=3, variance=NoiseModel(read_noise=8.0, gain=1.0))
        powers = 4.0 ** (1 - np.arange(4))[:, None, None]
        np.testing.assert_array_equal(again.deviation, response.deviation * powers)

    def test_any_number_of_workers_gives_the_same_bytes(self, cubic):
        _, levels, response = cubic
        again = nuc.fit(levels, order=3, variance=NOISE, workers=3)
        assert again.deviation.tobytes() == response.deviation.tobytes()

    def test_as_many_levels_as_coefficients_are_interpolated(self):
        rng = np.random.default_rng(7)
        some = LEVELS[[0, 2, 5, 7]]
        levels = noisy(curves(truth(3, rng), some), rng)
        response = nuc.fit(levels, order=3)
        for level, mean in zip(levels, response.levels, strict=True):
            curve = mean + sum(q * mean**i for i, q in enumerate(response.deviation))
            np.testing.assert_allclose(curve, level, atol=1e5 * EPS * 4000)
            corrected = response.correct(level, exact=True)
            np.testing.assert_allclose(corrected, mean, atol=1e5 * EPS * 4000)
        assert np.isnan(response.reduced_chi2).all()
        assert np.isnan(response.variances).all()

    def test_a_mean_of_corrected_pixels_is_the_reference(self, cubic):
        _, levels, response = cubic
        for level, mean in zip(levels, response.levels, strict=True):
            assert response.correct(level, exact=True).mean() == pytest.approx(mean, rel=1e-4)


class TestOnePoint:
    def test_by_offset_subtracts_the_deviation(self):
        level = 1000 + 50 * np.random.default_rng(1).standard_normal(SHAPE)
        response = nuc.fit([level], order=0)
        np.testing.assert_allclose(response.correct(level), level.mean(), rtol=10 * EPS)
        np.testing.assert_allclose(response.correct(level + 100), level.mean() + 100, rtol=10 * EPS)

    def test_by_gain_divides_by_the_response(self):
        level = 1000 + 50 * np.random.default_rng(1).standard_normal(SHAPE)
        response = nuc.fit([level], order=0, by="gain")
        np.testing.assert_allclose(response.correct(level), level.mean(), rtol=10 * EPS)
        np.testing.assert_allclose(response.correct(2 * level), 2 * level.mean(), rtol=10 * EPS)
        assert (response.freedom == 0).all()
        twice = nuc.fit([level, 2 * level], order=0, by="gain")
        assert (twice.freedom == 1).all()


@STRONG
class TestOrder:
    @pytest.mark.parametrize("order", [1, 2, 3])
    def test_auto_finds_the_order_of_the_curves(self, order):
        rng = np.random.default_rng(order)
        of_mean = NOISE.of_mean(100)
        levels = noisy(curves(truth(order, rng)), rng, of_mean)
        response = nuc.fit(levels, order="auto", variance=of_mean)
        assert response.order == order
        prediction = response.metadata["options"]["prediction_errors"]
        assert len(prediction) == 4
        assert min(prediction) == prediction[order]

    @pytest.mark.parametrize("count", [3, 4, 5, 6])
    def test_auto_tries_each_order_that_the_levels_left_determine(self, count):
        """With one left out, as many levels as coefficients: no further than the cubic."""
        order = min(3, count - 2)
        levels = curves(truth(order, np.random.default_rng(1)), np.linspace(300, 3500, count))
        response = nuc.fit(levels, order="auto")
        assert response.order == order
        assert len(response.metadata["options"]["prediction_errors"]) == order + 1

    def test_prediction_errors_are_in_variances_of_the_level_left_out(self):
        """Of the true order 1 for each such level, and x Cᵀ x of the others beside it."""
        rng, places = np.random.default_rng(16), np.linspace(300, 3500, 5)
        variances = np.array([1.0, 100.0, 4.0, 25.0, 1.0])
        noise = np.sqrt(variances)[:, None, None] * rng.standard_normal((5, *SHAPE))
        levels = curves(truth(1, rng), places) + noise
        found = nuc.fit(levels, order="auto", variance=variances)
        wanted = []
        for held in (1, 2, 3):
            others = np.delete(np.arange(5), held)
            design = np.vander(places, 2, increasing=True)
            scaled = design[others] / np.sqrt(variances[others])[:, None]
            covariance = np.linalg.inv(scaled.T @ scaled)
            wanted.append(1 + design[held] @ covariance @ design[held] / variances[held])
        # Five standard errors of the mean of 3072 squares; those of a pixel are not independent.
        error = found.metadata["options"]["prediction_errors"][1]
        assert error == pytest.approx(np.mean(wanted), rel=5 * np.sqrt(2 / 3072))

    def test_auto_takes_the_lowest_order_that_exact_levels_have(self):
        response = nuc.fit(curves(truth(1, np.random.default_rng(1))), order="auto")
        assert response.order == 1

    @pytest.mark.long
    def test_one_pixel_does_not_decide_on_the_order(self):
        errors = []
        for times in (1, 1.9, 3):
            sensitivity = np.ones(SHAPE)
            sensitivity[20, 20] = times
            array = StaringArray.of("PtSi", SHAPE, rng=1)
            array = array.with_causes(sensitivity=array.sensitivity * sensitivity)
            lights = (2e6, 5e6, 8e6, 11e6, 14e6)
            levels = [
                equipix.average(array.frames(each, 8, rng=k)) for k, each in enumerate(lights)
            ]
            response = nuc.fit(levels, order="auto")
            assert response.order == 1
            errors.append(response.metadata["options"]["prediction_errors"])
        # Five standard errors of the mean of 3072 squares.
        np.testing.assert_allclose(errors[1:], errors[:1] * 2, rtol=5 * np.sqrt(2 / 3072))

    def test_many_pixels_decide_on_the_order(self):
        rng = np.random.default_rng(15)
        deviation = truth(2, rng)
        deviation[2] = np.where(rng.random(SHAPE) < 0.1, 4e-5, 0.0)
        levels = noisy(curves(deviation), rng)
        assert nuc.fit(levels, order="auto", variance=NOISE).order == 2

    def test_auto_needs_a_level_to_leave_out(self):
        levels = curves(truth(1, np.random.default_rng(1)), LEVELS[:2])
        with pytest.raises(errors.InputError, match="2 of 2 differ: give three"):
            nuc.fit(levels, order="auto")

    @pytest.mark.parametrize("order", [0, 1, "auto"])
    def test_levels_along_the_last_axis_are_refused(self, order):
        levels = np.moveaxis(np.array(curves(truth(1, np.random.default_rng(1)))), 0, -1)
        assert levels.shape[2] < min(SHAPE)
        with pytest.raises(errors.InputError, match=r"along the last axis: .*moveaxis"):
            nuc.fit(levels, order=order)

    @pytest.mark.parametrize("places", [[0, 0, 0, -1, -1], [0, 0, 0, 0, -1]])
    def test_auto_refuses_two_levels_repeated(self, places):
        """Between them order 0 has no rival: it left 227 DN in frames of another level."""
        rng = np.random.default_rng(4)
        levels = noisy(curves(truth(1, rng), np.array(LEVELS)[places]), rng, NOISE.of_mean(100))
        with pytest.raises(errors.InputError, match="2 of 5 differ: give three"):
            nuc.fit(levels, order="auto", variance=NOISE.of_mean(100))


class TestInverse:
    def test_the_cubic_is_as_close_as_it_says(self):
        rng = np.random.default_rng(8)
        response = nuc.fit(curves(truth(3, rng)), order=3)
        low, high = response.valid_range
        largest = np.zeros(SHAPE)
        for share in np.linspace(0, 1, 101):
            raw = low + share * (high - low)
            difference = response.correct(raw) - response.correct(raw, exact=True)
            largest = np.maximum(largest, np.abs(difference))
        good = (response.flags & Flag.DO_NOT_USE) == 0
        # Compared at 17 places: between two of them a polynomial of degree 4 rises by 2 % at most.
        assert np.nanmax(largest[good] - 1.02 * response.inverse_error[good]) < 1e-9
        assert response.largest_inverse_error == response.inverse_error[good].max()
        assert np.nanmedian(largest / response.inverse_error) > 0.98

    # The noise stated, or the difference of each two frames, is above what residuals show.
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_an_error_beyond_the_noise_is_said(self):
        levels = curves(truth(2, np.random.default_rng(8)))
        error = nuc.fit(levels, order=2).inverse_error
        # The limit is 0.3 of the noise: between the fourth and the third largest error three of
        # 3072 pixels are beyond, which passes; between the fifth and the fourth four are.
        fifth, fourth, third = np.sort(error.ravel())[[-5, -4, -3]]
        few, many = (fourth + third) / 2 / 0.3, (fifth + fourth) / 2 / 0.3
        found = nuc.fit(levels, order=2, variance=np.full(len(LEVELS), few**2))
        assert found.metadata["inverse"]["pixels_beyond"] == 3
        assert found.metadata["inverse"]["noise_dn"] == pytest.approx(few)
        with pytest.warns(errors.MisfitWarning, match=r"in 4 of 3072 .* correct\(exact=True\)"):
            found = nuc.fit(levels, order=2, variance=np.full(len(LEVELS), many**2))
        assert found.metadata["inverse"]["largest_error_dn"] == pytest.approx(error.max(), rel=1e-6)

    def test_the_noise_of_the_finding_is_that_of_one_frame(self):
        rng = np.random.default_rng(14)
        frames = [noisy(np.repeat(each[None], 16, axis=0), rng) for each in curves(truth(1, rng))]
        response = nuc.fit([equipix.average(each) for each in frames], order=2)
        wanted = np.sqrt(NOISE.variance(LEVELS[0]))
        assert response.metadata["inverse"]["noise_dn"] == pytest.approx(wanted, rel=0.02)

    @STRONG
    def test_the_coefficients_are_what_correct_does(self, cubic):
        _, levels, response = cubic
        frame = levels[3]
        total = np.zeros(frame.shape)
        for coefficient in response.coefficients[::-1]:
            total = total * frame + coefficient
        np.testing.assert_array_equal(response.correct(frame, flagged="keep"), total)

    # All pixels of a level's second frame are 1 DN higher, as under brighter light.
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_a_stored_dark_is_part_of_the_coefficients(self):
        rng = np.random.default_rng(9)
        dark = equipix.average(rng.integers(60, 62, (64, *SHAPE), dtype=np.uint16))
        raw = [np.rint(each + dark.mean) for each in curves(truth(2, rng))]
        levels = [
            equipix.average(np.stack([each, each + 1]).astype(np.uint16), dark=dark) for each in raw
        ]
        response = nuc.fit(levels, order=2)
        frame = raw[4]
        total = np.zeros(frame.shape)
        for coefficient in response.coefficients[::-1]:
            total = total * frame + coefficient
        corrected = response.correct(frame, flagged="keep")
        # Roundings of some terms of up to 4000 DN, in one polynomial and in the moved one.
        atol = 30 * EPS * 4000
        np.testing.assert_allclose(total, corrected, atol=atol)
        subtracted = response.correct(frame - dark.mean, dark=None, flagged="keep")
        np.testing.assert_allclose(subtracted, corrected, atol=atol)
        np.testing.assert_array_equal(response.correct(frame, dark=dark, flagged="keep"), corrected)

    def test_values_outside_of_the_levels_are_extrapolated_and_said_so(self):
        deviation = truth(2, np.random.default_rng(10))
        response = nuc.fit(curves(deviation), order=2)
        low, high = response.valid_range
        inside, outside = (low + high) / 2, np.stack([low - 1, high + 1])
        assert not response.extrapolated(inside).any()
        assert response.extrapolated(outside).all()
        assert response.extrapolated(np.full(SHAPE, np.nan)).all()
        corrected = response.correct(outside, exact=True, flagged="keep")
        slope = 1 + deviation[1] + 2 * deviation[2] * LEVELS[[0, -1]][:, None, None]
        wanted = response.levels[[0, -1]][:, None, None] + [[[-1]], [[1]]] / slope
        np.testing.assert_allclose(corrected, wanted, rtol=1e-9)


class TestBadPixels:
    @pytest.fixture
    def levels(self):
        return curves(truth(1, np.random.default_rng(11)))

    def test_a_dead_pixel_has_gain_minus_one_and_leaves_the_reference_alone(self, levels):
        plain = nuc.fit(levels, order=1)
        levels[:, 3, 4] = 77.0
        levels[:, 5, 6] = 0.4 * levels[:, 5, 6]
        response = nuc.fit(levels, order=1)
        dead = Flag.DEAD | Flag.DO_NOT_USE
        assert np.argwhere(response.flags == dead).tolist() == [[3, 4], [5, 6]]
        assert np.count_nonzero(response.flags) == 2
        assert response.deviation[1, 3, 4] == pytest.approx(-1, abs=1e-9)
        others = np.ones(SHAPE, bool)
        others[[3, 5], [4, 6]] = False
        means = [each[others].mean() for each in levels]
        np.testing.assert_allclose(response.levels, means, rtol=10 * EPS)
        assert np.abs(response.deviation[1] - plain.deviation[1])[others].max() < 1e-3

    def test_a_pixel_that_saturates_does_not_bend_the_others(self, levels):
        of_mean = NOISE.of_mean(400)
        levels = noisy(levels, np.random.default_rng(16), of_mean)
        levels[:, 3, 4] = np.minimum(1.9 * levels[:, 3, 4], 4000)
        others = np.ones(SHAPE, bool)
        others[3, 4] = False
        means = [each[others].mean() for each in levels]
        for variance in (of_mean, None):
            response = nuc.fit(levels, order=1, variance=variance)
            # Sums of 3071 values in another order.
            np.testing.assert_allclose(response.levels, means, rtol=3072 * EPS)

    def test_a_pixel_that_rises_twice_as_much_is_hot(self, levels):
        levels[:, 3, 4] *= 2.3
        response = nuc.fit(levels, order=1)
        assert response.flags[3, 4] == Flag.HOT | Flag.DO_NOT_USE

    @pytest.mark.parametrize("variance", [NOISE.of_mean(400), None])
    def test_a_pixel_is_judged_by_the_levels_at_which_it_does_not_saturate(self, levels, variance):
        levels = noisy(levels, np.random.default_rng(16), NOISE.of_mean(400))
        levels[:, 3, 4] *= 2.6
        levels[:, 8, 9] = np.minimum(1.3 * levels[:, 8, 9], 4095)
        levels[1:, 20, 30] = 4095
        levels[:, 3, 4] = np.minimum(levels[:, 3, 4], 4095)
        assert levels[7, 3, 4] == levels[7, 8, 9] == 4095
        response = nuc.fit(levels, order=1, saturation=4095, variance=variance)
        assert response.flags[3, 4] == Flag.HOT | Flag.DO_NOT_USE | Flag.SATURATED
        assert response.flags[8, 9] == Flag.SATURATED
        # One level shows no rise.
        assert not response.flags[20, 30] & Flag.HOT

    def test_a_value_that_is_missing_costs_one_level_of_its_pixel(self, levels):
        levels[7, 3, 4] = np.nan
        levels[1:, 8, 9] = np.nan
        response = nuc.fit(levels, order=1)
        assert response.flags[3, 4] == 0
        assert (response.used[3, 4], response.used[8, 9], response.used[0, 0]) == (7, 1, 8)
        assert (response.freedom[3, 4], response.freedom[8, 9], response.freedom[0, 0]) == (5, 0, 6)
        assert response.limits[1, 3, 4] == response.levels[6]
        assert response.limits[1, 0, 0] == response.levels[7]
        assert response.flags[8, 9] == Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE
        assert np.isnan(response.coefficients[:, 8, 9]).all()
        assert np.isfinite(response.coefficients).sum() == 2 * (48 * 64 - 1)

    def test_a_curve_that_falls_has_no_inverse(self, levels):
        x = np.linspace(-1, 1, 8)
        levels[:, 3, 4] = 2000 + 1500 * (2.5 * x**3 - 1.5 * x)
        response = nuc.fit(levels, order=3)
        assert response.flags[3, 4] == Flag.NONLINEAR | Flag.DO_NOT_USE
        corrected = response.correct(levels[3], flagged="keep")
        assert np.argwhere(np.isnan(corrected)).tolist() == [[3, 4]]
        replaced = response.correct(levels[3], flagged="replace")
        around = np.delete(replaced[2:5, 3:6].ravel(), 4)
        assert replaced[3, 4] == pytest.approx(around.mean())

    def test_saturated_samples_are_left_out_and_flagged(self, levels):
        frames = [np.repeat(np.rint(each)[None], 4, axis=0).astype(np.uint16) for each in levels]
        frames[7][0, 3, 4] = 4095
        averages = [equipix.average(each, saturation=4095) for each in frames]
        response = nuc.fit(averages, order=1, variance=np.full(8, 1 / 12))
        assert response.flags[3, 4] == Flag.SATURATED
        assert response.limits[1, 3, 4] == response.levels[6]
        assert response.saturation == 4095

    def test_a_pixel_that_saturates_at_each_level_is_hot(self, levels):
        levels[:, 3, 4] = 4095
        response = nuc.fit(levels, order=1, saturation=4095)
        stuck = Flag.HOT | Flag.DO_NOT_USE | Flag.SATURATED | Flag.NO_FLAT_FIELD
        assert response.flags[3, 4] == stuck
        # Neighbours that are as near to saturation do not show that it is stuck.
        response = nuc.fit(levels[6:], order=1, saturation=4095)
        assert response.flags[3, 4] == stuck & ~Flag.HOT

    def test_a_pixel_without_values_that_saturates_at_one_level_is_not_hot(self, levels):
        levels[:-1, 3, 4], levels[-1, 3, 4] = np.nan, 4095
        wanted = Flag.DO_NOT_USE | Flag.SATURATED | Flag.NO_FLAT_FIELD
        assert nuc.fit(levels, order=1, saturation=4095).flags[3, 4] == wanted
        # Nor is one whose dark is not known.
        levels[:-1, 3, 4] = levels[:-1, 3, 5]
        dark = np.full((4, *SHAPE), 10.0)
        dark[:, 3, 4] = np.nan
        frames = (np.repeat(np.rint(each)[None], 4, axis=0) for each in levels)
        dark = equipix.average(dark, saturation=4095)
        averages = [equipix.average(each, saturation=4095, dark=dark) for each in frames]
        response = nuc.fit(averages, order=1, variance=np.full(8, 1 / 12))
        assert response.flags[3, 4] == wanted

    def test_masked_pixels_are_undetermined(self, levels):
        mask = np.zeros(SHAPE, bool)
        mask[:, :5] = True
        response = nuc.fit(levels, order=1, mask=mask)
        np.testing.assert_array_equal(np.isnan(response.deviation[0]), mask)


class TestRefusals:
    @pytest.fixture
    def levels(self):
        return curves(truth(1, np.random.default_rng(12)))

    def test_too_few_levels(self, levels):
        with pytest.raises(errors.InputError, match=r"2 of 2 differ .* order 2 needs 3"):
            nuc.fit(levels[:2], order=2)

    def test_levels_that_do_not_differ(self, levels):
        with pytest.raises(errors.InputError, match=r"1 of 3 differ .*300, 300, 300 DN"):
            nuc.fit(levels[[0, 0, 0]], order=1)

    def test_levels_that_differ_by_less_than_the_noise(self, levels):
        close = levels[[0, 0]] + np.array([0, 5])[:, None, None]
        nuc.fit(close, order=1)
        with pytest.raises(errors.InputError, match=r"1 of 2 differ .*noise .*, 8.9 DN"):
            nuc.fit(close, order=1, variance=NOISE)

    def test_arrays_of_one_light_are_refused(self, levels):
        rng = np.random.default_rng(17)
        again = levels + rng.standard_normal(levels.shape)
        with pytest.raises(errors.InputError, match=r"2 of 3 differ .* order 2 needs 3"):
            nuc.fit([levels[0], levels[7], again[0]], order=2)
        with pytest.raises(errors.InputError, match=r"1 of 2 differ .* order 1 needs 2"):
            nuc.fit([levels[0], again[0]], order=1)

    def test_a_dark_brighter_than_a_level_is_named(self, levels):
        rng = np.random.default_rng(18)
        dark = equipix.average(noisy(np.repeat(levels[7][None], 4, axis=0), rng))
        frames = [noisy(np.repeat(levels[k][None], 4, axis=0), rng) for k in (0, 5)]
        averages = [equipix.average(each, dark=dark) for each in frames]
        with pytest.raises(errors.InputError, match="the dark is brighter than a level"):
            nuc.fit(averages, order=1)

    def test_a_dark_brighter_than_a_level_is_named_where_the_fit_goes_on(self, levels):
        rng = np.random.default_rng(19)
        offset, noise = levels[0] / 3, (4, *SHAPE)
        dark = equipix.average(offset + 2 * rng.standard_normal(noise))
        for shade, number in ((30.0, 1), (0.0, 0)):
            lights = (levels[5], offset - shade, levels[7])
            given = [
                equipix.average(each + 2 * rng.standard_normal(noise), dark=dark) for each in lights
            ]
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                nuc.fit(given, order=1)
            told = [each for each in said if each.category is errors.InputWarning]
            assert len(told) == number
            assert all("is -30" in str(each.message) for each in told)
            assert all("DN at level 1. Give" in str(each.message) for each in told)

    def test_the_noise_that_levels_do_not_exceed_is_the_median(self):
        level = 100 + 0.1 * np.random.default_rng(1).standard_normal(SHAPE)
        with pytest.raises(errors.InputError, match="1 of 3 differ by .* mean, 2 DN, but order 1"):
            nuc.fit([level, level, level], order=1, variance=np.array([1.0, 4.0, 900.0]))

    def test_levels_that_saturate(self, levels):
        clipped = np.minimum(np.rint(levels), 3100).astype(np.uint16)
        message = r"'levels': 1.2% .*expected 50% .*Level 7 has no value in 98.8%"
        with pytest.raises(errors.InputError, match=message):
            nuc.fit(clipped, order=1, saturation=3100)
        with pytest.raises(errors.InputError, match=r"'levels': level 6: 100.0% .* 2500 DN"):
            nuc.fit(np.minimum(clipped, 2500), order=1, saturation=2500)

    def test_clipped_values_without_a_level_given(self, levels):
        clipped = np.minimum(np.rint(levels), 3500).astype(np.float32)
        with pytest.warns(errors.InputWarning, match="exactly 3500"):
            nuc.fit(clipped, order=1)

    @pytest.mark.parametrize("form", ["float64", "uint16", "averages", "less a dark"])
    def test_a_whole_level_at_one_value_is_refused(self, levels, form):
        bright = np.rint(levels[[0, 3, 7]])
        bright[:, 3, 4] = 310  # a dead pixel is not saturated
        # The lowest value of the last level is far above 2500; dead ones are left.
        given = np.minimum(bright, 2500).astype("uint16" if form == "uint16" else "float64")
        if form in ("averages", "less a dark"):
            dark = None if form == "averages" else equipix.average(np.full((2, *SHAPE), 60.0))
            frames = [np.minimum(each + [[[-1]], [[1]]], 2500) for each in bright]
            given = [equipix.average(each, dark=dark) for each in frames]
        with pytest.raises(errors.InputError, match=r"100.0% .* of level 2 are exactly 2500,"):
            nuc.fit(given, order=1)

    def test_most_of_a_level_at_one_value_is_named(self, levels):
        clipped = np.minimum(levels[[0, 3, 7]], np.quantile(levels[7], 0.2))
        with pytest.warns(errors.InputWarning, match=r"80.0% .* of level 2 .*levels.toml"):
            nuc.fit(clipped, order=1)

    def test_even_levels_of_an_even_array_do_not_saturate(self, levels):
        even = np.broadcast_to(levels.mean(axis=(1, 2), keepdims=True), levels.shape)
        assert (nuc.fit(even, order=1).flags == 0).all()
        even = np.where(np.arange(len(levels))[:, None, None] == 7, 4095.0, even)
        with pytest.raises(errors.InputError, match="level 7 are exactly 4095"):
            nuc.fit(even, order=1)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"order": 4}, "'order' is 4"),
            ({"order": True}, "'order' is True"),
            ({"order": 1.0}, "'order' is 1.0"),
            ({"order": "two"}, "'order' is 'two'"),
            ({"mask": np.ones(SHAPE, bool)}, "'mask' excludes all pixels: give one"),
            ({"by": "both"}, "'by' is 'both'"),
            ({"order": 2, "by": "gain"}, "order 2 corrects offset and gain"),
            ({"order": "auto", "by": "gain"}, "order 'auto' corrects offset and gain"),
            ({"mask": np.zeros((2, 2), bool)}, "'mask' has shape"),
            ({"variance": np.ones(3)}, "'variance'"),
            ({"variance": np.ones((8, *SHAPE))}, r"expected \(8,\), .* or a NoiseModel"),
            ({"variance": np.zeros(8)}, "'variance' holds 0, expected .* above 0"),
            ({"variance": [-1] * 8}, "'variance' holds -1, expected .* above 0"),
            ({"variance": [np.nan] * 8}, "'variance' holds nan, expected .* above 0"),
            ({"variance": [1, 2]}, "'variance' has 2 entries, expected 8: one a level"),
            ({"variance": [NOISE] * 2}, "'variance' has 2 entries, expected 8: one a level"),
            (
                {"variance": 4.0},
                r"has shape \(\), expected \(8,\), one number for each level, or a NoiseModel$",
            ),
            ({"variance": np.ones(SHAPE)}, r"\(48, 64\), expected \(8,\), .* or a NoiseModel$"),
            ({"workers": 0}, "'workers'"),
            ({"saturation": -1}, "'saturation'"),
        ],
    )
    def test_wrong_arguments(self, levels, given, message):
        with pytest.raises(errors.InputError, match=message):
            nuc.fit(levels, **given)

    def test_a_level_without_a_value(self, levels):
        levels[3] = np.nan
        with pytest.raises(errors.InputError, match="Level 3 has no value in 100.0%"):
            nuc.fit(levels)
        with pytest.raises(errors.InputError, match=r"'levels' has shape \(0,\)"):
            nuc.fit([])
        with pytest.raises(
            errors.InputError, match="'levels' is one FrameStatistics, expected a list"
        ):
            nuc.fit(equipix.average(levels))

    def test_levels_of_other_shapes(self, levels):
        averages = [equipix.average(np.stack([each, each + 1])) for each in levels]
        averages[1] = equipix.average(np.ones((2, 5, 6)) * [[[3]], [[4]]])
        with pytest.raises(errors.InputError, match="'levels' holds means of shapes"):
            nuc.fit(averages)
        with pytest.raises(errors.InputError, match="'levels' has shape"):
            nuc.fit(levels[0])
        with pytest.raises(errors.InputError, match="'levels' mixes"):
            nuc.fit([averages[0], levels[1]])

    def test_raw_frames_in_place_of_means(self, levels):
        stacks = np.repeat(levels[:, None], 3, axis=1)
        for given in (stacks, list(stacks), [stacks[0], stacks[1][:2]]):
            with pytest.raises(errors.InputError, match="holds raw frames.*equipix.average"):
                nuc.fit(given)
        with pytest.raises(errors.InputError, match="holds iterators.*equipix.average"):
            nuc.fit([iter(each) for each in stacks])
        with pytest.raises(errors.InputError, match=r"shapes \(48, 64\) and \(48, 50\), expected"):
            nuc.fit([levels[0], levels[1][:, :50]])

    def test_a_gain_without_signal(self):
        with pytest.raises(errors.InputError, match="largest mean is -10 DN"):
            nuc.fit(np.full((1, *SHAPE), -10.0), order=0, by="gain")

    @pytest.mark.parametrize("sigma", [0.1, 2.0])
    def test_a_gain_needs_a_level_above_six_standard_deviations(self, sigma):
        even = 0.01 * sigma * np.random.default_rng(1).standard_normal((2, *SHAPE))
        dim, light = sigma * (even + np.array([5.9, 6.1])[:, None, None])
        variance = np.full(2, sigma**2)
        with pytest.raises(errors.InputError, match="which is no signal"):
            nuc.fit([dim], order=0, by="gain", variance=variance[:1])
        nuc.fit([light], order=0, by="gain", variance=variance[:1])
        nuc.fit([dim, light], order=0, by="gain", variance=variance)  # one with signal is enough


class TestRawAverages:
    """Raw frames: the offset is part of the curves, photon noise counts from the lowest level."""

    def averages(self, offset):
        rng = np.random.default_rng(13)
        deviation = truth(1, rng)
        frames = [
            np.rint(offset + noisy(np.repeat(each[None], 16, axis=0), rng)).astype(np.uint16)
            for each in curves(deviation)
        ]
        return [equipix.average(each) for each in frames]

    def test_the_goodness_of_fit_does_not_depend_on_the_offset(self):
        for offset in (200, 2000):
            response = nuc.fit(self.averages(offset), order=1)
            freedom = (len(LEVELS) - 2) * response.flags.size
            # Five standard errors of χ², and 1 % for the model of the noise.
            limit = 5 * np.sqrt(2 / freedom) + 0.01
            assert response.reduced_chi2.mean() == pytest.approx(1, abs=limit)
            assert np.count_nonzero(response.flags) == 0

    # All pixels of a level's second frame are 1 DN higher, as under brighter light.
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_a_gain_of_raw_averages_is_refused(self):
        raw = self.averages(200)[-1:]
        with pytest.raises(errors.InputError, match="'levels' are averages of raw frames"):
            nuc.fit(raw, order=0, by="gain")
        zero = equipix.average(np.full((2, *SHAPE), 200, np.uint16))
        subtracted = [equipix.average([raw[0].mean + each for each in (-1, 1)], dark=zero)]
        found = nuc.fit(subtracted, order=0, by="gain")
        np.testing.assert_allclose(1 + found.deviation[1], subtracted[0].mean / found.levels[0])

    def test_the_averages_given_are_not_changed(self):
        averaged = Averaged.of(self.averages(200))
        plain = averaged.noise
        response = nuc.fit(averaged, order=1)
        assert averaged.pedestal == 0
        assert averaged.noise is plain
        fresh = nuc.fit(self.averages(200), order=1)
        np.testing.assert_array_equal(response.variances, fresh.variances)

    def test_no_dark_can_replace_the_offset(self):
        response = nuc.fit(self.averages(200), order=1)
        assert response.raw
        with pytest.raises(errors.InputError, match="part of its curves"):
            response.correct(np.ones(SHAPE), dark=np.ones(SHAPE))


class TestMisfit:
    """The message names what the data leave as a cause."""

    def test_auto_is_not_recommended_where_it_was_given(self):
        rng = np.random.default_rng(21)
        levels = noisy(curves(truth(2, rng)), rng)
        with pytest.warns(errors.MisfitWarning, match="no other order predicts") as found:
            nuc.fit(levels, order="auto", variance=NoiseModel(read_noise=0.2, gain=0.0025))
        assert "order='auto'" not in str(found[0].message)

    def test_residuals_far_below_the_noise_are_named(self):
        rng = np.random.default_rng(22)
        levels = noisy(curves(truth(1, rng)), rng)
        with pytest.warns(errors.MisfitWarning, match=r"chi-square 0\.1.*limit 0.5"):
            nuc.fit(levels, order=1, variance=NoiseModel(read_noise=6.0, gain=2.25))

    @pytest.mark.parametrize("order", [1, 2])
    @pytest.mark.parametrize("cfa", [None, "RGGB"])
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_curves_of_the_next_order_are_named_from_where_it_pays(self, order, cfa):
        """The next coefficient, of variance 1 + s² by noise and spread, pays from s = 1 on."""
        rng = np.random.default_rng(23)
        exact = truth(order, rng)
        flat = nuc.fit(curves(exact), order=order + 1, variance=np.full(len(LEVELS), 25.0))
        sigma = np.sqrt(flat.variances[-1].mean())
        for times, expected in ((0.7, False), (1.4, True)):
            more = np.concatenate([exact, times * sigma * rng.standard_normal((1, *SHAPE))])
            levels = curves(more) + 5 * rng.standard_normal((len(LEVELS), *SHAPE))
            found = nuc.fit(levels, order=order, variance=np.full(len(LEVELS), 25.0), cfa=cfa)
            # Of f squares one has the variance 1 + s², so χ² alone, below 2, would name nothing.
            freedom, part = len(LEVELS) - order - 1, 1 + times**2
            scatter = np.sqrt(2 * (freedom - 1 + part**2) / np.prod(SHAPE)) / freedom
            chi2 = (freedom - 1 + part) / freedom
            assert found.reduced_chi2.mean() == pytest.approx(chi2, abs=5 * scatter)
            assert ("misfit" in [each.kind for each in found.findings]) is expected
        ratio = found.metadata["next_power"]["ratio"]
        pixels = SHAPE[0] * SHAPE[1] / (4 if cfa else 1)
        # Of a colour the largest of three ratios; its own error beside that of noise alone.
        assert ratio == pytest.approx(1 + times**2, rel=5 * 2.33 * np.sqrt(2 / pixels))
        assert f"order={order + 1} or order='auto'" in found.findings[-1].message

    @pytest.mark.parametrize("count", [3, 4])
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_the_error_of_the_ratio_of_the_next_order_is_that_of_its_medians(self, count):
        """Without residuals it is one median, and over those of one degree of freedom two."""
        rng, shape = np.random.default_rng(27), (24, 32)
        levels = curves(truth(1, rng, shape), LEVELS[:count])
        levels += 5 * rng.standard_normal(levels.shape)
        found = nuc.fit(levels, order=1, variance=np.full(count, 5.0)).metadata["next_power"]
        squares = rng.standard_normal((2000, count - 2, *shape)) ** 2
        medians = np.median(squares, axis=(2, 3)) / 0.4549
        ratios = medians[:, 0] / (medians[:, 1] if count > 3 else 1)
        # A standard deviation of 2000 values has 1.6 %, and a ratio of these adds (8 %)²/2.
        assert found["standard_error"] == pytest.approx(np.std(ratios), rel=4 / np.sqrt(4000))

    def test_no_order_is_named_where_noise_is_understated(self):
        rng = np.random.default_rng(24)
        levels = noisy(curves(truth(1, rng)), rng)
        with pytest.warns(errors.MisfitWarning, match="order 2 explains no more") as found:
            nuc.fit(levels, variance=NoiseModel(read_noise=1.0, gain=0.0625))
        assert "order=" not in str(found[0].message)

    def test_a_tenth_of_bent_pixels_does_not_bend_the_others(self):
        """V̄ bends with them, so that all others have a curvature in common."""
        rng = np.random.default_rng(26)
        noise = 5 * rng.standard_normal((len(LEVELS), *SHAPE))
        exact = truth(1, rng)
        flat = nuc.fit(curves(exact) + noise, order=2, variance=np.full(len(LEVELS), 25.0))
        bent = rng.permutation(exact[0].size).reshape(SHAPE) % 10 == 0
        deviation = np.concatenate([exact, np.zeros((1, *SHAPE))])
        deviation[2, bent] = 50 * np.sqrt(flat.variances[-1].mean())
        levels = levels_of(curves(deviation) + noise, variance=np.full(len(LEVELS), 25.0))
        # The median is then 5 standard deviations off 0, where the mean is. It lies at the quantile
        # 0.5/0.9 of the others, 0.14 standard deviations from their middle, and so does that of the
        # squares: 1.31 times that of noise.
        found = next_power(levels, 1, workers=1)
        assert found["ratio"] == pytest.approx(1.31, abs=5 * found["standard_error"])

    @pytest.mark.study
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_linear_sensors_get_no_order(self, draws, figure):
        said = 0
        seeds = draws(200)
        for seed in seeds:
            rng = np.random.default_rng([25, seed])
            count = int(rng.integers(3, 9))
            shape = (16, 20) if seed % 2 else (8, 8)
            levels = noisy(curves(truth(1, rng, shape), LEVELS[:count]), rng)
            # Noise that is stated too small, which three levels cannot distinguish from a curve.
            share = 1.0 if count == 3 else rng.uniform(0.5, 1.1)
            stated = NoiseModel(NOISE.read_noise * share, NOISE.gain * share**2)
            found = nuc.fit(levels, variance=stated)
            said += any("do not follow" in each.message for each in found.findings)
        figure("linear sensors whose next order is named", said / len(seeds), "at most 1 %")
        assert said <= 0.01 * len(seeds)
