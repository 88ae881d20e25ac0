"""Frames in files of arrays: NumPy, HDF5 and NeXus, Zarr. Each library is imported where it reads.

An array is (rows, cols) or (..., rows, cols). In HDF5 and Zarr its place stands behind a colon:
``file.h5:/entry/data``; without one it is the only array of two or more axes, or that which NeXus
names as the default.
"""

import hashlib
import itertools
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix.errors import EquipixError, FileError
from equipix.io import binary

_AT_ONCE = 2**26
"""Most bytes that are read at once; at least a frame is."""

_MOST_AT_ONCE = 2**29
"""Most bytes that are read at once where chunks of the file hold as many frames."""

_NPY = b"\x93NUMPY"

HDF5, ZARR = (".h5", ".hdf5", ".nxs", ".nx5"), (".zarr",)

SUFFIXES = (".npy", *HDF5, *ZARR)

_PLACE = re.compile(rf"(.*?(?:{'|'.join(map(re.escape, (*HDF5, *ZARR)))})):(.*)", re.I | re.S)
"""A file, and the place of an array in it."""

_MOST_LISTED = 8

_MARK = "description"
"""Attribute that holds what wrote the array."""

_LEAST_SIDE = 8
"""Fewest rows and columns of what is a colour image, where 3 or 4 values stand on the last axis."""


def split(path: Path) -> tuple[Path, str]:
    """Return the file, and what stands behind its name: the place of an array in it, or a layout.

    Empty where nothing does.
    """
    if (found := _PLACE.fullmatch(str(path))) is not None:
        return Path(found[1]), found[2]
    name, layout = binary.split(str(path))
    return (Path(name), layout) if layout else (path, "")


def header(path: Path) -> tuple[tuple[int, int, int], np.dtype[Any], str]:
    """Shape (n, rows, cols) and dtype of the frames; the text that `ZarrFrames` writes."""
    with _opened(path) as array:
        _refuse_missing(path, array, ())
        *above, rows, cols = array.shape
        text = _text(array, _MARK).strip() if hasattr(array, "attrs") else ""
        return (int(np.prod(above)), rows, cols), np.dtype(array.dtype).newbyteorder("="), text


