"""Bad pixels of a simulated array, each kind by its criterion."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

import equipix
from equipix import Flag, errors, metrics, nuc, simulate
from equipix.measured.colour import Colours
from equipix.measured.defects import blind_pixels, response_outliers
from equipix.measured.means import Averaged
from equipix.simulate import StaringArray

SHAPE = (48, 64)
LIGHT = np.linspace(2e6, 14e6, 6)
DEAD, WEAK, NOISY, FLICKER, HIGH, BENT = (3, 4), (9, 9), (12, 50), (30, 7), (40, 33), (20, 20)
LESS_WEAK, LESS_NOISY, LESS_HIGH, LESS_BENT = (9, 40), (25, 50), (40, 10), (20, 50)
"""Pixels on the good side of a limit: 0.6 of the response, 1.5 times the noise, 0.6 of the range,
a quarter of the χ² that chance allows."""


@pytest.fixture(scope="module")
def array():
    rng = np.random.default_rng(1)
    sensitivity = 1 + 0.02 * rng.standard_normal(SHAPE)
    sensitivity[DEAD], sensitivity[WEAK], sensitivity[LESS_WEAK] = 0.0, 0.4, 0.6
    noise = np.full(SHAPE, 500.0)
    # At 8e6 electrons photons and the ADC make some 2900: 2.5 and 1.5 times as much.
    noise[NOISY], noise[LESS_NOISY] = 7_000.0, 3_600.0
    offset = 300 + 30 * rng.standard_normal(SHAPE)
    # Three and four of the six levels lie below saturation: 0.4 and 0.6 of the range.
    offset[HIGH], offset[LESS_HIGH] = 10_500.0, 9_000.0
    curvature = np.full(SHAPE, 0.002)
    # χ² rises as the square of the difference: 40 and 4, where 13 is the limit.
    curvature[BENT], curvature[LESS_BENT] = 0.002 + 0.0033, 0.002 + 0.00105
    return StaringArray(
        shape=SHAPE,
        sensitivity=sensitivity,
        read_noise_e=noise,
        offset_dn=offset,
        curvature=curvature,
    )


def frames(array, light, count, rng):
    """Frames in which one pixel jumps between two levels."""
    rng = np.random.default_rng(rng)
    stack = np.stack(list(array.frames(light, count, rng=rng)))
    state = np.cumsum(rng.random(count) < 0.1) % 2
    stack[:, FLICKER[0], FLICKER[1]] += (30 * state).astype(np.uint16)
    return stack


@pytest.fixture(scope="module")
def response(array):
    levels = [
        equipix.average(frames(array, light, 32, k), saturation=16383)
        for k, light in enumerate(LIGHT)
    ]
    return nuc.fit(levels, order=1)


def places(flags, flag):
    return {(int(row), int(col)) for row, col in np.argwhere(flags & flag)}


class TestKinds:
    def test_each_bad_pixel_is_found_and_no_good_one(self, array, response):
        found = nuc.find_defects(response, frames(array, 8e6, 100, 99))
        assert places(found.flags, Flag.DEAD) == {DEAD, WEAK}
        # What jumps is noisy, too, and its levels lie on no line.
        assert places(found.flags, Flag.HOT) == {NOISY, FLICKER}
        assert places(found.flags, Flag.TELEGRAPH) == {FLICKER}
        assert places(found.flags, Flag.OTHER_BAD_PIXEL) == {HIGH}
        assert places(found.flags, Flag.NONLINEAR) == {BENT, FLICKER}
        bad = {DEAD, WEAK, NOISY, FLICKER, HIGH, BENT}
        assert places(found.flags, Flag.DO_NOT_USE) == bad
        assert found.counts["unusable"] == 6
        assert found.counts["dead"] == 2
        assert found.counts["non_responding"] == 1

    def test_a_sample_without_a_value_hides_no_bad_pixel(self, array, response):
        stack = frames(array, 8e6, 100, 99).astype(float)
        stack[0, 0, 0] = np.nan
        found = nuc.find_defects(response, stack)
        assert places(found.flags, Flag.HOT) == {NOISY, FLICKER}
        assert places(found.flags, Flag.TELEGRAPH) == {FLICKER}

    def test_frames_of_two_sensors_are_refused(self, array, response):
        other = dataclasses.replace(array, offset_dn=array.offset_dn[::-1])
        stack = np.concatenate([frames(array, 8e6, 100, 99), frames(other, 8e6, 8, 98)])
        with pytest.raises(errors.InputError, match="'frames' 99 and 100.* of two series or sens"):
            nuc.find_defects(response, stack)

    def test_a_cosmic_ray_is_no_other_series(self, array, response):
        stack = frames(array, 8e6, 100, 99).astype(np.float32)
        stack[40, 4:10, 4:10] += 20000.0
        stack[50:, 12, 12] += 4000.0
        nuc.find_defects(response, stack)

    def test_averages_show_noise_but_no_flicker(self, array, response):
        average = equipix.average(frames(array, 8e6, 100, 99))
        found = nuc.find_defects(response, average)
        assert found.counts["noisy"] == 2
        assert "flickering" not in found.counts

    def test_few_frames_do_not_determine_flicker(self, array, response):
        few = nuc.find_defects(response, frames(array, 8e6, 97, 99))
        assert few.not_determinable == {"flickering": "below 98 frames"}
        assert "flickering" not in few.counts
        # What was found nevertheless is flagged.
        assert places(few.flags, Flag.TELEGRAPH) == {FLICKER}
        enough = nuc.find_defects(response, frames(array, 8e6, 98, 99))
        assert (enough.not_determinable, enough.counts["flickering"]) == ({}, 1)
        loose = nuc.DefectLimits(correlation=2.5)
        assert not nuc.find_defects(
            response, frames(array, 8e6, 23, 99), limits=loose
        ).not_determinable

    def levels_with_jumps(self, seed):
        """Averages of frames with cosmic rays and 80 pixels that jump, and these pixels."""
        rng = np.random.default_rng(seed)
        jumps = rng.choice(64 * 80, 80, replace=False)
        truth, levels = 1 + 0.02 * rng.standard_normal((64, 80)), []
        for light in (500, 1500, 2500, 3500):
            stack = 100 + light * truth + 4 * rng.standard_normal((64, 64, 80))
            state = np.cumsum(rng.random((64, 80)) < 0.1, axis=0) % 2
            stack.reshape(64, -1)[:, jumps] += 40 * state
            rays = rng.random(stack.shape) < 1e-3
            stack[rays] += rng.uniform(100, 300, rays.sum())
            levels.append(equipix.average(stack, reject=5))
        return levels, jumps

    @pytest.mark.study
    def test_jumps_are_found_in_all_draws_and_no_good_pixel(self, draws, figure):
        share, false = [], 0
        for seed in draws(20):
            levels, jumps = self.levels_with_jumps(seed)
            found = np.flatnonzero(nuc.fit(levels, order=1).flags & Flag.DO_NOT_USE)
            share.append(np.isin(jumps, found).mean())
            false += np.count_nonzero(~np.isin(found, jumps))
        figure("share of jumping pixels found, reject=5, 64 frames", np.mean(share), "76 of 80")
        figure("good pixels flagged beside them", false, "0 of 100 800")
        # Of 5040 pixels a draw, each by a chance of 1e-7.
        assert (np.mean(share) >= 76 / 80, false) == (True, 0)

    def test_jumps_are_found_though_their_samples_are_left_out(self):
        levels, jumps = self.levels_with_jumps(8)
        response = nuc.fit(levels, order=1)
        # 76 of 80 in the prototype.
        found = np.flatnonzero(response.flags & Flag.HOT)
        assert set(found) <= set(jumps)
        assert len(found) >= 76
        unflagged = dataclasses.replace(response, flags=np.zeros_like(response.flags))
        found = np.flatnonzero(nuc.find_defects(unflagged, levels[2]).flags & Flag.HOT)
        assert set(found) <= set(jumps)
        assert len(found) >= 60

    def test_without_frames_the_curves_alone_count(self, response):
        found = nuc.find_defects(response)
        assert set(found.counts) == {
            "dead",
            "non_responding",
            "out_of_range",
            "nonlinear",
            "unusable",
        }

    def test_good_arrays_raise_no_alarm(self):
        array = StaringArray.of("InSb", (96, 128), rng=2)
        levels = [equipix.average(array.frames(light, 16, rng=k)) for k, light in enumerate(LIGHT)]
        response = nuc.fit(levels, order=2)
        found = nuc.find_defects(response, np.stack(list(array.frames(8e6, 30, rng=50))))
        assert found.counts["unusable"] == 0

    def test_the_distribution_of_the_gain_is_reported(self, response):
        found = nuc.find_defects(response).gain_percentiles
        assert list(found) == ["0.1", "1", "5", "25", "50", "75", "95", "99", "99.9"]
        values = list(found.values())
        assert values == sorted(values)
        # Normal with a spread of 0.02: the quartiles lie 0.6745 of it from the median.
        assert found["75"] - found["25"] == pytest.approx(2 * 0.6745 * 0.02, rel=0.1)


class TestTheArrayAsReference:
    """What all pixels have in common is no defect of pixels."""

    @pytest.mark.parametrize("count", [16, 200])
    def test_an_order_that_is_too_low_makes_no_bad_pixels(self, count):
        array = StaringArray.of("HgCdTe", SHAPE, rng=1)
        bent = np.array(array.curvature)
        # Ten times the spread: more than six, in an array whose own curvature misfits.
        bent[20, 20] = bent.mean() + 10 * bent.std()
        array = array.with_causes(curvature=bent)
        levels = [
            equipix.average(array.frames(light, count, rng=k)) for k, light in enumerate(LIGHT)
        ]
        too_low = r"order 1 .* order=2 or order='auto'"
        with pytest.warns(errors.MisfitWarning, match=too_low):
            response = nuc.fit(levels, order=1)
        with pytest.warns(errors.MisfitWarning, match=too_low):
            found = nuc.find_defects(response)
        assert found.misfit > 10
        assert places(found.flags, Flag.DO_NOT_USE) == {(20, 20)}
        better = nuc.find_defects(nuc.fit(levels, order=2))
        assert better.misfit < 2

    def test_missing_levels_cost_degrees_of_freedom(self):
        rng = np.random.default_rng(5)
        shape, lights = (100, 200), np.linspace(300.0, 3500.0, 8)
        sigma = np.full(8, 4.0)
        levels = lights[:, None, None] + 2 * rng.standard_normal((8, *shape))
        levels[3:, :, :80] = np.nan
        response = nuc.fit(levels, order=1, variance=sigma)
        assert set(np.unique(response.freedom)) == {1, 6}
        # Six standard deviations, a chance of 1e-9 each, in 20 000 pixels.
        assert nuc.find_defects(response).counts["nonlinear"] == 0

    def test_masked_pixels_are_undetermined_and_nothing_else(self, array):
        levels = [equipix.average(frames(array, light, 8, k)) for k, light in enumerate(LIGHT)]
        mask = np.zeros(SHAPE, bool)
        mask[:, 55:] = True
        found = nuc.find_defects(nuc.fit(levels, order=1, mask=mask))
        assert set(np.unique(found.flags[mask])) == {Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE}

    def test_a_shaded_source_makes_no_dead_corner_at_either_door(self):
        rows, cols = np.mgrid[-1:1:96j, -1:1:128j]
        shade = 1 - 0.375 * (rows**2 + cols**2)
        assert shade.min() == pytest.approx(0.25)
        rng = np.random.default_rng(6)
        lights = np.linspace(500.0, 3500.0, 5)[:, None, None]
        levels = lights * shade + rng.standard_normal((5, 96, 128))
        levels[:, 40, 50] = 0.4 * levels[:, 40, 50]
        response = nuc.fit(levels, order=1, variance=np.ones(5))
        found = nuc.find_defects(response)
        assert places(response.flags, Flag.DEAD) == places(found.flags, Flag.DEAD) == {(40, 50)}
        assert found.counts["dead"] == 1

    def test_noise_is_judged_by_that_of_the_signal(self):
        """Photon noise of a bright half is no fault of its pixels."""
        rng = np.random.default_rng(7)
        signal = np.where(np.arange(64) < 52, 400.0, 6400.0) * np.ones((48, 1))
        sigma = np.sqrt(signal) / 2
        sigma[5, 5] *= 2.6
        stack = signal + sigma * rng.standard_normal((64, 48, 64))
        levels = np.linspace(0.5, 1.5, 4)[:, None, None] * signal
        response = nuc.fit(levels, order=1)
        found = nuc.find_defects(response, stack)
        assert places(found.flags, Flag.HOT) - places(response.flags, Flag.HOT) == {(5, 5)}
        assert found.counts["noisy"] == 1


@pytest.mark.parametrize("foreign", [1, 16])
def test_frames_of_another_level_in_an_average_are_told(foreign):
    """As a glob such as level1* takes those of level 10."""
    rng = np.random.default_rng(3)
    truth = 1 + 0.02 * rng.standard_normal(SHAPE)
    stacks = [
        100 + light * truth + 3 * rng.standard_normal((16, *SHAPE))
        for light in range(500, 2501, 500)
    ]
    mixed = np.concatenate([stacks[0], stacks[-1][:foreign]])
    levels = [equipix.average(each) for each in (mixed, *stacks[1:])]
    with pytest.warns(errors.MisfitWarning, match=r"level 0: .* all frames are of one level"):
        nuc.fit(levels, order=1)


class TestRegions:
    """A median of a block is that of bad pixels where they fill most of it."""

    @pytest.mark.parametrize(
        "region",
        [np.s_[20:32, 36:48], np.s_[16:32, 32:48], np.s_[32:41], np.s_[:24, :24], np.s_[:, -9:]],
        ids=["12x12", "16x16", "nine rows", "a corner", "nine columns"],
    )
    def test_a_dead_region_is_found_and_no_good_pixel_beside_it(self, region):
        shape, rng = (72, 96), np.random.default_rng(11)
        dead = np.zeros(shape, bool)
        dead[region] = True
        truth = np.where(dead, 0.0, 1 + 0.02 * rng.standard_normal(shape))
        lights = np.linspace(500.0, 3500.0, 5)[:, None, None]
        levels = lights * truth + rng.standard_normal((5, *shape))
        response = nuc.fit(levels, order=1, variance=np.ones(5))
        for flags in (response.flags, nuc.find_defects(response).flags):
            np.testing.assert_array_equal((flags & Flag.DO_NOT_USE) != 0, dead)

    @pytest.mark.study
    def test_regions_of_any_size_and_place_are_found(self, draws, figure):
        found, lost = [], 0
        for seed in draws(100):
            rng, shape = np.random.default_rng(seed), (72, 96)
            dead = np.zeros(shape, bool)
            # Up to 30 pixels are less than half of the 5×5 blocks around, at the corners as well.
            rows, cols = rng.integers(1, 31, 2)
            top, left = rng.integers(0, shape[0] - rows + 1), rng.integers(0, shape[1] - cols + 1)
            dead[top : top + rows, left : left + cols] = True
            truth = np.where(dead, 0.0, 1 + 0.02 * rng.standard_normal(shape))
            lights = np.linspace(500.0, 3500.0, 3)[:, None, None]
            levels = lights * truth + rng.standard_normal((3, *shape))
            flagged = (nuc.fit(levels, order=1, variance=np.ones(3)).flags & Flag.DO_NOT_USE) != 0
            found.append(flagged[dead].mean())
            lost += np.count_nonzero(flagged & ~dead)
        figure("pixels found of dead regions of up to 30×30", np.mean(found), "all")
        figure("good pixels lost beside them", lost, "none")
        assert (min(found), lost) == (1, 0)

    def test_a_calibration_finds_it(self):
        shifts, rng = equipix.cross_pattern(11, 19), np.random.default_rng(11)
        truth = 1 + 0.02 * rng.standard_normal((72, 96))
        truth[20:32, 36:48] = 0
        beams = simulate.exposures(truth, simulate.gaussian_beam((72, 96)), shifts)
        noisy = 3000 * beams + rng.standard_normal(beams.shape)
        found = equipix.calibrate(noisy, shifts, variance=np.ones(5))
        np.testing.assert_array_equal((found.flags & Flag.DO_NOT_USE) != 0, truth == 0)

    @pytest.mark.parametrize("factor", [2, 2.5, 5])
    @pytest.mark.parametrize("edge", [64, 73, "oblique"])
    def test_no_good_pixel_beside_a_step_of_the_response_is_hot(self, factor, edge):
        """672 of 12 288 were, where the step does not lie between blocks; bad ones are found."""
        rng = np.random.default_rng(1)
        row, col = np.indices((96, 128))
        weak = col + 0.3 * row < 80 if edge == "oblique" else col < edge
        response = (1 + 0.02 * rng.standard_normal(weak.shape)) / np.where(weak, factor, 1)
        bad = np.zeros(weak.shape, bool)
        bad[5::40, [60, 62, 75, 90]] = True
        response[bad & weak] *= 6 * factor
        response[bad & ~weak] = 0
        dead, hot = response_outliers(response, lambda: np.full(weak.shape, 1e-3))
        np.testing.assert_array_equal(hot, bad & weak)
        assert dead[bad & ~weak].all()
        assert not dead[~bad].any()

    @staticmethod
    def outliers(usual, seed=1):
        """What is dead and hot among pixels of these responses, of 2 % scatter."""
        rng = np.random.default_rng(seed)
        response = usual * (1 + 0.02 * rng.standard_normal(usual.shape))
        response += 1e-4 * rng.standard_normal(usual.shape)
        return response_outliers(response, lambda: np.full(usual.shape, 1e-4))

    @pytest.mark.parametrize("edge", [56, 61, 64, 67])
    @pytest.mark.parametrize(
        ("side", "bad", "wanted"),
        [
            (0.0, 0.2, "dead"),
            (0.15, 0.1, "dead"),
            (0.15, 0.2, "dead"),
            (0.7, 0.4, "dead"),
            (1.3, 2.5, "hot"),
        ],
    )
    @pytest.mark.parametrize("size", [(1, 1), (2, 1), (2, 2), (3, 1)])
    def test_bad_pixels_beside_a_step_are_found(self, side, bad, wanted, edge, size):
        """With one neighbour alone to spare neither pixel of a pair was, of 0.1 beside 0.15."""
        usual = np.ones((96, 128))
        usual[:, :edge] = side
        for row, col in itertools.product(range(size[0]), range(size[1])):
            usual[20 + row :: 24, edge + col] = usual[31 + row :: 24, edge + 5 + col] = bad
        dead, hot = self.outliers(usual)
        found = {"dead": dead, "hot": hot}
        np.testing.assert_array_equal(found.pop(wanted)[:, edge:], usual[:, edge:] == bad)
        assert not found.popitem()[1][:, edge:].any()

    @pytest.mark.parametrize("angle", range(0, 360, 15))
    @pytest.mark.parametrize("factor", [2.5, 5])
    def test_beside_a_step_at_any_angle_no_good_pixel_is_bad(self, factor, angle):
        """At the border of the sensor up to 4 were."""
        row, col = np.indices((176, 176)) - 87.7
        side = np.cos(np.radians(angle)) * col + np.sin(np.radians(angle)) * row
        dead, hot = self.outliers(np.where(side < 0, 1 / factor, 1))
        assert (np.count_nonzero(dead), np.count_nonzero(hot)) == (0, 0)

    @pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (2, 2)])
    @pytest.mark.parametrize("edge", [56, 61, 64, 67])
    def test_hot_pixels_beside_a_step_leave_good_ones_good(self, edge, size):
        usual = np.ones((96, 128))
        usual[:, :edge] = 0.25
        for row, col in itertools.product(range(size[0]), range(size[1])):
            usual[20 + row :: 24, edge - 1 - col] = usual[31 + row :: 24, edge - 2 - col] = 2
        dead, hot = self.outliers(usual)
        np.testing.assert_array_equal(hot, usual == 2)
        assert not dead.any()

    @pytest.mark.parametrize("edge", [56, 61, 64, 67])
    @pytest.mark.parametrize("side", [0.0, -0.01])
    def test_beside_a_dead_half_no_good_pixel_is_bad(self, side, edge):
        """With a negative median all pixels there were hot."""
        usual = np.ones((96, 128))
        usual[:, :edge] = side
        dead, hot = self.outliers(usual)
        assert not hot.any()
        assert not dead[:, edge:].any()
        assert dead[:, 48:edge].all()

    def averages(self, truth, beam, shifts, seed=1):
        """Averages of 16 frames of noise of 3 DN."""
        rng = np.random.default_rng(seed)
        dark, *levels = [
            100 + each + 3 * rng.standard_normal((16, *truth.shape))
            for each in (0 * truth, *simulate.exposures(truth, beam, shifts))
        ]
        dark = equipix.average(np.rint(dark).astype(np.uint16))
        return [equipix.average(np.rint(each).astype(np.uint16), dark=dark) for each in levels]

    @pytest.mark.parametrize(
        "regions",
        [
            [np.s_[:9, :]],
            [np.s_[:, 60:70]],
            [np.s_[20:32, 30:42]],
            [np.s_[40:52, 84:96]],
            [np.s_[:9, :], np.s_[-9:, :], np.s_[:, :9], np.s_[:, -9:]],
        ],
        ids=["rows", "columns", "block", "block at the edge", "frame"],
    )
    def test_a_calibration_leaves_it_out_before_the_fit(self, regions):
        """Nine rows at the edge did not converge in 3000 passes; without any it takes 12."""
        shape, shifts = (90, 96), equipix.cross_pattern(7, 11)
        truth = simulate.paper_sensitivity(shape, rng=2)
        beam = simulate.gaussian_beam(shape, amplitude=8000, width=60)
        dead = np.zeros(shape, bool)
        for region in regions:
            dead[region] = True
        cal = equipix.calibrate(self.averages(np.where(dead, 0, truth), beam, shifts), shifts)
        assert cal.converged
        assert cal.sweeps <= 40
        np.testing.assert_array_equal((cal.flags & Flag.DEAD) > 0, dead)
        error = metrics.relative_error(np.where(dead, np.nan, cal.sensitivity), truth)
        assert np.nanstd(error) < 2e-3

    @pytest.mark.parametrize("edge", [1e-3, 15.0], ids=["sharp", "fading"])
    def test_what_has_no_light_in_the_beam_is_not_dead(self, edge):
        """A disc that ends within a pixel, and one that fades, moved over the sensor."""
        shape, shifts = (60, 80), equipix.cross_pattern(5, 7)

        def beam(row, col):
            radius = np.hypot(row - 30, col - 40)
            return 8000 / (1 + np.exp(np.clip((radius - 24) / edge, -500, 500)))

        averaged = Averaged.of(self.averages(np.ones(shape), beam, shifts))
        assert not blind_pixels(averaged.values, averaged.models(averaged.noise)).any()

    @pytest.mark.parametrize("given", [True, False])
    def test_pixels_of_a_weak_colour_are_not_dead(self, given):
        """With a twentieth of the light of green 339 of 1164 good blue pixels were."""
        shape, shifts = (60, 80), equipix.cross_pattern(5, 7)
        plain = simulate.paper_sensitivity(shape, rng=2)
        truth = simulate.filtered(plain, "RGGB", response={"R": 0.5, "G": 1, "B": 0.05})
        dead = np.zeros(shape, bool)
        dead[20:32, 30:42] = True
        beam = simulate.gaussian_beam(shape, amplitude=120, width=400)
        frames = self.averages(np.where(dead, 0, truth), beam, shifts)
        averaged = Averaged.of(frames, colours=Colours.of("RGGB") if given else None)
        found = averaged.bad_pixels(averaged.noise).dead
        # Blue pixels are no brighter than noise: only what dead ones enclose sets them apart.
        blue = Colours.of("RGGB").numbers(shape) == 2
        assert not (found & ~dead).any()
        assert found[dead & ~blue].all()

    @pytest.mark.parametrize(("shifts", "found"), [([(0, 5), (5, 0)], 0), ([(0, 5), (0, 11)], 800)])
    def test_a_shadow_is_dead_only_where_all_shifts_run_along_it(self, shifts, found):
        """The shadow of a wire, of ten rows; its pixels have no light in any exposure."""

        def beam(row, col):
            return np.where((row >= 30) & (row < 40), 0.0, 8000.0) + 0 * col

        averages = self.averages(np.ones((60, 80)), beam, [(0, 0), *shifts])
        averaged = Averaged.of(averages)
        blind = blind_pixels(averaged.values, averaged.models(averaged.noise))
        assert np.count_nonzero(blind) == found

    def test_a_hot_region_is_found(self):
        rng = np.random.default_rng(12)
        truth = 1 + 0.02 * rng.standard_normal(SHAPE)
        truth[18:30, 34:46] *= 3
        hot = np.argwhere(truth > 2).tolist()
        lights = np.linspace(500.0, 3500.0, 5)[:, None, None]
        response = nuc.fit(lights * truth, order=1)
        assert np.argwhere(response.flags & Flag.HOT).tolist() == hot


class TestLimits:
    def test_they_are_adjustable(self, response):
        strict = nuc.find_defects(response, limits=nuc.DefectLimits(response=0.98))
        # Below 0.98 of the median of 256 neighbours lies what is beyond one spread of a normal
        # distribution; six standard errors of a slope, which are 0.04 of the spread, make it
        # 14.9 %, of 3072 pixels ± 20; that of the medians and the two dead ones are less.
        assert strict.counts["dead"] == pytest.approx(0.149 * 48 * 64, abs=5 * 20)
        loose = nuc.find_defects(response, limits=nuc.DefectLimits(response=0.2))
        assert loose.counts["dead"] == 1

    def test_wrong_limits_are_refused(self):
        words = r"^'noise' \(--noise-limit\) is 0, expected more than 0$"
        with pytest.raises(errors.InputError, match=words):
            nuc.DefectLimits(noise=0)

    def test_wrong_frames_are_refused(self, response):
        with pytest.raises(errors.InputError, match=r"frames of \(4, 5\), the sensor"):
            nuc.find_defects(response, np.ones((3, 4, 5)))
        with pytest.raises(errors.InputError, match="holds one frame"):
            nuc.find_defects(response, equipix.average(np.ones((1, *SHAPE))))
        with pytest.raises(errors.InputError, match="hold no value"):
            nuc.find_defects(response, np.full((3, *SHAPE), np.nan))

    @pytest.mark.parametrize("value", [8000, 8000.5])
    def test_equal_frames_show_no_noisy_pixel(self, response, value):
        found = nuc.find_defects(response, np.full((98, *SHAPE), value))
        assert found.counts["noisy"] == found.counts.get("flickering", 0) == 0


class TestFlags:
    def test_they_combine_by_or_and_survive_saving(self, array, response, tmp_path):
        found = nuc.find_defects(response, frames(array, 8e6, 100, 99))
        flagged = response.with_flags(found.flags)
        np.testing.assert_array_equal(flagged.flags, response.flags | found.flags)
        flagged.save(tmp_path / "r.tif")
        loaded = equipix.load(tmp_path / "r.tif")
        np.testing.assert_array_equal(loaded.flags, flagged.flags)
        corrector = equipix.Corrector(loaded)
        assert corrector.replaced == 6
        raw = frames(array, 8e6, 2, 5)
        corrected = corrector.apply(raw)
        # Bad pixels are the mean of neighbours, so noise alone is left: of a frame, 2 % more by
        # rounding and by the error of the curves, with 5 standard errors of 3072 values.
        noise = np.median(frames(array, 8e6, 100, 99).std(axis=0, ddof=1))
        assert corrected.std(axis=(1, 2)) == pytest.approx(noise, rel=0.02 + 5 / np.sqrt(2 * 3072))
        assert np.ptp(corrected, axis=(1, 2)).max() < 12 * noise
        assert np.ptp(raw, axis=(1, 2)).min() > 1000 * noise

    def test_other_flags_are_refused(self, response):
        with pytest.raises(errors.InputError, match="'flags' is float64"):
            response.with_flags(np.zeros(SHAPE))
