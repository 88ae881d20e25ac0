"""Every kind of result as a file: each bit comes back, and every change of one is noticed."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import zlib
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import ccdproc
import imageio.v2
import imageio.v3
import numpy as np
import pytest
import skimage.io
import tifffile
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from PIL import Image

import equipix
from equipix import Flag, bolometer, hardware, lens, nuc, simulate
from equipix._check import Array
from equipix.errors import EquipixError, FileError, InputError, InputWarning
from equipix.exposures.positions import Orientation
from equipix.findings import Finding, usable
from equipix.io.formats import load_pages, refuse_saved, save_pages
from equipix.io.record import UNSAVED, Map, Record, read_record
from equipix.saved_results import RECORDS
from equipix.scene.methods import METHODS
from equipix.scene.scene_correction import SceneState
from given import learned
from records import rewrite

with np.printoptions():  # nexusformat sets those of the whole process
    from nexusformat.nexus import nxload

SHAPE = (24, 32)
SUFFIXES = (".tif", ".npz", ".fits", ".nxs", ".asdf")


def measured(level, count=6, seed=0):
    rng = np.random.default_rng([seed, int(level)])
    return np.rint(50 + level + np.sqrt(level + 4) * rng.standard_normal((count, *SHAPE))).astype(
        np.uint16
    )


def calibration(**options):
    shifts = equipix.cross_pattern(3, 5) + 0.25 * np.eye(5, 2)
    truth = simulate.paper_sensitivity(SHAPE, rng=1)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE, width=60), shifts)
    frames += 1e-3 * np.random.default_rng(2).standard_normal(frames.shape)
    return equipix.calibrate(frames, shifts, tolerance=1e-3, **options)


def made():
    """Results of all kinds."""
    dark = equipix.average(measured(0), saturation=4095)
    levels = [equipix.average(measured(level), dark=dark) for level in (500, 1500, 3000)]
    response = nuc.fit(levels, order=2)
    states = np.arange(4.0) * 10
    shutter = [500 + 3 * state + measured(100, seed=4)[0] / 50 for state in states]
    odd = dataclasses.replace(
        calibration(cfa="RGGB"),
        colour_response={"R": float("nan"), "G": 1.0, "B": float("inf")},
        tilt_std=np.array([np.inf, 0.1]),
        findings=(
            Finding("sign", "what, value, limit, remedy", "misfit"),
            Finding("drift", "é", "input", "note"),
        ),
    )
    first = calibration(shift_std=0.01, robust=True, uncertainty=True)
    turned = dataclasses.replace(first.orientation, hidden=Orientation(rows=True), ratio=None)
    return {
        "calibration": dataclasses.replace(first, orientation=turned),
        "calibration in colours": odd,
        "response": response,
        "averages": levels[0],
        "averages without a dark": equipix.average(measured(9).astype(np.float64), reject=None),
        "polynomial": equipix.combine(response, nuc.fit([each.mean for each in levels], order=1)),
        "dynamic": bolometer.fit(shutter, states, 2.0, order=1),
    }


KINDS = made()


def differences(one, other, name=""):
    """The parts in which two results differ, to the last bit."""
    if type(one) is not type(other):
        return [name]
    if isinstance(one, np.ndarray):
        same = (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
        return [] if same else [name]
    if dataclasses.is_dataclass(one):
        one, other = ({at: getattr(each, at) for at in stored(each)} for each in (one, other))
    if isinstance(one, dict) and one.keys() == other.keys():
        return [at for key in one for at in differences(one[key], other[key], f"{name}.{key}")]
    if isinstance(one, tuple) and len(one) == len(other):
        return [at for pair in zip(one, other, strict=True) for at in differences(*pair, name)]
    return [] if one == other or (one != one and other != other) else [name]


def stored(instance):
    return [each.name for each in dataclasses.fields(instance) if each.metadata != UNSAVED]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", KINDS)
def test_every_kind_comes_back_bit_by_bit(tmp_path, name, suffix):
    path = tmp_path / f"a{suffix}"
    KINDS[name].save(path)
    assert differences(KINDS[name], equipix.load(path)) == []
    # No time of writing: the same result gives the same file.
    whole = path.read_bytes()
    equipix.load(path).save(path, force=True)
    assert path.read_bytes() == whole


@pytest.mark.parametrize("name", [*KINDS, "lens", "state", "scene"])
def test_every_kind_states_versions_and_the_time(name):
    squared = ((np.indices(SHAPE) - 12.0) ** 2).sum(axis=0)
    others = {
        "lens": lambda: lens.fit(1000 / (1 + squared / 30.0**2) ** 2).correction(),
        "state": lambda: KINDS["dynamic"].correction(10.0),
        "scene": lambda: learned("gated", SHAPE).correction(),
    }
    found = others[name]().metadata if name in others else KINDS[name].metadata
    assert found["versions"] == {"equipix": equipix.__version__, "numpy": np.__version__}
    finished = datetime.fromisoformat(found["finished"])
    assert finished <= datetime.now(UTC)
    if name not in ("polynomial", "lens", "scene"):  # of those nothing is known of the start
        assert datetime.fromisoformat(found["started"]) <= finished
        assert found["options"]


def skimage_read(path):
    return skimage.io.imread(path)


def pillow(path):
    with Image.open(path) as opened:
        assert opened.n_frames == 1
        return np.asarray(opened)


def imagej(path):
    """Debian's ImageJ, on a display that nobody sees."""
    if not (shutil.which("imagej") and shutil.which("xvfb-run")):
        left_out = pytest.fail if os.environ.get("CI") else pytest.skip
        left_out("no imagej, or no xvfb-run: apt-get install imagej xvfb xauth")
    macro = path.with_suffix(".ijm")
    macro.write_text(
        f'setBatchMode(true); open("{path}"); print(nImages, nSlices, bitDepth());'
        "for (y = 0; y < getHeight(); y++) { line = '';"
        "for (x = 0; x < getWidth(); x++) line += d2s(getPixel(x, y), -9) + ' '; print(line); }"
    )
    command = ["xvfb-run", "-a", "imagej", "-b", macro]
    # Its status is 1 after any macro.
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    lines = done.stdout.splitlines()
    assert "1 1 32" in lines, done.stderr
    rows = lines[lines.index("1 1 32") + 1 :]
    return np.array([row.split() for row in rows if row], float).astype(np.float32)


