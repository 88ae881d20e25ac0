"""Shift calibration: against the reference, against the truth, and by the laws it must obey."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import equipix
import reference
from equipix import Flag, errors, metrics, simulate
from reference import descent as reference_descent
from reference import model as reference_model

CROSS = equipix.cross_pattern(5, 7)
EPS = np.finfo(np.float64).eps
DESCENT = "coordinate-descent"
METHODS = ["multiscale", DESCENT]

pytestmark = pytest.mark.filterwarnings("ignore::equipix.errors.ConvergenceWarning")


def measured(shape, shifts=CROSS, *, noise=1e-3, seed=1, **options):
    """Exposures of a sensor with Gaussian noise, and its true sensitivity."""
    rng = np.random.default_rng(seed)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=3 * max(shape))
    frames = simulate.exposures(truth, beam, shifts, **options)
    return frames + noise * rng.standard_normal(frames.shape), truth / truth.mean()


@st.composite
def experiments(draw):
    """A small random experiment, in light that needs no prior: frames, positions and options."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rows, cols, count = draw(st.tuples(st.integers(1, 12), st.integers(1, 12), st.integers(2, 6)))
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    turned = draw(st.booleans())
    side = min(rows, cols) if turned else 0
    reach = np.array([side or rows, side or cols]) - 1
    variance = draw(st.sampled_from(["none", "exposures", "measurements"]))
    # Without variances what the model leaves is taken for noise.
    contrast = 0.01 if variance == "none" else 0.5
    given = draw(st.booleans())
    flux = rng.uniform(0.5, 2, count) if given else np.ones(count)
    frames = flux[:, None, None] * rng.uniform(1 - contrast, 1 + contrast, (count, rows, cols))
    frames = frames.astype(dtype)
    masked = draw(st.sampled_from(["none", "nan", "pixels", "measurements"]))
    options = {
        "rotation": rng.choice([0, 90, 180, 270], count) if turned else None,
        "flux": flux if given else None,
        "variance": {
            "none": None,
            "exposures": 1e-5 * rng.uniform(0.5, 2, count),
            "measurements": 1e-5 * rng.uniform(0.5, 2, frames.shape).astype(dtype),
        }[variance],
    }
    lost = rng.random(frames.shape) < 0.2
    lost[:, 0, 0] = False
    if masked == "nan":
        frames[lost] = np.nan
    elif masked != "none":
        options["mask"] = lost if masked == "measurements" else lost[0]
    layout = draw(st.sampled_from(["plain", "fortran", "every second", "read-only", "swapped"]))
    return laid_out(frames, layout), rng.integers(-reach, reach + 1, (count, 2)), options


def laid_out(frames, layout):
    """The same numbers in another memory layout."""
    if layout == "fortran":
        return np.asfortranarray(frames)
    if layout == "every second":
        wide = np.zeros((*frames.shape[:2], 2 * frames.shape[2]), frames.dtype)
        wide[..., ::2] = frames
        return wide[..., ::2]
    if layout == "swapped":
        return frames.astype(frames.dtype.newbyteorder())
    if layout == "read-only":
        frames.setflags(write=False)
    return frames


