"""The plan of an experiment: what it can compare, and errors as simulated experiments have them."""

from __future__ import annotations

import tracemalloc
import warnings
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import equipix
import reference
from equipix import _native, metrics, plan, simulate
from equipix.errors import (
    IdentifiabilityWarning,
    InputError,
    InputWarning,
    MisfitWarning,
)
from equipix.plan import pattern_errors
from equipix.plan.drift import distinct_trend, tilt_of_fluxes, tilt_rms
from equipix.plan.pattern_errors import LocalVariance

WITHIN = 0.1
"""The claim: predictions agree with simulation within 10 %."""

CROSS = equipix.cross_pattern(11, 19)
CCD = (582, 782)

PATTERNS = {
    "cross": ((72, 96), equipix.cross_pattern(5, 7), 150.0),
    "long arms": ((96, 128), CROSS, 200.0),
    "corners": ((96, 128), [(0, 0), (0, 23), (25, 2), (24, 25), (11, 14)], 250.0),
    "nine": (
        (60, 96),
        [(0, 0), (17, 3), (4, 19), (12, 12), (19, 18), (1, 9), (9, 1), (15, 7), (6, 14)],
        120.0,
    ),
    "three": ((48, 40), [(0, 0), (0, 1), (1, 0)], 100.0),
    "nearly periodic": ((96, 128), [(0, 0), (0, 20), (21, 0), (21, 20), (10, 7)], None),
}
patterns = pytest.mark.parametrize(
    ("shape", "shifts", "width"), PATTERNS.values(), ids=PATTERNS.keys()
)


def budget_of(*arguments, **options):
    """An error budget whose warnings do not matter here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        return plan.error_budget(*arguments, **options)


def beam_of(shape, width):
    return simulate.gaussian_beam(shape, width=width or 1e9)


def solved(frames, shifts, tolerance):
    """The relative error of M, the truth being 1, where drifts and shifts are wrong on purpose."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        found = equipix.calibrate(frames, shifts, tolerance=tolerance, workers=1).sensitivity
    return metrics.relative_error(found, np.ones(found.shape))


def slopes(error):
    """Least-squares tilt of an error, edge to edge (row, col)."""
    tilts = []
    for axis, size in enumerate(error.shape):
        lever = np.arange(size) - (size - 1) / 2
        profile = error.mean(axis=1 - axis)
        tilts.append(size * (lever @ profile) / (lever @ lever))
    return np.array(tilts)


def compare(predicted, errors, within=WITHIN):
    """A predicted rms against that of independent draws, whose own standard error comes on top."""
    squares = [np.mean(error**2) for error in errors]
    rms = np.sqrt(np.mean(squares))
    scatter = np.std(squares, ddof=1) / np.sqrt(len(squares)) / (2 * rms)
    assert predicted == pytest.approx(rms, abs=within * rms + 3 * scatter)


def orthogonal_draws(count, seed):
    """As many draws of `count` numbers of variance 1 as there are numbers, in random directions.

    Their mean square through any linear response is what it is for independent normal numbers,
    without the scatter of draws: the sum over an orthonormal basis does not depend on it.
    """
    normal = np.random.default_rng(seed).standard_normal((count, count))
    return np.sqrt(count) * np.linalg.qr(normal)[0]


