"""Content of tables of words, checked; binary files and memory images.

Binary files are the memories one behind the other, for a loader.
All numbers are little-endian. After the magic ``EQXT`` come the length of the header, a 32-bit
number, and the header itself, one line of JSON padded with spaces; then the words of the coarse
offset, if there is a DAC, the fine offset and the gain, row by row, as one byte each where the
width is 8 bits, else two; then the flags, four bytes a pixel. Each of these memories starts at a
multiple of 16 bytes, so that a loader can map it; zeros fill the gaps.

Memory images are text for ``$readmemh``, one word a pixel. From the highest bit down a word is the
coarse offset, the fine offset in two's complement, and the gain; the address is row · cols + col.
Comments at the top state the formula and the order. Flags of a pixel follow its word as a comment.
"""

import json
import struct
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from equipix._check import Array, ReadOnly
from equipix.errors import FileError, InputError
from equipix.findings import Flag, usable
from equipix.hardware.words import Format

NEWEST = 1
"""Format number of the files that this version writes."""

_FOREIGN = "holds no table that equipix has written in the format of its name: name such a file"

DTYPES = {"coarse": np.uint16, "offset": np.int16, "gain": np.uint16, "flags": np.uint32}
"""Type of each array, in the order of the files."""


@dataclass(frozen=True, eq=False)
class Content(ReadOnly):
    """The parts of a table, as of `equipix.hardware.Table`.

    Raises
    ------
    InputError
        If a type or a size is another, or words do not fit their widths.
    """

    format: Format
    coarse: Array
    offset: Array
    gain: Array
    flags: Array
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together."""
        super().__post_init__()
        for name, dtype in DTYPES.items():
            array = getattr(self, name)
            if array.dtype != dtype or array.ndim != 2 or array.shape != self.gain.shape:
                raise InputError(
                    f"'{name}' is {array.dtype} of shape {array.shape}, expected "
                    f"{np.dtype(dtype)} of {self.gain.shape}"
                )
        for name, bits in self.format.stored.items():
            words = getattr(self, name).astype(np.int32)
            end = 2 ** (bits - (name == "offset"))
            if np.any((words >= end) | (words < -end)):
                raise InputError(f"'{name}' holds words of more than its width")
        if np.any((self.gain == 0) != ~usable(self.flags)):
            raise InputError("'gain' must be 0 where 'flags' has DO_NOT_USE, and only there")


def checksum(content: Content) -> int:
    """CRC-32 of format and metadata, then of the arrays as little-endian numbers of their types."""
    crc = zlib.crc32(json.dumps([asdict(content.format), content.metadata]).encode())
    for name, dtype in DTYPES.items():
        stored = getattr(content, name).astype(np.dtype(dtype).newbyteorder("<"))
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


def read_header(path: Path, text: str, first: str = "") -> dict[str, Any]:
    """Parse the line that `header` made.

    Raises
    ------
    FileError
        If the file holds no table, or one of a newer version.
    """
    try:
        told: Any = json.loads(text.removeprefix(first)) if text.startswith(first) else None
    except ValueError:
        told = None
    if not isinstance(told, dict) or told.get("kind") != "equipix table":
        raise FileError(f"{path}: {_FOREIGN}")
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
    if told["format"]["dac_bits"] == 0:
        arrays = {"coarse": np.zeros(shape, np.uint16), **arrays}
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


_MAGIC = b"EQXT"

_LENGTH = struct.Struct("<I")
"""Length of the header."""

_FIXED = len(_MAGIC) + _LENGTH.size
"""Bytes ahead of the header."""

_ALIGNED = 16
"""Each memory starts at a multiple of this, in bytes."""


def to_binary(content: Content, _name: str) -> bytes:
    """Bytes of a file."""
    text = header(content).encode()
    text = text.ljust(_aligned(_FIXED + len(text)) - _FIXED)
    parts = [_MAGIC, _LENGTH.pack(len(text)), text]
    for name, dtype in _stored(content.format).items():
        memory = getattr(content, name).astype(dtype).tobytes()
        parts.append(memory.ljust(_aligned(len(memory)), b"\0"))
    return b"".join(parts)


def from_binary(path: Path, data: bytes) -> Content:
    """Parse the bytes of a file."""
    if data[:4] != _MAGIC:
        raise FileError(f"{path}: {_FOREIGN}")
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


def memories(widths: Format) -> list[str]:
    """Names of the arrays that a file holds: without a DAC there are no coarse words."""
    return [name for name in DTYPES if name != "coarse" or widths.dac_bits]


def _stored(widths: Format) -> dict[str, np.dtype[np.generic]]:
    """Type of each array in the file."""
    found = {}
    for name in memories(widths):
        full = np.dtype(DTYPES[name])
        narrow = widths.stored.get(name, 32) <= 8
        found[name] = np.dtype(f"{full.kind}1") if narrow else full.newbyteorder("<")
    return found


def in_words(content: Content) -> tuple[str, ...]:
    """Where the words of a pixel are, how many pixels must not be used, and what flags mean."""
    rows, cols = content.gain.shape
    bits = ", ".join(f"{flag:08x} {flag.name}" for flag in Flag)
    return (
        f"{rows} rows of {cols} pixels, row by row: {rows * cols} pixels. The first is that of",
        "   row 0, column 0, which viewers show at the upper left of a TIFF or PNG.",
        f"{np.count_nonzero(content.gain == 0)} pixels must not be used; all their words are 0.",
        f"flags of a pixel, hexadecimal, are the sum of {bits}.",
    )


_FIRST = "// equipix table: "


def to_memory_image(content: Content, _name: str) -> bytes:
    """Bytes of a file."""
    f = content.format
    offset = content.offset.astype(np.int64) & (2**f.offset_bits - 1)
    packed = (content.coarse.astype(np.int64) << f.offset_bits | offset) << f.gain_bits
    packed |= content.gain
    width = sum(f.stored.values())
    digits = -(-width // 4)
    said = (
        "A line below is the word of a pixel, and behind it as a comment its flags, if any.",
        f"{packed.size} words of {width} bits, {digits} hexadecimal digits each.",
        _fields(f),
    )
    comments = [f"// {line}" for line in (*f.words, *in_words(content), *said)]
    lines = [f"{_FIRST}{header(content)}", *comments]
    for word, flags in zip(packed.flat, content.flags.flat, strict=True):
        lines.append(f"{word:0{digits}x}" + (f" // {flags:08x}" if flags else ""))
    return "\n".join([*lines, ""]).encode()


def from_memory_image(path: Path, data: bytes) -> Content:
    """Parse the bytes of a file."""
    first, *lines = data.decode().splitlines()
    told = read_header(path, first, _FIRST)
    f = Format(**told["format"])
    parts = [line.partition("//") for line in lines if not line.startswith("//")]
    packed = np.array([int(word, 16) for word, _, _ in parts], np.int64)
    flags = np.array([int(flags or "0", 16) for _, _, flags in parts], np.int64)
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
    coarse = f"coarse [{top}:{offset}], " if f.dac_bits else ""
    return f"bits: {coarse}offset [{offset - 1}:{gain}], gain [{gain - 1}:0]"
