"""Names and globs to files, outputs whole or not at all, a reader's failure as an error."""

import ctypes
import errno
import glob
import logging
import os
import re
import shutil
import threading
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path

from equipix.errors import EquipixError, FileError, InputError
from equipix.io.arrays import ZARR, split


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
        At least one file; a list keeps its order. In a glob ``f2`` precedes ``f10``, and ``-20C``
        precedes ``-10C``: a minus that follows no letter, digit or bracket is a sign.

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
        raise InputError("'frames' names no file")
    return found


def _matches(name: str | PathLike[str], folder: Path) -> list[Path]:
    given = as_path("frames", name)
    path = folder / given
    file, _ = split(path)
    try:
        is_folder, exists = file.is_dir(), file.exists()
    except OSError as error:  # such as of a closed folder
        raise FileError(f"{path}: cannot be read: {error.strerror}") from error
    if is_folder and file.suffix.lower() not in ZARR:
        raise FileError(f"{path}: is a folder, expected files: name them by a glob, {path}/*.tif")
    if exists:
        return [path]
    pattern, place = split(given)
    if not glob.has_magic(str(pattern)):
        raise FileError(f"{path}: does not exist")
    # Unlike Path.glob, this leaves out hidden files, as a shell does.
    found = glob.glob(str(pattern), root_dir=folder, recursive=True)  # noqa: PTH207
    if not found:
        raise FileError(f"{path}: no file matches")
    behind = f":{place}" if place else ""
    return sorted((folder / f"{match}{behind}" for match in found), key=_natural)


def _natural(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"((?<![0-9A-Za-z)\]])-[0-9]+|[0-9]+)", str(path))
    return [(int(part) if k % 2 else 0, part) for k, part in enumerate(parts)]


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


def check_suffix(path: Path, suffixes: Iterable[str]) -> str:
    """Return the suffix of a file, in small letters; `InputError` unless it is one of these."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        wanted = ", ".join(suffixes)
        raise InputError(f"'{path}' ends in '{path.suffix}', expected the suffix {wanted}")
    return suffix


_TWO = "is named for two outputs: name another for one of them"


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[Path], twice: str = _TWO) -> None:
    """Refuse an output that is also an input, or another output, which `twice` says of it.

    Raises
    ------
    FileError
        If an output is one of the inputs or one of the other outputs, by whatever name.
    """
    taken = {split(path)[0].resolve() for path in inputs}
    named: set[Path] = set()
    for path in outputs:
        if path.resolve() in taken:
            raise FileError(f"{path}: is one of the inputs: name another output")
        if path.resolve() in named:
            raise FileError(f"{path}: {twice}")
        named.add(path.resolve())


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever a reader raises or logs about a broken file into an error that names it."""
    complaints = _Complaints()
    logger = logging.getLogger("tifffile")
    logger.addHandler(complaints)
    try:
        yield
    except Exception as error:
        # Also where a library is missing.
        if isinstance(error, FileNotFoundError) or not split(path)[0].exists():
            raise FileError(f"{path}: does not exist") from error
        # Values out of range are a fault of the file; no memory, or no library, is not.
        is_fault = not isinstance(error, EquipixError) or isinstance(error, InputError)
        if not is_fault:
            raise
        broken = f"incomplete, damaged, or no {path.suffix} file: use a copy, or make it again"
        if _is_text(path):
            broken += " (it holds text)"
        codecs = f"{error}; pip install 'equipix[codecs]'" if "imagecodecs" in str(error) else ""
        why = codecs or getattr(error, "strerror", None) or broken
        raise FileError(f"{path}: cannot be read: {why}") from error
    finally:
        logger.removeHandler(complaints)
    if complaints.messages:
        words = complaints.messages[0].rpartition("> ")[2]
        cut = words.startswith(_BEYOND)
        broken = f"is broken: {words}: use a copy, or make it again"
        raise FileError(f"{path}: {'is truncated' if cut else broken}")


_BEYOND = "invalid page offset", "invalid offset to page"
"""What tifffile logs of a page that begins, or whose directory ends, beyond the end of the file."""


def _is_text(path: Path) -> bool:
    """Whether a file begins with text; FITS and HDF5 begin with names of their own."""
    with suppress(OSError), split(path)[0].open("rb") as file:
        start = file.read(80)
        return bool(start) and start.isascii() and not start.startswith((b"SIMPLE", b"%"))
    return False


class _Complaints(logging.Handler):
    """What tifffile logs instead of raising, such as a last page that it leaves out."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.thread = threading.get_ident()
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the message."""
        if record.thread == self.thread:
            self.messages.append(record.getMessage())


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
    with _temporary(target) as temporary:
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
    with _temporary(target.resolve()) as temporary:
        temporary.mkdir(parents=True)
        yield temporary


@contextmanager
def _temporary(target: Path) -> Iterator[Path]:
    """Name what becomes the target: a file or a folder beside it, removed if it is left there."""
    temporary = _beside(target)
    try:
        with writing(target):
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Turn what the system refuses into an error that names the target."""
    try:
        yield
    except EquipixError:
        raise
    except OSError as error:
        why = error.strerror or str(error)  # without the name of the temporary file
        # NumPy counts what it could not write, and does not pass on why.
        full = error.errno == errno.ENOSPC or "requested and" in why
        why = os.strerror(errno.ENOSPC) if full else why
        todo = "free space, or name another folder" if full else "name another folder"
        raise FileError(f"{target}: cannot be written: {why}: {todo}") from error


def replace_folder(target: Path, new: Path) -> None:
    """Replace a folder, if there is one, by another; the old one is removed, or stands at `new`."""
    target = target.resolve()
    if not target.exists():
        new.rename(target)
        return
    if _exchanged(target, new):
        return
    # Without a folder for a moment, where the system cannot exchange two.
    old = _beside(target)
    target.rename(old)
    try:
        new.rename(target)
    except OSError:
        old.rename(target)
        raise
    shutil.rmtree(old)


_AT_FOLDER, _EXCHANGE = -100, 2
"""AT_FDCWD and RENAME_EXCHANGE of Linux."""


def _exchanged(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; False where the system or the disk cannot."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    names = os.fsencode(one), os.fsencode(other)
    return rename is not None and not rename(_AT_FOLDER, names[0], _AT_FOLDER, names[1], _EXCHANGE)


def _beside(target: Path) -> Path:
    """Return an unused hidden name in the folder of `target`, of the same suffix."""
    return target.parent / f".{uuid.uuid4().hex}{target.suffix}"
