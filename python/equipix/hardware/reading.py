"""Tables read from the files that they were saved to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from equipix.errors import FileError, InputError
from equipix.hardware.files import read_content
from equipix.hardware.table import Table

if TYPE_CHECKING:
    from os import PathLike


def read(path: str | PathLike[str]) -> Table:
    """Read a table from the file that `Table.save` wrote, bit by bit.

    Parameters
    ----------
    path : str or path
        The file; its suffix, .bin, .hex or .h, names the format.

    Returns
    -------
    Table
        As it was saved.

    Raises
    ------
    FileError
        If the file cannot be read, holds something else, or is of another size or version.
    InputError
        If the suffix is another.
    """
    content = read_content(path)
    try:
        return Table(*content)
    except InputError as error:
        raise FileError(f"{path}: is damaged: {error}") from error