@pytest.mark.parametrize(
    "read", [tifffile.imread, imageio.v2.imread, imageio.v3.imread, skimage_read, pillow, imagej]
)
@pytest.mark.parametrize("name", KINDS)
def test_other_programs_show_one_grey_image(tmp_path, name, read):
    if read is imagej and name not in ("calibration", "averages"):
        pytest.skip("a second each: one of 1 and one of DN")
    path = tmp_path / "a.tif"
    KINDS[name].save(path)
    image = read(path)
    assert image.dtype == np.float32
    assert np.isfinite(image).all()
    np.testing.assert_array_equal(image, KINDS[name].viewed().image.astype(np.float32))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", KINDS)
def test_a_saved_result_is_no_raw_frame(tmp_path, name, suffix):
    path, words = tmp_path / f"a{suffix}", f"holds .*{KINDS[name].KIND}, expected raw frames"
    KINDS[name].save(path)
    with pytest.raises(FileError, match=words):
        refuse_saved(path)
    if isinstance(KINDS[name], equipix.FrameStatistics):
        assert differences(KINDS[name], equipix.average(path)) == []
    else:
        with pytest.raises(FileError, match=words):
            equipix.average(path)


@pytest.mark.parametrize("name", ["calibration", "response"])
def test_astronomers_read_fits_without_arguments(tmp_path, name):
    result, path = KINDS[name], tmp_path / "a.fits"
    result.save(path)
    flat = CCDData.read(path)
    assert flat.unit.is_equivalent("")
    np.testing.assert_array_equal(flat.mask, ~usable(result.flags))
    assert np.isfinite(flat.data).all()
    assert (flat.data[flat.mask] == 1).all()
    with fits.open(path, checksum=True) as units:
        assert {"MASK", "FLAGS"} <= {unit.name for unit in units}
        assert all({"CHECKSUM", "DATASUM"} <= set(unit.header) for unit in units)
    if name == "calibration":
        assert isinstance(flat.uncertainty, StdDevUncertainty)
        np.testing.assert_array_equal(flat.uncertainty.array, result.viewed().std)
        np.testing.assert_array_equal(fits.getdata(path, "SENSITIVITY"), result.sensitivity)
        np.testing.assert_array_equal(fits.getdata(path, "BEAM"), result.beam)
        # Of a frame less its dark ccdproc gives what this package does.
        frame = np.random.default_rng(1).uniform(100, 200, SHAPE)
        found = ccdproc.flat_correct(CCDData(frame, unit="adu"), flat, norm_value=1)
        wanted = result.correct(frame, dark=None)
        valid = np.isfinite(wanted)
        assert valid.sum() > 0.9 * valid.size
        np.testing.assert_allclose(found.data[valid], wanted[valid], rtol=1e-14)


