"""Levels of a uniform source on disk, as levels.toml describes them, and their evaluation."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from equipix._check import By, Order, Progress, Words, as_mask, naming_memory, union
from equipix.errors import EquipixWarning, FileError, InputError, warn
from equipix.experiment.described import Described, excluded_pixels
from equipix.experiment.image_files import check_formats, refuse_repeats, sha256_of
from equipix.experiment.manifest import LevelManifest, read_level_manifest
from equipix.measured.colour import Colours
from equipix.measured.defects import SIGMAS
from equipix.measured.means import Averaged
from equipix.measured.statistics import FrameStatistics, refuse_subtracted
from equipix.nuc.curve_fit import fitted
from equipix.nuc.levels import Levels, levels_of
from equipix.nuc.order import check_order
from equipix.nuc.response import Response


@dataclass(frozen=True)
class LevelExperiment(Described[LevelManifest]):
    """Frames of a uniform source at several levels, as files on disk.

    Attributes
    ----------
    path : Path
        The levels.toml.
    manifest : LevelManifest
        Its checked content.

    See Also
    --------
    equipix.nuc.fit : The same for averages and arrays in memory.

    Notes
    -----
    Frames and dark frames are named relative to the file: one file (a multi-page TIFF holds many
    frames; a saved average stands for the frames that it was made of), a glob or a list.
    ``[sensor]`` is that of an experiment.toml. Without ``[dark]`` the level without light is part
    of the curves.
    """

    @classmethod
    def _read(cls, path: Path) -> LevelManifest:
        return read_level_manifest(path)

    def run(
        self,
        *,
        order: Order = 1,
        by: By = "offset",
        mask: ArrayLike | None = None,
        workers: int | None = None,
        progress: Progress | None = None,
    ) -> Response:
        """Fit the response curves to the files.

        Parameters
        ----------
        order : {0, 1, 2, 3, "auto"}
            Highest power of the array's mean, see `equipix.nuc.fit`.
        by : {"offset", "gain"}
            What a one-point correction changes.
        mask : array_like of bool, shape (rows, cols) or (n, rows, cols), optional
            True = do not use, besides the pixels that the file excludes.
        workers : int, optional
            Number of threads; by default one for each processor.
        progress : callable, optional
            Called as ``progress(done, total, stage)`` repeatedly.

        Returns
        -------
        Response
            With the dark frame, if there is one, and in `metadata` the sensor, the levels with
            their values and units, the noise and the hashes of the files.

        Raises
        ------
        FileError
            If a file cannot be read, the images differ in size or depth, a level saturates, or two
            files have the same content.
        InputError
            If an option is out of range, or the levels do not determine the curves.
        InsufficientMemoryError
            If the memory that it takes cannot be had.

        Warns
        -----
        EquipixWarning
            If the mean of a level is lower than that of a level with a lower value, beside the
            warnings of `equipix.nuc.fit`.
        """
        check_order(order, by)
        shape = check_formats(self._images())
        given = as_mask(mask, (len(self.manifest.level), *shape))
        excluded = union(given, excluded_pixels(self.path, self.manifest, shape))
        hashes = sha256_of([self.path, *self.files()])
        refuse_repeats(self.path, self.manifest, hashes)
        averaged = self._average(workers, progress)
        levels = levels_of(averaged, mask=excluded)
        self._warn_of_order(levels)
        origin = self._provenance(averaged, levels.references.tolist(), hashes)
        return fitted(levels, order=order, by=by, workers=workers, provenance=origin)

    def _average(self, workers: int | None, progress: Progress | None) -> Averaged:
        """Mean of every level; the frames' other statistics are reduced at once."""
        sensor = self.manifest.sensor
        averaged = Averaged(
            len(self.manifest.level),
            gain=sensor.gain_dn_per_e,
            saturation=sensor.saturation_level,
            saturation_key=sensor.saturation_key,
            words=Words("[[level]]", "level"),
            colours=Colours.of(sensor.cfa),
        )
        with naming_memory("averaging"):
            dark = self._dark(workers, progress)
            for name, level in zip(self.manifest.names, self.manifest.level, strict=True):
                frames = self._statistics(name, level.frames, dark, workers, progress)
                try:
                    averaged.add(frames, name)
                except InputError as error:
                    raise FileError(f"{self.path}: {error}") from error
        return averaged

    def _warn_of_order(self, levels: Levels) -> None:
        """Warn of values of levels that do not rise with the means by more than noise explains."""
        entries = zip(self.manifest.level, self.manifest.names, strict=True)
        known = [
            (level.value, name, mean, sigma)
            for (level, name), mean, sigma in zip(
                entries, levels.references, np.sqrt(levels.variances), strict=True
            )
            if level.value is not None
        ]
        known.sort(key=lambda each: each[0])
        for (_, below, least, one), (_, above, most, other) in pairwise(known):
            if most < least - SIGMAS * np.hypot(one, other):
                warn(
                    f"{self.path}: the mean of the frames falls from {least:.6g} DN in level "
                    f"'{below}' to {most:.6g} DN in level '{above}', whose 'value' is higher: see "
                    "that each value is that of its frames",
                    EquipixWarning,
                )
                return

    def _dark(self, workers: int | None, progress: Progress | None) -> FrameStatistics | None:
        if self.manifest.dark is None:
            return None
        dark = self._statistics("dark", self.manifest.dark.frames, None, workers, progress)
        refuse_subtracted(dark, f"{self.path}: [dark]")
        return dark

    def _provenance(
        self, averaged: Averaged, means: list[float], hashes: dict[Path, str]
    ) -> dict[str, Any]:
        """Sensor, levels, noise and the hashes of the files, as JSON values."""
        named = zip(self.manifest.names, self.manifest.level, means, strict=True)
        folder = self.path.parent
        return {
            "experiment": str(self.path),
            "sensor": self.manifest.sensor.model_dump(),
            "levels": [
                {"name": name, "value": level.value, "unit": level.unit, "mean": mean}
                for name, level, mean in named
            ],
            "noise": None if averaged.noise is None else asdict(averaged.noise),
            "inputs": {os.path.relpath(file, folder): digest for file, digest in hashes.items()},
        }
