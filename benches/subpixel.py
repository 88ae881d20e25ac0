"""What shifts between pixels cost, against whole ones."""

from __future__ import annotations

import time

import numpy as np

import equipix
from equipix import simulate

Row = tuple[str, str, str, str]

TOLERANCE = 1e-5


def rows(shape: tuple[int, int] = (582, 782), repetitions: int = 3) -> list[Row]:
    """Time a calibration at whole and at fractional shifts, to the same tolerance, in turn."""
    rng = np.random.default_rng(0)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    beam = simulate.wavy_beam(shape, rng=rng)
    whole = equipix.cross_pattern(11, 19)
    between = whole + rng.uniform(-0.5, 0.5, whole.shape)
    both = [(shifts, simulate.exposures(truth, beam, shifts)) for shifts in (whole, between)]
    times: list[list[float]] = [[], []]
    sweeps = [0, 0]
    for _ in range(repetitions):
        for index, (shifts, frames) in enumerate(both):
            start = time.perf_counter()
            cal = equipix.calibrate(frames, shifts, tolerance=TOLERANCE)
            times[index].append(time.perf_counter() - start)
            sweeps[index] = cal.sweeps
    whole_s, between_s = (float(np.median(each)) for each in times)
    return [
        (
            f"shifts between pixels, {shape[1]}×{shape[0]}×5 float64, to {TOLERANCE:.0e}",
            "<= 4 x whole shifts",
            f"{between_s / whole_s:.1f} x",
            f"{between_s:.2f} s, {sweeps[1]} passes; {whole_s:.3f} s, {sweeps[0]} passes; medians "
            f"of {repetitions} in turn",
        )
    ]
