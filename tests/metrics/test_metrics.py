"""Quality of frames: simulations with known components, laws, and a real camera."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

import equipix
from equipix import errors, metrics, nuc
from equipix.io.frames import read_frames
from equipix.metrics.correctability import fisher_quantile
from equipix.metrics.emva import high_passed, split_variances
from equipix.metrics.frame_noise import Moments, temporal_of
from equipix.simulate import StaringArray

SHAPE = (48, 64)
EPS = np.finfo(np.float64).eps


def frames_of(rng, count=16, spatial=0.0, temporal=1.0, shape=SHAPE):
    pattern = spatial * rng.standard_normal(shape)
    return 1000 + pattern + temporal * rng.standard_normal((count, *shape))


class TestTemporal:
    """The one computation of temporal noise, one frame at a time."""

    @pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
    def test_it_is_that_of_the_whole_stack(self, dtype):
        rng = np.random.default_rng(20)
        stack = rng.integers(20, 200, (12, *SHAPE)).astype(dtype)
        mask = rng.random(SHAPE) < 0.1
        found = temporal_of(stack, mask)
        whole = stack.astype(np.float64)
        free = whole - whole[:, ~mask].mean(axis=1)[:, None, None]
        # Sums of 12 squares of up to 180: some roundings of each.
        atol = 100 * EPS * 180**2
        np.testing.assert_allclose(found.variance, free.var(axis=0, ddof=1), rtol=0, atol=atol)
        np.testing.assert_allclose(found.mean, whole.mean(axis=0), rtol=0, atol=atol)
        steps = np.sum(np.diff(free, axis=0) ** 2, axis=0)
        np.testing.assert_allclose(found.steps, steps, rtol=0, atol=12 * atol)

    def test_a_missing_sample_stays_in_its_pixel(self):
        stack = frames_of(np.random.default_rng(21))
        stack[3, 5, 6] = np.inf
        found = temporal_of(stack)
        for each in (found.variance, found.mean):
            assert np.argwhere(~np.isfinite(each)).tolist() == [[5, 6]]
        assert np.argwhere(~found.used).tolist() == [[5, 6]]

    @pytest.mark.parametrize("metric", [metrics.correctability, metrics.three_d_noise])
    def test_the_stack_is_not_copied(self, metric):
        stack = np.random.default_rng(22).integers(0, 99, (200, 100, 128), dtype=np.uint16)
        tracemalloc.start()
        metric(stack)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        # As float64 the stack would take 200 frames; the sums are some frames.
        assert peak < 20 * 100 * 128 * 8

    @pytest.mark.parametrize("metric", [metrics.correctability, metrics.three_d_noise])
    def test_too_little_memory_is_named(self, metric):
        huge = np.broadcast_to(np.uint16(1), (2, 10**7, 10**7))
        with pytest.raises(errors.InsufficientMemoryError, match="Unable to allocate"):
            metric(huge)


class TestCorrectability:
    @pytest.mark.parametrize("ratio", [0.0, 0.3, 1.0, 3.0])
    def test_it_finds_a_known_ratio_without_bias(self, ratio):
        rng = np.random.default_rng(1)
        squares = []
        for _ in range(40):
            found = metrics.correctability(frames_of(rng, spatial=2 * ratio, temporal=2.0))
            squares.append(np.sign(found.ratio) * found.ratio**2)
        # Of one estimate of C²: (C² + 1/n)·√(2/N), by the spread of s².
        error = (ratio**2 + 1 / 16) * np.sqrt(2 / 3072) / np.sqrt(40)
        assert np.mean(squares) == pytest.approx(ratio**2, abs=4 * error)

    @pytest.mark.parametrize("ratio", [0.0, 0.5])
    def test_the_interval_covers_as_often_as_it_says(self, ratio):
        rng = np.random.default_rng(2)
        inside = 0
        for _ in range(400):
            stack = frames_of(rng, count=4, spatial=ratio, shape=(12, 15))
            found = metrics.correctability(stack, confidence=0.9)
            inside += found.low <= ratio <= found.high
        # 400 draws of 90 %: five standard errors.
        assert inside / 400 == pytest.approx(0.9, abs=5 * np.sqrt(0.09 / 400))

    @pytest.mark.study
    @pytest.mark.parametrize("lines", ["columns", "rows", "columns and pixels"])
    def test_the_interval_covers_a_pattern_of_lines(self, lines, draws, figure):
        seeds, inside = draws(300), 0
        for seed in seeds:
            rng = np.random.default_rng(seed)
            pattern = {
                "columns": np.ones((24, 1)) * rng.standard_normal(32),
                "rows": np.ones(32) * rng.standard_normal((24, 1)),
                "columns and pixels": (rng.standard_normal((24, 32)) + rng.standard_normal(32))
                / np.sqrt(2),
            }[lines]
            stack = 0.5 * pattern + rng.standard_normal((8, 24, 32))
            found = metrics.correctability(stack)
            inside += found.low <= 0.5 <= found.high
        covered = inside / len(seeds)
        figure(f"share of 95 % intervals of C that cover it, {lines}", covered, "0.92 to 0.96")
        error = 3 * np.sqrt(0.95 * 0.05 / len(seeds))
        assert 0.92 - error <= covered <= 0.96 + error

    def test_frames_along_the_last_axis_are_noticed(self):
        rng = np.random.default_rng(5)
        stack = frames_of(rng, spatial=0.3)
        assert stack.shape[0] < min(SHAPE)
        with pytest.warns(errors.EquipixWarning, match=r"moveaxis\(frames, -1, 0\)"):
            metrics.correctability(np.moveaxis(stack, 0, -1))
        # Many frames of narrow arrays are none such.
        assert metrics.correctability(frames_of(rng, count=100, shape=(40, 12))).ratio < 1

    def test_drift_of_the_frame_mean_does_not_count(self):
        stack = frames_of(np.random.default_rng(3), spatial=0.5)
        plain = metrics.correctability(stack)
        with pytest.warns(errors.MisfitWarning, match="scatter by 159 DN, the noise of a pixel is"):
            drifting = metrics.correctability(stack + np.linspace(0, 500, 16)[:, None, None])
        assert drifting.ratio == pytest.approx(plain.ratio, rel=1e-9)
        assert metrics.correctability(7 * stack).ratio == pytest.approx(plain.ratio, rel=1e-9)

    def test_bad_pixels_are_left_out(self):
        stack = frames_of(np.random.default_rng(4), spatial=0.5)
        plain = metrics.correctability(stack)
        stack[:, 3, 4] += 500
        assert metrics.correctability(stack).ratio > 5 * plain.ratio
        mask = np.zeros(SHAPE, bool)
        mask[3, 4] = True
        masked = metrics.correctability(stack, mask=mask)
        stack[2, 3, 4] = np.nan
        assert metrics.correctability(stack) == masked
        assert masked.pixels == 48 * 64 - 1
        assert masked.ratio == pytest.approx(plain.ratio, rel=0.01)

    def test_a_negative_variance_stays_signed(self):
        found = [
            metrics.correctability(frames_of(np.random.default_rng(seed))).ratio
            for seed in range(20)
        ]
        assert min(found) < 0 < max(found)
        assert np.isfinite(found).all()

    @pytest.mark.parametrize(
        ("probability", "degrees", "quantile", "error"),
        [
            (0.975, (10, 20), 2.7737, 0.01),
            (0.025, (10, 20), 0.29252, 0.01),
            (0.95, (30, 60), 1.64914, 1e-3),
            (0.975, (120, 1000), 1.28978, 1e-4),
            (0.025, (1000, 15000), 0.911751, 1e-5),
        ],
    )
    def test_quantiles_are_those_of_the_tables(self, probability, degrees, quantile, error):
        # The error of Paulson's approximation falls as the square of the degrees of freedom.
        assert fisher_quantile(probability, *degrees) == pytest.approx(quantile, rel=error)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"frames": np.ones((1, 4, 4))}, "expected two or more frames"),
            ({"frames": np.ones((4, 4))}, "expected 3 dimensions"),
            ({"frames": np.ones((3, 4, 4))}, "are all equal"),
            ({"frames": np.full((3, 4, 4), np.nan)}, "has 0 pixels"),
            ({"frames": np.eye(4)[None] * [[[1]], [[2]]], "confidence": 1.0}, "'confidence'"),
            ({"frames": np.ones((3, 4, 4)), "mask": np.ones((2, 2), bool)}, "'mask' has shape"),
        ],
    )
    def test_refusals(self, given, message):
        with pytest.raises(errors.InputError, match=message):
            metrics.correctability(**given)


class TestValidityInterval:
    def test_it_ends_where_the_ratio_exceeds_one(self):
        assert metrics.validity_interval([0, 1, 3], [0.5, 0.9, 1.1]) == pytest.approx(2)
        assert metrics.validity_interval([0, 1], [0.5, 1.0]) == np.inf
        assert metrics.validity_interval([2, 4], [1.5, 0.5]) == 2

    @pytest.mark.parametrize(
        ("times", "ratios"), [([0, 1], [1.0]), ([], []), ([1, 0], [1, 2]), ([0, 1], [1, np.nan])]
    )
    def test_refusals(self, times, ratios):
        with pytest.raises(errors.InputError, match="'ratios'"):
            metrics.validity_interval(times, ratios)

    def test_drifting_pixels_shorten_it(self):
        """The source blames bad pixels: with them the interval ends earlier than without."""
        rng = np.random.default_rng(5)
        drift = np.full(SHAPE, 0.02)
        drift.flat[rng.choice(48 * 64, 15, replace=False)] = 2.0
        direction = rng.standard_normal(SHAPE)
        times = np.arange(0, 80, 10.0)
        ratios = {"all": [], "good": []}
        for time in times:
            stack = frames_of(rng, spatial=0.0) + time * drift * direction
            ratios["all"].append(metrics.correctability(stack).ratio)
            ratios["good"].append(metrics.correctability(stack, mask=drift > 1).ratio)
        every, good = (metrics.validity_interval(times, ratios[name]) for name in ("all", "good"))
        # C of this pattern is t times its spread. Its square has a standard error of √(2/3072)
        # where it is 1, half of it in C; as much again where the line between two times begins.
        error = 5 * np.sqrt(2 / 3072)
        assert every == pytest.approx(1 / np.std(drift * direction), rel=error)
        assert good == pytest.approx(1 / np.std((drift * direction)[drift < 1]), rel=error)
        assert every < 0.2 * good

    def test_of_a_simulated_array_it_follows_the_drift(self):
        """C at each time is that of the array's means without noise, corrected by the curves."""
        array = StaringArray.of("HgCdTe", SHAPE, rng=2)
        levels = [
            equipix.average(array.frames(light, 64, rng=k, time_s=0.0))
            for k, light in enumerate(np.linspace(2e6, 14e6, 5))
        ]
        response, times = nuc.fit(levels, order=2), (10.0, 1e3, 1e5)
        ratios = []
        for time in times:
            frames = np.stack(list(array.frames(8e6, 24, rng=99, time_s=time)))
            found = metrics.correctability(response.correct(frames))
            left = response.correct(array.mean(8e6, time_s=time)).var(ddof=1)
            # Of a fixed pattern: the noise of the mean image alone, and its product with both.
            noise = found.temporal_variance / 24
            error = np.sqrt((2 * noise**2 + 4 * noise * left) / found.pixels)
            assert found.spatial_variance == pytest.approx(left, abs=5 * error)
            ratios.append(found.ratio)
        assert ratios == sorted(ratios)
        assert times[0] < metrics.validity_interval(times, ratios) < times[-1]


