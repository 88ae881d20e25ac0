"""Sensors behind colour filters: calibrated, fitted to levels, corrected, by each colour."""

import dataclasses
import doctest
import json
from pathlib import Path

import numpy as np
import pytest

import equipix
from equipix import cross_pattern, errors, metrics, nuc, plan, simulate
from equipix.io.tiff import write_frames
from equipix.lens import cos4
from equipix.measured.colour import Colours, pattern_of

SHAPE, CROSS, NOISE = (48, 56), cross_pattern(11, 19), 3.0
X_TRANS = "GBGGRG/RGRBGB/GBGGRG/GRGGBG/BGBRGR/GRGGBG"
PATTERNS = ["RGGB", "GRBG", "GBRG", "BGGR", "RRGG/RRGG/GGBB/GGBB", X_TRANS]
NAMED = "ignore:the response repeats"


def sensor(cfa, seed=1, dead=5):
    """Sensitivity of a sensor, and its good pixels; the dead ones have a tenth of their colour."""
    rng = np.random.default_rng(seed)
    plain = 1 + 0.01 * rng.standard_normal(SHAPE)
    truth = plain if cfa is None else simulate.filtered(plain, cfa)
    good = np.ones(SHAPE, bool)
    good.flat[rng.choice(good.size, dead, replace=False)] = False
    return np.where(good, truth, 0.1 * truth), good


def exposures(truth, seed=2, noise=NOISE, shifts=CROSS):
    beam = simulate.gaussian_beam(SHAPE, width=200, amplitude=8000)
    frames = simulate.exposures(truth, beam, shifts)
    return frames + noise * np.random.default_rng(seed).standard_normal(frames.shape)


def planes(cfa):
    return dict(Colours.of(cfa).planes(SHAPE))


