"""Experiments on disk: what is measured from the files, and what is refused."""

from __future__ import annotations

import hashlib
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from equipix import (
    CameraExperiment,
    Experiment,
    Flag,
    FrameStatistics,
    LevelExperiment,
    errors,
    load,
    metrics,
    simulate,
)
from equipix.experiment import experiment as experiment_run
from equipix.fitting.weighted import weighted_fit
from equipix.io.frames import read_frames
from equipix.measured.defects import dead_pixels, hot_pixels
from equipix.measured.means import Averaged
from equipix.measured.noise import NoiseModel, photon_transfer, scatter_limit

SHAPE = (64, 80)
SHIFTS = [(0, 0), (0, 5), (0, 7), (5, 0), (7, 0)]


@pytest.fixture(scope="module")
def virtual():
    sensitivity = simulate.cosine_sensitivity(SHAPE, rng=1)
    beam = simulate.gaussian_beam(SHAPE, width=200)
    return simulate.experiment(sensitivity, beam, SHIFTS, frames=12, rng=5)


@pytest.fixture(scope="module")
def manifest(virtual, tmp_path_factory):
    return virtual.write(tmp_path_factory.mktemp("experiment") / "whole")


@pytest.fixture(scope="module")
def calibration(manifest):
    return Experiment.load(manifest).run(tolerance=1e-5)


@pytest.fixture
def edited(manifest, tmp_path):
    """The manifest with one text replaced by another, its files where they were."""

    def edit(old, new):
        text = manifest.read_text()
        assert old in text
        text = re.sub(r'"(\w+/[^"]*\.tif)"', rf'"{manifest.parent}/\1"', text.replace(old, new, 1))
        path = tmp_path / "experiment.toml"
        path.write_text(text)
        return path

    return edit


def rms(error):
    return np.sqrt(np.nanmean(error**2))


# What comes out


def test_truth_is_found_within_the_noise(calibration, virtual):
    truth = np.where(virtual.camera.good, virtual.truth.sensitivity, np.nan)
    error = metrics.relative_error(calibration.sensitivity, truth)
    # 5112 pixels: the rms of the error scatters by 1/sqrt(2 * 5112) = 1 %, that of 20 blocks by
    # 16 %, and the prediction of four draws by half of that: 5 and 4 standard deviations.
    predicted, predicted_blocks = virtual.noise_prediction(rng=3)
    assert rms(error) == pytest.approx(predicted, rel=0.06)
    assert rms(metrics.block_means(error)) < 1.7 * predicted_blocks


def test_bad_pixels_are_flagged_and_no_others(calibration, virtual):
    flags = calibration.flags.ravel()
    bad = np.union1d(virtual.truth.dead, virtual.truth.hot)
    np.testing.assert_array_equal(np.flatnonzero(flags), bad)
    assert (flags[bad] & Flag.DO_NOT_USE).all()
    assert (flags[virtual.truth.dead] & Flag.DEAD).all()
    assert (flags[virtual.truth.hot] & Flag.HOT).all()
    assert np.isnan(calibration.sensitivity.ravel()[bad]).all()


def test_noise_of_the_camera_is_recovered(calibration, virtual):
    noise, camera = calibration.metadata["noise"], virtual.camera
    # The variance of one pixel of 12 frames scatters by sqrt(2/11) = 0.43; over 5120 pixels that
    # is 0.6 % of the dark variance, and over 5 exposures 0.27 % of the photon noise: 5 of these.
    assert noise["gain"] == pytest.approx(camera.gain_dn_per_e, rel=0.014)
    read_noise = np.hypot(camera.gain_dn_per_e * camera.read_noise_e, np.sqrt(1 / 12))
    assert noise["read_noise"] == pytest.approx(read_noise, rel=0.015)
    # So the model explains the residuals: 3 * 5112 - ... degrees of freedom, 5 deviations.
    assert calibration.reduced_chi2 == pytest.approx(1, abs=0.05)