class TestAgainstReference:
    @pytest.mark.long
    @settings(max_examples=150, deadline=None)
    @given(experiments(), st.integers(1, 8))
    @pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
    # Few drawn numbers may look like colour filters.
    @pytest.mark.filterwarnings("ignore:the response repeats:equipix.errors.MisfitWarning")
    def test_the_same_sweeps_give_the_same_numbers(self, experiment, sweeps):
        frames, shifts, options = experiment
        got = equipix.calibrate(
            frames, shifts, method=DESCENT, max_sweeps=sweeps, tolerance=1e-300, **options
        )
        # What drawn numbers that look like colour filters see has weights of its own.
        assume(all(finding.kind != "cfa" for finding in got.findings))
        wanted = reference.coordinate_descent(frames, shifts, sweeps=sweeps, **options)
        # Each sweep takes two quotients of sums of at most n + 3 roundings each, of numbers of one
        # sign; their errors are averaged, not amplified, by the next. Twice that for the gauge.
        rounding = 8 * sweeps * (len(frames) + 3) * EPS
        single = np.finfo(np.float32).eps if frames.dtype.itemsize == 4 else 0
        np.testing.assert_array_equal(got.component_labels, wanted.component_labels)
        # In the gauge of the fit: that of the result leaves flagged pixels out of the mean.
        fit = got.weighted.fit
        np.testing.assert_allclose(fit.sensitivity, wanted.sensitivity, rtol=rounding + single)
        # The estimate puts L at its closed form for the last M.
        data = reference_model.problem(frames, shifts, **options)
        beam = reference_descent.best_beam(data, np.nan_to_num(wanted.sensitivity))
        seen = np.isfinite(beam)
        np.testing.assert_allclose(fit.beam.values[seen], beam[seen], rtol=rounding)
        assert got.beam_origin == tuple(wanted.beam_origin)
        # √F is a norm of residuals, so it is off by no more than L and M times that of the frames.
        # F is what the last step left of F before, the sum of as many parts as a pixel has
        # roundings; before the first step L is at its closed form, and F at most Σ w y².
        least = 1 if options["variance"] is None else options["variance"].min()
        squares = np.nansum(np.square(frames, dtype=float)) / least
        left = np.asarray(wanted.objective)
        off = rounding * np.sqrt(squares)
        allowed = off * (2 * np.sqrt(left) + off) + frames.size * EPS * left
        allowed += 2 * (len(frames) + 3) * EPS * np.array([squares, *left[:-1]])
        looked_at = got.history["sweep"].astype(int) - 1
        difference = np.abs(got.history["objective"] - left[looked_at])
        np.testing.assert_array_less(difference, allowed[looked_at])

    def test_sensitivity_has_the_precision_of_the_frames(self):
        frames, _ = measured((16, 18))
        assert equipix.calibrate(frames, CROSS).sensitivity.dtype == np.float64
        assert equipix.calibrate(frames.astype(np.float32), CROSS).sensitivity.dtype == np.float32

    def test_arrays_of_the_fit_are_read_only(self):
        # std_of, predict and a later start read them again.
        frames, _ = measured((16, 18))
        cal = equipix.calibrate(frames, CROSS + 0.25 * np.eye(5, 2), uncertainty=True)
        fit = cal.weighted.fit
        arrays = [cal.sensitivity, cal.beam, cal.beam_coefficients, cal.component_labels]
        arrays += [*cal.history.values(), fit.flags, fit.information(workers=1)]
        arrays += [fit.beam.light((16, 18), (0, 0), 0, workers=1)]
        for array in arrays:
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
            with pytest.raises(ValueError, match="WRITEABLE"):
                array.flags.writeable = True


class TestAgainstTruth:
    def test_without_noise_the_truth_comes_back_to_rounding(self):
        frames, truth = measured((40, 50), noise=0)
        cal = equipix.calibrate(frames, CROSS, tolerance=1e-13)
        assert cal.converged
        assert np.abs(cal.sensitivity / truth - 1).max() < 1e-12

    @pytest.mark.parametrize("turns", [(180,), (90, 270), (180, 90)])
    def test_turned_exposures(self, turns):
        shifts = np.vstack([CROSS, [(2, -3), (-1, 4)][: len(turns)]])
        rotation = [0] * 5 + list(turns)
        frames, truth = measured((30, 40), shifts, noise=0, rotation=rotation)
        cal = equipix.calibrate(frames, shifts, rotation=rotation, tolerance=1e-10)
        assert cal.converged
        assert np.abs(cal.sensitivity / truth - 1).max() < 1e-9

    def test_known_fluxes(self):
        flux = [1, 1.1, 0.9, 1.3, 0.7]
        frames, truth = measured((30, 40), noise=0, flux=flux)
        cal = equipix.calibrate(frames, CROSS, flux=flux, tolerance=1e-10)
        assert np.abs(cal.sensitivity / truth - 1).max() < 1e-9

    def test_noise_leaves_what_is_predicted(self):
        shape, noise = (60, 80), 1e-3
        beam = simulate.gaussian_beam(shape, width=240)
        expected, _ = simulate.noise_prediction(
            measured(shape)[1], beam, CROSS, noise**2, draws=8, rng=0
        )
        squares = []
        for seed in range(8):
            frames, truth = measured(shape, seed=seed, noise=noise)
            squares.append(np.mean((equipix.calibrate(frames, CROSS).sensitivity / truth - 1) ** 2))
        # Both are an rms over 8 × 4800 nearly white values, which scatters by 1/√(2·38400): four
        # standard deviations of their quotient.
        scatter = np.sqrt(2) / np.sqrt(2 * 8 * 4800)
        assert np.sqrt(np.mean(squares)) == pytest.approx(expected, rel=4 * scatter)

    def test_reduced_chi2_is_one_on_honest_noise(self):
        frames, _ = measured((80, 100), noise=2e-3)
        cal = equipix.calibrate(frames, CROSS, variance=np.full(5, 4e-6))
        freedom = 4 * 8000 - 107 * 87
        assert cal.reduced_chi2 == pytest.approx(1, abs=4 * np.sqrt(2 / freedom))
        unweighted = equipix.calibrate(frames, CROSS)
        assert unweighted.reduced_chi2 == pytest.approx(4e-6, rel=4 * np.sqrt(2 / freedom))


