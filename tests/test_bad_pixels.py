"""Bad pixels of a simulated array, each kind by its criterion."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import Flag, errors, nuc
from equipix.simulate import StaringArray

SHAPE = (48, 64)
LIGHT = np.linspace(2e6, 14e6, 6)
DEAD, WEAK, NOISY, FLICKER, HIGH, BENT = (3, 4), (9, 9), (12, 50), (30, 7), (40, 33), (20, 20)


@pytest.fixture(scope="module")
def array():
    rng = np.random.default_rng(1)
    sensitivity = 1 + 0.02 * rng.standard_normal(SHAPE)
    sensitivity[DEAD], sensitivity[WEAK] = 0.0, 0.4
    noise = np.full(SHAPE, 500.0)
    noise[NOISY] = 20_000.0
    offset = 300 + 30 * rng.standard_normal(SHAPE)
    offset[HIGH] = 12_500.0
    curvature = np.full(SHAPE, 0.002)
    curvature[BENT] = 0.1
    return StaringArray(
        shape=SHAPE,
        sensitivity=sensitivity,
        read_noise_e=noise,
        offset_dn=offset,
        curvature=curvature,
    )


def frames(array, light, count, rng):
    """Frames in which one pixel jumps between two levels."""
    rng = np.random.default_rng(rng)
    stack = np.stack(list(array.frames(light, count, rng=rng)))
    state = np.cumsum(rng.random(count) < 0.1) % 2
    stack[:, FLICKER[0], FLICKER[1]] += (30 * state).astype(np.uint16)
    return stack


@pytest.fixture(scope="module")
def response(array):
    levels = [
        equipix.average(frames(array, light, 32, k), saturation=16383)
        for k, light in enumerate(LIGHT)
    ]
    return nuc.fit(levels, order=1)


def places(flags, flag):
    return {(int(row), int(col)) for row, col in np.argwhere(flags & flag)}


class TestKinds:
    def test_each_bad_pixel_is_found_and_no_good_one(self, array, response):
        found = nuc.find_defects(response, frames(array, 8e6, 100, 99))
        assert places(found.flags, Flag.DEAD) == {DEAD, WEAK}
        assert NOISY in places(found.flags, Flag.HOT)
        assert places(found.flags, Flag.TELEGRAPH) == {FLICKER}
        assert places(found.flags, Flag.OTHER_BAD_PIXEL) == {HIGH}
        assert BENT in places(found.flags, Flag.NONLINEAR)
        bad = {DEAD, WEAK, NOISY, FLICKER, HIGH, BENT}
        assert places(found.flags, Flag.DO_NOT_USE) == bad
        assert found.counts["unusable"] == 6
        assert found.counts["dead"] == 2
        assert found.counts["non_responding"] == 1

    def test_a_sample_without_a_value_hides_no_bad_pixel(self, array, response):
        stack = frames(array, 8e6, 100, 99).astype(float)
        stack[0, 0, 0] = np.nan
        found = nuc.find_defects(response, stack)
        assert NOISY in places(found.flags, Flag.HOT)
        assert places(found.flags, Flag.TELEGRAPH) == {FLICKER}

    def test_averages_show_noise_but_no_flicker(self, array, response):
        average = equipix.average(frames(array, 8e6, 100, 99))
        found = nuc.find_defects(response, average)
        assert found.counts["noisy"] >= 1
        assert "flickering" not in found.counts

    def test_without_frames_the_curves_alone_count(self, response):
        found = nuc.find_defects(response)
        assert set(found.counts) == {
            "dead",
            "non_responding",
            "out_of_range",
            "nonlinear",
            "unusable",
        }

    def test_good_arrays_raise_no_alarm(self):
        array = StaringArray.of("InSb", (96, 128), rng=2)
        levels = [equipix.average(array.frames(light, 16, rng=k)) for k, light in enumerate(LIGHT)]
        response = nuc.fit(levels, order=2)
        found = nuc.find_defects(response, np.stack(list(array.frames(8e6, 30, rng=50))))
        assert found.counts["unusable"] == 0

    def test_the_distribution_of_the_gain_is_reported(self, response):
        found = nuc.find_defects(response).gain_percentiles
        assert list(found) == ["0.1", "1", "5", "25", "50", "75", "95", "99", "99.9"]
        values = list(found.values())
        assert values == sorted(values)
        # Normal with a spread of 0.02: the quartiles lie 0.6745 of it from the median.
        assert found["75"] - found["25"] == pytest.approx(2 * 0.6745 * 0.02, rel=0.1)


class TestLimits:
    def test_they_are_adjustable(self, response):
        strict = nuc.find_defects(response, limits=nuc.DefectLimits(response=0.98))
        # Below 0.98 of the mean lies what is beyond one spread of a normal distribution.
        assert strict.counts["dead"] == pytest.approx(0.1587 * 48 * 64, rel=0.15)
        loose = nuc.find_defects(response, limits=nuc.DefectLimits(response=0.2))
        assert loose.counts["dead"] == 1

    def test_wrong_limits_are_refused(self):
        with pytest.raises(errors.InputError, match="'noise' is 0"):
            nuc.DefectLimits(noise=0)

    def test_wrong_frames_are_refused(self, response):
        with pytest.raises(errors.InputError, match=r"frames of \(4, 5\), the sensor"):
            nuc.find_defects(response, np.ones((3, 4, 5)))
        with pytest.raises(errors.InputError, match="holds one frame"):
            nuc.find_defects(response, equipix.average(np.ones((1, *SHAPE))))


class TestFlags:
    def test_they_combine_by_or_and_survive_saving(self, array, response, tmp_path):
        found = nuc.find_defects(response, frames(array, 8e6, 100, 99))
        flagged = response.with_flags(found.flags)
        np.testing.assert_array_equal(flagged.flags, response.flags | found.flags)
        flagged.save(tmp_path / "r.tif")
        loaded = equipix.load(tmp_path / "r.tif")
        np.testing.assert_array_equal(loaded.flags, flagged.flags)
        corrector = equipix.Corrector(loaded)
        assert corrector.replaced == 6
        corrected = corrector.apply(frames(array, 8e6, 2, 5))
        assert corrected.std() < 20

    def test_other_flags_are_refused(self, response):
        with pytest.raises(errors.InputError, match="'flags' is float64"):
            response.with_flags(np.zeros(SHAPE))
