"""Frames that a camera writes to a folder, taken into running averages."""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from glob import has_magic
from pathlib import Path
from typing import Any

import numpy as np

from equipix.errors import EquipixError, FileError
from equipix.experiment.described import excluded_pixels
from equipix.experiment.image_files import State, sha256_of, state_of
from equipix.experiment.manifest import Exposure, Manifest, read_manifest
from equipix.exposures.positions import check_reach
from equipix.findings import Finding
from equipix.io.arrivals import wait_for_change
from equipix.io.frames import stream_frames
from equipix.io.paths import find_files
from equipix.live.running import Running, place_of
from equipix.measured.statistics import saved_shape

_SETTLED = 0.4
"""Seconds for which a file must not have changed before it is read: a camera writes on."""

_LOOK, _AT_ONCE = 2.0, 5.0
"""Most seconds between two looks at the folder, and between two estimates while frames arrive."""

_GIVEN_UP = 5.0
"""Seconds without a change after which a file that cannot be read is reported. It is tried again
when it changes."""

_Format = tuple[tuple[int, ...], np.dtype[Any]]
"""Rows and columns of frames, and their type."""

_KEYS = ("aperture_before", "flux", "flux_std", "time", "shift_std")
"""Keys of an exposure that a live estimate does not take."""


@dataclass
class WatchedFolder:
    """A folder with an experiment.toml, whose frames arrive while it is watched.

    Nothing but the files is kept: after the end of the process, whatever its reason, the same files
    give the same averages again.

    Attributes
    ----------
    folder : Path
        The folder that is watched.
    path : Path
        The experiment.toml, which gives positions and dark frames. It is read again when it
        changes.
    workers : int or None
        Number of threads.
    """

    folder: Path
    path: Path
    workers: int | None = None
    _manifest: Manifest | None = None
    _state: State | None = None
    _running: Running | None = None
    _begun: int = 0
    _wanted: _Format | None = None
    _taken: dict[Path, State] = field(default_factory=dict)
    _shapes: dict[Path, _Format] = field(default_factory=dict)
    _seen: dict[Path, tuple[State, float]] = field(default_factory=dict)
    _refused: dict[Path, State] = field(default_factory=dict)
    _contents: dict[str, tuple[tuple[int, Path], tuple[float, float] | None]] = field(
        default_factory=dict
    )
    _reported: set[tuple[Path, str]] = field(default_factory=set)

    @property
    def running(self) -> Running | None:
        """The averages so far; None before the first frame."""
        return self._running

    @property
    def names(self) -> dict[tuple[float, float], str]:
        """Name of each position."""
        exposures = [] if self._manifest is None else self._manifest.exposure
        return {_place(each): each.name for each in reversed(exposures)}

    def changes(self) -> Iterator[list[Finding]]:
        """Give, whenever frames have arrived and the folder is quiet, which files are not used.

        It never ends by itself. While frames go on arriving it gives every few seconds.
        """
        told, fresh, found = time.monotonic(), False, list[Finding]()
        while True:
            new, waiting, more = self.look()
            fresh, found = fresh or new, found + more
            if (fresh or found) and (not waiting or time.monotonic() - told > _AT_ONCE):
                yield found
                told, fresh, found = time.monotonic(), False, []
                continue  # an estimate takes long enough for files to have settled
            if waiting:
                time.sleep(_SETTLED / 2)
            else:
                wait_for_change(self.folder, _LOOK)

    def look(self) -> tuple[bool, bool, list[Finding]]:
        """Take the frames of files that are complete.

        Returns
        -------
        new : bool
            Whether the averages have changed.
        waiting : bool
            Whether a file is still being written.
        findings : list of Finding
            Files that are not used, each once for each reason.
        """
        told = self._read_manifest()
        files, waiting = self._files(), False
        new, begun = self._forget_changed(files), self._begun
        refused: list[tuple[Path, str]] = []
        for file in sorted(files, key=lambda each: _order(each, files[each][1])):
            position, state = files[file]
            if state in (self._taken.get(file), self._refused.get(file)):
                continue
            age = self._age(file, state)
            if age < _SETTLED:
                waiting = True
                continue
            try:
                kind = _format_of(file)
                if state_of(file) == state:
                    self._take(file, state, position, kind)
                    self._taken[file], new = state, True
            except EquipixError as error:
                # A file that is half written now is whole later.
                if age >= _GIVEN_UP:
                    self._refused[file] = state
                    refused.append((file, str(error)))
        if self._begun > begun:  # all anew: others count than those that were taken first
            self._refused.clear()
            _, waiting, found = self.look()
            return True, waiting, told + found
        for each in refused:
            told += self._finding(*each)
        return new, waiting, told

    def _age(self, file: Path, state: State) -> float:
        """Seconds for which a file has not changed: clocks of two machines differ by some."""
        by_its_clock = time.time() - state[1] / 1e9
        if by_its_clock > _GIVEN_UP:
            return by_its_clock
        if self._seen.get(file, (None,))[0] != state:
            self._seen[file] = state, time.monotonic()
        return time.monotonic() - self._seen[file][1]

    def _take(
        self, file: Path, state: State, position: tuple[float, float] | None, kind: _Format
    ) -> None:
        """Add the frames of a file; refuse them if most files have another format."""
        self._shapes[file] = kind
        wanted = Counter(self._shapes.values()).most_common(1)[0][0]
        if self._running is not None and self._wanted != wanted:
            self._begin_again()
        if kind != wanted:
            raise FileError(
                f"{file}: holds {kind[1]} frames of shape {kind[0]}, expected {wanted[1]} of shape "
                f"{wanted[0]} as most files: use a copy, or take the frames again"
            )
        if position is not None:
            check_reach(f"{file}: 'shift'", np.array(position), kind[0])
        # Of copies the oldest counts, whichever is seen first: so it is for a new process too.
        content, order = sha256_of([file])[file], _order(file, state)
        first, its = self._contents.get(content, (order, position))
        if (position, its) != (None, None):  # a camera may show 0 in the dark
            if order < first:
                self._begin_again()
            elif order > first:
                raise FileError(
                    f"{file}: is a copy of '{first[1]}', which counts, expected frames of its own: "
                    "take them again, or remove one of the files"
                )
        running, added = self._begin(kind[0]) if self._running is None else self._running, False
        try:
            for _, frames in stream_frames([file]):
                running.add(frames, position)
                added = True
        except EquipixError:
            if added:
                refused = self._refused  # by what they hold
                self._forget()
                self._refused = refused
            raise
        self._running, self._wanted = running, wanted
        self._contents.setdefault(content, (order, position))

    def _begin(self, shape: tuple[int, ...]) -> Running:
        assert self._manifest is not None
        sensor, (rows, cols) = self._manifest.sensor, shape
        return Running(
            (rows, cols),
            saturation=sensor.saturation_level,
            mask=excluded_pixels(self.path, self._manifest, (rows, cols)),
            cfa=sensor.cfa,
            workers=self.workers,
        )

    def _begin_again(self) -> None:
        """Read all files once more, in their order."""
        self._forget()
        self._begun += 1

    def _forget(self) -> None:
        """Begin anew: sums do not give back what was added."""
        self._running, self._taken, self._refused, self._contents = None, {}, {}, {}

    def _forget_changed(self, files: dict[Path, tuple[Any, State]]) -> bool:
        """Begin anew where a file that was taken has changed or is gone."""
        now = {file: state for file, (_, state) in files.items()}
        changed = [file for file, was in self._taken.items() if now.get(file) != was]
        for file in {*changed, *self._shapes.keys() - now.keys()}:
            self._shapes.pop(file, None)
        if changed:
            self._forget()
        return bool(changed)

    def _finding(self, file: Path, message: str) -> list[Finding]:
        """Say once why a file is not used."""
        if (file, message) in self._reported:
            return []
        self._reported.add((file, message))
        return [Finding("unused", message, "input")]

    def _read_manifest(self) -> list[Finding]:
        """Read the experiment.toml where it is new or has changed, and begin anew.

        One that is just being edited is a finding: that of before counts until it can be read.
        """
        state = state_of(self.path)
        if self._manifest is not None and state == self._state:
            return []
        try:
            manifest = read_manifest(self.path, Manifest)
            _refuse_more(self.path, manifest)
        except EquipixError as error:
            if self._manifest is None:
                raise
            self._state = state
            return self._finding(self.path, str(error))
        if self._manifest is not None:
            self._forget()
        self._manifest, self._state = manifest, state
        return []

    def _files(self) -> dict[Path, tuple[tuple[float, float] | None, State]]:
        """Files that are there, with the position of their exposure, or None of dark frames."""
        manifest = self._manifest
        assert manifest is not None
        assert manifest.dark is not None
        named: list[tuple[str | list[str], tuple[float, float] | None]]
        named = [(each.frames, None) for each in manifest.dark]
        named += [(each.frames, _place(each)) for each in manifest.exposure]
        found: dict[Path, tuple[tuple[float, float] | None, State]] = {}
        for entry, position in named:
            for name in [entry] if isinstance(entry, str) else entry:
                for file in _existing(name, self.path.parent):
                    state = state_of(file)
                    if state is None:
                        continue
                    if found.get(file, (position,))[0] != position:
                        raise FileError(f"{self.path}: names '{file.name}' for two positions")
                    path = file if manifest.layout is None else manifest.layout.behind(file)
                    found[path] = position, state
        return found


