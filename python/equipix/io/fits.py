"""FITS files by astropy: frames, and results that astronomers' programs read.

The only module that imports astropy. Pages beside the viewed image are extensions of the name of
their array; its exact name stands in the keyword ARRAY.
"""

import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix.errors import FileError
from equipix.io.arrays import missing, native
from equipix.io.viewed import Viewed

SUFFIXES = (".fits", ".fit", ".fts")

READ = (*SUFFIXES, ".fz", ".gz")
"""Suffixes of files of frames; compressed ones are not written."""

_NAME, _TEXT = "ARRAY", "EQUIPIX-METADATA"

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
    fits = _astropy()
    from astropy.utils.exceptions import AstropyWarning

    with (
        warnings.catch_warnings(action="error", category=AstropyWarning),  # damage is a warning
        path.open("rb") as file,
        fits.open(file, memmap=False, checksum=True) as units,
    ):
        if _TEXT not in units:
            return {}, ""
        pages = {unit.header[_NAME]: native(unit.data) for unit in units if _NAME in unit.header}
        return pages, units[_TEXT].data.tobytes().decode()


def description(path: Path) -> str:
    """Text stored with a result; empty where there is none."""
    with _astropy().open(path) as units:
        return units[_TEXT].data.tobytes().decode() if _TEXT in units else ""


def settings(path: Path) -> tuple[float | None, float | None]:
    """Exposure time in s and temperature in °C, where the headers of a file hold them."""
    with _astropy().open(path) as units:
        return _keyword(units, "EXPTIME", "EXPOSURE"), _keyword(units, "CCD-TEMP", "SET-TEMP")


def _keyword(units: Any, *names: str) -> float | None:
    """Value of the first of some keywords that a header holds."""
    found = (unit.header[name] for name in names for unit in units if name in unit.header)
    return next((float(value) for value in found if isinstance(value, int | float)), None)


def header(path: Path) -> tuple[tuple[int, int, int], np.dtype[Any], str]:
    """Shape (n, rows, cols) and dtype of the frames of a file, none of which is decoded; its text.

    All images of one shape count, those of a cube one by one.
    """
    with _astropy().open(path) as units:
        images = _images(path, units)
        *_, rows, cols = images[0].shape
        count = sum(int(np.prod(unit.shape[:-2])) for unit in images)
        text = units[_TEXT].data.tobytes().decode() if _TEXT in units else ""
        return (count, rows, cols), native(_part(images[0], 1)).dtype, text


def stream_frames(path: Path) -> Iterator[NDArray[Any]]:
    """Frames of a file, one at a time, each of shape (1, rows, cols)."""
    with _astropy().open(path) as units:
        for unit in _images(path, units):
            *above, rows, cols = unit.shape
            for index in np.ndindex(*above):
                yield native(np.reshape(_part(unit, None, index), (1, rows, cols)))


def _part(unit: Any, size: int | None, index: tuple[int, ...] = ()) -> Any:
    """Some rows and columns of a frame, in the type that astropy gives to the whole."""
    frame = [slice(k, k + 1) for k in index or (0,) * (len(unit.shape) - 2)]
    return unit.section[(*frame, slice(size), slice(size))]


def _images(path: Path, units: Any) -> list[Any]:
    """Images of a file; those that extend an empty primary header count too."""
    images = [unit for unit in units if unit.is_image and len(unit.shape) >= 2]
    shapes = list(dict.fromkeys(unit.shape[-2:] for unit in images))
    if not shapes:
        held = ", ".join(f"{unit.name} {unit.shape}" for unit in units if unit.is_image)
        raise FileError(f"{path}: holds {held or 'tables'}, expected an image")
    beside = [unit.name for unit in images if unit.name in _BESIDE]
    if beside:
        raise FileError(
            f"{path}: holds {', '.join(beside)} beside its frames, expected frames only: export "
            "them to a file of their own"
        )
    if len(shapes) > 1:
        held = ", ".join(f"{unit.name} {unit.shape}" for unit in images)
        raise FileError(f"{path}: holds images of several shapes ({held}), expected one")
    return images
