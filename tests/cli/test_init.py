"""`equipix init`: templates that the schema accepts once they are filled in."""

from __future__ import annotations

import json
import re
import tomllib

import numpy as np
import pytest
from astropy.io import fits

import equipix
from equipix import CameraExperiment, Experiment, LevelExperiment
from equipix.experiment.manifest import CameraManifest, LevelManifest, Manifest
from equipix.experiment.templates import template
from equipix.io.tiff import write_frames
from equipix.report.limits import read_limits
from given import write_dng, written_experiment

SHAPE = (48, 64)


def filled(path, **values):
    """Replace each blank by the value of its key."""
    text = path.read_text()
    for key, value in values.items():
        text = re.sub(rf'^{key} = "\?"', f"{key} = {value}", text, flags=re.MULTILINE)
    path.write_text(text)
    assert '"?"' not in "".join(line for line in text.splitlines(True) if line[0] != "#")
    return path


def write(path, level, count=1):
    """Write single frames, or as many as are wanted to one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(level)
    frames = rng.poisson(level, (count, *SHAPE)).astype(np.uint16)
    write_frames(path, frames, nbytes=frames.nbytes)


def write_fits(path, time, temperature=-10.0, level=100, **cards):
    """Write a frame with the settings that it was taken with."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frame = np.random.default_rng(level).poisson(level, (16, 20)).astype(np.uint16)
    fits.writeto(path, frame, fits.Header({"EXPTIME": time, "CCD-TEMP": temperature} | cards))


@pytest.fixture
def folders(tmp_path):
    """A folder of single frames for each position, level or dark."""
    for level, name in enumerate(("dark", "20C", "40C"), 1):
        for k in range(3):
            write(tmp_path / "run" / name / f"{k}.tif", 100 * level + k)
    return tmp_path / "run"