class TestCalibrate:
    @pytest.mark.parametrize("cfa", PATTERNS)
    def test_a_good_sensor_has_no_flags_and_each_colour_the_mean_1(self, cfa):
        truth, good = sensor(cfa)
        cal = equipix.calibrate(exposures(truth), CROSS, variance=np.full(5, NOISE**2), cfa=cfa)
        np.testing.assert_array_equal(cal.flags == 0, good)
        for plane in planes(cfa).values():
            assert cal.sensitivity[plane & good].mean() == pytest.approx(1, abs=1e-12)
        means = {label: truth[plane & good].mean() for label, plane in planes(cfa).items()}
        ratios = [cal.colour_response[label] / mean for label, mean in means.items()]
        # Of a hundred pixels or more the ratio of two colours is known to 1e-3/√100.
        assert np.ptp(ratios) / np.mean(ratios) < 6 * 1e-3 / np.sqrt(100)
        assert np.mean((cal.sensitivity * cal.cfa.map_of(cal.colour_response, SHAPE))[good]) == (
            pytest.approx(1, abs=1e-12)
        )

    @pytest.mark.parametrize("noise", [0.3, 20.0])
    def test_what_is_known_of_shifts_counts_beside_an_unknown_variance(self, noise):
        """Variances of unit 1 over squared responses outweighed it: shifts ended 0.9 pixel off."""
        rng, std = np.random.default_rng(6), 0.006
        shifts = CROSS + std * rng.standard_normal((5, 2))
        frames = exposures(sensor("RGGB")[0], noise=noise, shifts=shifts)
        cal = equipix.calibrate(frames, CROSS, shift_std=std, cfa="RGGB")
        assert cal.converged
        known = equipix.calibrate(
            frames, CROSS, shift_std=std, cfa="RGGB", variance=np.full(5, noise**2)
        )
        assert np.abs(cal.shifts - shifts).max() < 5 * std
        # Weights differ by the responses of the colours, so each has noise of its own.
        assert np.abs(cal.shifts - known.shifts).max() < 2 * std

    def test_metadata_keep_labels_of_several_letters(self):
        truth, _ = sensor("RGGB")
        cfa = [["red", "green"], ["green", "blue"]]
        cal = equipix.calibrate(exposures(truth), CROSS, variance=np.full(5, NOISE**2), cfa=cfa)
        assert cal.metadata["options"]["cfa"] == cfa

    @pytest.mark.filterwarnings(NAMED)
    def test_without_a_cfa_the_pattern_is_named_and_nothing_flagged(self):
        truth, good = sensor("GBRG")
        cal = equipix.calibrate(exposures(truth), CROSS, variance=np.full(5, NOISE**2))
        np.testing.assert_array_equal(cal.flags == 0, good)
        (finding,) = cal.findings
        assert finding.kind == "cfa"
        assert "every 2 rows and 2 columns" in finding.message
        assert "cfa='GRBG' or cfa='GBRG'" in finding.message
        assert cal.cfa is None
        assert cal.colour_response is None
        assert np.abs(metrics.relative_error(cal.sensitivity, truth))[good].max() < 0.02

    @pytest.mark.filterwarnings(NAMED)
    @pytest.mark.parametrize(("pattern", "words"), [("AB/AB", "2 columns"), ("A/A/B", "3 rows")])
    def test_a_period_along_one_axis_is_named_as_read_out(self, pattern, words):
        truth, good = sensor(None)
        truth = simulate.filtered(truth, pattern, response={"A": 0.4, "B": 1.0})
        cal = equipix.calibrate(exposures(truth), CROSS, variance=np.full(5, NOISE**2))
        np.testing.assert_array_equal(cal.flags == 0, good)
        (finding,) = cal.findings
        assert words in finding.message
        assert "read-out" in finding.message
        assert "cfa=" not in finding.message

    @pytest.mark.parametrize("shape", [(12, 40), (8, 512), (15, 15)])
    def test_a_gradient_on_a_narrow_sensor_is_no_pattern(self, shape):
        light = 1000 * (1 + np.linspace(0, 0.3, shape[0])[:, None] + np.zeros(shape))
        light *= 1 + 0.01 * np.random.default_rng(1).standard_normal(shape)
        assert pattern_of(light) is None

    @pytest.mark.parametrize(
        ("given", "write"),
        [
            ("GRBG", r"cfa='RGGB' or cfa='BGGR'"),
            ("RRGG/RRGG/GGBB/GGBB", r"cfa='RGGB'"),
            ("BGGR", ""),
        ],
    )
    def test_a_pattern_that_mixes_colours_is_named(self, given, write):
        """Red and blue taken for the greens had no finding; red for blue cannot have one."""
        truth, _ = sensor("RGGB")
        frames, variance = exposures(truth), np.full(5, NOISE**2)
        if not write:
            assert equipix.calibrate(frames, CROSS, variance=variance, cfa=given).findings == ()
            return
        with pytest.warns(errors.MisfitWarning, match=f"pixels of one colour .* write {write}"):
            equipix.calibrate(frames, CROSS, variance=variance, cfa=given)

    def test_greens_that_differ_by_3_per_cent_are_one_colour(self):
        truth, _ = sensor("RGGB", dead=0)
        truth[::2, 1::2] *= 1.03
        cal = equipix.calibrate(exposures(truth), CROSS, variance=np.full(5, NOISE**2), cfa="RGGB")
        assert cal.findings == ()

    def test_greens_that_differ_by_more_are_those_of_the_pattern_that_is_named(self):
        truth, _ = sensor("RGGB", dead=0)
        truth[::2, 1::2] *= 1.08
        with pytest.warns(errors.MisfitWarning, match="write cfa='RGGB' or cfa='BGGR'"):
            equipix.calibrate(exposures(truth), CROSS, variance=np.full(5, NOISE**2))

    def test_a_monochrome_sensor_is_calibrated_as_ever(self):
        truth, good = sensor(None)
        frames = exposures(truth)
        alone = equipix.calibrate(frames, CROSS, variance=np.full(5, NOISE**2))
        given = equipix.calibrate(frames, CROSS, variance=np.full(5, NOISE**2), cfa="RGGB")
        assert alone.findings == ()
        assert alone.colour_response is None
        error = metrics.relative_error(given.sensitivity, alone.sensitivity, cfa="RGGB")
        # Two fits of the same data, each to the tolerance of 1e-6.
        assert np.abs(error[good]).max() < 2e-5

    @pytest.mark.parametrize("cfa", ["RGGB", None])
    @pytest.mark.filterwarnings(NAMED)
    def test_residuals_and_predictions_are_those_of_the_frames(self, cfa, tmp_path):
        truth, _ = sensor("RGGB", dead=0)
        frames = exposures(truth)
        variance = np.full(5, NOISE**2)
        cal = equipix.calibrate(frames, CROSS, variance=variance, cfa=cfa)
        squares = np.nansum(cal.residuals(frames, variance=variance) ** 2)
        assert squares == pytest.approx(cal.objective, rel=1e-9)
        cal.save(tmp_path / "cal.npz")
        again = equipix.load(tmp_path / "cal.npz")
        assert (again.cfa, again.colour_response) == (cal.cfa, cal.colour_response)
        np.testing.assert_array_equal(again.predict((3, 4)), cal.predict((3, 4)))
        (held_out,) = exposures(truth, noise=0, shifts=[(3, 4)])
        error = (cal.predict((3, 4)) - held_out) / held_out
        assert np.nanstd(error) < 3 * NOISE / 8000 / truth.min()

    def test_equal_weights_are_those_of_the_values(self):
        truth, good = sensor("RGGB")
        frames = exposures(truth)
        known = equipix.calibrate(frames, CROSS, variance=np.full(5, NOISE**2), cfa="RGGB")
        unknown = equipix.calibrate(frames, CROSS, cfa="RGGB")
        assert unknown.metadata["options"]["weights"] == "equal"
        assert unknown.reduced_chi2 == pytest.approx(NOISE**2 * known.reduced_chi2, rel=1e-6)
        np.testing.assert_allclose(
            unknown.sensitivity[good], known.sensitivity[good], rtol=0, atol=2e-5
        )

    def test_averages_are_weighted_by_the_noise_of_their_values(self):
        plain, good = sensor(None)
        light = simulate.gaussian_beam(SHAPE, width=200)
        virtual = simulate.experiment(
            plain, light, CROSS, frames=30, rng=3, cfa="RGGB", dead=0, hot=0, stage_error=0
        )
        dark = equipix.average(list(virtual.dark()))
        frames = [equipix.average(list(virtual.frames(k)), dark=dark) for k in range(5)]
        cal = equipix.calibrate(frames, CROSS, cfa="RGGB")
        np.testing.assert_array_equal(cal.flags == 0, good)
        freedom = 5 * plain.size - 2 * plain.size
        assert abs(cal.reduced_chi2 - 1) < 6 * np.sqrt(2 / freedom) + 0.02

    def test_a_corrected_frame_keeps_its_white_balance(self):
        truth, good = sensor("RGGB")
        cal = equipix.calibrate(exposures(truth), CROSS, variance=np.full(5, NOISE**2), cfa="RGGB")
        scene = 1000 * truth
        for flagged in ("nan", "replace"):
            corrected = cal.correct(scene, dark=None, flagged=flagged)
            for plane in planes("RGGB").values():
                usual = scene[plane & good].mean()
                inside = corrected[plane & (good if flagged == "nan" else True)]
                assert np.abs(inside / usual - 1).max() < 0.01

    def test_a_colour_that_varies_over_the_beam_is_a_finding(self):
        truth, _ = sensor("RGGB", dead=0)
        frames = exposures(truth)
        slope = np.linspace(-0.5, 0.5, SHAPE[1] + 19)
        for (_row, col), frame in zip(CROSS - CROSS.min(axis=0), frames, strict=True):
            red = planes("RGGB")["R"]
            frame[red] *= np.broadcast_to(1 + 0.03 * slope[col : col + SHAPE[1]], SHAPE)[red]
        with pytest.warns(errors.MisfitWarning, match="colours contradict one beam"):
            cal = equipix.calibrate(frames, CROSS, variance=np.full(5, NOISE**2), cfa="RGGB")
        (words,) = [each.message for each in cal.findings if each.kind == "colour"]
        assert "'mask'" in words
        assert "plan.suggest" in words

    @pytest.mark.long
    def test_each_colour_by_itself_has_a_beam_of_its_own(self):
        truth, _ = sensor("RGGB", dead=0)
        shifts = plan.suggest(SHAPE, 5, 12, cfa="RGGB", drift=1e-5)[0].shifts
        tint = {"R": (0.05, 0.0), "G": (0.0, 0.0), "B": (-0.03, 0.04)}
        frames = np.zeros((5, *SHAPE))
        for label, plane in planes("RGGB").items():
            down, right = tint[label]
            beam = simulate.tilted_beam(SHAPE, width=200, slope=(down, right))
            frames[:, plane] = 8000 * simulate.exposures(truth, beam, shifts)[:, plane]
        for plane in planes("RGGB").values():
            cal = equipix.calibrate(frames, shifts, mask=~plane)
            assert cal.components == 1
            error = metrics.relative_error(cal.sensitivity, np.where(plane, truth, np.nan))
            assert np.nanmax(np.abs(error)) < 1e-5


