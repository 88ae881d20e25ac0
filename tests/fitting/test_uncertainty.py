"""Error bars: against dense algebra, against simulated experiments, and their laws."""

from __future__ import annotations

import json
from typing import ClassVar

import numpy as np
import pytest

import equipix
import reference
from equipix import Flag, simulate
from equipix.cli import main
from equipix.errors import IdentifiabilityWarning, InputError
from equipix.plan import tilt_std

CROSS = equipix.cross_pattern(2, 3)
DRAWS_EXACT_TO = 0.02
"""The relative standard error of the map that draws go on to ..."""
MOST_DRAWS = 400
"""... if there are no more than these."""


def case(seed, *, shape=(12, 14), rotation=None, masked=0.0, shifts=CROSS):
    """Frames of a small sensor with noise of known, uneven variance, and their options."""
    rng = np.random.default_rng([seed, 41])
    truth = simulate.paper_sensitivity(shape, rng=rng)
    flux = rng.uniform(0.9, 1.1, len(shifts))
    beam = simulate.gaussian_beam(shape, width=2 * shape[0])
    frames = simulate.exposures(truth, beam, shifts, rotation=rotation, flux=flux)
    variance = 1e-6 * rng.uniform(0.5, 2, frames.shape)
    frames += np.sqrt(variance) * rng.standard_normal(frames.shape)
    mask = rng.random(frames.shape) < masked
    return frames, {"variance": variance, "mask": mask, "flux": flux, "rotation": rotation}


def dense(cal, frames, options, shifts=CROSS):
    return reference.covariance(frames, shifts, cal.sensitivity, cal.beam, **options)


TURNED = [0, 0, 90, 180, 270]
CASES = {
    "cross": {},
    "masked": {"masked": 0.1},
    "turned": {"shape": (11, 13), "rotation": TURNED},
    "turned and masked": {"shape": (12, 12), "rotation": TURNED, "masked": 0.1},
    "three exposures": {"shifts": [(0, 0), (0, 1), (1, 0)]},
}


@pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
class TestAgainstDenseAlgebra:
    @pytest.mark.parametrize("seed", [1, 2])
    @pytest.mark.parametrize("name", CASES)
    def test_the_map(self, name, seed):
        frames, options = case(seed, **CASES[name])
        shifts = CASES[name].get("shifts", CROSS)
        cal = equipix.calibrate(frames, shifts, uncertainty=True, **options)
        std = np.sqrt(np.diag(dense(cal, frames, options, shifts))).reshape(cal.shape)
        np.testing.assert_array_equal(np.isnan(cal.sensitivity_std), np.isnan(cal.sensitivity))
        error = (cal.sensitivity_std / std - 1)[np.isfinite(std)]
        made = cal.metadata["uncertainty"]
        stated = made["relative_standard_error"]
        assert stated <= DRAWS_EXACT_TO or made["draws"] == MOST_DRAWS
        # On so small a sensor a few slow errors make all pixels scatter together: three standard
        # errors, both of the rms and of the mean.
        assert np.sqrt(np.mean(error**2)) < 3 * stated

    @pytest.mark.parametrize("seed", [1, 2])
    @pytest.mark.parametrize("name", CASES)
    def test_functionals(self, name, seed):
        frames, options = case(seed, **CASES[name])
        shifts = CASES[name].get("shifts", CROSS)
        cal = equipix.calibrate(frames, shifts, **options)
        known = np.isfinite(cal.sensitivity)
        rng = np.random.default_rng(seed)
        weights = np.array([rng.standard_normal(cal.shape), np.ones(cal.shape)]) * known
        over_m = (weights / np.where(known, cal.sensitivity, 1)).reshape(2, -1)
        covariance = np.nan_to_num(dense(cal, frames, options, shifts))
        wanted = np.sqrt(np.einsum("ip,pq,iq->i", over_m, covariance, over_m))
        got = cal.std_of(weights)
        # The variance lacks 1e-4 at most, and single precision has 24 bits.
        np.testing.assert_allclose(got, wanted, rtol=1e-4)
        assert cal.std_of(weights[0]) == got[0]


