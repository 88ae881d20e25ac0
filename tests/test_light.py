"""Light that varies between the frames of one level: taken out of the noise, and named."""

import warnings

import numpy as np
import pytest

import equipix
from equipix import nuc, simulate
from equipix.errors import DriftWarning
from equipix.exposures.averaged import Averaged
from equipix.io import write_frames
from equipix.light import light_of
from equipix.metrics.moments import moments

SHAPE = (60, 80)
SHIFTS = equipix.cross_pattern(5, 7)
READ, GAIN = 4.0, 0.3


def drifting(rng, signal, share, frames, offset=100):
    """Whole numbers; the light falls by this share from the first to the last frame."""
    light = 1 + share * np.linspace(0.5, -0.5, frames)[:, None, None]
    values = light * signal
    values = offset + values + np.sqrt(READ + GAIN * values) * rng.standard_normal(values.shape)
    return np.rint(values).astype(np.uint16)


def even(rng, level=2000):
    return level * (1 + 0.03 * rng.standard_normal(SHAPE))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_the_variance_of_frame_means_is_kept(dtype, tmp_path):
    frames = np.random.default_rng(1).integers(0, 250, (37, 40, 50)).astype(dtype)
    wanted = frames.mean(axis=(1, 2), dtype=np.float64).var(ddof=1)
    found = equipix.average(frames).light_variance
    # Of whole numbers sums are exact; Chan's formula rounds each of 37 means of 250.
    assert found == pytest.approx(wanted, abs=37 * 250**2 * np.finfo(float).eps)
    assert equipix.average(iter(frames), workers=2).light_variance == found
    assert equipix.average(frames[:1]).light_variance is None
    if dtype is np.uint16:
        write_frames(tmp_path / "f.tif", iter(frames), nbytes=frames.nbytes)
        assert equipix.average(tmp_path / "f.tif").light_variance == found
    for name in ("a.npz", "a.tif"):
        equipix.average(frames).save(tmp_path / name)
        assert equipix.FrameStatistics.load(tmp_path / name).light_variance == found


@pytest.mark.parametrize("share", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("frames", [2, 16])
def test_the_light_is_no_noise(share, frames):
    rng = np.random.default_rng(2)
    signal = even(rng)
    dark = equipix.average(drifting(rng, 0 * signal, 0, frames))
    average = equipix.average(drifting(rng, signal, share, frames), dark=dark)
    averaged = Averaged.of([average])
    assert bool(averaged.unsteady) == (share > 0)
    noise = averaged.noise.scatter(2000.0)
    # Of variances with the part C of the light, the mean over the pixels has the variance
    # 2(σ⁴ + 2σ²C)/(f N); of three parameters, and of the dark, twice that.
    true = READ + GAIN * 2000 + 1 / 12
    common = 2000**2 * np.var(share * np.linspace(0.5, -0.5, frames), ddof=1)
    error = np.sqrt(2 * (1 + 2 * common / true) / (frames - 1) / signal.size)
    assert noise == pytest.approx(true, rel=5 * np.sqrt(2) * error)
    assert not averaged.findings(averaged.noise).noisy.any()


def test_saturated_pixels_do_not_follow_the_light():
    rng = np.random.default_rng(3)
    signal = even(rng)
    signal[:10] = 6000
    frames = np.minimum(drifting(rng, signal, 0.05, 16), 4095)
    average = equipix.average(frames, saturation=4095, dark=np.full(SHAPE, 100.0))
    wanted = np.var(0.05 * np.linspace(0.5, -0.5, 16), ddof=1)
    # A frame mean over 4000 pixels has noise of 4e-4 of 1800 DN, over a scatter of 1.6 %.
    assert light_of(average).relative == pytest.approx(wanted, rel=0.01)


def test_frames_without_light_may_have_an_offset_that_varies():
    rng = np.random.default_rng(4)
    offset = 3 * rng.standard_normal((16, 1, 1))
    dark = np.full(SHAPE, 100.0)
    frames = np.rint(100 + offset + 2 * rng.standard_normal((16, *SHAPE))).astype(np.uint16)
    found = light_of(equipix.average(frames, dark=dark))
    assert found.relative == 0
    assert found.variance(np.zeros(3)) == pytest.approx(offset.var(ddof=1), rel=0.05)


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_averages_and_frames_have_the_same_noise(share):
    rng = np.random.default_rng(5)
    frames = drifting(rng, even(rng), share, 8)
    by_frames, by_average = (moments("frames", each) for each in (frames, equipix.average(frames)))
    assert by_average.variance == pytest.approx(by_frames.variance, rel=1e-9)


def test_levels_with_light_that_varies_are_named_and_fitted():
    rng = np.random.default_rng(6)
    gain = 1 + 0.03 * rng.standard_normal(SHAPE)
    levels = [equipix.average(drifting(rng, x * gain, 0.05, 16)) for x in (200, 900, 1600, 2300)]
    with pytest.warns(DriftWarning, match=r"level 3: the light varies by 1\.\d\d% rms"):
        response = nuc.fit(levels, order=1)
    # 2 × 4800 degrees of freedom, five standard errors; V̄ follows the light of each level.
    assert np.nanmean(response.reduced_chi2) == pytest.approx(1, abs=5 * np.sqrt(2 / 9600))
    assert not response.flags.any()


@pytest.mark.study
def test_error_bars_with_light_that_varies(draws, figure):
    """Sixteen frames an exposure, whose light falls by 5 %; with it in the noise z is 0.60."""
    z = []
    for seed in draws(20):
        rng = np.random.default_rng([7, seed])
        truth = simulate.paper_sensitivity(SHAPE, rng=rng)
        beam = simulate.gaussian_beam(SHAPE, width=80, amplitude=2000)
        signals = simulate.exposures(truth, beam, SHIFTS)
        dark = equipix.average(drifting(rng, 0 * truth, 0, 16))
        averages = [equipix.average(drifting(rng, each, 0.05, 16), dark=dark) for each in signals]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DriftWarning)
            cal = equipix.calibrate(averages, SHIFTS, uncertainty=True)
        assert any(verdict.kind == "light" for verdict in cal.verdicts)
        error = simulate.relative_error(cal.sensitivity, truth)
        z.append(float(np.nanmean((error / cal.sensitivity_std * cal.sensitivity) ** 2)))
    found = float(np.sqrt(np.mean(z)))
    figure("z of calibrate, light that falls by 5 % over 16 frames", found, "0.95 to 1.05")
    assert abs(found - 1) < 0.05 + 3 * (1 / np.sqrt(2 * truth.size) + 0.02) / np.sqrt(len(z))
