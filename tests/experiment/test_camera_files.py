"""Experiments of raw files of cameras, and of bytes whose layout the manifest describes."""

from __future__ import annotations

import re

import numpy as np
import pytest

import equipix
from equipix import Experiment, LevelExperiment, errors, simulate
from equipix.io.frames import read_frames
from equipix.io.tiff import write_frames
from equipix.measured.colour import Colours
from given import write_dng, written_experiment

SHAPE = (64, 80)
SHIFTS = equipix.cross_pattern(5, 7)
BLACK = (64, 68, 68, 60)
SENSOR = '[sensor]\nsaturation = 4095\ncfa = "RGGB"\n\n'


def entry(kind, frames, **keys):
    lines = [f"[[{kind}]]" if kind != "dark" else "[dark]", f'frames = "{frames}"']
    return "\n".join([*lines, *(f"{key} = {value}" for key, value in keys.items())]) + "\n\n"


@pytest.fixture(scope="module")
def truth():
    return simulate.filtered(simulate.paper_sensitivity(SHAPE, rng=1), "RGGB")


@pytest.fixture(scope="module")
def folder(truth, tmp_path_factory):
    """Four frames of each exposure and of the dark, as DNG and as TIFF, and manifests of both."""
    folder, rng = tmp_path_factory.mktemp("raw"), np.random.default_rng(2)
    black = np.tile(np.reshape(BLACK, (2, 2)), (32, 40))
    beam = simulate.gaussian_beam(SHAPE, width=200, amplitude=2000)
    light = [np.zeros(SHAPE), *simulate.exposures(truth, beam, SHIFTS)]
    texts = {"dng": "", "tif": SENSOR}
    for k, each in enumerate(light):
        noise = np.sqrt(9 + 0.25 * each) * rng.standard_normal((4, *SHAPE))
        frames = np.rint(black + each + noise).astype(np.uint16)
        kind, name = ("exposure", f"p{k}") if k else ("dark", "dark")
        keys = {"name": f'"{name}"', "shift": SHIFTS[k - 1].tolist()} if k else {}
        for number, frame in enumerate(frames):
            write_dng(folder / f"{name}-{number}.dng", frame, black=BLACK)
        write_frames(folder / f"{name}.tif", frames, nbytes=frames.nbytes)
        texts["dng"] += entry(kind, f"{name}-*.dng", **keys)
        texts["tif"] += entry(kind, f"{name}.tif", **keys)
    for suffix, text in texts.items():
        (folder / f"{suffix}.toml").write_text(text)
    return folder


def edited(folder, suffix, *changes, name="edited"):
    text = (folder / f"{suffix}.toml").read_text()
    for old, new in changes:
        assert re.search(old, text), old
        text = re.sub(old, new, text, count=1)
    (folder / f"{name}.toml").write_text(text)
    return folder / f"{name}.toml"


