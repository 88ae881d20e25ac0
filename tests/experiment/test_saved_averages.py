"""Saved averages in the place of the frames that they were made of."""

from __future__ import annotations

import json

import numpy as np
import pytest

import equipix
from equipix import Experiment, cli, errors
from equipix.io.tiff import write_frames
from given import written_experiment
from records import rewrite

SHAPE, SHIFTS = (48, 64), [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)]


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    folder = tmp_path_factory.mktemp("averages")
    return written_experiment(folder, SHAPE, SHIFTS)


@pytest.fixture(scope="module")
def direct(manifest):
    """The calibration from the frames themselves."""
    return Experiment.load(manifest).run(tolerance=1e-4)


def run(*arguments):
    with pytest.raises(SystemExit) as done:
        cli.main([str(argument) for argument in arguments])
    return done.value.code or 0


def averaged(manifest, folder, *, suffix, subtract, saturation=4095):
    """The experiment with averages, as the command line writes them, in the place of frames."""
    dark, text = manifest.parent / "dark/dark.tif", manifest.read_text()
    names = {"dark/dark.tif": dark, **{f"frames/p{k}.tif": None for k in range(len(SHIFTS))}}
    for name in names:
        output = folder / name.replace("/", "-").replace(".tif", suffix)
        subtracted = ("--dark", dark) if subtract and "frames" in name else ()
        level = ("--saturation", saturation)
        assert run("average", manifest.parent / name, "-o", output, *subtracted, *level) == 0
        text = text.replace(name, output.name)
    path = folder / "experiment.toml"
    path.write_text(text.replace('"aperture/', f'"{manifest.parent}/aperture/'))
    return path


@pytest.mark.parametrize("subtract", [False, True], ids=["raw", "dark subtracted"])
@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_they_calibrate_as_their_frames_do(manifest, direct, tmp_path, suffix, subtract):
    found = Experiment.load(averaged(manifest, tmp_path, suffix=suffix, subtract=subtract)).run(
        tolerance=1e-4
    )
    np.testing.assert_array_equal(found.sensitivity, direct.sensitivity)
    np.testing.assert_array_equal(found.flags, direct.flags)
    np.testing.assert_array_equal(found.dark, direct.dark)


@pytest.mark.parametrize("name", ["step", "dark.step", "saturation", "light_variance"])
@pytest.mark.parametrize("value", ["1", None, True])
def test_a_file_with_something_else_than_numbers_is_refused(tmp_path, name, value):
    raw = np.random.default_rng(4).integers(10, 60, (2, 7, *SHAPE)).astype(np.uint16)
    equipix.average(raw[0], dark=equipix.average(raw[1])).save(tmp_path / "a.npz")
    rewrite(tmp_path / "a.npz", {name: value})
    if value is None and "step" not in name:
        assert getattr(equipix.load(tmp_path / "a.npz"), name) is None
        return
    with pytest.raises(errors.FileError, match=f"damaged: '{name}' is {value!r}, expected float"):
        equipix.load(tmp_path / "a.npz")


def test_an_average_of_an_average_is_that_average(manifest, tmp_path):
    frames, dark = manifest.parent / "frames/p0.tif", manifest.parent / "dark/dark.tif"
    mean, offset = tmp_path / "mean.tif", tmp_path / "dark.npz"
    equipix.average(frames).save(mean)
    equipix.average(dark).save(offset)
    found = equipix.average(mean, dark=equipix.average(offset))
    wanted = equipix.average(frames, dark=equipix.average(dark))
    for name, values in wanted.maps.items():
        np.testing.assert_array_equal(found.maps[name], values)
    # On the command line too, where --dark names an average.
    assert run("average", mean, "--dark", offset, "-o", tmp_path / "again.tif") == 0
    np.testing.assert_array_equal(equipix.load(tmp_path / "again.tif").mean, wanted.mean)


def test_another_dark_is_not_subtracted_a_second_time(manifest, tmp_path):
    frames, dark = manifest.parent / "frames/p0.tif", manifest.parent / "dark/dark.tif"
    equipix.average(frames, dark=equipix.average(dark)).save(tmp_path / "mean.npz")
    for other in (equipix.average(frames), np.zeros(SHAPE)):
        with pytest.raises(errors.InputError, match="another dark than 'dark' is subtracted"):
            equipix.average(tmp_path / "mean.npz", dark=other)


SUBTRACTED = "its dark was already subtracted; 'dark' needs frames or an average without a dark"


def test_a_dark_is_no_average_from_which_one_was_subtracted(manifest, direct, tmp_path, capsys):
    frames, dark = manifest.parent / "frames/p0.tif", manifest.parent / "dark/dark.tif"
    wrong, cal = tmp_path / "wrong.tif", tmp_path / "cal.tif"
    subtracted = equipix.average(dark, dark=equipix.average(dark), saturation=4095)
    subtracted.save(wrong)
    direct.save(cal)
    with pytest.raises(errors.InputError, match=f"^'dark': {SUBTRACTED}"):
        equipix.average(frames, dark=subtracted)
    with pytest.raises(errors.InputError, match=f"^'dark': {SUBTRACTED}"):
        direct.correct(np.ones(SHAPE), dark=subtracted)
    toml = manifest.with_name("wrong-dark.toml")
    toml.write_text(manifest.read_text().replace("dark/dark.tif", str(wrong)))
    for command in (("average", frames), ("correct", cal, frames)):
        assert run(*command, "--dark", wrong, "-o", tmp_path / "out.tif") == 1
        words = SUBTRACTED.replace("'dark'", "--dark")
        assert f"{wrong}: {words}" in capsys.readouterr().err
    assert run("calibrate", toml, "-o", tmp_path / "out.tif") == 1
    assert f"[dark] {wrong}: {SUBTRACTED}" in capsys.readouterr().err
    assert not (tmp_path / "out.tif").exists()


