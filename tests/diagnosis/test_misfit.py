"""What `calibrate` says of residuals: reduced χ², correlation of neighbours, and likely causes."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.diagnosis.misfit import _scale_words, misfit
from equipix.errors import EquipixWarning, MisfitWarning
from equipix.exposures.exposures import FitOptions
from equipix.exposures.positions import Positions
from equipix.fitting import windows
from equipix.fitting.residuals import bands, lag_one, sampled

SENSOR, CROSS = (64, 96), equipix.cross_pattern(11, 19)
NOISE = 1e-3


def photograph(rng, beam, shifts=CROSS, *, noise=NOISE, given=None):
    """Frames of a sensor, with white noise, and the shifts that are given."""
    sensor = simulate.cosine_sensitivity(SENSOR, rng=rng)
    frames = simulate.exposures(sensor, beam, shifts)
    frames = frames + noise * rng.standard_normal(frames.shape)
    return frames, shifts if given is None else given


def found_in(frames, shifts, variance=NOISE**2, **options):
    """The misfit of a calibration, or None; its warning is tested elsewhere."""
    if variance is not None:
        variance = np.broadcast_to(variance, len(frames))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        cal = equipix.calibrate(frames, shifts, variance=variance, tolerance=1e-4, **options)
    options = FitOptions(tolerance=1e-4)
    return misfit(cal.weighted, cal.flags, sampled(cal.weighted), options)


def smooth():
    return simulate.gaussian_beam(SENSOR, width=150)


def wavy(seed):
    return simulate.wavy_beam(SENSOR, rng=seed)


def with_row_noise(rng):
    frames, shifts = photograph(rng, smooth())
    return frames + 0.5 * NOISE * rng.standard_normal((5, SENSOR[0], 1)), shifts


def with_column_noise(rng):
    frames, shifts = photograph(rng, smooth())
    return frames + 0.5 * NOISE * rng.standard_normal((5, 1, SENSOR[1])), shifts


def with_dust(rng):
    frames, shifts = photograph(rng, smooth())
    row, col = rng.integers(20, 40), rng.integers(30, 60)
    frames[2, row : row + 6, col : col + 6] *= 0.97
    return frames, shifts


def with_a_bad_exposure(rng):
    frames, shifts = photograph(rng, smooth())
    frames[3] += 2 * NOISE * rng.standard_normal(SENSOR)
    return frames, shifts


def with_photon_noise(rng):
    frames, shifts = photograph(rng, simulate.gaussian_beam(SENSOR, width=60), noise=0)
    root = np.sqrt(0.1 + frames / frames.max())
    return frames + 1.5 * NOISE * root * rng.standard_normal(frames.shape), shifts


def with_a_false_scale(rng):
    return photograph(rng, wavy(rng), given=CROSS * np.array([1.01, 1.0]))


def with_false_shifts(rng):
    errors = 0.05 * rng.standard_normal(CROSS.shape)
    return photograph(rng, wavy(rng), CROSS + errors, given=CROSS.astype(float))


def with_drift(rng):
    frames, shifts = photograph(rng, smooth())
    return frames * np.exp(2e-3 * rng.standard_normal(5))[:, None, None], shifts


def with_fine_speckle(rng):
    k = 2 * np.pi / rng.uniform(3, 5, 60)
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 60))

    def beam(rows, cols):
        waves = zip(k * np.sin(angle), k * np.cos(angle), phase, strict=True)
        return (
            1
            + 0.02 * sum(np.cos(a * rows + b * cols + start) for a, b, start in waves)
            + 0 * (rows + cols)
        )

    return photograph(rng, beam, CROSS + rng.uniform(-0.5, 0.5, CROSS.shape))


def with_small_variances(rng):
    return photograph(rng, smooth(), noise=1.3 * NOISE)


def with_a_breathing_beam(rng):
    sensor = simulate.cosine_sensitivity(SENSOR, rng=rng)
    widths = 100 * np.exp(0.03 * rng.standard_normal(5))
    beams = [simulate.gaussian_beam(SENSOR, width=width) for width in widths]
    pairs = zip(CROSS, beams, strict=True)
    frames = np.concatenate([simulate.exposures(sensor, beam, [shift]) for shift, beam in pairs])
    return frames + NOISE * rng.standard_normal(frames.shape), CROSS


def with_two_exchanged(rng):
    frames, shifts = photograph(rng, wavy(rng))
    first, second = rng.choice(5, 2, replace=False)
    frames[[first, second]] = frames[[second, first]]
    return frames, shifts


def with_flicker(rng):
    frames, shifts = photograph(rng, smooth())
    phase = rng.uniform(0, 2 * np.pi, (5, 1, 1))
    waves = 2 * np.pi * np.arange(SENSOR[0])[:, None] / rng.uniform(5, 15)
    return frames * (1 + 5e-3 * np.sin(waves + phase)), shifts


CAUSES = {
    "rows": with_row_noise,
    "columns": with_column_noise,
    "region": with_dust,
    "exposure": with_a_bad_exposure,
    "signal": with_photon_noise,
    "shifts": with_false_shifts,
    "flux": with_drift,
    "structure": with_fine_speckle,
    "illumination": with_a_breathing_beam,
    "order": with_two_exchanged,
    "noise": with_small_variances,
}


@pytest.mark.parametrize("cause", CAUSES)
def test_the_cause_is_named(cause):
    for seed in range(3):
        found = found_in(*CAUSES[cause](np.random.default_rng([1, seed])))
        assert found is not None
        assert found.cause == cause


@pytest.mark.long
@pytest.mark.parametrize("cause", ["rows", "columns", "region", "shifts", "flux", "structure"])
def test_correlated_residuals_show_without_variances(cause):
    for seed in range(3):
        found = found_in(*CAUSES[cause](np.random.default_rng([2, seed])), variance=None)
        assert found is not None
        assert found.cause == cause
        assert "neighbouring pixels are correlated" in found.words


@pytest.mark.long
def test_a_false_scale_is_named_with_its_size():
    for seed in range(3):
        found = found_in(*with_a_false_scale(np.random.default_rng([3, seed])))
        assert found is not None
        assert found.cause == "shifts"
        scale = float(found.remedy.split("wrong by about ")[1].split("%")[0])
        # 1 % along rows, to a third: the sensitivity takes a part of what it leaves.
        assert scale == pytest.approx(1, abs=0.34)


def test_one_wrong_shift_is_no_false_scale():
    """Of the outermost of three rows it explains most of what a scale would."""
    rng = np.random.default_rng(4)
    for exposure, error in [(4, (1, 0)), (2, (0, -0.4))]:
        given = CROSS.astype(float)
        given[exposure] += error
        found = found_in(*photograph(rng, wavy(rng), given=given))
        assert found.cause == "shifts"
        assert "scale" not in found.remedy


@pytest.mark.parametrize(("shifts", "is_told"), [(CROSS, True), ([(0, 0), (0, 7), (5, 0)], False)])
def test_a_scale_is_named_where_one_shift_would_not_do_the_same(shifts, is_told):
    """With one move along each axis it would, to rounding."""
    shifts = np.array(shifts, float)
    exposures = SimpleNamespace(positions=Positions.of(shifts))
    weighted = SimpleNamespace(exposures=exposures)
    for scale in np.linspace(0.01, 0.1, 50):
        words = _scale_words(weighted, -scale * shifts)
        assert ("along rows and" in words) == is_told


def test_flicker_while_rows_are_read_is_common_to_rows():
    for seed in range(3):
        assert found_in(*with_flicker(np.random.default_rng([12, seed]))).cause == "rows"


def test_a_misfit_comes_before_the_drift_that_it_feigns():
    frames, shifts = with_a_breathing_beam(np.random.default_rng(13))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        cal = equipix.calibrate(frames, shifts, variance=np.full(5, NOISE**2))
    assert [finding.kind for finding in cal.findings] == ["misfit", "drift"]


def test_shift_std_is_no_remedy_where_it_was_given():
    assert "or give 'shift_std'" in found_in(*with_false_shifts(np.random.default_rng(14))).remedy
    rng = np.random.default_rng(14)
    beam = simulate.gaussian_beam(SENSOR, width=60, centre=(62, 48))
    frames, _ = photograph(rng, beam, CROSS + 0.2 * rng.standard_normal(CROSS.shape))
    found = found_in(frames, CROSS, shift_std=0.01)
    assert found.cause == "shifts"
    assert "which are wrong by more than their 'shift_std'" in found.remedy


def calibrated_in_speckle(period, seed):
    """A calibration with error bars in random waves of that period, and the true sensitivity."""
    rng = np.random.default_rng([15, round(10 * period), seed])
    waves = 60
    k = 2 * np.pi / (period * rng.uniform(0.8, 1.2, waves))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, waves))

    def beam(rows, cols):
        arguments = zip(k * np.sin(angle), k * np.cos(angle), phase, strict=True)
        return 1 + 0.018 * sum(np.cos(a * rows + b * cols + c) for a, b, c in arguments)

    shifts = CROSS + rng.uniform(-0.5, 0.5, CROSS.shape)
    truth = simulate.cosine_sensitivity(SENSOR, rng=rng)
    frames = simulate.exposures(truth, beam, shifts)
    frames += NOISE * rng.standard_normal(frames.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EquipixWarning)
        cal = equipix.calibrate(
            frames, shifts, variance=np.full(5, NOISE**2), tolerance=1e-5, uncertainty=True
        )
    return cal, truth / truth.mean()


def test_error_bars_in_speckle_of_three_pixels_are_refused():
    """There residuals are six times as large as noise."""
    cal, _ = calibrated_in_speckle(3.0, 0)
    assert cal.sensitivity_std is None
    assert "finer than a spline" in cal.findings[-1].message
    with pytest.raises(equipix.errors.InputError, match="move by whole pixels"):
        cal.std_of(equipix.metrics.maps.tilt_weights(np.ones(SENSOR, bool)))


@pytest.mark.study
@pytest.mark.parametrize(("period", "widened"), [(5.0, True), (10.0, False)])
def test_error_bars_in_speckle_are_widened_or_left(period, widened, figure):
    """With 5 pixels a period residuals are a tenth larger than noise."""
    rms = []
    for seed in range(6):
        cal, truth = calibrated_in_speckle(period, seed)
        z = (cal.sensitivity - truth) / cal.sensitivity_std
        rms.append(np.sqrt(np.mean(z**2)))
        assert (cal.weighted.excess > 1) == widened
    figure(f"z in speckle of {period:g} pixels", float(np.mean(rms)), "0.95 to 1.3")
    # Errors of pixels have large scales in common, so the scatter between experiments counts, not
    # the number of pixels. Student's t with 5 degrees of freedom is beyond 4 in one of 100 cases.
    assert abs(np.mean(rms) - 1) < 4 * np.std(rms, ddof=1) / len(rms) ** 0.5


def test_variances_that_are_too_large_are_noticed():
    found = found_in(*photograph(np.random.default_rng(4), smooth(), noise=0.6 * NOISE))
    assert found.cause == "noise"
    assert "too large" in found.words


def test_a_window_does_not_answer_for_the_whole_sensor():
    """Noise is larger than stated beyond a central window alone."""
    shape, rng = (400, 400), np.random.default_rng(16)
    sensor = simulate.cosine_sensitivity(shape, rng=rng)
    frames = simulate.exposures(sensor, simulate.wavy_beam(shape, rng=16), CROSS)
    noise = np.full(shape, 1.2 * NOISE)
    noise[115:286, 115:286] = NOISE
    found = found_in(frames + noise * rng.standard_normal(frames.shape), CROSS)
    assert found.cause == "noise"
    assert "times as large as the variances predict" in found.words


@pytest.mark.parametrize("true", [0.9, 1.0])
def test_the_noise_of_a_dark_hides_no_wrong_variances(true):
    rng = np.random.default_rng(17)
    beam = simulate.wavy_beam(SENSOR, contrast=0.3, rng=rng)
    frames, shifts = photograph(rng, beam, noise=true**0.5 * NOISE)
    frames += NOISE * rng.standard_normal(SENSOR)
    found = found_in(frames, shifts, dark_variance=NOISE**2)
    assert found is None if true == 1 else "too large" in found.remedy


@pytest.mark.parametrize("true", [0.85, 1.0])
def test_errors_of_shifts_as_stated_hide_no_wrong_variances(true):
    rng = np.random.default_rng(21)
    beam = simulate.gaussian_beam(SENSOR, width=60)
    moved = CROSS + 0.025 * rng.standard_normal(CROSS.shape)
    frames, _ = photograph(rng, beam, moved, noise=true**0.5 * NOISE)
    found = found_in(frames, CROSS, shift_std=0.025)
    assert found is None if true == 1 else "too large" in found.remedy


@pytest.mark.study
def test_no_false_alarm_over_right_models(draws):
    """100 experiments: whole and fractional shifts, smooth and structured beams, with masks."""
    for seed in draws(100):
        rng = np.random.default_rng([5, seed])
        beam = (smooth(), wavy(rng), simulate.striped_beam(SENSOR))[seed % 3]
        shifts = CROSS + (rng.uniform(-0.5, 0.5, CROSS.shape) if seed % 2 else 0)
        frames, shifts = photograph(rng, beam, shifts, noise=NOISE)
        mask = rng.random(SENSOR) < 0.05 if seed % 4 == 0 else None
        variance = None if seed % 5 == 0 else NOISE**2
        assert found_in(frames, shifts, variance, mask=mask) is None


FIVE = np.array([(0, 0), (0, 11), (0, 29), (14.4, 0.3), (37.2, -0.2)])
BETWEEN = np.array([(0, 0), (0.37, 0.21), (-0.28, 0.44), (0.1, 0.13), (0.2, -0.24)])


@pytest.mark.long
def test_noise_that_a_spline_follows_is_no_misfit():
    """Its slow waves more than its fast ones: neighbours were correlated by -5 %, 5.2 errors."""
    for seed in range(2):
        frames, shifts = photograph(np.random.default_rng([22, seed]), smooth(), FIVE + BETWEEN)
        assert found_in(frames, shifts) is None


def test_noise_is_simulated_once(monkeypatch):
    """Where both its χ² and the correlation of its neighbours are asked, which is a fit each."""
    asked = []

    def of_noise(*given):
        asked.append(windows.of_noise(*given))
        return asked[-1]

    monkeypatch.setattr("equipix.diagnosis.misfit.of_noise", of_noise)
    frames, shifts = photograph(np.random.default_rng([22, 0]), smooth(), FIVE + BETWEEN)
    with pytest.warns(MisfitWarning, match="times as large as the variances predict"):
        equipix.calibrate(frames, shifts, variance=np.full(5, NOISE**2 / 1.15))
    assert len(asked) == 1


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "shifts"),
    [
        ("five", FIVE),
        ("five, all between pixels", FIVE + BETWEEN),
        ("cross (11, 19) between pixels", CROSS + BETWEEN),
    ],
)
def test_noise_between_pixels_is_no_misfit(name, shifts, draws, figure):
    """A small sensor has wide edges, where few exposures see the beam."""
    shape, false, seeds = (100, 130), 0, draws(40)
    for seed in seeds:
        rng = np.random.default_rng([23, seed])
        sensor = simulate.paper_sensitivity(shape, rng=rng)
        frames = simulate.exposures(sensor, simulate.gaussian_beam(shape), shifts)
        frames = frames + NOISE * rng.standard_normal(frames.shape)
        false += found_in(frames, shifts) is not None
    figure(f"false misfits, {name}", f"{false} of {len(seeds)}", "at most 1 %")
    assert false <= 0.01 * len(seeds) + 3 * (0.01 * len(seeds)) ** 0.5


@pytest.mark.study
def test_the_correlation_of_white_residuals_is_normal(draws, figure):
    """Two z of each right model: mean 0, variance 1; limits are four standard errors of these."""
    z = []
    for seed in draws(100):
        frames, shifts = photograph(np.random.default_rng([6, seed]), smooth())
        cal = equipix.calibrate(frames, shifts, tolerance=1e-4)
        residuals = sampled(cal.weighted)
        z += [each.z for each in lag_one(residuals.values, residuals.share)]
    # Of few values the standard deviation is taken about the mean that is wanted.
    error, rms = 1 / len(z) ** 0.5, np.mean(np.square(z)) ** 0.5
    figure(
        "correlation of neighbours in white residuals, mean z", np.mean(z), f"0 ± {4 * error:.2f}"
    )
    figure(
        "correlation of neighbours in white residuals, rms z", rms, f"1 ± {4 * error / 2**0.5:.2f}"
    )
    assert abs(np.mean(z)) < 4 * error
    assert abs(rms - 1) < 4 * error / 2**0.5


def test_it_is_a_warning_and_a_finding():
    frames, shifts = photograph(np.random.default_rng(7), smooth(), noise=1.3 * NOISE)
    # Of simulated and of measured noise, each of 13 000 degrees of freedom: to 0.6 %.
    with pytest.warns(
        MisfitWarning, match=r"1\.(29|3[01]?) times as large as the variances predict"
    ):
        cal = equipix.calibrate(frames, shifts, variance=np.full(5, NOISE**2))
    assert [finding.kind for finding in cal.findings] == ["misfit"]


def test_data_without_noise_say_nothing():
    frames, shifts = photograph(np.random.default_rng(8), smooth(), noise=0)
    assert equipix.calibrate(frames, shifts, variance=np.full(5, NOISE**2)).findings == ()


def test_a_sample_has_the_residuals_of_its_rows():
    frames, shifts = photograph(np.random.default_rng(9), wavy(9), CROSS + 0.25 * np.eye(5, 2))
    cal = equipix.calibrate(frames, shifts, variance=np.full(5, NOISE**2), tolerance=1e-4)
    whole, part = sampled(cal.weighted), sampled(cal.weighted, most=5 * 96 * 32)
    expected = cal.residuals(frames, variance=np.full(5, NOISE**2))
    np.testing.assert_allclose(whole.values[:, 0], expected, rtol=0, atol=1e-9)
    assert part.values.shape == (5, 2, 32, 96)
    np.testing.assert_allclose(part.values, expected[:, part.rows], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("count", "most"), [(10, 3), (100, 500), (100, 64), (100, 0), (33, 33)])
def test_bands_are_rows_of_the_sensor(count, most):
    rows = bands(np.full(count, 7), most)
    assert rows.min() >= 0
    assert rows.max() < count
    assert (np.diff(rows, axis=1) == 1).all()
    assert len(np.unique(rows)) == rows.size <= max(most, count if count < 64 else 64)


def test_bands_lie_where_masks_leave_measurements():
    """Of discs on a large sensor the first and the last rows hold nothing."""
    measured = np.zeros(512)
    measured[100:190] = measured[320:360] = 400
    rows = bands(measured, 4 * 32)
    assert len(rows) >= 3
    assert (measured[rows].sum(axis=1) >= 16 * 400).all()
    assert len(np.unique(rows)) == rows.size


def test_what_most_pixels_are_flagged_for_is_a_misfit_of_a_positive_size():
    """A rotation that is wrong leaves a fifth of the pixels determined; χ² without them was −5."""
    rng = np.random.default_rng(2)
    frames, shifts = photograph(rng, smooth())
    found = found_in(frames, shifts, rotation=[0, 0, 0, 0, 180])
    assert found is None or found.chi2 > 0
