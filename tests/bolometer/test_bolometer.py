"""Corrections that follow temperature and bias: known truth, laws, the figures of the source."""

from __future__ import annotations

import json
import re
import runpy
import warnings
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import Flag, bolometer, errors, metrics, simulate
from equipix.bolometer.state_fit import flags_of, references_of, response_of
from equipix.report.maps import maps_of
from equipix.saved_results import load_correction
from equipix.simulate import BolometerArray
from records import rewrite

EPS = np.finfo(np.float64).eps
SHAPE = (24, 32)
LIMIT = 1 / 250_000
"""The source's average non-uniformity relative to the range."""

NOMINAL = 2.0
TESTED = -20 + 80 * (np.arange(40) + 0.5) / 40
"""Temperatures of the substrate from -20 to 60 °C that no fit uses."""


def states(count, changes=(-0.05, 0.05)):
    """Temperatures and biases of references, with V² changed by shares of the nominal one."""
    nodes = 20 - 40 * np.cos(np.pi * np.arange(count) / (count - 1))
    return np.array([(t, NOMINAL * np.sqrt(1 + each)) for t in nodes for each in changes])


def means(array, at, **scene):
    return np.stack([array.mean(t, bias_v=v, **scene) for t, v in at])


class Simulated:
    """Noise-free frames of references and of states that no fit uses."""

    def __init__(self):
        self.array = BolometerArray.of(SHAPE, rng=5)
        self.at = states(6)
        self.shutter = means(self.array, self.at)
        changes = np.random.default_rng(1).uniform(-0.05, 0.05, len(TESTED))
        self.tested = np.stack([TESTED, NOMINAL * np.sqrt(1 + changes)], axis=1)
        self.raw = means(self.array, self.tested)
        self.span = self.array.output_span([-20.0, *TESTED[::13], 60.0], [-20.0, 100.0])

    def left(self, correction, raw=None):
        frames = self.raw if raw is None else raw
        corrected = [
            correction.correction(t, v, extrapolate=True).correct(frame)
            for (t, v), frame in zip(self.tested, frames, strict=True)
        ]
        return metrics.non_uniformity(np.stack(corrected), self.span)


@pytest.fixture(scope="module")
def simulated():
    return Simulated()


@pytest.fixture(scope="module")
def both(simulated):
    """Offset and gain of the simulated array."""
    bodies = tuple(means(simulated.array, simulated.at, scene_c=each) for each in (0.0, 40.0))
    return bolometer.fit(simulated.shutter, *simulated.at.T, black_bodies=bodies)


class TestClaimsOfTheSource:
    """Average non-uniformity below 1/250 000 of the range, by static and dynamic correction."""

    def test_the_order_that_is_chosen_suffices(self, simulated):
        correction = bolometer.fit(simulated.shutter, *simulated.at.T)
        assert correction.axes.order == 4
        assert simulated.left(correction) < LIMIT

    def test_a_static_correction_fails(self, simulated):
        correction = bolometer.fit([simulated.array.mean(20.0)], [20.0], NOMINAL)
        assert (correction.axes.order, correction.axes.bias_order) == (0, 0)
        assert simulated.left(correction) > 1e3 * LIMIT

    def test_order_3_fails(self, simulated):
        correction = bolometer.fit(simulated.shutter, *simulated.at.T, order=3)
        assert simulated.left(correction) > 2 * LIMIT

    def test_without_the_bias_it_fails(self, simulated):
        at = states(6, (0.0,))
        shutter = means(simulated.array, at)
        correction = bolometer.fit(shutter, *at.T, order=4)
        assert simulated.left(correction) > 2 * LIMIT

    def test_the_inverse_temperature_needs_one_order_less(self, simulated):
        correction = bolometer.fit(simulated.shutter, *simulated.at.T, order=3, regressor="inverse")
        assert simulated.left(correction) < LIMIT

    @pytest.mark.parametrize("scene_c", [-20.0, 20.0, 60.0])
    def test_with_a_gain_scenes_are_as_even_as_the_shutter(self, simulated, both, scene_c):
        raw = means(simulated.array, simulated.tested, scene_c=scene_c)
        assert simulated.left(both, raw) < LIMIT
        offset = bolometer.fit(simulated.shutter, *simulated.at.T)
        assert simulated.left(offset, raw) > 10 * LIMIT

    def test_noise_of_the_references_adds_little(self, simulated):
        array, at = simulated.array, states(8, (0.0,))
        averages = [equipix.average(array.frames(t, 64, rng=k)) for k, (t, _) in enumerate(at)]
        correction = bolometer.fit(averages, *at.T)
        shares = []
        for celsius in TESTED:
            left = correction.correction(celsius).correct(array.mean(celsius)).std()
            shares.append(left / np.sqrt(np.mean(array.temporal_noise(celsius) ** 2)))
        # Orders of 4 or 5 from 8 x 64 frames leave the noise of √(6/8/64) = 0.11 of a frame.
        assert np.mean(shares) < 0.2

    def test_it_is_comparable_with_johnson_noise(self, simulated, both):
        johnson = simulated.array.dn_per_v * simulated.array.johnson_v(20.0).mean()
        assert simulated.left(both) < johnson / simulated.span < 10 * LIMIT


