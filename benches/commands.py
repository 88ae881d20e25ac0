"""Seconds and memory of equipix commands, each in a process of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

Row = tuple[str, str, str, str]

OBSERVED = """
import atexit, os, runpy, sys
from pathlib import Path

def tell():
    os.write(told, Path("/proc/self/status").read_bytes())

told = int(sys.argv.pop(1))
atexit.register(tell)
runpy.run_module("equipix", run_name="__main__", alter_sys=True)
"""
"""Runs equipix and tells of itself at the end. What the system counts for a child begins with the
peak of its parent."""


class Cost(NamedTuple):
    """Seconds that passed, seconds of processors, and the most memory that it ever held."""

    seconds: float
    processors: float
    gigabytes: float


def measure(arguments: tuple[str, ...], folder: Path | None = None) -> Cost:
    """Run a command of equipix, without what it prints of its result."""
    heard, told = os.pipe()
    start = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-c", OBSERVED, str(told), *arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        pass_fds=[told],
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
    os.close(told)
    with os.fdopen(heard) as pipe:
        state = pipe.read()
    _, status, used = os.wait4(child.pid, 0)
    seconds = time.perf_counter() - start
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, child.args)
    peak = re.findall(r"VmHWM:\s+(\d+)", state)[0]
    return Cost(seconds, used.ru_utime + used.ru_stime, 1024 * int(peak) / 1e9)


class Command(NamedTuple):
    """A command, its arguments, and the seconds and gigabytes that are wanted."""

    work: str
    arguments: tuple[str, ...]
    seconds: float
    gigabytes: float | None = None

    def row(self, folder: Path, shape: tuple[int, int]) -> Row:
        """Run it in a folder; give its row: work, wanted, got, how."""
        cost = measure(self.arguments, folder)
        limit = "" if self.gigabytes is None else f", {self.gigabytes:g} GB"
        return (
            f"equipix {self.work}, {shape[1]}×{shape[0]}",
            f"<= {self.seconds:g} s{limit}",
            f"{cost.seconds:.1f} s, {cost.gigabytes:.2f} GB",
            f"{cost.processors:.1f} s of processors; peak of resident memory",
        )