SYMMETRIES = pytest.mark.parametrize(
    ("change", "back"),
    [
        (lambda f, d: (f[::-1], d[::-1]), lambda m: m),
        (lambda f, d: (f.transpose(0, 2, 1), d[:, ::-1]), lambda m: m.T),
        (lambda f, d: (f[:, ::-1], d * [-1, 1]), lambda m: m[::-1]),
        (lambda f, d: (f[:, :, ::-1], d * [1, -1]), lambda m: m[:, ::-1]),
        (lambda f, d: (f, d + [3, -4]), lambda m: m),
        (lambda f, d: (1024 * f, d), lambda m: m),
    ],
    ids=["permuted", "transposed", "mirrored", "mirrored across", "moved", "brighter"],
)


class TestLaws:
    @pytest.mark.parametrize("method", METHODS)
    def test_the_objective_never_rises(self, method):
        frames, _ = measured((24, 30), noise=0.3)
        cal = equipix.calibrate(frames, CROSS, method=method, tolerance=1e-12)
        objective = cal.history["objective"]
        assert (np.diff(objective) <= 1e-13 * objective[0]).all()

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("workers", [2, 3, None])
    def test_the_same_bytes_for_any_number_of_workers(self, workers, method):
        frames, _ = measured((70, 90))
        options = {"rotation": [0, 90, 0, 180, 0], "method": method, "max_sweeps": 20}
        one = equipix.calibrate(frames, CROSS, workers=1, **options)
        many = equipix.calibrate(frames, CROSS, workers=workers, **options)
        assert one.sensitivity.tobytes() == many.sensitivity.tobytes()
        assert one.beam.tobytes() == many.beam.tobytes()
        assert one.objective == many.objective
        assert one.error_estimate == many.error_estimate

    @SYMMETRIES
    def test_symmetries_of_coordinate_descent(self, change, back):
        frames, _ = measured((25, 31))
        options = {"method": DESCENT, "max_sweeps": 30}
        plain = equipix.calibrate(frames, CROSS, **options).sensitivity
        changed = equipix.calibrate(*change(frames, CROSS), **options).sensitivity
        # The order of sums changes: as for the reference.
        np.testing.assert_allclose(back(changed), plain, rtol=8 * 30 * 8 * EPS)

    @SYMMETRIES
    def test_symmetries_of_the_minimum(self, change, back):
        frames, _ = measured((25, 31))
        plain = equipix.calibrate(frames, CROSS, tolerance=1e-11)
        changed = equipix.calibrate(*change(frames, CROSS), tolerance=1e-11)
        assert plain.converged
        assert changed.converged
        # Both are as far from the minimum as an estimate that is right within a factor 10 allows.
        np.testing.assert_allclose(back(changed.sensitivity), plain.sensitivity, rtol=2e-10)

    def test_a_beam_that_every_exposure_sees_alike_leaves_the_mean(self):
        frames, _ = measured((12, 14), shifts=np.zeros((2, 2), int))
        with pytest.warns(errors.IdentifiabilityWarning):
            cal = equipix.calibrate(frames[:2], np.zeros((2, 2), int))
        assert cal.components == 12 * 14


