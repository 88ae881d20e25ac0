"""The tilt that lamp drift leaves and the share of a trend that shows, and who asks for them."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import plan, simulate
from equipix.diagnosis.inputs import BEFORE
from equipix.findings import ask
from equipix.plan import drift
from given import exposures_of

CROSS = equipix.cross_pattern(11, 19).astype(float)
CCD = (582, 782)
EPS = np.finfo(float).eps


def dense_covariance(shifts, flux_std):
    """(DᵀD)⁻¹Dᵀ diag(ε²) D(DᵀD)⁻¹ as it stands, and the condition of DᵀD."""
    away = shifts - shifts.mean(axis=0)
    inverse = np.linalg.inv(away.T @ away)
    fit = inverse @ away.T
    return fit @ np.diag(np.square(flux_std)) @ fit.T, np.linalg.cond(away.T @ away)


@pytest.mark.parametrize("seed", range(8))
def test_slopes_are_those_of_least_squares(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(3, 12))
    shifts = rng.normal(0, (20, 5), (count, 2))
    shifts[:, 1] += shifts[:, 0] * rng.uniform(-0.2, 0.2)
    errors = rng.uniform(0, 1e-3, count)
    wanted, condition = dense_covariance(shifts, errors)
    # Sums of up to 12 terms and two inverses, as ill-conditioned as the matrix.
    np.testing.assert_allclose(
        drift.slope_std(shifts, errors), np.sqrt(np.diag(wanted)), rtol=50 * EPS * condition
    )


def test_equal_errors_have_the_formula_of_the_covariance():
    covariance = np.cov(CROSS.T, bias=True)
    wanted = 1e-4 * np.sqrt(np.diag(np.linalg.inv(covariance)) / 5)
    np.testing.assert_allclose(drift.slope_std(CROSS, 1e-4), wanted, rtol=100 * EPS)
    rho = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    edge = 1e-4 * np.array(CCD) / np.sqrt(5 * np.diag(covariance) * (1 - rho**2))
    np.testing.assert_allclose(drift.tilt_of_fluxes(CCD, CROSS, 1e-4), edge, rtol=100 * EPS)


def test_many_patterns_are_done_as_one_by_one():
    rng = np.random.default_rng(9)
    patterns = rng.integers(0, 40, (6, 3, 5, 2))
    errors = rng.uniform(0, 1e-3, 5)
    together = drift.tilt_of_fluxes(CCD, patterns, errors)
    assert together.shape == (6, 3, 2)
    for place in np.ndindex(6, 3):
        # Sums of five terms in another order.
        alone = drift.tilt_of_fluxes(CCD, patterns[place], errors)
        np.testing.assert_allclose(together[place], alone, rtol=100 * EPS)
    rms = drift.tilt_rms(together)
    np.testing.assert_allclose(rms, np.sqrt(np.sum(together**2, axis=-1) / 12), rtol=10 * EPS)


@pytest.mark.parametrize(
    ("shifts", "wanted"),
    [
        ([(0, 0), (0, 2), (0, 5)], (np.inf, 1 / np.sqrt(3 * 38 / 9))),
        ([(0, 0), (2, 0), (5, 0)], (1 / np.sqrt(3 * 38 / 9), np.inf)),
        ([(0, 0), (1, 2), (3, 6)], (np.inf, np.inf)),
        ([(4, 4), (4, 4), (4, 4)], (np.inf, np.inf)),
        ([(0.1, 0.1)], (np.inf, np.inf)),
    ],
)
def test_what_the_shifts_do_not_determine_is_infinite(shifts, wanted):
    found = drift.slope_std(np.array(shifts, float), 1.0)
    np.testing.assert_allclose(found, wanted, rtol=10 * EPS)


def test_a_row_of_pixels_has_no_tilt_across_and_a_steady_lamp_leaves_none():
    line = np.array([(0, 0), (0, 2), (0, 5)])
    np.testing.assert_allclose(
        drift.tilt_of_fluxes((1, 40), line, 1e-3), (0, 0.04 / np.sqrt(3 * 38 / 9)), rtol=10 * EPS
    )
    np.testing.assert_array_equal(drift.tilt_of_fluxes((30, 40), line, 0), (0, 0))


def test_all_callers_agree():
    wanted = drift.tilt_of_fluxes((64, 80), CROSS, 1e-4)
    budget = plan.error_budget((64, 80), CROSS, noise=1e-2, drift=1e-4)
    assert budget.tilt_by_cause["drift"] == tuple(wanted)
    assert budget.rms_by_cause["drift"] == drift.tilt_rms(wanted)
    np.testing.assert_array_equal(plan.tilt_std((64, 80), CROSS, flux_std=np.full(5, 1e-4)), wanted)


class TestTrend:
    @pytest.mark.parametrize("seed", range(6))
    def test_is_one_minus_r_squared(self, seed):
        rng = np.random.default_rng(seed)
        count = int(rng.integers(4, 12))
        shifts, times = rng.normal(0, 10, (count, 2)), rng.uniform(0, 600, count)
        affine = np.column_stack([np.ones(count), shifts])
        left = times - affine @ np.linalg.lstsq(affine, times)[0]
        wanted = np.sum(left**2) / np.sum((times - times.mean()) ** 2)
        # Shares of a whole of 1, found by two factorisations of this condition.
        limit = 100 * EPS * np.linalg.cond(affine)
        assert drift.distinct_trend(shifts, times) == pytest.approx(wanted, abs=limit)

    def test_does_not_depend_on_units(self):
        rng = np.random.default_rng(3)
        times = rng.uniform(0, 600, 5)
        told = drift.distinct_trend(CROSS, times)
        turned = CROSS @ np.array([[2.0, 1.0], [-1.0, 3.0]]) + 7
        assert drift.distinct_trend(turned, times) == pytest.approx(told, abs=100 * EPS)
        # Each of five times, of a spread of some 200, is rounded to half an eps of 1e6; the share
        # goes with their square.
        limit = 5 * EPS * 1e6 / 200
        assert drift.distinct_trend(CROSS, 1e6 + times) == pytest.approx(told, abs=limit)

    def test_at_its_ends(self):
        assert drift.distinct_trend(CROSS, CROSS @ (2.0, 3.0)) == pytest.approx(0, abs=100 * EPS)
        assert drift.distinct_trend(CROSS, np.full(5, 60.0)) == 1
        assert drift.distinct_trend(np.ones((5, 2)), np.arange(5)) == 1

    def test_the_plan_and_the_warning_agree(self):
        told = drift.distinct_trend(CROSS)
        assert drift.distinct_trend(CROSS, np.arange(5)) == told
        frames = simulate.exposures(np.ones((24, 32)), simulate.gaussian_beam((24, 32)), CROSS)
        times = {"flux": "linear", "time": [0.0, 10.0, 20.0, 30.0, 40.0]}
        advised = ask(BEFORE, exposures_of(frames, CROSS, **times))
        assert [finding.kind for finding in advised] == ["order"]
        assert f"only {told:.1%} of the variance" in advised[0].message
        order = plan.advise_order(CROSS)
        assert ask(BEFORE, exposures_of(frames, CROSS[order], **times)) == ()
        assert ask(BEFORE, exposures_of(frames, CROSS, flux="fit")) == ()
