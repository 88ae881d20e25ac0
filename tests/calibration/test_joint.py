"""Shifts between pixels, fluxes, refined shifts and offsets: `calibrate` where its model is joint.

Three witnesses: the dense reference on tiny sensors, sensors whose truth is known, and laws that
hold whatever the truth is.
"""

from __future__ import annotations

import warnings
from typing import ClassVar

import numpy as np
import pytest

import equipix
import reference
from equipix import Flag, metrics, simulate
from equipix.errors import (
    ConvergenceWarning,
    IdentifiabilityWarning,
    InputError,
    MisfitWarning,
)
from given import CROSS, SMALL, SMALL_CROSS, TURNED, between, small, used

SENSOR = (120, 160)
NOISE = 1e-3 / np.sqrt(3)
"""Standard deviation of noise that is uniform within 1e-3."""


def structured(seed, *, whole=False, noise=1e-3, shape=SENSOR):
    """The sub-pixel check: a beam with fine structure, uniform noise."""
    rng = np.random.default_rng(seed)
    shifts = CROSS if whole else between(CROSS, rng)
    sensitivity = simulate.cosine_sensitivity(shape, rng=rng)
    frames = simulate.exposures(sensitivity, simulate.wavy_beam(shape, rng=rng), shifts)
    return frames + rng.uniform(-noise, noise, frames.shape), shifts, sensitivity


def rms_error(calibration, truth):
    return np.sqrt(np.nanmean(metrics.relative_error(calibration.sensitivity, truth) ** 2))


