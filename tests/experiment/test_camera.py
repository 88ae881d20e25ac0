"""Cameras under levels of light: figures of EMVA 1288 against plain NumPy, truth and laws."""

from __future__ import annotations

import json
import re
import shutil
import tracemalloc

import numpy as np
import pytest
from PIL import Image

import equipix
from equipix import CameraExperiment, errors, metrics
from equipix.io.frames import read_frames
from equipix.io.tiff import write_frames
from equipix.metrics.emva import dark_lines, transfer_of
from equipix.report.camera import bounds_of, figures_of
from given import CAMERA, camera_levels, written_camera
from reference import emva

SEEDS = 12


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    return written_camera(tmp_path_factory.mktemp("camera"))


def figures(path):
    (found,) = CameraExperiment.load(path).figures().values()
    return found


@pytest.fixture(scope="module")
def found():
    """Figures of the virtual camera, from several draws of its noise."""
    levels = (camera_levels(seed) for seed in range(SEEDS))
    return [
        metrics.emva_transfer(on, off, photons, exposure_s=times)
        for on, off, photons, times in levels
    ]


class TestTruth:
    @pytest.mark.parametrize(
        ("name", "true"),
        [
            ("gain_dn_per_e", CAMERA["gain"]),
            ("read_noise_e", CAMERA["read"]),
            ("quantum_efficiency", CAMERA["efficiency"]),
            ("dark_noise_dn", np.sqrt((0.25 * 8) ** 2 + 1 / 12)),
            ("dark_current_mean", CAMERA["current"]),
            ("dark_current_variance", CAMERA["current"]),
            ("threshold_e", np.sqrt(8**2 + 1 / 12 / 0.25**2 + 0.25) + 0.5),
            ("threshold_light", (np.sqrt(8**2 + 1 / 12 / 0.25**2 + 0.25) + 0.5) / 0.6),
        ],
    )
    def test_it_comes_back_within_its_standard_error(self, found, name, true):
        values = [getattr(each, name) for each in found]
        error = np.std(values, ddof=1) / np.sqrt(SEEDS)
        # Student's t of 11 degrees of freedom is above 4.4 once in a thousand times.
        assert np.mean(values) == pytest.approx(true, abs=4.4 * error)
        assert error < 0.1 * true

    def test_saturation_is_that_of_the_well_but_for_the_distance_of_levels(self, found):
        step = 1.18 / 13 * CAMERA["well"]
        for each in found:
            assert CAMERA["well"] - step < each.saturation_e < CAMERA["well"] + step
            assert each.snr_max == pytest.approx(np.sqrt(each.saturation_e))
            ratio = each.saturation_light / each.threshold_light
            assert each.dynamic_range == pytest.approx(ratio)

    def test_at_the_threshold_the_signal_equals_its_noise(self, found):
        for each in found:
            assert each.snr(each.threshold_light) == pytest.approx(1)
            # Of many photons their noise alone is left, and of many more the unequal pixels.
            assert each.snr(1e9) == pytest.approx(
                np.sqrt(each.snr_max**2 * 1e9 / each.saturation_light), rel=1e-4
            )
            assert each.snr(1e15, prnu=0.01) == pytest.approx(100, rel=1e-4)
            weak = each.snr(each.threshold_light, dsnu_e=1e4)
            assert weak == pytest.approx(each.threshold_e / 1e4, rel=1e-4)

    def test_dark_noise_below_that_of_quantisation_counts_as_049_dn(self):
        levels = camera_levels(3, read=0.0, current=0.0)
        found = metrics.emva_transfer(*levels[:3], exposure_s=levels[3])
        assert found.dark_noise_dn < 0.4
        assert found.threshold_e == pytest.approx(
            np.sqrt(0.24 / found.gain_dn_per_e**2 + 0.25) + 0.5
        )

    def test_a_negative_estimate_of_dark_noise_counts_as_049_dn(self):
        on, off, photons, times = camera_levels(3)
        # The variance of the darks grows from 0 DN² at a time above 0: at 0 a line is below 0.
        rng, noise = np.random.default_rng(1), np.sqrt(0.05 + 40 * times / times.max())
        off = [100 + np.rint(each * rng.standard_normal((2, 48, 64))) for each in noise]
        found = metrics.emva_transfer(on, off, photons, exposure_s=times + times.max())
        assert found.dark_noise_dn < -1
        least = np.sqrt(0.24 / found.gain_dn_per_e**2 + 0.25) + 0.5
        assert found.threshold_e == pytest.approx(least)
        assert found.snr(found.threshold_light) == pytest.approx(1)

    def test_without_three_exposure_times_there_is_no_dark_current(self):
        on, off, photons, times = camera_levels(4)
        for given in (None, np.full(len(times), 0.01), np.resize([0.01, 0.02], len(times))):
            found = metrics.emva_transfer(on, off, photons, exposure_s=given)
            assert np.isnan([found.dark_current_mean, found.dark_current_variance]).all()
            noise = np.mean([emva.pair_moments(pair)[1] for pair in off])
            assert found.dark_noise_dn == pytest.approx(np.sqrt(noise))

    def test_lines_of_the_darks_are_those_of_least_squares(self):
        on, off, photons, times = camera_levels(4, shape=(16, 20))
        found = metrics.emva_transfer(on, off, photons, exposure_s=times)
        slopes, (_, noise) = np.polyfit(times, [emva.pair_moments(pair) for pair in off], 1)
        gain = found.gain_dn_per_e
        assert found.dark_noise_dn == pytest.approx(np.sqrt(noise))
        assert found.dark_current_mean == pytest.approx(slopes[0] / gain)
        assert found.dark_current_variance == pytest.approx(slopes[1] / gain**2)

    def test_times_that_hardly_differ_leave_the_noise_of_the_darks(self):
        on, off, photons, times = camera_levels(4, shape=(16, 20), current=0.0)
        rng = np.random.default_rng(1)
        times = 0.01 + 1e-6 * rng.standard_normal(len(times))
        found = metrics.emva_transfer(on, off, photons, exposure_s=times)
        assert np.isnan([found.dark_current_mean, found.dark_current_variance]).all()
        noise = np.mean([emva.pair_moments(pair)[1] for pair in off])
        assert found.dark_noise_dn == pytest.approx(np.sqrt(noise))

    def of_darks(self, off, times):
        """Figures of darks by their means and variances, at four levels of light."""
        return transfer_of(off + self.SIGNAL, off, np.arange(1.0, 5), times)

    SIGNAL = np.outer([100.0, 200, 300, 400], [1, 1])

    def test_three_times_determine_a_dark_current(self):
        times = np.array([1.0, 2.0, 3.0, 3.0])
        found = self.of_darks(np.stack([100 + times, 10 + 2 * times], axis=1), times)
        assert found.dark_current_mean == pytest.approx(1)
        assert found.dark_current_variance == pytest.approx(2)
        assert found.dark_noise_dn == pytest.approx(np.sqrt(10))

    def test_a_dark_that_is_quantised_bounds_the_noise(self):
        times = np.array([1.0, 2.0, 3.0, 4.0])
        found = self.of_darks(np.stack([100 + times, 0.19 + 0.01 * times], axis=1), times)
        assert found.dark_noise_dn == pytest.approx(np.sqrt(0.19))
        assert np.isnan(found.dark_current_variance)
        found = self.of_darks(np.stack([100 + times, [0.1, 9, 1, 5]], axis=1), times)
        assert found.dark_noise_dn == pytest.approx(np.sqrt(0.1))

    def test_a_signal_may_fall_by_5_percent(self):
        off, light = np.tile([100.0, 10.0], (4, 1)), np.array([1.0, 2.0, 3.0, 2.9])
        for fall, refused in ((0.049, False), (0.051, True)):
            on = off + np.stack([[60, 120, 180 * (1 - fall), 180], [60, 120, 180, 200]], axis=1)
            on = np.vstack([on, [400, 500]])
            given = on, np.vstack([off, off[:1]]), np.append(light, 5.0), None
            if refused:
                with pytest.raises(errors.InputError, match="is 2.9 at level 3 and 3 at level 2"):
                    transfer_of(*given)
            else:
                assert transfer_of(*given).saturation_dn == 300

    # A scatter a (1, -1, -1, 1) is orthogonal to a line over these times, and s² = 4 a²/2.
    EVEN, SCATTER = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, -1.0, -1.0, 1.0])

    @pytest.mark.parametrize("column", [0, 1])
    @pytest.mark.parametrize("slope", [1.0, -1.0])
    def test_a_slope_counts_up_to_its_own_error(self, column, slope):
        # t s/√Sxx with Sxx = 5.
        highest = np.sqrt(5) / (4.303 * np.sqrt(2))
        for share, known in ((0.99, True), (1.01, False)):
            off = np.array([100.0, 20.0]) + 1.0 * self.EVEN[:, None]
            off[:, column] += (slope - 1) * self.EVEN + share * highest * self.SCATTER
            found = self.of_darks(off, self.EVEN)
            slopes = found.dark_current_mean, found.dark_current_variance
            assert np.isfinite(slopes[column]) == known
            assert np.isfinite(slopes[1 - column])

    @pytest.mark.parametrize("one", [True, False])
    def test_darks_that_do_not_depend_on_the_time_give_no_dark_current(self, one):
        """Of one dark for all levels, and of others with noise of 3072 pixels."""
        times, known = np.linspace(0.5e-3, 10e-3, 14), []
        rng = np.random.default_rng(2)
        for _ in range(400):
            noise = np.zeros((14, 2)) if one else rng.standard_normal((14, 2))
            off = [100.1, 4.3] + noise * [np.sqrt(4 / 6144), 4 * np.sqrt(2 / 3072)]
            known.append(np.isfinite(dark_lines(times, off).slopes))
        # Errors of 95 % leave out at most 5 % of 800 slopes: with five standard errors.
        assert np.mean(known) <= (0 if one else 0.05 + 5 * np.sqrt(0.05 * 0.95 / 800))

    def test_a_dark_that_serves_several_levels_counts_once(self):
        """Repeated it was taken for more data: noise of three darks gave a dark current."""
        times, off = np.array([1.0, 2.0, 3.0]), np.array([[100, 4.0], [101, 5.0], [101, 4.5]])
        once = dark_lines(times, off)
        repeated = dark_lines(np.repeat(times, 10), np.repeat(off, 10, axis=0))
        assert np.isnan(once.slopes).all()
        for one, other in zip(once, repeated, strict=True):
            np.testing.assert_array_equal(one, other)

    @pytest.mark.parametrize(
        ("at_zero", "error", "noise"),
        [
            *((10.0, 4.95, 10.0), (10.0, 5.05, 15.0)),
            *((-10.0, 4.95, -10.0), (-10.0, 5.05, -5.0)),
            *((0.1, 0.11, 0.1), (-0.1, 0.11, 0.0), (-0.1, 0.13, 4.9)),
        ],
    )
    def test_the_variance_at_the_time_0_counts_up_to_its_own_error(self, at_zero, error, noise):
        """Positive up to half of it, or of 0.24 DN²; negative it is 0 up to twice its error."""
        # t s √(1/4 + 2.5²/5).
        size = error / (4.303 * np.sqrt(2) * np.sqrt(1.5))
        variance = at_zero + 2.0 * self.EVEN + size * self.SCATTER
        off = np.stack([100 + self.EVEN, variance], axis=1)
        found = dark_lines(self.EVEN, off).at_zero
        mean = at_zero + 5.0
        assert np.isnan(found) == (noise == mean)
        assert found == pytest.approx(np.nan if noise == mean else noise, nan_ok=True)

    @pytest.mark.parametrize("levels", [3, 4, 8, 14])
    def test_a_right_camera_with_much_dark_current_contradicts_no_times(self, levels):
        """Dark variances of 0.3 + 19 t DN², each of two frames of 16x20 pixels."""
        rng, times, negative = np.random.default_rng(1), np.linspace(0.02, 1.2, levels), 0
        for _ in range(1000):
            scatter = 1 + np.sqrt(2 / 320) * rng.standard_normal(levels)
            off = np.stack([100 + 4.75 * times, (0.3 + 19 * times) * scatter], axis=1)
            negative += dark_lines(times, off).at_zero < 0
        # Below -(twice the error of 95 %), of Student's t of one degree of freedom: in 1.3 %.
        assert negative <= 13 + 3 * np.sqrt(13)

    @pytest.mark.parametrize(
        ("darks", "times", "words"),
        [
            (14, np.ones(13), r"'exposure_s' has shape \(13,\), expected \(14,\)"),
            (14, np.full(14, np.nan), "'exposure_s' holds nan"),
            (1, np.ones(14), "'dark' has 1 entries, expected 14"),
        ],
    )
    def test_wrong_times_are_refused(self, darks, times, words):
        on, off, photons, _ = camera_levels(4)
        with pytest.raises(errors.InputError, match=words):
            metrics.emva_transfer(on, off[:darks], photons, exposure_s=times)


