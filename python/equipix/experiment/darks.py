"""Which dark frames an exposure or level takes, by exposure time and temperature."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from equipix._check import Array, Bools, union
from equipix.errors import FileError
from equipix.experiment.manifest import LevelManifest, Manifest, Taken, entry_files, name_of_dark
from equipix.io.frames import Settings
from equipix.measured.darks import (
    Shares,
    Wording,
    check_darks,
    common_settings,
    mixed,
    shares_of,
)
from equipix.measured.defects import hot_pixels
from equipix.measured.statistics import FrameStatistics

_WORDS = Wording(
    darks="the [[dark]]",
    values=("'exposure_s'", "'temperature_c'"),
    unknown="write it",
    contradiction="correct {name}, or the files of {place}",
    alike="write 'exposure_s' or 'temperature_c', or name their frames in one",
    temperature=", or raise 'dark_temperature_tolerance_c' in [sensor]",
)


@dataclass(frozen=True)
class Darks:
    """Dark of each exposure or level.

    Attributes
    ----------
    frames : tuple of FrameStatistics
        The dark frames that are used; none where only a level without light is known.
    shares : list of tuple of float
        Share of each of these in the dark of each exposure.
    black : ndarray, shape (rows, cols), or None
        Black level of a raw file of a camera, which is subtracted where there are no dark frames.
    """

    frames: tuple[FrameStatistics, ...] = ()
    shares: Sequence[Shares] = ()
    black: Array | None = None

    def of(self, exposure: int) -> FrameStatistics | Array | None:
        """Return what is subtracted from the frames of an exposure."""
        return mixed(self.frames, self.shares[exposure]) if self.frames else self.black

    @property
    def means(self) -> list[Array]:
        """Mean dark of each exposure."""
        darks = map(self.of, range(len(self.shares)))
        return [
            np.asarray(each.mean if isinstance(each, FrameStatistics) else each) for each in darks
        ]

    @property
    def hot(self) -> Bools | None:
        """Pixels that any dark shows to be hot."""
        return union(*(hot_pixels(each, None) for each in self.frames))


def chosen(path: Path, manifest: Manifest | LevelManifest) -> list[Shares]:
    """Share of each dark of the manifest `path` in that of each exposure or level.

    A single one without exposure time and temperature is that of all.

    Raises
    ------
    FileError
        If none fits, or the files contradict the manifest.
    """
    entries, measurements = manifest.dark or [], manifest.measurements
    stated = [each.settings for each in (*entries, *(taken for _, taken in measurements))]
    if len(entries) < 2 and not any(value is not None for each in stated for value in each):
        return [(1.0,) * len(entries)] * len(measurements)
    tolerance = manifest.sensor.dark_temperature_tolerance_c
    kind = "level" if isinstance(manifest, LevelManifest) else "exposure"

    def known(place: str, taken: Taken) -> Settings:
        files = entry_files(path, taken.frames, manifest.layout)
        return common_settings(place, taken.settings, files, tolerance, _WORDS)

    try:
        names = [name_of_dark(k, len(entries)) for k in range(len(entries))]
        darks = list(map(known, names, entries))
        check_darks(names, darks, stated, _WORDS)
        places = [(f"{kind} '{name}'", taken) for name, taken in measurements]
        return [
            shares_of(place, known(place, each), darks, tolerance, _WORDS) for place, each in places
        ]
    except FileError as error:
        raise FileError(f"{path}: {error}") from error
