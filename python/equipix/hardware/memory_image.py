"""Tables as text for ``$readmemh``: one word a pixel, which packs coarse, offset and gain.

From the highest bit down a word is the coarse offset, the fine offset in two's complement, and the
gain; the address is row · cols + col. Flags of a pixel follow its word as a comment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import FileError
from equipix.hardware.content import Content, header, made, read_header
from equipix.hardware.words import Format

if TYPE_CHECKING:
    from pathlib import Path

    from equipix._types import Array

_FIRST = "// equipix table: "


def encoded(content: Content, _name: str) -> bytes:
    """Bytes of a file."""
    f = content.format
    offset = content.offset.astype(np.int64) & (2**f.offset_bits - 1)
    packed = (content.coarse.astype(np.int64) << f.offset_bits | offset) << f.gain_bits
    packed |= content.gain
    digits = -(-(f.dac_bits + f.offset_bits + f.gain_bits) // 4)
    lines = [f"{_FIRST}{header(content)}", f"// {_fields(f)}"]
    for word, flags in zip(packed.flat, content.flags.flat, strict=True):
        lines.append(f"{word:0{digits}x}" + (f" // {flags:08x}" if flags else ""))
    return "\n".join([*lines, ""]).encode()


def decoded(path: Path, data: bytes) -> Content:
    """Parse the bytes of a file."""
    first, *lines = data.decode().splitlines()
    if not first.startswith(_FIRST):
        raise FileError(f"{path}: holds no table that equipix has written")
    told = read_header(path, first.removeprefix(_FIRST))
    f = Format(**told["format"])
    parts = [line.partition("//") for line in lines if not line.startswith("//")]
    packed = np.array([int(word, 16) for word, _, _ in parts], np.int64)
    flags = np.array([int(flags or "0", 16) for _, _, flags in parts], np.int64)
    if np.any(packed >= 2 ** (f.dac_bits + f.offset_bits + f.gain_bits)):
        raise FileError(f"{path}: holds words wider than its header says")
    offset = packed >> f.gain_bits & (2**f.offset_bits - 1)
    arrays: dict[str, Array] = {
        "coarse": packed >> (f.offset_bits + f.gain_bits),
        "offset": offset - (offset >> (f.offset_bits - 1) << f.offset_bits),
        "gain": packed & (2**f.gain_bits - 1),
        "flags": flags,
    }
    return made(path, told, arrays)


def _fields(f: Format) -> str:
    """Where the fields of a word are."""
    gain, offset = f.gain_bits, f.gain_bits + f.offset_bits
    top = offset + f.dac_bits - 1
    return f"coarse [{top}:{offset}], offset [{offset - 1}:{gain}], gain [{gain - 1}:0]"
