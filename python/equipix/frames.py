"""Averaging of repeated frames, and files of the result."""

from __future__ import annotations

import dataclasses
import itertools
import os
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix import _native, io
from equipix._check import (
    as_array,
    as_floats,
    as_level,
    check_maps,
    naming_memory,
    positive_workers,
)
from equipix._readonly import ReadOnly
from equipix.batches import batches, sum_dtype, unmasked
from equipix.errors import (
    BrightDarkWarning,
    FileError,
    InputError,
    UnsupportedFileError,
    warn,
)
from equipix.rejection import Rejection
from equipix.rounding import step_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from os import PathLike
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

    from equipix._types import Progress

_FORMAT = 1  # of saved statistics; files with a larger number are refused
_KIND = "frame statistics"
_PAGES = {
    "mean": np.float64,
    "variance": np.float64,
    "variance_of_mean": np.float64,
    "count": np.uint32,
    "saturated": np.uint32,
}
_COUNTS = ("count", "saturated")
_NUMBERS = ("saturation", "reject", "step", "light_variance")
_SAMPLED = 4096  # pixels that show the step between values
_DARK = "dark_"  # before the names of the dark's pages

DARKER = 0.25
"""Share of the dark by which frames are not darker than it: a dark drifts by less."""


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
    saturation : float or None
        The level that samples were compared with, in DN; None if there was none.
    raw : bool
        Whether no dark was subtracted from whole numbers, as cameras write them.
    reject : float or None
        The deviation, in standard deviations, beyond which samples were left out; None where all
        count.
    step : float
        Step between the values of the frames, in DN: 1 of whole numbers, 16 of 12 bits that were
        shifted to 16; 0 of values that are not whole. See `equipix.rounding`. Of files that hold no
        step it is found from the sums over frames; it is 0 where they are not whole, since the dark
        that was subtracted is not kept.
    light_variance : float or None
        Unbiased variance of the means of the frames over the pixels that are not masked, in DN²:
        that of the light, and of the noise over the number of pixels. Where samples are missing it
        is that of their differences to the first values of their pixels. None of one frame, or
        where it is not known: a saved average does not show it without the pixels of another mask.
    """

    mean: NDArray[Any]
    variance: NDArray[Any]
    variance_of_mean: NDArray[Any]
    count: NDArray[Any]
    saturated: NDArray[Any]
    dark: FrameStatistics | None = None
    saturation: float | None = None
    raw: bool = False
    reject: float | None = None
    step: float = 0.0
    light_variance: float | None = None

    def __post_init__(self) -> None:
        """Refuse maps of different shapes."""
        ReadOnly.__post_init__(self)
        dark = {} if self.dark is None else {"dark": self.dark.mean}
        check_maps("FrameStatistics", self.maps | dark)

    @property
    def maps(self) -> dict[str, NDArray[Any]]:
        """The five maps by their names."""
        return {name: getattr(self, name) for name in _PAGES}

    def save(self, path: str | PathLike[str], *, force: bool = False) -> None:
        """Write to a file that `FrameStatistics.load` reads.

        `equipix.average`, experiment.toml and the command line take the file in the place of the
        frames.

        Parameters
        ----------
        path : str or path
            The file; its suffix, .tif or .npz, names the format.
        force : bool
            Whether an existing file may be replaced.

        Raises
        ------
        FileError
            If the file exists and `force` is not set, or it cannot be written.
        """
        save_statistics(path, self, force=force)

    @staticmethod
    def load(path: str | PathLike[str]) -> FrameStatistics:
        """Read what `save` wrote.

        Parameters
        ----------
        path : str or path
            A .tif or .npz file.

        Returns
        -------
        FrameStatistics
            The averaged frames.

        Raises
        ------
        FileError
            If the file cannot be read, holds something else, or was written in a newer format.
        """
        return load_statistics(path)


def average(
    source: ArrayLike | Iterable[ArrayLike] | str | PathLike[str] | Iterable[str | PathLike[str]],
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
    source : array of shape (n, rows, cols), iterable of (rows, cols), path, glob, list of paths
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

    With `reject` a sample is compared with the mean of those before, and with a noise that pixels
    of similar signal have in common, or with its pixel's own where that is larger:
    `equipix.rejection.Rejection`, which states the bias that is left. The variance is divided by
    that of a normal distribution cut at so many standard deviations.

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
    level, rejection = as_level(saturation), None if reject is None else Rejection(reject)
    offset = dark if isinstance(dark, FrameStatistics | None) else as_floats("dark", dark, ndim=2)
    frames = _paths_or_frames(source)
    out = None if mask is None else as_array("mask", mask, ndim=2)
    with naming_memory("averaging"):
        if isinstance(frames, list):
            statistics = _average_files(frames, level, out, workers, progress, rejection)
        else:
            given = batches(frames)
            statistics = _average_batches(
                given, level, out, workers, progress, _length(source), rejection
            )
        if reject is not None:
            statistics = dataclasses.replace(statistics, reject=float(reject))
        return _masked(_subtract(statistics, offset), out)


def save_statistics(
    path: str | PathLike[str], statistics: FrameStatistics, *, force: bool = False
) -> None:
    """Write averaged frames; the parameters and errors are those of `FrameStatistics.save`."""
    pages, dark = dict(statistics.maps), statistics.dark
    content: dict[str, Any] = {"format": _FORMAT, "kind": _KIND}
    content |= {name: getattr(statistics, name) for name in ("raw", *_NUMBERS)}
    if dark is not None:
        pages |= {_DARK + name: values for name, values in dark.maps.items()}
        content |= {_DARK + name: getattr(dark, name) for name in _NUMBERS}
    io.save_pages(path, pages, content, force=force)


def load_statistics(path: str | PathLike[str]) -> FrameStatistics:
    """Read averaged frames; the parameter and errors are those of `FrameStatistics.load`."""
    return read_statistics(path, *io.load_pages(path))


def read_statistics(
    path: str | PathLike[str], pages: Mapping[str, NDArray[Any]], content: dict[str, Any]
) -> FrameStatistics:
    """Make averages of the arrays and metadata of the file that `save_statistics` wrote."""
    io.check_format(path, content, _KIND, _FORMAT)
    io.check_pages(path, pages, _PAGES)
    dark = None
    if _DARK + "mean" in pages:
        io.check_pages(path, pages, {_DARK + name: dtype for name, dtype in _PAGES.items()})
        dark = _of_pages(path, pages, content, _DARK)
    raw = content.get("raw", False)
    statistics = dataclasses.replace(_of_pages(path, pages, content), dark=dark, raw=raw)
    return statistics if "step" in content else _with_steps(statistics)


def _with_steps(statistics: FrameStatistics) -> FrameStatistics:
    """Find the steps of averages that were saved without: sums over frames still show them."""
    dark, mean = statistics.dark, statistics.mean
    if dark is not None:
        dark, mean = _with_steps(dark), mean + dark.mean
    step = _step(mean, statistics.variance, statistics.count)
    return dataclasses.replace(statistics, dark=dark, step=step)


def _of_pages(
    path: str | PathLike[str],
    pages: Mapping[str, NDArray[Any]],
    content: dict[str, Any],
    before: str = "",
) -> FrameStatistics:
    mean, variance, of_mean, count, saturated = (pages[before + name] for name in _PAGES)
    numbers = {name: content[before + name] for name in _NUMBERS if before + name in content}
    for name, value in numbers.items():
        if type(value) not in (int, float) and (name == "step" or value is not None):
            raise FileError(
                f"{path}: is damaged: its '{before}{name}' is {value!r}, expected a number"
            )
    return FrameStatistics(mean, variance, of_mean, count, saturated, **numbers)


def saved_shape(path: Path) -> tuple[int, int] | None:
    """Rows and columns of the averages in a file; None of frames. A calibration is an error."""
    if (kind := io.saved_kind(path)) is None:
        return None
    if kind != _KIND:
        io.refuse_saved(path)
    rows, cols = load_statistics(path).mean.shape
    return rows, cols


def _paths_or_frames(source: Any) -> list[Any] | NDArray[Any] | Iterator[Any]:
    """Paths as a list, an array as it is, other iterables as an iterator."""
    if isinstance(source, np.ndarray):
        return source if np.ma.is_masked(source) else np.asarray(source)
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
    mask: NDArray[Any] | None,
    workers: int | None,
    progress: Progress | None,
    rejection: Rejection | None,
) -> FrameStatistics:
    paths = io.find_files(names)
    if any(path.suffix.lower() == ".npz" for path in paths):
        return _saved(paths, level, mask, rejection)
    if rejection is None:
        with suppress(UnsupportedFileError):
            if mask is not None:
                _check_mask(mask, io.frame_format(paths[0])[0][1:])
            maps = _native.average_files(paths, level, mask, workers, progress)
            return _statistics(maps, io.frame_format(paths[0])[1], level)
    if any(saved_shape(path) for path in paths):
        return _saved(paths, level, mask, rejection)
    stream = io.stream_frames(paths, workers=workers)
    given = batches(frame for _, frames in stream for frame in frames)
    return _average_batches(given, level, mask, workers, progress, len(paths), rejection)


def _saved(
    paths: list[Path],
    level: float | None,
    mask: NDArray[Any] | None,
    rejection: Rejection | None,
) -> FrameStatistics:
    """Read the one average that is given in the place of frames."""
    path, *others = sorted(paths, key=lambda path: saved_shape(path) is None)
    if others:
        raise FileError(
            f"{path}: holds averaged frames, which cannot be averaged with other files: name one "
            "saved average alone, or the frames of all"
        )
    if rejection is not None:
        raise InputError(f"{path}: holds averaged frames, from which 'reject' cannot leave out any")
    statistics = load_statistics(path)
    if level is not None and statistics.saturation not in (None, level):
        raise FileError(
            f"{path}: was averaged with the saturation level {statistics.saturation:g}, expected "
            f"{level:g}: average the frames again with 'saturation' (--saturation {level:g})"
        )
    _check_mask(mask, statistics.mean.shape)
    return statistics if mask is None else dataclasses.replace(statistics, light_variance=None)


def _statistics(
    maps: tuple[Any, ...], dtype: np.dtype[Any], level: float | None
) -> FrameStatistics:
    mean, variance, count, saturated, light_variance = maps
    return FrameStatistics(
        mean,
        variance,
        variance / count,
        count,
        saturated,
        saturation=_level_of(dtype, level),
        raw=dtype.kind in "iu",
        step=_step(mean, variance, count),
        light_variance=None if np.isnan(light_variance) else light_variance,
    )


def _step(mean: NDArray[Any], variance: NDArray[Any], count: NDArray[Any]) -> float:
    """Step between the values of frames, of a sample of the pixels.

    Sums over frames are multiples of it. Those of a pixel whose frames are equal are multiples of
    their number as well, so there the mean counts.
    """
    sample = np.linspace(0, mean.size - 1, min(mean.size, _SAMPLED)).astype(np.intp)
    means, variances, counts = (each.ravel()[sample] for each in (mean, variance, count))
    return step_of(means * np.where(variances > 0, counts, 1))


def _level_of(dtype: np.dtype[Any], level: float | None) -> float | None:
    """Saturation level of samples of a dtype: the largest whole number, unless given."""
    if level is None and dtype.kind in "iu":
        return float(np.iinfo(dtype).max)
    return level


def _average_batches(
    given: Iterator[NDArray[Any]],
    level: float | None,
    mask: NDArray[Any] | None,
    workers: int | None,
    progress: Progress | None,
    total: int,
    rejection: Rejection | None,
) -> FrameStatistics:
    first = next(given)
    dtype, level = sum_dtype(first), _level_of(first.dtype, level)
    everything: Iterator[NDArray[Any]] = itertools.chain([first], given)
    if rejection is not None:
        dtype, everything = np.dtype(np.float64), rejection.cleaned(everything)
    _check_mask(mask, first.shape[1:])
    sums = _native.Accumulator(dtype.name, first.shape[1:], level, mask, workers)
    done = 0
    for batch in everything:
        sums.add(np.ascontiguousarray(unmasked(batch, dtype), dtype=dtype))
        done += len(batch)
        if progress is not None:
            progress(done, max(done, total), "average")
    maps = sums.finish()
    if rejection is not None:
        maps = (maps[0], maps[1] / rejection.variance_kept, *maps[2:])
    return _statistics(maps, first.dtype, level)


def _check_mask(mask: NDArray[Any] | None, shape: tuple[int, ...]) -> None:
    """Refuse a mask of frames of that shape that is none, or leaves no pixel."""
    if mask is None:
        return
    if mask.dtype != np.bool_ or mask.shape != shape:
        raise InputError(
            f"'mask' is {mask.dtype} of shape {mask.shape}, expected bool of shape {shape}, True "
            f"= do not use{': give mask != 0' if mask.shape == shape else ''}"
        )
    if mask.all():
        raise InputError("'mask' is True in every pixel, expected some pixels to use")


def _masked(statistics: FrameStatistics, mask: NDArray[Any] | None) -> FrameStatistics:
    """Return averages without the pixels of a mask."""
    if mask is None:
        return statistics
    maps: dict[str, Any] = {name: values.copy() for name, values in statistics.maps.items()}
    for name, values in maps.items():
        values[mask] = 0 if name in _COUNTS else np.nan
    return dataclasses.replace(statistics, **maps)


def _subtract(
    statistics: FrameStatistics, dark: FrameStatistics | NDArray[Any] | None
) -> FrameStatistics:
    if dark is None:
        return statistics
    if statistics.dark is not None:
        if isinstance(dark, FrameStatistics) and same_statistics(statistics.dark, dark):
            return statistics
        raise InputError(
            "'source' is an average from which another dark than 'dark' is subtracted already: "
            "give the frames, or the dark that was subtracted"
        )
    if isinstance(dark, FrameStatistics):
        refuse_subtracted(dark)
    mean = dark.mean if isinstance(dark, FrameStatistics) else dark
    if mean.shape != statistics.mean.shape:
        raise InputError(
            f"'dark' has shape {mean.shape}, expected {statistics.mean.shape} like the frames"
        )
    if not np.isfinite(mean).any():
        raise InputError("'dark' holds no finite number: give the mean of dark frames")
    variance = dark.variance_of_mean if isinstance(dark, FrameStatistics) else 0.0
    return dataclasses.replace(
        statistics,
        mean=statistics.mean - mean,
        variance_of_mean=statistics.variance_of_mean + variance,
        dark=dark if isinstance(dark, FrameStatistics) else None,
        raw=False,
    )


def warn_of_bright_dark(statistics: FrameStatistics) -> None:
    """Warn of a dark that is not that of the frames, or was subtracted from them before."""
    if statistics.dark is None or not np.isfinite(statistics.mean).any():
        return
    level, below = np.nanmedian(statistics.dark.mean), -np.nanmedian(statistics.mean)
    if level > 0 and below > DARKER * level:
        warn(
            f"the frames are darker than 'dark' by {below:.4g} of {level:.4g} DN in the median "
            f"(limit {DARKER:.0%}): see that frames and dark are not exchanged, and give frames "
            "from which no dark was subtracted",
            BrightDarkWarning,
        )


def refuse_subtracted(dark: FrameStatistics, place: str = "'dark'") -> None:
    """Refuse as a dark an average that holds no dark level; `place` is for the message."""
    if dark.dark is not None:
        raise InputError(
            f"{place}: its dark was already subtracted; 'dark' needs frames or an average without "
            "a dark"
        )


def same_statistics(one: FrameStatistics | None, other: FrameStatistics | None) -> bool:
    """Whether two averages are the same measurement: one object, or equal to the last bit."""
    if one is None or other is None or one is other:
        return one is other
    pairs = zip(one.maps.values(), other.maps.values(), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
