"""Seconds and memory of the commands for a uniform source on a large sensor, for `make bench`."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from equipix import simulate
from equipix.io.tiff import write_frames

if TYPE_CHECKING:
    from collections.abc import Iterable

Row = tuple[str, str, str, str]

SHAPE = (3000, 4000)
FRAMES = 8
LEVELS_E = (4e3, 8e3, 12e3, 16e3)
STEADY_E = 10e3
"""Photoelectrons of the frames of one steady level, of which three times as many are made."""


class Command(NamedTuple):
    """A command, its arguments, and the seconds and gigabytes that are wanted."""

    work: str
    arguments: tuple[str, ...]
    seconds: float
    gigabytes: float | None = None


COMMANDS = (
    Command(
        "nuc fit, order 1",
        ("nuc", "fit", "levels.toml", "-o", "response.tif", "--order", "1", "--force"),
        12,
        2.0,
    ),
    Command(
        "nuc fit, order auto",
        ("nuc", "fit", "levels.toml", "-o", "auto.tif", "--order", "auto", "--force"),
        18,
        2.0,
    ),
    Command("nuc quality", ("nuc", "quality", "response.tif", "steady0.tif"), 6, 1.5),
    Command(
        "nuc quality, three times the frames",
        ("nuc", "quality", "response.tif", "steady*.tif"),
        12,
        1.5,
    ),
    Command("nuc defects", ("nuc", "defects", "response.tif", "steady0.tif"), 6),
    Command("hardware", ("hardware", "response.tif", "-o", "table.bin", "--force"), 8),
)
"""The first writes the response that others read."""


def rows(shape: tuple[int, int] = SHAPE, *, frames: int = FRAMES) -> list[Row]:
    """Run each command in a process of its own; give the rows: work, wanted, got, how."""
    with tempfile.TemporaryDirectory(prefix="equipix-") as scratch:
        write_data(Path(scratch), shape, frames)
        return [measured(Path(scratch), each, f"{shape[1]}×{shape[0]}") for each in COMMANDS]


def measured(folder: Path, command: Command, size: str) -> Row:
    """Time of a command, and the most memory that its process ever held."""
    start = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-m", "equipix", *command.arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
    _, status, used = os.wait4(child.pid, 0)
    seconds = time.perf_counter() - start
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, child.args)
    limit = "" if command.gigabytes is None else f", {command.gigabytes:g} GB"
    return (
        f"equipix {command.work}, {size}",
        f"<= {command.seconds:g} s{limit}",
        f"{seconds:.1f} s, {1024 * used.ru_maxrss / 1e9:.2f} GB",
        f"{used.ru_utime + used.ru_stime:.1f} s of processors; peak of resident memory",
    )


def write_data(folder: Path, shape: tuple[int, int], frames: int) -> None:
    """Write levels with their dark, their levels.toml, and frames of one steady level."""
    rng = np.random.default_rng(1)
    bad = rng.choice(shape[0] * shape[1], shape[0] * shape[1] // 1000, replace=False)
    camera = simulate.Camera(
        sensitivity=1 + 0.03 * rng.standard_normal(shape, np.float32),
        dark=60 + 4 * rng.standard_normal(shape, np.float32),
        dead=bad[::2],
        hot=bad[1::2],
    )
    write(folder / "dark.tif", camera, 0.0, frames, rng)
    lines = ["[sensor]", "bit_depth = 12", "[dark]", 'frames = "dark.tif"']
    for number, light_e in enumerate(LEVELS_E):
        write(folder / f"level{number}.tif", camera, light_e, frames, rng)
        lines += ["[[level]]", f'frames = "level{number}.tif"']
    (folder / "levels.toml").write_text("\n".join(lines))
    for number in range(3):
        write(folder / f"steady{number}.tif", camera, STEADY_E, frames, rng)


def write(
    path: Path, camera: simulate.Camera, light_e: float, count: int, rng: np.random.Generator
) -> None:
    """Write frames of even light."""
    light = np.broadcast_to(light_e, camera.shape)
    made: Iterable[np.ndarray] = camera.frames(light, count, rng=rng)
    write_frames(path, made, nbytes=2 * count * camera.response.size)


if __name__ == "__main__":
    for row in rows():
        print(" | ".join(row))
