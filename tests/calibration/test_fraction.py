"""Shifts with one fraction of a pixel in common: they differ by whole pixels and count as whole."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import _native, simulate
from equipix.exposures.positions import Positions, whole_moves

SHAPE = (40, 52)
CROSS = equipix.cross_pattern(5, 7).astype(float)
FRACTION = np.array([0.1, -0.4])
NOISE = 1e-3
SAME = ("sensitivity", "flags", "component_labels", "objective", "reduced_chi2", "sweeps")


def frames(shifts=CROSS, **options):
    rng = np.random.default_rng(7)
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
    measured = simulate.exposures(truth, simulate.wavy_beam(SHAPE, rng=3), shifts, **options)
    return measured + NOISE * rng.standard_normal(measured.shape)


def both(shifts=CROSS, rotation=None, **options):
    """Calibrate the same frames at whole shifts, and at those that are larger by a fraction."""
    measured = frames(shifts, rotation=rotation)
    options |= {"rotation": rotation, "variance": np.full(len(shifts), NOISE**2)}
    return [equipix.calibrate(measured, shifts + each, **options) for each in (0, FRACTION)]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"rotation": [0, 90, 180, 270, 0]},
        {"method": "coordinate-descent", "tolerance": 1e-4},
        {"robust": True},
        {"flux": "fit", "rotation": [0, 0, 0, 0, 180]},
    ],
    ids=["plain", "turned", "descent", "robust", "free fluxes"],
)
@pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
def test_the_result_is_that_of_whole_shifts(options):
    whole, between = both(**options)
    assert whole.converged
    for name in SAME:
        np.testing.assert_array_equal(getattr(whole, name), getattr(between, name), name)
    # Fluxes and beam are scaled by the gauge: products of some ten factors near 1.
    rounding = 50 * np.finfo(float).eps
    np.testing.assert_allclose(between.beam, whole.beam, rtol=rounding)
    np.testing.assert_allclose(between.flux, whole.flux, rtol=rounding)
    np.testing.assert_array_equal(between.shifts, CROSS + FRACTION)
    assert between.shift_sign == whole.shift_sign
    if "robust" in options:
        np.testing.assert_array_equal(between.rejected, whole.rejected)


def test_the_error_bars_are_those_of_whole_shifts():
    whole, between = both(uncertainty=True)
    np.testing.assert_array_equal(whole.sensitivity_std, between.sensitivity_std)
    np.testing.assert_array_equal(whole.tilt_std, between.tilt_std)
    weights = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, 1, -1) * np.ones(SHAPE)
    assert whole.std_of(weights) == between.std_of(weights)


@pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
def test_a_line_of_positions_takes_as_few_products():
    whole, between = both(np.array([(0.0, 0), (5, 0), (11, 0)]))
    assert between.converged
    assert between.sweeps == whole.sweeps < 100


def test_the_origin_is_a_place_between_cells():
    whole, between = both()
    assert all(type(each) is int for each in whole.beam_origin)
    np.testing.assert_allclose(np.subtract(whole.beam_origin, between.beam_origin), FRACTION)
    # L at the pixels of each exposure, whose cells are at origin + shift.
    for k, shift in enumerate(between.shifts):
        corner = np.add(between.beam_origin, shift)
        row, col = np.rint(corner).astype(int)
        np.testing.assert_allclose(corner, (row, col), rtol=0, atol=1e-14)
        seen = between.beam[row : row + SHAPE[0], col : col + SHAPE[1]]
        np.testing.assert_array_equal(seen * between.sensitivity, between.predict(shift), str(k))


def test_a_prediction_elsewhere_is_that_of_the_true_beam():
    between = equipix.calibrate(frames(CROSS + FRACTION), CROSS + FRACTION)
    truth = simulate.cosine_sensitivity(SHAPE, rng=np.random.default_rng(7))
    there = (2.75, 3.5)
    signal = simulate.exposures(truth, simulate.wavy_beam(SHAPE, rng=3), [there])[0]
    relative = (between.predict(there) / signal)[np.isfinite(between.predict(there))]
    assert relative.size > 0.8 * signal.size
    # Beam and sensitivity follow the noise of a measurement; one scale is theirs together.
    assert relative.std() < 3 * NOISE
    assert relative.mean() == pytest.approx(1, abs=3 * NOISE)


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_files_keep_the_place(suffix, tmp_path):
    for cal in both():
        cal.save(tmp_path / f"cal{suffix}", force=True)
        read = equipix.load(tmp_path / f"cal{suffix}")
        assert read.beam_origin == cal.beam_origin
        assert [type(each) for each in read.beam_origin] == [type(each) for each in cal.beam_origin]
        np.testing.assert_array_equal(read.predict((2.3, 1.7)), cal.predict((2.3, 1.7)))
        np.testing.assert_array_equal(read.predict(cal.shifts[3]), cal.predict(cal.shifts[3]))


def test_the_core_decides_what_is_common():
    for fraction in ((0, 0), (0.3, -0.4), (0.5, 0.5), (1 / 3, 0)):
        shifts = CROSS + fraction
        assert _native.common_fraction(shifts) == pytest.approx(fraction, abs=1e-15)
        positions = Positions.of(shifts)
        assert positions.whole() is positions
    for apart in (CROSS + 0.25 * np.eye(5, 2), CROSS * (1 + 1e-6)):
        assert _native.common_fraction(apart) is None


@pytest.mark.parametrize("first", [0.0, 1.0, 0.3, 0.6, 1.7, -0.5, -2.9])
def test_moves_of_half_a_pixel_round_one_way_everywhere(first):
    """The plan, the coverage and the solver see the same whole moves, wherever the first is."""
    moves = np.array([0, 0.5, 1.5, 2.5, -0.5, -1.5, 1.1, -3.4])
    whole = [0, 0, 1, 2, -1, -2, 1, -3]
    shifts = np.column_stack([first + moves, 7.0 * np.arange(8)])
    np.testing.assert_array_equal(np.diff(whole_moves(shifts)[:, 0]), np.diff(whole))
    rounded = Positions.of(shifts).whole().shifts[:, 0]
    np.testing.assert_allclose(rounded - first, whole, rtol=0, atol=1e-12)
    with pytest.warns(equipix.errors.InputWarning):
        found = equipix.plan.identify(SHAPE, shifts)
    assert found.components == equipix.plan.identify(SHAPE, whole_moves(shifts)).components
