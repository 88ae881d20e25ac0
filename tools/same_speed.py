"""Compare the times of two builds, case by case.

``python tools/same_speed.py OLD NEW`` takes two folders that hold python/equipix with its
extension, as ``same_bytes.py --with-builds`` does. The builds take turns, each in a process of its
own, so that a change of the machine's speed hits both; the table shows the ratio of the medians.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

CCD, SMALL = (582, 782), (120, 160)
ROUNDS = 5


def cases() -> dict[str, tuple[Callable[[], object], int]]:
    """What is timed, and how often in a process."""
    import equipix
    from equipix import simulate

    rng = np.random.default_rng(1)

    def exposures(shape: tuple[int, int], fraction: float) -> tuple[Any, ...]:
        shifts = equipix.cross_pattern(11, 19).astype(float)
        shifts[1:] += fraction * rng.uniform(-0.5, 0.5, (4, 2))
        truth = simulate.cosine_sensitivity(shape, rng=rng)
        frames = simulate.exposures(truth, simulate.wavy_beam(shape, rng=2), shifts)
        return frames + 1e-3 * rng.standard_normal(frames.shape), shifts, np.full(5, 1e-6)

    whole, between, small = exposures(CCD, 0), exposures(CCD, 1), exposures(SMALL, 1)
    single = (whole[0].astype(np.float32), *whole[1:])
    folder = Path(tempfile.mkdtemp(prefix="equipix-speed-"))
    virtual = simulate.experiment(
        simulate.cosine_sensitivity((240, 320), rng=3),
        simulate.gaussian_beam((240, 320)),
        equipix.cross_pattern(11, 19),
        frames=16,
        rng=4,
    )
    manifest = virtual.write(folder / "experiment")

    def calibrate(data: tuple[Any, ...], **options: Any) -> object:
        frames, shifts, variance = data
        return equipix.calibrate(frames, shifts, variance=variance, **options)

    return {
        "whole pixels, 782×582, float64": (lambda: calibrate(whole), 3),
        "whole pixels, 782×582, float32": (lambda: calibrate(single), 3),
        "200 sweeps of coordinate descent": (
            lambda: calibrate(whole, method="coordinate-descent", max_sweeps=200),
            1,
        ),
        "between pixels, 782×582, to 1e-5": (lambda: calibrate(between, tolerance=1e-5), 1),
        "whole pixels with error bars, 160×120": (
            lambda: calibrate((small[0], np.rint(small[1]), small[2]), uncertainty=True),
            1,
        ),
        "between pixels with error bars, 160×120": (lambda: calibrate(small, uncertainty=True), 1),
        "experiment with measured moves, 320×240": (
            lambda: equipix.Experiment.load(manifest).run(),
            1,
        ),
    }


def worker() -> None:
    """Time every case in this process; print the least time of each."""
    warnings.simplefilter("ignore")
    for name, (work, repeats) in cases().items():
        times = []
        for _ in range(repeats + 1):
            start = time.perf_counter()
            work()
            times.append(time.perf_counter() - start)
        print(f"{name}\t{min(times[1:])}", flush=True)


def measured(build: Path) -> dict[str, float]:
    """Times of one process of a build."""
    own = build / ".venv/bin/python"
    python = str(own) if own.exists() else sys.executable
    environment = {**os.environ, "PYTHONPATH": str(build / "python")}
    command = [python, str(Path(__file__).resolve()), "--worker"]
    out = subprocess.run(
        command, env=environment, check=True, capture_output=True, text=True
    ).stdout
    return {name: float(value) for name, value in (line.split("\t") for line in out.splitlines())}


def main() -> None:
    """Take turns and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("builds", nargs="*", type=Path, metavar="OLD NEW")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        return worker()
    old, new = arguments.builds
    runs = [(measured(old), measured(new)) for _ in range(arguments.rounds)]
    print(f"{'':42} {'old, s':>9} {'new, s':>9} {'ratio':>7}")
    for name in runs[0][0]:
        before, after = (statistics.median(run[k][name] for run in runs) for k in (0, 1))
        print(f"{name:42} {before:9.3f} {after:9.3f} {after / before:7.2f}")
    return None


if __name__ == "__main__":
    main()
