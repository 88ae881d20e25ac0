"""Long recordings corrected: Zarr arrays that workers write by whole chunks."""

import hashlib
import math
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from equipix._check import Array, Flagged, OutputType, Progress, positive_workers
from equipix.batch.memory import PROCESS
from equipix.batch.series import Frames, Piece, key_of, remove_work, series_at, work_beside
from equipix.correction.apply import Corrector, output_dtype, usual_treatment
from equipix.correction.correct_files import (
    MARK,
    TWICE,
    Corrected,
    as_fast,
    pixels_lost,
    warn_of_corrected,
    warn_of_limited,
    warn_of_not_finite,
)
from equipix.correction.file_darks import file_darks, warn_of_darker
from equipix.correction.protocol import Correction
from equipix.errors import FileError, InputError
from equipix.experiment.image_files import origin_of, sha256_of
from equipix.findings import usable
from equipix.io.arrays import ZARR, ZarrFrames
from equipix.io.formats import FrameFile, checked, raw_headers, with_checksum
from equipix.io.frames import stream_part
from equipix.io.paths import (
    as_path,
    check_suffix,
    find_files,
    refuse_inputs,
    replace_folder,
    write_whole,
    writing,
)
from equipix.saved_results import load_correction

_FRAMES = 256
"""Frames of a piece, about."""

_CORRECTION = 150
"""Bytes of a pixel of a correction, as it is read and prepared."""

_CHUNK = 2**24
"""Bytes of a chunk of the output, about; at least a frame is, and more where the input has more."""