def slope(image):
    """Least-squares slope along rows and columns, a pixel."""
    places = np.indices(image.shape).reshape(2, -1).T
    plane = np.column_stack([np.ones(image.size), places])
    return np.linalg.lstsq(plane, image.ravel())[0][1:]


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
class TestReference:
    FRACTIONS = between(SMALL_CROSS, np.random.default_rng(8))
    ONE = (0.3, -0.4)
    DRIFT = np.array([1, 1.01, 0.99, 1.005, 0.98])

    CASES: ClassVar = {
        "fractions": (FRACTIONS, {}),
        "fractions turned": (FRACTIONS, {"rotation": TURNED}),
        "fractions with fluxes": (FRACTIONS, {"flux": DRIFT}),
        "free": (SMALL_CROSS, {"flux": "fit"}),
        "free turned": (SMALL_CROSS, {"flux": "fit", "rotation": TURNED}),
        "free between": (FRACTIONS, {"flux": "fit"}),
        "free between turned": (FRACTIONS, {"flux": "fit", "rotation": TURNED}),
        "free, all turned alike": (FRACTIONS, {"flux": "fit", "rotation": [90] * 5}),
        "linear": (FRACTIONS, {"flux": "linear", "time": [0, 3, 1, 4, 2]}),
        "free at one fraction": (SMALL_CROSS + ONE, {"flux": "fit"}),
        "free at one fraction, turned": (SMALL_CROSS + ONE, {"flux": "fit", "rotation": TURNED}),
        "prior": (SMALL_CROSS, {"flux": DRIFT, "flux_std": 0.01}),
        "prior turned": (SMALL_CROSS, {"flux": DRIFT, "flux_std": 0.01, "rotation": TURNED}),
    }

    @pytest.mark.parametrize("case", CASES)
    @pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning")
    def test_core_and_reference_agree(self, case):
        shifts, options = self.CASES[case]
        frames, measured = small(1, shifts, rotation=options.get("rotation"))
        cal = equipix.calibrate(frames, shifts, tolerance=1e-8, **measured, **options)
        dense = reference.joint(frames, shifts, **used(cal, measured), **options)
        assert cal.converged
        # The estimate is one of order, as in the tests of `multiscale`: a hundred times.
        np.testing.assert_allclose(cal.sensitivity, dense.sensitivity, atol=1e-6)
        np.testing.assert_allclose(cal.flux, dense.flux, atol=1e-6)
        # Cells behind the edge follow noise; these every exposure sees.
        corners = (np.ceil(each.beam_origin).astype(int) + 3 for each in (cal, dense))
        mine, theirs = (
            each.beam[row:, col:][:5, :5]
            for each, (row, col) in zip((cal, dense), corners, strict=True)
        )
        np.testing.assert_allclose(mine, theirs, atol=1e-6)

    @pytest.mark.long
    @pytest.mark.parametrize("shifts", [SMALL_CROSS, FRACTIONS], ids=["whole", "between"])
    def test_two_levels_tell_gain_and_offset(self, shifts):
        twice, levels = np.tile(shifts, (2, 1)), np.repeat([1, 0.5], 5)
        squares = []
        for seed in range(4):
            rng = np.random.default_rng(seed)
            offset = 0.1 * rng.random(SMALL)
            sensitivity = simulate.paper_sensitivity(SMALL, rng=rng)
            beam = simulate.wavy_beam(SMALL, width=30, rng=rng)
            frames = simulate.exposures(sensitivity, beam, twice, flux=levels) + offset
            frames += 1e-3 * rng.standard_normal(frames.shape)
            options = {"flux": levels, "variance": np.full(10, 1e-6), "dark": "fit"}
            cal = equipix.calibrate(frames, twice, tolerance=1e-8, **options)
            dense = reference.joint(frames, twice, **options)
            assert cal.converged
            np.testing.assert_allclose(cal.sensitivity, dense.sensitivity, atol=1e-6)
            np.testing.assert_allclose(cal.dark, dense.dark, atol=1e-6)
            squares.append(((cal.sensitivity - sensitivity / sensitivity.mean()) / dense.std) ** 2)
            squares.append(((cal.dark - offset) / dense.dark_std) ** 2)
        # 432 values each; correlations leave half of them, whose mean scatters by 0.1.
        assert np.mean(squares[::2]) == pytest.approx(1, abs=0.3)
        assert np.mean(squares[1::2]) == pytest.approx(1, abs=0.3)

    @pytest.mark.parametrize("flux", [None, np.full(5, 2.0)])
    def test_one_level_cannot_tell_gain_from_offset(self, flux):
        frames, measured = small(2, SMALL_CROSS)
        with pytest.raises(InputError, match="offset and gain are degenerate"):
            equipix.calibrate(frames, SMALL_CROSS, flux=flux, dark="fit", **measured)

    def test_a_pixel_with_one_measurement_tells_no_offset(self):
        twice, levels = np.tile(SMALL_CROSS, (2, 1)), np.repeat([1, 0.5], 5)
        truth = simulate.paper_sensitivity(SMALL, rng=1)
        frames = simulate.exposures(truth, simulate.gaussian_beam(SMALL), twice, flux=levels) + 0.1
        mask = np.zeros(frames.shape, bool)
        mask[1:, 5, 5] = True
        cal = equipix.calibrate(frames, twice, flux=levels, dark="fit", mask=mask)
        assert np.argwhere(np.isnan(cal.sensitivity)).tolist() == [[5, 5]]
        assert np.isnan(cal.dark[5, 5])
        assert cal.flags[5, 5] & Flag.NO_FLAT_FIELD
        np.testing.assert_allclose(np.delete(cal.dark, 5 * SMALL[1] + 5), 0.1, atol=1e-4)

    def test_residuals_know_the_fitted_dark(self):
        twice, levels = np.tile(SMALL_CROSS, (2, 1)), np.repeat([1, 0.5], 5)
        frames = simulate.exposures(
            simulate.paper_sensitivity(SMALL, rng=1),
            simulate.gaussian_beam(SMALL),
            twice,
            flux=levels,
        )
        cal = equipix.calibrate(frames + 0.1, twice, flux=levels, dark="fit")
        np.testing.assert_allclose(cal.residuals(frames + 0.1), 0, atol=1e-5)


