"""Tables of words: against the reference, against the correction, to files and back."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import tifffile

import equipix
import hardware as docs
import reference
from equipix import Flag, Polynomial, errors, hardware, metrics, nuc
from equipix.findings import Finding, usable
from equipix.hardware.quality import trial, widths_of
from equipix.hardware.table import UPLOAD
from equipix.hardware.words import Words
from equipix.io.tiff import write_frames
from equipix.simulate import StaringArray

SHAPE = (24, 32)
SUFFIXES = (".bin", ".hex", ".h")


@pytest.fixture(scope="module")
def made():
    """An array, and its two-point correction with three bad pixels."""
    array, response = docs.two_point(shape=SHAPE)
    flags = np.zeros(SHAPE, np.uint32)
    flags[2, 3] = Flag.DEAD | Flag.DO_NOT_USE
    flags[5, 7] = Flag.HOT | Flag.DO_NOT_USE
    flags[6, 1] = Flag.SATURATED
    return array, response.with_flags(flags)


def polynomial(*planes, flags=None, shape=(4, 5)):
    full = [np.broadcast_to(np.asarray(plane, float), shape) for plane in planes]
    return Polynomial(np.array(full), np.zeros(shape, np.uint32) if flags is None else flags)


def of_12_bits(correction):
    return dataclasses.replace(correction, metadata={"sensor": {"bit_depth": 12}})


def words_of(table, count=3, rng=1):
    shape = (count, *table.shape)
    return np.random.default_rng(rng).integers(0, 2**table.format.adc_bits, shape, np.uint16)


def by_reference(table, words):
    f = table.format
    return reference.apply_words(
        words,
        table.gain,
        table.offset,
        out_bits=f.out_bits,
        exponents=(f.adc, f.offset, f.gain, f.out),
        base=f.base,
    )


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"gain_bits": 8, "offset_bits": 8, "out_bits": 8},
        {"gain_bits": 11, "offset_bits": 9, "lowest": 700.0, "dac_bits": 12},
        {"adc_bits": 10, "adc_step": 16.0, "out_step": 0.25, "lowest": -30.0},
        {"out_step": 8.0, "offset_step": 0.5, "gain_step": 2.0**-12},
    ],
)
def test_words_are_those_of_the_reference(made, options):
    table = hardware.Table.of(made[1], **options)
    words = words_of(table)
    assert np.array_equal(table.apply(words, workers=2), by_reference(table, words))
    assert np.array_equal(table.apply(words[0], workers=1), by_reference(table, words)[0])


def exact_words(table, coefficients):
    """Words of the output by the correction itself, before they are rounded or limited."""
    f = table.format
    raw = np.arange(2**f.adc_bits)[:, None, None] * 2.0**f.adc + table.coarse * 2.0**f.coarse
    return raw, (coefficients[0] + coefficients[1] * raw) / 2.0**f.out - f.zero


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("lowest", [0.0, 37.5, 200.0])
def test_wide_words_are_the_correction_within_half_a_step(seed, lowest):
    rng = np.random.default_rng(seed)
    gain, offset = rng.uniform(0.7, 1.3, SHAPE), rng.uniform(-200, 20, SHAPE)
    correction = polynomial(offset, gain, shape=SHAPE)
    table = hardware.Table.of(
        correction, adc_bits=8, offset_bits=16, gain_bits=16, out_step=1.0, lowest=lowest
    )
    _, exact = exact_words(table, correction.coefficients)
    words = np.arange(256, dtype=np.uint16)[:, None, None] + np.zeros(SHAPE, np.uint16)
    found = table.apply(words)
    inside = (exact > 0) & (exact < 2**16 - 1)
    # A step of the gain is 2^-15, so 128 words from the middle its half makes 2^-9. Of 16 bits the
    # fine offset spends 5 on what the DAC leaves.
    limit = 0.5 + 2.0**-9 + 2.0 ** (table.format.offset - 1)
    assert table.format.offset <= -10
    assert np.abs(found - exact)[inside].max() <= limit
    assert inside.mean() > 0.5
    assert np.all(found[exact < -0.51] == 0)


def test_steps_follow_that_of_the_adc():
    rng = np.random.default_rng(1)
    correction = polynomial(rng.uniform(-200, 20, SHAPE), rng.uniform(0.7, 1.3, SHAPE), shape=SHAPE)
    options = {"adc_bits": 8, "adc_step": 16.0, "gain_bits": 8, "out_step": 2.0}
    table = hardware.Table.of(correction, **options, lowest=39.0)
    f = table.format
    # A corrected value of 39 DN is 19.5 steps, rounded down. Pedestals are below 255 steps.
    assert (f.zero, f.coarse) == (19, 4)
    _, exact = exact_words(table, correction.coefficients)
    words = np.arange(256, dtype=np.uint16)[:, None, None] + np.zeros(SHAPE, np.uint16)
    away = np.abs(table.apply(words) - exact)[(exact > 0) & (exact < 2**16 - 1)].max()
    told = table.metadata["largest_error_dn"] / 2.0
    assert told - 0.5 <= away <= told + 0.5
    # Where offsets are few steps, theirs is that of the product, or of a finer output.
    for out_step, finest in ((2.0, -3), (2.0**-8, -8)):
        even = hardware.Table.of(polynomial(0.0, 1.0), **options | {"out_step": out_step})
        assert (even.format.gain, even.format.offset) == (-7, finest)
    assert hardware.Table.of(correction, **options, dac_bits=0).format.coarse == 4


@pytest.mark.parametrize("bits", [8, 10, 13])
def test_narrow_words_are_off_by_no_more_than_their_steps(made, bits):
    response = made[1]
    table = hardware.Table.of(response, offset_bits=bits, gain_bits=bits, out_step=0.25)
    f, used = table.format, table.gain > 0
    _, exact = exact_words(table, response.coefficients)
    middle = 2.0 ** (f.adc_bits - 1 + f.adc)
    limit = (2.0**f.offset + 2.0**f.gain * middle) / 2 / 2.0**f.out
    words = np.arange(0, 2**14, 37, dtype=np.uint16)[:, None, None] + np.zeros(SHAPE, np.uint16)
    away = np.abs(table.apply(words) - exact[::37])
    inside = used & (exact[::37] > 0) & (exact[::37] < 2**f.out_bits - 1)
    largest = away[inside].max()
    assert largest <= limit + 0.5
    # The largest of 765 errors, spread evenly up to the limit, is close to it.
    assert largest > 0.8 * limit
    told = table.metadata["largest_error_dn"] / 2.0**f.out
    assert largest - 0.5 <= told <= limit


def test_the_steps_are_the_finest_that_fit(made):
    table = hardware.Table.of(made[1], lowest=500.0)
    f, used = table.format, table.gain > 0
    assert table.gain.max() >= 2 ** (f.gain_bits - 1)
    assert np.abs(table.offset[used].astype(int)).max() >= 2 ** (f.offset_bits - 2)
    assert f.coarse == f.adc or table.coarse.max() >= 2 ** (f.dac_bits - 1)
    # Pixels have a word from 0 on at the lowest value, and less than a step of the DAC.
    raw = (500.0 - made[1].coefficients[0]) / made[1].coefficients[1]
    left = (raw - table.coarse * 2.0**f.coarse)[used]
    assert left.min() >= 0
    assert left.max() < 2.0**f.coarse


def test_the_dac_keeps_a_wide_spread_in_the_range_of_the_adc():
    offset = np.random.default_rng(1).uniform(-3000, 0, SHAPE)
    correction = polynomial(offset, 1.0, shape=SHAPE)
    light = 3000.0
    raw = light - offset
    table = hardware.Table.of(correction, adc_bits=12, dac_bits=12, out_step=0.25)
    off = hardware.Table.of(correction, adc_bits=12, dac_step=2.0**13, out_step=0.25)
    # Rounding of the ADC, half a step, and of offset and output.
    assert np.abs(table.correct(raw) - light).max() < 0.5 + 0.125 + 2.0**table.format.offset
    assert (off.digitise(raw) == 4095).mean() > 0.5


def test_coefficients_are_those_of_the_words(made):
    table = hardware.Table.of(made[1], lowest=700.0, gain_bits=9)
    raw = np.full(SHAPE, 3000.0)
    offset, gain = table.coefficients
    used = table.gain > 0
    rounding = 2.0**table.format.adc / 2 * gain[used].max() + 2.0**table.format.out / 2
    assert np.abs(offset + gain * raw - table.correct(raw))[used].max() <= rounding
    assert np.isnan(offset[~used]).all()
    assert isinstance(table, equipix.Correction)


def test_pixels_that_must_not_be_used_have_the_code_0(made):
    table = hardware.Table.of(made[1])
    bad = (made[1].flags & Flag.DO_NOT_USE) != 0
    assert bad.sum() >= 2
    for words in (table.coarse, table.offset, table.gain):
        assert not words[bad].any()
    frame = np.full(SHAPE, 2000.0)
    frame[2, 3] = np.nan
    corrected = table.correct(frame)
    assert np.array_equal(np.isnan(corrected), bad)
    assert np.isfinite(table.correct(frame, flagged="replace")).all()
    assert not table.apply(np.full(SHAPE, 900, np.uint16))[bad].any()


def test_a_pixel_without_coefficients_is_flagged():
    gain = np.ones((4, 5))
    gain[1, 2] = np.nan
    table = hardware.Table.of(polynomial(0.0, gain))
    assert table.gain[1, 2] == 0
    assert table.flags[1, 2] == Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE


def same(one, other):
    arrays = ("coarse", "offset", "gain", "flags")
    equal = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in arrays)
    dtypes = all(getattr(one, name).dtype == getattr(other, name).dtype for name in arrays)
    return equal and dtypes and one.format == other.format and one.metadata == other.metadata


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("bits", [8, 11, 16])
def test_files_come_back_bit_by_bit(made, tmp_path, suffix, bits):
    widths = {"dac_bits": bits, "offset_bits": bits, "gain_bits": bits}
    table = hardware.Table.of(made[1], lowest=300.0, **widths)
    assert table.offset.min() < 0 < table.offset.max()
    path = tmp_path / f"table{suffix}"
    table.save(path)
    assert same(equipix.load(path), table)
    with pytest.raises(errors.FileError, match="exists already"):
        table.save(path)
    table.save(path, force=True)


def test_a_memory_image_packs_a_word_a_pixel(made, tmp_path):
    table = hardware.Table.of(made[1], dac_bits=8, offset_bits=12, gain_bits=12, lowest=300.0)
    table.save(tmp_path / "table.hex")
    text = (tmp_path / "table.hex").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("//")]
    assert len(lines) == SHAPE[0] * SHAPE[1]
    word = int(lines[0], 16)
    assert word >> 24 == table.coarse[0, 0]
    assert (word >> 12) % 4096 == table.offset[0, 0] % 4096
    assert word % 4096 == table.gain[0, 0]
    assert lines[2 * 32 + 3] == f"00000000 // {table.flags[2, 3]:08x}"


def compiled(folder, source):
    """A program of C, compiled without a warning; the test is left out without a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    (folder / "main.c").write_text(source)
    command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Werror"]
    command += [folder / "main.c", "-o", folder / "main"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return folder / "main"


FILTER = """#include <stdio.h>
#include "{name}.h"
int main(void) {{
    uint16_t x;
    for (uint32_t i = 0; fread(&x, 2, 1, stdin) == 1; i++) {{
        uint16_t z = equipix_{name}_apply(x, i % (EQUIPIX_{upper}_ROWS * EQUIPIX_{upper}_COLS));
        fwrite(&z, 2, 1, stdout);
    }}
    return 0;
}}
"""


@pytest.mark.parametrize(
    "options",
    [{"out_bits": 8}, {"out_bits": 14}, {}, {"adc_bits": 8, "adc_step": 64.0, "out_step": 2.0**-8}],
)
def test_the_function_of_the_c_header_gives_the_same_words(made, tmp_path, options):
    table = hardware.Table.of(made[1], **{"gain_bits": 12, "offset_bits": 10} | options)
    assert (table.format.shifts[0] > 0) == ("adc_step" in options)  # that of the product
    table.save(tmp_path / "table.h")
    program = compiled(tmp_path, FILTER.format(name="table", upper="TABLE"))
    words = words_of(table, 30)
    done = subprocess.run([program], input=words.tobytes(), capture_output=True, check=True)
    assert np.array_equal(np.frombuffer(done.stdout, np.uint16), table.apply(words).ravel())


def test_the_function_of_the_c_header_rounds_a_sum_of_half_a_step_to_even(tmp_path):
    """With an output of two steps of the sum each second sum is half-way between two words."""
    gain, offset = np.full((4, 5), 1.5), np.arange(-10.0, 10.0).reshape(4, 5) / 2
    steps = {"gain_step": 0.5, "offset_step": 0.5, "out_step": 1.0}
    table = hardware.Table.of(polynomial(offset, gain), adc_bits=8, dac_bits=0, **steps)
    assert table.format.shifts[2] == 1
    table.save(tmp_path / "table.h")
    program = compiled(tmp_path, FILTER.format(name="table", upper="TABLE"))
    words = np.arange(256, dtype=np.uint16)[:, None, None] + np.zeros((4, 5), np.uint16)
    done = subprocess.run([program], input=words.tobytes(), capture_output=True, check=True)
    wanted = np.clip(np.rint(offset + gain * words), 0, None) - table.format.zero
    found = np.frombuffer(done.stdout, np.uint16).reshape(words.shape)
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(table.apply(words), wanted)


def included(folder, names):
    """Compile a program that includes headers, and calls the function of each."""
    calls = " + ".join(f"equipix_{c_name}_apply(0, 0)" for c_name in names.values())
    lines = [*(f'#include "{name}.h"' for name in [*names, *names]), "int main(void) {"]
    return compiled(folder, "\n".join([*lines, f"    return {calls} < 0;", "}", ""]))


def test_names_of_files_give_names_of_their_own(made, tmp_path):
    names = {"größe": "gru00f6u00dfe", "grüße": "gru00fcu00dfe", "a-b": "a_b"}
    for gain_bits, name in enumerate(names, start=10):
        hardware.Table.of(made[1], gain_bits=gain_bits).save(tmp_path / f"{name}.h")
    included(tmp_path, names)
    hardware.Table.of(made[1], gain_bits=14).save(tmp_path / "a_b.h")
    with pytest.raises(subprocess.CalledProcessError) as failed:
        included(tmp_path, {"a-b": "a_b", "a_b": "a_b"})
    assert "another table has the names equipix_a_b" in failed.value.stderr


@pytest.mark.parametrize("suffix", [".hex", ".h"])
def test_files_say_in_words_where_the_words_of_a_pixel_are(made, tmp_path, suffix):
    table = hardware.Table.of(made[1], dac_bits=8, offset_bits=12, gain_bits=13)
    table.save(tmp_path / f"table{suffix}")
    said = " ".join((tmp_path / f"table{suffix}").read_text().replace("//", "").split())
    for words in (
        "24 rows of 32 pixels, row by row: 768 pixels.",
        "The first is that of row 0, column 0, which viewers show at the upper left",
        "2 pixels must not be used; all their words are 0.",
        "00000001 DO_NOT_USE, 00000002 SATURATED, 00000400 DEAD, 00000800 HOT,",
    ):
        assert words in said
    if suffix == ".hex":
        assert "768 words of 33 bits, 9 hexadecimal digits each." in said
        assert "bits: coarse [32:25], offset [24:13], gain [12:0]" in said


@pytest.mark.parametrize("bits", [8, 0])
def test_files_say_in_words_what_the_numbers_are(made, tmp_path, bits):
    table = hardware.Table.of(made[1], dac_bits=bits, gain_bits=12)
    f = table.format
    for suffix in (".hex", ".h"):
        table.save(tmp_path / f"table{suffix}")
        said = " ".join((tmp_path / f"table{suffix}").read_text().replace("//", "").split())
        ahead = (
            f"after the DAC has subtracted coarse * 2^{f.coarse} DN from the raw value."
            if bits
            else "of the raw value: no DAC subtracts anything ahead of the ADC."
        )
        for words in (
            f"x: word of the ADC, 14 bits, unsigned, in steps of 2^0 DN, {ahead}",
            f"z = {f.base} + round((gain * x * 2^{f.gain + f.adc} + offset * 2^{f.offset}) / "
            f"2^{f.out}), rounded half to even, limited to 0 to 65535.",
            f"(z + {f.zero}) * 2^{f.out}",
            "offset: 12 bits, two's complement.",
            f"gain: 12 bits, unsigned, in steps of 2^{f.gain}.",
            "gain 0: do not use this pixel",
        ):
            assert words in said


def test_without_a_dac_the_adc_sees_raw_values(made, tmp_path):
    response = made[1]
    table = hardware.Table.of(response, dac_bits=0)
    words = words_of(table)
    # A step of the ADC is 1 DN: words are the raw values.
    np.testing.assert_array_equal(table.digitise(words), np.where(table.gain > 0, words, 0))
    rounding = 2.0**table.format.out / 2 + table.metadata["largest_error_dn"]
    away = np.abs(table.correct(words[0] * 1.0) - response.correct(words[0] * 1.0))
    top = 2.0**table.format.out * (2**16 - 1)
    inside = (response.correct(words[0] * 1.0) > 0) & (response.correct(words[0] * 1.0) < top)
    assert away[inside].max() <= rounding * (1 + 1e-9)
    for suffix in SUFFIXES:
        table.save(tmp_path / f"table{suffix}")
        assert same(equipix.load(tmp_path / f"table{suffix}"), table)
    assert "coarse[" not in (tmp_path / "table.h").read_text()
    assert (
        "coarse" not in (tmp_path / "table.hex").read_text().splitlines()[-SHAPE[0] * SHAPE[1] - 1]
    )
    program = compiled(tmp_path, FILTER.format(name="table", upper="TABLE"))
    done = subprocess.run([program], input=words.tobytes(), capture_output=True, check=True)
    assert np.array_equal(np.frombuffer(done.stdout, np.uint16), table.apply(words).ravel())
    with pytest.raises(errors.InputError, match="'dac_step' is 2.0, but 'dac_bits' is 0"):
        hardware.Table.of(response, dac_bits=0, dac_step=2.0)
    with pytest.raises(errors.InputError, match="'dac_bits' is 4, expected 8 to 16 or 0 bits"):
        hardware.Table.of(response, dac_bits=4)
    with pytest.raises(errors.InputError, match="'gain_bits' is 0, expected 8 to 16 bits"):
        hardware.Table.of(response, gain_bits=0)


@pytest.mark.parametrize(("sensor", "bits"), [({"bit_depth": 12}, 12), ({"bit_depth": 4}, 8)])
def test_the_adc_has_the_bits_of_the_sensor(sensor, bits):
    kept = Polynomial(
        polynomial(0.0, 1.0).coefficients, polynomial(0.0, 1.0).flags, {"sensor": sensor}
    )
    assert hardware.Table.of(kept).format.adc_bits == bits
    assert hardware.Table.of(kept, adc_bits=16).format.adc_bits == 16
    # Where they are unknown.
    assert hardware.Table.of(polynomial(0.0, 1.0)).format.adc_bits == 14


def test_gains_for_the_upload_of_a_camera(made, tmp_path, run):
    response = made[1]
    response.save(tmp_path / "response.npz")
    command = ["hardware", tmp_path / "response.npz", "--preset", "upload", "-o"]
    assert run(*command, tmp_path / "gain.tif")[0] == 0
    gain = tifffile.imread(tmp_path / "gain.tif")
    assert gain.dtype == np.uint16
    used = usable(response.flags)
    np.testing.assert_array_equal(gain[used], np.rint(1024 * response.coefficients[1][used]))
    assert not gain[~used].any()
    with tifffile.TiffFile(tmp_path / "gain.tif") as file:
        assert file.pages[0].description == (
            "gain: 12 bits, unsigned, in steps of 2^-10.\ngain 0: do not use this pixel."
        )
    told = json.loads(run(*command, tmp_path / "again.tif", "--json")[1])
    assert (told["bits"], told["steps"]) == ({"gain": 12}, {"gain": 2.0**-10})
    assert told.keys().isdisjoint({"base", "zero", "largest_error_dn", "rounding_dn"})
    lost = np.std(response.coefficients[0][used])
    said = told["findings"][-1]["message"]
    assert f"the offsets of the correction differ by {lost:.3g} DN" in said
    # Gains without offsets lose nothing.
    flat = tmp_path / "flat.npz"
    polynomial(0.0, np.linspace(0.9, 1.1, 5)).save(flat)
    assert run("hardware", flat, "--preset", "upload", "-o", tmp_path / "flat.tif")[1].count("none")
    # A line in place of curves has offsets of its own: here those of curves are 0.
    curved = tmp_path / "curved.npz"
    polynomial(0.0, 1.0, np.linspace(1e-6, 3e-6, 5)).save(curved)
    options = ("--preset", "upload", "--linearise", 1000, 3000, "--json")
    told = json.loads(run("hardware", curved, *options, "-o", tmp_path / "curved.tif")[1])
    # Of c y² the chord has c (lo + hi) as its gain and -c lo hi as its offset, and half of the sag.
    lost = np.std(np.linspace(1e-6, 3e-6, 5)) * (3e6 + 0.5e6)
    assert f"the offsets of the correction differ by {lost:.3g} DN" in str(told["findings"])
    with pytest.raises(errors.FileError, match="or wrote it for other programs alone, as gains"):
        equipix.load(tmp_path / "gain.tif")
    other, level = tmp_path / "other.tif", tmp_path / "level.tif"
    for options, words in (
        ((other, "--gain-bits", 16), "--gain-bits is 16, but --preset upload has 12: leave one"),
        ((other, "--out-bits", 16), "--out-bits is 16, but --preset upload writes gains alone"),
        ((other, "--frames", level), f"--frames is given, but '{other}' holds gains alone"),
        ((tmp_path / "o.hex",), "o.hex' is no image, but --preset upload writes one: name a"),
    ):
        status, _, told = run(*command, *options)
        assert status == 1
        assert words in told
        assert not other.exists()
    planes = np.array(response.coefficients)
    planes[1, 3, 4] = 4.5
    with pytest.raises(
        errors.InputError, match="gain words of 1 usable pixels do not fit.*13 bits"
    ):
        hardware.Table.of(Polynomial(planes, response.flags), **UPLOAD)


def test_files_are_corrected_by_what_the_words_stand_for(made, tmp_path, run):
    array, response = made
    table = hardware.Table.of(response, out_step=4.0, out_bits=12)
    table.save(tmp_path / "table.bin")
    raw = next(array.frames(10e6, 1, rng=9))
    np.save(tmp_path / "raw.npy", raw)
    given = ("correct", tmp_path / "table.bin", tmp_path / "raw.npy", "-o", tmp_path / "done.tif")
    assert run(*given)[0] == 0
    found = tifffile.imread(tmp_path / "done.tif")
    offset, gain = table.coefficients
    np.testing.assert_allclose(found, offset + gain * raw, rtol=1e-6)
    # Half a step of the output, and of the ADC, which sees whole raw values here.
    assert np.nanmax(np.abs(found - table.correct(raw))) == pytest.approx(2.0, rel=0.01)


def test_two_c_headers_go_into_one_program(made, tmp_path):
    names = {"left": {"lowest": 700.0}, "right-2": {"gain_bits": 11, "out_bits": 14}}
    tables = {name: hardware.Table.of(made[1], **options) for name, options in names.items()}
    numbers = ("ROWS", "COLS", "ADC_BITS", "COARSE_BITS", "OFFSET_BITS", "GAIN_BITS", "OUT_BITS")
    numbers += tuple(f"{n}_STEP_EXPONENT" for n in ("ADC", "COARSE", "OFFSET", "GAIN", "OUT"))
    numbers += ("BASE", "ZERO")
    source, wanted = "#include <stdio.h>\n", []
    for name, table in tables.items():
        table.save(tmp_path / f"{name}.h")
        source += f'#include "{name}.h"\n'
        f = table.format
        wanted += [*SHAPE, f.adc_bits, f.dac_bits, f.offset_bits, f.gain_bits, f.out_bits]
        wanted += [f.adc, f.coarse, f.offset, f.gain, f.out, f.base, f.zero]
    macros = [f"EQUIPIX_{name}_{number}" for name in ("LEFT", "RIGHT_2") for number in numbers]
    text = "".join(f'    printf("%d\\n", {macro});\n' for macro in macros)
    calls = "    return equipix_left_apply(0, 0) + equipix_right_2_apply(0, 0) < 0;\n"
    program = compiled(tmp_path, source + "int main(void) {\n" + text + calls + "}\n")
    done = subprocess.run([program], capture_output=True, check=True, text=True)
    assert [int(line) for line in done.stdout.split()] == wanted
    # The output 0 is `lowest`, rounded down to a step.
    assert np.ldexp(tables["left"].format.zero, tables["left"].format.out) == 700.0


@pytest.mark.parametrize("sensor", ["/* a", "a */ b", "//", "??/", "\\", "é\n"])
def test_no_name_of_a_sensor_breaks_a_comment(tmp_path, sensor):
    kept = Polynomial(
        np.stack([np.zeros((4, 5)), np.ones((4, 5))]),
        np.zeros((4, 5), np.uint32),
        metadata={"sensor": {"name": sensor}},
    )
    table = hardware.Table.of(kept)
    for suffix in SUFFIXES:
        table.save(tmp_path / f"table{suffix}")
        assert equipix.load(tmp_path / f"table{suffix}").metadata["sensor"]["name"] == sensor
    compiled(tmp_path, FILTER.format(name="table", upper="TABLE"))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_files_are_refused_by_name(made, tmp_path, suffix):
    path = tmp_path / f"table{suffix}"
    hardware.Table.of(made[1]).save(path)
    whole = path.read_bytes()

    def refused(data, words):
        path.write_bytes(data)
        with pytest.raises(errors.FileError, match=rf"table\{suffix}: .*{words}"):
            equipix.load(path)

    refused(whole.replace(b'"version": 1', b'"version": 2'), "version 2, .* reads version 1")
    refused(whole.replace(b'"rows": 24', b'"rows": 25'), "another size")
    refused(whole[: len(whole) // 2], "incomplete|another size|holds no table")
    refused(b"", "holds no table|incomplete")
    refused(b"\xff\xfe" * 100, "holds no table|damaged")
    gain = hardware.Table.of(made[1]).gain[0, 0]
    if suffix == ".bin":
        refused(whole.replace(gain.tobytes(), (gain - 1).tobytes(), 1), "checksum|damaged")
    else:
        text = f"{gain:04x}" if suffix == ".hex" else f"{gain},"
        other = f"{gain - 1:04x}" if suffix == ".hex" else f"{gain - 1},"
        assert text.encode() in whole
        refused(whole.replace(text.encode(), other.encode(), 1), "checksum")


@pytest.mark.parametrize(
    ("written", "edited"),
    [("GAIN_BITS (16)", "GAIN_BITS (15)"), ("return 0;", "return 1;"), ("ROWS (24)", "ROWS (12)")],
)
def test_an_edited_c_header_is_refused(made, tmp_path, written, edited):
    path = tmp_path / "table.h"
    hardware.Table.of(made[1], out_bits=13).save(path)
    text = path.read_text()
    assert written in text
    path.write_text(text.replace(written, edited, 1))
    with pytest.raises(errors.FileError, match=r"table\.h: was edited.*SHA-256.*write the table"):
        equipix.load(path)
    # Line ends of another system are no edit.
    path.write_bytes(text.replace("\n", "\r\n").encode())
    assert same(equipix.load(path), hardware.Table.of(made[1], out_bits=13))


def test_a_c_header_without_a_digest_is_refused(made, tmp_path):
    path = tmp_path / "table.h"
    hardware.Table.of(made[1]).save(path)
    text = path.read_text()
    path.write_text(re.sub(r", SHA-256 of the lines above: \w+", "", text))
    with pytest.raises(errors.FileError, match="or its digest removed: .* SHA-256"):
        equipix.load(path)


def test_a_far_offset_is_named(made):
    planes = np.array(made[1].coefficients)
    exact = hardware.Table.of(made[1]).metadata["largest_error_dn"]
    planes[0, 4, 5] += 3e5
    far = Polynomial(planes, made[1].flags)
    with pytest.raises(errors.InputError, match=r"'offset_bits' is 12.*63\.\d DN.*: \(4, 5\); or"):
        hardware.Table.of(far)
    assert hardware.Table.of(far, offset_step=128.0).metadata["largest_error_dn"] > 60
    flags = made[1].flags.copy()
    flags[4, 5] |= Flag.DO_NOT_USE
    without = hardware.Table.of(Polynomial(planes, flags))
    assert without.metadata["largest_error_dn"] == exact


@pytest.mark.parametrize(("count", "refused"), [(3, True), (4, True), (5, False)])
def test_far_offsets_are_few_up_to_a_hundredth_of_the_usable_pixels(count, refused):
    """More of them are a part of the array."""
    shape = (20, 25)
    offset, flags = np.zeros(shape), np.zeros(shape, np.uint32)
    offset[0, :count] = 3e5
    flags[16:] = Flag.DO_NOT_USE  # 400 are left
    correction = polynomial(offset, 1.0, flags=flags, shape=shape)
    if refused:
        with pytest.raises(errors.InputError, match=f"without the {count} offsets far from most"):
            hardware.Table.of(correction)
    else:
        hardware.Table.of(correction)


def test_a_far_offset_may_cost_a_step_of_the_output():
    """Words of 8 bits from one offset to the other have steps of 2 DN, or of 4 DN."""
    options = {"dac_bits": 0, "offset_bits": 8, "out_step": 1.0}
    offset = np.tile([0.0, 1.0], (10, 10))
    offset[4, 4] = 300.0
    table = hardware.Table.of(polynomial(offset, 1.0, shape=offset.shape), **options)
    assert (table.format.offset, table.metadata["largest_error_dn"]) == (1, 1.0)
    with pytest.raises(errors.InputError, match=r"the largest error 2 DN, without the 1 "):
        hardware.Table.of(polynomial(2 * offset, 1.0, shape=offset.shape), **options)


@pytest.mark.parametrize("dtype", [np.int8, np.int16])
def test_words_of_offsets_are_the_numbers_of_twos_complement(dtype):
    ends, words = np.iinfo(dtype), Words("offset", np.iinfo(dtype).bits, signed=True)
    inside = np.array([ends.min, -1, 0, ends.max], float)
    assert words.outside(inside, 0) == 0
    np.testing.assert_array_equal(words.encoded(inside, 0).astype(dtype), inside)
    assert words.outside(np.array([ends.min - 1.0, ends.max + 1.0]), 0) == 2


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_cut_anywhere_is_refused_by_name(tmp_path, suffix):
    flags = np.zeros((4, 5), np.uint32)
    flags[3, 4] = Flag.DEAD | Flag.DO_NOT_USE
    path = tmp_path / f"table{suffix}"
    table = hardware.Table.of(polynomial(0.0, 1.0, flags=flags), gain_bits=8)
    table.save(path)
    whole = path.read_bytes()
    # The last line feed of a text carries nothing.
    least = len(whole) - (suffix != ".bin")
    for size in range(least):
        path.write_bytes(whole[:size])
        with pytest.raises(errors.FileError, match=rf"table\{suffix}: "):
            equipix.load(path)
    path.write_bytes(whole[:least])
    assert same(equipix.load(path), table)


@pytest.mark.parametrize("bits", [8, 12])
def test_memories_of_a_binary_file_are_aligned(made, tmp_path, bits):
    table = hardware.Table.of(made[1], dac_bits=bits, offset_bits=bits, gain_bits=bits)
    table = hardware.Table(
        table.format,
        *(getattr(table, name)[:5, :7] for name in ("coarse", "offset", "gain", "flags")),
        metadata=table.metadata,
    )
    path = tmp_path / "table.bin"
    table.save(path)
    data = path.read_bytes()
    at = 8 + int.from_bytes(data[4:8], "little")
    for name, kind in (("coarse", "u"), ("offset", "i"), ("gain", "u"), ("flags", "u")):
        words = getattr(table, name)
        dtype = np.dtype(f"<{kind}{4 if name == 'flags' else 1 + (bits > 8)}")
        assert at % 16 == 0
        assert np.array_equal(np.frombuffer(data, dtype, 35, at).reshape(5, 7), words)
        at += -(-35 * dtype.itemsize // 16) * 16
    assert at == len(data)
    assert same(equipix.load(path), table)


def test_other_suffixes_are_refused(made, tmp_path):
    with pytest.raises(errors.InputError, match=r"ends in '\.txt', expected .* \.bin, \.hex, \.h"):
        hardware.Table.of(made[1]).save(tmp_path / "table.txt")
    with pytest.raises(errors.FileError, match=r"none\.bin: does not exist"):
        equipix.load(tmp_path / "none.bin")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"gain_bits": 17}, "'gain_bits' is 17, expected 8 to 16"),
        ({"adc_bits": 7}, "'adc_bits' is 7"),
        ({"offset_bits": 9.5}, "'offset_bits' is 9.5"),
        ({"adc_step": 0.3}, "'adc_step' is 0.3, expected a power of two"),
        ({"out_step": 0}, "'out_step' is 0, expected a power of two"),
        ({"lowest": float("nan")}, "'lowest' is nan"),
        ({"lowest": 1e12}, "'lowest' is 1e\\+12 DN, expected less than 5.36871e\\+08 on either"),
        ({"lowest": -1e12}, "'lowest' is -1e\\+12 DN"),
        ({"lowest": 1e6, "dac_step": 4.0}, "'lowest' is 1e\\+06 DN, .* at most 1020 DN"),
        ({"out_step": 2.0**40, "adc_step": 2.0**-10}, "make sums of 65 bits, expected at most 58"),
    ],
)
def test_arguments_out_of_range_are_refused(made, options, words):
    with pytest.raises(errors.InputError, match=words):
        hardware.Table.of(made[1], **options)


