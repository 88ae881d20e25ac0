"""A report of a 150-megapixel calibration: seconds, bytes of the page and memory."""

from __future__ import annotations

import dataclasses
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from commands import Row
from large import SHAPE, true_sensitivity

import equipix
from equipix import simulate


def rows(shape: tuple[int, int] = SHAPE) -> list[Row]:
    """Measure in a process of its own, and give the table's rows: work, wanted, got, how."""
    command = [sys.executable, __file__, *map(str, shape)]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found = json.loads(output.stdout)
    work = f"report of a calibration {shape[1]}×{shape[0]} float32 with standard deviations"
    how = f"peak memory {found['peak'] / 1e9:.1f} GB, saved result {found['saved'] / 1e9:.2f} GB"
    return [
        (f"{work}: time", "<= 60 s", f"{found['seconds']:.1f} s", how),
        (f"{work}: page", "<= 15 MB", f"{found['page'] / 1e6:.1f} MB", ""),
    ]


def save_large(shape: tuple[int, int], path: Path) -> None:
    """Save a calibration of this shape, made from a small one, with a thousand dead pixels."""
    small = (24, 32)
    shifts = equipix.cross_pattern(3, 5)
    frames = simulate.exposures(np.ones(small), simulate.gaussian_beam(small), shifts)
    cal = equipix.calibrate(frames, shifts, variance=np.full(5, 1e-6), uncertainty=True)
    sensitivity = np.concatenate(
        [true_sensitivity(shape, first) for first in range(0, shape[0], 64)]
    ).astype(np.float32)
    flags = np.zeros(shape, cal.flags.dtype)
    flags.flat[:: max(1, flags.size // 1000)] = equipix.Flag.DEAD | equipix.Flag.DO_NOT_USE
    sensitivity[flags != 0] = np.nan
    dataclasses.replace(
        cal,
        sensitivity=sensitivity,
        sensitivity_std=np.full_like(sensitivity, 1e-3),
        flags=flags,
        component_labels=np.ones(shape, cal.component_labels.dtype),
        beam=np.ones((shape[0] + 6, shape[1] + 10)),
    ).save(path)


def measure(shape: tuple[int, int], folder: Path) -> dict[str, object]:
    """Write the page by the command line."""
    saved, page = folder / "cal.tif", folder / "report.html"
    save_large(shape, saved)
    command = [sys.executable, "-m", "equipix", "report", str(saved), "--output", str(page)]
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return {
        "seconds": time.perf_counter() - start,
        "peak": 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss,
        "saved": saved.stat().st_size,
        "page": page.stat().st_size,
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(json.dumps(measure((int(sys.argv[1]), int(sys.argv[2])), Path(place))))
