"""Shifts that look like micrometres are asked about; shifts in pixels are not."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import errors, plan, simulate
from equipix.exposures.positions import micrometre_step

CROSS = equipix.cross_pattern(11, 19)


@pytest.mark.parametrize("pitch", [2.4, 3.45, 5.5, 6.5, 8.3, 10.0, 15.0])
def test_a_cross_in_micrometres_is_recognised(pitch):
    for shape in ((240, 320), (300, 400)):
        largest = 19 * pitch
        if largest < min(shape):
            assert micrometre_step(pitch * CROSS, shape) == pytest.approx(pitch)
            assert micrometre_step(3.7 + pitch * CROSS, shape) == pytest.approx(pitch)


@pytest.mark.parametrize(
    "shifts",
    [
        CROSS,
        CROSS + 0.25,
        equipix.cross_pattern(97, 160),
        equipix.cross_pattern(4, 6),
        [(0, 0), (0, 100)],
        [(0, 0), (0, 0), (0, 0)],
        CROSS + np.random.default_rng(1).normal(0, 0.3, (5, 2)),
        np.round(8.3 * CROSS + np.random.default_rng(2).normal(0, 0.3, (5, 2)), 2),
        [(0, 0), (0, 5.5), (0, 11), (5.5, 0), (11, 0)],
    ],
    ids=["cross", "moved", "far", "four parts", "two", "alike", "measured", "stage", "half pixels"],
)
def test_shifts_in_pixels_are_not(shifts):
    assert micrometre_step(np.array(shifts, float), (240, 320)) is None


def test_suggested_patterns_are_not():
    for suggestion in plan.suggest((96, 128), 5, 40, drift=1e-6):
        assert micrometre_step(suggestion.shifts.astype(float), (96, 128)) is None


@pytest.mark.long
def test_calibrate_asks():
    shape, shifts = (200, 200), 8.3 * CROSS
    truth = simulate.paper_sensitivity(shape, rng=1)
    frames = simulate.exposures(truth, simulate.gaussian_beam(shape), CROSS)
    frames += 1e-3 * np.random.default_rng(1).standard_normal(frames.shape)
    with pytest.warns(errors.IdentifiabilityWarning, match=r"micrometres: .* multiples of 8\.3"):
        cal = equipix.calibrate(frames, shifts, tolerance=1e-2)
    assert "unit" in {finding.kind for finding in cal.findings}


@pytest.mark.long
def test_calibrate_does_not_ask_where_the_data_confirm_the_shifts():
    shape, shifts = (60, 80), 1.5 * np.array([(0, 0), (0, 7), (0, 11), (7, 0), (11, 0), (5, 6)])
    truth = simulate.paper_sensitivity(shape, rng=1)
    beam = simulate.wavy_beam(shape, contrast=0.2, rng=1)
    frames = simulate.exposures(truth, beam, shifts)
    frames += 1e-3 * np.random.default_rng(1).standard_normal(frames.shape)
    assert micrometre_step(shifts, shape) == 1.5
    cal = equipix.calibrate(frames, shifts, variance=np.full(6, 1e-6))
    assert cal.shift_sign == "confirmed"
    assert cal.findings == ()
