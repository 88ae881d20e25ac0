"""Averages of long series: sums of pieces by workers, merged in their order."""

import hashlib
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from equipix._check import (
    Array,
    ArrayLike,
    Progress,
    as_floats,
    as_level,
    as_mask,
    positive_workers,
)
from equipix.batch.memory import PROCESS
from equipix.batch.series import Frames, Piece, Series, key_of, series_at
from equipix.errors import FileError, InputError
from equipix.experiment.image_files import sha256_of, with_inputs
from equipix.io.formats import ONLY_RESULTS, FrameFile, frame_files
from equipix.io.paths import as_path, write_whole
from equipix.io.record import now
from equipix.measured.average import RunningAverage, completed, refuse_mixed
from equipix.measured.average import average as average_here
from equipix.measured.settings import taken_with
from equipix.measured.statistics import FrameStatistics, is_average
from equipix.measured.stream import GROUP, batches

_EXACT = ("uint8", "uint16")
"""Types whose sums are exact, so that pieces may be of any size."""

_WHOLE, _FLOATS = 64, 132
"""Bytes of a pixel's sums, of what comes of them, and of a copy to be written."""

_CRC = 4
"""Bytes of the checksum of sums."""


def average(
    frames: str | PathLike[str] | Iterable[str | PathLike[str]],
    work: str | PathLike[str],
    *,
    scheduler: str | None = "local",
    dark: FrameStatistics | ArrayLike | None = None,
    saturation: float | None = None,
    mask: ArrayLike | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> FrameStatistics:
    """Average the frames of files, 256 at a time, on the workers of a cluster.

    Parameters
    ----------
    frames : path, glob, or list of these
        Files as of `equipix.average`. All workers must see them under the same names.
    work : path
        Folder of the sums that workers have finished, made where it is not there. All workers must
        see it. Called again, the function goes on with those of the same inputs, options and
        version. Remove it when the result is saved.
    scheduler : str, optional
        Address of a scheduler of dask.distributed, such as ``tcp://host:8786``, "local" for worker
        processes on this machine, or None for no other process than this one.
    dark : FrameStatistics or array of shape (rows, cols), optional
        Dark mean to subtract, as of `equipix.average`.
    saturation : float, optional
        Level of saturation in DN, as of `equipix.average`.
    mask : array_like of bool, shape (rows, cols), optional
        True = do not use, as of `equipix.average`.
    workers : int, optional
        Number of worker processes on this machine, or of threads without a scheduler.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` repeatedly, in pieces.

    Returns
    -------
    FrameStatistics
        The same bytes of every array as of `equipix.average`; the metadata also hold the hashes of
        the files.

    Raises
    ------
    FileError
        If a file is missing, broken or differs from the first, or `work` cannot be written.
    InputError
        If an argument has a wrong shape or value.
    EquipixError
        If dask.distributed is not installed, or the scheduler cannot be reached.

    Notes
    -----
    A worker reads and sums a piece of frames, and writes the sums to `work`, whole or not at all.
    Nothing but names and hashes travels through the scheduler. At the end the sums are merged in
    the order of the frames, one piece at a time, so memory does not grow with their number. Pieces
    are 256 frames, or of whole numbers whole chunks of an HDF5 or Zarr file.
    """
    files = frame_files([frames] if isinstance(frames, str | PathLike) else frames)
    offset = dark if isinstance(dark, FrameStatistics | None) else as_floats("dark", dark, ndim=2)
    place = as_path("work", work)
    positive_workers(workers)
    with series_at(scheduler, place, memory_of(files), workers, progress) as series:
        hashes = sha256_of([file.path for file in files], series.digests)
        found = average_in(series, files, hashes, dark=offset, saturation=saturation, mask=mask)
    return replace(found, metadata=with_inputs(found.metadata, hashes))


def average_in(
    series: Series,
    files: Sequence[FrameFile],
    hashes: Mapping[Path, str],
    *,
    dark: FrameStatistics | Array | None = None,
    saturation: float | None = None,
    mask: ArrayLike | None = None,
    **options: Any,
) -> FrameStatistics:
    """Average files on a cluster; a saved average is read here. Other options are those of it."""
    started = now()
    if _is_saved(files):
        return average_here(files, dark=dark, saturation=saturation, mask=mask, **options)
    refuse_mixed([*files])
    frames, level = Frames(files), as_level(saturation)
    pieces = frames.pieces(_size(frames))
    excluded = as_mask(mask, frames.shape)
    key = key_of(
        {file.path: hashes[file.path] for file in files},
        dtype=frames.dtype.str,
        frames=[frames.count, *frames.shape],
        saturation=level,
        mask=None if excluded is None else hashlib.sha256(excluded.tobytes()).hexdigest(),
    )
    place = None if excluded is None else series.kept_array(f"{key}.mask", excluded)
    jobs = [
        _Job(series.work / f"{key}.{piece.start}.sums", piece, frames.dtype, level, place)
        for piece in pieces
    ]
    left = [job for job in jobs if _read(job.target) is None]
    series.results(_sum, left, memory_of(files)[0], "average")
    series.refuse_changed([job.target for job in jobs])
    sums = RunningAverage(np.empty((0, *frames.shape), frames.dtype), level, excluded)
    for job in jobs:
        state = _read(job.target)
        if state is None:
            raise FileError(f"{job.target}: is damaged: call again, and its frames are read again")
        sums.merge(state)
    statistics = sums.statistics()
    if not statistics.count.any():
        raise InputError("'frames' holds no finite number: give frames with numbers")
    return completed(statistics, dark, mask, started, taken_with(files), level)


def memory_of(files: Sequence[FrameFile]) -> list[int]:
    """Bytes that each piece needs at the peak."""
    if _is_saved(files):
        return [PROCESS]
    frames = Frames(files)
    sums = _WHOLE if frames.dtype.name in _EXACT else _FLOATS
    need = PROCESS + sums * math.prod(frames.shape) + frames.reading
    return [need] * len(frames.pieces(_size(frames)))


def _is_saved(files: Sequence[FrameFile]) -> bool:
    """Whether a result stands in the place of frames."""
    return any(file.path.suffix.lower() in ONLY_RESULTS or is_average(file) for file in files)


def _size(frames: Frames) -> int:
    """Frames of a piece: a group of the core, or of exact sums whole chunks of the file."""
    if frames.dtype.name not in _EXACT:
        return GROUP
    return max(frames.chunk, GROUP // frames.chunk * frames.chunk)


class _Job(NamedTuple):
    """A piece, and what its sums are."""

    target: Path
    piece: Piece
    dtype: np.dtype[Any]
    level: float | None
    mask: Path | None

    @property
    def name(self) -> str:
        """Name of the job."""
        return self.target.name


def _sum(job: _Job, workers: int | None) -> int:
    """Sum a piece and write the sums, their checksum first."""
    given = batches(frame for frames in job.piece.frames(workers) for frame in frames)
    first = next(given, None)
    if first is None:
        raise FileError(f"{job.piece.parts[0][0]}: has changed meanwhile: call again")
    mask = None if job.mask is None else np.load(job.mask)
    sums = RunningAverage(first, job.level, mask, workers)
    for batch in chain([first], given):
        sums.add(batch)
    if (first.dtype, sums.count) != (job.dtype, job.piece.length):
        raise FileError(f"{job.piece.parts[0][0]}: has changed meanwhile: call again")
    state = sums.state()
    with write_whole(job.target, force=True) as temporary, temporary.open("wb") as file:
        file.write(zlib.crc32(state.data).to_bytes(_CRC, "little"))
        file.write(state.data)
    return sums.count


def _read(target: Path) -> Array | None:
    """Sums that were written; None where there are none, or damaged ones."""
    try:
        with target.open("rb") as file:
            crc, state = file.read(_CRC), np.fromfile(file, np.uint8)
    except OSError:
        return None
    return state if crc == zlib.crc32(state.data).to_bytes(_CRC, "little") else None