def test_another_saturation_level_is_refused(manifest, tmp_path):
    path = averaged(manifest, tmp_path, suffix=".npz", subtract=False, saturation=4000)
    with pytest.raises(errors.FileError, match=r"level 4000, expected 4095: .*--saturation 4095\)"):
        Experiment.load(path).run()


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_averages_are_not_mixed_with_frames(manifest, tmp_path, suffix):
    frames, mean = manifest.parent / "frames/p0.tif", tmp_path / f"mean{suffix}"
    equipix.average(frames).save(mean)
    with pytest.raises(errors.FileError, match=f"mean{suffix}: holds averaged frames, which can"):
        equipix.average([mean, frames])


def test_an_average_of_another_shape_is_named(manifest, tmp_path):
    path = averaged(manifest, tmp_path, suffix=".npz", subtract=False)
    equipix.average(np.ones((2, 20, 30))).save(tmp_path / "frames-p1.npz", force=True)
    with pytest.raises(errors.FileError, match=r"frames-p1\.npz: holds averaged .*\(20, 30\)"):
        Experiment.load(path).run()


def test_arrays_that_are_no_averages_are_named(tmp_path, capsys):
    np.savez(tmp_path / "arrays.npz", values=np.ones((3, 3)))
    assert run("average", tmp_path / "arrays.npz", "-o", tmp_path / "mean.tif", "--json") == 1
    assert "arrays.npz: holds neither a correction" in capsys.readouterr().err
    equipix.average(np.ones((2, 3, 3))).save(tmp_path / "one.npz")
    assert run("inspect", tmp_path / "one.npz", "--json") == 0
    assert json.loads(capsys.readouterr().out)["saturation"] is None


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_what_equipix_saved_is_no_raw_frame(manifest, direct, tmp_path, capsys, suffix):
    frames = manifest.parent / "frames/p0.tif"
    cal, mean = tmp_path / f"cal{suffix}", tmp_path / f"mean{suffix}"
    direct.save(cal)
    equipix.average(frames).save(mean)
    toml = manifest.with_name("saved.toml")
    toml.write_text(manifest.read_text().replace("frames/p1.tif", str(cal)))
    hole = manifest.with_name("hole.toml")
    hole.write_text(manifest.read_text().replace("aperture/p1-after.tif", str(mean)))
    for command, file, kind in [
        (("average", cal), cal, "a calibration"),
        (("average", frames, cal), cal, "a calibration"),
        (("correct", cal, mean), mean, "frame statistics"),
        (("correct", cal, cal), cal, "a calibration"),
        (("correct", cal, frames, "--dark", cal), cal, "a calibration"),
        (("calibrate", toml), cal, "a calibration"),
        (("calibrate", hole), mean, "frame statistics"),
    ]:
        assert run(*command, "-o", tmp_path / "out.tif") == 1, command
        assert f"error: {file}: holds {kind}, expected raw frames" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_the_limit_of_rejection_is_kept(tmp_path, capsys, suffix):
    frames = np.random.default_rng(1).normal(1000, 5, (2, 16, 30, 40))
    plain, path = equipix.average(frames[0]), tmp_path / f"mean{suffix}"
    dark = equipix.average(frames[1] - 900, reject=4)
    mean = equipix.average(frames[0], dark=dark, reject=5.5)
    assert (plain.reject, mean.reject, dark.reject) == (None, 5.5, 4.0)
    mean.save(path)
    read = equipix.load(path)
    assert (read.reject, read.dark.reject) == (5.5, 4.0)
    assert run("inspect", path, "--json") == 0
    assert json.loads(capsys.readouterr().out)["rejected_beyond_sigmas"] == 5.5
    plain.save(path, force=True)
    assert equipix.load(path).reject is None
    assert run("inspect", path) == 0
    assert "rejected" not in capsys.readouterr().out


def test_the_command_line_names_frames_darker_than_their_dark(tmp_path, capsys):
    rng = np.random.default_rng(1)
    for name, level in (("dark", 100), ("drifted", 120), ("light", 1000)):
        frames = np.rint(level + rng.standard_normal((4, 20, 30))).astype(np.uint16)
        write_frames(tmp_path / f"{name}.tif", frames, nbytes=0)

    def said(frames, dark):
        arguments = ["average", f"{tmp_path}/{frames}.tif", "--dark", f"{tmp_path}/{dark}.tif"]
        with pytest.raises(SystemExit) as done:
            cli.main([*arguments, "-o", f"{tmp_path}/mean.npz", "--force"])
        assert not done.value.code
        return capsys.readouterr().err

    assert "darker than --dark by 900 of 1000 DN" in said("dark", "light")
    assert said("light", "dark") == said("dark", "drifted") == ""