def lowest_modes(shape, used, count=12):
    """Cosines over the sensor, the longest ones, as weights of means over the pixels used."""
    v, u = ((np.arange(size) + 0.5) / size for size in shape)
    waves = sorted(((i, j) for i in range(count) for j in range(count)), key=np.linalg.norm)
    modes = [np.outer(np.cos(np.pi * i * v), np.cos(np.pi * j * u)) for i, j in waves[1:]]
    return np.array(modes[:count]) * used / used.sum()


def blocks(shape, used, size=16):
    """Means over square blocks, as weights."""
    rows, cols = shape[0] // size, shape[1] // size
    number = np.add.outer(np.arange(shape[0]) // size * cols, np.arange(shape[1]) // size)
    weights = (number == np.arange(rows * cols)[:, None, None]) * used
    return weights / weights.sum(axis=(1, 2), keepdims=True)


def mean_square_scores(clean, shifts, truth, used, experiments, rng, **options):
    """Mean squares of errors over their deviations: of pixels, 16×16 means and long cosines.

    The noise of each experiment has the variance 1e-6 of the signal.
    """
    variance = 1e-6 * clean
    weights = [blocks(truth.shape, used), lowest_modes(truth.shape, used)]
    options |= {"variance": variance, "mask": ~used}
    errors, std = [], None
    for _ in range(experiments):
        frames = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)
        cal = equipix.calibrate(frames, shifts, uncertainty=std is None, **options)
        # Of a hundred right experiments one has the tilt of a drift in its error bars.
        if std is None and not (cal.drift and cal.drift.is_added):
            std, of_weights = cal.sensitivity_std, [cal.std_of(each) for each in weights]
        errors.append(np.where(used, cal.sensitivity - truth, 0))
    sums = np.zeros(3)
    for error in errors:
        logarithm = np.where(used, np.log1p(error / truth), 0).ravel()
        sums[0] += np.mean((error / std)[used] ** 2)
        for which, (each, scale) in enumerate(zip(weights, of_weights, strict=True)):
            z = each.reshape(len(each), -1) @ logarithm / scale
            sums[which + 1] += np.mean(z**2)
    return sums / experiments