def _place(exposure: Exposure) -> tuple[float, float]:
    """Position of an exposure; the origin unless it is given."""
    return place_of(exposure.shift or (0.0, 0.0))


def _order(file: Path, state: State) -> tuple[int, Path]:
    """Files are read in this order: the oldest first."""
    return state[1], file


def _existing(name: str, folder: Path) -> list[Path]:
    try:
        return find_files(name, folder=folder)
    except FileError:
        if (folder / name).is_dir() and not has_magic(name):
            raise
        return []  # not written yet


def _format_of(file: Path) -> _Format:
    """Shape and type of the frames of a file. All are read first: the last may be missing."""
    if saved_shape(file) is not None:
        raise FileError(f"{file}: holds averaged frames, expected frames of the camera")
    formats = {(frames.shape[1:], frames.dtype) for _, frames in stream_frames([file])}
    return formats.pop()


def _refuse_more(path: Path, manifest: Manifest) -> None:
    """Refuse what a live estimate does not take."""
    if manifest.dark is None or len(manifest.dark) > 1:
        raise FileError(f"{path}: equipix watch takes one table [dark], expected just one")
    for number, each in enumerate(manifest.exposure, start=1):
        given = [key for key in _KEYS if getattr(each, key) is not None]
        given += ["rotation"] if each.rotation else []
        if given:
            raise FileError(
                f"{path}: '{given[0]}' in [[exposure]] {number} ('{each.name}') is not for equipix "
                "watch: give 'shift' alone, and use equipix calibrate with it at the end"
            )
        if each.shift is None and number > 1:
            raise FileError(f"{path}: [[exposure]] {number} ('{each.name}') needs 'shift'")
