"""Exposure time and temperature of files, and the dark frames that fit them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from equipix.errors import FileError
from equipix.io.formats import saved_content
from equipix.io.frames import Settings, is_image, settings
from equipix.measured.statistics import FrameStatistics

_SAME = 0.01
"""Relative difference of exposure times that are the same: EXIF and people round them."""

KEYS = (("exposure_s", "s"), ("temperature_c", "°C"))
"""What an image was taken with, and its unit."""

TOLERANCE_K = 0.5
"""Difference of temperatures at which a dark still fits, unless another is stated."""

Shares = tuple[float, ...]
"""Share of each dark in that of an exposure, a level or a file."""


class Wording(NamedTuple):
    """Words of messages on darks, by the place where darks are named.

    `values` has a name for each of `KEYS`. Remedies are those for a value that is not known, for
    files of one dark that contradict one another, for two darks alike, and for a temperature that
    no dark has.
    """

    darks: str
    values: tuple[str, str]
    unknown: str
    contradiction: str
    alike: str
    temperature: str


_PLAIN = Wording("", ("", ""), "", "", "", "")


def settings_of(file: Path) -> Settings:
    """Exposure time and temperature of frames by their headers, of a saved average by its own."""
    if content := saved_content(file):
        return settings_in(content["fields"].get("metadata", {}))
    return settings(file)


def settings_in(metadata: Mapping[str, Any]) -> Settings:
    """Exposure time and temperature in the metadata of an average."""
    return Settings(*(metadata.get(key) for key, _ in KEYS))


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
            for key, _ in KEYS
            if key in one.metadata and key in other.metadata
        },
    )


def common_settings(
    place: str, stated: Settings, files: Sequence[Path], tolerance: float, words: Wording
) -> Settings:
    """Exposure time and temperature of some files: as stated, else the mean of what they hold."""
    read, found = {file: settings_of(file) for file in files}, list(stated)
    for index, (name, (_, unit)) in enumerate(zip(words.values, KEYS, strict=True)):
        known = [(file, value) for file, each in read.items() if (value := each[index]) is not None]
        whence = f"{name} of {place}"
        if stated[index] is None and known:
            whence = f"the mean of {place}"
            found[index] = float(np.mean([value for _, value in known]))
        for file, value in known:
            if apart(index, found[index], value, tolerance):
                raise FileError(
                    f"'{file.name}' holds {value:g} {unit}, but {whence} is {found[index]:g} "
                    f"{unit}: {words.contradiction.format(name=name, place=place)}"
                )
    return Settings(*found)


def taken_with(files: Sequence[Path]) -> dict[str, float]:
    """What frames in files other than images were all taken with, for the metadata of a mean.

    Images are left out: they seldom hold it, and many small ones are read faster than their EXIF.
    """
    if any(map(is_image, files)):
        return {}
    try:
        found = common_settings("", Settings(), files, TOLERANCE_K, _PLAIN)
    except FileError:  # frames of several exposure times
        return {}
    pairs = zip(KEYS, found, strict=True)
    return {key: value for (key, _), value in pairs if value is not None}


def check_darks(
    names: Sequence[str], darks: Sequence[Settings], others: Sequence[Settings], words: Wording
) -> None:
    """Refuse darks without a value that another dark or one of `others` has, and two alike."""
    for index, value in enumerate(words.values):
        unknown = [k for k, each in enumerate(darks) if each[index] is None]
        if unknown and any(each[index] is not None for each in (*darks, *others)):
            raise FileError(f"{value} of {names[unknown[0]]} is not known: {words.unknown}")
    for k, each in enumerate(darks):
        if each in darks[:k]:
            one = names[darks.index(each)]
            raise FileError(f"{one} and {names[k]} do not differ: {words.alike}")


def shares_of(
    place: str, wanted: Settings, darks: Sequence[Settings], tolerance: float, words: Wording
) -> Shares:
    """Share of each dark in that of an exposure: the one that fits, or two beside it in time."""
    held = [
        f"{', '.join(f'{each:g}' for each in dict.fromkeys(values) if each is not None)} {unit}"
        for values, (_, unit) in zip(zip(*darks, strict=True), KEYS, strict=True)
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


def apart(
    index: int, one: float | None, other: float | None, tolerance: float = TOLERANCE_K
) -> bool:
    """Whether two exposure times, or temperatures, are known and differ."""
    if one is None or other is None:
        return False
    limit = tolerance if index else _SAME * max(one, other)
    return abs(one - other) > limit + 1e-9 * abs(one)
