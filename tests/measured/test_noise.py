"""The noise model that weights averaged frames."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import errors, simulate
from equipix.measured.defects import dead_pixels, hot_pixels
from equipix.measured.means import Averaged
from equipix.measured.noise import MEDIAN_SQUARE, NoiseModel, chi2_tail, median_of_noise
from given import exposures_of

CROSS = equipix.cross_pattern(5, 7)
EPS = np.finfo(np.float64).eps


@pytest.fixture(scope="module")
def raw():
    """Sixteen noisy frames of each exposure."""
    rng = np.random.default_rng(3)
    truth = simulate.paper_sensitivity((40, 50), rng=rng)
    beam = simulate.gaussian_beam(truth.shape, width=60, amplitude=2000)
    means = simulate.exposures(truth, beam, CROSS)[:, None]
    return means + np.sqrt(4 + 0.3 * means) * rng.standard_normal((5, 16, *truth.shape))


@pytest.mark.filterwarnings("ignore::equipix.errors.ConvergenceWarning")
@pytest.mark.parametrize("unit", [2.0**-10, 2.0**10])
def test_a_unit_that_rounds_nothing_changes_no_bit(raw, unit):
    plain, scaled = (
        equipix.calibrate([equipix.average(u * each) for each in raw], CROSS, max_sweeps=15)
        for u in (1, unit)
    )
    np.testing.assert_array_equal(scaled.sensitivity, plain.sensitivity)
    assert scaled.reduced_chi2 == plain.reduced_chi2


@pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
@pytest.mark.parametrize("unit", [2.0**-100, 2.0**-10, 2.0**100])
@pytest.mark.parametrize(
    "sought",
    [
        {},
        {"shift_std": 0.05},
        {"shift_std": 0.05, "rotation": [0, 0, 0, 0, 90]},
        {"dark": "fit", "flux": [1, 2, 3, 1, 2]},
        {"flux": "fit"},
    ],
)
def test_a_unit_that_rounds_nothing_changes_no_bit_between_pixels(sought, unit):
    """Single precision, in which steps are, has no numbers of any size: they are in units."""
    rng = np.random.default_rng(3)
    truth = simulate.paper_sensitivity((40, 50), rng=rng)
    shifts = CROSS + rng.uniform(-0.4, 0.4, CROSS.shape)
    beam = simulate.wavy_beam(truth.shape, rng=3)
    frames = simulate.exposures(truth, beam, shifts, rotation=sought.get("rotation"))
    if "dark" in sought:
        frames *= np.array(sought["flux"])[:, None, None]
    frames += 1e-3 * rng.standard_normal(frames.shape)
    plain, scaled = (
        equipix.calibrate(
            u * frames, shifts, variance=np.full(frames.shape, (1e-3 * u) ** 2), **sought
        )
        for u in (1, unit)
    )
    np.testing.assert_array_equal(scaled.sensitivity, plain.sensitivity)
    assert scaled.reduced_chi2 == plain.reduced_chi2


@pytest.mark.parametrize("unit", [1e-3, 0.1, 1e3])
def test_the_unit_of_the_frames_plays_no_part(raw, unit):
    options = {"max_sweeps": 15, "tolerance": 1e-9}
    averages, in_unit = ([equipix.average(u * each) for each in raw] for u in (1, unit))
    # A frame is rounded when it is scaled, which a difference of nearly equal frames shows
    # enlarged by signal over noise, 2000/25, in each of 16 samples: weights move by less than
    # 1e3 roundings.
    noise, scaled_noise = Averaged.of(averages).noise, Averaged.of(in_unit).noise
    expected = unit**2 * noise.scatter(500.0)
    assert scaled_noise.scatter(500.0 * unit) == pytest.approx(expected, rel=1e3 * EPS)
    with pytest.warns(errors.ConvergenceWarning):
        plain = equipix.calibrate(averages, CROSS, **options)
    with pytest.warns(errors.ConvergenceWarning):
        scaled = equipix.calibrate(in_unit, CROSS, **options)
    # The search finds M - 1 in single precision: where the last bit of a measurement differs, a
    # rounding of it may go the other way.
    largest = np.abs(plain.sensitivity - 1).max()
    limit = largest * np.finfo(np.float32).eps + 1e3 * EPS
    np.testing.assert_allclose(scaled.sensitivity, plain.sensitivity, rtol=limit)
    assert scaled.reduced_chi2 == pytest.approx(plain.reduced_chi2, rel=limit)
    # Five standard deviations of chi2 over its degrees of freedom.
    freedom = 4 * 40 * 50 - 47 * 57
    assert plain.reduced_chi2 == pytest.approx(1, abs=5 * np.sqrt(2 / freedom))


def test_the_model_has_a_floor_relative_to_its_largest_variance():
    points = np.array([(0.0, 0.0, 100.0), (1000.0, 300.0, 100.0)])
    model = NoiseModel.fit(points)
    assert model.variance(0.0) == pytest.approx(300e-6)
    assert model.variance(1000.0) == pytest.approx(300, rel=1e-5)


def test_equal_frames_count_as_one(raw):
    same = [equipix.average(np.stack([each[0]] * 2)) for each in raw]
    one = [equipix.average(each[:1]) for each in raw]
    first, other = (equipix.calibrate(each, CROSS) for each in (same, one))
    np.testing.assert_array_equal(first.sensitivity, other.sensitivity)


def test_equal_frames_of_whole_numbers_have_the_noise_of_rounding(raw):
    same = [equipix.average(np.rint(np.stack([each[0]] * 2)).astype(np.uint16)) for each in raw]
    model = Averaged.of(same).noise
    assert model.scatter(500.0) == pytest.approx(0, abs=1e-3)
    # The floor of the noise is 1e-4 of a step.
    assert model.of_mean(2).variance(500.0) == pytest.approx(1 / 12, rel=1e-3)


class TestSaturatedExposures:
    """One text for averages, arrays and files: which exposure, what share, what to do."""

    def test_of_averages_are_named(self, raw):
        averages = [
            equipix.average(each, saturation=1e-9 if k == 3 else None) for k, each in enumerate(raw)
        ]
        with pytest.raises(
            errors.InputError, match=SATURATES.format("'frames': exposure 3", "100.0", "")
        ):
            equipix.calibrate(averages, CROSS)

    def test_of_arrays_are_named(self, raw):
        frames = raw.mean(axis=1)
        frames[3] *= 10
        frames[3, :, :5] = np.nan
        words = SATURATES.format("'frames': exposure 3", "90.0", " of 3000 DN")
        with pytest.raises(errors.InputError, match=words):
            equipix.calibrate(frames, CROSS, saturation=3000)
        frames[3, 7, 8] = 2999
        assert exposures_of(frames, CROSS, saturation=3000).usable(3).sum() == 1

    def test_of_the_dark_are_named(self, raw):
        dark = equipix.average(np.full((2, *raw.shape[2:]), 255, np.uint8))
        averages = [equipix.average(each, dark=dark) for each in raw]
        with pytest.raises(errors.InputError, match=SATURATES.format("^'dark'", "100.0", "")):
            equipix.calibrate(averages, CROSS)


SATURATES = (
    "{}: {}% of the pixels reach the saturation level{} and none is left to measure "
    "with: expose less, or correct 'saturation'"
)


def test_a_pixel_without_samples_hides_no_defect():
    dark = np.random.default_rng(1).normal(100, 2, (10, 40, 40))
    dark[:, 3, 4] += 500
    dark[:, 5, 6] = np.nan
    hot = hot_pixels(equipix.average(dark), NoiseModel(2.0, 0.3))
    assert np.argwhere(hot).tolist() == [[3, 4]]

    signals = np.full((3, 40, 40), 100.0)
    signals[:, 7, 8] = 1
    signals[0, 7, 8] = np.nan
    signals[1, 9, 9] = np.nan
    signals[:, 20, 20] = np.nan
    signals[0, :16, :16] = np.nan
    assert np.argwhere(dead_pixels(signals, None)).tolist() == [[7, 8], [20, 20]]


def test_a_pixel_without_a_dark_counts_in_no_noise_model(raw):
    """It has the variance of its frames, but no signal: the model is that without the pixel."""
    dark = np.random.default_rng(2).normal(0, 2, (8, *raw.shape[2:]))
    dark[3, 5, 6] = dark[:, 20, 20] = np.nan
    dark = equipix.average(dark)
    mask = np.zeros(raw.shape[2:], bool)
    mask[20, 20] = True
    whole, less = (
        Averaged.of([equipix.average(each, dark=dark, mask=given) for each in raw]).noise
        for given in (None, mask)
    )
    assert whole == less


def test_the_median_of_reduced_chi2_is_half_way_of_its_tail():
    freedom = np.array([[3, 1], [2, 1]])
    found = median_of_noise(freedom)
    assert found.shape == freedom.shape
    halves = [chi2_tail(x * f, f) for x, f in zip(found.flat, freedom.flat, strict=True)]
    # Sums of at most three terms.
    np.testing.assert_allclose(halves, 0.5, rtol=8 * np.finfo(float).eps)
    assert found[0, 1] == pytest.approx(MEDIAN_SQUARE, abs=5e-5)  # which has four digits
    assert np.isnan(median_of_noise(np.array(0)))