class TestKnownTruth:
    """Pixels whose offset and response are polynomials of the states."""

    def made(self, order=3, seed=2):
        rng, at = np.random.default_rng(seed), states(6)
        axes = bolometer.fit(np.ones((12, 2, 3)), *at.T, order=order).axes
        offset = 100 * rng.standard_normal((axes.terms, 6, 7))
        gain = 0.02 * rng.standard_normal((axes.terms, 6, 7))
        level = np.append(1e4, 10 * rng.standard_normal(axes.terms - 1))
        offset -= offset.mean(axis=(1, 2), keepdims=True)
        gain -= gain.mean(axis=(1, 2), keepdims=True)

        def frames(states_, signal):
            basis = axes.basis(*np.transpose(states_))
            response = 1 + np.tensordot(basis, gain, 1)
            levels = (basis @ level)[:, None, None]
            return levels + np.tensordot(basis, offset, 1) + response * signal, levels

        return frames, at

    @pytest.mark.parametrize("order", [1, 3])
    def test_offset_and_gain_are_found_to_rounding(self, order):
        frames, at = self.made(order)
        bodies = tuple(frames(at, signal)[0] for signal in (200.0, 900.0))
        found = bolometer.fit(frames(at, 0.0)[0], *at.T, black_bodies=bodies)
        assert (found.axes.order, found.gain_axes.order) == (order, order)
        for state in ((3.3, 1.97), (-11.0, 2.03)):
            raw, level = frames([state], 500.0)
            corrected = found.correction(*state).correct(raw)
            # Values of 1e4, some ten operations and 16 terms; the black bodies differ by 700.
            np.testing.assert_allclose(corrected, level.item() + 500, rtol=0, atol=1e3 * EPS * 1e4)

    def test_states_in_any_order_and_pixels_in_any_place(self):
        frames, at = self.made()
        raw = frames(at, 0.0)[0]
        found = bolometer.fit(raw, *at.T, order=3)
        mixed = np.random.default_rng(1).permutation(len(at))
        again = bolometer.fit(raw[mixed], *at[mixed].T, order=3)
        turned = bolometer.fit(raw.transpose(0, 2, 1), *at.T, order=3)
        scale = 100 * len(at) * EPS * 1e4
        np.testing.assert_allclose(again.offset, found.offset, rtol=0, atol=scale)
        np.testing.assert_allclose(
            turned.offset.transpose(0, 2, 1), found.offset, rtol=0, atol=scale
        )

    def test_what_all_pixels_share_is_no_deviation(self):
        frames, at = self.made()
        raw = frames(at, 0.0)[0]
        common = 50 * np.random.default_rng(1).standard_normal((len(at), 1, 1))
        found, other = (bolometer.fit(each, *at.T, order=3) for each in (raw, raw + common))
        np.testing.assert_allclose(other.offset, found.offset, rtol=0, atol=1e3 * EPS * 1e4)

    def test_one_bias_has_no_order_in_it(self):
        frames, _ = self.made()
        at = states(6, (0.0,))
        found = bolometer.fit(frames(at, 0.0)[0], *at.T)
        assert (found.axes.bias_order, found.axes.order) == (0, 3)
        assert found.metadata["options"]["bias_order"] == 0


