"""The file of a state: named maps, and what else is remembered as JSON."""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix.errors import FileError, InputError
from equipix.io import check_format, load_pages, save_pages

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

    from equipix._types import Array

KIND = "state of a correction from the scene"
"""The kind in the metadata of the file."""

FORMAT = 4
"""Number of the file format; a file with another one is refused."""

_CONTENT = frozenset({"method", "shape", "data_range", "saturation", "options", "counts", "peak"})
"""What is remembered beside the maps."""


def write_state(
    path: str | PathLike[str], maps: Mapping[str, Array], content: Mapping[str, Any], *, force: bool
) -> None:
    """Write a state; see `SceneCorrection.save`."""
    digest = {"digest": _digest(maps, content)}
    save_pages(path, maps, {"format": FORMAT, "kind": KIND, **content, **digest}, force=force)


def check_digest(maps: Mapping[str, Array], content: Mapping[str, Any]) -> None:
    """Refuse a state of which any byte is not the one that was saved.

    Raises
    ------
    InputError
        If the digest is that of another state.
    """
    held = {key: content[key] for key in sorted(_CONTENT)}
    if content.get("digest") != _digest(maps, held):
        raise InputError("'digest' is that of another state: maps or numbers were changed")


def _digest(maps: Mapping[str, Array], content: Mapping[str, Any]) -> str:
    """SHA-256 of all maps and of the content."""
    found = hashlib.sha256(json.dumps(dict(content), sort_keys=True).encode())
    for name, values in sorted(maps.items()):
        found.update(name.encode() + np.ascontiguousarray(values).tobytes())
    return found.hexdigest()


def read_state(
    path: str | PathLike[str], method: str | None, shape: tuple[int, int] | None
) -> tuple[dict[str, Array], dict[str, Any]]:
    """Read the maps and the rest of a state.

    Parameters
    ----------
    path : str or path
        The file.
    method : str, optional
        The method that it must be of.
    shape : tuple of int, optional
        The sizes of the sensor that it must be of.

    Returns
    -------
    maps : dict of str to ndarray
        Maps by name, float32.
    content : dict
        Method, shape, range, options, counts and the largest raw value.

    Raises
    ------
    FileError
        If it is not such a state, or is damaged.
    """
    maps, content = load_pages(path)
    check_format(path, content, KIND, FORMAT)
    if content["format"] < FORMAT:
        raise FileError(
            f"{path}: has format {content['format']}, of an earlier version whose states lack the "
            f"noise, the largest value or the pattern (format {FORMAT}): learn again"
        )
    if missing := _CONTENT - content.keys():
        raise FileError(f"{path}: is damaged: lacks {', '.join(sorted(missing))}")
    if method is not None and content["method"] != method:
        raise FileError(f"{path}: holds a state of '{content['method']}', expected '{method}'")
    held = _sizes(path, content["shape"])
    if not isinstance(content["method"], str):
        raise FileError(f"{path}: is damaged: 'method' is {content['method']!r}")
    if shape is not None and held != tuple(shape):
        raise FileError(f"{path}: holds a state of a sensor {held}, expected {tuple(shape)}")
    for name, values in maps.items():
        if values.dtype != np.float32 or values.ndim != 2:
            raise FileError(
                f"{path}: is damaged: page '{name}' is {values.dtype} of shape {values.shape}, "
                "expected float32 in two dimensions"
            )
    return maps, content


def _sizes(path: str | PathLike[str], shape: Any) -> tuple[int, int]:
    """Rows and columns of the sensor, from the file."""
    if (
        isinstance(shape, list)
        and len(shape) == 2
        and all(isinstance(size, int) and not isinstance(size, bool) for size in shape)
    ):
        return shape[0], shape[1]
    raise FileError(f"{path}: is damaged: 'shape' is {shape!r}, expected two whole numbers")