@pytest.mark.parametrize("name", KINDS)
def test_nexus_holds_a_flat_field(tmp_path, name):
    result, path = KINDS[name], tmp_path / "a.nxs"
    result.save(path)
    root = nxload(path)
    detector, viewed = root.entry.instrument.detector, result.viewed()
    if isinstance(result, equipix.FrameStatistics):
        np.testing.assert_array_equal(detector.data.nxdata, result.mean)
        np.testing.assert_array_equal(root.entry["data"].nxerrors.nxdata, viewed.std)
        return
    flat = detector.flatfield.nxdata
    inverse = viewed.image if name.startswith("calibration") else 1 / viewed.image
    np.testing.assert_array_equal(flat, inverse)
    np.testing.assert_array_equal(root.entry["data"].nxsignal.nxdata, flat)
    assert not detector.flatfield_applied.nxdata
    bits, flags = detector.pixel_mask.nxdata, result.flags
    np.testing.assert_array_equal(bits != 0, viewed.mask)
    np.testing.assert_array_equal((bits & 2) != 0, viewed.mask & ((flags & Flag.DEAD) != 0))
    assert ((bits & 0xFFFF) == bits).all()
    if viewed.std is not None:
        np.testing.assert_array_equal(detector.flatfield_errors.nxdata, viewed.std)


def test_pixel_masks_have_the_bits_of_nexus(tmp_path):
    flags = np.array([[0, Flag.SATURATED, Flag.DEAD, Flag.HOT, Flag.TELEGRAPH, Flag.NONLINEAR]])
    flags = (flags | np.where(flags > Flag.SATURATED, Flag.DO_NOT_USE, 0)).astype(np.uint32)
    equipix.Polynomial(np.ones((2, 1, 6)), flags).save(tmp_path / "a.nxs")
    mask = nxload(tmp_path / "a.nxs").entry.instrument.detector.pixel_mask.nxdata
    assert mask.tolist() == [[0, 0, 1 << 1, 1 << 3, 1 << 4, 1 << 8]]


@pytest.mark.parametrize("use", [None, "flat", "gain"])
@pytest.mark.parametrize("mean_one", [False, True])
@pytest.mark.parametrize("name", ["calibration", "calibration in colours", "response"])
def test_a_map_for_either_use(tmp_path, name, mean_one, use):
    result, path = KINDS[name], tmp_path / "a.fits"
    own = "flat" if name.startswith("calibration") else "gain"
    use_is = use or own
    result.save(path, use=use, mean_one=mean_one)
    assert differences(result, equipix.load(path)) == []
    found, read = result.to_ccddata(use=use, mean_one=mean_one), CCDData.read(path)
    assert read.header["MAP"] == ("sensitivity" if use_is == "flat" else "gain")
    for one in (found, read):
        np.testing.assert_array_equal(one.data, read.data)
        np.testing.assert_array_equal(one.mask, ~usable(result.flags))
        assert one.unit.is_equivalent("")
    viewed, good = result.viewed(), ~found.mask
    wanted = viewed.image if use_is == own else 1 / viewed.image
    wanted = wanted / wanted[good].mean() if mean_one else wanted
    np.testing.assert_allclose(found.data[good], wanted[good], rtol=1e-6)
    assert (found.data[~good] == 1).all()
    if mean_one:
        assert found.data[good].mean() == pytest.approx(1, abs=1e-6)
    if viewed.std is not None:
        relative = found.uncertainty.array[good] / found.data[good]
        np.testing.assert_allclose(relative, (viewed.std / viewed.image)[good], rtol=1e-6)
    table = result.to_xarray(use=use, mean_one=mean_one)
    assert dict(table.sizes) == dict(zip(("row", "col"), SHAPE, strict=True))
    values = table["sensitivity" if use_is == "flat" else "gain"]
    assert values.attrs["units"] == "1"
    np.testing.assert_array_equal(values, np.where(good, found.data, np.nan))
    np.testing.assert_array_equal(table["flags"], result.flags)
    assert len(table["flags"].attrs["flag_masks"]) == len([*Flag])
    assert ("std" in table) == (viewed.std is not None)


