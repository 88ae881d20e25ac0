"""Every kind of file that is read, cut and with flipped bits: named, or harmless."""

from __future__ import annotations

import signal
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
import tifffile
from PIL import Image

import equipix
from equipix import hardware, nuc
from equipix.batch import evaluation
from equipix.correction.correct_files import correct_files
from equipix.errors import EquipixError, FileError
from equipix.experiment.draft import draft_manifest
from equipix.experiment.manifest import kind_of
from equipix.io.frames import header, read_frames
from equipix.io.png import write_png
from equipix.io.tiff import write_frames
from equipix.report.limits import LimitsFile, limits_template, read_limits
from given import write_dng

if TYPE_CHECKING:
    from collections.abc import Callable

SHAPE = (8, 12)

FRAMES = np.random.default_rng(1).integers(0, 4096, (3, *SHAPE), dtype=np.uint16)

STEP, BITS = 64, 999
"""Every 64th byte, and a few more than every 1000th bit, so that all bits of a byte are flipped."""

IN_SHORT = 12
"""Cuts and bits of a file in the default suite."""

SLOW_S = 10


class Kind(NamedTuple):
    """A file: how it is written and read, and whether checksums find every change of its content.

    `layout` stands behind its name; of a folder, `inner` is the file that has faults.
    The beginning of some is a file of the same kind, which holds less: text of people, bare frames.
    """

    write: Callable[[Path], object]
    read: Callable[[Path], Any]
    checksums: bool = False
    open_ended: bool = False
    layout: str = ""
    inner: str = ""


def averages() -> equipix.FrameStatistics:
    return equipix.average(FRAMES.copy(), saturation=4095)


