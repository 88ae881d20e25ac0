"""FITS files by astropy: frames, and results that astronomers' programs read.

The only module that imports astropy. Pages beside the viewed image are extensions of the name of
their array; its exact name stands in the keyword ARRAY.
"""

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from equipix.errors import FileError
from equipix.io.arrays import missing, native
from equipix.io.viewed import Viewed

SUFFIXES = (".fits", ".fit", ".fts")

READ = (*SUFFIXES, ".fz", ".gz")
"""Suffixes of files of frames; compressed ones are not written."""

_NAME, _TEXT, _MARK = "ARRAY", "EQUIPIX-METADATA", "EQUIPIX"

_FOLLOWING = "NEXTEND"
"""Keyword of the number of images behind the first, as the Hubble telescope's files have it."""

_OF_VALUES = ("BSCALE", "BZERO", "BLANK", "DATAMIN", "DATAMAX", "CHECKSUM", "DATASUM", "INHERIT")
"""Keywords that say something of the values of an image, and do not hold for others."""

_TYPES = ("IMAGETYP", "OBSTYPE", "FRAME")
"""Keywords of what an image shows."""

_KINDS = {
    "dark": ("dark",),
    "bias": ("bias", "zero"),  # zero: as IRAF calls it
    "light": ("light", "object", "science", "flat"),
}
"""What the words on types of images contain, of several the first."""

_USES = {"flat": "divide frames by it", "gain": "multiply frames by it"}

_BESIDE = ("UNCERT", "ERR", "ERROR", "VAR", "VARIANCE", "IVAR", "MASK", "DQ", "WHT", "WEIGHT")
"""Names of images that say something of the pixels of another."""


def _astropy() -> Any:
    """Import astropy's reader of FITS, which takes half a second."""
    try:
        from astropy.io import fits
    except ImportError as error:
        raise missing("FITS", "astropy", "fits") from error
    return fits


@contextmanager
def _opened(path: Path, **options: bool) -> Iterator[Any]:
    """Open a file, which is closed even where astropy does not know what it holds."""
    with path.open("rb") as file, _astropy().open(file, **options) as units:
        yield units


def write_pages(
    path: Path, pages: Mapping[str, NDArray[Any]], text: str, viewed: Viewed | None
) -> None:
    """Write what other programs see as the primary image, and all arrays as extensions."""
    fits = _astropy()
    units = [fits.PrimaryHDU() if viewed is None else fits.PrimaryHDU(viewed.image)]
    if viewed is not None:
        units[0].header["MAP"] = (viewed.name, _USES.get(viewed.kind, ""))
        units[0].header["BUNIT"] = (viewed.unit or "1", "1: a ratio")
        if viewed.std is not None:
            uncertainty = fits.ImageHDU(viewed.std, name="UNCERT")
            uncertainty.header["UTYPE"] = "StdDevUncertainty"
            units.append(uncertainty)
        units.append(fits.ImageHDU(viewed.mask.astype(np.uint8), name="MASK"))
    for name, array in pages.items():
        page = fits.ImageHDU(array, name=name.upper())
        page.header[_NAME] = name
        units.append(page)
    units.append(fits.ImageHDU(np.frombuffer(text.encode(), np.uint8), name=_TEXT))
    every = fits.HDUList(units)
    every.update_extend()
    for unit in every:
        unit.add_checksum(when="HDU checksum")  # not the time: the same result, the same file
    with path.open("wb") as file:
        every.writeto(file)


def ccddata(viewed: Viewed) -> Any:
    """Return a map as astropy's ``CCDData``."""
    _astropy()  # names what is missing
    from astropy.nddata import CCDData, StdDevUncertainty

    std = None if viewed.std is None else StdDevUncertainty(viewed.std)
    return CCDData(viewed.image, unit=viewed.unit, mask=viewed.mask, uncertainty=std)


