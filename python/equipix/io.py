"""Frames, arrays and metadata to and from files: the only module that imports tifffile."""

from __future__ import annotations

import glob
import json
import logging
import os
import re
import threading
import uuid
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

from equipix import _native
from equipix.errors import EquipixError, FileError, InputError, UnsupportedFileError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from os import PathLike

    from numpy.typing import NDArray

_PAGE_NAME = 285  # TIFF tag
_SUBFILE_TYPE = 255  # TIFF tag
_PHOTOMETRIC = 262  # TIFF tag
_MAX_COMPRESSION = 4096  # no lossless coding packs tighter
_TIFF_LIMIT = 2**32 - 2**25  # bytes of pixels that still leave room for the directories


def find_files(
    source: str | PathLike[str] | Iterable[str | PathLike[str]], *, folder: Path = Path()
) -> list[Path]:
    """Files that a path, a glob or a list of these names; a glob's in natural order.

    Parameters
    ----------
    source : path, or iterable of paths
        A name with ``*``, ``?`` or ``[`` is a glob, unless a file has just that name.
    folder : Path, optional
        Where relative names start.

    Returns
    -------
    list of Path
        At least one file; a list keeps its order, and ``f2`` stands before ``f10`` in a glob.

    Raises
    ------
    FileError
        If a file does not exist or a glob matches nothing.
    InputError
        If there is no name, or something else than a name.
    """
    names = [source] if isinstance(source, str | bytes | os.PathLike) else source
    found = [path for name in names for path in _matches(name, folder)]
    if not found:
        raise InputError("'source' names no file")
    return found


def _matches(name: str | PathLike[str], folder: Path) -> list[Path]:
    pattern = str(as_path("source", name))
    path = folder / pattern
    if path.is_dir():
        raise FileError(f"{path}: is a folder, expected files: name them by a glob, {path}/*.tif")
    if path.exists():
        return [path]
    if not glob.has_magic(pattern):
        raise FileError(f"{path}: does not exist")
    # Unlike Path.glob, this leaves out hidden files, as a shell does.
    found = glob.glob(pattern, root_dir=folder, recursive=True)  # noqa: PTH207
    if not found:
        raise FileError(f"{path}: no file matches")
    return sorted((folder / match for match in found), key=_natural)


def as_path(name: str, value: object) -> Path:
    """Take an argument for the name of a file.

    Raises
    ------
    InputError
        If it is no name, or none that a file can have.
    """
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or "\0" in text:
        raise InputError(f"'{name}' holds {value!r}, expected the name of a file")
    return Path(text)


def _natural(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"([0-9]+)", str(path))
    return [(int(part), part) if part[:1].isdecimal() else (-1, part) for part in parts]


def read_frames(
    source: str | PathLike[str] | Iterable[str | PathLike[str]], *, workers: int | None = None
) -> NDArray[Any]:
    """All frames of some files at once; `equipix.average` takes them without holding them.

    Parameters
    ----------
    source : path, glob, or list of these
        Files as in `find_files`.
    workers : int, optional
        Number of threads; by default one for each processor.

    Returns
    -------
    ndarray, shape (n, rows, cols)
        The numbers in the files, in their own dtype.

    Raises
    ------
    FileError
        If a file cannot be read or differs from the first in shape or dtype.
    """
    return np.concatenate([frames for _, frames in stream_frames(source, workers=workers)])


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


