"""Compare errors of refined shifts and of M with their standard deviations.

``python docs/shift_errors.py`` prints z over 100 experiments for each beam: the rms error over the
stated standard deviation, with its own standard error from the scatter of the experiments.
"""

from __future__ import annotations

import warnings

import numpy as np

import equipix
from equipix import simulate
from equipix.errors import EquipixWarning
from equipix.simulate.beams import Beam

SHAPE = (96, 128)
CROSS = equipix.cross_pattern(11, 19).astype(float)
NOISE, STD, PERIOD, EXPERIMENTS = 1e-3, 0.03, 30, 100


def fringes(contrast: float, *, crossed: bool) -> Beam:
    """An even beam with fringes across columns, or across rows too."""

    def beam(rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        light = 1 + contrast * np.cos(2 * np.pi * cols / PERIOD + 0.3)
        return light + crossed * contrast * np.cos(2 * np.pi * rows / PERIOD + 0.7)

    return beam


def one(beam: Beam, seed: int) -> tuple[float, float, str]:
    """Give mean squares of z of M and of shifts less their mean, and whether these are refined."""
    rng = np.random.default_rng(seed)
    measured = CROSS + STD * rng.standard_normal(CROSS.shape)
    truth = 1 + rng.uniform(-0.05, 0.05, SHAPE)
    frames = simulate.exposures(truth, beam, CROSS)
    frames += NOISE * rng.standard_normal(frames.shape)
    cal = equipix.calibrate(
        frames, measured, variance=np.full(5, NOISE**2), shift_std=STD, uncertainty=True
    )
    of_m = (cal.sensitivity - truth / truth.mean()) / cal.sensitivity_std
    errors = cal.shifts - CROSS
    # What is stated is about shifts less their mean; that of a shift as measured is not.
    refined = cal.metadata["options"]["shifts"]
    errors = errors - errors.mean(axis=0) if refined == "refined" else errors
    return float(np.mean(of_m**2)), float(np.mean((errors / cal.shift_std) ** 2)), refined


def main() -> None:
    """Print all beams."""
    warnings.simplefilter("ignore", EquipixWarning)
    for crossed in (False, True):
        for contrast in (0.003, 0.01, 0.03, 0.1):
            beam = fringes(contrast, crossed=crossed)
            *squares, refined = zip(*[one(beam, seed) for seed in range(EXPERIMENTS)], strict=True)
            found = np.array(squares)
            z = np.sqrt(found.mean(axis=1))
            error = found.std(axis=1, ddof=1) / np.sqrt(EXPERIMENTS) / (2 * z)
            print(
                f"{'crossed' if crossed else 'parallel'} fringes of {contrast:.1%}: "
                f"z of M {z[0]:.3f} ± {error[0]:.3f}, of shifts {z[1]:.3f} ± {error[1]:.3f}; "
                f"refined in {refined.count('refined')} of {EXPERIMENTS}"
            )


if __name__ == "__main__":
    main()
