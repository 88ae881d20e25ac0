"""What experiments on disk have in common: a description, and the image files that it names."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Self, TypeVar

from equipix.errors import FileError
from equipix.experiment.manifest import LevelManifest, Manifest, find_files
from equipix.experiment.repeats import image_files, refuse_repeats
from equipix.frames import average
from equipix.io import as_path

if TYPE_CHECKING:
    from os import PathLike
    from pathlib import Path

    from equipix._types import Progress
    from equipix.frames import FrameStatistics

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
        masks: list[Path] = [] if mask is None else find_files(self.path, mask)
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

        sensor, files = self.manifest.sensor, find_files(self.path, entry)
        level = sensor.saturation_level
        found = average(files, dark=dark, saturation=level, workers=workers, progress=report)
        if sensor.largest is not None and found.mean.max() > sensor.largest:
            raise FileError(
                f"{self.path}: '{files[0].name}' of {name} holds means up to "
                f"{found.mean.max():.0f} DN, above {sensor.largest}, the largest value "
                f"that 'bit_depth' = {sensor.bit_depth} holds: correct 'bit_depth' in [sensor]"
            )
        return found
