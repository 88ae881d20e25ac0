"""Tables as binary files: the memories one behind the other, for a loader.

All numbers are little-endian. After the magic ``EQXT`` come the length of the header, a 32-bit
number, and the header itself, one line of JSON padded with spaces; then the words of the coarse
offset, the fine offset and the gain, row by row, as one byte each where the width is 8 bits, else
two; then the flags, four bytes a pixel. Each of these four memories starts at a multiple of 16
bytes, so that a loader can map it; zeros fill the gaps.
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

_LENGTH = struct.Struct("<I")
"""Length of the header."""

_FIXED = len(_MAGIC) + _LENGTH.size
"""Bytes ahead of the header."""

_ALIGNED = 16
"""Each memory starts at a multiple of this, in bytes."""


def encoded(content: Content, _name: str) -> bytes:
    """Bytes of a file."""
    text = header(content).encode()
    text = text.ljust(_aligned(_FIXED + len(text)) - _FIXED)
    parts = [_MAGIC, _LENGTH.pack(len(text)), text]
    for name, dtype in _stored(content.format).items():
        memory = content.arrays()[name].astype(dtype).tobytes()
        parts.append(memory.ljust(_aligned(len(memory)), b"\0"))
    return b"".join(parts)


def decoded(path: Path, data: bytes) -> Content:
    """Parse the bytes of a file."""
    if data[:4] != _MAGIC:
        raise FileError(f"{path}: holds no table that equipix has written")
    if len(data) < _FIXED:
        raise FileError(f"{path}: holds {len(data)} bytes, less than the header: incomplete")
    start = _FIXED + int(_LENGTH.unpack_from(data, len(_MAGIC))[0])
    fields = read_header(path, data[_FIXED:start].decode())
    size, stored = int(fields["rows"]) * int(fields["cols"]), _stored(Format(**fields["format"]))
    wanted = start + sum(_aligned(size * dtype.itemsize) for dtype in stored.values())
    if len(data) != wanted:
        raise FileError(
            f"{path}: holds {len(data)} bytes, expected {wanted} for {fields['rows']} x "
            f"{fields['cols']} pixels: of another size, or incomplete"
        )
    arrays: dict[str, Array] = {}
    for name, dtype in stored.items():
        arrays[name] = np.frombuffer(data, dtype, size, start)
        start += _aligned(size * dtype.itemsize)
    return made(path, fields, arrays)


def _aligned(size: int) -> int:
    """Next multiple of the alignment."""
    return -(-size // _ALIGNED) * _ALIGNED


def _stored(widths: Format) -> dict[str, np.dtype[np.generic]]:
    """Type of each array in the file."""
    bits = {"coarse": widths.dac_bits, "offset": widths.offset_bits, "gain": widths.gain_bits}
    found = {}
    for name, dtype in DTYPES.items():
        full = np.dtype(dtype)
        narrow = bits.get(name, 32) <= 8
        found[name] = np.dtype(f"{full.kind}1") if narrow else full.newbyteorder("<")
    return found
