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

from equipix.errors import EquipixError, FileError
from equipix.io.viewed import Viewed

SUFFIXES = (".fits", ".fit", ".fts")

_NAME, _TEXT = "ARRAY", "EQUIPIX-METADATA"

_USES = {"flat": "divide frames by it", "gain": "multiply frames by it"}

_KINDS = {8: "u1", 16: "i2", 32: "i4", 64: "i8", -32: "f4", -64: "f8"}
"""Types of the values by the keyword BITPIX."""


def _astropy() -> Any:
    """Import astropy's reader of FITS, which takes half a second."""
    try:
        from astropy.io import fits
    except ImportError as error:
        raise EquipixError(
            "FITS files need astropy, which is not installed: pip install 'equipix[fits]'"
        ) from error
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
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of checksums, and of broken headers
        return _read_pages(path)


def _read_pages(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    fits = _astropy()
    with path.open("rb") as file, fits.open(file, memmap=False, checksum=True) as units:
        if _TEXT not in units:
            return {}, ""
        pages = {unit.header[_NAME]: _native(unit.data) for unit in units if _NAME in unit.header}
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
        return (count, rows, cols), _dtype(images[0]), text


def stream_frames(path: Path) -> Iterator[NDArray[Any]]:
    """Frames of a file, one at a time, each of shape (1, rows, cols)."""
    with _astropy().open(path) as units:
        for unit in _images(path, units):
            *above, rows, cols = unit.shape
            for index in np.ndindex(*above):
                part = (*(slice(k, k + 1) for k in index), slice(None), slice(None))
                frame = unit.section[part] if above else unit.section[:, :]
                yield _native(np.reshape(frame, (1, rows, cols)))


def _images(path: Path, units: Any) -> list[Any]:
    """Images of a file; those that extend an empty primary header count too."""
    images = [unit for unit in units if unit.is_image and len(unit.shape) >= 2]
    shapes = list(dict.fromkeys(unit.shape[-2:] for unit in images))
    if not shapes:
        held = ", ".join(f"{unit.name} {unit.shape}" for unit in units if unit.is_image)
        raise FileError(f"{path}: holds {held or 'tables'}, expected an image")
    if len(shapes) > 1:
        held = ", ".join(f"{unit.name} {unit.shape}" for unit in images)
        raise FileError(f"{path}: holds images of several shapes ({held}), expected one")
    return images


def _dtype(unit: Any) -> np.dtype[Any]:
    """Type of the values: unsigned where BZERO makes it so, floating-point where it scales."""
    kind = np.dtype(_KINDS[unit.header["BITPIX"]])
    zero, scale = unit.header.get("BZERO", 0), unit.header.get("BSCALE", 1)
    if scale == 1 and zero == 2 ** (8 * kind.itemsize - 1) and kind.kind == "i":
        return np.dtype(f"u{kind.itemsize}")
    if (scale, zero) != (1, 0) and kind.kind != "f":
        return np.dtype(np.float32 if kind.itemsize < 4 else np.float64)
    return kind


def _native(array: NDArray[Any]) -> NDArray[Any]:
    """Values in the byte order of the machine."""
    return np.asarray(array, array.dtype.newbyteorder("="))
