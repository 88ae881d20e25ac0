"""Long series of frames in pieces, on the workers of a cluster or one after the other."""

import hashlib
import json
import math
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from equipix._check import Array, Progress
from equipix._native import __version__
from equipix.batch.cluster import LOCAL, Task, finished, scheduler_at
from equipix.batch.memory import PROCESS, reading
from equipix.errors import EquipixError, FileError
from equipix.experiment.image_files import State, digest, refuse_changed, state_of
from equipix.io.arrays import chunk_frames
from equipix.io.formats import FrameFile
from equipix.io.frames import stream_part
from equipix.io.paths import write_whole

_HASHED_AT_ONCE = 2**28
"""Bytes of files that one worker hashes at a time; at least a file is."""

_OURS = re.compile(r"\.?[0-9a-f]{32}")
"""Beginning of the names of pieces, and of files that are being written."""

_Result = TypeVar("_Result")


class Piece(NamedTuple):
    """Frames in their order that one worker takes at a time.

    Attributes
    ----------
    start : int
        Number of the first frame in the whole series.
    parts : tuple of (Path, int, int)
        Files, each with the numbers of its first frame and of the one behind its last.
    """

    start: int
    parts: tuple[tuple[Path, int, int], ...]

    def frames(self, workers: int | None) -> Iterator[Array]:
        """Give the frames a few at a time, each part of shape (n, rows, cols)."""
        for path, start, stop in self.parts:
            yield from stream_part(path, start, stop, workers=workers)

    @property
    def length(self) -> int:
        """Number of frames."""
        return sum(stop - start for _, start, stop in self.parts)


