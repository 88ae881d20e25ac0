"""Tables as C headers, with a function that applies them bit by bit."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import FileError
from equipix.hardware.content import DTYPES, Content, header, made, read_header

if TYPE_CHECKING:
    from pathlib import Path

    from equipix._types import Array

_FIRST = "/* equipix table: "

_TYPES = {"coarse": "uint16_t", "offset": "int16_t", "gain": "uint16_t", "flags": "uint32_t"}

_A_LINE = 16
"""Words in a line."""

_APPLY = """
/* Output word of pixel p for the word x of the ADC; shifts of negative numbers are arithmetic. */
static inline uint16_t equipix_apply(uint16_t x, uint32_t p)
{{
    if (equipix_gain[p] == 0) return 0; /* a pixel that must not be used */
    int64_t sum = (int64_t)equipix_gain[p] * x * ((int64_t)1 << {product})
                + (int64_t)equipix_offset[p] * ((int64_t)1 << {offset});
    {rounding}
    int64_t z = {base} + sum;
    return (uint16_t)(z < 0 ? 0 : z > {largest} ? {largest} : z);
}}
"""

_ROUNDING = "sum = (sum + {half} - 1 + ((sum >> {bits}) & 1)) >> {bits}; /* half to even */"


def encoded(content: Content) -> bytes:
    """Bytes of a file."""
    f = content.format
    rows, cols = content.gain.shape
    lines = [
        f"{_FIRST}{header(content)} */",
        "#ifndef EQUIPIX_TABLE_H",
        "#define EQUIPIX_TABLE_H",
        "#include <stdint.h>",
        f"#define EQUIPIX_ROWS {rows}",
        f"#define EQUIPIX_COLS {cols}",
        *(
            f"#define EQUIPIX_{name.upper()}_STEP_EXPONENT ({getattr(f, name)})"
            for name in ("adc", "coarse", "offset", "gain", "out")
        ),
    ]
    for name, values in content.arrays().items():
        lines.append(f"static const {_TYPES[name]} equipix_{name}[{values.size}] = {{")
        texts = [str(value) for value in values.ravel().tolist()]
        lines += [",".join(texts[i : i + _A_LINE]) + "," for i in range(0, len(texts), _A_LINE)]
        lines.append("};")
    product, offset, out = f.shifts
    rounding = _ROUNDING.format(bits=out, half=f"((int64_t)1 << {out - 1})") if out else ""
    apply = _APPLY.format(
        product=product,
        offset=offset,
        rounding=rounding,
        base=f"({f.base})",
        largest=2**f.out_bits - 1,
    )
    lines.append(apply)
    return "\n".join([*lines, "#endif", ""]).encode()


def decoded(path: Path, data: bytes) -> Content:
    """Parse the bytes of a file."""
    text = data.decode()
    first = text.split("\n", 1)[0]
    if not first.startswith(_FIRST):
        raise FileError(f"{path}: holds no table that equipix has written")
    told = read_header(path, first.removeprefix(_FIRST).removesuffix(" */"))
    arrays: dict[str, Array] = {}
    for name in DTYPES:
        body = re.search(rf"equipix_{name}\[\d+\] = {{\n(.*?)}};", text, re.DOTALL)
        if body is None:
            raise FileError(f"{path}: has no words of '{name}': incomplete")
        words = body[1].replace("\n", "").rstrip(",").split(",")
        arrays[name] = np.array([int(word) for word in words], np.int64)
    return made(path, told, arrays)