def stream_frames(path: Path, start: int = 0, stop: int | None = None) -> Iterator[NDArray[Any]]:
    """Frames of a file, some at a time, each part of shape (n, rows, cols); no chunk twice."""
    with _opened(path) as array:
        *above, _, _ = array.shape
        if not above:
            yield native(_read(path, array, ()))[None]
            return
        *outer, inner = above
        count = _at_once(array)
        stop = math.prod(above) if stop is None else stop
        for number, place in enumerate(np.ndindex(*outer)):
            here = range(inner)[max(start - number * inner, 0) : max(stop - number * inner, 0)]
            for first in range(here.start // count * count, here.stop, count):
                part = slice(max(first, here.start), min(first + count, here.stop))
                yield native(_read(path, array, (*place, part)))


def _read(path: Path, array: Any, place: tuple[int | slice, ...]) -> Any:
    """Read frames; the chunks of a file of hours may be removed meanwhile."""
    _refuse_missing(path, array, place)
    return array[place]


def _refuse_missing(path: Path, array: Any, place: tuple[int | slice, ...]) -> None:
    """Refuse frames of which files of a Zarr array are missing: they are read as a fill value."""
    folder, _ = split(path)
    if folder.suffix.lower() not in ZARR:
        return
    ranges = [
        range(n)[each] if isinstance(each, slice) else range(each, each + 1)
        for each, n in zip(place, array.shape, strict=False)
    ]
    ranges += map(range, array.shape[len(place) :])
    parts = [
        range(each.start // side, math.ceil(each.stop / side))
        for each, side in zip(ranges, array.shards or array.chunks, strict=True)
    ]
    for chunk in itertools.product(*parts):
        file = _chunk_file(Path(folder, array.path), array, chunk)
        if not file.exists():
            raise FileError(
                f"{path}: lacks the chunk '{file}', which would be read as {array.fill_value}: "
                "copy it again, or write chunks of one value too (of zarr: write_empty_chunks)"
            )


def _chunk_file(folder: Path, array: Any, chunk: tuple[int, ...]) -> Path:
    return Path(folder, array.metadata.encode_chunk_key(chunk))


def chunk_frames(path: Path) -> int:
    """Number of frames in a chunk of a file; 1 without chunks, or where one is too large."""
    if split(path)[0].suffix.lower() not in (*HDF5, *ZARR):
        return 1
    with _opened(path) as array:
        return _chunk_frames(array)


def _chunk_frames(array: Any) -> int:
    chunks = getattr(array, "chunks", None)
    chunk = int(chunks[-3]) if chunks is not None and len(chunks) > 2 else 1
    return chunk if chunk * _frame_bytes(array) <= _MOST_AT_ONCE else 1


def _frame_bytes(array: Any) -> int:
    return int(math.prod(array.shape[-2:]) * array.dtype.itemsize)


def _at_once(array: Any) -> int:
    """Number of frames that are read at once: whole chunks, where there is memory for them."""
    chunk = _chunk_frames(array)
    return int(max(chunk, _AT_ONCE // _frame_bytes(array) // chunk * chunk))


def native(values: Any) -> NDArray[Any]:
    """Values in the byte order of the machine."""
    return np.asarray(values, np.dtype(values.dtype).newbyteorder("="))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open the array of a file, of numbers and of two axes or more."""
    file, place = split(path)
    suffix = file.suffix.lower()
    opened = _npy if suffix == ".npy" else _hdf5 if suffix in HDF5 else _zarr
    with opened(file, place) as array:
        if array.ndim < 2 or 0 in array.shape or np.dtype(array.dtype).kind not in "uif":
            raise FileError(
                f"{path}: is {array.dtype} of shape {array.shape}, expected numbers of shape "
                "(rows, cols) or (n, rows, cols), each 1 or more"
            )
        is_deep = array.ndim > 2 and min(array.shape[-3:-1]) >= _LEAST_SIDE
        if is_deep and array.shape[-1] in (3, 4):
            raise FileError(
                f"{path}: is {array.dtype} of shape {array.shape}, as colour images are, expected "
                "one grey channel of shape (rows, cols) or (n, rows, cols): save one channel alone"
            )
        yield array


@contextmanager
def _npy(file: Path, _: str) -> Iterator[Any]:
    with file.open("rb") as stream:
        if stream.read(len(_NPY)) != _NPY:
            raise FileError(f"{file}: is no .npy file, whatever its name says")
    yield np.load(file, mmap_mode="r", allow_pickle=False)


def hdf5_library() -> Any:
    """Import the library of HDF5 files."""
    try:
        import h5py
    except ImportError as error:
        raise missing("HDF5", "h5py", "hdf5") from error
    return h5py


@contextmanager
def _hdf5(file: Path, place: str) -> Iterator[Any]:
    h5py = hdf5_library()
    with h5py.File(file) as root:
        arrays: list[str] = []

        def visit(name: str, each: Any) -> None:
            if isinstance(each, h5py.Dataset) and each.ndim >= 2:
                arrays.append(f"/{name}")

        root.visititems(visit)
        chosen = place or _nexus_default(root, h5py.Group)
        yield _chosen(file, root, chosen, arrays, lambda each: isinstance(each, h5py.Dataset))


def _nexus_default(root: Any, kind: type) -> str:
    """Place of the default plot of NeXus: ``default`` of each group, then ``signal``."""
    groups = [root]
    while isinstance(found := groups[-1].get(_text(groups[-1], "default")), kind):
        if found in groups:
            break
        groups.append(found)
    signal = _text(groups[-1], "signal")
    return f"{groups[-1].name}/{signal}" if signal in groups[-1] else ""


def _text(group: Any, name: str) -> str:
    """Text of an attribute, which programs store in several types; a space where there is none."""
    found = np.ravel(group.attrs.get(name, " "))[0]
    return found.decode() if isinstance(found, bytes) else str(found)


def _zarr_library() -> Any:
    try:
        import zarr
    except ImportError as error:
        raise missing("Zarr", "zarr", "zarr") from error
    return zarr


class ZarrFrames:
    """A Zarr array that is written by whole chunks of frames, by several processes at once.

    Parameters
    ----------
    path : Path
        Folder of the array.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def ensure(
        self, shape: tuple[int, int, int], dtype: np.dtype[Any], chunk: int, **texts: object
    ) -> None:
        """Make an array of chunks of so many frames, with texts as its attributes.

        One that is there is kept with its chunks, unless its metadata are damaged. The texts are
        written anew: a dark may have been renamed since.
        """
        zarr = _zarr_library()

        def create(store: Any) -> Any:
            return zarr.create_array(
                store,
                shape=shape,
                dtype=dtype,
                chunks=(chunk, *shape[1:]),
                attributes=texts,
                overwrite=True,
            )

        def layout(array: Any) -> dict[str, Any]:
            return {**array.metadata.to_dict(), "attributes": {}}

        try:
            array = zarr.open_array(str(self.path), mode="r+")
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            array = None
        if array is None or layout(array) != layout(create({})):
            create(str(self.path))
        elif array.attrs.asdict() != texts:
            array.attrs.put(texts)

    def clean(self) -> None:
        """Remove what processes that were killed left of chunks they had begun."""
        for part in self.path.rglob("*.partial"):
            part.unlink(missing_ok=True)

    def write(self, start: int, frames: NDArray[Any]) -> None:
        """Write one chunk, or the last frames, and wait until they are on the disk."""
        zarr = _zarr_library()
        # It would leave out chunks of zeros, and a chunk that was lost would look the same.
        with zarr.config.set({"array.write_empty_chunks": True}):
            array = zarr.open_array(str(self.path), mode="r+")
            array[start : start + len(frames)] = frames
        with self._chunk(array, start).open("rb+") as file:
            os.fsync(file.fileno())

    def sha256(self, start: int, stop: int) -> str:
        """Hash of the files of the chunks that hold these frames."""
        array = _zarr_library().open_array(str(self.path), mode="r")
        found = hashlib.sha256()
        for at in range(start, stop, array.chunks[0]):
            found.update(self._chunk(array, at).read_bytes())
        return found.hexdigest()

    def _chunk(self, array: Any, start: int) -> Path:
        return _chunk_file(self.path, array, (start // array.chunks[0], 0, 0))


@contextmanager
def _zarr(file: Path, place: str) -> Iterator[Any]:
    zarr = _zarr_library()
    root = zarr.open(str(file), mode="r")
    if isinstance(root, zarr.Array):
        yield root
        return
    arrays = [f"/{name}" for name, each in root.members(None) if getattr(each, "ndim", 0) >= 2]
    yield _chosen(file, root, place, arrays, lambda each: isinstance(each, zarr.Array))


def _chosen(
    file: Path, root: Any, place: str, arrays: list[str], is_array: Callable[[Any], bool]
) -> Any:
    """Array at a place, or the only one."""
    if not place and len(arrays) == 1:
        (place,) = arrays
    if place and place in root and is_array(root[place]):
        return root[place]
    listed = ", ".join(arrays[:_MOST_LISTED]) or "no array of two or more axes"
    more = f" and {len(arrays) - _MOST_LISTED} more" if len(arrays) > _MOST_LISTED else ""
    wrong = f"has no array '{place}'; it " if place else ""
    raise FileError(f"{file}: {wrong}holds {listed}{more}: name one, as in {file}:/entry/data")


def missing(what: str, library: str, extra: str) -> EquipixError:
    """Return an error that names a library, and what installs it."""
    return EquipixError(
        f"{what} files need {library}, which is not installed: pip install 'equipix[{extra}]'"
    )
