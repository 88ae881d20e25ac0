"""Predict the error of the sensitivity for N frames an exposure and n exposures, and check it.

A pixel holds 20 000 electrons. A frame of 16 000 electrons has shot noise and read noise. The mean
of N frames has 1/√N of this noise. `equipix.plan.error_budget` predicts the error of M from it.
"""

from __future__ import annotations

import warnings

import numpy as np

import equipix
from equipix import metrics, plan, simulate
from equipix.errors import MisfitWarning
from equipix.plan.budget import ErrorBudget

SENSOR = (582, 782)
SIGNAL, READ_NOISE = 16_000, 10
"""Electrons in a frame, and standard deviation of the read noise in electrons."""

PATTERNS = {
    5: equipix.cross_pattern(11, 19),
    # From: equipix plan --shape 582 782 --exposures 9 --max-shift 30 30
    9: [(0, 29), (30, 0), (30, 30), (29, 0), (0, 30), (0, 0), (28, 30), (1, 0), (30, 29)],
}
"""Shifts (row, col) in pixels, by the number of exposures."""


def main() -> None:
    """Print the errors caused by noise and by lamp drift, and simulate one experiment."""
    one = np.sqrt(SIGNAL + READ_NOISE**2) / SIGNAL
    print("frames, noise of the mean, error of M for 5 and for 9 exposures:")
    for frames in (1, 10, 100):
        noise = one / np.sqrt(frames)
        errors = [budget(n, noise).rms_by_cause["noise"] for n in PATTERNS]
        print(frames, f"{noise:.1e}", *(f"{error:.1e}" for error in errors))
    print("lamp drift, error of M that it adds for 5 and for 9 exposures:")
    for drift in (1e-5, 1e-4, 1e-3):
        errors = [budget(n, one, drift).rms_by_cause["drift"] for n in PATTERNS]
        print(f"{drift:.0e}", *(f"{error:.1e}" for error in errors))

    noise = one / np.sqrt(10)
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SENSOR, rng=rng)
    frames = simulate.exposures(truth, even_beam, PATTERNS[5])
    frames += noise * rng.standard_normal(frames.shape)
    cal = equipix.calibrate(frames, PATTERNS[5])
    rms = np.std(metrics.relative_error(cal.sensitivity, truth))
    print(f"simulated, 10 frames, 5 exposures: {rms:.2e}")
    print(f"predicted: {budget(5, noise).rms:.2e}")


def even_beam(rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """Light of 1 everywhere."""
    return np.ones(np.broadcast_shapes(rows.shape, cols.shape))


def budget(exposures: int, noise: float, drift: float = 0.0) -> ErrorBudget:
    """Error budget of the pattern with so many exposures."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MisfitWarning)
        return plan.error_budget(SENSOR, PATTERNS[exposures], noise=noise, drift=drift)


if __name__ == "__main__":
    main()
