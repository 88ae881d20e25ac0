"""Named arrays with metadata, to and from the files that equipix saves."""

from __future__ import annotations

import json
import os
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.errors import FileError, InputError
from equipix.io import tiff
from equipix.io.checksum import KEY, checksum
from equipix.io.images import frame_format
from equipix.io.names import as_path
from equipix.io.reading import reading
from equipix.io.whole import write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike
    from pathlib import Path

    from numpy.typing import NDArray


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
        Arrays by name, each kept in its own dtype: of shape (rows, cols), or a stack of shape
        (n, rows, cols), whose images are pages of their own in a TIFF.
    metadata : mapping
        JSON values; in a TIFF they are the first page's description. A checksum of arrays and
        metadata is added to them.
    force : bool, optional
        Replace a file that is there.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    InputError
        If the suffix is unknown or a page is not an array of numbers in two or three dimensions.
    """
    write = _WRITERS.get(as_path("path", path).suffix.lower())
    if write is None:
        raise InputError(f"'path' is {os.fspath(path)!r}, expected the suffix .tif or .npz")
    for name, array in pages.items():
        if array.ndim not in (2, 3) or array.dtype.kind not in "iuf" or array.size == 0:
            raise InputError(
                f"page '{name}' is {array.dtype} of shape {array.shape}, expected numbers in two"
                " dimensions or a stack of such images"
            )
    if KEY in metadata:
        raise InputError(f"'metadata' has a key {KEY!r}, which is that of the checksum: rename it")
    description = json.dumps({**metadata, KEY: checksum(pages, metadata)})
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
        If the file is not readable, was not written by `save_pages`, or differs from its checksum.
        A file written before there were checksums has none.
    InputError
        If the suffix is unknown.
    """
    path = as_path("path", path)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(
            f"{path}: ends in '{path.suffix}', expected a .tif or .npz file that equipix has saved"
        )
    with reading(path):
        pages, description = read(path)
    try:
        metadata = json.loads(description)
    except ValueError as error:
        raise FileError(
            f"{path}: holds neither a correction nor frame statistics: equipix did not write it"
        ) from error
    if isinstance(metadata, dict) and KEY in metadata:
        _check_sum(path, pages, metadata, metadata.pop(KEY))
    return pages, metadata


def _check_sum(
    path: Path, pages: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any], wanted: object
) -> None:
    """Refuse arrays and metadata that are not those that were written."""
    if checksum(pages, metadata) != wanted:
        raise FileError(
            f"{path}: is damaged: its arrays or metadata differ from its checksum: use a copy, or "
            "make it anew"
        )


def kind_of(path: Path) -> str | None:
    """Kind of content in a file that `save_pages` wrote, of which no array is read; else None.

    Raises
    ------
    FileError
        If the file is not readable.
    """
    read = _DESCRIPTIONS.get(path.suffix.lower())
    if read is None:
        return None
    with reading(path):
        description = read(path)
    try:
        content = json.loads(description)
    except ValueError:
        return None
    kind = content.get("kind") if isinstance(content, dict) else None
    return kind if isinstance(kind, str) else None


def saved_kind(path: Path) -> str | None:
    """Kind of content in a file that stands in the place of frames; None of other files.

    Files of whole numbers, which cameras write, are not searched.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES or (suffix != ".npz" and frame_format(path)[1].kind != "f"):
        return None
    return kind_of(path)


def refuse_saved(path: Path) -> None:
    """Refuse a file that `save_pages` wrote where images are expected.

    Raises
    ------
    FileError
        With what the file holds.
    """
    kind = saved_kind(path)
    if kind is not None:
        article = "" if kind.endswith("s") else "a "
        raise FileError(f"{path}: holds {article}{kind}, expected raw frames")


def check_format(path: str | PathLike[str], content: object, kind: str, newest: int) -> None:
    """Refuse the metadata of another kind of file than `kind`, or of a format above `newest`.

    Raises
    ------
    FileError
        If the metadata are not of such a file.
    """
    if not isinstance(content, dict) or content.get("kind") != kind:
        held = content.get("kind") if isinstance(content, dict) else None
        raise FileError(
            f"{path}: holds {held or 'something else'}, expected {kind} that equipix has saved"
        )
    number = content.get("format")
    if not isinstance(number, int) or isinstance(number, bool) or number < 1:
        raise FileError(f"{path}: is damaged: its format is {number!r}, expected a whole number")
    if number > newest:
        raise FileError(
            f"{path}: has format {number}, this version of equipix reads up to {newest}: install"
            " a newer one"
        )


def check_pages(
    path: str | PathLike[str],
    pages: Mapping[str, NDArray[Any]],
    wanted: Mapping[str, type],
    stacks: Mapping[str, type] | None = None,
) -> None:
    """Refuse pages without those required, or that are not all maps of one sensor.

    Parameters
    ----------
    path : path
        The file they are from.
    pages : mapping of str to ndarray
        Arrays by name.
    wanted : mapping of str to type
        Dtype, or kind of dtype, of each page of shape (rows, cols) that must be there.
    stacks : mapping of str to type, optional
        The same of pages of shape (n, rows, cols).

    Raises
    ------
    FileError
        If a page is missing, or has another dtype, rank or shape.
    """
    first = next(iter(wanted))
    for name, dtype in {**wanted, **(stacks or {})}.items():
        if name not in pages:
            raise FileError(f"{path}: is damaged: lacks the page '{name}'")
        page, (ndim, word) = pages[name], (2, "two") if name in wanted else (3, "three")
        fits = page.ndim == ndim and page.shape[-2:] == pages[first].shape
        if not (fits and np.issubdtype(page.dtype, dtype)):
            raise FileError(
                f"{path}: is damaged: page '{name}' is {page.dtype} of shape {page.shape},"
                f" expected {dtype.__name__} in {word} dimensions, as large as '{first}'"
            )


def _write_npz(path: Path, pages: Mapping[str, NDArray[Any]], description: str) -> None:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, metadata=np.array(description), **pages)


def _check_npz(path: Path) -> None:
    """Refuse another kind of file before NumPy takes it for pickled objects."""
    if not path.exists():
        raise FileError(f"{path}: does not exist")
    if not zipfile.is_zipfile(path):
        raise FileError(f"{path}: is no .npz file, whatever its name says")


def _read_npz(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    _check_npz(path)
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        pages = {name: file[name] for name in file.files}
    return pages, str(pages.pop("metadata", ""))


def _description_of_npz(path: Path) -> str:
    _check_npz(path)
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        return str(file["metadata"]) if "metadata" in file.files else ""


SUFFIXES = (".tif", ".tiff", ".npz")
"""Formats of `save_pages`."""

_WRITERS = {".tif": tiff.write_pages, ".tiff": tiff.write_pages, ".npz": _write_npz}
_READERS = {".tif": tiff.read_pages, ".tiff": tiff.read_pages, ".npz": _read_npz}
_DESCRIPTIONS = {
    ".tif": tiff.description,
    ".tiff": tiff.description,
    ".npz": _description_of_npz,
}
