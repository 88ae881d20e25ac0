"""Error bars of joint fits: against dense algebra, simulated experiments, and derivatives."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from test_uncertainty import (
    DRAWS_EXACT_TO,
    MOST_DRAWS,
    check_scores,
    lowest_modes,
    mean_square_scores,
)

import equipix
import reference
from equipix import simulate
from equipix.errors import IdentifiabilityWarning
from given import CROSS, SMALL, SMALL_CROSS, TURNED, between, small, used

pytestmark = [
    pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning"),
    pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning"),
]

FRACTIONS = between(SMALL_CROSS, np.random.default_rng(8))
INTERLEAVED = [0.0, 3.0, 1.0, 4.0, 2.0]
ALIKE = [90] * 5

CASES = {
    "linear drift": (SMALL_CROSS, {"flux": "linear", "time": INTERLEAVED}),
    "linear drift, all turned": (
        SMALL_CROSS,
        {"flux": "linear", "time": INTERLEAVED, "rotation": ALIKE},
    ),
    "hidden linear drift": (
        np.array([(0, 0), (0, 1), (1, 0), (1, 1), (0, 0)], float),
        {"flux": "linear", "time": [0.0, 1.0, 2.0, 3.0, 0.0]},
    ),
    "monitor": (SMALL_CROSS, {"flux_std": 1e-3}),
    "monitor, all turned": (SMALL_CROSS, {"flux_std": 1e-3, "rotation": ALIKE}),
    "monitor, turned": (SMALL_CROSS, {"flux_std": 1e-3, "rotation": TURNED}),
    "free": (SMALL_CROSS, {"flux": "fit"}),
    "free, turned": (SMALL_CROSS, {"flux": "fit", "rotation": TURNED}),
    "between pixels": (FRACTIONS, {}),
    "between pixels, free": (FRACTIONS, {"flux": "fit"}),
    "between pixels, monitor": (FRACTIONS, {"flux_std": 1e-3}),
}


class TestAgainstDenseAlgebra:
    @pytest.mark.parametrize("name", CASES)
    def test_the_map_and_functionals(self, name):
        shifts, options = CASES[name]
        frames, measured = small(1, shifts, rotation=options.get("rotation"))
        cal = equipix.calibrate(frames, shifts, uncertainty=True, **options, **measured)
        dense = reference.joint(frames, shifts, **options, **used(cal, measured))
        known = np.isfinite(cal.sensitivity)
        error = (cal.sensitivity_std / dense.std - 1)[known]
        made = cal.metadata["uncertainty"]
        stated = made["relative_standard_error"]
        assert stated <= DRAWS_EXACT_TO or made["draws"] == MOST_DRAWS
        # A few slow errors make all pixels scatter together: three standard errors.
        assert np.sqrt(np.mean(error**2)) < 3 * stated
        weights = np.random.default_rng(2).standard_normal(cal.shape) * known
        over_m = (weights / np.where(known, cal.sensitivity, 1)).ravel()
        wanted = np.sqrt(over_m @ np.nan_to_num(dense.covariance) @ over_m)
        # The variance lacks 1e-4 at most of what the other unknowns bring to it.
        assert cal.std_of(weights) == pytest.approx(wanted, rel=1e-4)

    @pytest.mark.long
    def test_refined_shifts(self):
        shape, std = (8, 32), np.array([0, 0.05, 0.03, 0.05, 0.05])
        rng = np.random.default_rng(3)
        shifts = between(SMALL_CROSS, rng)
        sensitivity = simulate.paper_sensitivity(shape, rng=rng)
        beam = simulate.wavy_beam(shape, width=60, contrast=0.3, rng=rng)
        frames = simulate.exposures(sensitivity, beam, shifts)
        frames += 1e-4 * rng.standard_normal(frames.shape)
        given = shifts + std[:, None] * rng.standard_normal(shifts.shape)
        options = {"variance": np.full(5, 1e-8), "shift_std": std}
        cal = equipix.calibrate(frames, given, uncertainty=True, **options)
        assert cal.metadata["options"]["shifts"] == "refined"
        dense = reference.joint(frames, given, **options)
        np.testing.assert_allclose(cal.shift_std, dense.shift_std, rtol=1e-3)
        error = cal.sensitivity_std / dense.std - 1
        assert (
            np.sqrt(np.mean(error**2)) < 3 * cal.metadata["uncertainty"]["relative_standard_error"]
        )

    @pytest.mark.parametrize("fitted", [False, True])
    def test_what_offsets_have_in_common(self, fitted):
        twice, levels = np.tile(SMALL_CROSS, (2, 1)), np.repeat([1, 0.5], 5)
        rng = np.random.default_rng(4)
        sensitivity = simulate.paper_sensitivity(SMALL, rng=rng)
        beam = simulate.wavy_beam(SMALL, width=15, contrast=0.3, rng=rng)
        frames = simulate.exposures(sensitivity, beam, twice, flux=levels) + 0.1
        frames += 1e-4 * rng.standard_normal(frames.shape)
        options = {"variance": np.full(10, 1e-8), "dark": "fit"}
        options["flux"] = "fit" if fitted else levels
        cal = equipix.calibrate(frames, twice, uncertainty=True, **options)
        dense = reference.joint(frames, twice, **options)
        error = cal.sensitivity_std / dense.std - 1
        stated = cal.metadata["uncertainty"]["relative_standard_error"]
        assert np.sqrt(np.mean(error**2)) < 3 * stated
        if fitted:
            along = cal.metadata["dark"]["std_along_sensitivity"]
            assert along == pytest.approx(dense.dark_along_std, rel=1e-3)


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
class TestAgainstSimulatedExperiments:
    """Sensors of 120 rows and 160 columns, 200 experiments for each setting.

    One experiment without drift in a thousand warns of one.
    """

    SHAPE = (120, 160)

    @pytest.mark.study
    @pytest.mark.parametrize(
        ("free", "fractional", "masked", "sensors"),
        [(True, False, 0, 4), (True, False, 0.02, 4), (False, True, 0, 2), (False, True, 0.02, 2)],
        ids=["free", "free, masked", "between pixels", "between pixels, masked"],
    )
    def test_z_scores(self, free, fractional, masked, sensors, draws, figure):
        def mean_squares(seed, experiments):
            return self.mean_squares(seed, free, fractional, masked, experiments)

        check_scores(mean_squares, sensors, len(draws(200)), figure)

    def mean_squares(self, seed, free, fractional, masked, experiments):
        rng = np.random.default_rng([seed, 46, int(100 * masked)])
        truth = simulate.paper_sensitivity(self.SHAPE, rng=rng)
        used = rng.random(self.SHAPE) >= masked
        shifts = between(CROSS, rng) if fractional else CROSS
        shape = self.SHAPE
        beam = simulate.wavy_beam(shape, rng=rng) if fractional else simulate.gaussian_beam(shape)
        clean = simulate.exposures(truth, beam, shifts)
        truth = in_gauge(truth, used, level=free)
        options = {"flux": "fit"} if free else {}
        return mean_square_scores(clean, shifts, truth, used, experiments, rng, **options)

    @pytest.mark.study
    def test_z_scores_of_refined_shifts(self, draws, figure):
        squares = []
        for seed in draws(40):
            rng = np.random.default_rng([seed, 47])
            shifts = between(CROSS, rng)
            sensitivity = simulate.paper_sensitivity(self.SHAPE, rng=rng)
            frames = simulate.exposures(
                sensitivity, simulate.wavy_beam(self.SHAPE, rng=rng), shifts
            )
            frames += 1e-3 * rng.standard_normal(frames.shape)
            given = shifts + 0.05 * rng.standard_normal(shifts.shape)
            cal = equipix.calibrate(frames, given, shift_std=0.05, variance=np.full(5, 1e-6))
            std = shift_std_of(cal)
            error = cal.shifts - shifts
            squares.append(np.sum(((error - error.mean(axis=0)) / std) ** 2) / 10)
        # 40 × 5 shifts along two axes, of which four are free: 4 % a standard error of the rms.
        z, limit = np.sqrt(np.mean(squares)), 0.1 * np.sqrt(40 / len(squares))
        figure("z of refined shifts", z, f"1 ± {limit:.2f}")
        assert z == pytest.approx(1, abs=limit)

    @pytest.mark.study
    def test_drift_is_in_the_tilt_of_a_monitored_lamp(self, draws, figure):
        shape, shifts = (60, 80), equipix.cross_pattern(5, 7)
        clean = simulate.exposures(np.ones(shape), simulate.gaussian_beam(shape), shifts)
        rng = np.random.default_rng(48)
        scores = []
        for index in draws(150):
            flux = np.exp(1e-3 * rng.standard_normal(5))
            frames = clean * flux[:, None, None] + 1e-4 * rng.standard_normal(clean.shape)
            cal = equipix.calibrate(
                frames,
                shifts,
                flux_std=1e-3,
                variance=np.full(5, 1e-8),
                uncertainty=index == 0,
            )
            if index == 0:
                std = cal.tilt_std
            scores.append(cal.tilt / std)
        # 150 pairs: 4 % a standard error of the rms, and three of them.
        z, limit = np.sqrt(np.mean(np.square(scores))), 0.13 * np.sqrt(150 / len(scores))
        figure("z of the tilt under a monitored lamp that drifts", z, f"1 ± {limit:.2f}")
        assert z == pytest.approx(1, abs=limit)


def shift_std_of(cal):
    """Standard deviations of refined shifts, without the map that `uncertainty` makes too."""
    answer = cal.weighted.fit.uncertainty(
        error_map=False, functionals=None, shifts=True, offset=False, workers=None, progress=None
    )
    return np.sqrt(answer.shift_variances)


def in_gauge(truth, used, *, level):
    """Truth of mean 1 over the pixels used, if asked without the slope of its logarithm."""
    if level:
        plane = np.column_stack([np.ones(used.sum()), np.argwhere(used)])
        slope = np.linalg.lstsq(plane, np.log(truth[used]))[0][1:]
        rows, cols = np.indices(truth.shape)
        truth = truth * np.exp(-slope[0] * rows - slope[1] * cols)
    return truth / truth[used].mean()


@pytest.mark.long
def test_shifts_that_no_beam_tells_are_wrong_by_their_prior():
    shape, shifts, std = (24, 30), equipix.cross_pattern(4, 7).astype(float), 0.05
    rng = np.random.default_rng(49)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=60)
    clean = simulate.exposures(truth, beam, shifts)
    frames = clean + 1e-3 * rng.standard_normal(clean.shape)
    options = {"variance": np.full(5, 1e-6)}
    weights = lowest_modes(shape, np.ones(shape, bool), count=3)

    def modes(moved):
        cal = equipix.calibrate(clean, shifts + moved, tolerance=1e-9, **options)
        return np.einsum("mrc,rc->m", weights, np.log(cal.sensitivity))

    # Derivatives by the central difference of 0.02 pixel, of an error cubic in it.
    step = 0.01 * np.eye(10).reshape(10, 5, 2)
    slopes = np.array([(modes(move) - modes(-move)) / 0.02 for move in step])
    cal = equipix.calibrate(frames, shifts, shift_std=std, uncertainty=True, **options)
    assert cal.metadata["options"]["shifts"] == "undetermined"
    np.testing.assert_array_equal(cal.shift_std, np.full((5, 2), std))
    exact = equipix.calibrate(frames, shifts + 1e-9, **options)
    # What moves all exposures alike moves the beam; the prior's mean is no error of M.
    by_axis = slopes.reshape(5, 2, -1)
    moved = std**2 * np.sum((by_axis - by_axis.mean(axis=0)) ** 2, axis=(0, 1))
    wanted = np.sqrt(exact.std_of(weights) ** 2 + moved)
    np.testing.assert_allclose(cal.std_of(weights), wanted, rtol=0.02)


def test_an_undetermined_tilt_is_infinitely_uncertain(tmp_path):
    frames, measured = small(6, SMALL_CROSS)
    cal = equipix.calibrate(frames, SMALL_CROSS, flux="fit", uncertainty=True, **measured)
    assert np.isinf(cal.tilt_std).all()
    cal.save(tmp_path / "cal.npz")
    assert np.isinf(equipix.load(tmp_path / "cal.npz").tilt_std).all()


def test_gain_and_offset_that_cannot_be_told_apart_are_named():
    twice = np.tile(SMALL_CROSS, (2, 1))
    rng = np.random.default_rng(7)
    truth = simulate.paper_sensitivity((24, 30), rng=rng)
    for width, told in ((20, True), (1e4, False)):
        beam = simulate.gaussian_beam(truth.shape, width=width)
        frames = simulate.exposures(truth, beam, twice, flux=np.repeat([1, 0.4], 5)) + 0.05
        frames += 5e-4 * rng.standard_normal(frames.shape)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            cal = equipix.calibrate(
                frames, twice, flux="fit", dark="fit", variance=np.full(10, 2.5e-7)
            )
        words = [str(each.message) for each in caught if each.category is IdentifiabilityWarning]
        assert any("nearly degenerate with the sensitivity" in each for each in words) != told
        assert (cal.metadata["dark"]["std_along_sensitivity"] is not None) == cal.converged


def test_the_same_bytes_for_any_number_of_workers():
    frames, measured = small(8, FRACTIONS)
    one, three = (
        equipix.calibrate(
            frames, FRACTIONS, flux="fit", uncertainty=True, workers=workers, **measured
        )
        for workers in (1, 3)
    )
    np.testing.assert_array_equal(one.sensitivity_std, three.sensitivity_std)
    weights = np.zeros(SMALL)
    weights[3, 4] = 1
    assert one.std_of(weights, workers=1) == three.std_of(weights, workers=3)
