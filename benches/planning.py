"""`equipix plan` for a sensor of 150 megapixels: seconds and memory, for `make bench`."""

from __future__ import annotations

import os
import subprocess
import sys

Row = tuple[str, str, str, str]

SHAPE = (10240, 14648)
CROSS = "0,0 0,11 0,19 11,0 19,0"


def rows(shape: tuple[int, int] = SHAPE, travel: int = 200) -> list[Row]:
    """Measure each command in a process of its own, and give the table's rows."""
    searched = measure(shape, "--max-shift", str(travel), str(travel))
    judged = measure(shape, "--shifts", CROSS)
    found = f"plan --max-shift {travel} {travel}, {shape[1]}×{shape[0]}"
    given = f"plan of cross (11, 19), {shape[1]}×{shape[0]}"
    return [
        (f"{work}: {name}", f"<= {limit:g} {unit}", f"{got:.{places}f} {unit}", how)
        for work, limit, figures in ((found, 15.0, searched), (given, 2.0, judged))
        for name, limit, unit, got, places, how in (
            ("time of the processor", limit, "s", figures[0], 1, "user and system, with imports"),
            ("peak memory", 0.3, "GB", figures[1], 2, "of the process"),
        )
    ]


def measure(shape: tuple[int, int], *options: str) -> tuple[float, float]:
    """Seconds of the processor and peak memory in GB of a command."""
    command = [sys.executable, "-m", "equipix", "plan", "--shape", *map(str, shape), *options]
    silent = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=silent, stderr=silent) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return used.ru_utime + used.ru_stime, 1024 * used.ru_maxrss / 1e9


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
