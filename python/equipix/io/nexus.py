"""NeXus files by h5py: results that programs of synchrotrons and neutron sources read.

The detector holds what those programs use. The record stands beside it, in a collection of the
entry, with its arrays by their names and its text.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equipix.findings import Flag
from equipix.io.arrays import HDF5, hdf5_library
from equipix.io.viewed import Viewed

SUFFIXES = HDF5

_KEPT = "entry/equipix"

_BITS = {Flag.DEAD: 1 << 1, Flag.HOT: 1 << 3, Flag.TELEGRAPH: 1 << 4}
"""Bits of ``pixel_mask``: dead, over responding, noisy."""

_OTHER = 1 << 8
"""Bit of ``pixel_mask`` of a pixel that is masked for another reason."""


def write_pages(
    path: Path, pages: Mapping[str, NDArray[Any]], text: str, viewed: Viewed | None
) -> None:
    """Write a detector with its flat field and mask, and all arrays as a collection."""
    with hdf5_library().File(path, "w") as root:
        root.attrs.update(NX_class="NXroot", default="entry")
        entry = _group(root, "entry", "NXentry")
        if viewed is not None:
            _write_detector(entry, viewed)
        kept = _group(entry, "equipix", "NXcollection")
        kept["metadata"] = text
        arrays = _group(kept, "arrays", "NXcollection")
        for name, array in pages.items():
            arrays[name] = array


def _write_detector(entry: Any, viewed: Viewed) -> None:
    """Write the map, a flat to divide by, as that of a detector and as the default plot."""
    if viewed.kind == "gain":
        viewed = viewed.exported("flat")
    name = "data" if viewed.kind == "mean" else "flatfield"
    instrument = _group(entry, "instrument", "NXinstrument")
    detector = _group(instrument, "detector", "NXdetector")
    maps = {name: viewed.image}
    if viewed.std is not None:
        maps[f"{name}_errors"] = viewed.std
    plot = _group(entry, "data", "NXdata")
    plot.attrs["signal"] = name
    entry.attrs["default"] = "data"
    for each, image in maps.items():
        detector[each] = image
        detector[each].attrs["units"] = viewed.unit or "1"
        plot[each] = hdf5_library().SoftLink(detector[each].name)
    detector["flatfield_applied"] = detector["pixel_mask_applied"] = np.False_
    detector["pixel_mask"] = _pixel_mask(viewed)


def _pixel_mask(viewed: Viewed) -> NDArray[np.uint32]:
    mask = np.zeros(viewed.mask.shape, np.uint32)
    for flag, bit in _BITS.items():
        mask[viewed.mask & ((viewed.flags & flag) != 0)] |= bit
    mask[viewed.mask & (mask == 0)] = _OTHER
    return mask


def _group(parent: Any, name: str, kind: str) -> Any:
    group = parent.create_group(name, track_order=True)
    group.attrs["NX_class"] = kind
    return group


def read_pages(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    """Read what `write_pages` wrote: arrays by name, and the text; of other files none."""
    with hdf5_library().File(path) as root:
        if _KEPT not in root:
            return {}, ""
        kept = root[_KEPT]
        pages = {name: np.asarray(each) for name, each in kept["arrays"].items()}
        return pages, str(kept["metadata"].asstr()[()])


def description(path: Path) -> str:
    """Text stored with a result; empty where there is none."""
    with hdf5_library().File(path) as root:
        return str(root[_KEPT]["metadata"].asstr()[()]) if _KEPT in root else ""