class TestExperiment:
    def test_finds_what_a_simulated_experiment_names(self, run, tmp_path):
        shifts = equipix.cross_pattern(5, 7)
        path = written_experiment(tmp_path, SHAPE, shifts, dead=0)
        wanted = Experiment.load(path).files()
        path.unlink()
        status, out, _ = run("init", "experiment", path.parent, "--json")
        assert status == 0
        told = json.loads(out)
        assert told["output"] == str(path)
        assert (told["files_found"], told["values_to_fill_in"]) == (len(wanted), 1)
        assert Experiment.load(filled(path, bit_depth=12)).files() == wanted

    def test_asks_for_shifts_without_images_of_a_hole(self, run, folders):
        assert run("init", "experiment", folders)[0] == 0
        path = filled(folders / "experiment.toml", bit_depth=16, shift="[0, 5]")
        found = Experiment.load(path).manifest
        assert found.dark[0].frames == "dark/*.tif"
        assert [(each.name, each.frames) for each in found.exposure] == [
            ("20C", "20C/*.tif"),
            ("40C", "40C/*.tif"),
        ]
        assert found.exposure[1].shift == [0, 5]

    def test_darks_are_parted_by_what_their_files_hold(self, run, tmp_path):
        taken = [(1.0, -10.0), (4.0, -10.1), (1.0, -20.0), (1.005, -10.2), (4.0, -10.0)]
        for k, (time, temperature) in enumerate(taken):
            write_fits(tmp_path / f"dark-{k}.fits", time, temperature, 100 + k)
        for k in range(3):
            write_fits(tmp_path / f"p{k}/a.fits", 1.0, level=500 + k)
        assert run("init", "experiment", tmp_path)[0] == 0
        text = (tmp_path / "experiment.toml").read_text()
        assert '"hole/p1-before.fits"' in text
        assert ".tif" not in text
        path = filled(tmp_path / "experiment.toml", bit_depth=16, shift="[0, 5]")
        found = Experiment.load(path).manifest
        assert [(each.frames, each.exposure_s, each.temperature_c) for each in found.dark] == [
            (["dark-0.fits", "dark-3.fits"], 1.0, -10.0),
            (["dark-1.fits", "dark-4.fits"], 4.0, -10.1),
            ("dark-2.fits", 1.0, -20.0),
        ]

    @pytest.mark.parametrize("bias", ["Bias Frame", "zero"])
    def test_headers_say_which_images_are_dark(self, run, tmp_path, bias):
        """As capture programs write them: one name, and the type in the header."""
        types = ["Dark Frame", bias, "Dark Frame", "Light Frame", "FLAT"]
        for k, each in enumerate(types):
            write_fits(tmp_path / f"img_{k:04}.fits", 1.0, level=100 + k, IMAGETYP=each)
        write_fits(tmp_path / "dark/0.fits", 1.0, level=200, OBSTYPE="OBJECT")
        write_fits(tmp_path / "hole/0.fits", 1.0, level=201, FRAME="dark")
        status, _, err = run("init", "experiment", tmp_path)
        assert status == 0
        assert f"not used: 'img_0001.fits' (is '{bias}' by its header (IMAGETYP))" in err
        found = tomllib.loads((tmp_path / "experiment.toml").read_text())
        assert [each["frames"] for each in found["dark"]] == [
            ["img_0000.fits", "img_0002.fits", "hole/0.fits"]
        ]
        assert [each["frames"] for each in found["exposure"]] == [
            ["img_0003.fits", "img_0004.fits"],
            "dark/0.fits",
        ]

    @pytest.mark.parametrize("suffix", [".fits.gz", ".FITS.gz"])
    def test_examples_beside_compressed_images_are_of_their_format(self, run, tmp_path, suffix):
        for k, name in enumerate(("dark", "p0", "p1")):
            write_fits(tmp_path / name / f"a{suffix}", 1.0, level=100 + k)
        assert run("init", "experiment", tmp_path)[0] == 0
        assert '"hole/p1-before.fits"' in (tmp_path / "experiment.toml").read_text()

    def test_darks_of_unknown_times_are_asked_for_by_folder(self, run, tmp_path):
        for k, name in enumerate(("dark-a/0", "dark-a/1", "dark-b/0", "dark-b/1", "p0/0", "p1/0")):
            write(tmp_path / f"{name}.tif", 100 + k)
        assert run("init", "experiment", tmp_path)[0] == 0
        found = tomllib.loads((tmp_path / "experiment.toml").read_text())["dark"]
        assert found == [
            {"frames": "dark-a/*.tif", "exposure_s": "?"},
            {"frames": "dark-b/*.tif", "exposure_s": "?"},
        ]

    def test_images_of_a_hole_belong_to_the_exposures_of_their_folder(self, run, tmp_path):
        for k, name in enumerate(("A/dark", "A/p0/0", "A/p1/0", "B/p1/0")):
            write(tmp_path / f"{name}.tif", 100 + k)
        for k, name in enumerate(("A/hole-p1-before", "A/hole-p1-after", "C/hole/p1-before")):
            write(tmp_path / f"{name}.tif", 200 + k)
        status, _, err = run("init", "experiment", tmp_path)
        assert status == 0
        text = (tmp_path / "experiment.toml").read_text()
        own, other = (each for each in tomllib.loads(text)["exposure"] if "p1" in each["frames"])
        assert own["aperture_before"] == "A/hole-p1-before.tif"
        assert own["aperture_after"] == "A/hole-p1-after.tif"
        assert other["shift"] == "?"
        assert "C/hole/p1-before.tif: belongs to no exposure by its name\n" in text
        assert "not used: 'C/hole/p1-before.tif' (belongs to no exposure" in err

    def test_raw_files_of_cameras_hold_their_bit_depth_and_black_level(self, run, tmp_path):
        for k in range(2):
            write_dng(tmp_path / f"p{k}.dng", np.full((100, 122), 100 + k, np.uint16))
        assert run("init", "experiment", tmp_path)[0] == 0
        path = filled(tmp_path / "experiment.toml", shift="[0, 5]")
        assert Experiment.load(path).manifest.dark is None

    def test_raw_files_beside_a_saved_dark_hold_their_level_and_time(self, run, tmp_path):
        for k, name in enumerate(("dark", "p0", "p1")):
            write_dng(tmp_path / f"{name}.dng", np.full((100, 122), 100 + k, np.uint16))
        equipix.average(tmp_path / "dark.dng").save(tmp_path / "dark.tif")
        (tmp_path / "dark.dng").unlink()
        assert run("init", "experiment", tmp_path)[0] == 0
        text = (tmp_path / "experiment.toml").read_text()
        assert "bit_depth" not in tomllib.loads(text)["sensor"]
        assert "exposure_s = 0.02\n" in text

    def test_a_blank_is_refused_by_name(self, run, folders):
        run("init", "experiment", folders)
        with pytest.raises(
            equipix.errors.FileError, match=r"'bit_depth' .* holds '\?', expected a"
        ):
            Experiment.load(folders / "experiment.toml")


