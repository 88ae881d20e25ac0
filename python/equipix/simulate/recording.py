"""A virtual experiment on disk: TIFF files and the manifest that names them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix._check import Progress
from equipix.errors import FileError
from equipix.io.paths import folder_beside, replace_folder
from equipix.io.tiff import write_frames


@dataclass(frozen=True, eq=False)
class Stream:
    """Frames of one shape, made one at a time as they are written.

    Attributes
    ----------
    frames : iterator of ndarray
        The frames.
    count : int
        Their number.
    """

    frames: Iterator[NDArray[Any]]
    count: int


@dataclass(frozen=True, eq=False)
class Recording:
    """All that an experiment holds on disk.

    Attributes
    ----------
    bit_depth : int
        Bits of the camera's ADC.
    frame_bytes : int
        Bytes of one frame.
    dark : Stream
        Dark frames.
    exposures : list of Stream
        Frames of each exposure.
    moves : list of tuple of Stream
        Images of the hole before and after each move, from the first exposure on.
    truth : dict
        What a calibration should find, by name.
    cfa : str, list of list of str, or None
        Colour filters of the camera.
    """

    bit_depth: int
    frame_bytes: int
    dark: Stream
    exposures: list[Stream]
    moves: list[tuple[Stream, Stream]]
    truth: dict[str, Any]
    cfa: str | list[list[str]] | None = None


def write_experiment(
    recording: Recording, target: Path, *, force: bool, progress: Progress | None
) -> Path:
    """Write an experiment whole or not at all; see `VirtualExperiment.write`."""
    if target.exists() and not _may_replace(target, force):
        raise FileError(
            f"'{target}' exists and is not empty: name another folder, or force the replacement "
            "of a folder that holds nothing but an experiment written before"
        )
    streams = dict(_named(recording))
    with folder_beside(target) as folder:
        counter = _Counter(progress, sum(stream.count for stream in streams.values()))
        for name, stream in streams.items():
            (folder / name).parent.mkdir(exist_ok=True)
            nbytes = stream.count * recording.frame_bytes
            write_frames(folder / name, counter.pass_on(stream.frames), nbytes=nbytes)
        np.savez(folder / "truth.npz", **recording.truth)
        (folder / "experiment.toml").write_text(_manifest(recording), encoding="utf-8")
        replace_folder(target, folder)
    return target / "experiment.toml"


def _named(recording: Recording) -> Iterator[tuple[str, Stream]]:
    """Name the files, with the frames of each."""
    yield "dark/dark.tif", recording.dark
    for k, stream in enumerate(recording.exposures):
        yield f"frames/p{k}.tif", stream
    for k, (before, after) in enumerate(recording.moves, start=1):
        yield f"aperture/p{k}-before.tif", before
        yield f"aperture/p{k}-after.tif", after


def _manifest(recording: Recording) -> str:
    lines = [
        "# calibration experiment of a virtual camera; the truth is in truth.npz",
        "[sensor]",
        'name = "virtual"',
        f"bit_depth = {recording.bit_depth}",
        *([] if recording.cfa is None else [f"cfa = {json.dumps(recording.cfa)}"]),
        "",
        "[dark]",
        'frames = "dark/dark.tif"',
    ]
    for k in range(len(recording.exposures)):
        lines += ["", "[[exposure]]", f'name = "p{k}"', f'frames = "frames/p{k}.tif"']
        if k:
            lines.append(f'aperture_before = "aperture/p{k}-before.tif"')
            lines.append(f'aperture_after = "aperture/p{k}-after.tif"')
    return "\n".join(lines) + "\n"


class _Counter:
    """Reports frames as they are written."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def pass_on(self, frames: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Yield the frames, each reported when it has been written."""
        for frame in frames:
            yield frame
            self._done += 1
            if self._progress is not None:
                self._progress(self._done, self._total, "writing")


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
