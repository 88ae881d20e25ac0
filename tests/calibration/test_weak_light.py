"""Pixels in weak light: always an answer, honest where there is light and where there is none."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
import reference
from equipix import Flag, simulate
from equipix.errors import ConvergenceWarning

CROSS = equipix.cross_pattern(11, 19)
SMALL_CROSS = equipix.cross_pattern(3, 5)
FRACTIONS = np.array([(0, 0), (0.3, 0.1), (0.2, 0.4), (0.45, 0.3), (0.1, 0.2)])
BETWEEN, SMALL_BETWEEN = CROSS + FRACTIONS, SMALL_CROSS + FRACTIONS
WEAK = Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE


def experiment(shape, beam, shifts=CROSS, *, noise=1e-3, seed=0):
    """Exposures with noise, and the true sensitivity."""
    rng = np.random.default_rng(seed)
    truth = 1 + rng.uniform(-0.05, 0.05, shape)
    frames = simulate.exposures(truth, beam, shifts)
    return frames + noise * rng.standard_normal(frames.shape), truth


def round_vignetting(rows, cols):
    """A lens that leaves the corners of 240×320 a thousandth of the light and less."""
    from_centre = np.hypot(rows - 120, cols - 160)
    return simulate.gaussian_beam((240, 320), width=600)(rows, cols) / (
        1 + np.exp((from_centre - 150) / 6)
    )


def dark_corner(rows, cols):
    """A corner with a hundred-thousandth of the light, 100 times below the noise."""
    return simulate.gaussian_beam((160, 200), width=400)(rows, cols) * np.where(
        (rows < 50) & (cols < 60), 1e-5, 1
    )


EXPERIMENTS = {
    "narrow beam": ((240, 320), simulate.gaussian_beam((240, 320), width=40), CROSS),
    "laser beam": ((160, 200), simulate.gaussian_beam((160, 200), width=45), CROSS),
    "round vignetting": ((240, 320), round_vignetting, CROSS),
    "dark corner": ((160, 200), dark_corner, CROSS),
    "laser beam, shifts between pixels": (
        (160, 200),
        simulate.gaussian_beam((160, 200), width=45),
        BETWEEN,
    ),
}


# Of the narrow beam most of the sensor sees nothing, which is said.
@pytest.mark.filterwarnings("ignore:the exposures determine only")
class TestAlwaysAnAnswer:
    @pytest.mark.long
    @pytest.mark.parametrize("name", EXPERIMENTS)
    def test_it_converges_and_errors_are_as_stated(self, name):
        shape, beam, shifts = EXPERIMENTS[name]
        frames, truth = experiment(shape, beam, shifts)
        cal = equipix.calibrate(frames, shifts, uncertainty=True)
        assert cal.converged
        assert cal.components == 1
        assert np.isfinite(cal.sensitivity).all()
        assert (cal.sensitivity_std > 0).all()
        good = (cal.flags & Flag.DO_NOT_USE) == 0
        np.testing.assert_array_equal((cal.flags[~good] & WEAK) == WEAK, True)
        assert cal.sensitivity[good].mean() == pytest.approx(1, abs=1e-9)
        error = cal.sensitivity - truth / truth[good].mean()
        # Those in use are known to 4 %.
        assert abs(error[good]).max() < 0.2
        # Of 76 800 normal values one is beyond 5 in one time of 20.
        z = error / cal.sensitivity_std
        assert abs(z[good]).max() < 5
        # In the dark M is near the mean, as the truth is.
        assert abs(z[~good]).max() < 5
        # The standard error of a mean square, and the exactness of 2 % of the map.
        limit = 5 * (2 / good.sum()) ** 0.5 + 2 * 0.02
        assert np.mean(z[good] ** 2) == pytest.approx(1, abs=limit)

    @pytest.mark.parametrize("name", ["laser beam", "round vignetting", "dark corner"])
    def test_without_noise_any_accuracy_is_reached(self, name):
        shape, beam, shifts = EXPERIMENTS[name]
        frames, truth = experiment(shape, beam, shifts, noise=0)
        cal = equipix.calibrate(frames, shifts, tolerance=1e-9)
        assert cal.converged
        assert not cal.flags.any()
        # The estimate is right within a factor 10.
        assert abs(cal.sensitivity - truth / truth.mean()).max() < 10 * 1e-9

    @pytest.mark.long
    def test_a_deviating_pixel_is_pulled_by_less_than_its_deviation_in_standard_deviations(self):
        shape, beam, shifts = EXPERIMENTS["laser beam"]
        found = []
        for deviation in (0, 0.3):
            truth = np.ones(shape)
            truth[40:120:2, 50:150:2] += deviation
            clean = simulate.exposures(truth, beam, shifts)
            noise = 1e-3 * np.random.default_rng(1).standard_normal(clean.shape)
            found.append(equipix.calibrate(clean + noise, shifts, uncertainty=True))
        even, uneven = found
        chosen = np.zeros(shape, bool)
        chosen[40:120:2, 50:150:2] = True
        chosen &= (uneven.flags & Flag.DO_NOT_USE) == 0
        # In the gauge of the pixels that do not deviate.
        level = uneven.sensitivity[60:100, 80:120][1::2, 1::2].mean()
        level /= even.sensitivity[60:100, 80:120][1::2, 1::2].mean()
        moved = uneven.sensitivity[chosen] / level - even.sensitivity[chosen]
        bias = abs(moved - 0.3)
        # The noise is that of one draw in both, but for its share at another M.
        assert (bias < 0.3 * 5 * even.sensitivity_std[chosen]).all()

    @pytest.mark.parametrize("width", [12, 20])
    def test_a_beam_on_a_small_part_of_the_sensor(self, width):
        shape = (180, 240)
        frames, truth = experiment(shape, simulate.gaussian_beam(shape, width=width), SMALL_CROSS)
        cal = equipix.calibrate(frames, SMALL_CROSS)
        assert cal.converged
        good = (cal.flags & Flag.DO_NOT_USE) == 0
        # Most pixels are in the dark, a bright one of all among them.
        assert 0.02 < good.mean() < 0.2
        error = cal.sensitivity - truth / truth[good].mean()
        # 5 standard deviations of at most 4 %, as of others in this light.
        assert abs(error[good]).max() < 0.2

    @pytest.mark.long
    @pytest.mark.filterwarnings(
        "ignore::equipix.errors.IdentifiabilityWarning",
        "ignore:no standard deviations:equipix.errors.ConvergenceWarning",
    )
    def test_light_below_its_noise_ends_with_the_cause(self):
        shape = (80, 100)
        beam = simulate.gaussian_beam(shape, width=25)
        # In the middle a measurement is 2.5 of its standard deviations.
        frames, _ = experiment(shape, beam, noise=0.4)
        with pytest.warns(ConvergenceWarning, match="too weak for its noise"):
            cal = equipix.calibrate(frames, CROSS, variance=np.full(5, 0.4**2), uncertainty=True)
        assert cal.is_partial
        assert not cal.converged
        # Some 2000 products, and the last step.
        assert cal.sweeps < 4000
        assert cal.sensitivity_std is None

    @pytest.mark.parametrize("noise", [0.15, 0.3, 0.45])
    def test_even_weak_light_needs_no_prior(self, noise):
        shape, block = (60, 80), np.s_[20:40, 20:60]
        rng = np.random.default_rng(0)
        truth = np.ones(shape)
        truth[block] = 1.5
        clean = simulate.exposures(truth, simulate.gaussian_beam(shape, width=300), CROSS)
        cal = equipix.calibrate(clean + noise * rng.standard_normal(clean.shape), CROSS)
        assert cal.converged
        # But for a pixel here and there that is as dark as if the light were.
        assert (cal.flags > 0).mean() < 2e-3
        # M of 800 and 1200 pixels of five exposures with this noise, the beam being found with it:
        # twice the variance that a known one leaves. Products of noise add its square.
        deviation = noise * (2 / 5 * (1 / 800 + 1.5**2 / 1200)) ** 0.5
        found = cal.sensitivity[block].mean() / cal.sensitivity[:15].mean()
        assert found == pytest.approx(1.5, abs=5 * deviation + noise**2 / 5)

    def test_even_weak_light_has_no_flags_but_large_standard_deviations(self):
        frames, _ = experiment((48, 64), simulate.gaussian_beam((48, 64), width=200), noise=0.1)
        cal = equipix.calibrate(frames, CROSS, variance=[0.01] * 5, uncertainty=True)
        # No D is a sixteenth of that of a bright pixel: nothing is flagged, though none has 4 %.
        assert not cal.flags.any()
        assert (cal.sensitivity_std > 0.04).all()

    @pytest.mark.parametrize("side", [27, 30])
    def test_masked_pixels_are_no_unknowns(self, side):
        """With a fifth of the sensor in use there are fewer measurements than pixels."""
        shape = (60, 60)
        frames, truth = experiment(shape, simulate.gaussian_beam(shape, width=120), SMALL_CROSS)
        mask = np.ones(shape, bool)
        mask[15 : 15 + side, 15 : 15 + side] = False
        cal = equipix.calibrate(frames, SMALL_CROSS, mask=mask)
        assert cal.weighted.fit.prior is None
        errors = (cal.sensitivity - truth / truth[~mask].mean())[~mask]
        # Of a pixel's noise of 1e-3 in five exposures, and the beam's as much again.
        assert np.sqrt(np.mean(errors**2)) < 2 * 1e-3 / 5**0.5 / 0.8

    @pytest.mark.parametrize("value", [50.0, np.nan])
    def test_values_of_masked_pixels_count_for_nothing(self, value):
        shape = (60, 80)
        frames, _ = experiment(shape, simulate.gaussian_beam(shape, width=200), SMALL_CROSS)
        mask = np.ones(shape, bool)
        mask[:, 38:42] = False
        changed = frames.copy()
        changed[:, mask] = value
        natural, cal = (equipix.calibrate(f, SMALL_CROSS, mask=mask) for f in (frames, changed))
        assert cal.converged
        np.testing.assert_array_equal(cal.sensitivity, natural.sensitivity)

    def test_pixels_in_the_dark_are_at_the_mean_of_lit_ones_between_pixels_too(self):
        shape = (100, 120)
        beam = simulate.gaussian_beam(shape, width=14)
        frames, _ = experiment(shape, beam, SMALL_BETWEEN, noise=2e-3)
        cal = equipix.calibrate(frames, SMALL_BETWEEN)
        assert cal.converged
        dark = np.ones(shape, bool)
        dark[15:-15, 15:-15] = False
        # M of the dark is that of its prior: μ, held after three steps, when M is within 1 %.
        assert np.median(cal.sensitivity[dark]) == pytest.approx(1, abs=0.01)

    def test_flags_do_not_depend_on_the_method(self):
        shape = (60, 80)
        rng = np.random.default_rng(0)
        truth = 1 + rng.uniform(-0.05, 0.05, shape)
        truth[:, 40:] *= 0.3
        clean = simulate.exposures(truth, simulate.gaussian_beam(shape, width=20), SMALL_CROSS)
        frames = clean + 4e-3 * rng.standard_normal(clean.shape)
        fast, swept = (
            equipix.calibrate(frames, SMALL_CROSS, method=method, tolerance=1e-7)
            for method in ("multiscale", "coordinate-descent")
        )
        assert fast.converged
        assert swept.converged
        assert 0.1 < (fast.flags > 0).mean() < 0.9
        np.testing.assert_array_equal(fast.flags, swept.flags)

    def test_one_pass_has_the_beam_that_fits_best(self):
        frames, _ = experiment((24, 32), simulate.gaussian_beam((24, 32), width=60), SMALL_CROSS)
        with pytest.warns(equipix.errors.ConvergenceWarning):
            cal = equipix.calibrate(frames, SMALL_CROSS, max_sweeps=1)
        cells, size, _ = reference.grid_cells((24, 32), SMALL_CROSS)
        above, below = (
            np.bincount(cells.ravel(), values.ravel(), size[0] * size[1])
            for values in (cal.sensitivity * frames, 0 * frames + cal.sensitivity**2)
        )
        seen = below > 0
        # Sums of at most five.
        wanted = above[seen] / below[seen]
        np.testing.assert_allclose(cal.beam.ravel()[seen], wanted, rtol=1e-14)

    def test_enough_light_changes_nothing(self):
        frames, _ = experiment((60, 80), simulate.gaussian_beam((60, 80), width=160), noise=1e-2)
        cal = equipix.calibrate(frames, CROSS)
        assert not cal.flags.any()
        assert cal.weighted.fit.prior is None


class TestTheMinimum:
    """On a sensor that NumPy can check pixel by pixel."""

    @staticmethod
    def slope(cal, frames):
        """What pulls at each M, of the frames and the prior, and the weight of both."""
        cells, shape, _ = reference.grid_cells(frames.shape[1:], SMALL_CROSS, None)
        m, size = cal.sensitivity, shape[0] * shape[1]
        above = np.bincount(cells.ravel(), (m * frames).ravel(), size)
        below = np.bincount(cells.ravel(), np.broadcast_to(m * m, frames.shape).ravel(), size)
        light = np.divide(above, below, where=below > 0, out=np.zeros(size))[cells]
        mean = m.mean()
        pull = cal.weighted.fit.prior * (1 - m / mean) / mean
        # μ is the mean of M.
        common = np.sum(pull * m) / np.sum(m)
        slope = np.sum(light * (frames - light * m), axis=0) + pull - common
        return slope, np.sum(light**2, axis=0) + cal.weighted.fit.prior / mean**2

    @pytest.mark.parametrize("seed", range(3))
    def test_it_ends_where_nothing_pulls(self, seed):
        beam = simulate.gaussian_beam((24, 32), width=7)
        frames, _ = experiment((24, 32), beam, SMALL_CROSS, noise=5e-3, seed=seed)
        options = {"tolerance": 1e-8}
        fast = equipix.calibrate(frames, SMALL_CROSS, **options)
        assert fast.converged
        assert (fast.weighted.fit.prior > 0).mean() > 0.1
        slope, weight = self.slope(fast, frames)
        # A sweep moves no M by more than the tolerance, right within a factor 10.
        assert abs(slope / weight).max() < 10 * 1e-8
        assert (np.diff(fast.history["objective"]) <= 1e-12 * fast.history["objective"][:-1]).all()

    @pytest.mark.parametrize("seed", range(3))
    def test_it_is_that_of_dense_algebra_and_of_sweeps(self, seed):
        shape, unit = (9, 11), 4e-4
        beam = simulate.gaussian_beam(shape, width=3)
        shifts = equipix.cross_pattern(1, 2)
        frames, _ = experiment(shape, beam, shifts, noise=unit**0.5, seed=seed)
        variance = np.full(len(frames), unit)
        options = {"variance": variance, "tolerance": 1e-9}
        fast = equipix.calibrate(frames, shifts, uncertainty=True, **options)
        swept = equipix.calibrate(frames, shifts, method="coordinate-descent", **options)
        assert fast.converged
        assert swept.converged
        prior = reference.weak_light_prior(frames, shifts, 1.0, variance=variance)
        assert 0.1 < (prior > 0).mean() < 1
        for cal in (fast, swept):
            np.testing.assert_allclose(cal.weighted.fit.prior, prior, rtol=1e-12, atol=0)
        wanted = reference.solve_dense(frames, shifts, variance=variance, prior=prior, steps=100)
        good = (fast.flags & Flag.DO_NOT_USE) == 0
        dense = wanted.sensitivity / wanted.sensitivity[good].mean()
        # Both estimates are right within a factor 10.
        np.testing.assert_allclose(fast.sensitivity, dense, rtol=0, atol=10 * 1e-9)
        np.testing.assert_allclose(swept.sensitivity, dense, rtol=0, atol=20 * 1e-9)
        objective = swept.history["objective"]
        assert (np.diff(objective) <= 1e-12 * objective[:-1]).all()

    def test_the_prior_follows_from_the_noise_not_from_the_unit(self):
        beam = simulate.gaussian_beam((24, 32), width=7)
        frames, _ = experiment((24, 32), beam, SMALL_CROSS, noise=5e-3)
        cal = equipix.calibrate(frames, SMALL_CROSS)
        scaled = equipix.calibrate(4096 * frames, SMALL_CROSS)
        np.testing.assert_array_equal(cal.flags, scaled.flags)
        np.testing.assert_allclose(cal.sensitivity, scaled.sensitivity, rtol=0, atol=2e-5)


class TestTheSun:
    """Nine discs, of unknown fluxes, at positions known to 0.3 pixels, masked outside the limb."""

    SIZE, RADIUS, NOISE = 512, 195, 0.02

    def disc(self, rows, cols):
        """A disc with limb darkening and a granulation of some 5 %."""
        rng = np.random.default_rng(5)
        y, x = rows - self.SIZE / 2, cols - self.SIZE / 2
        inside = 1 - (y**2 + x**2) / self.RADIUS**2
        granules = np.zeros(np.broadcast_shapes(rows.shape, cols.shape))
        for period, angle, phase in zip(*rng.uniform(0, 1, (3, 20)), strict=True):
            along = np.cos(np.pi * angle) * y + np.sin(np.pi * angle) * x
            granules += np.cos(2 * np.pi * (along / (8 + 17 * period) + phase))
        darkened = np.where(inside > 0, 0.4 + 0.6 * np.sqrt(np.maximum(inside, 0)), 0)
        return darkened * (1 + 0.05 * granules / 10**0.5)

    @pytest.mark.long
    @pytest.mark.filterwarnings(
        "ignore:free fluxes leave a tilt", "ignore:the residuals are", "ignore:residuals of"
    )
    def test_they_converge(self):
        rng = np.random.default_rng(0)
        shifts = 41 * reference_raster() + rng.uniform(-0.5, 0.5, (9, 2))
        truth = 1 + rng.uniform(-0.05, 0.05, (self.SIZE, self.SIZE))
        flux = np.exp(rng.normal(0, 0.03, 9))
        frames = simulate.exposures(truth, self.disc, shifts) * flux[:, None, None]
        frames += self.NOISE * rng.standard_normal(frames.shape)
        measured = shifts + 0.3 * rng.standard_normal(shifts.shape)
        rows, cols = np.mgrid[: self.SIZE, : self.SIZE] - self.SIZE / 2
        off = [np.hypot(rows + y, cols + x) > 0.97 * self.RADIUS for y, x in measured]
        cal = equipix.calibrate(
            frames,
            measured,
            mask=np.array(off),
            flux="fit",
            shift_std=0.3,
            variance=np.full(9, self.NOISE**2),
        )
        assert cal.converged
        # As many as for two ordinary joint fits.
        assert cal.sweeps <= 240


def reference_raster():
    """Nine positions, no two of which share a row or a column."""
    return np.array(
        [(0, 0), (1, 0.2), (-1, -0.3), (0.15, 1), (-0.2, -1)]
        + [(0.7, 0.7), (-0.8, 0.6), (0.6, -0.75), (-0.65, -0.8)]
    )


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the exposures determine only")
@pytest.mark.parametrize("name", ["narrow beam", "laser beam", "round vignetting", "dark corner"])
def test_a_dark_without_noise_flags_nothing_more(name):
    """The rule for the noise of the dark is that of the solver."""
    shape, beam, shifts = EXPERIMENTS[name]
    frames, _ = experiment(shape, beam, shifts)
    variance = np.full(5, 1e-6)
    without = equipix.calibrate(frames, shifts, variance=variance)
    exact = equipix.calibrate(frames, shifts, variance=variance, dark_variance=0)
    np.testing.assert_array_equal(exact.flags, without.flags)
