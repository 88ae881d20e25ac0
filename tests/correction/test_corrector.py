"""Corrections applied by the compiled part: types, rounding, limits, bad pixels, buffers."""

from __future__ import annotations

import copy
import gc
import pickle
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import Corrector, Flag, errors, nuc, simulate
from equipix.correction import apply as kernel

SHAPE = (37, 53)
TYPES = (np.uint8, np.uint16, np.float32)
RNG = np.random.default_rng(7)


class Given:
    """A correction whose coefficients and flags are given."""

    findings, dark, limits, saturation, colours = (), None, None, None, None
    takes_dark = needs_dark = leaves_offset = False
    bits = 0

    def __init__(self, coefficients, bad=()):
        self.coefficients = np.asarray(coefficients)
        self.flags = np.zeros(self.coefficients.shape[1:], np.uint32)
        self.flags.flat[list(bad)] = Flag.DO_NOT_USE
        self.metadata = {}

    @property
    def shape(self):
        return self.flags.shape

    def correct(self, frames, *, dark="stored", flagged="nan", out=None):
        raise NotImplementedError

    def save(self, path, *, force=False):
        raise NotImplementedError


def coefficients(planes, seed=1):
    rng = np.random.default_rng(seed)
    typical = np.array([-20.0, 1.0, 2e-6, -3e-11])[:planes]
    return (typical[:, None, None] * rng.uniform(0.7, 1.3, (planes, *SHAPE))).astype(np.float32)


def frames(dtype=np.uint16, count=3):
    rng = np.random.default_rng(2)
    largest = 255 if dtype == np.uint8 else 65535
    return rng.integers(0, largest + 1, (count, *SHAPE)).astype(dtype)


def horner(planes, raw, dtype=np.float32):
    """Σ c_j y^j, every operation rounded."""
    values = raw.astype(dtype)
    total = np.zeros(raw.shape, dtype)
    for plane in planes[::-1]:
        total = total * values + plane
    return total


def replaced(image, bad, colours=None, reach=1):
    """The mean of the nearest good pixels in place of bad ones, pixel by pixel.

    Those of the smallest square count that holds good ones of the pixel's colour, first in the
    image, then, round by round, those replaced in a round before. NaN counts in no mean.
    """
    values, known = image.astype(np.float64), ~bad
    colours = np.zeros(image.shape) if colours is None else colours
    rows, cols = np.indices(image.shape)
    while not known.all():
        found = {}
        for pixel in zip(*np.nonzero(~known), strict=True):
            far = np.maximum(abs(rows - pixel[0]), abs(cols - pixel[1]))
            for side in range(1, reach + 1):
                around = (far == side) & known & (colours == colours[pixel])
                if around.any():
                    near = values[around]
                    found[pixel] = (
                        near[~np.isnan(near)].mean() if np.isfinite(near).any() else np.nan
                    )
                    break
        if not found:
            values[~known] = np.nan
            break
        for pixel, value in found.items():
            values[pixel], known[pixel] = value, True
    return values


