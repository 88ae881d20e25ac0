"""Findings: the limit of each at both sides, and what follows from one."""

from __future__ import annotations

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.diagnosis.evidence import Evidence
from equipix.diagnosis.rules import AFTER
from equipix.errors import ConvergenceWarning, InputWarning, MisfitWarning
from equipix.exposures.exposures import FitOptions
from equipix.findings import Finding, Rule, ask, say
from equipix.fitting import windows
from equipix.fitting.weighted import Options, weighted_fit
from equipix.fitting.windows import WindowFit
from given import exposures_of

CROSS = equipix.cross_pattern(3, 5)


class Changed:
    """A fit that differs in what is given."""

    def __init__(self, fit, **found):
        self.__dict__.update(found, _fit=fit)

    def __getattr__(self, name):
        return getattr(self._fit, name)


@pytest.fixture(scope="module")
def evidence():
    """Evidence of a small joint fit with which nothing is wrong."""
    frames = experiment()
    exposures = exposures_of(frames, CROSS, variance=np.full(5, 1e-6), shift_std=0.01)
    options = Options(FitOptions(), uncertainty=True)
    weighted = weighted_fit(exposures, options)
    assert weighted.fit.is_joint
    return Evidence.of(weighted, options, exposures.flux)


def findings_on(evidence, *, uncertainty=True, **found):
    """Findings on a fit that differs from a good one in what is given."""
    weighted = evidence.weighted._replace(fit=Changed(evidence.fit, **found))
    options = dataclasses.replace(evidence.options, uncertainty=uncertainty)
    # The last question fits again, from this fit.
    return ask(AFTER[:-1], dataclasses.replace(evidence, weighted=weighted, options=options))


def kinds(evidence, **found):
    return [finding.kind for finding in findings_on(evidence, **found)]


def test_a_good_fit_has_no_finding(evidence):
    assert kinds(evidence) == []
    assert ask(AFTER, evidence) == ()


def test_a_finding_explains_others_and_stands_in_the_place_of_others():
    rules = [
        Rule("first", "input", lambda e: e.get("first")),
        Rule("explained", "misfit", lambda e: e.get("explained"), unless=frozenset({"first", "x"})),
        Rule("better", "misfit", lambda e: e.get("better"), instead=frozenset({"explained"})),
    ]

    def told(before=(), **evidence):
        return [each.kind for each in ask(rules, evidence, before)]

    assert told(first="a", explained="b") == ["first"]
    assert told(explained="b") == ["explained"]
    assert told([Finding("x", "", "input")], explained="b") == []
    assert told(explained="b", better="c") == ["better"]
    assert told(first="") == []


def test_a_warning_has_the_kind_of_its_finding_and_the_line_of_the_caller():
    finding = Finding("range", "too wide", "input")
    with pytest.warns(InputWarning, match="too wide") as caught:
        assert say(finding) == (finding,)
    assert caught[0].message.kind == "range"
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    ("kind", "within", "beyond"),
    [
        ("pattern", {"smallest_ritz": 1e-4}, {"smallest_ritz": 0.999e-4}),
        (
            "uncertainty",
            {"error_estimate": np.array([3.0, 0.1])},
            {"error_estimate": np.array([0.01, 0.1001])},
        ),
    ],
)
def test_a_limit_at_both_sides(evidence, kind, within, beyond):
    assert kinds(evidence, **within) == []
    assert kinds(evidence, **beyond) == [kind]


def test_messages_contain_the_value_and_the_limit(evidence):
    for found, value, limit in (
        ({"smallest_ritz": 2e-5}, "2.0e-05", "limit 0.0001"),
        ({"error_estimate": np.array([0.3])}, "3.0e-01", "limit 0.1"),
    ):
        (finding,) = findings_on(evidence, **found)
        assert value in finding.message
        assert limit in finding.message


def test_standard_deviations_are_missed_only_where_asked_for_after_a_joint_fit(
    evidence,
):
    far = {"error_estimate": np.array([0.3])}
    assert kinds(evidence, **far) == ["uncertainty"]
    assert kinds(evidence, **far, uncertainty=False) == []
    assert kinds(evidence, **far, is_joint=False) == []


@pytest.mark.parametrize(
    ("found", "remedy"),
    [
        ({"ended": "stalled"}, "use a larger 'tolerance', more positions or closer ones, or mask"),
        ({"ended": "stalled", "error_estimate": np.array([2.0])}, "use more light or more frames"),
        ({"ended": "sweeps used"}, "allow more sweeps"),
    ],
)
def test_measurements_left_out_add_a_remedy_and_take_none(evidence, found, remedy):
    """Where there is a mask, whatever their number: one of a million says little of the search."""
    found = {"error_estimate": np.array([1e-3]), "lost": []} | found
    plain = findings_on(evidence, **found, uncertainty=False)[-1].message
    assert remedy in plain
    assert "left out" not in plain
    lost = found | {"lost": [[], [7]]}
    assert findings_on(evidence, **lost, uncertainty=False)[-1].message == plain
    mask = np.zeros(evidence.exposures.shape, bool)
    mask[:, :3] = True
    masked = evidence.exposures.without(mask)
    evidence = dataclasses.replace(evidence, weighted=evidence.weighted._replace(exposures=masked))
    one, many = (
        findings_on(evidence, **found | {"lost": lost}, uncertainty=False)[-1].message
        for lost in ([[], [7]], [[1, 2], [7]])
    )
    assert one == (
        f"{plain}. Besides, 1 measurement along ragged edges of masks was left out: where that is "
        "many, use masks with smooth edges"
    )
    assert many.startswith(f"{plain}. Besides, 3 measurements along ragged edges of masks were ")