def test_origin_is_stored(calibration, manifest):
    metadata = calibration.metadata
    assert metadata["exposures"] == ["p0", "p1", "p2", "p3", "p4"]
    assert len(metadata["inputs"]) == 1 + 1 + 5 + 8
    digest = hashlib.sha256((manifest.parent / "frames/p3.tif").read_bytes()).hexdigest()
    assert metadata["inputs"]["frames/p3.tif"] == digest
    assert metadata["options"]["tolerance"] == 1e-5
    assert metadata["started"] <= metadata["finished"]


def test_stored_dark_corrects_frames(calibration, virtual, tmp_path):
    calibration.save(tmp_path / "cal.tif")
    loaded = load(tmp_path / "cal.tif")
    frame = next(virtual.frames(0))
    np.testing.assert_array_equal(loaded.correct(frame), calibration.correct(frame))
    good = virtual.camera.good
    np.testing.assert_allclose(calibration.dark[good], virtual.truth.dark[good], atol=6)


def test_measured_shifts_are_the_stage_s(manifest, virtual):
    shifts, std = Experiment.load(manifest).measure_shifts()
    assert (std[0] == 0).all()
    # Errors of successive moves add in quadrature.
    assert (np.diff(std, axis=0) > 0).all()
    # Non-uniformity of 5 % moves a spot by hundredths of a pixel beside the random error.
    np.testing.assert_allclose(shifts, virtual.truth.shifts, atol=0.1)


@pytest.mark.long
def test_moves_are_measured_again_with_a_part_of_the_sensor(tmp_path, monkeypatch):
    """As well as with all of it: both leave the noise of the images."""
    truth = simulate.paper_sensitivity((400, 420), rng=1)
    beam = simulate.gaussian_beam(truth.shape, width=300)
    virtual = simulate.experiment(truth, beam, SHIFTS, frames=8, aperture_frames=8, rng=2)
    experiment, fitted, found = Experiment.load(virtual.write(tmp_path / "it")), [], {}

    def fit(exposures, *arguments):
        fitted.append(exposures.shape)
        return weighted_fit(exposures, *arguments)

    monkeypatch.setattr(experiment_run, "weighted_fit", fit)
    found["part"] = experiment.run(tolerance=1e-4).metadata
    monkeypatch.setattr(experiment_run, "region_of_spots", lambda *_: None)
    found["whole"] = experiment.run(tolerance=1e-4).metadata
    part, whole = fitted
    assert part < whole == truth.shape
    for metadata in found.values():
        error = np.array(metadata["measured_shifts"]) - virtual.truth.shifts
        std = np.array(metadata["measured_shift_std"])
        assert np.abs(error[1:] / std[1:]).max() < 4  # of eight numbers: one in 2000
    shifts, std = (
        [np.array(each[key]) for each in found.values()]
        for key in ("measured_shifts", "measured_shift_std")
    )
    # The images are the same: what differs is the error of M, in either.
    assert (np.abs(shifts[0] - shifts[1]) < std[0].max() / 2).all()