class TestBadPixels:
    def test_they_are_flagged_and_change_no_other(self, simulated):
        at = simulated.at
        bodies = [means(simulated.array, at, scene_c=each) for each in (0.0, 40.0)]
        shutter = simulated.shutter.copy()
        shutter[3, 2, 3] = np.nan
        shutter[:, 5, 6] = bodies[0][:, 5, 6] = bodies[1][:, 5, 6] = 60000.0
        mask = np.zeros(SHAPE, bool)
        mask[7, 8] = True
        found = bolometer.fit(shutter, *at.T, black_bodies=tuple(bodies), mask=mask)
        unknown, dead = Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE, Flag.DEAD | Flag.DO_NOT_USE
        assert (found.flags[2, 3], found.flags[7, 8]) == (unknown, unknown)
        assert found.flags[5, 6] == dead
        assert np.count_nonzero(found.flags) == 3
        corrected = found.correction(10.0).correct(simulated.array.mean(10.0))
        assert np.isnan(corrected).sum() == 3
        assert np.nanstd(corrected) < LIMIT * simulated.span

    def test_maps_are_blank_where_they_are_flagged(self, simulated):
        mask = np.zeros(SHAPE, bool)
        mask[3, 4] = True
        found = bolometer.fit(simulated.shutter, *simulated.at.T, mask=mask)
        for each in maps_of(found):
            np.testing.assert_array_equal(np.isnan(each.values), mask)

    def test_dead_and_hot_pixels_are_told_by_their_neighbours(self):
        """Towards the edge light is weak: 122 good ones are below half of the mean of all."""
        rows, cols = np.mgrid[-1:1:96j, -1:1:128j]
        light = 1 - 0.35 * (rows**2 + cols**2)
        light[20, 30], light[3, 4], light[30:33, 40:43], light[10, 50] = 0, 0.1, 0.1, 2.5
        array = simulate.BolometerArray.of(light.shape, rng=1)
        at = [0.0, 20.0, 40.0]
        cold, warm = ([array.mean(c, scene_c=scene_c) for c in at] for scene_c in (20.0, 60.0))
        hot = [one + (other - one) * light for one, other in zip(cold, warm, strict=True)]
        shutter = [array.mean(c) for c in at]
        found = bolometer.fit(shutter, at, 2.0, order=1, black_bodies=(cold, hot))
        wanted = np.zeros(light.shape, np.uint32)
        wanted[light <= 0.1] = Flag.DEAD | Flag.DO_NOT_USE
        wanted[10, 50] = Flag.HOT | Flag.DO_NOT_USE
        np.testing.assert_array_equal(found.flags, wanted)

    def test_no_good_pixel_is_refused(self, simulated):
        shutter, mask = np.array(simulated.shutter), np.ones(SHAPE, bool)
        shutter[0, 0, 0], mask[0, 0] = np.nan, False
        with pytest.raises(errors.InputError, match="no pixel with a value at every state"):
            bolometer.fit(shutter, *simulated.at.T, mask=mask)


class TestCorrectionAtAState:
    def test_it_is_a_correction_of_frames(self, simulated, both, tmp_path):
        now = both.correction(12.5, 1.98)
        assert isinstance(now, equipix.Correction)
        assert now.metadata["state"] == {"substrate_c": 12.5, "bias_v": 1.98}
        frame = next(simulated.array.frames(12.5, 1, rng=3, scene_c=30.0, bias_v=1.98))
        corrector = equipix.Corrector(now, "uint16")
        wanted = np.rint(now.correct(frame.astype(np.float64)))
        # Single precision moves some values of 3e4 by 0.004, so a few round otherwise.
        assert np.abs(corrector.apply(frame) - wanted).max() <= 1
        assert np.mean(corrector.apply(frame) != wanted) < 0.02
        now.save(tmp_path / "now.npz")
        again = equipix.load(tmp_path / "now.npz")
        np.testing.assert_array_equal(again.coefficients, now.coefficients)

    def test_the_example_leaves_less_than_the_noise(self, capsys):
        path = Path(__file__).parents[2] / "examples/bolometer.py"
        runpy.run_path(str(path), run_name="__main__")
        *_, frame, noise = capsys.readouterr().out.splitlines()
        before, after = map(float, re.findall(r"(\d+\.\d+) DN", frame))
        temporal, spatial = map(float, re.findall(r"(\d+\.\d+) DN", noise))
        assert before > 1000 * after
        # The mean of 64 frames has an eighth of the temporal noise, references add 0.2 of it.
        assert spatial < np.hypot(1 / 8, 0.2) * temporal
        assert after < np.hypot(1, 0.2) * temporal

    def test_a_gain_after_it_is_refused_since_frames_hold_the_level(self, both):
        now, gain = both.correction(12.5), np.stack([np.zeros(SHAPE), np.full(SHAPE, 1.1)])
        then = equipix.Polynomial(gain, np.zeros(SHAPE, np.uint32))
        with pytest.raises(errors.InputError, match="the gain of 'then' would multiply it"):
            equipix.combine(now, then)

    def test_without_a_bias_it_is_that_in_the_middle_of_the_squares(self, both):
        middle = both.correction(12.5)
        np.testing.assert_array_equal(middle.coefficients, both.correction(12.5, 2.0).coefficients)

    @pytest.mark.parametrize(
        ("state", "message"),
        [
            ((61.0, 2.0), "'substrate_c' is 61 °C, but the references cover -20 to 60 °C"),
            ((20.0, 2.2), "'bias_v' is 2.2 V, but the references cover 1.94936 to 2.04939 V"),
            ((np.nan, 2.0), "'substrate_c' is nan"),
        ],
    )
    def test_states_outside_of_the_references_are_refused(self, both, state, message):
        with pytest.raises(errors.InputError, match=message):
            both.correction(*state)

    def test_extrapolation_must_be_asked_for(self, both):
        assert np.isfinite(both.correction(61.0, 2.2, extrapolate=True).coefficients).all()
        with pytest.raises(errors.InputError, match="'substrate_c' is inf"):
            both.correction(np.inf, extrapolate=True)


