"""The map of residuals that a calibration keeps."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
from equipix import simulate
from equipix.errors import MisfitWarning
from equipix.report.maps import maps_of

STD = 1e-3


def calibrated(shape, disturbed=None):
    """Noisy frames, and their calibration; the noise of one part may be larger."""
    shifts = equipix.cross_pattern(5, 7)
    truth = simulate.paper_sensitivity(shape, rng=1)
    frames = simulate.exposures(truth, simulate.gaussian_beam(shape), shifts)
    noise = STD * np.random.default_rng(0).standard_normal(frames.shape)
    if disturbed is not None:
        noise[(slice(None), *disturbed)] *= 4
    variance = np.full(len(shifts), STD**2)
    mask = np.zeros(shape, bool)
    mask[:3] = True
    return frames + noise, equipix.calibrate(frames + noise, shifts, variance=variance, mask=mask)


@pytest.mark.parametrize(("shape", "side"), [((40, 50), 1), ((200, 300), 2)])
def test_it_is_the_rms_over_exposures(shape, side):
    frames, cal = calibrated(shape)
    residuals = cal.residuals(frames, variance=np.full(5, STD**2))[:, side // 2 :: side]
    residuals = residuals.reshape(5, shape[0] // side, -1, side)
    assert cal.residual_map.shape == (shape[0] // side, shape[1] // side)
    assert cal.residual_map.dtype == np.float32
    (name,) = (each.name for each in maps_of(cal) if each.name.startswith("Residuals, rms"))
    assert ("of a row of each cell" in name) is (side > 1)
    known = np.isfinite(cal.residual_map)
    # The first rows are masked, and in no use.
    np.testing.assert_array_equal(known, (np.indices(known.shape)[0] * side + side // 2) >= 3)
    used = residuals[:, known]
    # Single precision.
    np.testing.assert_allclose(
        cal.residual_map[known], np.sqrt(np.nanmean(used**2, axis=(0, 2))), rtol=1e-6
    )


def test_a_disturbed_part_stands_out():
    with pytest.warns(MisfitWarning, match="largest in a region"):
        _, cal = calibrated((120, 160), (slice(60, 80), slice(40, 100)))
    inside = cal.residual_map[60:80, 40:100]
    outside = np.delete(cal.residual_map, np.s_[60:80], axis=0)
    assert np.nanmedian(inside) > 3 * np.nanmedian(outside)


def test_it_is_kept_on_disk(tmp_path):
    _, cal = calibrated((40, 50))
    cal.save(tmp_path / "cal.tif")
    kept = equipix.load(tmp_path / "cal.tif").residual_map
    np.testing.assert_array_equal(kept, cal.residual_map)