@pytest.mark.long
def test_the_second_measurement_of_shifts_gains(tmp_path, monkeypatch):
    """Six sensors in a narrow beam; calibrated with the shifts as measured once, and twice."""
    measured = experiment_run.measured_moves

    def once(path, manifest, *_, hot):
        return measured(path, manifest, hot=hot)

    errors_of, scores, blocks = ([], []), [], ([], [], [])
    for seed in range(6):
        truth = simulate.paper_sensitivity(SHAPE, rng=seed)
        beam = simulate.gaussian_beam(SHAPE, width=50)
        virtual = simulate.experiment(
            truth, beam, SHIFTS, frames=24, aperture_frames=24, dead=0, hot=0, rng=50 + seed
        )
        experiment = Experiment.load(virtual.write(tmp_path / str(seed)))
        for k in (0, 1):
            with monkeypatch.context() as patch:
                if k == 0:
                    patch.setattr(experiment_run, "measured_moves", once)
                found = experiment.run(tolerance=1e-4)
            error = np.array(found.metadata["measured_shifts"]) - virtual.truth.shifts
            errors_of[k].append(error[1:])
            of_m = metrics.relative_error(found.sensitivity, truth)
            blocks[k].append(rms(metrics.block_means(of_m)))
        blocks[2].append(virtual.noise_prediction(rng=seed)[1])
        scores.append(errors_of[1][-1] / np.array(found.metadata["measured_shift_std"])[1:])
    # Pixels uneven by 5 %, 0.029 rms, become uneven by what noise leaves of M, some 1e-3. The noise
    # of the images stays.
    assert rms(np.array(errors_of[1])) < rms(np.array(errors_of[0])) / 4
    # Six times eight sums over one to four moves, as good as some 24 numbers: 3/√48.
    assert rms(np.array(scores)) == pytest.approx(1, abs=0.43)
    # 120 blocks scatter by 7 % in the rms, the prediction of 4 draws each by half of that: 2.5 σ.
    first, second, noise = (rms(np.array(each)) for each in blocks)
    assert second == pytest.approx(noise, rel=0.2)
    assert first > 1.5 * second


def with_fluxes(manifest, edited, last):
    """The manifest with the fluxes 1, 1, 1, 1 and one that need not be true."""
    fluxes = iter([1, 1, 1, 1, last])
    text = manifest.read_text()
    return edited(
        text, re.sub(r"frames = \"frames", lambda m: f"flux = {next(fluxes)}\n{m[0]}", text)
    )


@pytest.mark.parametrize("factor", [3, 100])
def test_a_wrong_flux_spoils_the_spots_and_is_named(edited, manifest, factor):
    """They are doubled, or too uncertain: the shifts are then those of the images as taken."""
    experiment = Experiment.load(with_fluxes(manifest, edited, factor))
    with warnings.catch_warnings(record=True, action="always") as said:
        cal = experiment.run(max_sweeps=60)
    assert [each.message.kind for each in said][:2] == ["aperture", "flux"]
    wanted = f"exposure 'p4' has {1 / factor:.2g} times the light that its flux says"
    assert wanted in str(said[0].message)
    shifts, std = experiment.measure_shifts()
    np.testing.assert_array_equal(cal.metadata["measured_shifts"], shifts)
    np.testing.assert_array_equal(cal.metadata["measured_shift_std"], std)


def test_spots_that_no_flux_has_spoilt_are_refused(manifest, monkeypatch):
    measured = iter([experiment_run.measured_moves])

    def once(*arguments, **options):
        for measure in measured:
            return measure(*arguments, **options)
        raise errors.SpotError("a doubled spot")

    monkeypatch.setattr(experiment_run, "measured_moves", once)
    with pytest.raises(errors.SpotError, match="a doubled spot"):
        Experiment.load(manifest).run(tolerance=1e-4)


def test_turned_exposures_are_placed_by_the_aperture():
    """Numbers of the rotation formula: the same hole before and after a turn."""
    from equipix.exposures.positions import in_beam, variance_in_beam

    shape, hole, shift = (30, 40), np.array([20.0, 25.0]), np.array([3.0, 5.0])
    for turns in range(4):
        window = (shape[1], shape[0]) if turns % 2 else shape
        beam = np.zeros((80, 80))
        beam[20, 25] = 1
        seen = np.rot90(beam[3 : 3 + window[0], 5 : 5 + window[1]], turns)
        assert seen.shape == shape
        position = np.argwhere(seen)[0].astype(float)
        np.testing.assert_array_equal(in_beam(position, 90 * turns, shape) + shift, hole)
        variance = variance_in_beam(np.array([0.01, 0.04]), 90 * turns)
        expected = [0.04, 0.01] if turns % 2 else [0.01, 0.04]
        np.testing.assert_allclose(variance, expected)


