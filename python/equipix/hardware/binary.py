"""Tables as binary files: the memories one behind the other, for a loader.

All numbers are little-endian. After the magic ``EQXT`` come, as 32-bit numbers, the length of the
header and the header itself, one line of JSON; then the words of the coarse offset, the fine
offset and the gain, row by row, as one byte each where the width is 8 bits, else two; then the
flags, four bytes a pixel.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import FileError
from equipix.hardware.content import DTYPES, Content, header, made, read_header
from equipix.hardware.words import Format

if TYPE_CHECKING:
    from pathlib import Path

    from equipix._types import Array

_MAGIC = b"EQXT"


def encoded(content: Content) -> bytes:
    """Bytes of a file."""
    told = header(content).encode()
    stored = _stored(content.format)
    parts = [content.arrays()[name].astype(dtype).tobytes() for name, dtype in stored.items()]
    return b"".join([_MAGIC, struct.pack("<I", len(told)), told, *parts])


def decoded(path: Path, data: bytes) -> Content:
    """Parse the bytes of a file."""
    if data[:4] != _MAGIC:
        raise FileError(f"{path}: holds no table that equipix has written")
    start = 8 + int(struct.unpack_from("<I", data, 4)[0])
    told = read_header(path, data[8:start].decode())
    size, stored = int(told["rows"]) * int(told["cols"]), _stored(Format(**told["format"]))
    wanted = start + size * sum(dtype.itemsize for dtype in stored.values())
    if len(data) != wanted:
        raise FileError(
            f"{path}: holds {len(data)} bytes, expected {wanted} for {told['rows']} x "
            f"{told['cols']} pixels: of another size, or incomplete"
        )
    arrays: dict[str, Array] = {}
    for name, dtype in stored.items():
        arrays[name] = np.frombuffer(data, dtype, size, start)
        start += size * dtype.itemsize
    return made(path, told, arrays)


def _stored(widths: Format) -> dict[str, np.dtype[np.generic]]:
    """Type of each array in the file."""
    bits = {"coarse": widths.dac_bits, "offset": widths.offset_bits, "gain": widths.gain_bits}
    found = {}
    for name, dtype in DTYPES.items():
        full = np.dtype(dtype)
        narrow = bits.get(name, 32) <= 8
        found[name] = np.dtype(f"{full.kind}1") if narrow else full.newbyteorder("<")
    return found
