"""Files of named arrays with metadata: their formats by suffix, and NPZ, which is one of them."""

import json
import zlib
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from equipix._check import Array, Bools
from equipix.errors import FileError, InputError
from equipix.io import arrays, asdf, fits, nexus, tiff
from equipix.io.frames import (
    WITH_HEADERS,
    Header,
    Settings,
    frame_format,
    header,
    read_frames,
    settings,
    suffix_of,
)
from equipix.io.paths import as_path, find_files, reading, write_whole
from equipix.io.viewed import Viewed

_TEXT = "metadata"
"""Name of the array of an NPZ file that is the text."""

_SEPARATORS = (", ", " : ")
"""Of the JSON text: tifffile takes one that holds ``"shape":`` for its own."""

_CRC = "crc32"
"""Key of the checksum of the metadata."""


_Content = tuple[dict[str, Array], str]
"""Arrays by name, and the text."""


def _write_npz(path: Path, pages: Mapping[str, Array], text: str, _: Viewed | None) -> None:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **{_TEXT: np.array(text)}, **pages)


def _read_npz(path: Path) -> _Content:
    with path.open("rb") as stream, np.lib.npyio.NpzFile(stream) as file:
        pages = dict(file)
    return pages, str(pages.pop(_TEXT, ""))


def _npz_description(path: Path) -> str:
    with path.open("rb") as stream, np.lib.npyio.NpzFile(stream) as file:
        return str(file.get(_TEXT, ""))


_FORMATS = {
    **dict.fromkeys((".tif", ".tiff"), (tiff.write_pages, tiff.read_pages)),
    ".npz": (_write_npz, _read_npz),
    **dict.fromkeys(fits.SUFFIXES, (fits.write_pages, fits.read_pages)),
    **dict.fromkeys(nexus.SUFFIXES, (nexus.write_pages, nexus.read_pages)),
    **dict.fromkeys(asdf.SUFFIXES, (asdf.write_pages, asdf.read_pages)),
}
"""What writes and reads arrays and a text in each format; of other files there is no text."""

_DESCRIPTIONS = {
    ".npz": _npz_description,
    **dict.fromkeys(nexus.SUFFIXES, nexus.description),
    **dict.fromkeys(asdf.SUFFIXES, asdf.description),
}
"""What reads the text alone; that of a TIFF and of FITS stands in the header."""

SUFFIXES = tuple(_FORMATS)

SAVED = ".tif, .npz, .fits, .nxs or .asdf"
"""In words, what results are saved as: of each format one suffix."""

ONLY_RESULTS = (".npz", *asdf.SUFFIXES)
"""Suffixes of files that hold results and no frames."""


def save_pages(
    path: str | PathLike[str],
    pages: Mapping[str, Array],
    metadata: Mapping[str, Any],
    viewed: Viewed | None = None,
    *,
    force: bool = False,
) -> None:
    """Write named arrays and metadata to a file, which appears whole or not at all.

    Parameters
    ----------
    path : path
        Output; its suffix names the format: .tif, .npz, .fits, .nxs or .asdf.
    pages : mapping of str to ndarray
        Arrays by name, each kept in its own dtype: of shape (rows, cols), or a stack of shape
        (n, rows, cols), whose images are pages of their own in a TIFF.
    metadata : mapping
        JSON values; in a TIFF they are the first page's description. Their checksum is added.
    viewed : Viewed, optional
        What other programs show: the first page of a TIFF, as float32, and the primary image of a
        FITS file.
    force : bool, optional
        Replace a file that is there.

    Raises
    ------
    FileError
        If the file exists and `force` is not set, or cannot be written.
    InputError
        If the suffix is unknown.
    """
    write_pages, _ = _format(as_path("path", path))
    text = with_checksum(metadata)
    with write_whole(path, force=force) as temporary:
        write_pages(temporary, pages, text, viewed)


def load_pages(path: str | PathLike[str]) -> tuple[dict[str, Array], dict[str, Any]]:
    """Read what `save_pages` wrote.

    Parameters
    ----------
    path : path
        A .tif, .npz, .fits, .nxs or .asdf file.

    Returns
    -------
    pages : dict of str to ndarray
        The arrays by name.
    metadata : dict
        The metadata.

    Raises
    ------
    FileError
        If the file is not readable, was not written by `save_pages`, or its metadata differ from
        their checksum.
    InputError
        If the suffix is unknown.
    """
    path = as_path("path", path)
    _, read_pages = _format(path)
    with reading(path):
        pages, text = read_pages(path)
    metadata = _parsed(text)
    if _CRC not in metadata:
        raise FileError(
            f"{path}: holds neither a correction nor frame statistics: equipix did not write it, "
            "or wrote it for other programs alone, as gains of a table: name the result itself. "
            "Images are for equipix average, or for equipix calibrate in an experiment.toml"
        )
    if metadata.pop(_CRC) != _checksum(metadata):
        raise FileError(
            f"{path}: is damaged: its metadata differ from their checksum: use a copy, or make it "
            "again"
        )
    return pages, metadata


def _format(path: Path) -> tuple[Callable[..., None], Callable[[Path], _Content]]:
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: ends in '{path.suffix}', expected the suffix {SAVED}")
    return _FORMATS[path.suffix.lower()]


