"""Corrections applied to frames in files, however many."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix._types import Flagged, Progress
from equipix.correction.whole import Conversion
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
    write_png,
    write_whole,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import TypeGuard

    from numpy.typing import NDArray

    from equipix.correction.protocol import Correction, DarkCorrection


_MARK = "corrected by equipix"
"""Beginning of the description of what `correct_files` writes, so that a second correction is
detected."""


class Done(NamedTuple):
    """What was written."""

    frames: int
    clipped: int


def correct_files(
    correction: Correction,
    source: list[str],
    output: Path,
    *,
    dark: str = "stored",
    flagged: Flagged = "nan",
    conversion: Conversion | None = None,
    origin: str = "",
    force: bool = False,
    progress: Progress | None = None,
) -> Done:
    """Correct the frames of files, a few at a time.

    Parameters
    ----------
    correction : Correction
        What to apply.
    source : list of str
        Image files or globs.
    output : Path
        A name that ends in .tif: one file of all frames; in .png: the only frame, as whole numbers.
        Another: a folder to make, with a TIFF for each input file.
    dark : str
        "stored", "none", a file or glob of dark frames, or one of their saved statistics. Only a
        correction that subtracts a dark frame takes another than "stored".
    flagged : {"nan", "keep", "replace"}
        What becomes of flagged pixels; NaN is 0 in whole numbers.
    conversion : Conversion, optional
        Type of the output; float32 unless given.
    origin : str
        ASCII text that names the correction, such as its hash: it is stored in each file.
    force : bool
        Whether an existing file may be replaced; of a folder, the files of the same names.
    progress : callable, optional
        Called as ``progress(frames done, frames in all, "correcting")``.

    Returns
    -------
    Done
        Number of frames, and of values that had to be limited to the range of whole numbers.

    Raises
    ------
    FileError
        If a file cannot be read or written, two outputs would have the same name, or one would
        replace an input.
    InputError
        If the frames have another shape than the correction, it takes no other dark frame, or more
        than one frame would go to a .png, or floating-point numbers.

    Warns
    -----
    AlreadyCorrectedWarning
        If files were written by this function.
    """
    conversion = conversion or Conversion(display=None)
    files = find_files(source)
    outputs = _outputs(output, files)
    refuse_inputs(outputs, files)
    counts = {file: _count(file, correction) for file in files}
    _refuse_pictures(output, sum(counts.values()), conversion)
    _warn_of_corrected(files)
    correct = _with_dark(correction, dark)
    total, done = sum(counts.values()), 0

    def corrected(inputs: list[Path]) -> Iterator[NDArray[Any]]:
        nonlocal done
        for _, frames in stream_frames(inputs):
            yield from map(conversion.of, correct(frames, flagged=flagged))
            done += len(frames)
            if progress is not None:
                progress(done, total, "correcting")

    frame_bytes = conversion.dtype.itemsize * correction.shape[0] * correction.shape[1]
    mark = f"{_MARK}{origin and f', {origin}'}"
    if not is_folder(output):
        with write_whole(output, force=force) as temporary:
            _write(temporary, corrected(files), nbytes=total * frame_bytes, mark=mark)
        return Done(total, conversion.clipped)
    with folder_beside(output) as folder:
        for file, path in zip(files, outputs, strict=True):
            nbytes = counts[file] * frame_bytes
            _write(folder / path.name, corrected([file]), nbytes=nbytes, mark=mark)
        output.mkdir(exist_ok=True)
        for path in outputs:
            (folder / path.name).replace(path)
    return Done(total, conversion.clipped)


def _write(path: Path, frames: Iterator[NDArray[Any]], *, nbytes: int, mark: str) -> None:
    """Write frames to a TIFF, or the only one to a PNG."""
    if is_picture(path):
        for frame in frames:
            write_png(path, frame, description=mark)
    else:
        write_frames(path, frames, nbytes=nbytes, description=mark)


def is_picture(output: Path) -> bool:
    """Whether an output is a PNG, by its name."""
    return output.suffix.lower() == ".png"


def _refuse_pictures(output: Path, total: int, conversion: Conversion) -> None:
    """Refuse several frames, or floating-point numbers, in a PNG."""
    if not is_picture(output):
        return
    if total != 1:
        raise InputError(
            f"'{output}' holds one frame, but {total} are to be corrected: name a .tif of all, or "
            "a folder"
        )
    if conversion.dtype.kind != "u":
        raise InputError(f"'{output}' holds whole numbers: expected 'dtype' uint8 or uint16")


def is_folder(output: Path) -> bool:
    """Whether an output is a folder of files, by its name."""
    return output.suffix.lower() not in (".tif", ".tiff", ".png")


def _outputs(output: Path, files: list[Path]) -> list[Path]:
    """Name what will be written."""
    if not is_folder(output):
        return [output]
    names = [f"{file.stem}.tif" for file in files]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise FileError(f"{output}: two inputs would become '{repeated[0]}': correct them apart")
    return [output / name for name in names]


def _warn_of_corrected(files: list[Path]) -> None:
    """Warn of files that this module has written."""
    tiffs = [file for file in files if file.suffix.lower() in (".tif", ".tiff")]
    if corrected := [file for file in tiffs if description(file).startswith(_MARK)]:
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