def test_given_shifts_and_fluxes_are_used(edited, manifest):
    text = manifest.read_text()
    for k, (row, col) in enumerate(SHIFTS):
        text = text.replace(
            f'frames = "frames/p{k}.tif"',
            f'frames = ["frames/p{k}.tif"]\nflux = {1 + k / 10}\nshift = [{row}, {col}.0]',
        )
    text = re.sub(r"aperture_\w+ = .*\n", "", text)
    path = edited(manifest.read_text(), text)
    # The fluxes are not those of the frames, so two products leave M undetermined.
    with (
        pytest.warns(errors.IdentifiabilityWarning, match="far from its minimum"),
        pytest.warns(errors.ConvergenceWarning),
    ):
        calibration = Experiment.load(path).run(max_sweeps=2)
    np.testing.assert_array_equal(calibration.shifts, SHIFTS)
    np.testing.assert_allclose(calibration.flux, [1, 1.1, 1.2, 1.3, 1.4])


def test_coordinate_descent_rounds_a_fraction_of_a_pixel_with_a_warning(edited):
    path = edited('aperture_before = "aperture/p1-before.tif"', "shift = [0.0, 5.3]")
    path.write_text(re.sub(r"aperture_after = .*p1-after.*\n", "", path.read_text()))
    with (
        pytest.warns(errors.InputWarning, match="rounded to whole pixels: that of exposure 'p3'"),
        pytest.warns(errors.ConvergenceWarning),
    ):
        Experiment.load(path).run(method="coordinate-descent", max_sweeps=2)


@pytest.mark.parametrize(
    ("shift", "flux", "words"),
    [
        ("[100, 0]", "1", "'shifts' of exposure 'p1' is .* row part must be smaller"),
        ("[0, 5]", "1e60", "'flux' of exposure 'p1' is 1.*expected a positive number"),
    ],
)
@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning", "ignore:overflow")
def test_errors_on_an_exposure_have_its_name(edited, manifest, shift, flux, words):
    text = re.sub(r"aperture_\w+ = .*p1.*\n", "", manifest.read_text())
    text = re.sub(r"(name = .*)", r"\1\nflux = 1", text).replace("flux = 1\n", "", 1)
    text = text.replace('name = "p1"\nflux = 1', f'name = "p1"\nflux = {flux}\nshift = {shift}')
    with pytest.raises(errors.InputError, match=words):
        Experiment.load(edited(manifest.read_text(), text)).run(max_sweeps=2)


def test_progress_names_the_stages(manifest):
    stages = []
    with pytest.warns(errors.ConvergenceWarning):
        Experiment.load(manifest).run(
            max_sweeps=3, progress=lambda *report: stages.append(report[2])
        )
    assert {"averaging dark", "averaging p0", "averaging p4"} < set(stages)


@pytest.mark.data
def test_real_input(data_dir):
    """The figures wanted of data/experiment-320x240, in the gauge mean 1 over good pixels."""
    truth = np.load(data_dir / "experiment-320x240-truth.npz")
    experiment = Experiment.load(data_dir / "experiment-320x240/experiment.toml")
    calibration = experiment.run(tolerance=1e-5)
    bad = np.union1d(truth["dead"], truth["hot"])
    np.testing.assert_array_equal(np.flatnonzero(calibration.flags), bad)
    error = metrics.relative_error(calibration.sensitivity, truth["sensitivity"])
    assert rms(error) < 1.30e-3
    assert rms(metrics.block_means(error)) < 1.8e-4
    # Unequal pixels move a centroid by 0.008 pixel, a shift after two moves by 0.016.
    np.testing.assert_allclose(calibration.shifts, truth["shifts"], atol=4 * 0.016)


