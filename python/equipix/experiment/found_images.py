"""Image files of a folder, by what their headers and names say: light, dark, or of a hole."""

import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from glob import escape
from os.path import relpath
from pathlib import Path
from typing import NamedTuple, Self

from equipix.correction.correct_files import is_corrected
from equipix.errors import EquipixError, FileError
from equipix.experiment.manifest import Sensor
from equipix.io import camera_raw
from equipix.io.fits import ImageType
from equipix.io.formats import FrameFile
from equipix.io.frames import Settings, apart, has_format, header
from equipix.io.paths import find_files
from equipix.measured.statistics import saved_shape

_PLACES = ("*", "*/*", "*/*/*")
"""Where images are looked for: in the folder, and in those within it, two deep."""

_DARK, _HOLE = re.compile("dark"), re.compile(r"(?:^|[^a-z])(?:aperture|(?:pin)?hole)")
"""What the names of dark frames and of images of a hole contain."""

_OTHER = re.compile(r"(?:^|[^a-z])(?:science|object|target|bias|mask)")
"""What the names of images contain that are no measurement of the sensor."""


class ImageGroup(NamedTuple):
    """Images that belong together.

    `place` is that of the first in the folder, `files` and `entry` are as the manifest names them.
    """

    name: str
    place: str
    files: list[str]
    entry: str | list[str]
    frames: int = 1
    settings: Settings = Settings()
    saved: bool = False
    image_type: ImageType = ImageType()

    @property
    def is_dark(self) -> bool:
        """Whether its files are dark frames by their headers, or else by their names."""
        return _is_dark(self.image_type, self.place)

    def is_named(self, kind: re.Pattern[str]) -> bool:
        """Whether its files are of a kind by their names."""
        return kind.search(self.place.lower()) is not None

    def by_file(self) -> list[Self]:
        """Make a group of each file."""
        return [
            self._replace(name=Path(each).stem, files=[each], entry=each) for each in self.files
        ]


class FoundImages(NamedTuple):
    """Images of a folder by what their names say; `left` says why others are not used."""

    light: list[ImageGroup]
    dark: list[ImageGroup]
    holes: list[str]
    left: dict[str, str]

    @property
    def files(self) -> list[str]:
        """Names of all images that are measurements of the sensor."""
        groups = (*self.light, *self.dark)
        return [*self.holes, *(name for each in groups for name in each.files)]

    @property
    def raw(self) -> list[str]:
        """Those that are raw files of cameras, which hold their black and white level."""
        return [name for name in self.files if name.lower().endswith(camera_raw.SUFFIXES)]


def find_images(folder: Path, start: Path) -> FoundImages:
    """Find the images in a folder and two folders deep; their names begin at `start`."""
    groups, left = _groups(folder, start)
    bias = [each for each in groups if each.image_type.kind == "bias"]
    groups = [each for each in groups if each not in bias]
    holes = [each for each in groups if each.is_named(_HOLE) and each.image_type.kind != "dark"]
    other = [each for each in groups if each.is_named(_OTHER) and each not in holes]
    rest = [each for each in groups if each not in (*holes, *other)]
    dark = _raw_first([each for each in rest if each.is_dark], left)
    light = _raw_first([each for each in rest if not each.is_dark], left)
    left |= {name: f"is {each.image_type}" for each in bias for name in each.files}
    left |= {name: "no frames of the sensor by its name" for each in other for name in each.files}
    return FoundImages(light, dark, [name for each in holes for name in each.files], left)


def settings_differ(one: Settings, other: Settings, temperature_tolerance: float) -> bool:
    """Whether two files were taken with other exposure times or at other temperatures."""
    pairs = enumerate(zip(one, other, strict=True))
    return any(apart(key, a, b, temperature_tolerance) for key, (a, b) in pairs)


