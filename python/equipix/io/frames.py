"""Frames and masks from image files, by whichever reader decodes them."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from equipix import _native
from equipix.errors import FileError, UnsupportedFileError
from equipix.io import arrays, binary, camera_raw, fits, png, tiff
from equipix.io.paths import find_files, reading

_AT_ONCE = 2**27
"""Most bytes of a file of several frames that are read at once."""


def read_frames(source: str | PathLike[str] | Iterable[str | PathLike[str]]) -> NDArray[Any]:
    """All frames of some files at once; `equipix.average` does not hold them all.

    Parameters
    ----------
    source : path, glob, or list of these
        Files as in `find_files`.

    Returns
    -------
    ndarray, shape (n, rows, cols)
        The numbers in the files, in their own dtype.

    Raises
    ------
    FileError
        If a file cannot be read or differs from the first in shape or dtype.
    """
    return np.concatenate([frames for _, frames in stream_frames(source)])


@dataclass(frozen=True)
class FrameFiles:
    """Frames of files, read anew, a few at a time, whenever they are asked for.

    Attributes
    ----------
    files : tuple of Path
        The files.
    shape : tuple of int
        Number of frames, rows and columns.
    dtype : dtype
        Of the numbers in the files.
    """

    files: tuple[Path, ...]
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.shape[0]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        """Give one frame after the other, shape (rows, cols)."""
        for _, frames in stream_frames(self.files):
            yield from frames


def stream_frames(
    source: str | PathLike[str] | Iterable[str | PathLike[str]], *, workers: int | None = None
) -> Iterator[tuple[Path, NDArray[Any]]]:
    """Frames of some files, a few at a time, by whichever reader decodes them.

    Parameters
    ----------
    source : path, glob, or list of these
        Files as in `find_files`.
    workers : int, optional
        Number of threads; by default one for each processor.

    Yields
    ------
    path : Path
        The file.
    frames : ndarray, shape (n, rows, cols)
        Some of its frames, in the file's order.

    Raises
    ------
    FileError
        If a file cannot be read or differs from the first in shape or dtype.
    """
    first: tuple[Path, NDArray[Any]] | None = None
    for path in find_files(source):
        for frames in _frames(path, workers):
            first = first or (path, frames[:1])
            if frames.shape[1:] != first[1].shape[1:] or frames.dtype != first[1].dtype:
                raise FileError(
                    f"{path}: is {_format(frames)}, expected {_format(first[1])} as in {first[0]}"
                )
            yield path, frames


def stream_part(
    path: Path, start: int, stop: int, *, workers: int | None = None
) -> Iterator[NDArray[Any]]:
    """Frames of a file from the number `start` on to before `stop`, a few at a time."""
    return _frames(path, workers, start, stop)


_READERS = {
    **dict.fromkeys(arrays.SUFFIXES, arrays),
    **dict.fromkeys(fits.READ, fits),
    **dict.fromkeys(camera_raw.SUFFIXES, camera_raw),
}
"""The module that reads each kind of file besides images: ``header`` and ``stream_frames``."""

WITH_HEADERS = (*fits.READ, *camera_raw.SUFFIXES)
"""Suffixes of files whose exposure time is read with all that stands beside their frames."""

_IMAGES = (".tif", ".tiff", ".png", ".pgm", ".bmp")


def _reader(path: Path) -> Any:
    return binary if binary.split(str(path))[1] else _READERS.get(suffix_of(path))


def is_image(path: Path) -> bool:
    """Whether a file is an image, which the compiled reader or tifffile decodes."""
    return _reader(path) is None


def has_format(path: Path) -> bool:
    """Whether a file has a format of its own by its name, so that its layout is not asked for."""
    return suffix_of(path) in (*_IMAGES, *_READERS, ".npz")


def suffix_of(path: Path) -> str:
    """Suffix of a file, without the place of an array in it."""
    return arrays.split(path)[0].suffix.lower()


def frame_format(path: Path) -> tuple[tuple[int, int, int], np.dtype[Any]]:
    """Shape (n, rows, cols) and dtype of the frames of a file, none of which is decoded.

    Raises
    ------
    FileError
        If the file cannot be read or holds no grey image.
    """
    if not is_image(path):
        return header(path)[:2]
    check_image(path)
    with leaving_others(path):
        count, rows, cols, bits = _native.file_format(path)
        return (count, rows, cols), np.dtype(f"uint{bits}")
    return tiff.header(path)[:2]


@contextmanager
def leaving_others(*paths: Path) -> Iterator[None]:
    """Leave to tifffile what the compiled reader does not decode, saved results among it."""
    try:
        yield
    except FileError as error:
        if not isinstance(error, UnsupportedFileError) and not any(map(tiff.is_result, paths)):
            raise


def check_image(path: Path) -> None:
    """Refuse a file of unknown format, and an OME-TIFF whose pages are not frames of one thing."""
    if suffix_of(path) in (".jpg", ".jpeg"):
        raise FileError(
            f"{path}: is a JPEG, whose values are not proportional to light and lose detail, "
            "expected .tif, .png or a raw file: record one of these"
        )
    if not has_format(path):
        raise FileError(
            f"{path}: has no suffix of a format that is read, expected "
            f"{', '.join((*_IMAGES, *_READERS))}; of bare bytes name the layout, as in "
            f"{path.name}:480x640:Mono16"
        )
    if path.name.lower().endswith((".ome.tif", ".ome.tiff")):
        tiff.header(path)


class Settings(NamedTuple):
    """What an image was taken with; None where it is not known."""

    exposure_s: float | None = None
    temperature_c: float | None = None


def settings(path: Path) -> Settings:
    """Read exposure time and temperature from headers of FITS, EXIF of TIFF and raw files."""
    suffix = suffix_of(path)
    if suffix in WITH_HEADERS:
        return header(path).settings
    with reading(path):
        return Settings(_exposure_s(path) if suffix in (".tif", ".tiff") else None)


def _exposure_s(path: Path) -> float | None:
    """Exposure time of a TIFF, by the compiled reader in a tenth of the time of tifffile."""
    try:
        return _native.exposure_s(path)
    except FileError:
        return tiff.exposure_s(path)


_SAME = 0.01
"""Relative difference of exposure times that are the same: EXIF and people round them."""


def apart(index: int, one: float | None, other: float | None, tolerance: float) -> bool:
    """Whether two exposure times, or with index 1 temperatures, are known and differ."""
    if one is None or other is None:
        return False
    limit = tolerance if index else _SAME * max(abs(one), abs(other))
    return abs(one - other) > limit + 1e-9 * abs(one)


class Header(NamedTuple):
    """What a file holds beside its frames."""

    shape: tuple[int, int, int]
    """n, rows, cols."""
    dtype: np.dtype[Any]
    description: str
    """Text stored with the frames."""
    settings: Settings = Settings()
    image_type: fits.ImageType = fits.ImageType()
    """Of FITS files."""


def header(path: Path) -> Header:
    """Read what a file says of its frames, a TIFF in one go; the errors are of `frame_format`."""
    suffix = suffix_of(path)
    if not is_image(path):
        with reading(path):
            found = Header(*_reader(path).header(path))
            return found._replace(settings=Settings(*found.settings))
    if suffix in (".tif", ".tiff"):
        return Header(*tiff.header(path), settings(path))
    return Header(*frame_format(path), png.description(path) if suffix == ".png" else "")


def _frames(
    path: Path, workers: int | None, start: int = 0, stop: int | None = None
) -> Iterator[NDArray[Any]]:
    if not is_image(path):
        with reading(path):
            yield from _reader(path).stream_frames(path, start, stop)
        return
    check_image(path)
    with leaving_others(path):
        count, rows, cols, bits = _native.file_format(path)
        if count == 1 or count * rows * cols * bits <= 8 * _AT_ONCE:
            yield _native.read_file(path, workers)[start:stop]
            return
    yield from tiff.stream_frames(path, start, stop)


def _format(frames: NDArray[Any]) -> str:
    return f"{frames.shape[-2]} x {frames.shape[-1]} (rows x columns), {frames.dtype}"
