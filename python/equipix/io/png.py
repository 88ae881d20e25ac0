"""Grey PNG pictures of 8 or 16 bits, written with the standard library, and their descriptions."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix.io.paths import reading

_SIGNATURE = b"\x89PNG\r\n\x1a\n"

_LEVEL = 6  # of the compression

_KEYWORD = b"Description\0"

_LONGEST = 4096  # bytes of text that are read


def write_png(path: Path, frame: NDArray[Any], *, description: str) -> None:
    """Write one frame.

    Parameters
    ----------
    path : Path
        Output, written in place: use a folder that no other process reads.
    frame : ndarray, shape (rows, cols), uint8 or uint16
        The frame.
    description : str
        ASCII text, stored with the picture.
    """
    rows, cols = frame.shape
    header = struct.pack(">IIBBBBB", cols, rows, 8 * frame.itemsize, 0, 0, 0, 0)
    samples = np.ascontiguousarray(frame, dtype=frame.dtype.newbyteorder(">"))
    lines = samples.view(np.uint8).reshape(rows, -1)
    # Each line begins with the number of its filter: none.
    data = zlib.compress(np.pad(lines, ((0, 0), (1, 0))).tobytes(), _LEVEL)
    text = _KEYWORD + description.encode("ascii")
    chunks = ((b"IHDR", header), (b"tEXt", text), (b"IDAT", data), (b"IEND", b""))
    path.write_bytes(_SIGNATURE + b"".join(_chunk(*chunk) for chunk in chunks))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def description(path: Path) -> str:
    """Text stored with a picture before its samples; empty where there is none."""
    with reading(path), path.open("rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            return ""
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind == b"IDAT":
                return ""
            text = file.read(min(length, _LONGEST))
            if kind == b"tEXt" and text.startswith(_KEYWORD):
                return text.removeprefix(_KEYWORD).decode("latin-1")
            file.seek(length - len(text) + 4, 1)
    return ""
