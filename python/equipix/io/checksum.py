"""A checksum of named arrays and metadata, so that a damaged file is refused."""

from __future__ import annotations

import json
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

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
