"""A lamp that drifts by 1 %, and a monitor diode with an error of 2e-4."""

from __future__ import annotations

import warnings

import numpy as np

import equipix
from equipix import metrics, simulate
from equipix.errors import MisfitWarning

SENSOR = (96, 128)
NOISE, DRIFT, MONITOR = 1e-3, 1e-2, 2e-4


def main() -> None:
    """Calibrate with equal fluxes, and with the readings of the monitor as a prior."""
    rng = np.random.default_rng(2)
    truth = simulate.paper_sensitivity(SENSOR, rng=rng)
    shifts = equipix.cross_pattern(11, 19)
    flux = 1 + DRIFT * rng.standard_normal(5)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SENSOR), shifts, flux=flux)
    frames += NOISE * rng.standard_normal(frames.shape)
    readings = flux * (1 + MONITOR * rng.standard_normal(5))

    known = {"variance": np.full(5, NOISE**2)}
    with warnings.catch_warnings():
        # calibrate warns that the fluxes are not equal, and of the tilt that this probably hides.
        warnings.simplefilter("ignore", MisfitWarning)
        steady = equipix.calibrate(frames, shifts, **known)
    monitor = equipix.calibrate(frames, shifts, flux=readings, flux_std=MONITOR, **known)
    runs = {"steady lamp": steady, "monitor": monitor}
    for name, cal in runs.items():
        error = metrics.relative_error(cal.sensitivity, truth)
        tilt = cal.tilt - np.array(slope(truth))
        print(f"{name:12} rms error {np.std(error):.1e}, tilt error {np.abs(tilt).max():.1e}")
    # The remaining error of the tilt is that of the monitor. equipix.plan.error_budget predicts it.


def slope(truth: np.ndarray) -> tuple[float, float]:
    """Least-squares slopes of ln M along rows and columns, edge to edge."""
    rows, cols = truth.shape
    logarithm = np.log(truth)
    along_rows = np.polyfit(np.arange(rows) / rows, logarithm.mean(axis=1), 1)[0]
    along_cols = np.polyfit(np.arange(cols) / cols, logarithm.mean(axis=0), 1)[0]
    return along_rows, along_cols


if __name__ == "__main__":
    main()
