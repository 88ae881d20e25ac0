"""Files: every format against other readers, hostile input, interruption, whole output."""

from __future__ import annotations

import dataclasses
import io as stdio
import json
import os
import signal
import struct
import subprocess
import sys
import textwrap
import time
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

import equipix
from equipix import FrameStatistics, simulate
from equipix.errors import FileError, InputError
from equipix.io.formats import load_pages, save_pages, saved_kind
from equipix.io.frames import header, read_frames
from equipix.io.paths import find_files
from equipix.io.tiff import stream_frames as tiff_frames
from records import rewrite

RNG = np.random.default_rng(20)
WIDE = RNG.integers(0, 65536, (5, 23, 37), dtype=np.uint16)
NARROW = RNG.integers(0, 256, (5, 23, 37), dtype=np.uint8)


def assert_averages(source: object, frames: np.ndarray) -> None:
    """The average of files is, to the bit, that of the frames that were written."""
    result, wanted = equipix.average(source), equipix.average(frames)  # type: ignore[arg-type]
    for name, values in wanted.maps.items():
        np.testing.assert_array_equal(getattr(result, name), values, err_msg=name)


@pytest.mark.parametrize("frames", [NARROW, WIDE], ids=["8", "16"])
@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("layout", [{}, {"rowsperstrip": 4}, {"tile": (16, 32)}], ids=str)
@pytest.mark.parametrize(
    ("compression", "predictor"),
    [(None, 0), ("packbits", 0), ("zlib", 0), ("zlib", 1), ("lzw", 0), ("lzw", 1)],
)
def test_tiff(
    tmp_path: Path,
    frames: np.ndarray,
    byteorder: str,
    layout: dict[str, object],
    compression: str | None,
    predictor: int,
) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(
        path,
        frames,
        byteorder=byteorder,
        compression=compression,
        predictor=bool(predictor),
        photometric="minisblack",
        **layout,
    )
    assert_averages(path, frames)
    np.testing.assert_array_equal(equipix._native.read_file(path, None), frames)
    np.testing.assert_array_equal(np.concatenate(list(tiff_frames(path))), frames)


@pytest.mark.parametrize("frames", [NARROW, WIDE], ids=["8", "16"])
def test_files_of_one_image(tmp_path: Path, frames: np.ndarray) -> None:
    wide = frames.dtype == np.uint16
    for suffix in ("png", "pgm", "tif") if wide else ("png", "pgm", "tif", "bmp", "BMP", "TIFF"):
        for index, frame in enumerate(frames):
            path = tmp_path / f"{suffix}{index}.{suffix}"
            if suffix == "pgm":
                header = b"P5 # made here\n37 23\n%d\n" % (65535 if wide else 255)
                path.write_bytes(header + frame.astype(">u2" if wide else "u1").tobytes())
            else:
                Image.fromarray(frame).save(path)
        np.testing.assert_array_equal(np.asarray(Image.open(path)), frames[-1])
        assert_averages(tmp_path / f"{suffix}*.{suffix}", frames)


def test_plain_pgm_and_12_bits_keep_their_numbers(tmp_path: Path) -> None:
    frame = WIDE[0] % 4096
    numbers = " ".join(map(str, frame.ravel()))
    (tmp_path / "plain.pgm").write_text(f"P2\n37 23\n4095\n{numbers}\n")
    (tmp_path / "raw.pgm").write_bytes(b"P5 37 23 4095\n" + frame.astype(">u2").tobytes())
    tifffile.imwrite(tmp_path / "t.tif", frame)
    Image.fromarray(frame).save(tmp_path / "p.png")
    for path in tmp_path.iterdir():
        np.testing.assert_array_equal(read_frames(path)[0], frame)
    assert_averages(sorted(tmp_path.iterdir()), np.stack([frame] * 4))


