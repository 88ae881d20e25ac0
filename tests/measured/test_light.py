"""Light that varies between the frames of one level: taken out of the noise, and named."""

import warnings

import numpy as np
import pytest

import equipix
from equipix import metrics, nuc, simulate
from equipix.errors import MisfitWarning
from equipix.io.tiff import write_frames
from equipix.measured.means import Averaged
from equipix.measured.statistics import light_of
from equipix.metrics.frame_noise import moments

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
        assert equipix.load(tmp_path / name).light_variance == found


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
    assert not averaged.bad_pixels(averaged.noise).noisy.any()


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


@pytest.mark.parametrize("share", [0.0, 0.01])
def test_missing_samples_in_structured_light_are_not_light_that_varies(share):
    """Frames that miss a hundredth of the pixels, others each time, of values from 0 to 20 000."""
    rng = np.random.default_rng(8)
    signal = np.linspace(0, 20_000, SHAPE[1]) * np.ones(SHAPE)
    frames = drifting(rng, signal, share, 16).astype(np.float64)
    frames[rng.random(frames.shape) < 0.01] = np.nan
    dark = equipix.average(drifting(rng, 0 * signal, 0, 16))
    found = light_of(equipix.average(frames, dark=dark))
    wanted = np.var(share * np.linspace(0.5, -0.5, 16), ddof=1)
    # Means over 4752 of 4800 pixels that are spread by 5800 DN scatter by 8 of 10 000 DN. That is
    # independent of the light, whose estimate has 2√(wanted) of it, in 15 degrees of freedom.
    scatter = 0.58 * np.sqrt(0.01 / signal.size)
    assert (found.relative > 0) == (share > 0)
    spread = np.sqrt((4 * wanted * scatter**2 + 2 * scatter**4) / 15)
    assert abs(found.relative - wanted) < 5 * spread
    assert found.offset == 0


@pytest.mark.parametrize("share", [0.0, 0.05])
@pytest.mark.parametrize("lost", ["half of one", "a band of each"])
def test_missing_blocks_of_frames_are_not_light_that_varies(lost, share):
    """Half of one of 16 frames missing feigned 12.66 %."""
    rng = np.random.default_rng(9)
    signal = np.linspace(0, 20_000, SHAPE[1]) * np.ones(SHAPE)
    frames = drifting(rng, signal, share, 16).astype(np.float64)
    if lost == "half of one":
        frames[3, :, :40] = np.nan
    else:
        for frame, band in zip(frames, range(0, 80, 5), strict=True):
            frame[:, band : band + 20] = np.nan
    dark = equipix.average(drifting(rng, 0 * signal, 0, 16))
    found = light_of(equipix.average(frames, dark=dark))
    assert (found.relative > 0) == (share > 0)
    assert found.offset == 0
    # A frame shows the light of its own pixels. Half of frame 3 has 1.5 times the light, and 6 %
    # of the squared deviations; first values lack that frame, 1/16 of the light. A missing quarter
    # changes the mean signal by up to a quarter, and so do the frames that first values lack.
    wanted = np.var(share * np.linspace(0.5, -0.5, 16), ddof=1)
    least, most = (0.86, 1.14) if lost == "half of one" else (0.75**4, 1.25**4)
    assert least * wanted <= found.relative <= most * wanted


@pytest.mark.parametrize("masked", ["half", "garbage"])
@pytest.mark.parametrize("kind", ["whole", "float", "file"])
def test_masked_pixels_show_no_light(kind, masked, tmp_path):
    """With half of the pixels masked the variance was 0.25 of the true one."""
    rng = np.random.default_rng(10)
    frames = drifting(rng, even(rng), 0.05, 16, offset=0)
    mask = np.zeros(SHAPE, bool)
    if masked == "half":
        mask[:30] = True
        frames[:, mask] = 0
    else:
        mask[7] = True
        frames[:, mask] = rng.integers(0, 65_535, (16, 1))
    given = frames.astype(np.float32) if kind == "float" else frames
    if kind == "file":
        given = tmp_path / "f.tif"
        write_frames(given, iter(frames), nbytes=frames.nbytes)
    average = equipix.average(given, mask=mask)
    means = frames[:, ~mask].mean(axis=1, dtype=np.float64)
    # As in the test without a mask, with values up to 3000 here.
    assert average.light_variance == pytest.approx(
        means.var(ddof=1), abs=16 * 3000**2 * np.finfo(float).eps
    )
    wanted = np.var(0.05 * np.linspace(0.5, -0.5, 16), ddof=1)
    # Frame means have noise of √(600/2400) of 2000 DN, over a scatter of 1.6 %: 0.8 % of the
    # variance in 15 degrees of freedom, five times.
    assert light_of(average).relative == pytest.approx(wanted, rel=0.04)
    average.save(tmp_path / "a.npz")
    again = equipix.average(tmp_path / "a.npz", mask=mask)
    assert again.light_variance is None


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
    with pytest.warns(MisfitWarning, match=r"level 3: the light varies by 1\.\d\d% rms"):
        response = nuc.fit(levels, order=1)
    # 2 × 4800 degrees of freedom, five standard errors; V̄ follows the light of each level.
    assert np.nanmean(response.reduced_chi2) == pytest.approx(1, abs=5 * np.sqrt(2 / 9600))
    assert not response.flags.any()


def test_a_light_frame_among_dark_frames_is_named():
    """A newcomer was told to choose other shifts: pixels above the dark count as unresponsive."""
    rng = np.random.default_rng(6)
    light = simulate.gaussian_beam(SHAPE, amplitude=2000, width=60)
    shifts = equipix.cross_pattern(5, 7)
    raws = [
        drifting(rng, each, 0, 16) for each in simulate.exposures(np.ones(SHAPE), light, shifts)
    ]
    darks = drifting(rng, np.zeros(SHAPE), 0, 16)
    for stray in (False, True):
        darks[-1] = raws[0][0] if stray else darks[-1]
        dark = equipix.average(darks)
        averaged = Averaged.of([equipix.average(raw, dark=dark) for raw in raws])
        assert ("'dark': the offset varies" in averaged.unsteady) == stray


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
            warnings.simplefilter("ignore", MisfitWarning)
            cal = equipix.calibrate(averages, SHIFTS, uncertainty=True)
        assert any(finding.kind == "light" for finding in cal.findings)
        error = metrics.relative_error(cal.sensitivity, truth)
        z.append(float(np.nanmean((error / cal.sensitivity_std * cal.sensitivity) ** 2)))
    found = float(np.sqrt(np.mean(z)))
    figure("z of calibrate, light that falls by 5 % over 16 frames", found, "0.95 to 1.05")
    assert abs(found - 1) < 0.05 + 3 * (1 / np.sqrt(2 * truth.size) + 0.02) / np.sqrt(len(z))
