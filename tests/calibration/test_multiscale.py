"""The multiscale method: as fast as claimed, and the same minimum as everything slower."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
import reference
from equipix import Flag, simulate
from equipix.errors import ConvergenceWarning, IdentifiabilityWarning

CROSS = equipix.cross_pattern(5, 7)
HARD_CROSS = equipix.cross_pattern(11, 19)
SMALL_CROSS = equipix.cross_pattern(2, 3)
WIDE_CROSS = [(0, 0), (0, 4), (0, 6), (4, 0), (6, 0)]
HARD = {
    "cross": ((7, 9), SMALL_CROSS, {}),
    "turned": ((9, 6), SMALL_CROSS, {"rotation": [0, 0, 90, 180, 270]}),
    "one axis": ((5, 12), [(0, 0), (0, 2), (0, 3)], {}),
    "one diagonal": ((8, 10), [(0, 0), (1, 1), (3, 3)], {}),
    "four components": ((9, 11), WIDE_CROSS, {}),
    "masked components": (
        (9, 11),
        WIDE_CROSS,
        {"mask": np.random.default_rng(5).random((5, 9, 11)) < 0.2},
    ),
    "eight components of three": ((4, 6), [(0, 0), (0, 2)], {}),
}
"""Sensors, shifts and options that a coarse space or a gauge could trip over."""

EPS = {dtype: float(np.finfo(dtype).eps) for dtype in ("float32", "float64")}


def hard_case(shape):
    """Exposures of a sensor whose sensitivity varies at all scales, and its true sensitivity."""
    truth = simulate.cosine_sensitivity(shape, rng=5)
    beam = simulate.gaussian_beam(shape, width=1000)
    return simulate.exposures(truth, beam, HARD_CROSS), truth / truth.mean()


def small_case(shape, shifts=CROSS, *, noise=1e-3, seed=1, rotation=None):
    """The same with noise, in a beam of the sensor's own width."""
    rng = np.random.default_rng(seed)
    truth = simulate.cosine_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=2 * max(shape))
    frames = simulate.exposures(truth, beam, shifts, rotation=rotation)
    return frames + noise * rng.standard_normal(frames.shape), truth / truth.mean()


def largest_difference(one, other):
    """Of two sensitivities that are NaN at the same pixels."""
    np.testing.assert_array_equal(np.isnan(one), np.isnan(other))
    return float(np.nanmax(abs(one - other)))