def pillow(files):
    return [np.asarray(Image.open(file)) for file in files]


@pytest.mark.long
@pytest.mark.data
def test_a_real_camera_has_the_figures_of_plain_numpy(data_dir, run):
    folder = data_dir / "emva1288-set001-ccd-12bit"
    groups = []
    for line in (folder / "EMVA1288_Data.txt").read_text().splitlines():
        kind, *words = line.split()
        if kind in ("b", "d"):
            groups.append((kind, [float(word) for word in words], []))
        elif kind == "i":
            groups[-1][2].append(folder / words[0].replace("\\", "/"))
    pairs = {
        kind: [each for each in groups if each[0] == kind and len(each[2]) == 2] for kind in "bd"
    }
    bright, dark = ([pillow(each[2]) for each in pairs[kind]] for kind in "bd")
    many = {each[0]: pillow(each[2]) for each in groups if len(each[2]) == 50}
    seconds, photons = np.array([each[1] for each in pairs["b"]]).T * [[1e-9], [1]]
    wanted = emva.figures(bright, dark, photons, seconds, many["b"], many["d"])
    status, out, told = run("emva", folder, "--json")
    assert (status, told) == (0, "")
    found = json.loads(out)
    assert (found.pop("output"), found.pop("bounds"), found.pop("findings")) == (None, {}, [])
    assert found.keys() == wanted.keys()
    # Sums of 15 million values in another order: some roundings of variances of 1e-2 of means.
    assert found == pytest.approx(wanted, rel=1e-8)
    # The figures in the README of the data, as far as their digits go.
    assert found["gain_dn_per_e"] == pytest.approx(0.28006, abs=5e-6)
    assert found["responsivity_dn_per_photon"] == pytest.approx(0.126727, abs=5e-7)
    assert found["quantum_efficiency_percent"] == pytest.approx(45.249, abs=5e-4)
    assert found["prnu_percent"] == pytest.approx(0.262, abs=5e-4)
    assert found["linearity_error_percent"] == pytest.approx(0.297, abs=5e-4)


