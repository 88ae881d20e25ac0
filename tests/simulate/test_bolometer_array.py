"""The simulated array of bolometers: closed forms of its light, heat, bridge and noise."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import errors
from equipix.detector import photons as physics
from equipix.simulate import BolometerArray

SHAPE = (12, 16)
KELVIN = 293.15
"""The substrate at 20 °C."""


def band_share(product):
    """Share of a black body's power below λ, of λT in µm K: its series in exp(−c₂/λT)."""
    x, n = 14387.768775 / product, np.arange(1, 60)
    terms = np.exp(-n * x) / n * (x**3 + 3 * x**2 / n + 6 * x / n**2 + 6 / n**3)
    return 15 / np.pi**4 * terms.sum()


class TestLight:
    @pytest.mark.parametrize("kelvin", [250.0, 300.0, 373.15])
    def test_the_exitance_is_that_of_the_series(self, kelvin):
        stefan_boltzmann = 5.670374419e-8 * kelvin**4
        wanted = stefan_boltzmann * (band_share(14 * kelvin) - band_share(8 * kelvin))
        # The constants have ten digits.
        assert physics.exitance((8.0, 14.0), kelvin) == pytest.approx(wanted, rel=1e-8)

    def test_light_warms_by_its_power_over_the_conductance(self):
        pixels = BolometerArray(shape=SHAPE, bias_v=1e-6)
        rise = pixels.temperature(20.0, scene_c=40.0) - KELVIN
        power = physics.exitance((8.0, 14.0), KELVIN + 20) - physics.exitance((8.0, 14.0), KELVIN)
        # The temperatures, near 300 K, are rounded to 6e-14 K; the bias heats by 1e-13 K.
        np.testing.assert_allclose(rise, 0.8 * 25e-6**2 / 5 * power / 1e-7, atol=1e-12)

    def test_a_shutter_at_the_substrate_gives_no_light(self):
        pixels = BolometerArray.of(SHAPE, rng=1)
        np.testing.assert_array_equal(pixels.mean(35.0), pixels.mean(35.0, scene_c=35.0))
        assert (pixels.mean(35.0, scene_c=36.0) > pixels.mean(35.0)).all()


class TestHeat:
    def test_a_constant_resistance_is_heated_as_the_linear_equation_says(self):
        pixels = BolometerArray(shape=SHAPE, b_k=1e-9, reference_b_k=1e-9)
        heat, time = 2.0**2 / 4e5, 1e-9 / 1e-7
        # Periodic state: the rise at the end of a pulse, θ = a + (θ e^(−t/τ)) e^(−pulse/τ).
        added = heat / 1e-7 * -np.expm1(-60e-6 / time)
        wanted = added / -np.expm1(-(1 / 30) / time)
        rise = pixels.temperature(20.0) - KELVIN
        np.testing.assert_allclose(rise, wanted, rtol=0, atol=1e-11)

    def test_the_steps_are_small_enough(self, monkeypatch):
        pixels = BolometerArray.of(SHAPE, rng=1)
        before = [pixels.temperature(each, scene_c=100.0) for each in (-20.0, 60.0)]
        monkeypatch.setattr(physics, "_STEPS", 2 * physics._STEPS)
        after = [pixels.temperature(each, scene_c=100.0) for each in (-20.0, 60.0)]
        np.testing.assert_allclose(before, after, rtol=0, atol=1e-9)

    def test_the_bias_acts_through_the_heat_alone(self):
        cold = BolometerArray.of(SHAPE, rng=1)
        cold = cold.with_properties(capacity_j_per_k=1e3, conductance_w_per_k=1e3)
        change = cold.mean(20.0, bias_v=2.1) - cold.mean(20.0, bias_v=1.9)
        # With such a capacity a pulse of 10 µW warms by 6e-13 K, and G lets no heat remain.
        assert np.abs(change).max() < 1e-3 * cold.mean(20.0).std()
        warm = BolometerArray.of(SHAPE, rng=1)
        rises = [warm.temperature(20.0, bias_v=each) - KELVIN for each in (1.0, 2.0)]
        # Four times the power; the resistance falls by 2 % of the rise of 0.5 K.
        np.testing.assert_allclose(rises[1] / rises[0], 4, rtol=0.02)


