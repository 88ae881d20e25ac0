"""A virtual experiment on disk: TIFF files and the manifest that names them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import tifffile

from equipix.errors import FileError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from equipix.simulate.rig import VirtualExperiment

Progress: TypeAlias = "Callable[[int, int, str], None]"

CLASSIC_TIFF_BYTES = 2**32 - 2**25
"""Most bytes of pixels that fit the offsets of classic TIFF, with room for the directories."""


def write_experiment(
    virtual: VirtualExperiment, target: Path, *, force: bool, progress: Progress | None
) -> Path:
    """Write an experiment whole or not at all; see `VirtualExperiment.write`."""
    streams = dict(_streams(virtual))
    frame_bytes = virtual.camera.response.size * (1 if virtual.camera.bit_depth == 8 else 2)
    with _new_folder(target, force) as folder:
        writer = _Writer(folder, progress, sum(count for _, count in streams.values()))
        for name, (frames, count) in streams.items():
            writer.write(name, frames, big=count * frame_bytes > CLASSIC_TIFF_BYTES)
        np.savez(folder / "truth.npz", **vars(virtual.truth))
        (folder / "experiment.toml").write_text(_manifest(virtual), encoding="utf-8")
    return target / "experiment.toml"


def _streams(
    virtual: VirtualExperiment,
) -> Iterator[tuple[str, tuple[Iterator[NDArray[Any]], int]]]:
    """Name the files, with the frames of each and their number."""
    yield "dark/dark.tif", (virtual.dark(), virtual.dark_count)
    for k in range(len(virtual.positions)):
        yield f"frames/p{k}.tif", (virtual.frames(k), virtual.count)
    for k in range(1, len(virtual.positions)):
        count = virtual.aperture_count
        yield f"aperture/p{k}-before.tif", (virtual.aperture_before(k), count)
        yield f"aperture/p{k}-after.tif", (virtual.aperture_after(k), count)


def _manifest(virtual: VirtualExperiment) -> str:
    lines = [
        "# calibration experiment of a virtual camera; the truth is in truth.npz",
        "[sensor]",
        'name = "virtual"',
        f"bit_depth = {virtual.camera.bit_depth}",
        "",
        "[dark]",
        'frames = "dark/dark.tif"',
    ]
    for k in range(len(virtual.positions)):
        lines += ["", "[[exposure]]", f'name = "p{k}"', f'frames = "frames/p{k}.tif"']
        if k:
            lines.append(f'aperture_before = "aperture/p{k}-before.tif"')
            lines.append(f'aperture_after = "aperture/p{k}-after.tif"')
    return "\n".join(lines) + "\n"


class _Writer:
    """Writes multi-page TIFF files one frame at a time, counting the frames."""

    def __init__(self, folder: Path, progress: Progress | None, total: int) -> None:
        self._folder, self._progress, self._total, self._done = folder, progress, total, 0

    def write(self, name: str, frames: Iterator[NDArray[Any]], *, big: bool) -> None:
        path = self._folder / name
        path.parent.mkdir(exist_ok=True)
        with tifffile.TiffWriter(path, bigtiff=big) as writer:
            for frame in frames:
                writer.write(frame, photometric="minisblack", metadata=None)
                self._done += 1
                if self._progress is not None:
                    self._progress(self._done, self._total, "writing")


@contextmanager
def _new_folder(target: Path, force: bool) -> Iterator[Path]:
    """Make a folder beside the target that takes its place when all is written."""
    if target.exists() and not _may_replace(target, force):
        raise FileError(
            f"'{target}' exists and is not empty: name another folder, or force the replacement "
            "of an experiment"
        )
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        if target.exists():
            shutil.rmtree(target)
        partial.rename(target)
    except OSError as error:
        raise FileError(f"cannot write '{target}': {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _may_replace(target: Path, force: bool) -> bool:
    """Whether the target is an empty folder, or an experiment that may go."""
    if not target.is_dir():
        return False
    return not any(target.iterdir()) or (force and (target / "experiment.toml").is_file())