class TestFiles:
    @pytest.mark.parametrize("suffix", [".tif", ".npz"])
    @pytest.mark.parametrize("gain", [True, False])
    def test_a_saved_one_is_the_same(self, simulated, both, tmp_path, suffix, gain):
        kept = both if gain else bolometer.fit(simulated.shutter, *simulated.at.T, order=2)
        kept.save(tmp_path / f"kept{suffix}")
        read = equipix.load(tmp_path / f"kept{suffix}")
        assert (read.axes, read.gain_axes, read.metadata) == (
            kept.axes,
            kept.gain_axes,
            kept.metadata,
        )
        for state in ((1.0, 2.0), (44.0, 1.95)):
            one, other = (each.correction(*state).coefficients for each in (kept, read))
            assert one.tobytes() == other.tobytes()
        assert repr(read) == repr(kept)

    def test_in_the_place_of_a_correction_it_says_how_to_get_one(self, both, tmp_path):
        both.save(tmp_path / "kept.tif")
        with pytest.raises(errors.FileError, match="holds a dynamic correction, expected a corr"):
            load_correction(tmp_path / "kept.tif")

    def test_inspect_shows_it(self, both, tmp_path, run):
        both.save(tmp_path / "kept.tif")
        status, out, _ = run("inspect", tmp_path / "kept.tif", "--json")
        assert status == 0
        shown = json.loads(out)
        assert (shown["order"], shown["gain_order"], shown["bias_order"]) == (4, 4, 1)
        assert shown["substrate_c"] == [-20.0, 60.0]

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"version": 3}, "of version 3, this version of equipix reads version 2"),
            ({"kind": "response"}, "is damaged: .* holds offset, .*expected deviation"),
            ({"arrays": {"level": np.ones(1)}}, r"is damaged: array 'level' is .*shape \(1,\)"),
            ({"fields": {"axes": {}}}, "is damaged: 'axes' holds , expected substrate_c, "),
            ({"fields": {"axes.regressor": "3"}}, "is damaged: 'axes.regressor' is '3', expected"),
            ({"fields": {"axes.order": 3}}, "is damaged: 'offset' has shape .*expected"),
        ],
    )
    def test_damaged_files_are_refused(self, both, tmp_path, change, message):
        both.save(tmp_path / "kept.npz")
        rewrite(tmp_path / "kept.npz", **change)
        with pytest.raises(errors.FileError, match=message):
            equipix.load(tmp_path / "kept.npz")