def test_a_mean_of_frames_has_one_use():
    frames = KINDS["averages"]
    assert frames.to_xarray()["mean"].attrs["units"] == "DN"
    assert str(frames.to_ccddata().unit) == "adu"
    for options in ({"use": "gain"}, {"mean_one": True}):
        with pytest.raises(InputError, match="is a mean of frames, neither a flat nor a gain"):
            frames.to_xarray(**options)
    with pytest.raises(InputError, match="'use' is 'sum', expected 'flat', 'gain' or None"):
        KINDS["response"].to_xarray(use="sum")
    with pytest.raises(InputError, match=r"no map for other programs; its correction\(\) has one"):
        learned("gated", SHAPE).to_ccddata()


@pytest.mark.parametrize("library", ["xarray", "asdf"])
def test_a_missing_library_is_named(tmp_path, monkeypatch, library):
    monkeypatch.setitem(__import__("sys").modules, library, None)
    calls = {
        "asdf": lambda result: result.save(tmp_path / "a.asdf"),
        "xarray": lambda result: result.to_xarray(),
    }
    with pytest.raises(EquipixError, match=f"need {library}, which is not .*equipix.{library}"):
        calls[library](KINDS["response"])


@pytest.mark.parametrize("name", [*KINDS, "state"])
def test_convert_loses_nothing_on_any_way(tmp_path, run, name):
    (learned("gated", SHAPE) if name == "state" else KINDS[name]).save(tmp_path / "0.npz")
    files = [tmp_path / f"{k}{suffix}" for k, suffix in enumerate([".npz", *SUFFIXES, ".npz"])]
    for one, other in pairwise(files):
        assert run("convert", one, other)[0] == 0
    assert files[0].read_bytes() == files[-1].read_bytes()


def test_convert_writes_the_map_that_is_asked_for(tmp_path, run):
    path, table = tmp_path / "a.npz", tmp_path / "a.hex"
    KINDS["calibration"].save(path)
    assert run("convert", path, tmp_path / "a.tif", "--as", "gain", "--mean-one")[0] == 0
    wanted = KINDS["calibration"].viewed().exported("gain", mean_one=True).image
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "a.tif"), wanted.astype(np.float32))
    table_of_lines().save(table)
    assert run("convert", table, tmp_path / "b.bin")[0] == 0
    assert differences(*map(equipix.load, (table, tmp_path / "b.bin"))) == []
    for source, target, option, words in (
        (
            path,
            "b.nxs",
            "gain",
            "b.nxs: a NeXus file holds a flat to divide by, expected --as flat",
        ),
        (path, "b.npz", "flat", "holds no copy for other programs: leave out --as and --mean-one"),
        (table, "c.bin", "flat", "a.hex: holds no map for --as or --mean-one: leave them out"),
    ):
        status, _, said = run("convert", source, tmp_path / target, "--as", option)
        assert status == 1
        assert words in said
        assert not (tmp_path / target).exists()


