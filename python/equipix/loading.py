"""Corrections of any kind and averaged frames, read from the files that they were saved to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib import import_module
from os import PathLike
from typing import Any

from equipix.calibration.result import Calibration
from equipix.correction.protocol import Correction
from equipix.errors import FileError
from equipix.io.formats import load_pages
from equipix.nuc.response import Response

READERS = {
    "calibration": ("equipix.calibration.result", "read_calibration"),
    "dynamic correction": ("equipix.bolometer.dynamic", "read_dynamic"),
    "frame statistics": ("equipix.measured.average", "read_statistics"),
    "polynomial": ("equipix.correction.polynomial", "read_polynomial"),
    "response": ("equipix.nuc.response", "read_response"),
}
"""By the kind in a file's metadata, the module, imported on first use, and the function that makes
the content of ``(path, pages, metadata)``."""

_NO_CORRECTIONS = {
    "dynamic correction": "maps against the temperature of the substrate: "
    "bolometer.DynamicCorrection.load reads it, and its correction(...) is that of a state",
    "frame statistics": "the mean and variance of averaged frames, which correct nothing by "
    "themselves: FrameStatistics.load reads them, equipix correct subtracts them as --dark",
    "state of a correction from the scene": "equipix.scene.load reads it; its correction() is a "
    "correction",
}
"""Kinds of files that are no corrections, and what they are."""


def load(path: str | PathLike[str]) -> Correction:
    """Read a correction from the file that its `save` wrote.

    Parameters
    ----------
    path : str or path
        The file; its suffix, .tif or .npz, names the format.

    Returns
    -------
    Correction
        As it was saved, bit by bit: a `Calibration` from a file that `Calibration.save` wrote, a
        `nuc.Response` from one that `Response.save` wrote.

    Raises
    ------
    FileError
        If the file cannot be read, holds something else, or was written in a newer format. Averaged
        frames are read by `FrameStatistics.load`.
    """
    readers = {kind: reader for kind, reader in READERS.items() if kind not in _NO_CORRECTIONS}
    correction: Correction = _load(path, readers)
    return correction


def load_any(path: str | PathLike[str]) -> Any:
    """Read a correction or averaged frames; the parameters and errors are those of `load`."""
    return _load(path, READERS)


def load_calibration(path: str | PathLike[str]) -> Calibration:
    """Read a calibration from the file that `Calibration.save` wrote, and refuse other corrections.

    The parameters and errors are those of `load`.
    """
    calibration: Calibration = _load(path, {"calibration": READERS["calibration"]})
    return calibration


def load_response(path: str | PathLike[str]) -> Response:
    """Read a response from the file that `Response.save` wrote, and refuse other corrections.

    The parameters and errors are those of `load`.
    """
    response: Response = _load(path, {"response": READERS["response"]})
    return response


def _load(path: str | PathLike[str], readers: Mapping[str, tuple[str, str]]) -> Any:
    pages, content = load_pages(path)
    kind = content.get("kind") if isinstance(content, dict) else None
    if not isinstance(kind, str) or kind not in readers:
        raise FileError(f"{path}: holds {_what(kind, readers)}")
    module, function = readers[kind]
    try:
        return getattr(import_module(module), function)(path, pages, content)
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise FileError(f"{path}: damaged or incomplete {kind}: {error!r}") from error


def _what(kind: object, readers: Iterable[str]) -> str:
    """Describe the content of a file that is not expected here."""
    words = _NO_CORRECTIONS.get(str(kind))
    wanted = f"expected {' or '.join(readers)} that equipix has saved"
    return f"{kind or 'something else'}, {wanted}{f' ({words})' if words else ''}"
