"""NPZ files of NumPy: named arrays with a text."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from equipix._check import Array
from equipix.errors import FileError

_TEXT = "metadata"
"""Name of the array that is the text."""


def write_pages(path: Path, pages: Mapping[str, Array], text: str) -> None:
    """Write arrays and a text."""
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **{_TEXT: np.array(text)}, **pages)


def read_pages(path: Path) -> tuple[dict[str, Array], str]:
    """Read what `write_pages` wrote: arrays by name, and the text; of other files no text."""
    return _read(path, everything=True)


def description(path: Path) -> str:
    """Return the text alone; empty where there is none."""
    return _read(path, everything=False)[1]


def _read(path: Path, *, everything: bool) -> tuple[dict[str, Array], str]:
    # Refused here, before NumPy takes it for pickled objects.
    if not path.exists():
        raise FileError(f"{path}: does not exist")
    if not zipfile.is_zipfile(path):
        raise FileError(f"{path}: is no .npz file, whatever its name says")
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        names = file.files if everything else {_TEXT} & {*file.files}
        pages = {name: file[name] for name in names}
    return pages, str(pages.pop(_TEXT, ""))
