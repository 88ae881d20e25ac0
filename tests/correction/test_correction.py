"""Corrections of any kind: the protocol, files, the registry of `load`, the command line."""

from __future__ import annotations

import importlib
import inspect
import json
import pickle
import pkgutil
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest

import equipix
from equipix import Flag, bolometer, hardware, lens, nuc, saved_results, scene, simulate
from equipix.correction.apply import CorrectionBase
from equipix.correction.correct_files import correct_files
from equipix.correction.protocol import MEMBERS, check_correction
from equipix.errors import FileError, InputError
from equipix.findings import Finding
from equipix.io.formats import load_pages, save_pages
from equipix.io.frames import read_frames
from equipix.io.record import Counts, Record
from equipix.io.tiff import write_frames
from equipix.measured.colour import Colours
from equipix.saved_results import load_correction

SHAPE = (30, 40)
RNG = np.random.default_rng(5)


@dataclass(frozen=True, eq=False)
class Bent(CorrectionBase, Record, kind="bent response", version=2):
    """A correction of second order whose offset is part of it: no dark frame, no sensitivity."""

    coefficients: Annotated[np.ndarray, "float32", "3 rows cols"]
    flags: Counts
    metadata: dict[str, Any]
    findings: ClassVar[tuple[Finding, ...]] = ()
    dark = limits = saturation = colours = None
    bits = 0
    takes_dark = needs_dark = leaves_offset = False

    @property
    def shape(self):
        return self.flags.shape

    def _formula(self, _dark, _exact, /):
        return lambda frame: np.polynomial.polynomial.polyval(
            frame.astype(np.float64), self.coefficients, tensor=False
        )


@pytest.fixture
def bent(monkeypatch):
    monkeypatch.setattr(saved_results, "RECORDS", (*saved_results.RECORDS, Bent))
    coefficients = np.stack(
        [RNG.normal(-60, 1, SHAPE), RNG.normal(1, 0.05, SHAPE), RNG.normal(1e-5, 1e-6, SHAPE)]
    ).astype(np.float32)
    flags = np.zeros(SHAPE, np.uint32)
    flags[3, 4] = Flag.DEAD | Flag.DO_NOT_USE
    return Bent(coefficients, flags, {"levels": 4})


@pytest.fixture(scope="module")
def calibration():
    truth = simulate.paper_sensitivity(SHAPE, rng=1)
    shifts = equipix.cross_pattern(5, 7)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE, width=100), shifts)
    return equipix.calibrate(frames.astype(np.float32), shifts)


def raw_frames(count=3):
    return RNG.integers(100, 4000, (count, *SHAPE), dtype=np.uint16)


def horner(correction, frames):
    """Σ c_j y^j in double precision."""
    total = np.zeros(frames.shape)
    for coefficient in correction.coefficients[::-1].astype(np.float64):
        total = total * frames + coefficient
    return total


def rounding(correction, frames):
    """Limit of the roundings of Horner's scheme in float32: two a power, each of half an eps."""
    planes = np.abs(correction.coefficients.astype(np.float64)).max(axis=(1, 2))
    largest = np.polynomial.polynomial.polyval(float(frames.max()), planes)
    return len(planes) * np.finfo(np.float32).eps * largest