class TestAgainstNumPy:
    @pytest.mark.parametrize("planes", [1, 2, 3, 4])
    @pytest.mark.parametrize("raw", TYPES)
    @pytest.mark.parametrize("dtype", TYPES)
    def test_every_type_and_order(self, planes, raw, dtype):
        given = Given(coefficients(planes))
        corrector = Corrector(given, dtype)
        got = corrector.apply(frames(raw))
        wanted = horner(given.coefficients, frames(raw))
        if dtype == np.float32:
            # A product and a sum may not be fused: the same bytes.
            assert got.tobytes() == wanted.tobytes()
            assert corrector.clipped == 0
            return
        rounded = np.rint(wanted)
        largest = np.iinfo(dtype).max
        np.testing.assert_array_equal(got, np.clip(rounded, 0, largest))
        assert corrector.clipped == np.count_nonzero((rounded < 0) | (rounded > largest))

    def test_whole_numbers_round_half_to_even(self):
        halves = np.array([[0.5, 1.5, 2.5, -0.5, -0.50001, 254.5, 255.5]], np.float32)
        corrector = Corrector(Given(halves[None]), "uint8")
        got = corrector.apply(np.zeros(halves.shape, np.uint8))
        assert got.tolist() == [[0, 2, 2, 0, 0, 254, 255]]
        assert corrector.clipped == 2

    @pytest.mark.parametrize("bits", range(8, 17))
    def test_the_bits_of_the_camera_limit_values(self, bits):
        given = Given(coefficients(2))
        corrector = Corrector(given, bit_depth=bits)
        got, largest = corrector.apply(frames()), 2**bits - 1
        wanted = np.rint(horner(given.coefficients, frames()))
        np.testing.assert_array_equal(got, np.clip(wanted, 0, largest))
        assert corrector.clipped == np.count_nonzero((wanted < 0) | (wanted > largest))

    @pytest.mark.parametrize("flagged", ["replace", "nan", "keep"])
    def test_flagged_pixels(self, flagged):
        bad = [0, 60, *(r * SHAPE[1] + c for r in range(10, 14) for c in range(20, 25))]
        given = Given(coefficients(2), bad)
        got = Corrector(given, "float32", flagged=flagged).apply(frames())
        mask = given.flags != 0
        for each, raw in zip(got, frames(), strict=True):
            wanted = horner(given.coefficients, raw)
            if flagged == "replace":
                wanted = replaced(wanted, mask)
            elif flagged == "nan":
                wanted[mask] = np.nan
            np.testing.assert_array_equal(each[~mask], wanted[~mask])
            # A sum of eight values in float32: some roundings of it.
            np.testing.assert_allclose(each[mask], wanted[mask], rtol=1e-6)

    @pytest.mark.parametrize("planes", [2, 3, 4])
    @pytest.mark.parametrize(
        ("raw", "out"),
        [
            (np.float64, np.float64),
            (np.float64, np.float32),
            (np.int32, np.float64),
            (np.int32, np.float32),
            (np.uint16, np.float64),
            (np.float32, np.float64),
        ],
    )
    def test_double_precision(self, planes, raw, out):
        bad = [0, 60, *(r * SHAPE[1] + c for r in range(10, 14) for c in range(20, 25))]
        given = Given(coefficients(planes).astype(np.float64), bad)
        correction = equipix.Polynomial(given.coefficients, given.flags)
        mask = given.flags != 0
        exact = horner(given.coefficients, frames(raw), np.float64)
        for flagged in ("keep", "nan", "replace"):
            result = np.empty((3, *SHAPE), out)
            assert correction.correct(frames(raw), flagged=flagged, out=result) is result
            for got, kept in zip(result, exact, strict=True):
                wanted = kept.copy()
                if flagged == "replace":
                    wanted = replaced(kept, mask)
                elif flagged == "nan":
                    wanted[mask] = np.nan
                # Products and sums are not fused: the same bytes, before float32 rounds them.
                assert got[~mask].tobytes() == wanted[~mask].astype(out).tobytes()
                # A mean of eight values: some roundings of it.
                np.testing.assert_allclose(got[mask], wanted[mask], rtol=8 * np.finfo(out).eps)

    @pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
    def test_colours_are_replaced_by_their_own(self, dtype):
        planes, flags = identity()
        flags[RNG.random(SHAPE) < 0.4] = Flag.DO_NOT_USE
        sensor = {"sensor": {"cfa": ["RGG", "GBW", "GWB"]}}
        correction, raw = equipix.Polynomial(planes, flags, sensor), frames(dtype)[0]
        colours = np.tile([[0, 1, 1], [1, 2, 3], [1, 3, 2]], (13, 18))[: SHAPE[0], : SHAPE[1]]
        wanted = replaced(raw, flags != 0, colours, reach=3)
        found = correction.correct(raw, flagged="replace")
        np.testing.assert_allclose(found, wanted, rtol=24 * np.finfo(found.dtype).eps)

    def test_an_array_that_is_no_plain_buffer(self):
        correction = equipix.Polynomial(coefficients(3), np.zeros(SHAPE, np.uint32))
        for dtype in (np.float32, np.float64):
            raw = frames(dtype)
            wanted = correction.correct(raw)
            wide = np.empty((3, SHAPE[0], 2 * SHAPE[1]), dtype)
            assert correction.correct(raw, out=wide[..., ::2]).base is wide
            np.testing.assert_array_equal(wide[..., ::2], wanted)
            assert correction.correct(raw, out=raw) is raw
            np.testing.assert_array_equal(raw, wanted)

    @pytest.mark.parametrize("dtype", TYPES)
    def test_the_treatment_follows_from_the_type_unless_it_is_named(self, dtype):
        given = Given(coefficients(2), [0, 60])
        whole = dtype != np.float32
        wanted = Corrector(given, dtype, flagged="replace" if whole else "nan")
        corrector = Corrector(given, dtype)
        np.testing.assert_array_equal(corrector.apply(frames()), wanted.apply(frames()))
        assert corrector.replaced == (2 if whole else 0)

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
    def test_whole_numbers_hold_no_nan(self, dtype):
        polynomial = equipix.Polynomial(*identity())
        message = f"'nan', which {np.dtype(dtype)} does not hold: take 'replace' or 'keep'"
        with pytest.raises(errors.InputError, match=message):
            Corrector(polynomial, dtype, flagged="nan")
        with pytest.raises(errors.InputError, match=message):
            polynomial.correct(frames(), out=np.empty((3, *SHAPE), dtype))

    def test_a_stack_is_its_frames_one_by_one(self):
        corrector = Corrector(Given(coefficients(4), [70]))
        stack = corrector.apply(frames())
        assert corrector.frames == 3
        for each, raw in zip(stack, frames(), strict=True):
            np.testing.assert_array_equal(corrector.apply(raw), each)
        assert corrector.frames == 6

    def test_any_number_of_workers_gives_the_same_bytes(self):
        # Above 2^20 pixels, where threads work on parts of a frame.
        large = Given(np.tile(coefficients(2), (1, 30, 24)), [5])
        raw = np.tile(frames(count=1), (1, 30, 24))
        one, three = (Corrector(large, workers=each).apply(raw) for each in (1, 3))
        assert one.tobytes() == three.tobytes()

    def test_any_number_of_workers_gives_the_same_stack(self):
        # Above 2^20 values, where each thread takes whole frames.
        given, raw = Given(coefficients(3), [5, 6, 58, 59, 60]), frames(count=2**20 // 1961 + 1)
        one, three = Corrector(given, workers=1), Corrector(given, workers=3)
        assert one.apply(raw).tobytes() == three.apply(raw).tobytes()
        assert one.clipped == three.clipped > 0
        np.testing.assert_array_equal(one.apply(raw[-1]), three.apply(raw)[-1])

    def test_threads_share_one_corrector(self):
        corrector = Corrector(Given(coefficients(2), [0, 1, 2, 60, 61]), "float32")
        raw = frames(count=24)
        wanted = [corrector.apply(each).tobytes() for each in raw]
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda each: corrector.apply(each).tobytes(), [*raw] * 20))
        assert found == wanted * 20

    def test_counts_of_several_threads_add_up(self):
        corrector = Corrector(Given(np.stack([np.full(SHAPE, -1.0), np.zeros(SHAPE)])), "uint16")
        raw = frames(count=40)
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda _: corrector.apply(raw), range(100)))
        assert corrector.frames == 100 * len(raw)
        assert corrector.clipped == 100 * raw.size