def test_values_that_do_not_fit_are_counted_with_the_width_that_would_hold_them():
    gain = np.ones((4, 5))
    gain[0, :3] = 2.5
    with pytest.raises(errors.InputError, match=r"gain words of 3 usable pixels .* 11 bits would"):
        hardware.Table.of(polynomial(0.0, gain), gain_bits=10, gain_step=2.0**-9)
    offset = np.zeros((4, 5))
    offset[1, 1], offset[2, 2] = -300.0, 300.0
    correction = polynomial(offset, 1.0)
    with pytest.raises(errors.InputError, match=r"offset words of 2 usable .* 10 bits would"):
        hardware.Table.of(correction, offset_bits=8, offset_step=1.0, dac_step=1024.0)
    with pytest.raises(errors.InputError, match="dac words of 1 usable .* 9 bits would hold"):
        hardware.Table.of(correction, dac_step=1.0)
    # Flagged pixels are coded, not counted.
    flags = np.zeros((4, 5), np.uint32)
    flags[1, 1] = flags[2, 2] = Flag.DO_NOT_USE
    hardware.Table.of(polynomial(offset, 1.0, flags=flags), offset_bits=8, offset_step=1.0)


def test_corrections_without_use_are_refused():
    with pytest.raises(errors.InputError, match="no usable pixel"):
        hardware.Table.of(polynomial(0.0, np.nan))
    with pytest.raises(errors.InputError, match="gain of 0 or below in 20 usable pixels"):
        hardware.Table.of(polynomial(0.0, -1.0))
    with pytest.raises(errors.InputError, match="gain of 0 or below in 5 usable pixels"):
        hardware.Table.of(polynomial(0.0, np.minimum(np.arange(4.0)[:, None], 1)))
    with pytest.raises(errors.InputError, match="expected a correction"):
        hardware.Table.of("response.tif")