class TestRefusals:
    FRAMES = np.arange(24.0).reshape(4, 2, 3) ** 2
    AT = ([0.0, 10.0, 20.0, 30.0], 2.0)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"substrate_c": [0.0, 10.0]}, "'substrate_c' has 2 entries, expected 4"),
            ({"bias_v": [2.0, 2.0]}, "'bias_v' has 2 entries, expected 4"),
            ({"substrate_c": [0, 1, 2, -300]}, "'substrate_c' holds -300 °C"),
            ({"substrate_c": [0, 1, 2, np.nan]}, "'substrate_c' holds nan °C"),
            ({"substrate_c": [273.15, 283, 293, 303]}, "holds 273.15 °C, .* from kelvin"),
            ({"bias_v": [1, 1, 1, -1]}, "'bias_v' holds -1 V, expected finite volts above 0"),
            ({"order": 4}, "'order' 4 and 'bias_order' 0 have 5 coefficients, but 4 references"),
            ({"bias_order": 1, "order": 1}, "have 4 coefficients, .* 1 biases determine 2"),
            ({"order": 9}, "'order' is 9, expected 0 to 8 or 'auto'"),
            ({"order": "best"}, "'order' is 'best'"),
            ({"bias_order": -1}, "'bias_order' is -1"),
            ({"regressor": "square"}, "'regressor' is 'square'"),
            ({"mask": np.zeros((2, 3))}, "'mask' has dtype float64"),
            ({"mask": np.zeros((3, 3), bool)}, r"'mask' has shape \(3, 3\)"),
            ({"shutter": FRAMES[0]}, r"'shutter' has shape \(2, 3\)"),
            ({"shutter": [FRAMES[0], FRAMES[0][:1]]}, "'shutter' holds arrays of shapes"),
            ({"shutter": equipix.average(FRAMES)}, "'shutter' is one FrameStatistics"),
            (
                {"shutter": np.empty((0, 2, 3))},
                "'shutter' has shape .* expected at least one state",
            ),
            ({"black_bodies": FRAMES}, "'black_bodies' is no pair"),
            ({"black_bodies": (FRAMES, FRAMES[:2])}, r"'hot' has shape \(2, 2, 3\)"),
            (
                {"black_bodies": (FRAMES, FRAMES)},
                r"at state 0 \(states count from 0\) differ by 0 DN",
            ),
        ],
    )
    def test_wrong_references_are_refused(self, given, message):
        celsius, volts = self.AT
        how = {"shutter": self.FRAMES, "substrate_c": celsius, "bias_v": volts} | given
        with pytest.raises(errors.InputError, match=message):
            bolometer.fit(**how)

    def test_two_temperatures_leave_none_to_hold_out(self):
        with pytest.raises(errors.InputError, match=r"\[0.0, 10.0\] °C: give three, or an order"):
            bolometer.fit(self.FRAMES[:2], [0.0, 10.0], 2.0)

    def test_measures_of_nothing_are_refused(self):
        with pytest.raises(errors.InputError, match="'span' is 0"):
            metrics.non_uniformity(self.FRAMES, 0)
        with pytest.raises(errors.InputError, match="no finite value in frame 1"):
            metrics.non_uniformity([[[1.0]], [[np.nan]]], 1.0)


def test_states_that_determine_almost_nothing_are_refused():
    array = simulate.BolometerArray.of(SHAPE, rng=1)
    celsius = [20.0, 20.001, 60.0]
    shutter = [array.mean(each) for each in celsius]
    with pytest.raises(errors.InputError, match="times the noise of a reference"):
        bolometer.fit(shutter, celsius, 2.0, order=2)
    assert bolometer.fit(shutter, celsius, 2.0, order=1).axes.order == 1


def test_auto_takes_no_order_that_states_without_one_do_not_determine():
    """Nine temperatures, each at one of two biases."""
    array = simulate.BolometerArray.of(SHAPE, rng=1)
    celsius = np.linspace(-20, 60, 9)
    volts = np.where(np.arange(9) % 2, 2.05, 1.95)
    shutter = [array.mean(c, bias_v=v) for c, v in zip(celsius, volts, strict=True)]
    correction = bolometer.fit(shutter, celsius, volts)
    assert 1 <= correction.axes.order <= 3


def test_the_noise_of_a_response_is_that_of_both_black_bodies():
    rng, good = np.random.default_rng(1), np.ones((16, 20), bool)
    bodies = [
        references_of(name, [equipix.average(level + sigma * rng.standard_normal((8, 16, 20)))] * 2)
        for name, level, sigma in (("cold", 1000.0, 3.0), ("hot", 1400.0, 6.0))
    ]
    response, variance = response_of(bodies, good)
    wanted = (3**2 + 6**2) / 8 / 400**2
    # Of 320 sample variances of 7 degrees of freedom.
    np.testing.assert_allclose(variance, wanted, rtol=5 * np.sqrt(2 / 320 / 7))
    assert response.var() == pytest.approx(wanted, rel=5 * np.sqrt(2 / 640) * np.sqrt(2))


