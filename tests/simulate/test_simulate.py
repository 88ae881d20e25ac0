"""The simulated sensors, beams, camera and experiments are what they say they are."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import tifffile

import reference
from equipix import metrics, simulate
from equipix.errors import FileError, InputError

CROSS = [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)]


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


class TestSensitivities:
    def test_paper_sensor_is_uniform_and_white(self):
        xi = simulate.paper_sensitivity((240, 320), spread=0.04, rng=1) - 1
        assert abs(xi).max() <= 0.04
        # A uniform variable has a standard deviation of spread/√3, itself known to 0.45/√n of it.
        assert rms(xi) == pytest.approx(0.04 / np.sqrt(3), rel=5 * 0.45 / np.sqrt(xi.size))

    def test_cosine_sensor_has_the_stated_large_scale(self):
        sensitivity = simulate.cosine_sensitivity((5, 9), spread=0, rng=1)
        assert sensitivity[2, 4] == pytest.approx(1 + 0.05 * np.cos(1))
        assert sensitivity[0, 8] == pytest.approx(1 + 0.05 * np.cos(2.5) * np.cos(1))

    def test_the_same_seed_gives_the_same_sensor(self):
        first, second = (simulate.cosine_sensitivity((4, 4), rng=7) for _ in range(2))
        np.testing.assert_array_equal(first, second)

    @pytest.mark.parametrize("shape", [(0, 5), (5, 0), (5,), (2.5, 3), (-1, 3)])
    def test_an_empty_sensor_is_refused(self, shape):
        for make in (
            lambda: simulate.paper_sensitivity(shape, rng=1),
            lambda: simulate.gaussian_beam(shape),
        ):
            with pytest.raises(
                InputError, match=r"'shape' is \(.*, expected \(rows, cols\), each 1"
            ):
                make()


class TestBeams:
    @pytest.mark.parametrize("beam", [np.ones((5, 5)), np.ones(5), None, [1.0]])
    def test_values_of_a_beam_are_refused(self, beam):
        sensitivity = np.ones((48, 64))
        for take in (
            lambda: simulate.experiment(sensitivity, beam, CROSS, rng=1),
            lambda: simulate.exposures(sensitivity, beam, CROSS),
            lambda: simulate.noise_prediction(sensitivity, beam, CROSS, 1e-6, rng=1),
        ):
            with pytest.raises(InputError, match=r"'beam' is of type \w+, expected a function of"):
                take()

    def test_gaussian_falls_to_one_over_e_at_its_width(self):
        beam = simulate.gaussian_beam((11, 21), width=30, amplitude=2)
        np.testing.assert_allclose(
            beam(np.array([5.0, 35.0]), np.array([10.0, 10.0])), [2, 2 / np.e]
        )

    def test_gaussian_may_be_off_centre(self):
        beam = simulate.gaussian_beam((11, 21), centre=(3.5, -8))
        assert float(beam(np.array(3.5), np.array(-8.0))) == 1

    def test_stripes_return_after_a_period_along_their_normal(self):
        beam = simulate.striped_beam((50, 50), width=1e9, period=20)
        np.testing.assert_allclose(
            beam(np.array(3.0), np.array(4.0)), beam(np.array(15.0), np.array(20.0))
        )

    def test_tilt_grows_by_its_slope_from_edge_to_edge(self):
        beam = simulate.tilted_beam((40, 60), width=1e9, slope=(0.1, 0.2))
        edges = beam(np.array([-0.5, 39.5, 19.5]), np.array([29.5, 29.5, 59.5]))
        np.testing.assert_allclose(edges, [0.95, 1.05, 1.1])

    def test_waves_are_band_limited_and_of_the_stated_contrast(self):
        side = 512
        beam = simulate.wavy_beam((side, side), width=1e9, contrast=0.1, rng=3)
        structure = beam(np.arange(side, dtype=float)[:, None], np.arange(side, dtype=float)) - 1
        assert rms(structure) == pytest.approx(0.1, rel=0.1)
        taper = np.hanning(side)[:, None] * np.hanning(side)
        power = np.abs(np.fft.fft2(structure * taper)) ** 2
        frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side))
        # The taper spreads a line over two bins; its sidelobes beyond four hold under 1e-5.
        assert power[frequency > 0.1 + 4 / side].sum() < 1e-5 * power.sum()


def positions_seen(shape, shift, rotation):
    """u = A·p + t + d, from the table of the model."""
    rows, cols = shape
    matrix, offset = {
        0: ([[1, 0], [0, 1]], (0, 0)),
        90: ([[0, 1], [-1, 0]], (0, rows - 1)),
        180: ([[-1, 0], [0, -1]], (rows - 1, cols - 1)),
        270: ([[0, -1], [1, 0]], (cols - 1, 0)),
    }[rotation]
    pixels = np.stack(np.indices(shape), axis=-1)
    return pixels @ np.array(matrix).T + np.array(offset) + shift


class TestExposures:
    @pytest.mark.parametrize("rotation", [0, 90, 180, 270])
    @pytest.mark.parametrize("shift", [(0, 0), (-2.25, 3.5)])
    def test_every_pixel_sees_the_beam_where_the_model_says(self, rotation, shift):
        shape = (4, 7)
        sensitivity = simulate.paper_sensitivity(shape, rng=1)
        beam = simulate.gaussian_beam(shape, width=6, centre=(1, 2))
        frame = simulate.exposures(sensitivity, beam, [shift], flux=[1.5], rotation=[rotation])[0]
        u = positions_seen(shape, shift, rotation)
        expected = 1.5 * beam(u[..., 0], u[..., 1]) * sensitivity
        np.testing.assert_allclose(frame, expected, rtol=1e-14)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"shifts": [(0, 0, 0)]}, r"'shifts' has shape \(1, 3\)"),
            (
                {"shifts": [(0, 0), (np.nan, 1)]},
                r"'shifts' of exposure 1 \(from 0\) is \[nan, 1.0\], expected finite",
            ),
            ({"flux": [1.0, 2.0]}, "'flux' has 2 entries, expected 1"),
            ({"rotation": [45]}, "'rotation' holds 45"),
            ({"sensitivity": np.ones(3)}, "'sensitivity' has shape"),
        ],
    )
    def test_refuses_what_makes_no_sense(self, arguments, message):
        given = {"sensitivity": np.ones((3, 4)), "shifts": [(0, 0)], **arguments}
        with pytest.raises(InputError, match=message):
            simulate.exposures(beam=simulate.gaussian_beam((3, 4)), **given)


class TestAccuracy:
    def test_relative_error_does_not_depend_on_scale_or_bad_pixels(self):
        truth = simulate.paper_sensitivity((20, 30), rng=1)
        measured = 3.7 * truth
        measured[2, 3] *= 1.01
        measured[4, 5], truth[6, 7] = np.nan, np.nan
        error = metrics.relative_error(measured, truth)
        assert np.isnan(error[4, 5])
        assert np.isnan(error[6, 7])
        assert error[2, 3] - error[0, 0] == pytest.approx(0.01, rel=1e-3)
        assert np.nanmean(error * truth) == pytest.approx(0, abs=1e-15)

    def test_block_means_leave_out_what_is_not_finite(self):
        image = np.arange(24.0).reshape(4, 6)
        image[0, 0] = np.nan
        image[:2, 4:] = np.nan
        means = metrics.block_means(image, 2)
        np.testing.assert_allclose(means, [[14 / 3, 5.5, np.nan], [15.5, 17.5, 19.5]])

    def test_block_means_refuse_an_image_smaller_than_a_block(self):
        with pytest.raises(InputError, match="smaller than one block of 16"):
            metrics.block_means(np.ones((15, 40)))


class TestNoisePrediction:
    def set_up(self, shape):
        self.shape = shape
        self.sensitivity = simulate.cosine_sensitivity(shape, rng=1)
        self.beam = simulate.tilted_beam(shape, width=50)
        self.signal = simulate.exposures(self.sensitivity, self.beam, CROSS)
        self.variance = 1e-6 * self.signal

    def test_is_what_the_dense_covariance_says(self):
        self.set_up((12, 17))
        expected = self.dense_rms(np.zeros(self.shape, bool))
        found, _ = simulate.noise_prediction(
            self.sensitivity, self.beam, CROSS, self.variance, draws=100, rng=2
        )
        # The rms over 204 nearly independent pixels scatters by 1/√408 a draw.
        assert found == pytest.approx(expected, rel=4 / np.sqrt(2 * 204 * 100))

    def test_leaves_masked_pixels_out(self):
        self.set_up((12, 17))
        mask = np.random.default_rng(3).random(self.shape) < 0.1
        found, _ = simulate.noise_prediction(
            self.sensitivity, self.beam, CROSS, self.variance, mask=mask, draws=100, rng=2
        )
        assert found == pytest.approx(self.dense_rms(mask), rel=4 / np.sqrt(2 * 204 * 100))

    def dense_rms(self, mask):
        """Root mean square error by the pseudo-inverse of all relative steps, gauge mean 1."""
        weights = (self.signal**2 / self.variance)[:, ~mask]
        cells, grid_shape, _ = reference.grid_cells(self.shape, CROSS)
        pixels = weights.shape[1]
        rows = []
        for exposure, seen in zip(weights, cells[:, ~mask], strict=True):
            block = np.zeros((pixels, pixels + np.prod(grid_shape)))
            block[np.arange(pixels), np.arange(pixels)] = np.sqrt(exposure)
            block[np.arange(pixels), pixels + seen] = np.sqrt(exposure)
            rows.append(block)
        matrix = np.concatenate(rows)
        covariance = np.linalg.pinv(matrix.T @ matrix, hermitian=True)[:pixels, :pixels]
        share = self.sensitivity[~mask] / self.sensitivity[~mask].sum()
        gauge = np.eye(pixels) - share
        return np.sqrt(np.trace(gauge @ covariance @ gauge.T) / pixels)

    @pytest.mark.long
    def test_is_what_a_solver_leaves(self):
        self.set_up((18, 33))
        rng = np.random.default_rng(5)
        solves = [self.solved_error(rng) for _ in range(20)]
        found = simulate.noise_prediction(
            self.sensitivity, self.beam, CROSS, self.variance, draws=100, rng=2
        )
        assert found[0] == pytest.approx(
            np.mean([rms(e) for e in solves]), rel=4 / np.sqrt(1188 * 20)
        )
        # Two blocks a solve: an rms from 40 values, of which gauge and correlation leave half.
        blocks = np.mean([rms(metrics.block_means(e)) for e in solves])
        assert found[1] == pytest.approx(blocks, rel=4 / np.sqrt(2 * 20))

    def solved_error(self, rng):
        frames = self.signal + np.sqrt(self.variance) * rng.standard_normal(self.signal.shape)
        solution = reference.coordinate_descent(frames, CROSS, variance=self.variance, sweeps=400)
        return metrics.relative_error(solution.sensitivity, self.sensitivity)

    def test_refuses_variance_of_another_shape_or_zero(self):
        self.set_up((12, 17))
        with pytest.raises(InputError, match=r"'variance' has shape \(4,\)"):
            simulate.noise_prediction(self.sensitivity, self.beam, CROSS, np.ones(4), rng=1)
        with pytest.raises(InputError, match="must be above 0"):
            simulate.noise_prediction(self.sensitivity, self.beam, CROSS, 0.0, rng=1)
        with pytest.raises(InputError, match=r"'mask' of shape .* leaves no pixel"):
            simulate.noise_prediction(
                self.sensitivity, self.beam, CROSS, 1.0, mask=np.ones((12, 17), bool), rng=1
            )


class TestCamera:
    def test_mean_and_variance_are_those_of_photons_reading_and_rounding(self):
        rng = np.random.default_rng(1)
        camera = simulate.Camera(
            sensitivity=simulate.paper_sensitivity((30, 40), rng=2),
            dark=rng.normal(60, 3, (30, 40)),
        )
        light = rng.uniform(20, 15_000, (30, 40))
        count = 400
        frames = np.stack(list(camera.frames(light, count, rng=3))).astype(float)
        variance = camera.variance(light)
        mean = camera.offset + camera.gain_dn_per_e * light * camera.response
        z = (frames.mean(axis=0) - mean) / np.sqrt(variance / count)
        assert rms(z) == pytest.approx(1, abs=4 / np.sqrt(2 * z.size))
        ratio = frames.var(axis=0, ddof=1) / variance
        assert ratio.mean() == pytest.approx(1, abs=4 * np.sqrt(2 / (count * z.size)))

    def test_few_photons_are_counted(self):
        camera = simulate.Camera(
            sensitivity=np.ones((200, 200)), dark=0.0, gain_dn_per_e=1, read_noise_e=0
        )
        (frame,) = camera.frames(np.full((200, 200), 3.0), 1, rng=1)
        for count, probability in enumerate(np.exp(-3) * np.array([1, 3, 9 / 2, 27 / 6])):
            # Binomial, within four standard deviations.
            scatter = np.sqrt(probability * (1 - probability) / frame.size)
            assert np.mean(frame == count) == pytest.approx(probability, abs=4 * scatter)

    @pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (10, np.uint16), (16, np.uint16)])
    def test_values_clip_at_both_ends(self, bits, dtype):
        light = np.array([[0.0, 1e9]])
        camera = simulate.Camera(sensitivity=np.ones((1, 2)), dark=-50.0, bit_depth=bits)
        (frame,) = camera.frames(light, 1, rng=1)
        assert frame.dtype == dtype
        assert frame.tolist() == [[0, 2**bits - 1]]

    def test_a_full_well_stops_the_signal(self):
        camera = simulate.Camera(
            sensitivity=np.ones((1, 1)), full_well_e=1000, dark=0.0, read_noise_e=0
        )
        (frame,) = camera.frames(np.array([[5000.0]]), 1, rng=1)
        assert frame[0, 0] == 200

    def test_dead_pixels_are_blind_and_hot_ones_full(self):
        camera = simulate.Camera(sensitivity=np.ones((2, 3)), dead=np.array([1]), hot=np.array([5]))
        (dark,) = camera.frames(np.zeros((2, 3)), 1, rng=1)
        (bright,) = camera.frames(np.full((2, 3), 10_000.0), 1, rng=1)
        assert dark[1, 2] > 3500
        assert bright[1, 2] == 4095
        assert bright[0, 1] < 200 < bright[0, 0]
        assert np.flatnonzero(~camera.good).tolist() == [1, 5]

    @pytest.mark.parametrize(
        ("values", "message"),
        [
            ({"bit_depth": 7}, "'bit_depth' is 7, expected 8 to 16"),
            ({"gain_dn_per_e": 0}, "'gain_dn_per_e' is 0"),
            ({"full_well_e": -1}, "'full_well_e' is -1"),
            ({"read_noise_e": np.nan}, "'read_noise_e' is nan"),
            ({"dead": np.array([6])}, "'dead' holds indices outside 0 to 5"),
            ({"dark": np.ones((3, 2))}, r"'dark' has shape \(3, 2\)"),
        ],
    )
    def test_refuses_what_no_camera_has(self, values, message):
        with pytest.raises(InputError, match=message):
            simulate.Camera(sensitivity=np.ones((2, 3)), **values)


def small_experiment(shape=(60, 80), **options):
    sensitivity = simulate.cosine_sensitivity(shape, rng=1)
    options = {"frames": 3, "aperture_frames": 4, "rng": 2, **options}
    return simulate.experiment(sensitivity, simulate.gaussian_beam(shape), CROSS, **options)


def centre_of_hole(frames, dark):
    """First moment of the hole's image."""
    image = np.mean([frame - dark for frame in frames], axis=0)
    return np.array([np.average(axis, weights=image) for axis in np.indices(image.shape)])