class TestProtocol:
    def test_both_kinds_meet_it(self, bent, calibration):
        assert isinstance(bent, equipix.Correction)
        assert isinstance(calibration, equipix.Correction)
        assert not isinstance(np.ones(3), equipix.Correction)

    @pytest.mark.parametrize("with_dark", [True, False])
    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_coefficients_of_a_calibration_are_what_it_does(self, calibration, dtype, with_dark):
        sensitivity = calibration.sensitivity.astype(dtype)
        sensitivity[2, 3] = np.nan
        dark = RNG.normal(60, 5, SHAPE).astype(np.float32) if with_dark else None
        fields = vars(calibration) | {"sensitivity": sensitivity, "dark": dark}
        cal = equipix.Calibration(**fields)
        frames = raw_frames().astype(dtype)
        corrected = cal.correct(frames, dark="stored" if with_dark else None, flagged="keep")
        assert cal.coefficients.shape == (2, *SHAPE)
        assert cal.coefficients.dtype == dtype
        assert np.isnan(cal.coefficients[:, 2, 3]).all()
        # 1/M, its product and its sum round once, and so do the difference and the quotient, all
        # by half an eps of less than the largest frame over M; the dark is 2 % of it.
        limit = 3 * np.finfo(dtype).eps * frames.max() / np.nanmin(sensitivity)
        np.testing.assert_allclose(horner(cal, frames), corrected, rtol=0, atol=limit)

    def test_a_dead_pixel_has_coefficients_without_end(self, calibration):
        sensitivity = calibration.sensitivity.copy()
        sensitivity[4, 5] = 0
        cal = equipix.Calibration(**vars(calibration) | {"sensitivity": sensitivity})
        assert np.isinf(cal.coefficients[1, 4, 5])

    def test_flagged_pixels_become_what_was_asked(self, bent):
        frames = raw_frames()
        wanted = horner(bent, frames)
        kept = bent.correct(frames, flagged="keep")
        # The coefficients are float32, the sum is made in float64 and rounded to float32.
        np.testing.assert_allclose(kept, wanted, rtol=np.finfo(np.float32).eps)
        assert np.isnan(bent.correct(frames)[:, 3, 4]).all()
        replaced = bent.correct(frames[0], flagged="replace")
        around = [kept[0, 3 + r, 4 + c] for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]
        assert replaced[3, 4] == pytest.approx(np.mean(around), rel=1e-6)
        with pytest.raises(InputError, match="'frames' has shape"):
            bent.correct(frames[:, 1:])


def learned(name):
    """What a scene method gives of a scene that moves."""
    options = {"block": 10} if name == "Kalman" else {}
    method = getattr(scene, name)((48, 64), (0.0, 16383.0), saturation=16000.0, **options)
    for frame in simulate.MovingScene(seed=4, shape=(48, 64)).frames(60):
        method.update(np.rint(4000 + 8000 * frame.values).astype(np.uint16))
    return method.correction()


def levels(*, dark=False):
    array = simulate.StaringArray.of("InSb", SHAPE, rng=1)
    off = equipix.average(array.frames(0, 4, rng=9)) if dark else None
    return [
        equipix.average(array.frames(e, 4, rng=k), dark=off, saturation=16000.0)
        for k, e in enumerate((4e6, 8e6, 12e6))
    ]


def of_bolometers():
    array = simulate.BolometerArray.of(SHAPE, rng=5)
    frames = np.stack([array.mean(t) for t in (0.0, 20.0, 40.0)])
    return bolometer.fit(frames, [0.0, 20.0, 40.0], [2.0] * 3, order=2, bias_order=0).correction(10)


def falloff():
    rows, cols = np.mgrid[:120, :160]
    return lens.fit(1000 / (1 + ((rows - 62) ** 2 + (cols - 75) ** 2) / 300**2) ** 2)


NOTHING = {"takes_dark": False, "needs_dark": False, "dark": False, "limits": False}
RAW = {"leaves_offset": True}
PRODUCERS = {
    "Calibration": lambda cal: (cal, {"takes_dark": True, "needs_dark": True}),
    "Calibration with a dark": lambda cal: (
        equipix.Calibration(**vars(cal) | {"dark": np.full(SHAPE, 60.0)}),
        {"takes_dark": True, "dark": True},
    ),
    "Response": lambda _: (
        nuc.fit(levels(), order=2),
        RAW | {"takes_dark": True, "limits": True, "saturation": 16000.0, "bits": 14},
    ),
    "Response with a dark": lambda _: (
        nuc.fit(levels(dark=True), order=1),
        {"takes_dark": True, "dark": True, "limits": True, "saturation": 16000.0, "bits": 14},
    ),
    "Polynomial": lambda _: (equipix.combine(falloff().correction(), ones(falloff())), {}),
    "Polynomial of raw levels": lambda _: (
        equipix.combine(first := nuc.fit(levels(), order=1), ones(first)),
        RAW | {"saturation": 16000.0, "bits": 14},
    ),
    "Table": lambda cal: (hardware.Table.of(cal), {}),
    "Table of raw levels": lambda _: (hardware.Table.of(nuc.fit(levels(), order=1)), RAW),
    "AdaptiveLoop": lambda _: (hardware.AdaptiveLoop(SHAPE).correction(), RAW),
    "DynamicCorrection": lambda _: (of_bolometers(), RAW),
    "LensFalloff": lambda _: (falloff().correction(), {}),
    **{name: lambda _, name=name: (learned(name), RAW) for name in scene.__all__},
}
"""Every way to a correction, and what its members say."""


