"""Cosmic rays left out of averages, in one pass."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import cli, errors
from equipix.io.tiff import write_frames
from equipix.measured import stream

SHAPE, SIGMA = (80, 100), 5.0


def clean_frames(count, rng, shape=SHAPE):
    scene = np.linspace(500, 3000, shape[1]) * np.ones(shape)
    return scene, scene + SIGMA * rng.standard_normal((count, *shape))


def with_rays(frames, rng, share=0.01):
    """Frames with cosmic rays, of 10 to 400 standard deviations, in so many of the samples."""
    hit = rng.random(frames.shape) < share
    return np.where(
        hit, frames + SIGMA * np.exp(rng.uniform(np.log(10), np.log(400), frames.shape)), frames
    ), hit


@pytest.mark.parametrize("count", [9, 16, 64])
def test_the_mean_and_the_variance_are_those_of_clean_frames(count):
    rng = np.random.default_rng(count)
    scene, frames = clean_frames(count, rng)
    dirty, _ = with_rays(frames, rng)
    plain, clean = equipix.average(dirty), equipix.average(frames)
    found = equipix.average(dirty, reject=5)

    def error(statistics):
        return np.sqrt(np.mean((statistics.mean - scene) ** 2))

    assert error(plain) > 3 * error(clean)
    assert error(found) < 1.02 * error(clean)
    # Of the same frames: the variance must have no bias of 0.5 % or more.
    assert found.variance.mean() == pytest.approx(clean.variance.mean(), rel=0.005)
    wanted = SIGMA**2
    scatter = 5 * np.sqrt(2 / ((count - 1) * scene.size))
    assert found.variance.mean() == pytest.approx(wanted, rel=0.005 + scatter)


def test_the_rays_are_what_does_not_count():
    rng = np.random.default_rng(3)
    _, frames = clean_frames(32, rng)
    dirty, hit = with_rays(frames, rng)
    found = equipix.average(dirty, reject=5)
    missing = 32 - found.count
    # A limit of 5 leaves out 6e-7 of the clean samples, and every ray from 10 on.
    assert np.count_nonzero(missing != hit.sum(axis=0)) <= 2
    np.testing.assert_allclose(found.variance_of_mean, found.variance / found.count)


@pytest.mark.parametrize("sigmas", [3.0, 4.0])
def test_the_variance_of_what_is_kept_is_corrected(sigmas):
    rng = np.random.default_rng(4)
    _, frames = clean_frames(64, rng)
    found = equipix.average(frames, reject=sigmas)
    # Uncorrected it would be low by 2.7 % at 3 and by 0.1 % at 4. The limit is taken about a mean
    # with an error of its own, which changes the correction by a fraction of itself.
    scatter = 5 * np.sqrt(2 / (63 * frames[0].size))
    assert found.variance.mean() == pytest.approx(SIGMA**2, rel=0.005 + scatter)


def test_clean_frames_keep_their_samples():
    rng = np.random.default_rng(5)
    _, frames = clean_frames(24, rng)
    plain, found = equipix.average(frames), equipix.average(frames, reject=6)
    np.testing.assert_array_equal(found.count, plain.count)
    np.testing.assert_allclose(found.mean, plain.mean, rtol=1e-12)
    np.testing.assert_allclose(found.variance, plain.variance, rtol=1e-6)


@pytest.mark.parametrize("level", [20.0, 20.3, 20.5])
@pytest.mark.parametrize("noise", [0.1, 0.3, 0.6, 1.0])
def test_whole_numbers_keep_their_samples(noise, level):
    """Where most were equal the noise counted as that of rounding, and its tails as outliers."""
    frames = np.rint(np.random.default_rng(1).normal(level, noise, (20, 60, 60))).astype(np.uint8)
    kept, whole = equipix.average(frames, reject=5), equipix.average(frames)
    # Of 72 000 normal samples 0.04 lie beyond five standard deviations.
    assert np.count_nonzero(kept.count < 20) <= 1
    assert kept.variance.mean() == pytest.approx(whole.variance.mean(), rel=1e-3, abs=1e-9)


@pytest.mark.parametrize(("sigmas", "bias"), [(5, 0.015), (4, 0.04), (3, 0.09)])
@pytest.mark.parametrize("times", [1.5, 2.0, 2.5, 3.0, 10.0])
def test_a_noisy_pixel_keeps_its_noise(times, sigmas, bias):
    rng = np.random.default_rng(6)
    _, frames = clean_frames(64, rng)
    noisy = np.zeros(frames[0].shape, bool)
    noisy.flat[::10] = True
    frames[:, noisy] += SIGMA * np.sqrt(times**2 - 1) * rng.standard_normal((64, noisy.sum()))
    found = equipix.average(frames, reject=sigmas)
    share = found.variance[noisy].mean() / (times * SIGMA) ** 2
    # 800 pixels with 63 degrees of freedom; what is too low is the bias that is stated.
    scatter = 5 * np.sqrt(2 / (63 * 800))
    assert -bias - scatter < share - 1 < scatter
    others = found.variance[~noisy].mean() / SIGMA**2
    assert others == pytest.approx(1, abs=0.005 + 5 * np.sqrt(2 / (63 * 7200)))


def test_drift_of_all_pixels_is_no_outlier():
    rng = np.random.default_rng(7)
    _, frames = clean_frames(32, rng)
    frames += np.linspace(0, 200, 32)[:, None, None]
    found = equipix.average(frames, reject=5)
    assert (found.count == 32).mean() > 0.999


def test_a_ray_that_saturates_does_not_count_as_saturated():
    rng = np.random.default_rng(8)
    _, frames = clean_frames(16, rng)
    whole = np.rint(frames).astype(np.uint16)
    whole[12, 3, 4] = 65535
    assert equipix.average(whole).saturated[3, 4] == 1
    found = equipix.average(whole, reject=5)
    assert found.saturated[3, 4] == 0
    assert found.count[3, 4] == 15
    assert found.raw
    assert found.saturation == 65535


def test_masked_and_missing_samples_stay_missing():
    rng = np.random.default_rng(9)
    _, frames = clean_frames(16, rng)
    frames[:, 1, 1] = np.nan
    frames[3, 2, 2] = np.nan
    found = equipix.average(frames, reject=5)
    assert (found.count[1, 1], found.count[2, 2]) == (0, 15)
    masked = np.ma.array(frames, mask=np.isnan(frames))
    np.testing.assert_array_equal(equipix.average(masked, reject=5).count, found.count)


def test_large_frames_that_come_a_few_at_a_time_give_the_same(monkeypatch):
    """The first nine are compared with each other, though a batch has room for fewer."""
    _, frames = clean_frames(20, np.random.default_rng(11), (24, 32))
    wanted = equipix.average(frames, reject=5)
    monkeypatch.setattr(stream, "_BATCH_BYTES", 4 * frames[0].nbytes)
    for source in (iter(frames), iter(np.ma.array(frames))):
        found = equipix.average(source, reject=5)
        for name, values in wanted.maps.items():
            np.testing.assert_array_equal(getattr(found, name), values)


def test_an_iterator_and_files_give_the_same(tmp_path):
    rng = np.random.default_rng(10)
    _, frames = clean_frames(20, rng, (24, 32))
    whole = np.rint(with_rays(frames, rng)[0]).astype(np.uint16)
    wanted = equipix.average(whole, reject=5)
    write_frames(tmp_path / "frames.tif", iter(whole), nbytes=whole.nbytes)
    for source in (iter(whole), tmp_path / "frames.tif"):
        found = equipix.average(source, reject=5)
        for name, values in wanted.maps.items():
            np.testing.assert_array_equal(getattr(found, name), values)
    output = str(tmp_path / "mean.npz")
    with pytest.raises(SystemExit) as end:
        cli.main(["average", str(tmp_path / "frames.tif"), "-o", output, "--reject", "5"])
    assert not end.value.code
    loaded = equipix.load(tmp_path / "mean.npz")
    np.testing.assert_array_equal(loaded.mean, wanted.mean)
    other = str(tmp_path / "other.npz")
    arguments = ["average", str(tmp_path / "frames.tif"), "-o", other, "--reject", "5"]
    with pytest.raises(SystemExit) as end:
        cli.main([*arguments, "--dark", output])
    assert not end.value.code
    with pytest.raises(errors.InputError, match="holds averaged frames"):
        equipix.average(tmp_path / "mean.npz", reject=5)


@pytest.mark.parametrize("reject", [2.9, np.inf, np.nan, True, "five"])
def test_wrong_limits_are_refused(reject):
    with pytest.raises(errors.InputError, match="'reject' is"):
        equipix.average(np.ones((9, 4, 4)), reject=reject)


def test_few_frames_and_other_scenes_are_refused():
    rng = np.random.default_rng(11)
    _, frames = clean_frames(12, rng)
    with pytest.raises(errors.InputError, match="holds 8, expected 9"):
        equipix.average(frames[:8], reject=5)
    frames[10] = frames[10, :, ::-1]
    with pytest.raises(errors.InputError, match=r"% of frame 10 deviate .* another scene"):
        equipix.average(frames, reject=5)
