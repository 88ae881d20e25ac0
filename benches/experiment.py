"""What a calibration from files takes beside reading them, in calibrations at whole shifts."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from commands import Command, Row, measure

import equipix
from equipix import demo
from equipix.experiment.aperture import measured_moves
from equipix.experiment.image_files import sha256_of
from equipix.experiment.manifest import entry_files as find_files

if TYPE_CHECKING:
    from collections.abc import Callable


def rows(
    shape: tuple[int, int] = (582, 782), *, frames: int = 8, repetitions: int = 3
) -> list[Row]:
    """Time a calibration from files with measured moves, and its parts, in turn."""
    with tempfile.TemporaryDirectory(prefix="equipix-") as scratch:
        virtual = demo.virtual_experiment(shape, frames=frames, bit_depth=12, rng=1)
        experiment = equipix.Experiment.load(virtual.write(Path(scratch) / "experiment"))
        averages = averaged(experiment)
        shifts = np.rint(measured_moves(experiment.path, experiment.manifest).shifts)
        parts: list[Callable[[], object]] = [
            experiment.run,
            lambda: reading(experiment),
            lambda: equipix.calibrate(averages, shifts),
        ]
        seconds = [[timed(part) for part in parts] for _ in range(repetitions)]
    run, read, whole = np.median(seconds, axis=0)
    return [
        (
            f"calibration from files, {shape[1]}×{shape[0]}, measured moves, beside reading, "
            "averaging and spots",
            "<= 8 calibrations at whole shifts",
            f"{(run - read) / whole:.1f}",
            f"{run:.2f} s, of which reading {read:.2f} s; at whole shifts {whole:.2f} s; medians "
            f"of {repetitions} in turn",
        )
    ]


LARGE = (((3000, 4000), 40, 2.5), ((6000, 8000), 180, 8))
"""Shapes, and the seconds and gigabytes that are wanted of `equipix calibrate`."""


def large_rows(wanted: tuple[tuple[tuple[int, int], float, float], ...] = LARGE) -> list[Row]:
    """Run the usual way on large sensors: two frames, five positions, measured moves."""
    rows = []
    for shape, seconds, gigabytes in wanted:
        with tempfile.TemporaryDirectory(prefix="equipix-") as scratch:
            sizes = ("--shape", *map(str, shape), "--frames", "2")
            measure(("simulate", "-o", "experiment", *sizes), Path(scratch))
            manifest = "experiment/experiment.toml"
            calibrate = ("calibrate", manifest, "-o", "calibration.tif")
            command = Command("calibrate, measured moves", calibrate, seconds, gigabytes)
            rows.append(command.row(Path(scratch), shape))
    return rows


def averaged(experiment: equipix.Experiment) -> list[equipix.FrameStatistics]:
    """Averages of the dark, subtracted, and of all exposures."""
    path, manifest = experiment.path, experiment.manifest
    level = manifest.sensor.saturation_level
    darks = [file for each in manifest.dark or () for file in find_files(path, each.frames)]
    dark = equipix.average(darks, saturation=level)
    return [
        equipix.average(find_files(path, each.frames), dark=dark, saturation=level)
        for each in manifest.exposure
    ]


def reading(experiment: equipix.Experiment) -> None:
    """What a run reads: averages, hashes, and spots, which it measures twice."""
    averaged(experiment)
    sha256_of([experiment.path, *experiment.files()])
    for _ in range(2):
        measured_moves(experiment.path, experiment.manifest)


def timed(part: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    part()
    return time.perf_counter() - start


if __name__ == "__main__":
    for row in [*rows(), *large_rows()]:
        print(" | ".join(row))