def test_a_curved_correction_needs_a_line():
    correction = polynomial(10.0, 1.0, 1e-5)
    with pytest.raises(errors.InputError, match="degree 2 in raw.* order 1, or give 'linearise'"):
        hardware.Table.of(correction)
    table = hardware.Table.of(correction, linearise=(1000.0, 3000.0), out_step=2.0**-3, adc_bits=12)
    # A parabola is c (h/2)² below its chord: 10 DN; half of it is left on either side.
    assert table.metadata["linearised"]["sag_dn"] == pytest.approx(10.0, rel=1e-9)
    for raw, left in ((1000, -5.0), (2000, 5.0), (3000, -5.0)):
        frame = np.full((4, 5), raw, np.uint16)
        found = table.correct(frame) - correction.correct(frame)
        # Half a step of the output, and of the gain at 1048 words from the middle.
        assert found == pytest.approx(np.full((4, 5), left), abs=2.0**-4 + 1048 * 2.0**-16 + 1e-3)


@pytest.mark.parametrize("bend", [np.linspace(2e-5, 4e-5, 5), 4e-5 * np.array([1, -1, 1, -1, -1])])
def test_a_line_that_leaves_a_pattern_is_a_finding(bend):
    # Sags of c (h/2)² up to 40 DN, upwards or downwards: half of their spread is left.
    words = f"up to 20 DN, and a pattern with a standard deviation of {np.std(bend) * 1e6 / 2:.3g}"
    with pytest.warns(errors.InputWarning, match=words):
        table = hardware.Table.of(polynomial(10.0, 1.0, bend), linearise=(1000.0, 3000.0))
    assert [each.kind for each in table.findings] == ["line"]


