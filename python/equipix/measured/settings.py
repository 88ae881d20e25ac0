"""Exposure time and temperature of files, and the dark frames that fit them."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from equipix.errors import FileError
from equipix.findings import Finding
from equipix.io.formats import FrameFile
from equipix.io.frames import Settings, apart
from equipix.measured.statistics import FrameStatistics

KEYS = (("exposure_s", "s", "exposure time"), ("temperature_c", "°C", "temperature"))
"""What an image was taken with, its unit and its name."""

TOLERANCE_K = 0.5
"""Difference of temperatures at which a dark still fits, unless another is stated."""

Shares = tuple[float, ...]
"""Share of each dark in that of an exposure, a level or a file."""


class Wording(NamedTuple):
    """Words of messages on darks, by the place where darks are named.

    `values` has a name for each of `KEYS`. Remedies are those for a value that is not known, for
    files that contradict what is stated, for files of one dark that contradict one another, for
    two darks alike, for a temperature that no dark has, and for one dark of other settings.
    """

    darks: str
    values: tuple[str, str]
    unknown: str
    contradiction: str
    mixed: str
    alike: str
    temperature: str
    several: str


def settings_of(file: FrameFile) -> Settings:
    """Exposure time and temperature of frames by their headers, of a saved average by its own."""
    if fields := file.content.get("fields"):  # other programs write JSON of their own
        return settings_in(fields.get("metadata", {}))
    return file.settings


def settings_in(metadata: Mapping[str, Any]) -> Settings:
    """Exposure time and temperature in the metadata of an average."""
    return Settings(*(metadata.get(key) for key, _, _ in KEYS))


def mixed(darks: Sequence[FrameStatistics], shares: Shares) -> FrameStatistics:
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
        metadata={
            key: share * one.metadata[key] + rest * other.metadata[key]
            for key, _, _ in KEYS
            if key in one.metadata and key in other.metadata
        },
    )


def in_words(shares: Shares, names: Sequence[str]) -> str:
    """Name the darks that an exposure or file takes, of two the share of each, in ASCII."""
    used = [(share, name) for share, name in zip(shares, names, strict=True) if share]
    return " + ".join(name if share == 1 else f"{share:.4g} of {name}" for share, name in used)


def common_settings(
    place: str, stated: Settings, files: Sequence[FrameFile], tolerance: float, words: Wording
) -> Settings:
    """Exposure time and temperature of some files: as stated, else the mean of what they hold."""
    read = {file.path: settings_of(file) for file in files}
    found = [
        mean if value is None else value
        for value, mean in zip(stated, _mean(read.values()), strict=True)
    ]
    for index, (name, (_, unit, what)) in enumerate(zip(words.values, KEYS, strict=True)):
        known = {file: value for file, each in read.items() if (value := each[index]) is not None}
        wanted = found[index]
        different = [file for file in known if apart(index, wanted, known[file], tolerance)]
        if different and stated[index] is not None:
            remedy = words.contradiction.format(name=name, place=place)
            raise FileError(
                f"'{different[0].name}' holds {known[different[0]]:g} {unit}, but {name} of "
                f"{place} is {wanted:g} {unit}: {remedy}"
            )
        if different:
            least, most = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
            raise FileError(
                f"the files of {place} have different values of the {what}: '{least.name}' holds "
                f"{known[least]:g} {unit}, '{most.name}' {known[most]:g} {unit}: "
                f"{words.mixed.format(what=what)}"
            )
    return Settings(*found)


def _mean(held: Iterable[Settings]) -> Settings:
    """Mean of what is known of some settings."""
    known = ([each for each in values if each is not None] for values in zip(*held, strict=True))
    return Settings(*(float(np.mean(values)) if values else None for values in known))


def furthest(
    held: Mapping[Path, Settings], index: int, tolerance: float
) -> tuple[Path, Path] | None:
    """Files of the lowest and of the highest value of a setting; None where these are the same."""
    known = {file: value for file, each in held.items() if (value := each[index]) is not None}
    if not known:
        return None
    least, most = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
    return (least, most) if apart(index, known[least], known[most], tolerance) else None


def other_settings(
    dark: str,
    held: Settings,
    frames: Sequence[tuple[str, Settings]],
    tolerance: float,
    several: str = "",
) -> tuple[Finding, ...]:
    """Findings on a dark of another exposure time or temperature than frames by their headers.

    `several` continues the remedy where more than one dark may be given.
    """
    found = []
    for index, (_, unit, what) in enumerate(KEYS):
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
        message = (
            f"{dark} was taken with the {what} {held[index]:g} {unit}, {place} with {value:g} "
            f"{unit} by its files{likewise}{limit}, and dark current differs between them: give "
            f"dark frames of {value:g} {unit}{several.format(what=what)}"
        )
        found.append(Finding("other_dark", message, "input"))
    return tuple(found)


def average_findings(frames: Sequence[FrameFile], dark: Sequence[FrameFile]) -> tuple[Finding, ...]:
    """Findings on frames of one average, and on their dark, by what their files hold."""
    held = {file.path: file.settings for file in frames}
    named = [(f"'{file.name}'", each) for file, each in held.items()]
    found: tuple[Finding, ...] = ()
    if ends := furthest(held, 1, TOLERANCE_K):
        least, most = ends
        message = (
            f"'{least.name}' was taken at {held[least].temperature_c:g} °C, '{most.name}' at "
            f"{held[most].temperature_c:g} °C (limit {TOLERANCE_K:g} K), and dark current differs "
            "between them: average the frames of each temperature by themselves"
        )
        found = (Finding("temperature", message, "input"),)
    if dark:
        of_dark = _mean(map(settings_of, dark))
        found += other_settings("'dark'", of_dark, named, TOLERANCE_K)
    return found


def taken_with(files: Sequence[FrameFile]) -> dict[str, float]:
    """What frames were all taken with, for the metadata of their mean."""
    held = [file.settings for file in files]
    found = _mean(held)
    if any(apart(k, found[k], each[k], TOLERANCE_K) for each in held for k in range(len(KEYS))):
        return {}
    pairs = zip(KEYS, found, strict=True)
    return {key: value for (key, *_), value in pairs if value is not None}


def check_darks(
    names: Sequence[str], darks: Sequence[Settings], others: Sequence[Settings], words: Wording
) -> None:
    """Refuse darks without a value that another dark or one of `others` has, and two alike."""
    for index, value in enumerate(words.values):
        unknown = [k for k, each in enumerate(darks) if each[index] is None]
        if unknown and any(each[index] is not None for each in (*darks, *others)):
            raise FileError(f"{value} of {names[unknown[0]]} is not known: {words.unknown}")
    for (one, first), (other, second) in combinations(zip(names, darks, strict=True), 2):
        # Times that `shares_of` takes for the same serve the same exposures: one is left out.
        if not any(apart(k, first[k], second[k], tolerance=0) for k in range(len(KEYS))):
            raise FileError(f"{one} and {other} do not differ: {words.alike}")


def shares_of(
    place: str, wanted: Settings, darks: Sequence[Settings], tolerance: float, words: Wording
) -> Shares:
    """Share of each dark in that of an exposure: the one that fits, or two beside it in time."""
    held = [
        f"{', '.join(f'{each:g}' for each in dict.fromkeys(values) if each is not None)} {unit}"
        for values, (_, unit, _) in zip(zip(*darks, strict=True), KEYS, strict=True)
    ]
    for index, name in enumerate(words.values):
        differ = any(apart(index, each[index], darks[0][index], tolerance) for each in darks)
        if wanted[index] is None and differ:
            raise FileError(
                f"{name} of {place} is not known, and {words.darks} have {held[index]}: "
                f"{words.unknown}"
            )
    near = [k for k, each in enumerate(darks) if not apart(1, wanted[1], each[1], tolerance)]
    if not near:
        raise FileError(
            f"no dark fits {place} of {wanted.temperature_c:g} °C within {tolerance:g} K: they "
            f"have {held[1]}. Take dark frames at its temperature{words.temperature}"
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
