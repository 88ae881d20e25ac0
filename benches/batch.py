"""Sensors an hour on one and on two workers, and what a running cluster adds to one sensor."""

from __future__ import annotations

import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from commands import Row, measure

from equipix import batch, demo
from equipix.batch.cluster import SETTINGS
from equipix.batch.evaluation import Job, described_by, evaluate
from equipix.batch.memory import bytes_needed
from equipix.report.limits import LimitsFile

if TYPE_CHECKING:
    from collections.abc import Iterator


def rows(
    shape: tuple[int, int] = (582, 782), *, sensors: int = 12, frames: int = 8, repetitions: int = 3
) -> list[Row]:
    """Evaluate a lot on running clusters of workers of one thread each."""
    with tempfile.TemporaryDirectory(prefix="equipix-") as scratch:
        folder = Path(scratch)
        lot = [written(folder / f"s{number:02}", shape, frames) for number in range(sensors)]
        seconds, starts = {}, []
        for workers in (1, 2):
            with running(workers, lot[0], folder) as (address, started):
                starts.append(started)
                seconds[workers] = timed(lot, folder, address)
                if workers == 1:
                    added = what_one_takes(lot[0], folder, address, repetitions)
        memory, reserved, read, output, inputs = what_one_moves(lot[0], folder)
    size = f"{shape[1]}×{shape[0]}"
    efficiency = seconds[1] / seconds[2] / 2
    alone, there = np.median(added, axis=0)
    return [
        (
            f"batch of {sensors} sensors of {size}, efficiency of two workers of one thread each",
            ">= 0.9",
            f"{efficiency:.2f}",
            f"{3600 * sensors / seconds[1]:.0f} sensors an hour on one, "
            f"{3600 * sensors / seconds[2]:.0f} on two, with their pages and that of the lot",
        ),
        (
            f"what a running cluster adds to one sensor of {size}",
            "<= 10 %",
            f"{there / alone - 1:.1%}",
            f"{there:.2f} s, in this process {alone:.2f} s, one thread each, medians of "
            f"{repetitions} in turn; the start of a cluster, {starts[0]:.1f} s, apart",
        ),
        (
            f"what one sensor of {size} takes in a batch",
            "",
            f"{memory:.2f} GB of memory of {reserved:.2f} reserved, {read:.0f} MB read, "
            f"{output:.0f} MB written",
            f"{frames} frames of 16 bits of each position and of the dark, and images of the hole: "
            f"{inputs:.0f} MB; its page is written too",
        ),
    ]


def written(folder: Path, shape: tuple[int, int], frames: int) -> Path:
    """Write the images of a sensor of its own."""
    number = int(folder.name[1:])
    virtual = demo.virtual_experiment(shape, frames=frames, bit_depth=12, rng=number)
    return virtual.write(folder)


@contextmanager
def running(workers: int, manifest: Path, folder: Path) -> Iterator[tuple[str, float]]:
    """Address of a cluster whose workers have evaluated a sensor, and how long its start took."""
    import dask
    from distributed import LocalCluster

    started = time.perf_counter()
    with (
        dask.config.set(SETTINGS),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=0,
            dashboard_address="127.0.0.1:0",
            resources={"equipix-memory": 4e9},
        ) as cluster,
    ):
        taken = time.perf_counter() - started
        # As many sensors as workers, so that each has imported all that it needs.
        first = [manifest, *sorted(folder.glob("s*/experiment.toml"))[1:workers]]
        timed(first, folder, cluster.scheduler_address)
        yield cluster.scheduler_address, taken


def timed(manifests: list[Path], folder: Path, address: str) -> float:
    """Seconds of a lot that was not evaluated before."""
    with tempfile.TemporaryDirectory(dir=folder) as output:
        started = time.perf_counter()
        lot = batch.run(manifests, output, scheduler=address)
        taken = time.perf_counter() - started
    if lot.failed:
        raise RuntimeError(lot.failed[0].reason)
    return taken


def what_one_takes(
    manifest: Path, folder: Path, address: str, repetitions: int
) -> list[tuple[float, float]]:
    """Seconds of a sensor and its lot in this process and on a cluster, in turn."""
    return [
        (timed_alone(manifest, folder), timed([manifest], folder, address))
        for _ in range(1 + repetitions)
    ][1:]


def timed_alone(manifest: Path, folder: Path) -> float:
    """Seconds of the same work in this process."""
    with tempfile.TemporaryDirectory(dir=folder) as output:
        job = Job("a", manifest, Path(output), ".tif", {}, LimitsFile(), partial=False)
        started = time.perf_counter()
        row = evaluate(job, 1)
        batch.Lot((row,)).save(Path(output))
        taken = time.perf_counter() - started
    if row.status != "done":
        raise RuntimeError(row.reason)
    return taken


def what_one_moves(manifest: Path, folder: Path) -> tuple[float, ...]:
    """Gigabytes of memory, and those reserved; megabytes read, written, and of its inputs."""
    reserved = bytes_needed(described_by(manifest), {}) / 1e9
    before = bytes_read()
    timed_alone(manifest, folder)
    read = (bytes_read() - before) / 1e6
    with tempfile.TemporaryDirectory(dir=folder) as output:
        command = ("batch", str(manifest), "-o", output, "--workers", "1")
        memory = measure(command).gigabytes
        return memory, reserved, read, megabytes(Path(output)), megabytes(manifest.parent)


def bytes_read() -> int:
    """Bytes that this process has read so far, those that memory held among them."""
    return int(Path("/proc/self/io").read_text().split()[1])


def megabytes(folder: Path) -> float:
    """Size of all files in a folder."""
    return sum(each.stat().st_size for each in folder.rglob("*") if each.is_file()) / 1e6


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
