"""The dark of each file of frames, and what shows that it is another than theirs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from equipix._check import Array
from equipix.correction.protocol import Correction, refuse_dark, sensor_table
from equipix.errors import FileError, InputError
from equipix.findings import Finding, Findings, say
from equipix.io.formats import saved_kind
from equipix.io.frames import Settings, image_type, settings
from equipix.io.paths import find_files
from equipix.measured.average import average
from equipix.measured.darks import (
    TOLERANCE_K,
    Shares,
    Wording,
    check_darks,
    common_settings,
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
    several=(
        ", or 'dark' (--dark) several times: each frame takes the one that fits, or one "
        "interpolated between two times"
    ),
)

_QUOTE = (
    "leave them out, and quote patterns: of --dark d*.fits without quotes the shell gives all but "
    "the first file as frames"
)

_LIGHT = ("light", "object", "science", "flat")
"""What types of images with light contain."""

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
        pairs = zip(self.shares[file], self.names, strict=True)
        used = [(share, name) for share, name in pairs if share]
        return " + ".join(name if share == 1 else f"{share:.4g} {name}" for share, name in used)


def file_darks(
    correction: Correction, names: Sequence[str] | None, files: Sequence[Path]
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
    tolerance = sensor_table(correction.metadata).get("dark_temperature_tolerance_c", TOLERANCE_K)
    shown = {file: _shown(file) for file in files}
    said = _warn_of_dark_frames([file for file in files if "dark" in shown[file]])
    one: dict[Path, Shares] = dict.fromkeys(files, (1.0,))
    if names == ("stored",):
        if correction.needs_dark:
            raise InputError(
                "this correction holds no dark frame, and 'dark' (--dark) is 'stored': give dark "
                "frames, or 'none' (--dark none) if the dark is subtracted from the frames already"
            )
        known = settings_in(correction.metadata.get("dark_settings", {}))
        said += _warn_of_settings("the dark of the correction", known, files, tolerance)
        return FileDarks(names, {}, one, findings=said)
    refuse_dark(correction, names[0])
    if names == ("none",):
        return FileDarks(names, {}, one, findings=said)
    if word := {"stored", "none"} & set(names):
        raise InputError(f"'dark' (--dark) is '{word.pop()}' and names files too: leave out one")
    groups = [find_files(name) for name in names]
    _refuse_light([file for group in groups for file in group])
    places = [f"'dark' (--dark) {name}" for name in names]
    darks = [
        common_settings(place, Settings(), group, tolerance, _WORDS)
        for place, group in zip(places, groups, strict=True)
    ]
    shares = one
    if len(names) == 1:
        said += _warn_of_settings(places[0], darks[0], files, tolerance)
    else:
        check_darks(places, darks, (), _WORDS)
        shares = {
            file: shares_of(str(file), settings(file), darks, tolerance, _WORDS) for file in files
        }
    used = [k for k in range(len(names)) if any(each[k] for each in shares.values())]
    means = {k: _mean(places[k], groups[k]) for k in used}
    # The shell leaves one file of frames of an unquoted pattern, and gives the others as frames.
    bare = [Path(name) for name in names] == groups[0] and saved_kind(groups[0][0]) is None
    suspects = frozenset(file for file in files if bare and len(files) > 1 and not shown[file])
    return FileDarks(names, means, shares, suspects, said)


def _mean(place: str, files: list[Path]) -> Array:
    """Average a dark."""
    statistics = average(files)
    refuse_subtracted(statistics, place)
    return statistics.mean


def _shown(file: Path) -> str:
    """What an image shows by its header, in lower case."""
    return image_type(file).lower()


def _refuse_light(darks: Sequence[Path]) -> None:
    """Refuse frames that are no dark by their headers."""
    for file in darks:
        shown = _shown(file)
        if "dark" not in shown and any(word in shown for word in _LIGHT):
            raise FileError(
                f"{file}: is '{image_type(file)}' by its header (IMAGETYP), expected dark frames "
                "in 'dark' (--dark)"
            )


def _some(files: Sequence[Path]) -> str:
    """Name the first of some files, and how many there are more."""
    return f"{files[0]}{f' and {len(files) - 1} more' if len(files) > 1 else ''}"


def _warn_of_dark_frames(files: Sequence[Path]) -> Findings:
    """Warn of frames that are dark frames by their headers."""
    if not files:
        return ()
    words = f"{_some(files)}: given as frames, but dark frames by their headers: {_QUOTE}"
    return say(Finding("dark_frames", words, "input"))


def warn_of_as_dark(files: Sequence[Path], dark: str) -> Findings:
    """Warn of frames that are as dark as the dark, so that they are probably dark frames."""
    if not files:
        return ()
    words = (
        f"{_some(files)}: given as frames, but as dark as {dark}. If they hold no light, {_QUOTE}"
    )
    return say(Finding("dark_frames", words, "input"))


def is_as_dark(frame: Array, dark: Array) -> bool:
    """Whether the median of a frame is above that of its dark by less than half of the noise."""
    step = -(-frame.size // _SAMPLED)
    above = frame.ravel()[::step] - dark.ravel()[::step]
    level = np.nanmedian(above)
    # A normal distribution has half of its values within 0.6745 standard deviations.
    return bool(level <= 0.5 * np.nanmedian(abs(above - level)) / 0.6745)


def _warn_of_settings(
    named: str, dark: Settings, files: Sequence[Path], tolerance: float
) -> Findings:
    """Warn of files of another exposure time or temperature than their dark."""
    if dark == Settings():
        return ()
    wanted = [(str(file), settings(file)) for file in files]
    return say(*other_settings(named, dark, wanted, tolerance, _WORDS.several))


def warn_of_darker(frame: Array, dark: Array) -> Findings:
    """Warn of a frame from which the dark was probably subtracted before."""
    level, below = np.nanmedian(dark), np.nanmedian(dark - frame)
    if level > 0 and below > DARKER * level:
        words = (
            f"the first frame is darker than the dark by {below:.4g} of {level:.4g} DN in the "
            "median: give raw frames, or 'dark' (--dark) none if the dark was subtracted from them"
        )
        return say(Finding("bright_dark", words, "input"))
    return ()