class TestNotANumber:
    def test_a_raw_value_does_not_spread(self):
        corrector = Corrector(Given(coefficients(2), [60]), "float32", flagged="replace")
        raw = frames(np.float32, 1)[0]
        raw.flat[61] = np.nan
        got = corrector.apply(raw)
        assert np.flatnonzero(np.isnan(got)).tolist() == [61]
        whole = Corrector(Given(coefficients(2), [60]), "uint16")
        assert whole.apply(raw).flat[61] == 0
        assert whole.clipped >= 1

    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_coefficients_of_a_replaced_pixel_play_no_part(self, value):
        planes = coefficients(2)
        wanted = Corrector(Given(planes, [60])).apply(frames())
        planes[:, 1, 7] = value
        got = Corrector(Given(planes, [60])).apply(frames())
        np.testing.assert_array_equal(got, wanted)

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    def test_a_corrected_value_is_no_neighbour(self, dtype):
        planes, flags = np.stack([np.zeros((5, 5)), np.ones((5, 5))]), np.zeros((5, 5), np.uint32)
        flags[2, 2] = Flag.DO_NOT_USE
        image = np.ones((5, 5), dtype)
        image[2, 2], image[1, 1] = 7, np.nan
        found = equipix.Polynomial(planes, flags).correct(image, flagged="replace")
        assert found[2, 2] == 1
        assert np.flatnonzero(np.isnan(found)).tolist() == [6]