SIZES = (40, 60, 80)
TRUTH = {"t": 2.0, "v": 1.5, "h": 1.0, "tv": 0.8, "th": 0.6, "vh": 0.4, "tvh": 0.3}
AXES = {"t": 0, "v": 1, "h": 2}


class TestThreeDNoise:
    def drawn(self, rng, truth):
        total = np.full(SIZES, 100.0)
        for name, sigma in truth.items():
            axes = {AXES[letter] for letter in name}
            shape = [size if axis in axes else 1 for axis, size in enumerate(SIZES)]
            total += sigma * rng.standard_normal(shape)
        return total

    def test_known_components_come_back_without_bias(self):
        rng = np.random.default_rng(6)
        found = [metrics.three_d_noise(self.drawn(rng, TRUTH)) for _ in range(30)]
        for name, sigma in TRUTH.items():
            values = [getattr(each, name) for each in found]
            error = np.std(values, ddof=1) / np.sqrt(30)
            assert np.mean(values) == pytest.approx(sigma**2, abs=4 * error), name

    @pytest.mark.parametrize("name", ["t", "v", "h", "tv", "th", "vh", "tvh"])
    def test_one_component_alone_shows_in_no_other(self, name):
        found = metrics.three_d_noise(self.drawn(np.random.default_rng(7), {name: 1.0}))
        degrees = np.prod([SIZES[AXES[letter]] - 1 for letter in name])
        assert getattr(found, name) == pytest.approx(1, abs=5 * np.sqrt(2 / degrees))
        others = [getattr(found, other) for other in TRUTH if other != name]
        # The noise of a mean square of a lower component, at most that of tvh over 40.
        assert np.abs(others).max() < 0.01
        assert found.total == pytest.approx(getattr(found, name), abs=0.05)

    def test_transposed_frames_exchange_rows_and_columns(self):
        stack = self.drawn(np.random.default_rng(8), TRUTH)
        found = metrics.three_d_noise(stack)
        turned = metrics.three_d_noise(stack.transpose(0, 2, 1))
        pairs = (("v", "h"), ("tv", "th"), ("t", "t"), ("vh", "vh"), ("tvh", "tvh"))
        for one, other in pairs:
            assert getattr(turned, one) == pytest.approx(getattr(found, other), rel=1e-9)

    def test_refusals(self):
        with pytest.raises(errors.InputError, match="two or more along each axis"):
            metrics.three_d_noise(np.ones((3, 1, 5)))
        bad = np.ones((3, 4, 5))
        bad[0, 0, 0] = np.nan
        with pytest.raises(errors.InputError, match="1 values that are not finite"):
            metrics.three_d_noise(bad)