def test_the_line_of_a_cubic_leaves_half_of_its_sag_on_either_side():
    # About the middle 2000 the cubic is c t (t² − h²) from its chord, with extremes of
    # ∓ 2 c h³/(3√3): one on either side, so the chord itself is the best line. A parabola of -10 DN
    # beside it moves the line.
    c, h = 1e-8, 1000.0
    for parabola in (0.0, -1e-5):
        t = np.poly1d([1.0, -2000.0])
        curve = c * t**3 + parabola * t**2 + np.poly1d([1.0, 0.0])
        correction = polynomial(*curve.coeffs[::-1])
        low, high = 1000.0, 3000.0
        table = hardware.Table.of(
            correction, linearise=(low, high), out_step=2.0**-3, adc_bits=12, offset_bits=16
        )
        offset, gain = table.coefficients[:, 0, 0]
        raw = np.linspace(low, high, 65)
        left = curve(raw) - offset - gain * raw
        rounding = 2 * (2.0 ** (table.format.offset - 1) + 1048 * 2.0**-16)
        assert left.max() == pytest.approx(-left.min(), abs=rounding)
        sag = table.metadata["linearised"]["sag_dn"]
        assert left.max() - left.min() == pytest.approx(sag, abs=rounding)
        if not parabola:
            # Between two of 65 values the cubic changes by 3 c h (h/64)² near its extremes at most.
            assert sag == pytest.approx(4 * c * h**3 / 27**0.5, abs=2 * 3 * c * h * (h / 64) ** 2)


