"""Averaging of repeated frames, and files of the result."""

from __future__ import annotations

import dataclasses
import itertools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix import _native, io
from equipix._check import as_array, as_floats, as_level, naming_memory, positive_workers
from equipix._readonly import ReadOnly
from equipix.errors import InputError, UnsupportedFileError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from os import PathLike

    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Progress

_BATCH = 16  # frames handed over at once
_BATCH_BYTES = 2**26
_FORMAT = 1  # of saved statistics; files with a larger number are refused
_KIND = "frame statistics"
_PAGES = {
    "mean": np.float64,
    "variance": np.float64,
    "variance_of_mean": np.float64,
    "count": np.uint32,
    "saturated": np.uint32,
}
_DARK = "dark_"  # before the names of the dark's pages
_SUMMABLE = ("uint8", "uint16", "float32", "float64")


@dataclass(frozen=True, eq=False)
class FrameStatistics(ReadOnly):
    """Mean and scatter of repeated frames of one scene, as read-only arrays.

    Attributes
    ----------
    mean : ndarray, shape (rows, cols), float64
        Mean of the frames, the dark mean subtracted if there was one, in DN.
    variance : ndarray, shape (rows, cols), float64
        Unbiased sample variance of one frame, in DN²; NaN where fewer than two samples count.
    variance_of_mean : ndarray, shape (rows, cols), float64
        Variance of `mean`, in DN²: ``variance / count``, plus that of the dark mean.
    count : ndarray, shape (rows, cols), uint32
        Number of samples that went into the mean.
    saturated : ndarray, shape (rows, cols), uint32
        Number of samples at or above the saturation level.
    dark : FrameStatistics or None
        The dark frames whose mean was subtracted, where they were given as statistics. They show
        which pixels are hot, and how noisy a frame without light is.
    """

    mean: NDArray[Any]
    variance: NDArray[Any]
    variance_of_mean: NDArray[Any]
    count: NDArray[Any]
    saturated: NDArray[Any]
    dark: FrameStatistics | None = None

    @property
    def maps(self) -> dict[str, NDArray[Any]]:
        """The five maps by their names."""
        return {name: getattr(self, name) for name in _PAGES}


