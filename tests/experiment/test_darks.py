"""Several darks: the one that fits an exposure is taken, one between two is interpolated."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import tifffile
from astropy.io import fits

import equipix
from equipix import Experiment, LevelExperiment, errors, metrics, simulate
from equipix.comparison import _waves
from equipix.io.formats import FrameFile
from equipix.io.frames import Settings, apart, settings
from equipix.measured.means import Averaged
from equipix.measured.settings import mixed, settings_in, settings_of
from given import write_dng

SHAPE = (64, 80)
SHIFTS = equipix.cross_pattern(5, 7)
DARK_TIMES, TIMES = (0.5, 1.0, 4.0), (1.0, 1.0, 2.0, 2.0, 3.0)
GAIN, READ_NOISE, BIAS = 0.25, 3.0, 100.0


class Camera:
    """A camera whose dark current differs between pixels, in DN/s, and its sensitivity."""

    def __init__(self, seed=1):
        self.rng = np.random.default_rng(seed)
        self.truth = simulate.paper_sensitivity(SHAPE, rng=self.rng)
        self.current = self.rng.uniform(20, 60, SHAPE)
        beam = simulate.gaussian_beam(SHAPE, width=200, amplitude=2000)
        self.light = simulate.exposures(self.truth, beam, SHIFTS)

    def frames(self, light, time, count):
        mean = BIAS + self.current * time + light * time
        noise = np.sqrt(READ_NOISE**2 + GAIN * (mean - BIAS))
        values = mean + noise * self.rng.standard_normal((count, *SHAPE))
        return np.rint(values).astype(np.uint16)


def entry(kind, frames, **keys):
    lines = [f"[[{kind}]]", f'frames = "{frames}"']
    return "\n".join([*lines, *(f"{key} = {value}" for key, value in keys.items())]) + "\n\n"


def written(folder, camera, dark_count=40, times=TIMES, dark_times=DARK_TIMES):
    """Write an experiment of exposures of several times; return its manifest."""
    text = "[sensor]\nbit_depth = 16\n\n"
    for time in dark_times:
        np.save(folder / f"dark{time}.npy", camera.frames(0, time, dark_count))
        text += entry("dark", f"dark{time}.npy", exposure_s=time)
    for k, (time, light) in enumerate(zip(times, camera.light, strict=True)):
        np.save(folder / f"{k}.npy", camera.frames(light, time, 20))
        own = {"name": f'"p{k}"', "shift": SHIFTS[k].tolist(), "flux": time, "exposure_s": time}
        text += entry("exposure", f"{k}.npy", **own)
    (folder / "experiment.toml").write_text(text)
    return folder / "experiment.toml"


@pytest.fixture(scope="module")
def camera():
    return Camera()


@pytest.fixture(scope="module")
def manifest(camera, tmp_path_factory):
    return written(tmp_path_factory.mktemp("darks"), camera)


def edited(manifest, *changes):
    """The manifest with changes, beside it."""
    text = manifest.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = manifest.parent / "edited.toml"
    path.write_text(text)
    return path


def refused(manifest, words, *changes):
    with pytest.raises(errors.FileError, match=words):
        Experiment.load(edited(manifest, *changes)).run(max_sweeps=1)


@pytest.mark.parametrize("dark_count", [40, 4])
def test_the_truth_is_found_within_the_stated_errors(tmp_path, dark_count):
    """Also with few dark frames, whose noise is then as large as that of the exposures."""
    camera = Camera(2)
    cal = Experiment.load(written(tmp_path, camera, dark_count)).run(uncertainty=True)
    error = metrics.relative_error(cal.sensitivity, camera.truth) * cal.sensitivity
    z = float(np.sqrt(np.nanmean(np.square(error / cal.sensitivity_std))))
    # By the draws of the error map, and by the waves of M that errors of 5120 pixels consist of.
    exactness = cal.metadata["uncertainty"]["relative_standard_error"]
    scatter = np.hypot(
        exactness,
        (2 * _waves(cal, np.isfinite(cal.sensitivity), without_tilt=False, side=1)) ** -0.5,
    )
    assert z == pytest.approx(1, abs=4 * scatter)
    # 3 * 5120 degrees of freedom: five standard errors.
    assert cal.reduced_chi2 == pytest.approx(1, abs=0.06)
    assert cal.dark is None
    with pytest.raises(errors.InputError, match="holds no dark frame"):
        cal.correct(camera.frames(camera.light[0], 1.0, 1)[0])


@pytest.mark.parametrize("times", [(1.0, 2.0, 3.0, 5.0, 10.0), (1.0, 1.0, 2.0, 2.0, 3.0)])
def test_darks_of_each_time_give_no_misfit(tmp_path, times):
    """Their frames have noise of their own, by dark current, and some exposures share one.

    With the noise of one for all, and the largest that two share for all, χ² was 0.9 and 1.1.
    """
    cal = Experiment.load(written(tmp_path, Camera(3), 4, times, sorted(set(times)))).run()
    assert cal.reduced_chi2 == pytest.approx(1, abs=0.06)  # five standard errors
    assert cal.findings == ()


@pytest.mark.study
def test_a_linear_sensor_has_no_finding_at_several_times(tmp_path, draws, figure):
    times, chi2, false = (1.0, 2.0, 3.0, 5.0, 10.0), [], 0
    seeds = draws(60)
    for seed in seeds:
        dark_times = (times, (1.0, 10.0), (1.0, 4.0, 10.0))[seed % 3]
        count = (2, 4, 20)[seed // 3 % 3]
        manifest = written(tmp_path, Camera(100 + seed), count, times, dark_times)
        cal = Experiment.load(manifest).run(tolerance=1e-4)
        chi2.append(cal.reduced_chi2)
        false += any(each.concern == "misfit" for each in cal.findings)
    figure("χ² of exposures of several times", float(np.mean(chi2)), "0.97 to 1.03")
    figure("false findings at several times", f"{false} of {len(seeds)}", "at most 1 %")
    # 3 % is the deviation that does no harm (`equipix.diagnosis.misfit`).
    assert abs(np.mean(chi2) - 1) < 0.03 + 3 * np.std(chi2, ddof=1) / len(seeds) ** 0.5
    assert false <= 0.01 * len(seeds) + 3 * (0.01 * len(seeds)) ** 0.5


def test_one_between_two_is_interpolated_with_its_variance(manifest):
    low, high = (
        equipix.average(manifest.parent / f"dark{time}.npy", saturation=65535)
        for time in DARK_TIMES[1:]
    )
    cal = Experiment.load(manifest).run(tolerance=1e-3)
    frames = equipix.average(manifest.parent / "2.npy", saturation=65535)
    wanted = frames.mean - (2 / 3 * low.mean + 1 / 3 * high.mean)  # 2 s between 1 s and 4 s
    np.testing.assert_allclose(cal.weighted.exposures.values[2], wanted, rtol=1e-6, atol=1e-3)
    assert cal.metadata["darks"][::2] == [
        "[[dark]] 2 (1 s)",
        "0.6667 of [[dark]] 2 (1 s) + 0.3333 of [[dark]] 3 (4 s)",
        "0.3333 of [[dark]] 2 (1 s) + 0.6667 of [[dark]] 3 (4 s)",
    ]
    found = mixed([low, high], (2 / 3, 1 / 3))
    np.testing.assert_allclose(
        found.variance_of_mean, 4 / 9 * low.variance_of_mean + 1 / 9 * high.variance_of_mean
    )
    # 40 frames of each: 1/(4/9 + 1/9) times as many.
    assert np.unique(found.count).tolist() == [72]


@pytest.mark.parametrize(
    ("time", "shares"), [(1.0, {1.0: 1.0}), (2.5, {1.0: 0.5, 4.0: 0.5}), (3.98, {4.0: 1.0})]
)
def test_one_dark_that_all_exposures_take_is_that_of_the_result(tmp_path, camera, time, shares):
    """Whether it is one of several, to 1 % of the time, or between two of them."""
    cal = Experiment.load(written(tmp_path, camera, times=[time] * 5)).run(uncertainty=True)
    means = [share * equipix.average(tmp_path / f"dark{t}.npy").mean for t, share in shares.items()]
    np.testing.assert_array_equal(cal.dark, sum(means).astype(np.float32))
    assert cal.reduced_chi2 == pytest.approx(1, abs=0.06)  # five standard errors


def test_a_single_dark_is_the_same_with_and_without_keys(tmp_path, camera):
    manifest = written(tmp_path, camera, times=[1.0] * 5)
    rest = manifest.read_text().partition("[[exposure]]")[2]
    bare = "".join(line for line in rest.splitlines(True) if not line.startswith("exposure_s"))
    results = []
    for head, exposures in (
        ('[dark]\nframes = "dark1.0.npy"\n\n[[exposure]]', bare),
        ('[[dark]]\nframes = "dark1.0.npy"\n\n[[exposure]]', bare),
        ('[dark]\nframes = "dark1.0.npy"\ntemperature_c = -10\n\n[[exposure]]', bare),
        ('[dark]\nframes = "dark1.0.npy"\nexposure_s = 1.0\n\n[[exposure]]', rest),
    ):
        manifest.write_text(head + exposures)
        results.append(Experiment.load(manifest).run(tolerance=1e-3))
    for other in results[1:]:
        for name in ("sensitivity", "dark", "flags", "beam"):
            np.testing.assert_array_equal(getattr(other, name), getattr(results[0], name))


def variances_of(shares, counts=(4, 8)):
    """Variance that is common, and what each exposure has beside it, with a noise of 2 DN."""
    darks = []
    for k, count in enumerate(counts):
        frames = np.random.default_rng(k).standard_normal((count, 9, 12))
        # A mean sample variance of 4 DN² to rounding: none has more noise than the other.
        darks.append(equipix.average(100 + 2 * frames / frames.var(axis=0, ddof=1).mean() ** 0.5))
    averaged = Averaged(count=len(shares), darks=tuple(darks))
    rng = np.random.default_rng(9)
    for each in shares:
        frames = equipix.average(rng.normal(500, 9, (4, 9, 12)), dark=mixed(darks, each))
        averaged.add(frames, "", each)
    noise = equipix.NoiseModel(2.0, 0.0)
    own = [each.dark_variance for each in averaged.models(noise)]
    return float(np.median(averaged.dark_variance(noise))), own


@pytest.mark.parametrize(
    ("shares", "common", "own"),
    [
        ([(1.0, 0.0)] * 3, 1.0, [0, 0, 0]),  # 4/4 DN²
        ([(0.5, 0.5)] * 2, 0.25 + 0.125, [0, 0]),
        ([(1.0, 0.0), (0.0, 1.0)], 0.0, [1.0, 0.5]),
        # One pair of three, of 1 and 0.5 DN².
        ([(1.0, 0.0), (1.0, 0.0), (0.0, 1.0)], 1 / 3, [2 / 3, 2 / 3, 1 / 6]),
        ([(0.0, 1.0), (0.0, 1.0), (1.0, 0.0)], 1 / 6, [1 / 3, 1 / 3, 5 / 6]),
        ([(1.0, 0.0), (0.5, 0.5)], 0.5, [0.5, 0]),
    ],
)
def test_what_exposures_have_in_common_of_their_darks(shares, common, own):
    found_common, found_own = variances_of(shares)
    assert found_common == pytest.approx(common, rel=1e-12, abs=1e-12)
    assert found_own == pytest.approx(own, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("words", "changes"),
    [
        (
            r"no dark fits exposure 'p4' of 5 s: .* have 0.5, 1, 4 s, .* not extrapolated",
            [("flux = 3.0\nexposure_s = 3.0", "flux = 3.0\nexposure_s = 5")],
        ),
        (
            r"'exposure_s' of exposure 'p4' is not known, and the \[\[dark\]\] have 0.5, 1, 4 s",
            [("flux = 3.0\nexposure_s = 3.0", "flux = 3.0")],
        ),
        (r"'exposure_s' of \[\[dark\]\] 1 is not known: write it", [("exposure_s = 0.5\n", "")]),
        (
            r"\[\[dark\]\] 1 and \[\[dark\]\] 2 do not differ: write 'exposure_s' or",
            [("exposure_s = 0.5\n", "exposure_s = 1.0\n")],
        ),
        (
            r"\[\[dark\]\] 1 and \[\[dark\]\] 2 do not differ",
            [("exposure_s = 0.5\n", "exposure_s = 1.001\n")],
        ),
        (
            r"no dark fits exposure 'p0' of -12 °C within 0.5 K: they have -10 °C",
            [
                ('.npy"\nexposure_s', '.npy"\ntemperature_c = -10\nexposure_s'),
                ('name = "p0"\n', 'name = "p0"\ntemperature_c = -12\n'),
            ],
        ),
        (
            r"'temperature_c' of exposure 'p0' is not known, .* have -10, -20 °C: write it",
            [
                ("exposure_s = 0.5\n", "exposure_s = 0.5\ntemperature_c = -10\n"),
                ('dark1.0.npy"\n', 'dark1.0.npy"\ntemperature_c = -20\n'),
                ('dark4.0.npy"\n', 'dark4.0.npy"\ntemperature_c = -10\n'),
            ],
        ),
        (
            r"'exposure_s' in \[\[dark\]\] 2 holds -1.0, expected a number of seconds",
            [('dark1.0.npy"\nexposure_s = 1.0', 'dark1.0.npy"\nexposure_s = -1.0')],
        ),
        (
            r"'dark1.0.npy' stands in \[\[dark\]\] 1 and in \[\[dark\]\] 2",
            [("dark0.5.npy", "dark1.0.npy")],
        ),
        (r"unknown key 'time' in \[\[dark\]\] 1", [("exposure_s = 0.5\n", "time = 0.5\n")]),
    ],
)
def test_what_does_not_fit_is_named(manifest, words, changes):
    refused(manifest, words, *changes)


def test_the_tolerance_of_the_temperature_can_be_raised(manifest):
    path = edited(
        manifest,
        ("bit_depth = 16\n", "bit_depth = 16\ndark_temperature_tolerance_c = 2\n"),
        ('.npy"\nexposure_s', '.npy"\ntemperature_c = -10\nexposure_s'),
        ('name = "p0"\n', 'name = "p0"\ntemperature_c = -12\n'),
    )
    Experiment.load(path).run(tolerance=1e-2)


def test_the_nearest_temperature_is_taken(manifest):
    """Of two darks of one exposure time."""
    path = edited(
        manifest,
        ("exposure_s = 0.5\n", "exposure_s = 1.0\ntemperature_c = -10.3\n"),
        ('dark1.0.npy"\n', 'dark1.0.npy"\ntemperature_c = -10.0\n'),
        ('dark4.0.npy"\n', 'dark4.0.npy"\ntemperature_c = -10.2\n'),
    )
    text = path.read_text()
    path.write_text(text.replace("flux = ", "temperature_c = -10.1\nflux = "))
    cal = Experiment.load(path).run(tolerance=1e-2)
    frames, dark = (equipix.average(manifest.parent / f"{name}.npy") for name in (0, "dark1.0"))
    wanted = frames.mean - dark.mean
    np.testing.assert_allclose(cal.weighted.exposures.values[0], wanted, rtol=1e-6, atol=1e-3)


def fits_levels(folder, camera, *, stated="", dark_times=(1.0, 4.0)):
    """Levels of light by exposure time, as FITS files with headers; and their manifest."""
    text = "[sensor]\nbit_depth = 16\n\n"
    for kind, times in (("dark", dark_times), ("level", (1.0, 2.0, 3.0))):
        for time in times:
            light = 0 if kind == "dark" else 1000.0 * camera.truth
            header = fits.Header({"EXPTIME": time, "CCD-TEMP": -10 + 0.05 * time, "SET-TEMP": -11})
            frames = camera.frames(light, time, 8)
            name = f"{kind}{time:g}.fits"
            fits.writeto(folder / name, frames, header, overwrite=True)
            text += entry(kind, name) + (stated if name == "level2.fits" else "")
    (folder / "levels.toml").write_text(text)
    return folder / "levels.toml"


def test_headers_of_fits_files_give_what_the_manifest_leaves_out(tmp_path, camera):
    path = fits_levels(tmp_path, camera)
    assert settings(tmp_path / "level2.fits") == Settings(2.0, -9.9)
    response = LevelExperiment.load(path).run()
    darks = [equipix.average(tmp_path / f"dark{time}.fits", saturation=65535) for time in (1, 4)]
    for k, shares in enumerate([(1.0, 0.0), (2 / 3, 1 / 3), (1 / 3, 2 / 3)]):
        raw = equipix.average(tmp_path / f"level{k + 1}.fits", saturation=65535)
        mean = (raw.mean - mixed(darks, shares).mean).mean()
        assert response.levels[k] == pytest.approx(mean, rel=1e-4)
    assert response.dark is None
    assert not response.leaves_offset
    # Light without dark is proportional to the exposure time, so lines hold.
    # One degree of freedom in each of 5120 pixels: 2 %, and a model of the noise from 8 frames.
    assert np.nanmean(response.reduced_chi2) == pytest.approx(1, abs=0.1)


def test_averages_and_results_keep_what_their_darks_were_taken_with(tmp_path, camera):
    path = fits_levels(tmp_path, camera, dark_times=(1.0,))
    average = equipix.average(tmp_path / "dark1.fits", saturation=65535)
    average.save(tmp_path / "master.tif")
    assert settings_of(FrameFile(tmp_path / "master.tif")) == Settings(1.0, -9.95)
    assert settings_in(mixed([average] * 2, (0.5, 0.5)).metadata) == Settings(1.0, -9.95)
    path.write_text(path.read_text().replace("dark1.fits", "master.tif"))
    with pytest.warns(errors.InputWarning, match="dark. was taken with the exposure time 1 s"):
        known = LevelExperiment.load(path).run(order=0).metadata["dark_settings"]
    assert known == {"exposure_s": 1.0, "temperature_c": -9.95}


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        (
            "exposure_s = 3\n\n",
            r"'level2.fits' holds 2 s, but 'exposure_s' of level '2' is 3 s: correct 'exposure_s'",
        ),
        (
            "temperature_c = -12\n\n",
            r"'level2.fits' holds -9.9 °C, but 'temperature_c' of level '2' is -12 °C",
        ),
    ],
)
def test_a_header_that_contradicts_the_manifest_is_named(tmp_path, camera, stated, words):
    path = fits_levels(tmp_path, camera, stated=stated)
    with pytest.raises(errors.FileError, match=words):
        LevelExperiment.load(path).run()


def test_a_single_dark_of_other_settings_is_a_finding(tmp_path, camera):
    path = fits_levels(tmp_path, camera, dark_times=(16.0,))
    words = (
        r"\[dark\] was taken with the exposure time 16 s, level '1' with 1 s by its files, and "
        r"likewise 2 more, .* give dark frames of 1 s; .* one \[\[dark\]\] for each exposure time"
    )
    warm = r"\[dark\] was taken with the temperature -9.2 °C, level '1' with -9.95 °C .*limit 0.5 K"
    with pytest.warns(errors.InputWarning, match=words), pytest.warns(match=warm):
        response = LevelExperiment.load(path).run()
    assert [each.kind for each in response.findings][:2] == ["other_dark"] * 2
    assert response.metadata["levels"][0]["dark"] == "[dark] (16 s, -9.2 °C)"


def test_frames_of_one_average_have_one_exposure_time(tmp_path, camera, run):
    fits_levels(tmp_path, camera)
    output = tmp_path / "mean.tif"
    status, _, err = run("average", tmp_path / "dark*.fits", "-o", output)
    assert status == 1
    assert "dark1.fits' holds the exposure time 1 s, '" in err
    assert "dark4.fits' 4 s, expected one: average the frames of each" in err
    assert not output.exists()


def test_an_average_says_what_its_dark_was_taken_with(tmp_path, camera, run):
    fits_levels(tmp_path, camera)
    with fits.open(tmp_path / "level1.fits") as units:
        units[0].header["CCD-TEMP"] = -12
        units.writeto(tmp_path / "level1-cold.fits")
    lights, output = [tmp_path / "level1.fits", tmp_path / "level1-cold.fits"], tmp_path / "m.tif"
    status, _, err = run("average", *lights, "--dark", tmp_path / "dark4.fits", "-o", output)
    assert status == 0
    assert "'level1-cold.fits' was taken at -12 °C, 'level1.fits' at -9.95 °C (limit 0.5 K)" in err
    assert "--dark was taken with the exposure time 4 s, 'level1.fits' with 1 s" in err
    assert [each.kind for each in equipix.load(output).findings][:2] == [
        "temperature",
        "other_dark",
    ]


@pytest.mark.parametrize(
    ("name", "shown", "words"),
    [
        ("dark.fits", "Light Frame", r"'dark.fits' in \[dark\] is 'Light .*, expected dark frames"),
        ("p1.fits", "Dark Frame", r"'p1.fits' in 'frames' of exposure 'p1' is 'Dark Frame' by its"),
        ("p0.fits", "zero", r"is 'zero' by its header"),
        ("p0.fits", "bias", r"is 'bias' by its header \(IMAGETYP\), expected frames with light"),
    ],
)
def test_a_header_of_another_type_of_image_is_named(tmp_path, name, shown, words):
    text = "[sensor]\nbit_depth = 16\n\n" + entry("dark", "dark.fits")
    for k, each in enumerate(("dark.fits", "p0.fits", "p1.fits")):
        shift = f'name = "p{k - 1}"\nshift = [0, {k}]\n'
        text += entry("exposure", each) + shift if k else ""
        header = fits.Header({"IMAGETYP": shown} if each == name else {})
        fits.writeto(tmp_path / each, np.full((16, 20), 100 + k, np.uint16), header)
    (tmp_path / "experiment.toml").write_text(text)
    with pytest.raises(errors.FileError, match=words):
        Experiment.load(tmp_path / "experiment.toml").run()


def test_a_level_may_be_dark_frames_and_its_dark_no_light(tmp_path, camera):
    path = fits_levels(tmp_path, camera)
    fits.setval(tmp_path / "level1.fits", "IMAGETYP", value="DARK")
    fits.setval(tmp_path / "dark1.fits", "IMAGETYP", value="zero")
    LevelExperiment.load(path).run()
    fits.setval(tmp_path / "dark1.fits", "IMAGETYP", value="FLAT")
    with pytest.raises(errors.FileError, match=r"'dark1.fits' in .* is 'FLAT' by its header"):
        LevelExperiment.load(path).run()


def test_files_of_one_entry_that_contradict_one_another_are_named(tmp_path, camera):
    path = fits_levels(tmp_path, camera)
    path.write_text(path.read_text().replace('"level2.fits"', '["level2.fits", "level3.fits"]', 1))
    path.write_text(path.read_text().replace('[[level]]\nframes = "level3.fits"\n', ""))
    words = (
        r"the files of level '2' have different values of the exposure time: 'level2.fits' holds "
        r"2 s, 'level3.fits' 3 s: give each exposure time a table of its own"
    )
    with pytest.raises(errors.FileError, match=words):
        LevelExperiment.load(path).run()


@pytest.mark.parametrize(
    ("times", "known"),
    [
        ({"EXPTIME": -1.0}, None),
        ({"EXPTIME": -1.0, "EXPOSURE": 2.0}, 2.0),
        ({"EXPTIME": 0.0}, 0.0),
        ({"EXPTIME": "2"}, None),
    ],
)
def test_a_time_below_0_in_a_header_is_not_known(tmp_path, times, known):
    for name in ("a.fits", "b.fits"):
        header = fits.Header(times | {"CCD-TEMP": -10.0})
        fits.writeto(tmp_path / name, np.ones((16, 20), np.float32), header)
    assert settings(tmp_path / "a.fits") == Settings(known, -10.0)
    found = equipix.average(tmp_path / "*.fits")
    assert found.metadata.get("exposure_s") == known
    assert found.findings == ()


@pytest.mark.parametrize(("index", "near", "far"), [(0, 1.009, 1.011), (1, 1.4, 1.6)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_settings_differ_beyond_their_tolerance(index, near, far, sign):
    """Times by 1 % of the larger, temperatures by what is stated; of either sign."""
    for other, differ in ((1.0, False), (near, False), (far, True), (None, False)):
        pair = sign, None if other is None else sign * other
        assert apart(index, *pair, 0.5) is apart(index, *pair[::-1], 0.5) is differ


def test_exif_and_tags_give_the_exposure_time(tmp_path):
    frame = np.zeros((8, 9), np.uint16)
    tifffile.imwrite(
        tmp_path / "a.tif", frame, photometric="minisblack", extratags=[(33434, "2I", 1, (1, 60))]
    )
    assert settings(tmp_path / "a.tif") == Settings(1 / 60)
    # A tag that is no ratio tells nothing; a page with it is read all the same.
    for tags in ([], [(33434, "f", 1, 0.5)]):
        tifffile.imwrite(tmp_path / "b.tif", frame, photometric="minisblack", extratags=tags)
        assert settings(tmp_path / "b.tif") == Settings()
    assert settings(write_dng(tmp_path / "c.dng", np.zeros((100, 122), np.uint16))).exposure_s == (
        pytest.approx(1 / 50)
    )
    np.save(tmp_path / "d.npy", frame)
    assert settings(tmp_path / "d.npy") == Settings()


def write_exif(path, order, time, *, big=False):
    """Write a TIFF with an EXIF directory behind its frame, in the byte order "<" or ">"."""
    offset, count, entry = ("Q", "Q", "HHQ") if big else ("I", "H", "HHI")
    tifffile.imwrite(
        path,
        np.arange(72, dtype=np.uint16).reshape(8, 9),
        byteorder=order,
        bigtiff=big,
        photometric="minisblack",
        metadata=None,
        extratags=[(65000, offset, 1, 0, True)],
    )
    with tifffile.TiffFile(path) as file:
        tag = file.pages[0].tags[65000]
    content = bytearray(path.read_bytes())
    start = len(content)
    struct.pack_into(f"{order}H", content, tag.offset, 34665)  # which tifffile does not write
    struct.pack_into(f"{order}{offset}", content, tag.valueoffset, start)
    head = struct.pack(f"{order}{count}{entry}", 1, 33434, 5, 1)
    ratio, last = struct.pack(f"{order}2I", *time), struct.pack(f"{order}{offset}", 0)
    if big:  # a ratio fits into its entry
        path.write_bytes(content + head + ratio + last)
    else:
        behind = struct.pack(f"{order}I", start + len(head) + 4 + len(last))
        path.write_bytes(content + head + behind + last + ratio)
    return path


@pytest.mark.parametrize("order", "<>")
def test_the_compiled_reader_finds_exif(tmp_path, order, monkeypatch):
    one, other, third = (
        write_exif(tmp_path / f"{k}.tif", order, time)
        for k, time in enumerate([(1, 60), (3, 0), (1, 30)])
    )
    big = write_exif(tmp_path / "big.tif", order, (1, 60), big=True)
    assert settings(big) == Settings(1 / 60)  # by tifffile
    monkeypatch.setattr(tifffile, "TiffFile", None)
    assert [settings(each) for each in (one, other)] == [Settings(1 / 60), Settings()]
    assert equipix.average([one, other]).metadata["exposure_s"] == 1 / 60
    with pytest.raises(errors.FileError, match=r"'.*0.tif' holds the exposure time 0.0166667 s"):
        equipix.average([one, third])


def test_a_broken_exif_is_named(tmp_path):
    path = write_exif(tmp_path / "a.tif", "<", (1, 60))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(errors.FileError, match=r"a.tif: (is broken|cannot be read): "):
        settings(path)


def test_a_stack_of_another_program_is_no_saved_average(tmp_path):
    """It may hold JSON of its own, as tifffile writes the shape."""
    stack = np.ones((3, 16, 20), np.float32)
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack")
    assert settings_of(FrameFile(tmp_path / "stack.tif")) == Settings()


@pytest.mark.filterwarnings("ignore::equipix.errors.InputWarning")
def test_exposure_times_need_no_dark(tmp_path, camera):
    path = fits_levels(tmp_path, camera, stated="exposure_s = 2.0\n", dark_times=())
    assert LevelExperiment.load(path).run(order=0).dark is None
