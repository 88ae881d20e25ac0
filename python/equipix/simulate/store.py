"""A virtual experiment on disk: TIFF files and the manifest that names them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from equipix._types import Progress
from equipix.errors import FileError
from equipix.io import folder_beside, replace_folder, write_frames

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from equipix.simulate.rig import VirtualExperiment


def write_experiment(
    virtual: VirtualExperiment, target: Path, *, force: bool, progress: Progress | None
) -> Path:
    """Write an experiment whole or not at all; see `VirtualExperiment.write`."""
    streams = dict(_streams(virtual))
    frame_bytes = virtual.camera.response.size * (1 if virtual.camera.bit_depth == 8 else 2)
    if target.exists() and not _may_replace(target, force):
        raise FileError(
            f"'{target}' exists and is not empty: name another folder, or force the replacement "
            "of a folder that holds nothing but an experiment written before"
        )
    with folder_beside(target) as folder:
        counter = _Counter(progress, sum(count for _, count in streams.values()))
        for name, (frames, count) in streams.items():
            (folder / name).parent.mkdir(exist_ok=True)
            write_frames(folder / name, counter.pass_on(frames), nbytes=count * frame_bytes)
        np.savez(folder / "truth.npz", **vars(virtual.truth))
        (folder / "experiment.toml").write_text(_manifest(virtual), encoding="utf-8")
        replace_folder(target, folder)
    return target / "experiment.toml"


def _streams(
    virtual: VirtualExperiment,
) -> Iterator[tuple[str, tuple[Iterator[NDArray[Any]], int]]]:
    """Name the files, with the frames of each and their number."""
    yield "dark/dark.tif", (virtual.dark(), virtual.dark_count)
    for k in range(len(virtual.positions)):
        yield f"frames/p{k}.tif", (virtual.frames(k), virtual.count)
    for k in range(1, len(virtual.positions)):
        count = virtual.aperture_count
        yield f"aperture/p{k}-before.tif", (virtual.aperture_before(k), count)
        yield f"aperture/p{k}-after.tif", (virtual.aperture_after(k), count)


def _manifest(virtual: VirtualExperiment) -> str:
    lines = [
        "# calibration experiment of a virtual camera; the truth is in truth.npz",
        "[sensor]",
        'name = "virtual"',
        f"bit_depth = {virtual.camera.bit_depth}",
        "",
        "[dark]",
        'frames = "dark/dark.tif"',
    ]
    for k in range(len(virtual.positions)):
        lines += ["", "[[exposure]]", f'name = "p{k}"', f'frames = "frames/p{k}.tif"']
        if k:
            lines.append(f'aperture_before = "aperture/p{k}-before.tif"')
            lines.append(f'aperture_after = "aperture/p{k}-after.tif"')
    return "\n".join(lines) + "\n"


class _Counter:
    """Reports frames as they pass."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def pass_on(self, frames: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Yield the frames, each reported when it has been dealt with."""
        for frame in frames:
            yield frame
            self._done += 1
            if self._progress is not None:
                self._progress(self._done, self._total, "writing")


def _may_replace(target: Path, force: bool) -> bool:
    """Whether the target is an empty folder, or an experiment that may go."""
    if not target.is_dir():
        return False
    return not any(target.iterdir()) or (force and all(map(_is_ours, target.iterdir())))


def _is_ours(entry: Path) -> bool:
    """Whether an entry of an experiment's folder is one that `write_experiment` makes."""
    if entry.is_symlink():
        return False
    if entry.name in ("frames", "dark", "aperture") and entry.is_dir():
        return all(file.suffix == ".tif" and file.is_file() for file in entry.iterdir())
    return entry.name in ("experiment.toml", "truth.npz") and entry.is_file()
