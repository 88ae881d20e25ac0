"""What a first fit determines of the pixels under a spot, and the factors in it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.errors import InputError, SpotError
from equipix.experiment.aperture import Equalisation, Moves, _found, _size, region_of_spots
from equipix.exposures.exposures import FitOptions
from equipix.exposures.spots import Spot
from equipix.findings import Flag
from equipix.fitting.weighted import Weighted
from given import exposures_of

SHAPE, CROSS = (40, 50), equipix.cross_pattern(3, 5)
LARGEST = 0.008**2
"""Variance of a centroid by unequal pixels before any calibration."""


def fitted(shifts=CROSS, *, variance=None):
    """A weighted fit of noisy frames with a dark, in whole shifts from 0 on."""
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    flux = 1 + 0.1 * np.arange(len(shifts))
    frames = simulate.exposures(truth, simulate.tilted_beam(SHAPE, width=60), shifts, flux=flux)
    frames += 1e-3 * rng.standard_normal(frames.shape)
    exposures = exposures_of(frames, shifts, variance=variance, flux=flux)
    exposures = dataclasses.replace(exposures, dark=np.full(SHAPE, 7.0))
    return Weighted(exposures, exposures.fit(FitOptions()), None)


def light_of(fit, shift):
    """L on each pixel in an exposure at a whole shift."""
    row, col = np.add(fit.beam.origin, shift).astype(int)
    return fit.beam.values[row : row + SHAPE[0], col : col + SHAPE[1]]


def around(variance):
    """Equalisation of pixels with these variances."""
    return Equalisation(np.ones(variance.shape), np.zeros(variance.shape), variance)


def spot(row, col):
    return Spot(np.array([row, col], float), np.zeros(2))


@pytest.mark.parametrize(("count", "factor"), [(5, 5 / 3), (4, 2), (3, 3), (2, 2)])
def test_variances_are_those_of_n_measurements_that_determine_the_beam_too(count, factor):
    """n/(n − 2) over Σ w c²L² M², the relative variance with a known beam; 2 with two."""
    variance = 1e-6 * (1 + np.arange(count))
    weighted = fitted(CROSS[:count], variance=variance)
    exposures, fit = weighted.exposures, weighted.fit
    strength = sum(
        (c * light_of(fit, shift)) ** 2 / v
        for c, shift, v in zip(exposures.flux.values, CROSS, variance, strict=False)
    )
    found = Equalisation.of(weighted, np.zeros(SHAPE, np.uint32)).variance
    # Sums of `count` products, and a handful of roundings.
    wanted = factor / (strength * fit.sensitivity**2)
    np.testing.assert_allclose(found, wanted, rtol=20 * np.finfo(float).eps)


def test_without_variances_the_residuals_give_the_noise():
    none = np.zeros(SHAPE, np.uint32)
    unit, known = fitted(), fitted(variance=np.full(5, 1.0))
    np.testing.assert_allclose(
        Equalisation.of(unit, none).variance,
        unit.reduced_chi2 * Equalisation.of(known, none).variance,
        rtol=1e-12,
    )


def test_images_are_corrected_but_in_pixels_that_are_not_to_be_used():
    weighted = fitted()
    flags = np.zeros(SHAPE, np.uint32)
    flags[3, 4], flags[5, 6] = Flag.DEAD | Flag.DO_NOT_USE, Flag.SATURATED
    found = Equalisation.of(weighted, flags)
    images = np.random.default_rng(2).uniform(100, 200, (2, *SHAPE))
    wanted = (images - 7) / weighted.fit.sensitivity
    wanted[:, 3, 4] = images[:, 3, 4] - 7
    np.testing.assert_array_equal(found.apply(images), wanted)
    assert np.argwhere(np.isnan(found.variance)).tolist() == [[3, 4]]
    with pytest.raises(InputError, match=r"of a sensor of \(40, 50\), .* have \(40, 49\)"):
        found.apply(images[:, :, 1:])


def test_a_pixel_without_a_dark_takes_the_median():
    weighted = fitted()
    dark = np.linspace(5, 9, SHAPE[0] * SHAPE[1]).reshape(SHAPE)
    dark[3, 4] = np.nan
    flags = np.zeros(SHAPE, np.uint32)
    flags[3, 4] = Flag.DO_NOT_USE
    images = np.full((2, *SHAPE), 150.0)
    found = Equalisation.of(weighted, flags, darks=[dark]).at(0).apply(images)
    np.testing.assert_array_equal(found[:, 3, 4], 150 - np.nanmedian(dark))
    dark[3, 4] = np.nanmedian(dark)
    wanted = Equalisation.of(weighted, flags, darks=[dark]).at(0).apply(images)
    np.testing.assert_array_equal(found, wanted)


def test_a_fit_without_a_dark_is_refused():
    weighted = fitted()
    weighted = weighted._replace(exposures=dataclasses.replace(weighted.exposures, dark=None))
    with pytest.raises(InputError, match="holds no dark frame"):
        Equalisation.of(weighted, np.zeros(SHAPE, np.uint32))


def test_unequal_pixels_move_a_centroid_by_the_root_of_their_variance_over_4_pi():
    """Centroids of a disc on pixels of random gain."""
    rows, cols = np.indices((25, 25)) - 12.0
    disc = np.hypot(rows, cols) < 10
    rng, relative, draws = np.random.default_rng(3), 0.01, 4000
    gains = 1 + relative * rng.standard_normal((draws, np.count_nonzero(disc)))
    centroids = gains @ rows[disc] / gains.sum(axis=1)
    predicted = around(np.full(SHAPE, relative**2)).unequal_pixels(spot(20, 20))
    # Five standard errors of a variance over so many draws; a disc of pixels is round to 1 %.
    assert np.var(centroids) == pytest.approx(predicted, rel=5 * np.sqrt(2 / draws) + 0.01)


def test_the_pixels_under_a_spot_count_alone():
    small = 1e-6
    variance = np.full(SHAPE, 9e-6)
    variance[12:28, 22:38] = small
    assert around(variance).unequal_pixels(spot(20.3, 29.8)) == pytest.approx(small / (4 * np.pi))
    assert around(variance).unequal_pixels(spot(5, 5)) == pytest.approx(9e-6 / (4 * np.pi))
    corner = np.full(SHAPE, small)
    corner[8:], corner[:, 8:] = 1.0, 1.0
    assert around(corner).unequal_pixels(spot(0, 0)) == pytest.approx(small / (4 * np.pi))


def test_pixels_are_not_taken_for_worse_than_before_a_calibration():
    assert around(np.full(SHAPE, 1.0)).unequal_pixels(spot(20, 20)) == LARGEST
    assert around(np.full(SHAPE, np.nan)).unequal_pixels(spot(20, 20)) == LARGEST
    edge = 4 * np.pi * LARGEST
    below = around(np.full(SHAPE, 0.99 * edge)).unequal_pixels(spot(20, 20))
    assert below == pytest.approx(0.99 * LARGEST)


def moves_of(spots, shifts=CROSS, radius=5.0):
    """Moves with spots at these places."""
    none = np.zeros((len(shifts), 2))
    return Moves(np.array(shifts, float), none, np.array(spots, float), radius)


def test_a_region_holds_all_spots_far_from_its_edges_unless_the_sensor_ends():
    spots = [(700.2, 900.8), (711.9, 881.1)]
    rows, cols = region_of_spots(moves_of(spots), (1600, 2400), (2, 3))
    # 128 pixels on every side; whole periods from the corner on.
    assert (rows.start, rows.stop) == (572, 840)
    assert (cols.start, cols.stop) == (753, 1029)
    assert rows.start % 2 == cols.start % 3 == 0
    near = region_of_spots(moves_of([(20, 30), (2390, 40)]), (2400, 2400), (1, 1))
    assert (near[0].start, near[0].stop, near[1].start) == (0, 2400, 0)


def test_a_large_spot_takes_a_larger_region():
    rows, cols = region_of_spots(moves_of([(700, 900)], radius=90.0), (1600, 2400), (1, 1))
    # Two and a half times its radius on every side.
    assert (rows.start, rows.stop, cols.start, cols.stop) == (475, 926, 675, 1126)


@pytest.mark.parametrize(("shape", "radius"), [((120, 160), 6), ((1100, 1300), 80)])
def test_the_radius_of_a_disc_is_found_to_a_twentieth(shape, radius):
    place = np.array([shape[0] * 0.4, shape[1] * 0.6])
    away = np.indices(shape) - place[:, None, None]
    image = np.where(np.hypot(*away) < radius, 3000.0, 60.0)
    found, half = _size(image, place)
    assert half == 1530.0
    # By the pixels along its outline, 2πr of πr², each in or out by chance.
    assert abs(found / radius - 1) < 0.05


def discs(*places, shape=(1100, 1300), seed=0):
    """Two frames of discs at places (row, column), each with its radius and signal in DN."""
    rng = np.random.default_rng(seed)
    image = np.full(shape, 60.0)
    for row, col, radius, signal in places:
        away = np.hypot(*(np.indices(shape).T - (row, col)).T)
        image += signal * np.clip(radius - away, 0, 1)
    return rng.poisson(image, (2, *shape)).astype(np.uint16)


def found_in(before, after, hot=None):
    """What is found in images that come one frame at a time, and how often they are read."""
    reads = []

    def images():
        reads.append(1)
        return [iter(np.split(each, 2)) for each in (before, after)]

    return *_found(images, 4095.0, hot), len(reads)


def test_a_move_is_found_in_the_part_around_its_spots():
    before, after = discs((400.3, 700.1, 30, 3000)), discs((410.6, 689.2, 30, 3000), seed=1)
    before[0, 900:920, 100] = after[:, 3, 7] = 4095  # what the median of 3×3 removes
    found, shape, radius, reads = found_in(before, after)
    whole = equipix.measure_shift(before, after, saturation=4095.0)
    assert (reads, shape) == (1, (1100, 1300))
    assert abs(radius - 30) < 1.5
    # The background is that around the spot in both: far less apart than noise moves a centroid.
    assert np.all(np.abs(found.shift - whole.shift) < 0.1 * whole.std)
    assert np.all(np.abs(found.before.position - whole.before.position) < 0.1 * whole.std)


def test_a_move_with_another_bright_place_is_found_in_whole_images():
    small = (900, 200, 9, 3000)
    before, after = discs((400, 700, 30, 3000), small), discs((410, 689, 30, 3000), small)
    found, *_, reads = found_in(before, after)
    wanted = equipix.measure_shift(before, after, saturation=4095.0)
    assert reads == 2
    assert np.array_equal(found.shift, wanted.shift)
    large = (900, 200, 28, 3000)
    with pytest.raises(SpotError, match="'before'"):
        found_in(discs((400, 700, 30, 3000), large), after)


def test_what_is_wrong_beyond_the_part_around_the_spots_is_refused():
    before, after = discs((400, 700, 30, 3000)), discs((410, 689, 30, 3000), seed=1)
    with pytest.raises(InputError, match="shape"):
        found_in(before, after[:, :-1])
    with pytest.raises(InputError, match="shape"):
        found_in(before, after, hot=np.zeros((1099, 1300), bool))
    for place in (1000, 1001):  # one of them is not looked at coarsely
        broken = after.astype(np.float32)
        broken[1, place, place] = np.nan
        with pytest.raises(InputError, match="NaN"):
            found_in(before.astype(np.float32), broken)


def test_far_moves_take_a_larger_region_and_most_of_a_sensor_is_all_of_it():
    far = moves_of([(700, 900)], [(0, 0), (0, 210)])
    rows, cols = region_of_spots(far, (1600, 2400), (1, 1))
    # Twice the largest move on every side.
    assert (rows.start, rows.stop, cols.start, cols.stop) == (280, 1121, 480, 1321)
    middle = moves_of([(500, 500)], [(0, 0), (0, 210)])
    assert region_of_spots(middle, (1000, 1000), (1, 1)) is None
    assert region_of_spots(moves_of([(120, 160)]), (240, 320), (1, 1)) is None


def test_maps_of_a_part_correct_the_same_pixels():
    """And a spot is as uncertain there as by maps of the whole sensor."""
    weighted, flags = fitted(), np.zeros(SHAPE, np.uint32)
    darks = [np.full(SHAPE, 7.0), np.arange(2000.0).reshape(SHAPE)]
    whole = Equalisation.of(weighted, flags, darks=darks)
    part = dataclasses.replace(
        whole,
        corner=(8, 10),
        **{name: getattr(whole, name)[8:38, 10:46] for name in ("gain", "dark", "variance")},
    )
    images = np.random.default_rng(2).uniform(100, 200, (2, *SHAPE))
    for exposure in (0, 1):
        ours, wanted = (each.at(exposure).apply(images) for each in (part, whole))
        np.testing.assert_array_equal(ours, wanted[:, 8:38, 10:46])
    assert part.unequal_pixels(spot(20, 25)) == whole.unequal_pixels(spot(20, 25))
    with pytest.raises(InputError, match=r"of a sensor of \(40, 50\), .* have \(40, 49\)"):
        part.apply(images[:, :, 1:])