class TestIdentify:
    @settings(max_examples=60, deadline=None)
    @given(st.data())
    def test_agrees_with_the_reference(self, data):
        shape = data.draw(st.tuples(st.integers(1, 9), st.integers(1, 9)), "shape")
        n = data.draw(st.integers(2, 4), "n")
        turns = data.draw(st.lists(st.sampled_from([0, 90, 180, 270]), min_size=n, max_size=n))
        most = min(shape) - 1
        shift = st.tuples(st.integers(-most, most), st.integers(-most, most))
        shifts = data.draw(st.lists(shift, min_size=n, max_size=n), "shifts")
        rng = np.random.default_rng(data.draw(st.integers(0, 99)))
        each = data.draw(st.booleans())
        mask = rng.random((n, *shape) if each else shape) < data.draw(st.sampled_from([0, 0.3, 1]))
        found = plan.identify(shape, shifts, mask, rotation=turns)
        cells, grid, _ = reference.grid_cells(shape, shifts, turns)
        used = ~np.broadcast_to(mask, cells.shape)
        pixels, beam = reference.components(cells, used, grid)
        np.testing.assert_array_equal(found.labels, pixels)
        assert found.components == pixels.max() + 1
        assert found.largest == np.count_nonzero(pixels == 0)
        assert found.equations == used.sum()
        assert found.unknowns == (pixels >= 0).sum() + (beam >= 0).sum()

    @pytest.mark.parametrize(
        ("shifts", "components"),
        [
            (equipix.cross_pattern(5, 7), 1),
            (equipix.cross_pattern(4, 6), 4),
            ([(0, 0), (5, 0), (0, 7)], 35),
            # Index 1 of the lattice, but corners come apart.
            ([(0, 0), (11, 13), (19, 17), (30, 41)], 89),
        ],
    )
    def test_known_patterns(self, shifts, components):
        assert plan.identify((150, 170), shifts).components == components

    @settings(max_examples=150, deadline=None)
    @given(st.data())
    def test_a_part_of_a_sensor_tells_of_the_whole(self, data):
        """A mask that leaves all pixels has the whole sensor looked at."""
        spans = data.draw(st.tuples(st.integers(0, 7), st.integers(0, 7)), "spans")
        place = st.tuples(*(st.integers(0, span) for span in spans))
        shifts = data.draw(st.lists(place, min_size=2, max_size=5), "shifts")
        cfa = data.draw(st.sampled_from([None, "RGGB", "RGB/", "RRGG/GGBB"]))
        shape = tuple(data.draw(st.integers(1, 40), "more") + 5 * span for span in spans)
        part, whole = (
            plan.identify(shape, shifts, mask, cfa=cfa) for mask in (None, np.zeros(shape, bool))
        )
        for name in ("components", "largest", "equations", "unknowns", "by_colour"):
            assert getattr(part, name) == getattr(whole, name), name
        np.testing.assert_array_equal(part.labels, whole.labels)

    @pytest.mark.parametrize(
        "shifts", [CROSS, equipix.cross_pattern(4, 6), [(0, 0), (7, 3), (2, 9)]]
    )
    def test_takes_no_more_memory_for_a_larger_sensor(self, monkeypatch, shifts):
        looked_at, find = [], _native.planned_components
        monkeypatch.setattr(
            _native, "planned_components", lambda *a, **b: looked_at.append(a[0]) or find(*a, **b)
        )
        found = plan.identify((20_000, 30_000), shifts)
        assert found.equations == len(shifts) * 600_000_000
        # Three spans of 19 pixels, and up to two periods of the lattice: 57 of the last one.
        assert np.max(looked_at) <= 3 * 19 + 2 + 2 * 57

    def test_what_calibrate_finds(self):
        mask = np.random.default_rng(3).random((5, 30, 40)) < 0.4
        shifts = equipix.cross_pattern(4, 7)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", IdentifiabilityWarning)
            frames = np.random.default_rng(4).uniform(1, 1.01, (5, 30, 40))
            cal = equipix.calibrate(frames, shifts, mask=mask)
        found = plan.identify((30, 40), shifts, mask)
        np.testing.assert_array_equal(found.labels, cal.component_labels)

    def test_a_part_of_a_pixel_common_to_all_shifts_does_not_count(self):
        assert plan.identify((48, 64), equipix.cross_pattern(4, 6) + 0.3).components == 4

    def test_other_parts_of_pixels_are_rounded_with_a_warning(self):
        shifts = equipix.cross_pattern(4, 6) * 1.1 + 0.3
        words = (
            r"exposure 1 \(from 0\) is \[0\.3, 4\.7\] \(limit 0\.02 from whole\), the first is "
            r"\[0\.3, 0\.3\]: choose shifts that differ by whole pixels$"
        )
        with pytest.warns(InputWarning, match=words):
            found = plan.identify((48, 64), shifts)
        assert found.components == plan.identify((48, 64), equipix.cross_pattern(4, 7)).components

    def test_says_what_it_found(self):
        words = repr(plan.identify((20, 30), equipix.cross_pattern(4, 6)))
        assert words.startswith("<Identifiability: 4 components, the largest of 150 of 600 pixels")

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (((0, 5), [(0, 0), (0, 1)]), "'shape' is (0, 5)"),
            (((4.5, 5), [(0, 0), (0, 1)]), "'shape' is (4.5, 5)"),
            (((4, 5), np.empty((0, 2))), "'shifts' holds 0 exposures"),
            (((4, 5), [(0, 0), (0, 5)]), "must be smaller than the sensor"),
            (((4, 5), [(0, 0), (0, 1)], np.zeros((5, 4), bool)), "'mask' has shape (5, 4)"),
        ],
    )
    def test_refuses(self, arguments, words):
        with pytest.raises(InputError) as error:
            plan.identify(*arguments)
        assert words in str(error.value)