class TestLevels:
    def test_runs_when_it_is_filled_in(self, run, folders):
        assert run("init", "levels", folders)[0] == 0
        path = filled(folders / "levels.toml", bit_depth=16)
        assert LevelExperiment.load(path).manifest.names == ["20C", "40C"]
        assert LevelExperiment.load(path).run().levels.shape == (2,)

    def test_beside_the_images_of_another_folder(self, run, folders, tmp_path):
        path = tmp_path / "other/levels.toml"
        path.parent.mkdir()
        assert run("init", "levels", folders, "-o", path)[0] == 0
        assert len(LevelExperiment.load(filled(path, bit_depth=16)).files()) == 9

    @pytest.mark.parametrize("count", [1, 3])
    def test_numbered_files_alone_are_levels(self, run, tmp_path, count):
        for k in range(11):
            write(tmp_path / f"level[1] {k}.tif", 200 + k, count)
        assert run("init", "levels", tmp_path)[0] == 0
        found = LevelExperiment.load(filled(tmp_path / "levels.toml", bit_depth=16)).manifest
        assert found.dark is None
        assert [each.frames for each in found.level] == [f"level[1] {k}.tif" for k in range(11)]

    def test_series_are_told_apart_by_the_text_before_the_last_number(self, run, tmp_path):
        for k in range(3):
            for name in ("p1-", "p2-", "p", "p-dark-"):
                write(tmp_path / f"{name}{k}.tif", 100 + k)
        assert run("init", "levels", tmp_path)[0] == 0
        found = LevelExperiment.load(filled(tmp_path / "levels.toml", bit_depth=16)).manifest
        assert found.dark[0].frames == "p-dark-*.tif"
        assert {each.name: each.frames for each in found.level} == {
            # A glob p*.tif would find the others too.
            "p": ["p0.tif", "p1.tif", "p2.tif"],
            "p1": "p1-*.tif",
            "p2": "p2-*.tif",
        }

    def test_saved_averages_are_levels_and_other_results_are_left_out(self, run, tmp_path):
        for k in (1, 2):
            frames = np.random.default_rng(k).poisson(100 * k, (4, *SHAPE)).astype(np.uint16)
            equipix.average(frames).save(tmp_path / f"mean{k}.tif")
        flat = equipix.Polynomial(np.ones((2, *SHAPE)), np.zeros(SHAPE, np.uint32))
        flat.save(tmp_path / "flat.tif")
        (tmp_path / "notes.txt").write_text("none")
        status, out, err = run("init", "levels", tmp_path, "--json")
        assert status == 0
        assert json.loads(out)["files_not_used"] == 1
        assert "not used: 'flat.tif' (holds a polynomial, expected raw frames); " in err
        found = LevelExperiment.load(filled(tmp_path / "levels.toml", bit_depth=16)).manifest
        assert [each.frames for each in found.level] == ["mean1.tif", "mean2.tif"]

    def test_what_was_made_of_the_frames_is_no_level(self, run, folders):
        """Averages beside their frames, corrected frames, and what is no measurement."""
        run("average", folders / "20C/*.tif", "-o", folders / "mean.tif")
        flat = equipix.Polynomial(np.ones((2, *SHAPE)), np.zeros(SHAPE, np.uint32))
        flat.save(folders.parent / "flat.tif")
        run("correct", folders.parent / "flat.tif", folders / "40C/*.tif", "-o", folders / "done")
        write(folders / "science/0.tif", 900)
        assert run("init", "levels", folders)[0] == 0
        text = (folders / "levels.toml").read_text()
        assert [each["name"] for each in tomllib.loads(text)["level"]] == ["20C", "40C"]
        unused = text.partition("# Images that are not used:\n")[2].splitlines()
        assert unused == [
            *(f"#   done/{k}.tif: holds corrected frames, expected raw ones" for k in range(3)),
            "#   mean.tif: a saved average beside raw frames",
            "#   science/0.tif: no frames of the sensor by its name",
        ]

    def test_names_may_hold_control_characters(self, run, tmp_path):
        for name in ("a\x7f1.tif", "b\n1.tif"):
            write(tmp_path / name, 100)
            (tmp_path / f"no{name}").write_bytes(b"no image")
        assert run("init", "levels", tmp_path)[0] == 0
        content = tomllib.loads((tmp_path / "levels.toml").read_text())
        assert [each["frames"] for each in content["level"]] == ["a\x7f1.tif", "b\n1.tif"]


