"""Plan an experiment: evaluate a pattern of shifts, find a better one, choose the order.

A simulated calibration at the end compares the errors with the prediction.
"""

from __future__ import annotations

import warnings

import numpy as np

import equipix
from equipix import metrics, plan, simulate
from equipix.errors import MisfitWarning

SENSOR = (96, 128)
CAUSES = {"noise": 1e-3, "drift": 2e-5, "shift_error": 0.02, "beam_width": 200}
"""Noise of the mean of an exposure, drift of the lamp, errors of the stage, width of the beam."""


def main() -> None:
    """Compare the cross of the paper with the best pattern within a travel of 20 pixels."""
    cross = equipix.cross_pattern(11, 19)
    print(plan.identify(SENSOR, cross))
    budget = plan.error_budget(SENSOR, cross, **CAUSES)
    print("cross:    ", budget)

    best = plan.suggest(SENSOR, 5, 20, **CAUSES)[0]
    print("suggested:", best.budget)
    print("in this order (row, col):", best.shifts.tolist())
    shares = budget.distinct_trend, best.budget.distinct_trend
    print(f"of a linear drift {shares[0]:.1%} and {shares[1]:.1%} do not look like a tilt")

    # The experiment with all three errors, simulated with a known sensitivity.
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SENSOR, rng=rng)
    beam = simulate.gaussian_beam(SENSOR, width=CAUSES["beam_width"])
    reached = best.shifts + CAUSES["shift_error"] * rng.standard_normal((5, 2))
    flux = 1 + CAUSES["drift"] * rng.standard_normal(5)
    frames = simulate.exposures(truth, beam, reached, flux=flux)
    frames += CAUSES["noise"] * rng.standard_normal(frames.shape)
    cal = equipix.calibrate(frames, best.shifts)
    rms = np.std(metrics.relative_error(cal.sensitivity, truth))
    print(f"rms error {rms:.2e}, predicted by the plan {best.budget.rms:.2e}")


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        main()