def check_scores(mean_squares, sensors, experiments, figure):
    """The limits of the design for 200 experiments, which several sensors share.

    `mean_squares` gives those of one sensor, by its number and that of its experiments.
    By chance: 4e-4 over 3.84e6 pixels, plus the map's own 2 % squared; over 200 × 12 modes 0.014,
    over blocks, which share slow errors, as much.
    """
    each = min(experiments, 200 // sensors)
    numbers = range(-(-experiments // each))
    squares = np.mean([mean_squares(number, each) for number in numbers], axis=0)
    slow = 0.05 * np.sqrt(200 / (each * len(numbers)))
    limits = {"pixels": 0.03, "16×16 means": slow, "long cosines": slow}
    for (name, limit), z in zip(limits.items(), np.sqrt(squares), strict=True):
        figure(f"z of {name}", z, f"1 ± {limit:.2f}")
        assert z == pytest.approx(1, abs=limit)


class TestAgainstSimulatedExperiments:
    """Four sensors of 120 rows and 160 columns, fifty experiments each."""

    # One of a thousand right experiments shows a drift.
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    @pytest.mark.study
    @pytest.mark.parametrize("masked", [0, 0.02])
    def test_z_scores(self, masked, draws, figure):
        def mean_squares(seed, experiments):
            return self.mean_squares(seed, masked, experiments)

        check_scores(mean_squares, 4, len(draws(200)), figure)

    @staticmethod
    def mean_squares(seed, masked, experiments, *, shape=(120, 160)):
        rng = np.random.default_rng([seed, 42, int(100 * masked)])
        truth = simulate.paper_sensitivity(shape, rng=rng)
        used = rng.random(shape) >= masked
        truth /= truth[used].mean()
        shifts = equipix.cross_pattern(11, 19)
        clean = simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
        return mean_square_scores(clean, shifts, truth, used, experiments, rng)

    @pytest.mark.long
    def test_no_unbiased_estimate_could_be_better(self):
        ratios = []
        for seed in range(4):
            rng = np.random.default_rng([seed, 43])
            truth = simulate.paper_sensitivity((16, 20), rng=rng)
            truth /= truth.mean()
            clean = simulate.exposures(truth, simulate.gaussian_beam(truth.shape, width=30), CROSS)
            _, grid, (row, col) = reference.grid_cells(truth.shape, CROSS)
            rows, cols = np.arange(grid[0])[:, None] - row, np.arange(grid[1]) - col
            beam = simulate.gaussian_beam(truth.shape, width=30)(rows, cols)
            bound = reference.covariance(clean, CROSS, truth, beam, variance=np.full(5, 1e-6))
            errors = [
                equipix.calibrate(clean + 1e-3 * rng.standard_normal(clean.shape), CROSS)
                for _ in range(100)
            ]
            power = np.mean([(cal.sensitivity - truth) ** 2 for cal in errors])
            ratios.append(power / np.mean(np.diag(bound)))
        # The rms over 4 × 100 × 320 values, of which slow errors leave a tenth to count, scatters
        # by 0.6 %.
        assert np.sqrt(np.mean(ratios)) <= 1.02


@pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
class TestLaws:
    def test_the_same_bytes_for_any_number_of_workers(self):
        for options in ({}, {"rotation": TURNED, "shape": (16, 20)}):
            frames, options = case(3, masked=0.05, **options)
            one, three = (
                equipix.calibrate(frames, CROSS, uncertainty=True, workers=workers, **options)
                for workers in (1, 3)
            )
            np.testing.assert_array_equal(one.sensitivity_std, three.sensitivity_std)
            np.testing.assert_array_equal(one.tilt_std, three.tilt_std)

    def test_scales_with_the_noise_and_not_with_the_light(self):
        frames, options = case(4)
        cal = equipix.calibrate(frames, CROSS, uncertainty=True, **options)
        options["variance"] = options["variance"] * 4 * 1e6
        brighter = equipix.calibrate(1e3 * frames, CROSS, uncertainty=True, **options)
        # Two solutions to 1e-6, and single precision; draws are the same.
        np.testing.assert_allclose(brighter.sensitivity_std, 2 * cal.sensitivity_std, rtol=1e-3)
        np.testing.assert_allclose(brighter.tilt_std, 2 * cal.tilt_std, rtol=1e-4)

    def test_without_variance_the_residuals_tell_it(self):
        frames, options = case(5)
        options["variance"] = np.ones(len(frames))
        given = equipix.calibrate(frames, CROSS, uncertainty=True, **options)
        options["variance"] = None
        cal = equipix.calibrate(frames, CROSS, uncertainty=True, **options)
        scale = np.sqrt(cal.reduced_chi2)
        np.testing.assert_allclose(cal.sensitivity_std, scale * given.sensitivity_std, rtol=1e-14)
        weights = np.zeros(cal.shape)
        weights[3, 4] = 1
        assert cal.std_of(weights) == pytest.approx(scale * given.std_of(weights), rel=1e-14)

    def test_a_constant_weighs_what_the_gauge_leaves_of_it(self):
        cal = equipix.calibrate(*_with(case(6)))
        weights = cal.sensitivity / cal.sensitivity.size
        # Σ M·δ ln M is the mean of M itself, which is 1: rounding of sums in single precision.
        alone = np.zeros(cal.shape)
        alone[0, 0] = 1 / cal.sensitivity.size
        assert cal.std_of(weights) < 1e-3 * cal.std_of(alone)


def _with(frames_and_options):
    """Positional arguments of calibrate, for cases without keywords."""
    frames, _ = frames_and_options
    return frames, CROSS


class TestTilt:
    SHAPE = (40, 50)

    def test_is_the_slope_from_edge_to_edge(self):
        v, u = ((np.arange(size) + 0.5) / size - 0.5 for size in self.SHAPE)
        truth = np.exp(np.add.outer(0.01 * v, -0.02 * u))
        frames = simulate.exposures(truth, simulate.gaussian_beam(self.SHAPE, width=60), CROSS)
        cal = equipix.calibrate(frames, CROSS, tolerance=1e-9)
        # Solved to 1e-9 of M; the slope from edge to edge is at most six times the largest error.
        np.testing.assert_allclose(cal.tilt, [0.01, -0.02], rtol=0, atol=1e-8)

    # One of a thousand right experiments shows a drift.
    @pytest.mark.study
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_scatters_as_tilt_std_says(self, draws):
        clean = simulate.exposures(
            np.ones(self.SHAPE), simulate.gaussian_beam(self.SHAPE, width=60), CROSS
        )
        rng = np.random.default_rng(44)
        scores = []
        for index in draws(150):
            frames = clean + 1e-3 * rng.standard_normal(clean.shape)
            options = {"variance": np.full(5, 1e-6), "uncertainty": index == 0}
            cal = equipix.calibrate(frames, CROSS, **options)
            if index == 0:
                std = cal.tilt_std
            scores.append(cal.tilt / std)
        # Three standard errors of the rms of as many pairs.
        error = 3 / np.sqrt(4 * len(scores))
        assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1, abs=error)

    @pytest.mark.study
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_drift_tilts_as_the_formula_says(self, draws):
        shape, shifts = (60, 80), equipix.cross_pattern(5, 7)
        clean = simulate.exposures(np.ones(shape), simulate.gaussian_beam(shape), shifts)
        rng = np.random.default_rng(45)
        drift = 1e-3
        tilts = []
        for _ in draws(200):
            flux = np.exp(drift * rng.standard_normal(5))
            tilts.append(equipix.calibrate(clean * flux[:, None, None], shifts).tilt)
        std = tilt_std(shape, shifts, flux_std=drift)
        # Three standard errors of each rms of as many draws.
        error = 3 / np.sqrt(2 * len(tilts))
        assert np.std(tilts, axis=0) / std == pytest.approx(1, abs=error)

    def test_an_error_of_a_shift_in_a_slope_counts_as_one_of_flux(self):
        shifts = equipix.cross_pattern(11, 19)
        by_flux = tilt_std((582, 782), shifts, flux_std=1e-4)
        slope = (1e-4 / 0.05, 0)
        by_shift = tilt_std((582, 782), shifts, shift_std=0.05, beam_slope=slope)
        np.testing.assert_allclose(by_shift, by_flux, rtol=1e-12)
        both = tilt_std(
            (582, 782), shifts, flux_std=np.full(5, 1e-4), shift_std=0.05, beam_slope=slope
        )
        np.testing.assert_allclose(both, np.sqrt(2) * by_flux, rtol=1e-12)

    def test_drift_of_the_design(self):
        # DESIGN: at 782×582 with cross (11, 19) drift of 1e-4 makes 2.0e-3 rms.
        tilt = tilt_std((582, 782), equipix.cross_pattern(11, 19), flux_std=1e-4)
        assert np.hypot(*tilt) / np.sqrt(12) == pytest.approx(2.0e-3, rel=0.03)

    def test_shifts_along_one_line_leave_it_open(self):
        assert np.isinf(tilt_std((9, 9), [(0, 0), (0, 2), (0, 3)], flux_std=1e-4)).all()


class TestWhatIsUndetermined:
    def test_components_and_masked_pixels_are_nan(self):
        frames, options = case(7, shape=(24, 26), shifts=equipix.cross_pattern(4, 6))
        options["mask"] = np.zeros((24, 26), bool)
        options["mask"][3, 5] = True
        with pytest.warns(equipix.errors.IdentifiabilityWarning):
            cal = equipix.calibrate(
                frames, equipix.cross_pattern(4, 6), uncertainty=True, **options
            )
        undetermined = cal.component_labels != 0
        np.testing.assert_array_equal(np.isnan(cal.sensitivity_std), undetermined)
        weights = np.zeros(cal.shape)
        weights[3, 5] = 1
        with pytest.raises(InputError, match=r"in 1 pixels .* undetermined, .* \(3, 5\)"):
            cal.std_of(weights)

    def test_a_dead_pixel_has_an_honest_error(self):
        frames, options = case(8)
        frames[:, 7, 8] = np.sqrt(options["variance"][:, 7, 8])
        cal = equipix.calibrate(frames, CROSS, uncertainty=True, **options)
        error = np.sqrt(np.diag(dense(cal, frames, options))).reshape(cal.shape)
        assert cal.sensitivity_std[7, 8] == pytest.approx(error[7, 8], rel=4 * DRAWS_EXACT_TO)

    def test_a_pixel_of_no_weight_has_that_of_the_prior(self):
        frames, options = case(9)
        options["variance"][:, 7, 8] = 1e3
        cal = equipix.calibrate(frames, CROSS, uncertainty=True, **options)
        assert cal.flags[7, 8] & Flag.UNRELIABLE_FLAT
        seen = [cal.beam[7 + row, 8 + col] for row, col in CROSS]
        information = np.sum(np.square(options["flux"] * seen)) / 1e3
        # A power of 2, and no more than 1 since variances are given; they are right to 10 %.
        prior = reference.weak_light_prior(frames, CROSS, 1.0, **options)
        assert (prior > 0).sum() == 1
        # What L leaves uncertain is a millionth of D.
        wanted = 1 / np.sqrt(information + prior[7, 8])
        assert cal.sensitivity_std[7, 8] == pytest.approx(wanted, rel=4 * DRAWS_EXACT_TO)
        # Without the prior it would be 14.5.
        assert wanted < 0.2

    def test_measurements_that_leave_no_freedom_need_a_variance(self):
        frames = np.ones((2, 4, 5)) + np.array([0, 1e-3])[:, None, None]
        message = "'variance' is None and the residuals do not determine the noise"
        with (
            pytest.warns(IdentifiabilityWarning, match="the shifts leave 4 parts"),
            pytest.raises(InputError, match=message),
        ):
            equipix.calibrate(frames, [(0, 0), (0, 1)], uncertainty=True)


class TestArraysThatChange:
    @pytest.mark.parametrize("name", ["frames", "variance", "mask"])
    def test_are_refused_by_name(self, name):
        frames, options = case(7, masked=0.1)
        cal = equipix.calibrate(frames, CROSS, **options)
        weights = np.where(cal.flags == 0, 1 / cal.flags.size, 0)
        before = cal.std_of(weights)
        changed = frames if name == "frames" else options[name]
        kept = changed.copy()
        changed[:, 3:5] = False if name == "mask" else np.nan
        with pytest.raises(InputError, match=f"'{name}' of this calibration changed after"):
            cal.std_of(weights)
        changed[:] = kept
        assert cal.std_of(weights) == before

    def test_also_while_error_bars_are_found(self):
        frames, options = case(7)

        def change(_done, _total, stage):
            if stage == "uncertainty":
                frames[:, 3:5] = 0

        cal = equipix.calibrate(frames, CROSS, uncertainty=True, progress=change, **options)
        with pytest.raises(InputError, match="'frames' of this calibration changed after"):
            cal.std_of(np.full(cal.shape, 1 / cal.flags.size))

    def test_copies_may_change(self):
        frames, options = case(7)
        options["variance"] = np.asfortranarray(options["variance"])
        cal = equipix.calibrate(frames, CROSS, **options)
        weights = np.full(cal.shape, 1 / cal.flags.size)
        weights[:, :7] *= -1
        before = cal.std_of(weights)
        options["variance"] *= 100
        assert cal.std_of(weights) == before


class TestOfAResult:
    @pytest.mark.parametrize("suffix", [".tif", ".npz"])
    def test_is_saved_and_read_but_for_the_measurements(self, tmp_path, suffix):
        frames, options = case(10)
        cal = equipix.calibrate(frames, CROSS, uncertainty=True, **options)
        cal.save(tmp_path / f"cal{suffix}")
        again = equipix.load(tmp_path / f"cal{suffix}")
        np.testing.assert_array_equal(again.sensitivity_std, cal.sensitivity_std)
        np.testing.assert_array_equal(again.tilt_std, cal.tilt_std)
        np.testing.assert_array_equal(again.tilt, cal.tilt)
        assert again.metadata["uncertainty"] == cal.metadata["uncertainty"]
        with pytest.raises(InputError, match="read from a file or unpickled, which does not keep"):
            again.std_of(np.zeros(cal.shape))

    def test_is_in_single_precision_for_single_precision(self):
        frames, options = case(11)
        options["variance"] = options["variance"].astype(np.float32)
        cal = equipix.calibrate(frames.astype(np.float32), CROSS, uncertainty=True, **options)
        assert cal.sensitivity_std.dtype == np.float32
        assert "standard deviation" in repr(cal)

    def test_is_not_made_unless_asked_for(self):
        cal = equipix.calibrate(*_with(case(12)))
        assert cal.sensitivity_std is None
        assert cal.tilt_std is None
        assert "standard deviation" not in repr(cal)

    WRONG: ClassVar = [
        (np.ones((3, 4)), "has shape"),
        (np.full((12, 14), np.nan), "not finite"),
        (np.ones(5), "expected 2 or 3 dimensions"),
    ]

    @pytest.mark.parametrize(("weights", "words"), WRONG)
    def test_weights_that_do_not_fit_are_refused(self, weights, words):
        cal = equipix.calibrate(*_with(case(13)))
        with pytest.raises(InputError, match=words):
            cal.std_of(weights)

    def test_shows_progress_and_stops_with_it(self):
        frames, options = case(14, shape=(300, 400))
        stages = set()

        def progress(done, total, stage):
            assert done <= total
            stages.add(stage)
            if stage == "uncertainty":
                raise RuntimeError("enough")

        with pytest.raises(RuntimeError, match="enough"):
            equipix.calibrate(frames, CROSS, uncertainty=True, progress=progress, **options)
        assert "uncertainty" in stages

    def test_the_command_line_tells_it(self, tmp_path, capsys):
        folder, output = tmp_path / "experiment", tmp_path / "cal.tif"
        arguments = ["--shape", "48", "64", "--frames", "4", "-o", str(folder)]
        manifest = str(folder / "experiment.toml")
        for command in (
            ["simulate", *arguments],
            ["calibrate", manifest, "-o", str(output), "--uncertainty", "--json"],
            ["inspect", str(output), "--json"],
        ):
            with pytest.raises(SystemExit) as ended:
                main(command)
            assert ended.value.code == 0
        told, again = map(json.loads, capsys.readouterr().out.splitlines()[-2:])
        cal = equipix.load(output)
        assert told["sensitivity_std"] == pytest.approx(np.nanmedian(cal.sensitivity_std))
        assert told["sensitivity_std_is_exact_to"] <= DRAWS_EXACT_TO
        assert told["tilt_std"]["cols"] == again["tilt_std"]["cols"] == cal.tilt_std[1]
        assert cal.correct(np.full(cal.shape, 1000.0)).shape == cal.shape