# What is refused


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[sensor]", "[sensro]", r"unknown key 'sensro'"),
        ("bit_depth", "bits", r"unknown key 'bits' in \[sensor\]"),
        (
            'name = "p1"',
            'name = "p1"\nshift_std = 1',
            r"'shift_std' in \[\[exposure\]\] 2 \('p1'\)",
        ),
        (
            'name = "p1"',
            'name = "p1"\nflux_std = 1',
            r"'flux_std' is given without 'flux' in \[\[exposure\]\] 2",
        ),
        (
            'name = "p1"',
            'name = "p1"\ntime = 1',
            r"'time' is missing in exposure 'p0': give all or none",
        ),
        ('name = "p1"', 'name = "p1"\nshifts = [1, 2]', r"'shifts' .*: did you mean 'shift'\?"),
        (
            "bit_depth = 12",
            "bit_dept = 12",
            r"'bit_dept' in \[sensor\]: did you mean 'bit_depth'\?",
        ),
        ("[dark]", "[drak]", r"unknown key 'drak': did you mean 'dark'\?"),
        ("bit_depth = 12", "xyz = 1", r"'xyz' in \[sensor\]: known are name, bit_depth, "),
        ('name = "p1"', 'name = "p1"\nshift_um = [1, 2]', r"'shift_um' .* divide micrometres"),
        ('name = "p0"', 'name = "p0"\nshift = ["9 um", "0 um"]', r"holds '9 um'.* without a unit"),
        ('name = "p2"', "", r"key 'name' is missing in \[\[exposure\]\] 3"),
        ("bit_depth = 12", "bit_depth = 17", r"holds 17, expected a whole number from 1 to 16"),
        (
            "bit_depth = 12",
            "bit_depth = 12\nsaturation = 4096",
            r"is 4096, above 4095, the largest",
        ),
        ("bit_depth = 12", "saturation = -1", r"'saturation' in \[sensor\] holds -1"),
        ("bit_depth = 12", "gain_dn_per_e = 'x'", r"'gain_dn_per_e' in \[sensor\] holds 'x'"),
        ('name = "p1"', 'name = "p1"\nrotation = 45', r"holds 45, expected 0, 90, 180 or 270"),
        ('name = "p1"', 'name = "p1"\nflux = 0', r"'flux' in \[\[exposure\]\] 2 \('p1'\) holds 0"),
        ('name = "p1"', 'name = "p1"\nflux = 1', r"'flux' is missing in exposure 'p0'"),
        ('name = "p1"', 'name = "p0"', r"two exposures have the name 'p0'"),
        ('name = "p1"', 'name = "p1"\nshift = [1, 2]', r"not both in \[\[exposure\]\] 2 \('p1'\)"),
        ('name = "p0"', 'name = "p0"\nshift = [1]', r"\[row, col\] in pixels"),
        ('name = "p0"', 'name = "p0"\nshift = [1, nan]', r"holds nan, expected \[row, col\]"),
        ('aperture_after = "aperture/p1-after.tif"', "", r"both 'aperture_before' and"),
        ("# calibration", "format = 2\n# calibration", r"'format' holds 2, expected 1"),
        ("[dark]", "[dark", r"is not valid TOML"),
        ("bit_depth = 12", 'cfa = "RGBX"', r"'RGBX', expected the letters R, G, B, W, C, M, Y"),
        ('frames = "dark/dark.tif"', "", r"key 'frames' is missing in \[dark\]"),
        ('"frames/p1.tif"', "[]", r"'frames' in \[\[exposure\]\] 2 \('p1'\) holds \[\]"),
        ('"frames/p1.tif"', '"frames/none.tif"', r"frames/none\.tif: does not exist"),
        ('"frames/p1.tif"', '"frames/none*.tif"', r"frames/none\*\.tif: no file matches"),
    ],
)
def test_a_wrong_manifest_is_refused_by_name(edited, old, new, message):
    path = edited(old, new)
    with pytest.raises(errors.FileError, match=message) as caught:
        Experiment.load(path)
    assert str(path) in str(caught.value)
    assert "pydantic" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mistake_of_all_exposures_is_said_once(manifest, tmp_path):
    text = manifest.read_text()
    path = tmp_path / "experiment.toml"
    path.write_text(re.sub(r'name = "p(\d)"', r'name = "p\1"\nshfit = [0, 1]\nflux = -\1', text))
    with pytest.raises(errors.FileError) as caught:
        Experiment.load(path)
    problems = str(caught.value).removeprefix(f"{path}: ").split("; ")
    assert problems == [
        "'flux' in [[exposure]] 1 ('p0') holds 0, expected a positive number, and likewise in 4 "
        "more",
        "unknown key 'shfit' in [[exposure]] 1 ('p0'), and likewise in 4 more: did you mean "
        "'shift'?",
    ]