def test_all_figures_are_those_of_plain_numpy(tmp_path):
    path = written_camera(tmp_path, 3, shape=(16, 20), count=18)
    bright, dark = ([read_frames(tmp_path / f"{kind}{k}.tif") for k in range(18)] for kind in "bd")
    many, many_dark = (read_frames(tmp_path / f"{kind}.tif") for kind in "bd")
    _, _, photons, times = camera_levels(3, shape=(1, 1), count=18)
    wanted = emva.figures(bright, dark, photons, times, many, many_dark)
    found = {each.key: each.value for each in figures_of(figures(path))}
    assert found == pytest.approx(wanted, rel=1e-9)


def test_files_have_the_figures_of_their_frames(camera):
    found = figures(camera)
    on, off, photons, times = camera_levels(1)
    wanted = metrics.emva_transfer(on, off, photons, exposure_s=times)
    np.testing.assert_allclose(
        list(vars(found.transfer).values())[:6], list(vars(wanted).values())[:6], rtol=1e-9
    )
    spatial = metrics.emva_spatial(
        *(read_frames(camera.parent / name) for name in ("b.tif", "d.tif")),
        gain_dn_per_e=wanted.gain_dn_per_e,
    )
    np.testing.assert_allclose(found.spatial.prnu, spatial.prnu, rtol=1e-6)
    assert found.findings == ()
    assert len(found.metadata["inputs"]) == 2 * 14 + 2 + 1


