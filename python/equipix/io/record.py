"""Checks of saved arrays and metadata: format, names, dtypes, shapes, checksums."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix.errors import FileError

KEY = "crc32"
"""Name of the checksum in the metadata of a file."""


def checksum(pages: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any]) -> int:
    """CRC-32 of the metadata, and of the name, type, shape and bytes of each array.

    Bytes count in little-endian order, which the type of another machine does not change.
    """
    total = zlib.crc32(json.dumps(dict(metadata)).encode())
    for name, array in pages.items():
        plain = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        header = json.dumps([name, plain.dtype.str, plain.shape])
        total = zlib.crc32(plain.data, zlib.crc32(header.encode(), total))
    return total


def _check_sum(
    path: Path, pages: Mapping[str, NDArray[Any]], metadata: Mapping[str, Any], wanted: object
) -> None:
    """Refuse arrays and metadata that are not those that were written."""
    if checksum(pages, metadata) != wanted:
        raise FileError(
            f"{path}: is damaged: its arrays or metadata differ from its checksum: use a copy, or "
            "make it anew"
        )


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