def test_a_glob_is_in_natural_order_and_in_its_own_folder(tmp_path):
    from equipix.experiment.manifest import entry_files as find_files

    folder = tmp_path / "run[1]"
    folder.mkdir()
    for name in ("f10.tif", "f9.tif"):
        (folder / name).touch()
    found = find_files(folder / "experiment.toml", "f*.tif")
    assert [path.name for path in found] == ["f9.tif", "f10.tif"]


def test_one_exposure_is_not_enough(manifest, tmp_path):
    path = tmp_path / "experiment.toml"
    path.write_text(f'[dark]\nframes = "{manifest.parent}/dark/dark.tif"\n[[exposure]]\nname = "a"')
    with pytest.raises(errors.FileError, match="frames"):
        Experiment.load(path)


@pytest.mark.parametrize("make", ["absent", "folder", "binary"])
def test_no_manifest_at_all(tmp_path, make):
    path = tmp_path / "experiment.toml"
    if make == "folder":
        path.mkdir()
    elif make == "binary":
        path.write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    with pytest.raises(errors.FileError, match=re.escape(str(path))):
        Experiment.load(path)


def write_tiff(path, array):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(path, array, photometric="minisblack")


def test_values_that_the_bits_do_not_hold_are_refused(edited):
    path = edited("bit_depth = 12", "bit_depth = 10")
    with pytest.raises(errors.FileError, match=r"above 1023, .* correct 'bit_depth'"):
        Experiment.load(path).run()


@pytest.mark.parametrize(
    ("load", "evaluate", "content"),
    [
        (
            Experiment.load,
            Experiment.run,
            '[dark]\nframes = "0.tif"\n'
            '[[exposure]]\nname = "a"\nframes = "1.tif"\n'
            '[[exposure]]\nname = "b"\nshift = [0, 1]\nframes = "2.tif"\n',
        ),
        (
            LevelExperiment.load,
            LevelExperiment.run,
            '[[level]]\nframes = "0.tif"\n[[level]]\nframes = "1.tif"\n',
        ),
        (
            CameraExperiment.load,
            CameraExperiment.figures,
            '[[exposure]]\nframes = "0.tif"\ndark = "1.tif"\nexposure_s = 1.0\nphotons = 1.0\n'
            '[[exposure]]\nframes = "2.tif"\ndark = "1.tif"\nexposure_s = 1.0\nphotons = 2.0\n',
        ),
    ],
    ids=["experiment", "levels", "camera"],
)
def test_more_bits_than_the_files_hold_are_refused(tmp_path, load, evaluate, content):
    """In files of 8 bits no value reaches 4095 DN, so saturation would not be found."""
    path = tmp_path / "bits.toml"
    for k in range(3):
        write_tiff(tmp_path / f"{k}.tif", np.full((2, *SHAPE), 50 + k, np.uint8))
    path.write_text(f"[sensor]\nbit_depth = 12\n{content}")
    words = r"0.tif: holds values of 8 bits \(uint8\), but 'bit_depth' .* is 12: write 8, or"
    with pytest.raises(errors.FileError, match=words):
        evaluate(load(path))


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (np.zeros((2, 10, 12), np.uint16), r"\(10, 12\).*\(64, 80\)"),
        (np.zeros((2, *SHAPE), np.uint8), r"uint8.*uint16"),
        (
            np.full((2, *SHAPE), 4095, np.uint16),
            r"experiment\.toml: 'frames': exposure 'p1': 100\.0% .* 4095 DN .* .bit_depth.",
        ),
        (b"", r"empty"),
        (b"II*\0 nothing more", r"bad\.tif"),
    ],
)
def test_bad_images_are_named(edited, tmp_path, frames, message):
    path = edited('"frames/p1.tif"', '"bad.tif"')
    if isinstance(frames, bytes):
        (tmp_path / "bad.tif").write_bytes(frames)
    else:
        write_tiff(tmp_path / "bad.tif", frames)
    with pytest.raises(errors.FileError, match=message):
        Experiment.load(path).run()


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("frames/p3.tif", "frames/p1.tif", "'frames' of exposure 'p1' and in 'frames' of .* 'p3'"),
        ("frames/p3.tif", "dark/dark.tif", r"\[dark\] and in 'frames' of exposure 'p3'"),
        ("aperture/p3-after.tif", "aperture/p3-before.tif", "'aperture_before' of exposure 'p3'"),
        ("frames/p3.tif", "aperture/p1-after.tif", "'aperture_after' of exposure 'p1' and in"),
    ],
)
@pytest.mark.parametrize("copy", [False, True], ids=["name", "content"])
def test_one_file_for_two_measurements_is_refused(
    edited, manifest, tmp_path, old, new, where, copy
):
    name = new
    if copy:
        (tmp_path / "copy.tif").write_bytes((manifest.parent / new).read_bytes())
        name = "copy.tif"
    path = edited(f'"{old}"', f'"{name}"')
    with pytest.raises(errors.FileError, match=where) as caught:
        Experiment.load(path).run()
    assert new.split("/")[1] in str(caught.value)


