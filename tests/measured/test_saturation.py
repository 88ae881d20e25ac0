"""Levels above a full well, which lies below the top of the ADC, and what looks like one."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import equipix
from equipix import errors, nuc
from equipix.simulate import StaringArray

SHAPE = (48, 64)
WELL, GAIN, OFFSET = 20_000, 0.15, 100


def level(electrons, count, rng, *, spread=0.02, noise_e=10.0, drift=0.0):
    """Average of frames of a camera of 12 bits that is full at 3100 DN; seeds name its gains."""
    maps = np.random.default_rng(1)
    light = electrons * (1 + spread * maps.standard_normal(SHAPE))
    gain = GAIN * (1 + spread * maps.standard_normal(SHAPE))
    rng = np.random.default_rng(rng)
    power = 1 + drift * np.linspace(-1, 1, count)[:, None, None]
    held = np.minimum(rng.normal(power * light, np.sqrt(light)), WELL)
    read = gain * (held + noise_e * rng.standard_normal(held.shape)) + OFFSET
    return equipix.average(np.rint(read).astype(np.uint16), saturation=4095)


def said(levels, **options):
    """Messages of the warnings of a fit."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        nuc.fit(levels, **options)
    return [str(each.message) for each in caught if each.category is errors.InputWarning]


class TestAFullWell:
    @pytest.mark.parametrize("count", [2, 8, 64])
    def test_is_named_with_its_numbers_and_what_to_do(self, count):
        light = (2_000, 8_000, 14_000, 25_000, 30_000)
        levels = [level(each, count, k) for k, each in enumerate(light)]
        (message,) = said(levels)
        assert message.startswith("level 3 and level 4 of 'levels' probably saturate")
        told = re.findall(r"([\d.]+) DN² at ([\d.]+) DN \(level (\d)\)", message)
        assert [int(number) for *_, number in told] in ([3, 2], [4, 2])
        for variance, mean, number in told:
            which = levels[int(number)]
            # As printed, with three digits of a variance and six of a mean.
            assert float(variance) == pytest.approx(np.mean(which.variance), rel=5e-3)
            assert float(mean) == pytest.approx(np.mean(which.mean), rel=5e-6)
        assert "Leave out what saturates, and write saturation = " in message
        assert said(levels[:3]) == []
        # The level that is named excludes the full wells and nothing else.
        named = float(message.split("saturation = ")[1].split()[0])
        assert levels[2].mean.max() < named < np.median(levels[3].mean)

    def test_needs_no_dark_level_and_minds_no_dark_that_is_subtracted(self):
        dark = level(0, 16, 9)
        frames = [level(each, 8, k) for k, each in enumerate((8_000, 14_000, 25_000))]
        less = [
            equipix.FrameStatistics(
                each.mean - dark.mean,
                *(each.variance, each.variance_of_mean, each.count, each.saturated),
                dark=dark,
                saturation=4095,
            )
            for each in frames
        ]
        (message,), (plain,) = said(less), said(frames)
        assert message == plain

    def test_of_a_simulated_array(self):
        array = StaringArray.of("InSb", SHAPE, rng=1)
        levels = [
            equipix.average(array.frames(each, 8, rng=k)) for k, each in enumerate((4e6, 8e6, 25e6))
        ]
        (message,) = said(levels)
        assert message.startswith("level 2 of 'levels' probably saturates below")
        # With the level that it names the same frames are refused for their saturation.
        named = float(message.split("saturation = ")[1].split()[0])
        again = [
            equipix.average(array.frames(each, 8, rng=k), saturation=named)
            for k, each in enumerate((4e6, 8e6, 25e6))
        ]
        with pytest.raises(errors.InputError, match=r"Level 2 has no value in .*leave out levels"):
            nuc.fit(again)

    def test_under_a_mask_is_not_judged(self):
        levels = [level(each, 8, k) for k, each in enumerate((8_000, 14_000, 15_000))]
        mask = np.broadcast_to(np.arange(SHAPE[1]) < 50, SHAPE)
        pairs = zip(level(25_000, 8, 9).maps.values(), levels[2].maps.values(), strict=True)
        mixed = equipix.FrameStatistics(*(np.where(mask, *pair) for pair in pairs), saturation=4095)
        noise = equipix.NoiseModel(read_noise=10 * GAIN, gain=GAIN)
        assert said([*levels[:2], mixed], mask=mask, variance=noise) == []
        assert len(said([*levels[:2], mixed], variance=noise)) == 1


