"""Verdicts: the limit of each at both sides, and what follows from one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.calibration import verdicts
from equipix.calibration.options import Options
from equipix.calibration.sign import SignTest, _lower, _Residuals
from equipix.calibration.weights import Weighted
from equipix.errors import ConvergenceWarning, MisfitWarning
from equipix.exposures.options import FitOptions

CROSS = equipix.cross_pattern(3, 5)
GOOD = {
    "ended": "converged",
    "components": 1,
    "smallest_ritz": None,
    "leaves_tilt": False,
    "is_joint": True,
    "error_estimate": np.array([1e-7]),
    "misfit": 1000.0,
    "degrees_of_freedom": 1000,
}
"""What verdicts read of a fit with which nothing is wrong."""


def verdicts_on(*, variance=True, uncertainty=True, **found):
    """Verdicts on a fit that differs from a good one in what is given."""
    exposures = SimpleNamespace(variance=np.ones(5) if variance else None)
    weighted = Weighted(exposures, SimpleNamespace(**GOOD | found), None)
    options = Options(FitOptions(), uncertainty=uncertainty)
    return verdicts.on_fit(weighted, options, SignTest("undetermined"), None)


def kinds(**found):
    return [verdict.kind for verdict in verdicts_on(**found)]


def test_a_good_fit_has_no_verdict():
    assert kinds() == []


@pytest.mark.parametrize(
    ("kind", "within", "beyond"),
    [
        ("pattern", {"smallest_ritz": 1e-4}, {"smallest_ritz": 0.999e-4}),
        ("misfit", {"misfit": 4000.0}, {"misfit": 4000.1}),
        (
            "uncertainty",
            {"error_estimate": np.array([3.0, 0.1])},
            {"error_estimate": np.array([0.01, 0.1001])},
        ),
    ],
)
def test_a_limit_at_both_sides(kind, within, beyond):
    assert kinds(**within) == []
    assert kinds(**beyond) == [kind]


def test_messages_contain_the_value_and_the_limit():
    for found, value, limit in (
        ({"smallest_ritz": 2e-5}, "2.0e-05", "limit 0.0001"),
        ({"misfit": 9000.0}, "3.0 times", "limit 2"),
        ({"error_estimate": np.array([0.3])}, "3.0e-01", "limit 0.1"),
    ):
        (verdict,) = verdicts_on(**found)
        assert value in verdict.message
        assert limit in verdict.message


def test_no_misfit_is_found_without_known_variances():
    assert kinds(misfit=9000.0, variance=False) == []


def test_standard_deviations_are_missed_only_where_asked_for_after_a_joint_fit():
    far = {"error_estimate": np.array([0.3])}
    assert kinds(**far, uncertainty=False) == []
    assert kinds(**far, is_joint=False) == []


def experiment(noise=1e-3, contrast=0.0):
    rng = np.random.default_rng(3)
    truth = simulate.cosine_sensitivity((24, 30), rng=rng)
    truth *= 1 + contrast * np.linspace(-1, 1, 30)
    frames = simulate.exposures(truth, simulate.wavy_beam((24, 30), rng=1), CROSS + 0.25)
    return frames + noise * rng.standard_normal(frames.shape)


def test_a_fit_too_far_from_its_minimum_has_no_standard_deviations():
    frames = experiment(contrast=0.8)
    with (
        pytest.warns(ConvergenceWarning, match="no standard deviations: .* limit 0.1"),
        pytest.warns(ConvergenceWarning, match="not converged"),
    ):
        cal = equipix.calibrate(
            frames, CROSS + 0.25, variance=np.full(5, 1e-6), max_sweeps=1, uncertainty=True
        )
    assert "uncertainty" in [verdict.kind for verdict in cal.verdicts]
    assert cal.error_estimate > 0.1
    assert cal.sensitivity_std is cal.tilt_std is cal.shift_std is None


def test_residuals_twice_as_large_as_predicted_are_the_limit():
    frames = experiment()[:, :, :28]
    shifts = CROSS
    plain = equipix.calibrate(frames, shifts, variance=np.full(5, 1.0))
    # Reduced χ² goes with 1/variance; the fit does not depend on their common factor.
    at_limit = plain.reduced_chi2 / 4
    assert equipix.calibrate(frames, shifts, variance=np.full(5, 1.01 * at_limit)).verdicts == ()
    with pytest.warns(MisfitWarning, match=r"2\.0 times as large"):
        equipix.calibrate(frames, shifts, variance=np.full(5, 0.99 * at_limit))


@pytest.mark.parametrize("lower", [0, 1])
@pytest.mark.parametrize("freedom", [1000, 7200, 10**6])
def test_the_sign_needs_six_standard_deviations(lower, freedom):
    """√(2/dof) is the standard deviation of F/dof, relative to it."""

    def fits(ratio):
        excess = np.full((3, 8, 8), 1.0)
        low, high = (
            _Residuals(
                left=left,
                freedom=freedom,
                squares=left * excess,
                noise=1e-3,
                error=1e-6,
                stuck=False,
            )
            for left in (0.7, 0.7 * ratio)
        )
        return [low, high] if lower == 0 else [high, low]

    limit = 6 * np.sqrt(2 / freedom)
    assert _lower(fits(1 + 1.001 * limit)) == lower
    assert _lower(fits(1 + 0.999 * limit)) is None
    assert _lower([each._replace(freedom=999) for each in fits(10.0)]) is None
