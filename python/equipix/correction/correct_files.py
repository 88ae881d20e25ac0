"""Frames in files corrected, and pictures of them."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from equipix._check import LOG, Array, Bools, Display, Flagged, OutputType, Progress
from equipix.correction.apply import FAST, Corrector, output_dtype, usual_treatment
from equipix.correction.file_darks import (
    FileDarks,
    file_darks,
    is_as_dark,
    warn_of_as_dark,
    warn_of_darker,
)
from equipix.correction.protocol import Correction
from equipix.errors import FileError, InputError
from equipix.findings import Finding, Findings, say, usable
from equipix.io import fits
from equipix.io.formats import raw_headers
from equipix.io.frames import Header, stream_frames, suffix_of
from equipix.io.paths import find_files, folder_beside, refuse_inputs, write_whole
from equipix.io.png import write_png
from equipix.io.tiff import write_frames

MARK = "corrected by equipix"
"""Beginning of the description of what `correct_files` writes, so that a second correction is
detected."""

TWICE = "is named twice: name each input once"
"""What is wrong with a file that is named twice."""


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
        Pixels flagged ``DO_NOT_USE`` that became NaN in each frame: all, or of those that are kept
        the ones without coefficients. They are 0 in whole numbers, and black in pictures.
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
    dark: list[str] | None = None,
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
        A name that ends in .tif or .fits: one file of all frames; in .png: the only frame, as whole
        numbers. Another: a folder to make, with a FITS file for each FITS file, pictures apart, and
        a TIFF for each other. FITS files keep the headers of FITS files, and are no pictures.
    dark : list of str, optional
        "stored", which it is unless given, "none", or for each exposure time a file or glob of dark
        frames, or of their saved statistics. Of several each file takes the one that fits by its
        header, or one interpolated between two exposure times. Only a correction that subtracts a
        dark frame takes another than "stored".
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
        same name, or one would replace an input; if a dark is of several exposure times or holds
        light by its header, or none of several darks fits a file.
    InputError
        If the frames have another shape than the correction, it takes no other dark frame, or more
        than one frame would go to a .png, or floating-point numbers, or pictures to a .fits.

    Warns
    -----
    InputWarning
        If files were written by this function.
    InputWarning
        If the first frame is darker than the dark by more than a quarter of the dark.
    InputWarning
        If frames are of another exposure time or temperature than their dark, or dark frames.
    InputWarning
        If frames hold values that are not finite, in pixels that are not flagged.
    InputWarning
        If most values had to be limited to the range of whole numbers.
    """
    wanted = _dtype(output, dtype, bit_depth, display)
    files = find_files(source)
    outputs = _outputs(output, files, display)
    headers = raw_headers(files, correction.shape)
    total = sum(header.shape[0] for header in headers.values())
    _refuse_pictures(output, total, wanted)
    said = warn_of_corrected(headers, origin)
    darks = file_darks(correction, dark, headers)
    flagged = usual_treatment(wanted) if flagged is None else flagged
    LOG.info("corrects %d frames to %s, flagged pixels: %s", total, wanted, flagged)
    options: dict[str, Any] = {"bit_depth": bit_depth, "flagged": flagged, "sensor": sensor}
    kind = "float32" if display else wanted
    prepared = partial(Corrector, correction, kind, workers=workers, **options)
    good = usable(correction.flags)
    work = _Correcting(correction.dark, good, darks, prepared, files[0])
    frames = partial(_frames, work, display, total, progress)
    bad = int(np.count_nonzero(~good))
    beside = _Beside.of(headers, darks, origin, f"{bad} flagged pixels: {flagged}")
    _write_all(output, outputs, frames, wanted, beside, force=force)
    said += darks.findings + work.findings + warn_of_as_dark(work.as_dark, darks.names[0])
    said += warn_of_not_finite(work.not_finite, np.dtype(np.uint8) if display else wanted)
    made = work.corrector
    said += warn_of_limited(made.clipped, total * correction.flags.size, wanted)
    counts = made.clipped, made.extrapolated, made.replaced, pixels_lost(correction, flagged)
    return Corrected(wanted.name, total, *counts, said)


