"""Gain and offset together: shifts at two levels of the lamp, without a dark frame."""

from __future__ import annotations

import numpy as np

import equipix
from equipix import metrics, simulate

SENSOR = (96, 128)
LEVELS = (1.0, 0.4)
NOISE = 5e-4


def main() -> None:
    """Simulate a cross of five shifts at each level, and fit sensitivity and dark."""
    rng = np.random.default_rng(4)
    truth = simulate.paper_sensitivity(SENSOR, rng=rng)
    dark = 0.05 + 0.01 * rng.standard_normal(SENSOR)
    shifts = np.tile(equipix.cross_pattern(11, 19), (2, 1))
    flux = np.repeat(LEVELS, 5)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SENSOR), shifts, flux=flux) + dark
    frames += NOISE * rng.standard_normal(frames.shape)

    cal = equipix.calibrate(frames, shifts, flux=flux, dark="fit")
    error = np.std(metrics.relative_error(cal.sensitivity, truth))
    print(f"sensitivity: rms error {error:.1e}; dark: {np.std(cal.dark - dark):.1e}")
    # The dark is part of the calibration, so raw frames are corrected without another dark.
    equal = cal.correct(frames[0])
    beam = simulate.gaussian_beam(SENSOR)(*np.indices(SENSOR))
    print(f"rms deviation of a corrected frame from the beam {np.std(equal / beam):.1e}")


if __name__ == "__main__":
    main()