@pytest.mark.parametrize(
    ("most", "words"),
    [
        (2, r" 8 sweeps \(limit 2; the step that was begun is completed\): the"),
        (8, " 8 sweeps: the"),
    ],
)
def test_sweeps_beyond_their_limit_are_explained(evidence, most, words):
    options = dataclasses.replace(evidence.options, fit=FitOptions(max_sweeps=most))
    found = {"ended": "sweeps used", "sweeps": np.array([8]), "error_estimate": np.array([1e-3])}
    limited = dataclasses.replace(evidence, options=options)
    assert re.search(words, findings_on(limited, **found, uncertainty=False)[-1].message)


def experiment(noise=1e-3, contrast=0.0, shifts=CROSS + 0.25):
    rng = np.random.default_rng(3)
    truth = simulate.cosine_sensitivity((24, 30), rng=rng)
    truth *= 1 + contrast * np.linspace(-1, 1, 30)
    frames = simulate.exposures(truth, simulate.wavy_beam((24, 30), rng=1), shifts)
    return frames + noise * rng.standard_normal(frames.shape)


def test_a_fit_too_far_from_its_minimum_has_no_standard_deviations():
    shifts = CROSS + 0.25 * np.eye(5, 2)
    frames = experiment(contrast=0.8, shifts=shifts)
    with (
        pytest.warns(ConvergenceWarning, match="no standard deviations: .* limit 0.1"),
        pytest.warns(ConvergenceWarning, match="not converged"),
    ):
        cal = equipix.calibrate(
            frames, shifts, variance=np.full(5, 1e-6), max_sweeps=1, uncertainty=True
        )
    assert "uncertainty" in [finding.kind for finding in cal.findings]
    assert cal.error_estimate > 0.1
    assert cal.sensitivity_std is cal.tilt_std is cal.shift_std is None


def test_five_standard_errors_and_three_per_cent_are_the_limit_of_chi_square():
    frames = experiment()[:, :, :28]
    plain = equipix.calibrate(frames, CROSS, variance=np.full(5, 1e-6))
    # Reduced χ² goes with 1/variance; the fit does not depend on their common factor.
    freedom = plain.weighted.fit.degrees_of_freedom
    limit = max(0.03, 5 * np.sqrt(2 / freedom))
    for chi2 in (1 + 0.99 * limit, 1 - 0.99 * limit):
        variance = np.full(5, plain.reduced_chi2 * 1e-6 / chi2)
        assert equipix.calibrate(frames, CROSS, variance=variance).findings == ()
    for chi2 in (1 + 1.01 * limit, 1 - 1.01 * limit):
        variance = np.full(5, plain.reduced_chi2 * 1e-6 / chi2)
        with pytest.warns(MisfitWarning, match="times as large as the variances predict"):
            equipix.calibrate(frames, CROSS, variance=variance)


def window_fit(left, freedom, *, rng):
    """A settled fit of a window with residuals of that mean square."""
    fit = SimpleNamespace(error_estimate=np.array([1e-9]), ended="converged")
    residuals = np.sqrt(left) * rng.choice([-1.0, 1.0], (3, 8, 8))
    return WindowFit(fit, left, freedom, 1.0, 1.0, residuals)


@pytest.mark.parametrize("freedom", [1000, 7200, 10**6])
def test_an_orientation_needs_six_standard_deviations(freedom):
    """√(2/dof) is the standard deviation of F/dof, relative to it."""
    rng = np.random.default_rng(1)
    limit = 6 * np.sqrt(2 / freedom)
    low = window_fit(0.7, freedom, rng=rng)
    assert window_fit(0.7 * (1 + 1.001 * limit), freedom, rng=rng).is_far_above(low)
    assert not window_fit(0.7 * (1 + 0.999 * limit), freedom, rng=rng).is_far_above(low)
    few = [window_fit(left, 999, rng=rng) for left in (0.7, 7.0)]
    assert not few[1].is_far_above(few[0])


def test_nothing_is_concluded_from_a_misfit_of_half_a_per_cent():
    rng = np.random.default_rng(2)
    low = window_fit(1e-8, 10**4, rng=rng)
    assert window_fit(1e-8 + 1.01 * 0.005**2, 10**4, rng=rng).is_far_above(low)
    assert not window_fit(1e-8 + 0.99 * 0.005**2, 10**4, rng=rng).is_far_above(low)


@pytest.mark.parametrize("freedom", [1000, 10**6])
def test_an_order_explains_only_what_is_above_known_noise(freedom):
    rng = np.random.default_rng(3)
    limit = 6 * np.sqrt(2 / freedom)

    def explains(best, given):
        best, given = (window_fit(left, freedom, rng=rng) for left in (best, given))
        return windows._explains(best, given, knows_noise=True)

    # Where the variances are too large, 0.25 is further below 1 than a tenth of 0.18 is.
    assert not explains(0.25, 0.18)
    assert not explains(0.18, 0.25)
    assert not explains(0.9, 1 + 0.999 * limit)
    assert explains(1, 1 + 1.001 * limit)
    assert not explains(1.11, 2)
    assert explains(1.09, 2)
