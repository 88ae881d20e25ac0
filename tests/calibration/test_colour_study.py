"""Many sensors behind colour filters: error bars, false flags, defects found, false findings."""

import numpy as np
import pytest

import equipix
from equipix import cross_pattern, metrics, simulate

PATTERNS = {
    "RGGB and the like": ("RGGB", "GRBG", "GBRG", "BGGR"),
    "quad Bayer": ("RRGG/RRGG/GGBB/GGBB",),
    "X-Trans": ("GBGGRG/RGRBGB/GBGGRG/GRGGBG/BGBRGR/GRGGBG",),
}
SHAPE, SHIFTS, NOISE, DEAD = (48, 52), cross_pattern(5, 7), 3.0, 6


def drawn(cfa, seed):
    """Calibration of a sensor with dead pixels, its errors, its good pixels."""
    rng = np.random.default_rng([33, seed])
    truth = simulate.filtered(1 + 0.01 * rng.standard_normal(SHAPE), cfa)
    good = np.ones(SHAPE, bool)
    good.flat[rng.choice(good.size, DEAD, replace=False)] = False
    truth[~good] *= rng.uniform(0, 0.4, DEAD)
    beam = simulate.gaussian_beam(SHAPE, width=120, amplitude=8000)
    frames = simulate.exposures(truth, beam, SHIFTS)
    frames += NOISE * rng.standard_normal(frames.shape)
    cal = equipix.calibrate(
        frames, SHIFTS, variance=np.full(5, NOISE**2), cfa=cfa, uncertainty=True
    )
    error = metrics.relative_error(cal.sensitivity, np.where(good, truth, np.nan), cfa=cfa)
    return cal, error, good


@pytest.mark.study
@pytest.mark.parametrize("pattern", PATTERNS)
def test_error_bars_flags_and_findings_are_those_of_a_monochrome_sensor(draws, figure, pattern):
    squares, false, missed, findings = [], 0, 0, 0
    seeds = draws(200)
    for seed in seeds:
        cfas = PATTERNS[pattern]
        cal, error, good = drawn(cfas[seed % len(cfas)], seed)
        z = error * cal.sensitivity / cal.sensitivity_std
        squares.append(np.mean(z[good] ** 2))
        false += np.count_nonzero((cal.flags != 0) & good)
        missed += np.count_nonzero((cal.flags == 0) & ~good)
        findings += len(cal.findings)
    pixels = len(seeds) * (np.prod(SHAPE) - DEAD)
    z = float(np.sqrt(np.mean(squares)))
    # Errors of large scales are common to pixels, so the scatter of the draws tells the error of z.
    error_of_z = float(np.std(squares) / np.sqrt(len(seeds)) / 2)
    figure(f"z of calibrate behind {pattern}", round(z, 3), "0.97 to 1.03")
    figure(f"false flags behind {pattern}", f"{false} of {pixels}", "below 1e-4")
    figure(f"dead pixels missed behind {pattern}", missed, "0")
    figure(f"findings on right models behind {pattern}", findings, "at most 1 %")
    assert 0.97 - 3 * error_of_z < z < 1.03 + 3 * error_of_z
    allowed = 1e-4 * pixels
    assert false <= allowed + 3 * np.sqrt(allowed)
    assert missed == 0
    allowed = 0.01 * len(seeds)
    assert findings <= allowed + 3 * np.sqrt(allowed) + 1
