"""Frames in FITS, NumPy, HDF5, NeXus and Zarr files: like those of images."""

from __future__ import annotations

import warnings

import h5py
import numpy as np
import pytest
import zarr
from astropy.io import fits

import equipix
from equipix.errors import FileError
from equipix.io.frames import frame_format, header, read_frames

FRAMES = np.random.default_rng(1).integers(0, 4000, (5, 8, 9)).astype(np.uint16)


def npy(folder, frames):
    np.save(folder / "a.npy", frames)
    return folder / "a.npy"


def cube(folder, frames):
    fits.writeto(folder / "a.fits", frames)
    return folder / "a.fits"


def extensions(folder, frames):
    units = [fits.PrimaryHDU(), *map(fits.ImageHDU, frames)]
    fits.HDUList(units).writeto(folder / "a.fit")
    return folder / "a.fit"


def hdf5(folder, frames):
    with h5py.File(folder / "a.h5", "w") as file:
        file["entry/data"] = frames
        file["entry/exposure"] = np.arange(3.0)
    return folder / "a.h5"


def named(folder, frames):
    with h5py.File(folder / "b.h5", "w") as file:
        file["entry/data"] = frames
        file["entry/dark"] = np.zeros((2, 3, 4))
    return f"{folder}/b.h5:/entry/data"


def nexus(folder, frames):
    with h5py.File(folder / "a.nxs", "w") as file:
        file.attrs["default"] = "entry"
        entry = file.create_group("entry")
        entry.attrs["default"] = "detector"
        detector = entry.create_group("detector")
        detector.attrs["signal"] = "counts"
        detector["counts"] = frames
        detector["errors"] = np.sqrt(frames)
    return folder / "a.nxs"


def group(folder, frames):
    root = zarr.open_group(str(folder / "a.zarr"), mode="w")
    root.create_array("entry/data", data=frames, chunks=(2, 4, 4))
    return folder / "a.zarr"


def default(folder, name, kind):
    """NeXus of another program, whose attributes have a type of their own."""
    with h5py.File(folder / "a.nxs", "w") as file:
        file.attrs["default"] = kind("entry")
        entry = file.create_group("entry")
        entry.attrs["default"] = kind(f"/{name}")
        file.require_group(name).attrs["signal"] = kind("b")
        entry["a"], file[name]["b"] = FRAMES * 0, FRAMES
        if name == "entry":  # which then is its own default
            del entry.attrs["signal"]
    return folder / "a.nxs"


WRITERS = (npy, cube, extensions, hdf5, named, nexus, group)


@pytest.fixture(params=WRITERS, ids=lambda each: each.__name__)
def write(request):
    return request.param


@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "<f4", "<f8"])
def test_frames_come_back(tmp_path, write, dtype):
    if write is group and dtype == ">u2":
        pytest.skip("zarr writes no big-endian arrays of format 3")
    frames = FRAMES.astype(dtype)
    path = write(tmp_path, frames)
    read = read_frames(path)
    np.testing.assert_array_equal(read, frames)
    assert read.dtype == np.dtype(dtype).newbyteorder("=")
    shape, kind, *_ = header(equipix.io.paths.as_path("frames", path))
    assert (shape, kind) == (frames.shape, read.dtype)


def test_one_frame(tmp_path, write):
    np.testing.assert_array_equal(read_frames(write(tmp_path, FRAMES[:1])), FRAMES[:1])


def test_averages_are_those_of_the_array(tmp_path, write):
    path = write(tmp_path, FRAMES)
    found, wanted = equipix.average(path), equipix.average(FRAMES)
    for name in ("mean", "variance", "count"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_a_part_at_a_time(tmp_path, monkeypatch, write):
    monkeypatch.setattr("equipix.io.arrays._AT_ONCE", 2 * FRAMES[0].nbytes)
    np.testing.assert_array_equal(read_frames(write(tmp_path, FRAMES)), FRAMES)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda folder: named(folder, FRAMES).replace("data", "date"),
            "holds /entry/d.*, /entry/d",
        ),
        (lambda folder: folder / named(folder, FRAMES).rsplit(":")[0], "name one, as in"),
        (lambda folder: npy(folder, np.zeros(3)), "expected numbers of shape"),
        (lambda folder: npy(folder, np.zeros((2, 3), "U1")), "expected numbers of shape"),
        (lambda folder: npy(folder, np.zeros((8, 9, 3))), r"\(8, 9, 3\), as colour images are"),
        (lambda folder: npy(folder, np.zeros((2, 8, 9, 4))), "one grey channel"),
        (lambda folder: npy(folder, FRAMES[:0]), r"of shape \(0, 8, 9\), expected .* 1 or more"),
        (lambda folder: hdf5(folder, FRAMES[:, :0]), r"of shape \(5, 0, 9\), expected"),
        (lambda folder: default(folder, "entry", str), "holds /entry/a, /entry/b: name one"),
        (
            lambda folder: extensions(folder, [FRAMES[0], FRAMES[0, :5]]),
            r"several shapes \(\(8, 9\), \(5, 9\)\)",
        ),
        (lambda folder: folder / "none.fits", "does not exist"),
        (lambda folder: f"{folder}/none.h5:/entry", "does not exist"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, make, words):
    with pytest.raises(FileError, match=words):
        equipix.average(make(tmp_path))