@pytest.mark.parametrize(
    "linearise",
    [(1,), 5, (1, 2, 3), (3, 1), ("a", 2), (0, float("inf")), (0, 4096), (-1, 9), (0, np.nan)],
)
def test_a_range_of_a_line_is_two_rising_values_of_the_sensor(linearise):
    words = "'linearise' is .*expected two rising raw values in DN from 0 to 4095, the largest"
    correction = of_12_bits(polynomial(10.0, 1.0, 1e-5))
    with pytest.raises(errors.InputError, match=words):
        hardware.Table.of(correction, linearise=linearise)
    hardware.Table.of(correction, linearise=(0, 4095))
    # Of unknown bits the widest ADC is the limit.
    with pytest.raises(errors.InputError, match="from 0 to 131070, the largest"):
        hardware.Table.of(polynomial(1.0, 1.0, 1e-5), linearise=(0, 131071), adc_step=2.0)


@pytest.mark.parametrize("lowest", [-51.0, 8141.0])
def test_the_lowest_value_is_one_that_the_sensor_gives(lowest):
    # Raw values of 0 to 4095, corrected 2 y - 50 in the first row, y + 10 elsewhere.
    first = np.arange(4)[:, None] == 0
    correction = of_12_bits(polynomial(np.where(first, -50, 10.0), np.where(first, 2, 1.0)))
    words = f"'lowest' is {lowest:g} DN, expected a corrected value from -50 to 8140 DN.* 4095 DN"
    with pytest.raises(errors.InputError, match=words):
        hardware.Table.of(correction, lowest=lowest)
    for inside in (-50.0, 0.0, 100.0):
        hardware.Table.of(correction, lowest=inside)
    # The default fits where all corrected values are above it.
    hardware.Table.of(of_12_bits(polynomial(10.0, 1.0)))