class TestEmvaSpatial:
    def test_known_parts_come_back(self):
        rng = np.random.default_rng(9)
        shape, sigmas = (150, 200), {"row": 0.004, "column": 0.006, "pixel": 0.01}
        estimates = []
        for _ in range(20):
            pattern = 1 + sigmas["row"] * rng.standard_normal((150, 1))
            pattern = pattern + sigmas["column"] * rng.standard_normal((1, 200))
            pattern = pattern + sigmas["pixel"] * rng.standard_normal(shape)
            dark = 50 + 0.8 * rng.standard_normal(shape)
            off, on = (
                base + rng.standard_normal((8, *shape)) * 3 for base in (dark, dark + 800 * pattern)
            )
            found = metrics.emva_spatial(on, off, gain_dn_per_e=0.25, highpass=False)
            estimates.append([*(np.array(found.prnu) ** 2), found.dsnu.total**2])
        wanted = [sum(each**2 for each in sigmas.values()), *(each**2 for each in sigmas.values())]
        wanted = [*wanted, (0.8 / 0.25) ** 2]
        mean, error = np.mean(estimates, axis=0), np.std(estimates, axis=0, ddof=1) / np.sqrt(20)
        np.testing.assert_array_less(np.abs(mean - wanted), 4 * error)

    def test_the_bias_of_the_parts_is_that_which_is_stated(self):
        rng = np.random.default_rng(16)
        rows, cols, (r, c, p) = 30, 40, (1.0, 0.3, 0.01)
        found = []
        for _ in range(400):
            image = np.sqrt(r) * rng.standard_normal((rows, 1))
            image = image + np.sqrt(c) * rng.standard_normal((1, cols))
            image = image + np.sqrt(p) * rng.standard_normal((rows, cols))
            found.append(split_variances(Moments(image, 0.0, 2)))
        size, rest = rows * cols, rows * cols - rows - cols
        bias = size * (r * (cols - 1) + c * (rows - 1)) / (rest * (size - 1))
        assert bias == pytest.approx(r / rows + c / cols, rel=0.1)
        mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(400)
        wanted = [r + c / cols**2, c + r / rows**2, p - bias]
        np.testing.assert_array_less(np.abs(mean[1:] - wanted), 4 * error[1:])
        assert mean[3] < -20 * error[3]

    def test_the_high_pass_removes_what_is_smooth_and_keeps_pixels(self):
        rows, cols = np.mgrid[:60, :80]
        smooth = 100 + 0.3 * rows - 0.2 * cols
        # Inside, a line is its own mean; near a border the reflection bends it.
        inside = (slice(10, -10), slice(10, -10))
        assert np.abs(high_passed(smooth)[inside]).max() < 1e-10
        point = np.zeros((61, 61))
        point[30, 30] = 1
        filtered = high_passed(point)
        assert filtered.sum() == pytest.approx(0, abs=1e-12)
        assert filtered[30, 30] == pytest.approx(1 - 1 / 121)
        assert np.sum(filtered**2) == pytest.approx(1 - 0.0115, abs=5e-5)

    def test_the_high_pass_is_the_same_in_bands_of_any_size(self):
        image = np.random.default_rng(1).random((40, 9000))
        whole = high_passed(image)  # bands of 36 of 40 rows, and of 6553 of 9000
        np.testing.assert_allclose(whole, high_passed(image.T).T, atol=1e-13)
        assert high_passed(image.astype(np.float32)).dtype == np.float32

    def test_averages_give_the_same_as_frames(self):
        rng = np.random.default_rng(10)
        dark = rng.integers(40, 60, (8, *SHAPE), dtype=np.uint16)
        bright = rng.integers(900, 1100, (8, *SHAPE), dtype=np.uint16)
        of_frames = metrics.emva_spatial(bright, dark)
        averages = [equipix.average(each) for each in (bright, dark)]
        of_averages = metrics.emva_spatial(*averages)
        # Here the means of the frames scatter by the noise over √3072 alone.
        np.testing.assert_allclose(of_averages.prnu, of_frames.prnu, rtol=0.01)

    def test_no_light_and_other_shapes_are_refused(self):
        dark = np.random.default_rng(1).random((4, 8, 9))
        with pytest.raises(errors.InputError, match="expected more light"):
            metrics.emva_spatial(dark, dark)
        with pytest.raises(errors.InputError, match="'frames' are of"):
            metrics.emva_spatial(dark[:, :4], dark)
        with pytest.raises(errors.InputError, match="two or more rows and columns, above 2 x 2"):
            metrics.emva_spatial(dark[:, :2, :2] + 9, dark[:, :2, :2])
        with pytest.raises(errors.InputError, match="1 values that are not finite"):
            metrics.emva_spatial(np.where(dark == dark.max(), np.nan, dark + 9), dark)
        with pytest.raises(errors.InputError, match="'gain_dn_per_e' is 0"):
            metrics.emva_spatial(dark + 9, dark, gain_dn_per_e=0)
        average = equipix.average(dark + 1, dark=equipix.average(dark))
        with pytest.raises(errors.InputError, match="already subtracted"):
            metrics.emva_spatial(average, dark)