@pytest.mark.parametrize(("count", "is_dead"), [(1, False), (16, True)])
def test_a_response_is_known_to_the_error_of_the_mean_of_the_states(count, is_dead):
    """A pixel three standard errors of one state below half is dead by six of 16 states."""
    sigma = 1.0
    step = sigma * np.array([1, -1])[:, None, None]  # the variance of the mean of two is sigma²
    error = np.sqrt(2) * sigma / 1000
    response = np.ones(SHAPE)
    response[5, 6] = 0.5 - 3 * error
    levels = (1000 + 0 * response, 1000 + 0 * response, 1000 + 1000 * response)
    shutter, *bodies = (
        references_of("reference", [equipix.average(level + step)] * count) for level in levels
    )
    flags = flags_of(shutter, bodies, None)
    np.testing.assert_array_equal(np.argwhere(flags), [[5, 6]] if is_dead else np.empty((0, 2)))


class TestBodiesOfOtherStates:
    """Black bodies exchanged, or in another order than the shutter."""

    @pytest.fixture
    def series(self):
        array, celsius = BolometerArray.of((16, 20), rng=1), (-20.0, 0.0, 20.0, 40.0, 60.0)
        scenes = (None, 0.0, 40.0)
        return celsius, *([array.mean(t, scene_c=s) for t in celsius] for s in scenes)

    def test_in_their_order_nothing_is_said(self, series):
        celsius, shutter, *bodies = series
        assert bolometer.fit(shutter, celsius, 2.0, black_bodies=tuple(bodies)).findings == ()

    def test_a_hot_one_that_is_darker_is_a_note(self, series):
        celsius, shutter, cold, hot = series
        with pytest.warns(errors.InputWarning, match="'hot' is darker than 'cold' at every state"):
            found = bolometer.fit(shutter, celsius, 2.0, black_bodies=(hot, cold))
        assert [(each.kind, each.severity) for each in found.findings] == [("black_bodies", "note")]
        wanted = bolometer.fit(shutter, celsius, 2.0, black_bodies=(cold, hot))
        np.testing.assert_array_equal(found.gain, wanted.gain)

    def test_one_in_reversed_order_is_refused(self, series):
        celsius, shutter, cold, hot = series
        with pytest.raises(
            errors.InputError,
            match=r"darker by \d+ DN at state 4 \(states count from 0\), expected one",
        ):
            bolometer.fit(shutter, celsius, 2.0, black_bodies=(cold, hot[::-1]))

    def test_both_in_reversed_order_have_the_patterns_of_other_shutters(self, series):
        celsius, shutter, cold, hot = series
        with pytest.warns(
            errors.MisfitWarning, match=r"'shutter' at state 4 \(states count from 0\)"
        ):
            found = bolometer.fit(shutter, celsius, 2.0, black_bodies=(cold[::-1], hot[::-1]))
        assert [each.message[:6] for each in found.findings] == ["'cold'", "'hot' "]

    def test_a_body_as_warm_as_another_substrate_is_no_exchange(self):
        """Of pixels that differ in gain alone it looks like the shutter there."""
        gain = 1 + 0.05 * np.random.default_rng(1).standard_normal((16, 20))
        celsius = np.arange(5) * 20.0
        shutter, cold, hot = ((1e4 + 30 * at) * gain for at in (celsius[:, None, None], 0, 40))
        bodies = tuple(np.stack([each] * 5) for each in (cold, hot))
        assert bolometer.fit(shutter, celsius, 2.0, black_bodies=bodies, order=1).findings == ()