class TestTheHardCase:
    """Section 3 of the paper with a large-scale part: what takes 1e5 sweeps."""

    @pytest.mark.parametrize("shape", [(240, 320), (582, 782)])
    def test_a_certified_1e_6_takes_32_products(self, shape):
        frames, truth = hard_case(shape)
        cal = equipix.calibrate(frames, HARD_CROSS)
        assert cal.converged
        assert cal.error_estimate <= 1e-6
        assert abs(cal.sensitivity / truth - 1).max() < 1e-6
        # Without a first step in logarithms it takes 36, without waves in the coarse space 59.
        assert cal.sweeps <= 32

    @pytest.mark.parametrize("shape", [(240, 320), (582, 782)])
    def test_in_single_precision_too(self, shape):
        frames, truth = hard_case(shape)
        single = frames.astype(np.float32)
        cal = equipix.calibrate(single, HARD_CROSS)
        assert cal.converged
        # Without the waves in the coarse space it takes 59.
        assert cal.sweeps <= 45
        # What the rounding of the data does, and then that of the result.
        exact = equipix.calibrate(single.astype(np.float64), HARD_CROSS, tolerance=1e-10)
        rounding = abs(exact.sensitivity / truth - 1).max() + EPS["float32"]
        assert abs(cal.sensitivity / truth - 1).max() < 1e-6 + rounding

    @pytest.mark.parametrize("response", [0.1, 0.01])
    @pytest.mark.parametrize(
        ("shape", "shifts"), [((40, 60), equipix.cross_pattern(2, 3)), ((120, 160), CROSS)]
    )
    def test_a_half_that_responds_weakly(self, shape, shifts, response):
        truth = simulate.paper_sensitivity(shape, rng=1).copy()
        truth[:, : shape[1] // 2] *= response
        frames = simulate.exposures(truth, simulate.gaussian_beam(shape, width=1000), shifts)
        cal = equipix.calibrate(frames, shifts)
        assert cal.converged
        assert cal.sweeps <= 60
        # The gauge is the mean over usable pixels, without those flagged beside the weak half.
        usable = (cal.flags & equipix.Flag.DO_NOT_USE) == 0
        relative = cal.sensitivity / truth * truth[usable].mean() - 1
        assert abs(relative).max() < 1e-6 / response

    def test_dead_pixels_take_no_longer(self):
        frames, truth = hard_case((120, 160))
        usual = equipix.calibrate(frames, HARD_CROSS).sweeps
        dead = np.random.default_rng(3).random(truth.shape) < 0.01
        frames[:, dead] = 0
        cal = equipix.calibrate(frames, HARD_CROSS)
        assert cal.converged
        assert cal.sweeps <= 1.2 * usual
        np.testing.assert_array_equal(cal.flags & Flag.DEAD > 0, dead)

    @pytest.mark.long
    def test_the_number_of_products_does_not_depend_on_the_size(self):
        shapes = [(240, 320), (582, 782), (1164, 1564)]
        products = [equipix.calibrate(hard_case(shape)[0], HARD_CROSS).sweeps for shape in shapes]
        assert max(products) <= 1.2 * min(products)

    @pytest.mark.long
    @pytest.mark.parametrize(("noise", "gaps"), [(1e-3, "dark pixels"), (1e-2, "masked")])
    @pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
    def test_the_minimum_is_that_of_ten_thousand_sweeps(self, noise, gaps):
        frames, _ = hard_case((240, 320))
        rng = np.random.default_rng(3)
        options = {}
        if gaps == "masked":
            options["mask"] = rng.random(frames.shape) < 0.2
        else:
            dark = rng.random(frames.shape[1:]) < 1e-3
            frames[:, dark] *= rng.uniform(-0.02, 0.02, np.count_nonzero(dark))
        frames += rng.uniform(-noise, noise, frames.shape)
        cal = equipix.calibrate(frames, HARD_CROSS, **options)
        assert cal.converged
        with pytest.warns(ConvergenceWarning):
            swept = equipix.calibrate(
                frames,
                HARD_CROSS,
                method="coordinate-descent",
                max_sweeps=10_000,
                tolerance=1e-300,
                **options,
            )
        assert cal.objective == pytest.approx(swept.objective, rel=1e-9)
        assert largest_difference(cal.sensitivity, swept.sensitivity) < 1e-6


@pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
class TestAgainstReference:
    """On sensors that dense algebra can hold, with everything that may differ by measurement."""

    @staticmethod
    def experiment(seed):
        rng = np.random.default_rng(seed)
        shape = tuple(rng.integers(3, 10, 2))
        count = int(rng.integers(2, 7))
        turned = rng.random() < 0.4
        reach = np.full(2, min(shape)) if turned else np.array(shape)
        shifts = rng.integers(-reach // 2, reach // 2 + 1, (count, 2))
        rotation = rng.choice([0, 90, 180, 270], count) if turned else None
        frames, _ = small_case(shape, shifts, noise=1e-2, seed=seed, rotation=rotation)
        frames[:, 1, 1] *= rng.choice([1, -0.1])
        variance = [None, rng.uniform(0.5, 2, count), rng.uniform(0.5, 2, frames.shape)]
        options = {
            "flux": rng.uniform(0.9, 1.1, count) if rng.random() < 0.5 else None,
            "variance": variance[rng.integers(3)],
            "rotation": rotation,
            "mask": rng.random(frames.shape) < rng.choice([0, 0.1]),
        }
        frames = frames.astype(rng.choice(["float32", "float64"]))
        return frames, shifts, options

    # 17, 23, 34 and 36 have many small components and a negative pixel.
    @pytest.mark.parametrize("seed", range(40))
    def test_it_finds_the_dense_minimum(self, seed):
        frames, shifts, options = self.experiment(seed)
        wanted = reference.solve_dense(frames, shifts, **options)
        cal = equipix.calibrate(frames, shifts, tolerance=1e-10, **options)
        np.testing.assert_array_equal(cal.component_labels, wanted.component_labels)
        assert cal.converged
        # The estimate is right within a factor 10.
        atol = 10 * 1e-10
        single = EPS["float32"] if frames.dtype == np.float32 else 0
        # In the gauge of the fit: that of the result leaves flagged pixels out of the mean.
        found = cal.weighted.fit.sensitivity
        np.testing.assert_allclose(found, wanted.sensitivity, rtol=single, atol=atol)
        # F is stationary: an error of 1e-9 of the values costs its square.
        # Variances are kept in the precision of the frames.
        floor = 1e-18 * float(np.sum(np.square(frames, dtype=np.float64)))
        rel = 1e-9 + single
        assert cal.objective == pytest.approx(wanted.objective[-1], rel=rel, abs=floor)

    @pytest.mark.parametrize("noise", [0, 1e-3, 1e-2])
    @pytest.mark.parametrize("case", HARD)
    def test_so_it_does_where_a_coarse_space_or_a_gauge_could_fail(self, case, noise):
        shape, shifts, options = HARD[case]
        rotation = options.get("rotation")
        frames, _ = small_case(shape, shifts, noise=noise, rotation=rotation)
        wanted = reference.solve_dense(frames, shifts, **options)
        cal = equipix.calibrate(frames, shifts, tolerance=1e-10, **options)
        assert cal.converged
        # As above.
        found = cal.weighted.fit.sensitivity
        np.testing.assert_allclose(found, wanted.sensitivity, rtol=0, atol=10 * 1e-10)

    @pytest.mark.parametrize("value", [0, -0.05])
    @pytest.mark.parametrize("noise", [0, 1e-3, 1e-2])
    def test_so_it_does_with_dead_and_negative_pixels(self, value, noise):
        frames, _ = small_case((7, 9), SMALL_CROSS, noise=noise)
        rng = np.random.default_rng(3)
        for row, col in ((3, 4), (0, 0), (6, 8)):
            frames[:, row, col] *= value
            frames[:, row, col] += noise * rng.standard_normal(5)
        wanted = reference.solve_dense(frames, SMALL_CROSS)
        cal = equipix.calibrate(frames, SMALL_CROSS, tolerance=1e-10)
        assert cal.converged
        found = cal.weighted.fit.sensitivity
        np.testing.assert_allclose(found, wanted.sensitivity, rtol=0, atol=10 * 1e-10)


@pytest.mark.filterwarnings(
    "ignore::equipix.errors.IdentifiabilityWarning", "ignore::equipix.errors.ConvergenceWarning"
)
class TestAnyPattern:
    """It converges to the minimum, or says that it did not."""

    @staticmethod
    def check(frames, shifts, **options):
        cal = equipix.calibrate(frames, shifts, tolerance=1e-8, max_sweeps=20_000, **options)
        assert cal.converged == (cal.error_estimate <= 1e-8)
        objective = cal.history["objective"]
        assert (np.diff(objective) <= 1e-12 * objective[:-1] + 1e-20).all()
        if cal.converged:
            # A sweep of coordinate descent leaves the minimum where it is.
            assert TestAnyPattern.slope(cal, frames, shifts, **options) < 10 * 1e-8
        return cal

    @staticmethod
    def slope(cal, frames, shifts, *, rotation=None):
        """Largest change of M, in the largest component, by one sweep from the end of `cal`."""
        cells, grid_shape, _ = reference.grid_cells(frames.shape[1:], shifts, rotation)
        sums = [np.zeros(grid_shape).ravel() for _ in range(2)]
        inside = cal.component_labels == 0
        m = np.where(inside, cal.sensitivity, 0)
        for frame, cell in zip(frames, cells, strict=True):
            np.add.at(sums[0], cell[inside], (m * frame)[inside])
            np.add.at(sums[1], cell[inside], (m * m)[inside])
        beam = np.divide(*sums, where=sums[1] > 0, out=np.zeros_like(sums[0]))
        above = sum(beam[cell] * frame for frame, cell in zip(frames, cells, strict=True))
        below = sum(beam[cell] ** 2 for cell in cells)
        return abs(above[inside] / below[inside] - m[inside]).max()

    @pytest.mark.parametrize("count", [2, 3, 4, 7, 20, 50])
    @pytest.mark.parametrize("seed", range(3))
    def test_two_to_fifty_exposures_up_to_half_a_sensor_apart(self, count, seed):
        shape = (40, 56)
        rng = np.random.default_rng([count, seed])
        shifts = rng.integers((-10, -14), (11, 15), (count, 2))
        frames, _ = small_case(shape, shifts, seed=seed)
        cal = self.check(frames, shifts)
        assert cal.converged or count < 5

    def test_repeated_positions(self):
        shifts = np.repeat(CROSS, 3, axis=0)
        frames, _ = small_case((30, 40), shifts)
        assert self.check(frames, shifts).converged

    def test_the_same_position_throughout(self):
        frames, _ = small_case((12, 14), np.zeros((3, 2), int))
        cal = self.check(frames, np.zeros((3, 2), int))
        assert cal.converged
        assert cal.components == 12 * 14

    @pytest.mark.parametrize("shifts", [[(0, 0), (0, 3), (0, 4)], [(0, 0), (1, 1), (3, 3)]])
    def test_along_one_line(self, shifts):
        frames, _ = small_case((24, 60), shifts)
        assert self.check(frames, shifts).converged

    @pytest.mark.parametrize("shape", [(1, 40), (40, 1), (2, 30), (7, 5)])
    def test_narrow_sensors(self, shape):
        shifts = np.minimum(CROSS, np.array(shape) // 2)
        frames, _ = small_case(shape, shifts)
        assert self.check(frames, shifts).converged

    @pytest.mark.parametrize("shape", [(40, 40), (36, 50)])
    @pytest.mark.parametrize("turns", [(180,), (90, 270), (90, 180, 270)])
    def test_rotated_exposures(self, shape, turns):
        rng = np.random.default_rng(len(turns))
        shifts = np.vstack([CROSS, rng.integers(-8, 9, (len(turns), 2))])
        rotation = [0] * 5 + list(turns)
        frames, _ = small_case(shape, shifts, rotation=rotation)
        assert self.check(frames, shifts, rotation=rotation).converged

    def test_nearly_periodic_modes(self):
        # Differences of 10 and 11 only: ripples of that length are nearly the same in all.
        shifts = equipix.cross_pattern(10, 11)
        frames, _ = small_case((50, 60), shifts)
        self.check(frames, shifts)


class TestSingularCoarseMatrices:
    def test_each_piece_is_solved_in_its_own_gauge(self):
        shifts = equipix.cross_pattern(4, 6)
        frames, truth = small_case((50, 61), shifts, noise=0)
        with pytest.warns(IdentifiabilityWarning, match="4 parts"):
            cal = equipix.calibrate(frames, shifts, tolerance=1e-10)
        assert cal.converged
        largest = cal.component_labels == 0
        wanted = np.where(largest, truth / truth[largest].mean(), np.nan)
        # The estimate is right within a factor 10.
        assert largest_difference(cal.sensitivity, wanted) < 10 * 1e-10
        # In the beam every piece shows, in its gauge: in each, M of it has mean 1.
        labels = cal.component_labels
        row, col = cal.beam_origin
        seen = cal.beam[row : row + 50, col : col + 61]
        for label in range(4):
            piece = labels == label
            mean = (frames[0] / seen)[piece].mean()
            assert mean == pytest.approx(1, abs=10 * 1e-10)

    def test_islands_of_a_mask(self):
        frames, truth = small_case((60, 80), noise=0)
        mask = np.zeros((60, 80), bool)
        mask[26:34] = True
        mask[:, 36:44] = True
        with pytest.warns(IdentifiabilityWarning):
            cal = equipix.calibrate(frames, CROSS, mask=mask, tolerance=1e-10)
        assert cal.converged
        largest = cal.component_labels == 0
        wanted = np.where(largest, truth / truth[largest].mean(), np.nan)
        assert largest_difference(cal.sensitivity, wanted) < 10 * 1e-10

    def test_a_mask_that_empties_coarse_cells(self):
        shape = (120, 150)
        frames, truth = small_case(shape, noise=0)
        mask = np.zeros(shape, bool)
        # The hats are 3 · 7 pixels apart and twice as wide: none of their weight is left here.
        mask[30:80, 40:100] = True
        cal = equipix.calibrate(frames, CROSS, mask=mask, tolerance=1e-10)
        assert cal.converged
        wanted = np.where(mask, np.nan, truth / truth[~mask].mean())
        assert largest_difference(cal.sensitivity, wanted) < 10 * 1e-10

    def test_a_dark_corner(self):
        shape = (60, 80)
        truth = simulate.cosine_sensitivity(shape, rng=1)
        beam = simulate.gaussian_beam(shape, width=160)

        def vignetted(rows, cols):
            return beam(rows, cols) * np.where((rows < 20) & (cols < 30), 1e-5, 1)

        frames = simulate.exposures(truth, vignetted, CROSS)
        cal = equipix.calibrate(frames, CROSS)
        assert cal.converged
        # Without noise pixels of a weight of 1e-10 are determined too.
        assert not cal.flags.any()
        assert abs(cal.sensitivity / truth * truth.mean() - 1).max() < 10 * 1e-6


# The frames have no noise, their variances do.
@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
class TestAlmostNoWeight:
    """Pixels whose weight is below a millionth of the mean."""

    PIXELS = np.s_[[13, 20, 30], [14, 31, 49]]

    @pytest.mark.parametrize("method", ["multiscale", "coordinate-descent"])
    def test_they_are_flagged_and_spoil_nothing_else(self, method):
        frames, _ = small_case((40, 50))
        variance = np.ones(frames.shape)
        variance[:, *self.PIXELS] = 1e10
        frames[:, *self.PIXELS] = np.random.default_rng(2).uniform(-9, 9, (5, 3))
        without = np.zeros((40, 50), bool)
        without[self.PIXELS] = True
        options = {"method": method, "tolerance": 1e-9}
        cal = equipix.calibrate(frames, CROSS, variance=variance, **options)
        apart = equipix.calibrate(frames, CROSS, mask=without, **options)
        assert cal.converged
        flag = Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE
        np.testing.assert_array_equal((cal.flags & flag) == flag, without)
        assert not cal.flags[~without].any()
        # Weights of 1e-10 move the others by that share of the noise of these pixels, 9.
        atol = 2 * 10 * 1e-9 + 9e-10
        np.testing.assert_allclose(
            cal.sensitivity[~without], apart.sensitivity[~without], rtol=0, atol=atol
        )

    def test_they_take_their_closed_form_with_the_prior(self):
        frames, _ = small_case((40, 50))
        variance = np.ones(frames.shape)
        variance[:, *self.PIXELS] = 1e10
        frames[:, *self.PIXELS] *= 1.5
        cal = equipix.calibrate(frames, CROSS, variance=variance, tolerance=1e-9)
        prior = cal.weighted.fit.prior
        assert prior is not None
        for row, col in np.transpose(self.PIXELS):
            seen = np.array([cal.beam[row + down, col + right] for down, right in CROSS])
            # The prior is a measurement of the mean, of M = 1 to 1e-8 here, of this weight.
            weight = 1e10 * prior[row, col]
            wanted = (seen @ frames[:, row, col] + weight) / (seen @ seen + weight)
            assert cal.sensitivity[row, col] == pytest.approx(wanted, abs=10 * 1e-9 + 2e-8)
