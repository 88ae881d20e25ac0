"""What an error map costs in solves, for the table of `make bench`."""

from __future__ import annotations

import time

import numpy as np
from commands import Row

import equipix
from equipix import simulate
from equipix.exposures.exposures import FitOptions

NOISE = 1e-3
MOST_SOLVES = 200


def rows(shape: tuple[int, int] = (582, 782), repetitions: int = 3) -> list[Row]:
    """Time calibrations with and without uncertainty in turn, and give the table's rows."""
    shifts = equipix.cross_pattern(11, 19)
    truth = simulate.cosine_sensitivity(shape, rng=1)
    frames = simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    frames += NOISE * np.random.default_rng(2).standard_normal(frames.shape)
    frames = frames.astype(np.float32)
    variance = np.full(len(shifts), NOISE**2)
    weights = np.zeros(shape)
    weights[:16, :16] = 1 / 256
    seconds = []
    for _ in range(repetitions):
        start = time.perf_counter()
        cal = equipix.calibrate(frames, shifts, variance=variance)
        solve = time.perf_counter() - start
        whole = equipix.calibrate(frames, shifts, variance=variance, uncertainty=True)
        both = time.perf_counter() - start - solve
        cal.std_of(weights)
        functional = time.perf_counter() - start - solve - both
        assert cal.weighted is not None  # kept, since it was not loaded
        cal.weighted.exposures.fit(FitOptions())
        alone = time.perf_counter() - start - solve - both - functional
        seconds.append((solve, both - solve, functional, alone))
    solve, extra, functional, alone = np.median(seconds, axis=0)
    made = whole.metadata["uncertainty"]
    case = f"{shape[1]}×{shape[0]}×5 float32"
    return [
        (
            f"error map and tilt, {case}",
            f"<= {MOST_SOLVES} solves",
            f"{extra / solve:.1f} solves",
            f"{extra:.2f} s, solve {solve:.3f} s, median of {repetitions}; {made['draws']} draws, "
            f"exact to {made['relative_standard_error']:.1%}",
        ),
        (
            f"standard deviation of a functional, {case}",
            "about a solve",
            f"{functional / solve:.1f} solves",
            f"{functional:.3f} s",
        ),
        (
            f"calibrate of arrays with what it asks of the data, {case}",
            "<= 2 x its fit alone",
            f"{solve / alone:.1f} x",
            f"{solve:.3f} s, {alone:.3f} s",
        ),
    ]


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