@pytest.mark.parametrize(
    ("dtype", "options"),
    [
        ("float32", {}),
        ("float64", {"compression": "zlib"}),
        ("int16", {}),
        ("uint32", {}),
        ("uint16", {"bigtiff": True}),
        ("uint8", {"compression": "zstd"}),
        ("uint16", {"compression": "lzma"}),
    ],
)
def test_other_tiffs_are_left_to_tifffile(
    tmp_path: Path, dtype: str, options: dict[str, object]
) -> None:
    frames = (NARROW // 2).astype(dtype)
    for index in range(2):
        tifffile.imwrite(tmp_path / f"{index}.tif", frames, photometric="minisblack", **options)
    with pytest.raises(FileError, match="not decoded here"):
        equipix._native.read_file(tmp_path / "0.tif", None)
    assert_averages(tmp_path / "*.tif", np.concatenate([frames, frames]))


@pytest.mark.parametrize("options", [{"imagej": True}, {"metadata": {"axes": "TYX"}}], ids=str)
def test_stack_behind_one_directory_is_read_whole(
    tmp_path: Path, options: dict[str, object]
) -> None:
    path = tmp_path / "stack.tif"
    with tifffile.TiffWriter(path, imagej="imagej" in options) as file:
        file.write(
            WIDE,
            photometric="minisblack",
            contiguous=True,
            truncate=True,
            metadata={"axes": "TYX"},
        )
    with tifffile.TiffFile(path) as file:
        assert len(file.pages) == 1
    assert_averages(path, WIDE)


def test_tiff_that_needs_a_codec_says_which_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "z.tif"
    tifffile.imwrite(path, WIDE[0], compression="zstd")

    def missing(*_: object, **__: object) -> None:
        raise ValueError("<COMPRESSION.ZSTD: 50000> requires the 'imagecodecs' package")

    monkeypatch.setattr(tifffile.TiffPage, "asarray", missing)
    with pytest.raises(FileError, match=r"z\.tif.*ZSTD.*pip install 'equipix\[codecs\]'"):
        equipix.average(path)


def png(frame: np.ndarray, **options: object) -> bytes:
    buffer = stdio.BytesIO()
    Image.fromarray(frame).save(buffer, "png", **options)
    return buffer.getvalue()


def tiff(frames: np.ndarray, **options: object) -> bytes:
    buffer = stdio.BytesIO()
    tifffile.imwrite(buffer, frames, **{"photometric": "minisblack", **options})
    return buffer.getvalue()


def pages(*writes: tuple[np.ndarray, dict[str, object]], **options: object) -> bytes:
    buffer = stdio.BytesIO()
    with tifffile.TiffWriter(buffer, **options) as file:
        for frame, details in writes:
            file.write(frame, metadata=None, **{"photometric": "minisblack", **details})
    return buffer.getvalue()


def other(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = stdio.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


RGB = np.zeros((23, 37, 3), np.uint8)
NARROW_IMAGE = Image.fromarray(NARROW[0])
PAM = b"P7\nWIDTH 2\nHEIGHT 1\nDEPTH 1\nMAXVAL 255\nTUPLTYPE GRAYSCALE\nENDHDR\nab"
GREY_APNG = {"save_all": True, "append_images": [Image.fromarray(NARROW[1])]}


@pytest.mark.parametrize("both", [{}, {"bigtiff": True}], ids=["core", "tifffile"])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda o: pages((RGB, {"photometric": "rgb"}), **o), "RGB.*expected one grey channel"),
        (lambda o: pages((WIDE[0], {"photometric": "miniswhite"}), **o), "white at 0"),
        (lambda o: pages((WIDE[0], {}), (WIDE[1, 1:], {}), **o), "22 x 37.*expected 23 x 37"),
        (lambda o: pages((WIDE[0], {}), (NARROW[1], {}), **o), "8.*expected 23 x 37.*16"),
        (lambda o: pages((WIDE[0], {}), (WIDE[1], {"subfiletype": 1}), **o), "reduced copy"),
        (lambda o: pages((WIDE[0], {"subifds": 1}), (WIDE[1], {}), **o), "reduced copy"),
    ],
)
def test_pages_that_are_no_frames_are_refused_both_ways(
    tmp_path: Path, content: object, message: str, both: dict[str, object]
) -> None:
    (tmp_path / "bad.tif").write_bytes(content(both))  # type: ignore[operator]
    with pytest.raises(FileError, match=rf"bad\.tif: .*{message}"):
        equipix.average(tmp_path / "bad.tif")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.tif", b"", "is empty"),
        ("empty.png", b"", "is empty"),
        ("text.tif", b"not an image at all, only words", "not a readable TIFF"),
        ("text.png", b"not an image at all, only words", "not a readable image"),
        ("text.pgm", b"not an image at all, only words", "not a readable image"),
        ("text.bmp", b"not an image at all, only words, and too few of them", ""),
        ("a.jpg", other(NARROW_IMAGE, "jpeg"), "not proportional to light"),
        ("nosuffix", png(NARROW[0]), "expected .tif"),
        ("rgb.png", png(RGB), "expected one grey channel"),
        ("rgb.bmp", other(Image.fromarray(RGB), "bmp"), "BMP file of 8 bits"),
        ("rgb.pgm", b"P6 1 1 255\nabc", "expected a PGM"),
        ("pam.pgm", PAM, "expected a PGM"),
        ("palette.png", other(NARROW_IMAGE.convert("P"), "png"), "expected one grey channel"),
        ("palette.bmp", other(NARROW_IMAGE.convert("RGB").quantize(9), "bmp"), "palette"),
        ("alpha.png", other(NARROW_IMAGE.convert("LA"), "png"), "expected one grey channel"),
        ("clear.png", png(NARROW[0], transparency=3), "expected one grey channel"),
        ("one.png", other(NARROW_IMAGE.convert("1"), "png"), "1 bits, expected 8 or 16"),
        ("moving.png", other(NARROW_IMAGE, "png", **GREY_APNG), "animation"),
        ("two.pgm", b"P5 2 1 255\nabP5 2 1 255\ncd", "goes on after its image"),
        ("short.pgm", b"P5 2 2 255\nabc", "truncated"),
        ("short.pgm", b"P2 2 2 255\n1 2 3", "truncated"),
        ("words.pgm", b"P2 2 1 255\n1 x", "whole numbers"),
        ("much.pgm", b"P2 2 1 255\n1 256", "whole numbers"),
        ("bomb.pgm", b"P5 60000 60000 65535\n1", "claims 60000 x 60000"),
    ],
)
def test_bad_files_are_named(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=rf"{name}: .*{message}"):
        equipix.average(tmp_path / name)


