"""The forward model: what was fitted predicts, before and after saving."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import pytest

import equipix
from equipix import simulate

SHAPE = (40, 52)
CROSS = equipix.cross_pattern(5, 7).astype(float)
BETWEEN = CROSS + np.array([[0, 0], [0.3, 0.2], [0.1, -0.4], [0.45, 0.1], [-0.2, 0.35]])
ONE = (0.1, -0.4)
VARIANCE = np.array([1.0, 2.0, 1.5, 1.0, 0.5]) * 1e-6

CASES = {
    "whole": {},
    "coordinate descent": {"method": "coordinate-descent", "tolerance": 1e-4},
    "turned": {"rotation": [0, 90, 180, 270, 0]},
    "between pixels": {"shifts": BETWEEN},
    "between pixels, turned": {"shifts": BETWEEN, "rotation": [0, 90, 0, 180, 270]},
    "one fraction": {"shifts": CROSS + ONE},
    "one fraction, coordinate descent": {
        "shifts": CROSS + ONE,
        "method": "coordinate-descent",
        "tolerance": 1e-4,
    },
    "one fraction, turned": {"shifts": CROSS + ONE, "rotation": [0, 90, 180, 270, 0]},
    "one fraction, free fluxes": {"shifts": CROSS + ONE, "flux": "fit"},
    "free fluxes": {"flux": "fit"},
    "free fluxes between pixels": {"shifts": BETWEEN, "flux": "fit"},
    "linear fluxes between pixels": {
        "shifts": BETWEEN,
        "flux": "linear",
        "time": [0.0, 30.0, 10.0, 20.0, 40.0],
    },
    "free fluxes between pixels, turned": {
        "shifts": BETWEEN,
        "flux": "fit",
        "rotation": [0, 0, 0, 0, 180],
    },
    "prior fluxes": {"flux": np.ones(5), "flux_std": 1e-3, "shifts": BETWEEN},
    "refined": {"shifts": BETWEEN, "shift_std": 0.05},
    "dark fitted": {"flux": np.array([1.0, 1.6, 1.0, 1.6, 1.0]), "dark": "fit"},
    "each variance": {"shifts": BETWEEN, "variance": "each"},
    "float32": {"shifts": BETWEEN, "dtype": np.float32},
}


def calibrated(case, *, masked=None):
    """A calibration from noisy exposures, with what it was made from.

    `masked`: "some" of all measurements, or every second of the last columns ("frayed").
    """
    options = dict(CASES[case])
    rng = np.random.default_rng(7)
    shifts = options.pop("shifts", CROSS)
    dtype = options.pop("dtype", np.float64)
    turns = options.get("rotation", [0] * 5)
    levels = options["flux"] if options.get("dark") == "fit" else np.ones(5)
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
    beam = simulate.wavy_beam(SHAPE, rng=3)
    frames = simulate.exposures(truth, beam, shifts, flux=levels, rotation=turns)
    if options.get("dark") == "fit":
        frames += 0.1 * rng.uniform(size=SHAPE)
    variance = VARIANCE
    if options.pop("variance", None) == "each":
        variance = (1e-6 * rng.uniform(0.5, 2, frames.shape)).astype(dtype)
    scale = variance if variance.ndim == 3 else variance[:, None, None]
    frames = (frames + np.sqrt(scale) * rng.standard_normal(frames.shape)).astype(dtype)
    if masked == "some":
        options["mask"] = rng.uniform(size=frames.shape) < 0.03
    elif masked == "frayed":
        last = np.arange(SHAPE[1]) >= SHAPE[1] - 8
        options["mask"] = last & (rng.uniform(size=frames.shape) < 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", equipix.errors.EquipixWarning)
        cal = equipix.calibrate(frames, shifts, variance=variance, **options)
    return cal, frames, variance, options.get("mask", np.zeros(frames.shape, bool))


def squares_of(cal, frames, variance, mask):
    """Sum of squared residuals over variances, of the measurements that F contains."""
    residuals = cal.residuals(frames, variance=variance)
    fit = cal.weighted.fit
    used = ~mask & np.isfinite(cal.sensitivity)
    for k, lost in enumerate(fit.lost):
        assert not mask[k].flat[lost].any()
        used[k].flat[lost] = False
    assert np.isfinite(residuals[used]).all()
    if fit.few is not None:
        used &= ~fit.few
    return np.sum(np.square(residuals[used], dtype=np.float64)), residuals


@pytest.mark.long
@pytest.mark.parametrize("masked", [None, "some"])
@pytest.mark.parametrize("case", CASES)
def test_residuals_are_those_that_were_minimised(case, masked):
    cal, frames, variance, mask = calibrated(case, masked=masked)
    assert_minimised(cal, frames, variance, mask)


@pytest.mark.long
@pytest.mark.parametrize("case", [case for case in CASES if "between" in case or case == "refined"])
def test_residuals_without_measurements_that_are_lost_were_minimised(case):
    cal, frames, variance, mask = calibrated(case, masked="frayed")
    assert_minimised(cal, frames, variance, mask)
    exposures, fit = cal.weighted.exposures, cal.weighted.fit
    assert sum(map(len, fit.lost)) > 5
    for k, lost in enumerate(fit.lost):
        is_lost = np.zeros(SHAPE, bool)
        is_lost.flat[lost] = True
        missing = np.isnan(exposures.residual(fit, k, None))
        known = exposures.usable(k) & np.isfinite(cal.sensitivity)
        np.testing.assert_array_equal(missing[known], is_lost[known])


def assert_minimised(cal, frames, variance, mask):
    total, residuals = squares_of(cal, frames, variance, mask)
    freedom = cal.weighted.fit.degrees_of_freedom
    # A prediction is rounded by eps of itself, M by eps of its dtype; each of N residuals r changes
    # F by 2 r δ, and the roundings add up at random: 2 √F δ, ten of these, besides those of a sum.
    precision = np.finfo(cal.sensitivity.dtype).eps
    rounding = precision * np.abs(frames).max() / np.sqrt(np.min(variance))
    sums = 4 * np.finfo(float).eps * residuals.size
    tolerance = 10 * 2 * rounding / np.sqrt(cal.objective) + sums
    assert total == pytest.approx(cal.reduced_chi2 * freedom, rel=tolerance)


def test_the_degrees_of_freedom_are_measurements_less_unknowns():
    """At whole shifts: M of each pixel, L of each cell seen, less one for the scale."""
    cal, *_, mask = calibrated("whole", masked="some")
    seen = np.zeros(cal.beam.shape, bool)
    for (row, col), masked in zip(CROSS.astype(int) + cal.beam_origin, mask, strict=True):
        seen[row : row + SHAPE[0], col : col + SHAPE[1]] |= ~masked
    unknowns = np.count_nonzero(~mask.all(axis=0)) + np.count_nonzero(seen) - 1
    assert cal.weighted.fit.degrees_of_freedom == np.count_nonzero(~mask) - unknowns


@pytest.mark.parametrize(
    ("steep", "options"), [(0.4, {"flux": "fit"}), (0.5, {"flux": "linear", "time": BETWEEN[:, 1]})]
)
def test_a_tilt_that_the_gauge_removes_goes_to_the_beam(steep, options):
    """M with a steep slope: the residuals are still those that were minimised."""
    rng = np.random.default_rng(5)
    slope = np.linspace(-steep, steep, SHAPE[1])
    truth = simulate.paper_sensitivity(SHAPE, rng=rng) * np.exp(slope)
    frames = simulate.exposures(truth, simulate.wavy_beam(SHAPE, rng=3), BETWEEN)
    frames += 1e-4 * rng.standard_normal(frames.shape)
    variance = np.full(5, 1e-8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", equipix.errors.EquipixWarning)
        cal = equipix.calibrate(frames, BETWEEN, variance=variance, **options)
    assert np.abs(cal.beam_tilt * SHAPE).max() > 0.5
    total, _ = squares_of(cal, frames, variance, np.zeros(frames.shape, bool))
    # Predictions of size 1.6 rounded by eps, over the standard deviation 1e-4, as above.
    rounding = np.finfo(float).eps * np.abs(frames).max() / 1e-4
    assert total == pytest.approx(cal.objective, rel=20 * rounding / np.sqrt(cal.objective) + 1e-11)


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
@pytest.mark.parametrize(
    "case",
    [
        *("whole", "turned", "one fraction, turned", "one fraction, free fluxes", "refined"),
        *("free fluxes between pixels", "dark fitted", "float32"),
    ],
)
def test_a_loaded_calibration_predicts_the_same_bytes(case, suffix, tmp_path):
    cal, frames, variance, _ = calibrated(case)
    cal.save(tmp_path / f"cal{suffix}")
    read = equipix.load(tmp_path / f"cal{suffix}")
    for shift in ((0, 0), (2.25, -1.5), (3, 4.875)):
        np.testing.assert_array_equal(read.predict(shift), cal.predict(shift))
    np.testing.assert_array_equal(
        read.residuals(frames, variance=variance), cal.residuals(frames, variance=variance)
    )
    assert read.findings == cal.findings


def test_a_copy_keeps_the_fit():
    cal, *_ = calibrated("whole")
    weights = np.zeros(SHAPE)
    weights[3, 4], weights[5, 6] = 1, -1
    assert copy.copy(cal).std_of(weights) == cal.std_of(weights)


def test_a_pickled_calibration_does_without_its_fit():
    cal, frames, *_ = calibrated("between pixels")
    again = pickle.loads(pickle.dumps(cal))
    np.testing.assert_array_equal(again.residuals(frames), cal.residuals(frames))
    with pytest.raises(equipix.errors.InputError, match="measurements"):
        again.std_of(np.ones(SHAPE))


def test_between_cells_the_fitted_spline_predicts():
    """Against the B-spline written out, with the coefficients of the result."""
    cal, *_ = calibrated("between pixels")
    predicted = cal.predict((1.3, 2.6), flux=2.0)
    rows, cols = np.indices(SHAPE)
    expected = np.zeros(SHAPE)
    for i in range(-1, 3):
        for j in range(-1, 3):
            place = (rows + cal.beam_origin[0] + 1 + i, cols + cal.beam_origin[1] + 2 + j)
            inside = (place[0] < cal.beam.shape[0]) & (place[1] < cal.beam.shape[1])
            cells = np.full(SHAPE, np.nan)
            cells[inside] = cal.beam_coefficients[place[0][inside], place[1][inside]]
            expected += bspline(0.3 - i) * bspline(0.6 - j) * cells
    expected *= 2 * cal.sensitivity
    seen = np.isfinite(expected)
    assert np.count_nonzero(seen) > 0.8 * seen.size
    np.testing.assert_array_equal(np.isfinite(predicted), seen)
    # Sums of 16 products.
    np.testing.assert_allclose(predicted[seen], expected[seen], rtol=32 * np.finfo(float).eps)


def bspline(x):
    """The cubic B-spline, centred at 0."""
    x = abs(x)
    return 2 / 3 - x**2 + x**3 / 2 if x < 1 else max(2 - x, 0.0) ** 3 / 6