class TestErrorEstimate:
    @pytest.mark.study
    @pytest.mark.parametrize("sweeps", [100, 1000, 5000])
    def test_it_sees_the_large_scales_of_the_hard_case(self, sweeps):
        frames, truth = hard_case((582, 782))
        cal = equipix.calibrate(
            frames, equipix.cross_pattern(11, 19), method=DESCENT, max_sweeps=sweeps
        )
        true = np.abs(cal.sensitivity / truth - 1).max()
        assert 1 / 3 <= cal.error_estimate / true <= 10
        assert not cal.converged

    @pytest.mark.long
    def test_the_hard_case_converges(self):
        frames, truth = hard_case((240, 320))
        cal = equipix.calibrate(
            frames, equipix.cross_pattern(11, 19), method=DESCENT, tolerance=1e-4
        )
        assert cal.converged
        assert np.abs(cal.sensitivity / truth - 1).max() <= 3e-4

    @pytest.mark.parametrize("method", METHODS)
    def test_ended_by_max_sweeps_it_warns(self, method):
        frames, _ = measured((60, 80))
        with pytest.warns(errors.ConvergenceWarning, match="10 sweeps"):
            cal = equipix.calibrate(frames, CROSS, method=method, max_sweeps=10)
        assert not cal.converged
        assert cal.sweeps == 10
        assert cal.error_estimate > 1e-6

    @pytest.mark.parametrize("method", METHODS)
    def test_a_narrow_passage_is_noticed(self, method):
        """Two halves joined through a few rows: far slower than an open sensor of that size."""
        frames, truth = measured((48, 64), noise=0)
        truth = truth * np.where(np.arange(64) < 32, 1.02, 0.98)
        frames *= np.where(np.arange(64) < 32, 1.02, 0.98)
        mask = np.zeros((48, 64), bool)
        mask[:40, 28:36] = True
        cal = equipix.calibrate(
            frames, CROSS, mask=mask, method=method, tolerance=1e-5, max_sweeps=10**5
        )
        true = metrics.relative_error(cal.sensitivity, truth)
        assert cal.converged
        assert np.nanmax(np.abs(true)) < 10 * 1e-5


def hard_case(shape):
    """The standard hard case without noise: a sensor whose sensitivity varies at all scales."""
    truth = simulate.cosine_sensitivity(shape, rng=5)
    beam = simulate.gaussian_beam(shape, width=1000)
    return simulate.exposures(truth, beam, equipix.cross_pattern(11, 19)), truth / truth.mean()


