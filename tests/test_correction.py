"""Corrections of any kind: the protocol, files, the registry of `load`, the command line."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pytest

import equipix
from equipix import Flag, loading, simulate
from equipix.correction.apply import apply
from equipix.correction.correct_files import correct_files
from equipix.errors import FileError, InputError
from equipix.io.formats import load_pages, save_pages
from equipix.io.frames import read_frames
from equipix.io.record import Counts, Record
from equipix.io.tiff import write_frames
from equipix.loading import load_correction

SHAPE = (30, 40)
RNG = np.random.default_rng(5)


@dataclass(frozen=True, eq=False)
class Bent(Record, kind="bent response", version=2):
    """A correction of second order whose offset is part of it: no dark frame, no sensitivity."""

    coefficients: Annotated[np.ndarray, "float32", "3 rows cols"]
    flags: Counts
    metadata: dict[str, Any]

    @property
    def shape(self):
        return self.flags.shape

    def correct(self, frames, *, flagged="nan", out=None):
        def formula(frame, corrected):
            corrected[...] = np.polynomial.polynomial.polyval(
                frame.astype(np.float64), self.coefficients, tensor=False
            )

        return apply(frames, formula, flags=self.flags, flagged=flagged, out=out)


@pytest.fixture
def bent(monkeypatch):
    monkeypatch.setattr(loading, "RECORDS", (*loading.RECORDS, Bent))
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
            correct_files(bent, images[1], tmp_path / "out.tif", dark=dark)
        assert sorted(tmp_path.iterdir()) == before


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
        with pytest.raises(FileError, match="holds .*FrameStatistics, expected a corr.*--dark"):
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
        assert told["order"] == 2
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
