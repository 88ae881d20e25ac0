"""Tables as C headers, with a function that applies them bit by bit."""

import hashlib
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np

from equipix._check import Array
from equipix.errors import FileError
from equipix.hardware.table_files import (
    Content,
    checksum,
    header,
    in_words,
    made,
    memories,
    read_header,
)
from equipix.hardware.words import STEPS, Format

_FIRST = "/* equipix table: "

_DIGEST = "SHA-256 of the lines above:"

_A_LINE = 16
"""Words in a line."""

_APPLY = """
/* Output word z of pixel p = row * {upper}_COLS + col.
   {words}
   Right shifts of negative numbers must be arithmetic. */
static inline uint16_t {lower}_apply(uint16_t x, uint32_t p)
{{
    if ({lower}_gain[p] == 0) return 0; /* a pixel that must not be used */
    int64_t sum = (int64_t){lower}_gain[p] * x * ((int64_t)1 << {product})
                + (int64_t){lower}_offset[p] * ((int64_t)1 << {offset});
    {rounding}
    int64_t z = {upper}_BASE + sum;
    return (uint16_t)(z < 0 ? 0 : z > {largest} ? {largest} : z);
}}
"""

_ROUNDING = "sum = (sum + {half} - 1 + ((sum >> {bits}) & 1)) >> {bits}; /* half to even */"


def to_c_header(content: Content, name: str) -> bytes:
    """Bytes of a file, whose C names begin with ``equipix_`` and its name.

    A letter beyond ASCII is written as its code point. Other characters become ``_``, so two names
    may still be alike: a program that includes both files is then not compiled.
    """
    letters = re.sub(r"[^\x00-\x7f]", lambda letter: f"u{ord(letter[0]):04x}", name)
    lower = "equipix_" + re.sub(r"\W", "_", letters).lower()
    upper, crc = lower.upper(), f"0x{checksum(content):08x}"
    lines = [
        f"{_FIRST}{header(content)} */",
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        f"#define {upper}_CRC32 ({crc})",
        "#include <stdint.h>",
        *_macros(content, upper),
        "/* " + "\n   ".join(in_words(content)) + " */",
        *_arrays(content, lower),
        _function(content.format, lower),
        f"#elif {upper}_CRC32 != {crc}",
        f"#error another table has the names {lower}: write one to a file of another name",
    ]
    text = "\n".join([*lines, ""])
    return f"{text}{_last(upper, text)}\n".encode()


def _macros(content: Content, upper: str) -> list[str]:
    """Sizes of the sensor, widths, exponents of the steps, and constants."""
    rows, cols = content.gain.shape
    numbers = {"rows": rows, "cols": cols, **asdict(content.format)}
    names = {step: f"{step}_step_exponent" for step in STEPS} | {"dac_bits": "coarse_bits"}
    return [
        f"#define {upper}_{names.get(name, name).upper()} ({value})"
        for name, value in numbers.items()
    ]


def _arrays(content: Content, lower: str) -> list[str]:
    """Words of all pixels, row by row."""
    lines = []
    for name in memories(content.format):
        values = getattr(content, name)
        texts = [str(value) for value in values.ravel().tolist()]
        lines.append(f"static const {values.dtype.name}_t {lower}_{name}[{values.size}] = {{")
        lines += [",".join(texts[i : i + _A_LINE]) + "," for i in range(0, len(texts), _A_LINE)]
        lines.append("};")
    return lines


def _function(f: Format, lower: str) -> str:
    """Correct a word with whole numbers, as `Table.apply` does."""
    product, offset, out = f.shifts
    return _APPLY.format(
        lower=lower,
        upper=lower.upper(),
        words="\n   ".join(f.words),
        product=product,
        offset=offset,
        rounding=_ROUNDING.format(bits=out, half=f"((int64_t)1 << {out - 1})") if out else "",
        largest=2**f.out_bits - 1,
    )


def _last(upper: str, above: str) -> str:
    """Last line, by which a file is known to be whole and as it was written."""
    digest = hashlib.sha256(above.encode()).hexdigest()
    return f"#endif /* {upper}_H, {_DIGEST} {digest} */"


def from_c_header(path: Path, data: bytes) -> Content:
    """Parse the bytes of a file."""
    text = data.decode().replace("\r\n", "\n").rstrip()
    first = text.split("\n", 1)[0].rstrip()
    fields = read_header(path, first.removesuffix(" */"), _FIRST)
    guard = re.findall(r"^#ifndef (\w+)_H\s*$", text, re.MULTILINE)[0]
    above, newline, last = text.rpartition("\n")
    names = memories(Format(**fields["format"]))
    content = made(path, fields, {name: _words(text, name) for name in names})
    if last != _last(guard, above + newline):
        raise FileError(
            f"{path}: was edited, or its digest removed: the last line does not hold the SHA-256 "
            "of the lines above: write the table again"
        )
    return content


def _words(text: str, name: str) -> Array:
    """Words of one array."""
    body = re.findall(rf"_{name}\[\d+\] = {{\s*(.*?)}};", text, re.DOTALL)[0]
    words = re.sub(r"\s", "", body).rstrip(",").split(",")
    return np.array([int(word) for word in words], np.int64)
