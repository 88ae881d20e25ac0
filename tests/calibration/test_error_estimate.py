"""The estimated error of the sensitivity: honest at any moment, whatever the experiment.

It is one of order, no bound. What is asked of it: the true error, the largest distance of M to the
minimum of F, is below three times the estimate in 95 % of all cases and never above ten times; and
the median of estimate over true error is at most ten.
"""

from __future__ import annotations

import numpy as np
import pytest

import equipix
import reference
from equipix import metrics, simulate

CROSS = equipix.cross_pattern(5, 7)
MOST_SWEEPS = {"multiscale": 60, "coordinate-descent": 1000}

pytestmark = pytest.mark.filterwarnings(
    "ignore::equipix.errors.ConvergenceWarning", "ignore::equipix.errors.IdentifiabilityWarning"
)


def random_experiment(seed, smallest=16, largest=128):
    """Frames, shifts and mask of a small experiment of any kind."""
    rng = np.random.default_rng(seed)
    shape = tuple(np.exp(rng.uniform(np.log(smallest), np.log(largest + 1), 2)).astype(int))
    shifts = random_pattern(rng, shape)
    beam = simulate.gaussian_beam(shape, width=max(shape) * np.exp(rng.uniform(-0.3, 2)))
    if rng.random() < 0.3:
        beam = simulate.striped_beam(shape)
    truth = simulate.cosine_sensitivity(shape, rng=rng)
    frames = simulate.exposures(truth, beam, shifts)
    noise, missing = rng.choice([0, rng.uniform(0, 1e-2)]), rng.choice([0, rng.uniform(0, 0.2)])
    frames += noise * rng.standard_normal(frames.shape)
    return frames, shifts, rng.random(frames.shape) < missing