def test_one_file_listed_twice_is_refused(edited, manifest, tmp_path):
    (tmp_path / "copy.tif").write_bytes((manifest.parent / "frames/p3.tif").read_bytes())
    for second in ("frames/p3.tif", "copy.tif"):
        path = edited('"frames/p3.tif"', f'["frames/p3.tif", "{second}"]')
        with pytest.raises(errors.FileError, match="twice in 'frames' of exposure 'p3'"):
            Experiment.load(path).run()


def test_an_image_of_the_hole_serves_two_moves(edited):
    path = edited('"aperture/p2-before.tif"', '"aperture/p1-after.tif"')
    Experiment.load(path)


@pytest.mark.parametrize(
    "option",
    [{"tolerance": -1}, {"tolerance": "x"}, {"max_sweeps": 0}, {"max_sweeps": 2.5}, {"workers": 0}],
)
def test_bad_options_are_refused_before_the_work(manifest, option):
    stages = []
    with pytest.raises(errors.InputError, match=f"'{next(iter(option))}' is"):
        Experiment.load(manifest).run(**option, progress=lambda *stage: stages.append(stage))
    assert stages == []


def test_linear_fluxes_without_times_name_the_file(manifest):
    with pytest.raises(errors.InputError, match=r"experiment\.toml: .*--flux linear.* 'time'"):
        Experiment.load(manifest).run(flux="linear")


def another_dark(manifest, folder):
    """Dark frames like those of the experiment, but others."""
    frames = read_frames(manifest.parent / "dark/dark.tif")[::-1]
    write_tiff(folder / "another.tif", frames)
    return '"another.tif"'


def test_a_missing_spot_names_the_move(edited, manifest, tmp_path):
    path = edited('"aperture/p2-after.tif"', another_dark(manifest, tmp_path))
    with pytest.raises(errors.SpotError, match=r"move to exposure 'p2'.*after"):
        Experiment.load(path).run()


@pytest.mark.filterwarnings("ignore:.*times the light of the others")
def test_an_exposure_without_light_is_refused(edited, manifest, tmp_path):
    path = edited('"frames/p3.tif"', another_dark(manifest, tmp_path))
    with (
        pytest.warns(errors.MisfitWarning, match="'p3' has 0 times the light that its flux says"),
        pytest.raises(errors.InputError, match="median"),
    ):
        Experiment.load(path).run()


# The noise model and the flags by themselves


