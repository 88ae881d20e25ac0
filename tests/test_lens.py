"""Fall-off of a lens: the law, its fit beside a sensor's own gain, the gain that removes it."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import errors, lens, nuc, simulate
from equipix.lens import cos4

SHAPE = (240, 320)
CENTRE, FOCAL = (125.0, 150.0), 500.0


def squared(shape=SHAPE, centre=CENTRE):
    rows, cols = np.ogrid[: shape[0], : shape[1]]
    return (rows - centre[0]) ** 2 + (cols - centre[1]) ** 2


def flat(rng=None):
    light = 1000 * cos4(squared(), FOCAL)
    return light if rng is None else light * simulate.paper_sensitivity(SHAPE, rng=rng)


class TestCos4:
    def test_it_is_the_fourth_power_of_the_cosine(self):
        for distance in (0.0, 10.0, 300.0):
            angle = np.arctan(distance / FOCAL)
            assert float(cos4(distance**2, FOCAL)) == pytest.approx(np.cos(angle) ** 4)

    def test_the_corner_of_the_array_of_the_source(self):
        # 54 mm behind a lens of 100 mm: r² = 2·27² mm².
        wanted = np.cos(np.arctan(np.sqrt(2) * 27 / 100)) ** 4
        assert float(cos4(2 * 27**2, 100.0)) == pytest.approx(wanted)


class TestFit:
    def test_an_exact_flat_gives_centre_and_focal_length(self):
        found = lens.fit(flat())
        # Means over blocks of 5×5 pixels lie below the law at their centres by up to 2/f² times
        # 2·(5² − 1)/12 pixels² of it: 3e-5.
        assert found.centre == pytest.approx(CENTRE, abs=0.01)
        assert found.focal_length == pytest.approx(FOCAL, rel=3e-5)
        np.testing.assert_allclose(found.illumination(), flat() / 1000, rtol=3e-5)

    def test_errors_beside_the_sensors_own_gain_are_those_stated(self):
        z = []
        for seed in range(20):
            found = lens.fit(flat(seed))
            z.append(
                [
                    (found.centre[0] - CENTRE[0]) / found.std["row"],
                    (found.centre[1] - CENTRE[1]) / found.std["col"],
                    (found.focal_length - FOCAL) / found.std["focal_length"],
                ]
            )
        # 60 normal values: their rms has a standard error of 9.1 %; four of them. The law is
        # linear in its parameters where their errors are small.
        assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1, abs=0.36)

    @pytest.mark.parametrize("law", ["cos4", "radial"])
    def test_every_standard_error_is_that_of_repeated_flats(self, law):
        rng, shape, centre = np.random.default_rng(7), (24, 64), (10.0, 35.0)
        exact = lens.cos4(squared(shape, centre), 60.0)
        if law == "radial":
            exact = 1 - 0.4 * (rho := squared(shape, centre) / (24**2 + 64**2) * 4) + 0.1 * rho**2
        z = []
        for _ in range(40):
            found = lens.fit(1000 * exact + 10 * rng.standard_normal(shape), law=law)
            away = {"row": found.centre[0] - 10, "col": found.centre[1] - 35}
            away["focal_length"] = found.focal_length - 60
            for name, value, true in zip(
                ("k1", "k2"), found.coefficients, (-0.4, 0.1), strict=False
            ):
                away[name] = value - true
            z.append([away[name] / error for name, error in found.std.items()])
        # Four standard errors of an rms of 40.
        rms = np.sqrt(np.mean(np.square(z), axis=0))
        np.testing.assert_allclose(rms, 1, atol=4 / np.sqrt(2 * 40))

    def test_standard_errors_of_a_radial_law_are_those_of_its_derivatives(self):
        """Each of its own coefficient: they differ, and both are known from the law."""
        shape, (row, col), (k1, k2) = (64, 64), (30.0, 35.0), (-0.4, 0.1)
        half = np.hypot(*shape) / 2
        rows, cols = (each.ravel() for each in np.indices(shape))
        rho = ((rows - row) ** 2 + (cols - col) ** 2) / half**2
        slope = 1000 * (k1 + 2 * k2 * rho) * -2 / half**2
        light = 1 + k1 * rho + k2 * rho**2
        moved = slope * (rows - row), slope * (cols - col)
        design = np.stack([light, *moved, 1000 * rho, 1000 * rho**2], axis=1)
        wanted = 10 * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
        noise = 10 * np.random.default_rng(8).standard_normal(light.size)
        found = lens.fit((1000 * light + noise).reshape(shape), law="radial")
        assert wanted[4] > 1.15 * wanted[3]
        # Of the spread of 4096 residuals, and of the centre, by which the derivatives move.
        rel = 5 / np.sqrt(2 * light.size)
        assert found.std["k1"] == pytest.approx(wanted[3], rel=rel)
        assert found.std["k2"] == pytest.approx(wanted[4], rel=rel)

    def test_the_sensors_own_gain_can_be_given(self):
        sensitivity = simulate.cosine_sensitivity(SHAPE, rng=3)
        biased = lens.fit(1000 * cos4(squared(), FOCAL) * sensitivity)
        light = 1000 * cos4(squared(), FOCAL) * sensitivity
        found = lens.fit(light, sensitivity=sensitivity)
        assert found.focal_length == pytest.approx(FOCAL, rel=3e-5)
        assert abs(biased.focal_length / FOCAL - 1) > 100 * abs(found.focal_length / FOCAL - 1)

    def test_dust_and_masked_corners_are_left_out(self):
        image = flat(1)
        wanted = lens.fit(image)
        image[100:106, 200:206] *= 0.3
        image[5, 5] = np.nan
        mask = np.zeros(SHAPE, bool)
        mask[:20, :20] = True
        image[:20, :20] = 0
        found = lens.fit(image, mask=mask)
        assert found.focal_length == pytest.approx(
            wanted.focal_length, abs=2 * wanted.std["focal_length"]
        )

    def test_a_radial_law(self):
        rho = squared() / (np.hypot(*SHAPE) / 2) ** 2
        image = 500 * (1 - 0.3 * rho + 0.08 * rho**2)
        found = lens.fit(image, law="radial")
        assert found.centre == pytest.approx(CENTRE, abs=0.01)
        assert found.coefficients == pytest.approx([-0.3, 0.08], abs=1e-4)
        np.testing.assert_allclose(found.illumination(), image / 500, rtol=1e-4)
        # cos⁴ is 1 − 2 r²/f² + 3 r⁴/f⁴ − …: the first term follows from the focal length.
        natural = lens.fit(flat(), law="radial")
        first = -2 * (np.hypot(*SHAPE) / 2 / FOCAL) ** 2
        assert natural.coefficients[0] == pytest.approx(first, rel=0.05)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"law": "cos3"}, "'law' is 'cos3'"),
            ({"sensitivity": np.ones((2, 2))}, "'sensitivity' has shape"),
            ({"mask": np.arange(np.prod(SHAPE)).reshape(SHAPE) > 50}, "fewer than 100 finite"),
            ({"mask": np.ones(SHAPE, bool)}, "'mask' excludes all pixels"),
            ({"mask": np.full(SHAPE, np.nan)}, "'mask' has dtype float64, expected bool"),
            ({"mask": np.zeros(SHAPE, np.uint8)}, "'mask' has dtype uint8, expected bool"),
        ],
    )
    def test_refusals(self, given, message):
        with pytest.raises(errors.InputError, match=message):
            lens.fit(flat(), **given)

    @pytest.mark.parametrize(("law", "rounds"), [("cos4", 1), ("radial", 0)])
    def test_a_fit_that_has_not_converged_is_refused(self, law, rounds, monkeypatch):
        monkeypatch.setattr(lens, "_ROUNDS", rounds)
        with pytest.raises(errors.InputError, match=f"did not converge in {rounds} steps"):
            lens.fit(flat(1), law=law)

    def test_a_flat_without_fall_off_is_refused(self):
        with pytest.raises(errors.InputError, match="fall-off"):
            lens.fit(np.full(SHAPE, 7.0))
        with pytest.raises(errors.InputError, match="not darker at the edge"):
            lens.fit(1 / cos4(squared(), FOCAL))
        # A dark in its place gave f = 5614 pixels.
        dark = 100 + np.random.default_rng(1).standard_normal(SHAPE)
        with pytest.raises(errors.InputError, match="Give the flat, not the dark"):
            lens.fit(dark)

    @pytest.mark.parametrize("law", ["cos4", "radial"])
    def test_a_dark_less_the_flat_is_refused(self, law):
        with pytest.raises(
            errors.InputError, match=r"'frame' has the median -\d+\.\d+, expected light"
        ):
            lens.fit(20 - flat(1), law=law)


class TestCorrection:
    def test_it_is_the_gain_that_removes_the_fall_off(self, tmp_path):
        found = lens.fit(flat())
        correction = found.correction()
        assert isinstance(correction, equipix.Correction)
        np.testing.assert_allclose(correction.correct(flat()), 1000, rtol=6e-5)
        correction.save(tmp_path / "lens.tif")
        loaded = equipix.load(tmp_path / "lens.tif")
        np.testing.assert_array_equal(loaded.coefficients, correction.coefficients)
        assert loaded.metadata == correction.metadata

    def test_gains_that_the_flat_does_not_show_are_flagged(self):
        rho = squared() / (np.hypot(*SHAPE) / 2) ** 2
        image, masked = 1 - 1.3 * rho, rho > 0.6
        found = lens.fit(np.where(masked, np.nan, image), law="radial")
        correction = found.correction()
        flagged = (correction.flags & equipix.Flag.NO_FLAT_FIELD) != 0
        np.testing.assert_array_equal(np.isnan(correction.coefficients[1]), flagged)
        # The reach exceeds the mask by a block of 5 pixels and its diagonal at most.
        distance = np.sqrt(squared())
        assert flagged[masked & (distance > distance[~masked].max() + 15)].all()
        assert not flagged[~masked].any()
        assert flagged[image < 0.1].all()
        good = correction.coefficients[1][~flagged]
        assert (good.min(), good.max()) > (0.9, 1.0)
        assert good.max() < 10
        assert correction.metadata["k1"] == pytest.approx(-1.3, abs=1e-3)
        assert correction.metadata["k2"] == pytest.approx(0, abs=1e-3)
        whole = lens.fit(1 - 0.3 * rho, law="radial").correction()
        assert not whole.flags.any()

    def test_a_corner_with_little_light_is_not_corrected(self):
        light = cos4(squared(), 90.0)
        correction = lens.fit(1000 * light).correction()
        flagged = correction.flags != 0
        # But for the error of the law by block means, at most some 0.1 % here.
        assert flagged[light < 0.099].all()
        assert not flagged[light > 0.101].any()
        assert (light < 0.099).any()

    def test_corrected_frames_are_linear_in_light_only_where_the_mean_curve_is(self):
        shape, light = (100, 120), np.array([0.5e6, 2e6, 5e6, 8e6, 11e6, 14e6, 16e6])
        array = simulate.StaringArray.of("HgCdTe", shape, rng=1)
        dark = equipix.average(array.frames(0, 16, rng=50))
        levels = [
            equipix.average(array.frames(e, 8, rng=k), dark=dark) for k, e in enumerate(light)
        ]
        response = nuc.fit(levels, order=2)
        fall = cos4(squared(shape, (48.0, 63.0)), 150.0)
        frames = np.stack(list(array.frames(14e6 * fall, 16, rng=4)))
        corrected = response.correct(frames).mean(axis=0)
        bent = lens.fit(corrected)
        assert bent.focal_length == pytest.approx(152.0, abs=0.05)  # as docs/nuc.md says
        assert bent.focal_length - 150 > 100 * bent.std["focal_length"]
        linear = np.polynomial.Polynomial.fit(response.levels, light, 3)
        straight = lens.fit(linear(corrected))
        assert abs(straight.focal_length - 150) < 5 * straight.std["focal_length"]

    def test_the_example_prints_the_corner_of_the_source(self, capsys):
        path = Path(__file__).parents[1] / "examples/lens_falloff.py"
        runpy.run_path(str(path), run_name="__main__")
        said = capsys.readouterr().out
        assert " 100: 0.762  1.313" in said


class TestCombine:
    def levels(self):
        rng = np.random.default_rng(1)
        gain = simulate.paper_sensitivity(SHAPE, rng=rng)
        curve = 2e-6 * rng.standard_normal(SHAPE)
        return [v * gain + (curve - curve.mean()) * v * v for v in (500.0, 1500.0, 2500.0, 3500.0)]

    def test_response_curves_then_a_lens(self):
        response = nuc.fit(self.levels(), order=2)
        falloff = lens.fit(flat()).correction()
        both = equipix.combine(response, falloff)
        frame = self.levels()[1]
        wanted = falloff.correct(response.correct(frame))
        np.testing.assert_allclose(both.correct(frame), wanted, rtol=1e-12)

    def test_a_shift_calibration_repairs_curves_of_an_uneven_source(self):
        shape, shifts = (48, 64), equipix.cross_pattern(5, 7)
        truth = simulate.cosine_sensitivity(shape, rng=2)
        uneven = simulate.gaussian_beam(shape, width=60)(*np.indices(shape))
        response = nuc.fit([level * truth * uneven + 20 for level in (100.0, 900.0)], order=1)
        beam = simulate.gaussian_beam(shape, width=100, amplitude=1000)
        raw = simulate.exposures(truth, beam, shifts) + 20
        raw += 0.1 * np.random.default_rng(3).standard_normal(raw.shape)
        cal = equipix.calibrate(response.correct(raw), shifts)
        both = equipix.combine(response, cal)
        flat = 500 * truth + 20
        spread = [c.std() / c.mean() for c in (response.correct(flat), both.correct(flat))]
        assert spread[0] > 0.05
        # Noise of 1e-4 is up to 1e-3 where the source was faint, and so is the tilt that it leaves.
        assert spread[1] < 5e-3
        assert set(both.metadata) == {"versions", "first", "then", "finished"}

    def test_a_dark_is_not_subtracted_twice(self):
        shifts = equipix.cross_pattern(5, 7)
        beam = simulate.gaussian_beam(SHAPE, width=100, amplitude=1000)
        frames = simulate.exposures(np.ones(SHAPE), beam, shifts) + 60
        rng = np.random.default_rng(4)
        noise = rng.standard_normal((6, 2, *SHAPE))
        dark = equipix.average(list(60 + noise[0]))
        averages = [
            equipix.average(list(y + of_y), dark=dark)
            for y, of_y in zip(frames, noise[1:], strict=True)
        ]
        cal = equipix.calibrate(averages, shifts)
        response = nuc.fit(self.levels(), order=2)
        with pytest.raises(errors.InputError, match="'then' subtracts a dark frame of 60"):
            equipix.combine(response, cal)

    def test_flags_add_up_and_files_keep_it(self, tmp_path):
        response = nuc.fit(self.levels(), order=2)
        flags = response.flags.copy()
        flags[3, 4] |= equipix.Flag.HOT | equipix.Flag.DO_NOT_USE
        falloff = lens.fit(flat()).correction()
        both = equipix.combine(response.with_flags(flags), falloff)
        both.save(tmp_path / "both.npz")
        loaded = equipix.load(tmp_path / "both.npz")
        np.testing.assert_array_equal(loaded.flags, flags)
        np.testing.assert_array_equal(loaded.coefficients, both.coefficients)
        assert "degree 3" in repr(loaded)
        assert equipix.Corrector(loaded).replaced == 1

    @pytest.mark.parametrize("order", [0, 1, 2])
    def test_a_gain_after_raw_levels_is_refused(self, order, tmp_path):
        array = simulate.StaringArray.of("InSb", SHAPE, rng=1)
        frames = [list(array.frames(e, 2, rng=k)) for k, e in enumerate((0, 4e6, 8e6, 12e6))]
        falloff = lens.fit(flat()).correction()
        raw = nuc.fit([equipix.average(each) for each in frames[1:]], order=order)
        raw.save(tmp_path / "raw.npz")
        same = equipix.Polynomial(np.stack([np.zeros(SHAPE), np.ones(SHAPE)]), raw.flags)
        for first in (raw, equipix.load(tmp_path / "raw.npz"), equipix.combine(raw, same)):
            with pytest.raises(
                errors.InputError, match=r"'first' .* offset in corrected frames.*dark"
            ):
                equipix.combine(first, falloff)
        # An offset of 'then' can take away the one that 'first' leaves.
        offset = float(np.mean(frames[0]))
        less = equipix.Polynomial(np.stack([np.full(SHAPE, -offset), np.ones(SHAPE)]), raw.flags)
        equipix.combine(equipix.combine(raw, less), falloff)
        dark = equipix.average(frames[0])
        levels = [equipix.average(each, dark=dark) for each in frames[1:]]
        equipix.combine(nuc.fit(levels, order=order), falloff)

    def test_a_second_correction_of_raw_frames_is_refused(self, tmp_path):
        array = simulate.StaringArray.of("InSb", SHAPE, rng=1)
        frames = [list(array.frames(e, 2, rng=k)) for k, e in enumerate((4e6, 8e6, 12e6))]
        raw = nuc.fit([equipix.average(each) for each in frames], order=1)
        raw.save(tmp_path / "raw.npz")
        falloff = lens.fit(flat()).correction()
        same = equipix.Polynomial(np.stack([np.zeros(SHAPE), np.ones(SHAPE)]), raw.flags)
        for then in (raw, equipix.load(tmp_path / "raw.npz"), equipix.combine(raw, same)):
            with pytest.raises(errors.InputError, match="'then' holds the offsets of raw levels"):
                equipix.combine(falloff, then)
        learned = equipix.scene.ConstantStatistics(SHAPE, (0.0, 1.0))
        for each in simulate.MovingScene(seed=1, shape=SHAPE).frames(40):
            learned.update(each.values)
        learned.correction().save(tmp_path / "scene.npz")
        for then in (learned.correction(), equipix.load(tmp_path / "scene.npz")):
            with pytest.raises(errors.InputError, match="'then' is the result of a scene method"):
                equipix.combine(raw, then)

    @pytest.mark.parametrize(
        ("one", "other", "wanted"),
        [
            ({"bit_depth": 12}, {"name": "A"}, {"bit_depth": 12, "name": "A"}),
            ({"name": "A"}, {"bit_depth": 12}, {"bit_depth": 12, "name": "A"}),
            ({"name": ""}, {"name": "A", "bit_depth": 12}, {"bit_depth": 12, "name": "A"}),
            (None, {"name": "A", "bit_depth": 12}, {"bit_depth": 12, "name": "A"}),
            (
                {"bit_depth": 12, "gain_dn_per_e": 0.2},
                None,
                {"bit_depth": 12, "gain_dn_per_e": 0.2},
            ),
        ],
    )
    def test_what_is_known_of_the_sensor_is_kept(self, one, other, wanted):
        planes = np.stack([np.zeros(SHAPE), np.ones(SHAPE)])
        flags = np.zeros(SHAPE, np.uint32)
        first, then = (
            equipix.Polynomial(planes, flags, {} if each is None else {"sensor": each})
            for each in (one, other)
        )
        both = equipix.combine(first, then)
        assert both.metadata["sensor"] == wanted
        with pytest.raises(errors.InputError, match="4096, above 4095, .* of the 12 bits"):
            both.correct(np.full(SHAPE, 4096, np.uint16))

    def test_bits_of_corrected_frames_are_not_those_of_raw_ones(self):
        planes = np.stack([np.zeros(SHAPE), np.ones(SHAPE)])
        flags = np.zeros(SHAPE, np.uint32)
        first = equipix.Polynomial(planes, flags, saturation=4095.0)
        then = equipix.Polynomial(planes, flags, {"sensor": {"bit_depth": 16, "saturation": 6e4}})
        both = equipix.combine(first, then)
        assert both.saturation == 4095
        with pytest.raises(errors.InputError, match="4096, above 4095, .* of the 12 bits"):
            both.correct(np.full(SHAPE, 4096, np.uint16))

    def test_what_does_not_combine_is_refused(self):
        response = nuc.fit(self.levels(), order=2)
        with pytest.raises(errors.InputError, match="'then' has degree 3"):
            equipix.combine(response, response)
        line = response.coefficients[:2]
        offset = np.stack([np.full(SHAPE, -100.0), np.ones(SHAPE)])
        for planes in (line, offset):
            once = equipix.Polynomial(planes, response.flags)
            with pytest.raises(errors.InputError, match="gains of 'first', .* be applied twice"):
                equipix.combine(once, equipix.Polynomial(planes, response.flags, {"other": 1}))
        one, other = (
            equipix.Polynomial(line, response.flags, {"sensor": {"name": name}}) for name in "AB"
        )
        with pytest.raises(errors.InputError, match="of the sensor 'A', 'then' of 'B'"):
            equipix.combine(one, other)
        one, other = (
            equipix.Polynomial(line, response.flags, {"sensor": {"bit_depth": bits}})
            for bits in (12, 14)
        )
        with pytest.raises(errors.InputError, match="of the bit depth 12, 'then' of 14: expected"):
            equipix.combine(one, other)
        small = equipix.Polynomial(np.ones((2, 3, 4)), np.zeros((3, 4), np.uint32))
        with pytest.raises(errors.InputError, match="'first' is of shape"):
            equipix.combine(response, small)
        with pytest.raises(errors.InputError, match="'coefficients' has shape"):
            equipix.Polynomial(np.ones((5, 3, 4)), np.zeros((3, 4), np.uint32))