@pytest.mark.parametrize("suffix", [".npy", ".fits", ".h5", ".zarr"])
def test_a_file_that_is_none_is_named(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(b"no such thing" * 100)
    with pytest.raises(FileError, match=rf"a\{suffix}: "):
        equipix.average(tmp_path / f"a{suffix}")


@pytest.mark.parametrize(
    ("write", "library"), [(cube, "astropy.io"), (hdf5, "h5py"), (group, "zarr")]
)
def test_a_missing_library_is_named(tmp_path, monkeypatch, write, library):
    path = write(tmp_path, FRAMES)
    monkeypatch.setitem(__import__("sys").modules, library, None)
    with pytest.raises(equipix.errors.EquipixError, match="which is not installed: pip install"):
        equipix.average(path)


def test_a_saved_result_is_no_frame(tmp_path):
    response = equipix.nuc.fit([FRAMES[0] * 1.0 + 100, FRAMES[0] * 2.0 + 100])
    response.save(tmp_path / "a.fits")
    with pytest.raises(FileError, match="holds a response, expected raw frames"):
        equipix.average(tmp_path / "a.fits")


@pytest.mark.parametrize(
    "kind", [str, np.bytes_, lambda text: np.array([text], h5py.string_dtype())]
)
def test_the_default_of_nexus_is_a_text_of_any_type(tmp_path, kind):
    np.testing.assert_array_equal(read_frames(default(tmp_path, "entry/plot", kind)), FRAMES)


@pytest.mark.parametrize("write", [npy, cube, hdf5, named, group], ids=lambda each: each.__name__)
def test_suffixes_have_any_case(tmp_path, write):
    path = str(write(tmp_path, FRAMES))
    file, _, place = path.partition(":")
    upper = file.removesuffix(suffix := "." + file.rsplit(".")[-1]) + suffix.upper()
    equipix.io.paths.as_path("frames", file).rename(upper)
    np.testing.assert_array_equal(read_frames(f"{upper}:{place}" if place else upper), FRAMES)


def scaled(unit, **options):
    unit.scale("int16", **options)
    return unit


def blank(frames):
    unit = fits.PrimaryHDU(frames.astype(np.int16))
    unit.header["BLANK"] = -1
    return unit


UNITS = {
    "blank": lambda: blank(FRAMES),
    "signed bytes": lambda: fits.PrimaryHDU((FRAMES % 100).astype(np.int8)),
    "scaled": lambda: scaled(fits.PrimaryHDU(FRAMES / 2), bscale=0.5, bzero=100),
    "unsigned": lambda: fits.PrimaryHDU(FRAMES),
    "one frame": lambda: fits.PrimaryHDU(FRAMES[0]),
}


@pytest.mark.parametrize("unit", UNITS)
def test_the_type_of_a_fits_file_is_that_of_its_frames(tmp_path, unit):
    UNITS[unit]().writeto(tmp_path / "a.fits")
    read = read_frames(tmp_path / "a.fits")
    assert frame_format(tmp_path / "a.fits") == (read.shape, read.dtype)
    with fits.open(tmp_path / "a.fits") as units:
        np.testing.assert_array_equal(read, np.reshape(units[0].data, read.shape))


@pytest.mark.parametrize("name", ["a.fits.gz", "a.fits.fz"])
def test_compressed_fits_files_are_read(tmp_path, name):
    pressed = fits.CompImageHDU(FRAMES, compression_type="RICE_1")
    units = [fits.PrimaryHDU(), pressed] if name.endswith("fz") else [fits.PrimaryHDU(FRAMES)]
    fits.HDUList(units).writeto(tmp_path / name)
    np.testing.assert_array_equal(read_frames(tmp_path / name), FRAMES)
    assert frame_format(tmp_path / name) == (FRAMES.shape, FRAMES.dtype)


@pytest.mark.parametrize("name", ["ERR", "DQ", "UNCERT", "mask"])
def test_what_stands_beside_the_frames_of_a_fits_file_is_no_frame(tmp_path, name):
    units = [fits.PrimaryHDU(), fits.ImageHDU(FRAMES[0], name="SCI")]
    fits.HDUList([*units, fits.ImageHDU(FRAMES[1], name=name)]).writeto(tmp_path / "a.fits")
    with pytest.raises(FileError, match=rf"holds {name.upper()} beside its frames, expected fram"):
        equipix.average(tmp_path / "a.fits")


@pytest.mark.parametrize("place", ["", ":/entry/data"])
def test_an_array_in_a_file_is_not_replaced_by_its_average(tmp_path, run, place):
    path = hdf5(tmp_path, FRAMES)
    status, _, told = run("average", f"{path}{place}", "-o", path, "--force")
    assert (status, "one of the inputs" in told) == (1, True)
    np.testing.assert_array_equal(read_frames(path), FRAMES)


def test_only_what_astropy_says_refuses_a_saved_fits_file(tmp_path, monkeypatch):
    """A library that warns of a change to come says nothing of the file."""
    average = equipix.average(FRAMES)
    average.save(tmp_path / "a.fits")
    opened = fits.open

    def warned(*given, **options):
        warnings.warn("soon", DeprecationWarning, stacklevel=1)
        return opened(*given, **options)

    monkeypatch.setattr(fits, "open", warned)
    with pytest.warns(DeprecationWarning, match="soon"):
        assert equipix.load(tmp_path / "a.fits").mean.tobytes() == average.mean.tobytes()
