"""Which dark frames an exposure or level takes, by exposure time and temperature."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from equipix._check import Array, Bools, union
from equipix.errors import FileError
from equipix.experiment.manifest import (
    LevelManifest,
    Manifest,
    Sensor,
    Taken,
    entry_files,
    name_of_dark,
)
from equipix.findings import Finding
from equipix.io.frames import Settings, apart, settings
from equipix.measured.defects import hot_pixels
from equipix.measured.statistics import FrameStatistics

_KEYS = (("exposure_s", "s", "exposure time"), ("temperature_c", "°C", "temperature"))

_Shares = tuple[float, ...]


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
    shares: Sequence[_Shares] = ()
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


def mixed(darks: Sequence[FrameStatistics], shares: _Shares) -> FrameStatistics:
    """Interpolate between dark frames: D = Σ s D_k, with the variance Σ s² var(D_k).

    The variance of one frame is interpolated too, since that of dark current grows with time.
    """
    used = [(share, dark) for share, dark in zip(shares, darks, strict=True) if share]
    (share, one), *others = used
    if not others:
        return one
    ((rest, other),) = others
    with np.errstate(divide="ignore"):
        count = 1 / (share**2 / one.count + rest**2 / other.count)
    return FrameStatistics(
        share * one.mean + rest * other.mean,
        share * one.variance + rest * other.variance,
        share**2 * one.variance_of_mean + rest**2 * other.variance_of_mean,
        np.where(count > 0, np.maximum(count, 1), 0).astype(np.uint32),
        one.saturated + other.saturated,
        saturation=one.saturation,
        raw=one.raw and other.raw,
        step=max(one.step, other.step),
    )


class Choice(NamedTuple):
    """Share of each dark in that of each exposure or level, the same in words, and findings."""

    shares: list[_Shares]
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
        files = entry_files(path, taken.frames, manifest.layout)
        return _settings_of(place, taken.settings, files, tolerance)

    names = [name_of_dark(k, len(entries)) for k in range(len(entries))]
    try:
        darks = [known(name, each) for name, each in zip(names, entries, strict=True)]
        places = [f"{kind} '{name}'" for name, _ in measurements]
        pairs = zip(places, measurements, strict=True)
        wanted = [(place, known(place, taken)) for place, (_, taken) in pairs]
        findings: tuple[Finding, ...] = ()
        if len(entries) < 2 and not any(value is not None for each in stated for value in each):
            shares = [(1.0,) * len(entries)] * len(wanted)
            if darks:
                findings = other_settings(f"{path}: [dark]", darks[0], wanted, tolerance)
        else:
            _check_darks(darks, stated)
            shares = [_shares_of(*each, darks, tolerance) for each in wanted]
    except FileError as error:
        raise FileError(f"{path}: {error}") from error
    called = [f"{name}{_in_brackets(each)}" for name, each in zip(names, darks, strict=True)]
    return Choice(shares, [_words(each, called) for each in shares], findings)


def _in_brackets(settings: Settings) -> str:
    """Write what is known of some settings."""
    pairs = zip(settings, _KEYS, strict=True)
    known = [f"{value:g} {unit}" for value, (_, unit, _) in pairs if value is not None]
    return f" ({', '.join(known)})" if known else ""


def _words(shares: _Shares, darks: Sequence[str]) -> str:
    """Name the darks that an exposure takes, of two the share of each."""
    used = [(share, dark) for share, dark in zip(shares, darks, strict=True) if share]
    return " + ".join(dark if share == 1 else f"{share:.3g} × {dark}" for share, dark in used)


def other_settings(
    dark: str, held: Settings, frames: Sequence[tuple[str, Settings]], tolerance: float
) -> tuple[Finding, ...]:
    """Findings on a dark of another exposure time or temperature than frames by their headers."""
    found = []
    for index, (_, unit, what) in enumerate(_KEYS):
        differ = [
            (place, each[index])
            for place, each in frames
            if apart(index, each[index], held[index], tolerance)
        ]
        if not differ:
            continue
        (place, value), *others = differ
        likewise = f", and likewise {len(others)} more" if others else ""
        limit = f" (limit {tolerance:g} K)" if index else ""
        words = (
            f"{dark} was taken with the {what} {held[index]:g} {unit}, {place} with {value:g} "
            f"{unit} by its files{likewise}{limit}, and dark current differs between them: give "
            f"dark frames of {value:g} {unit}; a manifest has one [[dark]] for each {what}"
        )
        found.append(Finding("other_dark", words, "input"))
    return tuple(found)


def average_findings(frames: Sequence[Path], dark: Sequence[Path]) -> tuple[Finding, ...]:
    """Findings on frames of one average, and on their dark, by what their files hold."""
    tolerance = Sensor().dark_temperature_tolerance_c
    held = {file: settings(file) for file in frames}
    named = [(f"'{file.name}'", each) for file, each in held.items()]
    found: tuple[Finding, ...] = ()
    known = {
        file: each.temperature_c for file, each in held.items() if each.temperature_c is not None
    }
    least, most = (choose(known, key=known.__getitem__, default=None) for choose in (min, max))
    if least and most and apart(1, known[least], known[most], tolerance):
        words = (
            f"'{least.name}' was taken at {known[least]:g} °C, '{most.name}' at {known[most]:g} °C "
            f"(limit {tolerance:g} K), and dark current differs between them: average the frames "
            "of each temperature by themselves"
        )
        found = (Finding("temperature", words, "input"),)
    if dark:
        of_dark = _settings_of("'dark'", Settings(), dark, float("inf"))
        found += other_settings("'dark'", of_dark, named, tolerance)
    return found


def _settings_of(place: str, stated: Settings, files: Sequence[Path], tolerance: float) -> Settings:
    """Exposure time and temperature of an entry: as stated in the manifest, else by its files."""
    read, found = {file: settings(file) for file in files}, list(stated)
    for index, (key, unit, what) in enumerate(_KEYS):
        known = {file: value for file, each in read.items() if (value := each[index]) is not None}
        wanted = stated[index]
        if known and wanted is None:
            found[index] = wanted = float(np.mean([*known.values()]))
        different = [file for file in known if apart(index, wanted, known[file], tolerance)]
        if different and stated[index] is not None:
            raise FileError(
                f"'{different[0].name}' holds {known[different[0]]:g} {unit}, but '{key}' of "
                f"{place} is {wanted:g} {unit}: correct '{key}', or the files of {place}"
            )
        if different:
            least, most = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
            raise FileError(
                f"the files of {place} have different values of the {what}: '{least.name}' holds "
                f"{known[least]:g} {unit}, '{most.name}' {known[most]:g} {unit}: give each {what} "
                "a table of its own"
            )
    return Settings(*found)


def _check_darks(darks: Sequence[Settings], stated: Sequence[Settings]) -> None:
    """Refuse darks without a value that others have, or the manifest gives, and two alike."""
    for index, (key, _, _) in enumerate(_KEYS):
        unknown = [k for k, each in enumerate(darks) if each[index] is None]
        if unknown and any(each[index] is not None for each in (*darks, *stated)):
            place = name_of_dark(unknown[0], len(darks))
            raise FileError(f"'{key}' of {place} is not known: write it")
    for k, each in enumerate(darks):
        if each in darks[:k]:
            raise FileError(
                f"[[dark]] {darks.index(each) + 1} and {k + 1} do not differ: write 'exposure_s' "
                "or 'temperature_c', or name their frames in one"
            )


def _shares_of(
    place: str, wanted: Settings, darks: Sequence[Settings], tolerance: float
) -> _Shares:
    """Share of each dark in that of an exposure: the one that fits, or two beside it in time."""
    held = [
        f"{', '.join(f'{each:g}' for each in dict.fromkeys(values) if each is not None)} {unit}"
        for values, (_, unit, _) in zip(zip(*darks, strict=True), _KEYS, strict=True)
    ]
    for index, (key, _, _) in enumerate(_KEYS):
        differ = any(apart(index, each[index], darks[0][index], tolerance) for each in darks)
        if wanted[index] is None and differ:
            raise FileError(
                f"'{key}' of {place} is not known, and the [[dark]] have {held[index]}: write it"
            )
    near = [k for k, each in enumerate(darks) if not apart(1, wanted[1], each[1], tolerance)]
    if not near:
        raise FileError(
            f"no dark fits {place} of {wanted.temperature_c:g} °C within {tolerance:g} K: they "
            f"have {held[1]}. Take dark frames at its temperature, or raise "
            "'dark_temperature_tolerance_c' in [sensor]"
        )

    def distance(k: int) -> list[float]:
        """How far a dark is, in time and then in temperature; 0 where it is not known."""
        pairs = zip(wanted, darks[k], strict=True)
        return [0.0 if a is None or b is None else abs(a - b) for a, b in pairs]

    best = min(near, key=distance)
    if not apart(0, wanted[0], darks[best][0], tolerance):
        return tuple(float(k == best) for k in range(len(darks)))
    time, times = wanted.exposure_s or 0.0, [each.exposure_s or 0.0 for each in darks]
    below, above = ([k for k in near if (times[k] > time) is later] for later in (False, True))
    if not (below and above):
        raise FileError(
            f"no dark fits {place} of {time:g} s: those of its temperature have "
            f"{', '.join(f'{times[k]:g}' for k in near)} s, and a dark is interpolated between two "
            "times, not extrapolated: take dark frames of this time"
        )
    low, high = min(below, key=distance), min(above, key=distance)
    share = (times[high] - time) / (times[high] - times[low])
    return tuple(share * (k == low) + (1 - share) * (k == high) for k in range(len(darks)))