class TestEmvaTransfer:
    def levels(self, rng, gain=0.25, read=8.0, curvature=0.0):
        light = np.linspace(500, 19500, 20)
        electrons = 0.5 * light * (1 - curvature * light / 20000)
        dark = [50 + gain * read * rng.standard_normal((2, *SHAPE)) for _ in light]
        bright = []
        for mean in electrons:
            photons = mean + np.sqrt(mean) * rng.standard_normal((2, *SHAPE))
            noise = gain * read * rng.standard_normal((2, *SHAPE))
            bright.append(np.rint(50 + np.minimum(gain * photons + noise, gain * 9500)))
        return bright, [np.rint(each) for each in dark], light

    def test_known_values_come_back(self):
        found = metrics.emva_transfer(*self.levels(np.random.default_rng(11)))
        # A variance of 3072 pixels has 2.6 %; 13 levels up to 70 % average it.
        assert found.gain_dn_per_e == pytest.approx(0.25, rel=5 * 0.026 / np.sqrt(13))
        assert found.responsivity == pytest.approx(0.125, rel=1e-3)
        assert found.quantum_efficiency == pytest.approx(0.5, rel=5 * 0.026 / np.sqrt(13))
        # The variance of 20 darks of 3072 pixels, halved in the root, over the gain.
        error = np.hypot(np.sqrt(2 / (20 * 3072)) / 2, 0.026 / np.sqrt(13))
        assert found.read_noise_e == pytest.approx(8, rel=5 * error)
        assert found.linearity_error < 1e-3

    def test_a_curved_response_has_a_linearity_error(self):
        straight = metrics.emva_transfer(*self.levels(np.random.default_rng(12)))
        curved = metrics.emva_transfer(*self.levels(np.random.default_rng(12), curvature=0.05))
        # The parabola itself, and its line of least relative deviations by another routine.
        light = np.linspace(500, 19500, 20)
        signal = 0.125 * light * (1 - 0.05 * light / 20000)
        share = signal / curved.saturation_dn
        used = (share >= 0.05) & (share <= 0.95)
        slope, offset = np.polyfit(light[used], signal[used], 1, w=1 / signal[used])
        line = offset + slope * light[used]
        wanted = np.mean(np.abs(signal[used] - line) / line)
        # The relative error of each level, of 6144 values and as many darks: five of their mean.
        errors_of = np.sqrt((0.25 * signal[used] + 2 * 4) / 6144) / signal[used]
        error = 5 * np.sqrt(np.sum(errors_of**2)) / used.sum()
        assert error < wanted / 20
        assert curved.linearity_error == pytest.approx(wanted, abs=error)
        assert straight.linearity_error < wanted / 5

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda light: np.where(light > 9000, np.nan, light), "'light' holds nan"),
            (lambda light: -light, "'light' holds -500"),
            (lambda light: 0 * light, "'light' is 0 at all levels"),
            (lambda light: 0 * light + 7, "'light' is 7 at all levels"),
            (
                lambda light: np.where(light < 15000, 0, light),
                "'light' is 0 at all levels up to 70",
            ),
        ],
    )
    def test_light_that_gives_no_line_is_refused(self, change, message):
        bright, dark, light = self.levels(np.random.default_rng(15))
        with pytest.raises(errors.InputError, match=message):
            metrics.emva_transfer(bright, dark, change(light))

    @pytest.mark.parametrize(
        "change",
        [lambda light: light[::-1], lambda light: np.where(light > 9000, 20_000 - light, light)],
    )
    def test_light_that_falls_where_the_signal_rises_is_refused(self, change):
        bright, dark, light = self.levels(np.random.default_rng(11))
        with pytest.raises(
            errors.InputError, match=r"'light' is .* at level .* one value for each"
        ):
            metrics.emva_transfer(bright, dark, change(light))

    @pytest.mark.parametrize("last", [False, True])
    def test_dark_frames_in_place_of_a_bright_level_are_refused(self, last):
        bright, dark, light = self.levels(np.random.default_rng(11))
        at = len(bright) - 1 if last else len(bright) // 2
        bright = [*bright[:at], dark[at], *bright[at + 1 :]]
        with pytest.raises(
            errors.InputError, match=rf"at level {at}, .* and frames with light at level {at}"
        ):
            metrics.emva_transfer(bright, dark, light)

    def test_the_high_pass_takes_a_part_of_a_white_pattern(self):
        """What docs/camera.md states: the root of the sum of the squares of the filter."""
        point = np.zeros((41, 41))
        point[20, 20] = 1.0
        kept = float(np.sqrt(np.sum(high_passed(point) ** 2)))
        power = np.abs(np.fft.fft2(high_passed(point))) ** 2  # of mean kept²
        assert kept == pytest.approx(0.99423, abs=5e-6)
        rng = np.random.default_rng(1)
        pattern = 1000 * (1 + 0.01 * rng.standard_normal((200, 300)))
        dark = 50 + rng.standard_normal((4, 200, 300))
        found, plain = (
            metrics.emva_spatial(dark[::-1] + pattern, dark, highpass=each).prnu.total
            for each in (True, False)
        )
        # The ratio squared is the mean of the filter's power, weighted by that of the pattern: of
        # 60 000 values at 30 000 frequencies, each with a standard deviation of its own mean.
        scatter = power.std() / np.sqrt(30_000) / (2 * kept)
        assert found / plain == pytest.approx(kept, abs=5 * scatter)

    def test_darks_that_are_brighter_than_most_levels_are_named(self):
        rng = np.random.default_rng(1)
        light = [10.0, 20, 30, 400]
        frames = [rng.normal(each, 2, (2, 20, 30)) for each in light]
        darks = [rng.normal(100.0, 2, (2, 20, 30)) for _ in light]
        with pytest.raises(errors.InputError, match="0 levels .*3 of 4 are darker than their dark"):
            metrics.emva_transfer(frames, darks, light)

    def test_exchanged_darks_are_refused(self):
        bright, dark, light = self.levels(np.random.default_rng(11))
        with pytest.raises(errors.InputError, match="no level is brighter .* not exchanged"):
            metrics.emva_transfer(dark, bright, light)

    def test_light_in_another_unit_gives_no_quantum_efficiency(self):
        bright, dark, light = self.levels(np.random.default_rng(11))
        with pytest.warns(errors.EquipixWarning, match=r"efficiency of 50.* .*limit 1\.1.*photons"):
            found = metrics.emva_transfer(bright, dark, light / 1000)
        assert np.isnan(found.quantum_efficiency)
        assert found.responsivity == pytest.approx(125, rel=1e-3)

    def test_counts_that_do_not_fit_are_refused(self):
        bright, dark, light = self.levels(np.random.default_rng(13))
        with pytest.raises(errors.InputError, match="'frames' has 19 levels, 'dark' .* one 'dark'"):
            metrics.emva_transfer(bright[:19], dark, light)
        with pytest.raises(errors.InputError, match="expected three or more"):
            metrics.emva_transfer(bright[:2], dark[:2], light[:2])