class TestBuffers:
    def test_the_result_goes_where_the_caller_says(self):
        corrector = Corrector(Given(coefficients(2)))
        out = np.empty(SHAPE, np.uint16)
        assert corrector.apply(frames()[0], out) is out
        np.testing.assert_array_equal(out, corrector.apply(frames()[0]))

    def test_a_frame_need_not_be_aligned(self):
        corrector = Corrector(Given(coefficients(2)))
        raw = frames()[0]
        moved = np.frombuffer(b"0" + raw.tobytes(), np.uint8)[1:].view(np.uint16).reshape(SHAPE)
        assert not moved.flags.aligned
        np.testing.assert_array_equal(corrector.apply(moved), corrector.apply(raw))
        out = np.frombuffer(bytearray(raw.nbytes + 1), np.uint8)[1:].view(np.uint16)
        with pytest.raises(errors.InputError, match="'out' is not contiguous, not aligned"):
            corrector.apply(raw, out.reshape(SHAPE))

    def test_a_frame_need_not_be_contiguous(self):
        corrector = Corrector(Given(coefficients(2)))
        wide = np.repeat(frames(), 2, axis=2)
        np.testing.assert_array_equal(corrector.apply(wide[:, :, ::2]), corrector.apply(frames()))

    @pytest.mark.parametrize(
        ("out", "message"),
        [
            (np.empty(SHAPE, np.uint8), "'out' is uint8"),
            (np.empty((3, 4), np.uint16), r"'out' is uint16 of shape \(3, 4\)"),
            ([1, 2], "'out' is list"),
            (np.empty((SHAPE[0], 106), np.uint16)[:, ::2], "contiguous"),
        ],
    )
    def test_other_buffers_are_refused(self, out, message):
        with pytest.raises(errors.InputError, match=message):
            Corrector(Given(coefficients(2))).apply(frames()[0], out)

    def test_the_frames_themselves_are_no_buffer(self):
        raw = frames()[0]
        with pytest.raises(errors.InputError, match="overlaps"):
            Corrector(Given(coefficients(2))).apply(raw, raw)
        locked = np.empty(SHAPE, np.uint16)
        locked.flags.writeable = False
        with pytest.raises(errors.InputError, match="expected a writeable uint16 array"):
            Corrector(Given(coefficients(2))).apply(raw, locked)