def _groups(folder: Path, start: Path) -> tuple[list[ImageGroup], dict[str, str]]:
    """Group the images in a folder by their names but for the last number, type and settings.

    Files that hold no frames of a sensor stand in the second value, with the reason.
    """
    found: dict[tuple[Path, str, str], dict[Path, int]] = {}
    left: dict[str, str] = {}
    for place in _PLACES:
        with suppress(FileError):
            for file in filter(has_format, find_files(place, folder=folder)):
                alike = file.parent, file.stem.rstrip("0123456789"), file.suffix
                try:
                    found.setdefault(alike, {})[file] = _frame_count(file)
                except EquipixError as error:
                    left[_relative(file, start)] = str(error).removeprefix(f"{file}: ")
    kinds = Counter(parent for parent, *_ in found)
    groups: list[ImageGroup] = []
    for (parent, stem, _), counts in found.items():
        alone = kinds[parent] == 1 and parent != folder
        name = (parent.name if alone else stem.rstrip(" -_.")) or parent.name
        groups.extend(_groups_of(counts, name, folder, start, alone=alone))
    return groups, left


def _groups_of(
    counts: dict[Path, int], name: str, folder: Path, start: Path, *, alone: bool
) -> Iterator[ImageGroup]:
    """Group files of one name and their counts of frames; a file with several is a group.

    Those that are `alone` in their folder have its name.
    """
    series = _by_settings([*counts], folder)
    for held, image_type, files in series:
        time = "" if len(series) == 1 or held.exposure_s is None else f"-{held.exposure_s:g}s"
        names = [_relative(file, start) for file in files]
        place, entry = relpath(files[0], folder), _entry(names, start)
        group = ImageGroup(
            name + time, place, names, entry, len(files), held, image_type=image_type
        )
        if len(files) > 1 and counts[files[0]] == 1:
            yield group
            continue
        parts = group.by_file()
        if alone and len(files) == 1:
            parts = [parts[0]._replace(name=group.name)]
        for part, file in zip(parts, files, strict=True):
            yield part._replace(frames=counts[file] or 2, saved=counts[file] == 0)


def _frame_count(file: Path) -> int:
    """Count the frames of a file; 0 of a saved average."""
    if saved_shape(file):
        return 0
    found = header(file)
    if is_corrected(found.description):
        raise FileError(f"{file}: holds corrected frames, expected raw ones")
    return found.shape[0]


def _by_settings(files: list[Path], folder: Path) -> list[tuple[Settings, ImageType, list[Path]]]:
    """Part files by types of images and exposure times, dark frames by their temperatures too."""
    place = relpath(files[0], folder)
    found: list[tuple[Settings, ImageType, list[Path]]] = []
    for file in map(FrameFile, files):
        held, shown = file.settings, file.image_type
        is_dark = _is_dark(shown, place)
        tolerance = Sensor().dark_temperature_tolerance_c if is_dark else float("inf")
        for other, other_type, alike in found:
            if shown.kind == other_type.kind and not settings_differ(held, other, tolerance):
                alike.append(file.path)
                break
        else:
            found.append((held, shown, [file.path]))
    return found


def _is_dark(image_type: ImageType, place: str) -> bool:
    """Whether files are dark frames by their headers, or else by their names."""
    kind = image_type.kind
    return kind == "dark" if kind else _DARK.search(place.lower()) is not None


def _relative(file: Path, start: Path) -> str:
    return Path(relpath(file, start)).as_posix()


def _entry(names: list[str], start: Path) -> str | list[str]:
    """Name numbered files by a glob where that finds just these."""
    head, dot, suffix = names[0].rpartition(".")
    pattern = f"{escape(head.rstrip('0123456789'))}*{dot}{suffix}"
    found = [_relative(file, start) for file in find_files(pattern, folder=start)]
    return pattern if found == names else names


def _raw_first(groups: list[ImageGroup], left: dict[str, str]) -> list[ImageGroup]:
    """Leave saved averages out beside the frames that they may be made of."""
    raw = [each for each in groups if not each.saved]
    if raw:
        left |= {
            name: "a saved average beside raw frames"
            for each in groups
            if each.saved
            for name in each.files
        }
    return raw or groups
