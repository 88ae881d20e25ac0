"""Results cannot be changed, and arrays of the caller stay the caller's."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.exposures.positions import Orientation
from equipix.measured.statistics import FrameStatistics
from given import exposures_of

SHAPE, CROSS = (24, 32), equipix.cross_pattern(3, 5)


def frames():
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity(SHAPE, rng=rng)
    beam = simulate.gaussian_beam(SHAPE, width=60)
    measured = simulate.exposures(truth, beam, CROSS + 0.25)
    return measured + 1e-3 * rng.standard_normal(measured.shape)


def calibration():
    """With all arrays that a result may have, but a dark."""
    return equipix.calibrate(
        frames(), CROSS + 0.25, shift_std=0.01, robust=True, uncertainty=True, tolerance=1e-4
    )


def arrays(instance):
    """The arrays of a dataclass and of those in its fields, by name."""
    found = {}
    for field in dataclasses.fields(instance):
        value = getattr(instance, field.name)
        if isinstance(value, np.ndarray):
            found[field.name] = value
        elif isinstance(value, dict):
            held = ((key, each) for key, each in value.items() if isinstance(each, np.ndarray))
            found |= {f"{field.name}.{key}": each for key, each in held}
        elif dataclasses.is_dataclass(value):
            inner = arrays(value).items()
            found |= {f"{field.name}.{name}": array for name, array in inner}
    return found


def writeable(instance):
    found = arrays(instance)
    assert found
    return [name for name, array in found.items() if array.flags.writeable]


def test_arrays_of_a_calibration_are_read_only(tmp_path):
    cal = calibration()
    wanted = {"sensitivity", "beam", "flags", "rejected", "sensitivity_std", "history.objective"}
    assert wanted <= set(arrays(cal))
    cal.save(tmp_path / "cal.npz")
    cal.save(tmp_path / "cal.tif")
    for each in (
        cal,
        copy.copy(cal),
        copy.deepcopy(cal),
        pickle.loads(pickle.dumps(cal)),
        dataclasses.replace(cal, dark=np.zeros(SHAPE)),
        equipix.load(tmp_path / "cal.npz"),
        equipix.load(tmp_path / "cal.tif"),
    ):
        assert writeable(each) == []
    with pytest.raises(ValueError, match="read-only"):
        cal.sensitivity[0, 0] = 1


def test_what_a_calibration_computes_is_the_callers():
    cal, measured = calibration(), frames()
    for made in (
        cal.correct(measured, dark=None, flagged="replace"),
        cal.correct(measured[0], dark=None, out=np.empty(SHAPE)),
        cal.predict((0, 0)),
        cal.residuals(measured),
        cal.coefficients,
        cal.tilt,
    ):
        assert made.flags.writeable
    again = pickle.loads(pickle.dumps(cal))
    np.testing.assert_array_equal(
        again.correct(measured, dark=None), cal.correct(measured, dark=None)
    )


def test_frame_statistics_are_read_only(tmp_path):
    raw = np.random.default_rng(2).normal(100, 3, (4, *SHAPE))
    found = equipix.average(raw, dark=equipix.average(raw / 50))
    found.save(tmp_path / "mean.npz")
    for each in (
        found,
        pickle.loads(pickle.dumps(found)),
        copy.deepcopy(found),
        equipix.load(tmp_path / "mean.npz"),
    ):
        assert "dark.mean" in arrays(each)
        assert writeable(each) == []
    with pytest.raises(ValueError, match="read-only"):
        found.mean += 1


def test_exposures_are_read_only_views_of_the_callers_arrays():
    values, variance, mask = frames(), np.ones((5, *SHAPE)), np.zeros(SHAPE, bool)
    given = {"variance": variance, "mask": mask}
    exposures = exposures_of(
        values, CROSS, flux_std=1e-3, shift_std=0.1, saturation=values.max(), **given
    )
    assert {"values", "positions.std", "flux.std", "bad_pixels.saturated"} <= set(arrays(exposures))
    assert writeable(exposures) == []
    assert np.shares_memory(exposures.values, values)
    assert np.shares_memory(exposures.variance, variance)
    for changed in (
        exposures.chosen(np.array([0, 2])),
        exposures.window(12),
        exposures.at(exposures.positions.oriented(Orientation(rows=True))),
        exposures.at(exposures.positions.whole()),
        exposures.weighted(np.ones(5)),
        exposures.without(np.zeros((5, *SHAPE), bool)),
    ):
        assert writeable(changed) == []
    for own in (values, variance, mask):
        assert own.flags.writeable


def test_arrays_of_the_caller_stay_writeable():
    values, shifts = frames(), CROSS.astype(float)
    given = {
        "variance": np.full(5, 1e-6),
        "mask": np.zeros(SHAPE, bool),
        "flux": np.ones(5),
        "rotation": np.zeros(5, np.int64),
    }
    equipix.calibrate(values, shifts, tolerance=1e-3, **given)
    maps = [np.ones(SHAPE) for _ in range(5)]
    statistics = FrameStatistics(*maps)
    assert writeable(statistics) == []
    assert np.shares_memory(statistics.mean, maps[0])
    assert all(own.flags.writeable for own in (values, shifts, *given.values(), *maps))
