"""TIFF files by tifffile: frames that the compiled reader does not decode, and all outputs.

The only module that imports tifffile.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from equipix.errors import FileError
from equipix.io.paths import reading
from equipix.io.viewed import Viewed

_PAGE_NAME = 285  # TIFF tag

_PAGE_NUMBER = 297  # TIFF tag: number from 0, and how many there are

_VIEW = "view"  # name of the page for other programs, which no result reads

_SUBFILE_TYPE = 255  # TIFF tag

_PHOTOMETRIC = 262  # TIFF tag

_EXPOSURE_TIME = 33434  # TIFF tag: of DNG and EXIF

_EXIF = 34665  # TIFF tag

_MAX_COMPRESSION = 4096  # no lossless coding packs tighter

_TIFF_LIMIT = 2**32 - 2**25  # bytes of pixels that leave space for the directories


def header(path: Path) -> tuple[tuple[int, int, int], np.dtype[Any], str]:
    """Shape (n, rows, cols) and dtype of the frames of a file, none of which is decoded; its text.

    The text is stored with the first page; empty where there is none.
    """
    with reading(path), tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        _check_page(path, page, file.filehandle.size)
        _check_planes(path, file)
        count = max(len(file.pages), file.series[0].size // page.size)
        return (count, *page.shape), page.dtype, str(page.description)


def stream_frames(path: Path, start: int = 0, stop: int | None = None) -> Iterator[NDArray[Any]]:
    """Frames of a file, one at a time, each of shape (1, rows, cols)."""
    with reading(path), tifffile.TiffFile(path) as file:
        pages = len(file.pages)
        if pages == 0:
            raise FileError(f"{path}: is broken: it has no pages")
        for page in file.pages:
            _check_page(path, page, file.filehandle.size)
        _check_planes(path, file)
        if pages == 1 and file.series[0].size > file.pages[0].size:
            # A stack with a directory for its first frame only: mapped, not read at once.
            yield from tifffile.memmap(path, mode="r")[..., None, :, :].reshape(
                -1, 1, *file.pages[0].shape
            )[start:stop]
            return
        for page in file.pages[start:stop]:
            frame = page.asarray()
            if frame.shape != page.shape:  # how tifffile reports missing pixels
                raise FileError(f"{path}: is broken: a page has no pixels")
            yield frame[None]


def _check_page(path: Path, page: Any, length: int) -> None:
    """Refuse what the compiled reader refuses: colour, white at 0, and pages that are no frames."""
    old_type = page.tags.valueof(_SUBFILE_TYPE, default=1)
    beside = page.subifds and not _is_view(page)
    if page.is_reduced or page.is_mask or beside or old_type == 2:
        raise FileError(
            f"{path}: holds a reduced copy or a mask beside its frames, expected frames only:"
            " export them to a file of their own"
        )
    if _PHOTOMETRIC in page.tags and page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        raise FileError(f"{path}: has white at 0 (MinIsWhite), expected black at 0")
    grey = _PHOTOMETRIC not in page.tags or page.photometric == tifffile.PHOTOMETRIC.MINISBLACK
    if not grey or page.samplesperpixel != 1 or page.ndim != 2:
        raise FileError(
            f"{path}: is {page.photometric.name} of shape {page.shape}, expected one grey channel"
        )
    if page.nbytes > _MAX_COMPRESSION * length:
        raise FileError(f"{path}: claims {page.nbytes} bytes of pixels in a file of {length}")


def _check_planes(path: Path, file: Any) -> None:
    """Refuse an OME-TIFF whose pages are not frames of one thing: over time, or over depth."""
    if not file.is_ome:
        return
    series = file.series[0]
    *above, _, _ = series.shape
    own = [k for k, page in enumerate(series.pages) if page is not None and page.parent is file]
    places = np.unravel_index(own, above) if above else []
    varied = [axis for axis, each in zip(series.axes, places, strict=False) if np.ptp(each)]
    if len(file.series) > 1 or (varied and varied not in (["T"], ["Z"])):
        sizes = " x ".join(map(str, series.shape))
        images = f"{len(file.series)} images, the first " if len(file.series) > 1 else "pages "
        raise FileError(
            f"{path}: holds {images}of axes {series.axes} ({sizes}), expected one channel over "
            "time (T) or depth (Z): export what the frames are to a file of its own"
        )


def exposure_s(path: Path) -> float | None:
    """Exposure time in s, where the file has EXIF or tags of DNG."""
    with tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        exif = page.tags.valueof(_EXIF, default={})
        found = page.tags.valueof(_EXPOSURE_TIME, default=exif.get("ExposureTime"))
    return found[0] / found[1] if isinstance(found, tuple) and found[1] else None


def write_frames(
    path: str | PathLike[str],
    frames: Iterable[NDArray[Any]],
    *,
    nbytes: int,
    description: str | None = None,
) -> None:
    """Write frames as the pages of a TIFF file, holding one at a time.

    Parameters
    ----------
    path : path
        Output, written in place: use a folder that no other process reads.
    frames : iterable of ndarray, shape (rows, cols)
        The frames.
    nbytes : int
        Bytes of all frames together; above 4 GB they need BigTIFF.
    description : str, optional
        ASCII text, stored with the first page.
    """
    with tifffile.TiffWriter(path, bigtiff=nbytes > _TIFF_LIMIT) as file:
        for frame in frames:
            file.write(frame, photometric="minisblack", metadata=None, description=description)
            description = None


def write_pages(
    path: Path, pages: Mapping[str, NDArray[Any]], description: str, viewed: Viewed | None
) -> None:
    """Write named arrays as pages, with a description of the first.

    What other programs show of the result is the only page of the file, in single precision: the
    others are its SubIFDs, since ImageJ refuses a file with a page of 64 bits. They are of another
    photometric interpretation, DepthMap of DNG 1.5, since tifffile makes one stack of alike images.

    The images of a stack have the stack's name and are numbered; a single image has no number.
    Arrays of other sizes than the first one's are the last pages: tifffile takes all pages for
    equal where a few at the beginning and the last are.
    """
    behind = 0
    if viewed is not None:
        behind = sum(1 if array.ndim == 2 else len(array) for array in pages.values())
        pages = {_VIEW: viewed.image.astype(np.float32), **pages}
    sizes = [array.shape[-2:] for array in pages.values()]
    ordered = sorted(pages.items(), key=lambda each: each[1].shape[-2:] != sizes[0])
    big = sum(array.nbytes for array in pages.values()) > _TIFF_LIMIT
    with tifffile.TiffWriter(path, bigtiff=big) as file:
        for name, array in ordered:
            named = (_PAGE_NAME, "s", 0, name, True)
            images = [array] if array.ndim == 2 else array
            for number, image in enumerate(images):
                numbered = (_PAGE_NUMBER, "H", 2, (number, len(array)), True)
                file.write(
                    image,
                    photometric="depth_map" if viewed and name != _VIEW else "minisblack",
                    metadata=None,
                    description=description,
                    subifds=behind,
                    extratags=[named] if array.ndim == 2 else [named, numbered],
                )
                description, behind = "", 0


def read_pages(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    """Read what `write_pages` wrote: arrays by name, and the description; of other files none."""
    with tifffile.TiffFile(path) as file:
        every: Sequence[Any] = [*file.pages, *(file.pages[0].pages or ())]
        if any(_PAGE_NAME not in page.tags for page in every):
            return {}, ""
        images: dict[str, list[Any]] = {}
        for page in every:
            images.setdefault(page.tags[_PAGE_NAME].value, []).append(page)
        images.pop(_VIEW, None)
        pages = {name: _image_or_stack(path, name, found) for name, found in images.items()}
        return pages, every[0].description


def is_result(path: Path) -> bool:
    """Whether the file is a result with a page for other programs."""
    with suppress(FileError), reading(path), tifffile.TiffFile(path) as file:
        return _is_view(file.pages[0])
    return False


def _is_view(page: Any) -> bool:
    return bool(page.tags.valueof(_PAGE_NAME) == _VIEW)


def _image_or_stack(path: Path, name: str, images: Sequence[Any]) -> NDArray[Any]:
    """Read one array: an image without a number, or all images of a stack, in order."""
    numbers = [image.tags.valueof(_PAGE_NUMBER) for image in images]
    if numbers == [None]:
        return np.asarray(images[0].asarray())
    if numbers != [(number, len(images)) for number in range(len(images))]:
        raise FileError(
            f"{path}: is damaged: the pages named '{name}' are numbered {numbers}, expected each"
            f" number from 0 with their count {len(images)}"
        )
    stack = np.empty((len(images), *images[0].shape), images[0].dtype)
    for image, page in zip(stack, images, strict=True):
        page.asarray(out=image)
    return stack