class TestRefusals:
    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"dtype": "float64"}, "'dtype' is float64, expected"),
            ({"dtype": "nonsense"}, "'dtype' is 'nonsense'"),
            ({"bit_depth": 17}, "'bit_depth' is 17, expected 8 to 16"),
            ({"bit_depth": 7}, "'bit_depth' is 7, expected 8 to 16"),
            ({"dtype": "uint8", "bit_depth": 12}, "'bit_depth' is 12, expected 8 to 8"),
            ({"dtype": "float32", "bit_depth": 12}, "12, but float32 has none: leave it out"),
            ({"flagged": "bad"}, "'flagged' is 'bad'"),
            ({"workers": 0}, "'workers'"),
        ],
    )
    def test_wrong_arguments(self, given, message):
        with pytest.raises(errors.InputError, match=message):
            Corrector(Given(coefficients(2)), **given)

    @pytest.mark.parametrize(
        ("given", "was"),
        [
            ("r1.tif", "'r1.tif'"),
            (Path("r1.tif"), r"PosixPath\('r1.tif'\)"),
            (None, "None"),
            (np.ones(SHAPE), "of type ndarray"),
        ],
    )
    def test_what_is_no_correction(self, given, was):
        right, message = Given(coefficients(2)), f"is {was}, expected a correction: equipix.load"
        with pytest.raises(errors.InputError, match=f"'correction' {message}"):
            Corrector(given)
        with pytest.raises(errors.InputError, match=f"'first' {message}"):
            equipix.combine(given, right)
        with pytest.raises(errors.InputError, match=f"'then' {message}"):
            equipix.combine(right, given)

    def test_frames_of_other_shapes_and_types(self):
        corrector = Corrector(Given(coefficients(2)))
        with pytest.raises(errors.InputError, match=r"shape \(3, 4\), the sensor \(37, 53\)"):
            corrector.apply(np.zeros((3, 4), np.uint16))
        with pytest.raises(errors.InputError, match="'frames' is float64, expected uint8"):
            corrector.apply(np.zeros(SHAPE))

    def test_five_coefficients(self):
        with pytest.raises(errors.InputError, match="coefficients"):
            Corrector(Given(np.ones((5, *SHAPE))))

    def test_frames_of_another_bit_depth(self):
        level = np.random.default_rng(1).integers(1000, 2000, (2, 4, *SHAPE), dtype=np.uint16)
        averages = [
            equipix.average(each + 500 * k, saturation=4095) for k, each in enumerate(level)
        ]
        corrector = Corrector(nuc.fit(averages, order=0))
        with pytest.raises(
            errors.InputError, match="uint8, but the correction was measured with 12"
        ):
            corrector.apply(np.zeros(SHAPE, np.uint8))

    @pytest.mark.parametrize("value", [4096, 60000])
    def test_values_above_those_of_the_sensor(self, value):
        response = twelve_bits()
        message = f"'frames' holds {value}, above 4095, the largest value of the 12 bits"
        raw = np.full(SHAPE, 4095, np.uint16)
        corrector, both = (
            Corrector(response),
            equipix.combine(response, equipix.Polynomial(*identity())),
        )
        corrector.apply(raw)
        np.testing.assert_array_equal(
            both.correct(raw), equipix.Polynomial(both.coefficients, both.flags).correct(raw)
        )
        raw[-1, -1] = value
        for correct in (response.correct, corrector.apply, both.correct, Corrector(both).apply):
            with pytest.raises(errors.InputError, match=message):
                correct(raw)
        for frames in (raw.astype(np.float32), raw.astype(np.float64), raw.tolist()):
            with pytest.raises(errors.InputError, match=message):
                both.correct(frames)
        with pytest.raises(errors.InputError, match=message):
            corrector.apply(raw.astype(np.float32))
        assert corrector.frames == 1

    @pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
    def test_a_level_below_full_scale_refuses_no_value_of_the_sensor(self, dtype):
        response = twelve_bits(saturation=3900)
        raw = np.full(SHAPE, 2000, dtype)
        corrector, both = (
            Corrector(response),
            equipix.combine(response, equipix.Polynomial(*identity())),
        )
        for value, holds in ((4095, nullcontext()), (4096, pytest.raises(errors.InputError))):
            raw[3, 4] = value
            for correct in (response.correct, both.correct, corrector.apply):
                if correct != corrector.apply or dtype != np.float64:
                    with holds:
                        correct(raw)

    def test_the_bit_depth_in_the_metadata_comes_first(self):
        response = replace(twelve_bits(saturation=2000), metadata={"sensor": {"bit_depth": 13}})
        raw = np.full(SHAPE, 8191, np.uint16)
        response.correct(raw)
        message = "holds 8192, above 8191, the largest value of the 13 bits"
        for exact in (False, True):
            with pytest.raises(errors.InputError, match=message):
                response.correct(raw + 1, exact=exact)

    def test_a_level_without_end_refuses_nothing(self):
        raw = np.full(SHAPE, 60000, np.uint16)
        assert np.isfinite(twelve_bits(saturation=np.inf).correct(raw)).all()

    def test_whole_numbers_beyond_the_bits_of_a_calibration(self):
        metadata = {"sensor": {"name": "", "bit_depth": 12}}
        calibration = replace(calibrated(), metadata=metadata)
        corrector, raw = Corrector(calibration), np.full(SHAPE, 4095, np.uint16)
        for correct in (calibration.correct, corrector.apply):
            correct(raw)
            with pytest.raises(errors.InputError, match="'frames' holds 4096, above 4095"):
                correct(raw + 1)
            with pytest.raises(errors.InputError, match="uint8, but the correction was measured"):
                correct(np.zeros(SHAPE, np.uint8))
            correct(raw.astype(np.float32) * 3)  # electrons, perhaps
        with pytest.raises(errors.InputError, match="'frames' holds 4096, above 4095"):
            calibration.correct((raw + 1).astype(np.int64))

    def test_a_combination_keeps_the_level_in_its_file(self, tmp_path):
        response = twelve_bits()
        equipix.combine(response, equipix.Polynomial(*identity())).save(tmp_path / "both.tif")
        assert equipix.load(tmp_path / "both.tif").saturation == 4095

    def test_memory_that_cannot_be_had(self):
        corrector = Corrector(Given(coefficients(2)))
        frames = np.broadcast_to(np.uint16(1), (2**50, *SHAPE))
        with pytest.raises(errors.InsufficientMemoryError, match="correcting: .* EiB"):
            corrector.apply(frames)

    def test_frames_of_another_sensor(self):
        given = Given(coefficients(2))
        with pytest.raises(errors.InputError, match="names no sensor"):
            Corrector(given, sensor="array 7")
        given.metadata["sensor"] = {"name": "array 7"}
        Corrector(given, sensor="array 7")
        with pytest.raises(errors.InputError, match="'array 8', but the correction is of 'array 7"):
            Corrector(given, sensor="array 8")