@pytest.mark.parametrize("count", [3, 4])
def test_a_stack_that_tifffile_takes_for_colours_says_how_to_write_it(
    tmp_path: Path, count: int
) -> None:
    path, stack = tmp_path / "stack.tif", np.repeat(WIDE[:1], count, axis=0)
    tifffile.imwrite(path, stack, photometric="rgb", planarconfig="separate")  # its default
    for read in (equipix.average, header):
        with pytest.raises(FileError, match=r"one grey channel: .*photometric='minisblack'$"):
            read(path)
    tifffile.imwrite(path, stack, photometric="minisblack")
    assert equipix.average(path).count.max() == count


def test_files_that_differ_are_named_with_what_was_wanted(tmp_path: Path) -> None:
    for name, frame in {"0.png": WIDE[0], "1.png": WIDE[1, 1:], "2.png": NARROW[0]}.items():
        Image.fromarray(frame).save(tmp_path / name)
    with pytest.raises(FileError, match=r"1\.png.*22 x 37.*expected 23 x 37.*as in .*0\.png"):
        equipix.average([tmp_path / "0.png", tmp_path / "1.png"])
    with pytest.raises(FileError, match=r"2\.png.*8 bits, expected .*16 bits"):
        equipix.average([tmp_path / "0.png", tmp_path / "2.png"])
    (tmp_path / "3.png").symlink_to(os.devnull)
    with pytest.raises(FileError, match=r"3\.png"):
        equipix.average([tmp_path / "0.png", tmp_path / "3.png"])


HOSTILE = {
    "raw.tif": tiff(WIDE),
    "deflate.tif": tiff(WIDE, compression="zlib", predictor=True),
    "lzw.tif": tiff(WIDE, compression="lzw"),
    "tiled.tif": tiff(WIDE, tile=(16, 16)),
    "float.tif": tiff(WIDE.astype(np.float32)),
    "big.tif": tiff(WIDE, bigtiff=True),
    "wide.png": png(WIDE[0]),
    "narrow.bmp": other(NARROW_IMAGE, "bmp"),
    "wide.pgm": b"P5 37 23 65535\n" + WIDE[0].astype(">u2").tobytes(),
}


def average_or_error(path: Path) -> FrameStatistics | None:
    """The average, or None where the file is refused by an error that names it."""
    try:
        return equipix.average(path)
    except FileError as error:
        message = str(error)
    assert path.name in message
    return None