def ones(like):
    return equipix.Polynomial(
        np.stack([np.zeros(like.shape), np.ones(like.shape)]), np.zeros(like.shape, np.uint32)
    )


def check_members(correction):
    """Every member has the type and the shape that the protocol declares."""
    shape = correction.shape
    check_correction("correction", correction)
    assert [type(each) for each in shape] == [int, int]
    assert (correction.flags.dtype, correction.flags.shape) == (np.uint32, shape)
    planes = correction.coefficients
    assert planes.dtype in (np.float32, np.float64)
    assert len(planes) in (2, 3, 4)
    assert planes.shape[1:] == shape
    json.dumps(correction.metadata)
    assert isinstance(correction.findings, tuple)
    assert all(isinstance(each, Finding) for each in correction.findings)
    assert correction.dark is None or correction.dark.shape == shape
    assert correction.limits is None or correction.limits.shape == (2, *shape)
    assert correction.saturation is None or type(correction.saturation) is float
    assert type(correction.bits) is int
    assert isinstance(correction.colours, Colours | None)
    for name in ("takes_dark", "needs_dark", "leaves_offset"):
        assert type(getattr(correction, name)) is bool, name
    for name, wanted in (("correct", ["dark", "flagged", "out"]), ("save", ["force"])):
        keywords = inspect.signature(getattr(correction, name)).parameters
        assert set(wanted) <= set(keywords), name


@pytest.fixture(scope="module", params=PRODUCERS)
def produced(request, calibration):
    return PRODUCERS[request.param](calibration)


@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
class TestProducers:
    def test_every_member_is_given_and_true(self, produced):
        correction, wanted = produced
        check_members(correction)
        wanted = {"leaves_offset": False, "saturation": None, "bits": 0} | NOTHING | wanted
        for name, value in wanted.items():
            found = getattr(correction, name)
            assert (found is not None if name in ("dark", "limits") else found) == value, name

    def test_colours_of_the_sensor_are_known(self, produced):
        correction, _ = produced
        if isinstance(correction, hardware.Table):
            metadata = {**correction.metadata, "cfa": [["R", "G"], ["G", "B"]]}
        else:
            metadata = {**correction.metadata, "sensor": {"cfa": "RGGB"}}
        assert str(replace(correction, metadata=metadata).colours) == "RGGB"

    def test_those_that_leave_an_offset_take_no_gain(self, produced):
        correction, _ = produced
        gain = replace(ones(correction), coefficients=1.1 * ones(correction).coefficients)
        if correction.leaves_offset:
            with pytest.raises(InputError, match="'first' leaves an offset"):
                equipix.combine(correction, gain)
        else:
            equipix.combine(correction, gain)

    @pytest.mark.parametrize("member", MEMBERS)
    def test_one_that_is_forgotten_is_noticed(self, bent, member):
        check_members(bent)
        kept = {name: getattr(bent, name) for name in MEMBERS if name != member}
        with pytest.raises((InputError, AttributeError)):
            check_members(SimpleNamespace(**kept))

    def test_these_are_all(self):
        """No class of the package corrects, or gives a correction, that is not in the table."""
        found = set()
        for module in pkgutil.walk_packages(equipix.__path__, "equipix."):
            if module.name.endswith(("__main__", "_native")):
                continue
            for name, kind in vars(importlib.import_module(module.name)).items():
                gives = inspect.isclass(kind) and {"correct", "correction"} & set(dir(kind))
                if gives and kind.__module__ == module.name:
                    found.add(name)
        bases = {"Correction", "CorrectionBase", "RawCorrection", "SceneCorrection"}
        assert found - bases == {name.split(" ")[0] for name in PRODUCERS}