class TestExperiment:
    def test_streams_can_be_drawn_again_and_differ_from_each_other(self):
        virtual = small_experiment()
        first, again = (np.stack(list(virtual.frames(1))) for _ in range(2))
        np.testing.assert_array_equal(first, again)
        assert len(first) == 3
        assert (first[0] != first[1]).any()
        assert (next(virtual.frames(0)) != first[0]).any()

    def test_frames_show_the_beam_where_the_stage_stands(self):
        virtual = small_experiment(frames=200, stage_error=0.3, dead=0, hot=0)
        truth = virtual.truth
        light = simulate.exposures(truth.sensitivity, virtual.beam, truth.shifts)
        mean = np.mean(list(virtual.frames(3)), axis=0) - truth.dark
        variance = virtual.camera.variance(light[3] / truth.sensitivity) / 200
        z = (mean - truth.gain_dn_per_e * light[3]) / np.sqrt(variance)
        assert rms(z) == pytest.approx(1, abs=4 / np.sqrt(2 * z.size))

    def test_stage_errors_add_up(self):
        draws = [small_experiment(stage_error=0.1, rng=seed).positions for seed in range(100)]
        errors = np.stack(draws) - CROSS
        np.testing.assert_array_equal(errors[:, 0], 0)
        # 200 values a position; the standard deviation of one position is 0.1·√k.
        expected = 0.1 * np.sqrt(np.arange(1, 5))
        np.testing.assert_allclose(errors[:, 1:].std(axis=(0, 2)), expected, rtol=4 / np.sqrt(400))

    def test_the_hole_moves_against_the_sensor(self):
        virtual = small_experiment(stage_error=0, dead=0, hot=0)
        dark = virtual.truth.dark
        for k in range(1, 5):
            before = centre_of_hole(virtual.aperture_before(k), dark)
            after = centre_of_hole(virtual.aperture_after(k), dark)
            move = np.subtract(CROSS[k], CROSS[k - 1])
            # Unequal pixels of relative rms 0.05/√3 push the centre of a disc by 0.28 of that, and
            # 5 electrons of read noise on 4800 pixels 20 away push that of 1.6e6 by 0.004: five
            # standard deviations, for two images.
            np.testing.assert_allclose(before - after, move, atol=5 * np.sqrt(2) * 0.009)

    def test_prediction_counts_all_noise_of_the_means(self):
        """Photons, reading and rounding of the frames and of the dark, weighted by exposure."""
        virtual = small_experiment(frames=10, read_noise_e=100, dead=0, hot=0)
        truth = virtual.truth
        variance = virtual.variance_of_mean() / truth.gain_dn_per_e**2
        expected = 2 * (100**2 + 1 / 12 / truth.gain_dn_per_e**2) / 10
        light = simulate.exposures(truth.sensitivity, virtual.beam, truth.shifts)
        np.testing.assert_allclose(variance, light / 10 + expected)
        rms_of_map, _ = virtual.noise_prediction(rng=1)
        direct, _ = simulate.noise_prediction(
            truth.sensitivity, virtual.beam, truth.shifts, variance, rng=1
        )
        assert rms_of_map == direct

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"frames": 0}, "'frames' is 0"),
            ({"dark_frames": 0}, "'dark_frames' is 0"),
            ({"dead": 5000}, "5000 dead and 4 hot pixels do not fit 4800"),
            ({"bit_depth": 24}, "'bit_depth' is 24"),
            ({"shape": (14, 14)}, "leave no hole in view"),
        ],
    )
    def test_refuses_what_cannot_be_done(self, options, message):
        with pytest.raises(InputError, match=message):
            small_experiment(**options)


