"""Files under a correction: the dark that each takes, and FITS files with their headers."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData

import equipix
from equipix import Flag, nuc
from equipix.correction.correct_files import correct_files
from equipix.errors import FileError, InputError, InputWarning
from equipix.io.frames import read_frames
from equipix.io.tiff import write_frames

SHAPE = (16, 20)
CURRENT = np.random.default_rng(1).uniform(20, 60, SHAPE)  # DN/s
LIGHT, NOISE = 200.0, 2.0


def frames(time, light=LIGHT, seed=1):
    noise = NOISE * np.random.default_rng(seed).standard_normal(SHAPE)
    return np.rint(100 + CURRENT * time + light + noise).astype(np.uint16)


@pytest.fixture(scope="module")
def response():
    """A response that changes nothing but for a stored dark of 5 s, and flags a pixel."""
    ones = np.ones(SHAPE)
    known = nuc.fit([500 * ones, 5000 * ones], order=1)
    flags = known.flags.copy()
    flags[3, 4] = Flag.DEAD | Flag.DO_NOT_USE
    taken = {"dark_settings": {"exposure_s": 5.0, "temperature_c": -10.0}}
    return replace(
        known, dark=frames(5, 0).astype(float), flags=flags, metadata=known.metadata | taken
    )


@pytest.fixture
def night(tmp_path, monkeypatch):
    """Darks and frames of several exposure times as FITS files, in the current folder."""
    monkeypatch.chdir(tmp_path)
    for time in (1, 5, 10):
        for k in range(3):
            written(f"dark{time}-{k}.fits", time, 0, seed=k)
        equipix.average(f"dark{time}-*.fits").save(f"master{time}.fits")
    for time in (5, 7):
        written(f"m31-{time}.fits", time, LIGHT)
    return tmp_path


def written(name, time, light, *, seed=9, temperature=-10.0, **cards):
    kind = "Light Frame" if light else "Dark Frame"
    cards = {"EXPTIME": float(time), "CCD-TEMP": temperature, "IMAGETYP": kind} | cards
    header = fits.Header({**cards, "OBJECT": "M 31", "CRVAL1": 10.68})
    header.add_history("observed")
    fits.writeto(name, frames(time, light, seed), header, overwrite=True)
    return name


class TestNotFinite:
    @pytest.fixture
    def holed(self, tmp_path, monkeypatch):
        """Two files with 2 values that are not finite; one is that of the flagged pixel."""
        monkeypatch.chdir(tmp_path)
        for name, places in {"a.tif": [(3, 4), (5, 6)], "b.tif": [(1, 1), (2, 2)]}.items():
            values = frames(5).astype(np.float32)
            values[tuple(np.transpose(places))] = np.nan, np.inf
            write_frames(Path(name), [values], nbytes=values.nbytes)
        return ["a.tif", "b.tif"]

    @pytest.mark.parametrize(
        ("options", "outcome"),
        [
            *(({"flagged": each}, "stay so") for each in ("nan", "replace", "keep")),
            *(
                ({"dtype": "uint16", "flagged": each}, "look as if they were measured: .* float32")
                for each in ("replace", "keep")
            ),
            ({"display": "linear"}, "look as if they were measured: .* no picture"),
        ],
    )
    def test_they_are_counted_and_named_whatever_the_output(
        self, response, holed, options, outcome
    ):
        words = f"b.tif: holds 2 values of good .* infinite, and 1 more with 1. .* they {outcome}"
        with pytest.warns(InputWarning, match=words):
            done = correct_files(response, holed, Path("out.tif"), **options)
        assert [each.kind for each in done.findings] == ["not_finite"]

    @pytest.mark.parametrize(("flagged", "count"), [("nan", 2), ("keep", 1), ("replace", 0)])
    def test_flagged_pixels_without_a_value_are_counted(self, tmp_path, flagged, count):
        """Of those that are kept the ones without coefficients."""
        planes, flags = np.zeros((2, *SHAPE)), np.zeros(SHAPE, np.uint32)
        planes[1], planes[1, 3, 4] = 1, np.nan
        flags[3, 4:6] = Flag.DEAD | Flag.DO_NOT_USE
        raw = tmp_path / "raw.tif"
        write_frames(raw, [frames(5)], nbytes=frames(5).nbytes)
        correction = equipix.Polynomial(planes, flags)
        done = correct_files(correction, [str(raw)], tmp_path / "out.tif", flagged=flagged)
        assert done.flagged == np.isnan(read_frames(tmp_path / "out.tif")).sum() == count

    def test_good_frames_have_none(self, response, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        values = frames(5).astype(np.float32)
        write_frames(Path("good.tif"), [values], nbytes=values.nbytes)
        assert correct_files(response, ["good.tif"], Path("out.tif")).findings == ()

    def test_frames_without_a_number_are_one_finding(self, response, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        lost = np.full(SHAPE, np.nan, np.float32)
        write_frames(Path("lost.tif"), [lost], nbytes=lost.nbytes)
        with pytest.warns(InputWarning) as caught:
            done = correct_files(response, ["lost.tif"], Path("out.tif"))
        assert [each.kind for each in done.findings] == ["not_finite"]
        assert [each.category for each in caught] == [InputWarning]


class TestDarks:
    def test_of_several_each_file_takes_the_one_that_fits(self, response, night):
        source, darks = ["m31-7.fits", "m31-5.fits"], [f"master{k}.fits" for k in (1, 5, 10)]
        done = correct_files(response, source, night / "out.tif", dark=darks)
        assert (done.frames, done.findings) == (2, ())
        low, high = (equipix.load(night / f"master{k}.fits").mean for k in (5, 10))
        pairs = zip(read_frames("out.tif"), source, (0.6 * low + 0.4 * high, low), strict=True)
        for found, file, dark in pairs:
            wanted = response.correct(read_frames(file)[0], dark=dark)
            np.testing.assert_allclose(found, wanted, rtol=1e-6)
        # As frames too: here of one file each.
        again = [f"dark{k}-0.fits" for k in (1, 5, 10)]
        assert correct_files(response, source, night / "again.tif", dark=again).findings == ()

    def test_counts_go_on_from_dark_to_dark(self, response, night):
        darks = ["master5.fits", "master10.fits"]
        with pytest.warns(InputWarning, match="100% of the corrected values"):
            done = correct_files(
                replace(response, dark=None, inverse=4 * response.inverse),
                ["m31-*.fits"],
                night / "out.tif",
                dark=darks,
                dtype="uint8",
            )
        assert done.limited == 2 * CURRENT.size

    @pytest.mark.parametrize(
        ("file", "dark", "words"),
        [
            (
                ("m31-20.fits", 20, LIGHT),
                ["master1.fits", "master10.fits"],
                r"no dark fits m31-20.fits of 20 s: .* have 1, 10 s, .* not extrapolated",
            ),
            (
                ("m31-20.fits", 5, LIGHT),
                ["dark?-0.fits"],
                r"the files of .* dark\?-0.fits have different values of the exposure time: "
                r"'dark1-0.fits' holds 1 s, 'dark5-0.fits' 5 s: give .* once",
            ),
            (
                ("m31-20.fits", 5, LIGHT),
                ["m31-7.fits"],
                r"m31-7.fits: is 'Light Frame' by its header \(IMAGETYP\), expected dark frames",
            ),
            (
                ("m31-20.fits", 5, LIGHT),
                ["dark5-0.fits", "dark5-1.fits"],
                r"dark5-0.fits and .*dark5-1.fits do not differ: name their frames in one",
            ),
        ],
    )
    def test_what_does_not_fit_is_refused_by_name(self, response, night, file, dark, words):
        written(*file)
        before = sorted(night.iterdir())
        with pytest.raises(FileError, match=words):
            correct_files(response, ["m31-20.fits"], night / "out", dark=dark)
        assert sorted(night.iterdir()) == before

    @pytest.mark.parametrize(
        ("dark", "words"),
        [
            (["none", "master5.fits"], "is 'none' and names files too: leave out one"),
            (["master5.fits", "stored"], "is 'stored' and names files too: leave out one"),
            (["none", "none"], "is 'none' twice: give it once"),
            (["stored", "stored"], "is 'stored' twice: give it once"),
        ],
    )
    def test_a_word_stands_alone(self, response, night, dark, words):
        with pytest.raises(InputError, match=rf"'dark' \(--dark\) {words}$"):
            correct_files(response, ["m31-5.fits"], night / "o", dark=dark)

    @pytest.mark.parametrize("keyword", ["IMAGETYP", "OBSTYPE", "FRAME"])
    def test_a_frame_of_light_is_named_with_its_keyword(self, response, night, keyword):
        written("sky.fits", 5, LIGHT, **{"IMAGETYP": None, keyword: "FLAT"})
        words = rf"sky.fits: is 'FLAT' by its header \({keyword}\), expected dark frames"
        with pytest.raises(FileError, match=words):
            correct_files(response, ["m31-5.fits"], night / "o", dark=["s*.fits"])

    def test_a_dark_that_is_subtracted_is_named_by_its_file(self, response, night):
        dark = equipix.load("master1.fits")
        equipix.average("dark5-*.fits", dark=dark).save("less.fits")
        with pytest.raises(InputError, match=r"^less.fits: its dark was already subtracted"):
            correct_files(response, ["m31-5.fits"], night / "o", dark=["le*.fits"])

    @pytest.mark.parametrize(
        ("dark", "named"),
        [(None, "the dark of the correction"), (["master5.fits"], r"'dark' \(--dark\) master5")],
    )
    def test_another_exposure_time_or_temperature_is_a_finding(self, response, night, dark, named):
        written("warm.fits", 5, LIGHT, temperature=-4.0)
        assert correct_files(response, ["m31-5.fits"], night / "a.tif", dark=dark).findings == ()
        source = ["m31-5.fits", "m31-7.fits", "warm.fits"]
        with pytest.warns(InputWarning):
            done = correct_files(response, source, night / "b.tif", dark=dark)
        time, temperature = (each.message for each in done.findings)
        assert {each.kind for each in done.findings} == {"other_dark"}
        wanted = rf"{named}.* was taken with .* 5 s, m31-7.fits with 7 s by its files, "
        assert re.match(wanted, time)
        wanted = rf"{named}.* was taken with .* -10 °C, warm.fits with -4 °C by its files \(limit "
        assert re.match(wanted, temperature)

    @pytest.mark.parametrize("typed", [True, False])
    def test_dark_frames_among_the_frames_are_a_finding(self, response, night, typed):
        """As the shell gives them of an unquoted pattern."""
        if not typed:
            for name in ("dark5-0", "dark5-1", "dark5-2", "m31-5"):
                write_frames(f"{name}.tif", read_frames(f"{name}.fits"), nbytes=1)
        suffix = "fits" if typed else "tif"
        source = [f"{name}.{suffix}" for name in ("dark5-1", "dark5-2", "m31-5")]
        with pytest.warns(InputWarning, match="quote patterns"):
            done = correct_files(response, source, night / "o", dark=[f"dark5-0.{suffix}"])
        (found,) = done.findings
        assert found.kind == "dark_frames"
        assert found.message.startswith(f"dark5-1.{suffix} and 1 more: given as frames, but")

    def test_dark_frames_beside_the_stored_dark_are_a_finding(self, response, night):
        for name in ("dark5-0", "m31-5"):
            write_frames(f"{name}.tif", read_frames(f"{name}.fits"), nbytes=1)
        source = ["dark5-0.tif", "m31-5.tif"]
        with pytest.warns(InputWarning, match="as dark as the dark of the correction"):
            done = correct_files(response, source, night / "o")
        assert [(each.kind, each.message) for each in done.findings] == [
            (
                "dark_frames",
                "dark5-0.tif: given as frames, but as dark as the dark of the correction. If they "
                "hold no light, leave them out",
            )
        ]
        # Frames from which the dark was subtracted are another finding.
        lit = (read_frames("m31-5.tif") - response.dark - LIGHT).astype(np.float32)
        for name in ("a.tif", "b.tif"):
            write_frames(name, lit, nbytes=lit.nbytes)
        with pytest.warns(InputWarning, match="darker than the dark"):
            done = correct_files(response, ["a.tif", "b.tif"], night / "below")
        assert [each.kind for each in done.findings] == ["bright_dark"]


@pytest.fixture
def opened(monkeypatch):
    """Names of FITS files with how often each was opened."""
    counts = Counter()

    def counted(path, *arguments, opening=fits.open, **options):
        counts[Path(getattr(path, "name", path)).name] += 1
        return opening(path, *arguments, **options)

    monkeypatch.setattr(fits, "open", counted)
    return counts


@pytest.mark.usefixtures("night")
class TestOpens:
    """A file is opened once for all that its header holds, and once for its frames."""

    def test_of_an_average(self, run, opened):
        darks = ["dark5-0.fits", "dark5-1.fits"]
        options = [f"--dark={name}" for name in darks]
        assert run("average", "m31-5.fits", "dark5-2.fits", "-o", "a.npz", *options)[0] == 0
        assert opened == dict.fromkeys(["m31-5.fits", "dark5-2.fits", *darks], 2)

    def test_of_a_saved_average(self, run, opened):
        assert run("average", "master5.fits", "-o", "a.npz", "--dark", "master1.fits")[0] == 0
        # The second time its checksums are compared.
        assert opened == {"master5.fits": 2, "master1.fits": 2}

    @pytest.mark.parametrize("dark", [["dark5-0.fits"], ["master5.fits", "dark10-0.fits"]])
    def test_of_corrected_frames(self, response, night, opened, dark):
        source = ["m31-5.fits", "m31-7.fits"] if len(dark) > 1 else ["m31-5.fits"]
        correct_files(response, source, night / "out.tif", dark=dark)
        assert opened == dict.fromkeys([*source, *dark], 2)
        opened.clear()
        correct_files(response, source, night / "out.fits", dark=dark)
        # Once more for the header that is kept.
        assert opened == dict.fromkeys(source, 3) | dict.fromkeys(dark, 2)


class TestFits:
    @pytest.mark.parametrize("name", ["picture.fits", "picture.FIT"])
    def test_it_holds_no_picture(self, response, night, name):
        """Whose values are in no unit, beside a header that names one."""
        words = rf"'display' .*{name}' holds values .* in a unit: name a .tif, a .png"
        with pytest.raises(InputError, match=words):
            correct_files(response, ["m31-5.fits"], night / name, display="linear")
        assert not (night / name).exists()

    def test_headers_are_kept_and_say_what_was_done(self, response, night):
        darks = ["master5.fits", "master10.fits"]
        origin = "correction sha256 " + 64 * "a"
        correct_files(
            response, ["m31-*.fits"], night / "out", dark=darks, origin=origin, flagged="nan"
        )
        assert sorted(each.name for each in (night / "out").iterdir()) == [
            "m31-5.fits",
            "m31-7.fits",
        ]
        ccd = CCDData.read(night / "out" / "m31-7.fits")
        assert (ccd.unit, ccd.data.dtype.kind, np.isnan(ccd.data).sum()) == ("adu", "f", 1)
        assert np.nanmean(ccd.data) == pytest.approx(LIGHT, abs=1)
        for key, value in {"OBJECT": "M 31", "EXPTIME": 7.0, "CRVAL1": 10.68}.items():
            assert ccd.header[key] == value
        assert "BZERO" not in ccd.header
        history = "".join(ccd.header["HISTORY"])
        for words in (
            "observed",
            origin,
            "0.6 of master5.fits + 0.4 of master10.fits",
            "1 flagged",
        ):
            assert words in history
        with pytest.warns(InputWarning, match="corrected already, by this correction"):
            correct_files(
                response, ["out/m31-7.fits"], night / "b.tif", dark=["none"], origin=origin
            )

    @pytest.mark.parametrize("dtype", ["float32", "uint16", "uint8"])
    def test_one_file_of_all_frames_is_that_of_the_tiff(self, response, night, dtype):
        write_frames("m31-8.tif", frames(5)[None], nbytes=1)
        source = ["m31-5.fits", "m31-8.tif"]
        for name in ("all.fits", "all.tif"):
            correct_files(response, source, night / name, dtype=dtype)
        np.testing.assert_array_equal(read_frames("all.fits"), read_frames("all.tif"))
        with fits.open("all.fits") as units:
            units.verify("exception")
            assert [unit.header.get("OBJECT") for unit in units] == ["M 31", None]

    def test_cubes_extensions_and_compressed_files(self, response, night):
        cube = fits.ImageHDU(np.stack([frames(5)] * 6).reshape(3, 2, *SHAPE), name="SCI")
        cube.header["CTYPE3"] = "TIME"
        primary = fits.PrimaryHDU(header=fits.Header({"OBSERVER": "Hale", "IMAGETYP": "LIGHT"}))
        fits.HDUList([primary, cube]).writeto("cube.fits.gz")
        image = fits.CompImageHDU(frames(5), fits.Header({"OBJECT": "M 33"}))
        fits.HDUList([fits.PrimaryHDU(), image]).writeto("m33.fits.fz")
        correct_files(response, ["cube.fits.gz", "m33.fits.fz"], night / "out")
        with fits.open("out/cube.fits") as units:
            assert [unit.shape for unit in units] == [(3, 2, *SHAPE)]
            kept = units[0].header
            assert (kept["OBSERVER"], kept["CTYPE3"], kept["EXTNAME"]) == ("Hale", "TIME", "SCI")
            wanted = response.correct(frames(5))
            np.testing.assert_allclose(units[0].data[2, 1], wanted, rtol=1e-6)
        with fits.open("out/m33.fits") as units:
            assert (units[0].header["OBJECT"], units[0].shape) == ("M 33", SHAPE)

    def test_pictures_are_no_fits(self, response, night):
        correct_files(response, ["m31-5.fits"], night / "out", display="linear")
        assert [each.name for each in (night / "out").iterdir()] == ["m31-5.tif"]