class TestFiles:
    @pytest.fixture
    def images(self, tmp_path):
        frames = raw_frames(4)
        for number, half in enumerate((frames[:3], frames[3:])):
            with (tmp_path / f"raw{number}.tif").open("wb") as file:
                write_frames(file, half, nbytes=half.nbytes)
        return frames, [str(tmp_path / "raw*.tif")]

    def test_are_corrected_as_arrays_are(self, bent, images, tmp_path):
        frames, source = images
        assert correct_files(bent, source, tmp_path / "out.tif", flagged="replace").frames == 4
        found = read_frames(tmp_path / "out.tif")
        wanted = equipix.Corrector(bent, "float32", flagged="replace").apply(frames)
        np.testing.assert_array_equal(found, wanted)
        np.testing.assert_allclose(
            found, bent.correct(frames, flagged="replace"), rtol=0, atol=rounding(bent, frames)
        )

    def test_of_other_types_are_corrected_in_single_precision(self, bent, tmp_path):
        frames = raw_frames(2)
        for dtype in (np.float64, np.int32, ">u2"):
            write_frames(tmp_path / "raw.tif", frames.astype(dtype), nbytes=1)
            correct_files(bent, [str(tmp_path / "raw.tif")], tmp_path / "out.tif", force=True)
            wanted = equipix.Corrector(bent, "float32", flagged="nan").apply(frames)
            np.testing.assert_array_equal(read_frames(tmp_path / "out.tif"), wanted)

    @pytest.mark.parametrize("dark", ["none", "dark.tif"])
    def test_another_dark_is_refused_where_there_is_none(self, bent, images, tmp_path, dark):
        before = sorted(tmp_path.iterdir())
        with pytest.raises(InputError, match=f"'dark' is '{dark}', but the offsets .* 'stored'"):
            correct_files(bent, images[1], tmp_path / "out.tif", dark=[dark])
        assert sorted(tmp_path.iterdir()) == before

    def test_a_missing_dark_is_asked_for(self, calibration, images, tmp_path):
        words = "'dark' .* is 'stored': give dark frames, or 'none' .* if the dark is subtracted"
        with pytest.raises(InputError, match=words):
            correct_files(calibration, images[1], tmp_path / "out.tif")


