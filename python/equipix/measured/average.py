"""Averaging of repeated frames."""

import dataclasses
import itertools
import operator
import os
from collections.abc import Iterable, Iterator
from functools import partial
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from equipix import _native
from equipix._check import (
    LOG,
    Array,
    ArrayLike,
    Progress,
    as_floats,
    as_level,
    as_mask,
    naming_memory,
    positive_workers,
)
from equipix.errors import FileError, InputError
from equipix.io.formats import ONLY_RESULTS, FrameFile, frame_files
from equipix.io.frames import (
    check_image,
    frame_format,
    is_image,
    leaving_others,
    stream_frames,
)
from equipix.io.record import made, now, read_record
from equipix.measured.saturation import level_of
from equipix.measured.settings import furthest, taken_with
from equipix.measured.statistics import FrameStatistics, _masked, _step, is_average, subtracted
from equipix.measured.stream import Rejection, batches, sum_dtype, unmasked


def average(
    frames: ArrayLike | Iterable[ArrayLike] | str | PathLike[str] | Iterable[str | PathLike[str]],
    *,
    dark: FrameStatistics | ArrayLike | None = None,
    saturation: float | None = None,
    mask: ArrayLike | None = None,
    reject: float | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> FrameStatistics:
    r"""Mean and variance of each pixel over any number of repeated frames.

    Parameters
    ----------
    frames : array of shape (n, rows, cols), iterable of (rows, cols), path, glob, list of paths
        The frames, in DN. Of files, every page counts: grey TIFF, PNG, PGM and BMP, all of one
        shape and depth; the file of a saved average gives that average. An iterable is taken one
        frame at a time and never collected, and files are read in small batches, so memory does not
        grow with the number of frames. Masked samples of `numpy.ma` arrays do not count.
    dark : FrameStatistics or array of shape (rows, cols), optional
        Dark mean, subtracted from the mean, in DN; the variance of a `FrameStatistics` dark mean
        is added to that of the mean.
    saturation : float, optional
        Samples at or above this level are counted as saturated, in DN. By default the largest
        value of an integer dtype (give 4095 for 12 bits in a 16-bit file); floating-point frames
        are not tested then.
    mask : array_like of bool, shape (rows, cols), optional
        True = do not use: mean and variances of the pixel become NaN, its counts 0.
    reject : float, optional
        Leave out samples that deviate by more than so many standard deviations from the others of
        their pixel, such as cosmic rays: 5 is usual. They count nowhere, not even as saturated. It
        takes nine frames of one steady scene or more, and holds the first nine of them.
    workers : int, optional
        Number of threads; by default one for each processor. It changes no bit of the result.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` repeatedly, in frames; `total` is an
        estimate until all files have been opened.

    Returns
    -------
    FrameStatistics
        Mean, unbiased variance of one frame, variance of the mean, and counts. Of files `metadata`
        hold ``exposure_s`` and ``temperature_c``, where headers or EXIF agree.

    Raises
    ------
    InputError
        If an argument has a wrong shape or value, or no frame holds a finite number.
    FileError
        If a file is missing, broken, in colour, or differs from the first in shape or depth; if
        headers or EXIF of files hold different exposure times.
    InsufficientMemoryError
        If there is not enough memory; on Linux this is checked before the work starts.

    Notes
    -----
    For n samples x of a pixel

    .. math:: \bar x = \frac{1}{n} \sum x, \qquad s^2 = \frac{1}{n-1} \sum (x - \bar x)^2 .

    Samples of 8 and 16 bits are summed exactly. Others are summed as float64 in batches that are
    merged by Chan's formula [1]_, each 256 frames apart, with a relative error of some
    ``n/256 + 32`` roundings at most.
    Samples that are not finite do not count; saturated ones do, and are counted apart.

    With `reject` a sample is compared with the mean of those before, and with a noise that pixels
    of similar signal have in common, or with its pixel's own where that is larger:
    `equipix.measured.stream.Rejection`, which states the bias that is left. The variance is divided
    by that of a normal distribution cut at so many standard deviations.

    References
    ----------
    .. [1] T. F. Chan, G. H. Golub, R. J. LeVeque, "Algorithms for computing the sample variance",
       The American Statistician 37 (1983) 242-247.

    Examples
    --------
    >>> import numpy as np
    >>> import equipix
    >>> frames = np.array([[[1, 2]], [[3, 2]]], dtype=np.uint8)
    >>> result = equipix.average(frames)
    >>> result.mean, result.variance
    (array([[2., 2.]]), array([[2., 0.]]))
    """
    started = now()
    offset = dark if isinstance(dark, FrameStatistics | None) else as_floats("dark", dark, ndim=2)
    how = _How(
        as_level(saturation),
        mask,
        None if reject is None else Rejection(reject),
        positive_workers(workers),
        progress,
    )
    taken = _paths_or_frames(frames)
    common: dict[str, float] = {}
    with naming_memory("averaging"):
        if isinstance(taken, list):
            files = frame_files(taken)
            statistics = _average_files(files, how)
            common = taken_with(files)
        else:
            statistics = _average_batches(batches(taken), how, operator.length_hint(frames))
        if not statistics.count.any():
            raise InputError("'frames' holds no finite number: give frames with numbers")
        return completed(statistics, offset, mask, started, common, how.level)


def completed(
    statistics: FrameStatistics,
    dark: FrameStatistics | Array | None,
    mask: ArrayLike | None,
    started: str,
    common: dict[str, float],
    level: float | None,
) -> FrameStatistics:
    """Subtract the dark, mask pixels, and add what is known of the frames and the options."""
    options = {"saturation": level, "reject": statistics.reject}
    # A saved average brings its own.
    metadata = statistics.metadata or made(options=options, started=started, **common)
    found = dataclasses.replace(subtracted(statistics, dark), metadata=metadata)
    shape, less = found.mean.shape, "no" if dark is None else "its"
    text = "averaged %d frames of %d × %d pixels, saturation level %s, %s dark subtracted"
    LOG.info(text, found.count.max(), *shape, found.saturation, less)
    return _masked(found, as_mask(mask, found.mean.shape))


class _How(NamedTuple):
    """Options of an average, checked but for the mask."""

    level: float | None
    mask: ArrayLike | None
    rejection: Rejection | None
    workers: int | None
    progress: Progress | None


def _paths_or_frames(source: Any) -> list[Any] | Array | Iterator[Any]:
    """Paths as a list, an array as it is, other iterables as an iterator."""
    if isinstance(source, np.ndarray):
        return source if np.ma.is_masked(source) else np.asarray(source)
    if isinstance(source, str | os.PathLike):
        return [source]
    try:
        items = iter(source)
    except TypeError as error:
        raise InputError(
            f"'frames' is a {type(source).__name__}, expected frames or the names of files"
        ) from error
    for first in items:
        everything = itertools.chain([first], items)
        return list(everything) if isinstance(first, str | os.PathLike) else everything
    raise InputError("'frames' holds no frames")


def _average_files(files: list[FrameFile], how: _How) -> FrameStatistics:
    paths = [file.path for file in files]
    LOG.info("files to average: %d, the first %s", len(paths), paths[0])
    LOG.debug("reads %s", ", ".join(map(str, paths)))
    refuse_mixed(files)
    if any(path.suffix.lower() in ONLY_RESULTS for path in paths):
        return _saved(files, how)
    if how.rejection is None and all(map(is_image, paths)):
        for path in paths:
            check_image(path)
        with leaving_others(*paths):
            shape, dtype = frame_format(paths[0])
            mask = as_mask(how.mask, shape[1:])
            maps = _native.average_files(paths, how.level, mask, how.workers, how.progress)
            return _statistics(maps, dtype, level_of(dtype, how.level))
    if any(map(is_average, files)):
        return _saved(files, how)
    stream = stream_frames(paths, workers=how.workers)
    given = batches(frame for _, frames in stream for frame in frames)
    return _average_batches(given, how, len(paths))


def refuse_mixed(files: list[FrameFile]) -> None:
    """Refuse files of different exposure times, where they hold them."""
    if len(files) < 2:
        return
    held = {file.path: file.settings for file in files}
    if ends := furthest(held, 0, 0.0):
        (least, low), (most, high) = ((path, held[path].exposure_s) for path in ends)
        raise FileError(
            f"'{least}' holds the exposure time {low:g} s, '{most}' {high:g} s, "
            "expected one: average the frames of each exposure time by themselves"
        )


def _saved(files: list[FrameFile], how: _How) -> FrameStatistics:
    """Read the one average that is given in the place of frames."""
    path, *others = (file.path for file in sorted(files, key=is_average, reverse=True))
    if others:
        raise FileError(
            f"{path}: holds averaged frames, which cannot be averaged with other files: name one "
            "saved average alone, or the frames of all"
        )
    if how.rejection is not None:
        raise InputError(f"{path}: holds averaged frames, from which 'reject' cannot leave out any")
    statistics = read_record(path, FrameStatistics)
    level = how.level
    if level is not None and statistics.saturation not in (None, level):
        raise FileError(
            f"{path}: was averaged with the saturation level {statistics.saturation:g}, expected "
            f"{level:g}: average the frames again with 'saturation' (--saturation {level:g})"
        )
    return statistics if how.mask is None else dataclasses.replace(statistics, light_variance=None)


def _statistics(
    maps: tuple[Any, ...],
    dtype: np.dtype[Any],
    level: float | None,
    rejection: Rejection | None = None,
) -> FrameStatistics:
    mean, variance, count, saturated, light_variance = maps
    if rejection is not None:
        variance = variance / rejection.variance_kept
    return FrameStatistics(
        mean,
        variance,
        variance / count,
        count,
        saturated,
        saturation=level,
        raw=dtype.kind in "iu",
        reject=None if rejection is None else rejection.sigmas,
        step=_step(mean, variance, count),
        light_variance=None if np.isnan(light_variance) else light_variance,
    )


class RunningAverage:
    """Sums over frames of one shape and dtype, which do not grow with their number.

    Parameters
    ----------
    first : ndarray
        A frame or several, as all that follow.
    level : float, optional
        Saturation level in DN; by default the largest value of an integer dtype.
    mask : array_like of bool, shape (rows, cols), optional
        True = do not use.
    workers : int, optional
        Number of threads.
    rejection : Rejection, optional
        How samples were left out of the frames before they were added.
    """

    def __init__(
        self,
        first: Array,
        level: float | None = None,
        mask: ArrayLike | None = None,
        workers: int | None = None,
        rejection: Rejection | None = None,
    ) -> None:
        self._given, self._rejection = first.dtype, rejection
        self._level = level_of(first.dtype, level)
        self._dtype = sum_dtype(first) if rejection is None else np.dtype(np.float64)
        shape = first.shape[-2:]
        excluded = as_mask(mask, shape)
        given = self._dtype.name, shape, self._level, excluded, workers
        self._new = partial(_native.Accumulator, *given)
        self._sums = self._new()
        self.count = 0

    def add(self, frames: Array) -> None:
        """Add frames, shape (n, rows, cols)."""
        self._sums.add(unmasked(frames, self._dtype))
        self.count += len(frames)

    def state(self) -> Array:
        """Return the sums as bytes, uint8."""
        return self._sums.state()

    def merge(self, state: Array) -> None:
        """Add the sums of later frames, as `state` of others of the same options gave them.

        Raises
        ------
        InputError
            If they are of other frames or incomplete.
        """
        later = self._new()
        later.restore(state)
        self._sums.merge(later)

    def statistics(self) -> FrameStatistics:
        """Mean and scatter of all frames so far, no dark subtracted."""
        return _statistics(self._sums.finish(), self._given, self._level, self._rejection)


def _average_batches(given: Iterator[Array], how: _How, total: int) -> FrameStatistics:
    first = next(given)
    everything: Iterator[Array] = itertools.chain([first], given)
    if how.rejection is not None:
        everything = how.rejection.cleaned(everything, whole=first.dtype.kind in "bui")
    sums = RunningAverage(first, how.level, how.mask, how.workers, how.rejection)
    for batch in everything:
        sums.add(batch)
        if how.progress is not None:
            how.progress(sums.count, max(sums.count, total), "average")
    return sums.statistics()
