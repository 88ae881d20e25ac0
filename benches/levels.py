"""Seconds and memory of the commands for a uniform source on a large sensor, for `make bench`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from commands import Command, Row

from equipix import simulate
from equipix.io.tiff import write_frames

if TYPE_CHECKING:
    from collections.abc import Iterable

SHAPE = (3000, 4000)
FRAMES = 8
LEVELS_E = (4e3, 8e3, 12e3, 16e3)
STEADY_E = 10e3
"""Photoelectrons of the frames of one steady level, of which three times as many are made."""


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
        return [command.row(Path(scratch), shape) for command in COMMANDS]


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
