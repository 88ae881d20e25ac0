"""Frames as bare bytes, packed or not. Their layout stands behind the name of the file.

``frames.raw:480x640:Mono12p`` has 480 rows of 640 pixels; ``:skip=512`` bytes before the first
frame, ``:gap=16`` bytes between frames and ``:big`` for the high byte first may follow. Formats of
pixels have the names of GenICam's Pixel Format Naming Convention 2.4: in those that end in p the
bits of successive pixels follow one another from the lowest bit of the first byte on, and a frame
ends with a whole byte.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from equipix.errors import FileError

FORMATS = {f"Mono{bits}": bits for bits in (8, 10, 12, 14, 16)} | {"Mono10p": 10, "Mono12p": 12}
"""Bits of a pixel of each format."""

_TEXT = re.compile(r"(.+):(\d+)x(\d+):(Mono\w+)(?::skip=(\d+))?(?::gap=(\d+))?(:big)?", re.DOTALL)


def split(text: str) -> tuple[str, str]:
    """Return the name of a file, and the layout behind it; empty where there is none."""
    found = _TEXT.fullmatch(text)
    return (text, "") if found is None else (found[1], text[found.end(1) + 1 :])


class Layout(NamedTuple):
    """How the bytes of a file are frames: rows and columns, format of a pixel, bytes between."""

    rows: int
    cols: int
    pixel: str = "Mono16"
    skip: int = 0
    gap: int = 0
    big: bool = False

    @classmethod
    def of(cls, path: Path) -> Self:
        """Read the layout behind the name of a file, which has one."""
        found = _TEXT.fullmatch(str(path))
        if found is None or found[4] not in FORMATS or not (int(found[2]) and int(found[3])):
            raise FileError(
                f"{path}: names no layout, expected rows x columns and a format of pixels, such as "
                f"480x640:Mono12p, with one of {', '.join(FORMATS)}"
            )
        _, rows, cols, pixel, skip, gap, big = found.groups(default="0")
        if big != "0" and pixel.endswith("p"):
            raise FileError(
                f"{path}: {pixel} is packed from the lowest bit on: leave out ':big', or "
                "'big_endian' in [layout]"
            )
        return cls(int(rows), int(cols), pixel, int(skip), int(gap), big != "0")

    def __str__(self) -> str:
        """Write the layout as `of` reads it behind the name of a file."""
        gaps = f":skip={self.skip}:gap={self.gap}" if self.skip or self.gap else ""
        return f"{self.rows}x{self.cols}:{self.pixel}{gaps}{':big' if self.big else ''}"

    @property
    def bits(self) -> int:
        """Bits of a pixel."""
        return FORMATS[self.pixel]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values that are read."""
        return np.dtype(np.uint8 if self.bits == 8 else np.uint16)

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        bits = self.bits if self.pixel.endswith("p") else 8 * self.dtype.itemsize
        return -(-self.rows * self.cols * bits // 8)

    def count(self, file: Path) -> int:
        """Return the number of frames in a file, which must be whole."""
        size = file.stat().st_size
        count, rest = divmod(size - self.skip + self.gap, self.frame_bytes + self.gap)
        if count >= 1 and not rest:
            return count
        least = max(count, 1)
        taken = least * (self.frame_bytes + self.gap) - self.gap + self.skip
        kind = f"{self.rows} x {self.cols} (rows x columns) {self.pixel}"
        between = f", skipped {self.skip} and gaps of {self.gap} included" * bool(
            self.skip + self.gap
        )
        raise FileError(
            f"{file}: holds {size} bytes, but {least} frame{'s' * (least > 1)} of {kind} "
            f"take{'s' * (least == 1)} {taken}{between}: correct the layout, or copy the file "
            "again if it is cut"
        )

    def values(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """Values of the bytes of one frame, shape (rows, cols)."""
        if self.pixel.endswith("p"):
            return self._unpacked(data).reshape(self.rows, self.cols)
        order = self.dtype.newbyteorder(">" if self.big else "<")
        return data.view(order).astype(self.dtype).reshape(self.rows, self.cols)

    def _unpacked(self, data: NDArray[np.uint8]) -> NDArray[np.uint16]:
        """Values of packed bytes: pixel k begins at bit k·b, four pixels at a whole byte."""
        pixels, group = self.rows * self.cols, self.bits // 2
        filled = np.zeros(-(-pixels // 4) * group, np.uint8)
        filled[: data.size] = data
        groups = filled.reshape(-1, group)
        values = np.empty((len(groups), 4), np.uint16)
        for pixel in range(4):
            byte, shift = divmod(pixel * self.bits, 8)
            values[:, pixel] = groups[:, byte + 1]
            values[:, pixel] <<= 8
            values[:, pixel] |= groups[:, byte]
            values[:, pixel] >>= shift
        values &= 2**self.bits - 1
        return values.ravel()[:pixels]


def header(path: Path) -> tuple[tuple[int, int, int], np.dtype[Any], str]:
    """Shape (n, rows, cols) and dtype of the frames; no text."""
    layout = Layout.of(path)
    return (layout.count(_file(path)), layout.rows, layout.cols), layout.dtype, ""


def stream_frames(path: Path, start: int = 0, stop: int | None = None) -> Iterator[NDArray[Any]]:
    """Frames of a file, one at a time, each of shape (1, rows, cols)."""
    layout, file = Layout.of(path), _file(path)
    count = layout.count(file)
    with file.open("rb") as stream:
        for index in range(count)[start:stop]:
            stream.seek(layout.skip + index * (layout.frame_bytes + layout.gap))
            frame = layout.values(np.fromfile(stream, np.uint8, layout.frame_bytes))
            if frame.max() >> layout.bits:
                raise FileError(
                    f"{file}: frame {index} holds {frame.max()}, above {2**layout.bits - 1}, the "
                    f"largest value of {layout.pixel}: correct the order of bytes or the format"
                )
            yield frame[None]


def _file(path: Path) -> Path:
    return Path(split(str(path))[0])