def test_frames_that_do_not_fit_are_refused(made):
    table = hardware.Table.of(made[1])
    with pytest.raises(errors.InputError, match="has shape"):
        table.apply(np.zeros((3, 3), np.uint16))
    with pytest.raises(errors.InputError, match="expected uint8 or uint16 words"):
        table.apply(np.zeros(SHAPE))
    with pytest.raises(errors.InputError, match="holds 16384, above 16383"):
        table.apply(np.full(SHAPE, 16384, np.uint16))
    with pytest.raises(errors.InputError, match="usable pixels that are not finite"):
        table.correct(np.full(SHAPE, np.inf))


def test_outputs_that_are_limited_are_counted(made):
    table = hardware.Table.of(made[1])
    f = table.format
    words = words_of(table)
    used = table.gain > 0
    exact = table.gain * 2.0**f.gain * words * 2.0**f.adc + table.offset * 2.0**f.offset
    exact = np.rint(exact / 2.0**f.out) + f.base
    found = table.applied(words)
    assert found.below == (exact < 0)[:, used].sum()
    assert found.above == (exact > 2**f.out_bits - 1)[:, used].sum() > 0


def test_the_hash_is_that_of_the_correction(made):
    one, other = (hardware.Table.of(made[1], gain_bits=bits).metadata["sha256"] for bits in (9, 16))
    assert one == other
    changed = polynomial(*(made[1].coefficients + 1e-9), shape=SHAPE, flags=made[1].flags)
    assert hardware.Table.of(changed).metadata["sha256"] != one
    flags = np.array(made[1].flags)
    flags[0, 0] = Flag.SATURATED
    assert hardware.Table.of(made[1].with_flags(flags)).metadata["sha256"] != one


