"""Corrections applied to frames in files, however many."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._types import Flagged, Progress
from equipix.errors import AlreadyCorrectedWarning, FileError, InputError, warn
from equipix.frames import average, refuse_subtracted
from equipix.io import (
    description,
    find_files,
    folder_beside,
    frame_format,
    refuse_inputs,
    refuse_saved,
    stream_frames,
    write_frames,
    write_whole,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import TypeGuard

    from numpy.typing import NDArray

    from equipix.correction.protocol import Correction, DarkCorrection


_MARK = "corrected by equipix"
"""Description of what `correct_files` writes, so that a second correction is detected."""


def correct_files(
    correction: Correction,
    source: list[str],
    output: Path,
    *,
    dark: str = "stored",
    flagged: Flagged = "nan",
    force: bool = False,
    progress: Progress | None = None,
) -> int:
    """Correct the frames of files, a few at a time.

    Parameters
    ----------
    correction : Correction
        What to apply.
    source : list of str
        Image files or globs.
    output : Path
        A name that ends in .tif: one file of all frames. Another: a folder to make, with a TIFF
        for each input file.
    dark : str
        "stored", "none", a file or glob of dark frames, or one of their saved statistics. Only a
        correction that subtracts a dark frame takes another than "stored".
    flagged : {"nan", "keep", "replace"}
        What becomes of flagged pixels.
    force : bool
        Whether an existing file may be replaced; of a folder, the files of the same names.
    progress : callable, optional
        Called as ``progress(frames done, frames in all, "correcting")``.

    Returns
    -------
    int
        Number of frames.

    Raises
    ------
    FileError
        If a file cannot be read or written, two outputs would have the same name, or one would
        replace an input.
    InputError
        If the frames have another shape than the correction, or it takes no other dark frame.

    Warns
    -----
    AlreadyCorrectedWarning
        If files were written by this function.
    """
    files = find_files(source)
    outputs = _outputs(output, files)
    refuse_inputs(outputs, files)
    counts = {file: _count(file, correction) for file in files}
    _warn_of_corrected(files)
    correct = _with_dark(correction, dark)
    total, done = sum(counts.values()), 0

    def corrected(inputs: list[Path]) -> Iterator[NDArray[Any]]:
        nonlocal done
        for _, frames in stream_frames(inputs):
            yield from correct(frames, flagged=flagged)
            done += len(frames)
            if progress is not None:
                progress(done, total, "correcting")

    frame_bytes = 4 * correction.shape[0] * correction.shape[1]
    if not is_folder(output):
        with write_whole(output, force=force) as temporary:
            write_frames(temporary, corrected(files), nbytes=total * frame_bytes, description=_MARK)
        return total
    with folder_beside(output) as folder:
        for file, path in zip(files, outputs, strict=True):
            nbytes = counts[file] * frame_bytes
            write_frames(folder / path.name, corrected([file]), nbytes=nbytes, description=_MARK)
        output.mkdir(exist_ok=True)
        for path in outputs:
            (folder / path.name).replace(path)
    return total


def is_folder(output: Path) -> bool:
    """Whether an output is a folder of files, by its name."""
    return output.suffix.lower() not in (".tif", ".tiff")


def _outputs(output: Path, files: list[Path]) -> list[Path]:
    """Name what will be written."""
    if not is_folder(output):
        return [output]
    names = [f"{file.stem}.tif" for file in files]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise FileError(f"{output}: two inputs would become '{repeated[0]}': correct them apart")
    return [output / name for name in names]


def _warn_of_corrected(files: list[Path]) -> None:
    """Warn of files that this module has written: cameras write no floating-point numbers."""
    floats = [file for file in files if frame_format(file)[1].kind == "f"]
    if corrected := [file for file in floats if description(file) == _MARK]:
        others = f" and {len(corrected) - 1} more" if len(corrected) > 1 else ""
        warn(
            f"{corrected[0]}{others}: corrected already; a second correction divides by the "
            "sensitivity twice: give the raw frames",
            AlreadyCorrectedWarning,
        )


def _count(file: Path, correction: Correction) -> int:
    """Count the frames of a file; they must be raw, and of the sensor's shape."""
    refuse_saved(file)
    (count, *shape), _ = frame_format(file)
    if tuple(shape) != correction.shape:
        raise InputError(
            f"{file}: holds frames of shape {tuple(shape)}, expected {correction.shape}"
        )
    return count


def _with_dark(correction: Correction, dark: str) -> Callable[..., NDArray[Any]]:
    """Give the method that corrects frames, with this dark frame in place of that stored."""
    if dark == "stored":
        return correction.correct
    if not _takes_dark(correction):
        raise InputError(
            f"'dark' is '{dark}', but the offsets of this correction are part of it and no dark "
            "frame can replace them: expected 'stored'"
        )
    return partial(correction.correct, dark=None if dark == "none" else _dark_frame(dark))


def _takes_dark(correction: Correction) -> TypeGuard[DarkCorrection]:
    return hasattr(correction, "dark")


def _dark_frame(source: str) -> NDArray[Any]:
    """Read the mean of dark frames, averaged already or not."""
    dark = average(source)
    refuse_subtracted(dark, source)
    return dark.mean.astype(np.float32)