@pytest.mark.parametrize("name", HOSTILE)
def test_truncated_files_never_lose_a_page(tmp_path: Path, name: str) -> None:
    whole, path = HOSTILE[name], tmp_path / name
    path.write_bytes(whole)
    frames = read_frames(path)
    for size in sorted({*range(1, 300, 7), *range(1, len(whole), len(whole) // 60)}):
        path.write_bytes(whole[:size])
        result = average_or_error(path)
        if result is not None:  # what was cut off held no pixels, such as the trailer of a PNG
            np.testing.assert_array_equal(result.count, len(frames))
            np.testing.assert_array_equal(result.mean, equipix.average(frames).mean)


@pytest.mark.parametrize("name", HOSTILE)
def test_flipped_bytes_give_an_error_of_the_package_or_an_average(
    tmp_path: Path, name: str
) -> None:
    whole, path = HOSTILE[name], tmp_path / name
    rng = np.random.default_rng(sum(name.encode()))
    for trial in range(150):
        content = bytearray(whole)
        reach = 400 if trial % 2 else len(whole)
        for position in rng.integers(0, min(reach, len(whole)), 1 + trial % 5):
            content[position] ^= 1 << rng.integers(8)
        path.write_bytes(content)
        result = average_or_error(path)
        if result is not None and name.endswith("png"):  # its checksums find what matters
            np.testing.assert_array_equal(result.mean, WIDE[0])


def endless_tiff(path: Path, count: int) -> None:
    """A TIFF of many pages that all share one deflated strip."""
    frame = np.random.default_rng(0).integers(0, 4096, (582, 782), dtype=np.uint16)
    strip = zlib.compress(frame.tobytes(), 1)
    start = 8 + len(strip) + len(strip) % 2
    entries = [(256, 782), (257, 582), (258, 16), (259, 8), (262, 1), (273, 8), (277, 1)]
    entries += [(278, 582), (279, len(strip))]
    body = struct.pack("<H", len(entries))
    body += b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    size = len(body) + 4
    following = [start + size * (index + 1) for index in range(count - 1)] + [0]
    directories = b"".join(body + struct.pack("<I", offset) for offset in following)
    header = struct.pack("<2sHI", b"II", 42, start)
    path.write_bytes((header + strip).ljust(start, b"\0") + directories)


@pytest.mark.timing
@pytest.mark.parametrize("kind", ["pages", "files", "array"])
def test_ctrl_c_stops_within_half_a_second(
    stops_within: Callable[[float, Callable[[], float]], bool], tmp_path: Path, kind: str
) -> None:
    endless_tiff(tmp_path / "long.tif", 10_000 if kind == "pages" else 1)
    script = """
        import sys, time
        import numpy as np, equipix
        path, kind = sys.argv[1:]
        source = {
            "pages": path,
            "files": [path] * 10_000,
            "array": np.broadcast_to(np.ones((2000, 1500)), (2000, 2000, 1500)),
        }[kind]
        started = False
        def progress(done, total, stage):
            global started
            if not started and done < total / 2:
                started = True
                print("started", flush=True)
        try:
            equipix.average(source, progress=progress)
        except KeyboardInterrupt:
            print(time.time(), flush=True)
        """
    command = [sys.executable, "-c", textwrap.dedent(script), tmp_path / "long.tif", kind]

    def seconds_to_stop() -> float:
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "started\n"
            sent = time.time()
            child.send_signal(signal.SIGINT)
            return float(child.stdout.readline()) - sent

    assert stops_within(0.5, seconds_to_stop)
    assert [path.name for path in tmp_path.iterdir()] == ["long.tif"]


def test_numbers_below_zero_come_first_and_a_hyphen_is_no_sign(tmp_path: Path) -> None:
    ordered = ["-70C.png", "-10C.png", "0C.png", "5C.png", "20C.png"]
    ordered += ["at_-20.png", "at_-3.png", "at_4.png", "day-01-9.png", "day-01-10.png"]
    for name in ordered:
        (tmp_path / name).touch()
    assert [path.name for path in find_files(tmp_path / "*.png")] == ordered


def test_globs_are_in_natural_order(tmp_path: Path) -> None:
    for name in ("f10.png", "f9.png", "f1.png", "g.txt", ".f2.png"):
        (tmp_path / name).touch()
    found = find_files(tmp_path / "*.png")
    assert [path.name for path in found] == ["f1.png", "f9.png", "f10.png"]
    literal = tmp_path / "a[1].png"
    literal.touch()
    assert find_files(str(literal)) == [literal]
    assert find_files([literal, tmp_path / "f?.png"]) == [literal, *found[:2]]
    with pytest.raises(InputError, match="'frames' holds 3, expected a path"):
        equipix.average([literal, 3])  # type: ignore[list-item]
    with pytest.raises(InputError, match="'frames' names no file"):
        read_frames([])


PAGES = {
    "mean": RNG.normal(size=(4, 5)),
    "labels": RNG.integers(-5, 5, (4, 5), dtype=np.int32),
    "other shape": RNG.random((2, 3), dtype=np.float32),
    "count": RNG.integers(0, 2**32, (4, 5), dtype=np.uint32),
    "stack": RNG.integers(0, 2, (3, 4, 5), dtype=np.uint8),
    "stack of one": RNG.normal(size=(1, 4, 5)),
    "after it": RNG.normal(size=(4, 5)).astype(np.float32),
}


@pytest.mark.parametrize("suffix", [".tif", ".tiff", ".npz"])
def test_pages_come_back_with_dtype_name_and_metadata(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"pages{suffix}"
    metadata = {"format": 1, "name": "Müller", "list": [1, 2.5, None]}
    save_pages(path, PAGES, metadata)
    pages, found = load_pages(path)
    assert found == metadata
    assert pages.keys() == PAGES.keys()
    for name, array in PAGES.items():
        assert (pages[name].dtype, pages[name].shape) == (array.dtype, array.shape)
        np.testing.assert_array_equal(pages[name], array)
    if suffix != ".npz":
        with tifffile.TiffFile(path) as file:
            assert file.pages[1].tags["PageName"].value == "labels"
            described = json.loads(file.pages[0].description)
            assert described.pop("crc32") == zlib.crc32(json.dumps(metadata).encode())
            assert described == metadata
            # Any viewer shows the images of a stack one by one.
            stack = [page for page in file.pages if page.tags["PageName"].value == "stack"]
            assert [page.tags["PageNumber"].value for page in stack] == [(0, 3), (1, 3), (2, 3)]
            named = [page for page in file.pages if "stack" not in page.tags["PageName"].value]
            assert not any("PageNumber" in page.tags for page in named)
            # Sizes that differ come last: tifffile compares the first pages with the last one.
            assert [page.shape for page in file.pages].index((2, 3)) == len(file.pages) - 1


@pytest.mark.parametrize(
    "numbers",
    [[(0, 3), (1, 3)], [(1, 2), (0, 2)], [(0, 2), (0, 2)], [(0, 1), None], [None, None]],
)
def test_a_stack_that_lacks_an_image_is_refused(
    tmp_path: Path, numbers: list[tuple[int, int] | None]
) -> None:
    path = tmp_path / "stack.tif"
    with tifffile.TiffWriter(path) as file:
        for number in numbers:
            tags = [(285, "s", 0, "stack", True)]
            tags += [] if number is None else [(297, "H", 2, number, True)]
            file.write(np.ones((4, 5)), metadata=None, description="{}", extratags=tags)
    with pytest.raises(FileError, match="is damaged: the pages named 'stack' are numbered"):
        load_pages(path)


def test_output_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "out.tif"
    save_pages(path, PAGES, {})
    before = path.read_bytes()
    with pytest.raises(FileError, match=r"out\.tif: exists already; force=True"):
        save_pages(path, PAGES, {})
    broken = {**PAGES, "bad": np.array([object()])}
    for target in (path, tmp_path / "new.tif", tmp_path / "new.npz"):
        with pytest.raises((TypeError, ValueError)):
            save_pages(target, broken, {}, force=True)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    save_pages(path, {"mean": PAGES["mean"]}, {}, force=True)
    assert list(load_pages(path)[0]) == ["mean"]
    with pytest.raises(FileError, match=r"there is no folder .*none.: make it first"):
        save_pages(tmp_path / "none" / "out.tif", PAGES, {})
    with pytest.raises(FileError, match="cannot be written"):
        save_pages(path / "out.tif", PAGES, {})
    with pytest.raises(
        InputError, match=r"expected the suffix \.tif, \.npz, \.fits, \.nxs or \.asdf"
    ):
        save_pages(tmp_path / "out.jpg", PAGES, {})
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("path", [3, None, b"out.tif", "out\0.tif"])
def test_what_is_no_name_is_refused(path: object) -> None:
    for call in (lambda: save_pages(path, PAGES, {}), lambda: load_pages(path)):  # type: ignore[arg-type]
        with pytest.raises(InputError, match="'path' holds .*, expected a path"):
            call()


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "a.tif").mkdir()
    for target in ("a.tif", f"{'n' * 300}.tif"):
        with pytest.raises(FileError, match=r"\.tif: (is a folder|cannot be written)"):
            save_pages(tmp_path / target, PAGES, {}, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


def test_the_longest_name_can_be_written_by_many_at_once(tmp_path: Path) -> None:
    path = tmp_path / f"{'n' * 250}.tif"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: save_pages(path, PAGES, {}, force=True), range(40)))
    assert load_pages(path)[0].keys() == PAGES.keys()
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_damaged_statistics_are_refused(tmp_path: Path, suffix: str) -> None:
    path, average = tmp_path / f"a{suffix}", equipix.average(WIDE)
    for changed, message in (
        ({"version": "3"}, "of version 3, this version of equipix reads version 3: make"),
        ({"version": None}, "of version None"),
        ({"arrays": {"mean": average.mean.astype(np.int64)}}, "damaged: array 'mean' is int64"),
        (
            {"arrays": {"count": average.count[1:]}},
            r"damaged: array 'count' is uint32 of shape \(22, 37\)",
        ),
        ({"arrays": {"saturated": None}}, "damaged: array 'saturated' is missing"),
    ):
        average.save(path, force=True)
        rewrite(path, **changed)  # type: ignore[arg-type]
        with pytest.raises(FileError, match=rf"a\{suffix}: .*{message}"):
            equipix.load(path)


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_damaged_calibrations_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cal{suffix}"
    shifts = [(0, 0), (0, 1), (1, 0), (0, 0)]
    frames = simulate.exposures(np.ones((8, 9)), simulate.gaussian_beam((8, 9)), shifts)
    cal = equipix.calibrate(frames, shifts)
    left_out = np.zeros((4, 8, 9), bool)
    whole = dataclasses.replace(cal, dark=np.zeros((8, 9), np.float32), rejected=left_out)
    for name, page in (
        ("sensitivity", whole.sensitivity.astype(np.int32)),
        ("flags", whole.flags.astype(np.int32)),
        ("flags", whole.flags[1:]),
        ("component_labels", whole.component_labels[:, 1:]),
        ("dark", whole.dark[1:]),
        ("rejected", left_out[:, 1:]),
        ("rejected", left_out[0]),
        ("rejected", left_out.astype(np.int8)),
    ):
        whole.save(path, force=True)
        rewrite(path, arrays={name: page})
        with pytest.raises(FileError, match=f"is damaged: array '{name}' is"):
            equipix.load(path)
    whole.save(path, force=True)
    assert equipix.load(path).dark is not None


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_foreign_and_broken_files_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.raises(FileError, match=f"a{suffix}"):
        equipix.load(path)
    save_pages(path, PAGES, {"kind": "something"})
    with pytest.raises(FileError, match="holds something, expected .* or frame statistics or .*na"):
        equipix.load(path)
    save_pages(path, PAGES, {"kind": "frame statistics", "version": 99}, force=True)
    with pytest.raises(FileError, match=r"of version 99, .* reads version 3: .* install"):
        equipix.load(path)
    equipix.average(WIDE).save(path, force=True)
    whole = path.read_bytes()
    for size in range(0, len(whole) - 1, len(whole) // 40):
        path.write_bytes(whole[:size])
        with pytest.raises(FileError, match=f"a{suffix}"):
            equipix.load(path)
    tifffile.imwrite(tmp_path / "plain.tif", WIDE[0])
    with pytest.raises(FileError, match=r"plain\.tif"):
        load_pages(tmp_path / "plain.tif")


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_changed_metadata_differ_from_their_checksum(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"kept{suffix}"
    metadata = {"format": 1, "kind": "response", "levels": [1.5, 2.25], "name": "Müller"}
    save_pages(path, PAGES, metadata)
    whole, rng = path.read_bytes(), np.random.default_rng(4)
    text = whole.find(b'{"format"') if suffix == ".tif" else whole.find("{".encode("utf-32-le"))
    for place in range(text, text + len(json.dumps(metadata))):
        changed = bytearray(whole)
        changed[place] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        try:
            found = load_pages(path)[1]
        except FileError as error:
            assert str(path) in str(error)
        else:
            assert found == metadata, place


def test_a_file_without_a_checksum_is_refused(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "old.tif") as file:
        tags = [(285, "s", 0, "mean", True)]
        file.write(PAGES["mean"], metadata=None, description='{"format": 1}', extratags=tags)
    with pytest.raises(FileError, match=r"old\.tif: .*equipix did not write it"):
        load_pages(tmp_path / "old.tif")


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_a_missing_file_is_said_to_be_missing(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(FileError, match=rf"none\{suffix}: .*(does not exist|No such file)"):
        load_pages(tmp_path / f"none{suffix}")
    with pytest.raises(FileError, match=rf"none\{suffix}: .*(does not exist|No such file)"):
        saved_kind(tmp_path / f"none{suffix}")