class TestNoise:
    @pytest.mark.study
    @patterns
    @pytest.mark.parametrize("seed", [1, 2])
    def test_rms_and_map_agree_with_simulation(self, shape, shifts, width, seed):
        sigma, draws = 1e-3, 8
        budget = budget_of(shape, shifts, noise=sigma, beam_width=width)
        frames = simulate.exposures(np.ones(shape), beam_of(shape, width), shifts)
        rng = np.random.default_rng(seed)
        errors = [
            solved(frames + sigma * rng.standard_normal(frames.shape), shifts, sigma / 100)
            for _ in range(draws)
        ]
        compare(budget.rms_by_cause["noise"], errors)
        # Where the map says that errors are small or large, they are; less exactly so where few
        # waves make up most of the error.
        predicted = budget.noise_map
        assert np.sqrt(np.mean(predicted**2)) == pytest.approx(budget.rms_by_cause["noise"])
        few = len(shifts) == 3 or budget.spectrum.smallest < 1e-2
        edge = np.quantile(predicted, 0.75) * (1 + 1e-9)
        for part in (predicted <= edge, predicted > edge):
            wanted = np.sqrt(np.mean(predicted[part] ** 2))
            compare(wanted, [error[part] for error in errors], 0.25 if few else WITHIN)

    def test_of_the_cross(self):
        # What a solver at the optimum leaves: 1.21/√n at 782×582, 1.23/√n at 320×240.
        for shape, wanted in ((CCD, 1.21), ((240, 320), 1.23)):
            budget = budget_of(shape, CROSS, noise=1.0)
            # The third figure of the wanted one, and 3 draws of 65 536 pixels.
            tolerance = 0.005 + 3 * wanted / np.sqrt(2 * 3 * 65_536)
            assert budget.rms * np.sqrt(5) == pytest.approx(wanted, abs=tolerance)

    def test_scales_with_noise_and_falls_with_flux(self):
        shape = (48, 64)
        once = budget_of(shape, CROSS, noise=1e-3).rms
        assert budget_of(shape, CROSS, noise=2e-3).rms == pytest.approx(2 * once, rel=1e-9)
        # Twice the light in all exposures: linear but for noise², 1e-6, in a step.
        bright = budget_of(shape, CROSS, noise=1e-3, flux=[2] * 5).rms
        assert bright == pytest.approx(once / 2, rel=1e-2)

    @pytest.mark.long
    def test_known_fluxes_weigh(self):
        shape, sigma, flux = (64, 80), 1e-3, np.array([1, 2, 0.5, 1.5, 0.7])
        shifts = equipix.cross_pattern(5, 7)
        budget = budget_of(shape, shifts, noise=sigma, flux=flux)
        frames = simulate.exposures(np.ones(shape), beam_of(shape, None), shifts, flux=flux)
        rng, squares = np.random.default_rng(1), []
        for _ in range(8):
            noise = sigma * rng.standard_normal(frames.shape)
            cal = equipix.calibrate(frames + noise, shifts, flux=flux, tolerance=1e-5, workers=1)
            squares.append(np.var(cal.sensitivity))
        assert budget.rms == pytest.approx(np.sqrt(np.mean(squares)), rel=WITHIN)


