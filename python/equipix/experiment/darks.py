"""Which dark frames an exposure or level takes, by exposure time and temperature."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from equipix._check import Array, Bools, union
from equipix.errors import FileError
from equipix.experiment.manifest import LevelManifest, Manifest, Taken, entry_files, name_of_dark
from equipix.findings import Finding
from equipix.io.formats import FrameFile
from equipix.io.frames import Settings
from equipix.measured.defects import hot_pixels
from equipix.measured.settings import (
    KEYS,
    Shares,
    Wording,
    check_darks,
    common_settings,
    in_words,
    mixed,
    other_settings,
    shares_of,
)
from equipix.measured.statistics import FrameStatistics

_WORDS = Wording(
    darks="the [[dark]]",
    values=("'exposure_s'", "'temperature_c'"),
    unknown="write it",
    contradiction="correct {name}, or the files of {place}",
    mixed="give each {what} a table of its own",
    alike="write 'exposure_s' or 'temperature_c', or name their frames in one",
    temperature=", or raise 'dark_temperature_tolerance_c' in [sensor]",
    several="; a manifest has one [[dark]] for each {what}",
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
    words : list of str
        What is subtracted from each exposure; empty where nothing is.
    findings : tuple of Finding
        On a dark that was taken with other settings than an exposure.
    """

    frames: tuple[FrameStatistics, ...] = ()
    shares: Sequence[Shares] = ()
    black: Array | None = None
    words: Sequence[str] = ()
    findings: tuple[Finding, ...] = ()

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


class Choice(NamedTuple):
    """Share of each dark in that of each exposure or level, the same in words, and findings."""

    shares: list[Shares]
    words: list[str]
    findings: tuple[Finding, ...] = ()


def chosen(path: Path, manifest: Manifest | LevelManifest) -> Choice:
    """Choose the darks of each exposure or level of the manifest `path`.

    A single one is that of all where the manifest has no exposure time and no temperature; what
    its files hold of them, and those of the exposures, may then differ.

    Raises
    ------
    FileError
        If none fits, or the files contradict the manifest or one another.
    """
    entries, measurements = manifest.dark or [], manifest.measurements
    stated = [each.settings for each in (*entries, *(taken for _, taken in measurements))]
    tolerance = manifest.sensor.dark_temperature_tolerance_c
    kind = "level" if isinstance(manifest, LevelManifest) else "exposure"

    def known(place: str, taken: Taken) -> Settings:
        files = [*map(FrameFile, entry_files(path, taken.frames, manifest.layout))]
        return common_settings(place, taken.settings, files, tolerance, _WORDS)

    names = [name_of_dark(k, len(entries)) for k in range(len(entries))]
    try:
        darks = [known(name, each) for name, each in zip(names, entries, strict=True)]
        places = [f"{kind} '{name}'" for name, _ in measurements]
        pairs = zip(places, measurements, strict=True)
        wanted = [(place, known(place, taken)) for place, (_, taken) in pairs]
        findings: tuple[Finding, ...] = ()
        nothing = not any(value is not None for each in stated for value in each)
        if not entries or (len(entries) < 2 and nothing):
            shares = [(1.0,) * len(entries)] * len(wanted)
            if darks:
                findings = other_settings(
                    f"{path}: [dark]", darks[0], wanted, tolerance, _WORDS.several
                )
        else:
            check_darks(names, darks, stated, _WORDS)
            shares = [shares_of(*each, darks, tolerance, _WORDS) for each in wanted]
    except FileError as error:
        raise FileError(f"{path}: {error}") from error
    called = [f"{name}{_in_brackets(each)}" for name, each in zip(names, darks, strict=True)]
    return Choice(shares, [in_words(each, called) for each in shares], findings)


def _in_brackets(settings: Settings) -> str:
    """Write what is known of some settings."""
    pairs = zip(settings, KEYS, strict=True)
    known = [f"{value:g} {unit}" for value, (_, unit, _) in pairs if value is not None]
    return f" ({', '.join(known)})" if known else ""
