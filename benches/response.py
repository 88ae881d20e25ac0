"""Response curves fitted to levels of a uniform source, for `make bench`."""

from __future__ import annotations

import time

import numpy as np

from equipix import nuc

SHAPE, LEVELS, REPETITIONS = (512, 640), 20, 5


def rows(
    *, shape: tuple[int, int] = SHAPE, repetitions: int = REPETITIONS
) -> list[tuple[str, str, str, str]]:
    """Measure a cubic fit, and give the table's row: work, wanted, got, how."""
    rng = np.random.default_rng(1)
    light = np.linspace(300.0, 3500.0, LEVELS)[:, None, None]
    gain, bend, skew = (s * rng.standard_normal(shape) for s in (0.02, 4e-7, 1e-11))
    levels = light * (1 + gain) + bend * light**2 + skew * light**3
    levels += rng.standard_normal(levels.shape)
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        nuc.fit(levels, order=3, variance=np.ones(LEVELS))
        times.append(time.perf_counter() - start)
    name = f"a cubic fit of responses, {shape[1]}×{shape[0]}, {LEVELS} levels"
    median = f"median of {repetitions}, {min(times):.2f} to {max(times):.2f} s"
    return [(name, "< 1 s", f"{np.median(times):.2f} s", median)]