def correct(
    correction: str | PathLike[str],
    frames: str | PathLike[str] | list[str],
    output: str | PathLike[str],
    *,
    scheduler: str | None = "local",
    dark: list[str] | None = None,
    flagged: Flagged | None = None,
    dtype: OutputType | None = None,
    bit_depth: int | None = None,
    sensor: str | None = None,
    substrate_c: float | None = None,
    bias_v: float | None = None,
    workers: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Corrected:
    """Correct the frames of a recording into a Zarr array, on the workers of a cluster.

    Parameters
    ----------
    correction : path
        The file of a correction.
    frames : path, glob, or list of these
        A Zarr or HDF5 array, or image files in their order. All workers must see them.
    output : path
        The array to make, shape (n, rows, cols): .zarr.
    scheduler : str, optional
        Address of a scheduler of dask.distributed, such as ``tcp://host:8786``, "local" for worker
        processes on this machine, or None for no other process than this one.
    dark : list of str, optional
        As of `equipix.correction.correct_files.correct_files`, but one for all frames.
    flagged, dtype, bit_depth, sensor : optional
        As there.
    substrate_c, bias_v : float, optional
        State of a correction that follows temperature and bias.
    workers : int, optional
        Number of worker processes on this machine, or of threads without a scheduler.
    force : bool
        Whether an array that is there may be replaced.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` repeatedly, in pieces.

    Returns
    -------
    Corrected
        What was written, and what was counted.

    Raises
    ------
    FileError
        If a file cannot be read or written, or `correction` holds what learns from a scene: its
        frames follow one another.
    InputError
        If an argument does not fit the correction or the frames.
    EquipixError
        If dask.distributed or zarr is not installed, or the scheduler cannot be reached.

    Notes
    -----
    Each worker writes whole chunks of frames, by any number of workers the same bytes. A piece of
    some 256 frames is kept once it is written: called again after a fault, the function goes on
    with those of the same inputs, options and version whose chunks have the same hash. They are in
    a folder beside the output, which is moved to its place when all are written. Memory does not
    grow with the number of frames.
    """
    target = as_path("output", output)
    positive_workers(workers)
    check_suffix(target, ZARR)
    files = find_files(frames)
    place = as_path("correction", correction)
    refuse_inputs(files, [], TWICE)
    refuse_inputs([target], [*files, place])
    if target.exists() and not force:
        raise FileError(f"{target}: exists already; force=True (--force) replaces it")
    state = {"substrate_c": substrate_c, "bias_v": bias_v}
    applied = load_correction(place, **state)
    headers = raw_headers(files, applied.shape)
    given = Frames([FrameFile(file) for file in files])
    wanted = output_dtype(dtype or "float32")
    how = flagged or usual_treatment(wanted)
    bad = int(np.count_nonzero(~usable(applied.flags)))
    origin = named(place, applied)
    said = warn_of_corrected(headers, origin)
    darks = file_darks(applied, dark, headers)
    if len(darks.names) > 1:
        raise InputError(
            f"'dark' (--dark) is given {len(darks.names)} times, but '{target}' takes one for all "
            "frames: correct the frames of each exposure time apart"
        )
    of_dark = darks.of(files[0])
    options: dict[str, Any] = {
        "dtype": wanted.name,
        "bit_depth": bit_depth,
        "flagged": how,
        "sensor": sensor,
    }
    # Here all that is wrong with the options is found before processes start.
    replaced = Corrector(applied, dark=of_dark, **options).replaced
    said += darks.findings
    subtracted = applied.dark if isinstance(of_dark, str) else of_dark
    if subtracted is not None:
        first = next(stream_part(files[0], 0, 1, workers=workers))[0]
        said += warn_of_darker(first, subtracted)
    chunk = given.chunk if given.chunk > 1 else max(1, _CHUNK // given.frame_bytes)
    pieces = given.pieces(max(chunk, _FRAMES // chunk * chunk))
    memory = [_memory(given, chunk, wanted)] * len(pieces)
    with series_at(scheduler, work_beside(target), memory, workers, progress) as series:
        hashes = sha256_of([place, *files], series.digests)
        named_dark = of_dark if isinstance(of_dark, str | None) else _hash(of_dark)
        key = key_of(hashes, **options, **state, chunk=chunk, dark=named_dark)
        place_of_dark = (
            of_dark
            if isinstance(of_dark, str | None)
            else series.kept_array(f"{key}.dark", of_dark)
        )
        array, at = ZarrFrames(series.work / f"{key}.zarr"), place.absolute()
        jobs = [
            _Job(array.path, piece, chunk, at, hashes[place], state, options, place_of_dark)
            for piece in pieces
        ]
        shape = given.count, *given.shape
        history = [f"dark: {darks.named(files[0])}", f"{bad} flagged pixels: {how}"]
        with writing(array.path):
            array.ensure(shape, wanted, chunk, description=f"{MARK}, {origin}", history=history)
        series.results(_kept_or_corrected, jobs, memory[0], "correcting")
        series.refuse_changed([job.mark for job in jobs])
        counts = _total(jobs)
        array.clean()
        # No later call looks for this name: the old recording may stand there when this one ends.
        done = series.work / f"{key}.done"
        shutil.rmtree(done, ignore_errors=True)
        array.path.rename(done)
        replace_folder(target, done)
    remove_work(target)
    lost = Counter({files[0]: counts["not_finite"]}) if counts["not_finite"] else Counter()
    said += warn_of_not_finite(lost, wanted)
    said += warn_of_limited(counts["limited"], given.count * applied.flags.size, wanted)
    outside = None if applied.limits is None else counts["extrapolated"]
    lost_pixels = pixels_lost(applied, how)
    return Corrected(
        wanted.name, given.count, counts["limited"], outside, replaced, lost_pixels, said
    )


def named(path: Path, correction: Correction) -> str:
    """Name a correction by the hash of its file, and its state."""
    state = ", ".join(f"{name} {x:g}" for name, x in correction.metadata.get("state", {}).items())
    return ", ".join(filter(None, (origin_of(path), state)))


def _memory(frames: Frames, chunk: int, dtype: np.dtype[Any]) -> int:
    """Bytes that a piece needs at the peak: a correction, frames read, a chunk before and after."""
    pixels = math.prod(frames.shape)
    chunks = 2 * chunk * pixels * (frames.dtype.itemsize + dtype.itemsize)
    return PROCESS + _CORRECTION * pixels + frames.reading + chunks


def _hash(array: Array) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


@dataclass(frozen=True)
class _Job:
    """A piece, and how it is corrected."""

    array: Path
    piece: Piece
    chunk: int
    correction: Path
    hash: str
    state: Mapping[str, float | None]
    options: Mapping[str, Any]
    dark: Path | str | None

    @property
    def name(self) -> str:
        """Name of the job."""
        return self.mark.name

    @property
    def mark(self) -> Path:
        """The file that says that the piece is written, and what was counted."""
        return self.array.with_suffix(f".{self.piece.start}.json")

    @property
    def sha256(self) -> str:
        """Hash of the chunks of the piece."""
        first = self.piece.start
        return ZarrFrames(self.array).sha256(first, first + self.piece.length)

    def record(self) -> dict[str, Any]:
        """What the mark says: the hash of the chunks, and what was counted; nothing without one."""
        try:
            return checked(self.mark.read_text()) or {}
        except (OSError, ValueError):
            return {}

    def is_kept(self) -> bool:
        """Whether the piece is as it was written."""
        record = self.record()
        try:
            return bool(record) and record["sha256"] == self.sha256
        except OSError:
            return False


def _total(jobs: list[_Job]) -> Counter[str]:
    """What was counted in all."""
    total: Counter[str] = Counter()
    for job in jobs:
        record = job.record()
        if not record:
            raise FileError(f"{job.mark}: is missing or damaged: call again")
        total.update(record["counts"])
    return total


@lru_cache(maxsize=1)
def _loaded(path: Path, _hash: str, substrate_c: float | None, bias_v: float | None) -> Correction:
    """Read a correction once in each process, unless the file changes."""
    return load_correction(path, substrate_c=substrate_c, bias_v=bias_v)


def _kept_or_corrected(job: _Job, workers: int | None) -> int:
    """Correct a piece, unless it is as it was written before."""
    return job.piece.length if job.is_kept() else _corrected(job, workers)


def _corrected(job: _Job, workers: int | None) -> int:
    """Correct a piece, write its chunks, and then its mark."""
    correction = _loaded(job.correction, job.hash, **job.state)
    dark = np.load(job.dark) if isinstance(job.dark, Path) else job.dark
    corrector = Corrector(correction, dark=dark, workers=workers, **job.options)
    good, array = usable(correction.flags), ZarrFrames(job.array)
    at, not_finite = job.piece.start, 0
    with writing(job.mark):
        for frames in _chunks(job.piece.frames(workers), job.chunk):
            not_finite += int(np.count_nonzero(~np.isfinite(frames) & good))
            array.write(at, corrector.apply(as_fast(frames)))
            at += len(frames)
        if corrector.frames != job.piece.length:
            raise FileError(f"{job.piece.parts[0][0]}: has changed meanwhile: call again")
        counts = {
            "limited": corrector.clipped,
            "extrapolated": corrector.extrapolated or 0,
            "not_finite": not_finite,
        }
        with write_whole(job.mark, force=True) as temporary:
            temporary.write_text(with_checksum({"sha256": job.sha256, "counts": counts}))
    return corrector.frames


def _chunks(parts: Iterator[Array], size: int) -> Iterator[Array]:
    """Give frames so many at a time, whatever number they are read at."""
    kept: list[Array] = []
    for part in parts:
        while len(part):
            room = size - sum(map(len, kept))
            kept.append(part[:room])
            part = part[room:]
            if sum(map(len, kept)) == size:
                yield np.concatenate(kept)
                kept = []
    if kept:
        yield np.concatenate(kept)
