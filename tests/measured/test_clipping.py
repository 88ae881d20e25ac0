"""A saturation level that is missing or too high is found and named."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import equipix
from equipix import Experiment, Flag, errors, simulate
from equipix.measured.means import Averaged
from equipix.measured.saturation import clipping, clipping_of

SHAPE, SHIFTS = (64, 80), equipix.cross_pattern(5, 7)


def camera(seed, *, bit_depth=12, exposure_e=14_000.0, frames=6, width=120):
    """A virtual experiment; at 20 000 electrons and more the middle saturates."""
    rng = np.random.default_rng(seed)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    beam = simulate.gaussian_beam(SHAPE, width=width)
    return simulate.experiment(
        truth,
        beam,
        SHIFTS,
        frames=frames,
        bit_depth=bit_depth,
        exposure_e=exposure_e,
        stage_error=0.0,
        rng=rng,
    )


def averages(virtual, level=None, *, subtract=True):
    dark = equipix.average(virtual.dark(), saturation=level) if subtract else None
    return [
        equipix.average(virtual.frames(k), dark=dark, saturation=level) for k in range(len(SHIFTS))
    ]


@pytest.mark.parametrize("bit_depth", [8, 10, 12])
@pytest.mark.parametrize("frames", [1, 6])
def test_a_missing_level_is_named(bit_depth, frames):
    virtual = camera(1, bit_depth=bit_depth, exposure_e=20_000.0, frames=frames)
    found, level = averages(virtual, 65_535), 2**bit_depth - 1
    saturating = sum((each.mean + each.dark.mean >= level).sum() for each in found)
    assert saturating > 500
    gain = virtual.camera.gain_dn_per_e
    read_noise = np.hypot(gain * virtual.camera.read_noise_e, np.sqrt(1 / 12))
    options = {"variance": equipix.NoiseModel(read_noise, gain)}
    cal, said = calibrated(found, **options)
    assert re.search(f"exactly {level}, .*saturation = {level} ", said["InputWarning"])
    assert "saturation" in {finding.kind for finding in cal.findings}
    # With the level that it names all is well but for pixels that saturate around others.
    again, said = calibrated(averages(virtual, level), **options)
    assert set(said) <= {"IdentifiabilityWarning"}
    assert (again.flags & Flag.SATURATED).any()


def calibrated(frames, **options):
    """A calibration, and its warnings by their class."""
    return recorded(lambda: equipix.calibrate(frames, SHIFTS, **options))


def recorded(calibrate):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        cal = calibrate()
    return cal, {each.category.__name__: str(each.message) for each in said}


@pytest.mark.parametrize("bit_depth", [8, 12])
@pytest.mark.parametrize("seed", range(5))
def test_unclipped_frames_raise_no_warning(seed, bit_depth):
    """Peaks at 70 to 95 % of the range, in broad beams and narrow ones."""
    virtual = camera(
        seed, bit_depth=bit_depth, exposure_e=14_000.0 + 1000 * seed, width=60 + 100 * seed
    )
    for each in averages(virtual, 2**bit_depth):
        assert clipping_of(each) is None
    for frame in virtual.frames(0):
        assert clipping(frame.astype(float)) is None


def test_frames_without_a_number_are_named():
    """Not as a mask that leaves nothing."""
    with pytest.raises(errors.InputError, match="'frames' holds no finite number"):
        equipix.calibrate(np.full((3, 8, 9), np.nan), SHIFTS[:3])


def test_a_wrong_gain_is_named():
    """A tenth of the scatter, so that every pixel counts as noisy."""
    found = averages(camera(4), 4095)
    with pytest.raises(errors.InputError, match=r"leave no usable pixel: .* scatters.* the gain"):
        equipix.calibrate(found, SHIFTS, variance=equipix.NoiseModel(0.05, 0.0002))


@pytest.mark.parametrize(
    "values",
    [
        np.ones((40, 50)),
        np.where(np.arange(2000) < 900, 1.0, 0.9).reshape(40, 50),
        np.where(np.arange(2000) % 7 == 0, 0.0, 1.0).reshape(40, 50),
        np.full((40, 50), np.nan),
        -np.ones((40, 50)),
        np.zeros((1, 3)),
    ],
    ids=["even", "two levels", "dead pixels", "masked", "negative", "tiny"],
)
def test_even_scenes_are_not_clipped(values):
    assert clipping(values) is None


def test_most_of_an_exposure_at_the_largest_number_of_some_bits():
    values = np.where(np.arange(2000) < 400, np.linspace(500, 900, 2000), 1023).reshape(40, 50)
    assert clipping(values).level == 1023
    assert clipping(values - 1) is None


def test_a_level_that_is_too_high_in_a_manifest_is_named(tmp_path):
    path = camera(2, exposure_e=20_000.0).write(tmp_path / "experiment")
    path.write_text(path.read_text().replace("bit_depth = 12", "saturation = 4096"))
    cal, said = recorded(lambda: Experiment.load(path).run(tolerance=1e-3))
    assert "saturation = 4095 in " in said["InputWarning"]
    assert "no usable pixel" not in said["InputWarning"]
    assert "saturation" in {finding.kind for finding in cal.findings}


@pytest.mark.parametrize(
    ("exposure_e", "width"), [(20_000.0, 120), (28_000.0, 50)], ids=["mild", "strong"]
)
def test_clipped_samples_are_not_in_the_noise_model(exposure_e, width):
    """They scatter less; counted, they made every pixel noisy and hot."""
    virtual = camera(3, exposure_e=exposure_e, width=width)
    found = averages(virtual, 65_535)
    assert sum(clipping_of(each) is not None for each in found) == len(SHIFTS)
    noise = Averaged.of(found).noise
    # Variances of 5 degrees of freedom from 5 exposures; the slope of those of half of the 5120
    # pixels over half of the range is the difference of two means, and has twice their error.
    error = 2 * np.sqrt(2 / 5 / (5 * np.prod(SHAPE) / 2))
    assert noise.gain == pytest.approx(virtual.camera.gain_dn_per_e, rel=4 * error)
    bad_pixels = Averaged.of(found).bad_pixels(noise)
    # The camera's own hot pixels are all that there are.
    assert np.count_nonzero(bad_pixels.hot | bad_pixels.noisy) < 0.01 * np.prod(SHAPE)


def test_whole_numbers_saturate_at_the_largest_of_their_type():
    """5 % of the values clipped at 65 535."""
    rng = np.random.default_rng(3)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE, width=150), SHIFTS)
    frames = 65_535 / np.quantile(frames, 0.95) * frames
    frames += 20 * rng.standard_normal(frames.shape)
    clipped = np.clip(np.rint(frames), 0, 65_535).astype(np.uint16)
    variance = np.full(5, 400.0)
    for given in (clipped, list(clipped)):
        with pytest.warns(errors.InputWarning, match="frames of whole numbers"):
            cal = equipix.calibrate(given, SHIFTS, variance=variance, uncertainty=True)
        reached = (clipped == 65_535).any(axis=0)
        np.testing.assert_array_equal((cal.flags & Flag.SATURATED) != 0, reached)
        mean = truth[np.isfinite(cal.sensitivity)].mean()
        z = (cal.sensitivity * mean / truth - 1) / cal.sensitivity_std
        # 5120 values: their rms has a standard error of 1 %, that of the map of 2 % is added.
        assert np.sqrt(np.nanmean(z**2)) == pytest.approx(1, abs=4 * np.hypot(0.01, 0.02))
    _, said = calibrated(clipped.astype(float), variance=variance)
    assert "saturation = 65535" in said["InputWarning"]


@pytest.mark.parametrize("level", [4095, 16_383])
def test_a_level_spread_by_one_dn_is_named(level):
    """5 % of the values clipped, and noise of ± 1 DN behind that."""
    rng = np.random.default_rng(5)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    frames = simulate.exposures(truth, simulate.gaussian_beam(SHAPE, width=150), SHIFTS)
    frames = level / np.quantile(frames, 0.95) * frames + 5 * rng.standard_normal(frames.shape)
    spread = np.minimum(frames, level - 1) + rng.integers(-1, 2, frames.shape)
    _, said = calibrated(np.rint(spread), variance=np.full(5, 26.0))
    words = f"values are between {level - 2} and {level}, .*saturation = {level - 2} "
    assert re.search(words, said["InputWarning"])
    _, said = calibrated(np.rint(0.9 * frames), variance=np.full(5, 26.0))
    assert "InputWarning" not in said
