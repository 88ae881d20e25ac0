"""Tables to and from files, by suffix."""

from __future__ import annotations

from typing import TYPE_CHECKING

from equipix.errors import FileError, InputError
from equipix.hardware import binary, c_header, memory_image
from equipix.io import as_path, write_whole

if TYPE_CHECKING:
    from os import PathLike
    from pathlib import Path

    from equipix.hardware.content import Content

_FORMATS = {".bin": binary, ".hex": memory_image, ".h": c_header}

SUFFIXES = tuple(_FORMATS)
"""Suffixes of files of tables."""


def write(content: Content, path: str | PathLike[str], *, force: bool) -> None:
    """Write a file, which appears whole or not at all."""
    file = as_path("path", path)
    data = _FORMATS[_suffix(file)].encoded(content, file.stem)
    with write_whole(path, force=force) as temporary:
        temporary.write_bytes(data)


def read_content(path: str | PathLike[str]) -> Content:
    """Read what `write` wrote.

    Raises
    ------
    FileError
        If the file cannot be read, holds something else, or is incomplete or of another version.
    """
    file = as_path("path", path)
    kind = _FORMATS[_suffix(file)]
    try:
        content: Content = kind.decoded(file, file.read_bytes())
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"{file}: cannot be read: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise FileError(f"{file}: is damaged or incomplete: {error}") from error
    return content


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        raise InputError(f"'{path}' ends in none of {', '.join(SUFFIXES)}, which name the format")
    return suffix
