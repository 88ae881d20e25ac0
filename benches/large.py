"""150 megapixels in float32: memory, seconds and how soon Ctrl-C is heard, for `make bench`."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
from commands import Row

import equipix
from equipix import simulate

SHAPE = (10240, 14648)
SHIFTS = equipix.cross_pattern(11, 19)
BLOCK = 64
"""Rows made at a time."""

MOMENTS = (0.02, 0.1, 0.3, 0.6)
"""When Ctrl-C is pressed, as shares of the time that a calibration takes."""


def rows(shape: tuple[int, int] = SHAPE) -> list[Row]:
    """Measure in a process of its own, and give the table's rows: work, wanted, got, how."""
    command = [sys.executable, __file__, *map(str, shape)]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found = json.loads(output.stdout)
    work = f"hard case {shape[1]}×{shape[0]}×5 float32 in Python"
    certified = "converged" if found["converged"] else "not converged"
    how = (
        f"{found['seconds']:.1f} s, {certified} at {found['error_estimate']:.1e}, true error "
        f"{found['error']:.1e}, {found['sweeps']} products"
    )
    times = ", ".join(f"{share:.0%}" for share in MOMENTS)
    return [
        (
            f"{work}: peak memory over that of the data",
            "<= 3.5 x",
            f"{found['peak'] / found['data']:.2f} x",
            f"{found['peak'] / 1e9:.2f} GB by VmHWM, data {found['data'] / 1e9:.2f} GB",
        ),
        (f"{work}: time", "< 120 s", f"{found['seconds']:.1f} s", how),
        (
            f"{work}: from Ctrl-C to KeyboardInterrupt",
            "<= 0.5 s",
            f"{max(found['waits']):.2f} s",
            f"the longest, pressed after {times} of the time",
        ),
    ]


def measure(shape: tuple[int, int]) -> dict[str, object]:
    """Calibrate, and break off some calibrations."""
    frames = hard_case(shape)
    start = time.perf_counter()
    calibration = equipix.calibrate(frames, SHIFTS)
    seconds = time.perf_counter() - start
    found = {
        "data": frames.nbytes,
        "peak": peak_bytes(),
        "seconds": seconds,
        "sweeps": calibration.sweeps,
        "converged": calibration.converged,
        "error_estimate": calibration.error_estimate,
        "error": true_error(calibration.sensitivity),
    }
    del calibration
    return found | {"waits": [wait_after_interrupt(frames, share * seconds) for share in MOMENTS]}


def hard_case(shape: tuple[int, int]) -> np.ndarray:
    """Noise-free exposures of a sensor that varies on all scales, made in place."""
    frames = np.empty((len(SHIFTS), *shape), np.float32)
    beam = simulate.gaussian_beam(shape, width=1000 * max(1, shape[1] / 782))
    for first in range(0, shape[0], BLOCK):
        truth = true_sensitivity(shape, first)
        rows, cols = first + np.arange(len(truth))[:, None], np.arange(shape[1])
        for frame, (row, col) in zip(frames, SHIFTS, strict=True):
            frame[first : first + BLOCK] = beam(rows + row, cols + col) * truth
    return frames


def true_sensitivity(shape: tuple[int, int], first: int) -> np.ndarray:
    """A block of rows of `simulate.cosine_sensitivity`, with random numbers of its own."""
    u, v = (np.linspace(-0.5, 0.5, size) for size in shape)
    large_scale = 1 + 0.05 * np.cos(2 * u[first : first + BLOCK, None]) * np.cos(3 * v + 1)
    return simulate.paper_sensitivity(large_scale.shape, rng=first) * large_scale


def true_error(sensitivity: np.ndarray) -> float:
    """The largest relative error of M, found and true both divided by their means."""
    ratios, means = [], []
    for first in range(0, len(sensitivity), BLOCK):
        found = sensitivity[first : first + BLOCK].astype(np.float64)
        truth = true_sensitivity(sensitivity.shape, first)
        means.append((found.sum(), truth.sum()))
        ratios.append(((found / truth).min(), (found / truth).max()))
    found, truth = np.sum(means, axis=0)
    return float(np.abs(np.array(ratios) * truth / found - 1).max())


def peak_bytes() -> int:
    """The most memory that this process ever held."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(re.findall(r"VmHWM:\s+(\d+)", status)[0])


def wait_after_interrupt(frames: np.ndarray, seconds: float) -> float:
    """How long a calibration goes on after Ctrl-C is pressed so many seconds into it."""
    pressed = []

    def press() -> None:
        pressed.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)

    try:
        threading.Timer(seconds, press).start()
        equipix.calibrate(frames, SHIFTS)
        # Faster than before: there is nothing left to break off.
        while True:
            time.sleep(1)
    except KeyboardInterrupt:
        return time.perf_counter() - pressed[0]


if __name__ == "__main__":
    # A run that a script starts in the background ignores Ctrl-C, and would wait for it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print(json.dumps(measure((int(sys.argv[1]), int(sys.argv[2])))))