def refuse_copy(path: str | PathLike[str], use: str | None) -> None:
    """Refuse a copy for other programs that a format does not hold."""
    suffix = as_path("path", path).suffix.lower()
    if suffix == ".npz":
        raise InputError(
            f"{path}: an .npz file holds no copy for other programs: leave out 'use' and 'mean_one'"
        )
    if suffix in nexus.SUFFIXES and use == "gain":
        raise InputError(f"{path}: a NeXus file holds a flat to divide by, expected 'use' flat")


def with_checksum(metadata: Mapping[str, Any]) -> str:
    """Metadata as JSON, with their checksum."""
    return json.dumps({**metadata, _CRC: _checksum(metadata)}, separators=_SEPARATORS)


def checked(text: str) -> dict[str, Any] | None:
    """Metadata of a text of `with_checksum`; None where they differ from their checksum."""
    metadata = _parsed(text)
    return metadata if metadata.pop(_CRC, None) == _checksum(metadata) else None


def _checksum(metadata: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(dict(metadata)).encode())


def _parsed(text: str) -> dict[str, Any]:
    """Return the metadata in a text; empty where it is none of `save_pages`."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


class FrameFile(PathLike[str]):
    """A file of frames, or of what stands in their place, whose header is read once.

    Attributes
    ----------
    path : Path
        The file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def __fspath__(self) -> str:
        """Return the name, so that the file is a path too."""
        return str(self.path)

    @cached_property
    def header(self) -> Header:
        """What the file holds beside its frames."""
        return header(self.path)

    @cached_property
    def settings(self) -> Settings:
        """Exposure time and temperature in its header or EXIF."""
        in_header = suffix_of(self.path) in WITH_HEADERS
        return self.header.settings if in_header else settings(self.path)

    @property
    def image_type(self) -> fits.ImageType:
        """What the frames show by the header of a FITS file."""
        is_fits = suffix_of(self.path) in fits.READ
        return self.header.image_type if is_fits else fits.ImageType()

    @cached_property
    def content(self) -> dict[str, Any]:
        """Metadata that `save_pages` wrote; empty of other files."""
        if suffix_of(self.path) in fits.SUFFIXES:
            return _parsed(self.header.description)
        return _saved_content(self.path)

    @property
    def kind(self) -> str | None:
        """Kind of a result in the place of frames; None of other files."""
        return _kind(self.content)


def frame_files(source: Iterable[str | PathLike[str]]) -> list[FrameFile]:
    """Files that names or globs name; those whose headers are known stay as they are."""
    given = list(source)
    known = [each for each in given if isinstance(each, FrameFile)]
    return known if len(known) == len(given) else [*map(FrameFile, find_files(given))]


def _kind(content: dict[str, Any]) -> str | None:
    kind = content.get("kind")
    return kind if isinstance(kind, str) else None


def saved_kind(path: Path) -> str | None:
    """Kind of content in a file that stands in the place of frames; None of other files."""
    return FrameFile(path).kind


def _saved_content(path: Path) -> dict[str, Any]:
    """Metadata in a file; those of whole numbers, which cameras write, are not searched."""
    suffix = suffix_of(path)
    if suffix in _DESCRIPTIONS:
        file, _ = arrays.split(path)
        with reading(file):
            return _parsed(_DESCRIPTIONS[suffix](file))
    is_searched = suffix in SUFFIXES and frame_format(path)[1].kind == "f"
    return _parsed(header(path).description) if is_searched else {}


def refuse_saved(path: Path) -> None:
    """Refuse a file that `save_pages` wrote where images are expected.

    Raises
    ------
    FileError
        With what the file holds.
    """
    _refuse_kind(path, saved_kind(path))


def _refuse_kind(path: Path, kind: str | None, wanted: str = "raw frames") -> None:
    if kind is not None:
        article = "" if kind.endswith("s") else "a "
        raise FileError(f"{path}: holds {article}{kind}, expected {wanted}")


def raw_headers(files: Iterable[Path], shape: tuple[int, int]) -> dict[Path, Header]:
    """What files hold beside their frames, which must be raw and of the sensor's shape."""
    headers = {file: raw_header(file) for file in files}
    for file, found in headers.items():
        if found.shape[1:] != shape:
            raise InputError(f"{file}: holds frames of shape {found.shape[1:]}, expected {shape}")
    return headers


def raw_header(path: Path) -> Header:
    """What a file holds beside raw frames; what `save_pages` wrote is refused like there."""
    file = FrameFile(path)
    if suffix_of(path) in (*_DESCRIPTIONS, *fits.SUFFIXES):
        _refuse_kind(path, file.kind)
    found = file.header
    _refuse_kind(path, _kind(_parsed(found.description)) if found.dtype.kind == "f" else None)
    return found


def read_mask(path: str | PathLike[str]) -> Bools:
    """Read which pixels must not be used: those that are not 0 in the file.

    Parameters
    ----------
    path : path
        One grey image (TIFF, PNG, PGM, BMP or FITS), or a NumPy array (.npy) of two dimensions.

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
    _refuse_kind(file, saved_kind(file), "a mask, an image or .npy: 0 in usable pixels")
    array = _array(file) if file.suffix.lower() == ".npy" else read_frames(file)
    if array.ndim == 3 and len(array) == 1:
        array = array[0]
    if array.ndim != 2 or array.dtype.kind not in "buif":
        raise FileError(
            f"{file}: holds {array.dtype} of shape {array.shape}, expected one mask of shape "
            "(rows, cols), in which pixels that are not 0 must not be used"
        )
    return np.asarray(array != 0)


def _array(file: Path) -> Array:
    with reading(file):
        return np.asarray(np.load(file, allow_pickle=False))
