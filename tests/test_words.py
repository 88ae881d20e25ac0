"""Messages name what is wrong and what to do, in the reader's terms."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import equipix
from equipix import Experiment, cli, errors, simulate
from given import written_experiment

SHAPE, CROSS = (48, 64), equipix.cross_pattern(5, 7)


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    """An experiment with given shifts, fluxes and times."""
    folder = tmp_path_factory.mktemp("words")
    path = written_experiment(folder, SHAPE, CROSS, dead=0)
    text = path.read_text()
    for k, (row, col) in enumerate(CROSS.tolist()):
        images = "".join(
            f'aperture_{when} = "aperture/p{k}-{when}.tif"\n' for when in ("before", "after")
        )
        text = text.replace(images, "") if k else text
        text = text.replace(
            f'frames = "frames/p{k}.tif"\n',
            f'frames = "frames/p{k}.tif"\nshift = [{row}, {col}]\nflux = 1.0\n',
        )
    path.write_text(text)
    return path


@pytest.fixture
def edited(manifest):
    """The manifest with one text replaced by another, beside the first."""
    path = manifest.with_name("edited.toml")

    def edit(old, new, *, encoding="utf-8"):
        text = manifest.read_text()
        assert old in text
        path.write_text(text.replace(old, new), encoding=encoding)
        return path

    yield edit
    path.unlink(missing_ok=True)


def run(*arguments):
    with pytest.raises(SystemExit) as done:
        cli.main([str(argument) for argument in arguments])
    return done.value.code or 0


def test_readings_that_are_not_used_are_named(manifest):
    with (
        pytest.warns(errors.InputWarning, match=r"'flux' in .* is not used.* --flux fit"),
        pytest.warns(errors.IdentifiabilityWarning, match="leave a tilt"),
    ):
        Experiment.load(manifest).run(flux="fit", tolerance=1e-3)


def test_times_that_are_not_used_are_named(edited):
    text = re.sub(
        r"name = \"p(\d)\"\n", r'name = "p\1"\ntime = \1\n', edited("[dark]", "[dark]").read_text()
    )
    path = edited("[dark]", "[dark]")
    path.write_text(text)
    with pytest.warns(errors.InputWarning, match=r"'time' in .* is not used.*--flux linear"):
        Experiment.load(path).run(tolerance=1e-3)


def test_a_byte_order_mark_is_no_part_of_the_text(edited):
    path = edited("[dark]", "[dark]", encoding="utf-8-sig")
    assert len(Experiment.load(path).manifest.exposure) == 5


def test_one_table_in_the_place_of_many(tmp_path):
    path = tmp_path / "experiment.toml"
    path.write_text('[dark]\nframes = "d.tif"\n[exposure]\nname = "a"\nframes = "f.tif"\n')
    with pytest.raises(
        errors.FileError, match=r"\[exposure\] is one table: write \[\[exposure\]\]"
    ):
        Experiment.load(path)


def test_too_few_bits_are_named_and_nothing_is_written(edited, tmp_path, capsys):
    path = edited("bit_depth = 12", "bit_depth = 11")
    assert run("calibrate", path, "-o", tmp_path / "cal.tif", "--tolerance", "1e-3") == 1
    assert "bit_depth" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_fitted_dark_does_not_blame_what_was_not_given():
    frames = [equipix.average(np.random.default_rng(k).normal(9, 1, (4, 20, 30))) for k in range(5)]
    with pytest.raises(errors.InputError, match="noise model, that of averages") as caught:
        equipix.calibrate(frames, CROSS, dark="fit", flux=[1, 1, 1, 1, 2])
    assert "robust" not in str(caught.value)


def test_averages_without_a_dark_are_named(manifest):
    dark = equipix.average(manifest.parent / "dark/dark.tif")
    files = [manifest.parent / f"frames/p{k}.tif" for k in range(5)]
    raw = [equipix.average(file, saturation=4095) for file in files]
    with pytest.warns(errors.InputWarning, match=r"no dark was subtracted .*--dark"):
        equipix.calibrate(raw, CROSS, tolerance=1e-3)
    # A dark that was subtracted, as averages or as an array, raises no warning.
    for offset in (dark, dark.mean):
        frames = [equipix.average(file, saturation=4095, dark=offset) for file in files]
        equipix.calibrate(frames, CROSS, tolerance=1e-3)


def test_arrays_as_cameras_write_them_are_no_signal():
    rng = np.random.default_rng(1)
    signal = simulate.exposures(np.ones(SHAPE), simulate.gaussian_beam(SHAPE, width=60), CROSS)
    raw = np.rint(1000 * signal + 100 + rng.standard_normal(signal.shape))
    for given in (raw.astype(np.uint16), [*raw.astype(np.uint16)]):
        with pytest.warns(errors.InputWarning, match="no dark was subtracted from frames"):
            cal = equipix.calibrate(given, CROSS, tolerance=1e-3)
        assert "raw" in {each.kind for each in cal.findings}
    for dtype in (np.int32, np.float32):
        cal = equipix.calibrate(raw.astype(dtype), CROSS, tolerance=1e-3)
        assert cal.findings == ()


@pytest.mark.parametrize("dark", [None, True])
def test_a_dark_that_is_no_choice(dark):
    with pytest.raises(errors.InputError, match=f"'dark' is {dark}, expected 'subtracted' or"):
        equipix.calibrate(np.ones((5, *SHAPE)), CROSS, dark=dark)


def test_files_that_their_names_belie(manifest, tmp_path, capsys):
    frames = (manifest.parent / "frames/p0.tif").read_bytes()
    for name in ("cal.npz", "mask.npy"):
        (tmp_path / name).write_bytes(frames)
    assert run("inspect", tmp_path / "cal.npz") == 1
    assert (
        run("calibrate", manifest, "-o", tmp_path / "c.tif", "--mask", tmp_path / "mask.npy") == 1
    )
    said = capsys.readouterr().err
    assert "cal.npz: cannot be read: incomplete, damaged, or no .npz file: use a copy" in said
    assert "mask.npy: cannot be read: incomplete, damaged, or no .npy file" in said
    assert "pickle" not in said


def test_inspect_names_the_file(tmp_path, capsys):
    (tmp_path / "cal.png").write_bytes(b"")
    assert run("inspect", tmp_path / "cal.png") == 1
    said = capsys.readouterr().err
    assert "cal.png: ends in '.png', expected the suffix .tif, .npz, .fits" in said
    assert "'path'" not in said
    with pytest.raises(errors.InputError, match="ends in"):
        equipix.load(tmp_path / "mean.txt")


@pytest.mark.parametrize("suffix", [".jpg", ".xyz", ".TOML"])
def test_a_file_of_another_format_is_no_folder_of_corrected_frames(
    manifest, tmp_path, capsys, suffix
):
    frames, output = manifest.parent / "frames/p0.tif", tmp_path / f"x{suffix}"
    assert run("correct", "cal.tif", frames, "-o", output) == 1
    words = f"x{suffix}' ends in '{suffix}', but corrected frames are written as .tif"
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_frames_go_to_a_folder_with_a_dot_in_its_name(manifest, tmp_path):
    frames = manifest.parent / "frames/p0.tif"
    flat = equipix.Polynomial(np.ones((2, *SHAPE)), np.zeros(SHAPE, np.uint32))
    flat.save(tmp_path / "flat.npz")
    output = tmp_path / "run.2"
    output.mkdir()
    assert run("correct", tmp_path / "flat.npz", frames, "-o", output, "--force") == 0
    assert [each.name for each in output.iterdir()] == ["p0.tif"]


def test_a_message_on_the_name_of_a_picture_has_usual_suffixes(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert run("demo", "-o", tmp_path / "x.txt") == 1
    said = capsys.readouterr().err
    assert said.endswith("x.txt' is no picture, expected a suffix such as .png, .pdf or .svg\n")


def test_an_undetermined_tilt_is_said_in_words(tmp_path, capsys):
    frames = simulate.exposures(np.ones(SHAPE), simulate.gaussian_beam(SHAPE), CROSS)
    frames += 1e-3 * np.random.default_rng(1).standard_normal(frames.shape)
    with pytest.warns(errors.IdentifiabilityWarning, match="leave a tilt"):
        cal = equipix.calibrate(frames, CROSS, flux="fit", uncertainty=True, tolerance=1e-3)
    cal.save(tmp_path / "cal.npz")
    assert run("inspect", tmp_path / "cal.npz", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["tilt_std"] == {"rows": None, "cols": None}
    assert told["tilt_is"] == "undetermined along rows and cols, and set to 0"