class TestUniformSource:
    LIGHT = (1000.0, 5000.0, 10_000.0, 16_000.0)

    def levels(self, truth, *, raw, rng=5):
        rng = np.random.default_rng(rng)
        dark = 200 + 5 * rng.standard_normal(SHAPE)
        camera = simulate.Camera(sensitivity=truth, dark=dark)
        off = equipix.average(list(camera.frames(np.zeros(SHAPE), 16, rng=rng)))
        return [
            equipix.average(
                list(camera.frames(np.full(SHAPE, each), 16, rng=rng)), dark=None if raw else off
            )
            for each in self.LIGHT
        ]

    @pytest.mark.parametrize("raw", [False, True])
    @pytest.mark.parametrize("cfa", ["GRBG", X_TRANS])
    def test_curves_are_those_of_a_colour(self, cfa, raw, tmp_path):
        truth, good = sensor(cfa)
        levels = self.levels(truth, raw=raw)
        response = nuc.fit(levels, cfa=cfa)
        np.testing.assert_array_equal(response.flags == 0, good)
        gain = np.where(good, truth, np.nan)
        wanted = 1 + metrics.relative_error(gain, np.ones(SHAPE), cfa=cfa)
        z = ((1 + response.deviation[1] - wanted) / np.sqrt(response.variances[1]))[good]
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=5 / np.sqrt(2 * z.size))
        corrected = response.correct(levels[2].mean, dark=None, flagged="replace")
        for plane in planes(cfa).values():
            usual = levels[2].mean[plane & good].mean()
            assert corrected[plane & good].mean() == pytest.approx(usual, rel=1e-3)
            assert corrected[plane].std() < 5
        response.save(tmp_path / "response.npz")
        again = equipix.load(tmp_path / "response.npz")
        assert (again.cfa, again.colour_response) == (response.cfa, response.colour_response)
        assert nuc.find_defects(response).counts["unusable"] == (~good).sum()

    @pytest.mark.parametrize("raw", [False, True])
    def test_without_a_cfa_the_pattern_is_named_and_nothing_flagged(self, raw):
        truth, good = sensor("RGGB")
        with pytest.warns(errors.MisfitWarning, match="cfa='RGGB' or cfa='BGGR'"):
            response = nuc.fit(self.levels(truth, raw=raw))
        np.testing.assert_array_equal(response.flags == 0, good)
        with pytest.warns(errors.MisfitWarning, match="cfa='RGGB' or cfa='BGGR'"):
            assert nuc.find_defects(response).counts["unusable"] == (~good).sum()
        assert nuc.find_defects(response, cfa="RGGB").counts["unusable"] == (~good).sum()

    def test_a_dark_colour_is_no_defect(self, run, tmp_path):
        """A filter that lets a twentieth through, which alone is like a pixel without response."""
        deep = {"R": 0.35, "G": 1.0, "B": 0.05}
        truth = simulate.filtered(simulate.paper_sensitivity(SHAPE, rng=1), "RGGB", response=deep)
        truth[20, 20] *= 0.2
        with pytest.warns(errors.MisfitWarning, match="cfa="):
            response = nuc.fit(self.levels(truth, raw=False), mask=truth < 0)
        path = tmp_path / "response.npz"
        response = dataclasses.replace(response, flags=np.zeros(SHAPE, np.uint32))
        response.save(path)
        with pytest.warns(errors.MisfitWarning, match="cfa="):
            found = nuc.find_defects(response)
        named = nuc.find_defects(response, cfa="RGGB")
        for each in (found, named):
            assert np.flatnonzero(each.flags).tolist() == [20 * SHAPE[1] + 20]
        status, out, err = run("nuc", "defects", path, "--json")
        assert (status, json.loads(out)["unusable"]) == (0, 1)
        assert "--cfa RGGB" in err
        flagged = tmp_path / "flagged.npz"
        status, _, err = run("nuc", "defects", path, "--cfa", "RGGB", "-o", flagged)
        assert (status, err) == (0, "")
        # The file keeps the filters, so that the red pixel is replaced by red ones.
        red = np.where(planes("RGGB")["R"], 2000, 1000) * truth
        for again in (equipix.load(flagged), response.with_flags(named.flags, cfa="RGGB")):
            for exact in (False, True):
                value = again.correct(red, dark=None, flagged="replace", exact=exact)
                np.testing.assert_allclose(value[20, 20], value[20, 18], rtol=0.01)
            nuc.find_defects(again)
            with pytest.raises(errors.InputError, match="'cfa' is 'BGGR', .* fitted with 'RGGB'"):
                again.with_flags(named.flags, cfa="BGGR")

    def test_another_pattern_than_that_of_the_response_is_refused(self):
        truth, _ = sensor("RGGB")
        response = nuc.fit(self.levels(truth, raw=False), cfa="RGGB")
        with pytest.raises(errors.InputError, match="'cfa' is 'BGGR', .* fitted with 'RGGB'"):
            nuc.find_defects(response, cfa="BGGR")

    def test_quality_is_measured_in_each_plane(self, run, tmp_path):
        array = simulate.StaringArray.of("InSb", (32, 32), rng=1).with_causes(cfa="RGGB")
        levels = [equipix.average(array.frames(e, 16, rng=k)) for k, e in enumerate((2e6, 1e7))]
        response = nuc.fit(levels, cfa="RGGB")
        assert not response.flags.any()
        response.save(tmp_path / "response.npz")
        frames = np.stack(list(array.frames(6e6, 8, rng=9)))
        write_frames(tmp_path / "level.tif", iter(frames), nbytes=1)
        given = ("nuc", "quality", tmp_path / "response.npz", tmp_path / "level.tif", "--json")
        status, out, _ = run(*given)
        found = json.loads(out)
        assert (status, {*found}) == (0, {"R", "G1", "G2", "B", "findings"})
        assert json.loads(run(*given, "--cfa", "RGGB")[1]) == found
        assert found.pop("findings") == []
        status, _, err = run(*given, "--cfa", "BGGR")
        assert status == 1
        assert "--cfa is 'BGGR', but the correction was fitted with 'RGGB'" in err
        cut = metrics.planes(response.correct(frames), "RGGB")
        for name, each in found.items():
            assert each["C"] == pytest.approx(metrics.correctability(cut[name]).ratio)
            assert each["C"] < 1