def same(one, other):
    for name in ("sensitivity", "dark", "flags", "beam"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_pattern_and_saturation_are_those_of_the_files(folder):
    found, wanted = (Experiment.load(folder / f"{each}.toml").run() for each in ("dng", "tif"))
    same(found, wanted)
    assert found.colour_response == wanted.colour_response
    sensor = found.metadata["sensor"]
    assert (sensor["cfa"], sensor["saturation"]) == ("RGGB", 4095)


def test_what_the_manifest_gives_is_kept(folder):
    sensor = '[sensor]\nbit_depth = 13\ncfa = [["R", "G1"], ["G2", "B"]]\n[dark]'
    found = Experiment.load(edited(folder, "dng", (r"\[dark\]", sensor))).manifest.sensor
    assert found.bit_depth == 13
    assert found.cfa == [["R", "G1"], ["G2", "B"]]


@pytest.mark.parametrize(
    ("given", "level"),
    [("bit_depth = 14", 4095), ("bit_depth = 10", 1023), ("saturation = 5e3", 5000)],
)
def test_bits_alone_do_not_raise_the_level_of_a_file(folder, given, level):
    path = edited(folder, "dng", (r"\[dark\]", f"[sensor]\n{given}\n[dark]"))
    assert Experiment.load(path).manifest.sensor.saturation_level == level


def test_another_pattern_is_refused(folder):
    path = edited(folder, "dng", (r"\[dark\]", '[sensor]\ncfa = "BGGR"\n[dark]'))
    words = "'cfa' in .sensor. holds the colours 'BGGR', but 'dark-0.dng' 'RGGB': correct 'cfa'"
    with pytest.raises(errors.FileError, match=words):
        Experiment.load(path)


def test_files_of_two_patterns_are_refused(folder, tmp_path):
    frame = read_frames(folder / "p1-0.dng")[0]
    write_dng(tmp_path / "p1.dng", frame, pattern="GRBG")
    path = edited(folder, "dng", (r"p1-\*.dng", f"{tmp_path}/p1.dng"))
    words = "'dark-0.dng' holds the colours 'RGGB', but 'p1.dng' 'GRBG': correct 'cfa'"
    with pytest.raises(errors.FileError, match=words):
        Experiment.load(path)


@pytest.mark.parametrize(
    ("given", "agrees"),
    [
        ("RGGB", True),
        ([["R", "G1"], ["G2", "B"]], True),
        ([["a", "b"], ["b", "c"]], True),
        ([["a", "b"], ["c", "d"]], True),
        ("BGGR", False),
        ("GRBG", False),
        ("RGGG", False),
        ([["a", "b"], ["b", "a"]], False),
        ("RGRG/GBGB", True),
        ("RG/", False),
    ],
)
def test_patterns_that_agree(given, agrees):
    assert Colours.of("RGGB").agrees(Colours.of(given)) is agrees


NO_DARK = (r'\[dark\]\nframes = "[^"]*"\n', "")


def test_without_dark_frames_the_black_level_is_the_dark(folder, truth):
    cal = Experiment.load(edited(folder, "dng", NO_DARK)).run(uncertainty=True)
    np.testing.assert_array_equal(cal.dark, np.tile(np.reshape(BLACK, (2, 2)), (32, 40)))
    assert not any(each.kind == "raw" for each in cal.findings)
    levels = ", ".join(f"{each:g}" for each in BLACK)
    assert cal.metadata["darks"] == [f"black level {levels} DN in 'p1-0.dng'"] * len(SHIFTS)
    wanted = cal.sensitivity * 0
    for label, plane in Colours.of("RGGB").planes(SHAPE):
        del label
        wanted[plane] = truth[plane] / truth[plane].mean()
    z = (cal.sensitivity - wanted) / cal.sensitivity_std
    assert np.sqrt(np.nanmean(z**2)) == pytest.approx(1, abs=0.07)
    assert cal.reduced_chi2 == pytest.approx(1, abs=0.06)


def test_frames_without_a_black_level_need_a_dark(folder):
    with pytest.raises(errors.FileError, match="key 'dark' is missing"):
        Experiment.load(edited(folder, "tif", NO_DARK))
    mixed = edited(folder, "dng", NO_DARK, (r"p2-\*.dng", "p2.tif"))
    with pytest.raises(errors.FileError, match="key 'dark' is missing"):
        Experiment.load(mixed)


def test_black_levels_that_differ_are_refused(folder, tmp_path):
    write_dng(tmp_path / "p1.dng", read_frames(folder / "p1-0.dng")[0], black=100)
    path = edited(folder, "dng", NO_DARK, (r"p1-\*.dng", f"{tmp_path}/p1.dng"))
    words = "the black levels of 'p1.dng' and 'p2-0.dng' differ: give .dark. with dark frames"
    with pytest.raises(errors.FileError, match=words):
        Experiment.load(path)


def test_levels_without_a_dark_keep_the_level_without_light(folder):
    text = "".join(entry("level", f"{name}-*.dng") for name in ("dark", "p1"))
    (folder / "levels.toml").write_text(text)
    response = LevelExperiment.load(folder / "levels.toml").run()
    assert response.leaves_offset
    assert response.dark is None
    assert response.saturation == 4095


def packed(frames):
    """Mono12p by NumPy's bits, the lowest first."""
    bits = frames[..., None] >> np.arange(12) & 1
    return np.packbits(bits.astype(np.uint8).reshape(len(frames), -1), axis=1, bitorder="little")


LAYOUT = '[layout]\nshape = [64, 80]\npixel = "Mono12p"\nskip_bytes = 16\n\n[dark]'


@pytest.fixture(scope="module")
def bare(folder, tmp_path_factory):
    """The same frames, those of the exposures packed behind a header of 16 bytes."""
    target = tmp_path_factory.mktemp("bare")
    for name in (f"p{k}" for k in range(1, 6)):
        data = packed(read_frames(folder / f"{name}.tif"))
        (target / f"{name}.raw").write_bytes(bytes(16) + data.tobytes())
    text = (folder / "tif.toml").read_text().replace("[dark]", LAYOUT)
    text = re.sub(r'"(p\d).tif"', r'"\1.raw"', text).replace("dark.tif", f"{folder}/dark.tif")
    (target / "bare.toml").write_text(text)
    return target


def test_bytes_are_frames_by_the_layout_of_the_manifest(folder, bare):
    """Beside a dark that has a format of its own."""
    found, wanted = Experiment.load(bare / "bare.toml").run(), Experiment.load(folder / "tif.toml")
    same(found, wanted.run())
    assert "p1.raw:64x80:Mono12p:skip=16:gap=0" in found.metadata["inputs"]


def test_the_bits_of_the_layout_are_those_of_the_sensor(bare):
    path = edited(bare, "bare", ("saturation = 4095\n", ""))
    assert Experiment.load(path).manifest.sensor.bit_depth == 12


@pytest.mark.parametrize(
    ("words", "change"),
    [
        (r"p1.raw: holds 30736 bytes, but 3 frames of 64 x 90 .* take 25936,", ("80", "90")),
        (r"p1.raw: frame 0 holds \d+, above 4095, the largest value of Mono12", ("12p", "12")),
        (
            r"'pixel' in \[layout\] holds 'Bayer12', expected one of Mono8, Mono10,",
            ("Mono12p", "Bayer12"),
        ),
        (r"'shape' in \[layout\] holds \[80\], expected \[rows, cols\]", ("64, ", "")),
        (r"unknown key 'skip' in \[layout\]", ("skip_bytes", "skip")),
        (r"key 'pixel' is missing in \[layout\]", ('pixel = "Mono12p"\n', "")),
    ],
)
def test_a_wrong_layout_is_named(bare, words, change):
    with pytest.raises(errors.FileError, match=words):
        Experiment.load(edited(bare, "bare", change)).run()


def test_images_of_a_hole_have_the_dark_of_their_exposure(tmp_path):
    """Frames of 40 DN more and a dark of 40 DN more give the same as those without."""
    manifest = written_experiment(tmp_path, (90, 110), [(0, 0), (0, 5), (5, 0)], hot=0, dead=0)
    wanted = Experiment.load(manifest)
    for name in ("frames/p2", "aperture/p2-before", "aperture/p2-after", "dark/dark"):
        frames = read_frames(manifest.parent / f"{name}.tif") + np.uint16(40)
        frames = frames[::-1] if "dark" in name else frames
        write_frames(manifest.parent / f"{name}+.tif", frames, nbytes=frames.nbytes)
    text = manifest.read_text()
    text = re.sub(r"(p2[^.\n]*)\.tif", r"\1+.tif", text)
    text = text.replace("[dark]", '[[dark]]\nexposure_s = 2\nframes = "dark/dark+.tif"\n\n[[dark]]')
    text = text.replace('"dark/dark.tif"', '"dark/dark.tif"\nexposure_s = 1')
    for k in range(3):
        text = text.replace(f'name = "p{k}"', f'name = "p{k}"\nexposure_s = {2 if k == 2 else 1}')
    (manifest.parent / "several.toml").write_text(text)
    several = Experiment.load(manifest.parent / "several.toml")
    one, other = wanted.run(tolerance=1e-4), several.run(tolerance=1e-4)
    # Weights differ, since the darks of the exposures no longer have all their noise in common.
    np.testing.assert_allclose(other.sensitivity, one.sensitivity, rtol=2e-3)
    found, shifts = several.measure_shifts(other)[0], wanted.measure_shifts(one)[0]
    np.testing.assert_allclose(found, shifts, atol=1e-4)
    np.testing.assert_allclose(other.shifts, one.shifts, atol=1e-4)