class TestDrift:
    @pytest.mark.study
    @patterns
    @pytest.mark.parametrize("seed", [1, 2])
    def test_tilt_agrees_with_simulation(self, shape, shifts, width, seed):
        drift, count = 1e-5, len(shifts)
        budget = budget_of(shape, shifts, noise=1, drift=drift, beam_width=width)
        errors = []
        for draw in orthogonal_draws(count, seed):
            beam = beam_of(shape, width)
            frames = simulate.exposures(np.ones(shape), beam, shifts, flux=1 + drift * draw)
            errors.append(solved(frames, shifts, 1e-2 * drift))
        tilt = np.sqrt(np.mean([slopes(error) ** 2 for error in errors], axis=0))
        assert budget.tilt_by_cause["drift"] == pytest.approx(tilt, rel=WITHIN)
        rms = np.sqrt(np.mean(np.square(errors)))
        assert budget.rms_by_cause["drift"] == pytest.approx(rms, rel=WITHIN)

    @pytest.mark.parametrize(("arms", "wanted"), [((11, 19), 2.0e-3), ((97, 160), 2.4e-4)])
    def test_of_the_cross(self, arms, wanted):
        # Measured at 782×582, in two figures.
        tilt = tilt_of_fluxes(CCD, equipix.cross_pattern(*arms).astype(float), 1e-4)
        assert tilt_rms(tilt) == pytest.approx(wanted, abs=0.05 * 10 ** np.floor(np.log10(wanted)))

    def test_is_loud_when_it_exceeds_the_noise(self):
        with pytest.warns(MisfitWarning, match="times the error by noise"):
            plan.error_budget((64, 80), CROSS, noise=1e-4, drift=1e-4)
        plan.error_budget((64, 80), CROSS, noise=1e-2, drift=1e-4)  # warnings are errors here

    def test_along_one_line_the_other_tilt_is_free(self):
        with pytest.warns(IdentifiabilityWarning, match="30 parts"):
            budget = budget_of((30, 40), [(0, 0), (0, 2), (0, 5)], noise=1, drift=1e-9)
        assert np.isinf(budget.tilt_by_cause["drift"][0])
        line = budget_of((1, 40), [(0, 0), (0, 2), (0, 5)], noise=1, drift=1e-9)
        # ε·N/(√n·std): three shifts of variance 38/9.
        wanted = 1e-9 * 40 / np.sqrt(3 * 38 / 9)
        assert line.tilt_by_cause["drift"] == pytest.approx((0, wanted))


class TestShiftErrors:
    @pytest.mark.study
    @pytest.mark.parametrize(
        ("shape", "shifts", "width"),
        [case for case in PATTERNS.values() if case[2]],
        ids=[name for name, case in PATTERNS.items() if case[2]],
    )
    @pytest.mark.parametrize("seed", [1, 2])
    def test_error_agrees_with_simulation(self, shape, shifts, width, seed):
        delta, count = 1e-2, len(shifts)
        budget = budget_of(shape, shifts, noise=1, shift_error=delta, beam_width=width)
        errors = []
        for draw in orthogonal_draws(2 * count, seed):
            moved = np.asarray(shifts) + delta * draw.reshape(count, 2)
            frames = simulate.exposures(np.ones(shape), beam_of(shape, width), moved)
            errors.append(solved(frames, shifts, 1e-7))
        rms = np.sqrt(np.mean(np.square(errors)))
        assert budget.rms_by_cause["shift_error"] == pytest.approx(rms, rel=WITHIN)
        tilt = np.sqrt(np.mean([slopes(error) ** 2 for error in errors], axis=0))
        # A tilt is a small part of it: as exact as the whole.
        whole = np.sqrt(12) * rms
        assert budget.tilt_by_cause["shift_error"] == pytest.approx(tilt, abs=WITHIN * whole)

    def test_of_the_cross(self):
        # Section 5 of the design, in one figure: 0.01 pixel → 4e-5 rms; here 5.3e-5 with random
        # errors of all exposures.
        budget = budget_of(CCD, CROSS, noise=1, shift_error=0.01, beam_width=1000)
        assert 3e-5 < budget.rms_by_cause["shift_error"] < 6e-5

    def test_an_even_beam_forgives_them(self):
        assert budget_of((64, 80), CROSS, noise=1, shift_error=1).rms_by_cause["shift_error"] == 0


class TestSpectrum:
    def test_is_the_symbol(self):
        shifts = np.random.default_rng(2).integers(0, 30, (6, 2))
        found = budget_of((64, 80), shifts, noise=1).spectrum
        for row, col in ((0, 512), (100, 3), (512, 1024), (7, 700)):
            q = 2 * np.pi * np.array([found.rows[row], found.cols[col]])
            wanted = 6 - abs(np.exp(1j * shifts @ q).sum()) ** 2 / 6
            # Rounding of a sum of 6 unit numbers, squared.
            assert found.values[row, col] == pytest.approx(wanted, abs=100 * np.finfo(float).eps)

    def test_names_the_nearly_periodic_wave(self):
        shape, shifts, _ = PATTERNS["nearly periodic"]
        worst = budget_of(shape, shifts, noise=1).spectrum.worst
        phases = np.array(shifts) @ worst
        assert np.abs(phases - np.rint(phases)).max() < 0.1
        assert np.hypot(*worst) > 1 / 21