def test_each_plane_of_the_filters_has_its_own_figures(tmp_path):
    efficiency = np.tile([[0.3, 0.6], [0.55, 0.2]], (24, 32))
    path = written_camera(tmp_path, 5, cfa="RGGB", efficiency=efficiency)
    with pytest.warns(errors.InputWarning, match="plane [RB]: .* saturation is not reached"):
        found = CameraExperiment.load(path).figures()
    assert [*found] == ["R", "G1", "G2", "B"]
    on, off, photons, times = camera_levels(5, efficiency=efficiency)
    for k, each in enumerate(found.values()):
        cut = np.s_[:, k // 2 :: 2, k % 2 :: 2]
        wanted = metrics.emva_transfer(
            [s[cut] for s in on], [s[cut] for s in off], photons, exposure_s=times
        )
        assert each.transfer.gain_dn_per_e == pytest.approx(wanted.gain_dn_per_e, rel=1e-9)
        assert each.transfer.responsivity == pytest.approx(wanted.responsivity, rel=1e-9)
        # 768 pixels: a variance has 5 %, and eight levels average it.
        assert each.transfer.quantum_efficiency == pytest.approx(
            efficiency.flat[[0, 1, 64, 65][k]], rel=0.1
        )
        assert each.bright.shape == (24, 32)


def test_an_irradiance_gives_the_photons_of_the_standard(camera, tmp_path):
    """Photons are 50.34 A t λ E, of µm², ms, µm and µW/cm²."""
    text = camera.read_text()
    for name in ("frames", "dark"):
        text = text.replace(f'{name} = "', f'{name} = "{camera.parent}/')
    _, _, photons, times = camera_levels(1)
    for level, time in zip(photons.tolist(), times.tolist(), strict=True):
        irradiance = level / (50.34 * 5.5**2 * 1e3 * time * 0.53)
        text = text.replace(f"photons = {level!r}", f"irradiance_uw_cm2 = {irradiance!r}")
    path = tmp_path / "camera.toml"
    path.write_text("[light]\nwavelength_nm = 530\npixel_um = 5.5\n" + text)
    np.testing.assert_allclose(figures(path).photons, photons, rtol=2e-4)


def test_findings_name_what_limits_the_figures(tmp_path):
    path = written_camera(
        tmp_path,
        6,
        spatial=0,
        read=0.0,
        current=0.0,
        well=1e6,
        efficiency=0.007 * np.ones((48, 64)),
        gain=0.25,
    )
    with pytest.warns(errors.InputWarning) as said:
        found = figures(path)
    # There is no dark current, so that it is not determined.
    assert [each.kind for each in found.findings] == ["saturation", "spread", "quantisation"]
    assert len(said) == 3
    bounds = bounds_of(found)
    above = {"saturation_photons", "saturation_e"}
    above |= {
        f"{name}{form}" for name in ("snr_max", "dynamic_range") for form in ("", "_db", "_bits")
    }
    assert {key for key, each in bounds.items() if each == "above"} == above
    assert bounds["inverse_snr_max_percent"] == bounds["dark_noise_dn"] == "below"


def replaced(path, key, of):
    """A manifest with other numbers of a key."""
    text = re.sub(rf"{key} = (.*)", lambda at: f"{key} = {of(float(at[1]))!r}", path.read_text())
    path.write_text(text)
    return path


def small(folder, **options):
    return written_camera(folder, 3, **{"shape": (16, 20), "count": 18} | options)


@pytest.mark.filterwarnings("ignore::equipix.errors.EquipixWarning")
class TestFindings:
    """What limits the figures, from files of 16×20 pixels, and the figures that it concerns."""

    def kinds(self, path):
        return {each.kind: each.message for each in figures(path).findings}

    def test_times_that_hardly_differ(self, tmp_path):
        path = replaced(small(tmp_path, current=0.0), "exposure_s", lambda t: 0.01 + 1e-4 * t)
        said = self.kinds(path)
        assert [*said] == ["spread"]
        assert "times of 0.01 s and up to 2.75e-06 s more do not determine dark" in said["spread"]

    def test_a_dark_current_that_may_be_0_is_a_bound(self, tmp_path, run):
        path = small(tmp_path, current=0.0)
        found = json.loads(run("emva", path, "--json")[1])
        times, off = figures(path).exposure_s, figures(path).off
        # The upper end of a line's slope, by Student's t of 16 degrees of freedom.
        for column, by in enumerate(("mean", "variance")):
            (slope, _), covariance = np.polyfit(times, off[:, column], 1, cov=True)
            below = (slope + 2.1199 * covariance[0, 0] ** 0.5) / found["gain_dn_per_e"] ** (
                column + 1
            )
            assert found["bounds"][f"dark_current_{by}_e_per_s"] == "below"
            assert found[f"dark_current_{by}_e_per_s"] == pytest.approx(below, rel=1e-4)

    def test_times_that_contradict_the_noise(self, tmp_path, run):
        path = small(tmp_path, current=2e5, read=2.0)
        said = self.kinds(replaced(path, "exposure_s", lambda time: time + 0.02))
        assert "times" in said
        assert "quantisation" not in said
        assert "at the time 0, below 0 by more than twice its error" in said["times"]
        assert "'exposure_s'" in said["times"]
        found = json.loads(run("emva", path, "--json")[1])
        unknown = {key for key, value in found.items() if value is None} - {"output"}
        assert {key.partition("_")[0] for key in unknown} == {"dark", "threshold", "dynamic"}
        assert found["saturation_e"] > 0

    def test_quantisation_gives_the_bounds_of_the_standard(self, tmp_path, run):
        path = small(tmp_path, gain=0.01)
        assert "quantisation" in self.kinds(path)
        assert "DSNU is of rounded values, off by up to 0.5 DN" in run("emva", path)[2]
        found = json.loads(run("emva", path, "--json")[1])
        gain = found["gain_dn_per_e"]
        assert found["dark_noise_dn"] == pytest.approx(np.sqrt(0.24))
        assert found["dark_noise_e"] == pytest.approx(0.40 / gain, rel=0.02)
        assert found["threshold_e"] == pytest.approx(np.sqrt(0.24 / gain**2 + 0.25) + 0.5)
        assert found["dark_current_variance_e_per_s"] is None
        below = ("dark_noise_dn", "dark_noise_e", "threshold_photons", "threshold_e")
        above = ("dynamic_range", "dynamic_range_db", "dynamic_range_bits")
        assert found["bounds"] == dict.fromkeys(below, "below") | dict.fromkeys(above, "above")
        assert re.search(
            r"temporal dark noise with quantisation +DN +below 0\.4899", run("emva", path)[1]
        )

    def test_few_levels_and_frames(self, tmp_path):
        said = self.kinds(small(tmp_path, count=6, spatial=15))
        assert re.match(r"\d levels lie between 5 and 95 % .*limit 9", said["levels"])
        assert said["frames"].startswith("[spatial] has 15 frames with light and 15 without")

    @pytest.mark.parametrize(
        ("cfa", "words"),
        [
            (None, "every 2 rows and 2 columns by .* no 'cfa' is given in .sensor., .*'RGGB' or"),
            ("GRBG", "otherwise than 'cfa' in .sensor., 'GRBG', so planes .* write cfa='RGGB' or"),
            ("RGGB", None),
        ],
    )
    def test_colours_that_cfa_does_not_name(self, tmp_path, cfa, words):
        efficiency = np.tile([[0.45, 0.6], [0.6, 0.3]], (8, 10))
        path = small(tmp_path, cfa=cfa, efficiency=efficiency, spatial=0)
        found = CameraExperiment.load(path).figures()
        for each in found.values():
            said = [finding.message for finding in each.findings if finding.kind == "cfa"]
            assert [bool(re.search(words or "", one)) for one in said] == ([True] if words else [])

    def test_stripes_may_be_channels(self, tmp_path):
        efficiency = np.tile([[0.6, 0.55]], (16, 10))
        (said,) = figures(small(tmp_path, efficiency=efficiency, spatial=0)).findings
        assert (said.kind, said.severity) == ("cfa", "note")
        assert "every 2 columns by 9%, as channels of the read-out" in said.message

    def test_light_of_other_levels_is_named_by_its_exposures(self, tmp_path):
        path = replaced(small(tmp_path), "photons", lambda photons: 1e5 - photons)
        words = "the light in photons is .* at exposure '.*' and .* at exposure '.*', where"
        with pytest.raises(errors.FileError, match=words):
            figures(path)


def test_photons_in_another_unit_are_named(camera, tmp_path):
    text = camera.read_text().replace('= "', f'= "{camera.parent}/')
    text = text.replace(f'"{camera.parent}/RGGB', '"RGGB')
    path = tmp_path / "camera.toml"
    _, _, photons, _ = camera_levels(1)
    for level in photons.tolist():
        text = text.replace(f"photons = {level!r}", f"photons = {level / 100!r}")
    path.write_text(text)
    with pytest.warns(errors.InputWarning, match=r"quantum efficiency is \d+.* \(limit 1\.1\)"):
        found = figures(path)
    assert np.isnan(found.transfer.quantum_efficiency)
    words = {each.key: each.number for each in figures_of(found)}
    assert {key for key, each in words.items() if each == "needs photons"} == {
        *("responsivity_dn_per_photon", "quantum_efficiency_percent"),
        *("threshold_photons", "saturation_photons"),
    }


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::equipix.errors.InputWarning")  # few levels
@pytest.mark.usefixtures("hashing_by_one_thread")
def test_memory_does_not_grow_with_frames_and_levels(tmp_path):
    peaks = []
    few, many = {"count": 6, "spatial": 2}, {"count": 24, "frames": 8, "spatial": 32}
    for k, options in enumerate((few, many)):
        folder = tmp_path / str(k)
        folder.mkdir()
        loaded = CameraExperiment.load(written_camera(folder, 7, shape=(120, 160), **options))
        tracemalloc.start()
        loaded.figures(workers=1)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # Each mean of a level that was kept would add an image of 16 bits or more, 36 in all. Names and
    # settings of 36 files more, of 1 kB each, are below one.
    assert peaks[1] < peaks[0] + 120 * 160 * 2


class TestDescriptor:
    """EMVA1288_Data.txt, line by line."""

    @pytest.fixture
    def folder(self, tmp_path):
        on, off, photons, times = camera_levels(8, count=6)
        lines = ["# a comment", "v 3.0", "n 12 64 48"]
        for kind, stacks in (("b", on), ("d", off)):
            for k, stack in enumerate(stacks):
                values = [times[k] * 1e9, photons[k]] if kind == "b" else [times[k] * 1e9]
                lines.append(" ".join([kind, *(f"{each:.0f}" for each in values)]))
                for j, frame in enumerate(stack):
                    name = f"images/{kind}_{k}_{j}.tif"
                    (tmp_path / "images").mkdir(exist_ok=True)
                    write_frames(tmp_path / name, frame[None], nbytes=frame.nbytes)
                    lines.append(f"i {name}".replace("/", "\\"))
        (tmp_path / "EMVA1288_Data.txt").write_text("\n".join(lines) + "\n")
        return tmp_path

    def test_it_gives_levels_and_their_darks(self, folder):
        loaded = CameraExperiment.load(folder)
        assert loaded.path == folder / "EMVA1288_Data.txt"
        assert loaded.manifest.sensor.bit_depth == 12
        first = loaded.manifest.exposure[0]
        assert (first.name, first.dark) == ("line 4", ["images/d_0_0.tif", "images/d_0_1.tif"])
        words = r"3 levels lie between 5 and 95 % of saturation \(limit 9\)"
        with pytest.warns(errors.InputWarning, match=words):
            found = loaded.figures()[""]
        assert found.spatial is None
        assert found.transfer.gain_dn_per_e == pytest.approx(0.25, rel=0.2)

    @pytest.mark.parametrize(
        ("before", "after", "words"),
        [
            ("b_0_1.tif", "b_0_9.tif", r"line 6: 'images/b_0_9\.tif' does not exist"),
            ("\nd 466", "\nd 467", r"line 4: there are no dark images of 466667 ns"),
            ("b 466667 467", "b 466667", "line 4: holds 'b 466667', expected 'b' with .*photons"),
            ("b 466667 467", "b 466667 x", "line 4: holds 'b 466667 x', expected 'b' with"),
            (
                "b 466667 467",
                "b 466667 -3",
                r"'photons' in \[\[exposure\]\] 1 \('line 4'\) holds -3",
            ),
            ("n 12 64 48", "n 12", "line 3: holds 'n 12', expected 'n' with bits"),
            ("v 3.0", "x 3.0", "line 2: holds 'x 3.0', expected a line of"),
            ("i images\\b_0_1.tif\n", "", "line 4: names 1 images, expected two or more"),
            ("b_0_1.tif", "b_0_0.tif", r"'b_0_0.tif' stands twice in 'frames' of .* 'line 4'"),
            (
                "b_0_1.tif",
                "b_1_1.tif",
                r"stands in 'frames' of exposure 'line 4' and in .* 'line 7'",
            ),
            ("n 12", "n 8", r"'b_1_0.tif' of .*'line 7' holds means up to .* 'bit_depth' = 8"),
        ],
    )
    def test_mistakes_are_named_with_their_line(self, folder, before, after, words):
        path = folder / "EMVA1288_Data.txt"
        text = path.read_text()
        assert before in text
        path.write_text(text.replace(before, after, 1))
        with pytest.raises(errors.FileError, match=words) as caught:
            CameraExperiment.load(folder).figures()
        assert str(caught.value).startswith(str(path))

    def test_an_image_of_another_shape_is_named(self, folder, run):
        write_frames(folder / "images/b_2_1.tif", np.ones((1, 9, 9), np.uint16), nbytes=162)
        status, _, told = run("emva", folder)
        assert status == 1
        assert "EMVA1288_Data.txt, 'frames' of exposure 'line 10': " in told
        assert "images/b_2_1.tif: holds uint16 frames of shape (9, 9), expected" in told

    def test_a_folder_without_a_description_is_named(self, tmp_path, run):
        (tmp_path / "empty").mkdir()
        status, _, told = run("emva", tmp_path / "empty")
        assert status == 1
        assert "holds neither EMVA1288_Data.txt nor camera.toml, expected one of them" in told


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("photons = 466.6666666666667\n", "", r"give either 'photons' or .* in \[\[exposure\]\] 1"),
        ('dark = "d0.tif"\n', "", r"key 'dark' is missing in \[\[exposure\]\] 1"),
        ("photons = 466.6666666666667\n", "irradiance_uw_cm2 = 3.0\n", r"needs a table \[light\]"),
        ('"b0.tif"', '"none.tif"', "none.tif: does not exist"),
        ('"d0.tif"', '"b0.tif"', "'b0.tif' stands in 'frames' of .* and in 'dark'"),
        (
            "bit_depth = 12",
            "saturation = 4000.0",
            r"'saturation' in \[sensor\] is not for a camera",
        ),
        (
            "bit_depth = 12",
            "bit_depth = 12\ndark_temperature_tolerance_c = 2",
            r"'dark_temperature_tolerance_c' in \[sensor\] is not for a camera",
        ),
        ("exposure_s = ", "exposure_s = -", r"'exposure_s' in \[\[exposure\]\] 1 holds -0.0"),
    ],
)
def test_mistakes_in_a_camera_toml_are_named(camera, before, after, words):
    text = camera.read_text()
    assert before in text
    path = camera.parent / "wrong.toml"
    path.write_text(text.replace(before, after, 1))
    with pytest.raises(errors.FileError, match=words) as caught:
        CameraExperiment.load(path)
    assert str(caught.value).startswith(str(path))


