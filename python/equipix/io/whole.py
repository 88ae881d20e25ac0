"""Outputs that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
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
    """Replace a file in one step, when all of its new version is written.

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
    temporary = _beside(target)
    try:
        if target.is_dir():
            raise FileError(f"{target}: is a folder, expected the name of a file")
        if not target.parent.exists():
            raise FileError(f"{target}: there is no folder '{target.parent}': make it first")
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


@contextmanager
def folder_beside(target: Path) -> Iterator[Path]:
    """Make a folder whose content the caller moves to `target` when all of it is written.

    Parameters
    ----------
    target : path
        Where the content is to be; its parent folders are made.

    Yields
    ------
    Path
        The folder; what is in it at the end, or after an exception, is removed.

    Raises
    ------
    FileError
        If something cannot be written.
    """
    temporary = _beside(target.resolve())
    try:
        temporary.mkdir(parents=True)
        yield temporary
    except EquipixError:
        raise
    except OSError as error:
        raise FileError(f"{target}: cannot be written: {error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def replace_folder(target: Path, new: Path) -> None:
    """Replace a folder, if there is one, by another; the old one is removed last."""
    target = target.resolve()
    if not target.exists():
        new.rename(target)
        return
    old = _beside(target)
    target.rename(old)
    try:
        new.rename(target)
    except OSError:
        old.rename(target)
        raise
    shutil.rmtree(old)


def _beside(target: Path) -> Path:
    """Return an unused hidden name in the folder of `target`, of the same suffix."""
    return target.parent / f".{uuid.uuid4().hex}{target.suffix}"
