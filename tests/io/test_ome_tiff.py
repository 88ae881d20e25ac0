"""OME-TIFF: planes of one channel over time or depth are frames, others are refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

import equipix
from equipix import cli
from equipix.errors import FileError
from equipix.io.frames import frame_format, read_frames

SIZES = {"T": 3, "Z": 4, "C": 2}


def write(path, axes, **options):
    shape = (*(SIZES[axis] for axis in axes), 16, 20)
    planes = np.random.default_rng(1).integers(0, 4000, shape).astype(np.uint16)
    tifffile.imwrite(
        path, planes, photometric="minisblack", metadata={"axes": f"{axes}YX"}, **options
    )
    return planes


@pytest.mark.parametrize("axes", ["", "T", "Z"])
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"dtype": np.uint16}])
def test_planes_of_one_channel_are_frames(tmp_path, axes, options):
    path = tmp_path / "a.ome.tif"
    planes = write(path, axes, **options).reshape(-1, 16, 20)
    np.testing.assert_array_equal(read_frames(path), planes)
    np.testing.assert_array_equal(equipix.average(path).mean, planes.mean(axis=0))
    assert frame_format(path)[0] == planes.shape


def test_one_time_and_channel_of_several_slices(tmp_path):
    """Axes of one plane decide nothing."""
    planes = np.random.default_rng(1).integers(0, 9, (1, 4, 1, 16, 20)).astype(np.uint8)
    tifffile.imwrite(
        tmp_path / "a.ome.tif", planes, photometric="minisblack", metadata={"axes": "TZCYX"}
    )
    np.testing.assert_array_equal(read_frames(tmp_path / "a.ome.tif"), planes[0, :, 0])


@pytest.mark.parametrize("axes", ["C", "TC", "ZC", "TZ", "TZC"])
@pytest.mark.parametrize("suffix", [".ome.tif", ".OME.TIFF"])
def test_channels_and_stacks_over_time_are_refused(tmp_path, capsys, axes, suffix):
    path = tmp_path / f"a{suffix}"
    write(path, axes, ome=True)
    words = rf"a{suffix}: holds pages of axes {axes}YX \(.* x 16 x 20\), expected one channel over"
    for work in (equipix.average, read_frames, frame_format):
        with pytest.raises(FileError, match=words):
            work(path)
    with pytest.raises(SystemExit, match="1"):
        cli.main(["average", str(path), "-o", str(tmp_path / "mean.npz")])
    assert "expected one channel over time (T) or depth (Z)" in capsys.readouterr().err


def test_several_images_are_refused(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.ome.tif") as file:
        for _ in range(2):
            file.write(np.zeros((16, 20), np.uint8), photometric="minisblack")
    with pytest.raises(FileError, match="holds 2 images, the first of axes YX"):
        equipix.average(tmp_path / "a.ome.tif")
