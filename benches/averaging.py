"""Averaging of 500 TIFF files beside ``cat`` and NumPy, for the table of `make bench`."""

from __future__ import annotations

import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tifffile

import equipix

if TYPE_CHECKING:
    from collections.abc import Callable

FRAMES = 500
SHAPE = (582, 782)
REPETITIONS = 5


def rows(
    *, frames: int = FRAMES, repetitions: int = REPETITIONS
) -> list[tuple[str, str, str, str]]:
    """Measure, and give the table's rows: work, wanted, got, how."""
    with tempfile.TemporaryDirectory() as folder:
        paths = _write(Path(folder), frames)
        works = (lambda: equipix.average(paths), lambda: _cat(paths), lambda: _numpy(paths))
        ours, cat, numpy = _seconds(*works, repetitions=repetitions)
    work = f"average {frames} 16-bit TIFF files of {SHAPE[1]}x{SHAPE[0]}, page cache"
    how = f"median of {repetitions} interleaved: {ours:.3f} s"
    return [
        (work, "<= 1.25 x cat", f"{ours / cat:.2f} x", f"{how}, cat {cat:.3f} s"),
        (work, ">= 4 x numpy", f"{numpy / ours:.1f} x", f"{how}, numpy and tifffile {numpy:.3f} s"),
    ]


def _write(folder: Path, frames: int) -> list[Path]:
    rng = np.random.default_rng(0)
    scene = rng.normal(2000, 40, SHAPE)
    paths = [folder / f"{index:03}.tif" for index in range(frames)]
    for path in paths:
        tifffile.imwrite(path, rng.normal(scene, 20).astype(np.uint16))
    return paths


def _cat(paths: list[Path]) -> None:
    subprocess.run(["cat", *paths], stdout=subprocess.DEVNULL, check=True)


def _numpy(paths: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    total, squares = np.zeros(SHAPE), np.zeros(SHAPE)
    for path in paths:
        frame = tifffile.imread(path).astype(np.float64)
        total += frame
        squares += frame * frame
    mean = total / len(paths)
    return mean, (squares - total * mean) / (len(paths) - 1)


def _seconds(*works: Callable[[], object], repetitions: int) -> list[float]:
    """Median time of each work, their repetitions interleaved; the first round does not count."""
    times: list[list[float]] = [[] for _ in works]
    for _ in range(repetitions + 1):
        for work, taken in zip(works, times, strict=True):
            start = time.perf_counter()
            work()
            taken.append(time.perf_counter() - start)
    return [statistics.median(taken[1:]) for taken in times]


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
