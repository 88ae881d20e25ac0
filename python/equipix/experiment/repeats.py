"""Files that an experiment names twice, or under two names."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

from equipix.errors import FileError
from equipix.experiment.manifest import LevelManifest, find_files
from equipix.experiment.provenance import sha256_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from equipix.experiment.manifest import Manifest


class Entry(NamedTuple):
    """The files of one key of experiment.toml."""

    key: str
    exposure: str
    files: list[Path]
    kind: str = "exposure"

    def __str__(self) -> str:
        """Return the words for a message."""
        return f"'{self.key}' of {self.kind} '{self.exposure}'" if self.exposure else "[dark]"


def refuse_repeats(
    path: Path, manifest: Manifest | LevelManifest, hashes: Mapping[Path, str] | None = None
) -> None:
    """Refuse a file that stands for two measurements, by its name or, with `hashes`, its content.

    One image of the aperture may serve for two moves: it is after the one and before the other.
    Dark frames may be equal, as those of a camera that shows 0 in the dark.

    Raises
    ------
    FileError
        With the file and where it stands.
    """
    entries = [*_entries(path, manifest)]
    for entry in entries:
        if hashes is None or entry.key != "dark":
            for one, other in _alike(entry.files, entry.files, hashes, within=True):
                raise FileError(f"{path}: {_words(one, other)} twice in {entry}")
    for first, second in combinations(entries, 2):
        images = "aperture" in first.key and "aperture" in second.key
        if images and first.exposure != second.exposure:
            continue
        for one, other in _alike(first.files, second.files, hashes):
            raise FileError(
                f"{path}: {_words(one, other)} in {first} and in {second}: give each its own frames"
            )


def refuse_repeated_files(frames: list[Path], dark: list[Path]) -> None:
    """Refuse a file that is averaged twice, by its name or its content, or as its own dark.

    Raises
    ------
    FileError
        With the file and where it stands.
    """
    for hashes in (None, sha256_of(dict.fromkeys([*frames, *dark]))):
        for one, other in _alike(frames, frames, hashes, within=True):
            raise FileError(f"{_words(one, other)} twice in the frames: give each once")
        for one, other in _alike(frames, dark, hashes):
            raise FileError(
                f"{_words(one, other)} in the frames and in 'dark': give each its own frames"
            )


def image_files(path: Path, manifest: Manifest | LevelManifest) -> list[Path]:
    """List the files of all measurements, each once."""
    return list(dict.fromkeys(file for entry in _entries(path, manifest) for file in entry.files))


def _entries(path: Path, manifest: Manifest | LevelManifest) -> Iterator[Entry]:
    """Give the keys that name files of measurements, with the files."""
    if manifest.dark is not None:
        yield Entry("dark", "", find_files(path, manifest.dark.frames))
    if isinstance(manifest, LevelManifest):
        for name, level in zip(manifest.names, manifest.level, strict=True):
            yield Entry("frames", name, find_files(path, level.frames), "level")
        return
    for exposure in manifest.exposure:
        for key in ("frames", "aperture_before", "aperture_after"):
            entry = getattr(exposure, key)
            if entry is not None:
                yield Entry(key, exposure.name, find_files(path, entry))


def _alike(
    first: list[Path],
    second: list[Path],
    hashes: Mapping[Path, str] | None,
    *,
    within: bool = False,
) -> Iterator[tuple[Path, Path]]:
    """Give the pairs of the same file, or of the same content."""
    seen: dict[object, Path] = {}
    for file in first:
        mark = file.resolve() if hashes is None else hashes[file]
        if within and mark in seen:
            yield seen[mark], file
        seen.setdefault(mark, file)
    if not within:
        for file in second:
            mark = file.resolve() if hashes is None else hashes[file]
            if mark in seen:
                yield seen[mark], file


def _words(one: Path, other: Path) -> str:
    if one == other:
        return f"'{one.name}' stands"
    return f"'{one.name}' and '{other.name}' are the same images, and stand"
