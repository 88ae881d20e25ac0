"""One exposure under two names."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import errors, simulate
from equipix.diagnosis.inputs import repeated
from equipix.exposures.positions import Positions

CROSS = equipix.cross_pattern(3, 5)


def exposures(noise=1e-3):
    rng = np.random.default_rng(1)
    truth = simulate.paper_sensitivity((24, 32), rng=rng)
    frames = simulate.exposures(truth, simulate.gaussian_beam(truth.shape, width=60), CROSS)
    return frames + noise * rng.standard_normal(frames.shape)


def test_the_first_pair_is_named():
    frames = exposures()
    positions = Positions.of(CROSS)
    assert repeated(frames, positions) is None
    frames[3] = frames[1]
    frames[1:4:2, 5, 6] = np.nan
    assert repeated(frames, positions) == (1, 3)
    assert repeated(frames, Positions.of(CROSS[[0, 1, 2, 1, 4]])) is None
    frames[3, -1, -1] += 1e-9
    assert repeated(frames, positions) is None


def test_equal_constants_are_named_and_missing_exposures_are_not():
    positions = Positions.of(CROSS)
    assert repeated(np.ones((5, 4, 6)), positions) == (0, 1)
    assert repeated(np.full((5, 4, 6), np.nan), positions) is None


def test_a_calibration_of_equal_constant_frames_says_so():
    with pytest.warns(errors.MisfitWarning, match=r"exposure 0 \(from 0\) and exposure 1 \("):
        cal = equipix.calibrate(np.full((5, 24, 32), 1000.0), CROSS)
    assert "repeated" in {finding.kind for finding in cal.findings}


def test_a_calibration_says_so():
    frames = exposures()
    frames[4] = frames[2]
    with pytest.warns(errors.EquipixWarning) as caught:
        cal = equipix.calibrate(frames, CROSS)
    assert "exposure 2 (from 0) and exposure 4 (from 0) are equal, value for value" in str(
        caught[0].message
    )
    assert "repeated" in {finding.kind for finding in cal.findings}
