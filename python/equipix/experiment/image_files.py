"""Formats, repeats and hashes of image files."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from equipix._check import Array
from equipix.errors import FileError
from equipix.experiment.manifest import (
    AnyManifest,
    CameraManifest,
    LevelManifest,
    Manifest,
    entry_files,
    name_of_dark,
)
from equipix.io import binary, camera_raw
from equipix.io.arrays import split
from equipix.io.formats import FrameFile, refuse_saved
from equipix.io.frames import frame_format, stream_frames
from equipix.io.paths import reading
from equipix.measured.colour import Colours
from equipix.measured.statistics import saved_shape


def check_formats(files: Sequence[Path], bit_depth: int | None = None) -> tuple[int, int]:
    """Return the shape (rows, cols) that all files have.

    Raises
    ------
    FileError
        If a file cannot be read, or differs in shape from most, or in depth from the first of them;
        or if whole numbers of its type have fewer bits than the sensor.
    """
    formats = {file: format_of(file) for file in files}
    wanted = Counter(shape for shape, _ in formats.values()).most_common(1)[0][0]
    first = next(file for file, (shape, _) in formats.items() if shape == wanted)
    wanted_dtype = formats[first][1]
    for file, (shape, dtype) in formats.items():
        wanted_dtype = wanted_dtype or dtype
        if shape != wanted or dtype not in (None, wanted_dtype):
            raise FileError(
                f"{file}: holds {dtype or 'averaged'} frames of shape {shape}, expected "
                f"{wanted_dtype or 'averaged'} of shape {wanted} as in {first}"
            )
        bits = _bits(dtype)
        if bits is not None and bit_depth is not None and bit_depth > bits:
            raise FileError(
                f"{file}: holds values of {bits} bits ({dtype}), but 'bit_depth' in [sensor] is "
                f"{bit_depth}: write {bits}, or the bits of these files if they have fewer"
            )
    return wanted


def _bits(dtype: np.dtype[Any] | None) -> int | None:
    """Bits of the largest value of a type of whole numbers; None of others."""
    return (
        None if dtype is None or dtype.kind not in "iu" else int(np.iinfo(dtype).max).bit_length()
    )


def format_of(file: Path) -> tuple[tuple[int, int], np.dtype[Any] | None]:
    """Rows, columns and dtype of the frames of a file; no dtype of frames averaged before."""
    saved = saved_shape(file)
    if saved is not None:
        return saved, None
    (_, rows, cols), dtype = frame_format(file)
    return (rows, cols), dtype


_Manifest = TypeVar("_Manifest", Manifest, LevelManifest, CameraManifest)


def completed(path: Path, manifest: _Manifest) -> _Manifest:
    """Take what a manifest leaves out from its layout, and from raw files of cameras.

    Raises
    ------
    FileError
        If these contradict it or one another, or there is neither a dark nor a black level.
    """
    sensor, files = manifest.sensor, image_files(path, manifest)
    held = {
        file: _sensor_data(file) for file in files if file.suffix.lower() in camera_raw.SUFFIXES
    }
    needs_black = isinstance(manifest, Manifest) and manifest.dark is None
    if needs_black and len(held) < len(files):
        raise FileError(f"{path}: key 'dark' is missing")
    own: dict[str, object] = {}
    if sensor.saturation_level is None and manifest.layout is not None:
        own["bit_depth"] = binary.FORMATS[manifest.layout.pixel]
    elif sensor.saturation is None and held:
        white = min(each.white for each in held.values())
        own["saturation"] = float(min(white, sensor.largest or white))
    given, whence = Colours.of(sensor.cfa), "'cfa' in [sensor]"
    for file, each in held.items():
        found = Colours.of(each.cfa)
        if given is None and found is not None:
            given, whence, own["cfa"] = found, f"'{file.name}'", str(found)
        if given is not None and found is not None and not found.agrees(given):
            raise FileError(
                f"{path}: {whence} holds the colours '{given}', but '{file.name}' '{found}': "
                "correct 'cfa' in [sensor], or name the files of one sensor"
            )
        if needs_black and each.black != held[files[0]].black:
            raise FileError(
                f"{path}: the black levels of '{files[0].name}' and '{file.name}' differ: give "
                "[dark] with dark frames"
            )
    return manifest.model_copy(update={"sensor": sensor.model_copy(update=own)})


def black_level(file: Path) -> tuple[str, Array]:
    """Black level, in DN, that a raw file holds: in words, and of each pixel."""
    _, rows, cols = frame_format(file)[0]
    held = _sensor_data(file)
    levels = [f"{level:g}" for row in held.black for level in row]
    words = levels[0] if len({*levels}) == 1 else ", ".join(levels)
    return words, held.dark((rows, cols))


def _sensor_data(file: Path) -> camera_raw.SensorData:
    with reading(file):
        return camera_raw.sensor_data(file)


Digests = Callable[[list[Path]], Mapping[Path, bytes]]
"""What gives the SHA-256 of each of some files."""


class Entry(NamedTuple):
    """The files of one key of experiment.toml."""

    key: str
    exposure: str
    files: list[Path]
    kind: str = "exposure"

    def __str__(self) -> str:
        """Return the words for a message."""
        return f"'{self.key}' of {self.kind} '{self.exposure}'" if self.exposure else self.kind


def refuse_repeats(
    path: Path, manifest: AnyManifest, hashes: Mapping[Path, str] | None = None
) -> None:
    """Refuse a file that stands for two measurements, by its name or, with `hashes`, its content.

    One image of the aperture may serve for two moves: it is after the one and before the other.
    Dark frames may be equal, as those of a camera that shows 0 in the dark. Those of a camera.toml
    may serve for several exposures.

    Raises
    ------
    FileError
        With the file and where it stands.
    """
    entries = [*entries_of(path, manifest)]
    marks = hashes or _resolved(file for entry in entries for file in entry.files)
    for entry in entries:
        if hashes is None or entry.key != "dark":
            for one, other in _alike(entry.files, entry.files, marks):
                raise FileError(f"{path}: {_words(one, other)} twice in {entry}")
    for first, second in combinations(entries, 2):
        images = "aperture" in first.key and "aperture" in second.key
        darks = first.key == second.key == "dark"
        if images and first.exposure != second.exposure:
            continue
        if darks and (hashes or isinstance(manifest, CameraManifest)):
            continue
        for one, other in _alike(first.files, second.files, marks):
            raise FileError(
                f"{path}: {_words(one, other)} in {first} and in {second}: give each its own frames"
            )


def refuse_repeated_files(
    frames: list[Path], dark: list[Path], digests: Digests | None = None
) -> dict[Path, str]:
    """Refuse a file that is averaged twice, or as its own dark; return the hashes of all.

    A file is the same by its name or its content. `digests` is as for `sha256_of`.

    Raises
    ------
    FileError
        With the file and where it stands.
    """
    found = sha256_of([*frames, *dark], digests)
    for marks in (_resolved([*frames, *dark]), found):
        for one, other in _alike(frames, frames, marks):
            raise FileError(f"{_words(one, other)} twice in the frames: give each once")
        for one, other in _alike(frames, dark, marks):
            raise FileError(
                f"{_words(one, other)} in the frames and in 'dark': give each its own frames"
            )
    return found


def refuse_other_types(path: Path, manifest: AnyManifest) -> None:
    """Refuse FITS files whose headers say that they hold other images than their key wants.

    An exposure has light, and so has an image of a hole. A level may have none.

    Raises
    ------
    FileError
        With the file, its header and where it stands.
    """
    for entry in entries_of(path, manifest):
        if entry.key == "dark":
            refused, wanted = ["light"], "dark frames"
        elif isinstance(manifest, Manifest):
            refused, wanted = ["dark", "bias"], "frames with light"
        else:
            continue
        for file in map(FrameFile, entry.files):
            if file.image_type.kind in refused:
                raise FileError(
                    f"{path}: '{file.path.name}' in {entry} is {file.image_type}, expected "
                    f"{wanted}: name them instead, or correct the header"
                )


def image_files(path: Path, manifest: AnyManifest) -> list[Path]:
    """List the files of all measurements, each once."""
    return list(dict.fromkeys(file for entry in entries_of(path, manifest) for file in entry.files))


def entries_of(path: Path, manifest: AnyManifest) -> Iterator[Entry]:
    """Give the keys that name files of measurements, with the files."""
    layout = manifest.layout
    if isinstance(manifest, CameraManifest):
        for name, each in manifest.series:
            kind = "table" if each is manifest.spatial else "exposure"
            yield Entry("frames", name, entry_files(path, each.frames, layout), kind)
            yield Entry("dark", name, entry_files(path, each.dark, layout), kind)
        return
    darks = manifest.dark or []
    for index, dark in enumerate(darks):
        called = name_of_dark(index, len(darks))
        yield Entry("dark", "", entry_files(path, dark.frames, layout), called)
    if isinstance(manifest, LevelManifest):
        for name, level in zip(manifest.names, manifest.level, strict=True):
            yield Entry("frames", name, entry_files(path, level.frames, layout), "level")
        return
    for exposure in manifest.exposure:
        for key in ("frames", "aperture_before", "aperture_after"):
            entry = getattr(exposure, key)
            if entry is not None:
                yield Entry(key, exposure.name, entry_files(path, entry, layout))


def _resolved(files: Iterable[Path]) -> dict[Path, Path]:
    """Places of files, whatever their names."""
    return {file: file.resolve() for file in files}


def _alike(
    first: list[Path], second: list[Path], marks: Mapping[Path, object]
) -> Iterator[tuple[Path, Path]]:
    """Give the pairs of files with the same mark; within a list if both are one."""
    seen = {} if second is first else {marks[file]: file for file in reversed(first)}
    for file in second:
        if marks[file] in seen:
            yield seen[marks[file]], file
        if second is first:
            seen.setdefault(marks[file], file)


def _words(one: Path, other: Path) -> str:
    if one == other:
        return f"'{one.name}' stands"
    return f"'{one.name}' and '{other.name}' are the same images, and stand"


def raw_frames(files: Sequence[Path]) -> Iterator[Array]:
    """Frames as the camera gave them, some at a time; files that equipix has saved are refused."""
    for file in files:
        refuse_saved(file)
    return (frames for _, frames in stream_frames(files))


def sha256_of(files: Iterable[Path], digests: Digests | None = None) -> dict[Path, str]:
    """Hashes of the content of files; `digests` hashes many plain files, such as on a cluster."""
    parts = {file: _parts(split(file)[0]) for file in files}
    found = None if digests is None else digests([part for each in parts.values() for part in each])
    digest_of = digest if found is None else found.__getitem__
    with ThreadPoolExecutor() as pool:  # hashlib releases the GIL
        hashes = pool.map(partial(_sha256, digest_of=digest_of), parts, parts.values())
        return dict(zip(parts, hashes, strict=True))


def marks_of_levels(hashes: Mapping[Path, str]) -> dict[Path, str]:
    """Hashes of files by which levels of light must differ; the name of one that may be equal.

    Images in saturation are equal, and without light those of a camera that shows 0: half of their
    values or more are the smallest or the largest.
    """
    counts = Counter(hashes.values())
    repeated = {file: each for file, each in hashes.items() if counts[each] > 1}
    uniform: dict[str, bool] = {}
    for file, each in repeated.items():
        if each not in uniform:
            uniform[each] = saved_shape(file) is None and _is_uniform(file)
    return {
        file: str(file.resolve()) if uniform.get(each) else each for file, each in hashes.items()
    }


def _is_uniform(file: Path) -> bool:
    """Whether half of the values of the first frame are its smallest, or its largest."""
    _, frames = next(stream_frames(file))
    return bool(np.median(frames[0]) in (frames[0].min(), frames[0].max()))


def with_inputs(metadata: dict[str, Any], hashes: Mapping[Path, str]) -> dict[str, Any]:
    """Metadata with the hashes of files, beside those that they hold."""
    named = {str(file): each for file, each in hashes.items()}
    return {**metadata, "inputs": metadata.get("inputs", {}) | named}


def _sha256(path: Path, parts: list[Path], digest_of: Callable[[Path], bytes]) -> str:
    """Hash of a file; of an array in one the place counts too, of a folder all its parts."""
    file, place = split(path)
    if not place and file.is_file():
        return digest_of(file).hex()
    found = hashlib.sha256(place.encode())
    for part in parts:
        found.update(str(part.relative_to(file)).encode() + digest_of(part))
    return found.hexdigest()


def _parts(file: Path) -> list[Path]:
    """Files of a folder, or the file itself."""
    return [part for part in sorted(file.rglob("*")) if part.is_file()] if file.is_dir() else [file]


def digest(file: Path) -> bytes:
    """SHA-256 of the bytes of a file."""
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").digest()
    except OSError as error:
        raise FileError(f"{file}: cannot be read: {error.strerror}") from error


State = tuple[int, int]
"""Size of a file, and time of its last change in nanoseconds."""


def refuse_changed(states: Mapping[Path, State | None]) -> None:
    """Refuse a file whose state is no longer that of before.

    Raises
    ------
    FileError
        With the first such file.
    """
    for file, state in states.items():
        if state_of(file) != state:
            raise FileError(f"{file}: has changed meanwhile: begin again")


def state_of(file: Path) -> State | None:
    """State of a file, of a folder that of all files in it; None where there is none."""
    try:
        states = [part.stat() for part in _parts(split(file)[0])]
        return sum(each.st_size for each in states), max(
            (each.st_mtime_ns for each in states), default=0
        )
    except OSError:
        return None


def origin_of(correction: Path) -> str:
    """Name a correction by the hash of its file, as corrected frames do."""
    return f"correction sha256 {sha256_of([correction])[correction]}"
