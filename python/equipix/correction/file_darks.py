"""The dark of each file of frames, and what shows that it is another than theirs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from equipix._check import Array
from equipix.correction.protocol import Correction, refuse_dark, sensor_table
from equipix.errors import FileError, InputError
from equipix.findings import Finding, Findings, say
from equipix.io.formats import FrameFile, frame_files
from equipix.io.frames import Header, Settings
from equipix.measured.average import average
from equipix.measured.part import median
from equipix.measured.settings import (
    TOLERANCE_K,
    Shares,
    Wording,
    check_darks,
    common_settings,
    in_words,
    other_settings,
    settings_in,
    shares_of,
)
from equipix.measured.statistics import DARKER, refuse_subtracted

_WORDS = Wording(
    darks="the darks",
    values=("the exposure time", "the temperature"),
    unknown="name files whose headers hold it (EXPTIME and CCD-TEMP of FITS)",
    contradiction="",
    mixed="give 'dark' (--dark) once for each {what}, with its own files",
    alike="name their frames in one, as a pattern in quotes",
    temperature="",
    several=", or 'dark' (--dark) once for each {what}: each frame takes the one that fits",
)

_QUOTE = (
    "leave them out, and quote patterns: of --dark d*.fits without quotes the shell gives all but "
    "the first file as frames"
)

_WORDED = ("stored", "none")
"""What stands in the place of names of darks."""

_SAMPLED = 2**16  # pixels that show whether a frame is dark


@dataclass(frozen=True)
class FileDarks:
    """What is subtracted from the frames of each file.

    Attributes
    ----------
    names : tuple of str
        "stored", "none", or the names of darks.
    means : dict of int to ndarray
        Means of the darks that are used, by their number.
    shares : dict of Path to tuple of float
        Share of each dark in that of each file.
    suspects : frozenset of Path
        Files that are probably dark frames if they are as dark as the dark.
    findings : tuple of Finding
        What shows that a dark is not that of the frames.
    """

    names: tuple[str, ...]
    means: dict[int, Array]
    shares: dict[Path, Shares]
    suspects: frozenset[Path] = frozenset()
    findings: Findings = ()

    def of(self, file: Path) -> Array | Literal["stored"] | None:
        """Return the dark of a file, for the argument of `Corrector`."""
        if not self.means:
            return None if self.names == ("none",) else "stored"
        used = [(share, self.means[k]) for k, share in enumerate(self.shares[file]) if share]
        return np.asarray(sum(share * mean for share, mean in used))

    def named(self, file: Path) -> str:
        """Return the dark of a file in words."""
        return in_words(self.shares[file], self.names)


def file_darks(
    correction: Correction, names: Sequence[str] | None, headers: Mapping[Path, Header]
) -> FileDarks:
    """Choose the dark of each file by exposure time and temperature, and average those used.

    A single one is that of all; where the headers of frames differ from its own, this is a finding.

    Raises
    ------
    FileError
        If a dark is no dark, is of several exposure times, or none of several fits a file.
    InputError
        If the correction needs a dark, or takes none.
    """
    names = tuple(names or ("stored",))
    if any(name in _WORDED for name in names):
        return _worded(correction, names, headers)
    refuse_dark(correction, names[0])
    groups = [frame_files([name]) for name in names]
    _refuse_light([file for group in groups for file in group])
    places = [f"'dark' (--dark) {name}" for name in names]
    tolerance = _tolerance(correction)
    darks = [
        common_settings(place, Settings(), group, tolerance, _WORDS)
        for place, group in zip(places, groups, strict=True)
    ]
    said = _warn_of_dark_frames(headers)
    if len(names) == 1:
        shares: dict[Path, Shares] = dict.fromkeys(headers, (1.0,))
        said += _warn_of_settings(places[0], darks[0], headers, tolerance)
    else:
        check_darks(places, darks, (), _WORDS)
        shares = {
            file: shares_of(str(file), each.settings, darks, tolerance, _WORDS)
            for file, each in headers.items()
        }
    used = [k for k in range(len(names)) if any(each[k] for each in shares.values())]
    means = {k: _mean(groups[k]) for k in used}
    return FileDarks(names, means, shares, _suspects(names, groups[0], headers), said)


def _worded(
    correction: Correction, names: tuple[str, ...], headers: Mapping[Path, Header]
) -> FileDarks:
    """Take the dark of the correction, or none."""
    name, *others = sorted(names, key=lambda name: name not in _WORDED)
    if others:
        also = "twice: give it once" if name in others else "and names files too: leave out one"
        raise InputError(f"'dark' (--dark) is '{name}' {also}")
    said = _warn_of_dark_frames(headers)
    suspects: frozenset[Path] = frozenset()
    if name == "none":
        refuse_dark(correction, name)
    elif correction.needs_dark:
        raise InputError(
            "this correction holds no dark frame, and 'dark' (--dark) is 'stored': give dark "
            "frames, or 'none' (--dark none) if the dark is subtracted from the frames already"
        )
    else:
        known = settings_in(correction.metadata.get("dark_settings", {}))
        place = "the dark of the correction"
        said += _warn_of_settings(place, known, headers, _tolerance(correction))
        suspects = _untyped(headers)
    return FileDarks(names, {}, dict.fromkeys(headers, (1.0,)), suspects, said)


def _tolerance(correction: Correction) -> float:
    """Difference of temperatures at which a dark still fits."""
    sensor = sensor_table(correction.metadata)
    return float(sensor.get("dark_temperature_tolerance_c", TOLERANCE_K))


def _mean(files: list[FrameFile]) -> Array:
    """Average a dark."""
    statistics = average(files)
    refuse_subtracted(statistics, str(files[0].path))
    return statistics.mean


def _suspects(
    names: Sequence[str], dark: Sequence[FrameFile], headers: Mapping[Path, Header]
) -> frozenset[Path]:
    """Files of frames that may be dark frames, of a pattern without quotes.

    The shell leaves one file of such a pattern to the option, and gives the others as frames.
    """
    is_bare = [Path(name) for name in names] == [dark[0].path] and dark[0].kind is None
    return _untyped(headers) if is_bare else frozenset()


def _untyped(headers: Mapping[Path, Header]) -> frozenset[Path]:
    """Files of frames, among others, whose headers do not name the type of image."""
    if len(headers) < 2:
        return frozenset()
    return frozenset(file for file, each in headers.items() if not each.image_type.value)


def _refuse_light(darks: Sequence[FrameFile]) -> None:
    """Refuse frames that are no dark by their headers."""
    for file in darks:
        if file.image_type.kind == "light":
            raise FileError(
                f"{file.path}: is {file.image_type}, expected dark frames in 'dark' (--dark)"
            )


def _some(files: Sequence[Path]) -> str:
    """Name the first of some files, and how many there are more."""
    return f"{files[0]}{f' and {len(files) - 1} more' if len(files) > 1 else ''}"


def _warn_of_dark_frames(headers: Mapping[Path, Header]) -> Findings:
    """Warn of frames that are dark frames by their headers."""
    files = [file for file, each in headers.items() if each.image_type.kind == "dark"]
    if not files:
        return ()
    words = f"{_some(files)}: given as frames, but dark frames by their headers: {_QUOTE}"
    return say(Finding("dark_frames", words, "input"))


def warn_of_as_dark(files: Sequence[Path], dark: str) -> Findings:
    """Warn of frames that are as dark as the dark, so that they are probably dark frames."""
    if not files:
        return ()
    named, todo = (dark, _QUOTE)
    if dark in _WORDED:
        named, todo = "the dark of the correction", "leave them out"
    words = (
        f"{_some(files)}: given as frames, but as dark as {named}. If they hold no light, {todo}"
    )
    return say(Finding("dark_frames", words, "input"))


def is_as_dark(frame: Array, dark: Array) -> bool:
    """Whether the median of a frame is above that of its dark by less than half of the noise."""
    step = -(-frame.size // _SAMPLED)
    above = frame.ravel()[::step] - dark.ravel()[::step]
    level = median(above)
    # A normal distribution has half of its values within 0.6745 standard deviations.
    return bool(level <= 0.5 * median(abs(above - level)) / 0.6745)


def _warn_of_settings(
    named: str, dark: Settings, headers: Mapping[Path, Header], tolerance: float
) -> Findings:
    """Warn of files of another exposure time or temperature than their dark."""
    if dark == Settings():
        return ()
    wanted = [(str(file), each.settings) for file, each in headers.items()]
    return say(*other_settings(named, dark, wanted, tolerance, _WORDS.several))


def warn_of_darker(frame: Array, dark: Array) -> Findings:
    """Warn of a frame from which the dark was probably subtracted before."""
    level, below = median(dark), median(dark - frame)
    if level > 0 and below > DARKER * level:
        words = (
            f"the first frame is darker than the dark by {below:.4g} of {level:.4g} DN in the "
            "median: give raw frames, or 'dark' (--dark) none if the dark was subtracted from them"
        )
        return say(Finding("bright_dark", words, "input"))
    return ()
