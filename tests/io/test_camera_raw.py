"""Raw files of cameras: counts as the sensor gave them, and what the file holds of it."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import rawpy

import equipix
from equipix.errors import EquipixError, FileError
from equipix.io import camera_raw
from equipix.io.frames import Settings, frame_format, read_frames, settings
from given import write_dng

COUNTS = np.random.default_rng(1).integers(64, 4000, (100, 122)).astype(np.uint16)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_counts_come_back_with_pattern_and_levels(tmp_path, pattern):
    path = write_dng(tmp_path / "a.dng", COUNTS, pattern=pattern, black=(64, 65, 66, 67))
    np.testing.assert_array_equal(read_frames(path), COUNTS[None])
    assert frame_format(path) == ((1, *COUNTS.shape), np.dtype(np.uint16))
    found = camera_raw.sensor_data(path)
    assert found == (((64, 65), (66, 67)), 4095, [pattern[:2], pattern[2:]])
    dark = found.dark((3, 3))
    np.testing.assert_array_equal(dark, [[64, 65, 64], [66, 67, 66], [64, 65, 64]])


def test_the_dark_border_is_left_out(tmp_path):
    path = write_dng(
        tmp_path / "a.dng", COUNTS, black=(64, 65, 66, 67), area=(2, 4, 100, 122), pattern="GRBG"
    )
    with rawpy.imread(str(path)) as raw:
        rows, cols = raw.sizes.height, raw.sizes.width
    assert (rows, cols) >= (96, 116)
    np.testing.assert_array_equal(read_frames(path)[0], COUNTS[2:, 4:][:rows, :cols])
    assert camera_raw.sensor_data(path).black == ((64, 65), (66, 67))


def test_averages_are_those_of_the_counts(tmp_path):
    frames = [COUNTS, COUNTS[::-1], COUNTS[:, ::-1]]
    for k, each in enumerate(frames):
        write_dng(tmp_path / f"{k}.dng", np.ascontiguousarray(each))
    found, wanted = equipix.average(tmp_path / "*.dng"), equipix.average(np.stack(frames))
    for name in ("mean", "variance", "count"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_the_exposure_time_is_read(tmp_path):
    path = write_dng(tmp_path / "a.dng", COUNTS, exposure=(3, 4))
    assert settings(path) == Settings(0.75, None)
    path = write_dng(tmp_path / "b.dng", COUNTS, exposure=None)
    assert settings(path) == Settings()


def test_what_is_no_raw_file_is_named(tmp_path):
    (tmp_path / "a.nef").write_bytes(b"no such thing" * 100)
    with pytest.raises(FileError, match=r"a\.nef: is no \.nef file of a camera .*Unsupported"):
        equipix.average(tmp_path / "a.nef")


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    path = write_dng(tmp_path / "a.dng", COUNTS)
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(EquipixError, match=r"need rawpy, .*pip install 'equipix\[raw\]'"):
        equipix.average(path)
    with pytest.raises(FileError, match=r"none\.dng: does not exist"):
        settings(tmp_path / "none.dng")