class TestBridge:
    def test_equal_arms_are_balanced(self):
        pixels = BolometerArray(shape=SHAPE, bias_v=1e-6)
        np.testing.assert_allclose(pixels.mean(-20.0), pixels.offset_dn, rtol=0, atol=1e-6)

    def test_its_output_follows_the_ratio_of_the_arms(self):
        pixels = BolometerArray(shape=SHAPE, resistance_ohm=9e4, pulse_s=1e-12)
        wanted = 30000 + 5e5 * 2.0 * (1e5 / 1.9e5 - 0.5)
        np.testing.assert_allclose(pixels.mean(26.85), wanted, rtol=1e-9)

    def test_the_heat_sunk_arm_removes_most_of_the_ambient(self):
        pixels = BolometerArray.of(SHAPE, rng=1)
        one_arm = pixels.with_properties(reference_b_k=1e-9)
        changes = [abs((each.mean(60.0) - each.mean(-20.0)).mean()) for each in (pixels, one_arm)]
        assert changes[0] < changes[1] / 50

    def test_the_span_holds_all_pixels(self):
        pixels = BolometerArray.of(SHAPE, rng=1)
        span = pixels.output_span([-20.0, 60.0], [-20.0, 100.0])
        frames = [pixels.mean(own, scene_c=s) for own in (-20.0, 60.0) for s in (-20.0, 100.0)]
        assert span == np.max(frames) - np.min(frames)


class TestNoise:
    def test_johnson(self):
        pixels = BolometerArray(shape=SHAPE)
        wanted = np.sqrt(4 * 1.380649e-23 * 300.0 * 1e5 * 1e3)
        np.testing.assert_allclose(pixels.johnson_v(26.85), wanted, rtol=1e-9)
        assert f"{1e6 * wanted:.2f}" == "1.29"

    def test_frames_have_the_mean_and_the_noise_stated(self):
        pixels = BolometerArray.of((40, 50), rng=1)
        found = equipix.average(pixels.frames(20.0, 64, rng=2, scene_c=30.0, bias_v=1.95))
        noise = pixels.temporal_noise(20.0)
        z = (found.mean - pixels.mean(20.0, scene_c=30.0, bias_v=1.95)) / noise * 8
        # 2000 normal values, rms ± 1.6 %; variances of 64 frames, mean ± 0.4 %.
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=5 * 0.016)
        assert np.mean(found.variance / noise**2) == pytest.approx(1, abs=5 * 0.004)

    def test_the_adc_limits_values(self):
        pixels = BolometerArray(shape=SHAPE, bit_depth=8, offset_dn=1e4)
        frame = next(pixels.frames(20.0, 1, rng=1))
        assert frame.dtype == np.uint8
        assert frame.min() == 255


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"shape": (0, 4)}, "'shape'"),
        ({"bit_depth": 17}, "'bit_depth' is 17"),
        ({"bias_v": 0.0}, "'bias_v' is 0.0, expected a finite number above 0"),
        ({"pulse_s": 0.1}, "'frame_s' is 0.0333.*, expected more than 'pulse_s', 0.1"),
        ({"band_um": (14.0, 8.0)}, r"'band_um' is \(14.0, 8.0\)"),
        ({"b_k": np.ones(3)}, r"'b_k' has shape \(3,\), expected one number or \(12, 16\)"),
        ({"absorption": np.full(SHAPE, -0.1)}, "'absorption' holds -0.1"),
        ({"resistance_ohm": np.nan}, "'resistance_ohm' holds nan"),
    ],
)
def test_wrong_properties_are_refused(given, message):
    with pytest.raises(errors.InputError, match=message):
        BolometerArray(**({"shape": SHAPE} | given))


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"substrate_c": -300.0}, "'substrate_c' is -300.0 °C, expected more than -273.15"),
        ({"substrate_c": 20.0, "scene_c": np.nan}, "'scene_c' is nan"),
        ({"substrate_c": 20.0, "bias_v": -1.0}, "'bias_v' is -1.0"),
    ],
)
def test_states_that_are_none_are_refused(state, message):
    with pytest.raises(errors.InputError, match=message):
        BolometerArray(shape=SHAPE).mean(**state)


@pytest.mark.parametrize("conductance", [1e-8, 2e-9])
def test_pulses_add_up_in_pixels_that_are_slow(conductance):
    """Pulses much shorter than the time constant τ add up to one over 1 − exp(−frame/τ)."""
    slow = BolometerArray(shape=(1, 1), conductance_w_per_k=conductance)
    time = float(np.ravel(slow.capacity_j_per_k)[0]) / conductance
    once = BolometerArray(shape=(1, 1), conductance_w_per_k=conductance, frame_s=100 * time)
    single, many = (float(each.temperature(20.0)[0, 0]) - KELVIN for each in (once, slow))
    # Equal arms of the bridge: the power changes by the square of the change of the resistance.
    wanted = single / (1 - np.exp(-slow.frame_s / time))
    assert many == pytest.approx(wanted, rel=0.02)


@pytest.mark.long
def test_a_pixel_without_a_steady_state_is_refused():
    array = BolometerArray(shape=(1, 1), capacity_j_per_k=1.0)
    with pytest.raises(errors.InputError, match="reaches no steady state"):
        array.temperature(20.0)
