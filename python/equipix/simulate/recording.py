"""A virtual experiment on disk: TIFF files and the manifest that names them."""

import json
from collections.abc import Callable, Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from equipix._check import Array, Progress
from equipix.errors import FileError
from equipix.io.paths import folder_beside, replace_folder
from equipix.io.tiff import write_frames

Stream: TypeAlias = tuple[Callable[[], Iterator[Array]], int]
"""Frames of one file, made one at a time when they are written, and their number."""


def write_experiment(
    target: Path,
    streams: Mapping[str, Stream],
    *,
    frame_bytes: int,
    sensor: Mapping[str, object],
    truth: Mapping[str, Any],
    force: bool,
    progress: Progress | None,
) -> Path:
    """Write an experiment whole or not at all; see `VirtualExperiment.write`.

    `streams` are the frames by file, `sensor` the keys of ``[sensor]``.
    """
    if target.exists() and not _may_replace(target, force):
        raise FileError(
            f"'{target}' exists and is not empty: name another folder, or force the replacement "
            "of a folder that holds nothing but an experiment written before"
        )
    with folder_beside(target) as folder:
        done, total = count(1), sum(length for _, length in streams.values())
        for name, (made, length) in streams.items():
            (folder / name).parent.mkdir(exist_ok=True)
            frames = _reported(made(), progress, done, total)
            write_frames(folder / name, frames, nbytes=length * frame_bytes)
        np.savez(folder / "truth.npz", **truth)
        manifest = _manifest(sensor, sum(name.startswith("frames/") for name in streams))
        (folder / "experiment.toml").write_text(manifest, encoding="utf-8")
        replace_folder(target, folder)
    return target / "experiment.toml"


def _manifest(sensor: Mapping[str, object], exposures: int) -> str:
    lines = [
        "# calibration experiment of a virtual camera; the truth is in truth.npz",
        "[sensor]",
        *(f"{key} = {json.dumps(value)}" for key, value in sensor.items() if value is not None),
        *("", "[dark]", 'frames = "dark/dark.tif"'),
    ]
    for k in range(exposures):
        lines += ["", "[[exposure]]", f'name = "p{k}"', f'frames = "frames/p{k}.tif"']
        if k:
            lines += [f'aperture_{end} = "aperture/p{k}-{end}.tif"' for end in ("before", "after")]
    return "\n".join(lines) + "\n"


def _reported(
    frames: Iterator[Array], progress: Progress | None, done: Iterator[int], total: int
) -> Iterator[Array]:
    """Yield frames, each reported when it has been written."""
    for frame in frames:
        yield frame
        if progress is not None:
            progress(next(done), total, "writing")


def _may_replace(target: Path, force: bool) -> bool:
    """Whether the target is an empty folder, or an experiment that may be replaced."""
    if not target.is_dir():
        return False
    return not any(target.iterdir()) or (force and all(map(_is_ours, target.iterdir())))


def _is_ours(entry: Path) -> bool:
    """Whether an entry of an experiment's folder is one that `write_experiment` makes."""
    if entry.is_symlink():
        return False
    if entry.name in ("frames", "dark", "aperture") and entry.is_dir():
        return all(file.suffix == ".tif" and file.is_file() for file in entry.iterdir())
    return entry.name in ("experiment.toml", "truth.npz") and entry.is_file()