class TestOrder:
    def test_of_the_cross_hides_a_trend(self):
        # Section 5 of the design: 3.5 % of the variance.
        assert distinct_trend(CROSS) == pytest.approx(0.035, abs=5e-4)

    @pytest.mark.parametrize("count", [4, 6, 11])
    def test_advised_hides_less(self, count):
        shifts = np.random.default_rng(count).integers(0, 40, (count, 2))
        order = plan.advise_order(shifts)
        assert sorted(order) == list(range(count))
        told = distinct_trend(shifts[order])
        rng = np.random.default_rng(0)
        others = [distinct_trend(rng.permutation(shifts)) for _ in range(500)]
        assert told >= max(others) - 1e-9

    def test_a_trend_in_the_advised_order_does_not_tilt(self):
        shape, trend = (64, 80), 1e-4 * np.arange(5)
        tilts = []
        for shifts in (CROSS, CROSS[plan.advise_order(CROSS)]):
            beam = simulate.gaussian_beam(shape)
            frames = simulate.exposures(np.ones(shape), beam, shifts, flux=1 + trend)
            tilts.append(np.linalg.norm(slopes(solved(frames, shifts, 1e-7))))
        hidden = 1 - distinct_trend(CROSS[plan.advise_order(CROSS)])
        # The tilt goes with the root of what is hidden, in a metric as lopsided as cov(d): its
        # eigenvalues are 96 and 24.
        assert tilts[1] < 2 * np.sqrt(hidden / 0.965) * tilts[0]

    def test_three_exposures_hide_every_trend(self):
        assert distinct_trend([(0, 0), (0, 3), (5, 0)]) == pytest.approx(0, abs=1e-12)


def products(shape, shifts):
    """Products that calibrating a simulated experiment takes."""
    rng = np.random.default_rng(0)
    truth = simulate.cosine_sensitivity(shape, rng=rng)
    frames = simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    return equipix.calibrate(frames + 1e-3 * rng.standard_normal(frames.shape), shifts).sweeps


class TestPasses:
    @pytest.mark.study
    @pytest.mark.parametrize(
        "shifts",
        [
            *(equipix.cross_pattern(*arms) for arms in ((5, 7), (11, 19), (23, 41), (47, 71))),
            *(np.random.default_rng(n).integers(0, 100, (n, 2)) for n in (5, 6, 7, 8, 9)),
            *(np.random.default_rng(10 + n).integers(0, 40, (n, 2)) for n in (5, 6, 7, 8, 9)),
        ],
        ids=lambda shifts: f"{len(shifts)} within {shifts.max()}",
    )
    def test_are_those_of_a_calibration_within_a_factor_of_two(self, shifts):
        shape = (300, 400)
        found = pattern_errors.spectrum(shifts, np.ones(len(shifts))).passes
        taken = products(shape, shifts)
        if found <= 60:
            assert 0.5 < found / taken < 2
        else:  # The solver may have aggregates.
            assert 30 < taken <= 100

    def test_no_wave_counts_twice(self):
        """A pattern and itself with exchanged or reversed axes, and moved, take as many."""
        shifts = np.random.default_rng(3).integers(0, 30, (5, 2))
        same = shifts, shifts[:, ::-1], shifts * (1, -1), -shifts, shifts + 7
        found = [pattern_errors.spectrum(each, np.ones(5)).passes for each in same]
        # Rounding of λ, of 1000 radians; a minimum of two equal values counts twice in none.
        np.testing.assert_allclose(found, found[0], rtol=1e-9)

    @pytest.mark.parametrize("count", [5, 6, 7])
    def test_of_positions_without_anything_in_common(self, count):
        """The mean over random patterns is that of the waves on the grid."""
        rng = np.random.default_rng(count)
        patterns = rng.integers(0, 40, (60, count, 2))
        usual = pattern_errors.usual_passes(patterns)
        ones = np.ones(count)
        found = np.array([pattern_errors.spectrum(each, ones).passes for each in patterns])
        error = np.std(found / usual) / np.sqrt(60)
        assert np.mean(found / usual) == pytest.approx(1, abs=0.3 + 3 * error)


@pytest.fixture(scope="module")
def cross():
    return budget_of(CCD, CROSS, noise=1e-3, drift=1e-4)


# Of five positions, 100 expected passes allow for a spread √det Σ of 330, where that of the cross
# is 48: a tilt that is smaller by 2.9. Six may use the whole travel.
LIMITS = [(5, 2.5, 1.1), (6, 5, 0.95), (9, 6, 0.75)]


