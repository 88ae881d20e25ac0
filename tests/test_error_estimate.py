"""The estimated error of the sensitivity where light or masks nearly cut the sensor in two."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import simulate

CROSS = equipix.cross_pattern(5, 7)


def dark_stripe(rows, cols):
    """Light that falls to a hundredth along one line."""
    envelope = simulate.gaussian_beam((96, 128), width=400)(rows, cols)
    return envelope * (1 - 0.99 * np.exp(-(((cols - 64) / 6) ** 2)))


def two_lobes(rows, cols):
    """Light in two places, with a valley at 7 % of the peak between them."""
    lobes = sum(np.exp(-(((cols - centre) / 25) ** 2)) for centre in (30, 130))
    return (lobes + 0.07) * np.exp(-(((rows - 60) / 200) ** 2))


def passage(width):
    """Mask that joins two halves through so many rows."""
    mask = np.zeros((48, 64), bool)
    mask[: 48 - width, 28:36] = True
    return mask


CASES = {
    "stripe": ((96, 128), dark_stripe, None),
    "lobes": ((120, 160), two_lobes, None),
    "passage of 8 rows": ((48, 64), simulate.gaussian_beam((48, 64), width=200), passage(8)),
    "passage of 1 row": ((48, 64), simulate.gaussian_beam((48, 64), width=200), passage(1)),
}


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4, 1e-6])
@pytest.mark.parametrize("case", CASES)
def test_what_has_converged_is_within_an_order_of_the_estimate(case, tolerance):
    shape, beam, mask = CASES[case]
    halves = np.where(np.arange(shape[1]) < shape[1] // 2, 1.02, 0.98)
    truth = simulate.paper_sensitivity(shape, rng=1) * halves
    frames = simulate.exposures(truth, beam, CROSS)
    cal = equipix.calibrate(frames, CROSS, mask=mask, tolerance=tolerance)
    true = np.nanmax(np.abs(simulate.relative_error(cal.sensitivity, truth)))
    assert cal.converged
    # The band that the hard case has to keep: the estimate is one of order, not a bound.
    assert 1 / 10 <= cal.error_estimate / true <= 10