def as_fast(frames: Array) -> Array:
    """Frames in a type that a `Corrector` takes."""
    native = frames.dtype.newbyteorder("=")
    return frames.astype(native if native in FAST else np.float32, copy=False)


def pixels_lost(correction: Correction, flagged: Flagged) -> int:
    """Count the flagged pixels that become NaN in each frame."""
    good = usable(correction.flags)
    if flagged == "nan":
        return int(np.count_nonzero(~good))
    kept = correction.coefficients[:, ~good] if flagged == "keep" else np.empty((1, 0))
    return int(np.count_nonzero(~np.isfinite(kept).all(axis=0)))


class _Correcting:
    """Frames on their way through a corrector, which is made anew where they have another dark."""

    def __init__(
        self,
        stored: Array | None,
        good: Bools,
        darks: FileDarks,
        prepared: Callable[..., Corrector],
        first: Path,
    ) -> None:
        self._stored, self._good, self._darks, self._prepared = stored, good, darks, prepared
        self._file: Path | None = None
        self._shares, self._dark = darks.shares[first], darks.of(first)
        self.corrector = prepared(dark=self._dark)
        self.findings: Findings = ()
        self.as_dark: list[Path] = []
        self.not_finite: Counter[Path] = Counter()
        self.done = 0

    def corrected(self, file: Path, frames: Array) -> Array:
        """Correct some frames of a file."""
        if file != self._file:
            self._go_on(file, frames[0])
        self.done += len(frames)
        if lost := int(np.count_nonzero(~np.isfinite(frames) & self._good)):
            self.not_finite[file] += lost
        try:
            return self.corrector.apply(as_fast(frames))
        except InputError as error:
            raise type(error)(f"{file}: {error}") from error

    def _go_on(self, file: Path, frame: Array) -> None:
        """Take the dark of the next file, whose first frame is compared with it."""
        if self._darks.shares[file] != self._shares:
            self._take_dark(file)
        dark = self._stored if isinstance(self._dark, str) else self._dark
        if dark is not None:
            if self._file is None:
                self.findings = warn_of_darker(frame, dark)
            # Frames from which the dark was subtracted are below it, whatever light they hold.
            is_raw = not self.findings
            if is_raw and file in self._darks.suspects and is_as_dark(frame, dark):
                self.as_dark.append(file)
        self._file = file

    def _take_dark(self, file: Path) -> None:
        """Make the corrector anew, which counts on."""
        last = self.corrector
        self._shares, self._dark = self._darks.shares[file], self._darks.of(file)
        self.corrector = self._prepared(dark=self._dark)
        self.corrector.clipped, self.corrector.extrapolated = last.clipped, last.extrapolated


def _frames(
    work: _Correcting,
    display: Display | None,
    total: int,
    progress: Progress | None,
    files: Iterable[Path],
) -> Iterator[NDArray[Any]]:
    """Give the corrected frames of some files, or pictures of them."""
    for file, frames in stream_frames(files):
        for frame in work.corrected(file, frames):
            yield picture(frame, display) if display else frame
        if progress is not None:
            progress(work.done, total, "correcting")


class _Beside(NamedTuple):
    """What stands beside frames: the text of each file, shapes of its inputs, their history."""

    mark: str
    shapes: Mapping[Path, tuple[int, int, int]]
    history: Mapping[Path, tuple[str, ...]]

    @classmethod
    def of(cls, headers: Mapping[Path, Header], darks: FileDarks, origin: str, told: str) -> Self:
        """Name the correction, the dark of each file, and what became of flagged pixels."""
        mark = ", ".join(filter(None, (MARK, origin)))
        shapes = {file: header.shape for file, header in headers.items()}
        return cls(mark, shapes, {file: (f"dark: {darks.named(file)}", told) for file in headers})