class TestSuggest:
    @pytest.mark.study
    @pytest.mark.parametrize(
        ("exposures", "tilt", "noise", "seed"),
        [(n, *limits, seed) for n, *limits in LIMITS for seed in (0, 1)],
    )
    def test_beats_the_cross(self, cross, exposures, tilt, noise, seed):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MisfitWarning)
            found = plan.suggest(CCD, exposures, 80, patterns=2, rng=seed)
        for suggestion in found:
            budget = suggestion.budget
            assert budget.rms_by_cause["drift"] < cross.rms_by_cause["drift"] / tilt
            assert budget.rms_by_cause["noise"] < cross.rms_by_cause["noise"] * noise
            assert plan.identify(CCD, suggestion.shifts).components == 1
            assert suggestion.shifts.min() >= 0
            assert suggestion.shifts.max() <= 80
        rms = [suggestion.budget.rms for suggestion in found]
        assert rms == sorted(rms)

    @pytest.mark.study
    @pytest.mark.parametrize("travel", [40, 120])
    @pytest.mark.parametrize("exposures", [5, 6, 7])
    def test_takes_few_products(self, exposures, travel):
        """At most four times those of the cross, however far the stage goes."""
        shape = (240, 320)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MisfitWarning)
            found = plan.suggest(shape, exposures, travel)
        for suggestion in found:
            assert products(shape, suggestion.shifts) <= 4 * products(shape, CROSS)

    @pytest.mark.long
    def test_the_same_seed_finds_the_same(self):
        first, second = (
            plan.suggest((64, 80), 5, (10, 20), drift=1e-6, rng=4)[0].shifts for _ in range(2)
        )
        np.testing.assert_array_equal(first, second)
        assert (first.max(axis=0) <= (10, 20)).all()
        # In the order advised, which is one of its own.
        told = distinct_trend(first)
        assert told == pytest.approx(distinct_trend(first[plan.advise_order(first)]), abs=1e-9)

    @pytest.mark.long
    def test_five_unless_told(self):
        found = plan.suggest((40, 50), None, 12, drift=0)[0].shifts
        assert len(found) == 5
        assert plan.identify((40, 50), found).components == 1
        # Fewer where the travel has fewer positions.
        assert len(plan.suggest((1, 50), None, (0, 2), drift=0)[0].shifts) == 3

    @pytest.mark.long
    def test_not_all_at_the_corners(self):
        """Distances differ, and no wave of the travel's period is left with little weight."""
        travel = 30
        for suggestion in plan.suggest((96, 128), 7, travel, drift=1e-5):
            shifts = suggestion.shifts
            inside = np.minimum(shifts, travel - shifts).max(axis=1) > 0.1 * travel
            assert inside.any()
            waves = 2j * np.pi * np.array([(1, 0), (0, 1), (1, 1), (2, 0), (0, 2)]) / travel
            visible = 7 - np.abs(np.exp(waves @ shifts.T).sum(axis=1)) ** 2 / 7
            # Of seven positions all at the corners λ is below 0.1 at each of them.
            assert visible.min() > 0.5
            assert plan.identify((96, 128), shifts).components == 1

    @pytest.mark.long
    def test_tells_its_progress(self):
        told = []
        plan.suggest((40, 50), 4, 9, drift=0, progress=lambda *each: told.append(each))
        for stage in ("searching 4 positions", "judging patterns"):
            steps = [(done, total) for done, total, name in told if name == stage]
            assert steps == sorted(steps)
            assert steps[-1][0] == steps[-1][1]

    @pytest.mark.long
    def test_says_that_drift_will_tilt(self):
        with pytest.warns(MisfitWarning, match="drift"):
            plan.suggest((64, 80), 4, 5, drift=1e-3, patterns=1)
        plan.suggest((64, 80), 4, 5, patterns=1)  # warnings are errors here
        with pytest.warns(MisfitWarning, match="pattern 1: "):
            plan.suggest((300, 400), 4, 5, patterns=1)  # by a tenth of the noise

    @pytest.mark.parametrize(
        ("arguments", "options", "words"),
        [
            (((64, 80), 2, 10), {}, "no pattern of 2 exposures"),
            (((64, 80), 5, -1), {}, "'max_shift' is -1"),
            (((64, 80), 5, (0, 10)), {}, "no pattern of 5 exposures"),
            (((64, 80), None, (0, 10)), {}, "no pattern of two to five exposures"),
            (((64, 80), 0, 10), {}, "'exposures' is 0"),
            (((64, 80), 1, 10), {}, "'exposures' is 1, expected two or more"),
            (((64, 80), 5, 10), {"noise": np.nan}, "'noise' is nan"),
            (((64, 80), 5, 10), {"noise": "much"}, "'noise' is 'much'"),
            (((64, 80), 5, 10), {"drift": np.nan}, "'drift' is nan"),
            (((1, 1), None, 10), {}, "'shape' is (1, 1)"),
        ],
    )
    def test_refuses(self, arguments, options, words):
        with pytest.raises(InputError) as error:
            plan.suggest(*arguments, **options)
        assert words in str(error.value)