class TestWrite:
    def test_files_hold_the_streams(self, tmp_path):
        virtual = small_experiment()
        done = []
        manifest = virtual.write(tmp_path / "out", progress=lambda *step: done.append(step))
        assert manifest == tmp_path / "out" / "experiment.toml"
        frames = tifffile.imread(tmp_path / "out/frames/p4.tif")
        np.testing.assert_array_equal(frames, np.stack(list(virtual.frames(4))))
        dark = tifffile.imread(tmp_path / "out/dark/dark.tif")
        np.testing.assert_array_equal(dark, np.stack(list(virtual.dark())))
        after = tifffile.imread(tmp_path / "out/aperture/p2-after.tif")
        np.testing.assert_array_equal(after, np.stack(list(virtual.aperture_after(2))))
        with np.load(tmp_path / "out/truth.npz") as truth:
            np.testing.assert_array_equal(truth["shifts"], virtual.truth.shifts)
        total = 5 * 3 + 3 + 8 * 4
        assert done == [(k, total, "writing") for k in range(1, total + 1)]

    def test_the_manifest_names_the_files_and_the_bits(self, tmp_path):
        import tomllib

        manifest = tomllib.loads(small_experiment().write(tmp_path / "out").read_text())
        assert manifest["sensor"]["bit_depth"] == 12
        assert [e["name"] for e in manifest["exposure"]] == ["p0", "p1", "p2", "p3", "p4"]
        named = [manifest["dark"]["frames"]]
        named += [v for e in manifest["exposure"] for k, v in e.items() if k != "name"]
        assert len(named) == 1 + 5 + 8
        assert all((tmp_path / "out" / name).is_file() for name in named)

    def test_an_empty_folder_is_filled_and_a_full_one_kept(self, tmp_path):
        (tmp_path / "out").mkdir()
        small_experiment().write(tmp_path / "out")
        with pytest.raises(FileError, match="exists and is not empty"):
            small_experiment().write(tmp_path / "out")
        small_experiment(bit_depth=8).write(tmp_path / "out", force=True)
        assert tifffile.imread(tmp_path / "out/frames/p0.tif").dtype == np.uint8

    def test_force_never_removes_what_is_no_experiment(self, tmp_path):
        (tmp_path / "thesis.txt").write_text("years of work")
        with pytest.raises(FileError, match="exists and is not empty"):
            small_experiment().write(tmp_path, force=True)
        assert (tmp_path / "thesis.txt").exists()

    @pytest.mark.parametrize("name", ["thesis.txt", "frames/thesis.txt", "dark/2024/dark.tif"])
    def test_force_removes_only_what_it_wrote(self, tmp_path, name):
        virtual = small_experiment()
        virtual.write(tmp_path / "out")
        precious = tmp_path / "out" / name
        precious.parent.mkdir(exist_ok=True)
        precious.write_text("years of work")
        with pytest.raises(FileError, match="nothing but an experiment"):
            virtual.write(tmp_path / "out", force=True)
        assert precious.read_text() == "years of work"
        assert [path.name for path in tmp_path.iterdir()] == ["out"]

    def test_a_failure_keeps_what_was_there(self, tmp_path):
        def give_up(*_):
            raise KeyboardInterrupt

        manifest = small_experiment().write(tmp_path / "out")
        with pytest.raises(KeyboardInterrupt):
            small_experiment().write(tmp_path / "out", force=True, progress=give_up)
        assert manifest.is_file()
        small_experiment().write(tmp_path / "out", force=True)
        assert [path.name for path in tmp_path.iterdir()] == ["out"]

    def test_a_failure_leaves_nothing_behind(self, tmp_path):
        def give_up(done, *_):
            if done == 7:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            small_experiment().write(tmp_path / "out", progress=give_up)
        assert list(tmp_path.iterdir()) == []

    def test_a_path_that_cannot_be_made_is_named(self, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(FileError, match="cannot be written"):
            small_experiment().write(tmp_path / "file" / "out")

    @pytest.mark.parametrize("folder", [3, None, b"out", "a\0b"], ids=repr)
    def test_what_is_no_path_is_refused(self, folder):
        with pytest.raises(InputError, match="'folder' holds .*, expected a path"):
            small_experiment().write(folder)

    @pytest.mark.long
    def test_memory_does_not_grow_with_the_number_of_frames(self, tmp_path):
        def peak(frames):
            tracemalloc.start()
            small_experiment(frames=frames).write(tmp_path / str(frames))
            _, most = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            return most

        peak(2)  # what is imported or cached on first use
        few, many = peak(5), peak(50)
        frame_bytes = 60 * 80 * 2
        assert many - few < 10 * frame_bytes
