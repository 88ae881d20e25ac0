"""Frames and masks from image files, by whichever reader decodes them."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from equipix import _native
from equipix.errors import FileError, UnsupportedFileError
from equipix.io import arrays, fits, png, tiff
from equipix.io.paths import as_path, find_files, reading

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


_READERS = {
    **dict.fromkeys(arrays.SUFFIXES, arrays),
    **dict.fromkeys(fits.SUFFIXES, fits),
}
"""The module that reads each kind of file besides images: ``header`` and ``stream_frames``."""


def is_image(path: Path) -> bool:
    """Whether a file is an image, which the compiled reader or tifffile decodes."""
    return suffix_of(path) not in _READERS


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


class Header(NamedTuple):
    """Shape (n, rows, cols) and dtype of the frames of a file, and the text stored with them."""

    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    description: str


def header(path: Path) -> Header:
    """Read what a file says of its frames, a TIFF in one go; the errors are of `frame_format`."""
    suffix = suffix_of(path)
    if not is_image(path):
        with reading(path):
            return Header(*_READERS[suffix].header(path))
    if suffix in (".tif", ".tiff"):
        return Header(*tiff.header(path))
    return Header(*frame_format(path), png.description(path) if suffix == ".png" else "")


def _frames(path: Path, workers: int | None) -> Iterator[NDArray[Any]]:
    if not is_image(path):
        with reading(path):
            yield from _READERS[suffix_of(path)].stream_frames(path)
        return
    with leaving_others(path):
        count, rows, cols, bits = _native.file_format(path)
        if count == 1 or count * rows * cols * bits <= 8 * _AT_ONCE:
            yield _native.read_file(path, workers)
            return
    yield from tiff.stream_frames(path)


def _format(frames: NDArray[Any]) -> str:
    return f"{frames.shape[-2]} x {frames.shape[-1]} (rows x columns), {frames.dtype}"


def read_mask(path: str | PathLike[str]) -> NDArray[np.bool_]:
    """Read which pixels must not be used: those that are not 0 in the file.

    Parameters
    ----------
    path : path
        One grey image (TIFF, PNG, PGM or BMP), or a NumPy array (.npy) of two dimensions.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True = do not use.

    Raises
    ------
    FileError
        If the file cannot be read or holds no single image.
    """
    file = as_path("mask", path)
    array = _array(file) if file.suffix.lower() == ".npy" else read_frames(file)
    if array.ndim == 3 and len(array) == 1:
        array = array[0]
    if array.ndim != 2 or array.dtype.kind not in "buif":
        raise FileError(
            f"{file}: holds {array.dtype} of shape {array.shape}, expected one mask of shape "
            "(rows, cols), in which pixels that are not 0 must not be used"
        )
    mask: NDArray[np.bool_] = array != 0
    return mask


def _array(file: Path) -> NDArray[Any]:
    with reading(file), file.open("rb") as stream:
        if stream.read(6) != np.lib.format.MAGIC_PREFIX:
            raise FileError(f"{file}: is no .npy file, whatever its name says")
        stream.seek(0)
        return np.asarray(np.load(stream, allow_pickle=False))