def test_a_level_of_one_frame_is_named(camera, tmp_path):
    one = read_frames(camera.parent / "b3.tif")[:1]
    write_frames(tmp_path / "one.tif", one, nbytes=one.nbytes)
    path = camera.parent / "one.toml"
    path.write_text(camera.read_text().replace('"b3.tif"', f'"{tmp_path}/one.tif"'))
    with pytest.raises(
        errors.FileError, match=r"one.toml, 'frames' of exposure '4': 'frames' has 1"
    ):
        CameraExperiment.load(path).figures()


def test_one_dark_may_serve_several_levels(camera):
    path = camera.parent / "same.toml"
    text = camera.read_text()
    for k in range(1, 14):
        text = text.replace(f'"d{k}.tif"', '"d0.tif"')
    path.write_text(text)
    # Equal darks at all times determine no dark current.
    with pytest.warns(errors.InputWarning, match=" do not determine dark current by the mean"):
        assert figures(path).transfer.gain_dn_per_e == pytest.approx(0.25, rel=0.1)


@pytest.mark.parametrize(
    ("file", "copied", "at"),
    [
        ("b9.tif", "d3.tif", "'dark' of exposure '4' and in 'frames' of exposure '10'"),
        ("b9.tif", "b2.tif", "'frames' of exposure '3' and in 'frames' of exposure '10'"),
        ("b9.tif", "b.tif", r"'frames' of exposure '10' and in 'frames' of table 'spatial'"),
    ],
)
def test_copies_of_files_are_refused(camera, tmp_path, file, copied, at):
    shutil.copytree(camera.parent, tmp_path, dirs_exist_ok=True)
    shutil.copy(tmp_path / copied, tmp_path / file)
    with pytest.raises(errors.FileError, match=rf"are the same images, and stand in {at}: give"):
        CameraExperiment.load(tmp_path / camera.name).figures()


def test_images_of_saturated_levels_may_be_equal(camera, tmp_path):
    """All pixels of a camera of few bits are at the largest value, but for a dead one."""
    shutil.copytree(camera.parent, tmp_path, dirs_exist_ok=True)
    frames = np.full_like(read_frames(camera.parent / "b12.tif"), 4095)
    frames[:, 3, 4] = 0
    for file in ("b12.tif", "b13.tif"):
        write_frames(tmp_path / file, frames, nbytes=frames.nbytes)
    assert figures(tmp_path / camera.name).transfer.gain_dn_per_e == pytest.approx(0.25, rel=0.1)


def test_averages_stand_for_their_frames(camera):
    path = camera.parent / "averaged.toml"
    equipix.average(camera.parent / "b5.tif", saturation=4095).save(camera.parent / "b5.npz")
    path.write_text(camera.read_text().replace('"b5.tif"', '"b5.npz"'))
    assert figures(path).transfer == figures(camera).transfer
