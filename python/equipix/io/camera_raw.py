"""Raw files of cameras (DNG, CR2, NEF and others) by rawpy: counts of the sensor, not developed.

The only module that imports rawpy.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from equipix.errors import EquipixError, FileError

SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2", ".pef")


class SensorData(NamedTuple):
    """What a raw file holds about its sensor.

    Attributes
    ----------
    black : tuple of tuple of float
        Black level of each place of the pattern, in DN.
    white : int
        Level of saturation, in DN.
    cfa : list of str or None
        Rows of the pattern of colour filters, such as ["RG", "GB"]; None without filters.
    """

    black: tuple[tuple[float, ...], ...]
    white: int
    cfa: list[str] | None

    def dark(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Black level of each pixel of a sensor of that shape (rows, cols)."""
        once = np.array(self.black)
        repeats = [-(-size // step) for size, step in zip(shape, once.shape, strict=True)]
        return np.tile(once, repeats)[: shape[0], : shape[1]]


def header(
    path: Path,
) -> tuple[tuple[int, int, int], np.dtype[Any], str, tuple[float | None]]:
    """Shape (1, rows, cols) and dtype of the counts, no text, and the exposure time in seconds."""
    with _opened(path) as raw:
        shape = (1, raw.sizes.height, raw.sizes.width)
        # LibRaw has a float of 32 bits: its shortest decimal is what the camera wrote, as 0.02.
        time = float(str(np.float32(raw.other.shutter_speed)))
        return shape, np.dtype(np.uint16), "", (time or None,)


def stream_frames(path: Path, _start: int = 0, _stop: int | None = None) -> Iterator[NDArray[Any]]:
    """Counts of the sensor, without its dark border, in the one frame of a file."""
    with _opened(path) as raw:
        yield raw.raw_image_visible[None].copy()


def sensor_data(path: Path) -> SensorData:
    """Read black level, saturation and colour pattern."""
    with _opened(path) as raw:
        pattern = np.zeros((1, 1), int) if raw.raw_pattern is None else raw.raw_pattern
        black, names = raw.black_level_per_channel, raw.color_desc.decode()
        return SensorData(
            tuple(tuple(float(black[each]) for each in row) for row in pattern),
            int(raw.white_level),
            None
            if raw.raw_pattern is None or raw.num_colors == 1
            else ["".join(names[each] for each in row) for row in pattern],
        )


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        import rawpy
    except ImportError as error:
        raise EquipixError(
            "raw files of cameras need rawpy, which is not installed: pip install 'equipix[raw]'"
        ) from error
    try:
        opened = rawpy.imread(str(path))
    except rawpy.LibRawError as error:
        raise FileError(
            f"{path}: is no {path.suffix} file of a camera that LibRaw reads, or damaged: use "
            f"a copy (LibRaw: {error.args[0].decode()})"
        ) from error
    with opened as raw:
        if raw.raw_type != rawpy.RawType.Flat:
            raise FileError(f"{path}: holds several values in each pixel, expected one")
        yield raw