def test_the_cost_is_that_of_rounded_gains():
    array, response = docs.two_point()
    frames = docs.frames_of(array)[0]
    for bits in (8, 10):
        found = hardware.quality(response, frames, gain_bits=bits, offset_bits=16, lowest=1000.0)
        table = found.table
        step, gain = 2.0**table.format.gain, response.coefficients[1]
        assert step == 2.0 ** (1 - bits)
        word = table.digitise(frames).mean(axis=0)
        error = np.std((word - 2**13) * (np.rint(gain / step) * step - gain))
        noise = np.sqrt(found.before.temporal_variance)
        # Rounding of 16 frames of the output, steps of 1/4 DN, and of the offset is far below.
        assert found.added == pytest.approx(error / noise, rel=0.005)
        assert found.after.ratio > found.before.ratio
        assert found.at_ends == 0


def test_behind_colour_filters_each_plane_is_judged(tmp_path, run):
    rng = np.random.default_rng(1)
    light = np.tile([[0.5, 1.0], [1.0, 0.25]], (8, 10))
    gain = 1 + 0.05 * rng.standard_normal(light.shape)

    def frames(level, count):
        noise = 8 * rng.standard_normal((count, *light.shape))
        return np.rint(100 + level * light * gain + noise).astype(np.uint16)

    levels = [equipix.average(frames(level, 32)) for level in (1000.0, 8000.0)]
    response, raw = nuc.fit(levels, order=1, cfa="RGGB"), frames(4000.0, 8)
    found = hardware.quality(response, raw, gain_bits=9)
    exact, words = response.correct(raw), found.table.correct(raw)
    wanted = metrics.planes(exact, "RGGB")
    assert [*found.planes] == [*wanted] == ["R", "G1", "G2", "B"]
    for name, plane in wanted.items():
        cost, corrected = found.planes[name], metrics.planes(words, "RGGB")[name]
        assert cost.before == metrics.correctability(plane)
        assert cost.after == metrics.correctability(corrected)
        added = np.std((corrected.astype(float) - plane).mean(axis=0))
        noise = np.sqrt(cost.before.temporal_variance)
        assert cost.added == pytest.approx(added / noise, rel=1e-9)
    assert found.added == max(cost.added for cost in found.planes.values())
    assert (found.before, found.after, found.added) == found.planes[found.worst]
    # Colours differ by a factor of 4, noise not at all.
    assert found.before.ratio < 1 < metrics.correctability(exact).ratio
    widths = hardware.smallest_widths(response, [raw])
    told = []
    tried = trial(response, raw, progress=lambda *each: told.append(each), stage="widths")
    assert told == [(done, 25, "widths") for done in range(1, 26)]
    assert widths_of([tried.by_width]).both_bits == widths.both_bits
    alone = [hardware.quality(response, raw, gain_bits=bits, offset_bits=16) for bits in (8, 16)]
    assert [widths.added["gain"][bits] for bits in (8, 16)] == [each.added for each in alone]

    response.save(tmp_path / "response.npz")
    write_frames(tmp_path / "level.tif", raw, nbytes=1)
    command = ["hardware", tmp_path / "response.npz", "-o", tmp_path / "table.bin"]
    status, out, _ = run(*command, "--gain-bits", 9, "--frames", tmp_path / "level.tif", "--json")
    told = json.loads(out)
    assert status == 0
    assert (told["C"], told["worst"]["plane"]) == (found.before.ratio, found.worst)
    assert {each["plane"]: each["C_of_table"] for each in told["costs"]} == {
        name: cost.after.ratio for name, cost in found.planes.items()
    }


def test_the_worst_of_several_levels_counts_and_is_named(made, tmp_path, run):
    array, response = made
    response.save(tmp_path / "response.npz")
    levels = []
    for name, light in (("middle", 8.5e6), ("dim", 3e6)):
        levels.append(np.stack(list(array.frames(light, 8, rng=3))))
        write_frames(tmp_path / f"{name}.tif", levels[-1], nbytes=1)
    command = ["hardware", tmp_path / "response.npz", "-o", tmp_path / "t.bin", "--gain-bits", 10]
    names = [str(tmp_path / f"{name}.tif") for name in ("middle", "dim")]
    status, out, _ = run(*command, "--frames", names[0], "--frames", names[1], "--json")
    assert status == 0
    told, costs = json.loads(out), [hardware.quality(response, f, gain_bits=10) for f in levels]
    # The error of a gain grows with the distance from the middle of the ADC.
    assert costs[1].added > 2 * costs[0].added
    # Words of the two bad pixels are 0, but do not count.
    assert [each.at_ends for each in costs] == [0, 0]
    assert told["worst"] == {"frames": names[1]}
    assert told["added_noise"] == costs[1].added
    assert [each["added_noise"] for each in told["costs"]] == [each.added for each in costs]
    widths = hardware.smallest_widths(response, levels)
    assert told["sufficient_bits"]["gain"] == widths.gain_bits
    assert widths.gain_bits > hardware.smallest_widths(response, levels[:1]).gain_bits
    assert widths.worst["gain"] == (1, "")
    assert {"bits": "gain", "frames": names[1]} in told["worst_at_sufficient_bits"]
    write_frames(tmp_path / "one.tif", levels[0][:1], nbytes=1)
    status, _, said = run(*command, "--force", "--frames", tmp_path / "one.tif")
    assert status == 1
    assert "one.tif: holds one frame, expected two or more: each --frames names all of a" in said


def test_the_frames_of_a_level_are_corrected_once(made, tmp_path, run, monkeypatch):
    array, response = made
    response.save(tmp_path / "response.npz")
    names = []
    for light in (3e6, 8.5e6):
        names.append(tmp_path / f"{light:g}.tif")
        write_frames(names[-1], np.stack(list(array.frames(light, 4, rng=3))), nbytes=1)
    corrected, correct = [], nuc.Response.correct

    def counted(self, frames, **options):
        corrected.append(len(frames))
        return correct(self, frames, **options)

    monkeypatch.setattr(nuc.Response, "correct", counted)
    command = ["hardware", tmp_path / "response.npz", "-o", tmp_path / "table.bin"]
    assert run(*command, *(f"--frames={name}" for name in names))[0] == 0
    assert corrected == [4, 4]


def test_the_smallest_width_is_the_first_that_suffices():
    array, response = docs.two_point()
    found = hardware.smallest_widths(response, docs.frames_of(array), lowest=docs.LOWEST)
    for name, bits in (("gain", found.gain_bits), ("both", found.both_bits)):
        assert found.added[name][bits] <= 0.1 < found.added[name][bits - 1]
    # A bit less doubles the rounding of the gain.
    assert found.added["gain"][9] == pytest.approx(2 * found.added["gain"][10], rel=0.1)
    assert found.offset_bits == 8
    with pytest.raises(errors.InputError, match="gain_bits"):
        hardware.smallest_widths(response, docs.frames_of(array), gain_bits=9)


