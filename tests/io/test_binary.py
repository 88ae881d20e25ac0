"""Frames as bare bytes, packed or not, whose layout stands behind the name of the file."""

from __future__ import annotations

import re

import numpy as np
import pytest

import equipix
from equipix import cli
from equipix.errors import FileError
from equipix.io.frames import frame_format, read_frames

BITS = {"Mono8": 8, "Mono10": 10, "Mono10p": 10, "Mono12": 12, "Mono12p": 12, "Mono14": 14}
BITS |= {"Mono16": 16}


def frames_of(pixel, shape=(3, 7, 9)):
    return np.random.default_rng(1).integers(0, 2 ** BITS[pixel], shape, dtype=np.uint16)


def packed(frame, bits):
    """Bits of the pixels one after another, the lowest first, in plain Python."""
    stream = [int(value) >> bit & 1 for value in frame.ravel() for bit in range(bits)]
    stream += [0] * (-len(stream) % 8)
    return bytes(
        sum(bit << place for place, bit in enumerate(stream[start : start + 8]))
        for start in range(0, len(stream), 8)
    )


def written(pixel, frame, big=False):
    if pixel.endswith("p"):
        return packed(frame, BITS[pixel])
    if pixel == "Mono8":
        return frame.astype("u1").tobytes()
    return frame.astype(">u2" if big else "<u2").tobytes()


@pytest.mark.parametrize("pixel", BITS)
@pytest.mark.parametrize("shape", [(3, 7, 9), (2, 4, 8), (1, 1, 1), (2, 1, 3)])
def test_frames_come_back(tmp_path, pixel, shape):
    frames = frames_of(pixel, shape)
    (tmp_path / "a.raw").write_bytes(b"".join(written(pixel, each) for each in frames))
    path = tmp_path / f"a.raw:{shape[1]}x{shape[2]}:{pixel}"
    np.testing.assert_array_equal(read_frames(path), frames)
    dtype = np.dtype("u1" if pixel == "Mono8" else "u2")
    assert frame_format(path) == (shape, dtype)
    assert read_frames(path).dtype == dtype


def test_two_pixels_of_mono12p_are_three_bytes_as_in_the_convention(tmp_path):
    """Byte 0 is the low byte of pixel 0; byte 1 has its high bits below the low ones of pixel 1."""
    (tmp_path / "a.bin").write_bytes(bytes([0xBC, 0xFA, 0xDE]))
    assert read_frames(tmp_path / "a.bin:1x2:Mono12p").tolist() == [[[0xABC, 0xDEF]]]


@pytest.mark.parametrize("pixel", ["Mono12p", "Mono16"])
def test_bytes_before_and_between_frames_are_skipped(tmp_path, pixel):
    frames = frames_of(pixel)
    big = pixel == "Mono16"
    data = b"head" + b"gap".join(written(pixel, each, big) for each in frames)
    (tmp_path / "a.raw").write_bytes(data)
    path = f"{tmp_path}/a.raw:7x9:{pixel}:skip=4:gap=3{':big' if big else ''}"
    np.testing.assert_array_equal(read_frames(path), frames)


def test_averages_are_those_of_the_array_on_the_command_line_too(tmp_path):
    frames = frames_of("Mono12p")
    for k, each in enumerate(frames):
        (tmp_path / f"f{k}.raw").write_bytes(written("Mono12p", each))
    names = f"{tmp_path}/f*.raw:7x9:Mono12p"
    with pytest.raises(SystemExit, match="0"):
        cli.main(["average", names, "-o", str(tmp_path / "mean.npz")])
    found, wanted = equipix.load(tmp_path / "mean.npz"), equipix.average(frames)
    for name in ("mean", "variance", "count"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        (
            "480x640:Mono12p",
            "holds 614400 bytes, but 1 frame of 480 x 640 (rows x columns) Mono12p takes 460800:",
        ),
        ("480x640:Mono16:skip=8", "but 1 frame of .* takes 614408, skipped 8 and gaps of 0 incl"),
        ("100x1000:Mono16", "but 3 frames of 100 x 1000 .* Mono16 take 600000:"),
        ("1000x1000:Mono8", "but 1 frame of .* takes 1000000: correct the layout, or copy"),
        ("480x640:Mono12Packed", "with one of Mono8, .*, Mono12p"),
        ("480x640:Mono12p:big", "Mono12p is packed from the lowest bit on: leave out ':big'"),
        ("480x0:Mono8", "names no layout, expected rows x columns"),
        ("480x640:Mono12", "frame 0 holds 65535, above 4095, .* of Mono12: correct the order of"),
    ],
)
def test_a_wrong_layout_is_named_with_what_the_file_holds(tmp_path, layout, words):
    (tmp_path / "a.raw").write_bytes(b"\xff" * 614_400)
    pattern = words if ".*" in words or "(" not in words else re.escape(words)
    with pytest.raises(FileError, match=pattern):
        equipix.average(f"{tmp_path}/a.raw:{layout}")


def test_a_missing_file_and_an_empty_one_are_named(tmp_path):
    (tmp_path / "a.raw").touch()
    with pytest.raises(FileError, match=r"name the layout, as in a\.raw:480x640:Mono16"):
        equipix.average(tmp_path / "a.raw")
    for name, words in (("a", "holds 0 bytes"), ("b", "b.raw:7x9:Mono8: does not exist")):
        with pytest.raises(FileError, match=words):
            equipix.average(tmp_path / f"{name}.raw:7x9:Mono8")
