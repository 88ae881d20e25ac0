"""Pixels that experiment.toml excludes: a mask file, and regions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from equipix.errors import FileError
from equipix.experiment.manifest import find_files
from equipix.io import read_mask

if TYPE_CHECKING:
    from pathlib import Path

    from equipix._types import Bools
    from equipix.experiment.manifest import LevelManifest, Manifest, Region


def excluded_pixels(
    path: Path, manifest: Manifest | LevelManifest, shape: tuple[int, int]
) -> Bools | None:
    """Return the pixels that ``[sensor]`` excludes; None without a mask and regions.

    Parameters
    ----------
    path : Path
        The experiment.toml or levels.toml.
    manifest : Manifest or LevelManifest
        Its content.
    shape : tuple of int
        Rows and columns of the sensor.

    Returns
    -------
    ndarray of bool, shape (rows, cols), or None
        True = do not use.

    Raises
    ------
    FileError
        If the mask file is of another shape, a region reaches beyond the sensor, or nothing is
        left.
    """
    sensor = manifest.sensor
    if sensor.mask is None and sensor.region is None:
        return None
    excluded = np.zeros(shape, bool)
    if sensor.mask is not None:
        excluded |= _of_file(path, sensor.mask, shape)
    for index, region in enumerate(sensor.region or [], start=1):
        excluded |= _of_region(f"{path}: [[sensor.region]] {index}", region, shape)
    if excluded.all():
        raise FileError(f"{path}: 'mask' and 'region' in [sensor] leave no pixel to use")
    return excluded


def _of_file(path: Path, entry: str, shape: tuple[int, int]) -> Bools:
    file = find_files(path, entry)[0]
    mask = read_mask(file)
    if mask.shape != shape:
        raise FileError(
            f"{file}: is a mask of shape {mask.shape}, expected {shape} like the frames"
        )
    return mask


def _of_region(place: str, region: Region, shape: tuple[int, int]) -> Bools:
    shaped = _rectangle if region.centre is None else _disc
    inside = shaped(place, region, shape)
    return ~inside if region.outside else inside


def _rectangle(place: str, region: Region, shape: tuple[int, int]) -> Bools:
    inside = np.zeros(shape, bool)
    spans = []
    for name, span, size in zip(("rows", "cols"), (region.rows, region.cols), shape, strict=True):
        first, end = span or (0, size)
        if end > size:
            raise FileError(f"{place}: '{name}' ends at {end}, expected at most {size}")
        spans.append(slice(first, end))
    inside[tuple(spans)] = True
    return inside


def _disc(place: str, region: Region, shape: tuple[int, int]) -> Bools:
    row, col = region.centre or (0.0, 0.0)
    rows, cols = np.ogrid[: shape[0], : shape[1]]
    inside: Bools = np.hypot(rows - row, cols - col) <= (region.radius or 0.0)
    if not inside.any():
        raise FileError(
            f"{place}: 'centre' {[row, col]} and 'radius' {region.radius:g} name no pixel of the "
            f"sensor, which has {shape[0]} rows and {shape[1]} columns"
        )
    return inside