class TestNoFullWell:
    """What is good raises no warning: six standard errors, a chance of 1e-9 in each case."""

    @pytest.mark.parametrize("count", [2, 3, 8])
    @pytest.mark.parametrize("seed", range(5))
    def test_levels_that_lie_close_together(self, count, seed):
        light = 10_000 * 1.02 ** np.arange(12)
        assert said([level(each, count, 100 * seed + k) for k, each in enumerate(light)]) == []

    def test_gains_that_differ(self):
        light = 5_000 * 1.05 ** np.arange(12)
        assert said([level(each, 64, k, spread=0.05) for k, each in enumerate(light)]) == []

    @pytest.mark.parametrize("sigma", [0.05, 0.2, 0.5])
    def test_noise_below_a_step_of_the_adc(self, sigma):
        """Rounding makes the variance 0 in the middle of a step, and 1/4 DN² at its end."""
        rng = np.random.default_rng(3)
        halves = np.where(np.arange(SHAPE[1]) % 2, 0.5, 0.0)
        levels = []
        for value in (100.0, 200.2, 300.0, 400.2, 500.0):
            frames = value + halves + sigma * rng.standard_normal((8, *SHAPE))
            levels.append(equipix.average(np.rint(frames).astype(np.uint16)))
        assert said(levels, variance=[1.0] * 5) == []

    @pytest.mark.parametrize("count", [2, 8, 64, 256])
    @pytest.mark.parametrize("spread", [0.02, 0.05, 0.1])
    @pytest.mark.parametrize("level_that_drifts", [1, 2])
    def test_a_source_that_drifts_at_one_level(self, count, spread, level_that_drifts):
        """By 1 to 4 % of the light, which adds more variance than photons, at a level not full."""
        for drift in (0.01, 0.04):
            light = (2_000, 8_000, 10_000, 12_000)
            drifts = [drift if k == level_that_drifts else 0.0 for k in range(len(light))]
            levels = [
                level(each, count, 7 * k, spread=spread, drift=drifts[k])
                for k, each in enumerate(light)
            ]
            most = np.mean(levels[level_that_drifts].variance)
            if drift == 0.04:
                assert most > 2 * np.mean(levels[3].variance)
            assert said(levels) == []

    @pytest.mark.parametrize("material", ["PtSi", "InSb", "HgCdTe"])
    @pytest.mark.parametrize("count", [2, 16])
    def test_arrays_that_are_curved(self, material, count):
        array = StaringArray.of(material, SHAPE, rng=2)
        light = np.linspace(1e6, 15e6, 8)
        levels = [equipix.average(array.frames(e, count, rng=k)) for k, e in enumerate(light)]
        assert said(levels, order=2) == []

    def test_single_frames_show_no_noise(self):
        assert said([level(each, 1, k) for k, each in enumerate((2_000, 8_000, 25_000))]) == []


@pytest.mark.data
class TestRealCamera:
    def levels(self, data_dir, numbers, saturation):
        folder = data_dir / "emva1288-set001-ccd-12bit/images"
        return [
            equipix.average(sorted(folder.glob(f"b_{each:03}_snap_*.png")), saturation=saturation)
            for each in numbers
        ]

    @pytest.mark.long
    def test_all_levels_in_which_few_pixels_saturate_are_good(self, data_dir):
        assert said(self.levels(data_dir, range(0, 37, 3), 4095)) == []
