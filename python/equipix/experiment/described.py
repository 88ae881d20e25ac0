"""What both kinds of manifest share: averages, masks, provenance."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np

from equipix._check import Bools, Floats, Progress
from equipix.errors import FileError
from equipix.experiment.image_files import image_files, refuse_repeats
from equipix.experiment.manifest import LevelManifest, Manifest, Region, entry_files
from equipix.io.frames import read_mask
from equipix.io.paths import as_path
from equipix.measured.average import average
from equipix.measured.noise import NoiseModel
from equipix.measured.statistics import FrameStatistics

_Manifest = TypeVar("_Manifest", Manifest, LevelManifest)


@dataclass(frozen=True)
class Described(ABC, Generic[_Manifest]):
    """Images of a sensor as files on disk, and the file that describes them.

    Attributes
    ----------
    path : Path
        The file that describes them.
    manifest : Manifest or LevelManifest
        Its checked content.
    """

    path: Path
    manifest: _Manifest

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read and check the description.

        Parameters
        ----------
        path : str or path
            The experiment.toml, or the levels.toml of a `LevelExperiment`.

        Returns
        -------
        Experiment or LevelExperiment
            What `run` evaluates.

        Raises
        ------
        FileError
            If the file cannot be read, has an unknown key or a wrong value, or names a file that
            does not exist, or one file for two measurements.
        """
        file = as_path("path", path)
        described = cls(file, cls._read(file))
        described.files()
        refuse_repeats(file, described.manifest)
        return described

    def files(self) -> list[Path]:
        """All image files, each once."""
        mask = self.manifest.sensor.mask
        masks: list[Path] = [] if mask is None else entry_files(self.path, mask)
        return list(dict.fromkeys([*self._images(), *masks]))

    @classmethod
    @abstractmethod
    def _read(cls, path: Path) -> _Manifest:
        """Read and check a file."""

    def _images(self) -> list[Path]:
        """The files of measurements, each once, those of the dark first."""
        return image_files(self.path, self.manifest)

    def _statistics(
        self,
        name: str,
        entry: str | list[str],
        dark: FrameStatistics | None,
        workers: int | None,
        progress: Progress | None,
    ) -> FrameStatistics:
        """Average the files of an entry; `name` is for the progress."""

        def report(done: int, total: int, _: str) -> None:
            if progress is not None:
                progress(done, total, f"averaging {name}")

        sensor, files = self.manifest.sensor, entry_files(self.path, entry)
        level = sensor.saturation_level
        found = average(files, dark=dark, saturation=level, workers=workers, progress=report)
        if sensor.largest is not None and found.mean.max() > sensor.largest:
            raise FileError(
                f"{self.path}: '{files[0].name}' of {name} holds means up to "
                f"{found.mean.max():.0f} DN, above {sensor.largest}, the largest value "
                f"that 'bit_depth' = {sensor.bit_depth} holds: correct 'bit_depth' in [sensor]"
            )
        return found


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
    file = entry_files(path, entry)[0]
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


def provenance(
    path: Path,
    manifest: Manifest,
    hashes: Mapping[Path, str],
    shifts: Floats,
    std: Floats,
    noise: NoiseModel | None,
) -> dict[str, Any]:
    """Names, measured shifts, noise and the hashes of the files, as JSON values."""
    folder = path.parent
    return {
        "experiment": str(path),
        "sensor": manifest.sensor.model_dump(),
        "exposures": [exposure.name for exposure in manifest.exposure],
        "measured_shifts": shifts.tolist(),
        "measured_shift_std": std.tolist(),
        "noise": None if noise is None else asdict(noise),
        "inputs": {os.path.relpath(file, folder): digest for file, digest in hashes.items()},
    }