@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
class TestBetweenPixels:
    @pytest.mark.long
    def test_noise_counts_as_with_whole_shifts(self):
        rms = np.empty((10, 2))
        for seed in range(10):
            for whole in (False, True):
                frames, shifts, truth = structured(seed, whole=whole)
                cal = equipix.calibrate(frames, shifts, tolerance=1e-5)
                rms[seed, int(whole)] = rms_error(cal, truth)
        between, whole_shifts = rms.mean(axis=0)
        print(f"\nerror between pixels over that of whole shifts: {between / whole_shifts:.2f}")
        assert between <= 1.05 * whole_shifts
        # Section 5 of the design: 1.21·noise/√n for smooth beams; the structure adds a little.
        assert rms[:, 1].mean() == pytest.approx(1.21 * NOISE / np.sqrt(5), rel=0.1)

    @pytest.mark.long
    def test_without_noise_the_spline_itself_is_what_is_left(self):
        for seed in range(3):
            frames, shifts, truth = structured(seed, noise=0)
            cal = equipix.calibrate(frames, shifts)
            assert cal.converged
            assert rms_error(cal, truth) <= 1e-5

    def test_a_terrible_fit_is_told(self):
        frames, shifts, _ = structured(0)
        # The misfit that a wrong sign explains is no finding of its own.
        with pytest.warns(MisfitWarning, match="squared residuals are .* times as large"):
            cal = equipix.calibrate(frames, -shifts, tolerance=1e-4, variance=np.full(5, NOISE**2))
        assert [finding.kind for finding in cal.findings] == ["sign"]

    def test_rounded_shifts_ruin_it(self):
        frames, shifts, truth = structured(0)
        rounded = equipix.calibrate(frames, np.rint(shifts), tolerance=1e-5)
        assert rms_error(rounded, truth) > 5 * NOISE

    @pytest.mark.long
    def test_shifts_are_refined_where_the_beam_tells_them(self):
        rms = np.empty((4, 3))
        for seed in range(4):
            frames, shifts, truth = structured(seed)
            std = 0.05
            known = shifts + std * np.random.default_rng(seed + 50).standard_normal((5, 2))
            options = {"tolerance": 1e-5, "variance": np.full(5, NOISE**2)}
            runs = (
                equipix.calibrate(frames, shifts, **options),
                equipix.calibrate(frames, known, shift_std=std, **options),
                equipix.calibrate(frames, known, **options),
            )
            rms[seed] = [rms_error(run, truth) for run in runs]
            # 19 200 values, relative slopes of some 0.03: 1e-4 pixels; large scales count less.
            assert runs[1].metadata["options"]["shifts"] == "refined"
            error = runs[1].shifts - shifts
            assert np.abs(error - error.mean(axis=0)).max() < 1e-3
        true, refined, measured = rms.mean(axis=0)
        print(f"\nerror with refined shifts over that with the true ones: {refined / true:.3f}")
        assert refined < 1.1 * true
        assert measured > 1.5 * true

    @pytest.mark.long
    def test_shifts_that_a_smooth_beam_cannot_tell_stay_as_given(self):
        rng = np.random.default_rng(3)
        beam = simulate.gaussian_beam(SENSOR, width=1e4)
        truth = simulate.paper_sensitivity(SENSOR, rng=rng)
        shifts, std = between(CROSS, rng), 0.01
        frames = simulate.exposures(truth, beam, shifts)
        frames += NOISE * rng.standard_normal(frames.shape)
        known = shifts + std * rng.standard_normal(shifts.shape)
        options = {"variance": np.full(5, NOISE**2), "tolerance": 1e-4}
        given = equipix.calibrate(frames, known, **options)
        refined = equipix.calibrate(frames, known, shift_std=std, **options)
        assert refined.converged
        assert refined.metadata["options"]["shifts"] == "undetermined"
        np.testing.assert_array_equal(refined.shifts, known)
        np.testing.assert_allclose(refined.sensitivity, given.sensitivity, atol=1e-4)


