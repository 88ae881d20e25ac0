"""Calibrate a sensor from exposures in memory: measure the moves, average, solve, correct, save.

A virtual camera stands in for yours: wherever `camera` gives frames, give your own arrays or files.
"""

from __future__ import annotations

import sys

import numpy as np

import equipix
from equipix import Flag, simulate


def main(output: str = "cal.tif") -> None:
    """Run the whole experiment and say how good the result is."""
    pattern = equipix.cross_pattern(11, 19)
    truth = simulate.cosine_sensitivity((120, 160), rng=1)
    beam = simulate.gaussian_beam(truth.shape)
    camera = simulate.experiment(truth, beam, pattern, frames=50, rng=2)

    # Where the sensor stood: images of a hole in the beam, before and after each move.
    shifts = np.zeros((len(pattern), 2))
    for k in range(1, len(pattern)):
        before, after = list(camera.aperture_before(k)), list(camera.aperture_after(k))
        move = equipix.measure_shift(before, after, saturation=4095)
        shifts[k] = shifts[k - 1] + move.shift
    print("shifts (row, col):", shifts.round(3).tolist())

    # Averages, the dark subtracted; a pixel that saturates or hardly answers is not used.
    dark = equipix.average(camera.dark(), saturation=4095)
    exposures = [
        equipix.average(camera.frames(k), dark=dark, saturation=4095) for k in range(len(pattern))
    ]
    saturated = np.any([frames.saturated > 0 for frames in (dark, *exposures)], axis=0)
    dim = exposures[0].mean < 0.5 * np.median(exposures[0].mean)

    # The stage makes whole steps: what the centroid adds to them is its error and the stage's.
    cal = equipix.calibrate(exposures, shifts.round(), mask=saturated | dim)
    cal.save(output)
    print(cal)

    raw = next(camera.frames(0))
    equal = cal.correct(raw, dark=dark.mean, flagged="replace")
    bad = (cal.flags & Flag.DO_NOT_USE) != 0
    print(f"{bad.sum()} bad pixels; a frame of mean {raw.mean():.0f} DN becomes {equal.mean():.0f}")

    error = simulate.relative_error(cal.sensitivity, np.where(bad, np.nan, truth))
    predicted, _ = camera.noise_prediction(rng=3)
    print(f"rms error {np.nanstd(error):.2e}, where the noise predicts {predicted:.2e}")


if __name__ == "__main__":
    main(*sys.argv[1:])