class TestFrames:
    def test_netd_of_known_noise(self):
        rng = np.random.default_rng(14)
        cold, hot = (level + 2 * rng.standard_normal((64, *SHAPE)) for level in (1000, 1100))
        found = metrics.netd(cold, hot, delta_k=5.0)
        # 3072 medians of a value with a relative error of 1/√252.
        assert np.median(found) == pytest.approx(0.1, rel=0.01)
        drifting = hot + np.linspace(-30, 30, 64)[:, None, None]
        assert np.median(metrics.netd(cold, drifting, 5.0)) == pytest.approx(0.1, rel=0.01)
        hot[:, 5, 6] = cold[:, 5, 6] = 1000
        assert metrics.netd(cold, hot, 5.0)[5, 6] == np.inf

    def test_a_value_that_is_none_stays_in_its_pixel(self):
        rng = np.random.default_rng(14)
        cold, hot = (level + 2 * rng.standard_normal((16, *SHAPE)) for level in (1000, 1100))
        cold[3, 5, 6] = np.nan
        found = metrics.netd(cold, hot, delta_k=5.0)
        assert np.argwhere(~np.isfinite(found)).tolist() == [[5, 6]]

    @pytest.mark.parametrize("count", [2, 3, 4, 8])
    def test_the_median_netd_of_few_frames_is_that_of_the_noise(self, count):
        rng = np.random.default_rng(15)
        cold, hot = (level + 2 * rng.standard_normal((count, 200, 300)) for level in (1000, 1e9))
        found = np.median(metrics.netd(cold, hot, 1e9 - 1000))
        # Wilson and Hilferty's median is 1.4 % too large with two degrees of freedom, 0.4 % with
        # four; a median of 60 000 scatters by 0.4 %.
        assert found == pytest.approx(2, rel=0.008 + 3 * 1.25 / np.sqrt(4 * (count - 1) * 60_000))
        assert np.array_equal(metrics.netd(hot, cold, 5.0), metrics.netd(cold, hot, 5.0))

    def test_netd_refusals(self):
        cold = np.random.default_rng(1).random((3, 4, 5))
        with pytest.raises(errors.InputError, match="'delta_k' is 0"):
            metrics.netd(cold, cold, 0)
        with pytest.raises(errors.InputError, match="'hot' has shape"):
            metrics.netd(cold, cold[:, :2], 1)
        for hot in (cold, cold[::-1], cold + 1e-3):
            with pytest.raises(
                errors.InputError, match=r"'hot' .* 'cold' by .* no more than noise"
            ):
                metrics.netd(cold, hot, 10)
        dark = np.full_like(cold, 3.0)
        with pytest.raises(errors.InputError, match="'hot' differs from 'cold' by 0 DN"):
            metrics.netd(dark, dark, 10)

    def test_roughness_by_hand(self):
        frame = [[1.0, 2.0, 4.0], [1.0, 1.0, 1.0]]
        # Along columns 0 + 1 + 3, along rows 1 + 2 + 0 + 0, over 10.
        assert metrics.roughness(frame) == pytest.approx(0.7)
        assert metrics.roughness(np.full((3, 4), 5.0)) == 0
        with pytest.raises(errors.InputError, match="no finite value"):
            metrics.roughness(np.zeros((2, 2)))


