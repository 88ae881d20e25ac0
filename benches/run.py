"""Measure what the design promises and write the table benches/RESULTS.md.

All figures are ratios of times taken in turn in one run: machines differ, and so does one machine
from minute to minute. With ``--smoke`` everything runs once on little data and nothing is written.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import applying
import averaging
import cargo
import large
import levels
import multiscale
import numpy as np
import patterns
import planning
import reporting
import response
import subpixel
import uncertainty
import watching
from peers import table as peers

import batch
import equipix
import experiment
import scene
from equipix import simulate

if TYPE_CHECKING:
    from collections.abc import Iterator

    from commands import Row

HERE = Path(__file__).parent
SHIFTS = equipix.cross_pattern(11, 19)


def main(*, smoke: bool) -> None:
    """Run all measurements; print each row once it is measured."""
    rates = cargo.bench("rates", smoke=smoke)
    lines = heading(rates[0]["threads"])
    print(*lines, sep="\n")
    for rows in measured(rates, smoke=smoke):
        found = [f"| {' | '.join(row)} |" for row in rows]
        print(*found, sep="\n", flush=True)
        lines += found
    if not smoke:
        (HERE / "RESULTS.md").write_text("\n".join(lines) + "\n")


def measured(rates: list[dict[str, float]], *, smoke: bool) -> Iterator[list[Row]]:
    """Run one measurement after the other."""
    yield [rate_row(rate) for rate in rates]
    yield [numpy_row(rates[0], repetitions=1 if smoke else 7)]
    yield multiscale.rows(smoke=smoke)
    yield uncertainty.rows((48, 64), 1) if smoke else uncertainty.rows()
    yield subpixel.rows((48, 64), repetitions=1) if smoke else subpixel.rows()
    yield experiment.rows((96, 128), frames=2, repetitions=1) if smoke else experiment.rows()
    small = (((96, 128), 1, 1),)
    yield experiment.large_rows(small) if smoke else experiment.large_rows()
    yield large.rows((96, 128)) if smoke else large.rows()
    few = {"travels": (20,), "patterns": 1}
    yield patterns.rows((96, 128), **few) if smoke else patterns.rows()
    yield planning.rows((96, 128), travel=20) if smoke else planning.rows()
    yield levels.rows((96, 128), frames=3) if smoke else levels.rows()
    yield reporting.rows((96, 128)) if smoke else reporting.rows()
    lot = {"shape": (96, 128), "sensors": 2, "frames": 2, "repetitions": 1}
    yield batch.rows(**lot) if smoke else batch.rows()
    yield watching.rows((96, 128), frames=2, repetitions=1) if smoke else watching.rows()
    yield averaging.rows(frames=3, repetitions=1) if smoke else averaging.rows()
    yield response.rows(shape=(24, 32), repetitions=1) if smoke else response.rows()
    yield scene.rows(shape=(48, 64), frames=3, passes=1) if smoke else scene.rows()
    yield applying.rows(shapes=((48, 64), (24, 32)), repetitions=1) if smoke else applying.rows()
    yield peers.rows(factors={(48, 64): 1.5}, seconds=0.5) if smoke else peers.rows()


def rate_row(rate: dict[str, float]) -> Row:
    """Share of the copy rate that one sweep reaches."""
    wanted = ">= 40 %" if rate["cols"] == 4096 else ">= 20 %"
    return (
        f"one sweep, {rate['cols']}×{rate['rows']}×5 float32, share of the copy rate",
        wanted,
        f"{rate['share_of_copy_rate']:.0%}",
        f"sweep {rate['sweep_s'] * 1e3:.2f} ms, copy of the data {rate['copy_s'] * 1e3:.2f} ms "
        f"({rate['copy_gb_per_s']:.1f} GB/s read and written), counting the data twice; "
        f"{rate['share_in_all']:.0%} counting the data once and L and M read and written",
    )


def numpy_row(rate: dict[str, float], *, repetitions: int) -> Row:
    """How many times faster than whole-array NumPy a sweep is."""
    shape = (int(rate["rows"]), int(rate["cols"]))
    beam = simulate.gaussian_beam(shape)
    frames = simulate.exposures(np.ones(shape), beam, SHIFTS).astype(np.float32)
    sensitivity = np.ones(shape)
    times = []
    for _ in range(repetitions + 1):
        start = time.perf_counter()
        sensitivity = numpy_sweep(frames, sensitivity)
        times.append(time.perf_counter() - start)
    numpy_s = float(np.median(times[1:]))
    return (
        f"one sweep, {shape[1]}×{shape[0]}×5 float32, against whole-array NumPy",
        ">= 10 x",
        f"{numpy_s / rate['sweep_s']:.0f} x",
        f"NumPy {numpy_s * 1e3:.1f} ms, median of {repetitions}",
    )


def numpy_sweep(frames: np.ndarray, sensitivity: np.ndarray) -> np.ndarray:
    """One sweep without a Python loop over pixels."""
    rows, cols = sensitivity.shape
    above, below = np.zeros((2, *(sensitivity.shape + SHIFTS.max(axis=0))))
    squared = sensitivity**2
    for frame, (row, col) in zip(frames, SHIFTS, strict=True):
        above[row : row + rows, col : col + cols] += sensitivity * frame
        below[row : row + rows, col : col + cols] += squared
    beam = np.divide(above, below, where=below > 0, out=above)
    squares = beam**2
    above, below = np.zeros((2, rows, cols))
    for frame, (row, col) in zip(frames, SHIFTS, strict=True):
        above += beam[row : row + rows, col : col + cols] * frame
        below += squares[row : row + rows, col : col + cols]
    return above / below


def heading(threads: float) -> list[str]:
    """What stands above the rows."""
    return [
        "# Measured",
        "",
        f"By `make bench`, equipix {equipix.__version__}, {threads} threads on "
        f"{platform.machine()} with {os.cpu_count()} processors, Python "
        f"{platform.python_version()}, NumPy {np.__version__}.",
        "",
        "| work | wanted | got | how |",
        "|---|---|---|---|",
    ]


if __name__ == "__main__":
    main(smoke="--smoke" in sys.argv[1:])