def drifting(seed, shape, cross, *, turn, noise=1e-3, drift=0.01, sixth=True):
    """The rotation check: a smooth beam, a drifting lamp, a sixth exposure that is turned."""
    rng = np.random.default_rng(seed)
    shifts = np.vstack([cross, [(0, 0)]]) if sixth else np.array(cross)
    rotation = [0] * 5 + [turn] if sixth else [0] * 5
    flux = np.exp(drift * rng.standard_normal(len(shifts)))
    flux /= np.exp(np.log(flux).mean())
    truth = simulate.cosine_sensitivity(shape, rng=rng)
    beam = simulate.gaussian_beam(shape, width=1000)
    frames = simulate.exposures(truth, beam, shifts, flux=flux, rotation=rotation)
    frames += noise * rng.standard_normal(frames.shape)
    return frames, shifts, rotation, flux, truth


class TestFluxes:
    # In smooth beams free fluxes leave the orientation undetermined, which is said.
    @pytest.mark.long
    @pytest.mark.filterwarnings("ignore:neither residuals nor fluxes determine the orientation")
    @pytest.mark.parametrize(
        ("shape", "cross", "turn"),
        [((256, 256), (23, 41), 180), (SENSOR, (11, 19), 90), (SENSOR, (11, 19), 270)],
    )
    def test_a_turned_exposure_determines_them(self, shape, cross, turn):
        for seed in range(2):
            frames, shifts, rotation, flux, truth = drifting(
                seed, shape, equipix.cross_pattern(*cross), turn=turn
            )
            options = {"rotation": rotation, "variance": np.full(6, 1e-6), "tolerance": 1e-6}
            free = equipix.calibrate(frames, shifts, flux="fit", **options)
            given = equipix.calibrate(frames, shifts, flux=flux, **options)
            # Six more unknowns than pixels and cells: F takes no notice.
            assert rms_error(free, truth) < 1.001 * rms_error(given, truth)
            # A mean over N pixels knows a flux to 1e-3/√N, and what turns a tilt into fluxes
            # knows it some five times worse: 2e-5 of N = 256².
            one = 5e-3 / np.sqrt(truth.size)
            tilt = (slope(free.sensitivity) - slope(given.sensitivity)) * truth.shape
            assert np.abs(tilt).max() < 4 * one
            assert np.abs(free.flux / flux - 1).max() < 4 * one

    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    @pytest.mark.parametrize("is_between", [False, True], ids=["whole", "between"])
    def test_without_one_the_tilt_is_left_to_the_gauge(self, is_between):
        rng = np.random.default_rng(4)
        cross = between(CROSS, rng) if is_between else CROSS
        frames, shifts, _, flux, truth = drifting(5, SENSOR, cross, turn=0, sixth=False)
        with pytest.warns(IdentifiabilityWarning, match="tilt of the sensitivity undetermined"):
            cal = equipix.calibrate(frames, shifts, flux="fit", tolerance=1e-5)
        # Sums of 19 200 terms of size 1, in double precision.
        assert np.abs(slope(np.log(cal.sensitivity))).max() < 1e-14
        assert np.log(cal.flux).mean() == pytest.approx(0, abs=1e-14)
        hidden = np.column_stack([np.ones(5), shifts])
        told = np.linalg.svd(hidden)[0][:, 3:]
        # Each of the n − 3 is a mean over 19 200 pixels, known to 1e-5 and some.
        np.testing.assert_allclose(told.T @ np.log(cal.flux), told.T @ np.log(flux), atol=1e-4)

        # Taken as equal, what is affine in the shifts becomes a tilt: section 5.
        with pytest.warns(MisfitWarning, match="the data contradict the fluxes"):
            steady = equipix.calibrate(frames, shifts, tolerance=1e-5)
        affine = np.linalg.lstsq(hidden, np.log(flux))[0][1:]
        tilt = slope(np.log(steady.sensitivity / truth))
        # What is not affine leaves residuals, not tilts, but for some percent at edges.
        np.testing.assert_allclose(tilt, -affine, atol=0.1 * np.abs(affine).max())

    @pytest.mark.parametrize("level", [0.36, 0.38])
    def test_pixels_at_a_limit_of_the_range_count_for_both_or_none(self, level):
        # These columns are near half of the mean, 0.76 and 0.77: the tilt that is removed moves
        # some of them across that limit.
        shape, shifts = (48, 64), equipix.cross_pattern(5, 7)
        truth = simulate.paper_sensitivity(shape, rng=3)
        truth[:, :24] *= level
        beam, flux = simulate.gaussian_beam(shape, width=150), [1, 1.02, 1.03, 0.98, 0.99]
        frames = simulate.exposures(truth, beam, shifts, flux=flux)
        with pytest.warns(IdentifiabilityWarning, match="tilt of the sensitivity undetermined"):
            cal = equipix.calibrate(frames, shifts, flux="fit")
        # Sums of 3072 terms of size 1, in double precision.
        assert np.abs(cal.tilt).max() < 1e-13

    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_pixels_that_contradict_themselves_count_for_neither(self):
        shape, shifts = (48, 64), equipix.cross_pattern(5, 7)
        truth = simulate.paper_sensitivity(shape, rng=3)
        beam, flux = simulate.gaussian_beam(shape, width=150), [1, 1.01, 0.99, 1.02, 0.98]
        frames = simulate.exposures(truth, beam, shifts, flux=flux)
        frames += 1e-3 * np.random.default_rng(4).standard_normal(frames.shape)
        frames[:, 40, 50] *= [1, 0.5, 1.4, 0.7, 1.9]
        with pytest.warns(IdentifiabilityWarning, match="tilt of the sensitivity undetermined"):
            cal = equipix.calibrate(frames, shifts, flux="fit", robust=True)
        assert cal.flags[40, 50] & equipix.Flag.UNRELIABLE_FLAT
        assert np.isfinite(cal.sensitivity[40, 50])
        assert np.abs(cal.tilt).max() < 1e-13
        counted = np.isfinite(cal.sensitivity) & (cal.flags & equipix.Flag.UNRELIABLE_FLAT == 0)
        assert cal.sensitivity[counted].mean() == pytest.approx(1, abs=1e-13)

    def test_the_tilt_of_the_gauge_is_that_of_the_result(self):
        # A part of weak response and a dead pixel count for neither.
        shape, shifts = (48, 64), equipix.cross_pattern(5, 7)
        truth = simulate.paper_sensitivity(shape, rng=3)
        truth[:, :32] *= 0.3
        truth[30, 40] = 0
        beam, flux = simulate.gaussian_beam(shape, width=150), [1, 1.01, 0.99, 1.02, 0.98]
        frames = simulate.exposures(truth, beam, shifts, flux=flux)
        frames += 1e-3 * np.random.default_rng(4).standard_normal(frames.shape)
        with pytest.warns(IdentifiabilityWarning, match="tilt of the sensitivity undetermined"):
            cal = equipix.calibrate(frames, shifts, flux="fit")
        assert (cal.flags[:, :32] == 0).all()
        assert (cal.sensitivity[:, :32] < 0.5).all()
        assert cal.flags[30, 40] != 0
        # Sums of 3072 terms of size 1, in double precision.
        assert np.abs(cal.tilt).max() < 1e-13

    def test_a_monitor_limits_the_tilt(self):
        monitor = 1e-4
        frames, shifts, _, flux, truth = drifting(6, SENSOR, CROSS, turn=0, sixth=False)
        known = flux * (1 + monitor * np.random.default_rng(7).standard_normal(5))
        options = {"variance": np.full(5, 1e-6), "tolerance": 1e-6}
        cal = equipix.calibrate(frames, shifts, flux=known, flux_std=monitor, **options)
        assert cal.converged
        hidden = np.column_stack([np.ones(5), shifts])
        off = np.log(known / flux)
        # What looks like a tilt stays as the monitor has it, the rest comes from the frames:
        # to a mean over 19 200 pixels of noise 1e-3.
        left = np.log(cal.flux / flux)
        affine = hidden @ np.linalg.lstsq(hidden, off)[0]
        np.testing.assert_allclose(left, affine, atol=4e-3 / np.sqrt(truth.size))

    def test_a_linear_drift_is_told_by_an_interleaved_order(self):
        time = np.array([0, 3, 1, 4, 2]) * 60.0
        rng = np.random.default_rng(8)
        truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
        flux = np.exp(0.01 * (time - time.mean()) / np.ptp(time))
        frames = simulate.exposures(truth, simulate.gaussian_beam(SENSOR), CROSS, flux=flux)
        frames += 1e-3 * rng.standard_normal(frames.shape)
        cal = equipix.calibrate(frames, CROSS, flux="linear", time=time, tolerance=1e-6)
        # The share of the trend that is no tilt tells it: means over 19 200 pixels.
        hidden = np.column_stack([np.ones(5), CROSS])
        unit = np.log(flux) / np.linalg.norm(np.log(flux))
        share = np.linalg.norm(unit - hidden @ np.linalg.lstsq(hidden, unit)[0])
        std = 1e-3 / np.sqrt(truth.size) / share
        assert np.linalg.norm(np.log(cal.flux / flux)) < 4 * 1.21 * std

    def test_a_drift_along_the_shifts_is_left_to_the_gauge(self):
        shifts = [(0, 0), (0, 2), (0, 3), (0, 5)]
        frames, measured = small(3, shifts)
        with (
            pytest.warns(IdentifiabilityWarning, match="unconnected"),
            pytest.warns(IdentifiabilityWarning, match="tilt"),
        ):
            equipix.calibrate(frames, shifts, flux="linear", time=[0, 2, 3, 5], **measured)


