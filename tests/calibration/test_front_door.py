"""The same frames give the same calibration, whichever way they come in."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import Flag, simulate
from equipix.cli import main

SHAPE, SHIFTS = (96, 128), equipix.cross_pattern(11, 19)


def virtual_experiment(seed, *, bit_depth=8, frames=12, **how):
    """An experiment of a camera of few bits, some of whose samples saturate where it is bright."""
    rng = np.random.default_rng(seed)
    truth = simulate.cosine_sensitivity(SHAPE, rng=rng)
    beam = simulate.gaussian_beam(SHAPE, width=150)
    return simulate.experiment(
        truth, beam, SHIFTS, frames=frames, bit_depth=bit_depth, rng=rng, **how
    )


def statistics_of(virtual, level):
    """Averages of the frames that the experiment has on disk."""
    dark = equipix.average(virtual.dark(), saturation=level)
    return [
        equipix.average(virtual.frames(k), dark=dark, saturation=level) for k in range(len(SHIFTS))
    ]


def with_given_shifts(manifest):
    """The manifest with true shifts in the place of images of the hole."""
    text = manifest.read_text()
    for k, (row, col) in enumerate(SHIFTS.tolist()):
        images = "".join(
            f'aperture_{when} = "aperture/p{k}-{when}.tif"\n' for when in ("before", "after")
        )
        text = text.replace(images, f"shift = [{row}, {col}]\n")
    manifest.write_text(text)
    return manifest


@pytest.fixture(scope="module", params=["8 bits, saturated", "12 bits"])
def doors(request, tmp_path_factory):
    """One experiment through three doors: averages, files, and the command line."""
    bright = request.param.startswith("8")
    # So bright that some samples of the most sensitive pixels reach the largest value.
    virtual = virtual_experiment(
        3,
        bit_depth=8 if bright else 12,
        exposure_e=18_000.0 if bright else 14_000.0,
        stage_error=0.0,
    )
    level = virtual.camera.full_scale
    folder = tmp_path_factory.mktemp("doors")
    manifest = with_given_shifts(virtual.write(folder / "experiment"))
    averages = equipix.calibrate(statistics_of(virtual, level), SHIFTS, uncertainty=True)
    files = equipix.Experiment.load(manifest).run()
    output = folder / "cal.tif"
    main_of(["calibrate", str(manifest), "-o", str(output), "--json"])
    return virtual, averages, files, equipix.load(output)


def main_of(arguments):
    """Run the command line; it must succeed."""
    try:
        main(arguments)
    except SystemExit as end:
        assert not end.code, end.code


class TestDoors:
    @pytest.mark.long
    def test_give_the_same_flags(self, doors):
        virtual, averages, files, command = doors
        np.testing.assert_array_equal(averages.flags, files.flags)
        np.testing.assert_array_equal(files.flags, command.flags)
        bad = ~virtual.camera.good
        np.testing.assert_array_equal((files.flags & Flag.DO_NOT_USE) != 0, bad)
        if virtual.camera.bit_depth == 8:
            saturated = (files.flags & Flag.SATURATED) != 0
            assert np.isfinite(files.sensitivity[saturated & ~bad]).all()
            assert np.count_nonzero(saturated & ~bad) > 10

    def test_give_the_same_sensitivity(self, doors):
        _, averages, files, command = doors
        np.testing.assert_array_equal(files.sensitivity, command.sensitivity)
        np.testing.assert_array_equal(np.isnan(averages.sensitivity), np.isnan(files.sensitivity))
        difference = np.abs(averages.sensitivity - files.sensitivity)
        assert np.nanmax(difference / averages.sensitivity_std) < 0.01

    def test_keep_the_dark(self, doors):
        _, averages, files, command = doors
        np.testing.assert_allclose(averages.dark, files.dark, rtol=2**-23)
        np.testing.assert_array_equal(files.dark, command.dark)


@pytest.mark.long
def test_a_value_that_saturates_is_left_out_of_its_exposure_alone():
    """A pixel whose samples saturate where the beam is bright keeps the M that the others give."""
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    truth[40, 50] *= 1.9
    beam = simulate.gaussian_beam(SHAPE, width=60)
    bright = simulate.experiment(
        truth, beam, SHIFTS, frames=16, bit_depth=12, exposure_e=11_000.0, dead=0, hot=0, rng=rng
    )
    found = statistics_of(bright, bright.camera.full_scale)
    saturated = np.array([each.saturated[40, 50] > 0 for each in found])
    assert saturated.any()
    assert not saturated.all()
    cal = equipix.calibrate(found, SHIFTS, uncertainty=True)
    assert cal.flags[40, 50] == Flag.SATURATED
    error = cal.sensitivity[40, 50] * truth.mean() / truth[40, 50] - 1
    # Five standard deviations of this one pixel.
    assert abs(error) < 5 * cal.sensitivity_std[40, 50] / cal.sensitivity[40, 50]


def test_pixels_that_only_the_dark_shows_are_flagged_through_every_door():
    virtual = virtual_experiment(4, bit_depth=12, dead=3, hot=5)
    cal = equipix.calibrate(statistics_of(virtual, virtual.camera.full_scale), SHIFTS)
    hot = np.zeros(SHAPE, bool)
    hot.flat[virtual.camera.hot] = True
    np.testing.assert_array_equal((cal.flags & Flag.HOT) != 0, hot)


def test_averages_with_two_darks_are_refused():
    virtual = virtual_experiment(5)
    first, *others = statistics_of(virtual, 255)
    other = equipix.average(virtual.frames(0), dark=equipix.average(list(virtual.dark())[1:]))
    with pytest.raises(equipix.errors.InputError, match=r"exposure 4 has another dark"):
        equipix.calibrate([first, *others[:3], other], SHIFTS)


@pytest.mark.parametrize("suffix", [".tif", ".npz"])
def test_saved_averages_keep_their_dark(tmp_path, suffix):
    each = statistics_of(virtual_experiment(6), 255)[0]
    each.save(tmp_path / f"mean{suffix}")
    read = equipix.load(tmp_path / f"mean{suffix}")
    for name, values in each.dark.maps.items():
        np.testing.assert_array_equal(read.dark.maps[name], values)


@pytest.mark.long
def test_averages_saved_and_loaded_one_by_one_calibrate(tmp_path):
    """Each file holds the dark; equal darks are one."""
    found = statistics_of(virtual_experiment(7), 255)
    for k, each in enumerate(found):
        each.save(tmp_path / f"{k}.npz")
    read = [equipix.load(tmp_path / f"{k}.npz") for k in range(len(found))]
    again, first = (equipix.calibrate(each, SHIFTS) for each in (read, found))
    np.testing.assert_array_equal(again.sensitivity, first.sensitivity)


def test_exact_data_confirm_their_sign():
    """Whole numbers without noise: F is 0 with the right shifts."""
    rows, cols = np.indices((90, 100))
    beam = 500 + 3 * rows + 7 * cols + rows * cols % 61
    shifts = [(0, 0), (0, 5), (7, 0), (5, 9)]
    frames = [beam[r : r + 60, c : c + 64].astype(float) for r, c in shifts]
    assert equipix.calibrate(np.array(frames), shifts).shift_sign == "confirmed"


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """An experiment of one frame an exposure: averages, and its file."""
    virtual = virtual_experiment(8, bit_depth=12, frames=1, stage_error=0.0)
    manifest = with_given_shifts(virtual.write(tmp_path_factory.mktemp("single") / "experiment"))
    return statistics_of(virtual, virtual.camera.full_scale), manifest


class TestSingleFrames:
    """They show no noise: all weights are equal, and residuals determine the noise."""

    @pytest.mark.long
    def test_give_the_same_from_averages_and_files(self, single):
        averages, manifest = single
        arrays = equipix.calibrate(averages, SHIFTS, uncertainty=True)
        files = equipix.Experiment.load(manifest).run(uncertainty=True)
        for cal in (arrays, files):
            assert cal.metadata["options"]["weights"] == "equal"
            assert cal.findings == ()
        np.testing.assert_array_equal(arrays.flags, files.flags)
        difference = np.abs(arrays.sensitivity - files.sensitivity)
        assert np.nanmax(difference / arrays.sensitivity_std) < 0.01

    @pytest.mark.long
    def test_have_the_standard_deviations_of_equal_weights(self, single):
        averages, _ = single
        cal = equipix.calibrate(averages, SHIFTS, uncertainty=True)
        given = np.full(len(averages), cal.reduced_chi2)
        # The noise of the dark, which single frames have too, is not in variances that are given.
        dark = cal.weighted.exposures.dark_variance
        known = equipix.calibrate(
            averages, SHIFTS, variance=given, dark_variance=dark, uncertainty=True
        )
        assert known.reduced_chi2 == pytest.approx(1, rel=1e-9)
        # The same equations in another unit: each draw stops at its own tolerance.
        np.testing.assert_allclose(cal.sensitivity_std, known.sensitivity_std, rtol=1e-3)

    @pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
    def test_take_a_variance_that_is_given(self, single):
        averages, _ = single
        cal = equipix.calibrate(averages, SHIFTS, variance=np.full(5, 900.0))
        assert cal.metadata["options"]["weights"] == "variances"

    def test_have_residuals_in_their_unit(self, single):
        averages, _ = single
        cal = equipix.calibrate(averages, SHIFTS)
        left = cal.residuals(averages)
        means = np.stack([each.mean for each in averages])
        np.testing.assert_array_equal(left, cal.residuals(means))