class TestOrderOfFewTemperatures:
    """A plan of cold, room and hot, and what the noise of averages tells."""

    @pytest.fixture
    def array(self):
        return simulate.BolometerArray.of(SHAPE, rng=7)

    @staticmethod
    def left(array, correction, celsius):
        """Spatial noise over the temperatures of the references, in DN."""
        at = np.linspace(min(celsius), max(celsius), 9)
        return np.mean([correction.correction(each).correct(array.mean(each)).std() for each in at])

    @pytest.mark.parametrize(
        "celsius", [(0, 20, 40), (-20, 20, 60), (40, 0, 20), (0, 15, 40), (0, 19.99, 40)]
    )
    def test_three_tell_a_line_from_a_constant(self, array, celsius):
        shutter = [array.mean(each) for each in celsius]
        correction = bolometer.fit(shutter, celsius, 2.0)
        constant, line = correction.metadata["prediction_errors"]
        assert correction.axes.order == 1
        assert line < 0.1 * constant
        static = bolometer.fit(shutter, celsius, 2.0, order=0)
        assert self.left(array, correction, celsius) < 0.2 * self.left(array, static, celsius)

    def test_pixels_of_one_offset_need_no_line(self):
        rng = np.random.default_rng(3)
        offset = 1e4 + 100 * rng.standard_normal(SHAPE)
        averages = [equipix.average(offset + rng.standard_normal((16, *SHAPE))) for _ in range(3)]
        assert bolometer.fit(averages, [0, 20, 40], 2.0).axes.order == 0

    def test_near_temperatures_are_held_out_together(self, array):
        """Else that beside a neighbour is predicted by it, with any order."""
        celsius = [0, 20, 20.1, 40]
        shutter = [array.mean(each) for each in celsius]
        correction = bolometer.fit(shutter, celsius, 2.0)
        assert len(correction.metadata["prediction_errors"]) == 2
        assert correction.axes.order == 1
        with pytest.raises(errors.InputError, match=r"\[0.0, 40.0\] °C: give three"):
            bolometer.fit(shutter[::3] * 2, [0, 40, 0.3, 40.2], 2.0)

    def averages(self, array, celsius):
        return [equipix.average(array.frames(t, 64, rng=k)) for k, t in enumerate(celsius)]

    @pytest.mark.parametrize("count", [3, 4, 6, 8])
    def test_too_few_are_told_where_the_noise_is_known(self, array, count):
        celsius = np.linspace(-20, 60, count)
        averages = self.averages(array, celsius)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            correction = bolometer.fit(averages, celsius, 2.0)
        noise = np.sqrt(np.mean(array.temporal_noise(20.0) ** 2))
        # The prediction warns at five times noise that is an eighth of a frame's.
        assert bool(caught) == (self.left(array, correction, celsius) > noise)
        for each in caught:
            assert issubclass(each.category, errors.MisfitWarning)
            assert "take references at more temperatures" in str(each.message)

    def test_temperatures_of_other_references_are_told(self, array):
        celsius, shuffled = [-20, 0, 20, 40, 60], [20, -20, 60, 0, 40]
        averages = self.averages(array, celsius)
        for given, message in (
            (averages, "times the error that noise explains"),
            ([each.mean for each in averages], "'substrate_c' explains nothing"),
        ):
            with pytest.warns(errors.MisfitWarning, match=message):
                assert bolometer.fit(given, shuffled, 2.0).axes.order == 0
        with pytest.warns(errors.MisfitWarning, match="all of 'substrate_c' is 20 °C"):
            bolometer.fit(averages, [20.0] * 5, 2.0)
        bolometer.fit(self.averages(array, [20.0] * 5), [20.0] * 5, 2.0)  # warnings are errors

    @pytest.mark.parametrize("pair", [(2, 3), (2, 4), (0, 1), (1, 6)])
    @pytest.mark.parametrize("order", ["auto", 3])
    def test_two_exchanged_temperatures_are_told(self, array, pair, order):
        celsius = np.linspace(-20, 70, 7)
        averages = self.averages(array, celsius)
        exchanged = celsius.copy()
        exchanged[[*pair]] = celsius[[*reversed(pair)]]
        for given in (averages, [each.mean for each in averages]):
            bolometer.fit(given, celsius, 2.0, order=order)  # warnings are errors
            # Exchanged with the highest one, a temperature may leave the others no order above 0.
            told = "turns back .* none are exchanged|'substrate_c' explains nothing"
            with pytest.warns(errors.MisfitWarning, match=told):
                bolometer.fit(given, exchanged, 2.0, order=order)


def test_a_response_that_crosses_0_is_flagged_where_it_does():
    """Its gain has no limit there: it was -591 to 329, unflagged."""
    celsius = np.array([-20.0, 0, 20, 40, 60])
    response = np.ones((5, 3, 4))
    response[:, 1, 2] = (celsius - 30) / 50 + 1.0
    level = 30_000 + celsius[:, None, None]
    bodies = (level - 500 * response, level + 500 * response)
    found = bolometer.fit(level + 0 * response, celsius, 2.0, black_bodies=bodies, order=1)
    for state, flagged in ((-20.0, True), (0.0, True), (20.0, False), (60.0, False)):
        here = found.correction(state)
        expected = Flag.DEAD | Flag.DO_NOT_USE if flagged else 0
        assert here.flags[1, 2] == expected, state
        assert not np.delete(here.flags.ravel(), 6).any()
    assert not found.flags.any()