class TestLaws:
    SHIFTS = between(SMALL_CROSS, np.random.default_rng(9))

    def fitted(self, frames, shifts, **options):
        return equipix.calibrate(frames, shifts, tolerance=1e-9, **options).sensitivity

    def test_brighter_frames_change_but_the_beam(self):
        frames, measured = small(4, self.SHIFTS)
        plain = self.fitted(frames, self.SHIFTS, **measured)
        scaled = measured | {"variance": 1e6 * measured["variance"]}
        brighter = self.fitted(1e3 * frames, self.SHIFTS, **scaled)
        np.testing.assert_allclose(brighter, plain, atol=1e-7)

    def test_order_does_not_matter(self):
        frames, measured = small(5, self.SHIFTS)
        plain = self.fitted(frames, self.SHIFTS, **measured)
        order = [3, 0, 4, 2, 1]
        measured = {name: values[order] for name, values in measured.items()}
        again = self.fitted(frames[order], self.SHIFTS[order], **measured)
        np.testing.assert_allclose(again, plain, atol=1e-7)

    def test_axes_and_directions_are_alike(self):
        frames, measured = small(6, self.SHIFTS)
        plain = self.fitted(frames, self.SHIFTS, **measured)
        swapped = {name: values.swapaxes(1, 2) for name, values in measured.items()}
        turned = self.fitted(frames.swapaxes(1, 2), self.SHIFTS[:, ::-1], **swapped)
        np.testing.assert_allclose(turned.T, plain, atol=1e-7)
        mirrored = {name: values[:, ::-1] for name, values in measured.items()}
        upside = self.fitted(frames[:, ::-1], self.SHIFTS * [-1, 1], **mirrored)
        np.testing.assert_allclose(upside[::-1], plain, atol=1e-7)

    def test_threads_do_not_change_a_bit(self):
        frames, shifts, _ = structured(1, shape=(64, 80))
        options = {"flux": "fit", "shift_std": 0.01, "rotation": [0, 0, 0, 0, 180]}
        options |= {"max_sweeps": 60}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            # No frames were turned for this rotation: a finding names them.
            warnings.simplefilter("ignore", MisfitWarning)
            one, two = (
                equipix.calibrate(frames, shifts, workers=workers, **options) for workers in (1, 2)
            )
        for name in ("sensitivity", "beam", "flux", "shifts"):
            assert getattr(one, name).tobytes() == getattr(two, name).tobytes()

    def test_known_fluxes_and_whole_shifts_are_the_plain_problem(self):
        frames, measured = small(7, SMALL_CROSS)
        plain = self.fitted(frames, SMALL_CROSS, **measured)
        # A prior of 1e-9 lets fluxes move by less than that.
        joint = self.fitted(frames, SMALL_CROSS, flux=np.ones(5), flux_std=1e-9, **measured)
        np.testing.assert_allclose(joint, plain, atol=1e-7)