class TestLoad:
    @pytest.mark.parametrize("suffix", [".tif", ".npz"])
    def test_gives_back_a_correction_of_any_kind(self, bent, calibration, tmp_path, suffix):
        bent.save(tmp_path / f"bent{suffix}")
        calibration.save(tmp_path / f"cal{suffix}")
        read = equipix.load(tmp_path / f"bent{suffix}")
        assert isinstance(read, Bent)
        assert read.metadata == bent.metadata
        for name in ("coefficients", "flags"):
            old, new = getattr(bent, name), getattr(read, name)
            assert (old.dtype, old.shape, old.tobytes()) == (new.dtype, new.shape, new.tobytes())
        assert isinstance(equipix.load(tmp_path / f"cal{suffix}"), equipix.Calibration)

    def test_refuses_an_unknown_kind_by_name(self, bent, tmp_path, monkeypatch):
        bent.save(tmp_path / "bent.npz")
        monkeypatch.undo()
        with pytest.raises(FileError, match=r"bent\.npz: holds bent response, expected .*name"):
            equipix.load(tmp_path / "bent.npz")

    @pytest.mark.parametrize("content", [{}, {"kind": None}, {"kind": ["calibration"]}, [1], 3])
    def test_refuses_what_has_no_kind(self, tmp_path, content):
        path = tmp_path / "other.npz"
        np.savez(path, metadata=np.array(json.dumps(content)), values=np.ones((3, 3)))
        with pytest.raises(FileError, match="other.npz: .* equipix did not write it"):
            equipix.load(path)
        save_pages(path, {}, content if isinstance(content, dict) else {}, force=True)
        with pytest.raises(FileError, match=r"other.npz: holds .*, expected calibration or .*name"):
            equipix.load(path)

    @pytest.mark.parametrize("suffix", [".tif", ".npz"])
    def test_gives_back_averaged_frames(self, tmp_path, suffix):
        frames = raw_frames()
        dark = equipix.average(frames[:1], saturation=4000)
        mean = equipix.average(frames, dark=dark, saturation=4095)
        mean.save(tmp_path / f"mean{suffix}")
        read = equipix.load(tmp_path / f"mean{suffix}")
        for old, new in ((mean, read), (dark, read.dark)):
            assert old.saturation == new.saturation
            for name, values in old.maps.items():
                np.testing.assert_array_equal(new.maps[name], values)

    def test_says_what_frame_statistics_are_where_they_are_no_correction(self, tmp_path):
        equipix.average(raw_frames()).save(tmp_path / "mean.tif")
        with pytest.raises(FileError, match="holds frame statistics, expected a corr.*--dark"):
            load_correction(tmp_path / "mean.tif")

    def test_names_the_kind_of_a_damaged_file(self, bent, tmp_path):
        path = tmp_path / "bent.tif"
        bent.save(path)
        pages, content = load_pages(path)
        rest = {name: each for name, each in content["fields"].items() if name != "metadata"}
        save_pages(path, pages, content | {"fields": rest}, force=True)
        with pytest.raises(FileError, match=r"is damaged: .* expected .*metadata \(in bent resp"):
            equipix.load(path)
        save_pages(path, {"flags": pages["flags"]}, content, force=True)
        with pytest.raises(FileError, match="is damaged: array 'coefficients' is missing"):
            equipix.load(path)


class TestCommandLine:
    @pytest.fixture
    def saved(self, bent, tmp_path):
        bent.save(tmp_path / "bent.tif")
        return tmp_path / "bent.tif"

    def test_correct(self, run, bent, saved, tmp_path):
        frames = raw_frames(2)
        write_frames(tmp_path / "raw.tif", frames, nbytes=frames.nbytes)
        output = tmp_path / "out.tif"
        assert run("correct", saved, tmp_path / "raw.tif", "-o", output)[0] == 0
        limit = rounding(bent, frames)
        np.testing.assert_allclose(read_frames(output), bent.correct(frames), rtol=0, atol=limit)
        status, _, err = run(
            "correct", saved, tmp_path / "raw.tif", "-o", output, "--force", "--dark", "none"
        )
        assert status == 1
        assert "--dark is 'none'" in err

    def test_inspect(self, run, saved):
        status, out, _ = run("inspect", saved, "--json")
        assert status == 0
        told = json.loads(out)
        assert told["shape"] == list(SHAPE)
        assert told["flagged_pixels"] == {"DO_NOT_USE": 1, "DEAD": 1}
        assert told["degree"] == 2
        assert told["metadata"] == {"levels": 4}
        assert "sensitivity" not in run("inspect", saved)[1]

    def test_compare_needs_calibrations(self, run, saved, calibration, tmp_path):
        calibration.save(tmp_path / "cal.tif")
        status, out, err = run("compare", tmp_path / "cal.tif", saved)
        assert (status, out) == (1, "")
        assert f"{saved}: holds bent response, expected calibration" in err


def test_a_calibration_can_be_pickled(calibration):
    again = pickle.loads(pickle.dumps(calibration))
    np.testing.assert_array_equal(again.sensitivity, calibration.sensitivity)
    np.testing.assert_array_equal(again.coefficients, calibration.coefficients)