def _write_all(
    output: Path,
    outputs: Mapping[Path, list[Path]],
    frames: Callable[[list[Path]], Iterator[NDArray[Any]]],
    dtype: np.dtype[Any],
    beside: _Beside,
    *,
    force: bool,
) -> None:
    """Write one file, or a folder with a file for each input: all or none."""
    if not is_folder(output):
        with write_whole(output, force=force) as temporary:
            _write(temporary, frames(outputs[output]), outputs[output], dtype, beside)
        return
    with folder_beside(output) as folder:
        for path, files in outputs.items():
            _write(folder / path.name, frames(files), files, dtype, beside)
        if not output.exists():
            folder.rename(output)
            return
        for path in outputs:
            (folder / path.name).replace(path)


def _write(
    path: Path,
    frames: Iterator[NDArray[Any]],
    files: list[Path],
    dtype: np.dtype[Any],
    beside: _Beside,
) -> None:
    """Write the frames of some files to a FITS file or a TIFF, or the only one to a PNG."""
    if is_picture(path):
        for frame in frames:
            write_png(path, frame, description=beside.mark)
    elif path.suffix.lower() in fits.SUFFIXES:
        sources = [(file, beside.shapes[file], beside.history[file]) for file in files]
        fits.write_frames(path, frames, sources, dtype=dtype, mark=beside.mark)
    else:
        nbytes = dtype.itemsize * sum(math.prod(beside.shapes[file]) for file in files)
        write_frames(path, frames, nbytes=nbytes, description=beside.mark)


def _dtype(
    output: Path, dtype: OutputType | None, bit_depth: int | None, display: Display | None
) -> np.dtype[Any]:
    """Type of the output, by its name unless it is given."""
    if display is None:
        return output_dtype(dtype or ("uint16" if is_picture(output) else "float32"))
    if output.suffix.lower() in fits.SUFFIXES:
        raise InputError(
            f"'display' makes pictures, but '{output}' holds values to measure, in a unit: name a "
            ".tif, a .png of one frame or a folder, or leave out 'display'"
        )
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
    return output.suffix.lower() not in (".tif", ".tiff", ".png", *fits.SUFFIXES)


def _outputs(output: Path, files: list[Path], display: Display | None) -> dict[Path, list[Path]]:
    """Name what will be written, each with its inputs."""
    refuse_inputs(files, [], TWICE)
    if not is_folder(output):
        outputs = {output: files}
    else:
        names = [f"{file.stem}.tif" if display else _name(file) for file in files]
        if again := [name for name in names if names.count(name) > 1]:
            raise FileError(f"{output}: two inputs would become '{again[0]}': correct them apart")
        outputs = {output / name: [file] for name, file in zip(names, files, strict=True)}
    refuse_inputs(outputs, files)
    return outputs


def is_corrected(description: str) -> bool:
    """Whether the text of a file says that this module has written it."""
    return description.startswith(MARK)


def _name(file: Path) -> str:
    """Name of a corrected file in a folder: of FITS files with a suffix that is written."""
    if suffix_of(file) not in fits.READ:
        return f"{file.stem}.tif"
    names = (file.name, file.stem)  # the second of compressed files
    return next((n for n in names if n.lower().endswith(fits.SUFFIXES)), f"{file.stem}.fits")


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


def warn_of_not_finite(found: Counter[Path], dtype: np.dtype[Any]) -> Findings:
    """Warn of values of good pixels that are NaN or infinite, with the file that has most."""
    if not found:
        return ()
    (file, count), *others = found.most_common()
    more = f", and {len(others)} more with {found.total() - count}" if others else ""
    outcome = (
        "look as if they were measured: write 'dtype' (--dtype) float32, no picture, to keep them"
    )
    if dtype.kind == "f":
        outcome = "stay so: leave these frames out, or see what wrote them"
    words = (
        f"{file}: holds {count} values of good pixels that are NaN or infinite{more}. In the "
        f"output they {outcome}"
    )
    return say(Finding("not_finite", words, "input"))


def warn_of_limited(limited: int, values: int, dtype: np.dtype[Any]) -> Findings:
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
