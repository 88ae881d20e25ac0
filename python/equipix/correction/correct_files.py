"""Frames in files corrected, and pictures of them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from equipix._check import LOG, Array, Display, Flagged, OutputType, Progress
from equipix.correction.apply import FAST, Corrector, output_dtype, usual_treatment
from equipix.correction.protocol import Correction, Dark, refuse_dark
from equipix.errors import FileError, InputError
from equipix.findings import Finding, Findings, say, usable
from equipix.io.formats import raw_headers
from equipix.io.frames import Header, stream_frames
from equipix.io.paths import find_files, folder_beside, refuse_inputs, write_whole
from equipix.io.png import write_png
from equipix.io.tiff import write_frames
from equipix.measured.average import average
from equipix.measured.statistics import DARKER, FrameStatistics, refuse_subtracted

_MARK = "corrected by equipix"
"""Beginning of the description of what `correct_files` writes, so that a second correction is
detected."""


class Corrected(NamedTuple):
    """What was written.

    Attributes
    ----------
    dtype : str
        Type of the values.
    frames : int
        Number of frames.
    limited : int
        Values that had to be limited to the range of whole numbers, or were not a number.
    extrapolated : int or None
        Values corrected to outside of the levels of their pixel's response; None where the
        correction has none.
    replaced : int
        Pixels that were replaced in each frame.
    flagged : int
        Pixels flagged ``DO_NOT_USE`` that became NaN in each frame; black in pictures.
    findings : tuple of Finding
        What limits the frames, each also a warning.
    """

    dtype: str
    frames: int
    limited: int
    extrapolated: int | None
    replaced: int
    flagged: int
    findings: Findings


def correct_files(
    correction: Correction,
    source: list[str],
    output: Path,
    *,
    dark: str = "stored",
    flagged: Flagged | None = None,
    dtype: OutputType | None = None,
    bit_depth: int | None = None,
    display: Display | None = None,
    sensor: str | None = None,
    workers: int | None = None,
    origin: str = "",
    force: bool = False,
    progress: Progress | None = None,
) -> Corrected:
    """Correct the frames of files, a few at a time, with one `Corrector`.

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
    flagged : {"nan", "keep", "replace"}, optional
        What becomes of flagged pixels. Unless given, they become NaN in floating-point numbers, and
        are replaced in whole numbers and pictures.
    dtype : {"float32", "uint16", "uint8"}, optional
        Type of the output; float32 unless given, and uint16 for a .png.
    bit_depth : int, optional
        Significant bits of whole numbers, 8 to 16; by default all of the type.
    display : {"linear", "histogram"}, optional
        Make pictures of 8 bits by a tone law, see `equipix.correction.correct_files.picture`.
    sensor : str, optional
        Name of the sensor that gave the frames, to be compared with that of the correction.
    workers : int, optional
        Number of threads, as for `Corrector`.
    origin : str
        ASCII text that names the correction, such as its hash: it is stored in each file.
    force : bool
        Whether an existing file may be replaced; of a folder, the files of the same names.
    progress : callable, optional
        Called as ``progress(frames done, frames in all, "correcting")``.

    Returns
    -------
    Corrected
        What was written, and what was counted. For pictures nothing is limited.

    Raises
    ------
    FileError
        If a file cannot be read or written, an input is named twice, two outputs would have the
        same name, or one would replace an input.
    InputError
        If the frames have another shape than the correction, it takes no other dark frame, or more
        than one frame would go to a .png, or floating-point numbers.

    Warns
    -----
    InputWarning
        If files were written by this function.
    InputWarning
        If the first frame is darker than the dark by more than a quarter of the dark.
    InputWarning
        If most values had to be limited to the range of whole numbers.
    """
    wanted = _dtype(output, dtype, bit_depth, display)
    files = find_files(source)
    refuse_inputs(files, [], "is named twice: name each input once")
    outputs = _outputs(output, files)
    refuse_inputs(outputs, files)
    headers = raw_headers(files, correction.shape)
    total, done = sum(header.shape[0] for header in headers.values()), 0
    _refuse_pictures(output, total, wanted)
    said = warn_of_corrected(headers, origin)
    flagged = usual_treatment(wanted) if flagged is None else flagged
    of_dark = _dark(correction, dark)
    LOG.info("corrects %d frames to %s, dark: %s, flagged pixels: %s", total, wanted, dark, flagged)
    corrector = Corrector(
        correction,
        "float32" if display else wanted,
        bit_depth=bit_depth,
        flagged=flagged,
        dark=of_dark,
        sensor=sensor,
        workers=workers,
    )

    def corrected(inputs: list[Path]) -> Iterator[NDArray[Any]]:
        nonlocal done, said
        for _, frames in stream_frames(inputs):
            if done == 0:
                said += _warn_of_dark(frames[0], correction, of_dark)
            native = frames.dtype.newbyteorder("=")
            taken = frames.astype(native if native in FAST else np.float32, copy=False)
            for frame in corrector.apply(taken):
                yield picture(frame, display) if display else frame
            done += len(frames)
            if progress is not None:
                progress(done, total, "correcting")

    frame_bytes = wanted.itemsize * correction.shape[0] * correction.shape[1]
    mark = f"{_MARK}{origin and f', {origin}'}"
    if not is_folder(output):
        with write_whole(output, force=force) as temporary:
            _write(temporary, corrected(files), nbytes=total * frame_bytes, mark=mark)
    else:
        with folder_beside(output) as folder:
            for file, path in zip(files, outputs, strict=True):
                nbytes = headers[file].shape[0] * frame_bytes
                _write(folder / path.name, corrected([file]), nbytes=nbytes, mark=mark)
            output.mkdir(exist_ok=True)
            for path in outputs:
                (folder / path.name).replace(path)
    bad = int(np.count_nonzero(~usable(correction.flags))) if flagged == "nan" else 0
    said += _warn_of_limited(corrector.clipped, total * correction.flags.size, wanted)
    counts = corrector.clipped, corrector.extrapolated, corrector.replaced, bad
    return Corrected(wanted.name, total, *counts, said)


def _dtype(
    output: Path, dtype: OutputType | None, bit_depth: int | None, display: Display | None
) -> np.dtype[Any]:
    """Type of the output, by its name unless it is given."""
    if display is None:
        return output_dtype(dtype or ("uint16" if is_picture(output) else "float32"))
    if dtype not in (None, "uint8"):
        raise InputError(
            f"'display' makes pictures of 8 bits, but 'dtype' (--dtype) is '{dtype}': leave out one"
        )
    if bit_depth is not None:
        raise InputError(
            "'display' makes pictures of 8 bits, but 'bit_depth' (--bit-depth) is "
            f"{bit_depth}: leave out one"
        )
    return np.dtype(np.uint8)


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


def _refuse_pictures(output: Path, total: int, dtype: np.dtype[Any]) -> None:
    """Refuse several frames, or floating-point numbers, in a PNG."""
    if not is_picture(output):
        return
    if total != 1:
        raise InputError(
            f"'{output}' holds one frame, but {total} are to be corrected: name a .tif of all, or "
            "a folder"
        )
    if dtype.kind != "u":
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


def is_corrected(description: str) -> bool:
    """Whether the text of a file says that this module has written it."""
    return description.startswith(_MARK)


def warn_of_corrected(headers: Mapping[Path, Header], origin: str) -> Findings:
    """Warn of files whose text this module has written; `origin` as for `correct_files`."""
    corrected = [file for file, each in headers.items() if is_corrected(each.description)]
    if not corrected:
        return ()
    others = f" and {len(corrected) - 1} more" if len(corrected) > 1 else ""
    same = bool(origin) and headers[corrected[0]].description.endswith(origin)
    by = "by this correction" if same else "by another correction"
    words = (
        f"{corrected[0]}{others}: corrected already, {by}; what both remove is removed twice: give "
        "the raw frames"
    )
    return say(Finding("corrected", words, "input"))


def _warn_of_dark(frame: NDArray[Any], correction: Correction, dark: Dark) -> Findings:
    """Warn of a frame from which the dark was probably subtracted before."""
    given = correction.dark if isinstance(dark, str) else dark
    if given is None:
        return ()
    offset = np.asarray(given.mean if isinstance(given, FrameStatistics) else given)
    level, below = np.nanmedian(offset), np.nanmedian(offset - frame)
    if level > 0 and below > DARKER * level:
        words = (
            f"the first frame is darker than the dark by {below:.4g} of {level:.4g} DN in the "
            "median: give raw frames, or 'dark' (--dark) none if the dark was subtracted from them"
        )
        return say(Finding("bright_dark", words, "input"))
    return ()


def _warn_of_limited(limited: int, values: int, dtype: np.dtype[Any]) -> Findings:
    """Warn where most values are outside of the range of the output."""
    if limited <= values / 2:
        return ()
    remedy = "float32, or more bits in 'bit_depth' (--bit-depth)"
    if dtype == np.uint8:
        remedy = "uint16; or 'display' (--display linear), which scales frames to 8 bits"
    words = (
        f"{limited / values:.0%} of the corrected values were limited to the range of {dtype}: "
        f"choose 'dtype' (--dtype) {remedy}"
    )
    return say(Finding("limited", words, "input"))


def _dark(correction: Correction, dark: str) -> Dark:
    """Give the dark frame that an option names, for the argument of `Corrector`."""
    if dark == "stored":
        return "stored"
    refuse_dark(correction, dark)
    if dark == "none":
        return None
    statistics = average(dark)
    refuse_subtracted(statistics, dark)
    return statistics


PERCENTILES = (0.5, 99.5)
"""Percentiles of a frame that a linear picture shows as black and white."""

_BINS = 4096
"""Bins of the histogram between the smallest and the largest value."""

_PLATEAU = 4.0
"""Most pixels that count of a bin, over the mean of the bins that are not empty."""


def picture(frame: Array, display: Display) -> Array:
    """Make a picture of 8 bits of a frame.

    Parameters
    ----------
    frame : ndarray, shape (rows, cols)
        Corrected values; what is not finite becomes black.
    display : {"linear", "histogram"}
        The tone law.

    Returns
    -------
    ndarray, shape (rows, cols), uint8
        The picture, scaled for each frame by itself.

    Notes
    -----
    *linear*: black and white are the percentiles 0.5 and 99.5. *histogram*: equalisation of a
    histogram of 4096 bins between the smallest and the largest value, in which a bin counts at most
    4 times the mean of the bins that are not empty. That plateau keeps large even areas from taking
    all grey levels [1]_. An even frame becomes grey.

    References
    ----------
    .. [1] V. E. Vickers, "Plateau equalization algorithm for real-time display of high-quality
       infrared imagery", Optical Engineering 35 (1996) 1921-1926.
    """
    known = np.isfinite(frame)
    values = frame[known].astype(np.float64)
    grey = np.zeros(frame.shape, np.uint8)
    if values.size:
        tones = (_linear if display == "linear" else _equalised)(values)
        grey[known] = np.rint(255 * tones).astype(np.uint8)
    return grey


def _linear(values: Array) -> Array:
    """Tones from 0 to 1 between two percentiles."""
    low, high = np.percentile(values, PERCENTILES)
    if high <= low:
        return np.full(values.shape, 0.5)
    return np.asarray(np.clip((values - low) / (high - low), 0, 1))


def _equalised(values: Array) -> Array:
    """Tones from 0 to 1 by a histogram with a plateau."""
    low, high = values.min(), values.max()
    if high <= low:
        return np.full(values.shape, 0.5)
    bins = np.minimum(((values - low) / (high - low) * _BINS).astype(np.int64), _BINS - 1)
    counts: Any = np.bincount(bins, minlength=_BINS).astype(np.float64)
    counts = np.minimum(counts, _PLATEAU * counts[counts > 0].mean())
    below = np.cumsum(counts) - counts[0]
    return np.asarray((below / below[-1])[bins])
