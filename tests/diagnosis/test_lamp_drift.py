"""`cal.drift`: what the data say of fluxes that were given, and the tilt that a drift hides."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.diagnosis import lamp_drift as lamp_drift_module
from equipix.diagnosis.lamp_drift import lamp_drift
from equipix.errors import EquipixWarning, MisfitWarning
from equipix.exposures.exposures import FitOptions
from equipix.fitting.residuals import left_by, sampled
from equipix.fitting.weighted import Options, weighted_fit
from equipix.measured.noise import chi2_tail
from equipix.metrics.maps import tilt, tilt_weights
from equipix.plan.drift import affine_columns, distinct_trend, slope_covariance, slope_std
from given import exposures_of

SENSOR, NOISE = (48, 64), 1e-3
CROSS = equipix.cross_pattern(5, 7)
SEVEN = np.array([(0, 0), (3, 9), (9, 2), (-7, 8), (5, -9), (-3, -8), (-9, 1)], float)


def photograph(rng, drift, shifts=SEVEN, **how):
    flux = np.exp(drift * rng.standard_normal(len(shifts)))
    truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
    beam = simulate.gaussian_beam(SENSOR, width=150)
    frames = simulate.exposures(truth, beam, shifts, flux=flux, **how)
    return frames + NOISE * rng.standard_normal(frames.shape), truth, flux


def estimated(seed, drift, shifts=SEVEN, **options):
    """The drift that is found, and the error of the tilt."""
    frames, truth, flux = photograph(np.random.default_rng([1, seed]), drift, shifts)
    exposures = exposures_of(frames, shifts, variance=np.full(len(shifts), NOISE**2), **options)
    weighted = weighted_fit(exposures, Options(FitOptions(tolerance=1e-6)))
    valid = np.ones(SENSOR, bool)
    error = tilt(weighted.fit.sensitivity, valid) - tilt(truth, valid)
    return lamp_drift(weighted, sampled(weighted)), error, flux


@pytest.mark.study
def test_fluxes_without_drift_scatter_as_noise_does(draws, figure):
    """Probabilities of n right experiments are even: Kolmogorov's limit of 1e-3 is 1.95/√n."""
    found = np.sort([estimated(seed, 0.0)[0].probability for seed in draws(100)])
    ranks = (np.arange(found.size) + 0.5) / found.size
    distance, limit = np.abs(found - ranks).max(), 1.95 / found.size**0.5
    figure(
        "probabilities of no drift, distance from an even distribution", distance, f"< {limit:.3f}"
    )
    assert distance < limit


@pytest.mark.parametrize("light", [0.8, 0.995, 1.003, 1.3])
@pytest.mark.parametrize(
    ("shifts", "wrong", "alike"),
    [(SEVEN, 2, {2}), (CROSS, 0, {0}), (CROSS, 3, {3, 4})],
    ids=["seven", "first of a cross", "one arm of a cross"],
)
def test_one_exposure_of_other_light_is_named(shifts, wrong, alike, light):
    """Two positions on one arm of a cross leave the same residual: (2, -7, 5) at 0, 5 and 7."""
    frames, *_ = photograph(np.random.default_rng(1), 0.0, shifts)
    frames[wrong] *= light
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        drift = equipix.calibrate(frames, shifts, variance=np.full(len(shifts), NOISE**2)).drift
    assert re.search(rf"exposure {wrong} \(from 0\) by [+-]\d+\.\d\d%", drift.words)
    found = {name: np.log(times) for name, times in drift.alone}
    assert found.keys() == {f"exposure {k} (from 0)" for k in alike}
    # A linear step; and of the squares of an error the columns leave a tenth or more.
    error = np.log(light)
    limit = error**2 / 2 + 5 * drift.flux_std / 0.1**0.5
    assert abs(found[f"exposure {wrong} (from 0)"] - error) < limit
    if len(alike) > 1:
        other = found["exposure 4 (from 0)"]
        assert other / found["exposure 3 (from 0)"] == pytest.approx(-7 / 5, rel=1e-2)


def test_no_exposure_is_named_where_all_fluxes_drift():
    drift, *_ = estimated(0, 1e-2)
    assert drift.is_certain
    assert drift.alone == ()


def test_a_position_off_the_line_of_all_others_is_never_named():
    """Its flux leaves no residual but that of rounding."""
    shifts = np.array([(0, 0), (0, 5), (0, 7), (0, 11), (7, 0)], float)
    flux, names = np.array([0.01, 0.0, 0.0, 0.0, 0.02]), [f"exposure {k}" for k in range(5)]
    columns = affine_columns(shifts, None)
    found = lamp_drift_module._alone(names, columns, flux, np.full(5, 1e-8))
    assert [name for name, _ in found] == ["exposure 0"]
    assert found[0][1] == pytest.approx(np.exp(0.01))


