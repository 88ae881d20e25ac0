"""Files of named arrays with metadata: formats by suffix."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix.errors import FileError, InputError
from equipix.io import tiff
from equipix.io.frames import Header, frame_format, header
from equipix.io.paths import as_path, reading, write_whole
from equipix.io.record import KEY, _check_sum, checksum


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
        return _kind(read(path))


def _kind(description: str) -> str | None:
    """Kind of content that the text of a file names."""
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
    _refuse_kind(path, saved_kind(path))


def _refuse_kind(path: Path, kind: str | None) -> None:
    if kind is not None:
        article = "" if kind.endswith("s") else "a "
        raise FileError(f"{path}: holds {article}{kind}, expected raw frames")


def raw_header(path: Path) -> Header:
    """Shape, dtype and text of raw frames; what `save_pages` wrote is refused like there."""
    if path.suffix.lower() == ".npz":
        refuse_saved(path)
    found = header(path)
    _refuse_kind(path, _kind(found.description) if found.dtype.kind == "f" else None)
    return found


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