class Frames:
    """Frames of files, all of one shape and dtype.

    Raises
    ------
    FileError
        If a file differs from the first.
    """

    def __init__(self, files: Sequence[FrameFile]) -> None:
        self.files = files
        first, *others = files
        for other in others:
            wanted, got = (_format(each) for each in (first, other))
            if got != wanted:
                raise FileError(f"{other.path}: is {got}, expected {wanted} as in {first.path}")
        self.shape: tuple[int, int] = first.header.shape[1:]
        self.dtype = np.dtype(first.header.dtype).newbyteorder("=")
        self.count = sum(each.header.shape[0] for each in files)

    @cached_property
    def chunk(self) -> int:
        """Frames of a chunk of the only file, where so many are read at once; else 1."""
        return chunk_frames(self.files[0].path) if len(self.files) == 1 else 1

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def reading(self) -> int:
        """Bytes that a process needs at most to read: frames at once, and a copy of them."""
        return reading(self.frame_bytes, self.chunk)

    def pieces(self, size: int) -> list[Piece]:
        """Give all frames in their order, in pieces of so many frames."""
        parts: list[list[tuple[Path, int, int]]] = [[] for _ in range(0, self.count, size)]
        at = 0
        for file in self.files:
            end = at + file.header.shape[0]
            for number in range(at // size, -(-end // size)):
                first, last = max(at, number * size), min(end, (number + 1) * size)
                parts[number].append((file.path.absolute(), first - at, last - at))
            at = end
        return [Piece(number * size, tuple(each)) for number, each in enumerate(parts)]


def _format(file: FrameFile) -> str:
    (_, rows, cols), dtype, *_ = file.header
    return f"{rows} x {cols} (rows x columns), {np.dtype(dtype).newbyteorder('=')}"


class Series:
    """Where the pieces of a series are worked on, and the folder of what is finished.

    What jobs name is absolute: workers may run in another folder.

    Parameters
    ----------
    work : Path
        Folder of what workers have finished. All workers must see it.
    address : str or None
        Address of the scheduler; None for this process.
    workers : int or None
        Threads of this process.
    progress : callable or None
        Called as ``progress(done, total, stage)`` repeatedly.
    """

    def __init__(
        self,
        work: Path,
        address: str | None,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.work, self._address = work.absolute(), address
        self._workers, self._progress = workers, progress
        self._states: dict[Path, State | None] = {}

    def results(
        self,
        work: Callable[[Any, int | None], _Result],
        jobs: Sequence[Any],
        memory: int,
        stage: str,
    ) -> dict[str, _Result]:
        """Results of jobs by their names.

        Raises
        ------
        EquipixError
            With the first reason why a job has none. On a cluster the others are worked on before.
        """
        found: dict[str, _Result] = {}
        reasons = []
        for name, result in self._finished(work, jobs, memory):
            if isinstance(result, _Failed):
                reasons.append(result)
            elif isinstance(result, str):
                reasons.append(_Failed(EquipixError(result)))
            else:
                found[name] = result
            if self._progress is not None:
                self._progress(len(found) + len(reasons), len(jobs), stage)
        if reasons:
            raise reasons[0].error
        return found

    def _finished(
        self, work: Callable[[Any, int | None], _Result], jobs: Sequence[Any], memory: int
    ) -> Iterator[tuple[str, Any]]:
        if self._address is None:
            for job in jobs:
                yield job.name, work(job, self._workers)
            return
        tasks, caught = [Task(job, memory) for job in jobs], partial(_caught, work)
        for task, result in finished(caught, tasks, self._address, None):
            yield task.job.name, result

    def kept_array(self, name: str, array: Array) -> Path:
        """Write an array that all pieces need; its name says what it is."""
        path = self.work / f"{name}.npy"
        with write_whole(path, force=True) as temporary, temporary.open("wb") as file:
            np.save(file, array)
        return path

    def refuse_changed(self, made: Iterable[Path]) -> None:
        """Refuse files that have changed since they were hashed; remove what was made of them.

        Raises
        ------
        FileError
            With the first that has changed.
        """
        try:
            refuse_changed(self._states)
        except FileError:
            for each in made:
                each.unlink(missing_ok=True)
            raise

    def digests(self, files: list[Path]) -> dict[Path, bytes]:
        """SHA-256 of the bytes of each file."""
        self._states.update({file: state_of(file) for file in files})
        jobs, size = [_Hashed("hash 0", [])], 0
        for file in files:
            with suppress(OSError):  # the worker says what is wrong with it
                size += file.stat().st_size
            if size > _HASHED_AT_ONCE and jobs[-1].files:
                jobs.append(_Hashed(f"hash {len(jobs)}", []))
                size = 0
            jobs[-1].files.append(file.absolute())
        found = self.results(_digests, jobs, PROCESS, "hashing")
        digests = {file: each for name in found for file, each in found[name].items()}
        return {file: digests[file.absolute()] for file in files}


class _Hashed(NamedTuple):
    name: str
    files: list[Path]


def _digests(job: _Hashed, _: int | None) -> dict[Path, bytes]:
    return {file: digest(file) for file in job.files}


class _Failed(NamedTuple):
    """Why a job has no result."""

    error: EquipixError


def _caught(work: Callable[[Any, int | None], Any], job: Any, workers: int | None) -> Any:
    """Do work whose error of ours is a result: the cluster does not try it again."""
    try:
        return work(job, workers)
    except EquipixError as error:
        return _Failed(error)


@contextmanager
def series_at(
    scheduler: str | None,
    work: Path,
    memory: Sequence[int],
    workers: int | None = None,
    progress: Progress | None = None,
) -> Iterator[Series]:
    """Make the folder of finished pieces, and start processes that work on pieces.

    Parameters
    ----------
    scheduler : str or None
        Address of a scheduler, "local" for worker processes on this machine, None for none.
    work : Path
        The folder.
    memory : sequence of int
        Bytes that each piece needs.
    workers : int, optional
        Number of worker processes on this machine, or of threads where there are none.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` repeatedly.

    Yields
    ------
    Series
        To be used until the processes end.
    """
    is_new = not work.exists()
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"'{work}' cannot be the folder of pieces: {error.strerror}") from error
    try:
        if scheduler is None:
            yield Series(work, None, workers, progress)
            return
        address = None if scheduler == LOCAL else scheduler
        with scheduler_at(address, memory, workers) as found:
            yield Series(work, found, None, progress)
    finally:
        if is_new:
            with suppress(OSError):  # where there are pieces it is not empty
                work.rmdir()


def key_of(hashes: Mapping[Path, str], **known: object) -> str:
    """Hash of inputs in their order, options and version; the place of files is not part of it."""
    everything = {"version": __version__, "inputs": [*hashes.values()], **known}
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def work_beside(output: Path) -> Path:
    """Folder of the pieces of an output, on its disk."""
    place = output.resolve()
    return place.with_name(f"{place.name}.parts")


def remove_work(output: Path) -> None:
    """Remove the pieces, once the output is written, and their folder if it has nothing else."""
    work = work_beside(output)
    for each in work.glob("*"):
        if _OURS.match(each.name):
            shutil.rmtree(each) if each.is_dir() else each.unlink(missing_ok=True)
    with suppress(OSError):
        work.rmdir()