class TestComponents:
    @pytest.mark.parametrize(
        ("shifts", "components"),
        [
            (equipix.cross_pattern(5, 7), 1),
            (equipix.cross_pattern(4, 6), 4),
            ([(0, 0), (5, 0), (0, 7)], 35),
            ([(0, 0), (11, 13), (19, 17), (30, 41)], 89),
        ],
    )
    @pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
    def test_known_patterns(self, shifts, components):
        frames, _ = measured((96, 120), shifts, noise=0)
        cal = equipix.calibrate(frames, shifts, max_sweeps=1)
        sizes = np.bincount(cal.component_labels.ravel())
        assert cal.components == len(sizes) == components
        assert (np.diff(sizes) <= 0).all()

    def test_each_component_is_solved_and_only_the_largest_is_given(self):
        shifts = equipix.cross_pattern(4, 6)
        frames, truth = measured((50, 61), shifts, noise=0)
        with pytest.warns(errors.IdentifiabilityWarning, match="4 parts"):
            cal = equipix.calibrate(frames, shifts, tolerance=1e-10)
        assert cal.converged
        largest = cal.component_labels == 0
        np.testing.assert_array_equal(np.isnan(cal.sensitivity), ~largest)
        np.testing.assert_allclose(
            cal.sensitivity[largest], truth[largest] / truth[largest].mean(), rtol=1e-9
        )
        undetermined = Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE
        np.testing.assert_array_equal(cal.flags, np.where(largest, 0, undetermined))

    def test_a_masked_pixel_is_left_out_and_spoils_nothing(self):
        frames, truth = measured((30, 40), noise=0)
        mask = np.zeros((30, 40), bool)
        mask[3, 5] = mask[20:23, 30] = True
        frames[:, mask] = 1e9
        cal = equipix.calibrate(frames, CROSS, mask=mask, tolerance=1e-10)
        assert (cal.component_labels[mask] == -1).all()
        assert np.isnan(cal.sensitivity[mask]).all()
        error = metrics.relative_error(cal.sensitivity, np.where(mask, np.nan, truth))
        assert np.nanmax(np.abs(error)) < 1e-9
        assert np.isnan(cal.beam).any()

    @pytest.mark.parametrize("method", METHODS)
    def test_dead_and_negative_pixels_are_solved_and_flagged(self, method):
        frames, truth = measured((30, 40), noise=0)
        frames[:, 4, 4] = 0
        frames[:, 9, 9] *= -0.01
        cal = equipix.calibrate(frames, CROSS, method=method, tolerance=1e-8)
        assert cal.converged
        assert abs(cal.sensitivity[4, 4]) < 1e-8
        truth[4, 4] = 0
        truth[9, 9] *= -0.01
        # The estimate is within a factor 10 of the true error.
        usable = (cal.flags & equipix.Flag.DO_NOT_USE) == 0
        wanted = truth / truth[usable].mean()
        np.testing.assert_allclose(cal.sensitivity, wanted, rtol=0, atol=10 * 1e-8)
        assert np.argwhere(cal.flags).tolist() == [[4, 4], [9, 9]]
        assert (cal.flags[[4, 9], [4, 9]] == Flag.DEAD | Flag.DO_NOT_USE).all()


class TestFrameStatistics:
    def test_weights_come_from_a_noise_model(self):
        rng = np.random.default_rng(8)
        shape, count, gain = (60, 80), 16, 0.3
        truth = simulate.paper_sensitivity(shape, rng=rng)
        beam = simulate.gaussian_beam(shape, width=60, amplitude=2000)
        means = simulate.exposures(truth, beam, CROSS)
        raw = [mean + rng.normal(0, np.sqrt(gain * mean), (count, *shape)) for mean in means]
        averages = [equipix.average(frames) for frames in raw]
        cal = equipix.calibrate(averages, CROSS)
        # Four standard deviations of chi2 over its degrees of freedom and of the fitted variance,
        # which stands on count − 1 degrees of freedom in each of 5 · 4800 measurements.
        deviation = np.sqrt(2 / (4 * 4800 - 67 * 87) + 2 / ((count - 1) * 5 * 4800))
        assert cal.reduced_chi2 == pytest.approx(1, abs=4 * deviation)
        weighted = equipix.calibrate(
            np.stack([a.mean for a in averages]), CROSS, variance=gain * means / count
        )
        scatter = np.std(metrics.relative_error(weighted.sensitivity, truth))
        difference = np.std(metrics.relative_error(cal.sensitivity, weighted.sensitivity))
        # Weights off by a fraction move M by that fraction of its scatter: here by what the noise
        # of the means and four standard deviations of the fitted variance make of them.
        off = np.sqrt(gain / count / means.min()) + 4 * np.sqrt(2 / ((count - 1) * 5 * 4800))
        assert difference < off * scatter

    def test_saturated_means_are_left_out_and_flagged(self):
        frames, truth = measured((30, 40), noise=0)
        raw = np.rint(frames[:, None] * 200).astype(np.uint8)
        raw[2, :, 5, 6] = 255
        averages = [equipix.average(each, dark=np.zeros(truth.shape)) for each in raw]
        cal = equipix.calibrate(averages, CROSS, variance=np.full(5, 1 / 12))
        assert np.argwhere(cal.flags == Flag.SATURATED).tolist() == [[5, 6]]
        # The other four exposures determine the pixel, to the rounding of 200 DN.
        assert cal.sensitivity[5, 6] == pytest.approx(truth[5, 6], abs=5 / 200)
