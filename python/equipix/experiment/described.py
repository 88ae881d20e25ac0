"""What all kinds of manifest share: averages, masks, provenance."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import (
    EXPOSURES,
    Array,
    Bools,
    Progress,
    Words,
    as_mask,
    naming_memory,
    staged,
    union,
)
from equipix.errors import FileError, InputError
from equipix.experiment.darks import Darks, chosen
from equipix.experiment.image_files import (
    black_level,
    check_formats,
    completed,
    image_files,
    refuse_other_types,
    refuse_repeats,
    sha256_of,
)
from equipix.experiment.manifest import (
    CameraManifest,
    LevelManifest,
    Manifest,
    entry_files,
    name_of_dark,
    read_manifest,
)
from equipix.io.formats import read_mask
from equipix.io.paths import as_path
from equipix.measured.average import average
from equipix.measured.colour import Colours
from equipix.measured.means import Averaged
from equipix.measured.settings import settings_in
from equipix.measured.statistics import FrameStatistics, refuse_subtracted
from equipix.shown import Brief

_Manifest = TypeVar("_Manifest", Manifest, LevelManifest, CameraManifest)


@dataclass(frozen=True)
class Described(Brief, Generic[_Manifest]):
    """Images of a sensor as files on disk, and the file that describes them.

    Attributes
    ----------
    path : Path
        The file that describes them.
    manifest : Manifest, LevelManifest or CameraManifest
        Its checked content.
    """

    path: Path
    manifest: _Manifest

    _model: ClassVar[Any]
    _dtype: ClassVar[type[np.floating[Any]]] = np.float64
    _words: ClassVar[Words] = EXPOSURES

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
        return replace(described, manifest=completed(file, described.manifest))

    @classmethod
    def _read(cls, file: Path) -> Any:
        """Read and check the content of the description."""
        return read_manifest(file, cls._model)

    def files(self) -> list[Path]:
        """All image files, each once."""
        mask = self.manifest.sensor.mask
        masks: list[Path] = [] if mask is None else self._entry(mask)
        return list(dict.fromkeys([*image_files(self.path, self.manifest), *masks]))

    def _entry(self, entry: str | list[str]) -> list[Path]:
        """Files of an entry."""
        return entry_files(self.path, entry, self.manifest.layout)

    def _statistics(
        self,
        name: str,
        entry: str | list[str],
        dark: FrameStatistics | Array | None,
        workers: int | None,
        progress: Progress | None,
        mask: Bools | None = None,
    ) -> FrameStatistics:
        """Average the files of an entry; `name` is for the progress."""
        sensor, files = self.manifest.sensor, self._entry(entry)
        level = sensor.saturation_level
        stage = staged(progress, f"averaging {name}")
        found = average(
            files, dark=dark, saturation=level, mask=mask, workers=workers, progress=stage
        )
        if sensor.largest is not None and np.nanmax(found.mean, initial=0) > sensor.largest:
            raise FileError(
                f"{self.path}: '{files[0].name}' of {name} holds means up to "
                f"{np.nanmax(found.mean):.0f} DN, above {sensor.largest}, the largest value "
                f"that 'bit_depth' = {sensor.bit_depth} holds: correct 'bit_depth' in [sensor]"
            )
        return found

    @naming_memory("averaging")
    def _darks(self, workers: int | None = None, progress: Progress | None = None) -> Darks:
        """Average the dark frames that are used; in a camera.toml they stand with exposures."""
        assert not isinstance(self.manifest, CameraManifest)
        choice, entries = chosen(self.path, self.manifest), self.manifest.dark or []
        shares = choice.shares
        if not entries and isinstance(self.manifest, Manifest):
            file = self.files()[0]
            levels, black = black_level(file)
            words = f"black level {levels} DN in '{file.name}'"
            return Darks((), shares, black, [words] * len(shares))
        if not entries:
            return Darks((), shares, words=[""] * len(shares))
        used = [k for k in range(len(entries)) if any(each[k] for each in shares)]
        frames = []
        for k in used:
            name = "dark" if len(entries) == 1 else f"dark {k + 1}"
            dark = self._statistics(name, entries[k].frames, None, workers, progress)
            files = ", ".join(map(str, self._entry(entries[k].frames)))
            refuse_subtracted(dark, f"{self.path}: {name_of_dark(k, len(entries))} {files}")
            pairs = entries[k].settings._asdict().items()
            stated = {key: value for key, value in pairs if value is not None}
            frames.append(replace(dark, metadata=dark.metadata | stated))
        shares = [tuple(each[k] for k in used) for each in shares]
        return Darks(tuple(frames), shares, None, choice.words, choice.findings)

    @naming_memory("averaging")
    def _average(
        self,
        darks: Darks,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> Averaged:
        """Mean of every exposure or level; the frames' other statistics are reduced at once."""
        sensor, measurements = self.manifest.sensor, self.manifest.measurements
        averaged = Averaged(
            count=len(measurements),
            dtype=self._dtype,
            gain=sensor.gain_dn_per_e,
            saturation=sensor.saturation_level,
            saturation_key=sensor.saturation_key,
            words=self._words,
            colours=Colours.of(sensor.cfa),
            darks=darks.frames,
            black=darks.black,
        )
        for k, (name, taken) in enumerate(measurements):
            statistics = self._statistics(name, taken.frames, darks.of(k), workers, progress)
            try:
                averaged.add(statistics, name, darks.shares[k] if darks.frames else None)
            except InputError as error:
                raise FileError(f"{self.path}: {error}") from error
            del statistics  # not beside those of the next one
        return averaged

    def _checked(self, mask: ArrayLike | None) -> tuple[Bools | None, dict[Path, str]]:
        """Check all images; pixels that the file or the caller excludes, and hashes of the files.

        Raises
        ------
        FileError
            If images differ in shape or depth, or have fewer bits than the sensor; if two are the
            same, or a header names another type of image; if the mask file is of another shape, a
            region reaches beyond the sensor, or nothing is left.
        """
        files, bits = image_files(self.path, self.manifest), self.manifest.sensor.bit_depth
        shape: tuple[int, int] = check_formats(files, bits)
        refuse_other_types(self.path, self.manifest)
        count = len(self.manifest.measurements)
        given = None if mask is None else as_mask(mask, (count, *shape))
        excluded = union(given, excluded_pixels(self.path, self.manifest, shape))
        hashes = sha256_of([self.path, *self.files()])
        refuse_repeats(self.path, self.manifest, hashes)
        return excluded, hashes

    def _provenance(
        self, hashes: Mapping[Path, str], averaged: Averaged | None, **more: object
    ) -> dict[str, Any]:
        """Sensor, noise, dark, hashes of the files, and what else is given, as JSON values."""
        folder = self.path.parent
        noise, dark = (None, None) if averaged is None else (averaged.noise, averaged.dark)
        return {
            "experiment": str(self.path),
            "sensor": self.manifest.sensor.model_dump(),
            **more,
            "noise": None if noise is None else asdict(noise),
            "dark_settings": settings_in({} if dark is None else dark.metadata)._asdict(),
            "inputs": {os.path.relpath(file, folder): digest for file, digest in hashes.items()},
        }


def excluded_pixels(
    path: Path, manifest: Manifest | LevelManifest | CameraManifest, shape: tuple[int, int]
) -> Bools | None:
    """Pixels that ``[sensor]`` of the manifest `path` excludes; None without a mask and regions."""
    sensor = manifest.sensor
    masks = []
    if sensor.mask is not None:
        masks.append(_of_file(entry_files(path, sensor.mask, manifest.layout)[0], shape))
    for index, region in enumerate(sensor.region or [], start=1):
        masks.append(region.pixels(f"{path}: [[sensor.region]] {index}", shape))
    excluded = union(*masks)
    if excluded is not None and excluded.all():
        raise FileError(f"{path}: 'mask' and 'region' in [sensor] leave no pixel to use")
    return excluded


def _of_file(file: Path, shape: tuple[int, int]) -> Bools:
    mask = read_mask(file)
    if mask.shape != shape:
        raise FileError(
            f"{file}: is a mask of shape {mask.shape}, expected {shape} like the frames"
        )
    return mask