@pytest.mark.study
def test_a_drift_of_thirty_standard_errors_is_found(draws, figure):
    shown = estimated(0, 0.0)[0].flux_std
    found = [estimated(seed, 30 * shown)[0] for seed in draws(60)]
    # With four degrees of freedom one in 6000 is missed.
    assert all(each.is_certain for each in found)
    # χ² of 60 × 4 degrees of freedom: the root mean square scatters by 4.6 %; three of these.
    ratio = np.mean([each.size**2 for each in found]) ** 0.5 / (30 * shown)
    limit = 0.15 * (60 / len(found)) ** 0.5
    figure("drift found over the true one, rms", ratio, f"1 ± {limit:.2f}")
    assert ratio == pytest.approx(1, abs=limit)


@pytest.mark.study
def test_the_tilt_follows_students_t(draws, figure):
    """Errors over their standard deviations: 50 and 90 % of t with four degrees of freedom."""
    found = [estimated(seed, 1e-3) for seed in draws(100)]
    ratio = np.abs([error / drift.tilt_std for drift, error, _ in found])
    for quantile, share in ((0.741, 0.5), (2.132, 0.9)):
        # Two values for each experiment: four standard errors of a share.
        limit = 4 * (share * (1 - share) / ratio.size) ** 0.5
        below = np.mean(ratio < quantile)
        figure(f"tilts below the quantile of {share} of t", below, f"{share} ± {limit:.2f}")
        assert below == pytest.approx(share, abs=limit)


def test_a_drift_that_is_not_linear_contradicts_a_linear_one():
    times = np.arange(7.0)
    drift, _, _ = estimated(1, 1e-3, flux="linear", time=times)
    assert drift.degrees_of_freedom == 3
    assert drift.is_certain


def test_it_is_not_asked_where_fluxes_are_found():
    for options in ({"flux": "fit"}, {"flux": np.ones(7), "flux_std": 1e-3}):
        assert estimated(1, 1e-3, **options)[0] is None
    assert estimated(1, 1e-3, SEVEN[:3])[0] is None


def test_it_is_said_and_added_to_error_bars(tmp_path):
    frames, _, _ = photograph(np.random.default_rng(2), 1e-3)
    variance = np.full(7, NOISE**2)
    with pytest.warns(MisfitWarning, match="contradict the fluxes.*4 degrees of freedom"):
        cal = equipix.calibrate(frames, SEVEN, variance=variance, uncertainty=True)
    assert [finding.kind for finding in cal.findings] == ["drift"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        free = equipix.calibrate(frames, SEVEN, variance=variance, flux="fit", uncertainty=True)
    noise = free.sensitivity_std
    rows, cols = np.indices(SENSOR)
    away = np.stack([rows - rows.mean(), cols - cols.mean()])
    hidden = np.einsum("arc,ab,brc->rc", away, cal.drift.slope_covariance, away)
    # M is 1 within 10 %, and so the place where a tilt leaves it.
    np.testing.assert_allclose(cal.sensitivity_std, np.hypot(noise, np.sqrt(hidden)), rtol=0.15)
    weights = tilt_weights(np.ones(SENSOR, bool))
    np.testing.assert_allclose(cal.std_of(weights), cal.tilt_std, rtol=1e-3)
    cal.save(tmp_path / "cal.npz")
    kept = equipix.load(tmp_path / "cal.npz").drift
    np.testing.assert_array_equal(kept.slope_covariance, cal.drift.slope_covariance)
    assert kept.degrees_of_freedom == 4


def test_sensors_turned_alike_see_the_same_drift():
    """A sensor turned by 180°: shifts run the other way along its axes."""
    rng = np.random.default_rng(3)
    frames, _, _ = photograph(rng, 1e-3)
    turned = np.ascontiguousarray(frames[:, ::-1, ::-1])
    found = []
    for values, rotation in ((frames, None), (turned, np.full(7, 180))):
        exposures = exposures_of(values, SEVEN, rotation=rotation, variance=np.full(7, NOISE**2))
        weighted = weighted_fit(exposures, Options(FitOptions(tolerance=1e-6)))
        found.append(lamp_drift(weighted, sampled(weighted)))
    assert found[1].size == pytest.approx(found[0].size, rel=1e-3)
    np.testing.assert_allclose(found[1].tilt_std, found[0].tilt_std, rtol=1e-3)


def test_the_covariance_of_slopes_has_their_standard_deviations():
    covariance = slope_covariance(SEVEN, 1e-3, None, np.full(7, 5.0))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), slope_std(SEVEN, 1e-3), rtol=1e-12)
    # An exposure of no weight is as one that is not there.
    light = slope_covariance(SEVEN, 1e-3, None, np.array([1, 1, 1, 1, 1, 1, 1e-12]))
    np.testing.assert_allclose(light, slope_covariance(SEVEN[:6], 1e-3, None, np.ones(6)), 1e-9)


