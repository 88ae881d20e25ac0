"""Bad input to calibrate and correct: an error of the package that says what was wrong."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

import equipix
from equipix._check import Method
from equipix.errors import ConvergenceWarning, FileError, InputError, InputWarning
from equipix.exposures.exposures import FitOptions
from equipix.exposures.positions import Positions, Rounding
from records import rewrite

CROSS = equipix.cross_pattern(2, 3)


def frames(shape=(5, 8, 9)):
    return np.random.default_rng(0).uniform(0.5, 1.5, shape)


class Lengths:
    """An array with a unit, which NumPy would drop."""

    def __init__(self, values, unit):
        self.values, self.unit = values, unit

    def __array__(self, *args, **kwargs):
        return np.array(self.values, *args, **kwargs)


class Length(float):
    """A number with a unit."""

    units = "um"


def changed(**options):
    return {"frames": frames(), "shifts": CROSS} | options


def with_value(array, place, value):
    result = np.array(array, dtype=float)
    result[place] = value
    return result


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": frames((8, 9))}, r"'frames' has shape \(8, 9\)"),
        ({"frames": frames((5, 0, 9))}, "'frames' has shape"),
        ({"frames": "frame.tif"}, "'frames' has dtype"),
        ({"frames": frames().astype(complex)}, "'frames' has dtype complex128"),
        ({"frames": [frames()[0], frames()[0, :3]]}, "'frames' holds arrays of shapes"),
        ({"frames": np.ma.masked_greater(frames(), 1)}, "'frames' is a masked array.*'mask'"),
        ({"frames": list(np.ma.masked_greater(frames(), 1))}, "'frames' is a masked array"),
        ({"frames": frames((1, 8, 9)), "shifts": [(0, 0)]}, "at least two"),
        ({"frames": frames((4, 8, 9))}, "'shifts' has 5 entries, expected 4"),
        ({"shifts": CROSS[:, :1]}, r"'shifts' has shape \(5, 1\), expected \(n, 2\)"),
        ({"shifts": CROSS.ravel()}, "'shifts' has shape"),
        ({"shifts": with_value(CROSS, (2, 1), np.nan)}, "'shifts' of exposure 2 .from 0. is .*nan"),
        ({"shifts": with_value(CROSS, (3, 0), np.inf)}, "'shifts' of exposure 3 .from 0. is .*inf"),
        (
            {"shifts": with_value(CROSS, (4, 0), 8)},
            "'shifts' of exposure 4 .from 0. is .* row part",
        ),
        (
            {"shifts": with_value(CROSS, (4, 1), -1e300)},
            "'shifts' of exposure 4 .from 0. .* column part",
        ),
        ({"shifts": with_value(CROSS, (4, 1), 1e10)}, r"\(.*, 1e\+10\).*micrometres"),
        ({"shifts": [["9.3 um", "0 um"]] * 5}, "'shifts' holds '9.3 um', expected numbers of"),
        ({"shifts": Lengths(CROSS, "um")}, "'shifts' has the unit um, expected .* pixel pitch"),
        ({"shifts": [(Length(9), 0.0)] * 5}, "'shifts' has the unit um"),
        ({"frames": np.full((5, 8, 9), np.nan)}, "'frames' holds no finite number"),
        ({"mask": np.ones((8, 9), bool)}, "'mask' excludes all pixels"),
        ({"mask": np.ones((8, 8), bool)}, "'mask' has shape"),
        ({"mask": np.zeros((9, 8), bool)}, r"'mask' has shape \(9, 8\), expected \(8, 9\) or"),
        ({"mask": np.zeros((8, 9, 5), bool)}, r"'mask' has shape \(8, 9, 5\)"),
        ({"mask": np.ones((8, 9))}, "'mask' has dtype float64, expected bool"),
        ({"mask": np.arange(5)[:, None, None] == np.full((5, 8, 9), 3)}, "nothing of exposure 3"),
        (
            {"frames": with_value(frames(), 1, -0.1)},
            "'frames' of exposure 1 .from 0. have a median",
        ),
        ({"frames": with_value(frames(), 4, 0)}, "'frames' of exposure 4 .from 0. have a median"),
        ({"variance": np.ones(4)}, "'variance' has 4 entries"),
        ({"variance": np.ones((5, 8, 8))}, "'variance' has shape"),
        ({"variance": 9.0}, r"'variance' has shape \(\), expected \(5,\), one .*, or \(5, "),
        ({"variance": with_value(np.ones(5), 2, 0)}, "'variance' of exposure 2 .from 0. is 0"),
        ({"variance": with_value(np.ones(5), 2, -1)}, "'variance' of exposure 2 .from 0. is -1"),
        (
            {"variance": with_value(np.ones(5), 2, np.nan)},
            "'variance' of exposure 2 .from 0. is NaN",
        ),
        (
            {"variance": with_value(np.ones(5), 2, np.inf)},
            "'variance' of exposure 2 .from 0. is inf",
        ),
        ({"variance": with_value(np.ones((5, 8, 9)), (1, 2, 3), -1)}, "row 2, column 3 is -1"),
        ({"variance": with_value(np.ones((5, 8, 9)), (1, 2, 3), np.nan)}, "row 2, column 3 is NaN"),
        ({"variance": with_value(np.ones((5, 8, 9)), (1, 2, 3), np.inf)}, "row 2, column 3 is inf"),
        (
            {
                "frames": frames().astype(np.float32),
                "variance": with_value(np.ones((5, 8, 9), np.float32), (1, 2, 3), 0),
            },
            "row 2, column 3 is 0",
        ),
        ({"frames": 1e60 * frames()}, "choose another unit"),
        ({"frames": 1e-60 * frames()}, "choose another unit"),
        ({"flux": [1e300] * 5}, "'flux' of exposure 0 .from 0. is 1"),
        ({"flux": [1, 1, 1, 1]}, "'flux' has 4 entries"),
        ({"flux": [1, 1, 0, 1, 1]}, "'flux' of exposure 2 .from 0. is 0"),
        ({"flux": [1, 1, 1, np.nan, 1]}, "'flux' of exposure 3 .from 0. is NaN"),
        ({"rotation": [0, 0, 45, 0, 0]}, "'rotation' is .*45"),
        ({"method": "newton"}, "'method' is 'newton'"),
        ({"tolerance": 0}, "'tolerance' is 0"),
        ({"tolerance": np.nan}, "'tolerance' is nan"),
        ({"tolerance": 1}, "'tolerance' is 1, expected a relative error between 0 and 1"),
        ({"tolerance": "small"}, "'tolerance' is 'small'"),
        ({"tolerance": "1e-3"}, "'tolerance' is '1e-3'"),
        ({"tolerance": True}, "'tolerance' is True"),
        ({"tolerance": 10**400}, "'tolerance' is 1000"),
        ({"progress": 3}, "'progress' is 3, expected a function"),
        ({"frames": frames() > 1}, "'frames' has dtype bool"),
        ({"max_sweeps": 0}, "'max_sweeps' is 0"),
        ({"max_sweeps": 2.5}, r"'max_sweeps' is 2\.5"),
        ({"workers": 0}, "'workers' is 0"),
        ({"workers": True}, "'workers' is True"),
        ({"workers": 2**70}, "'workers' is"),
    ],
)
def test_calibrate_names_what_is_wrong(options, message):
    with pytest.raises(InputError, match=message):
        equipix.calibrate(**changed(**options))


@pytest.mark.parametrize(
    ("shift", "options"),
    [((0.3, 0.4), {"flux": "fit"}), ((0, 0), {"flux": "fit"}), ((2, 2), {"shift_std": 0.1})],
)
@pytest.mark.parametrize("rotation", [None, [0, 180, 0, 180, 0]])
def test_one_position_is_refused_where_the_solver_would_search_in_vain(shift, options, rotation):
    with pytest.raises(InputError, match="'shifts' are all alike"):
        equipix.calibrate(frames(), [shift] * 5, rotation=rotation, **options)


def test_an_unmet_tolerance_says_what_would_meet_it():
    with pytest.warns(ConvergenceWarning, match="allow more sweeps"):
        equipix.calibrate(frames(), CROSS, max_sweeps=8)
    with pytest.warns(ConvergenceWarning, match="no longer decreasing: use a larger"):
        equipix.calibrate(frames(), CROSS, tolerance=1e-300)


def test_a_rounded_shift_is_named_with_what_to_do():
    with pytest.warns(InputWarning, match=r"exposure 2 \(from 0\) is .*0\.3.* move the"):
        cal = equipix.calibrate(
            frames(),
            with_value(CROSS, (2, 0), 0.3),
            method="coordinate-descent",
            tolerance=1e-3,
        )
    assert [finding.kind for finding in cal.findings] == ["rounding"]
    np.testing.assert_array_equal(cal.shifts, with_value(CROSS, (2, 0), 0))


def test_moves_are_rounded_and_a_common_part_of_a_pixel_is_kept():
    moved = CROSS + 0.5 + np.array([(0, 0), (0.01, 0), (-0.01, 0), (0, 0.015), (0, -0.01)])
    rounded = Positions.of(moved).whole()
    np.testing.assert_array_equal(rounded.shifts, CROSS + 0.5)
    assert rounded.rounding is None


@pytest.mark.parametrize(
    ("shift", "std", "noticeable"),
    [(0.019, 0, False), (0.021, 0, True), (0.059, 0.02, False), (0.061, 0.02, True)],
)
def test_a_rounding_within_0_02_pixel_or_three_standard_errors_is_none(shift, std, noticeable):
    positions = Positions.of(with_value(CROSS, (3, 1), shift))
    rounding = positions.whole(np.full((5, 2), std)).rounding
    assert rounding == (Rounding(3, [CROSS[3, 0], shift]) if noticeable else None)


def test_the_core_decides_which_method_needs_whole_shifts():
    needs = {method: FitOptions(method).whole_shifts for method in get_args(Method)}
    assert needs == {"multiscale": False, "coordinate-descent": True}


def test_any_number_of_sweeps_may_be_allowed():
    assert equipix.calibrate(frames(), CROSS, tolerance=1e-3, max_sweeps=2**64).converged


def test_a_masked_measurement_needs_no_variance():
    values, variance = frames(), np.ones((5, 8, 9))
    values[1, 2, 3] = np.nan
    variance[1, 2, 3] = np.nan
    assert equipix.calibrate(values, CROSS, variance=variance, tolerance=1e-3).converged


@pytest.mark.parametrize("arm", [10**30, -(10**30), 0, 2.5, True])
def test_cross_pattern_names_a_wrong_arm(arm):
    with pytest.raises(InputError, match="'first' is"):
        equipix.cross_pattern(arm, 5)


def test_an_exception_in_the_progress_callback_stops_the_work_and_is_raised():
    def stop(*_):
        raise RuntimeError("stop here")

    with pytest.raises(RuntimeError, match="stop here"):
        equipix.calibrate(frames(), CROSS, tolerance=1e-12, progress=stop)


@pytest.fixture(scope="module")
def calibration():
    return equipix.calibrate(frames(), CROSS, tolerance=1e-3)


class TestCorrect:
    def test_divides_and_subtracts(self, calibration):
        raw = np.full((3, 8, 9), 7, np.uint16)
        corrected = calibration.correct(raw, dark=np.full((8, 9), 2))
        assert corrected.dtype == np.float32
        np.testing.assert_allclose(corrected[1], 5 / calibration.sensitivity, rtol=3e-7)

    def test_averaged_dark_frames(self, calibration):
        raw, dark = frames((8, 9)), equipix.average(frames((3, 8, 9)))
        np.testing.assert_array_equal(
            calibration.correct(raw, dark=dark), calibration.correct(raw, dark=dark.mean)
        )

    def test_into_an_array(self, calibration):
        raw, out = frames((8, 9)), np.empty((8, 9))
        assert calibration.correct(raw, dark=None, out=out) is out
        # 1/M and its product, and the quotient, round once each by half an eps.
        wanted = raw / calibration.sensitivity
        np.testing.assert_allclose(out, wanted, rtol=1.5 * np.finfo(float).eps)

    def test_flagged_pixels(self):
        mask = np.zeros((8, 9), bool)
        mask[2:5, 3] = True
        cal = equipix.calibrate(frames(), CROSS, mask=mask, tolerance=1e-3)
        flat = np.nan_to_num(cal.sensitivity, nan=3.0)
        for flagged, wanted in (("nan", np.nan), ("keep", np.nan), ("replace", 1.0)):
            corrected = cal.correct(flat, dark=None, flagged=flagged)
            np.testing.assert_allclose(corrected[mask], wanted, rtol=1e-14)
            np.testing.assert_allclose(corrected[~mask], 1.0, rtol=1e-14)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"frames": frames((9, 8))}, r"'frames' has shape \(9, 8\), the sensor \(8, 9\)"),
            ({"frames": frames((2, 2, 8, 9))}, "'frames' has shape"),
            ({"dark": "stored"}, "'dark' is 'stored'"),
            ({"dark": "yes"}, "'dark' is 'yes'"),
            ({"dark": np.zeros((2, 8, 9))}, "'dark' has shape"),
            ({"dark": np.zeros(3)}, "'dark' has shape"),
            ({"flagged": "drop"}, "'flagged' is 'drop'"),
            ({"out": np.empty((9, 8))}, "'out' is float64"),
            ({"out": np.empty((8, 9), int)}, "'out' is int64"),
            ({"out": np.empty((8, 9), np.float16)}, "'out' is float16.* expected .*float32"),
            ({"out": np.empty((8, 9), np.longdouble)}, "'out' is .* expected .*float32"),
        ],
    )
    def test_names_what_is_wrong(self, calibration, options, message):
        call = {"frames": frames((8, 9)), "dark": None} | options
        with pytest.raises(InputError, match=message):
            calibration.correct(call.pop("frames"), **call)


class TestFiles:
    @pytest.mark.parametrize("suffix", [".tif", ".npz"])
    def test_round_trip(self, calibration, tmp_path, suffix):
        path = tmp_path / f"cal{suffix}"
        calibration.save(path)
        again = equipix.load(path)
        for name in ("sensitivity", "beam", "flags", "component_labels", "shifts", "flux"):
            old, new = getattr(calibration, name), getattr(again, name)
            assert (old.dtype, old.tobytes()) == (new.dtype, new.tobytes())
        for name in ("beam_origin", "objective", "reduced_chi2", "components", "sweeps"):
            assert getattr(calibration, name) == getattr(again, name)
        assert again.error_estimate == calibration.error_estimate
        assert again.metadata == calibration.metadata
        assert again.dark is None
        np.testing.assert_array_equal(again.history["objective"], calibration.history["objective"])

    def test_an_existing_file_is_kept(self, calibration, tmp_path):
        path = tmp_path / "cal.tif"
        path.write_bytes(b"precious")
        with pytest.raises(FileError, match="cal.tif"):
            calibration.save(path)
        assert path.read_bytes() == b"precious"
        calibration.save(path, force=True)
        assert equipix.load(path).shape == (8, 9)

    def test_an_unknown_suffix_is_refused(self, calibration, tmp_path):
        with pytest.raises(InputError, match="cal.bmp"):
            calibration.save(tmp_path / "cal.bmp")
        assert list(tmp_path.iterdir()) == []

    def test_a_newer_format_is_refused(self, calibration, tmp_path):
        path = tmp_path / "cal.npz"
        calibration.save(path)
        known = equipix.Calibration.VERSION
        rewrite(path, version=known + 1)
        with pytest.raises(FileError, match=f"version {known + 1}.*reads version {known}: .* in"):
            equipix.load(path)

    @pytest.mark.parametrize("content", [b"", b"II*\0", b"PK\3\4", b"hello" * 100])
    @pytest.mark.parametrize("suffix", [".tif", ".npz"])
    def test_something_else_is_refused(self, tmp_path, suffix, content):
        path = tmp_path / f"other{suffix}"
        path.write_bytes(content)
        with pytest.raises(FileError, match="other"):
            equipix.load(path)

    def test_a_missing_file_is_named(self, tmp_path):
        with pytest.raises(FileError, match="nothing.tif"):
            equipix.load(tmp_path / "nothing.tif")

    @pytest.mark.parametrize(
        "changed",
        [
            {"rotation": np.full(5, 45)},
            {"rotation": np.zeros(1, int)},
            {"rotation": np.zeros(5)},
            {"beam_origin": [-1, 0]},
            {"beam_origin": [0.5, 0]},
            {"beam_origin": ["0", 0]},
            {"beam_origin": [0, None]},
            {"beam_origin": [0, 0, 0]},
            {"beam_origin": [0, 99]},
            {"shifts": np.zeros(2)},
            {"shifts": [1, 2]},
            {"objective": "small"},
            {"objective": None},
            {"converged": 1},
            {"sweeps": 1.5},
            {"shift_sign": "unknown"},
            {"metadata": 3},
            {"findings": [{"kind": "unheard", "message": "of"}]},
            {"history.sweep": np.full(2, -1)},
        ],
        ids=str,
    )
    def test_damaged_numbers_are_refused_by_name(self, calibration, tmp_path, changed):
        path = tmp_path / "cal.npz"
        calibration.save(path)
        arrays = {name: each for name, each in changed.items() if isinstance(each, np.ndarray)}
        rewrite(path, {} if arrays else changed, arrays)
        with pytest.raises(FileError, match=r"cal\.npz: is damaged: .*\(in calibration\)"):
            equipix.load(path)