class TestSaturatedReferences:
    SATURATED = Flag.SATURATED | Flag.DO_NOT_USE

    def frames(self):
        frames = np.random.default_rng(1).integers(20_000, 20_100, (5, *SHAPE), dtype=np.uint16)
        frames += (100 * np.arange(5, dtype=np.uint16))[:, None, None]
        return frames

    @pytest.mark.parametrize("of", [list, np.stack])
    def test_whole_numbers_at_the_top_of_their_type_are_flagged(self, of):
        shutter = self.frames()
        shutter[4, 2, 3] = shutter[:, 5, 6] = 65535
        cold, hot = shutter + np.uint16(0), np.minimum(shutter, 60_000) + np.uint16(5000)
        hot[1, 7, 8] = 65535
        how = {"order": 1, "black_bodies": (of(list(cold)), of(list(hot)))}
        found = bolometer.fit(of(list(shutter)), [0, 10, 20, 30, 40], 2.0, **how)
        wanted = np.zeros(SHAPE, np.uint32)
        wanted[2, 3] = wanted[5, 6] = wanted[7, 8] = self.SATURATED
        np.testing.assert_array_equal(found.flags, wanted)
        assert np.isnan(found.correction(20.0).correct(shutter[2].astype(float))).sum() == 3

    def test_one_saturated_sample_of_an_average_flags_the_pixel(self):
        stacks = np.repeat(self.frames()[:, None], 3, axis=1)
        stacks[1, 2, 4, 5] = 65535
        averages = [equipix.average(each) for each in stacks]
        found = bolometer.fit(averages, [0, 10, 20, 30, 40], 2.0, order=1)
        assert found.flags[4, 5] == self.SATURATED
        assert np.count_nonzero(found.flags) == 1

    def test_many_values_at_the_highest_one_are_told(self):
        shutter = self.frames().astype(float)
        shutter[3, :4] = 65535.0
        with pytest.warns(
            errors.InputWarning,
            match=r"128 values of 'shutter' at state 3 \(states count from 0\) are",
        ):
            bolometer.fit(shutter, [0, 10, 20, 30, 40], 2.0, order=1)

    def test_nothing_else_than_saturated_pixels_is_refused(self):
        with pytest.raises(errors.InputError, match="reach the saturation level of 255"):
            bolometer.fit(np.full((2, *SHAPE), 255, np.uint8), [0, 40], 2.0, order=1)


def test_the_mask_of_clipped_values_ends_the_warning():
    array = simulate.BolometerArray.of((24, 32), rng=1)
    frames = [array.mean(each) for each in (-20, 0, 20, 40, 60)]
    level = np.quantile(frames[4], 0.9)
    clipped = frames[4] >= level
    frames[4] = np.minimum(frames[4], level)
    with pytest.warns(errors.InputWarning, match="exclude their pixels by 'mask'"):
        bolometer.fit(frames, [-20, 0, 20, 40, 60], NOMINAL, order=3)
    correction = bolometer.fit(frames, [-20, 0, 20, 40, 60], NOMINAL, order=3, mask=clipped)
    np.testing.assert_array_equal((correction.flags & Flag.DO_NOT_USE) == 0, ~clipped)


def test_averages_beside_whole_numbers_leave_saturation_in_sight():
    array = simulate.BolometerArray.of((24, 32), rng=1)
    frames = [np.rint(array.mean(each)).astype(np.uint16) for each in (-20, 0, 20, 40, 60)]
    frames[4][3, 5] = 65535
    mixed = [equipix.average(np.stack([frames[0]] * 2)), *frames[1:]]
    correction = bolometer.fit(mixed, [-20, 0, 20, 40, 60], NOMINAL, order=3)
    assert correction.flags[3, 5] & Flag.SATURATED


def test_states_that_determine_one_order_alone_say_so():
    array = simulate.BolometerArray.of((24, 32), rng=1)
    celsius, volts = [0, 20, 40, 0, 40], [2.0, 2.0, 2.0, 2.05, 2.05]
    frames = [array.mean(c, bias_v=v) for c, v in zip(celsius, volts, strict=True)]
    with pytest.warns(errors.MisfitWarning, match="determine no order above 0"):
        bolometer.fit(frames, celsius, volts)
