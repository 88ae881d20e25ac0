"""Names given by callers, and the files that they denote."""

from __future__ import annotations

import glob
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from equipix.errors import FileError, InputError

if TYPE_CHECKING:
    from collections.abc import Iterable
    from os import PathLike


def find_files(
    source: str | PathLike[str] | Iterable[str | PathLike[str]], *, folder: Path = Path()
) -> list[Path]:
    """Files that a path, a glob or a list of these names; a glob's in natural order.

    Parameters
    ----------
    source : path, or iterable of paths
        A name with ``*``, ``?`` or ``[`` is a glob, unless a file has just that name.
    folder : Path, optional
        Where relative names start.

    Returns
    -------
    list of Path
        At least one file; a list keeps its order, and ``f2`` precedes ``f10`` in a glob.

    Raises
    ------
    FileError
        If a file does not exist or a glob matches nothing.
    InputError
        If there is no name, or something else than a name.
    """
    names = [source] if isinstance(source, str | bytes | os.PathLike) else source
    found = [path for name in names for path in _matches(name, folder)]
    if not found:
        raise InputError("'source' names no file")
    return found


def _matches(name: str | PathLike[str], folder: Path) -> list[Path]:
    pattern = str(as_path("source", name))
    path = folder / pattern
    if path.is_dir():
        raise FileError(f"{path}: is a folder, expected files: name them by a glob, {path}/*.tif")
    if path.exists():
        return [path]
    if not glob.has_magic(pattern):
        raise FileError(f"{path}: does not exist")
    # Unlike Path.glob, this leaves out hidden files, as a shell does.
    found = glob.glob(pattern, root_dir=folder, recursive=True)  # noqa: PTH207
    if not found:
        raise FileError(f"{path}: no file matches")
    return sorted((folder / match for match in found), key=_natural)


def _natural(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"([0-9]+)", str(path))
    return [(int(part), part) if part[:1].isdecimal() else (-1, part) for part in parts]


def as_path(name: str, value: object) -> Path:
    """Check that an argument is the name of a file or a folder.

    Raises
    ------
    InputError
        If it is no name, or none that a file can have.
    """
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or "\0" in text:
        raise InputError(f"'{name}' holds {value!r}, expected a path")
    return Path(text)


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Refuse an output that is also an input, or another output.

    Raises
    ------
    FileError
        If an output is one of the inputs or one of the other outputs, by whatever name.
    """
    taken = {path.resolve() for path in inputs}
    named: set[Path] = set()
    for path in outputs:
        if path.resolve() in taken:
            raise FileError(f"{path}: is one of the inputs: name another output")
        if path.resolve() in named:
            raise FileError(f"{path}: is named for two outputs: name another for one of them")
        named.add(path.resolve())
