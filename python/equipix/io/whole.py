"""Outputs that appear whole or not at all."""

from __future__ import annotations

import os
import uuid
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from equipix.errors import EquipixError, FileError
from equipix.io.names import as_path

if TYPE_CHECKING:
    from collections.abc import Iterator
    from os import PathLike


@contextmanager
def write_whole(path: str | PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """Give a file's place to a new version in one step, when all of it is written.

    Parameters
    ----------
    path : path
        Where the file is to be.
    force : bool, optional
        Replace a file that is there.

    Yields
    ------
    Path
        Where to write it; moved to `path` at the end, removed after an exception.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    InputError
        If `path` is not the name of a file.
    """
    target = as_path("path", path)
    temporary = beside(target)
    try:
        if target.is_dir():
            raise FileError(f"{target}: is a folder, expected the name of a file")
        if target.exists() and not force:
            raise FileError(f"{target}: exists already; force=True (--force) replaces it")
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(target)
    except EquipixError:
        raise
    except OSError as error:
        raise FileError(f"{target}: cannot be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def beside(target: Path) -> Path:
    """Give a hidden name in the folder of `target` that nothing else has, of the same suffix."""
    return target.parent / f".{uuid.uuid4().hex}{target.suffix}"