TYPES = st.sampled_from(["u1", "u2", "u4", "u8", "i2", "i4", "i8", "f4", "f8"])
IMAGES = TYPES.flatmap(
    lambda dtype: arrays(dtype, array_shapes(min_dims=2, max_dims=3, min_side=1, max_side=4))
)
TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)
JSON = st.dictionaries(TEXTS, st.integers() | st.floats(allow_nan=False) | TEXTS | st.none())
NAMES = st.from_regex(r"[a-z][a-z_0-9.]{0,9}[a-z]", fullmatch=True)


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=30, deadline=None)
@given(
    pages=st.dictionaries(NAMES, IMAGES, min_size=1, max_size=4),
    text=JSON.filter(lambda text: "crc32" not in text),  # the key of the checksum
    shown=st.booleans(),
)
def test_any_arrays_and_any_text_come_back(tmp_path_factory, suffix, pages, text, shown):
    path = tmp_path_factory.mktemp("any") / f"a{suffix}"
    viewed = KINDS["response"].viewed() if shown else None
    save_pages(path, pages, text, viewed)
    found, metadata = load_pages(path)
    assert metadata == text
    assert found.keys() == pages.keys()
    assert differences(pages, found) == []


def test_all_records_are_tested():
    assert {type(each) for each in KINDS.values()} == {*RECORDS} - {SceneState}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", METHODS)
def test_a_state_comes_back_bit_by_bit(tmp_path, name, suffix):
    path, method = tmp_path / f"a{suffix}", learned(name, SHAPE)
    method.save(path)
    loaded = equipix.load(path)
    assert type(loaded) is type(method)
    loaded.save(tmp_path / f"b{suffix}")
    states = [read_record(tmp_path / f"{each}{suffix}", SceneState) for each in "ab"]
    assert differences(*states) == []


def table_of_lines():
    """A table of lines in place of curves, which says what they leave."""
    with pytest.warns(InputWarning, match="'linearise'"):
        return hardware.Table.of(KINDS["polynomial"], linearise=(500, 3000))


def test_a_table_is_read_by_its_suffix(tmp_path):
    table = table_of_lines()
    for suffix in (".bin", ".hex", ".h"):
        table.save(tmp_path / f"a{suffix}")
        assert differences(table, equipix.load(tmp_path / f"a{suffix}")) == []
    with pytest.raises(FileError, match=r"none\.bin: does not exist"):
        equipix.load(tmp_path / "none.bin")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("name", [*KINDS, "state"])