def test_where_no_width_suffices_the_worst_place_is_that_of_16_bits(made):
    """Gains of 8 bits do not fit this step at all, so that no level is worse than another."""
    array, response = made
    levels = [np.stack(list(array.frames(light, 8, rng=3))) for light in (8.5e6, 3e6)]
    options = {"gain_step": 2.0**-12, "lowest": 1000.0}
    found = hardware.smallest_widths(response, levels, added=1e-12, **options)
    costs = [
        hardware.quality(response, each, gain_bits=16, offset_bits=16, **options).added
        for each in levels
    ]
    assert found.gain_bits is None
    assert np.isinf(found.added["gain"][8])
    assert found.added["gain"][16] == max(costs)
    assert found.worst["gain"] == (costs.index(max(costs)), "") == (1, "")


def test_frames_that_this_correction_has_corrected_are_named_so(made, tmp_path, run):
    array, response = made
    response.save(tmp_path / "response.npz")
    write_frames(tmp_path / "raw.tif", np.stack(list(array.frames(9e6, 4, rng=3))), nbytes=1)
    again = tmp_path / "again.tif"
    assert run("correct", tmp_path / "response.npz", tmp_path / "raw.tif", "-o", again)[0] == 0
    command = ["hardware", tmp_path / "response.npz", "-o", tmp_path / "table.hex"]
    assert "again.tif: corrected already, by this correction" in run(*command, "--frames", again)[2]


def test_findings_of_a_table_and_of_its_frames_are_shown(made, tmp_path, run):
    array, response = made
    limit = Finding("light", "what, value, limit, remedy", "misfit")
    dataclasses.replace(response, findings=(limit,)).save(tmp_path / "response.npz")
    frames = np.stack(list(array.frames(9e6, 8, rng=3))).astype(np.int64)
    frames += 100 * np.arange(8)[:, None, None]
    write_frames(tmp_path / "level.tif", frames.astype(np.uint16), nbytes=1)
    command = ["hardware", tmp_path / "response.npz", "-o", tmp_path / "table.hex", "--force"]
    assert json.loads(run(*command, "--json")[1])["findings"] == [dataclasses.asdict(limit)]
    status, out, err = run(*command, "--frames", tmp_path / "level.tif", "--json")
    assert status == 0
    own, found = json.loads(out)["findings"]
    assert own == dataclasses.asdict(limit)
    assert (found["kind"], err.count("scatter by") > 0) == ("light", True)


def test_the_command_writes_a_table(made, tmp_path, run):
    array, response = made
    response.save(tmp_path / "response.npz")
    frames = np.stack(list(array.frames(9e6, 8, rng=3)))
    write_frames(tmp_path / "level.tif", frames, nbytes=frames.nbytes)
    command = ["hardware", tmp_path / "response.npz", "-o", tmp_path / "table.hex"]
    status, out, _ = run(*command, "--gain-bits", 12, "--lowest", 100, "--json")
    assert status == 0
    told = json.loads(out)
    table = equipix.load(tmp_path / "table.hex")
    assert same(table, hardware.Table.of(response, gain_bits=12, lowest=100.0))
    assert told["bits"]["gain"] == 12
    assert told["steps"]["gain"] == 2.0**table.format.gain
    assert told["unusable_pixels"] == (table.gain == 0).sum()
    status, _, error = run(*command)
    assert status == 1
    assert "--force" in error
    status, out, _ = run(*command, "--force", "--json", "--frames", tmp_path / "level.tif")
    cost = hardware.quality(response, frames)
    assert json.loads(out)["C_of_table"] == pytest.approx(cost.after.ratio)
    widths = hardware.smallest_widths(response, [frames])
    found = json.loads(out)["sufficient_bits"]
    assert found == {
        "offset": widths.offset_bits,
        "gain": widths.gain_bits,
        "both": widths.both_bits,
    }
    assert 8 < found["gain"] <= 16
    # Beyond the range that the help states; and one file as two levels.
    assert run(*command, "--force", "--gain-bits", 20)[0] == 2
    twice = run(*command, "--force", *2 * ("--frames", tmp_path / "level.tif"))
    assert twice[0] == 1
    assert "level.tif: is named twice" in twice[2]
    assert "Example" in run("hardware", "--help")[1]


def test_the_errors_that_are_stated_bound_those_of_frames(made, tmp_path, run):
    response = made[1]
    response.save(tmp_path / "response.npz")
    run("hardware", tmp_path / "response.npz", "-o", tmp_path / "table.bin", "--out-bits", 12)
    table = equipix.load(tmp_path / "table.bin")
    told = json.loads(run("inspect", tmp_path / "table.bin", "--json")[1])
    raw = np.random.default_rng(1).uniform(1000, 9000, (50, *SHAPE))
    away = np.nanmax(np.abs(table.correct(raw) - response.correct(raw)))
    words, rounding = told["largest_error_dn"], told["rounding_dn"]
    # A step of the output is 4 DN, so its rounding alone is far beyond the error of the words.
    assert words + 0.9 * rounding < away <= words + rounding
    f = table.format
    assert told["steps"] == {
        "adc": 1.0,
        "coarse": 2.0**f.coarse,
        "offset": 2.0**f.offset,
        "gain": 2.0**f.gain,
        "out": 4.0,
    }
    assert (told["base"], told["zero"]) == (f.base, f.zero)


def test_arrays_of_a_table_fit_together(made):
    table = hardware.Table.of(made[1], gain_bits=12)
    parts = {name: getattr(table, name) for name in ("coarse", "offset", "gain", "flags")}
    with pytest.raises(errors.InputError, match="'offset' is int32"):
        hardware.Table(table.format, **parts | {"offset": table.offset.astype(np.int32)})
    with pytest.raises(errors.InputError, match="more than its width"):
        hardware.Table(table.format, **parts | {"gain": table.gain + np.uint16(4096)})
    with pytest.raises(errors.InputError, match="must be 0 where"):
        hardware.Table(table.format, **parts | {"flags": np.zeros(SHAPE, np.uint32)})


@pytest.mark.parametrize("by", ["offset", "gain"])
def test_one_point_corrections_have_a_table(by):
    array = StaringArray.of("PtSi", SHAPE, rng=3)
    dark = np.full(SHAPE, 300.0) if by == "gain" else None
    level = equipix.average(array.frames(9e6, 64, rng=1), dark=dark)
    response = nuc.fit([level], order=0, by=by)
    table = hardware.Table.of(response)
    frame = next(array.frames(9e6, 1, rng=2))
    away = np.abs(table.correct(frame) - response.correct(frame))
    # Half a step of the output, and single precision of 7000 DN.
    limit = 2.0**table.format.out / 2 + table.metadata["largest_error_dn"] + 7000 * 2.0**-22
    assert np.nanmax(away) <= limit
