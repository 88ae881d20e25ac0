"""What the measurements can compare: pixels that tell nothing tie no parts together."""

from __future__ import annotations

import numpy as np
import pytest

import equipix
import reference
from equipix import Flag, simulate

CROSS = equipix.cross_pattern(2, 3)

pytestmark = [
    pytest.mark.filterwarnings("ignore::equipix.errors.IdentifiabilityWarning"),
    # So many loose ends take long; what is compared does not depend on them.
    pytest.mark.filterwarnings("ignore::equipix.errors.ConvergenceWarning"),
]

UNDETERMINED = Flag.NO_FLAT_FIELD | Flag.DO_NOT_USE
UNRELIABLE = Flag.UNRELIABLE_FLAT | Flag.DO_NOT_USE


def bridged(seed, shape=(9, 12), noise=0.0):
    """Exposures of a sensor some of whose pixels do not respond, some measurements masked."""
    rng = np.random.default_rng(seed)
    truth = simulate.paper_sensitivity(shape, rng=rng)
    silent = rng.random(shape) < 0.15
    truth[silent] = 0
    frames = simulate.exposures(truth, simulate.gaussian_beam(shape, width=40), CROSS)
    frames += noise * rng.standard_normal(frames.shape)
    mask = rng.random(frames.shape) < 0.25
    return frames, truth, silent, mask


def parts(labels):
    """Labels renumbered in the order of their first pixels."""
    return [list(dict.fromkeys(labels.tolist())).index(label) for label in labels]


# A sensor of a few pixels in parts may end in a minimum that is not the best.
@pytest.mark.filterwarnings("ignore::equipix.errors.MisfitWarning")
class TestSilentPixels:
    @pytest.mark.study
    @pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
    def test_components_are_those_of_the_reference(self, noise, draws):
        shown, seeds = 0, draws(80)
        for seed in seeds:
            frames, _, silent, mask = bridged(seed, noise=noise)
            cal = equipix.calibrate(
                frames,
                CROSS,
                mask=mask,
                variance=np.full(5, max(noise, 1e-6) ** 2),
                max_sweeps=2000,
            )
            cells, grid, _ = reference.grid_cells(frames.shape[1:], CROSS)
            labels, _ = reference.components(cells, ~mask, grid, silent)
            plain, _ = reference.components(cells, ~mask, grid)
            answers = ~silent & ~mask.all(axis=0)
            if not cal.converged:
                continue
            shown += parts(plain[answers]) != parts(labels[answers])
            assert parts(cal.component_labels[answers]) == parts(labels[answers])
            # Where only pixels without response look at a cell, y ≈ 0 does not tell whether they
            # or the light are missing: then such a pixel may have no number that could have one.
            missing = (labels == 0) & (cal.component_labels != 0)
            assert not missing[~silent].any()
            # Or the prior of weak light gives one to a pixel that sees no light but its own noise.
            held = silent & (labels != 0) & (cal.component_labels == 0)
            assert (cal.flags[held] & UNRELIABLE == UNRELIABLE).all()
            np.testing.assert_array_equal(
                cal.component_labels != 0, ((labels != 0) & ~held) | missing
            )
            np.testing.assert_array_equal(cal.component_labels != 0, np.isnan(cal.sensitivity))
            lost = cal.flags[np.isnan(cal.sensitivity)]
            assert (lost & UNDETERMINED == UNDETERMINED).all()
            dead = silent & ~held & (cal.component_labels == 0)
            assert (cal.flags[dead] & Flag.DEAD > 0).all()
        # Of the whole study one, or nothing was. Which converge depends on the processor.
        assert shown >= 1 or len(seeds) < 80

    def test_the_only_bridge(self):
        """Two halves, told apart by a column of masked pixels but for one without response."""
        truth = simulate.paper_sensitivity((20, 30), rng=1)
        truth[:, 15:] *= 1.3
        truth[10, 14] = 0
        frames = simulate.exposures(truth, simulate.gaussian_beam(truth.shape, width=50), SMALL)
        mask = np.zeros(truth.shape, bool)
        mask[:, 12:17] = True
        mask[10, 14] = False
        # Measurements of the bridge and of both halves in common cells, or none.
        cal = equipix.calibrate(frames, SMALL, mask=mask)
        assert cal.components == 2
        halves = [cal.component_labels[:, :12], cal.component_labels[:, 17:]]
        assert sorted({label for half in halves for label in half.ravel().tolist()}) == [0, 1]
        assert np.isnan(cal.sensitivity[10, 14])
        assert cal.flags[10, 14] == Flag.DEAD | UNDETERMINED

    def test_one_that_sees_a_single_part_keeps_its_number(self):
        truth = simulate.paper_sensitivity((20, 30), rng=1)
        truth[3, 4] = 0
        frames = simulate.exposures(truth, simulate.gaussian_beam(truth.shape, width=50), CROSS)
        cal = equipix.calibrate(frames, CROSS)
        assert cal.components == 1
        assert cal.sensitivity[3, 4] == pytest.approx(0, abs=1e-5)
        assert cal.flags[3, 4] == Flag.DEAD | Flag.DO_NOT_USE

    def test_a_dim_half_responds(self):
        """A filter over half of the sensor: weak is not silent where it is well measured."""
        truth = simulate.paper_sensitivity((40, 60), rng=1)
        truth[:, 30:] *= 0.01
        rng = np.random.default_rng(2)
        clean = simulate.exposures(truth, simulate.gaussian_beam(truth.shape, width=90), CROSS)
        frames = clean + 1e-4 * rng.standard_normal(clean.shape)
        cal = equipix.calibrate(frames, CROSS)
        assert cal.components == 1
        assert np.isfinite(cal.sensitivity).all()

    @pytest.mark.parametrize("seed", range(3))
    def test_degrees_of_freedom_count_them(self, seed):
        """A pixel without response has an unknown of its own, and no say in the beam."""
        rng = np.random.default_rng(seed)
        shape = (120, 160)
        truth = simulate.paper_sensitivity(shape, rng=rng)
        truth[rng.random(shape) < 0.05] = 0
        frames = simulate.exposures(truth, simulate.gaussian_beam(shape), CROSS)
        frames += 1e-3 * rng.standard_normal(frames.shape)
        cal = equipix.calibrate(frames, CROSS, variance=np.full(5, 1e-6))
        freedom = cal.objective / cal.reduced_chi2
        unknowns = frames[0].size + np.isfinite(cal.beam).sum() - cal.components
        assert freedom == pytest.approx(frames.size - unknowns, rel=1e-9)
        assert cal.reduced_chi2 == pytest.approx(1, abs=4 * np.sqrt(2 / freedom))


SMALL = [(0, 0), (0, 1), (0, 3), (2, 0), (3, 0)]
"""Shifts so small that a gap of five columns parts the sensor."""
