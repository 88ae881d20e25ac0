"""Manifests to fill in, with the images of a folder."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from equipix.experiment.found_images import FoundImages, ImageGroup, find_images, settings_differ
from equipix.experiment.manifest import CameraManifest, LevelManifest, Manifest, Sensor, Table
from equipix.experiment.templates import BLANK, template
from equipix.findings import Finding
from equipix.io.frames import Settings, apart, suffix_of

_EXAMPLES = [ImageGroup(name, name, [name], f"{name}/*.tif") for name in ("p0", "p1", "dark")]
"""What stands for the images of a folder without any."""

_TITLE = (
    f'Replace each "{BLANK}", and see which files stand where. A line that begins with # is a '
    "comment, or a key that may be left out: remove its # to set it."
)

_CONTROL = r"[\x00-\x1f\x7f]"
"""Characters of names that end a comment of TOML, or that it refuses."""

_PACKED = r"\.[gf]z$"
"""Suffix of a compressed file, behind that of its format."""

_Entry = str | list[str]
"""Names of files as a manifest has them."""


class Draft(NamedTuple):
    """A manifest to fill in: its text, and how many images were found and are not used."""

    text: str
    findings: tuple[Finding, ...]
    files_found: int
    files_not_used: int
    values_to_fill_in: int


def draft_manifest(kind: str, folder: Path, start: Path) -> Draft:
    """Write a manifest that names the images of a folder, or examples without any.

    Parameters
    ----------
    kind : {"experiment", "levels", "camera"}
        Which manifest.
    folder : Path
        Where the images are, and two folders deep.
    start : Path
        Folder of the manifest, at which the names of files begin.

    Returns
    -------
    Draft
        The text, with a `BLANK` for each value that only the user knows.
    """
    found = find_images(folder, start)
    model, values_of = _KINDS[kind]
    light = found.light or _EXAMPLES[:2]
    dark = found.dark if found.light or found.dark else _EXAMPLES[2:]
    if len(light) == 1:
        light = light[0].by_file()
    values = values_of(found._replace(light=light, dark=dark))
    unused = _unused(found, values)
    findings = (*_findings(found, folder, unused),)
    sensor = {} if found.raw else {"bit_depth": BLANK}
    title = " ".join([*(each.message + "." for each in findings if each.kind == "images"), _TITLE])
    text = template(model, title, {"sensor": sensor, **values}) + _comments(unused)
    plain = (re.sub(_PACKED, "", name.lower()) for name in (*found.files, *unused))
    suffixes = [suffix for suffix in map(suffix_of, map(Path, plain)) if suffix]
    if suffixes and ".tif" not in suffixes:  # examples are as the images that there are
        text = text.replace('.tif"', f'{suffixes[0]}"')
    blanks = text.count(f' = "{BLANK}"')
    return Draft(text, findings, len(found.files), len(unused), blanks)


def _unused(found: FoundImages, values: Any) -> dict[str, str]:
    """Images that the values of a manifest do not name, and why."""
    named = {*_texts(values)}
    reasons = dict.fromkeys(found.holes, "belongs to no exposure by its name")
    for each in (*found.light, *found.dark):
        if not isinstance(each.entry, str) or each.entry not in named:
            reasons |= dict.fromkeys(each.files, "has no counterpart")
    return found.left | {name: why for name, why in reasons.items() if name not in named}


def _texts(value: Any) -> Iterator[str]:
    """Give all texts within a value."""
    if isinstance(value, str):
        yield value
        return
    within = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for each in within:
        yield from _texts(each)


def _findings(found: FoundImages, folder: Path, unused: dict[str, str]) -> Iterator[Finding]:
    """Say that entries are examples, and which images are not used."""
    if not found.light:
        what = "no frames with light were" if found.files or unused else "no images were"
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


def _comments(unused: dict[str, str]) -> str:
    """List images that are not used as comments."""
    plain = ((re.sub(_CONTROL, "?", name), why) for name, why in unused.items())
    lines = [f"#   {name}: {why}" for name, why in plain]
    return "\n".join(["", "# Images that are not used:", *lines, ""]) if lines else ""


def _experiment(found: FoundImages) -> dict[str, Any]:
    """Give exposures, with the images of a hole whose names have exposure and time."""
    exposures: list[dict[str, Any]] = []
    holes = [_exposure_of(name, found.light) for name in found.holes]
    for name, group in zip(_unique_names(found.light), found.light, strict=True):
        own = [hole for hole, each in zip(found.holes, holes, strict=True) if each is group]
        position: dict[str, Any] = {
            f"aperture_{when}": _joined([hole for hole in own if when in hole])
            for when in ("before", "after")
        }
        if BLANK in position.values():
            position = {"shift": BLANK}
        given = {"name": name, "frames": group.entry}
        exposures.append(given | (position if exposures else {}))
    needs_none = found.raw and found.raw == found.files and not found.dark
    darks = [] if needs_none else _dark_tables(found.dark) or [{"frames": BLANK}]
    return {"exposure": exposures} | ({"dark": darks} if darks else {})


def _levels(found: FoundImages) -> dict[str, Any]:
    """Give levels by their names, and the darks where there are any."""
    names = zip(_unique_names(found.light), found.light, strict=True)
    levels = [{"frames": each.entry, "name": name} for name, each in names]
    darks = _dark_tables(found.dark)
    return {"level": levels} | ({"dark": darks} if darks else {})


def _camera(found: FoundImages) -> dict[str, Any]:
    """Give pairs of light and dark, the longest for the non-uniformity."""
    names, darks = _unique_names(found.light), _dark_entries(found.light, found.dark)
    levels = [
        {"frames": each.entry, "dark": dark, "name": name}
        | {"exposure_s": BLANK if each.settings.exposure_s is None else each.settings.exposure_s}
        | {"photons": BLANK}
        for name, each, dark in zip(names, found.light, darks, strict=True)
    ]
    counts = [each.frames for each in found.light]
    most = max(counts)
    if len(counts) < 3 or most <= 2 or counts.count(most) > 1:
        return {"exposure": levels}
    spatial = levels.pop(counts.index(most))
    return {"exposure": levels, "spatial": {key: spatial[key] for key in ("frames", "dark")}}


_KINDS: dict[str, tuple[type[Table], Callable[[FoundImages], dict[str, Any]]]] = {
    "experiment": (Manifest, _experiment),
    "levels": (LevelManifest, _levels),
    "camera": (CameraManifest, _camera),
}


def _unique_names(light: list[ImageGroup]) -> list[str]:
    """Name each of the frames with light differently."""
    names = Counter(group.name for group in light)
    return [
        each.name if names[each.name] == 1 else f"{PurePosixPath(each.files[0]).parent.name}-{k}"
        for k, each in enumerate(light)
    ]


def _exposure_of(hole: str, light: list[ImageGroup]) -> ImageGroup | None:
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


def _dark_tables(groups: list[ImageGroup]) -> list[dict[str, Any]]:
    """Give one table for each pair of exposure time and temperature, or folder without them."""
    found: list[tuple[ImageGroup, list[_Entry]]] = []
    tolerance = Sensor().dark_temperature_tolerance_c
    for group in groups:
        for other, entries in found:
            places = (PurePosixPath(each.files[0]).parent for each in (group, other))
            alike = len({*places}) == 1 if group.settings == Settings() else True
            if alike and not settings_differ(group.settings, other.settings, tolerance):
                entries.append(group.entry)
                break
        else:
            found.append((group, [group.entry]))
    tables: list[dict[str, Any]] = [{"frames": _joined(entries)} for _, entries in found]
    for index, key in enumerate(Settings._fields):
        values = [group.settings[index] for group, _ in found]
        asked = index == 0 and len(values) > 1
        for table, value in zip(tables, values, strict=True):
            if value is not None or asked or any(each is not None for each in values):
                table[key] = BLANK if value is None else value
    return tables


def _dark_entries(light: list[ImageGroup], dark: list[ImageGroup]) -> list[_Entry]:
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


def _joined(entries: Iterable[_Entry]) -> _Entry:
    """Join entries to one; a blank without any."""
    names = [name for each in entries for name in ([each] if isinstance(each, str) else each)]
    return names if len(names) > 1 else [*names, BLANK][0]
