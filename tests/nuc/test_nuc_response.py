"""The response as a correction: files, command line, flags, real levels of a camera."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
import warnings

import numpy as np
import pytest

import equipix
from equipix import Flag, cli, errors, metrics, nuc, simulate
from equipix.io.frames import read_frames, stream_frames
from equipix.io.tiff import write_frames
from equipix.measured.noise import median_of_noise
from equipix.nuc.response import common_misfit, pattern_variance, typical
from records import rewrite

SHAPE = (24, 32)
LEVELS = (200.0, 1000.0, 2000.0, 3000.0)


@pytest.fixture(scope="module")
def averages():
    """Four levels of a 12-bit camera in 16-bit frames, with a dead pixel."""
    rng = np.random.default_rng(1)
    gain = 1 + 0.05 * rng.standard_normal(SHAPE)
    gain[3, 4] = 0
    dark = equipix.average(
        np.rint(60 + 3 * rng.standard_normal((16, *SHAPE))).astype(np.uint16), saturation=4095
    )
    return [
        equipix.average(
            np.rint(60 + level * gain + 3 * rng.standard_normal((4, *SHAPE))).astype(np.uint16),
            dark=dark,
            saturation=4095,
        )
        for level in LEVELS
    ]


@pytest.fixture(scope="module", params=[0, 1, 3])
def response(request, averages):
    return nuc.fit(averages, order=request.param)


def frames(count=3):
    return np.random.default_rng(2).integers(100, 3000, (count, *SHAPE), dtype=np.uint16)


@pytest.mark.long
def test_the_pattern_that_noise_leaves_is_predicted():
    """Order 2 leaves an InSb array noise alone; order 1 leaves its curvature, too."""
    count, squares, predicted = 32, [], []
    for seed in range(8):
        array = simulate.StaringArray.of("InSb", (48, 64), rng=seed)
        dark = equipix.average(array.frames(0, 16, rng=[seed, 9])) if seed % 2 else None
        levels = [
            equipix.average(array.frames(light, 16, rng=[seed, number]), dark=dark)
            for number, light in enumerate((3e6, 6e6, 9e6, 12e6, 16e6))
        ]
        frames = list(array.frames(11e6, count, rng=[seed, 10]))
        for order in (1, 2):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore" if order == 1 else "error", errors.MisfitWarning)
                response = nuc.fit(levels, order=order)
            found = metrics.correctability(response.correct(frames, flagged="nan"))
            wanted = pattern_variance(response, found.level)
            if order == 1:
                assert found.low > (wanted / found.temporal_variance) ** 0.5
            else:
                squares.append(found.spatial_variance)
                predicted.append(wanted)
                error = wanted + found.temporal_variance / count
    # Four standard errors of the mean of eight variances over 3072 pixels.
    error *= 4 * (2 / 3072 / 8) ** 0.5
    assert np.mean(squares) == pytest.approx(np.mean(predicted), abs=error)
    by_gain = nuc.fit([each.mean for each in levels], order=0, by="gain")
    assert np.isnan(pattern_variance(by_gain, 5000.0))
    colours = nuc.fit(levels, order=2, cfa="RGGB")
    assert np.isnan(pattern_variance(colours, 5000.0))


def made(dark=60.0, order=3, count=5):
    """A response of levels whose dark was subtracted, as arrays without noise; its levels."""
    rng, levels = np.random.default_rng(3), np.linspace(200.0, 3000.0, count)
    sizes = (5.0, 0.05, 5e-6, 5e-10)
    planes = [size * rng.uniform(-1, 1, SHAPE) for size in sizes[: order + 1]]
    planes = [each - each.mean() for each in planes]  # then the mean of the array is v
    values = [v + sum(q * v**i for i, q in enumerate(planes)) for v in levels]
    found = nuc.fit(values, order=order, variance=np.full(count, 4.0))
    return dataclasses.replace(found, dark=np.full(SHAPE, dark), findings=()), values


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")  # no noise
class TestRange:
    def test_it_has_its_ends_and_lies_above_a_stored_dark(self):
        response, _ = made()
        low, high = response.valid_range + 60.0
        assert not response.extrapolated(np.stack([low, high])).any()
        assert response.extrapolated(np.nextafter(low, 0.0)).all()
        assert response.extrapolated(np.nextafter(high, np.inf)).all()

    def test_the_exact_inverse_is_of_frames_less_the_stored_dark(self):
        response, values = made()
        for value in values:
            found = response.correct(value + 60.0, exact=True)
            # All pixels saw one light: rounding of a fit of four powers scaled to [−1, 1].
            np.testing.assert_allclose(found, found.flat[0], rtol=1e-10)
        shifted, _ = made(dark=100.0)
        np.testing.assert_allclose(
            shifted.correct(values[2] + 100.0, exact=True),
            response.correct(values[2] + 60.0, exact=True),
            rtol=1e-10,
        )

    def test_a_curve_without_an_inverse_has_no_exact_value(self):
        response, values = made()
        inverse = response.inverse.copy()
        inverse[:, 2, 3] = np.nan
        changed = dataclasses.replace(response, inverse=inverse)
        found = changed.correct(values[2] + 60.0, exact=True, flagged="keep")
        np.testing.assert_array_equal(np.argwhere(np.isnan(found)), [[2, 3]])

    def test_the_largest_error_of_the_inverse_is_of_usable_pixels(self):
        response, _ = made()
        worst = np.unravel_index(response.inverse_error.argmax(), SHAPE)
        flags = np.zeros(SHAPE, np.uint32)
        flags[worst] = Flag.HOT | Flag.DO_NOT_USE
        others = np.delete(response.inverse_error.ravel(), response.inverse_error.argmax())
        assert response.largest_inverse_error == response.inverse_error.max()
        assert response.with_flags(flags).largest_inverse_error == others.max()

    def test_flags_given_again_stay(self):
        response, _ = made()
        flags = np.full(SHAPE, 2**32 - 1, np.uint64)
        once = response.with_flags(flags)
        np.testing.assert_array_equal(once.flags, flags)
        np.testing.assert_array_equal(once.with_flags(flags).flags, flags)


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")  # no noise
class TestPatternVariance:
    """With two levels and known variances it is a formula."""

    LEVELS = np.array([500.0, 2500.0])
    VARIANCES = np.array([4.0, 25.0])

    def fitted(self, **options):
        gain = 1 + 0.3 * np.linspace(-1, 1, 24 * 32).reshape(SHAPE)
        values = self.LEVELS[:, None, None] * gain
        return gain, nuc.fit(values, variance=self.VARIANCES, **options)

    @pytest.mark.parametrize("level", [500.0, 1000.0, 2500.0, 4000.0])
    def test_it_is_that_of_the_line_over_the_square_of_the_slope(self, level):
        gain, response = self.fitted()
        share = (level - 500) / 2000
        variance = (1 - share) ** 2 * 4 + share**2 * 25
        wanted = np.mean(variance / gain**2)
        # Rounding of the inverse of a 2×2 matrix whose columns are alike to a fifth.
        assert pattern_variance(response, level) == pytest.approx(wanted, rel=1e-9)

    def test_pixels_without_a_value_at_some_level_do_not_count(self):
        gain, response = self.fitted()
        used = response.used.copy()
        used[:, :16] = 1
        response = dataclasses.replace(response, used=used)
        wanted = np.mean(25 / gain[:, 16:] ** 2)
        assert pattern_variance(response, 2500.0) == pytest.approx(wanted, rel=1e-9)

    def test_one_point_by_offset_has_one_without_a_dark_alone(self):
        _, response = self.fitted(order=0)
        # The weighted mean of both levels, at any level.
        wanted = pytest.approx(1 / (1 / 4 + 1 / 25), rel=1e-9)
        assert [pattern_variance(response, at) for at in (0.0, 3000.0)] == [wanted] * 2
        with_dark = dataclasses.replace(response, dark=np.zeros(SHAPE))
        assert np.isnan(pattern_variance(with_dark, 3000.0))


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")  # no noise
class TestTypical:
    @pytest.mark.parametrize("freedom", [1, 2, 6])
    def test_it_is_one_of_noise_of_any_freedom(self, freedom):
        count = 20_000
        squares = np.random.default_rng(freedom).chisquare(freedom, count) / freedom
        found = typical(squares, np.full(count, freedom))
        # Five standard errors of the median, which are largest for one degree of freedom.
        assert found == pytest.approx(1, abs=5 * 2.33 / np.sqrt(count))

    def test_it_is_no_more_than_the_mean(self):
        """Of few different values the median may be any."""
        assert typical(np.array([1.0, 1.0, 1.0, 0.0, 0.0]), np.array(1)) == 0.6

    def test_usable_pixels_with_freedom_alone_have_a_misfit_in_common(self):
        response, _ = made(order=1)
        # The median of a third below, a third at and a third above is that of noise.
        chi2 = np.tile(np.repeat([0.9, 1.0, 5.0], 4), (SHAPE[0], 1)) * median_of_noise(np.array(3))
        chi2, used = np.hstack([np.zeros((SHAPE[0], 20)), chi2]), response.used.copy()
        flags = np.zeros(SHAPE, np.uint32)
        flags[:, :10], used[:, 10:20] = Flag.HOT | Flag.DO_NOT_USE, 2
        chi2[:, :20] = 50.0
        odd = dataclasses.replace(response, reduced_chi2=chi2, used=used, flags=flags)
        assert common_misfit(odd) == pytest.approx(1, rel=1e-12)


class TestFile:
    @pytest.mark.parametrize("suffix", [".tif", ".npz"])
    def test_brings_back_every_bit(self, response, tmp_path, suffix):
        path = tmp_path / f"response{suffix}"
        response.save(path)
        loaded = equipix.load(path)
        assert isinstance(loaded, nuc.Response)
        for name, value in vars(response).items():
            if isinstance(value, np.ndarray):
                assert getattr(loaded, name).dtype == value.dtype
                np.testing.assert_array_equal(getattr(loaded, name), value)
            else:
                assert getattr(loaded, name) == value
        corrected = response.correct(frames(), flagged="replace")
        np.testing.assert_array_equal(loaded.correct(frames(), flagged="replace"), corrected)

    def test_is_not_replaced_without_force(self, response, tmp_path):
        response.save(tmp_path / "r.npz")
        with pytest.raises(errors.FileError, match="exists already"):
            response.save(tmp_path / "r.npz")
        response.save(tmp_path / "r.npz", force=True)

    @pytest.mark.parametrize(
        ("fields", "content", "message"),
        [
            ({}, {"version": 3}, "holds response of version 3, this version .* reads version 2"),
            ({"levels": "many"}, {}, "damaged"),
            ({"saturation": "full"}, {}, "damaged: 'saturation' is 'full', expected float"),
            ({"raw": 1}, {}, "damaged: 'raw' is 1, expected bool"),
            ({"cfa": {"pattern": []}}, {}, "damaged: 'cfa' is"),
        ],
    )
    def test_with_other_metadata_is_refused(self, response, tmp_path, fields, content, message):
        path = tmp_path / "r.npz"
        response.save(path)
        rewrite(path, fields, **content)
        with pytest.raises(errors.FileError, match=message):
            equipix.load(path)

    @pytest.mark.parametrize("name", ["deviation", "variances", "inverse", "limits", "flags"])
    def test_with_a_page_missing_or_cut_is_refused(self, response, tmp_path, name):
        path, page = tmp_path / "r.npz", getattr(response, name)
        for changed in (None, page[:-1], page[..., :-1]):
            response.save(path, force=True)
            rewrite(path, arrays={name: changed})
            with pytest.raises(errors.FileError, match="damaged"):
                equipix.load(path)


class TestProtocol:
    def test_a_response_is_a_correction(self, response):
        assert isinstance(response, equipix.Correction)
        assert response.shape == SHAPE
        assert response.flags.dtype == np.uint32
        json.dumps(response.metadata)
        assert f"order {response.order}" in repr(response)

    def test_its_arrays_are_read_only_and_what_it_computes_is_the_callers(self, response):
        for each in (response, copy.deepcopy(response), pickle.loads(pickle.dumps(response))):
            arrays = [value for value in vars(each).values() if isinstance(value, np.ndarray)]
            assert len(arrays) >= 9
            assert not any(array.flags.writeable for array in arrays)
        for made in (response.coefficients, response.valid_range, response.correct(frames())):
            assert made.flags.writeable

    def test_dtypes_follow_the_frames(self, response):
        assert response.correct(frames()).dtype == np.float32
        assert response.correct(frames().astype(np.float64)).dtype == np.float64
        out = np.empty((3, *SHAPE), np.float32)
        assert response.correct(frames(), out=out) is out

    def test_a_dead_pixel_is_replaced_on_request(self, averages):
        response = nuc.fit(averages, order=1)
        assert response.flags[3, 4] & Flag.DEAD
        assert response.deviation[1, 3, 4] == pytest.approx(-1, abs=0.02)
        corrected = response.correct(frames())
        assert np.argwhere(np.isnan(corrected[0])).tolist() == [[3, 4]]
        replaced = response.correct(frames(), flagged="replace")
        assert np.isfinite(replaced).all()


class TestOtherFrames:
    @pytest.mark.parametrize(
        ("given", "message"),
        [
            (np.zeros((3, 4)), r"shape \(3, 4\), the sensor \(24, 32\)"),
            (np.full(SHAPE, 4096, np.uint16), "4096, above 4095, the largest value of the 12 bits"),
            (np.zeros(SHAPE, np.uint8), "uint8, but the correction was measured with 12 bits"),
        ],
    )
    def test_are_refused_with_the_numbers(self, response, given, message):
        with pytest.raises(errors.InputError, match=message):
            response.correct(given)

    def test_wrong_words_are_refused(self, response):
        with pytest.raises(errors.InputError, match="'dark' is 'none'"):
            response.correct(frames(), dark="none")
        with pytest.raises(errors.InputError, match="'flagged' is 'bad'"):
            response.correct(frames(), flagged="bad")
        with pytest.raises(errors.InputError, match="'dark' has shape"):
            response.correct(frames(), dark=np.zeros((2, 2)))
        with pytest.raises(errors.InputError, match="'frames' has shape"):
            response.extrapolated(np.zeros((2, 2)))


class TestCommandLine:
    def run(self, *arguments):
        with pytest.raises(SystemExit) as end:
            cli.main([*map(str, arguments)])
        assert not end.value.code

    def test_inspect_shows_a_response(self, averages, tmp_path, capsys):
        nuc.fit(averages, order=1).save(tmp_path / "r.tif")
        self.run("inspect", tmp_path / "r.tif", "--json")
        shown = json.loads(capsys.readouterr().out)
        assert shown["order"] == 1
        assert shown["flagged_pixels"] == {"DO_NOT_USE": 1, "DEAD": 1}

    def test_correct_applies_a_response(self, response, tmp_path):
        response.save(tmp_path / "r.tif")
        write_frames(tmp_path / "raw.tif", iter(frames()), nbytes=1)
        self.run("correct", tmp_path / "r.tif", tmp_path / "raw.tif", "-o", tmp_path / "c.tif")
        corrected = np.concatenate([each for _, each in stream_frames([tmp_path / "c.tif"])])
        np.testing.assert_array_equal(corrected, response.correct(frames()))


@pytest.fixture(scope="module")
def levels(data_dir):
    """Averages of the 50 exposure levels of a 12-bit CCD, two frames each."""
    folder = data_dir / "emva1288-set001-ccd-12bit/images"
    names = [sorted(folder.glob(f"b_{level:03}_snap_*.png")) for level in range(50)]
    assert {len(files) for files in names} == {2}
    return [equipix.average(files, saturation=4095) for files in names]


@pytest.mark.data
class TestRealCamera:
    @pytest.mark.long
    def test_levels_that_saturate_are_refused(self, levels):
        with pytest.raises(errors.InputError, match=r"level 30: 100.0% .* 4095 DN"):
            nuc.fit(levels[:30] + levels[39:40])

    @pytest.mark.long
    def test_two_points_explain_a_ccd_and_the_order_is_found(self, levels):
        free = [each for each in levels if np.mean(each.saturated > 0) < 0.01]
        assert len(free) == 37
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            response = nuc.fit(free, order="auto")
        assert response.order == 1
        good = (response.flags & Flag.DO_NOT_USE) == 0
        assert good.mean() > 0.999
        # χ² of a noise model fitted to the same frames: within 1 % of its expectation, whose
        # standard error over 307 200 pixels with 35 degrees of freedom is 0.04 %.
        assert response.reduced_chi2[good].mean() == pytest.approx(1, abs=0.01)
        # The spread of K is the PRNU of 0.433 % (README of the data) and the error of each K.
        gain = response.deviation[1][good]
        spread = np.sqrt(np.var(gain) - np.mean(response.variances[1][good]))
        assert spread == pytest.approx(0.00433, rel=0.05)

    @pytest.mark.long
    def test_levels_left_out_are_corrected_and_higher_orders_add_noise(self, levels, data_dir):
        free = [k for k, each in enumerate(levels) if np.mean(each.saturated > 0) < 0.01]
        held = [free[9], free[18], free[27]]
        rest = [levels[k] for k in free if k not in held]
        folder = data_dir / "emva1288-set001-ccd-12bit/images"
        ratios = {}
        for order in (1, 2, 3):
            response = nuc.fit(rest, order=order)
            for level in held:
                frames = read_frames(sorted(folder.glob(f"b_{level:03}_snap_*.png")))
                ratios[level, order] = equipix.metrics.correctability(response.correct(frames))
                ratios[level, 0] = equipix.metrics.correctability(frames)
            # Few of the 307 200 pixels are inverted worse than noise.
            assert response.metadata["inverse"]["pixels_beyond"] < 300
        for level in held:
            assert ratios[level, 1].high < ratios[level, 0].low
            assert ratios[level, 1].high < ratios[level, 3].low