class TestBudget:
    def test_adds_causes_in_quadrature(self):
        budget = budget_of((64, 80), CROSS, noise=1e-3, drift=1e-5, shift_error=0.1, beam_width=99)
        assert budget.rms == pytest.approx(np.linalg.norm([*budget.rms_by_cause.values()]))
        assert all(value > 0 for value in budget.rms_by_cause.values())

    def test_between_pixels(self):
        """The errors are those of the nearest whole shifts, but a periodic wave is undetermined."""
        moved = CROSS + np.random.default_rng(1).uniform(-0.2, 0.2, (5, 2))
        between, whole = (budget_of((64, 80), each, noise=1) for each in (moved, CROSS))
        assert between.components == 1
        assert between.rms_by_cause["noise"] == whole.rms_by_cause["noise"]
        with pytest.warns(IdentifiabilityWarning, match="do not constrain a wave"):
            budget_of((64, 80), 2.5 * equipix.cross_pattern(1, 3), noise=1)

    @pytest.mark.parametrize(
        "shifts",
        [
            pytest.param([(0, 0), (0, 0.4), (0.3, 0), (0.2, 0.1)], id="less than a pixel apart"),
            pytest.param([(0, 0), (0, 2.3), (2.1, 0), (4.2, 6.4)], id="even but for fractions"),
        ],
    )
    def test_noise_is_not_known_where_whole_shifts_compare_too_little(self, shifts):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", IdentifiabilityWarning)
            budget = budget_of((64, 80), shifts, noise=1)
        (said,) = (each for each in budget.findings if each.kind == "noise")
        assert "the error by noise is not known" in said.message
        assert np.isnan([budget.rms, budget.rms_by_cause["noise"]]).all()
        assert budget.components == 1

    def test_noise_is_known_where_whole_shifts_leave_corners_alone(self):
        far = np.array([(0, 20), (6, 13), (11, 9), (15, 4), (20, 0)])
        assert plan.identify((64, 80), far).components > 1
        between = budget_of((64, 80), far + 0.2 * np.eye(5, 2), noise=1)
        assert 0 < between.rms < np.inf

    def test_of_parts_that_nothing_compares(self):
        with pytest.warns(IdentifiabilityWarning, match="4 parts"):
            budget = budget_of((80, 100), equipix.cross_pattern(4, 6), noise=1)
        # Each part is a sensor of half the pitch with a cross of (2, 3).
        alone = budget_of((40, 50), equipix.cross_pattern(2, 3), noise=1)
        # Both from 24 draws, whose mean squares scatter by 16 %: with such short shifts long waves
        # make up much of the error.
        assert budget.rms == pytest.approx(alone.rms, rel=3 * 0.16 / 2 * np.sqrt(2 / 24))

    @pytest.mark.parametrize("width", [None, 9.0])
    def test_the_local_variance_is_what_its_formula_says(self, width):
        shape, rng = (70, 6), np.random.default_rng(3)
        positions, powers = rng.integers(-4, 5, (7, 2)), rng.uniform(0.5, 1.5, 7)
        centre = (np.array(shape) - 1) / 2
        seen: dict[tuple[int, int], float] = {}
        for position, power in zip(positions, powers, strict=True):
            for p in np.ndindex(shape):
                cell = tuple((p + position).tolist())
                seen[cell] = seen.get(cell, 0) + power**2
        wanted = np.empty(shape)
        for p in np.ndindex(shape):
            cells = p + positions
            away = np.zeros(7) if width is None else ((cells - centre) ** 2).sum(axis=1)
            weight = powers**2 * np.exp(-2 * away / (width or 1) ** 2)
            counts = np.array([seen[tuple(cell)] for cell in cells.tolist()])
            wanted[p] = 1 / (weight.sum() - np.sum(powers**2 * weight / counts))
        found = LocalVariance(shape, positions, powers, width).at(*map(np.arange, shape))
        # Sums of seven terms of one sign, but for a difference of some tenths of them.
        np.testing.assert_allclose(found, wanted, rtol=1e-12)

    @pytest.mark.parametrize("width", [None, 150.0])
    @pytest.mark.parametrize("shape", [(200, 300), (7, 190), (45, 12)])
    def test_the_mean_of_the_local_variance_is_that_of_all_pixels(self, shape, width):
        rng = np.random.default_rng(4)
        positions, powers = rng.integers(0, 7, (5, 2)), rng.uniform(0.5, 1.5, 5)
        local = LocalVariance(shape, positions, powers, width)
        # The beam is analytic: 32 nodes leave rounding, of sums over 60 000 pixels.
        wanted = np.mean(local.at(*map(np.arange, shape)))
        assert local.mean == pytest.approx(wanted, rel=6e4 * np.finfo(float).eps)

    def test_the_map_and_parts_of_it(self):
        budget = budget_of((150, 40), CROSS, noise=1e-3, beam_width=90)
        assert budget.noise_map.shape == (150, 40)
        rows, cols = np.array([3, 70, 149]), np.array([0, 39])
        np.testing.assert_array_equal(budget.noise_at(rows, cols), budget.noise_map[rows][:, cols])
        rms = np.sqrt(np.mean(budget.noise_map**2))
        assert budget.rms_by_cause["noise"] == pytest.approx(rms, rel=6e3 * np.finfo(float).eps)

    # Of a strip the ends count as on 16 spans of its length, which is too much where shifts are
    # nearly periodic.
    @pytest.mark.study
    @pytest.mark.parametrize(
        ("name", "spans"),
        [
            *product((*PATTERNS, "far"), [(3, 3), (4, 5), (8, 6), (16, 16)]),
            *product(("long arms", "corners", "nine", "far"), [(1.5, 24)]),
        ],
    )
    def test_the_noise_of_a_large_sensor_follows_from_a_part(self, monkeypatch, name, spans):
        far = np.random.default_rng(4).integers(0, 25, (6, 2))
        positions = far if name == "far" else np.array(PATTERNS[name][1])
        shape = tuple((spans * np.ptp(positions, axis=0)).astype(int).tolist())
        monkeypatch.setattr(pattern_errors, "_PIXELS", 800_000)
        monkeypatch.setattr(pattern_errors, "_MOST", 120)
        monkeypatch.setattr(pattern_errors, "_SMALLEST", 16)
        by_law = pattern_errors.factor(shape, positions, np.ones(len(positions)))
        monkeypatch.setattr(pattern_errors, "_SMALLEST", 1000)
        drawn = pattern_errors.factor(shape, positions, np.ones(len(positions)))
        assert np.sqrt(by_law) == pytest.approx(np.sqrt(drawn), rel=WITHIN)

    def test_a_large_sensor_takes_no_longer_to_solve(self):
        small, large = (budget_of((size, size), CROSS, noise=1).rms for size in (256, 2000))
        # Edges matter less: their share falls from 19/256 to nothing.
        assert small * (1 - 0.05) < large < small

    def test_150_megapixels_take_the_memory_of_a_small_sensor(self):
        tracemalloc.start()
        try:
            budget = budget_of((10240, 14648), CROSS, noise=1, beam_width=20_000)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        # A map of the errors would take 1.2 GB.
        assert peak < 100e6
        # Without edges: the root of the mean of 1/λ, in a beam that falls to 0.82 at the corners.
        rows, cols = (2 * np.pi * (np.arange(1000) + 0.5) / 1000 for _ in range(2))
        inverse = 1 / pattern_errors.symbol(rows, cols, CROSS, np.ones(5))
        even = np.sqrt(inverse.mean())
        assert even < budget.rms < even / 0.82

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"noise": 0}, "'noise' is 0"),
            ({"noise": np.nan}, "'noise' is nan"),
            ({"noise": 1, "drift": -1}, "'drift' is -1"),
            ({"noise": 1, "beam_width": 0}, "'beam_width' is 0"),
            ({"noise": 1, "flux": [1, 1]}, "'flux' has 2 entries, expected 5"),
            ({"noise": 1, "flux": [1, 1, 0, 1, 1]}, "'flux' is"),
        ],
    )
    def test_refuses(self, options, words):
        with pytest.raises(InputError) as error:
            plan.error_budget((64, 80), CROSS, **options)
        assert words in str(error.value)


def test_a_shift_error_in_an_even_beam_is_named(run):
    arguments = (
        "plan",
        "--shape",
        "60",
        "80",
        "--shifts",
        "0,0 0,5 0,7 5,0 7,0",
        "--noise",
        "1e-3",
    )
    status, _, err = run(*arguments, "--shift-error", "0.1")
    assert status == 0
    assert "--shift-error has no effect in an even beam: give --beam-width" in err
    assert "even beam" not in run(*arguments, "--shift-error", "0.1", "--beam-width", "100")[2]
