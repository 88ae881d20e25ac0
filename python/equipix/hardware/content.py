"""What a file of a table holds, and its checks, whatever the format."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from equipix.errors import FileError, InputError
from equipix.flags import usable
from equipix.hardware.words import Format

if TYPE_CHECKING:
    from pathlib import Path

    from equipix._types import Array

NEWEST = 1
"""Format number of the files that this version writes."""

DTYPES = {"coarse": np.uint16, "offset": np.int16, "gain": np.uint16, "flags": np.uint32}
"""Type of each array, in the order of the files."""


class Content(NamedTuple):
    """The parts of a table."""

    format: Format
    coarse: Array
    offset: Array
    gain: Array
    flags: Array
    metadata: dict[str, Any]

    def arrays(self) -> dict[str, Array]:
        """Arrays by name."""
        return {name: getattr(self, name) for name in DTYPES}


def check_words(content: Content) -> None:
    """Refuse arrays that do not fit together.

    Raises
    ------
    InputError
        If a type or a size is another, or words do not fit their widths.
    """
    for name, dtype in DTYPES.items():
        array = content.arrays()[name]
        if array.dtype != dtype or array.ndim != 2 or array.shape != content.gain.shape:
            raise InputError(
                f"'{name}' is {array.dtype} of shape {array.shape}, expected "
                f"{np.dtype(dtype)} of {content.gain.shape}"
            )
    f = content.format
    for name, bits in (
        ("coarse", f.dac_bits),
        ("offset", f.offset_bits - 1),
        ("gain", f.gain_bits),
    ):
        words = content.arrays()[name].astype(np.int32)
        if np.any((words >= 2**bits) | (words < -(2**bits))):
            raise InputError(f"'{name}' holds words of more than its width")
    if np.any((content.gain == 0) != ~usable(content.flags)):
        raise InputError("'gain' must be 0 where 'flags' has DO_NOT_USE, and only there")


def checksum(content: Content) -> int:
    """CRC-32 of format and metadata, then of the arrays as little-endian numbers of their types."""
    crc = zlib.crc32(json.dumps([asdict(content.format), content.metadata]).encode())
    for name, dtype in DTYPES.items():
        stored = content.arrays()[name].astype(np.dtype(dtype).newbyteorder("<"))
        crc = zlib.crc32(stored.tobytes(), crc)
    return crc


def header(content: Content) -> str:
    """Everything but the arrays, as one line of JSON.

    It is a comment in C: it neither begins nor ends one, and holds no trigraph.
    """
    rows, cols = content.gain.shape
    told = {
        "kind": "equipix table",
        "version": NEWEST,
        "rows": rows,
        "cols": cols,
        "format": asdict(content.format),
        "crc32": checksum(content),
        "metadata": content.metadata,
    }
    return json.dumps(told).replace("*", "\\u002a").replace("?", "\\u003f")


def read_header(path: Path, text: str) -> dict[str, Any]:
    """Parse the line that `header` made.

    Raises
    ------
    FileError
        If the file holds no table, or one of a newer version.
    """
    try:
        told = json.loads(text)
    except ValueError:
        told = None
    if not isinstance(told, dict) or told.get("kind") != "equipix table":
        raise FileError(f"{path}: holds no table that equipix has written")
    version = told.get("version")
    if version != NEWEST:
        raise FileError(
            f"{path}: is a table of version {version}, this equipix reads version {NEWEST}: write "
            "it again, or install another equipix"
        )
    return told


def made(path: Path, told: dict[str, Any], arrays: dict[str, Array]) -> Content:
    """Put header and arrays of a file together.

    Raises
    ------
    FileError
        If they do not fit together.
    """
    shape = (int(told["rows"]), int(told["cols"]))
    for name, values in arrays.items():
        if values.size != shape[0] * shape[1]:
            raise FileError(
                f"{path}: holds {values.size} words of '{name}', expected "
                f"{shape[0] * shape[1]} for {shape[0]} x {shape[1]} pixels: of another size, or "
                "incomplete"
            )
    shaped = {name: arrays[name].astype(dtype).reshape(shape) for name, dtype in DTYPES.items()}
    content = Content(Format(**told["format"]), **shaped, metadata=told["metadata"])
    if checksum(content) != told["crc32"]:
        raise FileError(f"{path}: is damaged: its words do not have the checksum of its header")
    return content