def test_a_changed_byte_of_any_array_is_noticed(tmp_path, name, suffix):
    path = tmp_path / f"a{suffix}"
    (learned("gated", SHAPE) if name == "state" else KINDS[name]).save(path)
    pages, content = load_pages(path)
    for key, page in pages.items():
        changed = bytearray(page.tobytes())
        changed[len(changed) // 2] ^= 1
        other = np.frombuffer(bytes(changed), page.dtype).reshape(page.shape)
        save_pages(path, pages | {key: other}, content, force=True)
        with pytest.raises(FileError, match=rf"a\{suffix}: is damaged: array '{key}' differs"):
            equipix.load(path)


@pytest.mark.long
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_flipped_bit_of_a_file_is_refused_or_changes_nothing(tmp_path, suffix):
    path, wanted = tmp_path / f"kept{suffix}", KINDS["averages"]
    wanted.save(path)
    whole, rng = path.read_bytes(), np.random.default_rng(4)
    for place in rng.integers(0, len(whole), 150):
        changed = bytearray(whole)
        changed[place] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        try:
            found = equipix.load(path)
        except FileError as error:
            assert str(path) in str(error)
        else:
            assert differences(wanted, found) == [], int(place)


@pytest.mark.parametrize("name", KINDS)
def test_other_versions_kinds_and_parts_are_refused_by_name(tmp_path, name):
    path, kind = tmp_path / "a.npz", KINDS[name].KIND
    for changed, message in (
        ({"version": KINDS[name].VERSION + 1}, f"holds {kind} of version .* reads version"),
        ({"version": 1}, f"holds {kind} of version 1, .* make the file again"),
        ({"kind": "another"}, "holds another, expected calibration or .* name"),
        ({"fields": {"unknown": 1}}, rf"is damaged: .* \(in {kind}\): use a copy"),
        ({"fields": {"metadata": None}}, rf"is damaged: .* \(in {kind}\): use a copy"),
        ({"arrays": {"unknown": np.ones((2, 3))}}, rf"is damaged: .* \(in {kind}\)"),
    ):
        KINDS[name].save(path, force=True)
        rewrite(path, **changed)
        with pytest.raises(FileError, match=rf"a\.npz: {message}"):
            equipix.load(path)
    KINDS[name].save(path, force=True)
    pages, content = load_pages(path)
    save_pages(path, pages | {"more": np.ones((2, 3))}, content, force=True)
    with pytest.raises(FileError, match="is damaged: arrays more have no place in it"):
        equipix.load(path)


class Look(NamedTuple):
    at: int
    size: float


@dataclass(frozen=True)
class Part:
    word: Literal["one", "two"]
    looks: tuple[Look, ...]
    map: Map | None = None


@dataclass(frozen=True, eq=False)
class Whole(Record, kind="whole", version=7):
    map: Map
    parts: tuple[Part, ...]
    series: dict[str, Annotated[Array, "bool|>i8|int64", "n"]]
    pair: tuple[str, bool] = ("", False)
    any: dict[str, Any] = field(default_factory=dict)
    cached: object = field(default=None, metadata=UNSAVED)


def whole(**changed):
    values = {
        "map": np.arange(6, dtype=np.float32).reshape(2, 3),
        "parts": (Part("one", (Look(1, np.inf), Look(2, 3))), Part("two", (), np.ones((2, 3)))),
        "series": {"a": np.array([True, False]), "b": np.arange(2)},
        "pair": ("é", np.bool_(True)),
        "any": {"x": [1, {"y": None}]},
        "cached": object(),
    }
    return Whole(**values | changed)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_annotations_say_what_is_stored(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    whole().save(path)
    found = read_record(path, Whole)
    assert differences(whole(pair=("é", True)), found) == []
    assert found.cached is None
    assert isinstance(found.parts[0].looks[0], Look)
    assert list(load_pages(path)[0]) == ["map", "parts.1.map", "series.a", "series.b"]
    text = json.dumps(load_pages(path)[1], allow_nan=False)  # JSON of other languages, too
    place = json.loads(text)["fields"]["map"]
    assert place == {
        "dtype": "float32",
        "shape": [2, 3],
        "crc32": zlib.crc32(whole().map.astype("<f4").tobytes()),
    }


def test_the_order_of_bytes_changes_no_checksum(tmp_path):
    whole(map=whole().map.astype(">f4")).save(tmp_path / "a.npz")
    np.testing.assert_array_equal(read_record(tmp_path / "a.npz", Whole).map, whole().map)


@pytest.mark.parametrize(
    "changed",
    [
        {"map": np.ones(3)},
        {"map": np.ones((2, 3), np.int32)},
        {"map": np.ones((0, 3))},
        {"map": np.ones((2, 4))},
        {"map": None},
        {"map": [[1.0, 2.0]]},
        {"parts": (Part("three", ()),)},
        {"parts": (Part("one", (Look("1", 2.0),)),)},
        {"parts": (None,)},
        {"series": {"a": np.arange(2), "b": np.arange(3)}},
        {"pair": ("x",)},
        {"pair": ("x", 1)},
        {"any": {"x": object()}},
    ],
)
def test_what_does_not_fit_is_not_saved(tmp_path, changed):
    with pytest.raises(InputError, match="this whole cannot be saved: "):
        whole(**changed).save(tmp_path / "a.npz")
    assert list(tmp_path.iterdir()) == []


def test_a_reader_of_one_kind_refuses_the_others(tmp_path):
    KINDS["averages"].save(tmp_path / "a.tif")
    with pytest.raises(FileError, match=r"a\.tif: holds frame statistics, expected calibration th"):
        read_record(tmp_path / "a.tif", equipix.Calibration)
    with pytest.raises(
        InputError,
        match=r"expected the suffix \.tif, \.npz, \.fits, \.nxs, \.asdf, \.bin, \.hex or \.h",
    ):
        equipix.load(tmp_path / "a.txt")


def test_inspect_shows_every_kind(tmp_path, run):
    table = table_of_lines()
    for name, each in (KINDS | {"state": learned("kalman", SHAPE)}).items():
        each.save(tmp_path / f"{name}.npz")
        status, out, _ = run("inspect", tmp_path / f"{name}.npz", "--json")
        assert (status, json.loads(out)["shape"]) == (0, [*SHAPE]), name
    table.save(tmp_path / "a.hex")
    assert run("inspect", tmp_path / "a.hex", "--json")[0] == 0