def twelve_bits(saturation=4095):
    """A response to levels of 12 bits in 16."""
    level = np.random.default_rng(1).integers(1000, 1100, (2, 4, *SHAPE), dtype=np.uint16)
    averages = [
        equipix.average(each + 900 * k, saturation=saturation) for k, each in enumerate(level)
    ]
    return nuc.fit(averages, order=1)


class TestCountsOfLevels:
    # Levels of curved responses, to which order 1 is no fit.
    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    @pytest.mark.parametrize("order", [1, 2])
    def test_are_those_that_the_response_tells(self, order):
        array = simulate.StaringArray.of("HgCdTe", SHAPE, rng=3)
        averages = [
            equipix.average(array.frames(e, 8, rng=k)) for k, e in enumerate((3e6, 8e6, 14e6))
        ]
        mask = np.zeros((3, *SHAPE), bool)
        mask[2, :5], mask[0, 7:9] = True, True
        response = nuc.fit(averages, order=order, mask=mask)
        raw = frames(count=4) % 16384
        corrector = Corrector(response, flagged="keep")
        corrector.apply(raw)
        known = np.isfinite(response.coefficients[0])
        assert corrector.extrapolated == np.count_nonzero(response.extrapolated(raw) & known) > 0

    def test_a_level_itself_is_inside(self):
        gain = simulate.paper_sensitivity(SHAPE, rng=1).astype(np.float32)
        levels = np.stack([gain * level for level in (100.0, 4000.0)]).astype(np.float32)
        corrector = Corrector(nuc.fit(levels), "float32")
        corrector.apply(levels)
        assert corrector.extrapolated == 0
        corrector.apply(levels * np.float32(1.001))
        assert corrector.extrapolated == gain.size

    def test_a_calibration_and_one_level_have_none(self, result):
        one = nuc.fit([np.full(SHAPE, 100.0)], order=0)
        assert Corrector(one).extrapolated is None
        assert (Corrector(result).extrapolated is None) == isinstance(result, equipix.Calibration)

    def test_pixels_without_a_good_neighbour_are_not_counted_as_replaced(self):
        planes = coefficients(2)
        assert Corrector(Given(planes, [0, 60])).replaced == 2
        assert Corrector(Given(planes, range(planes[0].size))).replaced == 0