@pytest.mark.parametrize("drift", [0.0, 1e-3])
def test_a_noisy_exposure_hides_no_drift_and_feigns_none(drift):
    """The first exposure has a hundred times the noise; six others leave three combinations."""
    variance = np.full(7, NOISE**2)
    variance[0] *= 1e4
    options = Options(FitOptions(tolerance=1e-6))
    for seed in range(8):
        rng = np.random.default_rng([2, seed])
        frames, _, _ = photograph(rng, drift)
        frames[0] += 100 * NOISE * rng.standard_normal(SENSOR)
        weighted = weighted_fit(exposures_of(frames, SEVEN, variance=variance), options)
        found = lamp_drift(weighted, sampled(weighted))
        assert found.degrees_of_freedom in (3, 4) if drift else found.degrees_of_freedom == 3
        # χ² of three is below 0.0075 or above 20.3 in one of 3000.
        error = NOISE / np.mean(frames[1:]) / np.sqrt(frames[0].size)
        low, high = (0.05 * drift, 2.6 * drift) if drift else (0, 2.5 * error)
        assert low <= found.size < high
        assert found.is_certain == bool(drift)
        # The six others make the slope.
        others = slope_covariance(SEVEN[1:], found.size, None, np.ones(6))
        np.testing.assert_allclose(
            found.tilt_std, np.sqrt(np.diag(others)) * SENSOR, rtol=0.2 if drift else 0.1
        )


def test_one_noisy_exposure_that_is_wrong_is_no_drift_of_the_lamp():
    """Its flux is off by twenty of its own standard errors, that of no other."""
    variance = np.full(7, NOISE**2)
    variance[0] *= 1e4
    rng = np.random.default_rng(5)
    frames, _, _ = photograph(rng, 0.0)
    frames[0] = 1.04 * frames[0] + 100 * NOISE * rng.standard_normal(SENSOR)
    weighted = weighted_fit(
        exposures_of(frames, SEVEN, variance=variance), Options(FitOptions(tolerance=1e-6))
    )
    found = lamp_drift(weighted, sampled(weighted))
    assert found.probability < 1e-10
    assert not found.is_certain


def test_the_size_is_that_of_the_first_maximum_of_the_restricted_likelihood():
    columns = affine_columns(SEVEN, None)
    rng = np.random.default_rng(1)
    fluxes = 5 * rng.standard_normal(7)
    # Of equal variances: what is left, for each combination, less the variance.
    left = left_by(columns, fluxes)[0]
    assert lamp_drift_module._size(columns, fluxes, np.ones(7)) ** 2 == pytest.approx(
        left @ left / 4 - 1, rel=1e-3
    )
    assert lamp_drift_module._size(columns, fluxes / 1e3, np.ones(7)) == 0
    # Of an exposure of no weight nothing is known: as without it.
    variances = np.array([1, 1, 1, 1, 1, 1, 1e12])
    left = left_by(columns[:6], fluxes[:6])[0]
    assert lamp_drift_module._size(columns, fluxes, variances) ** 2 == pytest.approx(
        left @ left / 3 - 1, rel=1e-3
    )


@pytest.mark.parametrize(
    ("value", "freedom", "tail"),
    [
        (3.841459, 1, 0.05),
        (9.21034, 2, 0.01),
        (7.814728, 3, 0.05),
        (23.209251, 10, 0.01),
        (0, 3, 1),
    ],
)
def test_the_tail_of_chi_square(value, freedom, tail):
    """Quantiles from tables, given to six digits."""
    assert chi2_tail(value, freedom) == pytest.approx(tail, rel=1e-5)


def test_the_tilt_of_a_linear_drift_is_named():
    shape, shifts, rate = (64, 80), equipix.cross_pattern(5, 7), 2e-3
    flux = np.exp(rate * np.arange(5))
    clean = simulate.exposures(np.ones(shape), simulate.gaussian_beam(shape), shifts, flux=flux)
    frames = clean + 1e-4 * np.random.default_rng(3).standard_normal(clean.shape)
    with pytest.warns(MisfitWarning, match="if it is linear in the order of the exposures"):
        cal = equipix.calibrate(frames, shifts)
    # The rate is known to the standard error of what the trend leaves: 3.5 % of its variance.
    visible = rate * np.sqrt(10 * distinct_trend(shifts))
    error = 5 * cal.drift.flux_std / visible
    np.testing.assert_allclose(cal.drift.trend_tilt, np.abs(cal.tilt), rtol=error)
    assert (cal.drift.trend_tilt > 2 * cal.drift.tilt_std).all()