def random_pattern(rng, shape):
    """A cross, or from three to eight positions up to half a sensor apart."""
    half = np.array(shape) // 2
    if rng.random() < 0.4:
        return equipix.cross_pattern(*rng.choice(np.arange(1, min(half)), 2, replace=False))
    reach = rng.integers(1, half + 1)
    return rng.integers(-reach // 2, reach // 2 + 1, (rng.integers(3, 9), 2))


def minimiser(frames, shifts, mask):
    return equipix.calibrate(frames, shifts, mask=mask, tolerance=1e-12)


@pytest.mark.long
def test_the_minimiser_that_errors_are_measured_from_is_that_of_dense_algebra():
    for seed in range(12):
        frames, shifts, mask = random_experiment(seed, smallest=8, largest=12)
        dense = reference.solve_dense(frames, shifts, mask=mask)
        found = minimiser(frames, shifts, mask)
        # Ten times what the estimate says, and the rounding of a dense solution, whose condition
        # is that of the data alone: below 1e5.
        atol = 10 * found.error_estimate + 1e5 * np.finfo(float).eps
        np.testing.assert_allclose(found.sensitivity, dense.sensitivity, rtol=0, atol=atol)


def test_what_the_solver_leaves_is_no_flipped_exposure():
    """Without noise, the fit of another order may end nearer to nothing."""
    frames, shifts, mask = random_experiment(86)
    found = minimiser(frames, shifts, mask)
    assert not found.converged
    assert "misfit" not in {finding.kind for finding in found.findings}


@pytest.mark.study
def test_it_is_honest_where_a_coarse_tolerance_ends_a_fit(draws, figure):
    """At most one of 162 errors is above twice the estimate, and none above three times."""
    ratios = []
    for seed in draws(81):
        frames, shifts, mask = random_experiment(1000 + seed)
        best = minimiser(frames, shifts, mask)
        for tolerance in (1e-2, 1e-3):
            stopped = equipix.calibrate(frames, shifts, mask=mask, tolerance=tolerance)
            true = np.nanmax(abs(stopped.sensitivity - best.sensitivity))
            ratios.append(true / stopped.error_estimate)
    figure("true error over the estimate, largest", max(ratios), "below 3")
    assert np.count_nonzero(np.array(ratios) > 2) <= 1
    assert max(ratios) < 3


@pytest.mark.study
def test_it_is_honest_wherever_a_run_is_stopped(draws, figure):
    ratios = {method: [] for method in MOST_SWEEPS}
    for seed in draws(200):
        frames, shifts, mask = random_experiment(seed)
        best = minimiser(frames, shifts, mask)
        for method, most in MOST_SWEEPS.items():
            rng = np.random.default_rng([seed, 1])
            stopped = equipix.calibrate(
                frames,
                shifts,
                mask=mask,
                method=method,
                max_sweeps=int(np.exp(rng.uniform(0, np.log(most)))),
                tolerance=1e-8,
            )
            assert stopped.converged == (stopped.error_estimate <= 1e-8)
            true = np.nanmax(abs(stopped.sensitivity - best.sensitivity))
            # How far the minimum itself is known.
            true = max(true - best.error_estimate, 0)
            ratios[method].append(true / stopped.error_estimate)
    for method, each in ratios.items():
        each = np.array(each)
        figure(f"{method}: share of errors below 3 estimates", (each < 3).mean(), "at least 0.95")
        figure(f"{method}: true error over the estimate, largest", each.max(), "at most 10")
        assert (each < 3).mean() >= 0.95
        assert each.max() <= 10
        assert 1 / np.median(each) <= 10


@pytest.mark.study
def test_it_is_one_of_order_on_small_sensors_stopped_early(draws, figure):
    ratios = []
    for seed in draws(150):
        frames, shifts, mask = random_experiment(2000 + seed, smallest=12, largest=24)
        best = minimiser(frames, shifts, mask)
        most = int(np.random.default_rng(seed).integers(10, 25))
        stopped = equipix.calibrate(frames, shifts, mask=mask, max_sweeps=most, tolerance=1e-9)
        true = np.nanmax(abs(stopped.sensitivity - best.sensitivity)) - best.error_estimate
        ratios.append(max(true, 0) / stopped.error_estimate)
    figure("true error over the estimate, largest", max(ratios), "at most 10")
    assert np.mean(np.array(ratios) < 3) >= 0.95
    assert max(ratios) <= 10


def dark_stripe(rows, cols):
    """Light that falls to a hundredth along one line."""
    envelope = simulate.gaussian_beam((96, 128), width=400)(rows, cols)
    return envelope * (1 - 0.99 * np.exp(-(((cols - 64) / 6) ** 2)))


def two_lobes(rows, cols):
    """Light in two places, with a valley at 7 % of the peak between them."""
    lobes = sum(np.exp(-(((cols - centre) / 25) ** 2)) for centre in (30, 130))
    return (lobes + 0.07) * np.exp(-(((rows - 60) / 200) ** 2))


def passage(width):
    """Mask that joins two halves through so many rows."""
    mask = np.zeros((48, 64), bool)
    mask[: 48 - width, 28:36] = True
    return mask


CASES = {
    "stripe": ((96, 128), dark_stripe, None),
    "lobes": ((120, 160), two_lobes, None),
    "passage of 8 rows": ((48, 64), simulate.gaussian_beam((48, 64), width=200), passage(8)),
    "passage of 1 row": ((48, 64), simulate.gaussian_beam((48, 64), width=200), passage(1)),
}


@pytest.mark.study
@pytest.mark.parametrize(
    ("method", "tolerance"),
    # Coordinate descent to 1e-6 takes some ten thousand sweeps.
    [("multiscale", t) for t in (1e-2, 1e-3, 1e-4, 1e-6)]
    + [("coordinate-descent", t) for t in (1e-2, 1e-3, 1e-4)],
)
@pytest.mark.parametrize("case", CASES)
def test_what_has_converged_is_within_an_order_of_the_estimate(case, tolerance, method):
    shape, beam, mask = CASES[case]
    halves = np.where(np.arange(shape[1]) < shape[1] // 2, 1.02, 0.98)
    truth = simulate.paper_sensitivity(shape, rng=1) * halves
    frames = simulate.exposures(truth, beam, CROSS)
    cal = equipix.calibrate(frames, CROSS, mask=mask, method=method, tolerance=tolerance)
    true = np.nanmax(np.abs(metrics.relative_error(cal.sensitivity, truth)))
    assert cal.converged
    assert true <= 10 * cal.error_estimate
    # By how much it is too large is asked of the median of all experiments alone; but coordinate
    # descent makes the step that ten products find part of its estimate, which sharpens it.
    assert method == "multiscale" or cal.error_estimate <= 10 * true