def test_a_staring_array_has_filters():
    array = simulate.StaringArray.of("InSb", (32, 32), rng=1)
    light, dark = array.electrons(1e6), array.electrons(0)
    seen = array.with_causes(cfa="GRBG").electrons(1e6)
    np.testing.assert_allclose(seen - dark, simulate.filtered(light - dark, "GRBG"), rtol=1e-9)
    with pytest.raises(errors.InputError, match="whose response is not known"):
        array.with_causes(cfa="CYYM")


class TestReplacement:
    @pytest.mark.parametrize("cfa", PATTERNS)
    def test_the_compiled_part_replaces_as_numpy_does(self, cfa):
        rng = np.random.default_rng(7)
        flags = np.where(rng.random(SHAPE) < 0.2, equipix.Flag.DO_NOT_USE, 0).astype(np.uint32)
        flags[8:14, 20:27] = equipix.Flag.DO_NOT_USE
        metadata = {"sensor": {"cfa": Colours.of(cfa).rows}}
        ones = np.stack([np.zeros(SHAPE), np.ones(SHAPE)])
        correction = equipix.Polynomial(ones, flags, metadata)
        scene = simulate.filtered(rng.uniform(900, 1100, SHAPE), cfa)
        fast = correction.correct(scene.astype(np.float32), flagged="replace")
        slow = correction.correct(scene, flagged="replace")
        # Float32, and sums of up to some tens of values in it.
        np.testing.assert_allclose(fast, slow, rtol=1e-5)
        for label, plane in planes(cfa).items():
            response = simulate.beams.COLOUR_RESPONSE[label]
            assert 900 * response <= slow[plane].min()
            assert slow[plane].max() <= 1100 * response


