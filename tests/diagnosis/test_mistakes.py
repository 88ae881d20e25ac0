"""Mistakes of a person with frames and darks: refused, or a finding, where data show them."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

import equipix
from equipix import errors, simulate
from equipix.diagnosis.inputs import BEFORE, on_brightness
from equipix.findings import ask
from given import exposures_of

SHAPE, SHIFTS = (60, 80), equipix.cross_pattern(5, 7)


class Bench:
    """Raw frames of five positions and of the dark, of a beam with structure."""

    def __init__(self, seed=1):
        self.rng = np.random.default_rng(seed)
        truth = simulate.paper_sensitivity(SHAPE, rng=self.rng)
        self.offset = 200 + 10 * self.rng.standard_normal(SHAPE)
        self.signals = [truth * simulate.beams.window(_beam, SHAPE, shift) for shift in SHIFTS]
        self.dark = self.take(0 * truth)
        self.frames = [self.take(signal) for signal in self.signals]

    def take(self, signal, count=16):
        """Frames of whole numbers, with noise of 9 DN² and a tenth of the signal."""
        std = np.sqrt(9 + 0.1 * signal)
        values = self.offset + signal + std * self.rng.standard_normal((count, *SHAPE))
        return np.rint(values).astype(np.uint16)


def _beam(row, col):
    lump = np.exp(-((row - 25) ** 2 + (col - 45) ** 2) / 60**2)
    return 6000 * lump * (1 + 0.1 * np.sin(row / 7 + col / 11))


@pytest.fixture(scope="module")
def bench():
    return Bench()


def findings_of(frames, dark):
    """Kinds and messages of the findings."""
    if not isinstance(dark, equipix.FrameStatistics) and dark.ndim == 3:
        dark = equipix.average(dark)
    averages = [equipix.average(each, dark=dark) for each in frames]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        found = equipix.calibrate(averages, SHIFTS).findings
    return {finding.kind: finding.message for finding in found}


def test_without_a_mistake_there_is_no_finding(bench):
    assert findings_of(bench.frames, bench.dark) == {}


@pytest.mark.parametrize(("axis", "words"), [(1, "upside down"), (2, "mirrored left to right")])
def test_one_exposure_that_is_flipped_is_named(bench, axis, words):
    """Its dark was not flipped with it."""
    frames = list(bench.frames)
    frames[2] = np.flip(frames[2], axis)
    found = findings_of(frames, bench.dark)["misfit"]
    assert f"exposure 2 (from 0) fits better {words}" in found


@pytest.mark.parametrize("variance", [None, 30.0], ids=["unknown", "known"])
@pytest.mark.parametrize(
    ("axes", "words"),
    [((0,), "upside down"), ((1,), "mirrored left to right"), ((0, 1), "turned by 180 degrees")],
)
def test_one_array_that_is_flipped_is_named(bench, axes, words, variance):
    """Without variances its white pattern went unnoticed: the error of M was 16 times as large."""
    values = np.array([each.mean(axis=0) - bench.offset for each in bench.frames])
    values[3] = np.flip(values[3], axes)
    known = None if variance is None else np.full(5, variance)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        found = equipix.calibrate(values, SHIFTS, variance=known).findings
    assert any(f"exposure 3 (from 0) fits better {words}" in each.message for each in found)


@pytest.mark.long
def test_a_flip_is_named_where_an_opposite_shift_would_not_fit_the_window():
    rng, shape = np.random.default_rng(1), (200, 220)
    shifts = np.array([(12 * k, (7 * k * k) % 40) for k in range(8)], float)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    values = 6000 * simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    values += 7 * rng.standard_normal(values.shape)
    values[6] = values[6, ::-1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        found = equipix.calibrate(values, shifts, variance=np.full(8, 49.0)).findings
    assert any("exposure 6 (from 0) fits better upside down" in each.message for each in found)


@pytest.mark.parametrize("exposure", [2, 8])
def test_one_shift_of_the_wrong_sign_is_named(exposure):
    """It was said to be turned by 180 degrees. With five positions too few are right to tell."""
    shifts = np.array([*SHIFTS, (3, 4), (-4, 2), (2, -5), (-3, -6)], float)
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    values = np.array([truth * simulate.beams.window(_beam, SHAPE, each) for each in shifts])
    values += 7 * rng.standard_normal(values.shape)
    row, col = shifts[exposure]
    shifts[exposure] *= -1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        found = equipix.calibrate(values, shifts, variance=np.full(9, 49.0)).findings
    words = f"exposure {exposure} (from 0) fits better at the shift ({row:g}, {col:g}) than at"
    assert any(words in each.message for each in found)


def test_a_flip_that_leaves_less_than_half_a_percent_is_named():
    """A pattern of 0.4 % in nearly even light: chi-square is above 100."""
    rng = np.random.default_rng(0)
    truth, beam = (
        1 + 0.004 * rng.standard_normal((64, 72)),
        simulate.wavy_beam((64, 72), contrast=5e-4, rng=1),
    )
    values = simulate.exposures(truth, beam, equipix.cross_pattern(5, 7))
    values += 1e-4 * rng.standard_normal(values.shape)
    values[2] = values[2][::-1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        found = equipix.calibrate(
            values, equipix.cross_pattern(5, 7), variance=np.full(5, 1e-8)
        ).findings
    assert any("exposure 2 (from 0) fits better upside down" in each.message for each in found)


def test_a_noisy_exposure_is_not_flipped_where_variances_are_too_large():
    """Chi-square is 0.29 as given, and 0.30 to 0.31 with the exposure flipped."""
    rng = np.random.default_rng(0)
    truth = 1 + 0.01 * rng.standard_normal((60, 80))
    beam = simulate.wavy_beam((60, 80), contrast=0.002, rng=1)
    values = simulate.exposures(truth, beam, SHIFTS)
    std = 0.01 * np.array([1, 1, 5, 1, 1])[:, None, None]
    values += std * rng.standard_normal(values.shape)
    with pytest.warns(errors.MisfitWarning, match="the variances are too large"):
        equipix.calibrate(values, SHIFTS, variance=np.full(5, 2e-3))


@pytest.mark.parametrize("axis", [1, 2], ids=["up-down", "left-right"])
def test_some_exposures_that_are_flipped_are_a_misfit(bench, axis):
    frames = [np.flip(each, axis) if k in (1, 3) else each for k, each in enumerate(bench.frames)]
    assert "misfit" in findings_of(frames, bench.dark)


@pytest.mark.parametrize(("axis", "name"), [(1, "rows"), (2, "columns")])
def test_exposures_that_are_all_flipped_contradict_the_sign(bench, axis, name):
    """A flipped sensor moves the other way."""
    flipped = [np.flip(each, axis) for each in bench.frames]
    found = findings_of(flipped, np.flip(bench.dark, axis))
    assert f"reverse the sign of the shifts along {name}" in found["sign"]


def test_a_flipped_dark_is_named(bench):
    found = findings_of(bench.frames, np.flip(bench.dark, 2))
    assert "pattern of the dark" in found["misfit"]
    assert "is not flipped" in found["misfit"]


def test_a_dark_subtracted_twice_is_named(bench):
    """Averages keep its pattern; of an array only the offset of all values is left."""
    found = findings_of(bench.frames, 2 * bench.dark)
    assert "pattern of the dark" in found["misfit"]
    assert "once" in found["misfit"]
    assert "offset of" in findings_of(bench.frames, 2 * bench.dark.mean(axis=0))["misfit"]


def test_a_dark_subtracted_by_half_is_named_where_it_is_large():
    """Half of 800 DN is 7 % of this light; half of 200 DN is below what residuals show."""
    bench = Bench()
    bench.offset += 600
    dark = bench.take(np.zeros(SHAPE)).mean(axis=0)
    frames = [bench.take(signal) for signal in bench.signals]
    assert "offset of" in findings_of(frames, dark / 2)["misfit"]


@pytest.mark.parametrize("share", [1.0, 1.2])
def test_a_dark_as_bright_as_the_light_is_refused(bench, share):
    dark = bench.take(share * bench.signals[0])
    with pytest.raises(errors.InputError, match="is there light, and is the right dark"):
        findings_of(bench.frames, dark)


def test_frames_and_dark_that_are_exchanged_are_refused(bench):
    with pytest.raises(errors.InputError, match=r"is the (right dark|dark that of these frames)"):
        findings_of([bench.take(0 * bench.signals[0]) for _ in SHIFTS], bench.frames[0])


def test_a_dark_that_holds_a_tenth_of_the_light_is_a_drift(bench):
    """The light of an unmoved beam is missing in all exposures; a hundredth shows nowhere."""
    assert [*findings_of(bench.frames, bench.take(0.1 * bench.signals[0]))] == ["drift"]


def test_positions_in_the_place_of_frames_are_refused(bench):
    frames = np.array([each.mean(axis=0) for each in bench.frames])
    with pytest.raises(errors.InputError, match=r"'frames' has shape \(5, 2\), expected 3"):
        equipix.calibrate(SHIFTS, frames)


@pytest.mark.parametrize(("place", "mixed"), [(0, (0, 1)), (1, (1, 3)), (4, (0, 1, 2, 3, 4))])
def test_two_positions_in_one_average_are_a_misfit(bench, place, mixed):
    """As a pattern of names that takes files of several positions."""
    frames = list(bench.frames)
    frames[place] = np.concatenate([frames[k] for k in mixed])
    assert "misfit" in findings_of(frames, bench.dark)


def arrays(bench):
    """Mean frames without their offset, in DN."""
    return np.array([each.mean(axis=0) - bench.offset for each in bench.frames])


def findings(values, shifts=SHIFTS, **known):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        return equipix.calibrate(values, shifts, **known).findings


@pytest.mark.long
@pytest.mark.parametrize("std", [None, 0.02], ids=["known", "prior"])
@pytest.mark.parametrize("flux", [0.5, 2, 3])
def test_a_flux_that_is_far_off_names_the_exposure(bench, flux, std):
    """A factor of 2 made M fall by as much in five pixels: most counted as dead or hot."""
    given = [1, 1, 1, flux, 1]
    found = findings(arrays(bench), flux=given, flux_std=std)
    assert found[0].kind == "flux"
    assert "exposure 3 (from 0)" in found[0].message
    assert f"for its flux of {flux:g}" in found[0].message
    assert not {"drift", "misfit", "prior"} & {each.kind for each in found}


@pytest.mark.parametrize("flux", [0.5, 2])
def test_pixels_that_a_wrong_flux_contradicts_are_no_defects(flux):
    """Masked, they took the contradiction with them: chi-square of the rest was 0.99."""
    shape, shifts = (40, 50), equipix.cross_pattern(3, 5)
    truth = simulate.paper_sensitivity(shape, rng=1)
    frames = 1e4 * simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    frames += 30 * np.random.default_rng(1).standard_normal(frames.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", errors.EquipixWarning)
        cal = equipix.calibrate(frames, shifts, variance=np.full(5, 900.0), flux=[1, 1, 1, flux, 1])
    assert cal.reduced_chi2 > 100


@pytest.mark.long
@pytest.mark.parametrize("flux", [None, "fit"])
@pytest.mark.parametrize("black", [0, 1])
def test_a_black_exposure_is_named(bench, flux, black):
    values = arrays(bench)
    values[black] = np.random.default_rng(1).normal(5, 3, SHAPE)
    found = {each.kind: each.message for each in findings(values, flux=flux)}
    assert f"exposure {black} (from 0) has" in found["flux"]


def test_a_sensitivity_that_halves_is_no_wrong_flux_at_large_shifts():
    """Over 48 of 80 columns the light in the same cells falls by a factor of 1.5."""
    shape, shifts = (60, 80), equipix.cross_pattern(5, 48)
    truth = np.tile(np.linspace(1, 0.5, 80), (60, 1))
    frames = 1e4 * simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    frames += 30 * np.random.default_rng(1).standard_normal(frames.shape)
    assert "flux" not in {each.kind for each in findings(frames, shifts)}


def test_a_flipped_exposure_of_a_colour_sensor_is_named():
    """Mirrored, an even number of columns exchanges the colours."""
    shape, shifts = (64, 80), equipix.cross_pattern(5, 11)
    truth = simulate.paper_sensitivity(shape, rng=1) * np.tile([[1, 0.5], [0.5, 0.7]], (32, 40))
    frames = 1e4 * simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    frames += 30 * np.random.default_rng(1).standard_normal(frames.shape)
    frames[2] = frames[2, :, ::-1]
    found = findings(frames, shifts, cfa="RGGB", variance=np.full(5, 900.0))
    words = "exposure 2 (from 0) fits better mirrored left to right"
    assert any(words in each.message for each in found), [each.message for each in found]


def test_a_tilted_sensitivity_is_no_wrong_flux(bench):
    """The light falls by 1.2 between the same cells of the beam."""
    tilt = np.linspace(1, 0.25, SHAPE[1])
    values = np.array([tilt * each for each in bench.signals])
    assert "flux" not in {each.kind for each in findings(values)}


@pytest.mark.long
def test_shifts_in_millimetres_are_named(bench):
    found = findings(arrays(bench), 0.0083 * SHIFTS)
    assert "divide millimetres by the pixel pitch" in found[0].message


def test_a_flipped_exposure_with_uncertain_shifts_is_named(bench):
    """Its shift was widened instead, by as much as the flip needs."""
    values = arrays(bench)
    values[3] = values[3][:, ::-1]
    found = findings(values, shift_std=0.05, variance=np.full(5, 30.0))
    assert any("fits better mirrored left to right" in each.message for each in found)


def test_a_finding_calls_an_exposure_by_its_name(bench):
    values = arrays(bench)
    values[3] *= 0.5
    names = [f"position {k}" for k in range(5)]
    exposures = exposures_of(values, SHIFTS)
    (found,) = ask(BEFORE, dataclasses.replace(exposures, names=tuple(names)))
    assert "exposure 'position 3' has 0.5 times the light" in found.message


def test_a_prediction_outside_the_beam_is_refused(bench):
    """Every value of it was NaN, without a word."""
    cal = equipix.calibrate(np.array(bench.signals), SHIFTS)
    with pytest.raises(errors.InputError, match=r"'shift' is \[500, 0\]: no exposure has observed"):
        cal.predict((500, 0))


def test_noise_is_no_wrong_flux(bench):
    """Of five sums of 4800 values a signal of 0.01 standard deviations scatters by a factor."""
    rng = np.random.default_rng(1)
    weak = np.array(bench.signals) / np.mean(bench.signals)
    for _ in range(20):
        values = 0.01 * weak + rng.standard_normal(weak.shape)
        assert on_brightness(exposures_of(np.where(weak > 0, values, 0), SHIFTS)) is None