@pytest.fixture(scope="module")
def set_001(data_dir):
    """Pairs of frames of 50 levels, the light, and 50 bright and dark frames, of a real CCD."""
    folder, groups = data_dir / "emva1288-set001-ccd-12bit", []
    for line in (folder / "EMVA1288_Data.txt").read_text(encoding="latin-1").splitlines():
        kind, *words = line.split() or [""]
        if kind in ("b", "d"):
            groups.append((kind, [float(word) for word in words], []))
        elif kind == "i":
            groups[-1][2].append(folder / words[0].replace("\\", "/"))
    pairs = {
        kind: sorted(each for each in groups if each[0] == kind and len(each[2]) == 2)
        for kind in "bd"
    }
    bright, dark = ([read_frames(each[2]) for each in pairs[kind]] for kind in "bd")
    many = {each[0]: read_frames(each[2]) for each in groups if len(each[2]) == 50}
    return dark, bright, [each[1][1] for each in pairs["b"]], many


@pytest.mark.data
class TestRealCamera:
    """The figures of the README of the data, release 4.0."""

    @pytest.mark.long
    def test_gain_responsivity_and_linearity(self, set_001):
        dark, bright, light, _ = set_001
        found = metrics.emva_transfer(bright, dark, light)
        assert found.gain_dn_per_e == pytest.approx(0.28006, rel=0.01)
        assert found.responsivity == pytest.approx(0.126727, rel=0.01)
        assert found.quantum_efficiency == pytest.approx(0.45249, rel=0.01)
        assert found.linearity_error == pytest.approx(0.00297, abs=0.0002)

    @pytest.mark.long
    def test_non_uniformity_and_its_parts(self, set_001):
        many = set_001[3]
        found = metrics.emva_spatial(many["b"], many["d"], gain_dn_per_e=0.28006)
        assert found.dsnu.total == pytest.approx(0.553, rel=0.01)
        wanted = (0.00262, 0.000163, 0.000280, 0.00260)
        np.testing.assert_allclose(found.prnu, wanted, rtol=0.01)
        plain = metrics.emva_spatial(many["b"], many["d"], highpass=False)
        assert plain.prnu.total == pytest.approx(0.004327, rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_tilt_is_a_least_squares_fit_over_the_valid_pixels(seed):
    rng = np.random.default_rng(seed)
    rows, cols = rng.integers(3, 40, 2)
    sensitivity = np.exp(0.1 * rng.standard_normal((rows, cols)))
    valid = rng.random((rows, cols)) < 0.7
    row, col = np.nonzero(valid)
    design = np.stack([np.ones(row.size), row / rows, col / cols], axis=1)
    expected = np.linalg.lstsq(design, np.log(sensitivity[valid]), rcond=None)[0][1:]
    sensitivity[~valid] = np.nan
    found = equipix.metrics.maps.tilt(sensitivity, valid)
    # Rounding: some eps of each value, times the condition of the fit.
    bound = 1e-15 * row.size * np.linalg.cond(design) ** 2
    np.testing.assert_allclose(found, expected, rtol=0, atol=bound)
    weights = equipix.metrics.maps.tilt_weights(valid)
    sums = np.sum(weights * np.where(valid, np.log(sensitivity), 0), axis=(1, 2))
    np.testing.assert_allclose(found, sums, rtol=0, atol=bound)


def test_pixels_on_a_line_have_no_tilt():
    valid = np.eye(5, dtype=bool)
    assert np.isnan(equipix.metrics.maps.tilt(np.ones((5, 5)), valid)).all()