def read_pages(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    """Read what `write_pages` wrote: arrays by name, and the text; of other files none."""
    _astropy()  # names what is missing
    from astropy.utils.exceptions import AstropyWarning

    with (
        warnings.catch_warnings(action="error", category=AstropyWarning),  # damage is a warning
        _opened(path, memmap=False, checksum=True) as units,
    ):
        if _TEXT not in units:
            return {}, ""
        pages = {unit.header[_NAME]: native(unit.data) for unit in units if _NAME in unit.header}
        return pages, units[_TEXT].data.tobytes().decode()


def _keyword(units: Any, *names: str, least: float = -math.inf) -> float | None:
    """First number from the least on that a header holds under some keywords."""
    found = (unit.header[name] for name in names for unit in units if name in unit.header)
    numbers = (float(value) for value in found if isinstance(value, int | float))
    return next((value for value in numbers if value >= least), None)


class ImageType(NamedTuple):
    """What an image shows in the words of its header, such as "Dark Frame", and their keyword."""

    value: str = ""
    keyword: str = ""

    @property
    def kind(self) -> str:
        """What it is in short: dark, bias or light; nothing of other words. A flat dark is dark."""
        shown = self.value.lower()
        named = (kind for kind, words in _KINDS.items() if any(word in shown for word in words))
        return next(named, "")

    def __str__(self) -> str:
        """Return the words for a message."""
        return f"'{self.value}' by its header ({self.keyword})"


Header = tuple[
    tuple[int, int, int], np.dtype[Any], str, tuple[float | None, float | None], ImageType
]
"""Shape and dtype of frames, text, exposure time in s and temperature in °C, type of image."""


def header(path: Path) -> Header:
    """Read what a file holds beside its frames, none of which is decoded, in one go.

    All images of one shape count, those of a cube one by one. Of a result that was saved, whose
    text says so, images may be of several shapes.
    """
    with _opened(path) as units:
        text = units[_TEXT].data.tobytes().decode() if _TEXT in units else ""
        images = _every_image(units) if text else _images(path, units)
        *_, rows, cols = images[0].shape
        count = sum(int(np.prod(unit.shape[:-2])) for unit in images)
        text = text or str(images[0].header.get(_MARK, ""))
        # Programs write a time below 0, as -1, where they do not know it.
        time = _keyword(units, "EXPTIME", "EXPOSURE", least=0)
        taken = time, _keyword(units, "CCD-TEMP", "SET-TEMP")
        return (count, rows, cols), native(_part(images[0], 1)).dtype, text, taken, _type(units)


def _type(units: Any) -> ImageType:
    found = (ImageType(unit.header.get(name), name) for name in _TYPES for unit in units)
    return next((each for each in found if isinstance(each.value, str)), ImageType())


def stream_frames(path: Path, start: int = 0, stop: int | None = None) -> Iterator[NDArray[Any]]:
    """Frames of a file, one at a time, each of shape (1, rows, cols)."""
    with _opened(path) as units:
        places = (
            (unit, index) for unit in _images(path, units) for index in np.ndindex(*unit.shape[:-2])
        )
        for unit, index in islice(places, start, stop):
            yield native(np.reshape(_part(unit, None, index), (1, *unit.shape[-2:])))


def write_frames(
    path: Path,
    frames: Iterable[NDArray[Any]],
    sources: Iterable[tuple[Path, tuple[int, int, int], Sequence[str]]],
    *,
    dtype: np.dtype[Any],
    mark: str,
) -> None:
    """Write frames as the images of a file, holding one at a time.

    Parameters
    ----------
    path : Path
        Output, written in place: a file that does not exist.
    frames : iterable of ndarray, shape (rows, cols)
        The frames of all sources, of one type.
    sources : iterable of (Path, shape, lines of history)
        Files that the frames were made from, each with the shape (n, rows, cols) of its frames. An
        image gets the axes and the header of that in a FITS file, with what the primary header
        has beside it.
    dtype : dtype
        Type of the frames.
    mark : str
        ASCII text, stored with each image.
    """
    fits, rest = _astropy(), iter(frames)
    images = [
        (axes, _head(kept, axes, dtype, mark, history))
        for file, shape, history in sources
        for kept, axes in _heads(file, shape)
    ]
    images[0][1][_FOLLOWING] = (len(images) - 1, "images that follow")
    for axes, head in images:
        with closing(fits.StreamingHDU(str(path), head)) as stream:
            for frame in islice(rest, math.prod(axes[:-2])):
                # FITS has no unsigned numbers of 16 bits: 0 is stored as -32768.
                whole = dtype == np.uint16
                stream.write((frame ^ 2**15).view(np.int16) if whole else frame)


def _heads(path: Path, shape: tuple[int, int, int]) -> list[tuple[Any, tuple[int, ...]]]:
    """Header and axes of each image that the frames of a file came from."""
    if path.suffix.lower() not in READ:
        return [(_astropy().Header(), shape if shape[0] > 1 else shape[1:])]
    found = []
    with _opened(path) as units:
        for unit in _images(path, units):
            unit.verify("silentfix+ignore")
            kept = unit.header.copy(strip=True)
            if unit is not units[0]:
                kept.extend(units[0].header.copy(strip=True), unique=True)
            found.append((kept, unit.shape))
    return found


def _head(
    kept: Any, axes: tuple[int, ...], dtype: np.dtype[Any], mark: str, history: Sequence[str]
) -> Any:
    """Header of an image of other values: what is kept of another, and how they were made."""
    head = _astropy().PrimaryHDU().header.copy()
    head["BITPIX"] = -32 if dtype.kind == "f" else 8 * dtype.itemsize
    head["NAXIS"] = len(axes)
    place = "NAXIS"
    for number, size in enumerate(reversed(axes), start=1):
        head.set(f"NAXIS{number}", size, after=place)
        place = f"NAXIS{number}"
    head.extend(kept, strip=True, unique=True)
    for name in (*_OF_VALUES, _FOLLOWING):
        head.remove(name, ignore_missing=True)
    if dtype == np.uint16:
        head["BSCALE"], head["BZERO"] = 1, 2**15
    head["BUNIT"] = head.get("BUNIT") or "adu"
    head[_MARK] = mark
    for line in (mark, *history):
        head.add_history(line.encode("ascii", "replace").decode())
    return head


def _part(unit: Any, size: int | None, index: tuple[int, ...] = ()) -> Any:
    """Some rows and columns of a frame, in the type that astropy gives to the whole."""
    frame = [slice(k, k + 1) for k in index or (0,) * (len(unit.shape) - 2)]
    return unit.section[(*frame, slice(size), slice(size))]


def _images(path: Path, units: Any) -> list[Any]:
    """Images of a file; those that extend an empty primary header count too."""
    images = _every_image(units)
    shapes = list(dict.fromkeys(unit.shape[-2:] for unit in images))
    if not shapes:
        held = _in_words(unit for unit in units if unit.is_image)
        raise FileError(f"{path}: holds {held or 'tables'}, expected an image")
    beside = [unit.name for unit in images if unit.name in _BESIDE]
    if beside:
        raise FileError(
            f"{path}: holds {', '.join(beside)} beside its frames, expected frames only: export "
            "them to a file of their own"
        )
    if len(shapes) > 1:
        raise FileError(
            f"{path}: holds images of several shapes ({_in_words(images)}), expected one"
        )
    # Programs that copy headers leave a wrong number in files of others.
    first = units[0].header
    missing_images = first.get(_FOLLOWING, 0) - len(units) + 1 if _MARK in first else 0
    if missing_images > 0:
        raise FileError(f"{path}: lacks {missing_images} images at its end: is truncated")
    return images


def _in_words(images: Iterable[Any]) -> str:
    """Name images, where they have names, with their shapes."""
    return ", ".join(f"{unit.name} {unit.shape}".strip() for unit in images)


def _every_image(units: Any) -> list[Any]:
    return [unit for unit in units if unit.is_image and len(unit.shape) >= 2]