class TestCamera:
    @pytest.mark.parametrize("darks", [1, 3])
    def test_pairs_light_and_dark(self, run, tmp_path, darks):
        for k in range(3):
            for j in range(2):
                write(tmp_path / f"bright/{k}-{j}.tif", 100 * k + 50 + j)
        for k in range(darks):
            write(tmp_path / f"dark/{k}.tif", 10 + k, 2)
        assert run("init", "camera", tmp_path)[0] == 0
        path = filled(tmp_path / "camera.toml", bit_depth=16, exposure_s=0.01, photons=100)
        found = CameraExperiment.load(path).manifest
        assert found.spatial is None
        assert [each.frames for each in found.exposure] == [f"bright/{k}-*.tif" for k in range(3)]
        wanted = [f"dark/{k if darks > 1 else 0}.tif" for k in range(3)]
        assert [each.dark for each in found.exposure] == wanted

    def test_headers_pair_light_and_dark_by_their_exposure_times(self, run, tmp_path):
        for k, time in enumerate((0.1, 0.2, 0.4)):
            for j in range(2):
                write_fits(tmp_path / f"bright/{k}-{j}.fits", time, level=100 * k + 50 + j)
                write_fits(tmp_path / f"dark/{2 - k}-{j}.fits", time, level=10 + 2 * k + j)
        write_fits(tmp_path / "dark/9.fits", 7.0, level=9)
        status, _, err = run("init", "camera", tmp_path)
        assert status == 0
        assert "not used: 'dark/9.fits' (has no counterpart)" in err
        path = filled(tmp_path / "camera.toml", bit_depth=16, photons=100)
        found = CameraExperiment.load(path).manifest.exposure
        assert [each.dark for each in found] == [f"dark/{2 - k}-*.fits" for k in range(3)]
        assert [each.exposure_s for each in found] == [0.1, 0.2, 0.4]

    def test_the_longest_series_is_that_of_the_non_uniformity(self, run, tmp_path):
        for k, count in enumerate((2, 2, 9)):
            write(tmp_path / f"bright/{k}.tif", 100 * k + 50, count)
            write(tmp_path / f"dark/{k}.tif", 10 + k, count)
        assert run("init", "camera", tmp_path)[0] == 0
        path = filled(tmp_path / "camera.toml", bit_depth=16, exposure_s=0.01, photons=100)
        found = CameraExperiment.load(path).manifest
        assert len(found.exposure) == 2
        assert (found.spatial.frames, found.spatial.dark) == ("bright/2.tif", "dark/2.tif")


def test_a_key_that_has_a_default_shows_it():
    text = template(Manifest, "All", {"sensor": {}})
    assert "\n#dark_temperature_tolerance_c = 0.5\n" in text
    assert "\n#rotation = 0\n" in text
    assert "\n#skip_bytes = 0\n" in text


def test_limits_are_read_as_they_are(run, tmp_path):
    assert run("init", "limits", tmp_path)[0] == 0
    assert read_limits(tmp_path / "limits.toml").calibration.sensitivity_std == 0.005


@pytest.mark.parametrize("kind", ["experiment", "levels", "camera", "limits"])
def test_nothing_is_replaced_without_force(run, tmp_path, kind):
    assert run("init", kind, tmp_path)[0] == 0
    path = tmp_path / f"{kind}.toml"
    path.write_text("mine")
    status, out, err = run("init", kind, tmp_path)
    assert (status, out) == (1, "")
    assert "exists: name another output, or replace it with --force" in err
    assert path.read_text() == "mine"
    assert run("init", kind, tmp_path, "--force")[0] == 0
    assert tomllib.loads(path.read_text())


@pytest.mark.parametrize("model", [Manifest, LevelManifest, CameraManifest])
def test_every_key_of_a_template_is_valid_without_its_mark(model):
    """Each commented key, alone or with those that it needs, is one of the schema."""
    text = template(model, "All", {})
    keys = re.sub(r"^#(?! )", "", text, flags=re.MULTILINE)
    content = tomllib.loads(keys)
    with pytest.raises(ValueError, match="give") as caught:
        model.model_validate(content)
    # What excludes each other is all that is wrong: no unknown key, and no wrong example.
    kinds = {each["type"] for each in caught.value.errors()}
    assert kinds <= {"manifest", "too_short"}


@pytest.mark.parametrize("kind", ["experiment", "levels", "camera"])
def test_dark_frames_alone_are_no_light(run, tmp_path, kind):
    """Nor is the name of the folder itself looked at."""
    folder = tmp_path / "darkroom"
    write(folder / "dark.tif", 100, 4)
    assert run("init", kind, folder, "-o", tmp_path / "a.toml")[0] == 0
    assert "darkroom/dark.tif" in (tmp_path / "a.toml").read_text()
    assert '"p1/*.tif"' in (tmp_path / "a.toml").read_text()
    write(folder / "light.tif", 200, 4)
    assert run("init", kind, folder, "-o", tmp_path / "a.toml", "--force")[0] == 0
    assert 'frames = "darkroom/light.tif"' in (tmp_path / "a.toml").read_text()


def test_a_folder_that_does_not_exist_is_wrong_usage(run, tmp_path):
    assert run("init", "levels", tmp_path / "none", "-o", tmp_path / "a.toml")[0] == 2
    assert [*tmp_path.iterdir()] == []


def test_an_empty_folder_gives_an_example(run, tmp_path):
    status, _, err = run("init", "experiment", tmp_path)
    assert status == 0
    words = f"no images were found in '{tmp_path}': the entries for them are examples"
    assert words in err
    assert "no images were found" in (tmp_path / "experiment.toml").read_text()
    found = tomllib.loads((tmp_path / "experiment.toml").read_text())
    assert found["dark"][0]["frames"] == "dark/*.tif"
    assert [each["frames"] for each in found["exposure"]] == ["p0/*.tif", "p1/*.tif"]
