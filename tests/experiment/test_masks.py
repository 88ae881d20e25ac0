"""Pixels that must not be used: mask files, regions of experiment.toml, averages with a mask."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import tifffile
from astropy.io import fits

import equipix
from equipix import Experiment, Flag, cli, errors, simulate
from equipix.io.formats import read_mask
from given import written_experiment

SHAPE, SHIFTS = (48, 64), [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)]


@pytest.fixture(scope="module")
def manifest(tmp_path_factory):
    """An experiment with given shifts."""
    folder = tmp_path_factory.mktemp("masks")
    path = written_experiment(folder, SHAPE, SHIFTS, dead=0, hot=0)
    text = path.read_text()
    for k, (row, col) in enumerate(SHIFTS):
        text = re.sub(
            rf'aperture_before = "aperture/p{k}-.*\n.*-after.tif"', f"shift = [{row}, {col}]", text
        )
    path.write_text(text)
    return path


@pytest.fixture
def edited(manifest, tmp_path):
    """The manifest with lines added to [sensor] or after it; its files where they were."""

    def edit(lines):
        text = manifest.read_text().replace("bit_depth = 12\n", f"bit_depth = 12\n{lines}\n")
        path = tmp_path / "experiment.toml"
        path.write_text(re.sub(r'"(\w+/[^"]*\.tif)"', rf'"{manifest.parent}/\1"', text))
        return path

    return edit


def write_mask(path, mask):
    """A mask in the format of the suffix."""
    if path.suffix == ".npy":
        np.save(path, mask)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, mask.astype(np.uint8) * 255, photometric="minisblack")
    elif path.suffix == ".fits":
        fits.writeto(path, mask.astype(np.uint8))
    else:
        header = f"P5\n{mask.shape[1]} {mask.shape[0]}\n255\n".encode()
        path.write_bytes(header + mask.astype(np.uint8).tobytes())
    return path


def excluded(calibration):
    """Pixels that the calibration has not used."""
    return (calibration.flags & Flag.NO_FLAT_FIELD) != 0


@pytest.fixture
def mask():
    mask = np.zeros(SHAPE, bool)
    mask[10:14, 20:31] = True
    return mask


@pytest.mark.parametrize("suffix", [".npy", ".tif", ".pgm", ".fits"])
def test_a_mask_file_excludes_pixels(edited, tmp_path, mask, suffix):
    write_mask(tmp_path / f"mask{suffix}", mask)
    experiment = Experiment.load(edited(f'mask = "mask{suffix}"'))
    found = experiment.run(tolerance=1e-3)
    np.testing.assert_array_equal(excluded(found), mask)
    assert f"mask{suffix}" in found.metadata["inputs"]


def test_regions_exclude_pixels(edited):
    lines = (
        "[[sensor.region]]\nrows = [2, 5]\n[[sensor.region]]\nrows = [8, 12]\ncols = [60, 64]\n"
        "[[sensor.region]]\ncentre = [30, 31.5]\nradius = 4.5\n"
        "[[sensor.region]]\ncols = [1, 64]\noutside = true"
    )
    found = Experiment.load(edited(lines)).run(tolerance=1e-3)
    wanted = np.zeros(SHAPE, bool)
    wanted[2:5] = wanted[8:12, 60:] = wanted[:, 0] = True
    for row, col in np.ndindex(SHAPE):
        wanted[row, col] |= (row - 30) ** 2 + (col - 31.5) ** 2 <= 4.5**2
    np.testing.assert_array_equal(excluded(found), wanted)


def test_masks_add_up(edited, tmp_path, mask):
    """That of the caller, that of the file and the regions."""
    write_mask(tmp_path / "mask.npy", mask)
    path = edited('mask = "mask.npy"\n[[sensor.region]]\nrows = [0, 2]')
    other = np.zeros(SHAPE, bool)
    other[40, 50] = True
    found = Experiment.load(path).run(mask=other, tolerance=1e-3)
    wanted = mask | other
    wanted[:2] = True
    np.testing.assert_array_equal(excluded(found), wanted)


def run(*arguments):
    with pytest.raises(SystemExit) as done:
        cli.main([str(argument) for argument in arguments])
    return done.value.code or 0


def test_the_command_line_takes_a_mask(manifest, tmp_path, mask, capsys):
    file = write_mask(tmp_path / "mask.tif", mask)
    output = tmp_path / "cal.npz"
    command = ("calibrate", manifest, "-o", output, "--tolerance", "1e-3")
    assert run(*command, "--mask", file) == 0
    np.testing.assert_array_equal(excluded(equipix.load(output)), mask)
    capsys.readouterr()
    frames, mean = manifest.parent / "frames/p0.tif", tmp_path / "mean.tif"
    assert run("average", frames, "-o", mean, "--mask", file, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    saved = equipix.load(mean)
    np.testing.assert_array_equal(np.isnan(saved.mean), mask)
    assert found["mean"] == pytest.approx(np.nanmean(saved.mean))
    assert run("average", frames, "-o", file, "--mask", file, "--force") == 1
    assert "one of the inputs" in capsys.readouterr().err


def test_a_mask_of_another_shape_is_named_by_its_file(manifest, tmp_path, capsys):
    file, frames = write_mask(tmp_path / "wrong.npy", np.zeros((3, 4), bool)), "frames/p0.tif"
    for command in (("calibrate", manifest), ("average", manifest.parent / frames)):
        assert run(*command, "-o", tmp_path / "out.tif", "--mask", file) == 1
        assert f"error: {file}: --mask " in capsys.readouterr().err


def test_a_mask_of_whole_numbers_is_refused_with_the_remedy():
    frames, mask = np.ones((3, 24, 25)), np.zeros((24, 25), int)
    with pytest.raises(errors.InputError, match="'mask' .* give mask != 0"):
        equipix.calibrate(frames, SHIFTS[:3], mask=mask)
    with pytest.raises(errors.InputError, match="'mask' .* give mask != 0"):
        equipix.average(frames, mask=mask)


def test_averages_with_a_mask_calibrate(mask):
    """The masked pixels are those of no use; the others have the M of a calibration with mask."""
    rng = np.random.default_rng(5)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    virtual = simulate.experiment(
        truth, simulate.gaussian_beam(SHAPE, width=150), SHIFTS, frames=6, dead=0, hot=0, rng=rng
    )
    frames = [list(virtual.frames(k)) for k in range(len(SHIFTS))]
    dark = equipix.average(virtual.dark())
    masked = equipix.calibrate(
        [equipix.average(each, dark=dark, mask=mask) for each in frames], SHIFTS
    )
    np.testing.assert_array_equal(excluded(masked), mask)
    averages = [equipix.average(each, dark=dark) for each in frames]
    given = equipix.calibrate(averages, SHIFTS, mask=mask)
    # The noise models differ by the bins of pixels that they are fitted to: some per cent of the
    # weights, which change M by less than a tenth of its noise of 1e-3.
    np.testing.assert_allclose(masked.sensitivity[~mask], given.sensitivity[~mask], rtol=1e-3)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ('mask = "none.png"', r"none\.png: does not exist"),
        ('mask = "wrong.npy"', r"wrong\.npy: is a mask of shape \(3, 4\), expected \(48, 64\)"),
        ('mask = "cube.npy"', r"cube\.npy: holds float64 of shape \(2, 48, 64\), expected one"),
        ("mask = 3", r"'mask' in \[sensor\] holds 3, expected an image \(TIFF"),
        ("region = 3", r"'region' in \[sensor\] holds 3, expected tables"),
        ("[[sensor.region]]\nrows = [5]", r"'rows' in \[\[sensor.region\]\] 1 holds \[5\]"),
        ("[[sensor.region]]\nrows = [5, 5]", r"\[5, 5\] holds no pixel.* in \[\[sensor.region\]\]"),
        ("[[sensor.region]]\nrows = [0, 49]", r"region\]\] 1: 'rows' ends at 49, expected at most"),
        ("[[sensor.region]]\ncentre = [5, 5]", r"give both 'centre' and 'radius'"),
        ("[[sensor.region]]\noutside = true", r"give 'rows', 'cols' or both, or 'centre'"),
        ("[[sensor.region]]\nrow = [1, 2]", r"unknown key 'row' in \[\[sensor.region\]\] 1"),
        ("[[sensor.region]]\nrows = [0, 48]", r"leave no pixel to use"),
        (
            "[[sensor.region]]\nrows = [0, 1]\n[[sensor.region]]\ncentre = [24, 99]\nradius = 9",
            r"region\]\] 2: 'centre' \[24\.0, 99\.0\] and 'radius' 9 name no pixel .* 48 rows and",
        ),
    ],
)
def test_a_wrong_mask_is_refused_by_name(edited, tmp_path, lines, message):
    np.save(tmp_path / "wrong.npy", np.zeros((3, 4)))
    np.save(tmp_path / "cube.npy", np.zeros((2, *SHAPE)))
    with pytest.raises(errors.FileError, match=message):
        Experiment.load(edited(lines)).run()


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY nothing more"])
def test_a_broken_mask_file_is_named(tmp_path, content):
    path = tmp_path / "mask.npy"
    path.write_bytes(content)
    with pytest.raises(errors.FileError, match=r"mask\.npy: cannot be read: .* no \.npy file"):
        read_mask(path)


def test_nan_in_a_mask_is_not_0(tmp_path):
    np.save(tmp_path / "mask.npy", np.array([[0.0, np.nan]]))
    assert read_mask(tmp_path / "mask.npy").tolist() == [[False, True]]
