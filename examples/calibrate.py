"""Calibrate a sensor from exposures in memory: measure the moves, average, solve, correct, save.

A virtual camera takes the place of yours. Replace each call of `camera` by your arrays or files.
"""

from __future__ import annotations

import sys

import numpy as np

import equipix
from equipix import Flag, metrics, simulate


def main(output: str = "cal.tif") -> None:
    """Run the whole experiment and compare the result with the truth."""
    pattern = equipix.cross_pattern(11, 19)
    truth = simulate.cosine_sensitivity((120, 160), rng=1)
    beam = simulate.gaussian_beam(truth.shape)
    camera = simulate.experiment(truth, beam, pattern, frames=50, rng=2)

    # The shift of each exposure, from images of a hole in the beam before and after each move.
    shifts = np.zeros((len(pattern), 2))
    for k in range(1, len(pattern)):
        before, after = list(camera.aperture_before(k)), list(camera.aperture_after(k))
        move = equipix.measure_shift(before, after, saturation=4095)
        shifts[k] = shifts[k - 1] + move.shift
    print("shifts (row, col):", shifts.round(3).tolist())

    # Means of the frames without the dark. Dead, hot and noisy pixels are masked by `calibrate`.
    dark = equipix.average(camera.dark(), saturation=4095)
    exposures = [
        equipix.average(camera.frames(k), dark=dark, saturation=4095) for k in range(len(pattern))
    ]

    # The stage makes whole steps, so the fractions are errors of the centroids and of the stage.
    cal = equipix.calibrate(exposures, shifts.round())
    cal.save(output)
    print(cal)

    raw = next(camera.frames(0))
    equal = cal.correct(raw, flagged="replace")
    bad = (cal.flags & Flag.DO_NOT_USE) != 0
    print(f"{bad.sum()} bad pixels; a frame of mean {raw.mean():.0f} DN becomes {equal.mean():.0f}")

    error = metrics.relative_error(cal.sensitivity, np.where(bad, np.nan, truth))
    predicted, _ = camera.noise_prediction(rng=3)
    print(f"rms error {np.nanstd(error):.2e}, predicted from noise {predicted:.2e}")


if __name__ == "__main__":
    main(*sys.argv[1:])