class TestDarks:
    @pytest.fixture
    def calibration(self):
        return calibrated()

    def test_a_calibration_without_one_needs_one(self, calibration):
        plain = equipix.Calibration(**vars(calibration) | {"dark": None})
        for door in (lambda: plain.correct(frames()), lambda: Corrector(plain)):
            with pytest.raises(errors.InputError, match="this calibration holds no dark frame"):
                door()
        raw = frames()
        for dark in (None, np.full(SHAPE, 30.0)):
            wanted = plain.correct(raw, dark=dark, flagged="replace")
            found = Corrector(plain, "float32", dark=dark).apply(raw)
            np.testing.assert_array_equal(found, wanted)

    def test_another_takes_the_place_of_that_stored(self, calibration):
        raw = frames()
        dark = equipix.average(np.stack([np.full(SHAPE, 40), np.full(SHAPE, 42)]).astype(np.uint16))
        for given in (dark, np.full(SHAPE, 41.0), None):
            wanted = calibration.correct(raw, dark=given, flagged="keep")
            found = Corrector(calibration, "float32", dark=given, flagged="keep").apply(raw)
            np.testing.assert_array_equal(found, wanted)
        with pytest.raises(errors.InputError, match="'dark' has shape"):
            Corrector(calibration, dark=np.ones((3, 4)))

    def test_offsets_that_are_part_of_the_curves_take_none(self):
        with pytest.raises(errors.InputError, match="the offsets of this response are part of"):
            Corrector(twelve_bits(), dark=np.zeros(SHAPE))
        with pytest.raises(errors.InputError, match="offsets of this correction are part of it"):
            Corrector(Given(coefficients(2)), dark=None)

    def test_a_dead_pixel_without_a_dark_is_infinite(self, calibration):
        sensitivity = calibration.sensitivity.copy()
        sensitivity[4, 5] = 0
        dead = equipix.Calibration(**vars(calibration) | {"sensitivity": sensitivity})
        for dtype in (np.uint16, np.float64):
            raw = np.full(SHAPE, 100, dtype)
            assert np.isinf(dead.correct(raw, dark=None, flagged="keep")[4, 5])


@pytest.fixture(scope="module", params=["calibration", "response", "response with a dark"])
def result(request):
    if request.param == "calibration":
        return calibrated()
    truth = simulate.paper_sensitivity(SHAPE, rng=1)
    response = nuc.fit([truth * level + 5 for level in (500.0, 2000.0, 3000.0)], order=2)
    return response if request.param == "response" else replace(response, dark=60 * truth)


