"""Files of records, rewritten: checksums fit, so that other checks are what refuses them."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.io.formats import load_pages, save_pages

if TYPE_CHECKING:
    from pathlib import Path


def rewrite(
    path: Path,
    fields: dict[str, Any] | None = None,
    arrays: dict[str, np.ndarray | None] | None = None,
    **content: Any,
) -> None:
    """Replace JSON values of fields, arrays (None removes one) and other parts of a record."""
    pages, held = load_pages(path)
    for name, value in (fields or {}).items():
        *above, last = name.split(".")
        place(held, above)[last] = value
    for name, array in (arrays or {}).items():
        *above, last = name.split(".")
        if array is None:
            del pages[name]
            continue
        stored = array.view(np.uint8) if array.dtype == bool else array
        pages[name] = np.atleast_2d(stored)
        crc = zlib.crc32(np.ascontiguousarray(array).tobytes())
        place(held, above)[last] = {
            "dtype": array.dtype.name,
            "shape": [*array.shape],
            "crc32": crc,
        }
    save_pages(path, pages, held | content, force=True)


def place(held: dict[str, Any], names: list[str]) -> Any:
    """The mapping of the metadata that holds the fields of a part of a record."""
    found = held["fields"]
    for name in names:
        found = found[name]
    return found