def frame_format(path: Path) -> tuple[tuple[int, int, int], np.dtype[Any]]:
    """Shape (n, rows, cols) and dtype of the frames of a file, none of which is decoded.

    Raises
    ------
    FileError
        If the file cannot be read or holds no grey image.
    """
    try:
        count, rows, cols, bits = _native.file_format(path)
    except UnsupportedFileError:
        with _reading(path), tifffile.TiffFile(path) as file:
            page: Any = file.pages[0]
            _check_page(path, page, file.filehandle.size)
            count = max(len(file.pages), file.series[0].size // page.size)
            return (count, *page.shape), page.dtype
    return (count, rows, cols), np.dtype(f"uint{bits}")


def _frames(path: Path, workers: int | None) -> Iterator[NDArray[Any]]:
    try:
        yield _native.read_file(path, workers)
    except UnsupportedFileError:
        yield from _tiff_frames(path)


def _format(frames: NDArray[Any]) -> str:
    return f"{frames.shape[-2]} x {frames.shape[-1]} (rows x columns), {frames.dtype}"


def _tiff_frames(path: Path) -> Iterator[NDArray[Any]]:
    with _reading(path), tifffile.TiffFile(path) as file:
        pages = len(file.pages)
        if pages == 0:
            raise FileError(f"{path}: is broken: it has no pages")
        for page in file.pages:
            _check_page(path, page, file.filehandle.size)
        if pages == 1 and file.series[0].size > file.pages[0].size:
            # A stack with a directory for its first frame only: mapped, not read at once.
            yield from tifffile.memmap(path, mode="r")[..., None, :, :].reshape(
                -1, 1, *file.pages[0].shape
            )
            return
        for page in file.pages:
            frame = page.asarray()
            if frame.shape != page.shape:  # tifffile's way to say that the pixels are not there
                raise FileError(f"{path}: is broken: a page has no pixels")
            yield frame[None]


def _check_page(path: Path, page: Any, length: int) -> None:
    """Refuse what the compiled reader refuses: colour, white at 0, and what is no frame."""
    old_type = page.tags.valueof(_SUBFILE_TYPE, default=1)
    if page.is_reduced or page.is_mask or page.subifds or old_type == 2:
        raise FileError(
            f"{path}: holds a reduced copy or a mask beside its frames, expected frames only:"
            " export them to a file of their own"
        )
    if _PHOTOMETRIC in page.tags and page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        raise FileError(f"{path}: has white at 0 (MinIsWhite), expected black at 0")
    grey = _PHOTOMETRIC not in page.tags or page.photometric == tifffile.PHOTOMETRIC.MINISBLACK
    if not grey or page.samplesperpixel != 1 or page.ndim != 2:
        raise FileError(
            f"{path}: is {page.photometric.name} of shape {page.shape}, expected one grey channel"
        )
    if page.nbytes > _MAX_COMPRESSION * length:
        raise FileError(f"{path}: claims {page.nbytes} bytes of pixels in a file of {length}")


class _Complaints(logging.Handler):
    """What tifffile logs instead of raising, such as a last page that it leaves out."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.thread = threading.get_ident()
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the message."""
        if record.thread == self.thread:
            self.messages.append(record.getMessage())


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever a reader raises or logs about a broken file into an error that names it."""
    complaints = _Complaints()
    logger = logging.getLogger("tifffile")
    logger.addHandler(complaints)
    try:
        yield
    except EquipixError:
        raise
    except Exception as error:
        hint = "; pip install 'equipix[codecs]'" if "imagecodecs" in str(error) else ""
        raise FileError(f"{path}: cannot be read: {error}{hint}") from error
    finally:
        logger.removeHandler(complaints)
    if complaints.messages:
        raise FileError(f"{path}: is broken: {complaints.messages[0]}")


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Refuse to write over a file that the work reads.

    Raises
    ------
    FileError
        If an output is one of the inputs, by whatever name.
    """
    taken = {path.resolve() for path in inputs}
    for path in outputs:
        if path.resolve() in taken:
            raise FileError(f"{path}: is one of the inputs: name another output")


def beside(target: Path) -> Path:
    """Give a hidden name in the folder of `target` that nothing else has, of the same suffix."""
    return target.parent / f".{uuid.uuid4().hex}{target.suffix}"


@contextmanager
def write_whole(path: str | PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """Give a file's place to a new version in one step, when all of it is written.

    Parameters
    ----------
    path : path
        Where the file is to be.
    force : bool, optional
        Replace a file that is there.

    Yields
    ------
    Path
        Where to write it; moved to `path` at the end, removed after an exception.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    InputError
        If `path` is not the name of a file.
    """
    target = as_path("path", path)
    temporary = beside(target)
    try:
        if target.is_dir():
            raise FileError(f"{target}: is a folder, expected the name of a file")
        if target.exists() and not force:
            raise FileError(f"{target}: exists already; force=True (--force) replaces it")
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(target)
    except EquipixError:
        raise
    except OSError as error:
        raise FileError(f"{target}: cannot be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def save_pages(
    path: str | PathLike[str],
    pages: Mapping[str, NDArray[Any]],
    metadata: Mapping[str, Any],
    *,
    force: bool = False,
) -> None:
    """Write named arrays and metadata to a .tif or .npz file, which appears whole or not at all.

    Parameters
    ----------
    path : path
        Output; its suffix names the format.
    pages : mapping of str to ndarray
        Arrays by name, each kept in its own dtype; of shape (rows, cols) in a TIFF.
    metadata : mapping
        JSON values; in a TIFF they are the first page's description.
    force : bool, optional
        Replace a file that is there.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    InputError
        If the suffix is unknown or a page is not an array of numbers in two dimensions.
    """
    write = _WRITERS.get(as_path("path", path).suffix.lower())
    if write is None:
        raise InputError(f"'path' is {os.fspath(path)!r}, expected the suffix .tif or .npz")
    for name, array in pages.items():
        if array.ndim != 2 or array.dtype.kind not in "iuf":
            raise InputError(
                f"page '{name}' is {array.dtype} of shape {array.shape}, expected numbers in two"
                " dimensions"
            )
    description = json.dumps(dict(metadata))
    with write_whole(path, force=force) as temporary:
        write(temporary, pages, description)


def load_pages(path: str | PathLike[str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read what `save_pages` wrote.

    Parameters
    ----------
    path : path
        A .tif or .npz file.

    Returns
    -------
    pages : dict of str to ndarray
        The arrays by name.
    metadata : dict
        The metadata.

    Raises
    ------
    FileError
        If the file is not readable or was not written by `save_pages`.
    InputError
        If the suffix is unknown.
    """
    path = as_path("path", path)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"'path' is {str(path)!r}, expected the suffix .tif or .npz")
    with _reading(path):
        pages, description = read(path)
    try:
        metadata = json.loads(description)
    except ValueError as error:
        raise FileError(f"{path}: was not written by equipix: it lacks its metadata") from error
    return pages, metadata


def check_format(path: str | PathLike[str], content: object, kind: str, newest: int) -> None:
    """Refuse the metadata of another kind of file than `kind`, or of a format above `newest`.

    Raises
    ------
    FileError
        If the metadata are not of such a file.
    """
    if not isinstance(content, dict) or content.get("kind") != kind:
        raise FileError(f"{path}: holds something else than {kind} that equipix has saved")
    number = content.get("format")
    if not isinstance(number, int) or isinstance(number, bool) or number < 1:
        raise FileError(f"{path}: is damaged: its format is {number!r}, expected a whole number")
    if number > newest:
        raise FileError(
            f"{path}: has format {number}, this version of equipix reads up to {newest}: install"
            " a newer one"
        )


def check_pages(
    path: str | PathLike[str], pages: Mapping[str, NDArray[Any]], wanted: Mapping[str, type]
) -> None:
    """Refuse pages that lack one of those wanted, or are not all maps of one sensor.

    Parameters
    ----------
    path : path
        The file they are from.
    pages : mapping of str to ndarray
        Arrays by name.
    wanted : mapping of str to type
        Dtype, or kind of dtype, of each page that must be there.

    Raises
    ------
    FileError
        If a page is missing, or has another dtype, rank or shape.
    """
    shape = None
    for name, dtype in wanted.items():
        if name not in pages:
            raise FileError(f"{path}: is damaged: lacks the page '{name}'")
        page = pages[name]
        shape = shape or page.shape
        if page.ndim != 2 or page.shape != shape or not np.issubdtype(page.dtype, dtype):
            raise FileError(
                f"{path}: is damaged: page '{name}' is {page.dtype} of shape {page.shape},"
                f" expected {dtype.__name__} in two dimensions, as large as '{next(iter(wanted))}'"
            )


def write_frames(path: str | PathLike[str], frames: Iterable[NDArray[Any]], *, nbytes: int) -> None:
    """Write frames as the pages of a TIFF file, holding one at a time.

    Parameters
    ----------
    path : path
        Output, written in place: give it a folder that nobody reads yet.
    frames : iterable of ndarray, shape (rows, cols)
        The frames.
    nbytes : int
        Bytes of all frames together; above 4 GB they need BigTIFF.
    """
    with tifffile.TiffWriter(path, bigtiff=nbytes > _TIFF_LIMIT) as file:
        for frame in frames:
            file.write(frame, photometric="minisblack", metadata=None)


def _write_tiff(path: Path, pages: Mapping[str, NDArray[Any]], description: str) -> None:
    big = sum(array.nbytes for array in pages.values()) > _TIFF_LIMIT
    with tifffile.TiffWriter(path, bigtiff=big) as file:
        for name, array in pages.items():
            file.write(
                array,
                photometric="minisblack",
                metadata=None,
                description=description,
                extratags=[(_PAGE_NAME, "s", 0, name, True)],
            )
            description = ""


def _read_tiff(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    with tifffile.TiffFile(path) as file:
        every: Sequence[Any] = file.pages
        pages = {page.tags[_PAGE_NAME].value: page.asarray() for page in every}
        return pages, every[0].description


def _write_npz(path: Path, pages: Mapping[str, NDArray[Any]], description: str) -> None:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, metadata=np.array(description), **pages)


def _read_npz(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        pages = {name: file[name] for name in file.files}
    return pages, str(pages.pop("metadata"))


SUFFIXES = (".tif", ".tiff", ".npz")
"""Formats of `save_pages`."""

_WRITERS = {".tif": _write_tiff, ".tiff": _write_tiff, ".npz": _write_npz}
_READERS = {".tif": _read_tiff, ".tiff": _read_tiff, ".npz": _read_npz}