class TestOthers:
    def test_planes_have_one_colour_each(self):
        truth, _ = sensor("RGGB", dead=0)
        found = metrics.planes(np.stack([truth, truth]), "RGGB")
        assert {name: each.shape for name, each in found.items()} == dict.fromkeys(
            ("R", "G1", "G2", "B"), (2, 24, 28)
        )
        assert all(each.std() / each.mean() < 0.02 for each in found.values())
        with pytest.raises(errors.InputError, match="smaller than a period of 2×2"):
            metrics.planes(np.ones((1, 4)), "RGGB")

    def test_figures_of_a_camera_are_taken_plane_by_plane(self):
        truth, _ = sensor("RGGB", dead=0)
        rng = np.random.default_rng(3)
        dark = 50 + rng.standard_normal((16, *SHAPE))
        bright = dark[::-1] + 1000 * truth
        whole = metrics.emva_spatial(bright, dark, highpass=False)
        off, on = (metrics.planes(each, "RGGB") for each in (dark, bright))
        found = [metrics.emva_spatial(on[name], off[name], highpass=False) for name in off]
        assert whole.prnu.total > 0.3
        assert all(abs(each.prnu.total - 0.01) < 0.002 for each in found)

    def test_a_lens_is_fitted_to_all_colours(self):
        rows, cols = np.mgrid[:120, :160]
        flat = 1000 * cos4((rows - 62.0) ** 2 + (cols - 75.0) ** 2, 300.0)
        found = equipix.lens.fit(simulate.filtered(flat, X_TRANS), cfa=X_TRANS)
        assert found.focal_length == pytest.approx(300, rel=2e-3)

    def test_an_experiment_on_disk_names_its_filters(self, tmp_path, run):
        folder, output = tmp_path / "x", tmp_path / "cal.npz"
        args = ("--shape", 48, 64, "--frames", 8, "--cfa", "GRBG", "--bit-depth", 8)
        assert run("simulate", "-o", folder, *args)[0] == 0
        assert 'cfa = "GRBG"' in (folder / "experiment.toml").read_text()
        status, out, _ = run("calibrate", folder / "experiment.toml", "-o", output)
        assert status == 0
        assert "GRBG" in out
        cal = equipix.load(output)
        with np.load(folder / "truth.npz") as file:
            truth = dict(file)
        bad = np.zeros(cal.shape, bool)
        bad.flat[[*truth["dead"], *truth["hot"]]] = True
        assert not (cal.flags[~bad] != 0).any()
        assert cal.colour_response["R"] / cal.colour_response["G"] == pytest.approx(0.35, rel=0.02)

    @pytest.mark.parametrize(("cfa", "words"), [('"RGB"', "'RGB', expected four"), ("7", "cfa")])
    def test_a_wrong_pattern_in_a_manifest_is_named(self, tmp_path, cfa, words):
        path = tmp_path / "experiment.toml"
        path.write_text(f'[sensor]\ncfa = {cfa}\n[dark]\nframes = "d.tif"\n')
        with pytest.raises(errors.FileError, match=words):
            equipix.Experiment.load(path)

    def test_a_plan_states_both_counts(self, run):
        status, out, _ = run(
            "plan", "--shape", 48, 52, "--shifts", "0,0 0,11 0,19 11,0 19,0", "--cfa", "RGGB"
        )
        assert status == 0
        assert "36 (R 16, G 4, B 16)" in out


@pytest.mark.long
def test_the_examples_of_the_page_run():
    page = Path(__file__).parents[2] / "docs/colour.md"
    found = doctest.testfile(str(page), module_relative=False)
    assert found.attempted > 10
    assert found.failed == 0
