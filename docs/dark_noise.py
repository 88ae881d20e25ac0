"""Compare errors and their standard deviations if the dark is noisy: ``python docs/dark_noise.py``.

Forty frames of each exposure, a read noise of 6 DN, and few or many dark frames. Printed: z, the
rms error over the standard deviation, and reduced χ², as means over experiments with their
standard errors.
"""

from __future__ import annotations

import numpy as np

import equipix
from equipix import simulate

SHAPE = (120, 160)
SHIFTS = equipix.cross_pattern(11, 19)
FRAMES, DARK_FRAMES, EXPERIMENTS = 40, (200, 40, 10, 4), 5
READ_NOISE, GAIN, LEVEL = 6.0, 0.01, 2000.0


def taken(signal: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Frames in whole DN."""
    noise = np.sqrt(READ_NOISE**2 + GAIN * signal) * rng.standard_normal((count, *SHAPE))
    return np.rint(100 + signal + noise).astype(np.uint16)


def one(dark_frames: int, seed: int) -> tuple[float, float]:
    """Give z and reduced χ² of one experiment."""
    rng = np.random.default_rng([seed, dark_frames])
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    clean = LEVEL * simulate.exposures(truth, simulate.gaussian_beam(SHAPE, width=1000), SHIFTS)
    dark = equipix.average(taken(np.zeros(SHAPE), dark_frames, rng))
    frames = [equipix.average(taken(signal, FRAMES, rng), dark=dark) for signal in clean]
    cal = equipix.calibrate(frames, SHIFTS, tolerance=1e-5, uncertainty=True)
    z = (cal.sensitivity - truth / truth.mean()) / cal.sensitivity_std
    return float(np.sqrt(np.nanmean(z**2))), cal.reduced_chi2


def main() -> None:
    """Print all numbers of dark frames."""
    for dark_frames in DARK_FRAMES:
        found = np.array([one(dark_frames, seed) for seed in range(EXPERIMENTS)])
        (z, chi2), errors = found.mean(0), found.std(0, ddof=1) / np.sqrt(EXPERIMENTS)
        print(
            f"{dark_frames:3d} dark frames: z {z:.3f} ± {errors[0]:.3f}, "
            f"reduced χ² {chi2:.4f} ± {errors[1]:.4f}"
        )


if __name__ == "__main__":
    main()
