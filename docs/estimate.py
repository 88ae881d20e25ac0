"""Compare the error estimate with the error, for docs/method.md: ``python docs/estimate.py``.

Small random sensors, beams, shifts, masks and noise; each method is stopped at some moment.

- estimate.png: how often the estimate is how many times too large or too small
- the same in figures: printed
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from convergence import stopped
from figures import AFTER, BEFORE, FOLDER, INK, SAVED
from matplotlib.figure import Figure

import equipix
from equipix import simulate

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

PROBLEMS, EARLY_PROBLEMS = 500, 300
LIMITS = {"multiscale": (3, 60), "coordinate-descent": (1, 1000)}
"""Between which numbers of products or sweeps a method is stopped."""
EARLY = (1e-2, 1e-3)
"""Tolerances that a fit reaches before its smallest Ritz value is found."""
SHARP = 1e-10
"""Tolerance of what counts as the minimum; smaller errors are not compared with it."""
COLOURS = {"multiscale": BEFORE, "coordinate-descent": AFTER}


def problem(rng: Generator) -> tuple[NDArray, NDArray]:
    """Make up exposures, with NaN where masked, and their shifts."""
    shape = tuple(int(size) for size in rng.integers(16, 81, 2))
    arms = sorted(int(arm) for arm in rng.choice(np.arange(2, 13), 2, replace=False))
    loose = rng.integers(0, arms[1] + 1, (rng.integers(4, 9), 2))
    shifts = equipix.cross_pattern(*arms) if rng.random() < 0.5 else loose
    truth = simulate.cosine_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=rng.choice([0.7, 1.3, 5]) * max(shape))
    frames = simulate.exposures(truth, beam, shifts)
    frames += rng.choice([0, 1e-3, 1e-2]) * rng.standard_normal(frames.shape)
    frames[rng.random(frames.shape) < rng.choice([0, 0.1])] = np.nan
    return frames, shifts


def compare(rng: Generator) -> dict[str, float]:
    """Give the error of M over its estimate by method, where there is an error to speak of."""
    frames, shifts = problem(rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", equipix.errors.EquipixWarning)
        best = equipix.calibrate(frames, shifts, tolerance=SHARP)
        found = {m: stopped(frames, shifts, m, int(rng.integers(*LIMITS[m]))) for m in LIMITS}
    if best.components > 1 or not best.converged:
        return {}
    errors = {m: np.nanmax(np.abs(f.sensitivity / best.sensitivity - 1)) for m, f in found.items()}
    return {m: e / found[m].error_estimate for m, e in errors.items() if e > 100 * SHARP}


def early(rng: Generator) -> list[float]:
    """Give the error of M over its estimate where the fit ends early by its tolerance."""
    frames, shifts = problem(rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", equipix.errors.EquipixWarning)
        best = equipix.calibrate(frames, shifts, tolerance=SHARP)
        if best.components > 1 or not best.converged:
            return []
        found = [equipix.calibrate(frames, shifts, tolerance=tolerance) for tolerance in EARLY]
    errors = [np.nanmax(np.abs(each.sensitivity / best.sensitivity - 1)) for each in found]
    return [error / each.error_estimate for error, each in zip(errors, found, strict=True)]


def draw(ratios: dict[str, NDArray]) -> Figure:
    """Draw the distribution of error/estimate."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    bins = np.geomspace(1e-3, 10, 61)
    for method, values in ratios.items():
        axes.hist(values, bins, color=COLOURS[method], alpha=0.6, label=method)
    axes.axvline(1, color=INK, lw=0.8)
    axes.set(xscale="log", xlabel="largest error of M / its estimate", ylabel="stops")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    return figure


def main() -> None:
    """Compare, print, and draw into the folder of this file."""
    rng = np.random.default_rng(7)
    found = [compare(rng) for _ in range(PROBLEMS)]
    ratios = {m: np.array([each[m] for each in found if m in each]) for m in LIMITS}
    for method, values in ratios.items():
        print(
            f"{method}: {len(values)} stops; error/estimate below 3 in {np.mean(values < 3):.1%}, "
            f"above 1 in {np.mean(values > 1):.1%}, at most {values.max():.1f}; "
            f"estimate/error {np.median(1 / values):.2f} in the median"
        )
    rng = np.random.default_rng(11)
    stops = np.array([ratio for _ in range(EARLY_PROBLEMS) for ratio in early(rng)])
    print(
        f"ended at a tolerance of {EARLY}: {len(stops)} stops; error/estimate above 2 in "
        f"{np.count_nonzero(stops > 2)}, at most {stops.max():.1f}"
    )
    draw(ratios).savefig(FOLDER / "estimate.png", **SAVED)


if __name__ == "__main__":
    main()