def calibrated():
    """A calibration with a dark of 60 DN."""
    truth = simulate.paper_sensitivity(SHAPE, rng=1)
    shifts = equipix.cross_pattern(5, 7)
    beam = simulate.gaussian_beam(SHAPE, width=100, amplitude=1000)
    cal = equipix.calibrate(simulate.exposures(truth, beam, shifts), shifts)
    return equipix.Calibration(**vars(cal) | {"dark": np.full(SHAPE, 60.0)})


def identity():
    return np.stack([np.zeros(SHAPE), np.ones(SHAPE)]), np.zeros(SHAPE, np.uint32)


class TestResults:
    """`correct` of both results goes the same way."""

    @pytest.mark.parametrize("raw", TYPES)
    @pytest.mark.parametrize("dtype", TYPES)
    def test_into_every_type(self, result, raw, dtype):
        out = np.empty((3, *SHAPE), dtype)
        assert result.correct(frames(raw), flagged="replace", out=out) is out
        np.testing.assert_array_equal(out, Corrector(result, dtype).apply(frames(raw)))

    def test_coefficients_are_prepared_once(self, result, monkeypatch):
        made = []
        real = kernel.Prepared
        monkeypatch.setattr(
            kernel, "Prepared", lambda *given, **more: made.append(1) or real(*given, **more)
        )
        first = result.correct(frames(), flagged="replace")
        for _ in range(3):
            again = result.correct(frames(), flagged="replace")
            np.testing.assert_array_equal(again, first)
        assert len(made) <= 1
        other = equipix.combine(result, equipix.Polynomial(*identity()))
        assert not np.array_equal(other.correct(frames(), flagged="replace"), first - 1)

    def test_prepared_coefficients_are_those_asked_for(self):
        planes, flags = identity()
        flags[3, 4] = Flag.DO_NOT_USE
        polynomial, other = (equipix.Polynomial(each * planes, flags) for each in (1, 2))
        for _ in range(2):
            for flagged in ("nan", "keep", "replace"):
                for each in (polynomial, other):
                    wanted = Corrector(each, "float32", flagged=flagged).apply(frames())
                    found = each.correct(frames(), flagged=flagged)
                    np.testing.assert_array_equal(found, wanted)

    def test_a_dark_of_the_caller_may_change(self):
        calibration, dark = calibrated(), np.full(SHAPE, 10.0)
        first = calibration.correct(frames(), dark=dark)
        dark += 5
        wanted = calibration.correct(frames(), dark=np.full(SHAPE, 15.0))
        again = calibration.correct(frames(), dark=dark)
        np.testing.assert_array_equal(again, wanted)
        assert (again < first).all()

    def test_prepared_coefficients_end_with_their_result(self, monkeypatch):
        made = []
        real = kernel.Prepared

        def prepared(*given, **more):
            found = real(*given, **more)
            made.append(weakref.ref(found))
            return found

        monkeypatch.setattr(kernel, "Prepared", prepared)
        polynomial = equipix.Polynomial(*identity())
        polynomial.correct(frames())
        gc.collect()
        assert [each() is None for each in made] == [False]
        del polynomial
        gc.collect()
        assert [each() is None for each in made] == [True]

    def test_prepared_coefficients_are_no_part_of_a_copy_or_a_file(self, result):
        for dtype in (np.uint16, np.float64):
            wanted = result.correct(frames(dtype))
            for again in (pickle.loads(pickle.dumps(result)), copy.copy(result)):
                np.testing.assert_array_equal(again.correct(frames(dtype)), wanted)
        assert "_last" not in vars(result)

    def test_close_to_double_precision(self, result):
        single = result.correct(frames(), flagged="keep")
        double = result.correct(frames().astype(np.float64), flagged="keep")
        assert (single.dtype, double.dtype) == (np.float32, np.float64)
        # Coefficients, products and sums of Horner's scheme: three roundings a power.
        atol = 9 * np.finfo(np.float32).eps * 65535
        np.testing.assert_allclose(single, double, rtol=0, atol=atol)