def statistics(rng, signal, *, gain, read_noise, frames):
    """Mean and variance of frames drawn from the model, quantised like an ADC's."""
    sigma = np.sqrt(gain * signal + read_noise**2)
    drawn = np.rint(signal + sigma * rng.standard_normal((frames, *signal.shape)))
    variance = drawn.var(axis=0, ddof=1)
    count = np.full(signal.shape, frames, np.uint32)
    zeros = np.zeros(signal.shape, np.uint32)
    return FrameStatistics(drawn.mean(axis=0), variance, variance / frames, count, zeros)


@pytest.mark.parametrize("frames", [2, 5, 50])
def test_fit_recovers_the_model(frames):
    rng = np.random.default_rng(frames)
    exposures = [
        statistics(rng, level * np.ones((200, 200)), gain=0.3, read_noise=2.0, frames=frames)
        for level in (0.0, 300.0, 2000.0)
    ]
    # Random-telegraph pixels must not count.
    scattered = exposures[1].variance.copy()
    scattered[:2] *= 1000
    exposures[1] = replace(exposures[1], variance=scattered)
    points = np.concatenate(
        [photon_transfer(e.mean, e.variance, e.saturated == 0, frames) for e in exposures]
    )
    model = NoiseModel.fit(points)
    # Standard error of a mean variance over 40 000 pixels: sqrt(2/(frames - 1)/40000); the gain
    # has that of two levels, the read noise half of that of its square. Five of each.
    error = np.sqrt(2 / (frames - 1) / 40_000)
    assert model.gain == pytest.approx(0.3, rel=5 * error)
    assert model.read_noise == pytest.approx(np.sqrt(4 + 1 / 12), rel=5 * error)
    known = NoiseModel.fit(points[:1], gain=0.3)
    assert known.gain == 0.3


def test_variances_are_a_smooth_function_of_the_mean():
    rng = np.random.default_rng(1)
    levels = np.tile(np.linspace(500, 3000, 100), (100, 1))
    exposures = [statistics(rng, levels, gain=0.3, read_noise=2.0, frames=8) for _ in range(3)]
    averaged = Averaged.of(exposures)
    models = averaged.models(averaged.noise)
    variances = np.stack([model.variance(levels) for model in models])
    expected = np.broadcast_to((0.3 * levels + 4 + 1 / 12) / 8, variances.shape)
    # Standard errors as above, for 30 000 pixels and 7 degrees of freedom; twice for two
    # parameters, five of these.
    np.testing.assert_allclose(variances, expected, rtol=10 * np.sqrt(2 / 7 / 30_000))


@pytest.mark.parametrize("frames", [2, 3, 10, 100])
def test_scatter_limit_is_beyond_chance(frames):
    rng = np.random.default_rng(frames)
    ratios = rng.chisquare(frames - 1, 1_000_000) / (frames - 1)
    # Three standard deviations leave 0.135 %; Wilson and Hilferty are within a third of that.
    beyond = np.mean(ratios > scatter_limit(frames, sigmas=3.0))
    assert beyond == pytest.approx(0.00135, rel=0.35)


def test_faint_light_makes_no_dead_pixels():
    rng = np.random.default_rng(4)
    signals = 3 + 1.5 * rng.standard_normal((5, 100, 100))
    models = [NoiseModel(1.5, 0.0)] * 5
    assert (signals < 1.5).any(axis=0).any()
    assert not dead_pixels(signals, models).any()
    signals = 100 + 1.5 * rng.standard_normal((5, 100, 100))
    signals[:, 7, 9] = 49 - 6 * 1.5 - 8
    assert np.argwhere(dead_pixels(signals, models)).tolist() == [[7, 9]]


def test_noisy_pixels_are_hot():
    dark = statistics(np.random.default_rng(5), np.zeros((90, 90)), gain=0, read_noise=2, frames=9)
    assert not hot_pixels(dark, NoiseModel(2.0, 0.3)).any()
    variance, mean = dark.variance.copy(), dark.mean.copy()
    variance[3, 4] *= 60
    mean[6, 7] += 30
    dark = replace(dark, variance=variance, mean=mean)
    assert np.argwhere(hot_pixels(dark, NoiseModel(2.0, 0.3))).tolist() == [[3, 4], [6, 7]]
