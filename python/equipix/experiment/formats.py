"""Shape and depth of the images of an experiment, from the headers of their files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from equipix.errors import FileError
from equipix.frames import saved_shape
from equipix.io import frame_format

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from typing import Any

    import numpy as np


def check_formats(files: Sequence[Path]) -> tuple[int, int]:
    """Return the shape (rows, cols) that all files have.

    Raises
    ------
    FileError
        If a file cannot be read or differs from the first in shape or depth.
    """
    first, *others = files
    wanted, wanted_dtype = _format(first)
    for file in others:
        shape, dtype = _format(file)
        wanted_dtype = wanted_dtype or dtype
        if shape != wanted or dtype not in (None, wanted_dtype):
            raise FileError(
                f"{file}: holds {dtype or 'averaged'} frames of shape {shape}, expected "
                f"{wanted_dtype or 'averaged'} of shape {wanted} as in {first}"
            )
    return wanted


def _format(file: Path) -> tuple[tuple[int, int], np.dtype[Any] | None]:
    """Rows, columns and dtype of the frames of a file; no dtype of frames averaged before."""
    saved = saved_shape(file)
    if saved is not None:
        return saved, None
    (_, rows, cols), dtype = frame_format(file)
    return (rows, cols), dtype
