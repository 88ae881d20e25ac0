"""A recorded sequence in files, through a correction from the scene."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from equipix._check import LOG, Array, Progress, check_progress
from equipix.correction.correct_files import warn_of_corrected
from equipix.errors import FileError, InputError
from equipix.findings import Findings
from equipix.io.formats import raw_headers
from equipix.io.frames import stream_frames
from equipix.io.paths import find_files, refuse_inputs, write_whole
from equipix.io.tiff import write_frames
from equipix.metrics.maps import roughness
from equipix.scene.scene_correction import SceneCorrection
from equipix.shown import Brief

_POINTS = 50
"""Most frames of which the quality is found."""

_MARK = "corrected by equipix from the scene"
"""Description of corrected frames; its beginning is that of all corrected frames."""


@dataclass(frozen=True)
class SequenceResult(Brief):
    """What a sequence went through.

    Attributes
    ----------
    frames : int
        Number of frames.
    points : tuple of int
        Frames, from 1, of which the quality was found.
    raw, corrected : tuple of float
        Roughness of these frames before and after correction, see `metrics.roughness`.
    last : ndarray, shape (rows, cols)
        The last frame with finite values, raw.
    findings : tuple of Finding
        What limits the frames, each also a warning.
    """

    frames: int
    points: tuple[int, ...]
    raw: tuple[float, ...]
    corrected: tuple[float, ...]
    last: Array
    findings: Findings


def run_sequence(
    method: SceneCorrection,
    source: list[str],
    *,
    output: Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> SequenceResult:
    """Take the frames of files in order, holding a few at a time.

    Parameters
    ----------
    method : SceneCorrection
        The correction, which learns from the frames.
    source : list of str
        Image files or globs of raw frames.
    output : path, optional
        A .tif of all corrected frames, float32, each corrected by what was learned before it.
    force : bool
        Whether an existing output may be replaced.
    progress : callable, optional
        Called as ``progress(frames done, frames in all, "learning")``.

    Returns
    -------
    SequenceResult
        Number of frames, and quality over time.

    Raises
    ------
    FileError
        If a file cannot be read, or the output cannot be written.
    InputError
        If frames have another shape, one is refused, or none counted; then no output is left.
    """
    check_progress(progress)
    files = find_files(source)
    headers = raw_headers(files, method.shape)
    said = warn_of_corrected(headers, "")
    record = _Record(sum(header.shape[0] for header in headers.values()))
    LOG.info("learns from %d frames in %d files", record.total, len(files))
    frames = _corrected(method, files, record, progress)
    if output is None:
        for _ in frames:
            pass
    else:
        refuse_inputs([output], files)
        rows, cols = method.shape
        with write_whole(output, force=force) as temporary:
            nbytes = 4 * record.total * rows * cols
            write_frames(temporary, frames, nbytes=nbytes, description=_MARK)
            method.check_learned()
    return record.sequence(said)


class _Record:
    """The quality of some frames, and the last frame."""

    def __init__(self, total: int) -> None:
        self.total, self.done = total, 0
        self._every = max(1, -(-total // _POINTS))
        self._points: list[tuple[int, float, float]] = []
        self._last: tuple[int, Array, Array] | None = None

    def add(self, raw: Array, corrected: Array) -> None:
        """Take a frame before and after correction."""
        self.done += 1
        finite = bool(np.isfinite(corrected).all()) and np.ptp(raw) > 0
        if finite:
            self._last = (self.done, raw, corrected)
        if finite and (self.done % self._every == 0 or self.done == 1):
            self._points.append((self.done, roughness(raw), roughness(corrected)))

    def sequence(self, said: Findings) -> SequenceResult:
        """What was recorded, and what limits the frames."""
        if self._last is None:
            raise FileError("no frame holds finite values that differ: nothing to learn from")
        number, last, after = self._last
        if not self._points or self._points[-1][0] != number:
            self._points.append((number, roughness(last), roughness(after)))
        points, raw, corrected = zip(*self._points, strict=True)
        return SequenceResult(self.done, points, raw, corrected, last.copy(), said)


def _corrected(
    method: SceneCorrection, files: list[Path], record: _Record, progress: Progress | None
) -> Iterator[Array]:
    """Corrected frames, one after the other."""
    for path, frames in stream_frames(files):
        for raw in frames:
            try:
                corrected = method.update(raw)
            except InputError as error:
                raise InputError(
                    f"{path}: frame {record.done + 1} of the sequence: {error}"
                ) from error
            record.add(raw, corrected)
            if progress is not None:
                progress(record.done, record.total, "learning")
            yield corrected