def average(
    source: ArrayLike | Iterable[ArrayLike] | str | PathLike[str] | Iterable[str | PathLike[str]],
    *,
    dark: FrameStatistics | ArrayLike | None = None,
    saturation: float | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> FrameStatistics:
    r"""Mean and variance of each pixel over any number of repeated frames.

    Parameters
    ----------
    source : array of shape (n, rows, cols), iterable of (rows, cols), path, glob, list of paths
        The frames, in DN. Of files, every page counts: grey TIFF, PNG, PGM and BMP, all of one
        shape and depth. An iterable is taken one frame at a time and never collected, and files
        are read in small batches, so memory does not grow with the number of frames.
    dark : FrameStatistics or array of shape (rows, cols), optional
        Dark mean, subtracted from the mean, in DN; the variance of a `FrameStatistics` dark mean
        is added to that of the mean.
    saturation : float, optional
        Samples at or above this level are counted as saturated, in DN. By default the largest
        value of an integer dtype (give 4095 for 12 bits in a 16-bit file); floating-point frames
        are not tested then.
    workers : int, optional
        Number of threads; by default one for each processor. It changes no bit of the result.
    progress : callable, optional
        Called as ``progress(done, total, stage)`` repeatedly, in frames; `total` is an
        estimate until all files have been opened.

    Returns
    -------
    FrameStatistics
        Mean, unbiased variance of one frame, variance of the mean, and counts.

    Raises
    ------
    InputError
        If an argument has a wrong shape or value.
    FileError
        If a file is missing, broken, in colour, or differs from the first in shape or depth.
    InsufficientMemoryError
        If there is not enough memory; on Linux this is checked before the work starts.

    Notes
    -----
    For n samples x of a pixel

    .. math:: \bar x = \frac{1}{n} \sum x, \qquad s^2 = \frac{1}{n-1} \sum (x - \bar x)^2 .

    Samples of 8 and 16 bits are summed exactly. Others are summed as float64 in batches that are
    merged by Chan's formula [1]_, with a relative error of some ``n/16 + 16`` roundings at most.
    Samples that are not finite do not count; saturated ones do, and are counted apart.

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
    workers = positive_workers(workers)
    level = as_level(saturation)
    offset = dark if isinstance(dark, FrameStatistics | None) else as_floats("dark", dark, ndim=2)
    frames = _paths_or_frames(source)
    with naming_memory("averaging"):
        if isinstance(frames, list):
            maps = _average_files(frames, level, workers, progress)
        else:
            maps = _average_batches(_batches(frames), level, workers, progress, _length(source))
        mean, variance, count, saturated = maps
        statistics = FrameStatistics(mean, variance, variance / count, count, saturated)
        return _subtract(statistics, offset)


def save_statistics(
    path: str | PathLike[str], statistics: FrameStatistics, *, force: bool = False
) -> None:
    """Write averaged frames to a .tif or .npz file.

    Parameters
    ----------
    path : path
        Output; its suffix names the format.
    statistics : FrameStatistics
        What `equipix.average` returned.
    force : bool, optional
        Replace a file that is there.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    """
    pages = dict(statistics.maps)
    if statistics.dark is not None:
        pages |= {_DARK + name: values for name, values in statistics.dark.maps.items()}
    io.save_pages(path, pages, {"format": _FORMAT, "kind": _KIND}, force=force)


def load_statistics(path: str | PathLike[str]) -> FrameStatistics:
    """Read what `save_statistics` wrote.

    Parameters
    ----------
    path : path
        A .tif or .npz file.

    Returns
    -------
    FrameStatistics
        The averaged frames.

    Raises
    ------
    FileError
        If the file is not readable or holds something else.
    """
    pages, metadata = io.load_pages(path)
    io.check_format(path, metadata, _KIND, _FORMAT)
    io.check_pages(path, pages, _PAGES)
    dark = None
    if _DARK + "mean" in pages:
        io.check_pages(path, pages, {_DARK + name: dtype for name, dtype in _PAGES.items()})
        dark = _of_pages(pages, _DARK)
    return dataclasses.replace(_of_pages(pages), dark=dark)


def _of_pages(pages: dict[str, NDArray[Any]], before: str = "") -> FrameStatistics:
    mean, variance, of_mean, count, saturated = (pages[before + name] for name in _PAGES)
    return FrameStatistics(mean, variance, of_mean, count, saturated)


def _paths_or_frames(source: Any) -> list[Any] | NDArray[Any] | Iterator[Any]:
    """Paths as a list, an array as it is, other iterables as an iterator."""
    if np.ma.is_masked(source):
        raise InputError(
            "'source' is a masked array, whose mask would be lost: fill the masked samples with NaN"
        )
    if isinstance(source, np.ndarray):
        return source
    if isinstance(source, str | os.PathLike):
        return [source]
    try:
        items = iter(source)
    except TypeError as error:
        raise InputError(
            f"'source' is a {type(source).__name__}, expected frames or the names of files"
        ) from error
    for first in items:
        everything = itertools.chain([first], items)
        return list(everything) if isinstance(first, str | os.PathLike) else everything
    raise InputError("'source' holds no frames")


def _length(source: Any) -> int:
    return len(source) if hasattr(source, "__len__") else 0


def _average_files(
    names: list[Any],
    level: float | None,
    workers: int | None,
    progress: Progress | None,
) -> tuple[NDArray[Any], ...]:
    paths = io.find_files(names)
    try:
        return _native.average_files(paths, level, workers, progress)
    except UnsupportedFileError:
        stream = io.stream_frames(paths, workers=workers)
        batches = _batches(frame for _, frames in stream for frame in frames)
        return _average_batches(batches, level, workers, progress, len(paths))


def _batches(frames: NDArray[Any] | Iterator[Any]) -> Iterator[NDArray[Any]]:
    """Give the frames a few at a time: views of an array, copies of what an iterator gives."""
    if isinstance(frames, np.ndarray):
        if frames.ndim != 3 or 0 in frames.shape:
            raise InputError(
                f"'source' has shape {frames.shape}, expected (frames, rows, cols), none of them 0"
            )
        size = _batch_size(frames[0])
        yield from (frames[start : start + size] for start in range(0, len(frames), size))
        return
    first = as_array("source[0]", next(frames), ndim=2)
    batch = np.empty((_batch_size(first), *first.shape), first.dtype)
    filled = 0
    for index, item in enumerate(itertools.chain([first], frames)):
        frame = as_array(f"source[{index}]", item, ndim=2)
        if frame.shape != first.shape or frame.dtype != first.dtype:
            raise InputError(
                f"'source[{index}]' is {frame.dtype} of shape {frame.shape}, expected"
                f" {first.dtype} of shape {first.shape} like the first"
            )
        batch[filled] = frame
        filled += 1
        if filled == len(batch):
            yield batch
            filled = 0
    if filled:
        yield batch[:filled]


def _batch_size(frame: NDArray[Any]) -> int:
    return max(1, min(_BATCH, _BATCH_BYTES // max(1, frame.nbytes)))


def _average_batches(
    batches: Iterator[NDArray[Any]],
    level: float | None,
    workers: int | None,
    progress: Progress | None,
    total: int,
) -> tuple[NDArray[Any], ...]:
    first = next(batches)
    dtype = _sum_dtype(first.dtype)
    if level is None and first.dtype.kind in "iu":
        level = float(np.iinfo(first.dtype).max)
    sums = _native.Accumulator(dtype.name, first.shape[1:], level, workers)
    done = 0
    for batch in itertools.chain([first], batches):
        sums.add(np.ascontiguousarray(batch, dtype=dtype))
        done += len(batch)
        if progress is not None:
            progress(done, max(done, total), "average")
    return sums.finish()


def _sum_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Choose the dtype that frames are summed in: their own, or float64."""
    if dtype.kind not in "buif":
        raise InputError(f"'source' has dtype {dtype}, expected real numbers")
    return np.dtype(dtype.name if dtype.name in _SUMMABLE else "float64")


def _subtract(
    statistics: FrameStatistics, dark: FrameStatistics | NDArray[Any] | None
) -> FrameStatistics:
    if dark is None:
        return statistics
    mean = dark.mean if isinstance(dark, FrameStatistics) else dark
    if mean.shape != statistics.mean.shape:
        raise InputError(
            f"'dark' has shape {mean.shape}, expected {statistics.mean.shape} like the frames"
        )
    variance = dark.variance_of_mean if isinstance(dark, FrameStatistics) else 0.0
    return FrameStatistics(
        statistics.mean - mean,
        statistics.variance,
        statistics.variance_of_mean + variance,
        statistics.count,
        statistics.saturated,
        dark if isinstance(dark, FrameStatistics) else None,
    )
