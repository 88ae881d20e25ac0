"""The command init: a commented file to fill in, with the image files of a folder."""

import re
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from glob import escape
from os.path import relpath
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import typer

from equipix.cli import terminal
from equipix.errors import EquipixError, FileError
from equipix.experiment.manifest import CameraManifest, LevelManifest, Manifest, Table
from equipix.experiment.templates import BLANK, template
from equipix.io.frames import frame_format
from equipix.io.paths import find_files, write_whole
from equipix.measured.statistics import saved_shape
from equipix.report.limits import limits_template

commands = typer.Typer()

_PLACES = ("*", "*/*", "*/*/*")
"""Where images are looked for: in the folder, and in those within it, two deep."""

_DARK, _HOLE = re.compile("dark"), re.compile(r"(?:^|[^a-z])(?:aperture|(?:pin)?hole)")
"""What the names of dark frames and of images of a hole contain."""

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


@commands.command(epilog="Example: equipix init experiment measurement/")
def init(
    kind: Annotated[
        Literal["experiment", "levels", "camera", "limits"],
        typer.Argument(help="The file: for calibrate, nuc fit, emva, or report --limits."),
    ],
    folder: Annotated[
        Path, typer.Argument(exists=True, file_okay=False, help="Where the images are.")
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
    if kind == "limits":
        text = limits_template()
    else:
        groups = _groups(folder, path.parent)
        model, values_of = _KINDS[kind]
        values = {"sensor": {"bit_depth": BLANK}, **values_of(groups or _EXAMPLES)}
        text = template(model, _TITLE, values)
        result["files_found"] = sum(len(group.files) for group in groups)
        result["values_to_fill_in"] = text.count(f' = "{BLANK}"')
    with write_whole(path, force=force) as temporary:
        # A name that is no UTF-8 becomes one that does not exist: TOML cannot hold it.
        temporary.write_text(text, encoding="utf-8", errors="replace")
    terminal.show_result(result, as_json=as_json)


def _groups(folder: Path, start: Path) -> list[_Group]:
    """Group the images in a folder by their names but for the last number."""
    found: dict[tuple[Path, str, str], list[Path]] = {}
    for place in _PLACES:
        with suppress(FileError):
            for file in find_files(place, folder=folder):
                alike = file.parent, file.stem.rstrip("0123456789"), file.suffix
                found.setdefault(alike, []).append(file)
    groups: list[_Group] = []
    kinds = Counter(parent for parent, *_ in found)
    for (parent, stem, _), files in found.items():
        if not (frames := _frames(files[0])):
            continue
        names = [Path(relpath(file, start)).as_posix() for file in files]
        name = parent.name if kinds[parent] == 1 and parent != folder else stem.rstrip(" -_.")
        place, entry = relpath(files[0], folder), _entry(names, start)
        one = _Group(name or parent.name, place, names, entry, len(files))
        if frames == 1 < len(files):
            groups.append(one)
        else:
            parts = zip(one.parts(), files, strict=True)
            groups += [part._replace(frames=_frames(file)) for part, file in parts]
    return groups


def _frames(file: Path) -> int:
    """Count the frames of a file, more than one of a saved average; 0 of what holds none."""
    try:
        return 2 if saved_shape(file) else frame_format(file)[0][0]
    except EquipixError:
        return 0


def _entry(names: list[str], start: Path) -> str | list[str]:
    """Name numbered files by a glob where that finds just these."""
    head, dot, suffix = names[0].rpartition(".")
    pattern = f"{escape(head.rstrip('0123456789'))}*{dot}{suffix}"
    found = [Path(relpath(file, start)).as_posix() for file in find_files(pattern, folder=start)]
    return pattern if found == names else names


def _light(groups: list[_Group]) -> list[_Group]:
    """Take the frames with light, of one group each file by itself; each has a name of its own."""
    light = [each for each in groups if not (each.shows(_DARK) or each.shows(_HOLE))]
    light = light or _EXAMPLES[:2]
    if len(light) == 1:
        light = light[0].parts()
    names = Counter(group.name for group in light)
    return [
        each
        if names[each.name] == 1
        else each._replace(name=f"{Path(each.files[0]).parent.name}-{k}")
        for k, each in enumerate(light)
    ]


def _dark(groups: list[_Group]) -> list[str | list[str]]:
    """Name the dark frames of each group."""
    return [group.entry for group in groups if group.shows(_DARK)]


def _flat(entries: list[str | list[str]]) -> str | list[str]:
    """Join entries to one; a blank without any."""
    names = [name for each in entries for name in ([each] if isinstance(each, str) else each)]
    return names if len(names) > 1 else [*names, BLANK][0]


def _of_experiment(groups: list[_Group]) -> dict[str, Any]:
    """Give exposures, with the images of a hole whose names have exposure and time."""
    holes = [name for group in groups if group.shows(_HOLE) for name in group.files]
    exposures: list[dict[str, Any]] = []
    for group in _light(groups):
        own = re.compile(rf"(?<![^\W_]){re.escape(group.name)}(?![^\W_])")
        position: dict[str, Any] = {
            f"aperture_{when}": _flat([name for name in holes if own.search(name) and when in name])
            for when in ("before", "after")
        }
        if BLANK in position.values():
            position = {"shift": BLANK}
        given = {"name": group.name, "frames": group.entry}
        exposures.append(given | (position if exposures else {}))
    return {"dark": [{"frames": _flat(_dark(groups))}], "exposure": exposures}


def _of_levels(groups: list[_Group]) -> dict[str, Any]:
    """Give levels by their names, and the dark where there is one."""
    levels = [{"frames": each.entry, "name": each.name} for each in _light(groups)]
    dark = _dark(groups)
    return {"level": levels} | ({"dark": [{"frames": _flat(dark)}]} if dark else {})


def _of_camera(groups: list[_Group]) -> dict[str, Any]:
    """Give pairs of light and dark in their order, the longest for the non-uniformity."""
    light, dark = _light(groups), _dark(groups)
    if len(dark) != len(light):
        dark = [dark[0] if len(dark) == 1 else BLANK] * len(light)
    levels = [
        {"frames": each.entry, "dark": entry, "name": each.name}
        | {"exposure_s": BLANK, "photons": BLANK}
        for each, entry in zip(light, dark, strict=True)
    ]
    counts = [each.frames for each in light]
    most = max(counts)
    if len(light) < 3 or most <= 2 or counts.count(most) > 1:
        return {"exposure": levels}
    spatial = levels.pop(counts.index(most))
    return {"exposure": levels, "spatial": {key: spatial[key] for key in ("frames", "dark")}}


_KINDS: dict[str, tuple[type[Table], Callable[[list[_Group]], dict[str, Any]]]] = {
    "experiment": (Manifest, _of_experiment),
    "levels": (LevelManifest, _of_levels),
    "camera": (CameraManifest, _of_camera),
}