def response() -> equipix.Correction:
    levels = [equipix.average(FRAMES // 8 + level) for level in (500, 1500)]
    return nuc.fit(levels, order=1)


def record(path: Path) -> bytes:
    """All of a result, as the bytes of a file of arrays."""
    found, kept = equipix.load(path), path.parent / "again.npz"
    found.save(kept, force=True)
    return kept.read_bytes()


def table(path: Path) -> bytes:
    found, kept = equipix.load(path), path.parent / "again.bin"
    found.save(kept, force=True)
    return kept.read_bytes()


def frames(path: Path) -> tuple[object, ...]:
    header(path)
    found = read_frames(path)
    return found.dtype, found.shape, found.tobytes()


def several_images(path: Path) -> None:
    from astropy.io import fits

    raw = path.with_name("raw.fits")
    fits.HDUList([fits.PrimaryHDU(FRAMES[0]), *map(fits.ImageHDU, FRAMES[1:])]).writeto(raw)
    flat = equipix.Polynomial(np.ones((2, *SHAPE)), np.zeros(SHAPE, np.uint32))
    correct_files(flat, [str(raw)], path, dtype="uint16")


def hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["entry/data"] = FRAMES


def zarr(path: Path) -> None:
    import zarr

    zarr.create_array(str(path), data=FRAMES, chunks=FRAMES.shape)


def fits_image(path: Path) -> None:
    from astropy.io import fits

    fits.PrimaryHDU(FRAMES).writeto(path)


def packed(path: Path) -> None:
    path.write_bytes(FRAMES.astype("<u2").tobytes())


def row(path: Path) -> object:
    """A row of a batch, or None, with which the sensor is evaluated again."""
    job = evaluation.Job(path.stem, path, path.parent, ".tif", {}, LimitsFile(), False)
    kept = evaluation._kept(job, "a key")
    if kept is None:
        raise FileError(path)
    return kept


def write_row(path: Path) -> None:
    job = evaluation.Job(path.stem, path, path.parent, ".tif", {}, LimitsFile(), False)
    known = {"figures": {"rms": 0.1 + 0.2}, "flagged": [[0.125] * 40], "key": "a key"}
    evaluation._write(job, evaluation.Row(path.stem, str(path), status="done", **known))


def draft(kind: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(draft_manifest(kind, path.parent, path.parent).text)


def tiff_of(**options: Any) -> Callable[[Path], object]:
    given = {"photometric": "minisblack", "metadata": None} | options
    return lambda path: tifffile.imwrite(path, FRAMES, **given)


KINDS = {
    **{
        f"averages{suffix}": Kind(lambda path: averages().save(path), record, checksums=True)
        for suffix in (".tif", ".npz", ".fits", ".nxs", ".asdf")
    },
    **{
        f"table{suffix}": Kind(
            lambda path: hardware.Table.of(response()).save(path), table, checksums=True
        )
        for suffix in (".bin", ".hex", ".h")
    },
    "corrected.tif": Kind(lambda path: write_frames(path, FRAMES, nbytes=FRAMES.nbytes), frames),
    "deflated.tif": Kind(tiff_of(compression="zlib"), frames),
    "lzw.tif": Kind(tiff_of(compression="lzw"), frames),
    "tiled.tif": Kind(tiff_of(tile=(16, 16)), frames),
    "big.tif": Kind(tiff_of(bigtiff=True), frames),
    "series.ome.tif": Kind(tiff_of(metadata={"axes": "TYX"}), frames),
    "corrected.png": Kind(
        lambda path: write_png(path, FRAMES[0], description="corrected by equipix"), frames
    ),
    "one.pgm": Kind(
        lambda path: path.write_bytes(b"P5 12 8 65535\n" + FRAMES[0].astype(">u2").tobytes()),
        frames,
    ),
    "one.bmp": Kind(lambda path: Image.fromarray((FRAMES[0] >> 4).astype("u1")).save(path), frames),
    "array.npy": Kind(lambda path: np.save(path, FRAMES), frames),
    "array.h5": Kind(hdf5, frames),
    "array.zarr": Kind(zarr, frames, inner="c/0/0/0"),
    "named.zarr": Kind(zarr, frames, inner="zarr.json"),
    "image.fits": Kind(fits_image, frames),
    "several.fits": Kind(several_images, frames),
    "bare.raw": Kind(packed, frames, open_ended=True, layout=":8x12:Mono12"),
    "camera.dng": Kind(lambda path: write_dng(path, np.tile(FRAMES[0], (4, 4))), frames),
    "sensor.json": Kind(write_row, row, checksums=True),
    "experiment.toml": Kind(draft("experiment"), kind_of, open_ended=True),
    "levels.toml": Kind(draft("levels"), kind_of, open_ended=True),
    "camera.toml": Kind(draft("camera"), kind_of, open_ended=True),
    "limits.toml": Kind(
        lambda path: path.write_text(limits_template()), read_limits, open_ended=True
    ),
}


def outcome(kind: Kind, path: Path) -> Any:
    """What is read; None where an error names the file. Each other exception fails the test."""

    def late(*_: object) -> None:
        raise AssertionError(f"reading took more than {SLOW_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(SLOW_S)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # as a user may: a warning alone is no answer
            return kind.read(path.with_name(path.name + kind.layout))
    except EquipixError as error:
        assert path.name in str(error), error
        return None
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def some(places: range, count: int | None) -> list[int]:
    if count is None or len(places) <= count:
        return [*places]
    return [places[k] for k in np.linspace(0, len(places) - 1, count).astype(int)]


def check(folder: Path, name: str, count: int | None) -> None:
    kind, path = KINDS[name], folder / name
    kind.write(path)
    changed = path / kind.inner if kind.inner else path
    whole = changed.read_bytes()
    wanted = outcome(kind, path)
    assert wanted is not None
    for length in some(range(0, len(whole), STEP), count):
        changed.write_bytes(whole[:length])
        found = outcome(kind, path)
        assert kind.open_ended or found is None or found == wanted, f"cut at {length}"
    for bit in some(range(0, 8 * len(whole), BITS), count):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        changed.write_bytes(content)
        found = outcome(kind, path)
        assert not kind.checksums or found is None or found == wanted, f"bit {bit} flipped"


@pytest.mark.parametrize("text", ["a = " + "[" * 9999, "exposure = 3", "exposure = [[1], 2]"])
def test_odd_tables_of_a_manifest_are_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text(text)
    with pytest.raises(FileError, match=r"experiment\.toml: "):
        evaluation.described_by(path)


def test_deep_metadata_are_those_of_no_result(tmp_path: Path) -> None:
    path = tmp_path / "deep.npz"
    np.savez(path, metadata="[" * 9999)
    with pytest.raises(FileError, match=r"deep\.npz: holds neither"):
        equipix.load(path)


@pytest.mark.parametrize("name", KINDS)
def test_some_faults_of_a_file_are_named_or_harmless(tmp_path: Path, name: str) -> None:
    check(tmp_path, name, IN_SHORT)


@pytest.mark.long
@pytest.mark.parametrize("name", KINDS)
def test_every_fault_of_a_file_is_named_or_harmless(tmp_path: Path, name: str) -> None:
    check(tmp_path, name, None)