def test_a_linear_drift_hides_one_tilt_alone():
    # A raster in equal times, t = (2, 1)·d: a drift is told from all tilts but that along (2, 1).
    shape, shifts = (30, 40), [(0, 0), (0, 1), (1, 0), (1, 1)]
    v, u = np.indices(shape) / 100
    truth = np.exp(0.02 * v - 0.04 * u)
    frames = simulate.exposures(truth, simulate.gaussian_beam(shape, width=60), shifts)
    options = {"flux": "linear", "time": [0, 1, 2, 3], "tolerance": 1e-8}
    with pytest.warns(IdentifiabilityWarning, match="tilt"):
        cal = equipix.calibrate(frames, shifts, **options)
    # M to 1e-8, its slope over 30 rows to a twentieth of that a pixel.
    np.testing.assert_allclose(slope(np.log(cal.sensitivity)), (2e-4, -4e-4), rtol=0, atol=1e-9)
    np.testing.assert_allclose(cal.flux, 1, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"flux": "foo"}, "'flux' is 'foo'"),
        ({"flux": "fit", "flux_std": 0.1}, "'flux_std' is given, but 'flux' is 'fit'"),
        ({"flux_std": [0.1, 0.1]}, "'flux_std'"),
        ({"flux_std": 0}, r"'flux_std' is \[0.0"),
        ({"flux_std": np.nan}, "'flux_std' is"),
        ({"time": [0, 1, 2, 3, 4]}, "'time' is given but 'flux'"),
        ({"flux": "fit", "time": [0, 1, 2, 3, 4]}, "'time' and flux='linear' need each other"),
        ({"flux": "linear"}, "'time' and flux='linear' need each other"),
        ({"flux": "linear", "time": [0, 1]}, "'time' has"),
        ({"flux": "linear", "time": [1, 1, 1, 1, 1]}, "'time' is .*not all the same"),
        ({"flux": "linear", "time": [0, 1, 2, 3, np.inf]}, "'time' is"),
        ({"shift_std": [0.1, 0.1]}, r"'shift_std' has shape"),
        ({"shift_std": np.full((5, 3), 0.1)}, r"'shift_std' has shape \(5, 3\)"),
        ({"shift_std": -0.1}, "'shift_std' is"),
        ({"shift_std": 0}, "'shift_std' is .*not all 0"),
        ({"shift_std": np.full(5, np.nan)}, "'shift_std' is"),
        ({"dark": "foo"}, "'dark' is 'foo'"),
        ({"method": "coordinate-descent", "flux": "fit"}, "'method' is 'coordinate-descent'"),
        ({"method": "coordinate-descent", "shift_std": 0.1}, "'method' is 'coordinate-descent'"),
        ({"method": "coordinate-descent", "dark": "fit"}, "'method' is 'coordinate-descent'"),
    ],
)
def test_bad_input_is_named(options, message):
    frames, _ = small(1, SMALL_CROSS)
    with pytest.raises(InputError, match=message):
        equipix.calibrate(frames, SMALL_CROSS, **options)
