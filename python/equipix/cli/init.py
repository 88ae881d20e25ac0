"""The command init: a commented file to fill in, with the image files of a folder."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from glob import escape
from os.path import relpath
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, NamedTuple, Self

import typer

from equipix.cli import terminal
from equipix.correction.correct_files import is_corrected
from equipix.errors import EquipixError, FileError
from equipix.experiment.manifest import CameraManifest, LevelManifest, Manifest, Sensor, Table
from equipix.experiment.templates import BLANK, template
from equipix.findings import Finding, say
from equipix.io import camera_raw
from equipix.io.frames import Settings, apart, has_format, header, settings
from equipix.io.paths import find_files, write_whole
from equipix.measured.statistics import saved_shape
from equipix.report.limits import limits_template

commands = typer.Typer()

_PLACES = ("*", "*/*", "*/*/*")
"""Where images are looked for: in the folder, and in those within it, two deep."""

_DARK, _HOLE = re.compile("dark"), re.compile(r"(?:^|[^a-z])(?:aperture|(?:pin)?hole)")
"""What the names of dark frames and of images of a hole contain."""

_OTHER = re.compile(r"(?:^|[^a-z])(?:science|object|target|bias|mask)")
"""What the names of images contain that are no measurement of the sensor."""

_TITLE = (
    f'Replace each "{BLANK}", and see which files stand where. A line that begins with # is a '
    "comment, or a key that may be left out: remove its # to set it."
)


class _Group(NamedTuple):
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

    def shows(self, kind: re.Pattern[str]) -> bool:
        """Whether its files are of a kind by their names."""
        return kind.search(self.place.lower()) is not None

    def parts(self) -> list[Self]:
        """Take each file by itself."""
        return [
            self._replace(name=Path(each).stem, files=[each], entry=each) for each in self.files
        ]


_EXAMPLES = [_Group(name, name, [name], f"{name}/*.tif") for name in ("p0", "p1", "dark")]
"""What stands for the images of a folder without any."""


class _Images(NamedTuple):
    """Images of a folder by what their names say; `left` says why others are not used."""

    light: list[_Group]
    dark: list[_Group]
    holes: list[str]
    left: dict[str, str]

    @classmethod
    def of(cls, folder: Path, start: Path) -> Self:
        """Find them; names in the manifest begin at `start`."""
        groups, left = _groups(folder, start)
        holes = [each for each in groups if each.shows(_HOLE)]
        other = [each for each in groups if each.shows(_OTHER) and each not in holes]
        rest = [each for each in groups if each not in (*holes, *other)]
        dark = _raw_first([each for each in rest if each.shows(_DARK)], left)
        light = _raw_first([each for each in rest if not each.shows(_DARK)], left)
        left |= {
            name: "no frames of the sensor by its name" for each in other for name in each.files
        }
        return cls(light, dark, [name for each in holes for name in each.files], left)

    def unused(self, values: Any) -> dict[str, str]:
        """Images that the values of a manifest do not name, and why."""
        named = {*_texts(values)}
        found = dict.fromkeys(self.holes, "belongs to no exposure by its name")
        for each in (*self.light, *self.dark):
            if not isinstance(each.entry, str) or each.entry not in named:
                found |= dict.fromkeys(each.files, "has no counterpart")
        return self.left | {name: why for name, why in found.items() if name not in named}


@commands.command(epilog="Example: equipix init experiment measurement/")
def init(
    kind: Annotated[
        Literal["experiment", "levels", "camera", "limits"],
        typer.Argument(help="The file: for calibrate, nuc fit, emva, or report --limits."),
    ],
    folder: Annotated[
        Path,
        typer.Argument(
            exists=True,
            file_okay=False,
            help="Where the images are, and two folders deep. Their names say what they are: dark; "
            "hole or aperture with before or after and the name of an exposure; science, object, "
            "target, bias and mask are not used; all others have light. What is not used is "
            "listed. Without images the file holds examples.",
        ),
    ] = Path(),
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The file: .toml; in FOLDER unless given."),
    ] = None,
    force: terminal.Force = False,
    as_json: terminal.Json = False,
) -> None:
    """Write a commented experiment.toml, levels.toml, camera.toml or limits.toml."""
    path = output or folder / f"{kind}.toml"
    terminal.check_output(path, force=force, suffixes=(".toml",))
    result: dict[str, Any] = {"output": str(path)}
    said: tuple[Finding, ...] = ()
    if kind == "limits":
        text = limits_template()
    else:
        found = _Images.of(folder, path.parent)
        model, values_of = _KINDS[kind]
        light = found.light or _EXAMPLES[:2]
        dark = found.dark if found.light or found.dark else _EXAMPLES[2:]
        values = values_of(found._replace(light=_named(light), dark=dark))
        unused = found.unused(values)
        said = say(*_findings(found, folder, unused))
        sensor = {} if _tell_depth(found) else {"bit_depth": BLANK}
        title = " ".join([*(each.message + "." for each in said if each.kind == "images"), _TITLE])
        text = template(model, title, {"sensor": sensor, **values}) + _listed(unused)
        result["files_found"] = len(_files(found))
        result["files_not_used"] = len(unused)
        result["values_to_fill_in"] = text.count(f' = "{BLANK}"')
    with write_whole(path, force=force) as temporary:
        # A name that is no UTF-8 becomes one that does not exist: TOML cannot hold it.
        temporary.write_text(text, encoding="utf-8", errors="replace")
    terminal.show_result(result, None if kind == "limits" else said, as_json=as_json)


def _findings(found: _Images, folder: Path, unused: dict[str, str]) -> Iterator[Finding]:
    """Say that entries are examples, and which images are not used."""
    if not found.light:
        what = "no frames with light were" if _files(found) or unused else "no images were"
        words = f"{what} found in '{folder}': the entries for them are examples"
        yield Finding("images", words, "input", "note")
    if unused:
        first, *others = unused.items()
        more = f", and {len(others)} more" if others else ""
        words = (
            f"not used: '{first[0]}' ({first[1]}){more}; the end of the file lists all with the "
            "reasons"
        )
        yield Finding("unused", words, "input", "note")


def _files(found: _Images) -> list[str]:
    """Names of all images that are measurements of the sensor."""
    return [*found.holes, *(name for each in (*found.light, *found.dark) for name in each.files)]


def _tell_depth(found: _Images) -> bool:
    """Whether the files hold the level of saturation themselves."""
    files = _files(found)
    return bool(files) and all(name.lower().endswith(camera_raw.SUFFIXES) for name in files)


def _listed(unused: dict[str, str]) -> str:
    """List images that are not used as comments."""
    lines = [f"#   {name}: {why}" for name, why in unused.items()]
    return "\n".join(["", "# Images that are not used:", *lines, ""]) if lines else ""


def _texts(value: Any) -> Iterator[str]:
    """Give all texts within a value."""
    if isinstance(value, str):
        yield value
        return
    within = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for each in within:
        yield from _texts(each)


def _groups(folder: Path, start: Path) -> tuple[list[_Group], dict[str, str]]:
    """Group the images in a folder by their names but for the last number, and by settings.

    Files that hold no frames of a sensor stand in the second value, with the reason.
    """
    found: dict[tuple[Path, str, str], dict[Path, int]] = {}
    left: dict[str, str] = {}
    for place in _PLACES:
        with suppress(FileError):
            for file in filter(has_format, find_files(place, folder=folder)):
                alike = file.parent, file.stem.rstrip("0123456789"), file.suffix
                try:
                    found.setdefault(alike, {})[file] = _frames(file)
                except EquipixError as error:
                    left[_relative(file, start)] = str(error).removeprefix(f"{file}: ")
    groups: list[_Group] = []
    kinds = Counter(parent for (parent, *_), files in found.items() if files)
    for (parent, stem, _), counts in found.items():
        alone = kinds[parent] == 1 and parent != folder
        name = parent.name if alone else stem.rstrip(" -_.")
        series = _by_settings([*counts], folder)
        for held, files in series:
            time = "" if len(series) == 1 or held.exposure_s is None else f"-{held.exposure_s:g}s"
            names = [_relative(file, start) for file in files]
            one = _Group(
                (name or parent.name) + time,
                relpath(files[0], folder),
                names,
                _entry(names, start),
                len(files),
                held,
            )
            if len(files) > 1 and counts[files[0]] == 1:
                groups.append(one)
                continue
            parts = one.parts()
            if alone and len(files) == 1:
                parts = [parts[0]._replace(name=one.name)]
            for part, file in zip(parts, files, strict=True):
                is_saved = counts[file] == 0
                groups.append(part._replace(frames=counts[file] or 2, saved=is_saved))
    return groups, left


def _frames(file: Path) -> int:
    """Count the frames of a file; 0 of a saved average."""
    if saved_shape(file):
        return 0
    found = header(file)
    if is_corrected(found.description):
        raise FileError(f"{file}: holds corrected frames, expected raw ones")
    return found.shape[0]


def _by_settings(files: list[Path], folder: Path) -> list[tuple[Settings, list[Path]]]:
    """Part files by their exposure times, dark frames by their temperatures too."""
    is_dark = _DARK.search(relpath(files[0], folder).lower()) if files else None
    tolerance = Sensor().dark_temperature_tolerance_c if is_dark else float("inf")
    found: list[tuple[Settings, list[Path]]] = []
    for file in files:
        held = settings(file)
        for other, alike in found:
            if not _differ(held, other, tolerance):
                alike.append(file)
                break
        else:
            found.append((held, [file]))
    return found


def _differ(one: Settings, other: Settings, tolerance: float) -> bool:
    return any(apart(k, a, b, tolerance) for k, (a, b) in enumerate(zip(one, other, strict=True)))


def _relative(file: Path, start: Path) -> str:
    return Path(relpath(file, start)).as_posix()


def _entry(names: list[str], start: Path) -> str | list[str]:
    """Name numbered files by a glob where that finds just these."""
    head, dot, suffix = names[0].rpartition(".")
    pattern = f"{escape(head.rstrip('0123456789'))}*{dot}{suffix}"
    found = [_relative(file, start) for file in find_files(pattern, folder=start)]
    return pattern if found == names else names


def _raw_first(groups: list[_Group], left: dict[str, str]) -> list[_Group]:
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


def _named(light: list[_Group]) -> list[_Group]:
    """Take of one group each file by itself."""
    return light[0].parts() if len(light) == 1 else light


def _names(light: list[_Group]) -> list[str]:
    """Name each of the frames with light differently."""
    names = Counter(group.name for group in light)
    return [
        each.name if names[each.name] == 1 else f"{PurePosixPath(each.files[0]).parent.name}-{k}"
        for k, each in enumerate(light)
    ]


def _darks(groups: list[_Group]) -> list[dict[str, Any]]:
    """Give one table for each pair of exposure time and temperature, or folder without them."""
    found: list[tuple[_Group, list[str | list[str]]]] = []
    tolerance = Sensor().dark_temperature_tolerance_c
    for group in groups:
        for other, entries in found:
            places = (PurePosixPath(each.files[0]).parent for each in (group, other))
            alike = len({*places}) == 1 if group.settings == Settings() else True
            if alike and not _differ(group.settings, other.settings, tolerance):
                entries.append(group.entry)
                break
        else:
            found.append((group, [group.entry]))
    tables: list[dict[str, Any]] = [{"frames": _flat(entries)} for _, entries in found]
    for index, key in enumerate(Settings._fields):
        values = [group.settings[index] for group, _ in found]
        asked = index == 0 and len(values) > 1
        for table, value in zip(tables, values, strict=True):
            if value is not None or asked or any(each is not None for each in values):
                table[key] = BLANK if value is None else value
    return tables


def _flat(entries: Iterable[str | list[str]]) -> str | list[str]:
    """Join entries to one; a blank without any."""
    names = [name for each in entries for name in ([each] if isinstance(each, str) else each)]
    return names if len(names) > 1 else [*names, BLANK][0]


def _of_experiment(found: _Images) -> dict[str, Any]:
    """Give exposures, with the images of a hole whose names have exposure and time."""
    exposures: list[dict[str, Any]] = []
    holes = [_exposure_of(name, found.light) for name in found.holes]
    for name, group in zip(_names(found.light), found.light, strict=True):
        own = [hole for hole, each in zip(found.holes, holes, strict=True) if each is group]
        position: dict[str, Any] = {
            f"aperture_{when}": _flat([hole for hole in own if when in hole])
            for when in ("before", "after")
        }
        if BLANK in position.values():
            position = {"shift": BLANK}
        given = {"name": name, "frames": group.entry}
        exposures.append(given | (position if exposures else {}))
    needs_none = _tell_depth(found) and not found.dark
    darks = [] if needs_none else _darks(found.dark) or [{"frames": BLANK}]
    return {"exposure": exposures} | ({"dark": darks} if darks else {})


def _exposure_of(hole: str, light: list[_Group]) -> _Group | None:
    """Find the exposure whose name that of an image of a hole contains, beside its folder.

    The exposures are in the folder of the image or, where there are none, in the one above it.
    """
    above = PurePosixPath(hole).parents
    within = {
        folder: [each for each in light if folder in PurePosixPath(each.files[0]).parents]
        for folder in above[:2]
    }
    near = next(filter(None, within.values()), [])
    named = [
        each for each in near if re.search(rf"(?<![^\W_]){re.escape(each.name)}(?![^\W_])", hole)
    ]
    longest = max((len(each.name) for each in named), default=0)
    best = [each for each in named if len(each.name) == longest]
    return best[0] if len(best) == 1 else None


def _of_levels(found: _Images) -> dict[str, Any]:
    """Give levels by their names, and the darks where there are any."""
    names = zip(_names(found.light), found.light, strict=True)
    levels = [{"frames": each.entry, "name": name} for name, each in names]
    darks = _darks(found.dark)
    return {"level": levels} | ({"dark": darks} if darks else {})


def _of_camera(found: _Images) -> dict[str, Any]:
    """Give pairs of light and dark, the longest for the non-uniformity."""
    levels = [
        {"frames": each.entry, "dark": dark, "name": name}
        | {"exposure_s": BLANK if each.settings.exposure_s is None else each.settings.exposure_s}
        | {"photons": BLANK}
        for name, each, dark in zip(
            _names(found.light), found.light, _paired(found.light, found.dark), strict=True
        )
    ]
    counts = [each.frames for each in found.light]
    most = max(counts)
    if len(counts) < 3 or most <= 2 or counts.count(most) > 1:
        return {"exposure": levels}
    spatial = levels.pop(counts.index(most))
    return {"exposure": levels, "spatial": {key: spatial[key] for key in ("frames", "dark")}}


def _paired(light: list[_Group], dark: list[_Group]) -> list[str | list[str]]:
    """Give the dark of each level: by exposure time, else by their order, else the only one."""
    times = [each.settings.exposure_s for each in (*light, *dark)]
    if None not in times:
        fitting = [
            [d for d in dark if not apart(0, each.settings.exposure_s, d.settings.exposure_s, 0)]
            for each in light
        ]
        # Of two series of one time each takes the one of its length.
        return [
            min(few, key=lambda d: abs(d.frames - each.frames)).entry if few else BLANK
            for each, few in zip(light, fitting, strict=True)
        ]
    if len(dark) != len(light):
        return [dark[0].entry if len(dark) == 1 else BLANK] * len(light)
    return [each.entry for each in dark]


_KINDS: dict[str, tuple[type[Table], Callable[[_Images], dict[str, Any]]]] = {
    "experiment": (Manifest, _of_experiment),
    "levels": (LevelManifest, _of_levels),
    "camera": (CameraManifest, _of_camera),
}
