"""Masks of pixels from image files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.errors import FileError
from equipix.io.images import read_frames
from equipix.io.names import as_path
from equipix.io.reading import reading

if TYPE_CHECKING:
    from os import PathLike
    from pathlib import Path

    from numpy.typing import NDArray

_MAGIC = b"\x93NUMPY"
"""First bytes of an .npy file."""


def read_mask(path: str | PathLike[str]) -> NDArray[np.bool_]:
    """Read which pixels must not be used: those that are not 0 in the file.

    Parameters
    ----------
    path : path
        One grey image (TIFF, PNG, PGM or BMP), or a NumPy array (.npy) of two dimensions.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        True = do not use.

    Raises
    ------
    FileError
        If the file cannot be read or holds no single image.
    """
    file = as_path("mask", path)
    array = _array(file) if file.suffix.lower() == ".npy" else read_frames(file)
    if array.ndim == 3 and len(array) == 1:
        array = array[0]
    if array.ndim != 2 or array.dtype.kind not in "buif":
        raise FileError(
            f"{file}: holds {array.dtype} of shape {array.shape}, expected one mask of shape "
            "(rows, cols), in which pixels that are not 0 must not be used"
        )
    mask: NDArray[np.bool_] = array != 0
    return mask


def _array(file: Path) -> NDArray[Any]:
    with reading(file), file.open("rb") as stream:
        if stream.read(len(_MAGIC)) != _MAGIC:
            raise FileError(f"{file}: is no .npy file, whatever its name says")
        stream.seek(0)
        return np.asarray(np.load(stream, allow_pickle=False))
