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
from commands import Row
from peers import table as peers

import batch
import equipix
import experiment
import scene
from equipix import simulate

HERE = Path(__file__).parent
SHIFTS = equipix.cross_pattern(11, 19)


def main(*, smoke: bool) -> None:
    """Run all measurements."""
    rates = cargo.bench("rates", smoke=smoke)
    rows = [rate_row(rate) for rate in rates]
    rows.append(numpy_row(rates[0], repetitions=1 if smoke else 7))
    rows += multiscale.rows(smoke=smoke)
    rows += uncertainty.rows((48, 64), 1) if smoke else uncertainty.rows()
    rows += subpixel.rows((48, 64), repetitions=1) if smoke else subpixel.rows()
    rows += experiment.rows((96, 128), frames=2, repetitions=1) if smoke else experiment.rows()
    small = (((96, 128), 1, 1),)
    rows += experiment.large_rows(small) if smoke else experiment.large_rows()
    rows += large.rows((96, 128)) if smoke else large.rows()
    few = {"travels": (20,), "patterns": 1}
    rows += patterns.rows((96, 128), **few) if smoke else patterns.rows()
    rows += planning.rows((96, 128), travel=20) if smoke else planning.rows()
    rows += levels.rows((96, 128), frames=3) if smoke else levels.rows()
    rows += reporting.rows((96, 128)) if smoke else reporting.rows()
    lot = {"shape": (96, 128), "sensors": 2, "frames": 2, "repetitions": 1}
    rows += batch.rows(**lot) if smoke else batch.rows()
    rows += watching.rows((96, 128), frames=2, repetitions=1) if smoke else watching.rows()
    rows += averaging.rows(frames=3, repetitions=1) if smoke else averaging.rows()
    rows += response.rows(shape=(24, 32), repetitions=1) if smoke else response.rows()
    rows += scene.rows(shape=(48, 64), frames=3, passes=1) if smoke else scene.rows()
    rows += applying.rows(shapes=((48, 64), (24, 32)), repetitions=1) if smoke else applying.rows()
    rows += peers.rows(factors={(48, 64): 1.5}, seconds=0.5) if smoke else peers.rows()
    table = markdown(rows, rates[0]["threads"])
    print(table)
    if not smoke:
        (HERE / "RESULTS.md").write_text(table)


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


def markdown(rows: list[Row], threads: float) -> str:
    """Lay the rows out as a table."""
    lines = [
        "# Measured",
        "",
        f"By `make bench`, equipix {equipix.__version__}, {threads} threads on "
        f"{platform.machine()} with {os.cpu_count()} processors, Python "
        f"{platform.python_version()}, NumPy {np.__version__}.",
        "",
        "| work | wanted | got | how |",
        "|---|---|---|---|",
    ]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main(smoke="--smoke" in sys.argv[1:])
